//! What the server sends when: budgets, room, levels of detail, meshes that are shared.

use crate::samples::{NO_LIMITS, QUANTISER, config, contents, left_out, scene, values};
use glam::Vec3;
use psao::core::mirror::Capacity;
use psao::core::residual::BLOCK;
use psao::core::stream::{MAX_BODY_BYTES, Packet, flag};
use psao::{Client, State};
use psao_server::camera::Camera;
use psao_server::encode::{Encoder, Eye, FrameStats, Limits, Scheme, View, capacity_of};
use psao_server::facing::{AWAY, Faces};
use psao_server::scene::{LocalTransform, Scene};
use psao_server::world::{Options, World};

/// A world, one client's encoder, and that client.
struct Watched {
    world: World,
    encoder: Encoder,
    client: Client,
    /// Lengths of the packets that came.
    packets: Vec<usize>,
    /// All bits of [`flag::COARSE`] that they had.
    coarse: u8,
}

pub fn all(_: [Vec3; 2]) -> bool {
    true
}

/// No point is off by as much while its slice waits for being a little off.
const LITTLE: u8 = 5 * (QUANTISER.dead_zone + 1);

/// Frames that a slice waits at most.
const PATIENCE: u32 = 3;

const EVERYTHING: View<'_> = View {
    sees: &all,
    eye: None,
};

impl Watched {
    fn new(scene: Scene, density: f64, limits: Limits) -> Watched {
        let options = Options {
            density,
            rays: 128,
            rest_space: true,
            levels: limits.points_per_pixel > 0.0,
            ..Options::of(psao::core::Kernel::Planar)
        };
        let world = World::new(scene, options, &|_, _, _| ()).unwrap();
        let room = config(capacity_of(&world));
        Watched::with(world, limits, Client::new(room), 0)
    }

    /// `has`: the hash of the patches that the client says it has.
    fn with(world: World, limits: Limits, mut client: Client, has: u64) -> Watched {
        let mut encoder = Encoder::new(&world, Scheme::Residual(QUANTISER, limits), has);
        let header = encoder.header(&world, 0, 30.0);
        client.push(&header).unwrap();
        Watched {
            world,
            encoder,
            client,
            packets: Vec::new(),
            coarse: 0,
        }
    }

    /// A frame of the world as it is at that time, sent if it says anything new. The client has
    /// then what the encoder believes it to have.
    fn frame(&mut self, time_s: f64, view: &View<'_>) -> FrameStats {
        self.world.step(time_s, &|_| true, 200_000);
        self.encoder.merge(&self.world);
        self.world.clear_changes();
        let mut bytes = Vec::new();
        let time_ns = (time_s * 1e9) as u64;
        let sent = self
            .encoder
            .frame(&self.world, time_ns, view, false, &mut bytes);
        assert_eq!(sent.bytes, bytes.len() as u64);
        let pushed = self.client.push(&bytes).unwrap();
        assert_eq!(pushed.consumed, bytes.len());
        assert_eq!(pushed.frame.is_some(), !bytes.is_empty());
        let (mine, theirs) = (self.client.mirror(), self.encoder.mirror());
        assert!(contents(mine) == contents(theirs), "the mirrors differ");
        let theirs = self.encoder.slices().unwrap();
        assert!(values(self.client.slices()) == values(theirs));
        let mut rest = &bytes[..];
        while let Some((packet, length)) = Packet::read(rest, MAX_BODY_BYTES).unwrap() {
            self.packets.push(length);
            self.coarse |= packet.flags & flag::COARSE;
            rest = &rest[length..];
        }
        sent
    }

    /// How far off the points that the view needs are at most, in 1/255, by the slices' values; those
    /// of slices that are not open say 255.
    fn error(&self, view: &View<'_>) -> u8 {
        errors(&self.world, &self.client, view)[0]
    }

    /// What the client shows at all points of the scene.
    fn picture(&self) -> Vec<f32> {
        let lookup = self.client.mirror().lookup();
        let kernel = self.world.options.kernel;
        let slices = self.world.slices.iter();
        let points = slices.flat_map(|slice| slice.points.clone().map(|p| (slice.instance, p)));
        points
            .map(|(instance, number)| {
                let (position, normal) = self.world.grid_point(instance, number);
                let (position, normal) = (position.to_array(), normal.to_array());
                lookup.blend(kernel, instance, position, normal).openness
            })
            .collect()
    }
}

/// How far off a client's points are at most: those in view that may show, and the others.
fn errors(world: &World, client: &Client, view: &View<'_>) -> [u8; 2] {
    let slices = client.slices();
    let mut most = [0; 2];
    for (slice, open) in world.slices.iter().zip(slices.get()) {
        if !(view.sees)(slice.bounds) {
            continue;
        }
        let level = client.mirror().instances()[slice.instance as usize].level;
        let mut have = slices.values(open).iter();
        let points = world.occlusion(slice).iter().zip(world.levels(slice));
        for (number, (want, has)) in slice.points.clone().zip(points) {
            if u32::from(*has) >= level {
                let most = &mut most[usize::from(!view.needs(world, slice.instance, number))];
                *most = want
                    .abs_diff(have.next().copied().unwrap_or(255))
                    .max(*most);
            }
        }
    }
    most
}

/// Looks at the middle of the scene from a height; a negative one is below the floor.
fn from_height(height: f32) -> View<'static> {
    let camera = Camera {
        position: Vec3::Y * height,
        forward: Vec3::NEG_Y * height,
        up: Vec3::Z,
        fov_y_rad: 1.0,
        aspect: 1.0,
        near: 0.1,
        far: 100.0,
    };
    View {
        sees: &all,
        eye: Some(Eye::of(&camera, 1000)),
    }
}

fn still_scene() -> Scene {
    let mut scene = scene();
    scene.animations.clear();
    scene
}

#[test]
fn a_still_scene_sends_no_bytes_once_it_has_converged() {
    let mut watched = Watched::new(still_scene(), 400.0, NO_LIMITS);
    let mut sent = Vec::new();
    for _ in 0..40 {
        sent.push(watched.frame(0.0, &EVERYTHING).bytes);
    }
    let last = sent.iter().rposition(|bytes| *bytes > 0).unwrap();
    assert!((1..30).contains(&last), "{sent:?}");
    assert!(watched.error(&EVERYTHING) <= QUANTISER.bound());
}

#[test]
fn what_is_a_little_off_waits_for_more_but_not_for_long() {
    let mut watched = Watched::new(scene(), 800.0, NO_LIMITS);
    let mut waited = 0;
    watched.frame(0.0, &EVERYTHING);
    for frame in 1..30 {
        // Slowly, so that little changes at a time.
        let time_s = f64::from(frame) * 0.001;
        watched.frame(time_s, &EVERYTHING);
        let error = watched.error(&EVERYTHING);
        assert!(error < LITTLE, "frame {frame}: {error}");
        waited += u32::from(error > QUANTISER.bound());
    }
    assert!(waited > 5, "in {waited} frames");
    for _ in 0..PATIENCE {
        watched.frame(0.029, &EVERYTHING);
    }
    assert!(watched.error(&EVERYTHING) <= QUANTISER.bound());
}

#[test]
fn what_faces_away_is_not_sent_until_the_camera_comes_round_and_then_at_once() {
    let mut watched = Watched::new(scene(), 800.0, NO_LIMITS);
    let (above, below) = (from_height(3.0), from_height(-3.0));
    watched.frame(0.0, &EVERYTHING);
    let mut bytes = [0, 0];
    for frame in 1..30 {
        let time_s = f64::from(frame) * 0.03;
        let view = if frame < 15 { &above } else { &below };
        bytes[usize::from(frame < 15)] += watched.frame(time_s, view).bytes;
        let [shows, hidden] = errors(&watched.world, &watched.client, view);
        assert!(shows < LITTLE, "frame {frame}: {shows}");
        // What the box casts its shadow on turns its back to the camera below.
        assert!(frame < 20 || hidden > 20, "frame {frame}: {hidden}");
    }
    assert!(bytes[1] > 0 && bytes[0] > 0, "{bytes:?}");
    // What is left as it is costs nothing once all else stands still.
    for _ in 0..=PATIENCE {
        watched.frame(0.87, &below);
    }
    let sent = watched.frame(0.87, &below);
    let counted = FrameStats {
        encode_ns: 0,
        ..sent
    };
    assert_eq!(counted, FrameStats::default());
    assert!(errors(&watched.world, &watched.client, &below)[1] > 20);
    let sent = watched.frame(0.87, &above);
    assert!(watched.error(&above) < LITTLE && sent.bytes > 0);
    for _ in 0..PATIENCE {
        watched.frame(0.87, &above);
    }
    assert!(watched.error(&above) <= QUANTISER.bound());
}

#[test]
fn clients_that_look_from_two_sides_get_each_what_it_sees_of_the_same_slices() {
    let mut watched = Watched::new(scene(), 800.0, NO_LIMITS);
    let world = &mut watched.world;
    let scheme = Scheme::Residual(QUANTISER, NO_LIMITS);
    let views = [from_height(3.0), from_height(-3.0)];
    let mut clients = [0, 1].map(|_| {
        let encoder = Encoder::new(world, scheme, 0);
        (encoder, Client::new(config(capacity_of(world))))
    });
    for frame in 0..20 {
        world.step(frame as f64 * 0.04, &all, u64::MAX);
        for ((encoder, client), view) in clients.iter_mut().zip(&views) {
            encoder.merge(world);
            let mut bytes = match frame {
                0 => encoder.header(world, 0, 30.0),
                _ => Vec::new(),
            };
            let first = if frame == 0 { &EVERYTHING } else { view };
            encoder.frame(world, frame, first, true, &mut bytes);
            let mut rest = &bytes[..];
            while !rest.is_empty() {
                rest = &rest[client.push(rest).unwrap().consumed..];
            }
            let [shows, _] = errors(world, client, view);
            assert!(shows < LITTLE, "frame {frame}: {shows}");
        }
        world.clear_changes();
    }
    let [left, right] = clients
        .each_ref()
        .map(|(_, client)| values(client.slices()));
    assert!(left != right, "neither lacks what the other has");
}

#[test]
fn no_point_that_faces_the_eye_is_in_a_block_that_does_not_whatever_moves_and_bends() {
    let mut watched = Watched::new(scene(), 800.0, NO_LIMITS);
    let world = &mut watched.world;
    let (mut facing, mut left) = (0, 0);
    for step in 0..12 {
        let angle = f32::from(step as u8);
        let eye = Vec3::new(angle.sin(), angle.cos(), (angle * 1.7).sin()) * 1.5;
        world.step(f64::from(step) * 0.08, &all, 0);
        for slice in &world.slices {
            let Faces { any, all } = world.facing(slice, eye);
            for (at, number) in slice.points.clone().enumerate() {
                let [position, normal] = world.point_in_world(slice.instance, number);
                let faces = normal.dot((eye - position).normalize()) > 0.0;
                let [left_out, kept] = [any, all].map(|blocks| blocks >> (at / BLOCK) & 1 == 0);
                assert!(!(faces && left_out), "step {step}, point {number}");
                let away = normal.dot((eye - position).normalize()) < AWAY - 0.01;
                assert!(!away || kept, "step {step}, point {number}");
                (facing, left) = (facing + u32::from(faces), left + u32::from(left_out));
            }
        }
    }
    assert!(left * 20 > facing, "{left} left out, {facing} face the eye");
}

#[test]
fn instances_of_one_mesh_share_its_patches_which_come_once() {
    let mut scene = still_scene();
    let mut other = scene.instances[1].clone();
    other.node = scene.nodes.len() as u32;
    let mut node = scene.nodes[1].clone();
    if let LocalTransform::Trs { translation, .. } = &mut node.local {
        translation.x += 0.7;
    }
    scene.nodes.push(node);
    scene.instances.push(other);
    let mut watched = Watched::new(scene, 1500.0, NO_LIMITS);
    let sets = watched.world.topology.of_instance.clone();
    assert_eq!(sets[1], sets[3]);
    let count = watched.world.topology.patches();
    let slices = watched.world.slices.len() as u32;
    assert!(
        count > 4 && slices > count,
        "{slices} slices of {count} patches"
    );
    let (mut patches, mut opened) = (0, 0);
    // One after the other comes into view, goes, and comes again after a snapshot.
    for frame in 0..8 {
        let near = |bounds: [Vec3; 2]| bounds[0].x < -0.6 + 0.4 * (frame % 4) as f32;
        let view = View {
            sees: &near,
            eye: None,
        };
        if frame == 4 {
            watched.encoder.resync();
        }
        let sent = watched.frame(0.0, &view);
        (patches, opened) = (patches + sent.patches, opened + sent.opened);
    }
    assert_eq!((patches, opened), (count, 2 * slices));
    assert_eq!(watched.client.stats().patches, u64::from(count));

    // Who has all of them from a recording is sent none.
    let world = watched.world;
    let scheme = Scheme::Residual(QUANTISER, NO_LIMITS);
    let mut encoder = Encoder::new(&world, scheme, 0);
    let mut recording = encoder.header(&world, 0, 30.0);
    encoder.all_patches(&world, &mut recording);
    encoder.end(&mut recording);
    let mut client = Client::new(config(capacity_of(&world)));
    assert_eq!(client.topology_hash(), 0);
    client.push(&recording).unwrap();
    assert_eq!(client.state(), State::Ended);
    let has = client.topology_hash();
    assert_eq!(has, world.topology.hash);
    client.restart();
    // Its room for points is another, but not that for patches.
    let limits = Limits {
        points: capacity_of(&world).points * 17 / 20,
        ..NO_LIMITS
    };
    let mut watched = Watched::with(world, limits, client, has);
    let sent = watched.frame(0.0, &EVERYTHING);
    assert_eq!(sent.patches, 0);
    assert!(sent.opened > 4, "{sent:?}");
}

#[test]
fn a_budget_holds_over_any_half_second_and_the_largest_errors_go_first() {
    let limits = Limits {
        max_mbit: 0.2,
        ..NO_LIMITS
    };
    let mut watched = Watched::new(scene(), 2500.0, limits);
    let mut sent = Vec::new();
    let (mut waited, mut compared) = (0, 0);
    let mut owed = vec![0; watched.world.slices.len()];
    for frame in 0..200 {
        // Half of the time nothing moves, so that what waits can go out.
        let time_s = f64::from(frame.min(100)) * 0.01;
        let had: Vec<bool> = watched
            .client
            .slices()
            .get()
            .iter()
            .map(|s| s.point_count > 0)
            .collect();
        let stats = watched.frame(time_s, &EVERYTHING);
        sent.push(stats.bytes as f64);
        waited += stats.waiting;
        // Of what is not there yet, that comes first whose error, over all frames, is largest.
        let slices = watched
            .world
            .slices
            .iter()
            .zip(watched.client.slices().get());
        let (mut come, mut wait) = (Vec::new(), Vec::new());
        for (((slice, open), had), owed) in slices.zip(had).zip(&mut owed) {
            let dark = watched.world.occlusion(slice).iter();
            *owed += dark.map(|o| u64::from(255 - o).pow(2) + 1).sum::<u64>();
            match (had, open.point_count > 0) {
                (true, _) => {}
                (false, true) => come.push(*owed),
                (false, false) => wait.push(*owed),
            }
        }
        if let (Some(least), Some(most)) = (come.iter().min(), wait.iter().max()) {
            // The encoder adds as f32.
            let least_may_be = most - most / 100_000;
            assert!(
                *least >= least_may_be,
                "frame {frame}: {least} before {most}"
            );
            compared += 1;
        }
    }
    assert!(
        waited > 20 && compared > 2,
        "{waited} waited, {compared} compared"
    );
    let budget = limits.max_mbit * 1e6 / 8.0 * 0.5;
    // What is over: a slice and its patch, a packet each.
    let over = 2.0 * *watched.packets.iter().max().unwrap() as f64;
    let most = sent
        .windows(15)
        .map(|half| half.iter().sum::<f64>())
        .fold(0.0, f64::max);
    assert!(
        most <= budget + over,
        "{most} bytes in half a second, not {budget} + {over}"
    );
    assert!(
        most > 0.9 * budget,
        "the budget is meant to be needed: {most}"
    );
    // What went out in coarse steps while room was short has become as exact as all else.
    assert!(watched.coarse > 0);
    assert_eq!(sent[199], 0.0);
    assert!(watched.error(&EVERYTHING) <= QUANTISER.bound());
}

#[test]
fn a_client_with_too_little_room_has_what_is_in_view() {
    for by_cells in [false, true] {
        let mut watched = Watched::new(scene(), 2500.0, NO_LIMITS);
        let need = capacity_of(&watched.world);
        let limits = match by_cells {
            false => Limits {
                points: need.points * 17 / 20,
                ..NO_LIMITS
            },
            true => Limits {
                cells: need.cells * 17 / 20,
                ..NO_LIMITS
            },
        };
        let room = Capacity {
            points: if by_cells { need.points } else { limits.points },
            cells: if by_cells { limits.cells } else { need.cells },
            ..need
        };
        let client = Client::new(config(room));
        watched = Watched::with(watched.world, limits, client, 0);
        // Cells and buckets that are full leave some out in any case.
        let topology = &watched.world.topology;
        let levels = topology.of_instance.iter().flatten();
        let full: usize = levels
            .map(|&(set, level)| topology.sets[set as usize].levels[level as usize].discarded)
            .sum();
        let (mut closed, mut opened) = (0, 0);
        for frame in 0..48 {
            // A window that goes over the scene and back, twice.
            let middle = (frame as f32 * 0.26).sin() * 0.6;
            let window = |bounds: [Vec3; 2]| {
                let at = bounds[0].midpoint(bounds[1]).x;
                (at - middle).abs() < 0.2
            };
            let view = View {
                sees: &window,
                eye: None,
            };
            let stats = watched.frame(f64::from(frame) * 0.03, &view);
            (closed, opened) = (closed + stats.closed, opened + stats.opened);
            let error = watched.error(&view);
            assert!(error < LITTLE, "frame {frame}: {error}");
            let out = left_out(watched.client.slices());
            assert!(out <= full, "frame {frame}: {out} points have no cell");
        }
        assert!(
            closed > 7 && opened > closed,
            "{opened} opened, {closed} closed"
        );
    }
}

#[test]
fn levels_of_detail_change_with_the_distance_and_fade() {
    let limits = Limits {
        points_per_pixel: 0.0024,
        ..NO_LIMITS
    };
    let mut watched = Watched::new(still_scene(), 600.0, limits);
    // Points a pixel halve at √2 times the distance; away and back, and long enough at each.
    let way = [2.0, 3.8, 5.2, 8.0, 5.0, 3.4, 2.0];
    let mut levels = Vec::new();
    let mut settled: Option<Vec<f32>> = None;
    let (mut jumps, mut hard) = (Vec::new(), Vec::new());
    for far in way {
        let view = View {
            sees: &all,
            eye: Some(Eye {
                camera: Camera {
                    position: Vec3::new(0.0, far, 0.0),
                    forward: Vec3::NEG_Y,
                    up: Vec3::Z,
                    fov_y_rad: 1.0,
                    aspect: 1.0,
                    near: 0.1,
                    far: 100.0,
                },
                pixels_per_radian: 1000.0,
            }),
        };
        let mut last = settled.clone();
        let mut largest = 0.0f32;
        for _ in 0..40 {
            watched.frame(0.0, &view);
            let picture = watched.picture();
            largest = largest.max(last.map_or(0.0, |last| apart(&last, &picture)));
            last = Some(picture);
        }
        assert_eq!(
            watched.frame(0.0, &view).bytes,
            0,
            "at {far} m it does not end"
        );
        assert!(watched.error(&view) <= QUANTISER.bound());
        let now = last.unwrap();
        if let Some(settled) = &settled {
            hard.push(apart(settled, &now));
            jumps.push(largest);
        }
        settled = Some(now);
        let instances = watched.client.mirror().instances().iter();
        levels.push(instances.map(|instance| instance.level).collect::<Vec<_>>());
    }
    let expected = [0, 1, 2, 3, 2, 1, 0].map(|level| vec![level; 3]);
    assert_eq!(levels, expected);
    // Without a fade a picture would change from one to the other at once. (Where points go, what
    // lies between those that stay changes all the same.)
    for (jump, hard) in jumps.iter().zip(&hard) {
        assert!(jump < hard && *jump < 5.0 / 255.0, "{jumps:?} of {hard:?}");
    }
    let [jump, hard] = [&jumps, &hard].map(|jumps| jumps.iter().sum::<f32>());
    assert!(jump < 0.9 * hard, "{jump} of {hard}");
}

/// How much two pictures differ in the mean.
fn apart(a: &[f32], b: &[f32]) -> f32 {
    let sum: f32 = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum();
    sum / a.len() as f32
}

// ---------------------------------------------------------------- memory
