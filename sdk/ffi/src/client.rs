//! The client: memory, stream in, frames out.

use crate::border::unless_it_panics;
use crate::front::{Front, Shown};
use crate::handoff::{Before, Handoff};
use crate::result::psao_result::{self, *};
use crate::types::*;
use core::cell::UnsafeCell;
use core::ffi::{c_char, c_void};
use core::fmt::Write;
use core::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use psao::core::mirror::{Buffer, Capacity};
use psao::core::stream::{Frame, Header, PREAMBLE, Packet, kind};
use psao::core::{Bucket, tags};
use psao::memory::{Limits, Line, Source};
use psao::{Client, ClientError, State};

/// Largest body of a stream's first packet.
const FIRST_BODY_BYTES: u32 = 4096;

/// Follows one stream, in memory of yours. Opaque.
///
/// Two sides use it: the pusher (psao_client_push, psao_client_restart, psao_client_header,
/// psao_client_topology_hash, psao_client_stats, psao_client_error_text) and the taker
/// (psao_client_take, psao_client_dirty_ranges, psao_client_lookup, psao_client_lookup_over_baked,
/// psao_client_release). Each side must be one thread at a time. With psao_config.two_threads both
/// sides may run at once, and neither ever waits for the other; without, they must not.
/// psao_client_status is anyone's, at any time.
pub struct psao_client {
    /// A panic was stopped at the border: nothing in here can be relied on.
    poisoned: AtomicBool,
    two_threads: bool,
    stale_after_ns: u64,
    /// A [`State`] as its number, for any thread.
    state: AtomicU32,
    live_ns: AtomicU64,
    shown: AtomicBool,
    /// The taker wants all of the frame, even if it had it before.
    again: AtomicBool,
    /// When the first frame came; if one was taken.
    first_ns: AtomicU64,
    taken: AtomicBool,
    ease_ns: u64,
    front: Handoff<Front>,
    /// The pusher's; with one thread, the taker's too while it has a frame.
    pusher: UnsafeCell<Pusher>,
}

/// What the pusher's thread keeps.
struct Pusher {
    client: Client,
    frame: Frame,
    /// Of the mirror at that frame.
    mirror_hash: u64,
    /// The newest complete frame was not handed over.
    waiting: bool,
    merged: u64,
    /// Smallest difference of the caller's clock and a frame's time, in this stream.
    fastest_ns: Option<i128>,
    delay_ns: u64,
    error: Text,
    log: psao_log,
    log_user_data: *mut c_void,
}

/// A text of bounded length; what goes beyond is cut off.
struct Text {
    bytes: [u8; 512],
    length: usize,
}

impl Text {
    const EMPTY: Text = Text {
        bytes: [0; 512],
        length: 0,
    };

    fn of(args: core::fmt::Arguments<'_>) -> Text {
        let mut text = Text::EMPTY;
        // Only cuts off.
        let _ = text.write_fmt(args);
        text
    }

    fn get(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

impl Write for Text {
    fn write_str(&mut self, text: &str) -> core::fmt::Result {
        let mut end = text.len().min(self.bytes.len() - self.length);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.bytes[self.length..][..end].copy_from_slice(&text.as_bytes()[..end]);
        self.length += end;
        Ok(())
    }
}

impl Pusher {
    fn log(&self, level: psao_log_level, text: &Text) {
        if let Some(log) = self.log {
            let bytes = text.get();
            // SAFETY: the caller's function, with the caller's pointer and a slice of ours.
            unsafe {
                log(
                    self.log_user_data,
                    level as u32,
                    bytes.as_ptr().cast(),
                    bytes.len(),
                )
            }
        }
    }
}

/// Bytes of the block before the client's pieces, in lines.
const CLIENT_LINES: u64 = size_of::<psao_client>().div_ceil(size_of::<Line>()) as u64;

/// Runs a function that must not unwind into C.
pub(crate) fn guarded(body: impl FnOnce() -> Result<psao_result, psao_result>) -> psao_result {
    match unless_it_panics(body) {
        Some(Ok(result) | Err(result)) => result,
        None => PSAO_ERROR_INTERNAL,
    }
}

/// Runs a client's function; a client that panicked once does nothing any more.
///
/// # Safety
/// `client` is NULL or a live client.
pub(crate) unsafe fn with(
    client: *const psao_client,
    body: impl FnOnce(&psao_client) -> Result<psao_result, psao_result>,
) -> psao_result {
    // SAFETY: the caller's word. Both sides only ever share it.
    let Some(client) = (unsafe { client.as_ref() }) else {
        return PSAO_ERROR_NULL;
    };
    if client.poisoned.load(Ordering::Relaxed) {
        return PSAO_ERROR_INTERNAL;
    }
    match unless_it_panics(|| body(client)) {
        Some(Ok(result) | Err(result)) => result,
        None => {
            client.poisoned.store(true, Ordering::Relaxed);
            PSAO_ERROR_INTERNAL
        }
    }
}

/// Lends the caller's array, or nothing if it has no elements.
///
/// # Safety
/// `items` is NULL or valid for `count` elements during `'a`.
pub(crate) unsafe fn slice_of<'a, T>(
    items: *const T,
    count: usize,
) -> Result<&'a [T], psao_result> {
    if count == 0 {
        return Ok(&[]);
    }
    if items.is_null() {
        return Err(PSAO_ERROR_NULL);
    }
    if !items.is_aligned() || count > isize::MAX as usize / size_of::<T>().max(1) {
        return Err(PSAO_ERROR_VALUE);
    }
    // SAFETY: not null, aligned, of a possible size, and the caller's word for the rest.
    Ok(unsafe { core::slice::from_raw_parts(items, count) })
}

/// Writes an output; the last thing that a function does.
///
/// # Safety
/// `to` is NULL or valid for a write.
pub(crate) unsafe fn put<T>(to: *mut T, value: T) -> Result<(), psao_result> {
    if to.is_null() {
        return Err(PSAO_ERROR_NULL);
    }
    // SAFETY: not null, and the caller's word.
    unsafe { to.write_unaligned(value) };
    Ok(())
}

impl Default for psao_config {
    fn default() -> psao_config {
        psao_config {
            struct_size: size_of::<psao_config>() as u32,
            two_threads: 0,
            scene_hash: 0,
            stale_after_ns: 0,
            log: None,
            log_user_data: core::ptr::null_mut(),
            instance_count: 0,
            bucket_count: 0,
            cell_count: 0,
            slice_count: 0,
            point_count: 0,
            patch_count: 0,
            topology_bytes: 0,
            max_body_bytes: 0,
            max_raw_bytes: 0,
            ease_ns: 0,
        }
    }
}

impl psao_config {
    fn check(&self) -> Result<(), psao_result> {
        let limits = self.limits();
        let most = Limits::of_any(limits.capacity);
        if self.two_threads > 1 || limits.body_bytes < 64 || !limits.fit(&most) {
            return Err(PSAO_ERROR_VALUE);
        }
        Ok(())
    }

    /// The pieces of a client with this config, in their order.
    fn build(&self, source: &mut Source) -> (Client, Front) {
        let limits = self.limits();
        let client = Client::from(source, limits, self.scene_hash);
        let copy = match self.two_threads {
            0 => Capacity::default(),
            _ => limits.capacity,
        };
        (client, Front::new(source, copy))
    }

    /// Lines of the block.
    fn lines(&self) -> Result<usize, psao_result> {
        let mut source = Source::Measure(CLIENT_LINES);
        self.build(&mut source);
        let Source::Measure(lines) = source else {
            return Err(PSAO_ERROR_INTERNAL);
        };
        let most = isize::MAX as u64 / size_of::<Line>() as u64;
        if lines > most {
            return Err(PSAO_ERROR_VALUE);
        }
        Ok(lines as usize)
    }
}

/// Fills a config with just what a stream needs, from its first bytes: of a recording, or of what
/// a server sends. Zeroes the rest of it but struct_size.
///
/// Check the memory that it asks for against your own limit: a hostile server may ask for a lot.
///
/// Returns PSAO_NEED_MORE, and writes nothing, until the bytes hold the first packet (the first
/// 4116 bytes always do).
///
/// Threads: any. No alloc, lock or log. Safe on untrusted input. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_config_from_stream(
    input: *const u8,
    input_bytes: usize,
    out_config: *mut psao_config,
) -> psao_result {
    guarded(|| {
        // SAFETY: the caller's word.
        let input = unsafe { slice_of(input, input_bytes)? };
        let head = &input[..input.len().min(PREAMBLE.len())];
        if !PREAMBLE.starts_with(head) {
            return Err(PSAO_ERROR_NOT_A_STREAM);
        }
        let rest = &input[head.len()..];
        let Some((packet, _)) = Packet::read(rest, FIRST_BODY_BYTES)? else {
            return Ok(PSAO_NEED_MORE);
        };
        if packet.kind == kind::REFUSE {
            return Err(PSAO_ERROR_REFUSED);
        }
        if (packet.kind, packet.flags, packet.sequence) != (kind::HEADER, 0, 0) {
            return Err(PSAO_ERROR_FORMAT);
        }
        let header = Header::read(packet.body)?;
        let mut config = psao_config::default();
        config.set_limits(Limits::of(&header));
        // SAFETY: the caller's word.
        unsafe { write_struct(out_config, &config)? };
        Ok(PSAO_OK)
    })
}

/// Says how much memory a client with this config needs, and how it must be aligned. All that a
/// client ever uses is in there.
///
/// PSAO_ERROR_VALUE: two_threads is neither 0 nor 1, max_body_bytes is below 64 or a limit above
/// the format's, or no machine has so much memory.
///
/// Threads: any. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_memory_size(
    config: *const psao_config,
    out_bytes: *mut usize,
    out_align_bytes: *mut usize,
) -> psao_result {
    guarded(|| {
        // SAFETY: the caller's word.
        let config = unsafe { read_struct(config)? };
        config.check()?;
        let bytes = config.lines()? * size_of::<Line>();
        if out_bytes.is_null() || out_align_bytes.is_null() {
            return Err(PSAO_ERROR_NULL);
        }
        // SAFETY: not null, and the caller's word.
        unsafe {
            put(out_bytes, bytes)?;
            put(out_align_bytes, align_of::<Line>())?;
        }
        Ok(PSAO_OK)
    })
}

/// Makes a client in your memory, which is its own until you stop using it. There is nothing to
/// free but that. What was in the memory does not matter.
///
/// Errors as psao_client_memory_size, and PSAO_ERROR_MEMORY_SIZE, PSAO_ERROR_MEMORY_ALIGN.
///
/// Threads: any. No alloc or lock; may log. Since ABI 1.
///
/// # Safety
/// The pointers are as described; nothing else uses the memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_init(
    config: *const psao_config,
    memory: *mut c_void,
    memory_bytes: usize,
    out_client: *mut *mut psao_client,
) -> psao_result {
    guarded(|| {
        // SAFETY: the caller's word.
        let config = unsafe { read_struct(config)? };
        config.check()?;
        let lines = config.lines()?;
        if memory.is_null() || out_client.is_null() {
            return Err(PSAO_ERROR_NULL);
        }
        let block: *mut Line = memory.cast();
        if !block.is_aligned() {
            return Err(PSAO_ERROR_MEMORY_ALIGN);
        }
        if memory_bytes / size_of::<Line>() < lines {
            return Err(PSAO_ERROR_MEMORY_SIZE);
        }
        let head = CLIENT_LINES as usize;
        // SAFETY: the caller gives the memory to the client for as long as the client is used,
        // and nothing of it is used after that: so, for what it is used for, it lives forever. It
        // is aligned and long enough; any bytes are lines, and zeroing them makes them defined.
        let pieces = unsafe {
            let first = block.add(head);
            first.write_bytes(0, lines - head);
            core::slice::from_raw_parts_mut(first, lines - head)
        };
        let (client, front) = config.build(&mut Source::Lent(pieces));
        let client = psao_client {
            poisoned: AtomicBool::new(false),
            two_threads: config.two_threads == 1,
            stale_after_ns: config.stale_after_ns,
            state: AtomicU32::new(State::Connecting as u32),
            live_ns: AtomicU64::new(0),
            shown: AtomicBool::new(false),
            again: AtomicBool::new(false),
            first_ns: AtomicU64::new(0),
            taken: AtomicBool::new(false),
            ease_ns: config.ease_ns,
            front: Handoff::new(front),
            pusher: UnsafeCell::new(Pusher {
                client,
                frame: Frame::default(),
                mirror_hash: 0,
                waiting: false,
                merged: 0,
                fastest_ns: None,
                delay_ns: 0,
                error: Text::EMPTY,
                log: config.log,
                log_user_data: config.log_user_data,
            }),
        };
        let place: *mut psao_client = memory.cast();
        // SAFETY: the first lines are enough for it and aligned, and in no piece. Nobody else
        // knows of the client before it is handed out.
        unsafe {
            place.write(client);
            let bytes = lines * size_of::<Line>();
            let text = Text::of(format_args!("psao: a client in {bytes} bytes"));
            (*(*place).pusher.get()).log(psao_log_level::PSAO_LOG_INFO, &text);
            put(out_client, place)?;
        }
        Ok(PSAO_OK)
    })
}

const _: () = assert!(align_of::<psao_client>() <= align_of::<Line>());
const _: () = assert!(!core::mem::needs_drop::<Frame>());

impl psao_client {
    /// The pusher's part.
    ///
    /// # Safety
    /// On the pusher's thread; with one thread, or on the taker's while it has a frame.
    #[allow(clippy::mut_from_ref)]
    unsafe fn pusher(&self) -> &mut Pusher {
        // SAFETY: each side is one thread at a time, and the sides take turns unless there are
        // two threads, where only the pusher comes here. No function calls back in.
        unsafe { &mut *self.pusher.get() }
    }

    /// Hands the newest complete frame over, if the taker lets go of the last.
    fn hand_over(&self, pusher: &mut Pusher) {
        if !pusher.waiting || !pusher.client.is_whole() {
            return;
        }
        let (client, frame) = (&pusher.client, pusher.frame);
        let kernel = client.header().map(|header| header.kernel);
        let before = self.front.write(|front| {
            front.frame = frame;
            front.kernel = kernel.unwrap_or(front.kernel);
            if self.two_threads {
                front.merge(client.mirror());
            }
        });
        if let Some(before) = before {
            pusher.waiting = false;
            pusher.merged += u64::from(before == Before::Unseen);
            if self.two_threads {
                pusher.client.clear_dirty();
            }
        }
    }

    /// How much of the stream to show over baked values.
    fn stream_share(&self, now_ns: u64) -> f32 {
        // The taker wrote it behind what it has seen of the pusher.
        if !self.taken.load(Ordering::Acquire) {
            return 0.0;
        }
        let since_ns = now_ns.saturating_sub(self.first_ns.load(Ordering::Relaxed));
        if since_ns >= self.ease_ns {
            return 1.0;
        }
        since_ns as f32 / self.ease_ns as f32
    }

    fn publish(&self, pusher: &Pusher) {
        self.state
            .store(pusher.client.state() as u32, Ordering::Relaxed);
    }

    fn push(&self, input: &[u8], now_ns: u64) -> Result<(psao_result, usize), psao_result> {
        // SAFETY: psao_client_push is the pusher's.
        let pusher = unsafe { self.pusher() };
        if !self.two_threads {
            // The mirror is about to move on.
            match self.front.recall() {
                None => return Err(PSAO_ERROR_ORDER),
                Some(Before::Unseen) => pusher.waiting = true,
                Some(Before::Nothing) => {}
            }
        }
        if self.two_threads {
            // What the taker was too busy for, before more comes on top of it.
            self.hand_over(pusher);
        }
        let mismatches = pusher.client.stats().mismatches;
        let pushed = match pusher.client.push(input) {
            Ok(pushed) => pushed,
            Err(error) => {
                if error != ClientError::Failed {
                    pusher.error = Text::of(format_args!("{error}"));
                }
                self.hand_over(pusher);
                self.publish(pusher);
                return Err((&error).into());
            }
        };
        if let Some(frame) = pushed.frame {
            pusher.merged += u64::from(pusher.waiting);
            pusher.frame = frame;
            pusher.mirror_hash = pusher.client.mirror().hash();
            pusher.waiting = true;
            let late = i128::from(now_ns) - i128::from(frame.time_ns);
            let fastest = pusher.fastest_ns.map_or(late, |fastest| fastest.min(late));
            pusher.fastest_ns = Some(fastest);
            pusher.delay_ns = u64::try_from(late - fastest).unwrap_or(0);
            if !self.shown.swap(true, Ordering::Relaxed) {
                self.first_ns.store(now_ns, Ordering::Relaxed);
            }
        }
        self.hand_over(pusher);
        if pusher.client.state() == State::Live {
            self.live_ns.store(now_ns, Ordering::Relaxed);
        }
        self.publish(pusher);
        let result = if pushed.frame.is_some() {
            PSAO_OK
        } else if pusher.client.stats().mismatches > mismatches {
            PSAO_RESYNC
        } else {
            PSAO_NEED_MORE
        };
        Ok((result, pushed.consumed))
    }

    /// Takes the newest frame: one that the taker has not had, or any if it wants all of it again.
    fn take(&self) -> bool {
        if !self.again.load(Ordering::Relaxed) {
            return self.front.take();
        }
        if self.two_threads {
            let mut any = false;
            if !self.front.take_again() {
                return false;
            }
            self.front.change(|front| any = front.mark_all_dirty());
            if !any {
                self.front.release(|_| ());
                return false;
            }
        } else {
            // SAFETY: one thread, and it takes, so it does not push.
            let pusher = unsafe { self.pusher() };
            // A frame may have begun to come since.
            if !pusher.client.is_whole() || !self.front.take_again() {
                return false;
            }
            pusher.client.mark_all_dirty();
        }
        self.again.store(false, Ordering::Relaxed);
        true
    }

    /// What the taker has now.
    fn with_taken<R>(
        &self,
        look: impl FnOnce(&Front, Shown<'_>) -> Result<R, psao_result>,
    ) -> Result<R, psao_result> {
        let looked = self.front.taken(|front| {
            if self.two_threads {
                look(front, Shown::Copy(front))
            } else {
                // SAFETY: one thread, and it has the frame, so it does not push.
                let pusher = unsafe { &*self.pusher.get() };
                look(front, Shown::Mirror(pusher.client.mirror()))
            }
        });
        looked.unwrap_or(Err(PSAO_ERROR_ORDER))
    }
}

/// Feeds stream bytes, in any portions: from a socket, a file, wherever.
///
/// Stops behind every completed frame with PSAO_OK: take it, then push the rest. Everything else
/// that is no failure has used up all of the input: PSAO_NEED_MORE, and PSAO_RESYNC after which
/// you should send psao_uplink_resync.
///
/// input may be NULL only if input_bytes is 0. Push 0 bytes when your transport shows that the
/// link lives though nothing came (a still scene sends nothing), and now and then with two
/// threads: it hands over what the taker was too busy for.
///
/// now_ns: a clock of yours that does not run backwards; only differences count. 0 if you have
/// none.
///
/// out_consumed_bytes: written on success only.
///
/// PSAO_ERROR_ORDER: with one thread, while a frame is taken. Everything else below 0 ends the
/// stream: the last frame stays in place, psao_client_error_text has a sentence for a log, and
/// psao_client_restart makes ready for a new stream.
///
/// Threads: pusher. Time: what the input asks for, bounded by its size and the config. No alloc,
/// lock or log. Safe on untrusted input. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_push(
    client: *mut psao_client,
    input: *const u8,
    input_bytes: usize,
    now_ns: u64,
    out_consumed_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word.
    unsafe {
        with(client, |client| {
            let input = slice_of(input, input_bytes)?;
            if out_consumed_bytes.is_null() {
                return Err(PSAO_ERROR_NULL);
            }
            let (result, consumed) = client.push(input, now_ns)?;
            put(out_consumed_bytes, consumed)?;
            Ok(result)
        })
    }
}

/// Makes ready for a new stream, from its first byte, after a lost connection or a failure. The
/// last frame stays in place until the new stream's first snapshot: AO freezes, and does not
/// flash.
///
/// Threads: pusher. No alloc or lock; may log. Since ABI 1.
///
/// # Safety
/// The pointer is as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_restart(client: *mut psao_client) -> psao_result {
    // SAFETY: the caller's word; it is the pusher's.
    unsafe {
        with(client, |client| {
            let pusher = client.pusher();
            if pusher.client.state() == State::Failed {
                let error = core::mem::replace(&mut pusher.error, Text::EMPTY);
                pusher.log(psao_log_level::PSAO_LOG_ERROR, &error);
                pusher.error = error;
            }
            pusher.client.restart();
            pusher.fastest_ns = None;
            client.publish(pusher);
            Ok(PSAO_OK)
        })
    }
}

/// Reads what the stream says of itself.
///
/// PSAO_ERROR_ORDER: before its header has come.
///
/// Threads: pusher. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_header(
    client: *const psao_client,
    out_header: *mut psao_header,
) -> psao_result {
    // SAFETY: the caller's word; it is the pusher's.
    unsafe {
        with(client, |client| {
            let header = *client.pusher().client.header().ok_or(PSAO_ERROR_ORDER)?;
            let header = psao_header {
                struct_size: 0,
                profile: header.profile as u32,
                kernel: header.kernel as u32,
                instance_count: header.capacity.instances,
                bucket_count: header.capacity.buckets,
                cell_count: header.capacity.cells,
                scene_hash: header.scene_hash,
                ao_distance_m: header.ao_distance_m,
                density: header.density,
                rate_hz: header.rate_hz,
                threshold: u32::from(header.threshold),
            };
            write_struct(out_header, &header)?;
            Ok(PSAO_OK)
        })
    }
}

/// Says how the client is: whether its frame is the server's, and if not, since when.
///
/// now_ns: the clock of psao_client_push.
///
/// Threads: any, at any time. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_status(
    client: *const psao_client,
    now_ns: u64,
    out_status: *mut psao_status,
) -> psao_result {
    // SAFETY: the caller's word.
    unsafe {
        with(client, |client| {
            let live_ns = client.live_ns.load(Ordering::Relaxed);
            let state = client.state.load(Ordering::Relaxed);
            let waiting = match client.shown.load(Ordering::Relaxed) {
                true => psao_state::PSAO_STATE_STALE,
                false => psao_state::PSAO_STATE_CONNECTING,
            };
            let silent_ns = now_ns.saturating_sub(live_ns);
            let silent = client.stale_after_ns > 0 && silent_ns > client.stale_after_ns;
            let state = if state == State::Failed as u32 {
                psao_state::PSAO_STATE_FAILED
            } else if state == State::Ended as u32 {
                psao_state::PSAO_STATE_ENDED
            } else if state == State::Live as u32 && !silent {
                psao_state::PSAO_STATE_LIVE
            } else {
                waiting
            };
            let status = psao_status {
                struct_size: 0,
                state: state as u32,
                live_ns,
                stream_share: client.stream_share(now_ns),
            };
            write_struct(out_status, &status)?;
            Ok(PSAO_OK)
        })
    }
}

/// Reads the hash of the patches that the client has got, for psao_uplink_hello of a new
/// connection: the server then need not send them again. 0 if some are missing. Read it before
/// psao_client_restart, and keep the client.
///
/// A recording of patches alone (psao record --topology), shipped with the app and pushed first,
/// gives the same.
///
/// Threads: pusher. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_topology_hash(
    client: *const psao_client,
    out_hash: *mut u64,
) -> psao_result {
    // SAFETY: the caller's word; it is the pusher's.
    unsafe {
        with(client, |client| {
            put(out_hash, client.pusher().client.topology_hash())?;
            Ok(PSAO_OK)
        })
    }
}

/// Reads the totals.
///
/// Threads: pusher. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_stats(
    client: *const psao_client,
    out_stats: *mut psao_stats,
) -> psao_result {
    // SAFETY: the caller's word; it is the pusher's.
    unsafe {
        with(client, |client| {
            let pusher = client.pusher();
            let stats = pusher.client.stats();
            let stats = psao_stats {
                struct_size: 0,
                frame_id: pusher.frame.id,
                server_time_ns: pusher.frame.time_ns,
                delay_ns: pusher.delay_ns,
                mirror_hash: pusher.mirror_hash,
                stream_bytes: stats.bytes,
                frame_count: stats.frames,
                snapshot_count: stats.snapshots,
                discarded_count: stats.mismatches,
                merged_count: pusher.merged,
                instance_count: stats.instances,
                bucket_count: stats.buckets,
                cell_count: stats.cells,
                slice_count: stats.slices,
                patch_count: stats.patches,
            };
            write_struct(out_stats, &stats)?;
            Ok(PSAO_OK)
        })
    }
}

/// Reads what failed last, as a sentence that names it and what to do: UTF-8, terminated, at most
/// 513 bytes with the end. Empty if nothing failed. A longer text than the buffer has room for is
/// cut off.
///
/// out_bytes: the text's length without the end, written on success; may be NULL.
///
/// PSAO_ERROR_OUTPUT_SIZE: capacity_bytes is 0.
///
/// Threads: pusher. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_error_text(
    client: *const psao_client,
    out_text: *mut c_char,
    capacity_bytes: usize,
    out_bytes: *mut usize,
) -> psao_result {
    // SAFETY: the caller's word; it is the pusher's.
    unsafe {
        with(client, |client| {
            if out_text.is_null() {
                return Err(PSAO_ERROR_NULL);
            }
            let room = capacity_bytes
                .checked_sub(1)
                .ok_or(PSAO_ERROR_OUTPUT_SIZE)?;
            let text = client.pusher().error.get();
            let bytes = text.len().min(room);
            let out: *mut u8 = out_text.cast();
            out.copy_from_nonoverlapping(text.as_ptr(), bytes);
            out.add(bytes).write(0);
            if !out_bytes.is_null() {
                put(out_bytes, bytes)?;
            }
            Ok(PSAO_OK)
        })
    }
}

/// Takes the newest complete frame. It is yours, and nothing changes it, until
/// psao_client_release. With two threads, what comes meanwhile waits in the pusher's copy and
/// comes with a later frame, all of it and in order.
///
/// PSAO_NOTHING_NEW: none came since the last one that you took, or the pusher is just handing
/// one over: go on with what you have. There is nothing to release then.
///
/// PSAO_ERROR_ORDER: you still have one.
///
/// Threads: taker. Time: constant. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_take(
    client: *mut psao_client,
    out_frame: *mut psao_frame,
) -> psao_result {
    // SAFETY: the caller's word; it is the taker's.
    unsafe {
        with(client, |client| {
            struct_bytes(out_frame.cast())?;
            if client.front.taken(|_| ()).is_some() {
                return Err(PSAO_ERROR_ORDER);
            }
            if !client.take() {
                return Ok(PSAO_NOTHING_NEW);
            }
            client.taken.store(true, Ordering::Release);
            let frame = client.with_taken(|front, shown| {
                let buffers = shown.buffers();
                Ok(psao_frame {
                    struct_size: 0,
                    frame_id: front.frame.id,
                    server_time_ns: front.frame.time_ns,
                    kernel: front.kernel as u32,
                    instance_count: buffers.instances.len() as u32,
                    bucket_count: buffers.buckets.len() as u32,
                    cell_count: buffers.cells.len() as u32,
                    instances: buffers.instances.as_ptr().cast(),
                    buckets: buffers.buckets.as_ptr().cast(),
                    cells: buffers.cells.as_ptr().cast(),
                })
            })?;
            write_struct(out_frame, &frame)?;
            Ok(PSAO_OK)
        })
    }
}

/// Lists what of a buffer changed since the last release: what to upload. The first frame's
/// ranges cover the whole buffers, so yours need no clearing.
///
/// join_count: ranges with at most so many unchanged elements between them come as one. An upload
/// has a price of its own; 16 suits most.
///
/// ranges: capacity_count of them, filled in rising order. If there are more than fit, the last
/// one covers all the rest. So a fixed array is always enough, and bounds the number of uploads.
///
/// PSAO_ERROR_VALUE: buffer is no psao_buffer, or capacity_count is 0. PSAO_ERROR_ORDER: no frame
/// is taken.
///
/// Threads: taker. Time: grows with what changed. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_dirty_ranges(
    client: *const psao_client,
    buffer: u32,
    join_count: u32,
    ranges: *mut psao_range,
    capacity_count: u32,
    out_count: *mut u32,
) -> psao_result {
    // SAFETY: the caller's word; it is the taker's. No index reaches capacity_count.
    unsafe {
        with(client, |client| {
            let buffer = match buffer {
                0 => Buffer::Instances,
                1 => Buffer::Buckets,
                2 => Buffer::Cells,
                _ => return Err(PSAO_ERROR_VALUE),
            };
            if capacity_count == 0 {
                return Err(PSAO_ERROR_VALUE);
            }
            if ranges.is_null() || out_count.is_null() {
                return Err(PSAO_ERROR_NULL);
            }
            let count = client.with_taken(|_, shown| {
                let list = |at: usize, run: core::ops::Range<u32>| {
                    let range = psao_range {
                        first_index: run.start,
                        count: run.end - run.start,
                    };
                    ranges.add(at).write_unaligned(range);
                };
                Ok(shown.dirty_ranges(buffer, join_count, list, capacity_count as usize))
            })?;
            put(out_count, count as u32)?;
            Ok(PSAO_OK)
        })
    }
}

/// Copies buckets with a tag in each entry, which psao_planar_fast of the shaders wants: above the
/// cell's index (22 bits), a few bits of the cell's key, so that no cell is read in vain. Copy the
/// dirty ranges of PSAO_BUFFER_BUCKETS so, and upload the copies; a bucket is dirty, too, where
/// just a tag changed. psao_planar and psao_paper work with tags and without.
///
/// out_buckets: count of them.
///
/// PSAO_ERROR_VALUE: the range is not within the frame's buckets. PSAO_ERROR_CAPACITY: the frame
/// has more than 4194304 cells, so that their indices leave no room: upload the buckets as they
/// are, and call psao_planar. PSAO_ERROR_ORDER: no frame is taken.
///
/// Threads: taker. Time: grows with count. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_tag_buckets(
    client: *const psao_client,
    first_index: u32,
    count: u32,
    out_buckets: *mut psao_bucket,
) -> psao_result {
    // SAFETY: the caller's word; it is the taker's.
    unsafe {
        with(client, |client| {
            if out_buckets.is_null() && count > 0 {
                return Err(PSAO_ERROR_NULL);
            }
            client.with_taken(|_, shown| {
                let lookup = shown.buffers();
                let rest = lookup.buckets.get(first_index as usize..);
                let run = rest.and_then(|rest| rest.get(..count as usize));
                let run = run.ok_or(PSAO_ERROR_VALUE)?;
                if lookup.cells.len() > tags::MAX_CELLS as usize {
                    return Err(PSAO_ERROR_CAPACITY);
                }
                let out: *mut Bucket = out_buckets.cast();
                for (at, bucket) in run.iter().enumerate() {
                    let tagged = tags::tagged(bucket, lookup.cells);
                    out.add(at).write_unaligned(tagged);
                }
                Ok(PSAO_OK)
            })
        })
    }
}

/// Looks ambient occlusion up at points of one instance, on the CPU: what the shader does for
/// each fragment.
///
/// positions, normals: count of them, of three floats each, in the instance's local space (its
/// rest space if it is skinned). Normals may have any length.
///
/// out_openness: count values, 0 fully occluded to 1 open, never NaN. Unknown instances, positions
/// outside and numbers that are none answer 1.
///
/// PSAO_ERROR_ORDER: no frame is taken.
///
/// Threads: taker. Time: grows with count. No alloc, lock or log. Safe on untrusted input. Since
/// ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_lookup(
    client: *const psao_client,
    instance_index: u32,
    positions: *const f32,
    normals: *const f32,
    count: usize,
    out_openness: *mut f32,
) -> psao_result {
    // SAFETY: the caller's word; it is the taker's.
    unsafe {
        with(client, |client| {
            let positions = slice_of(positions.cast::<[f32; 3]>(), count)?;
            let normals = slice_of(normals.cast::<[f32; 3]>(), count)?;
            if out_openness.is_null() && count > 0 {
                return Err(PSAO_ERROR_NULL);
            }
            client.with_taken(|front, shown| {
                let lookup = shown.buffers();
                for (at, (position, normal)) in positions.iter().zip(normals).enumerate() {
                    let answer = lookup.blend(front.kernel, instance_index, *position, *normal);
                    out_openness.add(at).write_unaligned(answer.openness);
                }
                Ok(PSAO_OK)
            })
        })
    }
}

/// As psao_client_lookup, over occlusion that was baked (psao bake --to vertex or texture): where
/// the stream covers a place it answers, elsewhere the baked value does. That is where its points
/// have not come yet, and where it left them out because all is open.
///
/// baked: count values, 0 to 1. share: how much of the stream to show where it has come, 0 to 1,
/// of psao_status.stream_share. With 0 no frame need be taken, and the baked values are the
/// answers.
///
/// out_openness: count values, 0 to 1, never NaN. May be baked.
///
/// PSAO_ERROR_VALUE: share is not 0 to 1. PSAO_ERROR_ORDER: no frame is taken, and share is not 0.
///
/// Threads: taker. Time: grows with count. No alloc, lock or log. Safe on untrusted input. Since
/// ABI 1.
///
/// # Safety
/// The pointers are as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_lookup_over_baked(
    client: *const psao_client,
    instance_index: u32,
    positions: *const f32,
    normals: *const f32,
    baked: *const f32,
    share: f32,
    count: usize,
    out_openness: *mut f32,
) -> psao_result {
    // SAFETY: the caller's word; it is the taker's. Baked values are read one by one, each before
    // its answer is written, so that both may be in one array.
    unsafe {
        with(client, |client| {
            let positions = slice_of(positions.cast::<[f32; 3]>(), count)?;
            let normals = slice_of(normals.cast::<[f32; 3]>(), count)?;
            if !(0.0..=1.0).contains(&share) {
                return Err(PSAO_ERROR_VALUE);
            }
            if (baked.is_null() || out_openness.is_null()) && count > 0 {
                return Err(PSAO_ERROR_NULL);
            }
            let each = |answer: &dyn Fn(usize) -> psao::core::lookup::Answer| {
                for at in 0..count {
                    let value = answer(at).over_baked(baked.add(at).read_unaligned(), share);
                    out_openness.add(at).write_unaligned(value);
                }
                Ok(PSAO_OK)
            };
            if share == 0.0 {
                return each(&|_| psao::core::lookup::Answer::OPEN);
            }
            client.with_taken(|front, shown| {
                let lookup = shown.buffers();
                each(&|at| lookup.blend(front.kernel, instance_index, positions[at], normals[at]))
            })
        })
    }
}

/// Gives the frame back. Everything that was dirty in it counts as uploaded.
///
/// PSAO_ERROR_ORDER: no frame is taken.
///
/// Threads: taker. Time: grows with what changed. No alloc, lock or log. Since ABI 1.
///
/// # Safety
/// The pointer is as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_release(client: *mut psao_client) -> psao_result {
    // SAFETY: the caller's word; it is the taker's. With one thread, it has the frame, so that it
    // is not in a push.
    unsafe {
        with(client, |client| {
            let released = client.front.release(|front| {
                if client.two_threads {
                    front.clear_dirty();
                } else {
                    client.pusher().client.clear_dirty();
                }
            });
            if released {
                Ok(PSAO_OK)
            } else {
                Err(PSAO_ERROR_ORDER)
            }
        })
    }
}

/// Makes everything dirty: call it when your buffers were lost with their device, or made anew.
/// The next psao_client_take then gives the newest frame, even if you had it before, and its
/// ranges cover the whole buffers.
///
/// PSAO_ERROR_ORDER: a frame is taken; release it first.
///
/// Threads: taker. Time: constant; the next psao_client_take's grows with the capacity. No alloc,
/// lock or log. Since ABI 1.
///
/// # Safety
/// The pointer is as described.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_client_mark_all_dirty(client: *mut psao_client) -> psao_result {
    // SAFETY: the caller's word; it is the taker's.
    unsafe {
        with(client, |client| {
            if client.front.taken(|_| ()).is_some() {
                return Err(PSAO_ERROR_ORDER);
            }
            client.again.store(true, Ordering::Relaxed);
            Ok(PSAO_OK)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_stops_at_the_border_and_poisons_the_client() {
        let config = psao_config {
            instance_count: 1,
            bucket_count: 1,
            cell_count: 1,
            max_body_bytes: 64,
            max_raw_bytes: 64,
            ..psao_config::default()
        };
        let mut memory: Vec<Line> = vec![bytemuck::Zeroable::zeroed(); config.lines().unwrap()];
        let mut client = core::ptr::null_mut();
        let bytes = size_of_val(&memory[..]);
        // SAFETY: all that is passed lives until the end, and the client is used from here alone.
        unsafe {
            let init = psao_client_init(&config, memory.as_mut_ptr().cast(), bytes, &mut client);
            assert_eq!(init, PSAO_OK);
            let mut used = 77;
            let push = |used: &mut usize| psao_client_push(client, c"".as_ptr().cast(), 0, 0, used);
            assert_eq!((push(&mut used), used), (PSAO_NEED_MORE, 0));

            // Every function of a client runs in this.
            let hook = std::panic::take_hook();
            std::panic::set_hook(Box::new(|_| ()));
            let result = with(client, |_| panic!("provoked"));
            let elsewhere = guarded(|| panic!("provoked"));
            std::panic::set_hook(hook);
            assert_eq!([result, elsewhere], [PSAO_ERROR_INTERNAL; 2]);

            used = 77;
            assert_eq!((push(&mut used), used), (PSAO_ERROR_INTERNAL, 77));
            let mut status = psao_status {
                struct_size: size_of::<psao_status>() as u32,
                state: 77,
                live_ns: 77,
                stream_share: 77.0,
            };
            let asked = psao_client_status(client, 0, &mut status);
            assert_eq!((asked, status.state), (PSAO_ERROR_INTERNAL, 77));
            assert_eq!(psao_client_restart(client), PSAO_ERROR_INTERNAL);
            assert_eq!(psao_client_release(client), PSAO_ERROR_INTERNAL);

            // A new client in the same memory knows nothing of it.
            let init = psao_client_init(&config, memory.as_mut_ptr().cast(), bytes, &mut client);
            assert_eq!(init, PSAO_OK);
            let push = psao_client_push(client, core::ptr::null(), 0, 0, &mut used);
            assert_eq!(push, PSAO_NEED_MORE);
        }
    }
}
