//! zstd decompression in the caller's memory.
//!
//! The safe bindings to zstd let it take its state from the heap, and what an engine links must
//! not do that. So this crate binds the one function that is needed. It is a crate of its own
//! because it needs `unsafe`, which the client forbids itself.
//!
//! The state lives for one call: nothing of it has to be kept valid between packets, and nothing
//! points into the memory afterwards.
#![no_std]

use zstd_sys::{
    ZSTD_decompressDCtx, ZSTD_estimateDCtxSize, ZSTD_findFrameCompressedSize, ZSTD_initStaticDCtx,
};

/// The input is not exactly one zstd frame with content of the output's length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotOneFrame;

/// How a frame begins that has content; others are to be skipped.
const MAGIC: [u8; 4] = 0xFD2F_B528u32.to_le_bytes();

/// Words of memory that [`decompress`] needs, about 12 000.
pub fn state_words() -> usize {
    // SAFETY: it takes nothing, and returns a constant of the library.
    unsafe { ZSTD_estimateDCtxSize() }.div_ceil(8)
}

/// Decompresses `input`, which must be one whole frame, to fill `output` exactly.
///
/// `state`: [`state_words`] of them, whatever is in them. Takes no memory, no lock, and any input.
///
/// # Errors
/// It is another thing, or decompresses to another length. `output` then holds anything.
///
/// # Panics
/// If `state` is too short.
pub fn decompress(state: &mut [u64], output: &mut [u8], input: &[u8]) -> Result<(), NotOneFrame> {
    assert!(state.len() >= state_words(), "memory for zstd's state");
    // SAFETY: the pointer and the length are those of `input`.
    let length = unsafe { ZSTD_findFrameCompressedSize(input.as_ptr().cast(), input.len()) };
    // An error code is a length beyond any slice's. zstd itself would go on behind the first frame.
    if length != input.len() || !input.starts_with(&MAGIC) {
        return Err(NotOneFrame);
    }
    // SAFETY: `state` is `size_of_val` bytes aligned to 8 that nothing else uses during this call;
    // a state in memory of the caller's never takes any other. It is large enough, so not null.
    // `output` and `input` are slices that don't overlap. No pointer outlives the call.
    let written = unsafe {
        let context = ZSTD_initStaticDCtx(state.as_mut_ptr().cast(), size_of_val(state));
        ZSTD_decompressDCtx(
            context,
            output.as_mut_ptr().cast(),
            output.len(),
            input.as_ptr().cast(),
            input.len(),
        )
    };
    if written == output.len() {
        Ok(())
    } else {
        Err(NotOneFrame)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::{vec, vec::Vec};

    fn frame(content: &[u8]) -> Vec<u8> {
        let mut out = vec![0; zstd::zstd_safe::compress_bound(content.len())];
        let length = zstd::zstd_safe::compress(&mut out[..], content, 1).unwrap();
        out.truncate(length);
        out
    }

    #[test]
    fn one_whole_frame_of_the_right_length_and_nothing_else_is_taken() {
        let content: Vec<u8> = (0..50_000u32)
            .map(|i| (i.wrapping_mul(i) >> 7) as u8)
            .collect();
        // What was in the state before does not matter.
        let mut state = vec![u64::MAX; state_words()];
        let mut take = |length: usize, input: &[u8]| {
            let mut output = vec![0; length];
            decompress(&mut state, &mut output, input).map(|()| output)
        };
        let whole = frame(&content);
        assert_eq!(take(50_000, &whole).as_ref(), Ok(&content));
        assert_eq!(take(49_999, &whole), Err(NotOneFrame));
        assert_eq!(take(50_001, &whole), Err(NotOneFrame));
        assert_eq!(take(50_000, &whole[..whole.len() - 1]), Err(NotOneFrame));
        assert_eq!(
            take(100_000, &[&whole[..], &whole].concat()),
            Err(NotOneFrame)
        );
        let skippable = [0x50, 0x2a, 0x4d, 0x18, 0, 0, 0, 0];
        assert_eq!(
            take(50_000, &[&skippable[..], &whole].concat()),
            Err(NotOneFrame)
        );
        assert_eq!(
            take(50_000, &[&whole[..], &skippable].concat()),
            Err(NotOneFrame)
        );
        assert_eq!(take(0, &skippable), Err(NotOneFrame));
        assert_eq!(take(0, &[]), Err(NotOneFrame));
        assert_eq!(take(50_000, &whole).as_ref(), Ok(&content));
    }
}
