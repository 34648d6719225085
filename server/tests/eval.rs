//! `psao eval`, on a scene as small as it gets.

use clap::Parser;
use psao_server::eval::{EvalArgs, run};

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    eval: EvalArgs,
}

fn parse(options: &str) -> EvalArgs {
    let words = ["eval"].into_iter().chain(options.split_whitespace());
    Cli::try_parse_from(words).expect("options are known").eval
}

const TINY: &str = "--density 24 --rays 64 --frames 8 --size 48x27 --pictures 1 --steps 2,6";

/// The keys that others read.
const KEYS: [&str; 16] = [
    "scene",
    "profile",
    "density",
    "rate_hz",
    "quant",
    "mbit_per_s",
    "mbit_per_s_first_second",
    "rmse_255",
    "psnr_db",
    "flip",
    "decode_ms",
    "encode_ms",
    "rays_per_frame",
    "points_changed_per_frame",
    "cells_skipped_share",
    "client_bytes",
];

#[test]
fn residual_needs_fewer_bits_than_cells_and_the_file_says_so_under_the_agreed_names() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut args = parse(&format!("{TINY} --rates 15,60"));
    args.json = Some(folder.path().join("out.json"));
    args.out = Some(folder.path().join("out"));
    let found = run(&args, &|_, _, _| ()).expect("the built-in scene can be measured");

    let json = std::fs::read(folder.path().join("out.json")).expect("was written");
    let json: serde_json::Value = serde_json::from_slice(&json).expect("is JSON");
    let rows = json["rows"].as_array().expect("is a list");
    assert_eq!(
        rows.len(),
        2 * 3,
        "two rates; one row for cells, two for residual"
    );
    for row in rows {
        for key in KEYS {
            let value = &row[key];
            assert!(value.is_number() || value.is_string(), "{key} is {value}");
        }
        assert!(row["rmse_255"].as_f64().expect("a number") < 6.0, "{row}");
        assert!(
            row["points_changed_per_frame"].as_f64() > Some(0.0),
            "{row}"
        );
    }
    for rate in [15.0, 60.0] {
        let bits = |profile: &str| -> Vec<f64> {
            let rows = rows.iter().filter(|row| row["profile"] == profile);
            rows.filter(|row| row["rate_hz"] == rate)
                .map(|row| row["mbit_per_s"].as_f64().expect("a number"))
                .collect()
        };
        let (cells, residual) = (bits("cells"), bits("residual"));
        let [fine, coarse] = residual[..] else {
            panic!("{residual:?}");
        };
        assert!(
            fine * 4.0 < cells[0],
            "{fine} against {cells:?} at {rate} Hz"
        );
        assert!(
            coarse < fine,
            "a coarser quantiser takes {coarse}, not less than {fine}"
        );
    }
    assert_eq!(found.comparisons.len(), 2);
    assert!(
        found
            .table()
            .contains("15 Hz: bits of cells over residual at")
    );
    let page = std::fs::read_to_string(folder.path().join("out/report.html")).expect("was written");
    assert_eq!(page.matches("<svg").count(), 6, "every plot has data");
}

#[test]
fn the_same_call_finds_the_same_bits_and_errors() {
    let args = parse(&format!("{TINY} --rates 30"));
    let figures = || {
        let found = run(&args, &|_, _, _| ()).expect("the built-in scene can be measured");
        let rows = found.rows.into_iter();
        rows.map(|row| {
            (
                row.mbit_per_s,
                row.rmse_255,
                row.psnr_db,
                row.points_changed_per_frame,
            )
        })
        .collect::<Vec<_>>()
    };
    assert_eq!(figures(), figures());
}

#[test]
fn options_out_of_range_are_refused_by_name() {
    let refused = |options: &str| run(&parse(options), &|_, _, _| ()).expect_err("is refused");
    assert!(refused("--rates 0").contains("--rates"));
    assert!(refused("--rates nan").contains("--rates"));
    assert!(refused("--densities 0").contains("density"));
    assert!(refused(&format!("--steps {}", ["2"; 17].join(","))).contains("--steps"));
    for options in [
        "--steps 0",
        "--frames 1",
        "--path 2",
        "--pictures 0",
        "--profiles x",
    ] {
        let words = ["eval"].into_iter().chain(options.split_whitespace());
        assert!(Cli::try_parse_from(words).is_err(), "{options}");
    }
}
