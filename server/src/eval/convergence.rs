//! How far what a point says is off by the number of its rays: stratified, as points have them,
//! and independent, as they might.

use crate::rays::{Against, Directions, Fan, offset_origin};
use crate::report::{Form, Plot};
use crate::samples::{MAX_RAYS, Samples};
use crate::world::World;
use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;
use std::f32::consts::TAU;

/// Numbers of rays that are measured.
const RAYS: [usize; 9] = [16, 32, 64, 128, 256, 512, 1024, 2048, 4096];

/// Points that are looked at; of those, the ones that are neither open nor closed count.
const PLACES: usize = 2000;

/// Sets of [`MAX_RAYS`] stratified rays that the truth is of: other points' sets.
const TRUTH_SETS: u32 = 8;

/// Different sets of independent directions.
const INDEPENDENT_SETS: usize = 64;

/// What was measured; the names are those of the JSON file.
#[derive(Clone, Debug, Serialize)]
pub struct Convergence {
    /// Points that it is of.
    pub points: usize,
    /// One a number of rays.
    pub rows: Vec<Row>,
    /// The slope of the logarithm of the error over that of the number of rays.
    pub slope_stratified: f64,
    /// The same of independent rays: -0.5 but for chance.
    pub slope_independent: f64,
}

/// Errors at one number of rays: root mean squares, 1/255.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Row {
    /// Rays a point.
    pub rays: usize,
    /// As points have them.
    pub stratified_255: f64,
    /// Drawn one by one.
    pub independent_255: f64,
}

/// Measures points spread over what stands still; none if no point there is partly occluded.
pub fn measure(world: &World) -> Option<Convergence> {
    let mut points = Vec::new();
    for slice in &world.slices {
        let instance = &world.scene.instances[slice.instance as usize];
        if !(instance.moves || instance.deforms) {
            points.extend(slice.points.clone().map(|number| (slice.instance, number)));
        }
    }
    let step = points.len().div_ceil(PLACES).max(1);
    let samples = Samples::new(MAX_RAYS);
    let independent: Vec<Directions> = (0..INDEPENDENT_SETS as u64).map(drawn).collect();
    let errors: Vec<[[f64; 2]; RAYS.len()]> = points
        .par_iter()
        .step_by(step)
        .filter_map(|&(instance, number)| {
            let (position, normal) = world.grid_point(instance, number);
            let pose = &world.pose.instances[instance as usize];
            let normal = pose.world_normal(normal);
            let position = pose.world_from_local.transform_point3(position);
            let origin = offset_origin(position, normal, world.reach(instance));
            let fan = |number: u32| samples.fan(number, origin, normal, Vec3::X);
            let stratified = Opened::of(world, &fan(number));
            let truth: f64 = (1..=TRUTH_SETS)
                .map(|set| Opened::of(world, &fan(number.wrapping_add(set))).share(MAX_RAYS))
                .sum::<f64>()
                / f64::from(TRUTH_SETS);
            if truth == 0.0 || truth == 1.0 {
                return None;
            }
            let directions = &independent[number as usize % INDEPENDENT_SETS];
            let alone = Fan {
                directions,
                ..fan(number)
            };
            let alone = Opened::of(world, &alone);
            Some(RAYS.map(|rays| {
                let squared = |opened: &Opened| (opened.share(rays) - truth).powi(2);
                [squared(&stratified), squared(&alone)]
            }))
        })
        .collect();
    if errors.is_empty() {
        return None;
    }
    let rms = |row: usize, kind: usize| {
        let sum: f64 = errors.iter().map(|rows| rows[row][kind]).sum();
        (sum / errors.len() as f64).sqrt() * 255.0
    };
    let rows: Vec<Row> = (RAYS.iter().enumerate())
        .map(|(row, &rays)| Row {
            rays,
            stratified_255: rms(row, 0),
            independent_255: rms(row, 1),
        })
        .collect();
    Some(Convergence {
        points: errors.len(),
        slope_stratified: slope(&rows, |row| row.stratified_255),
        slope_independent: slope(&rows, |row| row.independent_255),
        rows,
    })
}

/// The least-squares line through the logarithms.
fn slope(rows: &[Row], error: impl Fn(&Row) -> f64) -> f64 {
    let dots = rows
        .iter()
        .map(|row| [(row.rays as f64).ln(), error(row).ln()]);
    let dots: Vec<[f64; 2]> = dots.collect();
    let mean = |axis: usize| dots.iter().map(|dot| dot[axis]).sum::<f64>() / dots.len() as f64;
    let (x, y) = (mean(0), mean(1));
    let across: f64 = dots.iter().map(|dot| (dot[0] - x) * (dot[1] - y)).sum();
    across / dots.iter().map(|dot| (dot[0] - x).powi(2)).sum::<f64>()
}

/// Which rays of a set met nothing, in the order in which they were given.
struct Opened(Vec<bool>);

impl Opened {
    fn of(world: &World, fan: &Fan<'_>) -> Opened {
        let words = fan.directions.words();
        let (mut todo, mut hit) = (vec![0; words], vec![0; words]);
        let count = fan.directions.len();
        fan.directions.mark_given(0..count, &mut todo);
        let t_max = world.options.ao_distance_m;
        let tracer = world.tracer();
        tracer.occluded_fan(Against::All, fan, t_max, &todo, &mut hit);
        let mut open = vec![false; count];
        for index in 0..count {
            open[fan.directions.given(index)] = hit[index / 64] >> (index % 64) & 1 == 0;
        }
        Opened(open)
    }

    /// The share of the first `rays` of them.
    fn share(&self, rays: usize) -> f64 {
        self.0[..rays].iter().filter(|open| **open).count() as f64 / rays as f64
    }
}

/// [`MAX_RAYS`] directions around z, each drawn alone.
fn drawn(set: u64) -> Directions {
    // SplitMix64.
    let mut state = set << 32;
    let mut random = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = state;
        x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ x >> 31) >> 40) as f32 / (1 << 24) as f32
    };
    let directions: Vec<Vec3> = (0..MAX_RAYS)
        .map(|_| {
            let (a, b) = (random(), random() * TAU);
            let (sin, cos) = b.sin_cos();
            Vec3::new(cos * a.sqrt(), sin * a.sqrt(), (1.0 - a).sqrt())
        })
        .collect();
    Directions::new(&directions)
}

impl Convergence {
    /// Error against rays, both logarithmic.
    pub(super) fn plot(&self) -> Plot {
        let dots = |error: fn(&Row) -> f64| {
            let dot = |row: &Row| ((row.rays as f64).log2(), error(row));
            self.rows.iter().map(dot).collect()
        };
        let name = |kind: &str, slope: f64| format!("{kind}, slope {slope:.2}");
        Plot {
            title: "Error of a point against its rays".into(),
            x_label: "rays a point, log2".into(),
            y_label: "error, 1/255 rms".into(),
            series: vec![
                (
                    name("stratified", self.slope_stratified),
                    dots(|row| row.stratified_255),
                ),
                (
                    name("independent", self.slope_independent),
                    dots(|row| row.independent_255),
                ),
            ],
            log_y: true,
            form: Form::Lines,
        }
    }
}
