//! What engines use instead: ambient occlusion from depth and normals alone, and its denoiser.

use super::gbuffer::GBuffer;
use super::{Gpu, Pass};
use bytemuck::{Pod, Zeroable};
use wgpu::TextureUsages as Usage;

/// How much work goes into a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// Directions through the pixel.
    pub slices: u32,
    /// Samples each way along one.
    pub steps: u32,
    /// Passes of the denoiser; 0 for none.
    pub denoise: u32,
}

/// XeGTAO's and Bevy's "low".
pub const LOW: Quality = Quality {
    slices: 1,
    steps: 2,
    denoise: 1,
};

/// XeGTAO's and Bevy's "high".
pub const HIGH: Quality = Quality {
    slices: 3,
    steps: 3,
    denoise: 2,
};

/// How far occluders count, as a part of the scene's AO distance: more, as few samples see too
/// little (XeGTAO has 1.457). With [`THICKNESS`] the best against rays in the built-in atrium, of
/// 1, 1.3, 1.457 and 1.8, for both presets.
const RADIUS: f32 = 1.3;

/// How far surfaces are taken to go on behind what is seen of them, as a part of the AO distance:
/// half as much is worse in the atrium, more no better.
const THICKNESS: f32 = 1.0;

/// What openness is raised to in the end, for the same reason (XeGTAO has 2.2): the best of 1, 1.3,
/// 1.6, 1.9 and 2.2 for the better preset in the atrium, and between the best two in Sponza.
const POWER: f32 = 1.3;

/// As `Settings` in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Settings {
    slices: u32,
    steps: u32,
    radius: f32,
    thickness: f32,
    power: f32,
    unused: [u32; 3],
}

/// What is denoised.
#[derive(Clone, Copy)]
pub enum Source<'a> {
    /// Occlusion from depth and normals.
    Screen {
        /// How well.
        quality: Quality,
        /// How far occluders count, metres.
        radius_m: f32,
        /// How far surfaces go on behind what is seen of them, metres.
        thickness_m: f32,
        /// What openness is raised to in the end; 1 for what was found.
        power: f32,
    },
    /// What another pass has put into an R32Float picture: denoised as often as this says.
    Picture(&'a wgpu::Texture, u32),
}

type Binding<'a> = (u32, wgpu::BindingResource<'a>);

fn texture(view: &wgpu::TextureView) -> wgpu::BindingResource<'_> {
    wgpu::BindingResource::TextureView(view)
}

impl Source<'_> {
    /// Tuned for a scene whose rays reach `ao_distance_m`.
    pub fn screen(quality: Quality, ao_distance_m: f32) -> Self {
        Source::Screen {
            quality,
            radius_m: ao_distance_m * RADIUS,
            thickness_m: ao_distance_m * THICKNESS,
            power: POWER,
        }
    }
}

/// The passes that put what the source says of a G-buffer into an R32Float picture of its size:
/// 1 is open.
///
/// # Errors
/// The device has no room for the pictures in between.
pub fn passes(
    gpu: &Gpu,
    buffer: &GBuffer,
    source: Source<'_>,
    openness: &wgpu::Texture,
) -> Result<Vec<Pass>, String> {
    let shader = gpu.shader("screen-space AO", include_str!("screen.wgsl"));
    let (settings, denoise) = match source {
        Source::Screen {
            quality,
            radius_m,
            thickness_m,
            power,
        } => (
            Settings {
                slices: quality.slices,
                steps: quality.steps,
                radius: radius_m,
                thickness: thickness_m,
                power,
                unused: [0; 3],
            },
            quality.denoise,
        ),
        Source::Picture(_, denoise) => (Settings::zeroed(), denoise),
    };
    let settings = gpu.uniform("settings", &settings);
    let size = buffer.size;
    let mips = (32 - size[0].max(size[1]).leading_zeros()).min(4);
    let float = wgpu::TextureFormat::R32Float;
    let distances = gpu.texture("distances", size, mips, float, Usage::STORAGE_BINDING)?;
    let word = wgpu::TextureFormat::R32Uint;
    let noisy = || gpu.texture("occlusion", size, 1, word, Usage::STORAGE_BINDING);
    let noisy = [noisy()?, noisy()?];

    let view = |texture: &wgpu::Texture| texture.create_view(&Default::default());
    let mip = |level: u32| {
        distances.create_view(&wgpu::TextureViewDescriptor {
            // Pictures of a few pixels have fewer; what is written there is not read.
            base_mip_level: level.min(mips - 1),
            mip_level_count: Some(1),
            ..Default::default()
        })
    };
    let levels = [mip(0), mip(1), mip(2), mip(3)];
    let [depth, world, out] = [&buffer.depth, &buffer.world, openness].map(view);
    let all_distances = view(&distances);
    let ping = noisy.each_ref().map(view);
    let eye = (0, buffer.eye.as_entire_binding());
    let set = (1, settings.as_entire_binding());

    let halves = size.map(|edge| edge.div_ceil(16));
    let tiles = size.map(|edge| edge.div_ceil(8));
    let pass = |entry, own: &[Binding<'_>], textures: &[Binding<'_>], groups| {
        let pipeline = gpu.compute(&shader, entry);
        Pass::new(gpu, entry, pipeline, &[own, textures], groups)
    };
    let levels: Vec<Binding<'_>> = (0..).zip(levels.iter().map(texture)).collect();
    let prepare = [eye.clone(), set.clone(), (2, texture(&depth))];
    let mut passes = vec![pass("prepare", &prepare, &levels, halves)];
    match source {
        Source::Screen { .. } => {
            let textures = [
                (4, texture(&all_distances)),
                (5, texture(&world)),
                (6, texture(&ping[0])),
            ];
            passes.push(pass("occlusion", &[eye, set], &textures, tiles));
        }
        Source::Picture(picture, _) => {
            let picture = view(picture);
            let textures = [
                (4, texture(&all_distances)),
                (6, texture(&ping[0])),
                (10, texture(&picture)),
            ];
            passes.push(pass("take", &[], &textures, tiles));
        }
    }
    for done in 0..denoise.max(1) {
        let [from, to] = [&ping[done as usize % 2], &ping[(done as usize + 1) % 2]];
        let (entry, into) = match denoise {
            0 => ("plain", (9, texture(&out))),
            _ if done + 1 == denoise => ("denoise_last", (9, texture(&out))),
            _ => ("denoise", (8, texture(to))),
        };
        passes.push(pass(entry, &[], &[(7, texture(from)), into], tiles));
    }
    Ok(passes)
}
