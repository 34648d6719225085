//! Points before a world has them: which instances share them, how many each gets, and the cells
//! that they fall into.

use super::{MAX_POINTS, Options, Progress, WorldError, bounds_of, count, deform, scale_of};
use crate::lattice::Lattice;
use crate::points::pilot::{Density, PILOT_RAYS, Pilot, densities};
use crate::points::{PointError, SurfacePoint, generate_with, morton_order};
use crate::rays::{Against, CpuTracer, Deformed, Tracer, offset_origin, reach};
use crate::samples::Samples;
use crate::scene::{Mesh, Pose, Scene};
use crate::truth::{Placement, buckets_for, choose_buckets, fit};
use glam::Vec3;
use psao_core::Instance;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};

/// An instance's points, before they are in cells.
pub(super) struct Placed {
    pub(super) instance: u32,
    /// Its points will move through cells.
    pub(super) loose: bool,
    pub(super) points: Vec<SurfacePoint>,
    pub(super) placements: Vec<Option<Placement>>,
    pub(super) grid: Instance,
    /// Distinct cells of the placements.
    pub(super) cells: usize,
}

/// The points of a mesh, for instances whose scales have the same ratios.
pub(super) struct Sampled {
    pub(super) mesh: u32,
    /// Instances and their scales, local units to metres.
    pub(super) users: Vec<(u32, Vec3)>,
    /// The largest of these.
    pub(super) scale: Vec3,
    /// In rest space, the grid of level 0, around the mesh.
    pub(super) grid: Option<Instance>,
    /// In progressive order, as many as the largest needs.
    pub(super) points: Vec<SurfacePoint>,
}

impl Sampled {
    /// The part of the points that a user of this scale needs.
    pub(super) fn share(&self, scale: Vec3) -> f32 {
        (scale / self.scale).powf(2.0).element_sum() / 3.0
    }
}

/// The instances that share points, and their scales (local units to metres).
pub(super) struct Users {
    mesh: u32,
    users: Vec<(u32, Vec3)>,
}

impl Users {
    /// The scale of the largest.
    fn largest(&self) -> Vec3 {
        let volume = |s: &Vec3| s.x * s.y * s.z;
        let scales = self.users.iter().map(|(_, s)| *s);
        scales.fold(
            Vec3::ZERO,
            |a, b| {
                if volume(&b) > volume(&a) { b } else { a }
            },
        )
    }
}

/// Which instances share points, large meshes first.
pub(super) fn shared_points(
    scene: &Scene,
    pose: &Pose,
    deformed: &[Deformed],
    options: &Options,
) -> Result<Vec<Users>, WorldError> {
    // Instances share points if their mesh is the same and scaled by the same ratios.
    let mut sets: BTreeMap<(u32, [i32; 2]), Vec<(u32, Vec3)>> = BTreeMap::new();
    for (index, instance) in scene.instances.iter().enumerate() {
        let mut scale = scale_of(&pose.instances[index].world_from_local);
        if instance.deforms {
            let mesh = &scene.meshes[instance.mesh as usize];
            if let Some(d) = deformed.iter().find(|d| d.instance as usize == index) {
                let posed = area(&mesh.triangles, &d.positions, scale);
                scale = Vec3::splat(
                    (posed / area(&mesh.triangles, &mesh.positions, Vec3::ONE)).sqrt() as f32,
                );
            }
        }
        if !(scale.is_finite() && scale.min_element() > 0.0) {
            continue;
        }
        let percent = |ratio: f32| ((ratio.ln() * 100.0).round()) as i32;
        let ratios = [percent(scale.y / scale.x), percent(scale.z / scale.x)];
        sets.entry((instance.mesh, ratios))
            .or_default()
            .push((index as u32, scale));
    }
    // Before memory is taken for any of them; a mask's holes are not known yet.
    let mut count = 0.0;
    for ((mesh, _), users) in &sets {
        let mesh = &scene.meshes[*mesh as usize];
        let sides = if mesh.double_sided { 2.0 } else { 1.0 };
        for (_, scale) in users {
            let on_side = area(&mesh.triangles, &mesh.positions, *scale) * options.density;
            count += sides * on_side.max(1.0);
        }
    }
    if options.density.is_finite() && count > MAX_POINTS as f64 {
        return Err(WorldError::TooManyPoints(count as u64));
    }
    // Large meshes first, so that none is left for the end alone.
    let sets = sets.into_iter();
    let mut sets: Vec<Users> = sets
        .map(|((mesh, _), users)| Users { mesh, users })
        .collect();
    sets.sort_by_key(|set| std::cmp::Reverse(scene.meshes[set.mesh as usize].triangles.len()));
    Ok(sets)
}

/// Poses in which places on what moves or bends are tried, evenly over the animations.
const PILOT_POSES: usize = 3;

/// Most instances of a mesh on which its places are tried.
const PILOT_USERS: usize = 4;

/// Traces a few rays from a few places of each mesh, and says how dense its points are to lie.
/// What stands still is tried among what stands still; the rest in several poses, among all.
pub(super) fn try_places(
    scene: &Scene,
    sets: &[Users],
    options: &Options,
    moves: &[bool],
    tracer: &mut CpuTracer,
    progress: Progress<'_>,
) -> Vec<Density> {
    let seed = |mesh: u32| options.seed.wrapping_add(u64::from(mesh));
    let mut pilots: Vec<Pilot> = sets
        .par_iter()
        .map(|set| {
            let mesh = &scene.meshes[set.mesh as usize];
            Pilot::new(mesh, set.largest(), options.density, seed(set.mesh))
        })
        .collect();
    let samples = Samples::new(PILOT_RAYS);
    let animations = scene.animations.iter();
    let longest = animations.map(|a| a.duration_s).fold(0.0, f32::max);
    let any_moves = moves.iter().any(|moves| *moves);
    let poses = if any_moves { PILOT_POSES } else { 1 };
    let (mut pose, mut deformed) = (Pose::default(), Vec::new());
    for index in (0..scene.instances.len()).filter(|&i| scene.instances[i].deforms) {
        deformed.push(Deformed {
            instance: index as u32,
            ..Deformed::default()
        });
    }
    // Backwards, so that the tracer ends in the first pose.
    for number in (0..poses).rev() {
        let time = f64::from(longest) * number as f64 / poses as f64;
        scene.pose(time, &mut pose);
        deform(scene, &pose, &mut deformed);
        tracer.update(scene, &pose, &deformed);
        let total = sets.len() as u64;
        for (done, (set, pilot)) in sets.iter().zip(&mut pilots).enumerate() {
            let step = set.users.len().div_ceil(PILOT_USERS);
            for &(instance, _) in set.users.iter().step_by(step) {
                let index = instance as usize;
                if number > 0 && !moves[index] {
                    continue;
                }
                let against = if moves[index] {
                    Against::All
                } else {
                    Against::Static
                };
                let mesh = &scene.meshes[set.mesh as usize];
                let at = deformed.binary_search_by_key(&instance, |d| d.instance);
                let (positions, normals) = match at {
                    Ok(at) => (&deformed[at].positions, &deformed[at].normals),
                    Err(_) => (&mesh.positions, &mesh.normals),
                };
                let placed = &pose.instances[index];
                let reach = reach(&placed.world_from_local, extent(mesh));
                let openness = |(number, place): (usize, &SurfacePoint)| {
                    let triangles = &mesh.triangles;
                    let normal = placed.world_normal(place.normal(triangles, positions, normals));
                    let outward = placed.world_normal(place.geometric_normal(triangles, positions));
                    let position = place.position(triangles, positions);
                    let position = placed.world_from_local.transform_point3(position);
                    let tangent = place.tangent(triangles, positions);
                    let tangent = placed.world_from_local.transform_vector3(tangent);
                    let origin = offset_origin(position, outward, reach);
                    let fan = samples.fan(number as u32, origin, normal, tangent);
                    let mut hit = [0];
                    let todo = [(1 << PILOT_RAYS) - 1];
                    tracer.occluded_fan(against, &fan, options.ao_distance_m, &todo, &mut hit);
                    1.0 - count(&hit) as f32 / PILOT_RAYS as f32
                };
                let openness: Vec<f32> =
                    pilot.places.par_iter().enumerate().map(openness).collect();
                // Instances and poses count alike.
                let times = set.users.len().div_ceil(step) * if moves[index] { poses } else { 1 };
                pilot.add(&openness, 1.0 / times as f32);
            }
            progress("pilot", done as u64 + 1, total);
        }
    }
    let pilots = pilots.into_iter().zip(sets);
    let pilots: Vec<(Pilot, &Mesh, usize)> = pilots
        .map(|(pilot, set)| (pilot, &scene.meshes[set.mesh as usize], set.users.len()))
        .collect();
    densities(&pilots)
}

/// Paper, 3.1: points a mesh.
pub(super) fn place_points(
    scene: &Scene,
    sets: Vec<Users>,
    factors: Option<Vec<Density>>,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Vec<Sampled>, WorldError> {
    let done = std::sync::atomic::AtomicU64::new(0);
    let total = sets.len() as u64;
    let mut sampled: Vec<Sampled> = sets
        .into_par_iter()
        .enumerate()
        .map(|(number, set)| {
            let mesh = &scene.meshes[set.mesh as usize];
            let largest = set.largest();
            let seed = options.seed.wrapping_add(u64::from(set.mesh));
            let corners = mesh.triangles.iter().flatten();
            let bounds = bounds_of(corners.map(|i| mesh.positions[*i as usize]));
            let (cell_m, radius) = (options.cell_m(), 1.0 / options.cell_over_radius);
            let grid = fit(bounds, largest, cell_m, radius).filter(|_| options.rest_space);
            let lattice = grid.as_ref().map(|grid| Lattice::new(mesh, grid));
            let factors = factors.as_ref().map(|factors| &factors[number]);
            let points = generate_with(
                mesh,
                largest,
                options.density,
                factors,
                lattice.as_ref(),
                seed,
            )?;
            progress(
                "points",
                done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1,
                total,
            );
            Ok(Sampled {
                mesh: set.mesh,
                users: set.users,
                scale: largest,
                grid,
                points: points.points,
            })
        })
        .collect::<Result<_, PointError>>()?;
    sampled.sort_by_key(|sampled| sampled.users[0].0);
    Ok(sampled)
}

/// Paper, 3.2: each instance's own prefix of its mesh's points, in Morton order.
pub(super) fn place_instances(
    scene: &Scene,
    pose: &Pose,
    deformed: &[Deformed],
    options: &Options,
    sets: Vec<Sampled>,
) -> Vec<Placed> {
    let placed = sets.par_iter().flat_map(|set| {
        set.users.par_iter().filter_map(|&(instance, scale)| {
            let count = (set.points.len() as f32 * set.share(scale)).round() as usize;
            let most = set.points.len();
            let points = &set.points[..count.clamp(1, most.max(1)).min(most)];
            // Local space is as large as placed, whatever the pose makes of it.
            let scale = if scene.instances[instance as usize].deforms {
                scale_of(&pose.instances[instance as usize].world_from_local)
            } else {
                scale
            };
            place_instance(scene, deformed, options, instance, scale, points)
        })
    });
    let mut placed: Vec<Placed> = placed.collect();
    placed.sort_by_key(|p| p.instance);
    placed
}

/// One instance's points in Morton order, quantised in its own grid.
fn place_instance(
    scene: &Scene,
    deformed: &[Deformed],
    options: &Options,
    instance: u32,
    scale: Vec3,
    points: &[SurfacePoint],
) -> Option<Placed> {
    let loose = scene.instances[instance as usize].deforms;
    let mesh = &scene.meshes[scene.instances[instance as usize].mesh as usize];
    let (positions, normals) = match deformed.iter().find(|d| loose && d.instance == instance) {
        Some(d) => (&d.positions, &d.normals),
        None => (&mesh.positions, &mesh.normals),
    };
    let local: Vec<Vec3> = points
        .iter()
        .map(|p| p.position(&mesh.triangles, positions))
        .collect();
    let bounds = bounds_of(local.iter().copied());
    // Room to move in before the first new grid.
    let margin = if loose {
        (bounds[1] - bounds[0]) * 0.25
    } else {
        Vec3::ZERO
    };
    let bounds = [bounds[0] - margin, bounds[1] + margin];
    let mut grid = fit(
        bounds,
        scale,
        options.cell_m(),
        1.0 / options.cell_over_radius,
    )?;
    let points: Vec<SurfacePoint> = morton_order(&local, bounds)
        .into_iter()
        .map(|i| points[i as usize])
        .collect();
    let placements: Vec<Option<Placement>> = points
        .iter()
        .map(|p| {
            let position = p.position(&mesh.triangles, positions);
            Placement::of(
                &grid,
                position,
                p.normal(&mesh.triangles, positions, normals),
            )
        })
        .collect();
    let cells = distinct_cells(&placements);
    grid.bucket_count = choose_buckets(&grid, &cells, buckets_for(cells.len()));
    let cells = cells.len();
    Some(Placed {
        instance,
        loose,
        points,
        placements,
        grid,
        cells,
    })
}

pub(super) fn distinct_cells(placements: &[Option<Placement>]) -> Vec<[u32; 3]> {
    let cells: HashSet<[u32; 3]> = placements.iter().flatten().map(|at| at.cell).collect();
    cells.into_iter().collect()
}

pub(super) fn extent(mesh: &Mesh) -> Vec3 {
    mesh.positions
        .iter()
        .fold(Vec3::ZERO, |extent, p| extent.max(p.abs()))
}

fn area(triangles: &[[u32; 3]], positions: &[Vec3], scale: Vec3) -> f64 {
    let double = triangles.iter().map(|t| {
        let [a, b, c] = t.map(|i| (positions[i as usize] * scale).as_dvec3());
        (b - a).cross(c - a).length()
    });
    double.sum::<f64>() * 0.5
}
