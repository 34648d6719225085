//! The native methods of `org.psao.Native`.
//!
//! Java passes addresses: of a client, of direct buffers that it looked up once, of words that it
//! reads results from. It keeps what they point to alive by passing the objects too, as `_keep`;
//! it makes sure that a side of a client is one thread at a time, and checks lengths. So these
//! functions are as safe as `org.psao` is, and that class is visible to nobody else.
//!
//! What is called every frame looks nothing up in the virtual machine. Answers are a `psao_result`
//! if below 0.

use crate::client::*;
use crate::log::{Log, log};
use crate::result::psao_result::{self, *};
use crate::result::psao_result_str;
use crate::types::*;
use crate::uplink::*;
use jni::EnvUnowned;
use jni::errors::{Error, ThrowRuntimeExAndDefault};
use jni::objects::{JByteArray, JByteBuffer, JClass, JDoubleArray, JLongArray, JObject, JString};
use jni::sys::{jdouble, jfloat, jint, jlong};
use psao::memory::Line;
use std::ffi::{CStr, c_char};

/// `PsaoConfig.WORDS`.
const CONFIG_WORDS: usize = 12;

/// A pointer, from Java's `long`.
pub(crate) fn at<T>(address: jlong) -> *mut T {
    address as usize as *mut T
}

/// Writes what Java reads.
///
/// # Safety
/// `words` is the address of as many as there are values.
unsafe fn say<const N: usize>(words: jlong, values: [u64; N]) {
    // SAFETY: the caller's word.
    unsafe { at::<[u64; N]>(words).write_unaligned(values) }
}

/// How many were written, or what failed.
pub(crate) fn count(result: psao_result, count: usize) -> jint {
    if (result as i32) < 0 {
        result as i32
    } else {
        // Java's lengths are int, and none is exceeded.
        count as jint
    }
}

/// A config as Java has it.
pub(crate) fn config(words: [i64; CONFIG_WORDS]) -> Result<psao_config, psao_result> {
    let count = |at: usize| u32::try_from(words[at]).map_err(|_| PSAO_ERROR_VALUE);
    Ok(psao_config {
        two_threads: count(0)?,
        scene_hash: words[1] as u64,
        stale_after_ns: u64::try_from(words[2]).map_err(|_| PSAO_ERROR_VALUE)?,
        instance_count: count(3)?,
        bucket_count: count(4)?,
        cell_count: count(5)?,
        slice_count: count(6)?,
        point_count: count(7)?,
        patch_count: count(8)?,
        topology_bytes: count(9)?,
        max_body_bytes: count(10)?,
        max_raw_bytes: count(11)?,
        ..psao_config::default()
    })
}

/// Reads a config, and does something with it that says what failed.
fn with_config(
    env: &mut EnvUnowned<'_>,
    words: &JLongArray<'_>,
    body: impl FnOnce(&psao_config) -> jlong,
) -> jlong {
    let outcome = env.with_env(|env| -> Result<jlong, Error> {
        let mut values = [0; CONFIG_WORDS];
        words.get_region(env, 0, &mut values)?;
        Ok(match config(values) {
            Ok(config) => body(&config),
            Err(result) => result as jlong,
        })
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

/// A sentence that a C function writes, as a Java string.
fn string<'a>(
    env: &mut EnvUnowned<'a>,
    write: impl FnOnce(&mut [c_char; 513]) -> Option<&CStr>,
) -> JString<'a> {
    let outcome = env.with_env(|env| -> Result<JString<'a>, Error> {
        let mut room = [0; 513];
        let text = write(&mut room).map(CStr::to_string_lossy);
        env.new_string(text.unwrap_or_default())
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Native_version(_: EnvUnowned<'_>, _: JClass<'_>) -> jint {
    crate::version::PSAO_VERSION as jint
}

#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Native_resultText<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    result: jint,
) -> JString<'a> {
    // SAFETY: the function answers a string that lives forever.
    string(&mut env, |_| unsafe {
        Some(CStr::from_ptr(psao_result_str(result)))
    })
}

/// Address of a direct buffer's first byte; 0 if it is not direct.
#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Native_address<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    buffer: JByteBuffer<'a>,
) -> jlong {
    let outcome = env.with_env(|env| -> Result<jlong, Error> {
        Ok(env
            .get_direct_buffer_address(&buffer)
            .map_or(0, |p| p as jlong))
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_configFromStream<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    input: jlong,
    input_bytes: jint,
    out_config: JLongArray<'a>,
    _keep: JObject<'a>,
) -> jint {
    let outcome = env.with_env(|env| -> Result<jint, Error> {
        let mut config = psao_config::default();
        // SAFETY: the module's rules.
        let result =
            unsafe { psao_config_from_stream(at(input), input_bytes as usize, &mut config) };
        if result == PSAO_OK {
            let counts = [
                config.instance_count,
                config.bucket_count,
                config.cell_count,
                config.slice_count,
                config.point_count,
                config.patch_count,
                config.topology_bytes,
                config.max_body_bytes,
                config.max_raw_bytes,
            ];
            out_config.set_region(env, 3, &counts.map(jlong::from))?;
        }
        Ok(result as jint)
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

/// Bytes of a block in which a client has room, however the block is aligned.
#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Native_blockBytes<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    config: JLongArray<'a>,
) -> jlong {
    with_config(&mut env, &config, |config| {
        let (mut bytes, mut align) = (0, 0);
        // SAFETY: the pointers are those of values.
        match unsafe { psao_client_memory_size(config, &mut bytes, &mut align) } {
            PSAO_OK => bytes as jlong + (align as jlong - 1),
            result => result as jlong,
        }
    })
}

/// Takes over the log, which must be closed once the client is not used any more.
#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Native_openLog<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    object: JObject<'a>,
) -> jlong {
    let outcome = env.with_env(|env| -> Result<jlong, Error> {
        Ok(Box::into_raw(Box::new(Log::new(env, &object)?)) as jlong)
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_closeLog<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    log: jlong,
) {
    let outcome = env.with_env(|_| -> Result<(), Error> {
        // SAFETY: openLog's, and closed once.
        drop(unsafe { Box::from_raw(at::<Log>(log)) });
        Ok(())
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

/// words: the client's address.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_init<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    config: JLongArray<'a>,
    block: jlong,
    block_bytes: jlong,
    log_object: jlong,
    words: jlong,
) -> jint {
    let result = with_config(&mut env, &config, |config| {
        let mut config = *config;
        if log_object != 0 {
            config.log = Some(log);
            config.log_user_data = at(log_object);
        }
        let block: *mut u8 = at(block);
        let past = block.align_offset(align_of::<Line>());
        let mut client = std::ptr::null_mut();
        // SAFETY: the module's rules; the block has so many bytes.
        unsafe {
            let room = (block_bytes as usize).saturating_sub(past);
            let result =
                psao_client_init(&config, block.wrapping_add(past).cast(), room, &mut client);
            if result == PSAO_OK {
                say(words, [client as u64]);
            }
            result as jlong
        }
    });
    result as jint
}

/// 256 times the bytes that were used, and a result.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_push(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    input: jlong,
    input_bytes: jint,
    now_ns: jlong,
    _keep: JObject<'_>,
    _keep_input: JObject<'_>,
) -> jlong {
    let mut used = 0;
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_client_push(
            at(client),
            at(input),
            input_bytes as usize,
            now_ns as u64,
            &mut used,
        )
    };
    if (result as i32) < 0 {
        result as jlong
    } else {
        (used as jlong) << 8 | result as jlong
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_restart(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: the module's rules.
    unsafe { psao_client_restart(at(client)) as jint }
}

/// words: as `PsaoHeader` reads them.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_header(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    words: jlong,
    _keep: JObject<'_>,
    _keep_words: JObject<'_>,
) -> jint {
    let mut header = psao_header {
        struct_size: size_of::<psao_header>() as u32,
        ..psao_header::default()
    };
    // SAFETY: the module's rules.
    unsafe {
        let result = psao_client_header(at(client), &mut header);
        if result == PSAO_OK {
            let values = [
                header.profile.into(),
                header.kernel.into(),
                header.instance_count.into(),
                header.bucket_count.into(),
                header.cell_count.into(),
                header.scene_hash,
                header.ao_distance_m.to_bits().into(),
                header.density.to_bits().into(),
                header.rate_hz.to_bits().into(),
                header.threshold.into(),
            ];
            say(words, values);
        }
        result as jint
    }
}

/// words: state, live_ns.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_status(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    now_ns: jlong,
    words: jlong,
    _keep: JObject<'_>,
    _keep_words: JObject<'_>,
) -> jint {
    let mut status = psao_status {
        struct_size: size_of::<psao_status>() as u32,
        ..psao_status::default()
    };
    // SAFETY: the module's rules.
    unsafe {
        let result = psao_client_status(at(client), now_ns as u64, &mut status);
        if result == PSAO_OK {
            say(words, [status.state.into(), status.live_ns]);
        }
        result as jint
    }
}

/// words: the hash.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_topologyHash(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    words: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: the module's rules.
    unsafe { psao_client_topology_hash(at(client), at(words)) as jint }
}

/// words: as `PsaoStats` reads them.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_stats(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    words: jlong,
    _keep: JObject<'_>,
    _keep_words: JObject<'_>,
) -> jint {
    let mut stats = psao_stats {
        struct_size: size_of::<psao_stats>() as u32,
        ..psao_stats::default()
    };
    // SAFETY: the module's rules.
    unsafe {
        let result = psao_client_stats(at(client), &mut stats);
        if result == PSAO_OK {
            let values = [
                stats.frame_id.into(),
                stats.server_time_ns,
                stats.delay_ns,
                stats.mirror_hash,
                stats.stream_bytes,
                stats.frame_count,
                stats.snapshot_count,
                stats.discarded_count,
                stats.merged_count,
                stats.instance_count,
                stats.bucket_count,
                stats.cell_count,
                stats.slice_count,
                stats.patch_count,
            ];
            say(words, values);
        }
        result as jint
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_errorText<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    client: jlong,
    _keep: JObject<'a>,
) -> JString<'a> {
    string(&mut env, |room| {
        // SAFETY: the module's rules; there is room for the longest text.
        let result = unsafe {
            psao_client_error_text(
                at(client),
                room.as_mut_ptr(),
                room.len(),
                std::ptr::null_mut(),
            )
        };
        // SAFETY: it was written, with its end.
        (result == PSAO_OK).then(|| unsafe { CStr::from_ptr(room.as_ptr()) })
    })
}

/// words: as `PsaoFrame` reads them.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_take(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    words: jlong,
    _keep: JObject<'_>,
) -> jint {
    let mut frame = psao_frame {
        struct_size: size_of::<psao_frame>() as u32,
        frame_id: 0,
        server_time_ns: 0,
        kernel: 0,
        instance_count: 0,
        bucket_count: 0,
        cell_count: 0,
        instances: std::ptr::null(),
        buckets: std::ptr::null(),
        cells: std::ptr::null(),
    };
    // SAFETY: the module's rules.
    unsafe {
        let result = psao_client_take(at(client), &mut frame);
        if result == PSAO_OK {
            let values = [
                frame.frame_id.into(),
                frame.server_time_ns,
                frame.kernel.into(),
                frame.instance_count.into(),
                frame.bucket_count.into(),
                frame.cell_count.into(),
                frame.instances as u64,
                frame.buckets as u64,
                frame.cells as u64,
            ];
            say(words, values);
        }
        result as jint
    }
}

/// How many `psao_range` were written.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_dirtyRanges(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    buffer: jint,
    join_count: jint,
    ranges: jlong,
    capacity_count: jint,
    _keep: JObject<'_>,
) -> jint {
    let mut written = 0;
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_client_dirty_ranges(
            at(client),
            buffer as u32,
            join_count as u32,
            at(ranges),
            capacity_count as u32,
            &mut written,
        )
    };
    count(result, written as usize)
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_tagBuckets(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    first_index: jint,
    count: jint,
    out_buckets: jlong,
    _keep: JObject<'_>,
    _keep_out: JObject<'_>,
) -> jint {
    let (first, count, out) = (first_index as u32, count as u32, at(out_buckets));
    // SAFETY: the module's rules.
    unsafe { psao_client_tag_buckets(at(client), first, count, out) as jint }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_lookup(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    instance_index: jint,
    positions: jlong,
    normals: jlong,
    count: jint,
    out_openness: jlong,
    _keep: JObject<'_>,
    _keep_positions: JObject<'_>,
    _keep_normals: JObject<'_>,
    _keep_out: JObject<'_>,
) -> jint {
    let (count, out) = (count as usize, at(out_openness));
    let (positions, normals) = (at(positions), at(normals));
    // SAFETY: the module's rules.
    unsafe {
        psao_client_lookup(
            at(client),
            instance_index as u32,
            positions,
            normals,
            count,
            out,
        ) as jint
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_release(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: the module's rules.
    unsafe { psao_client_release(at(client)) as jint }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_markAllDirty(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    client: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: the module's rules.
    unsafe { psao_client_mark_all_dirty(at(client)) as jint }
}

/// Bytes of the message, as with all that follow.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_hello<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    uplink: jlong,
    config: JLongArray<'a>,
    token: JByteArray<'a>,
    topology_hash: jlong,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'a>,
) -> jint {
    let bytes = env.with_env(|env| -> Result<Vec<u8>, Error> { env.convert_byte_array(&token) });
    let token = bytes.resolve::<ThrowRuntimeExAndDefault>();
    let result = with_config(&mut env, &config, |config| {
        let mut written = 0;
        // SAFETY: the module's rules.
        let result = unsafe {
            psao_uplink_hello(
                at(uplink),
                config,
                token.as_ptr(),
                token.len(),
                topology_hash as u64,
                at(out),
                capacity_bytes as usize,
                &mut written,
            )
        };
        count(result, written).into()
    });
    result as jint
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_camera(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    uplink: jlong,
    fov_y_rad: jfloat,
    aspect: jfloat,
    height_px: jint,
    position_x_m: jdouble,
    position_y_m: jdouble,
    position_z_m: jdouble,
    forward_x: jfloat,
    forward_y: jfloat,
    forward_z: jfloat,
    up_x: jfloat,
    up_y: jfloat,
    up_z: jfloat,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    let camera = psao_camera {
        struct_size: size_of::<psao_camera>() as u32,
        fov_y_rad,
        aspect,
        height_px: height_px as u32,
        position_m: [position_x_m, position_y_m, position_z_m],
        forward: [forward_x, forward_y, forward_z],
        up: [up_x, up_y, up_z],
    };
    let mut written = 0;
    // SAFETY: the module's rules.
    let result = unsafe {
        let capacity_bytes = capacity_bytes as usize;
        psao_uplink_camera(at(uplink), &camera, at(out), capacity_bytes, &mut written)
    };
    count(result, written)
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_transform<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    uplink: jlong,
    instance_index: jint,
    world_from_local: JDoubleArray<'a>,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'a>,
) -> jint {
    let outcome = env.with_env(|env| -> Result<jint, Error> {
        let mut matrix = [0.0; 12];
        world_from_local.get_region(env, 0, &mut matrix)?;
        let mut written = 0;
        // SAFETY: the module's rules.
        let result = unsafe {
            psao_uplink_transform(
                at(uplink),
                instance_index as u32,
                matrix.as_ptr(),
                at(out),
                capacity_bytes as usize,
                &mut written,
            )
        };
        Ok(count(result, written))
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_joints(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    uplink: jlong,
    instance_index: jint,
    local_from_rest: jlong,
    joint_count: jint,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
    _keep_joints: JObject<'_>,
) -> jint {
    let mut written = 0;
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_uplink_joints(
            at(uplink),
            instance_index as u32,
            at(local_from_rest),
            joint_count as u32,
            at(out),
            capacity_bytes as usize,
            &mut written,
        )
    };
    count(result, written)
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_presence(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    uplink: jlong,
    instance_index: jint,
    present: jint,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    let mut written = 0;
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_uplink_presence(
            at(uplink),
            instance_index as u32,
            present as u32,
            at(out),
            capacity_bytes as usize,
            &mut written,
        )
    };
    count(result, written)
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_ack(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    uplink: jlong,
    frame_id: jint,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    let (mut written, capacity_bytes) = (0, capacity_bytes as usize);
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_uplink_ack(
            at(uplink),
            frame_id as u32,
            at(out),
            capacity_bytes,
            &mut written,
        )
    };
    count(result, written)
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Native_resync(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    uplink: jlong,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    let mut written = 0;
    // SAFETY: the module's rules.
    let result =
        unsafe { psao_uplink_resync(at(uplink), at(out), capacity_bytes as usize, &mut written) };
    count(result, written)
}
