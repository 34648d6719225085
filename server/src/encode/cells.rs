//! Profile `cells`, the paper's (section 3.4): whole cells that differ from what the client has.

use super::sight::Sight;
use super::{Compression, FrameStats, View, compress, compressor, write_content};
use crate::truth::Truth;
use crate::world::World;
use psao::memory::Heap;
use psao_core::mirror::Capacity;
use psao_core::stream::{CHANGES_HEADER_BYTES, Writer, apply_changes, kind};
use psao_core::{Bucket, Cell, Instance, Mirror, Point, dirty, point};
use rayon::prelude::*;
use std::time::Instant;

/// Largest content of a frame packet before compression: a client keeps one in memory.
pub const RAW_BYTES: usize = 1 << 20;

/// A point is sent again when it is off by more than this many position steps on an axis.
pub const POSITION_THRESHOLD: u32 = 1;

/// A point is sent again when its normal is off by more than this (as a dot product; 11 degrees,
/// one step of the code where it is coarsest).
pub const NORMAL_THRESHOLD: f32 = 0.98;

/// What a client of profile `cells` has.
pub struct Cells {
    pub mirror: Mirror<Heap>,
    /// For figures: what a client would need of what it gets.
    pub sight: Sight,
    threshold: u8,
    compression: Compression,
    /// Cells that may differ from the mirror; and buckets that the mirror has something in.
    due_cells: Vec<u64>,
    due_buckets: Vec<u64>,
    /// Scratch: what this frame sends.
    send_cells: Vec<u64>,
    send_buckets: Vec<u64>,
}

impl Cells {
    pub fn new(
        world: &World,
        capacity: Capacity,
        threshold: u8,
        compression: Compression,
    ) -> Cells {
        let truth = &world.truth;
        let mut due_cells = vec![0; dirty::words(truth.cells.len())];
        dirty::mark_all(&mut due_cells, truth.cells.len());
        Cells {
            mirror: Mirror::new(Heap::new(capacity)),
            sight: Sight::new(world.slices.len()),
            threshold,
            compression,
            send_cells: vec![0; due_cells.len()],
            due_cells,
            due_buckets: vec![0; dirty::words(truth.buckets.len())],
            send_buckets: vec![0; dirty::words(truth.buckets.len())],
        }
    }

    pub fn reset(&mut self) {
        self.mirror.reset();
        self.mirror.clear_dirty();
        let capacity = self.mirror.capacity();
        dirty::mark_all(&mut self.due_cells, capacity.cells as usize);
        dirty::clear(&mut self.due_buckets, capacity.buckets as usize);
    }

    pub fn merge(&mut self, truth: &Truth) {
        let [_, buckets, cells] = truth.changes();
        for run in dirty::runs(cells, truth.cells.len()) {
            for cell in run {
                dirty::mark(&mut self.due_cells, truth.cells.len(), cell);
            }
        }
        for run in dirty::runs(buckets, truth.buckets.len()) {
            for bucket in run {
                // A bucket the client has nothing of comes along with its first cell.
                if self.mirror.buckets()[bucket] != Bucket::default() {
                    dirty::mark(&mut self.due_buckets, truth.buckets.len(), bucket);
                }
            }
        }
    }

    /// The packets of a frame: kind, bytes before compression, content.
    pub fn frame(
        &mut self,
        world: &World,
        view: &View<'_>,
        stats: &mut FrameStats,
    ) -> Vec<(u8, Vec<u8>)> {
        let truth = &world.truth;
        self.select(world, view);
        let instances: Vec<(u32, Instance)> = (0..truth.instances.len())
            .map(|i| {
                let present = world.is_present(i as u32);
                let none = Instance::default();
                (i as u32, if present { truth.instances[i] } else { none })
            })
            .filter(|(i, want)| self.mirror.instances()[*i as usize] != *want)
            .collect();
        let buckets: Vec<(u32, Bucket)> = elements(&self.send_buckets, &truth.buckets);
        let cells: Vec<(u32, Cell)> = elements(&self.send_cells, &truth.cells);
        dirty::clear(&mut self.send_buckets, truth.buckets.len());
        dirty::clear(&mut self.send_cells, truth.cells.len());
        stats.instances = instances.len() as u32;
        stats.buckets = buckets.len() as u32;
        stats.cells = cells.len() as u32;
        if instances.is_empty() && buckets.is_empty() && cells.is_empty() {
            return Vec::new();
        }
        let mut start = Instant::now();
        let contents = contents(&instances, &buckets, &cells);
        stats.encode_ns += start.elapsed().as_nanos() as u64;
        for content in &contents {
            // The same bytes and the same function as at the client; the server's own data
            // always applies.
            apply_changes(content, &mut self.mirror).expect("own changes apply to the mirror");
        }
        start = Instant::now();
        let packets = contents
            .par_iter()
            .map_init(
                || compressor(self.compression),
                |zstd, raw| (kind::FRAME, compress(zstd, raw)),
            )
            .collect();
        stats.encode_ns += start.elapsed().as_nanos() as u64;
        packets
    }

    /// Marks the cells and buckets to send.
    fn select(&mut self, world: &World, view: &View<'_>) {
        let (truth, threshold) = (&world.truth, self.threshold);
        let (cell_count, bucket_count) = (truth.cells.len(), truth.buckets.len());
        let mut check = Vec::new();
        let mut gather =
            |due: &mut [u64], range: std::ops::Range<usize>, keep: &dyn Fn(usize) -> bool| {
                let mut from = range.start;
                while let Some(run) = dirty::next_run(due, cell_count, from) {
                    if run.start >= range.end {
                        break;
                    }
                    from = run.end;
                    for cell in run.start..run.end.min(range.end) {
                        if keep(cell) {
                            dirty::unmark(due, cell_count, cell);
                            check.push(cell as u32);
                        }
                    }
                }
            };
        let mut seen_instance = vec![false; truth.instances.len()];
        for slice in &world.slices {
            if (view.sees)(slice.bounds) && world.is_present(slice.instance) {
                seen_instance[slice.instance as usize] = true;
                let range = slice.cells.start as usize..slice.cells.end as usize;
                gather(&mut self.due_cells, range, &|_| true);
            }
        }
        let loose = world.loose_cells as usize..cell_count;
        gather(&mut self.due_cells, loose, &|cell| {
            seen_instance[world.instance_of_bucket(truth.home(cell as u32)) as usize]
        });
        for cell in check {
            let (want, have) = (
                &truth.cells[cell as usize],
                &self.mirror.cells()[cell as usize],
            );
            // A freed cell is not sent: its bucket no longer names it.
            if want.is_empty() {
                continue;
            }
            let home = truth.home(cell) as usize;
            // With another key a cell's bucket is sent again: its tag on the GPU is another (format.md, 6.5).
            if self.mirror.buckets()[home] != truth.buckets[home] || want.key != have.key {
                dirty::mark(&mut self.send_buckets, bucket_count, home);
            }
            if differs(want, have, threshold) {
                dirty::mark(&mut self.send_cells, cell_count, cell as usize);
            }
        }
        for run in dirty::runs(&self.due_buckets, bucket_count) {
            for bucket in run {
                if self.mirror.buckets()[bucket] != truth.buckets[bucket] {
                    dirty::mark(&mut self.send_buckets, bucket_count, bucket);
                }
            }
        }
        dirty::clear(&mut self.due_buckets, bucket_count);
        // A bucket's cells must be what it says they are, in view or not: an index may have been
        // another cell before.
        for run in dirty::runs(&self.send_buckets, bucket_count) {
            for cell in run.flat_map(|bucket| truth.buckets[bucket].cells()) {
                let (want, have) = (
                    &truth.cells[cell as usize],
                    &self.mirror.cells()[cell as usize],
                );
                if differs(want, have, threshold) {
                    dirty::mark(&mut self.send_cells, cell_count, cell as usize);
                    dirty::unmark(&mut self.due_cells, cell_count, cell as usize);
                }
            }
        }
    }
}

fn elements<T: Copy>(set: &[u64], values: &[T]) -> Vec<(u32, T)> {
    dirty::runs(set, values.len())
        .flatten()
        .map(|i| (i as u32, values[i]))
        .collect()
}

/// Whether a cell must be sent again.
fn differs(want: &Cell, have: &Cell, threshold: u8) -> bool {
    want.key != have.key
        || want.points.iter().zip(&have.points).any(|(want, have)| {
            want.is_allocated() != have.is_allocated()
                || want.0 >> 8 != have.0 >> 8 && moved(*want, *have)
                || want.occlusion().abs_diff(have.occlusion()) > threshold
        })
}

fn moved(want: Point, have: Point) -> bool {
    let far = |(a, b): (u32, u32)| a.abs_diff(b) > POSITION_THRESHOLD;
    let turned = || {
        let [a, b] = [want, have].map(|p| glam::Vec3::from(point::decode_normal(p.normal())));
        a.dot(b) < NORMAL_THRESHOLD
    };
    want.position().into_iter().zip(have.position()).any(far) || turned()
}

/// The contents of a frame's packets, each at most [`RAW_BYTES`]; at least one.
fn contents(
    instances: &[(u32, Instance)],
    buckets: &[(u32, Bucket)],
    cells: &[(u32, Cell)],
) -> Vec<Vec<u8>> {
    fn split<'a, T>(rest: &mut &'a [(u32, T)], room: &mut usize) -> &'a [(u32, T)] {
        let each = size_of::<T>() + 4;
        let (head, tail) = rest.split_at(rest.len().min(*room / each));
        *rest = tail;
        *room -= head.len() * each;
        head
    }
    let (mut instances, mut buckets, mut cells) = (instances, buckets, cells);
    let mut contents = Vec::new();
    loop {
        let mut room = RAW_BYTES - CHANGES_HEADER_BYTES;
        let instance_part = split(&mut instances, &mut room);
        let bucket_part = split(&mut buckets, &mut room);
        let cell_part = split(&mut cells, &mut room);
        let mut content = vec![0; RAW_BYTES - room];
        write_content(
            &mut Writer::new(&mut content),
            instance_part,
            bucket_part,
            cell_part,
        )
        .expect("content has the room counted");
        contents.push(content);
        if instances.is_empty() && buckets.is_empty() && cells.is_empty() {
            return contents;
        }
    }
}
