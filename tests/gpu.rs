//! The lookup on the GPU against the CPU's, which is its definition; and what is uploaded.

use glam::Vec3;
use psao::{Client, Config};
use psao_core::lookup::Answer;
use psao_core::mirror::{Borrowed, Buffer, Capacity, PartsMut};
use psao_core::residual::Quantiser;
use psao_core::{Bucket, Cell, Kernel, Mirror};
use psao_gpu::wgpu::{self, PollType, TextureFormat, TextureUsages};
use psao_gpu::{Buffers, Pass, Tier};
use psao_server::args::camera_path;
use psao_server::camera::Frustum;
use psao_server::encode::{Encoder, Limits, Scheme, View as SeenBy, capacity_of};
use psao_server::render::{Fragment, View};
use psao_server::scene::Scene;
use psao_server::world::{Options, World};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{LazyLock, PoisonError, RwLock, RwLockReadGuard};

const WIDTH: usize = 480;
const HEIGHT: usize = 270;

/// How many steps of 1/255 pixels may be off.
const STEP: f32 = 1.0 / 255.0;

// ---------------------------------------------------------------- scenes

/// A client that has a frame, and what a camera sees then.
struct Shot {
    name: &'static str,
    client: Client,
    view: View,
}

impl Shot {
    fn of(name: &'static str, scene: Scene) -> Shot {
        let mut stream = Stream::new(scene, 512.0, 32);
        let mut client = stream.client();
        let camera = stream.next(&mut client, 3.0);
        let view = View::new(&stream.world, &camera, WIDTH, HEIGHT);
        Shot { name, client, view }
    }

    fn cpu(&self, kernel: Kernel) -> Vec<f32> {
        self.view
            .blend(self.client.mirror().lookup(), kernel)
            .openness
    }

    /// What the CPU's lookup finds; nothing where nothing was drawn.
    fn answers(&self, kernel: Kernel) -> Vec<Option<Answer>> {
        let lookup = self.client.mirror().lookup();
        let fragments = self.view.fragments.iter();
        let answer = |fragment: &Fragment| {
            let (position, normal) = (fragment.position.to_array(), fragment.normal.to_array());
            lookup.blend(kernel, fragment.instance, position, normal)
        };
        fragments
            .map(|fragment| fragment.as_ref().map(answer))
            .collect()
    }

    /// The G-buffer's two textures: positions and instances, normals.
    fn g_buffer(&self) -> [Vec<u8>; 2] {
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for fragment in &self.view.fragments {
            let (position, normal) =
                fragment
                    .as_ref()
                    .map_or(([0, 0, 0, u32::MAX], [0.0; 4]), |f| {
                        let [x, y, z] = f.position.to_array().map(f32::to_bits);
                        ([x, y, z, f.instance], f.normal.extend(0.0).to_array())
                    });
            positions.extend_from_slice(bytemuck::bytes_of(&position));
            normals.extend_from_slice(bytemuck::bytes_of(&normal));
        }
        [positions, normals]
    }
}

static ATRIUM: LazyLock<Shot> = LazyLock::new(|| Shot::of("atrium", Scene::atrium()));

/// Sponza with what rolls through it, where the scenes are at hand.
static SPONZA: LazyLock<Option<Shot>> = LazyLock::new(|| {
    let path = root().join("../shared/scenes/Sponza/Sponza.gltf");
    if !path.exists() {
        println!("no {}: Sponza is left out", path.display());
        return None;
    }
    let mut scene = Scene::load(&path, 1.0).unwrap();
    scene.add_movers(6, 1);
    Some(Shot::of("Sponza", scene))
});

fn shots() -> impl Iterator<Item = &'static Shot> {
    [Some(&*ATRIUM), SPONZA.as_ref()].into_iter().flatten()
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A server's frames along a camera path, without a network.
struct Stream {
    world: World,
    path: psao_server::camera::CameraPath,
    encoder: Encoder,
    header: Vec<u8>,
}

impl Stream {
    fn new(scene: Scene, density: f64, rays: usize) -> Stream {
        let options = Options {
            density,
            rays,
            rest_space: true,
            // Where points lie is all the same to a lookup, and this takes minutes less.
            adaptive: false,
            ..Options::of(Kernel::Planar)
        };
        let world = World::new(scene, options, &|_, _, _| ()).unwrap();
        let path = camera_path(&world, 0, WIDTH as f32 / HEIGHT as f32).unwrap();
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        let scheme = Scheme::Residual(quantiser, Limits::default());
        let mut encoder = Encoder::new(&world, scheme, 0);
        let header = encoder.header(&world, 0, 30.0);
        Stream {
            world,
            path,
            encoder,
            header,
        }
    }

    fn client(&self) -> Client {
        Client::new(Config {
            capacity: capacity_of(&self.world),
            scene_hash: 0,
        })
    }

    /// Sends the frame at a time; the camera that it is for.
    fn next(&mut self, client: &mut Client, time_s: f64) -> psao_server::camera::Camera {
        let camera = self.path.at(time_s);
        let seen = Frustum::new(&camera, 0.05);
        let sees = |[min, max]: [Vec3; 2]| seen.sees_box(min, max);
        self.world.step(time_s, &sees, u64::MAX);
        let rays = self.world.options.rays;
        self.world.converge(&sees, rays, &|_, _| ());
        self.encoder.merge(&self.world);
        self.world.clear_changes();
        let mut bytes = std::mem::take(&mut self.header);
        let view = SeenBy {
            sees: &sees,
            eye: None,
        };
        let now_ns = (time_s * 1e9) as u64;
        self.encoder
            .frame(&self.world, now_ns, &view, true, &mut bytes);
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let pushed = client.push(rest).unwrap();
            rest = &rest[pushed.consumed..];
        }
        camera
    }
}

// ---------------------------------------------------------------- the device

/// A device with nothing that is not everywhere: wgpu's default limits (128 MiB a storage buffer),
/// no optional feature (no subgroups, no timestamps).
struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
}

static GPU: LazyLock<Gpu> = LazyLock::new(|| Gpu::new(wgpu::Features::empty()));

impl Gpu {
    fn new(required_features: wgpu::Features) -> Gpu {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let adapter =
            pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))
                .expect("a Vulkan device: install Debian's mesa-vulkan-drivers, as tests/run does");
        let required_limits = wgpu::Limits::default();
        assert_eq!(required_limits.max_storage_buffer_binding_size, 128 << 20);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            required_features,
            required_limits,
            ..wgpu::DeviceDescriptor::default()
        }))
        .unwrap();
        Gpu { device, queue }
    }
    fn texture(&self, format: TextureFormat, usage: TextureUsages) -> wgpu::Texture {
        self.device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d {
                width: WIDTH as u32,
                height: HEIGHT as u32,
                depth_or_array_layers: 1,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        })
    }

    fn filled(&self, format: TextureFormat, bytes: &[u8]) -> wgpu::TextureView {
        let usage = TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST;
        let texture = self.texture(format, usage);
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some((bytes.len() / HEIGHT) as u32),
            rows_per_image: None,
        };
        self.queue
            .write_texture(texture.as_image_copy(), bytes, layout, texture.size());
        texture.create_view(&wgpu::TextureViewDescriptor::default())
    }

    fn submit(&self, encoder: wgpu::CommandEncoder) {
        self.queue.submit([encoder.finish()]);
        self.device.poll(PollType::wait_indefinitely()).unwrap();
    }

    fn read(&self, buffer: &wgpu::Buffer) -> Vec<u8> {
        let copy = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: buffer.size(),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(buffer, 0, &copy, 0, buffer.size());
        self.submit(encoder);
        copy.slice(..)
            .map_async(wgpu::MapMode::Read, |done| done.unwrap());
        self.device.poll(PollType::wait_indefinitely()).unwrap();
        copy.slice(..).get_mapped_range().unwrap().to_vec()
    }

    fn encoder(&self) -> wgpu::CommandEncoder {
        self.device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
    }

    /// Everything of a client, uploaded.
    fn buffers(&self, client: &Client) -> Buffers {
        let mut buffers = Buffers::new(&self.device, client.mirror().capacity()).unwrap();
        let mut encoder = self.encoder();
        // Nothing was uploaded before: all that is not zero is dirty.
        buffers.upload(&mut encoder, client.mirror());
        self.submit(encoder);
        buffers
    }

    /// The picture of the compute pass.
    fn picture(&self, shot: &Shot, kernel: Kernel, tier: Tier) -> Vec<f32> {
        let buffers = self.buffers(&shot.client);
        let pass = Pass::new(&self.device, &buffers, kernel, tier);
        self.run_pass(shot, &buffers, &pass, None)
    }

    fn run_pass(
        &self,
        shot: &Shot,
        buffers: &Buffers,
        pass: &Pass,
        timestamp_writes: Option<wgpu::ComputePassTimestampWrites<'_>>,
    ) -> Vec<f32> {
        let [positions, normals] = shot.g_buffer();
        let positions = self.filled(TextureFormat::Rgba32Uint, &positions);
        let normals = self.filled(TextureFormat::Rgba32Float, &normals);
        let usage = TextureUsages::STORAGE_BINDING | TextureUsages::COPY_SRC;
        let openness = self.texture(TextureFormat::R32Float, usage);
        let view = openness.create_view(&wgpu::TextureViewDescriptor::default());
        let g_buffer = pass.g_buffer(&self.device, &positions, &normals, &view);
        let mut encoder = self.encoder();
        {
            let mut run = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes,
            });
            pass.encode(&mut run, buffers, &g_buffer);
        }
        self.submit(encoder);
        self.read_texture(&openness)
    }

    fn read_texture(&self, texture: &wgpu::Texture) -> Vec<f32> {
        let row_bytes = (WIDTH * 4).next_multiple_of(256);
        let copy = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: (row_bytes * HEIGHT) as u64,
            usage: wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.encoder();
        let target = wgpu::TexelCopyBufferInfo {
            buffer: &copy,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row_bytes as u32),
                rows_per_image: None,
            },
        };
        encoder.copy_texture_to_buffer(texture.as_image_copy(), target, texture.size());
        self.submit(encoder);
        let bytes = self.read(&copy);
        let rows = bytes.chunks(row_bytes).map(|row| &row[..WIDTH * 4]);
        rows.flat_map(bytemuck::pod_collect_to_vec::<u8, f32>)
            .collect()
    }
}

// ---------------------------------------------------------------- the picture

/// The test that measures time has it to itself, as all of them draw with the same processor.
static TURN: RwLock<()> = RwLock::new(());

fn beside_others() -> RwLockReadGuard<'static, ()> {
    TURN.read().unwrap_or_else(PoisonError::into_inner)
}

/// Shares of the scene's pixels that differ by more than 1/255 and 4/255, and the largest
/// difference.
fn compare(shot: &Shot, got: &[f32], expected: &[f32]) -> [f32; 3] {
    assert_eq!(got.len(), expected.len());
    // A NaN is as far off as can be.
    let off = got.iter().zip(expected).map(|(a, b)| (a - b).abs());
    let off: Vec<f32> = off
        .map(|v| if v.is_nan() { f32::INFINITY } else { v })
        .collect();
    let largest = off.iter().copied().fold(0.0, f32::max);
    let seen = shot.view.valid().iter().filter(|valid| **valid).count() as f32;
    let beyond = |steps: f32| off.iter().filter(|v| **v > steps * STEP).count() as f32 / seen;
    [beyond(1.0), beyond(4.0), largest]
}

fn assert_exact(shot: &Shot, what: &str, got: &[f32], kernel: Kernel) {
    let expected = shot.cpu(kernel);
    let varied = expected.iter().filter(|v| **v > 0.1 && **v < 0.9).count();
    assert!(
        varied > WIDTH * HEIGHT / 50,
        "{}: a dull picture",
        shot.name
    );
    let [one, _, largest] = compare(shot, got, &expected);
    assert!(
        one == 0.0,
        "{}, {what}, {kernel:?}: {one} of the pixels are off by more than 1/255, up to {largest}",
        shot.name
    );
}

#[test]
fn exact_is_the_cpus_lookup_on_every_pixel() {
    let _beside = beside_others();
    for shot in shots() {
        for kernel in [Kernel::Planar, Kernel::Paper] {
            let picture = GPU.picture(shot, kernel, Tier::Exact);
            assert_exact(shot, "compute pass", &picture, kernel);
        }
    }
}

#[test]
fn fast_is_exact_to_the_eye() {
    let _beside = beside_others();
    for shot in shots() {
        let picture = GPU.picture(shot, Kernel::Planar, Tier::Fast);
        let [one, four, largest] = compare(shot, &picture, &shot.cpu(Kernel::Planar));
        assert!(
            one < 0.001 && four == 0.0,
            "{}: {one} of the pixels are off by more than 1/255, {four} by more than 4/255, the \
             worst by {largest}",
            shot.name
        );
    }
}

/// Prints what both tiers take, and the lookup of the paper; docs/gpu.md tells how near the ratios
/// come to 3 where nothing else runs. Here other programs may, so this asks for a little less; the
/// other tests of this file wait meanwhile.
#[test]
fn fast_takes_fewer_milliseconds_than_either_exact_kernel() {
    let _alone = TURN.write().unwrap_or_else(PoisonError::into_inner);
    let gpu = Gpu::new(wgpu::Features::TIMESTAMP_QUERY);
    let set = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
        label: None,
        ty: wgpu::QueryType::Timestamp,
        count: 2,
    });
    let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 16,
        usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    for shot in shots() {
        let buffers = gpu.buffers(&shot.client);
        let passes = [
            (Kernel::Planar, Tier::Exact),
            (Kernel::Planar, Tier::Fast),
            (Kernel::Paper, Tier::Exact),
        ]
        .map(|(kernel, tier)| Pass::new(&gpu.device, &buffers, kernel, tier));
        let mut ms = [const { Vec::new() }; 3];
        // In turn, so that what else runs on the machine slows all of them.
        for _ in 0..40 {
            for (pass, ms) in passes.iter().zip(&mut ms) {
                let writes = wgpu::ComputePassTimestampWrites {
                    query_set: &set,
                    beginning_of_pass_write_index: Some(0),
                    end_of_pass_write_index: Some(1),
                };
                gpu.run_pass(shot, &buffers, pass, Some(writes));
                let mut encoder = gpu.encoder();
                encoder.resolve_query_set(&set, 0..2, &resolved, 0);
                gpu.submit(encoder);
                let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&gpu.read(&resolved));
                let period_ns = gpu.queue.get_timestamp_period();
                ms.push((ticks[1] - ticks[0]) as f32 * period_ns / 1e6);
            }
        }
        // The least of them: all else that runs only adds.
        let [exact, fast, paper] = ms.map(|ms| ms.into_iter().fold(f32::INFINITY, f32::min));
        println!(
            "{}, {WIDTH}x{HEIGHT}: fast {fast:.1} ms, exact planar {exact:.1} ({:.2} times as \
             many), exact paper {paper:.1} ({:.2})",
            shot.name,
            exact / fast,
            paper / fast
        );
        for (kernel, ms) in [("planar", exact), ("paper", paper)] {
            assert!(
                fast < 0.4 * ms,
                "{}: fast takes {fast} ms, exact {kernel} {ms} ms",
                shot.name
            );
        }
    }
}

#[test]
fn the_text_for_fragment_shaders_gives_the_same_picture() {
    let _beside = beside_others();
    let picture = drawn(&ATRIUM, "psao_planar_fast(instance, position, normal)");
    assert_exact(&ATRIUM, "fragment", &picture, Kernel::Planar);
}

#[test]
fn over_baked_values_the_shader_shows_what_the_cpu_does() {
    let _beside = beside_others();
    for (kernel, number) in [(Kernel::Paper, 0), (Kernel::Planar, 1)] {
        for share in [0.0, 0.5, 1.0] {
            let call =
                format!("psao_over_baked({number}u, instance, position, normal, 0.25, {share:?})");
            let picture = drawn(&ATRIUM, &call);
            let answers = ATRIUM.answers(kernel);
            let shown = |answer: &Option<Answer>| answer.map_or(1.0, |a| a.over_baked(0.25, share));
            let expected: Vec<f32> = answers.iter().map(shown).collect();
            let [one, _, largest] = compare(&ATRIUM, &picture, &expected);
            assert!(
                one == 0.0,
                "{kernel:?}, share {share}: {one}, up to {largest}"
            );
            let baked = answers.iter().flatten().filter(|a| a.near < 0.01).count();
            let streamed = answers.iter().flatten().filter(|a| a.near == 1.0).count();
            assert!(
                baked > 100 && streamed > WIDTH * HEIGHT / 4,
                "{baked}, {streamed}"
            );
        }
    }
}

/// A picture by a fragment shader that calls a lookup; 1 where nothing was drawn.
fn drawn(shot: &Shot, call: &str) -> Vec<f32> {
    let gpu = &*GPU;
    let shade = "
    let found = textureLoad(positions, vec2<i32>(at.xy), 0);
    let normal = textureLoad(normals, vec2<i32>(at.xy), 0).xyz;
    let position = bitcast<vec3<f32>>(found.xyz);
    let instance = found.w;
    if instance == 0xffffffffu {
        return vec4<f32>(1.0);
    }
";
    let text = psao_gpu::wgsl(1)
        + "
@group(0) @binding(0) var positions: texture_2d<u32>;
@group(0) @binding(1) var normals: texture_2d<f32>;
@vertex fn corner(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
@fragment fn shade(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {"
        + shade
        + "    return vec4<f32>("
        + call
        + ");
}";
    let module = gpu
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: None,
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
    let buffers = gpu.buffers(&shot.client);
    let texture = |binding, sample_type| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::FRAGMENT,
        ty: wgpu::BindingType::Texture {
            sample_type,
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        },
        count: None,
    };
    let entries = [
        texture(0, wgpu::TextureSampleType::Uint),
        texture(1, wgpu::TextureSampleType::Float { filterable: false }),
    ];
    let layout = gpu
        .device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: None,
            entries: &entries,
        });
    let pipeline_layout = gpu
        .device
        .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(&layout), Some(buffers.bind_group_layout())],
            immediate_size: 0,
        });
    let pipeline = gpu
        .device
        .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: None,
            layout: Some(&pipeline_layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("corner"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("shade"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                targets: &[Some(TextureFormat::R32Float.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
    let [positions, normals] = shot.g_buffer();
    let views = [
        gpu.filled(TextureFormat::Rgba32Uint, &positions),
        gpu.filled(TextureFormat::Rgba32Float, &normals),
    ];
    let entry = |binding: u32| wgpu::BindGroupEntry {
        binding,
        resource: wgpu::BindingResource::TextureView(&views[binding as usize]),
    };
    let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &layout,
        entries: &[entry(0), entry(1)],
    });
    let usage = TextureUsages::RENDER_ATTACHMENT | TextureUsages::COPY_SRC;
    let target = gpu.texture(TextureFormat::R32Float, usage);
    let view = target.create_view(&wgpu::TextureViewDescriptor::default());
    let mut encoder = gpu.encoder();
    {
        let mut run = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations::default(),
            })],
            ..wgpu::RenderPassDescriptor::default()
        });
        run.set_pipeline(&pipeline);
        run.set_bind_group(0, &group, &[]);
        run.set_bind_group(1, buffers.bind_group(), &[]);
        run.draw(0..3, 0..1);
    }
    gpu.submit(encoder);
    gpu.read_texture(&target)
}

#[test]
fn the_glsl_snippets_give_the_same_picture_in_an_es_3_1_context() {
    let _beside = beside_others();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("gles");
    std::fs::create_dir_all(&folder).unwrap();
    let program = folder.join("gles");
    run(Command::new("cc")
        .args([
            "-std=c99",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-pedantic",
            "-O1",
        ])
        .arg(root().join("tests/c/gles.c"))
        .args(["-lEGL", "-lGLESv2", "-o"])
        .arg(&program));
    for shot in shots() {
        let mirror = shot.client.mirror();
        let [positions, normals] = shot.g_buffer();
        let parts: [(&str, &[u8]); 5] = [
            ("instances", bytemuck::cast_slice(mirror.instances())),
            ("buckets", bytemuck::cast_slice(mirror.buckets())),
            ("cells", bytemuck::cast_slice(mirror.cells())),
            ("positions", &positions),
            ("normals", &normals),
        ];
        for (name, bytes) in parts {
            std::fs::write(folder.join(name), bytes).unwrap();
        }
        for snippet in ["psao_es310.glsl", "psao_es300.glsl"] {
            for (function, kernel) in [
                ("psao_planar", Kernel::Planar),
                ("psao_planar_fast", Kernel::Planar),
                ("psao_paper", Kernel::Paper),
            ] {
                let said = run(Command::new(&program)
                    .arg(root().join("sdk/shaders/generated").join(snippet))
                    .arg(function)
                    .arg(&folder)
                    .args([WIDTH.to_string(), HEIGHT.to_string()]));
                assert!(said.contains("OpenGL ES 3."), "not an ES context: {said}");
                let openness = std::fs::read(folder.join("openness")).unwrap();
                let openness: Vec<f32> = bytemuck::pod_collect_to_vec(&openness);
                assert_exact(shot, &format!("{snippet}, {function}"), &openness, kernel);
            }
        }
    }
}

/// Runs a program to its end, which must be a success.
fn run(command: &mut Command) -> String {
    let output = command
        .output()
        .unwrap_or_else(|error| panic!("{command:?}: {error}: tests/run installs it"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (stdout, stderr) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}:\n{stdout}{stderr}");
    stdout
}

// ---------------------------------------------------------------- uploads

#[test]
fn only_what_changed_is_uploaded_and_then_the_gpu_has_the_mirror() {
    let _beside = beside_others();
    let gpu = &*GPU;
    let mut stream = Stream::new(Scene::atrium(), 64.0, 16);
    let mut client = stream.client();
    let mut buffers = Buffers::new(&gpu.device, capacity_of(&stream.world)).unwrap();
    let mut later = 0;
    for frame in 0..24 {
        stream.next(&mut client, f64::from(frame) * 0.1);
        let mut encoder = gpu.encoder();
        let done = buffers.upload(&mut encoder, client.mirror());
        gpu.submit(encoder);
        client.clear_dirty();
        assert!(done.dirty_bytes > 0, "frame {frame} changes something");
        assert!(done.bytes >= done.dirty_bytes && done.bytes * 10 <= done.dirty_bytes * 11);
        if frame > 0 {
            later += done.bytes;
        }
        let again = buffers.upload(&mut gpu.encoder(), client.mirror());
        assert_eq!(
            again,
            psao_gpu::Uploaded::default(),
            "nothing is left to upload"
        );
        let mirror = client.mirror();
        assert_holds(&buffers, mirror, &format!("frame {frame}"));
    }
    let all = mirror_bytes(client.mirror());
    assert!(
        later < 23 * all / 4,
        "{later} bytes in 23 frames, of {all} a whole upload"
    );
}

/// The GPU's buffers are the mirror's, with tags in the buckets.
fn assert_holds<M: psao_core::mirror::Memory>(buffers: &Buffers, mirror: &Mirror<M>, when: &str) {
    let tagged = mirror.buckets().iter();
    let tagged: Vec<Bucket> = tagged
        .map(|bucket| psao_core::tags::tagged(bucket, mirror.cells()))
        .collect();
    let parts: [(Buffer, &[u8]); 3] = [
        (Buffer::Instances, bytemuck::cast_slice(mirror.instances())),
        (Buffer::Buckets, bytemuck::cast_slice(&tagged)),
        (Buffer::Cells, bytemuck::cast_slice(mirror.cells())),
    ];
    for (kind, expected) in parts {
        let got = GPU.read(buffers.buffer(kind));
        assert!(got.starts_with(expected), "{when}: {kind:?}");
    }
}

#[test]
fn a_cell_that_gets_another_key_in_the_same_entry_gets_another_tag() {
    let _beside = beside_others();
    let gpu = &*GPU;
    let capacity = Capacity {
        instances: 1,
        buckets: 4,
        cells: 8,
        ..Capacity::default()
    };
    let mut memory = (
        vec![Default::default(); 1],
        vec![Bucket::default(); 4],
        vec![Cell::default(); 8],
    );
    let mut dirty = vec![0; capacity.dirty_words()];
    let mut mirror = Mirror::new(Borrowed(PartsMut {
        instances: &mut memory.0,
        buckets: &mut memory.1,
        cells: &mut memory.2,
        dirty: &mut dirty,
    }));
    let mut buffers = Buffers::new(&gpu.device, capacity).unwrap();
    let entries = [3, 5, 0, 0, 0, 0, 0, 0];
    for (cell, keys) in [(3, [7, 7, 100]), (5, [9, 2000, 9])] {
        let with_key = |key| Cell {
            key,
            ..Cell::default()
        };
        for key in keys {
            mirror.set_cell(cell, with_key(key)).unwrap();
            mirror.set_bucket(2, Bucket { entries }).unwrap();
            let mut encoder = gpu.encoder();
            buffers.upload(&mut encoder, &mirror);
            gpu.submit(encoder);
            mirror.clear_dirty();
            assert_holds(&buffers, &mirror, &format!("cell {cell} with key {key}"));
        }
    }
}

#[test]
fn all_of_it_is_uploaded_again_into_buffers_that_were_made_anew() {
    let _beside = beside_others();
    let gpu = &*GPU;
    let mut stream = Stream::new(Scene::atrium(), 16.0, 16);
    let mut client = stream.client();
    stream.next(&mut client, 0.0);
    client.clear_dirty();
    client.mark_all_dirty();
    let buffers = gpu.buffers(&client);
    client.clear_dirty();
    assert_holds(&buffers, client.mirror(), "after a lost device");
}

fn mirror_bytes<M: psao_core::mirror::Memory>(mirror: &Mirror<M>) -> u64 {
    mirror.capacity().bytes()
}

#[test]
fn buffers_larger_than_the_device_allows_are_refused_with_the_limit() {
    let _beside = beside_others();
    let capacity = Capacity {
        instances: 1,
        buckets: 1,
        cells: (128 << 20) / 32 + 1,
        ..Capacity::default()
    };
    let error = Buffers::new(&GPU.device, capacity).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("max_storage_buffer_binding_size"),
        "{error}"
    );
    assert_eq!((error.buffer, error.limit_bytes), ("psao cells", 128 << 20));
}
