//! Candidates on what is thin: where they are strewn by area alone, the edge of a table top or the
//! side of a chair's leg has places from which a lookup reads none that faces their way.
//!
//! Elimination takes away what is crowded, so these stay, and there are no more points in all.

use super::{SurfacePoint, area_vector, in_hole, in_metres};
use crate::scene::Mesh;
use crate::topology::Fast;
use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};

/// How near a candidate is to lie to every place, largest radii: a lookup reads at least so far
/// along each axis.
const NEAR: f64 = 1.25;

/// The cosine from which on it faces the same way, as in elimination.
const ALIKE: f32 = 0.1;

/// What is thinner cannot be seen, largest radii: most such triangles are none but for rounding.
const THINNEST: f64 = 0.01;

/// Places are looked at so far apart along a triangle, largest radii.
const STEP: f64 = 0.5;

/// Most places that are looked at for each candidate, besides one a triangle and side: there is no
/// end to what needles may be long.
const MOST_PLACES: f64 = 2.0;

/// Adds candidates along triangles that are narrow, on each of `sides`, where none is near; `radius`
/// is the largest radius in metres. At most `most`, evenly many everywhere, so that what is thin does
/// not take all points from what is not.
pub(super) fn cover(
    mesh: &Mesh,
    metric: Vec3,
    radius: f64,
    sides: u32,
    most: usize,
    candidates: &mut Vec<SurfacePoint>,
) {
    let near = NEAR * radius;
    let triangles = mesh.triangles.len() as u32;
    let narrow = |number: u32| {
        let found = Triangle::of(mesh, metric, number);
        found.filter(|found| (THINNEST * radius..2.0 * near).contains(&found.width))
    };
    let length: f64 = (0..triangles).filter_map(narrow).map(|n| n.length).sum();
    let places = MOST_PLACES * candidates.len().max(1) as f64;
    let step = (STEP * radius).max(length * f64::from(sides) / places);
    let places = || {
        (0..triangles).filter_map(narrow).flat_map(|triangle| {
            let count = (triangle.length / step).ceil().max(1.0) as u32;
            (0..count * sides).map(move |number| {
                let along = (f64::from(number % count) + 0.5) / f64::from(count);
                let place = triangle.middle(along, number >= count);
                (place, triangle.at(&place), triangle.normal(place.back))
            })
        })
    };
    let mut known = Known::around(near, places().map(|(_, at, _)| at));
    let of_candidate = |candidate: &SurfacePoint| {
        let triangle = Triangle::of(mesh, metric, candidate.triangle)?;
        let at = triangle.at(candidate);
        known
            .is_around(at)
            .then(|| (at, triangle.normal(candidate.back)))
    };
    let around: Vec<(DVec3, Vec3)> = candidates.par_iter().filter_map(of_candidate).collect();
    for (at, normal) in around {
        known.add(at, normal);
    }
    let mut added = Vec::new();
    for (place, at, normal) in places() {
        if !known.has_near(at, normal) && !in_hole(mesh, &place) {
            known.add(at, normal);
            added.push(place);
        }
    }
    let count = added.len().min(most);
    candidates.extend((0..count).map(|i| added[i * added.len() / count]));
}

/// A triangle in metres.
struct Triangle {
    number: u32,
    corners: [DVec3; 3],
    facing: Vec3,
    /// The corner across from the longest edge.
    tip: usize,
    length: f64,
    /// From the longest edge to the tip.
    width: f64,
}

impl Triangle {
    /// `None` without an area.
    fn of(mesh: &Mesh, metric: Vec3, number: u32) -> Option<Triangle> {
        let corners = mesh.triangles[number as usize].map(|i| in_metres(mesh, metric, i));
        let edge = |tip: usize| corners[(tip + 1) % 3].distance(corners[(tip + 2) % 3]);
        let tip = (0..3).max_by(|a, b| edge(*a).total_cmp(&edge(*b)))?;
        let across = area_vector(mesh, metric, number as usize);
        let (length, width) = (edge(tip), across.length() / edge(tip));
        (length.is_finite() && width > 0.0).then(|| Triangle {
            number,
            corners,
            facing: across.normalize_or_zero().as_vec3(),
            tip,
            length,
            width,
        })
    }

    /// A place half way between the longest edge and the other two, from one end of it to the
    /// other as `along` goes from 0 to 1.
    fn middle(&self, along: f64, back: bool) -> SurfacePoint {
        let [from, to] = [1, 2].map(|i| self.corners[(self.tip + i) % 3]);
        let edge = to - from;
        let below = (self.corners[self.tip] - from).dot(edge) / edge.length_squared();
        let below = below.clamp(1e-6, 1.0 - 1e-6);
        let up = 0.5 * (along / below).min((1.0 - along) / (1.0 - below));
        let mut weights = [0.0; 3];
        weights[self.tip] = up;
        weights[(self.tip + 1) % 3] = 1.0 - along - up * (1.0 - below);
        weights[(self.tip + 2) % 3] = along - up * below;
        let [_, u, v] = weights.map(|weight| weight.clamp(0.0, 1.0) as f32);
        SurfacePoint {
            triangle: self.number,
            u,
            // Rounding must not lead out of the triangle.
            v: v.min(1.0 - u),
            back,
        }
    }

    fn at(&self, point: &SurfacePoint) -> DVec3 {
        let [a, b, c] = self.corners;
        a + f64::from(point.u) * (b - a) + f64::from(point.v) * (c - a)
    }

    fn normal(&self, back: bool) -> Vec3 {
        if back { -self.facing } else { self.facing }
    }
}

/// Candidates by place, in cubes as long as the distance that counts as near.
struct Known {
    near: f64,
    /// Where candidates matter: cubes `COARSE` times as long.
    around: HashSet<[i32; 3], Fast>,
    /// The last candidate of each cube.
    last: HashMap<[i32; 3], u32, Fast>,
    all: Vec<One>,
}

/// A place is in reach of one or two of them an axis, and the next place mostly of the same.
const COARSE: f64 = 4.0;

struct One {
    at: DVec3,
    normal: Vec3,
    /// The one before it in its cube.
    before: Option<u32>,
}

impl Known {
    /// None yet; those in reach of `places` will matter.
    fn around(near: f64, places: impl Iterator<Item = DVec3>) -> Known {
        let mut around = HashSet::default();
        let mut before = None;
        for at in places {
            let reach = [at - near, at + near].map(|at| cube(at, COARSE * near));
            if before.replace(reach) == Some(reach) {
                continue;
            }
            for corner in 0..8 {
                around.insert([0, 1, 2].map(|axis| reach[corner >> axis & 1][axis]));
            }
        }
        Known {
            near,
            around,
            last: HashMap::default(),
            all: Vec::new(),
        }
    }

    fn is_around(&self, at: DVec3) -> bool {
        self.around
            .contains(&cube(at, COARSE * self.near).to_array())
    }

    fn add(&mut self, at: DVec3, normal: Vec3) {
        let cube = cube(at, self.near).to_array();
        let before = self.last.insert(cube, self.all.len() as u32);
        self.all.push(One { at, normal, before });
    }

    fn has_near(&self, at: DVec3, normal: Vec3) -> bool {
        let middle = cube(at, self.near);
        // The cube itself first: most often that is enough.
        (0..27).map(|k| (k + 13) % 27).any(|k| {
            let by = IVec3::new(k % 3, k / 3 % 3, k / 9) - 1;
            let beside = middle.wrapping_add(by).to_array();
            let mut next = self.last.get(&beside).copied();
            while let Some(number) = next {
                let one = &self.all[number as usize];
                let is_near = one.at.distance_squared(at) < self.near * self.near;
                if is_near && one.normal.dot(normal) > ALIKE {
                    return true;
                }
                next = one.before;
            }
            false
        })
    }
}

/// The cube of a length that has a place.
fn cube(at: DVec3, length: f64) -> IVec3 {
    (at / length).floor().as_ivec3()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::{generate, largest_radius};

    /// A floor of 4 m², and behind it, upright, a strip of `quads` quads.
    fn floor_and_strip(length: f32, height: f32, quads: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let mut quad = |corners: [Vec3; 4]| {
            let first = mesh.positions.len() as u32;
            mesh.positions.extend(corners);
            let triangles = [[0, 1, 2], [0, 2, 3]];
            mesh.triangles
                .extend(triangles.map(|t| t.map(|i| first + i)));
        };
        let corners = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
        quad(corners.map(|[x, y]| Vec3::new(x, y, 0.0)));
        for i in 0..quads {
            let [from, to] = [i, i + 1].map(|i| length * i as f32 / quads as f32);
            let corners = [[from, 0.0], [to, 0.0], [to, height], [from, height]];
            quad(corners.map(|[x, z]| Vec3::new(x, 3.0, z)));
        }
        mesh.normals = vec![Vec3::Z; mesh.positions.len()];
        mesh
    }

    #[test]
    fn every_place_of_a_strip_has_a_point_in_reach_and_there_are_no_more_points() {
        let density = 1024.0;
        for (height, quads) in [(0.001, 1), (0.005, 1), (0.005, 300), (0.02, 40)] {
            let mesh = floor_and_strip(2.0, height, quads);
            let set = generate(&mesh, Vec3::ONE, density, 1).unwrap();
            let expected = density * f64::from(4.0 + 2.0 * height);
            assert!((set.points.len() as f64 - expected).abs() < 1.0);
            let at = |p: &SurfacePoint| p.position(&mesh.triangles, &mesh.positions);
            let strip = set.points.iter().map(at).filter(|at| at.y > 2.5);
            let mut along: Vec<f32> = strip.map(|at| at.x).chain([0.0, 2.0]).collect();
            along.sort_by(f32::total_cmp);
            let gap = along.windows(2).map(|w| w[1] - w[0]).fold(0.0, f32::max);
            // One between two neighbours is taken away where both are nearer than about 1.4.
            let most = 2.8 * largest_radius(density) as f32;
            assert!(gap < most, "{height} {quads}: {gap}, not {most}");
        }
    }

    #[test]
    fn wires_take_at_most_a_quarter_of_the_points_from_a_floor_however_long_they_are() {
        for (length, at_least) in [(50.0, 750), (100.0, 740)] {
            let mesh = floor_and_strip(length, 4e-4, 1);
            let set = generate(&mesh, Vec3::ONE, 256.0, 1).unwrap();
            let floor = set.points.iter().filter(|point| point.triangle < 2);
            let floor = floor.count();
            assert!((at_least..810).contains(&floor), "{length}: {floor}");
        }
    }
}
