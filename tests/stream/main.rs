//! The stream format of `docs/format.md` (clauses in brackets), read by the client and by a second
//! reader that shares no code with it: whole, cut, damaged and hostile streams.

#[path = "../second_reader.rs"]
mod second_reader;

mod client;
mod packets;
mod patches;
mod samples;
mod server;
mod slices;
mod uplink;
