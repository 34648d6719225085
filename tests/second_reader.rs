//! A second reader of streams, written from `docs/format.md` alone: slow, obvious, and sharing no
//! code with the SDK. What both say of the same bytes must be the same.

use std::collections::HashMap;
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

struct Header {
    residual: bool,
    lengths: [u32; 3],
    max_body_bytes: u32,
    max_raw_bytes: u32,
    step: u8,
    slices: u32,
    points: u32,
}

/// Reads all of `bytes` with room for `room` instances, buckets and cells.
pub fn read(bytes: &[u8], room: [u32; 3]) -> Read {
    let mut read = Read::default();
    if let Err(error) = read_stream(bytes, room, &mut read) {
        read.error = Some(error);
    }
    read
}

fn read_stream(bytes: &[u8], room: [u32; 3], out: &mut Read) -> Result<(), String> {
    // 2.2
    let preamble = [0x89, 0x50, 0x53, 0x41, 0x4f, 0x0d, 0x0a, 0x1a];
    let begin = bytes.len().min(8);
    if bytes[..begin] != preamble[..begin] {
        return Err("2.2: preamble".into());
    }
    let mut at = begin;
    let mut header: Option<Header> = None;
    let mut sequence = 0u32;
    let mut last_id: Option<u32> = None;
    let mut open: Option<(u32, u64)> = None;
    let mut live = false;
    let mut in_snapshot = false;
    let mut mirror: [Buffer; 3] = Default::default();
    let mut open_slices: HashMap<u32, Slice> = HashMap::new();

    while at < bytes.len() {
        if out.ended {
            return Err("3.2: bytes behind the end".into());
        }
        // 2.3
        if at + 16 > bytes.len() {
            return Ok(());
        }
        let (kind, flags) = (bytes[at], bytes[at + 1]);
        let reserved = u16_at(bytes, at + 2);
        let body_bytes = u32_at(bytes, at + 4);
        let limit = header.as_ref().map_or(4096, |h| h.max_body_bytes);
        if body_bytes > limit {
            return Err("2.4: body_bytes".into());
        }
        let end = at + 16 + body_bytes as usize;
        if end > bytes.len() {
            return Ok(());
        }
        let body = &bytes[at + 16..end];
        let covered = [&bytes[at..at + 12], body].concat();
        if crc32(&covered) != u32_at(bytes, at + 12) {
            return Err("2.8: checksum".into());
        }
        if reserved != 0 {
            return Err("2.3: reserved".into());
        }
        if u32_at(bytes, at + 8) != sequence {
            return Err("2.7: sequence".into());
        }
        sequence = sequence.wrapping_add(1);
        at = end;

        // 2.6
        let allowed = match kind {
            2 | 5 => 0b11,
            1 | 3 | 4 => 0,
            _ => 0xff,
        };
        if flags & !allowed != 0 {
            return Err("2.6: flags".into());
        }
        match kind {
            1 if header.is_none() => header = Some(read_header(body, room)?),
            4 if header.is_none() => return Err("3.4: refused".into()),
            _ if header.is_none() => return Err("3.2: no header".into()),
            1 | 4 => return Err("3.2: after the header".into()),
            5 if !header.as_ref().is_some_and(|h| h.residual) => {
                return Err("3.2: slices in profile cells".into());
            }
            2 | 5 => {
                // 5.1
                if body.len() < 24 {
                    return Err("5.1: length".into());
                }
                let (id, time_ns) = (u32_at(body, 0), u64_at(body, 4));
                let (mirror_hash, raw_bytes) = (u64_at(body, 12), u32_at(body, 20));
                let (snapshot, last) = (flags & 1 != 0, flags & 2 != 0);
                let header = header.as_ref().expect("checked above");
                if raw_bytes > header.max_raw_bytes {
                    return Err("5.1: raw_bytes".into());
                }
                if !last && mirror_hash != 0 {
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
                    open_slices.clear();
                    in_snapshot = true;
                }
                if !live && !in_snapshot {
                    continue; // 5.6: withheld
                }
                if kind == 2 {
                    apply(&body[24..], raw_bytes, header.lengths, &mut mirror)?;
                } else {
                    if body.len() - 24 != raw_bytes as usize {
                        return Err("15.2: raw_bytes".into());
                    }
                    apply_items(&body[24..], header, &mut mirror, &mut open_slices)?;
                }
                if !last {
                    continue;
                }
                if hash(&mirror) == mirror_hash {
                    live = true;
                    out.shown.push(Shown {
                        id,
                        time_ns,
                        mirror_hash,
                        mirror: mirror.clone(),
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
fn read_header(body: &[u8], room: [u32; 3]) -> Result<Header, String> {
    if body.len() < 60 || u16_at(body, 0) != 1 {
        return Err("4.2: length or version".into());
    }
    let (profile, kernel, points, entries) = (body[4], body[5], body[6], body[7]);
    if profile > 1 || kernel > 1 || points != 7 || entries != 8 {
        return Err("4.1: profile, kernel or sizes".into());
    }
    let lengths = [u32_at(body, 16), u32_at(body, 20), u32_at(body, 24)];
    let (max_body_bytes, max_raw_bytes) = (u32_at(body, 28), u32_at(body, 32));
    if !(64..=1 << 22).contains(&max_body_bytes) || max_raw_bytes > 1 << 22 {
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
    let (step, slices, points) = (body[49], u32_at(body, 52), u32_at(body, 56));
    let places = 7 * u64::from(lengths[2]);
    if profile == 0 && (step, slices, points) != (0, 0, 0) {
        return Err("4.1: fields of the other profile".into());
    }
    if profile == 1 && (step == 0 || slices > lengths[2] || u64::from(points) > places) {
        return Err("4.1: step, slices or points".into());
    }
    if lengths.iter().zip(room).any(|(need, have)| *need > have) {
        return Err("4.3: room".into());
    }
    Ok(Header {
        residual: profile == 1,
        lengths,
        max_body_bytes,
        max_raw_bytes,
        step,
        slices,
        points,
    })
}

/// Section 6.
fn apply(
    compressed: &[u8],
    raw_bytes: u32,
    lengths: [u32; 3],
    mirror: &mut [Buffer; 3],
) -> Result<(), String> {
    if raw_bytes == 0 {
        return if compressed.is_empty() {
            Ok(())
        } else {
            Err("6.1: content".into())
        };
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
                0 => check_instance(value, lengths)?,
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
        && u32_at(value, 60) == 0;
    if good {
        Ok(())
    } else {
        Err("7.4: instance".into())
    }
}

/// 15.3: a slice that was opened.
struct Slice {
    /// The cell of each point, and its place in it.
    places: Vec<(u32, usize)>,
    cells: std::ops::Range<u32>,
    earlier: Vec<Vec<usize>>,
    later: Vec<Vec<usize>>,
    last: Vec<i64>,
}

/// 15.2 to 15.4
fn apply_items(
    content: &[u8],
    header: &Header,
    mirror: &mut [Buffer; 3],
    slices: &mut HashMap<u32, Slice>,
) -> Result<(), String> {
    let mut at = 0;
    let mut next = 0u64;
    while at < content.len() {
        let head = varint(content, &mut at)?;
        let index = next + u64::from(head / 2);
        next = index + 1;
        if next > u64::from(u32::MAX) {
            return Err("6.3: index".into());
        }
        let (index, opens) = (index as u32, head % 2 == 1);
        if opens {
            let instance = varint(content, &mut at)?;
            let first = varint(content, &mut at)?;
            let count = varint(content, &mut at)?;
            if index >= header.slices || slices.contains_key(&index) {
                return Err("15.3: index".into());
            }
            let slice = open_slice(header, mirror, instance, first, count)?;
            let used: usize = slices.values().map(|slice| slice.places.len()).sum();
            if used + slice.places.len() > header.points as usize {
                return Err("15.3: points in all".into());
            }
            slices.insert(index, slice);
        }
        let length = varint(content, &mut at)? as usize;
        if length > content.len() - at {
            return Err("15.2: length".into());
        }
        let data = &content[at..at + length];
        at += length;
        let slice = slices.get_mut(&index).ok_or("15.3: not open")?;
        // 15.4
        if places(&mirror[2], slice.cells.clone()).len() != slice.places.len() {
            return Err("15.4: other points".into());
        }
        slice.places = places(&mirror[2], slice.cells.clone());
        let mut occlusion = Vec::new();
        for (cell, place) in &slice.places {
            occlusion.push(i64::from(mirror[2][cell][4 + 4 * place]));
        }
        let step = if opens { 1 } else { i64::from(header.step) };
        decode(data, opens, step, &mut occlusion, slice)?;
        for ((cell, place), value) in slice.places.iter().zip(occlusion) {
            let bytes = mirror[2].get_mut(cell).expect("its point was just read");
            bytes[4 + 4 * place] = value as u8;
        }
    }
    Ok(())
}

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

/// The points of a run of cells: cell and place.
fn places(cells: &Buffer, run: std::ops::Range<u32>) -> Vec<(u32, usize)> {
    let mut places = Vec::new();
    for index in run {
        let Some(cell) = cells.get(&index) else {
            continue;
        };
        for place in 0..7 {
            if u32_at(cell, 4 + 4 * place) >> 31 == 0 {
                break;
            }
            places.push((index, place));
        }
    }
    places
}

/// 15.3
fn open_slice(
    header: &Header,
    mirror: &[Buffer; 3],
    instance: u32,
    first: u32,
    count: u32,
) -> Result<Slice, String> {
    let grid = mirror[0].get(&instance).ok_or("15.3: instance")?;
    if u32_at(grid, 44) == 0 {
        return Err("15.3: instance without points".into());
    }
    let end = u64::from(first) + u64::from(count);
    if count == 0 || end > u64::from(header.lengths[2]) {
        return Err("15.3: cells".into());
    }
    let cells = first..end as u32;
    for index in cells.clone() {
        if places(&mirror[2], index..index + 1).is_empty() {
            return Err("15.3: a cell without points".into());
        }
    }
    let places = places(&mirror[2], cells.clone());
    if places.len() > 1024 {
        return Err("15.3: points of a slice".into());
    }
    // 15.6
    let mut points = Vec::new();
    for (cell, place) in &places {
        let cell = &mirror[2][cell];
        let (key, point) = (u32_at(cell, 0), u32_at(cell, 4 + 4 * place));
        let row = u32_at(grid, 32);
        let layer = row.wrapping_mul(u32_at(grid, 36)).max(1);
        let corner = [key % layer % row, key % layer / row, key / layer];
        let steps = [point >> 16 & 31, point >> 21 & 31, point >> 26 & 31];
        let place = [0, 1, 2].map(|axis| corner[axis].wrapping_mul(32).wrapping_add(steps[axis]));
        points.push((place, (point >> 8) as u8));
    }
    let (earlier, later) = neighbours(&points);
    Ok(Slice {
        last: vec![0; places.len()],
        places,
        cells,
        earlier,
        later,
    })
}

/// 15.6: earlier and later neighbours of points, each a place and a normal's code.
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
        let t = ((16129 - dot).max(0) >> 6) as u64;
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
            .take(3)
            .map(|(_, _, other)| other)
            .collect()
    };
    let (mut earlier, mut later) = (Vec::new(), Vec::new());
    for at in 0..points.len() {
        earlier.push(nearest(at, (at.saturating_sub(128)..at).collect()));
        let end = (at + 129).min(points.len());
        later.push(nearest(at, (at + 1..end).collect()));
    }
    (earlier, later)
}

/// 15.6: a normal in steps.
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

/// 15.5: fast and slow.
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

/// 15.5
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
        let bound = (self.range >> 16) * ((odds.0 + odds.1) >> 1);
        let yes = self.code < bound;
        odds.learn(yes);
        if yes {
            self.range = bound;
        } else {
            self.code = self.code.wrapping_sub(bound);
            self.range -= bound;
        }
        if self.range < 1 << 32 {
            self.code = (self.code << 32) + number(self.data, self.taken, 4);
            self.taken += 4;
            self.range <<= 32;
        }
        yes
    }

    fn check_end(&self) -> Result<(), String> {
        let s = self.taken - 8;
        let v = number(self.data, s, 8);
        let low = v.wrapping_sub(self.code);
        for k in 0..=8 {
            let multiple = 1u128 << (64 - 8 * k);
            let n = (u128::from(low).div_ceil(multiple) * multiple) as u64;
            if n.wrapping_sub(low) < self.range {
                return if n == v && self.data.len() == s + k {
                    Ok(())
                } else {
                    Err("15.5: end of the data".into())
                };
            }
        }
        unreachable!("with k = 8, n is low")
    }
}

/// Big-endian, zeros behind the end.
fn number(data: &[u8], at: usize, bytes: usize) -> u64 {
    (at..at + bytes).fold(0, |n, at| {
        n << 8 | u64::from(data.get(at).copied().unwrap_or(0))
    })
}

/// 15.7
#[derive(Clone)]
struct Tables {
    block: Vec<Vec<Odds>>,
    some: Vec<Vec<Odds>>,
    down: Vec<Vec<Odds>>,
    more: Vec<Vec<Odds>>,
}

impl Tables {
    /// Out of the document itself.
    fn named(title: &str) -> Tables {
        let document = include_str!("../docs/format.md");
        let (_, rest) = document.split_once(&format!("```{title}\n")).expect(title);
        let (table, _) = rest.split_once("```").expect("the table ends");
        let rows = |name: &str, count: usize, columns: usize| {
            let mut rows = Vec::new();
            for line in table.lines() {
                let mut words = line.split_whitespace();
                if words.next() == Some(name) {
                    let row: Vec<Odds> = words.map(|n| Odds::new(n.parse().unwrap())).collect();
                    assert_eq!(row.len(), columns, "{line}");
                    rows.push(row);
                }
            }
            assert_eq!(rows.len(), count, "{name}");
            rows
        };
        Tables {
            block: rows("block", 4, 5),
            some: rows("some", 12, 10),
            down: rows("down", 5, 4),
            more: rows("more", 14, 12),
        }
    }
}

/// Later items, and items that open.
static TABLES: LazyLock<[Tables; 2]> =
    LazyLock::new(|| ["odds later items", "odds items that open"].map(Tables::named));

/// 15.8, 15.9
fn decode(
    data: &[u8],
    opens: bool,
    step: i64,
    occlusion: &mut [i64],
    slice: &mut Slice,
) -> Result<(), String> {
    let count = occlusion.len();
    let mut coder = Coder::new(data);
    let mut tables = TABLES[usize::from(opens)].clone();
    let last = &mut slice.last;
    if opens {
        occlusion.fill(255);
        last.fill(0);
    }
    let mut weight: Vec<i64> = last.iter().map(|last| 7 * last).collect();
    let mut activity: Vec<i64> = last.iter().map(|last| last.abs()).collect();
    let (mut moved_before, mut moved_before_that) = (0, 0);
    for start in (0..count).step_by(16) {
        let block = start..(start + 16).min(count);
        let changed = block.clone().filter(|&at| last[at] != 0).count();
        let column = match changed {
            0..=2 => changed,
            3..=5 => 3,
            _ => 4,
        };
        let row = moved_before + 2 * moved_before_that;
        let moves = coder.decide(&mut tables.block[row][column]);
        moved_before_that = moved_before;
        moved_before = usize::from(moves);
        if !moves {
            for at in block {
                weight[at] = 3 * last[at];
                activity[at] = 0;
                last[at] = 0;
            }
            continue;
        }
        for at in block {
            let or_itself = |found: &[usize]| [0, 1, 2].map(|i| *found.get(i).unwrap_or(&at));
            let earlier = or_itself(&slice.earlier[at]);
            let later = or_itself(&slice.later[at]);
            if opens {
                let weights = earlier.map(|other| weight[other]);
                let dark = (weights.iter().sum::<i64>() * 85 + 128) >> 8;
                let predicted = 255 - dark;
                let spread = (weights.iter().max().unwrap() - weights.iter().min().unwrap()) >> 1;
                let a = earlier.map(|other| activity[other]).iter().sum();
                let steps = steps(&mut coder, &mut tables, predicted, a, spread, 0, 0);
                occlusion[at] = (predicted + steps * step).clamp(0, 255);
                weight[at] = 255 - occlusion[at];
                activity[at] = (occlusion[at] - predicted).abs();
                continue;
            }
            let all = || earlier.iter().chain(&later);
            let sum = all().map(|&other| weight[other]).sum::<i64>() + 32;
            let (change, rounding) = (sum.div_euclid(64), sum.rem_euclid(64));
            let predicted = (occlusion[at] + change).clamp(0, 255);
            let a = all().map(|&other| activity[other]).sum::<i64>() + 2 * last[at].abs();
            let s = change.abs();
            let steps = steps(&mut coder, &mut tables, predicted, a, s, change, rounding);
            let becomes = (predicted + steps * step).clamp(0, 255);
            let now = (becomes - occlusion[at]).clamp(-127, 127);
            occlusion[at] = becomes;
            weight[at] = 13 * now + 3 * last[at];
            activity[at] = 2 * now.abs();
            last[at] = now;
        }
    }
    coder.check_end()
}

/// 15.10
fn steps(
    coder: &mut Coder<'_>,
    tables: &mut Tables,
    predicted: i64,
    a: i64,
    s: i64,
    c: i64,
    r: i64,
) -> i64 {
    let starts = [1, 3, 5, 7, 10, 14, 20, 28, 40, 60, 91];
    let kind = starts.iter().filter(|start| **start <= a).count();
    let size = match s {
        0..=3 => s as usize,
        4 => 3,
        _ => 4,
    };
    let open = usize::from(predicted == 255);
    if !coder.decide(&mut tables.some[kind][2 * size + open]) {
        return 0;
    }
    let down = match predicted {
        0 => false,
        255 => true,
        _ => coder.decide(&mut tables.down[(c.clamp(-2, 2) + 2) as usize][(r >> 4) as usize]),
    };
    let mut magnitude = 1;
    for row in 0..14 {
        if !coder.decide(&mut tables.more[row][kind]) {
            return if down { -magnitude } else { magnitude };
        }
        magnitude += 1;
    }
    let mut rest = 0;
    for _ in 0..8 {
        rest = 2 * rest + i64::from(coder.decide(&mut Odds::new(128)));
    }
    magnitude += rest;
    if down { -magnitude } else { magnitude }
}

/// Section 8.
fn hash(mirror: &[Buffer; 3]) -> u64 {
    let mut sum = 0u64;
    for (kind, buffer) in mirror.iter().enumerate() {
        for (index, bytes) in buffer {
            let mut h = mix(((kind as u64 + 1) << 32) + u64::from(*index));
            for at in (0..bytes.len()).step_by(8) {
                h = mix(h ^ u64_at(bytes, at));
            }
            sum = sum.wrapping_add(h);
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
