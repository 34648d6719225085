//! `psao bench-gpu`: the lookup against what an engine would use in its place, over the same
//! G-buffers, in milliseconds of the GPU and in error against ray-traced pictures.

use crate::args::{Layout, SceneArgs, camera_path};
use crate::camera::Frustum;
use crate::demo::parse_size;
use crate::encode::{Encoder, Limits, Scheme, View as Sight, capacity_of};
use crate::eval::percentile;
use crate::gpu::gbuffer::{GBuffer, Renderer};
use crate::gpu::screen::{self, HIGH, LOW, Source};
use crate::gpu::trace::GpuTracer;
use crate::gpu::{Gpu, Pass, Stopwatch};
use crate::metrics::Pair;
use crate::picture::{Picture, write_whole};
use crate::render::{REFERENCE_RAYS, View};
use crate::report::{Form, Panel, Plot, Report};
use crate::samples::Samples;
use crate::world::{Progress, World};
use clap::Args;
use glam::Vec3;
use psao::{Client, Config};
use psao_core::Kernel;
use psao_core::residual::Quantiser;
use psao_gpu::Tier;
use serde::Serialize;
use std::path::PathBuf;

/// Options of `psao bench-gpu`.
#[derive(Args, Clone, Debug)]
pub struct BenchGpuArgs {
    /// The scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Size of the pictures
    #[arg(long, value_name = "WxH", default_value = "480x270", value_parser = parse_size)]
    pub size: (usize, usize),
    /// Places along the camera path
    #[arg(long, value_name = "N", default_value_t = 3,
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub frames: u32,
    /// Which of the two camera paths to walk
    #[arg(long, value_name = "N", default_value_t = 1,
          value_parser = clap::value_parser!(u32).range(0..=1))]
    pub path: u32,
    /// Writes the figures as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Folder for report.html, with the plot, and pictures of the first 4 frames as PNG
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Also one ray a pixel by the device's own ray queries, where it has them. wgpu calls them
    /// experimental: a faulty driver may do anything
    #[arg(long)]
    pub ray_query: bool,
}

/// Seconds between two places along the path.
const STEP_S: f64 = 2.0;

/// Times that each method runs on each frame, all in turn, so that what else the machine does
/// meets all of them alike.
const ROUNDS: usize = 15;

/// Passes of the denoiser behind rays: as after the better screen-space method.
const DENOISE_RAYS: u32 = HIGH.denoise;

/// The lookups written plainly: the stream's own kernel, and the paper's over the same points, which
/// lie as the former wants them.
const EXACT: [&str; 2] = ["lookup, exact", "lookup, exact, paper kernel"];

/// How many times fewer milliseconds than either exact lookup the fast one is to take.
const FAST_GOAL: f64 = 3.0;

/// The method that not every device has.
const RAY_QUERY: &str = "1 ray a pixel, ray query";

/// Most pixels that it may answer otherwise: a ray along an edge may round to either side of it.
const QUERY_OFF_SHARE: f64 = 1e-3;

/// Frames of which pictures are kept.
const PICTURES: u32 = 4;

/// Rays a pixel of one call, so that no call takes long.
const RAYS_A_CALL: u32 = 32;

/// One method; the names are those of the JSON file.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// What it is.
    pub method: &'static str,
    /// Median milliseconds of the GPU for all its passes.
    pub median_ms: f64,
    /// 95th percentile of the same.
    pub p95_ms: f64,
    /// Its median over that of the fast lookup.
    pub over_fast: f64,
    /// Against the reference, over the pixels of all frames.
    pub psnr_db: f64,
    /// Mean FLIP against the reference.
    pub flip: f64,
    /// Each pass.
    pub passes: Vec<PassRow>,
}

/// One pass of a method.
#[derive(Clone, Debug, Serialize)]
pub struct PassRow {
    /// What it is.
    pub pass: &'static str,
    /// Median milliseconds.
    pub median_ms: f64,
    /// 95th percentile.
    pub p95_ms: f64,
}

/// What a run found; the names are those of the JSON file.
#[derive(Clone, Debug, Serialize)]
pub struct Race {
    /// Name and driver of the device.
    pub adapter: String,
    /// `Cpu` where the processor computes in a GPU's place: then milliseconds say nothing about
    /// GPUs, and ratios little.
    pub device_type: String,
    /// Scene file or `atrium`.
    pub scene: String,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// G-buffers.
    pub frames: u32,
    /// Points per square metre and side.
    pub density: f64,
    /// Metres that occluders count for.
    pub ao_distance_m: f32,
    /// Largest difference of the exact lookup from the processor's, 1/255.
    pub exact_off_255: f64,
    /// Share of pixels where the fast lookup is more than 1/255 off the exact one.
    pub fast_off_share: f64,
    /// Largest difference of the two, 1/255.
    pub fast_off_255: f64,
    /// Why no row is by the device's own ray queries, if none is.
    pub no_ray_query: Option<&'static str>,
    /// Share of the pixels whose ray the device's own query answers otherwise; 0 without.
    pub query_off_share: f64,
    /// One a method.
    pub rows: Vec<Row>,
}

/// A method as it is measured.
struct Method {
    name: &'static str,
    passes: Vec<&'static str>,
    /// Of each pass, milliseconds.
    ms: Vec<Vec<f64>>,
    squares: f64,
    flip: f64,
    panels: Vec<(String, Picture)>,
}

/// A method's work on one G-buffer.
enum Work<'a> {
    Lookup(&'a psao_gpu::Pass, psao_gpu::GBuffer),
    Passes(Vec<Pass>),
}

impl Work<'_> {
    fn names(&self) -> Vec<&'static str> {
        match self {
            Work::Lookup(..) => vec!["lookup"],
            Work::Passes(passes) => passes.iter().map(|pass| pass.name).collect(),
        }
    }

    /// Records all passes, with `after` behind each.
    fn record(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        buffers: &psao_gpu::Buffers,
        mut after: impl FnMut(&mut wgpu::CommandEncoder),
    ) {
        match self {
            Work::Lookup(pass, target) => {
                pass.encode(
                    &mut encoder.begin_compute_pass(&Default::default()),
                    buffers,
                    target,
                );
                after(encoder);
            }
            Work::Passes(passes) => {
                for pass in passes {
                    pass.record(encoder);
                    after(encoder);
                }
            }
        }
    }
}

/// Runs the race.
///
/// # Errors
/// What went wrong, and what to do about it: no GPU, none with timestamps, or a lookup or rays that
/// are not what they have to be.
pub fn run(args: &BenchGpuArgs, progress: Progress<'_>) -> Result<Race, String> {
    let experimental = if args.ray_query {
        psao_experimental::ray_queries()
    } else {
        wgpu::ExperimentalFeatures::disabled()
    };
    let gpu = Gpu::open_with(experimental)?;
    let mut watch = Stopwatch::new(&gpu)?;
    let mut world = args.scene.world(Layout::Patches, progress)?;
    let size = [args.size.0 as u32, args.size.1 as u32];
    let path = camera_path(&world, args.path, args.size.0 as f32 / args.size.1 as f32)?;
    let time_of = |frame: u32| f64::from(frame) * STEP_S;
    let views: Vec<Frustum> = (0..args.frames)
        .map(|frame| Frustum::new(&path.at(time_of(frame)), 0.0))
        .collect();
    let seen = |[min, max]: [Vec3; 2]| views.iter().any(|view| view.sees_box(min, max));
    let converging = |done, total| progress("convergence", done, total);
    world.converge(&seen, world.options.rays, &converging);

    let mut stream = Follower::new(&world);
    let too_large = |error: psao_gpu::TooLarge| error.to_string();
    let mut buffers =
        psao_gpu::Buffers::new(&gpu.device, capacity_of(&world)).map_err(too_large)?;
    let kernel = world.options.kernel;
    let lookups = [
        (kernel, Tier::Exact),
        (kernel, Tier::Fast),
        (Kernel::Paper, Tier::Exact),
    ]
    .map(|(kernel, tier)| psao_gpu::Pass::new(&gpu.device, &buffers, kernel, tier));
    let mut renderer = Renderer::new(&gpu, &world.scene, true)?;
    let samples = Samples::new(REFERENCE_RAYS);
    let mut tracer = GpuTracer::new(&gpu, &world.scene, &world.pose, &samples)?;
    let mut buffer = GBuffer::new(&gpu, size[0], size[1])?;
    let openness = gpu.openness(size)?;
    let rays = gpu.openness(size)?;

    let mut race = Race {
        adapter: gpu.name(),
        device_type: format!("{:?}", gpu.info.device_type),
        scene: world.scene.name.clone(),
        size: [args.size.0, args.size.1],
        frames: args.frames,
        density: args.scene.density,
        ao_distance_m: args.scene.ao_distance,
        exact_off_255: 0.0,
        fast_off_share: 0.0,
        fast_off_255: 0.0,
        no_ray_query: gpu.no_ray_query,
        query_off_share: 0.0,
        rows: Vec::new(),
    };
    let mut methods: Vec<Method> = Vec::new();
    let (mut pixels, mut off, mut query_off) = (0.0, 0.0, 0.0);
    let mut references = Vec::new();
    for frame in 0..args.frames {
        let camera = path.at(time_of(frame));
        world.step(time_of(frame), &seen, u64::MAX);
        // One frame of the stream stands for many at this place: what a view that lasts would have
        // found by looking comes at once.
        let sight = Sight {
            sees: &seen,
            eye: None,
        };
        stream.follow(&world, (time_of(frame) * 1e9) as u64, &sight)?;
        world.clear_changes();
        renderer.pose(&gpu, &world.scene, &world.pose);
        tracer.pose(&gpu, &world.scene, &world.pose)?;
        let mut encoder = gpu.encoder();
        buffers.upload(&mut encoder, stream.client.mirror());
        stream.client.clear_dirty();
        renderer.draw(&gpu, &world.scene, &camera, &mut encoder, &mut buffer);
        gpu.finish(encoder)?;
        let view = buffer.view(&gpu)?;
        let reach = world.options.ao_distance_m;
        let traced = |first, rays_a_pixel, into: &_| {
            tracer.pixels(&gpu, &buffer, &renderer, into, reach, [first, rays_a_pixel])
        };

        progress("reference", u64::from(frame), u64::from(args.frames));
        // The processor's tracer is the faster one where there is no other device.
        let reference = if gpu.info.device_type == wgpu::DeviceType::Cpu {
            view.trace(&world, &samples)
        } else {
            for first in (0..REFERENCE_RAYS as u32).step_by(RAYS_A_CALL as usize) {
                let mut encoder = gpu.encoder();
                traced(first, RAYS_A_CALL, &rays).record(&mut encoder);
                gpu.finish(encoder)?;
            }
            gpu.read_texture(&rays)?
        };

        let into = |texture: &wgpu::Texture| texture.create_view(&Default::default());
        let targets = [
            into(&buffer.position),
            into(&buffer.normal),
            into(&openness),
        ];
        let lookup = |pass: usize| {
            let [position, normal, openness] = &targets;
            let target = lookups[pass].g_buffer(&gpu.device, position, normal, openness);
            Work::Lookup(&lookups[pass], target)
        };
        let in_screen = |quality| {
            let source = Source::screen(quality, world.options.ao_distance_m);
            screen::passes(&gpu, &buffer, source, &openness).map(Work::Passes)
        };
        let mut denoised = vec![traced(0, 1, &rays)];
        let source = Source::Picture(&rays, DENOISE_RAYS);
        denoised.extend(screen::passes(&gpu, &buffer, source, &openness)?);
        let mut works = vec![
            ("lookup, fast", lookup(1)),
            (EXACT[0], lookup(0)),
            (EXACT[1], lookup(2)),
            ("screen space, low", in_screen(LOW)?),
            ("screen space, high", in_screen(HIGH)?),
            ("1 ray a pixel", Work::Passes(vec![traced(0, 1, &openness)])),
            ("1 ray a pixel, denoised", Work::Passes(denoised)),
        ];
        let query = tracer.pixels_by_query(&gpu, &buffer, &renderer, &openness, reach, [0, 1]);
        works.extend(query.map(|pass| (RAY_QUERY, Work::Passes(vec![pass]))));

        let valid = view.valid();
        let count = valid.iter().filter(|valid| **valid).count() as f64;
        pixels += count;
        let mut exact: Vec<f32> = Vec::new();
        let mut fast: Vec<f32> = Vec::new();
        let mut by_trees: Vec<f32> = Vec::new();
        for (index, (name, work)) in works.iter().enumerate() {
            let mut encoder = gpu.encoder();
            work.record(&mut encoder, &buffers, |_| ());
            gpu.finish(encoder)?;
            let found: Vec<f32> = gpu.read_texture(&openness)?;
            if methods.len() == index {
                methods.push(Method {
                    name,
                    passes: work.names(),
                    ms: vec![Vec::new(); work.names().len()],
                    squares: 0.0,
                    flip: 0.0,
                    panels: Vec::new(),
                });
            }
            let pair = Pair::new(&reference, &found, &valid, args.size.0, args.size.1)?;
            methods[index].squares += pair.rmse().powi(2) * count;
            methods[index].flip += pair.flip() / f64::from(args.frames);
            if frame < PICTURES {
                let picture = Picture::grey(&found, &valid, args.size.0, args.size.1);
                methods[index].panels.push(((*name).into(), picture));
            }
            match index {
                0 => fast = found,
                1 => exact = found,
                5 => by_trees = found,
                7 => {
                    let differ = found.iter().zip(&by_trees).filter(|(a, b)| a != b);
                    query_off += differ.count() as f64;
                }
                _ => {}
            }
        }
        race.exact_off_255 = race
            .exact_off_255
            .max(check(&view, &stream.client, kernel, &exact)?);
        let mut over = 0;
        for (fast, exact) in fast.iter().zip(&exact) {
            let off_255 = f64::from((fast - exact).abs()) * 255.0;
            race.fast_off_255 = race.fast_off_255.max(off_255);
            over += usize::from(off_255 > 1.0);
        }
        off += over as f64;
        race.fast_off_share = off / pixels.max(1.0);
        race.query_off_share = query_off / pixels.max(1.0);
        if race.query_off_share > QUERY_OFF_SHARE {
            return Err(format!(
                "the device's own ray queries answer {:.4} of the rays otherwise than the trees: \
                 please report it, with this device's name: {}",
                race.query_off_share, race.adapter
            ));
        }

        for round in 0..ROUNDS {
            for turn in 0..works.len() {
                let index = (round + turn) % works.len();
                let mut encoder = gpu.encoder();
                watch.mark(&mut encoder);
                works[index]
                    .1
                    .record(&mut encoder, &buffers, |encoder| watch.mark(encoder));
                let times = watch.finish(&gpu, encoder)?;
                for (all, ms) in methods[index].ms.iter_mut().zip(times) {
                    all.push(ms);
                }
            }
            let all = u64::from(args.frames) * ROUNDS as u64;
            progress(
                "race",
                u64::from(frame) * ROUNDS as u64 + round as u64 + 1,
                all,
            );
        }
        if frame < PICTURES {
            let picture = Picture::grey(&reference, &valid, args.size.0, args.size.1);
            references.push(picture);
        }
    }
    if race.fast_off_share > 1e-3 || race.fast_off_255 > 4.0 {
        return Err(format!(
            "the fast lookup is up to {:.2}/255 off the exact one, and more than 1/255 in {:.4} of \
             the pixels: please report it, with this device's name: {}",
            race.fast_off_255, race.fast_off_share, race.adapter
        ));
    }
    race.rows = rows(&methods, pixels);
    race.write(args, methods, references)?;
    Ok(race)
}

/// How far the GPU's exact lookup is off the processor's at most, 1/255.
fn check(view: &View, client: &Client, kernel: Kernel, found: &[f32]) -> Result<f64, String> {
    let expected = view.blend(client.mirror().lookup(), kernel).openness;
    let off = |(a, b): (&f32, &f32)| f64::from((a - b).abs()) * 255.0;
    let most = found.iter().zip(&expected).map(off).fold(0.0, f64::max);
    // NaN is off, too.
    if most <= 1.0 && found.iter().all(|v| v.is_finite()) {
        Ok(most)
    } else {
        Err(format!(
            "the exact lookup on the GPU is {most:.2}/255 off the processor's: please report it, \
             with the device's name"
        ))
    }
}

fn rows(methods: &[Method], pixels: f64) -> Vec<Row> {
    let totals = |method: &Method| -> Vec<f64> {
        let runs = 0..method.ms[0].len();
        runs.map(|run| method.ms.iter().map(|pass| pass[run]).sum())
            .collect()
    };
    let fast_ms = percentile(&totals(&methods[0]), 0.5);
    let row = |method: &Method| {
        let totals = totals(method);
        let median_ms = percentile(&totals, 0.5);
        let passes = method.passes.iter().zip(&method.ms);
        Row {
            method: method.name,
            median_ms,
            p95_ms: percentile(&totals, 0.95),
            over_fast: median_ms / fast_ms,
            psnr_db: -10.0 * (method.squares / pixels).log10(),
            flip: method.flip,
            passes: passes
                .map(|(pass, ms)| PassRow {
                    pass,
                    median_ms: percentile(ms, 0.5),
                    p95_ms: percentile(ms, 0.95),
                })
                .collect(),
        }
    };
    methods.iter().map(row).collect()
}

impl Race {
    /// All rows as a table, and what they are of.
    pub fn table(&self) -> String {
        let mut out = format!(
            "{} ({}), {} x {}, {} frames of {}, {} points/m2\n\n",
            self.adapter,
            self.device_type,
            self.size[0],
            self.size[1],
            self.frames,
            self.scene,
            self.density
        );
        let line = |cells: [String; 6]| {
            let [method, rest @ ..] = cells;
            let rest: Vec<String> = rest.iter().map(|cell| format!("{cell:>9}")).collect();
            format!("| {method:27} | {} |\n", rest.join(" | "))
        };
        let heads = [
            "method or pass",
            "median ms",
            "p95 ms",
            "/ fast",
            "PSNR dB",
            "FLIP",
        ];
        out += &line(heads.map(String::from));
        out += &line([
            "-".repeat(27),
            "-".repeat(9),
            "-".repeat(9),
            "-".repeat(9),
            "-".repeat(9),
            "-".repeat(9),
        ]);
        for row in &self.rows {
            out += &line([
                row.method.into(),
                format!("{:.3}", row.median_ms),
                format!("{:.3}", row.p95_ms),
                format!("{:.2}", row.over_fast),
                format!("{:.2}", row.psnr_db),
                format!("{:.4}", row.flip),
            ]);
            for pass in row.passes.iter().filter(|_| row.passes.len() > 1) {
                out += &line([
                    format!("  {}", pass.pass),
                    format!("{:.3}", pass.median_ms),
                    format!("{:.3}", pass.p95_ms),
                    String::new(),
                    String::new(),
                    String::new(),
                ]);
            }
        }
        if let Some(why) = self.no_ray_query {
            out += &format!("| {RAY_QUERY:27} | {why}\n");
        }
        out += &format!(
            "\nexact lookup off the processor's: at most {:.3}/255; fast off exact: at most \
             {:.3}/255, more than 1/255 in {:.4} % of the pixels\n",
            self.exact_off_255,
            self.fast_off_255,
            self.fast_off_share * 100.0
        );
        let exact = self.rows.iter().filter(|row| EXACT.contains(&row.method));
        let over = exact.map(|row| row.over_fast).fold(f64::INFINITY, f64::min);
        out += &format!(
            "fast lookup: at least {over:.2} times fewer ms than either exact one, {} the goal of \
             {FAST_GOAL}\n",
            if over >= FAST_GOAL {
                "within"
            } else {
                "short of"
            }
        );
        if self.no_ray_query.is_none() {
            out += &format!(
                "ray queries answer otherwise than the trees in {:.4} % of the pixels\n",
                self.query_off_share * 100.0
            );
        }
        out
    }

    fn write(
        &self,
        args: &BenchGpuArgs,
        methods: Vec<Method>,
        references: Vec<Picture>,
    ) -> Result<(), String> {
        let failed = |error: std::io::Error| error.to_string();
        if let Some(path) = &args.json {
            let json = serde_json::to_string_pretty(self).map_err(|error| error.to_string())?;
            write_whole(path, json.as_bytes()).map_err(failed)?;
        }
        let Some(folder) = &args.out else {
            return Ok(());
        };
        let mut panels: Vec<Panel> = references
            .into_iter()
            .enumerate()
            .map(|(frame, picture)| Panel {
                title: format!("Frame {frame}"),
                caption: String::new(),
                pictures: vec![("reference, 512 rays a pixel".into(), picture)],
            })
            .collect();
        for method in methods {
            for (panel, picture) in panels.iter_mut().zip(method.panels) {
                panel.pictures.push(picture);
            }
        }
        for (frame, panel) in panels.iter().enumerate() {
            for (name, picture) in &panel.pictures {
                let name = name.replace(", ", "-").replace(' ', "-");
                picture
                    .write_png(&folder.join(format!("{frame}-{name}.png")))
                    .map_err(failed)?;
            }
        }
        let plot = |title: &str, x_label: &str, x: &dyn Fn(&Row) -> f64| Plot {
            title: title.into(),
            x_label: x_label.into(),
            y_label: "ms (median)".into(),
            series: self
                .rows
                .iter()
                .map(|row| (row.method.into(), vec![(x(row), row.median_ms)]))
                .collect(),
            log_y: true,
            form: Form::Marks,
        };
        let summary = self.rows.iter().map(|row| {
            (
                row.method.into(),
                format!(
                    "{:.3} ms (p95 {:.3}), {:.2} dB, FLIP {:.4}",
                    row.median_ms, row.p95_ms, row.psnr_db, row.flip
                ),
            )
        });
        let report = Report {
            title: format!("PSAO bench-gpu: {} on {}", self.scene, self.adapter),
            summary: summary.collect(),
            panels,
            plots: vec![
                plot(
                    "Error and time",
                    "PSNR against 512 rays a pixel (dB)",
                    &|r| r.psnr_db,
                ),
                plot(
                    "Visible error and time",
                    "FLIP against 512 rays a pixel",
                    &|r| r.flip,
                ),
            ],
        };
        report.write(&folder.join("report.html")).map_err(failed)
    }
}

/// A client that is sent the stream of a world, without a network.
struct Follower {
    encoder: Encoder,
    client: Client,
    bytes: Vec<u8>,
}

impl Follower {
    fn new(world: &World) -> Follower {
        let scene_hash = world.scene.hash();
        // As a live server's defaults.
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        let mut encoder = Encoder::new(world, Scheme::Residual(quantiser, Limits::default()), 0);
        let bytes = encoder.header(world, scene_hash, 30.0);
        Follower {
            encoder,
            client: Client::new(Config {
                capacity: capacity_of(world),
                scene_hash,
            }),
            bytes,
        }
    }

    fn follow(&mut self, world: &World, time_ns: u64, sight: &Sight<'_>) -> Result<(), String> {
        self.encoder.merge(world);
        self.encoder
            .frame(world, time_ns, sight, true, &mut self.bytes);
        let mut rest = &self.bytes[..];
        while !rest.is_empty() {
            let pushed = self.client.push(rest).map_err(|error| error.to_string())?;
            rest = &rest[pushed.consumed..];
        }
        self.bytes.clear();
        Ok(())
    }
}
