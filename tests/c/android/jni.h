/* As far as OpenXR's header uses it, so that android/sample can be compiled without the NDK. */
typedef void *jobject;
