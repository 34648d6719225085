//! The directions that a point's rays take.
//!
//! An Owen-scrambled (0,2)-sequence on the cosine-weighted hemisphere: every prefix of a power of
//! two is stratified, so 256 rays a point are as good as 2048 independent ones, and a caller may
//! stop at any power of two. A point always takes the same directions in its own space: fresh ones
//! each frame would make still points flicker.

use std::f32::consts::TAU;

use glam::{Mat3A, Vec3};

use crate::rays::{Directions, Fan};

/// Most rays a set holds; enough for references.
pub const MAX_RAYS: usize = 4096;

/// Different scrambles. Neighbouring points also differ by a rotation about their normals.
const SETS: usize = 64;

/// Sets of directions, computed once.
pub struct Samples {
    rays: usize,
    /// Around z.
    sets: Vec<Directions>,
}

/// A number that looks random, for 32 bits that don't.
fn hash(x: u32) -> u32 {
    let x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    let x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// Owen's scrambling: each bit is flipped by a random function of the bits above it, which keeps
/// the stratification. (Laine and Karras' hash with Burley's constants, on the reversed number.)
fn scramble(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits();
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^= x.wrapping_mul(0x53a2_2864);
    x.reverse_bits()
}

/// Point `index` of scramble `set`, in 2^-32 of the unit square: the first two dimensions of
/// Sobol's sequence.
fn sobol(index: u32, set: u32) -> [u32; 2] {
    let mut second = 0u32;
    let mut column = 1u32 << 31;
    let mut rest = index;
    while rest != 0 {
        if rest & 1 == 1 {
            second ^= column;
        }
        column ^= column >> 1;
        rest >>= 1;
    }
    let seed = |dimension| hash(hash(2 * set + dimension).wrapping_add(0x9e37_79b9));
    [
        scramble(index.reverse_bits(), seed(0)),
        scramble(second, seed(1)),
    ]
}

/// A number within 0..1, never 1.
fn unit(x: u32) -> f32 {
    (x >> 8) as f32 / (1 << 24) as f32
}

impl Samples {
    /// Sets of `rays` directions each.
    ///
    /// # Panics
    /// Unless `rays` is within 1 to [`MAX_RAYS`].
    pub fn new(rays: usize) -> Samples {
        assert!(
            (1..=MAX_RAYS).contains(&rays),
            "rays a point: {rays} is not within 1..={MAX_RAYS}"
        );
        let set = |set: usize| {
            let direction = |i: usize| {
                let [a, b] = sobol(i as u32, set as u32).map(unit);
                let (sin, cos) = (b * TAU).sin_cos();
                Vec3::new(cos * a.sqrt(), sin * a.sqrt(), (1.0 - a).sqrt())
            };
            let mut directions = Directions::new(&(0..rays).map(direction).collect::<Vec<_>>());
            directions.set = set as u32;
            directions
        };
        Samples {
            rays,
            sets: (0..SETS).map(set).collect(),
        }
    }

    /// The first directions of a point's set, as many as `out` holds: unit vectors distributed by
    /// the cosine around `normal`. `tangent` is any vector fixed to the surface (a triangle's
    /// edge), so that the directions turn with it; of no matter where it is degenerate, and so is
    /// a normal without a direction, which counts as +z.
    ///
    /// # Panics
    /// If `out` is longer than a set.
    pub fn directions(&self, point_id: u32, normal: Vec3, tangent: Vec3, out: &mut [Vec3]) {
        assert!(
            out.len() <= self.rays,
            "{} rays asked of sets of {}",
            out.len(),
            self.rays
        );
        let fan = self.fan(point_id, Vec3::ZERO, normal, tangent);
        for index in 0..self.rays {
            if let Some(out) = out.get_mut(fan.directions.given(index)) {
                *out = fan.direction(index);
            }
        }
    }

    /// All sets, one after the other, directions around z; for shaders. Behind direction i of a
    /// set stands the place in the set of the one that is i-th in the sorted order.
    #[cfg(feature = "gpu")]
    pub(crate) fn table(&self) -> Vec<[f32; 4]> {
        let mut table = vec![[0.0; 4]; SETS * self.rays];
        for (set, out) in self.sets.iter().zip(table.chunks_mut(self.rays)) {
            for index in 0..self.rays {
                let [x, y, z] = set.direction(index).to_array();
                out[set.given(index)][..3].copy_from_slice(&[x, y, z]);
                out[index][3] = set.given(index) as f32;
            }
        }
        table
    }

    /// The rays of a point from `origin`, in the directions of [`Samples::directions`].
    pub fn fan(&self, point_id: u32, origin: Vec3, normal: Vec3, tangent: Vec3) -> Fan<'_> {
        let bits = hash(point_id);
        let normal = scaled(normal)
            .and_then(Vec3::try_normalize)
            .unwrap_or(Vec3::Z);
        let across = scaled(tangent)
            .and_then(Vec3::try_normalize)
            .map_or(Vec3::ZERO, |tangent| tangent - normal * normal.dot(tangent));
        let usable = across.length_squared() > 1e-6;
        let x = if usable {
            across.normalize()
        } else {
            normal.any_orthonormal_vector()
        };
        let y = normal.cross(x);
        let (sin, cos) = (unit(bits) * TAU).sin_cos();
        // The low bits choose the set; the rotation comes from the high ones.
        let axes = [x * cos + y * sin, y * cos - x * sin, normal];
        Fan {
            origin,
            axes: Mat3A::from_cols_array_2d(&axes.map(Vec3::into)),
            directions: &self.sets[bits as usize % SETS],
        }
    }
}

/// A multiple of the vector that neither overflows nor underflows when squared.
fn scaled(v: Vec3) -> Option<Vec3> {
    let largest = v.abs().max_element();
    (v.is_finite() && largest >= f32::MIN_POSITIVE).then(|| v / largest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_power_of_two_prefix_has_one_sample_in_each_elementary_interval() {
        for set in 0..SETS as u32 {
            for log in 0..=12u32 {
                for across in 0..=log {
                    // Intervals of 2^-across by 2^-(log - across).
                    let mut seen = vec![false; 1 << log];
                    for i in 0..1u32 << log {
                        let [a, b] = sobol(i, set).map(u64::from);
                        let column = (a << across) >> 32;
                        let row = (b << (log - across)) >> 32;
                        let cell = (column << (log - across) | row) as usize;
                        assert!(!seen[cell], "set {set}: two of 2^{log} in one interval");
                        seen[cell] = true;
                    }
                }
            }
        }
    }

    #[test]
    fn sets_differ() {
        for set in 1..SETS as u32 {
            let same = (0..256).filter(|i| sobol(*i, 0) == sobol(*i, set)).count();
            assert!(same == 0, "sets 0 and {set} share {same} samples");
        }
    }

    /// Directions of a point around +z.
    fn around_z(samples: &Samples, point: u32, rays: usize) -> Vec<Vec3> {
        let mut out = vec![Vec3::ZERO; rays];
        samples.directions(point, Vec3::Z, Vec3::X, &mut out);
        out
    }

    #[test]
    fn directions_are_unit_vectors_distributed_by_the_cosine() {
        let samples = Samples::new(256);
        for point in 0..200 {
            let directions = around_z(&samples, point, 256);
            assert!(
                directions
                    .iter()
                    .all(|d| (d.length() - 1.0).abs() < 1e-5 && d.z >= 0.0)
            );
            let mean: Vec3 = directions.iter().sum::<Vec3>() / 256.0;
            assert!(
                (mean.z / (2.0 / 3.0) - 1.0).abs() < 0.01,
                "mean z {}",
                mean.z
            );
            assert!(mean.truncate().length() < 0.01, "leans by {mean}");
        }
    }

    #[test]
    fn integration_error_falls_faster_than_of_independent_samples() {
        // Half of the hemisphere is hidden, by an edge through the normal at some angle; as an AO
        // mask would see it: discontinuous.
        let samples = Samples::new(1024);
        let error = |rays: usize| {
            let squares: f64 = (0..400u32)
                .map(|point| {
                    let edge = unit(hash(point ^ 0x5555_0000)) * TAU;
                    let away = Vec3::new(edge.cos(), edge.sin(), 0.3);
                    let directions = around_z(&samples, point, rays);
                    let open = directions.iter().filter(|d| d.dot(away) > 0.0).count();
                    // The plane's tilt away from the normal hides (1 - sin) / 2 of the cosine.
                    let exact = 0.5 * (1.0 + 0.3 / 1.09f64.sqrt());
                    (open as f64 / rays as f64 - exact).powi(2)
                })
                .sum();
            (squares / 400.0).sqrt()
        };
        let (coarse, fine) = (error(16), error(1024));
        // Independent samples: a factor of 8 from 16 to 1024.
        assert!(
            coarse / fine > 16.0,
            "{coarse} with 16 rays, {fine} with 1024"
        );
        // And an error of sqrt(p (1 - p) / n).
        assert!(fine < 0.48 / 32.0 / 4.0, "{fine} with 1024 rays");
    }

    #[test]
    fn directions_turn_with_the_surface() {
        let samples = Samples::new(64);
        let turn = glam::Quat::from_euler(glam::EulerRot::XYZ, 0.3, -1.1, 2.5);
        let (normal, tangent) = (Vec3::new(0.6, 0.0, 0.8), Vec3::new(3.0, 5.0, -2.0));
        let mut before = [Vec3::ZERO; 64];
        let mut after = [Vec3::ZERO; 64];
        samples.directions(7, normal, tangent, &mut before);
        samples.directions(7, turn * normal, turn * tangent * 0.01, &mut after);
        for (before, after) in before.iter().zip(after) {
            assert!((turn * *before).distance(after) < 1e-5);
        }
    }

    #[test]
    fn degenerate_normals_and_tangents_still_give_unit_vectors_on_the_right_side() {
        let samples = Samples::new(16);
        let odd = [
            Vec3::ZERO,
            Vec3::NAN,
            Vec3::Y,
            Vec3::INFINITY,
            Vec3::splat(1e-30),
            Vec3::MAX,
        ];
        for normal in odd {
            for tangent in odd {
                let mut out = [Vec3::ZERO; 16];
                samples.directions(1, normal, tangent, &mut out);
                for d in out {
                    assert!((d.length() - 1.0).abs() < 1e-5, "{normal} {tangent}: {d}");
                    let up = scaled(normal).map_or(Vec3::Z, Vec3::normalize);
                    assert!(d.dot(up) >= -1e-6, "{normal} {tangent}: {d} is below");
                }
            }
        }
    }
}
