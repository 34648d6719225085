//! Slices of profile `residual`: patches on instances, whose points' occlusion is coded together.
//!
//! A slice's points never move, so they are numbered once, in the order of their patch. What the
//! codec keeps of each lies beside the mirror, in that order. Blocks of points where all is open
//! need not be in the mirror's cells at all.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::bins::{self, Bin, GROUP, NOWHERE, Place};
use crate::grid::Instance;
use crate::mirror::{Memory, Mirror};
use crate::residual::{BLOCK, Neighbours, Quantiser, SliceState, decode_slice, find_neighbours};
use crate::stream::{Changes, Reader, StreamError, Writer, apply_changes};
use crate::topology::{PatchPoint, decode_patch};
use bytemuck::{Pod, Zeroable};

/// How a slice is coded the first time: exactly. What stands still stays exact from then on, and
/// beside the patches that come along the bits are few.
pub const FIRST: Quantiser = Quantiser {
    step: 1,
    dead_zone: 0,
};

/// In place of a point's last change: it is no open slice's.
pub const NOBODYS: i8 = i8::MIN;

/// Where a patch's bytes are.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Patch {
    /// Its first byte.
    pub first: u32,
    /// Bytes; 0 until the patch has come.
    pub bytes: u32,
}

impl Patch {
    fn range(&self) -> core::ops::Range<usize> {
        let first = self.first as usize;
        first..first.saturating_add(self.bytes as usize)
    }
}

/// A patch on an instance.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Slice {
    /// Instance index.
    pub instance: u32,
    /// Patch index.
    pub patch: u32,
    /// Its first point's place in the points' side data.
    pub point_first: u32,
    /// Points, at most [`crate::residual::SLICE_POINTS`]; 0 while the slice is closed.
    pub point_count: u32,
    /// Blocks of [`BLOCK`] points that are in cells, the first in the lowest bit.
    pub shown: u64,
}

impl Slice {
    fn range(&self) -> core::ops::Range<usize> {
        let first = self.point_first as usize;
        first..first.saturating_add(self.point_count as usize)
    }

    /// All its blocks.
    pub fn all_blocks(&self) -> u64 {
        let blocks = self.point_count.div_ceil(BLOCK as u32);
        1u64.checked_shl(blocks).unwrap_or(0).wrapping_sub(1)
    }
}

/// What is kept beside a mirror: the caller's memory, fixed in size.
#[derive(Debug)]
pub struct Slices<'a> {
    /// All slices, open or not.
    pub slices: &'a mut [Slice],
    /// All patches, come or not.
    pub patches: &'a mut [Patch],
    /// Patches' bytes.
    pub topology: &'a mut [u8],
    /// Bytes of them that are in use.
    pub topology_used: &'a mut u32,
    /// Each point's occlusion; 255 is open.
    pub values: &'a mut [u8],
    /// Each point's last change, or [`NOBODYS`]; as many as values.
    pub last: &'a mut [i8],
    /// Each point's neighbours; as many as values.
    pub neighbours: &'a mut [Neighbours],
    /// Where each point is stored; as many as values.
    pub places: &'a mut [Place],
    /// The mirror's free cells, as a set of [`crate::dirty`].
    pub free: &'a mut [u64],
    /// Points of one patch: [`crate::topology::PATCH_POINTS`].
    pub scratch: &'a mut [PatchPoint],
    /// Which: its index, the level, and how many points that leaves; 0 points for none.
    pub scratch_of: &'a mut [u32; 3],
}

/// What an item does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// New occlusion.
    Update,
    /// New occlusion, and other blocks are in cells.
    Show(u64),
    /// The slice's first: instance, patch, first point; and its blocks in cells.
    Open([u32; 3], u64),
    /// The slice's points go. No data.
    Close,
}

/// One item of a slices packet.
#[derive(Clone, Copy, Debug)]
pub struct Item<'a> {
    /// Slice index.
    pub index: u32,
    /// What it does.
    pub operation: Operation,
    /// Points of the slice: how many blocks there are to show.
    pub points: u32,
    /// What [`crate::residual::encode_slice`] wrote.
    pub bytes: &'a [u8],
}

/// Bytes that an item needs beside its data.
pub const ITEM_HEADER_BYTES: usize = 5 * 5 + 8;

impl Item<'_> {
    /// Writes the item; `next` is one more than the item before's index, or 0.
    ///
    /// # Errors
    /// There is no room, or the index is not above the one before.
    pub fn write(&self, next: u32, w: &mut Writer<'_>) -> Result<(), StreamError> {
        let gap = self.index.checked_sub(next).ok_or(StreamError::Value)?;
        let head = gap.checked_mul(4).ok_or(StreamError::Value)?;
        let (operation, opens, shown) = match self.operation {
            Operation::Update => (0, None, None),
            Operation::Show(shown) => (1, None, Some(shown)),
            Operation::Open(opens, shown) => (2, Some(opens), Some(shown)),
            Operation::Close => return w.varint(head | 3),
        };
        w.varint(head | operation)?;
        if let Some(opens) = opens {
            opens.into_iter().try_for_each(|value| w.varint(value))?;
        }
        if let Some(shown) = shown {
            w.bytes(
                shown
                    .to_le_bytes()
                    .get(..shown_bytes(self.points))
                    .unwrap_or_default(),
            )?;
        }
        w.varint(self.bytes.len() as u32)?;
        w.bytes(self.bytes)
    }
}

/// Bytes of the set of blocks of so many points.
fn shown_bytes(points: u32) -> usize {
    points.div_ceil(BLOCK as u32).div_ceil(8).min(8) as usize
}

fn read_shown(r: &mut Reader<'_>, slice: &Slice) -> Result<u64, StreamError> {
    let mut bytes = [0; 8];
    let coded = r.take(shown_bytes(slice.point_count))?;
    for (to, from) in bytes.iter_mut().zip(coded) {
        *to = *from;
    }
    let shown = u64::from_le_bytes(bytes);
    let exist = shown & !slice.all_blocks() == 0;
    exist.then_some(shown).ok_or(StreamError::Value)
}

impl Slices<'_> {
    /// Takes in a patch.
    ///
    /// # Errors
    /// There is no such patch, another one has come in its place, or there is no room for it.
    pub fn add_patch(&mut self, index: u32, bytes: &[u8]) -> Result<(), StreamError> {
        let patch = self
            .patches
            .get_mut(index as usize)
            .ok_or(StreamError::Value)?;
        if patch.bytes != 0 {
            // From an earlier stream: patches of one hash are the same.
            let same = self.topology.get(patch.range()) == Some(bytes);
            return same.then_some(()).ok_or(StreamError::Order);
        }
        if bytes.is_empty() {
            return Err(StreamError::Length);
        }
        let first = *self.topology_used as usize;
        let end = first.saturating_add(bytes.len());
        let room = self
            .topology
            .get_mut(first..end)
            .ok_or(StreamError::Value)?;
        room.copy_from_slice(bytes);
        *patch = Patch {
            first: first as u32,
            bytes: bytes.len() as u32,
        };
        *self.topology_used = end as u32;
        Ok(())
    }

    /// Puts a patch's points of a level where [`Slices::open`] and [`Slices::settle`] look
    /// first, for a caller that has them: it spares decoding the patch.
    pub fn lend_points<'b>(
        &mut self,
        patch: u32,
        level: u32,
        points: impl Iterator<Item = &'b PatchPoint>,
    ) {
        let [lent_patch, lent_level, count] = *self.scratch_of;
        if count == 0 || [lent_patch, lent_level] != [patch, level] {
            let mut count = 0u32;
            for (to, from) in self.scratch.iter_mut().zip(points) {
                *to = *from;
                count = count.saturating_add(1);
            }
            *self.scratch_of = [patch, level, count];
        }
    }

    /// Reads a patch's points of an instance's level into the scratch, and says how many.
    fn read_points(&mut self, grid: &Instance, patch: u32) -> Result<usize, StreamError> {
        let index = patch;
        let [patch, level, count] = *self.scratch_of;
        if count > 0 && [patch, level] == [index, grid.level] {
            return Ok(count as usize);
        }
        let patch = self.patches.get(index as usize).ok_or(StreamError::Value)?;
        let bytes = self.topology.get(patch.range()).unwrap_or_default();
        if bytes.is_empty() {
            return Err(StreamError::Order);
        }
        *self.scratch_of = [0; 3];
        let count = decode_patch(bytes, self.scratch)?;
        let mut kept = 0usize;
        for at in 0..count {
            let point = self.scratch.get(at).copied().unwrap_or_default();
            if u32::from(point.level) >= grid.level {
                if let Some(to) = self.scratch.get_mut(kept) {
                    *to = point;
                }
                kept = kept.saturating_add(1);
            }
        }
        *self.scratch_of = [index, grid.level, kept as u32];
        Ok(kept)
    }

    /// Opens a slice: all its points are open and in no cell. `known`: its neighbours, if the
    /// caller has found them before.
    ///
    /// # Errors
    /// There is no such slice, or it is open already; its instance has no grid; its patch has not
    /// come, or has no points of the instance's level; or its points' side data are outside the
    /// memory, or another open slice's.
    pub fn open<M: Memory>(
        &mut self,
        mirror: &Mirror<M>,
        index: u32,
        [instance, patch, point_first]: [u32; 3],
        known: Option<&[Neighbours]>,
    ) -> Result<(), StreamError> {
        let grid = grid_of(mirror, instance)?;
        let slice = self.slices.get(index as usize).ok_or(StreamError::Value)?;
        if slice.point_count != 0 {
            return Err(StreamError::Order);
        }
        let count = self.read_points(&grid, patch)?;
        let opened = Slice {
            instance,
            patch,
            point_first,
            point_count: count as u32,
            shown: 0,
        };
        let range = opened.range();
        let nobodys = |last: &[i8]| last.iter().all(|last| *last == NOBODYS);
        let usable = count > 0 && self.last.get(range.clone()).is_some_and(nobodys);
        let points = self.scratch.get(..count).unwrap_or_default();
        let (true, Some(neighbours), Some(values), Some(last), Some(places), Some(slice)) = (
            usable,
            self.neighbours.get_mut(range.clone()),
            self.values.get_mut(range.clone()),
            self.last.get_mut(range.clone()),
            self.places.get_mut(range.clone()),
            self.slices.get_mut(index as usize),
        ) else {
            return Err(StreamError::Value);
        };
        match known {
            Some(known) => neighbours
                .iter_mut()
                .zip(known)
                .for_each(|(to, from)| *to = *from),
            None => find_neighbours(points, neighbours),
        }
        values.fill(255);
        last.fill(0);
        places.fill(NOWHERE);
        *slice = opened;
        Ok(())
    }

    /// An open slice.
    ///
    /// # Errors
    /// There is no such slice, or it is closed.
    pub fn get(&self, index: u32) -> Result<Slice, StreamError> {
        let slice = self.slices.get(index as usize).ok_or(StreamError::Value)?;
        (slice.point_count != 0)
            .then_some(*slice)
            .ok_or(StreamError::Order)
    }

    /// An open slice's neighbours and state.
    pub fn side(&mut self, slice: &Slice) -> Option<(&[Neighbours], SliceState<'_>)> {
        let range = slice.range();
        let state = SliceState {
            value: self.values.get_mut(range.clone())?,
            last: self.last.get_mut(range.clone())?,
        };
        Some((self.neighbours.get(range)?, state))
    }

    /// Brings the mirror's cells to what an item made of a slice, with the blocks of `shown` in
    /// cells.
    ///
    /// # Errors
    /// None of a slice that was opened.
    pub fn settle<M: Memory>(
        &mut self,
        mirror: &mut Mirror<M>,
        index: u32,
        shown: u64,
    ) -> Result<(), StreamError> {
        let range = self.get(index)?.range();
        if let (Some(places), Some(values), Some(last)) = (
            self.places.get(range.clone()),
            self.values.get(range.clone()),
            self.last.get(range),
        ) {
            mirror.set_occlusion(places, values, last);
        }
        self.show(mirror, index, shown)
    }

    /// Has the blocks of `shown` in cells, and no others of the slice.
    fn show<M: Memory>(
        &mut self,
        mirror: &mut Mirror<M>,
        index: u32,
        shown: u64,
    ) -> Result<(), StreamError> {
        let slice = self.get(index)?;
        if shown == slice.shown {
            return Ok(());
        }
        let range = slice.range();
        let grid = grid_of(mirror, slice.instance)?;
        let count = self.read_points(&grid, slice.patch)?;
        let (Some(points), Some(values), Some(places)) = (
            self.scratch.get(..count),
            self.values.get(range.clone()),
            self.places.get_mut(range),
        ) else {
            return Err(StreamError::Value);
        };
        let is = |set: u64, at: usize| set >> (at.wrapping_div(BLOCK) & 63) & 1 != 0;
        for (at, (point, place)) in points.iter().zip(&mut *places).enumerate() {
            if is(slice.shown & !shown, at) && *place != NOWHERE {
                let bin = Bin::of(&grid, point).ok_or(StreamError::Value)?;
                bins::remove(mirror, self.free, &grid, bin, *place);
                *place = NOWHERE;
            }
        }
        let mut entering = shown & !slice.shown;
        let groups = points.chunks(GROUP).zip(values.chunks(GROUP));
        for ((points, values), places) in groups.zip(places.chunks_mut(GROUP)) {
            let which = points_of(entering);
            bins::insert(mirror, self.free, &grid, which, points, values, places);
            entering >>= GROUP.wrapping_div(BLOCK);
        }
        if let Some(slice) = self.slices.get_mut(index as usize) {
            slice.shown = shown;
        }
        Ok(())
    }

    /// Closes a slice: its points go.
    ///
    /// # Errors
    /// There is no such slice, or it is closed already.
    pub fn close<M: Memory>(
        &mut self,
        mirror: &mut Mirror<M>,
        index: u32,
    ) -> Result<(), StreamError> {
        self.show(mirror, index, 0)?;
        let closed = Slice::default();
        if let Some(slice) = self.slices.get_mut(index as usize) {
            let range = core::mem::replace(slice, closed).range();
            self.last.get_mut(range).unwrap_or_default().fill(NOBODYS);
        }
        Ok(())
    }

    /// Forgets all patches; no slice may be open.
    pub fn forget_patches(&mut self) {
        self.patches.fill(Patch::default());
        *self.topology_used = 0;
        *self.scratch_of = [0; 3];
    }

    /// Closes all slices, for a snapshot; the mirror is reset beside it. Patches stay.
    pub fn reset(&mut self, cells: u32) {
        self.slices.fill(Slice::default());
        self.last.fill(NOBODYS);
        bins::free_all(self.free, cells);
    }

    /// Whether an open slice is of this instance, whose grid then must not change.
    pub fn uses(&self, instance: u32) -> bool {
        let of = |slice: &Slice| slice.point_count != 0 && slice.instance == instance;
        self.slices.iter().any(of)
    }
}

/// The points of a group's blocks, the first in the lowest bit.
fn points_of(blocks: u64) -> u64 {
    const FIRST_BLOCK: u64 = (1 << BLOCK) - 1;
    let blocks = (0..GROUP.wrapping_div(BLOCK)).map(|block| (block, blocks >> block & 1));
    blocks.fold(0, |points, (block, shown)| {
        points | shown.wrapping_mul(FIRST_BLOCK << block.wrapping_mul(BLOCK))
    })
}

fn grid_of<M: Memory>(mirror: &Mirror<M>, instance: u32) -> Result<Instance, StreamError> {
    let grid = mirror.instances().get(instance as usize);
    let grid = grid.filter(|grid| grid.bucket_count > 0);
    grid.copied().ok_or(StreamError::Value)
}

/// Applies the decompressed content of a frame packet of profile `residual`: instances alone,
/// none of which may have open slices.
///
/// # Errors
/// As [`apply_changes`], and for anything else.
pub fn apply_instances<M: Memory>(
    raw: &[u8],
    mirror: &mut Mirror<M>,
    slices: &Slices<'_>,
) -> Result<Changes, StreamError> {
    let mut r = Reader(raw);
    let [count, buckets, cells] = [r.u32()?, r.u32()?, r.u32()?];
    if [buckets, cells] != [0; 2] {
        return Err(StreamError::Value);
    }
    let gaps = r.take((count as usize).saturating_mul(4))?;
    let mut next = 0u32;
    for gap in gaps.as_chunks::<4>().0 {
        let index = next
            .checked_add(u32::from_le_bytes(*gap))
            .ok_or(StreamError::Value)?;
        next = index.checked_add(1).ok_or(StreamError::Value)?;
        if slices.uses(index) {
            return Err(StreamError::Order);
        }
    }
    apply_changes(raw, mirror)
}

/// Applies the body of a patches packet: patches until its end. Returns how many.
///
/// # Errors
/// The content is not what a server writes.
pub fn apply_patches(content: &[u8], slices: &mut Slices<'_>) -> Result<u32, StreamError> {
    let mut r = Reader(content);
    let (mut next, mut count) = (0u32, 0u32);
    while !r.0.is_empty() {
        let index = next.checked_add(r.varint()?).ok_or(StreamError::Value)?;
        next = index.checked_add(1).ok_or(StreamError::Value)?;
        let length = r.varint()? as usize;
        slices.add_patch(index, r.take(length)?)?;
        count = count.saturating_add(1);
    }
    Ok(count)
}

/// Applies the content of a slices packet: items until its end. Returns how many.
///
/// # Errors
/// The content is not what a server writes. The mirror and the slices must then be reset by a
/// snapshot.
pub fn apply_slices<M: Memory>(
    content: &[u8],
    step: u8,
    mirror: &mut Mirror<M>,
    slices: &mut Slices<'_>,
) -> Result<u32, StreamError> {
    let mut r = Reader(content);
    let (mut next, mut count) = (0u32, 0u32);
    while !r.0.is_empty() {
        let head = r.varint()?;
        let index = next.checked_add(head >> 2).ok_or(StreamError::Value)?;
        next = index.checked_add(1).ok_or(StreamError::Value)?;
        count = count.saturating_add(1);
        let operation = head & 3;
        match operation {
            2 => {
                let opens = [r.varint()?, r.varint()?, r.varint()?];
                slices.open(mirror, index, opens, None)?;
            }
            3 => {
                slices.close(mirror, index)?;
                continue;
            }
            _ => {}
        }
        let slice = slices.get(index)?;
        let shown = match operation {
            0 => slice.shown,
            _ => read_shown(&mut r, &slice)?,
        };
        let length = r.varint()? as usize;
        let bytes = r.take(length)?;
        let first = operation == 2;
        let (neighbours, mut state) = slices.side(&slice).ok_or(StreamError::Value)?;
        let step = if first { FIRST.step } else { step };
        decode_slice(neighbours, step, &mut state, first, bytes)?;
        slices.settle(mirror, index, shown)?;
    }
    Ok(count)
}
