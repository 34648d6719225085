//! The report, opened as a reader opens it.

use std::process::Command;

use psao_server::picture::Picture;
use psao_server::report::{Form, Panel, Plot, Report};

/// What the page says of itself once it is loaded, as attributes of its root.
const PROBE: &str = "<script>addEventListener('load', () => {
    const seen = document.documentElement.dataset;
    const all = selector => [...document.querySelectorAll(selector)];
    const size = element => element.getBoundingClientRect();
    seen.pictures = all('img').filter(i => i.complete && i.naturalWidth > 0
        && size(i).width > 200).length;
    seen.plots = all('svg').filter(s => size(s).height > 150).length;
    seen.lines = all('svg polyline').filter(l => l.getAttribute('stroke-width') == 4
        && size(l).width > 200).length;
    seen.marks = all('svg circle').filter(c => size(c).width > 2).length;
    seen.overflow = document.documentElement.scrollWidth > innerWidth;
    seen.fetched = performance.getEntriesByType('resource')
        .filter(r => !r.name.startsWith('data:')).length;
})</script>";

fn sample() -> Report {
    let (w, h) = (320, 180);
    let valid: Vec<bool> = (0..w * h).map(|i| i / w > 12 || i % w > 60).collect();
    let image = |phase: f32| -> Vec<f32> {
        let at = |i: usize| ((i % w) as f32 * 0.05 + phase, (i / w) as f32 * 0.07);
        (0..w * h)
            .map(at)
            .map(|(x, y)| 0.6 + 0.4 * x.sin() * y.cos())
            .collect()
    };
    let (reference, test) = (image(0.0), image(0.02));
    let error: Vec<f32> = reference.iter().zip(&test).map(|(a, b)| a - b).collect();
    let panel = |t: f64| Panel {
        title: format!("{t} s"),
        caption: "PSNR 29.41 dB, FLIP 0.031, SSIM 0.962".into(),
        pictures: vec![
            ("from the stream".into(), Picture::grey(&test, &valid, w, h)),
            (
                "ray traced, 512 samples".into(),
                Picture::grey(&reference, &valid, w, h),
            ),
            ("error".into(), Picture::heat(&error, &valid, w, h, 0.01)),
        ],
    };
    let time = |f: &dyn Fn(f64) -> f64| -> Vec<(f64, f64)> {
        (0..600)
            .map(|i| (f64::from(i) / 60.0, f(f64::from(i))))
            .collect()
    };
    let noise = |i: f64| (i * 12.9898).sin() * 43_758.5 % 1.0;
    let plot = |title: &str, y_label: &str, series: Vec<(&str, Vec<(f64, f64)>)>| Plot {
        title: title.into(),
        x_label: "time (s)".into(),
        y_label: y_label.into(),
        series: series
            .into_iter()
            .map(|(name, points)| (name.to_string(), points))
            .collect(),
        ..Plot::default()
    };
    let mut bits = plot(
        "Bits per frame",
        "bits per frame",
        vec![
            (
                "residual",
                time(&|i| 9e4 * (1.0 + 0.4 * noise(i)) + 8e5 / (1.0 + i)),
            ),
            ("cells", time(&|i| 3.1e6 * (1.0 + 0.2 * noise(i + 0.5)))),
        ],
    );
    bits.log_y = true;
    let rmse = time(&|i| 1.4 + 6.0 / (1.0 + i) + 0.1 * noise(i));
    let psnr = (0..8)
        .map(|i| (f64::from(i) * 1.25, 28.6 + 0.5 * noise(f64::from(i))))
        .collect();
    let stages = ["scene", "occlusion", "select", "encode", "decode"]
        .iter()
        .enumerate();
    let stages = stages.map(|(k, name)| {
        let base = [0.3, 7.5, 0.8, 1.9, 1.1][k];
        (
            *name,
            time(&move |i| base * (1.0 + 0.15 * noise(i + k as f64))),
        )
    });
    let cloud = |k: f64| -> Vec<(f64, f64)> {
        let points = (1..40).map(f64::from);
        points
            .map(|i| (i * 0.4 * k, 8.0 / i.sqrt() * k.sqrt()))
            .collect()
    };
    let clouds = vec![("residual", cloud(1.0)), ("cells", cloud(3.0))];
    let mut scatter = plot("Error against bits", "point RMSE (1/255)", clouds);
    scatter.x_label = "rate (Mbit/s)".into();
    scatter.form = Form::Marks;
    Report {
        title: "psao demo: atrium, 10 s at 60 frames a second".into(),
        summary: [
            ("points", "412 331 in 1 204 slices"),
            ("rate, residual", "5.9 Mbit/s (35 times less than cells)"),
            ("PSNR, mean of 8 frames", "29.41 dB"),
        ]
        .map(|(what, value)| (what.to_string(), value.to_string()))
        .to_vec(),
        panels: vec![panel(2.5), panel(7.5)],
        plots: vec![
            bits,
            plot(
                "Error of points",
                "point RMSE (1/255)",
                vec![("residual", rmse)],
            ),
            plot(
                "Pictures against ray tracing",
                "PSNR (dB)",
                vec![("from the stream", psnr)],
            ),
            plot("Time per stage", "milliseconds", stages.collect()),
            scatter,
        ],
    }
}

#[test]
fn the_report_shows_its_plots_and_pictures_in_a_browser_and_fetches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // Stays in the target folder, for a person to look at.
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("report.html");
    sample().write(&path).unwrap();
    let html = std::fs::read_to_string(&path).unwrap();
    assert!(
        !html.contains("://"),
        "an address outside the page is named"
    );
    std::fs::write(&path, format!("{html}{PROBE}")).unwrap();

    for width in [1280, 390] {
        let output = Command::new("chromium")
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
            ])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
            ])
            .args(["--disable-sync", "--disable-dev-shm-usage", "--dump-dom"])
            .arg(format!("--window-size={width},900"))
            .arg(format!(
                "--user-data-dir={}",
                folder.path().join("profile").display()
            ))
            .arg(format!("file://{}", path.display()))
            .output()
            .expect("Chromium opens the report: apt-get install -y chromium");
        let dom = String::from_utf8_lossy(&output.stdout);
        let root = dom.split("<head").next().unwrap_or_default();
        for expected in [
            "data-pictures=\"6\"",
            "data-plots=\"5\"",
            "data-lines=\"9\"",
            "data-marks=\"86\"",
            "data-overflow=\"false\"",
            "data-fetched=\"0\"",
        ] {
            let error = String::from_utf8_lossy(&output.stderr);
            assert!(
                root.contains(expected),
                "{width}: not {expected}: {root}\n{error}"
            );
        }
        assert!(dom.contains("ray traced, 512 samples") && dom.contains("rate (Mbit/s)"));
    }
}
