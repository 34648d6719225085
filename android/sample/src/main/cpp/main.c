/* An OpenXR app on GLES 3.1 that plays a recording from its assets and draws the floor of its first
 * instance, lit by nothing but openness. What is PSAO's is in psao_ao.c (the thread that draws) and
 * player.c (the thread that has the bytes); the rest is what any OpenXR app does. */
#define XR_USE_PLATFORM_ANDROID
#define XR_USE_GRAPHICS_API_OPENGL_ES
#include "player.h"
#include "psao_ao.h"
#include <EGL/egl.h>
#include <android/asset_manager.h>
#include <android/log.h>
#include <android_native_app_glue.h>
#include <jni.h>
#include <math.h>
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>
#include <stdlib.h>
#include <string.h>

enum { VIEWS = 2, MOST_IMAGES = 8, MOST_BYTES = 256 << 20 };

#define SAY(...) __android_log_print(ANDROID_LOG_INFO, "psao", __VA_ARGS__)

/* What cannot be done without: says it, and ends the app. */
static void must(int truth, const char *what) {
    if (!truth) {
        __android_log_print(ANDROID_LOG_FATAL, "psao", "failed: %s", what);
        exit(1);
    }
}

#define XR(call) must(XR_SUCCEEDED(call), #call)

typedef struct eye {
    XrSwapchain swapchain;
    uint32_t width, height, image_count;
    GLuint targets[MOST_IMAGES], depth;
} eye;

typedef struct app {
    struct android_app *android;
    EGLDisplay display;
    EGLConfig config;
    EGLContext context;
    XrInstance instance;
    XrSystemId system;
    XrSession session;
    XrSpace space;
    XrSessionState state;
    int running;
    eye eyes[VIEWS];
    GLuint program;
    char *snippet;
    uint8_t *recording;
    player player;
    psao_ao ao;
} app;

/* A file from the package, with a zero byte behind it. */
static void *read_asset(const app *self, const char *name, size_t *bytes) {
    AAsset *asset = AAssetManager_open(self->android->activity->assetManager, name,
                                       AASSET_MODE_BUFFER);
    must(asset != NULL, name);
    size_t length = (size_t)AAsset_getLength64(asset);
    char *content = malloc(length + 1);
    must(content && AAsset_read(asset, content, length) == (int)length, name);
    AAsset_close(asset);
    content[length] = 0;
    *bytes = length;
    return content;
}

static void make_context(app *self) {
    const EGLint wanted[] = {EGL_RENDERABLE_TYPE, EGL_OPENGL_ES3_BIT, EGL_SURFACE_TYPE,
                             EGL_PBUFFER_BIT, EGL_RED_SIZE, 8, EGL_NONE};
    const EGLint version[] = {EGL_CONTEXT_MAJOR_VERSION, 3, EGL_CONTEXT_MINOR_VERSION, 1, EGL_NONE};
    const EGLint size[] = {EGL_WIDTH, 16, EGL_HEIGHT, 16, EGL_NONE};
    EGLint count = 0;
    self->display = eglGetDisplay(EGL_DEFAULT_DISPLAY);
    must(eglInitialize(self->display, NULL, NULL), "EGL");
    must(eglChooseConfig(self->display, wanted, &self->config, 1, &count) && count == 1,
         "a GLES 3 config");
    self->context = eglCreateContext(self->display, self->config, EGL_NO_CONTEXT, version);
    EGLSurface nothing = eglCreatePbufferSurface(self->display, self->config, size);
    must(eglMakeCurrent(self->display, nothing, nothing, self->context), "a GLES 3.1 context");
    GLint blocks = 0;
    glGetIntegerv(GL_MAX_FRAGMENT_SHADER_STORAGE_BLOCKS, &blocks);
    must(blocks >= 3, "three storage buffers in fragment shaders: use psao_es300.glsl here");
}

static GLuint compile(GLenum stage, const char *const *parts, GLsizei count) {
    GLuint shader = glCreateShader(stage);
    GLint good = 0;
    char text[1000] = "";
    glShaderSource(shader, count, parts, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &good);
    glGetShaderInfoLog(shader, sizeof text, NULL, text);
    must(good, text);
    return shader;
}

static void make_program(app *self) {
    /* The instance's local position and normal are varyings, straight from the vertices. */
    static const char *const vertex[] = {
        "#version 310 es\n"
        "uniform mat4 clip_from_world;\n"
        "uniform vec3 corner;\n"
        "uniform vec2 extent;\n"
        "out highp vec3 position;\n"
        "void main() {\n"
        "    vec2 at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * extent;\n"
        "    position = corner + vec3(at.x, 0, at.y);\n"
        "    vec3 world = vec3(at.x - 0.5 * extent.x, -1.2, -at.y);\n"
        "    gl_Position = clip_from_world * vec4(world, 1);\n"
        "}\n"};
    const char *const fragment[] = {"#version 310 es\n", self->snippet, PSAO_AO_GLSL,
                                    "in highp vec3 position;\n"
                                    "out vec4 color;\n"
                                    "void main() {\n"
                                    "    float open = psao_openness(0u, position, vec3(0, 1, 0));\n"
                                    "    color = vec4(vec3(open), 1);\n"
                                    "}\n"};
    GLint good = 0;
    self->program = glCreateProgram();
    glAttachShader(self->program, compile(GL_VERTEX_SHADER, vertex, 1));
    glAttachShader(self->program, compile(GL_FRAGMENT_SHADER, fragment, 4));
    glLinkProgram(self->program);
    glGetProgramiv(self->program, GL_LINK_STATUS, &good);
    must(good, "the program");
}

static PFN_xrVoidFunction function(app *self, const char *name) {
    PFN_xrVoidFunction found = NULL;
    XR(xrGetInstanceProcAddr(self->instance, name, &found));
    return found;
}

static void make_session(app *self) {
    PFN_xrInitializeLoaderKHR initialize =
        (PFN_xrInitializeLoaderKHR)function(self, "xrInitializeLoaderKHR");
    XrLoaderInitInfoAndroidKHR loader = {XR_TYPE_LOADER_INIT_INFO_ANDROID_KHR, NULL,
                                         self->android->activity->vm,
                                         self->android->activity->clazz};
    XR(initialize((const XrLoaderInitInfoBaseHeaderKHR *)&loader));

    const char *const extensions[] = {XR_KHR_ANDROID_CREATE_INSTANCE_EXTENSION_NAME,
                                      XR_KHR_OPENGL_ES_ENABLE_EXTENSION_NAME};
    XrInstanceCreateInfoAndroidKHR android = {XR_TYPE_INSTANCE_CREATE_INFO_ANDROID_KHR, NULL,
                                              self->android->activity->vm,
                                              self->android->activity->clazz};
    XrInstanceCreateInfo create = {.type = XR_TYPE_INSTANCE_CREATE_INFO, .next = &android};
    strcpy(create.applicationInfo.applicationName, "psao");
    create.applicationInfo.apiVersion = XR_MAKE_VERSION(1, 0, 0);
    create.enabledExtensionCount = 2;
    create.enabledExtensionNames = extensions;
    XR(xrCreateInstance(&create, &self->instance));
    XrSystemGetInfo headset = {XR_TYPE_SYSTEM_GET_INFO, NULL,
                               XR_FORM_FACTOR_HEAD_MOUNTED_DISPLAY};
    XR(xrGetSystem(self->instance, &headset, &self->system));

    /* OpenXR wants to be asked before a session is made. */
    PFN_xrGetOpenGLESGraphicsRequirementsKHR ask =
        (PFN_xrGetOpenGLESGraphicsRequirementsKHR)function(
            self, "xrGetOpenGLESGraphicsRequirementsKHR");
    XrGraphicsRequirementsOpenGLESKHR needs = {.type = XR_TYPE_GRAPHICS_REQUIREMENTS_OPENGL_ES_KHR};
    XR(ask(self->instance, self->system, &needs));
    XrGraphicsBindingOpenGLESAndroidKHR binding = {XR_TYPE_GRAPHICS_BINDING_OPENGL_ES_ANDROID_KHR,
                                                   NULL, self->display, self->config,
                                                   self->context};
    XrSessionCreateInfo session = {XR_TYPE_SESSION_CREATE_INFO, &binding, 0, self->system};
    XR(xrCreateSession(self->instance, &session, &self->session));
    XrReferenceSpaceCreateInfo space = {.type = XR_TYPE_REFERENCE_SPACE_CREATE_INFO,
                                        .referenceSpaceType = XR_REFERENCE_SPACE_TYPE_LOCAL};
    space.poseInReferenceSpace.orientation.w = 1.0f;
    XR(xrCreateReferenceSpace(self->session, &space, &self->space));
}

static void make_eye(app *self, eye *eye, const XrViewConfigurationView *view) {
    eye->width = view->recommendedImageRectWidth;
    eye->height = view->recommendedImageRectHeight;
    XrSwapchainCreateInfo create = {.type = XR_TYPE_SWAPCHAIN_CREATE_INFO,
                                    .usageFlags = XR_SWAPCHAIN_USAGE_COLOR_ATTACHMENT_BIT,
                                    .format = GL_SRGB8_ALPHA8,
                                    .sampleCount = 1,
                                    .width = eye->width,
                                    .height = eye->height,
                                    .faceCount = 1,
                                    .arraySize = 1,
                                    .mipCount = 1};
    XR(xrCreateSwapchain(self->session, &create, &eye->swapchain));
    XR(xrEnumerateSwapchainImages(eye->swapchain, 0, &eye->image_count, NULL));
    must(eye->image_count <= MOST_IMAGES, "no more than 8 images in a swapchain");
    XrSwapchainImageOpenGLESKHR images[MOST_IMAGES];
    memset(images, 0, sizeof images);
    for (uint32_t i = 0; i < eye->image_count; i++)
        images[i].type = XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_ES_KHR;
    XR(xrEnumerateSwapchainImages(eye->swapchain, eye->image_count, &eye->image_count,
                                  (XrSwapchainImageBaseHeader *)images));
    glGenRenderbuffers(1, &eye->depth);
    glBindRenderbuffer(GL_RENDERBUFFER, eye->depth);
    glRenderbufferStorage(GL_RENDERBUFFER, GL_DEPTH_COMPONENT24, (GLsizei)eye->width,
                          (GLsizei)eye->height);
    glGenFramebuffers((GLsizei)eye->image_count, eye->targets);
    for (uint32_t i = 0; i < eye->image_count; i++) {
        glBindFramebuffer(GL_FRAMEBUFFER, eye->targets[i]);
        glFramebufferTexture2D(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D,
                               images[i].image, 0);
        glFramebufferRenderbuffer(GL_FRAMEBUFFER, GL_DEPTH_ATTACHMENT, GL_RENDERBUFFER,
                                  eye->depth);
    }
}

static void make_eyes(app *self) {
    XrViewConfigurationView views[VIEWS];
    memset(views, 0, sizeof views);
    for (int i = 0; i < VIEWS; i++)
        views[i].type = XR_TYPE_VIEW_CONFIGURATION_VIEW;
    uint32_t count = 0;
    XR(xrEnumerateViewConfigurationViews(self->instance, self->system,
                                         XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO, VIEWS, &count,
                                         views));
    for (uint32_t i = 0; i < count; i++)
        make_eye(self, &self->eyes[i], &views[i]);
}

/* Column by column: the view's projection times the inverse of its pose. */
static void clip_from_world(const XrView *view, float *out) {
    const float near = 0.05f, far = 100.0f;
    float left = tanf(view->fov.angleLeft), right = tanf(view->fov.angleRight);
    float down = tanf(view->fov.angleDown), up = tanf(view->fov.angleUp);
    const float projection[16] = {2 / (right - left), 0, 0, 0,
                                  0, 2 / (up - down), 0, 0,
                                  (right + left) / (right - left), (up + down) / (up - down),
                                  -(far + near) / (far - near), -1,
                                  0, 0, -2 * far * near / (far - near), 0};
    XrQuaternionf q = view->pose.orientation;
    XrVector3f p = view->pose.position;
    /* Rows of the rotation are columns of its inverse. */
    const float r[9] = {1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y - q.w * q.z),
                        2 * (q.x * q.z + q.w * q.y),     2 * (q.x * q.y + q.w * q.z),
                        1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z - q.w * q.x),
                        2 * (q.x * q.z - q.w * q.y),     2 * (q.y * q.z + q.w * q.x),
                        1 - 2 * (q.x * q.x + q.y * q.y)};
    const float eye_from_world[16] = {r[0], r[1], r[2], 0, r[3], r[4], r[5], 0,
                                      r[6], r[7], r[8], 0,
                                      -(r[0] * p.x + r[3] * p.y + r[6] * p.z),
                                      -(r[1] * p.x + r[4] * p.y + r[7] * p.z),
                                      -(r[2] * p.x + r[5] * p.y + r[8] * p.z), 1};
    for (int column = 0; column < 4; column++)
        for (int row = 0; row < 4; row++) {
            float sum = 0;
            for (int k = 0; k < 4; k++)
                sum += projection[4 * k + row] * eye_from_world[4 * column + k];
            out[4 * column + row] = sum;
        }
}

static void draw_eye(app *self, const XrView *view, GLuint target, const eye *eye) {
    float matrix[16];
    clip_from_world(view, matrix);
    glBindFramebuffer(GL_FRAMEBUFFER, target);
    glViewport(0, 0, (GLsizei)eye->width, (GLsizei)eye->height);
    glClearColor(0.05f, 0.05f, 0.08f, 1.0f);
    glClear(GL_COLOR_BUFFER_BIT | GL_DEPTH_BUFFER_BIT);
    glUseProgram(self->program);
    psao_ao_bind(&self->ao, self->program);
    glUniformMatrix4fv(glGetUniformLocation(self->program, "clip_from_world"), 1, GL_FALSE, matrix);
    /* The floor of the first instance, as far as its points reach. */
    const psao_instance *grid = &self->ao.first;
    if (grid->bucket_count == 0)
        return;
    glUniform3f(glGetUniformLocation(self->program, "corner"), grid->origin[0], 0, grid->origin[2]);
    glUniform2f(glGetUniformLocation(self->program, "extent"),
                (float)grid->dims[0] / grid->cells_per_unit[0],
                (float)grid->dims[2] / grid->cells_per_unit[2]);
    glDrawArrays(GL_TRIANGLE_STRIP, 0, 4);
}

static void draw(app *self) {
    XrFrameState frame = {.type = XR_TYPE_FRAME_STATE};
    XR(xrWaitFrame(self->session, NULL, &frame));
    XR(xrBeginFrame(self->session, NULL));
    must(psao_ao_update(&self->ao, self->player.client) >= 0, "psao_ao_update");
    XrCompositionLayerProjectionView shown[VIEWS];
    memset(shown, 0, sizeof shown);
    uint32_t count = 0;
    if (frame.shouldRender) {
        XrView views[VIEWS];
        memset(views, 0, sizeof views);
        views[0].type = views[1].type = XR_TYPE_VIEW;
        XrViewState state = {.type = XR_TYPE_VIEW_STATE};
        XrViewLocateInfo locate = {
            .type = XR_TYPE_VIEW_LOCATE_INFO,
            .viewConfigurationType = XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO,
            .displayTime = frame.predictedDisplayTime,
            .space = self->space};
        XR(xrLocateViews(self->session, &locate, &state, VIEWS, &count, views));
        for (uint32_t i = 0; i < count; i++) {
            eye *eye = &self->eyes[i];
            uint32_t image = 0;
            XR(xrAcquireSwapchainImage(eye->swapchain, NULL, &image));
            XrSwapchainImageWaitInfo wait = {.type = XR_TYPE_SWAPCHAIN_IMAGE_WAIT_INFO,
                                             .timeout = XR_INFINITE_DURATION};
            XR(xrWaitSwapchainImage(eye->swapchain, &wait));
            draw_eye(self, &views[i], eye->targets[image], eye);
            XR(xrReleaseSwapchainImage(eye->swapchain, NULL));
            shown[i].type = XR_TYPE_COMPOSITION_LAYER_PROJECTION_VIEW;
            shown[i].pose = views[i].pose;
            shown[i].fov = views[i].fov;
            shown[i].subImage.swapchain = eye->swapchain;
            shown[i].subImage.imageRect.extent.width = (int32_t)eye->width;
            shown[i].subImage.imageRect.extent.height = (int32_t)eye->height;
        }
    }
    XrCompositionLayerProjection layer = {.type = XR_TYPE_COMPOSITION_LAYER_PROJECTION,
                                          .space = self->space,
                                          .viewCount = count,
                                          .views = shown};
    const XrCompositionLayerBaseHeader *layers[] = {(const XrCompositionLayerBaseHeader *)&layer};
    XrFrameEndInfo end = {.type = XR_TYPE_FRAME_END_INFO,
                          .displayTime = frame.predictedDisplayTime,
                          .environmentBlendMode = XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
                          .layerCount = count > 0 ? 1 : 0,
                          .layers = layers};
    XR(xrEndFrame(self->session, &end));
}

/* The recording plays while the session runs, and stands while it does not. */
static void follow_session(app *self) {
    XrEventDataBuffer event = {.type = XR_TYPE_EVENT_DATA_BUFFER};
    while (xrPollEvent(self->instance, &event) == XR_SUCCESS) {
        if (event.type == XR_TYPE_EVENT_DATA_SESSION_STATE_CHANGED) {
            self->state = ((const XrEventDataSessionStateChanged *)&event)->state;
            XrSessionBeginInfo begin = {XR_TYPE_SESSION_BEGIN_INFO, NULL,
                                        XR_VIEW_CONFIGURATION_TYPE_PRIMARY_STEREO};
            if (self->state == XR_SESSION_STATE_READY) {
                XR(xrBeginSession(self->session, &begin));
                self->running = 1;
            } else if (self->state == XR_SESSION_STATE_STOPPING) {
                XR(xrEndSession(self->session));
                self->running = 0;
            }
            player_pause(&self->player, !self->running);
        }
        memset(&event, 0, sizeof event);
        event.type = XR_TYPE_EVENT_DATA_BUFFER;
    }
}

void android_main(struct android_app *android) {
    static app self;
    size_t bytes;
    memset(&self, 0, sizeof self);
    self.android = android;
    self.snippet = read_asset(&self, "psao_es310.glsl", &bytes);
    self.recording = read_asset(&self, "recording.psao", &bytes);
    make_context(&self);
    make_program(&self);
    make_session(&self);
    make_eyes(&self);
    psao_ao_init(&self.ao);
    psao_result opened = player_open(&self.player, self.recording, bytes, MOST_BYTES);
    must(opened == PSAO_OK, psao_result_str(opened));
    player_pause(&self.player, 1);
    SAY("plays %zu bytes", bytes);
    while (!android->destroyRequested && self.state != XR_SESSION_STATE_EXITING) {
        int events;
        struct android_poll_source *source = NULL;
        while (ALooper_pollOnce(self.running ? 0 : 100, NULL, &events, (void **)&source) >= 0)
            if (source)
                source->process(android, source);
        follow_session(&self);
        if (self.running)
            draw(&self);
    }
    player_close(&self.player);
    psao_ao_free(&self.ao);
    xrDestroyInstance(self.instance);
    free(self.recording);
    free(self.snippet);
}
