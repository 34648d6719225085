//! What the client tells the server: packets in the same frame as the stream's.
//!
//! The first message on the control stream is [`Hello`]; then any of the others in any order.
//! Cameras and acknowledgements may also come as datagrams: one packet each, old ones dropped.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::mirror::Capacity;
use crate::stream::{Packet, Reader, StreamError, VERSION_MAJOR, VERSION_MINOR, Writer};

/// Longest token, bytes.
pub const MAX_TOKEN_BYTES: usize = 256;

/// Most joints in one message.
pub const MAX_JOINTS: u32 = 4096;

/// Largest body of an uplink packet.
pub const MAX_UPLINK_BODY_BYTES: u32 = 16 + MAX_JOINTS * 48;

/// What an uplink packet is.
pub mod kind {
    /// [`super::Hello`]
    pub const HELLO: u8 = 64;
    /// [`super::Camera`]
    pub const CAMERA: u8 = 65;
    /// [`super::Transform`]
    pub const TRANSFORM: u8 = 66;
    /// [`super::Joints`]
    pub const JOINTS: u8 = 67;
    /// [`super::Message::Ack`]
    pub const ACK: u8 = 68;
    /// [`super::Message::Resync`]
    pub const RESYNC: u8 = 69;
}

/// The client introduces itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hello<'a> {
    /// Bearer token, at most [`MAX_TOKEN_BYTES`].
    pub token: &'a [u8],
    /// Hash of the client's scene; 0 accepts any.
    pub scene_hash: u64,
    /// Room the client has. The server refuses a scene that needs more, but for points and cells
    /// of profile `residual`: of those it keeps what is in view.
    pub capacity: Capacity,
    /// [`crate::stream::Header::topology_hash`] of the patches that the client has already, all of
    /// them; 0 if it has none.
    pub topology_hash: u64,
}

/// Where the client looks from: decides what is sent first, and what not at all.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Camera {
    /// World position, metres.
    pub position_m: [f64; 3],
    /// Unit view direction.
    pub forward: [f32; 3],
    /// Unit up direction, not parallel to `forward`.
    pub up: [f32; 3],
    /// Vertical field of view, radians, 0 to π.
    pub fov_y_rad: f32,
    /// Width over height.
    pub aspect: f32,
    /// Rows of the picture; 0 if it is not to decide the level of detail.
    pub height_px: u32,
}

/// The engine moved an instance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    /// Instance index.
    pub instance: u32,
    /// World from local, metres: three rows of four.
    pub world_from_local: [[f64; 4]; 3],
}

/// The engine posed a skinned instance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joints<'a> {
    /// Instance index.
    pub instance: u32,
    /// Little-endian floats, three rows of four a joint: local from rest.
    matrices: &'a [u8],
}

impl<'a> Joints<'a> {
    /// Number of joints.
    pub fn count(&self) -> usize {
        self.matrices.len() / 48
    }

    /// The matrices, local from rest, three rows of four; all finite.
    pub fn matrices(&self) -> impl Iterator<Item = [[f32; 4]; 3]> + 'a {
        self.matrices
            .as_chunks::<48>()
            .0
            .iter()
            .map(|bytes| bytemuck::pod_read_unaligned(bytes))
    }
}

/// Any uplink message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message<'a> {
    /// First.
    Hello(Hello<'a>),
    /// View.
    Camera(Camera),
    /// Moved instance.
    Transform(Transform),
    /// Posed instance.
    Joints(Joints<'a>),
    /// The frame with this id is in the client's mirror.
    Ack(u32),
    /// The client's mirror is not what it should be: a snapshot is needed.
    Resync,
}

impl<'a> Message<'a> {
    /// Reads a message. `None`: an unknown kind that may be skipped. Bytes after a hello's known
    /// fields belong to a newer minor version and are ignored.
    pub fn read(packet: &Packet<'a>) -> Result<Option<Message<'a>>, StreamError> {
        let mut r = Reader(packet.body);
        if (kind::HELLO..=kind::RESYNC).contains(&packet.kind) {
            packet.check_flags(0)?;
        }
        let message = match packet.kind {
            kind::HELLO => {
                let major = r.u16()?;
                if major != VERSION_MAJOR {
                    return Err(StreamError::Version(major));
                }
                let _minor = r.u16()?;
                let scene_hash = r.u64()?;
                let capacity = Capacity {
                    instances: r.u32()?,
                    buckets: r.u32()?,
                    cells: r.u32()?,
                    slices: r.u32()?,
                    points: r.u32()?,
                    patches: r.u32()?,
                    topology_bytes: r.u32()?,
                };
                let topology_hash = r.u64()?;
                let token_bytes = r.u16()? as usize;
                if token_bytes > MAX_TOKEN_BYTES {
                    return Err(StreamError::Value);
                }
                let token = r.take(token_bytes)?;
                return Ok(Some(Message::Hello(Hello {
                    token,
                    scene_hash,
                    capacity,
                    topology_hash,
                })));
            }
            kind::CAMERA => {
                let camera = Camera {
                    position_m: [r.f64()?, r.f64()?, r.f64()?],
                    forward: [r.f32()?, r.f32()?, r.f32()?],
                    up: [r.f32()?, r.f32()?, r.f32()?],
                    fov_y_rad: r.f32()?,
                    aspect: r.f32()?,
                    height_px: r.u32()?,
                };
                if !camera.is_usable() {
                    return Err(StreamError::Value);
                }
                Message::Camera(camera)
            }
            kind::TRANSFORM => {
                let instance = r.u32()?;
                let mut world_from_local = [[0.0; 4]; 3];
                for value in world_from_local.as_flattened_mut() {
                    *value = r.f64()?;
                    if !value.is_finite() {
                        return Err(StreamError::Value);
                    }
                }
                Message::Transform(Transform {
                    instance,
                    world_from_local,
                })
            }
            kind::JOINTS => {
                let (instance, count) = (r.u32()?, r.u32()?);
                if count > MAX_JOINTS {
                    return Err(StreamError::Value);
                }
                let matrices = r.take((count as usize).saturating_mul(48))?;
                let floats = matrices.as_chunks::<4>().0;
                if !floats
                    .iter()
                    .all(|bytes| f32::from_le_bytes(*bytes).is_finite())
                {
                    return Err(StreamError::Value);
                }
                Message::Joints(Joints { instance, matrices })
            }
            kind::ACK => Message::Ack(r.u32()?),
            kind::RESYNC => Message::Resync,
            _ if packet.flags & crate::stream::flag::OPTIONAL != 0 => return Ok(None),
            other => return Err(StreamError::Kind(other)),
        };
        if r.0.is_empty() {
            Ok(Some(message))
        } else {
            Err(StreamError::Length)
        }
    }
}

impl Hello<'_> {
    /// Writes the body of a [`kind::HELLO`] packet.
    pub fn write(&self, w: &mut Writer<'_>) -> Result<(), StreamError> {
        if self.token.len() > MAX_TOKEN_BYTES {
            return Err(StreamError::Value);
        }
        w.u16(VERSION_MAJOR)?;
        w.u16(VERSION_MINOR)?;
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
            slices,
            points,
            patches,
            topology_bytes,
        ] {
            w.u32(value)?;
        }
        w.u64(self.topology_hash)?;
        w.u16(self.token.len() as u16)?;
        w.bytes(self.token)
    }
}

impl Camera {
    /// All finite, directions not zero, field of view and aspect in range.
    pub fn is_usable(&self) -> bool {
        let length = |v: &[f32; 3]| v.iter().map(|x| x.abs()).sum::<f32>();
        self.position_m.iter().all(|v| v.is_finite())
            && [&self.forward, &self.up]
                .iter()
                .all(|v| length(v).is_finite() && length(v) > 1e-6)
            && self.fov_y_rad > 0.0
            && self.fov_y_rad < core::f32::consts::PI
            && self.aspect > 1e-3
            && self.aspect < 1e3
    }

    /// Writes the body of a [`kind::CAMERA`] packet.
    pub fn write(&self, w: &mut Writer<'_>) -> Result<(), StreamError> {
        self.position_m.iter().try_for_each(|v| w.f64(*v))?;
        self.forward
            .iter()
            .chain(&self.up)
            .try_for_each(|v| w.f32(*v))?;
        w.f32(self.fov_y_rad)?;
        w.f32(self.aspect)?;
        w.u32(self.height_px)
    }
}

impl Transform {
    /// Writes the body of a [`kind::TRANSFORM`] packet.
    pub fn write(&self, w: &mut Writer<'_>) -> Result<(), StreamError> {
        w.u32(self.instance)?;
        self.world_from_local
            .as_flattened()
            .iter()
            .try_for_each(|v| w.f64(*v))
    }
}

/// Writes the body of a [`kind::JOINTS`] packet: `matrices` local from rest.
pub fn write_joints(
    w: &mut Writer<'_>,
    instance: u32,
    matrices: &[[[f32; 4]; 3]],
) -> Result<(), StreamError> {
    if matrices.len() > MAX_JOINTS as usize {
        return Err(StreamError::Value);
    }
    w.u32(instance)?;
    w.u32(matrices.len() as u32)?;
    w.bytes(bytemuck::cast_slice(matrices))
}
