//! Topology of profile `residual`: each mesh's points once, in patches that its instances share.

use crate::clusters::gather;
use crate::lattice;
use crate::points::SurfacePoint;
use crate::scene::Mesh;
use crate::truth::{Placement, buckets_for, choose_buckets};
use glam::Vec3;
use psao_core::Instance;
use psao_core::bins::{Bin, SCALES};
use psao_core::cell::CELL_POINTS;
use psao_core::residual::{BLOCK, Neighbours, find_neighbours};
use psao_core::topology::{LEVELS, MAX_PATCH_BYTES, Order, PATCH_POINTS, PatchPoint, encode_patch};
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::ops::Range;
use std::sync::OnceLock;

/// The points of a mesh (for instances whose scales have the same ratios).
#[derive(Clone, Debug)]
pub struct PointSet {
    /// Its patches, coded.
    pub patches: Vec<Vec<u8>>,
    /// The points of all patches, one after the other.
    pub points: Vec<SurfacePoint>,
    /// The same as the stream has them.
    pub coded: Vec<PatchPoint>,
    /// Where each patch's begin in them, and the end.
    first_point: Vec<usize>,
    /// The grid at each level, without a place in the bucket buffer.
    pub levels: Vec<Level>,
    /// Patches by place: what has points in, or a cell beside, each part of the grid of level 0.
    parts: HashMap<[u32; 3], Vec<u32>, Fast>,
}

/// A part is so many cells long, as a power of two.
const PART_BITS: u32 = 2;

/// A set's grid at a level of detail.
#[derive(Clone, Copy, Debug, Default)]
pub struct Level {
    /// Its `bucket_first` is 0.
    pub grid: Instance,
    /// Cells with points.
    pub cells: usize,
    /// Points that find no room in their cell or bucket.
    pub discarded: usize,
}

impl PointSet {
    /// Patches of a mesh's points, which come in progressive order; `grid` is that of level 0,
    /// around all of them, `highest` the last level, and `room` how many points a cell keeps. `None`
    /// if there are no points.
    pub fn new(
        mesh: &Mesh,
        points: &[SurfacePoint],
        grid: &Instance,
        highest: u32,
        room: usize,
    ) -> Option<PointSet> {
        let place = |point| lattice::place(mesh, grid, point);
        let mut places: Vec<Option<Placement>> = points.iter().map(place).collect();
        leave_room(&mut places, room);
        let coded = |(index, point): (usize, &SurfacePoint)| {
            let at = places[index]?;
            let mut coded = PatchPoint {
                normal: at.normal,
                level: level_of_rank(index, points.len(), highest),
                ..PatchPoint::default()
            };
            coded.position = at.steps();
            Some((coded, *point))
        };
        let mut all: Vec<(PatchPoint, SurfacePoint)> =
            points.iter().enumerate().filter_map(coded).collect();
        let mut first_point = vec![0];
        first_point.extend(gather(&mut all).iter().scan(0, |end, count| {
            *end += count;
            Some(*end)
        }));
        let patches: Vec<(Vec<u8>, Vec<(PatchPoint, SurfacePoint)>)> = first_point
            .par_windows(2)
            .map(|range| {
                let mut chunk = all[range[0]..range[1]].to_vec();
                let only: Vec<PatchPoint> = chunk.iter().map(|(coded, _)| *coded).collect();
                let order = Order::of(&only);
                chunk.sort_by_key(|(coded, _)| order.key(coded));
                let only: Vec<PatchPoint> = chunk.iter().map(|(coded, _)| *coded).collect();
                let mut bytes = vec![0; MAX_PATCH_BYTES];
                let length = encode_patch(&only, &mut bytes).expect("a patch has room and order");
                bytes.truncate(length);
                bytes.shrink_to_fit();
                (bytes, chunk)
            })
            .collect();
        let mut set = PointSet {
            patches: Vec::with_capacity(patches.len()),
            points: Vec::with_capacity(all.len()),
            coded: Vec::with_capacity(all.len()),
            first_point,
            levels: Vec::new(),
            parts: HashMap::default(),
        };
        for (bytes, chunk) in patches {
            set.patches.push(bytes);
            for (coded, point) in chunk {
                set.coded.push(coded);
                set.points.push(point);
            }
        }
        set.levels = (0..=highest)
            .into_par_iter()
            .map(|level| lay_out(&set.coded, grid, level))
            .collect();
        for patch in 0..set.patches.len() {
            for point in &set.coded[set.patch_range(patch)] {
                let cell = point.position.map(|steps| steps / 32);
                let [first, last] = [
                    cell.map(|c| c.saturating_sub(1) >> PART_BITS),
                    cell.map(|c| (c + 1) >> PART_BITS),
                ];
                for x in first[0]..=last[0] {
                    for y in first[1]..=last[1] {
                        for z in first[2]..=last[2] {
                            let patches = set.parts.entry([x, y, z]).or_default();
                            if patches.last() != Some(&(patch as u32)) {
                                patches.push(patch as u32);
                            }
                        }
                    }
                }
            }
        }
        (!set.coded.is_empty()).then_some(set)
    }

    /// Patches that have points around a local position, and perhaps some that are a little
    /// farther away.
    pub fn patches_near(&self, position: Vec3) -> &[u32] {
        let cells = self.levels[0].grid.to_cells(position.to_array());
        // What is below 0 becomes 0.
        let part = cells.map(|c| c as u32 >> PART_BITS);
        self.parts.get(&part).map_or(&[], Vec::as_slice)
    }

    /// The points of a patch, as numbers within the set.
    pub fn patch_range(&self, patch: usize) -> Range<usize> {
        self.first_point[patch]..self.first_point[patch + 1]
    }
}

/// Drops what a cell has no room for. The first points of the progressive order stay: they are
/// spread well over all that the cell holds, such as both sides of a thin wall, which those that
/// a client happens to get first need not be.
fn leave_room(places: &mut [Option<Placement>], room: usize) {
    let mut loads: HashMap<[u32; 3], usize, Fast> = HashMap::default();
    for place in places {
        let Some(at) = place else { continue };
        let load = loads.entry(at.cell).or_default();
        *load += 1;
        if *load > room {
            *place = None;
        }
    }
}

/// The highest level that has a point: each level has half of the points of the one below.
fn level_of_rank(rank: usize, count: usize, highest: u32) -> u8 {
    let has = |level: &u32| rank < count.div_ceil(1 << level);
    (1..=highest).take_while(has).count() as u8
}

/// A level's grid, with buckets for the cells that its points fall into.
fn lay_out(points: &[PatchPoint], level_0: &Instance, level: u32) -> Level {
    let scale = SCALES[level as usize];
    let factor = scale as f32 / SCALES[0] as f32;
    let mut grid = Instance {
        cells_per_unit: level_0.cells_per_unit.map(|cells| cells * factor),
        dims: level_0
            .dims
            .map(|dim| ((u64::from(dim) * u64::from(scale)) >> 16) as u32 + 1),
        level,
        ..*level_0
    };
    if level == 0 {
        grid.dims = level_0.dims;
    }
    let bins = bins_of(points, &grid);
    let mut loads: HashMap<[u32; 3], u32, Fast> = HashMap::default();
    for bin in bins {
        *loads.entry(bin.cell).or_default() += 1;
    }
    let cells: Vec<[u32; 3]> = loads.keys().copied().collect();
    grid.bucket_count = choose_buckets(&grid, &cells, buckets_for(cells.len()));
    let over = loads
        .values()
        .map(|&load| (load as usize).saturating_sub(CELL_POINTS));
    Level {
        grid,
        cells: cells.len(),
        discarded: over.sum(),
    }
}

fn bins_of<'a>(points: &'a [PatchPoint], grid: &'a Instance) -> impl Iterator<Item = Bin> + 'a {
    points
        .iter()
        .filter(|point| u32::from(point.level) >= grid.level)
        .filter_map(|point| Bin::of(grid, point))
}

/// Which blocks of a set's slices (of [`BLOCK`] points, at a level) lie so near one another that
/// one must be in the client's cells when the other has a dark point: those that share a cell or
/// have cells side by side.
#[derive(Clone, Debug, Default)]
pub struct Adjacency {
    first: Vec<u32>,
    blocks: Vec<u32>,
}

impl Adjacency {
    /// Of the slices that a set's patches are at a level. Blocks are numbered through, slice by
    /// slice, each slice beginning at a multiple of [`SLICE_BLOCKS`].
    pub fn new(set: &PointSet, level: u32) -> Adjacency {
        let grid = &set.levels[level as usize].grid;
        let mut of_cell: HashMap<[u32; 3], Vec<u32>, Fast> = HashMap::default();
        let mut cells: Vec<Vec<[u32; 3]>> = vec![Vec::new(); set.patches.len() * SLICE_BLOCKS];
        for patch in 0..set.patches.len() {
            let points = set.coded[set.patch_range(patch)].iter();
            let of_level = points.filter(|point| u32::from(point.level) >= level);
            for (at, point) in of_level.enumerate() {
                let Some(bin) = Bin::of(grid, point) else {
                    continue;
                };
                let block = patch * SLICE_BLOCKS + at / BLOCK;
                if !cells[block].contains(&bin.cell) {
                    cells[block].push(bin.cell);
                    of_cell.entry(bin.cell).or_default().push(block as u32);
                }
            }
        }
        let near: Vec<Vec<u32>> = cells
            .par_iter()
            .map(|cells| {
                let mut near = Vec::new();
                let mut around = Vec::new();
                for cell in cells {
                    for offset in 0..27u32 {
                        let by = [offset % 3, offset / 3 % 3, offset / 9];
                        let at: [u32; 3] =
                            std::array::from_fn(|i| (cell[i] + by[i]).wrapping_sub(1));
                        around.push(at);
                    }
                }
                around.sort_unstable();
                around.dedup();
                for cell in around {
                    near.extend(of_cell.get(&cell).into_iter().flatten());
                }
                near.sort_unstable();
                near.dedup();
                near
            })
            .collect();
        let mut adjacency = Adjacency::default();
        adjacency.first.push(0);
        for near in near {
            adjacency.blocks.extend(near);
            adjacency.first.push(adjacency.blocks.len() as u32);
        }
        adjacency
    }

    /// How many blocks there are.
    pub fn blocks(&self) -> usize {
        self.first.len() - 1
    }

    /// The blocks near one, itself among them.
    pub fn near(&self, block: usize) -> &[u32] {
        &self.blocks[self.first[block] as usize..self.first[block + 1] as usize]
    }
}

/// Most blocks of a slice.
pub const SLICE_BLOCKS: usize = PATCH_POINTS / BLOCK;

/// Hashes of cells: their coordinates are no attacker's.
pub(crate) type Fast = BuildHasherDefault<CellHasher>;

#[derive(Default)]
pub(crate) struct CellHasher(u64);

impl Hasher for CellHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            let mixed = (self.0 ^ u64::from_le_bytes(word)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            self.0 = mixed ^ mixed >> 29;
        }
    }
}

/// All point sets of a scene, and which instance has which.
#[derive(Clone, Debug, Default)]
pub struct Topology {
    /// All sets.
    pub sets: Vec<PointSet>,
    /// The first patch of each set.
    pub first_patch: Vec<u32>,
    /// Each instance's set, and the level that its scale asks for: its points are those of that
    /// level and above.
    pub of_instance: Vec<Option<(u32, u32)>>,
    /// Tells this topology from others.
    pub hash: u64,
    patches: u32,
    bytes: u32,
    /// Of each patch and level: what all encoders find the same.
    neighbours: Vec<OnceLock<Vec<Neighbours>>>,
}

impl Topology {
    /// Numbers the patches of all sets.
    pub fn new(sets: Vec<PointSet>, of_instance: Vec<Option<(u32, u32)>>) -> Topology {
        let mut topology = Topology {
            of_instance,
            ..Topology::default()
        };
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for set in &sets {
            topology.first_patch.push(topology.patches);
            topology.patches += set.patches.len() as u32;
            for patch in &set.patches {
                topology.bytes += patch.len() as u32;
                for byte in patch {
                    hash = (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
                }
            }
        }
        topology.hash = hash;
        let kinds = topology.patches as usize * LEVELS as usize;
        topology.neighbours = vec![OnceLock::new(); kinds];
        topology.sets = sets;
        topology
    }

    /// How many patches there are.
    pub fn patches(&self) -> u32 {
        self.patches
    }

    /// Bytes of all patches together.
    pub fn bytes(&self) -> u32 {
        self.bytes
    }

    /// A patch's points of a level.
    pub fn points_of(&self, patch: u32, level: u32) -> impl Iterator<Item = &PatchPoint> {
        let set = self.first_patch.partition_point(|first| *first <= patch) - 1;
        let range = self.sets[set].patch_range((patch - self.first_patch[set]) as usize);
        let points = self.sets[set].coded[range].iter();
        points.filter(move |point| u32::from(point.level) >= level)
    }

    /// The neighbours of a patch's points of a level, as [`find_neighbours`] finds them.
    pub fn neighbours(&self, patch: u32, level: u32) -> &[Neighbours] {
        let kind = patch * LEVELS + level;
        self.neighbours[kind as usize].get_or_init(|| {
            let points: Vec<PatchPoint> = self.points_of(patch, level).copied().collect();
            let mut neighbours = vec![Neighbours::default(); points.len()];
            find_neighbours(&points, &mut neighbours);
            neighbours
        })
    }

    /// A patch's bytes.
    pub fn patch(&self, index: u32) -> &[u8] {
        let set = self.first_patch.partition_point(|first| *first <= index) - 1;
        &self.sets[set].patches[(index - self.first_patch[set]) as usize]
    }

    /// The set of an instance, if it has points.
    pub fn set_of(&self, instance: u32) -> Option<&PointSet> {
        let (set, _) = (*self.of_instance.get(instance as usize)?)?;
        Some(&self.sets[set as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use psao_core::topology::decode_patch;

    #[test]
    fn each_level_has_half_of_the_points_of_the_one_below() {
        let counts = |count: usize| -> Vec<usize> {
            let level = |rank| level_of_rank(rank, count, LEVELS - 1);
            let levels: Vec<u8> = (0..count).map(level).collect();
            (0..LEVELS as u8)
                .map(|level| levels.iter().filter(|&&l| l >= level).count())
                .collect()
        };
        assert_eq!(counts(800), [800, 400, 200, 100]);
        assert_eq!(counts(1), [1, 1, 1, 1]);
        assert_eq!(counts(3), [3, 2, 1, 1]);
        let mut points = [PatchPoint::default(); PATCH_POINTS];
        let mut bytes = vec![0; MAX_PATCH_BYTES];
        let length = encode_patch(&points[..3], &mut bytes).unwrap();
        assert_eq!(decode_patch(&bytes[..length], &mut points), Ok(3));
    }
}
