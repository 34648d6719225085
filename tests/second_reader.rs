//! A second reader of streams, written from `docs/format.md` alone: slow, obvious, and sharing no
//! code with the SDK. What both say of the same bytes must be the same.

use std::collections::{BTreeMap, HashMap};
use std::ops::Range;
use std::sync::LazyLock;

/// One of the mirror's buffers: elements that were set, and their index.
pub type Buffer = HashMap<u32, Vec<u8>>;

/// A frame that may be shown.
#[derive(Clone, Debug, PartialEq)]
pub struct Shown {
    pub id: u32,
    pub time_ns: u64,
    pub mirror_hash: u64,
    /// Instances, buckets, cells; without elements that are all zero (8.2: they do not count).
    pub mirror: [Buffer; 3],
    /// Of each open slice: the number of its first point, and the occlusion of all its points,
    /// in cells or not.
    pub slices: BTreeMap<u32, (u32, Vec<u8>)>,
}

/// All that a stream says.
#[derive(Debug, Default)]
pub struct Read {
    pub shown: Vec<Shown>,
    /// A last frame's hash that did not match.
    pub mismatches: usize,
    pub ended: bool,
    /// Why reading stopped before the end of the bytes.
    pub error: Option<String>,
}

/// What a reader has room for (4.3).
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// Instances, buckets, cells.
    pub lengths: [u32; 3],
    pub slices: u32,
    pub points: u32,
    pub patches: u32,
    pub topology_bytes: u32,
}

/// What stays from one stream to the next (15.4).
#[derive(Debug, Default)]
pub struct Kept {
    /// `patches`, `topology_bytes` and `topology_hash` of the last header.
    of: (u32, u32, u64),
    patches: HashMap<u32, Vec<u8>>,
}

struct Header {
    residual: bool,
    lengths: [u32; 3],
    max_body_bytes: u32,
    max_raw_bytes: u32,
    step: u8,
    slices: u32,
    points: u32,
    patches: u32,
    topology_bytes: u32,
    topology_hash: u64,
}

/// Reads all of `bytes`, after other streams that left `kept`.
pub fn read(bytes: &[u8], room: Room, kept: &mut Kept) -> Read {
    let mut read = Read::default();
    if let Err(error) = read_stream(bytes, room, kept, &mut read) {
        read.error = Some(error);
    }
    read
}

fn read_stream(bytes: &[u8], room: Room, kept: &mut Kept, out: &mut Read) -> Result<(), String> {
    // 2.2
    let preamble = [0x89, 0x50, 0x53, 0x41, 0x4f, 0x0d, 0x0a, 0x1a];
    let begin = bytes.len().min(8);
    if bytes[..begin] != preamble[..begin] {
        return Err("2.2: preamble".into());
    }
    let mut at = begin;
    let mut header: Option<Header> = None;
    let mut sequence = 0u16;
    let mut last_id: Option<u32> = None;
    let mut open: Option<(u32, u64)> = None;
    let mut live = false;
    let mut in_snapshot = false;
    let mut mirror: [Buffer; 3] = Default::default();
    let mut slices: BTreeMap<u32, Slice> = BTreeMap::new();

    while at < bytes.len() {
        if out.ended {
            return Err("3.2: bytes behind the end".into());
        }
        // 2.3
        if at + 12 > bytes.len() {
            return Ok(());
        }
        let (kind, flags) = (bytes[at], bytes[at + 1]);
        let body_bytes = u32_at(bytes, at + 4);
        let limit = header.as_ref().map_or(4096, |h| h.max_body_bytes);
        if body_bytes > limit {
            return Err("2.4: body_bytes".into());
        }
        let end = at + 12 + body_bytes as usize;
        if end > bytes.len() {
            return Ok(());
        }
        let body = &bytes[at + 12..end];
        let covered = [&bytes[at..at + 8], body].concat();
        if crc32(&covered) != u32_at(bytes, at + 8) {
            return Err("2.8: checksum".into());
        }
        if u16_at(bytes, at + 2) != sequence {
            return Err("2.7: sequence".into());
        }
        sequence = sequence.wrapping_add(1);
        at = end;

        // 2.6
        let allowed = match kind {
            2 => 0b11,
            5 => 0b1111,
            1 | 3 | 4 | 6 => 0,
            _ => 0xff,
        };
        if flags & !allowed != 0 {
            return Err("2.6: flags".into());
        }
        match kind {
            1 if header.is_none() => {
                let read = read_header(body, room)?;
                // 15.4
                let of = (read.patches, read.topology_bytes, read.topology_hash);
                if kept.of != of || read.topology_hash == 0 {
                    kept.patches.clear();
                }
                kept.of = of;
                header = Some(read);
            }
            4 if header.is_none() => return Err("3.4: refused".into()),
            _ if header.is_none() => return Err("3.2: no header".into()),
            1 | 4 => return Err("3.2: after the header".into()),
            5 | 6 if !header.as_ref().is_some_and(|h| h.residual) => {
                return Err("3.2: slices or patches in profile cells".into());
            }
            6 => {
                let header = header.as_ref().expect("checked above");
                read_patches(body, header, &mut kept.patches)?;
            }
            2 | 5 => {
                // 5.1
                if body.len() < 16 {
                    return Err("5.1: length".into());
                }
                let (id, time_ns) = (u32_at(body, 0), u64_at(body, 4));
                let mirror_check = u32_at(body, 12);
                let (snapshot, last) = (flags & 1 != 0, flags & 2 != 0);
                let header = header.as_ref().expect("checked above");
                if !last && mirror_check != 0 {
                    return Err("5.5: a hash before the last packet".into());
                }
                match open {
                    Some(open) if open != (id, time_ns) => return Err("5.2: mixed".into()),
                    Some(_) if snapshot => return Err("5.3: snapshot within a frame".into()),
                    Some(_) => {}
                    None if last_id.is_some_and(|last| last.wrapping_add(1) != id) => {
                        return Err("5.2: id".into());
                    }
                    None => {}
                }
                last_id = Some(id);
                open = if last { None } else { Some((id, time_ns)) };
                if snapshot {
                    mirror = Default::default();
                    slices.clear();
                    in_snapshot = true;
                }
                if !live && !in_snapshot {
                    continue; // 5.6: withheld
                }
                if kind == 2 {
                    apply(&body[16..], header, &slices, &mut mirror)?;
                } else {
                    let step = (i64::from(header.step) << (flags >> 2)).min(255);
                    let patches = &kept.patches;
                    apply_items(&body[16..], header, step, patches, &mut mirror, &mut slices)?;
                }
                if !last {
                    continue;
                }
                let mirror_hash = hash(&mirror);
                if (mirror_hash >> 32) as u32 == mirror_check {
                    live = true;
                    out.shown.push(Shown {
                        id,
                        time_ns,
                        mirror_hash,
                        mirror: mirror.clone(),
                        slices: slices
                            .iter()
                            .map(|(at, slice)| (*at, slice.shown()))
                            .collect(),
                    });
                } else {
                    live = false;
                    out.mismatches += 1;
                }
                in_snapshot = false;
            }
            3 => {
                if open.is_some() {
                    return Err("3.3: end within a frame".into());
                }
                if !body.is_empty() {
                    return Err("3.1: end with a body".into());
                }
                out.ended = true;
            }
            _ if flags & 0x80 != 0 => {}
            _ => return Err("2.9: unknown kind".into()),
        }
    }
    Ok(())
}

/// Section 4.
fn read_header(body: &[u8], room: Room) -> Result<Header, String> {
    if body.len() < 76 || u16_at(body, 0) != 1 {
        return Err("4.2: length or version".into());
    }
    let (profile, kernel, points, entries) = (body[4], body[5], body[6], body[7]);
    if profile > 1 || kernel > 1 || points != 7 || entries != 8 {
        return Err("4.1: profile, kernel or sizes".into());
    }
    let header = Header {
        residual: profile == 1,
        lengths: [u32_at(body, 16), u32_at(body, 20), u32_at(body, 24)],
        max_body_bytes: u32_at(body, 28),
        max_raw_bytes: u32_at(body, 32),
        step: body[49],
        slices: u32_at(body, 52),
        points: u32_at(body, 56),
        patches: u32_at(body, 60),
        topology_bytes: u32_at(body, 64),
        topology_hash: u64_at(body, 68),
    };
    if !(64..=1 << 22).contains(&header.max_body_bytes) || header.max_raw_bytes > 1 << 22 {
        return Err("4.1: limits".into());
    }
    for at in [36, 40, 44] {
        let value = f32_at(body, at);
        if !value.is_finite() || value < 0.0 {
            return Err("4.1: parameters".into());
        }
    }
    if body[50..52] != [0; 2] {
        return Err("4.1: reserved".into());
    }
    if !header.residual && (body[49] != 0 || body[52..76] != [0; 24]) {
        return Err("4.1: fields of the other profile".into());
    }
    if header.residual && (header.step == 0 || header.lengths[2] > 1 << 29) {
        return Err("4.1: step or cells".into());
    }
    let lacks = header
        .lengths
        .iter()
        .zip(room.lengths)
        .any(|(need, have)| *need > have)
        || header.slices > room.slices
        || header.points > room.points
        || header.patches > room.patches
        || header.topology_bytes > room.topology_bytes;
    if lacks {
        return Err("4.3: room".into());
    }
    Ok(header)
}

/// Section 6.
fn apply(
    content: &[u8],
    header: &Header,
    slices: &BTreeMap<u32, Slice>,
    mirror: &mut [Buffer; 3],
) -> Result<(), String> {
    let lengths = header.lengths;
    if content.is_empty() {
        return Ok(());
    }
    let Some((raw_bytes, compressed)) = content.split_at_checked(4) else {
        return Err("6.1: length".into());
    };
    let raw_bytes = u32_at(raw_bytes, 0);
    if raw_bytes == 0 || raw_bytes > header.max_raw_bytes {
        return Err("6.1: raw_bytes".into());
    }
    // 6.1: one frame, not a skippable one, and nothing behind it.
    let frame = zstd::zstd_safe::find_frame_compressed_size(compressed);
    if !compressed.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]) || frame != Ok(compressed.len()) {
        return Err("6.1: not one frame".into());
    }
    let raw = zstd::bulk::decompress(compressed, raw_bytes as usize)
        .map_err(|error| format!("6.1: {error}"))?;
    if raw.len() != raw_bytes as usize {
        return Err("6.1: raw_bytes".into());
    }
    // 6.2
    if raw.len() < 12 {
        return Err("6.2: length".into());
    }
    let counts = [0, 4, 8].map(|at| u32_at(&raw, at) as usize);
    let sizes = [64usize, 32, 32];
    let total: usize = (0..3).map(|k| counts[k] * (4 + sizes[k])).sum();
    if raw.len() != 12 + total {
        return Err("6.2: length".into());
    }
    if header.residual && counts[1..] != [0, 0] {
        return Err("6: buckets or cells in profile residual".into());
    }
    let mut at = 12;
    for kind in 0..3 {
        let (count, size) = (counts[kind], sizes[kind]);
        let values = at + 4 * count;
        let mut next = 0u64;
        for element in 0..count {
            // 6.3
            let index = next + u64::from(u32_at(&raw, at + 4 * element));
            next = index + 1;
            if next > u64::from(u32::MAX) || index >= u64::from(lengths[kind]) {
                return Err("6.3, 6.4: index".into());
            }
            let value = &raw[values + size * element..values + size * (element + 1)];
            match kind {
                0 => {
                    check_instance(value, lengths)?;
                    if slices
                        .values()
                        .any(|slice| u64::from(slice.instance) == index)
                    {
                        return Err("6: an instance with an open slice".into());
                    }
                }
                1 => {
                    for entry in 0..8 {
                        let cell = u32_at(value, 4 * entry);
                        if cell != 0 && cell >= lengths[2] {
                            return Err("6.4: entry".into());
                        }
                    }
                }
                _ => {
                    if index == 0 {
                        return Err("6.4: cell 0".into());
                    }
                }
            }
            if value.iter().all(|byte| *byte == 0) {
                mirror[kind].remove(&(index as u32));
            } else {
                mirror[kind].insert(index as u32, value.to_vec());
            }
        }
        at = values + size * count;
    }
    Ok(())
}

/// 7.4
fn check_instance(value: &[u8], lengths: [u32; 3]) -> Result<(), String> {
    let (bucket_first, bucket_count) = (u32_at(value, 28), u32_at(value, 44));
    if bucket_count == 0 {
        return Ok(());
    }
    let origin = [0, 4, 8].map(|at| f32_at(value, at));
    let positive = [12, 16, 20, 24, 48, 52, 56].map(|at| f32_at(value, at));
    let dims = [32, 36, 40].map(|at| u32_at(value, at));
    let good = origin.iter().all(|v| v.is_finite())
        && positive.iter().all(|v| v.is_finite() && *v > 0.0)
        && dims.iter().all(|d| (1..=1 << 20).contains(d))
        && u64::from(bucket_first) + u64::from(bucket_count) <= u64::from(lengths[1])
        && u32_at(value, 60) <= 3;
    if good {
        Ok(())
    } else {
        Err("7.4: instance".into())
    }
}

/// 15.4: the body of a patches packet.
fn read_patches(
    body: &[u8],
    header: &Header,
    patches: &mut HashMap<u32, Vec<u8>>,
) -> Result<(), String> {
    let mut at = 0;
    let mut next = 0u64;
    while at < body.len() {
        let gap = varint(body, &mut at)?;
        let index = gap_index(&mut next, gap)?;
        let data = take(body, &mut at)?;
        if index >= header.patches {
            return Err("15.4: index".into());
        }
        if data.is_empty() {
            return Err("15.4: no data".into());
        }
        match patches.get(&index) {
            Some(had) if had != data => return Err("15.4: other data".into()),
            Some(_) => {}
            None => {
                patches.insert(index, data.to_vec());
            }
        }
        let bytes: usize = patches.values().map(|data| data.len()).sum();
        if bytes > header.topology_bytes as usize {
            return Err("15.4: topology_bytes".into());
        }
    }
    Ok(())
}

/// 15.5: a slice that was opened.
struct Slice {
    instance: u32,
    /// Numbers of its points, of all that the header announces.
    numbers: Range<u64>,
    points: Vec<Point>,
    /// 15.8: whether a block's points are in cells.
    shown: Vec<bool>,
    /// 15.10: neighbours of each point.
    earlier: Vec<Vec<usize>>,
    later: Vec<Vec<usize>>,
}

/// A point of a slice.
struct Point {
    /// Its bucket, its cell's key, and what its place holds with the occlusion 0; none: no bin.
    bin: Option<(u32, u32, u32)>,
    /// The cell that it is in, and its place there.
    place: Option<(u32, usize)>,
    occlusion: i64,
    last: i64,
}

impl Slice {
    fn shown(&self) -> (u32, Vec<u8>) {
        let occlusion = self.points.iter().map(|point| point.occlusion as u8);
        (self.numbers.start as u32, occlusion.collect())
    }
}

/// 15.5
fn apply_items(
    content: &[u8],
    header: &Header,
    step: i64,
    patches: &HashMap<u32, Vec<u8>>,
    mirror: &mut [Buffer; 3],
    slices: &mut BTreeMap<u32, Slice>,
) -> Result<(), String> {
    let mut at = 0;
    let mut next = 0u64;
    while at < content.len() {
        let head = varint(content, &mut at)?;
        let index = gap_index(&mut next, head / 4)?;
        let [update, open, close] = [0, 2, 3].map(|what| head % 4 == what);
        if index >= header.slices {
            return Err("15.5: index".into());
        }
        if slices.contains_key(&index) == open {
            return Err("15.5: open, or not open".into());
        }
        if open {
            let instance = varint(content, &mut at)?;
            let patch = varint(content, &mut at)?;
            let first = varint(content, &mut at)?;
            let slice = open_slice(header, patches, mirror, instance, patch, first)?;
            let numbers = &slice.numbers;
            let taken = |other: &Slice| {
                numbers.start < other.numbers.end && other.numbers.start < numbers.end
            };
            if slices.values().any(taken) {
                return Err("15.5: points of another slice".into());
            }
            slices.insert(index, slice);
        }
        let slice = slices.get_mut(&index).expect("checked above");
        if close {
            for point in &mut slice.points {
                take_out(mirror, point);
            }
            slices.remove(&index);
            continue;
        }
        let mut shown = slice.shown.clone();
        if !update {
            let bytes = slice.points.len().div_ceil(128);
            let bits = content.get(at..at + bytes).ok_or("15.5: length")?;
            at += bytes;
            for bit in 0..8 * bytes {
                let set = bits[bit / 8] >> (bit % 8) & 1 == 1;
                match shown.get_mut(bit) {
                    Some(shown) => *shown = set,
                    None if set => return Err("15.8: a bit without a block".into()),
                    None => {}
                }
            }
        }
        let data = take(content, &mut at)?;
        let step = if open { 1 } else { step };
        decode(data, open, step, slice)?;
        // 15.8
        for point in &slice.points {
            if let Some((cell, place)) = point.place {
                let cell = mirror[2].get_mut(&cell).expect("it has this point");
                cell[4 + 4 * place] = point.occlusion as u8;
            }
        }
        for (at, point) in slice.points.iter_mut().enumerate() {
            if slice.shown[at / 16] && !shown[at / 16] {
                take_out(mirror, point);
            }
        }
        for (at, point) in slice.points.iter_mut().enumerate() {
            if !slice.shown[at / 16] && shown[at / 16] {
                put_in(mirror, header.lengths[2], point);
            }
        }
        slice.shown = shown;
    }
    Ok(())
}

/// 15.8
fn put_in(mirror: &mut [Buffer; 3], cells: u32, point: &mut Point) {
    let Some((bucket, key, packed)) = point.bin else {
        return;
    };
    let [_, buckets, all] = mirror;
    let entries = buckets.get(&bucket).map_or([0; 8], |b| words(b));
    let named = entries.iter().take_while(|entry| **entry != 0);
    let found = named.copied().find(|cell| u32_at(&all[cell], 0) == key);
    let empty = entries.iter().position(|entry| *entry == 0);
    // A cell that is in use has a point, so it is among those that are not all zero.
    let unused = || (1..cells).find(|cell| !all.contains_key(cell));
    let index = match (found, empty) {
        (Some(cell), _) => cell,
        (None, None) => return,
        (None, Some(empty)) => {
            let Some(cell) = unused() else {
                return;
            };
            set_word(buckets.entry(bucket).or_insert(vec![0; 32]), empty, cell);
            set_word(all.entry(cell).or_insert(vec![0; 32]), 0, key);
            cell
        }
    };
    let cell = all.get_mut(&index).expect("a bucket names it");
    if let Some(place) = (0..7).find(|place| u32_at(cell, 4 + 4 * place) >> 31 == 0) {
        set_word(cell, 1 + place, packed | point.occlusion as u32);
        point.place = Some((index, place));
    }
}

/// 15.8
fn take_out(mirror: &mut [Buffer; 3], point: &mut Point) {
    let Some((index, place)) = point.place.take() else {
        return;
    };
    let [_, buckets, cells] = mirror;
    let cell = cells.get_mut(&index).expect("it has this point");
    set_word(cell, 1 + place, 1);
    for place in (0..7).rev() {
        if u32_at(cell, 4 + 4 * place) >> 31 == 1 {
            return;
        }
        set_word(cell, 1 + place, 0);
    }
    cells.remove(&index);
    let bucket = point.bin.expect("it is in a cell").0;
    let entries = buckets.get_mut(&bucket).expect("it names the cell");
    let list: [u32; 8] = words(entries);
    let named = list
        .iter()
        .position(|entry| *entry == index)
        .expect("it names the cell");
    let last = list.iter().take_while(|entry| **entry != 0).count() - 1;
    set_word(entries, named, list[last]);
    set_word(entries, last, 0);
    if last == 0 {
        buckets.remove(&bucket);
    }
}

/// The words of a bucket.
fn words(bytes: &[u8]) -> [u32; 8] {
    [0, 1, 2, 3, 4, 5, 6, 7].map(|word| u32_at(bytes, 4 * word))
}

fn set_word(bytes: &mut [u8], word: usize, value: u32) {
    bytes[4 * word..4 * word + 4].copy_from_slice(&value.to_le_bytes());
}

/// 6.3
fn gap_index(next: &mut u64, gap: u32) -> Result<u32, String> {
    let index = *next + u64::from(gap);
    *next = index + 1;
    if *next > u64::from(u32::MAX) {
        return Err("6.3: index".into());
    }
    Ok(index as u32)
}

/// A length, and as many bytes.
fn take<'a>(bytes: &'a [u8], at: &mut usize) -> Result<&'a [u8], String> {
    let length = varint(bytes, at)? as usize;
    if length > bytes.len() - *at {
        return Err("15.5: length".into());
    }
    *at += length;
    Ok(&bytes[*at - length..*at])
}

/// 15.2
fn varint(bytes: &[u8], at: &mut usize) -> Result<u32, String> {
    let mut value = 0u64;
    for group in 0..5 {
        let byte = *bytes.get(*at).ok_or("15.2: length")?;
        *at += 1;
        value += u64::from(byte % 128) << (7 * group);
        if byte < 128 {
            return u32::try_from(value).map_err(|_| "15.2: varint".into());
        }
    }
    Err("15.2: varint".into())
}

/// 15.5
fn open_slice(
    header: &Header,
    patches: &HashMap<u32, Vec<u8>>,
    mirror: &[Buffer; 3],
    instance: u32,
    patch: u32,
    first: u32,
) -> Result<Slice, String> {
    let placed = |grid: &&Vec<u8>| u32_at(grid, 44) > 0;
    let grid = mirror[0]
        .get(&instance)
        .filter(placed)
        .ok_or("15.5: instance")?;
    let data = patches.get(&patch).ok_or("15.5: no such patch")?;
    let level = u32_at(grid, 60);
    let mut points = read_patch(data)?;
    points.retain(|point| u32::from(point.level) >= level);
    let numbers = u64::from(first)..u64::from(first) + points.len() as u64;
    if points.is_empty() {
        return Err("15.5: no points of the level".into());
    }
    if numbers.end > u64::from(header.points) {
        return Err("15.5: beyond the points".into());
    }
    let placed: Vec<_> = points
        .iter()
        .map(|point| (point.position, point.normal))
        .collect();
    let (earlier, later) = neighbours(&placed);
    Ok(Slice {
        instance,
        numbers,
        shown: vec![false; points.len().div_ceil(16)],
        points: points
            .iter()
            .map(|point| Point {
                bin: bin(point, grid),
                place: None,
                occlusion: 255,
                last: 0,
            })
            .collect(),
        earlier,
        later,
    })
}

/// 15.3, 9.3, 7.8: a point's bucket, key and packed self.
fn bin(point: &PatchPoint, grid: &[u8]) -> Option<(u32, u32, u32)> {
    let m = [65536, 46341, 32768, 23170][u32_at(grid, 60) as usize];
    let bins = point
        .position
        .map(|position| ((2 * u64::from(position) + 1) * m) >> 17);
    let cell = bins.map(|bin| (bin >> 5) as u32);
    let dims = [32, 36, 40].map(|at| u32_at(grid, at));
    if (0..3).any(|axis| cell[axis] >= dims[axis]) {
        return None;
    }
    let [x, y, z] = cell;
    let row = dims[0];
    let layer = row.wrapping_mul(dims[1]);
    let combine = |by_y: u32, by_z: u32| {
        let rows = y.wrapping_mul(row).wrapping_mul(by_y);
        x.wrapping_add(rows)
            .wrapping_add(z.wrapping_mul(layer).wrapping_mul(by_z))
    };
    let bucket = u32_at(grid, 28) + combine(17, 31) % u32_at(grid, 44);
    let place = bins.map(|bin| (bin & 31) as u32);
    let packed = 1 << 31 | place[2] << 26 | place[1] << 21 | place[0] << 16;
    Some((bucket, combine(1, 1), packed | u32::from(point.normal) << 8))
}

/// 15.3: a point of a patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatchPoint {
    pub position: [u32; 3],
    pub normal: u8,
    pub level: u8,
}

/// 15.6: all points of a patch.
pub fn read_patch(data: &[u8]) -> Result<Vec<PatchPoint>, String> {
    let (mut patch, count, bits, _) = begin_patch(data)?;
    patch.read_part(count, 0, [0; 3], bits)?;
    patch.coder.check_end()?;
    Ok(patch.points)
}

/// A patch of the same decisions, up to the one where it is refused if it is, with the right end:
/// what is wrong with it is then not its end. `None` if not even its corner can be read.
pub fn patch_with_right_end(data: &[u8]) -> Option<Vec<u8>> {
    let (mut patch, count, bits, start) = begin_patch(data).ok()?;
    let _ = patch.read_part(count, 0, [0; 3], bits);
    Some([&data[..start], &patch.coder.with_right_end()].concat())
}

/// What comes before the decisions: the number of points, their bits, and how many bytes it is.
fn begin_patch(data: &[u8]) -> Result<(Patch<'_>, u32, [u32; 3], usize), String> {
    let mut at = 0;
    let count = varint(data, &mut at)?;
    let corner = [
        varint(data, &mut at)?,
        varint(data, &mut at)?,
        varint(data, &mut at)?,
    ];
    let bytes = data.get(at..at + 4).ok_or("15.6: length")?;
    let bits = [bytes[0], bytes[1], bytes[2]].map(u32::from);
    let (highest, coarse) = (usize::from(bytes[3] % 4), u32::from(bytes[3] / 4));
    if !(1..=1024).contains(&count)
        || corner.iter().any(|corner| *corner >= 1 << 25)
        || bits.iter().any(|bits| *bits > 25)
        || coarse > 4
        || corner.iter().any(|corner| corner % (1 << coarse) != 0)
    {
        return Err("15.6: points, corner, bits or form".into());
    }
    // The axis that gives a bit at each depth.
    let mut order = Vec::new();
    let mut left = bits;
    while left != [0; 3] {
        let most = *left.iter().max().expect("three axes");
        let axis = left
            .iter()
            .position(|left| *left == most)
            .expect("one has the most");
        left[axis] -= 1;
        order.push(axis);
    }
    let patch = Patch {
        coder: Coder::new(&data[at + 4..]),
        odds: PATCH_TABLES.clone(),
        state: vec![0; order.len()],
        order,
        corner,
        highest,
        coarse,
        points: Vec::new(),
        offsets: Vec::new(),
        before: [7; 2],
        other: [7; 2],
        same: true,
        distance_bits: 0,
    };
    Ok((patch, count, bits, at + 4))
}

/// A patch that is being read.
struct Patch<'a> {
    coder: Coder<'a>,
    odds: Tables<Odds>,
    order: Vec<usize>,
    /// Of each depth.
    state: Vec<usize>,
    corner: [u32; 3],
    /// The form: the highest level, and how many lowest bits are known along the surface.
    highest: usize,
    coarse: u32,
    points: Vec<PatchPoint>,
    offsets: Vec<[i64; 3]>,
    /// Normals: of the point before, and the last one that was another.
    before: [u8; 2],
    other: [u8; 2],
    /// Whether the point before had the normal of the one before it.
    same: bool,
    /// At the last point that had a distance.
    distance_bits: usize,
}

impl Patch<'_> {
    fn decide(&mut self, name: &str, row: usize, column: usize) -> bool {
        let rows = self.odds.get_mut(name).expect(name);
        self.coder.decide(&mut rows[row][column])
    }

    /// 15.6: a number less than `limit`.
    fn less_than(&mut self, limit: u32, name: &str, row: usize) -> u32 {
        let (mut low, mut high) = (0, limit);
        while high - low > 1 {
            let middle = (low + high) / 2;
            if self.decide(name, row, middle as usize - 1) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    }

    /// Plain bits, as many as one likes: those above the lowest 16 first.
    fn plain(&mut self, bits: u32) -> u32 {
        if bits > 16 {
            let above = self.coder.plain(bits - 16);
            return above << 16 | self.coder.plain(16);
        }
        self.coder.plain(bits)
    }

    /// A part of `count` points, whose offsets begin with the bits of `known`, and have `left`
    /// more along each axis.
    fn read_part(
        &mut self,
        count: u32,
        depth: usize,
        known: [u32; 3],
        mut left: [u32; 3],
    ) -> Result<(), String> {
        if count == 1 || depth == self.order.len() {
            for _ in 0..count {
                self.read_point(known, left)?;
            }
            return Ok(());
        }
        let axis = self.order[depth];
        left[axis] -= 1;
        let class = match count {
            2 => 0,
            3 | 4 => 1,
            _ => 2,
        };
        let state = self.state[depth];
        let below = if !self.decide("both", left[axis] as usize, 4 * class + state) {
            let above = self.decide("above", 0, state);
            self.state[depth] = if above { 3 } else { 2 };
            if above { 0 } else { count }
        } else {
            self.state[depth] = 1;
            if count == 2 {
                1
            } else if count <= 16 {
                1 + self.less_than(count - 1, "few", count as usize - 3)
            } else {
                let s = self.less_than(16, "many", 0);
                let bits = 32 - (count / 16).leading_zeros();
                let below = (s * count).div_ceil(16) + self.plain(bits);
                if below < 1 || below >= count {
                    return Err("15.6: below".into());
                }
                below
            }
        };
        if below > 0 {
            self.read_part(below, depth + 1, known, left)?;
        }
        if below < count {
            let mut upper = known;
            upper[axis] |= 1 << left[axis];
            self.read_part(count - below, depth + 1, upper, left)?;
        }
        Ok(())
    }

    /// 15.7
    fn read_point(&mut self, known: [u32; 3], left: [u32; 3]) -> Result<(), String> {
        let row = self
            .points
            .last()
            .map_or(0, |point| usize::from(point.level));
        let mut level = 0;
        while level < self.highest && self.decide("level", row, level) {
            level += 1;
        }
        let normal = self.read_normal()?;

        let step = normal_steps(normal);
        let largest = step
            .iter()
            .map(|step| step.abs())
            .max()
            .expect("three axes");
        let across = step
            .iter()
            .position(|s| s.abs() == largest)
            .expect("one is the largest");
        let others: Vec<usize> = (0..3).filter(|axis| *axis != across).collect();
        let mut offset = known.map(i64::from);
        let bits = [0, 1].map(|i| left[others[i]].saturating_sub(self.coarse));
        let numbers = if bits[0] + bits[1] <= 16 {
            let both = self.plain(bits[0] + bits[1]);
            [both >> bits[1], both % (1 << bits[1])]
        } else {
            [self.plain(bits[0]), self.plain(bits[1])]
        };
        for (axis, number) in others.iter().zip(numbers) {
            let known = [0, 1, 2, 4, 8][self.coarse as usize] % (1i64 << left[*axis]);
            offset[*axis] += (i64::from(number) << self.coarse) + known;
        }
        if left[across] > 0 {
            let low = offset[across];
            let high = low + (1 << left[across]) - 1;
            let mut nearest: Option<(i64, [i64; 3])> = None;
            for (that, point) in self.offsets.iter().zip(&self.points).rev().take(8) {
                let apart: i64 = others.iter().map(|&a| (offset[a] - that[a]).abs()).sum();
                let far = apart + if point.normal == normal { 0 } else { 64 };
                if nearest.is_none_or(|(least, _)| far < least) {
                    nearest = Some((far, *that));
                }
            }
            let c = step[across];
            let predicted = nearest.map_or(0, |(_, that)| {
                let e: i64 = others
                    .iter()
                    .map(|&a| (offset[a] - that[a]) * step[a])
                    .sum();
                that[across] - (2 * e * c.signum() + c.abs()).div_euclid(2 * c.abs())
            });
            let predicted = predicted.clamp(low, high);
            let alone = step.iter().filter(|step| **step != 0).count() == 1;
            let row = 2 * self.distance_bits.min(3) + usize::from(alone);
            let mut bits = 0;
            while bits < 27 && self.decide("across", row, bits) {
                bits += 1;
            }
            self.distance_bits = bits;
            offset[across] = predicted;
            if bits > 0 {
                let distance = 1 << (bits - 1) | i64::from(self.plain(bits as u32 - 1));
                let above = if predicted == low {
                    true
                } else if predicted == high {
                    false
                } else {
                    self.decide("up", 0, 0)
                };
                offset[across] += if above { distance } else { -distance };
            }
            if !(low..=high).contains(&offset[across]) {
                return Err("15.7: offset".into());
            }
        }
        let position = [0, 1, 2].map(|axis| self.corner[axis] + offset[axis] as u32);
        if position.iter().any(|position| *position >= 1 << 25) {
            return Err("15.6: position".into());
        }
        self.offsets.push(offset);
        self.points.push(PatchPoint {
            position,
            normal,
            level: level as u8,
        });
        Ok(())
    }

    /// 15.7
    fn read_normal(&mut self) -> Result<u8, String> {
        self.same = self.decide("same", 0, usize::from(!self.same));
        let mut normal = self.before;
        if !self.same {
            let so_far = self.other;
            self.other = self.before;
            if self.decide("again", 0, 0) {
                normal = so_far;
            } else {
                let mut differed = 0;
                for axis in 0..2 {
                    if !self.decide("some", 0, axis + differed) {
                        continue;
                    }
                    differed = 1;
                    let less = self.decide("down", 0, axis);
                    let mut amount = 1;
                    while amount < 14 && self.decide("more", axis, (amount - 1).min(5)) {
                        amount += 1;
                    }
                    let code = i64::from(normal[axis]);
                    let code = code + amount as i64 * if less { -1 } else { 1 };
                    if !(0..=14).contains(&code) {
                        return Err("15.7: normal".into());
                    }
                    normal[axis] = code as u8;
                }
            }
        }
        self.before = normal;
        Ok(normal[0] + 16 * normal[1])
    }
}

/// 15.10: earlier and later neighbours of points, each a position and a normal's code.
pub fn neighbours(points: &[([u32; 3], u8)]) -> (Vec<Vec<usize>>, Vec<Vec<usize>>) {
    let most = u64::from(u32::MAX);
    let normals: Vec<[i64; 3]> = (0..=255).map(normal_steps).collect();
    let distance = |a: usize, b: usize| {
        let (p, q) = (points[a], points[b]);
        let mut s = 0;
        let mut dot = 0;
        for axis in 0..3 {
            s += u64::from(p.0[axis].abs_diff(q.0[axis]).min(16384)).pow(2);
            dot += normals[usize::from(p.1)][axis] * normals[usize::from(q.1)][axis];
        }
        let turned = if p.1 == q.1 {
            0
        } else {
            (16129 - dot).max(0) >> 6
        };
        let t = turned as u64;
        s + (2 * t + ((s * t) >> 5).min(most)).min(most)
    };
    let nearest = |at: usize, others: Vec<usize>| {
        let mut found = Vec::new();
        for other in others {
            let far = distance(at, other);
            if far < most {
                found.push((far, at.abs_diff(other), other));
            }
        }
        found.sort();
        found
            .into_iter()
            .take(2)
            .map(|(_, _, other)| other)
            .collect()
    };
    let (mut earlier, mut later) = (Vec::new(), Vec::new());
    for at in 0..points.len() {
        earlier.push(nearest(at, (at.saturating_sub(24)..at).collect()));
        let end = (at + 25).min(points.len());
        later.push(nearest(at, (at + 1..end).collect()));
    }
    (earlier, later)
}

/// 15.10: a normal in steps.
pub fn normal_steps(code: u8) -> [i64; 3] {
    let a = i64::from(code % 16).min(14) - 7;
    let b = i64::from(code / 16).min(14) - 7;
    let c = 7 - a.abs() - b.abs();
    let vector = if c >= 0 {
        [a, b, c]
    } else {
        let p = if a < 0 { b.abs() - 7 } else { 7 - b.abs() };
        let q = if b < 0 { a.abs() - 7 } else { 7 - a.abs() };
        [p, q, c]
    };
    let squared: i64 = vector.iter().map(|v| v * v).sum();
    vector.map(|component| {
        let mut m = 0;
        while (m + 1) * (m + 1) * squared <= (127 * component) * (127 * component) {
            m += 1;
        }
        m * component.signum()
    })
}

/// 15.9: fast and slow.
#[derive(Clone, Copy)]
struct Odds(u64, u64);

impl Odds {
    fn new(n: u64) -> Odds {
        Odds(256 * n, 256 * n)
    }

    fn learn(&mut self, yes: bool) {
        if yes {
            *self = Odds(65535 - self.0, 65535 - self.1);
        }
        *self = Odds(self.0 - (self.0 >> 5), self.1 - (self.1 >> 7));
        if yes {
            *self = Odds(65535 - self.0, 65535 - self.1);
        }
    }
}

/// 15.9
struct Coder<'a> {
    data: &'a [u8],
    taken: usize,
    code: u64,
    range: u64,
}

impl Coder<'_> {
    fn new(data: &[u8]) -> Coder<'_> {
        Coder {
            data,
            taken: 8,
            code: number(data, 0, 8),
            range: u64::MAX,
        }
    }

    fn decide(&mut self, odds: &mut Odds) -> bool {
        let yes = self.decide_known((odds.0 + odds.1) >> 1);
        odds.learn(yes);
        yes
    }

    /// 15.11
    fn decide_known(&mut self, odds: u64) -> bool {
        let bound = (self.range >> 16) * odds;
        let yes = self.code < bound;
        if yes {
            self.range = bound;
        } else {
            self.code = self.code.wrapping_sub(bound);
            self.range -= bound;
        }
        self.refill();
        yes
    }

    /// 15.11
    fn symbol(&mut self, row: &[u64]) -> usize {
        let p = self.range >> 16;
        let symbol = row.iter().take_while(|n| self.code >= p * **n).count();
        let start = if symbol == 0 { 0 } else { p * row[symbol - 1] };
        let end = row.get(symbol).map_or(self.range, |n| p * n);
        self.code = self.code.wrapping_sub(start);
        self.range = end - start;
        self.refill();
        symbol
    }

    fn plain(&mut self, bits: u32) -> u32 {
        if bits == 0 {
            return 0;
        }
        self.range >>= bits;
        let number = (self.code / self.range).min((1 << bits) - 1);
        self.code = self.code.wrapping_sub(number * self.range);
        self.refill();
        number as u32
    }

    fn refill(&mut self) {
        if self.range < 1 << 32 {
            self.code = (self.code << 32) + number(self.data, self.taken, 4);
            self.taken += 4;
            self.range <<= 32;
        }
    }

    /// What is taken from the interval's lower end on, that end, the number that the data end
    /// with, and how many bytes of it count.
    fn end(&self) -> (u64, u64, u64, usize) {
        let v = number(self.data, self.taken - 8, 8);
        let low = v.wrapping_sub(self.code);
        for k in 0..=8 {
            let multiple = 1u128 << (64 - 8 * k);
            let n = (u128::from(low).div_ceil(multiple) * multiple) as u64;
            if n.wrapping_sub(low) < self.range {
                return (v, low, n, k);
            }
        }
        unreachable!("with k = 8, n is low")
    }

    fn check_end(&self) -> Result<(), String> {
        let (v, _, n, k) = self.end();
        if n == v && self.data.len() == self.taken - 8 + k {
            Ok(())
        } else {
            Err("15.9: end of the data".into())
        }
    }

    /// Data of the same decisions as were read, and with the right end.
    fn with_right_end(&self) -> Vec<u8> {
        let (v, low, n, k) = self.end();
        let before = 0..self.taken - 8;
        let mut bytes: Vec<u8> = before.map(|at| number(self.data, at, 1) as u8).collect();
        let mut last = bytes.len();
        while v < low && last > 0 {
            // The interval begins below the last of these numbers.
            last -= 1;
            bytes[last] = bytes[last].wrapping_sub(1);
            if bytes[last] != 255 {
                break;
            }
        }
        let mut last = bytes.len();
        while n < low && last > 0 {
            last -= 1;
            bytes[last] = bytes[last].wrapping_add(1);
            if bytes[last] != 0 {
                break;
            }
        }
        bytes.extend(&n.to_be_bytes()[..k]);
        bytes
    }
}

/// Big-endian, zeros behind the end.
fn number(data: &[u8], at: usize, bytes: usize) -> u64 {
    (at..at + bytes).fold(0, |n, at| {
        n << 8 | u64::from(data.get(at).copied().unwrap_or(0))
    })
}

/// Tables out of the document itself: rows by their names.
type Tables<T> = HashMap<String, Vec<Vec<T>>>;

fn tables<T>(title: &str, number: fn(u64) -> T) -> Tables<T> {
    let document = include_str!("../docs/format.md");
    let (_, rest) = document.split_once(&format!("```{title}\n")).expect(title);
    let (lines, _) = rest.split_once("```").expect("the table ends");
    let mut tables = Tables::new();
    for line in lines.lines() {
        let mut words = line.split_whitespace();
        let name = words.next().expect("a row has a name");
        let row = words.map(|n| number(n.parse().unwrap())).collect();
        tables.entry(name.into()).or_default().push(row);
    }
    tables
}

/// 15.11: of later items, and of items that open; 15.6: of patches.
static LATER: LazyLock<Tables<u64>> = LazyLock::new(|| tables("odds later items", |n| n));
static OPENING: LazyLock<Tables<u64>> = LazyLock::new(|| tables("odds items that open", |n| n));
static PATCH_TABLES: LazyLock<Tables<Odds>> = LazyLock::new(|| tables("odds patches", Odds::new));

/// What 15.12 keeps of a point during an item.
#[derive(Clone, Copy)]
struct Moving {
    weight: i64,
    activity: i64,
}

/// 15.12, 15.13
fn decode(data: &[u8], opens: bool, step: i64, slice: &mut Slice) -> Result<(), String> {
    let mut coder = Coder::new(data);
    let tables = if opens { &OPENING } else { &LATER };
    let of_step = step.min(4) as usize - 1;
    let points = &mut slice.points;
    let mut moving: Vec<Moving> = points
        .iter()
        .map(|point| Moving {
            weight: 8 * point.last,
            activity: point.last.abs(),
        })
        .collect();
    let (mut moved_before, mut moved_before_that) = (0, 0);
    let mut coded = vec![false; points.len()];
    for start in (0..points.len()).step_by(16) {
        let block = start..(start + 16).min(points.len());
        let changed = block.clone().filter(|&at| points[at].last != 0).count();
        let rests = changed == 0;
        let column = match changed {
            0..=2 => changed,
            3..=5 => 3,
            _ => 4,
        };
        let before = moved_before + 2 * moved_before_that;
        let odds = if opens {
            tables["block"][0][before]
        } else {
            tables["block"][4 * of_step + before][column]
        };
        let moves = coder.decide_known(odds);
        moved_before_that = moved_before;
        moved_before = usize::from(moves);
        if !moves {
            for at in block {
                moving[at] = Moving {
                    weight: 0,
                    activity: 0,
                };
                points[at].last = 0;
            }
            continue;
        }
        coded[block.clone()].fill(true);
        for at in block {
            let nearby = slice.earlier[at].iter().copied();
            let mut around: Vec<i64> = nearby
                .filter(|&other| coded[other])
                .map(|other| points[other].last)
                .collect();
            if around.is_empty() && at > start {
                around.push(points[at - 1].last);
            }
            let or_itself = |found: &[usize]| [0, 1].map(|i| *found.get(i).unwrap_or(&at));
            let point = &mut points[at];
            let earlier = or_itself(&slice.earlier[at]);
            if opens {
                let [a, b] = earlier.map(|other| moving[other].weight);
                let dark = (a + b + 1) >> 1;
                let predicted = 255 - dark;
                let bits = |number: i64| (64 - number.leading_zeros()) as usize;
                let row = 9 * bits((a - b).abs() >> 1) + bits(dark);
                let steps = -steps(&mut coder, &tables["steps"][row]);
                point.occlusion = (predicted + steps).clamp(0, 255);
                moving[at] = Moving {
                    weight: 255 - point.occlusion,
                    activity: 0,
                };
                continue;
            }
            let later = or_itself(&slice.later[at]);
            let all = || earlier.iter().chain(&later);
            let mut sum = all().map(|&other| moving[other].weight).sum::<i64>() + 7 * point.last;
            let activity: i64 = all().map(|&other| moving[other].activity).sum();
            let mut activity = activity + 2 * point.last.abs();
            if let (true, Some((a, b))) = (rests, around.first().zip(around.last()))
                && a.abs().max(b.abs()) >= 5
            {
                sum = 31 * (a + b);
                activity = a.abs() + b.abs() + 4 * (a - b).abs();
            }
            let change = (sum + 32).div_euclid(64);
            let predicted = (point.occlusion + change).clamp(0, 255);
            let (way, lies) = match predicted {
                0 => (1, 2),
                255 => (-1, 2),
                _ => {
                    let way = if sum < 0 { -1 } else { 1 };
                    (way, usize::from((sum - 64 * change) * way >= 0))
                }
            };
            let starts = [1, 3, 5, 7, 10, 14, 20, 28, 40, 60, 91];
            let kind = starts.iter().filter(|start| **start <= activity).count();
            let row = 36 * of_step + 3 * kind + lies;
            let steps = way * steps(&mut coder, &tables["steps"][row]);
            let becomes = (predicted + steps * step).clamp(0, 255);
            let now = (becomes - point.occlusion).clamp(-127, 127);
            point.occlusion = becomes;
            moving[at] = Moving {
                weight: 17 * now,
                activity: 2 * now.abs(),
            };
            point.last = now;
        }
    }
    coder.check_end()
}

/// 15.14
fn steps(coder: &mut Coder<'_>, row: &[u64]) -> i64 {
    let symbol = coder.symbol(row) as u32;
    match symbol {
        0 => 0,
        1..=8 if symbol % 2 == 1 => i64::from(symbol / 2 + 1),
        1..=8 => -i64::from(symbol / 2),
        _ => {
            let bits = symbol - 8;
            let rest = i64::from(coder.plain(bits + 1));
            let magnitude = 3 + (1 << bits) + (rest >> 1);
            if rest & 1 == 1 { -magnitude } else { magnitude }
        }
    }
}

/// Section 8.
fn hash(mirror: &[Buffer; 3]) -> u64 {
    let mut sum = 0u64;
    for (kind, buffer) in mirror.iter().enumerate() {
        for (index, bytes) in buffer {
            for word in 0..bytes.len() / 4 {
                let name = (kind as u64 + 1) << 56 | u64::from(*index) << 8 | word as u64;
                let part = u64::from(u32_at(bytes, 4 * word)).wrapping_mul(mix(name) | 1);
                sum = sum.wrapping_add(part);
            }
        }
    }
    sum
}

fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58476D1CE4E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D049BB133111EB);
    x ^ (x >> 31)
}

/// 2.8
pub fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = !0u32;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            let carry = crc & 1;
            crc >>= 1;
            if carry == 1 {
                crc ^= 0xEDB88320; // 0x04C11DB7, reflected
            }
        }
    }
    !crc
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(u32_at(bytes, at))
}
