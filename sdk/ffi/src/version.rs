//! Which library this is.

/// The library's version, of this header: 10000 major + 100 minor + patch.
pub const PSAO_VERSION: u32 = 100;

/// The version of the ABI. Functions say since which one they are there; none goes away or changes
/// within a major version of the library.
pub const PSAO_ABI_VERSION: u32 = 1;

/// The version of the stream format that this header was made for: 10000 major + minor.
pub const PSAO_STREAM_VERSION: u32 = 10000;

/// The library's version, which should be PSAO_VERSION: else the header is not the library's.
///
/// Threads: any. No alloc, lock or log. Since ABI 1.
#[unsafe(no_mangle)]
pub extern "C" fn psao_version() -> u32 {
    PSAO_VERSION
}

/// The ABI's version of the library: at least PSAO_ABI_VERSION, or functions are missing.
///
/// Threads: any. No alloc, lock or log. Since ABI 1.
#[unsafe(no_mangle)]
pub extern "C" fn psao_abi_version() -> u32 {
    PSAO_ABI_VERSION
}

#[cfg(test)]
mod tests {
    use super::*;
    use psao::core::stream::{VERSION_MAJOR, VERSION_MINOR};

    #[test]
    fn the_versions_are_those_of_the_package_and_the_format() {
        let part = |text: &str| text.parse::<u32>().unwrap();
        let version = [
            env!("CARGO_PKG_VERSION_MAJOR"),
            env!("CARGO_PKG_VERSION_MINOR"),
            env!("CARGO_PKG_VERSION_PATCH"),
        ]
        .map(part);
        assert_eq!(
            PSAO_VERSION,
            version[0] * 10000 + version[1] * 100 + version[2]
        );
        let stream = u32::from(VERSION_MAJOR) * 10000 + u32::from(VERSION_MINOR);
        assert_eq!(PSAO_STREAM_VERSION, stream);
    }
}
