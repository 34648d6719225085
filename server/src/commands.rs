//! `psao serve`, `record`, `play` and `inspect`.

use crate::args::{Layout, SceneArgs, StreamArgs, TraceArgs, camera_path};
use crate::camera::Frustum;
use crate::encode::{Encoder, Eye, View, least_capacity};
use crate::identity::Identity;
use crate::server::{Pace, Server};
use crate::transport::{Transport, TransportConfig};
use crate::world::Progress;
use clap::Args;
use glam::Vec3;
use psao::quic::{Closed, Connect, Connection, Trust};
use psao::{Client, ClientError, Config, State};
use psao_core::Cell;
use psao_core::bins::MAX_CELLS;
use psao_core::mirror::Capacity;
use psao_core::stream::{
    Frame, Header, MAX_BODY_BYTES, PREAMBLE, Packet, Refusal, StreamError, flag, kind,
};
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Options of `psao serve`.
#[derive(Args, Clone, Debug)]
pub struct ServeArgs {
    /// The scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// The stream.
    #[command(flatten)]
    pub stream: StreamArgs,
    /// What traces rays.
    #[command(flatten)]
    pub trace: TraceArgs,
    /// Address and UDP port to listen on
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:4433")]
    pub listen: SocketAddr,
    /// What clients must present
    #[arg(long, env = "PSAO_TOKEN", hide_env_values = true)]
    pub token: String,
    /// Folder of the server's certificate and key; made on first use
    #[arg(long, value_name = "DIR", default_value = "psao-identity")]
    pub identity: PathBuf,
    /// Clients served at once
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub max_clients: usize,
    /// Stops after this many frames; without it, runs until it is ended
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
}

/// Options of `psao record`.
#[derive(Args, Clone, Debug)]
pub struct RecordArgs {
    /// The scene.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// The stream.
    #[command(flatten)]
    pub stream: StreamArgs,
    /// What traces rays.
    #[command(flatten)]
    pub trace: TraceArgs,
    /// The recording to write
    #[arg(value_name = "FILE.psao")]
    pub out: PathBuf,
    /// Frames to record
    #[arg(long, value_name = "N", default_value_t = 60)]
    pub frames: u32,
    /// Which of the two camera paths to walk, 0 or 1; without it, everything is in view
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1))]
    pub path: Option<u32>,
    /// Records no frames, but where all points are (profile residual): for an app to ship, so that
    /// no session has to send it
    #[arg(long)]
    pub topology: bool,
}

/// Rows of the picture that a recorded camera is taken to have.
const RECORDED_ROWS: u32 = 1080;

/// Options of `psao play`.
#[derive(Args, Clone, Debug)]
pub struct PlayArgs {
    /// A recording; or with --fingerprint, a server's address
    #[arg(value_name = "FILE.psao | HOST:PORT")]
    pub source: String,
    /// Fingerprint of the server's certificate, as `psao serve` prints it
    #[arg(long, value_name = "HEX")]
    pub fingerprint: Option<psao::quic::Fingerprint>,
    /// The server's token
    #[arg(long, env = "PSAO_TOKEN", hide_env_values = true, default_value = "")]
    pub token: String,
    /// Largest memory of the client's buffers, MiB
    #[arg(long, value_name = "MIB", default_value_t = 2048)]
    pub max_memory: u64,
    /// A recording of where all points are, which the server then need not send
    #[arg(long, value_name = "FILE.psao")]
    pub topology: Option<PathBuf>,
    /// Stops after this many frames
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
}

/// Options of `psao inspect`.
#[derive(Args, Clone, Debug)]
pub struct InspectArgs {
    /// A recording
    #[arg(value_name = "FILE.psao")]
    pub file: PathBuf,
}

/// Runs a server. Where it listens, and what clients need to know of it, goes to `out`.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn serve(args: &ServeArgs, out: &mut dyn Write, progress: Progress<'_>) -> Result<(), String> {
    let settings = args.stream.settings()?;
    let identity = Identity::load_or_create(&args.identity).map_err(|e| e.to_string())?;
    let fingerprint = identity.fingerprint();
    let world = (args.trace).world(&args.scene, args.stream.layout(), progress)?;
    let mut server = Server::new(world, settings);
    let mut transport = Transport::start(TransportConfig {
        listen: args.listen,
        identity,
        token: args.token.clone(),
        max_clients: args.max_clients,
        scene_hash: server.scene_hash(),
        capacity: least_capacity(&server.world),
    })
    .map_err(|error| error.to_string())?;
    let (address, scene_hash) = (transport.local_addr(), server.scene_hash());
    writeln!(
        out,
        "listening    {address}\nfingerprint  {fingerprint}\nscene hash   {scene_hash:016x}"
    )
    .map_err(|error| format!("standard output: {error}"))?;

    let period = Duration::from_secs_f32(1.0 / settings.rate_hz);
    let start = Instant::now();
    let mut next = start;
    let mut pace = Pace::default();
    let mut frames = 0;
    while args.frames.is_none_or(|last| frames < last) {
        let began = Instant::now();
        if args.scene.refresh_rays.is_none() {
            server.world.options.refresh_rays = pace.refresh_rays;
        }
        let time_s = (began - start).as_secs_f64();
        let report = server.frame(&mut transport, time_s, pace.converge_rays);
        let busy = began.elapsed().as_secs_f32() / period.as_secs_f32();
        pace.after(busy, &report.step);
        frames += 1;
        next = (next + period).max(Instant::now());
        std::thread::sleep(next - Instant::now().min(next));
    }
    transport.close();
    Ok(())
}

/// Records a scene's stream to a file, without a network. The file appears whole or not at all.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn record(args: &RecordArgs, progress: Progress<'_>) -> Result<u64, String> {
    if args.frames == 0 {
        return Err("--frames must be 1 or more".into());
    }
    if args.topology && args.stream.layout() == Layout::Cells {
        return Err("--topology needs --profile residual".into());
    }
    let error = |error: std::io::Error| {
        let out = args.out.display();
        format!("{out}: {error}: choose another place for the recording")
    };
    // First of all, so that nobody waits for a recording that cannot be kept.
    if args.out.is_dir() {
        return Err(error(std::io::ErrorKind::IsADirectory.into()));
    }
    let temporary = args.out.with_extension("psao.part");
    let file = File::create(&temporary).map_err(error)?;
    let recorded = record_to(file, args, progress, &error).and_then(|total| {
        std::fs::rename(&temporary, &args.out).map_err(error)?;
        Ok(total)
    });
    if recorded.is_err() {
        // What is left of it is of no use; the first error is the one that matters.
        let _ = std::fs::remove_file(&temporary);
    }
    recorded
}

fn record_to(
    file: File,
    args: &RecordArgs,
    progress: Progress<'_>,
    error: &dyn Fn(std::io::Error) -> String,
) -> Result<u64, String> {
    let settings = args.stream.settings()?;
    let mut world = (args.trace).world(&args.scene, args.stream.layout(), progress)?;
    let path = args
        .path
        .map(|which| camera_path(&world, which, 16.0 / 9.0))
        .transpose()?;
    let time_of = |frame: u32| f64::from(frame) / f64::from(settings.rate_hz);
    let view = |time: f64| {
        path.as_ref()
            .map(|path| Frustum::new(&path.at(time), settings.margin_rad))
    };
    let mut file = BufWriter::new(file);
    let mut encoder = Encoder::new(&world, settings.scheme, 0);
    let scene_hash = world.scene.hash();
    let mut bytes = encoder.header(&world, scene_hash, settings.rate_hz);
    if args.topology {
        encoder.all_patches(&world, &mut bytes);
        encoder.end(&mut bytes);
        file.write_all(&bytes).map_err(error)?;
        finish(file, error)?;
        return Ok(bytes.len() as u64);
    }
    let first = view(0.0);
    let report = |done, total| progress("first occlusion", done, total);
    world.converge(&|bounds| sees(&first, bounds), world.options.rays, &report);

    let mut total = 0;
    for frame in 0..args.frames {
        let time = time_of(frame);
        let frustum = view(time);
        let visible = |bounds: [Vec3; 2]| sees(&frustum, bounds);
        world.step(time, &visible, u64::MAX);
        encoder.merge(&world);
        world.clear_changes();
        let view = View {
            sees: &visible,
            eye: path
                .as_ref()
                .map(|path| Eye::of(&path.at(time), RECORDED_ROWS)),
        };
        encoder.frame(&world, (time * 1e9) as u64, &view, true, &mut bytes);
        if frame + 1 == args.frames {
            encoder.end(&mut bytes);
        }
        file.write_all(&bytes).map_err(error)?;
        total += bytes.len() as u64;
        bytes.clear();
        progress("frames", u64::from(frame) + 1, u64::from(args.frames));
    }
    finish(file, error)?;
    Ok(total)
}

fn finish(file: BufWriter<File>, error: &dyn Fn(std::io::Error) -> String) -> Result<(), String> {
    let file = file.into_inner().map_err(|e| error(e.into_error()))?;
    file.sync_all().map_err(error)
}

fn sees(frustum: &Option<Frustum>, [min, max]: [Vec3; 2]) -> bool {
    frustum
        .as_ref()
        .is_none_or(|frustum| frustum.sees_box(min, max))
}

/// What a client made of a stream: what, and its value.
pub type Table = Vec<(String, String)>;

/// Follows a recording, or a live server.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn play(args: &PlayArgs) -> Result<Table, String> {
    let capacity = capacity_within(args.max_memory);
    let mut player = Player {
        client: Client::new(Config {
            capacity,
            scene_hash: 0,
        }),
        frames: args.frames,
        first_ns: 0,
        last: Frame::default(),
        decode: Vec::new(),
        end: None,
    };
    if let Some(topology) = &args.topology {
        player.file(topology)?;
        player.client.restart();
    }
    match &args.fingerprint {
        None => player.file(Path::new(&args.source))?,
        Some(fingerprint) => player.live(args, *fingerprint, capacity)?,
    }
    Ok(player.table())
}

/// The largest mirror in this much memory: a third for cells, as many points as are usual in them,
/// and what goes with both.
pub fn capacity_within(mebibytes: u64) -> Capacity {
    let cells = (mebibytes.min(1 << 20) << 20) / 3 / size_of::<Cell>() as u64;
    let cells = u32::try_from(cells).unwrap_or(MAX_CELLS).min(MAX_CELLS);
    Capacity {
        instances: 1 << 20,
        buckets: cells / 2,
        cells,
        slices: cells / 8,
        points: cells.saturating_mul(3),
        patches: cells / 8,
        topology_bytes: cells.saturating_mul(6),
    }
}

/// The least `--max-memory` whose [`capacity_within`] holds this.
fn max_memory_for(needed: Capacity) -> u64 {
    let holds = |mebibytes: &u64| capacity_within(*mebibytes).holds(&needed);
    let doubled = (0..21).map(|doublings| 1u64 << doublings).find(holds);
    let most = doubled.unwrap_or(1 << 20);
    (most / 2..=most).find(holds).unwrap_or(most)
}

fn unreadable(path: &Path, error: &std::io::Error) -> String {
    format!(
        "{}: {error}: give a file that `psao record` has written",
        path.display()
    )
}

struct Player {
    client: Client,
    /// Stops after so many.
    frames: Option<u64>,
    first_ns: u64,
    last: Frame,
    /// Milliseconds of decoding a frame.
    decode: Vec<f64>,
    /// Why a live server went, if nothing is wrong with that.
    end: Option<String>,
}

impl Player {
    fn file(&mut self, path: &Path) -> Result<(), String> {
        let error = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        let mut file = File::open(path).map_err(|error| {
            let is_address = path.to_str().is_some_and(|text| text.contains(':'));
            unreadable(path, &error)
                + if is_address {
                    "; a server needs --fingerprint"
                } else {
                    ""
                }
        })?;
        let mut chunk = vec![0; 1 << 16];
        while self.wants_more() {
            let count = file.read(&mut chunk).map_err(|e| error(&e))?;
            if count == 0 {
                break;
            }
            self.push(&chunk[..count], |_| ()).map_err(|e| error(&e))?;
        }
        if self.client.state() != State::Ended && self.wants_more() {
            return Err(error(
                &"the recording breaks off: it was not written to its end",
            ));
        }
        Ok(())
    }

    fn live(
        &mut self,
        args: &PlayArgs,
        fingerprint: psao::quic::Fingerprint,
        capacity: Capacity,
    ) -> Result<(), String> {
        let mut connection = Connection::open(Connect {
            address: &args.source,
            server_name: None,
            token: &args.token,
            trust: Trust::Fingerprint(fingerprint),
            scene_hash: 0,
            capacity,
            topology_hash: self.client.topology_hash(),
        })
        .map_err(|error| error.to_string())?;
        let mut received = Vec::new();
        while self.wants_more() {
            received.clear();
            match connection.receive_timeout(&mut received, Duration::from_secs(1)) {
                Ok(_) => {}
                Err(Closed::Ended) => break,
                Err(Closed::Done(why)) => {
                    self.end = Some(why);
                    break;
                }
                Err(closed) => return Err(closed.to_string()),
            }
            // A lost acknowledgement is made up for by the next.
            self.push(&received, |frame| {
                let _ = connection.ack(frame.id);
            })?;
            if self.client.state() == State::Desynchronised && self.client.stats().frames > 0 {
                connection.resync().map_err(|error| error.to_string())?;
            }
        }
        connection.close();
        Ok(())
    }

    fn wants_more(&self) -> bool {
        self.client.state() != State::Ended
            && self
                .frames
                .is_none_or(|frames| self.client.stats().frames < frames)
    }

    fn push(&mut self, bytes: &[u8], completed: impl Fn(&Frame)) -> Result<(), String> {
        let mut rest = bytes;
        let mut start = Instant::now();
        while !rest.is_empty() && self.wants_more() {
            let pushed = self.client.push(rest).map_err(|error| match error {
                ClientError::Capacity(needed) => format!(
                    "the stream needs a larger mirror: give --max-memory {}",
                    max_memory_for(needed)
                ),
                other => other.to_string(),
            })?;
            rest = &rest[pushed.consumed..];
            if let Some(frame) = pushed.frame {
                if self.client.stats().frames == 1 {
                    self.first_ns = frame.time_ns;
                }
                self.decode.push(start.elapsed().as_secs_f64() * 1e3);
                self.last = frame;
                self.client.clear_dirty();
                completed(&frame);
                start = Instant::now();
            }
        }
        Ok(())
    }

    fn table(mut self) -> Table {
        let stats = self.client.stats();
        let seconds = self.last.time_ns.saturating_sub(self.first_ns) as f64 / 1e9;
        self.decode.sort_by(f64::total_cmp);
        let decode = self
            .decode
            .get(self.decode.len() / 2)
            .copied()
            .unwrap_or(0.0);
        let row = |what: &str, value: String| (what.to_string(), value);
        let end = self.end.take().map(|why| row("end", why));
        let rows = vec![
            row(
                "frames",
                format!("{} ({} snapshots)", stats.frames, stats.snapshots),
            ),
            row("scene time", format!("{seconds:.2} s")),
            row("bytes", stats.bytes.to_string()),
            row(
                "changes",
                format!(
                    "{} cells, {} buckets, {} instances, {} slices, {} patches",
                    stats.cells, stats.buckets, stats.instances, stats.slices, stats.patches
                ),
            ),
            row(
                "mirror hash",
                format!("{:016x}", self.client.mirror().hash()),
            ),
            row("hash mismatches", stats.mismatches.to_string()),
            row("decoding", format!("{decode:.3} ms a frame (median)")),
            row(
                "client's memory",
                format!("{:.1} MB", self.client.memory_bytes() as f64 / 1e6),
            ),
        ];
        end.into_iter().chain(rows).collect()
    }
}

/// Prints what is in a recording, a line a frame, while it reads it.
///
/// # Errors
/// The file is no recording, or is damaged (where).
pub fn inspect(args: &InspectArgs, out: &mut dyn Write) -> Result<(), String> {
    let name = args.file.display();
    let unreadable = |error| unreadable(&args.file, &error);
    let file = File::open(&args.file).map_err(unreadable)?;
    let more = |bytes: &mut Vec<u8>| (&file).take(1 << 16).read_to_end(bytes);
    let print = |out: &mut dyn Write, line: String| {
        writeln!(out, "{line}").map_err(|error| format!("standard output: {error}"))
    };
    // What was read of the file, from `at` on; `used` of it are done with.
    let (mut bytes, mut at, mut used) = (Vec::new(), 0, 0);
    more(&mut bytes).map_err(unreadable)?;
    if !bytes.starts_with(&PREAMBLE) {
        return Err(format!("{name}: at byte 0: {}", StreamError::NotAStream));
    }
    used += PREAMBLE.len();
    let (mut packets, mut frame_bytes) = (0, 0);
    loop {
        let fail =
            |error: &dyn std::fmt::Display| format!("{name}: at byte {}: {error}", at + used);
        let read = Packet::read(&bytes[used..], MAX_BODY_BYTES).map_err(|error| fail(&error))?;
        let Some((packet, length)) = read else {
            let left = bytes.len() - used;
            let breaks_off = fail(&"the recording breaks off");
            bytes.drain(..used);
            at += used;
            used = 0;
            if more(&mut bytes).map_err(unreadable)? > 0 {
                continue;
            }
            return if left == 0 { Ok(()) } else { Err(breaks_off) };
        };
        match packet.kind {
            kind::HEADER => {
                let header = Header::read(packet.body).map_err(|error| fail(&error))?;
                print(out, format!("{header:#?}"))?;
                print(out, "frame      time s  packets     bytes     check".into())?;
            }
            kind::FRAME | kind::SLICES => {
                let (frame, _) = Frame::read(packet.body).map_err(|error| fail(&error))?;
                packets += 1;
                frame_bytes += length;
                if packet.flags & flag::LAST != 0 {
                    let Frame {
                        id,
                        time_ns,
                        mirror_check,
                    } = frame;
                    let seconds = time_ns as f64 / 1e9;
                    let line = format!(
                        "{id:>5}  {seconds:>10.4}  {packets:>7}  {frame_bytes:>8}  {mirror_check:08x}"
                    );
                    print(out, line)?;
                    (packets, frame_bytes) = (0, 0);
                }
            }
            kind::PATCHES => print(out, format!("patches, {length} bytes"))?,
            kind::END => print(out, "end".into())?,
            kind::REFUSE => {
                let code = packet
                    .body
                    .first_chunk()
                    .map_or(0, |code| u16::from_le_bytes(*code));
                print(out, format!("refused: {:?}", Refusal::from_code(code)))?;
            }
            other => print(
                out,
                format!("packet of unknown kind {other}, {length} bytes"),
            )?,
        }
        used += length;
    }
}
