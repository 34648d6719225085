//! How far one grey image is from another.
//!
//! FLIP and SSIM are written out here, for grey alone, because the build needs no more than a C
//! compiler and NVIDIA's FLIP is C++; a test holds ours to theirs.

use rayon::prelude::*;

/// What both images show where there is nothing to compare: white, as an unoccluded surface.
const MASKED: f32 = 1.0;

/// A reference image and a test image of the same size, with the pixels that count.
#[derive(Clone, Debug)]
pub struct Pair {
    width: usize,
    height: usize,
    reference: Vec<f32>,
    test: Vec<f32>,
    valid: Vec<bool>,
    valid_count: usize,
}

impl Pair {
    /// Pairs two grey images, 0 (black) to 1 (white), row by row from the top; values outside are
    /// clamped. Only pixels that are `valid` count; the rest (sky) may hold anything.
    ///
    /// # Errors
    /// Names the first thing wrong: an image or mask that is not `width * height` long, no valid
    /// pixel, a valid pixel that is NaN.
    pub fn new(
        reference: &[f32],
        test: &[f32],
        valid: &[bool],
        width: usize,
        height: usize,
    ) -> Result<Self, String> {
        let pixels = width.checked_mul(height);
        for (what, len) in [
            ("reference", reference.len()),
            ("test image", test.len()),
            ("mask", valid.len()),
        ] {
            if pixels != Some(len) {
                return Err(format!(
                    "the {what} has {len} pixels, not {width} x {height}: render both at one size"
                ));
            }
        }
        let valid_count = valid.iter().filter(|&&v| v).count();
        if valid_count == 0 {
            return Err("no pixel shows the scene: point the camera at it".into());
        }
        let masked = |what: &str, image: &[f32]| -> Result<Vec<f32>, String> {
            let mut out = Vec::with_capacity(image.len());
            for (i, (&value, &valid)) in image.iter().zip(valid).enumerate() {
                if valid && value.is_nan() {
                    let (x, y) = (i % width, i / width);
                    return Err(format!("pixel ({x}, {y}) of the {what} is NaN"));
                }
                out.push(if valid { value.clamp(0.0, 1.0) } else { MASKED });
            }
            Ok(out)
        };
        Ok(Self {
            width,
            height,
            reference: masked("reference", reference)?,
            test: masked("test image", test)?,
            valid: valid.to_vec(),
            valid_count,
        })
    }

    /// Root of the mean squared difference over valid pixels, 0..=1.
    pub fn rmse(&self) -> f64 {
        let squares = self.reference.iter().zip(&self.test).map(|(&a, &b)| {
            let d = f64::from(a) - f64::from(b);
            d * d
        });
        // Masked pixels are equal in both images and add nothing.
        (squares.sum::<f64>() / self.valid_count as f64).sqrt()
    }

    /// Peak signal-to-noise ratio in dB over valid pixels, for a peak of 1. Infinite when the
    /// images are equal.
    pub fn psnr_db(&self) -> f64 {
        -20.0 * self.rmse().log10()
    }

    /// Mean FLIP over valid pixels, 0 (no visible difference) to 1: see [`Self::flip_map`].
    pub fn flip(&self) -> f64 {
        self.mean_of_valid(&self.flip_map())
    }

    /// LDR-FLIP of every pixel, 0..=1: the difference a person sees who alternates the two images
    /// at 67 pixels per degree (a monitor of 0.7 m and 3840 pixels, seen from 0.7 m). Andersson et
    /// al., "FLIP: A Difference Evaluator for Alternating Images", 2020. The grey values are taken
    /// as sRGB, replicated to three channels; masked pixels are white in both images.
    ///
    /// In grey the opponent colours are 0 before and after filtering, so that of the colour
    /// pipeline only the lightness is left, and XYZ is the linear value.
    pub fn flip_map(&self) -> Vec<f32> {
        const PIXELS_PER_DEGREE: f32 = 67.0;
        // Colour: exponent, where the remapping has its knee, and what it maps the knee to.
        const QC: f32 = 0.7;
        const PC: f32 = 0.4;
        const PT: f32 = 0.95;
        // The largest colour difference (Hunt-adjusted green to blue), to the power QC.
        const COLOR_MAX: f32 = 41.276_1;
        // The standard deviation of the feature filters in pixels (0.082 degrees wide).
        const FEATURE_SIGMA: f32 = 0.5 * 0.082 * PIXELS_PER_DEGREE;
        let (w, h) = (self.width, self.height);

        // The achromatic contrast sensitivity, exp(-π² x² / 0.0047) for x in degrees.
        let csf_sigma = (0.0047f32 / 2.0).sqrt() / std::f32::consts::PI * PIXELS_PER_DEGREE;
        let csf = gaussian(csf_sigma, (6.0 * csf_sigma).ceil() as usize);
        let smooth = gaussian(FEATURE_SIGMA, (3.0 * FEATURE_SIGMA).ceil() as usize);
        let (edge, point) = derivatives(&smooth, FEATURE_SIGMA);

        let features = |image: &[f32]| -> (Vec<f32>, Vec<f32>) {
            let smooth_x = along_x(image, w, &smooth);
            let edge_x = along_y(&along_x(image, w, &edge), w, h, &smooth);
            let edge_y = along_y(&smooth_x, w, h, &edge);
            let point_x = along_y(&along_x(image, w, &point), w, h, &smooth);
            let point_y = along_y(&smooth_x, w, h, &point);
            let length = |a: Vec<f32>, b: Vec<f32>| {
                a.iter()
                    .zip(&b)
                    .map(|(&a, &b)| (a * a + b * b).sqrt())
                    .collect()
            };
            (length(edge_x, edge_y), length(point_x, point_y))
        };
        let seen = |image: &[f32]| {
            let linear: Vec<f32> = image.par_iter().map(|&v| linear_from_srgb(v)).collect();
            let mut lightness = along_y(&along_x(&linear, w, &csf), w, h, &csf);
            lightness
                .par_iter_mut()
                .for_each(|v| *v = lightness_from_linear(*v));
            let (edges, points) = features(&linear);
            (lightness, edges, points)
        };
        let (lightness_r, edges_r, points_r) = seen(&self.reference);
        let (lightness_t, edges_t, points_t) = seen(&self.test);

        (0..w * h)
            .into_par_iter()
            .map(|i| {
                let color = (lightness_r[i] - lightness_t[i]).abs().powf(QC);
                let knee = PC * COLOR_MAX;
                let color = if color < knee {
                    color * PT / knee
                } else {
                    PT + (color - knee) / (COLOR_MAX - knee) * (1.0 - PT)
                };
                let edge = (edges_r[i] - edges_t[i]).abs();
                let point = (points_r[i] - points_t[i]).abs();
                let feature = (edge.max(point) * std::f32::consts::FRAC_1_SQRT_2).sqrt();
                color.powf(1.0 - feature)
            })
            .collect()
    }

    /// Mean structural similarity over valid pixels, up to 1 (equal): Wang et al. 2004, Gaussian
    /// window of 11 x 11 with a standard deviation of 1.5, K1 = 0.01, K2 = 0.03. Windows that
    /// cross the border see its pixels repeated, so that every valid pixel counts.
    pub fn ssim(&self) -> f64 {
        const C1: f32 = 0.01 * 0.01;
        const C2: f32 = 0.03 * 0.03;
        let window = gaussian(1.5, 5);
        let blur = |f: &(dyn Fn(f32, f32) -> f32 + Sync)| {
            let image: Vec<f32> = self
                .reference
                .iter()
                .zip(&self.test)
                .map(|(&a, &b)| f(a, b))
                .collect();
            along_y(
                &along_x(&image, self.width, &window),
                self.width,
                self.height,
                &window,
            )
        };
        let [mean_a, mean_b] = [blur(&|a, _| a), blur(&|_, b| b)];
        let [aa, bb, ab] = [
            blur(&|a, _| a * a),
            blur(&|_, b| b * b),
            blur(&|a, b| a * b),
        ];
        let map: Vec<f32> = (0..aa.len())
            .map(|i| {
                let (ma, mb) = (mean_a[i], mean_b[i]);
                let (var_a, var_b) = (aa[i] - ma * ma, bb[i] - mb * mb);
                let cov = ab[i] - ma * mb;
                let luminance = (2.0 * ma * mb + C1) / (ma * ma + mb * mb + C1);
                luminance * (2.0 * cov + C2) / (var_a + var_b + C2)
            })
            .collect();
        self.mean_of_valid(&map)
    }

    fn mean_of_valid(&self, map: &[f32]) -> f64 {
        let valid = map.iter().zip(&self.valid).filter(|(_, v)| **v);
        valid.map(|(&x, _)| f64::from(x)).sum::<f64>() / self.valid_count as f64
    }
}

fn linear_from_srgb(v: f32) -> f32 {
    if v <= 0.04045 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    }
}

/// CIE L* of a linear grey.
fn lightness_from_linear(v: f32) -> f32 {
    const DELTA: f32 = 6.0 / 29.0;
    let v = v.clamp(0.0, 1.0);
    let f = if v > DELTA * DELTA * DELTA {
        v.cbrt()
    } else {
        v / (3.0 * DELTA * DELTA) + 4.0 / 29.0
    };
    116.0 * f - 16.0
}

/// `2 * radius + 1` weights that sum to 1.
fn gaussian(sigma: f32, radius: usize) -> Vec<f32> {
    let weight = |i| {
        let x = i as f32 - radius as f32;
        (-x * x / (2.0 * sigma * sigma)).exp()
    };
    let weights: Vec<f32> = (0..=2 * radius).map(weight).collect();
    let sum: f32 = weights.iter().sum();
    weights.iter().map(|w| w / sum).collect()
}

/// First and second derivative of a Gaussian, each scaled so that its positive weights sum to 1
/// and its negative ones to -1.
fn derivatives(gaussian: &[f32], sigma: f32) -> (Vec<f32>, Vec<f32>) {
    let x = |i: usize| i as f32 - (gaussian.len() / 2) as f32;
    let normal = |weights: Vec<f32>| -> Vec<f32> {
        let up: f32 = weights.iter().filter(|w| **w > 0.0).sum();
        let down: f32 = -weights.iter().filter(|w| **w < 0.0).sum::<f32>();
        weights
            .iter()
            .map(|&w| if w > 0.0 { w / up } else { w / down })
            .collect()
    };
    let first = gaussian
        .iter()
        .enumerate()
        .map(|(i, g)| -x(i) * g)
        .collect();
    let second = gaussian
        .iter()
        .enumerate()
        .map(|(i, g)| (x(i) * x(i) / (sigma * sigma) - 1.0) * g)
        .collect();
    (normal(first), normal(second))
}

/// Correlates each row with the (odd number of) weights; the border repeats.
fn along_x(image: &[f32], width: usize, weights: &[f32]) -> Vec<f32> {
    let radius = weights.len() / 2;
    let mut out = vec![0.0; image.len()];
    out.par_chunks_mut(width)
        .zip(image.par_chunks(width))
        .for_each_init(
            || vec![0.0; width + 2 * radius],
            |padded, (out, row)| {
                padded[..radius].fill(row[0]);
                padded[radius..radius + width].copy_from_slice(row);
                padded[radius + width..].fill(row[width - 1]);
                for (i, &weight) in weights.iter().enumerate() {
                    add_scaled(out, &padded[i..i + width], weight);
                }
            },
        );
    out
}

/// Correlates each column with the (odd number of) weights; the border repeats.
fn along_y(image: &[f32], width: usize, height: usize, weights: &[f32]) -> Vec<f32> {
    let radius = weights.len() / 2;
    let mut out = vec![0.0; image.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (i, &weight) in weights.iter().enumerate() {
            let row = (y + i).saturating_sub(radius).min(height - 1);
            add_scaled(out, &image[row * width..][..width], weight);
        }
    });
    out
}

fn add_scaled(out: &mut [f32], row: &[f32], weight: f32) {
    for (o, r) in out.iter_mut().zip(row) {
        *o += weight * r;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 131;
    const H: usize = 70;

    /// Deterministic noise, 0..1.
    fn noise(i: usize) -> f32 {
        let h = (i as u32).wrapping_mul(2_654_435_761);
        let h = (h ^ (h >> 15)).wrapping_mul(2_246_822_519);
        ((h ^ (h >> 13)) >> 8) as f32 / (1 << 24) as f32
    }

    /// An image of whole 255ths, as nv-flip takes bytes.
    fn image(f: impl Fn(f32, f32, usize) -> f32) -> Vec<f32> {
        (0..W * H)
            .map(|i| f((i % W) as f32, (i / W) as f32, i))
            .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0)
            .collect()
    }

    fn pairs() -> Vec<(&'static str, Vec<f32>, Vec<f32>)> {
        let soft = |x: f32, y: f32| 0.6 + 0.3 * (x * 0.11).sin() * (y * 0.07).cos();
        let disk = |x: f32, y: f32| {
            if (x - 60.0).hypot(y - 30.0) < 20.0 {
                0.2
            } else {
                0.9
            }
        };
        vec![
            (
                "equal",
                image(|x, y, _| soft(x, y)),
                image(|x, y, _| soft(x, y)),
            ),
            (
                "black and white",
                image(|_, _, _| 0.0),
                image(|_, _, _| 1.0),
            ),
            (
                "offset",
                image(|x, y, _| soft(x, y)),
                image(|x, y, _| soft(x, y) + 0.05),
            ),
            (
                "noise",
                image(|x, y, _| soft(x, y)),
                image(|x, y, i| soft(x, y) + 0.2 * (noise(i) - 0.5)),
            ),
            (
                "shifted edge",
                image(|x, y, _| disk(x, y)),
                image(|x, y, _| disk(x + 2.0, y)),
            ),
            (
                "dark stripes",
                image(|x, _, _| 0.02 * (x * 0.5).sin().max(0.0)),
                image(|_, y, _| 0.03 * (y * 0.4).sin().max(0.0)),
            ),
            (
                "pure noise",
                image(|_, _, i| noise(i)),
                image(|_, _, i| noise(i + 99_991)),
            ),
        ]
    }

    fn pair(a: &[f32], b: &[f32]) -> Pair {
        Pair::new(a, b, &vec![true; a.len()], W, H).unwrap()
    }

    #[test]
    fn flip_agrees_with_nvidias() {
        for (name, reference, test) in pairs() {
            let rgb = |image: &[f32]| {
                let bytes: Vec<u8> = image
                    .iter()
                    .flat_map(|&v| [(v * 255.0).round() as u8; 3])
                    .collect();
                nv_flip::FlipImageRgb8::with_data(W as u32, H as u32, &bytes)
            };
            let theirs = nv_flip::flip(rgb(&reference), rgb(&test), 67.020_64).to_vec();
            let pair = pair(&reference, &test);
            let ours = pair.flip_map();
            let worst = ours
                .iter()
                .zip(&theirs)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0f32, f32::max);
            assert!(worst < 1e-2, "{name}: a pixel is {worst} off");
            let mean = theirs.iter().map(|&v| f64::from(v)).sum::<f64>() / theirs.len() as f64;
            let off = (pair.flip() - mean).abs();
            assert!(off < 1e-3, "{name}: {} instead of {mean}", pair.flip());
        }
    }

    /// Straight from the definition: every window on its own, in f64.
    fn slow_ssim(a: &[f32], b: &[f32]) -> f64 {
        let at = |image: &[f32], x: i32, y: i32| {
            let (x, y) = (x.clamp(0, W as i32 - 1), y.clamp(0, H as i32 - 1));
            f64::from(image[y as usize * W + x as usize])
        };
        let mut sum = 0.0;
        for y in 0..H as i32 {
            for x in 0..W as i32 {
                let window = || {
                    (-5..=5)
                        .flat_map(|dy| (-5..=5).map(move |dx| (dx, dy)))
                        .map(|(dx, dy)| {
                            let weight = (-f64::from(dx * dx + dy * dy) / 4.5).exp();
                            (weight, at(a, x + dx, y + dy), at(b, x + dx, y + dy))
                        })
                };
                let total: f64 = window().map(|(w, _, _)| w).sum();
                let mean_a = window().map(|(w, a, _)| w * a).sum::<f64>() / total;
                let mean_b = window().map(|(w, _, b)| w * b).sum::<f64>() / total;
                let moment = |f: &dyn Fn(f64, f64) -> f64| {
                    window()
                        .map(|(w, a, b)| w * f(a - mean_a, b - mean_b))
                        .sum::<f64>()
                        / total
                };
                let (c1, c2) = (1e-4, 9e-4);
                sum += (2.0 * mean_a * mean_b + c1) * (2.0 * moment(&|a, b| a * b) + c2)
                    / (mean_a.powi(2) + mean_b.powi(2) + c1)
                    / (moment(&|a, _| a * a) + moment(&|_, b| b * b) + c2);
            }
        }
        sum / (W * H) as f64
    }

    #[test]
    fn ssim_agrees_with_the_definition() {
        for (name, a, b) in pairs() {
            let (fast, slow) = (pair(&a, &b).ssim(), slow_ssim(&a, &b));
            assert!(
                (fast - slow).abs() < 1e-3,
                "{name}: {fast} instead of {slow}"
            );
        }
    }

    #[test]
    fn psnr_and_rmse_of_a_known_difference() {
        let a = vec![0.5; W * H];
        let b = vec![0.6; W * H];
        assert!((pair(&a, &b).rmse() - 0.1).abs() < 1e-6);
        assert!((pair(&a, &b).psnr_db() - 20.0).abs() < 1e-4);
        assert_eq!(pair(&a, &a).psnr_db(), f64::INFINITY);
        assert_eq!(pair(&a, &a).flip(), 0.0);
        assert!((pair(&a, &a).ssim() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn masked_pixels_do_not_count() {
        let a = image(|x, y, i| (x + y) / 300.0 + 0.1 * noise(i));
        let b = image(|x, y, _| (x + y) / 300.0);
        let valid: Vec<bool> = (0..W * H).map(|i| i % W < 80).collect();
        let hidden = |image: &[f32], other: f32| -> Vec<f32> {
            image
                .iter()
                .zip(&valid)
                .map(|(&v, &valid)| if valid { v } else { other })
                .collect()
        };
        let plain = Pair::new(&a, &b, &valid, W, H).unwrap();
        let odd = Pair::new(&hidden(&a, f32::NAN), &hidden(&b, -7.0), &valid, W, H).unwrap();
        for f in [Pair::rmse, Pair::psnr_db, Pair::flip, Pair::ssim] {
            assert_eq!(f(&plain), f(&odd));
        }
        // The mean is over the valid part alone.
        let half = Pair::new(&vec![0.5; W * H], &vec![0.6; W * H], &valid, W, H).unwrap();
        assert!((half.rmse() - 0.1).abs() < 1e-6);
    }

    #[test]
    fn images_that_cannot_be_compared_are_refused_by_name() {
        let (a, v) = (vec![0.5; 6], vec![true; 6]);
        let refused =
            |r: &[f32], t: &[f32], v: &[bool], w, h| Pair::new(r, t, v, w, h).unwrap_err();
        assert!(refused(&a, &a[..5], &v, 3, 2).contains("test image has 5 pixels"));
        assert!(refused(&a, &a, &v, 4, 2).contains("reference"));
        assert!(refused(&a, &a, &v, usize::MAX, 2).contains("reference"));
        assert!(refused(&a, &a, &v[..1], 3, 2).contains("mask"));
        assert!(refused(&a, &a, &[false; 6], 3, 2).contains("no pixel"));
        assert!(refused(&[], &[], &[], 0, 0).contains("no pixel"));
        let nan = [0.5, 0.5, 0.5, 0.5, f32::NAN, 0.5];
        assert!(refused(&a, &nan, &v, 3, 2).contains("pixel (1, 1) of the test image is NaN"));
    }
}
