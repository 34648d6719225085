//! PSAO for engines on wgpu: buffers that hold the client's mirror, uploads of what changed, and
//! the passes that look it up.

pub use wgpu;
