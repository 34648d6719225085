//! libpsao as C and C++ programs get it: installed to a prefix, linked, and used.

mod one_client;

use clap::Parser;
use one_client::OneClient;
use psao_server::commands::{RecordArgs, record};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

const WARNINGS: &[&str] = &["-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-g"];

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Runs a program to its end, which must be a success.
fn run(command: &mut Command) -> String {
    let output = command.output();
    let Output {
        status,
        stdout,
        stderr,
    } = output.unwrap_or_else(|error| panic!("{command:?}: {error}: tests/run installs it"));
    let [stdout, stderr] = [stdout, stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert!(status.success(), "{command:?}: {status}\n{stdout}{stderr}");
    stdout
}

/// What all tests share: the installed library, and recordings of 300 frames.
struct Setup {
    folder: PathBuf,
    prefix: PathBuf,
    recordings: [PathBuf; 2],
}

static SETUP: LazyLock<Setup> = LazyLock::new(|| {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("c");
    std::fs::create_dir_all(&folder).unwrap();
    let prefix = folder.join("prefix");
    run(Command::new(env!("CARGO"))
        .current_dir(root())
        .args([
            "run", "--locked", "-p", "psao-gen", "--", "install", "--prefix",
        ])
        .arg(&prefix));
    let recordings = ["cells", "residual"].map(|profile| {
        let path = folder.join(format!("{profile}.psao"));
        recording(profile, 300, &path);
        path
    });
    Setup {
        folder,
        prefix,
        recordings,
    }
});

/// Records the built-in scene, coarsely.
fn recording(profile: &str, frames: u32, path: &Path) {
    #[derive(Parser)]
    struct Words {
        #[command(flatten)]
        args: RecordArgs,
    }
    let frames = frames.to_string();
    let words = [
        "record",
        "--density",
        "8",
        "--rays",
        "16",
        "--profile",
        profile,
        "--frames",
    ];
    let words = words
        .into_iter()
        .chain([&frames[..], path.to_str().unwrap()]);
    record(&Words::parse_from(words).args, &|_, _, _| ()).unwrap();
}

impl Setup {
    /// Compiles a program. `words`: standard, sanitizers, and the like.
    fn compile(&self, compiler: &str, source: &str, words: &[&str]) -> PathBuf {
        let name = source.replace(['/', '.'], "-") + &words.concat().replace(['=', ','], "-");
        let out = self.folder.join(name);
        let language = if compiler == "c++" { "c++" } else { "c" };
        run(Command::new(compiler)
            .args(WARNINGS)
            .args(words)
            .arg("-I")
            .arg(self.prefix.join("include"))
            .args(["-x", language])
            .arg(root().join(source))
            .args(["-x", "none"])
            .arg(self.prefix.join("lib/libpsao.a"))
            .args(["-lpthread", "-ldl", "-lm", "-o"])
            .arg(&out));
        out
    }
}

#[test]
fn the_abi_is_what_the_header_says_in_c99_and_cpp17() {
    let setup = &*SETUP;
    for (compiler, standard) in [("cc", "-std=c99"), ("c++", "-std=c++17")] {
        let program = setup.compile(compiler, "tests/c/abi.c", &[standard]);
        for recording in &setup.recordings {
            run(Command::new(&program).arg(recording));
        }
    }
}

#[test]
fn wrong_use_and_damage_are_harmless_under_sanitizers_and_valgrind() {
    let setup = &*SETUP;
    let sanitizers = [
        "-std=c99",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
    ];
    let sanitized = setup.compile("cc", "tests/c/abi.c", &sanitizers);
    let plain = setup.compile("cc", "tests/c/abi.c", &["-std=c99", "-DVALGRIND"]);
    for recording in &setup.recordings {
        run(Command::new(&sanitized).arg(recording));
        run(Command::new("valgrind")
            .args(["-q", "--error-exitcode=9", "--leak-check=full"])
            .arg(&plain)
            .arg(recording));
    }
}

#[test]
fn nothing_is_allocated_between_init_and_the_end_of_300_frames_nor_when_a_stream_fails() {
    let setup = &*SETUP;
    let program = setup.compile("cc", "tests/c/quiet.c", &["-std=c11"]);
    let folder = root().join("tests/conformance/streams");
    let index = std::fs::read_to_string(folder.join("index.txt")).unwrap();
    let fail = index.lines().filter_map(|line| {
        let name = line.strip_prefix("invalid ")?.split(' ').nth(1)?;
        Some(folder.join(format!("{name}.psao")))
    });
    let report = run(Command::new(program)
        .args(&setup.recordings)
        .arg("fail")
        .args(fail));
    assert_eq!(report.matches(", 0 calls of").count(), 5, "{report}");
}

#[test]
fn a_taker_on_its_own_thread_sees_whole_frames_in_order() {
    let setup = &*SETUP;
    let program = setup.compile("cc", "tests/c/threads.c", &["-std=c11"]);
    run(Command::new(program)
        .arg("together")
        .args(&setup.recordings));
}

#[test]
fn clients_share_nothing() {
    let setup = &*SETUP;
    let program = setup.compile(
        "cc",
        "tests/c/threads.c",
        &["-std=c11", "-fsanitize=thread"],
    );
    run(Command::new(program).arg("apart").args(&setup.recordings));
}

#[test]
fn any_implementation_of_the_header_can_be_checked_with_the_conformance_streams() {
    let setup = &*SETUP;
    let folder = root().join("tests/conformance/streams");
    let program = setup.compile("cc", "tests/conformance/run.c", &["-std=c99"]);
    let report = run(Command::new(&program).arg(&folder));
    let index = std::fs::read_to_string(folder.join("index.txt")).unwrap();
    let all = index.lines().count();
    assert!(
        report.ends_with(&format!("{all} passed, 0 failed\n")),
        "{report}"
    );
    // A runner that lets something pass proves nothing.
    let copy = setup.folder.join("conformance");
    std::fs::create_dir_all(&copy).unwrap();
    for entry in std::fs::read_dir(&folder).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), copy.join(entry.file_name())).unwrap();
    }
    let wrong = [
        index.replacen(" cells 10 0 ", " cells 9 0 ", 1),
        index.replacen(" -20", " -21", 1),
        index.replacen(" topology\n", "\n", 1),
        index.clone() + "valid 0 missing 1 0 0\n",
    ];
    for wrong in wrong {
        assert_ne!(wrong, index);
        std::fs::write(copy.join("index.txt"), wrong).unwrap();
        let output = Command::new(&program).arg(&copy).output().unwrap();
        assert!(!output.status.success());
    }
}

/// libpsao.a, built in another way than it is installed.
fn library(words: &[&str]) -> PathBuf {
    let messages = run(Command::new(env!("CARGO"))
        .current_dir(root())
        .args(["build", "--locked", "--message-format", "json"])
        .args(["-p", "psao-ffi"])
        .args(words));
    let mut paths = messages.split('"');
    paths
        .rfind(|part| part.ends_with("/libpsao.a"))
        .unwrap()
        .into()
}

#[test]
fn a_defect_ends_one_function_and_neither_the_program_nor_other_clients() {
    // The same profile: not while that is being installed.
    let setup = &*SETUP;
    let small = ["--profile", "libpsao", "--no-default-features"];
    let library = library(&[&small[..], &["--features", "thin,provoke"]].concat());
    for (name, words) in [
        ("plain", &["-std=c99"][..]),
        ("sanitized", &["-fsanitize=address,undefined"]),
        ("threads", &["-fsanitize=thread"]),
    ] {
        let program = setup.folder.join(format!("defects-{name}"));
        run(Command::new("cc")
            .args(WARNINGS)
            .args(words)
            .arg("-I")
            .arg(root().join("include"))
            .arg(root().join("tests/c/defects.c"))
            .arg(&library)
            .args(["-lpthread", "-o"])
            .arg(&program));
        for stream in ["cells", "residual"] {
            let stream = root().join(format!("tests/conformance/streams/{stream}.psao"));
            run(Command::new(&program).arg(stream));
        }
    }
}

#[test]
fn a_c_program_connects_plays_what_comes_and_is_heard() {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("connect");
    run(Command::new("cc")
        .args(WARNINGS)
        .args(["-std=c99", "-DPSAO_QUIC"])
        .arg("-I")
        .arg(root().join("include"))
        .arg(root().join("tests/c/connect.c"))
        .arg(library(&["--features", "quic"]))
        .args(["-lpthread", "-ldl", "-lm", "-o"])
        .arg(&program));
    let stream = root().join("tests/conformance/streams/cells.psao");
    let server = OneClient::start(std::fs::read(&stream).unwrap());
    let mut client = Command::new(&program)
        .args([&server.address, &server.fingerprint, one_client::TOKEN])
        .arg(&stream)
        .spawn()
        .unwrap();
    let (ended, mut heard) = server.until(2, || client.try_wait().unwrap());
    assert!(ended.success(), "{heard:?}");
    assert_eq!(heard.len(), 2, "{heard:?}");
    heard.sort();
    assert!(heard[0].contains("present: false"), "{heard:?}");
    assert_eq!(heard[1], "frame 10");
}

#[test]
fn the_examples_build_with_a_compiler_alone_with_pkg_config_and_with_cmake() {
    let setup = &*SETUP;
    let [cells, residual] = &setup.recordings;
    let picture = setup.folder.join("floor.pgm");
    let play = setup.compile("cc", "examples/c/play.c", &["-std=c99"]);
    run(Command::new(play).args([residual, &picture]));
    let pixels = std::fs::read(&picture).unwrap();
    let head = b"P5 256 256 255\n";
    assert!(pixels.starts_with(head) && pixels.len() == head.len() + 256 * 256);
    let pixels = &pixels[head.len()..];
    let shades = |range: std::ops::Range<u8>| pixels.iter().filter(|p| range.contains(p)).count();
    assert!(
        shades(0..128) > 500 && shades(250..255) + shades(255..255) > 500,
        "no occlusion"
    );

    let pkg_config = run(Command::new("pkg-config")
        .env("PKG_CONFIG_PATH", setup.prefix.join("lib/pkgconfig"))
        .args(["--cflags", "--libs", "psao"]));
    let library = setup.prefix.join("lib");
    let program = setup.folder.join("render_loop");
    run(Command::new("cc")
        .args(WARNINGS)
        .arg("-std=c11")
        .arg(root().join("examples/c/render_loop.c"))
        .args(pkg_config.split_whitespace())
        .args(["-pthread", "-o"])
        .arg(&program));
    run(Command::new(&program)
        .env("LD_LIBRARY_PATH", &library)
        .arg(cells));

    let build = setup.folder.join("cmake");
    run(Command::new("cmake")
        .arg("-S")
        .arg(root().join("examples/c"))
        .arg("-B")
        .arg(&build)
        .arg(format!("-DCMAKE_PREFIX_PATH={}", setup.prefix.display())));
    run(Command::new("cmake").arg("--build").arg(&build));
    run(Command::new(build.join("render_loop")).arg(residual));
    run(Command::new(build.join("play")).args([cells, &picture]));
}

/// Mesa's software GLES, without a window.
#[test]
fn the_android_sample_uploads_what_changed_and_its_shader_agrees_with_the_cpu() {
    let setup = &*SETUP;
    let program = setup.folder.join("sample");
    let sample = root().join("android/sample/src/main/cpp");
    run(Command::new("cc")
        .args(WARNINGS)
        .arg("-std=c11")
        .arg("-I")
        .arg(setup.prefix.join("include"))
        .arg("-I")
        .arg(&sample)
        .arg(root().join("tests/c/sample.c"))
        .args(["psao_ao.c", "player.c"].map(|name| sample.join(name)))
        .arg(setup.prefix.join("lib/libpsao.a"))
        .args(["-lEGL", "-lGLESv2", "-lpthread", "-ldl", "-lm", "-o"])
        .arg(&program));
    // Where the shaders are not in the tree yet, only the uploads can be looked at.
    let shaders = root().join("sdk/shaders");
    let snippet = shaders.join("generated/psao_es310.glsl");
    for stream in ["cells", "residual"] {
        let stream = root().join(format!("tests/conformance/streams/{stream}.psao"));
        run(Command::new(&program)
            .arg(stream)
            .args(shaders.exists().then_some(&snippet)));
    }
}

#[test]
fn the_shared_library_exports_the_listed_functions_and_nothing_else() {
    let library = SETUP.prefix.join("lib/libpsao.so");
    let symbols = run(Command::new("nm")
        .args(["-D", "--defined-only", "-j"])
        .arg(&library));
    let mut symbols: Vec<&str> = symbols.lines().collect();
    symbols.sort_unstable();
    let listed = include_str!("../sdk/ffi/exports.txt");
    assert_eq!(symbols, listed.lines().collect::<Vec<_>>());
}

#[test]
fn the_shared_library_is_small_and_knows_no_function_that_takes_memory() {
    let library = SETUP.prefix.join("lib/libpsao.so");
    // As the guide says: 164 KiB on x86_64.
    let bytes = std::fs::metadata(&library).unwrap().len();
    assert!(bytes < 165 << 10, "{bytes} bytes");
    let needed = run(Command::new("nm").args(["-D", "-u", "-j"]).arg(&library));
    let known = [
        "__cxa_finalize",
        "_longjmp",
        "_setjmp",
        "abort",
        "bcmp",
        // zstd's, of a decoder that is not in the caller's memory.
        "free",
        "memcpy",
        "memmove",
        "memset",
    ];
    for name in needed.lines() {
        let name = name.split('@').next().unwrap();
        // Weak ones of the compiler's and of zstd's tracing.
        let weak = ["_ITM_", "__gmon_start__", "ZSTD_trace_"];
        let weak = weak.iter().any(|start| name.starts_with(start));
        assert!(weak || known.contains(&name), "it needs {name}");
    }
}

#[test]
fn the_guide_has_a_remedy_for_every_result() {
    let guide = include_str!("../docs/integrate.md");
    let header = include_str!("../include/psao.h");
    let results = header.lines().filter_map(|line| {
        let (name, _) = line.trim().split_once(" = ")?;
        let result = name.starts_with("PSAO_ERROR_") || name == "PSAO_RESYNC";
        result.then_some(name)
    });
    let mut count = 0;
    for name in results {
        assert!(guide.contains(&format!("`{name}`")), "{name}");
        count += 1;
    }
    assert!(count > 20, "{count} results");
}
