//! The lookup on the CPU: the definition that every shader has to agree with to 1/255.
//!
//! A fragment at local position x with normal n blends the points of the 2×2×2 nearest cells of
//! its instance's grid (paper, section 3.5). All lengths are in cells.

use crate::cell::{Bucket, CELL_POINTS, Cell};
use crate::grid::Instance;
use crate::point::{NORMAL_AXES, POSITION_STEPS, Point, decode_position};

/// Eq. 3: points whose normal differs more than this (as a dot product) do not count; for
/// [`Kernel::Planar`] they count as if it were this much, so next to nothing beside others.
pub const T_N: f32 = 0.1;

/// Eq. 3: points that lie this much above or below their own plane do not count.
pub const T_D: f32 = 0.7;

/// [`Kernel::Planar`]: squared distances from the planes count this much more than those along
/// them.
pub const FLATNESS: f32 = 30.0;

/// [`Kernel::Planar`]: the squared distance, in radii, from which weights begin to fall.
pub const CORE: f32 = 0.5;

/// [`Kernel::Planar`]: the squared distance, in radii, from which points count next to nothing: the
/// floor beyond a wall that is as thick as that does not show on this side.
pub const REACH: f32 = 1.2;

/// [`Kernel::Planar`]: what is left of a point's weight beyond that, so that places without a point
/// in reach have an answer too.
pub const BEYOND: f32 = 0.001;

/// [`Kernel::Planar`]: how far before the block switches the cells fade that it will leave, in
/// cells.
pub const FADE: f32 = 0.3;

/// [`Kernel::Planar`]: points less open than this count less, by the square.
pub const SEEN: f32 = 0.2;

/// [`Kernel::Planar`]: what a point counts at least, however dark.
pub const UNSEEN: f32 = 0.0001;

/// From this weight on, points that are not dark are near: what a baked value is for is not there
/// any more. A point of [`Kernel::Planar`] at the fragment weighs 4, one at the radius 0.07.
pub const NEAR: f32 = 0.05;

/// How the points around a fragment are weighted.
#[repr(u8)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// The paper's, Eq. 2 to 4; 1 where no point counts.
    Paper = 0,
    /// s · (min(1, 5o)² + 0.0001) · max(0.001, 1 − d²/1.2r²) · max(0.1, n·nₚ)⁸
    /// / (0.5 + (d² + 30h²)/r²)² with h = max(|n·d|, |nₚ·d|); 1 where no point was fetched.
    ///
    /// s is the part of the point's cell: along each axis it falls to 0 over the last 0.3 cells
    /// before the block leaves the cell, so that the answer has no steps. A point of openness o
    /// below 0.2 counts less, as hardly any fragment nearby can see it: such points lie inside of
    /// solids or under what stands on their surface. Points that face elsewhere count next to
    /// nothing, and so only where there is no other. So do points out of reach: what lies on the
    /// other side of a wall does not show on a floor that goes on below it.
    #[default]
    Planar = 1,
}

/// The buffers a lookup reads.
#[derive(Clone, Copy, Debug)]
pub struct Lookup<'a> {
    /// Instance buffer.
    pub instances: &'a [Instance],
    /// Bucket buffer.
    pub buckets: &'a [Bucket],
    /// Cell buffer.
    pub cells: &'a [Cell],
}

/// What a lookup found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// 1 is open, 0 fully occluded. Never NaN.
    pub openness: f32,
    /// Sum of the weights; 0 where no point counted (`Paper`: a hole).
    pub weight: f32,
    /// Points read.
    pub fetched: u32,
    /// How far the stream covers the place: 0 where no point lies near that faces as the fragment
    /// does, 1 where enough do, and without a step between.
    pub near: f32,
}

impl Answer {
    /// What a place without points gets.
    pub const OPEN: Answer = Answer {
        openness: 1.0,
        weight: 0.0,
        fetched: 0,
        near: 0.0,
    };

    /// This answer where the stream covers the place, and a baked value where it does not.
    ///
    /// `baked`: openness, 0 to 1; one that is NaN counts as open. `share`: how much of the stream
    /// to show where it has come, 0 to 1; rises over some frames after the first, so that nothing
    /// flashes.
    pub fn over_baked(&self, baked: f32, share: f32) -> f32 {
        let baked = if baked.is_nan() {
            1.0
        } else {
            baked.clamp(0.0, 1.0)
        };
        // A share that is NaN shows nothing of the stream.
        let share = if share > 0.0 { share.min(1.0) } else { 0.0 };
        baked + (self.openness - baked) * (share * self.near)
    }
}

type Vec3 = [f32; 3];

/// A step of a point's position, in cells.
const STEP: f32 = 1.0 / POSITION_STEPS as f32;

/// The larger, `b` where `a` is NaN: an instruction, where `f32::max` is several.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The smaller, `b` where `a` is NaN.
#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn dot(a: Vec3, b: Vec3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl Lookup<'_> {
    /// Blends the points around a fragment.
    ///
    /// `position`, `normal` (any length): in the instance's local space. Unknown instances,
    /// instances without points, positions outside the grid and non-finite input answer 1; a zero
    /// normal agrees with no point, so `Paper` answers 1 and `Planar` blends by distance alone.
    pub fn blend(&self, kernel: Kernel, instance: u32, position: Vec3, normal: Vec3) -> Answer {
        // Chosen once, so that no point asks again.
        match kernel {
            // Roots come one at a time: with more lanes it would only weigh empty ones.
            Kernel::Paper => self.blend_by::<Paper, 1>(instance, position, normal),
            Kernel::Planar => self.blend_by::<Planar, 4>(instance, position, normal),
        }
    }

    /// `LANES` points of a cell are weighed at once.
    fn blend_by<W: Weigh, const LANES: usize>(
        &self,
        instance: u32,
        position: Vec3,
        normal: Vec3,
    ) -> Answer {
        let Some(grid) = self.instances.get(instance as usize) else {
            return Answer::OPEN;
        };
        if grid.bucket_count == 0 {
            return Answer::OPEN;
        }
        let g = grid.to_cells(position);
        let Some(normal) = to_cell_space(normal, grid) else {
            return Answer::OPEN;
        };
        // The block's lower cell, −1 at least, and the fragment's place seen from it, 0.5..1.5.
        let mut base = [0i32; 3];
        let mut place = [0.0f32; 3];
        for axis in 0..3 {
            if !(g[axis] >= -0.5 && g[axis] < grid.dims[axis] as f32 + 0.5) {
                return Answer::OPEN;
            }
            // The floor, without a call.
            let shifted = g[axis] - 0.5;
            let whole = shifted as i32;
            base[axis] = whole - i32::from(whole as f32 > shifted);
            place[axis] = g[axis] - base[axis] as f32;
        }
        let kernel = W::new(grid.radius, normal);
        let sides = [sides(place[0]), sides(place[1]), sides(place[2])];
        // Where steps are counted from: the middle of a cell's first.
        let middle = decode_position(0);
        let seen_from = [place[0] - middle, place[1] - middle, place[2] - middle];
        let mut blended = Blended::<LANES>::default();
        // −1 becomes a large number: below the grid is out of range too.
        let [x, y, z] = [base[0] as u32, base[1] as u32, base[2] as u32];
        for row in 0..4 {
            let (up_y, up_z) = (row & 1, row >> 1);
            let lower = [x, y.wrapping_add(up_y), z.wrapping_add(up_z)];
            if lower[1] >= grid.dims[1] || lower[2] >= grid.dims[2] {
                continue;
            }
            let key = grid.key(lower);
            let [bucket, next] = grid.bucket_pair(lower);
            for up_x in 0..2 {
                if x.wrapping_add(up_x) >= grid.dims[0] {
                    continue;
                }
                // Not an array: that would be looked up in memory.
                let bucket = if up_x == 0 { bucket } else { next };
                let Some(cell) = self.named(bucket, key.wrapping_add(up_x)) else {
                    continue;
                };
                let from = [
                    up_x as f32 - seen_from[0],
                    up_y as f32 - seen_from[1],
                    up_z as f32 - seen_from[2],
                ];
                let [side_x, side_y, side_z] = sides;
                let side = match W::FADES {
                    true => side_x[up_x as usize] * side_y[up_y as usize] * side_z[up_z as usize],
                    false => 1.0,
                };
                blended.add(&kernel, cell, from, side);
            }
        }
        blended.answer::<W>()
    }

    /// The cell at a grid coordinate: hash, then search its bucket for the key.
    pub fn find(&self, grid: &Instance, cell: [u32; 3]) -> Option<&Cell> {
        self.named(grid.bucket(cell), grid.key(cell))
    }

    /// The cell of this key that a bucket names.
    #[inline(always)]
    fn named(&self, bucket: u32, key: u32) -> Option<&Cell> {
        let bucket = self.buckets.get(bucket as usize)?;
        // A loop, not iterators: those are not inlined, and this is a quarter of a lookup.
        for &entry in &bucket.entries {
            if entry == 0 {
                break;
            }
            if let Some(cell) = self.cells.get(entry as usize)
                && cell.key == key
            {
                return Some(cell);
            }
        }
        None
    }
}

/// How much the lower and the upper cells of a block count along an axis, for a fragment at this
/// place in it: nothing once the block is about to leave them.
fn sides(place: f32) -> [f32; 2] {
    [1.5 - place, place - 0.5].map(|left| (left * (1.0 / FADE)).clamp(0.0, 1.0))
}

/// The fragment's unit normal in cell space; zero for a zero one, none for a non-finite one.
fn to_cell_space(normal: Vec3, grid: &Instance) -> Option<Vec3> {
    let largest = normal.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    if !normal.iter().all(|v| v.is_finite()) {
        return None;
    }
    if largest == 0.0 {
        return Some([0.0; 3]);
    }
    // Divided by the largest first, so that no square over- or underflows.
    let n: Vec3 = core::array::from_fn(|axis| normal[axis] / largest * grid.normal_scale[axis]);
    let squared = dot(n, n);
    if squared == 0.0 {
        return Some([0.0; 3]);
    }
    let scale = 1.0 / libm::sqrtf(squared);
    Some([n[0] * scale, n[1] * scale, n[2] * scale])
}

/// A kernel, for one fragment.
trait Weigh {
    /// Cells fade before the block leaves them.
    const FADES: bool;

    /// `radius` in cells; a unit normal in cell space, or zero.
    fn new(radius: f32, normal: Vec3) -> Self;

    /// The weight of a point at `d` from the fragment; `occlusion` as points have it, 0 to 255.
    fn weight(&self, d: Vec3, point_normal: Vec3, occlusion: f32) -> f32;

    /// The part of a weight that says how open a point is, not how near.
    fn seen(occlusion: f32) -> f32;
}

/// Eq. 2 and 3.
struct Paper {
    normal: Vec3,
    radius: f32,
    inverse_radius: f32,
}

impl Weigh for Paper {
    const FADES: bool = false;

    fn new(radius: f32, normal: Vec3) -> Paper {
        Paper {
            normal,
            radius,
            // Finite, for the same reason as that of `Planar`.
            inverse_radius: (1.0 / radius).min(f32::MAX),
        }
    }

    #[inline(always)]
    fn weight(&self, d: Vec3, point_normal: Vec3, _: f32) -> f32 {
        let squared = dot(d, d);
        let along = dot(point_normal, d);
        // Not lazily: a jump that is guessed wrong takes longer than both.
        let away = dot(point_normal, self.normal) <= T_N;
        let off_plane = (along * along >= T_D * squared) & (squared > 0.0);
        let near = larger(
            (self.radius - libm::sqrtf(squared)) * self.inverse_radius,
            0.0,
        );
        if away | off_plane { 0.0 } else { near }
    }

    fn seen(_: f32) -> f32 {
        1.0
    }
}

struct Planar {
    normal: Vec3,
    inverse_radius_squared: f32,
}

impl Weigh for Planar {
    const FADES: bool = true;

    fn new(radius: f32, normal: Vec3) -> Planar {
        Planar {
            normal,
            // Finite, so that a point right at the fragment is at distance 0 for any radius.
            inverse_radius_squared: (1.0 / (radius * radius)).min(f32::MAX),
        }
    }

    #[inline(always)]
    fn weight(&self, d: Vec3, point_normal: Vec3, occlusion: f32) -> f32 {
        let agree = larger(dot(point_normal, self.normal), T_N);
        let (to_plane, to_own) = (dot(self.normal, d), dot(point_normal, d));
        let h_squared = larger(to_plane * to_plane, to_own * to_own);
        let squared = dot(d, d);
        let far = CORE + (squared + FLATNESS * h_squared) * self.inverse_radius_squared;
        let within = 1.0 - squared * self.inverse_radius_squared * (1.0 / REACH);
        let in_reach = larger(within, BEYOND);
        let agree2 = agree * agree;
        let agree4 = agree2 * agree2;
        Self::seen(occlusion) * in_reach * (agree4 * agree4) / (far * far)
    }

    #[inline(always)]
    fn seen(occlusion: f32) -> f32 {
        let lit = smaller(occlusion * (1.0 / (255.0 * SEEN)), 1.0);
        lit * lit + UNSEEN
    }
}

/// Empties what is behind an empty place. Writers leave nothing there, so this is hardly ever
/// called, and its jumps are in nobody's way.
#[cold]
fn empty_behind(points: &mut [Point]) {
    for at in 1..points.len() {
        if points[at - 1] == Point::EMPTY {
            points[at] = Point::EMPTY;
        }
    }
}

/// What points come to: sums over them, a lane for each of those that are weighed at once. In a
/// fixed order, so that all processors answer the same.
struct Blended<const LANES: usize> {
    weight: [f32; LANES],
    /// Of weight times occlusion, 0 to 255.
    sum: [f32; LANES],
    fetched: [u32; LANES],
}

impl<const LANES: usize> Default for Blended<LANES> {
    fn default() -> Self {
        Blended {
            weight: [0.0; LANES],
            sum: [0.0; LANES],
            fetched: [0; LANES],
        }
    }
}

impl<const LANES: usize> Blended<LANES> {
    /// Adds a cell's points, of which `side` counts; `from` is the vector from the fragment to the
    /// middle of the cell's first step. Loops over lanes become vectors: they hold no jump and call
    /// nothing.
    #[inline(always)]
    fn add<W: Weigh>(&mut self, kernel: &W, cell: &Cell, from: Vec3, side: f32) {
        for first in (0..CELL_POINTS).step_by(LANES) {
            if cell.points[first] == Point::EMPTY {
                break;
            }
            let mut points = [Point::EMPTY; LANES];
            #[allow(clippy::manual_memcpy, reason = "that would be a call, for one load")]
            for lane in 0..LANES.min(CELL_POINTS - first) {
                points[lane] = cell.points[first + lane];
            }
            let mut gap = false;
            for lane in 1..LANES {
                gap |= (points[lane - 1] == Point::EMPTY) & (points[lane] != Point::EMPTY);
            }
            if gap {
                empty_behind(&mut points);
            }
            for lane in 0..LANES {
                let point = points[lane];
                let [x, y, z] = point.position();
                let d = [
                    from[0] + x as f32 * STEP,
                    from[1] + y as f32 * STEP,
                    from[2] + z as f32 * STEP,
                ];
                let code = point.normal() as usize;
                let normal = [
                    NORMAL_AXES[0][code],
                    NORMAL_AXES[1][code],
                    NORMAL_AXES[2][code],
                ];
                let occlusion = f32::from(point.occlusion());
                let weight = side * kernel.weight(d, normal, occlusion);
                let weight = if point.is_allocated() { weight } else { 0.0 };
                self.weight[lane] += weight;
                self.sum[lane] += weight * occlusion;
                self.fetched[lane] += u32::from(point.is_allocated());
            }
            if points[LANES - 1] == Point::EMPTY {
                break;
            }
        }
    }

    /// Eq. 4.
    fn answer<W: Weigh>(&self) -> Answer {
        let mut answer = Answer {
            weight: self.weight.iter().sum(),
            fetched: self.fetched.iter().sum(),
            ..Answer::OPEN
        };
        if answer.weight > 0.0 {
            let occlusion = self.sum.iter().sum::<f32>() / answer.weight;
            // The quotient of two sums may round past the largest value blended.
            answer.openness = (occlusion * (1.0 / 255.0)).min(1.0);
            // Dark points weigh less, but are as near.
            answer.near = (answer.weight / (NEAR * W::seen(occlusion))).min(1.0);
        }
        answer
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point::{Point, encode_normal};

    /// One instance of 4×4×4 cells of unit size, one cell filled.
    fn scene(cell: [u32; 3], points: &[Point]) -> (Instance, [Bucket; 16], [Cell; 2]) {
        let grid = Instance {
            radius: 0.8,
            cells_per_unit: [1.0; 3],
            dims: [4; 3],
            bucket_count: 16,
            normal_scale: [1.0; 3],
            ..Instance::default()
        };
        let mut buckets = [Bucket::default(); 16];
        buckets[grid.bucket(cell) as usize].entries[0] = 1;
        let mut cells = [Cell::default(); 2];
        cells[1].key = grid.key(cell);
        cells[1].points[..points.len()].copy_from_slice(points);
        (grid, buckets, cells)
    }

    fn up(occlusion: u8) -> Point {
        Point::pack([16, 0, 16], encode_normal([0.0, 1.0, 0.0]), occlusion)
    }

    #[test]
    fn a_point_is_seen_from_the_blocks_that_hold_its_cell() {
        let (grid, buckets, cells) = scene([1, 1, 1], &[up(51)]);
        let lookup = Lookup {
            instances: &[grid],
            buckets: &buckets,
            cells: &cells,
        };
        for kernel in [Kernel::Paper, Kernel::Planar] {
            let here = lookup.blend(kernel, 0, [1.4, 1.01, 1.6], [0.0, 2.0, 0.0]);
            assert!(
                (here.openness - 0.2).abs() < 1e-6 && here.weight > 0.0,
                "{here:?}"
            );
            let far = lookup.blend(kernel, 0, [3.5, 1.0, 1.5], [0.0, 1.0, 0.0]);
            assert_eq!((far.openness, far.fetched), (1.0, 0));
            let other_side = lookup.blend(kernel, 0, [1.4, 1.01, 1.6], [0.0, -1.0, 0.0]);
            let alone = kernel == Kernel::Planar;
            let expected = if alone { 0.2 } else { 1.0 };
            assert!(
                (other_side.openness - expected).abs() < 1e-6 && (other_side.weight > 0.0) == alone,
                "{kernel:?} of a point that faces away: {other_side:?}"
            );
        }
    }

    #[test]
    fn places_that_were_left_are_skipped_and_nothing_behind_an_empty_one_counts() {
        let (a, b) = (up(51), up(204));
        let (left, empty) = (Point::LEFT, Point::EMPTY);
        let gap_in_four = [a, empty, b, b, b, b, b];
        let gap_after_four = [a, a, a, a, a, empty, b];
        let all_left = [left, left, left, left, left, b, left];
        for (points, fetched, openness) in [
            (&[a, left, a][..], 2, 0.2),
            (&gap_in_four, 1, 0.2),
            (&gap_after_four, 5, 0.2),
            (&all_left, 1, 0.8),
            (&[empty, b], 0, 1.0),
        ] {
            let (grid, buckets, cells) = scene([1, 1, 1], points);
            let lookup = Lookup {
                instances: &[grid],
                buckets: &buckets,
                cells: &cells,
            };
            for kernel in [Kernel::Paper, Kernel::Planar] {
                let answer = lookup.blend(kernel, 0, [1.4, 1.01, 1.6], [0.0, 1.0, 0.0]);
                assert_eq!(answer.fetched, fetched, "{kernel:?} {points:?}");
                assert!((answer.openness - openness).abs() < 1e-6, "{answer:?}");
            }
        }
    }

    #[test]
    fn planar_hides_what_faces_away_and_what_is_dark_behind_what_is_not() {
        let down = Point::pack([16, 0, 16], encode_normal([0.0, -1.0, 0.0]), 10);
        for other in [down, up(0)] {
            let (grid, buckets, cells) = scene([1, 1, 1], &[other, up(204)]);
            let lookup = Lookup {
                instances: &[grid],
                buckets: &buckets,
                cells: &cells,
            };
            let both = lookup.blend(Kernel::Planar, 0, [1.4, 1.01, 1.6], [0.0, 1.0, 0.0]);
            assert!((both.openness - 0.8).abs() < 1e-3, "{both:?}");
        }
    }

    #[test]
    fn planar_does_not_jump_where_the_block_leaves_a_cell() {
        let (grid, buckets, cells) = scene([1, 1, 1], &[up(51)]);
        let lookup = Lookup {
            instances: &[grid],
            buckets: &buckets,
            cells: &cells,
        };
        let weight = |x| {
            lookup
                .blend(Kernel::Planar, 0, [x, 1.01, 1.6], [0.0, 1.0, 0.0])
                .weight
        };
        let steps: [f32; 2001] = core::array::from_fn(|i| weight(0.4 + i as f32 * 1.1e-3));
        let most = steps.iter().copied().fold(0.0, f32::max);
        for pair in steps.windows(2) {
            assert!(
                (pair[1] - pair[0]).abs() < 0.01 * most,
                "{pair:?} of {most}"
            );
        }
        assert_eq!((steps[0], steps[2000]), (0.0, 0.0));
    }

    #[test]
    fn baked_values_show_where_no_point_is_and_give_way_without_a_step() {
        for (kernel, occlusion) in [
            (Kernel::Planar, 102),
            (Kernel::Planar, 0),
            (Kernel::Paper, 102),
        ] {
            let (grid, buckets, cells) = scene([1, 1, 1], &[up(occlusion)]);
            let lookup = Lookup {
                instances: &[grid],
                buckets: &buckets,
                cells: &cells,
            };
            let at = |x: f32, up: f32| lookup.blend(kernel, 0, [x, 1.01, 1.6], [0.0, up, 0.0]);
            let streamed = f32::from(occlusion) / 255.0;
            let here = at(1.4, 1.0);
            assert!(
                (here.over_baked(0.9, 1.0) - streamed).abs() < 1e-6,
                "{here:?}"
            );
            assert_eq!(here.over_baked(0.9, 0.0), 0.9);
            let half = here.over_baked(0.9, 0.5);
            assert!((half - (0.9 + streamed) / 2.0).abs() < 1e-6, "{half}");
            // A slice that has not come, another instance, and the other side of a wall.
            let (far, unknown) = (at(3.5, 1.0), lookup.blend(kernel, 9, [0.0; 3], [0.0; 3]));
            for nothing in [far, unknown, at(1.4, -1.0)] {
                let shown = nothing.over_baked(0.9, 1.0);
                assert!((shown - 0.9).abs() < 1e-4, "{nothing:?}");
            }
            let steps = (0..2000).map(|i| at(0.4 + i as f32 * 1.1e-3, 1.0).over_baked(0.9, 1.0));
            let steps: [f32; 2000] = {
                let mut all = [0.0; 2000];
                all.iter_mut().zip(steps).for_each(|(to, step)| *to = step);
                all
            };
            for pair in steps.windows(2) {
                assert!((pair[1] - pair[0]).abs() < 0.05, "{kernel:?}: {pair:?}");
            }
        }
    }

    #[test]
    fn no_input_gives_nan_or_a_panic() {
        let (mut grid, buckets, cells) = scene([0, 0, 0], &[up(0); 7]);
        let odd = [
            f32::NAN,
            f32::INFINITY,
            f32::NEG_INFINITY,
            0.0,
            -0.0,
            1e38,
            -1e38,
            1e-45,
            0.5,
        ];
        for radius in [0.8, 1e-38, 1e30] {
            grid.radius = radius;
            let lookup = Lookup {
                instances: &[grid],
                buckets: &buckets,
                cells: &cells,
            };
            for kernel in [Kernel::Paper, Kernel::Planar] {
                for a in odd {
                    for b in odd {
                        for (position, normal) in [
                            ([a, b, 0.5], [0.0, 1.0, 0.0]),
                            ([0.5, 0.1, 0.5], [a, b, 0.0]),
                        ] {
                            let answer = lookup.blend(kernel, 0, position, normal);
                            assert!((0.0..=1.0).contains(&answer.openness), "{answer:?}");
                            assert!((0.0..=1.0).contains(&answer.over_baked(a, b)), "{answer:?}");
                            let finite = |v: Vec3| v.iter().all(|v| v.is_finite());
                            if !(finite(position) && finite(normal)) {
                                assert_eq!(answer.openness, 1.0);
                            }
                        }
                    }
                }
                assert_eq!(lookup.blend(kernel, 9, [0.0; 3], [0.0; 3]), Answer::OPEN);
            }
        }
    }
}
