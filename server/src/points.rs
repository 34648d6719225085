//! Points on surfaces: where ambient occlusion is known.
//!
//! A mesh's points are spread once, in its rest space, evenly by area in metres: more candidates
//! than needed are strewn over the triangles, and weighted sample elimination (Yuksel 2015) takes
//! away those that crowd others. Going on with it orders what is left, so that every prefix of the
//! points is an even, coarser set.

mod cover;
mod eliminate;
pub mod pilot;

use crate::lattice::Lattice;
use crate::scene::Mesh;
use cover::cover;
use eliminate::{Sample, eliminate};
use glam::{DVec3, Vec3};
use pilot::Density;
use rayon::prelude::*;
use std::fmt;

/// Candidates strewn for each point kept, as in the paper. They follow a low-discrepancy sequence,
/// so two leave gaps nearly as even as four random ones would (0.81 and 0.80 of the largest radius,
/// root mean square; two random ones 0.85), in a third of the time.
const CANDIDATES_PER_POINT: f64 = 2.0;

/// Most points of one mesh. Making them takes about 100 bytes a candidate: up to 3.4 GB, and twice
/// that where all is thin.
pub const MAX_POINTS: u64 = 1 << 24;

/// A sample on a mesh's surface: where it is never changes; its position and normal follow from
/// the (posed) vertices.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Index into the mesh's triangles.
    pub triangle: u32,
    /// Weight of the triangle's vertex 1, from 0 to 1.
    pub u: f32,
    /// Weight of the triangle's vertex 2; `u + v <= 1`, and the rest is vertex 0's.
    pub v: f32,
    /// It lies on the back of a double-sided triangle, and its normals are turned around.
    pub back: bool,
}

impl SurfacePoint {
    /// Where it is, in the space and unit of `positions`.
    pub fn position(&self, triangles: &[[u32; 3]], positions: &[Vec3]) -> Vec3 {
        let [p0, p1, p2] = self.corners(triangles, positions);
        p0 + self.u * (p1 - p0) + self.v * (p2 - p0)
    }

    /// Unit shading normal, interpolated from the vertices' `normals`; the geometric normal where
    /// those cancel out.
    pub fn normal(&self, triangles: &[[u32; 3]], positions: &[Vec3], normals: &[Vec3]) -> Vec3 {
        let [n0, n1, n2] = self.corners(triangles, normals);
        let sum = (1.0 - self.u - self.v) * n0 + self.u * n1 + self.v * n2;
        // Rounding leaves a direction of noise where unit vectors cancel.
        match sum.try_normalize() {
            Some(normal) if sum.length_squared() > 1e-8 => self.turn(normal),
            _ => self.geometric_normal(triangles, positions),
        }
    }

    /// Unit normal of the flat triangle, on the side the point is on; `Z` where the pose has
    /// collapsed the triangle.
    pub fn geometric_normal(&self, triangles: &[[u32; 3]], positions: &[Vec3]) -> Vec3 {
        let [p0, p1, p2] = self.corners(triangles, positions).map(|p| p.as_dvec3());
        let normal = (p1 - p0).cross(p2 - p0).normalize_or(DVec3::Z);
        self.turn(normal.as_vec3())
    }

    /// Unit direction of the triangle's first edge: turns with the surface, and so fixes a frame
    /// to it. `X` where the pose has collapsed the edge.
    pub fn tangent(&self, triangles: &[[u32; 3]], positions: &[Vec3]) -> Vec3 {
        let [p0, p1, _] = self.corners(triangles, positions);
        (p1 - p0).normalize_or(Vec3::X)
    }

    fn corners(&self, triangles: &[[u32; 3]], vertices: &[Vec3]) -> [Vec3; 3] {
        triangles[self.triangle as usize].map(|i| vertices[i as usize])
    }

    fn turn(&self, normal: Vec3) -> Vec3 {
        if self.back { -normal } else { normal }
    }
}

/// A mesh's points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointSet {
    /// In progressive order: every prefix is well spread.
    pub points: Vec<SurfacePoint>,
    /// Visible surface in square metres: without the mask's holes, and both sides of what has two.
    pub area_m2: f64,
}

/// Why there are no points.
#[derive(Clone, Debug, PartialEq)]
pub enum PointError {
    /// The density is not a number above 0.
    Density(f64),
    /// The metric has a component that is not finite.
    Metric {
        /// The mesh's name.
        mesh: String,
        /// Its factors along the axes.
        metric: Vec3,
    },
    /// The mesh needs more than [`MAX_POINTS`].
    TooMany {
        /// The mesh's name.
        mesh: String,
        /// Square metres, all sides.
        area_m2: f64,
        /// Points per square metre asked for.
        density: f64,
    },
}

impl fmt::Display for PointError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Density(density) => {
                write!(
                    f,
                    "--density is {density}: give points per square metre, above 0"
                )
            }
            Self::Metric { mesh, metric } => {
                write!(
                    f,
                    "mesh \"{mesh}\" is scaled by {metric}: give its node a finite scale"
                )
            }
            Self::TooMany {
                mesh,
                area_m2,
                density,
            } => write!(
                f,
                "mesh \"{mesh}\" has {area_m2:.4e} square metres; at {density} points each that \
                 is more than {MAX_POINTS}: if the scene is not in metres give its --unit, else \
                 lower --density"
            ),
        }
    }
}

impl std::error::Error for PointError {}

/// The largest radius in metres that disks around points can have without any overlapping, at
/// `density` points per square metre of a plane: the unit of spacing everywhere.
pub fn largest_radius(density: f64) -> f64 {
    (1.0 / (2.0 * 3f64.sqrt() * density)).sqrt()
}

/// Spreads points over a mesh's visible surface: `density` per square metre and side, none in the
/// mask's holes, but at least one a side.
///
/// `metric` is the factor from rest space to metres along each axis. The same arguments give the
/// same points, on any number of threads.
///
/// # Errors
/// A density or metric that makes no sense, or more than [`MAX_POINTS`] points.
pub fn generate(
    mesh: &Mesh,
    metric: Vec3,
    density: f64,
    seed: u64,
) -> Result<PointSet, PointError> {
    generate_with(mesh, metric, density, None, None, seed)
}

/// As [`generate`]; with `factors` denser here than there, on which depends how many points there
/// are; with a `lattice` on its places where they can.
///
/// # Errors
/// As [`generate`].
pub fn generate_with(
    mesh: &Mesh,
    metric: Vec3,
    density: f64,
    factors: Option<&Density>,
    lattice: Option<&Lattice<'_>>,
    seed: u64,
) -> Result<PointSet, PointError> {
    if !(density.is_finite() && density > 0.0) {
        return Err(PointError::Density(density));
    }
    if !metric.is_finite() {
        return Err(PointError::Metric {
            mesh: mesh.name.clone(),
            metric,
        });
    }
    let areas = Areas::of(mesh, metric);
    let sides = if mesh.double_sided { 2 } else { 1 };
    let area_m2 = areas.total() * f64::from(sides);
    if area_m2 * density > MAX_POINTS as f64 {
        return Err(PointError::TooMany {
            mesh: mesh.name.clone(),
            area_m2,
            density,
        });
    }
    if area_m2 == 0.0 {
        return Ok(PointSet::default());
    }
    // A tiny mesh needs some candidates more, to find what the mask leaves of it.
    let most = if factors.is_some() { pilot::MOST } else { 1.0 };
    let per_side = CANDIDATES_PER_POINT * density * areas.total() * f64::from(most);
    let per_side = (per_side.round() as u32).max(64);
    let mut candidates = strew(mesh, &areas, sides, per_side, seed);
    let area_m2 = area_m2 * candidates.len() as f64 / f64::from(per_side * sides);
    let mut of_candidates = Vec::new();
    if let Some(factors) = factors {
        // Candidates lie as dense as points are to.
        let drawn = |(k, c): (usize, SurfacePoint)| {
            let factor = factors.at(mesh, &c);
            let chance = (scramble(seed ^ scramble(!(k as u64))) >> 40) as f32 / (1 << 24) as f32;
            (chance * most < factor).then_some((c, factor))
        };
        (candidates, of_candidates) = candidates
            .into_par_iter()
            .enumerate()
            .filter_map(drawn)
            .unzip();
    }
    let share = match factors {
        // What is left of them is CANDIDATES_PER_POINT times the points.
        Some(_) => candidates.len() as f64 / CANDIDATES_PER_POINT / density,
        None => area_m2,
    };
    let count = (share * density).round() as usize;
    if count <= sides as usize {
        let front = candidates.iter().find(|c| !c.back);
        let back = candidates.iter().find(|c| c.back);
        let points = front.into_iter().chain(back).copied().collect();
        return Ok(PointSet { points, area_m2 });
    }
    let strewn = candidates.len();
    let radius = largest_radius(density);
    cover(mesh, metric, radius, sides, count / 4, &mut candidates);
    if let Some(factors) = factors {
        let added = candidates[strewn..].iter().map(|c| factors.at(mesh, c));
        of_candidates.extend(added);
    }
    if let Some(lattice) = lattice {
        // Before elimination, which evens out what this does to their distances.
        let settle = |c: &mut SurfacePoint| *c = lattice.settle(*c);
        candidates.par_iter_mut().for_each(settle);
    }
    let mut samples = samples(mesh, metric, &candidates);
    for (sample, factor) in samples.iter_mut().zip(of_candidates) {
        sample.stretch = factor.sqrt();
    }
    let order = progressive_order(&samples, count, density);
    let points = order.into_iter().map(|i| candidates[i as usize]).collect();
    Ok(PointSet { points, area_m2 })
}

/// Indices of the `count` samples that spread best, and best in every prefix.
fn progressive_order(samples: &[Sample], count: usize, density: f64) -> Vec<u32> {
    let mut reach = 2.0 * largest_radius(density);
    let mut left = eliminate(samples, reach as f32, count).kept;
    let mut order = vec![0; left.len()];
    while left.len() > 1 {
        let keep = left.len() / 2;
        reach *= (left.len() as f64 / keep as f64).sqrt();
        let of_left: Vec<Sample> = left.iter().map(|&i| samples[i as usize]).collect();
        let step = eliminate(&of_left, reach as f32, keep);
        for (slot, &i) in order[keep..left.len()].iter_mut().rev().zip(&step.removed) {
            *slot = left[i as usize];
        }
        left = step.kept.iter().map(|&i| left[i as usize]).collect();
    }
    order[..left.len()].copy_from_slice(&left);
    order
}

/// The running sum of the triangles' areas in square metres; what is not finite counts as 0.
struct Areas(Vec<f64>);

impl Areas {
    fn of(mesh: &Mesh, metric: Vec3) -> Self {
        let mut sum = 0.0;
        let add = |triangle| {
            let area = 0.5 * area_vector(mesh, metric, triangle).length();
            sum += if area.is_finite() { area } else { 0.0 };
            sum
        };
        Self((0..mesh.triangles.len()).map(add).collect())
    }

    fn one(&self, triangle: usize) -> f64 {
        self.0[triangle]
            - if triangle > 0 {
                self.0[triangle - 1]
            } else {
                0.0
            }
    }

    fn total(&self) -> f64 {
        self.0.last().copied().unwrap_or(0.0)
    }
}

/// A vertex in metres.
fn in_metres(mesh: &Mesh, metric: Vec3, vertex: u32) -> DVec3 {
    mesh.positions[vertex as usize].as_dvec3() * metric.as_dvec3()
}

/// Twice the triangle's area along its normal. Thin triangles need `f64`.
fn area_vector(mesh: &Mesh, metric: Vec3, triangle: usize) -> DVec3 {
    let [p0, p1, p2] = mesh.triangles[triangle].map(|i| in_metres(mesh, metric, i));
    (p1 - p0).cross(p2 - p0)
}

/// Steps of the two-dimensional sequence of least discrepancy (1/g and 1/g² for g³ = g + 1), as
/// fractions of 2^64.
const SEQUENCE: [u64; 2] = [0xC13F_A9A9_02A6_328F, 0x91E1_0DA5_C79E_7B1D];

/// Strews `per_side` candidates over each side, evenly by area, and leaves those in holes out.
/// The k-th falls at random into the k-th of as many equal shares of the area, in the triangles'
/// order. Within triangles they follow a low-discrepancy sequence, less half of its regularity:
/// where all weights are alike, elimination thins one part of a surface more than the next.
fn strew(mesh: &Mesh, areas: &Areas, sides: u32, per_side: u32, seed: u64) -> Vec<SurfacePoint> {
    const RUN: u32 = 1 << 14;
    let share = areas.total() / f64::from(per_side);
    let random = |k: u64| (scramble(seed ^ scramble(k)) >> 11) as f64 / (1u64 << 53) as f64;
    let one = |k: u64| {
        let at = ((k % u64::from(per_side)) as f64 + random(3 * k)) * share;
        let triangle = areas
            .0
            .partition_point(|&sum| sum <= at)
            .min(areas.0.len() - 1);
        let spacing = (share / areas.one(triangle)).min(1.0).sqrt();
        let coordinate = |axis: u64| {
            let step = SEQUENCE[axis as usize];
            let place = k.wrapping_mul(step).wrapping_add(scramble(seed ^ step));
            let place = (place >> 11) as f64 / (1u64 << 53) as f64;
            let place = place + 0.5 * spacing * random(3 * k + 1 + axis);
            // 24 bits, so that every sum and difference below is exact.
            (place.fract() * f64::from(1 << 24)).floor() as f32 / (1 << 24) as f32
        };
        let (a, b) = (coordinate(0), coordinate(1));
        let (u, v) = if a + b > 1.0 {
            (1.0 - a, 1.0 - b)
        } else {
            (a, b)
        };
        SurfacePoint {
            triangle: triangle as u32,
            u,
            v,
            back: k >= u64::from(per_side),
        }
    };
    let count = per_side * sides;
    let runs: Vec<Vec<SurfacePoint>> = (0..count.div_ceil(RUN))
        .into_par_iter()
        .map(|r| {
            let run = r * RUN..((r + 1) * RUN).min(count);
            run.map(|k| one(u64::from(k)))
                .filter(|point| !in_hole(mesh, point))
                .collect()
        })
        .collect();
    runs.concat()
}

/// The mask has a hole there.
pub fn in_hole(mesh: &Mesh, point: &SurfacePoint) -> bool {
    let mask = mesh.mask.as_ref().filter(|_| !mesh.uvs.is_empty());
    mask.is_some_and(|mask| {
        let [t0, t1, t2] = mesh.triangles[point.triangle as usize].map(|i| mesh.uvs[i as usize]);
        mask.is_hole(t0 + point.u * (t1 - t0) + point.v * (t2 - t0))
    })
}

/// A well-mixed 64-bit value for each input (the finalizer of SplitMix64).
fn scramble(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Candidates as elimination needs them.
fn samples(mesh: &Mesh, metric: Vec3, candidates: &[SurfacePoint]) -> Vec<Sample> {
    let position = |c: &SurfacePoint| {
        let [p0, p1, p2] = mesh.triangles[c.triangle as usize].map(|i| in_metres(mesh, metric, i));
        p0 + f64::from(c.u) * (p1 - p0) + f64::from(c.v) * (p2 - p0)
    };
    let lowest = candidates
        .par_iter()
        .map(position)
        .reduce(|| DVec3::INFINITY, DVec3::min);
    candidates
        .par_iter()
        .map(|c| {
            let normal = area_vector(mesh, metric, c.triangle as usize).normalize_or_zero();
            let normal = if c.back { -normal } else { normal };
            Sample {
                position: (position(c) - lowest).as_vec3().to_array(),
                normal: (normal * 127.0).round().to_array().map(|n| n as i8),
                stretch: 1.0,
            }
        })
        .collect()
}

/// The order of `positions` along a Morton curve of 21 bits an axis through the cube that starts
/// at `bounds[0]` and reaches as far as `bounds[1]` along the widest axis, so that its cells are
/// cubes. What lies outside counts as on the border; equal keys stay in the order given.
pub fn morton_order(positions: &[Vec3], bounds: [Vec3; 2]) -> Vec<u32> {
    const LAST: u64 = (1 << 21) - 1;
    let widest = (bounds[1].as_dvec3() - bounds[0].as_dvec3()).max_element();
    let scale = if widest > 0.0 {
        LAST as f64 / widest
    } else {
        0.0
    };
    let mut keys: Vec<(u64, u32)> = positions
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            let cell = (p.as_dvec3() - bounds[0].as_dvec3()) * scale;
            // Saturating casts: NaN counts as 0.
            let [x, y, z] = cell.to_array().map(|c| spread((c as u64).min(LAST)));
            (x | y << 1 | z << 2, i as u32)
        })
        .collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, i)| i).collect()
}

/// Puts two zeros between each of the lowest 21 bits.
fn spread(mut x: u64) -> u64 {
    x = (x | x << 32) & 0x001F_0000_0000_FFFF;
    x = (x | x << 16) & 0x001F_0000_FF00_00FF;
    x = (x | x << 8) & 0x100F_00F0_0F00_F00F;
    x = (x | x << 4) & 0x10C3_0C30_C30C_30C3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Mask, Wrap};
    use glam::Vec2;
    use rayon::ThreadPoolBuilder;

    fn plane(side: f32) -> Mesh {
        let corner = |x, y| Vec3::new(x, y, 0.0) * side;
        Mesh {
            name: "plane".into(),
            positions: vec![
                corner(0., 0.),
                corner(1., 0.),
                corner(1., 1.),
                corner(0., 1.),
            ],
            normals: vec![Vec3::Z; 4],
            uvs: vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        }
    }

    /// A sphere of radius 1 m, `2 * rings * rings` quads.
    fn sphere(rings: u32) -> Mesh {
        let mut mesh = Mesh {
            name: "sphere".into(),
            ..Mesh::default()
        };
        let turn = 2 * rings;
        for i in 0..=rings {
            for j in 0..=turn {
                let (sin, cos) = (std::f32::consts::PI * i as f32 / rings as f32).sin_cos();
                let (s, c) = (std::f32::consts::TAU * j as f32 / turn as f32).sin_cos();
                mesh.positions.push(Vec3::new(c * sin, s * sin, cos));
            }
        }
        for i in 0..rings {
            for j in 0..turn {
                let a = i * (turn + 1) + j;
                let b = a + turn + 1;
                mesh.triangles.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
            }
        }
        mesh.normals = mesh.positions.clone();
        mesh
    }

    fn positions(mesh: &Mesh, points: &[SurfacePoint]) -> Vec<Vec3> {
        points
            .iter()
            .map(|p| p.position(&mesh.triangles, &mesh.positions))
            .collect()
    }

    /// The distance from each to its nearest neighbour over `unit`, ascending.
    fn nearest(positions: &[Vec3], unit: f64) -> Vec<f64> {
        let cell = |p: &Vec3| (p.as_dvec3() / (2.0 * unit)).floor().as_i64vec3();
        let mut grid = std::collections::HashMap::<_, Vec<Vec3>>::new();
        for p in positions {
            grid.entry(cell(p)).or_default().push(*p);
        }
        let offsets = || (0..125).map(|k| glam::I64Vec3::new(k % 5, k / 5 % 5, k / 25) - 2);
        let one = |p: &Vec3| {
            let near = offsets().filter_map(|o| grid.get(&(cell(p) + o))).flatten();
            let d2 = near.map(|q| q.distance_squared(*p)).filter(|&d2| d2 > 0.0);
            f64::from(d2.fold(f32::INFINITY, f32::min).sqrt()) / unit
        };
        let mut all: Vec<f64> = positions.iter().map(one).collect();
        all.sort_by(f64::total_cmp);
        all
    }

    #[test]
    fn every_prefix_is_well_spread() {
        for (mesh, density) in [(plane(5.0), 1024.0), (sphere(60), 2048.0)] {
            let set = generate(&mesh, Vec3::ONE, density, 1).unwrap();
            let all = positions(&mesh, &set.points);
            for part in [1, 2, 3, 4, 16, 64] {
                let prefix = &all[..all.len() / part];
                let unit = largest_radius(prefix.len() as f64 / set.area_m2);
                let spread = nearest(prefix, unit);
                let mean = spread.iter().sum::<f64>() / spread.len() as f64;
                assert!(
                    spread[0] > 1.0,
                    "{} 1/{part}: least {}",
                    mesh.name,
                    spread[0]
                );
                assert!(mean > 1.4, "{} 1/{part}: mean {mean}", mesh.name);
            }
        }
    }

    #[test]
    fn density_is_what_was_asked_for_at_any_scale() {
        for scale in [1e-4f32, 1.0, 1e4] {
            for density in [1.0_f64, 512.0, 100_000.0] {
                // Always 3000 points' worth.
                let side = (3000.0 / density).sqrt();
                let mesh = plane((side / f64::from(scale)) as f32);
                let set = generate(&mesh, Vec3::splat(scale), density, 3).unwrap();
                assert!((set.area_m2 / (side * side) - 1.0).abs() < 1e-5);
                assert_eq!(set.points.len(), 3000, "scale {scale} density {density}");
                let metres: Vec<Vec3> = positions(&mesh, &set.points)
                    .iter()
                    .map(|&p| p * scale)
                    .collect();
                assert!(nearest(&metres, largest_radius(density))[0] > 1.0);
            }
        }
    }

    #[test]
    fn an_uneven_metric_spreads_points_evenly_in_metres() {
        let mesh = plane(1.0);
        let metric = Vec3::new(10.0, 0.5, 3.0);
        let set = generate(&mesh, metric, 600.0, 3).unwrap();
        assert_eq!(set.points.len(), 3000);
        let metres: Vec<Vec3> = positions(&mesh, &set.points)
            .iter()
            .map(|&p| p * metric)
            .collect();
        assert!(nearest(&metres, largest_radius(600.0))[0] > 1.0);
    }

    #[test]
    fn both_sides_of_a_double_sided_sheet_are_covered_evenly() {
        let mesh = Mesh {
            double_sided: true,
            ..plane(3.0)
        };
        let set = generate(&mesh, Vec3::ONE, 512.0, 1).unwrap();
        assert_eq!(set.points.len(), 9216);
        assert!((set.area_m2 - 18.0).abs() < 1e-5);
        for back in [false, true] {
            let side: Vec<_> = set
                .points
                .iter()
                .filter(|p| p.back == back)
                .copied()
                .collect();
            assert!(
                (side.len() as f64 / 4608.0 - 1.0).abs() < 0.01,
                "{}",
                side.len()
            );
            assert!(nearest(&positions(&mesh, &side), largest_radius(512.0))[0] > 1.0);
            let expected = if back { -Vec3::Z } else { Vec3::Z };
            let (triangles, at) = (&mesh.triangles, &mesh.positions);
            assert_eq!(side[0].normal(triangles, at, &mesh.normals), expected);
            assert_eq!(side[0].geometric_normal(triangles, at), expected);
        }
        let single = generate(&plane(3.0), Vec3::ONE, 512.0, 1).unwrap();
        assert!(single.points.iter().all(|p| !p.back));
    }

    #[test]
    fn no_point_lies_in_a_hole() {
        // A checkerboard of 4 x 4 texels, repeated: half of it is holes.
        let alpha = (0..16)
            .map(|i| if (i % 4 + i / 4) % 2 == 0 { 255 } else { 100 })
            .collect();
        let wrap = [Wrap::Repeat, Wrap::Mirror];
        let mask = Mask {
            width: 4,
            height: 4,
            alpha,
            cutoff: 0.5,
            wrap,
        };
        let mut mesh = Mesh {
            mask: Some(mask),
            ..plane(4.0)
        };
        mesh.uvs = mesh.positions.iter().map(|p| p.truncate() - 2.0).collect();
        let set = generate(&mesh, Vec3::ONE, 1024.0, 1).unwrap();
        assert!((set.area_m2 / 8.0 - 1.0).abs() < 0.01, "{}", set.area_m2);
        assert!((set.points.len() as f64 / 8192.0 - 1.0).abs() < 0.01);
        for p in positions(&mesh, &set.points) {
            let texel = |x: f32| (x * 4.0).floor() as i32;
            let mirrored = ((p.y - 2.0).rem_euclid(2.0) - 1.0).abs();
            let row = texel(1.0 - mirrored);
            assert_eq!((texel(p.x.rem_euclid(1.0)) + row) % 2, 0, "{p}");
        }
        mesh.mask.as_mut().unwrap().alpha.fill(0);
        assert_eq!(
            generate(&mesh, Vec3::ONE, 1024.0, 1),
            Ok(PointSet::default())
        );
    }

    #[test]
    fn the_same_seed_gives_the_same_points_on_any_number_of_threads() {
        let mesh = Mesh {
            double_sided: true,
            ..sphere(30)
        };
        let on = |threads, seed| {
            let pool = ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| generate(&mesh, Vec3::ONE, 2048.0, seed).unwrap())
        };
        let one = on(1, 7);
        for _ in 0..5 {
            assert!(one == on(2, 7));
        }
        assert!(one == on(5, 7));
        assert!(one != on(1, 8));
    }

    #[test]
    fn a_tiny_mesh_gets_one_point_a_side() {
        for sides in [1, 2] {
            let mesh = Mesh {
                double_sided: sides == 2,
                ..plane(0.001)
            };
            let set = generate(&mesh, Vec3::ONE, 1.0, 1).unwrap();
            assert_eq!(set.points.len(), sides);
            assert_eq!(set.points.iter().filter(|p| p.back).count(), sides - 1);
        }
    }

    #[test]
    fn triangles_without_area_get_nothing_and_needles_their_share() {
        let mut mesh = plane(1.0);
        mesh.positions
            .extend([Vec3::NAN, Vec3::new(f32::INFINITY, 1.0, 2.0)]);
        mesh.positions.extend([
            Vec3::ZERO,
            Vec3::new(1e3, 0.0, 9.0),
            Vec3::new(0.0, 1e-3, 0.0),
        ]);
        mesh.normals = vec![Vec3::Z; 9];
        mesh.triangles = vec![[0, 0, 1], [0, 1, 4], [1, 2, 5], [6, 7, 8], [3, 3, 3]];
        let set = generate(&mesh, Vec3::ONE, 1000.0, 1).unwrap();
        assert_eq!(set.points.len(), 500);
        assert!(set.points.iter().all(|p| p.triangle == 3));
        mesh.triangles.remove(3);
        assert_eq!(
            generate(&mesh, Vec3::ONE, 1000.0, 1),
            Ok(PointSet::default())
        );
        mesh.triangles.clear();
        assert_eq!(
            generate(&mesh, Vec3::ONE, 1000.0, 1),
            Ok(PointSet::default())
        );
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_a_remedy() {
        let says = |metric, density, part: &str| {
            let error = generate(&plane(1000.0), metric, density, 1)
                .unwrap_err()
                .to_string();
            assert!(error.contains(part), "{error}");
        };
        for density in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            says(Vec3::ONE, density, "--density");
        }
        says(
            Vec3::new(1.0, f32::NAN, 1.0),
            512.0,
            "\"plane\" is scaled by",
        );
        says(
            Vec3::ONE,
            512.0,
            "mesh \"plane\" has 1.0000e6 square metres; at 512 points",
        );
        says(Vec3::splat(1e30), 1.0, "--unit");
    }

    #[test]
    fn a_point_follows_its_triangle() {
        let at = [
            Vec3::ZERO,
            Vec3::new(2.0, 0.0, 0.0),
            Vec3::new(0.0, 4.0, 0.0),
        ];
        let point = SurfacePoint {
            triangle: 0,
            u: 0.25,
            v: 0.5,
            back: false,
        };
        assert_eq!(point.position(&[[0, 1, 2]], &at), Vec3::new(0.5, 2.0, 0.0));
        assert_eq!(point.tangent(&[[0, 1, 2]], &at), Vec3::X);
        let normals = [Vec3::X, Vec3::Z, Vec3::Z];
        let normal = point.normal(&[[0, 1, 2]], &at, &normals);
        assert!(normal.distance(Vec3::new(1.0, 0.0, 3.0).normalize()) < 1e-6);
        let cancel = [Vec3::Z, Vec3::Z, -Vec3::Z];
        let back = SurfacePoint {
            back: true,
            ..point
        };
        assert_eq!(back.normal(&[[0, 1, 2]], &at, &cancel), -Vec3::Z);
    }

    #[test]
    fn morton_order_interleaves_the_axes_and_is_stable() {
        let unit = |k: u64| (scramble(k) >> 40) as f32 / (1 << 24) as f32;
        let bounds = [Vec3::splat(-5.0), Vec3::new(5.0, -2.0, 0.0)];
        let mut positions: Vec<Vec3> = (0..999)
            .map(|k| Vec3::new(unit(3 * k), unit(3 * k + 1), unit(3 * k + 2)) * 12.0 - 6.0)
            .collect();
        positions.extend([positions[5], positions[5], Vec3::NAN]);
        let key = |p: Vec3| {
            let cell = p.to_array().map(|c| {
                ((f64::from(c) + 5.0) / 10.0 * 2_097_151.0).clamp(0.0, 2_097_151.0) as u64
            });
            (0..63)
                .map(|bit| (cell[bit % 3] >> (bit / 3) & 1) << bit)
                .sum::<u64>()
        };
        let mut expected: Vec<u32> = (0..positions.len() as u32).collect();
        expected.sort_by_key(|&i| key(positions[i as usize]));
        assert_eq!(morton_order(&positions, bounds), expected);
        assert_eq!(morton_order(&[Vec3::ONE; 3], [Vec3::ONE; 2]), [0, 1, 2]);
    }
}
