//! Pictures for people: grey images and error maps, side by side, as PNG.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use font8x8::UnicodeFonts;

/// Masked pixels (sky): a colour that no grey image and no error map holds.
const MASKED: [u8; 3] = [176, 196, 222];
/// Around panels, behind titles.
const PAPER: [u8; 3] = [24, 24, 28];
const INK: [u8; 3] = [240, 240, 240];
/// Pixels between panels, and around text.
const GAP: usize = 8;
/// Edge of a glyph before scaling, pixels.
const GLYPH: usize = 8;
/// Rows below an error map: the ramp and its labels.
const LEGEND: usize = GAP + 12 + GAP / 2 + GLYPH * 2 + GAP;

/// An RGB image, sRGB, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Picture {
    fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            rgb: PAPER.repeat(width * height),
        }
    }

    /// Pixels across.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Pixels down.
    pub fn height(&self) -> usize {
        self.height
    }

    /// A grey image: 0 is black, 1 white, with no curve between (as an engine would show an
    /// occlusion buffer); pixels that are not `valid` are pale blue.
    ///
    /// # Panics
    /// If `grey` or `valid` is not `width * height` long, or that is 0.
    pub fn grey(grey: &[f32], valid: &[bool], width: usize, height: usize) -> Self {
        Self::per_pixel(grey, valid, width, height, |v| [byte(v); 3])
    }

    /// A colour image of bytes, red, green and blue in turn.
    ///
    /// # Panics
    /// If `rgb` is not `width * height * 3` long.
    pub fn rgb(rgb: Vec<u8>, width: usize, height: usize) -> Self {
        assert_eq!(
            rgb.len(),
            width * height * 3,
            "bytes of {width} x {height} pixels"
        );
        Self { width, height, rgb }
    }

    /// A map of errors: their size from black (0) over magenta to pale yellow (`max` and more),
    /// with the ramp and its ends drawn below, so that it is a little higher than `height`.
    /// Pixels that are not `valid` are pale blue. Give maps that are to be compared the same
    /// `max`.
    ///
    /// # Panics
    /// If `error` or `valid` is not `width * height` long, or that is 0.
    pub fn heat(error: &[f32], valid: &[bool], width: usize, height: usize, max: f32) -> Self {
        let map = Self::per_pixel(error, valid, width, height, |v| {
            magma(v.abs() / max.max(f32::MIN_POSITIVE))
        });
        let mut out = Self::new(width, height + LEGEND);
        out.paste(&map, 0, 0);
        for x in 0..width {
            let color = magma(x as f32 / (width - 1).max(1) as f32);
            for y in height + GAP..height + GAP + 12 {
                out.set(x, y, color);
            }
        }
        let y = height + LEGEND - GAP - GLYPH * 2;
        let max = format!("{}", (max * 1e4).round() / 1e4);
        let scale = fitting_scale("0  ", width).min(fitting_scale(&max, width * 2 / 3));
        out.text(0, y, scale, "0");
        out.text(
            width.saturating_sub(text_width(&max, scale)),
            y,
            scale,
            &max,
        );
        out
    }

    fn per_pixel(
        values: &[f32],
        valid: &[bool],
        width: usize,
        height: usize,
        color: impl Fn(f32) -> [u8; 3],
    ) -> Self {
        assert!(
            width.checked_mul(height) == Some(values.len())
                && values.len() == valid.len()
                && !values.is_empty(),
            "{} values and {} mask entries are not {width} x {height}",
            values.len(),
            valid.len(),
        );
        let colors = values.iter().zip(valid);
        let colors = colors.map(|(&v, &valid)| if valid { color(v) } else { MASKED });
        Self {
            width,
            height,
            rgb: colors.flatten().collect(),
        }
    }

    /// Panels in a row, each under its title. A title too long for its panel is written smaller,
    /// and cut where that is not enough.
    pub fn side_by_side(panels: &[(&str, &Picture)]) -> Self {
        let title = GLYPH * 2 + 2 * GAP;
        let width = panels.iter().map(|(_, p)| p.width + GAP).sum::<usize>() + GAP;
        let height = panels.iter().map(|(_, p)| p.height).max().unwrap_or(0) + title + GAP;
        let mut out = Self::new(width, height);
        let mut left = GAP;
        for (text, picture) in panels {
            let scale = fitting_scale(text, picture.width);
            let fits: String = text.chars().take(picture.width / (GLYPH * scale)).collect();
            out.text(left, GAP + (2 - scale) * GLYPH / 2, scale, &fits);
            out.paste(picture, left, title);
            left += picture.width + GAP;
        }
        out
    }

    /// The picture as a PNG file's bytes.
    pub fn png(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let size = |n: usize| u32::try_from(n).expect("a picture's edge is below 2^32 pixels");
        let mut encoder = png::Encoder::new(&mut bytes, size(self.width), size(self.height));
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let written = encoder.write_header().and_then(|mut writer| {
            writer.write_image_data(&self.rgb)?;
            writer.finish()
        });
        written.expect("a Vec takes every byte, and the data is as long as the header says");
        bytes
    }

    /// Writes a PNG file; one that is there already stays whole until the new one is.
    ///
    /// # Errors
    /// As [`write_whole`].
    pub fn write_png(&self, path: &Path) -> io::Result<()> {
        write_whole(path, &self.png())
    }

    fn set(&mut self, x: usize, y: usize, color: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = (y * self.width + x) * 3;
            self.rgb[at..at + 3].copy_from_slice(&color);
        }
    }

    /// `other` must fit.
    fn paste(&mut self, other: &Picture, left: usize, top: usize) {
        for y in 0..other.height {
            let to = ((top + y) * self.width + left) * 3;
            let row = &other.rgb[y * other.width * 3..][..other.width * 3];
            self.rgb[to..to + row.len()].copy_from_slice(row);
        }
    }

    fn text(&mut self, left: usize, top: usize, scale: usize, text: &str) {
        for (i, c) in text.chars().enumerate() {
            let glyph = font8x8::BASIC_FONTS
                .get(c)
                .or_else(|| font8x8::LATIN_FONTS.get(c))
                .or_else(|| font8x8::BASIC_FONTS.get('?'))
                .unwrap_or_default();
            for y in 0..GLYPH * scale {
                for x in 0..GLYPH * scale {
                    if glyph[y / scale] >> (x / scale) & 1 == 1 {
                        self.set(left + i * GLYPH * scale + x, top + y, INK);
                    }
                }
            }
        }
    }
}

/// Writes a file under a temporary name beside it, then renames: a reader sees the old file or
/// the new one, never a part. Missing folders are made.
///
/// # Errors
/// The system's, with the path in its message.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let named = |e: io::Error| io::Error::new(e.kind(), format!("{}: {e}", path.display()));
    let name = path
        .file_name()
        .ok_or_else(|| named(io::ErrorKind::InvalidFilename.into()))?;
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new(".")).to_path_buf();
    std::fs::create_dir_all(&folder).map_err(named)?;
    let mut temporary = name.to_os_string();
    temporary.push(format!(".{}.tmp", std::process::id()));
    let temporary: PathBuf = folder.join(temporary);
    let write = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        std::fs::rename(&temporary, path)
    };
    write().map_err(|e| {
        // What is left of it is of no use; the first error is the one that matters.
        let _ = std::fs::remove_file(&temporary);
        named(e)
    })
}

fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn text_width(text: &str, scale: usize) -> usize {
    text.chars().count() * GLYPH * scale
}

/// Text is drawn twice as large where there is room.
fn fitting_scale(text: &str, width: usize) -> usize {
    if text_width(text, 2) <= width { 2 } else { 1 }
}

/// The magma colour map: lightness grows evenly with `v`, 0..1. A polynomial fitted to it.
fn magma(v: f32) -> [u8; 3] {
    const FIT: [[f32; 3]; 7] = [
        [-0.00213649, -0.000749655, -0.00538613],
        [0.251661, 0.677523, 2.49403],
        [8.35372, -3.57772, 0.314468],
        [-27.6687, 14.2647, -13.6492],
        [52.1761, -27.9436, 12.9442],
        [-50.7685, 29.0466, 4.23415],
        [18.6557, -11.4898, -5.60196],
    ];
    // NaN shows as the worst error rather than as none.
    let v = if v.is_nan() { 1.0 } else { v.clamp(0.0, 1.0) };
    std::array::from_fn(|i| byte(FIT.iter().rev().fold(0.0, |sum, c| sum * v + c[i])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode(bytes: &[u8]) -> (usize, usize, Vec<u8>) {
        let mut reader = png::Decoder::new(io::Cursor::new(bytes))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!(info.color_type, png::ColorType::Rgb);
        (info.width as usize, info.height as usize, pixels)
    }

    fn pixel(p: &Picture, x: usize, y: usize) -> [u8; 3] {
        let at = (y * p.width + x) * 3;
        p.rgb[at..at + 3].try_into().unwrap()
    }

    #[test]
    fn a_png_holds_the_greys_and_marks_the_sky() {
        let valid = [true, true, true, false, true, true];
        let picture = Picture::grey(&[0.0, 0.5, 1.0, 0.2, -3.0, 7.0], &valid, 3, 2);
        let (w, h, rgb) = decode(&picture.png());
        assert_eq!((w, h), (3, 2));
        let expected = [[0; 3], [128; 3], [255; 3], MASKED, [0; 3], [255; 3]];
        assert_eq!(rgb, expected.concat());
    }

    #[test]
    fn the_ramp_is_magma() {
        let lut = nv_flip::magma_lut().to_vec();
        for i in 0..256 {
            let ours = magma(i as f32 / 255.0);
            for c in 0..3 {
                let off = (i32::from(ours[c]) - i32::from(lut[i * 3 + c])).abs();
                assert!(
                    off <= 6,
                    "entry {i}: {ours:?} instead of {:?}",
                    &lut[i * 3..][..3]
                );
            }
        }
        assert_eq!(magma(f32::NAN), magma(1.0));
    }

    #[test]
    fn a_heat_map_shows_sizes_of_errors_and_its_scale() {
        let error = [0.0, 0.1, -0.1, 0.4];
        let heat = Picture::heat(&error.repeat(32), &[true; 128], 128, 1, 0.1);
        assert_eq!(pixel(&heat, 0, 0), magma(0.0));
        assert_eq!(pixel(&heat, 1, 0), magma(1.0));
        assert_eq!(pixel(&heat, 2, 0), magma(1.0), "the sign does not matter");
        assert_eq!(
            pixel(&heat, 3, 0),
            magma(1.0),
            "beyond the maximum it saturates"
        );
        assert_eq!(
            pixel(&heat, 127, 1 + GAP),
            magma(1.0),
            "the ramp ends with the maximum"
        );
        let label = |max| {
            let heat = Picture::heat(&error.repeat(32), &[true; 128], 128, 1, max);
            heat.rgb[(1 + GAP + 12) * 128 * 3..].to_vec()
        };
        assert_ne!(label(0.1), label(0.25), "the maximum is written");
        let equal = Picture::heat(&[0.0], &[true], 1, 1, 0.0);
        assert_eq!(
            pixel(&equal, 0, 0),
            magma(0.0),
            "equal images have no error"
        );
    }

    #[test]
    fn panels_stand_side_by_side_under_their_titles() {
        let white = Picture::grey(&[1.0; 64 * 10], &[true; 64 * 10], 64, 10);
        let black = Picture::grey(&[0.0; 20 * 30], &[true; 20 * 30], 20, 30);
        let both = Picture::side_by_side(&[("ab", &white), ("too long × to fit", &black)]);
        assert_eq!(
            (both.width, both.height),
            (64 + 20 + 3 * GAP, 30 + 16 + 3 * GAP)
        );
        let top = 16 + 2 * GAP;
        assert_eq!(pixel(&both, GAP, top), [255; 3]);
        assert_eq!(pixel(&both, GAP + 63, top + 9), [255; 3]);
        assert_eq!(
            pixel(&both, GAP + 63, top + 10),
            PAPER,
            "the shorter panel ends"
        );
        assert_eq!(pixel(&both, 64 + 2 * GAP + 19, top + 29), [0; 3]);
        let inked = |from: usize, to: usize| {
            (from..to).any(|x| (0..top).any(|y| pixel(&both, x, y) == INK))
        };
        assert!(inked(GAP, GAP + 32) && !inked(GAP + 32, 64 + 2 * GAP));
        assert!(inked(64 + 2 * GAP, 84 + 2 * GAP) && !inked(84 + 2 * GAP, both.width));
    }

    #[test]
    fn a_file_is_replaced_whole_and_nothing_is_left_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/a.png");
        let picture = Picture::grey(&[0.5], &[true], 1, 1);
        for _ in 0..2 {
            picture.write_png(&path).unwrap();
        }
        assert_eq!(std::fs::read(&path).unwrap(), picture.png());
        assert_eq!(
            std::fs::read_dir(path.parent().unwrap()).unwrap().count(),
            1
        );
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a.png")).unwrap();
        let error = write_whole(&folder.path().join("a.png"), b"x").unwrap_err();
        assert!(error.to_string().contains("a.png"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        assert!(write_whole(Path::new("/"), b"x").is_err());
    }
}
