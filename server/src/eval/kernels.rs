//! `psao eval --kernels …`: how well each kernel, cell size, capacity and placement rebuilds the
//! occlusion of a picture from the same number of points, what it reads and how long it takes.
//!
//! The points are those of profile `residual`: where a client has them, and as traced. They go into
//! grids that are made for each variant here, so that capacities and kernels can be tried which no
//! stream has; the default's is the stream's own. Pictures are ray traced once and shared by all
//! variants.

use super::convergence::{self, Convergence};
use super::variants::{
    Band, Blended, Facing, Grids, LeastSquares, Mean, Paper, Planar, Sample, Samples as SetSamples,
    Weigh,
};
use super::{EvalArgs, mean, percentile};
use crate::args::{PlacementArg, SceneArgs, camera_path};
use crate::metrics::Pair;
use crate::picture::{Picture, write_whole};
use crate::render::{Fragment, REFERENCE_RAYS, View};
use crate::report::{Form, Panel, Plot, Report};
use crate::samples::Samples;
use crate::world::{Options, Progress, World, bounds_of};
use glam::{DVec3, Vec3};
use psao_core::Kernel;
use psao_core::cell::CELL_POINTS;
use psao_core::point::NORMALS;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashSet;
use std::hint::black_box;
use std::str::FromStr;
use std::time::Instant;

/// A kernel that can be measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Name {
    Paper,
    PaperNearest,
    Band,
    Planar,
    PlanarUnfaded,
    PlanarDark,
    LeastSquares,
}

/// Names, radius over rm and cell size over radius where nothing else is asked for.
const NAMES: [(&str, Name, f32, f32); 7] = [
    // Eq. 2 to 4 of the paper; 1 where no point counts.
    ("paper", Name::Paper, 1.41, 2.0),
    // The same; where no point counts, the nearest.
    ("paper-nearest", Name::PaperNearest, 2.0, 1.25),
    // What planar was in the study that this project began with.
    ("band", Name::Band, 2.0, 1.25),
    // The core's default.
    ("planar", Name::Planar, 2.0, 1.25),
    // The same with steps where the block switches.
    ("planar-unfaded", Name::PlanarUnfaded, 2.0, 1.25),
    // The same with dark points counting as others do.
    ("planar-dark", Name::PlanarDark, 2.0, 1.25),
    // Moving least squares with planar's weights.
    ("least-squares", Name::LeastSquares, 2.0, 1.25),
];

/// A kernel with its radius and cell size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variant {
    name: Name,
    radius_over_rm: f32,
    cell_over_radius: f32,
}

impl Variant {
    fn name(&self) -> &'static str {
        let found = NAMES.iter().find(|entry| entry.1 == self.name);
        found.map_or("", |entry| entry.0)
    }
}

impl FromStr for Variant {
    type Err = String;

    fn from_str(text: &str) -> Result<Variant, String> {
        let (name, sizes) = text.split_once('@').unwrap_or((text, ""));
        let Some(&(_, name, radius, cell)) = NAMES.iter().find(|entry| entry.0 == name) else {
            let names: Vec<&str> = NAMES.iter().map(|entry| entry.0).collect();
            return Err(format!("{name} is no kernel: use {}", names.join(", ")));
        };
        let (r, c) = sizes.split_once('/').unwrap_or((sizes, ""));
        let number = |text: &str, default: f32| match text {
            "" => Some(default),
            text => text.parse().ok().filter(|v| (0.25..=16.0).contains(v)),
        };
        let (Some(radius_over_rm), Some(cell_over_radius)) = (number(r, radius), number(c, cell))
        else {
            return Err(format!(
                "{sizes} is not a radius over rm and a cell size over the radius, 0.25 to 16 \
                 each, such as 2/1.25"
            ));
        };
        Ok(Variant {
            name,
            radius_over_rm,
            cell_over_radius,
        })
    }
}

/// One variant; the names are those of the JSON file.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Scene file or `atrium`.
    pub scene: String,
    /// Points per square metre and side.
    pub density: f64,
    /// Kernel.
    pub kernel: &'static str,
    /// Radius over the largest Poisson radius at this density.
    pub radius_over_rm: f32,
    /// Cell size over radius.
    pub cell_over_r: f32,
    /// Points that a cell has room for.
    pub cell_capacity: usize,
    /// `uniform` or `adaptive`.
    pub placement: &'static str,
    /// AO alone against the reference, over the pixels of all pictures.
    pub psnr_db: f64,
    /// Mean FLIP of the pictures.
    pub flip: f64,
    /// Mean SSIM of the pictures.
    pub ssim: f64,
    /// 99th percentile of the step where the block of cells switches, 1 for all of the range.
    pub seam_p99: f64,
    /// Share of pixels where no point counts; for planar kernels, where none faces their way.
    pub holes_share: f64,
    /// Points read a pixel.
    pub fetched: f64,
    /// Nanoseconds a lookup, on one thread, in turns with the other variants of the same points.
    pub lookup_ns: f64,
    /// Share of the points that found no room.
    pub discarded_share: f64,
    /// Points placed on the whole scene.
    pub points: usize,
}

/// What an evaluation of kernels found; the names are those of the JSON file.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Found {
    /// Camera path.
    pub path: u32,
    /// Pictures that each figure is of.
    pub pictures: u32,
    /// Their size, pixels.
    pub size: (usize, usize),
    /// One a variant.
    pub rows: Vec<Row>,
    /// What rays a point are worth; of the first density and placement.
    pub convergence: Option<Convergence>,
    /// Pictures of errors.
    #[serde(skip)]
    panels: Vec<Panel>,
}

/// A picture's camera and truth, the same for all variants.
struct Shot {
    time_s: f64,
    view: View,
    reference: Vec<f32>,
}

/// A variant's lookup at some fragments of a picture: the sum of its answers.
type Timed = Box<dyn Fn(&[&Fragment]) -> f32>;

/// Places on both sides of a block's switch, in the grid's space.
const SEAM_SHARE: usize = 3;

/// Side of the boxes in which what is seen is noted, metres.
const NOTE_M: f32 = 0.25;

/// Runs the evaluation.
///
/// # Errors
/// What went wrong, and what to do about it.
pub fn run(args: &EvalArgs, progress: Progress<'_>) -> Result<Found, String> {
    let mut found = Found {
        path: args.path,
        pictures: args.pictures,
        size: args.size,
        ..Found::default()
    };
    let mut shots: Vec<Shot> = Vec::new();
    let one = [args.scene.density];
    let densities = if args.densities.is_empty() {
        &one
    } else {
        &args.densities[..]
    };
    for &density in densities {
        let scene = SceneArgs {
            density,
            ..args.scene.clone()
        };
        for &placement in &args.placements {
            let options = Options {
                rest_space: true,
                // Which points cells drop that overflow follows from these.
                levels: true,
                // What overflows is each variant's own affair.
                cell_capacity: usize::MAX,
                adaptive: placement == PlacementArg::Adaptive,
                ..scene.options()?
            };
            let world = World::new(scene.load()?, options, progress);
            let mut world = world.map_err(|error| error.to_string())?;
            if shots.is_empty() {
                shots = take(&mut world, args, progress)?;
                found.convergence = convergence::measure(&world);
            }
            let name = match placement {
                PlacementArg::Uniform => "uniform",
                PlacementArg::Adaptive => "adaptive",
            };
            measure_all(&mut world, &shots, args, name, &mut found, progress);
        }
    }
    if let Some(path) = &args.json {
        let json = serde_json::to_string_pretty(&found).map_err(|error| error.to_string())?;
        write_whole(path, json.as_bytes()).map_err(|error| error.to_string())?;
    }
    if let Some(folder) = &args.out {
        let page = folder.join("report.html");
        found.report().write(&page).map_err(|e| e.to_string())?;
        for (number, panel) in found.panels.iter().enumerate() {
            let pictures: Vec<(&str, &Picture)> = panel
                .pictures
                .iter()
                .map(|(t, p)| (t.as_str(), p))
                .collect();
            let file = folder.join(format!("errors-{number:02}.png"));
            let picture = Picture::side_by_side(&pictures);
            picture
                .write_png(&file)
                .map_err(|error| error.to_string())?;
        }
    }
    Ok(found)
}

/// Pictures along the path, evenly spaced in time, with their truth.
fn take(world: &mut World, args: &EvalArgs, progress: Progress<'_>) -> Result<Vec<Shot>, String> {
    let (width, height) = args.size;
    let path = camera_path(world, args.path, width as f32 / height as f32)?;
    let samples = Samples::new(REFERENCE_RAYS);
    let shot = |number: u32| {
        let time_s = (f64::from(number) + 0.5) / f64::from(args.pictures) * path.period_s();
        world.step(time_s, &|_| false, 0);
        let view = View::new(world, &path.at(time_s), width, height);
        let reference = view.trace(world, &samples);
        progress("reference", u64::from(number) + 1, u64::from(args.pictures));
        Shot {
            time_s,
            view,
            reference,
        }
    };
    Ok((0..args.pictures).map(shot).collect())
}

/// The points of what a picture shows, traced, an instance.
fn points_of(world: &mut World, shot: &Shot, progress: Progress<'_>) -> Vec<SetSamples> {
    world.step(shot.time_s, &|_| false, 0);
    let note = |p: Vec3| (p / NOTE_M).floor().as_ivec3();
    let noted: HashSet<_> = shot
        .view
        .fragments
        .iter()
        .flatten()
        .map(|f| note(f.world_position))
        .collect();
    let seen = |[min, max]: [Vec3; 2]| {
        let (low, high) = (note(min), note(max));
        let span = (high - low).as_i64vec3() + 1;
        // Where there are fewer fragments than boxes, the fragments are gone through.
        if span.x * span.y * span.z > noted.len() as i64 {
            return noted
                .iter()
                .any(|n| n.cmpge(low).all() && n.cmple(high).all());
        }
        (low.x..=high.x).any(|x| {
            (low.y..=high.y)
                .any(|y| (low.z..=high.z).any(|z| noted.contains(&glam::IVec3::new(x, y, z))))
        })
    };
    let rays = world.options.rays;
    world.converge(&seen, rays, &|done, total| {
        progress("points traced", done, total)
    });
    let world = &*world;
    let instances = 0..world.scene.instances.len() as u32;
    let sets = instances.into_par_iter().filter_map(|instance| {
        let (set, level) = (world.topology.set_of(instance)?, world.level_of(instance)?);
        let placed = &set.levels[0].grid;
        let unit = 1.0 / Vec3::from(placed.cells_per_unit).as_dvec3();
        let slices = world.slices_of(instance);
        let slices = world.slices[slices.start as usize..slices.end as usize].iter();
        let points: Vec<Sample> = slices
            .filter(|slice| seen(slice.bounds))
            .flat_map(|slice| {
                let points = world.topology.points_of(slice.patch, level);
                points
                    .zip(world.occlusion(slice))
                    .map(|(point, &occlusion)| {
                        let cells =
                            DVec3::from(point.position.map(|s| (f64::from(s) + 0.5) / 32.0));
                        let normal = Vec3::from(NORMALS[point.normal as usize]);
                        Sample {
                            position: (Vec3::from(placed.origin).as_dvec3() + cells * unit)
                                .as_vec3(),
                            normal: (normal / Vec3::from(placed.normal_scale)).normalize_or_zero(),
                            occlusion,
                            level: point.level,
                        }
                    })
            })
            .collect();
        let mesh = &world.scene.meshes[world.scene.instances[instance as usize].mesh as usize];
        let corners = mesh.triangles.iter().flatten();
        let own = &set.levels[level as usize].grid;
        (!points.is_empty()).then(|| SetSamples {
            instance,
            scale: Vec3::from(own.cells_per_unit) * world.options.cell_m(),
            bounds: bounds_of(corners.map(|i| mesh.positions[*i as usize])),
            points,
        })
    });
    sets.collect()
}

fn measure_all(
    world: &mut World,
    shots: &[Shot],
    args: &EvalArgs,
    placement: &'static str,
    found: &mut Found,
    progress: Progress<'_>,
) {
    let points: Vec<Vec<SetSamples>> = shots
        .iter()
        .map(|shot| points_of(world, shot, progress))
        .collect();
    let first = found.rows.len();
    let mut timed: Vec<Vec<Timed>> = shots.iter().map(|_| Vec::new()).collect();
    for variant in &args.kernels {
        for capacity in args.capacities.iter().map(|&c| usize::from(c)) {
            let row = match capacity <= CELL_POINTS {
                true => sized::<CELL_POINTS>(
                    world, shots, &points, variant, capacity, &mut timed, found,
                ),
                false => sized::<15>(world, shots, &points, variant, capacity, &mut timed, found),
            };
            found.rows.push(Row { placement, ..row });
        }
    }
    let nanoseconds = side_by_side(shots, &timed);
    for (row, lookup_ns) in found.rows[first..].iter_mut().zip(nanoseconds) {
        row.lookup_ns = lookup_ns;
    }
}

/// Nanoseconds a lookup of each variant: run by run of fragments, all variants take turns, and of
/// each the least counts. What else the machine does, and how fast it runs just now, so troubles
/// none more than another. Runs are warm: what a variant reads is in the cache if there is room.
fn side_by_side(shots: &[Shot], timed: &[Vec<Timed>]) -> Vec<f64> {
    const RUN: usize = 1024;
    const ROUNDS: usize = 9;
    let mut sums = vec![0.0; timed.first().map_or(0, Vec::len)];
    let mut count = 0;
    for (shot, timed) in shots.iter().zip(timed) {
        let fragments: Vec<&Fragment> = shot.view.fragments.iter().flatten().collect();
        count += fragments.len();
        for run in fragments.chunks(RUN) {
            let mut least = vec![f64::INFINITY; sums.len()];
            for _ in 0..ROUNDS {
                for (least, blend) in least.iter_mut().zip(timed) {
                    let start = Instant::now();
                    black_box(blend(run));
                    *least = least.min(start.elapsed().as_secs_f64());
                }
            }
            sums.iter_mut().zip(least).for_each(|(sum, s)| *sum += s);
        }
    }
    let each = 1e9 / count.max(1) as f64;
    sums.into_iter().map(|sum| sum * each).collect()
}

fn sized<const N: usize>(
    world: &World,
    shots: &[Shot],
    points: &[Vec<SetSamples>],
    variant: &Variant,
    capacity: usize,
    timed: &mut [Vec<Timed>],
    found: &mut Found,
) -> Row {
    let go = match variant.name {
        Name::Paper => measure::<Mean<Paper<false>>, N>,
        Name::PaperNearest => measure::<Mean<Paper<true>>, N>,
        Name::Band => measure::<Mean<Band>, N>,
        Name::Planar => measure::<Mean<Planar<true, true>>, N>,
        Name::PlanarUnfaded => measure::<Mean<Planar<false, true>>, N>,
        Name::PlanarDark => measure::<Mean<Planar<true, false>>, N>,
        Name::LeastSquares => measure::<LeastSquares, N>,
    };
    go(world, shots, points, variant, capacity, timed, found)
}

fn measure<K: Weigh + 'static, const N: usize>(
    world: &World,
    shots: &[Shot],
    points: &[Vec<SetSamples>],
    variant: &Variant,
    capacity: usize,
    timed: &mut [Vec<Timed>],
    found: &mut Found,
) -> Row {
    let options = &world.options;
    let rm = crate::points::largest_radius(options.density) as f32;
    let cell_m = rm * variant.radius_over_rm * variant.cell_over_radius;
    let (mut squares, mut pixels, mut holes, mut fetched) = (0.0, 0.0, 0.0, 0.0);
    let (mut flip, mut ssim) = (Vec::new(), Vec::new());
    let (mut steps, mut discarded, mut placed) = (Vec::new(), 0, 0);
    let mut pictures = Vec::new();
    for ((shot, points), timed) in shots.iter().zip(points).zip(timed) {
        let grids = Grids::<N>::new(
            world.scene.instances.len(),
            points,
            cell_m,
            variant.cell_over_radius,
            capacity,
        );
        discarded += grids.discarded;
        placed += grids.points;
        let fragments: Vec<_> = shot.view.fragments.iter().flatten().collect();
        let blend = |f: &Fragment| grids.blend::<K>(f.instance, f.position, f.normal);
        let answers: Vec<Blended> = fragments.par_iter().map(|f| blend(f)).collect();
        let facing = |f: &&Fragment| grids.blend::<Facing>(f.instance, f.position, f.normal).hole;
        holes += match variant.name {
            Name::Paper | Name::PaperNearest => answers.iter().filter(|a| a.hole).count(),
            _ => fragments.iter().copied().filter(facing).count(),
        } as f64;
        fetched += answers.iter().map(|a| f64::from(a.fetched)).sum::<f64>();
        let mut next = answers.iter();
        let test: Vec<f32> = (shot.view.fragments.iter())
            .map(|f| f.map_or(1.0, |_| next.next().map_or(1.0, |a| a.openness)))
            .collect();
        let every: Vec<_> = fragments.iter().step_by(SEAM_SHARE).collect();
        let at_switches = every.par_iter().filter_map(|f| step::<K, N>(&grids, f));
        steps.extend(at_switches.collect::<Vec<f64>>());
        // Of what the core has, the core's own code is timed.
        let kernel = match variant.name {
            Name::Paper => Some(Kernel::Paper),
            Name::Planar => Some(Kernel::Planar),
            _ => None,
        };
        let shipped = kernel.and_then(|kernel| Some((kernel, grids.of_client()?)));
        timed.push(match shipped {
            Some((kernel, buffers)) => Box::new(move |fragments| {
                let lookup = buffers.lookup();
                let one = |f: &&Fragment| {
                    let (position, normal) = (f.position.to_array(), f.normal.to_array());
                    lookup.blend(kernel, f.instance, position, normal).openness
                };
                fragments.iter().map(one).sum()
            }),
            None => Box::new(move |fragments| {
                let one = |f: &&Fragment| {
                    let found = grids.blend::<K>(f.instance, f.position, f.normal);
                    found.openness
                };
                fragments.iter().map(one).sum()
            }),
        });
        let (width, height) = (shot.view.width, shot.view.height);
        let valid = shot.view.valid();
        let Ok(pair) = Pair::new(&shot.reference, &test, &valid, width, height) else {
            continue;
        };
        let count = fragments.len() as f64;
        squares += pair.rmse().powi(2) * count;
        pixels += count;
        flip.push(pair.flip());
        ssim.push(pair.ssim());
        let error: Vec<f32> = test
            .iter()
            .zip(&shot.reference)
            .map(|(a, b)| a - b)
            .collect();
        pictures.push((
            format!("{:.1} s", shot.time_s),
            Picture::heat(&error, &valid, width, height, 0.25),
        ));
    }
    let row = Row {
        scene: world.scene.name.clone(),
        density: options.density,
        kernel: variant.name(),
        radius_over_rm: variant.radius_over_rm,
        cell_over_r: variant.cell_over_radius,
        cell_capacity: capacity,
        placement: "",
        psnr_db: -10.0 * (squares / pixels).max(1e-12).log10(),
        flip: mean(&flip),
        ssim: mean(&ssim),
        seam_p99: percentile(&steps, 0.99),
        holes_share: holes / pixels,
        fetched: fetched / pixels,
        lookup_ns: 0.0,
        discarded_share: discarded as f64 / placed.max(1) as f64,
        points: world.point_count(),
    };
    found.panels.push(Panel {
        title: format!(
            "{} r = {} rm, c = {} r, {capacity} a cell, {}/m²",
            row.kernel, row.radius_over_rm, row.cell_over_r, row.density
        ),
        caption: format!("{:.2} dB", row.psnr_db),
        pictures,
    });
    row
}

/// The step in the answer where, nearest to a fragment on its tangent plane, the block switches.
fn step<K: Weigh, const N: usize>(grids: &Grids<N>, fragment: &Fragment) -> Option<f64> {
    let (g, cell) = grids.in_cells(fragment.instance, fragment.position)?;
    let normal = (fragment.normal * cell).normalize_or_zero();
    let mut best: Option<(f32, Vec3, usize, f32)> = None;
    for axis in 0..3 {
        // The way along the surface that this coordinate changes fastest.
        let along = Vec3::AXES[axis] - normal * normal[axis];
        let switch = (g[axis]).floor() + 0.5;
        let steep = along.length_squared();
        if steep < 0.1 {
            continue;
        }
        let to = along * ((switch - g[axis]) / steep);
        let far = to.length();
        if best.is_none_or(|b| far < b.0) {
            best = Some((far, g + to, axis, switch));
        }
    }
    let (_, at, axis, switch) = best?;
    let side = |by: f32| {
        let mut at = at;
        at[axis] = switch + by;
        let position = fragment.position + (at - g) * cell;
        grids.blend::<K>(fragment.instance, position, fragment.normal)
    };
    let [before, after] = [side(-5e-4), side(5e-4)];
    Some(f64::from((before.openness - after.openness).abs()))
}

fn plot(series: Vec<(String, Vec<(f64, f64)>)>) -> Plot {
    Plot {
        x_label: "ns a lookup, one thread".into(),
        y_label: "AO alone, PSNR (dB)".into(),
        series,
        ..Plot::default()
    }
}

impl Found {
    /// All rows as a table.
    pub fn table(&self) -> String {
        let heads = [
            "scene",
            "/m²",
            "kernel",
            "r/rm",
            "c/r",
            "cap",
            "placement",
            "dB",
            "FLIP",
            "SSIM",
            "seam p99",
            "holes",
            "fetched",
            "ns",
            "discarded",
        ];
        let mut lines = vec![heads.map(String::from)];
        for row in &self.rows {
            lines.push([
                row.scene.clone(),
                row.density.to_string(),
                row.kernel.into(),
                row.radius_over_rm.to_string(),
                row.cell_over_r.to_string(),
                row.cell_capacity.to_string(),
                row.placement.into(),
                format!("{:.2}", row.psnr_db),
                format!("{:.4}", row.flip),
                format!("{:.4}", row.ssim),
                format!("{:.4}", row.seam_p99),
                format!("{:.2} %", row.holes_share * 100.0),
                format!("{:.1}", row.fetched),
                format!("{:.0}", row.lookup_ns),
                format!("{:.2} %", row.discarded_share * 100.0),
            ]);
        }
        super::aligned(&lines)
    }

    fn report(&self) -> Report {
        let scene = self.rows.first().map_or("", |row| &row.scene);
        let mut series: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
        for row in &self.rows {
            let name = format!("{}, {}/m², {}", row.kernel, row.density, row.placement);
            if series.last().is_none_or(|(last, _)| *last != name) {
                series.push((name, Vec::new()));
            }
            let dots = &mut series.last_mut().expect("one was just made").1;
            dots.push((row.lookup_ns, row.psnr_db));
        }
        let mut best: Vec<(f64, f64)> = Vec::new();
        let mut all: Vec<(f64, f64)> = series.iter().flat_map(|(_, dots)| dots.clone()).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
        for dot in all {
            if best.last().is_none_or(|last| dot.1 > last.1) {
                best.push(dot);
            }
        }
        Report {
            title: format!("PSAO eval, kernels: {scene}"),
            summary: Vec::new(),
            panels: self.panels.clone(),
            plots: [
                Plot {
                    title: "Error against time: every variant".into(),
                    form: Form::Marks,
                    ..plot(series)
                },
                Plot {
                    title: "Error against time: what no other betters in both".into(),
                    ..plot(vec![("Pareto line".into(), best)])
                },
            ]
            .into_iter()
            .chain(self.convergence.as_ref().map(Convergence::plot))
            .collect(),
        }
    }
}
