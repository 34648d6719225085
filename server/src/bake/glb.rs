//! Writes what was baked into a copy of a glTF file, as one `.glb`. Everything that the file had
//! stays: the JSON is kept as it is, known or not, and only added to.

use crate::scene::gltf::{MAX_FILE_BYTES, component_bytes, read_file, read_uri, split_glb};
use ::gltf::json::accessor::ComponentType;
use glam::Vec2;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Component types, primitive modes and buffer targets by glTF's numbers.
const FLOAT: u64 = 5126;
const UNSIGNED_INT: u64 = 5125;
const POINTS: u64 = 0;
const ARRAY_BUFFER: u64 = 34962;
const ELEMENT_ARRAY_BUFFER: u64 = 34963;

/// Textures of a material, by their numbers.
#[derive(Clone, Debug, Default)]
pub struct Textures {
    /// Occlusion.
    pub occlusion: Option<usize>,
    /// Normals in tangent space.
    pub normal: Option<usize>,
    /// Coefficients of transfer vectors, three or four each, half of one and one half.
    pub transfer: Vec<usize>,
    /// Bands of those.
    pub order: usize,
}

/// A glTF file that is being added to.
pub struct Document {
    json: Value,
    /// All buffers, one after the other.
    binary: Vec<u8>,
    /// Meshes as they were, for those that are placed more than once.
    pristine: Vec<Value>,
    /// The mesh that each node has taken for its own.
    owned: BTreeMap<usize, usize>,
    /// Images that are not there, and stay named by their files.
    pub missing_images: Vec<String>,
}

impl Document {
    /// Reads a `.gltf` or `.glb` with all its buffers and images.
    ///
    /// # Errors
    /// Names the file, what is wrong in it, and the remedy.
    pub fn open(path: &Path) -> Result<Document, String> {
        Document::read(path).map_err(|what| format!("{}: {what}", path.display()))
    }

    fn read(path: &Path) -> Result<Document, String> {
        let mut left = MAX_FILE_BYTES;
        let bytes = read_file(path, &mut left)?;
        let (text, chunk) = split_glb(&bytes)?;
        let mut json: Value =
            serde_json::from_slice(text).map_err(|error| format!("not a glTF file: {error}"))?;
        if !json.is_object() {
            return Err("not a glTF file: its JSON is no object; export it again".into());
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut binary = Vec::new();
        let mut starts = Vec::new();
        for (index, buffer) in list(&json, "buffers").iter().enumerate() {
            starts.push(binary.len() as u64);
            let read;
            let data: &[u8] = match buffer["uri"].as_str() {
                Some(uri) => {
                    read = read_uri(uri, folder, &mut left)
                        .map_err(|what| format!("buffer {index}: {what}"))?;
                    &read
                }
                None if index == 0 => chunk,
                None => &[],
            };
            let length = buffer["byteLength"].as_u64().unwrap_or(0);
            let used = data.get(..usize::try_from(length).unwrap_or(usize::MAX));
            binary.extend_from_slice(used.ok_or_else(|| {
                format!("buffer {index} is cut off or its data is missing; export it again")
            })?);
            pad(&mut binary, 0);
        }
        for view in list_mut(&mut json, "bufferViews") {
            // Compressed views name a buffer in their extension as well.
            let extensions = view["extensions"].as_object().cloned().unwrap_or_default();
            for (name, extension) in extensions {
                if extension.get("buffer").is_some() {
                    rebase(&mut view["extensions"][name], &starts)?;
                }
            }
            rebase(view, &starts)?;
        }
        let pristine = list(&json, "meshes").to_vec();
        let primitives = pristine.iter().flat_map(|mesh| list(mesh, "primitives"));
        for primitive in primitives {
            if !primitive["extensions"]["KHR_draco_mesh_compression"].is_null() {
                return Err(
                    "its geometry is also there compressed with KHR_draco_mesh_compression, which \
                     would no longer fit; decompress it with `npx @gltf-transform/cli copy IN.glb \
                     OUT.glb`"
                        .into(),
                );
            }
        }
        let mut document = Document {
            json,
            binary,
            pristine,
            owned: BTreeMap::new(),
            missing_images: Vec::new(),
        };
        document.embed_images(folder, &mut left);
        Ok(document)
    }

    /// Takes images from files into the binary chunk: a `.glb` goes elsewhere on its own.
    fn embed_images(&mut self, folder: &Path, left: &mut u64) {
        for index in 0..list(&self.json, "images").len() {
            let image = &self.json["images"][index];
            let Some(uri) = image["uri"]
                .as_str()
                .filter(|uri| !uri.starts_with("data:"))
            else {
                continue;
            };
            let uri = uri.to_string();
            let read = read_uri(&uri, folder, left).ok();
            let Some((bytes, kind)) = read.and_then(|bytes| image_kind(&bytes).map(|k| (bytes, k)))
            else {
                self.missing_images.push(uri);
                continue;
            };
            let view = self.add_view(&bytes, None, None);
            let Some(image) = self.json["images"][index].as_object_mut() else {
                continue;
            };
            image.remove("uri");
            image.insert("bufferView".into(), json!(view));
            image.insert("mimeType".into(), json!(kind));
        }
    }

    /// Adds bytes to the binary chunk; the buffer view's index.
    fn add_view(&mut self, bytes: &[u8], target: Option<u64>, stride: Option<usize>) -> usize {
        pad(&mut self.binary, 0);
        let mut view = json!({
            "buffer": 0,
            "byteOffset": self.binary.len(),
            "byteLength": bytes.len(),
        });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        if let Some(stride) = stride {
            view["byteStride"] = json!(stride);
        }
        self.binary.extend_from_slice(bytes);
        self.push("bufferViews", view)
    }

    /// Appends to one of the document's lists; its index.
    fn push(&mut self, name: &str, value: Value) -> usize {
        let list = list_mut(&mut self.json, name);
        list.push(value);
        list.len() - 1
    }

    /// Adds an accessor of `width` floats an element, for vertices; its index.
    fn add_floats(&mut self, values: &[f32], width: usize) -> usize {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let view = self.add_view(bytes, Some(ARRAY_BUFFER), None);
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        self.push(
            "accessors",
            json!({
                "bufferView": view,
                "componentType": FLOAT,
                "type": kind,
                "count": values.len() / width,
            }),
        )
    }

    /// The mesh that a node has for its own: another node's placing of the same mesh gets a copy,
    /// which shares all data. Its index.
    fn own_mesh(&mut self, node: usize) -> Result<usize, String> {
        if let Some(mesh) = self.owned.get(&node) {
            return Ok(*mesh);
        }
        let mesh = self.json["nodes"][node]["mesh"]
            .as_u64()
            .map(|mesh| mesh as usize);
        let mesh = mesh.filter(|mesh| *mesh < self.pristine.len());
        let mesh = mesh.ok_or_else(|| format!("node {node} has no mesh; export the file again"))?;
        let taken = self.owned.values().any(|owned| *owned == mesh);
        let own = if taken {
            let copy = self.pristine[mesh].clone();
            let copy = self.push("meshes", copy);
            self.json["nodes"][node]["mesh"] = json!(copy);
            copy
        } else {
            mesh
        };
        self.owned.insert(node, own);
        Ok(own)
    }

    fn primitive(&mut self, node: usize, primitive: usize) -> Result<&mut Value, String> {
        let mesh = self.own_mesh(node)?;
        let primitive = self.json["meshes"][mesh]["primitives"].get_mut(primitive);
        primitive.ok_or_else(|| format!("mesh {mesh} has lost a primitive; export it again"))
    }

    /// Gives a primitive of a node's mesh a vertex attribute of `width` floats (1 to 4). One of
    /// that name is replaced.
    ///
    /// # Errors
    /// There is no such primitive.
    pub fn set_attribute(
        &mut self,
        node: usize,
        primitive: usize,
        name: &str,
        values: &[f32],
        width: usize,
    ) -> Result<(), String> {
        let accessor = self.add_floats(values, width);
        self.primitive(node, primitive)?["attributes"][name] = json!(accessor);
        Ok(())
    }

    /// How many sets of texture coordinates a primitive has.
    ///
    /// # Errors
    /// There is no such primitive.
    pub fn uv_sets(&mut self, node: usize, primitive: usize) -> Result<usize, String> {
        let primitive = self.primitive(node, primitive)?;
        let has = |set: &usize| !primitive["attributes"][format!("TEXCOORD_{set}")].is_null();
        Ok((0..).take_while(has).count())
    }

    /// The second set of texture coordinates of a primitive, if it is there in floats.
    ///
    /// # Errors
    /// There is no such primitive, or the file is damaged.
    pub fn second_uvs(
        &mut self,
        node: usize,
        primitive: usize,
    ) -> Result<Option<Vec<Vec2>>, String> {
        let accessor = &self.primitive(node, primitive)?["attributes"]["TEXCOORD_1"];
        let Some(accessor) = accessor.as_u64().map(|accessor| accessor as usize) else {
            return Ok(None);
        };
        let source = &self.json["accessors"][accessor];
        if source["componentType"] != json!(FLOAT) || source["type"] != json!("VEC2") {
            return Ok(None);
        }
        let bytes = self.elements(accessor)?.concat();
        let uvs: Vec<Vec2> = bytemuck::pod_collect_to_vec(&bytes);
        Ok(uvs.iter().all(|uv| uv.is_finite()).then_some(uvs))
    }

    /// Makes a primitive of triangles of other vertices: `vertices` names the old one of each, of
    /// which all attributes and morph targets are copied. Adds texture coordinates as set `set`.
    ///
    /// # Errors
    /// The file is damaged.
    pub fn rebuild(
        &mut self,
        node: usize,
        primitive: usize,
        vertices: &[u32],
        triangles: &[[u32; 3]],
        set: usize,
        uvs: &[Vec2],
    ) -> Result<(), String> {
        let mut rebuilt = self.primitive(node, primitive)?.clone();
        for (_, accessor) in rebuilt["attributes"].as_object_mut().into_iter().flatten() {
            self.gather(accessor, vertices)?;
        }
        for target in list_mut(&mut rebuilt, "targets") {
            for (_, accessor) in target.as_object_mut().into_iter().flatten() {
                self.gather(accessor, vertices)?;
            }
        }
        if list(&rebuilt, "targets").is_empty()
            && let Some(rebuilt) = rebuilt.as_object_mut()
        {
            rebuilt.remove("targets");
        }
        let indices: &[u8] = bytemuck::cast_slice(triangles.as_flattened());
        let view = self.add_view(indices, Some(ELEMENT_ARRAY_BUFFER), None);
        rebuilt["indices"] = json!(self.push(
            "accessors",
            json!({
                "bufferView": view,
                "componentType": UNSIGNED_INT,
                "type": "SCALAR",
                "count": triangles.len() * 3,
            }),
        ));
        // Strips and fans became lists.
        rebuilt["mode"] = json!(4);
        let uvs = self.add_floats(bytemuck::cast_slice(uvs), 2);
        rebuilt["attributes"][format!("TEXCOORD_{set}")] = json!(uvs);
        *self.primitive(node, primitive)? = rebuilt;
        Ok(())
    }

    /// Replaces an accessor's index by that of a new one with the elements that `order` names.
    fn gather(&mut self, accessor: &mut Value, order: &[u32]) -> Result<(), String> {
        let index = accessor.as_u64().unwrap_or(u64::MAX) as usize;
        let elements = self.elements(index)?;
        let mut source = self.json["accessors"][index].clone();
        let stride = elements.first().map_or(4, Vec::len).next_multiple_of(4);
        let mut bytes = Vec::with_capacity(order.len() * stride);
        let mut bounds: Option<[Vec<f64>; 2]> = None;
        let component = component_of(&source)?;
        for &vertex in order {
            let element = elements.get(vertex as usize);
            let element = element.ok_or_else(|| damaged(index))?;
            let numbers: Vec<f64> = (element.chunks(component_bytes(component)))
                .map(|bytes| number(component, bytes))
                .collect();
            let [low, high] = bounds.get_or_insert_with(|| [numbers.clone(), numbers.clone()]);
            for (axis, number) in numbers.into_iter().enumerate() {
                low[axis] = low[axis].min(number);
                high[axis] = high[axis].max(number);
            }
            bytes.extend_from_slice(element);
            pad(&mut bytes, 0);
        }
        let view = self.add_view(&bytes, Some(ARRAY_BUFFER), Some(stride));
        let bounded = source["min"].is_array();
        if let Some(source) = source.as_object_mut() {
            for key in ["byteOffset", "sparse", "min", "max"] {
                source.remove(key);
            }
        }
        if let (Some([low, high]), true) = (bounds, bounded) {
            let whole = !matches!(component, ComponentType::F32);
            let write = |numbers: Vec<f64>| -> Value {
                let write = |n: f64| if whole { json!(n as i64) } else { json!(n) };
                numbers.into_iter().map(write).collect()
            };
            source["min"] = write(low);
            source["max"] = write(high);
        }
        source["bufferView"] = json!(view);
        source["count"] = json!(order.len());
        *accessor = json!(self.push("accessors", source));
        Ok(())
    }

    /// The bytes of each element of an accessor.
    fn elements(&self, index: usize) -> Result<Vec<Vec<u8>>, String> {
        let accessor = (self.json["accessors"].get(index)).ok_or_else(|| damaged(index))?;
        let component = component_bytes(component_of(accessor)?);
        let components = match accessor["type"].as_str() {
            Some("SCALAR") => 1,
            Some("VEC2") => 2,
            Some("VEC3") => 3,
            Some("VEC4") => 4,
            _ => return Err(damaged(index)),
        };
        let size = component * components;
        let count = accessor["count"].as_u64().ok_or_else(|| damaged(index))?;
        let (count, most) = (count as usize, self.binary.len().max(1));
        if count > most {
            return Err(damaged(index));
        }
        let mut elements = match accessor["bufferView"].as_u64() {
            Some(view) => self.span(view, &accessor["byteOffset"], count, size),
            None => Some(vec![vec![0; size]; count]),
        }
        .ok_or_else(|| damaged(index))?;
        let sparse = &accessor["sparse"];
        if sparse.is_object() {
            let replaced = || -> Option<Vec<(usize, Vec<u8>)>> {
                let count = sparse["count"].as_u64()? as usize;
                let (indices, values) = (&sparse["indices"], &sparse["values"]);
                let width = component_bytes(component_of(indices).ok()?);
                let view = indices["bufferView"].as_u64()?;
                let places = self.span(view, &indices["byteOffset"], count, width)?;
                let view = values["bufferView"].as_u64()?;
                let values = self.span(view, &values["byteOffset"], count, size)?;
                let place = |bytes: Vec<u8>| {
                    bytes
                        .iter()
                        .rev()
                        .fold(0, |sum, byte| sum << 8 | usize::from(*byte))
                };
                Some(places.into_iter().map(place).zip(values).collect())
            };
            for (place, value) in replaced().ok_or_else(|| damaged(index))? {
                *elements.get_mut(place).ok_or_else(|| damaged(index))? = value;
            }
        }
        Ok(elements)
    }

    /// `count` elements of `size` bytes in a buffer view, from an offset on.
    fn span(&self, view: u64, offset: &Value, count: usize, size: usize) -> Option<Vec<Vec<u8>>> {
        let view = self.json["bufferViews"].get(usize::try_from(view).ok()?)?;
        let start = view["byteOffset"].as_u64().unwrap_or(0) as usize;
        let end = start.checked_add(view["byteLength"].as_u64()? as usize)?;
        let bytes = self.binary.get(start..end)?;
        let bytes = bytes.get(offset.as_u64().unwrap_or(0) as usize..)?;
        let stride = view["byteStride"]
            .as_u64()
            .map_or(size, |stride| stride as usize);
        let element = |i: usize| {
            let from = i.checked_mul(stride)?;
            Some(bytes.get(from..from.checked_add(size)?)?.to_vec())
        };
        (0..count.min(self.binary.len())).map(element).collect()
    }

    /// Adds a PNG as a texture; its index.
    pub fn add_texture(&mut self, name: &str, png: &[u8]) -> usize {
        let view = self.add_view(png, None, None);
        let image = json!({
            "name": name,
            "bufferView": view,
            "mimeType": "image/png",
        });
        let image = self.push("images", image);
        // No mips: those of far surfaces would mix charts.
        let sampler = json!({
            "magFilter": 9729,
            "minFilter": 9729,
            "wrapS": 33071,
            "wrapT": 33071,
        });
        let sampler = self.push("samplers", sampler);
        self.push("textures", json!({ "source": image, "sampler": sampler }))
    }

    /// Gives a primitive a material that is its own with these textures, read by texture
    /// coordinates `set`. glTF has no place for transfer vectors: they are in its extras, as
    /// `psaoTransfer`.
    ///
    /// # Errors
    /// There is no such primitive.
    pub fn set_textures(
        &mut self,
        node: usize,
        primitive: usize,
        textures: &Textures,
        set: usize,
        materials: &mut BTreeMap<(Option<u64>, usize), usize>,
    ) -> Result<(), String> {
        let old = self.primitive(node, primitive)?["material"].as_u64();
        let material = match materials.get(&(old, set)) {
            Some(material) => *material,
            None => {
                let mut material = match old {
                    Some(old) => self.json["materials"][old as usize].clone(),
                    None => Value::Object(Map::new()),
                };
                let info = |texture: usize| json!({ "index": texture, "texCoord": set });
                if let Some(texture) = textures.occlusion {
                    material["occlusionTexture"] = info(texture);
                }
                if let Some(texture) = textures.normal {
                    material["normalTexture"] = info(texture);
                }
                if !textures.transfer.is_empty() {
                    if !material["extras"].is_object() {
                        material["extras"] = json!({});
                    }
                    material["extras"]["psaoTransfer"] = json!({
                        "order": textures.order,
                        "textures": textures.transfer,
                        "texCoord": set,
                    });
                }
                let material = self.push("materials", material);
                materials.insert((old, set), material);
                material
            }
        };
        self.primitive(node, primitive)?["material"] = json!(material);
        Ok(())
    }

    /// Adds points below a node, in its space, each with a normal and an occlusion.
    pub fn add_points(
        &mut self,
        node: usize,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        values: &[f32],
    ) {
        if positions.is_empty() {
            return;
        }
        let position = self.add_floats(positions.as_flattened(), 3);
        let bound = |pick: fn(f32, f32) -> f32| -> Value {
            let all = positions.iter().copied();
            let bound = all.reduce(|a, b| std::array::from_fn(|axis| pick(a[axis], b[axis])));
            json!(bound)
        };
        self.json["accessors"][position]["min"] = bound(f32::min);
        self.json["accessors"][position]["max"] = bound(f32::max);
        let normal = self.add_floats(normals.as_flattened(), 3);
        let occlusion = self.add_floats(values, 1);
        let mesh = json!({
            "name": "occlusion points",
            "primitives": [{
                "mode": POINTS,
                "attributes": {
                    "POSITION": position,
                    "NORMAL": normal,
                    "_OCCLUSION": occlusion,
                },
            }],
        });
        let mesh = self.push("meshes", mesh);
        let child = json!({ "name": "occlusion points", "mesh": mesh });
        let child = self.push("nodes", child);
        list_mut(&mut self.json["nodes"][node], "children").push(json!(child));
    }

    /// The file's bytes.
    ///
    /// # Errors
    /// It is larger than a `.glb` may be.
    pub fn finish(mut self) -> Result<Vec<u8>, String> {
        pad(&mut self.binary, 0);
        if !self.binary.is_empty() {
            // Of several buffers one is left: names and extras of the first are kept.
            let buffers = list_mut(&mut self.json, "buffers");
            buffers.truncate(1);
            if buffers.is_empty() {
                buffers.push(json!({}));
            }
            if let Some(buffer) = buffers[0].as_object_mut() {
                buffer.remove("uri");
                buffer.insert("byteLength".into(), json!(self.binary.len()));
            }
        }
        let mut text = self.json.to_string().into_bytes();
        pad(&mut text, b' ');
        let total = 12 + 8 + text.len() + 8 + self.binary.len();
        let word = |n: usize| {
            u32::try_from(n).map(u32::to_le_bytes).map_err(|_| {
                format!("the file would have {total} bytes, more than a .glb may: split the scene")
            })
        };
        let mut out = Vec::with_capacity(total);
        out.extend_from_slice(b"glTF");
        out.extend_from_slice(&2u32.to_le_bytes());
        out.extend_from_slice(&word(total)?);
        out.extend_from_slice(&word(text.len())?);
        out.extend_from_slice(b"JSON");
        out.extend_from_slice(&text);
        out.extend_from_slice(&word(self.binary.len())?);
        out.extend_from_slice(b"BIN\0");
        out.extend_from_slice(&self.binary);
        Ok(out)
    }
}

fn damaged(accessor: usize) -> String {
    format!("accessor {accessor} is damaged; export the file again")
}

/// A list of an object; empty where there is none.
fn list<'a>(object: &'a Value, name: &str) -> &'a [Value] {
    object[name].as_array().map_or(&[], Vec::as_slice)
}

/// A list of an object, made where there is none.
fn list_mut<'a>(object: &'a mut Value, name: &str) -> &'a mut Vec<Value> {
    let value = &mut object[name];
    if !value.is_array() {
        *value = json!([]);
    }
    match value {
        Value::Array(list) => list,
        _ => unreachable!("it was just made"),
    }
}

/// Makes a range of one of many buffers a range of all of them in one.
fn rebase(view: &mut Value, starts: &[u64]) -> Result<(), String> {
    let start = view["buffer"].as_u64().and_then(|b| starts.get(b as usize));
    let start = start.ok_or("a buffer view names no buffer; export the file again")?;
    let offset = view["byteOffset"].as_u64().unwrap_or(0);
    view["byteOffset"] = json!(start.saturating_add(offset));
    view["buffer"] = json!(0);
    Ok(())
}

fn pad(bytes: &mut Vec<u8>, with: u8) {
    bytes.resize(bytes.len().next_multiple_of(4), with);
}

fn component_of(accessor: &Value) -> Result<ComponentType, String> {
    Ok(match accessor["componentType"].as_u64() {
        Some(5120) => ComponentType::I8,
        Some(5121) => ComponentType::U8,
        Some(5122) => ComponentType::I16,
        Some(5123) => ComponentType::U16,
        Some(UNSIGNED_INT) => ComponentType::U32,
        Some(FLOAT) => ComponentType::F32,
        _ => return Err("an accessor has an unknown component type; export it again".into()),
    })
}

/// A component as it is written in the file, not normalised.
fn number(component: ComponentType, bytes: &[u8]) -> f64 {
    let mut word = [0; 4];
    word[..bytes.len()].copy_from_slice(bytes);
    let bits = u32::from_le_bytes(word);
    match component {
        ComponentType::I8 => f64::from(bits as u8 as i8),
        ComponentType::I16 => f64::from(bits as u16 as i16),
        ComponentType::F32 => f64::from(f32::from_bits(bits)),
        ComponentType::U8 | ComponentType::U16 | ComponentType::U32 => f64::from(bits),
    }
}

fn image_kind(bytes: &[u8]) -> Option<&'static str> {
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    if starts(b"\x89PNG") {
        Some("image/png")
    } else if starts(&[0xFF, 0xD8]) {
        Some("image/jpeg")
    } else if starts(b"\xABKTX 20") {
        Some("image/ktx2")
    } else if starts(b"RIFF") {
        Some("image/webp")
    } else {
        None
    }
}
