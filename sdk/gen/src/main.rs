//! Writes what is generated from the SDK's sources and checked in, or checks that it is current;
//! builds libpsao and installs it.

mod header;
mod install;
mod shaders;

use clap::{Parser, Subcommand};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Generated files of the PSAO SDK
#[derive(Parser)]
#[command(name = "psao-gen")]
struct Args {
    /// Write nothing; fail if a file is not what would be written
    #[arg(long)]
    check: bool,
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Build libpsao and install it with its header, pkg-config and CMake files
    Install {
        /// Where to: lib/, include/ in it are made
        #[arg(long)]
        prefix: PathBuf,
        /// Build it with its own transport: larger, with a thread and memory from the heap
        #[arg(long)]
        quic: bool,
    },
}

fn main() -> ExitCode {
    let args = Args::parse();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let done = match args.command {
        Some(Command::Install { prefix, quic }) => install::install(&root, &prefix, quic),
        None => generated(&root).and_then(|files| settle(&root, &files, args.check)),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("psao-gen: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Each file's path from the root, and what belongs in it.
fn generated(root: &Path) -> Result<Vec<(&'static str, String)>, String> {
    let header = header::generate(root)?;
    let exports: String = header::functions(&header)
        .iter()
        .map(|name| format!("{name}\n"))
        .collect();
    let mut files = vec![("include/psao.h", header), ("sdk/ffi/exports.txt", exports)];
    files.extend(shaders::generate(root)?);
    Ok(files)
}

fn settle(root: &Path, files: &[(&str, String)], check: bool) -> Result<(), String> {
    for (name, text) in files {
        let path = root.join(name);
        let present = std::fs::read_to_string(&path).unwrap_or_default();
        if present == *text {
            continue;
        }
        if check {
            return Err(format!("{name} is not current: run cargo run -p psao-gen"));
        }
        std::fs::write(&path, text).map_err(|error| format!("{name}: {error}"))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_checked_in_is_what_is_generated() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        settle(&root, &generated(&root).unwrap(), true).unwrap();
    }

    #[test]
    fn a_changed_file_is_noticed_and_written_anew() {
        let folder = tempfile::tempdir().unwrap();
        let files = [("file", "new".to_string())];
        std::fs::write(folder.path().join("file"), "old").unwrap();
        assert!(settle(folder.path(), &files, true).is_err());
        settle(folder.path(), &files, false).unwrap();
        assert_eq!(settle(folder.path(), &files, true), Ok(()));
    }
}
