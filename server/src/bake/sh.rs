//! Real spherical harmonics, bands 0 to 3: light from all around in a few numbers.

use glam::Vec3;

/// Most coefficients: order 4.
pub const MAX_COEFFICIENTS: usize = 16;

/// Coefficients of an order: bands below it, so 4 for order 2, 9 for order 3, 16 for order 4.
pub fn coefficients(order: usize) -> usize {
    order * order
}

/// The basis functions at a unit direction, orthonormal over the sphere, band by band and in
/// each from order -l to l (with y, z, x in band 1), in axes where z is up.
pub fn basis(d: Vec3) -> [f32; MAX_COEFFICIENTS] {
    let Vec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_8,
        0.488_602_5 * y,
        0.488_602_5 * z,
        0.488_602_5 * x,
        1.092_548_4 * x * y,
        1.092_548_4 * y * z,
        0.315_391_57 * (3.0 * zz - 1.0),
        1.092_548_4 * x * z,
        0.546_274_2 * (xx - yy),
        0.590_043_6 * y * (3.0 * xx - yy),
        2.890_611_4 * x * y * z,
        0.457_045_8 * y * (5.0 * zz - 1.0),
        0.373_176_33 * z * (5.0 * zz - 3.0),
        0.457_045_8 * x * (5.0 * zz - 1.0),
        1.445_305_7 * z * (xx - yy),
        0.590_043_6 * x * (xx - 3.0 * yy),
    ]
}

/// What a direction of an order's first basis function is: AO is the 0th coefficient over it.
pub const CONSTANT: f32 = 0.282_094_8;

/// `count` directions spread evenly over the sphere: a spiral by the golden ratio, each standing
/// for the same solid angle, and every stretch of it for a band of the sphere.
pub fn sphere(count: usize) -> impl Iterator<Item = Vec3> {
    let golden = std::f64::consts::TAU * (1.0 - 1.0 / ((1.0 + 5f64.sqrt()) / 2.0));
    (0..count).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
        let across = (1.0 - z * z).sqrt();
        let (sin, cos) = (golden * i as f64).sin_cos();
        glam::DVec3::new(across * cos, across * sin, z).as_vec3()
    })
}

/// Light of an environment (its radiance from each unit direction) as coefficients.
pub fn project(light: impl Fn(Vec3) -> f32) -> [f32; MAX_COEFFICIENTS] {
    // Fine enough for lobes a degree wide.
    const DIRECTIONS: usize = 1 << 14;
    let mut sums = [0f64; MAX_COEFFICIENTS];
    for direction in sphere(DIRECTIONS) {
        let radiance = f64::from(light(direction));
        for (sum, basis) in sums.iter_mut().zip(basis(direction)) {
            *sum += radiance * f64::from(basis);
        }
    }
    sums.map(|sum| (sum * 4.0 * std::f64::consts::PI / DIRECTIONS as f64) as f32)
}

/// What a surface that reflects everything evenly sends back: light against its transfer vector.
pub fn relight(light: &[f32], transfer: &[f32]) -> f32 {
    light.iter().zip(transfer).map(|(l, t)| l * t).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn basis_functions_are_orthonormal() {
        let count = 1 << 14;
        let mut products = [[0f64; MAX_COEFFICIENTS]; MAX_COEFFICIENTS];
        for direction in sphere(count) {
            let values = basis(direction);
            for (row, a) in products.iter_mut().zip(values) {
                for (sum, b) in row.iter_mut().zip(values) {
                    *sum += f64::from(a * b) * 4.0 * std::f64::consts::PI / count as f64;
                }
            }
        }
        for (i, row) in products.iter().enumerate() {
            for (j, product) in row.iter().enumerate() {
                let expected = f64::from(u8::from(i == j));
                assert!((product - expected).abs() < 1e-3, "{i} by {j}: {product}");
            }
        }
    }
}
