//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod scene;
pub mod truth;
