//! The client's side of a stream: packets in, frames out.

use crate::memory::{Heap, Limits, Piece, SliceHeap, Source};
use psao_core::Mirror;
use psao_core::mirror::Capacity;
use psao_core::slices::{apply_instances, apply_patches, apply_slices};
use psao_core::stream::{
    CHANGES_HEADER_BYTES, FRAME_HEADER_BYTES, Frame, Header, MAX_BODY_BYTES, PACKET_HEADER_BYTES,
    PREAMBLE, Packet, Profile, RAW_LENGTH_BYTES, Reader, Refusal, StreamError, apply_changes, flag,
    kind, mirror_check,
};

/// What a client may use at most.
#[cfg(feature = "std")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Most room of each kind; a stream that needs more is refused before memory is taken.
    pub capacity: Capacity,
    /// Hash of the client's scene; 0 accepts any.
    pub scene_hash: u64,
}

/// Why a push failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClientError {
    /// The bytes are no stream this client can follow.
    Stream(StreamError),
    /// The scene needs more room than [`Config::capacity`] (what it needs).
    Capacity(Capacity),
    /// The stream needs more memory than was lent (what it needs).
    Limits(Limits),
    /// The stream is of another scene (its hash).
    Scene(u64),
    /// A frame's content is not one zstd frame of the size that it says.
    Compression,
    /// The server will not serve; the text is the server's.
    Refused(Option<Refusal>, Words),
    /// An earlier push failed; call [`Client::restart`].
    Failed,
}

impl From<StreamError> for ClientError {
    fn from(error: StreamError) -> ClientError {
        ClientError::Stream(error)
    }
}

impl core::fmt::Display for ClientError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
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
            ClientError::Limits(needed) => write!(
                f,
                "the stream needs packets of {} bytes and contents of {}: lend more memory",
                needed.body_bytes, needed.raw_bytes
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

impl core::error::Error for ClientError {}

/// The words of a server, for a person: printable, at most 200 bytes of UTF-8.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Words {
    bytes: [u8; 200],
    length: usize,
}

impl Words {
    /// What of this is UTF-8 and printable, as far as there is room.
    fn of(text: &[u8]) -> Words {
        let mut words = Words {
            bytes: [0; 200],
            length: 0,
        };
        let valid = text.utf8_chunks().flat_map(|chunk| chunk.valid().chars());
        for character in valid.filter(|c| !c.is_control()) {
            let Some(room) = words.bytes[words.length..].get_mut(..character.len_utf8()) else {
                break;
            };
            character.encode_utf8(room);
            words.length += character.len_utf8();
        }
        words
    }
}

impl core::fmt::Display for Words {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        for chunk in self.bytes[..self.length].utf8_chunks() {
            f.write_str(chunk.valid())?;
        }
        Ok(())
    }
}

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

/// Largest packet body before the header says what this stream's is.
const FIRST_BODY_BYTES: u32 = 4096;

/// Follows one stream. From the heap, memory is taken at construction and when the header comes;
/// a client in lent memory takes none at all.
#[derive(Debug)]
pub struct Client {
    gather: Gather,
    decoder: Decoder,
}

/// Bytes of a packet that is not whole yet.
#[derive(Debug)]
struct Gather {
    bytes: Piece<u8>,
    length: usize,
    preamble_done: bool,
}

/// Everything behind a whole packet.
#[derive(Debug)]
struct Decoder {
    limits: Limits,
    scene_hash: u64,
    state: State,
    header: Option<Header>,
    mirror: Mirror<Heap>,
    slices: SliceHeap,
    /// What mirror and slices have their present lengths for.
    room: Capacity,
    /// Of the patches that have come.
    topology_hash: u64,
    /// Decompressed content of a packet.
    raw: Piece<u8>,
    zstd: Piece<u64>,
    next_sequence: u16,
    /// Number of the last frame that a packet came of.
    last_frame: Option<u32>,
    /// Number and time of the frame that is not complete.
    open_frame: Option<(u32, u64)>,
    /// The frame being received began with a reset of the mirror.
    in_snapshot: bool,
    /// The mirror holds a part of a frame, or not what the server has.
    partial: bool,
    stats: Stats,
}

impl Client {
    /// A client that has received nothing, with memory from the heap.
    #[cfg(feature = "std")]
    pub fn new(config: Config) -> Client {
        let limits = Limits::of_any(config.capacity);
        Client::from(&mut Source::Heap, limits, config.scene_hash)
    }

    /// A client that takes no memory, ever: all that it needs comes from `source`, usually
    /// [`Source::Lent`]. Measure the block first, by making one from [`Source::Measure`].
    ///
    /// `scene_hash`: as in [`Config::scene_hash`].
    ///
    /// # Panics
    /// If the block is shorter than measured.
    pub fn from(source: &mut Source, limits: Limits, scene_hash: u64) -> Client {
        let first_body_bytes = limits.body_bytes.max(FIRST_BODY_BYTES);
        let mut client = Client {
            gather: Gather {
                bytes: source.piece(packet_bytes(first_body_bytes) as u64),
                length: 0,
                preamble_done: false,
            },
            decoder: Decoder {
                limits,
                scene_hash,
                state: State::Connecting,
                header: None,
                mirror: Mirror::new(Heap::from(source, limits.capacity)),
                slices: SliceHeap::from(source, limits.capacity),
                room: Capacity::default(),
                topology_hash: 0,
                raw: source.piece(u64::from(limits.raw_bytes)),
                zstd: source.piece(psao_zstd::state_words() as u64),
                next_sequence: 0,
                last_frame: None,
                open_frame: None,
                in_snapshot: false,
                partial: false,
                stats: Stats::default(),
            },
        };
        if !matches!(source, Source::Measure(_)) {
            client
                .gather
                .bytes
                .resize_zeroed(packet_bytes(FIRST_BODY_BYTES));
            client.decoder.zstd.resize_zeroed(psao_zstd::state_words());
        }
        client
    }

    /// Lines of a block that is enough for a client with these limits; `u64::MAX` if no block is.
    pub fn lines(limits: Limits) -> u64 {
        let mut source = Source::Measure(0);
        Client::from(&mut source, limits, 0);
        match source {
            Source::Measure(lines) => lines,
            _ => 0,
        }
    }

    /// Forgets the stream's position, for a new connection. The mirror keeps its contents (the
    /// picture freezes rather than flashes) until the new stream's first snapshot, or until its
    /// header if the scene needs another capacity.
    pub fn restart(&mut self) {
        self.gather.length = 0;
        self.gather.preamble_done = false;
        let decoder = &mut self.decoder;
        decoder.state = State::Connecting;
        decoder.header = None;
        decoder.next_sequence = 0;
        decoder.last_frame = None;
        decoder.open_frame = None;
        decoder.in_snapshot = false;
    }

    /// Feeds stream bytes, in any portions. Stops behind a completed frame, so that the caller
    /// can take it before the mirror moves on.
    ///
    /// # Errors
    /// The bytes are not the stream of this scene; the client is then [`State::Failed`] until
    /// [`Client::restart`].
    pub fn push(&mut self, bytes: &[u8]) -> Result<Pushed, ClientError> {
        if self.decoder.state == State::Failed {
            return Err(ClientError::Failed);
        }
        let result = self.push_bytes(bytes);
        match &result {
            Ok(pushed) => self.decoder.stats.bytes += pushed.consumed as u64,
            Err(_) => self.decoder.state = State::Failed,
        }
        result
    }

    fn push_bytes(&mut self, bytes: &[u8]) -> Result<Pushed, ClientError> {
        let Client { gather, decoder } = self;
        let mut rest = bytes;
        while !rest.is_empty() {
            if decoder.state == State::Ended {
                return Err(StreamError::Order.into());
            }
            let max_body_bytes = decoder.max_body_bytes();
            let frame = if gather.length == 0
                && gather.preamble_done
                && let Some((packet, length)) = Packet::read(rest, max_body_bytes)?
            {
                // The common case: the packet is read where it lies.
                rest = &rest[length..];
                decoder.packet(packet)?
            } else {
                let missing = gather.wanted_bytes(max_body_bytes)? - gather.length;
                let (head, tail) = rest.split_at(missing.min(rest.len()));
                gather.bytes[gather.length..][..head.len()].copy_from_slice(head);
                gather.length += head.len();
                rest = tail;
                gather.take(decoder)?
            };
            // The header just said how large a packet may be; nothing is gathered at this point.
            let packet_bytes = packet_bytes(decoder.max_body_bytes());
            if gather.bytes.len() < packet_bytes {
                gather.bytes.resize_zeroed(packet_bytes);
            }
            if frame.is_some() {
                return Ok(Pushed {
                    consumed: bytes.len() - rest.len(),
                    frame,
                });
            }
        }
        Ok(Pushed {
            consumed: bytes.len(),
            frame: None,
        })
    }

    /// Where the client is in its stream.
    pub fn state(&self) -> State {
        self.decoder.state
    }

    /// The stream's parameters, once its header has come.
    pub fn header(&self) -> Option<&Header> {
        self.decoder.header.as_ref()
    }

    /// The state of the last completed frame (and, between pushes that complete none, of a part
    /// of the next: see [`Client::is_whole`]).
    pub fn mirror(&self) -> &Mirror<Heap> {
        &self.decoder.mirror
    }

    /// The mirror is that of a complete frame: it may be shown, and uploaded.
    pub fn is_whole(&self) -> bool {
        self.decoder.stats.frames > 0 && !self.decoder.partial
    }

    /// What profile `residual` keeps beside the mirror.
    pub fn slices(&self) -> &SliceHeap {
        &self.decoder.slices
    }

    /// What to say in a hello ([`psao_core::uplink::Hello::topology_hash`]) so that no patch is
    /// sent again: the hash of the patches that this client has got, in an earlier stream or from
    /// a recording, if it has all of them; else 0.
    pub fn topology_hash(&self) -> u64 {
        if self.decoder.slices.has_all_patches() {
            self.decoder.topology_hash
        } else {
            0
        }
    }

    /// Nothing counts as uploaded: for buffers that were lost with their device, or made anew.
    pub fn mark_all_dirty(&mut self) {
        self.decoder.mirror.mark_all_dirty();
    }

    /// What changed has been uploaded.
    pub fn clear_dirty(&mut self) {
        self.decoder.mirror.clear_dirty();
    }

    /// Totals.
    pub fn stats(&self) -> Stats {
        self.decoder.stats
    }

    /// Bytes of memory held: buffers, dirty sets, and the input and decompression buffers.
    pub fn memory_bytes(&self) -> u64 {
        let Client { gather, decoder } = self;
        decoder.mirror.capacity().bytes()
            + decoder.slices.bytes()
            + gather.bytes.bytes()
            + decoder.raw.bytes()
            + decoder.zstd.bytes()
    }
}

/// Bytes of the longest packet.
fn packet_bytes(max_body_bytes: u32) -> usize {
    PACKET_HEADER_BYTES + max_body_bytes as usize
}

impl Gather {
    /// Bytes that there must be before the next step can be taken; more than there are.
    fn wanted_bytes(&self, max_body_bytes: u32) -> Result<usize, ClientError> {
        if !self.preamble_done {
            return Ok(PREAMBLE.len());
        }
        if self.length < PACKET_HEADER_BYTES {
            return Ok(PACKET_HEADER_BYTES);
        }
        let mut length = Reader(&self.bytes[4..]);
        let body_bytes = length.u32()?;
        if body_bytes > max_body_bytes {
            return Err(StreamError::PacketTooLarge(body_bytes).into());
        }
        Ok(PACKET_HEADER_BYTES + body_bytes as usize)
    }

    /// Hands on what there is if it is whole.
    fn take(&mut self, decoder: &mut Decoder) -> Result<Option<Frame>, ClientError> {
        let gathered = &self.bytes[..self.length];
        if !self.preamble_done {
            if !PREAMBLE.starts_with(gathered) {
                return Err(StreamError::NotAStream.into());
            }
            if gathered.len() == PREAMBLE.len() {
                self.preamble_done = true;
                self.length = 0;
            }
            return Ok(None);
        }
        match Packet::read(gathered, decoder.max_body_bytes())? {
            Some((packet, _)) => {
                self.length = 0;
                decoder.packet(packet)
            }
            None => Ok(None),
        }
    }
}

impl Decoder {
    fn max_body_bytes(&self) -> u32 {
        self.header
            .map_or(FIRST_BODY_BYTES, |header| header.max_body_bytes)
    }

    fn packet(&mut self, packet: Packet<'_>) -> Result<Option<Frame>, ClientError> {
        if packet.sequence != self.next_sequence {
            return Err(StreamError::Sequence.into());
        }
        self.next_sequence = packet.sequence.wrapping_add(1);
        match packet.kind {
            kind::FRAME => packet.check_flags(flag::SNAPSHOT | flag::LAST)?,
            kind::SLICES => packet.check_flags(flag::SNAPSHOT | flag::LAST | flag::COARSE)?,
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
                Err(ClientError::Refused(refusal, Words::of(body.0)))
            }
            (kind::HEADER..=kind::PATCHES, _) => Err(StreamError::Order.into()),
            (_, None) => Err(StreamError::Order.into()),
            _ if packet.flags & flag::OPTIONAL != 0 => Ok(None),
            (other, _) => Err(StreamError::Kind(other).into()),
        }
    }

    fn begin(&mut self, header: Header) -> Result<(), ClientError> {
        let need = Limits::of(&header);
        if !self.limits.capacity.holds(&need.capacity) {
            return Err(ClientError::Capacity(need.capacity));
        }
        if !need.fit(&self.limits) {
            return Err(ClientError::Limits(need));
        }
        if self.scene_hash != 0 && self.scene_hash != header.scene_hash {
            return Err(ClientError::Scene(header.scene_hash));
        }
        // A server that was told that this client has all patches does not send them again,
        // whatever else its header asks for.
        let same_topology = header.topology_hash != 0
            && header.topology_hash == self.topology_hash
            && need.capacity.patches == self.room.patches
            && need.capacity.topology_bytes == self.room.topology_bytes;
        if !same_topology {
            self.slices.slices().forget_patches();
        }
        if self.room != need.capacity {
            let empty = Mirror::new(Heap::empty());
            let mut memory = core::mem::replace(&mut self.mirror, empty).into_memory();
            memory.resize_changed(need.capacity);
            self.mirror = Mirror::new(memory);
            self.slices.resize(need.capacity);
            self.room = need.capacity;
        } else {
            self.slices.slices().reset(need.capacity.cells);
        }
        self.topology_hash = header.topology_hash;
        self.raw.resize_zeroed(need.raw_bytes as usize);
        self.header = Some(header);
        self.partial = true;
        // Frames count only from a snapshot on: what an earlier connection left is not the
        // server's starting point.
        self.state = State::Desynchronised;
        Ok(())
    }

    fn frame(&mut self, header: &Header, packet: Packet<'_>) -> Result<Option<Frame>, ClientError> {
        let (frame, content) = Frame::read(packet.body)?;
        let has = |flag: u8| packet.flags & flag != 0;
        let (snapshot, last) = (has(flag::SNAPSHOT), has(flag::LAST));
        if !last && frame.mirror_check != 0 {
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
        self.partial = true;
        if packet.kind == kind::SLICES {
            let slices = &mut self.slices.slices();
            let step = header.step_of(packet.flags);
            let count = apply_slices(content, step, &mut self.mirror, slices)?;
            self.stats.slices += u64::from(count);
        } else if !content.is_empty() {
            let mut reader = Reader(content);
            let raw_bytes = reader.u32()?;
            if raw_bytes == 0 || raw_bytes > header.max_raw_bytes {
                return Err(StreamError::Value.into());
            }
            let (raw_bytes, compressed) = (raw_bytes as usize, reader.0);
            let room = &mut self.raw[..raw_bytes];
            psao_zstd::decompress(&mut self.zstd, room, compressed)
                .map_err(|_| ClientError::Compression)?;
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
        }
        if !last {
            return Ok(None);
        }
        if mirror_check(self.mirror.hash()) != frame.mirror_check {
            self.stats.mismatches += 1;
            self.state = State::Desynchronised;
            self.in_snapshot = false;
            return Ok(None);
        }
        self.stats.frames += 1;
        self.stats.snapshots += u64::from(self.in_snapshot);
        self.in_snapshot = false;
        self.partial = false;
        self.state = State::Live;
        Ok(Some(frame))
    }
}

const _: () = assert!(
    MAX_BODY_BYTES as usize > FRAME_HEADER_BYTES + RAW_LENGTH_BYTES + CHANGES_HEADER_BYTES,
    "a frame packet has room for content"
);
