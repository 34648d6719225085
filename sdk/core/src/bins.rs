//! Binning: which cell a point of a mesh falls into on an instance, and taking it in and out.
//!
//! Server and client run this same integer code on the same points in the same order, and so get
//! the same buckets and cells without any of them being sent.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::cell::{Bucket, CELL_POINTS, Cell};
use crate::dirty;
use crate::grid::Instance;
use crate::mirror::{Memory, Mirror};
use crate::point::Point;
use crate::topology::PatchPoint;

/// Where a point is stored: its cell's index times 8, and its place in it. [`NOWHERE`]: in none.
pub type Place = u32;

/// The [`Place`] of a point that is in no cell.
pub const NOWHERE: Place = u32::MAX;

/// Most cells of a mirror of profile `residual`, so that every place is a number.
pub const MAX_CELLS: u32 = 1 << 29;

/// 32nds of a cell a topology step, in 1/65536, at each level: with half as many points cells are
/// √2 times as long, and so hold as many as before.
pub const SCALES: [u32; 4] = [65536, 46341, 32768, 23170];

/// A point's coordinates in an instance's grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bin {
    /// The grid cell.
    pub cell: [u32; 3],
    /// Position in it, steps of 1/32.
    pub position: [u32; 3],
}

impl Bin {
    /// The bin of a topology's point. `None` outside the grid.
    pub fn of(grid: &Instance, point: &PatchPoint) -> Option<Bin> {
        let scale = u64::from(SCALES.get(grid.level as usize).copied()?);
        // The middle of the step. Positions have 25 bits, so this fits by far.
        let scaled = point.position.map(|steps| {
            let middle = u64::from(steps).wrapping_mul(2).wrapping_add(1);
            (middle.wrapping_mul(scale) >> 17) as u32
        });
        let bin = Bin {
            cell: scaled.map(|steps| steps >> 5),
            position: scaled.map(|steps| steps & 31),
        };
        let inside = bin
            .cell
            .iter()
            .zip(&grid.dims)
            .all(|(cell, dim)| cell < dim);
        inside.then_some(bin)
    }
}

/// Fills the set of free cells: all but cell 0, which no bucket can name.
pub fn free_all(free: &mut [u64], cells: u32) {
    dirty::mark_all(free, cells as usize);
    dirty::unmark(free, cells as usize, 0);
}

/// Stores a point in its cell; a new one if need be, the free one with the lowest index. Returns
/// [`NOWHERE`] if the cell or its bucket is full, or no cell is free.
pub fn insert<M: Memory>(
    mirror: &mut Mirror<M>,
    free: &mut [u64],
    grid: &Instance,
    bin: Bin,
    point: Point,
) -> Place {
    let (key, home) = (grid.key(bin.cell), grid.bucket(bin.cell));
    let Some(bucket) = mirror.buckets().get(home as usize).copied() else {
        return NOWHERE;
    };
    let has_key = |index: &u32| {
        let cell = mirror.cells().get(*index as usize);
        cell.is_some_and(|cell| cell.key == key)
    };
    let index = match bucket.cells().find(has_key) {
        Some(index) => index,
        None => match allocate(mirror, free, home, bucket, key) {
            Some(index) => index,
            None => return NOWHERE,
        },
    };
    let cell = mirror.cells().get(index as usize).copied();
    let vacant = cell.and_then(|cell| cell.points.iter().position(|p| !p.is_allocated()));
    let Some(vacant) = vacant else {
        return NOWHERE;
    };
    let place = index << 3 | vacant as u32;
    mirror.set_point(place, point);
    place
}

fn allocate<M: Memory>(
    mirror: &mut Mirror<M>,
    free: &mut [u64],
    home: u32,
    mut bucket: Bucket,
    key: u32,
) -> Option<u32> {
    let cells = mirror.capacity().cells as usize;
    let entry = bucket.entries.iter_mut().find(|entry| **entry == 0)?;
    let index = dirty::next_run(free, cells, 0)?.start;
    *entry = index as u32;
    let cell = Cell {
        key,
        ..Cell::default()
    };
    // Neither can fail: the index is inside the buffer, and not 0.
    mirror.set_cell(index as u32, cell).ok()?;
    mirror.set_bucket(home, bucket).ok()?;
    dirty::unmark(free, cells, index);
    Some(index as u32)
}

/// Takes a point out of its place. A cell without points is free again.
pub fn remove<M: Memory>(
    mirror: &mut Mirror<M>,
    free: &mut [u64],
    grid: &Instance,
    bin: Bin,
    place: Place,
) {
    mirror.set_point(place, Point::LEFT);
    let index = place >> 3;
    // Trailing places that were left are empty again: a reader stops at the first.
    for slot in (0..CELL_POINTS as u32).rev() {
        let place = index << 3 | slot;
        match mirror.point(place) {
            Some(Point::EMPTY) => {}
            Some(point) if !point.is_allocated() => mirror.set_point(place, Point::EMPTY),
            _ => return,
        }
    }
    let home = grid.bucket(bin.cell);
    let Some(mut bucket) = mirror.buckets().get(home as usize).copied() else {
        return;
    };
    let named = bucket.entries.iter().position(|&cell| cell == index);
    let last = bucket.entries.iter().rposition(|&cell| cell != 0);
    if let (Some(at), Some(last)) = (named, last) {
        bucket.entries.swap(at, last);
        if let Some(entry) = bucket.entries.get_mut(last) {
            *entry = 0;
        }
        // Neither can fail: both were there before.
        let _ = mirror.set_bucket(home, bucket);
        let _ = mirror.set_cell(index, Cell::default());
        dirty::mark(free, mirror.capacity().cells as usize, index as usize);
    }
}
