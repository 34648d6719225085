//! A second reader of streams of the profile `cells`, written from `docs/format.md` alone: slow,
//! obvious, and sharing no code with the SDK. What both say of the same bytes must be the same.

use std::collections::HashMap;

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
    lengths: [u32; 3],
    max_body_bytes: u32,
    max_raw_bytes: u32,
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
            2 => 0b11,
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
            2 => {
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
                    in_snapshot = true;
                }
                if !live && !in_snapshot {
                    continue; // 5.6: withheld
                }
                apply(&body[24..], raw_bytes, header.lengths, &mut mirror)?;
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
    if body.len() < 52 || u16_at(body, 0) != 1 {
        return Err("4.2: length or version".into());
    }
    let (profile, kernel, points, entries) = (body[4], body[5], body[6], body[7]);
    if profile != 0 || kernel > 1 || points != 7 || entries != 8 {
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
    if body[49..52] != [0; 3] {
        return Err("4.1: reserved".into());
    }
    if lengths.iter().zip(room).any(|(need, have)| *need > have) {
        return Err("4.3: room".into());
    }
    Ok(Header {
        lengths,
        max_body_bytes,
        max_raw_bytes,
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
