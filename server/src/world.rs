//! The world: a scene with points on it, their occlusion traced, kept in buckets and cells.
//!
//! One [`World::step`] is the server's half of the frame up to selection:
//! `scene ─► points ─► occlusion ─► truth`. Nothing is traced that cannot have changed: rays
//! against geometry that a point is rigidly attached to are traced once and kept as bits; the
//! others again only when something moved within their reach.

mod between;
mod place;
mod turns;

use crate::facing::{Cone, EYE_M, Faces, LocalEye};
use crate::points::{PointError, SurfacePoint, largest_radius};
use crate::rays::{
    Against, CpuTracer, Deformed, Fan, FanTracer, TooManyTriangles, Tracer, offset_origin, reach,
};
use crate::samples::Samples;
use crate::scene::{InstancePose, Mesh, Pose, Scene};
use crate::topology::{Adjacency, PointSet, SLICE_BLOCKS, Topology};
use crate::truth::{Place, Placement, Truth, choose_buckets, fit};
use between::{Between, THIN};
use glam::{Affine3A, DAffine3, Vec3, Vec3A};
use place::{
    Placed, Sampled, distinct_cells, extent, place_instances, place_points, shared_points,
    try_places,
};
use psao_core::cell::CELL_POINTS;
use psao_core::residual::BLOCK;
use psao_core::topology::LEVELS;
use psao_core::{Instance, Kernel};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use turns::{Block, Cost, Due, Turn};

/// Points of a slice: the unit of visibility and of tracing.
pub const SLICE_POINTS: usize = 1024;

/// Rays of the first pass over a slice, before it converges to [`Options::rays`].
pub const FIRST_RAYS: usize = 64;

/// How points are placed and traced.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Points per square metre and side.
    pub density: f64,
    /// Longest ray, metres.
    pub ao_distance_m: f32,
    /// Rays a point, 1 to 4096.
    pub rays: usize,
    /// Rays that a step spends on points near what moves, about; `u64::MAX` for all that they
    /// need. Where that is less, those have their turn first whose lag is likely to show most; some
    /// change as points around them do before they are traced themselves; and all are up to date
    /// some steps after the last move. May be changed between steps.
    pub refresh_rays: u64,
    /// Kernel that the grid is laid out for.
    pub kernel: Kernel,
    /// Interpolation radius r over the largest Poisson radius rm.
    pub radius_over_rm: f32,
    /// Cell size c over r.
    pub cell_over_radius: f32,
    /// In rest space, points that a cell has room for; those that find none are dropped.
    /// [`CELL_POINTS`], but where points are tried that go into no stream.
    pub cell_capacity: usize,
    /// Points lie denser where occlusion changes fast, and less dense elsewhere: as many in all.
    pub adaptive: bool,
    /// Seed of the point placement.
    pub seed: u64,
    /// Points are laid out for profile `residual`: in rest space, a mesh's for all its instances
    /// ([`Topology`]). Else each instance has its own in cells ([`Truth`]), and those of deforming
    /// instances move through the cells of the posed local space, as in the paper.
    pub rest_space: bool,
    /// In rest space, clients may ask for levels of detail. Which level a point has costs bits, so
    /// without this it has one only where instances of different size share a mesh.
    pub levels: bool,
}

impl Options {
    /// The defaults of a kernel. `Paper`: r is the spacing that elimination reaches, 1.41 rm, and
    /// 2×2×2 cells cover the whole radius (c = 2r). `Planar`: r = 2 rm and c = 1.25 r, where
    /// 2×2×2 cells hold everything nearer than 0.625 r, and fewer points are read.
    pub fn of(kernel: Kernel) -> Options {
        let (radius_over_rm, cell_over_radius) = match kernel {
            Kernel::Paper => (1.41, 2.0),
            Kernel::Planar => (2.0, 1.25),
        };
        Options {
            density: 512.0,
            ao_distance_m: 0.6,
            rays: 256,
            refresh_rays: u64::MAX,
            kernel,
            radius_over_rm,
            cell_over_radius,
            cell_capacity: CELL_POINTS,
            adaptive: false,
            seed: 1,
            rest_space: false,
            levels: false,
        }
    }

    /// Interpolation radius, metres.
    pub fn radius_m(&self) -> f32 {
        largest_radius(self.density) as f32 * self.radius_over_rm
    }

    /// Cell size, metres.
    pub fn cell_m(&self) -> f32 {
        self.radius_m() * self.cell_over_radius
    }
}

/// Why a world could not be made.
#[derive(Debug)]
pub enum WorldError {
    /// Points could not be placed.
    Points(PointError),
    /// The scene is too large to trace.
    Triangles(TooManyTriangles),
    /// The scene has too many points for 32-bit numbers (how many).
    TooManyPoints(u64),
}

impl std::fmt::Display for WorldError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            WorldError::Points(error) => write!(f, "{error}"),
            WorldError::Triangles(error) => write!(f, "{error}"),
            WorldError::TooManyPoints(count) => write!(
                f,
                "the scene would get {count} points, more than {MAX_POINTS}: lower --density, or \
                 give --unit if the scene is not in metres"
            ),
        }
    }
}

impl std::error::Error for WorldError {}

impl From<PointError> for WorldError {
    fn from(error: PointError) -> WorldError {
        WorldError::Points(error)
    }
}

/// How far a camera may have moved before the points that it then sees are there, metres.
const LOOKAHEAD_M: f32 = 0.7;

/// How far below the scene instances are that are not in it.
const AWAY_M: f32 = 1e7;

/// Most points of a scene: about 90 bytes each.
pub const MAX_POINTS: u64 = 1 << 26;

/// A set of a slice's points, the first in the lowest bit of the first word.
pub type PointBits = [u64; SLICE_POINTS / 64];

/// A run of points of one instance in Morton order.
#[derive(Clone, Debug)]
pub struct Slice {
    /// Instance index.
    pub instance: u32,
    /// Numbers of its points.
    pub points: Range<u32>,
    /// Cells that its points opened; empty in rest space, and for deforming instances, whose
    /// cells come and go.
    pub cells: Range<u32>,
    /// In rest space its patch.
    pub patch: u32,
    /// World bounds now, with a cell's margin.
    pub bounds: [Vec3; 2],
    /// Bounds in local space, for rigid instances.
    local_bounds: [Vec3; 2],
    /// Rays whose fixed bits are known.
    rays_done: usize,
    /// Something within reach has moved since its points were traced.
    stale: bool,
}

/// An instance that carries points.
#[derive(Clone, Debug)]
struct Carrier {
    points: Range<u32>,
    slices: Range<u32>,
    /// Its points move through cells.
    loose: bool,
    /// Points have not been moved to the present pose.
    unplaced: bool,
}

/// Which way an instance's points face, in local space.
#[derive(Clone, Debug, Default)]
struct Cones {
    /// Block by block: a slice's at [`SLICE_BLOCKS`] times its patch's number in its set.
    blocks: Vec<Cone>,
    /// Slice by slice.
    slices: Vec<Cone>,
}

/// What one step did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StepStats {
    /// Rays traced.
    pub rays: u64,
    /// Rays if every visible point had been traced with all its rays, as in the paper.
    pub rays_if_all: u64,
    /// Points traced.
    pub points: u64,
    /// Visible slices that have not reached all their rays.
    pub converging: u64,
    /// Points near what moves, in blocks of [`BLOCK`], that wait for their turn.
    pub waiting: u64,
}

/// A progress report: stage, done, total.
pub type Progress<'a> = &'a (dyn Fn(&str, u64, u64) + Sync);

/// The scene, its points, and what they say.
pub struct World {
    /// The scene.
    pub scene: Scene,
    /// How it is sampled.
    pub options: Options,
    /// Where everything is.
    pub pose: Pose,
    /// Where clients look from, metres from the scene's origin: points near what moves are only
    /// brought up to date when they may face one ([`World::facing`]). None: all are.
    pub eyes: Vec<Vec3>,
    /// In rest space, of each instance the finest level of detail that a client has: points of
    /// finer levels wait, when something moves near them, until a client has them. An instance
    /// after the last, or of level 0, has all its points brought up to date.
    pub finest_levels: Vec<u32>,
    /// Instances' grids; and, unless [`Options::rest_space`], buckets and cells.
    pub truth: Truth,
    /// With [`Options::rest_space`], points a mesh.
    pub topology: Topology,
    /// All slices, instance by instance.
    pub slices: Vec<Slice>,
    /// Cells from here on belong to deforming instances, in no order.
    pub loose_cells: u32,
    /// Vertices of deforming instances.
    pub deformed: Vec<Deformed>,
    instance_of_bucket: Vec<u32>,
    /// Largest local coordinates of each mesh.
    extents: Vec<Vec3>,
    tracer: CpuTracer,
    /// What traces rays against what stands still in the processor's place.
    still: Option<Box<dyn FanTracer>>,
    samples: Samples,
    carriers: Vec<Option<Carrier>>,
    points: Vec<SurfacePoint>,
    /// Where points are in the truth's cells; empty in rest space.
    places: Vec<Place>,
    /// In rest space, the highest level of detail that has a point.
    levels: Vec<u8>,
    occlusion: Vec<u8>,
    /// In rest space, of each slice the blocks in which a point's occlusion has changed since
    /// [`World::clear_changes`].
    changed: Vec<u64>,
    /// In rest space, which way each instance's points face.
    cones: Vec<Arc<Cones>>,
    openness: Vec<Option<Openness>>,
    /// Rays against what each point is attached to: bits of those that hit.
    fixed: Vec<u64>,
    moves: Vec<bool>,
    /// Where each instance that moves is, now and at the step before.
    swept: Vec<[Hull; 2]>,
    /// Of each slice, which of its blocks are due.
    turns: Vec<Turn>,
    /// The blocks of all slices, [`SLICE_BLOCKS`] each.
    blocks: Vec<Block>,
    /// Of each instance.
    costs: Vec<Cost>,
    /// [`World::finest_levels`] of the last step, of every instance.
    stepped_levels: Vec<u32>,
    /// Calls of [`World::step`].
    steps: u64,
    /// Space for what the traced points say, kept from step to step.
    traced: Vec<u8>,
    driven: BTreeMap<u32, DAffine3>,
    /// Instances that are out of the scene for now.
    absent: BTreeSet<u32>,
    posed: BTreeMap<u32, Vec<Affine3A>>,
    previous: Pose,
}

impl World {
    /// Places points on a scene and sorts them into cells; nothing is traced yet.
    ///
    /// # Errors
    /// The density asks for more points, or the scene has more triangles, than there is room for.
    pub fn new(
        scene: Scene,
        options: Options,
        progress: Progress<'_>,
    ) -> Result<World, WorldError> {
        let mut pose = Pose::default();
        scene.pose(0.0, &mut pose);
        let moves: Vec<bool> = scene
            .instances
            .iter()
            .map(|i| i.moves || i.deforms)
            .collect();
        let mut deformed = Vec::new();
        for (index, instance) in scene.instances.iter().enumerate() {
            if instance.deforms {
                deformed.push(Deformed {
                    instance: index as u32,
                    ..Deformed::default()
                });
            }
        }
        deform(&scene, &pose, &mut deformed);
        let mut tracer =
            CpuTracer::new(&scene, &pose, &deformed, &moves).map_err(WorldError::Triangles)?;
        let users = shared_points(&scene, &pose, &deformed, &options)?;
        let factors = options
            .adaptive
            .then(|| try_places(&scene, &users, &options, &moves, &mut tracer, progress));
        let sets = place_points(&scene, users, factors, &options, progress)?;

        let mut world = World {
            samples: Samples::new(options.rays),
            truth: Truth::default(),
            slices: Vec::new(),
            instance_of_bucket: Vec::new(),
            extents: scene.meshes.iter().map(extent).collect(),
            loose_cells: 1,
            tracer,
            still: None,
            carriers: vec![None; scene.instances.len()],
            points: Vec::new(),
            places: Vec::new(),
            levels: Vec::new(),
            occlusion: Vec::new(),
            changed: Vec::new(),
            cones: Vec::new(),
            openness: Vec::new(),
            topology: Topology::default(),
            fixed: Vec::new(),
            swept: vec![[Hull::default(); 2]; scene.instances.len()],
            turns: Vec::new(),
            blocks: Vec::new(),
            costs: vec![Cost::default(); scene.instances.len()],
            eyes: Vec::new(),
            finest_levels: Vec::new(),
            stepped_levels: vec![0; scene.instances.len()],
            steps: 0,
            traced: Vec::new(),
            driven: BTreeMap::new(),
            absent: BTreeSet::new(),
            posed: BTreeMap::new(),
            previous: pose.clone(),
            moves,
            scene,
            options,
            pose,
            deformed,
        };
        if world.options.rest_space {
            world.build_topology(sets, progress);
        } else {
            world.build_cells(sets, progress);
        }
        world.occlusion = vec![255; world.points.len()];
        world.fixed = vec![0; world.points.len() * world.words()];
        world.turns = vec![Turn::default(); world.slices.len()];
        world.blocks = vec![Block::default(); world.slices.len() * SLICE_BLOCKS];
        for slice in 0..world.slices.len() {
            world.slices[slice].bounds = world.slice_bounds(slice);
        }
        world.sweep();
        world.sweep();
        Ok(world)
    }

    fn build_topology(&mut self, sets: Vec<Sampled>, progress: Progress<'_>) {
        let total = sets.len() as u64;
        let done = std::sync::atomic::AtomicU64::new(0);
        let mut of_instance = vec![None; self.scene.instances.len()];
        // The fewest points that are not much fewer than asked for.
        let level_of = |share: f32| {
            let few = |level: &u32| 0.5f32.powi(*level as i32) > 0.75 * share;
            (1..LEVELS).take_while(few).count() as u32
        };
        let made: Vec<Option<PointSet>> = sets
            .par_iter()
            .map(|sampled| {
                let asked = sampled.users.iter();
                let asked = asked.map(|(_, scale)| level_of(sampled.share(*scale)));
                let all = self.options.levels.then_some(LEVELS - 1);
                let highest = asked.chain(all).max().unwrap_or(0);
                let mesh = &self.scene.meshes[sampled.mesh as usize];
                let room = self.options.cell_capacity;
                let set = PointSet::new(mesh, &sampled.points, &sampled.grid?, highest, room);
                let so_far = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                progress("topology", so_far + 1, total);
                set
            })
            .collect();
        let mut kept = Vec::new();
        for (sampled, set) in sets.iter().zip(made) {
            let Some(set) = set else { continue };
            for &(instance, scale) in &sampled.users {
                let level = level_of(sampled.share(scale));
                of_instance[instance as usize] = Some((kept.len() as u32, level));
            }
            kept.push(set);
        }
        self.topology = Topology::new(kept, of_instance);
        let mut instances = vec![Instance::default(); self.scene.instances.len()];
        let mut buckets = 0;
        for (instance, grid) in instances.iter_mut().enumerate() {
            let Some((set, level)) = self.topology.of_instance[instance] else {
                continue;
            };
            *grid = self.topology.sets[set as usize].levels[level as usize].grid;
            grid.bucket_first = buckets;
            buckets += grid.bucket_count;
        }
        self.truth = Truth::new(instances, 0);
        for instance in 0..self.scene.instances.len() as u32 {
            self.add_patches(instance);
        }
        self.changed = vec![u64::MAX; self.slices.len()];
        self.cones = self.all_cones();
        let of_instance = &self.topology.of_instance;
        let mut adjacent: BTreeMap<(u32, u32), Arc<Adjacency>> = BTreeMap::new();
        for key in of_instance.iter().flatten() {
            adjacent.entry(*key).or_insert_with(|| {
                let set = &self.topology.sets[key.0 as usize];
                Arc::new(Adjacency::new(set, key.1))
            });
        }
        self.openness = of_instance
            .iter()
            .map(|key| key.map(|key| Openness::new(Arc::clone(&adjacent[&key]))))
            .collect();
    }

    /// An instance's slices: the patches of its set, with the points of its level.
    fn add_patches(&mut self, instance: u32) {
        let Some((set_index, level)) = self.topology.of_instance[instance as usize] else {
            return;
        };
        let first = self.points.len() as u32;
        let first_slice = self.slices.len() as u32;
        let set = &self.topology.sets[set_index as usize];
        for patch in 0..set.patches.len() {
            let slice_first = self.points.len() as u32;
            for point in set.patch_range(patch) {
                let coded = &set.coded[point];
                if u32::from(coded.level) >= level {
                    self.points.push(set.points[point]);
                    self.levels.push(coded.level);
                }
            }
            self.slices.push(Slice {
                instance,
                points: slice_first..self.points.len() as u32,
                cells: 0..0,
                patch: self.topology.first_patch[set_index as usize] + patch as u32,
                bounds: [Vec3::ZERO; 2],
                local_bounds: [Vec3::ZERO; 2],
                rays_done: 0,
                stale: true,
            });
        }
        self.carriers[instance as usize] = Some(Carrier {
            points: first..self.points.len() as u32,
            slices: first_slice..self.slices.len() as u32,
            loose: false,
            unplaced: false,
        });
        self.bound_slices(instance, first_slice);
    }

    fn build_cells(&mut self, sets: Vec<Sampled>, progress: Progress<'_>) {
        let placed = place_instances(&self.scene, &self.pose, &self.deformed, &self.options, sets);
        let total: usize = placed.iter().map(|p| p.points.len()).sum();
        let mut instances = vec![Instance::default(); self.scene.instances.len()];
        let (mut buckets, mut cells) = (0, 0);
        for placed in &placed {
            let mut grid = placed.grid;
            grid.bucket_first = buckets;
            buckets += grid.bucket_count;
            self.instance_of_bucket
                .resize(buckets as usize, placed.instance);
            // What moves opens new cells before the old ones are empty.
            cells += if placed.loose {
                placed.cells * 2 + 64
            } else {
                placed.cells
            };
            instances[placed.instance as usize] = grid;
        }
        self.truth = Truth::new(instances, cells);
        self.points.reserve_exact(total);
        self.places.reserve_exact(total);
        // Rigid instances first: their cells never change and lie slice by slice.
        let rigid = placed.iter().filter(|p| !p.loose);
        for placed in rigid.chain(placed.iter().filter(|p| p.loose)) {
            if placed.loose && self.loose_cells == 1 {
                self.loose_cells = self.truth.next_cell();
            }
            self.add_carrier(placed);
            progress("cells", self.points.len() as u64, total as u64);
        }
        if !placed.iter().any(|p| p.loose) {
            self.loose_cells = self.truth.next_cell();
        }
    }

    fn add_carrier(&mut self, placed: &Placed) {
        let first = self.points.len() as u32;
        let first_slice = self.slices.len() as u32;
        for (chunk, places) in placed
            .points
            .chunks(SLICE_POINTS)
            .zip(placed.placements.chunks(SLICE_POINTS))
        {
            let slice_first = self.points.len() as u32;
            let cell_first = self.truth.next_cell();
            for (point, at) in chunk.iter().zip(places) {
                let number = self.points.len() as u32;
                let place = match at {
                    Some(at) => self.truth.insert(placed.instance, number, *at, 255),
                    None => Place::NONE,
                };
                self.points.push(*point);
                self.places.push(place);
            }
            let cells = cell_first..self.truth.next_cell();
            self.slices.push(Slice {
                instance: placed.instance,
                points: slice_first..self.points.len() as u32,
                cells: if placed.loose { 0..0 } else { cells },
                patch: 0,
                bounds: [Vec3::ZERO; 2],
                local_bounds: [Vec3::ZERO; 2],
                rays_done: 0,
                stale: true,
            });
        }
        self.carriers[placed.instance as usize] = Some(Carrier {
            points: first..self.points.len() as u32,
            slices: first_slice..self.slices.len() as u32,
            loose: placed.loose,
            unplaced: false,
        });
        self.bound_slices(placed.instance, first_slice);
    }

    /// Local bounds of a rigid instance's slices.
    fn bound_slices(&mut self, instance: u32, first_slice: u32) {
        if !self.scene.instances[instance as usize].deforms {
            for slice in first_slice as usize..self.slices.len() {
                let range = self.slices[slice].points.clone();
                let positions = &self.mesh(instance).positions;
                self.slices[slice].local_bounds =
                    bounds_of(self.local_positions(instance, range, positions));
            }
        }
    }

    /// Which instances move, or may: the others stand still.
    pub fn moves(&self) -> &[bool] {
        &self.moves
    }

    /// From now on another device traces the rays that points on what stands still gain against
    /// what stands still; all others stay with the processor. If the device fails, the processor
    /// takes over, and a warning says so.
    pub fn trace_still_on(&mut self, device: Box<dyn FanTracer>) {
        self.still = Some(device);
    }

    /// Whether another device than the processor traces what [`World::trace_still_on`] says.
    pub fn has_device(&self) -> bool {
        self.still.is_some()
    }

    fn give_up_device(&mut self, why: &str) {
        tracing::warn!("{why}: the processor traces all rays from now on");
        self.still = None;
    }

    /// The engine (or a client) moves an instance from now on; world metres.
    ///
    /// # Errors
    /// There is no such instance.
    pub fn drive(&mut self, instance: u32, world_from_local: DAffine3) -> Result<(), NoInstance> {
        let known = (instance as usize) < self.scene.instances.len();
        known
            .then(|| self.driven.insert(instance, world_from_local))
            .ok_or(NoInstance(instance))?;
        if !self.moves[instance as usize] {
            self.promote(instance);
        }
        Ok(())
    }

    /// Takes an instance out of the scene, or puts it back where it would be: it neither has
    /// occlusion nor gives any while it is out.
    ///
    /// # Errors
    /// There is no such instance.
    pub fn set_present(&mut self, instance: u32, present: bool) -> Result<(), NoInstance> {
        if instance as usize >= self.scene.instances.len() {
            return Err(NoInstance(instance));
        }
        if present {
            self.absent.remove(&instance);
        } else if self.absent.insert(instance) && !self.moves[instance as usize] {
            self.promote(instance);
        }
        Ok(())
    }

    /// The instances that are not in the scene.
    pub fn absent(&self) -> impl Iterator<Item = u32> + '_ {
        self.absent.iter().copied()
    }

    /// Whether an instance is in the scene.
    pub fn is_present(&self, instance: u32) -> bool {
        !self.absent.contains(&instance)
    }

    /// The engine (or a client) poses a skinned instance from now on: local from rest, a joint.
    ///
    /// # Errors
    /// There is no such instance, or it has another number of joints.
    pub fn drive_joints(&mut self, instance: u32, joints: Vec<Affine3A>) -> Result<(), NoInstance> {
        let pose = self.pose.instances.get(instance as usize);
        if !pose.is_some_and(|pose| pose.joints.len() == joints.len() && !joints.is_empty()) {
            return Err(NoInstance(instance));
        }
        self.posed.insert(instance, joints);
        Ok(())
    }

    /// An instance that stood still begins to move: the bits of its own points, and of all
    /// within its reach, no longer hold.
    fn promote(&mut self, instance: u32) {
        self.moves[instance as usize] = true;
        self.sweep();
        let hull = self.swept[instance as usize][0];
        // It has no more triangles than before, so the tracer that fitted still fits.
        if let Ok(tracer) = CpuTracer::new(&self.scene, &self.pose, &self.deformed, &self.moves) {
            self.tracer = tracer;
        }
        if let Some(device) = &mut self.still
            && let Err(why) = device.divide(&self.scene, &self.pose, &self.moves)
        {
            self.give_up_device(&why);
        }
        let (reach, words) = (self.options.ao_distance_m, self.words());
        for slice in &mut self.slices {
            if slice.instance == instance || hull.is_near(slice.bounds, reach) {
                slice.rays_done = 0;
                slice.stale = true;
                let points = slice.points.start as usize..slice.points.end as usize;
                self.fixed[points.start * words..points.end * words].fill(0);
            }
        }
    }

    /// Advances to a time and brings the points of all `visible` slices up to date.
    ///
    /// `visible` is asked with world bounds relative to the scene's origin. `converge_rays` bounds
    /// the rays spent on slices that have not reached all their rays, beyond one such slice; 0 for
    /// none at all.
    pub fn step(
        &mut self,
        time_s: f64,
        visible: &(dyn Fn([Vec3; 2]) -> bool + Sync),
        converge_rays: u64,
    ) -> StepStats {
        self.steps += 1;
        self.pose_at(time_s);
        self.mark_stale();
        self.place_deforming(visible);
        self.owe_finer_levels();
        self.trace(
            visible,
            converge_rays,
            self.options.rays,
            self.options.refresh_rays,
            &|_, _| (),
        )
    }

    /// Traces all `visible` slices until each point has had `rays` of its rays (all of them if
    /// `rays` is more), in stages of rising numbers.
    pub fn converge(
        &mut self,
        visible: &(dyn Fn([Vec3; 2]) -> bool + Sync),
        rays: usize,
        report: &(dyn Fn(u64, u64) + Sync),
    ) -> StepStats {
        let mut total = StepStats::default();
        loop {
            let stats = self.trace(visible, u64::MAX, rays, u64::MAX, report);
            total.rays += stats.rays;
            total.points += stats.points;
            if stats.converging == 0 {
                return total;
            }
        }
    }

    fn pose_at(&mut self, time_s: f64) {
        std::mem::swap(&mut self.previous, &mut self.pose);
        self.scene.pose(time_s, &mut self.pose);
        for (&instance, world) in &self.driven {
            let local = DAffine3 {
                translation: world.translation - self.scene.origin,
                ..*world
            };
            self.pose.instances[instance as usize].world_from_local = single(local);
        }
        for &instance in &self.absent {
            // Out of everything's reach: it moves away as any mover does.
            let place = &mut self.pose.instances[instance as usize].world_from_local;
            place.translation = Vec3A::NEG_Y * AWAY_M;
        }
        for (&instance, joints) in &self.posed {
            self.pose.instances[instance as usize]
                .joints
                .clone_from(joints);
        }
        deform(&self.scene, &self.pose, &mut self.deformed);
        self.tracer.update(&self.scene, &self.pose, &self.deformed);
        self.sweep();
    }

    /// Takes the movers' bounds of the present pose.
    fn sweep(&mut self) {
        for instance in (0..self.moves.len()).filter(|&i| self.moves[i]) {
            let deforms = self.scene.instances[instance].deforms;
            let [now, _] = self.swept[instance];
            let local = match now.local {
                Some(local) if !deforms => local,
                _ => LocalHull::of(self.vertices(instance as u32).0),
            };
            let world = &self.pose.instances[instance].world_from_local;
            self.swept[instance] = [Hull::new(local, world), now];
        }
    }

    /// Marks the slices within reach of what moved since the last step.
    fn mark_stale(&mut self) {
        let mut swept = Vec::new();
        for instance in 0..self.scene.instances.len() {
            let (old, new) = (
                &self.previous.instances[instance],
                &self.pose.instances[instance],
            );
            let turned = old.world_from_local != new.world_from_local;
            let bent = old.joints != new.joints || old.morph_weights != new.morph_weights;
            if !(self.moves[instance] && (turned || bent)) {
                continue;
            }
            swept.push((instance as u32, self.swept[instance]));
            if let Some(carrier) = &mut self.carriers[instance] {
                carrier.unplaced |= carrier.loose;
                for slice in carrier.slices.clone() {
                    self.slices[slice as usize].stale = true;
                    self.slices[slice as usize].bounds = self.slice_bounds(slice as usize);
                }
            }
            if bent && self.scene.instances[instance].deforms && self.options.rest_space {
                self.cones[instance] = Arc::new(self.cones_of(instance as u32));
            }
        }
        let reach = self.options.ao_distance_m;
        self.slices.par_iter_mut().for_each(|slice| {
            slice.stale |= swept.iter().any(|(instance, hulls)| {
                let near = |hull: &Hull| hull.is_near(slice.bounds, reach);
                *instance != slice.instance && hulls.iter().any(near)
            });
        });
    }

    /// Where a finer level is wanted than at the last step, its points may have missed something.
    fn owe_finer_levels(&mut self) {
        for instance in 0..self.stepped_levels.len() as u32 {
            let now = self.finest_level(instance);
            let before = std::mem::replace(&mut self.stepped_levels[instance as usize], now);
            if now < before {
                for slice in self.slices_of(instance) {
                    let turn = &mut self.turns[slice as usize];
                    turn.owed |= turn.missed;
                    turn.had |= turn.missed;
                }
            }
        }
    }

    /// The finest level of an instance that is kept up to date.
    fn finest_level(&self, instance: u32) -> u32 {
        let wanted = self.finest_levels.get(instance as usize);
        wanted.copied().unwrap_or(0)
    }

    /// Moves the points of visible deforming instances to their cells in the present pose.
    fn place_deforming(&mut self, visible: &(dyn Fn([Vec3; 2]) -> bool + Sync)) {
        for instance in 0..self.carriers.len() {
            let Some(carrier) = &self.carriers[instance] else {
                continue;
            };
            let seen = |slice: u32| visible(self.slices[slice as usize].bounds);
            if !carrier.unplaced || !carrier.slices.clone().any(seen) {
                continue;
            }
            let points = carrier.points.clone();
            let place = |world: &World| {
                let grid = &world.truth.instances[instance];
                world.placements(instance as u32, points.clone(), grid)
            };
            let mut placements = place(self);
            if placements.iter().any(Option::is_none) {
                self.regrid(instance as u32, points.clone());
                placements = place(self);
            }
            for (point, at) in points.zip(placements) {
                self.move_point(instance as u32, point, at);
            }
            if let Some(carrier) = &mut self.carriers[instance] {
                carrier.unplaced = false;
            }
        }
    }

    fn move_point(&mut self, instance: u32, point: u32, at: Option<Placement>) {
        let (place, occlusion) = (self.places[point as usize], self.occlusion[point as usize]);
        if let Some(at) = at
            && self.truth.is_in_cell(place, instance, at)
        {
            self.truth.set_point(place, at, occlusion);
            return;
        }
        if let Some((moved, to)) = self.truth.remove(place) {
            self.places[moved as usize] = to;
        }
        self.places[point as usize] = match at {
            Some(at) => self.truth.insert(instance, point, at, occlusion),
            None => Place::NONE,
        };
    }

    /// A deforming instance has left its grid: a larger one.
    fn regrid(&mut self, instance: u32, points: Range<u32>) {
        let positions = &self.vertices(instance).0;
        let [min, max] = bounds_of(self.local_positions(instance, points.clone(), positions));
        let margin = (max - min) * 0.25;
        let scale = scale_of(&self.pose.instances[instance as usize].world_from_local);
        let (cell_m, radius) = (self.options.cell_m(), 1.0 / self.options.cell_over_radius);
        // A pose that no grid fits (not finite, or flattened) leaves its points discarded.
        if let Some(mut grid) = fit([min - margin, max + margin], scale, cell_m, radius) {
            let placements = self.placements(instance, points.clone(), &grid);
            let cells = distinct_cells(&placements);
            grid.bucket_count = choose_buckets(&grid, &cells, self.truth.bucket_room(instance));
            self.truth.regrid(instance, grid);
            self.places[points.start as usize..points.end as usize].fill(Place::NONE);
        }
    }

    fn placements(
        &self,
        instance: u32,
        points: Range<u32>,
        grid: &Instance,
    ) -> Vec<Option<Placement>> {
        let triangles = &self.mesh(instance).triangles;
        let (positions, normals) = self.vertices(instance);
        self.points[points.start as usize..points.end as usize]
            .par_iter()
            .map(|p| {
                let position = p.position(triangles, positions);
                Placement::of(grid, position, p.normal(triangles, positions, normals))
            })
            .collect()
    }

    /// Traces what is visible and due. Slices with less than `goal` of their rays gain some, as far
    /// as `converge_rays` goes; the others' blocks have their turn, as far as `refresh_rays` goes.
    fn trace(
        &mut self,
        visible: &(dyn Fn([Vec3; 2]) -> bool + Sync),
        converge_rays: u64,
        goal: usize,
        refresh_rays: u64,
        report: &(dyn Fn(u64, u64) + Sync),
    ) -> StepStats {
        let all = self.options.rays;
        let mut stats = StepStats::default();
        // Slices with something to do, and the rays that their points are to have had.
        let mut asked: Vec<(usize, usize)> = Vec::new();
        let mut budget = converge_rays;
        let of_slices = self.slices.par_iter();
        let is_visible: Vec<bool> = of_slices.map(|slice| visible(slice.bounds)).collect();
        let slices = self.slices.iter().zip(&mut self.turns).zip(is_visible);
        for (index, ((slice, turn), is_visible)) in slices.enumerate() {
            if !is_visible || self.absent.contains(&slice.instance) {
                continue;
            }
            turn.is_new = turn.seen_at + 1 < self.steps;
            turn.seen_at = self.steps;
            let points = slice.points.len() as u64;
            stats.rays_if_all += points * all as u64;
            let mut rays = slice.rays_done;
            if rays < goal.min(all) {
                // Deforming points keep no bits, so they start with all rays.
                let deforms = self.scene.instances[slice.instance as usize].deforms;
                let next = if deforms {
                    all
                } else {
                    (rays * 2).max(FIRST_RAYS).min(all)
                };
                let cost = (next - rays) as u64 * points;
                // The first one may cost more, so that small budgets get there too.
                if cost <= budget || budget == converge_rays && budget > 0 {
                    budget = budget.saturating_sub(cost);
                    rays = next;
                }
                stats.converging += u64::from(rays < goal.min(all));
            }
            if rays > slice.rays_done || slice.stale || turn.owed > 0 {
                asked.push((index, rays));
            }
        }
        let (due, waiting) = self.take_turns(&asked, refresh_rays);
        stats.waiting = waiting;
        (stats.rays, stats.points) = self.trace_due(&due, report);
        stats
    }

    /// Traces blocks, slice by slice in order. How many rays and points.
    fn trace_due(&mut self, due: &[Due], report: &(dyn Fn(u64, u64) + Sync)) -> (u64, u64) {
        let words = self.words();
        // Out of the world, so that threads can fill their parts of them.
        let (mut fixed, mut traced) = (
            std::mem::take(&mut self.fixed),
            std::mem::take(&mut self.traced),
        );
        let parts = |due: &Due| -> Vec<(Range<u32>, [u8; 2])> {
            let points = &self.slices[due.slice].points;
            let firsts = points.clone().step_by(BATCH_POINTS).enumerate();
            let parts = firsts.map(|(part, first)| {
                let last = points.end.min(first + BATCH_POINTS as u32);
                let first_block = part * BATCH_POINTS / BLOCK;
                let own = [due.blocks, due.thin].map(|blocks| (blocks >> first_block) as u8);
                (first..last, own)
            });
            parts.filter(|(_, [blocks, _])| *blocks > 0).collect()
        };
        let parts: Vec<(&Due, Range<u32>, [u8; 2])> = due
            .iter()
            .flat_map(|due| parts(due).into_iter().map(move |(p, b)| (due, p, b)))
            .collect();
        let total: usize = parts.iter().map(|(_, points, _)| points.len()).sum();
        traced.resize(total, 0);
        let mut batches = Vec::with_capacity(parts.len());
        let (mut bits, mut bits_from, mut occlusion) = (&mut fixed[..], 0, &mut traced[..]);
        for (due, points, [blocks, thin]) in parts {
            let from = points.start as usize * words;
            let skipped = bits.split_at_mut(from - bits_from).1;
            let (own, rest) = skipped.split_at_mut(points.len() * words);
            (bits, bits_from) = (rest, points.end as usize * words);
            let (own_occlusion, rest) = occlusion.split_at_mut(points.len());
            occlusion = rest;
            batches.push(Batch {
                slice: due.slice,
                points,
                rays: due.rays,
                blocks,
                thin,
                taken: 0,
                still: None,
                fixed: own,
                occlusion: own_occlusion,
            });
        }
        if let Some(device) = &self.still
            && let Err(why) = self.trace_still(&**device, &mut batches)
        {
            self.give_up_device(&why);
        }
        let done = std::sync::atomic::AtomicU64::new(0);
        let counts = batches
            .par_iter_mut()
            .with_max_len(2)
            .map(|batch| {
                let counts = self.trace_batch(batch);
                let points = batch.points.len() as u64;
                let so_far = done.fetch_add(points, std::sync::atomic::Ordering::Relaxed);
                report(so_far + points, total as u64);
                counts
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        let mut batches = batches.iter().peekable();
        for due in due {
            let slice = &self.slices[due.slice];
            // An instance has no points of finer levels than its own.
            let whole = due.rays > slice.rays_done
                || Some(self.finest_level(slice.instance)) <= self.level_of(slice.instance);
            let turn = &mut self.turns[due.slice];
            let exact = due.blocks & !due.thin;
            turn.owed &= !exact;
            turn.had = turn.had & !exact | turn.near & due.blocks;
            if whole {
                turn.missed &= !exact;
            } else {
                turn.missed |= due.blocks;
            }
            let mut changed = 0;
            while let Some(batch) = batches.next_if(|batch| batch.slice == due.slice) {
                changed |= self.take_in(batch);
            }
            self.slices[due.slice].rays_done = due.rays;
            if changed != 0 && self.options.rest_space {
                self.note_change(due.slice, changed);
            }
        }
        (self.fixed, self.traced) = (fixed, traced);
        counts
    }

    /// Keeps what a batch's points say; the blocks of the slice that changed.
    fn take_in(&mut self, batch: &Batch<'_>) -> u64 {
        let slice = &self.slices[batch.slice];
        let first = (batch.points.start - slice.points.start) as usize / BLOCK;
        let gained = batch.rays > slice.rays_done;
        if !gained {
            self.costs[slice.instance as usize].traced += batch.taken as f32;
        }
        let mut changed = 0;
        for (number, occlusion) in batch.occlusion.chunks(BLOCK).enumerate() {
            if batch.blocks >> number & 1 == 0 {
                continue;
            }
            let start = batch.points.start as usize + number * BLOCK;
            let mut squares = 0;
            for (point, &occlusion) in (start..).zip(occlusion) {
                let off = u32::from(self.occlusion[point].abs_diff(occlusion));
                squares += off * off;
                if off > 0 {
                    self.occlusion[point] = occlusion;
                    if let Some(place) = self.places.get(point) {
                        self.truth.set_occlusion(*place, occlusion);
                    }
                }
            }
            changed |= u64::from(squares > 0) << (first + number);
            let block = &mut self.blocks[batch.slice * SLICE_BLOCKS + first + number];
            if !gained {
                let change = (squares as f32 / occlusion.len() as f32).sqrt();
                let rate = change / block.age(self.steps).max(1.0);
                // One step without a change says little of the next.
                block.rate = rate.max(block.rate * 0.5);
                block.note_turn(batch.thin >> number & 1 == 1, change);
            }
            block.traced_at = self.steps;
        }
        changed
    }

    /// Traces on `device` the rays that points on what stands still gain against what stands
    /// still. Batches that it did not get to are left to the processor.
    fn trace_still(&self, device: &dyn FanTracer, batches: &mut [Batch<'_>]) -> Result<(), String> {
        let words = self.words();
        let slice = |batch: &Batch<'_>| &self.slices[batch.slice];
        let gains = |batch: &&mut Batch<'_>| {
            batch.rays > slice(batch).rays_done && !self.moves[slice(batch).instance as usize]
        };
        let mut gaining: Vec<&mut Batch<'_>> = batches.iter_mut().filter(gains).collect();
        for batches in gaining.chunks_mut(DEVICE_BATCHES) {
            let fans = batches.par_iter().flat_map_iter(|batch| {
                let surface = self.surface(slice(batch).instance);
                let fan = move |number: u32| {
                    let point = &self.points[number as usize];
                    self.fan(
                        &surface,
                        number,
                        surface.position(point),
                        surface.normal(point),
                    )
                };
                batch.points.clone().map(fan)
            });
            let fans: Vec<Fan<'_>> = fans.collect();
            let mut todo = vec![0; fans.len() * words];
            let mut hit = todo.clone();
            let (mut left, mut asked) = (&fans[..], todo.chunks_exact_mut(words));
            for batch in &mut *batches {
                let (own, rest) = left.split_at(batch.points.len());
                left = rest;
                for (fan, todo) in own.iter().zip(&mut asked) {
                    fan.directions
                        .mark_given(slice(batch).rays_done..batch.rays, todo);
                }
            }
            device.occluded_fans(&fans, self.options.ao_distance_m, &todo, &mut hit)?;
            let (mut todo, mut hit) = (&todo[..], &hit[..]);
            for batch in &mut *batches {
                let of_batch = batch.fixed.len();
                batch.still = Some(open(&todo[..of_batch], batch.fixed));
                for (fixed, hit) in batch.fixed.iter_mut().zip(hit) {
                    *fixed |= hit;
                }
                (todo, hit) = (&todo[of_batch..], &hit[of_batch..]);
            }
        }
        Ok(())
    }

    /// An instance as its points lie on it in the present pose.
    fn surface(&self, instance: u32) -> Surface<'_> {
        let (positions, normals) = self.vertices(instance);
        Surface {
            triangles: &self.mesh(instance).triangles,
            positions,
            normals,
            pose: &self.pose.instances[instance as usize],
            reach: self.reach(instance),
        }
    }

    /// A point's rays from where it is in the world.
    fn fan(&self, on: &Surface<'_>, number: u32, position: Vec3, normal: Vec3) -> Fan<'_> {
        let point = &self.points[number as usize];
        let outward = point.geometric_normal(on.triangles, on.positions);
        let origin = offset_origin(position, on.pose.world_normal(outward), on.reach);
        let tangent = point.tangent(on.triangles, on.positions);
        let tangent = on.pose.world_from_local.transform_vector3(tangent);
        self.samples.fan(number, origin, normal, tangent)
    }

    /// Traces some points of a slice; rays and points that were traced.
    fn trace_batch(&self, batch: &mut Batch<'_>) -> (u64, u64) {
        let slice = &self.slices[batch.slice];
        let instance = slice.instance;
        let deforms = self.scene.instances[instance as usize].deforms;
        let (attached, others) = match (deforms, self.moves[instance as usize]) {
            (true, _) => (None, Against::All),
            (false, true) => (
                Some(Against::Instance(instance)),
                Against::AllExcept(instance),
            ),
            (false, false) => (Some(Against::Static), Against::Movers),
        };
        let surface = self.surface(instance);
        let t_max = self.options.ao_distance_m;
        let (rays, words) = (batch.rays, self.words());
        let converging = rays > slice.rays_done;
        // Bits that stay are found for all points at once.
        let finest = match converging {
            true => 0,
            false => self.finest_level(instance),
        };
        let near = |hull: &Hull| hull.is_near(slice.bounds, t_max);
        let movers = (0..self.moves.len()).filter(|&mover| self.moves[mover]);
        let movers: Vec<Hull> = movers
            .map(|mover| self.swept[mover][0])
            .filter(near)
            .collect();
        let (mut todo, mut hit, mut known) = (vec![0; words], vec![0; words], vec![0; words]);
        let (mut rays_traced, mut points_traced) = (batch.still.unwrap_or(0), 0);
        let first_block = (batch.points.start - slice.points.start) as usize / BLOCK;
        let turns = &self.blocks[batch.slice * SLICE_BLOCKS + first_block..];
        let mut between = [Between::default(); BATCH_POINTS / BLOCK];
        let mut untraced: Vec<(usize, Vec3, Vec3)> = Vec::new();
        let parts = batch
            .fixed
            .chunks_exact_mut(words)
            .zip(&mut *batch.occlusion);
        for (number, (fixed, occlusion)) in batch.points.clone().zip(parts) {
            let index = (number - batch.points.start) as usize;
            let block = index / BLOCK;
            if batch.blocks >> block & 1 == 0 {
                continue;
            }
            let level = self.levels.get(number as usize);
            if level.is_some_and(|level| u32::from(*level) < finest) {
                *occlusion = self.occlusion[number as usize];
                continue;
            }
            let point = &self.points[number as usize];
            let position = surface.position(point);
            let only_movers = others == Against::Movers;
            let in_reach = |mover: &&Hull| mover.is_within(position, t_max);
            if only_movers && !converging && !movers.iter().any(|m| in_reach(&m)) {
                *occlusion = openness(fixed, rays);
                continue;
            }
            let normal = surface.normal(point);
            let ahead = |mover: &&Hull| in_reach(mover) && mover.is_ahead(position, normal);
            let others_near = !only_movers || movers.iter().any(|m| ahead(&m));
            if !converging && !others_near {
                *occlusion = openness(fixed, rays);
                continue;
            }
            let thin = batch.thin >> block & 1 == 1;
            if thin && index % THIN != usize::from(turns[block].number) % THIN {
                untraced.push((index, position, normal));
                *occlusion = openness(fixed, rays);
                continue;
            }
            let fan = self.fan(&surface, number, position, normal);
            points_traced += 1;
            hit.fill(0);
            if let Some(attached) = attached {
                if converging && batch.still.is_none() {
                    fan.directions.mark_given(slice.rays_done..rays, &mut todo);
                    rays_traced += open(&todo, fixed);
                    self.tracer
                        .occluded_fan(attached, &fan, t_max, &todo, fixed);
                }
                hit.copy_from_slice(fixed);
            }
            if others_near {
                fan.directions.mark_given(0..rays, &mut todo);
                // A ray that hit what the point is attached to needs no other; nor, where only
                // movers are left, does one that leaves beside all of them.
                if only_movers {
                    known.fill(0);
                    for mover in movers.iter().filter(ahead) {
                        mark_towards(mover, &fan, &mut known);
                    }
                    todo.iter_mut().zip(&known).for_each(|(t, k)| *t &= k);
                }
                rays_traced += open(&todo, &hit);
                self.tracer
                    .occluded_fan(others, &fan, t_max, &todo, &mut hit);
            }
            *occlusion = openness(&hit, rays);
            if thin {
                let before = self.occlusion[number as usize];
                let change = f32::from(*occlusion) - f32::from(before);
                between[block].learn(position, normal, change);
            }
        }
        let before = &self.occlusion[batch.points.start as usize..];
        for (index, position, normal) in untraced {
            let change = between[index / BLOCK].change_at(position, normal);
            // Not more open than without what moves.
            let most = &mut batch.occlusion[index];
            *most = ((f32::from(before[index]) + change).round() as u8).min(*most);
        }
        batch.taken = rays_traced;
        (rays_traced, points_traced)
    }

    fn mesh(&self, instance: u32) -> &Mesh {
        &self.scene.meshes[self.scene.instances[instance as usize].mesh as usize]
    }

    /// Present local positions and normals of an instance's vertices.
    pub fn vertices(&self, instance: u32) -> (&[Vec3], &[Vec3]) {
        match self
            .deformed
            .binary_search_by_key(&instance, |d| d.instance)
        {
            Ok(index) => (
                &self.deformed[index].positions,
                &self.deformed[index].normals,
            ),
            Err(_) => (&self.mesh(instance).positions, &self.mesh(instance).normals),
        }
    }

    /// How coarse an instance's world positions are, for [`offset_origin`].
    pub fn reach(&self, instance: u32) -> f32 {
        let extent = self.extents[self.scene.instances[instance as usize].mesh as usize];
        reach(
            &self.pose.instances[instance as usize].world_from_local,
            extent,
        )
    }

    /// The instance whose buckets include `bucket`.
    pub fn instance_of_bucket(&self, bucket: u32) -> u32 {
        self.instance_of_bucket[bucket as usize]
    }

    /// Positions and normals of an instance's vertices in the space that its grid is in.
    pub fn grid_vertices(&self, instance: u32) -> (&[Vec3], &[Vec3]) {
        if self.options.rest_space {
            (&self.mesh(instance).positions, &self.mesh(instance).normals)
        } else {
            self.vertices(instance)
        }
    }

    /// The tracer, for pictures.
    pub fn tracer(&self) -> &dyn Tracer {
        &self.tracer
    }

    /// What the points of a slice say, in their order: 255 is open, 0 fully occluded.
    pub fn occlusion(&self, slice: &Slice) -> &[u8] {
        &self.occlusion[slice.points.start as usize..slice.points.end as usize]
    }

    /// Points, discarded ones included.
    pub fn point_count(&self) -> usize {
        self.points.len()
    }

    /// In rest space, the highest level of detail that has each point of a slice.
    pub fn levels(&self, slice: &Slice) -> &[u8] {
        &self.levels[slice.points.start as usize..slice.points.end as usize]
    }

    /// A point's position and normal in the space that its instance's grid is in.
    pub fn grid_point(&self, instance: u32, number: u32) -> (Vec3, Vec3) {
        let (positions, normals) = self.grid_vertices(instance);
        let point = &self.points[number as usize];
        let triangles = &self.mesh(instance).triangles;
        (
            point.position(triangles, positions),
            point.normal(triangles, positions, normals),
        )
    }

    /// A point's position (metres from the scene's origin) and unit normal in the world now.
    pub fn point_in_world(&self, instance: u32, number: u32) -> [Vec3; 2] {
        let (positions, normals) = self.vertices(instance);
        let point = &self.points[number as usize];
        let triangles = &self.mesh(instance).triangles;
        let pose = &self.pose.instances[instance as usize];
        [
            pose.world_from_local
                .transform_point3(point.position(triangles, positions)),
            pose.world_normal(point.normal(triangles, positions, normals)),
        ]
    }

    /// What a point says: 255 is open, 0 fully occluded.
    pub fn occlusion_of(&self, number: u32) -> u8 {
        self.occlusion[number as usize]
    }

    /// Where a point is in the truth's cells: its cell, and its place there. `None` in rest space,
    /// and where there is no room for it.
    pub fn place_of(&self, number: u32) -> Option<(u32, usize)> {
        let place = self.places.get(number as usize)?;
        place.cell().map(|cell| (cell, place.slot()))
    }

    /// In rest space: the level of detail that an instance's scale asks for, if it has points.
    pub fn level_of(&self, instance: u32) -> Option<u32> {
        let own = self.topology.of_instance.get(instance as usize)?;
        own.map(|(_, level)| level)
    }

    /// In rest space: the coarsest level of detail that an instance can have; 0 if it has no
    /// points.
    pub fn coarsest(&self, instance: u32) -> u32 {
        let set = self.topology.set_of(instance);
        set.map_or(0, |set| set.levels.len() as u32 - 1)
    }

    /// In rest space: an instance's grid at a level of detail, not below [`World::level_of`] and
    /// not above [`World::coarsest`].
    pub fn grid(&self, instance: u32, level: u32) -> Instance {
        let own = self.truth.instances[instance as usize];
        let Some(set) = self.topology.set_of(instance) else {
            return own;
        };
        Instance {
            bucket_first: own.bucket_first,
            ..set.levels[level as usize].grid
        }
    }

    /// Whether any of some points of a slice, which `seed` chooses, can be seen from `eye` or from
    /// less than 0.7 m around it.
    pub fn is_seen(&self, slice: &Slice, eye: Vec3, samples: u32, seed: u32) -> bool {
        let triangles = &self.mesh(slice.instance).triangles;
        let (positions, normals) = self.vertices(slice.instance);
        let pose = &self.pose.instances[slice.instance as usize];
        let reach = self.reach(slice.instance);
        let count = slice.points.len() as u32;
        let mut random = seed;
        let mut next = || {
            random = random.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            let mixed = (random >> 16 ^ random).wrapping_mul(0x7feb_352d);
            mixed ^ mixed >> 15
        };
        (0..samples).any(|sample| {
            let number = slice.points.start + next() % count.max(1);
            let point = &self.points[number as usize];
            let position = point.position(triangles, positions);
            let position = pose.world_from_local.transform_point3(position);
            let outward = pose.world_normal(point.geometric_normal(triangles, positions));
            let origin = offset_origin(position, outward, reach);
            // Every other time from where it may be soon.
            let mut aside = || ((next() >> 8) as f32 / (1 << 23) as f32 - 1.0) * LOOKAHEAD_M;
            let aside = Vec3::new(aside(), aside(), aside());
            let eye = if sample % 2 == 0 { eye } else { eye + aside };
            let (direction, far) = (eye - origin).normalize_and_length();
            // The triangle says it nearly always, and is at hand already.
            let facing = || pose.world_normal(point.normal(triangles, positions, normals));
            if direction.dot(outward) <= 0.0 && direction.dot(facing()) <= 0.0 {
                return false;
            }
            let mut hit = [0];
            self.tracer
                .occluded(Against::All, origin, &[direction], far, &[1], &mut hit);
            hit == [0]
        })
    }

    /// In rest space: slices that have points around a place in the space of an instance's grid.
    pub fn slices_near(&self, instance: u32, position: Vec3) -> impl Iterator<Item = u32> + '_ {
        let set = self.topology.set_of(instance);
        let patches = set.map_or(&[][..], |set| set.patches_near(position));
        let first = self.slices_of(instance).start;
        patches.iter().map(move |patch| first + patch)
    }

    /// Numbers of an instance's slices.
    pub fn slices_of(&self, instance: u32) -> Range<u32> {
        let carrier = self.carriers[instance as usize].as_ref();
        carrier.map_or(0..0, |carrier| carrier.slices.clone())
    }

    /// In rest space: the blocks of each slice (of [`BLOCK`] points, the first in the lowest bit)
    /// that have changed since [`World::clear_changes`]: in what they say, or in whether a client
    /// needs them ([`World::shown`]).
    pub fn changed(&self) -> &[u64] {
        &self.changed
    }

    /// In rest space: the blocks of a slice that may face an eye (in the world, metres from the
    /// scene's origin), or soon one near it. What is in the others shows in no picture from there.
    pub fn facing(&self, slice: &Slice, eye: Vec3) -> Faces {
        match (self.local_eye(slice.instance, eye), self.cones_at(slice)) {
            (Some(eye), Some(cones)) => eye.faces(cones),
            _ => Faces::all_of(slice),
        }
    }

    /// The same of a slice's points one by one: those of `points` that may face the eye.
    pub fn points_facing(&self, slice: &Slice, eye: Vec3, points: PointBits) -> PointBits {
        if points == [0; SLICE_POINTS / 64] {
            return points;
        }
        let Some(eye) = self.local_eye(slice.instance, eye) else {
            return points;
        };
        let (positions, normals) = self.vertices(slice.instance);
        let triangles = &self.mesh(slice.instance).triangles;
        let of_slice = &self.points[slice.points.start as usize..slice.points.end as usize];
        let mut facing = points;
        for (points, facing) in of_slice.chunks(64).zip(&mut facing) {
            let mut left = *facing;
            while left != 0 {
                let bit = left.trailing_zeros();
                left &= left - 1;
                let faces = points.get(bit as usize).is_some_and(|point| {
                    let (position, sides) = sides(point, triangles, positions, normals);
                    sides.iter().any(|side| eye.is_faced(position, *side))
                });
                *facing &= !(u64::from(!faces) << bit);
            }
        }
        facing
    }

    /// In rest space: bounds in the world of a block of a slice, with a cell's margin.
    pub fn block_bounds(&self, slice: &Slice, block: usize) -> [Vec3; 2] {
        let Some(cones) = self.cones_at(slice) else {
            return slice.bounds;
        };
        let (center, radius) = cones[block].ball();
        let world = &self.pose.instances[slice.instance as usize].world_from_local;
        let [min, max] = placed_bounds(world, [center - radius, center + radius]);
        let margin = self.options.cell_m();
        [min - margin, max + margin]
    }

    fn local_eye(&self, instance: u32, eye: Vec3) -> Option<LocalEye> {
        let place = &self.pose.instances[instance as usize].world_from_local;
        LocalEye::of(eye, EYE_M, place)
    }

    /// For [`World::may_be_seen`]: an eye that may soon be anywhere around, as each instance has it.
    pub fn local_eyes(&self, eye: Vec3) -> Vec<Option<LocalEye>> {
        // To the corners of where `is_seen` looks from.
        let around_m = LOOKAHEAD_M * 3f32.sqrt();
        let poses = self.pose.instances.iter();
        let eyes = poses.map(|pose| LocalEye::of(eye, around_m, &pose.world_from_local));
        eyes.collect()
    }

    /// Whether a point of a slice may face one of [`World::local_eyes`]: where none does,
    /// [`World::is_seen`] finds none.
    pub fn may_be_seen(&self, slice: &Slice, eyes: &[Option<LocalEye>]) -> bool {
        let instance = slice.instance as usize;
        let (Some(eye), Some(cones)) = (&eyes[instance], self.cones.get(instance)) else {
            return true;
        };
        let cone = cones.slices.get(self.patch_in_set(slice));
        cone.is_none_or(|cone| eye.may_be_faced(cone))
    }

    /// In rest space: the number of a slice's patch in its set; 0 without one.
    fn patch_in_set(&self, slice: &Slice) -> usize {
        let own = self.topology.of_instance.get(slice.instance as usize);
        let set = own.copied().flatten();
        set.map_or(0, |(set, _)| {
            slice.patch - self.topology.first_patch[set as usize]
        }) as usize
    }

    /// A slice's part of [`World::cones`].
    fn cones_at(&self, slice: &Slice) -> Option<&[Cone]> {
        let cones = self.cones.get(slice.instance as usize)?;
        let first = self.patch_in_set(slice) * SLICE_BLOCKS;
        let blocks = slice.points.len().div_ceil(BLOCK);
        cones.blocks.get(first..first + blocks)
    }

    /// What [`World::facing`] asks, in the present pose; one for all instances that do not deform
    /// and have the same points.
    fn all_cones(&self) -> Vec<Arc<Cones>> {
        let mut shared: BTreeMap<(u32, u32), Arc<Cones>> = BTreeMap::new();
        let of_instance = self.topology.of_instance.iter().zip(0..);
        of_instance
            .map(|(key, instance)| {
                let Some(key) = *key else {
                    return Arc::default();
                };
                if self.scene.instances[instance as usize].deforms {
                    return Arc::new(self.cones_of(instance));
                }
                let made = || Arc::new(self.cones_of(instance));
                Arc::clone(shared.entry(key).or_insert_with(made))
            })
            .collect()
    }

    fn cones_of(&self, instance: u32) -> Cones {
        let (positions, normals) = self.vertices(instance);
        let triangles = &self.mesh(instance).triangles;
        let slices = self.slices_of(instance);
        let slices = self.slices[slices.start as usize..slices.end as usize].par_iter();
        let of_slice = |slice: &Slice| {
            let points = slice.points.start as usize..slice.points.end as usize;
            let points = self.points[points].iter();
            Cone::of_blocks(points.map(|p| sides(p, triangles, positions, normals)))
        };
        let of_slices: Vec<(Vec<Cone>, Cone)> = slices.map(of_slice).collect();
        let mut cones = Cones::default();
        for (mut blocks, slice) in of_slices {
            blocks.resize(SLICE_BLOCKS, Cone::default());
            cones.blocks.append(&mut blocks);
            cones.slices.push(slice);
        }
        cones
    }

    /// Starts a new frame for [`World::changed`] and [`Truth::changes`].
    pub fn clear_changes(&mut self) {
        self.changed.fill(0);
        self.truth.clear_changes();
    }

    /// In rest space: the blocks of a slice (of [`psao_core::residual::BLOCK`] points) that a
    /// client needs, the first in the lowest bit. In the others, and in all cells around them,
    /// every point is as good as open.
    pub fn shown(&self, slice: &Slice) -> u64 {
        let Some(openness) = &self.openness[slice.instance as usize] else {
            return 0;
        };
        let first = self.patch_in_set(slice) * SLICE_BLOCKS;
        let near = openness.near_dark[first..first + SLICE_BLOCKS].iter();
        near.rev()
            .fold(0, |shown, &dark| shown << 1 | u64::from(dark > 0))
    }

    fn note_change(&mut self, index: usize, blocks: u64) {
        self.changed[index] |= blocks;
        let slice = &self.slices[index];
        let first_block = self.patch_in_set(slice) * SLICE_BLOCKS;
        let points = slice.points.start as usize..slice.points.end as usize;
        let Some(openness) = &mut self.openness[slice.instance as usize] else {
            return;
        };
        let blocks = self.occlusion[points].chunks(BLOCK);
        for (block, occlusion) in (first_block..).zip(blocks) {
            let least = occlusion.iter().copied().min().unwrap_or(255);
            openness.set(block, least);
        }
        // What comes into or goes out of cells nearby is a change of those slices too.
        let carrier = self.carriers[slice.instance as usize].as_ref();
        let first_slice = carrier.map_or(0, |carrier| carrier.slices.start as usize);
        for block in openness.turned.drain(..) {
            let (patch, block) = (block / SLICE_BLOCKS as u32, block % SLICE_BLOCKS as u32);
            self.changed[first_slice + patch as usize] |= 1 << block;
        }
    }

    /// Points that found no room in their cell or bucket.
    pub fn discarded(&self) -> usize {
        let of_instance = self.topology.of_instance.iter().flatten();
        let in_sets = of_instance
            .map(|&(set, level)| self.topology.sets[set as usize].levels[level as usize].discarded);
        let in_sets: usize = in_sets.sum();
        in_sets
            + self
                .places
                .iter()
                .filter(|&&place| place == Place::NONE)
                .count()
    }

    fn words(&self) -> usize {
        self.options.rays.div_ceil(64)
    }

    fn local_positions(
        &self,
        instance: u32,
        points: Range<u32>,
        positions: &[Vec3],
    ) -> impl Iterator<Item = Vec3> {
        let triangles = &self.mesh(instance).triangles;
        self.points[points.start as usize..points.end as usize]
            .iter()
            .map(move |p| p.position(triangles, positions))
    }

    fn slice_bounds(&self, slice: usize) -> [Vec3; 2] {
        let Slice {
            instance,
            points,
            local_bounds,
            ..
        } = &self.slices[slice];
        let deforms = self.scene.instances[*instance as usize].deforms;
        let local = if deforms {
            let positions = self.vertices(*instance).0;
            bounds_of(self.local_positions(*instance, points.clone(), positions))
        } else {
            *local_bounds
        };
        let world = &self.pose.instances[*instance as usize].world_from_local;
        let [min, max] = placed_bounds(world, local);
        let margin = self.options.cell_m();
        [min - margin, max + margin]
    }
}

/// A point's position, and unit normals that must all face away before the point does: its own, and
/// that of its flat triangle where the two have little to do with each other. (Some models have
/// normals that point inwards; and it is the triangle that is drawn or not.)
fn sides(
    point: &SurfacePoint,
    triangles: &[[u32; 3]],
    positions: &[Vec3],
    normals: &[Vec3],
) -> (Vec3, [Vec3; 2]) {
    let normal = point.normal(triangles, positions, normals);
    let flat = point.geometric_normal(triangles, positions);
    let other = if flat.dot(normal) < 0.5 { flat } else { normal };
    (point.position(triangles, positions), [normal, other])
}

/// A point as open as this, with all around it so too, need not be at the client.
const OPEN: u8 = 250;

/// Which blocks of an instance's points have dark ones, or are near such.
#[derive(Clone, Debug)]
struct Openness {
    adjacency: Arc<Adjacency>,
    dark: Vec<bool>,
    /// How many dark blocks are near each, itself counted.
    near_dark: Vec<u16>,
    /// Blocks that came near a dark one, or no longer are.
    turned: Vec<u32>,
}

impl Openness {
    fn new(adjacency: Arc<Adjacency>) -> Openness {
        let blocks = adjacency.blocks();
        Openness {
            adjacency,
            dark: vec![false; blocks],
            near_dark: vec![0; blocks],
            turned: Vec::new(),
        }
    }

    fn set(&mut self, block: usize, least: u8) {
        // A little apart, so that what wavers does not come and go.
        let dark = least < if self.dark[block] { OPEN + 3 } else { OPEN };
        if dark == self.dark[block] {
            return;
        }
        self.dark[block] = dark;
        for &near in self.adjacency.near(block) {
            let count = &mut self.near_dark[near as usize];
            let before = *count > 0;
            *count = if dark { *count + 1 } else { *count - 1 };
            if before != (*count > 0) {
                self.turned.push(near);
            }
        }
    }
}

/// There is no such instance, or it has no such joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoInstance(pub u32);

impl std::fmt::Display for NoInstance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the scene has no instance {} with these joints", self.0)
    }
}

impl std::error::Error for NoInstance {}

/// Points of a slice that are traced together: few, so that all threads end together.
const BATCH_POINTS: usize = 128;

/// Batches that a device gets at once: many rays, of little memory.
const DEVICE_BATCHES: usize = 512;

/// Some points of a slice, to be traced.
struct Batch<'a> {
    slice: usize,
    points: Range<u32>,
    /// As many of the rays are to be known.
    rays: usize,
    /// Which of its blocks.
    blocks: u8,
    /// Those of them of which one point in [`THIN`] is traced.
    thin: u8,
    /// Rays that it took.
    taken: u64,
    /// Rays against what stands still, if they have been traced already.
    still: Option<u64>,
    /// Their part of [`World::fixed`].
    fixed: &'a mut [u64],
    /// What they say.
    occlusion: &'a mut [u8],
}

/// What a point's rays need of its instance.
struct Surface<'a> {
    triangles: &'a [[u32; 3]],
    /// Of vertices, in local space.
    positions: &'a [Vec3],
    normals: &'a [Vec3],
    pose: &'a InstancePose,
    reach: f32,
}

impl Surface<'_> {
    /// Where a point is in the world.
    fn position(&self, point: &SurfacePoint) -> Vec3 {
        let local = point.position(self.triangles, self.positions);
        self.pose.world_from_local.transform_point3(local)
    }

    /// Its unit normal in the world.
    fn normal(&self, point: &SurfacePoint) -> Vec3 {
        let local = point.normal(self.triangles, self.positions, self.normals);
        self.pose.world_normal(local)
    }
}

/// Bounds of an instance's vertices in local space.
#[derive(Clone, Copy, Debug)]
struct LocalHull {
    bounds: [Vec3; 2],
    /// Farthest vertex from the middle of the bounds.
    radius: f32,
}

impl LocalHull {
    fn of(positions: &[Vec3]) -> LocalHull {
        let bounds = bounds_of(positions.iter().copied());
        let center = (bounds[0] + bounds[1]) * 0.5;
        let squared = |p: &Vec3| p.distance_squared(center);
        let farthest = positions.iter().map(squared).fold(0.0, f32::max);
        LocalHull {
            bounds,
            radius: farthest.sqrt(),
        }
    }
}

/// Bounds of a mover in the world: a box, and a ball, whichever is tighter.
#[derive(Clone, Copy, Debug, Default)]
struct Hull {
    bounds: [Vec3; 2],
    center: Vec3,
    radius: f32,
    /// What it was made from.
    local: Option<LocalHull>,
}

impl Hull {
    fn new(local: LocalHull, world_from_local: &Affine3A) -> Hull {
        let [min, max] = placed_bounds(world_from_local, local.bounds);
        let center = (min + max) * 0.5;
        // A little more, for rounding.
        let radius =
            local.radius * stretch(world_from_local) * 1.0001 + center.abs().max_element() * 1e-6;
        Hull {
            bounds: [min.max(center - radius), max.min(center + radius)],
            center,
            radius,
            local: Some(local),
        }
    }

    /// A ray of length `reach` from within `bounds` may meet it.
    fn is_near(&self, bounds: [Vec3; 2], reach: f32) -> bool {
        let nearest = self.center.clamp(bounds[0], bounds[1]);
        let far = reach + self.radius;
        touches(bounds, self.bounds, reach) && nearest.distance_squared(self.center) <= far * far
    }

    /// A ray of length `reach` from a place may meet it.
    fn is_within(&self, position: Vec3, reach: f32) -> bool {
        let far = reach + self.radius;
        let nearest = position.clamp(self.bounds[0], self.bounds[1]);
        position.distance_squared(self.center) <= far * far
            && nearest.distance_squared(position) <= reach * reach * 1.0001
    }

    /// At least so far from a place to its surface, metres.
    fn distance(&self, position: Vec3) -> f32 {
        let to_box = position.distance(position.clamp(self.bounds[0], self.bounds[1]));
        to_box.max(position.distance(self.center) - self.radius)
    }

    /// Which part of a point's rays, about, go to the ball: above 0.
    fn share(&self, position: Vec3, normal: Vec3) -> f32 {
        let to = self.center - position;
        let sin = (self.radius / to.length().max(f32::MIN_POSITIVE)).min(1.0);
        // Right where all of it is ahead, or it is half of all that can be seen.
        let ahead = (normal.dot(to.normalize_or_zero()) + sin) / (1.0 + sin);
        (sin * sin * ahead).max(1e-3)
    }

    /// Part of it is above the plane at a place.
    fn is_ahead(&self, position: Vec3, normal: Vec3) -> bool {
        let [min, max] = self.bounds;
        let (center, half) = ((min + max) * 0.5, (max - min) * 0.5);
        let of_box = normal.dot(center - position) + normal.abs().dot(half);
        of_box > 0.0 && normal.dot(self.center - position) > -self.radius
    }
}

/// What a point says of which `rays` of its rays some hit.
fn openness(hit: &[u64], rays: usize) -> u8 {
    let open = 255.0 * (1.0 - count(hit) as f32 / rays as f32);
    (open + 0.5) as u8
}

/// How many rays are asked for and not known to hit.
fn open(todo: &[u64], hit: &[u64]) -> u64 {
    let open = todo.iter().zip(hit).map(|(todo, hit)| todo & !hit);
    open.map(|open| u64::from(open.count_ones())).sum()
}

/// Marks the rays that can meet the ball around a mover.
fn mark_towards(mover: &Hull, fan: &Fan<'_>, marked: &mut [u64]) {
    let to = mover.center - fan.origin;
    let sin_squared = mover.radius * mover.radius / to.length_squared();
    let cos = if sin_squared < 1.0 {
        // A little wider, for rounding.
        (1.0 - sin_squared).sqrt() - 1e-4
    } else {
        -2.0
    };
    fan.mark_cone(to.normalize_or_zero(), cos, marked);
}

fn count(words: &[u64]) -> u64 {
    words.iter().map(|word| u64::from(word.count_ones())).sum()
}

fn deform(scene: &Scene, pose: &Pose, deformed: &mut [Deformed]) {
    deformed.par_iter_mut().for_each(|d| {
        let pose: &InstancePose = &pose.instances[d.instance as usize];
        scene.deform(d.instance as usize, pose, &mut d.positions, &mut d.normals);
    });
}

fn single(matrix: DAffine3) -> Affine3A {
    Affine3A::from_mat3_translation(matrix.matrix3.as_mat3(), matrix.translation.as_vec3())
}

/// Metres a local unit along each axis.
pub fn scale_of(world_from_local: &Affine3A) -> Vec3 {
    let m = world_from_local.matrix3;
    Vec3::new(m.x_axis.length(), m.y_axis.length(), m.z_axis.length())
}

/// The box around positions.
pub fn bounds_of(positions: impl Iterator<Item = Vec3>) -> [Vec3; 2] {
    positions.fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[min, max], p| {
        [min.min(p), max.max(p)]
    })
}

fn placed_bounds(world_from_local: &Affine3A, [min, max]: [Vec3; 2]) -> [Vec3; 2] {
    let center = world_from_local.transform_point3((min + max) * 0.5);
    let (half, m) = (Vec3A::from((max - min) * 0.5), world_from_local.matrix3);
    let half = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
    [center - Vec3::from(half), center + Vec3::from(half)]
}

/// Gershgorin's bound of the largest stretch; exact without shear.
fn stretch(world_from_local: &Affine3A) -> f32 {
    let m = world_from_local.matrix3;
    let squared = m.transpose() * m;
    let row = |row: Vec3A| row.abs().element_sum();
    let columns = row(squared.x_axis).max(row(squared.y_axis));
    columns.max(row(squared.z_axis)).sqrt()
}

/// Two boxes are nearer than `reach`.
fn touches(a: [Vec3; 2], b: [Vec3; 2], reach: f32) -> bool {
    (a[0] - reach).cmple(b[1]).all() && (b[0] - reach).cmple(a[1]).all()
}
