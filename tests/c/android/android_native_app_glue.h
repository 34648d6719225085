/* As far as android/sample uses it, so that it can be compiled without the NDK. */
#ifndef ANDROID_NATIVE_APP_GLUE_H
#define ANDROID_NATIVE_APP_GLUE_H

typedef struct ANativeActivity {
    struct AAssetManager *assetManager;
    void *vm, *clazz;
} ANativeActivity;

struct android_app {
    ANativeActivity *activity;
    int destroyRequested;
};

struct android_poll_source {
    void (*process)(struct android_app *app, struct android_poll_source *source);
};

int ALooper_pollOnce(int timeout_ms, int *fd, int *events, void **data);
void android_main(struct android_app *app);
#endif
