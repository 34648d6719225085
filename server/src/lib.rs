//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod rays;
pub mod samples;
pub mod scene;
pub mod truth;
