//! Streams to read, made by the server and by hand; and both readers side by side.

use crate::second_reader;
use glam::Vec3;
use psao::core::cell::{Bucket, Cell};
use psao::core::grid::Instance;
use psao::core::mirror::Capacity;
use psao::core::point::{Point, encode_normal};
use psao::core::residual::{MAX_SLICE_BYTES, Quantiser, encode_slice};
use psao::core::slices::{
    FIRST, ITEM_HEADER_BYTES, Item, Operation, apply_instances, apply_patches,
};
use psao::core::stream::{
    self, FRAME_HEADER_BYTES, Frame, Header, MAX_BODY_BYTES, PACKET_HEADER_BYTES, PREAMBLE, Packet,
    Profile, Writer, flag, kind, mirror_check, write_packet,
};
use psao::core::topology::{
    MAX_PATCH_BYTES, Order, PATCH_POINTS, PatchPoint, decode_patch, encode_patch,
};
use psao::{Client, ClientError, Config, State};
use psao_server::encode::{Compression, Encoder, Limits, Scheme, View, capacity_of};
use psao_server::scene::{
    Animation, Channel, Interpolation, Keys, LocalTransform, Mesh, Morph, Node, Scene,
};
use psao_server::world::{Options, World};
use std::collections::{BTreeMap, HashMap};
use std::sync::LazyLock;

// ---------------------------------------------------------------- streams to read

/// A stream, and what its readers must show.
#[derive(Clone)]
pub struct Sample {
    pub bytes: Vec<u8>,
    pub room: Capacity,
    /// Contents of the three buffers at each frame, by its number.
    pub mirrors: HashMap<u32, [Vec<u8>; 3]>,
}

/// A floor, a box that moves over it and one that swells.
pub const CELLS: Scheme = Scheme::Cells {
    threshold: 2,
    compression: Compression::Fast,
};

pub fn scene() -> Scene {
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

pub fn world(density: f64, scheme: Scheme) -> World {
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
pub fn serve(density: f64, scheme: Scheme, frames: u32) -> Sample {
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

pub fn contents<M: psao::core::mirror::Memory>(mirror: &psao::core::Mirror<M>) -> [Vec<u8>; 3] {
    [
        bytemuck::cast_slice(mirror.instances()).to_vec(),
        bytemuck::cast_slice(mirror.buckets()).to_vec(),
        bytemuck::cast_slice(mirror.cells()).to_vec(),
    ]
}

pub static SERVED: LazyLock<Sample> = LazyLock::new(|| serve(24.0, CELLS, 6));

pub const QUANTISER: Quantiser = Quantiser {
    step: 3,
    dead_zone: 2,
};
pub const NO_LIMITS: Limits = Limits {
    max_mbit: 0.0,
    points_per_pixel: 0.0,
    points: 0,
    cells: 0,
};
pub const RESIDUAL: Scheme = Scheme::Residual(QUANTISER, NO_LIMITS);
pub static SERVED_RESIDUAL: LazyLock<Sample> = LazyLock::new(|| serve(24.0, RESIDUAL, 8));

/// Writes streams by hand, and so others than the server's encoder would.
#[derive(Clone)]
pub struct Hand {
    pub bytes: Vec<u8>,
    pub sequence: u16,
}

impl Hand {
    pub const ROOM: Capacity = Capacity {
        instances: 2,
        buckets: 8,
        cells: 9,
        slices: 0,
        points: 0,
        patches: 0,
        topology_bytes: 0,
    };

    pub fn header() -> Header {
        Header {
            scene_hash: 7,
            capacity: Hand::ROOM,
            max_body_bytes: 4096,
            max_raw_bytes: 4096,
            ..Header::default()
        }
    }

    pub fn new() -> Hand {
        Hand::with(&Hand::header())
    }

    pub fn with(header: &Header) -> Hand {
        let mut body = vec![0; 256];
        let mut w = Writer::new(&mut body);
        header.write(&mut w).unwrap();
        let length = w.length();
        let mut hand = Hand::bare();
        hand.packet(kind::HEADER, 0, &body[..length]);
        hand
    }

    pub fn bare() -> Hand {
        Hand {
            bytes: PREAMBLE.to_vec(),
            sequence: 0,
        }
    }

    pub fn packet(&mut self, kind: u8, flags: u8, body: &[u8]) {
        let start = self.bytes.len();
        let room = start + PACKET_HEADER_BYTES + body.len();
        self.bytes.resize(room, 0);
        let out = &mut self.bytes[start..];
        write_packet(out, kind, flags, self.sequence, |w| w.bytes(body)).unwrap();
        self.sequence += 1;
    }

    pub fn frame(&mut self, flags: u8, id: u32, mirror_hash: u64, raw: &[u8]) {
        self.compressed(flags, id, mirror_hash, raw.len() as u32, &zstd(raw));
    }

    pub fn compressed(&mut self, flags: u8, id: u32, hash: u64, raw_bytes: u32, content: &[u8]) {
        let content = [&raw_bytes.to_le_bytes(), content].concat();
        self.part(kind::FRAME, flags, id, hash, &content);
    }

    pub fn slices(&mut self, flags: u8, id: u32, hash: u64, items: &[u8]) {
        self.part(kind::SLICES, flags, id, hash, items);
    }

    pub fn part(&mut self, kind: u8, flags: u8, id: u32, hash: u64, content: &[u8]) {
        let frame = Frame {
            id,
            time_ns: u64::from(id) * 1000,
            mirror_check: mirror_check(hash),
        };
        let mut body = vec![0; FRAME_HEADER_BYTES];
        frame.write(&mut Writer::new(&mut body)).unwrap();
        body.extend_from_slice(content);
        self.packet(kind, flags, &body);
    }
}

pub fn zstd(raw: &[u8]) -> Vec<u8> {
    zstd::bulk::compress(raw, 3).unwrap()
}

/// The content of a frame packet.
pub fn content(
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

pub fn grid() -> Instance {
    Instance {
        radius: 0.8,
        cells_per_unit: [10.0; 3],
        dims: [4, 3, 2],
        bucket_count: 8,
        normal_scale: [1.0; 3],
        ..Instance::default()
    }
}

pub fn cell(key: u32) -> Cell {
    let mut cell = Cell {
        key,
        ..Cell::default()
    };
    cell.points[0] = Point::pack([1, 2, 3], encode_normal([0.0, 1.0, 0.0]), key as u8);
    cell
}

pub fn bucket(entries: &[u32]) -> Bucket {
    let mut bucket = Bucket::default();
    bucket.entries[..entries.len()].copy_from_slice(entries);
    bucket
}

/// A mirror to compute hashes with, apart from the client's.
pub fn hash_after(contents: &[Vec<u8>]) -> u64 {
    let mut mirror = psao::core::Mirror::new(psao::memory::Heap::new(Hand::ROOM));
    for raw in contents {
        stream::apply_changes(raw, &mut mirror).unwrap();
    }
    mirror.hash()
}

/// A snapshot in three packets, a packet to skip between them, an empty frame, and one that takes
/// a cell and a bucket away again.
pub fn by_hand() -> Sample {
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
    hand.part(kind::FRAME, flag::LAST, 42, whole, &[]);
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
pub struct Coded {
    pub mirror: psao::core::Mirror<psao::memory::Heap>,
    pub slices: psao::memory::SliceHeap,
    pub step: u8,
}

/// An item: its slice, what it does, how many points the slice has, and the data.
pub type Made = (u32, Operation, u32, Vec<u8>);

impl Coded {
    pub fn new(header: &Header) -> Coded {
        Coded {
            mirror: psao::core::Mirror::new(psao::memory::Heap::new(header.capacity)),
            slices: psao::memory::SliceHeap::new(header.capacity),
            step: header.step,
        }
    }

    /// The flags of packets of later items, which are coded so much coarser from now on.
    pub fn coarsen(&mut self, header: &Header, doublings: u8) -> u8 {
        let flags = doublings << flag::COARSE.trailing_zeros();
        self.step = header.step_of(flags);
        flags
    }

    pub fn reset(&mut self) {
        let cells = self.mirror.capacity().cells;
        self.mirror.reset();
        self.slices.slices().reset(cells);
    }

    /// A patches packet's body.
    pub fn patches(&mut self, patches: &[(u32, Vec<u8>)]) -> Vec<u8> {
        let body = patches_body(patches);
        apply_patches(&body, &mut self.slices.slices()).unwrap();
        body
    }

    /// A frame packet's content.
    pub fn instances(&mut self, instances: &[(u32, Instance)]) -> Vec<u8> {
        let raw = content(instances, &[], &[]);
        apply_instances(&raw, &mut self.mirror, &self.slices.slices()).unwrap();
        raw
    }

    /// The item that brings a slice to `target`: of a number of its points.
    pub fn code(&mut self, index: u32, operation: Operation, target: &dyn Fn(usize) -> u8) -> Made {
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
            _ => {}
        }
        let slice = slices.get(index).unwrap();
        let shown = match operation {
            Operation::Open(_, shown) | Operation::Show(shown) => shown,
            _ => slice.shown,
        };
        let (neighbours, mut state) = slices.side(&slice).unwrap();
        let target: Vec<u8> = (0..slice.point_count as usize).map(target).collect();
        let mut data = vec![0; MAX_SLICE_BYTES];
        let length = encode_slice(
            neighbours,
            quantiser,
            &mut state,
            &target,
            &[],
            opens,
            &mut data,
        );
        data.truncate(length.unwrap());
        slices.settle(&mut self.mirror, index, shown).unwrap();
        (index, operation, slice.point_count, data)
    }
}

/// How many points of blocks that are shown are in no cell.
pub fn left_out(heap: &psao::memory::SliceHeap) -> usize {
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
pub fn items(items: &[Made]) -> Vec<u8> {
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

pub fn varint(value: u32) -> Vec<u8> {
    let mut bytes = [0; 5];
    let mut w = Writer::new(&mut bytes);
    w.varint(value).unwrap();
    let length = w.length();
    bytes[..length].to_vec()
}

pub fn patches_body(patches: &[(u32, Vec<u8>)]) -> Vec<u8> {
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
pub fn patch_of(points: &[PatchPoint]) -> Vec<u8> {
    let mut points = points.to_vec();
    let order = Order::of(&points);
    points.sort_by_key(|point| order.key(point));
    let mut bytes = vec![0; MAX_PATCH_BYTES];
    let length = encode_patch(&points, &mut bytes).unwrap();
    bytes.truncate(length);
    bytes
}

pub fn point(position: [u32; 3], level: u8) -> PatchPoint {
    PatchPoint {
        position,
        normal: encode_normal([0.0, 0.0, 1.0]),
        level,
        ..PatchPoint::default()
    }
}

/// What to make: points a patch, patches (each on two instances), frames.
#[derive(Clone, Copy)]
pub struct What {
    pub points: u32,
    pub patches: u32,
    pub frames: u32,
}

pub const MADE_SMALL: What = What {
    points: 40,
    patches: 2,
    frames: 8,
};
pub const MADE_LARGE: What = What {
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
/// they are, and the blocks in cells change. Every two frames have another step.
pub fn made(what: What) -> Sample {
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
        let coarse = coded.coarsen(&header, (frame / 2 % 4) as u8);
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
            hand.slices(coarse, frame + 1, 0, &items(&list));
            hand.slices(flag::LAST, frame + 1, hash, &[]);
        } else {
            hand.slices(coarse | flag::LAST, frame + 1, hash, &items(&list));
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
pub fn blocks(points: u32) -> u64 {
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
pub fn samples() -> [Sample; 4] {
    let made = made(MADE_SMALL);
    [SERVED.clone(), SERVED_RESIDUAL.clone(), by_hand(), made]
}

pub fn config(capacity: Capacity) -> Config {
    Config {
        capacity,
        scene_hash: 0,
    }
}

// ---------------------------------------------------------------- reading

/// What a reader says of a stream.
#[derive(Debug, PartialEq)]
pub struct Outcome {
    /// Number, time, hash.
    pub shown: Vec<(u32, u64, u64)>,
    pub mismatches: u64,
    pub ended: bool,
    pub error: Option<ClientError>,
    /// The second reader's words for the error: the clause that is broken.
    pub clause: Option<String>,
}

/// Reads a stream in pushes of `portion` bytes. Each frame shown must have the hash that its bytes
/// say, and the mirror that hash; `check` sees it.
pub fn read(
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
                        let hash = client.mirror().recompute_hash();
                        assert_eq!(mirror_check(hash), frame.mirror_check);
                        check(client, &frame);
                        outcome.shown.push((frame.id, frame.time_ns, hash));
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
pub struct Readers {
    pub client: Client,
    pub kept: second_reader::Kept,
    pub room: Capacity,
}

impl Readers {
    pub fn new(room: Capacity) -> Readers {
        Readers {
            client: Client::new(config(room)),
            kept: second_reader::Kept::default(),
            room,
        }
    }

    /// Reads a stream with both readers, which must agree, and returns what they say.
    pub fn agree(&mut self, bytes: &[u8]) -> Outcome {
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
            let hash = client.mirror().hash();
            assert_eq!(said, (frame.id, frame.time_ns, hash));
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
pub fn values(slices: &psao::memory::SliceHeap) -> BTreeMap<u32, (u32, Vec<u8>)> {
    let open = (0..)
        .zip(slices.get())
        .filter(|(_, slice)| slice.point_count > 0);
    open.map(|(index, slice)| (index, (slice.point_first, slices.values(slice).to_vec())))
        .collect()
}

/// What two readers that have read nothing before agree on.
pub fn agreed(bytes: &[u8], room: Capacity) -> Outcome {
    Readers::new(room).agree(bytes)
}

/// [`agreed`] with a new client, checked against the sample's mirrors too.
pub fn agreed_on(sample: &Sample) -> Outcome {
    let outcome = agreed(&sample.bytes, sample.room);
    let mut client = Client::new(config(sample.room));
    read(&mut client, &sample.bytes, usize::MAX, |client, frame| {
        assert_eq!(contents(client.mirror()), sample.mirrors[&frame.id]);
    });
    outcome
}

/// Where the packets of a whole stream are.
pub fn packets(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
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
pub fn mend(bytes: &mut [u8]) {
    let mut at = PREAMBLE.len();
    while at + PACKET_HEADER_BYTES <= bytes.len() {
        let length = u32::from_le_bytes(bytes[at + 4..at + 8].try_into().unwrap()) as usize;
        let end = at + PACKET_HEADER_BYTES + length;
        if end > bytes.len() {
            return;
        }
        let covered = [&bytes[at..at + 8], &bytes[at + 12..end]].concat();
        let checksum = second_reader::crc32(&covered);
        bytes[at + 8..at + 12].copy_from_slice(&checksum.to_le_bytes());
        at = end;
    }
}

/// SplitMix64: the same on every machine.
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e3779b97f4a7c15);
        let mut x = self.0;
        x = (x ^ x >> 30).wrapping_mul(0xbf58476d1ce4e5b9);
        x = (x ^ x >> 27).wrapping_mul(0x94d049bb133111eb);
        ((x ^ x >> 31) % limit as u64) as usize
    }
}

// ---------------------------------------------------------------- whole streams
