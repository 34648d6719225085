//! The mirror: the client's instances, buckets and cells. The server holds an exact copy of what
//! each client has, changed by the same functions, so both always agree to the bit.

use crate::cell::{Bucket, Cell};
use crate::dirty;
use crate::grid::{GridError, Instance};
use crate::lookup::Lookup;
use crate::point::Point;
use core::ops::Range;

/// How many of each a mirror, and what profile `residual` keeps beside it, have room for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Capacity {
    /// Instances.
    pub instances: u32,
    /// Buckets, all instances together.
    pub buckets: u32,
    /// Cells, all instances together, and the unused cell 0.
    pub cells: u32,
    /// Profile `residual`: slices, open or not. The fields from here on are 0 in profile `cells`,
    /// and in [`Mirror::capacity`].
    pub slices: u32,
    /// Points of all slices that are open at a time.
    pub points: u32,
    /// Patches.
    pub patches: u32,
    /// Bytes of all patches together.
    pub topology_bytes: u32,
}

impl Capacity {
    /// Words of [`PartsMut::dirty`].
    pub const fn dirty_words(&self) -> usize {
        dirty::words(self.instances as usize)
            + dirty::words(self.buckets as usize)
            + dirty::words(self.cells as usize)
    }

    /// Whether all that `need` asks for fits.
    pub fn holds(&self, need: &Capacity) -> bool {
        self.instances >= need.instances
            && self.buckets >= need.buckets
            && self.cells >= need.cells
            && self.slices >= need.slices
            && self.points >= need.points
            && self.patches >= need.patches
            && self.topology_bytes >= need.topology_bytes
    }

    /// Bytes of the three buffers and the dirty sets.
    pub const fn bytes(&self) -> u64 {
        self.instances as u64 * size_of::<Instance>() as u64
            + self.buckets as u64 * size_of::<Bucket>() as u64
            + self.cells as u64 * size_of::<Cell>() as u64
            + self.dirty_words() as u64 * 8
    }
}

/// One of the mirror's buffers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Buffer {
    /// [`Instance`]s, 64 bytes each.
    Instances,
    /// [`Bucket`]s, 32 bytes each.
    Buckets,
    /// [`Cell`]s, 32 bytes each.
    Cells,
}

/// Memory lent to a mirror: the caller's, fixed in size.
pub trait Memory {
    /// The buffers, to read.
    fn parts(&self) -> Parts<'_>;
    /// The buffers, to write.
    fn parts_mut(&mut self) -> PartsMut<'_>;
}

/// A mirror's buffers, to read.
#[derive(Clone, Copy)]
pub struct Parts<'a> {
    /// Instance buffer.
    pub instances: &'a [Instance],
    /// Bucket buffer.
    pub buckets: &'a [Bucket],
    /// Cell buffer.
    pub cells: &'a [Cell],
    /// The three dirty sets, in this order; [`Capacity::dirty_words`] long.
    pub dirty: &'a [u64],
}

/// A mirror's buffers, to write.
pub struct PartsMut<'a> {
    /// Instance buffer.
    pub instances: &'a mut [Instance],
    /// Bucket buffer.
    pub buckets: &'a mut [Bucket],
    /// Cell buffer.
    pub cells: &'a mut [Cell],
    /// The three dirty sets, in this order; [`Capacity::dirty_words`] long.
    pub dirty: &'a mut [u64],
}

impl PartsMut<'_> {
    /// Nothing counts as uploaded.
    pub fn mark_all_dirty(&mut self) {
        let capacity = Capacity {
            instances: self.instances.len() as u32,
            buckets: self.buckets.len() as u32,
            cells: self.cells.len() as u32,
            ..Capacity::default()
        };
        let (instances, buckets, cells) = split_sets(self.dirty, capacity);
        dirty::mark_all(instances, capacity.instances as usize);
        dirty::mark_all(buckets, capacity.buckets as usize);
        dirty::mark_all(cells, capacity.cells as usize);
    }
}

/// Why a change was refused. The mirror is as before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MirrorError {
    /// An index is outside its buffer, or names cell 0.
    Index,
    /// A bucket names a cell that is not there.
    Entry,
    /// An instance cannot be used.
    Grid(GridError),
}

/// Instances, buckets and cells, what of them changed since the last [`Mirror::clear_dirty`], and
/// a hash of it all.
#[derive(Debug)]
pub struct Mirror<M> {
    memory: M,
    hash: u64,
}

/// Buffers borrowed from the caller.
pub struct Borrowed<'a>(pub PartsMut<'a>);

impl Memory for Borrowed<'_> {
    fn parts(&self) -> Parts<'_> {
        let PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        } = &self.0;
        Parts {
            instances,
            buckets,
            cells,
            dirty,
        }
    }

    fn parts_mut(&mut self) -> PartsMut<'_> {
        let PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        } = &mut self.0;
        PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        }
    }
}

impl<M: Memory> Mirror<M> {
    /// An empty mirror in `memory`, which is zeroed.
    ///
    /// # Panics
    /// If the dirty sets are not [`Capacity::dirty_words`] long.
    pub fn new(memory: M) -> Mirror<M> {
        let mut mirror = Mirror { memory, hash: 0 };
        let words = mirror.capacity().dirty_words();
        assert_eq!(
            mirror.memory.parts().dirty.len(),
            words,
            "length of the dirty sets"
        );
        mirror.memory.parts_mut().dirty.fill(0);
        mirror.reset();
        mirror
    }

    /// The memory back, with what is in it.
    pub fn into_memory(self) -> M {
        self.memory
    }

    /// How many of each it has room for.
    pub fn capacity(&self) -> Capacity {
        let parts = self.memory.parts();
        Capacity {
            instances: parts.instances.len() as u32,
            buckets: parts.buckets.len() as u32,
            cells: parts.cells.len() as u32,
            ..Capacity::default()
        }
    }

    /// Back to the state after [`Mirror::new`], with everything that changes by it dirty.
    pub fn reset(&mut self) {
        let capacity = self.capacity();
        let PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        } = self.memory.parts_mut();
        let (instance_set, bucket_set, cell_set) = split_sets(dirty, capacity);
        reset_all(instances, instance_set);
        reset_all(buckets, bucket_set);
        reset_all(cells, cell_set);
        self.hash = 0;
    }

    /// Sets one instance.
    pub fn set_instance(&mut self, index: u32, value: Instance) -> Result<(), MirrorError> {
        let capacity = self.capacity();
        if index >= capacity.instances {
            return Err(MirrorError::Index);
        }
        value
            .validate(capacity.buckets)
            .map_err(MirrorError::Grid)?;
        let parts = self.memory.parts_mut();
        let (set, _, _) = split_sets(parts.dirty, capacity);
        replace(parts.instances, set, index, value, 1, &mut self.hash);
        Ok(())
    }

    /// Sets one bucket. It is dirty from now on, changed or not: a cell that it names may have
    /// another key, and so it another tag (see [`crate::tags`]).
    pub fn set_bucket(&mut self, index: u32, value: Bucket) -> Result<(), MirrorError> {
        let capacity = self.capacity();
        if index >= capacity.buckets {
            return Err(MirrorError::Index);
        }
        if value
            .entries
            .iter()
            .any(|&entry| entry != 0 && entry >= capacity.cells)
        {
            return Err(MirrorError::Entry);
        }
        let parts = self.memory.parts_mut();
        let (_, set, _) = split_sets(parts.dirty, capacity);
        replace(parts.buckets, set, index, value, 2, &mut self.hash);
        dirty::mark(set, capacity.buckets as usize, index as usize);
        Ok(())
    }

    /// Sets one cell, but not cell 0: no bucket can name it. Any content is harmless to a reader.
    pub fn set_cell(&mut self, index: u32, value: Cell) -> Result<(), MirrorError> {
        let capacity = self.capacity();
        if index == 0 || index >= capacity.cells {
            return Err(MirrorError::Index);
        }
        let parts = self.memory.parts_mut();
        let (_, _, set) = split_sets(parts.dirty, capacity);
        replace(parts.cells, set, index, value, 3, &mut self.hash);
        Ok(())
    }

    /// Gives a cell, which is all zero, a key, and names it in an entry of a bucket. What is outside
    /// the buffers is ignored.
    pub(crate) fn begin_cell(&mut self, home: u32, entry: usize, index: u32, key: u32) {
        let capacity = self.capacity();
        let parts = self.memory.parts_mut();
        let bucket = parts.buckets.get_mut(home as usize);
        let named = bucket.and_then(|bucket| bucket.entries.get_mut(entry));
        let (Some(named), Some(cell)) = (named, parts.cells.get_mut(index as usize)) else {
            return;
        };
        let words = [
            (named, index, word_factor(2, home, entry as u32)),
            (&mut cell.key, key, word_factor(3, index, 0)),
        ];
        for (word, value, factor) in words {
            let change = u64::from(value).wrapping_sub(u64::from(*word));
            self.hash = self.hash.wrapping_add(factor.wrapping_mul(change));
            *word = value;
        }
        let (_, buckets, cells) = split_sets(parts.dirty, capacity);
        dirty::mark(buckets, capacity.buckets as usize, home as usize);
        dirty::mark(cells, capacity.cells as usize, index as usize);
    }

    /// Sets one place of a cell: `place` as in [`crate::bins`]. Outside the buffer it is ignored.
    pub(crate) fn set_point(&mut self, place: u32, point: Point) {
        let (index, at) = (place >> 3, place & 7);
        let capacity = self.capacity();
        let parts = self.memory.parts_mut();
        let cell = parts.cells.get_mut(index as usize);
        if let Some(old) = cell.and_then(|cell| cell.points.get_mut(at as usize)) {
            // Word 0 is the key.
            let factor = word_factor(3, index, at + 1);
            let change = u64::from(point.0).wrapping_sub(u64::from(old.0));
            self.hash = self.hash.wrapping_add(factor.wrapping_mul(change));
            *old = point;
            let (_, _, set) = split_sets(parts.dirty, capacity);
            dirty::mark(set, capacity.cells as usize, index as usize);
        }
    }

    /// Sets the occlusion of those of a slice's points that changed last, where they are stored.
    pub(crate) fn set_occlusion(&mut self, places: &[u32], values: &[u8], last: &[i8]) {
        let capacity = self.capacity();
        let parts = self.memory.parts_mut();
        let (_, _, set) = split_sets(parts.dirty, capacity);
        let runs = places
            .chunks(64)
            .zip(values.chunks(64))
            .zip(last.chunks(64));
        let mut dirty = dirty::Marks::new(set, capacity.cells as usize);
        let mut found = [(0u32, Point::EMPTY, Point::EMPTY); 64];
        for ((places, values), last) in runs {
            // Which points changed is hard to foretell: a branch for each would cost more.
            let mut changed = not_zero(last);
            let mut count = 0;
            // Cells are far apart in a large memory. A loop that does little but read them has many
            // on their way at a time.
            while changed != 0 {
                let which = changed.trailing_zeros() as usize;
                changed &= changed - 1;
                let (Some(&place), Some(&value)) = (places.get(which), values.get(which)) else {
                    break;
                };
                // NOWHERE's place in a cell is one that no cell has.
                let cell = parts.cells.get((place >> 3) as usize);
                if let Some(point) = cell.and_then(|cell| cell.points.get((place & 7) as usize)) {
                    found[count] = (place, *point, point.with_occlusion(value));
                    count += 1;
                }
            }
            for (place, had, has) in &found[..count] {
                let (index, at) = (place >> 3, place & 7);
                let change = u64::from(has.0).wrapping_sub(u64::from(had.0));
                // Word 0 is the key.
                let factor = word_factor(3, index, at + 1);
                self.hash = self.hash.wrapping_add(factor.wrapping_mul(change));
                parts.cells[index as usize].points[at as usize] = *has;
                dirty.mark(index as usize);
            }
        }
    }

    /// What a place of a cell holds.
    pub(crate) fn point(&self, place: u32) -> Option<Point> {
        let cell = self.cells().get((place >> 3) as usize)?;
        cell.points.get((place & 7) as usize).copied()
    }

    /// The instance buffer.
    pub fn instances(&self) -> &[Instance] {
        self.memory.parts().instances
    }

    /// The bucket buffer.
    pub fn buckets(&self) -> &[Bucket] {
        self.memory.parts().buckets
    }

    /// The cell buffer.
    pub fn cells(&self) -> &[Cell] {
        self.memory.parts().cells
    }

    /// A hash of all contents, kept up to date with every change: equal contents at equal indices
    /// have equal hashes, whatever the order in which they came and whatever the capacity.
    pub fn hash(&self) -> u64 {
        self.hash
    }

    /// The same hash, computed from the contents.
    pub fn recompute_hash(&self) -> u64 {
        fn sum<T: bytemuck::Pod>(values: &[T], kind: u64) -> u64 {
            let parts = values
                .iter()
                .enumerate()
                .map(|(i, v)| hash_of(v, i as u32, kind));
            parts.fold(0, u64::wrapping_add)
        }
        let parts = self.memory.parts();
        sum(parts.instances, 1)
            .wrapping_add(sum(parts.buckets, 2))
            .wrapping_add(sum(parts.cells, 3))
    }

    /// The next run of elements of `buffer` at or after `from` that changed since
    /// [`Mirror::clear_dirty`]: what has to be uploaded.
    pub fn next_dirty(&self, buffer: Buffer, from: u32) -> Option<Range<u32>> {
        let (set, len) = self.dirty_set(buffer);
        dirty::next_run(set, len, from as usize).map(|run| run.start as u32..run.end as u32)
    }

    /// All runs of changed elements of `buffer`.
    pub fn dirty_runs(&self, buffer: Buffer) -> impl Iterator<Item = Range<u32>> + '_ {
        let (set, len) = self.dirty_set(buffer);
        dirty::runs(set, len).map(|run| run.start as u32..run.end as u32)
    }

    /// Nothing counts as uploaded: for buffers that were made anew, or lost with their device.
    pub fn mark_all_dirty(&mut self) {
        self.memory.parts_mut().mark_all_dirty();
    }

    /// Everything counts as uploaded.
    pub fn clear_dirty(&mut self) {
        let capacity = self.capacity();
        let (instances, buckets, cells) = split_sets(self.memory.parts_mut().dirty, capacity);
        dirty::clear(instances, capacity.instances as usize);
        dirty::clear(buckets, capacity.buckets as usize);
        dirty::clear(cells, capacity.cells as usize);
    }

    /// The CPU lookup over the present contents.
    pub fn lookup(&self) -> Lookup<'_> {
        let Parts {
            instances,
            buckets,
            cells,
            ..
        } = self.memory.parts();
        Lookup {
            instances,
            buckets,
            cells,
        }
    }

    fn dirty_set(&self, buffer: Buffer) -> (&[u64], usize) {
        let capacity = self.capacity();
        let [instances, buckets, cells] =
            [capacity.instances, capacity.buckets, capacity.cells].map(|len| len as usize);
        let dirty = self.memory.parts().dirty;
        let (instance_set, rest) = dirty.split_at(dirty::words(instances));
        let (bucket_set, cell_set) = rest.split_at(dirty::words(buckets));
        match buffer {
            Buffer::Instances => (instance_set, instances),
            Buffer::Buckets => (bucket_set, buckets),
            Buffer::Cells => (cell_set, cells),
        }
    }
}

/// Which of up to 64 bytes are not 0: the first in the lowest bit.
fn not_zero(bytes: &[i8]) -> u64 {
    const ONES: u64 = u64::from_le_bytes([1; 8]);
    const LOWER: u64 = u64::from_le_bytes([127; 8]);
    let mut set = 0;
    for (at, bytes) in bytes.chunks(8).enumerate() {
        let mut eight = [0; 8];
        match bytes.first_chunk() {
            Some(bytes) => eight = *bytes,
            None => eight[..bytes.len()].copy_from_slice(bytes),
        }
        let word = u64::from_le_bytes(eight.map(|byte| byte as u8));
        let highest = (((word & LOWER) + LOWER) | word) >> 7 & ONES;
        // Gathers the eight bits in the highest byte.
        set |= highest.wrapping_mul(0x0102_0408_1020_4080) >> 56 << (8 * at);
    }
    set
}

fn split_sets(dirty: &mut [u64], capacity: Capacity) -> (&mut [u64], &mut [u64], &mut [u64]) {
    let (instances, rest) = dirty.split_at_mut(dirty::words(capacity.instances as usize));
    let (buckets, cells) = rest.split_at_mut(dirty::words(capacity.buckets as usize));
    (instances, buckets, cells)
}

fn reset_all<T: bytemuck::Pod>(values: &mut [T], set: &mut [u64]) {
    let len = values.len();
    for (index, value) in values.iter_mut().enumerate() {
        if bytemuck::bytes_of(value).iter().any(|&byte| byte != 0) {
            *value = T::zeroed();
            dirty::mark(set, len, index);
        }
    }
}

fn replace<T: bytemuck::Pod>(
    values: &mut [T],
    set: &mut [u64],
    index: u32,
    value: T,
    kind: u64,
    hash: &mut u64,
) {
    let length = values.len();
    let old = &mut values[index as usize];
    let words = words_of(old).iter().zip(words_of(&value));
    let mut changed = false;
    for (at, (before, after)) in (0..).zip(words).filter(|(_, (a, b))| a != b) {
        let change = u64::from(*after).wrapping_sub(u64::from(*before));
        *hash = hash.wrapping_add(word_factor(kind, index, at).wrapping_mul(change));
        changed = true;
    }
    if changed {
        *old = value;
        dirty::mark(set, length, index as usize);
    }
}

/// The part of one element in the mirror's hash: each 32-bit word times its own factor. So a
/// change of one word costs one multiplication, and what is zero does not count.
fn hash_of<T: bytemuck::Pod>(value: &T, index: u32, kind: u64) -> u64 {
    let parts = (0..)
        .zip(words_of(value))
        .map(|(at, &word)| word_factor(kind, index, at).wrapping_mul(u64::from(word)));
    parts.fold(0, u64::wrapping_add)
}

fn words_of<T: bytemuck::Pod>(value: &T) -> &[u32] {
    bytemuck::cast_slice(core::slice::from_ref(value))
}

fn word_factor(kind: u64, index: u32, at: u32) -> u64 {
    mix(kind << 56 | u64::from(index) << 8 | u64::from(at)) | 1
}

/// The finaliser of SplitMix64.
fn mix(mut x: u64) -> u64 {
    x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ x >> 31
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use crate::Point;
    use std::{vec, vec::Vec};

    fn with_mirror<R>(run: impl FnOnce(&mut Mirror<Borrowed<'_>>) -> R) -> R {
        let capacity = Capacity {
            instances: 3,
            buckets: 70,
            cells: 200,
            ..Capacity::default()
        };
        let mut instances = vec![Instance::default(); 3];
        let mut buckets = vec![Bucket::default(); 70];
        let mut cells = vec![Cell::default(); 200];
        let mut dirty = vec![0; capacity.dirty_words()];
        run(&mut Mirror::new(Borrowed(PartsMut {
            instances: &mut instances,
            buckets: &mut buckets,
            cells: &mut cells,
            dirty: &mut dirty,
        })))
    }

    fn cell(key: u32) -> Cell {
        let mut cell = Cell {
            key,
            ..Cell::default()
        };
        cell.points[0] = Point::pack([1, 2, 3], 4, key as u8);
        cell
    }

    #[test]
    fn the_running_hash_equals_the_hash_of_the_contents_in_any_order() {
        let hash_of = |order: &[u32]| {
            with_mirror(|mirror| {
                for &index in order {
                    mirror.set_cell(index, cell(index * 7)).unwrap();
                    mirror.set_cell(index, cell(index)).unwrap();
                    let entries = [index, 1, 0, 0, 0, 0, 0, 0];
                    mirror.set_bucket(index % 70, Bucket { entries }).unwrap();
                    assert_eq!(mirror.hash(), mirror.recompute_hash());
                }
                mirror.hash()
            })
        };
        assert_eq!(hash_of(&[5, 60, 9]), hash_of(&[9, 5, 60]));
        assert_ne!(hash_of(&[5, 60, 9]), hash_of(&[5, 60, 10]));
    }

    #[test]
    fn only_real_changes_are_dirty_and_reset_marks_what_it_takes_away() {
        with_mirror(|mirror| {
            mirror.set_cell(7, cell(7)).unwrap();
            mirror.set_cell(8, cell(8)).unwrap();
            mirror.set_cell(100, Cell::default()).unwrap();
            let runs = |mirror: &Mirror<Borrowed<'_>>| -> Vec<_> {
                let runs = mirror.dirty_runs(Buffer::Cells);
                runs.map(|run| [run.start, run.end]).collect()
            };
            assert_eq!(runs(mirror), [[7, 9]]);
            mirror.clear_dirty();
            mirror.set_cell(8, cell(8)).unwrap();
            assert_eq!(runs(mirror), [[0; 2]; 0]);
            mirror.reset();
            assert_eq!(runs(mirror), [[7, 9]]);
            assert_eq!((mirror.hash(), mirror.recompute_hash()), (0, 0));
        });
    }

    #[test]
    fn bytes_that_are_not_zero_are_found_wherever_they_are() {
        for length in 0..=64 {
            for at in 0..length {
                let mut bytes = vec![0i8; length];
                bytes[at] = [1, -1, 127, -128][at % 4];
                assert_eq!(not_zero(&bytes), 1 << at);
                bytes.fill(-128);
                bytes[at] = 0;
                let all = u64::MAX >> (64 - length);
                assert_eq!(not_zero(&bytes), all ^ 1 << at);
            }
        }
    }

    #[test]
    fn a_bucket_that_is_set_again_is_dirty_for_its_cells_may_have_other_keys() {
        with_mirror(|mirror| {
            let entries = [7, 0, 0, 0, 0, 0, 0, 0];
            for key in [1, 2] {
                mirror.set_cell(7, cell(key)).unwrap();
                mirror.set_bucket(3, Bucket { entries }).unwrap();
                assert_eq!(mirror.next_dirty(Buffer::Buckets, 0), Some(3..4));
                mirror.clear_dirty();
            }
            assert_eq!(mirror.hash(), mirror.recompute_hash());
        });
    }

    #[test]
    fn everything_can_be_made_dirty_again() {
        with_mirror(|mirror| {
            mirror.mark_all_dirty();
            let capacity = mirror.capacity();
            for (buffer, count) in [
                (Buffer::Instances, capacity.instances),
                (Buffer::Buckets, capacity.buckets),
                (Buffer::Cells, capacity.cells),
            ] {
                assert_eq!(mirror.next_dirty(buffer, 0), Some(0..count));
            }
            mirror.clear_dirty();
            assert_eq!(mirror.next_dirty(Buffer::Cells, 0), None);
        });
    }

    #[test]
    fn changes_out_of_range_are_refused_and_change_nothing() {
        with_mirror(|mirror| {
            assert_eq!(mirror.set_cell(200, cell(1)), Err(MirrorError::Index));
            assert_eq!(mirror.set_cell(0, cell(1)), Err(MirrorError::Index));
            assert_eq!(
                mirror.set_bucket(70, Bucket::default()),
                Err(MirrorError::Index)
            );
            let entries = [1, 200, 0, 0, 0, 0, 0, 0];
            assert_eq!(
                mirror.set_bucket(0, Bucket { entries }),
                Err(MirrorError::Entry)
            );
            assert_eq!(
                mirror.set_instance(3, Instance::default()),
                Err(MirrorError::Index)
            );
            let bad = Instance {
                bucket_count: 1,
                ..Instance::default()
            };
            assert!(matches!(
                mirror.set_instance(0, bad),
                Err(MirrorError::Grid(_))
            ));
            assert_eq!(mirror.hash(), 0);
        });
    }
}
