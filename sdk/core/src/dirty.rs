//! Sets of indices, as bits with one level of summary: marking is O(1), and walking the runs of a
//! nearly empty set of a million costs some thousand loads.
//!
//! A set over `len` indices is a plain slice of [`words`]`(len)` words, all zero when empty: the
//! bits, then one summary bit a word.

use core::ops::Range;

/// Words a set over `len` indices needs.
pub const fn words(len: usize) -> usize {
    let bits = len.div_ceil(64);
    bits + bits.div_ceil(64)
}

/// Adds `index` (ignored if not below `len`).
pub fn mark(set: &mut [u64], len: usize, index: usize) {
    if index < len {
        let word = index / 64;
        set[word] |= 1 << (index % 64);
        set[len.div_ceil(64) + word / 64] |= 1 << (word % 64);
    }
}

/// Marks indices of which many are near each other: those of a word are gathered before the set
/// is touched.
pub struct Marks<'a> {
    set: &'a mut [u64],
    len: usize,
    word: usize,
    bits: u64,
}

impl<'a> Marks<'a> {
    /// Of a set over `len` indices.
    pub fn new(set: &'a mut [u64], len: usize) -> Marks<'a> {
        Marks {
            set,
            len,
            word: 0,
            bits: 0,
        }
    }

    /// Adds `index` (ignored if not below `len`).
    pub fn mark(&mut self, index: usize) {
        if index < self.len {
            if index / 64 != self.word {
                self.put();
                self.word = index / 64;
            }
            self.bits |= 1 << (index % 64);
        }
    }

    fn put(&mut self) {
        if self.bits != 0 {
            self.set[self.word] |= self.bits;
            self.set[self.len.div_ceil(64) + self.word / 64] |= 1 << (self.word % 64);
            self.bits = 0;
        }
    }
}

impl Drop for Marks<'_> {
    fn drop(&mut self) {
        self.put();
    }
}

/// Removes `index` (ignored if not below `len`).
pub fn unmark(set: &mut [u64], len: usize, index: usize) {
    if index < len {
        let word = index / 64;
        set[word] &= !(1 << (index % 64));
        if set[word] == 0 {
            set[len.div_ceil(64) + word / 64] &= !(1 << (word % 64));
        }
    }
}

/// The lowest index in the set at or after `from`.
pub fn first(set: &[u64], len: usize, from: usize) -> Option<usize> {
    let (bits, summary) = set.split_at(len.div_ceil(64));
    (from < len)
        .then(|| next_set(bits, summary, from))
        .flatten()
}

/// Adds every index below `len`.
pub fn mark_all(set: &mut [u64], len: usize) {
    set.fill(0);
    for index in 0..len {
        mark(set, len, index);
    }
}

/// Removes everything, touching only what is in the set.
pub fn clear(set: &mut [u64], len: usize) {
    let (bits, summary) = set.split_at_mut(len.div_ceil(64));
    for (block, words) in summary.iter_mut().zip(bits.chunks_mut(64)) {
        if *block != 0 {
            words.fill(0);
            *block = 0;
        }
    }
}

/// The first run of consecutive indices at or after `from`.
pub fn next_run(set: &[u64], len: usize, from: usize) -> Option<Range<usize>> {
    if from >= len {
        return None;
    }
    let (bits, summary) = set.split_at(len.div_ceil(64));
    let start = next_set(bits, summary, from)?;
    let mut word = start / 64;
    let mut zeros = !bits[word] >> (start % 64) << (start % 64);
    while zeros == 0 {
        word += 1;
        match bits.get(word) {
            Some(&bits) => zeros = !bits,
            None => return Some(start..len),
        }
    }
    Some(start..(word * 64 + zeros.trailing_zeros() as usize).min(len))
}

/// All runs, in order.
pub fn runs(set: &[u64], len: usize) -> impl Iterator<Item = Range<usize>> + '_ {
    let mut from = 0;
    core::iter::from_fn(move || {
        let run = next_run(set, len, from)?;
        from = run.end;
        Some(run)
    })
}

fn next_set(bits: &[u64], summary: &[u64], from: usize) -> Option<usize> {
    let mut word = from / 64;
    let first = bits[word] >> (from % 64) << (from % 64);
    if first != 0 {
        return Some(word * 64 + first.trailing_zeros() as usize);
    }
    word += 1;
    while word < bits.len() {
        let block = summary[word / 64] >> (word % 64);
        if block == 0 {
            word = (word / 64 + 1) * 64;
            continue;
        }
        word += block.trailing_zeros() as usize;
        return Some(word * 64 + bits[word].trailing_zeros() as usize);
    }
    None
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::{vec, vec::Vec};

    #[test]
    fn runs_are_those_of_a_plain_list_of_flags() {
        let mut seed = 7u64;
        let mut random = move |below: usize| {
            seed = seed
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (seed >> 33) as usize % below
        };
        for len in [1, 63, 64, 65, 4096, 4097, 10_000] {
            let mut set = vec![0; words(len)];
            let mut flags = vec![false; len];
            for _ in 0..20 {
                let (start, count) = (random(len), random(200));
                for index in start..(start + count).min(len) {
                    mark(&mut set, len, index);
                    flags[index] = true;
                }
                let gone = random(len);
                unmark(&mut set, len, gone);
                flags[gone] = false;
                mark(&mut set, len, len);
                let mut expected: Vec<usize> = Vec::new();
                for run in runs(&set, len) {
                    assert!(run.start < run.end && run.end <= len);
                    assert!(run.end == len || !flags[run.end], "a run stops early");
                    expected.extend(run);
                }
                let plain: Vec<usize> = (0..len).filter(|&i| flags[i]).collect();
                assert_eq!(expected, plain);
                let from = random(len);
                let after = plain.iter().find(|&&index| index >= from);
                assert_eq!(first(&set, len, from), after.copied());
                assert_eq!(first(&set, len, 0), plain.first().copied());
            }
            clear(&mut set, len);
            assert_eq!(next_run(&set, len, 0), None);
            mark_all(&mut set, len);
            assert_eq!(next_run(&set, len, 0), Some(0..len));
        }
    }
}
