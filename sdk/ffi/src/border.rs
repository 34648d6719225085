//! Where a defect stops: a panic ends a function of the library, and nothing beyond it.
//!
//! With Rust's standard library it unwinds to here. That library cannot be had without what prints
//! backtraces, which is more code than all of PSAO; so libpsao as it is installed does without it,
//! and a panic jumps here (`guard.c`). The frames that it jumps over have nothing to clean up,
//! which the compiler checks below: a client owns no memory, no lock and no file.

/// Runs `body`. `None` if it panicked.
#[cfg(panic = "unwind")]
pub fn unless_it_panics<R>(body: impl FnOnce() -> R) -> Option<R> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(body)).ok()
}

#[cfg(panic = "abort")]
pub use jump::unless_it_panics;

/// cbindgen:ignore
#[cfg(panic = "abort")]
mod jump {
    use core::ffi::c_void;
    use core::mem::needs_drop;

    // zstd and the guard need it, and nobody else names it when there is no std.
    #[link(name = "c")]
    unsafe extern "C" {}

    unsafe extern "C" {
        fn psao_guard_run(run: unsafe extern "C" fn(*mut c_void), argument: *mut c_void);
        fn psao_guard_leave() -> !;
    }

    struct Call<B, R> {
        body: Option<B>,
        result: Option<R>,
    }

    /// Runs `body`. `None` if it panicked.
    pub fn unless_it_panics<R, B: FnOnce() -> R>(body: B) -> Option<R> {
        // What a panic jumps over is these, and what the library keeps in them.
        const { assert!(!needs_drop::<B>() && !needs_drop::<R>()) };
        const { assert!(!needs_drop::<psao::Client>() && !needs_drop::<psao::ClientError>()) };

        unsafe extern "C" fn run<R, B: FnOnce() -> R>(call: *mut c_void) {
            // SAFETY: from below, which does not touch it meanwhile.
            let call = unsafe { &mut *call.cast::<Call<B, R>>() };
            call.result = call.body.take().map(|body| body());
        }
        let mut call = Call {
            body: Some(body),
            result: None,
        };
        // SAFETY: `run` gets the `Call` that it takes. It may not return but jump to where it was
        // called, which is sound where no frame between has a destructor (Rust's RFC 2945, "plain
        // old frames"): those are of this library and of `core`, and neither has any.
        unsafe { psao_guard_run(run::<R, B>, (&raw mut call).cast()) };
        call.result
    }

    #[panic_handler]
    fn panicked(_: &core::panic::PanicInfo<'_>) -> ! {
        // SAFETY: a panic is in a function that `unless_it_panics` runs, on this thread. (If it
        // were in none, this would end the process.)
        unsafe { psao_guard_leave() }
    }
}
