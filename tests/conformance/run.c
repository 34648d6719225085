/* Any implementation of psao.h must pass: plays every stream of a folder and compares what comes
 * out with the folder's index.txt, whose lines are
 *
 *     valid CLAUSES NAME FRAMES RESYNCS DIGEST [BEFORE]
 *     invalid CLAUSES NAME RESULT
 *
 * CLAUSES: of docs/format.md. BEFORE: the stream that the client got before this one, whatever came
 * of it, and was then restarted.
 * FRAMES: complete frames with the right hash. RESYNCS: those with a wrong one. DIGEST: FNV-1a,
 * eight bytes at a time, over the three buffers of each of the complete ones. RESULT: the
 * psao_result that ends it. A valid stream's NAME.lookups holds lines of an instance, a position, a
 * normal and the openness after its last frame, which may be off by 1/255. Each stream is pushed
 * whole, in pieces, and byte by byte.
 *
 *     run FOLDER
 */
#include "../c/common.h"
#include <inttypes.h>
#include <math.h>

typedef struct outcome {
    unsigned frames, resyncs;
    uint64_t digest;
    psao_result result;
} outcome;

static void mix(uint64_t *digest, const void *from, size_t size) {
    const uint64_t *data = (const uint64_t *)from;
    for (size_t i = 0; i < size / sizeof *data; i++)
        *digest = (*digest ^ data[i]) * 1099511628211u;
}

static unsigned check_lookups(psao_client *client, const char *path) {
    FILE *file = fopen(path, "r");
    if (!file)
        perror(path);
    CHECK(file != NULL);
    unsigned count = 0, instance;
    float at[3], normal[3], expected, open;
    while (fscanf(file, "%u %f %f %f %f %f %f %f", &instance, &at[0], &at[1], &at[2], &normal[0],
                  &normal[1], &normal[2], &expected) == 8) {
        GIVES(PSAO_OK, psao_client_lookup(client, instance, at, normal, 1, &open));
        CHECK(fabsf(open - expected) <= 1.0f / 255.0f);
        count++;
    }
    CHECK(feof(file));
    fclose(file);
    return count;
}

static outcome play(bytes stream, size_t piece, bytes before, unsigned frames,
                    const char *lookups) {
    outcome out = {0, 0, 14695981039346656037u, PSAO_OK};
    psao_config config;
    memset(&config, 0, sizeof config);
    config.struct_size = sizeof config;
    out.result = psao_config_from_stream(stream.data, stream.size, &config);
    if (out.result != PSAO_OK) {
        /* It must fail for a client with any memory, and with the same result. */
        config.instance_count = config.bucket_count = config.cell_count = 16;
    }
    owned made = make(&config);
    size_t done = 0, used = 0;
    while (done < before.size && psao_client_push(made.client, before.data + done,
                                                  before.size - done, 0, &used) >= 0)
        done += used;
    if (before.size > 0)
        GIVES(PSAO_OK, psao_client_restart(made.client));
    done = 0;
    out.result = PSAO_OK;
    while (done < stream.size && out.result >= 0) {
        size_t left = stream.size - done;
        out.result = psao_client_push(made.client, stream.data + done, left < piece ? left : piece,
                                      0, &used);
        done += out.result < 0 ? 0 : used;
        psao_frame frame;
        memset(&frame, 0, sizeof frame);
        frame.struct_size = sizeof frame;
        if (out.result != PSAO_OK)
            continue;
        GIVES(PSAO_OK, psao_client_take(made.client, &frame));
        mix(&out.digest, frame.instances, frame.instance_count * sizeof(psao_instance));
        mix(&out.digest, frame.buckets, frame.bucket_count * sizeof(psao_bucket));
        mix(&out.digest, frame.cells, frame.cell_count * sizeof(psao_cell));
        out.frames++;
        if (lookups && out.frames == frames)
            CHECK(check_lookups(made.client, lookups) > 0);
        GIVES(PSAO_OK, psao_client_release(made.client));
    }
    psao_stats stats;
    memset(&stats, 0, sizeof stats);
    stats.struct_size = sizeof stats;
    GIVES(PSAO_OK, psao_client_stats(made.client, &stats));
    out.resyncs = (unsigned)stats.discarded_count;
    free(made.block);
    return out;
}

int main(int count, char **words) {
    CHECK(count == 2);
    char path[1024], line[1024], kind[16], clauses[256], name[128];
    snprintf(path, sizeof path, "%s/index.txt", words[1]);
    FILE *index = fopen(path, "r");
    if (!index)
        perror(path);
    CHECK(index != NULL);
    unsigned passed = 0, failed = 0;
    while (fgets(line, sizeof line, index)) {
        int rest = 0;
        CHECK(sscanf(line, "%15s %255s %127s %n", kind, clauses, name, &rest) == 3);
        snprintf(path, sizeof path, "%s/%s.psao", words[1], name);
        bytes stream = read_file(path), before = {NULL, 0};
        char first[128];
        if (strcmp(kind, "valid") == 0 && sscanf(line + rest, "%*u %*u %*x %127s", first) == 1) {
            snprintf(path, sizeof path, "%s/%s.psao", words[1], first);
            before = read_file(path);
        }
        snprintf(path, sizeof path, "%s/%s.lookups", words[1], name);
        int good = 1;
        const size_t pieces[] = {stream.size, 977, 1};
        for (int i = 0; i < 3; i++) {
            if (strcmp(kind, "valid") == 0) {
                unsigned frames, resyncs;
                uint64_t digest;
                CHECK(sscanf(line + rest, "%u %u %" SCNx64, &frames, &resyncs, &digest) == 3);
                outcome out = play(stream, pieces[i], before, frames, path);
                good = good && out.result >= 0 && out.frames == frames && out.digest == digest &&
                       out.resyncs == resyncs;
            } else {
                int result;
                CHECK(strcmp(kind, "invalid") == 0 && sscanf(line + rest, "%d", &result) == 1);
                good = good && play(stream, pieces[i], before, 0, NULL).result == result;
            }
        }
        printf("%s %s [%s]\n", good ? "ok    " : "FAILED", name, clauses);
        passed += good != 0, failed += good == 0;
        free(stream.data);
        free(before.data);
    }
    fclose(index);
    printf("%u passed, %u failed\n", passed, failed);
    return failed == 0 && passed > 0 ? 0 : 1;
}
