//! The ray method: each element sends its own rays, stratified by the cosine.

use super::{Element, Numbers, Stage, sh};
use crate::rays::{Against, Tracer, offset_origin};
use crate::samples::Samples;
use crate::world::Progress;
use glam::Vec3;
use rayon::prelude::*;

/// Elements between two reports of progress.
const BATCH: usize = 256;
/// Rays up to this part of the scene's radius are traced as fans.
const SHORT: f32 = 0.1;

/// Sums of `rays` cosine-weighted rays an element, which end `distance_m` away (may be infinite).
/// As [`super::bake`] returns them. `seed` turns every element's rays: two seeds have none in
/// common.
pub fn trace(
    stage: &Stage,
    elements: &[Element],
    numbers: Numbers,
    rays: usize,
    distance_m: f32,
    seed: u32,
    progress: Progress<'_>,
) -> Result<Vec<f32>, String> {
    let tracer = stage.tracer()?;
    let samples = Samples::new(rays);
    let each = numbers.count();
    // A fan looks at all triangles that any of its rays may reach, a ray alone stops at the first.
    let short = distance_m < SHORT * stage.sphere().1;
    let mut values = vec![0.0; elements.len() * each];
    let (mut first, total) = (0, elements.len());
    for (elements, values) in elements.chunks(BATCH).zip(values.chunks_mut(BATCH * each)) {
        elements
            .par_iter()
            .zip(values.par_chunks_mut(each))
            .enumerate()
            .for_each_init(
                || (Vec::new(), Vec::new(), Vec::new()),
                |(todo, hit, directions), (index, (element, out))| {
                    let id = (first + index) as u32 ^ seed.wrapping_mul(0x9e37_79b9);
                    let origin = offset_origin(element.position, element.outward, element.reach);
                    let fan = samples.fan(id, origin, element.normal, Vec3::ZERO);
                    let words = fan.directions.words();
                    todo.resize(words, 0);
                    fan.directions.mark_given(0..rays, todo);
                    hit.clear();
                    hit.resize(words, 0);
                    if short {
                        tracer.occluded_fan(Against::All, &fan, distance_m, todo, hit);
                    } else {
                        directions.clear();
                        directions.extend((0..rays).map(|ray| fan.direction(ray)));
                        let all = Against::All;
                        tracer.occluded(all, origin, directions, distance_m, todo, hit);
                    }
                    let open = |ray: usize| hit[ray / 64] >> (ray % 64) & 1 == 0;
                    match numbers {
                        Numbers::Openness => {
                            let hits: u32 = hit.iter().map(|word| word.count_ones()).sum();
                            out[0] = 1.0 - hits as f32 / rays as f32;
                        }
                        Numbers::Transfer(_) => {
                            for ray in (0..rays).filter(|ray| open(*ray)) {
                                let basis = sh::basis(fan.direction(ray));
                                out.iter_mut().zip(basis).for_each(|(out, b)| *out += b);
                            }
                            out.iter_mut().for_each(|out| *out /= rays as f32);
                        }
                    }
                },
            );
        first += elements.len();
        progress("rays", first as u64, total as u64);
    }
    Ok(values)
}
