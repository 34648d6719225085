//! Which points turn their front to a viewer.
//!
//! A fragment's normal faces the camera, and the lookup gives next to nothing to points whose normal
//! is another. So points that all face away need neither rays nor bits until something turns: the
//! thing, or the way from which it is looked at.

use crate::world::Slice;
use glam::{Affine3A, Vec3, Vec3A};
use psao_core::residual::BLOCK;

/// The cosine between a point's normal and the way to the eye from which on the point faces away.
/// Not 0: where a surface bends out of sight, fragments whose normal is level with the view blend
/// points whose normals lie up to some 15 degrees behind; and normals are interpolated.
pub const AWAY: f32 = -0.3;

/// How far the eye may have moved before the next frame with what it sees then has come, metres.
pub const EYE_M: f32 = 0.1;

/// Where a block of points is, and which way its normals point.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cone {
    center: Vec3,
    radius: f32,
    /// The middle of the normals; of unit length, or zero where they point everywhere.
    axis: Vec3,
    /// Cosine and sine of two angles between the axis and the way to the eye: up to the first all
    /// points face the eye, from the second on (at most π) none does.
    limits: [[f32; 2]; 2],
}

/// Blocks of a slice, one bit each, the first the lowest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Faces {
    /// Those of which a point may face the eye.
    pub any: u64,
    /// Those of which all points do.
    pub all: u64,
}

impl Faces {
    /// All of a slice's blocks.
    pub fn all_of(slice: &Slice) -> Faces {
        let all = match slice.points.len().div_ceil(BLOCK) {
            0 => 0,
            blocks => u64::MAX >> (64 - blocks.min(64)),
        };
        Faces { any: all, all }
    }
}

impl Cone {
    /// Of points' positions and unit normals.
    fn of(points: &[(Vec3, [Vec3; 2])]) -> Cone {
        let count = points.len().max(1) as f32;
        let center = points.iter().map(|(at, _)| *at).sum::<Vec3>() / count;
        let normals = points.iter().flat_map(|(_, normals)| normals);
        let axis = normals.clone().sum::<Vec3>().normalize_or_zero();
        let far = |(at, _): &(Vec3, [Vec3; 2])| at.distance(center);
        let wide = |normal: &Vec3| normal.dot(axis).clamp(-1.0, 1.0).acos();
        let wide = normals.map(wide).fold(0.0, f32::max);
        let wide = if axis == Vec3::ZERO {
            std::f32::consts::PI
        } else {
            wide
        };
        let limit = |angle: f32| {
            let (sin, cos) = angle.clamp(0.0, std::f32::consts::PI).sin_cos();
            [cos, sin]
        };
        Cone {
            center,
            radius: points.iter().map(far).fold(0.0, f32::max),
            axis,
            limits: [AWAY.acos() - wide, AWAY.acos() + wide].map(limit),
        }
    }

    /// The cones of points' blocks, and of all of them. Of each point: its position, and two unit
    /// normals (the same where it has one) that both have to face away before it does.
    pub fn of_blocks(points: impl Iterator<Item = (Vec3, [Vec3; 2])>) -> (Vec<Cone>, Cone) {
        let points: Vec<(Vec3, [Vec3; 2])> = points.collect();
        let blocks = points.chunks(BLOCK).map(Cone::of).collect();
        (blocks, Cone::of(&points))
    }

    /// Whether all of its points face an eye, and whether any does that is at most `around` from
    /// there.
    fn faces(&self, eye: Vec3, around: f32) -> [bool; 2] {
        let to = eye - self.center;
        let squared = to.length_squared();
        let radius = self.radius + around;
        if squared <= radius * radius {
            return [false, true];
        }
        // A ball spans an angle β. All face the eye up to the first limit less β, none from the
        // second and β on. Both sides are times the distance.
        let [[cos, sin], [cos_none, sin_none]] = self.limits;
        let (towards, off) = (self.axis.dot(to), (squared - self.radius.powi(2)).sqrt());
        let within = sin * off > cos * self.radius;
        let all = within && towards > cos * off + sin * self.radius;
        let off = (squared - radius * radius).sqrt();
        let around_it = sin_none * off + cos_none * radius <= 0.0;
        let any = around_it || towards > cos_none * off - sin_none * radius;
        [all, any]
    }

    /// The middle of its normals: of unit length, or zero where they point everywhere.
    pub fn axis(&self) -> Vec3 {
        self.axis
    }

    /// A ball around its points.
    pub fn ball(&self) -> (Vec3, f32) {
        (self.center, self.radius)
    }
}

/// An eye in an instance's local space, wherever it is within a distance.
#[derive(Clone, Copy, Debug)]
pub struct LocalEye {
    position: Vec3,
    around: f32,
}

impl LocalEye {
    /// Of an eye that may be `around_m` metres from where it is said to be. `None` where angles in
    /// local space are not those in the world (the instance is stretched), or not known.
    pub fn of(eye: Vec3, around_m: f32, world_from_local: &Affine3A) -> Option<LocalEye> {
        let m = world_from_local.matrix3;
        let squared = m.transpose() * m;
        let scale = squared.x_axis.x;
        let off = |column: Vec3A, own: Vec3A| (column - own * scale).abs().max_element();
        let stretched = off(squared.x_axis, Vec3A::X)
            .max(off(squared.y_axis, Vec3A::Y))
            .max(off(squared.z_axis, Vec3A::Z));
        let position = world_from_local.inverse().transform_point3(eye);
        let around = around_m / scale.sqrt();
        let usable = stretched <= 0.02 * scale && around.is_finite() && position.is_finite();
        usable.then_some(LocalEye { position, around })
    }

    /// The blocks of a slice, given by their cones.
    pub fn faces(&self, cones: &[Cone]) -> Faces {
        let mut faces = Faces { any: 0, all: 0 };
        for cone in cones.iter().rev() {
            let [all, any] = cone.faces(self.position, self.around);
            faces.any = faces.any << 1 | u64::from(any);
            faces.all = faces.all << 1 | u64::from(all);
        }
        faces
    }

    /// Whether any of some points may face it, given by their cone.
    pub fn may_be_faced(&self, cone: &Cone) -> bool {
        let [_, any] = cone.faces(self.position, self.around);
        any
    }

    /// Whether a point may face it, or will soon.
    pub fn is_faced(&self, at: Vec3, normal: Vec3) -> bool {
        let to = self.position - at;
        normal.dot(to) > AWAY * to.length() - self.around
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    /// Points on a piece of a sphere.
    fn piece(seed: u32, center: Vec3, radius: f32, wide: f32) -> Vec<(Vec3, Vec3)> {
        let mut random = seed;
        let mut next = || {
            random = random.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            let mixed = (random >> 16 ^ random).wrapping_mul(0x7feb_352d);
            (mixed ^ mixed >> 15) as f32 * 0.5f32.powi(31) - 1.0
        };
        let middle = Vec3::new(next(), next(), next()).normalize_or(Vec3::X);
        (0..BLOCK)
            .map(|_| {
                let normal = middle + Vec3::new(next(), next(), next()) * wide;
                let normal = normal.normalize_or(middle);
                (center + normal * radius, normal)
            })
            .collect()
    }

    #[test]
    fn no_point_that_faces_the_eye_is_in_a_block_that_does_not_and_most_others_are() {
        let (mut away, mut left, mut front, mut whole) = (0, 0, 0, 0);
        for seed in 0..4000 {
            let wide = [0.0, 0.2, 0.5, 2.0][seed as usize % 4];
            let points = piece(seed, Vec3::new(0.3, -0.2, 0.1), 0.2, wide);
            let cone = Cone::of_blocks(points.iter().map(|&(at, normal)| (at, [normal; 2]))).1;
            let angle = seed as f32;
            let eye = Vec3::new(angle.cos(), angle.sin(), (angle * 0.7).sin()) * 2.0;
            let faces = points.iter().any(|(at, normal)| {
                let to = (eye - at).normalize();
                normal.dot(to) > AWAY
            });
            let every = points.iter().all(|(at, normal)| {
                let to = (eye - at).normalize();
                normal.dot(to) > AWAY
            });
            let [all, any] = cone.faces(eye, 0.0);
            assert!(any || !faces, "{seed}");
            assert!(every || !all, "{seed}");
            let [_, around] = cone.faces(eye, EYE_M);
            assert!(around || !any);
            (away, left) = (away + u32::from(!faces), left + u32::from(!around));
            (front, whole) = (front + u32::from(every), whole + u32::from(all));
        }
        assert!(left * 10 > away * 7 && away > 500, "{left} of {away}");
        assert!(whole * 10 > front * 7 && front > 1000, "{whole} of {front}");
    }

    #[test]
    fn a_block_whose_normals_point_everywhere_and_an_eye_within_always_face() {
        let everywhere = [(Vec3::ZERO, [Vec3::X, Vec3::NEG_X])];
        let cone = Cone::of_blocks(everywhere.into_iter()).1;
        assert_eq!(cone.faces(Vec3::splat(9.0), 0.0), [false, true]);
        let flat = [Vec3::X, Vec3::NEG_X].map(|at| (at, [Vec3::Y; 2]));
        let cone = Cone::of_blocks(flat.into_iter()).1;
        assert!(cone.faces(Vec3::new(0.0, -0.5, 0.0), 0.0)[1]);
        assert!(!cone.faces(Vec3::new(0.0, -4.0, 0.0), 0.0)[1]);
    }

    #[test]
    fn an_instance_that_is_turned_moved_and_scaled_faces_as_it_does_in_the_world() {
        let (flat, whole) = Cone::of_blocks([(Vec3::ZERO, [Vec3::Y; 2])].into_iter());
        let turned = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
        let place = |scale: Vec3| {
            Affine3A::from_scale_rotation_translation(scale, turned, Vec3::new(5.0, 0.0, 0.0))
        };
        // It looks along -x now.
        for (x, sees) in [(2.0, 1), (8.0, 0)] {
            let eye = Vec3::new(x, 0.0, 0.0);
            let local = LocalEye::of(eye, EYE_M, &place(Vec3::splat(0.25)));
            let local = local.expect("not stretched");
            assert_eq!(local.faces(&flat).any, sees);
            assert_eq!(local.is_faced(Vec3::ZERO, Vec3::Y), sees == 1);
            assert_eq!(local.may_be_faced(&whole), sees == 1);
            // From where it looks at it, and from where it does not, if that is near enough.
            let near = LocalEye::of(eye, 4.0, &place(Vec3::splat(0.25)));
            assert!(near.expect("not stretched").may_be_faced(&whole));
            assert!(LocalEye::of(eye, EYE_M, &place(Vec3::new(1.0, 2.0, 1.0))).is_none());
            assert!(LocalEye::of(eye, EYE_M, &place(Vec3::ZERO)).is_none());
        }
        assert!(LocalEye::of(Vec3::splat(f32::INFINITY), EYE_M, &place(Vec3::ONE)).is_none());
    }
}
