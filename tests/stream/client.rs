//! The client's memory, its way back after a wrong mirror, and damage at large.

use crate::samples::{
    Hand, Random, Readers, SERVED, agreed, bucket, by_hand, cell, config, content, contents, grid,
    mend, packets, read, zstd,
};
use crate::slices::slices_header;
use psao::core::mirror::Capacity;
use psao::core::stream::{
    self, Header, MAX_BODY_BYTES, MAX_RAW_BYTES, PACKET_HEADER_BYTES, PREAMBLE, StreamError, flag,
    kind,
};
use psao::{Client, ClientError, State};

/// What a client may hold at most: its mirror, what it keeps of slices, one packet and one content,
/// and zstd's own state.
pub fn most_bytes(room: Capacity) -> u64 {
    let packet = PACKET_HEADER_BYTES as u64 + u64::from(MAX_BODY_BYTES);
    let beside = psao::memory::SliceHeap::new(room).bytes();
    room.bytes() + beside + packet + u64::from(MAX_RAW_BYTES) + (256 << 10)
}

#[test]
fn no_length_field_takes_memory_beyond_what_the_client_allowed() {
    // [1.5, 2.4, 4.3, 4.5]
    let room = slices_header().capacity;
    let push = |bytes: &[u8]| {
        let mut client = Client::new(config(room));
        let result = client.push(bytes).map(|_| ());
        (client.memory_bytes(), result)
    };
    for (field, value) in [
        (16, u32::MAX),
        (20, u32::MAX),
        (24, u32::MAX),
        (24, 1 << 28),
    ] {
        let mut bytes = Hand::new().bytes;
        let at = PREAMBLE.len() + PACKET_HEADER_BYTES + field;
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        mend(&mut bytes);
        let (memory, result) = push(&bytes);
        assert!(
            matches!(result, Err(ClientError::Capacity(_))),
            "{result:?}"
        );
        assert!(memory < 256 << 10, "{memory} bytes");
    }
    // What profile `residual` keeps beside the mirror.
    type Ask = fn(&mut Capacity, u32);
    let asks: [Ask; 4] = [
        |capacity, count| capacity.slices = count,
        |capacity, count| capacity.points = count,
        |capacity, count| capacity.patches = count,
        |capacity, count| capacity.topology_bytes = count,
    ];
    for ask in asks {
        for count in [10_000, u32::MAX] {
            let mut header = slices_header();
            ask(&mut header.capacity, count);
            let (memory, result) = push(&Hand::with(&header).bytes);
            assert_eq!(result, Err(ClientError::Capacity(header.capacity)));
            assert!(memory < 256 << 10, "{memory} bytes");
        }
    }
    // More cells than places can be numbered [4.1], which no room makes good.
    for cells in [1 << 29, (1 << 29) + 1, u32::MAX] {
        let mut header = slices_header();
        header.capacity.cells = cells;
        let without_slices = Capacity {
            cells,
            ..Hand::ROOM
        };
        let error = agreed(&Hand::with(&header).bytes, without_slices).error;
        let expected = match cells {
            0x2000_0000 => ClientError::Capacity(header.capacity),
            _ => StreamError::Value.into(),
        };
        assert_eq!(error, Some(expected), "{cells} cells");
    }
    // The largest limits that a header may ask for.
    let header = Header {
        step: 255,
        max_body_bytes: MAX_BODY_BYTES,
        max_raw_bytes: MAX_RAW_BYTES,
        ..slices_header()
    };
    let hand = Hand::with(&header);
    let (memory, result) = push(&hand.bytes);
    assert!(
        result.is_ok() && memory <= most_bytes(room),
        "{memory} bytes"
    );
    for (before, size) in [
        (Hand::bare(), 4097),
        (Hand::bare(), u32::MAX),
        (Hand::new(), 4097),
        (hand.clone(), MAX_BODY_BYTES + 1),
        (hand.clone(), u32::MAX),
    ] {
        let mut bytes = before.bytes;
        bytes.extend([kind::FRAME, 0, 0, 0]);
        bytes.extend(size.to_le_bytes());
        bytes.extend([0; 8]);
        let (memory, result) = push(&bytes);
        assert_eq!(result, Err(StreamError::PacketTooLarge(size).into()));
        assert!(memory <= most_bytes(room), "{memory} bytes");
    }
    for counts in [
        [u32::MAX; 3],
        [1 << 30, 0, 0],
        [0, 1 << 30, 0],
        [0, 0, 1 << 30],
    ] {
        // (In profile `residual` there are no buckets and cells to count.)
        let raw: Vec<u8> = counts.iter().flat_map(|c| c.to_le_bytes()).collect();
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, 0, &raw);
        let (memory, result) = push(&hand.bytes);
        assert_eq!(result, Err(StreamError::Length.into()));
        assert!(memory <= most_bytes(room), "{memory} bytes");
    }
    let mut hand = hand;
    hand.compressed(
        flag::SNAPSHOT | flag::LAST,
        1,
        0,
        MAX_RAW_BYTES + 1,
        &[0; 9],
    );
    assert_eq!(push(&hand.bytes).1, Err(StreamError::Value.into()));
}

#[test]
fn a_zstd_bomb_takes_no_more_memory_than_the_header_says() {
    let bomb = zstd(&vec![0; 1 << 28]);
    assert!(bomb.len() < 64 << 10, "{} bytes", bomb.len());
    let header = Header {
        max_body_bytes: MAX_BODY_BYTES,
        max_raw_bytes: MAX_RAW_BYTES,
        ..Hand::header()
    };
    for raw_bytes in [1, 4096, MAX_RAW_BYTES] {
        let mut hand = Hand::with(&header);
        hand.compressed(flag::SNAPSHOT | flag::LAST, 1, 0, raw_bytes, &bomb);
        let mut client = Client::new(config(Hand::ROOM));
        assert_eq!(client.push(&hand.bytes), Err(ClientError::Compression));
        assert!(client.memory_bytes() <= most_bytes(Hand::ROOM));
    }
    // Within the limit it is only wrong: 2²² zero bytes are a content of no elements and more.
    let mut hand = Hand::with(&header);
    hand.frame(
        flag::SNAPSHOT | flag::LAST,
        1,
        0,
        &vec![0; MAX_RAW_BYTES as usize],
    );
    let mut client = Client::new(config(Hand::ROOM));
    assert_eq!(client.push(&hand.bytes), Err(StreamError::Length.into()));
    assert!(client.memory_bytes() <= most_bytes(Hand::ROOM));
}

// ---------------------------------------------------------------- recovery

#[test]
fn a_mirror_that_went_wrong_is_withheld_until_a_snapshot() {
    // [5.6, 5.7]
    let sample = &*SERVED;
    let mut bytes = sample.bytes.clone();
    // Packets: header, frames 1 to 6 (5 is a snapshot), end. Frame 2's hash becomes another.
    let places = packets(&bytes);
    assert_eq!(places.len(), 8);
    bytes[places[2].start + PACKET_HEADER_BYTES + 12] ^= 1;
    mend(&mut bytes);
    let mut client = Client::new(config(sample.room));
    let mut seen = Vec::new();
    let mut rest = &bytes[..];
    for place in &places[..5] {
        // Packet by packet, to look at the state after each.
        let (now, later) = rest.split_at(place.end - (bytes.len() - rest.len()));
        let frame = client.push(now).unwrap().frame.map(|frame| frame.id);
        seen.push((frame, client.state()));
        rest = later;
    }
    use State::{Desynchronised, Live};
    let lost = (None, Desynchronised);
    assert_eq!(seen, [lost, (Some(1), Live), lost, lost, lost]);
    assert_eq!(client.stats().mismatches, 1);
    let pushed = client.push(rest).unwrap();
    assert_eq!(pushed.frame.unwrap().id, 5);
    assert_eq!(contents(client.mirror()), sample.mirrors[&5]);
    assert_eq!(client.stats().snapshots, 2);

    let outcome = agreed(&bytes, sample.room);
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!((ids, outcome.mismatches), (vec![1, 5, 6], 1));
}

#[test]
fn a_snapshot_with_the_wrong_hash_is_no_snapshot() {
    let sample = by_hand();
    let mut bytes = sample.bytes.clone();
    let last_part = packets(&bytes)[5].start;
    bytes[last_part + PACKET_HEADER_BYTES + 15] ^= 4;
    mend(&mut bytes);
    let outcome = agreed(&bytes, sample.room);
    assert_eq!((outcome.shown.len(), outcome.mismatches), (0, 1));
}

#[test]
fn a_new_connection_keeps_the_old_picture_until_its_snapshot() {
    // [5.8]
    let sample = &*SERVED;
    let mut client = Client::new(config(sample.room));
    let places = packets(&sample.bytes);
    let mut rest = &sample.bytes[..places[6].end];
    while !rest.is_empty() {
        rest = &rest[client.push(rest).unwrap().consumed..];
    }
    let old = contents(client.mirror());
    assert_eq!(
        client.push(&[0xff; 40]),
        Err(StreamError::PacketTooLarge(u32::MAX).into())
    );
    client.restart();
    assert_eq!(client.state(), State::Connecting);
    assert_eq!(contents(client.mirror()), old);
    client.clear_dirty();
    client.push(&sample.bytes[..places[0].end]).unwrap();
    assert_eq!(client.state(), State::Desynchronised);
    // A frame that is no snapshot does not touch it: here the second before the first.
    let mut bytes = sample.bytes[places[2].clone()].to_vec();
    bytes[2..4].copy_from_slice(&1u16.to_le_bytes());
    let mut whole = [&PREAMBLE[..], &bytes].concat();
    mend(&mut whole);
    assert_eq!(client.push(&whole[8..]).unwrap().frame, None);
    assert_eq!(contents(client.mirror()), old);
    let buffers = [
        psao::core::mirror::Buffer::Instances,
        psao::core::mirror::Buffer::Buckets,
        psao::core::mirror::Buffer::Cells,
    ];
    for buffer in buffers {
        assert_eq!(client.mirror().next_dirty(buffer, 0), None);
    }
    let outcome = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
    assert_eq!(outcome.shown.len(), 6);
}

// ---------------------------------------------------------------- random damage

/// Damages a stream in one of the ways that bytes go wrong.
pub fn damage(bytes: &mut Vec<u8>, random: &mut Random) {
    let at = random.below(bytes.len());
    match random.below(7) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][random.below(5)],
        2 => drop(bytes.remove(at)),
        3 => bytes.insert(at, random.below(256) as u8),
        4 => bytes.truncate(at),
        5 => {
            let length = random.below(64).min(bytes.len() - at);
            let to = random.below(bytes.len() - length + 1);
            bytes.copy_within(at..at + length, to);
        }
        _ => {
            let word = [0u32, 1, 0x7fff_ffff, 0x8000_0000, u32::MAX][random.below(5)];
            let length = (bytes.len() - at).min(4);
            bytes[at..at + length].copy_from_slice(&word.to_le_bytes()[..length]);
        }
    }
}

#[test]
fn a_hundred_thousand_damaged_streams_end_as_both_readers_agree() {
    // Half have their checksums mended, so that the damage gets past them.
    let sample = by_hand();
    let run = |seed: u64| {
        let mut random = Random(seed);
        let mut readers = Readers::new(sample.room);
        let (mut errors, mut shown, mut withheld) = (0, 0, 0);
        for round in 0..50_000 {
            let mut bytes = sample.bytes.clone();
            for _ in 0..1 + random.below(3) {
                if !bytes.is_empty() {
                    damage(&mut bytes, &mut random);
                }
            }
            if round % 2 == 0 {
                mend(&mut bytes);
            }
            let outcome = readers.agree(&bytes);
            errors += usize::from(outcome.error.is_some());
            withheld += outcome.mismatches;
            shown += outcome.shown.len();
            assert!(readers.client.memory_bytes() <= most_bytes(sample.room));
        }
        assert!(
            errors > 10_000 && shown > 10_000 && withheld > 100,
            "the damage is meant to be of all kinds: {errors}, {shown}, {withheld}"
        );
    };
    std::thread::scope(|scope| {
        for seed in [1, 2] {
            scope.spawn(move || run(seed));
        }
    });
}

#[test]
fn damaged_contents_end_as_both_readers_agree() {
    // The content is damaged before it is compressed, and the hash is often made right.
    let raw = content(
        &[(0, grid()), (1, grid())],
        &[
            (0, bucket(&[1, 2, 3])),
            (3, bucket(&[8])),
            (7, bucket(&[4])),
        ],
        &[(1, cell(5)), (2, cell(6)), (3, cell(7)), (8, cell(9))],
    );
    let mut random = Random(3);
    let mut readers = Readers::new(Hand::ROOM);
    let mut shown = 0;
    for _ in 0..30_000 {
        let mut damaged = raw.clone();
        damage(&mut damaged, &mut random);
        let mut mirror = psao::core::Mirror::new(psao::memory::Heap::new(Hand::ROOM));
        let applied = stream::apply_changes(&damaged, &mut mirror);
        let hash = applied.map_or(0, |_| mirror.hash());
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, hash, &damaged);
        let outcome = readers.agree(&hand.bytes);
        assert_eq!(outcome.shown.len(), usize::from(outcome.error.is_none()));
        shown += outcome.shown.len();
        // Whatever is shown can be looked up.
        let lookup = readers.client.mirror().lookup();
        for instance in 0..3 {
            let position = [0.1, 0.12, 0.07].map(|v| v * random.below(4) as f32);
            for kernel in [psao::core::Kernel::Paper, psao::core::Kernel::Planar] {
                let answer = lookup.blend(kernel, instance, position, [0.0, 1.0, 0.0]);
                assert!((0.0..=1.0).contains(&answer.openness));
            }
        }
    }
    assert!(shown > 1000, "{shown} shown");
}

// ---------------------------------------------------------------- uplink
