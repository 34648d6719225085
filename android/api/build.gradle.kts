// The AAR: Java API, native library, and a prefab module, so that native code finds psao::psao.

plugins { alias(libs.plugins.android.library) }

/** Where `cargo ndk -o` puts the native libraries: a folder for each ABI. */
val natives = layout.projectDirectory.dir("jniLibs")
val abis = listOf("arm64-v8a", "x86_64")
val api = libs.versions.minSdk.get()

android {
    namespace = "org.psao"
    compileSdk = libs.versions.compileSdk.get().toInt()
    ndkVersion = libs.versions.ndk.get()
    defaultConfig {
        minSdk = api.toInt()
        consumerProguardFiles("proguard.txt")
        ndk { abiFilters += abis }
    }
    compileOptions {
        sourceCompatibility = JavaVersion.VERSION_1_8
        targetCompatibility = JavaVersion.VERSION_1_8
    }
    sourceSets["main"].apply {
        manifest.srcFile("AndroidManifest.xml")
        java.directories += listOf("core", "android")
        jniLibs.directories += "jniLibs"
    }
}

// AGP publishes only what its own CMake builds as prefab modules. So the module is made here, by
// the script that makes all of the AAR elsewhere, and put into the AAR that AGP made.
val prefab = tasks.register<Exec>("prefab") {
    description = "Makes the prefab module of the native libraries"
    val out = layout.buildDirectory.dir("psao")
    inputs.dir(natives)
    inputs.file("../../include/psao.h")
    outputs.dir(out)
    commandLine("../assemble-aar", "--prefab", natives.asFile.path, out.get().asFile.path)
}

tasks.register<Zip>("aar") {
    description = "The AAR with its prefab module: build/psao.aar"
    archiveFileName = "psao.aar"
    destinationDirectory = layout.buildDirectory
    isPreserveFileTimestamps = false
    isReproducibleFileOrder = true
    from(tasks.named("bundleReleaseAar").map { zipTree(it.outputs.files.singleFile) })
    from(prefab)
}
