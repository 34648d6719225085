//! `libpsao`: the C ABI of the PSAO client. `include/psao.h` is generated from this crate, in this
//! order; its comments are the documentation.
//!
//! ```text
//! bytes ─► psao_client_push ─► psao_client_take ─► psao_client_dirty_ranges ─► your GPU buffers
//!                                                └► psao_client_lookup (CPU)
//! camera, transforms, poses ─► psao_uplink_… ─► bytes
//! ```
#![allow(non_camel_case_types)]
#![cfg_attr(not(feature = "std"), no_std)]

#[cfg(all(feature = "std", panic = "abort"))]
compile_error!(
    "panics cannot be stopped with panic = \"abort\" unless the feature std is left out"
);
#[cfg(all(not(feature = "std"), panic = "unwind"))]
compile_error!("without the feature std panics cannot unwind: build with --profile libpsao");

// Its constants are the first in the header.
mod version;

mod border;
mod client;
#[cfg(feature = "quic")]
mod connection;
mod front;
mod handoff;
/// cbindgen:ignore
#[cfg(feature = "provoke")]
mod provoke;
mod result;
mod sync;
mod types;
mod uplink;

pub use client::*;
#[cfg(feature = "quic")]
pub use connection::*;
pub use result::{psao_result, psao_result_str};
pub use types::*;
pub use uplink::*;
pub use version::*;
