//! Ray tracing: what a ray hits, asked of groups of geometry.
//!
//! Rays against geometry that a point is rigidly attached to are traced once and kept by the
//! caller, so every query says which geometry it is [`Against`]. Static instances are flattened
//! into one tree in world space; each mover keeps a tree in its local space (shared by the
//! instances of a mesh, refitted each frame where the instance deforms), under a small tree over
//! the movers' world bounds.

mod body;
mod fan;
mod lanes;
#[cfg(test)]
mod tests;

use std::fmt;

use glam::{Affine3A, DAffine3, Mat3A, Vec2, Vec3, Vec3A};
#[cfg(feature = "gpu")]
use obvhs::cwbvh::{CwBvh, bvh2_to_cwbvh::bvh2_to_cwbvh};
use obvhs::{aabb::Aabb, bvh2::Bvh2, ray::Ray};
use rayon::prelude::*;

use crate::scene::{Mask, Mesh, Pose, Scene, Wrap};
use body::{Body, Corners};
use fan::Rays;
pub use fan::{Directions, Fan};
use lanes::Lanes;

/// Most triangles in the static group after instancing, so that a small file that places a large
/// mesh many times can't take all memory (about 0.5 kB a triangle while building).
pub const MAX_STATIC_TRIANGLES: usize = 1 << 24;

/// The nearest hit of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index into [`Scene::instances`].
    pub instance: u32,
    /// Index into the mesh's triangles.
    pub triangle: u32,
    /// Barycentric weight of the triangle's vertex 1, 0..1.
    pub u: f32,
    /// Barycentric weight of the triangle's vertex 2, 0..1.
    pub v: f32,
    /// Distance, in lengths of the ray's direction.
    pub t: f32,
}

/// Which geometry a query asks about. `All` is the same as `Static` or `Movers`, and as
/// `Instance(i)` or `AllExcept(i)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Against {
    /// Everything.
    All,
    /// Instances that are not in the mover group.
    Static,
    /// Instances in the mover group.
    Movers,
    /// One instance.
    Instance(u32),
    /// Everything but one instance.
    AllExcept(u32),
}

/// The deformed vertices of one deforming instance.
#[derive(Clone, Debug, Default)]
pub struct Deformed {
    /// Index into [`Scene::instances`].
    pub instance: u32,
    /// Positions in the instance's local space, as many as its mesh has.
    pub positions: Vec<Vec3>,
    /// Unit normals in the instance's local space, as many as positions.
    pub normals: Vec<Vec3>,
}

/// Answers ray queries about a posed scene. The answers depend on the scene and the pose alone,
/// not on threads or on earlier queries.
pub trait Tracer: Send + Sync {
    /// For each set bit i of `todo` whose bit in `hit` is not set yet, traces
    /// `origin + t * directions[i]` for 0 < t < `t_max`, and sets bit i of `hit` if anything is in
    /// the way (either side of a triangle; holes of masks let through). Bit i is bit `i % 64` of
    /// word `i / 64`; bits past `directions` are left alone.
    ///
    /// Directions are unit vectors (those of no length, or not finite, hit nothing); `origin` is in
    /// metres relative to the scene's origin, and should come from [`offset_origin`].
    fn occluded(
        &self,
        against: Against,
        origin: Vec3,
        directions: &[Vec3],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    );

    /// As [`Tracer::occluded`] for the rays of a fan, the bits in the sorted order of its
    /// directions, but much faster: the same rays hit.
    fn occluded_fan(
        &self,
        against: Against,
        fan: &Fan<'_>,
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    );

    /// The nearest hit with 0 < t < `t_max` among all geometry; `t_max` may be infinite.
    /// `direction` is a unit vector.
    fn closest(&self, origin: Vec3, direction: Vec3, t_max: f32) -> Option<Hit>;

    /// Moves the movers to `pose`, and refits those that deform to `deformed` (one a deforming
    /// instance, in instance order). Static instances stay as they were built.
    fn update(&mut self, scene: &Scene, pose: &Pose, deformed: &[Deformed]);
}

/// Answers for many points at once what stands still near them: another device than the processor,
/// which is worth asking only for many rays together.
pub trait FanTracer: Send + Sync {
    /// As [`Tracer::occluded_fan`] of [`Against::Static`] for each of `fans`, which take sets of
    /// the samples that this was made with. Bits are fan after fan, as many words each as its
    /// directions have.
    ///
    /// But for rays that graze an edge, or end on a surface, to within the rounding of 32-bit
    /// floats, the same rays hit.
    ///
    /// # Errors
    /// The device has no room, or is lost; `hit` is as it was, or has some of its bits.
    fn occluded_fans(
        &self,
        fans: &[Fan<'_>],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) -> Result<(), String>;

    /// Another division of the same scene: only instances that `moves` does not name stand still,
    /// as `pose` has them.
    ///
    /// # Errors
    /// The device has no room, or is lost.
    fn divide(&mut self, scene: &Scene, pose: &Pose, moves: &[bool]) -> Result<(), String>;
}

/// More static triangles than [`MAX_STATIC_TRIANGLES`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooManyTriangles {
    /// How many there are, every placement of a mesh counted.
    pub triangles: usize,
}

impl fmt::Display for TooManyTriangles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the scene's static instances have {} triangles in all, more than the {} that can be \
             traced: simplify its meshes, or place them fewer times",
            self.triangles, MAX_STATIC_TRIANGLES
        )
    }
}

impl std::error::Error for TooManyTriangles {}

/// The distance that leaves the surface: about ten times the error that reaches a hit from rounding
/// the corners, the position on the triangle and the intersection, each at most a few of the 2^-24
/// steps of the largest coordinate.
const OFFSET: f32 = 1.0 / (1 << 18) as f32;

/// Where a ray that leaves a surface at `position` should start so as not to hit that surface:
/// a little above it, along the unit `geometric_normal` (towards the side the rays leave from).
///
/// `reach` says how coarse the numbers are that made the triangle, see [`reach`]. The position
/// itself can't say: the middle of a large floor may lie at the scene's origin.
/// Nothing here is an absolute length, so a scene of millimetres is as safe as one of kilometres.
pub fn offset_origin(position: Vec3, geometric_normal: Vec3, reach: f32) -> Vec3 {
    position + geometric_normal * (reach * OFFSET)
}

/// The largest number, in metres, that takes part when vertices whose coordinates are within
/// `-local_extent..=local_extent` are placed by `world_from_local`; for [`offset_origin`].
/// The extent may be a triangle's, or a whole mesh's where that isn't much larger than the distance
/// the rays go (the offset is `reach` / 2^18).
pub fn reach(world_from_local: &Affine3A, local_extent: Vec3) -> f32 {
    let m = world_from_local.matrix3;
    let e = Vec3A::from(local_extent).abs();
    let placed = m.x_axis.abs() * e.x + m.y_axis.abs() * e.y + m.z_axis.abs() * e.z;
    (placed + world_from_local.translation.abs()).max_element()
}

/// The inverse of a placement, or nothing where it flattens space or is not finite. In `f64`:
/// small scales would underflow.
fn inverse(world_from_local: &Affine3A) -> Option<Mat3A> {
    let double = DAffine3::from_mat3_translation(
        world_from_local.matrix3.as_dmat3(),
        world_from_local.translation.as_dvec3(),
    );
    let inverse = double.matrix3.inverse().as_mat3();
    let usable = world_from_local.is_finite() && inverse.is_finite();
    (usable && double.matrix3.determinant() != 0.0).then(|| Mat3A::from(inverse))
}

/// Whether an instance placed so can be hit.
#[cfg(feature = "gpu")]
pub(crate) fn is_placed(world_from_local: &Affine3A) -> bool {
    inverse(world_from_local).is_some()
}

/// A tree with eight boxes a node over triangles in world space, as a GPU walks it, and its depth.
/// Corners that make no triangle become zero, and a triangle alone is put there twice.
#[cfg(feature = "gpu")]
pub(crate) fn wide_tree(corners: &mut Vec<[Vec3; 3]>) -> (CwBvh, usize) {
    if let [alone] = corners[..] {
        corners.push(alone);
    }
    let mut boxes = body::sane_boxes(corners);
    let tree = bvh2_to_cwbvh(&body::tree(&mut boxes, &body::STATIC), 3, true, false);
    let mut depth = 0;
    let mut level = if tree.nodes.is_empty() {
        vec![]
    } else {
        vec![0]
    };
    while !level.is_empty() {
        depth += 1;
        let inner = |node: &u32| {
            let node = &tree.nodes[*node as usize];
            node.child_base_idx..node.child_base_idx + node.imask.count_ones()
        };
        level = level.iter().flat_map(inner).collect();
    }
    (tree, depth)
}

/// Traces on the CPU, with trees from `obvhs`.
pub struct CpuTracer {
    /// All static instances, in world space.
    fixed: Body,
    /// First triangle of each static instance within `fixed`, and its index; in order.
    fixed_instances: Vec<(u32, u32)>,
    /// `fixed` has a mesh with a mask.
    fixed_masked: bool,
    /// Meshes that rigid movers place, in local space; others are empty.
    meshes: Vec<Body>,
    movers: Vec<Mover>,
    /// Over the movers' world bounds; each leaf holds one index into `movers`.
    top: Bvh2,
    /// For each instance, its index into `movers`.
    mover_of: Vec<Option<u32>>,
    /// For each instance, its mesh.
    mesh_of: Vec<u32>,
    /// For each mesh with a mask.
    cutouts: Vec<Option<Cutout>>,
    /// Everything that can be hit, in world space.
    bounds: Aabb,
    /// The processor has it.
    #[cfg(target_arch = "x86_64")]
    avx: Option<pulp::x86::V3>,
}

struct Mover {
    instance: u32,
    mesh: u32,
    /// Its own tree, if it deforms.
    own: Option<Body>,
    /// World directions to local ones; nothing if it can't be hit.
    local_from_world: Option<Mat3A>,
    /// World directions from local ones.
    world_from_local: Mat3A,
    translation: Vec3A,
    /// World bounds.
    bounds: Aabb,
}

/// What the hole test needs of a mesh.
struct Cutout {
    mask: Mask,
    uvs: Vec<[Vec2; 3]>,
}

impl Cutout {
    fn new(mesh: &Mesh) -> Option<Cutout> {
        let uv = |i: u32| mesh.uvs.get(i as usize).copied().unwrap_or_default();
        mesh.mask.as_ref().map(|mask| Cutout {
            mask: mask.clone(),
            uvs: mesh.triangles.iter().map(|t| t.map(uv)).collect(),
        })
    }
}

/// The texel of an axis of `size` texels that is nearest to coordinate `at`.
fn nearest_texel(at: f32, size: u32, wrap: Wrap) -> usize {
    let at = match wrap {
        Wrap::Clamp => at.clamp(0.0, 1.0),
        Wrap::Repeat => at - at.floor(),
        Wrap::Mirror => 1.0 - (at - 2.0 * (at * 0.5).floor() - 1.0).abs(),
    };
    ((at * size as f32) as usize).min((size as usize).saturating_sub(1))
}

/// How rays are measured while they are traced: t counts in steps of `unit`, a power of two (so
/// that nothing is rounded) chosen so that `end`, `t_max` in these steps, is 2^20 to 2^21. The
/// trees skip boxes that a ray leaves before t = 1e-4, which this makes negligible at any scale.
struct Span {
    unit: f32,
    end: f32,
}

impl Span {
    /// Nothing where `t_max` is not a usable distance.
    fn new(t_max: f32) -> Option<Span> {
        if !(1e-30..=1e30).contains(&t_max) {
            return None;
        }
        let unit = f32::from_bits(((t_max.to_bits() >> 23) - 20) << 23);
        Some(Span {
            unit,
            end: t_max / unit,
        })
    }
}

/// A ray as the trees want it: nothing where the direction has no length or is not finite.
fn ray(origin: Vec3A, direction: Vec3A, end: f32) -> Option<Ray> {
    /// Instead of infinite inverses, which times zero would be NaN.
    const STEEPEST: Vec3A = Vec3A::splat(1e27);
    if !direction.is_finite() || direction == Vec3A::ZERO {
        return None;
    }
    let direction = direction + Vec3A::ZERO; // -0 becomes 0: its inverse takes the same side.
    let inv_direction = direction.recip().clamp(-STEEPEST, STEEPEST);
    Some(Ray {
        origin,
        direction,
        inv_direction,
        tmin: 0.0,
        tmax: end,
    })
}

/// Calls `visit` with each set bit of `todo` that is not set in `hit`; sets it in `hit` if true.
fn for_each_open(todo: &[u64], hit: &mut [u64], rays: usize, mut visit: impl FnMut(usize) -> bool) {
    for (word, (todo, hit)) in todo.iter().zip(hit).enumerate() {
        let mut open = *todo & !*hit;
        while open != 0 {
            let bit = open.trailing_zeros();
            open &= open - 1;
            let i = word * 64 + bit as usize;
            if i < rays && visit(i) {
                *hit |= 1 << bit;
            }
        }
    }
}

impl CpuTracer {
    /// Builds the trees. `moves[i]`: instance i is in the mover group; all others are static,
    /// frozen as `pose` and `deformed` have them. An instance that a client starts to move needs a
    /// new tracer with another `moves`.
    ///
    /// Instances whose placement flattens them, or is not finite, are never hit.
    ///
    /// # Errors
    /// More than [`MAX_STATIC_TRIANGLES`] static triangles.
    pub fn new(
        scene: &Scene,
        pose: &Pose,
        deformed: &[Deformed],
        moves: &[bool],
    ) -> Result<CpuTracer, TooManyTriangles> {
        let instances = || {
            scene
                .instances
                .iter()
                .zip(&pose.instances)
                .zip(moves)
                .enumerate()
        };
        let mesh_of: Vec<u32> = scene.instances.iter().map(|i| i.mesh).collect();
        let deformed_of = |i: usize| {
            deformed
                .iter()
                .find(|d| d.instance as usize == i)
                .map(|d| &d.positions)
        };

        let triangles = instances()
            .filter(|(_, (_, moves))| !**moves)
            .map(|(_, ((instance, _), _))| scene.meshes[instance.mesh as usize].triangles.len())
            .sum();
        if triangles > MAX_STATIC_TRIANGLES {
            return Err(TooManyTriangles { triangles });
        }
        let mut corners = Vec::with_capacity(triangles);
        let mut fixed_instances = Vec::new();
        let mut fixed_masked = false;
        let mut movers = Vec::new();
        let mut mover_of = vec![None; scene.instances.len()];
        let mut placed = vec![false; scene.meshes.len()];
        for (i, ((instance, pose), moves)) in instances() {
            let mesh = &scene.meshes[instance.mesh as usize];
            let positions = deformed_of(i).unwrap_or(&mesh.positions);
            let place = &pose.world_from_local;
            if *moves {
                mover_of[i] = Some(movers.len() as u32);
                placed[instance.mesh as usize] |= !instance.deforms;
                movers.push(Mover {
                    instance: i as u32,
                    mesh: instance.mesh,
                    own: instance
                        .deforms
                        .then(|| Body::new(&corners_of(mesh, positions))),
                    local_from_world: None,
                    world_from_local: Mat3A::IDENTITY,
                    translation: Vec3A::ZERO,
                    bounds: Aabb::empty(),
                });
            } else if inverse(place).is_some() {
                let world: Vec<Vec3> = positions
                    .iter()
                    .map(|p| place.transform_point3(*p))
                    .collect();
                fixed_instances.push((corners.len() as u32, i as u32));
                fixed_masked |= mesh.mask.is_some();
                corners.extend(corners_of(mesh, &world));
            }
        }
        let rigid = |(mesh, placed): (&Mesh, &bool)| {
            let corners = if *placed {
                corners_of(mesh, &mesh.positions)
            } else {
                Vec::new()
            };
            let body = Body::new(&corners);
            // Through holes, rays get anywhere.
            if mesh.mask.is_some() {
                body
            } else {
                body.with_core()
            }
        };
        let mut tracer = CpuTracer {
            fixed: Body::new(&corners),
            fixed_instances,
            fixed_masked,
            meshes: scene.meshes.par_iter().zip(&placed).map(rigid).collect(),
            movers,
            top: Bvh2::default(),
            mover_of,
            mesh_of,
            cutouts: scene.meshes.iter().map(Cutout::new).collect(),
            bounds: Aabb::empty(),
            #[cfg(target_arch = "x86_64")]
            avx: pulp::x86::V3::try_new(),
        };
        tracer.update(scene, pose, deformed);
        Ok(tracer)
    }

    /// A hole of the mesh's mask is at this place of a triangle (weights of vertices 1 and 2).
    fn hole_at(&self, mesh: u32, triangle: u32, u: f32, v: f32) -> bool {
        let Some(Cutout { mask, uvs }) = &self.cutouts[mesh as usize] else {
            return false;
        };
        let [a, b, c] = uvs[triangle as usize];
        let at = a * (1.0 - u - v) + b * u + c * v;
        let x = nearest_texel(at.x, mask.width, mask.wrap[0]);
        let y = nearest_texel(at.y, mask.height, mask.wrap[1]);
        let alpha = mask.alpha.get(y * mask.width as usize + x);
        alpha.is_some_and(|alpha| f32::from(*alpha) / 255.0 < mask.cutoff)
    }

    /// Instance and triangle of a triangle of `fixed`.
    fn fixed_source(&self, id: u32) -> (u32, u32) {
        let next = self
            .fixed_instances
            .partition_point(|(first, _)| *first <= id);
        let (first, instance) = self.fixed_instances[next - 1];
        (instance, id - first)
    }

    fn body<'a>(&'a self, mover: &'a Mover) -> &'a Body {
        mover
            .own
            .as_ref()
            .unwrap_or(&self.meshes[mover.mesh as usize])
    }

    /// As far as a ray from `origin` can hit anything, and no farther than `t_max`.
    fn span(&self, origin: Vec3A, t_max: f32) -> Option<Span> {
        let corner = (origin - self.bounds.min)
            .abs()
            .max((origin - self.bounds.max).abs());
        let farthest = corner.length() * 1.01;
        // Not min(), which would take a NaN for no limit.
        let t_max = if t_max > farthest { farthest } else { t_max };
        if origin.is_finite() {
            Span::new(t_max)
        } else {
            None
        }
    }

    /// A triangle of `fixed` belongs to the group, and is no hole there.
    fn solid(&self, against: Against, id: u32, u: f32, v: f32) -> bool {
        let (instance, triangle) = self.fixed_source(id);
        let belongs = match against {
            Against::Instance(only) => instance == only,
            Against::AllExcept(but) => instance != but,
            Against::All | Against::Static | Against::Movers => true,
        };
        belongs && !self.hole_at(self.mesh_of[instance as usize], triangle, u, v)
    }

    /// Calls `ask` with each body of the group that is within reach: nothing stands for `fixed`,
    /// and the flag says whether all of its triangles count.
    fn each_body(
        &self,
        against: Against,
        origin: Vec3A,
        t_max: f32,
        mut ask: impl FnMut(Option<&Mover>, bool),
    ) {
        let named = match against {
            Against::Instance(i) | Against::AllExcept(i) => Some(i),
            Against::All | Against::Static | Against::Movers => None,
        };
        // An instance that is not a mover is part of the static tree, and filtered there.
        let mover = named.and_then(|i| self.mover_of.get(i as usize).copied().flatten());
        let only_instance = matches!(against, Against::Instance(_));
        if against != Against::Movers && !(only_instance && mover.is_some()) {
            ask(
                None,
                (named.is_none() || mover.is_some()) && !self.fixed_masked,
            );
        }
        if only_instance {
            if let Some(mover) = mover {
                ask(Some(&self.movers[mover as usize]), true);
            }
        } else if against != Against::Static {
            let around = Aabb::new(origin - t_max, origin + t_max);
            self.top.aabb_traverse(around, |top, leaf| {
                let slot = top.nodes[leaf as usize].first_index;
                let mover = &self.movers[top.primitive_indices[slot as usize] as usize];
                let nearest = origin.clamp(mover.bounds.min, mover.bounds.max);
                let near = nearest.distance_squared(origin) <= t_max * t_max;
                if near && against != Against::AllExcept(mover.instance) {
                    ask(Some(mover), true);
                }
                true
            });
        }
    }

    fn occluded_by_mover(
        &self,
        mover: &Mover,
        origin: Vec3A,
        directions: &[Vec3],
        span: &Span,
        todo: &[u64],
        hit: &mut [u64],
    ) {
        let Some(local_from_world) = mover.local_from_world else {
            return;
        };
        let body = self.body(mover);
        let masked = self.cutouts[mover.mesh as usize].is_some();
        let origin = local_from_world * (origin - mover.translation);
        if !origin.is_finite() {
            return;
        }
        for_each_open(todo, hit, directions.len(), |i| {
            let direction = local_from_world * (Vec3A::from(directions[i]) * span.unit);
            ray(origin, direction, span.end).is_some_and(|ray| {
                body.bounds.intersect_ray(&ray) < ray.tmax
                    && body.any(ray, |id, u, v| {
                        !masked || !self.hole_at(mover.mesh, id, u, v)
                    })
            })
        });
    }
}

/// The corners of a mesh's triangles, at other positions.
fn corners_of(mesh: &Mesh, positions: &[Vec3]) -> Vec<Corners> {
    let at = |i: u32| positions.get(i as usize).copied().unwrap_or(Vec3::NAN);
    mesh.triangles
        .iter()
        .map(|t| Corners::new(t.map(at)))
        .collect()
}

struct Bundled<'a> {
    fan: &'a Fan<'a>,
    bundle: &'a fan::Bundle,
    placed: Option<(Mat3A, Mat3A, Vec3A)>,
    body: &'a Body,
    t_max: f32,
    todo: &'a [u64],
    hit: &'a mut [u64],
}
struct Solid<'a, F>(Bundled<'a>, F);

impl<F: Fn(u32, f32, f32) -> bool> Solid<'_, F> {
    #[inline(always)]
    fn run<L: Lanes>(self, lanes: L) {
        let Solid(b, solid) = self;
        let mut rays = Rays::new(lanes, b.fan, b.bundle, b.placed, b.t_max, b.todo, b.hit);
        b.body.any_of(&mut rays, solid);
        rays.gather(b.todo, b.hit);
    }
}

#[cfg(target_arch = "x86_64")]
struct WithAvx<'a, F>(Solid<'a, F>, pulp::x86::V3);

#[cfg(target_arch = "x86_64")]
impl<F: Fn(u32, f32, f32) -> bool> pulp::NullaryFnOnce for WithAvx<'_, F> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.0.run(self.1);
    }
}

impl CpuTracer {
    fn dispatch<F: Fn(u32, f32, f32) -> bool>(&self, solid: Solid<'_, F>) {
        #[cfg(target_arch = "x86_64")]
        if let Some(avx) = self.avx {
            return avx.vectorize(WithAvx(solid, avx));
        }
        solid.run(lanes::Plain)
    }
}

impl Tracer for CpuTracer {
    fn occluded(
        &self,
        against: Against,
        origin: Vec3,
        directions: &[Vec3],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) {
        let origin = Vec3A::from(origin);
        let Some(span) = self.span(origin, t_max) else {
            return;
        };
        self.each_body(against, origin, t_max, |mover, plain| match mover {
            Some(mover) => self.occluded_by_mover(mover, origin, directions, &span, todo, hit),
            None => for_each_open(todo, hit, directions.len(), |i| {
                ray(origin, Vec3A::from(directions[i]) * span.unit, span.end).is_some_and(|ray| {
                    self.fixed
                        .any(ray, |id, u, v| plain || self.solid(against, id, u, v))
                })
            }),
        });
    }

    fn occluded_fan(
        &self,
        against: Against,
        fan: &Fan<'_>,
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) {
        let Some(span) = self.span(fan.origin.into(), t_max) else {
            return;
        };
        let t_max = span.end * span.unit;
        self.each_body(against, fan.origin.into(), t_max, |mover, plain| {
            let (body, placed) = match mover {
                None => (&self.fixed, None),
                Some(mover) => match mover.local_from_world {
                    Some(m) => (
                        self.body(mover),
                        Some((m, mover.world_from_local, mover.translation)),
                    ),
                    None => return,
                },
            };
            for (bundle, words) in fan.bundles() {
                let (todo, hit) = (&todo[words.clone()], &mut hit[words]);
                let trace = Bundled {
                    fan,
                    bundle,
                    placed,
                    body,
                    t_max,
                    todo,
                    hit,
                };
                match mover {
                    None if plain => self.dispatch(Solid(trace, |_, _, _| true)),
                    None => {
                        let solid = |id, u, v| self.solid(against, id, u, v);
                        self.dispatch(Solid(trace, solid));
                    }
                    Some(mover) if self.cutouts[mover.mesh as usize].is_none() => {
                        self.dispatch(Solid(trace, |_, _, _| true));
                    }
                    Some(mover) => {
                        let solid = |id, u, v| !self.hole_at(mover.mesh, id, u, v);
                        self.dispatch(Solid(trace, solid));
                    }
                }
            }
        });
    }

    fn closest(&self, origin: Vec3, direction: Vec3, t_max: f32) -> Option<Hit> {
        let (origin, direction) = (Vec3A::from(origin), Vec3A::from(direction));
        let span = self.span(origin, t_max)?;
        let mut world = ray(origin, direction * span.unit, span.end)?;
        let fixed = self.fixed.nearest(world, |id, u, v| {
            let (instance, triangle) = self.fixed_source(id);
            !self.hole_at(self.mesh_of[instance as usize], triangle, u, v)
        });
        let mut hit = fixed.map(|(id, t, u, v)| {
            let (instance, triangle) = self.fixed_source(id);
            world.tmax = t;
            Hit {
                instance,
                triangle,
                u,
                v,
                t,
            }
        });
        body::along(&self.top, world, |world, slot| {
            let mover = &self.movers[self.top.primitive_indices[slot] as usize];
            let nearer = mover.local_from_world.and_then(|local_from_world| {
                let origin = local_from_world * (origin - mover.translation);
                let local = ray(origin, local_from_world * world.direction, world.tmax)?;
                self.body(mover)
                    .nearest(local, |id, u, v| !self.hole_at(mover.mesh, id, u, v))
            });
            if let Some((triangle, t, u, v)) = nearer {
                world.tmax = t;
                hit = Some(Hit {
                    instance: mover.instance,
                    triangle,
                    u,
                    v,
                    t,
                });
            }
            true
        });
        hit.map(|hit| Hit {
            t: hit.t * span.unit,
            ..hit
        })
    }

    fn update(&mut self, scene: &Scene, pose: &Pose, deformed: &[Deformed]) {
        let meshes = &self.meshes;
        self.movers.par_iter_mut().for_each(|mover| {
            if let Some(own) = &mut mover.own
                && let Ok(at) = deformed.binary_search_by_key(&mover.instance, |d| d.instance)
            {
                let mesh = &scene.meshes[mover.mesh as usize];
                own.refit(&corners_of(mesh, &deformed[at].positions));
            }
            let place = &pose.instances[mover.instance as usize].world_from_local;
            let body = mover.own.as_ref().unwrap_or(&meshes[mover.mesh as usize]);
            mover.local_from_world = inverse(place).filter(|_| body.bounds.valid());
            mover.world_from_local = place.matrix3;
            mover.translation = place.translation;
            mover.bounds = body::placed(&body.bounds, place);
            if !(mover.bounds.min.is_finite() && mover.bounds.max.is_finite()) {
                mover.local_from_world = None;
            }
        });
        let mut hittable = Vec::new();
        let mut boxes = Vec::new();
        self.bounds = self.fixed.bounds;
        for (i, mover) in self.movers.iter().enumerate() {
            if mover.local_from_world.is_some() {
                hittable.push(i as u32);
                boxes.push(mover.bounds);
                self.bounds = self.bounds.union(&mover.bounds);
            }
        }
        self.top = body::tree(&mut boxes, &body::TOP);
        for slot in &mut self.top.primitive_indices {
            *slot = hittable[*slot as usize];
        }
    }
}
