//! What clients say to the server.

use crate::client::damage;
use crate::samples::{CELLS, Random, config, mend, read, world};
use crate::slices::slices_header;
use glam::DAffine3;
use psao::Client;
use psao::core::stream::{
    PACKET_HEADER_BYTES, PREAMBLE, Packet, StreamError, Writer, flag, write_packet,
};
use psao::core::uplink::{self, Camera, Hello, MAX_UPLINK_BODY_BYTES, Message, Transform};
use psao_server::encode::{Encoder, View, capacity_of};

/// One of each message, as a packet.
fn uplink_packets() -> Vec<Vec<u8>> {
    let hello = Hello {
        token: b"open sesame",
        scene_hash: 0x0123_4567_89ab_cdef,
        capacity: slices_header().capacity,
        topology_hash: 0xfedc_ba98_7654_3210,
    };
    let camera = Camera {
        position_m: [1e6, -2.5, 3.25],
        forward: [0.0, 0.0, -1.0],
        up: [0.0, 1.0, 0.0],
        fov_y_rad: 1.2,
        aspect: 16.0 / 9.0,
        height_px: 1080,
    };
    let rows = [
        [1.0, 0.0, 0.0, 10.5],
        [0.0, 2.0, 0.0, -7.25],
        [0.0, 0.0, 3.0, 1e7],
    ];
    let transform = Transform {
        instance: 3,
        world_from_local: rows,
    };
    let joints = [rows.map(|row| row.map(|v| v as f32)); 3];
    let packet = |kind, body: &dyn Fn(&mut Writer<'_>) -> Result<(), StreamError>| {
        let mut bytes = vec![0; 1000];
        let length = write_packet(&mut bytes, kind, 0, 5, body).unwrap();
        bytes.truncate(length);
        bytes
    };
    vec![
        packet(uplink::kind::HELLO, &|w| hello.write(w)),
        packet(uplink::kind::CAMERA, &|w| camera.write(w)),
        packet(uplink::kind::TRANSFORM, &|w| transform.write(w)),
        packet(uplink::kind::JOINTS, &|w| {
            uplink::write_joints(w, 3, &joints)
        }),
        packet(uplink::kind::ACK, &|w| w.u32(77)),
        packet(uplink::kind::RESYNC, &|_| Ok(())),
        packet(uplink::kind::PRESENCE, &|w| {
            let (instance, present) = (5, false);
            uplink::Presence { instance, present }.write(w)
        }),
    ]
}

/// Reads an uplink packet; `None` where it is not whole, or may be skipped.
fn read_uplink(bytes: &[u8]) -> Result<Option<Message<'_>>, StreamError> {
    match Packet::read(bytes, MAX_UPLINK_BODY_BYTES)? {
        Some((packet, _)) => Message::read(&packet),
        None => Ok(None),
    }
}

/// Writes what was read.
fn rewrite(message: &Message<'_>) -> Vec<u8> {
    let mut bytes = vec![0; 1000];
    let length = match message {
        Message::Hello(m) => write_packet(&mut bytes, uplink::kind::HELLO, 0, 5, |w| m.write(w)),
        Message::Camera(m) => write_packet(&mut bytes, uplink::kind::CAMERA, 0, 5, |w| m.write(w)),
        Message::Transform(m) => {
            write_packet(&mut bytes, uplink::kind::TRANSFORM, 0, 5, |w| m.write(w))
        }
        Message::Joints(m) => {
            let matrices: Vec<_> = m.matrices().collect();
            assert_eq!(matrices.len(), m.count());
            write_packet(&mut bytes, uplink::kind::JOINTS, 0, 5, |w| {
                uplink::write_joints(w, m.instance, &matrices)
            })
        }
        Message::Ack(id) => write_packet(&mut bytes, uplink::kind::ACK, 0, 5, |w| w.u32(*id)),
        Message::Resync => write_packet(&mut bytes, uplink::kind::RESYNC, 0, 5, |_| Ok(())),
        Message::Presence(m) => {
            write_packet(&mut bytes, uplink::kind::PRESENCE, 0, 5, |w| m.write(w))
        }
    };
    bytes.truncate(length.unwrap());
    bytes
}

#[test]
fn every_uplink_message_reads_back_as_it_was_written() {
    for bytes in uplink_packets() {
        let message = read_uplink(&bytes).unwrap().unwrap();
        assert_eq!(rewrite(&message), bytes, "{message:?}");
        for length in 0..bytes.len() {
            let prefix: Box<[u8]> = bytes[..length].into();
            assert_eq!(
                read_uplink(&prefix),
                Ok(None),
                "{length} bytes of {message:?}"
            );
        }
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            // A length that became larger waits for more.
            assert!(
                matches!(read_uplink(&flipped), Err(_) | Ok(None)),
                "bit {bit} of {message:?}"
            );
        }
    }
}

/// A packet with another body.
fn with_body(bytes: &[u8], body: &[u8]) -> Vec<u8> {
    let mut out = vec![0; PACKET_HEADER_BYTES + body.len()];
    write_packet(&mut out, bytes[0], bytes[1], 5, |w| w.bytes(body)).unwrap();
    out
}

#[test]
fn uplink_bodies_of_the_wrong_length_or_with_reserved_flags_are_refused() {
    // [10.2, 2.6]
    for bytes in uplink_packets() {
        let body = &bytes[PACKET_HEADER_BYTES..];
        let is_hello = bytes[0] == uplink::kind::HELLO;
        let longer = with_body(&bytes, &[body, &[0]].concat());
        // A hello may have fields of a newer minor version.
        assert_eq!(read_uplink(&longer).is_ok(), is_hello);
        for length in 0..body.len() {
            let shorter = with_body(&bytes, &body[..length]);
            assert_eq!(read_uplink(&shorter), Err(StreamError::Length));
        }
        for flag in 0..8 {
            let mut flagged = bytes.clone();
            flagged[1] = 1 << flag;
            let flagged = with_body(&flagged, body);
            assert_eq!(read_uplink(&flagged), Err(StreamError::Value));
        }
    }
    let unknown = |flags| with_body(&[71, flags], b"later");
    assert_eq!(read_uplink(&unknown(0)), Err(StreamError::Kind(71)));
    assert_eq!(read_uplink(&unknown(flag::OPTIONAL)), Ok(None));
}

#[test]
fn numbers_that_are_none_do_not_get_through_the_uplink() {
    let packets = uplink_packets();
    let mut refused = 0;
    for (packet, first, size) in [(1, 0, 8), (1, 24, 4), (2, 4, 8), (3, 8, 4)] {
        let body = &packets[packet][PACKET_HEADER_BYTES..];
        let end = match (packet, size) {
            (1, 8) => 24,
            (1, 4) => 56,
            _ => body.len(),
        };
        for at in (first..end).step_by(size) {
            for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut body = body.to_vec();
                if size == 8 {
                    body[at..at + 8].copy_from_slice(&value.to_le_bytes());
                } else {
                    body[at..at + 4].copy_from_slice(&(value as f32).to_le_bytes());
                }
                let bytes = with_body(&packets[packet], &body);
                assert_eq!(
                    read_uplink(&bytes),
                    Err(StreamError::Value),
                    "{packet} at {at}"
                );
                refused += 1;
            }
        }
    }
    assert_eq!(refused, 3 * (3 + 8 + 12 + 36));
    let camera = |change: &dyn Fn(&mut Camera)| {
        let mut camera = match read_uplink(&packets[1]).unwrap().unwrap() {
            Message::Camera(camera) => camera,
            other => panic!("{other:?}"),
        };
        change(&mut camera);
        read_uplink(&rewrite(&Message::Camera(camera))).is_ok()
    };
    assert!(camera(&|_| ()));
    assert!(!camera(&|c| c.forward = [0.0; 3]));
    assert!(!camera(&|c| c.up = [1e-7, 0.0, 0.0]));
    assert!(!camera(&|c| c.up = [f32::MAX; 3]));
    assert!(!camera(&|c| c.fov_y_rad = 0.0));
    assert!(!camera(&|c| c.fov_y_rad = 3.2));
    assert!(!camera(&|c| c.aspect = 0.0));
    assert!(!camera(&|c| c.aspect = -1.0));
    assert!(!camera(&|c| c.aspect = 1e4));
    // More joints than there may be, and a token that is too long.
    let mut joints = packets[3][PACKET_HEADER_BYTES..].to_vec();
    joints[4..8].copy_from_slice(&(uplink::MAX_JOINTS + 1).to_le_bytes());
    let bytes = with_body(&packets[3], &joints);
    assert_eq!(read_uplink(&bytes), Err(StreamError::Value));
    let mut hello = packets[0][PACKET_HEADER_BYTES..].to_vec();
    hello[48..50].copy_from_slice(&257u16.to_le_bytes());
    hello.extend([0; 300]);
    let bytes = with_body(&packets[0], &hello);
    assert_eq!(read_uplink(&bytes), Err(StreamError::Value));
}

#[test]
fn a_hundred_thousand_damaged_messages_are_read_or_refused() {
    let packets = uplink_packets();
    let mut random = Random(4);
    let (mut read, mut refused) = (0, 0);
    for round in 0..100_000 {
        let mut bytes = packets[random.below(packets.len())].clone();
        if round % 10 == 0 {
            bytes = (0..random.below(300))
                .map(|_| random.below(256) as u8)
                .collect();
        }
        for _ in 0..random.below(3) {
            if !bytes.is_empty() {
                damage(&mut bytes, &mut random);
            }
        }
        let mut whole = [&PREAMBLE[..], &bytes].concat();
        if round % 3 != 0 {
            mend(&mut whole);
        }
        match read_uplink(&whole[PREAMBLE.len()..]) {
            Ok(Some(message)) => {
                read += 1;
                // What is read is in range: it can be written, and reads the same.
                let again = rewrite(&message);
                assert_eq!(read_uplink(&again), Ok(Some(message)));
            }
            Ok(None) => {}
            Err(_) => refused += 1,
        }
    }
    assert!(
        read > 10_000 && refused > 10_000,
        "{read} read, {refused} refused"
    );
}

#[test]
fn a_world_driven_to_absurd_places_goes_on() {
    // All of these are finite, and so get through the uplink.
    let mut world = world(24.0, CELLS);
    let mut encoder = Encoder::new(&world, CELLS, 0);
    let mut bytes = encoder.header(&world, 0, 30.0);
    let mut client = Client::new(config(capacity_of(&world)));
    let far = DAffine3::from_translation(glam::DVec3::splat(1e300));
    let flat = DAffine3::from_scale(glam::DVec3::ZERO);
    let huge = DAffine3::from_scale(glam::DVec3::splat(f64::MAX));
    let mirrored = DAffine3::from_scale(glam::DVec3::new(-1.0, 1e-30, 1e30));
    for (frame, matrix) in [far, flat, huge, mirrored, DAffine3::IDENTITY]
        .into_iter()
        .enumerate()
    {
        for instance in 0..3 {
            world.drive(instance, matrix).unwrap();
        }
        world.step(frame as f64 * 0.1, &|_| true, u64::MAX);
        encoder.merge(&world);
        world.clear_changes();
        let view = View {
            sees: &|_| true,
            eye: None,
        };
        encoder.frame(&world, frame as u64, &view, true, &mut bytes);
    }
    assert!(world.drive(3, far).is_err());
    let outcome = read(&mut client, &bytes, usize::MAX, |_, _| ());
    assert_eq!((outcome.shown.len(), outcome.error), (5, None));
}
