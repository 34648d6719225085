//! A scene of a few square metres with one of everything: what stands, what rolls by it, what
//! bends, and what a client may move. Shared by tests of several packages.

use glam::{DVec3, Mat4, Quat, Vec3};
use psao_server::scene::{
    Animation, Channel, Instance, Interpolation, Keys, LocalTransform, Mesh, Morph, Node, Scene,
    Skin,
};

/// A floor of 3 x 3 m around the world's (50, 0, 0).
pub const FLOOR: u32 = 0;
/// A box of 0.4 m that stands on it.
pub const STILL: u32 = 1;
/// A box of 0.3 m that turns and passes by the other, in 4 s.
pub const MOVER: u32 = 2;
/// A sheet of 0.8 x 0.8 m that bulges by 0.5 m and back, in 2 s.
pub const SHEET: u32 = 3;
/// A post of 0.2 x 0.8 m whose upper joint sways, in 3 s.
pub const POST: u32 = 4;

/// The floor and the box that stands: nothing moves.
pub fn still_scene() -> Scene {
    let mut scene = Scene {
        name: "small".into(),
        ..Scene::default()
    };
    place(&mut scene, plane("floor", 3.0, 4), [0.0, 0.0, 0.0]);
    place(
        &mut scene,
        cuboid("still", Vec3::splat(0.4), 1),
        [0.0, 0.2, 0.0],
    );
    scene.set_origin();
    scene
}

/// All of it.
pub fn small_scene() -> Scene {
    let mut scene = still_scene();
    let mover = place(&mut scene, cuboid("mover", Vec3::splat(0.3), 1), [0.0; 3]);
    scene.instances[MOVER as usize].moves = true;
    let at = |x: f32, z| Vec3::new(50.0 + x, 0.25, z);
    let corners = vec![at(-1.2, 0.5), at(0.3, 0.6), at(1.1, -0.4), at(-1.2, 0.5)];
    let turns =
        [0.0, 1.1, 2.5, 0.0].map(|angle| Quat::from_axis_angle(Vec3::ONE.normalize(), angle));
    let times = vec![0.0, 1.0, 2.5, 4.0];
    animate(&mut scene, mover, times.clone(), Keys::Translation(corners));
    animate(&mut scene, mover, times, Keys::Rotation(turns.to_vec()));

    let mut sheet = plane("sheet", 0.8, 8);
    sheet.double_sided = true;
    let bulge = |p: &Vec3| {
        let round = (1.0 - (p.x * p.x + p.z * p.z) / 0.32).max(0.0);
        Vec3::Y * 0.5 * round
    };
    let slope = |p: &Vec3| match bulge(p).y > 0.0 {
        true => Vec3::new(p.x / 0.32, 1.0, p.z / 0.32).normalize() - Vec3::Y,
        false => Vec3::ZERO,
    };
    sheet.morphs.push(Morph {
        positions: sheet.positions.iter().map(bulge).collect(),
        normals: sheet.positions.iter().map(slope).collect(),
    });
    let sheet = place(&mut scene, sheet, [-0.8, 0.3, -0.8]);
    scene.nodes[sheet as usize].morph_weights = vec![0.0];
    scene.instances[SHEET as usize].deforms = true;
    let weights = vec![0.0, 1.0, 0.0];
    let keys = Keys::MorphWeights { count: 1, weights };
    animate(&mut scene, sheet, vec![0.0, 1.0, 2.0], keys);

    let mut post = cuboid("post", Vec3::new(0.2, 0.8, 0.2), 6);
    for position in &post.positions {
        let upper = ((position.y + 0.4) / 0.8).clamp(0.0, 1.0);
        post.joints.push([0, 1, 0, 0]);
        post.weights.push([1.0 - upper, upper, 0.0, 0.0]);
    }
    let post = place(&mut scene, post, [0.8, 0.4, 0.8]);
    let lower = node(&mut scene, None, [0.8, 0.4, 0.8]);
    let upper = node(&mut scene, Some(lower), [-50.0, 0.0, 0.0]);
    scene.skins.push(Skin {
        joints: vec![lower, upper],
        inverse_bind: vec![Mat4::IDENTITY; 2],
    });
    scene.instances[POST as usize].skin = Some(0);
    scene.instances[POST as usize].deforms = true;
    debug_assert_eq!(scene.instances[POST as usize].node, post);
    let sways = [0.0, 0.4, -0.3, 0.0].map(Quat::from_rotation_z);
    let keys = Keys::Rotation(sways.to_vec());
    animate(&mut scene, upper, vec![0.0, 1.0, 2.0, 3.0], keys);
    scene.set_origin();
    scene
}

fn node(scene: &mut Scene, parent: Option<u32>, at: [f64; 3]) -> u32 {
    let local = LocalTransform::Trs {
        translation: DVec3::from(at) + DVec3::X * 50.0,
        rotation: Quat::IDENTITY,
        scale: Vec3::ONE,
    };
    scene.nodes.push(Node {
        name: "node".into(),
        parent,
        local,
        morph_weights: Vec::new(),
    });
    scene.nodes.len() as u32 - 1
}

fn place(scene: &mut Scene, mesh: Mesh, at: [f64; 3]) -> u32 {
    let node = node(scene, None, at);
    scene.instances.push(Instance {
        name: mesh.name.clone(),
        mesh: scene.meshes.len() as u32,
        node,
        skin: None,
        moves: false,
        deforms: false,
    });
    scene.meshes.push(mesh);
    node
}

fn animate(scene: &mut Scene, node: u32, times: Vec<f32>, values: Keys) {
    scene.animations.push(Animation {
        name: "animation".into(),
        duration_s: times[times.len() - 1],
        channels: vec![Channel {
            node,
            times,
            interpolation: Interpolation::Linear,
            values,
        }],
    });
}

/// A square that faces up, of `steps` x `steps` squares.
fn plane(name: &str, size: f32, steps: u32) -> Mesh {
    let mut mesh = Mesh {
        name: name.into(),
        ..Mesh::default()
    };
    let at = |i: u32| (i as f32 / steps as f32 - 0.5) * size;
    patch(
        &mut mesh,
        steps,
        |u, v| Vec3::new(at(v), 0.0, at(u)),
        Vec3::Y,
    );
    mesh
}

/// A box around the origin, its sides of `steps` x `steps` rectangles.
fn cuboid(name: &str, size: Vec3, steps: u32) -> Mesh {
    let mut mesh = Mesh {
        name: name.into(),
        ..Mesh::default()
    };
    let at = |i: u32| i as f32 / steps as f32 - 0.5;
    for normal in [Vec3::X, Vec3::Y, Vec3::Z] {
        for side in [normal, -normal] {
            let along = Vec3::new(side.y, side.z, side.x);
            let across = side.cross(along);
            let corner = |u: u32, v: u32| (side * 0.5 + along * at(u) + across * at(v)) * size;
            patch(&mut mesh, steps, corner, side);
        }
    }
    mesh
}

fn patch(mesh: &mut Mesh, steps: u32, at: impl Fn(u32, u32) -> Vec3, normal: Vec3) {
    let first = mesh.positions.len() as u32;
    for u in 0..=steps {
        for v in 0..=steps {
            mesh.positions.push(at(u, v));
            mesh.normals.push(normal);
        }
    }
    for u in 0..steps {
        for v in 0..steps {
            let corner = first + u * (steps + 1) + v;
            let next = corner + steps + 1;
            mesh.triangles.push([corner, next, corner + 1]);
            mesh.triangles.push([corner + 1, next, next + 1]);
        }
    }
}
