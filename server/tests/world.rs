//! What the world promises: the same result however it is reached, and nothing done in vain.

#[path = "../../tests/small_scene.rs"]
mod small_scene;

use glam::{DAffine3, DVec3, Vec3};
use psao_core::residual::{BLOCK, Quantiser};
use psao_core::{Bucket, Cell, Kernel};
use psao_server::args::camera_path;
use psao_server::camera::Frustum;
use psao_server::encode::{Compression, Encoder, Eye, Limits, Scheme, View};
use psao_server::points::PointError;
use psao_server::rays::Against;
use psao_server::scene::Scene;
use psao_server::world::{Options, World, WorldError};
use small_scene::{FLOOR, MOVER, POST, SHEET, STILL, small_scene, still_scene};
use std::collections::BTreeMap;

fn cells(threshold: u8) -> Scheme {
    Scheme::Cells {
        threshold,
        compression: Compression::Fast,
    }
}

fn residual() -> Scheme {
    let quantiser = Quantiser {
        step: 3,
        dead_zone: 2,
    };
    Scheme::Residual(quantiser, Limits::default())
}

/// As a scheme needs it.
fn laid_out(options: Options, scheme: Scheme) -> Options {
    Options {
        rest_space: matches!(scheme, Scheme::Residual(..)),
        ..options
    }
}

/// Everything, from nowhere in particular.
const VIEW: View<'static> = View {
    sees: &all,
    eye: None,
};

fn options(density: f64, rays: usize) -> Options {
    Options {
        density,
        rays,
        ..Options::of(Kernel::Planar)
    }
}

fn world(scene: Scene, options: Options) -> World {
    World::new(scene, options, &|_, _, _| ()).unwrap()
}

fn all(_: [Vec3; 2]) -> bool {
    true
}

fn converge(world: &mut World) {
    world.converge(&all, usize::MAX, &|_, _| ());
}

/// A world that has seen no other pose than this one.
fn fresh(scene: &Scene, options: &Options, time_s: f64) -> World {
    let mut world = world(scene.clone(), options.clone());
    world.step(time_s, &all, 0);
    converge(&mut world);
    world
}

/// An instance's points by cell, in no order within one.
fn points(world: &World, instance: u32) -> BTreeMap<u32, Vec<u32>> {
    let grid = &world.truth.instances[instance as usize];
    let buckets = grid.bucket_first..grid.bucket_first + grid.bucket_count;
    let mut cells = BTreeMap::new();
    for bucket in buckets {
        for cell in world.truth.buckets[bucket as usize].cells() {
            let cell = &world.truth.cells[cell as usize];
            let mut points: Vec<u32> = cell.points[..cell.len()].iter().map(|p| p.0).collect();
            points.sort();
            cells.insert(cell.key, points);
        }
    }
    cells
}

/// Both say the same: to the bit for what stands, and up to a ray for few points of what moves
/// and is rigid (rays against itself were traced in another pose, and may graze an edge on the
/// other side).
fn assert_same(a: &World, b: &World) {
    for (index, instance) in a.scene.instances.iter().enumerate() {
        let name = format!("{index} {}", instance.name);
        let (a_cells, b_cells) = (points(a, index as u32), points(b, index as u32));
        let values = |cells: &BTreeMap<u32, Vec<u32>>| -> Vec<u32> {
            cells.values().flatten().copied().collect()
        };
        let (a_points, b_points) = (values(&a_cells), values(&b_cells));
        let own = a.slices.iter().filter(|s| s.instance as usize == index);
        let all: usize = own.map(|slice| slice.points.len()).sum();
        let discarded = 2 * all - a_points.len() - b_points.len();
        let same_grid = a.truth.instances[index] == b.truth.instances[index];
        assert!(same_grid || instance.deforms, "{name}: another grid");
        if instance.deforms && (!same_grid || discarded > 0) {
            // Where something bends, its grid depends on where it has been, and who came first into
            // a cell, and with these which points have no room; what the others say does not.
            let mut more = [0i32; 256];
            a_points
                .iter()
                .for_each(|point| more[(point & 0xff) as usize] += 1);
            b_points
                .iter()
                .for_each(|point| more[(point & 0xff) as usize] -= 1);
            let other = more
                .iter()
                .map(|more| more.unsigned_abs() as usize)
                .sum::<usize>();
            assert!(discarded < 20, "{name}: {discarded} discarded");
            assert!(other <= discarded, "{name}: {other} values differ");
            continue;
        }
        assert!(a_cells.keys().eq(b_cells.keys()), "{name}: other cells");
        assert_eq!(a_points.len(), b_points.len(), "{name}: number of points");
        let ray = 255 / a.options.rays as u32 + 1;
        let off = |a: u32, b: u32| match a >> 8 == b >> 8 {
            true => (a & 0xff).abs_diff(b & 0xff),
            false => 255,
        };
        let pairs = a_points.iter().zip(&b_points);
        let off: Vec<u32> = pairs
            .map(|(a, b)| off(*a, *b))
            .filter(|&off| off > 0)
            .collect();
        let most = off.iter().max().copied().unwrap_or(0);
        let few = if !instance.deforms && (instance.moves || index as u32 == STILL) {
            1 + a_points.len() / 100
        } else {
            0
        };
        let (count, all) = (off.len(), a_points.len());
        assert!(
            count <= few && most <= ray,
            "{name}: {count} of {all} points differ, by up to {most}"
        );
    }
}

/// Buckets and cells are compact, nothing is named twice, and every point is there or discarded.
fn assert_sound(world: &World) {
    let truth = &world.truth;
    let mut named = vec![0; truth.cells.len()];
    let mut keys = std::collections::HashSet::new();
    for (index, bucket) in truth.buckets.iter().enumerate() {
        let used = bucket.entries.iter().filter(|&&cell| cell != 0).count();
        assert_eq!(
            bucket.cells().count(),
            used,
            "an empty entry before a used one"
        );
        let instance = world.instance_of_bucket(index as u32);
        for cell in bucket.cells() {
            named[cell as usize] += 1;
            assert_eq!(truth.home(cell), index as u32);
            let key = truth.cells[cell as usize].key;
            assert!(
                keys.insert((instance, key)),
                "{instance} has cell {key} twice"
            );
        }
    }
    let mut stored = 0;
    for (cell, data) in truth.cells.iter().enumerate() {
        let used = data
            .points
            .iter()
            .filter(|point| point.is_allocated())
            .count();
        assert_eq!(data.len(), used, "an empty place before a used one");
        assert_eq!(
            named[cell],
            i32::from(!data.is_empty()),
            "cell {cell} is named"
        );
        stored += used;
    }
    assert_eq!(stored + world.discarded(), world.point_count());
    assert_eq!(
        truth.used_cells() as usize,
        named.iter().filter(|&&n| n == 1).count()
    );
}

#[test]
fn points_truth_and_stream_are_the_same_on_any_number_of_threads() {
    let run = |scene: Scene, scheme: Scheme, threads: usize| -> (Vec<Bucket>, Vec<Cell>, Vec<u8>) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let mut world = world(scene, laid_out(options(64.0, 64), scheme));
            converge(&mut world);
            let mut encoder = Encoder::new(&world, scheme, 0);
            let mut bytes = encoder.header(&world, world.scene.hash(), 30.0);
            for frame in 0..4 {
                world.step(f64::from(frame) * 0.1, &all, u64::MAX);
                encoder.merge(&world);
                world.clear_changes();
                encoder.frame(&world, 0, &VIEW, true, &mut bytes);
            }
            let mirror = encoder.mirror();
            (mirror.buckets().to_vec(), mirror.cells().to_vec(), bytes)
        })
    };
    for scene in [small_scene(), Scene::atrium()] {
        for scheme in [cells(2), residual()] {
            let name = format!("{} {scheme:?}", scene.name);
            let once = run(scene.clone(), scheme, 2);
            assert!(once == run(scene.clone(), scheme, 2), "{name}: twice");
            assert!(once == run(scene.clone(), scheme, 1), "{name}: 1 thread");
        }
    }
}

#[test]
fn a_still_scene_costs_no_ray_and_no_byte_once_it_has_converged() {
    for scheme in [cells(0), residual()] {
        let mut world = world(still_scene(), laid_out(options(256.0, 64), scheme));
        let mut encoder = Encoder::new(&world, scheme, 0);
        let (mut rays, mut bytes) = (Vec::new(), Vec::new());
        for frame in 0..6 {
            let step = world.step(f64::from(frame), &all, u64::MAX);
            encoder.merge(&world);
            world.clear_changes();
            let mut stream = Vec::new();
            let stats = encoder.frame(&world, 0, &VIEW, false, &mut stream);
            assert_eq!(stats.bytes, stream.len() as u64);
            assert!(step.rays_if_all > 0);
            rays.push(step.rays);
            bytes.push(stats.bytes);
        }
        assert!(rays[0] > 0 && bytes[0] > 0);
        assert_eq!(rays[1..], [0; 5]);
        assert_eq!(bytes[1..], [0; 5]);
    }
}

#[test]
fn converging_within_a_budget_ends_where_converging_at_once_does() {
    let options = options(128.0, 200);
    let at_once = fresh(&small_scene(), &options, 0.0);
    let mut slowly = world(small_scene(), options);
    let mut steps = 0;
    loop {
        // Less than all slices need in any stage, and enough for the largest one.
        let stats = slowly.step(0.0, &all, 70_000);
        steps += 1;
        if stats.converging == 0 {
            break;
        }
        assert!(steps < 100, "{} slices never converge", stats.converging);
    }
    assert!(steps > 3, "the budget held nothing back");
    assert_same(&slowly, &at_once);
}

#[test]
fn what_is_not_traced_again_could_not_have_changed() {
    for (scene, options) in [
        (small_scene(), options(256.0, 64)),
        (Scene::atrium(), options(48.0, 64)),
    ] {
        let mut stepped = world(scene.clone(), options.clone());
        converge(&mut stepped);
        let (mut rays, mut rays_if_all) = (0, 0);
        for time in [0.03, 0.1, 0.2, 0.9, 1.0, 1.1] {
            let stats = stepped.step(time, &all, u64::MAX);
            rays += stats.rays;
            rays_if_all += stats.rays_if_all;
            assert_sound(&stepped);
        }
        assert!(
            rays * 2 < rays_if_all,
            "{}: {rays} of {rays_if_all}",
            scene.name
        );
        let mut fresh = world(scene, options);
        // The same grids, where something has left its own on the way.
        fresh.step(0.9, &all, 0);
        fresh.step(1.0, &all, 0);
        fresh.step(1.1, &all, 0);
        converge(&mut fresh);
        assert_same(&stepped, &fresh);
    }
}

#[test]
fn points_that_take_turns_are_all_up_to_date_some_steps_after_the_last_move() {
    for scheme in [cells(0), residual()] {
        let options = laid_out(options(256.0, 64), scheme);
        let mut at_once = world(small_scene(), options.clone());
        let mut in_turns = world(small_scene(), options);
        for world in [&mut at_once, &mut in_turns] {
            converge(world);
        }
        in_turns.options.refresh_rays = 10_000;
        let (left, mut lagged, mut rays) = (|[_, max]: [Vec3; 2]| max.x < 50.0, false, [0, 0]);
        for step in 1..=12 {
            let time = f64::from(step) * 0.05;
            // For a while, some are not seen; they miss no turn.
            let some = |bounds: [Vec3; 2]| !(4..=6).contains(&step) || left(bounds);
            let (all, part) = (
                at_once.step(time, &some, u64::MAX),
                in_turns.step(time, &some, 0),
            );
            rays = [rays[0] + all.rays, rays[1] + part.rays];
            assert_eq!(all.waiting, 0);
            lagged |= part.waiting > 0 && !says_the_same(&at_once, &in_turns);
        }
        assert!(lagged && rays[1] * 2 < rays[0], "{rays:?}: none waited");
        let mut steps = 0;
        while in_turns.step(0.6, &all, 0).waiting > 0 {
            steps += 1;
            assert!(steps < 100, "some never have their turn");
            // The server may change its mind on the way.
            in_turns.options.refresh_rays += 1000;
        }
        at_once.step(0.6, &all, 0);
        assert!(steps > 0 && says_the_same(&at_once, &in_turns));
        assert_eq!(in_turns.step(0.6, &all, 0).rays, 0);
    }
}

#[test]
fn a_step_spends_the_rays_that_it_may_however_dense_and_new_the_points_are() {
    const BUDGET: u64 = 100_000;
    let mut world = world(small_scene(), laid_out(options(2560.0, 64), residual()));
    converge(&mut world);
    world.options.refresh_rays = BUDGET;
    let mut spent = Vec::new();
    for step in 1..=20 {
        let stats = world.step(f64::from(step) * 0.05, &all, 0);
        assert!(stats.waiting > 0, "step {step}: all had their turn");
        spent.push(stats.rays as f64 / BUDGET as f64);
    }
    // Nothing was known before the first.
    for (step, spent) in (1..).zip(&spent).skip(1) {
        assert!(*spent < 1.5, "step {step}: {spent} of the budget");
    }
    let mean = spent[1..].iter().sum::<f64>() / (spent.len() - 1) as f64;
    assert!(
        (0.85..1.15).contains(&mean),
        "{mean} of the budget: {spent:?}"
    );
}

/// To the bit.
fn says_the_same(a: &World, b: &World) -> bool {
    let mut slices = a.slices.iter().zip(&b.slices);
    slices.all(|(of_a, of_b)| a.occlusion(of_a) == b.occlusion(of_b))
}

#[test]
fn a_step_with_few_rays_spends_them_where_most_has_changed() {
    let options = laid_out(options(256.0, 64), residual());
    let mut worlds = [0; 3].map(|_| world(small_scene(), options.clone()));
    let off = |a: &World, b: &World| -> f64 {
        let points = |world: &World| -> Vec<u8> {
            let said = |slice| world.occlusion(slice).to_vec();
            world.slices.iter().flat_map(said).collect()
        };
        let pairs = points(a).into_iter().zip(points(b));
        pairs.map(|(a, b)| f64::from(a.abs_diff(b)).powi(2)).sum()
    };
    worlds.iter_mut().for_each(converge);
    let [in_turns, at_once, left] = &mut worlds;
    let (mut lag, mut stale, mut rays) = (0.0, 0.0, [0; 3]);
    for step in 1..=20 {
        let time = f64::from(step) * 0.05;
        rays[1] += at_once.step(time, &all, 0).rays;
        in_turns.options.refresh_rays = rays[1] / step as u64 * 15 / 64;
        rays[0] += in_turns.step(time, &all, 0).rays;
        // All of it, in every fourth step.
        if step % 4 == 0 {
            rays[2] += left.step(time, &all, 0).rays;
        }
        lag += off(in_turns, at_once);
        stale += off(left, at_once);
    }
    assert!(
        rays[0] <= rays[2],
        "{rays:?}: more than in turns of four steps"
    );
    assert!(lag < stale, "{rays:?} {lag} against {stale}");
}

#[test]
fn points_that_face_no_eye_wait_until_they_face_one() {
    let options = laid_out(options(1024.0, 64), residual());
    let mut whole = world(small_scene(), options.clone());
    let mut seen = world(small_scene(), options);
    for world in [&mut whole, &mut seen] {
        converge(world);
    }
    // The floor faces up.
    let below = (DVec3::new(50.2, -3.0, 0.1) - seen.scene.origin).as_vec3();
    let mut rays = [0, 0];
    for step in 1..=10 {
        seen.eyes = vec![below];
        for (world, rays) in [&mut whole, &mut seen].into_iter().zip(&mut rays) {
            *rays += world.step(f64::from(step) * 0.05, &all, 0).rays;
        }
        for (slice, other) in seen.slices.iter().zip(&whole.slices) {
            let faces = seen.facing(slice, below);
            let blocks = seen.occlusion(slice).chunks(BLOCK);
            for (block, pair) in blocks.zip(whole.occlusion(other).chunks(BLOCK)).enumerate() {
                assert!(faces.any >> block & 1 == 0 || pair.0 == pair.1, "{block}");
            }
        }
    }
    assert!(rays[1] * 10 < rays[0] * 9, "{rays:?}");
    assert!(!says_the_same(&whole, &seen));
    seen.eyes.clear();
    seen.step(0.5, &all, 0);
    assert!(says_the_same(&whole, &seen));
}

#[test]
fn points_of_levels_that_no_client_has_wait_until_one_has_them() {
    const COARSE: u32 = 2;
    let options = Options {
        levels: true,
        ..laid_out(options(256.0, 64), residual())
    };
    let mut whole = world(small_scene(), options.clone());
    let mut thin = world(small_scene(), options);
    for world in [&mut whole, &mut thin] {
        converge(world);
    }
    thin.finest_levels = vec![COARSE; thin.scene.instances.len()];
    let mut rays = [0, 0];
    // At the end what moved is where it was not, and where it was it no longer is.
    for time in [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 1.1] {
        for (world, rays) in [&mut whole, &mut thin].into_iter().zip(&mut rays) {
            *rays += world.step(time, &all, 0).rays;
        }
        for (slice, other) in thin.slices.iter().zip(&whole.slices) {
            let pairs = thin.occlusion(slice).iter().zip(whole.occlusion(other));
            for ((said, truth), level) in pairs.zip(thin.levels(slice)) {
                assert!(u32::from(*level) < COARSE || said == truth);
            }
        }
    }
    assert!(rays[1] * 2 < rays[0], "{rays:?}");
    assert!(!says_the_same(&whole, &thin));
    thin.finest_levels.clear();
    thin.step(1.1, &all, 0);
    assert!(says_the_same(&whole, &thin));
}

#[test]
fn in_rest_space_blocks_that_no_mover_reaches_are_left_alone_and_say_the_truth() {
    let options = laid_out(options(256.0, 64), residual());
    let mut stepped = world(small_scene(), options.clone());
    converge(&mut stepped);
    for time in [0.03, 0.1, 0.2, 0.9, 1.0, 1.1] {
        stepped.step(time, &all, 0);
    }
    let fresh = fresh(&small_scene(), &options, 1.1);
    for (slice, other) in stepped.slices.iter().zip(&fresh.slices) {
        if [FLOOR, STILL].contains(&slice.instance) {
            assert_eq!(stepped.occlusion(slice), fresh.occlusion(other));
        }
    }
}

#[test]
fn what_moved_out_of_view_is_up_to_date_when_it_is_seen_again() {
    let (scene, options) = (small_scene(), options(256.0, 64));
    let mut stepped = world(scene.clone(), options.clone());
    converge(&mut stepped);
    let left = |[min, max]: [Vec3; 2]| (min + max).x < 0.0;
    let mut skipped = 0;
    for step in 1..=20 {
        let before = stepped.truth.clone();
        stepped.step(f64::from(step) * 0.05, &left, u64::MAX);
        skipped += u32::from(before == stepped.truth);
    }
    assert!(skipped < 20, "nothing was seen");
    stepped.step(1.0, &all, u64::MAX);
    assert_same(&stepped, &fresh(&scene, &options, 1.0));
}

#[test]
fn an_instance_that_a_client_moves_takes_its_shadow_along() {
    let options = options(256.0, 64);
    let to = DAffine3::from_translation(DVec3::new(50.7, 0.2, 0.4));
    let mut moved = world(still_scene(), options.clone());
    converge(&mut moved);
    moved.drive(STILL, to).unwrap();
    moved.step(0.0, &all, u64::MAX);
    converge(&mut moved);
    let mut scene = still_scene();
    let at = psao_server::scene::LocalTransform::Matrix(to);
    scene.nodes[scene.instances[STILL as usize].node as usize].local = at;
    let mut there = world(scene, options);
    converge(&mut there);
    assert_same(&moved, &there);
    // A second move is one of something that moves already.
    let back = DAffine3::from_translation(DVec3::new(50.0, 0.2, 0.0));
    moved.drive(STILL, back).unwrap();
    moved.step(0.1, &all, u64::MAX);
    let mut never = world(still_scene(), moved.options.clone());
    converge(&mut never);
    assert_same(&moved, &never);
}

#[test]
fn an_instance_or_joints_that_are_not_there_cannot_be_driven() {
    let mut world = world(small_scene(), options(16.0, 16));
    let said = world.drive(99, DAffine3::IDENTITY).unwrap_err().to_string();
    assert!(said.contains("99"), "{said}");
    for (instance, joints) in [(POST, 1), (POST, 3), (MOVER, 2), (99, 2)] {
        let joints = vec![glam::Affine3A::IDENTITY; joints];
        assert!(world.drive_joints(instance, joints).is_err());
    }
    assert!(
        world
            .drive_joints(POST, vec![glam::Affine3A::IDENTITY; 2])
            .is_ok()
    );
}

#[test]
fn a_transform_that_makes_no_sense_harms_nothing_else() {
    let mut world = world(small_scene(), options(64.0, 32));
    converge(&mut world);
    let huge = DAffine3::from_translation(DVec3::splat(1e300));
    let flat = DAffine3::from_scale(DVec3::new(1.0, 0.0, 1.0));
    let nothing = DAffine3::from_scale(DVec3::ZERO);
    let large = DAffine3::from_scale(DVec3::splat(1e30));
    for transform in [huge, flat, nothing, large] {
        for instance in [STILL, MOVER, SHEET, POST] {
            world.drive(instance, transform).unwrap();
        }
        let joints = vec![glam::Affine3A::from_scale(Vec3::splat(1e30)); 2];
        world.drive_joints(POST, joints).unwrap();
        world.step(0.5, &all, u64::MAX);
        assert_sound(&world);
    }
    let away = DAffine3::from_translation(DVec3::new(50.0, 100.0, 0.0));
    for instance in [STILL, MOVER, SHEET, POST] {
        world.drive(instance, away).unwrap();
    }
    world.step(0.6, &all, u64::MAX);
    converge(&mut world);
    let open = points(&world, FLOOR);
    let mut open = open.values().flatten().map(|point| point & 0xff);
    assert!(
        open.all(|occlusion| occlusion == 255),
        "nothing is near the floor"
    );
}

#[test]
fn what_bends_out_of_its_grid_gets_another_and_is_found_there() {
    let mut world = world(small_scene(), options(512.0, 32));
    converge(&mut world);
    let grids = [SHEET, POST].map(|i| world.truth.instances[i as usize]);
    for step in 0..60 {
        world.step(f64::from(step) * 0.05, &all, u64::MAX);
        assert_sound(&world);
        let lookup = psao_core::Lookup {
            instances: &world.truth.instances,
            buckets: &world.truth.buckets,
            cells: &world.truth.cells,
        };
        for instance in [SHEET, POST] {
            let (positions, normals) = world.vertices(instance);
            let mesh = &world.scene.meshes[world.scene.instances[instance as usize].mesh as usize];
            let (mut found, mut asked) = (0, 0);
            for corners in &mesh.triangles {
                let middle =
                    |v: &[Vec3]| corners.iter().map(|&i| v[i as usize]).sum::<Vec3>() / 3.0;
                let (position, normal) = (middle(positions), middle(normals));
                let answer = lookup.blend(
                    Kernel::Planar,
                    instance,
                    position.to_array(),
                    normal.to_array(),
                );
                asked += 1;
                found += u32::from(answer.weight > 0.0);
            }
            assert!(
                found * 20 >= asked * 19,
                "step {step}: {found} of {asked} on {instance}"
            );
        }
    }
    assert_ne!(
        grids[0], world.truth.instances[SHEET as usize],
        "it was meant to leave its grid"
    );
}

#[test]
fn discarded_points_are_counted() {
    // Cells of the paper's size are too large for seven points each.
    let paper = Options {
        density: 512.0,
        ..Options::of(Kernel::Paper)
    };
    let mut full = world(small_scene(), paper);
    assert!(full.discarded() > 0);
    assert_sound(&full);
    for step in 0..10 {
        full.step(f64::from(step) * 0.1, &all, 0);
        assert_sound(&full);
    }
    let roomy = world(small_scene(), options(512.0, 16));
    assert!(roomy.discarded() * 100 < roomy.point_count());
    assert_sound(&roomy);
}

#[test]
fn a_density_that_asks_for_too_much_is_refused_before_memory_is_taken() {
    let refused = |scene: Scene, density: f64| {
        let made = World::new(scene, options(density, 16), &|_, _, _| ());
        made.err().expect("it is refused")
    };
    for density in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = refused(still_scene(), density);
        assert!(
            matches!(error, WorldError::Points(PointError::Density(_))),
            "{error}"
        );
        assert!(error.to_string().contains("--density"), "{error}");
    }
    // 9 m² of floor: more than one mesh may have, and then more than a scene may.
    let error = refused(still_scene(), 3e6);
    assert!(
        matches!(error, WorldError::Points(PointError::TooMany { .. })),
        "{error}"
    );
    assert!(error.to_string().contains("lower --density"), "{error}");
    let error = refused(still_scene(), 3e7);
    assert!(
        matches!(error, WorldError::TooManyPoints(count) if count > 270_000_000),
        "{error}"
    );
    assert!(error.to_string().contains("lower --density"), "{error}");
    // Each mesh alone would be within its limit.
    let mut many = still_scene();
    let floor = many.instances[0].clone();
    many.instances.resize(9, floor);
    let error = refused(many, 1.5e6);
    assert!(matches!(error, WorldError::TooManyPoints(_)), "{error}");
}

#[test]
fn a_new_view_is_all_but_whole_in_its_first_frame() {
    let options = laid_out(options(768.0, 16), residual());
    let mut world = world(Scene::atrium(), options);
    let path = camera_path(&world, 1, 1.6).unwrap();
    world.step(0.0, &all, u64::MAX);
    let mut encoder = Encoder::new(&world, residual(), 0);
    encoder.header(&world, 1, 60.0);
    // The second is a cut to another place.
    for time in [0.0, 20.0] {
        let camera = path.at(time);
        let frustum = Frustum::new(&camera, 0.2);
        let view = View {
            sees: &|[min, max]| frustum.sees_box(min, max),
            eye: Some(Eye::of(&camera, 360)),
        };
        encoder.frame(&world, 0, &view, true, &mut Vec::new());
        let has = encoder.slices().unwrap().get();
        let (mut seen, mut missing, mut left) = (0, 0, 0);
        for (slice, has) in world.slices.iter().zip(has) {
            for number in slice.points.clone().step_by(9) {
                let [at, normal] = world.point_in_world(slice.instance, number);
                let (way, far) = (camera.position - at).normalize_and_length();
                let clear = || {
                    let (origin, mut hit) = (at + normal * 1e-3, [0]);
                    let tracer = world.tracer();
                    tracer.occluded(Against::All, origin, &[way], far, &[1], &mut hit);
                    hit == [0]
                };
                let shows =
                    view.needs(&world, slice.instance, number) && way.dot(normal) > 0.0 && clear();
                seen += usize::from(shows);
                missing += usize::from(shows && has.point_count == 0);
            }
            left += usize::from((view.sees)(slice.bounds) && has.point_count == 0);
        }
        assert!(
            missing * 100 < seen,
            "{missing} of {seen} points, at {time} s"
        );
        assert!(left > 0, "nothing is behind anything at {time} s");
    }
}

#[test]
fn the_slices_near_a_place_are_those_with_points_there() {
    let options = Options {
        rest_space: true,
        ..options(512.0, 64)
    };
    let world = world(small_scene(), options);
    let mut others = 0;
    for (index, slice) in world.slices.iter().enumerate() {
        for number in slice.points.clone().step_by(7) {
            let (position, _) = world.grid_point(slice.instance, number);
            let near: Vec<u32> = world.slices_near(slice.instance, position).collect();
            assert!(
                near.contains(&(index as u32)),
                "{position} of slice {index}"
            );
            let all = world.slices_of(slice.instance).len();
            others += usize::from(near.len() < all);
        }
    }
    assert!(others > 0, "every place is near every slice");
    assert_eq!(world.slices_near(0, Vec3::splat(1e9)).count(), 0);
}
