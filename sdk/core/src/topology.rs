//! Topology: where a mesh's points are, in patches of up to [`PATCH_POINTS`], compactly coded.
//!
//! A patch is coded by [`code_points`], the same function for writer and reader. Its points lie in
//! Morton order, so that each begins like the one before it; what is left of a position is plain
//! along the surface, and predicted from the surface's normal across it.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::point::NORMAL_STEPS;
use crate::range::{Decoder, Encoder, Full, Odds};
use crate::stream::{Reader, StreamError, Writer};
use bytemuck::{Pod, Zeroable};

/// Most points of a patch.
pub const PATCH_POINTS: usize = 1024;

/// Levels of detail; each has half as many points as the one below it.
pub const LEVELS: u32 = 4;

/// Bits of a position along an axis: 2²⁰ cells of 32 steps.
pub const POSITION_BITS: u32 = 25;

/// Bytes that any patch fits in.
pub const MAX_PATCH_BYTES: usize = 24 << 10;

/// A point of a mesh.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct PatchPoint {
    /// Steps from the grid's corner: 1/32 of the cells that an instance of level 0 has.
    pub position: [u32; 3],
    /// Code of the normal in cell space, [`crate::point::encode_normal`].
    pub normal: u8,
    /// The highest level that has the point, below [`LEVELS`].
    pub level: u8,
    /// Zero.
    pub reserved: [u8; 2],
}

/// The order of a patch's points: by the bits of their positions, the highest first.
pub struct Order(Frame);

impl Order {
    /// The order for these points, at least one.
    pub fn of(points: &[PatchPoint]) -> Order {
        Order(Frame::around(points))
    }

    /// What to sort by.
    pub fn key(&self, point: &PatchPoint) -> (u128, u8, u8) {
        (self.0.key(point.position), point.normal, point.level)
    }
}

/// Writes a patch. Returns the number of bytes.
///
/// # Errors
/// `out` has no room ([`MAX_PATCH_BYTES`] are always enough); there are no points, or more than
/// [`PATCH_POINTS`], or they are not in [`Order`]; or one has a position of more than
/// [`POSITION_BITS`], a normal that no encoder makes, or a level too high.
pub fn encode_patch(points: &[PatchPoint], out: &mut [u8]) -> Result<usize, Full> {
    let bad = |point: &PatchPoint| {
        point.position.iter().any(|&p| p >> POSITION_BITS != 0)
            || point.normal != normal_code(split_normal(point.normal))
            || u32::from(point.level) >= LEVELS
    };
    let mut copy = [PatchPoint::default(); PATCH_POINTS];
    let copy = copy.get_mut(..points.len()).ok_or(Full)?;
    copy.copy_from_slice(points);
    let order = Order::of(points);
    if points.is_empty()
        || points.iter().any(bad)
        || !points.is_sorted_by_key(|point| order.key(point).0)
    {
        return Err(Full);
    }
    let mut frame = order.0;
    let mut w = Writer::new(out);
    let head = |w: &mut Writer<'_>| {
        w.varint(points.len() as u32)?;
        frame.origin.into_iter().try_for_each(|v| w.varint(v))?;
        w.bytes(&frame.bits)
    };
    head(&mut w).map_err(|_| Full)?;
    let start = w.length();
    let mut side = Encode(Encoder::new(out.get_mut(start..).ok_or(Full)?));
    code_points(&mut side, &mut frame, copy).map_err(|_| Full)?;
    Ok(start.saturating_add(side.0.finish()?))
}

/// Reads a patch into `points` and says how many it has, at least 1.
///
/// Takes time in proportion to the points, whatever the bytes.
///
/// # Errors
/// The bytes are not what a writer writes; or `points` is shorter than the patch.
pub fn decode_patch(bytes: &[u8], points: &mut [PatchPoint]) -> Result<usize, StreamError> {
    let mut r = Reader(bytes);
    let count = r.varint()? as usize;
    if count == 0 || count > PATCH_POINTS {
        return Err(StreamError::Value);
    }
    let origin = [r.varint()?, r.varint()?, r.varint()?];
    let mut frame = Frame::new(origin, r.array()?)?;
    let points = points.get_mut(..count).ok_or(StreamError::Length)?;
    let mut side = Decode(Decoder::new(r.0));
    code_points(&mut side, &mut frame, points)?;
    side.0.finish()?;
    Ok(count)
}

/// Most bits of a position in a patch, all axes together.
const DEPTHS: usize = 3 * POSITION_BITS as usize;

/// The box around a patch, and the order in which its positions' bits count.
struct Frame {
    origin: [u32; 3],
    bits: [u8; 3],
    /// For each depth, the highest first: the axis, and the bits of every axis below it.
    order: [(u8, [u8; 3]); DEPTHS],
    depths: usize,
}

impl Frame {
    fn around(points: &[PatchPoint]) -> Frame {
        let fold = |with: fn(u32, u32) -> u32, start: u32| {
            points.iter().fold([start; 3], |bound, p| {
                let ([a, b, c], [x, y, z]) = (bound, p.position);
                [with(a, x), with(b, y), with(c, z)]
            })
        };
        let (min, max) = (fold(u32::min, u32::MAX), fold(u32::max, 0));
        let ([a, b, c], [x, y, z]) = (min, max);
        let bits =
            |from: u32, to: u32| 32u32.saturating_sub((to.wrapping_sub(from)).leading_zeros());
        let mut frame = Frame {
            origin: min,
            bits: [bits(a, x) as u8, bits(b, y) as u8, bits(c, z) as u8],
            order: [(0, [0; 3]); DEPTHS],
            depths: 0,
        };
        frame.lay_out();
        frame
    }

    fn new(origin: [u32; 3], bits: [u8; 3]) -> Result<Frame, StreamError> {
        let fits = |(&from, &bits): (&u32, &u8)| {
            u32::from(bits) <= POSITION_BITS && from >> POSITION_BITS == 0
        };
        if !origin.iter().zip(&bits).all(fits) {
            return Err(StreamError::Value);
        }
        let mut frame = Frame {
            origin,
            bits,
            order: [(0, [0; 3]); DEPTHS],
            depths: 0,
        };
        frame.lay_out();
        Ok(frame)
    }

    /// At each depth the axis with the most bits left counts, the first of equals.
    fn lay_out(&mut self) {
        let mut left = self.bits;
        self.depths = 0;
        for depth in &mut self.order {
            let [x, y, z] = left;
            let most = x.max(y).max(z);
            if most == 0 {
                break;
            }
            let axis = left.iter().position(|&bits| bits == most).unwrap_or(0);
            if let Some(bits) = left.get_mut(axis) {
                *bits = bits.saturating_sub(1);
            }
            *depth = (axis as u8, left);
            self.depths = self.depths.saturating_add(1);
        }
    }

    fn order(&self) -> &[(u8, [u8; 3])] {
        self.order.get(..self.depths).unwrap_or_default()
    }

    /// Offset from the patch's corner.
    fn offset(&self, position: [u32; 3]) -> [u32; 3] {
        let ([x, y, z], [a, b, c]) = (position, self.origin);
        [x.wrapping_sub(a), y.wrapping_sub(b), z.wrapping_sub(c)]
    }

    /// The number that the order sorts by.
    fn key(&self, position: [u32; 3]) -> u128 {
        let offset = self.offset(position);
        self.order().iter().fold(0, |key, (axis, left)| {
            let bit = get(&offset, *axis) >> get(left, *axis) & 1;
            key << 1 | u128::from(bit)
        })
    }

    /// The first depth at which two offsets differ; the number of depths if they are equal.
    fn differs_at(&self, a: [u32; 3], b: [u32; 3]) -> usize {
        let differs = |(axis, left): &(u8, [u8; 3])| {
            (get(&a, *axis) ^ get(&b, *axis)) >> get(left, *axis) & 1 != 0
        };
        self.order().iter().position(differs).unwrap_or(self.depths)
    }
}

fn get<T: Copy + Default>(values: &[T; 3], axis: u8) -> T {
    values.get(usize::from(axis)).copied().unwrap_or_default()
}

/// Where writer and reader differ: the one knows the answers, the other reads them.
trait Side {
    /// Codes a decision: returns `wanted` when writing, and what was read when reading.
    fn bit(&mut self, odds: &mut Odds, wanted: bool) -> bool;
    /// Codes a plain number of up to 16 bits.
    fn bits(&mut self, count: u32, wanted: u32) -> u32;
}

struct Encode<'a>(Encoder<'a>);

impl Side for Encode<'_> {
    fn bit(&mut self, odds: &mut Odds, wanted: bool) -> bool {
        self.0.bit(odds, wanted);
        wanted
    }

    fn bits(&mut self, count: u32, wanted: u32) -> u32 {
        let mask = (1u32 << count).wrapping_sub(1);
        self.0.bits(count, wanted & mask);
        wanted & mask
    }
}

struct Decode<'a>(Decoder<'a>);

impl Side for Decode<'_> {
    fn bit(&mut self, odds: &mut Odds, _: bool) -> bool {
        self.0.bit(odds)
    }

    fn bits(&mut self, count: u32, _: u32) -> u32 {
        self.0.bits(count)
    }
}

/// A plain number of up to 32 bits, the upper ones first.
fn plain<S: Side>(side: &mut S, count: u32, wanted: u32) -> u32 {
    let upper = count.saturating_sub(16);
    let lower = count.min(16);
    let high = side.bits(upper, wanted.checked_shr(lower).unwrap_or(0));
    high.checked_shl(lower).unwrap_or(0) | side.bits(lower, wanted)
}

/// The odds of all kinds of decisions; they start anew with every patch.
struct Contexts {
    /// By the level of the point before, and how far the level has got.
    level: [[Odds; 3]; LEVELS as usize],
    /// The normal is that of the point before; by whether that was so there.
    same: [Odds; 2],
    /// It is the last one that was another.
    again: Odds,
    /// Otherwise, an axis: it is not as before; it goes down; it goes further.
    turn_some: [Odds; 3],
    turn_down: [Odds; 2],
    turn_more: [[Odds; 6]; 2],
    /// Where the position differs from the one before: a tree of 7 decisions.
    depth: [[Odds; 128]; 2],
    /// Across the surface: bits of the distance from the prediction, and its sign.
    across: [[Odds; POSITION_BITS as usize + 2]; 4 * 2],
    above: Odds,
}

impl Contexts {
    const START: Contexts = Contexts {
        level: [[Odds::new(128); 3]; LEVELS as usize],
        same: [Odds::new(128); 2],
        again: Odds::new(128),
        turn_some: [Odds::new(128); 3],
        turn_down: [Odds::new(128); 2],
        turn_more: [[Odds::new(128); 6]; 2],
        depth: [[Odds::new(128); 128]; 2],
        across: [[Odds::new(128); POSITION_BITS as usize + 2]; 4 * 2],
        above: Odds::new(128),
    };
}

/// How many points back one may lean on.
const BACK: usize = 16;

/// What the points so far say of the next.
struct History {
    normal: [u8; 2],
    other: [u8; 2],
    same: bool,
    level: u8,
    depth: usize,
    across: u32,
}

/// Codes all points of a patch, in its order. The reader's `points` become what was read.
fn code_points<S: Side>(
    side: &mut S,
    frame: &mut Frame,
    points: &mut [PatchPoint],
) -> Result<(), StreamError> {
    let mut odds = Contexts::START;
    let mut history = History {
        normal: [7; 2],
        other: [7; 2],
        same: true,
        level: 0,
        depth: 0,
        across: 0,
    };
    for at in 0..points.len() {
        let Some((done, [point, ..])) = points.split_at_mut_checked(at) else {
            break;
        };
        let level = code_level(
            side,
            odds.level.get_mut(usize::from(history.level)),
            point.level,
        );
        history.level = level;
        let normal = code_normal(side, &mut odds, &mut history, split_normal(point.normal))?;
        let back = done.get(at.saturating_sub(BACK)..).unwrap_or_default();
        let normal = normal_code(normal);
        let position = code_position(
            side,
            &mut odds,
            frame,
            &mut history,
            back,
            normal,
            point.position,
        )?;
        *point = PatchPoint {
            position,
            normal,
            level,
            reserved: [0; 2],
        };
    }
    Ok(())
}

fn code_level<S: Side>(side: &mut S, odds: Option<&mut [Odds; 3]>, wanted: u8) -> u8 {
    let mut level = 0;
    for odds in odds.into_iter().flatten() {
        if !side.bit(odds, wanted > level) {
            break;
        }
        level = level.wrapping_add(1);
    }
    level
}

/// A normal's two codes, 0 to 14 each.
fn split_normal(code: u8) -> [u8; 2] {
    [(code & 15).min(14), (code >> 4).min(14)]
}

fn normal_code([u, v]: [u8; 2]) -> u8 {
    u | v << 4
}

fn code_normal<S: Side>(
    side: &mut S,
    odds: &mut Contexts,
    history: &mut History,
    wanted: [u8; 2],
) -> Result<[u8; 2], StreamError> {
    let before = history.normal;
    let [same, changed] = &mut odds.same;
    let odds_same = if history.same { same } else { changed };
    history.same = side.bit(odds_same, wanted == before);
    if history.same {
        return Ok(before);
    }
    let other = history.other;
    history.other = before;
    if side.bit(&mut odds.again, wanted == other) {
        history.normal = other;
        return Ok(other);
    }
    let mut normal = before;
    let mut some = 0usize;
    let axes = normal.iter_mut().zip(wanted).zip(&mut odds.turn_more);
    for (((axis, wanted), more), down) in axes.zip(&mut odds.turn_down) {
        let by = i32::from(wanted).wrapping_sub(i32::from(*axis));
        let Some(odds_some) = odds.turn_some.get_mut(some) else {
            break;
        };
        some = 1;
        if !side.bit(odds_some, by != 0) {
            continue;
        }
        some = 2;
        let down = side.bit(down, by < 0);
        let mut far = 1u8;
        // From one end to the other is 14.
        while far < 14 {
            let row = usize::from(far).min(more.len()).wrapping_sub(1);
            let Some(odds) = more.get_mut(row) else { break };
            if !side.bit(odds, by.unsigned_abs() > u32::from(far)) {
                break;
            }
            far = far.wrapping_add(1);
        }
        let turned = if down {
            axis.checked_sub(far)
        } else {
            axis.checked_add(far).filter(|&code| code <= 14)
        };
        *axis = turned.ok_or(StreamError::Value)?;
    }
    history.normal = normal;
    Ok(normal)
}

fn code_position<S: Side>(
    side: &mut S,
    odds: &mut Contexts,
    frame: &Frame,
    history: &mut History,
    back: &[PatchPoint],
    normal: u8,
    wanted: [u32; 3],
) -> Result<[u32; 3], StreamError> {
    let wanted = frame.offset(wanted);
    // The bits that it shares with the point before, and how many are left of each axis.
    let (mut offset, left) = match back.last() {
        None => ([0; 3], frame.bits),
        Some(last) => {
            let last = frame.offset(last.position);
            let set = odds
                .depth
                .get_mut(usize::from(history.depth.is_multiple_of(2)));
            let depth = code_depth(side, set, frame.differs_at(last, wanted));
            history.depth = depth;
            match frame.order().get(depth) {
                // The same position once more.
                None if depth == frame.depths => (last, [0; 3]),
                None => return Err(StreamError::Value),
                Some(&(axis, left)) => {
                    let mut kept = last;
                    for (at, (kept, left)) in kept.iter_mut().zip(left).enumerate() {
                        *kept = kept.checked_shr(u32::from(left)).unwrap_or(0);
                        if at == usize::from(axis) {
                            // It comes after the one before, so the first bit to differ is a 1.
                            if *kept & 1 != 0 {
                                return Err(StreamError::Value);
                            }
                            *kept |= 1;
                        }
                        *kept = kept.checked_shl(u32::from(left)).unwrap_or(0);
                    }
                    (kept, left)
                }
            }
        }
    };
    let steps = NORMAL_STEPS
        .get(usize::from(normal))
        .copied()
        .unwrap_or_default();
    let [x, y, z] = steps.map(i32::unsigned_abs);
    let across = if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    };
    for (axis, offset) in offset.iter_mut().enumerate() {
        if axis != across {
            let left = left.get(axis).copied().unwrap_or(0);
            *offset |= plain(
                side,
                u32::from(left),
                wanted.get(axis).copied().unwrap_or(0),
            );
        }
    }
    let (Some(low), Some(left)) = (offset.get(across).copied(), left.get(across)) else {
        return Err(StreamError::Value);
    };
    if *left > 0 {
        let high = low
            | 1u32
                .checked_shl(u32::from(*left))
                .unwrap_or(0)
                .wrapping_sub(1);
        let predicted = predict(frame, back, &steps, normal, across, offset).clamp(low, high);
        let wanted = wanted.get(across).copied().unwrap_or(0);
        let flat = steps.iter().filter(|step| **step != 0).count() == 1;
        let value = code_across(side, odds, history, flat, predicted, [low, high], wanted)?;
        if let Some(offset) = offset.get_mut(across) {
            *offset = value;
        }
    }
    let ([a, b, c], [x, y, z]) = (frame.origin, offset);
    let position = [a.wrapping_add(x), b.wrapping_add(y), c.wrapping_add(z)];
    let fits = position.iter().all(|p| p >> POSITION_BITS == 0);
    fits.then_some(position).ok_or(StreamError::Value)
}

/// A depth, the highest of 7 bits first.
fn code_depth<S: Side>(side: &mut S, odds: Option<&mut [Odds; 128]>, wanted: usize) -> usize {
    let mut node = 1usize;
    if let Some(odds) = odds {
        for bit in (0..7).rev() {
            let Some(odds) = odds.get_mut(node) else {
                break;
            };
            node = node << 1 | usize::from(side.bit(odds, wanted >> bit & 1 != 0));
        }
    }
    node & 127
}

/// Where the plane through the nearest point so far says that a point is, across the surface.
fn predict(
    frame: &Frame,
    back: &[PatchPoint],
    steps: &[i32; 3],
    normal: u8,
    across: usize,
    offset: [u32; 3],
) -> u32 {
    let mut nearest = (u32::MAX, 0i64);
    for point in back.iter().rev() {
        let from = frame.offset(point.position);
        let (mut far, mut slope, mut base) = (0u32, 0i64, 0i64);
        let axes = offset.iter().zip(&from).zip(steps);
        for (axis, ((to, from), step)) in axes.enumerate() {
            if axis == across {
                base = i64::from(*from);
            } else {
                far = far.saturating_add(to.abs_diff(*from));
                let by = i64::from(*to).wrapping_sub(i64::from(*from));
                slope = slope.wrapping_add(by.wrapping_mul(i64::from(*step)));
            }
        }
        if point.normal != normal {
            far = far.saturating_add(64);
        }
        if far < nearest.0 {
            let rise = i64::from(steps.get(across).copied().unwrap_or(1));
            // Rounded to the nearest, halves up.
            let double = slope.wrapping_mul(2).wrapping_mul(rise.signum());
            let rise = rise.abs();
            let moved = double
                .wrapping_add(rise)
                .div_euclid(rise.wrapping_mul(2).max(1));
            nearest = (far, base.wrapping_sub(moved));
        }
    }
    nearest.1.clamp(0, i64::from(u32::MAX)) as u32
}

/// The offset across the surface, between `low` and `high`.
fn code_across<S: Side>(
    side: &mut S,
    odds: &mut Contexts,
    history: &mut History,
    flat: bool,
    predicted: u32,
    [low, high]: [u32; 2],
    wanted: u32,
) -> Result<u32, StreamError> {
    let class = history.across.min(3) << 1 | u32::from(flat);
    let far = wanted.abs_diff(predicted);
    let bits = 32u32.wrapping_sub(far.leading_zeros());
    let mut count = 0;
    for odds in odds.across.get_mut(class as usize).into_iter().flatten() {
        if !side.bit(odds, bits > count) {
            break;
        }
        count = count.wrapping_add(1);
    }
    history.across = count;
    if count == 0 {
        return Ok(predicted);
    }
    let lower = count.wrapping_sub(1);
    let far = 1u32.checked_shl(lower).unwrap_or(0) | plain(side, lower, far);
    let above = if predicted == low {
        true
    } else if predicted == high {
        false
    } else {
        side.bit(&mut odds.above, wanted > predicted)
    };
    let value = if above {
        predicted.checked_add(far)
    } else {
        predicted.checked_sub(far)
    };
    let inside = value.filter(|value| (low..=high).contains(value));
    inside.ok_or(StreamError::Value)
}
