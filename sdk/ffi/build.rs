//! Gives the shared library its name: programs ask for the ABI that they were linked with. And
//! compiles what stops a panic where there is no standard library.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=src/guard.c");
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("linux") {
        // PSAO_ABI_VERSION. (Android takes the file's name.)
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libpsao.so.1");
    }
    if std::env::var_os("CARGO_FEATURE_STD").is_none() {
        cc::Build::new().file("src/guard.c").compile("psao_guard");
    }
}
