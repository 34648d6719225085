//! The client's transport over QUIC.
//!
//! [`Connection::open`] connects, and starts one thread that runs the protocol; it is the only
//! thread, and it ends when the connection is dropped. What it receives waits in a buffer of
//! bounded size until [`Connection::receive`] takes it, and goes from there to
//! [`crate::Client::push`]. An engine that does not take it in time is not sent more (QUIC's flow
//! control), and the server merges what changed meanwhile into the next frame: there is nothing to
//! catch up with.
//!
//! The uplink functions take `&self`, never wait, and may be called from any thread. Those that
//! receive take `&mut self`. None of them calls back.
//!
//! A server that does not want the client says so in the stream: it is [`crate::Client::push`]
//! that reports [`crate::ClientError::Refused`].

use psao_core::mirror::Capacity;
use psao_core::stream::{PACKET_HEADER_BYTES, Packet, StreamError, Writer, write_packet};
use psao_core::uplink::{
    self, Camera, Hello, MAX_TOKEN_BYTES, MAX_UPLINK_BODY_BYTES, Message, Presence, Transform, kind,
};
use quinn::crypto::rustls::QuicClientConfig;
use quinn::{ConnectionError, Endpoint, ReadError, RecvStream, SendStream, VarInt};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, ring::default_provider};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{DigitallySignedStruct, RootCertStore, SignatureScheme};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tokio::runtime;
use tokio::sync::Notify;
use tokio::task::JoinSet;

/// The protocol's name in the TLS handshake.
pub const ALPN: &[u8] = b"psao/1";

/// Without a sign of life for so long, either side takes the other for gone.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(10);

/// So often the client shows that it lives: a still scene sends nothing by itself.
const KEEP_ALIVE: Duration = Duration::from_secs(3);

/// Time to connect. A server that is not there does not answer, so this is when that shows.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// The application error code of a close over no error.
const DONE: VarInt = VarInt::from_u32(0);

/// Time to tell the server that the connection is closed.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Most received bytes that wait for the engine: some frames, so that a late engine frame does not
/// stop the stream, and few enough that what it then reads is not old.
const RECEIVE_BUFFER_BYTES: usize = 1 << 20;

/// Bytes in flight: 2 MiB every 50 ms are 335 Mbit/s, more than the `cells` profile needs.
const RECEIVE_WINDOW_BYTES: u32 = 2 << 20;

/// Most bytes taken from QUIC at once.
const PIECE_BYTES: usize = 64 << 10;

/// Most uplink bytes that wait to be sent.
const UPLINK_BUFFER_BYTES: usize = 1 << 20;

/// Datagrams that wait to be sent: old cameras and acknowledgements are worthless, QUIC drops
/// them first.
const DATAGRAM_BUFFER_BYTES: usize = 1 << 10;

/// Room for the body of a [`Hello`], a [`Camera`] and a [`Transform`].
const HELLO_BYTES: usize = 64 + MAX_TOKEN_BYTES;
const CAMERA_BYTES: usize = 60;
const TRANSFORM_BYTES: usize = 100;

/// Most addresses of one name that are tried.
const MAX_ADDRESSES: usize = 8;

/// SHA-256 of a certificate in DER. Written and parsed as 64 hexadecimal digits; colons between
/// bytes are skipped, so that what `openssl x509 -fingerprint` prints is understood.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fingerprint(pub [u8; 32]);

impl Fingerprint {
    /// Of a certificate.
    pub fn of(certificate_der: &[u8]) -> Fingerprint {
        let digest = ring::digest::digest(&ring::digest::SHA256, certificate_der);
        let mut bytes = [0; 32];
        bytes.copy_from_slice(digest.as_ref());
        Fingerprint(bytes)
    }
}

impl std::fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl std::fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{self}")
    }
}

/// A text is no [`Fingerprint`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotAFingerprint;

impl std::fmt::Display for NotAFingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(
            "a fingerprint is 64 hexadecimal digits (SHA-256 of the certificate), \
             as the server prints it when it starts",
        )
    }
}

impl std::error::Error for NotAFingerprint {}

impl std::str::FromStr for Fingerprint {
    type Err = NotAFingerprint;

    fn from_str(text: &str) -> Result<Fingerprint, NotAFingerprint> {
        let mut bytes = [0; 32];
        let mut digits = text.chars().filter(|c| *c != ':');
        let mut digit = || digits.next()?.to_digit(16);
        for byte in &mut bytes {
            let (high, low) = digit().zip(digit()).ok_or(NotAFingerprint)?;
            *byte = (high << 4 | low) as u8;
        }
        match digits.next() {
            None => Ok(Fingerprint(bytes)),
            Some(_) => Err(NotAFingerprint),
        }
    }
}

/// How the client knows that the server is the right one.
#[derive(Clone, Debug)]
pub enum Trust {
    /// It has exactly this certificate, whatever name and dates are in it.
    Fingerprint(Fingerprint),
    /// Its certificate is valid now for the server's name, and signed by one of these PEM
    /// certificates (or is one of them).
    RootsPem(Vec<u8>),
}

/// Where to connect, and as whom.
#[derive(Clone, Debug)]
pub struct Connect<'a> {
    /// `host:port`; the host is a name or an address (IPv6 in brackets).
    pub address: &'a str,
    /// The name that the server's certificate is for; the host of `address` where `None`.
    pub server_name: Option<&'a str>,
    /// The token the server was started with; at most [`MAX_TOKEN_BYTES`] long.
    pub token: &'a str,
    /// How the server is recognised.
    pub trust: Trust,
    /// Hash of the client's scene; 0 accepts any.
    pub scene_hash: u64,
    /// Room the client has, as in [`crate::Config`].
    pub capacity: Capacity,
    /// Of the patches that the client has already: [`crate::Client::topology_hash`].
    pub topology_hash: u64,
}

/// Why a connection could not be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConnectError {
    /// The address is not understood or not known (the address, why).
    Address(String, String),
    /// The server name is not one that a certificate can be for (the name).
    ServerName(String),
    /// The token is longer than [`MAX_TOKEN_BYTES`] (its length).
    Token(usize),
    /// The roots cannot be used (why).
    Roots(String),
    /// Another certificate than the pinned one answered.
    Fingerprint {
        /// What is pinned.
        expected: Fingerprint,
        /// What the server has.
        found: Fingerprint,
    },
    /// The server's certificate is not valid (the address, why).
    Certificate(String, String),
    /// Nothing answers (the address).
    NoAnswer(String),
    /// What answers does not speak [`ALPN`] (the address).
    Protocol(String),
    /// The connection failed otherwise (the address, why).
    Failed(String, String),
    /// The system has no socket or thread to give (why).
    System(String),
}

impl std::fmt::Display for ConnectError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ConnectError::Address(address, why) => write!(
                f,
                "the address \"{address}\" cannot be used ({why}): pass host:port"
            ),
            ConnectError::ServerName(name) => write!(
                f,
                "\"{name}\" cannot be a server's name: pass the one in its certificate"
            ),
            ConnectError::Token(bytes) => write!(
                f,
                "the token has {bytes} bytes, at most {MAX_TOKEN_BYTES} are allowed: \
                 pass the one that the server was started with"
            ),
            ConnectError::Roots(why) => write!(
                f,
                "the trusted certificates cannot be used ({why}): pass PEM, \
                 -----BEGIN CERTIFICATE-----"
            ),
            ConnectError::Fingerprint { expected, found } => write!(
                f,
                "the server's certificate has the fingerprint {found}, not {expected}: \
                 if the server was set up anew, take its new fingerprint from its own output; \
                 otherwise somebody else answers at this address"
            ),
            ConnectError::Certificate(address, why) => write!(
                f,
                "the certificate of {address} is not valid ({why}): \
                 check the trusted certificates and the server name"
            ),
            ConnectError::NoAnswer(address) => write!(
                f,
                "no server answers at {address} within {} s: is it running, \
                 and is UDP to this port let through?",
                CONNECT_TIMEOUT.as_secs()
            ),
            ConnectError::Protocol(address) => write!(
                f,
                "what answers at {address} does not speak psao/1: check the port, \
                 or update the older side"
            ),
            ConnectError::Failed(address, why) => {
                write!(f, "no connection to {address}: {why}")
            }
            ConnectError::System(why) => write!(f, "no socket or thread to connect with: {why}"),
        }
    }
}

impl std::error::Error for ConnectError {}

/// Why nothing more comes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Closed {
    /// The server ended the stream; all of it was received.
    Ended,
    /// The server closed the connection and blames nobody: it shuts down, say (what it says).
    Done(String),
    /// The server closed the connection over an error (what it says).
    ByServer(String),
    /// The network or the server is gone (why).
    Lost(String),
}

impl std::fmt::Display for Closed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Closed::Ended => f.write_str("the server ended the stream"),
            Closed::Done(text) | Closed::ByServer(text) => {
                write!(f, "the server closed the connection: {text}")
            }
            Closed::Lost(why) => write!(f, "the connection is lost ({why}): open a new one"),
        }
    }
}

impl std::error::Error for Closed {}

/// Why an uplink message was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unsent {
    /// A value is outside its range, and the server would end the connection over it.
    Invalid(StreamError),
    /// The network is slower than the messages: send the newest state again later.
    Busy,
    /// The connection is closed: [`Connection::receive`] says why.
    Closed,
}

impl std::fmt::Display for Unsent {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Unsent::Invalid(error) => write!(f, "the message cannot be sent: {error}"),
            Unsent::Busy => f.write_str("the uplink is busy: send the newest state again later"),
            Unsent::Closed => f.write_str("the connection is closed: open a new one"),
        }
    }
}

impl std::error::Error for Unsent {}

/// What the caller's threads and the connection's thread share.
#[derive(Default)]
struct Shared {
    received: Mutex<Received>,
    /// Bytes have come, or none will.
    came: Condvar,
    /// Received bytes were taken, or the connection was closed.
    room: Notify,
    uplink: Mutex<Uplink>,
    /// There is something to send.
    queued: Notify,
}

#[derive(Default)]
struct Received {
    bytes: Vec<u8>,
    closed: Option<Closed>,
    /// The connection was dropped: nobody will take more bytes.
    dropped: bool,
}

impl Received {
    fn is_full(&self) -> bool {
        self.bytes.len() >= RECEIVE_BUFFER_BYTES && !self.dropped
    }
}

#[derive(Default)]
struct Uplink {
    /// Whole packets.
    bytes: Vec<u8>,
    next_sequence: u16,
}

/// Locks. Nothing panics while it holds one of these locks, so what they guard is whole.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// An open connection to a server. Dropping it closes it, and tells the server.
pub struct Connection {
    quic: quinn::Connection,
    shared: Arc<Shared>,
    /// Datagrams are counted by themselves: they may overtake each other and the stream.
    next_datagram: AtomicU16,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Connection {
    /// Connects and introduces the client. Waits until the server has proved who it is (one round
    /// trip), or for 5 s where nothing answers: call it outside the frame loop.
    ///
    /// # Errors
    /// The arguments cannot be used, no server answers, or it is not the right one.
    pub fn open(connect: Connect<'_>) -> Result<Connection, ConnectError> {
        let target = Target::of(&connect)?;
        let shared = Arc::new(Shared::default());
        let hello = Hello {
            token: connect.token.as_bytes(),
            scene_hash: connect.scene_hash,
            capacity: connect.capacity,
            topology_hash: connect.topology_hash,
        };
        queue(&shared, kind::HELLO, HELLO_BYTES, |w| hello.write(w))
            .map_err(|_| ConnectError::Token(connect.token.len()))?;

        let system = |error: std::io::Error| ConnectError::System(error.to_string());
        let runtime = runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(system)?;
        let (report, opened) = mpsc::sync_channel(1);
        let of_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("psao-quic".into())
            .spawn(move || runtime.block_on(run(target, of_thread, report)))
            .map_err(system)?;
        let quic = opened
            .recv()
            .unwrap_or_else(|_| Err(ConnectError::System("the thread ended".into())));
        match quic {
            Ok(quic) => Ok(Connection {
                quic,
                shared,
                next_datagram: AtomicU16::new(0),
                thread: Some(thread),
            }),
            Err(error) => {
                let _ = thread.join();
                Err(error)
            }
        }
    }

    /// Appends the stream's bytes that have come to `into`, and says how many (0: none yet, at
    /// most about 1 MiB). Never waits.
    ///
    /// # Errors
    /// Nothing more will come; all that came before has been taken.
    pub fn receive(&mut self, into: &mut Vec<u8>) -> Result<usize, Closed> {
        self.receive_timeout(into, Duration::ZERO)
    }

    /// Like [`Connection::receive`], but waits up to `timeout` while there is nothing.
    ///
    /// # Errors
    /// Nothing more will come; all that came before has been taken.
    pub fn receive_timeout(
        &mut self,
        into: &mut Vec<u8>,
        timeout: Duration,
    ) -> Result<usize, Closed> {
        let deadline = Instant::now().checked_add(timeout);
        let mut received = lock(&self.shared.received);
        while received.bytes.is_empty() {
            if let Some(closed) = &received.closed {
                return Err(closed.clone());
            }
            let now = Instant::now();
            let left = deadline.map_or(timeout, |at| at.saturating_duration_since(now));
            if left.is_zero() {
                return Ok(0);
            }
            let waited = self.shared.came.wait_timeout(received, left);
            received = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        let count = received.bytes.len();
        into.extend_from_slice(&received.bytes);
        received.bytes.clear();
        self.shared.room.notify_one();
        Ok(count)
    }

    /// Says where the client looks from. A camera overtakes an earlier one, which is then
    /// dropped.
    ///
    /// # Errors
    /// The camera is not [`Camera::is_usable`], or the connection is closed or busy.
    pub fn camera(&self, camera: &Camera) -> Result<(), Unsent> {
        self.newest(kind::CAMERA, CAMERA_BYTES, |w| camera.write(w))
    }

    /// Says that the frame `frame_id` is in the client's mirror. A later acknowledgement makes
    /// up for one that is lost.
    ///
    /// # Errors
    /// The connection is closed or busy.
    pub fn ack(&self, frame_id: u32) -> Result<(), Unsent> {
        self.newest(kind::ACK, 4, |w| w.u32(frame_id))
    }

    /// Says that the engine moved an instance. Arrives surely and in order.
    ///
    /// # Errors
    /// A value is not finite, or the connection is closed or busy.
    pub fn transform(&self, transform: &Transform) -> Result<(), Unsent> {
        self.reliable(kind::TRANSFORM, TRANSFORM_BYTES, |w| transform.write(w))
    }

    /// Says how the engine posed a skinned instance: `matrices` are local from rest, three rows
    /// of four, at most [`uplink::MAX_JOINTS`]. Arrives surely and in order.
    ///
    /// # Errors
    /// A value is not finite, there are too many, or the connection is closed or busy.
    pub fn joints(&self, instance: u32, matrices: &[[[f32; 4]; 3]]) -> Result<(), Unsent> {
        let room_bytes = 8 + 48 * matrices.len().min(uplink::MAX_JOINTS as usize);
        self.reliable(kind::JOINTS, room_bytes, |w| {
            uplink::write_joints(w, instance, matrices)
        })
    }

    /// Asks for a snapshot, after [`crate::State::Desynchronised`].
    ///
    /// # Errors
    /// The connection is closed or busy.
    pub fn resync(&self) -> Result<(), Unsent> {
        self.reliable(kind::RESYNC, 0, |_| Ok(()))
    }

    /// Takes an instance out of the scene, or puts it back. Threads: any.
    ///
    /// # Errors
    /// The connection is closed or busy.
    pub fn presence(&self, presence: &Presence) -> Result<(), Unsent> {
        self.reliable(kind::PRESENCE, 8, |w| presence.write(w))
    }

    /// Closes the connection and tells the server, as dropping does. Waits at most 1 s.
    pub fn close(self) {}

    fn reliable(
        &self,
        kind: u8,
        room_bytes: usize,
        body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
    ) -> Result<(), Unsent> {
        if self.quic.close_reason().is_some() {
            return Err(Unsent::Closed);
        }
        queue(&self.shared, kind, room_bytes, body)
    }

    /// Sends what only the newest of is worth anything: as a datagram where the server takes them.
    fn newest(
        &self,
        kind: u8,
        room_bytes: usize,
        body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
    ) -> Result<(), Unsent> {
        if self.quic.max_datagram_size().is_none() {
            return self.reliable(kind, room_bytes, body);
        }
        let mut datagram = vec![0; PACKET_HEADER_BYTES + room_bytes];
        let sequence = self.next_datagram.fetch_add(1, Ordering::Relaxed);
        let length = encode(&mut datagram, kind, sequence, body).map_err(Unsent::Invalid)?;
        datagram.truncate(length);
        let sent = self.quic.send_datagram(datagram.into());
        sent.map_err(|_| Unsent::Closed)
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        lock(&self.shared.received).dropped = true;
        self.quic.close(DONE, b"");
        self.shared.room.notify_one();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Writes a packet, and makes sure that the server will accept it.
fn encode(
    out: &mut [u8],
    kind: u8,
    sequence: u16,
    body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
) -> Result<usize, StreamError> {
    let length = write_packet(out, kind, 0, sequence, body)?;
    if let Some((packet, _)) = Packet::read(&out[..length], MAX_UPLINK_BODY_BYTES)? {
        Message::read(&packet)?;
    }
    Ok(length)
}

/// Queues a packet with a body of at most `room_bytes` for the stream.
fn queue(
    shared: &Shared,
    kind: u8,
    room_bytes: usize,
    body: impl FnOnce(&mut Writer<'_>) -> Result<(), StreamError>,
) -> Result<(), Unsent> {
    let mut uplink = lock(&shared.uplink);
    let Uplink {
        bytes,
        next_sequence,
    } = &mut *uplink;
    let start = bytes.len();
    if start >= UPLINK_BUFFER_BYTES {
        return Err(Unsent::Busy);
    }
    bytes.resize(start + PACKET_HEADER_BYTES + room_bytes, 0);
    let encoded = encode(&mut bytes[start..], kind, *next_sequence, body);
    bytes.truncate(start + encoded.unwrap_or(0));
    encoded.map_err(Unsent::Invalid)?;
    *next_sequence = next_sequence.wrapping_add(1);
    shared.queued.notify_one();
    Ok(())
}

/// The thread of a connection, from the first packet to the last.
async fn run(
    target: Target,
    shared: Arc<Shared>,
    report: mpsc::SyncSender<Result<quinn::Connection, ConnectError>>,
) {
    let opened = async {
        let (endpoint, quic) = target.connect().await?;
        let stream = quic.open_bi().await;
        let (send, receive) = stream.map_err(|error| target.error(&error))?;
        Ok((endpoint, quic, send, receive))
    };
    let (endpoint, quic, send, receive) = match opened.await {
        Ok(opened) => opened,
        Err(error) => {
            let _ = report.send(Err(error));
            return;
        }
    };
    let _ = report.send(Ok(quic.clone()));
    drop(report);
    let sending = tokio::spawn(send_queued(send, Arc::clone(&shared)));
    let closed = receive_all(receive, &shared).await;
    // First: who learns that nothing more comes finds the uplink closed, too.
    quic.close(DONE, b"");
    lock(&shared.received).closed = Some(closed);
    shared.came.notify_one();
    sending.abort();
    // The other side of a lost connection does not answer.
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, endpoint.wait_idle()).await;
}

async fn send_queued(mut stream: SendStream, shared: Arc<Shared>) {
    let mut bytes = Vec::new();
    loop {
        std::mem::swap(&mut lock(&shared.uplink).bytes, &mut bytes);
        if bytes.is_empty() {
            shared.queued.notified().await;
        } else if stream.write_all(&bytes).await.is_err() {
            // The receiving side says why.
            return;
        }
        bytes.clear();
    }
}

async fn receive_all(mut stream: RecvStream, shared: &Shared) -> Closed {
    loop {
        while lock(&shared.received).is_full() {
            shared.room.notified().await;
        }
        match stream.read_chunk(PIECE_BYTES, true).await {
            Ok(Some(chunk)) => {
                lock(&shared.received).bytes.extend_from_slice(&chunk.bytes);
                shared.came.notify_one();
            }
            Ok(None) => return Closed::Ended,
            Err(ReadError::ConnectionLost(ConnectionError::ApplicationClosed(close))) => {
                let why = printable(&close.reason);
                return match close.error_code {
                    DONE => Closed::Done(why),
                    _ => Closed::ByServer(why),
                };
            }
            Err(ReadError::ConnectionLost(ConnectionError::TimedOut)) => {
                return Closed::Lost(format!(
                    "no sign of the server for {} s",
                    IDLE_TIMEOUT.as_secs()
                ));
            }
            Err(error) => return Closed::Lost(error.to_string()),
        }
    }
}

/// Text from the other side, made fit for a message.
fn printable(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}

/// Where to connect, looked up and checked.
struct Target {
    address: String,
    addresses: Vec<SocketAddr>,
    name: String,
    config: quinn::ClientConfig,
    pinned: Option<Arc<Pinned>>,
}

impl Target {
    fn of(connect: &Connect<'_>) -> Result<Target, ConnectError> {
        let unusable = |why: String| ConnectError::Address(connect.address.into(), why);
        let addresses: Vec<SocketAddr> = connect
            .address
            .to_socket_addrs()
            .map_err(|error| unusable(error.to_string()))?
            .take(MAX_ADDRESSES)
            .collect();
        if addresses.is_empty() {
            return Err(unusable("the name has no address".into()));
        }
        let host = connect
            .address
            .rsplit_once(':')
            .map_or("", |(host, _)| host);
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let name = connect.server_name.unwrap_or(host).to_string();
        if ServerName::try_from(name.as_str()).is_err() {
            return Err(ConnectError::ServerName(name));
        }
        let (tls, pinned) = tls(&connect.trust)?;
        let tls = QuicClientConfig::try_from(tls)
            .map_err(|error| ConnectError::System(error.to_string()))?;
        let mut config = quinn::ClientConfig::new(Arc::new(tls));
        let mut transport = quinn::TransportConfig::default();
        transport
            .max_idle_timeout(IDLE_TIMEOUT.try_into().ok())
            .keep_alive_interval(Some(KEEP_ALIVE))
            .max_concurrent_bidi_streams(VarInt::from_u32(0))
            .max_concurrent_uni_streams(VarInt::from_u32(0))
            .stream_receive_window(VarInt::from_u32(RECEIVE_WINDOW_BYTES))
            .receive_window(VarInt::from_u32(RECEIVE_WINDOW_BYTES))
            .send_window(UPLINK_BUFFER_BYTES as u64)
            // The server sends none, but quinn sends none either unless it may receive them.
            .datagram_receive_buffer_size(Some(DATAGRAM_BUFFER_BYTES))
            .datagram_send_buffer_size(DATAGRAM_BUFFER_BYTES);
        config.transport_config(Arc::new(transport));
        Ok(Target {
            address: connect.address.into(),
            addresses,
            name,
            config,
            pinned,
        })
    }

    /// Tries all addresses at once, and takes the first that answers: `localhost` is `::1` and
    /// `127.0.0.1`, and a server that listens on one of them only does not answer on the other.
    async fn connect(&self) -> Result<(Endpoint, quinn::Connection), ConnectError> {
        let mut attempts = JoinSet::new();
        for &address in &self.addresses {
            let (config, name) = (self.config.clone(), self.name.clone());
            attempts.spawn(async move {
                let any = match address {
                    SocketAddr::V4(_) => SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
                    SocketAddr::V6(_) => SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0)),
                };
                let endpoint = Endpoint::client(any).map_err(Attempt::Socket)?;
                let connecting = endpoint.connect_with(config, address, &name);
                let quic = connecting.map_err(Attempt::Start)?.await;
                Ok((endpoint, quic.map_err(Attempt::Connection)?))
            });
        }
        let mut last = ConnectError::NoAnswer(self.address.clone());
        let all = async {
            while let Some(attempt) = attempts.join_next().await {
                match attempt {
                    Ok(Ok(connected)) => return Some(connected),
                    Ok(Err(Attempt::Socket(error))) => {
                        last = ConnectError::System(error.to_string());
                    }
                    Ok(Err(Attempt::Start(error))) => {
                        last = ConnectError::Failed(self.address.clone(), error.to_string());
                    }
                    Ok(Err(Attempt::Connection(error))) => last = self.error(&error),
                    Err(error) => last = ConnectError::System(error.to_string()),
                }
            }
            None
        };
        match tokio::time::timeout(CONNECT_TIMEOUT, all).await {
            Ok(Some(connected)) => Ok(connected),
            Ok(None) | Err(_) => Err(last),
        }
    }

    fn error(&self, error: &ConnectionError) -> ConnectError {
        let address = self.address.clone();
        let found = self.pinned.as_ref().and_then(|pinned| {
            let (expected, found) = (pinned.expected, *pinned.found.get()?);
            (expected != found).then_some(ConnectError::Fingerprint { expected, found })
        });
        if let Some(wrong) = found {
            return wrong;
        }
        const NO_APPLICATION_PROTOCOL: u64 = 0x100 | 120;
        match error {
            ConnectionError::TimedOut => ConnectError::NoAnswer(address),
            ConnectionError::VersionMismatch => ConnectError::Protocol(address),
            ConnectionError::ConnectionClosed(close)
                if u64::from(close.error_code) == NO_APPLICATION_PROTOCOL =>
            {
                ConnectError::Protocol(address)
            }
            ConnectionError::TransportError(error)
                if (0x100..0x200).contains(&u64::from(error.code)) =>
            {
                ConnectError::Certificate(address, error.reason.clone())
            }
            ConnectionError::ConnectionClosed(close)
                if close.error_code == quinn::TransportErrorCode::CONNECTION_REFUSED =>
            {
                ConnectError::Failed(address, "the server is busy: try again later".into())
            }
            other => ConnectError::Failed(address, other.to_string()),
        }
    }
}

/// Why one address did not work.
enum Attempt {
    Socket(std::io::Error),
    Start(quinn::ConnectError),
    Connection(ConnectionError),
}

fn tls(trust: &Trust) -> Result<(rustls::ClientConfig, Option<Arc<Pinned>>), ConnectError> {
    let provider = Arc::new(default_provider());
    let builder = rustls::ClientConfig::builder_with_provider(Arc::clone(&provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(|error| ConnectError::System(error.to_string()))?;
    let (mut config, pinned) = match trust {
        Trust::Fingerprint(expected) => {
            let pinned = Arc::new(Pinned {
                expected: *expected,
                found: OnceLock::new(),
                provider,
            });
            let config = builder
                .dangerous()
                .with_custom_certificate_verifier(Arc::clone(&pinned) as _)
                .with_no_client_auth();
            (config, Some(pinned))
        }
        Trust::RootsPem(pem) => {
            let mut roots = RootCertStore::empty();
            for certificate in CertificateDer::pem_slice_iter(pem) {
                let added = certificate.map_err(|error| error.to_string());
                let added = added.and_then(|der| roots.add(der).map_err(|e| e.to_string()));
                added.map_err(ConnectError::Roots)?;
            }
            if roots.is_empty() {
                return Err(ConnectError::Roots("there is none among them".into()));
            }
            let config = builder.with_root_certificates(roots).with_no_client_auth();
            (config, None)
        }
    };
    config.alpn_protocols = vec![ALPN.to_vec()];
    Ok((config, pinned))
}

/// Accepts one certificate. That the server has its key is checked as ever: without that, whoever
/// has seen the certificate could use it.
#[derive(Debug)]
struct Pinned {
    expected: Fingerprint,
    /// The certificate that was not accepted, for the error.
    found: OnceLock<Fingerprint>,
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let found = Fingerprint::of(end_entity);
        if found == self.expected {
            return Ok(ServerCertVerified::assertion());
        }
        let _ = self.found.set(found);
        Err(rustls::CertificateError::ApplicationVerificationFailure.into())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Err(rustls::Error::General("QUIC uses TLS 1.3".into()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        rustls::crypto::verify_tls13_signature(message, certificate, signature, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        let algorithms = &self.provider.signature_verification_algorithms;
        algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fingerprint_reads_back_as_it_is_written_and_as_openssl_writes_it() {
        // SHA-256 of "abc", from FIPS 180-2.
        let text = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        let abc = Fingerprint::of(b"abc");
        assert_eq!(abc.to_string(), text);
        assert_eq!(text.parse(), Ok(abc));
        let pairs: Vec<&str> = (0..32).map(|i| &text[2 * i..2 * i + 2]).collect();
        assert_eq!(pairs.join(":").to_uppercase().parse(), Ok(abc));
        for wrong in ["", &text[1..], &format!("{text}0"), &text.replace('b', "g")] {
            assert_eq!(wrong.parse::<Fingerprint>(), Err(NotAFingerprint));
        }
    }
}
