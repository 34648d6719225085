//! The stream format of `docs/format.md` (clauses in brackets), read by the client and by a second
//! reader that shares no code with it: whole, cut, damaged and hostile streams.

mod second_reader;

use glam::{DAffine3, Vec3};
use psao::core::cell::{Bucket, Cell};
use psao::core::grid::Instance;
use psao::core::mirror::{Capacity, MirrorError};
use psao::core::point::{Point, encode_normal};
use psao::core::residual::{
    MAX_SLICE_BYTES, Neighbours, Quantiser, SliceState, encode_slice, find_neighbours,
};
use psao::core::slices::{FIRST, Item, Values, apply_slices, store};
use psao::core::stream::{
    self, FRAME_HEADER_BYTES, Frame, Header, MAX_BODY_BYTES, MAX_RAW_BYTES, PACKET_HEADER_BYTES,
    PREAMBLE, Packet, Profile, Refusal, StreamError, Writer, flag, kind, write_packet,
};
use psao::core::uplink::{self, Camera, Hello, MAX_UPLINK_BODY_BYTES, Message, Transform};
use psao::{Client, ClientError, Config, State};
use psao_server::encode::{Compression, Encoder, Scheme, capacity_of, refusal};
use psao_server::scene::{
    Animation, Channel, Interpolation, Keys, LocalTransform, Mesh, Morph, Node, Scene,
};
use psao_server::world::{Options, World};
use std::collections::HashMap;
use std::sync::LazyLock;

// ---------------------------------------------------------------- streams to read

/// A stream, and what its readers must show.
#[derive(Clone)]
struct Sample {
    bytes: Vec<u8>,
    room: Capacity,
    /// Contents of the three buffers at each frame, by its number.
    mirrors: HashMap<u32, [Vec<u8>; 3]>,
}

/// A floor, a box that moves over it and one that swells.
const CELLS: Scheme = Scheme::Cells {
    threshold: 2,
    compression: Compression::Fast,
};

fn scene() -> Scene {
    let mut swelling = cuboid("swelling", Vec3::splat(0.4));
    let positions = swelling.positions.iter().map(|p| *p * 0.5).collect();
    let normals = Vec::new();
    swelling.morphs.push(Morph { positions, normals });
    let mut scene = Scene {
        name: "boxes".into(),
        meshes: vec![
            cuboid("floor", Vec3::new(1.2, 0.1, 1.2)),
            cuboid("moving", Vec3::splat(0.4)),
            swelling,
        ],
        ..Scene::default()
    };
    for (index, at) in [[0.0, -0.05, 0.0], [-0.3, 0.25, 0.1], [0.3, 0.3, -0.1]]
        .into_iter()
        .enumerate()
    {
        let name = scene.meshes[index].name.clone();
        scene.nodes.push(Node {
            name: name.clone(),
            parent: None,
            local: LocalTransform::Trs {
                translation: glam::DVec3::from(at),
                rotation: glam::Quat::IDENTITY,
                scale: Vec3::ONE,
            },
            morph_weights: vec![0.0; scene.meshes[index].morphs.len()],
        });
        scene.instances.push(psao_server::scene::Instance {
            name,
            mesh: index as u32,
            node: index as u32,
            skin: None,
            moves: index == 1,
            deforms: index == 2,
        });
    }
    let channel = |node, values| Channel {
        node,
        times: vec![0.0, 1.0],
        interpolation: Interpolation::Linear,
        values,
    };
    let path = vec![Vec3::new(-0.3, 0.25, 0.1), Vec3::new(0.3, 0.25, 0.3)];
    let weights = vec![0.0, 1.0];
    scene.animations.push(Animation {
        name: "all".into(),
        duration_s: 1.0,
        channels: vec![
            channel(1, Keys::Translation(path)),
            channel(2, Keys::MorphWeights { count: 1, weights }),
        ],
    });
    scene.set_origin();
    scene
}

fn cuboid(name: &str, size: Vec3) -> Mesh {
    let mut mesh = Mesh {
        name: name.into(),
        ..Mesh::default()
    };
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let pick =
                |a: usize, v: f32| Vec3::from(std::array::from_fn(|i| f32::from(i == a) * v));
            let normal = pick(axis, sign);
            let (u, v) = (pick((axis + 1) % 3, 1.0), pick((axis + 2) % 3, sign));
            let first = mesh.positions.len() as u32;
            for (a, b) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                mesh.positions.push((normal + u * a + v * b) * size * 0.5);
                mesh.normals.push(normal);
            }
            mesh.triangles.push([first, first + 1, first + 2]);
            mesh.triangles.push([first, first + 2, first + 3]);
        }
    }
    mesh
}

fn world(density: f64, scheme: Scheme) -> World {
    let options = Options {
        density,
        rays: 32,
        rest_space: matches!(scheme, Scheme::Residual(_)),
        ..Options::of(psao::core::Kernel::Planar)
    };
    World::new(scene(), options, &|_, _, _| ()).unwrap()
}

/// What a server sends of [`scene`]: `frames` frames, a snapshot again at the fifth, and an end.
/// In profile `residual` the view turns: boxes left of a line that moves to the right are seen.
fn serve(density: f64, scheme: Scheme, frames: u32) -> Sample {
    let mut world = world(density, scheme);
    let mut encoder = Encoder::new(&world, scheme);
    let mut bytes = encoder.header(&world, world.scene.hash(), 30.0);
    let mut mirrors = HashMap::new();
    let mut cells_sent = Vec::new();
    for frame in 0..frames {
        let time_s = f64::from(frame) * 0.09;
        world.step(time_s, &|_| true, u64::MAX);
        encoder.merge(&world.truth);
        world.truth.clear_changes();
        if frame == 4 {
            encoder.resync();
        }
        let line = -0.25 + 0.12 * frame as f32;
        let seen = |bounds: [Vec3; 2]| scheme == CELLS || bounds[0].midpoint(bounds[1]).x < line;
        let sent = encoder.frame(&world, (time_s * 1e9) as u64, &seen, true, &mut bytes);
        let changed = sent.cells + sent.slices;
        assert!(changed > 0, "frame {frame} is meant to change something");
        cells_sent.push(sent.cells);
        mirrors.insert(encoder.frame_id(), contents(encoder.mirror()));
    }
    encoder.end(&mut bytes);
    if let Scheme::Residual(_) = scheme {
        let opened = cells_sent.iter().filter(|cells| **cells > 0).count();
        assert!(
            opened > 2,
            "slices are meant to open over time: {cells_sent:?}"
        );
        assert!(cells_sent.contains(&0) || frames < 8, "{cells_sent:?}");
    }
    Sample {
        bytes,
        room: capacity_of(&world.truth),
        mirrors,
    }
}

fn contents<M: psao::core::mirror::Memory>(mirror: &psao::core::Mirror<M>) -> [Vec<u8>; 3] {
    [
        bytemuck::cast_slice(mirror.instances()).to_vec(),
        bytemuck::cast_slice(mirror.buckets()).to_vec(),
        bytemuck::cast_slice(mirror.cells()).to_vec(),
    ]
}

static SERVED: LazyLock<Sample> = LazyLock::new(|| serve(24.0, CELLS, 6));

const RESIDUAL: Scheme = Scheme::Residual(Quantiser {
    step: 3,
    dead_zone: 2,
});
static SERVED_RESIDUAL: LazyLock<Sample> = LazyLock::new(|| serve(24.0, RESIDUAL, 8));

/// Writes streams by hand, and so others than the server's encoder would.
#[derive(Clone)]
struct Hand {
    bytes: Vec<u8>,
    sequence: u32,
}

impl Hand {
    const ROOM: Capacity = Capacity {
        instances: 2,
        buckets: 8,
        cells: 9,
    };

    fn header() -> Header {
        Header {
            scene_hash: 7,
            capacity: Hand::ROOM,
            max_body_bytes: 4096,
            max_raw_bytes: 4096,
            ..Header::default()
        }
    }

    fn new() -> Hand {
        Hand::with(&Hand::header())
    }

    fn with(header: &Header) -> Hand {
        let mut body = vec![0; 256];
        let mut w = Writer::new(&mut body);
        header.write(&mut w).unwrap();
        let length = w.length();
        let mut hand = Hand::bare();
        hand.packet(kind::HEADER, 0, &body[..length]);
        hand
    }

    fn bare() -> Hand {
        Hand {
            bytes: PREAMBLE.to_vec(),
            sequence: 0,
        }
    }

    fn packet(&mut self, kind: u8, flags: u8, body: &[u8]) {
        let start = self.bytes.len();
        let room = start + PACKET_HEADER_BYTES + body.len();
        self.bytes.resize(room, 0);
        let out = &mut self.bytes[start..];
        write_packet(out, kind, flags, self.sequence, |w| w.bytes(body)).unwrap();
        self.sequence += 1;
    }

    fn frame(&mut self, flags: u8, id: u32, mirror_hash: u64, raw: &[u8]) {
        self.compressed(flags, id, mirror_hash, raw.len() as u32, &zstd(raw));
    }

    fn compressed(&mut self, flags: u8, id: u32, hash: u64, raw_bytes: u32, content: &[u8]) {
        self.part(kind::FRAME, flags, id, hash, raw_bytes, content);
    }

    fn slices(&mut self, flags: u8, id: u32, hash: u64, items: &[u8]) {
        self.part(kind::SLICES, flags, id, hash, items.len() as u32, items);
    }

    fn part(&mut self, kind: u8, flags: u8, id: u32, hash: u64, raw_bytes: u32, content: &[u8]) {
        let frame = Frame {
            id,
            time_ns: u64::from(id) * 1000,
            mirror_hash: hash,
            raw_bytes,
        };
        let mut body = vec![0; FRAME_HEADER_BYTES];
        frame.write(&mut Writer::new(&mut body)).unwrap();
        body.extend_from_slice(content);
        self.packet(kind, flags, &body);
    }
}

fn zstd(raw: &[u8]) -> Vec<u8> {
    zstd::bulk::compress(raw, 3).unwrap()
}

/// The content of a frame packet.
fn content(
    instances: &[(u32, Instance)],
    buckets: &[(u32, Bucket)],
    cells: &[(u32, Cell)],
) -> Vec<u8> {
    let mut raw = vec![0; 12 + 68 * instances.len() + 36 * (buckets.len() + cells.len())];
    let mut w = Writer::new(&mut raw);
    for count in [instances.len(), buckets.len(), cells.len()] {
        w.u32(count as u32).unwrap();
    }
    w.list(instances).unwrap();
    w.list(buckets).unwrap();
    w.list(cells).unwrap();
    assert_eq!(w.length(), raw.len());
    raw
}

fn grid() -> Instance {
    Instance {
        radius: 0.8,
        cells_per_unit: [10.0; 3],
        dims: [4, 3, 2],
        bucket_count: 8,
        normal_scale: [1.0; 3],
        ..Instance::default()
    }
}

fn cell(key: u32) -> Cell {
    let mut cell = Cell {
        key,
        ..Cell::default()
    };
    cell.points[0] = Point::pack([1, 2, 3], encode_normal([0.0, 1.0, 0.0]), key as u8);
    cell
}

fn bucket(entries: &[u32]) -> Bucket {
    let mut bucket = Bucket::default();
    bucket.entries[..entries.len()].copy_from_slice(entries);
    bucket
}

/// A mirror to compute hashes with, apart from the client's.
fn hash_after(contents: &[Vec<u8>]) -> u64 {
    let mut mirror = psao::core::Mirror::new(psao::memory::Heap::new(Hand::ROOM));
    for raw in contents {
        stream::apply_changes(raw, &mut mirror).unwrap();
    }
    mirror.hash()
}

/// A snapshot in three packets, a packet to skip between them, an empty frame, and one that takes
/// a cell and a bucket away again.
fn by_hand() -> Sample {
    let parts = [
        content(&[(0, grid())], &[], &[]),
        content(&[], &[(3, bucket(&[1, 8]))], &[(1, cell(5))]),
        content(&[], &[(4, bucket(&[2]))], &[(2, cell(6)), (8, cell(7))]),
    ];
    let away = content(
        &[],
        &[(3, bucket(&[8])), (4, bucket(&[]))],
        &[(1, Cell::default()), (2, Cell::default())],
    );
    let mut hand = Hand::new();
    hand.packet(100, flag::OPTIONAL, b"of a newer minor version");
    let mut mirrors = HashMap::new();
    let mut client = Client::new(config(Hand::ROOM));
    hand.frame(flag::SNAPSHOT, 41, 0, &parts[0]);
    hand.frame(0, 41, 0, &parts[1]);
    hand.packet(101, flag::OPTIONAL | 3, &[]);
    let whole = hash_after(&parts);
    let with_away = [&parts[..], std::slice::from_ref(&away)].concat();
    hand.frame(flag::LAST, 41, whole, &parts[2]);
    hand.compressed(flag::LAST, 42, whole, 0, &[]);
    hand.frame(flag::LAST, 43, hash_after(&with_away), &away);
    hand.packet(kind::END, 0, &[]);
    let mut rest = &hand.bytes[..];
    while !rest.is_empty() {
        let pushed = client.push(rest).unwrap();
        rest = &rest[pushed.consumed..];
        if let Some(frame) = pushed.frame {
            mirrors.insert(frame.id, contents(client.mirror()));
        }
    }
    assert_eq!(mirrors.len(), 3);
    Sample {
        bytes: hand.bytes,
        room: Hand::ROOM,
        mirrors,
    }
}

// ---------------------------------------------------------------- profile residual by hand

/// The server's side of profile `residual`, over integers alone: the same on every machine.
struct Coded {
    mirror: psao::core::Mirror<psao::memory::Heap>,
    slices: psao::memory::SliceHeap,
}

impl Coded {
    fn new(header: &Header) -> Coded {
        Coded {
            mirror: psao::core::Mirror::new(psao::memory::Heap::new(header.capacity)),
            slices: psao::memory::SliceHeap::new(header.slices, header.points),
        }
    }

    fn reset(&mut self) {
        self.mirror.reset();
        self.slices.slices().reset();
    }

    /// The data of an item that brings a slice to `target`: of a number of its points.
    fn code(
        &mut self,
        index: u32,
        opens: Option<[u32; 3]>,
        step: u8,
        target: &dyn Fn(usize) -> u8,
    ) -> Vec<u8> {
        let mut slices = self.slices.slices();
        if let Some([instance, first, count]) = opens {
            slices
                .open(&self.mirror, index, instance, first, count)
                .unwrap();
        }
        let (slice, neighbours, last) = slices.side(index).unwrap();
        let cells = slice.cell_first as usize..(slice.cell_first + slice.cell_count) as usize;
        let mut values = Values::of(&self.mirror.cells()[cells]).unwrap();
        let target: Vec<u8> = (0..slice.point_count as usize).map(target).collect();
        let quantiser = if opens.is_some() {
            FIRST
        } else {
            Quantiser {
                step,
                dead_zone: step / 2,
            }
        };
        let mut state = SliceState {
            value: values.get_mut(),
            last,
        };
        let mut data = vec![0; MAX_SLICE_BYTES];
        let first = opens.is_some();
        let length = encode_slice(neighbours, quantiser, &mut state, &target, first, &mut data);
        data.truncate(length.unwrap());
        store(&mut self.mirror, slice, values.get()).unwrap();
        data
    }
}

/// Items as a packet holds them.
fn items(items: &[(u32, Option<[u32; 3]>, Vec<u8>)]) -> Vec<u8> {
    let mut out = vec![0; items.iter().map(|item| item.2.len() + 32).sum()];
    let mut w = Writer::new(&mut out);
    let mut next = 0;
    for (index, opens, bytes) in items {
        let (index, opens) = (*index, *opens);
        Item {
            index,
            opens,
            bytes,
        }
        .write(next, &mut w)
        .unwrap();
        next = index + 1;
    }
    let length = w.length();
    out.truncate(length);
    out
}

/// What to make: cells a slice, slices, frames.
type Made = [u32; 3];
const MADE_SMALL: Made = [5, 3, 7];
const MADE_LARGE: Made = [180, 4, 30];

fn made_header([cells, slices, _]: Made) -> Header {
    let cells: Vec<Cell> = (1..=cells * slices).map(made_cell).collect();
    Header {
        profile: Profile::Residual,
        step: 3,
        slices,
        points: cells.iter().map(|cell| cell.len() as u32).sum(),
        capacity: Capacity {
            cells: cells.len() as u32 + 1,
            ..Hand::ROOM
        },
        max_body_bytes: 1 << 16,
        max_raw_bytes: 1 << 16,
        ..Hand::header()
    }
}

/// Four to seven points.
fn made_cell(index: u32) -> Cell {
    let mut random = Random(index.into());
    let mut cell = Cell {
        key: index - 1,
        ..Cell::default()
    };
    for place in 0..4 + index as usize % 4 {
        let position = std::array::from_fn(|_| random.below(32) as u32);
        let normal = [0x77, 0x77, 0xe7, random.below(256) as u8][random.below(4)];
        cell.points[place] = Point::pack(position, normal, index as u8);
    }
    cell
}

/// A shadow wanders over slices that open one after the other; after two thirds of the frames a
/// snapshot. In some frames some slices stay as they are.
fn made(what: Made) -> Sample {
    let [cells, slices, frames] = what;
    let header = made_header(what);
    let mut hand = Hand::with(&header);
    let mut coded = Coded::new(&header);
    let mut mirrors = HashMap::new();
    let mut random = Random(9);
    let grid = Instance {
        dims: [8, 8, 1000],
        ..grid()
    };
    let mut open = 0;
    for frame in 0..frames {
        let snapshot = frame == 0 || frame == frames * 2 / 3;
        let opened = if snapshot { 0 } else { open };
        open = (frame / 2 + 1).min(slices);
        let mut changes: Vec<(u32, Cell)> = Vec::new();
        for index in opened * cells + 1..=open * cells {
            changes.push((index, made_cell(index)));
        }
        let mut flags = 0;
        if snapshot {
            coded.reset();
            flags |= flag::SNAPSHOT;
        }
        if !changes.is_empty() {
            let instances: &[_] = if snapshot { &[(0, grid)] } else { &[] };
            let raw = content(instances, &[(0, bucket(&[1, 2, 3]))], &changes);
            stream::apply_changes(&raw, &mut coded.mirror).unwrap();
            hand.frame(flags, frame + 1, 0, &raw);
        }
        let noise = random.below(1000);
        let target = |at: usize| {
            let off = (at * 11).abs_diff(frame as usize * 60) as u8 as usize;
            let dark = 200usize.saturating_sub(off) + (at * 7 + noise) % 5;
            255 - if dark > 4 { dark as u8 } else { 0 }
        };
        let mut list = Vec::new();
        for index in 0..open {
            let opens = (index >= opened).then_some([0, index * cells + 1, cells]);
            if opens.is_some() || (index + frame) % 3 != 0 {
                list.push((index, opens, coded.code(index, opens, header.step, &target)));
            }
        }
        // The last frame in two packets, the second without anything.
        let hash = coded.mirror.hash();
        if frame + 1 == frames {
            hand.slices(0, frame + 1, 0, &items(&list));
            hand.slices(flag::LAST, frame + 1, hash, &[]);
        } else {
            hand.slices(flag::LAST, frame + 1, hash, &items(&list));
        }
        mirrors.insert(frame + 1, contents(&coded.mirror));
    }
    hand.packet(kind::END, 0, &[]);
    Sample {
        bytes: hand.bytes,
        room: header.capacity,
        mirrors,
    }
}

/// All samples that are small enough to be damaged in every place.
fn samples() -> [Sample; 4] {
    let made = made(MADE_SMALL);
    [SERVED.clone(), SERVED_RESIDUAL.clone(), by_hand(), made]
}

fn config(capacity: Capacity) -> Config {
    Config {
        capacity,
        scene_hash: 0,
    }
}

// ---------------------------------------------------------------- reading

/// What a reader says of a stream.
#[derive(Debug, PartialEq)]
struct Outcome {
    /// Number, time, hash.
    shown: Vec<(u32, u64, u64)>,
    mismatches: u64,
    ended: bool,
    error: Option<ClientError>,
}

/// Reads a stream in pushes of `portion` bytes. Each frame shown must have the hash that its bytes
/// say, and the mirror that hash; `check` sees it.
fn read(
    client: &mut Client,
    bytes: &[u8],
    portion: usize,
    mut check: impl FnMut(&Client, &Frame),
) -> Outcome {
    client.restart();
    let before = client.stats().mismatches;
    let mut outcome = Outcome {
        shown: Vec::new(),
        mismatches: 0,
        ended: false,
        error: None,
    };
    for mut rest in bytes.chunks(portion.max(1)) {
        while !rest.is_empty() {
            match client.push(rest) {
                Ok(pushed) => {
                    assert!(pushed.consumed > 0, "a push makes no headway");
                    rest = &rest[pushed.consumed..];
                    if let Some(frame) = pushed.frame {
                        assert_eq!(client.state(), State::Live);
                        assert_eq!(client.mirror().recompute_hash(), frame.mirror_hash);
                        check(client, &frame);
                        outcome
                            .shown
                            .push((frame.id, frame.time_ns, frame.mirror_hash));
                    }
                }
                Err(error) => {
                    assert_eq!(client.state(), State::Failed);
                    assert_eq!(client.push(&[0]), Err(ClientError::Failed));
                    outcome.error = Some(error);
                    break;
                }
            }
        }
        if outcome.error.is_some() {
            break;
        }
    }
    outcome.mismatches = client.stats().mismatches - before;
    outcome.ended = client.state() == State::Ended;
    outcome
}

/// Reads a stream with both readers, which must agree, and returns what they say.
fn agreed(client: &mut Client, bytes: &[u8], room: Capacity) -> Outcome {
    let second = second_reader::read(bytes, [room.instances, room.buckets, room.cells]);
    let mut frames = second.shown.iter();
    let outcome = read(client, bytes, usize::MAX, |client, frame| {
        let other = frames.next().expect("the second reader withholds this one");
        let said = (other.id, other.time_ns, other.mirror_hash);
        assert_eq!(said, (frame.id, frame.time_ns, frame.mirror_hash));
        let [instances, buckets, cells] = contents(client.mirror());
        for (bytes, buffer, size) in [
            (instances, &other.mirror[0], 64),
            (buckets, &other.mirror[1], 32),
            (cells, &other.mirror[2], 32),
        ] {
            for (index, element) in bytes.chunks(size).enumerate() {
                let zero = vec![0; size];
                let said = buffer.get(&(index as u32)).unwrap_or(&zero);
                assert_eq!(said, element, "element {index} of frame {}", frame.id);
            }
            let beyond = buffer.keys().any(|&i| i as usize >= bytes.len() / size);
            assert!(!beyond, "the second reader has more");
        }
    });
    assert!(frames.next().is_none(), "only the second reader shows this");
    assert_eq!(
        (outcome.mismatches as usize, outcome.ended),
        (second.mismatches, second.ended && second.error.is_none())
    );
    assert_eq!(
        outcome.error.is_some(),
        second.error.is_some(),
        "{:?}, but the second reader: {:?}",
        outcome.error,
        second.error
    );
    outcome
}

/// [`agreed`] with a new client, checked against the sample's mirrors too.
fn agreed_on(sample: &Sample) -> Outcome {
    let mut client = Client::new(config(sample.room));
    let outcome = agreed(&mut client, &sample.bytes, sample.room);
    read(&mut client, &sample.bytes, usize::MAX, |client, frame| {
        assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
    });
    outcome
}

/// Where the packets of a whole stream are.
fn packets(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let mut at = PREAMBLE.len();
    let mut packets = Vec::new();
    while at < bytes.len() {
        let (_, length) = Packet::read(&bytes[at..], MAX_BODY_BYTES).unwrap().unwrap();
        packets.push(at..at + length);
        at += length;
    }
    packets
}

/// Makes the checksums right again, as far as packets can be told.
fn mend(bytes: &mut [u8]) {
    let mut at = PREAMBLE.len();
    while at + PACKET_HEADER_BYTES <= bytes.len() {
        let length = u32::from_le_bytes(bytes[at + 4..at + 8].try_into().unwrap()) as usize;
        let end = at + PACKET_HEADER_BYTES + length;
        if end > bytes.len() {
            return;
        }
        let covered = [&bytes[at..at + 12], &bytes[at + 16..end]].concat();
        let checksum = second_reader::crc32(&covered);
        bytes[at + 12..at + 16].copy_from_slice(&checksum.to_le_bytes());
        at = end;
    }
}

/// SplitMix64: the same on every machine.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e3779b97f4a7c15);
        let mut x = self.0;
        x = (x ^ x >> 30).wrapping_mul(0xbf58476d1ce4e5b9);
        x = (x ^ x >> 27).wrapping_mul(0x94d049bb133111eb);
        ((x ^ x >> 31) % limit as u64) as usize
    }
}

// ---------------------------------------------------------------- whole streams

#[test]
fn both_readers_show_what_the_server_has_frame_by_frame() {
    assert_eq!(second_reader::crc32(b"123456789"), 0xcbf43926);
    let outcome = agreed_on(&SERVED);
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!(ids, [1, 2, 3, 4, 5, 6]);
    assert!(outcome.ended && outcome.error.is_none() && outcome.mismatches == 0);

    let outcome = agreed_on(&SERVED_RESIDUAL);
    assert_eq!((outcome.shown.len(), outcome.mismatches), (8, 0));
    assert!(outcome.ended && outcome.error.is_none());
    // Several slices an instance.
    let sample = serve(1500.0, RESIDUAL, 6);
    let mut client = Client::new(config(sample.room));
    client.push(&sample.bytes[..100]).unwrap();
    assert!(client.header().is_some_and(|header| header.slices > 5));
    let outcome = agreed_on(&sample);
    assert_eq!((outcome.shown.len(), outcome.error), (6, None));
    for what in [MADE_SMALL, MADE_LARGE] {
        let outcome = agreed_on(&made(what));
        assert_eq!(outcome.shown.len() as u32, what[2]);
        assert!(outcome.ended && outcome.error.is_none());
    }

    let outcome = agreed_on(&by_hand());
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!(ids, [41, 42, 43]);
    assert!(outcome.ended && outcome.error.is_none());
}

#[test]
fn a_frame_too_large_for_one_packet_comes_in_several() {
    let sample = serve(10_000.0, CELLS, 1);
    let packets = packets(&sample.bytes);
    assert!(packets.len() > 3, "{} packets", packets.len());
    let outcome = agreed_on(&sample);
    assert_eq!((outcome.shown.len(), outcome.error), (1, None));
}

#[test]
fn a_stream_does_not_depend_on_the_number_of_threads() {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.unwrap();
        [(CELLS, 6), (RESIDUAL, 8)]
            .map(|(scheme, frames)| pool.install(|| serve(24.0, scheme, frames).bytes))
    };
    let bytes = [SERVED.bytes.clone(), SERVED_RESIDUAL.bytes.clone()];
    assert!(on(1) == bytes && on(7) == bytes);
}

#[test]
fn however_a_stream_is_cut_its_frames_are_the_same() {
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let whole = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
        for portion in [1, 2, 15, 16, 17, 1000] {
            let cut = read(&mut client, &sample.bytes, portion, |client, frame| {
                assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
            });
            assert_eq!(cut, whole);
        }
    }
}

#[test]
fn every_prefix_of_a_stream_shows_the_frames_that_are_whole_in_it() {
    for sample in samples() {
        // Where each frame ends, from pushing byte by byte.
        let mut client = Client::new(config(sample.room));
        let mut ends = Vec::new();
        for at in 0..sample.bytes.len() {
            if let Some(frame) = client.push(&sample.bytes[at..=at]).unwrap().frame {
                ends.push((at + 1, frame));
            }
        }
        assert_eq!(ends.len(), sample.mirrors.len());
        for length in 0..=sample.bytes.len() {
            let prefix: Box<[u8]> = sample.bytes[..length].into();
            let outcome = agreed(&mut client, &prefix, sample.room);
            let whole = ends.iter().filter(|(end, _)| *end <= length).count();
            assert_eq!(outcome.shown.len(), whole, "{length} bytes");
            assert_eq!(outcome.error, None);
            assert_eq!(outcome.ended, length == sample.bytes.len());
        }
    }
}

#[test]
fn nothing_may_follow_the_end() {
    // [3.2]
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let mut longer = sample.bytes.clone();
        longer.push(0);
        let outcome = agreed(&mut client, &longer, sample.room);
        assert_eq!(outcome.shown.len(), sample.mirrors.len());
        assert_eq!(outcome.error, Some(StreamError::Order.into()));
    }
}

// ---------------------------------------------------------------- damaged streams

#[test]
fn every_flipped_bit_is_an_error_or_withholds_frames() {
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let good = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
        let mut bytes = sample.bytes.clone();
        for bit in 0..8 * bytes.len() {
            bytes[bit / 8] ^= 1 << (bit % 8);
            let outcome = read(&mut client, &bytes, usize::MAX, |client, frame| {
                assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
            });
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(
                good.shown.starts_with(&outcome.shown) && !outcome.ended,
                "bit {bit} goes unnoticed: {outcome:?}"
            );
            // Only a length that became larger leaves the reader waiting.
            assert!(
                outcome.error.is_some() || outcome.shown.len() < good.shown.len() || {
                    let end = packets(&bytes).pop().unwrap();
                    (end.start + 4..end.start + 8).contains(&(bit / 8))
                },
                "bit {bit}"
            );
        }
    }
}

#[test]
fn lost_repeated_and_swapped_packets_are_noticed() {
    // [2.7]
    for sample in samples() {
        let mut client = Client::new(config(sample.room));
        let places = packets(&sample.bytes);
        let list: Vec<&[u8]> = places.iter().map(|p| &sample.bytes[p.clone()]).collect();
        let mut damaged = |change: &dyn Fn(&mut Vec<&[u8]>), stays: bool| {
            let mut list = list.clone();
            change(&mut list);
            let bytes = [&PREAMBLE[..], &list.concat()].concat();
            let outcome = agreed(&mut client, &bytes, sample.room);
            assert_eq!(outcome.error.is_none(), stays, "{outcome:?}");
        };
        for at in 0..list.len() {
            // Without its last packet, a stream just stops.
            let last = at + 1 == list.len();
            damaged(
                &|list| {
                    list.remove(at);
                },
                last,
            );
            damaged(&|list| list.insert(at, list[at]), false);
            if !last {
                damaged(&|list| list.swap(at, at + 1), false);
            }
        }
    }
}

#[test]
fn frames_that_are_lost_or_mixed_are_noticed_even_where_the_sequence_is_right() {
    // [5.2 to 5.5]
    let sample = by_hand();
    let bodies: Vec<(u8, u8, Vec<u8>)> = packets(&sample.bytes)
        .into_iter()
        .map(|place| {
            let bytes = &sample.bytes[place];
            let (packet, _) = Packet::read(bytes, MAX_BODY_BYTES).unwrap().unwrap();
            (packet.kind, packet.flags, packet.body.to_vec())
        })
        .collect();
    let read_changed = |change: &dyn Fn(&mut Vec<(u8, u8, Vec<u8>)>)| {
        let mut bodies = bodies.clone();
        change(&mut bodies);
        let mut hand = Hand::bare();
        for (kind, flags, body) in &bodies {
            hand.packet(*kind, *flags, body);
        }
        agreed(
            &mut Client::new(config(sample.room)),
            &hand.bytes,
            sample.room,
        )
    };
    assert_eq!(bodies.len(), 9);
    assert_eq!(read_changed(&|_| ()).shown.len(), 3);
    let order = Some(ClientError::Stream(StreamError::Order));
    let value = Some(ClientError::Stream(StreamError::Value));

    let lost_first = read_changed(&|list| drop(list.remove(2)));
    assert_eq!((lost_first.shown.len(), lost_first.error), (0, None));
    let lost_part = read_changed(&|list| drop(list.remove(3)));
    assert_eq!(lost_part.shown, []);
    assert_eq!((lost_part.mismatches, lost_part.error), (1, None));
    let lost_last = read_changed(&|list| drop(list.remove(5)));
    assert_eq!(lost_last.error, order);
    let lost_frame = read_changed(&|list| drop(list.remove(6)));
    assert_eq!(
        (lost_frame.shown.len(), lost_frame.error),
        (1, order.clone())
    );
    let repeated = read_changed(&|list| list.insert(6, list[6].clone()));
    assert_eq!((repeated.shown.len(), repeated.error), (2, order.clone()));
    let end_within = read_changed(&|list| list.swap(5, 8));
    assert_eq!(end_within.error, order);
    let snapshot_within = read_changed(&|list| list[3].1 |= flag::SNAPSHOT);
    assert_eq!(snapshot_within.error, order);
    let early_hash = read_changed(&|list| list[2].2[12] = 1);
    assert_eq!(early_hash.error, value);
    let other_time = read_changed(&|list| list[3].2[4] ^= 1);
    assert_eq!(other_time.error, order);
}

#[test]
fn what_is_out_of_place_is_refused() {
    // [3.2]
    let order = Some(ClientError::Stream(StreamError::Order));
    let error = |hand: &Hand| {
        agreed(
            &mut Client::new(config(Hand::ROOM)),
            &hand.bytes,
            Hand::ROOM,
        )
        .error
    };
    for kind in [kind::FRAME, kind::SLICES, kind::END, 99] {
        let mut hand = Hand::bare();
        hand.packet(kind, 0, &[0; 24]);
        assert_eq!(error(&hand), order, "kind {kind} before the header");
    }
    for kind in [kind::HEADER, kind::REFUSE, kind::SLICES] {
        let mut hand = Hand::new();
        hand.packet(kind, 0, &[1; 60]);
        assert_eq!(error(&hand), order, "kind {kind} after the header");
    }
    for kind in [0, 6, 15, 64, 99, 255] {
        let mut hand = Hand::new();
        hand.packet(kind, 0, &[]);
        assert_eq!(error(&hand), Some(StreamError::Kind(kind).into()));
    }
    let mut hand = Hand::new();
    hand.packet(kind::END, 0, &[0]);
    assert_eq!(error(&hand), Some(StreamError::Length.into()));
}

// ---------------------------------------------------------------- fields outside their range

/// The stream by hand with one byte of its header packet's body replaced, the checksum right.
fn with_header_byte(at: usize, value: u8) -> Vec<u8> {
    let mut bytes = by_hand().bytes;
    bytes[PREAMBLE.len() + PACKET_HEADER_BYTES + at] = value;
    mend(&mut bytes);
    bytes
}

#[test]
fn headers_outside_their_ranges_are_refused_and_named() {
    // [4.1, 4.2]
    let error = |bytes: &[u8]| {
        let outcome = agreed(&mut Client::new(config(Hand::ROOM)), bytes, Hand::ROOM);
        outcome.error.map(|error| error.to_string())
    };
    assert_eq!(error(&by_hand().bytes), None);
    // A newer minor version is read, and so is the other kernel.
    assert_eq!(error(&with_header_byte(2, 9)), None);
    assert_eq!(error(&with_header_byte(5, 1)), None);
    let says = |at, value, words: &str| {
        let said = error(&with_header_byte(at, value)).expect("refused");
        assert!(said.contains(words), "{said}");
    };
    says(0, 2, "stream version 2");
    says(1, 1, "stream version 257");
    says(4, 2, "stream profile 2");
    for (at, value) in [
        (5, 2),
        (6, 8),
        (6, 15),
        (7, 4),
        (31, 1),
        (35, 1),
        (39, 0xff),
        (4, 1),
        (49, 1),
        (50, 1),
        (51, 1),
        (52, 1),
        (55, 1),
        (56, 1),
    ] {
        says(at, value, "outside its range");
    }
    for value in [f32::NAN, f32::INFINITY, -1.0] {
        for field in 0..3 {
            let mut header = Hand::header();
            *[
                &mut header.ao_distance_m,
                &mut header.density,
                &mut header.rate_hz,
            ][field] = value;
            let said = error(&Hand::with(&header).bytes).expect("refused");
            assert!(said.contains("outside its range"), "{said}");
        }
    }
    // Fields of a newer minor version are ignored, missing ones are not.
    let mut body = Packet::read(&Hand::new().bytes[8..], 4096)
        .unwrap()
        .unwrap()
        .0
        .body
        .to_vec();
    let mut hand = Hand::bare();
    body.extend([9; 20]);
    hand.packet(kind::HEADER, 0, &body);
    assert_eq!(error(&hand.bytes), None);
    for length in 0..60 {
        let mut hand = Hand::bare();
        hand.packet(kind::HEADER, 0, &body[..length]);
        assert!(error(&hand.bytes).is_some(), "{length} bytes");
    }
}

#[test]
fn reserved_bits_are_checked_and_flags_only_where_they_belong() {
    // [2.3, 2.6]
    let value = Some(ClientError::Stream(StreamError::Value));
    let bytes = by_hand().bytes;
    for place in packets(&bytes) {
        let known = bytes[place.start] < 64;
        for bit in 0..8 {
            let mut bytes = bytes.clone();
            if bytes[place.start + 1] & 1 << bit != 0 {
                continue;
            }
            bytes[place.start + 1] |= 1 << bit;
            mend(&mut bytes);
            let outcome = agreed(&mut Client::new(config(Hand::ROOM)), &bytes, Hand::ROOM);
            if !known {
                assert_eq!(outcome.error, None);
            } else if bit > 1 || bytes[place.start] != kind::FRAME {
                assert_eq!(outcome.error, value, "bit {bit}");
            }
        }
        for reserved in [2, 3] {
            let mut bytes = bytes.clone();
            bytes[place.start + reserved] = 1;
            mend(&mut bytes);
            let outcome = agreed(&mut Client::new(config(Hand::ROOM)), &bytes, Hand::ROOM);
            assert_eq!(outcome.error, value);
        }
    }
}

#[test]
fn a_client_says_what_it_lacks() {
    // [4.3]
    type Less = fn(&mut Capacity);
    let less: [Less; 3] = [
        |room| room.instances -= 1,
        |room| room.buckets -= 1,
        |room| room.cells -= 1,
    ];
    for less in less {
        let mut room = Hand::ROOM;
        less(&mut room);
        let mut client = Client::new(config(room));
        let outcome = agreed(&mut client, &by_hand().bytes, room);
        assert_eq!(outcome.error, Some(ClientError::Capacity(Hand::ROOM)));
        assert_eq!(client.mirror().capacity(), Capacity::default());
    }
    let mut client = Client::new(Config {
        scene_hash: 8,
        ..config(Hand::ROOM)
    });
    let error = client.push(&by_hand().bytes).unwrap_err();
    assert_eq!(error, ClientError::Scene(7));
    let mut client = Client::new(Config {
        scene_hash: 7,
        ..config(Hand::ROOM)
    });
    assert!(client.push(&by_hand().bytes).is_ok());
}

#[test]
fn a_refusal_comes_through_in_words() {
    // [3.4]
    for reason in [
        Refusal::Token,
        Refusal::Scene,
        Refusal::Capacity,
        Refusal::Full,
    ] {
        let mut client = Client::new(config(Hand::ROOM));
        let outcome = agreed(&mut client, &refusal(reason), Hand::ROOM);
        let text = reason.to_string();
        assert_eq!(
            outcome.error,
            Some(ClientError::Refused(Some(reason), text))
        );
    }
    let mut hand = Hand::bare();
    let words = format!("\u{3}\u{1}\u{1b}[31mno\n{}", "x".repeat(1000));
    hand.packet(kind::REFUSE, 0, words.as_bytes());
    match Client::new(config(Hand::ROOM)).push(&hand.bytes) {
        Err(ClientError::Refused(None, text)) => {
            assert!(text.starts_with("[31mnox") && text.len() == 200, "{text}");
        }
        other => panic!("{other:?}"),
    }
    let mut hand = Hand::bare();
    hand.packet(kind::REFUSE, 0, &[1]);
    let outcome = agreed(
        &mut Client::new(config(Hand::ROOM)),
        &hand.bytes,
        Hand::ROOM,
    );
    assert_eq!(outcome.error, Some(StreamError::Length.into()));
}

#[test]
fn content_that_does_not_fit_the_mirror_is_refused() {
    // [6.2 to 6.4, 7.4]
    let error = |raw: &[u8]| {
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, 0, raw);
        agreed(
            &mut Client::new(config(Hand::ROOM)),
            &hand.bytes,
            Hand::ROOM,
        )
        .error
    };
    let mirror = |error| Some(ClientError::Stream(StreamError::Mirror(error)));
    let length = Some(ClientError::Stream(StreamError::Length));
    let value = Some(ClientError::Stream(StreamError::Value));
    let index = mirror(MirrorError::Index);
    assert_eq!(error(&content(&[], &[], &[(9, cell(1))])), index);
    assert_eq!(error(&content(&[], &[], &[(0, cell(1))])), index);
    assert_eq!(error(&content(&[], &[(8, bucket(&[]))], &[])), index);
    assert_eq!(error(&content(&[(2, grid())], &[], &[])), index);
    let entry = mirror(MirrorError::Entry);
    assert_eq!(error(&content(&[], &[(0, bucket(&[9]))], &[])), entry);
    assert_eq!(
        error(&content(&[], &[(0, bucket(&[0, u32::MAX]))], &[])),
        entry
    );
    let change: [fn(&mut Instance); 11] = [
        |i| i.origin[1] = f32::NAN,
        |i| i.radius = 0.0,
        |i| i.radius = f32::INFINITY,
        |i| i.cells_per_unit[2] = -1.0,
        |i| i.cells_per_unit[0] = f32::NAN,
        |i| i.dims[0] = 0,
        |i| i.dims[2] = (1 << 20) + 1,
        |i| i.bucket_first = 1,
        |i| i.bucket_first = u32::MAX,
        |i| i.normal_scale[0] = 0.0,
        |i| i.reserved = 1,
    ];
    for (number, change) in change.into_iter().enumerate() {
        let mut grid = grid();
        change(&mut grid);
        let found = error(&content(&[(0, grid)], &[], &[]));
        let refused = matches!(
            found,
            Some(ClientError::Stream(StreamError::Mirror(MirrorError::Grid(
                _
            ))))
        );
        assert!(refused, "change {number}: {found:?}");
        // Without buckets all of it is unused.
        grid.bucket_count = 0;
        assert_eq!(error(&content(&[(0, grid)], &[], &[])), None);
    }
    let good = content(&[(0, grid())], &[(3, bucket(&[1]))], &[(1, cell(5))]);
    assert_eq!(error(&good), None);
    for short in 1..good.len() {
        assert_eq!(error(&good[..short]), length, "{short} bytes");
    }
    assert_eq!(error(&[&good[..], &[0]].concat()), length);
    // Gaps that go past the last index there can be.
    let mut far = content(&[], &[], &[(1, cell(1)), (2, cell(2))]);
    far[16..20].fill(0xff);
    assert_eq!(error(&far), value);
    far[12..16].fill(0xff);
    assert_eq!(error(&far), value);
}

#[test]
fn content_is_exactly_one_zstd_frame() {
    // [6.1]
    let raw = content(&[(0, grid())], &[(3, bucket(&[1]))], &[(1, cell(5))]);
    let hash = hash_after(std::slice::from_ref(&raw));
    let outcome = |raw_bytes: u32, compressed: &[u8]| {
        let mut hand = Hand::new();
        let flags = flag::SNAPSHOT | flag::LAST;
        hand.compressed(flags, 1, hash, raw_bytes, compressed);
        let outcome = agreed(
            &mut Client::new(config(Hand::ROOM)),
            &hand.bytes,
            Hand::ROOM,
        );
        assert_eq!(outcome.shown.len(), usize::from(outcome.error.is_none()));
        outcome.error
    };
    let bytes = raw.len() as u32;
    let good = zstd(&raw);
    let compression = Some(ClientError::Compression);
    assert_eq!(outcome(bytes, &good), None);
    assert_eq!(outcome(bytes - 1, &good), compression);
    assert_eq!(outcome(bytes + 1, &good), compression);
    assert_eq!(outcome(0, &good), Some(StreamError::Length.into()));
    assert_eq!(outcome(bytes, &[]), compression);
    assert_eq!(outcome(bytes, &raw), compression);
    for length in 1..good.len() {
        assert_eq!(
            outcome(bytes, &good[..length]),
            compression,
            "{length} bytes"
        );
    }
    assert_eq!(outcome(bytes, &[&good[..], &[0]].concat()), compression);
    let skippable = [0x50, 0x2a, 0x4d, 0x18, 1, 0, 0, 0, 0];
    assert_eq!(
        outcome(bytes, &[&skippable[..], &good].concat()),
        compression
    );
    assert_eq!(
        outcome(bytes, &[&good[..], &skippable].concat()),
        compression
    );
    let (head, tail) = raw.split_at(40);
    assert_eq!(
        outcome(bytes, &[zstd(head), zstd(tail)].concat()),
        compression
    );
}

// ---------------------------------------------------------------- slices

#[test]
fn normals_and_neighbours_are_those_of_the_integer_rule() {
    // [15.6]
    for code in 0..=255u8 {
        let steps = second_reader::normal_steps(code);
        let normal = psao::core::point::decode_normal(code);
        for axis in 0..3 {
            assert_eq!(steps[axis], (normal[axis] * 127.0) as i64, "code {code}");
        }
    }
    let mut random = Random(5);
    // From points on top of each other, which are all equally near, to points far outside any grid.
    for spread in [1, 2, 3, 20, 400, 1 << 15, 1 << 20, u32::MAX as usize] {
        for count in [0, 1, 2, 3, 4, 130, 131, 1024] {
            let points: Vec<([u32; 3], u8)> = (0..count)
                .map(|_| {
                    let place = std::array::from_fn(|_| random.below(spread) as u32);
                    (place, random.below(256) as u8)
                })
                .collect();
            let (places, normals): (Vec<_>, Vec<_>) = points.iter().copied().unzip();
            let mut found = vec![Neighbours::default(); count];
            find_neighbours(&places, &normals, &mut found);
            let (earlier, later) = second_reader::neighbours(&points);
            for at in 0..count {
                let said = |others: &[usize]| {
                    let mut far = [0; 3];
                    for (far, other) in far.iter_mut().zip(others) {
                        *far = at.abs_diff(*other) as u8;
                    }
                    far
                };
                let expected = Neighbours {
                    earlier: said(&earlier[at]),
                    later: said(&later[at]),
                };
                assert_eq!(found[at], expected, "{at} of {count}, spread {spread}");
            }
        }
    }
}

/// FNV-1a.
fn fingerprint(parts: impl IntoIterator<Item = u64>) -> u64 {
    let bytes = parts.into_iter().flat_map(u64::to_le_bytes);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    })
}

#[test]
fn a_made_stream_decodes_to_the_same_mirrors_on_every_machine() {
    // [13.1] The hashes of all frames: integers alone lead to them.
    let outcome = agreed_on(&made(MADE_LARGE));
    let hashes = outcome.shown.iter().map(|shown| shown.2);
    assert_eq!(fingerprint(hashes), 17487932342274786045);
}

/// A stream with cells 1 to 5 of 1, 2, 3, 7 and 7 points, the last two of them in an instance
/// without points; three slices, room for 13 points.
fn slices_header() -> Header {
    Header {
        profile: Profile::Residual,
        step: 3,
        slices: 3,
        points: 13,
        ..Hand::header()
    }
}

fn slices_content() -> Vec<u8> {
    let with = |index: u32, count: usize| {
        let mut cell = cell(index);
        for place in 0..count {
            cell.points[place] = Point::pack([place as u32 * 4, 2, 3], 0x77, 9);
        }
        (index, cell)
    };
    let cells = [(1, 1), (2, 2), (3, 3), (4, 7), (5, 7)].map(|(index, count)| with(index, count));
    content(&[(0, grid())], &[(0, bucket(&[1, 2, 3]))], &cells)
}

/// What the readers say of a snapshot with [`slices_content`] and a frame of these packets of
/// items, with the hash that the mirror then has.
fn slices_outcome(header: &Header, parts: &[Vec<u8>]) -> Outcome {
    let mut coded = Coded::new(header);
    let raw = slices_content();
    stream::apply_changes(&raw, &mut coded.mirror).unwrap();
    let mut hand = Hand::with(header);
    hand.frame(flag::SNAPSHOT | flag::LAST, 1, coded.mirror.hash(), &raw);
    for part in parts {
        let slices = &mut coded.slices.slices();
        let applied = apply_slices(part, header.step, &mut coded.mirror, slices);
        hand.slices(0, 2, 0, part);
        if applied.is_err() {
            break;
        }
    }
    hand.slices(flag::LAST, 2, coded.mirror.hash(), &[]);
    let mut client = Client::new(config(Hand::ROOM));
    let outcome = agreed(&mut client, &hand.bytes, Hand::ROOM);
    assert_eq!(outcome.mismatches, 0);
    let whole = outcome.error.is_none();
    assert_eq!(outcome.shown.len(), 1 + usize::from(whole));
    outcome
}

#[test]
fn items_that_do_not_fit_are_refused() {
    // [15.2 to 15.4]
    let header = slices_header();
    let error = |parts: &[Vec<u8>]| slices_outcome(&header, parts).error;
    let value = Some(ClientError::Stream(StreamError::Value));
    let order = Some(ClientError::Stream(StreamError::Order));
    let length = Some(ClientError::Stream(StreamError::Length));
    // All points open, or as they were: one decision a block, and the same data for all.
    let still = |first| {
        let (mut value, mut last) = ([255; 16], [0; 16]);
        let mut state = SliceState {
            value: &mut value,
            last: &mut last,
        };
        let quantiser = Quantiser {
            step: 3,
            dead_zone: 0,
        };
        let mut data = vec![0; 16];
        let neighbours = [Neighbours::default(); 16];
        let length = encode_slice(
            &neighbours,
            quantiser,
            &mut state,
            &[255; 16],
            first,
            &mut data,
        );
        data.truncate(length.unwrap());
        data
    };
    let (opened, unchanged) = (still(true), still(false));
    let open = |index, opens| items(&[(index, Some(opens), opened.clone())]);
    let good = open(0, [0, 1, 2]);
    assert_eq!(error(std::slice::from_ref(&good)), None);
    assert_eq!(error(&[open(2, [0, 1, 3])]), None);
    let later = items(&[(0, None, unchanged.clone())]);
    assert_eq!(error(&[good.clone(), later.clone()]), None);

    assert_eq!(error(&[later]), order, "not open");
    assert_eq!(error(&[good.clone(), good.clone()]), order, "open already");
    assert_eq!(error(&[open(3, [0, 1, 1])]), value, "no such slice");
    assert_eq!(error(&[items(&[(3, None, unchanged.clone())])]), order);
    assert_eq!(error(&[open(0, [1, 1, 1])]), value, "no points in it");
    assert_eq!(error(&[open(0, [2, 1, 1])]), value, "no such instance");
    assert_eq!(error(&[open(0, [0, 1, 0])]), order, "no cells");
    for (first, count) in [
        (0, 1),
        (0, 2),
        (1, 6),
        (6, 1),
        (8, 2),
        (9, 1),
        (u32::MAX, 1),
    ] {
        assert_eq!(error(&[open(0, [0, first, count])]), value, "cell {first}");
    }
    for count in [u32::MAX, u32::MAX - 1] {
        assert_eq!(error(&[open(0, [0, 2, count])]), value, "{count} cells");
    }
    // 7 + 6 points are as many as there may be, one more is not.
    assert_eq!(error(&[open(0, [0, 4, 1]), open(1, [0, 1, 3])]), None);
    assert_eq!(error(&[open(0, [0, 4, 2])]), value);
    let too_many = [open(0, [0, 4, 1]), open(1, [0, 1, 3]), open(2, [0, 1, 1])];
    assert_eq!(error(&too_many), value);

    let varint = |value: u32| {
        let mut bytes = [0; 5];
        let mut w = Writer::new(&mut bytes);
        w.varint(value).unwrap();
        let length = w.length();
        bytes[..length].to_vec()
    };
    for gap in [3, 1 << 20, u32::MAX / 2] {
        let far = [varint(gap << 1 | 1), vec![0, 1, 1, 0]].concat();
        assert_eq!(error(&[far]), value, "a gap of {gap}");
        assert_eq!(error(&[[varint(gap << 1), vec![0]].concat()]), order);
        assert_eq!(
            error(&[[good.clone(), varint(gap << 1), vec![0]].concat()]),
            order
        );
    }
    // Numbers in more bytes than they need are read; those that are too long or large are not.
    let size = opened.len() as u8;
    let long = [
        0x81,
        0,
        0x80,
        0,
        1,
        0x82,
        0x80,
        0x80,
        0x80,
        0,
        size | 0x80,
        0,
    ];
    assert_eq!(error(&[[&long[..], &opened].concat()]), None);
    let too_long = [1, 0, 1, 2, size | 0x80, 0x80, 0x80, 0x80, 0x80, 0];
    assert_eq!(error(&[[&too_long[..], &opened].concat()]), value);
    let too_large = [1, 0, 1, 2, 0xff, 0xff, 0xff, 0xff, 0x10];
    assert_eq!(error(&[[&too_large[..], &opened].concat()]), value);
    for short in 1..good.len() {
        assert_eq!(error(&[good[..short].to_vec()]), length, "{short} bytes");
    }
    assert_eq!(error(&[[&good[..], &[0x80]].concat()]), length);
    // The data itself ends too early, or too late [15.5].
    for data in [vec![], [&opened[..], &[0]].concat(), vec![0xff; 9]] {
        let list = items(&[(0, Some([0, 1, 2]), data)]);
        assert_eq!(error(&[list]), length);
    }

    let mut longer = Hand::with(&header);
    longer.part(kind::SLICES, flag::SNAPSHOT | flag::LAST, 1, 0, 1, &[]);
    let mut client = Client::new(config(Hand::ROOM));
    let outcome = agreed(&mut client, &longer.bytes, Hand::ROOM);
    assert_eq!(outcome.error, length);
}

#[test]
fn a_slice_has_at_most_1024_points() {
    // [15.3] 4 to 7 points a cell, 5.5 in the mean.
    let mut header = made_header([250, 1, 1]);
    let cells: Vec<(u32, Cell)> = (1..=250).map(|index| (index, made_cell(index))).collect();
    let raw = content(&[(0, grid())], &[], &cells);
    let mut points = 0;
    let fit = cells.iter().take_while(|(_, cell)| {
        points += cell.len();
        points <= 1024
    });
    let fit = fit.count() as u32;
    header.slices = 1;
    for (count, good) in [(fit, true), (fit + 1, false), (250, false)] {
        let mut coded = Coded::new(&header);
        stream::apply_changes(&raw, &mut coded.mirror).unwrap();
        let data = if good {
            coded.code(0, Some([0, 1, count]), 3, &|at| at as u8)
        } else {
            Vec::new()
        };
        let mut hand = Hand::with(&header);
        hand.frame(flag::SNAPSHOT, 1, 0, &raw);
        let list = items(&[(0, Some([0, 1, count]), data)]);
        hand.slices(flag::LAST, 1, coded.mirror.hash(), &list);
        let mut client = Client::new(config(header.capacity));
        let outcome = agreed(&mut client, &hand.bytes, header.capacity);
        assert_eq!(outcome.shown.len(), usize::from(good), "{count} cells");
        assert_eq!(outcome.error.is_none(), good, "{count} cells");
    }
}

#[test]
fn slices_over_the_same_cells_and_cells_that_come_again_say_what_came_last() {
    // [15.4]
    let header = slices_header();
    let mut coded = Coded::new(&header);
    let raw = slices_content();
    stream::apply_changes(&raw, &mut coded.mirror).unwrap();
    let mut hand = Hand::with(&header);
    hand.frame(flag::SNAPSHOT, 1, 0, &raw);
    let [a, b] = [Some([0, 1, 3]), Some([0, 2, 2])];
    let first = [
        (0, a, coded.code(0, a, 3, &|at| 200 - at as u8 * 9)),
        (1, b, coded.code(1, b, 3, &|at| 90 + at as u8 * 7)),
        // In another packet, since indices rise.
        (0, None, coded.code(0, None, 3, &|at| 30 + at as u8)),
    ];
    hand.slices(0, 1, 0, &items(&first[..2]));
    hand.slices(flag::LAST, 1, coded.mirror.hash(), &items(&first[2..]));
    // Cells of the slices come again: with as many points at other places, then with fewer.
    let mut again = cell(2);
    again.points[1] = Point::pack([9; 3], 0xe7, 77);
    let raw = content(&[], &[], &[(2, again)]);
    stream::apply_changes(&raw, &mut coded.mirror).unwrap();
    hand.frame(0, 2, 0, &raw);
    let second = [
        (0, None, coded.code(0, None, 3, &|at| 60 + at as u8 * 20)),
        (1, None, coded.code(1, None, 3, &|at| 250 - at as u8 * 20)),
    ];
    hand.slices(flag::LAST, 2, coded.mirror.hash(), &items(&second));
    let mut fewer = hand.clone();
    hand.packet(kind::END, 0, &[]);
    let outcome = agreed(
        &mut Client::new(config(Hand::ROOM)),
        &hand.bytes,
        Hand::ROOM,
    );
    assert_eq!((outcome.shown.len(), outcome.error), (2, None));

    fewer.frame(0, 3, 0, &content(&[], &[], &[(3, cell(3))]));
    fewer.slices(flag::LAST, 3, 0, &items(&[(1, None, Vec::new())]));
    let outcome = agreed(
        &mut Client::new(config(Hand::ROOM)),
        &fewer.bytes,
        Hand::ROOM,
    );
    assert_eq!(outcome.error, Some(StreamError::Value.into()));
}

#[test]
fn a_lost_packet_of_slices_never_shows_a_wrong_mirror_even_where_the_sequence_is_right() {
    for sample in [made(MADE_SMALL), SERVED_RESIDUAL.clone()] {
        let list: Vec<(u8, u8, Vec<u8>)> = packets(&sample.bytes)
            .into_iter()
            .map(|place| {
                let bytes = &sample.bytes[place];
                let (packet, _) = Packet::read(bytes, MAX_BODY_BYTES).unwrap().unwrap();
                (packet.kind, packet.flags, packet.body.to_vec())
            })
            .collect();
        let mut client = Client::new(config(sample.room));
        let right = hashes(&sample);
        let mut noticed = 0;
        for at in 1..list.len() {
            for swap in [false, true] {
                let mut list = list.clone();
                if !swap {
                    list.remove(at);
                } else if at + 1 < list.len() {
                    list.swap(at, at + 1);
                }
                let mut hand = Hand::bare();
                for (kind, flags, body) in &list {
                    hand.packet(*kind, *flags, body);
                }
                let outcome = agreed_with(&mut client, &hand.bytes, &sample, &right);
                noticed += usize::from(outcome.error.is_some() || outcome.mismatches > 0);
            }
        }
        assert!(noticed > list.len(), "{noticed} of {}", 2 * list.len());
    }
}

#[test]
fn every_flipped_bit_behind_a_right_checksum_never_shows_a_wrong_mirror() {
    for sample in [made(MADE_SMALL), SERVED_RESIDUAL.clone()] {
        let mut client = Client::new(config(sample.room));
        let right = hashes(&sample);
        let (mut errors, mut withheld, mut shown) = (0, 0, 0);
        for place in packets(&sample.bytes) {
            for bit in 8 * place.start..8 * place.end {
                let mut bytes = sample.bytes.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                mend(&mut bytes);
                let outcome = agreed_with(&mut client, &bytes, &sample, &right);
                errors += usize::from(outcome.error.is_some());
                withheld += usize::from(outcome.mismatches > 0);
                shown += outcome.shown.len();
            }
        }
        assert!(
            errors > 1000 && withheld > 100,
            "{errors}, {withheld}, {shown}"
        );
    }
}

/// [`agreed`], and what is shown are mirrors of the sample, though perhaps of other frames. (That a
/// mirror has the hash that it is shown with is checked in [`read`].)
fn agreed_with(client: &mut Client, bytes: &[u8], sample: &Sample, right: &[u64]) -> Outcome {
    let outcome = agreed(client, bytes, sample.room);
    for (id, _, hash) in &outcome.shown {
        assert!(right.contains(hash), "frame {id} is wrong");
    }
    outcome
}

/// The hashes of a sample's mirrors.
fn hashes(sample: &Sample) -> Vec<u64> {
    let shown = agreed_on(sample).shown;
    shown.into_iter().map(|shown| shown.2).collect()
}

#[test]
fn thirty_thousand_damaged_streams_of_slices_end_as_both_readers_agree() {
    let sample = made(MADE_SMALL);
    let most = most_bytes(sample.room);
    let run = |seed: u64| {
        let mut random = Random(seed);
        let mut client = Client::new(config(sample.room));
        let (mut errors, mut shown, mut withheld) = (0, 0, 0);
        for _ in 0..15_000 {
            let mut bytes = sample.bytes.clone();
            for _ in 0..1 + random.below(3) {
                if !bytes.is_empty() {
                    damage(&mut bytes, &mut random);
                }
            }
            mend(&mut bytes);
            let outcome = agreed(&mut client, &bytes, sample.room);
            errors += usize::from(outcome.error.is_some());
            withheld += outcome.mismatches;
            shown += outcome.shown.len();
            assert!(client.memory_bytes() <= most);
        }
        assert!(
            errors > 3000 && shown > 3000 && withheld > 100,
            "the damage is meant to be of all kinds: {errors}, {shown}, {withheld}"
        );
    };
    std::thread::scope(|scope| {
        for seed in [11, 12] {
            let run = &run;
            scope.spawn(move || run(seed));
        }
    });
}

#[test]
fn damaged_items_end_as_both_readers_agree() {
    // The hash is made right for what comes out, so that nothing but the items decides.
    let header = slices_header();
    let mut coded = Coded::new(&header);
    stream::apply_changes(&slices_content(), &mut coded.mirror).unwrap();
    let mut part = |open: bool, base: u8| {
        let all = [(0, [0, 1, 3]), (2, [0, 4, 1])].map(|(index, opens)| {
            let opens = open.then_some(opens);
            let target = |at: usize| base.wrapping_add((at * 13) as u8);
            (index, opens, coded.code(index, opens, 3, &target))
        });
        items(&all)
    };
    let parts = [part(true, 100), part(false, 90), part(false, 160)];
    let mut random = Random(6);
    let mut shown = 0;
    for _ in 0..30_000 {
        let mut parts = parts.clone();
        let which = random.below(3);
        damage(&mut parts[which], &mut random);
        shown += usize::from(slices_outcome(&header, &parts).error.is_none());
    }
    assert!((300..29_000).contains(&shown), "{shown} shown");
}

// ---------------------------------------------------------------- memory

/// What a client may hold at most: its mirror, what it keeps of slices, one packet and one content,
/// and zstd's own state.
fn most_bytes(room: Capacity) -> u64 {
    let packet = PACKET_HEADER_BYTES as u64 + u64::from(MAX_BODY_BYTES);
    room.bytes() + u64::from(room.cells) * 65 + packet + u64::from(MAX_RAW_BYTES) + (256 << 10)
}

#[test]
fn no_length_field_takes_memory_beyond_what_the_client_allowed() {
    // [1.5, 2.4, 4.3, 4.5]
    let room = Hand::ROOM;
    let push = |bytes: &[u8]| {
        let mut client = Client::new(config(room));
        let result = client.push(bytes).map(|_| ());
        (client.memory_bytes(), result)
    };
    for (field, value) in [
        (16, u32::MAX),
        (20, u32::MAX),
        (24, u32::MAX),
        (24, 1 << 28),
    ] {
        let mut bytes = Hand::new().bytes;
        let at = PREAMBLE.len() + PACKET_HEADER_BYTES + field;
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        mend(&mut bytes);
        let (memory, result) = push(&bytes);
        assert!(
            matches!(result, Err(ClientError::Capacity(_))),
            "{result:?}"
        );
        assert!(memory < 256 << 10, "{memory} bytes");
    }
    // More slices and points than cells can hold, which nobody has room for [4.1].
    for (slices, points) in [(10, 0), (u32::MAX, 0), (0, 64), (0, u32::MAX)] {
        let header = Header {
            slices,
            points,
            ..slices_header()
        };
        let (memory, result) = push(&Hand::with(&header).bytes);
        assert_eq!(result, Err(StreamError::Value.into()));
        assert!(memory < 256 << 10, "{memory} bytes");
    }
    // The largest limits that a header may ask for.
    let header = Header {
        profile: Profile::Residual,
        step: 255,
        slices: 9,
        points: 63,
        max_body_bytes: MAX_BODY_BYTES,
        max_raw_bytes: MAX_RAW_BYTES,
        ..Hand::header()
    };
    let hand = Hand::with(&header);
    let (memory, result) = push(&hand.bytes);
    assert!(
        result.is_ok() && memory <= most_bytes(room),
        "{memory} bytes"
    );
    for (before, size) in [
        (Hand::bare(), 4097),
        (Hand::bare(), u32::MAX),
        (Hand::new(), 4097),
        (hand.clone(), MAX_BODY_BYTES + 1),
        (hand.clone(), u32::MAX),
    ] {
        let mut bytes = before.bytes;
        bytes.extend([kind::FRAME, 0, 0, 0]);
        bytes.extend(size.to_le_bytes());
        bytes.extend([0; 8]);
        let (memory, result) = push(&bytes);
        assert_eq!(result, Err(StreamError::PacketTooLarge(size).into()));
        assert!(memory <= most_bytes(room), "{memory} bytes");
    }
    for counts in [
        [u32::MAX; 3],
        [1 << 30, 0, 0],
        [0, 1 << 30, 0],
        [0, 0, 1 << 30],
    ] {
        let raw: Vec<u8> = counts.iter().flat_map(|c| c.to_le_bytes()).collect();
        let mut hand = hand.clone();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, 0, &raw);
        let (memory, result) = push(&hand.bytes);
        assert_eq!(result, Err(StreamError::Length.into()));
        assert!(memory <= most_bytes(room), "{memory} bytes");
    }
    let mut hand = hand;
    hand.compressed(
        flag::SNAPSHOT | flag::LAST,
        1,
        0,
        MAX_RAW_BYTES + 1,
        &[0; 9],
    );
    assert_eq!(push(&hand.bytes).1, Err(StreamError::Value.into()));
}

#[test]
fn a_zstd_bomb_takes_no_more_memory_than_the_header_says() {
    let bomb = zstd(&vec![0; 1 << 28]);
    assert!(bomb.len() < 64 << 10, "{} bytes", bomb.len());
    let header = Header {
        max_body_bytes: MAX_BODY_BYTES,
        max_raw_bytes: MAX_RAW_BYTES,
        ..Hand::header()
    };
    for raw_bytes in [1, 4096, MAX_RAW_BYTES] {
        let mut hand = Hand::with(&header);
        hand.compressed(flag::SNAPSHOT | flag::LAST, 1, 0, raw_bytes, &bomb);
        let mut client = Client::new(config(Hand::ROOM));
        assert_eq!(client.push(&hand.bytes), Err(ClientError::Compression));
        assert!(client.memory_bytes() <= most_bytes(Hand::ROOM));
    }
    // Within the limit it is only wrong: 2²² zero bytes are a content of no elements and more.
    let mut hand = Hand::with(&header);
    hand.frame(
        flag::SNAPSHOT | flag::LAST,
        1,
        0,
        &vec![0; MAX_RAW_BYTES as usize],
    );
    let mut client = Client::new(config(Hand::ROOM));
    assert_eq!(client.push(&hand.bytes), Err(StreamError::Length.into()));
    assert!(client.memory_bytes() <= most_bytes(Hand::ROOM));
}

// ---------------------------------------------------------------- recovery

#[test]
fn a_mirror_that_went_wrong_is_withheld_until_a_snapshot() {
    // [5.6, 5.7]
    let sample = &*SERVED;
    let mut bytes = sample.bytes.clone();
    // Packets: header, frames 1 to 6 (5 is a snapshot), end. Frame 2's hash becomes another.
    let places = packets(&bytes);
    assert_eq!(places.len(), 8);
    bytes[places[2].start + PACKET_HEADER_BYTES + 12] ^= 1;
    mend(&mut bytes);
    let mut client = Client::new(config(sample.room));
    let mut seen = Vec::new();
    let mut rest = &bytes[..];
    for place in &places[..5] {
        // Packet by packet, to look at the state after each.
        let (now, later) = rest.split_at(place.end - (bytes.len() - rest.len()));
        let frame = client.push(now).unwrap().frame.map(|frame| frame.id);
        seen.push((frame, client.state()));
        rest = later;
    }
    use State::{Desynchronised, Live};
    let lost = (None, Desynchronised);
    assert_eq!(seen, [lost, (Some(1), Live), lost, lost, lost]);
    assert_eq!(client.stats().mismatches, 1);
    let pushed = client.push(rest).unwrap();
    assert_eq!(pushed.frame.unwrap().id, 5);
    assert_eq!(contents(client.mirror()), sample.mirrors[&5]);
    assert_eq!(client.stats().snapshots, 2);

    let outcome = agreed(&mut client, &bytes, sample.room);
    let ids: Vec<u32> = outcome.shown.iter().map(|shown| shown.0).collect();
    assert_eq!((ids, outcome.mismatches), (vec![1, 5, 6], 1));
}

#[test]
fn a_snapshot_with_the_wrong_hash_is_no_snapshot() {
    let sample = by_hand();
    let mut bytes = sample.bytes.clone();
    let last_part = packets(&bytes)[5].start;
    bytes[last_part + PACKET_HEADER_BYTES + 15] ^= 4;
    mend(&mut bytes);
    let mut client = Client::new(config(sample.room));
    let outcome = agreed(&mut client, &bytes, sample.room);
    assert_eq!((outcome.shown.len(), outcome.mismatches), (0, 1));
}

#[test]
fn a_new_connection_keeps_the_old_picture_until_its_snapshot() {
    // [5.8]
    let sample = &*SERVED;
    let mut client = Client::new(config(sample.room));
    let places = packets(&sample.bytes);
    let mut rest = &sample.bytes[..places[6].end];
    while !rest.is_empty() {
        rest = &rest[client.push(rest).unwrap().consumed..];
    }
    let old = contents(client.mirror());
    assert_eq!(
        client.push(&[0xff; 40]),
        Err(StreamError::PacketTooLarge(u32::MAX).into())
    );
    client.restart();
    assert_eq!(client.state(), State::Connecting);
    assert_eq!(contents(client.mirror()), old);
    client.clear_dirty();
    client.push(&sample.bytes[..places[0].end]).unwrap();
    assert_eq!(client.state(), State::Desynchronised);
    // A frame that is no snapshot does not touch it: here the second before the first.
    let mut bytes = sample.bytes[places[2].clone()].to_vec();
    bytes[8..12].copy_from_slice(&1u32.to_le_bytes());
    let mut whole = [&PREAMBLE[..], &bytes].concat();
    mend(&mut whole);
    assert_eq!(client.push(&whole[8..]).unwrap().frame, None);
    assert_eq!(contents(client.mirror()), old);
    let buffers = [
        psao::core::mirror::Buffer::Instances,
        psao::core::mirror::Buffer::Buckets,
        psao::core::mirror::Buffer::Cells,
    ];
    for buffer in buffers {
        assert_eq!(client.mirror().next_dirty(buffer, 0), None);
    }
    let outcome = agreed(&mut client, &sample.bytes, sample.room);
    assert_eq!(outcome.shown.len(), 6);
}

// ---------------------------------------------------------------- random damage

/// Damages a stream in one of the ways that bytes go wrong.
fn damage(bytes: &mut Vec<u8>, random: &mut Random) {
    let at = random.below(bytes.len());
    match random.below(7) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][random.below(5)],
        2 => drop(bytes.remove(at)),
        3 => bytes.insert(at, random.below(256) as u8),
        4 => bytes.truncate(at),
        5 => {
            let length = random.below(64).min(bytes.len() - at);
            let to = random.below(bytes.len() - length + 1);
            bytes.copy_within(at..at + length, to);
        }
        _ => {
            let word = [0u32, 1, 0x7fff_ffff, 0x8000_0000, u32::MAX][random.below(5)];
            let length = (bytes.len() - at).min(4);
            bytes[at..at + length].copy_from_slice(&word.to_le_bytes()[..length]);
        }
    }
}

#[test]
fn a_hundred_thousand_damaged_streams_end_as_both_readers_agree() {
    // Half have their checksums mended, so that the damage gets past them.
    let sample = by_hand();
    let run = |seed: u64| {
        let mut random = Random(seed);
        let mut client = Client::new(config(sample.room));
        let (mut errors, mut shown, mut withheld) = (0, 0, 0);
        for round in 0..50_000 {
            let mut bytes = sample.bytes.clone();
            for _ in 0..1 + random.below(3) {
                if !bytes.is_empty() {
                    damage(&mut bytes, &mut random);
                }
            }
            if round % 2 == 0 {
                mend(&mut bytes);
            }
            let outcome = agreed(&mut client, &bytes, sample.room);
            errors += usize::from(outcome.error.is_some());
            withheld += outcome.mismatches;
            shown += outcome.shown.len();
            assert!(client.memory_bytes() <= most_bytes(sample.room));
        }
        assert!(
            errors > 10_000 && shown > 10_000 && withheld > 100,
            "the damage is meant to be of all kinds: {errors}, {shown}, {withheld}"
        );
    };
    std::thread::scope(|scope| {
        for seed in [1, 2] {
            scope.spawn(move || run(seed));
        }
    });
}

#[test]
fn damaged_contents_end_as_both_readers_agree() {
    // The content is damaged before it is compressed, and the hash is often made right.
    let raw = content(
        &[(0, grid()), (1, grid())],
        &[
            (0, bucket(&[1, 2, 3])),
            (3, bucket(&[8])),
            (7, bucket(&[4])),
        ],
        &[(1, cell(5)), (2, cell(6)), (3, cell(7)), (8, cell(9))],
    );
    let mut random = Random(3);
    let mut client = Client::new(config(Hand::ROOM));
    let mut shown = 0;
    for _ in 0..30_000 {
        let mut damaged = raw.clone();
        damage(&mut damaged, &mut random);
        let mut mirror = psao::core::Mirror::new(psao::memory::Heap::new(Hand::ROOM));
        let applied = stream::apply_changes(&damaged, &mut mirror);
        let hash = applied.map_or(0, |_| mirror.hash());
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, hash, &damaged);
        let outcome = agreed(&mut client, &hand.bytes, Hand::ROOM);
        assert_eq!(outcome.shown.len(), usize::from(outcome.error.is_none()));
        shown += outcome.shown.len();
        // Whatever is shown can be looked up.
        let lookup = client.mirror().lookup();
        for instance in 0..3 {
            let position = [0.1, 0.12, 0.07].map(|v| v * random.below(4) as f32);
            for kernel in [psao::core::Kernel::Paper, psao::core::Kernel::Planar] {
                let answer = lookup.blend(kernel, instance, position, [0.0, 1.0, 0.0]);
                assert!((0.0..=1.0).contains(&answer.openness));
            }
        }
    }
    assert!(shown > 1000, "{shown} shown");
}

// ---------------------------------------------------------------- uplink

/// One of each message, as a packet.
fn uplink_packets() -> Vec<Vec<u8>> {
    let hello = Hello {
        token: b"open sesame",
        scene_hash: 0x0123_4567_89ab_cdef,
        capacity: Hand::ROOM,
    };
    let camera = Camera {
        position_m: [1e6, -2.5, 3.25],
        forward: [0.0, 0.0, -1.0],
        up: [0.0, 1.0, 0.0],
        fov_y_rad: 1.2,
        aspect: 16.0 / 9.0,
    };
    let rows = [
        [1.0, 0.0, 0.0, 10.5],
        [0.0, 2.0, 0.0, -7.25],
        [0.0, 0.0, 3.0, 1e7],
    ];
    let transform = Transform {
        instance: 3,
        world_from_local: rows,
    };
    let joints = [rows.map(|row| row.map(|v| v as f32)); 3];
    let packet = |kind, body: &dyn Fn(&mut Writer<'_>) -> Result<(), StreamError>| {
        let mut bytes = vec![0; 1000];
        let length = write_packet(&mut bytes, kind, 0, 5, body).unwrap();
        bytes.truncate(length);
        bytes
    };
    vec![
        packet(uplink::kind::HELLO, &|w| hello.write(w)),
        packet(uplink::kind::CAMERA, &|w| camera.write(w)),
        packet(uplink::kind::TRANSFORM, &|w| transform.write(w)),
        packet(uplink::kind::JOINTS, &|w| {
            uplink::write_joints(w, 3, &joints)
        }),
        packet(uplink::kind::ACK, &|w| w.u32(77)),
        packet(uplink::kind::RESYNC, &|_| Ok(())),
    ]
}

/// Reads an uplink packet; `None` where it is not whole, or may be skipped.
fn read_uplink(bytes: &[u8]) -> Result<Option<Message<'_>>, StreamError> {
    match Packet::read(bytes, MAX_UPLINK_BODY_BYTES)? {
        Some((packet, _)) => Message::read(&packet),
        None => Ok(None),
    }
}

/// Writes what was read.
fn rewrite(message: &Message<'_>) -> Vec<u8> {
    let mut bytes = vec![0; 1000];
    let length = match message {
        Message::Hello(m) => write_packet(&mut bytes, uplink::kind::HELLO, 0, 5, |w| m.write(w)),
        Message::Camera(m) => write_packet(&mut bytes, uplink::kind::CAMERA, 0, 5, |w| m.write(w)),
        Message::Transform(m) => {
            write_packet(&mut bytes, uplink::kind::TRANSFORM, 0, 5, |w| m.write(w))
        }
        Message::Joints(m) => {
            let matrices: Vec<_> = m.matrices().collect();
            assert_eq!(matrices.len(), m.count());
            write_packet(&mut bytes, uplink::kind::JOINTS, 0, 5, |w| {
                uplink::write_joints(w, m.instance, &matrices)
            })
        }
        Message::Ack(id) => write_packet(&mut bytes, uplink::kind::ACK, 0, 5, |w| w.u32(*id)),
        Message::Resync => write_packet(&mut bytes, uplink::kind::RESYNC, 0, 5, |_| Ok(())),
    };
    bytes.truncate(length.unwrap());
    bytes
}

#[test]
fn every_uplink_message_reads_back_as_it_was_written() {
    for bytes in uplink_packets() {
        let message = read_uplink(&bytes).unwrap().unwrap();
        assert_eq!(rewrite(&message), bytes, "{message:?}");
        for length in 0..bytes.len() {
            let prefix: Box<[u8]> = bytes[..length].into();
            assert_eq!(
                read_uplink(&prefix),
                Ok(None),
                "{length} bytes of {message:?}"
            );
        }
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            // A length that became larger waits for more.
            assert!(
                matches!(read_uplink(&flipped), Err(_) | Ok(None)),
                "bit {bit} of {message:?}"
            );
        }
    }
}

/// A packet with another body.
fn with_body(bytes: &[u8], body: &[u8]) -> Vec<u8> {
    let mut out = vec![0; PACKET_HEADER_BYTES + body.len()];
    write_packet(&mut out, bytes[0], bytes[1], 5, |w| w.bytes(body)).unwrap();
    out
}

#[test]
fn uplink_bodies_of_the_wrong_length_or_with_reserved_flags_are_refused() {
    // [10.2, 2.6]
    for bytes in uplink_packets() {
        let body = &bytes[PACKET_HEADER_BYTES..];
        let is_hello = bytes[0] == uplink::kind::HELLO;
        let longer = with_body(&bytes, &[body, &[0]].concat());
        // A hello may have fields of a newer minor version.
        assert_eq!(read_uplink(&longer).is_ok(), is_hello);
        for length in 0..body.len() {
            let shorter = with_body(&bytes, &body[..length]);
            assert_eq!(read_uplink(&shorter), Err(StreamError::Length));
        }
        for flag in 0..8 {
            let mut flagged = bytes.clone();
            flagged[1] = 1 << flag;
            let flagged = with_body(&flagged, body);
            assert_eq!(read_uplink(&flagged), Err(StreamError::Value));
        }
    }
    let unknown = |flags| with_body(&[70, flags], b"later");
    assert_eq!(read_uplink(&unknown(0)), Err(StreamError::Kind(70)));
    assert_eq!(read_uplink(&unknown(flag::OPTIONAL)), Ok(None));
}

#[test]
fn numbers_that_are_none_do_not_get_through_the_uplink() {
    let packets = uplink_packets();
    let mut refused = 0;
    for (packet, first, size) in [(1, 0, 8), (1, 24, 4), (2, 4, 8), (3, 8, 4)] {
        let body = &packets[packet][PACKET_HEADER_BYTES..];
        let end = if (packet, size) == (1, 8) {
            24
        } else {
            body.len()
        };
        for at in (first..end).step_by(size) {
            for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut body = body.to_vec();
                if size == 8 {
                    body[at..at + 8].copy_from_slice(&value.to_le_bytes());
                } else {
                    body[at..at + 4].copy_from_slice(&(value as f32).to_le_bytes());
                }
                let bytes = with_body(&packets[packet], &body);
                assert_eq!(
                    read_uplink(&bytes),
                    Err(StreamError::Value),
                    "{packet} at {at}"
                );
                refused += 1;
            }
        }
    }
    assert_eq!(refused, 3 * (3 + 8 + 12 + 36));
    let camera = |change: &dyn Fn(&mut Camera)| {
        let mut camera = match read_uplink(&packets[1]).unwrap().unwrap() {
            Message::Camera(camera) => camera,
            other => panic!("{other:?}"),
        };
        change(&mut camera);
        read_uplink(&rewrite(&Message::Camera(camera))).is_ok()
    };
    assert!(camera(&|_| ()));
    assert!(!camera(&|c| c.forward = [0.0; 3]));
    assert!(!camera(&|c| c.up = [1e-7, 0.0, 0.0]));
    assert!(!camera(&|c| c.up = [f32::MAX; 3]));
    assert!(!camera(&|c| c.fov_y_rad = 0.0));
    assert!(!camera(&|c| c.fov_y_rad = 3.2));
    assert!(!camera(&|c| c.aspect = 0.0));
    assert!(!camera(&|c| c.aspect = -1.0));
    assert!(!camera(&|c| c.aspect = 1e4));
    // More joints than there may be, and a token that is too long.
    let mut joints = packets[3][PACKET_HEADER_BYTES..].to_vec();
    joints[4..8].copy_from_slice(&(uplink::MAX_JOINTS + 1).to_le_bytes());
    let bytes = with_body(&packets[3], &joints);
    assert_eq!(read_uplink(&bytes), Err(StreamError::Value));
    let mut hello = packets[0][PACKET_HEADER_BYTES..].to_vec();
    hello[24..26].copy_from_slice(&257u16.to_le_bytes());
    hello.extend([0; 300]);
    let bytes = with_body(&packets[0], &hello);
    assert_eq!(read_uplink(&bytes), Err(StreamError::Value));
}

#[test]
fn a_hundred_thousand_damaged_messages_are_read_or_refused() {
    let packets = uplink_packets();
    let mut random = Random(4);
    let (mut read, mut refused) = (0, 0);
    for round in 0..100_000 {
        let mut bytes = packets[random.below(packets.len())].clone();
        if round % 10 == 0 {
            bytes = (0..random.below(300))
                .map(|_| random.below(256) as u8)
                .collect();
        }
        for _ in 0..random.below(3) {
            if !bytes.is_empty() {
                damage(&mut bytes, &mut random);
            }
        }
        let mut whole = [&PREAMBLE[..], &bytes].concat();
        if round % 3 != 0 {
            mend(&mut whole);
        }
        match read_uplink(&whole[PREAMBLE.len()..]) {
            Ok(Some(message)) => {
                read += 1;
                // What is read is in range: it can be written, and reads the same.
                let again = rewrite(&message);
                assert_eq!(read_uplink(&again), Ok(Some(message)));
            }
            Ok(None) => {}
            Err(_) => refused += 1,
        }
    }
    assert!(
        read > 10_000 && refused > 10_000,
        "{read} read, {refused} refused"
    );
}

#[test]
fn a_world_driven_to_absurd_places_goes_on() {
    // All of these are finite, and so get through the uplink.
    let mut world = world(24.0, CELLS);
    let mut encoder = Encoder::new(&world, CELLS);
    let mut bytes = encoder.header(&world, 0, 30.0);
    let mut client = Client::new(config(capacity_of(&world.truth)));
    let far = DAffine3::from_translation(glam::DVec3::splat(1e300));
    let flat = DAffine3::from_scale(glam::DVec3::ZERO);
    let huge = DAffine3::from_scale(glam::DVec3::splat(f64::MAX));
    let mirrored = DAffine3::from_scale(glam::DVec3::new(-1.0, 1e-30, 1e30));
    for (frame, matrix) in [far, flat, huge, mirrored, DAffine3::IDENTITY]
        .into_iter()
        .enumerate()
    {
        for instance in 0..3 {
            world.drive(instance, matrix).unwrap();
        }
        world.step(frame as f64 * 0.1, &|_| true, u64::MAX);
        encoder.merge(&world.truth);
        world.truth.clear_changes();
        encoder.frame(&world, frame as u64, &|_| true, true, &mut bytes);
    }
    assert!(world.drive(3, far).is_err());
    let outcome = read(&mut client, &bytes, usize::MAX, |_, _| ());
    assert_eq!((outcome.shown.len(), outcome.error), (5, None));
}
