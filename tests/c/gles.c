/* Draws a G-buffer's openness with a generated snippet in an OpenGL ES 3.1 context, as an engine
 * would: the client's three buffers as storage buffers or as textures, a fragment shader that calls
 * the snippet. Reads its input from files and writes FOLDER/openness, floats from the top row.
 *
 *     gles SNIPPET FUNCTION FOLDER WIDTH HEIGHT */
#define EGL_EGLEXT_PROTOTYPES
#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <GLES3/gl31.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(truth)                                                            \
    do {                                                                        \
        if (!(truth)) {                                                         \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #truth); \
            exit(1);                                                            \
        }                                                                       \
    } while (0)

enum { TEXELS_A_ROW = 2048, TEXEL_BYTES = 16 };

static char *read_file(const char *folder, const char *name, size_t *size) {
    char path[4096];
    FILE *file;
    char *bytes;
    CHECK(snprintf(path, sizeof path, "%s%s%s", folder, *folder ? "/" : "", name) <
          (int)sizeof path);
    file = fopen(path, "rb");
    if (!file)
        perror(path);
    CHECK(file && fseek(file, 0, SEEK_END) == 0);
    *size = (size_t)ftell(file);
    rewind(file);
    /* Room for a zero behind text, and for the rest of a row of texels. */
    bytes = calloc(1, *size + TEXELS_A_ROW * TEXEL_BYTES);
    CHECK(bytes && fread(bytes, 1, *size, file) == *size);
    fclose(file);
    return bytes;
}

static void make_context(void) {
    const EGLint config_wants[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT,
                                   EGL_RENDERABLE_TYPE, EGL_OPENGL_ES3_BIT, EGL_NONE};
    const EGLint context_wants[] = {EGL_CONTEXT_MAJOR_VERSION, 3, EGL_CONTEXT_MINOR_VERSION, 1,
                                    EGL_NONE};
    EGLDisplay display;
    EGLConfig config;
    EGLContext context;
    EGLint count = 0;
    display = eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, NULL);
    CHECK(eglInitialize(display, NULL, NULL));
    CHECK(eglBindAPI(EGL_OPENGL_ES_API));
    CHECK(eglChooseConfig(display, config_wants, &config, 1, &count) && count == 1);
    context = eglCreateContext(display, config, EGL_NO_CONTEXT, context_wants);
    CHECK(context != EGL_NO_CONTEXT);
    CHECK(eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, context));
    printf("%s\n", (const char *)glGetString(GL_VERSION));
}

static GLuint compile(GLenum stage, const char *version, const char *snippet, const char *text) {
    const char *parts[3];
    GLuint shader = glCreateShader(stage);
    GLint good = 0;
    char log[4096] = "";
    parts[0] = version;
    parts[1] = snippet;
    parts[2] = text;
    glShaderSource(shader, 3, parts, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &good);
    glGetShaderInfoLog(shader, sizeof log, NULL, log);
    if (!good)
        fprintf(stderr, "%s\n", log);
    CHECK(good);
    return shader;
}

static void texture(GLuint program, const char *name, GLint unit, GLenum format, GLenum external,
                    GLenum type, int width, int height, const void *bytes) {
    GLuint texture;
    GLint place = glGetUniformLocation(program, name);
    CHECK(place >= 0);
    glGenTextures(1, &texture);
    glActiveTexture((GLenum)(GL_TEXTURE0 + unit));
    glBindTexture(GL_TEXTURE_2D, texture);
    glTexParameteri(GL_TEXTURE_2D, GL_TEXTURE_MIN_FILTER, GL_NEAREST);
    glTexParameteri(GL_TEXTURE_2D, GL_TEXTURE_MAG_FILTER, GL_NEAREST);
    glTexStorage2D(GL_TEXTURE_2D, 1, format, width, height);
    glTexSubImage2D(GL_TEXTURE_2D, 0, 0, 0, width, height, external, type, bytes);
    glUniform1i(place, unit);
    CHECK(glGetError() == GL_NO_ERROR);
}

int main(int count, char **words) {
    static const char *const buffers[3] = {"instances", "buckets", "cells"};
    static const char *const samplers[3] = {"psao_instances", "psao_buckets", "psao_cells"};
    static const char vertex[] =
        "void main() {\n"
        "    vec2 at = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1));\n"
        "    gl_Position = vec4(at * 4.0 - 1.0, 0.0, 1.0);\n"
        "}\n";
    static const char fragment[] =
        "uniform highp usampler2D positions;\n"
        "uniform highp sampler2D normals;\n"
        "layout(location = 0) out uvec4 result;\n"
        "void main() {\n"
        "    uvec4 at = texelFetch(positions, ivec2(gl_FragCoord.xy), 0);\n"
        "    vec3 normal = texelFetch(normals, ivec2(gl_FragCoord.xy), 0).xyz;\n"
        "    float openness = 1.0;\n"
        "    if (at.w != 0xffffffffu)\n"
        "        openness = %s(at.w, uintBitsToFloat(at.xyz), normal);\n"
        "    result = uvec4(floatBitsToUint(openness));\n"
        "}\n";
    char text[sizeof fragment + 64], path[4096];
    const char *version;
    char *snippet;
    size_t size;
    int width, height, storage, unit, i;
    GLuint program, target, frame;
    GLint good = 0;
    GLuint *pixels;
    FILE *out;

    CHECK(count == 6);
    width = atoi(words[4]);
    height = atoi(words[5]);
    make_context();
    snippet = read_file("", words[1], &size);
    storage = strstr(words[1], "es310") != NULL;
    version = storage ? "#version 310 es\n" : "#version 300 es\n";
    CHECK(snprintf(text, sizeof text, fragment, words[2]) < (int)sizeof text);
    program = glCreateProgram();
    glAttachShader(program, compile(GL_VERTEX_SHADER, version, "", vertex));
    glAttachShader(program, compile(GL_FRAGMENT_SHADER, version, snippet, text));
    glLinkProgram(program);
    glGetProgramiv(program, GL_LINK_STATUS, &good);
    CHECK(good);
    glUseProgram(program);

    for (i = 0; i < 3; i++) {
        char *bytes = read_file(words[3], buffers[i], &size);
        if (storage) {
            GLuint buffer;
            glGenBuffers(1, &buffer);
            glBindBufferBase(GL_SHADER_STORAGE_BUFFER, (GLuint)i, buffer);
            glBufferData(GL_SHADER_STORAGE_BUFFER, (GLsizeiptr)size, bytes, GL_STATIC_DRAW);
        } else {
            size_t texels = size / TEXEL_BYTES;
            int rows = (int)((texels + TEXELS_A_ROW - 1) / TEXELS_A_ROW);
            texture(program, samplers[i], i, GL_RGBA32UI, GL_RGBA_INTEGER, GL_UNSIGNED_INT,
                    TEXELS_A_ROW, rows, bytes);
        }
        free(bytes);
    }
    unit = 3;
    {
        char *bytes = read_file(words[3], "positions", &size);
        texture(program, "positions", unit++, GL_RGBA32UI, GL_RGBA_INTEGER, GL_UNSIGNED_INT, width,
                height, bytes);
        free(bytes);
        bytes = read_file(words[3], "normals", &size);
        texture(program, "normals", unit++, GL_RGBA32F, GL_RGBA, GL_FLOAT, width, height, bytes);
        free(bytes);
    }

    glGenRenderbuffers(1, &target);
    glBindRenderbuffer(GL_RENDERBUFFER, target);
    glRenderbufferStorage(GL_RENDERBUFFER, GL_RGBA32UI, width, height);
    glGenFramebuffers(1, &frame);
    glBindFramebuffer(GL_FRAMEBUFFER, frame);
    glFramebufferRenderbuffer(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_RENDERBUFFER, target);
    CHECK(glCheckFramebufferStatus(GL_FRAMEBUFFER) == GL_FRAMEBUFFER_COMPLETE);
    glViewport(0, 0, width, height);
    glDrawArrays(GL_TRIANGLES, 0, 3);

    /* The G-buffer's top row was uploaded first, so that it is at the bottom and is read first. */
    pixels = malloc((size_t)width * (size_t)height * 16);
    CHECK(pixels);
    glReadPixels(0, 0, width, height, GL_RGBA_INTEGER, GL_UNSIGNED_INT, pixels);
    CHECK(glGetError() == GL_NO_ERROR);
    CHECK(snprintf(path, sizeof path, "%s/openness", words[3]) < (int)sizeof path);
    out = fopen(path, "wb");
    CHECK(out);
    for (i = 0; i < width * height; i++)
        CHECK(fwrite(&pixels[4 * i], 4, 1, out) == 1);
    CHECK(fclose(out) == 0);
    free(pixels);
    free(snippet);
    return 0;
}
