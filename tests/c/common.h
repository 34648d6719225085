/* What the C tests share: checks that say what failed, files, and clients in blocks of exactly the
 * size that the library asked for. C99 and C++17. */
#ifndef COMMON_H
#define COMMON_H
#include <psao.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(truth)                                                          \
    do {                                                                      \
        if (!(truth)) {                                                       \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #truth); \
            exit(1);                                                          \
        }                                                                     \
    } while (0)

/* Compares results, and names both. */
#define GIVES(expected, call)                                                        \
    do {                                                                             \
        psao_result got = (call);                                                    \
        if (got != (expected)) {                                                     \
            fprintf(stderr, "%s:%d: %s\n  gave %s\n", __FILE__, __LINE__, #call,     \
                    psao_result_str(got));                                           \
            exit(1);                                                                 \
        }                                                                            \
    } while (0)

typedef struct bytes {
    uint8_t *data;
    size_t size;
} bytes;

static inline bytes read_file(const char *path) {
    bytes file = {NULL, 0};
    FILE *stream = fopen(path, "rb");
    long length;
    if (!stream)
        perror(path);
    CHECK(stream && fseek(stream, 0, SEEK_END) == 0 && (length = ftell(stream)) >= 0);
    rewind(stream);
    file.size = (size_t)length;
    file.data = (uint8_t *)malloc(file.size + 1);
    CHECK(file.data && fread(file.data, 1, file.size, stream) == file.size);
    fclose(stream);
    return file;
}

static inline psao_config config_of(bytes stream) {
    psao_config config;
    memset(&config, 0, sizeof config);
    config.struct_size = sizeof config;
    GIVES(PSAO_OK, psao_config_from_stream(stream.data, stream.size, &config));
    return config;
}

typedef struct owned {
    psao_client *client;
    unsigned char *block;
} owned;

/* The block ends where the client's memory ends, so that valgrind sees any byte beyond. */
static inline owned make(const psao_config *config) {
    owned made;
    size_t size, align;
    GIVES(PSAO_OK, psao_client_memory_size(config, &size, &align));
    made.block = (unsigned char *)malloc(size + align);
    CHECK(made.block != NULL);
    size_t past = (size_t)made.block % align;
    unsigned char *memory = made.block + (past == 0 ? 0 : align - past);
    size_t end = (size_t)(made.block + size + align - memory) - size;
    memset(memory, 0xa5, size + end);
    made.client = NULL;
    GIVES(PSAO_OK, psao_client_init(config, memory, size, &made.client));
    return made;
}
#endif
