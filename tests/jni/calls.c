/* What calls of the C ABI cost, in nanoseconds: the same calls as Checks.java times through JNI, of
 * the same library. Arguments: a recording of profile residual, of 10 frames. What is timed is
 * checked. */
#define _POSIX_C_SOURCE 200809L
#include "../c/common.h"
#include <time.h>

enum { COUNT = 200000, ROUNDS = 9 };

static double now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec * 1e9 + (double)now.tv_nsec;
}

static int rising(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

#define TIME(name, expected, call)                                   \
    do {                                                             \
        double rounds[ROUNDS];                                       \
        for (int round = -3; round < ROUNDS; round++) {              \
            double start = now_ns();                                 \
            for (unsigned i = 0; i < COUNT; i++)                     \
                GIVES(expected, call);                               \
            if (round >= 0)                                          \
                rounds[round] = (now_ns() - start) / COUNT;          \
        }                                                            \
        qsort(rounds, ROUNDS, sizeof *rounds, rising);               \
        printf("%s: %.1f\n", name, rounds[ROUNDS / 2]);              \
    } while (0)

int main(int count, char **words) {
    CHECK(count == 2);
    bytes stream = read_file(words[1]);
    psao_config config = config_of(stream);
    owned made = make(&config);
    psao_client *client = made.client;
    size_t used = 0, length = 0;
    for (size_t done = 0; done < stream.size; done += used)
        CHECK(psao_client_push(client, stream.data + done, stream.size - done, 0, &used) >= 0);
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.struct_size = sizeof frame;
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    GIVES(PSAO_OK, psao_client_release(client));
    psao_status status;
    memset(&status, 0, sizeof status);
    status.struct_size = sizeof status;
    psao_stats stats;
    memset(&stats, 0, sizeof stats);
    stats.struct_size = sizeof stats;
    psao_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.struct_size = sizeof camera;
    camera.fov_y_rad = camera.aspect = camera.forward[2] = camera.up[1] = 1.0f;
    psao_uplink uplink = {0};
    uint8_t out[PSAO_UPLINK_SMALL_BYTES];
    TIME("push of nothing", PSAO_NEED_MORE, psao_client_push(client, NULL, 0, i, &used));
    TIME("take of nothing new", PSAO_NOTHING_NEW, psao_client_take(client, &frame));
    TIME("status", PSAO_OK, psao_client_status(client, i, &status));
    TIME("stats", PSAO_OK, psao_client_stats(client, &stats));
    TIME("camera", PSAO_OK, psao_uplink_camera(&uplink, &camera, out, sizeof out, &length));
    CHECK(stats.frame_id == 10 && status.state == PSAO_STATE_ENDED && length > 12);
    free(made.block);
    free(stream.data);
    return 0;
}
