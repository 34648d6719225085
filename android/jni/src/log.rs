//! A client's messages, to Java.

use crate::client::guarded;
use crate::result::psao_result::PSAO_OK;
use jni::objects::{JObject, JValue};
use jni::refs::Weak;
use jni::vm::JavaVM;
use jni::{Env, errors::Error, jni_sig, jni_str};
use std::ffi::{c_char, c_void};

/// Where messages go: `psao_config.log_user_data`.
pub struct Log {
    vm: JavaVM,
    /// The client holds the object. A client that nobody closes must not hold it forever.
    object: Weak<JObject<'static>>,
}

impl Log {
    /// To an `org.psao.PsaoLog`.
    pub fn new(env: &Env<'_>, object: &JObject<'_>) -> Result<Log, Error> {
        Ok(Log {
            vm: env.get_java_vm()?,
            object: env.new_weak_ref(object)?,
        })
    }
}

/// A `psao_log`, on whatever thread: one that Java does not know yet is attached until it ends.
///
/// # Safety
/// `user_data` is a live [`Log`]; `message` has `message_bytes`.
pub unsafe extern "C" fn log(
    user_data: *mut c_void,
    level: u32,
    message: *const c_char,
    message_bytes: usize,
) {
    guarded(|| {
        // SAFETY: the caller's word.
        let (log, bytes) = unsafe {
            let log: &Log = &*user_data.cast();
            (
                log,
                std::slice::from_raw_parts(message.cast(), message_bytes),
            )
        };
        let text = String::from_utf8_lossy(bytes);
        let said = log.vm.attach_current_thread(|env| -> Result<(), Error> {
            let Some(object) = log.object.upgrade_local(env)? else {
                return Ok(());
            };
            let text = env.new_string(&text)?;
            let words = [JValue::Int(level as i32), JValue::Object(&text)];
            let signature = jni_sig!((level: jint, message: JString) -> ());
            env.call_method(&object, jni_str!("log"), signature, &words)?;
            Ok(())
        });
        // What the object throws has nobody to go to: it was asked to listen.
        let _ = said;
        Ok(PSAO_OK)
    });
}
