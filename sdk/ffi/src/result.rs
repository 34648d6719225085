//! What every function answers.

use core::ffi::{CStr, c_char};
use psao::ClientError;
use psao::core::stream::{Refusal, StreamError};

/// What a function answers: 0 or more is a success, less is a failure, and what the function
/// writes is then untouched. Values are never reused; new ones may come.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum psao_result {
    /// Done. From psao_client_push: a frame was completed, take it before you push on.
    PSAO_OK = 0,
    /// All input was used, and more is needed. Nothing to do but to go on.
    PSAO_NEED_MORE = 1,
    /// Nothing came since the last take. Keep what you have.
    PSAO_NOTHING_NEW = 2,
    /// The mirror differs from the server's. Send psao_uplink_resync, and push on: the last frame
    /// stays in place until a snapshot comes.
    PSAO_RESYNC = 3,
    /// A pointer is NULL that must not be.
    PSAO_ERROR_NULL = -1,
    /// struct_size is not that of a struct this library knows, or the part it does not know is
    /// not zero: use the library that the header came with, or a newer one.
    PSAO_ERROR_STRUCT = -2,
    /// A value is out of its range: see the function.
    PSAO_ERROR_VALUE = -3,
    /// Called at a time when it makes no sense: see the function.
    PSAO_ERROR_ORDER = -4,
    /// The memory is smaller than psao_client_memory_size says.
    PSAO_ERROR_MEMORY_SIZE = -5,
    /// The memory is not aligned as psao_client_memory_size says.
    PSAO_ERROR_MEMORY_ALIGN = -6,
    /// An earlier push failed: connect anew and call psao_client_restart.
    PSAO_ERROR_FAILED = -7,
    /// These bytes are not a PSAO stream: look at where they come from.
    PSAO_ERROR_NOT_A_STREAM = -20,
    /// Another version or profile of the format: use matching versions of server and library.
    PSAO_ERROR_VERSION = -21,
    /// Bytes were lost or changed on the way: connect anew. If it persists, the transport does not
    /// deliver everything in order.
    PSAO_ERROR_DAMAGED = -22,
    /// The bytes break the format: a faulty or hostile server. Connect anew.
    PSAO_ERROR_FORMAT = -23,
    /// The server has another scene: load the same files on both sides.
    PSAO_ERROR_SCENE = -24,
    /// The server refused for a reason that this library does not know: psao_client_error_text has
    /// the server's words.
    PSAO_ERROR_REFUSED = -30,
    /// The server wants another token: pass the one it was started with.
    PSAO_ERROR_REFUSED_TOKEN = -31,
    /// The server has another scene: load the same files on both sides.
    PSAO_ERROR_REFUSED_SCENE = -32,
    /// The server speaks another version: update the older side.
    PSAO_ERROR_REFUSED_VERSION = -33,
    /// The scene needs more room than the hello offered: raise the counts in psao_config.
    PSAO_ERROR_REFUSED_CAPACITY = -34,
    /// The server serves as many clients as it may: try again later.
    PSAO_ERROR_REFUSED_FULL = -35,
    /// The server did not understand the first message: it must be psao_uplink_hello's.
    PSAO_ERROR_REFUSED_MALFORMED = -36,
    /// The stream needs more than psao_config allows: psao_client_error_text says what, and
    /// psao_config_from_stream fills a config that is enough.
    PSAO_ERROR_CAPACITY = -40,
    /// The buffer for what the function writes is too small.
    PSAO_ERROR_OUTPUT_SIZE = -41,
    /// No server answers at the address, or the system has no socket or thread to give:
    /// psao_connection_open's text says which.
    PSAO_ERROR_NO_CONNECTION = -50,
    /// Who answers has not the certificate that was asked for: take the fingerprint that the server
    /// prints, or the roots that signed its certificate.
    PSAO_ERROR_UNTRUSTED = -51,
    /// The connection is closed: open a new one, and call psao_client_restart.
    PSAO_ERROR_CLOSED = -52,
    /// The network is slower than what is to be sent: send the newest state again later.
    PSAO_ERROR_BUSY = -53,
    /// A defect of the library: it stopped before it could do harm. This client answers nothing
    /// else from now on; make a new one, and please report it.
    PSAO_ERROR_INTERNAL = -90,
}

use psao_result::*;

/// All of them, with their names.
const NAMES: &[(psao_result, &CStr)] = &[
    (PSAO_OK, c"PSAO_OK"),
    (PSAO_NEED_MORE, c"PSAO_NEED_MORE: push what comes next"),
    (PSAO_NOTHING_NEW, c"PSAO_NOTHING_NEW: keep what you have"),
    (PSAO_RESYNC, c"PSAO_RESYNC: send psao_uplink_resync"),
    (
        PSAO_ERROR_NULL,
        c"PSAO_ERROR_NULL: a pointer is NULL that must not be",
    ),
    (
        PSAO_ERROR_STRUCT,
        c"PSAO_ERROR_STRUCT: struct_size is unknown: use the library that the header came with",
    ),
    (
        PSAO_ERROR_VALUE,
        c"PSAO_ERROR_VALUE: a value is out of its range",
    ),
    (PSAO_ERROR_ORDER, c"PSAO_ERROR_ORDER: not at this time"),
    (
        PSAO_ERROR_MEMORY_SIZE,
        c"PSAO_ERROR_MEMORY_SIZE: give as much as psao_client_memory_size says",
    ),
    (
        PSAO_ERROR_MEMORY_ALIGN,
        c"PSAO_ERROR_MEMORY_ALIGN: align as psao_client_memory_size says",
    ),
    (
        PSAO_ERROR_FAILED,
        c"PSAO_ERROR_FAILED: an earlier push failed: psao_client_restart, and a new stream",
    ),
    (
        PSAO_ERROR_NOT_A_STREAM,
        c"PSAO_ERROR_NOT_A_STREAM: these bytes are no PSAO stream",
    ),
    (
        PSAO_ERROR_VERSION,
        c"PSAO_ERROR_VERSION: use matching versions of server and library",
    ),
    (
        PSAO_ERROR_DAMAGED,
        c"PSAO_ERROR_DAMAGED: bytes were lost or changed: connect anew",
    ),
    (
        PSAO_ERROR_FORMAT,
        c"PSAO_ERROR_FORMAT: the bytes break the format: connect anew",
    ),
    (
        PSAO_ERROR_SCENE,
        c"PSAO_ERROR_SCENE: load the same files as the server",
    ),
    (
        PSAO_ERROR_REFUSED,
        c"PSAO_ERROR_REFUSED: the server will not serve",
    ),
    (
        PSAO_ERROR_REFUSED_TOKEN,
        c"PSAO_ERROR_REFUSED_TOKEN: pass the server's token",
    ),
    (
        PSAO_ERROR_REFUSED_SCENE,
        c"PSAO_ERROR_REFUSED_SCENE: load the same files as the server",
    ),
    (
        PSAO_ERROR_REFUSED_VERSION,
        c"PSAO_ERROR_REFUSED_VERSION: update the older side",
    ),
    (
        PSAO_ERROR_REFUSED_CAPACITY,
        c"PSAO_ERROR_REFUSED_CAPACITY: raise the config's counts",
    ),
    (
        PSAO_ERROR_REFUSED_FULL,
        c"PSAO_ERROR_REFUSED_FULL: try again later",
    ),
    (
        PSAO_ERROR_REFUSED_MALFORMED,
        c"PSAO_ERROR_REFUSED_MALFORMED: the first message must be psao_uplink_hello's",
    ),
    (
        PSAO_ERROR_CAPACITY,
        c"PSAO_ERROR_CAPACITY: the stream needs more than the config allows",
    ),
    (
        PSAO_ERROR_OUTPUT_SIZE,
        c"PSAO_ERROR_OUTPUT_SIZE: the output buffer is too small",
    ),
    (
        PSAO_ERROR_NO_CONNECTION,
        c"PSAO_ERROR_NO_CONNECTION: check the address, and that the server runs",
    ),
    (
        PSAO_ERROR_UNTRUSTED,
        c"PSAO_ERROR_UNTRUSTED: another certificate than the one asked for",
    ),
    (
        PSAO_ERROR_CLOSED,
        c"PSAO_ERROR_CLOSED: the connection is closed: open a new one",
    ),
    (
        PSAO_ERROR_BUSY,
        c"PSAO_ERROR_BUSY: send the newest state again later",
    ),
    (
        PSAO_ERROR_INTERNAL,
        c"PSAO_ERROR_INTERNAL: a defect of the library: make a new client",
    ),
];

/// The name of a result, and what to do about it, in one line for a log. Never NULL.
///
/// result: any value; an unknown one says so.
///
/// Threads: any. No alloc, lock or log. Since ABI 1.
#[unsafe(no_mangle)]
pub extern "C" fn psao_result_str(result: i32) -> *const c_char {
    let known = NAMES.iter().find(|(value, _)| *value as i32 == result);
    known
        .map_or(c"unknown result: a newer library?", |(_, name)| *name)
        .as_ptr()
}

impl From<&ClientError> for psao_result {
    fn from(error: &ClientError) -> psao_result {
        match error {
            ClientError::Stream(error) => (*error).into(),
            ClientError::Capacity(_) | ClientError::Limits(_) => PSAO_ERROR_CAPACITY,
            ClientError::Scene(_) => PSAO_ERROR_SCENE,
            ClientError::Compression => PSAO_ERROR_FORMAT,
            ClientError::Refused(reason, _) => match reason {
                None => PSAO_ERROR_REFUSED,
                Some(Refusal::Token) => PSAO_ERROR_REFUSED_TOKEN,
                Some(Refusal::Scene) => PSAO_ERROR_REFUSED_SCENE,
                Some(Refusal::Version) => PSAO_ERROR_REFUSED_VERSION,
                Some(Refusal::Capacity) => PSAO_ERROR_REFUSED_CAPACITY,
                Some(Refusal::Full) => PSAO_ERROR_REFUSED_FULL,
                Some(Refusal::Malformed) => PSAO_ERROR_REFUSED_MALFORMED,
            },
            ClientError::Failed => PSAO_ERROR_FAILED,
        }
    }
}

impl From<StreamError> for psao_result {
    fn from(error: StreamError) -> psao_result {
        match error {
            StreamError::NotAStream => PSAO_ERROR_NOT_A_STREAM,
            StreamError::Version(_) | StreamError::Profile(_) => PSAO_ERROR_VERSION,
            StreamError::Checksum | StreamError::Sequence => PSAO_ERROR_DAMAGED,
            _ => PSAO_ERROR_FORMAT,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_result_has_its_own_name_and_value() {
        for (index, (result, name)) in NAMES.iter().enumerate() {
            let name = name.to_str().unwrap();
            assert_eq!(name.split(':').next().unwrap(), format!("{result:?}"));
            for (other, _) in &NAMES[..index] {
                assert_ne!(*other as i32, *result as i32);
            }
        }
        let is_value = |line: &&str| line.trim().starts_with("PSAO_") && line.contains(" = ");
        let declared = include_str!("result.rs").lines().filter(is_value).count();
        assert_eq!(declared, NAMES.len(), "a value without a name");
    }
}
