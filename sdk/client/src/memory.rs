//! Heap memory for a mirror, taken once.

use psao_core::bins::{NOWHERE, Place};
use psao_core::mirror::{Capacity, Memory, Parts, PartsMut};
use psao_core::residual::Neighbours;
use psao_core::slices::{Patch, Slice, Slices};
use psao_core::topology::{PATCH_POINTS, PatchPoint};
use psao_core::{Bucket, Cell, Instance, dirty};

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

/// What profile `residual` keeps beside a mirror; never grows.
#[derive(Clone, Debug, Default)]
pub struct SliceHeap {
    slices: Vec<Slice>,
    patches: Vec<Patch>,
    topology: Vec<u8>,
    topology_used: u32,
    values: Vec<u8>,
    last: Vec<i8>,
    neighbours: Vec<Neighbours>,
    places: Vec<Place>,
    free: Vec<u64>,
    scratch: Vec<PatchPoint>,
    scratch_of: [u32; 3],
}

impl SliceHeap {
    /// Room as a header asks for: no patch has come, no slice is open.
    pub fn new(capacity: Capacity) -> SliceHeap {
        let points = capacity.points as usize;
        let mut heap = SliceHeap {
            slices: vec![Slice::default(); capacity.slices as usize],
            patches: vec![Patch::default(); capacity.patches as usize],
            topology: vec![0; capacity.topology_bytes as usize],
            topology_used: 0,
            values: vec![0; points],
            last: vec![0; points],
            neighbours: vec![Neighbours::default(); points],
            places: vec![NOWHERE; points],
            free: vec![0; dirty::words(capacity.cells as usize)],
            scratch: vec![PatchPoint::default(); PATCH_POINTS],
            scratch_of: [0; 3],
        };
        heap.slices().reset(capacity.cells);
        heap
    }

    /// Room as another header asks for: no slice is open. Where the room for patches is the same,
    /// those that have come stay. What goes is given back before anything new is taken.
    pub fn resized(mut self, capacity: Capacity) -> SliceHeap {
        let lengths = (self.patches.len(), self.topology.len());
        if lengths != (capacity.patches as usize, capacity.topology_bytes as usize) {
            drop(self);
            return SliceHeap::new(capacity);
        }
        let patches = std::mem::take(&mut self.patches);
        let topology = std::mem::take(&mut self.topology);
        let topology_used = self.topology_used;
        drop(self);
        SliceHeap {
            patches,
            topology,
            topology_used,
            ..SliceHeap::new(Capacity {
                patches: 0,
                topology_bytes: 0,
                ..capacity
            })
        }
    }

    /// Lends it to the codec.
    pub fn slices(&mut self) -> Slices<'_> {
        let SliceHeap {
            slices,
            patches,
            topology,
            topology_used,
            values,
            last,
            neighbours,
            places,
            free,
            scratch,
            scratch_of,
        } = self;
        Slices {
            slices,
            patches,
            topology,
            topology_used,
            values,
            last,
            neighbours,
            places,
            free,
            scratch,
            scratch_of,
        }
    }

    /// All slices, open or not.
    pub fn get(&self) -> &[Slice] {
        &self.slices
    }

    /// An open slice's occlusion, a point: 255 is open.
    pub fn values(&self, slice: &Slice) -> &[u8] {
        let first = slice.point_first as usize;
        &self.values[first..first + slice.point_count as usize]
    }

    /// An open slice's last changes, a point.
    pub fn last(&self, slice: &Slice) -> &[i8] {
        let first = slice.point_first as usize;
        &self.last[first..first + slice.point_count as usize]
    }

    /// An open slice's neighbours, a point.
    pub fn neighbours(&self, slice: &Slice) -> &[Neighbours] {
        let first = slice.point_first as usize;
        &self.neighbours[first..first + slice.point_count as usize]
    }

    /// Whether all patches have come.
    pub fn has_all_patches(&self) -> bool {
        self.patches.iter().all(|patch| patch.bytes != 0)
    }

    /// Bytes held.
    pub fn bytes(&self) -> u64 {
        let a_point = 1 + 1 + size_of::<Neighbours>() + size_of::<Place>();
        let bytes = self.slices.len() * size_of::<Slice>()
            + self.patches.len() * size_of::<Patch>()
            + self.topology.len()
            + self.values.len() * a_point
            + self.free.len() * 8
            + self.scratch.len() * size_of::<PatchPoint>();
        bytes as u64
    }
}
