//! The PSAO reference server: `scene ─► points ─► occlusion ─► select ─► encode ─► transport`.

pub mod identity;
pub mod scene;
pub mod transport;
