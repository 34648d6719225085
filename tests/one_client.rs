//! A server that has one stream for one client: what bindings, examples and commands connect to.

use psao_core::mirror::Capacity;
use psao_server::identity::Identity;
use psao_server::transport::{Event, OwnedMessage, Transport, TransportConfig};

/// What the client must present.
pub const TOKEN: &str = "open sesame";

/// The server, before its client has come.
pub struct OneClient {
    transport: Transport,
    stream: Vec<u8>,
    /// Where it listens.
    pub address: String,
    /// Of its certificate.
    pub fingerprint: String,
}

impl OneClient {
    /// Listens.
    pub fn start(stream: Vec<u8>) -> OneClient {
        let identity = Identity::ephemeral().unwrap();
        let fingerprint = identity.fingerprint().to_string();
        let transport = Transport::start(TransportConfig {
            listen: "127.0.0.1:0".parse().unwrap(),
            identity,
            token: TOKEN.into(),
            max_clients: 1,
            scene_hash: 0,
            capacity: Capacity::default(),
        })
        .unwrap();
        OneClient {
            address: transport.local_addr().to_string(),
            transport,
            stream,
            fingerprint,
        }
    }

    /// Serves until the client's end is known. Shuts down when it has heard so many messages.
    /// Returns that end, and what it has heard.
    pub fn until<R>(
        mut self,
        messages: usize,
        mut ended: impl FnMut() -> Option<R>,
    ) -> (R, Vec<String>) {
        let mut heard = Vec::new();
        loop {
            for event in self.transport.events() {
                match event {
                    Event::Joined(id, _) => self.transport.send(id, self.stream.clone()),
                    Event::Message(_, OwnedMessage::Ack(frame)) => {
                        heard.push(format!("frame {frame}"));
                    }
                    Event::Message(_, message) => heard.push(format!("{message:?}")),
                    Event::Left(..) => {}
                }
                // Messages may overtake each other.
                if heard.len() == messages {
                    self.transport.close();
                }
            }
            if let Some(ended) = ended() {
                return (ended, heard);
            }
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }
}
