//! PSAO core: what server and client must agree on, once.
//!
//! ```text
//! stream bytes ─► stream (packets) ─► mirror (buckets, cells, instances) ─► lookup
//! ```
//!
//! * [`point`], [`cell`], [`grid`]: the data of the paper (Neff et al., PSAO, section 3.2),
//!   laid out as the client's GPU buffers hold it.
//! * [`mirror`]: those buffers, their dirty ranges, and a hash that proves two mirrors equal.
//! * [`stream`]: the packets of `docs/format.md`, reader and writer side by side.
//! * [`topology`], over [`range`]: where a mesh's points are, in patches.
//! * [`slices`]: patches on instances, whose points [`bins`] puts into cells.
//! * [`residual`], over [`range`]: the coding of a slice's occlusion.
//! * [`uplink`]: what the client tells the server.
//! * [`tags`]: what a GPU's buckets say of their cells' keys.
//! * [`lookup`]: the blend of the few points around a fragment; the definition for all shaders.
//!
//! `no_std`, no allocation, no `unsafe`: every buffer is the caller's and is bounded before use.
#![no_std]

pub mod bins;
pub mod cell;
pub mod dirty;
pub mod grid;
pub mod lookup;
pub mod mirror;
pub mod point;
pub mod range;
pub mod residual;
pub mod slices;
pub mod stream;
pub mod tags;
pub mod topology;
pub mod uplink;
mod usual;

pub use cell::{Bucket, Cell};
pub use grid::Instance;
pub use lookup::{Kernel, Lookup};
pub use mirror::Mirror;
pub use point::Point;
