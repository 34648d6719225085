//! The command `psao`.
use psao_server::{
    camera::CameraPath, encode::*, metrics, points, render, samples, scene::Scene, world::*,
};
use std::time::Instant;
fn main() {
    let arg: Vec<String> = std::env::args().collect();
    let density: f64 = arg[2].parse().unwrap();
    let t = Instant::now();
    let mut scene = if arg[1] == "atrium" {
        Scene::atrium()
    } else {
        Scene::load(arg[1].as_ref(), 1.0).unwrap()
    };
    scene.add_movers(arg[3].parse().unwrap(), 1);
    eprintln!(
        "load {:?}: {} instances",
        t.elapsed(),
        scene.instances.len()
    );
    let t = Instant::now();
    let kernel = if arg.get(4).is_some_and(|a| a == "paper") {
        psao_core::Kernel::Paper
    } else {
        psao_core::Kernel::Planar
    };
    let options = Options {
        density,
        ..Options::of(kernel)
    };
    let mut world = World::new(scene, options, &|_, _, _| ()).unwrap();
    eprintln!(
        "world {:?}: {} points, {} cells, {} buckets, {} slices, {} discarded",
        t.elapsed(),
        world.point_count(),
        world.truth.used_cells(),
        world.truth.buckets.len(),
        world.slices.len(),
        world.discarded()
    );
    let bounds = world.scene.bounds(&world.pose);
    let path = CameraPath::find(bounds, 0, 16.0 / 9.0, &|o, d| {
        world.tracer().closest(o, d, f32::INFINITY).map(|h| {
            (h.t, {
                let m =
                    &world.scene.meshes[world.scene.instances[h.instance as usize].mesh as usize];
                let p = points::SurfacePoint {
                    triangle: h.triangle,
                    u: h.u,
                    v: h.v,
                    back: false,
                };
                world.pose.instances[h.instance as usize]
                    .world_normal(p.geometric_normal(&m.triangles, world.vertices(h.instance).0))
            })
        })
    });
    let path = path.unwrap();
    let frusta: Vec<_> = (0..8)
        .map(|i| psao_server::camera::Frustum::new(&path.at(i as f64 * 0.5), 0.15))
        .collect();
    let visible = |b: [glam::Vec3; 2]| frusta.iter().any(|f| f.sees_box(b[0], b[1]));
    let t = Instant::now();
    let stats = world.converge(&visible, &|_, _, _| ());
    eprintln!(
        "converge {:?}: {stats:?} {:.2} M rays/s",
        t.elapsed(),
        stats.rays as f64 / t.elapsed().as_secs_f64() / 1e6
    );
    let mut encoder = Encoder::new(&world.truth, 2, Compression::Fast);
    let mut out = encoder.header(&world, 0, 30.0);
    let mut client = psao::Client::new(psao::Config {
        capacity: capacity_of(&world.truth),
        scene_hash: 0,
    });
    let reference = samples::Samples::new(512);
    for frame in 0..31u32 {
        let time = frame as f64 / 30.0;
        let t = Instant::now();
        let step = world.step(time, &visible, u64::MAX);
        let t_step = t.elapsed();
        encoder.merge(&world.truth);
        world.truth.clear_changes();
        let t = Instant::now();
        let f = encoder.frame(&world, (time * 1e9) as u64, &visible, true, &mut out);
        let t_enc = t.elapsed();
        let t = Instant::now();
        let mut rest = &out[..];
        while !rest.is_empty() {
            let p = client.push(rest).unwrap();
            rest = &rest[p.consumed..];
        }
        let t_dec = t.elapsed();
        out.clear();
        assert_eq!(client.mirror().hash(), encoder.mirror().hash());
        if frame % 10 == 0 {
            eprintln!(
                "frame {frame}: step {t_step:?} {step:?} enc {t_enc:?} dec {t_dec:?} {f:?} rmse {:.3}",
                point_rmse(&world, client.mirror(), &visible)
            );
            let t = Instant::now();
            let view = render::View::new(&world, &path.at(time), 480, 270);
            let blended = view.blend(client.mirror().lookup(), kernel);
            let t_blend = t.elapsed();
            let truth = view.trace(&world, &reference);
            let pair =
                metrics::Pair::new(&truth, &blended.openness, &view.valid(), 480, 270).unwrap();
            eprintln!(
                "  psnr {:.2} flip {:.4} fetched {:.1} holes {:.4} blend {t_blend:?} trace {:?}",
                pair.psnr_db(),
                pair.flip(),
                blended.fetched,
                blended.holes_share,
                t.elapsed()
            );
            let e: Vec<f32> = truth
                .iter()
                .zip(&blended.openness)
                .map(|(a, b)| a - b)
                .collect();
            use psao_server::picture::Picture;
            let v = view.valid();
            Picture::side_by_side(&[
                ("stream", &Picture::grey(&blended.openness, &v, 480, 270)),
                ("reference", &Picture::grey(&truth, &v, 480, 270)),
                ("error", &Picture::heat(&e, &v, 480, 270, 0.2)),
            ])
            .write_png(format!("/tmp/f{frame}.png").as_ref())
            .unwrap();
        }
    }
}
