//! From a detailed mesh to a plain one: which place of the detailed mesh each texel of the plain
//! one stands for, and the normal there as a normal map holds it.
//!
//! Tangent space is glTF's: T along u, B = cross(N, T) * w up in the picture (against v), N the
//! interpolated normal. The tangents are written to the file, so that no viewer makes its own: a
//! vertex has the mean of its triangles' directions of u, weighted by area, at a right angle to its
//! normal. As in a viewer's shader, T and N are interpolated and made unit vectors, and B follows
//! from them.

use super::Stage;
use super::atlas::{Atlas, Charts};
use super::elements::{Element, Surface, covered};
use crate::points::SurfacePoint;
use crate::rays::Tracer;
use glam::{Mat3, Vec3, Vec4};
use rayon::prelude::*;

/// What a plain scene's texels stand for.
pub struct Detail {
    /// The place on the detailed scene, from its origin; on the plain one where there is none
    /// within the cage. In the order of [`super::texels`].
    pub elements: Vec<Element>,
    /// Unit normal there, in the texel's tangent space.
    pub normals: Vec<Vec3>,
    /// Tangents of each instance's charts' vertices, in its local space.
    pub tangents: Vec<Vec<Vec4>>,
    /// Texels for which there is no place within the cage.
    pub missed: usize,
}

impl Detail {
    /// Looks for the detailed scene from `cage_m` metres outside of the plain one's surface to as
    /// much inside, against the interpolated normal. The first surface is taken, of either side.
    ///
    /// # Errors
    /// The plain scene deforms, the detailed one is too large, or it is nowhere within the cage.
    pub fn new(
        plain: &Stage,
        atlas: &Atlas,
        detailed: &Stage,
        cage_m: f32,
    ) -> Result<Detail, String> {
        if let Some(instance) = plain.scene.instances.iter().find(|i| i.deforms) {
            return Err(format!(
                "{}: a normal map is for a mesh at rest: export it without skin and morph targets",
                instance.name
            ));
        }
        let instances = |stage: &Stage| 0..stage.scene.instances.len() as u32;
        let surfaces: Vec<Surface> = instances(plain).map(|i| Surface::new(plain, i)).collect();
        let found: Vec<Surface> = (instances(detailed))
            .map(|i| Surface::new(detailed, i))
            .collect();
        let tangents: Vec<Vec<Vec4>> = (instances(plain).zip(&atlas.instances))
            .map(|(instance, charts)| tangents(plain, instance, charts))
            .collect();
        let tracer = detailed.tracer()?;
        // Each scene's metres are from an origin of its own.
        let shift = (plain.scene.origin - detailed.scene.origin).as_vec3();
        let places: Vec<(Element, Option<Vec3>)> = covered(atlas)
            .par_iter()
            .map(|texel| {
                let at = texel.instance as usize;
                let mut own = surfaces[at].element(&texel.point);
                own.position += shift;
                let start = own.position + own.normal * cage_m;
                let Some(hit) = tracer.closest(start, -own.normal, 2.0 * cage_m) else {
                    return (own, None);
                };
                let point = SurfacePoint {
                    triangle: hit.triangle,
                    u: hit.u,
                    v: hit.v,
                    back: false,
                };
                let mut there = found[hit.instance as usize].element(&point);
                if there.outward.dot(own.normal) < 0.0 {
                    there.outward = -there.outward;
                    there.normal = -there.normal;
                }
                let (_, normals) = plain.vertices(texel.instance);
                let charts = &atlas.instances[at];
                let frame = frame(charts, normals, &tangents[at], &texel.point);
                // Normals go back to local space with the transpose of what takes places there.
                let place = &plain.pose.instances[at].world_from_local;
                let local = place.matrix3.transpose() * glam::Vec3A::from(there.normal);
                let normal = (frame.inverse() * Vec3::from(local)).normalize_or(Vec3::Z);
                (there, Some(normal))
            })
            .collect();
        let missed = places.iter().filter(|(_, normal)| normal.is_none()).count();
        if missed == places.len() {
            return Err(format!(
                "{}: nothing of it within {cage_m} m of {}: they must be in the same place; or \
                 raise --cage",
                detailed.scene.name, plain.scene.name
            ));
        }
        let (elements, normals): (Vec<_>, Vec<_>) = (places.into_iter())
            .map(|(element, normal)| (element, normal.unwrap_or(Vec3::Z)))
            .unzip();
        Ok(Detail {
            elements,
            normals,
            tangents,
            missed,
        })
    }
}

/// A tangent for each of an instance's charts' vertices.
fn tangents(stage: &Stage, instance: u32, charts: &Charts) -> Vec<Vec4> {
    let (positions, normals) = stage.vertices(instance);
    let mut sums = vec![[Vec3::ZERO; 2]; charts.vertices.len()];
    for triangle in &charts.triangles {
        let [a, b, c] = triangle.map(|v| charts.vertices[v as usize]);
        let [p, q, r] = [a, b, c].map(|(vertex, _)| positions[vertex as usize]);
        let (across, down) = (b.1 - a.1, c.1 - a.1);
        let turn = across.perp_dot(down).signum();
        // Directions of u and of v reversed, which is up in the picture.
        let along = ((q - p) * down.y - (r - p) * across.y) * turn;
        let up = ((q - p) * down.x - (r - p) * across.x) * turn;
        let area = (q - p).cross(r - p).length();
        for vertex in triangle {
            let [tangent, bitangent] = &mut sums[*vertex as usize];
            *tangent += along.normalize_or_zero() * area;
            *bitangent += up.normalize_or_zero() * area;
        }
    }
    sums.iter()
        .zip(&charts.vertices)
        .map(|([along, up], (vertex, _))| {
            let normal = normals[*vertex as usize];
            let tangent = along.reject_from_normalized(normal);
            // Where triangles cancel each other out, any direction will do.
            let tangent = tangent
                .try_normalize()
                .unwrap_or(normal.any_orthonormal_vector());
            let side = normal.cross(tangent).dot(*up);
            tangent.extend(if side < 0.0 { -1.0 } else { 1.0 })
        })
        .collect()
}

/// What takes tangent space to local space, as a viewer makes it at a place.
fn frame(charts: &Charts, normals: &[Vec3], tangents: &[Vec4], point: &SurfacePoint) -> Mat3 {
    let corners = charts.triangles[point.triangle as usize];
    let weights = [1.0 - point.u - point.v, point.u, point.v];
    let (mut normal, mut tangent) = (Vec3::ZERO, Vec4::ZERO);
    for (corner, weight) in corners.into_iter().zip(weights) {
        let (vertex, _) = charts.vertices[corner as usize];
        normal += normals[vertex as usize] * weight;
        tangent += tangents[corner as usize] * weight;
    }
    let normal = normal.normalize_or(Vec3::Z);
    let along = tangent
        .truncate()
        .normalize_or(normal.any_orthonormal_vector());
    let up = normal
        .cross(along)
        .normalize_or(normal.any_orthonormal_vector())
        * tangent.w.signum();
    Mat3::from_cols(along, up, normal)
}
