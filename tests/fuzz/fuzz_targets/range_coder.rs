//! Range-coded data: a patch's points, then a slice over them.
#![no_main]

use libfuzzer_sys::fuzz_target;
use psao::core::residual::{Neighbours, SliceState, decode_slice, find_neighbours};
use psao::core::topology::{PATCH_POINTS, PatchPoint, decode_patch};

fuzz_target!(|data: &[u8]| {
    let [first, step, low, high, rest @ ..] = data else {
        return;
    };
    let length = usize::from(u16::from_le_bytes([*low, *high])).min(rest.len());
    let (patch, slice) = rest.split_at(length);
    let mut points = vec![PatchPoint::default(); PATCH_POINTS];
    // Where the patch is none, a slice over points that are all in one place.
    let count = decode_patch(patch, &mut points).unwrap_or(100);
    let first = first & 1 != 0;
    let mut neighbours = vec![Neighbours::default(); count];
    find_neighbours(&points[..count], first, &mut neighbours);
    let (mut value, mut last) = (vec![255; count], vec![0; count]);
    let mut state = SliceState {
        value: &mut value,
        last: &mut last,
    };
    let _ = decode_slice(&neighbours, (*step).max(1), &mut state, first, slice);
});
