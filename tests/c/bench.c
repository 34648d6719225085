/* How long a frame takes, single-threaded: push and take, with the ranges to upload listed. And
 * the bytes of the mirror that change in it, a second, against memcpy of the same bytes.
 * Arguments: recordings. What is timed is checked first: every pass must end in the same mirror.
 */
#define _POSIX_C_SOURCE 200809L
#include "common.h"
#include <time.h>

enum { PASSES = 5, MOST = 4096 };

/* Of this thread's processor time: what else the machine does hardly shows. */
static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

static int rising(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double at(double *sorted, unsigned count, double part) {
    return sorted[(unsigned)((double)(count - 1) * part)];
}

static void bench(const char *path) {
    static double frame_s[PASSES * MOST], ratio[PASSES];
    bytes stream = read_file(path);
    psao_config config = config_of(stream);
    unsigned frames = 0, all = 0;
    uint64_t hash = 0;
    double rate[PASSES], changed = 0;
    for (int pass = 0; pass < PASSES; pass++) {
        owned made = make(&config);
        unsigned char *copy = (unsigned char *)calloc(config.cell_count + 1, sizeof(psao_cell));
        psao_range *ranges = (psao_range *)malloc(sizeof *ranges * (config.cell_count + 1));
        CHECK(copy && ranges);
        double decode_s = 0, copy_s = 0, this_s = 0;
        size_t done = 0, used = 0;
        frames = 0, changed = 0;
        while (done < stream.size) {
            psao_frame frame;
            memset(&frame, 0, sizeof frame);
            frame.struct_size = sizeof frame;
            uint32_t count = 0;
            double start = now_s();
            psao_result result =
                psao_client_push(made.client, stream.data + done, stream.size - done, 0, &used);
            int taken = result == PSAO_OK && psao_client_take(made.client, &frame) == PSAO_OK;
            if (taken)
                GIVES(PSAO_OK, psao_client_dirty_ranges(made.client, PSAO_BUFFER_CELLS, 0, ranges,
                                                        config.cell_count + 1, &count));
            this_s += now_s() - start;
            CHECK(result >= 0);
            done += used;
            if (!taken)
                continue;
            double copying = now_s();
            for (uint32_t i = 0; i < count; i++)
                memcpy(copy + ranges[i].first_index * sizeof(psao_cell),
                       frame.cells + ranges[i].first_index, ranges[i].count * sizeof(psao_cell));
            copying = now_s() - copying;
            CHECK(memcmp(copy, frame.cells, frame.cell_count * sizeof(psao_cell)) == 0);
            start = now_s();
            GIVES(PSAO_OK, psao_client_release(made.client));
            this_s += now_s() - start;
            /* The first frame brings everything: it is no frame like the others. */
            if (frames++ > 0) {
                for (uint32_t i = 0; i < count; i++)
                    changed += ranges[i].count * (double)sizeof(psao_cell);
                frame_s[all++] = this_s, decode_s += this_s, copy_s += copying;
                CHECK(all < PASSES * MOST);
            }
            this_s = 0;
        }
        psao_stats stats;
        memset(&stats, 0, sizeof stats);
        stats.struct_size = sizeof stats;
        GIVES(PSAO_OK, psao_client_stats(made.client, &stats));
        CHECK(pass == 0 || stats.mirror_hash == hash);
        hash = stats.mirror_hash;
        rate[pass] = changed / decode_s * 1e-6;
        ratio[pass] = copy_s / decode_s;
        free(made.block);
        free(copy);
        free(ranges);
    }
    qsort(frame_s, all, sizeof *frame_s, rising);
    qsort(rate, PASSES, sizeof *rate, rising);
    qsort(ratio, PASSES, sizeof *ratio, rising);
    printf("%s: %u frames, %.1f kB of cells changed a frame; a frame %.3f ms (median), %.3f (p99);"
           " %.0f MB/s, %.3f of memcpy\n",
           path, frames, changed / (frames - 1) * 1e-3, at(frame_s, all, 0.5) * 1e3,
           at(frame_s, all, 0.99) * 1e3, at(rate, PASSES, 0.5), at(ratio, PASSES, 0.5));
    free(stream.data);
}

int main(int count, char **words) {
    CHECK(count > 1);
    for (int word = 1; word < count; word++)
        bench(words[word]);
    return 0;
}
