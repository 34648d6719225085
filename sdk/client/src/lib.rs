//! PSAO client.
