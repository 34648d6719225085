//! Options that several commands share: which scene, how sampled, how sent.

use crate::camera::CameraPath;
use crate::encode::{Compression, Limits, Scheme};
#[cfg(feature = "gpu")]
use crate::gpu::trace::StillTracer;
use crate::points::SurfacePoint;
use crate::rays::Tracer;
use crate::scene::{Placement, Pose, Scene};
use crate::server::Settings;
use crate::world::{Options, Progress, World};
use clap::{Args, ValueEnum};
use glam::Vec3;
use psao_core::Kernel;
use psao_core::residual::Quantiser;
use std::path::PathBuf;

/// Which scene, and how it is sampled.
#[derive(Args, Clone, Debug)]
pub struct SceneArgs {
    /// A glTF file (.gltf or .glb); without it, a built-in atrium with moving boulders and figures
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
    /// Places another file in the scene, at metres x,y,z, scaled; may be given several times
    #[arg(long, value_name = "FILE@X,Y,Z[,SCALE]")]
    pub add: Vec<Placement>,
    /// Adds boulders that roll through the middle of the scene
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub movers: usize,
    /// Metres per unit of the scene's files
    #[arg(long, value_name = "METRES", default_value_t = 1.0)]
    pub unit: f64,
    /// Points per square metre and side
    #[arg(long, value_name = "N", default_value_t = 512.0)]
    pub density: f64,
    /// Rays a point, 1 to 4096
    #[arg(long, value_name = "N", default_value_t = 256)]
    pub rays: usize,
    /// Rays that a frame spends on points near what moves, about; those whose lag shows most come
    /// first. Without it, serve spends as many as keep its rate, and all others what is needed
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub refresh_rays: Option<u64>,
    /// Longest ray, metres
    #[arg(long, value_name = "METRES", default_value_t = 0.6)]
    pub ao_distance: f32,
    /// How a fragment blends the points around it; decides radius and cell size
    #[arg(long, value_enum, default_value_t = KernelArg::Planar)]
    pub kernel: KernelArg,
    /// How points are spread over surfaces
    #[arg(long, value_enum, default_value_t = PlacementArg::Uniform)]
    pub placement: PlacementArg,
    /// Seed of the point placement and of the boulders
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
}

/// A kernel by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum KernelArg {
    /// The default of this project
    Planar,
    /// Eq. 2 to 4 of the paper
    Paper,
}

/// How points are spread, by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlacementArg {
    /// Evenly over all surfaces
    Uniform,
    /// Denser where occlusion changes fast
    Adaptive,
}

/// Compression by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum CompressionArg {
    /// zstd level 1
    Fast,
    /// zstd level 15, strategy 4, as in the paper
    Paper,
}

/// A stream profile by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProfileArg {
    /// The paper's: whole changed cells, zstd
    Cells,
    /// Where points are once, then occlusion alone, predicted and entropy coded
    Residual,
}

/// What traces rays, by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceArg {
    /// All rays on the processor
    Cpu,
    /// Rays between things that stand still on a GPU with Vulkan, the others on the processor
    Gpu,
}

/// What traces rays.
#[derive(Args, Clone, Debug)]
pub struct TraceArgs {
    /// What traces rays; gpu wants a build with --features gpu
    #[arg(long, value_enum, value_name = "DEVICE", default_value_t = DeviceArg::Cpu)]
    pub trace: DeviceArg,
}

impl TraceArgs {
    /// Loads the scene and places its points, and has their rays traced as asked for.
    ///
    /// # Errors
    /// What is wrong with a file or an option, or that there is no GPU, and what to do.
    pub fn world(
        &self,
        scene: &SceneArgs,
        layout: Layout,
        progress: Progress<'_>,
    ) -> Result<World, String> {
        #[cfg(not(feature = "gpu"))]
        if self.trace == DeviceArg::Gpu {
            return Err(
                "--trace gpu: this psao was built without its GPU parts: build it again with \
                 --features gpu, or leave --trace away"
                    .into(),
            );
        }
        let world = scene.world(layout, progress)?;
        #[cfg(feature = "gpu")]
        if self.trace == DeviceArg::Gpu {
            let mut world = world;
            let (pose, rays) = (&world.pose, world.options.rays);
            let device = StillTracer::open(&world.scene, pose, rays, world.moves());
            let device = device.map_err(|error| format!("--trace gpu: {error}"))?;
            world.trace_still_on(Box::new(device));
            return Ok(world);
        }
        Ok(world)
    }
}

impl ProfileArg {
    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            ProfileArg::Cells => "cells",
            ProfileArg::Residual => "residual",
        }
    }
}

/// How it is sent.
#[derive(Args, Clone, Debug)]
pub struct StreamArgs {
    /// What is sent of a change
    #[arg(long, value_enum, default_value_t = ProfileArg::Residual)]
    pub profile: ProfileArg,
    /// Server frames per second
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    pub fps: f32,
    /// Occlusion differences up to this many 1/255 are not sent
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub threshold: u8,
    /// Occlusion changes in multiples of this many 1/255 (profile residual), 1 to 255
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub step: u8,
    /// How hard zstd tries (profile cells)
    #[arg(long, value_enum, default_value_t = CompressionArg::Fast)]
    pub compression: CompressionArg,
    /// Most stream bits a second, in millions (profile residual); 0 for no limit. What does not
    /// fit waits, the largest visible error goes first
    #[arg(long, value_name = "MBIT", default_value_t = 0.0)]
    pub max_mbit: f64,
    /// Instances so far away that they have more points than this a pixel get fewer (profile
    /// residual), such as 0.01; at 1 only what fills next to no pixels. 0 for all points always
    #[arg(long, value_name = "N", default_value_t = 0.0)]
    pub points_per_pixel: f32,
    /// The extended field of view reaches this much farther on every side, degrees
    #[arg(long, value_name = "DEGREES", default_value_t = 10.0)]
    pub margin: f32,
}

impl SceneArgs {
    /// Loads the scene with all its additions.
    ///
    /// # Errors
    /// What is wrong with a file or an option, and what to do.
    pub fn load(&self) -> Result<Scene, String> {
        let usable = self.unit.is_finite() && self.unit > 0.0;
        usable
            .then_some(())
            .ok_or("--unit must be above 0: metres per unit of the files")?;
        let mut scene = match &self.scene {
            Some(path) => Scene::load(path, self.unit).map_err(|e| e.to_string())?,
            None => Scene::atrium(),
        };
        for placement in &self.add {
            let other = Scene::load(&placement.path, self.unit).map_err(|e| e.to_string())?;
            scene.add(other, placement.at, placement.scale);
        }
        if self.movers > 0 {
            scene.add_movers(self.movers, self.seed);
        }
        Ok(scene)
    }

    /// How the scene is to be sampled.
    ///
    /// # Errors
    /// An option is out of its range.
    pub fn options(&self) -> Result<Options, String> {
        if !(1..=crate::samples::MAX_RAYS).contains(&self.rays) {
            return Err(format!("--rays must be 1 to {}", crate::samples::MAX_RAYS));
        }
        // An infinite distance is allowed: the scene's size bounds the rays.
        if self.ao_distance.is_nan() || self.ao_distance < 0.0 {
            return Err("--ao-distance must be 0 or more metres".into());
        }
        let kernel = match self.kernel {
            KernelArg::Planar => Kernel::Planar,
            KernelArg::Paper => Kernel::Paper,
        };
        Ok(Options {
            density: self.density,
            rays: self.rays,
            refresh_rays: self.refresh_rays.unwrap_or(u64::MAX),
            ao_distance_m: self.ao_distance,
            adaptive: self.placement == PlacementArg::Adaptive,
            seed: self.seed,
            ..Options::of(kernel)
        })
    }

    /// Loads the scene and places its points.
    ///
    /// # Errors
    /// What is wrong with a file or an option, and what to do.
    pub fn world(&self, layout: Layout, progress: Progress<'_>) -> Result<World, String> {
        let options = Options {
            rest_space: layout != Layout::Cells,
            levels: layout == Layout::Levels,
            ..self.options()?
        };
        World::new(self.load()?, options, progress).map_err(|error| error.to_string())
    }
}

/// How a world's points are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Each instance's in cells, for profile `cells`.
    Cells,
    /// A mesh's for all its instances, for profile `residual`.
    Patches,
    /// The same in levels of detail.
    Levels,
}

impl Layout {
    /// For profile `residual`: with levels of detail or without.
    pub fn of_patches(levels: bool) -> Layout {
        if levels {
            Layout::Levels
        } else {
            Layout::Patches
        }
    }
}

impl StreamArgs {
    /// How points are to be laid out for the profile.
    pub fn layout(&self) -> Layout {
        match self.profile {
            ProfileArg::Cells => Layout::Cells,
            ProfileArg::Residual => Layout::of_patches(self.points_per_pixel > 0.0),
        }
    }

    /// How frames are made.
    ///
    /// # Errors
    /// An option is out of its range.
    pub fn settings(&self) -> Result<Settings, String> {
        if !(self.fps > 0.0 && self.fps <= 1000.0) {
            return Err("--fps must be above 0 and at most 1000".into());
        }
        if self.step == 0 {
            return Err("--step must be 1 to 255".into());
        }
        if !(self.max_mbit.is_finite() && self.max_mbit >= 0.0) {
            return Err("--max-mbit must be 0 (no limit) or more".into());
        }
        if self.max_mbit > 0.0 && self.profile == ProfileArg::Cells {
            return Err("--max-mbit needs --profile residual".into());
        }
        if !(self.points_per_pixel.is_finite() && self.points_per_pixel >= 0.0) {
            return Err("--points-per-pixel must be 0 (all points always) or more".into());
        }
        if !(0.0..=180.0).contains(&self.margin) {
            return Err("--margin must be 0 to 180 degrees".into());
        }
        Ok(Settings {
            scheme: match self.profile {
                ProfileArg::Cells => Scheme::Cells {
                    threshold: self.threshold,
                    compression: match self.compression {
                        CompressionArg::Fast => Compression::Fast,
                        CompressionArg::Paper => Compression::Paper,
                    },
                },
                ProfileArg::Residual => Scheme::Residual(
                    Quantiser {
                        step: self.step,
                        dead_zone: self.threshold,
                    },
                    Limits {
                        max_mbit: self.max_mbit,
                        points_per_pixel: self.points_per_pixel,
                        ..Limits::default()
                    },
                ),
            },
            rate_hz: self.fps,
            margin_rad: self.margin.to_radians(),
        })
    }
}

/// A camera path through a world; `which` is 0 or 1.
///
/// # Errors
/// The scene has no extent.
pub fn camera_path(world: &World, which: u32, aspect: f32) -> Result<CameraPath, String> {
    let vertices = |instance| world.vertices(instance).0;
    path_through(
        &world.scene,
        &world.pose,
        world.tracer(),
        &vertices,
        which,
        aspect,
    )
}

/// The same of a scene in a pose, without points. `vertices`: positions of an instance's vertices,
/// in local space.
///
/// # Errors
/// As [`camera_path`].
pub fn path_through<'a>(
    scene: &Scene,
    pose: &Pose,
    tracer: &dyn Tracer,
    vertices: &(dyn Fn(u32) -> &'a [Vec3] + Sync),
    which: u32,
    aspect: f32,
) -> Result<CameraPath, String> {
    let closest = |origin: Vec3, direction: Vec3| {
        let hit = tracer.closest(origin, direction, f32::INFINITY)?;
        let instance = &scene.instances[hit.instance as usize];
        let mesh = &scene.meshes[instance.mesh as usize];
        let point = SurfacePoint {
            triangle: hit.triangle,
            u: hit.u,
            v: hit.v,
            back: false,
        };
        let local = point.geometric_normal(&mesh.triangles, vertices(hit.instance));
        let normal = pose.instances[hit.instance as usize].world_normal(local);
        // Both sides of what has two are fronts.
        let away = mesh.double_sided && normal.dot(direction) > 0.0;
        Some((hit.t, if away { -normal } else { normal }))
    };
    CameraPath::find(scene.bounds(pose), which, aspect, &closest)
}
