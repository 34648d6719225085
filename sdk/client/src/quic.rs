//! The client's transport over QUIC.
