//! `psao eval`: what each profile costs and how far off it is, for every density, rate and
//! quantiser, on the same frames of one scene and without a network.
//!
//! All streams of a profile and rate are encoded and decoded side by side over the same steps of
//! one world, so they differ in nothing but the quantiser. The two profiles need a world each (one
//! in rest space), which trace the same rays along the same camera path. How long decoding takes is
//! measured afterwards, for the streams of both by turns.

pub mod convergence;
pub mod kernels;
mod variants;

use crate::args::{Layout, PlacementArg, ProfileArg, SceneArgs, camera_path};
use crate::camera::{Camera, CameraPath, Frustum};
use crate::demo::parse_size;
use crate::encode::{Compression, Encoder, Eye, Limits, Scheme, View as Sight, capacity_of};
use crate::metrics::Pair;
use crate::picture::write_whole;
use crate::render::{REFERENCE_RAYS, View};
use crate::report::{Form, Plot, Report};
use crate::samples::Samples;
use crate::world::{Progress, World};
use clap::Args;
use glam::Vec3;
use psao::{Client, Config};
use psao_core::Cell;
use psao_core::mirror::Buffer;
use psao_core::residual::Quantiser;
use psao_core::stream::{MAX_BODY_BYTES, PREAMBLE, Packet, kind};
use psao_core::topology::LEVELS;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

/// Profile `cells` is measured as the paper's: this threshold, and zstd level 15, strategy 4.
const CELLS: Scheme = Scheme::Cells {
    threshold: 2,
    compression: Compression::Paper,
};

/// As the live server's default.
const MARGIN_DEGREES: f32 = 10.0;

/// Most memory that the streams measured side by side may take, bytes.
const MAX_STREAMS_BYTES: u64 = 16 << 30;

/// How often each frame is decoded for its time.
const DECODE_ROUNDS: usize = 5;

/// Most values a list option takes: each multiplies the work.
const MAX_VALUES: usize = 16;

/// Options of `psao eval`.
#[derive(Args, Clone, Debug)]
pub struct EvalArgs {
    /// The scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Stream profiles to compare
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_value = "cells,residual"
    )]
    pub profiles: Vec<ProfileArg>,
    /// Server frames per second
    #[arg(
        long,
        value_name = "HZ,...",
        value_delimiter = ',',
        default_value = "15,60"
    )]
    pub rates: Vec<f64>,
    /// Points per square metre and side; without it, that of --density
    #[arg(long, value_name = "N,...", value_delimiter = ',')]
    pub densities: Vec<f64>,
    /// Quantisers of profile residual, 1/255: the step, and the dead zone if it is not 0.65 steps
    #[arg(
        long,
        value_name = "STEP[/DEADZONE],...",
        value_delimiter = ',',
        default_value = "1/0,2,3,4,6,8",
        value_parser = parse_quantiser
    )]
    pub steps: Vec<Quantiser>,
    /// Points a pixel that far instances are thinned to (profile residual), each measured by
    /// itself; 0 for all points always. More rows of --size ask for more points
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "0")]
    pub points_per_pixel: Vec<f32>,
    /// Most bits a second in the steady frames, in millions (profile residual), each measured by
    /// itself; 0 for no limit
    #[arg(
        long,
        value_name = "MBIT,...",
        value_delimiter = ',',
        default_value = "0"
    )]
    pub max_mbit: Vec<f64>,
    /// Frames at each rate. The first second is reported apart; of less than two seconds, the
    /// first half where that is shorter
    #[arg(long, value_name = "N", default_value_t = 60,
          value_parser = clap::value_parser!(u32).range(2..=100_000))]
    pub frames: u32,
    /// Kernels to compare instead of profiles: paper, paper-nearest, band, planar, planar-unfaded,
    /// planar-dark, least-squares, each with its radius over rm and cell size over the radius if
    /// they are not the usual ones
    #[arg(long, value_name = "NAME[@R[/C]],...", value_delimiter = ',')]
    pub kernels: Vec<kernels::Variant>,
    /// Points that a cell holds (with --kernels)
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "7",
          value_parser = clap::value_parser!(u8).range(1..=15))]
    pub capacities: Vec<u8>,
    /// How points are spread (with --kernels)
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_value = "uniform,adaptive"
    )]
    pub placements: Vec<PlacementArg>,
    /// Which of the two camera paths to walk: tune (or 0) and check (or 1)
    #[arg(long, value_name = "PATH", default_value = "check", value_parser = parse_path)]
    pub path: u32,
    /// The camera stands where the path begins: steady frames hold only what movers change
    #[arg(long, conflicts_with = "kernels")]
    pub standing: bool,
    /// Frames at each rate that are compared with a ray-traced picture
    #[arg(long, value_name = "N", default_value_t = 2,
          value_parser = clap::value_parser!(u32).range(1..=64))]
    pub pictures: u32,
    /// Size of those pictures
    #[arg(long, value_name = "WxH", default_value = "320x180", value_parser = parse_size)]
    pub size: (usize, usize),
    /// Writes the figures as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Folder for report.html, with the plots
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

fn parse_path(text: &str) -> Result<u32, String> {
    match text {
        "tune" | "0" => Ok(0),
        "check" | "1" => Ok(1),
        _ => Err(format!("{text} is neither tune nor check")),
    }
}

fn parse_quantiser(text: &str) -> Result<Quantiser, String> {
    let parse = || {
        let (step, dead_zone) = match text.split_once('/') {
            Some((step, dead_zone)) => (step.parse().ok()?, Some(dead_zone.parse().ok()?)),
            None => (text.parse().ok()?, None),
        };
        let usual = (0.65 * f32::from(step)).round() as u8;
        (step > 0).then_some(Quantiser {
            step,
            dead_zone: dead_zone.unwrap_or(usual),
        })
    };
    parse().ok_or_else(|| format!("{text} is not a step of 1 to 255, such as 3, or 3/2"))
}

/// One profile at one density, rate and quantiser; the names are those of the JSON file.
///
/// Unless it says otherwise, a figure is of the steady frames: those after the first second.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    /// Scene file or `atrium`.
    pub scene: String,
    /// Stream profile.
    pub profile: &'static str,
    /// Points per square metre and side.
    pub density: f64,
    /// Frames per second of scene time.
    pub rate_hz: f64,
    /// What is not sent, and how coarse what is, in 1/255.
    pub quant: String,
    /// Points a pixel that far instances are thinned to; 0 for all points.
    pub points_per_pixel: f32,
    /// Most megabits a second in the steady frames; 0 for no limit.
    pub max_mbit: f64,
    /// Megabits per second of scene time.
    pub mbit_per_s: f64,
    /// The part of it that is occlusion alone, in slices packets (profile `residual`).
    pub mbit_per_s_slices: f64,
    /// The part of it that is where points are (profile `residual`): what a client with the scene's
    /// topology at hand is not sent.
    pub mbit_per_s_topology: f64,
    /// All of it, over the frames before the steady ones, with the stream's header.
    pub mbit_per_s_first_second: f64,
    /// Root mean square difference of the client's visible points from the server's, 1/255.
    pub rmse_255: f64,
    /// AO alone against the reference, over the pixels of all pictures; `null` if none shows the
    /// scene.
    pub psnr_db: Option<f64>,
    /// Mean FLIP of the pictures; `null` if none shows the scene.
    pub flip: Option<f64>,
    /// Median milliseconds that the client takes for a frame's bytes, on one thread; of each frame the
    /// median of several times.
    pub decode_ms: f64,
    /// 99th percentile of the same.
    pub decode_p99_ms: f64,
    /// Median milliseconds of coding and packing a frame, on one thread: what compares coders.
    pub encode_ms: f64,
    /// Median milliseconds of finding what of a frame the client lacks, on all threads: what coding
    /// and packing leave of the frame's time.
    pub select_ms: f64,
    /// Median milliseconds of the world's step, on all threads; shared by all clients.
    pub step_ms: f64,
    /// 99th percentile of the same.
    pub step_p99_ms: f64,
    /// Median milliseconds of a step and then a frame for one client.
    pub frame_ms: f64,
    /// 99th percentile of the same.
    pub frame_p99_ms: f64,
    /// Rays traced a frame.
    pub rays_per_frame: f64,
    /// Points of the client's buffers that a frame changed.
    pub points_changed_per_frame: f64,
    /// Share of the cells of what is in view that the client has not got for being open.
    pub cells_skipped_share: f64,
    /// Memory of the client: buffers and all.
    pub client_bytes: u64,
    /// The first frame: all that is in view.
    pub first_frame_bytes: u64,
}

/// Profile `cells` against profile `residual` at the point error of `cells`, neither with a limit
/// of bits.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// Points per square metre and side.
    pub density: f64,
    /// Frames per second of scene time.
    pub rate_hz: f64,
    /// Points a pixel of `residual`; 0 for all points.
    pub points_per_pixel: f32,
    /// Point error of `cells`, 1/255.
    pub rmse_255: f64,
    /// Bits of `cells` over bits of `residual`, interpolated to that error; `null` where there is
    /// nothing to interpolate between (one quantiser, or no bits).
    pub bits_cells_over_residual: Option<f64>,
    /// The same for a client that has the topology already.
    pub bits_cells_over_residual_shipped: Option<f64>,
    /// That error is outside of what the quantisers span.
    pub extrapolated: bool,
    /// Decode time of `residual` over that of `cells`, interpolated as the bits are; of the nearest
    /// quantiser where there is nothing to interpolate between.
    pub decode_residual_over_cells: f64,
    /// Encode time of `cells` over that of `residual`, in the same way.
    pub encode_cells_over_residual: f64,
}

/// What an evaluation found; the names are those of the JSON file.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Evaluation {
    /// Frames at each rate.
    pub frames: u32,
    /// Camera path.
    pub path: u32,
    /// The camera stood where it begins.
    pub standing: bool,
    /// One a profile, density, rate and quantiser.
    pub rows: Vec<Row>,
    /// One a density and rate, if both profiles were measured.
    pub comparisons: Vec<Comparison>,
    /// Kilobits of each frame, a row.
    #[serde(skip)]
    kbits: Vec<Vec<f64>>,
}

/// Frames that are reported apart from the steady ones.
fn left_out(frames: u32, rate_hz: f64) -> u32 {
    (rate_hz.ceil() as u32).min(frames / 2).max(1)
}

/// Runs the evaluation.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn run(args: &EvalArgs, progress: Progress<'_>) -> Result<Evaluation, String> {
    for (name, count) in [
        ("--profiles", args.profiles.len()),
        ("--rates", args.rates.len()),
        ("--densities", args.densities.len()),
        ("--steps", args.steps.len()),
        ("--points-per-pixel", args.points_per_pixel.len()),
        ("--max-mbit", args.max_mbit.len()),
    ] {
        if count > MAX_VALUES {
            return Err(format!("{name} takes at most {MAX_VALUES} values"));
        }
    }
    if !args.rates.iter().all(|rate| *rate > 0.0 && *rate <= 1000.0) {
        return Err("--rates must be above 0 and at most 1000".into());
    }
    let usable = |points: &f32| points.is_finite() && *points >= 0.0;
    if !args.points_per_pixel.iter().all(usable) {
        return Err("--points-per-pixel must be 0 (all points always) or more".into());
    }
    if !args.max_mbit.iter().all(|m| m.is_finite() && *m >= 0.0) {
        return Err("--max-mbit must be 0 (no limit) or more".into());
    }
    let mut bench = Bench {
        args,
        samples: Samples::new(REFERENCE_RAYS),
        references: BTreeMap::new(),
        recordings: Vec::new(),
    };
    let mut found = Evaluation {
        frames: args.frames,
        path: args.path,
        standing: args.standing,
        ..Evaluation::default()
    };
    let one = [args.scene.density];
    let densities = if args.densities.is_empty() {
        &one
    } else {
        &args.densities[..]
    };
    for &density in densities {
        for &profile in &args.profiles {
            bench.profile(profile, density, &mut found, progress)?;
        }
        for &rate_hz in &args.rates {
            for &points_per_pixel in &args.points_per_pixel {
                bench.time_decoding(&mut found, rate_hz, points_per_pixel)?;
                found.compare(density, rate_hz, points_per_pixel);
            }
        }
        bench.recordings.clear();
    }
    if let Some(path) = &args.json {
        let json = serde_json::to_string_pretty(&found).map_err(|error| error.to_string())?;
        write_whole(path, json.as_bytes()).map_err(|error| error.to_string())?;
    }
    if let Some(folder) = &args.out {
        let page = folder.join("report.html");
        found.report().write(&page).map_err(|e| e.to_string())?;
    }
    Ok(found)
}

/// What all rows share.
struct Bench<'a> {
    args: &'a EvalArgs,
    samples: Samples,
    /// Ray-traced pictures by rate and frame: the same for every profile and density.
    references: BTreeMap<(u64, u32), Vec<f32>>,
    /// Streams of the density at hand.
    recordings: Vec<Recording>,
}

/// A stream, to be decoded again.
struct Recording {
    /// Into [`Evaluation::rows`].
    row: usize,
    config: Config,
    /// Of each frame.
    bytes: Vec<Vec<u8>>,
    /// Its first steady frame.
    steady: usize,
}

impl Bench<'_> {
    fn profile(
        &mut self,
        profile: ProfileArg,
        density: f64,
        found: &mut Evaluation,
        progress: Progress<'_>,
    ) -> Result<(), String> {
        let args = self.args;
        let stage = |name: &str| format!("{} {density}/m² {name}", profile.name());
        let scene = SceneArgs {
            density,
            ..args.scene.clone()
        };
        let placing = |name: &str, done, total| progress(&stage(name), done, total);
        let layout = match profile {
            ProfileArg::Cells => Layout::Cells,
            ProfileArg::Residual => {
                Layout::of_patches(args.points_per_pixel.iter().any(|&p| p > 0.0))
            }
        };
        let mut world = scene.world(layout, &placing)?;
        // Streams in a group are measured side by side: those that keep the same points.
        let groups: Vec<Vec<Scheme>> = match profile {
            ProfileArg::Cells => vec![vec![CELLS]],
            ProfileArg::Residual => {
                let group = |&points_per_pixel: &f32| {
                    let schemes = args.max_mbit.iter().flat_map(|&max_mbit| {
                        let limits = Limits {
                            max_mbit,
                            points_per_pixel,
                            ..Limits::default()
                        };
                        let scheme = move |&quantiser| Scheme::Residual(quantiser, limits);
                        args.steps.iter().map(scheme)
                    });
                    schemes.collect()
                };
                args.points_per_pixel.iter().map(group).collect()
            }
        };
        bounded(&world, groups[0].len())?;
        let aspect = args.size.0 as f32 / args.size.1 as f32;
        let path = camera_path(&world, args.path, aspect)?;

        // All rays come first: the frames are to show what the stream can do, not how points
        // converge.
        let views: Vec<Frustum> = args
            .rates
            .iter()
            .flat_map(|&rate| (0..args.frames).map(move |frame| f64::from(frame) / rate))
            .map(|time| view(&args.camera(&path, time)))
            .collect();
        // Movers may come into view wherever they are now.
        let movers = bounds_of_movers(&world);
        let seen = |[min, max]: [Vec3; 2]| {
            let within = |of: &[Vec3; 2]| of[0].cmple(min).all() && max.cmple(of[1]).all();
            movers.iter().any(within) || views.iter().any(|view| view.sees_box(min, max))
        };
        let converging = |done, total| progress(&stage("convergence"), done, total);
        world.converge(&seen, world.options.rays, &converging);

        let runs = args.rates.iter();
        let runs = runs.flat_map(|&rate| groups.iter().map(move |group| (rate, group)));
        for (rate_hz, schemes) in runs {
            // Back to the start, with all that will be seen as it is then.
            world.eyes.clear();
            world.finest_levels.clear();
            world.step(0.0, &seen, u64::MAX);
            world.converge(&seen, world.options.rays, &|_, _| ());
            world.clear_changes();
            let name = format!("{rate_hz} Hz");
            let frames = |done, total| progress(&stage(&name), done, total);
            self.rate(&mut world, &path, rate_hz, schemes, found, &frames)?;
        }
        Ok(())
    }

    /// Streams of all schemes, side by side.
    fn rate(
        &mut self,
        world: &mut World,
        path: &CameraPath,
        rate_hz: f64,
        schemes: &[Scheme],
        found: &mut Evaluation,
        report: &dyn Fn(u64, u64),
    ) -> Result<(), String> {
        let args = self.args;
        let mut streams: Vec<Stream> = schemes
            .iter()
            .map(|&scheme| Stream::new(world, scheme, rate_hz))
            .collect();
        let (mut step_ms, mut rays) = (Vec::new(), Vec::new());
        for frame in 0..args.frames {
            let time = f64::from(frame) / rate_hz;
            let camera = args.camera(path, time);
            let view = view(&camera);
            let visible = |[min, max]: [Vec3; 2]| view.sees_box(min, max);
            let sight = Sight {
                sees: &visible,
                eye: Some(Eye::of(&camera, args.size.1 as u32)),
            };
            let start = Instant::now();
            world.eyes = vec![camera.position];
            let finest = &mut world.finest_levels;
            finest.clear();
            finest.resize(world.scene.instances.len(), LEVELS);
            for stream in &streams {
                stream.encoder.want_levels(finest);
            }
            let step = world.step(time, &visible, u64::MAX);
            step_ms.push(ms(start));
            rays.push(step.rays as f64);
            let first = left_out(args.frames, rate_hz);
            for stream in &mut streams {
                if frame == first {
                    stream.limit();
                }
                stream.frame(world, (time * 1e9) as u64, &sight)?;
            }
            world.clear_changes();
            // The middle of each of as many equal parts of the steady frames.
            let steady = args.frames - first;
            let pictures = args.pictures.min(steady);
            let middle = |i| first + (2 * i + 1) * steady / (2 * pictures);
            if (0..pictures).any(|i| middle(i) == frame) {
                let view = View::new(world, &camera, args.size.0, args.size.1);
                let key = (rate_hz.to_bits(), frame);
                let trace = || view.trace(world, &self.samples);
                let reference = self.references.entry(key).or_insert_with(trace);
                streams.iter_mut().for_each(|s| s.look(&view, reference));
            }
            report(u64::from(frame) + 1, u64::from(args.frames));
        }
        let steady = left_out(args.frames, rate_hz) as usize;
        for mut stream in streams {
            self.recordings.push(Recording {
                row: found.rows.len(),
                config: stream.config,
                bytes: std::mem::take(&mut stream.sent),
                steady,
            });
            let cells = stream.encoder.cells(world);
            let steps = step_ms[steady..].iter();
            let frames = steps.zip(&stream.frames[steady..]);
            let frames: Vec<f64> = frames.map(|(step, own)| step + own.frame_ms).collect();
            found.kbits.push(stream.kbits());
            found.rows.push(Row {
                scene: world.scene.name.clone(),
                density: world.options.density,
                rate_hz,
                step_ms: percentile(&step_ms[steady..], 0.5),
                step_p99_ms: percentile(&step_ms[steady..], 0.99),
                frame_ms: percentile(&frames, 0.5),
                frame_p99_ms: percentile(&frames, 0.99),
                rays_per_frame: mean(&rays[steady..]),
                cells_skipped_share: cells
                    .map_or(0.0, |[has, all]| 1.0 - has as f64 / all.max(1) as f64),
                ..stream.row(steady, rate_hz)
            });
        }
        Ok(())
    }

    /// Decodes the streams that are compared again, one frame of each by turns, so that whatever else
    /// the machine does slows them alike. Between two frames of a stream come those of all others,
    /// which leave little of it in caches, as an engine would.
    fn time_decoding(
        &self,
        found: &mut Evaluation,
        rate_hz: f64,
        points_per_pixel: f32,
    ) -> Result<(), String> {
        let compared = |recording: &&Recording| {
            let row = &found.rows[recording.row];
            let thinned_alike = row.points_per_pixel == points_per_pixel;
            row.rate_hz == rate_hz && (thinned_alike || row.profile == ProfileArg::Cells.name())
        };
        let recordings: Vec<&Recording> = self.recordings.iter().filter(compared).collect();
        let mut times: Vec<Vec<Vec<f64>>> = recordings
            .iter()
            .map(|recording| vec![Vec::new(); recording.bytes.len()])
            .collect();
        for _ in 0..DECODE_ROUNDS {
            let mut clients: Vec<Client> = recordings
                .iter()
                .map(|recording| Client::new(recording.config))
                .collect();
            for frame in 0..self.args.frames as usize {
                for ((recording, client), times) in
                    recordings.iter().zip(&mut clients).zip(&mut times)
                {
                    let start = Instant::now();
                    push(client, &recording.bytes[frame])?;
                    times[frame].push(ms(start));
                    client.clear_dirty();
                }
            }
        }
        for (recording, times) in recordings.iter().zip(&times) {
            let steady = times[recording.steady..].iter();
            let decode: Vec<f64> = steady.map(|rounds| percentile(rounds, 0.5)).collect();
            let row = &mut found.rows[recording.row];
            row.decode_ms = percentile(&decode, 0.5);
            row.decode_p99_ms = percentile(&decode, 0.99);
        }
        Ok(())
    }
}

/// Gives a client all of a frame's bytes; returns the frame that it shows then.
fn push(client: &mut Client, mut bytes: &[u8]) -> Result<Option<u32>, String> {
    let mut shown = None;
    while !bytes.is_empty() {
        let pushed = client.push(bytes).map_err(|error| error.to_string())?;
        bytes = &bytes[pushed.consumed..];
        shown = pushed.frame.map(|frame| frame.id).or(shown);
    }
    Ok(shown)
}

impl EvalArgs {
    /// The camera at a time.
    fn camera(&self, path: &CameraPath, time_s: f64) -> Camera {
        path.at(if self.standing { 0.0 } else { time_s })
    }
}

/// World bounds of all points of each instance that moves, now.
fn bounds_of_movers(world: &World) -> Vec<[Vec3; 2]> {
    let movers = (0..).zip(world.moves()).filter(|(_, moves)| **moves);
    let bounds = |(instance, _)| {
        let slices = world.slices_of(instance);
        let slices = &world.slices[slices.start as usize..slices.end as usize];
        slices
            .iter()
            .map(|slice| slice.bounds)
            .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
    };
    movers.filter_map(bounds).collect()
}

fn view(camera: &Camera) -> Frustum {
    Frustum::new(camera, MARGIN_DEGREES.to_radians())
}

/// Checks that streams side by side have room.
fn bounded(world: &World, streams: usize) -> Result<(), String> {
    let capacity = capacity_of(world);
    // Mirrors at both ends and what the client had before; at both ends, what the residual codec
    // keeps (at most 32 bytes a point).
    let elements = u64::from(capacity.cells) + u64::from(capacity.buckets);
    let each = elements * 3 * 32 + world.point_count() as u64 * 2 * 32;
    let total = each * streams as u64;
    if total > MAX_STREAMS_BYTES {
        return Err(format!(
            "{streams} streams side by side would take {} GiB, more than {}: lower --density or \
             give fewer --steps",
            total >> 30,
            MAX_STREAMS_BYTES >> 30
        ));
    }
    Ok(())
}

/// One encoder and the client that follows it.
struct Stream {
    scheme: Scheme,
    encoder: Encoder,
    config: Config,
    client: Client,
    /// The client's cells before the frame.
    before: Vec<Cell>,
    /// Bytes made and not pushed yet: before the first frame, the header.
    bytes: Vec<u8>,
    /// Those of the frames so far.
    sent: Vec<Vec<u8>>,
    frames: Vec<StreamFrame>,
    /// Of all pictures: squared error, pixels, FLIP, pictures.
    squares: f64,
    pixels: f64,
    flip: f64,
    pictures: f64,
}

struct StreamFrame {
    bytes: usize,
    slices_bytes: usize,
    topology_bytes: usize,
    /// Finding, coding and packing.
    frame_ms: f64,
    encode_ms: f64,
    select_ms: f64,
    rmse_255: f64,
    points: u64,
}

impl Stream {
    fn new(world: &World, scheme: Scheme, rate_hz: f64) -> Stream {
        let scene_hash = world.scene.hash();
        let mut unlimited = scheme;
        if let Scheme::Residual(_, limits) = &mut unlimited {
            limits.max_mbit = 0.0;
        }
        let mut encoder = Encoder::new(world, unlimited, 0);
        let bytes = encoder.header(world, scene_hash, rate_hz as f32);
        let config = Config {
            capacity: capacity_of(world),
            scene_hash,
        };
        Stream {
            scheme,
            encoder,
            client: Client::new(config),
            config,
            before: vec![Cell::default(); capacity_of(world).cells as usize],
            bytes,
            sent: Vec::new(),
            frames: Vec::new(),
            squares: 0.0,
            pixels: 0.0,
            flip: 0.0,
            pictures: 0.0,
        }
    }

    /// From the next frame on, the stream's limit of bits holds.
    fn limit(&mut self) {
        if let Scheme::Residual(_, limits) = self.scheme {
            self.encoder.set_max_mbit(limits.max_mbit);
        }
    }

    fn frame(&mut self, world: &World, time_ns: u64, sight: &Sight<'_>) -> Result<(), String> {
        let (encoder, bytes) = (&mut self.encoder, &mut self.bytes);
        let start = Instant::now();
        encoder.merge(world);
        let stats = encoder.frame(world, time_ns, sight, true, bytes);
        let frame_ms = ms(start);
        let encode_ms = stats.encode_ns as f64 * 1e-6;
        let shown = push(&mut self.client, &self.bytes)?;
        let (mine, theirs) = (self.client.mirror(), self.encoder.mirror());
        if shown != Some(self.encoder.frame_id()) || mine.hash() != theirs.hash() {
            let frame = self.encoder.frame_id();
            return Err(format!(
                "{}: the client's mirror is not the server's after frame {frame}; please report it",
                name_of(self.scheme)
            ));
        }
        let mut points = 0;
        for run in mine.dirty_runs(Buffer::Cells) {
            let run = run.start as usize..run.end as usize;
            let pairs = self.before[run.clone()].iter_mut().zip(&mine.cells()[run]);
            for (before, now) in pairs {
                let changed = before
                    .points
                    .iter()
                    .zip(&now.points)
                    .filter(|(a, b)| a != b);
                points += changed.count() as u64;
                *before = *now;
            }
        }
        let slices = matches!(self.scheme, Scheme::Residual(..)).then(|| self.client.slices());
        let rmse_255 = self.encoder.point_rmse(world, mine, slices, sight);
        self.frames.push(StreamFrame {
            bytes: self.bytes.len(),
            slices_bytes: packets_bytes(&self.bytes, kind::SLICES)?,
            topology_bytes: packets_bytes(&self.bytes, kind::PATCHES)?,
            frame_ms,
            encode_ms,
            // Coding, where it had two threads, is counted twice.
            select_ms: (frame_ms - encode_ms).max(0.0),
            rmse_255,
            points,
        });
        self.client.clear_dirty();
        self.sent.push(std::mem::take(&mut self.bytes));
        Ok(())
    }

    /// Compares what the client would show with the reference.
    fn look(&mut self, view: &View, reference: &[f32]) {
        let Some(header) = self.client.header() else {
            return;
        };
        let valid = view.valid();
        let blended = view.blend(self.client.mirror().lookup(), header.kernel);
        let size = (view.width, view.height);
        // A camera that sees nothing of the scene has nothing to compare.
        if let Ok(pair) = Pair::new(reference, &blended.openness, &valid, size.0, size.1) {
            let pixels = valid.iter().filter(|valid| **valid).count() as f64;
            self.squares += pair.rmse().powi(2) * pixels;
            self.pixels += pixels;
            self.flip += pair.flip();
            self.pictures += 1.0;
        }
    }

    fn kbits(&self) -> Vec<f64> {
        let bytes = self.frames.iter().map(|frame| frame.bytes as f64);
        bytes.map(|bytes| bytes * 8e-3).collect()
    }

    /// The figures of the frames from `steady` on.
    fn row(&self, steady: usize, rate_hz: f64) -> Row {
        let of = |value: &dyn Fn(&StreamFrame) -> f64| -> Vec<f64> {
            self.frames[steady..].iter().map(value).collect()
        };
        let kbits = self.kbits();
        let seen = self.pictures > 0.0;
        let error = (self.squares / self.pixels).max(1e-12);
        let limits = match self.scheme {
            Scheme::Cells { .. } => Limits::default(),
            Scheme::Residual(_, limits) => limits,
        };
        Row {
            profile: match self.scheme {
                Scheme::Cells { .. } => ProfileArg::Cells.name(),
                Scheme::Residual(..) => ProfileArg::Residual.name(),
            },
            quant: name_of(self.scheme),
            points_per_pixel: limits.points_per_pixel,
            max_mbit: limits.max_mbit,
            mbit_per_s: mean(&kbits[steady..]) * rate_hz / 1e3,
            mbit_per_s_slices: mean(&of(&|frame| frame.slices_bytes as f64)) * 8e-6 * rate_hz,
            mbit_per_s_topology: mean(&of(&|frame| frame.topology_bytes as f64)) * 8e-6 * rate_hz,
            mbit_per_s_first_second: mean(&kbits[..steady]) * rate_hz / 1e3,
            rmse_255: mean(&of(&|frame| frame.rmse_255 * frame.rmse_255)).sqrt(),
            psnr_db: seen.then(|| -10.0 * error.log10()),
            flip: seen.then(|| self.flip / self.pictures),
            encode_ms: percentile(&of(&|frame| frame.encode_ms), 0.5),
            select_ms: percentile(&of(&|frame| frame.select_ms), 0.5),
            points_changed_per_frame: mean(&of(&|frame| frame.points as f64)),
            client_bytes: self.client.memory_bytes(),
            first_frame_bytes: self.frames[0].bytes as u64,
            ..Row::default()
        }
    }
}

/// Bytes in packets of a kind.
fn packets_bytes(stream: &[u8], kind: u8) -> Result<usize, String> {
    let mut rest = stream.strip_prefix(&PREAMBLE).unwrap_or(stream);
    let mut bytes = 0;
    let read = |rest| Packet::read(rest, MAX_BODY_BYTES).map_err(|error| error.to_string());
    while let Some((packet, length)) = read(rest)? {
        bytes += if packet.kind == kind { length } else { 0 };
        rest = &rest[length..];
    }
    Ok(bytes)
}

/// A quantiser in words.
fn name_of(scheme: Scheme) -> String {
    match scheme {
        Scheme::Cells { threshold, .. } => format!("threshold {threshold}"),
        Scheme::Residual(Quantiser { step, dead_zone }, _) => {
            format!("step {step}, dead zone {dead_zone}")
        }
    }
}

/// Level of detail and budget in words.
fn limits(row: &Row) -> String {
    let budget = match row.max_mbit {
        0.0 => String::new(),
        mbit => format!(" in {mbit} Mbit/s"),
    };
    per_pixel(row.points_per_pixel) + &budget
}

/// Level of detail in words.
fn per_pixel(points: f32) -> String {
    match points {
        0.0 => String::new(),
        points => format!(" to {points}/pixel"),
    }
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// The value that this share of the values is below.
pub(crate) fn percentile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let index = (sorted.len() as f64 * share) as usize;
    sorted
        .get(index.min(sorted.len().saturating_sub(1)))
        .copied()
        .unwrap_or(0.0)
}

/// What a point error costs in bits or time, from measured pairs of both: on straight lines through
/// neighbouring pairs, with the cost logarithmic. Pairs that another betters in both count for
/// nothing. Also says whether the error is outside of the rest.
fn cost_at(rmse: f64, measured: &[(f64, f64)]) -> Option<(f64, bool)> {
    let mut sorted = measured.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut pairs: Vec<(f64, f64)> = Vec::new();
    for pair in sorted {
        if pairs.last().is_none_or(|last| pair.1 < last.1) {
            pairs.push(pair);
        }
    }
    if pairs.len() < 2 || pairs.iter().any(|(_, cost)| *cost <= 0.0) {
        return None;
    }
    let above = pairs.partition_point(|(error, _)| *error < rmse);
    let [(x0, y0), (x1, y1)] = {
        let upper = above.clamp(1, pairs.len() - 1);
        [pairs[upper - 1], pairs[upper]]
    };
    let along = (rmse - x0) / (x1 - x0);
    let cost = (y0.ln() + along * (y1.ln() - y0.ln())).exp();
    let extrapolated = rmse < pairs[0].0 || rmse > pairs[pairs.len() - 1].0;
    Some((cost, extrapolated))
}

/// Lines as a table whose columns line up, the first its head.
fn aligned<const N: usize>(lines: &[[String; N]]) -> String {
    let wide = |column: usize| {
        let cells = lines.iter().map(|line| line[column].chars().count());
        cells.max().unwrap_or(0)
    };
    let widths: [usize; N] = std::array::from_fn(wide);
    let rule = widths.map(|width| "-".repeat(width));
    let join = |line: &[String; N]| {
        let cells = line.iter().zip(&widths);
        let cells: Vec<String> = cells
            .map(|(cell, width)| format!("{cell:width$}"))
            .collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let mut out = String::new();
    for (number, line) in lines.iter().enumerate() {
        out += &join(line);
        if number == 0 {
            out += &join(&rule);
        }
    }
    out
}

impl Evaluation {
    fn compare(&mut self, density: f64, rate_hz: f64, points_per_pixel: f32) {
        let of = |profile: ProfileArg| -> Vec<&Row> {
            let rows = self.rows.iter().filter(|row| row.profile == profile.name());
            rows.filter(|row| row.density == density && row.rate_hz == rate_hz)
                .collect()
        };
        let mut residual = of(ProfileArg::Residual);
        residual.retain(|row| row.points_per_pixel == points_per_pixel && row.max_mbit == 0.0);
        let off = |row: &Row, from: f64| (row.rmse_255 - from).abs();
        let Some(cells) = of(ProfileArg::Cells).first().copied() else {
            return;
        };
        let nearest = residual
            .iter()
            .min_by(|a, b| off(a, cells.rmse_255).total_cmp(&off(b, cells.rmse_255)));
        let Some(nearest) = nearest else { return };
        let at_equal_error = |cost: &dyn Fn(&Row) -> f64| {
            let measured = residual.iter().map(|row| (row.rmse_255, cost(row)));
            cost_at(cells.rmse_255, &measured.collect::<Vec<_>>())
        };
        let time = |ms: &dyn Fn(&Row) -> f64| at_equal_error(ms).map_or(ms(nearest), |(ms, _)| ms);
        let bits = at_equal_error(&|row| row.mbit_per_s);
        let shipped = at_equal_error(&|row| row.mbit_per_s - row.mbit_per_s_topology);
        let comparison = Comparison {
            density,
            rate_hz,
            points_per_pixel,
            rmse_255: cells.rmse_255,
            bits_cells_over_residual: bits.map(|(bits, _)| cells.mbit_per_s / bits),
            bits_cells_over_residual_shipped: shipped.map(|(bits, _)| cells.mbit_per_s / bits),
            extrapolated: bits.is_some_and(|(_, extrapolated)| extrapolated),
            decode_residual_over_cells: time(&|row| row.decode_ms) / cells.decode_ms,
            encode_cells_over_residual: cells.encode_ms / time(&|row| row.encode_ms),
        };
        self.comparisons.push(comparison);
    }

    /// All rows as a table, and what they come to.
    pub fn table(&self) -> String {
        let heads = [
            "profile",
            "quantiser",
            "/m²",
            "/pixel",
            "at most",
            "Hz",
            "Mbit/s",
            "slices",
            "topology",
            "first s",
            "rmse/255",
            "dB",
            "FLIP",
            "decode ms",
            "p99",
            "encode ms",
            "select ms",
            "step ms",
            "p99",
            "frame ms",
            "p99",
            "krays",
            "points",
            "skipped",
            "client MB",
        ];
        let mut lines = vec![heads.map(String::from)];
        for row in &self.rows {
            let optional = |value: Option<f64>, digits| {
                value.map_or("-".into(), |value| format!("{value:.digits$}"))
            };
            lines.push([
                row.profile.into(),
                row.quant.clone(),
                row.density.to_string(),
                match row.points_per_pixel {
                    0.0 => "all".into(),
                    points => points.to_string(),
                },
                match row.max_mbit {
                    0.0 => "-".into(),
                    mbit => mbit.to_string(),
                },
                row.rate_hz.to_string(),
                format!("{:.2}", row.mbit_per_s),
                format!("{:.2}", row.mbit_per_s_slices),
                format!("{:.2}", row.mbit_per_s_topology),
                format!("{:.2}", row.mbit_per_s_first_second),
                format!("{:.3}", row.rmse_255),
                optional(row.psnr_db, 2),
                optional(row.flip, 4),
                format!("{:.3}", row.decode_ms),
                format!("{:.3}", row.decode_p99_ms),
                format!("{:.3}", row.encode_ms),
                format!("{:.3}", row.select_ms),
                format!("{:.1}", row.step_ms),
                format!("{:.1}", row.step_p99_ms),
                format!("{:.1}", row.frame_ms),
                format!("{:.1}", row.frame_p99_ms),
                format!("{:.1}", row.rays_per_frame / 1e3),
                format!("{:.0}", row.points_changed_per_frame),
                format!("{:.0} %", row.cells_skipped_share * 100.0),
                format!("{:.1}", row.client_bytes as f64 / 1e6),
            ]);
        }
        let mut out = aligned(&lines);
        out += "\n";
        for (what, value) in self.conclusions() {
            out += &format!("{what}: {value}\n");
        }
        out
    }

    fn conclusions(&self) -> Vec<(String, String)> {
        let mut lines: Vec<(String, String)> = Vec::new();
        for found in &self.comparisons {
            let bits = match found.bits_cells_over_residual {
                Some(ratio) if found.extrapolated => format!("{ratio:.1} (extrapolated)"),
                Some(ratio) => format!("{ratio:.1}"),
                None => "unknown (needs two --steps and some bits)".into(),
            };
            lines.push((
                format!(
                    "{}/m²{}, {} Hz",
                    found.density,
                    per_pixel(found.points_per_pixel),
                    found.rate_hz
                ),
                format!(
                    "bits of cells over residual at {:.3}/255 rms {bits}, with the topology \
                     shipped {}; decode time of residual over cells {:.2}, encode time of cells \
                     over residual {:.1}",
                    found.rmse_255,
                    found
                        .bits_cells_over_residual_shipped
                        .map_or("unknown".into(), |ratio| format!("{ratio:.1}")),
                    found.decode_residual_over_cells,
                    found.encode_cells_over_residual
                ),
            ));
        }
        let mut rates: Vec<f64> = self.rows.iter().map(|row| row.rate_hz).collect();
        rates.dedup();
        rates.sort_by(f64::total_cmp);
        rates.dedup();
        let steady = rates.iter().map(|&rate| {
            let first = left_out(self.frames, rate);
            format!("{} of {} at {rate} Hz", self.frames - first, self.frames)
        });
        lines.push((
            "steady frames".into(),
            format!(
                "the last {}; those before are \"first s\"",
                steady.collect::<Vec<_>>().join(", ")
            ),
        ));
        lines
    }

    /// What more points cost: a plot a profile, quantiser, rate and number of points a pixel that
    /// was measured at several densities.
    fn growth(&self) -> Vec<Plot> {
        let mut runs: Vec<(String, Vec<&Row>)> = Vec::new();
        for row in &self.rows {
            let thinned = limits(row);
            let run = format!("{} {}{thinned}, {} Hz", row.profile, row.quant, row.rate_hz);
            match runs.iter_mut().find(|(name, _)| *name == run) {
                Some((_, rows)) => rows.push(row),
                None => runs.push((run, vec![row])),
            }
        }
        runs.retain(|(_, rows)| rows.len() > 1);
        let plot = |(run, mut rows): (String, Vec<&Row>)| {
            rows.sort_by(|a, b| a.density.total_cmp(&b.density));
            let costs: [(&str, fn(&Row) -> f64); 5] = [
                ("server frame", |row| row.frame_ms),
                ("select and encode", |row| row.select_ms + row.encode_ms),
                ("client frame", |row| row.decode_ms),
                ("Mbit/s", |row| row.mbit_per_s),
                ("Mbit/s, topology shipped", |row| {
                    row.mbit_per_s - row.mbit_per_s_topology
                }),
            ];
            let curve = |(name, cost): (&str, fn(&Row) -> f64)| {
                let ratio = |row: &&Row| (row.density, cost(row) / cost(rows[0]));
                (name.into(), rows.iter().map(ratio).collect())
            };
            Plot {
                title: format!("Growth, {run}"),
                x_label: "points per m²".into(),
                y_label: "times the least density's".into(),
                series: costs.into_iter().map(curve).collect(),
                log_y: false,
                form: Form::Lines,
            }
        };
        runs.into_iter().map(plot).collect()
    }

    fn report(&self) -> Report {
        let scene = self.rows.first().map_or("", |row| &row.scene);
        let mut summary = self.conclusions();
        for row in &self.rows {
            summary.push((
                format!(
                    "{} {}, {}/m²{}, {} Hz",
                    row.profile,
                    row.quant,
                    row.density,
                    limits(row),
                    row.rate_hz
                ),
                format!(
                    "{:.2} Mbit/s, {:.3}/255 rms, {:.2} dB, decode {:.3} ms, encode {:.3} ms",
                    row.mbit_per_s,
                    row.rmse_255,
                    row.psnr_db.unwrap_or(f64::NAN),
                    row.decode_ms,
                    row.encode_ms
                ),
            ));
        }
        // A line a profile, density and rate; a point a quantiser.
        let curves = |x: &dyn Fn(&Row) -> f64, y: &dyn Fn(&Row) -> f64| {
            let mut curves: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
            for row in &self.rows {
                let Row {
                    profile,
                    density,
                    rate_hz,
                    ..
                } = row;
                let thinned = limits(row);
                let name = format!("{profile}, {density}/m²{thinned}, {rate_hz} Hz");
                if curves.last().is_none_or(|(last, _)| *last != name) {
                    curves.push((name, Vec::new()));
                }
                let points = &mut curves.last_mut().expect("one was just made").1;
                points.push((x(row), y(row)));
            }
            curves
        };
        let plot = |title: &str, x_label: &str, y_label: &str, series| Plot {
            title: title.into(),
            x_label: x_label.into(),
            y_label: y_label.into(),
            series,
            log_y: true,
            form: Form::Lines,
        };
        let rmse = |row: &Row| row.rmse_255;
        let psnr = |row: &Row| row.psnr_db.unwrap_or(f64::NAN);
        let (points, picture) = ("error of the points, rms (1/255)", "AO alone, PSNR (dB)");
        let mut plots = vec![
            plot(
                "Bits and error of the points",
                points,
                "Mbit/s",
                curves(&rmse, &|r| r.mbit_per_s),
            ),
            plot(
                "Bits and error of the picture",
                picture,
                "Mbit/s",
                curves(&psnr, &|r| r.mbit_per_s),
            ),
            plot(
                "Decode time and error",
                points,
                "ms a frame",
                curves(&rmse, &|r| r.decode_ms),
            ),
            plot(
                "Encode time and error",
                points,
                "ms a frame",
                curves(&rmse, &|r| r.encode_ms),
            ),
        ];
        let mut over_time: BTreeMap<(u64, u64), Vec<(String, Vec<(f64, f64)>)>> = BTreeMap::new();
        for (row, kbits) in self.rows.iter().zip(&self.kbits) {
            let key = (row.density.to_bits(), row.rate_hz.to_bits());
            let times = (0..).map(|frame| f64::from(frame) / row.rate_hz);
            let thinned = limits(row);
            let name = format!("{} {}{thinned}", row.profile, row.quant);
            let line = times.zip(kbits.iter().copied()).collect();
            over_time.entry(key).or_default().push((name, line));
        }
        for ((density, rate_hz), series) in over_time {
            let (density, rate_hz) = (f64::from_bits(density), f64::from_bits(rate_hz));
            let title = format!("Bits of each frame, {density}/m², {rate_hz} Hz");
            plots.push(plot(&title, "time (s)", "kbit", series));
        }
        plots.extend(self.growth());
        Report {
            title: format!("PSAO eval: {scene}"),
            summary,
            panels: Vec::new(),
            plots,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_interpolated_on_a_log_scale_and_extrapolation_is_said() {
        // The last is worse than the first in both.
        let measured = [(2.0, 1.0), (1.0, 10.0), (4.0, 0.5), (3.0, 2.0)];
        let at = |rmse| cost_at(rmse, &measured).expect("three points");
        let near = |(bits, out): (f64, bool), want: f64, extrapolated| {
            assert!((bits / want - 1.0).abs() < 1e-9, "{bits} instead of {want}");
            assert_eq!(out, extrapolated);
        };
        near(at(1.0), 10.0, false);
        near(at(1.5), 10f64.sqrt(), false);
        near(at(2.0), 1.0, false);
        near(at(3.0), 0.5f64.sqrt(), false);
        near(at(4.0), 0.5, false);
        near(at(0.0), 100.0, true);
        near(at(6.0), 0.25, true);
    }

    #[test]
    fn no_ratio_is_made_up_from_one_quantiser_or_none_or_silence() {
        assert_eq!(cost_at(1.0, &[]), None);
        assert_eq!(cost_at(1.0, &[(1.0, 5.0)]), None);
        assert_eq!(cost_at(1.0, &[(1.0, 5.0), (1.0, 6.0)]), None);
        assert_eq!(cost_at(1.0, &[(1.0, 5.0), (2.0, 0.0)]), None);
    }

    #[test]
    fn steady_frames_leave_out_the_first_second_or_half() {
        assert_eq!(left_out(600, 60.0), 60);
        assert_eq!(left_out(90, 60.0), 45);
        assert_eq!(left_out(10, 60.0), 5);
        assert_eq!(left_out(10, 0.5), 1);
        assert_eq!(left_out(2, 1000.0), 1);
    }
}
