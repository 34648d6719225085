/* Several clients at once in one process. Arguments: how, and a recording a client.
 *
 * together: each client has a thread that pushes and a thread that takes: every frame taken is one
 * that the server sent, whole, and they come in order.
 * apart: each client has a thread that does both: nothing is shared between clients. (So the
 * thread sanitizer can judge it also where the library was not compiled for it: tests/tsan.)
 * wrong: two threads restart the first client, which is against the rules: tests/tsan expects
 * that the sanitizer says so. */
#include "common.h"
#include <pthread.h>
#include <stdatomic.h>

enum { FRAMES = 4096 };

typedef struct pair {
    bytes stream;
    owned made;
    /* Digest of each frame, from a client that took them one by one. */
    uint64_t *expected;
    atomic_int done;
    unsigned taken;
    pthread_t pusher, taker;
} pair;

/* FNV-1a of a frame's buffers, eight bytes at a time. */
static uint64_t digest(const psao_frame *frame) {
    uint64_t hash = 14695981039346656037u;
    const void *parts[3];
    size_t sizes[3];
    parts[0] = frame->instances, sizes[0] = frame->instance_count * sizeof(psao_instance);
    parts[1] = frame->buckets, sizes[1] = frame->bucket_count * sizeof(psao_bucket);
    parts[2] = frame->cells, sizes[2] = frame->cell_count * sizeof(psao_cell);
    for (int part = 0; part < 3; part++) {
        const uint64_t *data = (const uint64_t *)parts[part];
        for (size_t i = 0; i < sizes[part] / sizeof *data; i++)
            hash = (hash ^ data[i]) * 1099511628211u;
    }
    return hash;
}

static psao_frame empty_frame(void) {
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.struct_size = sizeof frame;
    return frame;
}

static void play_alone(pair *pair) {
    psao_config config = config_of(pair->stream);
    owned made = make(&config);
    size_t done = 0, used = 0;
    uint32_t last = 0;
    while (done < pair->stream.size) {
        CHECK(psao_client_push(made.client, pair->stream.data + done, pair->stream.size - done, 0,
                               &used) >= 0);
        done += used;
        psao_frame frame = empty_frame();
        if (psao_client_take(made.client, &frame) == PSAO_OK) {
            CHECK(frame.frame_id < FRAMES && frame.frame_id == last + 1);
            last = frame.frame_id;
            pair->expected[last] = digest(&frame);
            GIVES(PSAO_OK, psao_client_release(made.client));
        }
    }
    CHECK(last > 1);
    free(made.block);
}

static void *play_apart(void *argument) {
    play_alone((pair *)argument);
    return NULL;
}

static void *push_all(void *argument) {
    pair *self = (pair *)argument;
    size_t done = 0, used = 0, piece = 1;
    while (done < self->stream.size) {
        size_t left = self->stream.size - done;
        piece = piece * 5 % 4093 + 1;
        CHECK(psao_client_push(self->made.client, self->stream.data + done,
                               left < piece ? left : piece, done, &used) >= 0);
        done += used;
    }
    atomic_store(&self->done, 1);
    return NULL;
}

static void *take_all(void *argument) {
    pair *self = (pair *)argument;
    uint32_t last = 0;
    for (int done = 0; !done;) {
        done = atomic_load(&self->done);
        if (done) {
            size_t used;
            GIVES(PSAO_NEED_MORE, psao_client_push(self->made.client, NULL, 0, 0, &used));
        }
        psao_status status;
        memset(&status, 0, sizeof status);
        status.struct_size = sizeof status;
        GIVES(PSAO_OK, psao_client_status(self->made.client, 0, &status));
        CHECK(status.state != PSAO_STATE_FAILED);
        psao_frame frame = empty_frame();
        if (psao_client_take(self->made.client, &frame) != PSAO_OK)
            continue;
        CHECK(frame.frame_id > last && frame.frame_id < FRAMES);
        last = frame.frame_id;
        CHECK(digest(&frame) == self->expected[last]);
        self->taken++;
        GIVES(PSAO_OK, psao_client_release(self->made.client));
    }
    /* What came last is there at the end. */
    CHECK(self->expected[last] != 0 && (last + 1 == FRAMES || self->expected[last + 1] == 0));
    return NULL;
}

static void play_together(pair *pairs, int count) {
    for (int i = 0; i < count; i++) {
        play_alone(&pairs[i]);
        psao_config config = config_of(pairs[i].stream);
        config.two_threads = 1;
        pairs[i].made = make(&config);
    }
    for (int i = 0; i < count; i++) {
        CHECK(pthread_create(&pairs[i].pusher, NULL, push_all, &pairs[i]) == 0);
        CHECK(pthread_create(&pairs[i].taker, NULL, take_all, &pairs[i]) == 0);
    }
    for (int i = 0; i < count; i++) {
        CHECK(pthread_join(pairs[i].pusher, NULL) == 0);
        CHECK(pthread_join(pairs[i].taker, NULL) == 0);
        printf("client %d: %u frames taken\n", i, pairs[i].taken);
        CHECK(pairs[i].taken > 0);
        free(pairs[i].made.block);
    }
}

static void *restart_often(void *argument) {
    psao_client *client = (psao_client *)argument;
    for (int i = 0; i < 1000; i++)
        GIVES(PSAO_OK, psao_client_restart(client));
    return NULL;
}

static void push_twice(const pair *pair) {
    psao_config config = config_of(pair->stream);
    owned made = make(&config);
    pthread_t threads[2];
    for (int i = 0; i < 2; i++)
        CHECK(pthread_create(&threads[i], NULL, restart_often, made.client) == 0);
    for (int i = 0; i < 2; i++)
        CHECK(pthread_join(threads[i], NULL) == 0);
    free(made.block);
}

int main(int count, char **words) {
    static pair pairs[4];
    CHECK(count > 2 && count <= 6);
    int clients = count - 2;
    for (int i = 0; i < clients; i++) {
        pairs[i].stream = read_file(words[i + 2]);
        pairs[i].expected = (uint64_t *)calloc(FRAMES, sizeof *pairs[i].expected);
        CHECK(pairs[i].expected != NULL);
    }
    if (strcmp(words[1], "together") == 0) {
        play_together(pairs, clients);
    } else if (strcmp(words[1], "wrong") == 0) {
        push_twice(&pairs[0]);
    } else {
        for (int i = 0; i < clients; i++)
            CHECK(pthread_create(&pairs[i].pusher, NULL, play_apart, &pairs[i]) == 0);
        for (int i = 0; i < clients; i++)
            CHECK(pthread_join(pairs[i].pusher, NULL) == 0);
    }
    for (int i = 0; i < clients; i++) {
        free(pairs[i].expected);
        free(pairs[i].stream.data);
    }
    return 0;
}
