//! Where frames come from: a recording, at its own pace and over and over, or a live server.

use crate::Args;
use psao::quic::{Closed, Connect, Connection, Trust};
use psao::{Client, Config, State};
use psao_core::mirror::Capacity;
use psao_core::stream::Frame;
use psao_core::uplink;
use psao_server::commands::capacity_within;

/// Memory of the client's buffers, MiB.
const MEMORY_MIB: u64 = 2048;

enum Source {
    /// All its bytes, and how many are used up.
    Recording(Vec<u8>, usize),
    Live(Box<Connection>),
}

/// A client and what it follows.
pub struct Feed {
    /// Holds the mirror.
    pub client: Client,
    source: Source,
    /// Received, not pushed yet.
    received: Vec<u8>,
    /// The last frame.
    pub last: Option<Frame>,
    /// Time of the first frame since the recording began (again).
    first_ns: Option<u64>,
}

impl Feed {
    /// Opens what the arguments name. `scene_hash`: of the scene that is drawn.
    pub fn open(args: &Args, scene_hash: u64) -> Result<Feed, String> {
        let capacity = capacity_within(MEMORY_MIB);
        let client = Client::new(Config {
            capacity,
            scene_hash,
        });
        let source = match args.fingerprint {
            Some(fingerprint) => {
                Source::Live(Box::new(connect(args, fingerprint, scene_hash, capacity)?))
            }
            None => {
                let bytes = std::fs::read(&args.source).map_err(|error| {
                    format!(
                        "{}: {error}: give a file that `psao record` has written, or a server's \
                         HOST:PORT with --fingerprint",
                        args.source
                    )
                })?;
                Source::Recording(bytes, 0)
            }
        };
        Ok(Feed {
            client,
            source,
            received: Vec::new(),
            last: None,
            first_ns: None,
        })
    }

    /// Scene time of the last frame, seconds.
    pub fn time_s(&self) -> f64 {
        self.last.map_or(0.0, |frame| frame.time_ns as f64 * 1e-9)
    }

    /// Takes in what has come; of a recording, the frames of its first `elapsed_s` seconds. Says
    /// whether a recording has come to its end, and begins again.
    pub fn follow(&mut self, elapsed_s: f64) -> Result<bool, String> {
        if matches!(self.source, Source::Live(_)) {
            self.receive()?;
            return Ok(false);
        }
        let due = |frame: &Frame, first: u64| {
            frame.time_ns.saturating_sub(first) as f64 * 1e-9 >= elapsed_s
        };
        loop {
            if let (Some(last), Some(first)) = (&self.last, self.first_ns)
                && due(last, first)
            {
                return Ok(false);
            }
            if !self.next()? {
                if self.first_ns.is_none() {
                    return Err("the recording has no frame: record it again".into());
                }
                if let Source::Recording(_, used) = &mut self.source {
                    *used = 0;
                }
                self.first_ns = None;
                self.last = None;
                self.client.restart();
                return Ok(true);
            }
        }
    }

    /// The next frame of a recording; false at its end.
    pub fn next(&mut self) -> Result<bool, String> {
        let Source::Recording(bytes, used) = &mut self.source else {
            return Ok(false);
        };
        while *used < bytes.len() && self.client.state() != State::Ended {
            let pushed = self
                .client
                .push(&bytes[*used..])
                .map_err(|error| error.to_string())?;
            *used += pushed.consumed;
            if let Some(frame) = pushed.frame {
                self.first_ns.get_or_insert(frame.time_ns);
                self.last = Some(frame);
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Waits for a live server's next frames, or steps through a recording's.
    pub fn wait(&mut self) -> Result<bool, String> {
        match &mut self.source {
            Source::Recording(..) => self.next(),
            Source::Live(connection) => {
                let second = std::time::Duration::from_secs(1);
                match connection.receive_timeout(&mut self.received, second) {
                    Ok(_) => self.push_received().map(|()| true),
                    Err(Closed::Ended) => Ok(false),
                    Err(closed) => Err(closed.to_string()),
                }
            }
        }
    }

    fn receive(&mut self) -> Result<(), String> {
        let Source::Live(connection) = &mut self.source else {
            return Ok(());
        };
        match connection.receive(&mut self.received) {
            Ok(_) | Err(Closed::Ended) => self.push_received(),
            Err(closed) => Err(closed.to_string()),
        }
    }

    fn push_received(&mut self) -> Result<(), String> {
        let Source::Live(connection) = &self.source else {
            return Ok(());
        };
        let mut rest = &self.received[..];
        while !rest.is_empty() && self.client.state() != State::Ended {
            let pushed = self.client.push(rest).map_err(|error| error.to_string())?;
            rest = &rest[pushed.consumed..];
            if let Some(frame) = pushed.frame {
                self.last = Some(frame);
                // A lost acknowledgement is made up for by the next.
                let _ = connection.ack(frame.id);
            }
        }
        self.received.clear();
        if self.client.state() == State::Desynchronised && self.client.stats().frames > 0 {
            connection.resync().map_err(|error| error.to_string())?;
        }
        Ok(())
    }

    /// Tells a live server where the camera is.
    pub fn tell(&self, camera: &uplink::Camera) {
        if let Source::Live(connection) = &self.source {
            // It is told again with the next picture.
            let _ = connection.camera(camera);
        }
    }
}

fn connect(
    args: &Args,
    fingerprint: psao::quic::Fingerprint,
    scene_hash: u64,
    capacity: Capacity,
) -> Result<Connection, String> {
    Connection::open(Connect {
        address: &args.source,
        server_name: None,
        token: &args.token,
        trust: Trust::Fingerprint(fingerprint),
        scene_hash,
        capacity,
        topology_hash: 0,
    })
    .map_err(|error| error.to_string())
}
