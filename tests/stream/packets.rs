//! Packets, frames, headers and contents: whole, cut, damaged, out of place.

use crate::samples::{
    CELLS, Hand, MADE_LARGE, MADE_SMALL, RESIDUAL, Readers, SERVED, SERVED_RESIDUAL, agreed,
    agreed_on, bucket, by_hand, cell, config, content, contents, grid, hash_after, made, mend,
    packets, read, samples, serve, zstd,
};
use crate::second_reader;
use psao::core::grid::Instance;
use psao::core::mirror::{Capacity, MirrorError};
use psao::core::stream::{
    MAX_BODY_BYTES, PACKET_HEADER_BYTES, PREAMBLE, Packet, Refusal, StreamError, flag, kind,
};
use psao::{Client, ClientError, Config};
use psao_server::encode::refusal;

#[test]
fn both_readers_show_what_the_server_has_frame_by_frame() {
    assert_eq!(second_reader::crc32(b"123456789"), 0xcbf43926);
    let outcome = agreed_on(&SERVED);
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!(ids, [1, 2, 3, 4, 5, 6]);
    assert!(outcome.ended && outcome.error.is_none() && outcome.mismatches == 0);

    let outcome = agreed_on(&SERVED_RESIDUAL);
    assert_eq!((outcome.shown.len(), outcome.mismatches), (8, 0));
    assert!(outcome.ended && outcome.error.is_none());
    // Several slices an instance.
    let sample = serve(1500.0, RESIDUAL, 6);
    let mut client = Client::new(config(sample.room));
    client.push(&sample.bytes[..100]).unwrap();
    assert!(
        client
            .header()
            .is_some_and(|header| header.capacity.slices > 5)
    );
    let outcome = agreed_on(&sample);
    assert_eq!((outcome.shown.len(), outcome.error), (6, None));
    for what in [MADE_SMALL, MADE_LARGE] {
        let outcome = agreed_on(&made(what));
        assert_eq!(outcome.shown.len() as u32, what.frames);
        assert!(outcome.ended && outcome.error.is_none());
    }

    let outcome = agreed_on(&by_hand());
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!(ids, [41, 42, 43]);
    assert!(outcome.ended && outcome.error.is_none());
}

#[test]
fn a_frame_too_large_for_one_packet_comes_in_several() {
    let sample = serve(10_000.0, CELLS, 1);
    let packets = packets(&sample.bytes);
    assert!(packets.len() > 3, "{} packets", packets.len());
    let outcome = agreed_on(&sample);
    assert_eq!((outcome.shown.len(), outcome.error), (1, None));
}

#[test]
fn a_stream_does_not_depend_on_the_number_of_threads() {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.unwrap();
        [(CELLS, 6), (RESIDUAL, 8)]
            .map(|(scheme, frames)| pool.install(|| serve(24.0, scheme, frames).bytes))
    };
    let bytes = [SERVED.bytes.clone(), SERVED_RESIDUAL.bytes.clone()];
    assert!(on(1) == bytes && on(7) == bytes);
}

#[test]
fn however_a_stream_is_cut_its_frames_are_the_same() {
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let whole = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
        for portion in [1, 2, 15, 16, 17, 1000] {
            let cut = read(&mut client, &sample.bytes, portion, |client, frame| {
                assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
            });
            assert_eq!(cut, whole);
        }
    }
}

#[test]
fn every_prefix_of_a_stream_shows_the_frames_that_are_whole_in_it() {
    for sample in samples() {
        // Where each frame ends, from pushing byte by byte.
        let mut client = Client::new(config(sample.room));
        let mut ends = Vec::new();
        for at in 0..sample.bytes.len() {
            if let Some(frame) = client.push(&sample.bytes[at..=at]).unwrap().frame {
                ends.push((at + 1, frame));
            }
        }
        assert_eq!(ends.len(), sample.mirrors.len());
        for length in 0..=sample.bytes.len() {
            let prefix: Box<[u8]> = sample.bytes[..length].into();
            let outcome = agreed(&prefix, sample.room);
            let whole = ends.iter().filter(|(end, _)| *end <= length).count();
            assert_eq!(outcome.shown.len(), whole, "{length} bytes");
            assert_eq!(outcome.error, None);
            assert_eq!(outcome.ended, length == sample.bytes.len());
        }
    }
}

#[test]
fn nothing_may_follow_the_end() {
    // [3.2]
    for sample in samples() {
        let mut longer = sample.bytes.clone();
        longer.push(0);
        let outcome = agreed(&longer, sample.room);
        assert_eq!(outcome.shown.len(), sample.mirrors.len());
        assert_eq!(outcome.error, Some(StreamError::Order.into()));
    }
}

// ---------------------------------------------------------------- damaged streams

#[test]
fn every_flipped_bit_is_an_error_or_withholds_frames() {
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let good = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
        let mut bytes = sample.bytes.clone();
        for bit in 0..8 * bytes.len() {
            bytes[bit / 8] ^= 1 << (bit % 8);
            let outcome = read(&mut client, &bytes, usize::MAX, |client, frame| {
                assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
            });
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(
                good.shown.starts_with(&outcome.shown) && !outcome.ended,
                "bit {bit} goes unnoticed: {outcome:?}"
            );
            // Only a length that became larger leaves the reader waiting.
            assert!(
                outcome.error.is_some() || outcome.shown.len() < good.shown.len() || {
                    let end = packets(&bytes).pop().unwrap();
                    (end.start + 4..end.start + 8).contains(&(bit / 8))
                },
                "bit {bit}"
            );
        }
    }
}

#[test]
fn lost_repeated_and_swapped_packets_are_noticed() {
    // [2.7]
    for sample in samples() {
        let places = packets(&sample.bytes);
        let list: Vec<&[u8]> = places.iter().map(|p| &sample.bytes[p.clone()]).collect();
        let damaged = |change: &dyn Fn(&mut Vec<&[u8]>), stays: bool| {
            let mut list = list.clone();
            change(&mut list);
            let bytes = [&PREAMBLE[..], &list.concat()].concat();
            let outcome = agreed(&bytes, sample.room);
            assert_eq!(outcome.error.is_none(), stays, "{outcome:?}");
        };
        for at in 0..list.len() {
            // Without its last packet, a stream just stops.
            let last = at + 1 == list.len();
            damaged(
                &|list| {
                    list.remove(at);
                },
                last,
            );
            damaged(&|list| list.insert(at, list[at]), false);
            if !last {
                damaged(&|list| list.swap(at, at + 1), false);
            }
        }
    }
}

#[test]
fn frames_that_are_lost_or_mixed_are_noticed_even_where_the_sequence_is_right() {
    // [5.2 to 5.5]
    let sample = by_hand();
    let bodies: Vec<(u8, u8, Vec<u8>)> = packets(&sample.bytes)
        .into_iter()
        .map(|place| {
            let bytes = &sample.bytes[place];
            let (packet, _) = Packet::read(bytes, MAX_BODY_BYTES).unwrap().unwrap();
            (packet.kind, packet.flags, packet.body.to_vec())
        })
        .collect();
    let read_changed = |change: &dyn Fn(&mut Vec<(u8, u8, Vec<u8>)>)| {
        let mut bodies = bodies.clone();
        change(&mut bodies);
        let mut hand = Hand::bare();
        for (kind, flags, body) in &bodies {
            hand.packet(*kind, *flags, body);
        }
        agreed(&hand.bytes, sample.room)
    };
    assert_eq!(bodies.len(), 9);
    assert_eq!(read_changed(&|_| ()).shown.len(), 3);
    let order = Some(ClientError::Stream(StreamError::Order));
    let value = Some(ClientError::Stream(StreamError::Value));

    let lost_first = read_changed(&|list| drop(list.remove(2)));
    assert_eq!((lost_first.shown.len(), lost_first.error), (0, None));
    let lost_part = read_changed(&|list| drop(list.remove(3)));
    assert_eq!(lost_part.shown, []);
    assert_eq!((lost_part.mismatches, lost_part.error), (1, None));
    let lost_last = read_changed(&|list| drop(list.remove(5)));
    assert_eq!(lost_last.error, order);
    let lost_frame = read_changed(&|list| drop(list.remove(6)));
    assert_eq!((lost_frame.shown.len(), lost_frame.error), (1, order));
    let repeated = read_changed(&|list| list.insert(6, list[6].clone()));
    assert_eq!((repeated.shown.len(), repeated.error), (2, order));
    let end_within = read_changed(&|list| list.swap(5, 8));
    assert_eq!(end_within.error, order);
    let snapshot_within = read_changed(&|list| list[3].1 |= flag::SNAPSHOT);
    assert_eq!(snapshot_within.error, order);
    let early_hash = read_changed(&|list| list[2].2[12] = 1);
    assert_eq!(early_hash.error, value);
    let other_time = read_changed(&|list| list[3].2[4] ^= 1);
    assert_eq!(other_time.error, order);
}

#[test]
fn what_is_out_of_place_is_refused() {
    // [3.2]
    let order = Some(ClientError::Stream(StreamError::Order));
    let error = |hand: &Hand| agreed(&hand.bytes, Hand::ROOM).error;
    for kind in [kind::FRAME, kind::SLICES, kind::PATCHES, kind::END, 99] {
        let mut hand = Hand::bare();
        hand.packet(kind, 0, &[0; 24]);
        assert_eq!(error(&hand), order, "kind {kind} before the header");
    }
    for kind in [kind::HEADER, kind::REFUSE, kind::SLICES, kind::PATCHES] {
        let mut hand = Hand::new();
        hand.packet(kind, 0, &[1; 60]);
        assert_eq!(error(&hand), order, "kind {kind} after the header");
    }
    for kind in [0, 7, 15, 64, 99, 255] {
        let mut hand = Hand::new();
        hand.packet(kind, 0, &[]);
        assert_eq!(error(&hand), Some(StreamError::Kind(kind).into()));
    }
    let mut hand = Hand::new();
    hand.packet(kind::END, 0, &[0]);
    assert_eq!(error(&hand), Some(StreamError::Length.into()));
}

// ---------------------------------------------------------------- fields outside their range

/// The stream by hand with one byte of its header packet's body replaced, the checksum right.
fn with_header_byte(at: usize, value: u8) -> Vec<u8> {
    let mut bytes = by_hand().bytes;
    bytes[PREAMBLE.len() + PACKET_HEADER_BYTES + at] = value;
    mend(&mut bytes);
    bytes
}

#[test]
fn headers_outside_their_ranges_are_refused_and_named() {
    // [4.1, 4.2]
    let error = |bytes: &[u8]| {
        let outcome = agreed(bytes, Hand::ROOM);
        outcome.error.map(|error| error.to_string())
    };
    assert_eq!(error(&by_hand().bytes), None);
    // A newer minor version is read, and so is the other kernel.
    assert_eq!(error(&with_header_byte(2, 9)), None);
    assert_eq!(error(&with_header_byte(5, 1)), None);
    let says = |at, value, words: &str| {
        let said = error(&with_header_byte(at, value)).expect("refused");
        assert!(said.contains(words), "{said}");
    };
    says(0, 2, "stream version 2");
    says(1, 1, "stream version 257");
    says(4, 2, "stream profile 2");
    for (at, value) in [
        (5, 2),
        (6, 8),
        (6, 15),
        (7, 4),
        (31, 1),
        (35, 1),
        (39, 0xff),
        (4, 1),
        (49, 1),
        (50, 1),
        (51, 1),
        (52, 1),
        (55, 1),
        (56, 1),
    ] {
        says(at, value, "outside its range");
    }
    for value in [f32::NAN, f32::INFINITY, -1.0] {
        for field in 0..3 {
            let mut header = Hand::header();
            *[
                &mut header.ao_distance_m,
                &mut header.density,
                &mut header.rate_hz,
            ][field] = value;
            let said = error(&Hand::with(&header).bytes).expect("refused");
            assert!(said.contains("outside its range"), "{said}");
        }
    }
    // Fields of a newer minor version are ignored, missing ones are not.
    let mut body = Packet::read(&Hand::new().bytes[8..], 4096)
        .unwrap()
        .unwrap()
        .0
        .body
        .to_vec();
    let mut hand = Hand::bare();
    body.extend([9; 20]);
    hand.packet(kind::HEADER, 0, &body);
    assert_eq!(error(&hand.bytes), None);
    for length in 0..60 {
        let mut hand = Hand::bare();
        hand.packet(kind::HEADER, 0, &body[..length]);
        assert!(error(&hand.bytes).is_some(), "{length} bytes");
    }
}

#[test]
fn reserved_flags_are_refused_and_others_where_they_do_not_belong() {
    // [2.3, 2.6]
    let value = Some(ClientError::Stream(StreamError::Value));
    let bytes = by_hand().bytes;
    for place in packets(&bytes) {
        let known = bytes[place.start] < 64;
        for bit in 0..8 {
            let mut bytes = bytes.clone();
            if bytes[place.start + 1] & 1 << bit != 0 {
                continue;
            }
            bytes[place.start + 1] |= 1 << bit;
            mend(&mut bytes);
            let outcome = agreed(&bytes, Hand::ROOM);
            if !known {
                assert_eq!(outcome.error, None);
            } else if bit > 1 || bytes[place.start] != kind::FRAME {
                assert_eq!(outcome.error, value, "bit {bit}");
            }
        }
    }
}

#[test]
fn a_client_says_what_it_lacks() {
    // [4.3]
    type Less = fn(&mut Capacity);
    let less: [Less; 3] = [
        |room| room.instances -= 1,
        |room| room.buckets -= 1,
        |room| room.cells -= 1,
    ];
    for less in less {
        let mut room = Hand::ROOM;
        less(&mut room);
        let mut readers = Readers::new(room);
        let outcome = readers.agree(&by_hand().bytes);
        assert_eq!(outcome.error, Some(ClientError::Capacity(Hand::ROOM)));
        assert_eq!(readers.client.mirror().capacity(), Capacity::default());
    }
    let mut client = Client::new(Config {
        scene_hash: 8,
        ..config(Hand::ROOM)
    });
    let error = client.push(&by_hand().bytes).unwrap_err();
    assert_eq!(error, ClientError::Scene(7));
    let mut client = Client::new(Config {
        scene_hash: 7,
        ..config(Hand::ROOM)
    });
    assert!(client.push(&by_hand().bytes).is_ok());
}

#[test]
fn a_refusal_comes_through_in_words() {
    // [3.4]
    for reason in [
        Refusal::Token,
        Refusal::Scene,
        Refusal::Capacity,
        Refusal::Full,
    ] {
        let outcome = agreed(&refusal(reason), Hand::ROOM);
        let Some(ClientError::Refused(Some(said), words)) = outcome.error else {
            panic!("{:?}", outcome.error);
        };
        assert_eq!((said, words.to_string()), (reason, reason.to_string()));
    }
    let mut hand = Hand::bare();
    let words = format!("\u{3}\u{1}\u{1b}[31mno\n{}", "x".repeat(1000));
    hand.packet(kind::REFUSE, 0, words.as_bytes());
    match Client::new(config(Hand::ROOM)).push(&hand.bytes) {
        Err(ClientError::Refused(None, words)) => {
            let text = words.to_string();
            assert!(text.starts_with("[31mnox") && text.len() == 200, "{text}");
        }
        other => panic!("{other:?}"),
    }
    let mut hand = Hand::bare();
    hand.packet(kind::REFUSE, 0, &[1]);
    let outcome = agreed(&hand.bytes, Hand::ROOM);
    assert_eq!(outcome.error, Some(StreamError::Length.into()));
}

#[test]
fn content_that_does_not_fit_the_mirror_is_refused() {
    // [6.2 to 6.4, 7.4]
    let error = |raw: &[u8]| {
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, 0, raw);
        agreed(&hand.bytes, Hand::ROOM).error
    };
    let mirror = |error| Some(ClientError::Stream(StreamError::Mirror(error)));
    let length = Some(ClientError::Stream(StreamError::Length));
    let value = Some(ClientError::Stream(StreamError::Value));
    let index = mirror(MirrorError::Index);
    assert_eq!(error(&content(&[], &[], &[(9, cell(1))])), index);
    assert_eq!(error(&content(&[], &[], &[(0, cell(1))])), index);
    assert_eq!(error(&content(&[], &[(8, bucket(&[]))], &[])), index);
    assert_eq!(error(&content(&[(2, grid())], &[], &[])), index);
    let entry = mirror(MirrorError::Entry);
    assert_eq!(error(&content(&[], &[(0, bucket(&[9]))], &[])), entry);
    assert_eq!(
        error(&content(&[], &[(0, bucket(&[0, u32::MAX]))], &[])),
        entry
    );
    let change: [fn(&mut Instance); 11] = [
        |i| i.origin[1] = f32::NAN,
        |i| i.radius = 0.0,
        |i| i.radius = f32::INFINITY,
        |i| i.cells_per_unit[2] = -1.0,
        |i| i.cells_per_unit[0] = f32::NAN,
        |i| i.dims[0] = 0,
        |i| i.dims[2] = (1 << 20) + 1,
        |i| i.bucket_first = 1,
        |i| i.bucket_first = u32::MAX,
        |i| i.normal_scale[0] = 0.0,
        |i| i.level = 4,
    ];
    for (number, change) in change.into_iter().enumerate() {
        let mut grid = grid();
        change(&mut grid);
        let found = error(&content(&[(0, grid)], &[], &[]));
        let refused = matches!(
            found,
            Some(ClientError::Stream(StreamError::Mirror(MirrorError::Grid(
                _
            ))))
        );
        assert!(refused, "change {number}: {found:?}");
        // Without buckets all of it is unused.
        grid.bucket_count = 0;
        assert_eq!(error(&content(&[(0, grid)], &[], &[])), None);
    }
    let good = content(&[(0, grid())], &[(3, bucket(&[1]))], &[(1, cell(5))]);
    assert_eq!(error(&good), None);
    for short in 1..good.len() {
        assert_eq!(error(&good[..short]), length, "{short} bytes");
    }
    assert_eq!(error(&[&good[..], &[0]].concat()), length);
    // Gaps that go past the last index there can be.
    let mut far = content(&[], &[], &[(1, cell(1)), (2, cell(2))]);
    far[16..20].fill(0xff);
    assert_eq!(error(&far), value);
    far[12..16].fill(0xff);
    assert_eq!(error(&far), value);
}

#[test]
fn content_is_exactly_one_zstd_frame() {
    // [6.1]
    let raw = content(&[(0, grid())], &[(3, bucket(&[1]))], &[(1, cell(5))]);
    let hash = hash_after(std::slice::from_ref(&raw));
    let outcome = |raw_bytes: u32, compressed: &[u8]| {
        let mut hand = Hand::new();
        let flags = flag::SNAPSHOT | flag::LAST;
        hand.compressed(flags, 1, hash, raw_bytes, compressed);
        let outcome = agreed(&hand.bytes, Hand::ROOM);
        assert_eq!(outcome.shown.len(), usize::from(outcome.error.is_none()));
        outcome.error
    };
    let bytes = raw.len() as u32;
    let good = zstd(&raw);
    let compression = Some(ClientError::Compression);
    assert_eq!(outcome(bytes, &good), None);
    assert_eq!(outcome(bytes - 1, &good), compression);
    assert_eq!(outcome(bytes + 1, &good), compression);
    assert_eq!(outcome(0, &good), Some(StreamError::Value.into()));
    assert_eq!(outcome(bytes, &[]), compression);
    assert_eq!(outcome(bytes, &raw), compression);
    for length in 1..good.len() {
        assert_eq!(
            outcome(bytes, &good[..length]),
            compression,
            "{length} bytes"
        );
    }
    assert_eq!(outcome(bytes, &[&good[..], &[0]].concat()), compression);
    let skippable = [0x50, 0x2a, 0x4d, 0x18, 1, 0, 0, 0, 0];
    assert_eq!(
        outcome(bytes, &[&skippable[..], &good].concat()),
        compression
    );
    assert_eq!(
        outcome(bytes, &[&good[..], &skippable].concat()),
        compression
    );
    let (head, tail) = raw.split_at(40);
    assert_eq!(
        outcome(bytes, &[zstd(head), zstd(tail)].concat()),
        compression
    );
}

// ---------------------------------------------------------------- patches
