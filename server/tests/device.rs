//! A device beside the processor changes nothing of what points say.

use psao_server::rays::{Against, CpuTracer, Fan, FanTracer, Tracer};
use psao_server::scene::{Pose, Scene};
use psao_server::world::{Options, StepStats, World};
use std::sync::atomic::{AtomicUsize, Ordering};

/// The processor as a device; fails after so many calls.
struct Processor {
    tracer: CpuTracer,
    calls_left: AtomicUsize,
}

impl Processor {
    fn beside(world: &World, calls: usize) -> Box<Processor> {
        Box::new(Processor {
            tracer: tracer(&world.scene, &world.pose, world.moves()),
            calls_left: calls.into(),
        })
    }
}

fn tracer(scene: &Scene, pose: &Pose, moves: &[bool]) -> CpuTracer {
    // What deforms moves, and is not asked for.
    CpuTracer::new(scene, pose, &[], moves).expect("a small scene")
}

impl FanTracer for Processor {
    fn occluded_fans(
        &self,
        fans: &[Fan<'_>],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) -> Result<(), String> {
        let take = |left: usize| left.checked_sub(1);
        let order = Ordering::Relaxed;
        let taken = self.calls_left.fetch_update(order, order, take);
        taken.map_err(|_| "out of calls".to_string())?;
        let words = fans[0].directions.words();
        let bits = todo.chunks(words).zip(hit.chunks_mut(words));
        for (fan, (todo, hit)) in fans.iter().zip(bits) {
            self.tracer
                .occluded_fan(Against::Static, fan, t_max, todo, hit);
        }
        Ok(())
    }

    fn divide(&mut self, scene: &Scene, pose: &Pose, moves: &[bool]) -> Result<(), String> {
        self.tracer = tracer(scene, pose, moves);
        Ok(())
    }
}

/// What all points say, and what that took, converged before and after an instance that stood
/// still has moved; `calls`: of a device.
fn said(calls: Option<usize>) -> ([Vec<u8>; 2], [StepStats; 2], bool) {
    let options = Options {
        density: 12.0,
        rays: 96,
        rest_space: true,
        ..Options::of(psao_core::Kernel::Planar)
    };
    let mut world =
        World::new(Scene::atrium(), options, &|_, _, _| ()).expect("the built-in scene");
    if let Some(calls) = calls {
        world.trace_still_on(Processor::beside(&world, calls));
    }
    let all = |world: &World| {
        let points = 0..world.point_count() as u32;
        points.map(|point| world.occlusion_of(point)).collect()
    };
    let first = world.converge(&|_| true, usize::MAX, &|_, _| ());
    let before = all(&world);
    let still = world.moves().iter().position(|moves| !moves);
    let still = still.expect("an instance that stands still");
    let place = world.pose.instances[still].world_from_local;
    let moved = glam::DAffine3::from_mat3_translation(
        place.matrix3.as_dmat3(),
        place.translation.as_dvec3() + world.scene.origin + glam::DVec3::Y * 0.1,
    );
    world.drive(still as u32, moved).expect("it is there");
    world.step(1.5, &|_| true, 0);
    let second = world.converge(&|_| true, usize::MAX, &|_, _| ());
    let after = all(&world);
    ([before, after], [first, second], world.has_device())
}

#[test]
fn points_say_the_same_bit_for_bit_when_their_rays_are_traced_together_on_a_device() {
    let (alone, stats, _) = said(None);
    assert!(alone[0] != alone[1], "nothing moved: not much of a test");
    let (beside, stats_beside, kept) = said(Some(usize::MAX));
    assert!(kept);
    assert!(beside == alone, "some points say something else");
    assert_eq!(stats_beside, stats, "as many rays");
    // The device gives up in the middle of converging.
    let (failed, stats_failed, kept) = said(Some(1));
    assert!(!kept);
    assert!(failed == alone, "some points say something else");
    assert_eq!(stats_failed, stats, "as many rays");
}

#[cfg(not(feature = "gpu"))]
#[test]
fn a_gpu_asked_of_a_build_without_one_is_refused_with_the_remedy() {
    use clap::Parser;
    use psao_server::args::{DeviceArg, Layout};
    use psao_server::demo::DemoArgs;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        demo: DemoArgs,
    }
    let cli = Cli::parse_from(["demo", "--trace", "gpu"]);
    let DemoArgs { scene, trace, .. } = cli.demo;
    assert_eq!(trace.trace, DeviceArg::Gpu);
    let refused = trace.world(&scene, Layout::Patches, &|_, _, _| ());
    let why = refused.map(|_| ()).expect_err("there is no GPU");
    assert!(why.contains("--features gpu"), "{why}");
}
