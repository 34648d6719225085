//! `psao bake`: what is baked, into which file, how well and how fast.

use super::atlas::Atlas;
use super::detail::Detail;
use super::glb::{Document, Textures};
use super::{
    Baked, DepthMaps, Element, Method, Numbers, Points, REFERENCE_RAYS, Stage, bake, rays,
    rmse_255, sh, texels, vertices,
};
use crate::picture::{Picture, write_whole};
use crate::points::largest_radius;
use crate::rays::{Hit, Tracer};
use crate::report::{Form, Plot};
use crate::scene::{Origins, Scene};
use crate::world::Progress;
use clap::{Args, ValueEnum};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Elements that the error is measured on, evenly from all of them.
const CHECKED: usize = 2048;
/// Pixels of the preview.
const PREVIEW: [usize; 2] = [480, 270];

/// Options of `psao bake`.
#[derive(Args, Clone, Debug)]
pub struct BakeArgs {
    /// A glTF file (.gltf or .glb)
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// A plain glTF file, in the same place as SCENE: occlusion and normals of SCENE go into its
    /// textures, and SCENE's own file is not written; with --to texture
    #[arg(long, value_name = "SCENE")]
    pub onto: Option<PathBuf>,
    /// How far from the plain surface the detailed one may be, either way, metres; without it, a
    /// 50th of the plain scene's radius
    #[arg(long, value_name = "METRES")]
    pub cage: Option<f32>,
    /// Where the occlusion goes: vertex attribute _OCCLUSION, occlusion texture, points with
    /// _OCCLUSION below each node, or spherical harmonics in vertex attributes _TRANSFER_0... or
    /// in textures
    #[arg(long, value_enum, default_value_t = Target::Vertex)]
    pub to: Target,
    /// How; several, separated by commas, are measured side by side, and the first is written
    #[arg(long, value_enum, value_delimiter = ',', default_value = "rays")]
    pub method: Vec<MethodArg>,
    /// Directions an element, 1 to 4096; several, separated by commas, are measured side by side,
    /// and the last is written
    #[arg(long, value_name = "K", value_delimiter = ',', default_value = "256")]
    pub directions: Vec<usize>,
    /// The .glb to write
    #[arg(long, value_name = "FILE.glb")]
    pub out: PathBuf,
    /// Picture to write; without it, OUT with the ending .png
    #[arg(long, value_name = "FILE.png")]
    pub preview: Option<PathBuf>,
    /// Writes what was measured
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Writes a plot of the error against the number of directions
    #[arg(long, value_name = "FILE.svg")]
    pub plot: Option<PathBuf>,
    /// Metres per unit of the file
    #[arg(long, value_name = "METRES", default_value_t = 1.0)]
    pub unit: f64,
    /// Longest ray, metres; depth maps can't end, so that they need `inf`
    #[arg(long, value_name = "METRES", default_value_t = f32::INFINITY)]
    pub ao_distance: f32,
    /// Texels an edge of the texture
    #[arg(long, value_name = "TEXELS", default_value_t = 1024)]
    pub size: u32,
    /// Points per square metre and side
    #[arg(long, value_name = "N", default_value_t = 512.0)]
    pub density: f64,
    /// Bands of spherical harmonics: 2, 3 or 4 for 4, 9 or 16 coefficients
    #[arg(long, value_name = "N", default_value_t = 3,
        value_parser = clap::value_parser!(u8).range(2..=4))]
    pub order: u8,
    /// Texels an edge of a depth map
    #[arg(long, value_name = "TEXELS", default_value_t = 1024)]
    pub resolution: u32,
    /// How far over an element something must be to hide it, in texels of a depth map; more where
    /// surfaces slant
    #[arg(long, value_name = "TEXELS", default_value_t = 0.004)]
    pub bias: f32,
    /// Directions between two read-backs from the GPU; 0 for one read-back at the end
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub readback_every: usize,
}

/// Where occlusion goes, by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A number a vertex
    Vertex,
    /// A texture over a set of texture coordinates of its own
    Texture,
    /// Points spread over all surfaces
    Points,
    /// A transfer vector a vertex
    Sh,
    /// A transfer vector a texel, over a set of texture coordinates of its own
    ShTexture,
}

/// A method by name.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum MethodArg {
    /// Depth maps from all around, on a GPU
    Depth,
    /// Rays, on the processor
    Rays,
}

/// What a bake came to.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// `depth` or `rays`.
    pub method: &'static str,
    /// `vertex`, `texture`, `points`, `sh` or `sh-texture`.
    pub target: String,
    /// Places baked.
    pub elements: usize,
    /// Directions each.
    pub directions: usize,
    /// From elements to values, trees or shaders and uploads included.
    pub seconds: f64,
    /// Root of the mean square error of openness against 4096 other rays an element, in 1/255.
    pub rmse_255: f64,
    /// Times that sums came back from the GPU.
    pub readbacks: usize,
}

/// All that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The scene's name.
    pub scene: String,
    /// Longest ray, metres; nothing where it does not end.
    pub ao_distance_m: Option<f32>,
    /// Elements that the error was measured on.
    pub checked: usize,
    /// Texels an edge of depth maps.
    pub resolution: u32,
    /// Their bias, texels.
    pub bias: f32,
    /// One a method and number of directions.
    pub rows: Vec<Row>,
    /// What a user should know of the input.
    pub notes: Vec<String>,
}

impl Report {
    /// For people.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{:>8} {:>8} {:>9} {:>10} {:>9} {:>8} {:>9}\n",
            "method", "target", "elements", "directions", "seconds", "rmse/255", "readbacks"
        );
        for row in &self.rows {
            text += &format!(
                "{:>8} {:>8} {:>9} {:>10} {:>9.3} {:>8.2} {:>9}\n",
                row.method,
                row.target,
                row.elements,
                row.directions,
                row.seconds,
                row.rmse_255,
                row.readbacks
            );
        }
        self.notes
            .iter()
            .for_each(|note| text += &format!("{note}\n"));
        text
    }
}

/// Elements of all instances, one after the other, and where they belong.
struct Job {
    numbers: Numbers,
    elements: Vec<Element>,
    /// First element of each instance, and behind the last.
    starts: Vec<usize>,
    texture: Option<(Atlas, Vec<u32>)>,
    detail: Option<Detail>,
    points: Vec<Points>,
}

/// Bakes a scene into a file. Files appear whole or not at all.
///
/// # Errors
/// What is wrong with the scene or an option, and what to do.
pub fn run(args: &BakeArgs, progress: Progress<'_>) -> Result<Report, String> {
    check(args)?;
    let written = args.onto.as_ref().unwrap_or(&args.scene);
    let (scene, origins) =
        Scene::load_with_origins(written, args.unit).map_err(|error| error.to_string())?;
    let mut document = Document::open(written)?;
    let stage = Stage::new(scene);
    let mut job = job(args, &stage, &origins, &mut document)?;
    // What is looked around in: the scene that is written, unless it stands for another.
    let detailed = args.onto.as_ref().map(|_| -> Result<Stage, String> {
        let scene = Scene::load(&args.scene, args.unit).map_err(|error| error.to_string())?;
        Ok(Stage::new(scene))
    });
    let detailed = detailed.transpose()?;
    if let (Some(detailed), Some((atlas, _))) = (&detailed, &job.texture) {
        let cage_m = args.cage.unwrap_or(stage.sphere().1 / 50.0);
        let mut detail = Detail::new(&stage, atlas, detailed, cage_m)?;
        job.elements = std::mem::take(&mut detail.elements);
        job.detail = Some(detail);
    }
    let around = detailed.as_ref().unwrap_or(&stage);
    let count = job.elements.len();
    if count == 0 {
        return Err(format!(
            "{}: nothing of it can be baked: raise --density or --size",
            args.scene.display()
        ));
    }

    let step = count.div_ceil(CHECKED).max(1);
    let checked: Vec<Element> = job.elements.iter().step_by(step).copied().collect();
    let reference = rays::trace(
        around,
        &checked,
        Numbers::Openness,
        REFERENCE_RAYS,
        args.ao_distance,
        1,
        &|_, done, total| progress("reference", done, total),
    )?;
    let target = args.to.to_possible_value();
    let target = target.map_or(String::new(), |value| value.get_name().to_string());
    let mut rows = Vec::new();
    let mut values = None;
    for (number, method) in args.method.iter().enumerate() {
        let method = match method {
            MethodArg::Rays => Method::Rays {
                distance_m: args.ao_distance,
            },
            MethodArg::Depth => Method::Depth(DepthMaps {
                resolution: args.resolution,
                bias: args.bias,
                readback_every: args.readback_every,
            }),
        };
        for directions in &args.directions {
            let baked = bake(
                around,
                &job.elements,
                job.numbers,
                method,
                *directions,
                progress,
            )?;
            rows.push(Row {
                method: method.name(),
                target: target.clone(),
                elements: count,
                directions: *directions,
                seconds: baked.seconds,
                rmse_255: error(job.numbers, &baked, step, &reference),
                readbacks: baked.readbacks,
            });
            if number == 0 {
                values = Some(baked.values);
            }
        }
    }
    let values = values.ok_or("give a --method and a number of --directions")?;

    let preview = preview(args, &stage, &job, &values)?;
    let mut notes = notes(&stage, &document);
    if let Some(missed) = job.detail.as_ref().map(|d| d.missed).filter(|m| *m > 0) {
        notes.push(format!(
            "{missed} texels have nothing of the detailed scene within the cage: they show the \
             plain one"
        ));
    }
    let bytes = write(&stage, &origins, document, &job, &values)?;
    let report = Report {
        scene: stage.scene.name.clone(),
        ao_distance_m: args.ao_distance.is_finite().then_some(args.ao_distance),
        checked: checked.len(),
        resolution: args.resolution,
        bias: args.bias,
        rows,
        notes,
    };
    let text = |error: std::io::Error| error.to_string();
    let picture = (args.preview.clone()).unwrap_or_else(|| args.out.with_extension("png"));
    preview.write_png(&picture).map_err(text)?;
    if let Some(json) = &args.json {
        let bytes = serde_json::to_vec_pretty(&report).map_err(|error| error.to_string())?;
        write_whole(json, &bytes).map_err(text)?;
    }
    if let Some(path) = &args.plot {
        let svg = plot(&report).ok_or("--plot: give several numbers of --directions")?;
        write_whole(path, svg.as_bytes()).map_err(text)?;
    }
    // Last: where it is, all is well.
    write_whole(&args.out, &bytes).map_err(text)?;
    Ok(report)
}

/// The error of each method against the number of directions.
fn plot(report: &Report) -> Option<String> {
    let mut series: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
    for row in &report.rows {
        let point = ((row.directions as f64).log2(), row.rmse_255);
        match series.iter_mut().find(|(method, _)| method == row.method) {
            Some((_, points)) => points.push(point),
            None => series.push((row.method.into(), vec![point])),
        }
    }
    // A picture of its own has no legend: the colours are a plot's first two.
    let colors = series.iter().zip(["blue", "orange"]);
    let legend: Vec<String> = colors
        .map(|((name, _), color)| format!("{color} {name}"))
        .collect();
    let plot = Plot {
        title: format!("{}: error against directions", report.scene),
        x_label: format!("directions, power of 2 ({})", legend.join(", ")),
        y_label: "root mean square error, 1/255".into(),
        series,
        log_y: true,
        form: Form::Lines,
    };
    plot.svg()
}

fn check(args: &BakeArgs) -> Result<(), String> {
    let most = crate::samples::MAX_RAYS;
    if args.directions.iter().any(|k| !(1..=most).contains(k)) {
        return Err(format!("--directions must be 1 to {most}"));
    }
    if args.ao_distance.is_nan() || args.ao_distance <= 0.0 {
        return Err("--ao-distance must be above 0 metres, or inf".into());
    }
    if args.method.contains(&MethodArg::Depth) {
        if args.ao_distance.is_finite() {
            return Err(
                "--ao-distance: a depth map shows only what is farthest from a surface, so that \
                 rays along it can't end: use --method rays, or leave the distance out"
                    .into(),
            );
        }
        if !(16..=8192).contains(&args.resolution) {
            return Err("--resolution must be 16 to 8192 texels".into());
        }
        if !(0.0..=64.0).contains(&args.bias) {
            return Err("--bias must be 0 to 64 texels".into());
        }
    }
    if args.onto.is_some() && args.to != Target::Texture {
        return Err(
            "--onto: a detailed scene goes into a plain one's textures: add --to texture".into(),
        );
    }
    if args.cage.is_some() && args.onto.is_none() {
        return Err("--cage is for --onto: how far the two scenes are apart".into());
    }
    if args
        .cage
        .is_some_and(|cage| !(cage > 0.0 && cage.is_finite()))
    {
        return Err("--cage must be above 0 metres".into());
    }
    if args.out.extension().is_none_or(|ending| ending != "glb") {
        return Err(format!(
            "--out {}: its name must end with .glb",
            args.out.display()
        ));
    }
    // Before anybody waits for it.
    let folder = args
        .out
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(|error| format!("--out: {}: {error}", folder.display()))
}

fn job(
    args: &BakeArgs,
    stage: &Stage,
    origins: &Origins,
    document: &mut Document,
) -> Result<Job, String> {
    let instances = 0..stage.scene.instances.len() as u32;
    let mut job = Job {
        numbers: match args.to {
            Target::Sh | Target::ShTexture => Numbers::Transfer(usize::from(args.order)),
            _ => Numbers::Openness,
        },
        elements: Vec::new(),
        starts: vec![0],
        texture: None,
        detail: None,
        points: Vec::new(),
    };
    match args.to {
        Target::Vertex | Target::Sh => {
            // Two texels of a depth map of 512.
            let inset_m = stage.sphere().1 / 128.0;
            for instance in instances {
                job.elements.extend(vertices(stage, instance, inset_m));
                job.starts.push(job.elements.len());
            }
        }
        Target::Texture | Target::ShTexture => {
            let mut second = Vec::new();
            for instance in instances {
                let (node, origin) = source(stage, origins, instance);
                let uvs = document.second_uvs(node, origin.primitive)?;
                second.push(uvs.and_then(|uvs| {
                    let pick = |vertex: &u32| uvs.get(*vertex as usize).copied();
                    origin.vertices.iter().map(pick).collect()
                }));
            }
            let atlas = Atlas::new(stage, args.size, &second)?;
            let (places, elements) = texels(stage, &atlas);
            job.elements = elements;
            job.texture = Some((atlas, places));
        }
        Target::Points => {
            for instance in instances {
                let points = Points::new(stage, instance, args.density, 1);
                let points = points.map_err(|error| error.to_string())?;
                job.elements.extend_from_slice(&points.elements);
                job.starts.push(job.elements.len());
                job.points.push(points);
            }
        }
    }
    Ok(job)
}

/// An instance's node, and where its mesh came from.
fn source<'a>(
    stage: &Stage,
    origins: &'a Origins,
    instance: u32,
) -> (usize, &'a crate::scene::MeshOrigin) {
    let mesh = stage.scene.instances[instance as usize].mesh;
    (
        origins.nodes[instance as usize],
        &origins.meshes[mesh as usize],
    )
}

fn error(numbers: Numbers, baked: &Baked, step: usize, reference: &[f32]) -> f64 {
    let (each, scale) = match numbers {
        Numbers::Openness => (1, 1.0),
        Numbers::Transfer(_) => (numbers.count(), sh::CONSTANT),
    };
    let values = baked.values.chunks(each).step_by(step);
    let openness: Vec<f32> = values.map(|values| values[0] / scale).collect();
    rmse_255(&openness, reference)
}

fn notes(stage: &Stage, document: &Document) -> Vec<String> {
    let mut notes = Vec::new();
    let dropped = &stage.scene.dropped;
    let mut note = |count: u64, what: &str| {
        if count > 0 {
            notes.push(format!("{count} {what}"));
        }
    };
    note(
        dropped.degenerate_triangles,
        "triangles of zero area or with a NaN were left out",
    );
    note(
        dropped.out_of_range_triangles,
        "triangles name vertices that are not there, and were left out",
    );
    note(dropped.non_finite_vertices, "vertices have a NaN");
    note(
        document.missing_images.len() as u64,
        "images are not there: the file still names them",
    );
    notes
}

/// Puts the values into the file.
fn write(
    stage: &Stage,
    origins: &Origins,
    mut document: Document,
    job: &Job,
    values: &[f32],
) -> Result<Vec<u8>, String> {
    let instances = 0..stage.scene.instances.len() as u32;
    let each = job.numbers.count();
    if let Some((atlas, places)) = &job.texture {
        let mut textures = Textures::default();
        match job.numbers {
            Numbers::Openness => {
                // Occlusion textures are read by their red channel, so that grey will do.
                let grey = (png::ColorType::Grayscale, png::BitDepth::Eight);
                let picture = encode_png(atlas, places, grey, &[1.0], |at, _| values[at])?;
                textures.occlusion = Some(document.add_texture("occlusion", &picture));
            }
            Numbers::Transfer(order) => {
                let width = width_of(each);
                let color = [png::ColorType::Rgb, png::ColorType::Rgba][width - 3];
                let form = (color, png::BitDepth::Sixteen);
                for part in 0..each / width {
                    // No coefficient is above 1 or below -1.
                    let value = |at: usize, channel: usize| {
                        values[at * each + part * width + channel] * 0.5 + 0.5
                    };
                    let picture = encode_png(atlas, places, form, &[0.5; 4][..width], value)?;
                    let name = format!("transfer {part}");
                    textures
                        .transfer
                        .push(document.add_texture(&name, &picture));
                }
                textures.order = order;
            }
        }
        if let Some(detail) = &job.detail {
            let rgb = (png::ColorType::Rgb, png::BitDepth::Eight);
            let value = |at: usize, axis: usize| detail.normals[at][axis] * 0.5 + 0.5;
            let picture = encode_png(atlas, places, rgb, &[0.5, 0.5, 1.0], value)?;
            textures.normal = Some(document.add_texture("normals", &picture));
        }
        let mut materials = BTreeMap::new();
        for (instance, charts) in instances.zip(&atlas.instances) {
            let (node, origin) = source(stage, origins, instance);
            let vertices: Vec<u32> = (charts.vertices.iter())
                .map(|(vertex, _)| origin.vertices[*vertex as usize])
                .collect();
            let uvs: Vec<Vec2> = charts.vertices.iter().map(|(_, uv)| *uv).collect();
            let set = document.uv_sets(node, origin.primitive)?;
            let triangles = &charts.triangles;
            document.rebuild(node, origin.primitive, &vertices, triangles, set, &uvs)?;
            let primitive = origin.primitive;
            if let Some(detail) = &job.detail {
                // The frame that the normal map is for: viewers must not make their own.
                let (_, normals) = stage.vertices(instance);
                let normals: Vec<f32> = (charts.vertices.iter())
                    .flat_map(|(vertex, _)| normals[*vertex as usize].to_array())
                    .collect();
                let tangents = detail.tangents[instance as usize].iter();
                let tangents: Vec<f32> = tangents.flat_map(|t| t.to_array()).collect();
                document.set_attribute(node, primitive, "NORMAL", &normals, 3)?;
                document.set_attribute(node, primitive, "TANGENT", &tangents, 4)?;
            }
            document.set_textures(node, primitive, &textures, set, &mut materials)?;
        }
        return document.finish();
    }
    for instance in instances {
        let (node, origin) = source(stage, origins, instance);
        let range = job.starts[instance as usize]..job.starts[instance as usize + 1];
        let values = &values[range.start * each..range.end * each];
        if let Some(points) = job.points.get(instance as usize) {
            let (positions, normals) = stage.vertices(instance);
            let triangles = &stage.mesh(instance).triangles;
            let place = |point: &crate::points::SurfacePoint| {
                let position = point.position(triangles, positions);
                let normal = point.normal(triangles, positions, normals);
                (position.to_array(), normal.to_array())
            };
            let (at, normals): (Vec<_>, Vec<_>) = points.points.iter().map(place).unzip();
            document.add_points(node, &at, &normals, values);
            continue;
        }
        // Vertices that no triangle uses are open; those that became several, for flat normals,
        // get the mean.
        let open = match job.numbers {
            Numbers::Openness => vec![1.0],
            Numbers::Transfer(_) => vec![0.0; each],
        };
        let mut sums = vec![0.0; origin.count * each];
        let mut counts = vec![0.0f32; origin.count];
        for (vertex, values) in origin.vertices.iter().zip(values.chunks(each)) {
            counts[*vertex as usize] += 1.0;
            let sums = &mut sums[*vertex as usize * each..][..each];
            sums.iter_mut()
                .zip(values)
                .for_each(|(sum, value)| *sum += value);
        }
        for (sums, count) in sums.chunks_mut(each).zip(&counts) {
            match *count {
                0.0 => sums.copy_from_slice(&open),
                count => sums.iter_mut().for_each(|sum| *sum /= count),
            }
        }
        match job.numbers {
            Numbers::Openness => {
                document.set_attribute(node, origin.primitive, "_OCCLUSION", &sums, 1)?;
            }
            Numbers::Transfer(_) => {
                let width = width_of(each);
                for part in 0..each / width {
                    let values: Vec<f32> = (sums.chunks(each))
                        .flat_map(|sums| sums[part * width..][..width].to_vec())
                        .collect();
                    let name = format!("_TRANSFER_{part}");
                    document.set_attribute(node, origin.primitive, &name, &values, width)?;
                }
            }
        }
    }
    document.finish()
}

/// Coefficients that are written together.
fn width_of(coefficients: usize) -> usize {
    if coefficients.is_multiple_of(4) { 4 } else { 3 }
}

/// A texture of an atlas as a PNG: `value` says an element's number in a channel, 0 to 1; `empty`
/// is each channel's where no chart is.
fn encode_png(
    atlas: &Atlas,
    places: &[u32],
    (color, depth): (png::ColorType, png::BitDepth),
    empty: &[f32],
    value: impl Fn(usize, usize) -> f32,
) -> Result<Vec<u8>, String> {
    let wide = depth == png::BitDepth::Sixteen;
    let each = if wide { 2 } else { 1 };
    let mut texels = vec![0; atlas.size as usize * atlas.size as usize * empty.len() * each];
    for channel in 0..empty.len() {
        let values = (0..places.len()).map(|at| value(at, channel));
        let picture = atlas.picture(places, values, empty[channel]);
        for (at, number) in picture.into_iter().enumerate() {
            let number = number.clamp(0.0, 1.0);
            let start = (at * empty.len() + channel) * each;
            if wide {
                let word = ((number * 65535.0).round() as u16).to_be_bytes();
                texels[start..start + 2].copy_from_slice(&word);
            } else {
                texels[start] = (number * 255.0).round() as u8;
            }
        }
    }
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, atlas.size, atlas.size);
    encoder.set_color(color);
    encoder.set_depth(depth);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(&texels)?;
        writer.finish()
    });
    written.map_err(|error| format!("the texture: {error}"))?;
    Ok(bytes)
}

/// The light that previews of spherical harmonics show: a bright patch over a dim sky, which turns
/// around the vertical (y), `turn` in radians.
pub fn environment(turn: f32, direction: Vec3) -> f32 {
    let (sin, cos) = turn.sin_cos();
    let sun = Vec3::new(0.75 * cos, 0.66, 0.75 * sin).normalize();
    0.25 + 0.15 * direction.y + 1.4 * (2.0 * (direction.dot(sun) - 1.0)).exp()
}

/// Which element each texel of an atlas shows.
struct Texels<'a> {
    atlas: &'a Atlas,
    elements: Vec<u32>,
}

impl Texels<'_> {
    fn new<'a>(atlas: &'a Atlas, places: &[u32]) -> Texels<'a> {
        let mut elements = vec![u32::MAX; atlas.size as usize * atlas.size as usize];
        for (element, place) in (0..).zip(places) {
            elements[*place as usize] = element;
        }
        Texels { atlas, elements }
    }

    /// The element of the texel at a hit.
    fn at(&self, hit: Hit) -> Option<usize> {
        let charts = &self.atlas.instances[hit.instance as usize];
        let uvs = charts.triangles[hit.triangle as usize]
            .map(|vertex| charts.vertices[vertex as usize].1);
        let uv = uvs[0] * (1.0 - hit.u - hit.v) + uvs[1] * hit.u + uvs[2] * hit.v;
        let edge = self.atlas.size as usize;
        let texel = |at: f32| ((at * edge as f32) as usize).min(edge - 1);
        let element = self.elements[texel(uv.y) * edge + texel(uv.x)];
        (element != u32::MAX).then_some(element as usize)
    }
}

/// What was baked, seen from within the scene.
fn preview(args: &BakeArgs, stage: &Stage, job: &Job, values: &[f32]) -> Result<Picture, String> {
    let [width, height] = PREVIEW;
    let aspect = width as f32 / height as f32;
    let tracer = stage.tracer()?;
    let vertices = |instance| stage.vertices(instance).0;
    let path = crate::args::path_through(&stage.scene, &stage.pose, &tracer, &vertices, 0, aspect)?;
    let camera = path.at(0.0);
    let hits: Vec<(Option<Hit>, Vec3)> = (0..width * height)
        .into_par_iter()
        .map(|pixel| {
            let (x, y) = (pixel % width, pixel / width);
            let (origin, direction) = camera.ray(x as u32, y as u32, width as u32, height as u32);
            let hit = tracer.closest(origin, direction, f32::INFINITY);
            let place = hit.map_or(Vec3::ZERO, |hit| origin + direction * hit.t);
            (hit, place)
        })
        .collect();
    let valid: Vec<bool> = hits.iter().map(|(hit, _)| hit.is_some()).collect();
    let picture = |shade: &(dyn Fn(Hit, Vec3) -> f32 + Sync)| {
        let grey: Vec<f32> = (hits.par_iter())
            .map(|(hit, place)| hit.map_or(0.0, |hit| shade(hit, *place)))
            .collect();
        Picture::grey(&grey, &valid, width, height)
    };
    let each = job.numbers.count();
    let texels = job
        .texture
        .as_ref()
        .map(|(atlas, places)| Texels::new(atlas, places));
    let corners = |hit: Hit| {
        let start = job.starts[hit.instance as usize];
        let triangle = stage.mesh(hit.instance).triangles[hit.triangle as usize];
        let weights = [1.0 - hit.u - hit.v, hit.u, hit.v];
        triangle
            .map(|vertex| start + vertex as usize)
            .into_iter()
            .zip(weights)
    };
    Ok(match args.to {
        Target::Vertex => picture(&|hit, _| corners(hit).map(|(at, w)| values[at] * w).sum()),
        Target::Sh | Target::ShTexture => {
            let panels: Vec<(String, Picture)> = [0.0f32, 90.0, 180.0, 270.0]
                .iter()
                .map(|degrees| {
                    let light = sh::project(|d| environment(degrees.to_radians(), d));
                    let lit = |at: usize| sh::relight(&light, &values[at * each..][..each]);
                    let lit = |hit: Hit, _: Vec3| match &texels {
                        Some(texels) => texels.at(hit).map_or(0.0, lit),
                        None => corners(hit).map(|(at, weight)| lit(at) * weight).sum(),
                    };
                    (format!("light turned by {degrees}"), picture(&lit))
                })
                .collect();
            let panels: Vec<(&str, &Picture)> = panels
                .iter()
                .map(|(title, picture)| (title.as_str(), picture))
                .collect();
            Picture::side_by_side(&panels)
        }
        Target::Texture => picture(&|hit, _| {
            let texel = texels.as_ref().and_then(|texels| texels.at(hit));
            texel.map_or(1.0, |at| values[at])
        }),
        Target::Points => {
            let cell = 4.0 * largest_radius(args.density) as f32;
            let mut grid: HashMap<[i32; 3], Vec<usize>> = HashMap::new();
            let key = |p: Vec3| (p / cell).floor().to_array().map(|c| c as i32);
            for (index, element) in job.elements.iter().enumerate() {
                grid.entry(key(element.position)).or_default().push(index);
            }
            picture(&|_, place| {
                let around = (0..27).filter_map(|n| {
                    let step = Vec3::new((n % 3) as f32, (n / 3 % 3) as f32, (n / 9) as f32);
                    grid.get(&key(place + (step - 1.0) * cell))
                });
                let distance = |at: &&usize| job.elements[**at].position.distance_squared(place);
                let nearest = around
                    .flatten()
                    .min_by(|a, b| distance(a).total_cmp(&distance(b)));
                nearest.map_or(1.0, |at| values[*at])
            })
        }
    })
}
