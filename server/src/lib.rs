//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod metrics;
pub mod picture;
pub mod rays;
pub mod report;
pub mod samples;
pub mod scene;
pub mod truth;
