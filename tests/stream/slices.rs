//! Slices: items, cells and places, damage of both.

use crate::client::{damage, most_bytes};
use crate::samples::{
    Coded, Hand, MADE_SMALL, Made, Outcome, Random, Readers, SERVED_RESIDUAL, Sample, agreed,
    agreed_on, blocks, bucket, cell, content, grid, items, left_out, made, mend, packets, patch_of,
    patches_body, point, varint,
};
use psao::ClientError;
use psao::core::cell::Cell;
use psao::core::grid::Instance;
use psao::core::mirror::Capacity;
use psao::core::point::{Point, encode_normal};
use psao::core::residual::{Neighbours, Quantiser, SliceState, encode_slice};
use psao::core::slices::{FIRST, Operation, apply_instances, apply_patches, apply_slices};
use psao::core::stream::{Header, MAX_BODY_BYTES, Packet, Profile, StreamError, flag, kind};
use psao::core::topology::PatchPoint;

/// Three slices, four patches of which the last never comes, and three instances: all points,
/// without buckets, and at level 1.
pub fn slices_header() -> Header {
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
    let quantiser = Quantiser {
        step: if first {
            FIRST.step
        } else {
            slices_header().step
        },
        dead_zone: 0,
    };
    let length = encode_slice(
        &neighbours,
        quantiser,
        &mut state,
        &target,
        &[],
        first,
        &mut data,
    );
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

pub const PATCHES: u8 = kind::PATCHES;
pub const SLICES: u8 = kind::SLICES;

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
    // The data itself ends too early, or too late. (None at all say that all points move, by
    // nothing.)
    for data in [vec![0], [&data[..], &[0]].concat(), vec![0xff; 9]] {
        let list = items(&[(0, Operation::Open([0, 0, 0], 3), count, data)]);
        refused(&[&list], "15.9: end of the data");
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
        "15.6: points, corner, bits or form"
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
pub fn hashes(sample: &Sample) -> Vec<u64> {
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
