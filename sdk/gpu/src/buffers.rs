//! The mirror's three buffers on the GPU, and uploads of what changed.

use psao_core::mirror::{Buffer, Capacity, Memory};
use psao_core::tags;
use psao_core::{Bucket, Cell, Instance, Mirror};
use std::fmt;
use std::ops::Range;
use wgpu::util::StagingBelt;

/// Instances, buckets and cells on the GPU, as large as the stream may ever need: they never grow
/// and never move, so bind groups stay valid.
///
/// They are the mirror's, but for the tags in the buckets ([`psao_core::tags`]), which spare
/// [`crate::Tier::Fast`] from reading cells that it does not look for.
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
    /// What the present upload copies.
    plan: Vec<(Buffer, Range<u32>)>,
}

/// A buffer is larger than the device can bind, or than entries of buckets can name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLarge {
    /// Which one.
    pub buffer: &'static str,
    /// What it needs.
    pub bytes: u64,
    /// What is possible.
    pub limit_bytes: u64,
}

impl fmt::Display for TooLarge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} need {} bytes, more than the {} that are possible (at most 128 MiB, and the \
             max_storage_buffer_binding_size and max_buffer_size that the device was requested \
             with): request it with larger limits, or stream with a lower density",
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

/// Least staging memory that is taken at a time, enough for most frames.
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
            .min(limits.max_buffer_size)
            .min(STRIDES[2] * u64::from(tags::MAX_CELLS));
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
            plan: Vec::new(),
            device: device.clone(),
            buffers,
            layout,
            group,
            capacity,
        })
    }

    /// Copies what changed since [`Mirror::clear_dirty`], which is the caller's to call next; all
    /// of it into new buffers, after [`Mirror::mark_all_dirty`]. The
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
        let done = self.make_plan(mirror);
        let Some(size) = wgpu::BufferSize::new(done.bytes) else {
            return done;
        };
        // One piece of staging memory for all: taking one costs more than copying a range.
        let align = const { wgpu::BufferSize::new(wgpu::COPY_BUFFER_ALIGNMENT).unwrap() };
        let staging = self.belt.allocate(size, align);
        let mut view = staging
            .get_mapped_range_mut()
            .expect("the belt lends memory that is mapped");
        let mut filled = 0;
        let mut fill = |bytes: &[u8]| {
            view.slice(filled..filled + bytes.len())
                .copy_from_slice(bytes);
            filled += bytes.len();
        };
        let mut offset = staging.offset();
        for (kind, run) in &self.plan {
            let elements = run.start as usize..run.end as usize;
            match kind {
                Buffer::Instances => fill(bytemuck::cast_slice(&mirror.instances()[elements])),
                Buffer::Buckets => {
                    for bucket in &mirror.buckets()[elements] {
                        fill(bytemuck::bytes_of(&tags::tagged(bucket, mirror.cells())));
                    }
                }
                Buffer::Cells => fill(bytemuck::cast_slice(&mirror.cells()[elements])),
            }
            let stride = STRIDES[*kind as usize];
            let bytes = bytes_of(*kind, run);
            let target = &self.buffers[*kind as usize];
            let at = u64::from(run.start) * stride;
            encoder.copy_buffer_to_buffer(staging.buffer(), offset, target, at, bytes);
            offset += bytes;
        }
        drop(view);
        self.belt.finish_and_recall_on_submit(encoder);
        if done.bytes > KEPT_BYTES {
            self.belt = StagingBelt::new(self.device.clone(), CHUNK_BYTES);
        }
        done
    }

    /// What has to be copied: what changed, and little of what lies between.
    fn make_plan<M: Memory>(&mut self, mirror: &Mirror<M>) -> Uploaded {
        let mut done = Uploaded::default();
        self.plan.clear();
        for kind in KINDS {
            let first = self.plan.len();
            for run in mirror.dirty_runs(kind) {
                done.dirty_bytes += bytes_of(kind, &run);
                if let Some((_, before)) = self.plan[first..].last_mut() {
                    let more = bytes_of(kind, &(before.end..run.end));
                    if done.affords(more) {
                        done.bytes += more;
                        before.end = run.end;
                        continue;
                    }
                }
                done.bytes += bytes_of(kind, &run);
                self.plan.push((kind, run));
            }
        }
        done.copies = self.plan.len() as u32;
        done
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

    /// One of the buffers: for engines with bindings of their own. What it holds of the mirror is
    /// told at [`Buffers`].
    pub fn buffer(&self, kind: Buffer) -> &wgpu::Buffer {
        &self.buffers[kind as usize]
    }
}

fn bytes_of(kind: Buffer, run: &Range<u32>) -> u64 {
    u64::from(run.end - run.start) * STRIDES[kind as usize]
}

impl Uploaded {
    /// Whether copying `more` bytes, changed and not, keeps all within 1.1 times what changed.
    fn affords(&self, more: u64) -> bool {
        (self.bytes + more) * 10 <= self.dirty_bytes * 11
    }
}
