// An OpenXR app that plays a packaged recording. All of PSAO in it is src/main/cpp/psao_ao.c.

plugins { alias(libs.plugins.android.application) }

android {
    namespace = "org.psao.sample"
    compileSdk = libs.versions.compileSdk.get().toInt()
    ndkVersion = libs.versions.ndk.get()
    defaultConfig {
        applicationId = "org.psao.sample"
        minSdk = libs.versions.minSdk.get().toInt()
        targetSdk = libs.versions.compileSdk.get().toInt()
        ndk { abiFilters += listOf("arm64-v8a", "x86_64") }
    }
    buildFeatures { prefab = true }
    externalNativeBuild { cmake { path = file("src/main/cpp/CMakeLists.txt") } }
    // It is compressed already.
    androidResources { noCompress += "psao" }
}

// The recording and the lookup, from where they are kept.
val assets = tasks.register<Sync>("collectAssets") {
    from("../../tests/conformance/streams/residual.psao") { rename { "recording.psao" } }
    from("../../sdk/shaders/generated/psao_es310.glsl")
    into(layout.buildDirectory.dir("psao-assets"))
}
android.sourceSets["main"].assets.directories += "build/psao-assets"
tasks.named("preBuild") { dependsOn(assets) }

dependencies {
    // `gradle :api:aar` makes it: the AAR with its prefab module.
    implementation(files("../api/build/psao.aar"))
    implementation(libs.openxr.loader)
}
