//! What the baker promises: the same occlusion by either method, in files that keep all they had.

#[path = "../../tests/small_scene.rs"]
#[expect(dead_code, reason = "other tests move the scene")]
mod small_scene;

use clap::Parser;
use glam::{Vec2, Vec3};
use psao_server::bake::atlas::Atlas;
use psao_server::bake::command::{BakeArgs, environment, run};
use psao_server::bake::{Element, Method, Numbers, Stage, bake, rmse_255, sh, texels, vertices};
use psao_server::rays::{Against, Tracer, offset_origin};
use psao_server::samples::Samples;
use psao_server::scene::{Instance, LocalTransform, Mesh, Node, Scene};
use serde_json::{Value, json};
use small_scene::small_scene;
use std::path::{Path, PathBuf};
use std::process::Command;

const ENDLESS: Method = Method::Rays {
    distance_m: f32::INFINITY,
};

fn elements(stage: &Stage) -> Vec<Element> {
    let instances = 0..stage.scene.instances.len() as u32;
    let inset_m = stage.sphere().1 / 128.0;
    instances
        .flat_map(|instance| vertices(stage, instance, inset_m))
        .collect()
}

fn openness(stage: &Stage, elements: &[Element], method: Method, directions: usize) -> Vec<f32> {
    let quiet = &|_: &str, _, _| ();
    let baked = bake(
        stage,
        elements,
        Numbers::Openness,
        method,
        directions,
        quiet,
    );
    baked.expect("a small scene").values
}

/// A mesh alone, where it is.
fn alone(mesh: Mesh) -> Stage {
    let mut scene = Scene {
        meshes: vec![mesh],
        nodes: vec![Node {
            name: "node".into(),
            parent: None,
            local: LocalTransform::IDENTITY,
            morph_weights: Vec::new(),
        }],
        instances: vec![Instance {
            name: "mesh".into(),
            mesh: 0,
            node: 0,
            skin: None,
            moves: false,
            deforms: false,
        }],
        ..Scene::default()
    };
    scene.set_origin();
    Stage::new(scene)
}

/// A grid of `steps` x `steps` squares over 0..1 x 0..1, bent.
fn sheet(mesh: &mut Mesh, steps: u32, at: impl Fn(f32, f32) -> (Vec3, Vec3)) {
    let first = mesh.positions.len() as u32;
    for u in 0..=steps {
        for v in 0..=steps {
            let (position, normal) = at(u as f32 / steps as f32, v as f32 / steps as f32);
            mesh.positions.push(position);
            mesh.normals.push(normal);
        }
    }
    for u in 0..steps {
        for v in 0..steps {
            let corner = first + u * (steps + 1) + v;
            let next = corner + steps + 1;
            for triangle in [[corner, next, corner + 1], [corner + 1, next, next + 1]] {
                let [a, b, c] = triangle.map(|v| mesh.positions[v as usize]);
                // Triangles at the poles have no area.
                if (b - a).cross(c - a).length() > 1e-9 {
                    mesh.triangles.push(triangle);
                }
            }
        }
    }
}

/// A floor with a wall along one side, both 40 m.
fn corner() -> Stage {
    let mut mesh = Mesh::default();
    sheet(&mut mesh, 8, |u, v| {
        (Vec3::new(40.0 * v, 0.0, 40.0 * u - 20.0), Vec3::Y)
    });
    sheet(&mut mesh, 8, |u, v| {
        (Vec3::new(0.0, 40.0 * u, 40.0 * v - 20.0), Vec3::X)
    });
    alone(mesh)
}

/// A ball of 1 m over a gently waved floor: nothing has an edge.
fn smooth() -> Stage {
    use std::f32::consts::{PI, TAU};
    let mut mesh = Mesh::default();
    sheet(&mut mesh, 32, |u, v| {
        let (across, around) = ((u * PI).sin(), v * TAU);
        let out = Vec3::new(
            across * around.cos(),
            (u * PI).cos(),
            -across * around.sin(),
        );
        (out + Vec3::Y * 1.6, out)
    });
    sheet(&mut mesh, 24, |u, v| {
        let (x, z) = (6.0 * v - 3.0, 6.0 * u - 3.0);
        let normal = Vec3::new(0.2 * x.sin(), 1.0, 0.0).normalize();
        (Vec3::new(x, 0.2 * x.cos(), z), normal)
    });
    alone(mesh)
}

#[test]
fn half_of_the_sky_is_open_at_the_foot_of_a_long_wall() {
    let stage = corner();
    let elements = elements(&stage);
    let values = openness(&stage, &elements, ENDLESS, 1024);
    // The middle of the edge that floor and wall share, of the floor.
    let foot = (0..81).filter(|v| v % 9 == 0 && (3..6).contains(&(v / 9)));
    for vertex in foot {
        let value = values[vertex];
        assert!((value - 0.5).abs() < 0.03, "vertex {vertex}: {value}");
    }
    // A floor vertex 40 m away sees the wall under 45 degrees.
    let far = values[4 * 9 + 8];
    assert!((0.85..0.95).contains(&far), "far from the wall: {far}");
}

#[test]
fn nothing_hides_a_box_from_the_sky() {
    let mut scene = small_scene::still_scene();
    scene.instances.remove(0);
    scene.set_origin();
    let stage = Stage::new(scene);
    let values = openness(&stage, &elements(&stage), ENDLESS, 64);
    assert!(
        values.len() > 20 && values.iter().all(|v| *v == 1.0),
        "{values:?}"
    );
}

#[test]
fn the_error_of_rays_falls_with_their_number() {
    let stage = Stage::new(small_scene());
    let elements = elements(&stage);
    let reference = psao_server::bake::rays::trace(
        &stage,
        &elements,
        Numbers::Openness,
        4096,
        f32::INFINITY,
        1,
        &|_, _, _| (),
    )
    .expect("a small scene");
    let error = |rays| rmse_255(&openness(&stage, &elements, ENDLESS, rays), &reference);
    let [coarse, middle, fine] = [16, 128, 1024].map(error);
    println!("rmse {coarse} {middle} {fine}");
    // Independent rays: the root of 8 from each to the next.
    assert!(coarse > 3.0 * middle && middle > 3.0 * fine);
    assert!(fine < 1.0, "{fine}/255 with 1024 rays");
}

#[test]
fn shorter_rays_leave_more_open() {
    let stage = corner();
    let elements = elements(&stage);
    let near = openness(&stage, &elements, Method::Rays { distance_m: 1.0 }, 64);
    let endless = openness(&stage, &elements, ENDLESS, 64);
    assert!(
        near.iter()
            .zip(&endless)
            .all(|(near, endless)| near >= endless)
    );
    assert!(near.iter().sum::<f32>() > endless.iter().sum::<f32>() + 10.0);
}

#[test]
fn white_light_in_harmonics_gives_the_openness() {
    let stage = Stage::new(small_scene());
    let elements = elements(&stage);
    let plain = openness(&stage, &elements, ENDLESS, 256);
    let white = sh::project(|_| 1.0);
    for order in 2..=4 {
        let numbers = Numbers::Transfer(order);
        let baked = bake(&stage, &elements, numbers, ENDLESS, 256, &|_, _, _| ());
        let values = baked.expect("a small scene").values;
        for (transfer, plain) in values.chunks(numbers.count()).zip(&plain) {
            let lit = sh::relight(&white, transfer);
            assert!(
                (lit - plain).abs() < 2e-3,
                "order {order}: {lit}, not {plain}"
            );
            assert!((transfer[0] / sh::CONSTANT - plain).abs() < 1e-4);
        }
    }
}

#[test]
fn turning_light_in_harmonics_agrees_with_traced_light_within_two_percent() {
    let stage = smooth();
    let elements: Vec<Element> = elements(&stage).into_iter().step_by(3).collect();
    let numbers = Numbers::Transfer(3);
    let baked = bake(&stage, &elements, numbers, ENDLESS, 1024, &|_, _, _| ());
    let transfers = baked.expect("a small scene").values;
    let tracer = stage.tracer().expect("a small scene");
    let samples = Samples::new(1024);
    for turn in [0.0f32, 1.3, 2.9, 4.4] {
        let light = sh::project(|d| environment(turn, d));
        let (mut squares, mut total) = (0.0, 0.0);
        for (number, (element, transfer)) in (0u32..).zip(elements.iter().zip(transfers.chunks(9)))
        {
            let mut directions = vec![Vec3::ZERO; 1024];
            samples.directions(number ^ 0x5555, element.normal, Vec3::ZERO, &mut directions);
            let origin = offset_origin(element.position, element.outward, element.reach);
            let (todo, mut hit) = ([u64::MAX; 16], [0; 16]);
            let all = Against::All;
            tracer.occluded(all, origin, &directions, f32::INFINITY, &todo, &mut hit);
            let open = (0..1024).filter(|ray| hit[ray / 64] >> (ray % 64) & 1 == 0);
            let traced = open
                .map(|ray| environment(turn, directions[ray]))
                .sum::<f32>()
                / 1024.0;
            squares += f64::from(sh::relight(&light, transfer) - traced).powi(2);
            total += f64::from(traced);
        }
        let count = elements.len() as f64;
        let error = (squares / count).sqrt() / (total / count);
        println!("light turned by {turn}: {:.2} % of the mean", 100.0 * error);
        assert!(error < 0.02, "turned by {turn}: {error}");
    }
}

#[test]
fn an_atlas_gives_every_place_of_every_surface_its_own_texel() {
    let stage = Stage::new(small_scene());
    let atlas = Atlas::new(&stage, 128, &[]).expect("a small scene");
    let (places, elements) = texels(&stage, &atlas);
    let unique: std::collections::BTreeSet<_> = places.iter().collect();
    assert_eq!(unique.len(), places.len(), "texels have one owner");
    let texel_of: std::collections::BTreeMap<_, _> = places.iter().zip(&elements).collect();
    let size = atlas.size as f32;
    let mut checked = 0;
    for (instance, charts) in (0..).zip(&atlas.instances) {
        let (positions, _) = stage.vertices(instance);
        let place = stage.pose.instances[instance as usize].world_from_local;
        let triangles = &stage.mesh(instance).triangles;
        assert_eq!(charts.triangles.len(), triangles.len());
        for (in_atlas, in_mesh) in charts.triangles.iter().zip(triangles) {
            let at = in_atlas.map(|v| charts.vertices[v as usize]);
            assert_eq!(at.map(|(vertex, _)| vertex), *in_mesh, "the same triangle");
            let uv = (at[0].1 + at[1].1 + at[2].1) / 3.0 * size;
            let middle = in_mesh.map(|v| place.transform_point3(positions[v as usize]));
            let middle = (middle[0] + middle[1] + middle[2]) / 3.0;
            let texel = uv.y as u32 * atlas.size + uv.x as u32;
            let element = texel_of.get(&texel).expect("a texel below every triangle");
            // Metres a texel, from the triangle's own.
            let edge = positions[in_mesh[0] as usize].distance(positions[in_mesh[1] as usize]);
            let texels = at[0].1.distance(at[1].1) * size;
            let distance = element.position.distance(middle);
            assert!(distance < 1.5 * edge / texels.max(1.0), "{distance} m off");
            checked += 1;
        }
    }
    assert!(checked > 100);
}

/// A floor that is placed once, and a box placed twice, once mirrored; in two buffers.
fn file(folder: &Path) -> PathBuf {
    let corners = [
        [-2.0f32, 0.0, -2.0],
        [-2.0, 0.0, 2.0],
        [2.0, 0.0, -2.0],
        [2.0, 0.0, 2.0],
    ];
    let floor: Vec<u8> = (corners
        .as_flattened()
        .iter()
        .chain(&[0.0, 1.0, 0.0].repeat(4)))
    .flat_map(|f| f.to_le_bytes())
    .chain([0u16, 1, 2, 2, 1, 3].into_iter().flat_map(u16::to_le_bytes))
    .collect();
    let cube: Vec<u8> = (0..8u8)
        .flat_map(|corner| [corner & 1, corner >> 1 & 1, corner >> 2])
        .flat_map(|side| (f32::from(side) - 0.5).to_le_bytes())
        .chain([
            0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4, 2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4,
            6, 1, 3, 5, 3, 7, 5,
        ])
        .collect();
    std::fs::write(folder.join("floor.bin"), &floor).expect("a folder");
    std::fs::write(folder.join("cube.bin"), &cube).expect("a folder");
    let json = json!({
        "asset": {"version": "2.0", "generator": "a test", "extras": {"kept": [1, 2.5, "x"]}},
        "extensionsUsed": ["X_unknown"],
        "extensions": {"X_unknown": {"anything": true}},
        "scene": 0,
        "scenes": [{"nodes": [0, 1, 2]}],
        "nodes": [
            {"mesh": 0, "name": "floor"},
            {"mesh": 1, "translation": [0.0, 0.5, 0.0]},
            {"mesh": 1, "translation": [1.0, 0.5, 0.0], "scale": [-1.0, 1.0, 1.0]},
        ],
        "materials": [{"name": "stone", "pbrMetallicRoughness": {"roughnessFactor": 0.7}}],
        "meshes": [
            {"primitives": [
                {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0},
            ]},
            {"name": "cube", "primitives": [{"attributes": {"POSITION": 3}, "indices": 4}]},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
             "min": [-2.0, 0.0, -2.0], "max": [2.0, 0.0, 2.0]},
            {"bufferView": 0, "byteOffset": 48, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC3",
             "min": [-0.5, -0.5, -0.5], "max": [0.5, 0.5, 0.5]},
            {"bufferView": 3, "componentType": 5121, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96, "byteStride": 12, "target": 34962},
            {"buffer": 0, "byteOffset": 96, "byteLength": 12, "target": 34963},
            {"buffer": 1, "byteLength": 96, "target": 34962},
            {"buffer": 1, "byteOffset": 96, "byteLength": 36, "target": 34963},
        ],
        "buffers": [
            {"byteLength": floor.len(), "uri": "floor.bin"},
            {"byteLength": cube.len(), "uri": "cube.bin"},
        ],
    });
    let path = folder.join("scene.gltf");
    std::fs::write(&path, json.to_string()).expect("a folder");
    path
}

#[derive(Parser)]
struct Words {
    #[command(flatten)]
    bake: BakeArgs,
}

fn args(scene: &Path, out: &Path, more: &[&str]) -> BakeArgs {
    let paths = [scene, Path::new("--out"), out].map(Path::as_os_str);
    let words = std::iter::once("bake".as_ref()).chain(paths);
    let words = words.chain(more.iter().map(std::ffi::OsStr::new));
    Words::try_parse_from(words).expect("these options").bake
}

/// Bakes the file above; what was written, as JSON.
fn baked(folder: &Path, more: &[&str]) -> (PathBuf, Value) {
    let out = folder.join("out.glb");
    let options = args(
        &file(folder),
        &out,
        &[&["--directions", "64"], more].concat(),
    );
    let report = run(&options, &|_, _, _| ()).expect("a sound scene");
    assert!(
        report
            .rows
            .iter()
            .all(|row| row.elements > 8 && row.rmse_255 < 8.0)
    );
    let bytes = std::fs::read(&out).expect("it was written");
    let length = u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
    let json = serde_json::from_slice(&bytes[20..20 + length]).expect("JSON");
    (out, json)
}

/// All that `old` says, `new` says too; lists may have become longer.
fn keeps(old: &Value, new: &Value, changes: &[&str], at: &str) {
    if changes.contains(&at) {
        return;
    }
    match (old, new) {
        (Value::Object(old), Value::Object(_)) => {
            for (key, value) in old {
                keeps(value, &new[key], changes, &format!("{at}/{key}"));
            }
        }
        (Value::Array(old), Value::Array(all)) => {
            assert!(all.len() >= old.len(), "{at} is shorter");
            for (i, (old, new)) in old.iter().zip(all).enumerate() {
                keeps(old, new, changes, &format!("{at}/{i}"));
            }
        }
        _ => assert_eq!(old, new, "{at}"),
    }
}

/// Attribute of a primitive as floats, by the gltf crate: a reader of its own.
fn floats(path: &Path, mesh: usize, name: &str) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("it was written");
    let file = gltf::Gltf::from_slice(&bytes).expect("a valid file");
    let mesh = file.meshes().nth(mesh).expect("the mesh");
    let primitive = mesh.primitives().next().expect("a primitive");
    let found = primitive
        .attributes()
        .find(|(semantic, _)| semantic.to_string() == name);
    let (_, accessor) = found.unwrap_or_else(|| panic!("mesh has no {name}"));
    let view = accessor.view().expect("data");
    let blob = file.blob.as_ref().expect("a binary chunk");
    let data = &blob[view.offset() + accessor.offset()..][..accessor.count() * accessor.size()];
    bytemuck::pod_collect_to_vec(data)
}

#[test]
fn a_file_keeps_all_it_had_and_each_placement_gets_its_own_occlusion() {
    let folder = tempfile::tempdir().expect("a folder");
    let (out, new) = baked(folder.path(), &[]);
    let old = std::fs::read(folder.path().join("scene.gltf")).expect("the input");
    let old: Value = serde_json::from_slice(&old).expect("JSON");
    let changes = [
        // Where data lies in the one buffer, and the second placement's own copy of its mesh.
        "/buffers",
        "/bufferViews/2/buffer",
        "/bufferViews/3/buffer",
        "/bufferViews/3/byteOffset",
        "/nodes/2/mesh",
    ];
    keeps(&old, &new, &changes, "");
    assert_eq!(new["meshes"].as_array().map(Vec::len), Some(3));

    let scene = |path: &Path| Scene::load(path, 1.0).expect("a sound file");
    let (before, after) = (scene(&folder.path().join("scene.gltf")), scene(&out));
    assert_eq!(before.instances.len(), after.instances.len());
    for (before, after) in before.instances.iter().zip(&after.instances) {
        let (a, b) = (&before.mesh, &after.mesh);
        assert_eq!(
            scene(&folder.path().join("scene.gltf")).meshes[*a as usize].positions,
            scene(&out).meshes[*b as usize].positions
        );
    }
    // Both boxes stand on the floor side by side: only the sides that touch are dark, and the
    // upper corners are open to each side.
    let (one, other) = (floats(&out, 1, "_OCCLUSION"), floats(&out, 2, "_OCCLUSION"));
    assert_eq!((one.len(), other.len()), (8, 8));
    assert_ne!(one, other, "each placement has its own");
    // The second is the first's mirror image about x = 0.5.
    for (a, b) in one.iter().zip(&other) {
        assert!((a - b).abs() < 0.1, "{one:?} {other:?}");
    }
    assert!(
        one[2] > one[0] && one[6] > one[4],
        "the floor darkens lower corners: {one:?}"
    );
}

#[test]
fn texture_occlusion_lies_over_texture_coordinates_of_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let (out, json) = baked(folder.path(), &["--to", "texture", "--size", "128"]);
    for mesh in json["meshes"].as_array().expect("meshes") {
        let primitive = &mesh["primitives"][0];
        let material = &json["materials"][primitive["material"].as_u64().expect("one") as usize];
        let set = material["occlusionTexture"]["texCoord"]
            .as_u64()
            .expect("a set");
        assert!(primitive["attributes"][format!("TEXCOORD_{set}")].is_u64());
    }
    let floor = &json["materials"][json["meshes"][0]["primitives"][0]["material"]
        .as_u64()
        .expect("one") as usize];
    assert_eq!(
        floor["name"], "stone",
        "the material's other properties stay"
    );
    let uvs: Vec<Vec2> = bytemuck::cast_slice(&floats(&out, 1, "TEXCOORD_0")).to_vec();
    assert!(uvs.len() > 8, "seams split vertices");
    assert!(
        uvs.iter()
            .all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0)
    );
    // The loader reads the same triangles from it.
    let [old, new] = [folder.path().join("scene.gltf"), out].map(|path| {
        let scene = Scene::load(&path, 1.0).expect("a sound file");
        let place = |instance: &Instance| {
            let mesh = &scene.meshes[instance.mesh as usize];
            let at = |v: &u32| mesh.positions[*v as usize];
            mesh.triangles
                .as_flattened()
                .iter()
                .map(at)
                .collect::<Vec<Vec3>>()
        };
        scene.instances.iter().map(place).collect::<Vec<_>>()
    });
    assert_eq!(old, new);
}

#[test]
fn a_baked_texture_baked_again_keeps_its_second_set_of_coordinates() {
    let folder = tempfile::tempdir().expect("a folder");
    let (once, _) = baked(folder.path(), &["--to", "texture", "--size", "128"]);
    let twice = folder.path().join("twice.glb");
    let more = ["--to", "texture", "--size", "128", "--directions", "16"];
    run(&args(&once, &twice, &more), &|_, _, _| ()).expect("a sound file");
    assert_eq!(
        floats(&once, 0, "TEXCOORD_0"),
        floats(&twice, 0, "TEXCOORD_0")
    );
    assert!(!floats(&twice, 0, "TEXCOORD_1").is_empty());
}

#[test]
fn points_and_harmonics_are_written_where_readers_find_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let (out, json) = baked(folder.path(), &["--to", "points", "--density", "20"]);
    let mesh =
        json["nodes"][json["nodes"][0]["children"][0].as_u64().expect("a child") as usize]["mesh"]
            .as_u64()
            .expect("points") as usize;
    let values = floats(&out, mesh, "_OCCLUSION");
    // 16 square metres of floor.
    assert!(
        (250..=390).contains(&values.len()),
        "{} points",
        values.len()
    );
    assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
    assert!(values.iter().any(|v| *v < 0.5) && values.iter().any(|v| *v > 0.9));

    let (out, _) = baked(folder.path(), &["--to", "sh"]);
    for part in 0..3 {
        assert_eq!(floats(&out, 1, &format!("_TRANSFER_{part}")).len(), 8 * 3);
    }
    let (out, _) = baked(folder.path(), &["--to", "sh", "--order", "2"]);
    assert_eq!(floats(&out, 1, "_TRANSFER_0").len(), 8 * 4);
}

#[test]
fn harmonics_in_textures_are_those_of_their_texels() {
    let folder = tempfile::tempdir().expect("a folder");
    let to = ["--to", "sh-texture", "--size", "64", "--directions", "256"];
    let (out, json) = baked(folder.path(), &to);
    let transfer = &json["materials"]
        .as_array()
        .expect("materials")
        .last()
        .expect("one")["extras"]["psaoTransfer"];
    assert_eq!(transfer["order"], 3);
    assert_eq!(transfer["textures"].as_array().map(Vec::len), Some(3));
    let stage = Stage::new(Scene::load(&folder.path().join("scene.gltf"), 1.0).expect("sound"));
    let (places, elements) = texels(&stage, &Atlas::new(&stage, 64, &[]).expect("a small scene"));
    let numbers = Numbers::Transfer(3);
    let expected = bake(&stage, &elements, numbers, ENDLESS, 256, &|_, _, _| ());
    let expected = expected.expect("a small scene").values;
    for part in 0..3 {
        let (texels, channels) = picture(&out, part);
        assert_eq!(channels, 3);
        for (place, expected) in places.iter().zip(expected.chunks(9)) {
            for channel in 0..3 {
                let at = (*place as usize * 3 + channel) * 2;
                let word = u16::from_be_bytes([texels[at], texels[at + 1]]);
                let value = f32::from(word) / 65535.0 * 2.0 - 1.0;
                let expected = expected[part * 3 + channel];
                assert!((value - expected).abs() < 1e-4, "{value}, not {expected}");
            }
        }
    }
}

/// A mesh alone as a glTF file.
fn mesh_file(folder: &Path, name: &str, mesh: &Mesh) -> PathBuf {
    let vertices: Vec<f32> = (mesh.positions.iter().chain(&mesh.normals))
        .flat_map(|v| v.to_array())
        .collect();
    let mut bytes: Vec<u8> = bytemuck::cast_slice(&vertices).to_vec();
    let (count, half) = (mesh.positions.len(), bytes.len() / 2);
    bytes.extend_from_slice(bytemuck::cast_slice(mesh.triangles.as_flattened()));
    let bound = |pick: fn(Vec3, Vec3) -> Vec3| {
        let all = mesh.positions.iter().copied();
        all.reduce(pick).expect("vertices").to_array()
    };
    let json = json!({
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3",
             "min": bound(Vec3::min), "max": bound(Vec3::max)},
            {"bufferView": 1, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5125, "count": mesh.triangles.len() * 3,
             "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": half},
            {"buffer": 0, "byteOffset": half, "byteLength": half},
            {"buffer": 0, "byteOffset": 2 * half, "byteLength": bytes.len() - 2 * half},
        ],
        "buffers": [{"byteLength": bytes.len(), "uri": format!("{name}.bin")}],
    });
    std::fs::write(folder.join(format!("{name}.bin")), bytes).expect("a folder");
    let path = folder.join(format!("{name}.gltf"));
    std::fs::write(&path, json.to_string()).expect("a folder");
    path
}

/// A picture of a written file, and its channels.
fn picture(path: &Path, image: usize) -> (Vec<u8>, usize) {
    let bytes = std::fs::read(path).expect("it was written");
    let file = gltf::Gltf::from_slice(&bytes).expect("a valid file");
    let image = file.images().nth(image).expect("the image");
    let gltf::image::Source::View { view, .. } = image.source() else {
        panic!("the image is elsewhere");
    };
    let blob = file.blob.as_ref().expect("a binary chunk");
    let png = std::io::Cursor::new(&blob[view.offset()..][..view.length()]);
    let mut reader = png::Decoder::new(png).read_info().expect("a PNG");
    let mut texels = vec![0; reader.output_buffer_size().expect("a small picture")];
    let info = reader.next_frame(&mut texels).expect("a PNG");
    (texels, info.color_type.samples())
}

/// Bakes one mesh onto another; what a viewer sees of it is compared with the detailed surface:
/// root mean square of the angle between normals, degrees, and of openness in 1/255.
/// `normal_at`: the detailed surface's normal at a place on it.
fn baked_onto(detailed: &Mesh, plain: &Mesh, normal_at: impl Fn(Vec3) -> Vec3) -> [f64; 2] {
    const SIZE: usize = 256;
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("out.glb");
    let high = mesh_file(folder.path(), "detailed", detailed);
    let low = mesh_file(folder.path(), "plain", plain);
    let low = low.to_str().expect("a plain name");
    let size = SIZE.to_string();
    let more = [
        "--onto",
        low,
        "--to",
        "texture",
        "--size",
        &size,
        "--cage",
        "0.2",
        "--directions",
        "128",
    ];
    let report = run(&args(&high, &out, &more), &|_, _, _| ()).expect("sound scenes");
    assert_eq!(report.notes, [""; 0], "every texel has its place");

    let three = |name: &str| -> Vec<Vec3> { bytemuck::pod_collect_to_vec(&floats(&out, 0, name)) };
    let (positions, normals) = (three("POSITION"), three("NORMAL"));
    let tangents: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&floats(&out, 0, "TANGENT"));
    let uvs: Vec<Vec2> = bytemuck::pod_collect_to_vec(&floats(&out, 0, "TEXCOORD_0"));
    let ((grey, 1), (colors, 3)) = (picture(&out, 0), picture(&out, 1)) else {
        panic!("a grey and a coloured picture");
    };
    let scene = Scene::load(&out, 1.0).expect("a sound file");
    let stage = alone(detailed.clone());
    let origin = stage.scene.origin.as_vec3();
    let tracer = stage.tracer().expect("a small scene");
    let step = (scene.meshes[0].triangles.len() / 400).max(1);
    let (mut angles, mut seen, mut elements) = (0.0, Vec::new(), Vec::new());
    // The loader splits no vertices of a file that has normals.
    for triangle in scene.meshes[0].triangles.iter().step_by(step) {
        for weights in [[0.6, 0.2, 0.2], [0.2, 0.3, 0.5]] {
            let corners = || triangle.iter().map(|v| *v as usize).zip(weights);
            let mean = |of: &[Vec3]| corners().map(|(v, w)| of[v] * w).sum::<Vec3>();
            // As a viewer's shader does.
            let normal = mean(&normals).normalize();
            let tangent = corners()
                .map(|(v, w)| Vec3::from_slice(&tangents[v]) * w)
                .sum::<Vec3>();
            let tangent = tangent.normalize();
            let bitangent = normal.cross(tangent) * tangents[triangle[0] as usize][3];
            let uv = corners().map(|(v, w)| uvs[v] * w).sum::<Vec2>() * SIZE as f32;
            let texel = uv.y as usize * SIZE + uv.x as usize;
            let map = |axis: usize| f32::from(colors[texel * 3 + axis]) / 127.5 - 1.0;
            let bumped = (tangent * map(0) + bitangent * map(1) + normal * map(2)).normalize();

            let from = mean(&positions) + normal * 0.2;
            let hit = tracer
                .closest(from - origin, -normal, 0.4)
                .expect("the detailed mesh");
            let place = from - normal * hit.t;
            let expected = normal_at(place);
            angles += f64::from(bumped.angle_between(expected).to_degrees()).powi(2);
            seen.push(f32::from(grey[texel]) / 255.0);
            elements.push(Element {
                position: place - origin,
                normal: expected,
                outward: expected,
                // The place has been rounded once more.
                reach: 64.0,
            });
        }
    }
    let reference = openness(&stage, &elements, ENDLESS, 4096);
    let angle = (angles / elements.len() as f64).sqrt();
    [angle, rmse_255(&seen, &reference)]
}

#[test]
fn waves_baked_onto_a_plane_look_as_the_waves_within_a_degree_and_two_percent() {
    let waves = |x: f32, z: f32| {
        let height = 0.1 * (4.0 * x).sin() * (3.0 * z).cos();
        let along = 0.4 * (4.0 * x).cos() * (3.0 * z).cos();
        let across = -0.3 * (4.0 * x).sin() * (3.0 * z).sin();
        (
            Vec3::new(x, height, z),
            Vec3::new(-along, 1.0, -across).normalize(),
        )
    };
    let (mut detailed, mut plain) = (Mesh::default(), Mesh::default());
    // Another extent than the plane's, and so another origin.
    sheet(&mut detailed, 200, |u, v| {
        waves(5.0 * v - 2.0, 4.0 * u - 2.0)
    });
    sheet(&mut plain, 2, |u, v| {
        (Vec3::new(3.9 * v - 1.95, 0.0, 3.9 * u - 1.95), Vec3::Y)
    });
    let [angle, occlusion] = baked_onto(&detailed, &plain, |place| waves(place.x, place.z).1);
    println!("waves: {angle} degrees, {occlusion}/255");
    assert!(
        angle < 1.0 && occlusion < 5.0,
        "{angle} degrees, {occlusion}/255"
    );
}

#[test]
fn a_bumpy_ball_baked_onto_a_round_one_looks_bumpy_within_a_degree_and_two_percent() {
    use std::f32::consts::{PI, TAU};
    // Bumps of a smooth function of space, so that no pole is special.
    let radius = |out: Vec3| 1.0 + 0.04 * (7.0 * out.x).sin() * (6.0 * out.y).cos();
    let slope = |out: Vec3| {
        let (x, y) = (7.0 * out.x, 6.0 * out.y);
        Vec3::new(0.28 * x.cos() * y.cos(), -0.24 * x.sin() * y.sin(), 0.0)
    };
    let normal = |out: Vec3| {
        let tangential = slope(out).reject_from_normalized(out);
        (out - tangential / radius(out)).normalize()
    };
    let ball = |mesh: &mut Mesh, steps: u32, bumpy: bool| {
        sheet(mesh, steps, |u, v| {
            let (across, around) = ((u * PI).sin(), v * TAU);
            let x = across * around.cos();
            let out = Vec3::new(x, (u * PI).cos(), -across * around.sin()).normalize();
            match bumpy {
                true => (out * radius(out), normal(out)),
                false => (out, out),
            }
        });
    };
    let (mut detailed, mut plain) = (Mesh::default(), Mesh::default());
    ball(&mut detailed, 256, true);
    ball(&mut plain, 24, false);
    let [angle, occlusion] = baked_onto(&detailed, &plain, |place| normal(place.normalize()));
    println!("ball: {angle} degrees, {occlusion}/255");
    assert!(
        angle < 1.0 && occlusion < 5.0,
        "{angle} degrees, {occlusion}/255"
    );
}

/// Runs a program to its end, which must be a success.
fn succeed(command: &mut Command) -> String {
    let output = command.output();
    let output = output.unwrap_or_else(|error| {
        panic!("{command:?}: {error}: install it with `apt-get install nodejs npm`")
    });
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (said, errors) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}:\n{said}{errors}");
    said
}

#[test]
fn khronos_validator_finds_no_error_in_what_is_written() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/gltf_validator");
    let installed = Path::new(env!("CARGO_TARGET_TMPDIR")).join("gltf_validator");
    std::fs::create_dir_all(&installed).expect("a folder");
    for name in ["package.json", "package-lock.json", "validate.js"] {
        std::fs::copy(source.join(name), installed.join(name)).expect("a file of ours");
    }
    // Does nothing where it is there already, and checks its hash where not.
    let install = ["install", "--no-audit", "--no-fund", "--prefer-offline"];
    succeed(Command::new("npm").args(install).current_dir(&installed));

    let folder = tempfile::tempdir().expect("a folder");
    let scene = file(folder.path());
    let onto = scene.to_str().expect("a plain name");
    let texture = ["--to", "texture", "--size", "64"];
    let detail = [&texture[..], &["--onto", onto]].concat();
    let harmonics = [
        &["--to", "sh-texture", "--size", "64", "--order", "4"][..],
        &["--to", "sh", "--order", "2"],
    ];
    let all = [
        &[][..],
        &texture,
        &detail,
        &["--to", "points", "--density", "20"],
    ];
    let written: Vec<PathBuf> = (0..)
        .zip(all.into_iter().chain(harmonics))
        .map(|(number, more)| {
            let out = folder.path().join(format!("{number}.glb"));
            let more = [&["--directions", "4"], more].concat();
            run(&args(&scene, &out, &more), &|_, _, _| ()).expect("a sound scene");
            out
        })
        .collect();
    let validate = |files: &[PathBuf]| {
        let mut command = Command::new("node");
        command
            .arg("validate.js")
            .args(files)
            .current_dir(&installed);
        command
    };
    let said = succeed(&mut validate(&written));
    assert!(said.contains("6 files of glTF 2.0"), "{said}");
    // It does look: a file with a hole in it is refused.
    let broken = folder.path().join("broken.gltf");
    let text = std::fs::read_to_string(&scene).expect("the scene");
    let text = text.replace("\"bufferView\":3", "\"bufferView\":33");
    std::fs::write(&broken, text).expect("a folder");
    let output = validate(&[broken]).output().expect("it ran before");
    assert!(!output.status.success(), "{output:?}");
}

#[test]
fn bad_input_gives_an_error_that_names_it_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = file(folder.path());
    let out = folder.path().join("out.glb");
    let refused = |scene: &Path, more: &[&str], named: &str| {
        let error = run(&args(scene, &out, more), &|_, _, _| ()).expect_err(named);
        assert!(error.contains(named), "{error}");
        assert!(!out.exists() && !out.with_extension("png").exists());
    };
    refused(&scene, &["--directions", "0"], "--directions");
    refused(&scene, &["--directions", "5000"], "4096");
    refused(&scene, &["--ao-distance=-1"], "--ao-distance");
    refused(&scene, &["--ao-distance", "NaN"], "--ao-distance");
    refused(
        &scene,
        &["--method", "depth", "--ao-distance", "1"],
        "--method rays",
    );
    refused(
        &scene,
        &["--method", "depth", "--resolution", "0"],
        "--resolution",
    );
    refused(&scene, &["--to", "texture", "--size", "1"], "16 to");
    refused(&scene, &["--to", "points", "--density=-1"], "--density");
    let onto = scene.to_str().expect("a plain name").to_string();
    refused(&scene, &["--onto", &onto], "--to texture");
    refused(&scene, &["--cage", "1"], "--onto");
    let texture = ["--onto", &onto, "--to", "texture", "--size", "64", "--cage"];
    refused(&scene, &[&texture[..], &["0"]].concat(), "--cage");
    let mut far = Mesh::default();
    sheet(&mut far, 1, |u, v| (Vec3::new(u, 90.0, v), Vec3::NEG_Y));
    let far = mesh_file(folder.path(), "far", &far);
    refused(&far, &[&texture[..], &["1"]].concat(), "--cage");
    refused(&folder.path().join("none.glb"), &[], "none.glb");
    let cut = folder.path().join("cut.gltf");
    std::fs::write(&cut, "{").expect("a folder");
    refused(&cut, &[], "cut.gltf");
    let wrong = args(&scene, &folder.path().join("out.gltf"), &[]);
    let error = run(&wrong, &|_, _, _| ()).expect_err("not a .glb");
    assert!(error.contains(".glb"), "{error}");
}

#[cfg(feature = "gpu")]
mod gpu {
    use super::*;
    use psao_server::bake::DepthMaps;

    const MAPS: DepthMaps = DepthMaps {
        resolution: 512,
        bias: 0.004,
        readback_every: 0,
    };

    #[test]
    fn depth_maps_see_what_rays_see() {
        // Skinned, morphed and double-sided instances, all mirrored.
        let mut scene = small_scene();
        let mirror = glam::DAffine3::from_scale(glam::DVec3::new(-1.0, 1.0, 1.0));
        scene.transform(mirror);
        for stage in [Stage::new(scene), smooth()] {
            let elements = elements(&stage);
            let rays = openness(&stage, &elements, ENDLESS, 1024);
            let error = |k| rmse_255(&openness(&stage, &elements, Method::Depth(MAPS), k), &rays);
            let [coarse, fine] = [16, 128].map(error);
            println!("rmse {coarse} with 16 depth maps, {fine} with 128");
            // At 512 directions it is below 5; there are tables in docs/bake.md.
            assert!(fine < 6.0 && coarse > 2.0 * fine, "{coarse}, {fine}");
        }
    }

    #[test]
    fn light_falls_through_the_holes_of_a_mask() {
        let mut scene = small_scene::still_scene();
        let open = openness(
            &Stage::new(scene.clone()),
            &elements(&Stage::new(scene.clone())),
            Method::Depth(MAPS),
            64,
        );
        // The box becomes a hole.
        let mesh = &mut scene.meshes[1];
        mesh.uvs = vec![Vec2::ZERO; mesh.positions.len()];
        mesh.mask = Some(psao_server::scene::Mask {
            width: 1,
            height: 1,
            alpha: vec![0],
            cutoff: 0.5,
            wrap: [psao_server::scene::Wrap::Repeat; 2],
        });
        let stage = Stage::new(scene);
        let floor = vertices(&stage, 0, 0.0);
        let masked = openness(&stage, &floor, Method::Depth(MAPS), 64);
        assert!(masked.iter().all(|v| *v > 0.999), "{masked:?}");
        assert!(open[..floor.len()].iter().any(|v| *v < 0.9), "{open:?}");
    }

    #[test]
    fn reading_back_less_often_changes_no_value() {
        let stage = Stage::new(small_scene());
        let elements = elements(&stage);
        let quiet = &|_: &str, _, _| ();
        let bake_with = |readback_every| {
            let maps = Method::Depth(DepthMaps {
                resolution: 128,
                readback_every,
                ..MAPS
            });
            let baked = bake(&stage, &elements, Numbers::Transfer(3), maps, 20, quiet);
            baked.expect("a small scene")
        };
        let once = bake_with(0);
        assert_eq!(once.readbacks, 1);
        for (every, readbacks) in [(1, 20), (16, 2)] {
            let often = bake_with(every);
            assert_eq!(often.readbacks, readbacks);
            let pairs = often.values.iter().zip(&once.values);
            assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-5));
        }
    }
}
