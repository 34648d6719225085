//! The conformance streams in `tests/conformance/streams`: that they are what they are said to be,
//! that they cover the format, and that nothing made from them harms a client.

#[path = "conformance/derive.rs"]
mod derive;
#[path = "conformance/record.rs"]
mod record;
#[allow(dead_code)] // Each test takes what it needs.
mod small_scene;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

type Files = BTreeMap<String, Vec<u8>>;

const REGENERATE: &str = "cargo test -p psao-tests --test conformance -- --ignored regenerate";

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("conformance/streams")
}

fn files() -> Files {
    let entries = std::fs::read_dir(folder()).unwrap_or_else(|_| panic!("run {REGENERATE}"));
    let entries = entries.map(|entry| entry.unwrap());
    let read = |entry: std::fs::DirEntry| std::fs::read(entry.path()).unwrap();
    entries
        .map(|entry| (entry.file_name().into_string().unwrap(), read(entry)))
        .collect()
}

fn recordings(files: &Files) -> Files {
    let take = |name: &&str| {
        let bytes = files.get(&format!("{name}.psao"));
        let bytes = bytes.unwrap_or_else(|| panic!("{name}.psao is missing: run {REGENERATE}"));
        (name.to_string(), bytes.clone())
    };
    record::RECORDED.iter().map(take).collect()
}

#[test]
#[ignore = "writes tests/conformance/streams anew"]
fn regenerate_the_conformance_streams() {
    let recorded = record::RECORDED
        .map(|name| (name.to_string(), record::record(name)))
        .into();
    let _ = std::fs::remove_dir_all(folder());
    std::fs::create_dir_all(folder()).unwrap();
    for (name, bytes) in derive::derive(&recorded) {
        std::fs::write(folder().join(name), bytes).unwrap();
    }
}

#[test]
fn the_streams_are_what_their_recordings_give_and_no_file_lacks() {
    let present = files();
    let expected = derive::derive(&recordings(&present));
    let names = |files: &Files| files.keys().cloned().collect::<BTreeSet<_>>();
    assert_eq!(names(&present), names(&expected), "run {REGENERATE}");
    for (name, bytes) in &expected {
        assert!(present[name] == *bytes, "{name} differs: run {REGENERATE}");
    }
    let bytes: usize = present.values().map(Vec::len).sum();
    assert!(bytes < 3 << 20, "{bytes} bytes of streams");
}

/// Clauses of these sections of which a stream alone can show nothing: definitions, advice, what
/// writers do, and (4.3, 4.5) what follows from a reader's own room; `tests/stream.rs` and
/// `tests/c/abi.c` check that.
const WITHOUT_STREAMS: &[&str] = &["2.1", "4.3", "4.4", "4.5", "4.6", "6.5", "8.4", "15.15"];

#[test]
fn every_clause_of_sections_2_to_8_and_15_has_a_stream() {
    let format = include_str!("../docs/format.md");
    let clauses: BTreeSet<&str> = format
        .lines()
        .filter_map(|line| {
            let clause = line.split(' ').next()?;
            let (section, number) = clause.split_once('.')?;
            let section: u32 = section.parse().ok()?;
            number.parse::<u32>().ok()?;
            ((2..=8).contains(&section) || section == 15).then_some(clause)
        })
        .collect();
    assert!(clauses.len() > 60, "{clauses:?}");
    let index = String::from_utf8(files()["index.txt"].clone()).unwrap();
    let covered: BTreeSet<&str> = index
        .lines()
        .flat_map(|line| line.split(' ').nth(1).unwrap().split(','))
        .chain(WITHOUT_STREAMS.iter().copied())
        .collect();
    assert_eq!(clauses.difference(&covered).collect::<Vec<_>>(), [&""; 0]);
    let unknown: Vec<_> = covered.difference(&clauses).collect();
    let outside = |clause: &&&&str| clause.starts_with("9.") || clause.starts_with("12.");
    assert_eq!(
        unknown.iter().filter(|c| !outside(c)).count(),
        0,
        "{unknown:?}"
    );
}
