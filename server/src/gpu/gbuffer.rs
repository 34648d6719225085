//! The G-buffer: what a camera sees of the server's scene at one time, drawn as an engine would.

use super::{Eye, Gpu, from_octahedral};
use crate::camera::Camera;
use crate::rays::reach;
use crate::render::{Fragment, View};
use crate::scene::{Mesh, Pose, Scene, Wrap};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::ops::Range;
use wgpu::TextureFormat as Format;

/// Instance index of pixels that show no surface.
pub const NOTHING: u32 = u32::MAX;

const POSITION: Format = Format::Rgba32Uint;
const NORMAL: Format = Format::Rgba16Float;
const WORLD: Format = Format::Rg32Uint;
const DEPTH: Format = Format::Depth32Float;

/// Textures of one size that a camera's view is drawn to.
pub struct GBuffer {
    /// Pixels across and down.
    pub size: [u32; 2],
    /// Bits of the position in the instance's own (or rest) space, `f32` each; the instance's
    /// index, [`NOTHING`] where nothing is.
    pub position: wgpu::Texture,
    /// Unit normal in that space, interpolated from the vertices, towards the viewer's side of
    /// what has two.
    pub normal: wgpu::Texture,
    /// The same normal and that of the flat triangle, both in the world's space; octahedral.
    pub world: wgpu::Texture,
    /// Reversed: 1 at the near plane, 0 at infinity. Near plane over distance along the middle
    /// axis.
    pub depth: wgpu::Texture,
    /// The camera, last drawn with.
    pub(super) eye: wgpu::Buffer,
    camera: Eye,
}

impl GBuffer {
    /// Nothing is drawn yet.
    ///
    /// # Errors
    /// The device draws no pictures of that size.
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Result<GBuffer, String> {
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let texture = |what: &str, format| gpu.texture(what, [width, height], 1, format, usage);
        let camera = Eye::zeroed();
        Ok(GBuffer {
            size: [width, height],
            position: texture("position", POSITION)?,
            normal: texture("normal", NORMAL)?,
            world: texture("world normals", WORLD)?,
            depth: texture("depth", DEPTH)?,
            eye: gpu.uniform("eye", &camera),
            camera,
        })
    }

    /// What was drawn, back on the processor: for the lookup there, and its rays.
    ///
    /// # Errors
    /// The device is lost.
    pub fn view(&self, gpu: &Gpu) -> Result<View, String> {
        let positions: Vec<[u32; 4]> = gpu.read_texture(&self.position)?;
        let normals: Vec<[u16; 4]> = gpu.read_texture(&self.normal)?;
        let worlds: Vec<[u32; 2]> = gpu.read_texture(&self.world)?;
        let depths: Vec<f32> = gpu.read_texture(&self.depth)?;
        let [width, height] = self.size;
        let fragment = |pixel: usize| {
            let [x, y, z, instance] = positions[pixel];
            let at = [pixel as u32 % width, pixel as u32 / width];
            let normal = Vec3::from(std::array::from_fn(|i| half(normals[pixel][i])));
            (instance != NOTHING).then(|| Fragment {
                instance,
                position: Vec3::from([x, y, z].map(f32::from_bits)),
                normal,
                world_position: self.camera.place(at, depths[pixel], self.size),
                world_normal: from_octahedral(worlds[pixel][0]),
                outward: from_octahedral(worlds[pixel][1]),
                // Directions are only turned by it.
                tangent: Vec3::ZERO,
            })
        };
        Ok(View {
            width: width as usize,
            height: height as usize,
            fragments: (0..positions.len()).map(fragment).collect(),
        })
    }
}

/// A half-precision number.
fn half(bits: u16) -> f32 {
    let (exponent, mantissa) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023));
    let size = match exponent {
        0 => mantissa * 2f32.powi(-24),
        _ => (1.0 + mantissa / 1024.0) * 2f32.powi(exponent - 15),
    };
    if bits >> 15 == 1 { -size } else { size }
}

/// An instance as shaders have it: `Placed` in `eye.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Placed {
    rows: [[f32; 4]; 3],
    mask: u32,
    flags: u32,
    reach: f32,
    unused: u32,
}

const DOUBLE_SIDED: u32 = 1;
const MIRRORED: u32 = 2;

/// A mask as shaders have it: `Mask` in `eye.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct MaskInfo {
    first: u32,
    width: u32,
    height: u32,
    cutoff: f32,
    wrap: [u32; 2],
    unused: [u32; 2],
}

/// The alpha masks of a scene's meshes.
pub(super) struct Masks {
    pub(super) info: wgpu::Buffer,
    pub(super) alpha: wgpu::Buffer,
    /// Of each mesh: 0 for none, else one more than its index.
    pub(super) of_mesh: Vec<u32>,
}

impl Masks {
    pub(super) fn new(gpu: &Gpu, scene: &Scene) -> Result<Masks, String> {
        let (mut infos, mut alpha) = (Vec::new(), Vec::new());
        let mut of_mesh = Vec::new();
        for mesh in &scene.meshes {
            of_mesh.push(mesh.mask.as_ref().map_or(0, |_| infos.len() as u32 + 1));
            if let Some(mask) = &mesh.mask {
                infos.push(MaskInfo {
                    // What is longer than 32 bits is refused with the buffer.
                    first: alpha.len() as u32,
                    width: mask.width,
                    height: mask.height,
                    cutoff: mask.cutoff,
                    wrap: mask.wrap.map(|wrap| match wrap {
                        Wrap::Clamp => 0,
                        Wrap::Repeat => 1,
                        Wrap::Mirror => 2,
                    }),
                    unused: [0; 2],
                });
                alpha.extend_from_slice(&mask.alpha);
            }
        }
        if infos.is_empty() {
            infos.push(MaskInfo::zeroed());
        }
        Ok(Masks {
            info: gpu.storage("masks", &infos)?,
            alpha: gpu.storage("mask texels", &alpha)?,
            of_mesh,
        })
    }
}

/// Position and normal.
type Vertex = [Vec3; 2];

/// A mesh within the buffers of all.
struct Drawn {
    vertices: Range<u64>,
    indices: Range<u64>,
    double_sided: bool,
}

/// An instance that deforms: where its vertices are in the buffer of such.
struct Bent {
    instance: u32,
    vertices: Range<u64>,
}

/// Draws a scene. Threads: one at a time.
pub struct Renderer {
    /// For each of [`Renderer::kind`].
    pipelines: Vec<wgpu::RenderPipeline>,
    binding: wgpu::BindGroup,
    shapes: wgpu::Buffer,
    uvs: wgpu::Buffer,
    indices: wgpu::Buffer,
    posed: wgpu::Buffer,
    meshes: Vec<Drawn>,
    bent: Vec<Bent>,
    masks: Masks,
    pub(super) placed: wgpu::Buffer,
    flags: Vec<u32>,
    extents: Vec<Vec3>,
    rest_space: bool,
    eye: wgpu::Buffer,
}

const VERTEX_BYTES: u64 = size_of::<Vertex>() as u64;

impl Renderer {
    /// Uploads a scene's meshes. With `rest_space`, positions and normals of deforming instances
    /// come out as they are at rest (stream profile `residual`), else as they are posed.
    ///
    /// # Errors
    /// The device has no room for them.
    pub fn new(gpu: &Gpu, scene: &Scene, rest_space: bool) -> Result<Renderer, String> {
        let mut shapes: Vec<Vertex> = Vec::new();
        let (mut uvs, mut indices) = (Vec::new(), Vec::new());
        let mut meshes = Vec::new();
        for mesh in &scene.meshes {
            let (vertex, index) = (shapes.len() as u64, indices.len() as u64);
            let both = mesh.positions.iter().zip(&mesh.normals);
            shapes.extend(both.map(|(p, n)| [*p, *n]));
            uvs.extend_from_slice(&mesh.uvs);
            uvs.resize(shapes.len(), glam::Vec2::ZERO);
            indices.extend_from_slice(&mesh.triangles);
            meshes.push(Drawn {
                vertices: vertex..shapes.len() as u64,
                indices: index * 3..indices.len() as u64 * 3,
                double_sided: mesh.double_sided,
            });
        }
        let mut bent = Vec::new();
        let mut count = 0;
        for (index, instance) in scene.instances.iter().enumerate() {
            if instance.deforms {
                let first = count;
                count += scene.meshes[instance.mesh as usize].positions.len() as u64;
                bent.push(Bent {
                    instance: index as u32,
                    vertices: first..count,
                });
            }
        }
        let masks = Masks::new(gpu, scene)?;
        let vertex = wgpu::BufferUsages::VERTEX;
        let placed = vec![Placed::zeroed(); scene.instances.len().max(1)];
        let placed = gpu.storage("instances", &placed)?;
        let eye = gpu.uniform("eye", &Eye::zeroed());
        let shader = gpu.shader("G-buffer", include_str!("gbuffer.wgsl"));
        let layout = layout(gpu);
        let binding = gpu.bind(
            &layout,
            &[
                (0, eye.as_entire_binding()),
                (1, placed.as_entire_binding()),
                (2, masks.info.as_entire_binding()),
                (3, masks.alpha.as_entire_binding()),
            ],
        );
        let empty = vec![[Vec3::ZERO; 2]; count as usize];
        let mut renderer = Renderer {
            pipelines: (0..6)
                .map(|kind| pipeline(gpu, &shader, &layout, kind))
                .collect(),
            binding,
            shapes: gpu.filled("vertices", &shapes, vertex)?,
            uvs: gpu.filled("texture coordinates", &uvs, vertex)?,
            indices: gpu.filled("triangles", &indices, wgpu::BufferUsages::INDEX)?,
            posed: gpu.filled("deformed vertices", &empty, vertex)?,
            meshes,
            bent,
            masks,
            placed,
            flags: vec![0; scene.instances.len()],
            extents: scene.meshes.iter().map(extent).collect(),
            rest_space,
            eye,
        };
        let mut pose = Pose::default();
        scene.pose(0.0, &mut pose);
        renderer.pose(gpu, scene, &pose);
        Ok(renderer)
    }

    /// Moves everything to a pose of the scene that the renderer was made for.
    pub fn pose(&mut self, gpu: &Gpu, scene: &Scene, pose: &Pose) {
        let mut placed = Vec::with_capacity(scene.instances.len());
        for (index, (instance, at)) in scene.instances.iter().zip(&pose.instances).enumerate() {
            let mesh = instance.mesh as usize;
            let m = at.world_from_local.matrix3;
            let mirrored = m.determinant() < 0.0;
            let double_sided = self.meshes[mesh].double_sided;
            let flags = u32::from(double_sided) * DOUBLE_SIDED + u32::from(mirrored) * MIRRORED;
            self.flags[index] = flags;
            let t = at.world_from_local.translation;
            let row = |i: usize| [m.x_axis[i], m.y_axis[i], m.z_axis[i], t[i]];
            placed.push(Placed {
                rows: [row(0), row(1), row(2)],
                mask: self.masks.of_mesh[mesh],
                flags,
                reach: reach(&at.world_from_local, self.extents[mesh]),
                unused: 0,
            });
        }
        gpu.queue
            .write_buffer(&self.placed, 0, bytemuck::cast_slice(&placed));
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for bent in &self.bent {
            let instance = bent.instance as usize;
            scene.deform(
                instance,
                &pose.instances[instance],
                &mut positions,
                &mut normals,
            );
            let both = positions.iter().zip(&normals);
            let vertices: Vec<Vertex> = both.map(|(p, n)| [*p, *n]).collect();
            let at = bent.vertices.start * VERTEX_BYTES;
            gpu.queue
                .write_buffer(&self.posed, at, bytemuck::cast_slice(&vertices));
        }
    }

    /// Draws the scene as last posed.
    pub fn draw(
        &self,
        gpu: &Gpu,
        scene: &Scene,
        camera: &Camera,
        encoder: &mut wgpu::CommandEncoder,
        into: &mut GBuffer,
    ) {
        into.camera = Eye::of(camera);
        for eye in [&self.eye, &into.eye] {
            gpu.queue
                .write_buffer(eye, 0, bytemuck::bytes_of(&into.camera));
        }
        let views = [&into.position, &into.normal, &into.world, &into.depth]
            .map(|texture| texture.create_view(&Default::default()));
        let attachment = |view, value: f64| {
            Some(wgpu::RenderPassColorAttachment {
                view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color {
                        r: value,
                        g: value,
                        b: value,
                        a: value,
                    }),
                    store: wgpu::StoreOp::Store,
                },
            })
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("G-buffer"),
            color_attachments: &[
                attachment(&views[0], f64::from(NOTHING)),
                attachment(&views[1], 0.0),
                attachment(&views[2], 0.0),
            ],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &views[3],
                depth_ops: Some(wgpu::Operations {
                    load: wgpu::LoadOp::Clear(0.0),
                    store: wgpu::StoreOp::Store,
                }),
                stencil_ops: None,
            }),
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_bind_group(0, &self.binding, &[]);
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        let mut bent = self.bent.iter().peekable();
        for (index, instance) in scene.instances.iter().enumerate() {
            let mesh = &self.meshes[instance.mesh as usize];
            let bytes = |r: &Range<u64>, each: u64| r.start * each..r.end * each;
            let shape = self.shapes.slice(bytes(&mesh.vertices, VERTEX_BYTES));
            let posed = bent
                .next_if(|bent| bent.instance as usize == index)
                .map_or(shape, |bent| {
                    self.posed.slice(bytes(&bent.vertices, VERTEX_BYTES))
                });
            pass.set_pipeline(&self.pipelines[self.kind(instance.mesh, self.flags[index])]);
            pass.set_vertex_buffer(0, posed);
            pass.set_vertex_buffer(1, if self.rest_space { shape } else { posed });
            pass.set_vertex_buffer(2, self.uvs.slice(bytes(&mesh.vertices, 8)));
            let indices = mesh.indices.start as u32..mesh.indices.end as u32;
            pass.draw_indexed(indices, 0, index as u32..index as u32 + 1);
        }
    }

    /// Which pipeline draws a mesh: 0 to 2 culls what a single-sided one shows of its back, with
    /// the winding as it is or mirrored, or culls nothing; 3 more with a mask.
    fn kind(&self, mesh: u32, flags: u32) -> usize {
        let sides = match flags {
            0 => 0,
            MIRRORED => 1,
            _ => 2,
        };
        sides
            + if self.masks.of_mesh[mesh as usize] != 0 {
                3
            } else {
                0
            }
    }
}

/// Largest local coordinates.
fn extent(mesh: &Mesh) -> Vec3 {
    mesh.positions
        .iter()
        .fold(Vec3::ZERO, |most, p| most.max(p.abs()))
}

fn layout(gpu: &Gpu) -> wgpu::BindGroupLayout {
    let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::VERTEX_FRAGMENT,
        ty: wgpu::BindingType::Buffer {
            ty,
            has_dynamic_offset: false,
            min_binding_size: None,
        },
        count: None,
    };
    let storage = wgpu::BufferBindingType::Storage { read_only: true };
    gpu.device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("G-buffer"),
            entries: &[
                entry(0, wgpu::BufferBindingType::Uniform),
                entry(1, storage),
                entry(2, storage),
                entry(3, storage),
            ],
        })
}

fn pipeline(
    gpu: &Gpu,
    shader: &wgpu::ShaderModule,
    binding: &wgpu::BindGroupLayout,
    kind: usize,
) -> wgpu::RenderPipeline {
    let layout = gpu
        .device
        .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(binding)],
            immediate_size: 0,
        });
    let stream = |attributes| {
        Some(wgpu::VertexBufferLayout {
            array_stride: VERTEX_BYTES,
            step_mode: wgpu::VertexStepMode::Vertex,
            attributes,
        })
    };
    let target = |format: Format| Some(wgpu::ColorTargetState::from(format));
    gpu.device
        .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("G-buffer"),
            layout: Some(&layout),
            vertex: wgpu::VertexState {
                module: shader,
                entry_point: Some("corner"),
                compilation_options: Default::default(),
                buffers: &[
                    stream(&wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3]),
                    stream(&wgpu::vertex_attr_array![2 => Float32x3, 3 => Float32x3]),
                    Some(wgpu::VertexBufferLayout {
                        array_stride: 8,
                        step_mode: wgpu::VertexStepMode::Vertex,
                        attributes: &wgpu::vertex_attr_array![4 => Float32x2],
                    }),
                ],
            },
            primitive: wgpu::PrimitiveState {
                front_face: match kind % 3 {
                    1 => wgpu::FrontFace::Cw,
                    _ => wgpu::FrontFace::Ccw,
                },
                cull_mode: (kind % 3 != 2).then_some(wgpu::Face::Back),
                ..Default::default()
            },
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Greater),
                stencil: Default::default(),
                bias: Default::default(),
            }),
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: shader,
                entry_point: Some(if kind < 3 { "solid" } else { "masked" }),
                compilation_options: Default::default(),
                targets: &[target(POSITION), target(NORMAL), target(WORLD)],
            }),
            multiview_mask: None,
            cache: None,
        })
}
