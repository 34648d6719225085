//! What is baked: places on surfaces, with what a method needs to know of each.

use super::Stage;
use super::atlas::Atlas;
use crate::points::{self, SurfacePoint};
use crate::rays::reach;
use glam::{Vec2, Vec3};

/// A place on a surface, in metres from the scene's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Element {
    /// Where it is.
    pub position: Vec3,
    /// Unit normal, interpolated from the vertices: the hemisphere that is looked at.
    pub normal: Vec3,
    /// Unit normal of the flat triangle, on the same side.
    pub outward: Vec3,
    /// How coarse the numbers around are: see [`crate::rays::offset_origin`].
    pub reach: f32,
}

/// An instance's surface, as elements are taken from it.
pub(super) struct Surface<'a> {
    triangles: &'a [[u32; 3]],
    positions: &'a [Vec3],
    normals: &'a [Vec3],
    place: &'a crate::scene::InstancePose,
    reach: f32,
}

impl<'a> Surface<'a> {
    pub(super) fn new(stage: &'a Stage, instance: u32) -> Surface<'a> {
        let (positions, normals) = stage.vertices(instance);
        let place = &stage.pose.instances[instance as usize];
        let extent = positions
            .iter()
            .fold(Vec3::ZERO, |most, p| most.max(p.abs()));
        Surface {
            triangles: &stage.mesh(instance).triangles,
            positions,
            normals,
            place,
            reach: reach(&place.world_from_local, extent),
        }
    }

    pub(super) fn element(&self, point: &SurfacePoint) -> Element {
        let normal = point.normal(self.triangles, self.positions, self.normals);
        let flat = point.geometric_normal(self.triangles, self.positions);
        let normal = self.place.world_normal(normal);
        let flat = self.place.world_normal(flat);
        let position = point.position(self.triangles, self.positions);
        Element {
            position: self.place.world_from_local.transform_point3(position),
            normal,
            // Some files wind triangles against their normals.
            outward: if flat.dot(normal) < 0.0 { -flat } else { flat },
            reach: self.reach,
        }
    }

    fn world(&self, triangle: usize) -> [Vec3; 3] {
        let at = |v: u32| {
            let local = self.positions[v as usize];
            self.place.world_from_local.transform_point3(local)
        };
        self.triangles[triangle].map(at)
    }
}

/// An element for each vertex of an instance, at the vertex's corner of its largest triangle; the
/// front of what has two sides.
///
/// Not quite at the corner: a vertex at the foot of a wall lies in the wall's plane, where what is
/// visible depends on rounding alone. Elements lie inside the triangle by a tenth of the way to its
/// middle, or by `inset_m` where that is less.
pub fn vertices(stage: &Stage, instance: u32, inset_m: f32) -> Vec<Element> {
    let surface = Surface::new(stage, instance);
    let mut best = vec![
        (
            -1.0f32,
            SurfacePoint {
                triangle: 0,
                u: 0.0,
                v: 0.0,
                back: false
            }
        );
        surface.positions.len()
    ];
    for (index, triangle) in surface.triangles.iter().enumerate() {
        let corners = surface.world(index);
        let area = (corners[1] - corners[0])
            .cross(corners[2] - corners[0])
            .length();
        let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
        for (corner, vertex) in triangle.iter().enumerate() {
            let best = &mut best[*vertex as usize];
            if area > best.0 {
                let way = corners[corner].distance(middle);
                let part = if way > 0.0 {
                    (inset_m / way).min(0.1)
                } else {
                    0.0
                };
                let weight = |of: usize| part / 3.0 + if of == corner { 1.0 - part } else { 0.0 };
                *best = (
                    area,
                    SurfacePoint {
                        triangle: index as u32,
                        u: weight(1),
                        v: weight(2),
                        back: false,
                    },
                );
            }
        }
    }
    best.iter()
        .map(|(_, point)| surface.element(point))
        .collect()
}

/// Points spread over an instance's surface.
pub struct Points {
    /// Where they are in the mesh.
    pub points: Vec<SurfacePoint>,
    /// The same, posed.
    pub elements: Vec<Element>,
}

impl Points {
    /// `density` points a square metre and side, as the streaming points are placed.
    ///
    /// # Errors
    /// A density that makes no sense for the mesh.
    pub fn new(
        stage: &Stage,
        instance: u32,
        density: f64,
        seed: u64,
    ) -> Result<Points, points::PointError> {
        let surface = Surface::new(stage, instance);
        let metric = crate::world::scale_of(&surface.place.world_from_local);
        let set = points::generate(stage.mesh(instance), metric, density, seed)?;
        let elements = set.points.iter().map(|point| surface.element(point));
        Ok(Points {
            elements: elements.collect(),
            points: set.points,
        })
    }
}

/// Texels of an atlas: which, and their elements.
pub fn texels(stage: &Stage, atlas: &Atlas) -> (Vec<u32>, Vec<Element>) {
    let instances = 0..stage.scene.instances.len() as u32;
    let surfaces: Vec<Surface> = instances.map(|i| Surface::new(stage, i)).collect();
    (covered(atlas).iter())
        .map(|texel| {
            let element = surfaces[texel.instance as usize].element(&texel.point);
            (texel.index, element)
        })
        .unzip()
}

/// A texel of an atlas that has a place on a surface.
pub(super) struct Texel {
    /// Its number, row by row from the top.
    index: u32,
    /// The instance.
    pub(super) instance: u32,
    /// Where on its mesh.
    pub(super) point: SurfacePoint,
}

/// All texels of an atlas that have a place, each once.
pub(super) fn covered(atlas: &Atlas) -> Vec<Texel> {
    let mut owner = vec![false; atlas.size as usize * atlas.size as usize];
    let mut texels = Vec::new();
    // First texels whose middle a triangle covers; then those that it only touches, which are as
    // visible: they take the nearest place on the triangle.
    for touching in [false, true] {
        for (instance, charts) in (0..).zip(&atlas.instances) {
            for (index, corners) in charts.triangles.iter().enumerate() {
                let uvs = corners.map(|v| charts.vertices[v as usize].1 * atlas.size as f32);
                each_texel(uvs, atlas.size, touching, |texel, u, v| {
                    if !std::mem::replace(&mut owner[texel as usize], true) {
                        let point = SurfacePoint {
                            triangle: index as u32,
                            u,
                            v,
                            back: false,
                        };
                        texels.push(Texel {
                            index: texel,
                            instance,
                            point,
                        });
                    }
                });
            }
        }
    }
    texels
}

/// Calls `visit` with each texel whose middle lies in a triangle (corners in texels), and the
/// weights of vertices 1 and 2 there; with `touching`, also those whose middle is within a texel of
/// it, with the weights of the nearest place.
fn each_texel(uvs: [Vec2; 3], size: u32, touching: bool, mut visit: impl FnMut(u32, f32, f32)) {
    let margin = if touching { 1.0 } else { 0.0 };
    let low = uvs[0].min(uvs[1]).min(uvs[2]) - margin - 0.5;
    let high = uvs[0].max(uvs[1]).max(uvs[2]) + margin + 0.5;
    let span = |low: f32, high: f32| low.max(0.0) as u32..(high.max(0.0) as u32 + 1).min(size);
    let area = (uvs[1] - uvs[0]).perp_dot(uvs[2] - uvs[0]);
    for y in span(low.y, high.y) {
        for x in span(low.x, high.x) {
            let at = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let weight = |a: Vec2, b: Vec2| (b - a).perp_dot(at - a) / area;
            let (u, v) = (weight(uvs[2], uvs[0]), weight(uvs[0], uvs[1]));
            let inside = u >= 0.0 && v >= 0.0 && u + v <= 1.0;
            if inside {
                visit(y * size + x, u, v);
            } else if touching {
                let (u, v) = nearest(uvs, at);
                let place = uvs[0] + (uvs[1] - uvs[0]) * u + (uvs[2] - uvs[0]) * v;
                if place.distance_squared(at) < 1.0 {
                    visit(y * size + x, u, v);
                }
            }
        }
    }
}

/// Weights of vertices 1 and 2 at the place on a triangle's edges nearest to `at`.
fn nearest(uvs: [Vec2; 3], at: Vec2) -> (f32, f32) {
    let mut best = (f32::INFINITY, [1.0, 0.0, 0.0]);
    for from in 0..3 {
        let to = (from + 1) % 3;
        let edge = uvs[to] - uvs[from];
        let part = (at - uvs[from]).dot(edge) / edge.length_squared().max(f32::MIN_POSITIVE);
        let part = part.clamp(0.0, 1.0);
        let distance = (uvs[from] + edge * part).distance_squared(at);
        if distance < best.0 {
            let mut weights = [0.0; 3];
            weights[from] = 1.0 - part;
            weights[to] = part;
            best = (distance, weights);
        }
    }
    (best.1[1], best.1[2])
}
