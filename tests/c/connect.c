/* The optional transport: connects, plays what comes, and says so. Arguments: address,
 * fingerprint, token, and the stream that the server will send, for its config. */
#define _POSIX_C_SOURCE 200809L
#include "common.h"
#include <time.h>

int main(int count, char **words) {
    CHECK(count == 5);
    bytes stream = read_file(words[4]);
    psao_config config = config_of(stream);
    psao_connect connect;
    memset(&connect, 0, sizeof connect);
    psao_connection *connection = NULL;
    char text[200] = "";

    GIVES(PSAO_ERROR_STRUCT, psao_connection_open(&connect, &config, NULL, 0, &connection));
    connect.struct_size = sizeof connect;
    GIVES(PSAO_ERROR_NULL, psao_connection_open(&connect, &config, NULL, 0, &connection));
    connect.address = words[1];
    connect.token = words[3];
    GIVES(PSAO_ERROR_VALUE, psao_connection_open(&connect, &config, NULL, 0, &connection));
    connect.fingerprint = "12:34";
    GIVES(PSAO_ERROR_VALUE,
          psao_connection_open(&connect, &config, text, sizeof text, &connection));
    CHECK(strstr(text, "64 hexadecimal digits") != NULL);
    char wrong[65];
    memset(wrong, '7', 64);
    wrong[64] = 0;
    connect.fingerprint = wrong;
    GIVES(PSAO_ERROR_UNTRUSTED, psao_connection_open(&connect, &config, text, 20, &connection));
    CHECK(strlen(text) == 19);
    connect.fingerprint = words[2];
    connect.address = "nowhere";
    GIVES(PSAO_ERROR_VALUE, psao_connection_open(&connect, &config, NULL, 0, &connection));
    connect.address = words[1];
    CHECK(connection == NULL);
    GIVES(PSAO_OK, psao_connection_open(&connect, &config, text, sizeof text, &connection));

    owned made = make(&config);
    psao_uplink uplink = {0};
    uint8_t message[PSAO_UPLINK_SMALL_BYTES], came[777];
    size_t length = 0, arrived = 0;
    GIVES(PSAO_ERROR_VALUE, psao_connection_send(connection, message, 3));
    GIVES(PSAO_OK,
          psao_uplink_hello(&uplink, &config, NULL, 0, 0, message, sizeof message, &length));
    GIVES(PSAO_ERROR_VALUE, psao_connection_send(connection, message, length));
    GIVES(PSAO_OK, psao_uplink_presence(&uplink, 3, 0, message, sizeof message, &length));
    GIVES(PSAO_OK, psao_connection_send(connection, message, length));
    GIVES(PSAO_ERROR_NULL, psao_connection_receive(NULL, came, sizeof came, &arrived, NULL, 0));
    GIVES(PSAO_ERROR_NULL, psao_connection_receive(connection, NULL, 1, &arrived, NULL, 0));

    psao_status status;
    memset(&status, 0, sizeof status);
    status.struct_size = sizeof status;
    unsigned frames = 0;
    for (int waits = 0; status.state != PSAO_STATE_ENDED;) {
        psao_result result =
            psao_connection_receive(connection, came, sizeof came, &arrived, text, sizeof text);
        CHECK(result == PSAO_OK || result == PSAO_NOTHING_NEW);
        if (result == PSAO_NOTHING_NEW) {
            struct timespec pause = {0, 1000000};
            nanosleep(&pause, NULL);
            CHECK(waits++ < 60000);
        }
        for (size_t done = 0, used; result == PSAO_OK && done < arrived; done += used) {
            psao_result pushed =
                psao_client_push(made.client, came + done, arrived - done, 0, &used);
            CHECK(pushed >= 0);
            frames += pushed == PSAO_OK;
        }
        GIVES(PSAO_OK, psao_client_status(made.client, 0, &status));
    }
    GIVES(PSAO_OK, psao_uplink_ack(&uplink, frames, message, sizeof message, &length));
    GIVES(PSAO_OK, psao_connection_send(connection, message, length));
    /* The server closes when it has that. */
    for (int waits = 0;; waits++) {
        psao_result result =
            psao_connection_receive(connection, came, sizeof came, &arrived, text, sizeof text);
        if (result == PSAO_ERROR_CLOSED)
            break;
        CHECK(result == PSAO_NOTHING_NEW && waits < 60000);
        struct timespec pause = {0, 1000000};
        nanosleep(&pause, NULL);
    }
    CHECK(strlen(text) > 10);
    GIVES(PSAO_OK, psao_connection_close(connection));
    GIVES(PSAO_OK, psao_connection_close(NULL));
    free(made.block);
    free(stream.data);
    return 0;
}
