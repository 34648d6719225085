//! The point: 32 bits, as in the paper's section 3.2.
//!
//! | bits | what |
//! |---|---|
//! | 31 | allocated |
//! | 16..=30 | position in its cell, 5 bits an axis: x at 16, y at 21, z at 26 |
//! | 8..=15 | normal, octahedral, 4 bits an axis: u at 8, v at 12 |
//! | 0..=7 | occlusion: 255 is open, 0 fully occluded |

use bytemuck::{Pod, Zeroable};

/// Steps of a position along one axis of a cell.
pub const POSITION_STEPS: u32 = 32;

/// A packed point. The all-zero value is "no point".
#[repr(transparent)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Point(pub u32);

impl Point {
    /// No point here.
    pub const EMPTY: Point = Point(0);

    /// A place that a point has left while others behind it stay: readers skip it.
    pub const LEFT: Point = Point(1);

    /// Packs a point. `position`: steps of 1/32 cell an axis, 0..=31 (higher bits are cut off);
    /// `normal`: a code of [`encode_normal`]; `occlusion`: 255 is open.
    pub const fn pack(position: [u32; 3], normal: u8, occlusion: u8) -> Point {
        Point(
            1 << 31
                | (position[2] & 31) << 26
                | (position[1] & 31) << 21
                | (position[0] & 31) << 16
                | (normal as u32) << 8
                | occlusion as u32,
        )
    }

    /// A point is stored here.
    pub const fn is_allocated(self) -> bool {
        self.0 >> 31 != 0
    }

    /// Position in steps of 1/32 cell, 0..=31 an axis. The point lies in the middle of its step.
    pub const fn position(self) -> [u32; 3] {
        [self.0 >> 16 & 31, self.0 >> 21 & 31, self.0 >> 26 & 31]
    }

    /// The normal's code.
    pub const fn normal(self) -> u8 {
        (self.0 >> 8) as u8
    }

    /// 255 is open, 0 fully occluded.
    pub const fn occlusion(self) -> u8 {
        self.0 as u8
    }

    /// The same point with another occlusion.
    pub const fn with_occlusion(self, occlusion: u8) -> Point {
        Point(self.0 & !0xff | occlusion as u32)
    }
}

/// Quantises a coordinate inside its cell (0..1, in cells) to 1/32 steps, clamped to the cell.
pub fn encode_position(in_cell: f32) -> u32 {
    // The cast saturates, and takes NaN to 0.
    ((in_cell * POSITION_STEPS as f32) as u32).min(POSITION_STEPS - 1)
}

/// The middle of a position step, in cells.
pub fn decode_position(step: u32) -> f32 {
    (step as f32 + 0.5) * (1.0 / POSITION_STEPS as f32)
}

/// One axis of a normal's code: 15 levels from -1 to 1, so that 0 and ±1 are exact and axis-aligned
/// surfaces keep their normals; code 15 reads as 14.
const fn decode_axis(code: u32) -> f32 {
    let level = if code > 14 { 14 } else { code };
    (level as f32 - 7.0) / 7.0
}

/// The octahedral map before normalisation: |x| + |y| + |z| = 1.
const fn octahedron(u: f32, v: f32) -> [f32; 3] {
    let (au, av) = (u.abs(), v.abs());
    let z = 1.0 - au - av;
    if z >= 0.0 {
        [u, v, z]
    } else {
        [
            if u < 0.0 { av - 1.0 } else { 1.0 - av },
            if v < 0.0 { au - 1.0 } else { 1.0 - au },
            z,
        ]
    }
}

/// The unit normals of all 256 codes: octahedral, 4 + 4 bits, 15 levels an axis.
pub static NORMALS: [[f32; 3]; 256] = {
    let mut table = [[0.0; 3]; 256];
    let mut code = 0;
    while code < 256 {
        let n = octahedron(decode_axis(code as u32 & 15), decode_axis(code as u32 >> 4));
        let squared = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) as f64;
        // Newton's iteration from above: sqrt is not const.
        let mut root = 1.0f64;
        let mut step = 0;
        while step < 12 {
            root = 0.5 * (root + squared / root);
            step += 1;
        }
        table[code] = [
            (n[0] as f64 / root) as f32,
            (n[1] as f64 / root) as f32,
            (n[2] as f64 / root) as f32,
        ];
        code += 1;
    }
    table
};

/// [`NORMALS`], an axis at a time: several points' are put together without taking vectors apart.
pub(crate) static NORMAL_AXES: [[f32; 256]; 3] = {
    let mut table = [[0.0; 256]; 3];
    let mut code = 0;
    while code < 256 {
        let mut axis = 0;
        while axis < 3 {
            table[axis][code] = NORMALS[code][axis];
            axis += 1;
        }
        code += 1;
    }
    table
};

/// The unit normals of all codes in 1/127, each component rounded towards 0.
pub(crate) static NORMAL_STEPS: [[i32; 3]; 256] = {
    let mut table = [[0; 3]; 256];
    let mut code = 0;
    while code < 256 {
        let mut axis = 0;
        while axis < 3 {
            table[code][axis] = (NORMALS[code][axis] * 127.0) as i32;
            axis += 1;
        }
        code += 1;
    }
    table
};

/// The unit normal of a code.
pub fn decode_normal(code: u8) -> [f32; 3] {
    NORMALS[code as usize]
}

/// The code whose normal is nearest to `normal` (any length); +z for zero or non-finite input.
pub fn encode_normal(normal: [f32; 3]) -> u8 {
    let [x, y, z] = normal;
    let sum = x.abs() + y.abs() + z.abs();
    let straight_up = 7 | 7 << 4;
    if !(sum > 0.0 && sum < f32::INFINITY) {
        return straight_up;
    }
    let (mut u, mut v) = (x / sum, y / sum);
    if z < 0.0 {
        let folded = (1.0 - v.abs(), 1.0 - u.abs());
        u = if x < 0.0 { -folded.0 } else { folded.0 };
        v = if y < 0.0 { -folded.1 } else { folded.1 };
    }
    // Rounding each axis alone is not the nearest on the sphere: try the four around.
    let (u0, v0) = (((u + 1.0) * 7.0) as u32, ((v + 1.0) * 7.0) as u32);
    let mut best = (straight_up, f32::NEG_INFINITY);
    let mut corner = 0;
    while corner < 4 {
        let code = ((u0 + (corner & 1)).min(14) | (v0 + (corner >> 1)).min(14) << 4) as u8;
        let n = decode_normal(code);
        let dot = n[0] * x + n[1] * y + n[2] * z;
        if dot > best.1 {
            best = (code, dot);
        }
        corner += 1;
    }
    best.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_position_and_occlusion_survives_packing() {
        for position in 0..1u32 << 15 {
            let p = [position & 31, position >> 5 & 31, position >> 10 & 31];
            let point = Point::pack(p, (position % 251) as u8, (position % 256) as u8);
            assert!(point.is_allocated());
            assert_eq!(point.position(), p);
            assert_eq!(point.normal(), (position % 251) as u8);
            assert_eq!(point.occlusion(), (position % 256) as u8);
            assert_eq!(point.with_occlusion(9).position(), p);
            for axis in p {
                assert_eq!(encode_position(decode_position(axis)), axis);
            }
        }
    }

    #[test]
    fn every_normal_code_decodes_to_unit_length_and_encodes_back() {
        for code in 0..=255u8 {
            let n = decode_normal(code);
            let length = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
            assert!((length - 1.0).abs() < 1e-6, "code {code}: length² {length}");
            let again = decode_normal(encode_normal(n));
            let dot = n[0] * again[0] + n[1] * again[1] + n[2] * again[2];
            assert!(
                dot > 1.0 - 1e-6,
                "code {code} came back as another normal, dot {dot}"
            );
        }
    }

    #[test]
    fn axis_aligned_normals_are_exact() {
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut n = [0.0; 3];
                n[axis] = sign;
                assert_eq!(decode_normal(encode_normal(n)), n);
            }
        }
    }

    #[test]
    fn encoding_picks_the_nearest_of_all_codes() {
        let mut seed = 1u32;
        let mut random = || {
            seed = seed.wrapping_mul(747796405).wrapping_add(2891336453);
            (seed >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
        };
        let mut worst: f32 = 1.0;
        for _ in 0..20_000 {
            let n = [random(), random(), random()];
            let length = libm::sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
            if length < 0.1 {
                continue;
            }
            let dot = |code: u8| {
                let m = decode_normal(code);
                (n[0] * m[0] + n[1] * m[1] + n[2] * m[2]) / length
            };
            let best = (0..=255).map(dot).fold(-1.0, f32::max);
            let got = dot(encode_normal(n));
            // The four corners of the square in the map are not always the nearest on the
            // sphere, but never far from it.
            assert!(got > best - 0.004, "{n:?}: {got} < {best}");
            worst = worst.min(got);
        }
        // 15 levels an axis: the coarsest spot of the map is 11.5 degrees off.
        assert!(worst > 0.979, "worst angle's cosine {worst}");
    }

    #[test]
    fn useless_normals_encode_as_something() {
        for n in [[0.0; 3], [f32::NAN, 0.0, 0.0], [f32::INFINITY, 1.0, 0.0]] {
            assert_eq!(decode_normal(encode_normal(n)), [0.0, 0.0, 1.0]);
        }
        assert_eq!(encode_position(f32::NAN), 0);
        assert_eq!(encode_position(-1.0), 0);
        assert_eq!(encode_position(1.0), 31);
    }
}
