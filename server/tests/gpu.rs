//! What runs on a GPU says what the processor says. On machines without one it runs on Mesa's
//! lavapipe (Debian: mesa-vulkan-drivers).
#![cfg(feature = "gpu")]

use psao_server::camera::Camera;
use psao_server::gpu::Gpu;
use psao_server::gpu::gbuffer::{GBuffer, Renderer};
use psao_server::render::View;
use psao_server::scene::Scene;
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
    let mut world = World::new(Scene::atrium(), options, &|_, _, _| ()).expect("the built-in scene");
    world.step(time_s, &|_| false, 0);
    world
}

fn camera(world: &World, aspect: f32) -> Camera {
    psao_server::args::camera_path(world, 0, aspect).expect("a path").at(world.pose.time_s)
}

#[test]
fn the_gbuffer_shows_what_the_processors_rays_see() {
    let gpu = gpu();
    let world = atrium(2.5);
    let (width, height) = (240, 135);
    let mut renderer = Renderer::new(&gpu, &world.scene, true).expect("a small scene");
    renderer.pose(&gpu, &world.scene, &world.pose);
    let mut buffer = GBuffer::new(&gpu, width, height).expect("a small picture");
    let camera = camera(&world, width as f32 / height as f32);
    let mut encoder = gpu.encoder();
    renderer.draw(&gpu, &world.scene, &camera, &mut encoder, &mut buffer);
    gpu.finish(encoder).expect("a device");

    let drawn = buffer.view(&gpu).expect("a device");
    let cast = View::new(&world, &camera, width as usize, height as usize);
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
    assert!(instances.len() > 5, "{} instances are not much of a test", instances.len());
    assert!(same as f64 > 0.995 * all as f64, "{same} of {all} pixels show the same instance");
    assert!(near as f64 > 0.995 * same as f64, "{near} of {same} pixels show the same place");
    assert!(
        faces_the_same_way as f64 > 0.995 * same as f64,
        "{faces_the_same_way} of {same} pixels have the same normal"
    );
}
