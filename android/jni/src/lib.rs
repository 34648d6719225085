//! `libpsao_jni`: libpsao, and what its Java API (`android/api`) calls, in one library.
//!
//! ```text
//! org.psao.PsaoClient ─► native.rs ─► psao_client_…, psao_uplink_… ─► psao
//! ```
//! It has the sources of libpsao, not a second library, so that an app carries one: native code
//! links this one by way of `include/psao.h`, and may use the very clients that Java made
//! (`PsaoClient.nativeClient`). Java gets the same hand-off between its threads and the same
//! results as C, and each function is documented once, in the header and in Java.

#![allow(non_camel_case_types)]

#[path = "../../../sdk/ffi/src/border.rs"]
pub mod border;
#[path = "../../../sdk/ffi/src/client.rs"]
pub mod client;
#[cfg(feature = "quic")]
#[path = "../../../sdk/ffi/src/connection.rs"]
pub mod connection;
#[path = "../../../sdk/ffi/src/front.rs"]
pub mod front;
#[path = "../../../sdk/ffi/src/handoff.rs"]
pub mod handoff;
#[path = "../../../sdk/ffi/src/result.rs"]
pub mod result;
#[path = "../../../sdk/ffi/src/sync.rs"]
pub mod sync;
#[path = "../../../sdk/ffi/src/types.rs"]
pub mod types;
#[path = "../../../sdk/ffi/src/uplink.rs"]
pub mod uplink;
#[path = "../../../sdk/ffi/src/version.rs"]
pub mod version;

mod log;
mod native;
#[cfg(feature = "quic")]
mod native_connection;
#[cfg(feature = "provoke")]
mod provoke;
