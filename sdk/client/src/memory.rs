//! A client's memory: typed pieces, from the heap or all of one block that somebody lends.
//!
//! Whatever a client keeps is a [`Piece`]. Each is asked of a [`Source`] with the most that it may
//! ever have to hold, and given its present length when a stream's header says it. So one list of
//! pieces measures the block, cuts it up and takes the heap's share.

use bytemuck::{Pod, Zeroable};
use core::ops::{Deref, DerefMut};
use psao_core::bins::Place;
use psao_core::mirror::{Capacity, Memory, Parts, PartsMut};
use psao_core::residual::Neighbours;
use psao_core::slices::{Patch, Slice, Slices};
use psao_core::stream::{Header, MAX_BODY_BYTES, MAX_RAW_BYTES};
use psao_core::topology::{PATCH_POINTS, PatchPoint};
use psao_core::{Bucket, Cell, Instance, dirty};

/// 64 bytes, a cache line: what lent memory is made of. Every piece begins with one.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Line(pub [u8; 64]);

/// The most that a stream may ask a client to keep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Limits {
    /// Most room of each kind.
    pub capacity: Capacity,
    /// Largest packet body, bytes.
    pub body_bytes: u32,
    /// Largest decompressed content of a packet, bytes.
    pub raw_bytes: u32,
}

impl Limits {
    /// What any stream of at most this capacity needs.
    pub fn of_any(capacity: Capacity) -> Limits {
        Limits {
            capacity,
            body_bytes: MAX_BODY_BYTES,
            raw_bytes: MAX_RAW_BYTES,
        }
    }

    /// What the stream with this header needs.
    pub fn of(header: &Header) -> Limits {
        Limits {
            capacity: header.capacity,
            body_bytes: header.max_body_bytes,
            raw_bytes: header.max_raw_bytes,
        }
    }

    /// Nothing in `self` is more than in `most`.
    pub fn fit(&self, most: &Limits) -> bool {
        most.capacity.holds(&self.capacity)
            && self.body_bytes <= most.body_bytes
            && self.raw_bytes <= most.raw_bytes
    }
}

/// Where pieces come from.
#[derive(Debug)]
pub enum Source {
    /// The heap. Pieces are empty until they are given a length.
    #[cfg(feature = "std")]
    Heap,
    /// A block that is cut up from its front.
    Lent(&'static mut [Line]),
    /// Nowhere: counts the lines of the block that would do.
    Measure(u64),
}

impl Source {
    /// A piece of at most `most` elements, none of them in use.
    ///
    /// # Panics
    /// If the block is too short: measure it first.
    pub fn piece<T: Pod>(&mut self, most: u64) -> Piece<T> {
        let lines = most
            .saturating_mul(size_of::<T>() as u64)
            .div_ceil(size_of::<Line>() as u64);
        match self {
            #[cfg(feature = "std")]
            Source::Heap => Piece {
                memory: Store::Heap(Vec::new()),
                length: 0,
            },
            Source::Measure(total) => {
                *total = total.saturating_add(lines);
                Piece::empty()
            }
            Source::Lent(block) => {
                let (piece, rest) = core::mem::take(block).split_at_mut(lines as usize);
                *block = rest;
                let bytes: &mut [u8] = bytemuck::cast_slice_mut(piece);
                let whole = bytes.len() / size_of::<T>() * size_of::<T>();
                let elements = bytemuck::cast_slice_mut(&mut bytes[..whole]);
                Piece {
                    memory: Store::Lent(elements),
                    length: 0,
                }
            }
        }
    }
}

/// A list of elements, from the heap or lent.
#[derive(Debug)]
pub struct Piece<T: 'static> {
    memory: Store<T>,
    length: usize,
}

#[derive(Debug)]
enum Store<T: 'static> {
    #[cfg(feature = "std")]
    Heap(Vec<T>),
    Lent(&'static mut [T]),
}

impl<T: Pod> Piece<T> {
    /// Nothing, with no room for more.
    fn empty() -> Piece<T> {
        Piece {
            memory: Store::Lent(&mut []),
            length: 0,
        }
    }

    /// Makes it `length` elements, all zero. From the heap, memory is taken anew; a lent piece
    /// must have room.
    ///
    /// # Panics
    /// If a lent piece has no room: lengths are checked against [`Limits`] before.
    pub fn resize_zeroed(&mut self, length: usize) {
        match &mut self.memory {
            #[cfg(feature = "std")]
            Store::Heap(elements) => {
                // The old one goes first, so that both are never held at once.
                *elements = Vec::new();
                *elements = vec![T::zeroed(); length];
            }
            Store::Lent(elements) => elements[..length].fill(T::zeroed()),
        }
        self.length = length;
    }

    /// Bytes in use.
    pub fn bytes(&self) -> u64 {
        size_of_val::<[T]>(self) as u64
    }
}

impl<T> Deref for Piece<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.memory {
            #[cfg(feature = "std")]
            Store::Heap(elements) => elements,
            Store::Lent(elements) => &elements[..self.length],
        }
    }
}

impl<T> DerefMut for Piece<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.memory {
            #[cfg(feature = "std")]
            Store::Heap(elements) => elements,
            Store::Lent(elements) => &mut elements[..self.length],
        }
    }
}

#[cfg(feature = "std")]
impl<T: Pod> Clone for Piece<T> {
    /// A copy on the heap.
    fn clone(&self) -> Piece<T> {
        Piece {
            memory: Store::Heap(self.to_vec()),
            length: self.length,
        }
    }
}

/// A mirror's buffers, on the heap unless they were lent.
#[cfg_attr(feature = "std", derive(Clone))]
#[derive(Debug)]
pub struct Heap {
    instances: Piece<Instance>,
    buckets: Piece<Bucket>,
    cells: Piece<Cell>,
    dirty: Piece<u64>,
}

impl Heap {
    /// No buffers, and no room for any.
    pub(crate) fn empty() -> Heap {
        Heap {
            instances: Piece::empty(),
            buckets: Piece::empty(),
            cells: Piece::empty(),
            dirty: Piece::empty(),
        }
    }

    /// Zeroed buffers of the given capacity, on the heap.
    #[cfg(feature = "std")]
    pub fn new(capacity: Capacity) -> Heap {
        let mut heap = Heap::from(&mut Source::Heap, capacity);
        heap.resize(capacity);
        heap
    }

    /// Empty buffers with room for a capacity.
    pub fn from(source: &mut Source, most: Capacity) -> Heap {
        Heap {
            instances: source.piece(u64::from(most.instances)),
            buckets: source.piece(u64::from(most.buckets)),
            cells: source.piece(u64::from(most.cells)),
            dirty: source.piece(most.dirty_words() as u64),
        }
    }

    /// Makes the buffers as long as a capacity says, all zero.
    pub fn resize(&mut self, capacity: Capacity) {
        self.instances.resize_zeroed(capacity.instances as usize);
        self.buckets.resize_zeroed(capacity.buckets as usize);
        self.cells.resize_zeroed(capacity.cells as usize);
        self.dirty.resize_zeroed(capacity.dirty_words());
    }

    /// As [`Heap::resize`], so that all of it is dirty in a mirror made of it: whoever uploads
    /// has to fill buffers of another length anew. A mirror that begins takes away whatever is
    /// not zero, and what it takes away has changed.
    pub(crate) fn resize_changed(&mut self, capacity: Capacity) {
        self.resize(capacity);
        bytemuck::cast_slice_mut::<_, u8>(&mut self.instances).fill(1);
        bytemuck::cast_slice_mut::<_, u8>(&mut self.buckets).fill(1);
        bytemuck::cast_slice_mut::<_, u8>(&mut self.cells).fill(1);
    }
}

// Every change of the mirror asks for its buffers.
impl Memory for Heap {
    #[inline]
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

    #[inline]
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

/// What profile `residual` keeps beside a mirror, on the heap unless it was lent.
#[cfg_attr(feature = "std", derive(Clone))]
#[derive(Debug)]
pub struct SliceHeap {
    slices: Piece<Slice>,
    patches: Piece<Patch>,
    topology: Piece<u8>,
    topology_used: u32,
    values: Piece<u8>,
    last: Piece<i8>,
    neighbours: Piece<Neighbours>,
    places: Piece<Place>,
    free: Piece<u64>,
    scratch: Piece<PatchPoint>,
    scratch_of: [u32; 3],
}

impl SliceHeap {
    /// Room as a header asks for, on the heap: no patch has come, no slice is open.
    #[cfg(feature = "std")]
    pub fn new(capacity: Capacity) -> SliceHeap {
        let mut heap = SliceHeap::from(&mut Source::Heap, capacity);
        heap.resize(capacity);
        heap
    }

    /// Nothing yet, with room for a capacity.
    pub fn from(source: &mut Source, most: Capacity) -> SliceHeap {
        let points = u64::from(most.points);
        SliceHeap {
            slices: source.piece(u64::from(most.slices)),
            patches: source.piece(u64::from(most.patches)),
            topology: source.piece(u64::from(most.topology_bytes)),
            topology_used: 0,
            values: source.piece(points),
            last: source.piece(points),
            neighbours: source.piece(points),
            places: source.piece(points),
            free: source.piece(dirty::words(most.cells as usize) as u64),
            scratch: source.piece(PATCH_POINTS as u64),
            scratch_of: [0; 3],
        }
    }

    /// Room as a header asks for: no slice is open. Where the room for patches is the same as it
    /// was, those that have come stay.
    pub fn resize(&mut self, capacity: Capacity) {
        let points = capacity.points as usize;
        let topology = [capacity.patches as usize, capacity.topology_bytes as usize];
        if [self.patches.len(), self.topology.len()] != topology {
            self.patches.resize_zeroed(topology[0]);
            self.topology.resize_zeroed(topology[1]);
            self.slices().forget_patches();
        }
        self.slices.resize_zeroed(capacity.slices as usize);
        self.values.resize_zeroed(points);
        self.last.resize_zeroed(points);
        self.neighbours.resize_zeroed(points);
        self.places.resize_zeroed(points);
        self.free
            .resize_zeroed(dirty::words(capacity.cells as usize));
        self.scratch.resize_zeroed(PATCH_POINTS);
        self.scratch_of = [0; 3];
        self.slices().reset(capacity.cells);
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
        self.slices.bytes()
            + self.patches.bytes()
            + self.topology.bytes()
            + self.values.bytes()
            + self.last.bytes()
            + self.neighbours.bytes()
            + self.places.bytes()
            + self.free.bytes()
            + self.scratch.bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Client, State};
    use psao_core::mirror::Buffer;
    use psao_core::stream::{self, Frame, PREAMBLE, Profile, flag, kind, write_packet};

    fn lent(lines: u64) -> Source {
        Source::Lent(Box::leak(vec![Line([0xa5; 64]); lines as usize].into()))
    }

    /// A stream of one snapshot that sets bucket 1.
    fn stream_of(capacity: Capacity) -> Vec<u8> {
        let header = Header {
            profile: Profile::Residual,
            step: 1,
            capacity,
            max_body_bytes: 4096,
            max_raw_bytes: 4096,
            ..Header::default()
        };
        let mut bytes = PREAMBLE.to_vec();
        let mut packet = |kind, flags, sequence, body: &dyn Fn(&mut stream::Writer<'_>)| {
            let mut out = [0; 256];
            let length = write_packet(&mut out, kind, flags, sequence, |w| {
                body(w);
                Ok(())
            });
            bytes.extend_from_slice(&out[..length.unwrap()]);
        };
        packet(kind::HEADER, 0, 0, &|w| header.write(w).unwrap());
        let frame = Frame {
            id: 1,
            ..Frame::default()
        };
        let flags = flag::SNAPSHOT | flag::LAST;
        packet(kind::FRAME, flags, 1, &|w| frame.write(w).unwrap());
        bytes
    }

    #[test]
    fn a_client_in_lent_memory_follows_any_stream_within_its_limits() {
        let capacity = |cells| Capacity {
            instances: 3,
            buckets: 70,
            cells,
            slices: 5,
            points: 77,
            patches: 3,
            topology_bytes: 100,
        };
        let limits = Limits {
            capacity: capacity(1000),
            body_bytes: 4096,
            raw_bytes: 4096,
        };
        let mut source = lent(Client::lines(limits));
        let mut client = Client::from(&mut source, limits, 0);
        assert!(
            matches!(source, Source::Lent([])),
            "measured more than it takes"
        );
        for cells in [900, 1000, 10] {
            client.restart();
            let pushed = client.push(&stream_of(capacity(cells))).unwrap();
            assert_eq!(pushed.frame.map(|frame| frame.id), Some(1));
            assert_eq!(client.state(), State::Live);
            assert_eq!(client.mirror().cells().len(), cells as usize);
            assert_eq!(client.mirror().recompute_hash(), 0);
            // All that an upload has to fill is named.
            let runs: Vec<_> = client.mirror().dirty_runs(Buffer::Cells).collect();
            assert_eq!((runs.len(), runs[0].clone()), (1, 0..cells));
            client.clear_dirty();
        }
        client.restart();
        assert!(client.push(&stream_of(capacity(1001))).is_err());
    }

    #[test]
    #[should_panic]
    fn a_block_one_line_short_is_noticed() {
        let limits = Limits {
            body_bytes: 4096,
            ..Limits::default()
        };
        let mut source = lent(Client::lines(limits) - 1);
        Client::from(&mut source, limits, 0);
    }

    #[test]
    fn absurd_limits_measure_as_absurd() {
        let all = Capacity {
            instances: u32::MAX,
            buckets: u32::MAX,
            cells: u32::MAX,
            ..Capacity::default()
        };
        assert!(Client::lines(Limits::of_any(all)) > 1 << 32);
    }
}
