//! The command `psao`.
fn main() {}
