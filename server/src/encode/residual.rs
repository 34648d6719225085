//! Profile `residual`: patches once, then slices' occlusion, the largest visible error first.

use super::sight::Sight;
use super::{Compression, Eye, FrameStats, View, capacity_of, compress, compressor, write_content};
use crate::facing::Faces;
use crate::world::{PointBits, SLICE_POINTS, Slice, World};
use glam::Vec3;
use psao::memory::{Heap, SliceHeap};
use psao_core::bins::Bin;
use psao_core::mirror::Capacity;
use psao_core::residual::{BLOCK, MAX_SLICE_BYTES, Quantiser, SliceState, encode_slice};
use psao_core::slices::{self, FIRST, ITEM_HEADER_BYTES, Item, Operation};
use psao_core::stream::{CHANGES_HEADER_BYTES, Writer, kind};
use psao_core::{Instance, Mirror};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};
use std::ops::{Range, RangeInclusive};
use std::time::Instant;

/// What a client gets at most.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Limits {
    /// Stream bits a second, in millions; 0 for no limit. What does not fit waits.
    pub max_mbit: f64,
    /// Points a pixel: instances farther away get fewer points; 0 for all of them always.
    pub points_per_pixel: f32,
    /// Most points and cells at the client; 0 for room for all. Slices that have not been seen
    /// for longest make room for others.
    pub points: u32,
    /// As `points`.
    pub cells: u32,
}

impl Limits {
    /// No more than a client has room for.
    pub fn fit(&mut self, room: &Capacity) {
        let least = |limit: u32, room: u32| if limit == 0 { room } else { limit.min(room) };
        self.points = least(self.points, room.points);
        self.cells = least(self.cells, room.cells);
    }
}

/// Largest content of a packet of patches or slices.
const PACKET_BYTES: usize = 1 << 18;

/// Slices coded side by side before the budget is looked at again.
const BATCH: usize = 64;

/// Frames over which a change of the level of detail is faded, at least.
const FADE_S: f32 = 0.4;

/// A slice waits while what it is off by, squared and summed over its points, is less than this many
/// squares of the least difference that counts: what comes of it later costs hardly more bits.
const LITTLE: u64 = 60;

/// And none of its points by as many, so that none sticks out.
const LITTLE_A_POINT: u64 = 25;

/// No slice waits longer for being little off.
const WAIT_S: f32 = 0.1;

/// Once slices have waited for room for so long, occlusion is sent in steps twice as coarse: much
/// nearer for all beats exact for few.
const STRAINED_S: f32 = 0.25;

/// Once none has for so long, in steps half as coarse.
const EASED_S: f32 = 0.1;

/// Most doublings of the step: what the packets' flags have room for.
const COARSEST: u8 = 3;

/// What a client of profile `residual` has.
pub struct Residual {
    pub mirror: Mirror<Heap>,
    pub heap: SliceHeap,
    /// Frames a second, as the header says.
    pub rate_hz: f32,
    capacity: Capacity,
    quantiser: Quantiser,
    limits: Limits,
    /// Patches that the client has.
    has_patch: Vec<bool>,
    /// Of each slice, the blocks whose occlusion, or place in cells, may differ from the client's.
    due: Vec<u64>,
    /// The frame since which a slice has been a little off.
    little_since: Vec<Option<u64>>,
    sight: Sight,
    /// Slices on their way from one level's picture to another's.
    fades: BTreeMap<u32, Fade>,
    space: Space,
    /// Where there are too few cells for all slices: how many each open one takes at most, so that
    /// none finds them used up, however many of its blocks are shown.
    cells: Option<Vec<u32>>,
    /// Bytes sent beyond the budget so far.
    debt: f64,
    /// Doublings of the step that the budget asks for now.
    coarse: u8,
    /// Frames, since the step changed last or this began, after each of which slices waited for
    /// room; below 0, frames after which none did.
    strained: i32,
    /// Of each slice, what its visible errors came to in the frames in which it waited for room.
    owed: Vec<f32>,
}

/// Occlusion that a slice's points begin with, so that the picture does not jump.
struct Fade {
    from: Vec<u8>,
    begun: u64,
}

/// What a frame sends.
pub struct Packets {
    /// Bodies of patches packets.
    pub patches: Vec<Vec<u8>>,
    /// Kind and content of the frame's packets.
    pub packets: Vec<(u8, Vec<u8>)>,
    /// Doublings of the step in those of slices.
    pub coarse: u8,
}

/// A slice that the client lacks something of.
struct Lack {
    index: u32,
    opens: bool,
    /// Blocks to bring up to date. The others are not in the picture, and stay as they are.
    blocks: u64,
    /// Blocks that are due and need nothing, in the picture or not.
    near_enough: u64,
    /// Points (of the world's) that are not in the picture.
    free: PointBits,
    /// Visible error: squared, over all other points, a square metre's part of the picture.
    weight: f32,
}

/// How much a client lacks of a slice.
enum Off {
    /// Nothing that counts.
    Near,
    /// So little that it waits.
    Little,
    Far,
}

/// A slice, coded.
struct Coded {
    index: u32,
    opens: Option<[u32; 3]>,
    /// Blocks that were to be brought up to date, and those with points that still differ.
    blocks: u64,
    left: u64,
    values: Vec<u8>,
    last: Vec<i8>,
    bytes: Vec<u8>,
    /// Time that it took.
    encode_ns: u64,
}

impl Residual {
    pub fn new(world: &World, quantiser: Quantiser, limits: Limits, has_patches: bool) -> Residual {
        let mut capacity = capacity_of(world);
        let limit = |all: u32, limit: u32| if limit == 0 { all } else { all.min(limit) };
        capacity.points = limit(capacity.points, limits.points);
        capacity.cells = limit(capacity.cells, limits.cells);
        let scarce = capacity.cells < capacity_of(world).cells;
        let mut heap = SliceHeap::new(capacity);
        for patch in 0..world.topology.patches() {
            // The encoder's own copy is whole from the start.
            let bytes = world.topology.patch(patch);
            heap.slices()
                .add_patch(patch, bytes)
                .expect("there is room for all patches");
        }
        Residual {
            mirror: Mirror::new(Heap::new(capacity)),
            heap,
            rate_hz: 60.0,
            capacity,
            quantiser,
            limits,
            has_patch: vec![has_patches; capacity.patches as usize],
            due: vec![u64::MAX; world.slices.len()],
            little_since: vec![None; world.slices.len()],
            sight: Sight::new(world.slices.len()),
            fades: BTreeMap::new(),
            space: Space::new(capacity.points),
            cells: scarce.then(|| vec![0; world.slices.len()]),
            debt: 0.0,
            coarse: 0,
            strained: 0,
            owed: vec![0.0; world.slices.len()],
        }
    }

    /// Cells that the client has, and that it would have if nothing were left out for being open.
    pub fn cells(&self, world: &World) -> [usize; 2] {
        let has = self.mirror.cells().iter().filter(|cell| !cell.is_empty());
        let mut all = HashSet::new();
        for (slice, open) in world.slices.iter().zip(self.heap.get()) {
            if open.point_count > 0 {
                let grid = self.mirror.instances()[slice.instance as usize];
                let points = world.topology.points_of(slice.patch, grid.level);
                let bins = points.filter_map(|point| Bin::of(&grid, point));
                all.extend(bins.map(|bin| (slice.instance, bin.cell)));
            }
        }
        [has.count(), all.len()]
    }

    /// Slices of which the client needs something.
    pub fn needed(&self) -> &[u32] {
        self.sight.needed()
    }

    pub fn capacity(&self) -> Capacity {
        self.capacity
    }

    /// The grid that a slice's points lie in at the client.
    fn grid(&self, slice: &Slice) -> &Instance {
        &self.mirror.instances()[slice.instance as usize]
    }

    pub fn reset(&mut self) {
        self.mirror.reset();
        self.mirror.clear_dirty();
        self.heap.slices().reset(self.capacity.cells);
        self.fades.clear();
        self.space = Space::new(self.capacity.points);
        if let Some(cells) = &mut self.cells {
            cells.fill(0);
        }
    }

    pub fn merge(&mut self, world: &World) {
        for (due, changed) in self.due.iter_mut().zip(world.changed()) {
            *due |= changed;
        }
    }

    /// Lowers each instance's level to the finest that the client has, or may get at once.
    pub fn want_levels(&self, finest: &mut [u32]) {
        for (finest, has) in finest.iter_mut().zip(self.mirror.instances()) {
            let level = if has.bucket_count > 0 { has.level } else { 0 };
            *finest = level.min(*finest);
        }
    }

    /// What was sent counts against the budget of this frame; what was too much, of the next.
    pub fn spent(&mut self, bytes: u64) {
        if self.limits.max_mbit > 0.0 {
            self.debt = (self.debt + bytes as f64 - self.budget()).max(0.0);
        }
    }

    /// [`Limits::max_mbit`] from the next frame on.
    pub fn set_max_mbit(&mut self, max_mbit: f64) {
        self.limits.max_mbit = max_mbit;
        if max_mbit == 0.0 {
            (self.debt, self.coarse, self.strained) = (0.0, 0, 0);
        }
    }

    /// Bytes a frame.
    fn budget(&self) -> f64 {
        self.limits.max_mbit * 1e6 / 8.0 / f64::from(self.rate_hz.max(1.0))
    }

    pub fn frame(&mut self, world: &World, view: &View<'_>, stats: &mut FrameStats) -> Packets {
        let mut room = if self.limits.max_mbit > 0.0 {
            self.budget() - self.debt
        } else {
            f64::INFINITY
        };
        let mut out = Frame::default();
        self.drop_absent(world, &mut out);
        self.sight.look(world, view);
        let mut lacks = self.lacks(world, view);
        self.choose_levels(world, view, &lacks, room, &mut out);
        if !out.closes.is_empty() {
            // What changed its level is lacking as a whole now.
            lacks = self.lacks(world, view);
        }
        // All of an instance's slices change level in one frame, so that none is missing.
        let (mut now, mut later): (Vec<Lack>, Vec<Lack>) = (Vec::new(), Vec::new());
        for lack in lacks {
            let fading = self.fades.get(&lack.index);
            let whole = lack.opens && fading.is_some_and(|fade| fade.begun == self.sight.frames());
            if whole { &mut now } else { &mut later }.push(lack);
        }
        if room.is_finite() {
            // So that what is less off in every frame than something else has its turn as well.
            for lack in &mut later {
                let owed = &mut self.owed[lack.index as usize];
                *owed += lack.weight;
                lack.weight = *owed;
            }
            later.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        }
        now.append(&mut later);
        let mut chosen = Vec::new();
        let mut rest = now.as_slice();
        while !rest.is_empty() {
            if room <= 0.0 {
                stats.waiting += rest.len() as u32;
                break;
            }
            // Few slices take less than 16 bytes: no more are coded than may find room.
            let most = ((room / 16.0) as usize).clamp(4, BATCH);
            let (batch, after) = rest.split_at(rest.len().min(most));
            rest = after;
            self.choose(world, batch, &mut room, &mut chosen, &mut out, stats);
        }
        // In the order in which the client will take them, as cells come about in that order.
        chosen.sort_unstable_by_key(|coded| coded.index);
        for coded in chosen {
            self.owed[coded.index as usize] = 0.0;
            self.apply(world, coded, &mut out, stats);
        }
        let heap = self.heap.get();
        self.fades
            .retain(|&index, _| heap[index as usize].point_count > 0);
        stats.closed = out.closes.len() as u32;
        let start = Instant::now();
        let packets = out.write(self, world, stats);
        stats.encode_ns += start.elapsed().as_nanos() as u64;
        if room.is_finite() {
            self.strain(stats.waiting > 0);
        }
        packets
    }

    /// Fits the step to the budget: after a frame, by whether slices wait for room.
    fn strain(&mut self, waiting: bool) {
        self.strained = match waiting {
            true => self.strained.max(0) + 1,
            false => self.strained.min(0) - 1,
        };
        let frames = |seconds: f32| (seconds * self.rate_hz).ceil() as i32;
        if self.strained >= frames(STRAINED_S) {
            (self.coarse, self.strained) = ((self.coarse + 1).min(COARSEST), 0);
        } else if self.strained <= -frames(EASED_S) {
            (self.coarse, self.strained) = (self.coarse.saturating_sub(1), 0);
        }
    }

    /// How slices are coded now that were before.
    fn quantiser(&self) -> Quantiser {
        let Quantiser { step, dead_zone } = self.quantiser;
        let coarser = |by: u8| by.saturating_mul(1 << self.coarse);
        Quantiser {
            step: coarser(step),
            dead_zone: coarser(dead_zone.saturating_add(1)) - 1,
        }
    }

    /// The slices in sight that the client does not have, or that differ where it shows by more than
    /// a little, or have for a while.
    fn lacks(&mut self, world: &World, view: &View<'_>) -> Vec<Lack> {
        let this = &*self;
        let needed = this.sight.needed().par_iter();
        let checked: Vec<(Lack, Off)> = needed
            .filter_map(|&index| this.check(world, view, index))
            .collect();
        let mut lacks = Vec::new();
        for (lack, off) in checked {
            // Until the world changes them again.
            self.due[lack.index as usize] &= !lack.near_enough;
            let since = &mut self.little_since[lack.index as usize];
            match off {
                Off::Near => {
                    *since = None;
                    self.owed[lack.index as usize] = 0.0;
                }
                Off::Little => *since = since.or(Some(self.sight.frames())),
                Off::Far => lacks.push(lack),
            }
        }
        lacks
    }

    /// What the client needs of a slice in sight, and how much it lacks of that; `None` if none of it
    /// may have changed.
    fn check(&self, world: &World, view: &View<'_>, index: u32) -> Option<(Lack, Off)> {
        let slice = &world.slices[index as usize];
        let open = &self.heap.get()[index as usize];
        let opens = open.point_count == 0;
        let due = self.due[index as usize];
        let fading = self.fades.contains_key(&index);
        if !(opens || fading || due != 0) {
            return None;
        }
        let mut lack = Lack {
            index,
            opens,
            blocks: u64::MAX,
            near_enough: 0,
            free: [0; SLICE_POINTS / 64],
            weight: 0.0,
        };
        let near = || {
            let far = |eye: Eye| distance(eye.camera.position, slice.bounds).max(0.5);
            view.eye.map_or(1.0, far).powi(2)
        };
        if opens {
            // What is missing reads as open. At equal error, new slices first.
            let want = world.occlusion(slice).iter();
            let dark: u64 = want.map(|w| u64::from(255 - w).pow(2)).sum();
            lack.weight = (dark + want_a_little(slice)) as f32 / near();
            return Some((lack, Off::Far));
        }
        let level = self.grid(slice).level;
        let asked = if fading { u64::MAX } else { due };
        let have = self.heap.values(open);
        let off_by = |than| Differences::of(world, slice, level, have, asked, than);
        let differences = off_by(self.quantiser());
        let missing = to_show(world, &self.mirror, slice, open) & !open.shown;
        let differing = differences.blocks();
        let mut shows = missing;
        let mut faces = Faces {
            any: differing,
            all: differing,
        };
        if !fading {
            // What is near enough for now counts again once there is room.
            let at_last = match self.coarse {
                0 => differing,
                _ => off_by(self.quantiser).blocks(),
            };
            lack.near_enough = due & !at_last & !missing;
            faces = view.blocks(world, slice, due & (differing | missing));
            lack.blocks = faces.any;
            shows &= faces.any;
        }
        let [squares, most] =
            differences.squares(&in_picture(world, view, slice, faces, &differences.off));
        lack.weight = (squares as f32 + f32::from(u8::from(shows != 0))) / near();
        let off = match squares {
            _ if shows != 0 || fading => Off::Far,
            0 => Off::Near,
            _ if self.waits(index, squares, most) => Off::Little,
            _ => Off::Far,
        };
        if matches!(off, Off::Far) && !fading {
            let everything = [u64::MAX; SLICE_POINTS / 64];
            let needed = in_picture(world, view, slice, faces, &everything);
            lack.free = needed.map(|word| !word);
        }
        Some((lack, off))
    }

    /// Whether a slice that is off by so much, squared and summed and at most, may wait for more.
    fn waits(&self, index: u32, squares: u64, most: u64) -> bool {
        let least = u64::from(self.quantiser().dead_zone) + 1;
        let waited =
            self.little_since[index as usize].map_or(0, |since| self.sight.frames() - since);
        // Without a dead zone nothing is to be off.
        least > 1
            && squares < LITTLE * least.pow(2)
            && most < LITTLE_A_POINT * least.pow(2)
            && waited < (WAIT_S * self.rate_hz) as u64
    }

    /// Takes instances from the client that are out of the scene.
    fn drop_absent(&mut self, world: &World, out: &mut Frame) {
        for instance in world.absent() {
            if self.mirror.instances()[instance as usize].bucket_count > 0 {
                for index in self.open_slices(world, instance) {
                    self.close(index, out);
                }
                self.set_instance(instance, Instance::default(), out);
            }
        }
    }

    fn open_slices(&self, world: &World, instance: u32) -> Vec<u32> {
        let heap = self.heap.get();
        let is_open = |slice: &u32| heap[*slice as usize].point_count > 0;
        world.slices_of(instance).filter(is_open).collect()
    }

    /// Gives instances the level of detail that their distance asks for.
    fn choose_levels(
        &mut self,
        world: &World,
        view: &View<'_>,
        lacks: &[Lack],
        room: f64,
        out: &mut Frame,
    ) {
        let mut nearest: BTreeMap<u32, f32> = BTreeMap::new();
        for &index in self.sight.needed() {
            let slice = &world.slices[index as usize];
            let far = view
                .eye
                .map_or(0.0, |eye| distance(eye.camera.position, slice.bounds));
            let least = nearest.entry(slice.instance).or_insert(f32::INFINITY);
            *least = least.min(far);
        }
        let mut opening: Vec<u32> = lacks
            .iter()
            .filter(|lack| lack.opens)
            .map(|lack| world.slices[lack.index as usize].instance)
            .collect();
        opening.dedup();
        for (instance, far) in nearest {
            let Some(base) = world.level_of(instance) else {
                continue;
            };
            let has = self.mirror.instances()[instance as usize];
            let placed = has.bucket_count > 0;
            let from = if placed { has.level } else { base };
            let range = base..=world.coarsest(instance);
            let level = self.level_at(world, view, range, from, far);
            if placed && level == has.level {
                continue;
            }
            if !placed && !opening.contains(&instance) {
                continue;
            }
            let grid = world.grid(instance, level);
            let slices = world.slices_of(instance);
            let open = self.open_slices(world, instance);
            if open.is_empty() {
                self.set_instance(instance, grid, out);
                continue;
            }
            // Three bits a point, all in this frame.
            let points: usize = slices.map(|s| world.slices[s as usize].points.len()).sum();
            if room.is_finite() && points as f64 * 3.0 / 8.0 > room {
                continue;
            }
            self.change_level(world, instance, grid, &open, out);
        }
    }

    /// The level for a distance in metres: the coarsest with enough points a pixel. A little
    /// farther is needed to lose points than to gain them.
    fn level_at(
        &self,
        world: &World,
        view: &View<'_>,
        range: RangeInclusive<u32>,
        from: u32,
        far: f32,
    ) -> u32 {
        let (base, coarsest) = range.into_inner();
        let Some(eye) = view.eye else { return base };
        let pixels = (eye.pixels_per_radian / far.max(1e-3)).powi(2);
        let wanted = self.limits.points_per_pixel * pixels;
        if wanted <= 0.0 {
            return base;
        }
        let halvings = (world.options.density as f32 / wanted).log2();
        let mut level = from;
        while level > base && halvings < (level - base) as f32 {
            level -= 1;
        }
        while level < coarsest && halvings >= (level - base) as f32 + 1.25 {
            level += 1;
        }
        level
    }

    fn set_instance(&mut self, instance: u32, grid: Instance, out: &mut Frame) {
        self.mirror
            .set_instance(instance, grid)
            .expect("own grids are usable");
        out.instances.push((instance, grid));
    }

    /// Closes an instance's slices, and notes what its points at the new level begin with: what
    /// the client's picture shows there now.
    fn change_level(
        &mut self,
        world: &World,
        instance: u32,
        grid: Instance,
        open: &[u32],
        out: &mut Frame,
    ) {
        let lookup = self.mirror.lookup();
        let kernel = world.options.kernel;
        let fades: Vec<(u32, Fade)> = open
            .par_iter()
            .map(|&index| {
                let slice = &world.slices[index as usize];
                let numbers = slice.points.clone().zip(world.levels(slice));
                let of_level = numbers.filter(|(_, has)| u32::from(**has) >= grid.level);
                let shown = of_level.map(|(number, _)| {
                    let (position, normal) = world.grid_point(instance, number);
                    let (position, normal) = (position.to_array(), normal.to_array());
                    let answer = lookup.blend(kernel, instance, position, normal);
                    (answer.openness * 255.0 + 0.5) as u8
                });
                let fade = Fade {
                    from: shown.collect(),
                    begun: self.sight.frames(),
                };
                (index, fade)
            })
            .collect();
        for &index in open {
            self.close(index, out);
        }
        self.fades.extend(fades);
        self.set_instance(instance, grid, out);
    }

    fn close(&mut self, index: u32, out: &mut Frame) {
        self.give_back(index);
        self.due[index as usize] = u64::MAX;
        out.closes.push(index);
    }

    /// Undoes [`Residual::open`].
    fn give_back(&mut self, index: u32) {
        let slice = self.heap.get()[index as usize];
        let first = slice.point_first;
        self.space.free(first..first + slice.point_count);
        if let Some(cells) = &mut self.cells {
            cells[index as usize] = 0;
        }
        let mut slices = self.heap.slices();
        slices
            .close(&mut self.mirror, index)
            .expect("open slices close");
    }

    /// What a slice's points should say at the client now.
    fn target(&self, world: &World, index: u32) -> Vec<u8> {
        let slice = &world.slices[index as usize];
        let level = self.grid(slice).level;
        let points = world.occlusion(slice).iter().zip(world.levels(slice));
        let of_level = points.filter(|(_, has)| u32::from(**has) >= level);
        let mut target: Vec<u8> = of_level.map(|(occlusion, _)| *occlusion).collect();
        if let Some(fade) = self.fades.get(&index) {
            let done = (self.sight.frames() - fade.begun) as f32 / (FADE_S * self.rate_hz).max(1.0);
            for (to, from) in target.iter_mut().zip(&fade.from) {
                let (from, to_f) = (f32::from(*from), f32::from(*to));
                *to = (from + (to_f - from) * done.min(1.0)).round() as u8;
            }
        }
        target
    }

    /// Codes slices until there is no more room.
    fn choose(
        &mut self,
        world: &World,
        batch: &[Lack],
        room: &mut f64,
        chosen: &mut Vec<Coded>,
        out: &mut Frame,
        stats: &mut FrameStats,
    ) {
        let level = |slice: &Slice| self.grid(slice).level;
        let slice = |lack: &Lack| &world.slices[lack.index as usize];
        batch.par_iter().filter(|lack| lack.opens).for_each(|lack| {
            let (slice, topology) = (slice(lack), &world.topology);
            topology.neighbours(slice.patch, level(slice));
        });
        let mut ready: Vec<(&Lack, Option<[u32; 3]>)> = Vec::new();
        for lack in batch {
            if lack.opens {
                let opens = self.open(world, lack.index, out);
                ready.extend(opens.map(|opens| (lack, Some(opens))));
            } else {
                ready.push((lack, None));
            }
        }
        // A few slices take less time than another thread to wake up.
        let coded: Vec<Coded> = ready
            .par_iter()
            .with_min_len(BATCH / 2)
            .map(|&(lack, opens)| self.code(world, lack, opens))
            .collect();
        for coded in coded {
            stats.encode_ns += coded.encode_ns;
            if *room <= 0.0 {
                stats.waiting += 1;
                if coded.opens.is_some() {
                    self.give_back(coded.index);
                }
                continue;
            }
            *room -= (coded.bytes.len() + 4) as f64;
            if let Some([_, patch, _]) = coded.opens
                && !self.has_patch[patch as usize]
            {
                self.has_patch[patch as usize] = true;
                *room -= world.topology.patch(patch).len() as f64;
                out.patches.push(patch);
            }
            chosen.push(coded);
        }
    }

    /// Brings the encoder's own mirror to where the client's will be.
    fn apply(&mut self, world: &World, coded: Coded, out: &mut Frame, stats: &mut FrameStats) {
        let index = coded.index;
        let slice = self.heap.get()[index as usize];
        // Where something changes once, more will: the rest of the slice comes along, as the client
        // reads the patch anew each time that blocks come.
        let shown = match coded.opens {
            Some(_) => to_show(world, &self.mirror, &world.slices[index as usize], &slice),
            None => slice.all_blocks(),
        };
        let mut slices = self.heap.slices();
        if shown != slice.shown {
            let level = self.mirror.instances()[slice.instance as usize].level;
            let points = world.topology.points_of(slice.patch, level);
            slices.lend_points(slice.patch, level, points);
        }
        let (_, state) = slices.side(&slice).expect("own slices are open");
        state.value.copy_from_slice(&coded.values);
        state.last.copy_from_slice(&coded.last);
        slices
            .settle(&mut self.mirror, index, shown)
            .expect("own slices are open");
        let operation = match coded.opens {
            Some(opens) => Operation::Open(opens, shown),
            None if shown != slice.shown => Operation::Show(shown),
            None => Operation::Update,
        };
        self.little_since[index as usize] = None;
        stats.opened += u32::from(coded.opens.is_some());
        stats.slices += 1;
        out.items
            .push((index, operation, slice.point_count, coded.bytes));
        let fading = self.fades.get(&index).is_some_and(|fade| {
            self.sight.frames() - fade.begun < (FADE_S * self.rate_hz).ceil() as u64
        });
        if !fading {
            self.fades.remove(&index);
            let due = &mut self.due[index as usize];
            *due = *due & !coded.blocks | coded.left;
        }
    }

    /// Opens a slice at the encoder; others make room if they are out of view. No cell changes
    /// yet. Returns what the item says of it, if there is room.
    fn open(&mut self, world: &World, index: u32, out: &mut Frame) -> Option<[u32; 3]> {
        let slice = &world.slices[index as usize];
        let grid = *self.grid(slice);
        let points = || world.topology.points_of(slice.patch, grid.level);
        let count = points().count() as u32;
        if count == 0 {
            return None;
        }
        let own_cells = self.cells.as_ref().map_or(0, |_| {
            let bins = points().filter_map(|point| Bin::of(&grid, point));
            bins.map(|bin| bin.cell).collect::<HashSet<_>>().len() as u32
        });
        let first = loop {
            let taken: u32 = self.cells.iter().flatten().sum();
            // Cell 0 is never used.
            let cells_free = own_cells == 0 || taken + own_cells < self.capacity.cells;
            if cells_free && let Some(first) = self.space.take(count) {
                break first;
            }
            let heap = self.heap.get();
            let idle = (0..heap.len() as u32).filter(|&other| {
                heap[other as usize].point_count > 0
                    && self.sight.last_seen(other) < self.sight.frames()
            });
            let oldest = idle.min_by_key(|&other| self.sight.last_seen(other))?;
            self.close(oldest, out);
        };
        if let Some(cells) = &mut self.cells {
            cells[index as usize] = own_cells;
        }
        let mut slices = self.heap.slices();
        let opens = [slice.instance, slice.patch, first];
        slices.lend_points(slice.patch, grid.level, points());
        let neighbours = world.topology.neighbours(slice.patch, grid.level);
        slices
            .open(&self.mirror, index, opens, Some(neighbours))
            .expect("own slices open");
        Some(opens)
    }

    fn code(&self, world: &World, lack: &Lack, opens: Option<[u32; 3]>) -> Coded {
        let Lack { index, blocks, .. } = *lack;
        let slice = self.heap.get()[index as usize];
        let target = self.target(world, index);
        let of = &world.slices[index as usize];
        let level = self.grid(of).level;
        // The numbers that the points of the level have in the world's slice.
        let numbers = (0..).zip(world.levels(of));
        let numbers = numbers.filter(|(_, has)| u32::from(**has) >= level);
        let numbers = numbers.map(|(number, _): (usize, _)| number);
        let is_free = |number: usize| lack.free[number / 64] >> (number % 64) & 1 != 0;
        let mut free = [0; SLICE_POINTS / 64];
        for (at, number) in numbers.clone().enumerate() {
            free[at / 64] |= u64::from(is_free(number)) << (at % 64);
        }
        let mut coded = Coded {
            index,
            opens,
            blocks,
            left: 0,
            values: self.heap.values(&slice).to_vec(),
            last: self.heap.last(&slice).to_vec(),
            bytes: vec![0; MAX_SLICE_BYTES],
            encode_ns: 0,
        };
        let mut state = SliceState {
            value: &mut coded.values,
            last: &mut coded.last,
        };
        let quantiser = if opens.is_some() {
            FIRST
        } else {
            self.quantiser()
        };
        let start = Instant::now();
        let length = encode_slice(
            self.heap.neighbours(&slice),
            quantiser,
            &mut state,
            &target,
            &free,
            opens.is_some(),
            &mut coded.bytes,
        )
        .expect("a slice has the room asked for");
        coded.encode_ns = start.elapsed().as_nanos() as u64;
        coded.bytes.truncate(length);
        for (number, (has, wants)) in numbers.zip(coded.values.iter().zip(&target)) {
            let differs = !self.quantiser.leaves(*has, *wants);
            coded.left |= u64::from(differs) << (number / BLOCK);
        }
        coded
    }

    /// Bodies of patches packets.
    pub fn patches(&self, world: &World, indices: &[u32]) -> Vec<Vec<u8>> {
        let mut bodies = Bodies::default();
        for &index in indices {
            let bytes = world.topology.patch(index);
            bodies.add(index, bytes.len() + 10, |next, w| {
                w.varint(index - next)?;
                w.varint(bytes.len() as u32)?;
                w.bytes(bytes)
            });
        }
        bodies.0.into_iter().map(|(body, _)| body).collect()
    }
}

/// The blocks of a slice that the client must have in cells.
fn to_show(world: &World, mirror: &Mirror<Heap>, slice: &Slice, open: &slices::Slice) -> u64 {
    let level = mirror.instances()[slice.instance as usize].level;
    if Some(level) == world.level_of(slice.instance) {
        world.shown(slice) & open.all_blocks()
    } else {
        open.all_blocks()
    }
}

/// Those of some points of a slice that are in the picture, of which these blocks are.
fn in_picture(
    world: &World,
    view: &View<'_>,
    slice: &Slice,
    blocks: Faces,
    points: &PointBits,
) -> PointBits {
    let Faces { any, all } = blocks;
    let of = |blocks: u64| {
        let mut points = *points;
        for (word, points) in points.iter_mut().enumerate() {
            for part in 0..64 / BLOCK {
                let block = ((1 << BLOCK) - 1) << (part * BLOCK);
                if blocks >> (word * (64 / BLOCK) + part) & 1 == 0 {
                    *points &= !block;
                }
            }
        }
        points
    };
    let Some(eye) = view.eye else { return of(any) };
    let mut shown = world.points_facing(slice, eye.camera.position, of(any & !all));
    let whole = of(all);
    shown
        .iter_mut()
        .zip(whole)
        .for_each(|(s, whole)| *s |= whole);
    shown
}

/// Where a slice's points are not near enough to what they should say.
struct Differences {
    off: PointBits,
    /// By how much, of every point in `off`.
    by: [u8; SLICE_POINTS],
}

impl Differences {
    /// In some blocks. `have`: what the client's points of the level say.
    fn of(
        world: &World,
        slice: &Slice,
        level: u32,
        have: &[u8],
        blocks: u64,
        quantiser: Quantiser,
    ) -> Differences {
        let mut found = Differences {
            off: [0; SLICE_POINTS / 64],
            by: [0; SLICE_POINTS],
        };
        let mut compare = |at: usize, want: u8, have: u8| {
            let off = !quantiser.leaves(have, want);
            found.off[at / 64] |= u64::from(off) << (at % 64);
            found.by[at] = want.abs_diff(have);
        };
        let is_asked = |at: usize| blocks >> (at / BLOCK) & 1 != 0;
        let want = world.occlusion(slice);
        if want.len() == have.len() {
            let pairs = want.chunks(BLOCK).zip(have.chunks(BLOCK)).enumerate();
            for (block, (want, have)) in pairs.filter(|(block, _)| is_asked(block * BLOCK)) {
                for (at, (want, have)) in (block * BLOCK..).zip(want.iter().zip(have)) {
                    compare(at, *want, *have);
                }
            }
        } else {
            let points = want.iter().zip(world.levels(slice)).enumerate();
            let of_level = points.filter(|(_, (_, has))| u32::from(**has) >= level);
            for ((at, (want, _)), have) in of_level.zip(have) {
                if is_asked(at) {
                    compare(at, *want, *have);
                }
            }
        }
        found
    }

    /// The blocks that have any.
    fn blocks(&self) -> u64 {
        let parts = (0..SLICE_POINTS).step_by(BLOCK);
        let block = |at: usize| self.off[at / 64] >> (at % 64) & ((1 << BLOCK) - 1) != 0;
        parts
            .rev()
            .fold(0, |blocks, at| blocks << 1 | u64::from(block(at)))
    }

    /// The sum of the squares of some of them, and the largest of these.
    fn squares(&self, of: &PointBits) -> [u64; 2] {
        let [mut sum, mut most] = [0, 0];
        for (word, points) in of.iter().enumerate() {
            let mut left = *points;
            while left != 0 {
                let at = word * 64 + left.trailing_zeros() as usize;
                left &= left - 1;
                let square = u64::from(self.by[at]).pow(2);
                [sum, most] = [sum + square, square.max(most)];
            }
        }
        [sum, most]
    }
}

/// A slice without darkness is still a little better had than not.
fn want_a_little(slice: &Slice) -> u64 {
    slice.points.len() as u64
}

/// From a point to a box, metres.
fn distance(from: Vec3, [min, max]: [Vec3; 2]) -> f32 {
    from.distance(from.clamp(min, max))
}

/// A frame being put together.
#[derive(Default)]
struct Frame {
    closes: Vec<u32>,
    instances: Vec<(u32, Instance)>,
    patches: Vec<u32>,
    items: Vec<(u32, Operation, u32, Vec<u8>)>,
}

impl Frame {
    fn write(mut self, sent: &Residual, world: &World, stats: &mut FrameStats) -> Packets {
        stats.instances = self.instances.len() as u32;
        stats.patches = self.patches.len() as u32;
        self.patches.sort_unstable();
        self.instances.sort_unstable_by_key(|(index, _)| *index);
        let mut closes = Bodies::default();
        for &index in &self.closes {
            let item = Item {
                index,
                operation: Operation::Close,
                points: 0,
                bytes: &[],
            };
            closes.add(index, ITEM_HEADER_BYTES, |next, w| item.write(next, w));
        }
        let mut items = Bodies::default();
        for (index, operation, points, bytes) in &self.items {
            let item = Item {
                index: *index,
                operation: *operation,
                points: *points,
                bytes,
            };
            let room = ITEM_HEADER_BYTES + bytes.len();
            items.add(*index, room, |next, w| item.write(next, w));
        }
        let mut packets = closes.packets();
        if !self.instances.is_empty() {
            let mut raw = vec![0; CHANGES_HEADER_BYTES + self.instances.len() * 68];
            write_content(&mut Writer::new(&mut raw), &self.instances, &[], &[])
                .expect("content has the room counted");
            let compressed = compress(&mut compressor(Compression::Fast), &raw);
            packets.push((kind::FRAME, compressed));
        }
        packets.append(&mut items.packets());
        Packets {
            patches: sent.patches(world, &self.patches),
            packets,
            coarse: sent.coarse,
        }
    }
}

/// Contents of packets, cut at [`PACKET_BYTES`]; and the index after the last in each.
#[derive(Default)]
struct Bodies(Vec<(Vec<u8>, u32)>);

impl Bodies {
    /// Adds what `write` writes, which is told the index after the last in the packet.
    fn add(
        &mut self,
        index: u32,
        room: usize,
        write: impl FnOnce(u32, &mut Writer<'_>) -> Result<(), psao_core::stream::StreamError>,
    ) {
        // What comes out of order begins another packet.
        let full =
            |(body, next): &(Vec<u8>, u32)| body.len() + room > PACKET_BYTES || index < *next;
        if self.0.last().is_none_or(full) {
            self.0.push((Vec::new(), 0));
        }
        let (body, next) = self.0.last_mut().expect("one was just made");
        let start = body.len();
        body.resize(start + room, 0);
        let mut writer = Writer::new(&mut body[start..]);
        write(*next, &mut writer).expect("it has the room asked for");
        let length = writer.length();
        body.truncate(start + length);
        *next = index + 1;
    }

    fn packets(self) -> Vec<(u8, Vec<u8>)> {
        let bodies = self.0.into_iter();
        bodies.map(|(body, _)| (kind::SLICES, body)).collect()
    }
}

/// Memory for points' side data, given out in runs.
#[derive(Debug)]
struct Space {
    /// Sorted, apart from one another, none empty.
    free: Vec<Range<u32>>,
}

impl Space {
    fn new(points: u32) -> Space {
        Space {
            free: Vec::from_iter((points > 0).then_some(0..points)),
        }
    }

    /// The first place with room for `count`.
    fn take(&mut self, count: u32) -> Option<u32> {
        let at = self
            .free
            .iter()
            .position(|run| run.end - run.start >= count)?;
        let first = self.free[at].start;
        self.free[at].start += count;
        if self.free[at].is_empty() {
            self.free.remove(at);
        }
        Some(first)
    }

    fn free(&mut self, run: Range<u32>) {
        let at = self.free.partition_point(|other| other.start < run.start);
        self.free.insert(at, run);
        if at + 1 < self.free.len() && self.free[at].end == self.free[at + 1].start {
            self.free[at].end = self.free[at + 1].end;
            self.free.remove(at + 1);
        }
        if at > 0 && self.free[at - 1].end == self.free[at].start {
            self.free[at - 1].end = self.free[at].end;
            self.free.remove(at);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn space_is_given_out_once_and_grows_together_again() {
        let mut space = Space::new(100);
        let runs: Vec<u32> = (0..10).map(|_| space.take(10).unwrap()).collect();
        assert_eq!(space.take(1), None);
        for index in [3, 7, 5, 4, 0, 9, 8, 1, 6, 2] {
            let first = runs[index];
            space.free(first..first + 10);
        }
        assert_eq!((space.free.len(), space.free[0].clone()), (1, 0..100));
    }
}
