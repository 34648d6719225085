//! Occlusion by rays on the GPU: rays in, hits out, and rays a pixel over a G-buffer.
//!
//! What moves is asked of a few thousand points at a time, group by group, and its answers steer
//! what is asked next: that stays on the processor. This is for many rays at once, as when points
//! near what stands still converge.

use super::gbuffer::{GBuffer, Masks, Renderer};
use super::query::{Bodies, Count};
use super::{Gpu, Pass};
use crate::rays::{Fan, FanTracer, is_placed, wide_tree};
use crate::samples::Samples;
use crate::scene::{Pose, Scene};
use bytemuck::{Pod, Zeroable};
use glam::{Vec2, Vec3};
use obvhs::cwbvh::CwBvh;

/// A ray: `origin + t * direction` for 0 < t < `t_max`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Ray {
    /// Metres from the scene's origin; from [`crate::rays::offset_origin`].
    pub origin: Vec3,
    /// Metres; finite.
    pub t_max: f32,
    /// Unit vector.
    pub direction: Vec3,
    /// Nothing.
    pub unused: f32,
}

/// Most levels of a tree: the shader's stack.
const STACK: usize = 32;

/// Rays of one call of the shader, so that none takes longer than a driver waits.
const RAYS_A_CALL: usize = 1 << 19;

/// The same of fans, whose rays are short.
const FAN_RAYS_A_CALL: usize = 1 << 21;

/// As `Fan` in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct FanRow {
    origin: Vec3,
    set: u32,
    axes: [[f32; 4]; 3],
}

/// As `Trees` in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Trees {
    fixed_nodes: u32,
    moving_nodes: u32,
    fixed_triangles: u32,
    rays: u32,
    first: u32,
    t_max: f32,
    fan_words: u32,
    unused: u32,
}

/// Triangles under a tree, as the shader reads them.
#[derive(Default)]
struct Body {
    tree: CwBvh,
    triangles: Vec<[[f32; 4]; 3]>,
    uvs: Vec<[Vec2; 3]>,
}

/// Answers ray queries about a posed scene on a GPU. Threads: one at a time.
pub struct GpuTracer {
    trees: Trees,
    uniform: wgpu::Buffer,
    nodes: wgpu::Buffer,
    triangles: wgpu::Buffer,
    uvs: wgpu::Buffer,
    masks: Masks,
    directions: wgpu::Buffer,
    moves: Vec<bool>,
    fixed_uvs: usize,
    occluded: wgpu::ComputePipeline,
    pixels: wgpu::ComputePipeline,
    fans: wgpu::ComputePipeline,
    /// Where the device has ray queries.
    bodies: Option<Bodies>,
}

impl GpuTracer {
    /// Builds the trees. `samples` holds the directions that pixels and fans take.
    ///
    /// # Errors
    /// The device has no room for the scene, or its triangles are so nested that the tree is too
    /// deep for the shader.
    pub fn new(
        gpu: &Gpu,
        scene: &Scene,
        pose: &Pose,
        samples: &Samples,
    ) -> Result<GpuTracer, String> {
        let moves = scene.instances.iter().map(|i| i.moves || i.deforms);
        GpuTracer::of(gpu, scene, pose, samples, moves.collect())
    }

    fn of(
        gpu: &Gpu,
        scene: &Scene,
        pose: &Pose,
        samples: &Samples,
        moves: Vec<bool>,
    ) -> Result<GpuTracer, String> {
        let masks = Masks::new(gpu, scene)?;
        let fixed = Body::new(scene, pose, &masks, 0, |i| !moves[i])?;
        let moving = Body::new(scene, pose, &masks, fixed.uvs.len(), |i| moves[i])?;
        // Later poses need other trees over as many triangles; a node holds two or more.
        let mut nodes: Vec<[u32; 20]> = node_words(&fixed.tree);
        let fixed_nodes = nodes.len();
        nodes.resize(fixed_nodes + moving.triangles.len().max(1), [0; 20]);
        let mut triangles = fixed.triangles;
        let fixed_triangles = triangles.len();
        triangles.extend_from_slice(&moving.triangles);
        let mut uvs = fixed.uvs;
        let fixed_uvs = uvs.len();
        uvs.extend_from_slice(&moving.uvs);
        let source = concat!(include_str!("trees.wgsl"), "\n", include_str!("trace.wgsl"));
        let shader = gpu.shader("rays", source);
        let mut usage = wgpu::BufferUsages::STORAGE;
        if gpu.no_ray_query.is_none() {
            usage |= wgpu::BufferUsages::BLAS_INPUT;
        }
        let triangles_buffer = gpu.filled("traced triangles", &triangles, usage)?;
        let bodies = gpu.no_ray_query.is_none().then(|| {
            let count = |first, end, masked| Count {
                triangles: first as u32..end as u32,
                masked,
            };
            let counts = [
                count(0, fixed_triangles, fixed_uvs > 0),
                count(fixed_triangles, triangles.len(), uvs.len() > fixed_uvs),
            ];
            Bodies::new(gpu, &triangles_buffer, counts)
        });
        let trees = Trees {
            fixed_nodes: fixed_nodes as u32,
            moving_nodes: moving.tree.nodes.len() as u32,
            fixed_triangles: fixed_triangles as u32,
            ..Trees::zeroed()
        };
        let tracer = GpuTracer {
            trees,
            uniform: gpu.uniform("trees", &trees),
            nodes: gpu.storage("tree nodes", &nodes)?,
            triangles: triangles_buffer,
            uvs: gpu.storage("traced texture coordinates", &uvs)?,
            masks,
            directions: gpu.storage("directions", &samples.table())?,
            moves,
            fixed_uvs,
            occluded: gpu.compute(&shader, "occluded"),
            pixels: gpu.compute(&shader, "pixels"),
            fans: gpu.compute(&shader, "fans"),
            bodies,
        };
        tracer.write_moving_nodes(gpu, &moving.tree);
        Ok(tracer)
    }

    /// Moves what moves to another pose of the same scene.
    ///
    /// # Errors
    /// As [`GpuTracer::new`].
    pub fn pose(&mut self, gpu: &Gpu, scene: &Scene, pose: &Pose) -> Result<(), String> {
        let moves = &self.moves;
        let moving = Body::new(scene, pose, &self.masks, self.fixed_uvs, |i| moves[i])?;
        self.trees.moving_nodes = moving.tree.nodes.len() as u32;
        self.write_moving_nodes(gpu, &moving.tree);
        let at = u64::from(self.trees.fixed_triangles) * 48;
        gpu.queue
            .write_buffer(&self.triangles, at, bytemuck::cast_slice(&moving.triangles));
        let at = self.fixed_uvs as u64 * 24;
        gpu.queue
            .write_buffer(&self.uvs, at, bytemuck::cast_slice(&moving.uvs));
        if let Some(bodies) = &self.bodies {
            bodies.build(gpu, &self.triangles, 1..2);
        }
        Ok(())
    }

    fn write_moving_nodes(&self, gpu: &Gpu, tree: &CwBvh) {
        let at = u64::from(self.trees.fixed_nodes) * 80;
        let words = node_words(tree);
        gpu.queue
            .write_buffer(&self.nodes, at, bytemuck::cast_slice(&words));
    }

    /// What all kernels read; `found_by` is what a ray finds its triangles by.
    fn scene<'a>(
        &'a self,
        found_by: wgpu::BindingResource<'a>,
    ) -> [(u32, wgpu::BindingResource<'a>); 6] {
        [
            (0, self.uniform.as_entire_binding()),
            (1, found_by),
            (2, self.triangles.as_entire_binding()),
            (3, self.uvs.as_entire_binding()),
            (4, self.masks.info.as_entire_binding()),
            (5, self.masks.alpha.as_entire_binding()),
        ]
    }

    /// Whether anything is in the way of each ray: either side of a triangle, but for holes of
    /// masks.
    ///
    /// # Errors
    /// The device has no room for the rays, or is lost.
    pub fn occluded(&self, gpu: &Gpu, rays: &[Ray]) -> Result<Vec<bool>, String> {
        let mut all = Vec::with_capacity(rays.len());
        for part in rays.chunks(RAYS_A_CALL) {
            let trees = Trees {
                rays: part.len() as u32,
                ..self.trees
            };
            gpu.write(&self.uniform, bytemuck::bytes_of(&trees));
            let words = part.len().div_ceil(32);
            let hits = gpu.filled("hits", &vec![0u32; words], HITS)?;
            let asked = gpu.storage("rays", part)?;
            let mut resources = self.scene(self.nodes.as_entire_binding()).to_vec();
            resources.push((6, asked.as_entire_binding()));
            resources.push((7, hits.as_entire_binding()));
            let bound = gpu.bind(&self.occluded.get_bind_group_layout(0), &resources);
            let mut encoder = gpu.encoder();
            {
                let mut pass = encoder.begin_compute_pass(&Default::default());
                pass.set_pipeline(&self.occluded);
                pass.set_bind_group(0, &bound, &[]);
                pass.dispatch_workgroups(words.div_ceil(64) as u32, 1, 1);
            }
            gpu.queue.submit([encoder.finish()]);
            let hits: Vec<u32> = gpu.read(&hits)?;
            all.extend((0..part.len()).map(|i| hits[i / 32] >> (i % 32) & 1 == 1));
        }
        Ok(all)
    }

    /// Which rays of fans anything that stands still is in the way of: as
    /// [`FanTracer::occluded_fans`].
    fn occluded_fans(
        &self,
        gpu: &Gpu,
        fans: &[Fan<'_>],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) -> Result<(), String> {
        let words = fans.first().map_or(1, |fan| fan.directions.words().max(1));
        let fans_a_call = (FAN_RAYS_A_CALL / 64 / words).max(1);
        let bits = todo.chunks(fans_a_call * words);
        let bits = bits.zip(hit.chunks_mut(fans_a_call * words));
        for (fans, (todo, hit)) in fans.chunks(fans_a_call).zip(bits) {
            let row = |fan: &Fan<'_>| FanRow {
                origin: fan.origin,
                set: fan.directions.set,
                axes: fan.axes.to_cols_array_2d().map(|[x, y, z]| [x, y, z, 0.0]),
            };
            let rows: Vec<FanRow> = fans.iter().map(row).collect();
            // A fan from nowhere hits nothing, and must not get lost in the trees.
            let asked = todo
                .iter()
                .zip(&*hit)
                .enumerate()
                .flat_map(|(i, (todo, hit))| {
                    let open = if fans[i / words].origin.is_finite() {
                        todo & !hit
                    } else {
                        0
                    };
                    [open as u32, (open >> 32) as u32]
                });
            let asked: Vec<u32> = asked.collect();
            let trees = Trees {
                rays: asked.len() as u32,
                // Finite, which is far enough.
                t_max: t_max.min(1e30),
                fan_words: words as u32 * 2,
                ..self.trees
            };
            gpu.write(&self.uniform, bytemuck::bytes_of(&trees));
            let rows = gpu.storage("fans", &rows)?;
            let bits = gpu.filled("bits of rays", &asked, HITS)?;
            let asked_of = [
                (5, self.directions.as_entire_binding()),
                (7, rows.as_entire_binding()),
                (8, bits.as_entire_binding()),
            ];
            let workgroups = [asked.len().div_ceil(64) as u32, 1];
            let pipeline = self.fans.clone();
            let pass = Pass::new(
                gpu,
                "fans",
                pipeline,
                &[&self.scene(self.nodes.as_entire_binding()), &asked_of],
                workgroups,
            );
            let mut encoder = gpu.encoder();
            pass.record(&mut encoder);
            gpu.queue.submit([encoder.finish()]);
            let found: Vec<u32> = gpu.read(&bits)?;
            for (hit, found) in hit.iter_mut().zip(found.chunks_exact(2)) {
                *hit |= u64::from(found[0]) | u64::from(found[1]) << 32;
            }
        }
        Ok(())
    }

    /// A pass that traces rays of every pixel's set, `rays` of them from the `first` on, and puts
    /// the open share into an R32Float texture of the G-buffer's size; with `first` above 0, what
    /// an earlier pass put there counts for as many rays.
    pub fn pixels(
        &self,
        gpu: &Gpu,
        buffer: &GBuffer,
        renderer: &Renderer,
        openness: &wgpu::Texture,
        t_max_m: f32,
        rays: [u32; 2],
    ) -> Pass {
        let by_trees = (&self.pixels, self.nodes.as_entire_binding());
        self.pixels_by(by_trees, gpu, buffer, renderer, openness, t_max_m, rays)
    }

    /// As [`GpuTracer::pixels`], by the device's own ray queries; `None` where it has none.
    pub fn pixels_by_query(
        &self,
        gpu: &Gpu,
        buffer: &GBuffer,
        renderer: &Renderer,
        openness: &wgpu::Texture,
        t_max_m: f32,
        rays: [u32; 2],
    ) -> Option<Pass> {
        let bodies = self.bodies.as_ref()?;
        let by_query = (&bodies.pixels, bodies.scene.as_binding());
        Some(self.pixels_by(by_query, gpu, buffer, renderer, openness, t_max_m, rays))
    }

    fn pixels_by(
        &self,
        (pipeline, found_by): (&wgpu::ComputePipeline, wgpu::BindingResource<'_>),
        gpu: &Gpu,
        buffer: &GBuffer,
        renderer: &Renderer,
        openness: &wgpu::Texture,
        t_max_m: f32,
        [first, rays]: [u32; 2],
    ) -> Pass {
        let trees = Trees {
            rays,
            first,
            t_max: t_max_m,
            ..self.trees
        };
        let view = |texture: &wgpu::Texture| texture.create_view(&Default::default());
        let uniform = gpu.uniform("trees", &trees);
        let mut scene = self.scene(found_by).to_vec();
        scene[0].1 = uniform.as_entire_binding();
        let textures = [&buffer.position, &buffer.world, &buffer.depth, openness].map(view);
        let [position, world, depth, openness] =
            textures.each_ref().map(wgpu::BindingResource::TextureView);
        let pixels = [
            (0, buffer.eye.as_entire_binding()),
            (1, position),
            (2, world),
            (3, depth),
            (4, renderer.placed.as_entire_binding()),
            (5, self.directions.as_entire_binding()),
            (6, openness),
        ];
        let tiles = buffer.size.map(|edge| edge.div_ceil(8));
        Pass::new(gpu, "rays", pipeline.clone(), &[&scene, &pixels], tiles)
    }
}

/// Traces points' rays against what stands still, on the fastest device there is.
pub struct StillTracer {
    gpu: Gpu,
    samples: Samples,
    tracer: GpuTracer,
}

impl StillTracer {
    /// Opens the device and builds the trees. `rays`: of a point, as in
    /// [`Options::rays`](crate::world::Options::rays); `moves`: as [`FanTracer::divide`] takes it.
    ///
    /// # Errors
    /// There is no device, or as [`GpuTracer::new`].
    pub fn open(
        scene: &Scene,
        pose: &Pose,
        rays: usize,
        moves: &[bool],
    ) -> Result<StillTracer, String> {
        let gpu = Gpu::open()?;
        let samples = Samples::new(rays);
        let tracer = GpuTracer::of(&gpu, scene, pose, &samples, moves.to_vec())?;
        Ok(StillTracer {
            gpu,
            samples,
            tracer,
        })
    }
}

impl FanTracer for StillTracer {
    fn occluded_fans(
        &self,
        fans: &[Fan<'_>],
        t_max: f32,
        todo: &[u64],
        hit: &mut [u64],
    ) -> Result<(), String> {
        self.tracer.occluded_fans(&self.gpu, fans, t_max, todo, hit)
    }

    fn divide(&mut self, scene: &Scene, pose: &Pose, moves: &[bool]) -> Result<(), String> {
        self.tracer = GpuTracer::of(&self.gpu, scene, pose, &self.samples, moves.to_vec())?;
        Ok(())
    }
}

const HITS: wgpu::BufferUsages = wgpu::BufferUsages::STORAGE.union(wgpu::BufferUsages::COPY_SRC);

fn node_words(tree: &CwBvh) -> Vec<[u32; 20]> {
    bytemuck::pod_collect_to_vec(&tree.nodes)
}

impl Body {
    /// The instances that `belongs` names, in world space.
    fn new(
        scene: &Scene,
        pose: &Pose,
        masks: &Masks,
        first_uv: usize,
        belongs: impl Fn(usize) -> bool,
    ) -> Result<Body, String> {
        let mut corners: Vec<[Vec3; 3]> = Vec::new();
        // Of each triangle: its mask, and where its texture coordinates are.
        let mut of: Vec<[u32; 2]> = Vec::new();
        let mut body = Body::default();
        let (mut positions, mut normals) = (Vec::new(), Vec::new());
        for (index, instance) in scene
            .instances
            .iter()
            .enumerate()
            .filter(|(i, _)| belongs(*i))
        {
            let at = &pose.instances[index];
            let mesh = &scene.meshes[instance.mesh as usize];
            scene.deform(index, at, &mut positions, &mut normals);
            let mask = masks.of_mesh[instance.mesh as usize];
            let placed = is_placed(&at.world_from_local);
            for triangle in &mesh.triangles {
                let world = |i: u32| at.world_from_local.transform_point3(positions[i as usize]);
                // Triangles keep their number from pose to pose, so one that can't be hit is one
                // without an area.
                corners.push(if placed {
                    triangle.map(world)
                } else {
                    [Vec3::ZERO; 3]
                });
                of.push([mask, ((first_uv + body.uvs.len()) * 3) as u32]);
                if mask != 0 {
                    let uv = |i: u32| mesh.uvs.get(i as usize).copied().unwrap_or_default();
                    body.uvs.push(triangle.map(uv));
                }
            }
        }
        let (tree, depth) = wide_tree(&mut corners);
        if depth > STACK {
            return Err(format!(
                "the scene's triangles are nested {depth} boxes deep, more than the {STACK} that \
                 the GPU's tracer walks: trace on the processor"
            ));
        }
        body.triangles = tree
            .primitive_indices
            .iter()
            .map(|&i| {
                let [a, b, c] = corners[i as usize];
                // One triangle alone is there twice.
                let [mask, uv] = of[(i as usize).min(of.len() - 1)];
                [
                    a.extend(f32::from_bits(mask)).into(),
                    b.extend(f32::from_bits(uv)).into(),
                    c.extend(0.0).into(),
                ]
            })
            .collect();
        body.tree = tree;
        Ok(body)
    }
}
