/* Where a panic goes when there is no unwinding: back to who called the function that panicked.
 * In C because setjmp returns twice, which only a C compiler knows how to deal with. */
#include <setjmp.h>
#include <stdlib.h>

struct guard {
    jmp_buf place;
    struct guard *outer;
};

/* A thread's innermost guard, kept so that no use of it takes memory: glibc's thread-specific data
 * may, and elsewhere so may a thread-local variable of a library (Android emulates them). */
#ifdef __GLIBC__

__attribute__((tls_model("initial-exec"))) static _Thread_local struct guard *innermost;

static struct guard *get(void) { return innermost; }
static void set(struct guard *guard) { innermost = guard; }

#else
#include <pthread.h>

static pthread_once_t once = PTHREAD_ONCE_INIT;
static pthread_key_t key;

static void make_key(void) {
    /* So many keys that there is none left: nothing else works then either. */
    if (pthread_key_create(&key, NULL) != 0)
        abort();
}
static struct guard *get(void) {
    pthread_once(&once, make_key);
    return (struct guard *)pthread_getspecific(key);
}
static void set(struct guard *guard) { pthread_setspecific(key, guard); }

#endif

/* Calls run, and returns also when it leaves through psao_guard_leave. */
void psao_guard_run(void (*run)(void *), void *argument) {
    struct guard here;
    here.outer = get();
    set(&here);
    /* Unlike setjmp, never a system call for the mask of signals. */
    if (_setjmp(here.place) == 0)
        run(argument);
    set(here.outer);
}

/* Does not return. */
void psao_guard_leave(void) {
    struct guard *guard = get();
    if (!guard)
        abort();
    _longjmp(guard->place, 1);
}

/* Parts of Rust's core library name it in tables for unwinding, which nothing here does. Weak: in a
 * program with another Rust library it is that one's. */
__attribute__((weak)) void rust_eh_personality(void) { abort(); }
