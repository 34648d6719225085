//! The viewer shows what a recording says: to a file, and in a window.

use clap::Parser;
use psao_server::commands::{RecordArgs, ServeArgs, record, serve};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

#[derive(Parser)]
struct Recorder {
    #[command(flatten)]
    args: RecordArgs,
}

/// A short, coarse recording of the built-in scene.
fn recording(folder: &Path) -> PathBuf {
    let file = folder.join("atrium.psao");
    let name = file.to_str().expect("a name in ASCII");
    let args = "psao --density 24 --rays 32 --frames 3 --path 0"
        .split(' ')
        .chain([name]);
    record(&Recorder::parse_from(args).args, &|_, _, _| ()).expect("a recording");
    file
}

fn viewer() -> Command {
    Command::new(env!("CARGO_BIN_EXE_psao-viewer"))
}

/// Width, height, and the bytes of red, green and blue.
fn pixels(file: &Path) -> (u32, u32, Vec<u8>) {
    let bytes = std::fs::read(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().expect("a PNG");
    let mut out = vec![0; reader.output_buffer_size().expect("a small picture")];
    let info = reader.next_frame(&mut out).expect("a PNG");
    let samples = info.color_type.samples();
    let rgb = out.chunks(samples).flat_map(|texel| match samples {
        1 | 2 => [texel[0]; 3],
        _ => [texel[0], texel[1], texel[2]],
    });
    (info.width, info.height, rgb.collect())
}

fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
    let off = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b)));
    off.sum::<f64>() / a.len() as f64
}

#[test]
fn a_picture_from_the_stream_is_nearer_to_the_ray_traced_one_than_one_without_occlusion() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = recording(folder.path());
    let picture = |mode: &str, overlay: &str| {
        let file = folder.path().join(format!("{mode}-{overlay}.png"));
        let out = viewer()
            .arg(&recording)
            .args([
                "--headless",
                "--size",
                "192x108",
                "--mode",
                mode,
                "--overlay",
                overlay,
            ])
            .arg("--out")
            .arg(&file)
            .output()
            .expect("the viewer starts");
        let error = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success(), "{mode}, {overlay}: {error}");
        let (width, height, rgb) = pixels(&file);
        assert_eq!((width, height), (192, 108));
        // Beside the text.
        rgb[192 * 3 * 72..].to_vec()
    };
    let [stream, rays, screen, off] =
        ["ao", "reference", "screen", "off"].map(|mode| picture(mode, "none"));
    let from_rays = [&stream, &screen, &off].map(|picture| mean_difference(picture, &rays));
    println!("from the ray-traced picture, of 255: stream, screen, off {from_rays:?}");
    assert!(from_rays[2] > 4.0, "there is no occlusion in view");
    assert!(
        from_rays[0] < 0.5 * from_rays[2],
        "the stream's occlusion is not what rays say"
    );
    assert!(from_rays[1] < 0.8 * from_rays[2], "nor is the screen's");
    for overlay in ["cells", "points", "dirty", "occupancy"] {
        let off = mean_difference(&picture("ao", overlay), &stream);
        assert!(off > 4.0, "overlay {overlay} does not show");
    }
}

#[derive(Parser)]
struct Servant {
    #[command(flatten)]
    args: ServeArgs,
}

/// Hands on what is written to it.
struct Lines(std::sync::mpsc::Sender<String>);

impl std::io::Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        // Nobody listens any more when the test is done.
        let _ = self.0.send(String::from_utf8_lossy(bytes).into_owned());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_live_server_is_followed() {
    let folder = tempfile::tempdir().expect("a folder");
    let identity = folder.path().join("identity");
    let args = "psao --density 24 --rays 32 --token T --listen 127.0.0.1:0 --identity".split(' ');
    let args = Servant::parse_from(args.chain([identity.to_str().expect("ASCII")])).args;
    let (lines, said) = std::sync::mpsc::channel();
    // It serves until the test's process ends.
    std::thread::spawn(move || {
        let served = serve(&args, &mut Lines(lines), &|_, _, _| ());
        panic!("the server ended: {served:?}");
    });
    let mut text = String::new();
    while !text.contains("scene hash") {
        text += &said.recv().expect("the server says where it is");
    }
    let word = |name: &str| {
        let mut words = text.split_whitespace().skip_while(|word| *word != name);
        words.nth(1).unwrap_or_else(|| panic!("no {name} in {text}")).to_string()
    };
    let picture = |mode: &str| {
        let file = folder.path().join(format!("{mode}.png"));
        let out = viewer()
            .args([word("listening"), "--fingerprint".into(), word("fingerprint")])
            .args(["--token", "T", "--headless", "--frames", "8", "--size", "192x108"])
            .args(["--mode", mode, "--out"])
            .arg(&file)
            .output()
            .expect("the viewer starts");
        let error = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success(), "{error}");
        pixels(&file).2[192 * 3 * 72..].to_vec()
    };
    // The figures have moved on between the two, the floor and the walls have not.
    let off = mean_difference(&picture("ao"), &picture("off"));
    assert!(off > 4.0, "no occlusion comes from the server: {off}");
}

#[test]
fn what_is_wrong_is_said_with_its_remedy() {
    let folder = tempfile::tempdir().expect("a folder");
    let error_of = |args: &[&str]| {
        let out = viewer().args(args).output().expect("the viewer starts");
        assert!(!out.status.success());
        String::from_utf8_lossy(&out.stderr).into_owned()
    };
    let out = folder.path().join("a.png");
    let out = out.to_str().expect("a name in ASCII");
    let missing = error_of(&["nothing.psao", "--headless", "--out", out]);
    assert!(
        missing.contains("nothing.psao") && missing.contains("psao record"),
        "{missing}"
    );
    let recording = recording(folder.path());
    let recording = recording.to_str().expect("a name in ASCII");
    let other = error_of(&[recording, "--movers", "1", "--headless", "--out", out]);
    assert!(other.contains("another scene"), "{other}");
}

/// Ended when the test is.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(command: &mut Command, needs: &str) -> (Running, String) {
    let child = command.stdout(Stdio::piped()).spawn();
    let mut child = child.unwrap_or_else(|error| panic!("{error}: apt-get install {needs}"));
    let stdout = child.stdout.take().expect("it is piped");
    let running = Running(child);
    let mut line = String::new();
    BufReader::new(stdout)
        .read_line(&mut line)
        .expect("its output can be read");
    (running, line.trim().into())
}

#[test]
fn a_window_shows_the_scene() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = recording(folder.path());
    let (_screen, number) = start(
        Command::new("Xvfb").args(["-displayfd", "1", "-screen", "0", "640x400x24"]),
        "xvfb",
    );
    assert!(number.parse::<u32>().is_ok(), "Xvfb gave no display");
    let display = format!(":{number}");
    let (_viewer, said) = start(
        viewer()
            .arg(&recording)
            .args(["--size", "480x270"])
            .env("DISPLAY", &display),
        "mesa-vulkan-drivers libxkbcommon-x11-0 libxcursor1 libxi6",
    );
    assert_eq!(said, "first picture");
    // What was presented is on the screen some requests later.
    let file = std::env::var("PSAO_SCREENSHOT").map_or(folder.path().join("a.png"), PathBuf::from);
    let shows = |attempt: u32| {
        let shot = Command::new("import")
            .args(["-display", &display, "-window", "root"])
            .arg(&file)
            .status()
            .unwrap_or_else(|error| panic!("{error}: apt-get install imagemagick"));
        assert!(shot.success());
        let (_, _, rgb) = pixels(&file);
        let grey = |texel: &&[u8]| texel.iter().all(|v| (30..250).contains(v));
        let lit = rgb.chunks(3).filter(grey).count();
        println!("screenshot {attempt}: {lit} pixels of a picture");
        lit > 480 * 270 / 2
    };
    assert!((0..50).any(shows), "the window stays empty");
}
