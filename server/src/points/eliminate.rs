//! Weighted sample elimination (Yuksel 2015), exact and parallel.
//!
//! The algorithm is a loop: take away the sample of the largest weight, lower its neighbours'
//! weights, until enough are gone. A heap makes that loop serial. Here it runs in parallel with the
//! same result, because of two facts. Weights only fall, so a sample whose key is above those of
//! all its neighbours goes before any of them, whatever happens elsewhere: it may go now. And the
//! loop's keys fall from one removal to the next, so its order is that of the keys at removal,
//! and what was taken too many are the last ones. Every order of work gives the same removals:
//! a stale key is only ever too high, and so at most delays a neighbour. For that, weights are
//! integers (sums do not depend on their order) and keys are unique.

use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// What elimination knows of a point.
#[derive(Clone, Copy, Default)]
pub(super) struct Sample {
    /// Metres from the lowest corner of the mesh's bounds: no component is negative.
    pub position: [f32; 3],
    /// Unit normal times 127.
    pub normal: [i8; 3],
    /// Distances count as so many times longer: where it is above 1 points lie denser.
    pub stretch: f32,
}

/// What became of the samples, by index.
pub(super) struct Eliminated {
    /// What is left, ascending.
    pub kept: Vec<u32>,
    /// What was taken away, first first.
    pub removed: Vec<u32>,
}

/// Weights are fixed point: what two samples at the least distance weigh on each other.
const ONE: f32 = (1 << 25) as f32;
/// At most so many neighbours each, to bound memory and time where layers lie much closer than
/// points do; a plane has 7 to 15. Keeps a sample's weight below 2^32.
const MAX_NEIGHBOURS: usize = 64;
/// Samples a unit of parallel work: what they touch fits a core's second-level cache.
const CHUNK: usize = 4096;
/// Elimination ends at about this weight on plain surfaces, so what weighs less needs no work at
/// first. Speed alone depends on it: what it missed is taken down to a weight of 0 after.
const LIKELY_END: u32 = (0.02 * ONE) as u32;
/// Cosine of the angle from which two surfaces face different ways: a fragment on one does not
/// blend points of the other (`T_n` of the lookup), so they need not keep apart.
const FACING: i32 = 127 * 127 / 10;

/// Takes samples away until `keep` are left, spread as evenly as samples closer than `reach`
/// metres (twice the largest Poisson radius at the density to come) can tell.
pub(super) fn eliminate(samples: &[Sample], reach: f32, keep: usize) -> Eliminated {
    let least = samples.iter().map(|s| s.stretch).fold(1.0, f32::min);
    let (cells, order) = sort_into_cells(samples, reach / least);
    let sorted: Vec<Sample> = order.par_iter().map(|&i| samples[i as usize]).collect();
    let mut graph = Graph::new(&sorted, &cells, reach, keep);
    drop(cells);
    let wanted = sorted.len().saturating_sub(keep);
    let mut gone = graph.remove_above(LIKELY_END);
    if gone.len() < wanted {
        gone.append(&mut graph.remove_above(0));
    }
    if gone.len() < wanted {
        // Nobody has a neighbour any more: the ties decide.
        gone.extend(
            graph
                .keys
                .iter()
                .map(|key| key.load(Relaxed))
                .filter(|&key| key != GONE),
        );
    }
    gone.par_sort_unstable_by(|a, b| b.cmp(a));
    gone.truncate(wanted);
    let removed: Vec<u32> = gone.iter().map(|&key| order[index_of(key)]).collect();
    let mut is_kept = vec![true; samples.len()];
    for &i in &removed {
        is_kept[i as usize] = false;
    }
    let kept = (0..samples.len() as u32)
        .filter(|&i| is_kept[i as usize])
        .collect();
    Eliminated { kept, removed }
}

/// The key of a sample that was taken away: below every other.
const GONE: u64 = 0;
/// Spreads ties evenly over the samples' order, and so over the surface: 2^32 / golden ratio.
const TIE: u32 = 0x9E37_79B1;
/// `TIE * UNTIE == 1`, modulo 2^32.
const UNTIE: u32 = 0x0E8B_2F51;
const _: () = assert!(TIE.wrapping_mul(UNTIE) == 1);

fn key_of(index: usize, weight: u32) -> u64 {
    u64::from(weight) << 32 | u64::from((index as u32 + 1).wrapping_mul(TIE))
}

fn index_of(key: u64) -> usize {
    (key as u32).wrapping_mul(UNTIE) as usize - 1
}

fn weight_of(key: u64) -> u32 {
    (key >> 32) as u32
}

/// One step along y and along z in a cell's number; along x it is 1.
const STEP: [i64; 2] = [1 << 21, 1 << 42];

/// The cells' numbers in ascending order, and which sample each belongs to. Cells are at least
/// `reach` wide, and never at the border of what 21 bits an axis hold.
fn sort_into_cells(samples: &[Sample], reach: f32) -> (Vec<i64>, Vec<u32>) {
    let extent = samples.iter().flat_map(|s| s.position).fold(0.0, f32::max);
    let per_metre = 1.0 / f64::from(reach).max(f64::from(extent) / ((1 << 21) - 4) as f64);
    let mut pairs: Vec<(i64, u32)> = samples
        .par_iter()
        .enumerate()
        .map(|(i, s)| {
            let [x, y, z] = s.position.map(|c| (f64::from(c) * per_metre) as i64 + 1);
            (x + y * STEP[0] + z * STEP[1], i as u32)
        })
        .collect();
    pairs.par_sort_unstable();
    pairs.into_par_iter().unzip()
}

/// Who weighs on whom.
struct Graph<'a> {
    samples: &'a [Sample],
    weigh: Weigh,
    /// Weight and tie of each sample; never below the truth, and `GONE` once it is.
    keys: Vec<AtomicU64>,
    chunks: Vec<Chunk>,
}

/// A run of samples and their neighbours: the first `counts[i]` from `starts[i]` on.
struct Chunk {
    first: usize,
    starts: Vec<u32>,
    counts: Vec<u8>,
    neighbours: Vec<u32>,
}

/// Yuksel's weight function with its limit, scaled so that the largest is `ONE`.
#[derive(Clone, Copy)]
struct Weigh {
    reach: f32,
    least: f32,
    scale: f32,
}

impl Weigh {
    fn new(reach: f32, count: usize, keep: usize) -> Self {
        let least = 0.65 * (1.0 - (keep as f64 / count as f64).powf(1.5)) as f32;
        Self {
            reach,
            least,
            scale: 1.0 / (1.0 - least),
        }
    }

    /// The weight of two samples on each other, if they are neighbours.
    fn of(&self, a: &Sample, b: &Sample) -> Option<u32> {
        let d2 = (0..3)
            .map(|k| (a.position[k] - b.position[k]).powi(2))
            .sum::<f32>();
        let facing: i32 = (0..3)
            .map(|k| i32::from(a.normal[k]) * i32::from(b.normal[k]))
            .sum();
        let stretch = 0.5 * (a.stretch + b.stretch);
        let d2 = d2 * (stretch * stretch);
        if d2 >= self.reach * self.reach || facing <= FACING {
            return None;
        }
        let d = (d2.sqrt() / self.reach).max(self.least);
        Some((((1.0 - d) * self.scale).powi(8) * ONE) as u32)
    }
}

impl<'a> Graph<'a> {
    fn new(samples: &'a [Sample], cells: &[i64], reach: f32, keep: usize) -> Self {
        let weigh = Weigh::new(reach, samples.len(), keep);
        let mut chunks: Vec<Chunk> = (0..samples.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|c| {
                let first = c * CHUNK;
                Chunk::new(
                    first..(first + CHUNK).min(samples.len()),
                    samples,
                    cells,
                    &weigh,
                )
            })
            .collect();
        make_mutual(&mut chunks);
        let keys = (0..samples.len())
            .map(|_| AtomicU64::new(GONE + 1))
            .collect();
        Self {
            samples,
            weigh,
            keys,
            chunks,
        }
    }

    /// Takes away all that weighs more than `end` when its turn comes; returns the keys they had.
    fn remove_above(&mut self, end: u32) -> Vec<u64> {
        let Self {
            samples,
            weigh,
            keys,
            chunks,
        } = self;
        let mut work: Vec<Work> = chunks
            .par_iter_mut()
            .map(|chunk| {
                let mut work = Work::default();
                for i in 0..chunk.counts.len() {
                    let me = chunk.first + i;
                    if keys[me].load(Relaxed) == GONE {
                        continue;
                    }
                    let weight = chunk.weight(i, samples, weigh, keys);
                    keys[me].store(key_of(me, weight), Relaxed);
                    if weight > end {
                        work.waiting.push(i as u32);
                    }
                }
                work
            })
            .collect();
        while work.iter().any(|w| !w.waiting.is_empty()) {
            work.par_iter_mut()
                .zip(&mut *chunks)
                .for_each(|(work, chunk)| {
                    // Again while it is fruitful and in the cache.
                    while chunk.sweep(work, end, samples, weigh, keys) {}
                });
        }
        work.into_iter().flat_map(|w| w.removed).collect()
    }
}

/// What is left to do in a chunk, and what was done.
#[derive(Default)]
struct Work {
    /// Samples that weigh enough to be taken away, from the chunk's first.
    waiting: Vec<u32>,
    /// Keys at removal.
    removed: Vec<u64>,
}

impl Chunk {
    fn new(
        range: std::ops::Range<usize>,
        samples: &[Sample],
        cells: &[i64],
        weigh: &Weigh,
    ) -> Self {
        let first = range.start;
        // The nine rows of cells around a sample, its own first. A row's three cells are one run
        // of the sorted samples, and each row's run only moves forward from sample to sample.
        let shifts = [
            [0, 0],
            [-1, 0],
            [1, 0],
            [0, -1],
            [0, 1],
            [-1, -1],
            [1, -1],
            [-1, 1],
            [1, 1],
        ]
        .map(|[y, z]| y * STEP[0] + z * STEP[1]);
        let mut cursors =
            shifts.map(|shift| cells.partition_point(|&cell| cell < cells[first] + shift - 1));
        let mut chunk = Self {
            first,
            starts: vec![],
            counts: vec![],
            neighbours: vec![],
        };
        for i in range {
            let start = chunk.neighbours.len();
            'rows: for (shift, cursor) in shifts.iter().zip(&mut cursors) {
                let middle = cells[i] + shift;
                while *cursor < cells.len() && cells[*cursor] < middle - 1 {
                    *cursor += 1;
                }
                for j in *cursor..cells.len() {
                    if cells[j] > middle + 1 {
                        break;
                    }
                    if j != i && weigh.of(&samples[i], &samples[j]).is_some() {
                        chunk.neighbours.push(j as u32);
                        if chunk.neighbours.len() - start == MAX_NEIGHBOURS {
                            break 'rows;
                        }
                    }
                }
            }
            chunk.starts.push(start as u32);
            chunk.counts.push((chunk.neighbours.len() - start) as u8);
        }
        chunk
    }

    fn neighbours_of(&mut self, i: usize) -> &mut [u32] {
        &mut self.neighbours[self.starts[i] as usize..][..usize::from(self.counts[i])]
    }

    /// The sum of the weights of the neighbours that are left; forgets the others.
    fn weight(&mut self, i: usize, all: &[Sample], weigh: &Weigh, keys: &[AtomicU64]) -> u32 {
        let me = &all[self.first + i];
        let mut sum = 0;
        let mut left = 0;
        let list = self.neighbours_of(i);
        for k in 0..list.len() {
            let j = list[k];
            if keys[j as usize].load(Relaxed) != GONE {
                sum += weigh.of(me, &all[j as usize]).unwrap_or(0);
                list[left] = j;
                left += 1;
            }
        }
        self.counts[i] = left as u8;
        sum
    }

    /// Looks at all that wait, and takes away those whose turn it is. True where there were any.
    fn sweep(
        &mut self,
        work: &mut Work,
        end: u32,
        all: &[Sample],
        weigh: &Weigh,
        keys: &[AtomicU64],
    ) -> bool {
        let before = work.removed.len();
        work.waiting.retain(|&i| {
            let i = i as usize;
            let me = self.first + i;
            let mut key = keys[me].load(Relaxed);
            // Who was in the way stays first in the list, and is most often still in the way.
            let list = self.neighbours_of(i);
            if list
                .first()
                .is_some_and(|&j| keys[j as usize].load(Relaxed) > key)
            {
                return true;
            }
            // Each neighbour's key is read once: one that another thread takes away meanwhile
            // either counts as gone, or is seen to be in the way.
            let mut lost = 0;
            let mut highest = (GONE, 0);
            let mut left = 0;
            for k in 0..list.len() {
                let j = list[k];
                let key = keys[j as usize].load(Relaxed);
                if key == GONE {
                    lost += weigh.of(&all[me], &all[j as usize]).unwrap_or(0);
                } else {
                    list[left] = j;
                    highest = highest.max((key, left));
                    left += 1;
                }
            }
            if left > 0 {
                list.swap(0, highest.1);
            }
            self.counts[i] = left as u8;
            if lost > 0 {
                let weight = weight_of(key) - lost;
                key = key_of(me, weight);
                keys[me].store(key, Relaxed);
                if weight <= end {
                    return false;
                }
            }
            if highest.0 > key {
                return true;
            }
            keys[me].store(GONE, Relaxed);
            work.removed.push(key);
            false
        });
        work.removed.len() > before
    }
}

/// Drops neighbours that do not know of each other, which the limit on their number leaves.
fn make_mutual(chunks: &mut [Chunk]) {
    let is_full = |&count: &u8| usize::from(count) == MAX_NEIGHBOURS;
    if !chunks.iter().any(|chunk| chunk.counts.iter().any(is_full)) {
        return;
    }
    let knows = |j: u32, i: u32| {
        let chunk = &chunks[j as usize / CHUNK];
        let j = j as usize % CHUNK;
        let list = &chunk.neighbours[chunk.starts[j] as usize..][..usize::from(chunk.counts[j])];
        list.len() < MAX_NEIGHBOURS || list.contains(&i)
    };
    let mutual: Vec<Vec<bool>> = chunks
        .par_iter()
        .map(|chunk| {
            let mut mutual = Vec::with_capacity(chunk.neighbours.len());
            for i in 0..chunk.counts.len() {
                let list = &chunk.neighbours[chunk.starts[i] as usize..];
                let list = &list[..usize::from(chunk.counts[i])];
                mutual.extend(list.iter().map(|&j| knows(j, (chunk.first + i) as u32)));
            }
            mutual
        })
        .collect();
    chunks
        .par_iter_mut()
        .zip(mutual)
        .for_each(|(chunk, mutual)| {
            for i in 0..chunk.counts.len() {
                let mutual = &mutual[chunk.starts[i] as usize..];
                let mut left = 0;
                let list = chunk.neighbours_of(i);
                for k in 0..list.len() {
                    if mutual[k] {
                        list[left] = list[k];
                        left += 1;
                    }
                }
                chunk.counts[i] = left as u8;
            }
        });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::scramble;

    /// At random in a box, facing along one of five directions.
    fn scattered(count: u64, size: [f32; 3]) -> Vec<Sample> {
        let unit = |k| (scramble(k) >> 40) as f32 / (1 << 24) as f32;
        let normals = [
            [0, 0, 127],
            [0, 0, -127],
            [0, 127, 0],
            [90, 0, 90],
            [0, 90, 90],
        ];
        (0..count)
            .map(|i| Sample {
                position: [0, 1, 2].map(|k| unit(4 * i + k) * size[k as usize]),
                normal: normals[(scramble(4 * i + 3) % 5) as usize],
                stretch: 1.0,
            })
            .collect()
    }

    /// The loop of the paper, on the same weights, ties and all.
    fn obvious(samples: &[Sample], reach: f32, keep: usize) -> Vec<u32> {
        let (_, order) = sort_into_cells(samples, reach);
        let weigh = Weigh::new(reach, samples.len(), keep);
        let sample = |i: usize| &samples[order[i] as usize];
        let mut left: Vec<usize> = (0..samples.len()).collect();
        let mut weights: Vec<u32> = left
            .iter()
            .map(|&i| {
                let others = left.iter().filter(|&&j| j != i);
                others.filter_map(|&j| weigh.of(sample(i), sample(j))).sum()
            })
            .collect();
        let mut removed = vec![];
        while left.len() > keep {
            let heaviest = (0..left.len()).max_by_key(|&k| key_of(left[k], weights[left[k]]));
            let i = left.swap_remove(heaviest.unwrap());
            for &j in &left {
                weights[j] -= weigh.of(sample(i), sample(j)).unwrap_or(0);
            }
            removed.push(order[i]);
        }
        removed
    }

    #[test]
    fn the_parallel_order_is_exactly_that_of_the_serial_loop() {
        // Dense enough for many neighbours, sparse enough that ties decide, and several chunks.
        for (count, size, keep) in [
            (2, [1.0, 1.0, 0.0], 1),
            (300, [1.0, 1.0, 0.0], 100),
            (3000, [30.0, 20.0, 0.0], 1500),
            (3000, [9.0, 9.0, 9.0], 750),
            (2000, [90.0, 90.0, 9.0], 100),
            (9000, [60.0, 60.0, 1.0], 4500),
        ] {
            let samples = scattered(count, size);
            let reach = if count == 300 { 0.2 } else { 1.0 };
            let got = eliminate(&samples, reach, keep);
            assert_eq!(
                got.removed,
                obvious(&samples, reach, keep),
                "{count} {size:?}"
            );
            assert_eq!(got.kept.len(), keep);
            let mut all = [got.kept, got.removed].concat();
            all.sort_unstable();
            assert!(all.iter().copied().eq(0..count as u32));
        }
    }

    #[test]
    fn crowds_are_thinned_to_the_count_the_same_on_any_number_of_threads() {
        // All within reach of all: lists are cut off.
        let samples = scattered(20_000, [0.5, 0.5, 0.5]);
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| eliminate(&samples, 1.0, 5_000))
        };
        let one = on(1);
        assert_eq!(one.kept.len(), 5_000);
        for _ in 0..3 {
            assert_eq!(on(2).removed, one.removed);
        }
    }
}
