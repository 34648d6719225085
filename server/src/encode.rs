//! Select and encode: what one client (or a group that shares a view) lacks, as stream bytes.
//!
//! The encoder holds an exact copy of the client's mirror and compares the truth with it, so a
//! threshold is always against what was last *sent*, and what could not be sent in one frame
//! (out of view, or the link was busy) is simply found again in a later one, merged.

use crate::truth::Truth;
use crate::world::World;
use psao::memory::{Heap, SliceHeap};
use psao_core::mirror::Capacity;
use psao_core::residual::{
    MAX_SLICE_BYTES, Neighbours, Quantiser, SLICE_POINTS, SliceState, encode_slice,
};
use psao_core::slices::{FIRST, Item, Slice, Values, store};
use psao_core::stream::{
    self, CHANGES_HEADER_BYTES, FRAME_HEADER_BYTES, Frame, Header, PACKET_HEADER_BYTES, PREAMBLE,
    Profile, StreamError, Writer, apply_changes, flag, kind, write_packet,
};
use psao_core::{Bucket, Cell, Instance, Mirror, Point, dirty, point};
use rayon::prelude::*;
use zstd::zstd_safe::{CCtx, CParameter, Strategy, compress_bound};

/// Largest content of a frame packet before compression: a client keeps one in memory.
pub const RAW_BYTES: usize = 1 << 20;

/// A point is sent again when it is off by more than this many position steps on an axis.
pub const POSITION_THRESHOLD: u32 = 1;

/// A point is sent again when its normal is off by more than this (as a dot product; 11 degrees,
/// one step of the code where it is coarsest).
pub const NORMAL_THRESHOLD: f32 = 0.98;

/// How a stream carries changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheme {
    /// Profile `cells`: whole cells, sent again when a point's occlusion is off by more than
    /// `threshold` (1/255).
    Cells {
        /// Occlusion differences up to this many 1/255 are not sent.
        threshold: u8,
        /// How hard zstd tries.
        compression: Compression,
    },
    /// Profile `residual`: each cell once, then its points' occlusion alone.
    Residual(Quantiser),
}

/// How hard zstd tries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// Level 1: for live streams.
    Fast,
    /// Level 15, strategy 4: the paper's, for figures.
    Paper,
}

/// What one frame cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Instances, buckets and cells sent.
    pub instances: u32,
    /// Buckets sent.
    pub buckets: u32,
    /// Cells sent.
    pub cells: u32,
    /// Slices sent (profile `residual`).
    pub slices: u32,
    /// Bytes of the frame in the stream.
    pub bytes: u64,
}

/// One client's view of the truth.
pub struct Encoder {
    mirror: Mirror<Heap>,
    scheme: Scheme,
    /// Profile `residual`: all slices, and what the codec keeps of them.
    runs: Vec<CellRun>,
    run_of_cell: Vec<u32>,
    slices: SliceHeap,
    /// Cells that may differ from the mirror; and buckets that the mirror has something in.
    due_cells: Vec<u64>,
    due_buckets: Vec<u64>,
    /// Scratch: what this frame sends.
    send_cells: Vec<u64>,
    send_buckets: Vec<u64>,
    frame_id: u32,
    sequence: u32,
    snapshot: bool,
}

/// A slice of profile `residual`: a run of cells with at most [`SLICE_POINTS`] points.
#[derive(Clone, Debug)]
struct CellRun {
    /// The world's slice that opened the cells: decides visibility.
    world_slice: u32,
    cells: std::ops::Range<u32>,
    /// The client has it.
    open: bool,
    /// Its occlusion may differ from the client's.
    due: bool,
}

impl Encoder {
    /// A client that has nothing.
    ///
    /// # Panics
    /// For profile `residual` in a world that is not laid out in rest space.
    pub fn new(world: &World, scheme: Scheme) -> Encoder {
        let truth = &world.truth;
        let capacity = capacity_of(truth);
        let mut runs = Vec::new();
        let mut run_of_cell = Vec::new();
        let mut slices = SliceHeap::default();
        if let Scheme::Residual(_) = scheme {
            assert!(
                world.options.rest_space,
                "profile residual needs points in rest space"
            );
            runs = cell_runs(world);
            run_of_cell = vec![0; truth.cells.len()];
            let mut points = 0;
            for (index, run) in runs.iter().enumerate() {
                let cells = run.cells.start as usize..run.cells.end as usize;
                points += truth.cells[cells.clone()]
                    .iter()
                    .map(Cell::len)
                    .sum::<usize>();
                run_of_cell[cells].fill(index as u32);
            }
            slices = SliceHeap::new(runs.len() as u32, points as u32);
        }
        let mut due_cells = vec![0; dirty::words(truth.cells.len())];
        dirty::mark_all(&mut due_cells, truth.cells.len());
        Encoder {
            mirror: Mirror::new(Heap::new(capacity)),
            scheme,
            runs,
            run_of_cell,
            slices,
            send_cells: vec![0; due_cells.len()],
            due_cells,
            due_buckets: vec![0; dirty::words(truth.buckets.len())],
            send_buckets: vec![0; dirty::words(truth.buckets.len())],
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
            capacity: capacity_of(&world.truth),
            max_body_bytes: (FRAME_HEADER_BYTES + compress_bound(RAW_BYTES)) as u32,
            max_raw_bytes: RAW_BYTES as u32,
            ao_distance_m: world.options.ao_distance_m,
            density: world.options.density as f32,
            rate_hz,
            ..Header::default()
        };
        match self.scheme {
            Scheme::Cells { threshold, .. } => header.threshold = threshold,
            Scheme::Residual(quantiser) => {
                header.profile = Profile::Residual;
                header.threshold = quantiser.bound();
                header.step = quantiser.step;
                header.slices = self.runs.len() as u32;
                header.points = self.slices.slices().last.len() as u32;
            }
        }
        let mut out = PREAMBLE.to_vec();
        self.packet(&mut out, kind::HEADER, 0, 256, |w| header.write(w));
        out
    }

    /// The client lost track: it gets everything in view anew.
    pub fn resync(&mut self) {
        self.mirror.reset();
        self.mirror.clear_dirty();
        let cells = self.mirror.capacity().cells as usize;
        dirty::mark_all(&mut self.due_cells, cells);
        self.slices.slices().reset();
        self.runs.iter_mut().for_each(|run| run.open = false);
        dirty::clear(
            &mut self.due_buckets,
            self.mirror.capacity().buckets as usize,
        );
        self.snapshot = true;
    }

    /// What the truth changed in a step. To be called after every step, sent or not.
    pub fn merge(&mut self, truth: &Truth) {
        let [_, buckets, cells] = truth.changes();
        for run in dirty::runs(cells, truth.cells.len()) {
            for cell in run {
                dirty::mark(&mut self.due_cells, truth.cells.len(), cell);
                if let Some(&run) = self.run_of_cell.get(cell) {
                    self.runs[run as usize].due = true;
                }
            }
        }
        for run in dirty::runs(buckets, truth.buckets.len()) {
            for bucket in run {
                // A bucket the client has nothing of comes along with its first cell.
                if self.mirror.buckets()[bucket] != Bucket::default() {
                    dirty::mark(&mut self.due_buckets, truth.buckets.len(), bucket);
                }
            }
        }
    }

    /// Appends a frame with all that is `visible` and differs. A frame without changes is
    /// appended only on demand (`always`), and says that the client is up to date at `time_ns`.
    pub fn frame(
        &mut self,
        world: &World,
        time_ns: u64,
        visible: &(dyn Fn([glam::Vec3; 2]) -> bool + Sync),
        always: bool,
        out: &mut Vec<u8>,
    ) -> FrameStats {
        let truth = &world.truth;
        match self.scheme {
            Scheme::Cells { threshold, .. } => self.select(world, visible, threshold),
            Scheme::Residual(_) => self.select_new(world, visible),
        }
        let instances: Vec<(u32, Instance)> = (0..truth.instances.len())
            .filter(|&i| self.mirror.instances()[i] != truth.instances[i])
            .map(|i| (i as u32, truth.instances[i]))
            .collect();
        let buckets: Vec<(u32, Bucket)> = elements(&self.send_buckets, &truth.buckets);
        let mut cells: Vec<(u32, Cell)> = elements(&self.send_cells, &truth.cells);
        if let Scheme::Residual(_) = self.scheme {
            // Where the points are; what they say follows.
            for point in cells.iter_mut().flat_map(|(_, cell)| &mut cell.points) {
                if point.is_allocated() {
                    *point = point.with_occlusion(255);
                }
            }
        }
        dirty::clear(&mut self.send_buckets, truth.buckets.len());
        dirty::clear(&mut self.send_cells, truth.cells.len());
        let mut stats = FrameStats {
            instances: instances.len() as u32,
            buckets: buckets.len() as u32,
            cells: cells.len() as u32,
            ..FrameStats::default()
        };
        let mut contents = if stats == FrameStats::default() {
            Vec::new()
        } else {
            contents(&instances, &buckets, &cells)
        };
        for content in &contents {
            // The same bytes and the same function as at the client; the server's own data
            // always applies.
            apply_changes(content, &mut self.mirror).expect("own changes apply to the mirror");
        }
        let items = match self.scheme {
            Scheme::Cells { .. } => Vec::new(),
            Scheme::Residual(quantiser) => {
                let (items, slices) = self.code_slices(world, visible, quantiser);
                stats.slices = slices;
                items
            }
        };
        if contents.is_empty() && items.is_empty() {
            if !always && !self.snapshot {
                return stats;
            }
            contents.push(Vec::new());
        }
        self.mirror.clear_dirty();
        self.frame_id += 1;
        let start = out.len();
        self.write_frame(&contents, &items, time_ns, out);
        stats.bytes = (out.len() - start) as u64;
        stats
    }

    /// Marks the cells and buckets to send.
    fn select(
        &mut self,
        world: &World,
        visible: &(dyn Fn([glam::Vec3; 2]) -> bool + Sync),
        threshold: u8,
    ) {
        let truth = &world.truth;
        let (cell_count, bucket_count) = (truth.cells.len(), truth.buckets.len());
        let mut check = Vec::new();
        let mut gather =
            |due: &mut [u64], range: std::ops::Range<usize>, keep: &dyn Fn(usize) -> bool| {
                let mut from = range.start;
                while let Some(run) = dirty::next_run(due, cell_count, from) {
                    if run.start >= range.end {
                        break;
                    }
                    from = run.end;
                    for cell in run.start..run.end.min(range.end) {
                        if keep(cell) {
                            dirty::unmark(due, cell_count, cell);
                            check.push(cell as u32);
                        }
                    }
                }
            };
        let mut seen_instance = vec![false; truth.instances.len()];
        for slice in &world.slices {
            if visible(slice.bounds) {
                seen_instance[slice.instance as usize] = true;
                let range = slice.cells.start as usize..slice.cells.end as usize;
                gather(&mut self.due_cells, range, &|_| true);
            }
        }
        let loose = world.loose_cells as usize..cell_count;
        gather(&mut self.due_cells, loose, &|cell| {
            seen_instance[world.instance_of_bucket(truth.home(cell as u32)) as usize]
        });
        for cell in check {
            let (want, have) = (
                &truth.cells[cell as usize],
                &self.mirror.cells()[cell as usize],
            );
            // A freed cell is not sent: its bucket no longer names it.
            if want.is_empty() {
                continue;
            }
            let home = truth.home(cell) as usize;
            if self.mirror.buckets()[home] != truth.buckets[home] {
                dirty::mark(&mut self.send_buckets, bucket_count, home);
            }
            if differs(want, have, threshold) {
                dirty::mark(&mut self.send_cells, cell_count, cell as usize);
            }
        }
        for run in dirty::runs(&self.due_buckets, bucket_count) {
            for bucket in run {
                if self.mirror.buckets()[bucket] != truth.buckets[bucket] {
                    dirty::mark(&mut self.send_buckets, bucket_count, bucket);
                }
            }
        }
        dirty::clear(&mut self.due_buckets, bucket_count);
        // A bucket's cells must be what it says they are, in view or not: an index may have been
        // another cell before.
        for run in dirty::runs(&self.send_buckets, bucket_count) {
            for cell in run.flat_map(|bucket| truth.buckets[bucket].cells()) {
                let (want, have) = (
                    &truth.cells[cell as usize],
                    &self.mirror.cells()[cell as usize],
                );
                if differs(want, have, threshold) {
                    dirty::mark(&mut self.send_cells, cell_count, cell as usize);
                    dirty::unmark(&mut self.due_cells, cell_count, cell as usize);
                }
            }
        }
    }

    /// Marks the cells of slices that are seen for the first time, and the buckets that name them.
    fn select_new(&mut self, world: &World, visible: &(dyn Fn([glam::Vec3; 2]) -> bool + Sync)) {
        let truth = &world.truth;
        for run in self.runs.iter().filter(|run| !run.open) {
            if visible(world.slices[run.world_slice as usize].bounds) {
                for cell in run.cells.clone() {
                    dirty::mark(&mut self.send_cells, truth.cells.len(), cell as usize);
                    // A bucket may name cells that the client has not got: those are empty.
                    let home = truth.home(cell) as usize;
                    if self.mirror.buckets()[home] != truth.buckets[home] {
                        dirty::mark(&mut self.send_buckets, truth.buckets.len(), home);
                    }
                }
            }
        }
    }

    /// Codes the visible slices that differ; their cells are in the mirror already. Returns the
    /// contents of the packets and the number of slices.
    fn code_slices(
        &mut self,
        world: &World,
        visible: &(dyn Fn([glam::Vec3; 2]) -> bool + Sync),
        quantiser: Quantiser,
    ) -> (Vec<Vec<u8>>, u32) {
        let seen: Vec<bool> = world
            .slices
            .iter()
            .map(|slice| visible(slice.bounds))
            .collect();
        let mut due = Vec::new();
        for (index, run) in self.runs.iter_mut().enumerate() {
            let opens = !run.open;
            if seen[run.world_slice as usize] && (opens || run.due) {
                (run.open, run.due) = (true, false);
                due.push((index as u32, opens));
            }
        }
        let mut slices = self.slices.slices();
        for &(index, opens) in &due {
            if opens {
                let run = &self.runs[index as usize];
                let instance = world.slices[run.world_slice as usize].instance;
                let count = run.cells.end - run.cells.start;
                slices
                    .open(&self.mirror, index, instance, run.cells.start, count)
                    .expect("own slices open once");
            }
        }
        // Slices are independent: coded side by side, taken over one after the other.
        struct Work<'a> {
            opens: bool,
            slice: Slice,
            neighbours: &'a [Neighbours],
            last: Vec<i8>,
        }
        let mut work = Vec::new();
        for &(index, opens) in &due {
            let slice = slices.slices[index as usize];
            let points =
                slice.point_first as usize..(slice.point_first + slice.point_count) as usize;
            work.push(Work {
                opens,
                slice,
                neighbours: &slices.neighbours[points.clone()],
                last: slices.last[points].to_vec(),
            });
        }
        let mirror = &self.mirror;
        let coded: Vec<Option<(Values, Vec<u8>)>> = work
            .par_iter_mut()
            .map(|work| {
                let cells = work.slice.cell_first as usize
                    ..(work.slice.cell_first + work.slice.cell_count) as usize;
                let read =
                    |cells: &[Cell]| Values::of(cells).expect("a slice's points are bounded");
                let want = read(&world.truth.cells[cells.clone()]);
                let mut have = read(&mirror.cells()[cells]);
                let off = want
                    .get()
                    .iter()
                    .zip(have.get())
                    .map(|(w, h)| w.abs_diff(*h))
                    .max();
                if !work.opens && off.is_none_or(|off| off <= quantiser.dead_zone) {
                    return None;
                }
                let quantiser = if work.opens { FIRST } else { quantiser };
                let mut bytes = vec![0; MAX_SLICE_BYTES];
                let mut state = SliceState {
                    value: have.get_mut(),
                    last: &mut work.last,
                };
                let length = encode_slice(
                    work.neighbours,
                    quantiser,
                    &mut state,
                    want.get(),
                    work.opens,
                    &mut bytes,
                )
                .expect("a slice has the room asked for");
                bytes.truncate(length);
                Some((have, bytes))
            })
            .collect();
        let lasts: Vec<(Slice, Vec<i8>)> = work
            .iter_mut()
            .map(|w| (w.slice, std::mem::take(&mut w.last)))
            .collect();
        let mut packets: Vec<Vec<u8>> = Vec::new();
        let (mut next, mut count) = (0, 0);
        for (((slice, last), coded), (index, opens)) in lasts.into_iter().zip(coded).zip(due) {
            let Some((values, bytes)) = coded else {
                continue;
            };
            store(&mut self.mirror, slice, values.get()).expect("own slices are in the mirror");
            let points =
                slice.point_first as usize..(slice.point_first + slice.point_count) as usize;
            slices.last[points].copy_from_slice(&last);
            let instance = world.slices[self.runs[index as usize].world_slice as usize].instance;
            let item = Item {
                index,
                opens: opens.then_some([instance, slice.cell_first, slice.cell_count]),
                bytes: &bytes,
            };
            let room = bytes.len() + 32;
            if packets
                .last()
                .is_none_or(|packet| packet.len() + room > SLICES_BYTES)
            {
                packets.push(Vec::new());
                next = 0;
            }
            let packet = packets.last_mut().expect("one was just made");
            let start = packet.len();
            packet.resize(start + room, 0);
            let mut writer = Writer::new(&mut packet[start..]);
            item.write(next, &mut writer)
                .expect("an item has the room asked for");
            let length = writer.length();
            packet.truncate(start + length);
            next = index + 1;
            count += 1;
        }
        (packets, count)
    }

    fn write_frame(
        &mut self,
        contents: &[Vec<u8>],
        items: &[Vec<u8>],
        time_ns: u64,
        out: &mut Vec<u8>,
    ) {
        let compression = match self.scheme {
            Scheme::Cells { compression, .. } => compression,
            // Each cell is sent once: worth the effort.
            Scheme::Residual(_) => Compression::Paper,
        };
        let compressed: Vec<Vec<u8>> = contents
            .par_iter()
            .map_init(|| compressor(compression), |zstd, raw| compress(zstd, raw))
            .collect();
        let cells = contents.iter().zip(&compressed);
        let cells = cells.map(|(raw, compressed)| (kind::FRAME, raw.len(), compressed));
        let slices = items.iter().map(|items| (kind::SLICES, items.len(), items));
        let packets: Vec<(u8, usize, &Vec<u8>)> = cells.chain(slices).collect();
        for (index, (kind, raw_bytes, body)) in packets.iter().enumerate() {
            let mut flags = 0;
            let mut frame = Frame {
                id: self.frame_id,
                time_ns,
                mirror_hash: 0,
                raw_bytes: *raw_bytes as u32,
            };
            if self.snapshot {
                flags |= flag::SNAPSHOT;
                self.snapshot = false;
            }
            if index + 1 == packets.len() {
                flags |= flag::LAST;
                frame.mirror_hash = self.mirror.hash();
            }
            self.packet(out, *kind, flags, FRAME_HEADER_BYTES + body.len(), |w| {
                frame.write(w)?;
                w.bytes(body)
            });
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
        &self.mirror
    }

    /// The number of the last frame.
    pub fn frame_id(&self) -> u32 {
        self.frame_id
    }
}

/// Largest content of a slices packet.
const SLICES_BYTES: usize = 1 << 18;

/// The world's slices, cut where one holds too many points (cells that it opened may hold points
/// of the slices behind it).
fn cell_runs(world: &World) -> Vec<CellRun> {
    let mut runs = Vec::new();
    for (index, slice) in world.slices.iter().enumerate() {
        let (mut start, mut points) = (slice.cells.start, 0);
        let mut cut = |start: u32, end: u32| {
            if start < end {
                let world_slice = index as u32;
                runs.push(CellRun {
                    world_slice,
                    cells: start..end,
                    open: false,
                    due: true,
                });
            }
        };
        for cell in slice.cells.clone() {
            let count = world.truth.cells[cell as usize].len();
            if points + count > SLICE_POINTS {
                cut(start, cell);
                (start, points) = (cell, 0);
            }
            points += count;
        }
        cut(start, slice.cells.end);
    }
    runs
}

/// Room a mirror of the truth needs.
pub fn capacity_of(truth: &Truth) -> Capacity {
    Capacity {
        instances: truth.instances.len() as u32,
        buckets: truth.buckets.len() as u32,
        cells: truth.cells.len() as u32,
    }
}

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

fn elements<T: Copy>(set: &[u64], values: &[T]) -> Vec<(u32, T)> {
    dirty::runs(set, values.len())
        .flatten()
        .map(|i| (i as u32, values[i]))
        .collect()
}

/// Whether a cell must be sent again.
fn differs(want: &Cell, have: &Cell, threshold: u8) -> bool {
    want.key != have.key
        || want.points.iter().zip(&have.points).any(|(want, have)| {
            want.is_allocated() != have.is_allocated()
                || want.0 >> 8 != have.0 >> 8 && moved(*want, *have)
                || want.occlusion().abs_diff(have.occlusion()) > threshold
        })
}

fn moved(want: Point, have: Point) -> bool {
    let far = |(a, b): (u32, u32)| a.abs_diff(b) > POSITION_THRESHOLD;
    let turned = || {
        let [a, b] = [want, have].map(|p| glam::Vec3::from(point::decode_normal(p.normal())));
        a.dot(b) < NORMAL_THRESHOLD
    };
    want.position().into_iter().zip(have.position()).any(far) || turned()
}

/// The contents of a frame's packets, each at most [`RAW_BYTES`]; at least one.
fn contents(
    instances: &[(u32, Instance)],
    buckets: &[(u32, Bucket)],
    cells: &[(u32, Cell)],
) -> Vec<Vec<u8>> {
    fn split<'a, T>(rest: &mut &'a [(u32, T)], room: &mut usize) -> &'a [(u32, T)] {
        let each = size_of::<T>() + 4;
        let (head, tail) = rest.split_at(rest.len().min(*room / each));
        *rest = tail;
        *room -= head.len() * each;
        head
    }
    let (mut instances, mut buckets, mut cells) = (instances, buckets, cells);
    let mut contents = Vec::new();
    loop {
        let mut room = RAW_BYTES - CHANGES_HEADER_BYTES;
        let instance_part = split(&mut instances, &mut room);
        let bucket_part = split(&mut buckets, &mut room);
        let cell_part = split(&mut cells, &mut room);
        let mut content = vec![0; RAW_BYTES - room];
        write_content(
            &mut Writer::new(&mut content),
            instance_part,
            bucket_part,
            cell_part,
        )
        .expect("content has the room counted");
        contents.push(content);
        if instances.is_empty() && buckets.is_empty() && cells.is_empty() {
            return contents;
        }
    }
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

fn compress(zstd: &mut CCtx<'_>, raw: &[u8]) -> Vec<u8> {
    if raw.is_empty() {
        return Vec::new();
    }
    let mut out = Vec::with_capacity(compress_bound(raw.len()));
    zstd.compress2(&mut out, raw)
        .expect("zstd has the room it asked for");
    out
}

/// Root mean square difference between what a mirror says and the truth, in 1/255, over the points
/// of `visible` slices.
pub fn point_rmse(
    world: &World,
    mirror: &Mirror<Heap>,
    visible: &(dyn Fn([glam::Vec3; 2]) -> bool + Sync),
) -> f64 {
    let (mut sum, mut count) = (0u64, 0u64);
    let mut add = |cell: usize| {
        let (want, have) = (&world.truth.cells[cell], &mirror.cells()[cell]);
        for (want, have) in want.points.iter().zip(&have.points) {
            if want.is_allocated() {
                let off = u64::from(want.occlusion().abs_diff(have.occlusion()));
                // A point the client does not have counts as wholly wrong.
                sum += if have.is_allocated() {
                    off * off
                } else {
                    255 * 255
                };
                count += 1;
            }
        }
    };
    let mut seen_instance = vec![false; world.truth.instances.len()];
    for slice in world.slices.iter().filter(|slice| visible(slice.bounds)) {
        seen_instance[slice.instance as usize] = true;
        slice.cells.clone().for_each(|cell| add(cell as usize));
    }
    for cell in world.loose_cells as usize..world.truth.cells.len() {
        let home = world.truth.home(cell as u32);
        if seen_instance[world.instance_of_bucket(home) as usize] {
            add(cell);
        }
    }
    (sum as f64 / count.max(1) as f64).sqrt()
}
