//! Topology: where a mesh's points are, in patches of up to [`PATCH_POINTS`], compactly coded.
//!
//! A patch is coded by one function, the same for writer and reader. It is halved again
//! and again, and how many points each half has is coded, until a part has one point. What is left
//! of that point's position is plain along the surface, and predicted from its normal across it.
//! Along the surface positions may be coarser: all those of a lattice ([`settled`]).
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::point::NORMAL_STEPS;
use crate::range::{Decoder, Encoder, Full, Odds, odds};
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

/// Longest lattice of a patch, as a power of two: half a cell.
pub const MOST_SHIFT: u32 = 4;

/// The axis across the surface: that on which a normal's code is longest, the first of equals.
pub fn across(normal: u8) -> usize {
    let steps = NORMAL_STEPS.get(usize::from(normal)).copied();
    let [x, y, z] = steps.unwrap_or_default().map(i32::unsigned_abs);
    if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    }
}

/// The position of a lattice that stands for this one, along an axis: all that differ in the
/// lowest `shift` bits alone (at most [`MOST_SHIFT`]) have the one in their middle in common.
///
/// A patch of which all points are settled, along the two axes that are not [`across`], costs
/// `2 * shift` bits a point less.
pub fn settled(position: u32, shift: u32) -> u32 {
    let low = low_bits(shift);
    position & !low | low.div_ceil(2)
}

fn low_bits(count: u32) -> u32 {
    1u32.checked_shl(count).unwrap_or(0).wrapping_sub(1)
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
    let frame = order.0;
    let mut w = Writer::new(out);
    let head = |w: &mut Writer<'_>| {
        w.varint(points.len() as u32)?;
        frame.origin.into_iter().try_for_each(|v| w.varint(v))?;
        w.bytes(&frame.bits)?;
        w.bytes(&[frame.highest | (frame.shift as u8) << 2])
    };
    head(&mut w).map_err(|_| Full)?;
    let start = w.length();
    let mut side = Encode(Encoder::new(out.get_mut(start..).ok_or(Full)?));
    code_points(&mut side, &frame, copy).map_err(|_| Full)?;
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
    let frame = Frame::new(origin, r.array()?, r.array()?)?;
    let points = points.get_mut(..count).ok_or(StreamError::Length)?;
    let mut side = Decode(Decoder::new(r.0));
    code_points(&mut side, &frame, points)?;
    side.0.finish()?;
    Ok(count)
}

/// Most bits of a position in a patch, all axes together.
const DEPTHS: usize = 3 * POSITION_BITS as usize;

/// The box around a patch, and the order in which its positions' bits count.
struct Frame {
    origin: [u32; 3],
    bits: [u8; 3],
    /// The highest level that a point has.
    highest: u8,
    /// The lattice that all points are settled on.
    shift: u32,
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
        let fits = |shift: &u32| {
            points.iter().all(|point| {
                let mut axes = point.position.iter().enumerate();
                let across = across(point.normal);
                axes.all(|(axis, at)| axis == across || settled(*at, *shift) == *at)
            })
        };
        let shift = (1..=MOST_SHIFT).rev().find(fits).unwrap_or(0);
        // So that offsets are settled as positions are.
        let min = fold(u32::min, u32::MAX).map(|least| least & !low_bits(shift));
        let ([a, b, c], [x, y, z]) = (min, fold(u32::max, 0));
        let bits =
            |from: u32, to: u32| 32u32.saturating_sub((to.wrapping_sub(from)).leading_zeros());
        let mut frame = Frame {
            origin: min,
            bits: [bits(a, x) as u8, bits(b, y) as u8, bits(c, z) as u8],
            highest: points.iter().map(|point| point.level).max().unwrap_or(0),
            shift,
            order: [(0, [0; 3]); DEPTHS],
            depths: 0,
        };
        frame.lay_out();
        frame
    }

    fn new(origin: [u32; 3], bits: [u8; 3], [form]: [u8; 1]) -> Result<Frame, StreamError> {
        let (highest, shift) = (form & 3, u32::from(form >> 2));
        let fits = |(&from, &bits): (&u32, &u8)| {
            u32::from(bits) <= POSITION_BITS && from >> POSITION_BITS == 0
        };
        let settled = origin.iter().all(|from| from & low_bits(shift) == 0);
        if shift > MOST_SHIFT || !settled || !origin.iter().zip(&bits).all(fits) {
            return Err(StreamError::Value);
        }
        let mut frame = Frame {
            origin,
            bits,
            highest,
            shift,
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

    /// Bits of each axis from a depth on.
    fn left(&self, depth: usize) -> [u8; 3] {
        match depth.checked_sub(1) {
            None => self.bits,
            Some(above) => self.order().get(above).map_or([0; 3], |(_, left)| *left),
        }
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
    /// How many points have a 0 in this bit of an axis (not asked for when reading).
    fn below(&self, points: &[PatchPoint], frame: &Frame, axis: u8, left: [u8; 3]) -> usize;
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

    fn below(&self, points: &[PatchPoint], frame: &Frame, axis: u8, left: [u8; 3]) -> usize {
        let bit = |p: &PatchPoint| get(&frame.offset(p.position), axis) >> get(&left, axis) & 1;
        points.partition_point(|point| bit(point) == 0)
    }
}

struct Decode<'a>(Decoder<'a>);

impl Side for Decode<'_> {
    #[inline(always)]
    fn bit(&mut self, odds: &mut Odds, _: bool) -> bool {
        self.0.bit(odds)
    }

    #[inline(always)]
    fn bits(&mut self, count: u32, _: u32) -> u32 {
        self.0.bits(count)
    }

    fn below(&self, _: &[PatchPoint], _: &Frame, _: u8, _: [u8; 3]) -> usize {
        0
    }
}

/// A plain number of up to 32 bits, the upper ones first.
fn plain<S: Side>(side: &mut S, count: u32, wanted: u32) -> u32 {
    let upper = count.saturating_sub(16);
    let lower = count.min(16);
    let high = side.bits(upper, wanted.checked_shr(lower).unwrap_or(0));
    high.checked_shl(lower).unwrap_or(0) | side.bits(lower, wanted)
}

/// Two plain numbers; as one if that is short enough, as each costs a division.
fn plain_pair<S: Side>(side: &mut S, counts: [u32; 2], wanted: [u32; 2]) -> [u32; 2] {
    let ([first, second], [upper, lower]) = (wanted, counts);
    if upper.saturating_add(lower) > 16 {
        return [plain(side, upper, first), plain(side, lower, second)];
    }
    let both = first << lower | second & low_bits(lower);
    let both = side.bits(upper.wrapping_add(lower), both);
    [both >> lower, both & low_bits(lower)]
}

/// The odds of all kinds of decisions; they start anew with every patch.
struct Contexts {
    /// A part of the patch has points on both sides of its middle: by how long it is, how many
    /// points it has, and how it was with the last such part.
    both: [[[Odds; STATES]; 3]; POSITION_BITS as usize],
    /// Otherwise, all are above.
    above: [Odds; STATES],
    /// How many are below: for few points, a tree for each number.
    few: [[Odds; 16]; 17],
    /// For many, a tree of 16ths.
    many: [Odds; 16],
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
    /// Across the surface: bits of the distance from the prediction, and its sign.
    across: [[Odds; POSITION_BITS as usize + 2]; 4 * 2],
    up: Odds,
}

/// What the last part of the same size was like: none yet, points on both sides, all below, all
/// above.
const STATES: usize = 4;

impl Contexts {
    const START: Contexts = Contexts {
        both: [
            [
                odds([57, 160, 27, 86]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([51, 97, 34, 93]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([78, 175, 91, 53]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([137, 130, 105, 113]),
                odds([161, 159, 157, 170]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([202, 211, 140, 151]),
                odds([227, 254, 209, 229]),
                odds([167, 242, 198, 211]),
            ],
            [
                odds([89, 159, 36, 44]),
                odds([220, 243, 108, 115]),
                odds([243, 253, 161, 128]),
            ],
            [
                odds([73, 74, 24, 40]),
                odds([114, 140, 40, 72]),
                odds([236, 240, 87, 109]),
            ],
            [
                odds([55, 46, 15, 31]),
                odds([67, 95, 43, 46]),
                odds([238, 202, 89, 127]),
            ],
            [
                odds([114, 49, 33, 29]),
                odds([109, 56, 14, 25]),
                odds([244, 174, 60, 74]),
            ],
            [
                odds([145, 87, 59, 85]),
                odds([128, 60, 30, 73]),
                odds([237, 149, 44, 91]),
            ],
            [
                odds([128, 94, 80, 120]),
                odds([157, 54, 63, 80]),
                odds([197, 93, 41, 116]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([233, 202, 128, 176]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
            [
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
                odds([128, 128, 128, 128]),
            ],
        ],
        above: odds([100, 94, 38, 163]),
        few: [
            odds([
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 131, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 215, 56, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 234, 134, 32, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 232, 201, 82, 36, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 251, 220, 132, 47, 52, 128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 248, 231, 196, 78, 19, 98, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 157, 242, 214, 144, 55, 40, 103, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 164, 217, 200, 199, 96, 83, 132, 75, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 155, 242, 235, 192, 158, 96, 76, 112, 82, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 148, 241, 244, 208, 195, 112, 70, 22, 125, 98, 128, 128, 128, 128, 128,
            ]),
            odds([
                128, 161, 158, 249, 247, 201, 134, 80, 40, 13, 154, 116, 128, 128, 128, 128,
            ]),
            odds([
                128, 198, 145, 248, 248, 222, 186, 102, 42, 10, 97, 115, 112, 128, 128, 128,
            ]),
            odds([
                128, 160, 167, 252, 155, 249, 201, 131, 65, 32, 11, 127, 116, 123, 128, 128,
            ]),
            odds([
                128, 193, 131, 247, 140, 244, 220, 184, 92, 20, 48, 11, 148, 117, 118, 128,
            ]),
        ],
        many: odds([
            128, 141, 161, 153, 248, 154, 244, 221, 169, 40, 38, 126, 46, 89, 112, 138,
        ]),
        level: [
            odds([153, 130, 126]),
            odds([117, 149, 135]),
            odds([86, 97, 148]),
            odds([100, 86, 86]),
        ],
        same: odds([250, 117]),
        again: Odds::new(118),
        turn_some: odds([187, 254, 169]),
        turn_down: odds([125, 126]),
        turn_more: [
            odds([163, 196, 208, 215, 216, 165]),
            odds([173, 204, 218, 222, 226, 171]),
        ],
        across: [
            odds([
                160, 148, 169, 172, 139, 74, 73, 37, 57, 111, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                7, 207, 207, 188, 170, 102, 20, 61, 85, 98, 128, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                172, 140, 152, 161, 128, 69, 76, 54, 102, 84, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                138, 129, 113, 155, 156, 161, 58, 61, 128, 145, 111, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                196, 178, 149, 141, 116, 88, 77, 34, 95, 111, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                141, 160, 121, 147, 131, 136, 68, 87, 88, 128, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                202, 200, 183, 162, 124, 83, 78, 45, 60, 88, 111, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
            odds([
                125, 235, 228, 227, 192, 95, 24, 53, 56, 111, 128, 128, 128, 128, 128, 128, 128,
                128, 128, 128, 128, 128, 128, 128, 128, 128, 128,
            ]),
        ],
        up: Odds::new(127),
    };
}

/// How many points back one may lean on.
const BACK: usize = 8;

/// What the points so far say of the next.
struct History {
    normal: [u8; 2],
    other: [u8; 2],
    same: bool,
    level: u8,
    across: u32,
    /// The state of each depth.
    states: [u8; DEPTHS],
}

/// A part of the patch: what its points' offsets have in common, and how many they are.
#[derive(Clone, Copy, Default)]
struct Part {
    offset: [u32; 3],
    depth: usize,
    count: usize,
}

/// Codes all points of a patch, in its order: the patch is halved again and again, until a part
/// has one point. The reader's `points` become what was read.
fn code_points<S: Side>(
    side: &mut S,
    frame: &Frame,
    points: &mut [PatchPoint],
) -> Result<(), StreamError> {
    let mut odds = Contexts::START;
    let mut history = History {
        normal: [7; 2],
        other: [7; 2],
        same: true,
        level: 0,
        across: 0,
        states: [0; DEPTHS],
    };
    // The upper halves that wait: one a depth at most.
    let mut waiting = [Part::default(); DEPTHS];
    let mut waits = 0usize;
    let mut part = Part {
        count: points.len(),
        ..Part::default()
    };
    let mut at = 0usize;
    loop {
        while let (2.., Some(&(axis, left))) = (part.count, frame.order().get(part.depth)) {
            let end = at.saturating_add(part.count);
            let wanted = side.below(points.get(at..end).unwrap_or_default(), frame, axis, left);
            let below = code_below(
                side,
                &mut odds,
                &mut history,
                &part,
                get(&left, axis),
                wanted,
            )?;
            let depth = part.depth.saturating_add(1);
            let mut upper = Part {
                depth,
                count: part.count.saturating_sub(below),
                ..part
            };
            if let Some(offset) = upper.offset.get_mut(usize::from(axis)) {
                *offset |= 1u32.checked_shl(u32::from(get(&left, axis))).unwrap_or(0);
            }
            let lower = Part {
                depth,
                count: below,
                ..part
            };
            part = if below == 0 { upper } else { lower };
            if below > 0 && upper.count > 0 {
                *waiting.get_mut(waits).ok_or(StreamError::Value)? = upper;
                waits = waits.saturating_add(1);
            }
        }
        for _ in 0..part.count {
            let Some((done, [point, ..])) = points.split_at_mut_checked(at) else {
                return Err(StreamError::Value);
            };
            let back = done.get(at.saturating_sub(BACK)..).unwrap_or_default();
            *point = code_point(side, &mut odds, frame, &mut history, back, &part, *point)?;
            at = at.saturating_add(1);
        }
        let Some(next) = waits.checked_sub(1) else {
            return Ok(());
        };
        waits = next;
        part = waiting.get(next).copied().unwrap_or_default();
    }
}

/// How many of a part's points lie below its middle.
fn code_below<S: Side>(
    side: &mut S,
    odds: &mut Contexts,
    history: &mut History,
    part: &Part,
    left: u8,
    wanted: usize,
) -> Result<usize, StreamError> {
    let count = part.count;
    let class = match count {
        2 => 0,
        3 | 4 => 1,
        _ => 2,
    };
    let state = history
        .states
        .get_mut(part.depth)
        .ok_or(StreamError::Value)?;
    let odds_both = odds
        .both
        .get_mut(usize::from(left))
        .and_then(|row| row.get_mut(class))
        .and_then(|row| row.get_mut(usize::from(*state)));
    let odds_above = odds.above.get_mut(usize::from(*state));
    let (Some(odds_both), Some(odds_above)) = (odds_both, odds_above) else {
        return Err(StreamError::Value);
    };
    if !side.bit(odds_both, wanted != 0 && wanted != count) {
        let above = side.bit(odds_above, wanted == 0);
        *state = if above { 3 } else { 2 };
        return Ok(if above { 0 } else { count });
    }
    *state = 1;
    if count <= 16 {
        // From 1 on, all below the count.
        let tree = odds.few.get_mut(count).ok_or(StreamError::Value)?;
        let values = count.saturating_sub(1);
        let value = code_tree(side, tree, values, wanted.saturating_sub(1));
        return Ok(value.saturating_add(1));
    }
    let sixteenth = |below: usize| (below << 4).checked_div(count).unwrap_or(0);
    let part = code_tree(side, &mut odds.many, 16, sixteenth(wanted));
    // The first with this 16th, and how many bits those with it need.
    let first = part.wrapping_mul(count).div_ceil(16);
    let bits = usize::BITS.wrapping_sub((count >> 4).leading_zeros());
    let more = side.bits(bits, wanted.wrapping_sub(first) as u32) as usize;
    let below = first.saturating_add(more);
    let inside = (1..count).contains(&below);
    inside.then_some(below).ok_or(StreamError::Value)
}

/// A number below `values`, at most 16: halves of what is left, as long as there are two.
fn code_tree<S: Side>(side: &mut S, odds: &mut [Odds; 16], values: usize, wanted: usize) -> usize {
    let (mut low, mut high) = (0usize, values);
    while high.saturating_sub(low) > 1 {
        // Each middle comes up on one way only, so it names the odds.
        let middle = low.midpoint(high);
        let Some(odds) = odds.get_mut(middle) else {
            break;
        };
        if side.bit(odds, wanted >= middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

fn code_point<S: Side>(
    side: &mut S,
    odds: &mut Contexts,
    frame: &Frame,
    history: &mut History,
    back: &[PatchPoint],
    part: &Part,
    wanted: PatchPoint,
) -> Result<PatchPoint, StreamError> {
    let level_odds = odds.level.get_mut(usize::from(history.level));
    let level = code_level(side, level_odds, frame.highest, wanted.level);
    history.level = level;
    let normal = code_normal(side, odds, history, split_normal(wanted.normal))?;
    let normal = normal_code(normal);
    let position = code_position(
        side,
        odds,
        frame,
        history,
        back,
        normal,
        part,
        wanted.position,
    )?;
    Ok(PatchPoint {
        position,
        normal,
        level,
        reserved: [0; 2],
    })
}

fn code_level<S: Side>(side: &mut S, odds: Option<&mut [Odds; 3]>, highest: u8, wanted: u8) -> u8 {
    let mut level = 0;
    for odds in odds.into_iter().flatten().take(usize::from(highest)) {
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
    part: &Part,
    wanted: [u32; 3],
) -> Result<[u32; 3], StreamError> {
    let wanted = frame.offset(wanted);
    let (mut offset, left) = (part.offset, frame.left(part.depth));
    let across = across(normal);
    let along = match across {
        0 => [1, 2],
        1 => [0, 2],
        _ => [0, 1],
    };
    let counts = along.map(|axis| u32::from(get(&left, axis)).saturating_sub(frame.shift));
    let [first, second] = along.map(|axis| get(&wanted, axis) >> frame.shift);
    let told = plain_pair(side, counts, [first, second]);
    for (axis, told) in along.into_iter().zip(told) {
        let middle = settled(0, frame.shift) & low_bits(u32::from(get(&left, axis)));
        if let Some(offset) = offset.get_mut(usize::from(axis)) {
            *offset |= told << frame.shift | middle;
        }
    }
    let steps = NORMAL_STEPS
        .get(usize::from(normal))
        .copied()
        .unwrap_or_default();
    let (Some(low), Some(left)) = (offset.get(across).copied(), left.get(across)) else {
        return Err(StreamError::Value);
    };
    if *left > 0 {
        let high = low | low_bits(u32::from(*left));
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

/// Where the plane through the nearest point so far says that a point is, across the surface.
fn predict(
    frame: &Frame,
    back: &[PatchPoint],
    steps: &[i32; 3],
    normal: u8,
    across: usize,
    offset: [u32; 3],
) -> u32 {
    // Along the surface twice, then across it.
    let of = |[x, y, z]: [i64; 3]| match across {
        0 => [y, z, x],
        1 => [x, z, y],
        _ => [x, y, z],
    };
    let by = |point: &PatchPoint| {
        let [from_u, from_v, from] = of(frame.offset(point.position).map(i64::from));
        let [u, v, _] = of(offset.map(i64::from));
        [u.wrapping_sub(from_u), v.wrapping_sub(from_v), from]
    };
    // The least of numbers whose lowest byte tells which they are of: which it will be is hard to
    // foretell.
    let least = back.iter().rev().zip(0u64..).map(|(point, which)| {
        let [by_u, by_v, _] = by(point);
        let turned = u64::from(point.normal != normal) << 6;
        let far = by_u.unsigned_abs().wrapping_add(by_v.unsigned_abs());
        far.wrapping_add(turned) << 8 | which
    });
    let nearest = least
        .min()
        .and_then(|least| back.iter().rev().nth((least & 0xff) as usize));
    let [by_u, by_v, from] = nearest.map(by).unwrap_or_default();
    let [step_u, step_v, rise] = of(steps.map(i64::from));
    let slope = by_u
        .wrapping_mul(step_u)
        .wrapping_add(by_v.wrapping_mul(step_v));
    // Rounded to the nearest, halves up.
    let double = slope.wrapping_mul(2).wrapping_mul(rise.signum());
    let rise = rise.abs();
    let moved = double
        .wrapping_add(rise)
        .div_euclid(rise.wrapping_mul(2).max(1));
    from.wrapping_sub(moved).clamp(0, i64::from(u32::MAX)) as u32
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
        side.bit(&mut odds.up, wanted > predicted)
    };
    let value = if above {
        predicted.checked_add(far)
    } else {
        predicted.checked_sub(far)
    };
    let inside = value.filter(|value| (low..=high).contains(value));
    inside.ok_or(StreamError::Value)
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

    struct Random(u32);

    impl Random {
        fn below(&mut self, limit: u32) -> u32 {
            self.0 = self.0.wrapping_mul(747796405).wrapping_add(2891336453);
            let mixed = (self.0 >> 16 ^ self.0).wrapping_mul(0x7feb352d);
            (mixed ^ mixed >> 15) % limit
        }
    }

    fn sorted(mut points: Vec<PatchPoint>) -> Vec<PatchPoint> {
        let order = Order::of(&points);
        points.sort_by_key(|point| order.key(point));
        points
    }

    /// Points all over a box, or on a slope in it, or all in one place.
    fn points(random: &mut Random, count: usize) -> Vec<PatchPoint> {
        let kind = random.below(4);
        let extent = 1 << random.below(POSITION_BITS + 1);
        let from = [0; 3].map(|_| random.below((1 << POSITION_BITS) - extent + 1));
        let normals = 1 + random.below(225);
        let point = |random: &mut Random| {
            let [u, v, w] = [0; 3].map(|_| random.below(extent));
            let by = match kind {
                0 => [u, v, w],
                1 => [u, v, (u + v) / 2],
                2 => [u, extent / 2, v],
                _ => [extent - 1; 3],
            };
            let normal = random.below(normals) as u8;
            PatchPoint {
                position: [from[0] + by[0], from[1] + by[1], from[2] + by[2]],
                normal: normal_code([normal % 15, normal / 15]),
                level: random.below(LEVELS) as u8,
                reserved: [0; 2],
            }
        };
        (0..count).map(|_| point(random)).collect()
    }

    #[test]
    fn patches_are_read_as_they_were_written() {
        let mut random = Random(3);
        let mut bytes = vec![0; MAX_PATCH_BYTES];
        for case in 0..400 {
            let count = [1, 2, 17, 300, PATCH_POINTS][case % 5];
            let points = sorted(points(&mut random, count));
            let length = encode_patch(&points, &mut bytes).unwrap();
            let mut read = vec![PatchPoint::default(); PATCH_POINTS];
            assert_eq!(
                decode_patch(&bytes[..length], &mut read),
                Ok(count),
                "case {case}"
            );
            assert_eq!(read[..count], points, "case {case}");
        }
    }

    #[test]
    fn what_is_no_patch_is_refused_by_writer_and_reader() {
        let mut random = Random(4);
        let mut bytes = vec![0; MAX_PATCH_BYTES];
        let mut good = sorted(points(&mut random, 300));
        let length = encode_patch(&good, &mut bytes).unwrap();
        let bytes = &bytes[..length];
        let mut read = vec![PatchPoint::default(); PATCH_POINTS];
        // Damage may leave another patch: checksum and hash are for that.
        let cut = (0..length).filter(|&end| decode_patch(&bytes[..end], &mut read).is_ok());
        assert!(cut.count() < 4);
        assert!(decode_patch(bytes, &mut read[..299]).is_err());
        let mut wrong = 0;
        for at in 0..length * 8 {
            let mut bytes = bytes.to_vec();
            bytes[at / 8] ^= 1 << (at % 8);
            wrong += usize::from(decode_patch(&bytes, &mut read) != Ok(300));
        }
        assert!(wrong * 2 > length * 8, "{wrong} of {} noticed", length * 8);
        let refused = |points: &[PatchPoint]| {
            assert_eq!(
                encode_patch(points, &mut vec![0; MAX_PATCH_BYTES]),
                Err(Full)
            );
        };
        refused(&[]);
        refused(&vec![good[0]; PATCH_POINTS + 1]);
        good.reverse();
        refused(&good);
        for spoil in [
            |point: &mut PatchPoint| point.level = LEVELS as u8,
            |point: &mut PatchPoint| point.normal = 0xf7,
            |point: &mut PatchPoint| point.position[1] = 1 << POSITION_BITS,
        ] {
            let mut point = good[0];
            spoil(&mut point);
            refused(&[point]);
        }
        assert_eq!(encode_patch(&good[..1], &mut []), Err(Full));
    }

    #[test]
    fn patches_are_the_same_on_every_machine() {
        let mut random = Random(6);
        let mut bytes = vec![0; MAX_PATCH_BYTES];
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for case in 0..60 {
            let points = sorted(points(&mut random, [1, 50, 700][case % 3]));
            let length = encode_patch(&points, &mut bytes).unwrap();
            for byte in &bytes[..length] {
                hash = (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
            }
        }
        assert_eq!(hash, 16272685179639305169);
    }
}
