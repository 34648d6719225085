//! Where points are worth the most: a few rays from a few places tell how fast occlusion changes
//! over each surface, and points lie the denser the faster it does.
//!
//! What a blend is off by grows with the change between neighbouring points, so the same number of
//! points does more where occlusion has an edge than where it is even. The radius stays the same
//! everywhere, so densities are held within what it can bridge and what cells have room for.

use super::{Areas, SurfacePoint, scramble, strew};
use crate::scene::Mesh;
use glam::{IVec3, Mat3, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;

/// Rays of a place.
pub const PILOT_RAYS: usize = 16;

/// Places for each point to come.
const PLACES_PER_POINT: f64 = 1.0;

/// The densest that points may lie, over the mean.
pub(super) const MOST: f32 = 3.0;

/// The least dense: any less, and blocks of cells without a point are common.
const LEAST: f32 = 0.7;

/// Fits reach this many spacings of the places: some fifteen of them on a plane.
const REACH: f32 = 2.25;

/// The part of independent rays' variance that is left of stratified ones.
const NOISE: f32 = 0.3;

/// The places on a mesh at which occlusion is tried.
#[derive(Clone, Debug, Default)]
pub struct Pilot {
    /// The places, evenly spread.
    pub places: Vec<SurfacePoint>,
    /// Metres that a fit reaches.
    reach: f32,
    positions: Vec<Vec3>,
    /// Of each place, those within reach that face the same way.
    near: Vec<Vec<u32>>,
    /// Change of openness a metre, summed over the poses.
    change: Vec<f32>,
    metric: Vec3,
}

impl Pilot {
    /// Chooses places on a mesh; arguments are those of [`super::generate`], and places that it
    /// would refuse are none.
    pub fn new(mesh: &Mesh, metric: Vec3, density: f64, seed: u64) -> Pilot {
        let areas = Areas::of(mesh, metric);
        let sides = if mesh.double_sided { 2 } else { 1 };
        let density = density * PLACES_PER_POINT;
        let per_side = areas.total() * density;
        if !(per_side >= 1.0 && per_side * f64::from(sides) < super::MAX_POINTS as f64) {
            return Pilot::default();
        }
        let places = strew(mesh, &areas, sides, per_side as u32, scramble(seed));
        let position = |place: &SurfacePoint| {
            let at = place.position(&mesh.triangles, &mesh.positions);
            at * metric
        };
        let positions: Vec<Vec3> = places.par_iter().map(position).collect();
        let normals: Vec<Vec3> = places
            .par_iter()
            .map(|p| p.geometric_normal(&mesh.triangles, &mesh.positions) / metric)
            .map(Vec3::normalize_or_zero)
            .collect();
        let reach = REACH * (1.0 / density).sqrt() as f32;
        let near = neighbours(&positions, &normals, reach);
        Pilot {
            reach,
            near,
            change: vec![0.0; places.len()],
            places,
            positions,
            metric,
        }
    }

    /// Notes how fast openness (of each place, 0 to 1) changes around each place in one pose, which
    /// counts as the part `share` of all.
    pub fn add(&mut self, openness: &[f32], share: f32) {
        let positions = &self.positions;
        let (near, reach) = (&self.near, self.reach);
        self.change
            .par_iter_mut()
            .zip(near)
            .enumerate()
            .for_each(|(i, (change, near))| {
                *change += share * slope(positions, openness, i as u32, near, reach);
            });
    }

    /// Which side a place is on: places of one box that face differently do not mix.
    fn side(&self, mesh: &Mesh, place: &SurfacePoint) -> u8 {
        side_of(place.geometric_normal(&mesh.triangles, &mesh.positions) / self.metric)
    }
}

/// For each place those within `reach` that face the same way, itself among them.
fn neighbours(positions: &[Vec3], normals: &[Vec3], reach: f32) -> Vec<Vec<u32>> {
    let cell = |p: Vec3| (p / reach).floor().as_ivec3();
    let mut cells: HashMap<IVec3, Vec<u32>> = HashMap::new();
    for (i, p) in positions.iter().enumerate() {
        cells.entry(cell(*p)).or_default().push(i as u32);
    }
    (0..positions.len())
        .into_par_iter()
        .map(|i| {
            let (p, n) = (positions[i], normals[i]);
            let mut near = Vec::new();
            for offset in 0..27 {
                let by = IVec3::new(offset % 3, offset / 3 % 3, offset / 9) - 1;
                for &j in cells.get(&(cell(p) + by)).into_iter().flatten() {
                    let to = j as usize;
                    let close = positions[to].distance_squared(p) < reach * reach;
                    if close && normals[to].dot(n) > 0.5 {
                        near.push(j);
                    }
                }
            }
            near
        })
        .collect()
}

/// The steepness of a plane through what neighbours say, and what it misses.
fn slope(positions: &[Vec3], openness: &[f32], i: u32, near: &[u32], reach: f32) -> f32 {
    let count = near.len() as f32;
    let at = positions[i as usize];
    let mean_o = near.iter().map(|&j| openness[j as usize]).sum::<f32>() / count;
    let mean_d = near
        .iter()
        .map(|&j| positions[j as usize] - at)
        .sum::<Vec3>()
        / count;
    // A ridge: the fit has no say along the normal, and little where neighbours are few.
    let mut matrix = Mat3::from_diagonal(Vec3::splat(0.1 * reach * reach));
    let (mut right, mut squares) = (Vec3::ZERO, 0.0);
    for &j in near {
        let d = positions[j as usize] - at - mean_d;
        let o = openness[j as usize] - mean_o;
        matrix += Mat3::from_cols(d * d.x, d * d.y, d * d.z);
        right += d * o;
        squares += o * o;
    }
    let steep = matrix.inverse() * right;
    let noise = NOISE * mean_o * (1.0 - mean_o) / PILOT_RAYS as f32;
    let missed = ((squares - steep.dot(right)) / count - noise).max(0.0);
    (steep.length_squared() + missed * 4.0 / (reach * reach)).sqrt()
}

fn side_of(normal: Vec3) -> u8 {
    let a = normal.abs();
    let axis = if a.x >= a.y && a.x >= a.z {
        0
    } else if a.y >= a.z {
        1
    } else {
        2
    };
    axis << 1 | u8::from(normal[usize::from(axis)] < 0.0)
}

/// How dense points are to lie, over the mean.
#[derive(Clone, Debug, Default)]
pub struct Density {
    box_m: f32,
    metric: Vec3,
    factors: HashMap<(IVec3, u8), f32>,
}

impl Density {
    /// The factor at a place of the mesh that the pilot was of, as on average for places that the
    /// pilot has not seen.
    pub(super) fn at(&self, mesh: &Mesh, place: &SurfacePoint) -> f32 {
        let position = place.position(&mesh.triangles, &mesh.positions) * self.metric;
        let normal = place.geometric_normal(&mesh.triangles, &mesh.positions) / self.metric;
        let key = ((position / self.box_m).floor().as_ivec3(), side_of(normal));
        self.factors.get(&key).copied().unwrap_or(1.0)
    }
}

/// Densities for all meshes together, such that there are as many points as if they lay evenly.
/// `users`: how many instances have the points of each mesh.
pub fn densities(pilots: &[(Pilot, &Mesh, usize)]) -> Vec<Density> {
    let all = || {
        let of = |(pilot, _, users): &(Pilot, &Mesh, usize)| {
            let users = *users as f64;
            pilot
                .change
                .clone()
                .into_iter()
                .map(move |c| (f64::from(c), users))
        };
        pilots.iter().flat_map(of)
    };
    let total: f64 = all().map(|(_, users)| users).sum();
    let mean = all().map(|(change, users)| change * users).sum::<f64>() / total.max(1.0);
    let factor = |change: f32, scale: f64| {
        let raw = scale * (f64::from(change) / mean).sqrt();
        raw.clamp(f64::from(LEAST), f64::from(MOST)) as f32
    };
    // The scale at which factors are 1 on average.
    let (mut low, mut high) = (0.0, 1e6);
    for _ in 0..64 {
        let scale = 0.5 * (low + high);
        let sum: f64 = all()
            .map(|(c, users)| f64::from(factor(c as f32, scale)) * users)
            .sum();
        if sum < total {
            low = scale;
        } else {
            high = scale;
        }
    }
    let even = mean <= 0.0;
    let density = |(pilot, mesh, _): &(Pilot, &Mesh, usize)| {
        let box_m = pilot.reach * 0.75;
        let mut sums: HashMap<(IVec3, u8), [f32; 2]> = HashMap::new();
        for (i, place) in pilot.places.iter().enumerate() {
            let key = (
                (pilot.positions[i] / box_m).floor().as_ivec3(),
                pilot.side(mesh, place),
            );
            let sum = sums.entry(key).or_default();
            sum[0] += if even {
                1.0
            } else {
                factor(pilot.change[i], high)
            };
            sum[1] += 1.0;
        }
        Density {
            box_m,
            metric: pilot.metric,
            factors: sums.into_iter().map(|(key, [s, n])| (key, s / n)).collect(),
        }
    };
    pilots.par_iter().map(density).collect()
}
