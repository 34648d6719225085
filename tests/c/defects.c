/* A defect of the library ends one of its functions and nothing else. For a library with the
 * feature provoke. Argument: a recording. */
#include "common.h"
#include <pthread.h>

psao_result psao_provoke(const psao_client *client);

static psao_client *other;
static unsigned logged;

/* A function of the library within another one of the same thread. */
static void provokes(void *user_data, uint32_t level, const char *text, size_t bytes) {
    CHECK(user_data == &logged && level == PSAO_LOG_INFO && text && bytes > 0);
    if (other)
        GIVES(PSAO_ERROR_INTERNAL, psao_provoke(other));
    GIVES(PSAO_ERROR_INTERNAL, psao_provoke(NULL));
    logged++;
}

static void plays(const psao_client *good, bytes stream) {
    psao_client *client = (psao_client *)good;
    size_t used = 0, done = 0;
    unsigned frames = 0;
    while (done < stream.size) {
        CHECK(psao_client_push(client, stream.data + done, stream.size - done, 0, &used) >= 0);
        done += used, frames++;
    }
    CHECK(frames > 1);
}

static void *many(void *argument) {
    const psao_config *config = (const psao_config *)argument;
    for (int i = 0; i < 200; i++) {
        owned made = make(config);
        GIVES(PSAO_ERROR_INTERNAL, psao_provoke(made.client));
        GIVES(PSAO_ERROR_INTERNAL, psao_provoke(NULL));
        GIVES(PSAO_ERROR_INTERNAL, psao_client_restart(made.client));
        free(made.block);
    }
    return NULL;
}

int main(int count, char **words) {
    CHECK(count == 2);
    bytes stream = read_file(words[1]);
    psao_config config = config_of(stream);

    GIVES(PSAO_ERROR_INTERNAL, psao_provoke(NULL));
    owned good = make(&config), bad = make(&config);
    GIVES(PSAO_ERROR_INTERNAL, psao_provoke(bad.client));

    /* It answers nothing else from now on, and writes nothing. */
    size_t used = 77;
    psao_status status;
    memset(&status, 0, sizeof status);
    status.struct_size = sizeof status, status.state = 77;
    GIVES(PSAO_ERROR_INTERNAL, psao_client_push(bad.client, NULL, 0, 0, &used));
    GIVES(PSAO_ERROR_INTERNAL, psao_client_status(bad.client, 0, &status));
    GIVES(PSAO_ERROR_INTERNAL, psao_client_release(bad.client));
    CHECK(used == 77 && status.state == 77);

    other = good.client;
    config.log = provokes, config.log_user_data = &logged;
    owned within = make(&config);
    CHECK(logged == 1);
    GIVES(PSAO_ERROR_INTERNAL, psao_client_push(good.client, NULL, 0, 0, &used));
    plays(within.client, stream);
    GIVES(PSAO_ERROR_INTERNAL, psao_provoke(within.client));
    config.log = NULL;

    pthread_t threads[4];
    for (int i = 0; i < 4; i++)
        CHECK(pthread_create(&threads[i], NULL, many, &config) == 0);
    for (int i = 0; i < 4; i++)
        CHECK(pthread_join(threads[i], NULL) == 0);

    owned last = make(&config);
    plays(last.client, stream);
    free(last.block);
    free(within.block);
    free(bad.block);
    free(good.block);
    free(stream.data);
    return 0;
}
