/* Nothing takes memory from the heap between a client's init and the end of its recording: every
 * allocation function of the program and its libraries is this file's, and counts. Nor does a
 * stream that fails take any.
 * Arguments: recordings; then "fail", and streams that do. */
#define _GNU_SOURCE
#include "common.h"
#include <dlfcn.h>
#include <stdatomic.h>
#include <sys/mman.h>

static atomic_long calls;

/* glibc's own, under its other names. */
void *__libc_malloc(size_t);
void *__libc_calloc(size_t, size_t);
void *__libc_realloc(void *, size_t);
void *__libc_memalign(size_t, size_t);
void __libc_free(void *);

void *malloc(size_t size) {
    calls++;
    return __libc_malloc(size);
}
void *calloc(size_t count, size_t size) {
    calls++;
    return __libc_calloc(count, size);
}
void *realloc(void *old, size_t size) {
    calls++;
    return __libc_realloc(old, size);
}
void *memalign(size_t align, size_t size) {
    calls++;
    return __libc_memalign(align, size);
}
void *aligned_alloc(size_t align, size_t size) {
    calls++;
    return __libc_memalign(align, size);
}
int posix_memalign(void **out, size_t align, size_t size) {
    calls++;
    *out = __libc_memalign(align, size);
    return *out ? 0 : 12;
}
void free(void *old) {
    calls += old != NULL;
    __libc_free(old);
}
void *mmap(void *at, size_t size, int protection, int flags, int file, off_t offset) {
    static void *(*real)(void *, size_t, int, int, int, off_t);
    calls++;
    if (!real)
        *(void **)&real = dlsym(RTLD_NEXT, "mmap");
    return real(at, size, protection, flags, file, offset);
}

static void play(bytes stream, uint32_t two_threads) {
    psao_config config = config_of(stream);
    config.two_threads = two_threads;
    owned made = make(&config);
    unsigned frames = 0, uploads = 0;
    size_t done = 0, used = 0;
    long before = calls;
    while (done < stream.size) {
        psao_result result =
            psao_client_push(made.client, stream.data + done, stream.size - done, 0, &used);
        CHECK(result >= 0);
        done += used;
        psao_frame frame;
        memset(&frame, 0, sizeof frame);
        frame.struct_size = sizeof frame;
        if (psao_client_take(made.client, &frame) != PSAO_OK)
            continue;
        frames++;
        for (uint32_t buffer = 0; buffer < 3; buffer++) {
            psao_range ranges[32];
            uint32_t count;
            GIVES(PSAO_OK, psao_client_dirty_ranges(made.client, buffer, 16, ranges, 32, &count));
            uploads += count;
        }
        float at[3] = {0.1f, 0.0f, 0.1f}, up[3] = {0, 1, 0}, open;
        GIVES(PSAO_OK, psao_client_lookup(made.client, 0, at, up, 1, &open));
        GIVES(PSAO_OK, psao_client_release(made.client));
    }
    long after = calls;
    printf("%u frames, %u ranges, %ld calls of allocation functions\n", frames, uploads,
           after - before);
    CHECK(after == before && frames >= 300);
    free(made.block);
}

/* Into a client with room for any of them. */
static void fail(int count, char **words) {
    psao_config config;
    memset(&config, 0, sizeof config);
    config.struct_size = sizeof config;
    config.instance_count = 256, config.bucket_count = 1 << 14, config.cell_count = 1 << 15;
    config.slice_count = 1 << 10, config.point_count = 1 << 16, config.patch_count = 1 << 10;
    config.topology_bytes = 1 << 20;
    owned made = make(&config);
    long taken = 0;
    for (int word = 0; word < count; word++) {
        bytes stream = read_file(words[word]);
        long before = calls;
        GIVES(PSAO_OK, psao_client_restart(made.client));
        psao_result result = PSAO_OK;
        for (size_t done = 0, used = 0; result >= 0; done += used) {
            CHECK(done < stream.size);
            size_t left = stream.size - done;
            result = psao_client_push(made.client, stream.data + done, left, 0, &used);
        }
        char text[513];
        size_t length = 0;
        GIVES(PSAO_OK, psao_client_error_text(made.client, text, sizeof text, &length));
        CHECK(length > 0);
        taken += calls - before;
        free(stream.data);
    }
    printf("%d streams failed, %ld calls of allocation functions\n", count, taken);
    CHECK(taken == 0);
    free(made.block);
}

int main(int count, char **words) {
    CHECK(count > 1);
    long before = calls;
    /* What counts nothing proves nothing. */
    void *volatile probe = malloc(1);
    free(probe);
    CHECK(calls == before + 2);
    for (int word = 1; word < count; word++) {
        if (strcmp(words[word], "fail") == 0) {
            fail(count - word - 1, words + word + 1);
            break;
        }
        bytes stream = read_file(words[word]);
        play(stream, 0);
        play(stream, 1);
        free(stream.data);
    }
    return 0;
}
