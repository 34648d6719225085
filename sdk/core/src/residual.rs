//! The residual codec: a slice's occlusion, from what the client has to what the server wants.
//!
//! A point's change is predicted from its neighbours' changes, of this frame where they come
//! earlier in the slice and of the last frame where they come later. What is left is quantised
//! and coded by [`crate::range`], one symbol a point, with odds that depend on how much goes on
//! around. The odds are known beforehand: slices are too short to learn more from than that says.
//! Encoder and decoder run the same function over the same integers, so that both end in the same
//! state.
//!
//! A slice depends on nothing but its own state: slices may be decoded in any order, on any
//! thread, and one that is lost or not sent harms no other.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::point::NORMAL_STEPS;
use crate::range::{Decoder, Encoder, Full};
use crate::stream::StreamError;
use crate::topology::{PATCH_POINTS, PatchPoint};
use crate::usual::{ACTIVITIES, BLOCK as BLOCK_ODDS, FIRST, FIRST_BLOCK, LATER, Row, SYMBOLS};
use bytemuck::{Pod, Zeroable};

/// Most points of a slice.
pub const SLICE_POINTS: usize = PATCH_POINTS;

/// Points that share a flag for "nothing to do", and are in the client's cells or not.
pub const BLOCK: usize = 16;

/// Neighbours of a point that come before it, and as many that come after.
const NEIGHBOURS: usize = 2;

/// How far away in the slice's order a neighbour may be. Points are in Morton order, so those
/// near in space are near in the order.
const WINDOW: usize = 24;

/// A point's nearest neighbours on the same surface, as distances in the slice's order; 0 where
/// there is none. Made by [`find_neighbours`] from what both sides know.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Neighbours {
    /// Counted back.
    pub earlier: [u8; NEIGHBOURS],
    /// Counted forward.
    pub later: [u8; NEIGHBOURS],
}

/// Finds every point's neighbours in a slice.
///
/// What is longer than the other, or than [`SLICE_POINTS`], is left alone.
pub fn find_neighbours(points: &[PatchPoint], out: &mut [Neighbours]) {
    let count = points.len().min(out.len()).min(SLICE_POINTS);
    let points = points.get(..count).unwrap_or_default();
    let out = out.get_mut(..count).unwrap_or_default();
    if !find_near_neighbours(points, out) {
        for (at, out) in out.iter_mut().enumerate() {
            *out = search(points, at);
        }
    }
}

/// Bits of a key of [`find_near_neighbours`] that say how far away in the order a point is.
const KEY_BITS: u32 = (WINDOW as u32).ilog2().wrapping_add(1);

/// Squared distances from here on count as this in such a key, so that it fits.
const NEAR: i32 = 1 << 21;

/// The key of no point at all, greater than any.
const NO_KEY: i32 = i32::MAX >> KEY_BITS << KEY_BITS;

/// The same for patches as small as most are; others it refuses (false).
///
/// It goes through all points once for each distance in the order, so that processors compute many
/// points side by side, and there is nothing to foretell.
fn find_near_neighbours(points: &[PatchPoint], out: &mut [Neighbours]) -> bool {
    let count = points.len();
    let Some(first) = points.first() else {
        return true;
    };
    let mut axes = [[0i16; SLICE_POINTS]; 3];
    let mut normals = [[0i16; SLICE_POINTS]; 3];
    let mut codes = [0u8; SLICE_POINTS];
    let (mut fits, mut flat) = (true, true);
    for (at, (point, code)) in points.iter().zip(&mut codes).enumerate() {
        *code = point.normal;
        flat &= point.normal == first.normal;
        let normal = normal_steps(point.normal);
        for axis in 0..3u8 {
            let place = axis_of(&point.position, axis).wrapping_sub(axis_of(&first.position, axis));
            let place = place as i32;
            fits &= place.unsigned_abs() <= FAR as u32 / 2;
            let axis_place = axes
                .get_mut(usize::from(axis))
                .and_then(|axis| axis.get_mut(at));
            let axis_normal = normals
                .get_mut(usize::from(axis))
                .and_then(|axis| axis.get_mut(at));
            if let (Some(to), Some(to_normal)) = (axis_place, axis_normal) {
                *to = place as i16;
                *to_normal = axis_of(&normal, axis) as i16;
            }
        }
    }
    if !fits {
        return false;
    }
    let mut earlier = [[NO_KEY; SLICE_POINTS]; NEIGHBOURS];
    let mut later = [[NO_KEY; SLICE_POINTS]; NEIGHBOURS];
    let mut keys = [0i32; SLICE_POINTS];
    for back in 1..=WINDOW.min(count.wrapping_sub(1)) {
        let Some(keys) = keys.get_mut(..count.wrapping_sub(back)) else {
            break;
        };
        let product = |p: i16, q: i16| i32::from(p).wrapping_mul(i32::from(q));
        let square = |p: i16, q: i16| product(p.wrapping_sub(q), p.wrapping_sub(q));
        of_pairs(&axes, back, keys, square);
        for key in &mut *keys {
            *key = (*key).min(NEAR);
        }
        if !flat {
            let mut along = [0i32; SLICE_POINTS];
            let along = along.get_mut(..keys.len()).unwrap_or_default();
            of_pairs(&normals, back, along, product);
            let codes = codes.iter().zip(codes.get(back..).unwrap_or_default());
            for ((key, along), (p, q)) in keys.iter_mut().zip(along).zip(codes) {
                let turned = if p == q { 0 } else { turned(*along) };
                let more = key.wrapping_mul(turned) >> 5;
                *key = key.wrapping_add(turned << 1).wrapping_add(more);
            }
        }
        for key in &mut *keys {
            *key = *key << KEY_BITS | back as i32;
        }
        keep_keys(&mut earlier, back, keys);
        keep_keys(&mut later, 0, keys);
    }
    let mask = NO_KEY ^ i32::MAX;
    let [[e0, e1], [l0, l1]] = [&earlier, &later];
    let found = e0.iter().zip(e1).zip(l0.iter().zip(l1));
    for (at, (out, ((e0, e1), (l0, l1)))) in out.iter_mut().zip(found).enumerate() {
        let far = |key: i32| key >= NEAR << KEY_BITS && key != NO_KEY;
        if far(*e1) || far(*l1) {
            *out = search(points, at);
            continue;
        }
        out.earlier = [*e0, *e1].map(|key| (key & mask) as u8);
        out.later = [*l0, *l1].map(|key| (key & mask) as u8);
    }
    true
}

/// For each point the sum over the axes of what `of` makes of its number and that of the point so
/// far `back`; the first of `out` is of the first point that has one there.
fn of_pairs(
    axes: &[[i16; SLICE_POINTS]; 3],
    back: usize,
    out: &mut [i32],
    of: impl Fn(i16, i16) -> i32,
) {
    let [x, y, z] = axes.each_ref().map(|axis| {
        let after = axis.get(back..).unwrap_or_default();
        axis.iter().zip(after)
    });
    for (((out, x), y), z) in out.iter_mut().zip(x).zip(y).zip(z) {
        let [x, y, z] = [x, y, z].map(|(p, q)| of(*p, *q));
        *out = x.wrapping_add(y).wrapping_add(z);
    }
}

/// Keeps of each point, from `start` on, its key if that is among the least.
fn keep_keys(least: &mut [[i32; SLICE_POINTS]; NEIGHBOURS], start: usize, keys: &[i32]) {
    let [first, second] = least;
    let first = first.get_mut(start..).unwrap_or_default();
    let second = second.get_mut(start..).unwrap_or_default();
    for ((first, second), key) in first.iter_mut().zip(second).zip(keys) {
        let more = (*first).max(*key);
        *first = (*first).min(*key);
        *second = (*second).min(more);
    }
}

fn axis_of<T: Copy + Default>(values: &[T; 3], axis: u8) -> T {
    values.get(usize::from(axis)).copied().unwrap_or_default()
}

/// The neighbours of a point of any patch, by a search through the window around it.
fn search(points: &[PatchPoint], at: usize) -> Neighbours {
    let (before, after) = points.split_at_checked(at).unwrap_or_default();
    let Some((point, after)) = after.split_first() else {
        return Neighbours::default();
    };
    Neighbours {
        earlier: nearest(point, before.iter().rev()),
        later: nearest(point, after.iter()),
    }
}

fn nearest<'a>(
    point: &PatchPoint,
    others: impl Iterator<Item = &'a PatchPoint>,
) -> [u8; NEIGHBOURS] {
    let mut nearest = NONE;
    for (by, other) in (1u8..).zip(others.take(WINDOW)) {
        keep(
            &mut nearest,
            u64::from(apart(point, other)) << 8 | u64::from(by),
        );
    }
    nearest.map(|candidate| candidate as u8)
}

/// How far apart two points count as.
fn apart(p: &PatchPoint, q: &PatchPoint) -> u32 {
    let axes = p.position.into_iter().zip(q.position);
    let squared = axes.fold(0u32, |sum, (p, q)| {
        let apart = (p.wrapping_sub(q) as i32).clamp(-FAR, FAR);
        sum.wrapping_add(apart.wrapping_mul(apart) as u32)
    });
    if p.normal == q.normal {
        return squared;
    }
    let axes = normal_steps(p.normal)
        .into_iter()
        .zip(normal_steps(q.normal));
    let along = axes.fold(0i32, |sum, (p, q)| sum.wrapping_add(p.wrapping_mul(q)));
    let turned = turned(along) as u32;
    let more = u64::from(squared).wrapping_mul(u64::from(turned)) >> 5;
    let more = u32::try_from(more).unwrap_or(u32::MAX);
    squared.saturating_add((turned << 1).saturating_add(more))
}

/// Coordinates that differ by more count as differing by this.
const FAR: i32 = 1 << 14;

/// The nearest so far, near ones first: the distance in space, then, in the lowest byte, in the
/// order.
const NONE: [u64; NEIGHBOURS] = [(u32::MAX as u64) << 8; NEIGHBOURS];

/// How much two points that face different ways are turned from each other, by the product of
/// their normals: 0 where it is little, about 500 where they are opposite. They count as farther
/// apart by it, as what is on the other side of an edge or a wall says little.
fn turned(along: i32) -> i32 {
    127i32.wrapping_mul(127).wrapping_sub(along).max(0) >> 6
}

fn normal_steps(code: u8) -> [i32; 3] {
    let steps = NORMAL_STEPS.get(usize::from(code));
    steps.copied().unwrap_or_default()
}

/// Keeps a candidate if it is among the nearest; of equally near ones, the nearest in the order.
fn keep(nearest: &mut [u64; NEIGHBOURS], mut candidate: u64) {
    for kept in nearest {
        (*kept, candidate) = ((*kept).min(candidate), (*kept).max(candidate));
    }
}

/// What both sides know of a slice's points, besides where they are.
#[derive(Debug)]
pub struct SliceState<'a> {
    /// Occlusion at the client: 255 is open.
    pub value: &'a mut [u8],
    /// Its last change, at most 127 either way. As many as values.
    pub last: &'a mut [i8],
}

/// How coarse a slice is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quantiser {
    /// Residuals are multiples of this many 1/255; 0 counts as 1. 1 is lossless together with
    /// `dead_zone` 0.
    pub step: u8,
    /// A point that is off by no more than this many 1/255 is left as it is. One that is to be 0
    /// becomes 0 all the same: the lookup all but leaves out points that are wholly occluded (those
    /// within something else), and no longer does where they are a little above.
    pub dead_zone: u8,
}

impl Quantiser {
    /// No coded point is off by more than this many 1/255.
    pub fn bound(self) -> u8 {
        self.dead_zone.max(self.step / 2)
    }

    /// Whether a point that says `value` is near enough to `target` to be left as it is.
    pub fn leaves(self, value: u8, target: u8) -> bool {
        value == target || target != 0 && value.abs_diff(target) <= self.dead_zone
    }
}

/// Codes a slice that the client has in this state, so that it gets near `target`, and brings the
/// state to what the client will then have. `first`: the client has never had the slice; its
/// state is taken for open and still, whatever it says. Returns the number of bytes.
///
/// `neighbours`, the state and `target` have the same length, at most [`SLICE_POINTS`]; what is
/// longer than the shortest is left alone. `free`: a set of points, the first in the lowest bit of
/// the first word, that may say anything: they take what costs least. Those beyond its end are not
/// in it.
///
/// # Errors
/// `out` has no room: [`MAX_SLICE_BYTES`] are always enough. The state is then worthless.
pub fn encode_slice(
    neighbours: &[Neighbours],
    quantiser: Quantiser,
    state: &mut SliceState<'_>,
    target: &[u8],
    free: &[u64],
    first: bool,
    out: &mut [u8],
) -> Result<usize, Full> {
    let mut side = Encode {
        coder: Encoder::new(out),
        target,
        free,
        quantiser,
        per_step: (1u32 << 20)
            .wrapping_div(u32::from(quantiser.step.max(1)))
            .wrapping_add(1),
    };
    code_slice(&mut side, neighbours, quantiser.step, state, first);
    side.coder.finish()
}

/// Decodes what [`encode_slice`] coded, with the same neighbours, `step`, state and `first`.
///
/// Takes time in proportion to the points, whatever the bytes.
///
/// # Errors
/// [`StreamError::Length`]: the bytes are not what the encoder wrote. The state is then
/// worthless. (Not every change of the bytes shows here: packets have checksums for that.)
pub fn decode_slice(
    neighbours: &[Neighbours],
    step: u8,
    state: &mut SliceState<'_>,
    first: bool,
    bytes: &[u8],
) -> Result<(), StreamError> {
    let mut side = Decode(Decoder::new(bytes));
    code_slice(&mut side, neighbours, step, state, first);
    side.0.finish()
}

/// Bytes that any slice fits in: a point takes a symbol of at most 14 bits and at most 8 more.
pub const MAX_SLICE_BYTES: usize = 3 << 10;

/// Where encoder and decoder differ: the one knows the answers, the other reads them.
trait Side {
    /// Codes a decision: returns `wanted` when encoding, and what was read when decoding.
    fn decide(&mut self, odds: u16, wanted: bool) -> bool;
    /// The same for the steps that `way` points along.
    fn coded(&mut self, row: &Row, way: i32, wanted: i32) -> i32;
    /// A block's points need coding (not asked for when decoding).
    fn moved(&self, first: usize, values: &[u8]) -> bool;
    /// The steps to take from a point's predicted value (not asked for when decoding).
    fn steps(&self, at: usize, predicted: i32) -> i32;
}

struct Encode<'a> {
    coder: Encoder<'a>,
    target: &'a [u8],
    free: &'a [u64],
    quantiser: Quantiser,
    /// What to multiply by in place of dividing by the step, in 1/2^20 and rounded up.
    per_step: u32,
}

impl Encode<'_> {
    /// Whole steps in a distance of at most 512, exactly: what rounding up adds is less than the
    /// distance / 2^20, and so less than a step's part in one.
    fn whole_steps(&self, far: i32) -> i32 {
        ((far as u32).wrapping_mul(self.per_step) >> 20) as i32
    }

    /// The points from `first` on, up to the next multiple of 64, that may say anything.
    fn free(&self, first: usize) -> u64 {
        let word = self.free.get(first >> 6).copied().unwrap_or_default();
        word >> (first & 63)
    }
}

impl Side for Encode<'_> {
    fn decide(&mut self, odds: u16, wanted: bool) -> bool {
        self.coder.decide(odds, wanted);
        wanted
    }

    #[inline(always)]
    fn coded(&mut self, row: &Row, way: i32, wanted: i32) -> i32 {
        if wanted == 0 {
            // The first symbol, and the usual one, is a decision.
            let [none, ..] = *row;
            self.coder.decide(none, true);
            return 0;
        }
        let along = wanted.wrapping_mul(way);
        let size = along.unsigned_abs();
        let against = u32::from(along < 0);
        if size <= LAST_ALONE {
            let symbol = (size << 1).saturating_sub(1).wrapping_add(against);
            self.coder.symbol(row, symbol as usize);
        } else {
            let over = size.wrapping_sub(LAST_ALONE - 1);
            let bits = over.ilog2().min(LONGEST);
            self.coder
                .symbol(row, bits.wrapping_add(2 * LAST_ALONE) as usize);
            let rest = over.wrapping_sub(1 << bits) << 1 | against;
            self.coder.bits(bits.wrapping_add(1), rest);
        }
        wanted
    }

    fn moved(&self, first: usize, values: &[u8]) -> bool {
        let target = self.target.get(first..).unwrap_or_default();
        let moved = |target: &[u8], values: &[u8]| {
            let pairs = target.iter().zip(values);
            pairs.fold(false, |moved, (t, v)| {
                moved | !self.quantiser.leaves(*v, *t)
            })
        };
        let free = self.free(first);
        if free != 0 {
            let pairs = target.iter().zip(values).enumerate();
            let mut needed = pairs.filter(|(at, _)| free >> (at & 63) & 1 == 0);
            return needed.any(|(_, (t, v))| !self.quantiser.leaves(*v, *t));
        }
        // Of known length in the usual case: then it takes a few instructions.
        match (target.first_chunk::<BLOCK>(), values.first_chunk::<BLOCK>()) {
            (Some(target), Some(values)) => moved(target, values),
            _ => moved(target, values),
        }
    }

    fn steps(&self, at: usize, predicted: i32) -> i32 {
        if self.free(at) & 1 != 0 {
            return 0;
        }
        let target = self.target.get(at).copied().unwrap_or_default();
        let off = i32::from(target).wrapping_sub(predicted);
        let Quantiser { step, dead_zone } = self.quantiser;
        let (far, step) = (off.wrapping_abs(), i32::from(step.max(1)));
        if target == 0 {
            // What goes beyond ends there.
            let most = far.wrapping_add(step).wrapping_sub(1);
            return 0i32.wrapping_sub(self.whole_steps(most));
        }
        if far <= i32::from(dead_zone) {
            return 0;
        }
        let nearest = self.whole_steps(far.wrapping_add(step >> 1));
        // Fewer steps cost fewer bits.
        let fewer = nearest.wrapping_sub(1);
        let rest = far.wrapping_sub(fewer.wrapping_mul(step));
        let steps = if nearest > 1 && rest <= i32::from(dead_zone) {
            fewer
        } else {
            nearest
        };
        steps.wrapping_mul(off.signum())
    }
}

struct Decode<'a>(Decoder<'a>);

impl Side for Decode<'_> {
    #[inline(always)]
    fn decide(&mut self, odds: u16, _: bool) -> bool {
        self.0.decide(odds)
    }

    #[inline(always)]
    fn coded(&mut self, row: &Row, way: i32, _: i32) -> i32 {
        let symbol = self.0.symbol(row) as u32;
        if symbol == 0 {
            return 0;
        }
        let (size, against) = if symbol <= 2 * LAST_ALONE {
            (symbol.wrapping_add(1) >> 1, symbol & 1 == 0)
        } else {
            let bits = symbol.wrapping_sub(2 * LAST_ALONE);
            let rest = self.0.bits(bits.wrapping_add(1));
            let over = (1 << bits) | rest >> 1;
            (over.wrapping_add(LAST_ALONE - 1), rest & 1 != 0)
        };
        let along = (size as i32).wrapping_mul(way);
        if against {
            0i32.wrapping_sub(along)
        } else {
            along
        }
    }

    fn moved(&self, _: usize, _: &[u8]) -> bool {
        false
    }

    fn steps(&self, _: usize, _: i32) -> i32 {
        0
    }
}

/// Steps to either side with a symbol of their own, after the one for none. Each symbol after
/// these is for twice as many sizes as the one before, told apart by plain bits, and for both
/// sides.
const LAST_ALONE: u32 = 4;
/// Plain bits of the last symbol, its side not counted.
const LONGEST: u32 = SYMBOLS as u32 - 1 - 2 * LAST_ALONE;

/// Weights of changes in 1/64: of a neighbour now, of one that comes later in the last frame, and
/// of the point itself then.
const NOW: i32 = 17;
const LAST: i32 = 8;
const OWN: i32 = 7;

/// After a rest: the weight of what is around, in 1/64, and the least change there that counts.
const AROUND: i32 = 31;
const MUCH: i32 = 5;

/// A point's part in its neighbours' prediction: in the upper half the weighted change, in the
/// lower how much went on there. Parts can be added as they are.
fn part(change: i32, activity: i32) -> i32 {
    (change << 16).wrapping_add(activity)
}

/// The change that a part stands for.
fn change_of(part: i32) -> i32 {
    let change = (part & 0xffff) >> 1;
    if part < 0 {
        0i32.wrapping_sub(change)
    } else {
        change
    }
}

/// What is expected of a point in a block that was at rest, if what was coded around it changed by
/// much: about the same, as such a block has its turn after many steps at once. The weighted change,
/// and how much goes on: most where those around it do not agree.
#[inline(always)]
fn after_a_rest(
    parts: &[i32; SLICE_POINTS],
    coded: u64,
    start: usize,
    at: usize,
    earlier: [u8; NEIGHBOURS],
) -> Option<(i32, i32)> {
    let around = earlier.map(|back| {
        let of = at.wrapping_sub(usize::from(back));
        let is_coded = coded >> ((of / BLOCK) & 63) & 1 != 0;
        (back != 0 && is_coded).then(|| change_of(get(parts, of)))
    });
    let (one, other) = match around {
        [Some(one), Some(other)] => (one, other),
        [Some(one), None] | [None, Some(one)] => (one, one),
        [None, None] if at != start => {
            let before = change_of(get(parts, at.wrapping_sub(1)));
            (before, before)
        }
        [None, None] => return None,
    };
    let (most, apart) = (
        one.wrapping_abs().max(other.wrapping_abs()),
        one.wrapping_sub(other).wrapping_abs(),
    );
    let activity = one
        .wrapping_abs()
        .wrapping_add(other.wrapping_abs())
        .wrapping_add(apart << 2);
    let sum = one.wrapping_add(other).wrapping_mul(AROUND);
    (most >= MUCH).then_some((sum, activity))
}

/// The least activity of each kind but the first.
const ACTIVITY_STARTS: [u8; ACTIVITIES - 1] = [1, 3, 5, 7, 10, 14, 20, 28, 40, 60, 91];

/// The kind of an activity.
static ACTIVITY_KINDS: [u8; 128] = {
    let mut kinds = [0; 128];
    let mut activity = 0;
    while activity < 128 {
        #[allow(clippy::indexing_slicing, clippy::arithmetic_side_effects)]
        {
            let mut kind = 0;
            while kind < ACTIVITIES - 1 && activity >= ACTIVITY_STARTS[kind] as usize {
                kind += 1;
            }
            kinds[activity] = kind as u8;
            activity += 1;
        }
    }
    kinds
};

fn activity_kind(activity: i32) -> usize {
    let last = ACTIVITY_KINDS.len().wrapping_sub(1);
    let kind = ACTIVITY_KINDS.get((activity as usize).min(last));
    kind.map_or(0, |kind| usize::from(*kind))
}

/// The same for both sides.
fn code_slice<S: Side>(
    side: &mut S,
    neighbours: &[Neighbours],
    step: u8,
    state: &mut SliceState<'_>,
    first: bool,
) {
    let count = neighbours
        .len()
        .min(state.value.len())
        .min(state.last.len());
    let count = count.min(SLICE_POINTS);
    let (Some(neighbours), Some(values), Some(lasts)) = (
        neighbours.get(..count),
        state.value.get_mut(..count),
        state.last.get_mut(..count),
    ) else {
        return;
    };
    let step = i32::from(step.max(1));
    if first {
        values.fill(255);
        lasts.fill(0);
        code_first(side, neighbours, step, values);
    } else {
        code_later(side, neighbours, step, values, lasts);
    }
}

/// Where a slice was open: a point is about as dark as its neighbours before it.
fn code_first<S: Side>(side: &mut S, neighbours: &[Neighbours], step: i32, values: &mut [u8]) {
    let mut darks = [0i32; SLICE_POINTS];
    let mut moved_before = 0usize;
    let blocks = values.chunks_mut(BLOCK).zip(neighbours.chunks(BLOCK));
    for (block, (values, neighbours)) in blocks.enumerate() {
        let start = block.wrapping_mul(BLOCK);
        let Some(odds) = FIRST_BLOCK.get(moved_before) else {
            return;
        };
        let wanted = side.moved(start, values);
        let moved = side.decide(*odds, wanted);
        moved_before = (moved_before << 1 | usize::from(moved)) & 3;
        if !moved {
            continue;
        }
        for (at, (value, neighbours)) in (start..).zip(values.iter_mut().zip(neighbours)) {
            let earlier = neighbours.earlier;
            let [a, b] = earlier.map(|back| get(&darks, at.wrapping_sub(usize::from(back))));
            let dark = a.wrapping_add(b).wrapping_add(1) >> 1;
            let spread = a.wrapping_sub(b).wrapping_abs() >> 1;
            let [spread, kind] = [spread, dark].map(|n| i32::BITS.wrapping_sub(n.leading_zeros()));
            let row = FIRST.get(spread as usize);
            let Some(row) = row.and_then(|row| row.get(kind as usize)) else {
                return;
            };
            let predicted = 255i32.wrapping_sub(dark);
            let wanted = side.steps(at, predicted);
            let moved = side.coded(row, -1, wanted).wrapping_mul(step);
            let has = predicted.wrapping_add(moved).clamp(0, 255);
            *value = has as u8;
            if let Some(dark) = darks.get_mut(at) {
                *dark = 255i32.wrapping_sub(has);
            }
        }
    }
}

/// Where it had been coded before: a point changes about as its neighbours do.
fn code_later<S: Side>(
    side: &mut S,
    neighbours: &[Neighbours],
    step: i32,
    values: &mut [u8],
    lasts: &mut [i8],
) {
    let kind = (step as usize).min(LATER.len()).wrapping_sub(1);
    let (Some(block_odds), Some(odds)) = (BLOCK_ODDS.get(kind), LATER.get(kind)) else {
        return;
    };
    let mut parts = [0i32; SLICE_POINTS];
    for (part_of, last) in parts.iter_mut().zip(lasts.iter()) {
        let last = i32::from(*last);
        *part_of = part(last.wrapping_mul(LAST), last.wrapping_abs());
    }
    let mut moved_before = 0usize;
    // Blocks that have moved, the first in the lowest bit.
    let mut coded = 0u64;
    let blocks = values
        .chunks_mut(BLOCK)
        .zip(lasts.chunks_mut(BLOCK))
        .zip(neighbours.chunks(BLOCK));
    for (block, ((values, lasts), neighbours)) in blocks.enumerate() {
        let start = block.wrapping_mul(BLOCK);
        let busy = busy(lasts);
        let kind = match busy {
            0..=2 => busy,
            3..=5 => 3,
            _ => 4,
        };
        let row = block_odds.get(moved_before);
        let Some(block_odds) = row.and_then(|row| row.get(kind)) else {
            return;
        };
        let wanted = side.moved(start, values);
        let moved = side.decide(*block_odds, wanted);
        moved_before = (moved_before << 1 | usize::from(moved)) & 3;
        if !moved {
            let end = start.wrapping_add(lasts.len());
            parts.get_mut(start..end).unwrap_or_default().fill(0);
            lasts.fill(0);
            continue;
        }
        coded |= 1 << (block & 63);
        let points = values.iter_mut().zip(lasts.iter_mut()).zip(neighbours);
        for (at, ((value, last), neighbours)) in (start..).zip(points) {
            let mut sum = 0i32;
            for forward in neighbours.later {
                sum = sum.wrapping_add(get(&parts, at.wrapping_add(usize::from(forward))));
            }
            for back in neighbours.earlier {
                sum = sum.wrapping_add(get(&parts, at.wrapping_sub(usize::from(back))));
            }
            let old = i32::from(*last);
            let mut activity = (sum & 0xffff).wrapping_add(old.wrapping_abs() << 1);
            let mut sum = (sum >> 16).wrapping_add(old.wrapping_mul(OWN));
            if busy == 0
                && let Some(expected) = after_a_rest(&parts, coded, start, at, neighbours.earlier)
            {
                (sum, activity) = expected;
            }
            let change = sum.wrapping_add(32) >> 6;
            let had = i32::from(*value);
            let predicted = had.wrapping_add(change).clamp(0, 255);
            // Mirrored, so that what is usual upwards is also known downwards.
            let (way, lies) = match predicted {
                0 => (1, 2),
                255 => (-1, 2),
                _ => {
                    let way = if sum < 0 { -1 } else { 1 };
                    let over = sum.wrapping_sub(change << 6).wrapping_mul(way);
                    (way, usize::from(over >= 0))
                }
            };
            let row = odds.get(activity_kind(activity));
            let Some(row) = row.and_then(|row| row.get(lies)) else {
                return;
            };
            let wanted = side.steps(at, predicted);
            let mut keep = |has: i32| {
                let change = has.wrapping_sub(had).clamp(-127, 127);
                *value = has as u8;
                *last = change as i8;
                if let Some(part_of) = parts.get_mut(at) {
                    *part_of = part(change.wrapping_mul(NOW), change.wrapping_abs() << 1);
                }
            };
            // Apart, as the next point waits for what becomes of this: no steps are the usual
            // case, and then nothing else has to be known for it.
            match side.coded(row, way, wanted) {
                0 => keep(predicted),
                steps => {
                    let moved = steps.wrapping_mul(step);
                    keep(predicted.wrapping_add(moved).clamp(0, 255));
                }
            }
        }
    }
}

/// How many points of a block have changed last.
fn busy(lasts: &[i8]) -> usize {
    let busy = |lasts: &[i8]| {
        lasts
            .iter()
            .fold(0u8, |n, last| n.wrapping_add(u8::from(*last != 0)))
    };
    // Of known length in the usual case: then it takes three instructions.
    usize::from(
        lasts
            .first_chunk::<BLOCK>()
            .map_or_else(|| busy(lasts), |block| busy(block)),
    )
}

fn get(parts: &[i32; SLICE_POINTS], at: usize) -> i32 {
    parts
        .get(at & (SLICE_POINTS.wrapping_sub(1)))
        .copied()
        .unwrap_or_default()
}

#[cfg(test)]
#[allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::arithmetic_side_effects
)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec;
    use std::vec::Vec;

    /// Pseudo-random numbers below a limit.
    struct Random(u32);

    impl Random {
        fn below(&mut self, limit: u32) -> u32 {
            self.0 = self.0.wrapping_mul(747796405).wrapping_add(2891336453);
            let mixed = (self.0 >> 16 ^ self.0).wrapping_mul(0x7feb352d);
            (mixed ^ mixed >> 15) % limit
        }
    }

    fn patch(positions: &[[u32; 3]], normals: &[u8]) -> Vec<PatchPoint> {
        let pairs = positions.iter().zip(normals);
        let point = |(position, normal): (&[u32; 3], &u8)| PatchPoint {
            position: *position,
            normal: *normal,
            ..PatchPoint::default()
        };
        pairs.map(point).collect()
    }

    /// A slice on two walls, and a shadow that wanders over it.
    struct Scene {
        positions: Vec<[u32; 3]>,
        neighbours: Vec<Neighbours>,
    }

    impl Scene {
        fn new(points: usize, seed: u32) -> Scene {
            let mut random = Random(seed);
            let mut positions = Vec::new();
            let mut normals = Vec::new();
            for at in 0..points as u32 {
                // Morton order on a 32 x 32 patch, folded in the middle.
                let even = |v: u32| (0..5).map(|bit| (v >> (2 * bit) & 1) << bit).sum::<u32>();
                let [u, v] = [even(at), even(at >> 1)].map(|c| c * 19 + random.below(12));
                let fold = 16 * 19;
                positions.push([u.min(fold), v, u.saturating_sub(fold)]);
                normals.push(if u < fold { 0x77 } else { 0x7e });
            }
            let mut neighbours = vec![Neighbours::default(); points];
            find_neighbours(&patch(&positions, &normals), &mut neighbours);
            Scene {
                positions,
                neighbours,
            }
        }

        fn target(&self, frame: u32, random: &mut Random) -> Vec<u8> {
            let darkness = |p: &[u32; 3]| {
                let centre = [40 + frame * 9 % 900, 300, 20];
                let off: u32 = p
                    .iter()
                    .zip(&centre)
                    .map(|(p, c)| p.abs_diff(*c).pow(2))
                    .sum();
                180u32.saturating_sub(off / 150)
            };
            let noisy = |dark: u32| if dark > 0 { dark + random.below(4) } else { 0 };
            self.positions
                .iter()
                .map(darkness)
                .map(noisy)
                .map(|dark| 255 - dark as u8)
                .collect()
        }
    }

    #[derive(Clone, Debug, PartialEq)]
    struct Owned {
        value: Vec<u8>,
        last: Vec<i8>,
    }

    impl Owned {
        fn new(points: usize) -> Owned {
            Owned {
                value: vec![99; points],
                last: vec![-3; points],
            }
        }

        fn state(&mut self) -> SliceState<'_> {
            SliceState {
                value: &mut self.value,
                last: &mut self.last,
            }
        }
    }

    fn encode(
        scene: &Scene,
        quantiser: Quantiser,
        state: &mut Owned,
        target: &[u8],
        first: bool,
    ) -> Vec<u8> {
        let mut out = vec![0; MAX_SLICE_BYTES];
        let state = &mut state.state();
        let length = encode_slice(
            &scene.neighbours,
            quantiser,
            state,
            target,
            &[],
            first,
            &mut out,
        );
        out.truncate(length.unwrap());
        out
    }

    /// Codes a frame, checks that both sides agree and are within the bound, and returns the bytes.
    fn both(
        scene: &Scene,
        quantiser: Quantiser,
        [server, client]: &mut [Owned; 2],
        target: &[u8],
        first: bool,
    ) -> Vec<u8> {
        let bytes = encode(scene, quantiser, server, target, first);
        let state = &mut client.state();
        decode_slice(&scene.neighbours, quantiser.step, state, first, &bytes).unwrap();
        assert!(server == client, "{quantiser:?}");
        for (value, target) in server.value.iter().zip(target) {
            assert!(
                value.abs_diff(*target) <= quantiser.bound(),
                "{quantiser:?}"
            );
        }
        bytes
    }

    const LENGTHS: [usize; 7] = [0, 1, 15, 16, 17, 1000, SLICE_POINTS];

    #[test]
    fn both_sides_end_the_same_and_within_the_bound_whatever_the_step_and_length() {
        for points in LENGTHS {
            let scene = Scene::new(points, 1);
            for step in 1..=16 {
                for dead_zone in [0, step / 2, step] {
                    let quantiser = Quantiser { step, dead_zone };
                    let mut random = Random(u32::from(step));
                    let mut sides = [Owned::new(points), Owned::new(points)];
                    for frame in 0..8 {
                        let target = scene.target(frame * 3, &mut random);
                        both(&scene, quantiser, &mut sides, &target, frame == 0);
                    }
                }
            }
        }
    }

    #[test]
    fn targets_without_any_order_are_coded_in_the_bytes_promised() {
        let scene = Scene::new(SLICE_POINTS, 2);
        let mut random = Random(3);
        for (step, dead_zone) in [(1, 0), (7, 200), (255, 0), (255, 255)] {
            let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
            for frame in 0..20 {
                // Noise, then black and white at random: the longest jumps.
                let steep = frame % 2 * 254 + 1;
                let target: Vec<u8> = (0..SLICE_POINTS)
                    .map(|_| (random.below(256) / steep * steep) as u8)
                    .collect();
                both(
                    &scene,
                    Quantiser { step, dead_zone },
                    &mut sides,
                    &target,
                    frame == 0,
                );
            }
        }
    }

    #[test]
    fn points_that_may_say_anything_save_bytes_and_the_others_end_within_the_bound() {
        let scene = Scene::new(SLICE_POINTS, 1);
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        // Every other eight, and all of the second half.
        let mut free = [0xff00_ff00_ff00_ff00; SLICE_POINTS / 64];
        free[SLICE_POINTS / 128..].fill(u64::MAX);
        let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
        let start = scene.target(0, &mut Random(9));
        both(&scene, quantiser, &mut sides, &start, true);
        let opened = sides[0].value.clone();
        for frame in 1..8 {
            let target = scene.target(frame * 3, &mut Random(frame));
            let whole = both(&scene, quantiser, &mut sides.clone(), &target, false);
            let [server, client] = &mut sides;
            let mut bytes = vec![0; MAX_SLICE_BYTES];
            let state = &mut server.state();
            let near = &scene.neighbours;
            let length = encode_slice(near, quantiser, state, &target, &free, false, &mut bytes);
            let bytes = &bytes[..length.unwrap()];
            decode_slice(near, quantiser.step, &mut client.state(), false, bytes).unwrap();
            assert!(server == client);
            assert!(
                bytes.len() < whole.len(),
                "{} of {}",
                bytes.len(),
                whole.len()
            );
            for (at, (value, target)) in server.value.iter().zip(&target).enumerate() {
                let is_free = free[at / 64] >> (at % 64) & 1 != 0;
                assert!(
                    is_free || value.abs_diff(*target) <= quantiser.bound(),
                    "{at}"
                );
            }
            // A block that is free as a whole stays as it is.
            let half = SLICE_POINTS / 2;
            assert!(server.value[half..] == opened[half..]);
        }
    }

    #[test]
    fn what_is_to_be_black_becomes_black_within_the_dead_zone_too() {
        let scene = Scene::new(SLICE_POINTS, 1);
        for (step, dead_zone) in [(3, 2), (4, 3), (6, 4), (1, 9)] {
            let quantiser = Quantiser { step, dead_zone };
            let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
            let start: Vec<u8> = (0..SLICE_POINTS).map(|at| (at % 7) as u8).collect();
            both(&scene, quantiser, &mut sides, &start, true);
            both(&scene, quantiser, &mut sides, &[0; SLICE_POINTS], false);
            assert_eq!(sides[0].value, [0; SLICE_POINTS]);
        }
    }

    #[test]
    fn step_1_without_dead_zone_loses_nothing() {
        let scene = Scene::new(SLICE_POINTS, 1);
        let quantiser = Quantiser {
            step: 1,
            dead_zone: 0,
        };
        assert_eq!(quantiser.bound(), 0);
        let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
        for frame in 0..10 {
            let target = scene.target(frame, &mut Random(frame));
            both(&scene, quantiser, &mut sides, &target, frame == 0);
            assert_eq!(sides[0].value, target);
        }
    }

    #[test]
    fn what_is_open_or_within_the_dead_zone_costs_next_to_nothing() {
        let scene = Scene::new(SLICE_POINTS, 1);
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
        let open = vec![253; SLICE_POINTS];
        let bytes = both(&scene, quantiser, &mut sides, &open, true);
        assert!(bytes.len() <= 3, "{} bytes", bytes.len());
        let bytes = both(&scene, quantiser, &mut sides, &open, false);
        assert!(bytes.len() <= 3, "{} bytes", bytes.len());
        assert_eq!(sides[0].value, [255; SLICE_POINTS]);
    }

    #[test]
    fn output_without_room_is_an_error_however_little_is_missing() {
        let scene = Scene::new(SLICE_POINTS, 1);
        let quantiser = Quantiser {
            step: 2,
            dead_zone: 1,
        };
        let target = scene.target(9, &mut Random(1));
        let length = encode(
            &scene,
            quantiser,
            &mut Owned::new(SLICE_POINTS),
            &target,
            true,
        )
        .len();
        for room in 0..length {
            let (mut out, mut state) = (vec![0; room], Owned::new(SLICE_POINTS));
            let state = &mut state.state();
            let result = encode_slice(
                &scene.neighbours,
                quantiser,
                state,
                &target,
                &[],
                true,
                &mut out,
            );
            assert_eq!(result, Err(Full));
        }
    }

    #[test]
    fn what_changes_as_one_after_a_rest_costs_little() {
        let scene = Scene::new(SLICE_POINTS, 3);
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        let bytes_of = |change: u8| {
            let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
            let first = vec![200; SLICE_POINTS];
            both(&scene, quantiser, &mut sides, &first, true);
            // Every fourth block has its turn.
            let mut target = first;
            let turns = target.chunks_mut(BLOCK).step_by(4);
            turns.flatten().for_each(|value| *value -= change);
            both(&scene, quantiser, &mut sides, &target, false).len()
        };
        // The first of a block says by how much, the others follow.
        let (little, much) = (bytes_of(9), bytes_of(60));
        assert!(little < 64 && much < 192, "{little} and {much}");
    }

    #[test]
    fn changed_cut_and_lengthened_bytes_do_no_harm() {
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        // Such a run can end as some other slice would; it must be the exception. Of one scene's
        // runs chance says more than the coder: these are many.
        let (mut unnoticed, mut tried) = ([0; 4], [0; 4]);
        for seed in 1..9 {
            let scene = Scene::new(SLICE_POINTS, seed);
            let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
            let target = scene.target(0, &mut Random(1));
            both(&scene, quantiser, &mut sides, &target, true);
            for frame in 1..20 {
                let before = sides[0].clone();
                let target = scene.target(frame, &mut Random(frame + 1));
                let bytes = both(&scene, quantiser, &mut sides, &target, false);
                let decode = |bytes: &[u8]| {
                    let (mut state, neighbours) = (before.clone(), &scene.neighbours);
                    let result = decode_slice(neighbours, 3, &mut state.state(), false, bytes);
                    result.map(|()| state)
                };
                assert!(decode(&bytes).as_ref() == Ok(&sides[0]));
                let mut count = |kind: usize, bytes: &[u8]| {
                    let decoded = decode(bytes);
                    assert!(decoded.is_ok() || decoded == Err(StreamError::Length));
                    unnoticed[kind] += u32::from(decoded.is_ok());
                    tried[kind] += 1;
                };
                for length in 0..bytes.len() {
                    count(0, &bytes[..length]);
                }
                for bit in 0..bytes.len() * 8 {
                    let mut changed = bytes.clone();
                    changed[bit / 8] ^= 1 << (bit % 8);
                    count(1, &changed);
                }
                for more in 0..=255 {
                    let mut longer = bytes.clone();
                    longer.push(more);
                    count(2, &longer);
                    longer.extend([0; 12]);
                    count(3, &longer);
                }
            }
        }
        let rare = [25, 6, 11, 1000];
        for ((unnoticed, tried), rare) in unnoticed.into_iter().zip(tried).zip(rare) {
            assert!(unnoticed * rare < tried, "{unnoticed} of {tried}");
        }
    }

    #[test]
    fn random_bytes_are_decoded_to_an_end() {
        let mut random = Random(4);
        let scene = Scene::new(SLICE_POINTS, 1);
        for _ in 0..100_000 {
            let points = LENGTHS[random.below(6) as usize].min(64);
            let bytes: Vec<u8> = (0..random.below(40))
                .map(|_| random.below(256) as u8)
                .collect();
            let mut state = Owned {
                value: (0..points).map(|_| random.below(256) as u8).collect(),
                last: (0..points).map(|_| random.below(256) as i8).collect(),
            };
            let (step, first) = (random.below(256) as u8, random.below(2) == 0);
            let neighbours = &scene.neighbours[..points];
            let _ = decode_slice(neighbours, step, &mut state.state(), first, &bytes);
        }
    }

    #[test]
    fn neighbours_that_do_not_exist_are_harmless() {
        let wild = vec![
            Neighbours {
                earlier: [255; 2],
                later: [255; 2]
            };
            SLICE_POINTS
        ];
        let scene = Scene {
            neighbours: wild,
            ..Scene::new(SLICE_POINTS, 1)
        };
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 2,
        };
        let mut sides = [Owned::new(SLICE_POINTS), Owned::new(SLICE_POINTS)];
        for frame in 0..3 {
            let target = scene.target(frame, &mut Random(1));
            both(&scene, quantiser, &mut sides, &target, frame == 0);
        }
    }

    #[test]
    fn neighbours_are_the_nearest_on_the_same_side() {
        let scene = Scene::new(SLICE_POINTS, 1);
        for (at, neighbours) in scene.neighbours.iter().enumerate() {
            let distance = |other: usize| -> u32 {
                let pair = scene.positions[at].iter().zip(&scene.positions[other]);
                pair.map(|(a, b)| a.abs_diff(*b).pow(2)).sum()
            };
            for back in neighbours.earlier.map(usize::from) {
                assert!(back <= at && (back > 0 || at < 3), "{at}: {neighbours:?}");
            }
            for forward in neighbours.later.map(usize::from) {
                let left = SLICE_POINTS - 1 - at;
                assert!(
                    forward <= left && (forward > 0 || left < 3),
                    "{at}: {neighbours:?}"
                );
            }
            // On a jittered lattice of 19 steps, the last of each four has one next door.
            if at % 4 == 3 {
                let nearest = distance(at - usize::from(neighbours.earlier[0]));
                assert!(nearest <= 31 * 31 + 12 * 12, "{at}: {nearest}");
            }
        }
        // Two sheets back to back: neighbours are on the own side, though the other is nearer.
        let positions: Vec<[u32; 3]> = (0..64).map(|at| [at / 2 * 10, 0, at % 2]).collect();
        let normals: Vec<u8> = (0..64)
            .map(|at| if at % 2 == 0 { 0x77 } else { 0 })
            .collect();
        let mut found = vec![Neighbours::default(); 64];
        find_neighbours(&patch(&positions, &normals), &mut found);
        assert!(
            found[10..54]
                .iter()
                .all(|n| n.earlier[0] % 2 == 0 && n.later[0] % 2 == 0)
        );
    }

    #[test]
    fn neighbours_are_those_of_a_search_through_all_pairs() {
        let mut random = Random(5);
        let spreads = [3, 40, 3000, 5000, 1 << 14, 1 << 25];
        let sizes = spreads.map(|spread| (300, spread));
        // Told anew, in floating point, which is exact for these numbers.
        let apart = |p: &PatchPoint, q: &PatchPoint| {
            let axes = |p: [f64; 3], q: [f64; 3]| (0..3).map(move |axis| (p[axis], q[axis]));
            let far = 16384.0;
            let squared: f64 = axes(p.position.map(f64::from), q.position.map(f64::from))
                .map(|(p, q)| (p - q).abs().min(far).powi(2))
                .sum();
            let normal = |p: &PatchPoint| NORMAL_STEPS[usize::from(p.normal)].map(f64::from);
            let along: f64 = axes(normal(p), normal(q)).map(|(p, q)| p * q).sum();
            let turned = match p.normal == q.normal {
                true => 0.0,
                false => ((127.0 * 127.0 - along).max(0.0) / 64.0).floor(),
            };
            let apart = squared + 2.0 * turned + (squared * turned / 32.0).floor();
            apart.min(f64::from(u32::MAX)) as u32
        };
        for (count, spread) in [
            (1, 9),
            (2, 1),
            (2, 9000),
            (40, 3),
            (300, 40),
            (1024, 40),
            (1024, 1 << 25),
        ]
        .into_iter()
        .chain(sizes)
        {
            let points: Vec<PatchPoint> = (0..count)
                .map(|_| PatchPoint {
                    position: [0; 3].map(|_| random.below(spread)),
                    normal: random.below(3) as u8 * 0x33,
                    ..PatchPoint::default()
                })
                .collect();
            let mut found = vec![Neighbours::default(); count];
            find_neighbours(&points, &mut found);
            for (at, found) in found.iter().enumerate() {
                let two = |mut all: Vec<(u32, u8)>| {
                    all.retain(|(apart, _)| *apart < u32::MAX);
                    all.sort_unstable();
                    all.extend([(0, 0); 2]);
                    [all[0].1, all[1].1]
                };
                let back =
                    (1..=WINDOW.min(at)).map(|by| (apart(&points[at], &points[at - by]), by as u8));
                assert_eq!(found.earlier, two(back.collect()), "{at} of {count}");
                let forward = (1..=WINDOW.min(count - 1 - at))
                    .map(|by| (apart(&points[at], &points[at + by]), by as u8));
                assert_eq!(found.later, two(forward.collect()), "{at} of {count}");
            }
        }
    }

    #[test]
    fn decoded_states_are_the_same_on_every_machine() {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let mut add = |byte: u8| {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        };
        for points in LENGTHS {
            let scene = Scene::new(points, 7);
            let mut random = Random(8);
            let mut sides = [Owned::new(points), Owned::new(points)];
            for frame in 0..40 {
                let step = 1 + random.below(6) as u8;
                let quantiser = Quantiser {
                    step,
                    dead_zone: random.below(5) as u8,
                };
                let target = scene.target(frame, &mut random);
                let bytes = both(&scene, quantiser, &mut sides, &target, frame % 16 == 0);
                bytes.iter().for_each(|byte| add(*byte));
                sides[1].value.iter().for_each(|value| add(*value));
                sides[1].last.iter().for_each(|last| add(*last as u8));
            }
        }
        assert_eq!(hash, 18406625483993254412);
    }
}
