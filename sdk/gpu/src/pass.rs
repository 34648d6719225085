//! The lookup as a compute pass: a G-buffer in, a texture of openness out.

use crate::Buffers;
use psao_core::Kernel;
use psao_core::cell::CELL_POINTS;

/// How a lookup is computed; both give the same picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tier {
    /// The kernel as the CPU's lookup defines it, written plainly.
    Exact,
    /// The fewest milliseconds: within 1/255 of [`Tier::Exact`] for 999 of 1000 pixels and within
    /// 4/255 for all. Only for [`Kernel::Planar`]; `Paper` is computed as in `Exact`.
    #[default]
    Fast,
}

/// The compute pass. Made once, used every frame, from any thread.
#[derive(Debug)]
pub struct Pass {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    /// Pixels of a workgroup, across and down.
    tile: [u32; 2],
}

/// What a pass reads and writes. Made when the textures are, used every frame.
#[derive(Debug)]
pub struct GBuffer {
    group: wgpu::BindGroup,
    tiles: [u32; 2],
}

const ENTRIES: &str = include_str!("pass.wgsl");

impl Pass {
    /// Compiles the pass. `kernel`: what the stream's header says.
    pub fn new(device: &wgpu::Device, buffers: &Buffers, kernel: Kernel, tier: Tier) -> Pass {
        let texture = |binding, sample_type| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Texture {
                sample_type,
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled: false,
            },
            count: None,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("psao G-buffer"),
            entries: &[
                texture(0, wgpu::TextureSampleType::Uint),
                texture(1, wgpu::TextureSampleType::Float { filterable: false }),
                wgpu::BindGroupLayoutEntry {
                    binding: 2,
                    visibility: wgpu::ShaderStages::COMPUTE,
                    ty: wgpu::BindingType::StorageTexture {
                        access: wgpu::StorageTextureAccess::WriteOnly,
                        format: wgpu::TextureFormat::R32Float,
                        view_dimension: wgpu::TextureViewDimension::D2,
                    },
                    count: None,
                },
            ],
        });
        let text = format!("{}\n{ENTRIES}", crate::wgsl(0));
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("psao"),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("psao"),
            bind_group_layouts: &[Some(buffers.bind_group_layout()), Some(&layout)],
            immediate_size: 0,
        });
        let (entry, tile) = match (kernel, tier) {
            (Kernel::Paper, _) => ("psao_pass_paper", [8, 8]),
            (Kernel::Planar, Tier::Exact) => ("psao_pass_planar", [8, 8]),
            (Kernel::Planar, Tier::Fast) => ("psao_pass_fast", [16, 8]),
        };
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        Pass {
            pipeline,
            layout,
            tile,
        }
    }

    /// Names the textures to work on; all must be of the same size.
    ///
    /// - `position`: `Rgba32Uint`, xyz the bits of the `f32` position in the instance's local (or
    ///   rest) space, w the instance index, `0xffff_ffff` where nothing was drawn.
    /// - `normal`: `Rgba16Float` (or any float format), xyz the interpolated normal in that space,
    ///   of any length.
    /// - `openness`: `R32Float` with `STORAGE_BINDING`, written: 1 is open, 0 fully occluded; 1
    ///   where nothing was drawn.
    pub fn g_buffer(
        &self,
        device: &wgpu::Device,
        position: &wgpu::TextureView,
        normal: &wgpu::TextureView,
        openness: &wgpu::TextureView,
    ) -> GBuffer {
        let size = openness.texture().size();
        let entry = |binding, view| wgpu::BindGroupEntry {
            binding,
            resource: wgpu::BindingResource::TextureView(view),
        };
        GBuffer {
            group: device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("psao G-buffer"),
                layout: &self.layout,
                entries: &[entry(0, position), entry(1, normal), entry(2, openness)],
            }),
            tiles: [
                size.width.div_ceil(self.tile[0]),
                size.height.div_ceil(self.tile[1]),
            ],
        }
    }

    /// Records the lookup of every pixel. It takes bind groups 0 and 1 of `pass`.
    pub fn encode(&self, pass: &mut wgpu::ComputePass<'_>, buffers: &Buffers, g_buffer: &GBuffer) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, buffers.bind_group(), &[]);
        pass.set_bind_group(1, &g_buffer.group, &[]);
        pass.dispatch_workgroups(g_buffer.tiles[0], g_buffer.tiles[1], 1);
    }
}

// The shaders read a cell as its key and seven points.
const _: () = assert!(CELL_POINTS == 7);
