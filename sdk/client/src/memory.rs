//! Heap memory for a mirror, taken once.

use psao_core::mirror::{Capacity, Memory, Parts, PartsMut};
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
