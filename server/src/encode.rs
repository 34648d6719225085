//! Select and encode: what one client (or a group that shares a view) lacks, as stream bytes.
//!
//! The encoder holds an exact copy of the client's mirror and compares the truth with it, so a
//! threshold is always against what was last *sent*, and what could not be sent in one frame
//! (out of view, over the budget, or the link was busy) is simply found again in a later one,
//! merged.

mod cells;
mod residual;
mod sight;

pub use cells::{NORMAL_THRESHOLD, POSITION_THRESHOLD, RAW_BYTES};
pub use residual::Limits;

use crate::camera::Camera;
use crate::facing::{AWAY, Faces};
use crate::world::{Slice, World};
use glam::Vec3;
use psao::memory::{Heap, SliceHeap};
use psao_core::mirror::Capacity;
use psao_core::residual::Quantiser;
use psao_core::stream::{
    self, FRAME_HEADER_BYTES, Frame, Header, PACKET_HEADER_BYTES, PREAMBLE, Profile,
    RAW_LENGTH_BYTES, StreamError, Writer, flag, kind, mirror_check, write_packet,
};
use psao_core::{Bucket, Cell, Instance, Mirror};
use rayon::prelude::*;
use std::time::Instant;
use zstd::zstd_safe::{CCtx, CParameter, Strategy, compress_bound};

/// How a stream carries changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scheme {
    /// Profile `cells`: whole cells, sent again when a point's occlusion is off by more than
    /// `threshold` (1/255).
    Cells {
        /// Occlusion differences up to this many 1/255 are not sent.
        threshold: u8,
        /// How hard zstd tries.
        compression: Compression,
    },
    /// Profile `residual`: where points are once, a mesh; then their occlusion alone.
    Residual(Quantiser, Limits),
}

/// How hard zstd tries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// Level 1: for live streams.
    Fast,
    /// Level 15, strategy 4: the paper's, for figures.
    Paper,
}

/// What one client looks at.
pub struct View<'a> {
    /// Whether it sees any of a box of the world, relative to the scene's origin, now or soon.
    pub sees: &'a (dyn Fn([Vec3; 2]) -> bool + Sync),
    /// From where; `None` until it has said so.
    pub eye: Option<Eye>,
}

impl View<'_> {
    /// Those of some blocks of a slice in view that the picture may show ([`World::facing`]).
    pub fn blocks(&self, world: &World, slice: &Slice, of: u64) -> Faces {
        let Some(eye) = self.eye else {
            let Faces { any, all } = Faces::all_of(slice);
            let (any, all) = (any & of, all & of);
            return Faces { any, all };
        };
        let faces = world.facing(slice, eye.camera.position);
        let mut any = 0;
        let mut left = faces.any & of;
        while left != 0 {
            let block = left.trailing_zeros();
            left &= left - 1;
            let seen = (self.sees)(world.block_bounds(slice, block as usize));
            any |= u64::from(seen) << block;
        }
        let all = faces.all & any;
        Faces { any, all }
    }

    /// Whether the picture may show what a point says, if its slice is in sight: it is in view, and
    /// faces the eye.
    pub fn needs(&self, world: &World, instance: u32, number: u32) -> bool {
        self.eye.is_none_or(|eye| {
            let [at, normal] = world.point_in_world(instance, number);
            let to = eye.camera.position - at;
            normal.dot(to) > AWAY * to.length() && (self.sees)([at, at])
        })
    }
}

/// Where a client looks from, and how finely.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eye {
    /// Relative to the scene's origin.
    pub camera: Camera,
    /// Pixels a radian in the middle of the picture; 0 if the client has not said.
    pub pixels_per_radian: f32,
}

impl Eye {
    /// Of a camera whose picture has so many rows.
    pub fn of(camera: &Camera, height_px: u32) -> Eye {
        Eye {
            camera: *camera,
            pixels_per_radian: height_px as f32 * 0.5 / (camera.fov_y_rad * 0.5).tan(),
        }
    }
}

/// What one frame cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Instances sent.
    pub instances: u32,
    /// Buckets sent (profile `cells`).
    pub buckets: u32,
    /// Cells sent (profile `cells`).
    pub cells: u32,
    /// Slices whose occlusion was sent (profile `residual`).
    pub slices: u32,
    /// Slices opened, among these.
    pub opened: u32,
    /// Slices closed.
    pub closed: u32,
    /// Slices that waited for room in the budget.
    pub waiting: u32,
    /// Patches sent.
    pub patches: u32,
    /// Bytes of these in the stream.
    pub patch_bytes: u64,
    /// Bytes of the frame in the stream, patches included.
    pub bytes: u64,
    /// Time for coding and packing, nanoseconds, summed over threads; the rest of the frame's time
    /// is for finding what the client lacks.
    pub encode_ns: u64,
}

/// One client's view of the truth.
pub struct Encoder {
    scheme: Scheme,
    sent: Sent,
    frame_id: u32,
    sequence: u16,
    snapshot: bool,
}

/// What the client has.
enum Sent {
    Cells(Box<cells::Cells>),
    Residual(Box<residual::Residual>),
}

impl Encoder {
    /// A client that has nothing but, in profile `residual`, perhaps all patches: `topology_hash`
    /// as its hello said.
    ///
    /// # Panics
    /// If the world is not laid out for the scheme ([`crate::world::Options::rest_space`]).
    pub fn new(world: &World, scheme: Scheme, topology_hash: u64) -> Encoder {
        let residual = matches!(scheme, Scheme::Residual(..));
        assert_eq!(
            world.options.rest_space, residual,
            "profile residual needs points in rest space, cells in posed space"
        );
        let sent = match scheme {
            Scheme::Cells {
                threshold,
                compression,
            } => {
                let capacity = capacity_of(world);
                Sent::Cells(Box::new(cells::Cells::new(
                    world,
                    capacity,
                    threshold,
                    compression,
                )))
            }
            Scheme::Residual(quantiser, limits) => {
                let had = topology_hash != 0 && topology_hash == world.topology.hash;
                Sent::Residual(Box::new(residual::Residual::new(
                    world, quantiser, limits, had,
                )))
            }
        };
        Encoder {
            scheme,
            sent,
            frame_id: 0,
            sequence: 0,
            snapshot: true,
        }
    }

    /// The stream's first bytes.
    pub fn header(&mut self, world: &World, scene_hash: u64, rate_hz: f32) -> Vec<u8> {
        let mut header = Header {
            profile: Profile::Cells,
            kernel: world.options.kernel,
            scene_hash,
            capacity: capacity_of(world),
            max_body_bytes: (FRAME_HEADER_BYTES + RAW_LENGTH_BYTES + compress_bound(RAW_BYTES))
                as u32,
            max_raw_bytes: RAW_BYTES as u32,
            ao_distance_m: world.options.ao_distance_m,
            density: world.options.density as f32,
            rate_hz,
            ..Header::default()
        };
        match (&mut self.sent, self.scheme) {
            (Sent::Residual(sent), Scheme::Residual(quantiser, _)) => {
                header.profile = Profile::Residual;
                header.capacity = sent.capacity();
                header.threshold = quantiser.bound();
                header.step = quantiser.step;
                header.topology_hash = world.topology.hash;
                sent.rate_hz = rate_hz;
            }
            (_, Scheme::Cells { threshold, .. }) => header.threshold = threshold,
            _ => {}
        }
        let mut out = PREAMBLE.to_vec();
        self.packet(&mut out, kind::HEADER, 0, 256, |w| header.write(w));
        out
    }

    /// All patches, as a recording that an app can ship has them between header and end.
    pub fn all_patches(&mut self, world: &World, out: &mut Vec<u8>) {
        if let Sent::Residual(sent) = &mut self.sent {
            let all: Vec<u32> = (0..world.topology.patches()).collect();
            for body in sent.patches(world, &all) {
                self.packet(out, kind::PATCHES, 0, body.len(), |w| w.bytes(&body));
            }
        }
    }

    /// The client lost track: it gets everything in view anew.
    pub fn resync(&mut self) {
        match &mut self.sent {
            Sent::Cells(sent) => sent.reset(),
            Sent::Residual(sent) => sent.reset(),
        }
        self.snapshot = true;
    }

    /// Lowers each instance's level of detail to the finest that the client has, or may get at
    /// once: from the levels of all clients, [`World::finest_levels`].
    pub fn want_levels(&self, finest: &mut [u32]) {
        match &self.sent {
            Sent::Cells(_) => finest.fill(0),
            Sent::Residual(sent) => sent.want_levels(finest),
        }
    }

    /// [`Limits::max_mbit`] from the next frame on; profile `cells` has no such limit.
    pub fn set_max_mbit(&mut self, max_mbit: f64) {
        if let Sent::Residual(sent) = &mut self.sent {
            sent.set_max_mbit(max_mbit);
        }
    }

    /// What the world changed in a step. To be called after every step, sent or not.
    pub fn merge(&mut self, world: &World) {
        match &mut self.sent {
            Sent::Cells(sent) => sent.merge(&world.truth),
            Sent::Residual(sent) => sent.merge(world),
        }
    }

    /// Appends a frame with all that is in view and differs. A frame without changes is
    /// appended only on demand (`always`), and says that the client is up to date at `time_ns`.
    pub fn frame(
        &mut self,
        world: &World,
        time_ns: u64,
        view: &View<'_>,
        always: bool,
        out: &mut Vec<u8>,
    ) -> FrameStats {
        let start = out.len();
        let mut stats = FrameStats::default();
        let mut coarse = 0;
        let mut packets = match &mut self.sent {
            Sent::Cells(sent) => sent.frame(world, view, &mut stats),
            Sent::Residual(sent) => {
                let frame = sent.frame(world, view, &mut stats);
                let packing = Instant::now();
                for body in frame.patches {
                    self.packet(out, kind::PATCHES, 0, body.len(), |w| w.bytes(&body));
                }
                stats.encode_ns += packing.elapsed().as_nanos() as u64;
                stats.patch_bytes = (out.len() - start) as u64;
                coarse = frame.coarse;
                frame.packets
            }
        };
        let wanted = always || self.snapshot || out.len() > start;
        if packets.is_empty() && wanted {
            packets.push((kind::FRAME, Vec::new()));
        }
        if !packets.is_empty() {
            let packing = Instant::now();
            self.frame_id += 1;
            self.write_frame(&packets, coarse, time_ns, out);
            stats.encode_ns += packing.elapsed().as_nanos() as u64;
        }
        stats.bytes = (out.len() - start) as u64;
        // Frames that send nothing pay for those that sent too much.
        if let Sent::Residual(sent) = &mut self.sent {
            sent.spent(stats.bytes);
        }
        stats
    }

    fn write_frame(
        &mut self,
        packets: &[(u8, Vec<u8>)],
        coarse: u8,
        time_ns: u64,
        out: &mut Vec<u8>,
    ) {
        for (index, (kind, body)) in packets.iter().enumerate() {
            let mut flags = 0;
            if *kind == kind::SLICES {
                flags |= coarse << flag::COARSE.trailing_zeros();
            }
            let mut frame = Frame {
                id: self.frame_id,
                time_ns,
                mirror_check: 0,
            };
            if self.snapshot {
                flags |= flag::SNAPSHOT;
                self.snapshot = false;
            }
            if index + 1 == packets.len() {
                flags |= flag::LAST;
                frame.mirror_check = mirror_check(self.mirror().hash());
            }
            self.packet(out, *kind, flags, FRAME_HEADER_BYTES + body.len(), |w| {
                frame.write(w)?;
                w.bytes(body)
            });
        }
        match &mut self.sent {
            Sent::Cells(sent) => sent.mirror.clear_dirty(),
            Sent::Residual(sent) => sent.mirror.clear_dirty(),
        }
    }

    fn packet(
        &mut self,
        out: &mut Vec<u8>,
        kind: u8,
        flags: u8,
        room: usize,
        body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
    ) {
        let start = out.len();
        out.resize(start + PACKET_HEADER_BYTES + room, 0);
        let written = write_packet(&mut out[start..], kind, flags, self.sequence, body)
            .expect("a packet has the room asked for");
        out.truncate(start + written);
        self.sequence = self.sequence.wrapping_add(1);
    }

    /// The stream's last packet.
    pub fn end(&mut self, out: &mut Vec<u8>) {
        self.packet(out, kind::END, 0, 0, |_| Ok(()));
    }

    /// What the client has.
    pub fn mirror(&self) -> &Mirror<Heap> {
        match &self.sent {
            Sent::Cells(sent) => &sent.mirror,
            Sent::Residual(sent) => &sent.mirror,
        }
    }

    /// What the client has beside the mirror (profile `residual`).
    pub fn slices(&self) -> Option<&SliceHeap> {
        match &self.sent {
            Sent::Cells(_) => None,
            Sent::Residual(sent) => Some(&sent.heap),
        }
    }

    /// Profile `residual`: cells that the client has, and that it would have if nothing were left
    /// out for being open.
    pub fn cells(&self, world: &World) -> Option<[usize; 2]> {
        match &self.sent {
            Sent::Cells(_) => None,
            Sent::Residual(sent) => Some(sent.cells(world)),
        }
    }

    /// Root mean square difference between what a client has and the truth, in 1/255, over the
    /// points that its view needs: in view and facing the eye ([`View::needs`]), in slices of which
    /// something has been in sight so far. In profile `cells`, which makes no such choice, call it after each
    /// frame. `slices`: the client's, of profile `residual`.
    pub fn point_rmse(
        &mut self,
        world: &World,
        mirror: &Mirror<Heap>,
        slices: Option<&SliceHeap>,
        view: &View<'_>,
    ) -> f64 {
        let needed = match &mut self.sent {
            Sent::Cells(sent) => {
                sent.sight.look(world, view);
                sent.sight.needed()
            }
            Sent::Residual(sent) => sent.needed(),
        };
        let of_slice = |index: &u32| {
            let slice = &world.slices[*index as usize];
            let (mut sum, mut count) = (0u64, 0u64);
            // A point the client does not have counts as wholly wrong.
            let mut add = |number: u32, have: Option<u8>| {
                if view.needs(world, slice.instance, number) {
                    let want = world.occlusion_of(number);
                    let off = have.map_or(255, |have| u64::from(want.abs_diff(have)));
                    sum += off * off;
                    count += 1;
                }
            };
            if let Some(slices) = slices {
                let level = mirror.instances()[slice.instance as usize].level;
                let mut have = slices.values(&slices.get()[*index as usize]).iter();
                for (number, has) in slice.points.clone().zip(world.levels(slice)) {
                    if u32::from(*has) >= level {
                        add(number, have.next().copied());
                    }
                }
            } else {
                for number in slice.points.clone() {
                    // Those without a cell are in nobody's.
                    if let Some((cell, at)) = world.place_of(number) {
                        let have = mirror.cells()[cell as usize].points[at];
                        add(number, have.is_allocated().then(|| have.occlusion()));
                    }
                }
            }
            (sum, count)
        };
        let add = |a: (u64, u64), b: (u64, u64)| (a.0 + b.0, a.1 + b.1);
        let (sum, count) = needed.par_iter().map(of_slice).reduce(|| (0, 0), add);
        (sum as f64 / count.max(1) as f64).sqrt()
    }

    /// The number of the last frame.
    pub fn frame_id(&self) -> u32 {
        self.frame_id
    }
}

/// Room that a client needs to have everything at once.
pub fn capacity_of(world: &World) -> Capacity {
    let (truth, topology) = (&world.truth, &world.topology);
    if !world.options.rest_space {
        return Capacity {
            instances: truth.instances.len() as u32,
            buckets: truth.buckets.len() as u32,
            cells: truth.cells.len() as u32,
            ..Capacity::default()
        };
    }
    let levels = topology.of_instance.iter().flatten();
    let cells: usize = levels
        .map(|&(set, level)| topology.sets[set as usize].levels[level as usize].cells)
        .sum();
    Capacity {
        instances: truth.instances.len() as u32,
        buckets: truth.buckets.len() as u32,
        cells: cells as u32 + 1,
        slices: world.slices.len() as u32,
        points: world.point_count() as u32,
        patches: topology.patches(),
        topology_bytes: topology.bytes(),
    }
}

/// Room that a client needs at least: in profile `residual` it need not have everything at once.
pub fn least_capacity(world: &World) -> Capacity {
    let all = capacity_of(world);
    if !world.options.rest_space {
        return all;
    }
    Capacity {
        points: all.points.min(LEAST_POINTS),
        cells: all.cells.min(LEAST_POINTS),
        ..all
    }
}

/// As many points (and cells) as a client should have room for.
const LEAST_POINTS: u32 = 1 << 16;

/// A refusal packet after the preamble.
pub fn refusal(reason: stream::Refusal) -> Vec<u8> {
    let text = reason.to_string();
    let mut out = PREAMBLE.to_vec();
    let start = out.len();
    out.resize(start + PACKET_HEADER_BYTES + 2 + text.len(), 0);
    write_packet(&mut out[start..], kind::REFUSE, 0, 0, |w| {
        w.u16(reason as u16)?;
        w.bytes(text.as_bytes())
    })
    .expect("a refusal has the room asked for");
    out
}

fn write_content(
    w: &mut Writer<'_>,
    instances: &[(u32, Instance)],
    buckets: &[(u32, Bucket)],
    cells: &[(u32, Cell)],
) -> Result<(), StreamError> {
    for count in [instances.len(), buckets.len(), cells.len()] {
        w.u32(count as u32)?;
    }
    w.list(instances)?;
    w.list(buckets)?;
    w.list(cells)
}

fn compressor(compression: Compression) -> CCtx<'static> {
    let mut zstd = CCtx::create();
    let parameters: &[CParameter] = match compression {
        Compression::Fast => &[CParameter::CompressionLevel(1)],
        Compression::Paper => &[
            CParameter::CompressionLevel(15),
            CParameter::Strategy(Strategy::ZSTD_lazy),
        ],
    };
    for parameter in parameters {
        zstd.set_parameter(*parameter)
            .expect("zstd knows its own parameters");
    }
    zstd
}

/// The content of a frame packet.
fn compress(zstd: &mut CCtx<'_>, raw: &[u8]) -> Vec<u8> {
    if raw.is_empty() {
        return Vec::new();
    }
    let mut compressed = Vec::with_capacity(compress_bound(raw.len()));
    zstd.compress2(&mut compressed, raw)
        .expect("zstd has the room it asked for");
    [&(raw.len() as u32).to_le_bytes(), compressed.as_slice()].concat()
}
