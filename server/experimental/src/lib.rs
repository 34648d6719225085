//! Leave to use what wgpu calls experimental. Apart from the server, which has no unsafe code.

/// For `psao bench-gpu --ray-query`, and nothing else.
pub fn ray_queries() -> wgpu::ExperimentalFeatures {
    // SAFETY: wgpu asks that its user accept undefined behaviour where a driver's or its own ray
    // queries are wrong. Who passes the option has been told, and traces a scene of their own.
    unsafe { wgpu::ExperimentalFeatures::enabled() }
}
