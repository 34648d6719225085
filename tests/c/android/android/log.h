/* As far as android/sample uses it, so that it can be compiled without the NDK. */
enum { ANDROID_LOG_INFO = 4, ANDROID_LOG_FATAL = 7 };
int __android_log_print(int priority, const char *tag, const char *format, ...);
