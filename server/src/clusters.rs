//! Which points of a mesh make up a patch. A patch comes whole when some of it is seen, so they
//! should be seen together: lie together, and face the same way.

use crate::points::SurfacePoint;
use psao_core::point::NORMALS;
use psao_core::topology::PatchPoint;
use std::cmp::Reverse;

/// Most points of a patch. With twice as many more comes that is not seen, with half as many
/// there are so many patches that what each costs by itself counts.
pub const MOST: usize = 512;

/// As far apart count points that face opposite ways, in steps of 1/32 cell. A flat patch is some 10
/// cells long, so that sides are told apart long before places are.
const OPPOSITE: f32 = 120.0 * 32.0;

/// Few points that face another way are not worth a patch of their own.
const LEAST: usize = 128;

/// Puts points that make up a patch one behind the other, and says how many each has:
/// [`MOST`] at most. The same on any number of threads.
pub fn gather(points: &mut [(PatchPoint, SurfacePoint)]) -> Vec<usize> {
    if points.is_empty() {
        return Vec::new();
    }
    let mut bounds = [[i32::MAX, i32::MIN]; AXES];
    for (point, _) in &*points {
        for ([min, max], at) in bounds.iter_mut().zip(place(point)) {
            (*min, *max) = ((*min).min(at), (*max).max(at));
        }
    }
    let length = |axis: &usize| bounds[*axis][1] - bounds[*axis][0];
    // The first of equals.
    let longest = |axes: usize| {
        (0..axes)
            .min_by_key(|axis| Reverse(length(axis)))
            .unwrap_or(0)
    };
    let fits = points.len() <= MOST;
    let axis = longest(AXES);
    if fits && axis < POSITION_AXES {
        return vec![points.len()];
    }
    let middle = bounds[axis][0] + length(&axis) / 2;
    points.sort_by_key(|(point, _)| place(point)[axis] > middle);
    let mut lower = points.partition_point(|(point, _)| place(point)[axis] <= middle);
    if lower.min(points.len() - lower) < LEAST {
        if fits {
            return vec![points.len()];
        }
        let axis = longest(POSITION_AXES);
        points.sort_by_key(|(point, _)| place(point)[axis]);
        lower = points.len() / 2;
    }
    let (lower, upper) = points.split_at_mut(lower);
    let (mut counts, upper) = rayon::join(|| gather(lower), || gather(upper));
    counts.extend(upper);
    counts
}

/// Of a position, and of that and a normal.
const POSITION_AXES: usize = 3;
const AXES: usize = 6;

/// Where a point lies and which way it faces, so that both can be compared.
fn place(point: &PatchPoint) -> [i32; AXES] {
    let [x, y, z] = point.position.map(|steps| steps as i32);
    let [u, v, w] = NORMALS[point.normal as usize].map(|part| (part * OPPOSITE / 2.0) as i32);
    [x, y, z, u, v, w]
}

#[cfg(test)]
mod tests {
    use super::*;
    use psao_core::point::encode_normal;

    fn point(position: [u32; 3], normal: [f32; 3]) -> (PatchPoint, SurfacePoint) {
        let point = PatchPoint {
            position,
            normal: encode_normal(normal),
            ..PatchPoint::default()
        };
        let anywhere = SurfacePoint {
            triangle: 0,
            u: 0.0,
            v: 0.0,
            back: false,
        };
        (point, anywhere)
    }

    #[test]
    fn the_two_sides_of_a_wall_are_patches_of_their_own() {
        let sides = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
        let at = |i: u32| point([i % 50 * 20, i / 50 * 20, i & 1], sides[i as usize & 1]);
        let mut points: Vec<_> = (0..2500).map(at).collect();
        let counts = gather(&mut points);
        assert_eq!(counts.iter().sum::<usize>(), points.len());
        let mut rest = points.as_slice();
        for count in counts {
            assert!((LEAST..=MOST).contains(&count));
            let patch = rest.split_off(..count).unwrap();
            assert!(patch.iter().all(|(p, _)| p.normal == patch[0].0.normal));
        }
    }

    #[test]
    fn what_cannot_be_told_apart_is_divided_all_the_same() {
        for count in [0, 1, MOST, MOST + 1, 5000] {
            let mut points = vec![point([7; 3], [0.0, 1.0, 0.0]); count];
            let counts = gather(&mut points);
            assert_eq!(counts.iter().sum::<usize>(), count);
            assert!(counts.iter().all(|&count| (1..=MOST).contains(&count)));
        }
    }

    #[test]
    fn few_points_that_face_another_way_stay_with_the_others() {
        let normal = |i: u32| [0.0, if i < 450 { 1.0 } else { -1.0 }, 0.0];
        let mut points: Vec<_> = (0..500).map(|i| point([i, 0, 0], normal(i))).collect();
        assert_eq!(gather(&mut points), [500]);
    }
}
