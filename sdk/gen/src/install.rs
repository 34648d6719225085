//! libpsao where C and C++ projects look for it.

use std::path::Path;
use std::process::Command;

/// How the library is built, and what follows from that for a program that uses it.
struct Variant {
    cargo: &'static str,
    /// What the header wants defined, as for CMake and for a compiler.
    define: [&'static str; 2],
    /// What a program that links libpsao.a has to link besides.
    system_libraries: &'static str,
}

const SMALL: Variant = Variant {
    cargo: "--profile libpsao --no-default-features --features thin",
    define: ["", ""],
    system_libraries: "-lc",
};

const QUIC: Variant = Variant {
    cargo: "--profile sdk --features thin,quic",
    define: ["PSAO_QUIC", " -DPSAO_QUIC"],
    system_libraries: "-lpthread -ldl -lm -lgcc_s -lc",
};

/// Builds the library and puts it, its header, `psao.pc` and a CMake package under `prefix`. With
/// `quic` it can connect by itself.
///
/// # Errors
/// It does not build, or a file cannot be written.
pub fn install(root: &Path, prefix: &Path, quic: bool) -> Result<(), String> {
    let Variant {
        cargo,
        define: [define, cflag],
        system_libraries,
    } = if quic { QUIC } else { SMALL };
    let build = Command::new(std::env::var("CARGO").unwrap_or("cargo".into()))
        .current_dir(root)
        .args(["build", "--locked", "-p", "psao-ffi"])
        .args(cargo.split(' '))
        .args(["--message-format", "json"])
        .output()
        .map_err(|error| format!("cargo: {error}"))?;
    if !build.status.success() {
        let errors = String::from_utf8_lossy(&build.stderr);
        return Err(format!("libpsao does not build:\n{errors}"));
    }
    let messages = String::from_utf8_lossy(&build.stdout);
    let built = |ending: &str| {
        let mut paths = messages.split('"').filter(|part| part.ends_with(ending));
        paths.next_back().ok_or(format!("cargo built no {ending}"))
    };
    let (shared, fixed) = (built("/libpsao.so")?, built("/libpsao.a")?);

    std::fs::create_dir_all(prefix).map_err(|error| format!("{}: {error}", prefix.display()))?;
    let prefix = prefix.canonicalize().map_err(|error| error.to_string())?;
    let version = env!("CARGO_PKG_VERSION");
    let header = std::fs::read_to_string(root.join("include/psao.h"));
    let header = header.map_err(|error| format!("include/psao.h: {error}"))?;
    let abi = "#define PSAO_ABI_VERSION ";
    let abi = header.lines().find_map(|line| line.strip_prefix(abi));
    let soname = format!(
        "libpsao.so.{}",
        abi.ok_or("no ABI version in include/psao.h")?
    );

    let put = |name: &str, content: &[u8]| -> Result<(), String> {
        let path = prefix.join(name);
        let folder = path.parent().unwrap_or(&path);
        std::fs::create_dir_all(folder).map_err(|error| format!("{name}: {error}"))?;
        std::fs::write(&path, content).map_err(|error| format!("{name}: {error}"))
    };
    let read = |name: &str| std::fs::read(name).map_err(|error| format!("{name}: {error}"));
    put("include/psao.h", header.as_bytes())?;
    put(&format!("lib/{soname}"), &read(shared)?)?;
    put("lib/libpsao.a", &read(fixed)?)?;
    let link = prefix.join("lib/libpsao.so");
    let _ = std::fs::remove_file(&link);
    std::os::unix::fs::symlink(&soname, &link).map_err(|error| error.to_string())?;
    put(
        "lib/pkgconfig/psao.pc",
        format!(
            "prefix=${{pcfiledir}}/../..\n\
             Name: psao\n\
             Description: Client of PSAO: streamed, ray-traced ambient occlusion\n\
             Version: {version}\n\
             Cflags: -I${{prefix}}/include{cflag}\n\
             Libs: -L${{prefix}}/lib -lpsao\n\
             Libs.private: {system_libraries}\n"
        )
        .as_bytes(),
    )?;
    put(
        "lib/cmake/psao/psaoConfig.cmake",
        format!(
            "# psao::psao is the shared library, psao::static the other.\n\
             set(psao_prefix \"${{CMAKE_CURRENT_LIST_DIR}}/../../..\")\n\
             if(NOT TARGET psao::psao)\n\
             \x20 add_library(psao::psao SHARED IMPORTED)\n\
             \x20 set_target_properties(psao::psao PROPERTIES\n\
             \x20   IMPORTED_LOCATION \"${{psao_prefix}}/lib/{soname}\"\n\
             \x20   IMPORTED_SONAME \"{soname}\"\n\
             \x20   INTERFACE_COMPILE_DEFINITIONS \"{define}\"\n\
             \x20   INTERFACE_INCLUDE_DIRECTORIES \"${{psao_prefix}}/include\")\n\
             \x20 add_library(psao::static STATIC IMPORTED)\n\
             \x20 set_target_properties(psao::static PROPERTIES\n\
             \x20   IMPORTED_LOCATION \"${{psao_prefix}}/lib/libpsao.a\"\n\
             \x20   INTERFACE_LINK_LIBRARIES \"{system_libraries}\"\n\
             \x20   INTERFACE_COMPILE_DEFINITIONS \"{define}\"\n\
             \x20   INTERFACE_INCLUDE_DIRECTORIES \"${{psao_prefix}}/include\")\n\
             endif()\n"
        )
        .as_bytes(),
    )?;
    put(
        "lib/cmake/psao/psaoConfigVersion.cmake",
        format!(
            "set(PACKAGE_VERSION {version})\n\
             if(PACKAGE_FIND_VERSION VERSION_LESS_EQUAL PACKAGE_VERSION)\n\
             \x20 set(PACKAGE_VERSION_COMPATIBLE TRUE)\n\
             endif()\n"
        )
        .as_bytes(),
    )?;
    println!("libpsao {version} is in {}", prefix.display());
    Ok(())
}
