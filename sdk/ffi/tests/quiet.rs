//! A client in lent memory takes none from Rust's allocator, whatever is pushed into it. (That it
//! takes none from C's either is `tests/c/quiet.c`'s to show.)

use psao::core::mirror::{Buffer, Capacity};
use psao::memory::{Limits, Line, Source};
use psao::{Client, ClientError};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fmt::Write;
use std::path::Path;

/// Counts the calls of each thread.
struct Counting;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    CALLS.set(CALLS.get() + 1);
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

// SAFETY: the system's allocator, with the same arguments; counting takes no memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's word.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller's word; it came from there.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's word.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's word; it came from there.
        unsafe { System.realloc(memory, layout, size) }
    }
}

/// Takes a text and keeps its length alone.
struct Length(usize);

impl Write for Length {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        self.0 += text.len();
        Ok(())
    }
}

/// Pushes a stream to its end or to its first error; takes, lists and looks up each frame.
/// Returns frames, ranges, and the length of the error's text.
fn play(client: &mut Client, stream: &[u8]) -> (u64, u64, usize) {
    let (mut frames, mut ranges, mut text) = (0, 0, Length(0));
    let mut rest = stream;
    client.restart();
    while !rest.is_empty() {
        let pushed = match client.push(rest) {
            Ok(pushed) => pushed,
            Err(error) => {
                write!(text, "{error}").unwrap();
                assert_eq!(client.push(rest), Err(ClientError::Failed));
                break;
            }
        };
        rest = &rest[pushed.consumed..];
        if pushed.frame.is_none() {
            continue;
        }
        frames += 1;
        for buffer in [Buffer::Instances, Buffer::Buckets, Buffer::Cells] {
            ranges += client.mirror().dirty_runs(buffer).count() as u64;
        }
        let kernel = client.header().map(|header| header.kernel).unwrap();
        for index in 0..client.mirror().instances().len() as u32 {
            let lookup = client.mirror().lookup();
            let answer = lookup.blend(kernel, index, [0.1, 0.0, 0.1], [0.0, 1.0, 0.0]);
            assert!((0.0..=1.0).contains(&answer.openness));
        }
        client.clear_dirty();
    }
    (frames, ranges, text.0)
}

#[test]
fn a_client_allocates_nothing_in_300_frames_and_none_of_the_hostile_streams() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/conformance/streams");
    let entries = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let recordings = entries.filter(|path| path.extension().is_some_and(|end| end == "psao"));
    let streams: Vec<Vec<u8>> = recordings
        .map(|path| std::fs::read(path).unwrap())
        .collect();
    let most = Capacity {
        instances: 256,
        buckets: 1 << 14,
        cells: 1 << 15,
        slices: 1 << 10,
        points: 1 << 16,
        patches: 1 << 10,
        topology_bytes: 1 << 20,
    };
    let limits = Limits::of_any(most);
    let block = vec![Line([0xa5; 64]); Client::lines(limits) as usize];
    let mut source = Source::Lent(Box::leak(block.into()));

    // What counts nothing proves nothing.
    let before = CALLS.get();
    drop(std::hint::black_box(Box::new(1)));
    assert_eq!(CALLS.get(), before + 2);

    let before = CALLS.get();
    let mut client = Client::from(&mut source, limits, 0);
    let (mut frames, mut ranges, mut refused) = (0, 0, 0);
    for stream in streams.iter().cycle().take(3 * streams.len()) {
        let (these, listed, text) = play(&mut client, stream);
        frames += these;
        ranges += listed;
        refused += u32::from(text > 0);
    }
    let calls = CALLS.get() - before;
    assert!(
        frames >= 300 && ranges > frames && refused > 150,
        "{frames} {ranges} {refused}"
    );
    assert_eq!(calls, 0);
}
