#define _POSIX_C_SOURCE 200809L
#include "player.h"
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { STEP_NS = 2000000 };

static uint64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static void sleep_step(void) {
    const struct timespec step = {0, STEP_NS};
    nanosleep(&step, NULL);
}

/* Waits until so much time has been played. Time does not pass while it is paused. */
static void wait_for(player *self, uint64_t *played_ns, uint64_t due_ns) {
    while (*played_ns < due_ns && !atomic_load(&self->closed)) {
        uint64_t before = now_ns();
        sleep_step();
        if (!atomic_load(&self->paused))
            *played_ns += now_ns() - before;
        /* The link lives, and what the taker was too busy for is handed over. */
        size_t used;
        psao_client_push(self->client, NULL, 0, now_ns(), &used);
    }
}

static void *play(void *argument) {
    player *self = (player *)argument;
    psao_result result = PSAO_OK;
    while (result >= 0 && !atomic_load(&self->closed)) {
        size_t done = 0, used = 0;
        uint64_t played_ns = 0, first_ns = 0, frames = 0;
        while (done < self->stream_bytes && result >= 0 && !atomic_load(&self->closed)) {
            result = psao_client_push(self->client, self->stream + done,
                                      self->stream_bytes - done, now_ns(), &used);
            if (result < 0)
                break;
            done += used;
            psao_stats stats;
            memset(&stats, 0, sizeof stats);
            stats.struct_size = sizeof stats;
            if (result == PSAO_OK && psao_client_stats(self->client, &stats) == PSAO_OK) {
                first_ns = frames++ == 0 ? stats.server_time_ns : first_ns;
                wait_for(self, &played_ns, stats.server_time_ns - first_ns);
            }
        }
        /* From the beginning: the last frame stays until the first comes again. */
        if (result >= 0)
            result = psao_client_restart(self->client);
        if (frames == 0)
            break;
    }
    atomic_store(&self->result, result);
    return NULL;
}

psao_result player_open(player *self, const uint8_t *stream, size_t stream_bytes,
                        size_t most_bytes) {
    memset(self, 0, sizeof *self);
    self->stream = stream;
    self->stream_bytes = stream_bytes;
    psao_config config;
    memset(&config, 0, sizeof config);
    config.struct_size = sizeof config;
    size_t bytes = 0, align = 0;
    psao_result result = psao_config_from_stream(stream, stream_bytes, &config);
    if (result != PSAO_OK)
        return result < 0 ? result : PSAO_ERROR_NOT_A_STREAM;
    config.two_threads = 1;
    result = psao_client_memory_size(&config, &bytes, &align);
    if (result < 0)
        return result;
    if (bytes > most_bytes || posix_memalign(&self->memory, align, bytes) != 0)
        return PSAO_ERROR_MEMORY_SIZE;
    result = psao_client_init(&config, self->memory, bytes, &self->client);
    if (result < 0)
        return result;
    if (pthread_create(&self->thread, NULL, play, self) != 0)
        return PSAO_ERROR_INTERNAL;
    self->started = 1;
    return PSAO_OK;
}

void player_pause(player *self, int paused) {
    atomic_store(&self->paused, paused);
}

void player_close(player *self) {
    atomic_store(&self->closed, 1);
    if (self->started)
        pthread_join(self->thread, NULL);
    free(self->memory);
    memset(self, 0, sizeof *self);
}
