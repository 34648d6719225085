//! PSAO for engines on wgpu: buffers that hold the client's mirror, uploads of what changed, and
//! the lookup, as a compute pass over a G-buffer or as text for the engine's own shaders.
//!
//! ```text
//! client.mirror() ─► Buffers::upload ─► Pass::encode (G-buffer in, openness out)
//!                                    └► or wgsl() in the engine's fragment shader
//! ```
//!
//! It works within wgpu's default limits (128 MiB a storage buffer), on devices without subgroups
//! and without timestamps.

mod buffers;
mod pass;

pub use buffers::{Buffers, TooLarge, Uploaded};
pub use pass::{GBuffer, Pass, Tier};
pub use wgpu;

const STORAGE: &str = include_str!("../../shaders/storage.wgsl");
const FUNCTIONS: &str = include_str!("../../shaders/psao.wgsl");

/// The lookup as WGSL to put in front of an engine's own shader: `psao_planar_fast`, `psao_planar`
/// and `psao_paper`, which the text documents. It declares the three buffers as bindings 0 to 2 of
/// bind group `group`: set [`Buffers::bind_group`] there.
///
/// All of its names begin with `psao_`, `Psao` or `PSAO_`.
pub fn wgsl(group: u32) -> String {
    let storage = STORAGE.replace("@group(0)", &format!("@group({group})"));
    format!("{storage}\n{FUNCTIONS}")
}
