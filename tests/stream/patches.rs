//! Patches, and the codec's integer rules.

use crate::samples::{MADE_LARGE, Random, agreed_on, made, patch_of, point, varint};
use crate::second_reader;
use psao::core::residual::{Neighbours, find_neighbours};
use psao::core::topology::{Order, PATCH_POINTS, PatchPoint, across, decode_patch, settled};
use std::collections::BTreeMap;

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
            let mut found = vec![Neighbours::default(); count];
            find_neighbours(&points, &mut found);
            let placed: Vec<_> = points.iter().map(|p| (p.position, p.normal)).collect();
            let (earlier, later) = second_reader::neighbours(&placed);
            for at in 0..count {
                let said = |others: &[usize]| {
                    let mut far = [0; 2];
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
            for (rough, shift) in [(1, 0), (15, 0), (1, 3), (15, 1), (15, 4)] {
                let corner = extent.map(|extent| random.below(all - extent + 1));
                let turn = random.below(15);
                let points: Vec<PatchPoint> = (0..count)
                    .map(|_| {
                        let mut code = || ((turn + random.below(rough)) % 15) as u8;
                        let normal = code() | code() << 4;
                        let across = across(normal);
                        let at = |axis: usize| {
                            let at = (corner[axis] + random.below(extent[axis])) as u32;
                            if axis == across {
                                at
                            } else {
                                settled(at, shift)
                            }
                        };
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

/// Any decisions, for `count` points in a box of so many bits, whose form is that byte.
fn any_patch(random: &mut Random, count: u32, bits: [u8; 3], form: u8) -> Vec<u8> {
    let mut data = varint(count);
    for bits in bits {
        let most = (1 << 25) - if bits < 25 { 1usize << bits } else { 0 };
        data.extend(varint(
            random.below(most) as u32 >> (form >> 2) << (form >> 2),
        ));
    }
    data.extend(bits);
    data.push(form);
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
        let form = [0, random.below(20) as u8][round / 4 % 2];
        let random_data = any_patch(&mut random, count as u32, bits, form);
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
    let limits = "15.6: points, corner, bits or form";
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
    // Half a cell is the longest lattice, on which a corner has to lie.
    let with = |corner: [u8; 3], shift: u8| {
        let form = shift << 2;
        [&[1], &corner[..], &rest[..3], &[form], &rest[4..]].concat()
    };
    assert!(patch_read(&with([0, 16, 32], 4)).is_ok());
    refused(&with([0, 16, 32], 5), limits);
    refused(&with([0, 16, 8], 4), limits);
    for length in 0..8 {
        assert!(patch_read(&one[..length]).is_err(), "{length} bytes");
    }
    refused(&[&one[..], &[0]].concat(), "15.9: end of the data");
    let points: Vec<PatchPoint> = (0..30).map(|at| point([at * 7 % 30, at, 3], 0)).collect();
    let data = patch_of(&points);
    let read = (0..data.len()).filter(|&length| {
        let cut = patch_read(&data[..length]);
        assert_ne!(cut, patch_read(&data));
        cut.is_ok()
    });
    // What is cut off may be another patch, but hardly ever.
    assert!(read.count() < 4, "of {} bytes", data.len());
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
    assert_eq!(fingerprint(hashes), 18074039415186671072);
}

// ---------------------------------------------------------------- slices
