//! The mirror's three buffers on the GPU, and uploads of what changed.

use psao_core::mirror::{Buffer, Capacity, Memory};
use psao_core::{Bucket, Cell, Instance, Mirror};
use std::fmt;
use std::ops::Range;
use wgpu::util::StagingBelt;

/// Instances, buckets and cells on the GPU, as large as the stream may ever need: they never grow
/// and never move, so bind groups stay valid.
///
/// Use it from one thread at a time.
#[derive(Debug)]
pub struct Buffers {
    device: wgpu::Device,
    buffers: [wgpu::Buffer; 3],
    layout: wgpu::BindGroupLayout,
    group: wgpu::BindGroup,
    capacity: Capacity,
    belt: StagingBelt,
}

/// A buffer is larger than the device can bind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLarge {
    /// Which one.
    pub buffer: &'static str,
    /// What it needs.
    pub bytes: u64,
    /// What the device allows.
    pub limit_bytes: u64,
}

impl fmt::Display for TooLarge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} need {} bytes, but the device was requested with max_storage_buffer_binding_size \
             and max_buffer_size of at most {}: request it with larger limits, or stream with a \
             lower density",
            self.buffer, self.bytes, self.limit_bytes
        )
    }
}

impl std::error::Error for TooLarge {}

/// What one upload did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Uploaded {
    /// Bytes of the elements that had changed.
    pub dirty_bytes: u64,
    /// Bytes copied: at most a tenth more, where that saves a copy.
    pub bytes: u64,
    /// Copies.
    pub copies: u32,
}

const NAMES: [&str; 3] = ["psao instances", "psao buckets", "psao cells"];
const KINDS: [Buffer; 3] = [Buffer::Instances, Buffer::Buckets, Buffer::Cells];
const STRIDES: [u64; 3] = [
    size_of::<Instance>() as u64,
    size_of::<Bucket>() as u64,
    size_of::<Cell>() as u64,
];

/// Staging memory is taken in pieces of this size, enough for most frames.
const CHUNK_BYTES: u64 = 256 << 10;

/// After an upload larger than this (the first frame's, a snapshot's) its staging memory is given
/// back instead of kept for the next.
const KEPT_BYTES: u64 = 4 << 20;

impl Buffers {
    /// Takes the memory, zeroed: all is open until the first upload. `capacity`: the client's.
    ///
    /// # Errors
    /// A buffer is larger than the device's limits.
    pub fn new(device: &wgpu::Device, capacity: Capacity) -> Result<Buffers, TooLarge> {
        let counts = [capacity.instances, capacity.buckets, capacity.cells];
        let limits = device.limits();
        let limit_bytes = limits
            .max_storage_buffer_binding_size
            .min(limits.max_buffer_size);
        // At least one of each: an empty buffer cannot be bound.
        let sizes: [u64; 3] =
            std::array::from_fn(|kind| u64::from(counts[kind].max(1)) * STRIDES[kind]);
        for (&bytes, buffer) in sizes.iter().zip(NAMES) {
            if bytes > limit_bytes {
                return Err(TooLarge {
                    buffer,
                    bytes,
                    limit_bytes,
                });
            }
        }
        let buffers: [wgpu::Buffer; 3] = std::array::from_fn(|kind| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(NAMES[kind]),
                size: sizes[kind],
                usage: wgpu::BufferUsages::STORAGE
                    | wgpu::BufferUsages::COPY_DST
                    | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            })
        });
        let entry = |binding| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::FRAGMENT | wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: wgpu::BufferBindingType::Storage { read_only: true },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("psao"),
            entries: &[entry(0), entry(1), entry(2)],
        });
        let bound = |kind: usize| wgpu::BindGroupEntry {
            binding: kind as u32,
            resource: buffers[kind].as_entire_binding(),
        };
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("psao"),
            layout: &layout,
            entries: &[bound(0), bound(1), bound(2)],
        });
        Ok(Buffers {
            belt: StagingBelt::new(device.clone(), CHUNK_BYTES),
            device: device.clone(),
            buffers,
            layout,
            group,
            capacity,
        })
    }

    /// Copies what changed since [`Mirror::clear_dirty`], which is the caller's to call next. The
    /// copies are recorded at `encoder`'s end: submit it, and before anything that is to see them.
    ///
    /// Never waits for the GPU: staging memory that is still in use is left alone, and comes back
    /// when the device is polled (as by every submit).
    ///
    /// # Panics
    /// If the mirror is larger than these buffers.
    pub fn upload<M: Memory>(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        mirror: &Mirror<M>,
    ) -> Uploaded {
        assert!(
            self.capacity.holds(&mirror.capacity()),
            "the mirror is larger than the buffers made for it"
        );
        let mut done = Uploaded::default();
        let contents: [&[u8]; 3] = [
            bytemuck::cast_slice(mirror.instances()),
            bytemuck::cast_slice(mirror.buckets()),
            bytemuck::cast_slice(mirror.cells()),
        ];
        for kind in 0..3 {
            let mut pending: Option<Range<u64>> = None;
            for run in mirror.dirty_runs(KINDS[kind]) {
                let run = u64::from(run.start) * STRIDES[kind]..u64::from(run.end) * STRIDES[kind];
                done.dirty_bytes += run.end - run.start;
                pending = match pending {
                    Some(before) if done.affords(run.end - before.end) => {
                        done.bytes += run.end - before.end;
                        Some(before.start..run.end)
                    }
                    before => {
                        done.bytes += run.end - run.start;
                        if let Some(before) = before {
                            self.copy(encoder, kind, contents[kind], before, &mut done);
                        }
                        Some(run)
                    }
                };
            }
            if let Some(last) = pending {
                self.copy(encoder, kind, contents[kind], last, &mut done);
            }
        }
        self.belt.finish_and_recall_on_submit(encoder);
        if done.bytes > KEPT_BYTES {
            self.belt = StagingBelt::new(self.device.clone(), CHUNK_BYTES);
        }
        done
    }

    fn copy(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        kind: usize,
        contents: &[u8],
        range: Range<u64>,
        done: &mut Uploaded,
    ) {
        for start in range.clone().step_by(CHUNK_BYTES as usize) {
            let end = range.end.min(start + CHUNK_BYTES);
            let size = wgpu::BufferSize::new(end - start).expect("a run is not empty");
            self.belt
                .write_buffer(encoder, &self.buffers[kind], start, size)
                .copy_from_slice(&contents[start as usize..end as usize]);
            done.copies += 1;
        }
    }

    /// Layout of [`Buffers::bind_group`]: read-only storage buffers at bindings 0 (instances),
    /// 1 (buckets) and 2 (cells), for fragment and compute shaders.
    pub fn bind_group_layout(&self) -> &wgpu::BindGroupLayout {
        &self.layout
    }

    /// The three buffers, for [`crate::wgsl`].
    pub fn bind_group(&self) -> &wgpu::BindGroup {
        &self.group
    }

    /// One of the buffers: for engines with bindings of their own.
    pub fn buffer(&self, kind: Buffer) -> &wgpu::Buffer {
        let at = KINDS.iter().position(|known| *known == kind);
        &self.buffers[at.expect("all kinds are listed")]
    }
}

impl Uploaded {
    /// Whether copying `more` bytes, changed and not, keeps all within 1.1 times what changed.
    fn affords(&self, more: u64) -> bool {
        (self.bytes + more) * 10 <= self.dirty_bytes * 11
    }
}
