//! What the fuzz targets do with an input, also called by `tests/conformance.rs` without a fuzzer.

use psao::core::mirror::Capacity;
use psao::core::residual::{Neighbours, SliceState, decode_slice, find_neighbours};
use psao::core::stream::{
    Header, PACKET_HEADER_BYTES, PREAMBLE, Packet, Profile, kind, write_packet,
};
use psao::core::topology::{PATCH_POINTS, PatchPoint, decode_patch};
use psao::core::uplink::{MAX_UPLINK_BODY_BYTES, Message};
use psao::{Client, Config};

/// What a stream may ask for in [`push`], and the memory that is enough for it.
const CAPACITY: Capacity = Capacity {
    instances: 256,
    buckets: 1 << 14,
    cells: 1 << 15,
    slices: 1 << 10,
    points: 1 << 16,
    patches: 1 << 10,
    topology_bytes: 1 << 20,
};
const MOST_BYTES: u64 = 16 << 20;

/// The room of [`packets`].
const SMALL: Capacity = Capacity {
    instances: 4,
    buckets: 64,
    cells: 64,
    slices: 8,
    points: 2048,
    patches: 4,
    topology_bytes: 4096,
};

/// Any bytes, in any portions: no panic, and no memory beyond what was allowed.
pub fn push(data: &[u8]) {
    let Some((&portion, mut rest)) = data.split_first() else {
        return;
    };
    let mut client = Client::new(Config {
        capacity: CAPACITY,
        scene_hash: 0,
    });
    let portion = usize::from(portion).max(1) * 16;
    while !rest.is_empty() {
        let piece = &rest[..portion.min(rest.len())];
        let Ok(pushed) = client.push(piece) else {
            break;
        };
        assert!(pushed.consumed > 0);
        rest = &rest[pushed.consumed..];
    }
    assert!(client.memory_bytes() < MOST_BYTES);
}

/// Bodies of packets behind right lengths, sequences and checksums, so that what lies behind those
/// is reached: input is a kind, flags and a length, then so many bytes of the body, and so on.
pub fn packets(data: &[u8]) {
    let mut client = Client::new(Config {
        capacity: SMALL,
        scene_hash: 0,
    });
    let header = Header {
        profile: Profile::Residual,
        capacity: SMALL,
        step: 3,
        max_body_bytes: 1 << 16,
        max_raw_bytes: 1 << 16,
        ..Header::default()
    };
    let mut bytes = vec![0; 256];
    let length = write_packet(&mut bytes, kind::HEADER, 0, 0, |w| header.write(w)).unwrap();
    client.push(&PREAMBLE).unwrap();
    client.push(&bytes[..length]).unwrap();
    let mut rest = data;
    let mut sequence = 1;
    while let [kind, flags, low, high, body @ ..] = rest {
        let length = usize::from(u16::from_le_bytes([*low, *high])).min(body.len());
        let (body, after) = body.split_at(length);
        rest = after;
        bytes.resize(PACKET_HEADER_BYTES + body.len(), 0);
        write_packet(&mut bytes, *kind, *flags, sequence, |w| w.bytes(body)).unwrap();
        sequence += 1;
        if client.push(&bytes).is_err() {
            break;
        }
    }
    assert_eq!(client.mirror().hash(), client.mirror().recompute_hash());
}

/// Range-coded data: a patch's points, then a slice over them.
pub fn range_coder(data: &[u8]) {
    let [first, step, low, high, rest @ ..] = data else {
        return;
    };
    let length = usize::from(u16::from_le_bytes([*low, *high])).min(rest.len());
    let (patch, slice) = rest.split_at(length);
    let mut points = vec![PatchPoint::default(); PATCH_POINTS];
    // Where the patch is none, a slice over points that are all in one place.
    let count = decode_patch(patch, &mut points).unwrap_or(100);
    let first = first & 1 != 0;
    let mut neighbours = vec![Neighbours::default(); count];
    find_neighbours(&points[..count], &mut neighbours);
    let (mut value, mut last) = (vec![255; count], vec![0; count]);
    let mut state = SliceState {
        value: &mut value,
        last: &mut last,
    };
    let _ = decode_slice(&neighbours, (*step).max(1), &mut state, first, slice);
}

/// What a client may send to a server.
pub fn uplink(data: &[u8]) {
    if let [kind, flags, body @ ..] = data {
        let packet = Packet {
            kind: *kind,
            flags: *flags,
            sequence: 0,
            body,
        };
        let _ = Message::read(&packet);
    }
    let _ = Packet::read(data, MAX_UPLINK_BODY_BYTES);
}
