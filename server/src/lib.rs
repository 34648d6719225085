//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod args;
pub mod bake;
#[cfg(feature = "gpu")]
pub mod bench_gpu;
pub mod camera;
pub mod commands;
pub mod demo;
pub mod encode;
pub mod eval;
pub mod facing;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod identity;
pub mod metrics;
pub mod picture;
pub mod points;
pub mod rays;
pub mod render;
pub mod report;
pub mod samples;
pub mod scene;
pub mod server;
pub mod topology;
pub mod transport;
pub mod truth;
pub mod world;
