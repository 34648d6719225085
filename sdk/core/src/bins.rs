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

/// Points that [`insert`] takes at a time.
pub const GROUP: usize = 64;

/// A cell that points of a group fall into.
#[derive(Clone, Copy, Default)]
struct Target {
    cell: [u32; 3],
    key: u32,
    home: u32,
    /// The cell's index; 0 if there is none yet.
    index: u32,
}

/// Stores those points of a group whose bit is set in `which`, in order, each in its cell; a new
/// one if need be, the free one with the lowest index. A point's place stays [`NOWHERE`] if it is
/// outside the grid, its cell or its bucket is full, or no cell is free.
///
/// What is longer than the shortest, or than [`GROUP`], is left alone.
pub fn insert<M: Memory>(
    mirror: &mut Mirror<M>,
    free: &mut [u64],
    grid: &Instance,
    which: u64,
    points: &[PatchPoint],
    values: &[u8],
    places: &mut [Place],
) {
    let mut targets = [Target::default(); GROUP];
    let mut packed = [(0u8, Point::EMPTY); GROUP];
    // Which target a cell was last, by the end of its key: points come back to cells again and
    // again. Where two cells share an end, one becomes a target twice, which costs time alone.
    let mut known = [0u8; GROUP];
    let mut begun = 0usize;
    let all = points.iter().zip(values).zip(&mut packed).enumerate();
    for (at, ((point, value), (target_of, packed))) in all {
        let Some(bin) = Bin::of(grid, point).filter(|_| which >> at & 1 != 0) else {
            continue;
        };
        let key = grid.key(bin.cell);
        let Some(known) = known.get_mut(key as usize & (GROUP - 1)) else {
            continue;
        };
        let has = targets.get(usize::from(*known)).map(|target| target.key);
        if has != Some(key) || begun == 0 {
            *known = begun as u8;
            if let Some(target) = targets.get_mut(begun) {
                (target.cell, target.key) = (bin.cell, key);
            }
            begun = begun.saturating_add(1);
        }
        *target_of = *known;
        *packed = Point::pack(bin.position, point.normal, *value);
    }
    let targets = targets.get_mut(..begun).unwrap_or_default();
    // Buckets and cells lie anywhere in a large memory. Loops that do nothing but read them, first
    // the ones and then the others, and whose steps do not wait for each other, have many of them
    // on their way at a time.
    let mut buckets = [Bucket::default(); GROUP];
    for (target, bucket) in targets.iter_mut().zip(&mut buckets) {
        target.home = grid.bucket(target.cell);
        let stored = mirror.buckets().get(target.home as usize);
        *bucket = stored.copied().unwrap_or_default();
    }
    for (target, bucket) in targets.iter_mut().zip(&buckets) {
        target.index = find(mirror, bucket, target.key);
    }
    let mut allocated = 0usize;
    for ((target_of, point), place) in packed.into_iter().zip(places) {
        let Some(target) = targets.get_mut(usize::from(target_of)) else {
            continue;
        };
        if point == Point::EMPTY {
            continue;
        }
        if target.index == 0 {
            let index = find_or_allocate(mirror, free, target.home, target.key, &mut allocated);
            target.index = index.unwrap_or(0);
        }
        let cell = mirror.cells().get(target.index as usize);
        let points = cell.map(|cell| cell.points).unwrap_or_default();
        let taken = points.iter().zip(0..).fold(0u32, |taken, (point, slot)| {
            taken | u32::from(point.is_allocated()) << slot
        });
        let vacant = taken.trailing_ones();
        if target.index != 0 && vacant < CELL_POINTS as u32 {
            *place = target.index << 3 | vacant;
            mirror.set_point(*place, point);
        }
    }
}

/// The cell of a bucket that has a key, the first of several; 0 for none.
fn find<M: Memory>(mirror: &Mirror<M>, bucket: &Bucket, key: u32) -> u32 {
    let cells = mirror.cells();
    // All are looked at: where to stop would be hard to foretell.
    bucket.entries.iter().rev().fold(0, |found, &index| {
        let has = cells.get(index as usize).map(|cell| cell.key) == Some(key);
        if has && index != 0 { index } else { found }
    })
}

/// A cell that came about since it was looked for, or else a new one: the first free one from
/// `allocated` on, which is the last that was taken.
fn find_or_allocate<M: Memory>(
    mirror: &mut Mirror<M>,
    free: &mut [u64],
    home: u32,
    key: u32,
    allocated: &mut usize,
) -> Option<u32> {
    let bucket = mirror.buckets().get(home as usize)?;
    let found = find(mirror, bucket, key);
    if found != 0 {
        return Some(found);
    }
    let entry = bucket.entries.iter().position(|&entry| entry == 0)?;
    let cells = mirror.capacity().cells as usize;
    let index = dirty::first(free, cells, *allocated)?;
    *allocated = index;
    mirror.begin_cell(home, entry, index as u32, key);
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

#[cfg(test)]
#[allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::arithmetic_side_effects
)]
mod tests {
    extern crate std;
    use super::*;
    use crate::mirror::{Borrowed, Capacity, PartsMut};
    use std::collections::HashMap;
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn cells_hold_what_was_put_in_and_not_taken_out() {
        let capacity = Capacity {
            instances: 1,
            buckets: 9,
            cells: 40,
            ..Capacity::default()
        };
        let (mut instances, mut buckets) = ([Instance::default()], [Bucket::default(); 9]);
        let mut cells = [Cell::default(); 40];
        let mut dirty = vec![0; capacity.dirty_words()];
        let mut mirror = Mirror::new(Borrowed(PartsMut {
            instances: &mut instances,
            buckets: &mut buckets,
            cells: &mut cells,
            dirty: &mut dirty,
        }));
        let mut free = vec![0; dirty::words(40)];
        free_all(&mut free, 40);
        let grid = Instance {
            radius: 1.0,
            cells_per_unit: [1.0; 3],
            normal_scale: [1.0; 3],
            dims: [5, 4, 3],
            bucket_count: 9,
            ..Instance::default()
        };
        mirror.set_instance(0, grid).unwrap();
        let mut seed = 1u32;
        let mut random = |below: u32| {
            seed = seed.wrapping_mul(747796405).wrapping_add(2891336453);
            (seed >> 12) % below
        };
        let mut held: Vec<(Bin, Place, Point)> = Vec::new();
        let (mut full_cells, mut no_room) = (0, 0);
        for _ in 0..20_000 {
            if random(held.len() as u32 / 4 + 40) < 60 {
                let cell = [random(5), random(4), random(3)];
                let position = [random(32), random(32), random(32)];
                let bin = Bin { cell, position };
                let point = Point::pack(position, random(225) as u8, random(256) as u8);
                let at = [0, 1, 2].map(|axis| cell[axis] * 32 + position[axis]);
                let patch_point = PatchPoint {
                    position: at,
                    normal: point.normal(),
                    ..PatchPoint::default()
                };
                assert_eq!(Bin::of(&grid, &patch_point), Some(bin));
                let mut place = [NOWHERE];
                insert(
                    &mut mirror,
                    &mut free,
                    &grid,
                    1,
                    &[patch_point],
                    &[point.occlusion()],
                    &mut place,
                );
                let [place] = place;
                let here = held.iter().filter(|(other, ..)| other.cell == cell).count();
                if place == NOWHERE {
                    full_cells += usize::from(here == CELL_POINTS);
                    no_room += usize::from(here == 0);
                    assert!(here == CELL_POINTS || here == 0);
                } else {
                    held.push((bin, place, point));
                }
            } else {
                let (bin, place, _) = held.swap_remove(random(held.len() as u32) as usize);
                remove(&mut mirror, &mut free, &grid, bin, place);
            }
            let mut by_cell: HashMap<[u32; 3], Vec<u32>> = HashMap::new();
            for (bin, place, point) in &held {
                assert_eq!(mirror.point(*place), Some(*point));
                by_cell.entry(bin.cell).or_default().push(point.0);
            }
            let lookup = mirror.lookup();
            let mut found = 0;
            for (cell, points) in &mut by_cell {
                let cell = lookup.find(&grid, *cell).unwrap();
                let mut has: Vec<u32> = cell.points().map(|point| point.0).collect();
                has.sort_unstable();
                points.sort_unstable();
                assert_eq!(has, *points);
                found += 1;
            }
            let used = mirror
                .cells()
                .iter()
                .filter(|cell| **cell != Cell::default());
            assert_eq!(used.count(), found, "a cell without points is all zero");
        }
        assert!(full_cells > 0 && no_room > 0);
        assert_eq!(mirror.hash(), mirror.recompute_hash());
    }

    #[test]
    fn a_level_up_has_cells_that_are_longer_by_the_root_of_two() {
        let grid = |level| Instance {
            dims: [1 << 20; 3],
            level,
            ..Instance::default()
        };
        let point = |position| PatchPoint {
            position: [position; 3],
            ..PatchPoint::default()
        };
        for position in [0, 1, 31, 32, 1000, (1 << 25) - 1] {
            let bins = [0, 1, 2, 3].map(|level| Bin::of(&grid(level), &point(position)).unwrap());
            assert_eq!(bins[0].cell[0], position >> 5);
            assert_eq!(bins[0].position[0], position & 31);
            for (level, bin) in (0..).zip(bins) {
                let steps = f64::from(bin.cell[2] * 32 + bin.position[2]) + 0.5;
                let factor = f64::from(SCALES[level as usize]) / 65536.0;
                assert!((factor * 2f64.powf(0.5 * f64::from(level)) - 1.0).abs() < 3e-5);
                let expected = (f64::from(position) + 0.5) * factor;
                let off = (steps - expected).abs();
                assert!(off <= 0.5, "{position} {level}: {off}");
            }
        }
        let small = Instance {
            dims: [2, 3, 4],
            ..Instance::default()
        };
        assert_eq!(Bin::of(&small, &point(64)), None);
        assert!(Bin::of(&small, &point(63)).is_some());
    }
}
