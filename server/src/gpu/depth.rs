//! Occlusion by depth maps: the scene drawn from all around, from far away, and every element
//! compared with each map. All sums stay on the device until the end.

use super::Gpu;
use super::gbuffer::Masks;
use crate::bake::{DepthMaps, Element, Numbers, Stage, sh};
use crate::world::Progress;
use bytemuck::{Pod, Zeroable};
use glam::{Vec2, Vec3};
use std::f32::consts::TAU;
use wgpu::BufferBindingType::{Storage, Uniform};

/// `Direction` in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Direction {
    right: [f32; 4],
    up: [f32; 4],
    toward: [f32; 4],
    size: [f32; 4],
    basis: [f32; sh::MAX_COEFFICIENTS],
}

/// Bytes from a direction to the next: where uniforms may start on any device.
const STRIDE: usize = 256;
const _: () = assert!(size_of::<Direction>() <= STRIDE);

/// A triangle's corner as it is drawn.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Corner {
    position: Vec3,
    uv: Vec2,
    mask: u32,
}

/// Directions handed over at once: few enough that no driver takes them for a hang.
const BATCH: usize = 16;
/// Workgroups along one axis that every device has.
const GROUPS: u32 = 32768;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
const TILT: wgpu::TextureFormat = wgpu::TextureFormat::Rg16Float;

/// Bakes elements: [`Numbers::count`] values each, and how often sums were read back.
///
/// # Errors
/// There is no GPU, or it has no room.
pub fn bake(
    stage: &Stage,
    elements: &[Element],
    numbers: Numbers,
    maps: DepthMaps,
    directions: usize,
    progress: Progress<'_>,
) -> Result<(Vec<f32>, usize), String> {
    if elements.is_empty() {
        return Ok((Vec::new(), 0));
    }
    let gpu = Gpu::open()?;
    let (middle, radius) = stage.sphere();
    // A little larger, so that what lies on it stays within the map.
    let radius = radius * (1.0 + 4.0 / maps.resolution.max(1) as f32);
    let work = Work::new(&gpu, stage, elements, numbers, maps, middle)?;

    let mut uniforms = vec![0u8; directions * STRIDE];
    let sphere = sh::sphere(directions);
    for (index, (toward, out)) in sphere.zip(uniforms.chunks_mut(STRIDE)).enumerate() {
        // Each map turned differently, so that no grid of texels shows through all of them.
        let turn = TAU * (index as f32 * 0.754_877_7).fract();
        let (a, b) = toward.any_orthonormal_pair();
        let right = a * turn.cos() + b * turn.sin();
        let direction = Direction {
            right: right.extend(0.0).into(),
            up: toward.cross(right).extend(0.0).into(),
            toward: toward.extend(radius).into(),
            size: [
                maps.resolution as f32,
                maps.bias,
                elements.len() as f32,
                numbers.count() as f32,
            ],
            basis: match numbers {
                Numbers::Openness => [1.0; sh::MAX_COEFFICIENTS],
                Numbers::Transfer(_) => sh::basis(toward),
            },
        };
        out[..size_of::<Direction>()].copy_from_slice(bytemuck::bytes_of(&direction));
    }
    let buffer = gpu.filled("directions", &uniforms, wgpu::BufferUsages::UNIFORM)?;
    let bound = work.bind_direction(&gpu, &buffer);

    // Sums are of f32 on the device, and where they come back in parts, of f64 here.
    let mut sums = vec![0f64; elements.len() * (numbers.count() + 1)];
    let every = match maps.readback_every {
        0 => directions,
        every => every,
    };
    let (mut done, mut readbacks) = (0, 0);
    while done < directions {
        let part_end = (done + every).min(directions);
        while done < part_end {
            let end = (done + BATCH).min(part_end);
            let mut encoder = gpu.encoder();
            for index in done..end {
                work.record(&mut encoder, &bound, (index * STRIDE) as u32);
            }
            gpu.finish(encoder)?;
            done = end;
            progress("depth maps", done as u64, directions as u64);
        }
        let part: Vec<f32> = gpu.read(&work.sums)?;
        readbacks += 1;
        for (sum, part) in sums.iter_mut().zip(part) {
            *sum += f64::from(part);
        }
        let mut encoder = gpu.encoder();
        encoder.clear_buffer(&work.sums, 0, None);
        gpu.queue.submit([encoder.finish()]);
    }
    let each = numbers.count() + 1;
    let mut values = Vec::with_capacity(elements.len() * numbers.count());
    for sums in sums.chunks(each) {
        // An element that no direction is above, with very few directions, counts as open.
        let openness = |sum: &f64| match sums[0] > 0.0 {
            true => (sum / sums[0]) as f32,
            false => 1.0,
        };
        values.extend(sums[1..].iter().map(openness));
    }
    Ok((values, readbacks))
}

/// All that a direction's passes read and write.
struct Work {
    map: wgpu::TextureView,
    tilts: wgpu::TextureView,
    solid: wgpu::RenderPipeline,
    masked: wgpu::RenderPipeline,
    gather: wgpu::ComputePipeline,
    direction: wgpu::BindGroupLayout,
    masks: wgpu::BindGroup,
    elements: wgpu::BindGroup,
    corners: wgpu::Buffer,
    /// Corners of triangles without a mask, which come first, and of all.
    counts: [u32; 2],
    sums: wgpu::Buffer,
    workgroups: [u32; 2],
}

impl Work {
    fn new(
        gpu: &Gpu,
        stage: &Stage,
        elements: &[Element],
        numbers: Numbers,
        maps: DepthMaps,
        middle: Vec3,
    ) -> Result<Work, String> {
        let size = [maps.resolution; 2];
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let map = gpu.texture("depth map", size, 1, DEPTH, usage)?;
        let map = map.create_view(&Default::default());
        let tilts = gpu.texture("tilts", size, 1, TILT, usage)?;
        let tilts = tilts.create_view(&Default::default());
        // Elements are counted in f32, and 2^24 is also more than any device sums at once.
        if elements.len() > 1 << 24 {
            return Err(format!(
                "{} elements: at most {} are baked at once: lower --size or --density",
                elements.len(),
                1 << 24
            ));
        }
        let masks = Masks::new(gpu, &stage.scene)?;
        let (corners, counts) = corners(stage, &masks, middle);
        let corners = gpu.filled("triangles", &corners, wgpu::BufferUsages::VERTEX)?;
        let rows: Vec<[[f32; 4]; 3]> = elements
            .iter()
            .map(|element| {
                [
                    (element.position - middle).extend(0.0).into(),
                    element.normal.extend(0.0).into(),
                    element.outward.extend(0.0).into(),
                ]
            })
            .collect();
        let rows = gpu.storage("elements", &rows)?;
        let sums = vec![0f32; elements.len() * (numbers.count() + 1)];
        let sums = gpu.filled(
            "sums",
            &sums,
            wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC,
        )?;

        let every = wgpu::ShaderStages::VERTEX_FRAGMENT | wgpu::ShaderStages::COMPUTE;
        let read = Storage { read_only: true };
        let write = Storage { read_only: false };
        let direction = layout(gpu, &[(every, buffer(Uniform, true))]);
        let mask_layout = layout(
            gpu,
            &[
                (wgpu::ShaderStages::FRAGMENT, buffer(read, false)),
                (wgpu::ShaderStages::FRAGMENT, buffer(read, false)),
            ],
        );
        let depth_texture = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Depth,
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        };
        let tilt_texture = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Float { filterable: false },
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        };
        let compute = wgpu::ShaderStages::COMPUTE;
        let element_layout = layout(
            gpu,
            &[
                (compute, buffer(read, false)),
                (compute, buffer(write, false)),
                (compute, depth_texture),
                (compute, tilt_texture),
            ],
        );
        let shader = gpu.shader("depth maps", include_str!("depth.wgsl"));
        let layouts = |groups: &[Option<&wgpu::BindGroupLayout>]| {
            gpu.device
                .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                    label: None,
                    bind_group_layouts: groups,
                    immediate_size: 0,
                })
        };
        let draw_layout = layouts(&[Some(&direction), Some(&mask_layout)]);
        let gather_layout = layouts(&[Some(&direction), None, Some(&element_layout)]);
        let gather = gpu
            .device
            .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some("gather"),
                layout: Some(&gather_layout),
                module: &shader,
                entry_point: Some("gather"),
                compilation_options: Default::default(),
                cache: None,
            });
        let groups = (elements.len() as u32).div_ceil(64);
        Ok(Work {
            solid: pipeline(gpu, &shader, &draw_layout, "solid"),
            masked: pipeline(gpu, &shader, &draw_layout, "masked"),
            gather,
            masks: gpu.bind(
                &mask_layout,
                &[
                    (0, masks.info.as_entire_binding()),
                    (1, masks.alpha.as_entire_binding()),
                ],
            ),
            elements: gpu.bind(
                &element_layout,
                &[
                    (0, rows.as_entire_binding()),
                    (1, sums.as_entire_binding()),
                    (2, wgpu::BindingResource::TextureView(&map)),
                    (3, wgpu::BindingResource::TextureView(&tilts)),
                ],
            ),
            direction,
            map,
            tilts,
            corners,
            counts,
            sums,
            workgroups: [groups.min(GROUPS), groups.div_ceil(GROUPS)],
        })
    }

    fn bind_direction(&self, gpu: &Gpu, directions: &wgpu::Buffer) -> wgpu::BindGroup {
        let one = wgpu::BufferBinding {
            buffer: directions,
            offset: 0,
            size: wgpu::BufferSize::new(size_of::<Direction>() as u64),
        };
        gpu.bind(&self.direction, &[(0, wgpu::BindingResource::Buffer(one))])
    }

    /// Draws a direction's map and compares all elements with it.
    fn record(&self, encoder: &mut wgpu::CommandEncoder, direction: &wgpu::BindGroup, at: u32) {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("depth map"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &self.tilts,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
                    store: wgpu::StoreOp::Store,
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &self.map,
                depth_ops: Some(wgpu::Operations {
                    load: wgpu::LoadOp::Clear(1.0),
                    store: wgpu::StoreOp::Store,
                }),
                stencil_ops: None,
            }),
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_bind_group(0, direction, &[at]);
        pass.set_bind_group(1, &self.masks, &[]);
        pass.set_vertex_buffer(0, self.corners.slice(..));
        let [solid, all] = self.counts;
        pass.set_pipeline(&self.solid);
        pass.draw(0..solid, 0..1);
        pass.set_pipeline(&self.masked);
        pass.draw(solid..all, 0..1);
        drop(pass);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.gather);
        pass.set_bind_group(0, direction, &[at]);
        pass.set_bind_group(2, &self.elements, &[]);
        pass.dispatch_workgroups(self.workgroups[0], self.workgroups[1], 1);
    }
}

/// Corners of all triangles as they are posed, relative to `middle`: first of those without a
/// mask. How many those are, and all.
fn corners(stage: &Stage, masks: &Masks, middle: Vec3) -> (Vec<Corner>, [u32; 2]) {
    let mut parts = [Vec::new(), Vec::new()];
    for (index, instance) in (0..).zip(&stage.scene.instances) {
        let mesh = stage.mesh(index);
        let mask = masks.of_mesh[instance.mesh as usize];
        let (positions, _) = stage.vertices(index);
        let place = &stage.pose.instances[index as usize].world_from_local;
        let part = &mut parts[usize::from(mask != 0)];
        for vertex in mesh.triangles.as_flattened() {
            part.push(Corner {
                position: place.transform_point3(positions[*vertex as usize]) - middle,
                uv: mesh.uvs.get(*vertex as usize).copied().unwrap_or_default(),
                mask,
            });
        }
    }
    let [mut corners, masked] = parts;
    let solid = corners.len() as u32;
    corners.extend(masked);
    let all = corners.len() as u32;
    (corners, [solid, all])
}

fn buffer(ty: wgpu::BufferBindingType, has_dynamic_offset: bool) -> wgpu::BindingType {
    wgpu::BindingType::Buffer {
        ty,
        has_dynamic_offset,
        min_binding_size: None,
    }
}

fn layout(
    gpu: &Gpu,
    bindings: &[(wgpu::ShaderStages, wgpu::BindingType)],
) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = (0..)
        .zip(bindings)
        .map(|(binding, (visibility, ty))| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: *visibility,
            ty: *ty,
            count: None,
        })
        .collect();
    gpu.device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("depth maps"),
            entries: &entries,
        })
}

/// Draws depth and its tilt, of both sides.
fn pipeline(
    gpu: &Gpu,
    shader: &wgpu::ShaderModule,
    layout: &wgpu::PipelineLayout,
    fragment: &str,
) -> wgpu::RenderPipeline {
    gpu.device
        .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("depth map"),
            layout: Some(layout),
            vertex: wgpu::VertexState {
                module: shader,
                entry_point: Some("corner"),
                compilation_options: Default::default(),
                buffers: &[Some(wgpu::VertexBufferLayout {
                    array_stride: size_of::<Corner>() as u64,
                    step_mode: wgpu::VertexStepMode::Vertex,
                    attributes: &wgpu::vertex_attr_array![
                        0 => Float32x3, 1 => Float32x2, 2 => Uint32
                    ],
                })],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Less),
                stencil: Default::default(),
                bias: Default::default(),
            }),
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: shader,
                entry_point: Some(fragment),
                compilation_options: Default::default(),
                targets: &[Some(TILT.into())],
            }),
            multiview_mask: None,
            cache: None,
        })
}
