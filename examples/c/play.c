/* The smallest whole integration of libpsao: plays a recording and looks ambient occlusion up on
 * the CPU, at a grid of positions on a floor, as a picture.
 *
 *     play RECORDING.psao PICTURE.pgm [INSTANCE HEIGHT]
 *
 * INSTANCE: whose local space the floor is in; HEIGHT: its local y. 0 and 0 unless given.
 * Every frame overwrites the picture. See README.md for how to build it.
 */
#include <psao.h>
#include <stdio.h>
#include <stdlib.h>

enum { SIZE = 256 };

static int failed(const char *what, psao_result result) {
    fprintf(stderr, "%s: %s\n", what, psao_result_str(result));
    return 1;
}

/* Looks one row after the other up: an engine's shader does the same for each fragment. */
static int write_picture(psao_client *client, const psao_frame *frame, uint32_t instance,
                         float height, const char *path) {
    static float positions[SIZE * 3], normals[SIZE * 3], openness[SIZE];
    if (instance >= frame->instance_count || frame->instances[instance].bucket_count == 0) {
        fprintf(stderr, "instance %u has no points\n", (unsigned)instance);
        return 1;
    }
    const psao_instance *grid = &frame->instances[instance];
    FILE *file = fopen(path, "wb");
    if (!file) {
        perror(path);
        return 1;
    }
    fprintf(file, "P5 %d %d 255\n", SIZE, SIZE);
    for (int row = 0; row < SIZE; row++) {
        for (int column = 0; column < SIZE; column++) {
            float u = ((float)column + 0.5f) / SIZE, v = ((float)row + 0.5f) / SIZE;
            float *position = &positions[column * 3], *normal = &normals[column * 3];
            position[0] = grid->origin[0] + u * (float)grid->dims[0] / grid->cells_per_unit[0];
            position[1] = height;
            position[2] = grid->origin[2] + v * (float)grid->dims[2] / grid->cells_per_unit[2];
            normal[0] = 0.0f, normal[1] = 1.0f, normal[2] = 0.0f;
        }
        psao_result result =
            psao_client_lookup(client, instance, positions, normals, SIZE, openness);
        if (result < 0) {
            fclose(file);
            return failed("psao_client_lookup", result);
        }
        for (int column = 0; column < SIZE; column++)
            fputc((int)(openness[column] * 255.0f + 0.5f), file);
    }
    return fclose(file) == 0 ? 0 : 1;
}

/* Feeds the stream and takes every frame. */
static int play(psao_client *client, const uint8_t *bytes, size_t size, uint32_t instance,
                float height, const char *path) {
    unsigned frames = 0;
    while (size > 0) {
        size_t used;
        psao_result result = psao_client_push(client, bytes, size, 0, &used);
        if (result < 0) {
            char text[513];
            psao_client_error_text(client, text, sizeof text, NULL);
            fprintf(stderr, "%s\n", text);
            return failed("psao_client_push", result);
        }
        bytes += used;
        size -= used;
        psao_frame frame = {.struct_size = sizeof frame};
        if (result != PSAO_OK || psao_client_take(client, &frame) != PSAO_OK)
            continue;
        frames++;
        /* Here an engine uploads what psao_client_dirty_ranges names. */
        int status = write_picture(client, &frame, instance, height, path);
        psao_client_release(client);
        if (status != 0)
            return status;
    }
    printf("%u frames\n", frames);
    return frames > 0 ? 0 : 1;
}

static uint8_t *read_file(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    long length = -1;
    uint8_t *bytes = NULL;
    if (file && fseek(file, 0, SEEK_END) == 0 && (length = ftell(file)) > 0) {
        rewind(file);
        bytes = malloc((size_t)length);
        *size = bytes ? fread(bytes, 1, (size_t)length, file) : 0;
    }
    if (!bytes)
        perror(path);
    if (file)
        fclose(file);
    return bytes;
}

int main(int count, char **words) {
    if (count != 3 && count != 5) {
        fprintf(stderr, "usage: %s RECORDING.psao PICTURE.pgm [INSTANCE HEIGHT]\n", words[0]);
        return 2;
    }
    uint32_t instance = count == 5 ? (uint32_t)strtoul(words[3], NULL, 10) : 0;
    float height = count == 5 ? strtof(words[4], NULL) : 0.0f;
    size_t size = 0;
    uint8_t *bytes = read_file(words[1], &size);
    if (!bytes)
        return 1;

    /* The stream's first bytes say what a client needs; you say whether it may have it. */
    psao_config config = {.struct_size = sizeof config};
    size_t memory_bytes, align_bytes;
    psao_result result = psao_config_from_stream(bytes, size, &config);
    if (result == PSAO_OK)
        result = psao_client_memory_size(&config, &memory_bytes, &align_bytes);
    if (result != PSAO_OK)
        return failed(words[1], result);
    if (memory_bytes > (size_t)1 << 30) {
        fprintf(stderr, "%s wants more than 1 GiB\n", words[1]);
        return 1;
    }

    /* malloc aligns to less than a cache line. */
    unsigned char *block = malloc(memory_bytes + align_bytes);
    if (!block)
        return 1;
    size_t past = (size_t)((uintptr_t)block % align_bytes);
    psao_client *client;
    result = psao_client_init(&config, block + (align_bytes - past), memory_bytes, &client);
    if (result != PSAO_OK)
        return failed("psao_client_init", result);

    int status = play(client, bytes, size, instance, height, words[2]);
    free(block);
    free(bytes);
    return status;
}
