//! Heap memory for a mirror, taken once.

use psao_core::mirror::{Capacity, Memory, Parts, PartsMut};
use psao_core::residual::Neighbours;
use psao_core::slices::{Slice, Slices};
use psao_core::{Bucket, Cell, Instance};

/// A mirror's buffers on the heap; never grows.
#[derive(Clone, Debug, Default)]
pub struct Heap {
    instances: Vec<Instance>,
    buckets: Vec<Bucket>,
    cells: Vec<Cell>,
    dirty: Vec<u64>,
}

impl Heap {
    /// Zeroed buffers of the given capacity.
    pub fn new(capacity: Capacity) -> Heap {
        Heap {
            instances: vec![Instance::default(); capacity.instances as usize],
            buckets: vec![Bucket::default(); capacity.buckets as usize],
            cells: vec![Cell::default(); capacity.cells as usize],
            dirty: vec![0; capacity.dirty_words()],
        }
    }
}

impl Memory for Heap {
    fn parts(&self) -> Parts<'_> {
        let Heap {
            instances,
            buckets,
            cells,
            dirty,
        } = self;
        Parts {
            instances,
            buckets,
            cells,
            dirty,
        }
    }

    fn parts_mut(&mut self) -> PartsMut<'_> {
        let Heap {
            instances,
            buckets,
            cells,
            dirty,
        } = self;
        PartsMut {
            instances,
            buckets,
            cells,
            dirty,
        }
    }
}

/// What the residual codec keeps beside a mirror; never grows.
#[derive(Clone, Debug, Default)]
pub struct SliceHeap {
    slices: Vec<Slice>,
    neighbours: Vec<Neighbours>,
    last: Vec<i8>,
    points_used: u32,
}

impl SliceHeap {
    /// Room for slices and their points, none of them open.
    pub fn new(slices: u32, points: u32) -> SliceHeap {
        SliceHeap {
            slices: vec![Slice::default(); slices as usize],
            neighbours: vec![Neighbours::default(); points as usize],
            last: vec![0; points as usize],
            points_used: 0,
        }
    }

    /// Lends it to the codec.
    pub fn slices(&mut self) -> Slices<'_> {
        let SliceHeap {
            slices,
            neighbours,
            last,
            points_used,
        } = self;
        Slices {
            slices,
            neighbours,
            last,
            points_used,
        }
    }

    /// Bytes held.
    pub fn bytes(&self) -> u64 {
        let slices = self.slices.len() * size_of::<Slice>();
        let points = self.last.len() * (size_of::<Neighbours>() + 1);
        (slices + points) as u64
    }
}
