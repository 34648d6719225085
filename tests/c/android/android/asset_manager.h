/* As far as android/sample uses it, so that it can be compiled without the NDK. */
#include <stddef.h>
#include <stdint.h>

typedef struct AAsset AAsset;
struct AAssetManager;
enum { AASSET_MODE_BUFFER = 3 };
AAsset *AAssetManager_open(struct AAssetManager *manager, const char *name, int mode);
int64_t AAsset_getLength64(AAsset *asset);
int AAsset_read(AAsset *asset, void *to, size_t bytes);
void AAsset_close(AAsset *asset);
