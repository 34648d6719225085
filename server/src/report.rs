//! What a run found, as one page that a browser opens anywhere: `report.html` refers to nothing
//! outside itself. Pictures are inlined as PNG, plots as SVG that follows the page's colours.

use std::fmt::Write as _;
use std::io;
use std::ops::Range;
use std::path::Path;

use base64::Engine as _;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint};
use plotters::prelude::*;

use crate::picture::{Picture, write_whole};

/// A page. Texts may hold anything: they are escaped.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// The heading.
    pub title: String,
    /// The main figures: what, and its value with its unit.
    pub summary: Vec<(String, String)>,
    /// Rendered frames.
    pub panels: Vec<Panel>,
    /// Plots, two a row where there is room.
    pub plots: Vec<Plot>,
}

/// One rendered frame: pictures in a row (below one another on a phone).
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// Above the pictures.
    pub title: String,
    /// Below the pictures: the frame's PSNR, FLIP and the like.
    pub caption: String,
    /// Each with its own title. Pictures of one size line up.
    pub pictures: Vec<(String, Picture)>,
}

/// One plot.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Above the plot.
    pub title: String,
    /// With the unit.
    pub x_label: String,
    /// With the unit.
    pub y_label: String,
    /// Name and points. What is not finite (or, on a logarithmic axis, not above 0) is a gap.
    pub series: Vec<(String, Vec<(f64, f64)>)>,
    /// The vertical axis is logarithmic.
    pub log_y: bool,
    /// How points are drawn.
    pub form: Form,
}

/// How a plot shows its points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// Joined in the order given.
    #[default]
    Lines,
    /// A mark each: for clouds, such as error against bits.
    Marks,
}

/// Told apart also by the colour-blind in this order, and visible on white and on black.
const COLORS: [RGBColor; 8] = [
    RGBColor(31, 131, 214),
    RGBColor(224, 112, 26),
    RGBColor(27, 158, 119),
    RGBColor(199, 74, 168),
    RGBColor(184, 134, 11),
    RGBColor(107, 110, 207),
    RGBColor(209, 73, 91),
    RGBColor(74, 155, 170),
];

/// Plots are drawn at about twice the size shown, since the backend rounds to whole units.
const PLOT_SIZE: (u32, u32) = (960, 600);

const STYLE: &str = "\
:root{color-scheme:light dark;--paper:#fff;--card:#f5f6f8;--line:#d9dce1;--ink:#1b1d22;\
--quiet:#5c6370}
@media(prefers-color-scheme:dark){:root{--paper:#131418;--card:#1d1f25;--line:#343842;\
--ink:#e8eaee;--quiet:#a0a7b4}}
*{box-sizing:border-box}
body{margin:0 auto;padding:16px;max-width:1280px;background:var(--paper);color:var(--ink);\
font:16px/1.45 system-ui,sans-serif}
h1{font-size:1.5rem;margin:.4em 0 .8em}h2{font-size:1.15rem;margin:1.8em 0 .6em}
h3{font-size:1rem;margin:0 0 .5em}
h1,h2,h3,p,figcaption,td,th{overflow-wrap:anywhere}
table{border-collapse:collapse;min-width:min(100%,30em)}
th,td{text-align:left;font-weight:400;padding:.35em .8em .35em 0;\
border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--quiet)}td{font-variant-numeric:tabular-nums}
section{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px;\
margin-bottom:16px}
section p{margin:.5em 0 0}
.row,.plots{display:grid;gap:12px}
.row{grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr))}
.plots{grid-template-columns:repeat(auto-fit,minmax(min(100%,480px),1fr))}
.plots section{margin:0;min-width:0}
figure{margin:0;min-width:0}
figcaption,.legend{font-size:.9rem;color:var(--quiet)}
img,svg{display:block;width:100%;height:auto}
.legend{display:flex;flex-wrap:wrap;gap:.1em 1em;margin-bottom:.3em}
.legend i{display:inline-block;width:.8em;height:.8em;border-radius:50%;margin-right:.4em}
svg text{fill:currentColor;font-family:system-ui,sans-serif}
svg [stroke=\"#000000\"]{stroke:currentColor}
";

impl Report {
    /// Writes the page; one that is there already stays whole until the new one is.
    ///
    /// # Errors
    /// As [`write_whole`].
    pub fn write(&self, path: &Path) -> io::Result<()> {
        write_whole(path, self.html().as_bytes())
    }

    /// The page.
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let mut out = format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{STYLE}</style></head>\n<body>\n<h1>{title}</h1>\n"
        );
        if !self.summary.is_empty() {
            out += "<table>\n";
            for (what, value) in &self.summary {
                let (what, value) = (escape(what), escape(value));
                let _ = writeln!(
                    out,
                    "<tr><th scope=\"row\">{what}</th><td>{value}</td></tr>"
                );
            }
            out += "</table>\n";
        }
        if !self.panels.is_empty() {
            out += "<h2>Pictures</h2>\n";
            self.panels.iter().for_each(|p| p.write(&mut out));
        }
        if !self.plots.is_empty() {
            out += "<h2>Plots</h2>\n<div class=\"plots\">\n";
            self.plots.iter().for_each(|p| p.write(&mut out));
            out += "</div>\n";
        }
        out + "</body></html>\n"
    }
}

impl Panel {
    fn write(&self, out: &mut String) {
        let _ = writeln!(
            out,
            "<section><h3>{}</h3><div class=\"row\">",
            escape(&self.title)
        );
        for (title, picture) in &self.pictures {
            let title = escape(title);
            let png = base64::engine::general_purpose::STANDARD.encode(picture.png());
            let (width, height) = (picture.width(), picture.height());
            let _ = writeln!(
                out,
                "<figure><figcaption>{title}</figcaption><img alt=\"{title}\" width=\"{width}\" \
                 height=\"{height}\" src=\"data:image/png;base64,{png}\"></figure>"
            );
        }
        *out += "</div>";
        if !self.caption.is_empty() {
            let _ = write!(out, "<p>{}</p>", escape(&self.caption));
        }
        *out += "</section>\n";
    }
}

impl Plot {
    fn write(&self, out: &mut String) {
        let title = escape(&self.title);
        let _ = write!(out, "<section><h3>{title}</h3><div class=\"legend\">");
        for (i, (name, _)) in self.series.iter().enumerate() {
            let RGBColor(r, g, b) = COLORS[i % COLORS.len()];
            let _ = write!(
                out,
                "<span><i style=\"background:rgb({r} {g} {b})\"></i>{}</span>",
                escape(name)
            );
        }
        *out += "</div>";
        match self.svg() {
            Some(svg) => {
                let (w, h) = PLOT_SIZE;
                // The backend's own tag fixes the size and names the SVG specification's address.
                let body = svg.split_once('>').map_or("", |(_, body)| body);
                let tag =
                    format!("<svg role=\"img\" aria-label=\"{title}\" viewBox=\"0 0 {w} {h}\">");
                *out += &tag;
                *out += body;
            }
            None => *out += "<p>no data</p>",
        }
        *out += "</section>\n";
    }

    /// `None` without a single finite point.
    pub(crate) fn svg(&self) -> Option<String> {
        let y_of = |y: f64| if self.log_y { y.log10() } else { y };
        let series: Vec<Vec<(f64, f64)>> = self
            .series
            .iter()
            .map(|(_, points)| points.iter().map(|&(x, y)| (x, y_of(y))).collect())
            .collect();
        let finite = |&&(x, y): &&(f64, f64)| x.is_finite() && y.is_finite();
        let drawn: Vec<(f64, f64)> = series.iter().flatten().filter(finite).copied().collect();
        let x = range(drawn.iter().map(|p| p.0), self.form == Form::Marks)?;
        let mut y = range(drawn.iter().map(|p| p.1), true)?;
        // Amounts start at 0, unless they vary too little to be told apart then.
        let lowest = drawn.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
        if !self.log_y && lowest >= 0.0 && lowest < 0.5 * y.end {
            y.start = 0.0;
        }
        let y = Axis {
            ticks: if self.log_y { log_ticks(&y) } else { ticks(&y) },
            range: y,
        };
        let x = Axis {
            ticks: ticks(&x),
            range: x,
        };
        let label = |v: &f64| tick_label(if self.log_y { 10f64.powf(*v) } else { *v });

        let mut svg = String::new();
        let root = SVGBackend::with_string(&mut svg, PLOT_SIZE).into_drawing_area();
        let draw = || -> Result<(), DrawingAreaErrorKind<io::Error>> {
            let mut chart = ChartBuilder::on(&root)
                .margin(14)
                .margin_right(30)
                .x_label_area_size(100)
                .y_label_area_size(150)
                .build_cartesian_2d(x, y)?;
            chart
                .configure_mesh()
                .bold_line_style(BLACK.mix(0.15))
                .light_line_style(TRANSPARENT)
                .axis_style(BLACK.stroke_width(2))
                .label_style(("sans-serif", 34))
                .axis_desc_style(("sans-serif", 34))
                .x_desc(&self.x_label)
                .y_desc(&self.y_label)
                .x_label_formatter(&|v| tick_label(*v))
                .y_label_formatter(&label)
                .draw()?;
            for (i, points) in series.iter().enumerate() {
                let color = COLORS[i % COLORS.len()];
                let gap = |&(x, y): &(f64, f64)| !x.is_finite() || !y.is_finite();
                for run in points.split(gap).filter(|run| !run.is_empty()) {
                    if self.form == Form::Lines {
                        let style = color.stroke_width(4);
                        chart.draw_series(LineSeries::new(run.iter().copied(), style))?;
                    }
                    // A few joined points are marked too: they are not a curve.
                    if self.form == Form::Marks || run.len() <= 32 {
                        let marks = run.iter().map(|&p| Circle::new(p, 7, color.filled()));
                        chart.draw_series(marks)?;
                    }
                }
            }
            root.present()
        };
        draw().expect("a String takes every byte");
        drop(root);
        Some(svg)
    }
}

/// A linear axis with marks where we want them.
#[derive(Clone)]
struct Axis {
    range: Range<f64>,
    ticks: Vec<f64>,
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (low, high): (i32, i32)) -> i32 {
        let along = (value - self.range.start) / (self.range.end - self.range.start);
        low + (along * f64::from(high - low)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() {
            Vec::new()
        } else {
            self.ticks.clone()
        }
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

/// From the least to the greatest, widened where they are equal, and by a little if `padded`.
fn range(values: impl Iterator<Item = f64>, padded: bool) -> Option<Range<f64>> {
    let (lo, hi) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| {
        (lo.min(v), hi.max(v))
    });
    // Far apart ends would overflow their difference: nothing this is for comes near.
    if lo > hi || !(hi - lo).is_finite() {
        return None;
    }
    let least = lo.abs().max(hi.abs()) * 1e-9;
    let pad = if hi - lo <= least {
        if lo == 0.0 { 1.0 } else { lo.abs() * 0.1 }
    } else if padded {
        (hi - lo) * 0.05
    } else {
        0.0
    };
    Some(lo - pad..hi + pad)
}

/// Four to nine round numbers (1, 2 or 5 times a power of ten apart) within a range.
fn ticks(range: &Range<f64>) -> Vec<f64> {
    let rough = (range.end - range.start) / 8.0;
    let decade = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .map(|m| m * decade)
        .into_iter()
        .find(|s| *s >= rough);
    let step = step.unwrap_or(10.0 * decade);
    let first = (range.start / step - 1e-9).ceil();
    (0..)
        .map(|i| (first + f64::from(i)) * step)
        .take_while(|v| *v <= range.end + step * 1e-9)
        .collect()
}

/// Round numbers within a range of base-10 logarithms, as logarithms.
fn log_ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.end - range.start;
    if decades < 0.7 {
        // Too narrow for powers: evenly spaced values serve better.
        let values = 10f64.powf(range.start)..10f64.powf(range.end);
        return ticks(&values)
            .into_iter()
            .filter(|v| *v > 0.0)
            .map(f64::log10)
            .collect();
    }
    let digits: &[f64] = if decades < 3.0 {
        &[1.0, 2.0, 5.0]
    } else {
        &[1.0]
    };
    let every = (decades / 8.0).ceil().max(1.0) as i64;
    let (first, last) = (range.start.floor() as i64, range.end.ceil() as i64);
    (first..=last)
        .filter(|e| e % every == 0)
        .flat_map(|e| digits.iter().map(move |d| e as f64 + d.log10()))
        .filter(|v| range.contains(v))
        .collect()
}

/// At most four digits, with a letter for thousands and up.
fn tick_label(v: f64) -> String {
    let size = v.abs();
    let (scaled, unit) = match size {
        _ if size >= 1e9 => (v / 1e9, "G"),
        _ if size >= 1e6 => (v / 1e6, "M"),
        _ if size >= 1e4 => (v / 1e3, "k"),
        _ => (v, ""),
    };
    if size > 0.0 && size < 1e-3 {
        return format!("{v:.0e}");
    }
    let text = format!("{scaled:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    format!("{}{unit}", if text == "-0" { "0" } else { text })
}

fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<(f64, f64)>, log_y: bool, form: Form) -> String {
        let series = vec![("a".to_string(), points)];
        let mut html = String::new();
        Plot {
            series,
            log_y,
            form,
            ..Plot::default()
        }
        .write(&mut html);
        html
    }

    #[test]
    fn texts_cannot_become_markup() {
        let evil = || "<script>\"x\" & 'y'".to_string();
        let picture = Picture::grey(&[0.5], &[true], 1, 1);
        let report = Report {
            title: evil(),
            summary: vec![(evil(), evil())],
            panels: vec![Panel {
                title: evil(),
                caption: evil(),
                pictures: vec![(evil(), picture)],
            }],
            plots: vec![Plot {
                title: evil(),
                x_label: evil(),
                y_label: evil(),
                series: vec![(evil(), vec![(0.0, 1.0), (1.0, 2.0)])],
                ..Plot::default()
            }],
        };
        let html = report.html();
        assert!(!html.contains("<script"));
        assert!(!html.contains("\"x\""));
        // Title twice, summary twice, panel title and caption, picture title and alternative
        // text, plot title and its label for screen readers, legend, two axes.
        assert_eq!(html.matches("&lt;script&gt;").count(), 13);
    }

    #[test]
    fn data_that_cannot_be_drawn_leaves_gaps_not_garbage() {
        let nan = f64::NAN;
        for log_y in [false, true] {
            for form in [Form::Lines, Form::Marks] {
                for nothing in [
                    vec![],
                    vec![(0.0, nan)],
                    vec![(nan, 1.0), (1.0, f64::INFINITY)],
                ] {
                    assert!(plot(nothing, log_y, form).contains("no data"));
                }
                for some in [
                    vec![(3.0, 5.0)],
                    vec![(0.0, 5.0), (1.0, 5.0)],
                    vec![
                        (0.0, 1.0),
                        (1.0, nan),
                        (2.0, f64::INFINITY),
                        (3.0, 4.0),
                        (4.0, 9.0),
                    ],
                    vec![(1e-300, 1e-300), (1e300, 1e300)],
                ] {
                    let html = plot(some, log_y, form);
                    assert!(html.contains("<svg"), "{html}");
                    assert!(!html.contains("NaN") && !html.contains("inf"), "{html}");
                }
            }
        }
        let gap = vec![(0.0, 1.0), (1.0, 2.0), (2.0, nan), (3.0, 4.0), (4.0, 9.0)];
        let lines = |html: &str| html.matches("stroke-width=\"4\"").count();
        assert_eq!(
            lines(&plot(gap, false, Form::Lines)),
            2,
            "the line is cut at the gap"
        );
        assert!(plot(vec![(0.0, 0.0), (1.0, -1.0)], true, Form::Lines).contains("no data"));
    }

    #[test]
    fn ticks_are_few_round_and_within() {
        for (start, end) in [
            (0.0, 1.0),
            (0.0, 600.0),
            (27.3, 31.8),
            (-4.0, 3e6),
            (1e-7, 3e-7),
        ] {
            let t = ticks(&(start..end));
            assert!((4..=9).contains(&t.len()), "{start}..{end}: {t:?}");
            assert!(
                t.iter()
                    .all(|v| *v >= start - 1e-12 && *v <= end * (1.0 + 1e-9)),
                "{t:?}"
            );
        }
        assert_eq!(ticks(&(0.0..10.0)), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        let powers = |range| -> Vec<f64> {
            log_ticks(&range)
                .iter()
                .map(|v| 10f64.powf(*v).round())
                .collect()
        };
        assert_eq!(powers(0.0..2.0), [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]);
        assert_eq!(powers(-0.1..4.1), [1.0, 10.0, 100.0, 1000.0, 10000.0]);
        for (start, end) in [(1.0, 1.2), (0.0, 0.71), (-3.0, 9.0), (-300.0, 300.0)] {
            let t = log_ticks(&(start..end));
            assert!((2..=10).contains(&t.len()), "{start}..{end}: {t:?}");
        }
    }

    #[test]
    fn tick_labels_are_short() {
        for (v, text) in [
            (0.0, "0"),
            (-0.0, "0"),
            (0.25, "0.25"),
            (12.5, "12.5"),
            (5000.0, "5000"),
            (20_000.0, "20k"),
            (1_500_000.0, "1.5M"),
            (-3e9, "-3G"),
            (0.000_2, "2e-4"),
            (0.30000000000000004, "0.3"),
        ] {
            assert_eq!(tick_label(v), text);
        }
    }
}
