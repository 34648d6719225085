//! The server's transport: bytes to clients and messages from them, over QUIC.
//!
//! The frame loop asks [`Transport::events`] what came, and for each client that is
//! [`Transport::ready`] hands over the next frame's bytes; it never waits for a network. A client
//! whose network is slow stays not ready, and its next frame holds what changed meanwhile: at most
//! one frame and QUIC's own send window are ever on their way to it.
//!
//! A client is admitted here (token, scene, capacity, number); what it is sent after that, from
//! the preamble on, is the caller's.

use crate::identity::Identity;
use psao::quic::{ALPN, IDLE_TIMEOUT};
use psao_core::mirror::Capacity;
use psao_core::stream::{
    self, MAX_BODY_BYTES, PACKET_HEADER_BYTES, PREAMBLE, Packet, Reader, Refusal, StreamError,
    write_packet,
};
use psao_core::uplink::{
    Camera, Hello, MAX_JOINTS, MAX_TOKEN_BYTES, MAX_UPLINK_BODY_BYTES, Message, Presence, Transform,
};
use quinn::crypto::rustls::QuicServerConfig;
use quinn::{ConnectionError, Endpoint, Incoming, ReadExactError, RecvStream, SendStream, VarInt};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::runtime::{self, Runtime};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinSet;
use tracing::{debug, info};

/// Time from a client's first packet to its hello.
const HELLO_DEADLINE: Duration = Duration::from_secs(5);

/// Time a refused client has to read why.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(3);

/// Time to tell the clients that the server ends.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Connections that may be without a hello at once. Beyond half of them, a client must first show
/// that its address is its own, so that forged ones cannot keep others out.
const MAX_STRANGERS: usize = 64;

/// Body of the first packet: a hello with the longest token, and room for newer minor versions.
const MAX_HELLO_BODY_BYTES: u32 = 256 + MAX_TOKEN_BYTES as u32;

/// The send window holds what is in flight and what waits behind it. It follows the congestion
/// window, at twice its size: less would leave the link idle, more would only wait, and be old when
/// it arrives. The bounds: some frames of a slow start, and what a stalled client may hold of this
/// server's memory (670 Mbit/s at 50 ms).
const SEND_WINDOW_BYTES: std::ops::RangeInclusive<u64> = (128 << 10)..=(4 << 20);

/// Bytes written between two looks at the congestion window.
const PIECE_BYTES: usize = 64 << 10;

/// Uplink bytes in flight, a client.
const RECEIVE_WINDOW_BYTES: u32 = 256 << 10;

/// Datagrams that wait to be read, a client; older ones are dropped.
const DATAGRAM_BUFFER_BYTES: usize = 16 << 10;

/// Transforms and joints that wait for [`Transport::events`], a client; beyond this its stream is
/// not read, so that it is held back by QUIC's flow control.
const MAX_WAITING_BYTES: usize = 1 << 20;

/// How a connection was closed: the codes are for logs of the other side, the text says it.
mod code {
    use quinn::VarInt;
    pub const DONE: VarInt = VarInt::from_u32(0);
    pub const REFUSED: VarInt = VarInt::from_u32(1);
    pub const MALFORMED: VarInt = VarInt::from_u32(2);
    pub const STOPPED: VarInt = VarInt::from_u32(3);
}

/// What a server offers, and to whom.
#[derive(Debug)]
pub struct TransportConfig {
    /// Where to listen (UDP); port 0 takes a free one.
    pub listen: SocketAddr,
    /// Certificate and key.
    pub identity: Identity,
    /// What clients must present; at most [`MAX_TOKEN_BYTES`] long. Empty: clients with an empty
    /// token are served.
    pub token: String,
    /// Clients served at once.
    pub max_clients: usize,
    /// Hash of the scene; clients with another one are refused.
    pub scene_hash: u64,
    /// Room that the scene needs; clients with less are refused.
    pub capacity: Capacity,
}

/// Why a server cannot start.
#[derive(Debug)]
pub enum TransportError {
    /// The address cannot be listened on.
    Listen(SocketAddr, std::io::Error),
    /// The identity cannot be used (why).
    Identity(String),
    /// The token is longer than [`MAX_TOKEN_BYTES`] (its length).
    Token(usize),
    /// The system has no thread to give.
    Thread(std::io::Error),
}

impl std::fmt::Display for TransportError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            TransportError::Listen(address, error) => write!(
                f,
                "cannot listen on UDP {address}: {error}: choose another address or port, \
                 or stop what uses it"
            ),
            TransportError::Identity(why) => {
                write!(f, "the certificate cannot be used for TLS: {why}")
            }
            TransportError::Token(bytes) => write!(
                f,
                "the token has {bytes} bytes: choose one of at most {MAX_TOKEN_BYTES}"
            ),
            TransportError::Thread(error) => write!(f, "no thread for the network: {error}"),
        }
    }
}

impl std::error::Error for TransportError {}

/// A client, from its joining to its leaving; never used again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(u64);

impl std::fmt::Display for ClientId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "client {}", self.0)
    }
}

/// What a client has said of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Room {
    /// Room it has: what is admitted has all that [`TransportConfig::capacity`] asks for.
    pub capacity: Capacity,
    /// Hash of the patches it has already, all of them; 0 for none.
    pub topology_hash: u64,
}

/// What happened since the last look.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A client was admitted, and waits for the stream from its preamble on.
    Joined(ClientId, Room),
    /// A client is gone (why). Its last event.
    Left(ClientId, String),
    /// A client says something.
    Message(ClientId, OwnedMessage),
}

/// [`Message`], kept. All values are in the ranges that the uplink's reader checks.
#[derive(Clone, Debug, PartialEq)]
pub enum OwnedMessage {
    /// View: the newest only.
    Camera(Camera),
    /// Moved instance; the index may be one that the scene does not have.
    Transform(Transform),
    /// Posed instance; index and number of joints may be ones that the scene does not have.
    Joints {
        /// Instance index.
        instance: u32,
        /// Local from rest, three rows of four.
        matrices: Vec<[[f32; 4]; 3]>,
    },
    /// The frame with this id is in the client's mirror; the newest only.
    Ack(u32),
    /// A snapshot is needed.
    Resync,
    /// An instance goes or comes.
    Presence(Presence),
}

/// Listens for clients, on a thread of its own. Dropping it closes every connection.
#[derive(Debug)]
pub struct Transport {
    endpoint: Endpoint,
    local_addr: SocketAddr,
    shared: Arc<Shared>,
    /// `None` once closed.
    runtime: Option<Runtime>,
}

/// What the frame loop and the network's thread share.
#[derive(Debug)]
struct Shared {
    token: String,
    max_clients: usize,
    scene_hash: u64,
    capacity: Capacity,
    clients: Mutex<Clients>,
}

#[derive(Debug, Default)]
struct Clients {
    by_id: BTreeMap<ClientId, Client>,
    last_id: u64,
}

/// One client. All that it can make the server keep is in here, and bounded.
#[derive(Debug, Default)]
struct Client {
    joined_told: bool,
    room: Room,
    camera: Option<Camera>,
    ack: Option<u32>,
    resync: bool,
    /// Transforms and joints.
    waiting: Vec<OwnedMessage>,
    waiting_bytes: usize,
    downlink: Downlink,
    left: Option<String>,
    wake: Arc<Wake>,
}

/// The frame on its way to a client.
#[derive(Debug, Default)]
enum Downlink {
    #[default]
    Ready,
    Waiting(Vec<u8>),
    Writing,
}

#[derive(Debug, Default)]
struct Wake {
    /// There is a frame to write.
    frame: Notify,
    /// Waiting messages were taken.
    room: Notify,
}

impl Shared {
    /// Nothing panics while it holds the lock, so what it guards is whole.
    fn clients(&self) -> MutexGuard<'_, Clients> {
        self.clients.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs `change` on a client that has not left.
    fn with<T>(&self, id: ClientId, change: impl FnOnce(&mut Client) -> T) -> Option<T> {
        let mut clients = self.clients();
        let client = clients.by_id.get_mut(&id);
        client.filter(|client| client.left.is_none()).map(change)
    }

    /// Admits a client, or says why not.
    fn admit(&self, hello: &Hello<'_>) -> Result<(ClientId, Arc<Wake>), (Refusal, String)> {
        let refuse = |refusal: Refusal| Err((refusal, refusal.to_string()));
        if !equal_in_constant_time(hello.token, self.token.as_bytes()) {
            return refuse(Refusal::Token);
        }
        if hello.scene_hash != 0 && hello.scene_hash != self.scene_hash {
            return refuse(Refusal::Scene);
        }
        let (need, have) = (self.capacity, hello.capacity);
        if !have.holds(&need) {
            let text = format!(
                "{}: it needs {} instances, {} buckets, {} cells, {} slices, {} points, \
                 {} patches and {} bytes of topology",
                Refusal::Capacity,
                need.instances,
                need.buckets,
                need.cells,
                need.slices,
                need.points,
                need.patches,
                need.topology_bytes
            );
            return Err((Refusal::Capacity, text));
        }
        let mut clients = self.clients();
        let live = clients.by_id.values().filter(|c| c.left.is_none()).count();
        if live >= self.max_clients {
            return refuse(Refusal::Full);
        }
        clients.last_id += 1;
        let id = ClientId(clients.last_id);
        let client = Client {
            room: Room {
                capacity: have,
                topology_hash: hello.topology_hash,
            },
            ..Client::default()
        };
        let wake = Arc::clone(&client.wake);
        clients.by_id.insert(id, client);
        Ok((id, wake))
    }

    /// A client is gone. The first reason given stays.
    fn leave(&self, id: ClientId, why: String) {
        let mut clients = self.clients();
        let Some(client) = clients.by_id.get_mut(&id).filter(|c| c.left.is_none()) else {
            return;
        };
        info!("{id} left: {why}");
        client.downlink = Downlink::Ready;
        client.left = Some(why);
        if !client.joined_told {
            // Otherwise clients that come and go would pile up between two looks.
            clients.by_id.remove(&id);
        }
    }
}

impl Transport {
    /// Listens.
    ///
    /// # Errors
    /// The address, the identity or the token cannot be used.
    pub fn start(config: TransportConfig) -> Result<Transport, TransportError> {
        if config.token.len() > MAX_TOKEN_BYTES {
            return Err(TransportError::Token(config.token.len()));
        }
        let quic = quic_config(config.identity)?;
        let runtime = runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("psao-transport")
            .enable_all()
            .build()
            .map_err(TransportError::Thread)?;
        let listen = |error| TransportError::Listen(config.listen, error);
        let endpoint = {
            let _in_runtime = runtime.enter();
            Endpoint::server(quic, config.listen).map_err(listen)?
        };
        let local_addr = endpoint.local_addr().map_err(listen)?;
        let shared = Arc::new(Shared {
            token: config.token,
            max_clients: config.max_clients,
            scene_hash: config.scene_hash,
            capacity: config.capacity,
            clients: Mutex::default(),
        });
        runtime.spawn(accept(endpoint.clone(), Arc::clone(&shared)));
        Ok(Transport {
            endpoint,
            local_addr,
            shared,
            runtime: Some(runtime),
        })
    }

    /// Where it listens.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// What happened since the last call, never waiting: by client, the oldest first; of each
    /// client its camera, its acknowledgement and its resync, then moves and poses in the order
    /// sent. To be called every frame: clients are held back until then.
    pub fn events(&mut self) -> Vec<Event> {
        let mut events = Vec::new();
        self.shared.clients().by_id.retain(|&id, client| {
            if !client.joined_told {
                client.joined_told = true;
                events.push(Event::Joined(id, client.room));
            }
            let camera = client.camera.take().map(OwnedMessage::Camera);
            let ack = client.ack.take().map(OwnedMessage::Ack);
            let resync = std::mem::take(&mut client.resync).then_some(OwnedMessage::Resync);
            let newest = camera.into_iter().chain(ack).chain(resync);
            let messages = newest.chain(client.waiting.drain(..));
            events.extend(messages.map(|message| Event::Message(id, message)));
            client.waiting_bytes = 0;
            client.wake.room.notify_one();
            let left = client.left.take();
            let stays = left.is_none();
            events.extend(left.map(|why| Event::Left(id, why)));
            stays
        });
        events
    }

    /// The client is there, and all bytes sent to it before are in QUIC's hands: the next frame
    /// may be encoded for it.
    pub fn ready(&self, id: ClientId) -> bool {
        let ready = |client: &mut Client| matches!(client.downlink, Downlink::Ready);
        self.shared.with(id, ready).unwrap_or(false)
    }

    /// Sends stream bytes, of any length. To a client that has left meanwhile, nothing.
    ///
    /// # Panics
    /// If the client is there and was not [`Transport::ready`]: its mirror would go out of step,
    /// and no client can bring that about.
    pub fn send(&mut self, id: ClientId, bytes: Vec<u8>) {
        let taken = self.shared.with(id, |client| {
            let ready = matches!(client.downlink, Downlink::Ready);
            if ready {
                client.downlink = Downlink::Waiting(bytes);
                client.wake.frame.notify_one();
            }
            ready
        });
        assert_ne!(
            taken,
            Some(false),
            "{id} is sent a frame while it is not ready"
        );
    }

    /// Closes every connection, telling the clients, and ends the thread; as dropping does. Waits
    /// at most 1 s. Afterwards nobody is ready and nothing happens.
    pub fn close(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            self.endpoint.close(code::DONE, b"the server shut down");
            runtime.block_on(async {
                let idle = self.endpoint.wait_idle();
                let _ = tokio::time::timeout(CLOSE_TIMEOUT, idle).await;
            });
            drop(runtime);
            self.shared.clients().by_id.clear();
        }
    }
}

impl Drop for Transport {
    fn drop(&mut self) {
        self.close();
    }
}

fn quic_config(identity: Identity) -> Result<quinn::ServerConfig, TransportError> {
    let failed = |error: &dyn std::error::Error| TransportError::Identity(error.to_string());
    let mut tls = identity.into_tls().map_err(|error| failed(&error))?;
    tls.alpn_protocols = vec![ALPN.to_vec()];
    let tls = QuicServerConfig::try_from(tls).map_err(|error| failed(&error))?;
    let mut transport = quinn::TransportConfig::default();
    transport
        .max_idle_timeout(IDLE_TIMEOUT.try_into().ok())
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .stream_receive_window(VarInt::from_u32(RECEIVE_WINDOW_BYTES))
        .receive_window(VarInt::from_u32(RECEIVE_WINDOW_BYTES))
        .send_window(*SEND_WINDOW_BYTES.start())
        .datagram_receive_buffer_size(Some(DATAGRAM_BUFFER_BYTES));
    let mut config = quinn::ServerConfig::with_crypto(Arc::new(tls));
    config
        .transport_config(Arc::new(transport))
        .max_incoming(MAX_STRANGERS);
    Ok(config)
}

async fn accept(endpoint: Endpoint, shared: Arc<Shared>) {
    let strangers = Arc::new(Semaphore::new(MAX_STRANGERS));
    while let Some(incoming) = endpoint.accept().await {
        let crowded = strangers.available_permits() < MAX_STRANGERS / 2;
        let Ok(place) = Arc::clone(&strangers).try_acquire_owned() else {
            incoming.refuse();
            continue;
        };
        if crowded && !incoming.remote_address_validated() && incoming.may_retry() {
            // It may retry, so this does not fail.
            let _ = incoming.retry();
            continue;
        }
        tokio::spawn(serve(incoming, Arc::clone(&shared), place));
    }
}

/// A connection, from its first packet to its last.
async fn serve(incoming: Incoming, shared: Arc<Shared>, place: OwnedSemaphorePermit) {
    let from = incoming.remote_address();
    let introduction = async {
        let connection = incoming.await?;
        let (send, mut receive) = connection.accept_bi().await?;
        let mut packets = Packets::default();
        let admission = match packets.read(&mut receive, MAX_HELLO_BODY_BYTES).await {
            Ok(Some(Message::Hello(hello))) => shared.admit(&hello),
            Err(End::Malformed(StreamError::Version(version))) => Err((
                Refusal::Version,
                format!("{} (the client has {version})", Refusal::Version),
            )),
            Ok(_) | Err(End::Malformed(_)) => {
                Err((Refusal::Malformed, Refusal::Malformed.to_string()))
            }
            Err(End::Finished) => Err((Refusal::Malformed, Refusal::Malformed.to_string())),
            Err(End::Lost(error)) => return Err(error),
        };
        Ok((connection, send, receive, packets, admission))
    };
    let introduced = tokio::time::timeout(HELLO_DEADLINE, introduction).await;
    let (connection, send, receive, packets, admission) = match introduced {
        Ok(Ok(introduced)) => introduced,
        Ok(Err(error)) => return debug!("{from} did not get to its hello: {error}"),
        Err(_) => return debug!("{from} said no hello in time"),
    };
    let (id, wake) = match admission {
        Ok(admitted) => admitted,
        Err((refusal, text)) => {
            info!("{from} refused: {text}");
            return refuse(&connection, send, refusal, &text).await;
        }
    };
    drop(place);
    info!("{id} joined from {from}");
    // They end with this function.
    let mut beside = JoinSet::new();
    beside.spawn(write_frames(
        connection.clone(),
        send,
        Arc::clone(&shared),
        id,
        Arc::clone(&wake),
    ));
    beside.spawn(read_datagrams(connection.clone(), Arc::clone(&shared), id));
    let end = read_messages(receive, packets, &shared, id, &wake).await;
    close(&connection, &shared, id, end);
}

/// Tells a client why it is not served. It closes the connection when it has read that.
async fn refuse(
    connection: &quinn::Connection,
    mut send: SendStream,
    refusal: Refusal,
    text: &str,
) {
    let mut bytes = [0; 512];
    let body = |w: &mut stream::Writer<'_>| {
        w.u16(refusal as u16)?;
        w.bytes(text.as_bytes())
    };
    let (preamble, packet) = bytes.split_at_mut(PREAMBLE.len());
    preamble.copy_from_slice(&PREAMBLE);
    let length = write_packet(packet, stream::kind::REFUSE, 0, 0, body).unwrap_or(0);
    let told = async {
        let written = send.write_all(&bytes[..PREAMBLE.len() + length]).await;
        if written.is_ok() && send.finish().is_ok() {
            connection.closed().await;
        }
    };
    let _ = tokio::time::timeout(REFUSAL_TIMEOUT, told).await;
    connection.close(code::REFUSED, text.as_bytes());
}

/// Why a client's messages end.
enum End {
    /// It finished its stream.
    Finished,
    /// It sent what cannot be understood.
    Malformed(StreamError),
    /// The connection ended.
    Lost(ConnectionError),
}

impl From<StreamError> for End {
    fn from(error: StreamError) -> End {
        End::Malformed(error)
    }
}

impl From<ReadExactError> for End {
    fn from(error: ReadExactError) -> End {
        match error {
            ReadExactError::FinishedEarly(0) => End::Finished,
            ReadExactError::ReadError(quinn::ReadError::ConnectionLost(error)) => End::Lost(error),
            // Cut off within a packet.
            ReadExactError::FinishedEarly(_) | ReadExactError::ReadError(_) => {
                End::Malformed(StreamError::Length)
            }
        }
    }
}

/// Closes a connection, and says in words why.
fn close(connection: &quinn::Connection, shared: &Shared, id: ClientId, end: End) {
    let (code, why) = match end {
        End::Finished => (code::DONE, "the client ended its stream".into()),
        End::Malformed(error) => (code::MALFORMED, format!("it sent a bad message: {error}")),
        End::Lost(ConnectionError::ApplicationClosed(_)) => {
            (code::DONE, "the client closed the connection".into())
        }
        End::Lost(ConnectionError::TimedOut) => (code::DONE, "no sign of life".into()),
        End::Lost(error) => (code::DONE, format!("the connection was lost: {error}")),
    };
    connection.close(code, why.as_bytes());
    shared.leave(id, why);
}

/// Reads the packets of one uplink stream.
#[derive(Default)]
struct Packets {
    bytes: Vec<u8>,
    next_sequence: u16,
}

impl Packets {
    /// The next message. `None`: one that may be skipped.
    async fn read(
        &mut self,
        stream: &mut RecvStream,
        max_body_bytes: u32,
    ) -> Result<Option<Message<'_>>, End> {
        self.bytes.resize(PACKET_HEADER_BYTES, 0);
        stream.read_exact(&mut self.bytes).await?;
        let body_bytes = Reader(&self.bytes[4..]).u32()?;
        if body_bytes > max_body_bytes {
            return Err(StreamError::PacketTooLarge(body_bytes).into());
        }
        self.bytes
            .resize(PACKET_HEADER_BYTES + body_bytes as usize, 0);
        match stream
            .read_exact(&mut self.bytes[PACKET_HEADER_BYTES..])
            .await
        {
            Err(ReadExactError::FinishedEarly(_)) => return Err(StreamError::Length.into()),
            read => read?,
        }
        let (packet, _) = Packet::read(&self.bytes, max_body_bytes)?.ok_or(StreamError::Length)?;
        if packet.sequence != self.next_sequence {
            return Err(StreamError::Sequence.into());
        }
        self.next_sequence = packet.sequence.wrapping_add(1);
        Ok(Message::read(&packet)?)
    }
}

async fn read_messages(
    mut stream: RecvStream,
    mut packets: Packets,
    shared: &Shared,
    id: ClientId,
    wake: &Wake,
) -> End {
    loop {
        let full = |client: &mut Client| client.waiting_bytes >= MAX_WAITING_BYTES;
        while shared.with(id, full).unwrap_or(false) {
            wake.room.notified().await;
        }
        let message = match packets.read(&mut stream, MAX_UPLINK_BODY_BYTES).await {
            Ok(Some(message)) => message,
            Ok(None) => continue,
            Err(end) => return end,
        };
        let (bytes, owned) = match message {
            Message::Hello(_) => return End::Malformed(StreamError::Order),
            Message::Camera(camera) => {
                shared.with(id, |client| client.camera = Some(camera));
                continue;
            }
            Message::Ack(frame_id) => {
                shared.with(id, |client| client.ack = Some(frame_id));
                continue;
            }
            Message::Resync => {
                shared.with(id, |client| client.resync = true);
                continue;
            }
            Message::Transform(transform) => (0, OwnedMessage::Transform(transform)),
            Message::Presence(presence) => (0, OwnedMessage::Presence(presence)),
            Message::Joints(joints) => {
                let matrices: Vec<_> = joints.matrices().collect();
                let instance = joints.instance;
                let bytes = size_of_val(matrices.as_slice());
                (bytes, OwnedMessage::Joints { instance, matrices })
            }
        };
        shared.with(id, |client| {
            client.waiting_bytes += size_of::<OwnedMessage>() + bytes;
            client.waiting.push(owned);
        });
    }
}

/// Cameras and acknowledgements. What was overtaken on the way is dropped.
async fn read_datagrams(connection: quinn::Connection, shared: Arc<Shared>, id: ClientId) {
    let (mut last_camera, mut last_ack) = (None, None);
    // Sequences wrap, and a kind may be silent for longer than that takes: a camera that stands
    // still. So they are told by the newest of both kinds.
    let mut newest = 0i64;
    let mut newer = |sequence: u16, last: &mut Option<i64>| {
        let number = newest + i64::from(sequence.wrapping_sub(newest as u16) as i16);
        newest = newest.max(number);
        let newer = last.is_none_or(|last| number > last);
        if newer {
            *last = Some(number);
        }
        newer
    };
    // Where the connection ends, the stream's reader says why.
    while let Ok(datagram) = connection.read_datagram().await {
        let read = || -> Result<(u16, Option<Message<'_>>), StreamError> {
            let (packet, length) =
                Packet::read(&datagram, MAX_BODY_BYTES)?.ok_or(StreamError::Length)?;
            if length != datagram.len() {
                return Err(StreamError::Length);
            }
            Ok((packet.sequence, Message::read(&packet)?))
        };
        match read() {
            Ok((sequence, Some(Message::Camera(camera)))) => {
                if newer(sequence, &mut last_camera) {
                    shared.with(id, |client| client.camera = Some(camera));
                }
            }
            Ok((sequence, Some(Message::Ack(frame_id)))) => {
                if newer(sequence, &mut last_ack) {
                    shared.with(id, |client| client.ack = Some(frame_id));
                }
            }
            Ok((_, None)) => {}
            Ok(_) => return close(&connection, &shared, id, StreamError::Order.into()),
            Err(error) => return close(&connection, &shared, id, error.into()),
        }
    }
}

async fn write_frames(
    connection: quinn::Connection,
    mut stream: SendStream,
    shared: Arc<Shared>,
    id: ClientId,
    wake: Arc<Wake>,
) {
    loop {
        let waiting = shared.with(id, |client| match &mut client.downlink {
            Downlink::Waiting(bytes) => {
                let bytes = std::mem::take(bytes);
                client.downlink = Downlink::Writing;
                Some(bytes)
            }
            Downlink::Ready | Downlink::Writing => None,
        });
        let Some(bytes) = waiting.flatten() else {
            wake.frame.notified().await;
            continue;
        };
        for piece in bytes.chunks(PIECE_BYTES) {
            let window = connection.stats().path.cwnd.saturating_mul(2);
            let (least, most) = SEND_WINDOW_BYTES.into_inner();
            connection.set_send_window(window.clamp(least, most));
            if let Err(error) = stream.write_all(piece).await {
                if let quinn::WriteError::Stopped(_) = error {
                    connection.close(code::STOPPED, b"the client stopped the stream");
                    shared.leave(id, "the client stopped the stream".into());
                }
                return;
            }
        }
        shared.with(id, |client| client.downlink = Downlink::Ready);
    }
}

/// Compares in a time that depends on the lengths only, so that a token cannot be found out byte
/// by byte.
fn equal_in_constant_time(a: &[u8], b: &[u8]) -> bool {
    let differing = a.iter().zip(b).fold(0, |bits, (a, b)| bits | (a ^ b));
    a.len() == b.len() && std::hint::black_box(differing) == 0
}

const _: () = assert!(
    MAX_JOINTS as usize * 48 < MAX_WAITING_BYTES,
    "one message is less than what may wait"
);
