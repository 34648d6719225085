//! The PSAO client: stream bytes in, complete frames out.
//!
//! ```text
//! bytes ─► Client::push ─► mirror ─► Client::mirror().dirty_runs(..) ─► the engine's GPU buffers
//! ```
//!
//! [`Client`] does no input or output and has no thread and no clock: whoever has the bytes, from
//! a socket or a recording, pushes them. With the feature `quic`, [`quic`] fetches them from a
//! server.
#![cfg_attr(not(feature = "std"), no_std)]

mod client;
pub mod memory;
#[cfg(feature = "quic")]
pub mod quic;

#[cfg(feature = "std")]
pub use client::Config;
pub use client::{Client, ClientError, Pushed, State, Stats, Words};
pub use psao_core as core;
