//! Reads glTF 2.0 (`.gltf` and `.glb`) into a [`Scene`].
//!
//! The JSON is parsed by the `gltf` crate; everything it points to is read here, because files are
//! not to be trusted: every offset is checked, and memory is taken only for what the buffers hold.
//! Faults in single triangles, vertices and channels are repaired or dropped and counted
//! ([`Dropped`](super::Dropped)); faults that leave no sensible scene are errors.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fs;
use std::io::{Cursor, Read};
use std::path::Path;

use ::gltf::json;
use base64::Engine;
use glam::{DAffine3, DMat4, DVec3, Mat4, Quat, Vec2, Vec3};
use json::accessor::{ComponentType, Type};
use json::material::AlphaMode;
use json::mesh::{Mode, Semantic};
use json::texture::WrappingMode;
use json::validation::Checked;

use super::atrium::sin_cos;
use super::{
    Animation, Channel, Instance, Interpolation, Keys, LocalTransform, Mask, Mesh, Morph, Node,
    Pose, Scene, SceneError, Skin, Wrap,
};

/// Bytes of all files of a scene together.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 30;
/// Bytes decoded from them: few bytes can name the same data many times.
const MAX_DECODED_BYTES: u64 = 4 << 30;
/// Texels of a mask.
const MAX_TEXELS: u64 = 1 << 26;
/// Levels of the node hierarchy.
const MAX_DEPTH: usize = 1024;
/// Triangles of all instances together.
const MAX_TRIANGLES: u64 = 1 << 27;
/// Coordinates beyond this are damage, not geometry: their squares would overflow.
const MAX_COORDINATE: f32 = 1e15;
/// Metres from end to end.
const MAX_EXTENT_M: f32 = 1e7;

/// Required extensions that change nothing here, or that are read.
const HARMLESS: [&str; 5] = [
    "KHR_mesh_quantization",
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "KHR_lights_",
];

impl Scene {
    /// Loads a glTF file. `unit_m` is the metres that one unit of the file stands for (1 by the
    /// standard); where it is not 1, one root node scales everything.
    ///
    /// Plays the first animation only. Normals that the file lacks are made flat, as glTF has it.
    ///
    /// # Errors
    /// Names the file, what in it is wrong, and what to do: missing or damaged files, geometry
    /// compression (Draco, meshopt), a broken hierarchy, sizes beyond what a scene can be.
    pub fn load(path: &Path, unit_m: f64) -> Result<Scene, SceneError> {
        Scene::load_with_origins(path, unit_m).map(|(scene, _)| scene)
    }

    /// The same, and where in the file everything came from: for who writes to the file again.
    ///
    /// # Errors
    /// As [`Scene::load`].
    pub fn load_with_origins(path: &Path, unit_m: f64) -> Result<(Scene, Origins), SceneError> {
        load(path, unit_m).map_err(|what| SceneError(format!("{}: {what}", path.display())))
    }
}

/// Where in a glTF file a scene's parts came from.
#[derive(Clone, Debug, Default)]
pub struct Origins {
    /// One a mesh of the scene.
    pub meshes: Vec<MeshOrigin>,
    /// The file's node of each instance of the scene.
    pub nodes: Vec<usize>,
}

/// Where a mesh of a scene came from.
#[derive(Clone, Debug, Default)]
pub struct MeshOrigin {
    /// The file's mesh.
    pub mesh: usize,
    /// Which of its primitives.
    pub primitive: usize,
    /// For each vertex of the scene's mesh, the vertex of the primitive.
    pub vertices: Vec<u32>,
    /// Vertices of the primitive, also those that no triangle uses.
    pub count: usize,
}

/// Node transforms in double precision: the `gltf` crate has them in single, which is too coarse
/// for roots far out.
#[derive(serde::Deserialize)]
struct Precise {
    #[serde(default)]
    nodes: Vec<PreciseNode>,
}

#[derive(serde::Deserialize)]
struct PreciseNode {
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
}

fn load(path: &Path, unit_m: f64) -> Result<(Scene, Origins), String> {
    if !(unit_m.is_finite() && unit_m > 0.0) {
        return Err(format!(
            "a unit of {unit_m} m: give metres per unit, above 0"
        ));
    }
    let mut left = MAX_FILE_BYTES;
    let bytes = read_file(path, &mut left)?;
    let (text, binary) = split_glb(&bytes)?;
    let bad_json = |error: serde_json::Error| format!("not a glTF file: {error}");
    let root: json::Root = serde_json::from_slice(text).map_err(bad_json)?;
    let precise: Precise = serde_json::from_slice(text).map_err(bad_json)?;
    if !root.asset.version.starts_with("2.") {
        let version = &root.asset.version;
        return Err(format!(
            "glTF {version} is not supported; export it as glTF 2.0"
        ));
    }
    check_extensions(&root)?;

    let folder = path.parent().unwrap_or(Path::new(""));
    let mut buffers = Vec::new();
    for (index, buffer) in root.buffers.iter().enumerate() {
        let data = match &buffer.uri {
            Some(uri) => read_uri(uri, folder, &mut left)
                .map_err(|what| format!("buffer {index}: {what}"))?,
            None if index == 0 => binary.to_vec(),
            None => Vec::new(),
        };
        if (data.len() as u64) < buffer.byte_length.0 {
            let (has, wants) = (data.len(), buffer.byte_length.0);
            return Err(format!(
                "buffer {index} has {has} bytes, not the {wants} it should; the file is cut off \
                 or its data is missing: export it again"
            ));
        }
        buffers.push(data);
    }

    let mut loader = Loader {
        root: &root,
        folder,
        file_bytes: buffers.iter().map(|buffer| buffer.len() as u64).sum(),
        buffers,
        left: Cell::new(MAX_DECODED_BYTES),
        files_left: left,
        node_of: vec![None; root.nodes.len()],
        masks: BTreeMap::new(),
        scene: Scene::default(),
        origins: Origins::default(),
    };
    loader.scene.name = path
        .file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    loader.nodes(&precise)?;
    loader.skins()?;
    loader.instances()?;
    loader.bind_strays();
    loader.animation();
    let (mut scene, origins) = (loader.scene, loader.origins);
    if scene.instances.is_empty() {
        return Err(
            "no node of its scene places a mesh with triangles; export one that does".into(),
        );
    }
    scene.finish();
    if unit_m != 1.0 {
        scene.transform(DAffine3::from_scale(DVec3::splat(unit_m)));
    }

    let mut pose = Pose::default();
    scene.pose(0.0, &mut pose);
    let [low, high] = scene.bounds(&pose);
    let extent = (high - low).max_element();
    if !(scene.origin.is_finite() && extent <= MAX_EXTENT_M) {
        return Err(format!(
            "the scene is {extent:e} m across, and at most {MAX_EXTENT_M:e} m can be handled; \
             check its node transforms and the metres per unit ({unit_m})"
        ));
    }
    Ok((scene, origins))
}

/// Reads a file, and takes its size off what may still be read.
pub(crate) fn read_file(path: &Path, left: &mut u64) -> Result<Vec<u8>, String> {
    let cannot = |error: std::io::Error| {
        format!(
            "cannot read {}: {error}; put the file there, or correct the path",
            path.display()
        )
    };
    let file = fs::File::open(path).map_err(cannot)?;
    if !file.metadata().map_err(cannot)?.is_file() {
        return Err(format!(
            "{} is not a file; give a .gltf or .glb file",
            path.display()
        ));
    }
    let mut bytes = Vec::new();
    file.take(*left + 1)
        .read_to_end(&mut bytes)
        .map_err(cannot)?;
    *left = left.checked_sub(bytes.len() as u64).ok_or_else(|| {
        format!("its files have more than {MAX_FILE_BYTES} bytes; split the scene into several")
    })?;
    Ok(bytes)
}

/// The JSON and the binary chunk of a `.glb`; of any other file, the file and nothing.
pub(crate) fn split_glb(bytes: &[u8]) -> Result<(&[u8], &[u8]), String> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, &[]));
    }
    let cut = || "the .glb is damaged or cut off; export or download it again".to_string();
    let word = |at: usize| -> Option<u32> {
        Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
    };
    let chunk = |at: usize| -> Option<(&[u8], &[u8])> {
        let end = (at + 8).checked_add(word(at)? as usize)?;
        Some((bytes.get(at + 4..at + 8)?, bytes.get(at + 8..end)?))
    };
    match word(4) {
        Some(2) => {}
        Some(version) => return Err(format!(".glb version {version}; export it as glTF 2.0")),
        None => return Err(cut()),
    }
    let (kind, text) = chunk(12).ok_or_else(cut)?;
    if kind != b"JSON" {
        return Err(cut());
    }
    let next = 20 + text.len();
    match chunk(next) {
        Some((kind, data)) if kind == b"BIN\0" => Ok((text, data)),
        // Chunks of other kinds are to be ignored.
        Some(_) => Ok((text, &[])),
        None if next >= bytes.len() => Ok((text, &[])),
        None => Err(cut()),
    }
}

fn check_extensions(root: &json::Root) -> Result<(), String> {
    for name in &root.extensions_required {
        if HARMLESS.iter().any(|harmless| name.starts_with(harmless)) {
            continue;
        }
        return Err(match name.as_str() {
            "KHR_draco_mesh_compression"
            | "EXT_meshopt_compression"
            | "KHR_meshopt_compression" => format!(
                "its geometry is compressed with {name}, which is not supported; decompress it \
                 with `npx @gltf-transform/cli copy IN.glb OUT.glb`"
            ),
            _ => format!(
                "it requires the extension {name}, which is not supported; export it without"
            ),
        });
    }
    if root
        .extensions_used
        .iter()
        .any(|name| name == "EXT_mesh_gpu_instancing")
    {
        return Err(
            "its instances are in the extension EXT_mesh_gpu_instancing, which is not \
                    supported; export every instance as a node"
                .into(),
        );
    }
    Ok(())
}

/// What a URI names: `data:`, or a file relative to the scene's.
pub(crate) fn read_uri(uri: &str, folder: &Path, left: &mut u64) -> Result<Vec<u8>, String> {
    if let Some(data) = uri.strip_prefix("data:") {
        let (_, text) = data
            .split_once(";base64,")
            .ok_or("its data: URI is not base64; export it with base64 data or as a file")?;
        return base64::engine::general_purpose::STANDARD
            .decode(text)
            .map_err(|error| format!("its data: URI is damaged: {error}; export it again"));
    }
    let name = unescape(uri);
    if name.contains("://") || Path::new(&name).is_absolute() {
        return Err(format!(
            "`{name}` is not relative to the scene's file; put it beside it"
        ));
    }
    read_file(&folder.join(name), left)
}

/// Undoes percent escapes; what is no escape stays.
fn unescape(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let mut out = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        let digits = bytes
            .get(at + 1..at + 3)
            .and_then(|hex| std::str::from_utf8(hex).ok());
        let escaped = digits.and_then(|hex| u8::from_str_radix(hex, 16).ok());
        match escaped {
            Some(byte) if bytes[at] == b'%' => {
                out.push(byte);
                at += 3;
            }
            _ => {
                out.push(bytes[at]);
                at += 1;
            }
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// What an alpha mask leaves of a material.
#[derive(Clone)]
enum Alpha {
    Solid,
    AllHole,
    Masked {
        mask: Mask,
        tex_coord: u32,
        transform: UvTransform,
    },
}

/// KHR_texture_transform.
#[derive(Clone, Copy)]
struct UvTransform {
    offset: Vec2,
    rotation: f32,
    scale: Vec2,
}

impl UvTransform {
    fn apply(&self, uv: Vec2) -> Vec2 {
        // Not the platform's sine: Scene::hash must not differ by its last bit.
        let (sin, cos) = sin_cos(f64::from(self.rotation) / std::f64::consts::TAU);
        let (sin, cos) = (sin as f32, cos as f32);
        let uv = uv * self.scale;
        self.offset + Vec2::new(cos * uv.x + sin * uv.y, cos * uv.y - sin * uv.x)
    }
}

struct Loader<'a> {
    root: &'a json::Root,
    folder: &'a Path,
    buffers: Vec<Vec<u8>>,
    file_bytes: u64,
    /// Bytes that may still be decoded.
    left: Cell<u64>,
    /// Bytes that may still be read from files.
    files_left: u64,
    /// Index in the scene of each node of the file.
    node_of: Vec<Option<u32>>,
    /// By material.
    masks: BTreeMap<usize, Alpha>,
    scene: Scene,
    origins: Origins,
}

impl Loader<'_> {
    /// Takes memory from the budget.
    fn take(&self, bytes: u64) -> Result<(), String> {
        let left = self.left.get().checked_sub(bytes).ok_or_else(|| {
            format!("it expands to more than {MAX_DECODED_BYTES} bytes; simplify or split it")
        })?;
        self.left.set(left);
        Ok(())
    }

    /// The bytes of a buffer view, and its stride.
    fn view(&self, index: usize) -> Result<(&[u8], Option<u64>), String> {
        let missing = || format!("buffer view {index} is not there; export the file again");
        let view = self.root.buffer_views.get(index).ok_or_else(missing)?;
        let buffer = self.buffers.get(view.buffer.value()).ok_or_else(|| {
            format!("buffer view {index} names a buffer that is not there; export the file again")
        })?;
        let start = view.byte_offset.map_or(0, |offset| offset.0);
        let bytes = start
            .checked_add(view.byte_length.0)
            .and_then(|end| buffer.get(usize::try_from(start).ok()?..usize::try_from(end).ok()?));
        let bytes = bytes.ok_or_else(|| {
            format!("buffer view {index} reaches beyond its buffer; export the file again")
        })?;
        Ok((bytes, view.byte_stride.map(|stride| stride.0 as u64)))
    }

    /// `count` elements of `size` bytes in a buffer view.
    fn span(
        &self,
        view: usize,
        offset: u64,
        count: u64,
        size: u64,
    ) -> Result<impl Iterator<Item = &[u8]>, String> {
        let (bytes, stride) = self.view(view)?;
        let stride = stride.unwrap_or(size);
        if stride < size {
            return Err(format!(
                "buffer view {view} has a stride of {stride} bytes for elements of {size}; export \
                 the file again"
            ));
        }
        let needed = count.checked_sub(1).map_or(Some(0), |steps| {
            steps
                .checked_mul(stride)?
                .checked_add(size)?
                .checked_add(offset)
        });
        if needed.is_none_or(|needed| needed > bytes.len() as u64) {
            return Err(format!(
                "{count} elements do not fit into the {} bytes of buffer view {view}; the file \
                 is damaged: export it again",
                bytes.len()
            ));
        }
        let (offset, stride, size) = (offset as usize, stride as usize, size as usize);
        Ok((0..count as usize).map(move |i| &bytes[offset + i * stride..][..size]))
    }

    /// All elements of an accessor of `N` components, each converted by `convert`.
    fn read<const N: usize, T: Copy + Default>(
        &self,
        index: usize,
        convert: fn(ComponentType, bool, &[u8]) -> Option<T>,
    ) -> Result<Vec<[T; N]>, String> {
        let named = |what: String| format!("accessor {index}: {what}");
        let accessor = self.root.accessors.get(index);
        let accessor = accessor
            .ok_or_else(|| named("it is not there; the file is damaged: export it again".into()))?;
        let wrong = || named("its type does not suit its use; export the file again".into());
        let (Checked::Valid(component), Checked::Valid(kind)) =
            (accessor.component_type, accessor.type_)
        else {
            return Err(wrong());
        };
        let components = match kind {
            Type::Scalar => 1,
            Type::Vec2 => 2,
            Type::Vec3 => 3,
            Type::Vec4 | Type::Mat2 => 4,
            Type::Mat3 => 9,
            Type::Mat4 => 16,
        };
        if components != N {
            return Err(wrong());
        }
        let component = component.0;
        let width = component_bytes(component);
        let size = (N * width) as u64;
        let element = |bytes: &[u8]| -> Option<[T; N]> {
            let mut out = [T::default(); N];
            for (value, bytes) in out.iter_mut().zip(bytes.chunks_exact(width)) {
                *value = convert(component, accessor.normalized, bytes)?;
            }
            Some(out)
        };

        let count = accessor.count.0;
        let mut values = match accessor.buffer_view {
            Some(view) => {
                let offset = accessor.byte_offset.map_or(0, |offset| offset.0);
                let span = self
                    .span(view.value(), offset, count, size)
                    .map_err(named)?;
                self.take(count.saturating_mul(size_of::<[T; N]>() as u64))?;
                span.map(element)
                    .collect::<Option<Vec<_>>>()
                    .ok_or_else(wrong)?
            }
            None => {
                // All zero but for what is sparse. A mesh of more vertices than the file has bytes
                // is none.
                if count > self.file_bytes {
                    return Err(named(format!(
                        "{count} elements without data; export it again"
                    )));
                }
                self.take(count * size_of::<[T; N]>() as u64)?;
                vec![[T::default(); N]; count as usize]
            }
        };
        if let Some(sparse) = &accessor.sparse {
            let Checked::Valid(index_type) = sparse.indices.component_type else {
                return Err(wrong());
            };
            let view = sparse.indices.buffer_view.value();
            let width = component_bytes(index_type.0) as u64;
            let (at, many) = (sparse.indices.byte_offset.0, sparse.count.0);
            let indices = self.span(view, at, many, width).map_err(named)?;
            let view = sparse.values.buffer_view.value();
            let at = sparse.values.byte_offset.0;
            let replacements = self.span(view, at, many, size).map_err(named)?;
            for (place, bytes) in indices.zip(replacements) {
                let place = to_uint(index_type.0, false, place).ok_or_else(wrong)?;
                let value = values.get_mut(place as usize).ok_or_else(|| {
                    named("a sparse index is out of range; export the file again".into())
                })?;
                *value = element(bytes).ok_or_else(wrong)?;
            }
        }
        Ok(values)
    }

    fn vec3s(&self, index: usize) -> Result<Vec<Vec3>, String> {
        Ok(self
            .read::<3, f32>(index, to_float)?
            .into_iter()
            .map(Vec3::from)
            .collect())
    }

    /// The nodes of the default scene, depth first.
    fn nodes(&mut self, precise: &Precise) -> Result<(), String> {
        let root = self.root;
        let chosen = root.scene.map_or(0, |scene| scene.value());
        let mut stack: Vec<(usize, Option<u32>, usize)> = Vec::new();
        if let Some(scene) = root.scenes.get(chosen) {
            stack.extend(scene.nodes.iter().map(|node| (node.value(), None, 1)));
        } else if root.scene.is_some() {
            return Err(format!(
                "its default scene {chosen} is not there; export it again"
            ));
        } else {
            let mut child = vec![false; root.nodes.len()];
            for node in root
                .nodes
                .iter()
                .filter_map(|node| node.children.as_ref())
                .flatten()
            {
                if let Some(child) = child.get_mut(node.value()) {
                    *child = true;
                }
            }
            stack.extend(
                (0..root.nodes.len())
                    .filter(|&n| !child[n])
                    .map(|n| (n, None, 1)),
            );
        }
        stack.reverse();

        while let Some((index, parent, depth)) = stack.pop() {
            let (Some(node), Some(precise)) = (root.nodes.get(index), precise.nodes.get(index))
            else {
                return Err(format!("node {index} is not there; export the file again"));
            };
            let name = label("node", index, node.name.as_deref());
            if self.node_of[index].is_some() {
                return Err(format!(
                    "{name} has two parents, or is its own ancestor; nodes must form a tree"
                ));
            }
            if depth > MAX_DEPTH {
                return Err(format!(
                    "{name} lies more than {MAX_DEPTH} levels deep; flatten the hierarchy"
                ));
            }
            let here = self.scene.nodes.len() as u32;
            self.node_of[index] = Some(here);
            let local = local_transform(node, precise).ok_or_else(|| {
                format!("{name}: its transform is not finite or its rotation is zero; correct it")
            })?;
            let mesh = node.mesh.and_then(|mesh| root.meshes.get(mesh.value()));
            let targets = (mesh.iter().flat_map(|mesh| &mesh.primitives))
                .map(|primitive| primitive.targets.as_ref().map_or(0, Vec::len))
                .max()
                .unwrap_or(0);
            let weights = node
                .weights
                .as_ref()
                .or(mesh.and_then(|mesh| mesh.weights.as_ref()));
            let mut morph_weights = weights.cloned().unwrap_or_default();
            morph_weights.resize(targets, 0.0);
            if !morph_weights
                .iter()
                .all(|weight| weight.abs() <= MAX_COORDINATE)
            {
                return Err(format!("{name}: a morph weight is not finite; correct it"));
            }
            self.scene.nodes.push(Node {
                name,
                parent,
                local,
                morph_weights,
            });
            let children = node.children.iter().flatten().rev();
            stack.extend(children.map(|child| (child.value(), Some(here), depth + 1)));
        }
        Ok(())
    }

    fn skins(&mut self) -> Result<(), String> {
        for (index, skin) in self.root.skins.iter().enumerate() {
            let name = label("skin", index, skin.name.as_deref());
            let mut joints = Vec::new();
            for joint in &skin.joints {
                let node = self.node_of.get(joint.value()).copied().flatten();
                joints.push(node.ok_or_else(|| {
                    format!(
                        "{name}: joint {} is no node of the scene; export the whole skeleton",
                        joint.value()
                    )
                })?);
            }
            if joints.is_empty() || joints.len() > 1 << 16 {
                return Err(format!(
                    "{name} has {} joints, not 1 to 65536",
                    joints.len()
                ));
            }
            let mut inverse_bind = match skin.inverse_bind_matrices {
                None => vec![Mat4::IDENTITY; joints.len()],
                Some(accessor) => (self.read::<16, f32>(accessor.value(), to_float))
                    .map_err(|what| format!("{name}: {what}"))?
                    .iter()
                    .map(Mat4::from_cols_array)
                    .collect(),
            };
            if inverse_bind.len() < joints.len() || !inverse_bind.iter().all(Mat4::is_finite) {
                return Err(format!(
                    "{name}: its inverse bind matrices are too few or not finite; export it again"
                ));
            }
            inverse_bind.truncate(joints.len());
            self.scene.skins.push(Skin {
                joints,
                inverse_bind,
            });
        }
        Ok(())
    }

    /// The meshes that nodes use, and their placements.
    fn instances(&mut self) -> Result<(), String> {
        // A file's mesh is read when a node first uses it: its primitives, as scene meshes.
        let mut meshes: Vec<Option<Vec<u32>>> = vec![None; self.root.meshes.len()];
        let mut order: Vec<(u32, usize)> = (self.node_of.iter().enumerate())
            .filter_map(|(index, node)| Some(((*node)?, index)))
            .collect();
        order.sort_unstable();
        let mut triangles = 0;
        for (node, index) in order {
            let source = &self.root.nodes[index];
            let Some(mesh) = source.mesh.map(|mesh| mesh.value()) else {
                continue;
            };
            let name = self.scene.nodes[node as usize].name.clone();
            let skin = match source.skin {
                Some(skin) if skin.value() >= self.scene.skins.len() => {
                    return Err(format!(
                        "{name} names a skin that is not there; export it again"
                    ));
                }
                skin => skin.map(|skin| skin.value() as u32),
            };
            let Some(primitives) = meshes.get(mesh) else {
                return Err(format!(
                    "{name} names a mesh that is not there; export it again"
                ));
            };
            let primitives = match primitives {
                Some(primitives) => primitives.clone(),
                None => self.mesh(mesh)?,
            };
            for &mesh in &primitives {
                let data = &self.scene.meshes[mesh as usize];
                triangles += data.triangles.len() as u64;
                if triangles > MAX_TRIANGLES {
                    return Err(format!(
                        "its instances have more than {MAX_TRIANGLES} triangles; simplify it"
                    ));
                }
                let skin = if data.joints.is_empty() { None } else { skin };
                let (name, moves, deforms) = (name.clone(), false, false);
                self.scene.instances.push(Instance {
                    name,
                    mesh,
                    node,
                    skin,
                    moves,
                    deforms,
                });
                self.origins.nodes.push(index);
            }
            meshes[mesh] = Some(primitives);
        }
        Ok(())
    }

    /// Reads a mesh of the file; the scene's meshes that its primitives became.
    fn mesh(&mut self, index: usize) -> Result<Vec<u32>, String> {
        let root = self.root;
        let mesh = &root.meshes[index];
        let name = label("mesh", index, mesh.name.as_deref());
        let mut primitives = Vec::new();
        for (number, primitive) in mesh.primitives.iter().enumerate() {
            let name = format!("{name}, primitive {number}");
            match self
                .primitive(primitive, &name)
                .map_err(|what| format!("{name}: {what}"))?
            {
                Some((mesh, vertices, count)) => {
                    primitives.push(self.scene.meshes.len() as u32);
                    self.scene.meshes.push(mesh);
                    self.origins.meshes.push(MeshOrigin {
                        mesh: index,
                        primitive: number,
                        vertices,
                        count,
                    });
                }
                None => self.scene.dropped.empty_primitives += 1,
            }
        }
        Ok(primitives)
    }

    /// A primitive's mesh, which vertex of the primitive each of its vertices was, and how many
    /// the primitive has. Nothing where it has no triangle.
    fn primitive(
        &mut self,
        primitive: &json::mesh::Primitive,
        name: &str,
    ) -> Result<Option<(Mesh, Vec<u32>, usize)>, String> {
        let attribute = |semantic| primitive.attributes.get(&Checked::Valid(semantic));
        let attribute = |semantic| attribute(semantic).map(|accessor| accessor.value());
        let Some(positions) = attribute(Semantic::Positions) else {
            return Ok(None);
        };
        let mode = match primitive.mode {
            Checked::Valid(mode) => mode,
            Checked::Invalid => return Err("its mode is unknown; export the file again".into()),
        };
        if !matches!(
            mode,
            Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan
        ) {
            return Ok(None);
        }
        let material = match primitive.material {
            None => None,
            Some(index) => Some((
                index.value(),
                (self.root.materials.get(index.value()))
                    .ok_or("its material is not there; export the file again")?,
            )),
        };
        let alpha = match material {
            Some((index, material)) => self.alpha(index, material)?,
            None => Alpha::Solid,
        };
        let mask = match alpha {
            Alpha::AllHole => return Ok(None),
            Alpha::Solid => None,
            Alpha::Masked {
                mask,
                tex_coord,
                transform,
            } => Some((mask, tex_coord, transform)),
        };

        let mut mesh = Mesh {
            name: name.to_string(),
            positions: self.vec3s(positions)?,
            double_sided: material.is_some_and(|(_, material)| material.double_sided),
            ..Mesh::default()
        };
        let count = mesh.positions.len();
        let check = |what: &str, length: usize| {
            if length == count {
                Ok(())
            } else {
                Err(format!(
                    "{length} {what} for {count} vertices; export the file again"
                ))
            }
        };
        if let Some(normals) = attribute(Semantic::Normals) {
            mesh.normals = self.vec3s(normals)?;
            check("normals", mesh.normals.len())?;
        }
        if let Some((mask, tex_coord, transform)) = mask {
            let uvs = attribute(Semantic::TexCoords(tex_coord));
            let uvs = uvs.ok_or("its material has a mask, but it has no texture coordinates")?;
            mesh.uvs = (self.read::<2, f32>(uvs, to_float)?.into_iter())
                .map(|uv| transform.apply(Vec2::from(uv)))
                .collect();
            check("texture coordinates", mesh.uvs.len())?;
            self.take(mask.alpha.len() as u64)?;
            mesh.mask = Some(mask);
        }
        for set in 0..2 {
            let joints = attribute(Semantic::Joints(set));
            let (Some(joints), Some(weights)) = (joints, attribute(Semantic::Weights(set))) else {
                break;
            };
            let joints = self.read::<4, u32>(joints, to_uint)?;
            let weights = self.read::<4, f32>(weights, to_float)?;
            check("joints", joints.len())?;
            check("joint weights", weights.len())?;
            let joints = joints
                .into_iter()
                .map(|joints| joints.map(|joint| joint.min(65535) as u16));
            if set == 0 {
                mesh.joints = joints.collect();
                mesh.weights = weights;
            } else {
                for (v, (joints, weights)) in joints.zip(weights).enumerate() {
                    strongest(&mut mesh.joints[v], &mut mesh.weights[v], joints, weights);
                }
            }
        }
        for target in primitive.targets.iter().flatten() {
            let mut morph = Morph::default();
            self.take(count as u64 * size_of::<Vec3>() as u64)?;
            morph.positions = match target.positions {
                Some(accessor) => self.vec3s(accessor.value())?,
                None => vec![Vec3::ZERO; count],
            };
            check("morphed positions", morph.positions.len())?;
            if let (Some(accessor), false) = (target.normals, mesh.normals.is_empty()) {
                morph.normals = self.vec3s(accessor.value())?;
                check("morphed normals", morph.normals.len())?;
            }
            mesh.morphs.push(morph);
        }

        let indices: Vec<u32> = match primitive.indices {
            Some(indices) => self
                .read::<1, u32>(indices.value(), to_uint)?
                .into_flattened(),
            None => (0..count as u32).collect(),
        };
        mesh.triangles = match mode {
            Mode::TriangleStrip => (indices.windows(3).enumerate())
                .map(|(i, w)| {
                    if i % 2 == 0 {
                        [w[0], w[1], w[2]]
                    } else {
                        [w[1], w[0], w[2]]
                    }
                })
                .collect(),
            Mode::TriangleFan => (indices.windows(2).skip(1))
                .map(|edge| [indices[0], edge[0], edge[1]])
                .collect(),
            _ => indices.as_chunks::<3>().0.to_vec(),
        };
        let vertices = self.repair(&mut mesh)?;
        Ok((!mesh.triangles.is_empty()).then_some((mesh, vertices, count)))
    }

    /// Makes the mesh keep what [`Mesh`] promises; which vertex each of its vertices was before.
    fn repair(&mut self, mesh: &mut Mesh) -> Result<Vec<u32>, String> {
        let count = mesh.positions.len();
        let dropped = &mut self.scene.dropped;
        let good = |v: Vec3| v.abs().max_element() <= MAX_COORDINATE && !v.is_nan();

        let before = mesh.triangles.len();
        mesh.triangles
            .retain(|triangle| triangle.iter().all(|&v| (v as usize) < count));
        dropped.out_of_range_triangles += (before - mesh.triangles.len()) as u64;

        let mut broken = vec![false; count];
        for v in 0..count {
            let usable = good(mesh.positions[v]);
            let mut finite = usable;
            for morph in &mut mesh.morphs {
                let normal = morph.normals.get_mut(v);
                for delta in std::iter::once(&mut morph.positions[v]).chain(normal) {
                    if !good(*delta) {
                        *delta = Vec3::ZERO;
                        finite = false;
                    }
                }
            }
            if let Some(uv) = mesh.uvs.get_mut(v).filter(|uv| !uv.is_finite()) {
                *uv = Vec2::ZERO;
                finite = false;
            }
            if let Some(weights) = mesh.weights.get_mut(v) {
                finite &= weights.iter().all(|weight| weight.is_finite());
                *weights = weights.map(|w| if w.is_finite() { w.max(0.0) } else { 0.0 });
                let sum: f32 = weights.iter().sum();
                if sum > 0.0 && sum.is_finite() {
                    *weights = weights.map(|weight| weight / sum);
                } else {
                    (mesh.joints[v], *weights) = ([0; 4], [1.0, 0.0, 0.0, 0.0]);
                    dropped.bad_joints += 1;
                }
            }
            finite &= mesh.normals.get(v).is_none_or(|normal| normal.is_finite());
            dropped.non_finite_vertices += u64::from(!finite);
            broken[v] = !usable;
        }

        let before = mesh.triangles.len();
        let positions = &mesh.positions;
        mesh.triangles.retain(|triangle| {
            triangle.iter().all(|&v| !broken[v as usize])
                && area_vector(positions, triangle).length_squared() > 0.0
        });
        dropped.degenerate_triangles += (before - mesh.triangles.len()) as u64;

        if mesh.normals.is_empty() {
            // Flat, so no two triangles share a vertex.
            let corners: Vec<u32> = mesh.triangles.as_flattened().to_vec();
            let corner_bytes = size_of::<Vec3>() * (2 + mesh.morphs.len()) + 48;
            self.take(corners.len() as u64 * corner_bytes as u64)?;
            gather(mesh, &corners);
            for (i, triangle) in mesh.triangles.iter_mut().enumerate() {
                *triangle = [0, 1, 2].map(|k| (3 * i + k) as u32);
                let normal = area_vector(&mesh.positions, triangle).normalize().as_vec3();
                mesh.normals.extend([normal; 3]);
            }
            return Ok(corners);
        }

        // Vertices that no triangle uses would only widen the bounds.
        let mut place = vec![u32::MAX; count];
        let mut used = Vec::new();
        for v in mesh.triangles.as_flattened_mut() {
            let place = &mut place[*v as usize];
            if *place == u32::MAX {
                *place = used.len() as u32;
                used.push(*v);
            }
            *v = *place;
        }
        if used.len() < count {
            gather(mesh, &used);
        } else {
            // All are used: keep the file's order.
            for v in mesh.triangles.as_flattened_mut() {
                *v = used[*v as usize];
            }
            used = (0..count as u32).collect();
        }
        // Normals that are no directions are made from the triangles around them.
        let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
        for triangle in &mesh.triangles {
            let area = area_vector(&mesh.positions, triangle);
            triangle.iter().for_each(|&v| sums[v as usize] += area);
        }
        for (normal, sum) in mesh.normals.iter_mut().zip(sums) {
            *normal = (normal.as_dvec3().try_normalize())
                .or_else(|| sum.try_normalize())
                .unwrap_or(DVec3::Y)
                .as_vec3();
        }
        Ok(used)
    }

    /// Vertices whose joints a skin does not have follow its first joint. A mesh may be used with
    /// several skins, so that this waits for all instances.
    fn bind_strays(&mut self) {
        let mut joints = vec![usize::MAX; self.scene.meshes.len()];
        for instance in &self.scene.instances {
            if let Some(skin) = instance.skin {
                let joints = &mut joints[instance.mesh as usize];
                *joints = (*joints).min(self.scene.skins[skin as usize].joints.len());
            }
        }
        for (mesh, joints) in self.scene.meshes.iter_mut().zip(joints) {
            for (joint, weights) in mesh.joints.iter_mut().zip(&mut mesh.weights) {
                // Files leave anything in joints without weight.
                for (joint, _) in joint.iter_mut().zip(*weights).filter(|(_, w)| *w == 0.0) {
                    *joint = 0;
                }
                if joint.iter().any(|&joint| joint as usize >= joints) {
                    (*joint, *weights) = ([0; 4], [1.0, 0.0, 0.0, 0.0]);
                    self.scene.dropped.bad_joints += 1;
                }
            }
        }
    }

    /// The first animation of the file.
    fn animation(&mut self) {
        let Some(source) = self.root.animations.first() else {
            return;
        };
        let mut channels = Vec::new();
        for channel in &source.channels {
            match self.channel(source, channel) {
                Some(channel) => channels.push(channel),
                None => self.scene.dropped.bad_channels += 1,
            }
        }
        let last = channels
            .iter()
            .filter_map(|channel| channel.times.last().copied());
        let duration_s = last.fold(0.0, f32::max);
        // Keys at time 0 alone hold still: over any time.
        let duration_s = if duration_s > 0.0 { duration_s } else { 1.0 };
        if !channels.is_empty() {
            let name = label("animation", 0, source.name.as_deref());
            self.scene.animations.push(Animation {
                name,
                duration_s,
                channels,
            });
        }
    }

    /// A channel of the file; nothing where it is broken in any way.
    fn channel(
        &self,
        animation: &json::Animation,
        channel: &json::animation::Channel,
    ) -> Option<Channel> {
        use json::animation::{Interpolation as Source, Property};
        let sampler = animation.samplers.get(channel.sampler.value())?;
        let node = (*self.node_of.get(channel.target.node.value())?)?;
        let times = self
            .read::<1, f32>(sampler.input.value(), to_float)
            .ok()?
            .into_flattened();
        let orderly = times.first().is_some_and(|&first| first >= 0.0)
            && times.windows(2).all(|pair| pair[0] < pair[1])
            && times.iter().all(|time| time.is_finite());
        let interpolation = match sampler.interpolation {
            Checked::Valid(Source::Step) => Interpolation::Step,
            Checked::Valid(Source::Linear) => Interpolation::Linear,
            Checked::Valid(Source::CubicSpline) => Interpolation::CubicSpline,
            Checked::Invalid => return None,
        };
        let cubic = interpolation == Interpolation::CubicSpline;
        let needed = if cubic { times.len() * 3 } else { times.len() };
        let output = sampler.output.value();
        let target = &self.scene.nodes[node as usize];
        let Checked::Valid(property) = channel.target.path else {
            return None;
        };
        let driven = property == Property::MorphTargetWeights
            || matches!(target.local, LocalTransform::Trs { .. });
        let good = |value: f32| value.abs() <= MAX_COORDINATE;
        let values = match property {
            Property::Translation => Keys::Translation(self.vec3s(output).ok()?),
            Property::Scale => Keys::Scale(self.vec3s(output).ok()?),
            Property::Rotation => {
                let keys = self.read::<4, f32>(output, to_float).ok()?;
                let mut keys: Vec<Quat> = keys.into_iter().map(Quat::from_array).collect();
                let step = if cubic { 3 } else { 1 };
                for key in keys.iter_mut().skip(step / 2).step_by(step) {
                    *key = unit(*key)?;
                }
                Keys::Rotation(keys)
            }
            Property::MorphTargetWeights => {
                let weights = self.read::<1, f32>(output, to_float).ok()?.into_flattened();
                Keys::MorphWeights {
                    count: target.morph_weights.len(),
                    weights,
                }
            }
        };
        let (length, sound) = match &values {
            Keys::Translation(keys) | Keys::Scale(keys) => (
                keys.len(),
                keys.iter().all(|key| key.to_array().into_iter().all(good)),
            ),
            Keys::Rotation(keys) => (
                keys.len(),
                keys.iter().all(|key| key.to_array().into_iter().all(good)),
            ),
            Keys::MorphWeights { count, weights } => (
                // No weights, or a number that is no multiple, gives a length that is not needed.
                weights
                    .len()
                    .checked_div(*count)
                    .filter(|n| n * count == weights.len())?,
                weights.iter().copied().all(good),
            ),
        };
        let valid = orderly && driven && sound && length == needed;
        valid.then_some(Channel {
            node,
            times,
            interpolation,
            values,
        })
    }

    /// What a material's alpha mode leaves: decoded once a material.
    fn alpha(&mut self, index: usize, material: &json::Material) -> Result<Alpha, String> {
        if material.alpha_mode != Checked::Valid(AlphaMode::Mask) {
            return Ok(Alpha::Solid);
        }
        if let Some(alpha) = self.masks.get(&index) {
            return Ok(alpha.clone());
        }
        let named = |what: String| {
            format!(
                "{}: {what}",
                label("material", index, material.name.as_deref())
            )
        };
        let cutoff = material.alpha_cutoff.map_or(0.5, |cutoff| cutoff.0);
        let pbr = &material.pbr_metallic_roughness;
        let base = pbr.base_color_factor.0[3];
        let alpha = match &pbr.base_color_texture {
            None if base < cutoff => Alpha::AllHole,
            None => Alpha::Solid,
            Some(info) => {
                let mut mask = self.mask(info.index.value()).map_err(named)?;
                mask.cutoff = cutoff;
                for texel in &mut mask.alpha {
                    *texel = (f32::from(*texel) * base).round() as u8;
                }
                let holes = mask
                    .alpha
                    .iter()
                    .filter(|&&alpha| mask.is_below_cutoff(alpha))
                    .count();
                let (tex_coord, transform) = uv_transform(info);
                match holes {
                    0 => Alpha::Solid,
                    _ if holes == mask.alpha.len() => Alpha::AllHole,
                    _ => Alpha::Masked {
                        mask,
                        tex_coord,
                        transform,
                    },
                }
            }
        };
        self.masks.insert(index, alpha.clone());
        Ok(alpha)
    }

    /// The alpha of a texture; its cutoff is the caller's to set.
    fn mask(&mut self, texture: usize) -> Result<Mask, String> {
        let missing = |what: &str| format!("its mask's {what} is not there; export it again");
        let texture = self
            .root
            .textures
            .get(texture)
            .ok_or_else(|| missing("texture"))?;
        let image = texture.source.value();
        let image = self
            .root
            .images
            .get(image)
            .ok_or_else(|| missing("image"))?;
        let read;
        let bytes: &[u8] = match (&image.uri, image.buffer_view) {
            (Some(uri), _) => {
                read = read_uri(uri, self.folder, &mut self.files_left)?;
                &read
            }
            (None, Some(view)) => self.view(view.value())?.0,
            (None, None) => return Err(missing("image data")),
        };
        let wrap = match texture.sampler {
            None => [Wrap::Repeat; 2],
            Some(sampler) => {
                let sampler = self.root.samplers.get(sampler.value());
                let sampler = sampler.ok_or_else(|| missing("sampler"))?;
                [sampler.wrap_s, sampler.wrap_t].map(|mode| match mode {
                    Checked::Valid(WrappingMode::ClampToEdge) => Wrap::Clamp,
                    Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::Mirror,
                    Checked::Valid(WrappingMode::Repeat) | Checked::Invalid => Wrap::Repeat,
                })
            }
        };
        let jpeg = bytes.starts_with(&[0xFF, 0xD8]);
        let (width, height, alpha) = if jpeg { opaque() } else { decode_alpha(bytes)? };
        self.take(alpha.len() as u64)?;
        Ok(Mask {
            width,
            height,
            alpha,
            cutoff: 0.0,
            wrap,
        })
    }
}

/// One texel stands for an image without alpha.
fn opaque() -> (u32, u32, Vec<u8>) {
    (1, 1, vec![255])
}

/// Width, height and alpha of a PNG.
fn decode_alpha(bytes: &[u8]) -> Result<(u32, u32, Vec<u8>), String> {
    let cannot = |error: png::DecodingError| {
        format!("its mask's image is not a readable PNG: {error}; convert it to PNG")
    };
    let limits = png::Limits {
        bytes: 4 * MAX_TEXELS as usize,
    };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(cannot)?;
    let (width, height) = (reader.info().width, reader.info().height);
    if u64::from(width) * u64::from(height) > MAX_TEXELS {
        return Err(format!(
            "its mask's image has {width} x {height} texels; shrink it"
        ));
    }
    let channels = match reader.output_color_type().0 {
        png::ColorType::GrayscaleAlpha => 2,
        png::ColorType::Rgba => 4,
        _ => return Ok(opaque()),
    };
    let size = reader
        .output_buffer_size()
        .ok_or("its mask's image is too large; shrink it")?;
    let mut pixels = vec![0; size];
    reader.next_frame(&mut pixels).map_err(cannot)?;
    let alpha = pixels
        .chunks_exact(channels)
        .map(|pixel| pixel[channels - 1])
        .collect();
    Ok((width, height, alpha))
}

/// Which texture coordinates a mask uses, and how they are changed first.
fn uv_transform(info: &json::texture::Info) -> (u32, UvTransform) {
    let extension = info.extensions.as_ref();
    let extension = extension.and_then(|all| all.others.get("KHR_texture_transform"));
    let number = |value: &json::Value| value.as_f64().map(|number| number as f32);
    let pair = |name: &str| {
        let values = extension?.get(name)?;
        Some(Vec2::new(number(values.get(0)?)?, number(values.get(1)?)?))
    };
    let tex_coord = extension.and_then(|extension| extension.get("texCoord")?.as_u64());
    let tex_coord = tex_coord
        .and_then(|set| u32::try_from(set).ok())
        .unwrap_or(info.tex_coord);
    let transform = UvTransform {
        offset: pair("offset").unwrap_or(Vec2::ZERO),
        rotation: extension
            .and_then(|all| number(all.get("rotation")?))
            .unwrap_or(0.0),
        scale: pair("scale").unwrap_or(Vec2::ONE),
    };
    (tex_coord, transform)
}

/// A node's transform; nothing where it is not finite.
fn local_transform(node: &json::Node, precise: &PreciseNode) -> Option<LocalTransform> {
    let good = |values: &[f64]| values.iter().all(|v| v.abs() <= f64::from(MAX_COORDINATE));
    if let Some(matrix) = precise.matrix {
        let affine = DAffine3::from_mat4(DMat4::from_cols_array(&matrix));
        return good(&matrix).then_some(LocalTransform::Matrix(affine));
    }
    let translation = DVec3::from(precise.translation.unwrap_or_default());
    let rotation = node
        .rotation
        .map_or(Some(Quat::IDENTITY), |r| unit(Quat::from_array(r.0)))?;
    let scale = Vec3::from(node.scale.unwrap_or([1.0; 3]));
    (good(&translation.to_array()) && good(&scale.as_dvec3().to_array())).then_some(
        LocalTransform::Trs {
            translation,
            rotation,
            scale,
        },
    )
}

/// The unit quaternion along `q`. In double precision without vector instructions, so that it is
/// the same on every machine ([`Scene::hash`]).
fn unit(q: Quat) -> Option<Quat> {
    let q = q.as_dquat();
    let length = q.length();
    (length > 0.0 && length.is_finite()).then(|| (q / length).as_quat())
}

/// Keeps the four strongest of eight joint weights.
fn strongest(joints: &mut [u16; 4], weights: &mut [f32; 4], more: [u16; 4], their: [f32; 4]) {
    let mut all: Vec<(u16, f32)> = (joints.iter().copied().zip(weights.iter().copied()))
        .chain(more.into_iter().zip(their))
        .collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1));
    for (i, &(joint, weight)) in all.iter().take(4).enumerate() {
        (joints[i], weights[i]) = (joint, weight);
    }
}

/// Along the triangle's normal, twice its area long.
fn area_vector(positions: &[Vec3], triangle: &[u32; 3]) -> DVec3 {
    let [a, b, c] = triangle.map(|v| positions[v as usize].as_dvec3());
    (b - a).cross(c - a)
}

/// Makes the vertices named by `order` the mesh's vertices.
fn gather(mesh: &mut Mesh, order: &[u32]) {
    fn pick<T: Copy>(values: &mut Vec<T>, order: &[u32]) {
        if !values.is_empty() {
            *values = order.iter().map(|&v| values[v as usize]).collect();
        }
    }
    pick(&mut mesh.positions, order);
    pick(&mut mesh.normals, order);
    pick(&mut mesh.uvs, order);
    pick(&mut mesh.joints, order);
    pick(&mut mesh.weights, order);
    for morph in &mut mesh.morphs {
        pick(&mut morph.positions, order);
        pick(&mut morph.normals, order);
    }
}

fn label(kind: &str, index: usize, name: Option<&str>) -> String {
    name.map_or_else(
        || format!("{kind} {index}"),
        |name| format!("{kind} {index} `{name}`"),
    )
}

pub(crate) fn component_bytes(component: ComponentType) -> usize {
    match component {
        ComponentType::I8 | ComponentType::U8 => 1,
        ComponentType::I16 | ComponentType::U16 => 2,
        ComponentType::U32 | ComponentType::F32 => 4,
    }
}

pub(crate) fn to_float(component: ComponentType, normalized: bool, bytes: &[u8]) -> Option<f32> {
    let (value, full) = match component {
        ComponentType::F32 => return Some(f32::from_le_bytes(bytes.try_into().ok()?)),
        ComponentType::I8 => (f32::from(i8::from_le_bytes(bytes.try_into().ok()?)), 127.0),
        ComponentType::U8 => (f32::from(*bytes.first()?), 255.0),
        ComponentType::I16 => (
            f32::from(i16::from_le_bytes(bytes.try_into().ok()?)),
            32767.0,
        ),
        ComponentType::U16 => (
            f32::from(u16::from_le_bytes(bytes.try_into().ok()?)),
            65535.0,
        ),
        ComponentType::U32 => return Some(u32::from_le_bytes(bytes.try_into().ok()?) as f32),
    };
    Some(if normalized {
        (value / full).max(-1.0)
    } else {
        value
    })
}

fn to_uint(component: ComponentType, _normalized: bool, bytes: &[u8]) -> Option<u32> {
    match component {
        ComponentType::U8 => Some(u32::from(*bytes.first()?)),
        ComponentType::U16 => Some(u32::from(u16::from_le_bytes(bytes.try_into().ok()?))),
        ComponentType::U32 => Some(u32::from_le_bytes(bytes.try_into().ok()?)),
        _ => None,
    }
}
