//! What a client may send to a server.
#![no_main]

use libfuzzer_sys::fuzz_target;
use psao::core::stream::Packet;
use psao::core::uplink::{MAX_UPLINK_BODY_BYTES, Message};

fuzz_target!(|data: &[u8]| {
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
});
