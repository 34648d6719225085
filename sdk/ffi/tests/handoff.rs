//! The hand-off under every interleaving of its two threads that the memory model allows (loom),
//! and under load.

mod sync {
    pub use loom::cell::UnsafeCell;
    pub use loom::sync::atomic::{AtomicU32, Ordering};
}

/// The very file that the library is made of, over loom's atomics.
#[path = "../src/handoff.rs"]
mod handoff;

use handoff::{Before, Handoff};
use loom::sync::Arc;

/// Both halves are always written together.
#[derive(Default)]
struct Pair(u32, u32);

#[test]
fn the_reader_sees_whole_writes_in_order_and_misses_none_for_good() {
    loom::model(|| {
        let shared = Arc::new(Handoff::new(Pair::default()));
        let writer = {
            let shared = Arc::clone(&shared);
            loom::thread::spawn(move || {
                let mut kept = 0;
                for number in 1..=3 {
                    let done = shared.write(|pair| *pair = Pair(number, number)).is_some();
                    kept = if done { number } else { kept };
                }
                kept
            })
        };
        let mut last = 0;
        for _ in 0..2 {
            if shared.take() {
                let seen = shared.taken(|pair| (pair.0, pair.1)).unwrap();
                assert_eq!(seen.0, seen.1, "half a write");
                assert!(seen.0 > last, "out of order, or seen twice");
                last = seen.0;
                assert!(shared.release(|_| ()));
            }
        }
        let kept = writer.join().unwrap();
        // What was written last is there for whoever comes late.
        assert_eq!(shared.take(), last < kept);
        assert!(last == kept || shared.taken(|pair| pair.0) == Some(kept));
    });
}

#[test]
fn what_the_reader_marks_when_it_lets_go_is_there_for_the_writer() {
    loom::model(|| {
        let shared = Arc::new(Handoff::new(Pair::default()));
        assert!(shared.write(|pair| pair.0 = 1).is_some());
        let reader = {
            let shared = Arc::clone(&shared);
            loom::thread::spawn(move || {
                let took = shared.take();
                if took {
                    assert!(shared.release(|pair| pair.1 = pair.0));
                }
                took
            })
        };
        let mut seen = None;
        let wrote = shared.write(|pair| {
            seen = Some((pair.0, pair.1));
            pair.0 = 2;
        });
        assert!(seen.is_none_or(|(first, second)| first == 1 && second <= 1));
        assert_eq!(wrote.is_some(), seen.is_some());
        // Taken before or after the second write, but taken.
        assert!(reader.join().unwrap() || wrote.is_none() || shared.take());
    });
}

#[test]
fn what_is_taken_again_is_whole_and_no_older() {
    loom::model(|| {
        let shared = Arc::new(Handoff::new(Pair::default()));
        assert!(shared.write(|pair| *pair = Pair(1, 1)).is_some() && shared.take());
        assert!(shared.release(|_| ()));
        let writer = {
            let shared = Arc::clone(&shared);
            loom::thread::spawn(move || shared.write(|pair| *pair = Pair(2, 2)).is_some())
        };
        // Not while it is written.
        if shared.take_again() {
            let mut seen = (0, 0);
            assert!(shared.change(|pair| seen = (pair.0, pair.1)));
            assert!(
                seen.0 == seen.1 && (1..=2).contains(&seen.0),
                "half a write"
            );
            assert!(shared.release(|_| ()));
        }
        let wrote = writer.join().unwrap();
        assert!(shared.take_again());
        assert_eq!(shared.taken(|pair| pair.0), Some(if wrote { 2 } else { 1 }));
    });
}

#[test]
fn nothing_is_recalled_while_the_reader_has_it() {
    loom::model(|| {
        let shared = Arc::new(Handoff::new(Pair::default()));
        assert!(shared.write(|pair| pair.0 = 1).is_some());
        let reader = {
            let shared = Arc::clone(&shared);
            loom::thread::spawn(move || {
                shared.take() && shared.taken(|pair| pair.0) == Some(1) && shared.release(|_| ())
            })
        };
        let recalled = shared.recall();
        let took = reader.join().unwrap();
        match recalled {
            Some(Before::Unseen) => assert!(!took),
            Some(Before::Nothing) | None => assert!(took),
        }
    });
}

#[test]
fn wrong_order_is_said() {
    loom::model(|| {
        let shared = Handoff::new(Pair::default());
        assert!(!shared.take() && shared.taken(|_| ()).is_none() && !shared.release(|_| ()));
        assert_eq!(shared.recall(), Some(Before::Nothing));
        assert!(shared.write(|_| ()).is_some() && shared.take() && !shared.take());
        assert!(shared.write(|_| ()).is_none() && shared.recall().is_none());
        assert!(shared.release(|_| ()) && !shared.release(|_| ()));
    });
}
