//! What the client tells the server, as bytes for whatever transport there is.

use crate::client::{guarded, put, slice_of};
use crate::result::psao_result::{self, *};
use crate::types::*;
use psao::core::stream::{PACKET_HEADER_BYTES, StreamError, Writer, write_packet};
use psao::core::uplink::{
    self, Camera, Hello, MAX_JOINTS, MAX_TOKEN_BYTES, Presence, Transform, kind,
};

/// The longest message that psao_uplink_joints writes, with 4096 joints.
pub const PSAO_UPLINK_MAX_BYTES: u32 = 196628;

/// The longest message of any other psao_uplink_ function.
pub const PSAO_UPLINK_SMALL_BYTES: u32 = 384;

const _: () = assert!(
    PSAO_UPLINK_MAX_BYTES == PACKET_HEADER_BYTES as u32 + uplink::MAX_UPLINK_BODY_BYTES - 8
);

/// Writes one message; all values were checked before, so that only room can be missing.
///
/// # Safety
/// The pointers are as the functions below describe.
unsafe fn message(
    uplink: *mut psao_uplink,
    (out, capacity_bytes, out_bytes): (*mut u8, usize, *mut usize),
    kind: u8,
    body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
) -> Result<psao_result, psao_result> {
    if uplink.is_null() || out.is_null() || out_bytes.is_null() {
        return Err(PSAO_ERROR_NULL);
    }
    let room = capacity_bytes.min(PSAO_UPLINK_MAX_BYTES as usize);
    // SAFETY: not null, and the caller's word for the rest.
    unsafe {
        let sequence = (*uplink).next_sequence;
        let out = core::slice::from_raw_parts_mut(out, room);
        let written = match write_packet(out, kind, 0, sequence as u16, body) {
            Err(StreamError::Length) => return Err(PSAO_ERROR_OUTPUT_SIZE),
            written => written?,
        };
        (*uplink).next_sequence = sequence.wrapping_add(1);
        put(out_bytes, written)?;
    }
    Ok(PSAO_OK)
}

/// Writes the first message of every connection: who you are, and how much you can hold. Sets
/// uplink to begin.
///
/// config: the client's; the server refuses a scene that needs larger counts. token, token_bytes:
/// at most 256 bytes, the one that the server was started with. topology_hash: of
/// psao_client_topology_hash; 0 for a new client.
///
/// out: capacity_bytes; PSAO_UPLINK_SMALL_BYTES are enough. out_bytes: how long the message is.
///
/// PSAO_ERROR_VALUE: the token is too long. PSAO_ERROR_OUTPUT_SIZE: out is too small; what is in
/// it is then undefined.
///
/// Threads: exclusive per psao_uplink. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_hello(
    uplink: *mut psao_uplink,
    config: *const psao_config,
    token: *const u8,
    token_bytes: usize,
    topology_hash: u64,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let config = read_struct(config)?;
        let token = slice_of(token, token_bytes)?;
        if token.len() > MAX_TOKEN_BYTES {
            return Err(PSAO_ERROR_VALUE);
        }
        let hello = Hello {
            token,
            scene_hash: config.scene_hash,
            capacity: config.limits().capacity,
            topology_hash,
        };
        if uplink.is_null() {
            return Err(PSAO_ERROR_NULL);
        }
        let mut first = psao_uplink::default();
        let out = (out, capacity_bytes, out_bytes);
        let result = message(&mut first, out, kind::HELLO, |w| hello.write(w))?;
        uplink.write(first);
        Ok(result)
    })
}

/// Writes where you look from. Send it when it changes, at most once a frame; as a datagram if
/// the transport has them, with a psao_uplink of its own.
///
/// PSAO_ERROR_VALUE: a value is outside the range that psao_camera says, or not finite.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_camera(
    uplink: *mut psao_uplink,
    camera: *const psao_camera,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let camera = read_struct(camera)?;
        let camera = Camera {
            position_m: camera.position_m,
            forward: camera.forward,
            up: camera.up,
            fov_y_rad: camera.fov_y_rad,
            aspect: camera.aspect,
            height_px: camera.height_px,
        };
        if !camera.is_usable() {
            return Err(PSAO_ERROR_VALUE);
        }
        let out = (out, capacity_bytes, out_bytes);
        message(uplink, out, kind::CAMERA, |w| camera.write(w))
    })
}

/// Writes that you moved an instance: from then on this places it, and not the scene's animation.
///
/// world_from_local: 12 doubles, three rows of four, metres, the translation in the fourth column.
///
/// PSAO_ERROR_VALUE: a value is not finite.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_transform(
    uplink: *mut psao_uplink,
    instance_index: u32,
    world_from_local: *const f64,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let [world_from_local] = slice_of(world_from_local.cast::<[[f64; 4]; 3]>(), 1)? else {
            return Err(PSAO_ERROR_INTERNAL);
        };
        if !world_from_local
            .as_flattened()
            .iter()
            .all(|value| value.is_finite())
        {
            return Err(PSAO_ERROR_VALUE);
        }
        let transform = Transform {
            instance: instance_index,
            world_from_local: *world_from_local,
        };
        let out = (out, capacity_bytes, out_bytes);
        message(uplink, out, kind::TRANSFORM, |w| transform.write(w))
    })
}

/// Writes how you posed a skinned instance.
///
/// local_from_rest: 12 floats a joint, three rows of four: what takes a vertex from rest space to
/// local space. joint_count: the skin's, at most 4096.
///
/// out: 20 bytes and 48 a joint, at most PSAO_UPLINK_MAX_BYTES.
///
/// PSAO_ERROR_VALUE: a value is not finite, or there are too many joints.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_joints(
    uplink: *mut psao_uplink,
    instance_index: u32,
    local_from_rest: *const f32,
    joint_count: u32,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        if joint_count > MAX_JOINTS {
            return Err(PSAO_ERROR_VALUE);
        }
        let joints: &[[[f32; 4]; 3]] = slice_of(local_from_rest.cast(), joint_count as usize)?;
        let finite = |joint: &[[f32; 4]; 3]| joint.as_flattened().iter().all(|v| v.is_finite());
        if !joints.iter().all(finite) {
            return Err(PSAO_ERROR_VALUE);
        }
        let out = (out, capacity_bytes, out_bytes);
        message(uplink, out, kind::JOINTS, |w| {
            uplink::write_joints(w, instance_index, joints)
        })
    })
}

/// Writes that you took an instance out of the scene, or put it back: what is out has no points
/// and occludes nothing. All are in at first. To swap an instance's mesh, have an instance for
/// each mesh, and put one of them in.
///
/// present: 1 if it is in the scene, 0 if it is not.
///
/// PSAO_ERROR_VALUE: present is neither.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_presence(
    uplink: *mut psao_uplink,
    instance_index: u32,
    present: u32,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        if present > 1 {
            return Err(PSAO_ERROR_VALUE);
        }
        let presence = Presence {
            instance: instance_index,
            present: present == 1,
        };
        let out = (out, capacity_bytes, out_bytes);
        message(uplink, out, kind::PRESENCE, |w| presence.write(w))
    })
}

/// Writes that a frame is in your mirror. Optional; a later one makes up for one that is lost.
///
/// frame_id: of psao_frame or psao_stats.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_ack(
    uplink: *mut psao_uplink,
    frame_id: u32,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    let out = (out, capacity_bytes, out_bytes);
    // SAFETY: the caller's word.
    guarded(|| unsafe { message(uplink, out, kind::ACK, |w| w.u32(frame_id)) })
}

/// Writes that you need a snapshot, after PSAO_RESYNC.
///
/// out, capacity_bytes, out_bytes, Threads and the rest as psao_uplink_hello. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_uplink_resync(
    uplink: *mut psao_uplink,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    let out = (out, capacity_bytes, out_bytes);
    // SAFETY: the caller's word.
    guarded(|| unsafe { message(uplink, out, kind::RESYNC, |_| Ok(())) })
}
