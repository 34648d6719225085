//! The conformance streams in `tests/conformance/streams`: that they are what they are said to be,
//! that they cover the format, and that nothing made from them harms a client.

#[path = "conformance/derive.rs"]
mod derive;
#[path = "conformance/record.rs"]
mod record;
#[allow(dead_code)] // Each test takes what it needs.
mod small_scene;
#[path = "fuzz/targets.rs"]
mod targets;

use psao_core::mirror::Capacity;
use psao_core::stream::{PACKET_HEADER_BYTES, PREAMBLE, Packet, write_packet};
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
/// writers do, and (4.3, 4.5) what follows from a reader's own room; `tests/stream` and
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

/// The streams alone.
fn streams() -> Files {
    let mut files = files();
    files.retain(|name, _| name.ends_with(".psao"));
    files
}

/// As the target `push` takes it: portions of 16 bytes times the first byte.
fn pushed(stream: &[u8], portion: u8) {
    targets::push(&[&[portion][..], stream].concat());
}

#[test]
fn every_prefix_and_every_single_bit_flip_of_small_streams_is_harmless() {
    let streams = streams();
    for name in [
        "unused-entries-and-places",
        "after-a-failure",
        "numbers-in-more-bytes",
    ] {
        let stream = &streams[&format!("{name}.psao")];
        let capacity = Capacity {
            instances: 256,
            buckets: 1 << 14,
            cells: 1 << 15,
            slices: 1 << 10,
            points: 1 << 16,
            patches: 1 << 10,
            topology_bytes: 1 << 20,
        };
        let mut client = psao::Client::new(psao::Config {
            capacity,
            scene_hash: 0,
        });
        for length in 0..stream.len() {
            // From a block of its own, so that what lies behind it is not the rest.
            let prefix = stream[..length].to_vec();
            client.restart();
            let mut rest = &prefix[..];
            while !rest.is_empty() {
                rest = &rest[client.push(rest).unwrap().consumed..];
            }
        }
    }
    let stream = &streams["unused-entries-and-places.psao"];
    for bit in 0..stream.len() * 8 {
        let mut flipped = stream.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        pushed(&flipped, 255);
        pushed(&mended(&flipped), 255);
    }
}

/// The stream with right checksums and sequences, as far as its packets can be told apart.
fn mended(stream: &[u8]) -> Vec<u8> {
    let mut out = stream[..PREAMBLE.len().min(stream.len())].to_vec();
    let mut rest = &stream[out.len()..];
    for sequence in 0.. {
        let Some(head) = rest.first_chunk::<PACKET_HEADER_BYTES>() else {
            break;
        };
        let length = u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as usize;
        let Some(body) = rest[PACKET_HEADER_BYTES..].get(..length) else {
            break;
        };
        let mut packet = vec![0; PACKET_HEADER_BYTES + length];
        write_packet(&mut packet, head[0], head[1], sequence, |w| w.bytes(body)).unwrap();
        debug_assert!(Packet::read(&packet, u32::MAX).is_ok());
        out.extend(packet);
        rest = &rest[PACKET_HEADER_BYTES + length..];
    }
    out.extend(rest);
    out
}

/// Numbers that are the same in every run (splitmix64).
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((x ^ (x >> 31)) % end as u64) as usize
    }
}

/// Changes a few bytes, or takes some out, or puts some of another stream in.
fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    for _ in 0..=random.below(4) {
        if bytes.is_empty() {
            return;
        }
        let at = random.below(bytes.len());
        match random.below(6) {
            0 => bytes[at] = random.below(256) as u8,
            1 => bytes[at] ^= 1 << random.below(8),
            2 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][random.below(5)],
            3 => {
                let end = (at + 1 + random.below(64)).min(bytes.len());
                bytes.drain(at..end);
            }
            4 => {
                let from = random.below(other.len());
                let piece = &other[from..(from + random.below(64)).min(other.len())];
                bytes.splice(at..at, piece.iter().copied());
            }
            _ => {
                let from = random.below(other.len());
                let end = (at + random.below(64)).min(bytes.len());
                for (to, from) in bytes[at..end].iter_mut().zip(&other[from..]) {
                    *to = *from;
                }
            }
        }
    }
}

/// Mutations of the streams, through the fuzz targets: half with mended checksums.
fn mutations(count: usize, seed: u64) {
    let streams: Vec<Vec<u8>> = streams().into_values().collect();
    let mut random = Random(seed);
    for number in 0..count {
        let mut bytes = streams[random.below(streams.len())].clone();
        let other = &streams[random.below(streams.len())];
        mutate(&mut bytes, other, &mut random);
        if number % 2 == 1 {
            bytes = mended(&bytes);
        }
        pushed(&bytes, random.below(256) as u8);
        // The others read what lies behind the header.
        let body = &bytes[bytes.len().min(100 + random.below(400))..];
        match number % 8 {
            0 => targets::packets(body),
            1 => targets::range_coder(body),
            2 => targets::uplink(body),
            _ => {}
        }
    }
}

#[test]
fn streams_and_thousands_of_mutations_of_them_are_harmless() {
    for stream in streams().into_values() {
        for portion in [0, 1, 7, 255] {
            pushed(&stream, portion);
        }
    }
    mutations(20_000, 1);
}

#[test]
#[ignore = "takes minutes"]
fn a_million_mutations_are_harmless() {
    mutations(1_000_000, 2);
}
