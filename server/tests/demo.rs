//! The command `psao` as a user runs it: what it writes, what it says when something is wrong,
//! and server and client as processes of their own.

use serde_json::Value;
use std::io::{BufRead, BufReader, Lines};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use tempfile::TempDir;

/// Enough of a scene to stream something, at next to no cost.
const TINY: [&str; 4] = ["--density", "16", "--rays", "16"];

/// What a run of `psao` gave.
struct Run {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

fn command(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_psao"));
    command.current_dir(folder).env_remove("PSAO_TOKEN");
    command
}

fn psao(folder: &Path, args: &[&str]) -> Run {
    let output = command(folder).args(args).output().unwrap();
    let [stdout, stderr] =
        [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert!(!stderr.contains("panicked"), "psao {args:?}: {stderr}");
    Run {
        code: output.status.code(),
        stdout,
        stderr,
    }
}

/// Runs what must work, and returns what it prints.
fn works(folder: &Path, args: &[&str]) -> String {
    let run = psao(folder, args);
    assert_eq!(run.code, Some(0), "psao {args:?}: {}", run.stderr);
    run.stdout
}

/// Runs what must fail in one line that has all `words`, beside those that name stages.
fn fails(folder: &Path, args: &[&str], words: &[&str]) {
    let Run { code, stderr, .. } = psao(folder, args);
    let lines: Vec<_> = stderr
        .lines()
        .filter(|line| !line.ends_with(" ..."))
        .collect();
    let line = lines.first().copied().unwrap_or_default();
    match code {
        Some(1) => {
            assert!(line.starts_with("psao: "), "psao {args:?}: {stderr}");
            assert_eq!(lines.len(), 1, "psao {args:?}: {stderr}");
        }
        Some(2) => assert!(line.starts_with("error: "), "psao {args:?}: {stderr}"),
        _ => panic!("psao {args:?} ended with {code:?}: {stderr}"),
    }
    for word in words {
        assert!(
            lines.iter().any(|line| line.contains(word)),
            "psao {args:?} does not say {word}: {stderr}"
        );
    }
}

/// Names of all there is in a folder.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// The folder of real scenes, or `None` (and says so) where it is not at hand.
fn scenes() -> Option<PathBuf> {
    let folder = std::env::var_os("PSAO_SCENES").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes"),
        PathBuf::from,
    );
    if folder.is_dir() {
        return Some(folder.canonicalize().unwrap());
    }
    println!(
        "skipped: there is no {} (set PSAO_SCENES)",
        folder.display()
    );
    None
}

/// Runs the demo with a picture and checks its files and figures. Returns the figures.
fn demo(options: &[&str], size: (u32, u32)) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let text = format!("{}x{}", size.0, size.1);
    let mut args = vec!["demo", "--pictures", "1", "--size", &text];
    args.extend(["--out", "out", "--json", "figures.json"]);
    args.extend(options);
    let stdout = works(folder.path(), &args);
    assert_eq!(names(folder.path()), ["figures.json", "out"]);
    assert_eq!(
        names(&folder.path().join("out")),
        ["frame-1.png", "report.html"]
    );
    assert!(
        stdout.contains("report.html"),
        "it says where the report is: {stdout}"
    );
    check_picture(&folder.path().join("out/frame-1.png"), size);
    check_report(&folder.path().join("out/report.html"));
    let json = std::fs::read_to_string(folder.path().join("figures.json")).unwrap();
    let figures: Value = serde_json::from_str(&json).unwrap();
    check_figures(&figures);
    figures
}

/// Three pictures of that size beside each other, and none of one colour.
fn check_picture(path: &Path, (width, height): (u32, u32)) {
    let file = BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!(
        (info.color_type, info.bit_depth),
        (png::ColorType::Rgb, png::BitDepth::Eight)
    );
    assert_eq!(info.width, 3 * width + 4 * 8, "three pictures and the gaps");
    assert!(
        info.height > height + 40 && info.height < height + 100,
        "title, picture, scale"
    );
    let row = info.width as usize * 3;
    for panel in 0..3 {
        let middle = (panel * 2 + 1) * info.width as usize / 6;
        let half = width as usize / 3;
        // The pictures lie under a title of 32 rows.
        let mut values = [false; 256];
        for y in 32..32 + height as usize {
            for x in middle - half..middle + half {
                values[usize::from(bytes[y * row + x * 3])] = true;
            }
        }
        let shades = values.iter().filter(|&&value| value).count();
        assert!(shades > 16, "picture {panel} has only {shades} shades");
    }
}

fn check_report(path: &Path) {
    let html = std::fs::read_to_string(path).unwrap();
    assert!(
        html.trim_end().ends_with("</html>"),
        "the report is cut off"
    );
    let pictures = html.matches("data:image/png;base64,").count();
    assert_eq!(
        pictures, 3,
        "from the stream, the reference, the difference"
    );
    assert_eq!(html.matches("<svg").count(), 5, "plots");
    for title in ["Stream", "Error of the client's points", "Rays a frame"] {
        let escaped = title.replace('\'', "&#39;");
        assert!(
            html.contains(title) || html.contains(&escaped),
            "no plot \"{title}\""
        );
    }
}

fn check_figures(figures: &Value) {
    let number = |key: &str| -> f64 {
        let value = figures[key]
            .as_f64()
            .unwrap_or_else(|| panic!("{key}: {:?}", figures[key]));
        assert!(value.is_finite() && value >= 0.0, "{key}: {value}");
        value
    };
    let whole = |key: &str| -> u64 {
        figures[key]
            .as_u64()
            .unwrap_or_else(|| panic!("{key}: {:?}", figures[key]))
    };
    for key in ["scene", "profile"] {
        assert!(
            figures[key].as_str().is_some_and(|text| !text.is_empty()),
            "{key}"
        );
    }
    for key in [
        "points",
        "cells",
        "buckets",
        "instances",
        "frames",
        "client_bytes",
    ] {
        assert!(whole(key) > 0, "{key}");
    }
    // The paper's cells are too large for the seven points that they hold.
    let share = if figures["kernel"] == "paper" { 7 } else { 50 };
    assert!(whole("discarded_points") < whole("points") / share);
    assert!(whole("cells") <= whole("points"));
    assert!(whole("buckets") * 8 >= whole("cells"));
    // At least the cells in use are in the client's memory, 32 bytes each.
    assert!(whole("client_bytes") > whole("cells") * 32);
    assert!(number("fps") > 0.0);
    assert!(
        number("mbit_per_s") > 0.0,
        "something moves in all scenes here"
    );
    assert!(whole("rays_traced") > 0);
    assert!(whole("rays_traced") < whole("rays_if_all_traced"));
    assert!(
        (8.0..60.0).contains(&number("psnr_db")),
        "{}",
        number("psnr_db")
    );
    assert!((0.0..0.6).contains(&number("flip")) && number("flip") > 0.0);
    assert_eq!(figures["mirror_matches"], Value::Bool(true));
    assert!(number("rmse_255") <= 2.0, "over the threshold");
    let ms = figures["ms"].as_object().unwrap();
    for stage in ["trace", "select_encode", "transport", "decode", "lookup"] {
        assert!(
            ms[stage].as_f64().is_some_and(|ms| ms > 0.0),
            "{stage}: {ms:?}"
        );
    }
}

#[test]
fn the_demo_streams_the_built_in_scene_and_reports_on_it() {
    let options = ["--density", "48", "--rays", "32", "--frames", "4"];
    let figures = demo(&options, (96, 54));
    assert_eq!(figures["scene"], "atrium");
    assert_eq!(figures["frames"], 4);
    let paper = demo(&[&options[..], &["--kernel", "paper"]].concat(), (120, 60));
    assert_ne!(paper["cells"], figures["cells"], "its cells are larger");
    let movers = demo(&[&options[..], &["--movers", "3"]].concat(), (96, 54));
    assert_eq!(
        movers["instances"].as_u64().unwrap(),
        figures["instances"].as_u64().unwrap() + 3
    );
    let path = demo(&[&options[..], &["--path", "1"]].concat(), (96, 54));
    assert_ne!(
        path["psnr_db"], figures["psnr_db"],
        "it sees something else"
    );
}

#[test]
fn what_is_not_sent_stays_within_the_threshold() {
    // A ray is one step of 255: there is much that differs by a little.
    let options = [
        "--density",
        "16",
        "--rays",
        "256",
        "--frames",
        "6",
        "--fps",
        "10",
    ];
    let figures = demo(&options, (96, 54));
    assert!(
        figures["rmse_255"].as_f64().unwrap() > 0.0,
        "nothing was left out"
    );
}

#[test]
fn the_demo_runs_on_a_real_hall_with_boulders() {
    let Some(scenes) = scenes() else { return };
    let sponza = scenes.join("Sponza/Sponza.gltf").display().to_string();
    let options = ["--scene", &sponza, "--movers", "6", "--frames", "3"];
    let figures = demo(&[&options[..], &TINY].concat(), (96, 54));
    assert_eq!(figures["scene"], "Sponza.gltf");
}

#[test]
fn the_demo_runs_on_a_real_room_with_animated_figures() {
    let Some(scenes) = scenes() else { return };
    let file = |name: &str| scenes.join(name).display().to_string();
    let room = file("ConferenceRoom/ConferenceRoom.gltf");
    let man = format!("{}@1,0,0", file("CesiumMan/CesiumMan.glb"));
    let fox = format!("{}@-1,0,1,0.01", file("Fox/Fox.glb"));
    let figure = format!("{}@0,0,-1", file("RiggedFigure/RiggedFigure.glb"));
    let mut options = vec![
        "--scene",
        &room,
        "--density",
        "64",
        "--rays",
        "32",
        "--frames",
        "4",
    ];
    options.extend(["--add", &man, "--add", &fox, "--add", &figure]);
    let figures = demo(&options, (96, 54));
    let alone = demo(&[&options[..8], &["--movers", "1"]].concat(), (96, 54));
    let instances = |figures: &Value| figures["instances"].as_u64().unwrap();
    assert_eq!(instances(&figures), instances(&alone) - 1 + 3);
}

/// Records the built-in scene.
fn recording(folder: &Path, file: &str, options: &[&str]) {
    let args = [&["record", file, "--frames", "5"], &TINY[..], options].concat();
    let said = works(folder, &args);
    let bytes = std::fs::metadata(folder.join(file)).unwrap().len();
    assert!(said.contains(&bytes.to_string()), "{said}");
}

/// The value of a line of a table.
fn row<'a>(table: &'a str, what: &str) -> &'a str {
    let line = table.lines().find_map(|line| line.strip_prefix(what));
    line.unwrap_or_else(|| panic!("no {what} in {table}"))
        .trim()
}

#[test]
fn a_recording_is_the_same_twice_and_plays_to_what_the_server_had() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for options in [
        &[][..],
        &["--path", "1"],
        &["--compression", "paper", "--threshold", "0"],
    ] {
        recording(folder, "a.psao", options);
        recording(folder, "b.psao", options);
        let [a, b] = ["a.psao", "b.psao"].map(|name| std::fs::read(folder.join(name)).unwrap());
        assert!(a == b, "recorded twice, the bytes differ ({options:?})");
        let played = works(folder, &["play", "a.psao"]);
        assert_eq!(row(&played, "frames"), "5 (1 snapshots)");
        assert_eq!(row(&played, "bytes"), a.len().to_string());
        assert_eq!(row(&played, "hash mismatches"), "0");
        let listed = works(folder, &["inspect", "a.psao"]);
        let mut lines = listed.lines().rev();
        assert_eq!(lines.next(), Some("end"));
        let last = lines.next().unwrap();
        assert!(last.trim_start().starts_with("5 "), "{last}");
        let upper_half = &row(&played, "mirror hash")[..8];
        assert!(last.ends_with(&format!("  {upper_half}")), "{last}");
        let played = works(folder, &["play", "a.psao", "--frames", "2"]);
        assert_eq!(row(&played, "frames"), "2 (1 snapshots)");
    }
    assert_eq!(names(folder), ["a.psao", "b.psao"]);
}

#[test]
fn output_that_nobody_reads_is_an_error_and_no_panic() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    recording(folder, "a.psao", &[]);
    for verb in ["play", "inspect"] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let mut command = command(folder);
        let output = command
            .args([verb, "a.psao"])
            .stdout(writer)
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.starts_with("psao: standard output: "), "{said}");
    }
}

#[test]
fn a_damaged_recording_is_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    recording(folder, "whole.psao", &[]);
    let whole = std::fs::read(folder.join("whole.psao")).unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).unwrap();
    write("cut.psao", &whole[..whole.len() / 2]);
    // Only the end is missing.
    write("endless.psao", &whole[..whole.len() - 16]);
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 4;
    write("flipped.psao", &flipped);
    let mut version = whole;
    version[24] = 9;
    write("version.psao", &version);
    write("text.psao", b"This is no recording.\n");
    write("empty.psao", b"");
    for verb in ["play", "inspect"] {
        fails(folder, &[verb, "cut.psao"], &["cut.psao", "breaks off"]);
        fails(
            folder,
            &[verb, "flipped.psao"],
            &["flipped.psao", "checksum"],
        );
        fails(
            folder,
            &[verb, "version.psao"],
            &["version.psao", "checksum"],
        );
        fails(
            folder,
            &[verb, "text.psao"],
            &["text.psao", "not a PSAO stream"],
        );
        fails(folder, &[verb, "empty.psao"], &["empty.psao"]);
        fails(
            folder,
            &[verb, "none.psao"],
            &["none.psao", "No such file", "psao record"],
        );
    }
    fails(
        folder,
        &["play", "endless.psao"],
        &["endless.psao", "breaks off"],
    );
    fails(
        folder,
        &["play", "127.0.0.1:4433"],
        &["127.0.0.1:4433", "--fingerprint"],
    );
    fails(
        folder,
        &["play", "whole.psao", "--max-memory", "0"],
        &["--max-memory"],
    );
}

#[test]
fn a_bad_option_or_file_is_refused_in_words_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    std::fs::write(folder.join("text.gltf"), "This is no glTF.\n").unwrap();
    let triangle = r#"{"asset":{"version":"2.0"},
        "extensionsUsed":["KHR_draco_mesh_compression"],
        "extensionsRequired":["KHR_draco_mesh_compression"]}"#;
    std::fs::write(folder.join("draco.gltf"), triangle).unwrap();
    // What is left, but for the folder of the report, which is made first, and stays empty.
    let left = || {
        let mut left = names(folder);
        left.retain(|name| name != "out" || !names(&folder.join("out")).is_empty());
        left
    };
    let cases: [(&[&str], &[&str]); 20] = [
        (&["--add", "fox.glb"], &["--add", "fox.glb", "FILE@x,y,z"]),
        (
            &["--add", "fox.glb@1,2"],
            &["--add", "fox.glb@1,2", "FILE@x,y,z"],
        ),
        (&["--add", "fox.glb@1,2,x"], &["--add", "`x`", "FILE@x,y,z"]),
        (&["--add", "fox.glb@1,2,3,0"], &["--add", "scale"]),
        (
            &["--add", "fox.glb@1,2,3"],
            &["fox.glb", "cannot read", "path"],
        ),
        (
            &["--scene", "none.gltf"],
            &["none.gltf", "cannot read", "path"],
        ),
        (&["--scene", "text.gltf"], &["text.gltf", "not a glTF file"]),
        (
            &["--scene", "draco.gltf"],
            &["draco.gltf", "KHR_draco_mesh_compression", "copy"],
        ),
        (&["--density", "0"], &["--density", "above 0"]),
        (&["--density", "nan"], &["--density", "above 0"]),
        (
            &["--density", "1e9"],
            &["points, more than", "lower --density"],
        ),
        (&["--rays", "0"], &["--rays", "1 to 4096"]),
        (&["--rays", "4097"], &["--rays", "1 to 4096"]),
        (&["--unit", "0"], &["--unit", "above 0"]),
        (&["--ao-distance", "nan"], &["--ao-distance", "0 or more"]),
        (&["--fps", "0"], &["--fps", "above 0"]),
        (&["--margin", "181"], &["--margin", "0 to 180"]),
        (&["--kernel", "gauss"], &["--kernel", "gauss"]),
        (&["--path", "2"], &["--path", "2"]),
        (&["--frames", "0"], &["--frames", "1 or more"]),
    ];
    for (options, words) in cases {
        fails(
            folder,
            &[&["demo", "--out", "out"], options].concat(),
            words,
        );
        fails(folder, &[&["record", "x.psao"], options].concat(), words);
        assert_eq!(left(), ["draco.gltf", "text.gltf"], "after {options:?}");
    }
    for size in ["10", "96x", "x54", "15x54", "96x9000", "-1x5"] {
        let option = format!("--size={size}");
        fails(folder, &["demo", &option], &["--size", size, "480x270"]);
    }
    if let Some(scenes) = scenes() {
        let draco = scenes.join("Fox/Fox-draco.glb").display().to_string();
        let add = format!("{draco}@0,0,0");
        let words = [
            "Fox-draco.glb",
            "KHR_draco_mesh_compression",
            "gltf-transform",
        ];
        fails(folder, &["demo", "--scene", &draco], &words);
        fails(folder, &["demo", "--add", &add], &words);
    }
    assert_eq!(left(), ["draco.gltf", "text.gltf"]);
}

#[test]
fn where_nothing_can_be_written_it_says_so_before_it_works_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // A file where a folder should be: not even root can write into it.
    std::fs::write(folder.join("file"), "").unwrap();
    std::fs::create_dir(folder.join("folder.psao")).unwrap();
    let stages = |args: &[&str]| {
        let run = psao(folder, args);
        run.stderr
            .lines()
            .filter(|line| line.ends_with(" ..."))
            .count()
    };
    let cases: [(&[&str], &str); 4] = [
        (&["demo", "--out", "file/out"], "file/out"),
        (
            &["demo", "--out", "out", "--json", "file/x.json"],
            "file/x.json",
        ),
        (&["record", "file/x.psao"], "file/x.psao"),
        (&["record", "folder.psao"], "folder.psao"),
    ];
    for (args, name) in cases {
        let args = [args, &TINY].concat();
        fails(folder, &args, &[name]);
        assert_eq!(stages(&args), 0, "it worked in vain: {args:?}");
    }
    assert_eq!(names(folder), ["file", "folder.psao", "out"]);
    assert!(names(&folder.join("out")).is_empty());
}

/// A server as a process of its own, ended with the test.
struct Served {
    process: Child,
    /// What it prints; open, so that it can.
    _lines: Lines<BufReader<ChildStdout>>,
    folder: TempDir,
    address: String,
    fingerprint: String,
}

impl Served {
    fn start() -> Served {
        let folder = tempfile::tempdir().unwrap();
        let mut process = command(folder.path())
            .args(["serve", "--listen", "127.0.0.1:0", "--token", "open sesame"])
            .args(TINY)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
        let mut value = |name: &str| {
            let line = lines.next().expect("the server says where it is").unwrap();
            let value = line.strip_prefix(name).expect(&line);
            value.trim().to_string()
        };
        let address = value("listening");
        let fingerprint = value("fingerprint");
        Served {
            process,
            _lines: lines,
            folder,
            address,
            fingerprint,
        }
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}

#[test]
fn a_server_process_serves_a_player_process_and_refuses_strangers() {
    let mut served = Served::start();
    let folder = served.folder.path();
    let play = ["play", &served.address, "--frames", "4", "--fingerprint"];
    let right = [&play[..], &[&served.fingerprint]].concat();
    for _ in 0..2 {
        let played = works(folder, &[&right[..], &["--token", "open sesame"]].concat());
        assert_eq!(row(&played, "frames"), "4 (1 snapshots)");
        assert_eq!(row(&played, "hash mismatches"), "0");
    }
    fails(
        folder,
        &[&right[..], &["--token", "open"]].concat(),
        &["wrong token"],
    );
    fails(folder, &right, &["wrong token"]);
    let other = "0".repeat(64);
    let words = [&served.fingerprint, &other, "fingerprint"];
    let wrong = [&play[..], &[&other, "--token", "open sesame"]].concat();
    fails(folder, &wrong, &words);
    fails(
        folder,
        &[&play[..], &["12"]].concat(),
        &["--fingerprint", "64 hexadecimal"],
    );
    assert!(
        served.process.try_wait().unwrap().is_none(),
        "the server goes on"
    );
    let played = works(
        served.folder.path(),
        &[&right[..], &["--token", "open sesame"]].concat(),
    );
    assert_eq!(row(&played, "frames"), "4 (1 snapshots)");
}

#[test]
fn a_server_says_which_address_is_in_use() {
    let folder = tempfile::tempdir().unwrap();
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let args = [
        "serve", "--token", "x", "--frames", "1", "--listen", &address,
    ];
    fails(
        folder.path(),
        &[&args[..], &TINY].concat(),
        &[&address, "cannot listen", "another address or port"],
    );
    fails(folder.path(), &["serve"], &["--token"]);
}
