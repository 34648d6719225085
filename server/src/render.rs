//! Pictures of occlusion alone: what the client sees from its mirror, and the ray-traced truth.

use crate::camera::Camera;
use crate::rays::{Against, offset_origin};
use crate::samples::Samples;
use crate::world::World;
use glam::Vec3;
use psao_core::{Kernel, Lookup};
use rayon::prelude::*;

/// Rays of the reference, a pixel.
pub const REFERENCE_RAYS: usize = 512;

/// What a pixel shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fragment {
    /// Instance index.
    pub instance: u32,
    /// Position in the instance's local (or rest) space: what an engine passes as a varying.
    pub position: Vec3,
    /// Shading normal in that space, towards the viewer's side of a double-sided surface.
    pub normal: Vec3,
    /// World position, metres from the scene's origin.
    pub world_position: Vec3,
    pub(crate) world_normal: Vec3,
    /// Normal of the flat triangle, in the world.
    pub(crate) outward: Vec3,
    /// World direction of a triangle edge.
    pub(crate) tangent: Vec3,
}

/// The fragments a camera sees, row by row from the top; none where it sees the sky.
#[derive(Clone, Debug)]
pub struct View {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// One a pixel.
    pub fragments: Vec<Option<Fragment>>,
}

/// A picture from the mirror, and what it cost.
#[derive(Clone, Debug, PartialEq)]
pub struct Blended {
    /// Openness a pixel; 1 for the sky.
    pub openness: Vec<f32>,
    /// Points read a pixel of the scene, on average.
    pub fetched: f64,
    /// Share of the scene's pixels without any point that counts.
    pub holes_share: f64,
}

impl View {
    /// Casts a ray a pixel, as an engine would rasterise: backs of single-sided surfaces are not
    /// there.
    pub fn new(world: &World, camera: &Camera, width: usize, height: usize) -> View {
        let fragments = (0..width * height)
            .into_par_iter()
            .map(|pixel| {
                let (x, y) = ((pixel % width) as u32, (pixel / width) as u32);
                let (origin, direction) = camera.ray(x, y, width as u32, height as u32);
                first_visible(world, origin, direction)
            })
            .collect();
        View {
            width,
            height,
            fragments,
        }
    }

    /// Which pixels show the scene.
    pub fn valid(&self) -> Vec<bool> {
        self.fragments.iter().map(Option::is_some).collect()
    }

    /// The client's picture: the lookup at every fragment, from its buffers alone.
    pub fn blend(&self, lookup: Lookup<'_>, kernel: Kernel) -> Blended {
        let answers: Vec<(f32, u32, bool)> = self
            .fragments
            .par_iter()
            .map(|fragment| match fragment {
                Some(f) => {
                    let (position, normal) = (f.position.to_array(), f.normal.to_array());
                    let answer = lookup.blend(kernel, f.instance, position, normal);
                    (answer.openness, answer.fetched, answer.weight == 0.0)
                }
                None => (1.0, 0, false),
            })
            .collect();
        let count = self.fragments.iter().flatten().count().max(1) as f64;
        Blended {
            openness: answers.iter().map(|a| a.0).collect(),
            fetched: answers.iter().map(|a| f64::from(a.1)).sum::<f64>() / count,
            holes_share: answers.iter().filter(|a| a.2).count() as f64 / count,
        }
    }

    /// The reference: [`REFERENCE_RAYS`] stratified rays a pixel, each pixel its own set.
    pub fn trace(&self, world: &World, samples: &Samples) -> Vec<f32> {
        self.fragments
            .par_iter()
            .enumerate()
            .map_init(
                || {
                    (
                        vec![Vec3::ZERO; REFERENCE_RAYS],
                        [0u64; REFERENCE_RAYS / 64],
                    )
                },
                |(directions, hit), (pixel, fragment)| {
                    let Some(f) = fragment else { return 1.0 };
                    samples.directions(pixel as u32, f.world_normal, f.tangent, directions);
                    let origin =
                        offset_origin(f.world_position, f.outward, world.reach(f.instance));
                    hit.fill(0);
                    let todo = [u64::MAX; REFERENCE_RAYS / 64];
                    let t_max = world.options.ao_distance_m;
                    world
                        .tracer()
                        .occluded(Against::All, origin, directions, t_max, &todo, hit);
                    let blocked: u32 = hit.iter().map(|word| word.count_ones()).sum();
                    1.0 - blocked as f32 / REFERENCE_RAYS as f32
                },
            )
            .collect()
    }
}

/// What a ray sees: the first surface that is not a single-sided one's back.
pub fn first_visible(world: &World, mut origin: Vec3, direction: Vec3) -> Option<Fragment> {
    // Bounded: a ray that only ever sees backs sees nothing.
    for _ in 0..64 {
        let hit = world.tracer().closest(origin, direction, f32::INFINITY)?;
        let mesh_index = world.scene.instances[hit.instance as usize].mesh as usize;
        let mesh = &world.scene.meshes[mesh_index];
        let (positions, normals) = world.vertices(hit.instance);
        let pose = &world.pose.instances[hit.instance as usize];
        let mut surface = crate::points::SurfacePoint {
            triangle: hit.triangle,
            u: hit.u,
            v: hit.v,
            back: false,
        };
        let front = pose.world_normal(surface.geometric_normal(&mesh.triangles, positions));
        surface.back = front.dot(direction) > 0.0;
        let position = surface.position(&mesh.triangles, positions);
        let world_position = pose.world_from_local.transform_point3(position);
        if surface.back && !mesh.double_sided {
            origin = offset_origin(world_position, front, world.reach(hit.instance));
            continue;
        }
        let normal = surface.normal(&mesh.triangles, positions, normals);
        let tangent = surface.tangent(&mesh.triangles, positions);
        let (grid_positions, grid_normals) = world.grid_vertices(hit.instance);
        return Some(Fragment {
            instance: hit.instance,
            position: surface.position(&mesh.triangles, grid_positions),
            normal: surface.normal(&mesh.triangles, grid_positions, grid_normals),
            world_position,
            world_normal: pose.world_normal(normal),
            outward: if surface.back { -front } else { front },
            tangent: pose.world_from_local.transform_vector3(tangent),
        });
    }
    None
}
