//! A window on a scene: its geometry is drawn here, its ambient occlusion comes from a live server
//! or a recording.
//!
//! `feed` is what an app does with the client, `picture` what it does on the GPU; `window` is a
//! window and a camera.

mod feed;
mod picture;
mod window;

use clap::Parser;
use feed::Feed;
use glam::Vec3;
use picture::{Mode, Overlay, Pictures, Shown};
use psao_server::args::{SceneArgs, path_through};
use psao_server::camera::{Camera, CameraPath};
use psao_server::demo::parse_size;
use psao_server::gpu::Gpu;
use psao_server::picture::Picture;
use psao_server::rays::{CpuTracer, Deformed};
use psao_server::render::REFERENCE_RAYS;
use psao_server::scene::{Pose, Scene};
use psao_server::server::uplink_camera;
use std::path::PathBuf;
use std::process::ExitCode;

/// Shows a scene with ambient occlusion from a server or a recording.
///
/// Keys: 1 to 4 choose where occlusion comes from (stream, rays, screen, none), Tab what is drawn
/// over it; W A S D Q E and the mouse fly, O circles what is in the middle, P walks the path,
/// Space holds the time of a recording, Escape leaves.
#[derive(Parser)]
#[command(version)]
pub struct Args {
    /// A recording; or with --fingerprint, a server's address. It must be of the same scene
    #[arg(value_name = "FILE.psao | HOST:PORT")]
    source: String,
    /// Fingerprint of the server's certificate, as `psao serve` prints it
    #[arg(long, value_name = "HEX")]
    fingerprint: Option<psao::quic::Fingerprint>,
    /// The server's token
    #[arg(long, env = "PSAO_TOKEN", hide_env_values = true, default_value = "")]
    token: String,
    /// The scene: as it was given to `psao serve` or `psao record`
    #[command(flatten)]
    scene: SceneArgs,
    /// Where occlusion comes from
    #[arg(long, value_enum, default_value_t = Mode::Ao)]
    mode: Mode,
    /// What is drawn over it
    #[arg(long, value_enum, default_value_t = Overlay::None)]
    overlay: Overlay,
    /// Size of the picture
    #[arg(long, value_name = "WxH", default_value = "960x540", value_parser = parse_size)]
    size: (usize, usize),
    /// Opens no window: follows the frames, and writes one picture
    #[arg(long, requires = "out")]
    headless: bool,
    /// The picture to write
    #[arg(long, value_name = "FILE.png", requires = "headless")]
    out: Option<PathBuf>,
    /// Frames to follow before the picture
    #[arg(long, value_name = "N", default_value_t = 30, requires = "headless")]
    frames: u32,
}

fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("psao-viewer: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<(), String> {
    let scene = args.scene.load()?;
    let feed = Feed::open(args, scene.hash())?;
    match &args.out {
        Some(out) => headless(args, &scene, feed, out),
        None => window::run(args, scene, feed),
    }
}

/// The path that `psao record --path 0` walks.
fn path(scene: &Scene, aspect: f32) -> Result<CameraPath, String> {
    let mut pose = Pose::default();
    scene.pose(0.0, &mut pose);
    let deforms = scene
        .instances
        .iter()
        .enumerate()
        .filter(|(_, i)| i.deforms);
    let deformed: Vec<Deformed> = deforms
        .map(|(index, _)| {
            let (mut positions, mut normals) = (Vec::new(), Vec::new());
            scene.deform(index, &pose.instances[index], &mut positions, &mut normals);
            Deformed {
                instance: index as u32,
                positions,
                normals,
            }
        })
        .collect();
    let moves: Vec<bool> = scene
        .instances
        .iter()
        .map(|i| i.moves || i.deforms)
        .collect();
    let tracer = CpuTracer::new(scene, &pose, &deformed, &moves);
    let tracer = tracer.map_err(|error| error.to_string())?;
    let vertices = |instance: u32| -> &[Vec3] {
        match deformed.binary_search_by_key(&instance, |d| d.instance) {
            Ok(at) => &deformed[at].positions,
            Err(_) => &scene.meshes[scene.instances[instance as usize].mesh as usize].positions,
        }
    };
    path_through(scene, &pose, &tracer, &vertices, 0, aspect)
}

/// Lines for the corner of the picture.
fn text(feed: &Feed, pictures: &Pictures, mode: Mode, overlay: Overlay, mbit: f64) -> Vec<String> {
    let cells = feed
        .client
        .mirror()
        .cells()
        .iter()
        .filter(|cell| !cell.is_empty())
        .count();
    let mode = match mode {
        Mode::Ao => "stream".into(),
        Mode::Reference => format!("rays ({} of 512)", pictures.rays()),
        Mode::Screen => "screen space".into(),
        Mode::Off => "off".into(),
    };
    vec![
        format!("occlusion  {mode}"),
        format!("overlay    {}", format!("{overlay:?}").to_lowercase()),
        format!("time       {:.2} s", feed.time_s()),
        format!("stream     {mbit:.2} Mbit/s"),
        format!("cells      {cells}"),
        match pictures.occlusion_ms {
            Some(ms) => format!("GPU        {ms:.2} ms for occlusion"),
            None => "GPU        not timed".into(),
        },
    ]
}

/// Rays that each picture of the reference adds, where nobody waits for it.
const RAYS: u32 = 32;

fn headless(
    args: &Args,
    scene: &Scene,
    mut feed: Feed,
    out: &std::path::Path,
) -> Result<(), String> {
    let gpu = Gpu::open()?;
    let size = [args.size.0 as u32, args.size.1 as u32];
    let path = path(scene, args.size.0 as f32 / args.size.1 as f32)?;
    let told = |camera: &Camera| uplink_camera(camera, scene.origin, size[1]);
    feed.tell(&told(&path.at(0.0)));
    let usage = wgpu::TextureUsages::RENDER_ATTACHMENT;
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let target = gpu.texture("picture", size, 1, format, usage)?;
    let mut pictures = None;
    while u64::from(args.frames) > feed.client.stats().frames && feed.wait()? {
        feed.tell(&told(&path.at(feed.time_s())));
        if pictures.is_none() && feed.client.is_whole() {
            pictures = Some(Pictures::new(&gpu, scene, size, format, &feed.client)?);
        }
        if let Some(pictures) = &mut pictures {
            // Each frame on its own, for the overlay of what changed.
            pictures.take(&gpu, &mut feed.client)?;
        }
    }
    let (Some(last), Some(mut pictures)) = (feed.last, pictures) else {
        return Err(format!("{}: there is no frame in it", args.source));
    };
    let seconds = last.time_ns as f64 * 1e-9;
    let mbit = feed.client.stats().bytes as f64 * 8e-6 / seconds.max(1.0);
    let camera = path.at(seconds);
    let count = if args.mode == Mode::Reference {
        // The last says that it has them all.
        REFERENCE_RAYS as u32 / RAYS + 1
    } else {
        2
    };
    for _ in 0..count {
        // The second knows how long the first took.
        let text = text(&feed, &pictures, args.mode, args.overlay, mbit);
        let shown = Shown {
            camera: &camera,
            mode: args.mode,
            rays: RAYS,
            overlay: args.overlay,
            text: &text,
        };
        let view = target.create_view(&Default::default());
        pictures.draw(&gpu, scene, seconds, &mut feed.client, &shown, &view)?;
    }
    let rgba: Vec<[u8; 4]> = gpu.read_texture(&target)?;
    let rgb = rgba.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    Picture::rgb(rgb, args.size.0, args.size.1)
        .write_png(out)
        .map_err(|error| error.to_string())
}
