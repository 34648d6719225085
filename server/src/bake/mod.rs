//! The baker: ambient occlusion once, into vertices, textures, points and spherical harmonics.
//!
//! What is computed, by either method: openness is the cosine-weighted share of the hemisphere
//! around an element's (interpolated) normal in which nothing is hit, of either side of a triangle,
//! within the AO distance; holes of masks let light through. Everything is as the scene is posed at
//! 0 s. Rays may end at a distance; depth maps can't: of what lies over an element they know only
//! what is farthest from it, so that their distance is infinite.

pub mod atlas;
pub mod command;
pub mod detail;
mod elements;
pub mod glb;
pub mod rays;
pub mod sh;

pub use elements::{Element, Points, texels, vertices};

use crate::rays::{CpuTracer, Deformed};
use crate::scene::{Mesh, Pose, Scene};
use crate::world::Progress;
use glam::Vec3;
use std::time::Instant;

/// Rays of a reference.
pub const REFERENCE_RAYS: usize = 4096;

/// A scene posed at 0 s, to be baked.
pub struct Stage {
    /// The scene.
    pub scene: Scene,
    /// Where everything is.
    pub pose: Pose,
    deformed: Vec<Deformed>,
}

impl Stage {
    /// Poses the scene.
    pub fn new(scene: Scene) -> Stage {
        let mut pose = Pose::default();
        scene.pose(0.0, &mut pose);
        let bent = (0..scene.instances.len()).filter(|i| scene.instances[*i].deforms);
        let deformed = bent
            .map(|instance| {
                let mut deformed = Deformed {
                    instance: instance as u32,
                    ..Deformed::default()
                };
                let (positions, normals) = (&mut deformed.positions, &mut deformed.normals);
                scene.deform(instance, &pose.instances[instance], positions, normals);
                deformed
            })
            .collect();
        Stage {
            scene,
            pose,
            deformed,
        }
    }

    /// An instance's mesh.
    pub fn mesh(&self, instance: u32) -> &Mesh {
        &self.scene.meshes[self.scene.instances[instance as usize].mesh as usize]
    }

    /// Positions and normals of an instance's vertices in its local space, deformed.
    pub fn vertices(&self, instance: u32) -> (&[Vec3], &[Vec3]) {
        let index = self
            .deformed
            .binary_search_by_key(&instance, |d| d.instance);
        match index {
            Ok(index) => {
                let deformed = &self.deformed[index];
                (&deformed.positions, &deformed.normals)
            }
            Err(_) => {
                let mesh = self.mesh(instance);
                (&mesh.positions, &mesh.normals)
            }
        }
    }

    /// Rays against the scene as it is posed.
    ///
    /// # Errors
    /// It has too many triangles.
    pub fn tracer(&self) -> Result<CpuTracer, String> {
        let moves = vec![false; self.scene.instances.len()];
        CpuTracer::new(&self.scene, &self.pose, &self.deformed, &moves)
            .map_err(|error| error.to_string())
    }

    /// Middle and radius of a sphere around everything, metres from the scene's origin. The radius
    /// is above 0.
    pub fn sphere(&self) -> (Vec3, f32) {
        let [low, high] = self.scene.bounds(&self.pose);
        let radius = (high - low).length() * 0.5;
        ((low + high) * 0.5, radius.max(f32::MIN_POSITIVE))
    }
}

/// What is computed of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Numbers {
    /// One number: 1 is open, 0 fully occluded.
    Openness,
    /// The transfer vector of so many bands of spherical harmonics, 2 to 4: what each basis
    /// function as the only light would give an evenly reflecting surface. The 0th is openness
    /// times [`sh::CONSTANT`].
    Transfer(usize),
}

impl Numbers {
    /// Numbers an element.
    pub fn count(self) -> usize {
        match self {
            Numbers::Openness => 1,
            Numbers::Transfer(order) => sh::coefficients(order),
        }
    }
}

/// How it is computed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Method {
    /// Every element's own rays, on the processor.
    Rays {
        /// Longest ray, metres; may be infinite.
        distance_m: f32,
    },
    /// Depth maps from all around, on the GPU.
    Depth(DepthMaps),
}

impl Method {
    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Method::Rays { .. } => "rays",
            Method::Depth(_) => "depth",
        }
    }
}

/// How depth maps are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthMaps {
    /// Texels an edge.
    pub resolution: u32,
    /// How far over an element something must be to hide it, in texels, for a surface that faces
    /// the light; a slanted one's grows with its slope.
    pub bias: f32,
    /// Directions between two read-backs of the sums; 0 for one read-back in all.
    pub readback_every: usize,
}

/// What a bake gave.
#[derive(Clone, Debug, PartialEq)]
pub struct Baked {
    /// [`Numbers::count`] an element, in their order.
    pub values: Vec<f32>,
    /// From the elements to the values: trees or shaders and uploads included.
    pub seconds: f64,
    /// Times that values came back from the GPU.
    pub readbacks: usize,
}

/// Bakes elements with so many directions each (for depth maps: of the whole sphere, so that half
/// of them are above an element), at most [`crate::samples::MAX_RAYS`].
///
/// # Errors
/// The scene is too large, or there is no GPU, or this program was built without.
pub fn bake(
    stage: &Stage,
    elements: &[Element],
    numbers: Numbers,
    method: Method,
    directions: usize,
    progress: Progress<'_>,
) -> Result<Baked, String> {
    if !(1..=crate::samples::MAX_RAYS).contains(&directions) {
        let most = crate::samples::MAX_RAYS;
        return Err(format!("{directions} directions: give 1 to {most}"));
    }
    let began = Instant::now();
    let (values, readbacks) = match method {
        Method::Rays { distance_m } => {
            let seed = 0;
            let values = rays::trace(
                stage, elements, numbers, directions, distance_m, seed, progress,
            )?;
            (values, 0)
        }
        Method::Depth(maps) => depth(stage, elements, numbers, maps, directions, progress)?,
    };
    Ok(Baked {
        values,
        seconds: began.elapsed().as_secs_f64(),
        readbacks,
    })
}

#[cfg(feature = "gpu")]
fn depth(
    stage: &Stage,
    elements: &[Element],
    numbers: Numbers,
    maps: DepthMaps,
    directions: usize,
    progress: Progress<'_>,
) -> Result<(Vec<f32>, usize), String> {
    crate::gpu::depth::bake(stage, elements, numbers, maps, directions, progress)
}

#[cfg(not(feature = "gpu"))]
fn depth(
    _: &Stage,
    _: &[Element],
    _: Numbers,
    _: DepthMaps,
    _: usize,
    _: Progress<'_>,
) -> Result<(Vec<f32>, usize), String> {
    Err("--method depth needs a GPU: build with --features gpu, or use --method rays".into())
}

/// Root of the mean square of differences between two bakes' openness of the same elements, in
/// 1/255.
pub fn rmse_255(a: &[f32], b: &[f32]) -> f64 {
    let pairs = a.iter().zip(b);
    let squares: f64 = pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum();
    (squares / a.len().max(1) as f64).sqrt() * 255.0
}
