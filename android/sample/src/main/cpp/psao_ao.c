#include "psao_ao.h"
#include <string.h>

enum {
    /* An upload has a price of its own: ranges with so few unchanged elements between are one. */
    JOIN_COUNT = 16,
    /* At most so many uploads a buffer and picture. */
    MOST_RANGES = 64
};

/* Bytes of an element of each buffer. */
static const GLsizeiptr ELEMENT_BYTES[3] = {64, 32, 32};

void psao_ao_init(psao_ao *ao) {
    memset(ao, 0, sizeof *ao);
    ao->kernel = -1;
    glGenBuffers(3, ao->buffers);
}

static psao_result upload(psao_ao *ao, const psao_client *client, uint32_t buffer,
                          const void *elements, uint32_t element_count) {
    const GLsizeiptr size = ELEMENT_BYTES[buffer];
    psao_range ranges[MOST_RANGES];
    uint32_t count = 0;
    psao_result result =
        psao_client_dirty_ranges(client, buffer, JOIN_COUNT, ranges, MOST_RANGES, &count);
    if (result < 0)
        return result;
    glBindBuffer(GL_SHADER_STORAGE_BUFFER, ao->buffers[buffer]);
    if (ao->bytes[buffer] != (GLsizeiptr)element_count * size) {
        /* A stream begins: all is dirty, so that nothing need be cleared. */
        ao->bytes[buffer] = (GLsizeiptr)element_count * size;
        glBufferData(GL_SHADER_STORAGE_BUFFER, ao->bytes[buffer], NULL, GL_DYNAMIC_DRAW);
    }
    for (uint32_t i = 0; i < count; i++) {
        GLintptr from = (GLintptr)ranges[i].first_index * size;
        GLsizeiptr bytes = (GLsizeiptr)ranges[i].count * size;
        glBufferSubData(GL_SHADER_STORAGE_BUFFER, from, bytes, (const char *)elements + from);
        ao->uploaded_bytes += (uint64_t)bytes;
    }
    ao->upload_count += count;
    return PSAO_OK;
}

psao_result psao_ao_update(psao_ao *ao, psao_client *client) {
    psao_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.struct_size = sizeof frame;
    psao_result result = psao_client_take(client, &frame);
    if (result != PSAO_OK)
        return result;
    ao->upload_count = 0;
    ao->uploaded_bytes = 0;
    const void *elements[3] = {frame.instances, frame.buckets, frame.cells};
    const uint32_t counts[3] = {frame.instance_count, frame.bucket_count, frame.cell_count};
    for (uint32_t buffer = 0; buffer < 3 && result == PSAO_OK; buffer++)
        result = upload(ao, client, buffer, elements[buffer], counts[buffer]);
    ao->kernel = (GLint)frame.kernel;
    ao->frame_id = frame.frame_id;
    if (frame.instance_count > 0)
        ao->first = frame.instances[0];
    /* GLES has copied what was passed to it. */
    psao_result released = psao_client_release(client);
    return result < 0 ? result : released;
}

void psao_ao_bind(const psao_ao *ao, GLuint program) {
    if (ao->kernel >= 0)
        for (GLuint buffer = 0; buffer < 3; buffer++)
            glBindBufferBase(GL_SHADER_STORAGE_BUFFER, buffer, ao->buffers[buffer]);
    glUniform1i(glGetUniformLocation(program, "psao_kernel"), ao->kernel);
}

void psao_ao_free(psao_ao *ao) {
    glDeleteBuffers(3, ao->buffers);
    memset(ao, 0, sizeof *ao);
    ao->kernel = -1;
}
