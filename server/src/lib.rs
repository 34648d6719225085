//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod camera;
pub mod metrics;
pub mod picture;
pub mod report;
pub mod scene;
