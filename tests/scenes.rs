//! Scenes that tests build of parallelograms.

use glam::{DVec3, Quat, Vec3};
use psao_server::scene::{Instance, LocalTransform, Mesh, Node, Scene};

/// Adds a mesh where it was made.
pub fn place(scene: &mut Scene, mesh: Mesh) {
    let node = scene.nodes.len() as u32;
    scene.nodes.push(Node {
        name: mesh.name.clone(),
        parent: None,
        local: LocalTransform::Trs {
            translation: DVec3::ZERO,
            rotation: Quat::IDENTITY,
            scale: Vec3::ONE,
        },
        morph_weights: Vec::new(),
    });
    scene.instances.push(Instance {
        name: mesh.name.clone(),
        mesh: scene.meshes.len() as u32,
        node,
        skin: None,
        moves: false,
        deforms: false,
    });
    scene.meshes.push(mesh);
}

/// A parallelogram that faces `u` × `v`.
pub fn quad(mesh: &mut Mesh, corner: Vec3, u: Vec3, v: Vec3) {
    let first = mesh.positions.len() as u32;
    mesh.positions
        .extend([corner, corner + u, corner + v, corner + u + v]);
    mesh.normals.extend([u.cross(v).normalize(); 4]);
    mesh.triangles.push([first, first + 1, first + 2]);
    mesh.triangles.push([first + 1, first + 3, first + 2]);
}

/// An empty mesh.
pub fn mesh(name: &str, double_sided: bool) -> Mesh {
    Mesh {
        name: name.into(),
        double_sided,
        ..Mesh::default()
    }
}
