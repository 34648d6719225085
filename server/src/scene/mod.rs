//! The scene: meshes, instances, and how they are posed at a time.
//!
//! All positions a caller sees are metres relative to [`Scene::origin`], so that `f32` is precise
//! however far the scene lies from the world's origin: hierarchies are composed in `f64`, and the
//! origin is subtracted there.

mod atrium;
pub(crate) mod gltf;

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

pub use self::gltf::{MeshOrigin, Origins};
use glam::{Affine3A, DAffine3, DVec3, Mat3A, Mat4, Quat, Vec2, Vec3, Vec3A};

/// Geometry once, in its own rest space (a glTF primitive).
#[derive(Clone, Debug, Default)]
pub struct Mesh {
    /// The source's name, for messages.
    pub name: String,
    /// Vertex positions in rest space, before morphing and skinning. All finite.
    pub positions: Vec<Vec3>,
    /// Unit vertex normals in rest space, as many as positions (generated where missing).
    pub normals: Vec<Vec3>,
    /// Texture coordinates for the mask; empty where there is no mask, else as many as positions.
    pub uvs: Vec<Vec2>,
    /// Vertex indices, each within `positions`; no triangle is of zero area.
    pub triangles: Vec<[u32; 3]>,
    /// Both sides are visible and carry points.
    pub double_sided: bool,
    /// Alpha mask: texels below the cutoff are holes, for points and for rays.
    pub mask: Option<Mask>,
    /// Joint indices a vertex; empty unless skinned. Each within the skin of every instance.
    pub joints: Vec<[u16; 4]>,
    /// Joint weights a vertex, summing to 1; empty unless skinned.
    pub weights: Vec<[f32; 4]>,
    /// Morph targets: deltas a vertex.
    pub morphs: Vec<Morph>,
}

/// One morph target of a mesh.
#[derive(Clone, Debug, Default)]
pub struct Morph {
    /// Position deltas, as many as the mesh has positions.
    pub positions: Vec<Vec3>,
    /// Normal deltas, as many as positions, or empty.
    pub normals: Vec<Vec3>,
}

/// The alpha channel of a MASK material.
#[derive(Clone, Debug)]
pub struct Mask {
    /// Texels across.
    pub width: u32,
    /// Texels down.
    pub height: u32,
    /// Alpha times the material's base alpha, row by row from the top, `width * height` long.
    pub alpha: Vec<u8>,
    /// A texel whose alpha / 255 is below this is a hole.
    pub cutoff: f32,
    /// Wrap mode along u and v.
    pub wrap: [Wrap; 2],
}

/// What a texture does outside 0..1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wrap {
    /// The edge texel goes on.
    Clamp,
    /// The texture repeats.
    Repeat,
    /// The texture repeats, every second time mirrored.
    Mirror,
}

/// A node's place relative to its parent.
#[derive(Clone, Copy, Debug)]
pub enum LocalTransform {
    /// Translation, rotation, scale: what animations drive.
    Trs {
        /// Metres (after the unit), in `f64`: roots may lie far out.
        translation: DVec3,
        /// Unit quaternion.
        rotation: Quat,
        /// Per axis; may be negative.
        scale: Vec3,
    },
    /// Any affine matrix.
    Matrix(DAffine3),
}

/// A node of the hierarchy.
#[derive(Clone, Debug)]
pub struct Node {
    /// The source's name.
    pub name: String,
    /// Index of the parent; always less than the node's own index.
    pub parent: Option<u32>,
    /// Rest transform relative to the parent.
    pub local: LocalTransform,
    /// Rest morph weights (from the node, else the mesh); empty without morph targets.
    pub morph_weights: Vec<f32>,
}

/// A mesh placed in the scene. Its index is the instance index of the stream: nodes in depth-first
/// order from the scene's roots, and within a node its mesh's primitives in the file's order;
/// added files after the main one.
#[derive(Clone, Debug)]
pub struct Instance {
    /// Node name, for messages.
    pub name: String,
    /// Index into [`Scene::meshes`].
    pub mesh: u32,
    /// Index into [`Scene::nodes`].
    pub node: u32,
    /// Index into [`Scene::skins`].
    pub skin: Option<u32>,
    /// Its transform changes with time.
    pub moves: bool,
    /// Its vertices move relative to its own local space (skin, or morph targets).
    pub deforms: bool,
}

/// Joints of a skinned mesh.
#[derive(Clone, Debug)]
pub struct Skin {
    /// Node indices.
    pub joints: Vec<u32>,
    /// Rest space of the mesh to the joint's space, as many as joints.
    pub inverse_bind: Vec<Mat4>,
}

/// Key frames that drive one property of one node; looped over its animation's duration.
#[derive(Clone, Debug)]
pub struct Channel {
    /// Node driven.
    pub node: u32,
    /// Key times in seconds, increasing.
    pub times: Vec<f32>,
    /// Between keys.
    pub interpolation: Interpolation,
    /// Values at the keys.
    pub values: Keys,
}

/// What happens between two keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// The value of the key before.
    Step,
    /// Linear; spherical for rotations.
    Linear,
    /// Hermite; each key holds in-tangent, value, out-tangent.
    CubicSpline,
}

/// Key values of a channel (three per key for cubic splines).
#[derive(Clone, Debug)]
pub enum Keys {
    /// Translations.
    Translation(Vec<Vec3>),
    /// Rotations.
    Rotation(Vec<Quat>),
    /// Scales.
    Scale(Vec<Vec3>),
    /// Morph weights, `count` a key.
    MorphWeights {
        /// Weights a key.
        count: usize,
        /// All keys' weights.
        weights: Vec<f32>,
    },
}

/// Channels that loop together.
#[derive(Clone, Debug)]
pub struct Animation {
    /// The source's name.
    pub name: String,
    /// Seconds; the last key of any channel. Above 0.
    pub duration_s: f32,
    /// Channels.
    pub channels: Vec<Channel>,
}

/// Everything that can be ray traced, and its clock.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// File name or `atrium`.
    pub name: String,
    /// Geometry.
    pub meshes: Vec<Mesh>,
    /// Hierarchy, parents first.
    pub nodes: Vec<Node>,
    /// Skins.
    pub skins: Vec<Skin>,
    /// Placements; see [`Instance`] for their order.
    pub instances: Vec<Instance>,
    /// All play at once, each looped (of each file, its first).
    pub animations: Vec<Animation>,
    /// Centre of the world bounds at time 0, in world metres. Poses are relative to it.
    pub origin: DVec3,
    /// What was dropped while loading.
    pub dropped: Dropped,
}

/// What the loader left out, counted: nothing disappears silently.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Triangles of zero area, or with a non-finite vertex.
    pub degenerate_triangles: u64,
    /// Triangles that name a vertex that is not there.
    pub out_of_range_triangles: u64,
    /// Primitives that are points or lines, or have no triangle left.
    pub empty_primitives: u64,
    /// Vertices with a NaN or infinite attribute (their triangles are dropped or repaired).
    pub non_finite_vertices: u64,
    /// Vertices whose joints are out of range: bound rigidly to the skin's first joint.
    pub bad_joints: u64,
    /// Animation channels that could not be read.
    pub bad_channels: u64,
}

/// Where one instance is at one time: what an engine would feed.
///
/// Where `world_from_local` mirrors (its determinant is negative), a triangle's winding is
/// reversed in world space: its front there is `cross(e1, e2)` times the determinant's sign.
/// Normals need no such care: [`InstancePose::world_normal`] keeps them on the front.
#[derive(Clone, Debug, Default)]
pub struct InstancePose {
    /// Local space to metres relative to [`Scene::origin`].
    pub world_from_local: Affine3A,
    /// Rest space to local space, one a joint; empty unless skinned.
    pub joints: Vec<Affine3A>,
    /// Morph weights; empty without targets.
    pub morph_weights: Vec<f32>,
}

/// Where everything is at one time.
#[derive(Clone, Debug, Default)]
pub struct Pose {
    /// Seconds since the scene's start.
    pub time_s: f64,
    /// One an instance.
    pub instances: Vec<InstancePose>,
    /// Working memory of [`Scene::pose`], kept so that posing again allocates nothing.
    pub scratch: PoseScratch,
}

/// Working memory of [`Scene::pose`]; its content means nothing to a caller.
#[derive(Clone, Debug, Default)]
pub struct PoseScratch {
    locals: Vec<LocalTransform>,
    worlds: Vec<DAffine3>,
    weights: Vec<Vec<f32>>,
}

/// Why a scene could not be had: names the file, the thing in it, and the remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneError(String);

impl fmt::Display for SceneError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for SceneError {}

/// A file to add to a scene, and where: `FILE@x,y,z` or `FILE@x,y,z,scale`.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// The glTF file.
    pub path: PathBuf,
    /// Where its origin goes, in world metres.
    pub at: DVec3,
    /// Metres per unit of the file; above 0, 1 where the text names none.
    pub scale: f64,
}

impl FromStr for Placement {
    type Err = SceneError;

    fn from_str(text: &str) -> Result<Self, SceneError> {
        let bad = |what: &str| {
            SceneError(format!(
                "`{text}`: {what}; write FILE@x,y,z or FILE@x,y,z,scale in metres"
            ))
        };
        let (path, place) = text
            .rsplit_once('@')
            .ok_or_else(|| bad("there is no `@`"))?;
        if path.is_empty() {
            return Err(bad("there is no file name before `@`"));
        }
        let numbers = (place.split(','))
            .map(|part| match part.trim().parse::<f64>() {
                Ok(number) if number.is_finite() => Ok(number),
                _ => Err(bad(&format!("`{part}` is not a finite number"))),
            })
            .collect::<Result<Vec<f64>, SceneError>>()?;
        let (at, scale) = match numbers[..] {
            [x, y, z] => (DVec3::new(x, y, z), 1.0),
            [x, y, z, scale] => (DVec3::new(x, y, z), scale),
            _ => {
                return Err(bad(&format!(
                    "{} numbers after `@`, not 3 or 4",
                    numbers.len()
                )));
            }
        };
        if scale <= 0.0 {
            return Err(bad("the scale is not above 0"));
        }
        Ok(Placement {
            path: path.into(),
            at,
            scale,
        })
    }
}

impl LocalTransform {
    /// No transform, in the form that animations drive.
    pub const IDENTITY: LocalTransform = LocalTransform::Trs {
        translation: DVec3::ZERO,
        rotation: Quat::IDENTITY,
        scale: Vec3::ONE,
    };

    fn matrix(&self) -> DAffine3 {
        match *self {
            LocalTransform::Trs {
                translation,
                rotation,
                scale,
            } => DAffine3::from_scale_rotation_translation(
                scale.as_dvec3(),
                rotation.as_dquat().normalize(),
                translation,
            ),
            LocalTransform::Matrix(matrix) => matrix,
        }
    }
}

impl Mask {
    /// Whether the surface has a hole at `uv` (any values; wrapped, then the nearest texel).
    pub fn is_hole(&self, uv: Vec2) -> bool {
        let texel = |coordinate: f32, size: u32, wrap: Wrap| {
            let c = if coordinate.is_finite() {
                f64::from(coordinate)
            } else {
                0.0
            };
            let c = match wrap {
                Wrap::Clamp => c,
                Wrap::Repeat => c.rem_euclid(1.0),
                Wrap::Mirror => 1.0 - (c.rem_euclid(2.0) - 1.0).abs(),
            };
            // The conversion saturates, so that negative values end at texel 0.
            ((c * f64::from(size)) as usize).min((size as usize).saturating_sub(1))
        };
        let x = texel(uv.x, self.width, self.wrap[0]);
        let y = texel(uv.y, self.height, self.wrap[1]);
        let alpha = self.alpha.get(y * self.width as usize + x);
        alpha.is_some_and(|&alpha| self.is_below_cutoff(alpha))
    }

    fn is_below_cutoff(&self, alpha: u8) -> bool {
        f32::from(alpha) / 255.0 < self.cutoff
    }
}

impl InstancePose {
    /// The unit normal in the world of a normal in local space: by the inverse transpose, which
    /// keeps it on the surface's front under any scale and mirroring. Where the transform
    /// flattens the surface, so that it has no normal, the local one comes back.
    pub fn world_normal(&self, normal: Vec3) -> Vec3 {
        transform_normal(&self.world_from_local.matrix3, normal)
    }
}

/// The inverse transpose without its division: the cofactors, which differ from it by the
/// determinant, hence the sign.
fn transform_normal(matrix: &Mat3A, normal: Vec3) -> Vec3 {
    let size = (matrix.x_axis.abs().max(matrix.y_axis.abs()))
        .max(matrix.z_axis.abs())
        .max_element();
    let m = *matrix * (1.0 / size);
    let [x, y, z] = [
        m.y_axis.cross(m.z_axis),
        m.z_axis.cross(m.x_axis),
        m.x_axis.cross(m.y_axis),
    ];
    let turned = x * normal.x + y * normal.y + z * normal.z;
    let facing = if m.x_axis.dot(x) < 0.0 {
        -turned
    } else {
        turned
    };
    facing.try_normalize().map_or(normal, Vec3::from)
}

impl Channel {
    /// Sets the property that this channel drives to its value at `t` seconds.
    fn apply(&self, t: f32, local: &mut LocalTransform, weights: &mut [f32]) {
        if let Keys::MorphWeights {
            count,
            weights: keys,
        } = &self.values
        {
            for (slot, weight) in weights.iter_mut().enumerate().take(*count) {
                *weight = self.value(
                    t,
                    |i| keys[i * count + slot],
                    |a, b, u| a + (b - a) * u,
                    hermite,
                );
            }
            return;
        }
        let LocalTransform::Trs {
            translation,
            rotation,
            scale,
        } = local
        else {
            return;
        };
        match &self.values {
            Keys::Translation(keys) => {
                *translation = self.value(t, |i| keys[i], Vec3::lerp, hermite).as_dvec3();
            }
            Keys::Scale(keys) => *scale = self.value(t, |i| keys[i], Vec3::lerp, hermite),
            Keys::Rotation(keys) => {
                let value = self.value(t, |i| keys[i], Quat::slerp, hermite);
                let length = value.length();
                *rotation = if length > 0.0 {
                    value / length
                } else {
                    Quat::IDENTITY
                };
            }
            Keys::MorphWeights { .. } => {}
        }
    }

    /// The value at `t`, of keys read by `key`; held before the first and after the last.
    fn value<T>(
        &self,
        t: f32,
        key: impl Fn(usize) -> T,
        lerp: impl Fn(T, T, f32) -> T,
        hermite: impl Fn([T; 4], f32, f32) -> T,
    ) -> T {
        let cubic = self.interpolation == Interpolation::CubicSpline;
        let at = |k: usize| if cubic { key(3 * k + 1) } else { key(k) };
        let next = self.times.partition_point(|&time| time <= t);
        if next == 0 {
            return at(0);
        }
        if next == self.times.len() || self.interpolation == Interpolation::Step {
            return at(next - 1);
        }
        let span = self.times[next] - self.times[next - 1];
        let u = (t - self.times[next - 1]) / span;
        if cubic {
            let ends = [at(next - 1), key(3 * next - 1), key(3 * next), at(next)];
            hermite(ends, u, span)
        } else {
            lerp(at(next - 1), at(next), u)
        }
    }
}

/// glTF's cubic spline: value and out-tangent of one key, in-tangent and value of the next.
fn hermite<T>([v0, out0, in1, v1]: [T; 4], u: f32, span: f32) -> T
where
    T: std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
{
    let (u2, u3) = (u * u, u * u * u);
    v0 * (2.0 * u3 - 3.0 * u2 + 1.0)
        + out0 * ((u3 - 2.0 * u2 + u) * span)
        + in1 * ((u3 - u2) * span)
        + v1 * (3.0 * u2 - 2.0 * u3)
}

/// To single precision; what does not fit there collapses to a point, so that no infinity or NaN
/// spreads from one broken node over everything downstream.
fn finite_affine(matrix: DAffine3) -> Affine3A {
    let single = matrix.as_affine3a();
    if single.is_finite() {
        single
    } else {
        Affine3A::ZERO
    }
}

impl Scene {
    /// Poses everything at `time_s` seconds (any finite time; animations loop). Reuses the memory
    /// that `pose` has.
    pub fn pose(&self, time_s: f64, pose: &mut Pose) {
        let time_s = if time_s.is_finite() { time_s } else { 0.0 };
        pose.time_s = time_s;
        let PoseScratch {
            locals,
            worlds,
            weights,
        } = &mut pose.scratch;

        locals.clear();
        locals.extend(self.nodes.iter().map(|node| node.local));
        weights.resize_with(self.nodes.len(), Vec::new);
        for (weights, node) in weights.iter_mut().zip(&self.nodes) {
            weights.clear();
            weights.extend_from_slice(&node.morph_weights);
        }
        for animation in &self.animations {
            let t = time_s.rem_euclid(f64::from(animation.duration_s)) as f32;
            for channel in &animation.channels {
                let node = channel.node as usize;
                channel.apply(t, &mut locals[node], &mut weights[node]);
            }
        }

        worlds.clear();
        for (node, local) in self.nodes.iter().zip(locals.iter()) {
            let local = local.matrix();
            worlds.push(
                node.parent
                    .map_or(local, |parent| worlds[parent as usize] * local),
            );
        }

        pose.instances
            .resize_with(self.instances.len(), InstancePose::default);
        for (instance, out) in self.instances.iter().zip(&mut pose.instances) {
            let node = instance.node as usize;
            let mut world = worlds[node];
            out.joints.clear();
            if let Some(skin) = instance.skin {
                let skin = &self.skins[skin as usize];
                let mut local_from_world = world.inverse();
                if !local_from_world.is_finite() {
                    // Only the joints place a skinned mesh: its own node may be anything.
                    world = DAffine3::from_translation(world.translation);
                    local_from_world = world.inverse();
                }
                for (&joint, bind) in skin.joints.iter().zip(&skin.inverse_bind) {
                    let bind = DAffine3::from_mat4(bind.as_dmat4());
                    let joint = local_from_world * worlds[joint as usize] * bind;
                    out.joints.push(finite_affine(joint));
                }
            }
            world.translation -= self.origin;
            out.world_from_local = finite_affine(world);
            out.morph_weights.clear();
            if !self.meshes[instance.mesh as usize].morphs.is_empty() {
                out.morph_weights.extend_from_slice(&weights[node]);
            }
        }
    }

    /// The vertices of an instance in its local space: morphed, then skinned; unit normals. Rigid
    /// instances give their rest. `pose` may come from anywhere: a joint or a weight that it lacks
    /// counts as at rest.
    ///
    /// # Panics
    /// Where there is no such instance.
    pub fn deform(
        &self,
        instance: usize,
        pose: &InstancePose,
        positions: &mut Vec<Vec3>,
        normals: &mut Vec<Vec3>,
    ) {
        let instance = &self.instances[instance];
        let mesh = &self.meshes[instance.mesh as usize];
        positions.clear();
        positions.extend_from_slice(&mesh.positions);
        normals.clear();
        normals.extend_from_slice(&mesh.normals);

        for (morph, &weight) in mesh.morphs.iter().zip(&pose.morph_weights) {
            for (position, &delta) in positions.iter_mut().zip(&morph.positions) {
                *position += delta * weight;
            }
            for (normal, &delta) in normals.iter_mut().zip(&morph.normals) {
                *normal += delta * weight;
            }
        }
        if !mesh.morphs.is_empty() {
            for (normal, &rest) in normals.iter_mut().zip(&mesh.normals) {
                *normal = normal.try_normalize().unwrap_or(rest);
            }
        }

        if instance.skin.is_some() {
            for v in 0..mesh.joints.len() {
                let mut matrix = Mat3A::ZERO;
                let mut translation = Vec3A::ZERO;
                for (&joint, &weight) in mesh.joints[v].iter().zip(&mesh.weights[v]) {
                    let joint = pose
                        .joints
                        .get(joint as usize)
                        .copied()
                        .unwrap_or(Affine3A::IDENTITY);
                    matrix += joint.matrix3 * weight;
                    translation += joint.translation * weight;
                }
                positions[v] = (matrix * Vec3A::from(positions[v]) + translation).into();
                normals[v] = transform_normal(&matrix, normals[v]);
            }
        }
    }

    /// Smallest box around every vertex, in metres relative to the origin. Always finite: what
    /// is not is left out, and of a scene without vertices it is the origin alone.
    pub fn bounds(&self, pose: &Pose) -> [Vec3; 2] {
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for (index, instance) in self.instances.iter().enumerate() {
            let at = &pose.instances[index];
            let local = if instance.deforms {
                self.deform(index, at, &mut positions, &mut normals);
                &positions
            } else {
                &self.meshes[instance.mesh as usize].positions
            };
            for &position in local {
                let world = at.world_from_local.transform_point3(position);
                if world.is_finite() {
                    low = low.min(world);
                    high = high.max(world);
                }
            }
        }
        if low.cmple(high).all() {
            [low, high]
        } else {
            [Vec3::ZERO; 2]
        }
    }

    /// Puts the origin at the centre of the bounds at time 0. Every function that builds or
    /// changes a scene ends with this; call it after changing the fields by hand.
    pub fn set_origin(&mut self) {
        let mut pose = Pose::default();
        self.origin = DVec3::ZERO;
        self.pose(0.0, &mut pose);
        // A first guess in double precision, so that the bounds are precise far out too.
        let first = self
            .instances
            .first()
            .map(|instance| instance.node as usize);
        self.origin = first.map_or(DVec3::ZERO, |node| pose.scratch.worlds[node].translation);
        for _ in 0..2 {
            self.pose(0.0, &mut pose);
            let [low, high] = self.bounds(&pose);
            self.origin += (low.as_dvec3() + high.as_dvec3()) / 2.0;
        }
    }

    /// Moves, turns or scales everything: one more root node above all roots (index 0; the others
    /// move up by one).
    pub fn transform(&mut self, by: DAffine3) {
        for node in &mut self.nodes {
            node.parent = Some(node.parent.map_or(0, |parent| parent + 1));
        }
        let local = LocalTransform::Matrix(by);
        let morph_weights = Vec::new();
        self.nodes.insert(
            0,
            Node {
                name: "transform".into(),
                parent: None,
                local,
                morph_weights,
            },
        );
        self.shift_nodes(1);
        self.set_origin();
    }

    /// Moves every reference to a node, but for parents, up by `by`.
    fn shift_nodes(&mut self, by: u32) {
        self.instances
            .iter_mut()
            .for_each(|instance| instance.node += by);
        self.skins
            .iter_mut()
            .flat_map(|skin| &mut skin.joints)
            .for_each(|node| *node += by);
        let channels = self
            .animations
            .iter_mut()
            .flat_map(|animation| &mut animation.channels);
        channels.for_each(|channel| channel.node += by);
    }

    /// Adds everything of another scene, scaled by `scale` (finite, not 0) and then moved by `at`
    /// world metres. Its instances come after those that are here.
    pub fn add(&mut self, mut other: Scene, at: DVec3, scale: f64) {
        other.transform(DAffine3::from_scale_rotation_translation(
            DVec3::splat(scale),
            glam::DQuat::IDENTITY,
            at,
        ));
        let nodes = self.nodes.len() as u32;
        other.shift_nodes(nodes);
        for node in &mut other.nodes {
            node.parent = node.parent.map(|parent| parent + nodes);
        }
        for instance in &mut other.instances {
            instance.mesh += self.meshes.len() as u32;
            instance.skin = instance.skin.map(|skin| skin + self.skins.len() as u32);
        }
        self.meshes.append(&mut other.meshes);
        self.nodes.append(&mut other.nodes);
        self.skins.append(&mut other.skins);
        self.instances.append(&mut other.instances);
        self.animations.append(&mut other.animations);
        let (to, from) = (&mut self.dropped, other.dropped);
        to.degenerate_triangles += from.degenerate_triangles;
        to.out_of_range_triangles += from.out_of_range_triangles;
        to.empty_primitives += from.empty_primitives;
        to.non_finite_vertices += from.non_finite_vertices;
        to.bad_joints += from.bad_joints;
        to.bad_channels += from.bad_channels;
        self.set_origin();
    }

    /// A number for the content: geometry, masks, hierarchy, skins, instances and animations, but
    /// no names. The same on every machine, so that client and server can tell whether they have
    /// the same scene. Not for use against an adversary.
    pub fn hash(&self) -> u64 {
        let mut hash = ContentHash(0);
        hash.count(self.meshes.len());
        for mesh in &self.meshes {
            hash.vectors(&mesh.positions);
            hash.vectors(&mesh.normals);
            hash.floats(mesh.uvs.iter().flat_map(|uv| uv.to_array()));
            hash.words(mesh.triangles.as_flattened().iter().map(|&i| u64::from(i)));
            hash.word(u64::from(mesh.double_sided));
            hash.count(mesh.mask.iter().len());
            if let Some(mask) = &mesh.mask {
                hash.words([mask.width, mask.height, mask.cutoff.to_bits()].map(u64::from));
                hash.words(mask.wrap.map(|wrap| wrap as u64));
                hash.words(mask.alpha.iter().map(|&alpha| u64::from(alpha)));
            }
            hash.words(
                mesh.joints
                    .as_flattened()
                    .iter()
                    .map(|&joint| u64::from(joint)),
            );
            hash.floats(mesh.weights.as_flattened().iter().copied());
            hash.count(mesh.morphs.len());
            for morph in &mesh.morphs {
                hash.vectors(&morph.positions);
                hash.vectors(&morph.normals);
            }
        }
        hash.count(self.nodes.len());
        for node in &self.nodes {
            hash.word(node.parent.map_or(u64::MAX, u64::from));
            match node.local {
                LocalTransform::Trs {
                    translation,
                    rotation,
                    scale,
                } => {
                    hash.words(translation.to_array().map(f64::to_bits));
                    hash.floats(rotation.to_array());
                    hash.floats(scale.to_array());
                }
                LocalTransform::Matrix(matrix) => {
                    hash.words(matrix.to_cols_array().map(f64::to_bits));
                }
            }
            hash.floats(node.morph_weights.iter().copied());
        }
        hash.count(self.skins.len());
        for skin in &self.skins {
            hash.words(skin.joints.iter().map(|&joint| u64::from(joint)));
            hash.floats(skin.inverse_bind.iter().flat_map(Mat4::to_cols_array));
        }
        hash.count(self.instances.len());
        for instance in &self.instances {
            let skin = instance.skin.map_or(u64::MAX, u64::from);
            hash.words([u64::from(instance.mesh), u64::from(instance.node), skin]);
        }
        hash.count(self.animations.len());
        for animation in &self.animations {
            hash.word(u64::from(animation.duration_s.to_bits()));
            hash.count(animation.channels.len());
            for channel in &animation.channels {
                hash.words([u64::from(channel.node), channel.interpolation as u64]);
                hash.floats(channel.times.iter().copied());
                match &channel.values {
                    Keys::Translation(keys) => hash.vectors(keys),
                    Keys::Rotation(keys) => hash.floats(keys.iter().flat_map(|k| k.to_array())),
                    Keys::Scale(keys) => hash.vectors(keys),
                    Keys::MorphWeights { weights, .. } => hash.floats(weights.iter().copied()),
                }
                hash.word(match &channel.values {
                    Keys::Translation(_) => 0,
                    Keys::Rotation(_) => 1,
                    Keys::Scale(_) => 2,
                    Keys::MorphWeights { .. } => 3,
                });
            }
        }
        hash.0 ^ (hash.0 >> 32)
    }

    /// What follows from the other fields, and the origin: the last step of building.
    fn finish(&mut self) {
        let mut moves = vec![false; self.nodes.len()];
        for channel in self
            .animations
            .iter()
            .flat_map(|animation| &animation.channels)
        {
            moves[channel.node as usize] |= !matches!(channel.values, Keys::MorphWeights { .. });
        }
        for node in 0..self.nodes.len() {
            moves[node] |= self.nodes[node]
                .parent
                .is_some_and(|parent| moves[parent as usize]);
        }
        for instance in &mut self.instances {
            instance.moves = moves[instance.node as usize];
            let morphs = !self.meshes[instance.mesh as usize].morphs.is_empty();
            instance.deforms = instance.skin.is_some() || morphs;
        }
        self.set_origin();
    }
}

/// Each step is a bijection of the state, and of the word: one change anywhere always shows.
struct ContentHash(u64);

impl ContentHash {
    fn word(&mut self, word: u64) {
        self.0 = (self.0.rotate_left(23) ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    }

    fn count(&mut self, count: usize) {
        self.word(count as u64);
    }

    fn words(&mut self, words: impl IntoIterator<Item = u64>) {
        let mut count = 0;
        for word in words {
            self.word(word);
            count += 1;
        }
        self.count(count);
    }

    fn floats(&mut self, values: impl IntoIterator<Item = f32>) {
        self.words(values.into_iter().map(|value| u64::from(value.to_bits())));
    }

    fn vectors(&mut self, values: &[Vec3]) {
        self.floats(values.iter().flat_map(|value| value.to_array()));
    }
}
