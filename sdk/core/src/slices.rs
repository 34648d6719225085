//! Slices of profile `residual`: runs of cells whose points' occlusion is coded together.
//!
//! A slice's points never move, so they are numbered once: cell by cell, place by place. What the
//! codec keeps of each (its last change, its neighbours) lies beside the mirror, in that order.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::cell::Cell;
use crate::mirror::{Memory, Mirror};
use crate::residual::{
    Neighbours, Quantiser, SLICE_POINTS, SliceState, decode_slice, find_neighbours,
};
use crate::stream::{Reader, StreamError, Writer};
use bytemuck::{Pod, Zeroable};

/// How a slice is coded the first time: exactly. What stands still stays exact from then on, and
/// beside the cells that come along the bits are few.
pub const FIRST: Quantiser = Quantiser {
    step: 1,
    dead_zone: 0,
};

/// A slice that has been opened.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Slice {
    /// First cell.
    pub cell_first: u32,
    /// Cells; 0 until the slice is opened.
    pub cell_count: u32,
    /// Its first point's place in the points' side data.
    pub point_first: u32,
    /// Points, at most [`SLICE_POINTS`].
    pub point_count: u32,
}

/// What the codec keeps beside a mirror: the caller's memory, fixed in size.
#[derive(Debug)]
pub struct Slices<'a> {
    /// All slices, opened or not.
    pub slices: &'a mut [Slice],
    /// Each point's neighbours.
    pub neighbours: &'a mut [Neighbours],
    /// Each point's last change; as many as neighbours.
    pub last: &'a mut [i8],
    /// Points given out so far.
    pub points_used: &'a mut u32,
}

/// The occlusion of a slice's points.
#[derive(Clone, Debug)]
pub struct Values {
    values: [u8; SLICE_POINTS],
    count: usize,
}

impl Values {
    /// Reads the points of a run of cells.
    ///
    /// # Errors
    /// More than [`SLICE_POINTS`].
    pub fn of(cells: &[Cell]) -> Result<Values, StreamError> {
        let mut out = Values {
            values: [255; SLICE_POINTS],
            count: 0,
        };
        for point in points(cells) {
            let place = out.values.get_mut(out.count).ok_or(StreamError::Value)?;
            *place = point.occlusion();
            out.count = out.count.saturating_add(1);
        }
        Ok(out)
    }

    /// One a point.
    pub fn get(&self) -> &[u8] {
        self.values.get(..self.count).unwrap_or_default()
    }

    /// One a point.
    pub fn get_mut(&mut self) -> &mut [u8] {
        self.values.get_mut(..self.count).unwrap_or_default()
    }
}

fn points(cells: &[Cell]) -> impl Iterator<Item = crate::Point> + '_ {
    cells
        .iter()
        .flat_map(|cell| cell.points.into_iter().take_while(|p| p.is_allocated()))
}

impl Slices<'_> {
    /// Opens a slice: its points are those that the mirror's cells hold now.
    ///
    /// A cell without points is refused, and so the work that a slice can ask for is bounded by
    /// its points.
    ///
    /// # Errors
    /// It is open already, or has no cell; a cell has no point; its instance has none; there are
    /// more points than a slice or the side data has room for.
    pub fn open<M: Memory>(
        &mut self,
        mirror: &Mirror<M>,
        index: u32,
        instance: u32,
        cell_first: u32,
        cell_count: u32,
    ) -> Result<(), StreamError> {
        let cells = run(mirror, cell_first, cell_count)?;
        let grid = mirror
            .instances()
            .get(instance as usize)
            .filter(|grid| grid.bucket_count > 0)
            .ok_or(StreamError::Value)?;
        let slice = self
            .slices
            .get_mut(index as usize)
            .ok_or(StreamError::Value)?;
        if slice.cell_count != 0 || cell_count == 0 {
            return Err(StreamError::Order);
        }
        let mut positions = [[0u32; 3]; SLICE_POINTS];
        let mut normals = [0u8; SLICE_POINTS];
        let mut count = 0usize;
        let row = grid.dims[0];
        // A grid of 2³² cells and more wraps, as its keys do.
        let layer = row.wrapping_mul(grid.dims[1]).max(1);
        for cell in cells {
            if cell.is_empty() {
                return Err(StreamError::Value);
            }
            let (z, rest) = (div(cell.key, layer), rem(cell.key, layer));
            let corner = [rem(rest, row), div(rest, row), z];
            for point in points(core::slice::from_ref(cell)) {
                let (Some(position), Some(normal)) =
                    (positions.get_mut(count), normals.get_mut(count))
                else {
                    return Err(StreamError::Value);
                };
                let step = point.position();
                for (axis, place) in position.iter_mut().enumerate() {
                    let (corner, step) = (corner.get(axis), step.get(axis));
                    let corner = corner.copied().unwrap_or(0).wrapping_mul(32);
                    *place = corner.wrapping_add(step.copied().unwrap_or(0));
                }
                *normal = point.normal();
                count = count.saturating_add(1);
            }
        }
        let first = *self.points_used as usize;
        let end = first.saturating_add(count);
        let (Some(neighbours), Some(last), Some(positions), Some(normals)) = (
            self.neighbours.get_mut(first..end),
            self.last.get_mut(first..end),
            positions.get(..count),
            normals.get(..count),
        ) else {
            return Err(StreamError::Value);
        };
        find_neighbours(positions, normals, neighbours);
        last.fill(0);
        *slice = Slice {
            cell_first,
            cell_count,
            point_first: first as u32,
            point_count: count as u32,
        };
        *self.points_used = end as u32;
        Ok(())
    }

    /// Forgets all slices, for a snapshot.
    pub fn reset(&mut self) {
        self.slices.fill(Slice::default());
        *self.points_used = 0;
    }

    /// An opened slice with its neighbours and last changes.
    pub fn side(&mut self, index: u32) -> Option<(Slice, &[Neighbours], &mut [i8])> {
        let slice = *self.slices.get(index as usize)?;
        let first = slice.point_first as usize;
        let points = first..first.saturating_add(slice.point_count as usize);
        (slice.cell_count != 0).then_some(())?;
        Some((
            slice,
            self.neighbours.get(points.clone())?,
            self.last.get_mut(points)?,
        ))
    }
}

fn div(a: u32, b: u32) -> u32 {
    a.checked_div(b).unwrap_or(0)
}

fn rem(a: u32, b: u32) -> u32 {
    a.checked_rem(b).unwrap_or(0)
}

/// A run of a mirror's cells.
fn run<M: Memory>(mirror: &Mirror<M>, first: u32, count: u32) -> Result<&[Cell], StreamError> {
    let end = first.checked_add(count).ok_or(StreamError::Value)?;
    mirror
        .cells()
        .get(first as usize..end as usize)
        .ok_or(StreamError::Value)
}

/// Gives a slice's points new occlusion. As many values as the slice has points.
///
/// # Errors
/// The slice is not in the mirror.
pub fn store<M: Memory>(
    mirror: &mut Mirror<M>,
    slice: Slice,
    values: &[u8],
) -> Result<(), StreamError> {
    let mut values = values.iter();
    for index in slice.cell_first..slice.cell_first.saturating_add(slice.cell_count) {
        let mut cell = *mirror
            .cells()
            .get(index as usize)
            .ok_or(StreamError::Value)?;
        let mut changed = 0;
        for point in cell
            .points
            .iter_mut()
            .take_while(|point| point.is_allocated())
        {
            let new = point.with_occlusion(*values.next().ok_or(StreamError::Value)?);
            changed |= new.0 ^ point.0;
            *point = new;
        }
        if changed != 0 {
            mirror.set_cell(index, cell)?;
        }
    }
    Ok(())
}

/// Applies the content of a slices packet: items until its end.
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
        // The lowest bit says that the slice is new.
        let head = r.varint()?;
        let index = next.checked_add(head >> 1).ok_or(StreamError::Value)?;
        next = index.checked_add(1).ok_or(StreamError::Value)?;
        let first = head & 1 != 0;
        if first {
            let (instance, cell_first, cell_count) = (r.varint()?, r.varint()?, r.varint()?);
            slices.open(mirror, index, instance, cell_first, cell_count)?;
        }
        let length = r.varint()? as usize;
        let bytes = r.take(length)?;
        let (slice, neighbours, last) = slices.side(index).ok_or(StreamError::Order)?;
        let mut values = Values::of(run(mirror, slice.cell_first, slice.cell_count)?)?;
        if values.get().len() != slice.point_count as usize {
            return Err(StreamError::Value);
        }
        let mut state = SliceState {
            value: values.get_mut(),
            last,
        };
        let step = if first { FIRST.step } else { step };
        decode_slice(neighbours, step, &mut state, first, bytes)?;
        store(mirror, slice, values.get())?;
        count = count.saturating_add(1);
    }
    Ok(count)
}

/// One item of a slices packet.
#[derive(Clone, Copy, Debug)]
pub struct Item<'a> {
    /// Slice index.
    pub index: u32,
    /// For a new slice: instance, first cell, cells.
    pub opens: Option<[u32; 3]>,
    /// What [`crate::residual::encode_slice`] wrote.
    pub bytes: &'a [u8],
}

impl Item<'_> {
    /// Writes the item; `next` is one more than the item before's index, or 0.
    pub fn write(&self, next: u32, w: &mut Writer<'_>) -> Result<(), StreamError> {
        let gap = self.index.checked_sub(next).ok_or(StreamError::Value)?;
        let head = gap.checked_mul(2).ok_or(StreamError::Value)?;
        w.varint(head | u32::from(self.opens.is_some()))?;
        if let Some(opens) = self.opens {
            opens.into_iter().try_for_each(|value| w.varint(value))?;
        }
        w.varint(self.bytes.len() as u32)?;
        w.bytes(self.bytes)
    }
}
