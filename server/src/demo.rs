//! The main job: server and client over loopback QUIC in one process, pictures and a report.

use crate::args::{SceneArgs, StreamArgs, TraceArgs, camera_path};
use crate::camera::{CameraPath, Frustum};
use crate::encode::capacity_of;
use crate::identity::Identity;
use crate::metrics::Pair;
use crate::picture::{Picture, write_whole};
use crate::render::{REFERENCE_RAYS, View};
use crate::report::{Form, Panel, Plot, Report};
use crate::samples::Samples;
use crate::server::{FrameReport, Server, uplink_camera};
use crate::transport::{ClientId, Transport, TransportConfig};
use crate::world::{FIRST_RAYS, Progress};
use clap::Args;
use glam::Vec3;
use psao::quic::{Connect, Connection, Trust};
use psao::{Client, Config};
use psao_core::mirror::Buffer;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Options of `psao demo`.
#[derive(Args, Clone, Debug)]
pub struct DemoArgs {
    /// The scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// The stream.
    #[command(flatten)]
    pub stream: StreamArgs,
    /// What traces rays.
    #[command(flatten)]
    pub trace: TraceArgs,
    /// Server frames to stream
    #[arg(long, value_name = "N", default_value_t = 60)]
    pub frames: u32,
    /// Frames of which pictures are made, spread over the run
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub pictures: u32,
    /// Size of the pictures
    #[arg(long, value_name = "WxH", default_value = "480x270", value_parser = parse_size)]
    pub size: (usize, usize),
    /// Which of the two camera paths to walk, 0 or 1
    #[arg(
        long,
        value_name = "N",
        default_value_t = 0,
        value_parser = clap::value_parser!(u32).range(0..=1)
    )]
    pub path: u32,
    /// Folder for the pictures and report.html
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Writes the figures as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// A picture's size as on the command line: `480x270`.
///
/// # Errors
/// It is none, or an edge is not 16 to 8192.
pub fn parse_size(text: &str) -> Result<(usize, usize), String> {
    let parse = || {
        let (width, height) = text.split_once('x')?;
        let size: (usize, usize) = (width.parse().ok()?, height.parse().ok()?);
        let usable = (16..=8192).contains(&size.0) && (16..=8192).contains(&size.1);
        usable.then_some(size)
    };
    parse().ok_or_else(|| format!("{text} is not a size such as 480x270 (16 to 8192 each)"))
}

/// What the demo measured; the names are those of the JSON file.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Figures {
    /// Scene file or `atrium`.
    pub scene: String,
    /// Points on all surfaces, discarded ones included.
    pub points: usize,
    /// Cells in use.
    pub cells: u32,
    /// Share of the cells of all that came into view which the client need not have, as everything
    /// in and around them is open.
    pub cells_skipped_share: f64,
    /// Buckets.
    pub buckets: usize,
    /// Instances of the scene.
    pub instances: usize,
    /// Points without room in their cell or bucket.
    pub discarded_points: usize,
    /// Frames streamed.
    pub frames: u32,
    /// Frames per second of scene time.
    pub fps: f32,
    /// Stream profile.
    pub profile: &'static str,
    /// Points per square metre and side.
    pub density: f64,
    /// Kernel's name.
    pub kernel: String,
    /// Megabits per second of scene time, after the first frame.
    pub mbit_per_s: f64,
    /// Bytes of the first frame: all that is in view.
    pub first_frame_bytes: u64,
    /// Rays traced in all frames, after the first occlusion.
    pub rays_traced: u64,
    /// Rays if every visible point had been traced in every frame, as in the paper.
    pub rays_if_all_traced: u64,
    /// AO alone against the reference, over all pictures' pixels that show the scene.
    pub psnr_db: f64,
    /// Mean FLIP of the pictures.
    pub flip: f64,
    /// Root mean square difference of the client's points from the server's, 1/255, over frames.
    pub rmse_255: f64,
    /// The client's buffers were the server's copy of them in every frame.
    pub mirror_matches: bool,
    /// Memory of the client: buffers and all.
    pub client_bytes: u64,
    /// Bytes of the client's buffers that changed a frame and would be uploaded (median).
    pub upload_bytes_per_frame: u64,
    /// Points read a pixel.
    pub fetched: f64,
    /// Share of pixels without a point that counts.
    pub holes_share: f64,
    /// Seconds until the first frame can be sent: scene, points, grid, first occlusion (64 rays).
    pub ready_s: f64,
    /// Median milliseconds a frame by stage.
    pub ms: BTreeMap<&'static str, f64>,
}

/// One frame's figures over time, for the plots.
#[derive(Clone, Debug, Default)]
struct FrameRow {
    time_s: f64,
    bytes: u64,
    upload_bytes: u64,
    rmse_255: f64,
    rays: u64,
    rays_if_all: u64,
    ms: [f64; 4],
}

const STAGES: [&str; 4] = ["trace", "select_encode", "transport", "decode"];

/// A client over loopback, as an app would run it.
struct Loopback {
    connection: Connection,
    client: Client,
    received: Vec<u8>,
}

/// Runs the demo.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn run(args: &DemoArgs, progress: Progress<'_>) -> Result<Figures, String> {
    let settings = args.stream.settings()?;
    if args.frames == 0 {
        return Err("--frames must be 1 or more".into());
    }
    // First of all, so that nobody waits for a report that cannot be kept.
    let json_folder = args.json.as_deref().and_then(Path::parent);
    let mut folders = vec![(&args.out, args.out.as_path())];
    folders.extend(args.json.as_ref().zip(json_folder));
    for (path, folder) in folders {
        std::fs::create_dir_all(folder)
            .map_err(|error| format!("{}: {error}: choose another place for it", path.display()))?;
    }
    let start = Instant::now();
    let mut world = (args.trace).world(&args.scene, args.stream.layout(), progress)?;
    let aspect = args.size.0 as f32 / args.size.1 as f32;
    let path = camera_path(&world, args.path, aspect)?;
    let time_of = |frame: u32| f64::from(frame) / f64::from(args.stream.fps);

    // Everything that the cameras to come will see gets its first occlusion now.
    let views: Vec<Frustum> = (0..args.frames)
        .map(|frame| Frustum::new(&path.at(time_of(frame)), settings.margin_rad))
        .collect();
    let seen = |[min, max]: [Vec3; 2]| views.iter().any(|view| view.sees_box(min, max));
    let report = |stage: &'static str| move |done, total| progress(stage, done, total);
    world.converge(&seen, FIRST_RAYS, &report("first occlusion"));
    let ready_s = start.elapsed().as_secs_f64();
    // A live server would stream by now, and converge in the frames; here each frame is to show
    // what the stream can do, so all rays come first.
    world.converge(&seen, world.options.rays, &report("convergence"));

    let mut figures = Figures {
        scene: world.scene.name.clone(),
        points: world.point_count(),
        buckets: world.truth.buckets.len(),
        instances: world.scene.instances.len(),
        frames: args.frames,
        fps: args.stream.fps,
        profile: args.stream.profile.name(),
        density: args.scene.density,
        kernel: format!("{:?}", world.options.kernel).to_lowercase(),
        mirror_matches: true,
        ready_s,
        ..Figures::default()
    };
    let mut server = Server::new(world, settings);
    let (mut transport, mut link) = connect(&server)?;
    let id = introduce(
        &mut server,
        &mut transport,
        &link,
        &path,
        args.size.1 as u32,
    )?;

    let samples = Samples::new(REFERENCE_RAYS);
    let mut rows = Vec::new();
    let mut shots = Vec::new();
    for frame in 0..args.frames {
        let camera = path.at(time_of(frame));
        let said = uplink_camera(&camera, server.world.scene.origin, args.size.1 as u32);
        link.connection
            .camera(&said)
            .map_err(|error| error.to_string())?;
        let report = server.frame(&mut transport, time_of(frame), u64::MAX);
        let row = link.follow(&mut server, &mut transport, id, &report)?;
        figures.mirror_matches &= link.matches(&server, id);
        rows.push(FrameRow {
            time_s: time_of(frame),
            ..row
        });
        if is_shown(frame, args) {
            progress("pictures", shots.len() as u64, u64::from(args.pictures));
            let view = View::new(&server.world, &camera, args.size.0, args.size.1);
            shots.extend(Shot::take(
                &server,
                &link.client,
                &view,
                &samples,
                time_of(frame),
            ));
        }
        progress("frames", u64::from(frame) + 1, u64::from(args.frames));
    }
    let counts = link.client.mirror();
    figures.mirror_matches &= counts.hash() == counts.recompute_hash();
    figures.client_bytes = link.client.memory_bytes();
    let cells = link.client.mirror().cells().iter();
    figures.cells = cells.filter(|cell| !cell.is_empty()).count() as u32;
    let all_cells = server
        .cells_of(id)
        .map_or(figures.cells as usize, |[_, all]| all);
    figures.cells_skipped_share = 1.0 - f64::from(figures.cells) / all_cells.max(1) as f64;
    figures.discarded_points = server.world.discarded();
    figures.summarise(&rows, &shots);
    write_results(args, &figures, &rows, &shots)?;
    link.connection.close();
    transport.close();
    Ok(figures)
}

fn is_shown(frame: u32, args: &DemoArgs) -> bool {
    // The middle of each of as many equal parts as there are pictures.
    let pictures = args.pictures.min(args.frames);
    (0..pictures).any(|i| (2 * i + 1) * args.frames / (2 * pictures) == frame)
}

/// Server and client, over UDP on this machine.
fn connect(server: &Server) -> Result<(Transport, Loopback), String> {
    let identity = Identity::ephemeral().map_err(|error| error.to_string())?;
    let fingerprint = identity.fingerprint();
    let capacity = capacity_of(&server.world);
    let transport = Transport::start(TransportConfig {
        listen: ([127, 0, 0, 1], 0).into(),
        identity,
        token: "demo".into(),
        max_clients: 1,
        scene_hash: server.scene_hash(),
        capacity,
    })
    .map_err(|error| error.to_string())?;
    let connection = Connection::open(Connect {
        address: &transport.local_addr().to_string(),
        server_name: None,
        token: "demo",
        trust: Trust::Fingerprint(fingerprint),
        scene_hash: server.scene_hash(),
        capacity,
        topology_hash: 0,
    })
    .map_err(|error| error.to_string())?;
    let client = Client::new(Config {
        capacity,
        scene_hash: server.scene_hash(),
    });
    Ok((
        transport,
        Loopback {
            connection,
            client,
            received: Vec::new(),
        },
    ))
}

/// Waits until the server knows the client and where it looks.
fn introduce(
    server: &mut Server,
    transport: &mut Transport,
    link: &Loopback,
    path: &CameraPath,
    height_px: u32,
) -> Result<ClientId, String> {
    let camera = uplink_camera(&path.at(0.0), server.world.scene.origin, height_px);
    let deadline = Instant::now() + Duration::from_secs(10);
    while Instant::now() < deadline {
        // A camera is a datagram: it may be lost, or overtake the introduction.
        link.connection
            .camera(&camera)
            .map_err(|error| error.to_string())?;
        std::thread::sleep(Duration::from_millis(2));
        server.listen(transport);
        if let Some(id) = server.first_with_camera() {
            return Ok(id);
        }
    }
    Err("the client did not reach the server within 10 s on the loopback interface".into())
}

impl Loopback {
    /// Receives what the server has sent until the client is where the server is.
    fn follow(
        &mut self,
        server: &mut Server,
        transport: &mut Transport,
        id: ClientId,
        report: &FrameReport,
    ) -> Result<FrameRow, String> {
        let sent = report.sent.iter().find(|(client, _)| *client == id);
        let mut row = FrameRow {
            bytes: sent.map_or(0, |(_, stats)| stats.bytes),
            rays: report.step.rays,
            rays_if_all: report.step.rays_if_all,
            ..FrameRow::default()
        };
        let wanted = server.progress_of(id).map_or(0, |(_, newest)| newest);
        let start = Instant::now();
        let mut decode = Duration::ZERO;
        let mut done = sent.is_none();
        while !done {
            self.received.clear();
            let waited = Duration::from_secs(60);
            let got = self.connection.receive_timeout(&mut self.received, waited);
            if got.map_err(|error| error.to_string())? == 0 {
                return Err(format!("frame {wanted} did not arrive within 60 s"));
            }
            let decoding = Instant::now();
            let mut rest = &self.received[..];
            while !rest.is_empty() {
                let pushed = self.client.push(rest).map_err(|error| error.to_string())?;
                rest = &rest[pushed.consumed..];
                done |= pushed.frame.is_some_and(|frame| frame.id == wanted);
            }
            decode += decoding.elapsed();
        }
        // An engine would upload these now.
        let mirror = self.client.mirror();
        for (buffer, bytes) in [
            (Buffer::Instances, 64),
            (Buffer::Buckets, 32),
            (Buffer::Cells, 32),
        ] {
            let changed = mirror
                .dirty_runs(buffer)
                .map(|run| u64::from(run.end - run.start));
            row.upload_bytes += bytes * changed.sum::<u64>();
        }
        self.client.clear_dirty();
        self.connection
            .ack(wanted)
            .map_err(|error| error.to_string())?;
        let waited = start.elapsed().saturating_sub(decode);
        row.ms = [report.step_ms, report.encode_ms, ms(waited), ms(decode)];
        row.rmse_255 = server.point_rmse(id, &self.client).unwrap_or(0.0);
        // The next frame must not be skipped for a window that is only just emptying.
        while !transport.ready(id) {
            std::thread::yield_now();
        }
        Ok(row)
    }

    /// The client's buffers equal the server's copy of them.
    fn matches(&self, server: &Server, id: ClientId) -> bool {
        server.mirror_of(id).is_some_and(|mirror| {
            let mine = self.client.mirror();
            mirror.hash() == mine.hash()
                && mirror.instances() == mine.instances()
                && mirror.buckets() == mine.buckets()
                && mirror.cells() == mine.cells()
        })
    }
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// One frame's pictures.
struct Shot {
    time_s: f64,
    blended: Vec<f32>,
    reference: Vec<f32>,
    valid: Vec<bool>,
    size: (usize, usize),
    psnr_db: f64,
    flip: f64,
    fetched: f64,
    holes_share: f64,
    lookup_ms: f64,
}

impl Shot {
    /// `None` where the camera sees nothing of the scene.
    fn take(
        server: &Server,
        client: &Client,
        view: &View,
        samples: &Samples,
        time_s: f64,
    ) -> Option<Shot> {
        let kernel = client.header()?.kernel;
        let valid = view.valid();
        let start = Instant::now();
        let blended = view.blend(client.mirror().lookup(), kernel);
        let lookup_ms = ms(start.elapsed());
        let reference = view.trace(&server.world, samples);
        let size = (view.width, view.height);
        let pair = Pair::new(&reference, &blended.openness, &valid, size.0, size.1).ok()?;
        Some(Shot {
            time_s,
            psnr_db: pair.psnr_db(),
            flip: pair.flip(),
            fetched: blended.fetched,
            holes_share: blended.holes_share,
            lookup_ms,
            blended: blended.openness,
            reference,
            valid,
            size,
        })
    }

    fn error(&self) -> Vec<f32> {
        self.blended
            .iter()
            .zip(&self.reference)
            .map(|(a, b)| (a - b).abs())
            .collect()
    }

    fn pictures(&self) -> Vec<(String, Picture)> {
        let (width, height) = self.size;
        let grey = |values: &[f32]| Picture::grey(values, &self.valid, width, height);
        let heat = Picture::heat(&self.error(), &self.valid, width, height, 0.25);
        vec![
            ("from the stream".into(), grey(&self.blended)),
            (
                format!("ray traced, {REFERENCE_RAYS} rays a pixel"),
                grey(&self.reference),
            ),
            ("difference".into(), heat),
        ]
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

impl Figures {
    fn summarise(&mut self, rows: &[FrameRow], shots: &[Shot]) {
        let later = &rows[1.min(rows.len() - 1)..];
        // The first frame alone says nothing about a rate.
        let rated = &rows[1..];
        let bits = rated.iter().map(|row| row.bytes as f64 * 8.0).sum::<f64>();
        self.first_frame_bytes = rows[0].bytes;
        self.mbit_per_s = bits / rated.len().max(1) as f64 * f64::from(self.fps) / 1e6;
        self.rays_traced = rows.iter().map(|row| row.rays).sum();
        self.rays_if_all_traced = rows.iter().map(|row| row.rays_if_all).sum();
        let squares = rows
            .iter()
            .map(|row| row.rmse_255 * row.rmse_255)
            .sum::<f64>();
        self.rmse_255 = (squares / rows.len() as f64).sqrt();
        let uploads = later.iter().map(|row| row.upload_bytes as f64).collect();
        self.upload_bytes_per_frame = median(uploads) as u64;
        for (stage, name) in STAGES.into_iter().enumerate() {
            self.ms.insert(
                name,
                median(later.iter().map(|row| row.ms[stage]).collect()),
            );
        }
        self.ms.insert(
            "lookup",
            median(shots.iter().map(|shot| shot.lookup_ms).collect()),
        );
        let count = shots.len().max(1) as f64;
        self.flip = shots.iter().map(|shot| shot.flip).sum::<f64>() / count;
        self.fetched = shots.iter().map(|shot| shot.fetched).sum::<f64>() / count;
        self.holes_share = shots.iter().map(|shot| shot.holes_share).sum::<f64>() / count;
        let (mut squares, mut pixels) = (0.0, 0.0);
        for shot in shots {
            for (error, valid) in shot.error().into_iter().zip(&shot.valid) {
                squares += if *valid {
                    f64::from(error * error)
                } else {
                    0.0
                };
                pixels += f64::from(u8::from(*valid));
            }
        }
        self.psnr_db = 10.0 * (pixels / f64::max(squares, 1e-12)).log10();
    }

    /// The main figures for a reader: what, and its value.
    pub fn table(&self) -> Vec<(String, String)> {
        let row = |what: &str, value: String| (what.to_string(), value);
        let share = self.rays_traced as f64 / (self.rays_if_all_traced as f64).max(1.0);
        vec![
            row("scene", self.scene.clone()),
            row(
                "points",
                format!("{} ({} discarded)", self.points, self.discarded_points),
            ),
            row(
                "client's cells, buckets",
                format!(
                    "{}, {} ({:.0} % of the cells are open, and left out)",
                    self.cells,
                    self.buckets,
                    self.cells_skipped_share * 100.0
                ),
            ),
            row("ready to stream after", format!("{:.1} s", self.ready_s)),
            row(
                "stream",
                format!(
                    "{:.2} Mbit/s at {} Hz, after a first frame of {:.1} MB",
                    self.mbit_per_s,
                    self.fps,
                    self.first_frame_bytes as f64 / 1e6
                ),
            ),
            row(
                "rays traced",
                format!("{:.2} % of tracing every visible point", share * 100.0),
            ),
            row(
                "picture (AO alone)",
                format!("{:.2} dB, FLIP {:.4}", self.psnr_db, self.flip),
            ),
            row(
                "client's points off by",
                format!("{:.3} / 255 rms", self.rmse_255),
            ),
            row(
                "mirror equals the server's",
                self.mirror_matches.to_string(),
            ),
            row(
                "client's memory",
                format!("{:.1} MB", self.client_bytes as f64 / 1e6),
            ),
            row(
                "upload a frame",
                format!("{:.1} kB", self.upload_bytes_per_frame as f64 / 1e3),
            ),
        ]
    }
}

fn write_results(
    args: &DemoArgs,
    figures: &Figures,
    rows: &[FrameRow],
    shots: &[Shot],
) -> Result<(), String> {
    let mut panels = Vec::new();
    for (number, shot) in shots.iter().enumerate() {
        let pictures = shot.pictures();
        let side_by_side: Vec<(&str, &Picture)> = pictures
            .iter()
            .map(|(title, picture)| (title.as_str(), picture))
            .collect();
        let path = args.out.join(format!("frame-{}.png", number + 1));
        Picture::side_by_side(&side_by_side)
            .write_png(&path)
            .map_err(|e| e.to_string())?;
        panels.push(Panel {
            title: format!("At {:.2} s", shot.time_s),
            caption: format!("AO alone: {:.2} dB, FLIP {:.4}", shot.psnr_db, shot.flip),
            pictures,
        });
    }
    let over_time = |value: &dyn Fn(&FrameRow) -> f64| -> Vec<(f64, f64)> {
        rows.iter().map(|row| (row.time_s, value(row))).collect()
    };
    let plot = |title: &str, y_label: &str, log_y: bool, series: Vec<(String, Vec<_>)>| Plot {
        title: title.into(),
        x_label: "time (s)".into(),
        y_label: y_label.into(),
        series,
        log_y,
        form: Form::Lines,
    };
    let stage = |index: usize| (STAGES[index].to_string(), over_time(&|row| row.ms[index]));
    let shot_line = |value: &dyn Fn(&Shot) -> f64| {
        shots
            .iter()
            .map(|shot| (shot.time_s, value(shot)))
            .collect()
    };
    let report = Report {
        title: format!("PSAO: {}", figures.scene),
        summary: figures.table(),
        panels,
        plots: vec![
            plot(
                "Stream",
                "kbit a frame",
                true,
                vec![("kbit".into(), over_time(&|row| row.bytes as f64 * 8e-3))],
            ),
            plot(
                "Error of the client's points",
                "rms (1/255)",
                false,
                vec![("rms".into(), over_time(&|row| row.rmse_255))],
            ),
            plot(
                "Error of the picture",
                "PSNR (dB)",
                false,
                vec![("AO alone".into(), shot_line(&|shot| shot.psnr_db))],
            ),
            plot(
                "Time a frame",
                "ms",
                true,
                (0..STAGES.len()).map(stage).collect(),
            ),
            plot(
                "Rays a frame",
                "million rays",
                true,
                vec![
                    ("traced".into(), over_time(&|row| row.rays as f64 * 1e-6)),
                    (
                        "every visible point".into(),
                        over_time(&|row| row.rays_if_all as f64 * 1e-6),
                    ),
                ],
            ),
        ],
    };
    report
        .write(&args.out.join("report.html"))
        .map_err(|error| error.to_string())?;
    if let Some(path) = &args.json {
        let json = serde_json::to_string_pretty(figures).map_err(|error| error.to_string())?;
        write_whole(path, json.as_bytes()).map_err(|error| error.to_string())?;
    }
    Ok(())
}
