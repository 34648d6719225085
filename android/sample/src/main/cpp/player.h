/* Plays a recording to a client, at its own pace, on a thread of its own: the pusher's side. Of no
 * platform but POSIX. */
#ifndef PLAYER_H
#define PLAYER_H

#include <psao.h>
#include <pthread.h>
#include <stdatomic.h>

typedef struct player {
    /* For two threads; the thread that draws takes. */
    psao_client *client;
    /* Private. */
    const uint8_t *stream;
    size_t stream_bytes;
    void *memory;
    atomic_int paused, closed;
    int started;
    /* Of the last push: below 0 it failed, and the thread has ended. */
    atomic_int result;
    pthread_t thread;
} player;

/* Makes a client and begins to play, again and again. The stream must stay until player_close.
 *
 * Errors of psao_config_from_stream and psao_client_init, and PSAO_ERROR_MEMORY_SIZE if there is
 * not the memory, or it is more than most_bytes. */
psao_result player_open(player *player, const uint8_t *stream, size_t stream_bytes,
                        size_t most_bytes);

/* Stops where it is, or goes on: the app is not seen, or is seen again. */
void player_pause(player *player, int paused);

/* Ends the thread, and frees the client. Also after player_open failed. */
void player_close(player *player);

#endif
