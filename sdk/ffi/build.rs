//! Gives the shared library its name: programs ask for the ABI that they were linked with.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("linux") {
        // PSAO_ABI_VERSION. (Android takes the file's name.)
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libpsao.so.1");
    }
}
