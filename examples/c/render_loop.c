/* libpsao in a render loop: one thread receives and decodes, the other draws at its own rate.
 *
 *     render_loop RECORDING.psao
 *
 * A recording stands for the network, and memory for the GPU; upload() is where an engine calls
 * glBufferSubData, vkCmdCopyBuffer or ID3D12GraphicsCommandList::CopyBufferRegion. At the end what
 * was uploaded is compared with the last frame: not one changed byte may have been missed.
 */
#include <psao.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { RANGES = 32, JOIN = 16 };

/* What the receiving thread has. */
struct receiver {
    psao_client *client;
    const uint8_t *bytes;
    size_t size;
    psao_result result;
    atomic_bool done;
};

/* A buffer of the "GPU". */
struct buffer {
    unsigned char *bytes;
    size_t element_bytes, size_bytes, uploaded_bytes;
};

/* Every engine has a thread that reads the socket. It never waits for the one that draws. */
static void *receive(void *argument) {
    struct receiver *receiver = argument;
    const uint8_t *bytes = receiver->bytes;
    size_t left = receiver->size;
    psao_result result = PSAO_OK;
    while (left > 0 && result >= 0) {
        /* As if a packet came. */
        size_t piece = left < 1200 ? left : 1200, used;
        result = psao_client_push(receiver->client, bytes, piece, 0, &used);
        if (result >= 0) {
            bytes += used;
            left -= used;
        }
        /* PSAO_RESYNC: here psao_uplink_resync writes what to send. */
    }
    receiver->result = result < 0 ? result : PSAO_OK;
    atomic_store(&receiver->done, true);
    return NULL;
}

/* Copies what changed. More ranges than fit come as one: the number of copies is bounded. */
static void upload(psao_client *client, psao_buffer which, const void *from, uint32_t count,
                   struct buffer *to) {
    psao_range ranges[RANGES];
    uint32_t range_count;
    size_t size_bytes = count * to->element_bytes;
    if (size_bytes != to->size_bytes) {
        /* A new stream with buffers of other lengths: all of them will be dirty. */
        free(to->bytes);
        to->bytes = malloc(size_bytes);
        to->size_bytes = to->bytes ? size_bytes : 0;
        if (!to->bytes)
            return;
    }
    if (psao_client_dirty_ranges(client, which, JOIN, ranges, RANGES, &range_count) != PSAO_OK)
        return;
    for (uint32_t i = 0; i < range_count; i++) {
        size_t first = ranges[i].first_index * to->element_bytes;
        size_t bytes = ranges[i].count * to->element_bytes;
        memcpy(to->bytes + first, (const unsigned char *)from + first, bytes);
        to->uploaded_bytes += bytes;
    }
}

static int same(const struct buffer *uploaded, const void *frame) {
    return uploaded->size_bytes == 0 || memcmp(uploaded->bytes, frame, uploaded->size_bytes) == 0;
}

static int draw(struct receiver *receiver) {
    struct buffer instances = {NULL, sizeof(psao_instance), 0, 0};
    struct buffer buckets = {NULL, sizeof(psao_bucket), 0, 0};
    struct buffer cells = {NULL, sizeof(psao_cell), 0, 0};
    unsigned pictures = 0, frames = 0, wrong = 0;
    for (bool last = false; !last;) {
        last = atomic_load(&receiver->done);
        if (last) {
            /* The other thread is at its end: what it could not hand over, it does now. */
            size_t used;
            psao_client_push(receiver->client, NULL, 0, 0, &used);
        }
        psao_frame frame = {.struct_size = sizeof frame};
        if (psao_client_take(receiver->client, &frame) == PSAO_OK) {
            upload(receiver->client, PSAO_BUFFER_INSTANCES, frame.instances,
                   frame.instance_count, &instances);
            upload(receiver->client, PSAO_BUFFER_BUCKETS, frame.buckets, frame.bucket_count,
                   &buckets);
            upload(receiver->client, PSAO_BUFFER_CELLS, frame.cells, frame.cell_count, &cells);
            wrong += !same(&instances, frame.instances) || !same(&buckets, frame.buckets) ||
                     !same(&cells, frame.cells);
            psao_client_release(receiver->client);
            frames++;
        }
        /* Nothing new: the buffers hold the last frame, and the picture is drawn with it. */
        pictures++;
    }
    size_t all = instances.uploaded_bytes + buckets.uploaded_bytes + cells.uploaded_bytes;
    printf("%u pictures, %u frames taken, %zu bytes uploaded, %u frames wrong\n", pictures, frames,
           all, wrong);
    free(instances.bytes);
    free(buckets.bytes);
    free(cells.bytes);
    return frames > 0 && wrong == 0 ? 0 : 1;
}

int main(int count, char **words) {
    FILE *file = count == 2 ? fopen(words[1], "rb") : NULL;
    if (!file) {
        fprintf(stderr, "usage: %s RECORDING.psao\n", words[0]);
        return 2;
    }
    fseek(file, 0, SEEK_END);
    long length = ftell(file);
    rewind(file);
    uint8_t *bytes = malloc(length > 0 ? (size_t)length : 1);
    size_t size = bytes && length > 0 ? fread(bytes, 1, (size_t)length, file) : 0;
    fclose(file);

    psao_config config = {.struct_size = sizeof config};
    size_t memory_bytes, align_bytes;
    psao_result result = psao_config_from_stream(bytes, size, &config);
    config.two_threads = 1;
    if (result == PSAO_OK)
        result = psao_client_memory_size(&config, &memory_bytes, &align_bytes);
    if (result != PSAO_OK || memory_bytes > (size_t)1 << 30) {
        fprintf(stderr, "%s: %s\n", words[1], psao_result_str(result));
        return 1;
    }
    unsigned char *block = malloc(memory_bytes + align_bytes);
    if (!block)
        return 1;
    size_t past = (size_t)((uintptr_t)block % align_bytes);
    struct receiver receiver = {.bytes = bytes, .size = size, .result = PSAO_OK};
    result = psao_client_init(&config, block + (align_bytes - past), memory_bytes,
                              &receiver.client);
    pthread_t thread;
    if (result != PSAO_OK || pthread_create(&thread, NULL, receive, &receiver) != 0) {
        fprintf(stderr, "%s\n", psao_result_str(result));
        return 1;
    }
    int status = draw(&receiver);
    pthread_join(thread, NULL);
    if (receiver.result != PSAO_OK) {
        fprintf(stderr, "psao_client_push: %s\n", psao_result_str(receiver.result));
        status = 1;
    }
    free(block);
    free(bytes);
    return status;
}
