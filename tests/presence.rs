//! Instances that go and come while a stream runs.

#[allow(dead_code)] // Each test takes what it needs.
mod small_scene;

use glam::{DAffine3, DVec3, Vec3};
use psao::{Client, Config};
use psao_core::Kernel;
use psao_core::residual::Quantiser;
use psao_server::encode::{Encoder, Limits, Scheme, View, capacity_of};
use psao_server::world::{Options, World};
use small_scene::{FLOOR, STILL, still_scene};

fn world() -> World {
    let options = Options {
        density: 300.0,
        rest_space: true,
        ..Options::of(Kernel::Planar)
    };
    World::new(still_scene(), options, &|_, _, _| ()).expect("the scene is small")
}

fn floor(world: &World) -> Vec<u8> {
    let slices = world.slices.iter().filter(|slice| slice.instance == FLOOR);
    slices
        .flat_map(|slice| world.occlusion(slice).to_vec())
        .collect()
}

fn settle(world: &mut World, time_s: f64) {
    while world.step(time_s, &|_| true, u64::MAX).converging > 0 {}
    world.step(time_s, &|_| true, u64::MAX);
}

#[test]
fn what_goes_takes_its_shadow_along_and_brings_it_back() {
    let mut world = world();
    settle(&mut world, 0.0);
    let before = floor(&world);
    assert!(
        before.iter().any(|&open| open < 200),
        "the box darkens the floor"
    );

    world.set_present(STILL, false).expect("there is a box");
    settle(&mut world, 1.0);
    let mut elsewhere = self::world();
    let away = DAffine3::from_translation(DVec3::new(0.0, 1e4, 0.0));
    elsewhere.drive(STILL, away).expect("there is a box");
    settle(&mut elsewhere, 0.0);
    settle(&mut elsewhere, 1.0);
    assert_eq!(floor(&world), floor(&elsewhere));
    assert!(
        floor(&world).iter().all(|&open| open == 255),
        "a floor alone is open"
    );

    world.set_present(STILL, true).expect("there is a box");
    settle(&mut world, 2.0);
    assert_eq!(floor(&world), before);
    assert!(world.set_present(99, false).is_err());
}

#[test]
fn a_client_follows_an_instance_that_goes_and_comes() {
    let mut world = world();
    let quantiser = Quantiser {
        step: 3,
        dead_zone: 2,
    };
    let scheme = Scheme::Residual(quantiser, Limits::default());
    let mut encoder = Encoder::new(&world, scheme, 0);
    let mut client = Client::new(Config {
        capacity: capacity_of(&world),
        scene_hash: 0,
    });
    let mut bytes = encoder.header(&world, 0, 30.0);
    let top = Vec3::new(0.0, 0.2, 0.0);
    let mut seen = Vec::new();
    for frame in 0..9u32 {
        world
            .set_present(STILL, !(3..6).contains(&frame))
            .expect("there is a box");
        settle(&mut world, f64::from(frame));
        encoder.merge(&world);
        world.clear_changes();
        let view = View {
            sees: &|_| true,
            eye: None,
        };
        encoder.frame(&world, u64::from(frame), &view, true, &mut bytes);
        while !bytes.is_empty() {
            let pushed = client.push(&bytes).expect("an own stream");
            bytes.drain(..pushed.consumed);
        }
        assert_eq!(client.mirror().hash(), encoder.mirror().hash());
        assert_eq!(client.mirror().hash(), client.mirror().recompute_hash());
        let lookup = client.mirror().lookup();
        let answer = lookup.blend(Kernel::Planar, STILL, top.to_array(), [0.0, 1.0, 0.0]);
        let there = client.mirror().instances()[STILL as usize].bucket_count > 0;
        assert!(there || answer.openness == 1.0);
        seen.push(there);
    }
    let expected = [true, true, true, false, false, false, true, true, true];
    assert_eq!(seen, expected);
}
