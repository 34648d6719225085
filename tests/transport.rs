//! The transport over real QUIC on the loopback interface: what one side sends is what the other
//! gets, and what may go wrong ends in words.
//!
//! Waits end with what they wait for; their limits are only there to fail instead of hanging.

use psao::core::mirror::Capacity;
use psao::core::stream::{self, PACKET_HEADER_BYTES, Refusal, write_packet};
use psao::core::uplink::{self, Camera, Hello, Transform};
use psao::quic::{ALPN, Closed, Connect, ConnectError, Connection, Fingerprint, Trust, Unsent};
use psao::{Client, ClientError, Config};
use psao_server::identity::{CERTIFICATE_FILE, Identity};
use psao_server::transport::{
    ClientId, Event, OwnedMessage, Transport, TransportConfig, TransportError,
};
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::Runtime;

const TOKEN: &str = "open sesame";
const SCENE: u64 = 0x5ce4e;
const NEEDS: Capacity = Capacity {
    instances: 10,
    buckets: 20,
    cells: 30,
    slices: 0,
    points: 0,
    patches: 0,
    topology_bytes: 0,
};

/// After so long a wait has failed.
const TOO_LONG: Duration = Duration::from_secs(60);

/// A server, its events kept until a test asks for them.
struct Server {
    transport: Transport,
    fingerprint: Fingerprint,
    certificate: Vec<u8>,
    events: VecDeque<Event>,
}

impl Server {
    fn start(max_clients: usize) -> Server {
        let folder = tempfile::tempdir().unwrap();
        let identity = Identity::load_or_create(folder.path()).unwrap();
        let certificate = std::fs::read(folder.path().join(CERTIFICATE_FILE)).unwrap();
        let fingerprint = identity.fingerprint();
        let transport = Transport::start(TransportConfig {
            listen: "127.0.0.1:0".parse().unwrap(),
            identity,
            token: TOKEN.into(),
            max_clients,
            scene_hash: SCENE,
            capacity: NEEDS,
        });
        Server {
            transport: transport.unwrap(),
            fingerprint,
            certificate,
            events: VecDeque::new(),
        }
    }

    fn address(&self) -> String {
        self.transport.local_addr().to_string()
    }

    /// What a client that is welcome says.
    fn open(&self, change: impl FnOnce(&mut Connect<'_>)) -> Result<Connection, ConnectError> {
        let address = self.address();
        let mut connect = Connect {
            address: &address,
            server_name: None,
            token: TOKEN,
            trust: Trust::Fingerprint(self.fingerprint),
            scene_hash: SCENE,
            capacity: NEEDS,
            topology_hash: 0,
        };
        change(&mut connect);
        Connection::open(connect)
    }

    fn poll(&mut self) {
        self.events.extend(self.transport.events());
    }

    fn next_event(&mut self) -> Event {
        wait("an event", || {
            self.poll();
            self.events.pop_front()
        })
    }

    fn joined(&mut self) -> ClientId {
        match self.next_event() {
            Event::Joined(id, _) => id,
            other => panic!("{other:?} instead of a client joining"),
        }
    }

    fn left(&mut self, id: ClientId) -> String {
        match self.next_event() {
            Event::Left(left, why) if left == id => why,
            other => panic!("{other:?} instead of {id} leaving"),
        }
    }

    fn message(&mut self, id: ClientId) -> OwnedMessage {
        match self.next_event() {
            Event::Message(from, message) if from == id => message,
            other => panic!("{other:?} instead of a message of {id}"),
        }
    }

    fn client(&mut self) -> (Connection, ClientId) {
        let connection = self.open(|_| ()).unwrap();
        let id = self.joined();
        (connection, id)
    }

    fn send(&mut self, id: ClientId, bytes: Vec<u8>) {
        wait("the client to be ready", || {
            self.transport.ready(id).then_some(())
        });
        self.transport.send(id, bytes);
    }
}

/// Looks until there is something.
fn wait<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let pause = Duration::from_millis(1);
    let looks = TOO_LONG.as_millis() / pause.as_millis();
    for _ in 0..looks {
        if let Some(found) = look() {
            return found;
        }
        std::thread::sleep(pause);
    }
    panic!("waited in vain for {what}");
}

/// Receives `count` bytes, and sees that there are no more.
fn receive(connection: &mut Connection, count: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    while bytes.len() < count {
        let came = connection.receive_timeout(&mut bytes, TOO_LONG).unwrap();
        assert_ne!(came, 0, "{} of {count} bytes came", bytes.len());
    }
    assert_eq!(bytes.len(), count);
    bytes
}

/// Receives until nothing more will come.
fn closed(connection: &mut Connection) -> (Vec<u8>, Closed) {
    let mut bytes = Vec::new();
    loop {
        match connection.receive_timeout(&mut bytes, TOO_LONG) {
            Ok(came) => assert_ne!(came, 0, "it does not end"),
            Err(why) => return (bytes, why),
        }
    }
}

/// Bytes of a frame that no other frame has.
fn frame(number: u32, length: usize) -> Vec<u8> {
    let mut state = number.wrapping_mul(2_654_435_761) | 1;
    let bytes = (0..length).map(|_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    });
    bytes.collect()
}

fn refused(bytes: &[u8]) -> (Refusal, String) {
    let mut client = Client::new(Config {
        capacity: NEEDS,
        scene_hash: SCENE,
    });
    match client.push(bytes) {
        Err(ClientError::Refused(Some(refusal), words)) => (refusal, words.to_string()),
        other => panic!("{other:?} instead of a refusal"),
    }
}

/// A client that says whatever a test wants.
struct Raw {
    runtime: Runtime,
    connection: quinn::Connection,
    send: quinn::SendStream,
    receive: quinn::RecvStream,
}

impl Raw {
    fn connect(server: &Server, alpn: &[u8]) -> Result<Raw, quinn::ConnectionError> {
        let mut roots = rustls::RootCertStore::empty();
        use rustls::pki_types::{CertificateDer, pem::PemObject};
        let certificate = CertificateDer::from_pem_slice(&server.certificate).unwrap();
        roots.add(certificate).unwrap();
        let provider = rustls::crypto::ring::default_provider();
        let mut tls = rustls::ClientConfig::builder_with_provider(provider.into())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        tls.alpn_protocols = vec![alpn.to_vec()];
        let tls = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
        let mut config = quinn::ClientConfig::new(Arc::new(tls));
        let mut transport = quinn::TransportConfig::default();
        // Negotiated: the shorter one of both sides'. Only the test of a client that vanishes
        // comes to it.
        transport.max_idle_timeout(Some(Duration::from_secs(3).try_into().unwrap()));
        // It takes whatever the server has.
        transport.stream_receive_window(quinn::VarInt::MAX);
        config.transport_config(Arc::new(transport));
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let opened = runtime.block_on(async {
            let any: SocketAddr = "127.0.0.1:0".parse().unwrap();
            let endpoint = quinn::Endpoint::client(any).unwrap();
            let to = server.transport.local_addr();
            let connection = endpoint.connect_with(config, to, "localhost").unwrap();
            let connection = connection.await?;
            let (send, receive) = connection.open_bi().await?;
            Ok((connection, send, receive))
        });
        opened.map(|(connection, send, receive)| Raw {
            runtime,
            connection,
            send,
            receive,
        })
    }

    fn open(server: &Server) -> Raw {
        Raw::connect(server, ALPN).unwrap()
    }

    fn say(&mut self, bytes: &[u8]) {
        self.runtime.block_on(self.send.write_all(bytes)).unwrap();
    }

    fn datagram(&self, bytes: Vec<u8>) {
        self.connection.send_datagram(bytes.into()).unwrap();
    }

    /// All that comes until the stream's end.
    fn answer(&mut self) -> Vec<u8> {
        let answer = self.receive.read_to_end(1 << 16);
        self.runtime.block_on(answer).unwrap()
    }
}

fn packet(
    kind: u8,
    sequence: u16,
    body: impl FnOnce(&mut stream::Writer<'_>) -> Result<(), stream::StreamError>,
) -> Vec<u8> {
    let mut bytes = vec![0; 1 << 10];
    let length = write_packet(&mut bytes, kind, 0, sequence, body).unwrap();
    bytes.truncate(length);
    bytes
}

fn hello() -> Vec<u8> {
    let hello = Hello {
        token: TOKEN.as_bytes(),
        scene_hash: 0,
        capacity: NEEDS,
        topology_hash: 0,
    };
    packet(uplink::kind::HELLO, 0, |w| hello.write(w))
}

fn camera(x: f64) -> Camera {
    Camera {
        position_m: [x, 0.0, 0.0],
        forward: [0.0, 0.0, -1.0],
        up: [0.0, 1.0, 0.0],
        fov_y_rad: 1.0,
        aspect: 1.5,
        height_px: 0,
    }
}

fn transform(instance: u32) -> Transform {
    let world_from_local = [[1.0, 0.0, 0.0, 0.5]; 3];
    Transform {
        instance,
        world_from_local,
    }
}

#[test]
fn every_byte_arrives_once_and_in_order_whatever_a_frame_s_size() {
    let mut server = Server::start(1);
    let (mut connection, id) = server.client();
    let mut into = Vec::new();
    assert_eq!(connection.receive(&mut into), Ok(0), "nothing was sent yet");
    for (number, length) in [
        (1, 8),
        (2, 1),
        (3, 0),
        (4, 1500),
        (5, 20_000_000),
        (6, 70_000),
    ] {
        let sent = frame(number, length);
        server.send(id, sent.clone());
        let came = receive(&mut connection, length);
        assert!(came == sent, "frame {number} is another one");
    }
}

#[test]
fn a_client_that_joins_late_gets_its_own_stream_from_the_start() {
    let mut server = Server::start(2);
    let (mut early, early_id) = server.client();
    for number in 0..10 {
        server.send(early_id, frame(number, 5000));
        receive(&mut early, 5000);
    }
    let (mut late, late_id) = server.client();
    assert!(late_id > early_id);
    server.send(late_id, frame(100, 3000));
    server.send(early_id, frame(10, 5000));
    assert!(receive(&mut late, 3000) == frame(100, 3000));
    assert!(receive(&mut early, 5000) == frame(10, 5000));
}

#[test]
fn a_client_is_refused_in_the_stream_with_the_reason() {
    let mut server = Server::start(0);
    type Change = fn(&mut Connect<'_>);
    let cases: [(Change, Refusal); 8] = [
        (|c| c.token = "open sesam", Refusal::Token),
        (|c| c.token = "open sesamf", Refusal::Token),
        (|c| c.token = "", Refusal::Token),
        (|c| c.scene_hash = 1, Refusal::Scene),
        (|c| c.capacity.instances -= 1, Refusal::Capacity),
        (|c| c.capacity.buckets -= 1, Refusal::Capacity),
        (|c| c.capacity.cells -= 1, Refusal::Capacity),
        (|c| c.scene_hash = 0, Refusal::Full),
    ];
    for (change, expected) in cases {
        let mut connection = server.open(change).unwrap();
        let (bytes, why) = closed(&mut connection);
        let (refusal, text) = refused(&bytes);
        assert_eq!(refusal, expected);
        assert!(text.starts_with(&expected.to_string()), "{text}");
        assert_eq!(why, Closed::Ended);
        assert_eq!(connection.resync(), Err(Unsent::Closed));
    }
    server.poll();
    assert_eq!(server.events, [], "none of them joined");
}

#[test]
fn a_hello_that_is_none_is_refused_and_the_server_goes_on() {
    let mut server = Server::start(1);
    let mut other_version = hello();
    other_version[PACKET_HEADER_BYTES] = 2;
    let other_version = packet(uplink::kind::HELLO, 0, |w| {
        w.bytes(&other_version[PACKET_HEADER_BYTES..])
    });
    let mut changed = hello();
    *changed.last_mut().unwrap() ^= 1;
    let long = packet(uplink::kind::HELLO, 0, |w| w.bytes(&[0; 600]));
    let cases = [
        (
            b"GET / HTTP/1.1\r\nHost: psao\r\n\r\n".to_vec(),
            Refusal::Malformed,
        ),
        (vec![0xff; 1000], Refusal::Malformed),
        (vec![], Refusal::Malformed),
        (hello()[..20].to_vec(), Refusal::Malformed),
        (changed, Refusal::Malformed),
        (long, Refusal::Malformed),
        (
            packet(uplink::kind::HELLO, 1, |w| {
                w.bytes(&hello()[PACKET_HEADER_BYTES..])
            }),
            Refusal::Malformed,
        ),
        (
            packet(uplink::kind::HELLO, 0, |w| {
                w.bytes(&hello()[PACKET_HEADER_BYTES..][..14])
            }),
            Refusal::Malformed,
        ),
        (
            packet(uplink::kind::RESYNC, 0, |_| Ok(())),
            Refusal::Malformed,
        ),
        (
            packet(stream::kind::FRAME, 0, |_| Ok(())),
            Refusal::Malformed,
        ),
        (other_version, Refusal::Version),
    ];
    for (bytes, expected) in cases {
        let mut raw = Raw::open(&server);
        raw.say(&bytes);
        raw.send.finish().unwrap();
        assert_eq!(refused(&raw.answer()).0, expected, "{bytes:?}");
    }
    server.client();
    assert_eq!(server.events, []);
}

#[test]
fn a_bad_message_ends_its_client_only() {
    let mut server = Server::start(2);
    let (mut other, other_id) = server.client();
    let mut nan = transform(0);
    nan.world_from_local[1][2] = f64::NAN;
    let on_the_stream = [
        vec![0xff; 100],
        packet(uplink::kind::HELLO, 1, |w| {
            w.bytes(&hello()[PACKET_HEADER_BYTES..])
        }),
        packet(uplink::kind::TRANSFORM, 1, |w| nan.write(w)),
        packet(uplink::kind::RESYNC, 2, |_| Ok(())),
        packet(77, 1, |_| Ok(())),
    ];
    for bytes in on_the_stream {
        let mut raw = Raw::open(&server);
        raw.say(&hello());
        let id = server.joined();
        raw.say(&bytes);
        let why = server.left(id);
        assert!(why.starts_with("it sent a bad message"), "{why}");
    }
    let in_a_datagram = [
        vec![],
        vec![0xff; 100],
        packet(uplink::kind::RESYNC, 0, |_| Ok(())),
        [packet(uplink::kind::ACK, 0, |w| w.u32(1)), vec![0]].concat(),
    ];
    for bytes in in_a_datagram {
        let mut raw = Raw::open(&server);
        raw.say(&hello());
        let id = server.joined();
        raw.datagram(bytes);
        let why = server.left(id);
        assert!(why.starts_with("it sent a bad message"), "{why}");
    }
    server.send(other_id, frame(1, 1000));
    receive(&mut other, 1000);
}

#[test]
fn an_unknown_message_that_may_be_skipped_is_skipped() {
    let mut server = Server::start(1);
    let mut raw = Raw::open(&server);
    let mut skipped = vec![0; 100];
    let optional = stream::flag::OPTIONAL;
    let length = write_packet(&mut skipped, 99, optional, 1, |w| w.u64(7)).unwrap();
    skipped.truncate(length);
    let resync = packet(uplink::kind::RESYNC, 2, |_| Ok(()));
    raw.say(&[hello(), skipped.clone(), resync].concat());
    let id = server.joined();
    assert_eq!(server.message(id), OwnedMessage::Resync);
    raw.datagram(skipped);
    raw.datagram(packet(uplink::kind::ACK, 0, |w| w.u32(9)));
    assert_eq!(server.message(id), OwnedMessage::Ack(9));
}

#[test]
fn only_the_pinned_certificate_is_trusted() {
    let server = Server::start(1);
    let expected = Identity::ephemeral().unwrap().fingerprint();
    let error = server
        .open(|c| c.trust = Trust::Fingerprint(expected))
        .err();
    let found = server.fingerprint;
    assert_eq!(error, Some(ConnectError::Fingerprint { expected, found }));
    let text = error.unwrap().to_string();
    assert!(text.contains(&found.to_string()) && text.contains(&expected.to_string()));
    // Names and dates do not matter.
    server
        .open(|c| c.server_name = Some("elsewhere.example"))
        .unwrap();
}

#[test]
fn roots_are_trusted_for_the_server_s_name_only() {
    let mut server = Server::start(8);
    let roots = Trust::RootsPem(server.certificate.clone());
    // The address itself is a name in the certificate.
    let mut connection = server.open(|c| c.trust = roots.clone()).unwrap();
    let id = server.joined();
    server.send(id, frame(1, 100));
    assert_eq!(receive(&mut connection, 100), frame(1, 100));
    let named = |name: &'static str| {
        let trust = roots.clone();
        server.open(move |c| {
            c.trust = trust;
            c.server_name = Some(name);
        })
    };
    assert!(named("localhost").is_ok());
    let error = named("elsewhere.example").err().unwrap();
    assert!(matches!(error, ConnectError::Certificate(..)), "{error}");

    let other = Server::start(1);
    let trust = Trust::RootsPem(other.certificate.clone());
    let error = server.open(|c| c.trust = trust).err().unwrap();
    assert!(matches!(error, ConnectError::Certificate(..)), "{error}");
}

#[test]
fn arguments_that_cannot_work_are_told_apart() {
    let server = Server::start(1);
    let long = "x".repeat(uplink::MAX_TOKEN_BYTES + 1);
    let error = |change: &dyn Fn(&mut Connect<'_>)| {
        let opened = server.open(|connect| change(connect));
        opened.err().expect("it cannot work")
    };
    for address in [
        "",
        "localhost",
        "localhost:",
        "localhost:http3",
        "[::1:5",
        "1.2.3.4:99999",
    ] {
        let connect = Connect {
            address,
            server_name: None,
            token: TOKEN,
            trust: Trust::Fingerprint(server.fingerprint),
            scene_hash: 0,
            capacity: NEEDS,
            topology_hash: 0,
        };
        let error = Connection::open(connect).err().unwrap();
        assert!(
            matches!(error, ConnectError::Address(..)),
            "{address}: {error}"
        );
    }
    let name = error(&|c| c.server_name = Some("not a name"));
    assert!(matches!(name, ConnectError::ServerName(_)), "{name}");
    for pem in [
        "",
        "none",
        "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
    ] {
        let roots = error(&|c| c.trust = Trust::RootsPem(pem.into()));
        assert!(matches!(roots, ConnectError::Roots(_)), "{roots}");
    }
    let connect = |token: &str| {
        Connection::open(Connect {
            address: &server.address(),
            server_name: None,
            token,
            trust: Trust::Fingerprint(server.fingerprint),
            scene_hash: 0,
            capacity: NEEDS,
            topology_hash: 0,
        })
    };
    assert_eq!(connect(&long).err(), Some(ConnectError::Token(257)));
    assert!(connect(&long[1..]).is_ok());
}

#[test]
fn a_name_with_several_addresses_reaches_the_one_that_listens() {
    let mut server = Server::start(2);
    let address = format!("localhost:{}", server.transport.local_addr().port());
    let connection = Connection::open(Connect {
        address: &address,
        server_name: None,
        token: TOKEN,
        trust: Trust::RootsPem(server.certificate.clone()),
        scene_hash: 0,
        capacity: NEEDS,
        topology_hash: 0,
    });
    let _connection = connection.unwrap();
    server.joined();
}

/// Takes as long as the client tries: nothing else tells a server that is not there from one that
/// is slow.
#[test]
fn where_no_server_is_the_error_says_so() {
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = silent.local_addr().unwrap().to_string();
    let opened = Connection::open(Connect {
        address: &address,
        server_name: None,
        token: TOKEN,
        trust: Trust::Fingerprint(Fingerprint([0; 32])),
        scene_hash: 0,
        capacity: NEEDS,
        topology_hash: 0,
    });
    assert_eq!(opened.err(), Some(ConnectError::NoAnswer(address)));
}

#[test]
fn another_protocol_is_turned_away_on_both_sides() {
    let server = Server::start(1);
    assert!(Raw::connect(&server, b"h3").is_err());

    let identity_folder = tempfile::tempdir().unwrap();
    let (endpoint, fingerprint, runtime) = raw_server(identity_folder.path(), b"h3", true);
    let address = endpoint.local_addr().unwrap().to_string();
    runtime.spawn(async move {
        while let Some(incoming) = endpoint.accept().await {
            let _ = incoming.await;
        }
    });
    let opened = Connection::open(Connect {
        address: &address,
        server_name: None,
        token: TOKEN,
        trust: Trust::Fingerprint(fingerprint),
        scene_hash: 0,
        capacity: NEEDS,
        topology_hash: 0,
    });
    assert_eq!(opened.err(), Some(ConnectError::Protocol(address)));
}

/// A QUIC server that is not ours.
fn raw_server(
    folder: &std::path::Path,
    alpn: &[u8],
    datagrams: bool,
) -> (quinn::Endpoint, Fingerprint, Runtime) {
    use rustls::pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject};
    let fingerprint = Identity::load_or_create(folder).unwrap().fingerprint();
    let certificate = CertificateDer::from_pem_file(folder.join(CERTIFICATE_FILE)).unwrap();
    let key = PrivateKeyDer::from_pem_file(folder.join("key.pem")).unwrap();
    let provider = rustls::crypto::ring::default_provider();
    let mut tls = rustls::ServerConfig::builder_with_provider(provider.into())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![certificate], key)
        .unwrap();
    tls.alpn_protocols = vec![alpn.to_vec()];
    let tls = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
    let mut config = quinn::ServerConfig::with_crypto(Arc::new(tls));
    let mut transport = quinn::TransportConfig::default();
    transport.datagram_receive_buffer_size(datagrams.then_some(1 << 16));
    config.transport_config(Arc::new(transport));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let endpoint = {
        let _in_runtime = runtime.enter();
        quinn::Endpoint::server(config, "127.0.0.1:0".parse().unwrap()).unwrap()
    };
    (endpoint, fingerprint, runtime)
}

#[test]
fn cameras_go_over_the_stream_where_the_server_takes_no_datagrams() {
    let folder = tempfile::tempdir().unwrap();
    let (endpoint, fingerprint, runtime) = raw_server(folder.path(), ALPN, false);
    let address = endpoint.local_addr().unwrap().to_string();
    let served = runtime.spawn(async move {
        let connection = endpoint.accept().await.unwrap().await.unwrap();
        let (_send, mut receive) = connection.accept_bi().await.unwrap();
        let mut bytes = vec![0; hello().len() + 2 * PACKET_HEADER_BYTES + 60 + 4];
        receive.read_exact(&mut bytes).await.unwrap();
        bytes
    });
    let connection = Connection::open(Connect {
        address: &address,
        server_name: None,
        token: TOKEN,
        trust: Trust::Fingerprint(fingerprint),
        scene_hash: 0,
        capacity: NEEDS,
        topology_hash: 0,
    });
    let connection = connection.unwrap();
    connection.camera(&camera(3.0)).unwrap();
    connection.ack(7).unwrap();
    let expected = [
        hello(),
        packet(uplink::kind::CAMERA, 1, |w| camera(3.0).write(w)),
        packet(uplink::kind::ACK, 2, |w| w.u32(7)),
    ];
    assert_eq!(runtime.block_on(served).unwrap(), expected.concat());
}

#[test]
fn what_the_engine_says_arrives_as_said_and_in_order() {
    let mut server = Server::start(1);
    let (connection, id) = server.client();
    let matrices: Vec<[[f32; 4]; 3]> = (0..uplink::MAX_JOINTS)
        .map(|joint| [[joint as f32, 0.5, -1.0, 2.0]; 3])
        .collect();
    connection.transform(&transform(3)).unwrap();
    connection.joints(4, &matrices).unwrap();
    connection.joints(5, &[]).unwrap();
    connection.transform(&transform(u32::MAX)).unwrap();
    assert_eq!(server.message(id), OwnedMessage::Transform(transform(3)));
    let joints = |instance, matrices| OwnedMessage::Joints { instance, matrices };
    assert_eq!(server.message(id), joints(4, matrices));
    assert_eq!(server.message(id), joints(5, vec![]));
    assert_eq!(
        server.message(id),
        OwnedMessage::Transform(transform(u32::MAX))
    );
    connection.resync().unwrap();
    assert_eq!(server.message(id), OwnedMessage::Resync);
}

#[test]
fn what_the_server_would_take_amiss_is_not_sent() {
    let mut server = Server::start(1);
    let (connection, id) = server.client();
    let mut wrong = camera(0.0);
    wrong.aspect = f32::NAN;
    let invalid = Err(Unsent::Invalid(stream::StreamError::Value));
    assert_eq!(connection.camera(&wrong), invalid);
    let mut wrong = transform(0);
    wrong.world_from_local[0][0] = f64::INFINITY;
    assert_eq!(connection.transform(&wrong), invalid);
    assert_eq!(connection.joints(0, &[[[f32::NAN; 4]; 3]]), invalid);
    let many = vec![[[0.0; 4]; 3]; uplink::MAX_JOINTS as usize + 1];
    assert_eq!(connection.joints(0, &many), invalid);
    // The sequence has no gap after them.
    connection.resync().unwrap();
    assert_eq!(server.message(id), OwnedMessage::Resync);
    connection.camera(&camera(1.0)).unwrap();
    assert_eq!(server.message(id), OwnedMessage::Camera(camera(1.0)));
}

#[test]
fn of_many_cameras_the_newest_arrives_and_none_goes_back() {
    let mut server = Server::start(1);
    let (connection, id) = server.client();
    let last = 500;
    for number in 1..=last {
        connection.camera(&camera(f64::from(number))).unwrap();
    }
    let mut before = 0.0;
    while before < f64::from(last) {
        match server.message(id) {
            OwnedMessage::Camera(camera) => {
                assert!(camera.position_m[0] > before);
                before = camera.position_m[0];
            }
            other => panic!("{other:?} instead of a camera"),
        }
    }
}

#[test]
fn a_camera_or_ack_that_was_overtaken_is_dropped() {
    let mut server = Server::start(1);
    let mut raw = Raw::open(&server);
    raw.say(&hello());
    let id = server.joined();
    let at = |sequence: u16, x| packet(uplink::kind::CAMERA, sequence, |w| camera(x).write(w));
    let ack = |sequence: u16, frame: u32| packet(uplink::kind::ACK, sequence, |w| w.u32(frame));
    // Sequences wrap; each kind is compared with its own.
    raw.datagram(at(u16::MAX - 1, 1.0));
    raw.datagram(at(2, 2.0));
    raw.datagram(at(u16::MAX, 3.0));
    raw.datagram(at(2, 4.0));
    raw.datagram(ack(1, 10));
    // Datagrams of the loopback interface keep their order: the last one comes behind them all.
    let mut camera_at = 0.0;
    loop {
        match server.message(id) {
            OwnedMessage::Camera(camera) => camera_at = camera.position_m[0],
            ack => break assert_eq!(ack, OwnedMessage::Ack(10)),
        }
    }
    assert_eq!(camera_at, 2.0);
    raw.datagram(ack(0, 9));
    raw.datagram(at(3, 5.0));
    assert_eq!(server.message(id), OwnedMessage::Camera(camera(5.0)));
    // A camera that stood still while sequences went around is newer all the same.
    for (sequence, frame) in [(30_000, 11), (60_000, 12), (24_000, 13)] {
        raw.datagram(ack(sequence, frame));
        assert_eq!(server.message(id), OwnedMessage::Ack(frame));
    }
    raw.datagram(at(24_001, 6.0));
    assert_eq!(server.message(id), OwnedMessage::Camera(camera(6.0)));
    raw.datagram(at(24_000, 7.0));
    raw.datagram(ack(24_002, 14));
    assert_eq!(server.message(id), OwnedMessage::Ack(14));
    assert_eq!(server.events, []);
}

#[test]
fn a_client_that_floods_is_held_back_and_nothing_is_lost() {
    let mut server = Server::start(2);
    let (connection, id) = server.client();
    // The server's frame loop does not look. What may be under way: what waits there, the window,
    // what waits here and what is being written here.
    const BOUND: usize = (1 << 20) + (256 << 10) + (1 << 20) + (1 << 20) + (64 << 10);
    let length = packet(uplink::kind::TRANSFORM, 0, |w| transform(0).write(w)).len();
    let (mut sent, mut busy) = (0, 0);
    while busy < 300 {
        match connection.transform(&transform(sent)) {
            Ok(()) => (sent, busy) = (sent + 1, 0),
            Err(error) => {
                assert_eq!(error, Unsent::Busy);
                busy += 1;
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        assert!(sent as usize * length <= BOUND, "{sent} moves wait");
    }
    assert!(sent > 5000, "a scene's worth of moves goes through: {sent}");
    for number in 0..sent {
        assert_eq!(
            server.message(id),
            OwnedMessage::Transform(transform(number))
        );
    }
    connection.transform(&transform(sent)).unwrap();
    assert_eq!(server.message(id), OwnedMessage::Transform(transform(sent)));
}

#[test]
fn a_client_that_stops_reading_is_skipped_while_another_is_served_and_then_goes_on() {
    const LENGTH: usize = 64 << 10;
    // What may be under way to a client: its buffer, its window (QUIC takes no more than fits
    // into it), one frame.
    const BOUND: usize = (1 << 20) + (2 << 20) + 3 * LENGTH;
    let mut server = Server::start(2);
    let (mut stalled, stalled_id) = server.client();
    let (mut served, served_id) = server.client();
    let mut taken = Vec::new();
    let mut skipped = 0;
    for number in 0..10_000 {
        if server.transport.ready(stalled_id) {
            server.transport.send(stalled_id, frame(number, LENGTH));
            taken.push(number);
            skipped = 0;
        } else {
            skipped += 1;
        }
        server.send(served_id, frame(number, LENGTH));
        assert!(receive(&mut served, LENGTH) == frame(number, LENGTH));
        assert!(taken.len() * LENGTH <= BOUND, "{} frames wait", taken.len());
        if skipped == 600 {
            break;
        }
    }
    assert_eq!(skipped, 600, "it is not ready while it does not read");
    let waited: Vec<u8> = taken.iter().flat_map(|n| frame(*n, LENGTH)).collect();
    assert!(receive(&mut stalled, waited.len()) == waited);
    server.send(stalled_id, frame(77_777, LENGTH));
    assert!(receive(&mut stalled, LENGTH) == frame(77_777, LENGTH));
}

#[test]
fn a_client_that_goes_is_gone_and_may_come_back() {
    let mut server = Server::start(1);
    let (connection, first) = server.client();
    let mut turned_away = server.open(|_| ()).unwrap();
    assert_eq!(refused(&closed(&mut turned_away).0).0, Refusal::Full);
    // It has not read what it was sent, and does not say goodbye on its stream.
    server.send(first, frame(1, 5_000_000));
    drop(connection);
    assert_eq!(server.left(first), "the client closed the connection");
    assert!(!server.transport.ready(first));
    server.transport.send(first, frame(2, 100));
    let (mut connection, second) = server.client();
    assert_ne!(first, second);
    server.send(second, frame(3, 100));
    assert_eq!(receive(&mut connection, 100), frame(3, 100));
    connection.close();
    server.left(second);
}

/// Takes as long as the idle timeout that this client asks for.
#[test]
fn for_a_client_that_vanishes_little_is_kept_until_the_idle_timeout() {
    const LENGTH: usize = 16 << 10;
    let mut server = Server::start(1);
    let mut raw = Raw::open(&server);
    raw.say(&hello());
    let id = server.joined();
    // Nothing of it is left that could say goodbye, or acknowledge.
    raw.runtime.shutdown_timeout(TOO_LONG);
    let mut kept = 0;
    let last = wait("the client to leave", || {
        if server.transport.ready(id) {
            server.transport.send(id, vec![0; LENGTH]);
            kept += LENGTH;
            assert!(kept <= (128 << 10) + 2 * LENGTH, "{kept} bytes wait");
        }
        server.poll();
        server.events.pop_front()
    });
    assert_eq!(last, Event::Left(id, "no sign of life".into()));
}

#[test]
fn a_client_that_ends_or_stops_its_stream_is_gone() {
    let mut server = Server::start(1);
    let mut raw = Raw::open(&server);
    raw.say(&hello());
    let id = server.joined();
    raw.send.finish().unwrap();
    assert_eq!(server.left(id), "the client ended its stream");
    let mut raw = Raw::open(&server);
    raw.say(&hello());
    let id = server.joined();
    raw.receive.stop(0u32.into()).unwrap();
    let why = wait("the client to leave", || {
        if server.transport.ready(id) {
            server.transport.send(id, vec![0; 100]);
        }
        server.poll();
        server.events.pop_front()
    });
    let stopped = "the client stopped the stream".to_string();
    assert_eq!(why, Event::Left(id, stopped));
}

#[test]
fn when_the_server_ends_its_clients_are_told() {
    let told = Closed::Done("the server shut down".into());
    let mut unheard = 0;
    for _ in 0..3 {
        let mut server = Server::start(2);
        let (mut idle, _) = server.client();
        let (mut busy, id) = server.client();
        server.send(id, frame(1, 20_000_000));
        drop(server.transport);
        let (frames, why) = closed(&mut idle);
        assert!(frames.is_empty());
        for why in [why, closed(&mut busy).1] {
            // The one datagram that says so may be lost, then the client notices the silence.
            let lost = matches!(why, Closed::Lost(_));
            assert!(lost || why == told, "{why:?}");
            unheard += u32::from(lost);
        }
        assert_eq!(busy.camera(&camera(0.0)), Err(Unsent::Closed));
        assert_eq!(busy.transform(&transform(0)), Err(Unsent::Closed));
    }
    assert!(unheard < 3, "of 6 clients {unheard} were not told");
}

#[test]
fn a_closed_server_is_quiet_and_its_port_is_free() {
    let mut server = Server::start(1);
    let (_connection, id) = server.client();
    let address = server.transport.local_addr();
    let taken = |listen| {
        Transport::start(TransportConfig {
            listen,
            identity: Identity::ephemeral().unwrap(),
            token: String::new(),
            max_clients: 1,
            scene_hash: 0,
            capacity: NEEDS,
        })
    };
    let error = taken(address).unwrap_err();
    assert!(matches!(error, TransportError::Listen(..)), "{error}");
    server.transport.close();
    assert!(!server.transport.ready(id));
    assert_eq!(server.transport.events(), []);
    server.transport.send(id, vec![1]);
    drop(server);
    taken(address).unwrap();
}
