/* PSAO in a GLES 3.1 renderer, in one file to copy: buffers, uploads, and what the shader needs.
 *
 *     psao_ao ao;
 *     psao_ao_init(&ao);
 *     program = ... "#version 310 es\n", psao_es310.glsl, PSAO_AO_GLSL, your shader;
 *
 *     each picture, on the thread that draws:
 *         psao_ao_update(&ao, client);
 *         glUseProgram(program);
 *         psao_ao_bind(&ao, program);
 *         draw; your shader multiplies ambient light by psao_openness(instance, position, normal)
 *
 * Starvation. Until a first frame is there everything is open; while nothing comes, the last frame
 * stays. Neither waits, and neither flashes. psao_client_status says which it is.
 *
 * Threads: those of the GLES context, and the client's taker (psao.h). Nothing is allocated but by
 * GLES, and that only where a stream begins. */
#ifndef PSAO_AO_H
#define PSAO_AO_H

#include <GLES3/gl31.h>
#include <psao.h>

#ifdef __cplusplus
extern "C" {
#endif

/* After psao_es310.glsl. What the lookup takes is described there: the instance's number, and
 * position and normal in its local space (its rest space if it is skinned), straight from the
 * vertices. */
#define PSAO_AO_GLSL                                                          \
    "uniform int psao_kernel;\n"                                              \
    "float psao_openness(uint instance, vec3 position, vec3 normal) {\n"      \
    "    if (psao_kernel < 0) return 1.0;\n"                                  \
    "    if (psao_kernel == 0) return psao_paper(instance, position, normal);\n" \
    "    return psao_planar_fast(instance, position, normal);\n"              \
    "}\n"

typedef struct psao_ao {
    /* Instances, buckets, cells, as psao_buffer numbers them, and how long they are. */
    GLuint buffers[3];
    GLsizeiptr bytes[3];
    /* Of the last frame; -1: none has come yet. */
    GLint kernel;
    uint32_t frame_id;
    /* The first instance's grid in that frame, for apps that place something by it. */
    psao_instance first;
    /* Of the last update that brought something. */
    uint32_t upload_count;
    uint64_t uploaded_bytes;
} psao_ao;

/* Makes the buffers, empty. */
void psao_ao_init(psao_ao *ao);

/* Takes the newest frame and uploads what changed in it. Call it once a picture.
 *
 * PSAO_OK: there was one. PSAO_NOTHING_NEW: draw with what you have. Errors: psao_client_take. */
psao_result psao_ao_update(psao_ao *ao, psao_client *client);

/* Binds the buffers to the bindings of psao_es310.glsl, and sets the program in use. */
void psao_ao_bind(const psao_ao *ao, GLuint program);

/* Deletes the buffers, in the context that they are of. */
void psao_ao_free(psao_ao *ao);

#ifdef __cplusplus
}
#endif
#endif
