// Needs the Android SDK and, for the native library, the NDK: docs/android.md has the commands.
// android/assemble-aar makes the same AAR without either.
pluginManagement {
    repositories {
        google()
        mavenCentral()
        gradlePluginPortal()
    }
}

dependencyResolutionManagement {
    repositoriesMode = RepositoriesMode.FAIL_ON_PROJECT_REPOS
    repositories {
        google()
        mavenCentral()
    }
}

rootProject.name = "psao"
include(":api", ":sample")
