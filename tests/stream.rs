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
use psao::core::slices::{
    FIRST, ITEM_HEADER_BYTES, Item, Operation, apply_instances, apply_patches, apply_slices,
};
use psao::core::stream::{
    self, FRAME_HEADER_BYTES, Frame, Header, MAX_BODY_BYTES, MAX_RAW_BYTES, PACKET_HEADER_BYTES,
    PREAMBLE, Packet, Profile, Refusal, StreamError, Writer, flag, kind, write_packet,
};
use psao::core::topology::{MAX_PATCH_BYTES, Order, PATCH_POINTS, PatchPoint};
use psao::core::topology::{decode_patch, encode_patch};
use psao::core::uplink::{self, Camera, Hello, MAX_UPLINK_BODY_BYTES, Message, Transform};
use psao::{Client, ClientError, Config, State};
use psao_server::encode::{
    Compression, Encoder, Eye, FrameStats, Limits, Scheme, View, capacity_of, refusal,
};
use psao_server::scene::{
    Animation, Channel, Interpolation, Keys, LocalTransform, Mesh, Morph, Node, Scene,
};
use psao_server::world::{Options, World};
use std::collections::{BTreeMap, HashMap};
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
        rest_space: matches!(scheme, Scheme::Residual(..)),
        ..Options::of(psao::core::Kernel::Planar)
    };
    World::new(scene(), options, &|_, _, _| ()).unwrap()
}

/// What a server sends of [`scene`]: `frames` frames, a snapshot again at the fifth, and an end.
/// In profile `residual` the view turns: boxes left of a line that moves to the right are seen.
fn serve(density: f64, scheme: Scheme, frames: u32) -> Sample {
    let mut world = world(density, scheme);
    let mut encoder = Encoder::new(&world, scheme, 0);
    let mut bytes = encoder.header(&world, world.scene.hash(), 30.0);
    let mut mirrors = HashMap::new();
    let mut opened = Vec::new();
    for frame in 0..frames {
        let time_s = f64::from(frame) * 0.09;
        world.step(time_s, &|_| true, u64::MAX);
        encoder.merge(&world);
        world.clear_changes();
        if frame == 4 {
            encoder.resync();
        }
        let line = -0.25 + 0.12 * frame as f32;
        let sees = |bounds: [Vec3; 2]| scheme == CELLS || bounds[0].midpoint(bounds[1]).x < line;
        let view = View {
            sees: &sees,
            eye: None,
        };
        let sent = encoder.frame(&world, (time_s * 1e9) as u64, &view, true, &mut bytes);
        let changed = sent.cells + sent.slices;
        assert!(changed > 0, "frame {frame} is meant to change something");
        opened.push(sent.opened);
        mirrors.insert(encoder.frame_id(), contents(encoder.mirror()));
    }
    encoder.end(&mut bytes);
    if scheme != CELLS {
        let some = opened.iter().filter(|opened| **opened > 0).count();
        assert!(some > 2, "slices are meant to open over time: {opened:?}");
        assert!(opened.contains(&0) || frames < 8, "{opened:?}");
    }
    Sample {
        bytes,
        room: capacity_of(&world),
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

const QUANTISER: Quantiser = Quantiser {
    step: 3,
    dead_zone: 2,
};
const NO_LIMITS: Limits = Limits {
    max_mbit: 0.0,
    points_per_pixel: 0.0,
    points: 0,
    cells: 0,
};
const RESIDUAL: Scheme = Scheme::Residual(QUANTISER, NO_LIMITS);
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
        slices: 0,
        points: 0,
        patches: 0,
        topology_bytes: 0,
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
    step: u8,
}

/// An item: its slice, what it does, how many points the slice has, and the data.
type Made = (u32, Operation, u32, Vec<u8>);

impl Coded {
    fn new(header: &Header) -> Coded {
        Coded {
            mirror: psao::core::Mirror::new(psao::memory::Heap::new(header.capacity)),
            slices: psao::memory::SliceHeap::new(header.capacity),
            step: header.step,
        }
    }

    fn reset(&mut self) {
        let cells = self.mirror.capacity().cells;
        self.mirror.reset();
        self.slices.slices().reset(cells);
    }

    /// A patches packet's body.
    fn patches(&mut self, patches: &[(u32, Vec<u8>)]) -> Vec<u8> {
        let body = patches_body(patches);
        apply_patches(&body, &mut self.slices.slices()).unwrap();
        body
    }

    /// A frame packet's content.
    fn instances(&mut self, instances: &[(u32, Instance)]) -> Vec<u8> {
        let raw = content(instances, &[], &[]);
        apply_instances(&raw, &mut self.mirror, &self.slices.slices()).unwrap();
        raw
    }

    /// The item that brings a slice to `target`: of a number of its points.
    fn code(&mut self, index: u32, operation: Operation, target: &dyn Fn(usize) -> u8) -> Made {
        let mut slices = self.slices.slices();
        let mut quantiser = Quantiser {
            step: self.step,
            dead_zone: self.step / 2,
        };
        let mut opens = false;
        match operation {
            Operation::Open(at, _) => {
                slices.open(&self.mirror, index, at, None).unwrap();
                quantiser = FIRST;
                opens = true;
            }
            Operation::Close => {
                slices.close(&mut self.mirror, index).unwrap();
                return (index, operation, 0, Vec::new());
            }
            _ => slices.prepare(&self.mirror, index, None).unwrap(),
        }
        let slice = slices.get(index).unwrap();
        let shown = match operation {
            Operation::Open(_, shown) | Operation::Show(shown) => shown,
            _ => slice.shown,
        };
        let (neighbours, mut state) = slices.side(&slice).unwrap();
        let target: Vec<u8> = (0..slice.point_count as usize).map(target).collect();
        let mut data = vec![0; MAX_SLICE_BYTES];
        let length = encode_slice(neighbours, quantiser, &mut state, &target, opens, &mut data);
        data.truncate(length.unwrap());
        slices.settle(&mut self.mirror, index, shown).unwrap();
        (index, operation, slice.point_count, data)
    }
}

/// How many points of blocks that are shown are in no cell.
fn left_out(heap: &psao::memory::SliceHeap) -> usize {
    let mut heap = heap.clone();
    let slices = heap.slices();
    let mut count = 0;
    for slice in slices.slices.iter() {
        for at in 0..slice.point_count {
            let place = slices.places[(slice.point_first + at) as usize];
            let shown = slice.shown >> (at / 16) & 1 == 1;
            count += usize::from(shown && place == psao::core::bins::NOWHERE);
        }
    }
    count
}

/// Items as a packet holds them.
fn items(items: &[Made]) -> Vec<u8> {
    let mut out = vec![
        0;
        items
            .iter()
            .map(|item| item.3.len() + ITEM_HEADER_BYTES)
            .sum()
    ];
    let mut w = Writer::new(&mut out);
    let mut next = 0;
    for (index, operation, points, bytes) in items {
        let item = Item {
            index: *index,
            operation: *operation,
            points: *points,
            bytes,
        };
        item.write(next, &mut w).unwrap();
        next = index + 1;
    }
    let length = w.length();
    out.truncate(length);
    out
}

fn varint(value: u32) -> Vec<u8> {
    let mut bytes = [0; 5];
    let mut w = Writer::new(&mut bytes);
    w.varint(value).unwrap();
    let length = w.length();
    bytes[..length].to_vec()
}

fn patches_body(patches: &[(u32, Vec<u8>)]) -> Vec<u8> {
    let mut body = Vec::new();
    let mut next = 0;
    for (index, data) in patches {
        body.extend(varint(index - next));
        body.extend(varint(data.len() as u32));
        body.extend(data);
        next = index.wrapping_add(1);
    }
    body
}

/// The points in their order, coded.
fn patch_of(points: &[PatchPoint]) -> Vec<u8> {
    let mut points = points.to_vec();
    let order = Order::of(&points);
    points.sort_by_key(|point| order.key(point));
    let mut bytes = vec![0; MAX_PATCH_BYTES];
    let length = encode_patch(&points, &mut bytes).unwrap();
    bytes.truncate(length);
    bytes
}

fn point(position: [u32; 3], level: u8) -> PatchPoint {
    PatchPoint {
        position,
        normal: encode_normal([0.0, 0.0, 1.0]),
        level,
        ..PatchPoint::default()
    }
}

/// What to make: points a patch, patches (each on two instances), frames.
#[derive(Clone, Copy)]
struct What {
    points: u32,
    patches: u32,
    frames: u32,
}

const MADE_SMALL: What = What {
    points: 40,
    patches: 2,
    frames: 8,
};
const MADE_LARGE: What = What {
    points: 1024,
    patches: 3,
    frames: 30,
};

fn made_header(what: What) -> Header {
    let all = what.points * what.patches;
    Header {
        profile: Profile::Residual,
        step: 3,
        capacity: Capacity {
            instances: 2,
            buckets: 2 * made_buckets(what),
            // Too few in the end, as are the buckets.
            cells: 1 + all / 5,
            slices: 2 * what.patches,
            points: 2 * all,
            patches: what.patches,
            topology_bytes: 8 * all,
        },
        max_body_bytes: 1 << 16,
        max_raw_bytes: 1 << 16,
        topology_hash: 0x70b0,
        ..Hand::header()
    }
}

fn made_buckets(what: What) -> u32 {
    what.points * what.patches / 25 + 1
}

/// A rough surface, some of whose points lie outside the grid.
fn made_patch(what: What, index: u32) -> Vec<u8> {
    let mut random = Random(index.into());
    let extent = 16 * what.points.isqrt() as usize;
    let points: Vec<PatchPoint> = (0..what.points)
        .map(|at| {
            let mut along = |extent: usize| random.below(extent) as u32;
            let (x, y, rough) = (along(extent) + 40 * index, along(extent), along(5));
            let normals = [0x77, 0x77, 0xe7, (along(15) << 4 | along(15)) as u8];
            PatchPoint {
                position: [
                    x + if at % 29 == 7 { 700 } else { 0 },
                    y,
                    40 + x / 9 + rough,
                ],
                normal: normals[along(4) as usize],
                level: (at.trailing_zeros() as u8).min(3),
                ..PatchPoint::default()
            }
        })
        .collect();
    patch_of(&points)
}

/// A shadow wanders over slices that open, close and open again; after half of the frames one
/// instance changes its level, after two thirds is a snapshot. In some frames some slices stay as
/// they are, and the blocks in cells change.
fn made(what: What) -> Sample {
    let header = made_header(what);
    let buckets = made_buckets(what);
    let mut hand = Hand::with(&header);
    let mut coded = Coded::new(&header);
    let mut mirrors = HashMap::new();
    let mut random = Random(9);
    let mut left_out_points = 0;
    let grid = |instance: u32, level| Instance {
        dims: [20, 20, 9],
        bucket_first: instance * buckets,
        bucket_count: buckets,
        level,
        ..grid()
    };
    let slices = 2 * what.patches;
    let mut come = 0;
    let mut open = vec![false; slices as usize];
    for frame in 0..what.frames {
        let snapshot = frame == 0 || frame == what.frames * 2 / 3;
        let switch = frame == what.frames / 2;
        let flags = if snapshot { flag::SNAPSHOT } else { 0 };
        if snapshot {
            coded.reset();
            open.fill(false);
        }
        // Two patches more a frame, between the frame's packets.
        let more: Vec<(u32, Vec<u8>)> = (come..what.patches.min(come + 2))
            .map(|index| (index, made_patch(what, index)))
            .collect();
        come += more.len() as u32;
        let body = coded.patches(&more);
        if !more.is_empty() && frame == 0 {
            hand.packet(kind::PATCHES, 0, &body);
        }
        if snapshot || switch {
            // One instance's slices close all, so that its grid can change.
            let closes: Vec<Made> = (what.patches..slices)
                .filter(|&index| std::mem::take(&mut open[index as usize]))
                .map(|index| coded.code(index, Operation::Close, &|_| 0))
                .collect();
            if !closes.is_empty() {
                hand.slices(0, frame + 1, 0, &items(&closes));
            }
            let level = 1 + u32::from(frame >= what.frames / 2);
            let changed = [(0, grid(0, 0)), (1, grid(1, level))];
            let raw = coded.instances(if snapshot { &changed } else { &changed[1..] });
            hand.frame(flags, frame + 1, 0, &raw);
        }
        if !more.is_empty() && frame > 0 {
            hand.packet(kind::PATCHES, 0, &body);
        }
        let noise = random.below(1000);
        let target = |at: usize| {
            let off = (at * 11).abs_diff(frame as usize * 60) as u8 as usize;
            let dark = 200usize.saturating_sub(off) + (at * 7 + noise) % 5;
            255 - if dark > 4 { dark as u8 } else { 0 }
        };
        let mut list = Vec::new();
        for index in 0..slices {
            let (patch, was) = (index % what.patches, open[index as usize]);
            let (instance, ask) = (index / what.patches, (index + frame) % 4);
            let points = coded.slices.get()[index as usize].point_count;
            let shown = random.below(usize::MAX) as u64 | random.below(usize::MAX) as u64;
            let operation = match (was, ask) {
                (false, _) if patch < come && ask != 1 => {
                    let has = made_count(what, patch, coded.mirror.instances()[instance as usize]);
                    Operation::Open([instance, patch, index * what.points], shown & blocks(has))
                }
                (false, _) | (true, 0) => continue,
                (true, 1) => Operation::Update,
                (true, 2) => Operation::Show(shown & blocks(points)),
                (true, _) if frame % 3 == 2 => Operation::Close,
                (true, _) => Operation::Update,
            };
            open[index as usize] = operation != Operation::Close;
            list.push(coded.code(index, operation, &target));
        }
        left_out_points += left_out(&coded.slices);
        // The last frame in two packets, the second without anything.
        let hash = coded.mirror.hash();
        if frame + 1 == what.frames {
            hand.slices(0, frame + 1, 0, &items(&list));
            hand.slices(flag::LAST, frame + 1, hash, &[]);
        } else {
            hand.slices(flag::LAST, frame + 1, hash, &items(&list));
        }
        mirrors.insert(frame + 1, contents(&coded.mirror));
    }
    assert!(
        left_out_points > 0,
        "cells are meant to be full, and points outside"
    );
    hand.packet(kind::END, 0, &[]);
    Sample {
        bytes: hand.bytes,
        room: header.capacity,
        mirrors,
    }
}

/// All blocks of so many points.
fn blocks(points: u32) -> u64 {
    ((1u128 << points.div_ceil(16)) - 1) as u64
}

/// How many points of a patch an instance has.
fn made_count(what: What, patch: u32, grid: Instance) -> u32 {
    let mut points = [PatchPoint::default(); PATCH_POINTS];
    let count = decode_patch(&made_patch(what, patch), &mut points).unwrap();
    let has = points[..count]
        .iter()
        .filter(|point| u32::from(point.level) >= grid.level);
    has.count() as u32
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
    /// The second reader's words for the error: the clause that is broken.
    clause: Option<String>,
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
        clause: None,
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

/// The two readers, and what they keep from one stream to the next.
struct Readers {
    client: Client,
    kept: second_reader::Kept,
    room: Capacity,
}

impl Readers {
    fn new(room: Capacity) -> Readers {
        Readers {
            client: Client::new(config(room)),
            kept: second_reader::Kept::default(),
            room,
        }
    }

    /// Reads a stream with both readers, which must agree, and returns what they say.
    fn agree(&mut self, bytes: &[u8]) -> Outcome {
        let room = second_reader::Room {
            lengths: [self.room.instances, self.room.buckets, self.room.cells],
            slices: self.room.slices,
            points: self.room.points,
            patches: self.room.patches,
            topology_bytes: self.room.topology_bytes,
        };
        let second = second_reader::read(bytes, room, &mut self.kept);
        let mut frames = second.shown.iter();
        let mut outcome = read(&mut self.client, bytes, usize::MAX, |client, frame| {
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
            assert_eq!(values(client.slices()), other.slices, "frame {}", frame.id);
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
        outcome.clause = second.error;
        outcome
    }
}

/// What each open slice's points say: the number of the first, and the occlusion of all.
fn values(slices: &psao::memory::SliceHeap) -> BTreeMap<u32, (u32, Vec<u8>)> {
    let open = (0..)
        .zip(slices.get())
        .filter(|(_, slice)| slice.point_count > 0);
    open.map(|(index, slice)| (index, (slice.point_first, slices.values(slice).to_vec())))
        .collect()
}

/// What two readers that have read nothing before agree on.
fn agreed(bytes: &[u8], room: Capacity) -> Outcome {
    Readers::new(room).agree(bytes)
}

/// [`agreed`] with a new client, checked against the sample's mirrors too.
fn agreed_on(sample: &Sample) -> Outcome {
    let outcome = agreed(&sample.bytes, sample.room);
    let mut client = Client::new(config(sample.room));
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
    assert!(
        client
            .header()
            .is_some_and(|header| header.capacity.slices > 5)
    );
    let outcome = agreed_on(&sample);
    assert_eq!((outcome.shown.len(), outcome.error), (6, None));
    for what in [MADE_SMALL, MADE_LARGE] {
        let outcome = agreed_on(&made(what));
        assert_eq!(outcome.shown.len() as u32, what.frames);
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
            let outcome = agreed(&prefix, sample.room);
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
        let mut longer = sample.bytes.clone();
        longer.push(0);
        let outcome = agreed(&longer, sample.room);
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
        let places = packets(&sample.bytes);
        let list: Vec<&[u8]> = places.iter().map(|p| &sample.bytes[p.clone()]).collect();
        let damaged = |change: &dyn Fn(&mut Vec<&[u8]>), stays: bool| {
            let mut list = list.clone();
            change(&mut list);
            let bytes = [&PREAMBLE[..], &list.concat()].concat();
            let outcome = agreed(&bytes, sample.room);
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
        agreed(&hand.bytes, sample.room)
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
    let error = |hand: &Hand| agreed(&hand.bytes, Hand::ROOM).error;
    for kind in [kind::FRAME, kind::SLICES, kind::PATCHES, kind::END, 99] {
        let mut hand = Hand::bare();
        hand.packet(kind, 0, &[0; 24]);
        assert_eq!(error(&hand), order, "kind {kind} before the header");
    }
    for kind in [kind::HEADER, kind::REFUSE, kind::SLICES, kind::PATCHES] {
        let mut hand = Hand::new();
        hand.packet(kind, 0, &[1; 60]);
        assert_eq!(error(&hand), order, "kind {kind} after the header");
    }
    for kind in [0, 7, 15, 64, 99, 255] {
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
        let outcome = agreed(bytes, Hand::ROOM);
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
            let outcome = agreed(&bytes, Hand::ROOM);
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
            let outcome = agreed(&bytes, Hand::ROOM);
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
        let mut readers = Readers::new(room);
        let outcome = readers.agree(&by_hand().bytes);
        assert_eq!(outcome.error, Some(ClientError::Capacity(Hand::ROOM)));
        assert_eq!(readers.client.mirror().capacity(), Capacity::default());
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
        let outcome = agreed(&refusal(reason), Hand::ROOM);
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
    let outcome = agreed(&hand.bytes, Hand::ROOM);
    assert_eq!(outcome.error, Some(StreamError::Length.into()));
}

#[test]
fn content_that_does_not_fit_the_mirror_is_refused() {
    // [6.2 to 6.4, 7.4]
    let error = |raw: &[u8]| {
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, 0, raw);
        agreed(&hand.bytes, Hand::ROOM).error
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
        |i| i.level = 4,
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
        let outcome = agreed(&hand.bytes, Hand::ROOM);
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

// ---------------------------------------------------------------- patches

#[test]
fn normals_and_neighbours_are_those_of_the_integer_rule() {
    // [15.10]
    for code in 0..=255u8 {
        let steps = second_reader::normal_steps(code);
        let normal = psao::core::point::decode_normal(code);
        for axis in 0..3 {
            assert_eq!(steps[axis], (normal[axis] * 127.0) as i64, "code {code}");
        }
    }
    let mut random = Random(5);
    // From points on top of each other, which are all equally near, to points far outside any grid.
    for spread in [1, 2, 3, 20, 400, 1 << 15, 1 << 20, 1 << 25] {
        for count in [0, 1, 2, 3, 4, 17, 26, 130, 1024] {
            let points: Vec<PatchPoint> = (0..count)
                .map(|_| PatchPoint {
                    position: std::array::from_fn(|_| random.below(spread) as u32),
                    normal: random.below(256) as u8,
                    ..PatchPoint::default()
                })
                .collect();
            for (first, window) in [(true, 16), (false, 24)] {
                let mut found = vec![Neighbours::default(); count];
                find_neighbours(&points, first, &mut found);
                let placed: Vec<_> = points.iter().map(|p| (p.position, p.normal)).collect();
                let (earlier, later) = second_reader::neighbours(&placed, window);
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
                        later: if first { [0; 3] } else { said(&later[at]) },
                    };
                    assert_eq!(found[at], expected, "{at} of {count}, spread {spread}");
                }
            }
        }
    }
}

/// What both readers make of a patch's data: the same.
fn patch_read(data: &[u8]) -> Result<Vec<PatchPoint>, String> {
    let second = second_reader::read_patch(data);
    let mut points = [PatchPoint::default(); PATCH_POINTS];
    let count = decode_patch(data, &mut points);
    assert_eq!(
        count.is_ok(),
        second.is_ok(),
        "{count:?}, {second:?} of {data:?}"
    );
    let second = second?;
    let points = points[..count.unwrap()].to_vec();
    let other = second.iter().map(|point| PatchPoint {
        position: point.position,
        normal: point.normal,
        level: point.level,
        ..PatchPoint::default()
    });
    assert_eq!(points, other.collect::<Vec<_>>());
    Ok(points)
}

#[test]
fn patches_of_any_shape_read_back_as_they_were_written() {
    // [15.6, 15.7]
    let mut random = Random(7);
    let all = 1 << 25;
    for extent in [
        [1, 1, 1],
        [2, 1, 1],
        [1, 1, 500],
        [9, 9, 9],
        [600, 500, 4],
        [1 << 18, 3, 1 << 20],
        [all, all, all],
        [1, all, 1],
    ] {
        for count in [1, 2, 3, 4, 5, 16, 17, 40, 1023, 1024] {
            for rough in [1, 15] {
                let corner = extent.map(|extent| random.below(all - extent + 1));
                let turn = random.below(15);
                let points: Vec<PatchPoint> = (0..count)
                    .map(|_| {
                        let mut code = || ((turn + random.below(rough)) % 15) as u8;
                        let normal = code() | code() << 4;
                        let at = |axis: usize| (corner[axis] + random.below(extent[axis])) as u32;
                        PatchPoint {
                            position: [0, 1, 2].map(at),
                            normal,
                            level: random.below(rough.min(4)) as u8,
                            ..PatchPoint::default()
                        }
                    })
                    .collect();
                let order = Order::of(&points);
                let mut sorted = points.clone();
                sorted.sort_by_key(|point| order.key(point));
                assert_eq!(patch_read(&patch_of(&points)), Ok(sorted), "{extent:?}");
            }
        }
    }
}

/// Any decisions, for `count` points in a box of so many bits.
fn any_patch(random: &mut Random, count: u32, bits: [u8; 3]) -> Vec<u8> {
    let mut data = varint(count);
    for bits in bits {
        let most = (1 << 25) - if bits < 25 { 1usize << bits } else { 0 };
        data.extend(varint(random.below(most) as u32));
    }
    data.extend(bits);
    // Bits of a kind now and then, so that what is seldom comes too.
    while data.len() < 10_000 {
        let byte = [0, 0xff, random.below(256) as u8][random.below(16).min(2)];
        data.push(byte);
    }
    data
}

#[test]
fn patches_that_no_encoder_writes_are_read_or_refused_by_both_readers_for_each_reason() {
    // [15.6, 15.7, 15.9] Decisions at random, so that each refusal comes; and behind them the
    // right end, so that nothing else is wrong with the patch.
    let mut random = Random(8);
    let mut reasons: BTreeMap<String, usize> = BTreeMap::new();
    for round in 0..20_000 {
        let (count, most) = match round % 4 {
            0 => (1, 4),
            1 => (1 + random.below(5), 25),
            2 => (1 + random.below(60), 12),
            _ => (17, 6),
        };
        let bits = [0; 3].map(|_| random.below(most + 1) as u8);
        let random_data = any_patch(&mut random, count as u32, bits);
        let data = second_reader::patch_with_right_end(&random_data).unwrap();
        let read = patch_read(&data);
        let reason = read.map_or_else(
            |why| why,
            |points| {
                assert_eq!(points.len(), count);
                "read".into()
            },
        );
        *reasons.entry(reason).or_default() += 1;
    }
    for reason in [
        "read",
        "15.6: below",
        "15.7: normal",
        "15.7: offset",
        "15.6: position",
    ] {
        assert!(
            reasons.get(reason).is_some_and(|times| *times > 20),
            "{reasons:?}"
        );
    }
    assert_eq!(reasons.len(), 5, "{reasons:?}");
}

#[test]
fn patches_outside_their_limits_are_refused() {
    // [15.6]
    let refused = |data: &[u8], clause: &str| {
        assert_eq!(patch_read(data).unwrap_err(), clause, "{data:?}");
    };
    let limits = "15.6: points, corner or bits";
    let one = patch_of(&[point([5, 6, 7], 0)]);
    let points = patch_read(&one).unwrap();
    assert_eq!(points, [point([5, 6, 7], 0)]);
    let [head, rest] = [&one[..4], &one[4..]];
    assert_eq!(head, [1, 5, 6, 7]);
    refused(&[&[0, 5, 6, 7][..], rest].concat(), limits);
    refused(&[&varint(1025)[..], &[5, 6, 7], rest].concat(), limits);
    refused(&[&varint(u32::MAX)[..], &[5, 6, 7], rest].concat(), limits);
    for axis in 0..3 {
        let corner = |value: u32| -> Vec<u8> {
            let mut corner = [5, 6, 7];
            corner[axis] = value;
            corner.map(varint).concat()
        };
        let most = (1 << 25) - 1;
        assert!(patch_read(&[&[1], &corner(most)[..], rest].concat()).is_ok());
        refused(&[&[1], &corner(most + 1)[..], rest].concat(), limits);
        let mut bits = rest.to_vec();
        bits[axis] = 26;
        refused(&[head, &bits].concat(), limits);
        // One step past the last position that there is.
        let mut far = [5, 6, 7];
        far[axis] += 1;
        let two = patch_of(&[point([5, 6, 7], 0), point(far, 0)]);
        let with = |value: u32| [&[2], &corner(value)[..], &two[4..]].concat();
        assert!(patch_read(&with(most - 1)).is_ok());
        refused(&with(most), "15.6: position");
    }
    for length in 0..7 {
        assert!(patch_read(&one[..length]).is_err(), "{length} bytes");
    }
    refused(&[&one[..], &[0]].concat(), "15.9: end of the data");
    let points: Vec<PatchPoint> = (0..30).map(|at| point([at * 7 % 30, at, 3], 0)).collect();
    let data = patch_of(&points);
    for length in 0..data.len() {
        // What is cut off may be another patch, but hardly ever.
        let cut = patch_read(&data[..length]);
        assert!(cut.is_err() || length + 2 > data.len(), "{length} bytes");
        assert_ne!(cut, patch_read(&data));
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
    // [13.1] The hashes of all frames: integers alone lead to them, so whoever gets others has
    // another codec, hash or bins, and can't read streams that were stored before.
    let outcome = agreed_on(&made(MADE_LARGE));
    let hashes = outcome.shown.iter().map(|shown| shown.2);
    assert_eq!(fingerprint(hashes), 7549024034835355145);
}

// ---------------------------------------------------------------- slices

/// Three slices, four patches of which the last never comes, and three instances: all points,
/// without buckets, and at level 1.
fn slices_header() -> Header {
    Header {
        profile: Profile::Residual,
        step: 3,
        capacity: Capacity {
            instances: 3,
            slices: 3,
            points: 60,
            patches: 4,
            topology_bytes: 400,
            ..Hand::ROOM
        },
        ..Hand::header()
    }
}

/// Points of the patches of [`slices_header`]; none of the second has level 1.
const SLICES_POINTS: [u32; 3] = [20, 5, 17];

fn slices_patches() -> Vec<(u32, Vec<u8>)> {
    let patch = |count: u32, level: fn(u32) -> u8| -> Vec<PatchPoint> {
        let at = |n: u32| [n * 5 % 120, n * 9 % 90, n * 4 % 60];
        (0..count).map(|n| point(at(n), level(n))).collect()
    };
    let [a, b, c] = SLICES_POINTS;
    let patches = [patch(a, |n| n as u8 % 4), patch(b, |_| 0), patch(c, |_| 3)];
    (0..)
        .zip(patches.iter().map(|points| patch_of(points)))
        .collect()
}

fn slices_instances() -> [(u32, Instance); 2] {
    let all = Instance {
        bucket_count: 4,
        ..grid()
    };
    let coarse = Instance {
        bucket_first: 4,
        level: 1,
        ..all
    };
    [(0, all), (2, coarse)]
}

/// A stream that begins with the patches and a snapshot of the instances.
fn slices_begun(header: &Header) -> (Hand, Coded) {
    let mut coded = Coded::new(header);
    let mut hand = Hand::with(header);
    hand.packet(kind::PATCHES, 0, &coded.patches(&slices_patches()));
    let raw = coded.instances(&slices_instances());
    let flags = flag::SNAPSHOT | flag::LAST;
    hand.frame(flags, 1, coded.mirror.hash(), &raw);
    (hand, coded)
}

/// What the readers say of that and a frame of these packets (kind and content), with the hash
/// that the mirror then has.
fn slices_outcome(header: &Header, parts: &[(u8, Vec<u8>)]) -> Outcome {
    let (mut hand, mut coded) = slices_begun(header);
    for (kind, part) in parts {
        let slices = &mut coded.slices.slices();
        let mirror = &mut coded.mirror;
        let applied = match *kind {
            kind::SLICES => {
                hand.slices(0, 2, 0, part);
                apply_slices(part, header.step, mirror, slices).is_ok()
            }
            kind::PATCHES => {
                hand.packet(kind::PATCHES, 0, part);
                apply_patches(part, slices).is_ok()
            }
            _ => {
                hand.frame(0, 2, 0, part);
                apply_instances(part, mirror, slices).is_ok()
            }
        };
        if !applied {
            break;
        }
    }
    hand.slices(flag::LAST, 2, coded.mirror.hash(), &[]);
    let outcome = agreed(&hand.bytes, header.capacity);
    assert_eq!(outcome.mismatches, 0);
    let whole = outcome.error.is_none();
    assert_eq!(outcome.shown.len(), 1 + usize::from(whole));
    outcome
}

/// Data that leave so many points as they are, or open: one decision a block.
fn still(points: u32, first: bool) -> Vec<u8> {
    let count = points as usize;
    let (mut value, mut last) = (vec![255; count], vec![0; count]);
    let mut state = SliceState {
        value: &mut value,
        last: &mut last,
    };
    let neighbours = vec![Neighbours::default(); count];
    let target = vec![255; count];
    let mut data = vec![0; 64];
    let length = encode_slice(&neighbours, FIRST, &mut state, &target, first, &mut data);
    data.truncate(length.unwrap());
    data
}

fn open_item(index: u32, at: [u32; 3], shown: u64, points: u32) -> Made {
    (
        index,
        Operation::Open(at, shown),
        points,
        still(points, true),
    )
}

const PATCHES: u8 = kind::PATCHES;
const SLICES: u8 = kind::SLICES;

#[test]
fn items_that_do_not_fit_are_refused() {
    // [15.2, 15.5, 15.8]
    let header = slices_header();
    // A packet each.
    let outcome = |list: &[&Made]| {
        let part = |item: &&Made| (SLICES, items(std::slice::from_ref(*item)));
        let parts: Vec<_> = list.iter().map(part).collect();
        slices_outcome(&header, &parts)
    };
    let good = |list: &[&Made]| {
        let outcome = outcome(list);
        assert_eq!(outcome.error, None, "{:?}", outcome.clause);
    };
    let refused = |list: &[&Made], clause: &str| {
        let outcome = outcome(list);
        assert!(matches!(outcome.error, Some(ClientError::Stream(_))));
        assert_eq!(outcome.clause.unwrap(), clause);
    };
    let [a, b, c] = SLICES_POINTS;
    let first = open_item(0, [0, 0, 0], 3, a);
    good(&[&first]);
    good(&[&open_item(2, [0, 2, 60 - c], 1, c)]);
    good(&[&open_item(1, [2, 2, 0], 0, c)]);
    let of_level = a - a.div_ceil(4);
    good(&[&open_item(1, [2, 0, 7], 1, of_level)]);

    // What is open, and what is not.
    let update = |index| (index, Operation::Update, a, still(a, false));
    let show = |index, shown| (index, Operation::Show(shown), a, still(a, false));
    let close = |index| (index, Operation::Close, 0, Vec::new());
    for later in [update(0), show(0, 1), close(0)] {
        good(&[&first, &later]);
        refused(&[&later], "15.5: open, or not open");
        refused(&[&first, &close(0), &later], "15.5: open, or not open");
    }
    good(&[&first, &close(0), &first]);
    refused(&[&first, &first], "15.5: open, or not open");
    for far in [
        update(3),
        show(3, 1),
        close(3),
        open_item(3, [0, 0, 0], 3, a),
    ] {
        refused(&[&far], "15.5: index");
    }

    // Instances and patches.
    let opens = |at| open_item(0, at, 0, a);
    for instance in [3, u32::MAX] {
        refused(&[&opens([instance, 0, 0])], "15.5: instance");
    }
    refused(&[&opens([1, 0, 0])], "15.5: instance");
    for patch in [3, 4, u32::MAX] {
        refused(&[&opens([0, patch, 0])], "15.5: no such patch");
    }
    refused(&[&opens([2, 1, 0])], "15.5: no points of the level");

    // Where the points are kept.
    let second = |at, first, points| open_item(at, [0, 1, first], 1, points);
    for first in [61 - a, 60, 61, u32::MAX, u32::MAX - a + 1] {
        refused(&[&opens([0, 0, first])], "15.5: beyond the points");
    }
    for first_point in [0, 1, 7, a - 1] {
        let both = [&first, &second(1, first_point, b)];
        refused(&both, "15.5: points of another slice");
    }
    good(&[&first, &second(1, a, b)]);
    good(&[&second(0, 0, b), &open_item(1, [0, 0, b], 3, a)]);
    let overlaps = open_item(1, [0, 0, b - 1], 3, a);
    refused(
        &[&second(0, 0, b), &overlaps],
        "15.5: points of another slice",
    );
    good(&[&first, &close(0), &second(1, 7, b)]);

    // Bits without a block.
    good(&[&first, &show(0, 0)]);
    for shown in [4, 0x80, 0x83] {
        refused(
            &[&open_item(0, [0, 0, 0], shown, a)],
            "15.8: a bit without a block",
        );
        refused(&[&first, &show(0, shown)], "15.8: a bit without a block");
    }
}

#[test]
fn items_whose_bytes_do_not_fit_are_refused() {
    // [15.2, 15.5, 15.9]
    let header = slices_header();
    let outcome = |content: Vec<u8>| slices_outcome(&header, &[(SLICES, content)]);
    let refused = |content: &[&[u8]], clause: &str| {
        let outcome = outcome(content.concat());
        assert!(matches!(outcome.error, Some(ClientError::Stream(_))));
        assert_eq!(outcome.clause.unwrap(), clause);
    };
    let count = SLICES_POINTS[0];
    let data = still(count, true);
    let good = items(&[open_item(0, [0, 0, 0], 3, count)]);
    assert_eq!(good[..6], [2, 0, 0, 0, 3, data.len() as u8]);
    assert_eq!(outcome(good.clone()).error, None);
    for gap in [3, 1 << 20, u32::MAX / 4] {
        for operation in 0..4 {
            let head = varint(gap << 2 | operation);
            refused(&[&head, &[0, 0, 0, 3, 0]], "15.5: index");
            refused(&[&good, &head, &[0, 0, 0, 3, 0]], "15.5: index");
        }
    }
    // Numbers in more bytes than they need are read; those that are too long or large are not.
    let size = data.len() as u8;
    let long = [
        0x82,
        0x80,
        0,
        0x80,
        0,
        0,
        0x80,
        0x80,
        0x80,
        0x80,
        0,
        3,
        size | 0x80,
        0,
    ];
    assert_eq!(outcome([&long[..], &data].concat()).error, None);
    let too_long = [2, 0, 0, 0, 3, size | 0x80, 0x80, 0x80, 0x80, 0x80, 0];
    refused(&[&too_long, &data], "15.2: varint");
    let too_large = [2, 0, 0, 0, 3, 0xff, 0xff, 0xff, 0xff, 0x10];
    refused(&[&too_large, &data], "15.2: varint");
    for short in 1..good.len() {
        let error = outcome(good[..short].to_vec()).error;
        assert_eq!(error, Some(StreamError::Length.into()), "{short} bytes");
    }
    refused(&[&good, &[0x80]], "15.2: length");
    // The data itself ends too early, or too late.
    for data in [vec![], [&data[..], &[0]].concat(), vec![0xff; 9]] {
        let list = items(&[(0, Operation::Open([0, 0, 0], 3), count, data)]);
        refused(&[&list], "15.9: end of the data");
    }
    // More content than the frame says, or less.
    for raw_bytes in [0, 1, good.len() as u32 - 1, good.len() as u32 + 1] {
        let (mut hand, _) = slices_begun(&header);
        hand.part(SLICES, flag::LAST, 2, 0, raw_bytes, &good);
        let outcome = agreed(&hand.bytes, header.capacity);
        assert_eq!(outcome.error, Some(StreamError::Length.into()));
        assert_eq!(outcome.clause.unwrap(), "15.5: raw_bytes");
    }
}

#[test]
fn patches_that_do_not_fit_are_refused() {
    // [2.6, 3.2, 15.4, 15.5]
    let header = slices_header();
    let come = slices_patches();
    let data = patch_of(&[point([1, 2, 3], 3)]);
    let outcome = |parts: &[&[u8]]| {
        let parts: Vec<_> = parts.iter().map(|part| (PATCHES, part.to_vec())).collect();
        slices_outcome(&header, &parts)
    };
    let good = |parts: &[&[u8]]| assert_eq!(outcome(parts).error, None);
    let refused = |parts: &[&[u8]], clause: &str| {
        let outcome = outcome(parts);
        assert!(matches!(outcome.error, Some(ClientError::Stream(_))));
        assert_eq!(outcome.clause.unwrap(), clause);
    };
    let body = |index, data: &[u8]| patches_body(&[(index, data.to_vec())]);
    good(&[&[]]);
    good(&[&body(3, &data)]);
    // Again the same, in any packet, but no other.
    good(&[
        &patches_body(&come),
        &body(3, &data),
        &body(3, &data),
        &body(0, &come[0].1),
    ]);
    refused(&[&body(0, &data)], "15.4: other data");
    refused(&[&body(3, &data), &body(3, &come[0].1)], "15.4: other data");
    refused(&[&body(0, &come[0].1[..9])], "15.4: other data");
    refused(&[&body(4, &data)], "15.4: index");
    refused(&[&body(u32::MAX - 1, &data)], "15.4: index");
    refused(&[&body(u32::MAX, &data)], "6.3: index");
    refused(
        &[&[&body(3, &data)[..], &varint(u32::MAX), &[1, 0]].concat()],
        "6.3: index",
    );
    refused(&[&body(3, &[])], "15.4: no data");
    refused(&[&body(0, &[])], "15.4: no data");
    let whole = body(3, &data);
    for length in 1..whole.len() {
        assert_eq!(
            outcome(&[&whole[..length]]).error,
            Some(StreamError::Length.into()),
            "{length} bytes"
        );
    }
    // All the room that there is, and one byte more. What they hold is not looked at yet.
    let used: usize = come.iter().map(|(_, data)| data.len()).sum();
    let left = header.capacity.topology_bytes as usize - used;
    good(&[&body(3, &vec![9; left])]);
    refused(&[&body(3, &vec![9; left + 1])], "15.4: topology_bytes");
    refused(&[&body(3, &vec![9; 900])], "15.4: topology_bytes");

    // It is when a slice is opened.
    let opens = items(&[open_item(0, [0, 3, 0], 1, 1)]);
    let opened = |patch: &[u8]| {
        let parts = [(PATCHES, body(3, patch)), (SLICES, opens.clone())];
        slices_outcome(&header, &parts)
    };
    assert_eq!(opened(&data).error, None);
    let longer = [&data[..], &[0]].concat();
    assert_eq!(opened(&longer).clause.unwrap(), "15.9: end of the data");
    assert_eq!(
        opened(&[0; 8]).clause.unwrap(),
        "15.6: points, corner or bits"
    );
    assert!(opened(&data[..5]).error.is_some());

    // No flags are theirs.
    for bit in 0..8 {
        let mut hand = Hand::with(&header);
        hand.packet(PATCHES, 1 << bit, &body(3, &data));
        let outcome = agreed(&hand.bytes, header.capacity);
        assert_eq!(outcome.error, Some(StreamError::Value.into()), "flag {bit}");
    }
    // Not before the header, nor after the end, nor in the other profile.
    let mut before = Hand::bare();
    before.packet(PATCHES, 0, &body(3, &data));
    let mut after = Hand::with(&header);
    after.packet(kind::END, 0, &[]);
    after.packet(PATCHES, 0, &body(3, &data));
    let mut other = Hand::new();
    other.packet(PATCHES, 0, &[]);
    for hand in [before, after, other] {
        let outcome = agreed(&hand.bytes, header.capacity);
        assert_eq!(outcome.error, Some(StreamError::Order.into()));
    }
}

#[test]
fn instances_change_only_while_none_of_their_slices_is_open_and_alone() {
    // [6, 7.4]
    let header = slices_header();
    let outcome = |parts: &[(u8, Vec<u8>)]| slices_outcome(&header, parts);
    let frame = |instances: &[(u32, Instance)]| (kind::FRAME, content(instances, &[], &[]));
    let slices = |item: &Made| (SLICES, items(std::slice::from_ref(item)));
    let [(_, all), (_, coarse)] = slices_instances();
    let opened = open_item(1, [0, 0, 0], 3, SLICES_POINTS[0]);
    let closed = (1, Operation::Close, 0, Vec::new());
    let clause = "6: an instance with an open slice";
    for changed in [all, coarse, Instance::default()] {
        let parts = [slices(&opened), frame(&[(0, changed)])];
        assert_eq!(outcome(&parts).clause.unwrap(), clause);
        let parts = [slices(&opened), frame(&[(1, all), (2, changed)])];
        assert_eq!(outcome(&parts).error, None);
        let parts = [slices(&opened), slices(&closed), frame(&[(0, changed)])];
        assert_eq!(outcome(&parts).error, None);
    }
    for level in 0..6 {
        let part = frame(&[(0, Instance { level, ..all })]);
        assert_eq!(outcome(&[part]).error.is_none(), level < 4, "level {level}");
    }
    for raw in [
        content(&[], &[(0, bucket(&[]))], &[]),
        content(&[], &[], &[(1, cell(5))]),
        content(&[(0, all)], &[(0, bucket(&[1]))], &[(1, cell(5))]),
    ] {
        let outcome = outcome(&[(kind::FRAME, raw)]);
        assert_eq!(
            outcome.clause.unwrap(),
            "6: buckets or cells in profile residual"
        );
    }
}

#[test]
fn points_take_the_first_place_and_cells_the_lowest_number_and_leave_them_again() {
    // [7.7, 15.8] One bucket, and three cells for the points of cells 0 to 3 along x.
    let header = Header {
        capacity: Capacity {
            instances: 1,
            buckets: 1,
            cells: 4,
            slices: 3,
            points: 99,
            patches: 3,
            topology_bytes: 999,
        },
        step: 1,
        ..slices_header()
    };
    let grid = Instance {
        dims: [4, 1, 1],
        bucket_count: 1,
        ..grid()
    };
    let mut coded = Coded::new(&header);
    let mut hand = Hand::with(&header);
    // Eight points in each of two cells; one in each of four and one outside; two in the first.
    let at = |x: u32, n: u32| point([32 * x + n, 5, 6], 0);
    let first: Vec<_> = (0..16).map(|n| at(n / 8, n % 8)).collect();
    let second: Vec<_> = [0, 2, 3, 4].map(|x| at(x, 10)).to_vec();
    let third = vec![at(0, 20), at(0, 21)];
    let patches = (0..).zip([first, second, third].map(|points| patch_of(&points)));
    let body = coded.patches(&patches.collect::<Vec<_>>());
    hand.packet(PATCHES, 0, &body);
    let raw = coded.instances(&[(0, grid)]);
    let flags = flag::SNAPSHOT | flag::LAST;
    hand.frame(flags, 1, coded.mirror.hash(), &raw);

    let mut id = 1;
    let mut step = |index, operation, occlusion: u8| {
        let item = coded.code(index, operation, &|_| occlusion);
        id += 1;
        hand.slices(flag::LAST, id, coded.mirror.hash(), &items(&[item]));
        let outcome = agreed(&hand.bytes, header.capacity);
        assert_eq!((outcome.shown.len() as u32, outcome.error), (id, None));
        let cells = coded.mirror.cells()[1..].to_vec();
        (coded.mirror.buckets()[0].entries, cells)
    };
    let up = encode_normal([0.0, 0.0, 1.0]);
    let packed = |n, occlusion| Point::pack([n, 5, 6], up, occlusion);
    let numbers = |entries: [u32; 8]| entries.into_iter().take_while(|entry| *entry != 0);
    let numbers = |entries| numbers(entries).collect::<Vec<_>>();
    let open = |patch, first| Operation::Open([0, patch, first], 1);

    let (entries, cells) = step(0, open(0, 0), 100);
    assert_eq!(numbers(entries), [1, 2]);
    assert_eq!((cells[0].key, cells[1].key), (0, 1));
    let seven: [Point; 7] = std::array::from_fn(|n| packed(n as u32, 100));
    assert_eq!([cells[0].points, cells[1].points], [seven; 2]);
    // Cell 0 is full, cell 2 is the last that there is, cell 4 is outside the grid.
    let (entries, cells) = step(1, open(1, 20), 50);
    assert_eq!(numbers(entries), [1, 2, 3]);
    assert_eq!((cells[0].points, cells[2].key), (seven, 2));
    assert_eq!(cells[2].points[..2], [packed(10, 50), Point::EMPTY]);
    // Who found no room says what it says, in no cell, and does not come in later by itself.
    let (entries, cells) = step(0, Operation::Close, 0);
    assert_eq!(numbers(entries), [3]);
    assert_eq!(cells[..2], [Cell::default(); 2]);
    let (entries, cells) = step(1, Operation::Update, 90);
    assert_eq!(numbers(entries), [3]);
    assert_eq!(cells[2].points[0], packed(10, 90));
    let (entries, _) = step(1, Operation::Show(0), 90);
    assert!(numbers(entries).is_empty());
    let (entries, cells) = step(1, Operation::Show(1), 30);
    assert_eq!(numbers(entries), [1, 2, 3]);
    assert_eq!([cells[0].key, cells[1].key, cells[2].key], [0, 2, 3]);
    assert_eq!(cells[0].points[..2], [packed(10, 30), Point::EMPTY]);
    // Places are left until all behind them are, and taken again from the first.
    let (_, cells) = step(2, open(2, 50), 10);
    let ours = [packed(20, 10), packed(21, 10), Point::EMPTY];
    assert_eq!(cells[0].points[1..4], ours);
    let (entries, cells) = step(1, Operation::Close, 0);
    assert_eq!(numbers(entries), [1], "the other two are unused");
    assert_eq!(cells[0].points[0], Point::LEFT);
    assert_eq!(cells[0].points[1..4], ours);
    let (entries, cells) = step(1, open(1, 20), 70);
    assert_eq!(numbers(entries), [1, 2, 3]);
    assert_eq!(cells[0].points[0], packed(10, 70));
    assert_eq!(cells[0].points[1..4], ours);
    let (entries, cells) = step(2, Operation::Close, 0);
    assert_eq!(numbers(entries), [1, 2, 3]);
    assert_eq!(cells[0].points[..2], [packed(10, 70), Point::EMPTY]);
}

#[test]
fn a_point_that_finds_its_bucket_full_is_in_no_cell() {
    // [15.8] Nine cells for the eight entries of one bucket.
    let header = Header {
        capacity: Capacity {
            instances: 1,
            buckets: 1,
            cells: 20,
            ..slices_header().capacity
        },
        ..slices_header()
    };
    let mut coded = Coded::new(&header);
    let mut hand = Hand::with(&header);
    let points: Vec<_> = (0..9).map(|x| point([32 * x, 0, 0], 0)).collect();
    hand.packet(PATCHES, 0, &coded.patches(&[(0, patch_of(&points))]));
    let grid = Instance {
        dims: [9, 1, 1],
        bucket_count: 1,
        ..grid()
    };
    hand.frame(flag::SNAPSHOT, 1, 0, &coded.instances(&[(0, grid)]));
    let item = coded.code(0, Operation::Open([0, 0, 0], 1), &|at| at as u8);
    hand.slices(flag::LAST, 1, coded.mirror.hash(), &items(&[item]));
    let outcome = agreed(&hand.bytes, header.capacity);
    assert_eq!((outcome.shown.len(), outcome.error), (1, None));
    assert_eq!(coded.mirror.buckets()[0].entries, [1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(coded.mirror.cells()[9], Cell::default());
    assert_eq!(left_out(&coded.slices), 1);
    assert_eq!(coded.slices.values(&coded.slices.get()[0])[8], 8);
}

#[test]
fn what_leaves_goes_before_what_comes_and_both_behind_what_changes() {
    // [15.8] Blocks of one item that change places in a full cell: those that come find room,
    // though they have lower numbers than those that go.
    let header = slices_header();
    let mut coded = Coded::new(&header);
    let mut hand = Hand::with(&header);
    let points: Vec<_> = (0..32).map(|n| point([n, 0, 0], 0)).collect();
    hand.packet(PATCHES, 0, &coded.patches(&[(0, patch_of(&points))]));
    hand.frame(flag::SNAPSHOT, 1, 0, &coded.instances(&slices_instances()));
    let item = coded.code(0, Operation::Open([0, 0, 0], 2), &|_| 200);
    hand.slices(flag::LAST, 1, coded.mirror.hash(), &items(&[item]));
    let positions = |coded: &Coded| coded.mirror.cells()[1].points.map(|p| p.position()[0]);
    assert_eq!(positions(&coded), [16, 17, 18, 19, 20, 21, 22]);
    let item = coded.code(0, Operation::Show(1), &|_| 77);
    hand.slices(flag::LAST, 2, coded.mirror.hash(), &items(&[item]));
    assert_eq!(positions(&coded), [0, 1, 2, 3, 4, 5, 6]);
    assert!(
        coded.mirror.cells()[1]
            .points
            .iter()
            .all(|p| p.occlusion().abs_diff(77) <= 1)
    );
    let outcome = agreed(&hand.bytes, header.capacity);
    assert_eq!((outcome.shown.len(), outcome.error), (2, None));
}

#[test]
fn each_level_has_the_points_of_that_level_and_above_in_longer_cells() {
    // [15.3]
    let mut random = Random(12);
    let points: Vec<_> = (0..400u32)
        .map(|n| {
            let position = [0; 3].map(|_| random.below(900) as u32);
            point(position, (n.trailing_zeros() as u8).min(3))
        })
        .collect();
    let header = Header {
        capacity: Capacity {
            instances: 4,
            buckets: 400,
            cells: 900,
            slices: 4,
            points: 1600,
            patches: 1,
            topology_bytes: 9000,
        },
        max_body_bytes: 1 << 16,
        ..slices_header()
    };
    let mut coded = Coded::new(&header);
    let mut hand = Hand::with(&header);
    hand.packet(PATCHES, 0, &coded.patches(&[(0, patch_of(&points))]));
    let grids = [0, 1, 2, 3].map(|level| Instance {
        dims: [28; 3],
        bucket_first: 100 * level,
        bucket_count: 100,
        level,
        ..grid()
    });
    let instances: Vec<_> = (0..).zip(grids).collect();
    hand.frame(flag::SNAPSHOT, 1, 0, &coded.instances(&instances));
    let opened: Vec<Made> = (0..4)
        .map(|level| {
            let has = points
                .iter()
                .filter(|point| u32::from(point.level) >= level);
            let shown = blocks(has.count() as u32);
            let operation = Operation::Open([level, 0, 400 * level], shown);
            coded.code(level, operation, &|at| at as u8)
        })
        .collect();
    assert_eq!(
        [0, 1, 2, 3].map(|level: usize| opened[level].2),
        [400, 200, 100, 50]
    );
    hand.slices(flag::LAST, 1, coded.mirror.hash(), &items(&opened));
    let outcome = agreed(&hand.bytes, header.capacity);
    assert_eq!((outcome.shown.len(), outcome.error), (1, None));
    for (level, scale) in [(0, 1.0), (1, 0.5f64.sqrt()), (2, 0.5), (3, 0.125f64.sqrt())] {
        for point in points
            .iter()
            .filter(|point| usize::from(point.level) >= level)
        {
            let steps = point.position.map(|p| (f64::from(p) + 0.5) * scale);
            let cell = steps.map(|steps| (steps / 32.0) as u32);
            let grid = &coded.mirror.instances()[level];
            if cell.iter().all(|cell| *cell < 28) {
                let lookup = coded.mirror.lookup();
                let found = lookup.find(grid, cell);
                assert!(found.is_some(), "cell {cell:?} of level {level}");
            }
        }
    }
}

#[test]
fn patches_stay_for_streams_that_have_the_same_and_for_no_others() {
    // [15.4, 10.3]
    let header = Header {
        topology_hash: 77,
        ..slices_header()
    };
    let patches = slices_patches();
    let count = SLICES_POINTS[0];
    let last = patch_of(&[point([1, 2, 3], 3)]);
    let all: Vec<_> = patches.iter().cloned().chain([(3, last)]).collect();
    // A stream of patches alone, without frames: what an app can ship.
    let brought = |header: &Header, patches: &[(u32, Vec<u8>)]| {
        let mut hand = Hand::with(header);
        hand.packet(PATCHES, 0, &patches_body(patches));
        hand.packet(kind::END, 0, &[]);
        hand.bytes
    };
    // A stream that opens a slice without having brought its patch.
    let opens = |header: &Header| {
        let mut coded = Coded::new(header);
        coded.patches(&patches);
        let mut hand = Hand::with(header);
        let raw = coded.instances(&slices_instances());
        hand.frame(flag::SNAPSHOT, 1, 0, &raw);
        let item = coded.code(0, Operation::Open([0, 0, 0], 3), &|at| at as u8 * 9);
        assert_eq!(item.2, count);
        hand.slices(flag::LAST, 1, coded.mirror.hash(), &items(&[item]));
        hand.bytes
    };
    let mut room = header.capacity;
    (room.cells, room.points, room.patches, room.topology_bytes) = (99, 999, 9, 999);
    let mut readers = Readers::new(room);
    assert!(readers.agree(&opens(&header)).error.is_some());
    let bring = |readers: &mut Readers, some: &[(u32, Vec<u8>)]| {
        let outcome = readers.agree(&brought(&header, some));
        assert!(
            outcome.error.is_none() && outcome.ended,
            "{:?}",
            outcome.clause
        );
    };
    bring(&mut readers, &all[..2]);
    assert_eq!(readers.client.topology_hash(), 0, "two are missing");
    bring(&mut readers, &all[1..]);
    assert_eq!(readers.client.topology_hash(), 77);
    for _ in 0..2 {
        let outcome = readers.agree(&opens(&header));
        assert_eq!((outcome.shown.len(), outcome.error), (1, None));
    }
    // The mirror may become another, as between two servers with other limits.
    let mut larger = header;
    (larger.capacity.cells, larger.capacity.points) = (99, 999);
    larger.capacity.slices = 2;
    for header in [larger, header] {
        let outcome = readers.agree(&opens(&header));
        assert_eq!((outcome.shown.len(), outcome.error), (1, None));
        assert_eq!(readers.client.topology_hash(), 77);
    }
    // Not even a stream that fails takes them away, nor one that is refused for its size.
    assert!(
        readers
            .agree(&brought(&header, &[(9, vec![1])]))
            .error
            .is_some()
    );
    let mut too_large = header;
    too_large.capacity.cells = 100;
    assert!(readers.agree(&opens(&too_large)).error.is_some());
    assert_eq!(readers.agree(&opens(&header)).error, None);
    // Another topology does.
    type Change = fn(&mut Header);
    let changes: [Change; 5] = [
        |header| header.topology_hash = 78,
        |header| header.topology_hash = 0,
        |header| header.capacity.patches += 1,
        |header| header.capacity.topology_bytes += 1,
        |header| *header = Hand::header(),
    ];
    for (number, change) in changes.into_iter().enumerate() {
        bring(&mut readers, &all);
        let mut other = header;
        change(&mut other);
        if other.profile == Profile::Residual {
            let clause = readers.agree(&opens(&other)).clause;
            assert_eq!(
                clause.as_deref(),
                Some("15.5: no such patch"),
                "change {number}"
            );
        } else {
            assert_eq!(readers.agree(&Hand::with(&other).bytes).error, None);
        }
        assert_eq!(readers.client.topology_hash(), 0, "change {number}");
        let clause = readers.agree(&opens(&header)).clause;
        assert_eq!(
            clause.as_deref(),
            Some("15.5: no such patch"),
            "change {number}"
        );
    }
    // A hash of 0 tells nothing, however often it comes.
    let none = Header {
        topology_hash: 0,
        ..header
    };
    readers.agree(&brought(&none, &all));
    assert_eq!(readers.client.topology_hash(), 0);
    assert!(readers.agree(&opens(&none)).error.is_some());
}

#[test]
fn patches_come_at_any_time_and_snapshots_leave_them() {
    // [3.2, 5.6, 7.3] Before any snapshot, between the packets of a frame, and of one withheld.
    let header = slices_header();
    let patches = slices_patches();
    let mut coded = Coded::new(&header);
    let mut hand = Hand::with(&header);
    let some = |coded: &mut Coded, hand: &mut Hand, which: usize| {
        let body = coded.patches(&patches[which..=which]);
        hand.packet(PATCHES, 0, &body);
    };
    some(&mut coded, &mut hand, 0);
    hand.slices(0, 1, 0, &[0xff; 9]);
    some(&mut coded, &mut hand, 1);
    hand.slices(flag::LAST, 1, 5, &[0xff; 9]);
    for id in [2, 3] {
        coded.reset();
        hand.frame(flag::SNAPSHOT, id, 0, &coded.instances(&slices_instances()));
        if id == 2 {
            some(&mut coded, &mut hand, 2);
        }
        let all: Vec<Made> = [(0, 0), (1, 20), (2, 25)]
            .map(|(patch, first)| {
                let shown = blocks(SLICES_POINTS[patch as usize]);
                let operation = Operation::Open([0, patch, first], shown);
                coded.code(patch, operation, &|at| 250 - at as u8)
            })
            .to_vec();
        hand.slices(flag::LAST, id, coded.mirror.hash(), &items(&all));
    }
    let outcome = agreed(&hand.bytes, header.capacity);
    assert_eq!((outcome.shown.len(), outcome.error), (2, None));
    assert_eq!(outcome.shown[0].2, outcome.shown[1].2);
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
                let outcome = agreed_with(&hand.bytes, &sample, &right);
                noticed += usize::from(outcome.error.is_some() || outcome.mismatches > 0);
            }
        }
        assert!(noticed > list.len() / 2, "{noticed} of {}", 2 * list.len());
    }
}

#[test]
fn every_flipped_bit_behind_a_right_checksum_never_shows_a_wrong_mirror() {
    for sample in [made(MADE_SMALL), SERVED_RESIDUAL.clone()] {
        let right = hashes(&sample);
        let (mut errors, mut withheld, mut shown) = (0, 0, 0);
        for place in packets(&sample.bytes) {
            for bit in 8 * place.start..8 * place.end {
                let mut bytes = sample.bytes.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                mend(&mut bytes);
                let outcome = agreed_with(&bytes, &sample, &right);
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
fn agreed_with(bytes: &[u8], sample: &Sample, right: &[u64]) -> Outcome {
    let outcome = agreed(bytes, sample.room);
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
        let mut readers = Readers::new(sample.room);
        let (mut errors, mut shown, mut withheld) = (0, 0, 0);
        for round in 0..15_000 {
            // Now and then what an earlier stream left is there still, damaged patches and all.
            if round % 3 == 0 {
                readers = Readers::new(sample.room);
            }
            let mut bytes = sample.bytes.clone();
            for _ in 0..1 + random.below(3) {
                if !bytes.is_empty() {
                    damage(&mut bytes, &mut random);
                }
            }
            mend(&mut bytes);
            let outcome = readers.agree(&bytes);
            errors += usize::from(outcome.error.is_some());
            withheld += outcome.mismatches;
            shown += outcome.shown.len();
            assert!(readers.client.memory_bytes() <= most);
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
fn damaged_items_and_patches_end_as_both_readers_agree() {
    // The hash is made right for what comes out, so that nothing but they decides.
    let header = slices_header();
    let (_, mut coded) = slices_begun(&header);
    let last = patch_of(&[
        point([1, 2, 3], 3),
        point([70, 2, 9], 1),
        point([9, 9, 9], 2),
    ]);
    let body = coded.patches(&[(3, last)]);
    let [a, _, c] = SLICES_POINTS;
    let opens = [
        (0, Operation::Open([0, 0, 0], 1)),
        (1, Operation::Open([0, 3, 57], 1)),
        (2, Operation::Open([2, 2, a], 3)),
    ];
    let later = [
        (0, Operation::Show(2)),
        (1, Operation::Update),
        (2, Operation::Show(blocks(c))),
    ];
    let last = [
        (0, Operation::Update),
        (1, Operation::Close),
        (2, Operation::Show(1)),
    ];
    let mut part = |what: [(u32, Operation); 3], base: u8| {
        let target = |at: usize| base.wrapping_add((at * 13) as u8);
        let all = what.map(|(index, operation)| coded.code(index, operation, &target));
        (SLICES, items(&all))
    };
    let parts = [
        (PATCHES, body),
        part(opens, 100),
        part(later, 90),
        part(last, 160),
    ];
    assert_eq!(slices_outcome(&header, &parts).error, None);
    let mut random = Random(6);
    let mut shown = 0;
    for _ in 0..30_000 {
        let mut parts = parts.clone();
        let which = random.below(4);
        damage(&mut parts[which].1, &mut random);
        shown += usize::from(slices_outcome(&header, &parts).error.is_none());
    }
    assert!((300..29_000).contains(&shown), "{shown} shown");
}

// ---------------------------------------------------------------- the server's profile residual

/// A world, one client's encoder, and that client.
struct Watched {
    world: World,
    encoder: Encoder,
    client: Client,
    /// Lengths of the packets that came.
    packets: Vec<usize>,
}

fn all(_: [Vec3; 2]) -> bool {
    true
}

const EVERYTHING: View<'_> = View {
    sees: &all,
    eye: None,
};

impl Watched {
    fn new(scene: Scene, density: f64, limits: Limits) -> Watched {
        let options = Options {
            density,
            rays: 128,
            rest_space: true,
            ..Options::of(psao::core::Kernel::Planar)
        };
        let world = World::new(scene, options, &|_, _, _| ()).unwrap();
        let room = config(capacity_of(&world));
        Watched::with(world, limits, Client::new(room), 0)
    }

    /// `has`: the hash of the patches that the client says it has.
    fn with(world: World, limits: Limits, mut client: Client, has: u64) -> Watched {
        let mut encoder = Encoder::new(&world, Scheme::Residual(QUANTISER, limits), has);
        let header = encoder.header(&world, 0, 30.0);
        client.push(&header).unwrap();
        Watched {
            world,
            encoder,
            client,
            packets: Vec::new(),
        }
    }

    /// A frame of the world as it is at that time, sent if it says anything new. The client has
    /// then what the encoder believes it to have.
    fn frame(&mut self, time_s: f64, view: &View<'_>) -> FrameStats {
        self.world.step(time_s, &|_| true, 200_000);
        self.encoder.merge(&self.world);
        self.world.clear_changes();
        let mut bytes = Vec::new();
        let time_ns = (time_s * 1e9) as u64;
        let sent = self
            .encoder
            .frame(&self.world, time_ns, view, false, &mut bytes);
        assert_eq!(sent.bytes, bytes.len() as u64);
        let pushed = self.client.push(&bytes).unwrap();
        assert_eq!(pushed.consumed, bytes.len());
        assert_eq!(pushed.frame.is_some(), !bytes.is_empty());
        let (mine, theirs) = (self.client.mirror(), self.encoder.mirror());
        assert!(contents(mine) == contents(theirs), "the mirrors differ");
        let theirs = self.encoder.slices().unwrap();
        assert!(values(self.client.slices()) == values(theirs));
        let mut rest = &bytes[..];
        while let Some((_, length)) = Packet::read(rest, MAX_BODY_BYTES).unwrap() {
            self.packets.push(length);
            rest = &rest[length..];
        }
        sent
    }

    /// How far off the points of slices in view are at most, in 1/255, by the slices' values; those
    /// of slices that are not open say 255.
    fn error(&self, view: &View<'_>) -> u8 {
        let slices = self.client.slices();
        let mut most = 0;
        for (slice, open) in self.world.slices.iter().zip(slices.get()) {
            if !(view.sees)(slice.bounds) {
                continue;
            }
            let level = self.client.mirror().instances()[slice.instance as usize].level;
            let want = self
                .world
                .occlusion(slice)
                .iter()
                .zip(self.world.levels(slice));
            let want = want.filter(|(_, has)| u32::from(**has) >= level);
            let mut have = slices.values(open).iter();
            for (want, _) in want {
                most = most.max(want.abs_diff(have.next().copied().unwrap_or(255)));
            }
        }
        most
    }

    /// What the client shows at all points of the scene.
    fn picture(&self) -> Vec<f32> {
        let lookup = self.client.mirror().lookup();
        let kernel = self.world.options.kernel;
        let slices = self.world.slices.iter();
        let points = slices.flat_map(|slice| slice.points.clone().map(|p| (slice.instance, p)));
        points
            .map(|(instance, number)| {
                let (position, normal) = self.world.grid_point(instance, number);
                let (position, normal) = (position.to_array(), normal.to_array());
                lookup.blend(kernel, instance, position, normal).openness
            })
            .collect()
    }
}

fn still_scene() -> Scene {
    let mut scene = scene();
    scene.animations.clear();
    scene
}

#[test]
fn a_still_scene_sends_no_bytes_once_it_has_converged() {
    let mut watched = Watched::new(still_scene(), 400.0, NO_LIMITS);
    let mut sent = Vec::new();
    for _ in 0..40 {
        sent.push(watched.frame(0.0, &EVERYTHING).bytes);
    }
    let last = sent.iter().rposition(|bytes| *bytes > 0).unwrap();
    assert!((1..30).contains(&last), "{sent:?}");
    assert!(watched.error(&EVERYTHING) <= QUANTISER.bound());
}

#[test]
fn instances_of_one_mesh_share_its_patches_which_come_once() {
    let mut scene = still_scene();
    let mut other = scene.instances[1].clone();
    other.node = scene.nodes.len() as u32;
    let mut node = scene.nodes[1].clone();
    if let LocalTransform::Trs { translation, .. } = &mut node.local {
        translation.x += 0.7;
    }
    scene.nodes.push(node);
    scene.instances.push(other);
    let mut watched = Watched::new(scene, 1500.0, NO_LIMITS);
    let sets = watched.world.topology.of_instance.clone();
    assert_eq!(sets[1], sets[3]);
    let count = watched.world.topology.patches();
    let slices = watched.world.slices.len() as u32;
    assert!(
        count > 4 && slices > count,
        "{slices} slices of {count} patches"
    );
    let (mut patches, mut opened) = (0, 0);
    // One after the other comes into view, goes, and comes again after a snapshot.
    for frame in 0..8 {
        let near = |bounds: [Vec3; 2]| bounds[0].x < -0.6 + 0.4 * (frame % 4) as f32;
        let view = View {
            sees: &near,
            eye: None,
        };
        if frame == 4 {
            watched.encoder.resync();
        }
        let sent = watched.frame(0.0, &view);
        (patches, opened) = (patches + sent.patches, opened + sent.opened);
    }
    assert_eq!((patches, opened), (count, 2 * slices));
    assert_eq!(watched.client.stats().patches, u64::from(count));

    // Who has all of them from a recording is sent none.
    let world = watched.world;
    let scheme = Scheme::Residual(QUANTISER, NO_LIMITS);
    let mut encoder = Encoder::new(&world, scheme, 0);
    let mut recording = encoder.header(&world, 0, 30.0);
    encoder.all_patches(&world, &mut recording);
    encoder.end(&mut recording);
    let mut client = Client::new(config(capacity_of(&world)));
    assert_eq!(client.topology_hash(), 0);
    client.push(&recording).unwrap();
    assert_eq!(client.state(), State::Ended);
    let has = client.topology_hash();
    assert_eq!(has, world.topology.hash);
    client.restart();
    // Its room for points is another, but not that for patches.
    let limits = Limits {
        points: capacity_of(&world).points * 17 / 20,
        ..NO_LIMITS
    };
    let mut watched = Watched::with(world, limits, client, has);
    let sent = watched.frame(0.0, &EVERYTHING);
    assert_eq!(sent.patches, 0);
    assert!(sent.opened > 4, "{sent:?}");
}

#[test]
fn a_budget_holds_over_any_half_second_and_the_largest_errors_go_first() {
    let limits = Limits {
        max_mbit: 0.2,
        ..NO_LIMITS
    };
    let mut watched = Watched::new(scene(), 2500.0, limits);
    let mut sent = Vec::new();
    let (mut waited, mut compared) = (0, 0);
    for frame in 0..200 {
        // Half of the time nothing moves, so that what waits can go out.
        let time_s = f64::from(frame.min(100)) * 0.01;
        let had: Vec<bool> = watched
            .client
            .slices()
            .get()
            .iter()
            .map(|s| s.point_count > 0)
            .collect();
        let stats = watched.frame(time_s, &EVERYTHING);
        sent.push(stats.bytes as f64);
        waited += stats.waiting;
        // Of what is not there yet, the darkest comes first.
        let slices = watched
            .world
            .slices
            .iter()
            .zip(watched.client.slices().get());
        let (mut come, mut wait) = (Vec::new(), Vec::new());
        for ((slice, open), had) in slices.zip(had) {
            let dark = watched.world.occlusion(slice).iter();
            let dark: u64 = dark.map(|o| u64::from(255 - o).pow(2) + 1).sum();
            match (had, open.point_count > 0) {
                (true, _) => {}
                (false, true) => come.push(dark),
                (false, false) => wait.push(dark),
            }
        }
        if let (Some(least), Some(most)) = (come.iter().min(), wait.iter().max()) {
            assert!(least >= most, "frame {frame}: {least} before {most}");
            compared += 1;
        }
    }
    assert!(
        waited > 20 && compared > 2,
        "{waited} waited, {compared} compared"
    );
    let budget = limits.max_mbit * 1e6 / 8.0 * 0.5;
    // What is over: a slice and its patch, a packet each.
    let over = 2.0 * *watched.packets.iter().max().unwrap() as f64;
    let most = sent
        .windows(15)
        .map(|half| half.iter().sum::<f64>())
        .fold(0.0, f64::max);
    assert!(
        most <= budget + over,
        "{most} bytes in half a second, not {budget} + {over}"
    );
    assert!(
        most > 0.9 * budget,
        "the budget is meant to be needed: {most}"
    );
    assert_eq!(sent[199], 0.0);
    assert!(watched.error(&EVERYTHING) <= QUANTISER.bound());
}

#[test]
fn a_client_with_too_little_room_has_what_is_in_view() {
    for by_cells in [false, true] {
        let mut watched = Watched::new(scene(), 2500.0, NO_LIMITS);
        let need = capacity_of(&watched.world);
        let limits = match by_cells {
            false => Limits {
                points: need.points * 17 / 20,
                ..NO_LIMITS
            },
            true => Limits {
                cells: need.cells * 17 / 20,
                ..NO_LIMITS
            },
        };
        let room = Capacity {
            points: if by_cells { need.points } else { limits.points },
            cells: if by_cells { limits.cells } else { need.cells },
            ..need
        };
        let client = Client::new(config(room));
        watched = Watched::with(watched.world, limits, client, 0);
        // Cells and buckets that are full leave some out in any case.
        let topology = &watched.world.topology;
        let levels = topology.of_instance.iter().flatten();
        let full: usize = levels
            .map(|&(set, level)| topology.sets[set as usize].levels[level as usize].discarded)
            .sum();
        let (mut closed, mut opened) = (0, 0);
        for frame in 0..48 {
            // A window that goes over the scene and back, twice.
            let middle = (frame as f32 * 0.26).sin() * 0.6;
            let window = |bounds: [Vec3; 2]| {
                let at = bounds[0].midpoint(bounds[1]).x;
                (at - middle).abs() < 0.2
            };
            let view = View {
                sees: &window,
                eye: None,
            };
            let stats = watched.frame(f64::from(frame) * 0.03, &view);
            (closed, opened) = (closed + stats.closed, opened + stats.opened);
            let error = watched.error(&view);
            assert!(error <= QUANTISER.bound(), "frame {frame}: {error}");
            let out = left_out(watched.client.slices());
            assert!(out <= full, "frame {frame}: {out} points have no cell");
        }
        assert!(
            closed > 7 && opened > closed,
            "{opened} opened, {closed} closed"
        );
    }
}

#[test]
fn levels_of_detail_change_with_the_distance_and_fade() {
    let limits = Limits {
        points_per_pixel: 0.0024,
        ..NO_LIMITS
    };
    let mut watched = Watched::new(still_scene(), 600.0, limits);
    // Points a pixel halve at √2 times the distance; away and back, and long enough at each.
    let way = [2.0, 3.8, 5.2, 8.0, 5.0, 3.4, 2.0];
    let mut levels = Vec::new();
    let mut settled: Option<Vec<f32>> = None;
    let (mut jumps, mut hard) = (Vec::new(), Vec::new());
    for far in way {
        let view = View {
            sees: &all,
            eye: Some(Eye {
                camera: psao_server::camera::Camera {
                    position: Vec3::new(0.0, far, 0.0),
                    forward: Vec3::NEG_Y,
                    up: Vec3::Z,
                    fov_y_rad: 1.0,
                    aspect: 1.0,
                    near: 0.1,
                    far: 100.0,
                },
                pixels_per_radian: 1000.0,
            }),
        };
        let mut last = settled.clone();
        let mut largest = 0.0f32;
        for _ in 0..40 {
            watched.frame(0.0, &view);
            let picture = watched.picture();
            largest = largest.max(last.map_or(0.0, |last| apart(&last, &picture)));
            last = Some(picture);
        }
        assert_eq!(
            watched.frame(0.0, &view).bytes,
            0,
            "at {far} m it does not end"
        );
        assert!(watched.error(&view) <= QUANTISER.bound());
        let now = last.unwrap();
        if let Some(settled) = &settled {
            hard.push(apart(settled, &now));
            jumps.push(largest);
        }
        settled = Some(now);
        let instances = watched.client.mirror().instances().iter();
        levels.push(instances.map(|instance| instance.level).collect::<Vec<_>>());
    }
    let expected = [0, 1, 2, 3, 2, 1, 0].map(|level| vec![level; 3]);
    assert_eq!(levels, expected);
    // Without a fade a picture would change from one to the other at once. (Where points go, what
    // lies between those that stay changes all the same.)
    for (jump, hard) in jumps.iter().zip(&hard) {
        assert!(jump < hard && *jump < 5.0 / 255.0, "{jumps:?} of {hard:?}");
    }
    let [jump, hard] = [&jumps, &hard].map(|jumps| jumps.iter().sum::<f32>());
    assert!(jump < 0.9 * hard, "{jump} of {hard}");
}

/// How much two pictures differ in the mean.
fn apart(a: &[f32], b: &[f32]) -> f32 {
    let sum: f32 = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum();
    sum / a.len() as f32
}

// ---------------------------------------------------------------- memory

/// What a client may hold at most: its mirror, what it keeps of slices, one packet and one content,
/// and zstd's own state.
fn most_bytes(room: Capacity) -> u64 {
    let packet = PACKET_HEADER_BYTES as u64 + u64::from(MAX_BODY_BYTES);
    let beside = psao::memory::SliceHeap::new(room).bytes();
    room.bytes() + beside + packet + u64::from(MAX_RAW_BYTES) + (256 << 10)
}

#[test]
fn no_length_field_takes_memory_beyond_what_the_client_allowed() {
    // [1.5, 2.4, 4.3, 4.5]
    let room = slices_header().capacity;
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
    // What profile `residual` keeps beside the mirror.
    type Ask = fn(&mut Capacity, u32);
    let asks: [Ask; 4] = [
        |capacity, count| capacity.slices = count,
        |capacity, count| capacity.points = count,
        |capacity, count| capacity.patches = count,
        |capacity, count| capacity.topology_bytes = count,
    ];
    for ask in asks {
        for count in [10_000, u32::MAX] {
            let mut header = slices_header();
            ask(&mut header.capacity, count);
            let (memory, result) = push(&Hand::with(&header).bytes);
            assert_eq!(result, Err(ClientError::Capacity(header.capacity)));
            assert!(memory < 256 << 10, "{memory} bytes");
        }
    }
    // More cells than places can be numbered [4.1], which no room makes good.
    for cells in [1 << 29, (1 << 29) + 1, u32::MAX] {
        let mut header = slices_header();
        header.capacity.cells = cells;
        let without_slices = Capacity {
            cells,
            ..Hand::ROOM
        };
        let error = agreed(&Hand::with(&header).bytes, without_slices).error;
        let expected = match cells {
            0x2000_0000 => ClientError::Capacity(header.capacity),
            _ => StreamError::Value.into(),
        };
        assert_eq!(error, Some(expected), "{cells} cells");
    }
    // The largest limits that a header may ask for.
    let header = Header {
        step: 255,
        max_body_bytes: MAX_BODY_BYTES,
        max_raw_bytes: MAX_RAW_BYTES,
        ..slices_header()
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
        // (In profile `residual` there are no buckets and cells to count.)
        let raw: Vec<u8> = counts.iter().flat_map(|c| c.to_le_bytes()).collect();
        let mut hand = Hand::new();
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

    let outcome = agreed(&bytes, sample.room);
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
    let outcome = agreed(&bytes, sample.room);
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
    let outcome = read(&mut client, &sample.bytes, usize::MAX, |_, _| ());
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
        let mut readers = Readers::new(sample.room);
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
            let outcome = readers.agree(&bytes);
            errors += usize::from(outcome.error.is_some());
            withheld += outcome.mismatches;
            shown += outcome.shown.len();
            assert!(readers.client.memory_bytes() <= most_bytes(sample.room));
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
    let mut readers = Readers::new(Hand::ROOM);
    let mut shown = 0;
    for _ in 0..30_000 {
        let mut damaged = raw.clone();
        damage(&mut damaged, &mut random);
        let mut mirror = psao::core::Mirror::new(psao::memory::Heap::new(Hand::ROOM));
        let applied = stream::apply_changes(&damaged, &mut mirror);
        let hash = applied.map_or(0, |_| mirror.hash());
        let mut hand = Hand::new();
        hand.frame(flag::SNAPSHOT | flag::LAST, 1, hash, &damaged);
        let outcome = readers.agree(&hand.bytes);
        assert_eq!(outcome.shown.len(), usize::from(outcome.error.is_none()));
        shown += outcome.shown.len();
        // Whatever is shown can be looked up.
        let lookup = readers.client.mirror().lookup();
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
        capacity: slices_header().capacity,
        topology_hash: 0xfedc_ba98_7654_3210,
    };
    let camera = Camera {
        position_m: [1e6, -2.5, 3.25],
        forward: [0.0, 0.0, -1.0],
        up: [0.0, 1.0, 0.0],
        fov_y_rad: 1.2,
        aspect: 16.0 / 9.0,
        height_px: 1080,
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
        packet(uplink::kind::PRESENCE, &|w| {
            let (instance, present) = (5, false);
            uplink::Presence { instance, present }.write(w)
        }),
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
        Message::Presence(m) => {
            write_packet(&mut bytes, uplink::kind::PRESENCE, 0, 5, |w| m.write(w))
        }
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
    let unknown = |flags| with_body(&[71, flags], b"later");
    assert_eq!(read_uplink(&unknown(0)), Err(StreamError::Kind(71)));
    assert_eq!(read_uplink(&unknown(flag::OPTIONAL)), Ok(None));
}

#[test]
fn numbers_that_are_none_do_not_get_through_the_uplink() {
    let packets = uplink_packets();
    let mut refused = 0;
    for (packet, first, size) in [(1, 0, 8), (1, 24, 4), (2, 4, 8), (3, 8, 4)] {
        let body = &packets[packet][PACKET_HEADER_BYTES..];
        let end = match (packet, size) {
            (1, 8) => 24,
            (1, 4) => 56,
            _ => body.len(),
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
    hello[48..50].copy_from_slice(&257u16.to_le_bytes());
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
    let mut encoder = Encoder::new(&world, CELLS, 0);
    let mut bytes = encoder.header(&world, 0, 30.0);
    let mut client = Client::new(config(capacity_of(&world)));
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
        encoder.merge(&world);
        world.clear_changes();
        let view = View {
            sees: &|_| true,
            eye: None,
        };
        encoder.frame(&world, frame as u64, &view, true, &mut bytes);
    }
    assert!(world.drive(3, far).is_err());
    let outcome = read(&mut client, &bytes, usize::MAX, |_, _| ());
    assert_eq!((outcome.shown.len(), outcome.error), (5, None));
}
