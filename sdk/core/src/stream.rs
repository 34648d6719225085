//! The stream: packets, their reader and their writer. `docs/format.md` is the definition.
//!
//! A reader trusts nothing: lengths are checked before bytes are touched, and every value before
//! it reaches the mirror.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::bins::MAX_CELLS;
use crate::cell::{BUCKET_ENTRIES, Bucket, CELL_POINTS, Cell};
use crate::grid::Instance;
use crate::lookup::Kernel;
use crate::mirror::{Capacity, Memory, Mirror, MirrorError};
use bytemuck::Pod;

/// The first bytes of a stream; the line ends detect a transfer that mangles text.
pub const PREAMBLE: [u8; 8] = *b"\x89PSAO\r\n\x1a";

/// Major version: a reader refuses any other.
pub const VERSION_MAJOR: u16 = 1;

/// Minor version: a reader accepts newer ones, and ignores what they add.
pub const VERSION_MINOR: u16 = 0;

/// Bytes of a packet's header.
pub const PACKET_HEADER_BYTES: usize = 12;

/// Where its checksum is, which covers what is before it, and the body.
const CHECKSUM_AT: usize = PACKET_HEADER_BYTES - 4;

/// Largest body any packet may have.
pub const MAX_BODY_BYTES: u32 = 1 << 22;

/// Largest decompressed content of a frame packet.
pub const MAX_RAW_BYTES: u32 = 1 << 22;

/// Bytes of a frame's or a slices packet's body before its content.
pub const FRAME_HEADER_BYTES: usize = 16;

/// Bytes of a frame packet's content before what is compressed: the length that this will have.
pub const RAW_LENGTH_BYTES: usize = 4;

/// What a packet is.
pub mod kind {
    /// Parameters of the stream: always the first packet. [`super::Header`].
    pub const HEADER: u8 = 1;
    /// A part of a frame's changes. [`super::Frame`].
    pub const FRAME: u8 = 2;
    /// The stream ends here, as intended. Empty body.
    pub const END: u8 = 3;
    /// The server will not serve. [`super::Refusal`].
    pub const REFUSE: u8 = 4;
    /// A part of a frame's changes: slices. [`super::Frame`], then [`crate::slices`]' items.
    /// Profile `residual` only.
    pub const SLICES: u8 = 5;
    /// Patches, in no frame. Profile `residual` only.
    pub const PATCHES: u8 = 6;
}

/// Flags of a packet.
pub mod flag {
    /// Frame: the mirror is reset before this packet is applied.
    pub const SNAPSHOT: u8 = 1;
    /// Frame: the frame is complete with this packet, and `mirror_check` holds.
    pub const LAST: u8 = 2;
    /// Slices: two bits, by how many doublings the items' step is coarser than the header's. See
    /// [`super::Header::step_of`].
    pub const COARSE: u8 = 12;
    /// Any unknown kind: may be skipped by a reader that does not know it.
    pub const OPTIONAL: u8 = 128;
}

/// Why bytes are not a stream that this reader can follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamError {
    /// The stream does not begin with [`PREAMBLE`].
    NotAStream,
    /// Another major version (the value).
    Version(u16),
    /// A profile that this reader does not know (its number).
    Profile(u8),
    /// A packet's checksum does not match: bytes were changed on the way.
    Checksum,
    /// A packet was lost or reordered.
    Sequence,
    /// A packet is larger than this reader allows (the value).
    PacketTooLarge(u32),
    /// A body ends before its content does, or goes on after it.
    Length,
    /// A reserved field is not zero, or a value outside its range.
    Value,
    /// An unknown packet kind that may not be skipped (the value).
    Kind(u8),
    /// The packet is not allowed here: a frame before the header, a second header, a part of a
    /// frame within another one, anything after the end.
    Order,
    /// The change cannot be applied to the mirror.
    Mirror(MirrorError),
}

impl From<MirrorError> for StreamError {
    fn from(error: MirrorError) -> StreamError {
        StreamError::Mirror(error)
    }
}

impl core::fmt::Display for StreamError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            StreamError::NotAStream => f.write_str("not a PSAO stream (wrong first bytes)"),
            StreamError::Version(major) => write!(
                f,
                "stream version {major}, this reader knows {VERSION_MAJOR}: \
                 use matching versions of server and SDK"
            ),
            StreamError::Profile(profile) => write!(
                f,
                "stream profile {profile}, this reader knows {} (cells) and {} (residual): \
                 let the server use one of these, or update the SDK",
                Profile::Cells as u8,
                Profile::Residual as u8
            ),
            StreamError::Checksum => f.write_str("a packet's checksum does not match"),
            StreamError::Sequence => f.write_str("a packet is missing or out of order"),
            StreamError::PacketTooLarge(bytes) => {
                write!(f, "a packet of {bytes} bytes is over the limit")
            }
            StreamError::Length => f.write_str("a packet's length does not fit its content"),
            StreamError::Value => f.write_str("a field is outside its range"),
            StreamError::Kind(kind) => write!(f, "unknown packet kind {kind}"),
            StreamError::Order => f.write_str("a packet comes where it may not"),
            StreamError::Mirror(error) => write!(f, "a change cannot be applied: {error:?}"),
        }
    }
}

impl core::error::Error for StreamError {}

/// Which scheme carries the changes.
#[repr(u8)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Profile {
    /// The paper's (section 3.4): changed buckets and whole changed cells, zstd.
    #[default]
    Cells = 0,
    /// Where points are once, a mesh; after that only their occlusion, predicted and entropy
    /// coded, slice by slice.
    Residual = 1,
}

/// Parameters of a stream.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Header {
    /// Scheme.
    pub profile: Profile,
    /// Kernel that the grid was laid out for.
    pub kernel: Kernel,
    /// Content hash of the scene: the client's must be the same.
    pub scene_hash: u64,
    /// Sizes of the mirror.
    pub capacity: Capacity,
    /// Largest packet body in this stream, bytes.
    pub max_body_bytes: u32,
    /// Largest decompressed content of a frame packet, bytes.
    pub max_raw_bytes: u32,
    /// Longest ray, metres.
    pub ao_distance_m: f32,
    /// Points per square metre and side.
    pub density: f32,
    /// Server frames per second.
    pub rate_hz: f32,
    /// A point is sent again when its occlusion is off by more than this, in 1/255.
    pub threshold: u8,
    /// Profile `residual`: occlusion changes in multiples of this many 1/255, 1 or more.
    pub step: u8,
    /// Profile `residual`: tells all patches together from others; 0 for none to tell.
    pub topology_hash: u64,
}

/// What every part of a frame says of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Frame {
    /// Counts up by 1 a frame, wrapping. Encoders begin with 1; a reader takes any first one.
    pub id: u32,
    /// Scene time of this state, nanoseconds since the scene's start.
    pub time_ns: u64,
    /// [`mirror_check`] of [`Mirror::hash`] after the frame; 0 in all but its last packet.
    pub mirror_check: u32,
}

/// What a frame says of its mirror's hash: the upper half, as in the lower one a bit depends on none
/// above it.
pub fn mirror_check(hash: u64) -> u32 {
    (hash >> 32) as u32
}

/// Why a server will not serve a client.
#[repr(u16)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The token is wrong or missing.
    Token = 1,
    /// The client's scene is another one.
    Scene = 2,
    /// No common protocol version or profile.
    Version = 3,
    /// The client's buffers are too small for this scene.
    Capacity = 4,
    /// The server serves as many clients as it may.
    Full = 5,
    /// The client's first message cannot be understood.
    Malformed = 6,
}

impl Refusal {
    /// From its code.
    pub fn from_code(code: u16) -> Option<Refusal> {
        use Refusal::*;
        [Token, Scene, Version, Capacity, Full, Malformed]
            .into_iter()
            .find(|r| *r as u16 == code)
    }
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Refusal::Token => "wrong token: pass the one that the server was started with",
            Refusal::Scene => "another scene: client and server must load the same files",
            Refusal::Version => "no common protocol version: update the older side",
            Refusal::Capacity => "the client's buffers are too small for this scene: raise them",
            Refusal::Full => "the server is full: try again later",
            Refusal::Malformed => "the first message was not understood: not a PSAO client?",
        })
    }
}

/// A packet, its checksum and sequence already checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet<'a> {
    /// See [`kind`] and [`crate::uplink::kind`].
    pub kind: u8,
    /// See [`flag`].
    pub flags: u8,
    /// Counts up by 1 a packet, wrapping.
    pub sequence: u16,
    /// Content.
    pub body: &'a [u8],
}

impl<'a> Packet<'a> {
    /// Checks that no flag but those of `known` is set: all others are reserved.
    pub fn check_flags(&self, known: u8) -> Result<(), StreamError> {
        if self.flags & !known == 0 {
            Ok(())
        } else {
            Err(StreamError::Value)
        }
    }

    /// Reads the packet at the start of `bytes` and says how long it is, or `None` if more bytes
    /// are needed. `max_body_bytes` bounds what it may ask for.
    pub fn read(
        bytes: &'a [u8],
        max_body_bytes: u32,
    ) -> Result<Option<(Packet<'a>, usize)>, StreamError> {
        let Some((header, rest)) = bytes.split_first_chunk::<PACKET_HEADER_BYTES>() else {
            return Ok(None);
        };
        let mut reader = Reader(header);
        let (kind, flags, sequence) = (reader.u8()?, reader.u8()?, reader.u16()?);
        let (body_bytes, checksum) = (reader.u32()?, reader.u32()?);
        if body_bytes > max_body_bytes.min(MAX_BODY_BYTES) {
            return Err(StreamError::PacketTooLarge(body_bytes));
        }
        let Some(body) = rest.get(..body_bytes as usize) else {
            return Ok(None);
        };
        let (covered, _) = header.split_at(CHECKSUM_AT);
        if crc32(covered, body) != checksum {
            return Err(StreamError::Checksum);
        }
        let length = PACKET_HEADER_BYTES.saturating_add(body_bytes as usize);
        Ok(Some((
            Packet {
                kind,
                flags,
                sequence,
                body,
            },
            length,
        )))
    }
}

fn crc32(header: &[u8], body: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(header);
    hasher.update(body);
    hasher.finalize()
}

/// Writes one packet into `out` and returns its length. `body` fills it.
///
/// # Errors
/// [`StreamError::Length`] if `out` is too small.
pub fn write_packet(
    out: &mut [u8],
    kind: u8,
    flags: u8,
    sequence: u16,
    body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
) -> Result<usize, StreamError> {
    let (header, rest) = out
        .split_first_chunk_mut::<PACKET_HEADER_BYTES>()
        .ok_or(StreamError::Length)?;
    let mut writer = Writer {
        out: rest,
        length: 0,
    };
    body(&mut writer)?;
    let body_bytes = writer.length;
    if body_bytes > MAX_BODY_BYTES as usize {
        return Err(StreamError::PacketTooLarge(body_bytes as u32));
    }
    let body = rest.get(..body_bytes).ok_or(StreamError::Length)?;
    let (covered, checksum) = header.split_at_mut(CHECKSUM_AT);
    let mut writer = Writer {
        out: covered,
        length: 0,
    };
    writer.bytes(&[kind, flags])?;
    writer.u16(sequence)?;
    writer.u32(body_bytes as u32)?;
    checksum.copy_from_slice(&crc32(covered, body).to_le_bytes());
    Ok(PACKET_HEADER_BYTES.saturating_add(body_bytes))
}

impl Header {
    /// The step of later items in a slices packet with these [`flag`]s.
    pub fn step_of(&self, flags: u8) -> u8 {
        let doublings = (flags & flag::COARSE) >> flag::COARSE.trailing_zeros();
        self.step.saturating_mul(1 << doublings)
    }

    /// Reads a header packet's body. Bytes after the known fields belong to a newer minor
    /// version and are ignored.
    pub fn read(body: &[u8]) -> Result<Header, StreamError> {
        let mut r = Reader(body);
        let major = r.u16()?;
        if major != VERSION_MAJOR {
            return Err(StreamError::Version(major));
        }
        let _minor = r.u16()?;
        let profile = match r.u8()? {
            0 => Profile::Cells,
            1 => Profile::Residual,
            other => return Err(StreamError::Profile(other)),
        };
        let kernel = match r.u8()? {
            0 => Kernel::Paper,
            1 => Kernel::Planar,
            _ => return Err(StreamError::Value),
        };
        if [r.u8()?, r.u8()?] != [CELL_POINTS as u8, BUCKET_ENTRIES as u8] {
            return Err(StreamError::Value);
        }
        let scene_hash = r.u64()?;
        let mut capacity = Capacity {
            instances: r.u32()?,
            buckets: r.u32()?,
            cells: r.u32()?,
            ..Capacity::default()
        };
        let (max_body_bytes, max_raw_bytes) = (r.u32()?, r.u32()?);
        let (ao_distance_m, density, rate_hz) = (r.f32()?, r.f32()?, r.f32()?);
        let (threshold, step) = (r.u8()?, r.u8()?);
        if r.array::<2>()? != [0; 2] {
            return Err(StreamError::Value);
        }
        let beside = [r.u32()?, r.u32()?, r.u32()?, r.u32()?];
        let topology_hash = r.u64()?;
        let fits = match profile {
            Profile::Cells => step == 0 && beside == [0; 4] && topology_hash == 0,
            Profile::Residual => step > 0 && capacity.cells <= MAX_CELLS,
        };
        [
            capacity.slices,
            capacity.points,
            capacity.patches,
            capacity.topology_bytes,
        ] = beside;
        if !fits {
            return Err(StreamError::Value);
        }
        let in_range = (64..=MAX_BODY_BYTES).contains(&max_body_bytes)
            && max_raw_bytes <= MAX_RAW_BYTES
            && [ao_distance_m, density, rate_hz]
                .iter()
                .all(|v| v.is_finite() && *v >= 0.0);
        if !in_range {
            return Err(StreamError::Value);
        }
        Ok(Header {
            profile,
            kernel,
            scene_hash,
            capacity,
            max_body_bytes,
            max_raw_bytes,
            ao_distance_m,
            density,
            rate_hz,
            threshold,
            step,
            topology_hash,
        })
    }

    /// Writes a header packet's body.
    pub fn write(&self, w: &mut Writer<'_>) -> Result<(), StreamError> {
        w.u16(VERSION_MAJOR)?;
        w.u16(VERSION_MINOR)?;
        let sizes = [CELL_POINTS as u8, BUCKET_ENTRIES as u8];
        w.bytes(&[self.profile as u8, self.kernel as u8, sizes[0], sizes[1]])?;
        w.u64(self.scene_hash)?;
        let Capacity {
            instances,
            buckets,
            cells,
            slices,
            points,
            patches,
            topology_bytes,
        } = self.capacity;
        for value in [
            instances,
            buckets,
            cells,
            self.max_body_bytes,
            self.max_raw_bytes,
        ] {
            w.u32(value)?;
        }
        for value in [self.ao_distance_m, self.density, self.rate_hz] {
            w.f32(value)?;
        }
        w.bytes(&[self.threshold, self.step, 0, 0])?;
        for value in [slices, points, patches, topology_bytes] {
            w.u32(value)?;
        }
        w.u64(self.topology_hash)
    }
}

impl Frame {
    /// Reads the body of a frame's or a slices packet: the frame's fields, and the content after them.
    pub fn read(body: &[u8]) -> Result<(Frame, &[u8]), StreamError> {
        let mut r = Reader(body);
        let frame = Frame {
            id: r.u32()?,
            time_ns: r.u64()?,
            mirror_check: r.u32()?,
        };
        Ok((frame, r.0))
    }

    /// Writes the fields before the content.
    pub fn write(&self, w: &mut Writer<'_>) -> Result<(), StreamError> {
        w.u32(self.id)?;
        w.u64(self.time_ns)?;
        w.u32(self.mirror_check)
    }
}

/// Counts of what a frame packet changes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// Instances set.
    pub instances: u32,
    /// Buckets set.
    pub buckets: u32,
    /// Cells set.
    pub cells: u32,
}

/// Bytes of a frame packet's content before its lists.
pub const CHANGES_HEADER_BYTES: usize = 12;

/// Applies the decompressed content of a frame packet of profile `cells` to a mirror.
///
/// Lengths are checked before anything is changed. After any other error the mirror holds a part
/// of the changes and must be reset by a snapshot.
pub fn apply_changes<M: Memory>(
    raw: &[u8],
    mirror: &mut Mirror<M>,
) -> Result<Changes, StreamError> {
    let mut r = Reader(raw);
    let changes = Changes {
        instances: r.u32()?,
        buckets: r.u32()?,
        cells: r.u32()?,
    };
    let instances = r.list::<Instance>(changes.instances)?;
    let buckets = r.list::<Bucket>(changes.buckets)?;
    let cells = r.list::<Cell>(changes.cells)?;
    if !r.0.is_empty() {
        return Err(StreamError::Length);
    }
    instances.for_each(|index, value| mirror.set_instance(index, value))?;
    buckets.for_each(|index, value| mirror.set_bucket(index, value))?;
    cells.for_each(|index, value| mirror.set_cell(index, value))?;
    Ok(changes)
}

/// Elements with their indices: the gaps between the indices first, then the values.
struct List<'a, T> {
    gaps: &'a [u8],
    values: &'a [u8],
    kind: core::marker::PhantomData<T>,
}

impl<T: Pod> List<'_, T> {
    fn for_each(
        &self,
        mut set: impl FnMut(u32, T) -> Result<(), MirrorError>,
    ) -> Result<(), StreamError> {
        let mut next = 0u32;
        let values = self.values.chunks_exact(size_of::<T>());
        for (gap, value) in self.gaps.as_chunks::<4>().0.iter().zip(values) {
            let index = next
                .checked_add(u32::from_le_bytes(*gap))
                .ok_or(StreamError::Value)?;
            next = index.checked_add(1).ok_or(StreamError::Value)?;
            set(index, bytemuck::pod_read_unaligned(value))?;
        }
        Ok(())
    }
}

/// Reads little-endian values from the front of a slice.
#[derive(Clone, Copy, Debug)]
pub struct Reader<'a>(pub &'a [u8]);

impl<'a> Reader<'a> {
    /// The next `count` bytes.
    pub fn take(&mut self, count: usize) -> Result<&'a [u8], StreamError> {
        let (head, rest) = self.0.split_at_checked(count).ok_or(StreamError::Length)?;
        self.0 = rest;
        Ok(head)
    }

    /// The next `N` bytes.
    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], StreamError> {
        let (head, rest) = self.0.split_first_chunk().ok_or(StreamError::Length)?;
        self.0 = rest;
        Ok(*head)
    }

    /// A byte.
    pub fn u8(&mut self) -> Result<u8, StreamError> {
        self.array().map(|[byte]| byte)
    }

    /// Two bytes.
    pub fn u16(&mut self) -> Result<u16, StreamError> {
        self.array().map(u16::from_le_bytes)
    }

    /// Four bytes.
    pub fn u32(&mut self) -> Result<u32, StreamError> {
        self.array().map(u32::from_le_bytes)
    }

    /// Eight bytes.
    pub fn u64(&mut self) -> Result<u64, StreamError> {
        self.array().map(u64::from_le_bytes)
    }

    /// A float, any value.
    pub fn f32(&mut self) -> Result<f32, StreamError> {
        self.array().map(f32::from_le_bytes)
    }

    /// A double, any value.
    pub fn f64(&mut self) -> Result<f64, StreamError> {
        self.array().map(f64::from_le_bytes)
    }

    /// A number in 1 to 5 bytes: 7 bits each, low ones first; the high bit says that more follow.
    pub fn varint(&mut self) -> Result<u32, StreamError> {
        let mut value = 0u64;
        for shift in [0u32, 7, 14, 21, 28] {
            let byte = self.u8()?;
            value |= u64::from(byte & 127).wrapping_shl(shift);
            if byte & 128 == 0 {
                return u32::try_from(value).map_err(|_| StreamError::Value);
            }
        }
        Err(StreamError::Value)
    }

    fn list<T: Pod>(&mut self, count: u32) -> Result<List<'a, T>, StreamError> {
        let bytes = |each: usize| {
            (count as usize)
                .checked_mul(each)
                .ok_or(StreamError::Length)
        };
        let gaps = self.take(bytes(4)?)?;
        let values = self.take(bytes(size_of::<T>())?)?;
        Ok(List {
            gaps,
            values,
            kind: core::marker::PhantomData,
        })
    }
}

/// Writes little-endian values into a slice.
#[derive(Debug)]
pub struct Writer<'a> {
    out: &'a mut [u8],
    length: usize,
}

impl<'a> Writer<'a> {
    /// Writes from the start of `out`.
    pub fn new(out: &'a mut [u8]) -> Writer<'a> {
        Writer { out, length: 0 }
    }

    /// Bytes written.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Bytes as they are.
    pub fn bytes(&mut self, bytes: &[u8]) -> Result<(), StreamError> {
        let end = self
            .length
            .checked_add(bytes.len())
            .ok_or(StreamError::Length)?;
        let place = self
            .out
            .get_mut(self.length..end)
            .ok_or(StreamError::Length)?;
        place.copy_from_slice(bytes);
        self.length = end;
        Ok(())
    }

    /// Two bytes.
    pub fn u16(&mut self, value: u16) -> Result<(), StreamError> {
        self.bytes(&value.to_le_bytes())
    }

    /// Four bytes.
    pub fn u32(&mut self, value: u32) -> Result<(), StreamError> {
        self.bytes(&value.to_le_bytes())
    }

    /// Eight bytes.
    pub fn u64(&mut self, value: u64) -> Result<(), StreamError> {
        self.bytes(&value.to_le_bytes())
    }

    /// A number as [`Reader::varint`] reads it.
    pub fn varint(&mut self, mut value: u32) -> Result<(), StreamError> {
        while value > 127 {
            self.bytes(&[value as u8 | 128])?;
            value >>= 7;
        }
        self.bytes(&[value as u8])
    }

    /// A float.
    pub fn f32(&mut self, value: f32) -> Result<(), StreamError> {
        self.bytes(&value.to_le_bytes())
    }

    /// A double.
    pub fn f64(&mut self, value: f64) -> Result<(), StreamError> {
        self.bytes(&value.to_le_bytes())
    }

    /// A list of elements with rising indices, as a frame's content holds it.
    pub fn list<T: Pod>(&mut self, elements: &[(u32, T)]) -> Result<(), StreamError> {
        let mut next = 0;
        for (index, _) in elements {
            self.u32(index.checked_sub(next).ok_or(StreamError::Value)?)?;
            next = index.saturating_add(1);
        }
        elements
            .iter()
            .try_for_each(|(_, value)| self.bytes(bytemuck::bytes_of(value)))
    }
}

#[cfg(target_endian = "big")]
compile_error!("the mirror is read from and hashed over little-endian memory");
