//! Lookups that the stream has not got: grids with cells of any capacity and size, and kernels
//! that are tried against those of the core on the same points.

use crate::truth::{Placement, buckets_for, choose_buckets, fit};
use glam::Vec3;
use psao_core::lookup::{BEYOND, CORE, FADE, FLATNESS, REACH, SEEN, T_D, T_N, UNSEEN};
use psao_core::point::{NORMALS, decode_position};
use psao_core::{Bucket, Instance, Lookup, Point};
use rayon::prelude::*;
use std::collections::HashMap;

/// A point where a client has it, as it was traced.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// In the space of its instance's grid.
    pub position: Vec3,
    /// Unit normal in that space.
    pub normal: Vec3,
    /// 255 is open, 0 fully occluded.
    pub occlusion: u8,
    /// Highest level of detail that has it.
    pub level: u8,
}

/// The points of an instance.
#[derive(Clone, Debug)]
pub struct Samples {
    /// Instance index.
    pub instance: u32,
    /// Metres a unit of the grid's space, an axis.
    pub scale: Vec3,
    /// What its grid is around, in that space.
    pub bounds: [Vec3; 2],
    /// In the order in which they go into cells.
    pub points: Vec<Sample>,
}

/// A cell of `N` places: 32 bytes for 7, 64 for 15.
#[repr(C, align(32))]
#[derive(Clone, Copy, Debug)]
struct Cell<const N: usize> {
    key: u32,
    points: [Point; N],
}

/// Buffers as a client's, but for the capacity of cells.
#[derive(Clone, Debug)]
pub struct Grids<const N: usize> {
    instances: Vec<Instance>,
    buckets: Vec<Bucket>,
    cells: Vec<Cell<N>>,
    /// Points that found no room.
    pub discarded: usize,
    /// Points in all.
    pub points: usize,
}

/// What the core's lookup reads.
#[derive(Clone, Debug)]
pub struct ClientBuffers {
    instances: Vec<Instance>,
    buckets: Vec<Bucket>,
    cells: Vec<psao_core::Cell>,
}

impl ClientBuffers {
    /// The core's lookup.
    pub fn lookup(&self) -> Lookup<'_> {
        Lookup {
            instances: &self.instances,
            buckets: &self.buckets,
            cells: &self.cells,
        }
    }
}

impl<const N: usize> Grids<N> {
    /// Puts points into cells of `cell_m` metres, `capacity` at most; first come, first served.
    pub fn new(
        instances: usize,
        sets: &[Samples],
        cell_m: f32,
        cell_over_radius: f32,
        capacity: usize,
    ) -> Grids<N> {
        let mut grids = Grids {
            instances: vec![Instance::default(); instances],
            buckets: Vec::new(),
            cells: vec![Cell {
                key: 0,
                points: [Point::EMPTY; N],
            }],
            discarded: 0,
            points: 0,
        };
        let filled: Vec<_> = sets
            .par_iter()
            .filter_map(|set| fill::<N>(set, cell_m, cell_over_radius, capacity.min(N)))
            .collect();
        for (set, filled) in sets.iter().zip(&filled) {
            grids.points += set.points.len();
            let mut grid = filled.grid;
            grid.bucket_first = grids.buckets.len() as u32;
            let last = grids.buckets.len() + grid.bucket_count as usize;
            grids.buckets.resize(last, Bucket::default());
            grids.instances[set.instance as usize] = grid;
            grids.discarded += filled.discarded;
            for (at, cell) in &filled.cells {
                let bucket = &mut grids.buckets[grid.bucket(*at) as usize];
                match bucket.entries.iter_mut().find(|entry| **entry == 0) {
                    Some(entry) => {
                        *entry = grids.cells.len() as u32;
                        grids.cells.push(*cell);
                    }
                    None => {
                        grids.discarded += cell.points.iter().filter(|p| p.is_allocated()).count()
                    }
                }
            }
        }
        grids
    }

    /// Blends the points around a fragment; see [`psao_core::Lookup::blend`].
    pub fn blend<K: Weigh>(&self, instance: u32, position: Vec3, normal: Vec3) -> Blended {
        let grid = &self.instances[instance as usize];
        let g = grid.to_cells(position.to_array());
        let normal = (normal * Vec3::from(grid.normal_scale)).normalize_or_zero();
        let (mut base, mut place) = ([0i32; 3], Vec3::ZERO);
        for axis in 0..3 {
            if grid.bucket_count == 0
                || !(g[axis] >= -0.5 && g[axis] < grid.dims[axis] as f32 + 0.5)
            {
                return Blended::default();
            }
            let lower = (g[axis] - 0.5).floor();
            base[axis] = lower as i32;
            place[axis] = g[axis] - lower;
        }
        let mut kernel = K::new(grid.radius, normal, place);
        let mut fetched = 0;
        // As the core goes about it, so that times compare.
        let [x, y, z] = base.map(|lower| lower as u32);
        for row in 0..4 {
            let (up_y, up_z) = (row & 1, row >> 1);
            let lower = [x, y.wrapping_add(up_y), z.wrapping_add(up_z)];
            if lower[1] >= grid.dims[1] || lower[2] >= grid.dims[2] {
                continue;
            }
            let key = grid.key(lower);
            let [bucket, next] = grid.bucket_pair(lower);
            for up_x in 0..2 {
                if x.wrapping_add(up_x) >= grid.dims[0] {
                    continue;
                }
                let bucket = if up_x == 0 { bucket } else { next };
                let Some(found) = self.named(bucket, key.wrapping_add(up_x)) else {
                    continue;
                };
                kernel.enter((up_x + 2 * row) as usize);
                let from = Vec3::new(up_x as f32, up_y as f32, up_z as f32) - place;
                for point in &found.points {
                    if !point.is_allocated() {
                        break;
                    }
                    let step = point.position().map(decode_position);
                    let point_normal = Vec3::from(NORMALS[point.normal() as usize]);
                    let openness = f32::from(point.occlusion()) * (1.0 / 255.0);
                    kernel.add(from + Vec3::from(step), point_normal, openness);
                    fetched += 1;
                }
            }
        }
        Blended {
            fetched,
            ..kernel.answer()
        }
    }

    #[inline(always)]
    fn named(&self, bucket: u32, key: u32) -> Option<&Cell<N>> {
        for &entry in &self.buckets[bucket as usize].entries {
            if entry == 0 {
                break;
            }
            let cell = &self.cells[entry as usize];
            if cell.key == key {
                return Some(cell);
            }
        }
        None
    }

    /// The same buffers as clients have them, if their cells have as much room.
    pub fn of_client(&self) -> Option<ClientBuffers> {
        let cells = self.cells.iter().map(|cell| {
            Some(psao_core::Cell {
                key: cell.key,
                points: cell.points.as_slice().try_into().ok()?,
            })
        });
        Some(ClientBuffers {
            instances: self.instances.clone(),
            buckets: self.buckets.clone(),
            cells: cells.collect::<Option<_>>()?,
        })
    }

    /// Where a fragment is in its grid, in cells, and what a cell is in the grid's space.
    pub fn in_cells(&self, instance: u32, position: Vec3) -> Option<(Vec3, Vec3)> {
        let grid = &self.instances[instance as usize];
        let size = 1.0 / Vec3::from(grid.cells_per_unit);
        (grid.bucket_count > 0).then(|| (grid.to_cells(position.to_array()).into(), size))
    }
}

struct Filled<const N: usize> {
    grid: Instance,
    cells: Vec<([u32; 3], Cell<N>)>,
    discarded: usize,
}

fn fill<const N: usize>(
    set: &Samples,
    cell_m: f32,
    cell_over_radius: f32,
    capacity: usize,
) -> Option<Filled<N>> {
    let mut grid = fit(set.bounds, set.scale, cell_m, 1.0 / cell_over_radius)?;
    let mut index: HashMap<[u32; 3], usize> = HashMap::new();
    let mut cells: Vec<([u32; 3], Cell<N>)> = Vec::new();
    let mut discarded = 0;
    // The server drops the last of the progressive order where a cell overflows.
    let mut order: Vec<usize> = (0..set.points.len()).collect();
    let mixed = |i: usize| (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    order.sort_by_key(|&i| (std::cmp::Reverse(set.points[i].level), mixed(i)));
    for point in order.iter().map(|&i| &set.points[i]) {
        let Some(at) = Placement::of(&grid, point.position, point.normal) else {
            discarded += 1;
            continue;
        };
        let number = *index.entry(at.cell).or_insert_with(|| {
            let points = [Point::EMPTY; N];
            cells.push((at.cell, Cell { key: 0, points }));
            cells.len() - 1
        });
        let places = &mut cells[number].1.points[..capacity];
        match places.iter_mut().find(|place| !place.is_allocated()) {
            Some(place) => *place = Point::pack(at.position, at.normal, point.occlusion),
            None => discarded += 1,
        }
    }
    let all: Vec<[u32; 3]> = cells.iter().map(|(at, _)| *at).collect();
    grid.bucket_count = choose_buckets(&grid, &all, buckets_for(all.len()));
    cells
        .iter_mut()
        .for_each(|(at, cell)| cell.key = grid.key(*at));
    Some(Filled {
        grid,
        cells,
        discarded,
    })
}

/// What a lookup found.
#[derive(Clone, Copy, Debug)]
pub struct Blended {
    /// 1 is open.
    pub openness: f32,
    /// No point counted.
    pub hole: bool,
    /// Points read.
    pub fetched: u32,
}

impl Default for Blended {
    fn default() -> Blended {
        Blended {
            openness: 1.0,
            hole: true,
            fetched: 0,
        }
    }
}

/// A kernel: lengths are in cells.
pub trait Weigh {
    /// `place`: where the fragment is in its block, 0.5 to 1.5 an axis.
    fn new(radius: f32, normal: Vec3, place: Vec3) -> Self;
    /// The points that come are of the block's `corner`: its bits are x, y and z.
    fn enter(&mut self, corner: usize);
    /// A point at `d` from the fragment.
    fn add(&mut self, d: Vec3, point_normal: Vec3, openness: f32);
    /// What it comes to; `fetched` is not its own.
    fn answer(&self) -> Blended;
}

/// The weighted mean that most kernels are, with the nearest point to fall back on.
pub struct Mean<F> {
    formula: F,
    weight: f32,
    sum: f32,
    nearest: f32,
    nearest_squared: f32,
}

/// A formula for a point's weight.
pub trait Formula {
    /// Where no weight is above 0, the nearest point counts; else the answer is 1.
    const NEAREST: bool;
    /// As [`Weigh::new`].
    fn new(radius: f32, normal: Vec3, place: Vec3) -> Self;
    /// As [`Weigh::enter`].
    fn enter(&mut self, _corner: usize) {}
    /// A point's weight.
    fn weight(&self, d: Vec3, squared: f32, point_normal: Vec3, openness: f32) -> f32;
}

impl<F: Formula> Weigh for Mean<F> {
    fn new(radius: f32, normal: Vec3, place: Vec3) -> Self {
        Mean {
            formula: F::new(radius, normal, place),
            weight: 0.0,
            sum: 0.0,
            nearest: 1.0,
            nearest_squared: f32::INFINITY,
        }
    }

    fn enter(&mut self, corner: usize) {
        self.formula.enter(corner);
    }

    fn add(&mut self, d: Vec3, point_normal: Vec3, openness: f32) {
        let squared = d.length_squared();
        if F::NEAREST && squared < self.nearest_squared {
            self.nearest_squared = squared;
            self.nearest = openness;
        }
        let weight = self.formula.weight(d, squared, point_normal, openness);
        self.weight += weight;
        self.sum += weight * openness;
    }

    fn answer(&self) -> Blended {
        let hole = self.weight <= 0.0;
        let openness = match hole {
            false => (self.sum / self.weight).min(1.0),
            true if F::NEAREST => self.nearest,
            true => 1.0,
        };
        Blended {
            openness,
            hole,
            fetched: 0,
        }
    }
}

/// The paper's, Eq. 2 to 4.
pub struct Paper<const NEAREST: bool> {
    radius: f32,
    normal: Vec3,
}

impl<const NEAREST: bool> Formula for Paper<NEAREST> {
    const NEAREST: bool = NEAREST;

    fn new(radius: f32, normal: Vec3, _: Vec3) -> Self {
        Paper { radius, normal }
    }

    fn weight(&self, d: Vec3, squared: f32, point_normal: Vec3, _: f32) -> f32 {
        let along = point_normal.dot(d);
        if point_normal.dot(self.normal) <= T_N || along * along >= T_D * squared && squared > 0.0 {
            return 0.0;
        }
        ((self.radius - squared.sqrt()) / self.radius).max(0.0)
    }
}

/// What `planar` was: a band of 0.3 radii around the plane, points within the radius alone.
pub struct Band {
    normal: Vec3,
    inverse_radius_squared: f32,
}

impl Formula for Band {
    const NEAREST: bool = true;

    fn new(radius: f32, normal: Vec3, _: Vec3) -> Self {
        Band {
            normal,
            inverse_radius_squared: 1.0 / (radius * radius),
        }
    }

    fn weight(&self, d: Vec3, squared: f32, point_normal: Vec3, _: f32) -> f32 {
        let agree = point_normal.dot(self.normal);
        if agree <= T_N {
            return 0.0;
        }
        let h = self.normal.dot(d).abs().max(point_normal.dot(d).abs());
        let near = (1.0 - squared * self.inverse_radius_squared).max(0.0);
        let flat = (1.0 - h * h * self.inverse_radius_squared / 0.09).max(0.0);
        near * flat * agree.powi(8)
    }
}

/// The core's planar kernel, or what is left of it without fading cells, or with dark points
/// counting as others do.
pub struct Planar<const FADES: bool, const HIDES: bool> {
    normal: Vec3,
    inverse_radius_squared: f32,
    sides: [[f32; 2]; 3],
    side: f32,
}

impl<const FADES: bool, const HIDES: bool> Formula for Planar<FADES, HIDES> {
    const NEAREST: bool = false;

    fn new(radius: f32, normal: Vec3, place: Vec3) -> Self {
        let left = |at: f32| [1.5 - at, at - 0.5].map(|left| (left / FADE).clamp(0.0, 1.0));
        Planar {
            normal,
            inverse_radius_squared: 1.0 / (radius * radius),
            sides: place.to_array().map(left),
            side: 1.0,
        }
    }

    fn enter(&mut self, corner: usize) {
        if FADES {
            let [x, y, z] = self.sides;
            self.side = x[corner & 1] * y[corner >> 1 & 1] * z[corner >> 2];
        }
    }

    fn weight(&self, d: Vec3, squared: f32, point_normal: Vec3, openness: f32) -> f32 {
        let agree = point_normal.dot(self.normal).max(T_N);
        let h = self.normal.dot(d).abs().max(point_normal.dot(d).abs());
        let far = CORE + (squared + FLATNESS * (h * h)) * self.inverse_radius_squared;
        let in_reach = (1.0 - squared * self.inverse_radius_squared * (1.0 / REACH)).max(BEYOND);
        let seen = if HIDES {
            (openness * (1.0 / SEEN)).min(1.0).powi(2) + UNSEEN
        } else {
            1.0
        };
        let agree2 = agree * agree;
        let agree4 = agree2 * agree2;
        self.side * seen * in_reach * agree4 * agree4 / (far * far)
    }
}

/// Moving least squares in the tangent plane: a plane through the points' values, held back by a
/// ridge and kept within the range of what it blends.
pub struct LeastSquares {
    formula: Planar<true, true>,
    axes: [Vec3; 2],
    radius: f32,
    weight: f32,
    /// Sums of u, v, uu, uv, vv, o, uo, vo.
    sums: [f32; 8],
    range: [f32; 2],
}

impl Weigh for LeastSquares {
    fn new(radius: f32, normal: Vec3, place: Vec3) -> Self {
        let (u, v) = if normal == Vec3::ZERO {
            (Vec3::X, Vec3::Y)
        } else {
            normal.any_orthonormal_pair()
        };
        LeastSquares {
            formula: Planar::new(radius, normal, place),
            axes: [u, v],
            radius,
            weight: 0.0,
            sums: [0.0; 8],
            range: [1.0, 0.0],
        }
    }

    fn enter(&mut self, corner: usize) {
        self.formula.enter(corner);
    }

    fn add(&mut self, d: Vec3, point_normal: Vec3, o: f32) {
        let w = self.formula.weight(d, d.length_squared(), point_normal, o);
        let [u, v] = self.axes.map(|axis| axis.dot(d));
        self.weight += w;
        let terms = [u, v, u * u, u * v, v * v, o, u * o, v * o];
        self.sums
            .iter_mut()
            .zip(terms)
            .for_each(|(sum, t)| *sum += w * t);
        self.range = [self.range[0].min(o), self.range[1].max(o)];
    }

    fn answer(&self) -> Blended {
        if self.weight <= 0.0 {
            return Blended::default();
        }
        let [u, v, uu, uv, vv, o, uo, vo] = self.sums.map(|sum| sum / self.weight);
        let ridge = 0.03 * self.radius * self.radius;
        let (a, b, c) = (uu - u * u + ridge, uv - u * v, vv - v * v + ridge);
        let (p, q) = (uo - u * o, vo - v * o);
        let det = a * c - b * b;
        let (su, sv) = ((p * c - q * b) / det, (q * a - p * b) / det);
        Blended {
            openness: (o - su * u - sv * v).clamp(self.range[0], self.range[1]),
            hole: false,
            fetched: 0,
        }
    }
}

/// Finds out alone whether any point faces the fragment's way.
pub struct Facing {
    normal: Vec3,
    any: bool,
}

impl Weigh for Facing {
    fn new(_: f32, normal: Vec3, _: Vec3) -> Self {
        Facing { normal, any: false }
    }

    fn enter(&mut self, _: usize) {}

    fn add(&mut self, _: Vec3, point_normal: Vec3, _: f32) {
        self.any |= point_normal.dot(self.normal) > T_N;
    }

    fn answer(&self) -> Blended {
        Blended {
            hole: !self.any,
            ..Blended::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use psao_core::Kernel;

    #[test]
    fn kernels_of_the_core_answer_here_as_they_do_there() {
        let mut random = 1u64;
        let mut next = || {
            random = random
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (random >> 40) as f32 / (1 << 24) as f32
        };
        let point = |at: [f32; 4]| Sample {
            position: Vec3::new(at[0], at[1] * 0.1, at[2]),
            normal: Vec3::new(0.2 - at[3], 1.0, at[0]).normalize(),
            occlusion: (at[3] * 255.0) as u8,
            level: 0,
        };
        let points = (0..2000)
            .map(|_| point(std::array::from_fn(|_| next())))
            .collect();
        let set = Samples {
            instance: 0,
            scale: Vec3::ONE,
            bounds: [Vec3::ZERO, Vec3::ONE],
            points,
        };
        let grids = Grids::<7>::new(1, &[set], 0.07, 1.25, 7);
        assert!(grids.discarded > 0 && grids.cells.len() > 100);
        let buffers = grids.of_client().unwrap();
        let lookup = buffers.lookup();
        for _ in 0..2000 {
            let at = Vec3::new(next(), next() * 0.1, next());
            let normal = Vec3::new(next() - 0.5, 1.0, next());
            let core = |kernel| lookup.blend(kernel, 0, at.to_array(), normal.to_array());
            let pairs = [
                (
                    core(Kernel::Paper),
                    grids.blend::<Mean<Paper<false>>>(0, at, normal),
                ),
                (
                    core(Kernel::Planar),
                    grids.blend::<Mean<Planar<true, true>>>(0, at, normal),
                ),
            ];
            for (core, here) in pairs {
                assert_eq!(core.fetched, here.fetched);
                assert!(
                    (core.openness - here.openness).abs() < 1e-4,
                    "{core:?} {here:?}"
                );
            }
        }
    }
}
