//! The server's own work on a GPU: pictures of a scene, rays, and what competes with the lookup.
//!
//! Nothing here is the SDK's: engines take `psao-gpu` and the shader snippets. The G-buffer is the
//! one that they share: position and normal in an instance's local (or rest) space, and depth.

pub mod depth;
pub mod gbuffer;
mod query;
pub mod screen;
pub mod trace;

use crate::camera::Camera;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::borrow::Cow;

/// A device, and the queue to it.
pub struct Gpu {
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// What it is.
    pub info: wgpu::AdapterInfo,
    /// Why rays can't be asked of the device itself, where they can't.
    pub no_ray_query: Option<&'static str>,
}

/// What is asked of timestamps: between passes, wherever a caller wants them.
const TIMESTAMPS: wgpu::Features =
    wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS);

const RAY_QUERY: wgpu::Features = wgpu::Features::EXPERIMENTAL_RAY_QUERY;

impl Gpu {
    /// The fastest device there is, for work without a window.
    ///
    /// # Errors
    /// There is none, or it gives no access; says what to install.
    pub fn open() -> Result<Gpu, String> {
        Gpu::open_with(wgpu::ExperimentalFeatures::disabled())
    }

    /// As [`Gpu::open`], and with ray queries if the device has them and the caller accepts what
    /// wgpu calls experimental.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_with(experimental: wgpu::ExperimentalFeatures) -> Result<Gpu, String> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        Ok(Gpu::of(&instance, None, experimental)?.0)
    }

    /// The fastest device that can show pictures on a surface, if one is given, and its adapter;
    /// `experimental` as in [`Gpu::open_with`].
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn of(
        instance: &wgpu::Instance,
        surface: Option<&wgpu::Surface<'_>>,
        experimental: wgpu::ExperimentalFeatures,
    ) -> Result<(Gpu, wgpu::Adapter), String> {
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            compatible_surface: surface,
            ..Default::default()
        };
        let adapter = pollster::block_on(instance.request_adapter(&options)).map_err(|error| {
            format!(
                "no GPU with Vulkan: {error}: install its driver, or mesa-vulkan-drivers, which \
                 computes on the processor"
            )
        })?;
        let no_ray_query = if !adapter.features().contains(RAY_QUERY) {
            Some("not on this adapter")
        } else if !experimental.is_enabled() {
            Some("not asked for: --ray-query")
        } else {
            None
        };
        let mut features = adapter.features() & TIMESTAMPS;
        features.set(RAY_QUERY, no_ray_query.is_none());
        let wanted = wgpu::DeviceDescriptor {
            label: Some("psao"),
            required_features: features,
            experimental_features: experimental,
            // All that it has: scenes need large buffers.
            required_limits: adapter.limits(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&wanted))
            .map_err(|error| format!("{}: {error}", adapter.get_info().name))?;
        let gpu = Gpu {
            device,
            queue,
            info: adapter.get_info(),
            no_ray_query,
        };
        Ok((gpu, adapter))
    }

    /// Name and driver.
    pub fn name(&self) -> String {
        let (name, driver) = (&self.info.name, &self.info.driver_info);
        format!("{name}, {driver}")
    }

    /// A buffer that shaders read, filled; never empty, as none may be bound.
    ///
    /// # Errors
    /// The device can't bind as much; names `what` it is.
    pub fn storage<T: Pod>(&self, what: &str, content: &[T]) -> Result<wgpu::Buffer, String> {
        self.filled(what, content, wgpu::BufferUsages::STORAGE)
    }

    fn filled<T: Pod>(
        &self,
        what: &str,
        content: &[T],
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, String> {
        let bytes: &[u8] = bytemuck::cast_slice(content);
        let limits = self.device.limits();
        let most = if usage.contains(wgpu::BufferUsages::STORAGE) {
            limits
                .max_buffer_size
                .min(limits.max_storage_buffer_binding_size)
        } else {
            limits.max_buffer_size
        };
        if bytes.len() as u64 > most {
            return Err(format!(
                "the scene's {what} need {} bytes, more than the {most} that {} binds at once: \
                 simplify its meshes, or use another device",
                bytes.len(),
                self.info.name
            ));
        }
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(what),
            size: (bytes.len() as u64).next_multiple_of(4).max(16),
            usage: usage | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.write(&buffer, bytes);
        Ok(buffer)
    }

    /// Writes bytes to the start of a buffer; a multiple of 4, or the rest is zero.
    fn write(&self, buffer: &wgpu::Buffer, bytes: &[u8]) {
        let whole = bytes.len() / 4 * 4;
        self.queue.write_buffer(buffer, 0, &bytes[..whole]);
        if whole < bytes.len() {
            let mut last = [0; 4];
            last[..bytes.len() - whole].copy_from_slice(&bytes[whole..]);
            self.queue.write_buffer(buffer, whole as u64, &last);
        }
    }

    /// A uniform buffer that holds a value.
    pub fn uniform<T: Pod>(&self, what: &str, value: &T) -> wgpu::Buffer {
        let bytes = bytemuck::bytes_of(value);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(what),
            size: bytes.len() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.queue.write_buffer(&buffer, 0, bytes);
        buffer
    }

    fn shader(&self, what: &str, source: &str) -> wgpu::ShaderModule {
        let source = Cow::Owned(format!("{source}\n{}", include_str!("eye.wgsl")));
        self.device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(what),
                source: wgpu::ShaderSource::Wgsl(source),
            })
    }

    fn compute(&self, module: &wgpu::ShaderModule, entry: &str) -> wgpu::ComputePipeline {
        let descriptor = wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module,
            entry_point: Some(entry),
            compilation_options: Default::default(),
            cache: None,
        };
        self.device.create_compute_pipeline(&descriptor)
    }

    /// Resources with their binding numbers.
    pub fn bind(
        &self,
        layout: &wgpu::BindGroupLayout,
        resources: &[(u32, wgpu::BindingResource<'_>)],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = resources
            .iter()
            .map(|(binding, resource)| wgpu::BindGroupEntry {
                binding: *binding,
                resource: resource.clone(),
            })
            .collect();
        self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout,
            entries: &entries,
        })
    }

    /// A texture for passes to write and read.
    ///
    /// # Errors
    /// The device has none of that size.
    pub fn texture(
        &self,
        what: &str,
        size: [u32; 2],
        mips: u32,
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> Result<wgpu::Texture, String> {
        let most = self.device.limits().max_texture_dimension_2d;
        if size.iter().any(|edge| *edge == 0 || *edge > most) {
            return Err(format!(
                "a picture of {} x {}: {} draws 1 to {most} pixels each way",
                size[0], size[1], self.info.name
            ));
        }
        Ok(self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some(what),
            size: wgpu::Extent3d {
                width: size[0],
                height: size[1],
                depth_or_array_layers: 1,
            },
            mip_level_count: mips,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: usage | wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        }))
    }

    /// A picture of one number a pixel for passes to write: 1 is open, 0 fully occluded.
    ///
    /// # Errors
    /// The device has none of that size.
    pub fn openness(&self, size: [u32; 2]) -> Result<wgpu::Texture, String> {
        let format = wgpu::TextureFormat::R32Float;
        let usage = wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::RENDER_ATTACHMENT;
        self.texture("openness", size, 1, format, usage)
    }

    /// An empty list of work.
    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.device.create_command_encoder(&Default::default())
    }

    /// Hands work over, and waits until it is done.
    ///
    /// # Errors
    /// The device is lost.
    pub fn finish(&self, encoder: wgpu::CommandEncoder) -> Result<(), String> {
        self.queue.submit([encoder.finish()]);
        self.wait()
    }

    fn wait(&self) -> Result<(), String> {
        let done = self.device.poll(wgpu::PollType::wait_indefinitely());
        done.map(|_| ())
            .map_err(|error| format!("{}: {error}", self.info.name))
    }

    /// What is in a buffer (that may be copied from).
    ///
    /// # Errors
    /// The device is lost.
    pub fn read<T: Pod>(&self, buffer: &wgpu::Buffer) -> Result<Vec<T>, String> {
        let landing = self.landing(buffer.size());
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(buffer, 0, &landing, 0, buffer.size());
        self.queue.submit([encoder.finish()]);
        Ok(bytemuck::pod_collect_to_vec(&self.mapped(&landing)?))
    }

    fn landing(&self, size: u64) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    fn mapped(&self, landing: &wgpu::Buffer) -> Result<Vec<u8>, String> {
        landing.map_async(wgpu::MapMode::Read, .., |_| ());
        self.wait()?;
        let view = landing.get_mapped_range(..);
        let view = view.map_err(|error| format!("{}: {error}", self.info.name))?;
        Ok(view.to_vec())
    }

    /// A texture's texels (of its first mip), row by row from the top, as many bytes each as its
    /// format has.
    ///
    /// # Errors
    /// The device is lost.
    pub fn read_texture<T: Pod>(&self, texture: &wgpu::Texture) -> Result<Vec<T>, String> {
        let texel = texture.format().block_copy_size(None).unwrap_or(4);
        let row = texture.width() * texel;
        let pitch = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let landing = self.landing(u64::from(pitch) * u64::from(texture.height()));
        let mut encoder = self.encoder();
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &landing,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(pitch),
                    rows_per_image: None,
                },
            },
            texture.size(),
        );
        self.queue.submit([encoder.finish()]);
        let bytes = self.mapped(&landing)?;
        let rows = bytes
            .chunks(pitch as usize)
            .map(|padded| &padded[..row as usize]);
        Ok(bytemuck::pod_collect_to_vec(
            &rows.collect::<Vec<_>>().concat(),
        ))
    }
}

/// A compute pass with all that it reads and writes.
pub struct Pass {
    /// What it does, as its shader says.
    pub name: &'static str,
    pipeline: wgpu::ComputePipeline,
    groups: Vec<wgpu::BindGroup>,
    /// Workgroups across and down.
    workgroups: [u32; 2],
}

impl Pass {
    fn new(
        gpu: &Gpu,
        name: &'static str,
        pipeline: wgpu::ComputePipeline,
        groups: &[&[(u32, wgpu::BindingResource<'_>)]],
        workgroups: [u32; 2],
    ) -> Pass {
        let bind = |(index, resources): (u32, &&[_])| {
            gpu.bind(&pipeline.get_bind_group_layout(index), resources)
        };
        let groups = (0..).zip(groups).map(bind).collect();
        Pass {
            name,
            pipeline,
            groups,
            workgroups,
        }
    }

    /// Adds the pass to a list of work.
    pub fn record(&self, encoder: &mut wgpu::CommandEncoder) {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipeline);
        for (index, group) in (0..).zip(&self.groups) {
            pass.set_bind_group(index, group, &[]);
        }
        pass.dispatch_workgroups(self.workgroups[0], self.workgroups[1], 1);
    }
}

/// Times on the device, between marks in a list of work.
pub struct Stopwatch {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    marks: u32,
    /// Written to behind each mark, where that is needed.
    fence: Option<wgpu::Buffer>,
}

/// Most marks of a stopwatch.
const MARKS: u32 = 32;

impl Stopwatch {
    /// # Errors
    /// The device has no timestamps.
    pub fn new(gpu: &Gpu) -> Result<Stopwatch, String> {
        if !gpu.device.features().contains(TIMESTAMPS) {
            return Err(format!(
                "{} has no timestamp queries, so nothing can be timed on it: use another device",
                gpu.name()
            ));
        }
        Ok(Stopwatch {
            queries: gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: MARKS,
            }),
            resolved: gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: u64::from(MARKS) * 8,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            marks: 0,
            // Lavapipe takes the time of a mark when it next waits for what was drawn, which
            // computing does not make it do, but a barrier does.
            fence: (gpu.info.device_type == wgpu::DeviceType::Cpu).then(|| gpu.landing(16)),
        })
    }

    /// Notes the time when all work so far is done.
    ///
    /// # Panics
    /// After 32 marks without [`Stopwatch::finish`].
    pub fn mark(&mut self, encoder: &mut wgpu::CommandEncoder) {
        encoder.write_timestamp(&self.queries, self.marks);
        self.marks += 1;
        if let Some(fence) = &self.fence {
            // Between two writes there is one.
            encoder.clear_buffer(fence, 0, None);
            encoder.clear_buffer(fence, 0, None);
        }
    }

    /// Does the work, and says how many milliseconds lie between each two marks.
    ///
    /// # Errors
    /// The device is lost.
    pub fn finish(
        &mut self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
    ) -> Result<Vec<f64>, String> {
        let marks = std::mem::take(&mut self.marks);
        encoder.resolve_query_set(&self.queries, 0..marks, &self.resolved, 0);
        gpu.finish(encoder)?;
        let ticks: Vec<u64> = gpu.read(&self.resolved)?;
        let tick_ms = f64::from(gpu.queue.get_timestamp_period()) * 1e-6;
        let pairs = ticks[..marks as usize].windows(2);
        Ok(pairs
            .map(|pair| pair[1].saturating_sub(pair[0]) as f64 * tick_ms)
            .collect())
    }
}

/// A camera as shaders have it: `Eye` in `eye.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Eye {
    /// World position, metres from the scene's origin.
    pub position: [f32; 3],
    /// Distance of the near plane, metres.
    pub near: f32,
    /// Unit vector to the right.
    pub right: [f32; 3],
    /// Half the width of the picture at distance 1.
    pub tan_x: f32,
    /// Unit vector up.
    pub up: [f32; 3],
    /// Half the height of the picture at distance 1.
    pub tan_y: f32,
    /// Unit vector to the middle of the picture.
    pub forward: [f32; 3],
    /// Nothing.
    pub unused: f32,
}

impl Eye {
    /// Of a camera that passes [`Camera::check`]. Its far plane does not count: depth is reversed,
    /// and goes on for ever.
    pub fn of(camera: &Camera) -> Eye {
        let [right, up, forward] = camera.axes();
        let tan_y = (camera.fov_y_rad * 0.5).tan();
        Eye {
            position: camera.position.into(),
            near: camera.near,
            right: right.into(),
            tan_x: tan_y * camera.aspect,
            up: up.into(),
            tan_y,
            forward: forward.into(),
            unused: 0.0,
        }
    }

    /// The world position at a pixel's centre and a depth.
    pub fn place(&self, pixel: [u32; 2], depth: f32, size: [u32; 2]) -> Vec3 {
        let across = (pixel[0] as f32 + 0.5) / size[0] as f32 * 2.0 - 1.0;
        let down = (pixel[1] as f32 + 0.5) / size[1] as f32 * 2.0 - 1.0;
        let way = Vec3::from(self.forward) + Vec3::from(self.right) * (across * self.tan_x)
            - Vec3::from(self.up) * (down * self.tan_y);
        Vec3::from(self.position) + way * (self.near / depth)
    }
}

/// A unit vector from two numbers of 16 bits, as `octahedral` in `eye.wgsl` writes it.
fn from_octahedral(packed: u32) -> Vec3 {
    let part = |bits: u32| f32::from(bits as u16 as i16) / 32767.0;
    let (x, y) = (part(packed), part(packed >> 16));
    let z = 1.0 - x.abs() - y.abs();
    let fold = (-z).max(0.0);
    let away = |v: f32| if v >= 0.0 { v - fold } else { v + fold };
    Vec3::new(away(x), away(y), z).normalize_or(Vec3::Z)
}
