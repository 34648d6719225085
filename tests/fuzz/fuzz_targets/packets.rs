//! Bodies of packets behind right lengths, sequences and checksums, so that what lies behind those
//! is reached: input is a kind, flags and a length, then so many bytes of the body, and so on.
#![no_main]

use libfuzzer_sys::fuzz_target;
use psao::core::mirror::Capacity;
use psao::core::stream::{Header, PACKET_HEADER_BYTES, PREAMBLE, Profile, kind, write_packet};
use psao::{Client, Config};

const CAPACITY: Capacity = Capacity {
    instances: 4,
    buckets: 64,
    cells: 64,
    slices: 8,
    points: 2048,
    patches: 4,
    topology_bytes: 4096,
};

fuzz_target!(|data: &[u8]| {
    let mut client = Client::new(Config {
        capacity: CAPACITY,
        scene_hash: 0,
    });
    let header = Header {
        profile: Profile::Residual,
        capacity: CAPACITY,
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
});
