//! The scene's triangles for the device's own ray queries, where it has them.

use super::Gpu;
use std::ops::Range;

/// The shader: `pixels` as in the tracer's.
const SHADER: &str = concat!(include_str!("query.wgsl"), "\n", include_str!("trace.wgsl"));

/// Triangles that are built together.
pub(super) struct Count {
    /// Which of the tracer's.
    pub triangles: Range<u32>,
    /// Whether any has a mask, so that the shader has to be asked about what rays meet.
    pub masked: bool,
}

/// A body of triangles, in world space.
struct Body {
    built: wgpu::Blas,
    size: wgpu::BlasTriangleGeometrySizeDescriptor,
    first_vertex: u32,
}

/// Two bodies, what stands still and what moves, and the pass through them.
pub(super) struct Bodies {
    bodies: [Option<Body>; 2],
    pub scene: wgpu::Tlas,
    pub pixels: wgpu::ComputePipeline,
}

impl Bodies {
    /// Builds both over the tracer's triangles: three vectors each, the corners first in them.
    pub fn new(gpu: &Gpu, triangles: &wgpu::Buffer, counts: [Count; 2]) -> Bodies {
        let flags = wgpu::AccelerationStructureFlags::PREFER_FAST_TRACE;
        let update_mode = wgpu::AccelerationStructureUpdateMode::Build;
        let body = |count: Count| {
            let size = wgpu::BlasTriangleGeometrySizeDescriptor {
                vertex_format: wgpu::VertexFormat::Float32x3,
                vertex_count: count.triangles.len() as u32 * 3,
                index_format: None,
                index_count: None,
                flags: if count.masked {
                    wgpu::AccelerationStructureGeometryFlags::NO_DUPLICATE_ANY_HIT_INVOCATION
                } else {
                    wgpu::AccelerationStructureGeometryFlags::OPAQUE
                },
            };
            let built = gpu.device.create_blas(
                &wgpu::CreateBlasDescriptor {
                    label: Some("body"),
                    flags,
                    update_mode,
                },
                wgpu::BlasGeometrySizeDescriptors::Triangles {
                    descriptors: vec![size.clone()],
                },
            );
            Body {
                built,
                size,
                first_vertex: count.triangles.start * 3,
            }
        };
        let bodies = counts.map(|count| (!count.triangles.is_empty()).then(|| body(count)));
        let mut scene = gpu.device.create_tlas(&wgpu::CreateTlasDescriptor {
            label: Some("bodies"),
            max_instances: 2,
            flags,
            update_mode,
        });
        let in_place = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        for (index, body) in bodies.iter().enumerate() {
            scene[index] = body
                .as_ref()
                .map(|body| wgpu::TlasInstance::new(&body.built, in_place, index as u32, 0xff));
        }
        let shader = gpu.shader("rays by query", SHADER);
        let all = Bodies {
            bodies,
            scene,
            pixels: gpu.compute(&shader, "pixels"),
        };
        all.build(gpu, triangles, 0..2);
        all
    }

    /// Builds some of the two anew, over what the triangles are now.
    pub fn build(&self, gpu: &Gpu, triangles: &wgpu::Buffer, which: Range<usize>) {
        let entries: Vec<_> = self.bodies[which]
            .iter()
            .flatten()
            .map(|body| wgpu::BlasBuildEntry {
                blas: &body.built,
                geometry: wgpu::BlasGeometries::TriangleGeometries(vec![
                    wgpu::BlasTriangleGeometry {
                        size: &body.size,
                        vertex_buffer: triangles,
                        first_vertex: body.first_vertex,
                        vertex_stride: 16,
                        index_buffer: None,
                        first_index: None,
                        transform_buffer: None,
                        transform_buffer_offset: None,
                    },
                ]),
            })
            .collect();
        let mut encoder = gpu.encoder();
        encoder.build_acceleration_structures(&entries, [&self.scene]);
        gpu.queue.submit([encoder.finish()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wgpu::naga::front::wgsl;
    use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};

    #[test]
    fn the_shader_is_valid_on_devices_with_ray_queries_and_only_there() {
        let source = format!("{SHADER}\n{}", include_str!("eye.wgsl"));
        let module = wgsl::parse_str(&source).expect("a shader");
        let valid = |capabilities| {
            Validator::new(ValidationFlags::all(), capabilities)
                .validate(&module)
                .is_ok()
        };
        let others = Capabilities::default();
        assert!(valid(others | Capabilities::RAY_QUERY));
        assert!(
            !valid(others - Capabilities::RAY_QUERY),
            "it asks for no rays"
        );
    }
}
