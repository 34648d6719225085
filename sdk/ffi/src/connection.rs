//! The optional transport: a connection to a server over QUIC, on a thread of its own.

use crate::client::{guarded, put, slice_of};
use crate::result::psao_result::{self, *};
use crate::types::*;
use psao::core::stream::Packet;
use psao::core::uplink::{MAX_UPLINK_BODY_BYTES, Message};
use psao::quic::{Connect, ConnectError, Connection, Trust, Unsent};
use std::ffi::{CStr, c_char};

/// An open connection. Opaque. It takes memory from the heap and has one thread, which runs the
/// protocol until the connection is closed.
pub struct psao_connection {
    quic: Connection,
    /// Bytes that came, and how many of them the caller has.
    came: Vec<u8>,
    given: usize,
}

/// Where to connect, and as whom. Strings are UTF-8 and end with a zero byte.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct psao_connect {
    /// sizeof(psao_connect).
    pub struct_size: u32,
    /// "host:port"; an IPv6 address in brackets.
    pub address: *const c_char,
    /// The name in the server's certificate; NULL: the host of address.
    pub server_name: *const c_char,
    /// The token that the server was started with; NULL: none.
    pub token: *const c_char,
    /// The server has exactly the certificate with this SHA-256, 64 hexadecimal digits: what it
    /// prints when it starts. NULL: roots_pem says who is trusted.
    pub fingerprint: *const c_char,
    /// Certificates in PEM, one of which signed the server's. NULL if there is a fingerprint.
    pub roots_pem: *const c_char,
    /// Of psao_client_topology_hash; 0 for a new client.
    pub topology_hash: u64,
}

// SAFETY: as the trait asks.
unsafe impl Sized32 for psao_connect {}

/// Reads a string of the caller's; `None` for NULL.
///
/// # Safety
/// `text` is NULL or ends with a zero byte, and lives during `'a`.
unsafe fn string<'a>(text: *const c_char) -> Result<Option<&'a str>, psao_result> {
    if text.is_null() {
        return Ok(None);
    }
    // SAFETY: not null, and the caller's word.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(Some).map_err(|_| PSAO_ERROR_VALUE)
}

/// Writes a sentence as far as there is room for it, with a zero byte behind it.
///
/// # Safety
/// `out` is NULL or valid for `capacity_bytes`.
unsafe fn say(sentence: &str, out: *mut c_char, capacity_bytes: usize) {
    if out.is_null() || capacity_bytes == 0 {
        return;
    }
    let length = sentence.floor_char_boundary(capacity_bytes - 1);
    // SAFETY: not null, and `length + 1` is at most the capacity.
    unsafe {
        out.copy_from_nonoverlapping(sentence.as_ptr().cast(), length);
        out.add(length).write(0);
    }
}

impl From<&ConnectError> for psao_result {
    fn from(error: &ConnectError) -> psao_result {
        match error {
            ConnectError::Address(..)
            | ConnectError::ServerName(_)
            | ConnectError::Token(_)
            | ConnectError::Roots(_) => PSAO_ERROR_VALUE,
            ConnectError::Fingerprint { .. } | ConnectError::Certificate(..) => {
                PSAO_ERROR_UNTRUSTED
            }
            ConnectError::NoAnswer(_)
            | ConnectError::Protocol(_)
            | ConnectError::Failed(..)
            | ConnectError::System(_) => PSAO_ERROR_NO_CONNECTION,
        }
    }
}

/// Connects to a server and sends the hello: what psao_uplink_hello would write, with config and
/// connect's token. Waits until the server has proved who it is, or 5 s if nothing answers: not
/// for the frame loop.
///
/// out_text, text_bytes: room for a sentence about why it failed, for a log; may be NULL and 0.
/// Unlike other outputs it is written on failure only, and ends with a zero byte.
///
/// PSAO_ERROR_VALUE: a string is not UTF-8 or not what it should be, or there is not exactly one
/// of fingerprint and roots_pem. PSAO_ERROR_UNTRUSTED, PSAO_ERROR_NO_CONNECTION.
///
/// Threads: any. Takes memory, and starts a thread. Safe on untrusted input. Since ABI 1, in
/// libraries built with the feature quic.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_connection_open(
    connect: *const psao_connect,
    config: *const psao_config,
    out_text: *mut c_char,
    text_bytes: usize,
    out_connection: *mut *mut psao_connection,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let (connect, config) = (read_struct(connect)?, read_struct(config)?);
        if out_connection.is_null() {
            return Err(PSAO_ERROR_NULL);
        }
        let address = string(connect.address)?.ok_or(PSAO_ERROR_NULL)?;
        let trust = match (string(connect.fingerprint)?, string(connect.roots_pem)?) {
            (Some(digits), None) => digits.parse().map(Trust::Fingerprint).map_err(|error| {
                say(&format!("{error}"), out_text, text_bytes);
                PSAO_ERROR_VALUE
            })?,
            (None, Some(pem)) => Trust::RootsPem(pem.into()),
            _ => return Err(PSAO_ERROR_VALUE),
        };
        let opened = Connection::open(Connect {
            address,
            server_name: string(connect.server_name)?,
            token: string(connect.token)?.unwrap_or(""),
            trust,
            scene_hash: config.scene_hash,
            capacity: config.limits().capacity,
            topology_hash: connect.topology_hash,
        });
        let quic = opened.map_err(|error| {
            say(&error.to_string(), out_text, text_bytes);
            psao_result::from(&error)
        })?;
        let connection = Box::new(psao_connection {
            quic,
            came: Vec::new(),
            given: 0,
        });
        put(out_connection, Box::into_raw(connection))?;
        Ok(PSAO_OK)
    })
}

/// Lends the connection.
///
/// # Safety
/// `connection` is NULL or open, and nothing else uses it during `'a`.
unsafe fn open<'a>(
    connection: *mut psao_connection,
) -> Result<&'a mut psao_connection, psao_result> {
    // SAFETY: the caller's word.
    unsafe { connection.as_mut() }.ok_or(PSAO_ERROR_NULL)
}

/// Takes bytes of the stream that have come, at most capacity_bytes, for psao_client_push. Never
/// waits. What is not taken stays, up to 1 MiB; beyond that the server is asked to wait, and
/// merges what changes meanwhile.
///
/// out_bytes: how many.
///
/// PSAO_NOTHING_NEW: none have come since. PSAO_ERROR_CLOSED: none will come any more, and all
/// that came was taken: out_text, if not NULL, has a sentence about why, as in
/// psao_connection_open.
///
/// Threads: exclusive per connection. Takes memory now and then, and a lock that the connection's
/// thread holds for short. Since ABI 1, in libraries built with the feature quic.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_connection_receive(
    connection: *mut psao_connection,
    out: *mut u8,
    capacity_bytes: usize,
    out_bytes: *mut usize,
    out_text: *mut c_char,
    text_bytes: usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let connection = open(connection)?;
        if out.is_null() || out_bytes.is_null() {
            return Err(PSAO_ERROR_NULL);
        }
        let psao_connection { quic, came, given } = connection;
        if *given == came.len() {
            came.clear();
            *given = 0;
            if let Err(closed) = quic.receive(came) {
                say(&closed.to_string(), out_text, text_bytes);
                return Err(PSAO_ERROR_CLOSED);
            }
        }
        let rest = &came[*given..];
        let count = rest.len().min(capacity_bytes);
        out.copy_from_nonoverlapping(rest.as_ptr(), count);
        *given += count;
        put(out_bytes, count)?;
        Ok(if count > 0 { PSAO_OK } else { PSAO_NOTHING_NEW })
    })
}

/// Sends a message that a psao_uplink_ function wrote, but for the hello, which was sent. Its
/// number does not matter: the connection counts anew. Cameras and acknowledgements overtake
/// older ones; all else arrives surely and in order. Never waits.
///
/// PSAO_ERROR_VALUE: it is no such message. PSAO_ERROR_BUSY: the network is slower than the
/// messages: send the newest state again later. PSAO_ERROR_CLOSED: see psao_connection_receive.
///
/// Threads: exclusive per connection. Takes memory now and then, and a lock that the connection's
/// thread holds for short. Since ABI 1, in libraries built with the feature quic.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_connection_send(
    connection: *mut psao_connection,
    message: *const u8,
    message_bytes: usize,
) -> psao_result {
    // SAFETY: the caller's word.
    guarded(|| unsafe {
        let quic = &open(connection)?.quic;
        let bytes = slice_of(message, message_bytes)?;
        let packet = match Packet::read(bytes, MAX_UPLINK_BODY_BYTES) {
            Ok(Some((packet, length))) if length == bytes.len() => packet,
            _ => return Err(PSAO_ERROR_VALUE),
        };
        let sent = match Message::read(&packet) {
            Ok(Some(Message::Camera(camera))) => quic.camera(&camera),
            Ok(Some(Message::Transform(transform))) => quic.transform(&transform),
            Ok(Some(Message::Joints(joints))) => {
                let matrices: Vec<_> = joints.matrices().collect();
                quic.joints(joints.instance, &matrices)
            }
            Ok(Some(Message::Ack(frame))) => quic.ack(frame),
            Ok(Some(Message::Resync)) => quic.resync(),
            Ok(Some(Message::Presence(presence))) => quic.presence(&presence),
            Ok(Some(Message::Hello(_)) | None) | Err(_) => return Err(PSAO_ERROR_VALUE),
        };
        match sent {
            Ok(()) => Ok(PSAO_OK),
            Err(Unsent::Invalid(_)) => Err(PSAO_ERROR_VALUE),
            Err(Unsent::Busy) => Err(PSAO_ERROR_BUSY),
            Err(Unsent::Closed) => Err(PSAO_ERROR_CLOSED),
        }
    })
}

/// Closes the connection, tells the server, ends its thread and frees its memory. Waits at most
/// 1 s.
///
/// connection: not to be used afterwards. NULL does nothing.
///
/// Threads: exclusive per connection. Since ABI 1, in libraries built with the feature quic.
///
/// # Safety
/// The pointer is as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_connection_close(connection: *mut psao_connection) -> psao_result {
    guarded(|| {
        if !connection.is_null() {
            // SAFETY: it came from a box in psao_connection_open, and is given back once.
            drop(unsafe { Box::from_raw(connection) });
        }
        Ok(PSAO_OK)
    })
}
