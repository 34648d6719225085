//! Streams that any reader must treat alike, with what it must make of them: made from recordings
//! by taking them apart.

use psao::core::Lookup;
use psao::core::mirror::Capacity;
use psao::core::stream::{
    FRAME_HEADER_BYTES, PACKET_HEADER_BYTES, PREAMBLE, Packet, Refusal, flag, kind, write_packet,
};
use psao::{Client, Config};
use std::fmt::Write;
use std::path::Path;

/// A stream's packets, to change.
#[derive(Clone)]
struct Parts(Vec<(u8, u8, Vec<u8>)>);

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

    fn changed(&self, change: impl FnOnce(&mut Vec<(u8, u8, Vec<u8>)>)) -> Vec<u8> {
        let mut parts = self.clone();
        change(&mut parts.0);
        parts.stream()
    }
}

fn is_frame(part: &(u8, u8, Vec<u8>)) -> bool {
    matches!(part.0, kind::FRAME | kind::SLICES)
}

/// The frame packets that end a frame, by their place among all.
fn lasts(parts: &[(u8, u8, Vec<u8>)]) -> Vec<usize> {
    let last = |at: &usize| is_frame(&parts[*at]) && parts[*at].1 & flag::LAST != 0;
    (0..parts.len()).filter(last).collect()
}

/// Writes the streams and their index into a folder. `samples`: a recording of each profile.
/// Returns how many bytes the streams have.
pub fn write(folder: &Path, samples: &[Vec<u8>; 2]) -> u64 {
    let _ = std::fs::remove_dir_all(folder);
    std::fs::create_dir_all(folder).unwrap();
    let [cells, residual] = samples;
    let (parts, slices) = (Parts::of(cells), Parts::of(residual));
    let mut index = String::new();
    let mut total = 0;
    let mut put = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.join(format!("{name}.psao")), bytes).unwrap();
        total += bytes.len() as u64;
    };

    let optional = (200, flag::OPTIONAL, b"skip me".to_vec());
    let valid: [(&str, &str, Vec<u8>); 6] = [
        ("cells", "5,6,7,8", cells.clone()),
        ("residual", "15", residual.clone()),
        ("cut-off", "2.5,3.3", cells[..cells.len() - 20].to_vec()),
        (
            "optional-kind",
            "2.9",
            parts.changed(|list| list.insert(1, optional)),
        ),
        (
            "wrong-hash-withholds",
            "5.7",
            parts.changed(|list| {
                let last = lasts(list)[4];
                list[last].2[12] ^= 1;
            }),
        ),
        (
            "no-snapshot-shows-nothing-until-one",
            "5.6",
            // The first frames go; the next one's packets are numbered on from any.
            slices.changed(|list| {
                let again: Vec<_> = list.iter().filter(|part| is_frame(part)).cloned().collect();
                let first = lasts(list)[0] + 1;
                let end = list.len() - 1;
                let count = lasts(list).len() as u32;
                let mut again = again;
                for part in &mut again {
                    let id = u32::from_le_bytes(part.2[..4].try_into().unwrap()) + count;
                    part.2[..4].copy_from_slice(&id.to_le_bytes());
                }
                list.splice(end..end, again);
                // Packets before the first frame, patches among them, stay.
                let keep = list.iter().position(is_frame).unwrap();
                list.drain(keep..first);
            }),
        ),
    ];
    for (name, clauses, bytes) in &valid {
        put(name, bytes);
        let (frames, resyncs, digest, lookups) = reference(bytes);
        assert!(frames > 0, "{name} is meant to show something");
        writeln!(
            index,
            "valid {clauses} {name} {frames} {resyncs} {digest:016x}"
        )
        .unwrap();
        std::fs::write(folder.join(format!("{name}.lookups")), lookups).unwrap();
    }

    let raw = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = cells.clone();
        change(&mut bytes);
        bytes
    };
    let header_at = PREAMBLE.len();
    let body_at = header_at + PACKET_HEADER_BYTES;
    let header = |at: usize, value: u8| parts.changed(|list| list[0].2[at] = value);
    let refusal = |reason: u16| {
        let body = [&reason.to_le_bytes()[..], b"words"].concat();
        Parts(vec![(kind::REFUSE, 0, body)]).stream()
    };
    let invalid: [(&str, &str, i32, Vec<u8>); 17] = [
        ("not-a-stream", "2.2", -20, raw(&|bytes| bytes[0] ^= 1)),
        ("another-version", "4.2", -21, header(0, 2)),
        ("unknown-profile", "4.1", -21, header(4, 9)),
        ("unknown-kernel", "4.1", -23, header(5, 9)),
        (
            "body-changed",
            "2.8",
            -22,
            raw(&|bytes| bytes[body_at + 40] ^= 4),
        ),
        (
            "checksum-changed",
            "2.8",
            -22,
            raw(&|bytes| bytes[header_at + 12] ^= 1),
        ),
        (
            "packet-missing",
            "2.7",
            -22,
            raw(&|bytes| {
                // The second packet goes, the others keep their numbers.
                let length = |at: usize| PACKET_HEADER_BYTES + parts.0[at].2.len();
                let second = PREAMBLE.len() + length(0);
                bytes.drain(second..second + length(1));
            }),
        ),
        (
            "packet-too-large",
            "2.4",
            -23,
            raw(&|bytes| bytes[header_at + 6] = 1),
        ),
        (
            "unknown-kind",
            "2.9",
            -23,
            parts.changed(|list| list.insert(1, (60, 0, Vec::new()))),
        ),
        (
            "uplink-kind",
            "3.1",
            -23,
            parts.changed(|list| list.insert(1, (65, 0, Vec::new()))),
        ),
        (
            "second-header",
            "3.2",
            -23,
            parts.changed(|list| list.insert(1, list[0].clone())),
        ),
        (
            "byte-after-the-end",
            "3.2",
            -23,
            raw(&|bytes| bytes.push(0)),
        ),
        (
            "reserved-flag",
            "2.6",
            -23,
            parts.changed(|list| {
                let frame = lasts(list)[0];
                list[frame].1 |= 4;
            }),
        ),
        (
            "frame-missing",
            "5.2",
            -23,
            parts.changed(|list| {
                let ends = lasts(list);
                list.drain(ends[1] + 1..=ends[2]);
            }),
        ),
        (
            "content-is-no-zstd-frame",
            "6.1",
            -23,
            parts.changed(|list| {
                let frame = list.iter().position(is_frame).unwrap();
                list[frame].2[FRAME_HEADER_BYTES] ^= 0xff;
            }),
        ),
        ("refused-token", "3.4", -31, refusal(Refusal::Token as u16)),
        ("refused-for-an-unknown-reason", "3.4", -30, refusal(999)),
    ];
    for (name, clauses, result, bytes) in &invalid {
        put(name, bytes);
        writeln!(index, "invalid {clauses} {name} {result}").unwrap();
    }
    std::fs::write(folder.join("index.txt"), index).unwrap();
    total
}

/// What the Rust client makes of a valid stream: frames, resyncs, digest, and lookups at the end.
fn reference(bytes: &[u8]) -> (u32, u64, u64, String) {
    let all = u32::MAX;
    let mut client = Client::new(Config {
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
    });
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
    (frames, client.stats().mismatches, digest, lookups)
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
