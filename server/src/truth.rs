//! The server's own instances, buckets and cells, of which each client's mirror holds what it was
//! sent: memory management of the paper's section 3.2.

use glam::Vec3;
use psao_core::cell::{BUCKET_ENTRIES, CELL_POINTS};
use psao_core::grid::MAX_DIM;
use psao_core::point::{encode_normal, encode_position};
use psao_core::{Bucket, Cell, Instance, Point, dirty};

/// Where a point is stored: a cell and a place in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place(u32);

impl Place {
    /// Discarded: its cell or its bucket is full.
    pub const NONE: Place = Place(u32::MAX);

    fn new(cell: u32, slot: usize) -> Place {
        Place(cell << 3 | slot as u32)
    }

    /// Index of the cell, unless discarded.
    pub fn cell(self) -> Option<u32> {
        (self != Place::NONE).then_some(self.0 >> 3)
    }

    /// Its place in the cell.
    pub fn slot(self) -> usize {
        self.0 as usize & 7
    }
}

/// A point's coordinates in its instance's grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// The grid cell.
    pub cell: [u32; 3],
    /// Position steps in the cell.
    pub position: [u32; 3],
    /// Code of the normal in cell space.
    pub normal: u8,
}

impl Placement {
    /// Quantises a local position and normal. `None` outside the grid, or not finite.
    pub fn of(grid: &Instance, position: Vec3, normal: Vec3) -> Option<Placement> {
        let g = grid.to_cells(position.to_array());
        let mut placement = Placement {
            cell: [0; 3],
            position: [0; 3],
            normal: 0,
        };
        for axis in 0..3 {
            if !(g[axis] >= 0.0 && g[axis] < grid.dims[axis] as f32) {
                return None;
            }
            let cell = g[axis].floor();
            placement.cell[axis] = cell as u32;
            placement.position[axis] = encode_position(g[axis] - cell);
        }
        placement.normal = encode_normal((normal * Vec3::from(grid.normal_scale)).to_array());
        Some(placement)
    }

    /// From steps of 1/32 of a cell.
    pub fn at(steps: [u32; 3], normal: u8) -> Placement {
        Placement {
            cell: steps.map(|s| s >> 5),
            position: steps.map(|s| s & 31),
            normal,
        }
    }

    /// The position, in steps of 1/32 of a cell from the grid's corner.
    pub fn steps(&self) -> [u32; 3] {
        std::array::from_fn(|axis| self.cell[axis] << 5 | self.position[axis])
    }
}

/// A grid around `bounds` (local space) with cells of `cell_m` metres and a margin of one cell.
/// `scale`: local units to metres, per axis. The buckets are the caller's to fill in.
/// `None` if the instance is flattened, not finite, or too large for `f32` to tell its cells.
pub fn fit(bounds: [Vec3; 2], scale: Vec3, cell_m: f32, radius_over_cell: f32) -> Option<Instance> {
    let cells_per_unit = scale / cell_m;
    let origin = bounds[0] - 1.0 / cells_per_unit;
    let extent = (bounds[1] - origin) * cells_per_unit;
    let tellable = extent.is_finite() && extent.max_element() < (MAX_DIM - 2) as f32;
    if !tellable {
        return None;
    }
    let inverse = 1.0 / cells_per_unit;
    let dims = extent.to_array().map(|cells| cells.floor() as u32 + 2);
    let grid = Instance {
        origin: origin.to_array(),
        radius: radius_over_cell,
        cells_per_unit: cells_per_unit.to_array(),
        dims,
        bucket_count: 1,
        normal_scale: (inverse / inverse.max_element()).to_array(),
        ..Instance::default()
    };
    grid.validate(1).is_ok().then_some(grid)
}

/// Buckets for a number of cells: four times as many entries as cells, odd so that the strides of
/// Eq. 1 and the bucket count share no power of two.
pub fn buckets_for(cells: usize) -> u32 {
    ((4 * cells).div_ceil(BUCKET_ENTRIES) as u32).max(1) | 1
}

/// The best bucket count up to `most` (odd) for an instance's cells.
///
/// Eq. 1 is linear, so for some counts whole rows of cells fall into few buckets (17·Dx and
/// 31·Dx·Dy may be small multiples of one another modulo the count); a few less, and they don't.
pub fn choose_buckets(grid: &Instance, cells: &[[u32; 3]], most: u32) -> u32 {
    let mut best = (u64::MAX, most);
    for count in (0..16)
        .map(|i| most.saturating_sub(2 * i))
        .filter(|&count| count > 0)
    {
        let candidate = Instance {
            bucket_first: 0,
            bucket_count: count,
            ..*grid
        };
        let mut load = vec![0u32; count as usize];
        cells
            .iter()
            .for_each(|&cell| load[candidate.bucket(cell) as usize] += 1);
        // What overflows counts most; what is more than half full leaves no room to move.
        let cost = |&load: &u32| -> u64 {
            u64::from(load.saturating_sub(BUCKET_ENTRIES as u32 / 2)).pow(2)
                + 1000 * u64::from(load.saturating_sub(BUCKET_ENTRIES as u32))
        };
        let cost = load.iter().map(cost).sum();
        if cost < best.0 {
            best = (cost, count);
        }
        if cost == 0 {
            break;
        }
    }
    best.1
}

/// The server's buckets and cells.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth {
    /// One a scene instance.
    pub instances: Vec<Instance>,
    /// All instances' buckets.
    pub buckets: Vec<Bucket>,
    /// All cells; 0 is unused.
    pub cells: Vec<Cell>,
    /// The bucket that names a cell.
    home: Vec<u32>,
    /// The points in a cell's places.
    owners: Vec<[u32; CELL_POINTS]>,
    bucket_room: Vec<u32>,
    free: Vec<u32>,
    next: u32,
    /// Cells and buckets changed since [`Truth::clear_changes`].
    changed_cells: Vec<u64>,
    changed_buckets: Vec<u64>,
    changed_instances: Vec<u64>,
}

impl Truth {
    /// Room for `cells` cells (and cell 0) in the instances' buckets.
    pub fn new(instances: Vec<Instance>, cells: usize) -> Truth {
        let buckets = instances
            .iter()
            .map(|i| (i.bucket_first + i.bucket_count) as usize)
            .max()
            .unwrap_or(0);
        let mut changed_instances = vec![0; dirty::words(instances.len())];
        dirty::mark_all(&mut changed_instances, instances.len());
        Truth {
            bucket_room: instances.iter().map(|i| i.bucket_count).collect(),
            instances,
            buckets: vec![Bucket::default(); buckets],
            cells: vec![Cell::default(); cells + 1],
            home: vec![0; cells + 1],
            owners: vec![[0; CELL_POINTS]; cells + 1],
            free: Vec::new(),
            next: 1,
            changed_cells: vec![0; dirty::words(cells + 1)],
            changed_buckets: vec![0; dirty::words(buckets)],
            changed_instances,
        }
    }

    /// Stores a point, if its cell and its bucket have room.
    pub fn insert(&mut self, instance: u32, point: u32, at: Placement, occlusion: u8) -> Place {
        let grid = &self.instances[instance as usize];
        let (key, bucket) = (grid.key(at.cell), grid.bucket(at.cell));
        let entries = self.buckets[bucket as usize];
        let found = entries
            .cells()
            .find(|&cell| self.cells[cell as usize].key == key);
        let Some(cell) = found.or_else(|| self.allocate(bucket, key)) else {
            return Place::NONE;
        };
        let slot = self.cells[cell as usize].len();
        if slot == CELL_POINTS {
            return Place::NONE;
        }
        self.cells[cell as usize].points[slot] = Point::pack(at.position, at.normal, occlusion);
        self.owners[cell as usize][slot] = point;
        self.mark_cell(cell);
        Place::new(cell, slot)
    }

    /// Takes a point out. The cell's last point moves into its place, so that empty places come
    /// last; that point's number and new place are returned.
    pub fn remove(&mut self, place: Place) -> Option<(u32, Place)> {
        let cell = place.cell()?;
        self.mark_cell(cell);
        let (data, owners) = (
            &mut self.cells[cell as usize],
            &mut self.owners[cell as usize],
        );
        let (slot, last) = (place.slot(), data.len() - 1);
        data.points[slot] = data.points[last];
        owners[slot] = owners[last];
        data.points[last] = Point::EMPTY;
        let moved = (slot != last).then(|| (owners[slot], place));
        if last == 0 {
            self.release(cell);
        }
        moved
    }

    /// Changes a stored point that stays in its cell.
    pub fn set_point(&mut self, place: Place, at: Placement, occlusion: u8) {
        self.replace(place, |_| Point::pack(at.position, at.normal, occlusion));
    }

    /// Changes a stored point's occlusion.
    pub fn set_occlusion(&mut self, place: Place, occlusion: u8) {
        self.replace(place, |point| point.with_occlusion(occlusion));
    }

    fn replace(&mut self, place: Place, with: impl FnOnce(Point) -> Point) {
        let Some(cell) = place.cell() else { return };
        let point = &mut self.cells[cell as usize].points[place.slot()];
        let new = with(*point);
        if new != *point {
            *point = new;
            self.mark_cell(cell);
        }
    }

    /// Whether a stored point is in the cell of `at`.
    pub fn is_in_cell(&self, place: Place, instance: u32, at: Placement) -> bool {
        let grid = &self.instances[instance as usize];
        place.cell().is_some_and(|cell| {
            self.cells[cell as usize].key == grid.key(at.cell)
                && self.home[cell as usize] == grid.bucket(at.cell)
        })
    }

    /// Most buckets that an instance's grid may have.
    pub fn bucket_room(&self, instance: u32) -> u32 {
        self.bucket_room[instance as usize]
    }

    /// Replaces an instance's grid by one with no more than [`Truth::bucket_room`] buckets, and
    /// empties it.
    pub fn regrid(&mut self, instance: u32, mut grid: Instance) {
        let old = self.instances[instance as usize];
        grid.bucket_first = old.bucket_first;
        grid.bucket_count = grid.bucket_count.min(self.bucket_room(instance));
        for bucket in old.bucket_first..old.bucket_first + old.bucket_count {
            for cell in self.buckets[bucket as usize].entries {
                if cell != 0 {
                    self.release(cell);
                }
            }
        }
        self.instances[instance as usize] = grid;
        let len = self.instances.len();
        dirty::mark(&mut self.changed_instances, len, instance as usize);
    }

    /// The bucket that names a cell.
    pub fn home(&self, cell: u32) -> u32 {
        self.home[cell as usize]
    }

    /// Cells in use.
    pub fn used_cells(&self) -> u32 {
        self.next - 1 - self.free.len() as u32
    }

    /// The first cell that was never in use.
    pub fn next_cell(&self) -> u32 {
        self.next
    }

    /// Changed instances, buckets and cells since [`Truth::clear_changes`], as sets of
    /// [`psao_core::dirty`].
    pub fn changes(&self) -> [&[u64]; 3] {
        [
            &self.changed_instances,
            &self.changed_buckets,
            &self.changed_cells,
        ]
    }

    /// Starts a new frame.
    pub fn clear_changes(&mut self) {
        dirty::clear(&mut self.changed_instances, self.instances.len());
        dirty::clear(&mut self.changed_buckets, self.buckets.len());
        dirty::clear(&mut self.changed_cells, self.cells.len());
    }

    fn allocate(&mut self, bucket: u32, key: u32) -> Option<u32> {
        let free_entry = self.buckets[bucket as usize]
            .entries
            .iter()
            .position(|&e| e == 0)?;
        let cell = self.free.pop().or_else(|| {
            let fresh = self.next;
            ((fresh as usize) < self.cells.len()).then(|| {
                self.next += 1;
                fresh
            })
        })?;
        self.buckets[bucket as usize].entries[free_entry] = cell;
        self.cells[cell as usize] = Cell {
            key,
            ..Cell::default()
        };
        self.home[cell as usize] = bucket;
        self.mark_bucket(bucket);
        Some(cell)
    }

    /// Frees a cell and takes it out of its bucket, whose last entry moves into its place.
    fn release(&mut self, cell: u32) {
        let bucket = self.home[cell as usize];
        let entries = &mut self.buckets[bucket as usize].entries;
        let last = entries.iter().rposition(|&e| e != 0);
        let found = entries.iter().position(|&e| e == cell);
        if let (Some(found), Some(last)) = (found, last) {
            entries[found] = entries[last];
            entries[last] = 0;
        }
        self.cells[cell as usize] = Cell::default();
        self.free.push(cell);
        self.mark_bucket(bucket);
        self.mark_cell(cell);
    }

    fn mark_cell(&mut self, cell: u32) {
        dirty::mark(&mut self.changed_cells, self.cells.len(), cell as usize);
    }

    fn mark_bucket(&mut self, bucket: u32) {
        dirty::mark(
            &mut self.changed_buckets,
            self.buckets.len(),
            bucket as usize,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    fn grid() -> Instance {
        let mut grid = fit([Vec3::ZERO, Vec3::splat(4.0)], Vec3::ONE, 1.0, 0.8).unwrap();
        grid.bucket_count = 5;
        grid
    }

    /// Every point is where its place says, cells and buckets are compact, nothing is named twice.
    fn check(truth: &Truth, places: &HashMap<u32, Place>) {
        let mut named = vec![0; truth.cells.len()];
        for (index, bucket) in truth.buckets.iter().enumerate() {
            for cell in bucket.entries.into_iter().filter(|&cell| cell != 0) {
                named[cell as usize] += 1;
                assert_eq!(truth.home(cell), index as u32);
                assert!(
                    !truth.cells[cell as usize].is_empty(),
                    "an empty cell is named"
                );
            }
            let used = bucket.entries.iter().filter(|&&cell| cell != 0).count();
            assert_eq!(
                bucket.cells().count(),
                used,
                "an empty entry before a used one"
            );
        }
        let mut stored = 0;
        for (cell, data) in truth.cells.iter().enumerate() {
            assert!(named[cell] <= 1 && (named[cell] == 1) != data.is_empty());
            let used = data.points.iter().filter(|p| p.is_allocated()).count();
            assert_eq!(data.len(), used, "an empty place before a used one");
            stored += used;
        }
        assert_eq!(
            stored,
            places.values().filter(|&&p| p != Place::NONE).count()
        );
        for (point, place) in places {
            if let Some(cell) = place.cell() {
                assert_eq!(truth.owners[cell as usize][place.slot()], *point);
            }
        }
        assert_eq!(
            truth.used_cells() as usize,
            named.iter().filter(|&&n| n == 1).count()
        );
    }

    #[test]
    fn points_can_come_move_and_go_in_any_order() {
        let mut truth = Truth::new(vec![grid()], 30);
        let mut places = HashMap::new();
        let mut seed = 3u32;
        let mut random = |below: u32| {
            seed = seed.wrapping_mul(747796405).wrapping_add(2891336453);
            (seed >> 16) % below
        };
        let mut discarded = 0;
        for round in 0..4000u32 {
            let point = random(150);
            let at = Placement {
                cell: [random(6), random(6), random(2)],
                position: [random(32), random(32), random(32)],
                normal: random(225) as u8,
            };
            match places.get(&point).copied() {
                Some(place) if round % 3 == 0 => {
                    if let Some((moved, to)) = truth.remove(place) {
                        places.insert(moved, to);
                    }
                    places.remove(&point);
                }
                Some(place) if truth.is_in_cell(place, 0, at) => truth.set_point(place, at, 9),
                Some(place) => truth.set_occlusion(place, round as u8),
                None => {
                    let place = truth.insert(0, point, at, 200);
                    discarded += u32::from(place == Place::NONE);
                    places.insert(point, place);
                }
            }
            check(&truth, &places);
        }
        assert!(
            discarded > 0,
            "the test is meant to overflow cells and buckets"
        );
        truth.regrid(0, grid());
        check(&truth, &HashMap::new());
        assert_eq!(truth.used_cells(), 0);
    }

    #[test]
    fn flat_floors_and_walls_of_any_size_find_room_in_their_buckets() {
        for width in (5..160).step_by(3) {
            for depth in [4, 30, 88] {
                for axis in 0..3 {
                    let cells: Vec<[u32; 3]> = (0..width * depth)
                        .map(|i| {
                            let mut cell = [i % width + 1, 1, i / width + 1];
                            cell.swap(1, axis);
                            cell
                        })
                        .collect();
                    let dims = [0, 1, 2].map(|a| cells.iter().map(|c| c[a]).max().unwrap() + 2);
                    let mut grid = Instance { dims, ..grid() };
                    grid.bucket_count = choose_buckets(&grid, &cells, buckets_for(cells.len()));
                    let mut loads = HashMap::new();
                    for &cell in &cells {
                        *loads.entry(grid.bucket(cell)).or_insert(0) += 1;
                    }
                    let over = loads.values().map(|load: &usize| load.saturating_sub(8));
                    let over = over.sum::<usize>();
                    assert!(over * 1000 <= cells.len(), "{dims:?}: {over} have no room");
                }
            }
        }
    }

    #[test]
    fn a_lookup_finds_every_stored_point() {
        let mut truth = Truth::new(vec![grid()], 100);
        let position = Vec3::new(1.3, 2.2, 0.9);
        let at = Placement::of(&truth.instances[0], position, Vec3::Y).unwrap();
        truth.insert(0, 0, at, 51);
        let lookup = psao_core::Lookup {
            instances: &truth.instances,
            buckets: &truth.buckets,
            cells: &truth.cells,
        };
        for kernel in [psao_core::Kernel::Paper, psao_core::Kernel::Planar] {
            let answer = lookup.blend(kernel, 0, position.to_array(), [0.0, 1.0, 0.0]);
            assert!(
                answer.weight > 0.0 && (answer.openness - 0.2).abs() < 1e-6,
                "{answer:?}"
            );
        }
    }

    #[test]
    fn a_thin_upright_figure_does_not_overflow_its_buckets() {
        // The dimensions and the count for which 31·Dx·Dy is 3 times 17·Dx.
        let mut grid = grid();
        grid.dims = [18, 49, 27];
        let cells: Vec<[u32; 3]> = (0..49u32)
            .flat_map(|y| (0..16).map(move |i| [7 + i % 4, y, 12 + i / 4]))
            .collect();
        let overflow = |count: u32| {
            let grid = Instance {
                bucket_count: count,
                ..grid
            };
            let mut load = vec![0; count as usize];
            cells
                .iter()
                .for_each(|&cell| load[grid.bucket(cell) as usize] += 1);
            load.into_iter()
                .map(|n: usize| n.saturating_sub(BUCKET_ENTRIES))
                .sum::<usize>()
        };
        assert!(overflow(367) > 0, "the paper's count overflows");
        let count = choose_buckets(&grid, &cells, 367);
        assert!(
            count <= 367 && overflow(count) == 0,
            "{count} buckets overflow"
        );
    }

    #[test]
    fn useless_grids_are_refused_and_points_outside_are_not_placed() {
        let unit = [Vec3::ZERO, Vec3::ONE];
        assert!(fit(unit, Vec3::new(1.0, 0.0, 1.0), 0.1, 0.8).is_none());
        assert!(fit(unit, Vec3::splat(f32::NAN), 0.1, 0.8).is_none());
        assert!(fit([Vec3::ZERO, Vec3::splat(1e7)], Vec3::ONE, 0.1, 0.8).is_none());
        let grid = fit(unit, Vec3::new(1.0, 2.0, 4.0), 0.1, 0.8).unwrap();
        assert_eq!(grid.dims, [13, 23, 43]);
        assert!(Placement::of(&grid, Vec3::splat(2.0), Vec3::Y).is_none());
        assert!(Placement::of(&grid, Vec3::splat(f32::NAN), Vec3::Y).is_none());
        for corner in [Vec3::ZERO, Vec3::ONE] {
            assert!(Placement::of(&grid, corner, Vec3::Y).is_some());
        }
    }
}
