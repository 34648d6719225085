//! What the scene loader promises, on files made here, and on real ones where they are at hand.

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine;
use glam::{DAffine3, DQuat, DVec3, Vec2, Vec3};
use psao_server::scene::{Dropped, LocalTransform, Placement, Pose, Scene};
use serde_json::{Value, json};

/// A glTF file in the making.
struct Gltf {
    json: Value,
    bin: Vec<u8>,
}

impl Gltf {
    /// One node with one mesh of one primitive, without attributes yet.
    fn new() -> Gltf {
        let json = json!({
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {}}]}],
            "accessors": [],
            "bufferViews": [],
            "buffers": [],
        });
        Gltf {
            json,
            bin: Vec::new(),
        }
    }

    /// One triangle in the plane z = 0 that faces +z.
    fn triangle() -> Gltf {
        let mut file = Gltf::new();
        let corners = file.floats("VEC3", &[0., 0., 0., 1., 0., 0., 0., 1., 0.]);
        file.attribute("POSITION", corners);
        file
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        while !self.bin.len().is_multiple_of(4) {
            self.bin.push(0);
        }
        let views = self.json["bufferViews"].as_array_mut().unwrap();
        views.push(json!({
            "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len(),
        }));
        self.bin.extend_from_slice(bytes);
        views.len() - 1
    }

    fn accessor(&mut self, kind: &str, component: u32, count: usize, bytes: &[u8]) -> usize {
        let view = self.view(bytes);
        let accessors = self.json["accessors"].as_array_mut().unwrap();
        accessors.push(json!({
            "bufferView": view, "componentType": component, "count": count, "type": kind,
        }));
        accessors.len() - 1
    }

    fn floats(&mut self, kind: &str, values: &[f32]) -> usize {
        let width = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let bytes: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        self.accessor(kind, 5126, values.len() / width, &bytes)
    }

    fn indices(&mut self, values: &[u16]) -> usize {
        let bytes: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        self.accessor("SCALAR", 5123, values.len(), &bytes)
    }

    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    fn attribute(&mut self, name: &str, accessor: usize) {
        self.primitive()["attributes"][name] = json!(accessor);
    }

    /// Adds a channel to the animation that drives a node.
    fn channel(&mut self, node: usize, path: &str, mode: &str, times: usize, values: usize) {
        if self.json["animations"].is_null() {
            self.json["animations"] = json!([{"channels": [], "samplers": []}]);
        }
        let animation = &mut self.json["animations"][0];
        let samplers = animation["samplers"].as_array_mut().unwrap();
        samplers.push(json!({"input": times, "output": values, "interpolation": mode}));
        let sampler = samplers.len() - 1;
        animation["channels"].as_array_mut().unwrap().push(json!({
            "sampler": sampler, "target": {"node": node, "path": path},
        }));
    }

    /// As text with its buffer inside.
    fn text(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        let data = base64::engine::general_purpose::STANDARD.encode(&self.bin);
        let uri = format!("data:application/octet-stream;base64,{data}");
        json["buffers"] = json!([{"byteLength": self.bin.len(), "uri": uri}]);
        serde_json::to_vec(&json).unwrap()
    }

    fn glb(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        json["buffers"] = json!([{"byteLength": self.bin.len()}]);
        let mut text = serde_json::to_vec(&json).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let mut out = b"glTF".to_vec();
        let total = 12 + 8 + text.len() + 8 + bin.len();
        for word in [2, total, text.len()] {
            out.extend((word as u32).to_le_bytes());
        }
        out.extend(b"JSON");
        out.extend(text);
        out.extend((bin.len() as u32).to_le_bytes());
        out.extend(b"BIN\0");
        out.extend(bin);
        out
    }

    fn load(&self) -> Result<Scene, String> {
        load_bytes(&self.text(), "gltf")
    }

    fn scene(&self) -> Scene {
        self.load().unwrap()
    }
}

fn load_bytes(bytes: &[u8], extension: &str) -> Result<Scene, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("scene.{extension}"));
    fs::write(&path, bytes).unwrap();
    Scene::load(&path, 1.0).map_err(|error| error.to_string())
}

fn posed(scene: &Scene, time_s: f64) -> Pose {
    let mut pose = Pose::default();
    scene.pose(time_s, &mut pose);
    pose
}

/// The vertices and normals of an instance in world metres.
fn world(scene: &Scene, instance: usize, time_s: f64) -> (Vec<Vec3>, Vec<Vec3>) {
    let pose = posed(scene, time_s);
    let at = &pose.instances[instance];
    let (mut positions, mut normals) = (Vec::new(), Vec::new());
    scene.deform(instance, at, &mut positions, &mut normals);
    for position in &mut positions {
        *position = at.world_from_local.transform_point3(*position) + scene.origin.as_vec3();
    }
    for normal in &mut normals {
        *normal = at.world_normal(*normal);
    }
    (positions, normals)
}

#[track_caller]
fn assert_near(a: Vec3, b: Vec3) {
    assert!(a.distance(b) < 1e-5, "{a} is not {b}");
}

/// Everything a scene's user relies on.
fn assert_sound(scene: &Scene) {
    assert!(scene.origin.is_finite());
    for mesh in &scene.meshes {
        let count = mesh.positions.len();
        assert_eq!(mesh.normals.len(), count);
        assert!(mesh.positions.iter().all(|position| position.is_finite()));
        assert!(
            mesh.normals.iter().all(|normal| normal.is_normalized()),
            "{}",
            mesh.name
        );
        assert_eq!(mesh.uvs.len(), if mesh.mask.is_some() { count } else { 0 });
        assert_eq!(mesh.joints.len(), mesh.weights.len());
        assert!(mesh.joints.is_empty() || mesh.joints.len() == count);
        assert!(
            mesh.weights
                .iter()
                .all(|w| (w.iter().sum::<f32>() - 1.0).abs() < 1e-4)
        );
        assert!(!mesh.triangles.is_empty());
        assert!(
            mesh.triangles
                .as_flattened()
                .iter()
                .all(|&v| (v as usize) < count)
        );
        assert!(
            mesh.morphs
                .iter()
                .all(|morph| morph.positions.len() == count)
        );
        assert!(
            mesh.morphs
                .iter()
                .all(|m| m.normals.is_empty() || m.normals.len() == count)
        );
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|v| mesh.positions[v as usize].as_dvec3());
            assert!((b - a).cross(c - a).length() > 0.0, "{}", mesh.name);
        }
    }
    for (index, node) in scene.nodes.iter().enumerate() {
        assert!(node.parent.is_none_or(|parent| (parent as usize) < index));
    }
    for instance in &scene.instances {
        if let Some(skin) = instance.skin {
            let joints = scene.skins[skin as usize].joints.len();
            let mesh = &scene.meshes[instance.mesh as usize];
            assert!(
                mesh.joints
                    .as_flattened()
                    .iter()
                    .all(|&joint| (joint as usize) < joints)
            );
        }
    }
    for time_s in [0.0, 0.37, 1e6] {
        let pose = posed(scene, time_s);
        let [low, high] = scene.bounds(&pose);
        assert!(low.is_finite() && high.is_finite() && low.cmple(high).all());
        for at in &pose.instances {
            assert!(at.world_from_local.is_finite());
            assert!(at.joints.iter().all(|joint| joint.is_finite()));
        }
    }
}

#[test]
fn missing_normals_are_flat_and_the_origin_is_the_centre() {
    // A roof: two triangles that share an edge, folded.
    let mut file = Gltf::new();
    let corners = [0., 0., 0., 0., 0., 1., 1., 1., 0., -1., 1., 0.];
    let corners = file.floats("VEC3", &corners);
    file.attribute("POSITION", corners);
    let indices = file.indices(&[0, 1, 2, 0, 3, 1]);
    file.primitive()["indices"] = json!(indices);
    let scene = file.scene();
    let mesh = &scene.meshes[0];
    assert_eq!(mesh.positions.len(), 6);
    let half = 0.5f32.sqrt();
    assert_near(mesh.normals[0], Vec3::new(-half, half, 0.0));
    assert_near(mesh.normals[3], Vec3::new(half, half, 0.0));
    assert_eq!(scene.origin, DVec3::new(0.0, 0.5, 0.5));
    assert_eq!(
        scene.bounds(&posed(&scene, 0.0)),
        [Vec3::new(-1., -0.5, -0.5), Vec3::new(1., 0.5, 0.5)]
    );
    assert_sound(&scene);
}

#[test]
fn strips_and_fans_keep_their_winding() {
    for (mode, corners) in [
        (5, [0., 0., 0., 1., 0., 0., 0., 1., 0., 1., 1., 0.]),
        (6, [0., 0., 0., 1., 0., 0., 1., 1., 0., 0., 1., 0.]),
    ] {
        let mut file = Gltf::new();
        let corners = file.floats("VEC3", &corners);
        file.attribute("POSITION", corners);
        file.primitive()["mode"] = json!(mode);
        let scene = file.scene();
        assert_eq!(scene.meshes[0].triangles.len(), 2);
        assert!(
            scene.meshes[0]
                .normals
                .iter()
                .all(|&normal| normal == Vec3::Z)
        );
    }
}

#[test]
fn hierarchies_instancing_and_the_unit_compose() {
    let mut file = Gltf::triangle();
    file.json["nodes"] = json!([
        {"translation": [10.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.5f64.sqrt(), 0.5f64.sqrt()],
         "children": [1, 2]},
        {"mesh": 0, "scale": [2.0, 3.0, 1.0]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
    ]);
    let scene = file.scene();
    assert_eq!((scene.meshes.len(), scene.instances.len()), (1, 2));
    assert_near(world(&scene, 0, 0.0).0[1], Vec3::new(10.0, 2.0, 0.0));
    assert_near(world(&scene, 0, 0.0).0[2], Vec3::new(7.0, 0.0, 0.0));
    assert_near(world(&scene, 1, 0.0).0[2], Vec3::new(9.0, 0.0, 5.0));

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    fs::write(&path, file.glb()).unwrap();
    let scene = Scene::load(&path, 0.5).unwrap();
    assert_near(world(&scene, 1, 0.0).0[2], Vec3::new(4.5, 0.0, 2.5));
    assert!(
        Scene::load(&path, 0.0)
            .unwrap_err()
            .to_string()
            .contains("metres per unit")
    );
}

#[test]
fn mirrored_and_squashed_instances_keep_their_normals_in_front() {
    let mut file = Gltf::new();
    let corners = file.floats("VEC3", &[1., 0., 0., 0., 1., 0., 0., 0., 1.]);
    file.attribute("POSITION", corners);
    file.json["nodes"] = json!([{"mesh": 0, "scale": [-1.0, 1.0, 2.0]}]);
    let scene = file.scene();
    // The plane x + y + z = 1 becomes -x + y + z/2 = 1, and its outside stays outside.
    let (positions, normals) = world(&scene, 0, 0.0);
    assert_near(normals[0], Vec3::new(-1.0, 1.0, 0.5).normalize());
    let pose = posed(&scene, 0.0);
    let winding = (positions[1] - positions[0]).cross(positions[2] - positions[0]);
    let sign = pose.instances[0]
        .world_from_local
        .matrix3
        .determinant()
        .signum();
    assert_eq!(sign, -1.0);
    assert!((winding * sign).dot(normals[0]) > 0.0);
}

#[test]
fn quantized_and_normalized_attributes_are_read() {
    let mut file = Gltf::new();
    let corners: Vec<u8> = [[0i16, 0, 0, 0], [32767, 0, 0, 0], [0, -32768, 0, 0]]
        .as_flattened()
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let corners = file.accessor("VEC3", 5122, 3, &corners);
    file.json["accessors"][corners]["normalized"] = json!(true);
    file.json["bufferViews"][0]["byteStride"] = json!(8);
    file.attribute("POSITION", corners);
    let normals = file.accessor("VEC3", 5120, 3, &[0, 0, 129, 0, 0, 0, 128, 0, 0, 0, 127, 0]);
    file.json["accessors"][normals]["normalized"] = json!(true);
    file.json["bufferViews"][1]["byteStride"] = json!(4);
    file.attribute("NORMAL", normals);
    file.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    file.json["extensionsUsed"] = json!(["KHR_mesh_quantization"]);
    let mesh = &file.scene().meshes[0];
    assert_eq!(mesh.positions, [Vec3::ZERO, Vec3::X, -Vec3::Y]);
    assert_eq!(mesh.normals, [-Vec3::Z, -Vec3::Z, Vec3::Z]);
}

#[test]
fn sparse_accessors_replace_values_of_data_and_of_zeros() {
    let mut file = Gltf::triangle();
    let places = file.view(&[2, 0]);
    let values: Vec<u8> = [0f32, 7.0, 0.0]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let values = file.view(&values);
    file.json["accessors"][0]["sparse"] = json!({
        "count": 1,
        "indices": {"bufferView": places, "componentType": 5121},
        "values": {"bufferView": values},
    });
    assert_eq!(
        file.scene().meshes[0].positions[2],
        Vec3::new(0.0, 7.0, 0.0)
    );
    file.json["accessors"][0]
        .as_object_mut()
        .unwrap()
        .remove("bufferView");
    // All but one vertex at zero: nothing is left, and that is said.
    assert!(file.load().unwrap_err().contains("triangles"));
    file.json["accessors"][0]["sparse"]["indices"]["byteOffset"] = json!(1);
    file.json["accessors"][0]["count"] = json!(1u64 << 40);
    assert!(file.load().unwrap_err().contains("accessor 0"));
}

#[test]
fn step_and_linear_keys_hold_interpolate_and_loop() {
    let mut file = Gltf::triangle();
    let times = file.floats("SCALAR", &[1.0, 3.0, 4.0]);
    let places = file.floats("VEC3", &[1., 0., 0., 3., 0., 0., 3., 8., 0.]);
    file.channel(0, "translation", "LINEAR", times, places);
    let scales = file.floats("VEC3", &[1., 1., 1., 2., 2., 2., 3., 3., 3.]);
    file.channel(0, "scale", "STEP", times, scales);
    let scene = file.scene();
    assert!(scene.instances[0].moves && !scene.instances[0].deforms);
    for (time, at, scale) in [
        (0.0, Vec3::X, 1.0),
        (2.0, Vec3::X * 2.0, 1.0),
        (3.5, Vec3::new(3., 4., 0.), 2.0),
        (4.5, Vec3::X, 1.0),
        (-2.0, Vec3::X * 2.0, 1.0),
    ] {
        let (positions, _) = world(&scene, 0, time);
        assert_near(positions[0], at);
        assert_near(positions[1], at + Vec3::X * scale);
    }
}

#[test]
fn rotations_are_spherical_and_take_the_short_way() {
    let mut file = Gltf::triangle();
    let times = file.floats("SCALAR", &[0.0, 1.0]);
    // 90 degrees about z, with the sign that would go the long way around.
    let half = 0.5f32.sqrt();
    let turns = file.floats("VEC4", &[0., 0., 0., 1., 0., 0., -half, -half]);
    file.channel(0, "rotation", "LINEAR", times, turns);
    let scene = file.scene();
    let (sin, cos) = 30f32.to_radians().sin_cos();
    assert_near(world(&scene, 0, 1.0 / 3.0).0[1], Vec3::new(cos, sin, 0.0));
}

#[test]
fn cubic_splines_follow_their_tangents() {
    let mut file = Gltf::triangle();
    let times = file.floats("SCALAR", &[0.0, 2.0]);
    // In-tangent, value, out-tangent of each key.
    let keys = [
        9., 9., 9., 0., 0., 0., 1., 0., 0., 0., 4., 0., 2., 0., 0., 9., 9., 9.,
    ];
    let keys = file.floats("VEC3", &keys);
    file.channel(0, "translation", "CUBICSPLINE", times, keys);
    let scene = file.scene();
    // At u = 1/4: h10 = 9/64, h01 = 10/64, h11 = -3/64, tangents times 2 seconds.
    let x = 2.0 * 9.0 / 64.0 + 2.0 * 10.0 / 64.0;
    assert_near(
        world(&scene, 0, 0.5).0[0],
        Vec3::new(x, -3.0 / 64.0 * 2.0 * 4.0, 0.0),
    );
}

#[test]
fn morph_targets_add_up_and_their_weights_animate() {
    let mut file = Gltf::triangle();
    let normals = file.floats("VEC3", &[0., 0., 1., 0., 0., 1., 0., 0., 1.]);
    file.attribute("NORMAL", normals);
    let up = file.floats("VEC3", &[0., 0., 1., 0., 0., 1., 0., 0., 1.]);
    let right = file.floats("VEC3", &[1., 0., 0., 1., 0., 0., 1., 0., 0.]);
    file.primitive()["targets"] = json!([{"POSITION": up}, {"POSITION": up, "NORMAL": right}]);
    file.json["meshes"][0]["weights"] = json!([0.25, 0.0]);
    let scene = file.scene();
    assert!(scene.instances[0].deforms && !scene.instances[0].moves);
    assert_near(world(&scene, 0, 0.0).0[0], Vec3::Z * 0.25);

    let times = file.floats("SCALAR", &[0.0, 1.0]);
    let weights = file.floats("SCALAR", &[0., 0., 2., 1.]);
    file.channel(0, "weights", "LINEAR", times, weights);
    let (positions, normals) = world(&file.scene(), 0, 0.5);
    assert_near(positions[0], Vec3::Z * 1.5);
    assert_near(normals[0], Vec3::new(0.5, 0.0, 1.0).normalize());
}

/// A triangle skinned to two joints; the second, one unit up, turns 90 degrees in a second.
fn skinned() -> Gltf {
    let mut file = Gltf::new();
    let corners = file.floats("VEC3", &[0., 0., 0., 0., 2., 0., 1., 2., 0.]);
    file.attribute("POSITION", corners);
    let joints = file.accessor("VEC4", 5121, 3, &[0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]);
    file.attribute("JOINTS_0", joints);
    let weights = file.floats("VEC4", &[1., 0., 0., 0., 1., 0., 0., 0., 1., 1., 0., 0.]);
    file.attribute("WEIGHTS_0", weights);
    let mut bind = glam::Mat4::IDENTITY.to_cols_array().to_vec();
    bind.extend(glam::Mat4::from_translation(-Vec3::Y).to_cols_array());
    let bind = file.floats("MAT4", &bind);
    file.json["skins"] = json!([{"joints": [1, 2], "inverseBindMatrices": bind}]);
    file.json["scenes"] = json!([{"nodes": [0, 1]}]);
    file.json["nodes"] = json!([
        {"mesh": 0, "skin": 0, "translation": [50, 60, 70]},
        {"translation": [3, 0, 0], "children": [2]},
        {"translation": [0, 1, 0]},
    ]);
    let times = file.floats("SCALAR", &[0.0, 1.0]);
    let half = 0.5f32.sqrt();
    let turns = file.floats("VEC4", &[0., 0., 0., 1., 0., 0., half, half]);
    file.channel(2, "rotation", "LINEAR", times, turns);
    file
}

#[test]
fn skins_place_vertices_by_their_joints_alone() {
    for scale in [json!([1, 1, 1]), json!([-2, 1, 1]), json!([0, 1, 1])] {
        let mut file = skinned();
        file.json["nodes"][0]["scale"] = scale;
        let scene = file.scene();
        assert!(scene.instances[0].deforms);
        let (positions, normals) = world(&scene, 0, 0.9999999);
        assert!(
            positions[0].distance(Vec3::new(3.0, 0.0, 0.0)) < 1e-4,
            "{positions:?}"
        );
        // (0, 1) about the joint turns to (-1, 0).
        assert!(
            positions[1].distance(Vec3::new(2.0, 1.0, 0.0)) < 1e-4,
            "{positions:?}"
        );
        // Half of (1, 2), half of (-1, 2) turned.
        assert!(
            positions[2].distance(Vec3::new(3.0, 2.0, 0.0)) < 1e-4,
            "{positions:?}"
        );
        // Faces -z at rest.
        assert_near(normals[1], -Vec3::Z);
        assert_sound(&scene);
    }
}

#[test]
fn joints_out_of_range_follow_the_first_and_are_counted() {
    let mut file = skinned();
    file.json["skins"] = json!([{"joints": [1]}]);
    let scene = file.scene();
    assert_eq!(scene.dropped.bad_joints, 2);
    assert_near(world(&scene, 0, 0.0).0[1], Vec3::new(3.0, 2.0, 0.0));
    file.json["skins"] = json!([{"joints": [1, 9]}]);
    assert!(file.load().unwrap_err().contains("joint 9 is no node"));
}

fn png(pixels: &[[u8; 4]], width: u32) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, pixels.len() as u32 / width);
    encoder.set_color(png::ColorType::Rgba);
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(pixels.as_flattened()).unwrap();
    writer.finish().unwrap();
    out
}

/// A triangle with a mask of 2 x 1 texels: a hole on the left.
fn masked() -> Gltf {
    let mut file = Gltf::triangle();
    let uvs = file.floats("VEC2", &[0., 0., 1., 0., 0., 1.]);
    file.attribute("TEXCOORD_0", uvs);
    file.primitive()["material"] = json!(0);
    let image = file.view(&png(&[[0; 4], [255; 4]], 2));
    file.json["images"] = json!([{"bufferView": image, "mimeType": "image/png"}]);
    file.json["samplers"] = json!([{"wrapS": 33648, "wrapT": 33071}]);
    file.json["textures"] = json!([{"source": 0, "sampler": 0}]);
    file.json["materials"] = json!([{
        "alphaMode": "MASK", "doubleSided": true,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
    }]);
    file
}

#[test]
fn masks_have_holes_where_the_texture_says() {
    let scene = masked().scene();
    let mesh = &scene.meshes[0];
    assert!(mesh.double_sided);
    let mask = mesh.mask.as_ref().unwrap();
    // Mirrored across, clamped down.
    for (u, v, hole) in [
        (0.2, 0.5, true),
        (0.7, 0.5, false),
        (1.3, -4.0, false),
        (1.8, 9.0, true),
        (-0.2, 0.5, true),
        (-0.7, 0.5, false),
        (f32::NAN, f32::INFINITY, true),
    ] {
        assert_eq!(mask.is_hole(Vec2::new(u, v)), hole, "{u}, {v}");
    }
    assert_sound(&scene);
}

#[test]
fn texture_transforms_apply_to_masks() {
    let mut file = masked();
    let turn = std::f64::consts::FRAC_PI_2;
    file.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] =
        json!({"KHR_texture_transform": {"offset": [5, 0], "rotation": turn, "scale": [2, 3]}});
    file.json["extensionsRequired"] = json!(["KHR_texture_transform"]);
    let scene = file.scene();
    // Counter-clockwise with v downwards: (u, v) goes to (v, -u).
    let uvs = &scene.meshes[0].uvs;
    assert!(uvs[1].distance(Vec2::new(5.0, -2.0)) < 1e-5);
    assert!(uvs[2].distance(Vec2::new(8.0, 0.0)) < 1e-5);
}

#[test]
fn without_a_texture_the_base_colour_decides() {
    let mut file = masked();
    for (alpha, cutoff, stays) in [(1.0, 0.5, true), (0.3, 0.5, false), (0.3, 0.2, true)] {
        file.json["materials"] = json!([{
            "alphaMode": "MASK", "alphaCutoff": cutoff,
            "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, alpha]},
        }]);
        assert_eq!(file.load().is_ok(), stays);
    }
}

#[test]
fn broken_geometry_is_dropped_and_counted_and_slivers_stay() {
    let mut file = Gltf::new();
    let sliver = 1e-20;
    let corners = file.floats(
        "VEC3",
        &[
            0.,
            0.,
            0.,
            1.,
            0.,
            0.,
            0.,
            1.,
            0.,
            f32::NAN,
            0.,
            0.,
            0.5,
            sliver,
            0.,
            0.25,
            0.,
            0.,
        ],
    );
    file.attribute("POSITION", corners);
    let indices = file.indices(&[0, 1, 2, 0, 1, 3, 0, 1, 4, 0, 5, 1, 0, 1, 60000, 2, 2, 1]);
    file.primitive()["indices"] = json!(indices);
    let points = json!({"attributes": {"POSITION": corners}, "mode": 0});
    file.json["meshes"][0]["primitives"]
        .as_array_mut()
        .unwrap()
        .push(points);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].triangles.len(), 2);
    let expected = Dropped {
        degenerate_triangles: 3,
        out_of_range_triangles: 1,
        empty_primitives: 1,
        non_finite_vertices: 1,
        ..Dropped::default()
    };
    assert_eq!(scene.dropped, expected);
    assert_sound(&scene);
}

#[test]
fn normals_that_are_no_directions_are_made_again() {
    let mut file = Gltf::triangle();
    let normals = file.floats("VEC3", &[0., 0., 5., 0., 0., 0., f32::NAN, 0., 1.]);
    file.attribute("NORMAL", normals);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].normals, [Vec3::Z; 3]);
    assert_eq!(scene.dropped.non_finite_vertices, 1);
}

#[test]
fn broken_channels_are_dropped_and_counted() {
    let mut file = Gltf::triangle();
    let times = file.floats("SCALAR", &[0.0, 1.0]);
    let back = file.floats("SCALAR", &[1.0, 0.0]);
    let places = file.floats("VEC3", &[0., 0., 0., 1., 0., 0.]);
    let nan = file.floats("VEC3", &[0., 0., 0., f32::NAN, 0., 0.]);
    let zero = file.floats("VEC4", &[0., 0., 0., 0., 0., 0., 0., 1.]);
    file.channel(0, "translation", "LINEAR", back, places);
    file.channel(0, "translation", "LINEAR", times, nan);
    file.channel(0, "translation", "CUBICSPLINE", times, places);
    file.channel(0, "rotation", "LINEAR", times, zero);
    file.channel(0, "weights", "LINEAR", times, places);
    file.channel(9, "translation", "LINEAR", times, places);
    file.channel(0, "translation", "LINEAR", times, places);
    let scene = file.scene();
    assert_eq!(scene.dropped.bad_channels, 6);
    assert_eq!(scene.animations[0].channels.len(), 1);
}

#[test]
fn errors_name_the_file_the_thing_and_the_remedy() {
    let with = |change: &dyn Fn(&mut Gltf)| {
        let mut file = masked();
        change(&mut file);
        file.load().unwrap_err()
    };
    for name in [
        "KHR_draco_mesh_compression",
        "EXT_meshopt_compression",
        "KHR_meshopt_compression",
    ] {
        let error = with(&|file| file.json["extensionsRequired"] = json!([name]));
        assert!(error.contains(name), "{error}");
        assert!(
            error.contains("npx @gltf-transform/cli copy IN.glb OUT.glb"),
            "{error}"
        );
        assert!(error.contains("scene.gltf"), "{error}");
    }
    let error = with(&|file| file.json["nodes"] = json!([{"children": [1]}, {"children": [0]}]));
    assert!(
        error.contains("node 0 has two parents, or is its own ancestor"),
        "{error}"
    );
    let error = with(&|file| {
        let chain = (0..2000).map(|i| json!({"children": [i + 1]}));
        file.json["nodes"] = chain.collect();
    });
    assert!(error.contains("1024 levels"), "{error}");
    let error = with(&|file| file.json["images"] = json!([{"uri": "leaf%20a.png"}]));
    assert!(
        error.contains("material 0") && error.contains("leaf a.png"),
        "{error}"
    );
    let error = with(&|file| file.json["images"] = json!([{"bufferView": 0}]));
    assert!(error.contains("convert it to PNG"), "{error}");
    let error = with(&|file| file.json["accessors"][0]["count"] = json!(4));
    assert!(
        error.contains("mesh 0") && error.contains("accessor 0"),
        "{error}"
    );
    let error = with(&|file| file.json["accessors"][0]["componentType"] = json!(1));
    assert!(error.contains("accessor 0"), "{error}");
    let error = with(&|file| file.json["bufferViews"][0]["byteStride"] = json!(0));
    assert!(error.contains("stride"), "{error}");
    let error = with(&|file| file.json["nodes"] = json!([{"mesh": 0, "rotation": [0, 0, 0, 0]}]));
    assert!(error.contains("node 0"), "{error}");
    let error = with(&|file| file.json["nodes"] = json!([{"mesh": 0, "scale": [1e9, 1, 1]}]));
    assert!(error.contains("across"), "{error}");
    let error = with(&|file| file.json["asset"]["version"] = json!("1.0"));
    assert!(error.contains("glTF 1.0"), "{error}");

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    let mut json = Gltf::triangle().json;
    json["buffers"] = json!([{"byteLength": 36, "uri": "a.bin"}]);
    fs::write(&path, serde_json::to_vec(&json).unwrap()).unwrap();
    let error = Scene::load(&path, 1.0).unwrap_err().to_string();
    assert!(
        error.contains("a.gltf") && error.contains("a.bin"),
        "{error}"
    );
    fs::write(folder.path().join("a.bin"), [0; 35]).unwrap();
    let error = Scene::load(&path, 1.0).unwrap_err().to_string();
    assert!(
        error.contains("buffer 0 has 35 bytes, not the 36"),
        "{error}"
    );
    fs::write(folder.path().join("a.bin"), Gltf::triangle().bin).unwrap();
    assert_sound(&Scene::load(&path, 1.0).unwrap());
    assert!(Scene::load(folder.path(), 1.0).is_err());
}

#[test]
fn roots_far_out_are_as_precise_as_near_ones() {
    let mut file = Gltf::triangle();
    file.json["nodes"] = json!([
        {"translation": [1e6 + 0.125, -3e6, 0.0], "children": [1, 2]},
        {"mesh": 0},
        {"mesh": 0, "translation": [0.25, 0.0, 0.0]},
    ]);
    let scene = file.scene();
    assert_eq!(scene.origin, DVec3::new(1e6 + 0.75, -3e6 + 0.5, 0.0));
    let pose = posed(&scene, 0.0);
    let at = |i: usize| Vec3::from(pose.instances[i].world_from_local.translation);
    assert_eq!(at(1) - at(0), Vec3::X * 0.25);
}

#[test]
fn transforming_and_adding_scenes_moves_everything_and_nothing_within() {
    let mut scene = skinned().scene();
    let before = world(&scene, 0, 0.5).0;
    let by = DAffine3::from_scale_rotation_translation(
        DVec3::splat(2.0),
        DQuat::from_rotation_y(std::f64::consts::PI),
        DVec3::new(1.0, 2.0, 3.0),
    );
    scene.transform(by);
    for (after, before) in world(&scene, 0, 0.5).0.iter().zip(&before) {
        assert!(
            after
                .as_dvec3()
                .distance(by.transform_point3(before.as_dvec3()))
                < 1e-4
        );
    }

    let mut scene = Scene::atrium();
    let many = scene.instances.len();
    let table = world(&scene, 0, 0.7).0;
    scene.add(skinned().scene(), DVec3::new(100.0, 0.0, 0.0), 3.0);
    assert_eq!(scene.instances.len(), many + 1);
    for (after, before) in world(&scene, many, 0.5).0.iter().zip(&before) {
        assert!(after.distance(*before * 3.0 + Vec3::X * 100.0) < 1e-3);
    }
    for (after, before) in world(&scene, 0, 0.7).0.iter().zip(&table) {
        assert!(after.distance(*before) < 1e-3);
    }
    assert_sound(&scene);
}

#[test]
fn placements_are_read_or_refused_with_what_is_wrong() {
    let placement: Placement = "a@b.glb@1,-2.5,3e1,0.01".parse().unwrap();
    assert_eq!(placement.path, PathBuf::from("a@b.glb"));
    assert_eq!(
        (placement.at, placement.scale),
        (DVec3::new(1.0, -2.5, 30.0), 0.01)
    );
    assert_eq!("f@0,0,0".parse::<Placement>().unwrap().scale, 1.0);
    for (text, wrong) in [
        ("f.glb", "no `@`"),
        ("@1,2,3", "no file name"),
        ("f@1,2", "2 numbers"),
        ("f@1,x,3", "`x` is not"),
        ("f@1,2,nan", "`nan` is not"),
        ("f@1,2,3,0", "above 0"),
    ] {
        let error = text.parse::<Placement>().unwrap_err().to_string();
        assert!(
            error.contains(wrong) && error.contains("FILE@x,y,z"),
            "{error}"
        );
    }
}

#[test]
fn the_hash_is_of_the_content_alone() {
    let file = skinned();
    let hash = file.scene().hash();
    assert_eq!(load_bytes(&file.glb(), "glb").unwrap().hash(), hash);
    let mut named = skinned();
    named.json["nodes"][0]["name"] = json!("else");
    assert_eq!(named.scene().hash(), hash);
    for change in [
        |scene: &mut Scene| scene.meshes[0].positions[0].x = -0.0,
        |scene: &mut Scene| scene.meshes[0].triangles[0].swap(0, 1),
        |scene: &mut Scene| scene.meshes[0].double_sided = true,
        |scene: &mut Scene| scene.nodes[2].local = LocalTransform::IDENTITY,
        |scene: &mut Scene| scene.skins[0].joints.swap(0, 1),
        |scene: &mut Scene| scene.instances[0].skin = None,
        |scene: &mut Scene| scene.animations[0].channels[0].times[1] = 2.0,
        |scene: &mut Scene| scene.transform(DAffine3::IDENTITY),
    ] {
        let mut scene = file.scene();
        change(&mut scene);
        assert_ne!(scene.hash(), hash);
    }
}

#[test]
fn posing_again_takes_no_new_memory() {
    let scene = Scene::atrium();
    let mut pose = posed(&scene, 0.0);
    let places = |pose: &Pose| -> Vec<*const glam::Affine3A> {
        pose.instances.iter().map(|at| at.joints.as_ptr()).collect()
    };
    let before = (pose.instances.as_ptr(), places(&pose));
    scene.pose(1.5, &mut pose);
    assert_eq!((pose.instances.as_ptr(), places(&pose)), before);
    assert_eq!(pose.time_s, 1.5);
}

#[test]
fn a_pose_from_elsewhere_may_lack_anything() {
    let scene = skinned().scene();
    let (mut positions, mut normals) = (Vec::new(), Vec::new());
    scene.deform(0, &Default::default(), &mut positions, &mut normals);
    assert_eq!(positions, scene.meshes[0].positions);
}

#[test]
fn the_atrium_is_sound_and_the_same_on_every_machine() {
    let scene = Scene::atrium();
    assert_sound(&scene);
    let triangles: usize = scene
        .instances
        .iter()
        .map(|i| scene.meshes[i.mesh as usize].triangles.len())
        .sum();
    assert!((20_000..60_000).contains(&triangles), "{triangles}");
    assert_eq!(scene.dropped, Dropped::default());
    // Winding and normals agree.
    for mesh in &scene.meshes {
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|v| mesh.positions[v as usize]);
            let normal: Vec3 = triangle.iter().map(|&v| mesh.normals[v as usize]).sum();
            assert!((b - a).cross(c - a).dot(normal) > 0.0, "{}", mesh.name);
        }
    }
    // Nothing leaves the building.
    for step in 0..40 {
        let pose = posed(&scene, f64::from(step) * 0.73);
        let [low, high] = scene.bounds(&pose);
        assert!(
            (high - low).distance(Vec3::new(12.4, 5.4, 8.4)) < 1e-3,
            "{low} {high}"
        );
    }
    let skinned = scene
        .instances
        .iter()
        .filter(|instance| instance.skin.is_some())
        .count();
    assert_eq!(skinned, 2);
    // Recorded once; another value on another machine means client and server would disagree.
    assert_eq!(scene.hash(), ATRIUM_HASH, "{:#x}", scene.hash());
}

const ATRIUM_HASH: u64 = 0xee74_4695_90df_c62b;

/// The folder of real scenes, where there is one.
fn real_scenes() -> Vec<PathBuf> {
    let folder = std::env::var_os("PSAO_SCENES").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes"),
        PathBuf::from,
    );
    let mut files = Vec::new();
    for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
        for file in fs::read_dir(entry.path()).into_iter().flatten().flatten() {
            let path = file.path();
            if path.extension().is_some_and(|e| e == "gltf" || e == "glb") {
                files.push(path);
            }
        }
    }
    files.sort();
    if files.is_empty() {
        println!(
            "skipped: no scenes in {}; set PSAO_SCENES",
            folder.display()
        );
    }
    files
}

#[test]
fn real_scenes_load_or_name_the_extension_that_is_in_the_way() {
    for path in real_scenes() {
        match Scene::load(&path, 1.0) {
            Ok(mut scene) => {
                let triangles: usize = (scene.instances.iter())
                    .map(|instance| scene.meshes[instance.mesh as usize].triangles.len())
                    .sum();
                let [low, high] = scene.bounds(&posed(&scene, 0.0));
                println!(
                    "{}: {} instances, {triangles} triangles, {} m, {:?}",
                    scene.name,
                    scene.instances.len(),
                    high - low,
                    scene.dropped
                );
                assert_sound(&scene);
                assert_eq!(scene.hash(), Scene::load(&path, 1.0).unwrap().hash());
                let many = scene.instances.len();
                scene.add_movers(4, 1);
                assert_eq!(scene.instances.len(), many + 4);
                assert_sound(&scene);
            }
            Err(error) => {
                let error = error.to_string();
                assert!(error.contains("_compression"), "{error}");
            }
        }
    }
}

/// Changes bytes by a fixed sequence.
struct Vandal(u64);

impl Vandal {
    fn next(&mut self, below: usize) -> usize {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        ((self.0 >> 33) as usize) % below.max(1)
    }

    /// Truncates, flips bytes, writes NaN, or makes numbers in the text larger.
    fn damage(&mut self, bytes: &[u8], variant: usize) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        match variant % 4 {
            0 => bytes.truncate(self.next(bytes.len())),
            1 => {
                for _ in 0..8 {
                    let at = self.next(bytes.len());
                    bytes[at] ^= 1 << self.next(8);
                }
            }
            2 => {
                for _ in 0..64 {
                    let at = self.next(bytes.len() / 4) * 4;
                    let value = [f32::NAN, f32::INFINITY, f32::MAX, 1e-44][self.next(4)];
                    bytes
                        .get_mut(at..at + 4)
                        .unwrap_or_default()
                        .copy_from_slice(&value.to_le_bytes());
                }
            }
            _ => {
                // Digits of the text: counts, indices, offsets, types.
                let digits: Vec<usize> = (0..bytes.len().min(60_000))
                    .filter(|&i| bytes[i].is_ascii_digit())
                    .collect();
                for _ in 0..1 + self.next(3) {
                    let at = digits[self.next(digits.len())];
                    bytes[at] = b"0123456789-e"[self.next(12)];
                }
            }
        }
        bytes
    }
}

/// Loads damaged bytes beside the original's files; a panic fails the test.
fn survive(folder: &Path, bytes: &[u8], extension: &str, variants: usize) -> [usize; 2] {
    let mut vandal = Vandal(bytes.len() as u64);
    let mut outcomes = [0; 2];
    let place = tempfile::tempdir().unwrap();
    for file in fs::read_dir(folder).unwrap().flatten() {
        if file
            .path()
            .extension()
            .is_some_and(|e| e == "bin" || e == "png")
        {
            let mut bytes = fs::read(file.path()).unwrap();
            // Damage beside the text, too.
            for _ in 0..50 {
                let at = vandal.next(bytes.len());
                bytes[at] = 255;
            }
            fs::write(place.path().join(file.file_name()), bytes).unwrap();
        }
    }
    let path = place.path().join(format!("damaged.{extension}"));
    for variant in 0..variants {
        // NaN only where there is binary data: text with it does not parse anyway.
        fs::write(&path, vandal.damage(bytes, variant)).unwrap();
        match Scene::load(&path, 1.0) {
            Ok(scene) => {
                assert_sound(&scene);
                outcomes[0] += 1;
            }
            Err(error) => {
                assert!(error.to_string().contains("damaged."), "{error}");
                outcomes[1] += 1;
            }
        }
    }
    outcomes
}

#[test]
fn damaged_files_load_repaired_or_give_an_error_and_never_panic() {
    let empty = tempfile::tempdir().unwrap();
    for file in [skinned(), masked(), Gltf::triangle()] {
        for (bytes, extension) in [(file.glb(), "glb"), (file.text(), "gltf")] {
            let [sound, refused] = survive(empty.path(), &bytes, extension, 400);
            assert!(
                sound > 0 && refused > 0,
                "{sound} loaded, {refused} refused"
            );
        }
    }
    // Every length of a small file.
    let whole = skinned().glb();
    for length in 0..whole.len() - 3 {
        assert!(load_bytes(&whole[..length], "glb").is_err(), "{length}");
    }
}

#[test]
fn damaged_real_scenes_never_panic() {
    for path in real_scenes() {
        let bytes = fs::read(&path).unwrap();
        let extension = path.extension().unwrap().to_str().unwrap();
        let large = fs::read_dir(path.parent().unwrap()).unwrap().flatten();
        let size: u64 = large.map(|file| file.metadata().unwrap().len()).sum();
        let variants = if size > 1_000_000 { 12 } else { 60 };
        let [sound, refused] = survive(path.parent().unwrap(), &bytes, extension, variants);
        println!("{}: {sound} loaded, {refused} refused", path.display());
        assert_eq!(sound + refused, variants);
    }
}
