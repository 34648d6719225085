//! Cells and buckets: the paper's `CellData` and `HashBucket` (section 3.2, Figure 3).

use crate::point::Point;
use bytemuck::{Pod, Zeroable};

/// Points a cell holds; with its key it fills 32 bytes, two cells to a cache line.
pub const CELL_POINTS: usize = 7;

/// Entries of a bucket.
pub const BUCKET_ENTRIES: usize = 8;

/// A grid cell's points: `CellData`. A reader stops at the first [`Point::EMPTY`], and skips places
/// without a point before it.
#[repr(C, align(16))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Cell {
    /// The cell's dense index in its instance's grid: x + y·Dx + z·Dx·Dy.
    pub key: u32,
    /// Points, and places without.
    pub points: [Point; CELL_POINTS],
}

/// One bucket of an instance's hash table: `HashBucket`. Names cells by their index; 0 names
/// none (cell 0 is never used). Empty entries come last.
#[repr(C, align(16))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Bucket {
    /// Cell indices; 0 is empty.
    pub entries: [u32; BUCKET_ENTRIES],
}

impl Cell {
    /// The points the cell holds.
    pub fn points(&self) -> impl Iterator<Item = Point> + '_ {
        self.points
            .iter()
            .copied()
            .take_while(|&point| point != Point::EMPTY)
            .filter(|point| point.is_allocated())
    }

    /// How many points the cell holds.
    pub fn len(&self) -> usize {
        self.points().count()
    }

    /// The cell holds no point.
    pub fn is_empty(&self) -> bool {
        self.points().next().is_none()
    }
}

impl Bucket {
    /// The cells it names.
    pub fn cells(&self) -> impl Iterator<Item = u32> + '_ {
        self.entries.iter().copied().take_while(|&entry| entry != 0)
    }
}
