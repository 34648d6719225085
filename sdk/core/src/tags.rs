//! Tags: on the GPU, a bucket's entry holds a few bits of its cell's key above the cell's index, so
//! that the fast lookup reads no cell in vain.
//!
//! Whoever uploads a bucket tags it on the way; the mirror itself has no tags. A bucket is dirty
//! whenever one of its tags may have changed: a writer sends a bucket again where a cell that it
//! names gets another key (docs/format.md, 6.5).

use crate::cell::{Bucket, Cell};

/// Bits of a tagged entry that name the cell; the tag lies above them.
pub const CELL_BITS: u32 = 22;

/// Cells that tagged entries can name: 128 MiB. A bucket of a larger buffer can't be tagged.
pub const MAX_CELLS: u32 = 1 << CELL_BITS;

/// A key's tag, 1 to 1023: `psao_tag` of psao.wgsl, shifted.
pub fn tag_of(key: u32) -> u32 {
    (key.wrapping_mul(0x9e37_79b1) >> CELL_BITS).max(1)
}

/// Cells that a tagged bucket may have: those that one load of 16 bytes brings.
const MOST: usize = 4;

/// The bucket with tags, as the GPU is to have it. It stays without where two of its cells have the
/// same tag, or where it has more than 4 (together about one bucket of five hundred): the fast
/// lookup then searches it as the plain one does, and in all others knows after one load.
///
/// `cells`: those that it names, at most [`MAX_CELLS`]; beyond them there are no tags.
pub fn tagged(bucket: &Bucket, cells: &[Cell]) -> Bucket {
    if bucket.cells().count() > MOST {
        return *bucket;
    }
    let mut out = *bucket;
    for at in 0..bucket.cells().count() {
        let tag = match cells.get(bucket.entries[at] as usize) {
            Some(cell) => tag_of(cell.key),
            None => return *bucket,
        };
        if out.entries[..at]
            .iter()
            .any(|entry| entry >> CELL_BITS == tag)
        {
            return *bucket;
        }
        out.entries[at] |= tag << CELL_BITS;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(keys: [u32; 4]) -> [Cell; 4] {
        keys.map(|key| Cell {
            key,
            ..Cell::default()
        })
    }

    const BUCKET: Bucket = Bucket {
        entries: [3, 1, 2, 0, 0, 0, 0, 0],
    };

    #[test]
    fn entries_keep_their_cells_under_the_tags_of_the_keys() {
        let cells = cells([0, 10, 20, 0]);
        let out = tagged(&BUCKET, &cells);
        for (entry, plain) in out.entries.into_iter().zip(BUCKET.entries) {
            assert_eq!(entry & (MAX_CELLS - 1), plain);
            let tag = cells[plain as usize].key;
            let tag = if plain == 0 { 0 } else { tag_of(tag) };
            assert_eq!(entry >> CELL_BITS, tag);
        }
        // Key 0 has one, too.
        assert_eq!(out.entries[0] >> CELL_BITS, 1);
    }

    #[test]
    fn a_bucket_of_more_cells_than_a_load_brings_stays_as_it_is() {
        let cells: [Cell; 6] = core::array::from_fn(|at| Cell {
            key: at as u32 * 10,
            ..Cell::default()
        });
        let mut bucket = Bucket {
            entries: [1, 2, 3, 4, 0, 0, 0, 0],
        };
        let four = tagged(&bucket, &cells).entries;
        assert!(four[..4].iter().all(|entry| entry >> CELL_BITS != 0));
        bucket.entries[4] = 5;
        assert_eq!(tagged(&bucket, &cells), bucket);
    }

    #[test]
    fn a_bucket_with_two_equal_tags_or_an_unknown_cell_stays_as_it_is() {
        let same = (11..).find(|key| tag_of(*key) == tag_of(10)).unwrap();
        assert_eq!(tagged(&BUCKET, &cells([0, 10, same, 30])), BUCKET);
        assert_eq!(tagged(&BUCKET, &cells([0, 10, 20, 30])[..3]), BUCKET);
    }
}
