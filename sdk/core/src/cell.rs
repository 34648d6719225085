//! Cells and buckets: the paper's `CellData` and `HashBucket` (section 3.2, Figure 3).

use crate::point::Point;
use bytemuck::{Pod, Zeroable};

/// Points a cell holds; with its key it fills 32 bytes, two cells to a cache line.
pub const CELL_POINTS: usize = 7;

/// Entries of a bucket.
pub const BUCKET_ENTRIES: usize = 8;

/// A grid cell's points: `CellData`. Empty places come last, so a reader stops at the first.
#[repr(C, align(16))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Cell {
    /// The cell's dense index in its instance's grid: x + y·Dx + z·Dx·Dy.
    pub key: u32,
    /// Points, empty ones last.
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
    /// How many points the cell holds.
    pub fn len(&self) -> usize {
        self.points
            .iter()
            .take_while(|point| point.is_allocated())
            .count()
    }

    /// The cell holds no point.
    pub fn is_empty(&self) -> bool {
        !self.points[0].is_allocated()
    }
}

impl Bucket {
    /// The cells it names.
    pub fn cells(&self) -> impl Iterator<Item = u32> + '_ {
        self.entries.iter().copied().take_while(|&entry| entry != 0)
    }
}
