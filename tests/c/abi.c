/* The ABI as its header states it: sizes, versions, results of wrong use, structs of other sizes,
 * and damaged streams. Argument: a recording. Compiled as C99 and as C++17. */
#include "common.h"
#include <stddef.h>

/* As declared at ABI 1, on machines with 64-bit pointers. What is there never moves. */
static void check_layout(void) {
    CHECK(sizeof(psao_result) == 4 && sizeof(psao_buffer) == 4 && sizeof(psao_state) == 4);
    CHECK(sizeof(psao_instance) == 64 && offsetof(psao_instance, radius) == 12);
    CHECK(offsetof(psao_instance, cells_per_unit) == 16);
    CHECK(offsetof(psao_instance, bucket_first) == 28 && offsetof(psao_instance, dims) == 32);
    CHECK(offsetof(psao_instance, bucket_count) == 44);
    CHECK(offsetof(psao_instance, normal_scale) == 48 && offsetof(psao_instance, level) == 60);
    CHECK(sizeof(psao_bucket) == 32 && sizeof(psao_cell) == 32 && offsetof(psao_cell, points) == 4);
    CHECK(sizeof(psao_range) == 8 && sizeof(psao_uplink) == 4);
    CHECK(sizeof(psao_camera) == 64 && offsetof(psao_camera, position_m) == 16);
    CHECK(offsetof(psao_camera, forward) == 40 && offsetof(psao_camera, up) == 52);
    CHECK(offsetof(psao_config, scene_hash) == 8 && offsetof(psao_config, stale_after_ns) == 16);
    CHECK(offsetof(psao_config, log) == 24 && offsetof(psao_config, log_user_data) == 32);
    CHECK(offsetof(psao_config, instance_count) == 40 && sizeof(psao_config) == 88);
    CHECK(offsetof(psao_config, ease_ns) == 80 && offsetof(psao_status, stream_share) == 16);
    CHECK(offsetof(psao_frame, server_time_ns) == 8 && offsetof(psao_frame, instances) == 32);
    CHECK(sizeof(psao_frame) == 56 && sizeof(psao_status) == 24);
    CHECK(sizeof(psao_header) == 48 && offsetof(psao_header, scene_hash) == 24);
    CHECK(offsetof(psao_stats, server_time_ns) == 8 && sizeof(psao_stats) == 112);
}

static void check_versions(void) {
    CHECK(psao_version() == PSAO_VERSION);
    CHECK(psao_abi_version() == PSAO_ABI_VERSION);
    CHECK(strncmp(psao_result_str(PSAO_OK), "PSAO_OK", 7) == 0);
    CHECK(strstr(psao_result_str(PSAO_ERROR_CAPACITY), "config") != NULL);
    CHECK(strstr(psao_result_str(-12345), "unknown") != NULL);
}

static int messages;

static void take_message(void *user_data, uint32_t level, const char *message,
                         size_t message_bytes) {
    CHECK(user_data == &messages && level >= PSAO_LOG_ERROR && level <= PSAO_LOG_INFO);
    CHECK(message_bytes > 0 && message[0] != 0);
    messages++;
}

static void check_config(bytes stream) {
    psao_config config = config_of(stream);
    CHECK(config.cell_count > 0 && config.struct_size == sizeof config && config.log == NULL);
    size_t size = 1, align = 1;
    psao_client *client = NULL;

    GIVES(PSAO_ERROR_NULL, psao_config_from_stream(NULL, 1, &config));
    GIVES(PSAO_ERROR_NULL, psao_config_from_stream(stream.data, stream.size, NULL));
    GIVES(PSAO_NEED_MORE, psao_config_from_stream(NULL, 0, &config));
    GIVES(PSAO_NEED_MORE, psao_config_from_stream(stream.data, 30, &config));
    GIVES(PSAO_ERROR_NOT_A_STREAM, psao_config_from_stream(stream.data + 1, 30, &config));

    GIVES(PSAO_ERROR_NULL, psao_client_memory_size(NULL, &size, &align));
    GIVES(PSAO_ERROR_NULL, psao_client_memory_size(&config, NULL, &align));
    GIVES(PSAO_ERROR_NULL, psao_client_memory_size(&config, &size, NULL));
    psao_config wrong = config;
    wrong.two_threads = 2;
    GIVES(PSAO_ERROR_VALUE, psao_client_memory_size(&wrong, &size, &align));
    wrong = config;
    wrong.max_body_bytes = 63;
    GIVES(PSAO_ERROR_VALUE, psao_client_memory_size(&wrong, &size, &align));
    wrong.max_body_bytes = ((uint32_t)1 << 22) + 1;
    GIVES(PSAO_ERROR_VALUE, psao_client_memory_size(&wrong, &size, &align));

    /* Short, odd and absurd sizes; a longer one only if what follows is zero. */
    wrong = config;
    for (uint32_t bytes = 0; bytes < 8; bytes++) {
        wrong.struct_size = bytes;
        GIVES(PSAO_ERROR_STRUCT, psao_client_memory_size(&wrong, &size, &align));
    }
    wrong.struct_size = 0xffffffff;
    GIVES(PSAO_ERROR_STRUCT, psao_client_memory_size(&wrong, &size, &align));
    CHECK(size == 1 && align == 1);
    struct {
        psao_config config;
        uint32_t more[2];
    } newer;
    memset(&newer, 0, sizeof newer);
    newer.config = config;
    newer.config.struct_size = sizeof newer;
    GIVES(PSAO_OK, psao_client_memory_size(&newer.config, &size, &align));
    size_t full = size;
    newer.more[1] = 1;
    GIVES(PSAO_ERROR_STRUCT, psao_client_memory_size(&newer.config, &size, &align));
    /* An older caller's struct is shorter, in a block that ends with it. */
    size_t short_bytes = offsetof(psao_config, instance_count);
    psao_config *older = (psao_config *)malloc(short_bytes);
    CHECK(older != NULL);
    memcpy(older, &config, short_bytes);
    older->struct_size = (uint32_t)short_bytes;
    GIVES(PSAO_OK, psao_client_memory_size(older, &size, &align));
    CHECK(size > 0 && size != full);
    free(older);

    GIVES(PSAO_OK, psao_client_memory_size(&config, &size, &align));
    CHECK(size == full && align >= 16 && (align & (align - 1)) == 0);
    wrong = config;
    wrong.two_threads = 1;
    GIVES(PSAO_OK, psao_client_memory_size(&wrong, &full, &align));
    CHECK(full > size + (size_t)config.cell_count * sizeof(psao_cell));

    unsigned char *block = (unsigned char *)malloc(size + 2 * align);
    CHECK(block != NULL);
    unsigned char *memory = block + (align - (size_t)block % align);
    GIVES(PSAO_ERROR_NULL, psao_client_init(NULL, memory, size, &client));
    GIVES(PSAO_ERROR_NULL, psao_client_init(&config, NULL, size, &client));
    GIVES(PSAO_ERROR_NULL, psao_client_init(&config, memory, size, NULL));
    GIVES(PSAO_ERROR_MEMORY_SIZE, psao_client_init(&config, memory, size - 1, &client));
    GIVES(PSAO_ERROR_MEMORY_ALIGN, psao_client_init(&config, memory + 1, size, &client));
    GIVES(PSAO_ERROR_MEMORY_ALIGN, psao_client_init(&config, memory + 8, size, &client));
    CHECK(client == NULL);
    config.log = take_message;
    config.log_user_data = &messages;
    GIVES(PSAO_OK, psao_client_init(&config, memory, size, &client));
    CHECK(client != NULL && messages == 1);
    free(block);
}

static psao_result push_from(psao_client *client, bytes stream, size_t at, size_t *used) {
    return psao_client_push(client, stream.data + at, stream.size - at, 200, used);
}

/* Halfway up, what the stream answers at its own points and the baked value count the same. */
static void check_over_baked(psao_client *client, const psao_frame *frame) {
    int compared = 0;
    for (uint32_t i = 0; i < frame->instance_count; i++) {
        const psao_instance *grid = &frame->instances[i];
        float at[3], up[3] = {0, 1, 0}, open = -1, baked = 0.5f, full = -1, half = -1;
        for (uint32_t cell = 0; grid->bucket_count > 0 && cell < 256; cell++) {
            for (int axis = 0; axis < 3; axis++)
                at[axis] = grid->origin[axis] +
                           ((float)(cell * (1u + (uint32_t)axis) % grid->dims[axis]) + 0.5f) /
                               grid->cells_per_unit[axis];
            GIVES(PSAO_OK, psao_client_lookup(client, i, at, up, 1, &open));
            GIVES(PSAO_OK,
                  psao_client_lookup_over_baked(client, i, at, up, &baked, 1, 1, &full));
            GIVES(PSAO_OK,
                  psao_client_lookup_over_baked(client, i, at, up, &baked, 0.5f, 1, &half));
            CHECK(half >= (full + baked) / 2 - 1e-6f && half <= (full + baked) / 2 + 1e-6f);
            CHECK((full - baked) * (open - baked) >= 0);
            compared += full == open && open != baked;
        }
    }
    CHECK(compared > 0);
}

static void check_order(bytes stream) {
    psao_config config = config_of(stream);
    config.log = take_message;
    config.log_user_data = &messages;
    config.stale_after_ns = 1000;
    config.ease_ns = 200;
    owned made = make(&config);
    psao_client *client = made.client;
    size_t used = 99;
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    psao_header header;
    memset(&header, 0, sizeof header);
    psao_status status;
    memset(&status, 0, sizeof status);
    psao_stats stats;
    memset(&stats, 0, sizeof stats);
    psao_range ranges[4];
    uint32_t count = 77;
    float at[3] = {0, 0, 0}, up[3] = {0, 1, 0}, open = -1, baked = 0.25f, both = -1;

    GIVES(PSAO_ERROR_STRUCT, psao_client_take(client, &frame));
    frame.struct_size = sizeof frame;
    GIVES(PSAO_NOTHING_NEW, psao_client_take(client, &frame));
    GIVES(PSAO_ERROR_ORDER, psao_client_release(client));
    GIVES(PSAO_ERROR_ORDER, psao_client_dirty_ranges(client, 0, 0, ranges, 4, &count));
    GIVES(PSAO_ERROR_ORDER, psao_client_lookup(client, 0, at, up, 1, &open));
    header.struct_size = sizeof header;
    GIVES(PSAO_ERROR_ORDER, psao_client_header(client, &header));
    status.struct_size = sizeof status;
    GIVES(PSAO_OK, psao_client_status(client, 5, &status));
    CHECK(status.state == PSAO_STATE_CONNECTING && status.live_ns == 0);
    CHECK(status.stream_share == 0);
    /* Baked values are there before the stream. */
    GIVES(PSAO_OK, psao_client_lookup_over_baked(client, 0, at, up, &baked, 0, 1, &both));
    CHECK(both == baked);
    both = -1;
    GIVES(PSAO_ERROR_ORDER, psao_client_lookup_over_baked(client, 0, at, up, &baked, 1, 1, &both));

    GIVES(PSAO_ERROR_NULL, psao_client_push(NULL, stream.data, 1, 0, &used));
    GIVES(PSAO_ERROR_NULL, psao_client_push(client, NULL, 1, 0, &used));
    GIVES(PSAO_ERROR_NULL, psao_client_push(client, stream.data, 1, 0, NULL));
    CHECK(used == 99);
    GIVES(PSAO_NEED_MORE, psao_client_push(client, NULL, 0, 0, &used));
    CHECK(used == 0);

    GIVES(PSAO_OK, psao_client_push(client, stream.data, stream.size, 100, &used));
    CHECK(used > 0 && used < stream.size);
    GIVES(PSAO_OK, psao_client_status(client, 100, &status));
    CHECK(status.stream_share == 0); /* nobody has it yet */
    GIVES(PSAO_ERROR_NULL, psao_client_take(NULL, &frame));
    GIVES(PSAO_ERROR_NULL, psao_client_take(client, NULL));
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    CHECK(frame.cells != NULL && (size_t)frame.cells % 64 == 0);
    CHECK(frame.struct_size == sizeof frame && frame.cell_count == config.cell_count);
    GIVES(PSAO_ERROR_ORDER, psao_client_take(client, &frame));
    GIVES(PSAO_ERROR_ORDER, psao_client_push(client, stream.data, 1, 0, &used));
    GIVES(PSAO_ERROR_VALUE, psao_client_dirty_ranges(client, 3, 0, ranges, 4, &count));
    GIVES(PSAO_ERROR_VALUE, psao_client_dirty_ranges(client, 2, 0, ranges, 0, &count));
    GIVES(PSAO_ERROR_NULL, psao_client_dirty_ranges(client, 2, 0, NULL, 4, &count));
    GIVES(PSAO_ERROR_NULL, psao_client_dirty_ranges(client, 2, 0, ranges, 4, NULL));
    CHECK(count == 77);
    /* The first frame fills buffers that hold anything. */
    for (uint32_t buffer = 0; buffer < 3; buffer++) {
        uint32_t counts[3];
        counts[0] = frame.instance_count, counts[1] = frame.bucket_count;
        counts[2] = frame.cell_count;
        GIVES(PSAO_OK, psao_client_dirty_ranges(client, buffer, 0, ranges, 4, &count));
        CHECK(count == 1 && ranges[0].first_index == 0 && ranges[0].count == counts[buffer]);
    }
    GIVES(PSAO_ERROR_NULL, psao_client_lookup(client, 0, NULL, up, 1, &open));
    GIVES(PSAO_ERROR_NULL, psao_client_lookup(client, 0, at, up, 1, NULL));
    GIVES(PSAO_OK, psao_client_lookup(client, 0, NULL, NULL, 0, NULL));
    CHECK(open == -1);
    GIVES(PSAO_OK, psao_client_lookup(client, 0xffffffff, at, up, 1, &open));
    CHECK(open == 1);
    GIVES(PSAO_ERROR_NULL, psao_client_lookup_over_baked(client, 0, at, up, NULL, 1, 1, &both));
    GIVES(PSAO_ERROR_NULL, psao_client_lookup_over_baked(client, 0, at, up, &baked, 1, 1, NULL));
    GIVES(PSAO_ERROR_VALUE, psao_client_lookup_over_baked(client, 0, at, up, &baked, 2, 1, &both));
    CHECK(both == -1);
    GIVES(PSAO_OK,
          psao_client_lookup_over_baked(client, 0xffffffff, at, up, &baked, 1, 1, &both));
    CHECK(both == baked);
    check_over_baked(client, &frame);
    GIVES(PSAO_OK, psao_client_status(client, 150, &status));
    CHECK(status.stream_share == 0.25f);
    GIVES(PSAO_OK, psao_client_status(client, 300, &status));
    CHECK(status.stream_share == 1);
    GIVES(PSAO_OK, psao_client_release(client));
    GIVES(PSAO_ERROR_ORDER, psao_client_release(client));
    GIVES(PSAO_NOTHING_NEW, psao_client_take(client, &frame));

    GIVES(PSAO_OK, psao_client_header(client, &header));
    CHECK(header.cell_count == config.cell_count && header.rate_hz > 0);
    stats.struct_size = sizeof stats;
    GIVES(PSAO_OK, psao_client_stats(client, &stats));
    CHECK(stats.frame_count == 1 && stats.frame_id == frame.frame_id && stats.stream_bytes == used);
    GIVES(PSAO_OK, psao_client_status(client, 1100, &status));
    CHECK(status.state == PSAO_STATE_LIVE && status.live_ns == 100);
    GIVES(PSAO_OK, psao_client_status(client, 1101, &status));
    CHECK(status.state == PSAO_STATE_STALE && status.live_ns == 100);

    /* A frame that nobody took is taken late, and whatever came since comes with it. */
    size_t at_byte = used;
    GIVES(PSAO_OK, push_from(client, stream, at_byte, &used));
    at_byte += used;
    GIVES(PSAO_OK, push_from(client, stream, at_byte, &used));
    at_byte += used;
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    GIVES(PSAO_OK, psao_client_release(client));
    GIVES(PSAO_OK, psao_client_stats(client, &stats));
    CHECK(stats.frame_id == frame.frame_id && stats.merged_count == 1);

    /* Damage ends the stream, and says so once and for all; the picture stays. */
    uint8_t damaged[64];
    memset(damaged, 0x55, sizeof damaged);
    char text[600];
    size_t length = 0;
    GIVES(PSAO_OK, psao_client_error_text(client, text, sizeof text, &length));
    CHECK(length == 0 && text[0] == 0);
    CHECK(psao_client_push(client, damaged, sizeof damaged, 0, &used) < 0);
    GIVES(PSAO_ERROR_FAILED, psao_client_push(client, damaged, 1, 0, &used));
    GIVES(PSAO_OK, psao_client_error_text(client, text, sizeof text, &length));
    CHECK(length > 0 && strlen(text) == length);
    GIVES(PSAO_OK, psao_client_error_text(client, text, 4, NULL));
    CHECK(strlen(text) == 3);
    GIVES(PSAO_ERROR_OUTPUT_SIZE, psao_client_error_text(client, text, 0, NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_error_text(client, NULL, 4, NULL));
    GIVES(PSAO_OK, psao_client_status(client, 0, &status));
    CHECK(status.state == PSAO_STATE_FAILED);
    int before = messages;
    GIVES(PSAO_OK, psao_client_restart(client));
    CHECK(messages == before + 1);
    GIVES(PSAO_OK, psao_client_status(client, 0, &status));
    CHECK(status.state == PSAO_STATE_STALE);
    /* The new stream's first frame is a snapshot, and its end is known. */
    at_byte = 0;
    while (at_byte < stream.size) {
        CHECK(push_from(client, stream, at_byte, &used) >= 0);
        at_byte += used;
    }
    GIVES(PSAO_OK, psao_client_status(client, 200, &status));
    CHECK(status.state == PSAO_STATE_ENDED);
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    GIVES(PSAO_OK, psao_client_release(client));

    GIVES(PSAO_ERROR_NULL, psao_client_restart(NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_release(NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_header(client, NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_status(client, 0, NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_stats(client, NULL));
    GIVES(PSAO_ERROR_NULL, psao_client_topology_hash(client, NULL));
    free(made.block);
}

/* Buckets with tags: the same entries, a tag above each, or none at all. */
static void check_tags(bytes stream) {
    psao_config config = config_of(stream);
    owned made = make(&config);
    psao_client *client = made.client;
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.struct_size = sizeof frame;
    psao_bucket out[2];
    size_t used;
    GIVES(PSAO_ERROR_ORDER, psao_client_tag_buckets(client, 0, 1, out));
    GIVES(PSAO_OK, psao_client_push(client, stream.data, stream.size, 0, &used));
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    GIVES(PSAO_ERROR_NULL, psao_client_tag_buckets(NULL, 0, 1, out));
    GIVES(PSAO_ERROR_NULL, psao_client_tag_buckets(client, 0, 1, NULL));
    GIVES(PSAO_OK, psao_client_tag_buckets(client, 0, 0, NULL));
    GIVES(PSAO_ERROR_VALUE, psao_client_tag_buckets(client, frame.bucket_count, 1, out));
    GIVES(PSAO_ERROR_VALUE, psao_client_tag_buckets(client, 1, frame.bucket_count, out));
    GIVES(PSAO_ERROR_VALUE, psao_client_tag_buckets(client, 0xffffffff, 0, out));
    uint32_t tagged = 0;
    for (uint32_t i = 0; i < frame.bucket_count; i++) {
        memset(out, 0xee, sizeof out);
        GIVES(PSAO_OK, psao_client_tag_buckets(client, i, 1, out));
        CHECK(out[1].entries[0] == 0xeeeeeeee);
        const uint32_t *plain = frame.buckets[i].entries;
        int bare = memcmp(out[0].entries, plain, sizeof(psao_bucket)) == 0;
        for (int entry = 0; entry < 8 && plain[entry] != 0; entry++) {
            uint32_t tag = frame.cells[plain[entry]].key * 0x9e3779b1u >> 22;
            if (tag == 0)
                tag = 1;
            CHECK(bare || out[0].entries[entry] == (plain[entry] | tag << 22));
            tagged += !bare;
        }
    }
    CHECK(tagged > 100);
    free(made.block);
}

/* Buffers that were lost: the newest frame comes again, and all of it is dirty. */
static void check_again(bytes stream, uint32_t two_threads) {
    psao_config config = config_of(stream);
    config.two_threads = two_threads;
    owned made = make(&config);
    psao_client *client = made.client;
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.struct_size = sizeof frame;
    psao_range ranges[4];
    uint32_t count;
    size_t used, at_byte = 0;
    GIVES(PSAO_ERROR_NULL, psao_client_mark_all_dirty(NULL));
    /* Before the first frame there is nothing to give again. */
    GIVES(PSAO_OK, psao_client_mark_all_dirty(client));
    GIVES(PSAO_NOTHING_NEW, psao_client_take(client, &frame));
    for (int round = 0; round < 3; round++) {
        GIVES(PSAO_OK, push_from(client, stream, at_byte, &used));
        at_byte += used;
        GIVES(PSAO_OK, psao_client_take(client, &frame));
        uint32_t shown = frame.frame_id;
        GIVES(PSAO_ERROR_ORDER, psao_client_mark_all_dirty(client));
        GIVES(PSAO_OK, psao_client_release(client));
        GIVES(PSAO_NOTHING_NEW, psao_client_take(client, &frame));

        GIVES(PSAO_OK, psao_client_mark_all_dirty(client));
        GIVES(PSAO_OK, psao_client_take(client, &frame));
        CHECK(frame.frame_id == shown);
        for (uint32_t buffer = 0; buffer < 3; buffer++) {
            uint32_t counts[3];
            counts[0] = frame.instance_count, counts[1] = frame.bucket_count;
            counts[2] = frame.cell_count;
            GIVES(PSAO_OK, psao_client_dirty_ranges(client, buffer, 0, ranges, 4, &count));
            CHECK(count == 1 && ranges[0].first_index == 0 && ranges[0].count == counts[buffer]);
        }
        GIVES(PSAO_OK, psao_client_release(client));
        GIVES(PSAO_NOTHING_NEW, psao_client_take(client, &frame));
    }
    /* Half a frame is not shown for that: the next whole one is. */
    GIVES(PSAO_OK, psao_client_mark_all_dirty(client));
    size_t half = stream.size - at_byte > 60 ? 60 : 1;
    GIVES(PSAO_NEED_MORE, psao_client_push(client, stream.data + at_byte, half, 0, &used));
    at_byte += used;
    GIVES(PSAO_OK, push_from(client, stream, at_byte, &used));
    GIVES(PSAO_OK, psao_client_take(client, &frame));
    GIVES(PSAO_OK, psao_client_dirty_ranges(client, PSAO_BUFFER_CELLS, 0, ranges, 4, &count));
    CHECK(count == 1 && ranges[0].count == frame.cell_count);
    GIVES(PSAO_OK, psao_client_release(client));
    free(made.block);
}

static void check_capacity(bytes stream) {
    psao_config config = config_of(stream);
    size_t used;
    config.cell_count -= 1;
    owned made = make(&config);
    GIVES(PSAO_ERROR_CAPACITY, psao_client_push(made.client, stream.data, stream.size, 0, &used));
    char text[600];
    GIVES(PSAO_OK, psao_client_error_text(made.client, text, sizeof text, NULL));
    CHECK(strstr(text, "cells") != NULL);
    free(made.block);

    config = config_of(stream);
    config.max_body_bytes -= 1;
    made = make(&config);
    GIVES(PSAO_ERROR_CAPACITY, psao_client_push(made.client, stream.data, stream.size, 0, &used));
    free(made.block);

    config = config_of(stream);
    config.scene_hash = 1;
    made = make(&config);
    GIVES(PSAO_ERROR_SCENE, psao_client_push(made.client, stream.data, stream.size, 0, &used));
    free(made.block);
}

static uint32_t sequence_of(const uint8_t *message) {
    return message[2] | (uint32_t)message[3] << 8;
}

static void check_uplink(bytes stream) {
    psao_config config = config_of(stream);
    psao_uplink uplink;
    memset(&uplink, 0xff, sizeof uplink);
    uint8_t out[PSAO_UPLINK_SMALL_BYTES];
    uint8_t token[257];
    memset(token, 'x', sizeof token);
    size_t length = 0, room = sizeof out;

    GIVES(PSAO_ERROR_VALUE, psao_uplink_hello(&uplink, &config, token, 257, 0, out, room, &length));
    GIVES(PSAO_ERROR_OUTPUT_SIZE,
          psao_uplink_hello(&uplink, &config, token, 5, 0, out, 12, &length));
    CHECK(uplink.next_sequence == 0xffffffff && length == 0);
    GIVES(PSAO_OK, psao_uplink_hello(&uplink, &config, token, 256, 0, out, room, &length));
    CHECK(uplink.next_sequence == 1 && length > 256 && out[0] == 64 && sequence_of(out) == 0);

    psao_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.struct_size = sizeof camera;
    GIVES(PSAO_ERROR_VALUE, psao_uplink_camera(&uplink, &camera, out, room, &length));
    camera.fov_y_rad = 1, camera.aspect = 1.5f, camera.forward[2] = -1, camera.up[1] = 1;
    GIVES(PSAO_OK, psao_uplink_camera(&uplink, &camera, out, room, &length));
    CHECK(out[0] == 65 && sequence_of(out) == 1);

    double matrix[12] = {1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7};
    GIVES(PSAO_OK, psao_uplink_transform(&uplink, 3, matrix, out, room, &length));
    CHECK(out[0] == 66 && length == 112);
    matrix[4] = (double)(0.0f / (float)(uplink.next_sequence - 3));
    GIVES(PSAO_ERROR_VALUE, psao_uplink_transform(&uplink, 3, matrix, out, room, &length));

    float joints[24] = {0};
    GIVES(PSAO_OK, psao_uplink_joints(&uplink, 3, joints, 2, out, room, &length));
    CHECK(out[0] == 67 && length == 20 + 96);
    GIVES(PSAO_OK, psao_uplink_joints(&uplink, 3, NULL, 0, out, room, &length));
    GIVES(PSAO_ERROR_NULL, psao_uplink_joints(&uplink, 3, NULL, 1, out, room, &length));
    GIVES(PSAO_ERROR_VALUE, psao_uplink_joints(&uplink, 3, joints, 4097, out, room, &length));
    GIVES(PSAO_OK, psao_uplink_ack(&uplink, 9, out, room, &length));
    CHECK(out[0] == 68 && length == 16 && sequence_of(out) == 5);
    GIVES(PSAO_OK, psao_uplink_resync(&uplink, out, 12, &length));
    CHECK(out[0] == 69 && length == 12);
    GIVES(PSAO_ERROR_VALUE, psao_uplink_presence(&uplink, 3, 2, out, room, &length));
    GIVES(PSAO_OK, psao_uplink_presence(&uplink, 3, 1, out, room, &length));
    CHECK(out[0] == 70 && length == 20 && out[12] == 3 && out[16] == 1 && out[17] == 0);
    GIVES(PSAO_OK, psao_uplink_presence(&uplink, 3, 0, out, room, &length));
    CHECK(out[16] == 0);
    GIVES(PSAO_ERROR_OUTPUT_SIZE, psao_uplink_resync(&uplink, out, 11, &length));
    GIVES(PSAO_ERROR_NULL, psao_uplink_resync(NULL, out, room, &length));
    GIVES(PSAO_ERROR_NULL, psao_uplink_resync(&uplink, NULL, room, &length));
    GIVES(PSAO_ERROR_NULL, psao_uplink_resync(&uplink, out, room, NULL));
    GIVES(PSAO_ERROR_NULL, psao_uplink_hello(NULL, &config, token, 5, 0, out, room, &length));
    GIVES(PSAO_ERROR_NULL, psao_uplink_hello(&uplink, &config, NULL, 5, 0, out, room, &length));
    CHECK(uplink.next_sequence == 9);
}

/* Prefixes, and flips of single bits, from blocks of exactly their size. */
static void check_damage(bytes stream) {
    psao_config config = config_of(stream);
    owned made = make(&config);
    size_t size = stream.size < 6000 ? stream.size : 6000;
    for (size_t cut = 0; cut <= size; cut += 61) {
        uint8_t *exact = (uint8_t *)malloc(cut ? cut : 1);
        CHECK(exact != NULL);
        memcpy(exact, stream.data, cut);
        for (int flip = 0; flip < 2; flip++) {
            if (flip && cut > 0)
                exact[cut * 7919 % cut] ^= (uint8_t)(1 << cut % 8);
            GIVES(PSAO_OK, psao_client_restart(made.client));
            size_t done = 0, used = 0;
            while (done < cut &&
                   psao_client_push(made.client, exact + done, cut - done, 0, &used) >= 0)
                done += used;
        }
        free(exact);
    }
    free(made.block);
}

int main(int count, char **words) {
    CHECK(count == 2);
    bytes stream = read_file(words[1]);
    check_layout();
    check_versions();
    check_config(stream);
    check_order(stream);
    check_tags(stream);
    check_again(stream, 0);
    check_again(stream, 1);
    check_capacity(stream);
    check_uplink(stream);
    check_damage(stream);
    free(stream.data);
    return 0;
}
