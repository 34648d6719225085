//! The recordings that the conformance streams begin with: small scenes, played so that each thing
//! that a stream can do happens once.

use super::small_scene::{STILL, small_scene, still_scene};
use glam::Vec3;
use psao_core::Kernel;
use psao_core::residual::Quantiser;
use psao_core::stream::{PREAMBLE, Packet, flag};
use psao_server::camera::Camera;
use psao_server::encode::{Compression, Encoder, Eye, Limits, Scheme, View, capacity_of};
use psao_server::scene::Scene;
use psao_server::world::{Options, World};

/// All of them.
pub const RECORDED: [&str; 8] = [
    "cells",
    "residual",
    "topology",
    "without-patches",
    "levels",
    "reopen",
    "presence",
    "budget",
];

/// Frames a second of all of them: few, so that a change of level fades in two frames.
const RATE_HZ: f32 = 5.0;

/// Makes one of [`RECORDED`].
pub fn record(name: &str) -> Vec<u8> {
    let quantiser = Quantiser {
        step: 4,
        dead_zone: 3,
    };
    let residual = |limits| Scheme::Residual(quantiser, limits);
    let plain = residual(Limits::default());
    match name {
        "cells" => {
            let scheme = Scheme::Cells {
                threshold: 2,
                compression: Compression::Fast,
            };
            let mut take = Take::new(small_scene(), 24.0, scheme, |_| 0);
            take.frames(10, |take, frame| {
                if frame == 6 {
                    take.encoder.resync();
                }
                Shot::default()
            })
        }
        "residual" => {
            let mut take = Take::new(small_scene(), 60.0, plain, |_| 0);
            take.frames(10, |take, frame| {
                if frame == 6 {
                    take.encoder.resync();
                }
                Shot::default()
            })
        }
        "topology" => {
            let mut take = Take::new(small_scene(), 40.0, plain, |_| 0);
            take.encoder.all_patches(&take.world, &mut take.out);
            take.frames(0, |_, _| Shot::default())
        }
        "without-patches" => {
            let mut take = Take::new(small_scene(), 40.0, plain, |world| world.topology.hash);
            let out = take.frames(4, |_, _| Shot::default());
            assert_eq!(take.patches, 0);
            out
        }
        "levels" => {
            let limits = Limits {
                points_per_pixel: 0.0024,
                ..Limits::default()
            };
            let mut take = Take::new(still_scene(), 300.0, residual(limits), |_| 0);
            let mut levels = std::collections::BTreeSet::new();
            let out = take.frames(14, |take, frame| {
                let instances = take.encoder.mirror().instances().iter();
                levels.extend(instances.map(|instance| instance.level));
                Shot {
                    height_m: Some([2.0, 6.0, 12.0, 20.0, 40.0, 6.0, 2.0][frame / 2]),
                    ..Shot::default()
                }
            });
            assert_eq!(levels.len(), 4, "{levels:?}");
            out
        }
        "reopen" => {
            let scene = still_scene;
            let need = capacity_of(&world(scene(), 400.0, plain));
            let limits = Limits {
                points: need.points * 6 / 10,
                ..Limits::default()
            };
            let mut take = Take::new(scene(), 400.0, residual(limits), |_| 0);
            let out = take.frames(12, |_, frame| Shot {
                window: Some((frame as f32 * 0.52).sin() * 1.2),
                ..Shot::default()
            });
            assert!(take.closed > 0 && take.opened > take.closed);
            out
        }
        "presence" => {
            let mut take = Take::new(still_scene(), 60.0, plain, |_| 0);
            let out = take.frames(6, |take, frame| {
                let present = !(2..4).contains(&frame);
                take.world.set_present(STILL, present).unwrap();
                Shot::default()
            });
            assert!(take.closed > 0 && take.opened > take.closed);
            out
        }
        "budget" => {
            // Enough for what there is at first; then too little for what moves, and at last enough.
            let mut take = Take::new(small_scene(), 60.0, plain, |_| 0);
            let out = take.frames(16, |take, frame| {
                if let Some(max_mbit) = [(2, 0.003), (10, 1.0)].into_iter().find(|on| on.0 == frame)
                {
                    take.encoder.set_max_mbit(max_mbit.1);
                }
                Shot::default()
            });
            let mut rest = &out[PREAMBLE.len()..];
            let mut coarse = std::collections::BTreeSet::new();
            while let Some((packet, length)) = Packet::read(rest, u32::MAX).unwrap() {
                coarse.insert(packet.flags & flag::COARSE);
                rest = &rest[length..];
            }
            assert_eq!(coarse.len(), 4, "{coarse:?}");
            out
        }
        _ => panic!("{name} is none of the recordings"),
    }
}

fn world(scene: Scene, density: f64, scheme: Scheme) -> World {
    let (kernel, rest_space, levels) = match scheme {
        Scheme::Residual(_, limits) => (Kernel::Planar, true, limits.points_per_pixel > 0.0),
        _ => (Kernel::Paper, false, false),
    };
    let options = Options {
        density,
        rays: 32,
        rest_space,
        levels,
        ..Options::of(kernel)
    };
    World::new(scene, options, &|_, _, _| ()).unwrap()
}

/// What the client sees of a frame; all of it where nothing is said.
#[derive(Default)]
struct Shot {
    /// From so high above the scene.
    height_m: Option<f32>,
    /// What is nearer than 0.3 m to here on the x axis.
    window: Option<f32>,
}

/// A recording in the making.
struct Take {
    world: World,
    encoder: Encoder,
    out: Vec<u8>,
    opened: u32,
    closed: u32,
    patches: u32,
}

impl Take {
    fn new(scene: Scene, density: f64, scheme: Scheme, knows: fn(&World) -> u64) -> Take {
        let world = world(scene, density, scheme);
        let mut encoder = Encoder::new(&world, scheme, knows(&world));
        let out = encoder.header(&world, 0x5ce4e, RATE_HZ);
        Take {
            world,
            encoder,
            out,
            opened: 0,
            closed: 0,
            patches: 0,
        }
    }

    fn frames(&mut self, count: usize, shot: impl FnMut(&mut Take, usize) -> Shot) -> Vec<u8> {
        let mut shot = shot;
        for frame in 0..count {
            let time_s = frame as f64 / f64::from(RATE_HZ);
            let Shot { height_m, window } = shot(self, frame);
            while self
                .world
                .step(time_s, &|_| true, u64::MAX)
                .converging
                .ne(&0)
            {}
            self.encoder.merge(&self.world);
            self.world.clear_changes();
            let sees = |[low, high]: [Vec3; 2]| {
                window.is_none_or(|x| (low.midpoint(high).x - x).abs() < 0.3)
            };
            let view = View {
                sees: &sees,
                eye: height_m.map(|height| Eye {
                    camera: Camera {
                        position: Vec3::Y * height,
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
            let time_ns = (time_s * 1e9) as u64;
            let (world, out) = (&self.world, &mut self.out);
            let stats = self.encoder.frame(world, time_ns, &view, true, out);
            self.opened += stats.opened;
            self.closed += stats.closed;
            self.patches += stats.patches;
        }
        self.encoder.end(&mut self.out);
        std::mem::take(&mut self.out)
    }
}
