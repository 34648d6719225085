//! The scene: meshes, instances, and how they are posed at a time.
//!
//! All positions a caller sees are metres relative to [`Scene::origin`], so that `f32` is precise
//! however far the scene lies from the world's origin: hierarchies are composed in `f64`, and the
//! origin is subtracted there.

use glam::{Affine3A, DAffine3, DVec3, Mat4, Quat, Vec2, Vec3};

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
}
