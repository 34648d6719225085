//! The native methods of `org.psao.NativeConnection`, by the rules of [`crate::native`].

use crate::connection::*;
use crate::native::{at, config, count};
use crate::result::psao_result;
use jni::errors::{Error, ThrowRuntimeExAndDefault};
use jni::objects::{JByteArray, JClass, JLongArray, JObject, JString};
use jni::sys::{jint, jlong};
use jni::{Env, EnvUnowned};
use std::ffi::{CStr, CString, c_char};

/// Room for a sentence about what failed.
const TEXT_BYTES: usize = 513;

/// A string of Java's in UTF-8, of which null is none.
fn string(env: &mut Env<'_>, bytes: &JByteArray<'_>) -> Result<Option<CString>, Error> {
    if bytes.is_null() {
        return Ok(None);
    }
    // A zero byte ends it, as in C.
    let mut bytes = env.convert_byte_array(bytes)?;
    let end = bytes.iter().position(|byte| *byte == 0);
    bytes.truncate(end.unwrap_or(bytes.len()));
    Ok(CString::new(bytes).ok())
}

/// The result, and the sentence behind it, in the words and the text that Java reads.
///
/// # Safety
/// `words` is the address of one word.
unsafe fn answer<'a>(
    env: &mut Env<'a>,
    words: jlong,
    result: jlong,
    text: &[c_char; TEXT_BYTES],
) -> Result<JString<'a>, Error> {
    // SAFETY: the caller's word; the text ends with a zero byte.
    let text = unsafe {
        at::<jlong>(words).write_unaligned(result);
        CStr::from_ptr(text.as_ptr())
    };
    env.new_string(text.to_string_lossy())
}

/// words: a result, and the connection. Answers a sentence about what failed.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_NativeConnection_open<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    address: JByteArray<'a>,
    server_name: JByteArray<'a>,
    token: JByteArray<'a>,
    fingerprint: JByteArray<'a>,
    roots_pem: JByteArray<'a>,
    topology_hash: jlong,
    config_words: JLongArray<'a>,
    words: jlong,
    _keep: JObject<'a>,
) -> JString<'a> {
    let outcome = env.with_env(|env| -> Result<JString<'a>, Error> {
        let mut values = [0; 12];
        config_words.get_region(env, 0, &mut values)?;
        let strings = [
            string(env, &address)?,
            string(env, &server_name)?,
            string(env, &token)?,
            string(env, &fingerprint)?,
            string(env, &roots_pem)?,
        ];
        let [address, server_name, token, fingerprint, roots_pem] = strings
            .each_ref()
            .map(|text| text.as_ref().map_or(std::ptr::null(), |t| t.as_ptr()));
        let connect = psao_connect {
            struct_size: size_of::<psao_connect>() as u32,
            address,
            server_name,
            token,
            fingerprint,
            roots_pem,
            topology_hash: topology_hash as u64,
        };
        let mut text = [0; TEXT_BYTES];
        let mut connection = std::ptr::null_mut();
        let result = match config(values) {
            Err(result) => result,
            // SAFETY: the pointers are those of values that live until it returns.
            Ok(config) => unsafe {
                psao_connection_open(
                    &connect,
                    &config,
                    text.as_mut_ptr(),
                    TEXT_BYTES,
                    &mut connection,
                )
            },
        };
        // SAFETY: the module's rules: there are two words.
        unsafe {
            at::<jlong>(words)
                .add(1)
                .write_unaligned(connection as jlong);
            answer(env, words, result as jlong, &text)
        }
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

/// How many bytes.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_NativeConnection_receive(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    connection: jlong,
    out: jlong,
    capacity_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    let mut came = 0;
    let (none, capacity_bytes) = (std::ptr::null_mut(), capacity_bytes as usize);
    // SAFETY: the module's rules.
    let result = unsafe {
        psao_connection_receive(at(connection), at(out), capacity_bytes, &mut came, none, 0)
    };
    count(result, came)
}

/// Why a connection is closed.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_NativeConnection_closedText<'a>(
    mut env: EnvUnowned<'a>,
    _: JClass<'a>,
    connection: jlong,
    words: jlong,
    _keep: JObject<'a>,
) -> JString<'a> {
    let outcome = env.with_env(|env| -> Result<JString<'a>, Error> {
        let (mut text, mut byte, mut came) = ([0; TEXT_BYTES], 0, 0);
        // SAFETY: the module's rules; nothing came, and there is room for nothing.
        unsafe {
            let result: psao_result = psao_connection_receive(
                at(connection),
                &mut byte,
                0,
                &mut came,
                text.as_mut_ptr(),
                TEXT_BYTES,
            );
            answer(env, words, result as jlong, &text)
        }
    });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_NativeConnection_send(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    connection: jlong,
    message: jlong,
    message_bytes: jint,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: the module's rules.
    unsafe { psao_connection_send(at(connection), at(message), message_bytes as usize) as jint }
}

#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_NativeConnection_close(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    connection: jlong,
) {
    // SAFETY: the module's rules; Java closes it once.
    unsafe { psao_connection_close(at(connection)) };
}
