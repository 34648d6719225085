//! The client's side of a stream: packets in, frames out.

use crate::memory::{Heap, SliceHeap};
use psao_core::Mirror;
use psao_core::mirror::Capacity;
use psao_core::slices::{apply_instances, apply_patches, apply_slices};
use psao_core::stream::{
    CHANGES_HEADER_BYTES, FRAME_HEADER_BYTES, Frame, Header, MAX_BODY_BYTES, PACKET_HEADER_BYTES,
    PREAMBLE, Packet, Profile, Reader, Refusal, StreamError, apply_changes, flag, kind,
};

/// What a client may use at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Most room of each kind; a stream that needs more is refused before memory is taken.
    pub capacity: Capacity,
    /// Hash of the client's scene; 0 accepts any.
    pub scene_hash: u64,
}

/// Why a push failed.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientError {
    /// The bytes are no stream this client can follow.
    Stream(StreamError),
    /// The scene needs more room than [`Config::capacity`] (what it needs).
    Capacity(Capacity),
    /// The stream is of another scene (its hash).
    Scene(u64),
    /// A frame's content is not one zstd frame of the size that it says.
    Compression,
    /// The server will not serve; the text is the server's.
    Refused(Option<Refusal>, String),
    /// An earlier push failed; call [`Client::restart`].
    Failed,
}

impl From<StreamError> for ClientError {
    fn from(error: StreamError) -> ClientError {
        ClientError::Stream(error)
    }
}

impl std::fmt::Display for ClientError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ClientError::Stream(error) => write!(f, "{error}"),
            ClientError::Capacity(needed) => write!(
                f,
                "the scene needs {} instances, {} buckets, {} cells, {} slices, {} points, \
                 {} patches and {} bytes of topology: raise Config::capacity",
                needed.instances,
                needed.buckets,
                needed.cells,
                needed.slices,
                needed.points,
                needed.patches,
                needed.topology_bytes
            ),
            ClientError::Scene(hash) => write!(
                f,
                "the stream is of another scene (hash {hash:016x}): load the server's files"
            ),
            ClientError::Compression => f.write_str("a frame's content does not decompress"),
            ClientError::Refused(_, text) => write!(f, "refused by the server: {text}"),
            ClientError::Failed => f.write_str("an earlier push failed: call restart"),
        }
    }
}

impl std::error::Error for ClientError {}

/// Where a client is in its stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// No header has come.
    Connecting,
    /// Frames come and agree with the server.
    Live,
    /// The mirror is not what the server says it should be: ask for a snapshot
    /// ([`psao_core::uplink::Message::Resync`]). Frames are withheld until one comes.
    Desynchronised,
    /// The server ended the stream.
    Ended,
    /// A push failed.
    Failed,
}

/// What one push did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pushed {
    /// Bytes used up; the rest must be pushed again. All of them unless a frame was completed.
    pub consumed: usize,
    /// The frame this push completed: the mirror now holds exactly that state.
    pub frame: Option<Frame>,
}

/// Totals since the client was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Stream bytes used up.
    pub bytes: u64,
    /// Frames completed.
    pub frames: u64,
    /// Snapshots among them.
    pub snapshots: u64,
    /// Times the mirror did not match the server's hash.
    pub mismatches: u64,
    /// Instances set.
    pub instances: u64,
    /// Buckets set.
    pub buckets: u64,
    /// Cells set.
    pub cells: u64,
    /// Items of slices applied (profile `residual`).
    pub slices: u64,
    /// Patches that came (profile `residual`).
    pub patches: u64,
}

/// Follows one stream. Memory is taken when the header comes, and never after.
pub struct Client {
    config: Config,
    state: State,
    header: Option<Header>,
    mirror: Mirror<Heap>,
    slices: SliceHeap,
    /// What mirror and slices have room for.
    room: Capacity,
    /// Of the patches that have come.
    topology_hash: u64,
    /// Bytes of a packet that is not whole yet.
    input: Vec<u8>,
    /// Decompressed content of a packet.
    raw: Vec<u8>,
    zstd: zstd::zstd_safe::DCtx<'static>,
    next_sequence: u32,
    /// Number of the last frame that a packet came of.
    last_frame: Option<u32>,
    /// Number and time of the frame that is not complete.
    open_frame: Option<(u32, u64)>,
    preamble_done: bool,
    /// The frame being received began with a reset of the mirror.
    in_snapshot: bool,
    stats: Stats,
}

impl Client {
    /// A client that has received nothing.
    pub fn new(config: Config) -> Client {
        Client {
            config,
            state: State::Connecting,
            header: None,
            mirror: Mirror::new(Heap::new(Capacity::default())),
            slices: SliceHeap::default(),
            room: Capacity::default(),
            topology_hash: 0,
            input: Vec::new(),
            raw: Vec::new(),
            zstd: zstd::zstd_safe::DCtx::create(),
            next_sequence: 0,
            last_frame: None,
            open_frame: None,
            preamble_done: false,
            in_snapshot: false,
            stats: Stats::default(),
        }
    }

    /// Forgets the stream's position, for a new connection. The mirror keeps its contents (the
    /// picture freezes rather than flashes) until the new stream's first snapshot, or until its
    /// header if the scene needs another capacity.
    pub fn restart(&mut self) {
        self.state = State::Connecting;
        self.header = None;
        self.input.clear();
        self.next_sequence = 0;
        self.last_frame = None;
        self.open_frame = None;
        self.preamble_done = false;
        self.in_snapshot = false;
    }

    /// Feeds stream bytes, in any portions. Stops behind a completed frame, so that the caller
    /// can take it before the mirror moves on.
    ///
    /// # Errors
    /// The bytes are not the stream of this scene; the client is then [`State::Failed`] until
    /// [`Client::restart`].
    pub fn push(&mut self, bytes: &[u8]) -> Result<Pushed, ClientError> {
        if self.state == State::Failed {
            return Err(ClientError::Failed);
        }
        let result = self.push_bytes(bytes);
        match &result {
            Ok(pushed) => self.stats.bytes += pushed.consumed as u64,
            Err(_) => self.state = State::Failed,
        }
        result
    }

    fn push_bytes(&mut self, bytes: &[u8]) -> Result<Pushed, ClientError> {
        let mut rest = bytes;
        while !rest.is_empty() {
            if self.state == State::Ended {
                return Err(StreamError::Order.into());
            }
            let wanted = self.wanted_bytes()?;
            if self.input.is_empty() && rest.len() >= wanted && self.preamble_done {
                // The common case: read the packet where it lies.
                if let Some((packet, length)) = Packet::read(rest, self.max_body_bytes())? {
                    rest = &rest[length..];
                    if let Some(frame) = self.packet(packet)? {
                        let consumed = bytes.len() - rest.len();
                        return Ok(Pushed {
                            consumed,
                            frame: Some(frame),
                        });
                    }
                    continue;
                }
            }
            let missing = wanted.saturating_sub(self.input.len()).max(1);
            let (head, tail) = rest.split_at(missing.min(rest.len()));
            self.input.extend_from_slice(head);
            rest = tail;
            if let Some(frame) = self.gathered()? {
                return Ok(Pushed {
                    consumed: bytes.len() - rest.len(),
                    frame: Some(frame),
                });
            }
        }
        Ok(Pushed {
            consumed: bytes.len(),
            frame: None,
        })
    }

    /// Bytes that `input` must hold before the next step can be taken.
    fn wanted_bytes(&self) -> Result<usize, ClientError> {
        if !self.preamble_done {
            return Ok(PREAMBLE.len());
        }
        if self.input.len() < PACKET_HEADER_BYTES {
            return Ok(PACKET_HEADER_BYTES);
        }
        let mut length = Reader(&self.input[4..]);
        let body_bytes = length.u32()?;
        if body_bytes > self.max_body_bytes() {
            return Err(StreamError::PacketTooLarge(body_bytes).into());
        }
        Ok(PACKET_HEADER_BYTES + body_bytes as usize)
    }

    fn max_body_bytes(&self) -> u32 {
        self.header.map_or(4096, |header| header.max_body_bytes)
    }

    /// Takes what `input` holds if it is whole.
    fn gathered(&mut self) -> Result<Option<Frame>, ClientError> {
        if !self.preamble_done {
            if !PREAMBLE.starts_with(&self.input[..self.input.len().min(PREAMBLE.len())]) {
                return Err(StreamError::NotAStream.into());
            }
            if self.input.len() == PREAMBLE.len() {
                self.preamble_done = true;
                self.input.clear();
            }
            return Ok(None);
        }
        if self.input.len() < self.wanted_bytes()? {
            return Ok(None);
        }
        // The buffer moves out for the time of the call and comes back emptied.
        let mut input = std::mem::take(&mut self.input);
        let result = match Packet::read(&input, self.max_body_bytes()) {
            Ok(Some((packet, _))) => self.packet(packet),
            Ok(None) => Ok(None),
            Err(error) => Err(error.into()),
        };
        input.clear();
        self.input = input;
        if self.header.is_some() && self.input.capacity() < self.packet_bytes() {
            self.input.reserve_exact(self.packet_bytes());
        }
        result
    }

    fn packet_bytes(&self) -> usize {
        PACKET_HEADER_BYTES + self.max_body_bytes() as usize
    }

    fn packet(&mut self, packet: Packet<'_>) -> Result<Option<Frame>, ClientError> {
        if packet.sequence != self.next_sequence {
            return Err(StreamError::Sequence.into());
        }
        self.next_sequence = packet.sequence.wrapping_add(1);
        match packet.kind {
            kind::FRAME | kind::SLICES => packet.check_flags(flag::SNAPSHOT | flag::LAST)?,
            kind::HEADER | kind::END | kind::REFUSE | kind::PATCHES => packet.check_flags(0)?,
            _ => {}
        }
        match (packet.kind, self.header) {
            (kind::HEADER, None) => self.begin(Header::read(packet.body)?).map(|()| None),
            (kind::FRAME, Some(header)) => self.frame(&header, packet),
            (kind::SLICES, Some(header)) if header.profile == Profile::Residual => {
                self.frame(&header, packet)
            }
            (kind::PATCHES, Some(header)) if header.profile == Profile::Residual => {
                let count = apply_patches(packet.body, &mut self.slices.slices())?;
                self.stats.patches += u64::from(count);
                Ok(None)
            }
            (kind::END, Some(_)) if self.open_frame.is_none() => {
                if !packet.body.is_empty() {
                    return Err(StreamError::Length.into());
                }
                self.state = State::Ended;
                Ok(None)
            }
            (kind::REFUSE, None) => {
                let mut body = Reader(packet.body);
                let refusal = Refusal::from_code(body.u16()?);
                let text = String::from_utf8_lossy(body.0);
                let printable = text.chars().filter(|c| !c.is_control());
                Err(ClientError::Refused(refusal, printable.take(200).collect()))
            }
            (kind::HEADER..=kind::PATCHES, _) => Err(StreamError::Order.into()),
            (_, None) => Err(StreamError::Order.into()),
            _ if packet.flags & flag::OPTIONAL != 0 => Ok(None),
            (other, _) => Err(StreamError::Kind(other).into()),
        }
    }

    fn begin(&mut self, header: Header) -> Result<(), ClientError> {
        let need = header.capacity;
        if !self.config.capacity.holds(&need) {
            return Err(ClientError::Capacity(need));
        }
        if self.config.scene_hash != 0 && self.config.scene_hash != header.scene_hash {
            return Err(ClientError::Scene(header.scene_hash));
        }
        // A server that was told that this client has all patches does not send them again,
        // whatever else its header asks for.
        let same_topology = header.topology_hash != 0
            && header.topology_hash == self.topology_hash
            && need.patches == self.room.patches
            && need.topology_bytes == self.room.topology_bytes;
        if !same_topology {
            self.slices.slices().forget_patches();
        }
        // What is replaced goes first, so that old and new are never held at once.
        if self.room != need {
            self.mirror = Mirror::new(Heap::new(Capacity::default()));
            self.slices = std::mem::take(&mut self.slices).resized(need);
            self.mirror = Mirror::new(Heap::new(need));
            self.room = need;
        } else {
            self.slices.slices().reset(need.cells);
        }
        self.topology_hash = header.topology_hash;
        self.raw.resize(header.max_raw_bytes as usize, 0);
        self.header = Some(header);
        self.input.reserve_exact(self.packet_bytes());
        // Frames count only from a snapshot on: what an earlier connection left is not the
        // server's starting point.
        self.state = State::Desynchronised;
        Ok(())
    }

    fn frame(&mut self, header: &Header, packet: Packet<'_>) -> Result<Option<Frame>, ClientError> {
        let (frame, compressed) = Frame::read(packet.body)?;
        let has = |flag: u8| packet.flags & flag != 0;
        let (snapshot, last) = (has(flag::SNAPSHOT), has(flag::LAST));
        if frame.raw_bytes > header.max_raw_bytes || !last && frame.mirror_hash != 0 {
            return Err(StreamError::Value.into());
        }
        let in_order = match self.open_frame {
            Some(open) => open == (frame.id, frame.time_ns) && !snapshot,
            None => self
                .last_frame
                .is_none_or(|id| id.wrapping_add(1) == frame.id),
        };
        if !in_order {
            return Err(StreamError::Order.into());
        }
        self.last_frame = Some(frame.id);
        self.open_frame = (!last).then_some((frame.id, frame.time_ns));
        if snapshot {
            self.mirror.reset();
            self.slices.slices().reset(header.capacity.cells);
            self.in_snapshot = true;
        } else if self.state == State::Desynchronised && !self.in_snapshot {
            return Ok(None);
        }
        let raw_bytes = frame.raw_bytes as usize;
        if packet.kind == kind::SLICES {
            if raw_bytes != compressed.len() {
                return Err(StreamError::Length.into());
            }
            let slices = &mut self.slices.slices();
            let count = apply_slices(compressed, header.step, &mut self.mirror, slices)?;
            self.stats.slices += u64::from(count);
        } else if raw_bytes > 0 {
            // zstd itself would go on behind the first frame, and skip what is none.
            if zstd::zstd_safe::find_frame_compressed_size(compressed) != Ok(compressed.len()) {
                return Err(ClientError::Compression);
            }
            let room = &mut self.raw[..raw_bytes];
            let written = self
                .zstd
                .decompress(room, compressed)
                .map_err(|_| ClientError::Compression)?;
            if written != raw_bytes {
                return Err(ClientError::Compression);
            }
            let raw = &self.raw[..raw_bytes];
            let changes = match header.profile {
                Profile::Cells => apply_changes(raw, &mut self.mirror)?,
                Profile::Residual => {
                    let slices = self.slices.slices();
                    apply_instances(raw, &mut self.mirror, &slices)?
                }
            };
            self.stats.instances += u64::from(changes.instances);
            self.stats.buckets += u64::from(changes.buckets);
            self.stats.cells += u64::from(changes.cells);
        } else if !compressed.is_empty() {
            return Err(StreamError::Length.into());
        }
        if !last {
            return Ok(None);
        }
        if self.mirror.hash() != frame.mirror_hash {
            self.stats.mismatches += 1;
            self.state = State::Desynchronised;
            self.in_snapshot = false;
            return Ok(None);
        }
        self.stats.frames += 1;
        self.stats.snapshots += u64::from(self.in_snapshot);
        self.in_snapshot = false;
        self.state = State::Live;
        Ok(Some(frame))
    }

    /// Where the client is in its stream.
    pub fn state(&self) -> State {
        self.state
    }

    /// The stream's parameters, once its header has come.
    pub fn header(&self) -> Option<&Header> {
        self.header.as_ref()
    }

    /// The state of the last completed frame (and, between pushes that complete none, of a part
    /// of the next).
    pub fn mirror(&self) -> &Mirror<Heap> {
        &self.mirror
    }

    /// What profile `residual` keeps beside the mirror.
    pub fn slices(&self) -> &SliceHeap {
        &self.slices
    }

    /// What to say in a hello ([`psao_core::uplink::Hello::topology_hash`]) so that no patch is
    /// sent again: the hash of the patches that this client has got, in an earlier stream or from
    /// a recording, if it has all of them; else 0.
    pub fn topology_hash(&self) -> u64 {
        if self.slices.has_all_patches() {
            self.topology_hash
        } else {
            0
        }
    }

    /// What changed has been uploaded.
    pub fn clear_dirty(&mut self) {
        self.mirror.clear_dirty();
    }

    /// Totals.
    pub fn stats(&self) -> Stats {
        self.stats
    }

    /// Bytes of memory held: buffers, dirty sets, and the input and decompression buffers.
    pub fn memory_bytes(&self) -> u64 {
        self.mirror.capacity().bytes()
            + self.slices.bytes()
            + self.input.capacity() as u64
            + self.raw.capacity() as u64
            + self.zstd.sizeof() as u64
    }
}

const _: () = assert!(
    MAX_BODY_BYTES as usize > FRAME_HEADER_BYTES + CHANGES_HEADER_BYTES,
    "a frame packet has room for content"
);
