//! What points say that are not traced themselves, from those traced around them.
//!
//! What a mover does to points changes little from one to the next, so where rays are scarce a
//! block is brought nearly up to date by some of its points: the others change as these do. Next
//! time others are traced, so that no error stays, and once there is room for it all of them.

use glam::Vec3;
use psao_core::residual::BLOCK;

/// One of so many points of a block is traced where not all of them are.
pub(super) const THIN: usize = 4;

/// Points of a block, and by how much what they say has changed, in 1/255.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Between {
    known: [(Vec3, Vec3, f32); BLOCK],
    count: usize,
}

impl Between {
    /// A point's position and unit normal in the world.
    pub(super) fn learn(&mut self, position: Vec3, normal: Vec3, change: f32) {
        self.known[self.count] = (position, normal, change);
        self.count += 1;
    }

    /// By how much another changes; 0 where none is known that faces the same way.
    pub(super) fn change_at(&self, position: Vec3, normal: Vec3) -> f32 {
        let (mut sum, mut weights) = (0.0, 0.0);
        for (at, facing, change) in &self.known[..self.count] {
            let alike = normal.dot(*facing).max(0.0).powi(4);
            let weight = alike / at.distance_squared(position).max(1e-12);
            (sum, weights) = (sum + weight * change, weights + weight);
        }
        if weights > 0.0 { sum / weights } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_two_points_the_nearer_counts_more_and_one_that_faces_away_nothing() {
        let mut known = Between::default();
        assert_eq!(known.change_at(Vec3::ZERO, Vec3::Y), 0.0);
        known.learn(Vec3::ZERO, Vec3::Y, 10.0);
        known.learn(Vec3::X, Vec3::Y, 30.0);
        known.learn(Vec3::X * 0.1, Vec3::NEG_Y, 99.0);
        let near = known.change_at(Vec3::X * 0.25, Vec3::Y);
        assert!((10.0..20.0).contains(&near), "{near}");
        assert_eq!(known.change_at(Vec3::X * 0.5, Vec3::Y), 20.0);
        assert!((known.change_at(Vec3::ZERO, Vec3::Y) - 10.0).abs() < 1e-3);
        assert_eq!(known.change_at(Vec3::X * 0.1, Vec3::Z), 0.0);
    }
}
