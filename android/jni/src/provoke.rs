//! Only for tests, behind the feature `provoke`: what must never happen, and what Java itself
//! cannot do.

use crate::client::{psao_client_restart, with};
use crate::native::at;
use crate::result::psao_result::PSAO_ERROR_INTERNAL;
use jni::EnvUnowned;
use jni::errors::{Error, ThrowRuntimeExAndDefault};
use jni::objects::{JClass, JObject};
use jni::sys::{jint, jlong};

/// A panic in a client's function.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Provoke_panicOfClient(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    address: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: as org.psao.Native's.
    unsafe { with(at(address), |_| panic!("provoked")) as jint }
}

/// A panic on the way from Java to it.
#[unsafe(no_mangle)]
pub extern "system" fn Java_org_psao_Provoke_panicOnTheWay(
    mut env: EnvUnowned<'_>,
    _: JClass<'_>,
) -> jint {
    let outcome = env.with_env(|_| -> Result<jint, Error> { panic!("provoked") });
    outcome.resolve::<ThrowRuntimeExAndDefault>()
}

/// Restarts a client on a thread that Java does not know, which logs.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn Java_org_psao_Provoke_restartElsewhere(
    _: EnvUnowned<'_>,
    _: JClass<'_>,
    address: jlong,
    _keep: JObject<'_>,
) -> jint {
    // SAFETY: as org.psao.Native's; this thread waits, so that it is still one pusher.
    let thread = std::thread::spawn(move || unsafe { psao_client_restart(at(address)) as jint });
    thread.join().unwrap_or(PSAO_ERROR_INTERNAL as jint)
}
