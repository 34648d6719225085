//! What the recordings become: streams that any reader must treat alike, with what it must make of
//! them. Nothing here depends on the machine: the bytes are those checked in, or a test fails.

use super::Files;
use psao::core::mirror::Capacity;
use psao::core::stream::{
    FRAME_HEADER_BYTES, Frame, Header, PACKET_HEADER_BYTES, PREAMBLE, Packet, Profile, Reader,
    Refusal, Writer, flag, kind, mirror_check, write_packet,
};
use psao::core::{Instance, Lookup};
use psao::{Client, Config};
use std::collections::BTreeMap;
use std::fmt::Write;

/// A packet: kind, flags, body.
type Part = (u8, u8, Vec<u8>);

/// A stream's packets, to change.
#[derive(Clone)]
struct Parts(Vec<Part>);

impl Parts {
    fn of(stream: &[u8]) -> Parts {
        let mut rest = &stream[PREAMBLE.len()..];
        let mut parts = Vec::new();
        while let Some((packet, length)) = Packet::read(rest, u32::MAX).unwrap() {
            parts.push((packet.kind, packet.flags, packet.body.to_vec()));
            rest = &rest[length..];
        }
        Parts(parts)
    }

    /// The stream, with right lengths, sequences and checksums.
    fn stream(&self) -> Vec<u8> {
        let mut bytes = PREAMBLE.to_vec();
        for (sequence, (kind, flags, body)) in (0..).zip(&self.0) {
            let start = bytes.len();
            bytes.resize(start + PACKET_HEADER_BYTES + body.len(), 0);
            write_packet(&mut bytes[start..], *kind, *flags, sequence, |w| {
                w.bytes(body)
            })
            .unwrap();
        }
        bytes
    }

    fn changed(&self, change: impl FnOnce(&mut Vec<Part>)) -> Vec<u8> {
        let mut parts = self.clone();
        change(&mut parts.0);
        parts.stream()
    }

    /// Its first frames, and an end.
    fn brief(&self, frames: usize) -> Parts {
        let last = lasts(&self.0)[frames - 1];
        let mut parts = Parts(self.0[..=last].to_vec());
        parts.0.push((kind::END, 0, Vec::new()));
        parts
    }

    /// With one more packet before the end: of a frame that goes on.
    fn with(&self, kind: u8, content: &[u8]) -> Parts {
        self.with_body(kind, 0, content)
    }

    fn with_body(&self, kind: u8, flags: u8, content: &[u8]) -> Parts {
        let mut parts = self.clone();
        let end = parts.0.len() - 1;
        let before = parts.0.iter().rfind(|part| is_frame(part)).unwrap();
        let (frame, _) = Frame::read(&before.2).unwrap();
        let goes_on = before.1 & flag::LAST == 0;
        let frame = Frame {
            id: frame.id + u32::from(!goes_on),
            mirror_check: if flags & flag::LAST == 0 {
                0
            } else {
                frame.mirror_check
            },
            ..frame
        };
        parts.0.insert(end, (kind, flags, body(&frame, content)));
        parts
    }

    /// Sets every frame's hash to that of what the client makes of it.
    fn hashed(&self) -> Parts {
        let mut parts = self.clone();
        for last in lasts(&self.0) {
            let mut client = client();
            let stream = Parts(parts.0[..=last].to_vec()).stream();
            let mut rest = &stream[..];
            while !rest.is_empty() {
                rest = &rest[client.push(rest).unwrap().consumed..];
            }
            let check = mirror_check(client.mirror().recompute_hash());
            parts.0[last].2[12..16].copy_from_slice(&check.to_le_bytes());
        }
        parts
    }
}

fn is_frame(part: &Part) -> bool {
    matches!(part.0, kind::FRAME | kind::SLICES)
}

/// The frame packets that end a frame, by their place among all.
fn lasts(parts: &[Part]) -> Vec<usize> {
    let last = |at: &usize| is_frame(&parts[*at]) && parts[*at].1 & flag::LAST != 0;
    (0..parts.len()).filter(last).collect()
}

fn written(room: usize, write: impl FnOnce(&mut Writer<'_>)) -> Vec<u8> {
    let mut bytes = vec![0; room];
    let mut writer = Writer::new(&mut bytes);
    write(&mut writer);
    let length = writer.length();
    bytes.truncate(length);
    bytes
}

fn body(frame: &Frame, content: &[u8]) -> Vec<u8> {
    written(FRAME_HEADER_BYTES + content.len(), |w| {
        frame.write(w).unwrap();
        w.bytes(content).unwrap();
    })
}

fn varint(value: u32) -> Vec<u8> {
    written(5, |w| w.varint(value).unwrap())
}

/// The content of a frame packet.
fn packed(raw: &[u8]) -> Vec<u8> {
    [&(raw.len() as u32).to_le_bytes()[..], &zstd(raw)].concat()
}

/// A zstd frame by hand, of one raw block: no compressor's whims.
fn zstd(raw: &[u8]) -> Vec<u8> {
    let length = (raw.len() as u32).to_le_bytes();
    let block = (raw.len() as u32) << 3 | 1;
    let head = [0x28, 0xb5, 0x2f, 0xfd, 0xa0];
    [&head[..], &length, &block.to_le_bytes()[..3], raw].concat()
}

/// What one list of a frame packet's content has: gaps, and elements.
type List<'a, const N: usize> = &'a [(u32, [u32; N])];

fn content(instances: List<'_, 16>, buckets: List<'_, 8>, cells: List<'_, 8>) -> Vec<u8> {
    fn put<const N: usize>(list: List<'_, N>, out: &mut Vec<u32>) {
        out.extend(list.iter().map(|(gap, _)| gap));
        out.extend(list.iter().flat_map(|(_, words)| words));
    }
    let mut words = vec![instances.len(), buckets.len(), cells.len()]
        .into_iter()
        .map(|count| count as u32)
        .collect();
    put(instances, &mut words);
    put(buckets, &mut words);
    put(cells, &mut words);
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// An instance of 4 x 4 x 4 cells in 2 buckets.
fn grid() -> [u32; 16] {
    let instance = Instance {
        origin: [0.0; 3],
        radius: 0.8,
        cells_per_unit: [1.0; 3],
        bucket_first: 0,
        dims: [4; 3],
        bucket_count: 2,
        normal_scale: [1.0; 3],
        level: 0,
    };
    bytemuck::cast(instance)
}

/// A stream of 2 instances, 4 buckets and 8 cells, made by hand: a frame for each content.
fn by_hand(contents: &[Vec<u8>]) -> Parts {
    let header = Header {
        profile: Profile::Cells,
        capacity: Capacity {
            instances: 2,
            buckets: 4,
            cells: 8,
            ..Capacity::default()
        },
        max_body_bytes: 4096,
        max_raw_bytes: 4096,
        ..Header::default()
    };
    let mut parts = vec![(kind::HEADER, 0, written(256, |w| header.write(w).unwrap()))];
    for (number, raw) in (1..).zip(contents) {
        let frame = Frame {
            id: number,
            time_ns: 0,
            mirror_check: 0,
        };
        let flags = flag::LAST | if number == 1 { flag::SNAPSHOT } else { 0 };
        parts.push((kind::FRAME, flags, body(&frame, &packed(raw))));
    }
    parts.push((kind::END, 0, Vec::new()));
    Parts(parts)
}

/// The first item of a slices packet, which opens a slice.
struct Opening {
    index: u32,
    at: [u32; 3],
    shown: Vec<u8>,
    data: Vec<u8>,
}

impl Opening {
    /// The first of a stream, of whose slices this one has so many points.
    fn of(parts: &Parts, points: &dyn Fn(u32) -> u32) -> Opening {
        let packet = parts.0.iter().find(|part| part.0 == kind::SLICES).unwrap();
        let mut reader = Reader(&packet.2[FRAME_HEADER_BYTES..]);
        let head = reader.varint().unwrap();
        assert_eq!(head & 3, 2, "the first item opens a slice");
        let at = [(); 3].map(|()| reader.varint().unwrap());
        let blocks = points(head >> 2).div_ceil(16) as usize;
        let shown = reader.take(blocks.div_ceil(8)).unwrap().to_vec();
        let length = reader.varint().unwrap() as usize;
        Opening {
            index: head >> 2,
            at,
            shown,
            data: reader.take(length).unwrap().to_vec(),
        }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = varint(self.index << 2 | 2);
        for value in self.at {
            bytes.extend(varint(value));
        }
        bytes.extend(&self.shown);
        bytes.extend(varint(self.data.len() as u32));
        bytes.extend(&self.data);
        bytes
    }
}

const FORMAT: i32 = -23;
const DAMAGED: i32 = -22;

/// Everything that belongs in the folder, by file name.
pub fn derive(recorded: &Files) -> Files {
    let mut files = Files::new();
    let mut index = String::new();
    let mut clauses: BTreeMap<Vec<u32>, Vec<&str>> = BTreeMap::new();
    let invalid = invalid(recorded);
    let valid = valid(recorded, &invalid);
    for (name, of, first, bytes) in &valid {
        let first = first.map_or(("", Vec::new()), |first| {
            let found = invalid.iter().find(|(name, ..)| *name == first);
            let bytes = found.map_or_else(|| recorded[first].clone(), |found| found.3.clone());
            (first, bytes)
        });
        let (frames, resyncs, digest, lookups) = reference(bytes, &first.1);
        assert_eq!(frames > 0, !lookups.is_empty(), "{name}");
        let line = format!(
            "valid {of} {name} {frames} {resyncs} {digest:016x} {}",
            first.0
        );
        writeln!(index, "{}", line.trim_end()).unwrap();
        files.insert(format!("{name}.psao"), bytes.clone());
        if frames > 0 {
            files.insert(format!("{name}.lookups"), lookups.into_bytes());
        }
    }
    for (name, of, result, bytes) in &invalid {
        writeln!(index, "invalid {of} {name} {result}").unwrap();
        files.insert(format!("{name}.psao"), bytes.clone());
    }
    let valid = valid.iter().map(|(name, of, ..)| (name, of));
    let invalid = invalid.iter().map(|(name, of, ..)| (name, of));
    for (name, of) in valid.chain(invalid) {
        for clause in of.split(',') {
            let key = clause.split('.').map(|part| part.parse().unwrap());
            clauses.entry(key.collect()).or_default().push(name);
        }
    }
    let clauses: String = clauses
        .iter()
        .map(|(clause, names)| format!("{}.{} {}\n", clause[0], clause[1], names.join(" ")))
        .collect();
    files.insert("index.txt".into(), index.into_bytes());
    files.insert("clauses.txt".into(), clauses.into_bytes());
    files
}

/// A valid stream: name, clauses, the stream that the client was given before, bytes.
type Valid = (&'static str, &'static str, Option<&'static str>, Vec<u8>);

fn valid(recorded: &Files, invalid: &[Invalid]) -> Vec<Valid> {
    let (cells, residual) = (&recorded["cells"], &recorded["residual"]);
    let (parts, slices) = (Parts::of(cells).brief(5), Parts::of(residual));
    let optional = (200, flag::OPTIONAL, b"skip me".to_vec());
    let short = parts.stream();
    assert!(invalid.iter().any(|(name, ..)| *name == "frame-missing"));
    let used = grid();
    let point =
        |occlusion: u32| 0x8000_0000 | 16 << 26 | 16 << 21 | 16 << 16 | 0xee << 8 | occlusion;
    let mut unused = used;
    unused[11] = 0;
    unused[3] = 0xffff_ffff;
    // Behind the first empty entry and the first empty place there may be anything; a place that
    // was left is passed over.
    let bucket = [1, 3, 0, 2, 0, 0, 0, 0];
    let cell = [0, 1, point(40), 0, point(200), 0, 0, 0];
    let odd = content(
        &[(0, used), (0, unused)],
        &[(0, bucket)],
        &[
            (1, cell),
            (0, [1, point(90), 0, 0, 0, 0, 0, 0]),
            (0, [2, 5, 0, 0, 0, 0, 0, 0]),
        ],
    );
    vec![
        (
            "cells",
            "2.2,2.3,2.4,2.6,2.7,2.8,3.1,3.2,3.3,4.1,5.1,5.2,5.3,5.4,5.5,5.9,6.1,6.2,6.3,6.4,6.6,\
             7.1,7.2,7.3,7.4,7.5,7.6,7.7,7.8,7.9,7.10,8.1,8.2,8.3,9.8",
            None,
            cells.clone(),
        ),
        (
            "residual",
            "3.1,5.1,5.3,7.3,8.1,8.2,8.3,9.9,15.1,15.2,15.4,15.5,15.6,15.7,15.8,15.9,15.10,15.11,\
             15.12,15.13,15.14",
            None,
            residual.clone(),
        ),
        (
            "topology",
            "3.2,15.4,15.6,15.7",
            None,
            recorded["topology"].clone(),
        ),
        (
            "without-patches",
            "15.4",
            Some("topology"),
            recorded["without-patches"].clone(),
        ),
        (
            "levels",
            "7.4,15.3,15.5,15.8",
            None,
            recorded["levels"].clone(),
        ),
        (
            "reopen",
            "15.5,15.8,15.13",
            None,
            recorded["reopen"].clone(),
        ),
        (
            "presence",
            "7.4,15.5,15.8",
            None,
            recorded["presence"].clone(),
        ),
        ("budget", "2.6,15.13", None, recorded["budget"].clone()),
        (
            "cut-off",
            "2.5,3.3",
            None,
            short[..short.len() - 20].to_vec(),
        ),
        (
            "after-a-failure",
            "5.8,7.3",
            Some("frame-missing"),
            short.clone(),
        ),
        (
            "optional-kind",
            "2.9",
            None,
            parts.changed(|list| list.insert(1, optional)),
        ),
        (
            "newer-minor-version",
            "4.1,4.2,12.1",
            None,
            parts.changed(|list| {
                list[0].2[2] = 7;
                list[0].2.extend(b"fields of then");
            }),
        ),
        (
            "frame-without-content",
            "6.1",
            None,
            parts.with_body(kind::FRAME, flag::LAST, &[]).stream(),
        ),
        (
            "unused-entries-and-places",
            "7.4,7.6,7.7,7.8",
            None,
            by_hand(&[odd]).hashed().stream(),
        ),
        (
            "numbers-in-more-bytes",
            "15.2",
            None,
            slices.brief(3).changed(|list| {
                let packet = list.iter_mut().find(|part| part.0 == kind::SLICES).unwrap();
                let (frame, content) = Frame::read(&packet.2).unwrap();
                assert!(content[0] < 0x80);
                let longer = [&[content[0] | 0x80, 0x80, 0], &content[1..]].concat();
                packet.2 = body(&frame, &longer);
            }),
        ),
        (
            "patches-within-a-frame",
            "3.2,5.1,15.4",
            None,
            slices.brief(3).changed(|list| {
                let patches = list
                    .iter()
                    .position(|part| part.0 == kind::PATCHES)
                    .unwrap();
                let patches = list.remove(patches);
                let first = list.iter().position(is_frame).unwrap();
                assert!(list[first].0 == kind::FRAME && list[first].1 & flag::LAST == 0);
                list.insert(first + 1, patches);
            }),
        ),
        (
            "wrong-hash-withholds",
            "5.6,5.7",
            None,
            Parts::of(cells).changed(|list| {
                let last = lasts(list)[2];
                list[last].2[12] ^= 1;
            }),
        ),
        (
            "nothing-before-a-snapshot",
            "5.6",
            None,
            // The first frame goes, and with it the snapshot; a later one begins anew.
            slices.changed(|list| {
                let first = list.iter().position(is_frame).unwrap();
                let end = lasts(list)[0];
                list.drain(first..=end);
            }),
        ),
    ]
}

/// An invalid stream: name, clauses, the psao_result that ends it, bytes.
type Invalid = (&'static str, &'static str, i32, Vec<u8>);

fn invalid(recorded: &Files) -> Vec<Invalid> {
    let mut list = broken_packets(&Parts::of(&recorded["cells"]).brief(3));
    list.extend(broken_contents());
    list.extend(broken_slices(&Parts::of(&recorded["residual"]).brief(1)));
    list
}

/// Packets, header and frames: sections 2 to 5.
fn broken_packets(parts: &Parts) -> Vec<Invalid> {
    let whole = parts.stream();
    let raw = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = whole.clone();
        change(&mut bytes);
        bytes
    };
    let header_at = PREAMBLE.len();
    let body_at = header_at + PACKET_HEADER_BYTES;
    let header = |at: usize, bytes: &[u8]| {
        parts.changed(|list| list[0].2[at..at + bytes.len()].copy_from_slice(bytes))
    };
    let refusal = |reason: u16| {
        let body = [&reason.to_le_bytes()[..], b"words"].concat();
        Parts(vec![(kind::REFUSE, 0, body)])
    };
    let insert = |at: usize, part: Part| parts.changed(|list| list.insert(at, part));
    let first = parts.0.iter().position(is_frame).unwrap();
    let frame = |at: usize, change: &dyn Fn(&mut Part)| parts.changed(|list| change(&mut list[at]));
    let last = lasts(&parts.0)[1];
    // A second packet for the first frame: its content changes nothing.
    let goes_on = |change: &dyn Fn(&mut Part)| {
        parts.changed(|list| {
            let mut second = list[first].clone();
            second.1 = flag::LAST;
            second.2.truncate(FRAME_HEADER_BYTES);
            second.2[16..].fill(0);
            list[first].1 &= !flag::LAST;
            list[first].2[12..16].fill(0);
            change(&mut second);
            list.insert(first + 1, second);
        })
    };
    assert_eq!(parts.0[first].1, flag::SNAPSHOT | flag::LAST);
    let mut list = vec![
        ("not-a-stream", "2.2", -20, raw(&|bytes| bytes[0] ^= 1)),
        (
            "body-changed",
            "2.8",
            DAMAGED,
            raw(&|bytes| bytes[body_at + 40] ^= 4),
        ),
        (
            "checksum-changed",
            "2.8",
            DAMAGED,
            raw(&|bytes| bytes[header_at + 8] ^= 1),
        ),
        (
            "sequence-and-damaged",
            "2.7,2.10",
            DAMAGED,
            raw(&|bytes| bytes[header_at + 2] = 1),
        ),
        (
            "packet-too-large",
            "2.4",
            FORMAT,
            raw(&|bytes| bytes[header_at + 6] = 1),
        ),
        (
            "packet-missing",
            "2.7",
            DAMAGED,
            raw(&|bytes| {
                // The second packet goes, the others keep their numbers.
                let length = |at: usize| PACKET_HEADER_BYTES + parts.0[at].2.len();
                let second = PREAMBLE.len() + length(0);
                bytes.drain(second..second + length(1));
            }),
        ),
        (
            "reserved-flag",
            "2.6",
            FORMAT,
            frame(first, &|part| part.1 |= 4),
        ),
        (
            "flag-of-another-kind",
            "2.6",
            FORMAT,
            frame(0, &|part| part.1 = flag::LAST),
        ),
        (
            "unknown-kind",
            "2.9",
            FORMAT,
            insert(1, (60, 0, Vec::new())),
        ),
        ("uplink-kind", "3.1", FORMAT, insert(1, (65, 0, Vec::new()))),
        (
            "slices-in-profile-cells",
            "3.1,3.2",
            FORMAT,
            insert(1, (kind::SLICES, 0, vec![0; 24])),
        ),
        (
            "patches-in-profile-cells",
            "3.1,3.2",
            FORMAT,
            insert(1, (kind::PATCHES, 0, Vec::new())),
        ),
        (
            "frame-before-the-header",
            "3.2",
            FORMAT,
            insert(0, parts.0[first].clone()),
        ),
        (
            "second-header",
            "3.2",
            FORMAT,
            insert(1, parts.0[0].clone()),
        ),
        (
            "refusal-after-the-header",
            "3.2",
            FORMAT,
            insert(1, refusal(1).0[0].clone()),
        ),
        (
            "byte-after-the-end",
            "3.2",
            FORMAT,
            raw(&|bytes| bytes.push(0)),
        ),
        (
            "end-with-a-body",
            "3.1",
            FORMAT,
            frame(parts.0.len() - 1, &|part| part.2.push(0)),
        ),
        (
            "end-within-a-frame",
            "3.3",
            FORMAT,
            parts.changed(|list| {
                list[last].1 &= !flag::LAST;
                list[last].2[12..16].fill(0);
                list.drain(last + 1..list.len() - 1);
            }),
        ),
        ("another-version", "4.2", -21, header(0, &[2])),
        ("unknown-profile", "4.1,12.3", -21, header(4, &[9])),
        ("unknown-kernel", "4.1,12.3", FORMAT, header(5, &[9])),
        ("other-cells", "4.1", FORMAT, header(6, &[8])),
        ("other-buckets", "4.1", FORMAT, header(7, &[4])),
        (
            "body-limit-too-small",
            "4.1",
            FORMAT,
            header(28, &63u32.to_le_bytes()),
        ),
        (
            "content-limit-too-large",
            "4.1",
            FORMAT,
            header(32, &[1, 0, 64, 0]),
        ),
        (
            "distance-not-finite",
            "4.1",
            FORMAT,
            header(36, &f32::NAN.to_le_bytes()),
        ),
        (
            "rate-below-zero",
            "4.1",
            FORMAT,
            header(44, &(-1f32).to_le_bytes()),
        ),
        ("reserved-in-header", "4.1", FORMAT, header(50, &[1])),
        (
            "slices-announced-in-profile-cells",
            "4.1",
            FORMAT,
            header(52, &[1]),
        ),
        (
            "short-header",
            "4.2",
            FORMAT,
            frame(0, &|part| part.2.truncate(75)),
        ),
        (
            "short-frame",
            "5.1",
            FORMAT,
            frame(first, &|part| part.2.truncate(23)),
        ),
        (
            "content-over-the-limit",
            "5.1",
            FORMAT,
            frame(first, &|part| part.2[23] = 1),
        ),
        (
            "frame-missing",
            "5.2",
            FORMAT,
            parts.changed(|list| {
                let ends = lasts(list);
                list.drain(ends[0] + 1..=ends[1]);
            }),
        ),
        (
            "another-frame-between",
            "5.2,5.4",
            FORMAT,
            goes_on(&|part| part.2[0] += 1),
        ),
        (
            "another-time-in-a-frame",
            "5.2",
            FORMAT,
            goes_on(&|part| part.2[4] ^= 1),
        ),
        (
            "snapshot-within-a-frame",
            "5.3",
            FORMAT,
            goes_on(&|part| part.1 |= flag::SNAPSHOT),
        ),
        (
            "hash-before-the-last",
            "5.5",
            FORMAT,
            frame(first, &|part| part.1 = flag::SNAPSHOT),
        ),
        (
            "refused-for-an-unknown-reason",
            "3.4",
            -30,
            refusal(999).stream(),
        ),
    ];
    let reasons = [
        ("refused-token", Refusal::Token, -31),
        ("refused-scene", Refusal::Scene, -32),
        ("refused-version", Refusal::Version, -33),
        ("refused-capacity", Refusal::Capacity, -34),
        ("refused-full", Refusal::Full, -35),
        ("refused-malformed", Refusal::Malformed, -36),
    ];
    list.extend(
        reasons
            .map(|(name, reason, result)| (name, "3.4", result, refusal(reason as u16).stream())),
    );
    list
}

/// Contents of frame packets: sections 6 and 7.
fn broken_contents() -> Vec<Invalid> {
    let good = content(&[(0, grid())], &[], &[]);
    let packed = zstd(&good);
    let as_is = |bytes: &[u8]| {
        by_hand(std::slice::from_ref(&good)).changed(|list| {
            list[1].2.truncate(FRAME_HEADER_BYTES + 4);
            list[1].2.extend(bytes);
        })
    };
    let stream = |raw: Vec<u8>| by_hand(&[raw]).stream();
    let cells = |list: List<'_, 8>| stream(content(&[], &[], list));
    let buckets = |list: List<'_, 8>| stream(content(&[], list, &[]));
    let instance = |word: usize, value: u32| {
        let mut words = grid();
        words[word] = value;
        stream(content(&[(0, words)], &[], &[]))
    };
    let skippable = [0x50, 0x2a, 0x4d, 0x18, 0, 0, 0, 0];
    let half = packed.len() / 2;
    vec![
        (
            "content-is-no-zstd-frame",
            "6.1",
            FORMAT,
            as_is(&[0xff; 40]),
        ),
        ("content-cut-off", "6.1", FORMAT, as_is(&packed[..half])),
        (
            "two-zstd-frames",
            "6.1",
            FORMAT,
            as_is(&[&packed[..], &packed].concat()),
        ),
        (
            "skippable-frame",
            "6.1",
            FORMAT,
            as_is(&[&skippable[..], &packed].concat()),
        ),
        (
            "bytes-behind-the-zstd-frame",
            "6.1",
            FORMAT,
            as_is(&[&packed[..], &[0]].concat()),
        ),
        (
            "content-of-another-length",
            "6.1",
            FORMAT,
            as_is(&zstd(&good[4..])),
        ),
        (
            "content-of-no-bytes",
            "6.1",
            FORMAT,
            by_hand(std::slice::from_ref(&good))
                .changed(|list| list[1].2[FRAME_HEADER_BYTES..][..4].fill(0)),
        ),
        (
            "content-too-short",
            "6.2",
            FORMAT,
            stream(good[..good.len() - 4].to_vec()),
        ),
        (
            "content-too-long",
            "6.2",
            FORMAT,
            stream([&good[..], &[0; 4]].concat()),
        ),
        (
            "count-beyond-the-content",
            "6.2",
            FORMAT,
            stream([[0xff; 12], [0; 12]].concat()),
        ),
        (
            "gap-beyond-all-indices",
            "6.3",
            FORMAT,
            cells(&[(1, [0; 8]), (u32::MAX, [0; 8])]),
        ),
        ("cell-0", "6.4", FORMAT, cells(&[(0, [0; 8])])),
        ("cell-index", "6.4", FORMAT, cells(&[(8, [0; 8])])),
        ("bucket-index", "6.4", FORMAT, buckets(&[(4, [0; 8])])),
        (
            "instance-index",
            "6.4",
            FORMAT,
            stream(content(&[(2, grid())], &[], &[])),
        ),
        (
            "bucket-names-no-cell",
            "6.4,7.6",
            FORMAT,
            buckets(&[(0, [8, 0, 0, 0, 0, 0, 0, 0])]),
        ),
        (
            "origin-not-finite",
            "7.4",
            FORMAT,
            instance(1, f32::INFINITY.to_bits()),
        ),
        ("radius-zero", "7.4", FORMAT, instance(3, 0)),
        (
            "cells-per-unit-below-zero",
            "7.4",
            FORMAT,
            instance(5, (-1f32).to_bits()),
        ),
        ("buckets-beyond-the-buffer", "7.4", FORMAT, instance(7, 3)),
        (
            "buckets-around-the-buffer",
            "7.4",
            FORMAT,
            instance(7, u32::MAX),
        ),
        ("grid-without-cells", "7.4", FORMAT, instance(9, 0)),
        (
            "grid-too-long",
            "7.4,7.5",
            FORMAT,
            instance(10, (1 << 20) + 1),
        ),
        ("normal-scale-zero", "7.4,7.10", FORMAT, instance(14, 0)),
        ("level-4", "7.4", FORMAT, instance(15, 4)),
    ]
}

/// Patches and slices: section 15. `parts`: one frame, which opens slices.
fn broken_slices(parts: &Parts) -> Vec<Invalid> {
    let mut client = client();
    let whole = parts.stream();
    let pushed = client.push(&whole).unwrap();
    assert!(pushed.frame.is_some());
    let room = client.header().unwrap().capacity;
    let kept = client.slices().get();
    let opening = Opening::of(parts, &|index| kept[index as usize].point_count);
    let index = opening.index;
    let head = |operation: u32| varint(index << 2 | operation);
    let slices = |content: &[u8]| parts.with(kind::SLICES, content).stream();
    let closed = parts.with(kind::SLICES, &head(3));
    // After the slice was closed, opened again otherwise.
    let again = |change: &dyn Fn(&mut Opening)| {
        let mut opening = Opening::of(parts, &|index| kept[index as usize].point_count);
        change(&mut opening);
        closed.with(kind::SLICES, &opening.bytes()).stream()
    };
    let used = (0..)
        .zip(kept)
        .find(|(at, slice)| *at != index && slice.point_count > 0);
    let other_first = used.unwrap().1.point_first;
    let blocks = kept[index as usize].point_count.div_ceil(16);
    assert!(!blocks.is_multiple_of(8), "the slice has a bit to spare");
    let header = |at: usize, bytes: &[u8]| {
        parts.changed(|list| list[0].2[at..at + bytes.len()].copy_from_slice(bytes))
    };
    let at = parts
        .0
        .iter()
        .position(|part| part.0 == kind::PATCHES)
        .unwrap();
    let mut reader = Reader(&parts.0[at].2);
    let (patch, length) = (reader.varint().unwrap(), reader.varint().unwrap() as usize);
    let (data, rest) = (reader.0[..length].to_vec(), reader.0[length..].to_vec());
    let item =
        |index: u32, data: &[u8]| [&varint(index), &varint(data.len() as u32), data].concat();
    // Another data for the first patch, and a byte of room for it.
    let patched = |data: &[u8]| {
        parts.changed(|list| {
            let bytes = room.topology_bytes + 1;
            list[0].2[64..68].copy_from_slice(&bytes.to_le_bytes());
            list[at].2 = [&item(patch, data), &rest[..]].concat();
        })
    };
    let more = |body: Vec<u8>| parts.changed(|list| list.insert(at + 1, (kind::PATCHES, 0, body)));
    let words: &[[u32; 16]] = bytemuck::cast_slice(client.mirror().instances());
    let instance = opening.at[0];
    let frame = |raw: &[u8]| parts.with_body(kind::FRAME, 0, &packed(raw)).stream();
    let changed = content(&[(instance, words[instance as usize])], &[], &[]);
    let item_bytes = opening.bytes();
    let shown = [&head(1)[..], &vec![0xff; opening.shown.len()], &[0]].concat();
    vec![
        ("step-zero", "4.1", FORMAT, header(49, &[0])),
        (
            "coarse-patches",
            "2.6",
            FORMAT,
            parts.changed(|list| list[at].1 = 4),
        ),
        (
            "too-many-cells-for-slices",
            "4.1",
            FORMAT,
            header(24, &0x2000_0001u32.to_le_bytes()),
        ),
        (
            "cells-in-profile-residual",
            "6.2",
            FORMAT,
            frame(&content(&[], &[], &[(1, [0; 8])])),
        ),
        (
            "instance-of-an-open-slice",
            "6.4,15.5",
            FORMAT,
            frame(&changed),
        ),
        ("number-of-six-bytes", "15.2", FORMAT, slices(&[0x80; 6])),
        (
            "number-too-large",
            "15.2",
            FORMAT,
            slices(&[0xff, 0xff, 0xff, 0xff, 0x1f]),
        ),
        (
            "patch-index",
            "15.4",
            FORMAT,
            more(item(room.patches, &[1])),
        ),
        ("patch-without-data", "15.4", FORMAT, more(item(patch, &[]))),
        (
            "patch-with-other-data",
            "15.4",
            FORMAT,
            more(item(patch, &data[1..])),
        ),
        (
            "patch-cut-off",
            "15.4",
            FORMAT,
            more(item(patch, &data)[..20].to_vec()),
        ),
        (
            "topology-full",
            "15.4",
            FORMAT,
            header(64, &(room.topology_bytes - 1).to_le_bytes()),
        ),
        (
            "patch-of-no-points",
            "15.6",
            FORMAT,
            patched(&vec![0; length]),
        ),
        (
            "patch-goes-on",
            "15.6,15.9",
            FORMAT,
            patched(&[&data[..], &[0]].concat()),
        ),
        (
            "slice-index",
            "15.5",
            FORMAT,
            slices(&varint(room.slices << 2 | 3)),
        ),
        ("open-of-an-open-slice", "15.5", FORMAT, slices(&item_bytes)),
        (
            "close-of-a-closed-slice",
            "15.5",
            FORMAT,
            closed.with(kind::SLICES, &head(3)).stream(),
        ),
        ("item-cut-off", "15.5", FORMAT, {
            let short = &item_bytes[..item_bytes.len() - 1];
            closed.with(kind::SLICES, short).stream()
        }),
        (
            "open-on-no-instance",
            "15.5",
            FORMAT,
            again(&|item| item.at[0] = room.instances),
        ),
        (
            "open-without-a-patch",
            "15.5",
            FORMAT,
            again(&|item| item.at[1] = room.patches),
        ),
        (
            "points-beyond-the-room",
            "15.5",
            FORMAT,
            again(&|item| item.at[2] = room.points),
        ),
        (
            "points-of-another-slice",
            "15.5",
            FORMAT,
            again(&|item| item.at[2] = other_first),
        ),
        ("shown-without-a-block", "15.8", FORMAT, slices(&shown)),
        (
            "slice-goes-on",
            "15.9",
            FORMAT,
            again(&|item| item.data.push(0)),
        ),
        (
            "slice-data-cut-off",
            "15.9",
            FORMAT,
            again(&|item| item.data.truncate(item.data.len() - 1)),
        ),
        (
            "slice-data-of-no-run",
            "15.9",
            FORMAT,
            again(&|item| item.data.fill(0xff)),
        ),
    ]
}

fn client() -> Client {
    let all = u32::MAX;
    Client::new(Config {
        capacity: Capacity {
            instances: all,
            buckets: all,
            cells: all,
            slices: all,
            points: all,
            patches: all,
            topology_bytes: all,
        },
        scene_hash: 0,
    })
}

/// What the Rust client makes of a valid stream, after another one or none: frames, resyncs,
/// digest, and lookups at the end.
fn reference(bytes: &[u8], before: &[u8]) -> (u32, u64, u64, String) {
    let mut client = client();
    let mut rest = before;
    while let Ok(pushed) = client.push(rest)
        && !rest.is_empty()
    {
        rest = &rest[pushed.consumed..];
    }
    client.restart();
    let resyncs = client.stats().mismatches;
    let (mut frames, mut digest, mut lookups) = (0, 14695981039346656037u64, String::new());
    let mut rest = bytes;
    while !rest.is_empty() {
        let pushed = client.push(rest).unwrap();
        rest = &rest[pushed.consumed..];
        if pushed.frame.is_none() {
            continue;
        }
        frames += 1;
        let mirror = client.mirror();
        let mut mix = |bytes: &[u8]| {
            for word in bytes.as_chunks::<8>().0 {
                digest = (digest ^ u64::from_le_bytes(*word)).wrapping_mul(1099511628211);
            }
        };
        mix(bytemuck::cast_slice(mirror.instances()));
        mix(bytemuck::cast_slice(mirror.buckets()));
        mix(bytemuck::cast_slice(mirror.cells()));
        lookups = looked_up(mirror.lookup(), client.header().unwrap().kernel);
    }
    (frames, client.stats().mismatches - resyncs, digest, lookups)
}

/// A few positions in every instance, from side to side of its grid.
fn looked_up(lookup: Lookup<'_>, kernel: psao::core::Kernel) -> String {
    let mut out = String::new();
    for (instance, grid) in (0..).zip(lookup.instances) {
        for step in 0..64u8 {
            let part = |bits: u32| f32::from(step >> bits & 3) * 0.3 + 0.05;
            let position: [f32; 3] = std::array::from_fn(|axis| {
                let length = grid.dims[axis] as f32 / grid.cells_per_unit[axis].max(1e-9);
                grid.origin[axis] + part(2 * axis as u32) * length
            });
            let normal = [0.3, 0.9, 0.1];
            let answer = lookup.blend(kernel, instance, position, normal);
            if answer.fetched > 0 {
                let [x, y, z] = position;
                let openness = answer.openness;
                writeln!(out, "{instance} {x:e} {y:e} {z:e} 0.3 0.9 0.1 {openness}").unwrap();
            }
        }
    }
    out
}
