//! Any bytes, in any portions: no panic, and no memory beyond what was allowed.
#![no_main]

use libfuzzer_sys::fuzz_target;
use psao::core::mirror::Capacity;
use psao::{Client, Config};

/// What a small stream needs, and what anything may take.
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

fuzz_target!(|data: &[u8]| {
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
});
