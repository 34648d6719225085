use glam::{DVec3, Mat3, Quat, Vec2, Vec3, vec3};

use super::*;
use crate::samples::Samples;
use crate::scene::{Instance, InstancePose};

/// Numbers that look random, the same each run.
struct Random(u32);

impl Random {
    /// Within 0..1.
    fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let x = ((self.0 >> ((self.0 >> 28) + 4)) ^ self.0).wrapping_mul(277_803_737);
        (((x >> 22) ^ x) >> 8) as f32 / (1 << 24) as f32
    }

    /// Within a cube of half size 1.
    fn cube(&mut self) -> Vec3 {
        vec3(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
    }

    fn direction(&mut self) -> Vec3 {
        (self.cube() + vec3(1e-3, 0.0, 0.0)).normalize()
    }

    fn soup(&mut self, triangles: usize, size: f32) -> Mesh {
        let mut mesh = Mesh::default();
        for i in 0..triangles as u32 {
            let centre = self.cube();
            for _ in 0..3 {
                mesh.positions.push(centre + self.cube() * size);
                mesh.uvs
                    .push(Vec2::new(self.unit(), self.unit()) * 4.0 - 2.0);
            }
            mesh.triangles.push([3 * i, 3 * i + 1, 3 * i + 2]);
        }
        mesh
    }
}

fn place(scene: &mut Scene, pose: &mut Pose, mesh: u32, world_from_local: Affine3A, deforms: bool) {
    let instance = Instance {
        name: String::new(),
        mesh,
        node: 0,
        skin: None,
        moves: false,
        deforms,
    };
    scene.instances.push(instance);
    pose.instances.push(InstancePose {
        world_from_local,
        ..Default::default()
    });
}

/// Rotated, mirrored, stretched and sheared matrices, and one that does nothing.
fn matrices(random: &mut Random) -> Vec<Affine3A> {
    let shear = Mat3::from_cols(
        vec3(1.0, 0.2, 0.0),
        vec3(0.7, 1.1, 0.0),
        vec3(-0.4, 0.3, 0.6),
    );
    [
        Affine3A::IDENTITY,
        Affine3A::from_quat(Quat::from_rotation_y(0.7)),
        Affine3A::from_scale(vec3(-1.0, 1.0, 1.0)),
        Affine3A::from_scale(vec3(0.1, 3.0, 1.5)),
        Affine3A::from_mat3(shear),
        Affine3A::from_mat3(shear * Mat3::from_diagonal(vec3(1.0, -2.0, 1.0))),
    ]
    .into_iter()
    .map(|m| Affine3A::from_translation(random.cube()) * m)
    .collect()
}

/// Six instances of a soup (three of them static, one deforming), half of them masked.
fn mixture() -> (Scene, Pose, Vec<Deformed>, Vec<bool>) {
    let mut random = Random(1);
    let mut scene = Scene::default();
    let mut pose = Pose::default();
    scene.meshes.push(random.soup(150, 0.3));
    scene.meshes.push(random.soup(150, 0.3));
    scene.meshes[1].mask = Some(Mask {
        width: 7,
        height: 5,
        alpha: (0..35).map(|_| (random.unit() * 255.0) as u8).collect(),
        cutoff: 0.5,
        wrap: [Wrap::Repeat, Wrap::Mirror],
    });
    for (i, m) in matrices(&mut random).into_iter().enumerate() {
        for mesh in 0..2 {
            place(&mut scene, &mut pose, mesh, m, i == 4);
        }
    }
    let moves = (0..scene.instances.len())
        .map(|i| i % 4 > 1 || i / 2 == 4)
        .collect();
    let deformed = deform(&scene, &mut random);
    (scene, pose, deformed, moves)
}

fn deform(scene: &Scene, random: &mut Random) -> Vec<Deformed> {
    let deforming = scene
        .instances
        .iter()
        .enumerate()
        .filter(|(_, i)| i.deforms);
    let moved = |(i, instance): (usize, &Instance)| {
        let rest = &scene.meshes[instance.mesh as usize].positions;
        let positions = rest
            .iter()
            .map(|p| *p * 1.3 + random.cube() * 0.3)
            .collect();
        Deformed {
            instance: i as u32,
            positions,
            normals: Vec::new(),
        }
    };
    deforming.map(moved).collect()
}

/// The slow and obvious tracer: all hits of a ray, in `f64`, nearest first, each with how far it
/// is from the nearest edge of its triangle or texel (where the other may decide differently).
struct Obvious {
    triangles: Vec<(u32, u32, [DVec3; 3], [Vec2; 3])>,
}

struct Found {
    instance: u32,
    triangle: u32,
    t: f64,
    hole: bool,
    /// Nothing near decides it.
    sure: bool,
}

impl Obvious {
    fn new(scene: &Scene, pose: &Pose, deformed: &[Deformed]) -> Obvious {
        let mut triangles = Vec::new();
        for (i, instance) in scene.instances.iter().enumerate() {
            let mesh = &scene.meshes[instance.mesh as usize];
            let deformed = deformed.iter().find(|d| d.instance as usize == i);
            let positions = deformed.map_or(&mesh.positions, |d| &d.positions);
            let m = pose.instances[i].world_from_local;
            let columns = [
                m.matrix3.x_axis,
                m.matrix3.y_axis,
                m.matrix3.z_axis,
                m.translation,
            ];
            let [x, y, z, t] = columns.map(|c| c.as_dvec3());
            for (n, triangle) in mesh.triangles.iter().enumerate() {
                let world = triangle.map(|v| {
                    let p = positions[v as usize].as_dvec3();
                    x * p.x + y * p.y + z * p.z + t
                });
                let uvs = triangle.map(|v| mesh.uvs.get(v as usize).copied().unwrap_or_default());
                triangles.push((i as u32, n as u32, world, uvs));
            }
        }
        Obvious { triangles }
    }

    fn hits(&self, scene: &Scene, origin: Vec3, direction: Vec3) -> Vec<Found> {
        let (o, d) = (origin.as_dvec3(), direction.as_dvec3());
        let mut found = Vec::new();
        for (instance, triangle, [a, b, c], uvs) in &self.triangles {
            let (e1, e2) = (*b - *a, *c - *a);
            let normal = e1.cross(e2);
            let t = normal.dot(*a - o) / normal.dot(d);
            let p = o + d * t - *a;
            let u = p.cross(e2).dot(normal) / normal.length_squared();
            let v = e1.cross(p).dot(normal) / normal.length_squared();
            let inside = u.min(v).min(1.0 - u - v);
            if inside.is_nan() || inside < -1e-3 {
                continue;
            }
            let grazing = (normal.dot(d) / normal.length()).abs() < 1e-3;
            let mut found_one = Found {
                instance: *instance,
                triangle: *triangle,
                t,
                hole: false,
                sure: inside > 1e-3 && !grazing && t.abs() > 1e-4,
            };
            let mesh = &scene.meshes[scene.instances[*instance as usize].mesh as usize];
            if let Some(mask) = &mesh.mask {
                let at = uvs[0].as_dvec2() * (1.0 - u - v)
                    + uvs[1].as_dvec2() * u
                    + uvs[2].as_dvec2() * v;
                // Repeats along x, and mirrors along y.
                let x = at.x.rem_euclid(1.0) * 7.0;
                let y = at.y.rem_euclid(2.0);
                let y = if y > 1.0 { 2.0 - y } else { y } * 5.0;
                let texel = mask.alpha[(y as usize).min(4) * 7 + (x as usize).min(6)];
                found_one.hole = f64::from(texel) / 255.0 < f64::from(mask.cutoff);
                found_one.sure &= (x - x.round()).abs() > 1e-3 && (y - y.round()).abs() > 1e-3;
            }
            found.push(found_one);
        }
        found.sort_by(|a, b| a.t.total_cmp(&b.t));
        found
    }
}

fn one(tracer: &CpuTracer, against: Against, origin: Vec3, direction: Vec3, t_max: f32) -> bool {
    let mut hit = [0];
    tracer.occluded(against, origin, &[direction], t_max, &[1], &mut hit);
    hit[0] == 1
}

/// Compares with [`Obvious`] over random rays; returns how many hit and how many missed.
fn compare(
    scene: &Scene,
    pose: &Pose,
    deformed: &[Deformed],
    moves: &[bool],
    tracer: &CpuTracer,
) -> (usize, usize) {
    let obvious = Obvious::new(scene, pose, deformed);
    let mut random = Random(9);
    let (mut hits, mut misses) = (0, 0);
    for _ in 0..1500 {
        let (origin, direction) = (random.cube() * 2.0, random.direction());
        let t_max = 0.1 + random.unit() * 2.0;
        let found = obvious.hits(scene, origin, direction);
        let in_range = |f: &&Found| f.t > 0.0 && f.t < f64::from(t_max);
        let groups = [
            (Against::All, None),
            (Against::Static, None),
            (Against::Movers, None),
            (Against::Instance(3), Some(3)),
            (Against::Instance(4), Some(4)),
            (Against::AllExcept(3), Some(3)),
            (Against::AllExcept(4), Some(4)),
        ];
        for (against, named) in groups {
            let belongs = |f: &&Found| match against {
                Against::All => true,
                Against::Static => !moves[f.instance as usize],
                Against::Movers => moves[f.instance as usize],
                Against::Instance(_) => Some(f.instance) == named,
                Against::AllExcept(_) => Some(f.instance) != named,
            };
            let end = f64::from(t_max);
            if found
                .iter()
                .filter(belongs)
                .any(|f| !f.sure || (f.t - end).abs() < 1e-4)
            {
                continue;
            }
            let expected = found
                .iter()
                .filter(belongs)
                .filter(in_range)
                .any(|f| !f.hole);
            let got = one(tracer, against, origin, direction, t_max);
            assert_eq!(got, expected, "{against:?} {origin} {direction} {t_max}");
            if got { hits += 1 } else { misses += 1 }
        }
        if found.iter().all(|f| f.sure) {
            let expected = found.iter().find(|f| f.t > 0.0 && !f.hole);
            let got = tracer.closest(origin, direction, f32::INFINITY);
            let names = |instance, triangle| (instance, triangle);
            assert_eq!(
                got.map(|h| names(h.instance, h.triangle)),
                expected.map(|f| names(f.instance, f.triangle)),
            );
            if let (Some(got), Some(expected)) = (got, expected) {
                assert!((f64::from(got.t) - expected.t).abs() < 1e-4 * (1.0 + expected.t));
                let m = &pose.instances[got.instance as usize].world_from_local;
                let mesh = &scene.meshes[scene.instances[got.instance as usize].mesh as usize];
                let deformed = deformed.iter().find(|d| d.instance == got.instance);
                let positions = deformed.map_or(&mesh.positions, |d| &d.positions);
                let [a, b, c] =
                    mesh.triangles[got.triangle as usize].map(|v| positions[v as usize]);
                let local = a * (1.0 - got.u - got.v) + b * got.u + c * got.v;
                let at = origin + direction * got.t;
                assert!(
                    m.transform_point3(local).distance(at) < 1e-3,
                    "weights name the place"
                );
            }
        }
    }
    (hits, misses)
}

#[test]
fn hits_are_those_of_the_obvious_tracer_for_any_matrix_group_and_mask() {
    let (scene, pose, deformed, moves) = mixture();
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let (hits, misses) = compare(&scene, &pose, &deformed, &moves, &tracer);
    assert!(
        hits > 1500 && misses > 1500,
        "{hits} hits, {misses} misses: too few to tell"
    );
}

#[test]
fn after_an_update_hits_are_where_movers_went_and_how_they_deformed() {
    let (scene, mut pose, deformed, moves) = mixture();
    let mut tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let mut random = Random(5);
    let turn = Affine3A::from_quat(Quat::from_euler(glam::EulerRot::XYZ, 1.0, 0.3, -0.5));
    for i in (0..moves.len()).filter(|i| moves[*i]) {
        pose.instances[i].world_from_local = turn * pose.instances[i].world_from_local;
    }
    let deformed = deform(&scene, &mut random);
    tracer.update(&scene, &pose, &deformed);
    let (hits, misses) = compare(&scene, &pose, &deformed, &moves, &tracer);
    assert!(
        hits > 1500 && misses > 1500,
        "{hits} hits, {misses} misses: too few to tell"
    );
}

#[test]
fn moving_everything_or_nothing_gives_the_same_answers() {
    let (scene, pose, deformed, moves) = mixture();
    let still = vec![false; moves.len()];
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &still).unwrap();
    compare(&scene, &pose, &deformed, &still, &tracer);
    let all = vec![true; moves.len()];
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &all).unwrap();
    compare(&scene, &pose, &deformed, &all, &tracer);
}

#[test]
fn groups_partition_the_scene_and_only_bits_asked_for_change() {
    let (scene, pose, deformed, moves) = mixture();
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let samples = Samples::new(256);
    let mut random = Random(3);
    let mut directions = [Vec3::ZERO; 200];
    for point in 0..200 {
        let origin = random.cube() * 1.5;
        samples.directions(point, random.direction(), Vec3::X, &mut directions);
        let ask = |against, todo: &[u64; 4]| {
            let mut hit = [0; 4];
            tracer.occluded(against, origin, &directions, 0.8, todo, &mut hit);
            hit
        };
        let or = |a: [u64; 4], b: [u64; 4]| std::array::from_fn::<u64, 4, _>(|i| a[i] | b[i]);
        let all = ask(Against::All, &[!0; 4]);
        assert_eq!(all[3] >> 8, 0, "no ray past the directions");
        let full = [!0; 4];
        assert_eq!(
            all,
            or(ask(Against::Static, &full), ask(Against::Movers, &full))
        );
        for i in 0..moves.len() as u32 + 1 {
            let parts = or(
                ask(Against::Instance(i), &full),
                ask(Against::AllExcept(i), &full),
            );
            assert_eq!(all, parts, "instance {i}");
        }
        let some = [0x1234_5678_9abc_def0, 0, !0, 0xff];
        let expected: [u64; 4] = std::array::from_fn(|i| all[i] & some[i]);
        assert_eq!(ask(Against::All, &some), expected);
        // Across groups, hits gather.
        let mut gathered = [0; 4];
        for against in [Against::Static, Against::Movers] {
            tracer.occluded(against, origin, &directions, 0.8, &full, &mut gathered);
        }
        assert_eq!(gathered, all);
    }
}

/// A jittered grid of triangles over `place(x, y)` for x and y within 0..1.
fn tessellated(random: &mut Random, cells: u32, place: impl Fn(f32, f32) -> Vec3) -> Mesh {
    let mut mesh = Mesh::default();
    for y in 0..=cells {
        for x in 0..=cells {
            let inner = |i: u32| i > 0 && i < cells;
            let jitter = |i, r: f32| if inner(i) { r * 0.6 - 0.3 } else { 0.0 };
            let (jx, jy) = (jitter(x, random.unit()), jitter(y, random.unit()));
            mesh.positions.push(place(
                (x as f32 + jx) / cells as f32,
                (y as f32 + jy) / cells as f32,
            ));
        }
    }
    for y in 0..cells {
        for x in 0..cells {
            let a = y * (cells + 1) + x;
            let c = a + cells + 1;
            mesh.triangles.extend([[a, a + 1, c], [a + 1, c + 1, c]]);
        }
    }
    mesh
}

/// Traces 64 rays from each of `points` random places of the one instance, on the side that
/// `normal` is on; returns rays and hits.
fn from_surface(
    scene: &Scene,
    pose: &Pose,
    moves: bool,
    points: u32,
    t_max: f32,
    towards: impl Fn(Vec3, Vec3) -> Vec3,
) -> (u32, u32) {
    let tracer = CpuTracer::new(scene, pose, &[], &[moves]).unwrap();
    let samples = Samples::new(64);
    let mut random = Random(77);
    let mesh = &scene.meshes[0];
    let m = &pose.instances[0].world_from_local;
    let mut hits = 0;
    let mut directions = [Vec3::ZERO; 64];
    for point in 0..points {
        let triangle = mesh.triangles[(random.unit() * mesh.triangles.len() as f32) as usize];
        let local = triangle.map(|v| mesh.positions[v as usize]);
        let [a, b, c] = local.map(|p| m.transform_point3(p));
        let (u, v) = (random.unit(), random.unit());
        let (u, v) = if u + v > 1.0 {
            (1.0 - u, 1.0 - v)
        } else {
            (u, v)
        };
        let position = a + (b - a) * u + (c - a) * v;
        let normal = towards(position, (b - a).cross(c - a).normalize());
        let extent = local[0].abs().max(local[1].abs()).max(local[2].abs());
        let origin = offset_origin(position, normal, reach(m, extent));
        samples.directions(point, normal, b - a, &mut directions);
        let mut hit = [0];
        tracer.occluded(Against::All, origin, &directions, t_max, &[!0], &mut hit);
        hits += hit[0].count_ones();
    }
    (points * 64, hits)
}

#[test]
fn a_flat_surface_never_occludes_itself_at_any_scale_or_place() {
    for (n, scale) in [1e-3f32, 1.0, 1e3].into_iter().enumerate() {
        for (k, away) in [0.0, 3.0, 1000.0].into_iter().enumerate() {
            let mut random = Random((10 * n + k) as u32);
            let (x, y) = (random.direction(), random.direction());
            let y = (y - x * x.dot(y)).normalize();
            let shift = random.direction() * away * scale;
            let plane = |u: f32, v: f32| (x * (u - 0.5) + y * (v - 0.5)) * 20.0 * scale + shift;
            let mut scene = Scene::default();
            let mut pose = Pose::default();
            // Coarse triangles are the hard ones: their corners are far from the rays.
            scene
                .meshes
                .push(tessellated(&mut random, [2, 9, 60][n], plane));
            place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
            for moves in [false, true] {
                for side in [1.0, -1.0] {
                    let (_, hits) =
                        from_surface(&scene, &pose, moves, 2000, 0.6 * scale, |_, n| n * side);
                    assert_eq!(hits, 0, "scale {scale}, {away} away, moves {moves}");
                }
            }
            // Placed back to the origin: now local coordinates are the coarse ones.
            let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.4, 1.2, -0.7);
            pose.instances[0].world_from_local =
                Affine3A::from_scale_rotation_translation(vec3(0.5, -2.0, 1.0), turn, Vec3::ZERO)
                    * Affine3A::from_translation(-shift);
            for moves in [false, true] {
                let (_, hits) = from_surface(&scene, &pose, moves, 2000, 0.6 * scale, |_, n| n);
                assert_eq!(hits, 0, "scale {scale}, {away} away, placed, moves {moves}");
            }
        }
    }
}

#[test]
fn no_ray_leaves_a_closed_sphere_at_any_scale() {
    for scale in [1e-3f32, 1.0, 1e3] {
        let mut random = Random(4);
        let sphere = |u: f32, v: f32| {
            let (u, v) = (u * std::f32::consts::TAU, v * std::f32::consts::PI);
            // The seam and the poles have to close exactly.
            let u = if u == std::f32::consts::TAU { 0.0 } else { u };
            let sin = if v == std::f32::consts::PI {
                0.0
            } else {
                v.sin()
            };
            vec3(u.cos() * sin, u.sin() * sin, v.cos()) * scale
        };
        let mut mesh = tessellated(&mut random, 40, sphere);
        // Rows jitter differently at the two ends of the seam: take the first column's.
        for y in 0..=40 {
            mesh.positions[y * 41 + 40] = mesh.positions[y * 41];
        }
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| mesh.positions[v as usize]);
            (b - a).cross(c - a).length()
        };
        mesh.triangles = mesh
            .triangles
            .iter()
            .copied()
            .filter(|t| area(t) > 0.0)
            .collect();
        let mut scene = Scene::default();
        let mut pose = Pose::default();
        scene.meshes.push(mesh);
        place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
        for moves in [false, true] {
            let inward = |p: Vec3, n: Vec3| if n.dot(p) > 0.0 { -n } else { n };
            let (rays, hits) = from_surface(&scene, &pose, moves, 5000, 10.0 * scale, inward);
            assert_eq!(hits, rays, "scale {scale}, moves {moves}");
        }
    }
}

#[test]
fn rays_aimed_at_shared_edges_do_not_slip_through() {
    let mut random = Random(8);
    let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.4, 1.2, -0.7);
    let mut scene = Scene::default();
    let mut pose = Pose::default();
    let wall = |u: f32, v: f32| turn * vec3(u * 6.0 - 3.0, v * 6.0 - 3.0, 0.0);
    scene.meshes.push(tessellated(&mut random, 20, wall));
    place(
        &mut scene,
        &mut pose,
        0,
        Affine3A::from_scale(vec3(1.0, 1.3, 0.7)),
        false,
    );
    for moves in [false, true] {
        let tracer = CpuTracer::new(&scene, &pose, &[], &[moves]).unwrap();
        let m = &pose.instances[0].world_from_local;
        let at = |v: u32| m.transform_point3(scene.meshes[0].positions[v as usize]);
        for _ in 0..20_000 {
            let x = 1 + (random.unit() * 18.0) as u32;
            let y = 1 + (random.unit() * 18.0) as u32;
            let corner = y * 21 + x;
            let other = [corner + 1, corner + 21, corner + 20][(random.unit() * 3.0) as usize];
            let along = 0.001 + random.unit() * 0.998;
            let target = at(corner).lerp(at(other), along);
            let origin = target + random.direction();
            let direction = (target - origin).normalize();
            let normal = (at(22) - at(0)).cross(at(1) - at(0)).normalize();
            if normal.dot(direction).abs() > 0.05 {
                assert!(
                    one(&tracer, Against::All, origin, direction, 2.0),
                    "{origin} {target}"
                );
            }
        }
    }
}

#[test]
fn rays_along_axes_hit_what_lies_in_the_planes_of_boxes() {
    // Axis-aligned walls: boxes are flat, and directions have zero components of either sign.
    let mut scene = Scene::default();
    let mut pose = Pose::default();
    let mut random = Random(2);
    scene.meshes.push(tessellated(&mut random, 16, |u, v| {
        vec3(u * 8.0, 2.0, v * 8.0)
    }));
    place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
    for moves in [false, true] {
        let tracer = CpuTracer::new(&scene, &pose, &[], &[moves]).unwrap();
        for i in 0..=80 {
            let from = vec3(i as f32 * 0.1, 1.0, 8.0 - i as f32 * 0.1);
            for zero in [0.0, -0.0] {
                assert!(one(
                    &tracer,
                    Against::All,
                    from,
                    vec3(zero, 1.0, -zero),
                    1.5
                ));
                assert!(!one(
                    &tracer,
                    Against::All,
                    from,
                    vec3(zero, -1.0, zero),
                    1.5
                ));
                assert!(!one(
                    &tracer,
                    Against::All,
                    from,
                    vec3(zero, 1.0, zero),
                    0.9
                ));
            }
        }
    }
}

#[test]
fn the_same_scene_at_another_scale_gives_the_same_answers() {
    let mut random = Random(6);
    let soup = random.soup(400, 0.2);
    let rays: Vec<(Vec3, Vec3)> = (0..2000)
        .map(|_| (random.cube(), random.direction()))
        .collect();
    let hits = |scale: f32, moves: bool| {
        let mut scene = Scene::default();
        let mut pose = Pose::default();
        let mut mesh = soup.clone();
        mesh.positions.iter_mut().for_each(|p| *p *= scale);
        scene.meshes.push(mesh);
        place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
        let tracer = CpuTracer::new(&scene, &pose, &[], &[moves]).unwrap();
        let ask = |(o, d): &(Vec3, Vec3)| one(&tracer, Against::All, *o * scale, *d, 0.3 * scale);
        rays.iter().map(ask).collect::<Vec<bool>>()
    };
    for moves in [false, true] {
        let usual = hits(1.0, moves);
        assert!(usual.iter().filter(|hit| **hit).count() > 200);
        for power in [-20, -10, 10, 20] {
            assert!(
                hits(2f32.powi(power), moves) == usual,
                "2^{power}, moves {moves}"
            );
        }
    }
}

#[test]
fn senseless_rays_hit_nothing() {
    let (scene, pose, deformed, moves) = mixture();
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    for against in [
        Against::All,
        Against::Static,
        Against::Movers,
        Against::Instance(2),
    ] {
        assert!(!one(&tracer, against, Vec3::ZERO, Vec3::ZERO, 1.0));
        for odd in odd {
            assert!(!one(&tracer, against, vec3(0.0, odd, 0.0), Vec3::X, 1.0));
            assert!(!one(&tracer, against, Vec3::ZERO, vec3(odd, 0.0, 0.0), 1.0));
        }
        for t_max in [0.0, -1.0, f32::NEG_INFINITY] {
            assert!(!one(&tracer, against, Vec3::ZERO, Vec3::X, t_max));
        }
    }
    assert_eq!(tracer.closest(Vec3::NAN, Vec3::X, 1.0), None);
    assert_eq!(tracer.closest(Vec3::ZERO, Vec3::ZERO, f32::INFINITY), None);
    assert_eq!(tracer.closest(Vec3::ZERO, Vec3::X, f32::NAN), None);
    assert_eq!(
        tracer.closest(Vec3::splat(1e30), Vec3::X, f32::INFINITY),
        None
    );
}

#[test]
fn an_empty_scene_hits_nothing() {
    let mut tracer = CpuTracer::new(&Scene::default(), &Pose::default(), &[], &[]).unwrap();
    assert_eq!(tracer.closest(Vec3::ZERO, Vec3::X, f32::INFINITY), None);
    for against in [
        Against::All,
        Against::Static,
        Against::Movers,
        Against::Instance(0),
    ] {
        assert!(!one(&tracer, against, Vec3::ZERO, Vec3::X, 1.0));
    }
    tracer.update(&Scene::default(), &Pose::default(), &[]);
}

#[test]
fn flattened_and_broken_placements_are_never_hit_and_hide_nothing_else() {
    let mut random = Random(11);
    let mut scene = Scene::default();
    let mut pose = Pose::default();
    scene.meshes.push(random.soup(200, 0.4));
    place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
    for broken in [
        Affine3A::from_scale(vec3(1.0, 0.0, 1.0)),
        Affine3A::from_scale(Vec3::ZERO),
        Affine3A::from_scale(vec3(f32::NAN, 1.0, 1.0)),
        Affine3A::from_translation(vec3(0.0, f32::INFINITY, 0.0)),
        Affine3A::from_scale(Vec3::splat(1e-30)),
        Affine3A::from_scale(Vec3::splat(1e30)),
    ] {
        place(&mut scene, &mut pose, 0, broken, false);
    }
    for moves in [false, true] {
        let moves = vec![moves; scene.instances.len()];
        let tracer = CpuTracer::new(&scene, &pose, &[], &moves).unwrap();
        let alone = Obvious::new(
            &Scene {
                instances: scene.instances[..1].to_vec(),
                ..scene.clone()
            },
            &pose,
            &[],
        );
        let mut hits = 0;
        for _ in 0..1000 {
            let (origin, direction) = (random.cube(), random.direction());
            let found = alone.hits(&scene, origin, direction);
            for broken in 1..5 {
                assert!(!one(
                    &tracer,
                    Against::Instance(broken),
                    origin,
                    direction,
                    1.0
                ));
            }
            if found.iter().all(|f| f.sure && (f.t - 1.0).abs() > 1e-4) {
                let expected = found.iter().any(|f| f.t > 0.0 && f.t < 1.0);
                assert_eq!(
                    one(&tracer, Against::Instance(0), origin, direction, 1.0),
                    expected
                );
                hits += usize::from(expected);
            }
        }
        assert!(hits > 100);
    }
}

#[test]
fn geometry_that_is_all_in_one_place_still_builds_and_traces() {
    // The same triangle over and over, and triangles that tower over each other, each a little
    // larger: these make trees that are chains.
    for grow in [1.0f32, 1.001, 1.05] {
        let mut mesh = Mesh::default();
        let mut sizes = vec![1.0f32];
        while sizes.len() < 20_000 && sizes[sizes.len() - 1] < 1e5 {
            sizes.push(sizes[sizes.len() - 1] * grow);
        }
        for (i, size) in sizes.iter().enumerate() {
            let corners = [
                vec3(-1.0, 1.0, -1.0),
                vec3(1.0, 1.0, -1.0),
                vec3(0.0, 1.0, 1.0),
            ];
            mesh.positions.extend(corners.map(|p| p * *size));
            mesh.triangles.push([0, 1, 2].map(|k| 3 * i as u32 + k));
        }
        for deforms in [false, true] {
            let mut scene = Scene::default();
            let mut pose = Pose::default();
            scene.meshes.push(mesh.clone());
            place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, deforms);
            let tracer = CpuTracer::new(&scene, &pose, &[], &[deforms]).unwrap();
            let all = Against::All;
            for size in &sizes {
                let (down, below) = (size * 0.0004, Vec3::Y * *size * 0.9998);
                assert!(
                    !one(&tracer, all, below, Vec3::NEG_Y, down),
                    "{grow} {size}"
                );
                assert!(one(&tracer, all, below, Vec3::Y, down), "{grow} {size}");
            }
        }
    }
}

#[test]
fn trees_stay_shallow_however_boxes_are_nested() {
    // Deep ones would overflow the stack of what is recursive in the builder.
    for grow in [1.0f32, 1.001, 1.05, 2.0] {
        let mut size = 1.0f32;
        let mut boxes = Vec::new();
        while boxes.len() < 5000 && size < 1e6 {
            boxes.push(Aabb::new(Vec3A::ZERO, Vec3A::splat(size)));
            size *= grow;
        }
        let tree = body::tree(&mut boxes, &body::TOP);
        assert!(
            tree.depth(0) <= 96,
            "{} levels for {} boxes",
            tree.depth(0),
            boxes.len()
        );
        let mut held = tree.primitive_indices.clone();
        held.sort_unstable();
        assert!(held.into_iter().eq(0..boxes.len() as u32), "each box once");
    }
}

#[test]
fn deformed_vertices_that_are_not_finite_take_only_their_triangles_away() {
    let (scene, pose, mut deformed, moves) = mixture();
    let mut tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    for d in &mut deformed {
        d.positions[0] = Vec3::NAN;
        d.positions[4] = Vec3::INFINITY;
    }
    tracer.update(&scene, &pose, &deformed);
    let (hits, _) = compare(&scene, &pose, &deformed, &moves, &tracer);
    assert!(hits > 1500);
}

#[test]
fn too_many_placements_of_a_mesh_are_refused_before_memory_is_taken() {
    let mut scene = Scene::default();
    let mut pose = Pose::default();
    let mut mesh = Random(1).soup(1, 1.0);
    mesh.triangles = vec![[0, 1, 2]; 1 << 20];
    scene.meshes.push(mesh);
    for _ in 0..17 {
        place(&mut scene, &mut pose, 0, Affine3A::IDENTITY, false);
    }
    let refused = CpuTracer::new(&scene, &pose, &[], &[false; 17]).err();
    assert_eq!(
        refused,
        Some(TooManyTriangles {
            triangles: 17 << 20
        })
    );
}

#[test]
fn wrap_modes_choose_the_texel_that_a_texture_would() {
    let cases = [
        (
            Wrap::Repeat,
            [
                (0.0, 0),
                (0.99, 3),
                (1.0, 0),
                (-0.01, 3),
                (2.3, 1),
                (-7.6, 1),
            ],
        ),
        (
            Wrap::Clamp,
            [
                (0.0, 0),
                (0.99, 3),
                (1.0, 3),
                (-0.01, 0),
                (2.3, 3),
                (-7.6, 0),
            ],
        ),
        (
            Wrap::Mirror,
            [
                (0.0, 0),
                (0.99, 3),
                (1.1, 3),
                (-0.01, 0),
                (2.3, 1),
                (-7.6, 1),
            ],
        ),
    ];
    for (wrap, cases) in cases {
        for (at, texel) in cases {
            assert_eq!(nearest_texel(at, 4, wrap), texel, "{wrap:?} at {at}");
        }
        assert!(nearest_texel(f32::NAN, 4, wrap) < 4);
    }
}

/// What a fan hits, and what its rays hit one by one, in the sorted order.
fn both_ways(tracer: &CpuTracer, against: Against, fan: &Fan<'_>, t_max: f32) -> [Vec<u64>; 2] {
    let rays: Vec<Vec3> = (0..fan.directions.len())
        .map(|i| fan.direction(i))
        .collect();
    let words = fan.directions.words();
    let (mut together, mut single) = (vec![0; words], vec![0; words]);
    let todo = vec![!0; words];
    tracer.occluded_fan(against, fan, t_max, &todo, &mut together);
    tracer.occluded(against, fan.origin, &rays, t_max, &todo, &mut single);
    [together, single]
}

#[test]
fn a_fan_hits_exactly_what_its_rays_hit_one_by_one() {
    let (scene, pose, deformed, moves) = mixture();
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let mut random = Random(12);
    // Fewer than a group, an odd number, one bundle, and several.
    for rays in [3, 64, 200, 256, 1000] {
        let samples = Samples::new(rays);
        let (mut hits, mut misses) = (0, 0);
        for point in 0..150 {
            let (origin, normal) = (random.cube() * 2.0, random.direction());
            let fan = samples.fan(point, origin, normal, random.direction());
            let t_max = 0.05 + random.unit() * 1.5;
            let instance = (random.unit() * 12.0) as u32;
            for against in [
                Against::All,
                Against::Static,
                Against::Movers,
                Against::Instance(instance),
                Against::AllExcept(instance),
            ] {
                let [together, single] = both_ways(&tracer, against, &fan, t_max);
                assert_eq!(together, single, "{against:?} {origin} {normal} {t_max}");
                let hit = single.iter().map(|word| word.count_ones()).sum::<u32>() as usize;
                hits += hit;
                misses += rays - hit;
            }
        }
        assert!(hits > 10 * rays && misses > 10 * rays, "{hits} {misses}");
    }
}

#[test]
fn directions_that_go_anywhere_make_fans_too() {
    let (scene, pose, deformed, moves) = mixture();
    let tracer = CpuTracer::new(&scene, &pose, &deformed, &moves).unwrap();
    let mut random = Random(13);
    for _ in 0..50 {
        let mut given: Vec<Vec3> = (0..100).map(|_| random.direction()).collect();
        given.extend([Vec3::ZERO, Vec3::NAN, Vec3::X, Vec3::NEG_Y, -Vec3::Z]);
        let directions = Directions::new(&given);
        let fan = Fan {
            origin: random.cube() * 1.5,
            axes: Mat3A::IDENTITY,
            directions: &directions,
        };
        let [together, single] = both_ways(&tracer, Against::All, &fan, 1.0);
        assert_eq!(together, single, "from {}", fan.origin);
    }
}

#[test]
fn cores_and_vectors_decide_no_ray_otherwise() {
    // A closed ball of many corners, stretched, turned and sheared, from outside and within; and
    // the same without a triangle, which has no core.
    let ball = |u: f32, v: f32| {
        let (u, v) = (u * std::f32::consts::TAU, v * std::f32::consts::PI);
        let u = if u == std::f32::consts::TAU { 0.0 } else { u };
        let sin = if v == std::f32::consts::PI {
            0.0
        } else {
            v.sin()
        };
        vec3(u.cos() * sin, u.sin() * sin, v.cos()) * 0.5
    };
    let mut random = Random(14);
    let mut closed = tessellated(&mut random, 16, ball);
    for y in 0..=16 {
        closed.positions[y * 17 + 16] = closed.positions[y * 17];
    }
    let mut open = closed.clone();
    open.triangles.swap_remove(200);
    let samples = Samples::new(256);
    for (mesh, has_core) in [(closed, true), (open, false)] {
        for placed in matrices(&mut random) {
            let (mut scene, mut pose) = (Scene::default(), Pose::default());
            scene.meshes.push(mesh.clone());
            place(&mut scene, &mut pose, 0, placed, false);
            let mut tracer = CpuTracer::new(&scene, &pose, &[], &[true]).unwrap();
            assert_eq!(tracer.meshes[0].core.is_some(), has_core);
            let mut hits = 0;
            for point in 0..200 {
                let origin = placed.transform_point3(random.cube() * 1.2);
                let fan = samples.fan(point, origin, random.direction(), Vec3::X);
                let [together, single] = both_ways(&tracer, Against::All, &fan, 0.6);
                assert_eq!(together, single, "from {origin}");
                hits += single.iter().map(|word| word.count_ones()).sum::<u32>();
                #[cfg(target_arch = "x86_64")]
                {
                    let avx = tracer.avx.take();
                    let [plain, _] = both_ways(&tracer, Against::All, &fan, 0.6);
                    assert_eq!(plain, single, "without vectors, from {origin}");
                    tracer.avx = avx;
                }
            }
            assert!(hits > 500, "{hits} hits: too few to tell");
        }
    }
}
