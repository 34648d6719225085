//! The range coder: decisions and symbols as bytes, each at about its information.
//!
//! Encoder and decoder do the same integer arithmetic on the same probabilities, which are learnt
//! ([`Odds`]) or known. A coded run has exactly one right length and ending, which
//! [`Decoder::finish`] checks: bytes that are missing, left over or changed at the end are an
//! error.
#![deny(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects
)]

use crate::stream::StreamError;

/// Below this the interval is widened by 32 bits.
const NARROW: u64 = 1 << 32;

/// How likely a decision is a yes, learnt from those before: the mean of a fast and a slow
/// estimate, each in 1/65536.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Odds {
    fast: u16,
    slow: u16,
}

impl Odds {
    /// Weight of a new decision in the fast and the slow estimate: 1/2^shift.
    const SHIFTS: [u32; 2] = [5, 7];

    /// Starts with a yes in `yes`/256 of all cases; 1 to 255.
    pub const fn new(yes: u8) -> Odds {
        let start = (yes as u16) << 8;
        Odds {
            fast: start,
            slow: start,
        }
    }

    /// In 1/65536, never 0.
    fn yes(self) -> u16 {
        self.fast.midpoint(self.slow)
    }

    fn learn(&mut self, yes: bool) {
        let [fast, slow] = Self::SHIFTS;
        let flip = if yes { u16::MAX } else { 0 };
        // Toward 0 of the value or of its complement: neither end is ever reached.
        let less = |from: u16, shift: u32| {
            let from = from ^ flip;
            from.wrapping_sub(from >> shift) ^ flip
        };
        self.fast = less(self.fast, fast);
        self.slow = less(self.slow, slow);
    }
}

/// Odds of so many yeses in 256 cases each.
pub(crate) const fn odds<const N: usize>(starts: [u8; N]) -> [Odds; N] {
    let mut odds = [Odds::new(128); N];
    let mut at = 0;
    while at < N {
        #[allow(clippy::indexing_slicing, clippy::arithmetic_side_effects)]
        {
            odds[at] = Odds::new(starts[at]);
            at += 1;
        }
    }
    odds
}

/// The last bytes of a run: as few as name a number in the interval, read with zeros after them.
/// Returns that number, wrapped at 2^64 (a carry), and how many bytes of it count.
fn ending(low: u64, range: u64) -> (u64, usize) {
    let mut bytes = 0;
    let mut below = u64::MAX;
    loop {
        let number = low.wrapping_add(below) & !below;
        if number.wrapping_sub(low) < range || below == 0 {
            return (number, bytes);
        }
        bytes = bytes.saturating_add(1);
        below >>= 8;
    }
}

/// The output has no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

/// Writes decisions to a caller's buffer.
pub struct Encoder<'a> {
    out: &'a mut [u8],
    /// Bytes written, or that would have been had there been room.
    length: usize,
    low: u64,
    range: u64,
}

impl<'a> Encoder<'a> {
    /// Starts at the front of `out`.
    pub fn new(out: &'a mut [u8]) -> Encoder<'a> {
        Encoder {
            out,
            length: 0,
            low: 0,
            range: u64::MAX,
        }
    }

    /// Writes one decision.
    pub fn bit(&mut self, odds: &mut Odds, yes: bool) {
        self.decide(odds.yes(), yes);
        odds.learn(yes);
    }

    /// Writes one decision that is a yes in `odds`/65536 of all cases; 1 to 65535.
    #[inline(always)]
    pub fn decide(&mut self, odds: u16, yes: bool) {
        let bound = (self.range >> 16).wrapping_mul(u64::from(odds));
        if yes {
            self.range = bound;
        } else {
            self.add(bound);
            self.range = self.range.wrapping_sub(bound);
        }
        self.widen();
    }

    /// Writes one of `N` + 1 symbols. `below`: in how many of 65536 cases it is the first, one of
    /// the first two, of the first three, and so on: each more than the one before.
    #[inline]
    pub fn symbol<const N: usize>(&mut self, below: &[u16; N], symbol: usize) {
        let part = self.range >> 16;
        let start = symbol.checked_sub(1).and_then(|before| below.get(before));
        let start = start.map_or(0, |start| part.wrapping_mul(u64::from(*start)));
        let end = below.get(symbol);
        let end = end.map_or(self.range, |end| part.wrapping_mul(u64::from(*end)));
        self.add(start);
        self.range = end.wrapping_sub(start);
        self.widen();
    }

    /// Writes a number of `count` bits, 0 to 16, of which all are equally likely.
    pub fn bits(&mut self, count: u32, value: u32) {
        self.range >>= count;
        self.add(self.range.wrapping_mul(u64::from(value)));
        self.widen();
    }

    fn widen(&mut self) {
        if self.range < NARROW {
            self.put(4);
            self.low <<= 32;
            self.range <<= 32;
        }
    }

    /// Ends the run and says how many bytes it is.
    ///
    /// # Errors
    /// It had not enough room; the buffer's content is useless.
    pub fn finish(mut self) -> Result<usize, Full> {
        let (number, bytes) = ending(self.low, self.range);
        self.add(number.wrapping_sub(self.low));
        self.put(bytes);
        (self.length <= self.out.len())
            .then_some(self.length)
            .ok_or(Full)
    }

    /// Moves the interval up; a carry goes into what is written already.
    fn add(&mut self, by: u64) {
        let (low, carry) = self.low.overflowing_add(by);
        self.low = low;
        if carry {
            let written = self.out.get_mut(..self.length).unwrap_or_default();
            for byte in written.iter_mut().rev() {
                *byte = byte.wrapping_add(1);
                if *byte != 0 {
                    break;
                }
            }
        }
    }

    /// Writes the interval's upper bytes.
    fn put(&mut self, bytes: usize) {
        let upper = self.low.to_be_bytes();
        let end = self.length.saturating_add(bytes);
        let room = self.out.get_mut(self.length..end);
        if let (Some(room), Some(upper)) = (room, upper.get(..bytes)) {
            room.copy_from_slice(upper);
        }
        self.length = end;
    }
}

/// Reads decisions. Past the end it reads zeros: the caller's decisions are bounded in number, and
/// [`Decoder::finish`] tells.
pub struct Decoder<'a> {
    bytes: &'a [u8],
    /// Bytes taken in, zeros past the end included.
    taken: usize,
    /// The number read, relative to the interval.
    code: u64,
    range: u64,
}

impl<'a> Decoder<'a> {
    /// Starts at the front of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Decoder<'a> {
        Decoder {
            bytes,
            taken: 8,
            code: window(bytes, 0),
            range: u64::MAX,
        }
    }

    /// Reads one decision.
    #[inline(always)]
    pub fn bit(&mut self, odds: &mut Odds) -> bool {
        let yes = self.decide(odds.yes());
        odds.learn(yes);
        yes
    }

    /// Reads one decision that is a yes in `odds`/65536 of all cases.
    #[inline(always)]
    pub fn decide(&mut self, odds: u16) -> bool {
        let bound = (self.range >> 16).wrapping_mul(u64::from(odds));
        let yes = self.code < bound;
        if yes {
            self.range = bound;
        } else {
            self.code = self.code.wrapping_sub(bound);
            self.range = self.range.wrapping_sub(bound);
        }
        self.widen();
        yes
    }

    /// Reads one of `N` + 1 symbols; `below` as in [`Encoder::symbol`]. It looks for the first
    /// symbols first, so that these should be the usual ones.
    #[inline(always)]
    pub fn symbol<const N: usize>(&mut self, below: &[u16; N]) -> usize {
        let part = self.range >> 16;
        let mut start = 0;
        let mut symbol = 0usize;
        let mut end = self.range;
        for below in below {
            let bound = part.wrapping_mul(u64::from(*below));
            if self.code < bound {
                end = bound;
                break;
            }
            start = bound;
            symbol = symbol.wrapping_add(1);
        }
        self.code = self.code.wrapping_sub(start);
        self.range = end.wrapping_sub(start);
        self.widen();
        symbol
    }

    /// Reads a number of `count` bits, 0 to 16, of which all are equally likely.
    #[inline(always)]
    pub fn bits(&mut self, count: u32) -> u32 {
        self.range >>= count;
        // What the division leaves over belongs to the last number, though no encoder goes there.
        let last = (1u64 << count).wrapping_sub(1);
        let value = self.code.checked_div(self.range).unwrap_or(0).min(last);
        self.code = self.code.wrapping_sub(self.range.wrapping_mul(value));
        self.widen();
        value as u32
    }

    // Inlined, like its callers: what is called with the decoder keeps it out of registers.
    #[inline(always)]
    fn widen(&mut self) {
        if self.range < NARROW {
            let end = self.taken.saturating_add(4);
            let next = match self.bytes.get(self.taken..end) {
                Some(&[a, b, c, d]) => u32::from_be_bytes([a, b, c, d]),
                _ => (window(self.bytes, self.taken) >> 32) as u32,
            };
            self.taken = end;
            self.code = self.code << 32 | u64::from(next);
            self.range <<= 32;
        }
    }

    /// Checks that the bytes end where the decisions do, as the encoder would have ended them.
    ///
    /// # Errors
    /// [`StreamError::Length`]: bytes are missing, left over or changed. What was read is
    /// worthless.
    pub fn finish(self) -> Result<(), StreamError> {
        let start = self.taken.wrapping_sub(8);
        let low = window(self.bytes, start).wrapping_sub(self.code);
        let (number, bytes) = ending(low, self.range);
        let right = number.wrapping_sub(low) == self.code
            && self.bytes.len() == start.saturating_add(bytes);
        right.then_some(()).ok_or(StreamError::Length)
    }
}

/// Eight bytes from `at`, zeros past the end.
fn window(bytes: &[u8], at: usize) -> u64 {
    let rest = bytes.get(at..).unwrap_or_default();
    if let Some(eight) = rest.first_chunk() {
        return u64::from_be_bytes(*eight);
    }
    let mut eight = [0; 8];
    for (to, from) in eight.iter_mut().zip(rest) {
        *to = *from;
    }
    u64::from_be_bytes(eight)
}

#[cfg(test)]
#[allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::arithmetic_side_effects
)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec;
    use std::vec::Vec;

    /// Pseudo-random decisions: what is asked, and of which of eight odds.
    fn decisions(seed: u32, count: usize) -> Vec<(usize, bool)> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(747796405).wrapping_add(2891336453);
            state >> 16
        };
        (0..count)
            .map(|_| {
                let which = next() as usize % 8;
                (
                    which,
                    next() % 256 < [1, 20, 90, 128, 160, 230, 255, 256][which],
                )
            })
            .collect()
    }

    fn encode(decisions: &[(usize, bool)], out: &mut [u8]) -> Result<usize, Full> {
        let mut odds = [Odds::new(128); 8];
        let mut encoder = Encoder::new(out);
        for &(which, yes) in decisions {
            encoder.bit(&mut odds[which], yes);
        }
        encoder.finish()
    }

    fn decode(decisions: &[(usize, bool)], bytes: &[u8]) -> Result<Vec<bool>, StreamError> {
        let mut odds = [Odds::new(128); 8];
        let mut decoder = Decoder::new(bytes);
        let read = decisions
            .iter()
            .map(|&(which, _)| decoder.bit(&mut odds[which]));
        let read = read.collect();
        decoder.finish().map(|()| read)
    }

    #[test]
    fn what_is_written_is_read() {
        let mut out = vec![0; 4096];
        for seed in 0..3000 {
            let decisions = decisions(seed, seed as usize % 700);
            let length = encode(&decisions, &mut out).unwrap();
            let read = decode(&decisions, &out[..length]).unwrap();
            let written = decisions.iter().map(|d| d.1);
            assert!(read.into_iter().eq(written), "seed {seed}");
        }
    }

    #[test]
    fn plain_numbers_among_decisions_are_read_as_written() {
        let mut out = vec![0; 8192];
        for seed in 1..500u32 {
            let mut odds = Odds::new(3);
            let mut encoder = Encoder::new(&mut out);
            let of = |i: u32| {
                let count = i.wrapping_mul(seed) % 17;
                (count, i.wrapping_mul(2654435761) >> 15 & ((1 << count) - 1))
            };
            for i in 0..1000 {
                let (count, value) = of(i);
                encoder.bits(count, value);
                encoder.bit(&mut odds, value & 1 != 0);
            }
            let length = encoder.finish().unwrap();
            let mut odds = Odds::new(3);
            let mut decoder = Decoder::new(&out[..length]);
            for i in 0..1000 {
                let (count, value) = of(i);
                assert_eq!(decoder.bits(count), value);
                assert_eq!(decoder.bit(&mut odds), value & 1 != 0);
            }
            decoder.finish().unwrap();
        }
    }

    #[test]
    fn symbols_are_read_as_written_however_unlikely() {
        let rows = [[1, 2, 3], [65533, 65534, 65535], [20000, 40000, 60000]];
        let mut out = vec![0; 8192];
        for seed in 0..300u32 {
            let of = |i: u32| {
                let mixed = (i ^ seed << 12).wrapping_mul(2654435761);
                (&rows[mixed as usize % 3], (mixed >> 20) as usize % 4)
            };
            let mut encoder = Encoder::new(&mut out);
            for i in 0..1000 {
                let (row, symbol) = of(i);
                encoder.symbol(row, symbol);
                encoder.decide(60000, symbol == 0);
            }
            let length = encoder.finish().unwrap();
            let mut decoder = Decoder::new(&out[..length]);
            for i in 0..1000 {
                let (row, symbol) = of(i);
                assert_eq!(decoder.symbol(row), symbol);
                assert_eq!(decoder.decide(60000), symbol == 0);
            }
            decoder.finish().unwrap();
        }
    }
}
