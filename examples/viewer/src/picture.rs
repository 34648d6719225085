//! A frame on the GPU: G-buffer ─► occlusion ─► picture.

use bytemuck::{Pod, Zeroable};
use font8x8::UnicodeFonts;
use psao::Client;
use psao_core::Kernel;
use psao_core::mirror::{Buffer, Capacity};
use psao_gpu::Tier;
use psao_server::camera::Camera;
use psao_server::gpu::gbuffer::{GBuffer, Renderer};
use psao_server::gpu::screen::{self, HIGH, Source};
use psao_server::gpu::trace::GpuTracer;
use psao_server::gpu::{Gpu, Pass, Stopwatch};
use psao_server::render::REFERENCE_RAYS;
use psao_server::samples::Samples;
use psao_server::scene::{Pose, Scene};

/// Where occlusion comes from.
#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The stream's points
    Ao,
    /// Rays: more with each picture in which nothing moves, up to 512 a pixel
    Reference,
    /// Depth and normals alone
    Screen,
    /// Nothing
    Off,
}

/// What is drawn over the picture.
#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overlay {
    /// Nothing
    None,
    /// Each cell that the client has, in a colour of its own
    Cells,
    /// Points, from dark (occluded) to pale (open)
    Points,
    /// Cells that changed, fading
    Dirty,
    /// How full cells are
    Occupancy,
}

/// As `Look` in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Look {
    overlay: u32,
    picture: u32,
    columns: u32,
    lines: u32,
}

/// Letters across and lines of the text.
pub const TEXT: [usize; 2] = [34, 9];

/// What is shown.
pub struct Shown<'a> {
    /// Where from.
    pub camera: &'a Camera,
    /// Where occlusion comes from.
    pub mode: Mode,
    /// Rays a pixel that the reference gains with the picture; a divisor of 512.
    pub rays: u32,
    /// What is drawn over it.
    pub overlay: Overlay,
    /// Lines of text in the corner.
    pub text: &'a [String],
}

/// The lookup, and the buffers that it reads.
struct Lookup {
    kernel: Kernel,
    capacity: Capacity,
    buffers: psao_gpu::Buffers,
    pass: psao_gpu::Pass,
    /// Of each cell, the picture in which it last changed.
    stamps: wgpu::Buffer,
}

impl Lookup {
    fn new(gpu: &Gpu, kernel: Kernel, capacity: Capacity) -> Result<Lookup, String> {
        let buffers =
            psao_gpu::Buffers::new(&gpu.device, capacity).map_err(|error| error.to_string())?;
        Ok(Lookup {
            kernel,
            capacity,
            pass: psao_gpu::Pass::new(&gpu.device, &buffers, kernel, Tier::Fast),
            buffers,
            stamps: gpu.storage("stamps", &vec![0u32; capacity.cells as usize])?,
        })
    }
}

/// Textures of the picture's size.
struct Targets {
    buffer: GBuffer,
    openness: wgpu::Texture,
    screen: Vec<Pass>,
}

/// Draws pictures. Threads: one at a time.
pub struct Pictures {
    renderer: Renderer,
    tracer: GpuTracer,
    lookup: Lookup,
    targets: Targets,
    format: wgpu::TextureFormat,
    shader: String,
    pipeline: wgpu::RenderPipeline,
    look: wgpu::Buffer,
    text: wgpu::Buffer,
    radius_m: f32,
    /// Pictures so far.
    count: u32,
    /// Rays that the reference has.
    rays: u32,
    traced: Option<(Camera, f64)>,
    pose: Pose,
    watch: Option<Stopwatch>,
    /// Milliseconds of the GPU for the occlusion of the last picture, if it has a clock.
    pub occlusion_ms: Option<f64>,
}

impl Pictures {
    /// Uploads the scene. `format`: of what is drawn to; `rest_space`: the stream's profile.
    pub fn new(
        gpu: &Gpu,
        scene: &Scene,
        size: [u32; 2],
        format: wgpu::TextureFormat,
        client: &Client,
    ) -> Result<Pictures, String> {
        let mut pose = Pose::default();
        scene.pose(0.0, &mut pose);
        let header = client.header().ok_or("the stream has no header yet")?;
        let rest_space = header.profile == psao_core::stream::Profile::Residual;
        let lookup = Lookup::new(gpu, header.kernel, client.mirror().capacity())?;
        let radius_m = header.ao_distance_m;
        let shader = format!("{}\n{}", psao_gpu::wgsl(0), include_str!("compose.wgsl"));
        let glyph = |letter: u8| {
            let glyph = font8x8::BASIC_FONTS
                .get(char::from(letter))
                .unwrap_or_default();
            [0, 4].map(|at| u32::from_le_bytes(std::array::from_fn(|i| glyph[at + i])))
        };
        let mut text: Vec<u32> = (0..128).flat_map(glyph).collect();
        text.resize(256 + TEXT[0] * TEXT[1], 0);
        Ok(Pictures {
            renderer: Renderer::new(gpu, scene, rest_space)?,
            tracer: GpuTracer::new(gpu, scene, &pose, &Samples::new(REFERENCE_RAYS))?,
            targets: Targets::new(gpu, size, radius_m)?,
            pipeline: pipeline(gpu, &shader, format, &lookup.buffers),
            lookup,
            format,
            shader,
            look: gpu.uniform("look", &Look::zeroed()),
            text: gpu.storage("text", &text)?,
            radius_m,
            count: 0,
            rays: 0,
            traced: None,
            pose,
            watch: Stopwatch::new(gpu).ok(),
            occlusion_ms: None,
        })
    }

    /// For a window of another size.
    pub fn resize(&mut self, gpu: &Gpu, size: [u32; 2]) -> Result<(), String> {
        self.targets = Targets::new(gpu, size, self.radius_m)?;
        self.traced = None;
        Ok(())
    }

    /// Rays a pixel that the reference has.
    pub fn rays(&self) -> u32 {
        self.rays
    }

    /// Draws what the client has at scene time `time_s` into `target`, and waits until it is done.
    pub fn draw(
        &mut self,
        gpu: &Gpu,
        scene: &Scene,
        time_s: f64,
        client: &mut Client,
        shown: &Shown<'_>,
        target: &wgpu::TextureView,
    ) -> Result<(), String> {
        self.count += 1;
        let mut encoder = gpu.encoder();
        self.upload(gpu, client, &mut encoder)?;
        let moved = self.pose.time_s != time_s;
        if moved {
            scene.pose(time_s, &mut self.pose);
            self.renderer.pose(gpu, scene, &self.pose);
        }
        let Targets {
            buffer, openness, ..
        } = &mut self.targets;
        self.renderer
            .draw(gpu, scene, shown.camera, &mut encoder, buffer);
        let view = |texture: &wgpu::Texture| texture.create_view(&Default::default());
        let [position, normal, world, open] =
            [&buffer.position, &buffer.normal, &buffer.world, openness].map(view);
        if shown.mode != Mode::Reference {
            self.traced = None;
        }

        if let Some(watch) = &mut self.watch {
            watch.mark(&mut encoder);
        }
        match shown.mode {
            Mode::Ao => {
                let target = self
                    .lookup
                    .pass
                    .g_buffer(&gpu.device, &position, &normal, &open);
                let mut pass = encoder.begin_compute_pass(&Default::default());
                self.lookup
                    .pass
                    .encode(&mut pass, &self.lookup.buffers, &target);
            }
            Mode::Screen => self
                .targets
                .screen
                .iter()
                .for_each(|pass| pass.record(&mut encoder)),
            Mode::Reference => {
                let now = Some((*shown.camera, time_s));
                if self.traced != now {
                    if self.traced.is_none_or(|(_, traced_s)| traced_s != time_s) {
                        self.tracer.pose(gpu, scene, &self.pose)?;
                    }
                    self.traced = now;
                    self.rays = 0;
                }
                if self.rays < REFERENCE_RAYS as u32 {
                    let rays = [self.rays, shown.rays];
                    let (renderer, reach) = (&self.renderer, self.radius_m);
                    let buffer = &self.targets.buffer;
                    let openness = &self.targets.openness;
                    self.tracer
                        .pixels(gpu, buffer, renderer, openness, reach, rays)
                        .record(&mut encoder);
                    self.rays += shown.rays;
                }
            }
            Mode::Off => clear(&mut encoder, &open),
        }
        if let Some(watch) = &mut self.watch {
            watch.mark(&mut encoder);
        }

        self.write_look(gpu, shown);
        let own = [
            self.look.as_entire_binding(),
            wgpu::BindingResource::TextureView(&position),
            wgpu::BindingResource::TextureView(&normal),
            wgpu::BindingResource::TextureView(&world),
            wgpu::BindingResource::TextureView(&open),
            self.lookup.stamps.as_entire_binding(),
            self.text.as_entire_binding(),
        ];
        let own: Vec<_> = (0..).zip(own).collect();
        let own = gpu.bind(&self.pipeline.get_bind_group_layout(1), &own);
        {
            let mut pass = onto(&mut encoder, target, wgpu::LoadOp::Load);
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, self.lookup.buffers.bind_group(), &[]);
            pass.set_bind_group(1, &own, &[]);
            pass.draw(0..3, 0..1);
        }
        match &mut self.watch {
            Some(watch) => self.occlusion_ms = watch.finish(gpu, encoder)?.first().copied(),
            None => gpu.finish(encoder)?,
        }
        Ok(())
    }

    /// Brings the GPU's buffers to the client's last frame, without a picture.
    pub fn take(&mut self, gpu: &Gpu, client: &mut Client) -> Result<(), String> {
        self.count += 1;
        let mut encoder = gpu.encoder();
        self.upload(gpu, client, &mut encoder)?;
        gpu.finish(encoder)
    }

    fn upload(
        &mut self,
        gpu: &Gpu,
        client: &mut Client,
        encoder: &mut wgpu::CommandEncoder,
    ) -> Result<(), String> {
        let Some(header) = client.header().filter(|_| client.is_whole()) else {
            return Ok(());
        };
        let capacity = client.mirror().capacity();
        if (header.kernel, capacity) != (self.lookup.kernel, self.lookup.capacity) {
            self.lookup = Lookup::new(gpu, header.kernel, capacity)?;
            self.pipeline = pipeline(gpu, &self.shader, self.format, &self.lookup.buffers);
        }
        let mirror = client.mirror();
        for run in mirror.dirty_runs(Buffer::Cells) {
            let stamps = vec![self.count; (run.end - run.start) as usize];
            let at = u64::from(run.start) * 4;
            gpu.queue
                .write_buffer(&self.lookup.stamps, at, bytemuck::cast_slice(&stamps));
        }
        self.lookup.buffers.upload(encoder, mirror);
        client.clear_dirty();
        Ok(())
    }

    fn write_look(&self, gpu: &Gpu, shown: &Shown<'_>) {
        let lines = shown.text.len().min(TEXT[1]);
        let mut letters = vec![0u32; TEXT[0] * lines];
        for (row, line) in letters.chunks_mut(TEXT[0]).zip(shown.text) {
            for (letter, byte) in row.iter_mut().zip(line.bytes()) {
                *letter = u32::from(byte);
            }
        }
        gpu.queue
            .write_buffer(&self.text, 256 * 4, bytemuck::cast_slice(&letters));
        let look = Look {
            overlay: shown.overlay as u32,
            picture: self.count,
            columns: TEXT[0] as u32,
            lines: lines as u32,
        };
        gpu.queue
            .write_buffer(&self.look, 0, bytemuck::bytes_of(&look));
    }
}

impl Targets {
    fn new(gpu: &Gpu, size: [u32; 2], radius_m: f32) -> Result<Targets, String> {
        let buffer = GBuffer::new(gpu, size[0], size[1])?;
        let openness = gpu.openness(size)?;
        let source = Source::screen(HIGH, radius_m);
        Ok(Targets {
            screen: screen::passes(gpu, &buffer, source, &openness)?,
            buffer,
            openness,
        })
    }
}

/// All open.
fn clear(encoder: &mut wgpu::CommandEncoder, openness: &wgpu::TextureView) {
    drop(onto(
        encoder,
        openness,
        wgpu::LoadOp::Clear(wgpu::Color::WHITE),
    ));
}

fn onto<'a>(
    encoder: &'a mut wgpu::CommandEncoder,
    view: &wgpu::TextureView,
    load: wgpu::LoadOp<wgpu::Color>,
) -> wgpu::RenderPass<'a> {
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: None,
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations {
                load,
                store: wgpu::StoreOp::Store,
            },
        })],
        depth_stencil_attachment: None,
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    })
}

fn pipeline(
    gpu: &Gpu,
    shader: &str,
    format: wgpu::TextureFormat,
    buffers: &psao_gpu::Buffers,
) -> wgpu::RenderPipeline {
    let module = gpu
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("picture"),
            source: wgpu::ShaderSource::Wgsl(shader.into()),
        });
    let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::FRAGMENT,
        ty,
        count: None,
    };
    let buffer = |ty| wgpu::BindingType::Buffer {
        ty,
        has_dynamic_offset: false,
        min_binding_size: None,
    };
    let storage = buffer(wgpu::BufferBindingType::Storage { read_only: true });
    let texture = |sample_type| wgpu::BindingType::Texture {
        sample_type,
        view_dimension: wgpu::TextureViewDimension::D2,
        multisampled: false,
    };
    let float = texture(wgpu::TextureSampleType::Float { filterable: false });
    let uint = texture(wgpu::TextureSampleType::Uint);
    let own = gpu
        .device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("picture"),
            entries: &[
                entry(0, buffer(wgpu::BufferBindingType::Uniform)),
                entry(1, uint),
                entry(2, float),
                entry(3, uint),
                entry(4, float),
                entry(5, storage),
                entry(6, storage),
            ],
        });
    let layout = gpu
        .device
        .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(buffers.bind_group_layout()), Some(&own)],
            immediate_size: 0,
        });
    gpu.device
        .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("picture"),
            layout: Some(&layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("corner"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: Default::default(),
            depth_stencil: None,
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("picture"),
                compilation_options: Default::default(),
                targets: &[Some(format.into())],
            }),
            multiview_mask: None,
            cache: None,
        })
}
