//! What the taker sees of a frame: its own copy of the mirror, or the mirror itself.

use core::ops::Range;
use psao::core::mirror::{Buffer, Capacity, Memory, Mirror, Parts, PartsMut};
use psao::core::stream::Frame;
use psao::core::{Kernel, Lookup, dirty};
use psao::memory::{Heap, Source};

/// The newest frame that was handed over.
pub struct Front {
    /// Which it is.
    pub frame: Frame,
    /// Which lookup its grids were laid out for.
    pub kernel: Kernel,
    /// With two threads, a copy of the mirror and what of it was not uploaded yet; else empty.
    copy: Heap,
}

impl Front {
    /// No frame, with room for a copy of a mirror of at most this capacity.
    pub fn new(source: &mut Source, most: Capacity) -> Front {
        Front {
            frame: Frame::default(),
            kernel: Kernel::Planar,
            copy: Heap::from(source, most),
        }
    }

    /// Copies what is dirty in the mirror, where it is dirty from now on.
    pub fn merge(&mut self, mirror: &Mirror<Heap>) {
        let capacity = mirror.capacity();
        if capacity_of(self.copy.parts()) != capacity {
            // All of the mirror is dirty then.
            self.copy.resize(capacity);
        }
        let PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        } = self.copy.parts_mut();
        let (instance_set, rest) = dirty.split_at_mut(dirty::words(instances.len()));
        let (bucket_set, cell_set) = rest.split_at_mut(dirty::words(buckets.len()));
        let runs = |buffer| mirror.dirty_runs(buffer);
        copy(
            instances,
            mirror.instances(),
            runs(Buffer::Instances),
            instance_set,
        );
        copy(buckets, mirror.buckets(), runs(Buffer::Buckets), bucket_set);
        copy(cells, mirror.cells(), runs(Buffer::Cells), cell_set);
    }

    /// The taker has nothing of it. Says whether there is anything: not before the first frame.
    pub fn mark_all_dirty(&mut self) -> bool {
        let mut parts = self.copy.parts_mut();
        parts.mark_all_dirty();
        !parts.buckets.is_empty()
    }

    /// The taker has what was dirty.
    pub fn clear_dirty(&mut self) {
        let PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        } = self.copy.parts_mut();
        let (instance_set, rest) = dirty.split_at_mut(dirty::words(instances.len()));
        let (bucket_set, cell_set) = rest.split_at_mut(dirty::words(buckets.len()));
        dirty::clear(instance_set, instances.len());
        dirty::clear(bucket_set, buckets.len());
        dirty::clear(cell_set, cells.len());
    }

    fn next_dirty(&self, buffer: Buffer, from: u32) -> Option<Range<u32>> {
        let Parts {
            instances,
            buckets,
            cells,
            dirty,
        } = self.copy.parts();
        let (instance_set, rest) = dirty.split_at(dirty::words(instances.len()));
        let (bucket_set, cell_set) = rest.split_at(dirty::words(buckets.len()));
        let (set, length) = match buffer {
            Buffer::Instances => (instance_set, instances.len()),
            Buffer::Buckets => (bucket_set, buckets.len()),
            Buffer::Cells => (cell_set, cells.len()),
        };
        let run = dirty::next_run(set, length, from as usize)?;
        Some(run.start as u32..run.end as u32)
    }
}

fn capacity_of(parts: Parts<'_>) -> Capacity {
    Capacity {
        instances: parts.instances.len() as u32,
        buckets: parts.buckets.len() as u32,
        cells: parts.cells.len() as u32,
        ..Capacity::default()
    }
}

fn copy<T: Copy>(
    to: &mut [T],
    from: &[T],
    runs: impl Iterator<Item = Range<u32>>,
    set: &mut [u64],
) {
    for run in runs {
        let run = run.start as usize..run.end as usize;
        to[run.clone()].copy_from_slice(&from[run.clone()]);
        for index in run {
            dirty::mark(set, to.len(), index);
        }
    }
}

/// A complete frame's buffers.
#[derive(Clone, Copy)]
pub enum Shown<'a> {
    /// One thread: the mirror itself, which nothing changes while it is taken.
    Mirror(&'a Mirror<Heap>),
    /// Two threads: the copy.
    Copy(&'a Front),
}

impl<'a> Shown<'a> {
    /// The buffers.
    pub fn buffers(self) -> Lookup<'a> {
        match self {
            Shown::Mirror(mirror) => mirror.lookup(),
            Shown::Copy(front) => {
                let parts = front.copy.parts();
                Lookup {
                    instances: parts.instances,
                    buckets: parts.buckets,
                    cells: parts.cells,
                }
            }
        }
    }

    /// Runs of what changed, those with at most `join` unchanged elements between them as one. As
    /// many as `ranges` has room for; the last covers all that is left. Returns how many.
    pub fn dirty_ranges(
        self,
        buffer: Buffer,
        join: u32,
        mut ranges: impl FnMut(usize, Range<u32>),
        most: usize,
    ) -> usize {
        let next = |from| match self {
            Shown::Mirror(mirror) => mirror.next_dirty(buffer, from),
            Shown::Copy(front) => front.next_dirty(buffer, from),
        };
        let mut count = 0;
        let mut open: Option<Range<u32>> = None;
        let mut from = 0;
        while let Some(run) = next(from) {
            from = run.end;
            open = Some(match open {
                Some(last) if run.start - last.end <= join || count + 1 == most => {
                    last.start..run.end
                }
                Some(last) => {
                    ranges(count, last);
                    count += 1;
                    run
                }
                None => run,
            });
        }
        if let Some(last) = open {
            ranges(count, last);
            count += 1;
        }
        count
    }
}
