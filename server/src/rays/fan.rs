//! Rays from one origin, traced together.
//!
//! A point's rays share their origin, so what a triangle costs (its edges as seen from there) is
//! paid once for all of them, and so is walking down a tree: a box is tested against the ball that
//! the rays reach and the half space they go to, and at the leaves against what groups of
//! neighbouring directions span. What is left is a few multiplications a ray.

use glam::{Mat3A, Vec3, Vec3A};
use obvhs::aabb::Aabb;

use super::body::{Core, Corners, Seen};
use super::lanes::{LANES, Lanes};

/// Groups of a bundle: a bit each in a mask. A group has as many directions as there are lanes.
pub(super) const GROUPS: usize = 32;
/// Rows of groups, each a lane.
const ROWS: usize = GROUPS / LANES;
/// Directions of a bundle.
pub(super) const BUNDLE: usize = LANES * GROUPS;
/// Words of 64 bits that have a bit for each direction of a bundle.
pub(super) const WORDS: usize = BUNDLE / 64;

/// A fixed set of directions, sorted so that neighbours in number are neighbours in space. Bits
/// that say something of each are in this order.
#[derive(Clone, Debug)]
pub struct Directions {
    bundles: Vec<Bundle>,
    /// Which of those given each is.
    given: Vec<u16>,
    /// All have z >= 0.
    upward: bool,
    /// Which of several sets this is, for a device that has them all.
    pub set: u32,
}

/// Up to [`BUNDLE`] directions; those missing have no length, so that they hit nothing.
#[derive(Clone, Debug)]
pub(super) struct Bundle {
    x: [[f32; LANES]; GROUPS],
    y: [[f32; LANES]; GROUPS],
    z: [[f32; LANES]; GROUPS],
}

impl Directions {
    /// Sorts directions: unit vectors, at most 65536. Those of no length, or not finite, hit
    /// nothing.
    pub fn new(directions: &[Vec3]) -> Directions {
        let usable = |d: &Vec3| if d.is_finite() { *d } else { Vec3::ZERO };
        let directions: Vec<Vec3> = directions.iter().map(usable).collect();
        let mut given: Vec<u16> = (0..directions.len()).map(|i| i as u16).collect();
        sort(&directions, &mut given);
        let bundles = given
            .chunks(BUNDLE)
            .map(|part| Bundle::new(&directions, part));
        Directions {
            bundles: bundles.collect(),
            upward: directions.iter().all(|d| d.z >= 0.0),
            given,
            set: 0,
        }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.given.len()
    }

    /// There are none.
    pub fn is_empty(&self) -> bool {
        self.given.is_empty()
    }

    /// Words of 64 bits that have a bit for each.
    pub fn words(&self) -> usize {
        self.len().div_ceil(64)
    }

    /// The number that a direction had when it was given.
    pub(crate) fn given(&self, index: usize) -> usize {
        usize::from(self.given[index])
    }

    /// Direction `index` in the sorted order.
    pub(crate) fn direction(&self, index: usize) -> Vec3 {
        let bundle = &self.bundles[index / BUNDLE];
        let (group, lane) = (index % BUNDLE / LANES, index % LANES);
        Vec3::new(
            bundle.x[group][lane],
            bundle.y[group][lane],
            bundle.z[group][lane],
        )
    }

    /// Sets the bits of those that had a number within `range` when they were given, and clears
    /// all others.
    pub fn mark_given(&self, range: std::ops::Range<usize>, bits: &mut [u64]) {
        if range == (0..self.len()) {
            bits.fill(u64::MAX);
            self.clear_missing(bits);
            return;
        }
        bits.fill(0);
        for (word, part) in bits.iter_mut().zip(self.given.chunks(64)) {
            for (bit, given) in part.iter().enumerate() {
                *word |= u64::from(range.contains(&usize::from(*given))) << bit;
            }
        }
    }

    /// Sets the bits of those whose dot product with the unit vector `axis` is at least `cos`.
    pub(crate) fn mark_cone(&self, axis: Vec3, cos: f32, bits: &mut [u64]) {
        for (bundle, words) in self.bundles.iter().zip(bits.chunks_mut(WORDS)) {
            let groups = bundle.x.iter().zip(&bundle.y).zip(&bundle.z);
            for (group, ((x, y), z)) in groups.enumerate() {
                let mut within = 0;
                for lane in 0..LANES {
                    let dot = axis.x * x[lane] + axis.y * y[lane] + axis.z * z[lane];
                    within |= u64::from(dot >= cos) << lane;
                }
                if let Some(word) = words.get_mut(group * LANES / 64) {
                    *word |= within << (group * LANES % 64);
                }
            }
        }
        // They have no length, so that a wide cone counts them.
        self.clear_missing(bits);
    }

    /// Clears the bits after the last direction.
    fn clear_missing(&self, bits: &mut [u64]) {
        let rest = self.len() % 64;
        if rest != 0
            && let Some(last) = bits.get_mut(self.len() / 64)
        {
            *last &= (1 << rest) - 1;
        }
    }
}

/// Halves the set along its longest extent until groups are left.
fn sort(directions: &[Vec3], part: &mut [u16]) {
    let groups = part.len().div_ceil(LANES);
    if groups < 2 {
        return;
    }
    let at = |i: &u16| directions[usize::from(*i)];
    let (low, high) = part
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), i| {
            (low.min(at(i)), high.max(at(i)))
        });
    let axis = (high - low).max_position();
    let middle = groups / 2 * LANES;
    part.select_nth_unstable_by(middle, |a, b| {
        at(a)[axis].total_cmp(&at(b)[axis]).then(a.cmp(b))
    });
    let (left, right) = part.split_at_mut(middle);
    sort(directions, left);
    sort(directions, right);
}

impl Bundle {
    fn new(directions: &[Vec3], part: &[u16]) -> Bundle {
        let mut bundle = Bundle {
            x: [[0.0; LANES]; GROUPS],
            y: [[0.0; LANES]; GROUPS],
            z: [[0.0; LANES]; GROUPS],
        };
        for (group, lanes) in part.chunks(LANES).enumerate() {
            for (lane, index) in lanes.iter().enumerate() {
                let d = directions[usize::from(*index)];
                bundle.x[group][lane] = d.x;
                bundle.y[group][lane] = d.y;
                bundle.z[group][lane] = d.z;
            }
        }
        bundle
    }
}

/// Rays from one origin: a set of directions, placed.
#[derive(Clone, Copy, Debug)]
pub struct Fan<'a> {
    /// Metres relative to the scene's origin; should come from [`super::offset_origin`].
    pub origin: Vec3,
    /// World from the directions' space: a rotation.
    pub axes: Mat3A,
    /// The directions.
    pub directions: &'a Directions,
}

impl Fan<'_> {
    /// Direction `index`, in the sorted order, in the world.
    pub fn direction(&self, index: usize) -> Vec3 {
        (self.axes * Vec3A::from(self.directions.direction(index))).into()
    }

    /// Sets the bits of the rays within a cone: whose dot product with the unit vector `axis` is
    /// at least `cos`.
    pub fn mark_cone(&self, axis: Vec3, cos: f32, bits: &mut [u64]) {
        let local = self.axes.transpose() * Vec3A::from(axis);
        self.directions.mark_cone(local.into(), cos, bits);
    }

    /// The bundles as rays in another space, each with the words of bits that are its own.
    pub(super) fn bundles(&self) -> impl Iterator<Item = (&Bundle, std::ops::Range<usize>)> {
        let words = |i: usize| i * WORDS..((i + 1) * WORDS).min(self.directions.words());
        let bundles = self.directions.bundles.iter().enumerate();
        bundles.map(move |(i, bundle)| (bundle, words(i)))
    }
}

/// A bundle's rays in the space of a tree.
pub(super) struct Rays<'a, L: Lanes> {
    lanes: L,
    bundle: &'a Bundle,
    axes: Mat3A,
    local_from_world: Option<Mat3A>,
    origin: Vec3A,
    t_max: f32,
    /// No ray gets farther than this in the tree's space, squared.
    reach_squared: f32,
    /// All rays go to the side of this normal that it points to; zero if they may go anywhere.
    normal: Vec3A,
    behind: f32,
    /// Lanes of each group that are asked for and have not hit yet.
    open: [u8; GROUPS],
    /// Groups with such lanes.
    alive: u32,
    packed: Option<Packed<L>>,
}

/// The open rays without gaps, in groups of their own.
struct Packed<L: Lanes> {
    /// In the tree's space.
    directions: [[L::F; 3]; GROUPS],
    /// Lanes that have not hit yet.
    open: [u8; GROUPS],
    /// Groups with such lanes.
    alive: u32,
    /// The group and lane that each lane was: eight times the one and the other.
    from: [u8; BUNDLE],
    /// Inverses of the largest and least components of each group's directions along each axis,
    /// for the time when a ray enters a slab ahead, and one behind (towards negative
    /// coordinates),
    enter: [[[L::F; ROWS]; 2]; 3],
    /// and when it leaves it.
    leave: [[[L::F; ROWS]; 2]; 3],
}

/// Instead of the infinite time to a slab that a ray never gets to.
const NEVER: f32 = 1e30;

impl<'a, L: Lanes> Rays<'a, L> {
    /// The open rays of a bundle: those in `todo` that are not in `hit`. `normal` is the third of
    /// the fan's axes as a plane in the tree's space, if all directions have z >= 0.
    #[inline(always)]
    pub(super) fn new(
        lanes: L,
        fan: &Fan<'_>,
        bundle: &'a Bundle,
        placed: Option<(Mat3A, Mat3A, Vec3A)>,
        t_max: f32,
        todo: &[u64],
        hit: &[u64],
    ) -> Rays<'a, L> {
        let mut open = [0; GROUPS];
        let mut alive = 0;
        for (word, (todo, hit)) in todo.iter().zip(hit).enumerate() {
            let bytes = (todo & !hit).to_le_bytes();
            for (byte, lanes) in bytes.into_iter().enumerate() {
                let group = word * 8 + byte;
                open[group] = lanes;
                alive |= u32::from(lanes != 0) << group;
            }
        }
        let origin = Vec3A::from(fan.origin);
        let (origin, reach, normal) = match &placed {
            None => (origin, t_max, fan.axes.z_axis),
            Some((local_from_world, world_from_local, translation)) => {
                let m = local_from_world;
                // Gershgorin's bound of the largest singular value; exact without shear.
                let squared = *m * m.transpose();
                let [x, y, z] = [squared.x_axis, squared.y_axis, squared.z_axis];
                let row = |row: Vec3A| row.abs().element_sum();
                let stretch = row(x).max(row(y)).max(row(z)).sqrt();
                (
                    *m * (origin - *translation),
                    t_max * stretch,
                    world_from_local.transpose() * fan.axes.z_axis,
                )
            }
        };
        let normal = if fan.directions.upward {
            normal
        } else {
            Vec3A::ZERO
        };
        Rays {
            lanes,
            bundle,
            axes: fan.axes,
            local_from_world: placed.map(|placed| placed.0),
            origin,
            t_max,
            // A little more, for rounding.
            reach_squared: reach * reach * 1.0001,
            behind: -1e-5 * reach * normal.length(),
            normal,
            open,
            alive,
            packed: None,
        }
    }

    /// All have hit something.
    #[inline(always)]
    pub(super) fn done(&self) -> bool {
        self.packed
            .as_ref()
            .map_or(self.alive, |packed| packed.alive)
            == 0
    }

    /// Sets the bits of the rays that have hit something.
    #[inline(always)]
    pub(super) fn gather(&self, todo: &[u64], hit: &mut [u64]) {
        for ((todo, hit), open) in todo.iter().zip(hit).zip(self.open.chunks_exact(8)) {
            let open = open
                .iter()
                .rev()
                .fold(0, |word, lanes| word << 8 | u64::from(*lanes));
            *hit |= todo & !open;
        }
    }

    /// Squared distance to a box, or infinity where no ray gets to it: it is too far, or behind.
    #[inline(always)]
    pub(super) fn distance(&self, bounds: &Aabb) -> f32 {
        let (min, max) = (bounds.min - self.origin, bounds.max - self.origin);
        let ahead = (min * self.normal).max(max * self.normal).element_sum();
        let nearest = min.max(-max).max(Vec3A::ZERO).length_squared();
        if nearest <= self.reach_squared && ahead >= self.behind {
            nearest
        } else {
            f32::INFINITY
        }
    }

    /// Tests the triangles of a leaf against all open rays that may meet its box.
    #[inline(always)]
    pub(super) fn leaf<'b>(
        &mut self,
        bounds: &Aabb,
        triangles: impl Iterator<Item = (&'b Corners, u32)>,
        solid: &impl Fn(u32, f32, f32) -> bool,
    ) {
        if self.packed.is_none() {
            self.packed = Some(self.pack());
        }
        let Some(packed) = &mut self.packed else {
            return;
        };
        let (min, max) = (bounds.min - self.origin, bounds.max - self.origin);
        let towards = packed.towards(self.lanes, min, max, self.t_max);
        if towards == 0 {
            return;
        }
        for (corners, id) in triangles {
            let Some(seen) = corners.seen_from(self.origin, self.normal, self.behind) else {
                continue;
            };
            let mut groups = towards & packed.alive;
            while groups != 0 {
                let group = groups.trailing_zeros() as usize;
                groups &= groups - 1;
                let hit = packed.hits(self.lanes, &seen, group, id, self.t_max, solid);
                packed.open[group] &= !hit;
                if packed.open[group] == 0 {
                    packed.alive &= !(1 << group);
                }
                for lane in (0..LANES).filter(|lane| hit >> lane & 1 == 1) {
                    let from = usize::from(packed.from[group * LANES + lane]);
                    self.open[from / LANES] &= !(1 << (from % LANES));
                }
            }
        }
    }

    /// Tests all open rays against a core.
    #[inline(always)]
    pub(super) fn enter(&mut self, core: &Core) {
        let l = self.lanes;
        let to = core.center - self.origin;
        let distance_squared = to.length_squared();
        // From nearer, a ray might start within the surface. (False for what is not a number.)
        let far = distance_squared > core.outer_radius * core.outer_radius;
        if !far || !distance_squared.is_finite() {
            return;
        }
        let outside = distance_squared - core.radius * core.radius;
        let (outside, to) = (l.splat(outside), l.splat3(to.to_array()));
        let (zero, t_max) = (l.splat(0.0), l.splat(self.t_max));
        let mut groups = self.alive;
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let directions = self.place(group);
            let squared = l.dot(directions, directions);
            let along = l.dot(to, directions);
            let inner = l.sub(l.mul(along, along), l.mul(squared, outside));
            // t = (along - sqrt(inner)) / squared, if it is less than t_max.
            let least = l.sub(along, l.mul(t_max, squared));
            let soon = l.or(l.gt(zero, least), l.gt(inner, l.mul(least, least)));
            let hit = l.and(l.and(l.gt(along, zero), l.gt(inner, zero)), soon);
            self.open[group] &= !(l.bits(hit) as u8);
            if self.open[group] == 0 {
                self.alive &= !(1 << group);
            }
        }
    }

    /// A group's directions in the tree's space, by the same operations as [`Fan::direction`] and
    /// a mover's matrix, so that a fan hits what its rays would hit one by one.
    #[inline(always)]
    fn place(&self, group: usize) -> [L::F; 3] {
        let (l, bundle) = (self.lanes, self.bundle);
        let (x, y, z) = (&bundle.x[group], &bundle.y[group], &bundle.z[group]);
        let turned = turn(l, &self.axes, [l.load(x), l.load(y), l.load(z)]);
        match &self.local_from_world {
            Some(m) => turn(l, m, turned),
            None => turned,
        }
    }

    #[inline(always)]
    fn pack(&self) -> Packed<L> {
        let l = self.lanes;
        let mut packed = Packed {
            directions: [[l.splat(0.0); 3]; GROUPS],
            open: [0; GROUPS],
            alive: 0,
            from: [0; BUNDLE],
            enter: [[[l.splat(NEVER); ROWS]; 2]; 3],
            leave: [[[l.splat(NEVER); ROWS]; 2]; 3],
        };
        // By axis, group and lane, and by axis, row, lane and group of the row.
        let mut lanes = [[[0.0f32; LANES]; GROUPS]; 3];
        let mut groups = [[[[0.0f32; LANES]; LANES]; ROWS]; 3];
        let mut count = 0;
        let mut put = |count: usize, axis: usize, value: f32| {
            let (group, lane) = (count / LANES, count % LANES);
            lanes[axis][group][lane] = value;
            groups[axis][group / LANES][lane][group % LANES] = value;
        };
        let mut last = [0.0; 3];
        for group in 0..GROUPS {
            if self.open[group] == 0 {
                continue;
            }
            let [x, y, z] = self.place(group);
            let (x, y, z) = (l.store(x), l.store(y), l.store(z));
            for lane in 0..LANES {
                if self.open[group] >> lane & 1 == 1 {
                    last = [x[lane], y[lane], z[lane]];
                    put(count, 0, x[lane]);
                    put(count, 1, y[lane]);
                    put(count, 2, z[lane]);
                    packed.from[count] = (group * LANES + lane) as u8;
                    packed.open[count / LANES] |= 1 << (count % LANES);
                    packed.alive |= 1 << (count / LANES);
                    count += 1;
                }
            }
        }
        // Closed lanes of the last group are like another, so as not to widen what it spans.
        for lane in count..count.next_multiple_of(LANES) {
            for axis in 0..3 {
                put(lane, axis, last[axis]);
            }
        }
        for group in 0..count.div_ceil(LANES) {
            let [x, y, z] = &lanes;
            packed.directions[group] = [l.load(&x[group]), l.load(&y[group]), l.load(&z[group])];
        }
        let (zero, one, never) = (l.splat(0.0), l.splat(1.0), l.splat(NEVER));
        // For rounding: longer times to leave, and shorter ones to enter.
        let (wider, narrower) = (l.splat(1.0 + 1e-6), l.splat(1.0 - 1e-6));
        for axis in 0..3 {
            for row in 0..count.div_ceil(LANES).div_ceil(LANES) {
                let own = &groups[axis][row];
                let mut most = l.load(&own[0]);
                let mut least = most;
                for lane in 1..LANES {
                    let component = l.load(&own[lane]);
                    most = l.max(most, component);
                    least = l.min(least, component);
                }
                let over_most = l.div(one, most);
                let over_least = l.div(one, least);
                let (down_most, down_least) = (l.sub(zero, over_most), l.sub(zero, over_least));
                let (rises, falls) = (l.gt(most, zero), l.gt(zero, least));
                let (all_rise, all_fall) = (l.gt(least, zero), l.gt(zero, most));
                let [enter, leave] = [&mut packed.enter[axis], &mut packed.leave[axis]];
                enter[0][row] = l.select(rises, l.mul(over_most, narrower), never);
                enter[1][row] = l.select(falls, l.mul(down_least, narrower), never);
                leave[0][row] = l.select(all_rise, l.mul(over_least, wider), never);
                leave[1][row] = l.select(all_fall, l.mul(down_most, wider), never);
            }
        }
        packed
    }
}

impl<L: Lanes> Packed<L> {
    /// Groups with open rays that may meet a box, given relative to the origin.
    #[inline(always)]
    fn towards(&self, l: L, min: Vec3A, max: Vec3A, t_max: f32) -> u32 {
        let mut enter = [(l.splat(0.0), &self.enter[0][0]); 3];
        let mut leave = [[(l.splat(0.0), &self.leave[0][0]); 2]; 3];
        for axis in 0..3 {
            let (min, max) = (min[axis], max[axis]);
            let side = &self.enter[axis][usize::from(min <= 0.0)];
            enter[axis] = (l.splat(min.max(-max).max(0.0)), side);
            // Far enough from zero that times NEVER it is far.
            let ahead = if max > 0.0 { max.max(1e-12) } else { NEVER };
            let behind = if min < 0.0 { (-min).max(1e-12) } else { NEVER };
            let [to_ahead, to_behind] = &self.leave[axis];
            leave[axis] = [(l.splat(ahead), to_ahead), (l.splat(behind), to_behind)];
        }
        let mut groups = 0;
        let t_max = l.splat(t_max);
        let last = GROUPS - self.alive.leading_zeros() as usize;
        for row in 0..last.div_ceil(LANES) {
            let (mut from, mut to) = (l.splat(0.0), t_max);
            for axis in 0..3 {
                let ((entry, enter), [ahead, behind]) = (enter[axis], leave[axis]);
                from = l.max(from, l.mul(entry, enter[row]));
                to = l.min(to, l.mul(ahead.0, ahead.1[row]));
                to = l.min(to, l.mul(behind.0, behind.1[row]));
            }
            groups |= l.bits(l.ge(to, from)) << (row * LANES);
        }
        groups & self.alive
    }

    /// Lanes of a group that are open and hit a triangle.
    #[inline(always)]
    fn hits(
        &self,
        l: L,
        seen: &Seen,
        group: usize,
        id: u32,
        t_max: f32,
        solid: &impl Fn(u32, f32, f32) -> bool,
    ) -> u8 {
        let directions = self.directions[group];
        let (inside, [a, b, c]) = seen.sides(l, directions);
        let mut lanes = inside & u32::from(self.open[group]);
        let mut hit = 0;
        if lanes == 0 {
            return hit;
        }
        lanes &= seen.in_range(l, directions, t_max);
        let (a, b, c) = (l.store(a), l.store(b), l.store(c));
        while lanes != 0 {
            let lane = lanes.trailing_zeros() as usize;
            lanes &= lanes - 1;
            let sum = a[lane] + b[lane] + c[lane];
            if sum != 0.0 && solid(id, b[lane] / sum, c[lane] / sum) {
                hit |= 1 << lane;
            }
        }
        hit
    }
}

#[inline(always)]
fn turn<L: Lanes>(l: L, by: &Mat3A, given: [L::F; 3]) -> [L::F; 3] {
    let (x, y, z) = (by.x_axis, by.y_axis, by.z_axis);
    [
        l.dot(l.splat3([x.x, y.x, z.x]), given),
        l.dot(l.splat3([x.y, y.y, z.y]), given),
        l.dot(l.splat3([x.z, y.z, z.z]), given),
    ]
}
