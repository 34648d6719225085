//! What one thread writes and another reads, without locks and without waiting.
//!
//! ```text
//!            ┌──── write ────┐                ┌──── take ────┐
//!  IDLE ─► WRITING ─► READY ─┴─► READING ─► IDLE
//!            ▲          │  (written again before it was taken)
//!            └──────────┘
//! ```
//! Every step is one compare-exchange. A side that finds the other one at work goes on without:
//! the writer keeps what it has and tries again later, the reader keeps what it took before. So
//! neither ever waits, and the reader never sees half of a write.

use crate::sync::{AtomicU32, Ordering, UnsafeCell};

/// Nothing that the reader does not have.
const IDLE: u32 = 0;
/// The writer is at work.
const WRITING: u32 = 1;
/// Written and not taken yet.
const READY: u32 = 2;
/// The reader is at work.
const READING: u32 = 3;

/// A value that changes hands between a writer's thread and a reader's.
pub struct Handoff<T> {
    state: AtomicU32,
    value: UnsafeCell<T>,
}

// SAFETY: the value is only reached in the states WRITING and READING, each of which one side
// enters by a compare-exchange that acquires what the other side released.
unsafe impl<T: Send> Sync for Handoff<T> {}

impl<T> Handoff<T> {
    /// Nothing to take yet.
    pub fn new(value: T) -> Handoff<T> {
        Handoff {
            state: AtomicU32::new(IDLE),
            value: UnsafeCell::new(value),
        }
    }

    fn step(&self, from: u32, to: u32) -> bool {
        let acquire = Ordering::Acquire;
        let stepped = self
            .state
            .compare_exchange(from, to, acquire, Ordering::Relaxed);
        stepped.is_ok()
    }

    /// Writer: changes the value and makes it ready. `None` if the reader has it.
    pub fn write(&self, change: impl FnOnce(&mut T)) -> Option<Before> {
        // What was not taken yet may be written on. The reader may take it between the two steps.
        let before = if self.step(IDLE, WRITING) {
            Before::Nothing
        } else if self.step(READY, WRITING) {
            Before::Unseen
        } else {
            return None;
        };
        // SAFETY: in WRITING, nobody but the one writer reaches the value.
        self.value.with_mut(|value| change(unsafe { &mut *value }));
        self.state.store(READY, Ordering::Release);
        Some(before)
    }

    /// Writer: takes back what was not taken yet. `None` if the reader has the value.
    pub fn recall(&self) -> Option<Before> {
        if self.step(READY, IDLE) {
            Some(Before::Unseen)
        } else if self.state.load(Ordering::Relaxed) == IDLE {
            Some(Before::Nothing)
        } else {
            None
        }
    }

    /// Reader: takes the value if it was written since it was taken last.
    pub fn take(&self) -> bool {
        self.step(READY, READING)
    }

    /// Reader: takes the value, written since or not, unless the writer is at work on it.
    pub fn take_again(&self) -> bool {
        self.step(READY, READING) || self.step(IDLE, READING)
    }

    /// Reader: looks at the value between [`Handoff::take`] and [`Handoff::release`], else `None`.
    pub fn taken<R>(&self, look: impl FnOnce(&T) -> R) -> Option<R> {
        // Only the reader itself leaves this state.
        (self.state.load(Ordering::Relaxed) == READING).then(|| {
            // SAFETY: in READING, nobody but the one reader reaches the value.
            self.value.with(|value| look(unsafe { &*value }))
        })
    }

    /// Reader: changes the value between [`Handoff::take`] and [`Handoff::release`], else nothing.
    pub fn change(&self, change: impl FnOnce(&mut T)) -> bool {
        if self.state.load(Ordering::Relaxed) != READING {
            return false;
        }
        // SAFETY: as in `taken`.
        self.value.with_mut(|value| change(unsafe { &mut *value }));
        true
    }

    /// Reader: gives the value back, after a last change. Says whether it had it.
    pub fn release(&self, change: impl FnOnce(&mut T)) -> bool {
        let had = self.change(change);
        if had {
            self.state.store(IDLE, Ordering::Release);
        }
        had
    }
}

/// What was there for the reader when the writer came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Before {
    /// Nothing that it has not taken.
    Nothing,
    /// Something that it has not seen.
    Unseen,
}
