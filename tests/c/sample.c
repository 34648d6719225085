/* The part of the Android sample that knows of no platform, on this machine's GLES 3.1: what is in
 * the buffers after each frame is what the client has, and the shader looks up what the CPU does.
 *
 *     sample RECORDING.psao [SNIPPET.glsl]
 */
#define _POSIX_C_SOURCE 200809L
#include "common.h"
#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <math.h>
#include <player.h>
#include <psao_ao.h>

enum { SIZE = 64 };

#define GLES_OK() CHECK(glGetError() == GL_NO_ERROR)

static void make_context(void) {
    EGLDisplay display =
        eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, NULL);
    CHECK(display != EGL_NO_DISPLAY && eglInitialize(display, NULL, NULL));
    CHECK(eglBindAPI(EGL_OPENGL_ES_API));
    const EGLint version[] = {EGL_CONTEXT_MAJOR_VERSION, 3, EGL_CONTEXT_MINOR_VERSION, 1, EGL_NONE};
    EGLContext context = eglCreateContext(display, EGL_NO_CONFIG_KHR, EGL_NO_CONTEXT, version);
    CHECK(context != EGL_NO_CONTEXT);
    CHECK(eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, context));
}

static GLuint compile(GLenum stage, const char *const *parts, GLsizei count) {
    GLuint shader = glCreateShader(stage);
    GLint good = 0;
    char text[2000] = "";
    glShaderSource(shader, count, parts, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &good);
    glGetShaderInfoLog(shader, sizeof text, NULL, text);
    if (!good)
        fprintf(stderr, "%s\n", text);
    CHECK(good);
    return shader;
}

/* A picture of openness on a floor, as the bits of floats. */
static GLuint make_program(const char *snippet) {
    const char *vertex[] = {"#version 310 es\n"
                            "void main() {\n"
                            "    vec2 at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0;\n"
                            "    gl_Position = vec4(at, 0, 1);\n"
                            "}\n"};
    const char *fragment[] = {"#version 310 es\n", snippet, PSAO_AO_GLSL,
                              "uniform vec3 corner;\n"
                              "uniform vec2 extent;\n"
                              "uniform float size;\n"
                              "out uint bits;\n"
                              "void main() {\n"
                              "    vec2 at = gl_FragCoord.xy / size * extent;\n"
                              "    vec3 position = corner + vec3(at.x, 0, at.y);\n"
                              "    bits = floatBitsToUint(\n"
                              "        psao_openness(0u, position, vec3(0, 1, 0)));\n"
                              "}\n"};
    GLuint program = glCreateProgram();
    GLint good = 0;
    glAttachShader(program, compile(GL_VERTEX_SHADER, vertex, 1));
    glAttachShader(program, compile(GL_FRAGMENT_SHADER, fragment, 4));
    glLinkProgram(program);
    glGetProgramiv(program, GL_LINK_STATUS, &good);
    CHECK(good);
    return program;
}

static void make_target(void) {
    GLuint texture, target;
    glGenTextures(1, &texture);
    glBindTexture(GL_TEXTURE_2D, texture);
    glTexStorage2D(GL_TEXTURE_2D, 1, GL_R32UI, SIZE, SIZE);
    glGenFramebuffers(1, &target);
    glBindFramebuffer(GL_FRAMEBUFFER, target);
    glFramebufferTexture2D(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D, texture, 0);
    CHECK(glCheckFramebufferStatus(GL_FRAMEBUFFER) == GL_FRAMEBUFFER_COMPLETE);
    glViewport(0, 0, SIZE, SIZE);
}

static void draw(const psao_ao *ao, GLuint program, const float *corner, const float *extent,
                 float *openness) {
    static uint32_t pixels[SIZE * SIZE][4];
    glUseProgram(program);
    psao_ao_bind(ao, program);
    glUniform3fv(glGetUniformLocation(program, "corner"), 1, corner);
    glUniform2fv(glGetUniformLocation(program, "extent"), 1, extent);
    glUniform1f(glGetUniformLocation(program, "size"), SIZE);
    glDrawArrays(GL_TRIANGLES, 0, 3);
    glReadPixels(0, 0, SIZE, SIZE, GL_RGBA_INTEGER, GL_UNSIGNED_INT, pixels);
    GLES_OK();
    for (int i = 0; i < SIZE * SIZE; i++)
        memcpy(&openness[i], &pixels[i][0], sizeof *openness);
}

/* What the GPU has is what the client has. (The frame was taken from the other client.) */
static void check_buffers(const psao_ao *ao, const psao_frame *frame) {
    const void *elements[3] = {frame->instances, frame->buckets, frame->cells};
    const size_t sizes[3] = {frame->instance_count * sizeof(psao_instance),
                             frame->bucket_count * sizeof(psao_bucket),
                             frame->cell_count * sizeof(psao_cell)};
    for (int i = 0; i < 3; i++) {
        CHECK((size_t)ao->bytes[i] == sizes[i]);
        glBindBuffer(GL_COPY_READ_BUFFER, ao->buffers[i]);
        const void *held =
            glMapBufferRange(GL_COPY_READ_BUFFER, 0, ao->bytes[i], GL_MAP_READ_BIT);
        CHECK(held && memcmp(held, elements[i], sizes[i]) == 0);
        CHECK(glUnmapBuffer(GL_COPY_READ_BUFFER));
    }
    GLES_OK();
}

/* Both clients get the same stream; the second is the CPU's word. */
static int step(psao_client *client, bytes stream, size_t *done) {
    while (*done < stream.size) {
        size_t used;
        psao_result result =
            psao_client_push(client, stream.data + *done, stream.size - *done, 0, &used);
        CHECK(result >= 0);
        *done += used;
        if (result == PSAO_OK)
            return 1;
    }
    return 0;
}

/* The sample's other thread. */
static void check_player(psao_ao *ao, bytes stream) {
    const uint8_t nonsense[100] = {0};
    player player;
    GIVES(PSAO_ERROR_NOT_A_STREAM, player_open(&player, nonsense, sizeof nonsense, SIZE_MAX));
    player_close(&player);
    GIVES(PSAO_ERROR_MEMORY_SIZE, player_open(&player, stream.data, stream.size, 1000));
    player_close(&player);
    GIVES(PSAO_OK, player_open(&player, stream.data, stream.size, SIZE_MAX));
    psao_result result = PSAO_NOTHING_NEW;
    for (unsigned last = 0; last < 3; last = ao->frame_id) {
        result = psao_ao_update(ao, player.client);
        CHECK(result >= 0 && player.result >= 0);
    }
    player_pause(&player, 1);
    player_close(&player);
    GLES_OK();
}

int main(int count, char **words) {
    CHECK(count == 2 || count == 3);
    bytes stream = read_file(words[1]);
    psao_config config = config_of(stream);
    owned shown = make(&config), word = make(&config);
    make_context();
    make_target();
    GLuint program = 0;
    if (count == 3) {
        bytes snippet = read_file(words[2]);
        snippet.data[snippet.size] = 0;
        program = make_program((const char *)snippet.data);
    }
    psao_ao ao;
    psao_ao_init(&ao);
    static float openness[SIZE * SIZE], positions[SIZE * SIZE * 3], normals[SIZE * SIZE * 3],
        expected[SIZE * SIZE];
    float corner[3] = {0, 0, 0}, extent[2] = {1, 1};

    /* Before the first frame: open, whatever is asked. */
    GIVES(PSAO_NOTHING_NEW, psao_ao_update(&ao, shown.client));
    if (program) {
        draw(&ao, program, corner, extent, openness);
        for (int i = 0; i < SIZE * SIZE; i++)
            CHECK(openness[i] == 1.0f);
    }

    unsigned frames = 0, occluded = 0;
    uint64_t later_bytes = 0;
    size_t done = 0, word_done = 0;
    for (int round = 0; round < 2; round++) {
        while (step(shown.client, stream, &done)) {
            CHECK(step(word.client, stream, &word_done));
            psao_frame frame;
            memset(&frame, 0, sizeof frame);
            frame.struct_size = sizeof frame;
            GIVES(PSAO_OK, psao_client_take(word.client, &frame));
            GIVES(PSAO_OK, psao_ao_update(&ao, shown.client));
            CHECK(ao.frame_id == frame.frame_id && ao.upload_count > 0);
            check_buffers(&ao, &frame);
            later_bytes += frames > 0 && round == 0 ? ao.uploaded_bytes : 0;
            frames++;
            const psao_instance *grid = frame.instances;
            if (program && grid->bucket_count > 0) {
                for (int axis = 0; axis < 2; axis++)
                    extent[axis] = (float)grid->dims[2 * axis] / grid->cells_per_unit[2 * axis];
                for (int axis = 0; axis < 3; axis++)
                    corner[axis] = grid->origin[axis];
                corner[1] = 0;
                for (int i = 0; i < SIZE * SIZE; i++) {
                    float *at = &positions[3 * i];
                    at[0] = corner[0] + ((float)(i % SIZE) + 0.5f) / SIZE * extent[0];
                    at[1] = corner[1];
                    at[2] = corner[2] + ((float)(i / SIZE) + 0.5f) / SIZE * extent[1];
                    normals[3 * i + 1] = 1.0f;
                }
                draw(&ao, program, corner, extent, openness);
                GIVES(PSAO_OK, psao_client_lookup(word.client, 0, positions, normals, SIZE * SIZE,
                                                  expected));
                for (int i = 0; i < SIZE * SIZE; i++) {
                    CHECK(fabsf(openness[i] - expected[i]) <= 1.0f / 255.0f);
                    occluded += openness[i] < 0.9f;
                }
            }
            GIVES(PSAO_OK, psao_client_release(word.client));
        }
        /* While nothing comes the last frame stays, and so it does when a new stream begins. */
        GIVES(PSAO_NOTHING_NEW, psao_ao_update(&ao, shown.client));
        GIVES(PSAO_OK, psao_client_restart(shown.client));
        GIVES(PSAO_OK, psao_client_restart(word.client));
        done = word_done = 0;
    }
    CHECK(frames > 2);
    check_player(&ao, stream);
    /* Frames after the first bring less than all of it. */
    uint64_t whole = (uint64_t)(ao.bytes[0] + ao.bytes[1] + ao.bytes[2]);
    CHECK(later_bytes > 0 && later_bytes < whole * (frames / 2 - 1));
    psao_ao_free(&ao);
    GLES_OK();
    printf("%s: %u frames on %s; %u occluded\n", words[1], frames, glGetString(GL_RENDERER),
           occluded);
    CHECK(!program || occluded > 100);
    free(shown.block);
    free(word.block);
    free(stream.data);
    return 0;
}
