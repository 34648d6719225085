//! The plain structs that cross the border, and how they do.

use crate::result::psao_result::{self, *};
use core::ffi::{c_char, c_void};
use psao::core::mirror::Capacity;
use psao::core::{Bucket, Cell, Instance};
use psao::memory::Limits;

/// How important a message is.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum psao_log_level {
    /// Something failed, and says what to do.
    PSAO_LOG_ERROR = 1,
    /// Something is not as it should be, and goes on.
    PSAO_LOG_WARNING = 2,
    /// What happens, now and then.
    PSAO_LOG_INFO = 3,
}

/// Takes a message: message_bytes of UTF-8, not terminated, valid during the call. level is a
/// psao_log_level. Called on the thread of the function that has something to say, and only from
/// psao_client_init and psao_client_restart.
pub type psao_log = Option<
    unsafe extern "C" fn(
        user_data: *mut c_void,
        level: u32,
        message: *const c_char,
        message_bytes: usize,
    ),
>;

/// What a client may hold, and how it is used. Set struct_size and the counts; zero elsewhere is
/// the default. psao_config_from_stream fills one from a stream's first bytes.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_config {
    /// sizeof(psao_config).
    pub struct_size: u32,
    /// 1: one thread pushes and another takes; the buffers are then held twice. 0: the same
    /// thread does both, or you lock.
    pub two_threads: u32,
    /// Hash of the scene you loaded; 0 accepts any.
    pub scene_hash: u64,
    /// psao_client_status calls a client stale for which the link showed no sign of life for so
    /// long. 0: never for that reason.
    pub stale_after_ns: u64,
    /// Takes messages; may be NULL.
    pub log: psao_log,
    /// Passed to log.
    pub log_user_data: *mut c_void,
    /// Most instances.
    pub instance_count: u32,
    /// Most buckets, of all instances.
    pub bucket_count: u32,
    /// Most cells, of all instances, and one.
    pub cell_count: u32,
    /// Most slices. This and the next three are 0 for streams of profile cells.
    pub slice_count: u32,
    /// Most points of slices that are open at a time.
    pub point_count: u32,
    /// Most patches: parts of meshes with their points.
    pub patch_count: u32,
    /// Most bytes of all patches.
    pub topology_bytes: u32,
    /// Largest packet. 0: the format's limit, 4 MiB.
    pub max_body_bytes: u32,
    /// Largest decompressed packet. 0: the format's limit, 4 MiB.
    pub max_raw_bytes: u32,
    /// For engines that have baked occlusion: how long the first frame takes to come up over it,
    /// in psao_status.stream_share. 0: it is there at once.
    pub ease_ns: u64,
}

/// What the stream says of itself.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct psao_header {
    /// sizeof(psao_header), set by you.
    pub struct_size: u32,
    /// 0 cells, 1 residual.
    pub profile: u32,
    /// Kernel for the lookup: 0 paper, 1 planar.
    pub kernel: u32,
    /// Elements of the instance buffer.
    pub instance_count: u32,
    /// Elements of the bucket buffer.
    pub bucket_count: u32,
    /// Elements of the cell buffer.
    pub cell_count: u32,
    /// Hash of the server's scene.
    pub scene_hash: u64,
    /// Longest ray.
    pub ao_distance_m: f32,
    /// Points per square metre and side.
    pub density: f32,
    /// Server frames per second.
    pub rate_hz: f32,
    /// Occlusion may be off by so many 1/255.
    pub threshold: u32,
}

/// An instance's grid and hash table, as the shaders read it.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_instance {
    /// The grid's corner, in local units.
    pub origin: [f32; 3],
    /// Interpolation radius, in cells.
    pub radius: f32,
    /// Local units to cells.
    pub cells_per_unit: [f32; 3],
    /// First bucket of this instance.
    pub bucket_first: u32,
    /// Cells along each axis.
    pub dims: [u32; 3],
    /// Buckets of this instance; 0: it has no points, ignore the rest.
    pub bucket_count: u32,
    /// Takes a local normal to cell space, before normalising.
    pub normal_scale: [f32; 3],
    /// Level of detail, 0 (all points) to 3. For people: the lookup does not need it.
    pub level: u32,
}

/// Up to eight cells by their index; 0 ends the list.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_bucket {
    /// Cell indices.
    pub entries: [u32; 8],
}

/// A grid cell's points.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_cell {
    /// The cell's index in its instance's grid.
    pub key: u32,
    /// Points of 32 bits: 1 allocated, 15 position, 8 normal, 8 occlusion from the top; 0 ends
    /// the list.
    pub points: [u32; 7],
}

const _: () = assert!(size_of::<psao_instance>() == size_of::<Instance>());
const _: () = assert!(size_of::<psao_bucket>() == size_of::<Bucket>());
const _: () = assert!(size_of::<psao_cell>() == size_of::<Cell>());

/// A complete frame, yours until psao_client_release. The buffers stay where they are for the
/// client's life; their lengths change only where a new stream says so, and then all of them is
/// dirty.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_frame {
    /// sizeof(psao_frame), set by you.
    pub struct_size: u32,
    /// Number, for psao_uplink_ack.
    pub frame_id: u32,
    /// Scene time of this state.
    pub server_time_ns: u64,
    /// Kernel for the lookup: 0 paper, 1 planar.
    pub kernel: u32,
    /// Elements of instances.
    pub instance_count: u32,
    /// Elements of buckets.
    pub bucket_count: u32,
    /// Elements of cells.
    pub cell_count: u32,
    /// 64 bytes each, aligned to 64.
    pub instances: *const psao_instance,
    /// 32 bytes each, aligned to 64.
    pub buckets: *const psao_bucket,
    /// 32 bytes each, aligned to 64.
    pub cells: *const psao_cell,
}

/// Which of a frame's buffers.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum psao_buffer {
    /// psao_frame.instances
    PSAO_BUFFER_INSTANCES = 0,
    /// psao_frame.buckets
    PSAO_BUFFER_BUCKETS = 1,
    /// psao_frame.cells
    PSAO_BUFFER_CELLS = 2,
}

/// Elements that lie together.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct psao_range {
    /// First element.
    pub first_index: u32,
    /// Elements.
    pub count: u32,
}

/// Where a client is in its stream.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum psao_state {
    /// No frame has come yet. Draw without AO: everything is open.
    PSAO_STATE_CONNECTING = 0,
    /// The last frame is the server's.
    PSAO_STATE_LIVE = 1,
    /// The last frame is older than it should be. Go on drawing it: it freezes, and catches up
    /// without a flash.
    PSAO_STATE_STALE = 2,
    /// The server ended the stream. The last frame stays good.
    PSAO_STATE_ENDED = 3,
    /// A push failed. The last frame stays in place; psao_client_restart and a new stream go on
    /// from it.
    PSAO_STATE_FAILED = 4,
}

/// How a client is.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct psao_status {
    /// sizeof(psao_status), set by you.
    pub struct_size: u32,
    /// A psao_state.
    pub state: u32,
    /// The last time, by your clock, at which the frame was the server's: while not live, AO is
    /// what it was then. 0: never.
    pub live_ns: u64,
    /// How much of the stream to show over baked occlusion: 0 before the first frame was taken,
    /// 1 psao_config.ease_ns after it came. For psao_client_lookup_over_baked and the shaders'
    /// psao_over_baked.
    pub stream_share: f32,
}

/// Totals since init, and the newest frame.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct psao_stats {
    /// sizeof(psao_stats), set by you.
    pub struct_size: u32,
    /// Number of the newest complete frame.
    pub frame_id: u32,
    /// Its scene time.
    pub server_time_ns: u64,
    /// How much later it came than the fastest frame of this stream, by your clock: what waits on
    /// the way.
    pub delay_ns: u64,
    /// Hash of its mirror. The server says the upper half with each frame, of the bytes it means.
    pub mirror_hash: u64,
    /// Bytes pushed and used.
    pub stream_bytes: u64,
    /// Complete frames.
    pub frame_count: u64,
    /// Snapshots among them.
    pub snapshot_count: u64,
    /// Frames that were discarded because the mirror's hash was not the server's.
    pub discarded_count: u64,
    /// Frames that went into a later one because the taker was busy or late.
    pub merged_count: u64,
    /// Instances received.
    pub instance_count: u64,
    /// Buckets received.
    pub bucket_count: u64,
    /// Cells received.
    pub cell_count: u64,
    /// Changes of slices received.
    pub slice_count: u64,
    /// Patches received.
    pub patch_count: u64,
}

/// Counts a connection's messages: one for what goes up the stream, another one for datagrams.
/// All zero at the start of every connection. Yours: no client knows of it.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct psao_uplink {
    /// Number of the next message.
    pub next_sequence: u32,
}

/// Where you look from. The server sends what you see first.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_camera {
    /// sizeof(psao_camera).
    pub struct_size: u32,
    /// Vertical field of view, above 0 and below pi.
    pub fov_y_rad: f32,
    /// Width over height, above 0.001 and below 1000.
    pub aspect: f32,
    /// Rows of the picture: decides how fine what is far away needs to be. 0: all as fine as near.
    pub height_px: u32,
    /// World position.
    pub position_m: [f64; 3],
    /// View direction, not zero.
    pub forward: [f32; 3],
    /// Up, not zero and not along forward.
    pub up: [f32; 3],
}

/// Structs that grow: their first field is their size as the caller knows it.
///
/// # Safety
/// `repr(C)`, begins with a `u32 struct_size`, and all-zero bytes are a value.
pub(crate) unsafe trait Sized32: Copy {}

// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_config {}
// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_header {}
// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_frame {}
// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_status {}
// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_stats {}
// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_camera {}

/// A struct that is larger than this is none.
const MAX_STRUCT_BYTES: usize = 4096;

/// Reads what the caller says the size of its struct is.
///
/// # Safety
/// `from` is NULL or has 4 bytes to read.
pub(crate) unsafe fn struct_bytes(from: *const u8) -> Result<usize, psao_result> {
    if from.is_null() {
        return Err(PSAO_ERROR_NULL);
    }
    // SAFETY: not null, and so 4 bytes long.
    let bytes = unsafe { from.cast::<u32>().read_unaligned() } as usize;
    if (8..=MAX_STRUCT_BYTES).contains(&bytes) && bytes.is_multiple_of(4) {
        Ok(bytes)
    } else {
        Err(PSAO_ERROR_STRUCT)
    }
}

/// Reads a struct of the caller's: of an older one the rest is zero, of a newer one the rest must
/// be.
///
/// # Safety
/// `from` is NULL or as long as its first 4 bytes say.
pub(crate) unsafe fn read_struct<T: Sized32>(from: *const T) -> Result<T, psao_result> {
    let from = from.cast::<u8>();
    // SAFETY: the caller's word.
    let theirs = unsafe { struct_bytes(from)? };
    let known = theirs.min(size_of::<T>());
    for at in known..theirs {
        // SAFETY: within the length that the struct says.
        if unsafe { *from.add(at) } != 0 {
            return Err(PSAO_ERROR_STRUCT);
        }
    }
    // SAFETY: all-zero bytes are a `T`. The first `known` bytes are within both.
    Ok(unsafe {
        let mut value: T = core::mem::zeroed();
        from.copy_to_nonoverlapping((&raw mut value).cast(), known);
        value
    })
}

/// Writes a struct to the caller's, as far as it goes; its struct_size stays.
///
/// # Safety
/// `to` is NULL or as long as its first 4 bytes say.
pub(crate) unsafe fn write_struct<T: Sized32>(to: *mut T, value: &T) -> Result<(), psao_result> {
    let to = to.cast::<u8>();
    // SAFETY: the caller's word.
    let theirs = unsafe { struct_bytes(to)? };
    let known = theirs.min(size_of::<T>());
    // SAFETY: `known` bytes are within both, and at least 8.
    unsafe {
        let from = (&raw const *value).cast::<u8>();
        from.add(4).copy_to_nonoverlapping(to.add(4), known - 4);
    }
    Ok(())
}

impl psao_config {
    /// What it allows, where zero is the default.
    pub(crate) fn limits(&self) -> Limits {
        let or = |value: u32, default: u32| if value == 0 { default } else { value };
        let any = Limits::of_any(Capacity::default());
        Limits {
            capacity: Capacity {
                instances: self.instance_count,
                buckets: self.bucket_count,
                cells: self.cell_count,
                slices: self.slice_count,
                points: self.point_count,
                patches: self.patch_count,
                topology_bytes: self.topology_bytes,
            },
            body_bytes: or(self.max_body_bytes, any.body_bytes),
            raw_bytes: or(self.max_raw_bytes, any.raw_bytes),
        }
    }

    /// Sets what a stream needs.
    pub(crate) fn set_limits(&mut self, need: Limits) {
        self.instance_count = need.capacity.instances;
        self.bucket_count = need.capacity.buckets;
        self.cell_count = need.capacity.cells;
        self.slice_count = need.capacity.slices;
        self.point_count = need.capacity.points;
        self.patch_count = need.capacity.patches;
        self.topology_bytes = need.capacity.topology_bytes;
        self.max_body_bytes = need.body_bytes;
        // 0 would be the default.
        self.max_raw_bytes = need.raw_bytes.max(1);
    }
}
