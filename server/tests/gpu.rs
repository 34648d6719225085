//! What runs on a GPU says what the processor says. On machines without one it runs on Mesa's
//! lavapipe (Debian: mesa-vulkan-drivers).
#![cfg(feature = "gpu")]

use clap::Parser;
use psao_server::bench_gpu::{self, BenchGpuArgs};
use psao_server::camera::Camera;
use psao_server::gpu::Gpu;
use psao_server::gpu::gbuffer::{GBuffer, Renderer};
use psao_server::gpu::screen::{self, HIGH, LOW, Quality, Source};
use psao_server::gpu::trace::{GpuTracer, Ray, StillTracer};
use psao_server::metrics::Pair;
use psao_server::rays::{Against, Fan, FanTracer, offset_origin};
use psao_server::render::{REFERENCE_RAYS, View};
use psao_server::samples::Samples;
use psao_server::scene::{Instance, LocalTransform, Mask, Mesh, Node, Scene, Wrap};
use psao_server::world::{Options, World};

fn gpu() -> Gpu {
    Gpu::open().expect("a Vulkan driver: apt-get install mesa-vulkan-drivers")
}

/// Few points: these tests are of pictures.
fn atrium(time_s: f64) -> World {
    let options = Options {
        density: 4.0,
        rays: 16,
        rest_space: true,
        ..Options::of(psao_core::Kernel::Planar)
    };
    let mut world =
        World::new(Scene::atrium(), options, &|_, _, _| ()).expect("the built-in scene");
    world.step(time_s, &|_| false, 0);
    world
}

fn camera(world: &World, aspect: f32) -> Camera {
    psao_server::args::camera_path(world, 0, aspect)
        .expect("a path")
        .at(world.pose.time_s)
}

/// The world drawn from the camera.
fn drawn(gpu: &Gpu, world: &World, camera: &Camera, size: [u32; 2]) -> (Renderer, GBuffer) {
    let mut renderer = Renderer::new(gpu, &world.scene, true).expect("a small scene");
    renderer.pose(gpu, &world.scene, &world.pose);
    let mut buffer = GBuffer::new(gpu, size[0], size[1]).expect("a small picture");
    let mut encoder = gpu.encoder();
    renderer.draw(gpu, &world.scene, camera, &mut encoder, &mut buffer);
    gpu.finish(encoder).expect("a device");
    (renderer, buffer)
}

#[test]
fn the_gbuffer_shows_what_the_processors_rays_see() {
    let gpu = gpu();
    let world = atrium(2.5);
    let (width, height) = (240, 135);
    let camera = camera(&world, width as f32 / height as f32);
    let (_, buffer) = drawn(&gpu, &world, &camera, [width, height]);

    compare(&gpu, &world, &camera, &buffer, 5);
}

/// Holds what is drawn to what the processor's rays see: more than so many instances.
fn compare(gpu: &Gpu, world: &World, camera: &Camera, buffer: &GBuffer, more_than: usize) {
    let drawn = buffer.view(gpu).expect("a device");
    let [width, height] = buffer.size;
    let cast = View::new(world, camera, width as usize, height as usize);
    let mut instances = std::collections::BTreeSet::new();
    let (mut same, mut near, mut faces_the_same_way) = (0, 0, 0);
    for (drawn, cast) in drawn.fragments.iter().zip(&cast.fragments) {
        let index = |f: &Option<psao_server::render::Fragment>| f.map(|f| f.instance);
        if index(drawn) != index(cast) {
            continue;
        }
        same += 1;
        let (Some(drawn), Some(cast)) = (drawn, cast) else {
            near += 1;
            faces_the_same_way += 1;
            continue;
        };
        instances.insert(drawn.instance);
        near += usize::from(drawn.position.distance(cast.position) < 1e-3);
        faces_the_same_way += usize::from(drawn.normal.dot(cast.normal) > 0.999);
    }
    let all = drawn.fragments.len();
    println!(
        "{} instances; of {all} pixels {same} show the same, {near} the same place, \
         {faces_the_same_way} the same normal",
        instances.len()
    );
    assert!(
        instances.len() > more_than,
        "{} instances are not much of a test",
        instances.len()
    );
    assert!(
        same as f64 > 0.995 * all as f64,
        "{same} of {all} pixels show the same instance"
    );
    assert!(
        near as f64 > 0.995 * same as f64,
        "{near} of {same} pixels show the same place"
    );
    assert!(
        faces_the_same_way as f64 > 0.995 * same as f64,
        "{faces_the_same_way} of {same} pixels have the same normal"
    );
}

#[test]
fn each_ray_hits_on_the_gpu_what_it_hits_on_the_processor() {
    let gpu = gpu();
    let mut world = atrium(0.0);
    let samples = Samples::new(64);
    let mut tracer =
        GpuTracer::new(&gpu, &world.scene, &world.pose, &samples).expect("a small scene");
    for time_s in [0.0, 3.25] {
        world.step(time_s, &|_| false, 0);
        tracer
            .pose(&gpu, &world.scene, &world.pose)
            .expect("a small scene");
        // From what the camera sees, all ways and far: many near misses.
        let view = View::new(&world, &camera(&world, 2.0), 40, 20);
        let seen: Vec<_> = view.fragments.iter().flatten().collect();
        let mut rays = Vec::new();
        let mut expected = Vec::new();
        for (number, fragment) in (0..).zip(&seen) {
            let at = world.pose.instances[fragment.instance as usize].world_from_local;
            let posed = !world.scene.instances[fragment.instance as usize].deforms;
            let origin = at.transform_point3(fragment.position)
                + at.transform_vector3(fragment.normal).normalize() * 0.01;
            let mut directions = vec![glam::Vec3::ZERO; 64];
            let normal = if number % 2 == 0 {
                fragment.normal
            } else {
                -fragment.normal
            };
            samples.directions(number, normal, glam::Vec3::X, &mut directions);
            for t_max in [0.6, 30.0] {
                let mut hit = [0];
                if posed {
                    let todo = [u64::MAX];
                    let all = Against::All;
                    world
                        .tracer()
                        .occluded(all, origin, &directions, t_max, &todo, &mut hit);
                    expected.extend((0..64).map(|i| hit[0] >> i & 1 == 1));
                    rays.extend(directions.iter().map(|&direction| Ray {
                        origin,
                        t_max,
                        direction,
                        unused: 0.0,
                    }));
                }
            }
        }
        let found = tracer.occluded(&gpu, &rays).expect("a device");
        assert_eq!(found.len(), expected.len());
        let blocked = expected.iter().filter(|hit| **hit).count();
        let differ = found.iter().zip(&expected).filter(|(a, b)| a != b).count();
        println!(
            "at {time_s} s: of {} rays {blocked} hit, {differ} differ",
            rays.len()
        );
        assert!(
            blocked * 5 > rays.len() && blocked < rays.len() / 20 * 19,
            "not much of a test"
        );
        // Those that graze an edge: one computes movers' in local space.
        assert!(
            differ * 20_000 <= rays.len(),
            "{differ} of {} rays differ",
            rays.len()
        );
    }
}

/// A ray that the processor answers one way or the other when it is moved by a few roundings.
fn is_on_edge(world: &World, fan: &Fan<'_>, index: usize, t_max: f32) -> bool {
    let direction = fan.direction(index);
    let (a, b) = direction.any_orthonormal_pair();
    let size = fan.origin.abs().max_element().max(1.0);
    let mut answers = std::collections::BTreeSet::new();
    for turn in 0..24 {
        let (sin, cos) = (turn as f32).sin_cos();
        let aside = (a * cos + b * sin) * (1 + turn % 3) as f32;
        let longer = 1.0 + (turn % 5 - 2) as f32 * 2e-6;
        let origin = fan.origin + aside * size * 1e-6;
        let directions = [(direction + aside * 1e-6).normalize()];
        let mut hit = [0];
        let (tracer, group) = (world.tracer(), Against::Static);
        tracer.occluded(group, origin, &directions, t_max * longer, &[1], &mut hit);
        answers.insert(hit[0]);
    }
    answers.len() == 2
}

#[test]
fn each_ray_of_a_fan_hits_on_the_gpu_what_it_hits_on_the_processor_unless_it_grazes() {
    let world = atrium(0.0);
    let samples = Samples::new(200);
    let device = StillTracer::open(&world.scene, &world.pose, 200, world.moves());
    let device = device.expect("a Vulkan driver: apt-get install mesa-vulkan-drivers");
    let mut fans = Vec::new();
    for slice in &world.slices {
        let reach = world.reach(slice.instance);
        for number in slice.points.clone().step_by(2) {
            let [position, normal] = world.point_in_world(slice.instance, number);
            let origin = offset_origin(position, normal, reach);
            fans.push(samples.fan(number, origin, normal, glam::Vec3::X));
        }
    }
    // One that starts nowhere hits nothing, and does no harm to others.
    fans[7].origin = glam::Vec3::NAN;
    let words = fans[0].directions.words();
    let mut todo = vec![0; fans.len() * words];
    // The first of each set, but for some that are known to hit.
    let (mut found, mut expected) = (todo.clone(), todo.clone());
    for ((fan, todo), found) in fans
        .iter()
        .zip(todo.chunks_mut(words))
        .zip(found.chunks_mut(words))
    {
        fan.directions.mark_given(0..128, todo);
        found[1] = 0b1011;
    }
    expected.copy_from_slice(&found);
    let t_max = 2.0;
    device
        .occluded_fans(&fans, t_max, &todo, &mut found)
        .expect("a device");
    let bits = todo.chunks(words).zip(expected.chunks_mut(words));
    for (fan, (todo, hit)) in fans.iter().zip(bits) {
        let tracer = world.tracer();
        tracer.occluded_fan(Against::Static, fan, t_max, todo, hit);
    }
    let blocked: u32 = expected.iter().map(|word| word.count_ones()).sum();
    let rays = fans.len() * 128;
    let mut differ = 0;
    for (word, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let differing = (0..64).filter(|bit| (found ^ expected) >> bit & 1 == 1);
        for bit in differing {
            let (fan, index) = (&fans[word / words], word % words * 64 + bit);
            differ += 1;
            assert!(
                is_on_edge(&world, fan, index, t_max),
                "fan {}, ray {index}: {found:x}, {expected:x}",
                word / words
            );
        }
    }
    println!("of {rays} rays {blocked} hit, {differ} differ");
    assert!(
        blocked as usize * 5 > rays && (blocked as usize) < rays / 20 * 19,
        "not much of a test"
    );
    assert!(differ * 20_000 <= rays, "{differ} of {rays} rays differ");
}

/// The built-in scene, all of it converged, before and after things have moved, one of them that
/// stood still; on the GPU what stands still.
fn occlusion(on_gpu: bool) -> [Vec<u8>; 2] {
    let options = Options {
        density: 12.0,
        rays: 128,
        rest_space: true,
        ..Options::of(psao_core::Kernel::Planar)
    };
    let mut world =
        World::new(Scene::atrium(), options, &|_, _, _| ()).expect("the built-in scene");
    if on_gpu {
        let device = StillTracer::open(&world.scene, &world.pose, 128, world.moves());
        let device = device.expect("a Vulkan driver: apt-get install mesa-vulkan-drivers");
        world.trace_still_on(Box::new(device));
    }
    let said = |world: &World| {
        let points = 0..world.point_count() as u32;
        points.map(|point| world.occlusion_of(point)).collect()
    };
    world.converge(&|_| true, usize::MAX, &|_, _| ());
    let before = said(&world);
    let still = world.moves().iter().position(|moves| !moves);
    let still = still.expect("an instance that stands still") as u32;
    let place = world.pose.instances[still as usize].world_from_local;
    let mut moved = glam::DAffine3::from_mat3_translation(
        place.matrix3.as_dmat3(),
        place.translation.as_dvec3() + world.scene.origin,
    );
    moved.translation.y += 0.1;
    world.drive(still, moved).expect("it is there");
    world.step(1.5, &|_| true, 0);
    world.converge(&|_| true, usize::MAX, &|_, _| ());
    assert_eq!(world.has_device(), on_gpu);
    [before, said(&world)]
}

#[test]
fn all_points_say_the_same_whether_the_gpu_or_the_processor_traces_what_stands_still() {
    for (on_gpu, on_cpu) in occlusion(true).iter().zip(&occlusion(false)) {
        let off = on_gpu.iter().zip(on_cpu).map(|(a, b)| a.abs_diff(*b));
        let differ = off.clone().filter(|off| *off > 0).count();
        let most = off.max().unwrap_or(0);
        let dark = on_cpu.iter().filter(|said| **said < 200).count();
        println!(
            "of {} points ({dark} dark) {differ} say something else, {most}/255 at most",
            on_cpu.len()
        );
        assert!(dark * 20 > on_cpu.len(), "not much of a test");
        // A ray that grazes an edge: 2/255 of a point of 128 rays.
        assert!(
            differ * 200 <= on_cpu.len() && most <= 2,
            "{differ} of {} points, by up to {most}/255",
            on_cpu.len()
        );
    }
}

#[test]
fn pixels_traced_on_the_gpu_are_those_traced_on_the_processor() {
    let gpu = gpu();
    let world = atrium(1.0);
    let size = [64, 36];
    let camera = camera(&world, 16.0 / 9.0);
    let (renderer, buffer) = drawn(&gpu, &world, &camera, size);
    let samples = Samples::new(REFERENCE_RAYS);
    let tracer = GpuTracer::new(&gpu, &world.scene, &world.pose, &samples).expect("small");
    let openness = gpu.openness(size).expect("a small picture");
    let mut encoder = gpu.encoder();
    for first in (0..REFERENCE_RAYS as u32).step_by(128) {
        let t_max = world.options.ao_distance_m;
        let rays = [first, 128];
        tracer
            .pixels(&gpu, &buffer, &renderer, &openness, t_max, rays)
            .record(&mut encoder);
    }
    gpu.finish(encoder).expect("a device");
    let found: Vec<f32> = gpu.read_texture(&openness).expect("a device");
    let view = buffer.view(&gpu).expect("a device");
    let expected = view.trace(&world, &samples);
    let pair = Pair::new(&expected, &found, &view.valid(), 64, 36).expect("one size");
    println!("PSNR {:.1} dB between two references", pair.psnr_db());
    // Both are turned at random; each has an error of its own of about 50 dB.
    assert!(pair.psnr_db() > 44.0, "{} dB", pair.psnr_db());
}

/// A floor and a wall that meet at a right angle, 40 m each way.
fn corner_scene() -> Scene {
    use glam::Vec3;
    let quad = |a: Vec3, b: Vec3, c: Vec3, d: Vec3, normal: Vec3| Mesh {
        positions: vec![a, b, c, d],
        normals: vec![normal; 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Mesh::default()
    };
    let at = |x: f32, y: f32, z: f32| Vec3::new(x, y, z) * 20.0;
    let floor = [
        at(-1.0, 0.0, 0.0),
        at(-1.0, 0.0, 2.0),
        at(1.0, 0.0, 2.0),
        at(1.0, 0.0, 0.0),
    ];
    let wall = [
        at(-1.0, 0.0, 0.0),
        at(1.0, 0.0, 0.0),
        at(1.0, 2.0, 0.0),
        at(-1.0, 2.0, 0.0),
    ];
    let instance = |mesh: u32| Instance {
        name: String::new(),
        mesh,
        node: 0,
        skin: None,
        moves: false,
        deforms: false,
    };
    let [a, b, c, d] = floor;
    let [e, f, g, h] = wall;
    Scene {
        meshes: vec![quad(a, b, c, d, Vec3::Y), quad(e, f, g, h, Vec3::Z)],
        nodes: vec![Node {
            name: String::new(),
            parent: None,
            local: LocalTransform::IDENTITY,
            morph_weights: Vec::new(),
        }],
        instances: vec![instance(0), instance(1)],
        ..Scene::default()
    }
}

/// The corner, and in it two sheets that are seen from both sides and full of holes, one of them
/// mirrored; and a wall that is seen from its front alone.
fn holed_scene() -> Scene {
    let mut scene = corner_scene();
    let mut sheet = scene.meshes[1].clone();
    sheet
        .positions
        .iter_mut()
        .for_each(|p| *p = *p * 0.06 + glam::Vec3::Y * 0.1);
    let mut wall = sheet.clone();
    wall.triangles = vec![[0, 2, 1], [0, 3, 2]];
    wall.normals.iter_mut().for_each(|n| *n = -*n);
    let corners = [[0.0, 0.0], [2.3, 0.4], [2.0, 2.7], [-0.3, 2.0]];
    sheet.uvs = corners.map(glam::Vec2::from).to_vec();
    sheet.double_sided = true;
    sheet.mask = Some(Mask {
        width: 5,
        height: 4,
        alpha: (0..20u32).map(|i| (i * 97 % 256) as u8).collect(),
        cutoff: 0.5,
        wrap: [Wrap::Repeat, Wrap::Mirror],
    });
    scene.meshes.extend([sheet, wall]);
    for (mesh, x, z, mirror, moves) in [
        (2, -1.6, 2.0, 1.0, false),
        (2, 1.4, 2.5, -1.0, true),
        (3, 0.0, 4.0, 1.0, false),
    ] {
        scene.instances.push(Instance {
            mesh,
            node: scene.nodes.len() as u32,
            moves,
            ..scene.instances[0].clone()
        });
        scene.nodes.push(Node {
            local: LocalTransform::Trs {
                translation: glam::DVec3::new(x, 0.0, z),
                rotation: glam::Quat::from_rotation_y(0.4 * mirror),
                scale: glam::Vec3::new(mirror, 1.0, 1.0),
            },
            ..scene.nodes[0].clone()
        });
    }
    scene
}

#[test]
fn holes_and_backs_and_mirrored_surfaces_are_what_they_are_on_the_processor() {
    let gpu = gpu();
    let options = Options {
        density: 0.5,
        rays: 1,
        rest_space: true,
        ..Options::of(psao_core::Kernel::Planar)
    };
    let world = World::new(holed_scene(), options, &|_, _, _| ()).expect("a small scene");
    let camera = Camera {
        position: glam::Vec3::new(0.0, 1.5, 6.0),
        forward: glam::Vec3::new(0.0, -0.1, -1.0),
        up: glam::Vec3::Y,
        fov_y_rad: 1.0,
        aspect: 2.0,
        near: 0.05,
        far: f32::INFINITY,
    };
    let (_, buffer) = drawn(&gpu, &world, &camera, [240, 120]);
    compare(&gpu, &world, &camera, &buffer, 3);

    let samples = Samples::new(64);
    let tracer = GpuTracer::new(&gpu, &world.scene, &world.pose, &samples).expect("small");
    let (mut rays, mut expected) = (Vec::new(), Vec::new());
    for number in 0..400 {
        let origin = glam::Vec3::new((number % 20) as f32 * 0.3 - 3.0, 0.4, number as f32 * 0.012);
        let mut directions = vec![glam::Vec3::ZERO; 64];
        samples.directions(number, glam::Vec3::Y, glam::Vec3::X, &mut directions);
        let (mut hit, all) = ([0], Against::All);
        world
            .tracer()
            .occluded(all, origin, &directions, 5.0, &[u64::MAX], &mut hit);
        expected.extend((0..64).map(|i| hit[0] >> i & 1 == 1));
        let ray = |&direction| Ray {
            origin,
            t_max: 5.0,
            direction,
            unused: 0.0,
        };
        rays.extend(directions.iter().map(ray));
    }
    let found = tracer.occluded(&gpu, &rays).expect("a device");
    let differ = found.iter().zip(&expected).filter(|(a, b)| a != b).count();
    let blocked = expected.iter().filter(|hit| **hit).count();
    println!("of {} rays {blocked} hit, {differ} differ", rays.len());
    assert!(
        blocked > 3000 && blocked < rays.len() - 3000,
        "not much of a test"
    );
    // A ray through the edge of a texel may round to either side of it.
    assert!(
        differ * 5000 <= rays.len(),
        "{differ} of {} rays differ",
        rays.len()
    );
}

/// Openness at `distance` from an endless wall at a right angle, by rays of length `radius`: those
/// that meet the wall are a segment of the disc that the cosine-weighted hemisphere projects to.
fn beside_a_wall(distance: f32, radius: f32) -> f32 {
    let c = (distance / radius).min(1.0);
    1.0 - (c.acos() - c * (1.0 - c * c).sqrt()) / std::f32::consts::PI
}

#[test]
fn screen_space_occlusion_of_a_corner_is_the_closed_forms() {
    let gpu = gpu();
    let scene = corner_scene();
    let (size, radius_m) = ([320u32, 240u32], 0.6);
    let camera = Camera {
        position: glam::Vec3::new(0.0, 1.5, 3.0),
        forward: glam::Vec3::new(0.0, -0.35, -1.0),
        up: glam::Vec3::Y,
        fov_y_rad: 1.0,
        aspect: 4.0 / 3.0,
        near: 0.05,
        far: f32::INFINITY,
    };
    let renderer = Renderer::new(&gpu, &scene, true).expect("a small scene");
    let mut buffer = GBuffer::new(&gpu, size[0], size[1]).expect("a small picture");
    let mut encoder = gpu.encoder();
    renderer.draw(&gpu, &scene, &camera, &mut encoder, &mut buffer);
    gpu.finish(encoder).expect("a device");
    let view = buffer.view(&gpu).expect("a device");
    let openness = gpu.openness(size).expect("a small picture");
    let errors = |quality: Quality| {
        // Nothing is behind these surfaces.
        let source = Source::Screen {
            quality,
            radius_m,
            thickness_m: 1e3,
            power: 1.0,
        };
        let mut encoder = gpu.encoder();
        for pass in screen::passes(&gpu, &buffer, source, &openness).expect("small") {
            pass.record(&mut encoder);
        }
        gpu.finish(encoder).expect("a device");
        let found: Vec<f32> = gpu.read_texture(&openness).expect("a device");
        let (mut sum, mut bias, mut count) = (0.0, 0.0, 0.0);
        for (pixel, fragment) in view.fragments.iter().enumerate() {
            let Some(fragment) = fragment else { continue };
            let at = [pixel % size[0] as usize, pixel / size[0] as usize];
            // Occluders must be in the picture, and no nearer than some pixels.
            let inside = |at: usize, edge: u32| at > 60 && at < edge as usize - 60;
            let to_wall = fragment.position.y.max(fragment.position.z);
            if inside(at[0], size[0]) && inside(at[1], size[1]) && to_wall > 0.05 {
                let error = found[pixel] - beside_a_wall(to_wall, radius_m);
                sum += error.abs();
                bias += error;
                count += 1.0;
            }
        }
        assert!(count > 5000.0, "{count} pixels are not much of a test");
        (sum / count, bias / count)
    };
    let fine = errors(Quality {
        slices: 16,
        steps: 32,
        denoise: 0,
    });
    let (high, low) = (errors(HIGH), errors(LOW));
    println!("mean |error| and mean error: 16 x 32 {fine:?}, high {high:?}, low {low:?}");
    assert!(fine.0 < 0.01, "the method itself: {fine:?}");
    // Few samples miss the top of the wall: a bias that any number of passes keeps.
    assert!(high.0 < 0.03, "high: {high:?}");
    assert!(low.0 < 0.05, "low: {low:?}");
}

#[derive(Parser)]
struct Bench {
    #[command(flatten)]
    args: BenchGpuArgs,
}

#[test]
fn the_race_checks_and_times_every_method_and_keeps_its_pictures() {
    let folder = tempfile::tempdir().expect("a folder");
    let (out, json) = (folder.path().join("out"), folder.path().join("race.json"));
    let args = "psao --density 16 --rays 32 --size 96x54 --frames 2".split(' ');
    let mut args = Bench::parse_from(args).args;
    (args.out, args.json) = (Some(out.clone()), Some(json.clone()));
    let race = bench_gpu::run(&args, &|_, _, _| ()).expect("a device that times");
    println!("{}", race.table());
    assert!(race.exact_off_255 <= 1.0 && race.fast_off_255 <= 4.0);
    assert_eq!(race.rows.len(), 7);
    for row in &race.rows {
        assert!(
            row.median_ms > 0.0 && row.p95_ms >= row.median_ms,
            "{row:?}"
        );
        assert!(row.psnr_db > 5.0 && row.psnr_db.is_finite(), "{row:?}");
        assert!(
            row.passes.iter().all(|pass| pass.median_ms > 0.0),
            "{row:?}"
        );
    }
    let why = race.no_ray_query.expect("nobody asked for ray queries");
    assert!(
        race.table()
            .contains(&format!("| 1 ray a pixel, ray query    | {why}"))
    );
    let of = |name: &str| {
        race.rows
            .iter()
            .find(|row| row.method == name)
            .expect("a method")
    };
    // The fast lookup against both exact ones: the smaller of the two ratios is told.
    let exact = ["lookup, exact", "lookup, exact, paper kernel"].map(|name| of(name).over_fast);
    let told = format!("at least {:.2} times fewer ms", exact[0].min(exact[1]));
    assert!(race.table().contains(&told), "{told}");
    // Noise, and the same without some of it.
    let noisy = of("1 ray a pixel");
    assert!(of("1 ray a pixel, denoised").psnr_db > noisy.psnr_db + 6.0);
    // More work, a better picture.
    assert!(of("screen space, high").psnr_db > of("screen space, low").psnr_db);
    let page = std::fs::read_to_string(out.join("report.html")).expect("a report");
    assert_eq!(page.matches("<svg").count(), 2);
    let pictures = std::fs::read_dir(&out).expect("a folder").count();
    assert_eq!(pictures, 1 + 2 * 8, "a report, and eight pictures a frame");
    let json = std::fs::read_to_string(&json).expect("figures");
    assert!(json.contains("\"median_ms\"") && json.contains("\"adapter\""));
}
