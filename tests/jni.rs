//! The Java API through JNI, in a Java virtual machine that checks every use of it
//! (`-Xcheck:jni`): whatever it says fails the test. `tests/jni/Checks.java` has the promises.

mod one_client;

use one_client::OneClient;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

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
    stdout + &stderr
}

fn sources(folder: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(root().join(folder)).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|ending| ending == "java"));
    assert!(!paths.is_empty(), "{folder}");
    paths
}

/// Compiles for the oldest Java that the API runs on; a warning or a missing comment fails it.
fn javac(out: &Path, sources: impl IntoIterator<Item = PathBuf>, words: &[&str]) {
    run(Command::new("javac")
        .args(["--release", "8", "-Xlint:all", "-Werror"])
        .args(words)
        .arg("-cp")
        .arg(out)
        .arg("-d")
        .arg(out)
        .args(sources));
}

/// Compiled classes, and the folder of the native library.
struct Setup {
    classes: PathBuf,
    library: PathBuf,
}

static SETUP: LazyLock<Setup> = LazyLock::new(|| {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("jni");
    let classes = folder.join("classes");
    let _ = std::fs::remove_dir_all(&classes);
    std::fs::create_dir_all(&classes).unwrap();
    let messages = run(Command::new(env!("CARGO"))
        .current_dir(root())
        .args(["build", "--locked", "-p", "psao-jni"])
        .args(["--features", "provoke,quic", "--message-format", "json"]));
    let library = messages
        .split('"')
        .rfind(|part| part.ends_with("/libpsao_jni.so"));
    let library = Path::new(library.unwrap()).parent().unwrap().to_path_buf();
    let documented = ["-Xdoclint:all/protected"];
    javac(&classes, sources("android/api/core/org/psao"), &documented);
    // The Android part, against the few classes of Android that it uses, as the tests declare them.
    javac(&classes, sources("tests/jni/android"), &[]);
    javac(
        &classes,
        sources("android/api/android/org/psao/android"),
        &documented,
    );
    javac(&classes, sources("tests/jni"), &[]);
    javac(&classes, sources("android/desktop"), &[]);
    Setup { classes, library }
});

/// A Java program, in a small heap, so that what it leaks shows.
fn java(main: &str) -> Command {
    let mut command = Command::new("java");
    command
        .args(["-Xcheck:jni", "-Xmx96m", "-XX:MaxDirectMemorySize=96m"])
        .arg("-cp")
        .arg(&SETUP.classes)
        .arg(format!("-Djava.library.path={}", SETUP.library.display()))
        .arg(main);
    command
}

fn streams() -> PathBuf {
    root().join("tests/conformance/streams")
}

/// Runs one of the checks, in a virtual machine of its own.
fn check(name: &str) -> String {
    let report = run(java("org.psao.Checks").arg(name).arg(streams()));
    // The virtual machine's own words about wrong use of JNI.
    for word in ["WARNING", "FATAL", "Exception in thread"] {
        assert!(!report.contains(word), "{report}");
    }
    assert!(report.contains(&format!("{name}: passed\n")), "{report}");
    report
}

#[test]
fn the_conformance_streams_give_through_jni_what_they_give_in_c() {
    let report = check("conformance");
    let index = std::fs::read_to_string(streams().join("index.txt")).unwrap();
    let all = format!("{} streams\n", index.lines().count());
    assert!(report.contains(&all), "{report}");
}

#[test]
fn wrong_use_gives_the_documented_exceptions_and_harms_nothing() {
    check("wrongUse");
}

#[test]
fn java_has_every_result_of_the_header_by_its_name() {
    let report = check("results");
    let header = include_str!("../include/psao.h");
    let results = header.split("typedef int32_t psao_result;").nth(1).unwrap();
    let results = results.split("};").next().unwrap().matches(" = ").count();
    assert!(report.contains(&format!("{results} results\n")), "{report}");
}

#[test]
fn a_taker_on_its_own_thread_sees_whole_frames_in_order() {
    check("threads");
}

#[test]
fn a_client_may_be_closed_while_other_threads_are_in_it() {
    check("closeMeanwhile");
}

#[test]
fn ten_thousand_clients_leave_nothing_behind() {
    check("tenThousand");
}

#[test]
fn a_panic_comes_out_as_an_exception_and_poisons_only_its_client() {
    check("panics");
}

#[test]
fn messages_come_from_any_thread_and_what_listeners_throw_is_dropped() {
    check("logs");
}

#[test]
fn a_frame_makes_no_garbage() {
    check("garbage");
}

#[test]
fn what_the_client_says_to_the_server_is_what_c_says() {
    check("uplink");
}

#[test]
fn a_player_plays_all_frames_and_none_while_it_is_paused() {
    check("player");
}

#[test]
fn the_android_part_pauses_and_resumes_with_the_activity_and_notices_networks() {
    check("android");
}

/// The same calls, in C, of the same library: it has the C ABI too.
#[test]
fn a_call_through_jni_costs_nanoseconds_more_than_in_c() {
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("jni/calls");
    let setup = &*SETUP;
    run(Command::new("cc")
        .args(["-Wall", "-Wextra", "-Werror", "-std=c99", "-O1", "-I"])
        .arg(root().join("include"))
        .arg(root().join("tests/jni/calls.c"))
        .arg(setup.library.join("libpsao_jni.so"))
        .arg(format!("-Wl,-rpath,{}", setup.library.display()))
        .arg("-o")
        .arg(&program));
    let stream = streams().join("residual.psao");
    let in_c = run(Command::new(&program).arg(&stream));
    // Without the checks, as apps run.
    let in_java = run(Command::new("java")
        .arg("-cp")
        .arg(&setup.classes)
        .arg(format!("-Djava.library.path={}", setup.library.display()))
        .args(["org.psao.Checks", "calls"])
        .arg(streams()));
    let [c, java] = [&in_c, &in_java].map(|report| {
        let figures = report.lines().filter_map(|line| line.split_once(": "));
        let figures = figures.filter_map(|(name, ns)| Some((name, ns.parse::<f64>().ok()?)));
        figures.collect::<Vec<_>>()
    });
    assert_eq!((c.len(), java.len()), (5, 5), "{in_c}{in_java}");
    for ((name, c), (same, java)) in c.iter().zip(&java) {
        assert_eq!(name, same);
        println!("{name}: {c} ns in C, {java} ns in Java");
        assert!(*c > 0.0 && *java > 0.0);
    }
}

#[test]
fn a_java_program_connects_plays_what_comes_and_is_heard() {
    let stream = std::fs::read(streams().join("cells.psao")).unwrap();
    let server = OneClient::start(stream);
    let mut client = java("org.psao.Checks");
    client
        .arg("connects")
        .arg(streams())
        .args([&server.address, &server.fingerprint, one_client::TOKEN])
        .stdout(std::process::Stdio::piped());
    let mut client = client.spawn().unwrap();
    let (ended, mut heard) = server.until(2, || client.try_wait().unwrap());
    assert!(ended.success(), "{heard:?}");
    let report = std::io::read_to_string(client.stdout.unwrap()).unwrap();
    assert_eq!(report, "connects: passed\n");
    assert_eq!(heard.len(), 2, "{heard:?}");
    heard.sort();
    assert!(heard[0].contains("present: false"), "{heard:?}");
    assert_eq!(heard[1], "frame 10");
}

#[test]
fn the_desktop_sample_plays_a_recording_and_writes_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("floor.pgm");
    let stream = streams().join("residual.psao");
    let report = run(java("Play").arg(&stream).arg(&picture));
    assert!(report.contains("10 frames\n"), "{report}");
    let pixels = std::fs::read(&picture).unwrap();
    let head = b"P5 256 256 255\n";
    assert!(pixels.starts_with(head) && pixels.len() == head.len() + 256 * 256);
    let occluded = pixels[head.len()..].iter().filter(|shade| **shade < 200);
    assert!(occluded.count() > 100, "no occlusion");
    // What is none is said to be none.
    let other = java("Play").arg(file!()).arg(&picture).output().unwrap();
    assert!(!other.status.success());
}

#[test]
fn the_aar_is_the_same_byte_for_byte_and_has_what_an_app_needs() {
    let folder = tempfile::tempdir().unwrap();
    let abis = ["arm64-v8a", "x86_64"];
    for abi in abis {
        // What is in it does not matter here: tests/android-link makes one for Android.
        let to = folder.path().join("natives").join(abi);
        std::fs::create_dir_all(&to).unwrap();
        std::fs::write(to.join("libpsao_jni.so"), abi).unwrap();
    }
    let assemble = |out: &Path| {
        let mut command = Command::new(root().join("android/assemble-aar"));
        command.arg(folder.path().join("natives")).arg(out);
        command.env_remove("ANDROID_JAR");
        command
    };
    let aars = ["one.aar", "other.aar"].map(|name| folder.path().join(name));
    for aar in &aars {
        run(&mut assemble(aar));
    }
    let [one, other] = aars.each_ref().map(|aar| std::fs::read(aar).unwrap());
    assert!(one == other, "two runs, two results");

    let out = folder.path().join("out");
    run(Command::new("unzip")
        .arg("-q")
        .arg(&aars[0])
        .arg("-d")
        .arg(&out));
    let listed = run(Command::new("unzip").arg("-Z1").arg(&aars[0]));
    let mut expected = vec![
        "AndroidManifest.xml".to_string(),
        "META-INF/com/android/build/gradle/aar-metadata.properties".into(),
        "R.txt".into(),
        "classes.jar".into(),
    ];
    expected.extend(abis.map(|abi| format!("jni/{abi}/libpsao_jni.so")));
    let module = "prefab/modules/psao";
    expected.push(format!("{module}/include/psao.h"));
    for abi in abis {
        expected.push(format!("{module}/libs/android.{abi}/abi.json"));
        expected.push(format!("{module}/libs/android.{abi}/libpsao_jni.so"));
    }
    expected.push(format!("{module}/module.json"));
    expected.push("prefab/prefab.json".into());
    expected.push("proguard.txt".into());
    assert_eq!(listed.lines().collect::<Vec<_>>(), expected);
    for name in expected.iter().filter(|name| name.ends_with(".json")) {
        let json = std::fs::read(out.join(name)).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
        assert!(json.is_object(), "{name}");
        if let Some(abi) = json.get("abi") {
            assert!(
                name.contains(abi.as_str().unwrap()) && json["api"] == 24,
                "{json}"
            );
        }
    }
    let classes = out.join("classes.jar");
    let listed = run(Command::new("unzip").arg("-Z1").arg(&classes));
    let other = listed.lines().filter(|name| !name.starts_with("org/psao/"));
    assert_eq!(other.collect::<Vec<_>>(), [""; 0], "no class but ours");
    for name in [
        "org/psao/PsaoClient.class",
        "org/psao/android/PsaoAssets.class",
    ] {
        assert!(listed.lines().any(|line| line == name), "{listed}");
    }
    // Java 8's bytecode, which every Android build tool reads.
    let class = Command::new("unzip")
        .arg("-p")
        .arg(&classes)
        .arg("org/psao/PsaoClient.class")
        .output()
        .unwrap();
    assert_eq!(class.stdout[..8], [0xca, 0xfe, 0xba, 0xbe, 0, 0, 0, 52]);

    // Without a library there is nothing to assemble, and it says so.
    std::fs::remove_dir_all(folder.path().join("natives")).unwrap();
    std::fs::create_dir(folder.path().join("natives")).unwrap();
    let output = assemble(&aars[0]).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(
        !output.status.success() && error.contains("arm64-v8a/libpsao_jni.so"),
        "{error}"
    );
}

#[test]
fn the_native_library_exports_the_c_abi_and_what_java_calls_and_nothing_else() {
    let library = SETUP.library.join("libpsao_jni.so");
    let symbols = run(Command::new("nm")
        .args(["-D", "--defined-only", "-j"])
        .arg(library));
    let mut symbols: Vec<String> = symbols.lines().map(String::from).collect();
    symbols.sort_unstable();
    let mut expected: Vec<String> = include_str!("../sdk/ffi/exports.txt")
        .lines()
        .map(String::from)
        .collect();
    expected.extend(["open", "receive", "send", "close"].map(|n| format!("psao_connection_{n}")));
    for (class, source) in [
        (
            "Native",
            include_str!("../android/api/core/org/psao/Native.java"),
        ),
        (
            "NativeConnection",
            include_str!("../android/api/core/org/psao/NativeConnection.java"),
        ),
        ("Provoke", include_str!("jni/Provoke.java")),
    ] {
        for line in source
            .lines()
            .filter(|line| line.contains("static native "))
        {
            let name = line
                .split('(')
                .next()
                .unwrap()
                .split(' ')
                .next_back()
                .unwrap();
            expected.push(format!("Java_org_psao_{class}_{name}"));
        }
    }
    expected.sort_unstable();
    assert_eq!(symbols, expected);
}
