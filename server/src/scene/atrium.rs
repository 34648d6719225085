//! The built-in scene, an indoor atrium, and boulders that roll through any scene.
//!
//! Everything is ordinary meshes, nodes, skins and animations. It has to be the same on every
//! machine ([`Scene::hash`]), so that it is computed in double precision with nothing but
//! arithmetic and square roots, which IEEE 754 fixes to the last bit; the platform's sine is not.

use std::collections::HashMap;
use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec3, DVec4, Mat4, Quat, Vec3, Vec4Swizzles};

use super::{
    Animation, Channel, Instance, Interpolation, Keys, LocalTransform, Mesh, Morph, Node, Pose,
    Scene, Skin,
};

/// Sine and cosine of a number of turns, the same on every machine.
pub(super) fn sin_cos(turns: f64) -> (f64, f64) {
    let quarter = (turns * 4.0).round();
    let x = (turns * 4.0 - quarter) * (TAU / 4.0);
    // Taylor series; |x| is at most an eighth of a turn, where 9 terms leave less than 1e-16.
    let (mut sin, mut cos, mut term) = (0.0, 0.0, 1.0);
    for n in 0..18 {
        match n % 4 {
            0 => cos += term,
            1 => sin += term,
            2 => cos -= term,
            _ => sin -= term,
        }
        term *= x / f64::from(n + 1);
    }
    match quarter.rem_euclid(4.0) as u32 {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// The rotation about the unit vector along `v` by its length in radians.
fn rotation(v: DVec3) -> DQuat {
    let angle = v.length();
    if angle == 0.0 {
        return DQuat::IDENTITY;
    }
    let (sin, cos) = sin_cos(angle / TAU / 2.0);
    let axis = v / angle * sin;
    DQuat::from_xyzw(axis.x, axis.y, axis.z, cos)
}

/// Adds a triangle that faces as its vertices' normals do; nothing where it has no area.
fn triangle(mesh: &mut Mesh, [a, b, c]: [u32; 3]) {
    let at = |v: u32| mesh.positions[v as usize].as_dvec3();
    let up = (at(b) - at(a)).cross(at(c) - at(a));
    if up.length_squared() < 1e-18 {
        return;
    }
    let normal: Vec3 = [a, b, c]
        .map(|v| mesh.normals[v as usize])
        .into_iter()
        .sum();
    let triangle = if up.dot(normal.as_dvec3()) < 0.0 {
        [a, c, b]
    } else {
        [a, b, c]
    };
    mesh.triangles.push(triangle);
}

/// Adds a smooth surface: a grid of positions and normals over `u` and `v` in 0..=1.
fn surface(mesh: &mut Mesh, nu: u32, nv: u32, at: impl Fn(f64, f64) -> (DVec3, DVec3)) {
    let first = mesh.positions.len() as u32;
    for j in 0..=nv {
        for i in 0..=nu {
            let (position, normal) = at(f64::from(i) / f64::from(nu), f64::from(j) / f64::from(nv));
            mesh.positions.push(position.as_vec3());
            mesh.normals.push(normal.normalize().as_vec3());
        }
    }
    for j in 0..nv {
        for i in 0..nu {
            let corner = |i, j| first + j * (nu + 1) + i;
            let (a, b) = (corner(i, j), corner(i + 1, j));
            let (c, d) = (corner(i + 1, j + 1), corner(i, j + 1));
            triangle(mesh, [a, b, c]);
            triangle(mesh, [a, c, d]);
        }
    }
}

/// Adds a box between two corners.
fn cuboid(mesh: &mut Mesh, low: [f64; 3], high: [f64; 3]) {
    let (low, high) = (DVec3::from(low), DVec3::from(high));
    let size = high - low;
    for (normal, across, up) in [
        (DVec3::X, DVec3::Y, DVec3::Z),
        (DVec3::Y, DVec3::Z, DVec3::X),
        (DVec3::Z, DVec3::X, DVec3::Y),
    ] {
        for (corner, normal) in [(low, -normal), (low + normal * size, normal)] {
            surface(mesh, 1, 1, |u, v| {
                (corner + (across * u + up * v) * size, normal)
            });
        }
    }
}

/// Adds a surface of revolution about the y axis. Each part of the profile (radius, height) is
/// smooth within itself and creased against the next; its outside is to the right of its way up.
fn lathe(mesh: &mut Mesh, segments: u32, parts: &[&[[f64; 2]]]) {
    for part in parts {
        let last = part.len() - 1;
        surface(mesh, segments, last as u32, |u, v| {
            let i = (v * last as f64).round() as usize;
            let (before, after) = (part[i.saturating_sub(1)], part[(i + 1).min(last)]);
            // The last column is the first, to the last bit.
            let (sin, cos) = sin_cos(u - u.floor());
            let normal = [after[1] - before[1], before[0] - after[0]];
            (
                DVec3::new(part[i][0] * cos, part[i][1], part[i][0] * sin),
                DVec3::new(normal[0] * cos, normal[1], normal[0] * sin),
            )
        });
    }
}

/// Smooth normals from the triangles around each vertex, which face outwards.
fn smooth(mesh: &mut Mesh) {
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|v| mesh.positions[v as usize].as_dvec3());
        triangle
            .iter()
            .for_each(|&v| sums[v as usize] += (b - a).cross(c - a));
    }
    mesh.normals = sums.iter().map(|sum| sum.normalize().as_vec3()).collect();
}

/// A lumpy ball about the origin; `radius` is in the middle between lumps and dents.
fn boulder(radius: f64) -> Mesh {
    let phi = (1.0 + 5f64.sqrt()) / 2.0;
    let mut points: Vec<DVec3> = Vec::new();
    for (a, b) in [(1.0, phi), (1.0, -phi), (-1.0, phi), (-1.0, -phi)] {
        points.extend([
            DVec3::new(0.0, a, b),
            DVec3::new(a, b, 0.0),
            DVec3::new(b, 0.0, a),
        ]);
    }
    // The faces of an icosahedron are the triples of corners that are all 2 apart.
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    for a in 0..12 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                let [p, q, r] = [a, b, c].map(|i| points[i as usize]);
                let edges = [p.distance(q), q.distance(r), r.distance(p)];
                if edges.iter().all(|edge| (edge - 2.0).abs() < 0.1) {
                    let outward = (q - p).cross(r - p).dot(p) > 0.0;
                    triangles.push(if outward { [a, b, c] } else { [a, c, b] });
                }
            }
        }
    }
    for _ in 0..3 {
        let mut middles: HashMap<(u32, u32), u32> = HashMap::new();
        let mut finer = Vec::new();
        for [a, b, c] in triangles {
            let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(a, b)| {
                *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    points.push(points[a as usize] + points[b as usize]);
                    points.len() as u32 - 1
                })
            });
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        points
            .iter_mut()
            .for_each(|point| *point = point.normalize());
        triangles = finer;
    }
    let lumps = [
        (DVec3::new(1.1, 0.3, -0.5), 0.04, 0.1),
        (DVec3::new(-0.6, 1.3, 0.8), 0.03, 0.6),
        (DVec3::new(0.9, -0.8, 1.5), 0.02, 0.3),
    ];
    let positions = points.iter().map(|&point| {
        let lump = |&(way, size, phase): &(DVec3, f64, f64)| {
            size * sin_cos(point.dot(way) * 0.5 + phase).0
        };
        (point * (radius * (1.0 + lumps.iter().map(lump).sum::<f64>()))).as_vec3()
    });
    let positions = positions.collect();
    let mut mesh = Mesh {
        name: "boulder".into(),
        positions,
        triangles,
        ..Mesh::default()
    };
    smooth(&mut mesh);
    mesh
}

/// `count` points on a level ellipse, equally far apart along it; the first at `phase` turns.
fn ellipse(centre: DVec3, x: f64, z: f64, phase: f64, count: usize) -> Vec<DVec3> {
    const FINE: usize = 4096;
    let at = |i: usize| {
        let (sin, cos) = sin_cos(phase + i as f64 / FINE as f64);
        centre + DVec3::new(x * cos, 0.0, z * sin)
    };
    let mut along = vec![0.0];
    for i in 0..FINE {
        along.push(along[i] + at(i).distance(at(i + 1)));
    }
    (0..count)
        .map(|k| {
            let target = along[FINE] * k as f64 / count as f64;
            let i = along.partition_point(|&length| length <= target).min(FINE) - 1;
            let step = (along[i + 1] - along[i]).max(f64::MIN_POSITIVE);
            at(i).lerp(at(i + 1), (target - along[i]) / step)
        })
        .collect()
}

/// `count` points on a level racetrack, equally far apart along it: two straights, from
/// `-x` to `x`, and half circles of radius `z`.
fn racetrack(centre: DVec3, x: f64, z: f64, count: usize) -> Vec<DVec3> {
    let (straight, bend) = (2.0 * x, z * TAU / 2.0);
    let half = straight + bend;
    (0..count)
        .map(|k| {
            let along = 2.0 * half * k as f64 / count as f64;
            let (along, side) = if along < half {
                (along, 1.0)
            } else {
                (along - half, -1.0)
            };
            let (sin, cos) = sin_cos((along - straight).max(0.0) / bend / 2.0);
            centre + DVec3::new(along.min(straight) - x + z * sin, 0.0, z * cos) * side
        })
        .collect()
}

/// The orientations of a ball that rolls along a closed path of its centre, one a point and the
/// first again at the end.
///
/// Rolling without slipping fixes the angular velocity but for the spin about the vertical, which
/// does not move the point of contact. A ball that has rolled around a loop is turned; so a spin
/// is chosen such that it comes back as it started: a steady one, which settles how far the ball
/// turns about its mean axis, and a swing in time with the rolling for the other two axes.
fn roll(path: &[DVec3], radius: f64) -> Vec<DQuat> {
    let count = path.len();
    let steps: Vec<DVec3> = (0..count)
        .map(|k| DVec3::Y.cross(path[(k + 1) % count] - path[k]) / radius)
        .collect();
    // Orientations under a spin (radians over the loop) a step.
    let follow = |spin: &dyn Fn(usize) -> f64| {
        let mut orientations = vec![DQuat::IDENTITY];
        for k in 0..count {
            let turn = rotation(steps[k] + DVec3::Y * (spin(k) / count as f64));
            orientations.push((turn * orientations[k]).normalize());
        }
        orientations
    };
    // Twice the vector part of the whole loop's rotation: zero where the loop closes.
    let rest = |orientations: &[DQuat]| {
        let whole = orientations[count];
        DVec3::new(whole.x, whole.y, whole.z) * (2.0 * whole.w.signum())
    };
    // Newton, the least step each time, from several steady spins; the gentlest solution.
    let mut gentlest = (f64::INFINITY, follow(&|_| 0.0));
    for start in -10..=10 {
        let steady = follow(&|_| f64::from(start) * 2.0);
        let vertical: Vec<DVec3> = steady.iter().map(|q| q.conjugate() * DVec3::Y).collect();
        let try_out = |spin: DVec4| follow(&|k| spin.x + spin.yzw().dot(vertical[k]));
        let mut spin = DVec4::new(f64::from(start) * 2.0, 0.0, 0.0, 0.0);
        for _ in 0..16 {
            let orientations = try_out(spin);
            let error = rest(&orientations);
            if error.length() < 1e-11 {
                if spin.length() < gentlest.0 {
                    gentlest = (spin.length(), orientations);
                }
                break;
            }
            let slopes = [DVec4::X, DVec4::Y, DVec4::Z, DVec4::W]
                .map(|along| (rest(&try_out(spin + along * 1e-6)) - error) / 1e-6);
            let square =
                |slope: DVec3| DMat3::from_cols(slope * slope.x, slope * slope.y, slope * slope.z);
            let squares = slopes
                .map(square)
                .into_iter()
                .fold(DMat3::ZERO, |sum, m| sum + m);
            let along = squares.inverse() * error;
            let step = DVec4::from(slopes.map(|slope| slope.dot(along)));
            if !step.is_finite() {
                break;
            }
            spin -= step.clamp_length_max(3.0);
        }
    }
    // What is left (rounding, or all of it for a path that no spin closes) goes evenly.
    let mut orientations = gentlest.1;
    let error = rest(&orientations);
    for (k, orientation) in orientations.iter_mut().enumerate() {
        *orientation = rotation(error * (-(k as f64) / count as f64)) * *orientation;
    }
    orientations
}

/// A node under `parent` and the animation that leads it once around `path` in `seconds`.
fn lead(
    scene: &mut Scene,
    name: &str,
    parent: Option<u32>,
    path: &[DVec3],
    orientations: &[DQuat],
    seconds: f64,
) -> u32 {
    let node = scene.nodes.len() as u32;
    let rotations: Vec<Quat> = orientations.iter().map(|q| q.as_quat()).collect();
    scene.nodes.push(Node {
        name: name.into(),
        parent,
        local: LocalTransform::Trs {
            translation: path[0],
            rotation: rotations[0],
            scale: Vec3::ONE,
        },
        morph_weights: Vec::new(),
    });
    let count = path.len();
    let times: Vec<f32> = (0..=count)
        .map(|k| (seconds * k as f64 / count as f64) as f32)
        .collect();
    let translations = (0..=count).map(|k| path[k % count].as_vec3()).collect();
    let channel = |values| Channel {
        node,
        times: times.clone(),
        interpolation: Interpolation::Linear,
        values,
    };
    scene.animations.push(Animation {
        name: name.into(),
        duration_s: times[count],
        channels: vec![
            channel(Keys::Translation(translations)),
            channel(Keys::Rotation(rotations)),
        ],
    });
    node
}

fn add_mesh(scene: &mut Scene, mesh: Mesh) -> u32 {
    scene.meshes.push(mesh);
    scene.meshes.len() as u32 - 1
}

fn add_instance(scene: &mut Scene, mesh: u32, node: u32, skin: Option<u32>) {
    let name = scene.nodes[node as usize].name.clone();
    scene.instances.push(Instance {
        name,
        mesh,
        node,
        skin,
        moves: false,
        deforms: false,
    });
}

/// Places a mesh on a node of its own.
fn place(scene: &mut Scene, name: &str, mesh: u32, at: [f64; 3], scale: [f32; 3]) -> u32 {
    let node = scene.nodes.len() as u32;
    let local = LocalTransform::Trs {
        translation: at.into(),
        rotation: Quat::IDENTITY,
        scale: scale.into(),
    };
    let morph_weights = Vec::new();
    scene.nodes.push(Node {
        name: name.into(),
        parent: None,
        local,
        morph_weights,
    });
    add_instance(scene, mesh, node, None);
    node
}

/// Points of a path such that a ball of `radius` turns by no more than a third of a radian
/// between two.
fn path_points(length: f64, radius: f64) -> usize {
    ((length / radius * 3.0) as usize).clamp(48, 1024)
}

fn path_length(path: &[DVec3]) -> f64 {
    (0..path.len())
        .map(|k| path[k].distance(path[(k + 1) % path.len()]))
        .sum()
}

impl Scene {
    /// The built-in scene: an atrium of 12 x 8 x 5 m with a gallery, columns, furniture, a swaying
    /// cloth, six rolling boulders and two walking figures. The same on every machine.
    pub fn atrium() -> Scene {
        let mut scene = Scene {
            name: "atrium".into(),
            ..Scene::default()
        };
        building(&mut scene);
        furniture(&mut scene);
        cloth(&mut scene);
        for (column, radius, x, z) in [
            (0, 0.5, 1.0, 0.9),
            (1, 0.35, 1.15, 0.95),
            (2, 0.25, 1.2, 1.05),
        ] {
            let mesh = add_mesh(&mut scene, boulder(radius));
            let centre = DVec3::new(TALL_COLUMNS_X[column], radius, 1.0);
            for half in 0..2 {
                let phase = column as f64 * 0.15 + f64::from(half) * 0.5;
                let count = path_points(path_length(&ellipse(centre, x, z, 0.0, 256)), radius);
                let path = ellipse(centre, x, z, phase, count);
                let orientations = roll(&path, radius);
                let seconds = path_length(&path) / 0.7;
                let node = lead(&mut scene, "boulder", None, &path, &orientations, seconds);
                add_instance(&mut scene, mesh, node, None);
            }
        }
        let mesh = figure(&mut scene);
        for (x, z) in [(-0.6, -3.3), (-0.4, 3.25)] {
            walker(
                &mut scene,
                mesh,
                &racetrack(DVec3::new(x, 0.0, z), 3.0, 0.3, 256),
            );
        }
        scene.finish();
        scene
    }

    /// Adds `n` boulders that roll along closed paths around the middle of the scene, at most
    /// 1000. `seed` varies the paths; the same seed gives the same boulders.
    ///
    /// They follow the floor that lies under their path at time 0, and pass through what stands on
    /// it. Without a floor they float at half the scene's height. Where it is level they roll
    /// without slipping.
    pub fn add_movers(&mut self, n: usize, seed: u64) {
        let n = n.min(1000);
        if n == 0 {
            return;
        }
        let mut pose = Pose::default();
        self.pose(0.0, &mut pose);
        let [low, high] = self.bounds(&pose).map(|corner| corner.as_dvec3());
        let size = (high - low).max(DVec3::splat(1e-3));
        let middle = self.origin + (low + high) / 2.0;
        let across = (size.x + size.z) / 2.0;
        // Rooms to halls; far larger or smaller scenes keep the proportion.
        let room = (2.0..200.0).contains(&across);
        let radius = if room {
            (0.02 * across).clamp(0.15, 0.6)
        } else {
            0.02 * across
        };

        let mut random = seed;
        let mut next = || {
            // SplitMix64.
            random = random.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = random;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            (z ^ (z >> 31)) as f64 / 2f64.powi(64)
        };
        let paths: Vec<Vec<DVec3>> = (0..n)
            .map(|i| {
                let reach = 0.1 + 0.25 * (i as f64 + next()) / n as f64;
                let (x, z) = (size.x * reach * (0.8 + 0.4 * next()), size.z * reach);
                let phase = (i as f64 + 0.5 * next()) * 0.382;
                let count = path_points(path_length(&ellipse(middle, x, z, 0.0, 256)), radius);
                ellipse(middle, x, z, phase, count)
            })
            .collect();
        let points: Vec<DVec3> = paths.iter().flatten().copied().collect();
        let surfaces = self.surfaces_under(&points, &pose);

        let mesh = add_mesh(self, boulder(radius));
        // Key frames are in single precision: relative to the middle they stay precise far out.
        let parent = self.nodes.len() as u32;
        self.nodes.push(Node {
            name: "movers".into(),
            parent: None,
            local: LocalTransform::Trs {
                translation: middle,
                rotation: Quat::IDENTITY,
                scale: Vec3::ONE,
            },
            morph_weights: Vec::new(),
        });
        let mut first = 0;
        for path in paths {
            let under = &surfaces[first..first + path.len()];
            first += path.len();
            let heights = follow_floor(under, radius);
            let path: Vec<DVec3> = (path.iter().enumerate())
                .map(|(k, &point)| match &heights {
                    Some(heights) => DVec3::new(point.x, heights[k] + radius, point.z),
                    None => point,
                })
                .map(|point| point - middle)
                .collect();
            let level: Vec<DVec3> = path.iter().map(|p| DVec3::new(p.x, 0.0, p.z)).collect();
            let orientations = roll(&level, radius);
            let seconds = path_length(&path) / (2.5 * radius);
            let node = lead(self, "boulder", Some(parent), &path, &orientations, seconds);
            add_instance(self, mesh, node, None);
        }
        self.finish();
    }

    /// The heights, from below, at which the vertical through each point (world metres) meets a
    /// surface that is not steep.
    fn surfaces_under(&self, points: &[DVec3], pose: &Pose) -> Vec<Vec<f64>> {
        // Sorted by x, so that a triangle finds the points in its range without seeing the rest.
        let mut order: Vec<usize> = (0..points.len()).collect();
        order.sort_by(|&a, &b| points[a].x.total_cmp(&points[b].x));
        let mut heights = vec![Vec::new(); points.len()];
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for (index, instance) in self.instances.iter().enumerate() {
            let at = &pose.instances[index];
            self.deform(index, at, &mut positions, &mut normals);
            for triangle in &self.meshes[instance.mesh as usize].triangles {
                let [a, b, c] = triangle.map(|v| {
                    let world = at.world_from_local.transform_point3(positions[v as usize]);
                    world.as_dvec3() + self.origin
                });
                let up = (b - a).cross(c - a);
                if up.y.abs() <= 0.5 * up.length() {
                    continue;
                }
                let (low, high) = (a.min(b).min(c), a.max(b).max(c));
                let from = order.partition_point(|&i| points[i].x < low.x);
                for &i in order[from..].iter().take_while(|&&i| points[i].x <= high.x) {
                    let p = points[i];
                    let edge =
                        |a: DVec3, b: DVec3| (b.z - a.z) * (p.x - a.x) - (b.x - a.x) * (p.z - a.z);
                    let weights = DVec3::new(edge(b, c), edge(c, a), edge(a, b)) / up.y;
                    if weights.min_element() >= 0.0 {
                        heights[i].push(weights.dot(DVec3::new(a.y, b.y, c.y)));
                    }
                }
            }
        }
        heights
            .iter_mut()
            .for_each(|heights| heights.sort_by(f64::total_cmp));
        heights
    }
}

/// The floor's height along a closed path, of the surfaces at each of its points; nothing where
/// most of the path has no floor.
fn follow_floor(surfaces: &[Vec<f64>], radius: f64) -> Option<Vec<f64>> {
    // A floor has room above it for a boulder and then some; the lowest such one.
    let floor = |heights: &Vec<f64>| {
        let room = |i: usize| {
            heights
                .get(i + 1)
                .map_or(f64::INFINITY, |above| above - heights[i])
        };
        (0..heights.len())
            .find(|&i| room(i) > 4.0 * radius)
            .map(|i| heights[i])
    };
    let mut lowest: Vec<f64> = surfaces.iter().filter_map(floor).collect();
    if lowest.len() * 2 < surfaces.len() {
        return None;
    }
    lowest.sort_by(f64::total_cmp);
    let mut height = lowest[lowest.len() / 2];
    // Twice around, so that the end meets the beginning. A step higher than half a radius is an
    // obstacle, not floor.
    let mut heights = vec![height; surfaces.len()];
    for k in 0..2 * surfaces.len() {
        let k = k % surfaces.len();
        let off = |candidate: f64| (candidate - height).abs();
        let nearest = surfaces[k]
            .iter()
            .copied()
            .min_by(|&a, &b| off(a).total_cmp(&off(b)));
        height = nearest
            .filter(|&nearest| off(nearest) <= radius / 2.0)
            .unwrap_or(height);
        heights[k] = height;
    }
    for _ in 0..8 {
        let count = heights.len();
        heights = (0..count)
            .map(|k| {
                (heights[(k + count - 1) % count] + heights[k] + heights[(k + 1) % count]) / 3.0
            })
            .collect();
    }
    Some(heights)
}

/// Where the columns in front of the gallery stand.
const GALLERY_COLUMNS_X: [f64; 5] = [-5.4, -3.0, -0.6, 1.8, 4.2];
/// The columns that the boulders go around, at z = 1.
const TALL_COLUMNS_X: [f64; 3] = [-3.6, -0.4, 2.8];

/// Room, gallery, columns, arches, beams and steps. What meets, overlaps by a centimetre or so:
/// no two visible faces lie in one plane.
fn building(scene: &mut Scene) {
    let one = [1.0; 3];
    let mut room = Mesh {
        name: "room".into(),
        ..Mesh::default()
    };
    for (low, high) in [
        ([-6.0, -0.2, -4.0], [6.0, 0.0, 4.0]),    // floor
        ([-6.2, -0.2, -4.2], [-6.0, 5.2, 4.2]),   // walls
        ([6.0, -0.2, -4.2], [6.2, 5.2, 4.2]),     //
        ([-6.0, -0.2, -4.2], [6.0, 5.2, -4.0]),   //
        ([-6.0, -0.2, 4.0], [6.0, 5.2, 4.2]),     //
        ([-6.0, 5.0, -4.0], [6.0, 5.2, -1.2]),    // roof around a skylight
        ([-6.0, 5.0, 1.8], [6.0, 5.2, 4.0]),      //
        ([-6.0, 5.0, -1.2], [-2.5, 5.2, 1.8]),    //
        ([2.5, 5.0, -1.2], [6.0, 5.2, 1.8]),      //
        ([-6.01, 2.6, -4.01], [6.01, 2.8, -2.4]), // gallery
    ] {
        cuboid(&mut room, low, high);
    }
    let room = add_mesh(scene, room);
    place(scene, "room", room, [0.0; 3], one);

    let mut column = Mesh {
        name: "column".into(),
        ..Mesh::default()
    };
    let shaft: Vec<[f64; 2]> = (0..=8)
        .map(|i| f64::from(i) / 8.0)
        .map(|t| [0.2 - 0.03 * t * t, 0.12 + 1.24 * t])
        .collect();
    let torus: Vec<[f64; 2]> = (0..=6)
        .map(|i| sin_cos(-0.25 + f64::from(i) / 12.0))
        .map(|(sin, cos)| [0.21 + 0.04 * cos, 0.08 + 0.04 * sin])
        .collect();
    let capital: Vec<[f64; 2]> = (0..=6)
        .map(|i| f64::from(i) / 6.0)
        .map(|t| [0.17 + 0.08 * t * t, 1.36 + 0.12 * t])
        .collect();
    lathe(
        &mut column,
        32,
        &[
            &[[0.28, -0.01], [0.28, 0.04]],
            &[[0.28, 0.04], [0.21, 0.04]],
            &torus,
            &[[0.21, 0.12], [0.2, 0.12]],
            &shaft,
            &capital,
            &[[0.25, 1.48], [0.25, 1.54]],
            &[[0.25, 1.54], [0.0, 1.54]],
        ],
    );
    let column = add_mesh(scene, column);
    for x in GALLERY_COLUMNS_X {
        place(scene, "gallery column", column, [x, 0.0, -2.4], one);
    }
    for x in TALL_COLUMNS_X {
        // Stretched to just above the beams' underside.
        place(
            scene,
            "tall column",
            column,
            [x, 0.0, 1.0],
            [1.0, 3.08, 1.0],
        );
    }

    let mut arch = Mesh {
        name: "arch".into(),
        ..Mesh::default()
    };
    for (radius, side) in [(1.0, -1.0), (1.1, 1.0)] {
        surface(&mut arch, 24, 1, |u, v| {
            let (sin, cos) = sin_cos(u / 2.0);
            let out = DVec3::new(cos, sin, 0.0);
            (out * radius + DVec3::Z * (0.3 * v - 0.15), out * side)
        });
    }
    for side in [-1.0, 1.0] {
        surface(&mut arch, 24, 1, |u, v| {
            let (sin, cos) = sin_cos(u / 2.0);
            let out = DVec3::new(cos, sin, 0.0);
            (
                out * (1.0 + 0.1 * v) + DVec3::Z * (0.15 * side),
                DVec3::Z * side,
            )
        });
    }
    let arch = add_mesh(scene, arch);
    for pair in GALLERY_COLUMNS_X.windows(2) {
        place(
            scene,
            "arch",
            arch,
            [(pair[0] + pair[1]) / 2.0, 1.52, -2.4],
            one,
        );
    }

    let mut beam = Mesh {
        name: "beam".into(),
        ..Mesh::default()
    };
    cuboid(&mut beam, [-0.12, 4.7, -4.01], [0.12, 5.01, 4.01]);
    let beam = add_mesh(scene, beam);
    for x in TALL_COLUMNS_X {
        place(scene, "beam", beam, [x, 0.0, 0.0], one);
    }

    let mut steps = Mesh {
        name: "steps".into(),
        ..Mesh::default()
    };
    for i in 0..14 {
        let (z, top) = (0.4 - 0.2 * f64::from(i), 0.2 * f64::from(i + 1));
        cuboid(&mut steps, [4.7, -0.01, z - 0.2], [5.8, top, z]);
    }
    let steps = add_mesh(scene, steps);
    place(scene, "steps", steps, [0.0; 3], one);
}

/// Railing, table, bench, crates, shelf and thin-walled vases.
fn furniture(scene: &mut Scene) {
    let one = [1.0; 3];
    let mut post = Mesh {
        name: "post".into(),
        ..Mesh::default()
    };
    lathe(&mut post, 12, &[&[[0.02, -0.01], [0.02, 0.92]]]);
    let post = add_mesh(scene, post);
    for i in 0..12 {
        let x = -5.7 + 10.2 * f64::from(i) / 11.0;
        place(scene, "post", post, [x, 2.8, -2.45], one);
    }
    let groups: [(&str, &[([f64; 3], [f64; 3])]); 5] = [
        (
            "railing",
            &[
                ([-6.01, 3.7, -2.49], [4.6, 3.75, -2.41]),
                ([-6.01, 2.95, -2.475], [4.5, 3.55, -2.465]), // a pane
            ],
        ),
        (
            "table",
            &[
                ([-5.8, 0.72, 2.7], [-4.3, 0.76, 3.6]),
                ([-5.72, -0.01, 2.78], [-5.65, 0.73, 2.85]),
                ([-4.45, -0.01, 2.78], [-4.38, 0.73, 2.85]),
                ([-5.72, -0.01, 3.45], [-5.65, 0.73, 3.52]),
                ([-4.45, -0.01, 3.45], [-4.38, 0.73, 3.52]),
            ],
        ),
        (
            "bench",
            &[
                ([3.3, 0.4, 3.3], [5.6, 0.46, 3.8]),
                ([3.5, -0.01, 3.36], [3.62, 0.41, 3.74]),
                ([5.28, -0.01, 3.36], [5.4, 0.41, 3.74]),
            ],
        ),
        (
            "crates",
            &[
                ([4.8, -0.01, 1.5], [5.6, 0.8, 2.3]),
                ([4.95, 0.79, 1.6], [5.45, 1.25, 2.1]),
                ([5.0, -0.01, 2.45], [5.5, 0.5, 2.9]),
            ],
        ),
        (
            "shelf",
            &[
                ([-5.8, 1.2, -4.01], [-4.5, 1.225, -3.72]),
                ([-5.8, 1.6, -4.01], [-4.5, 1.625, -3.72]),
                ([-5.7, 1.22, -3.95], [-5.5, 1.5, -3.77]),
                ([-5.4, 1.22, -3.93], [-5.25, 1.46, -3.76]),
            ],
        ),
    ];
    for (name, boxes) in groups {
        let mut mesh = Mesh {
            name: name.into(),
            ..Mesh::default()
        };
        boxes
            .iter()
            .for_each(|&(low, high)| cuboid(&mut mesh, low, high));
        let mesh = add_mesh(scene, mesh);
        place(scene, name, mesh, [0.0; 3], one);
    }

    let mut vase = Mesh {
        name: "vase".into(),
        ..Mesh::default()
    };
    let profile = |inset: f64| {
        let at = move |t: f64| [0.12 + 0.06 * sin_cos(t * 0.8).0 - inset, 0.45 * t];
        (0..=24)
            .map(move |i| at(f64::from(i) / 24.0))
            .collect::<Vec<[f64; 2]>>()
    };
    let outside = profile(0.0);
    // The way down, so that its outside faces the axis. The wall is 8 mm thick.
    let inside: Vec<[f64; 2]> = profile(0.008)
        .into_iter()
        .rev()
        .map(|[r, y]| [r, y.max(0.01)])
        .collect();
    lathe(
        &mut vase,
        32,
        &[
            &outside,
            &[outside[24], inside[0]],
            &inside,
            &[inside[24], [0.0, 0.01]],
        ],
    );
    let vase = add_mesh(scene, vase);
    place(scene, "vase", vase, [-5.0, 0.755, 3.1], one);
    place(scene, "vase", vase, [3.2, 2.795, -3.4], [1.6, 2.0, 1.6]);
    place(scene, "vase", vase, [5.2, 1.245, 1.85], [0.8, 0.7, 0.8]);
}

/// A double-sided cloth in front of the gallery that sways: a morph target.
fn cloth(scene: &mut Scene) {
    let sheet = |sway: f64| {
        let mut mesh = Mesh {
            name: "cloth".into(),
            double_sided: true,
            ..Mesh::default()
        };
        let at = move |u: f64, v: f64| {
            let fold = 0.05 * (0.3 + 0.7 * v) * sin_cos(u * 4.0 + 0.3 * v).0;
            DVec3::new(1.6 * u, -2.4 * v, fold + sway * 0.25 * v * v)
        };
        surface(&mut mesh, 48, 48, |u, v| {
            let step = 1.0 / 1024.0;
            let across = at(u + step, v) - at(u - step, v);
            let down = at(u, v + step) - at(u, v - step);
            (at(u, v), down.cross(across))
        });
        mesh
    };
    let (mut mesh, swayed) = (sheet(-0.2), sheet(1.0));
    let delta =
        |to: &[Vec3], from: &[Vec3]| to.iter().zip(from).map(|(to, from)| to - from).collect();
    mesh.morphs.push(Morph {
        positions: delta(&swayed.positions, &mesh.positions),
        normals: delta(&swayed.normals, &mesh.normals),
    });
    let mesh = add_mesh(scene, mesh);
    let node = place(scene, "cloth", mesh, [-2.6, 3.69, -2.1], [1.0; 3]);
    scene.nodes[node as usize].morph_weights = vec![0.0];
    const KEYS: usize = 32;
    let weights = (0..=KEYS).map(|k| (0.5 - 0.5 * sin_cos(k as f64 / KEYS as f64).1) as f32);
    scene.animations.push(Animation {
        name: "sway".into(),
        duration_s: 4.0,
        channels: vec![Channel {
            node,
            times: (0..=KEYS).map(|k| k as f32 / 8.0).collect(),
            interpolation: Interpolation::Linear,
            values: Keys::MorphWeights {
                count: 1,
                weights: weights.collect(),
            },
        }],
    });
}

/// A joint of the figure: name, parent, offset from the parent's, the limb's end from its own, and
/// the limb's radius; metres.
type Joint = (&'static str, Option<usize>, [f64; 3], [f64; 3], f64);

/// The figure at rest faces +z and stands on y = 0.
const JOINTS: [Joint; 12] = [
    ("hips", None, [0.0, 0.95, 0.0], [0.0, 0.12, 0.0], 0.15),
    ("spine", Some(0), [0.0, 0.2, 0.0], [0.0, 0.15, 0.0], 0.14),
    ("chest", Some(1), [0.0, 0.2, 0.0], [0.0, 0.12, 0.0], 0.16),
    ("head", Some(2), [0.0, 0.34, 0.0], [0.0, 0.1, 0.0], 0.11),
    (
        "left arm",
        Some(2),
        [0.22, 0.12, 0.0],
        [0.04, -0.26, 0.0],
        0.055,
    ),
    (
        "left forearm",
        Some(4),
        [0.04, -0.28, 0.0],
        [0.0, -0.28, 0.03],
        0.045,
    ),
    (
        "right arm",
        Some(2),
        [-0.22, 0.12, 0.0],
        [-0.04, -0.26, 0.0],
        0.055,
    ),
    (
        "right forearm",
        Some(6),
        [-0.04, -0.28, 0.0],
        [0.0, -0.28, 0.03],
        0.045,
    ),
    (
        "left thigh",
        Some(0),
        [0.1, -0.05, 0.0],
        [0.0, -0.4, 0.0],
        0.085,
    ),
    (
        "left shin",
        Some(8),
        [0.0, -0.43, 0.0],
        [0.0, -0.4, 0.0],
        0.065,
    ),
    (
        "right thigh",
        Some(0),
        [-0.1, -0.05, 0.0],
        [0.0, -0.4, 0.0],
        0.085,
    ),
    (
        "right shin",
        Some(10),
        [0.0, -0.43, 0.0],
        [0.0, -0.4, 0.0],
        0.065,
    ),
];

/// Where a joint is in the figure's rest space.
fn rest_place(joint: usize) -> DVec3 {
    let (_, parent, offset, ..) = JOINTS[joint];
    DVec3::from(offset) + parent.map_or(DVec3::ZERO, rest_place)
}

/// The figure's mesh: a capsule a limb, each bent with its parent near the joint; and feet.
fn figure(scene: &mut Scene) -> u32 {
    let mut mesh = Mesh {
        name: "figure".into(),
        ..Mesh::default()
    };
    for (joint, &(_, parent, _, end, radius)) in JOINTS.iter().enumerate() {
        let from = rest_place(joint);
        let to = from + DVec3::from(end);
        capsule(&mut mesh, from, to, radius);
        if joint == 9 || joint == 11 {
            capsule(
                &mut mesh,
                to + DVec3::Y * 0.01,
                to + DVec3::new(0.0, 0.0, 0.16),
                0.05,
            );
        }
        let along = (to - from).normalize();
        for position in &mesh.positions[mesh.joints.len()..] {
            let height = (position.as_dvec3() - from).dot(along);
            // Half the parent's at the joint, none of it one radius into the limb.
            let share = (0.5 - 0.5 * height / radius).clamp(0.0, 1.0) as f32;
            let share = if parent.is_some() { share } else { 0.0 };
            let other = parent.unwrap_or(joint);
            mesh.joints.push([joint as u16, other as u16, 0, 0]);
            mesh.weights.push([1.0 - share, share, 0.0, 0.0]);
        }
    }
    add_mesh(scene, mesh)
}

/// A cylinder between two points with round ends.
fn capsule(mesh: &mut Mesh, from: DVec3, to: DVec3, radius: f64) {
    let along = (to - from).normalize();
    let side = if along.x.abs() < 0.5 {
        DVec3::X
    } else {
        DVec3::Z
    };
    let side = (side - along * side.dot(along)).normalize();
    let third = along.cross(side);
    // Rings: six on each cap, four between.
    surface(mesh, 20, 16, |u, v| {
        let ring = (v * 16.0).round();
        let cap = if ring < 8.0 {
            ring.min(6.0)
        } else {
            ring.max(10.0) - 4.0
        };
        let (height, out) = sin_cos(-0.25 + cap / 24.0);
        let (sin, cos) = sin_cos(u - u.floor());
        // The poles' rings are single points.
        let out = if ring == 0.0 || ring == 16.0 {
            0.0
        } else {
            out
        };
        let normal = along * height + (side * cos + third * sin) * out;
        let middle = from.lerp(to, ((ring - 6.0) / 4.0).clamp(0.0, 1.0));
        (middle + normal * radius, normal)
    });
}

/// A figure that walks along a closed path on the floor.
fn walker(scene: &mut Scene, mesh: u32, path: &[DVec3]) {
    let count = path.len();
    let headings: Vec<DQuat> = (0..=count)
        .map(|k| {
            let way = path[(k + 1) % count] - path[(k + count - 1) % count];
            let way = way.normalize();
            // Half the angle from +z, without its arc cosine.
            let (cos, sin) = (
                ((1.0 + way.z) / 2.0).max(0.0),
                ((1.0 - way.z) / 2.0).max(0.0),
            );
            DQuat::from_xyzw(0.0, sin.sqrt().copysign(way.x), 0.0, cos.sqrt())
        })
        .collect();
    // 1.25 m a stride of 1.2 s, so that the feet slide little.
    let node = lead(
        scene,
        "figure",
        None,
        path,
        &headings,
        path_length(path) / 1.04,
    );
    let first = scene.nodes.len() as u32;
    let skin = scene.skins.len() as u32;
    let mut channels = Vec::new();
    for (joint, &(name, parent, offset, ..)) in JOINTS.iter().enumerate() {
        let joint_node = first + joint as u32;
        scene.nodes.push(Node {
            name: name.into(),
            parent: Some(parent.map_or(node, |parent| first + parent as u32)),
            local: LocalTransform::Trs {
                translation: offset.into(),
                rotation: Quat::IDENTITY,
                scale: Vec3::ONE,
            },
            morph_weights: Vec::new(),
        });
        const KEYS: usize = 24;
        let times: Vec<f32> = (0..=KEYS).map(|k| 0.05 * k as f32).collect();
        let rotations = (0..=KEYS).map(|k| {
            let phase = k as f64 / KEYS as f64;
            let bend = bend(name, phase);
            rotation(DVec3::X * bend).as_quat()
        });
        let values = Keys::Rotation(rotations.collect());
        let interpolation = Interpolation::Linear;
        channels.push(Channel {
            node: joint_node,
            times: times.clone(),
            interpolation,
            values,
        });
        if joint == 0 {
            let bob =
                |k| DVec3::from(offset) + DVec3::Y * (0.02 * sin_cos(k as f64 / 12.0).1 - 0.02);
            let values = Keys::Translation((0..=KEYS).map(|k| bob(k).as_vec3()).collect());
            channels.push(Channel {
                node: joint_node,
                times,
                interpolation,
                values,
            });
        }
    }
    scene.animations.push(Animation {
        name: "walk".into(),
        duration_s: 1.2,
        channels,
    });
    scene.skins.push(Skin {
        joints: (0..JOINTS.len() as u32)
            .map(|joint| first + joint)
            .collect(),
        inverse_bind: (0..JOINTS.len())
            .map(|joint| Mat4::from_translation(-rest_place(joint).as_vec3()))
            .collect(),
    });
    add_instance(scene, mesh, node, Some(skin));
}

/// How far a joint is bent about its x axis, in radians, `phase` turns into the walk.
fn bend(joint: &str, phase: f64) -> f64 {
    let phase = if joint.starts_with("right") {
        phase + 0.5
    } else {
        phase
    };
    let (sin, cos) = sin_cos(phase);
    match joint.split(' ').next_back().unwrap_or(joint) {
        "thigh" => -0.45 * sin,
        // Bent while the leg swings forwards.
        "shin" => 0.45 + 0.4 * cos,
        "arm" => 0.4 * sin,
        "forearm" => -0.35 + 0.15 * sin,
        "spine" => 0.04,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn translation(scene: &Scene, instance: usize, time_s: f64, pose: &mut Pose) -> DVec3 {
        scene.pose(time_s, pose);
        let at = pose.instances[instance].world_from_local;
        Vec3::from(at.translation).as_dvec3() + scene.origin
    }

    fn boulders(scene: &Scene) -> Vec<usize> {
        (0..scene.instances.len())
            .filter(|&i| scene.instances[i].name == "boulder")
            .collect()
    }

    /// A level square floor of 20 m at a height, with walls' worth of height above it.
    fn hall(height: f64) -> Scene {
        let mut scene = Scene::default();
        let mut floor = Mesh::default();
        cuboid(
            &mut floor,
            [-10.0, height - 0.3, -10.0],
            [10.0, height, 10.0],
        );
        cuboid(
            &mut floor,
            [-10.0, height, -10.0],
            [-9.9, height + 6.0, 10.0],
        );
        let floor = add_mesh(&mut scene, floor);
        place(&mut scene, "floor", floor, [0.0; 3], [1.0; 3]);
        scene.finish();
        scene
    }

    #[test]
    fn sine_and_cosine_agree_with_the_platforms() {
        for i in -1000..1000 {
            let turns = f64::from(i) / 173.0;
            let (sin, cos) = sin_cos(turns);
            let (expected_sin, expected_cos) = (turns * TAU).sin_cos();
            assert!((sin - expected_sin).abs() < 1e-14 && (cos - expected_cos).abs() < 1e-14);
        }
    }

    #[test]
    fn a_loop_of_rolling_closes_by_a_gentle_spin() {
        for (x, z, radius) in [
            (1.0, 0.9, 0.5),
            (1.2, 1.05, 0.25),
            (6.0, 2.0, 0.4),
            (3.0, 9.0, 0.6),
        ] {
            let length = path_length(&ellipse(DVec3::ZERO, x, z, 0.0, 256));
            let path = ellipse(DVec3::ZERO, x, z, 0.2, path_points(length, radius));
            let orientations = roll(&path, radius);
            let (first, last) = (orientations[0], orientations[path.len()]);
            assert!(first.dot(last).abs() > 1.0 - 1e-12, "{x} {z} {radius}");
            for k in 0..path.len() {
                let turn = orientations[k + 1] * orientations[k].inverse();
                let turn = if turn.w < 0.0 { -turn } else { turn };
                let vector = DVec3::new(turn.x, turn.y, turn.z);
                let angular = vector.normalize() * 2.0 * vector.length().asin();
                let moved = path[(k + 1) % path.len()] - path[k];
                // The point of contact moves with the centre and around it.
                let slip = moved + angular.cross(DVec3::Y * -radius);
                assert!(slip.length() < 1e-6 * moved.length(), "{slip} of {moved}");
                assert!(angular.y.abs() < angular.length() / 2.0, "spins: {angular}");
            }
        }
    }

    #[test]
    fn boulders_roll_without_slipping_in_the_posed_scene() {
        let atrium = Scene::atrium();
        let mut moved = hall(3.0);
        moved.add_movers(3, 7);
        let mut pose = Pose::default();
        for scene in [&atrium, &moved] {
            for instance in boulders(scene) {
                let mesh = &scene.meshes[scene.instances[instance].mesh as usize];
                let radius: f32 = mesh.positions.iter().map(|p| p.length()).sum::<f32>()
                    / mesh.positions.len() as f32;
                for time_s in [0.31, 2.77, 5.123, 1000.71] {
                    // Over a hundredth of a second, from the orientation and the centre alone.
                    let step = 0.01;
                    let before = translation(scene, instance, time_s, &mut pose);
                    let turned = pose.instances[instance].world_from_local.matrix3;
                    let after = translation(scene, instance, time_s + step, &mut pose);
                    let turn =
                        pose.instances[instance].world_from_local.matrix3 * turned.transpose();
                    let angular = Vec3::new(
                        turn.y_axis.z - turn.z_axis.y,
                        turn.z_axis.x - turn.x_axis.z,
                        turn.x_axis.y - turn.y_axis.x,
                    ) / 2.0;
                    let centre = (after - before).as_vec3();
                    let slip = centre + angular.cross(Vec3::Y * -radius);
                    assert!(centre.length() > 0.002, "{} stands still", mesh.name);
                    assert!(slip.length() < 0.06 * centre.length(), "{slip} of {centre}");
                }
            }
        }
    }

    #[test]
    fn nothing_jumps_where_its_animation_starts_again() {
        let scene = Scene::atrium();
        let mut pose = Pose::default();
        let (mut before, mut after, mut normals) = (Vec::new(), Vec::new(), Vec::new());
        for animation in &scene.animations {
            let end = f64::from(animation.duration_s);
            for instance in 0..scene.instances.len() {
                let mut vertices = |time_s, out: &mut Vec<Vec3>| {
                    scene.pose(time_s, &mut pose);
                    let at = &pose.instances[instance];
                    scene.deform(instance, at, out, &mut normals);
                    out.iter_mut()
                        .for_each(|p| *p = at.world_from_local.transform_point3(*p));
                };
                if scene.instances[instance].moves || scene.instances[instance].deforms {
                    vertices(end - 0.001, &mut before);
                    vertices(end + 0.001, &mut after);
                    // Nothing is faster than 4 m/s.
                    let far = before.iter().zip(&after).map(|(a, b)| a.distance(*b));
                    let far = far.fold(0.0, f32::max);
                    let name = &scene.instances[instance].name;
                    assert!(far < 0.008, "{name} by {far} m as {} ends", animation.name);
                }
            }
        }
    }

    #[test]
    fn the_atriums_boulders_keep_clear_of_columns_and_of_each_other() {
        let scene = Scene::atrium();
        let mut pose = Pose::default();
        let boulders = boulders(&scene);
        assert_eq!(boulders.len(), 6);
        let size = |instance: usize| {
            let mesh = &scene.meshes[scene.instances[instance].mesh as usize];
            f64::from(
                mesh.positions
                    .iter()
                    .map(|p| p.length())
                    .fold(0.0, f32::max),
            )
        };
        for step in 0..300 {
            let time_s = f64::from(step) * 0.17;
            let places: Vec<DVec3> = boulders
                .iter()
                .map(|&i| translation(&scene, i, time_s, &mut pose))
                .collect();
            for (i, &place) in places.iter().enumerate() {
                for x in TALL_COLUMNS_X {
                    let away = DVec3::new(place.x - x, 0.0, place.z - 1.0).length();
                    assert!(away > size(boulders[i]) + 0.28, "{away}");
                }
                for (j, other) in places.iter().enumerate().take(i) {
                    assert!(place.distance(*other) > size(boulders[i]) + size(boulders[j]));
                }
            }
        }
    }

    #[test]
    fn the_figures_walk_on_the_floor() {
        let scene = Scene::atrium();
        let mut pose = Pose::default();
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for instance in 0..scene.instances.len() {
            if scene.instances[instance].skin.is_none() {
                continue;
            }
            for step in 0..60 {
                scene.pose(f64::from(step) * 0.11, &mut pose);
                let at = &pose.instances[instance];
                scene.deform(instance, at, &mut positions, &mut normals);
                let height =
                    |p: &Vec3| at.world_from_local.transform_point3(*p).y + scene.origin.y as f32;
                let low = positions.iter().map(height).fold(f32::INFINITY, f32::min);
                let high = positions.iter().map(height).fold(0.0, f32::max);
                assert!((-0.03..0.1).contains(&low), "{low}");
                assert!((1.6..2.0).contains(&high), "{high}");
            }
        }
    }

    #[test]
    fn movers_stand_on_the_floor_under_their_paths_or_float() {
        let mut pose = Pose::default();
        for height in [0.0, 3.0] {
            let mut scene = hall(height);
            scene.add_movers(5, 1);
            for instance in boulders(&scene) {
                let y = translation(&scene, instance, 1.7, &mut pose).y;
                // 0.02 of 20 m, above the floor.
                assert!((y - height - 0.4).abs() < 1e-4, "{y}");
            }
        }
        // A tall post with nothing around it: no floor.
        let mut scene = Scene::default();
        let mut post = Mesh::default();
        cuboid(&mut post, [-10.0, 0.0, 0.0], [-9.9, 8.0, 0.1]);
        cuboid(&mut post, [10.0, 0.0, 19.9], [10.1, 8.0, 20.0]);
        let post = add_mesh(&mut scene, post);
        place(&mut scene, "post", post, [0.0; 3], [1.0; 3]);
        scene.finish();
        scene.add_movers(3, 1);
        for instance in boulders(&scene) {
            assert!((translation(&scene, instance, 1.7, &mut pose).y - 4.0).abs() < 1e-4);
        }
    }

    #[test]
    fn movers_follow_a_floor_that_rises_and_ignore_what_stands_on_it() {
        let ramp: Vec<Vec<f64>> = (0..200)
            .map(|k| 1.0 - (f64::from(k) / 100.0 - 1.0).abs())
            .map(|y| vec![y])
            .collect();
        let heights = follow_floor(&ramp, 0.4).unwrap();
        assert!(
            heights
                .iter()
                .zip(&ramp)
                .all(|(height, floor)| (height - floor[0]).abs() < 0.05)
        );
        let mut crates = vec![vec![0.0]; 100];
        crates[40..60]
            .iter_mut()
            .for_each(|heights| *heights = vec![0.0, 1.0]);
        assert!(
            follow_floor(&crates, 0.4)
                .unwrap()
                .iter()
                .all(|&height| height == 0.0)
        );
        let mut hole = vec![vec![0.0]; 100];
        hole[40..60].iter_mut().for_each(|heights| heights.clear());
        assert!(
            follow_floor(&hole, 0.4)
                .unwrap()
                .iter()
                .all(|&height| height == 0.0)
        );
        assert!(follow_floor(&vec![Vec::new(); 100], 0.4).is_none());
    }

    #[test]
    fn the_same_seed_gives_the_same_movers_and_far_out_too() {
        let with = |seed, far: f64| {
            let mut scene = hall(0.0);
            scene.transform(glam::DAffine3::from_translation(DVec3::new(far, 0.0, -far)));
            scene.add_movers(3, seed);
            scene
        };
        assert_eq!(with(1, 0.0).hash(), with(1, 0.0).hash());
        assert_ne!(with(1, 0.0).hash(), with(2, 0.0).hash());
        let (near, far) = (with(1, 0.0), with(1, 1e6));
        let (mut near_pose, mut far_pose) = (Pose::default(), Pose::default());
        near.pose(3.3, &mut near_pose);
        far.pose(3.3, &mut far_pose);
        for (a, b) in near_pose.instances.iter().zip(&far_pose.instances) {
            assert!(a.world_from_local.abs_diff_eq(b.world_from_local, 1e-4));
        }
    }
}
