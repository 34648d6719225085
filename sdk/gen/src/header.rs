//! `include/psao.h`, from the sources of `sdk/ffi`.

use cbindgen::{Builder, Config, DocumentationStyle, Language, Style};
use std::path::Path;

/// What a reader of the header reads first.
const INTRODUCTION: &str = "\
/* libpsao: ambient occlusion that a server traces, as points that your shaders blend.
 * Generated from sdk/ffi by psao-gen: do not edit.
 *
 * A client follows one stream. It does no input or output, has no thread and no clock, and takes
 * no memory but the block that you give it:
 *
 *     psao_config config = {.struct_size = sizeof config};
 *     config.cell_count = ...;                         what it may hold: you say it, or
 *     psao_config_from_stream(bytes, n, &config);      a stream's first bytes
 *     psao_client_memory_size(&config, &size, &align); one block, yours to take and to free
 *     psao_client_init(&config, memory, size, &client);
 *
 *     for each piece of the stream, until it is used up:
 *         psao_client_push(client, bytes, n, now_ns, &used);
 *
 *     for each picture:
 *         if (psao_client_take(client, &frame) == PSAO_OK) {
 *             psao_client_dirty_ranges(...);           upload these parts of frame's buffers
 *             psao_client_release(client);
 *         }
 *
 * Threads. Pushing is one side, taking the other; psao_client says which functions are whose. Each
 * side must be one thread at a time. With config.two_threads = 1 the sides may be two threads that
 * run at once, and never wait for each other: a frame that is complete while the other side reads
 * stays with the pusher and is merged into the next. Whatever the timing, a frame taken is whole,
 * and frames come in the order sent.
 *
 * Results. 0 and above is a success, below 0 a failure; on failure no output is written. Many
 * clients may live in one process. Nothing here is global, and nothing throws.
 */
";

/// Defined by those whose library has the feature `quic`.
const QUIC: &str = "PSAO_QUIC";

/// The header's text.
///
/// # Errors
/// The sources do not parse.
pub fn generate(root: &Path) -> Result<String, String> {
    let mut config = Config {
        language: Language::C,
        cpp_compat: true,
        include_guard: Some("PSAO_H".into()),
        documentation_style: DocumentationStyle::C,
        style: Style::Both,
        usize_is_size_t: true,
        no_includes: true,
        sys_includes: vec!["stddef.h".into(), "stdint.h".into()],
        line_length: 100,
        ..Config::default()
    };
    config.defines.insert("feature = quic".into(), QUIC.into());
    // Enums that functions take and write as uint32_t.
    config.export.include = ["psao_log_level", "psao_buffer", "psao_state"]
        .map(String::from)
        .to_vec();
    let builder = Builder::new().with_config(config);
    let builder = builder.with_src(root.join("sdk/ffi/src/lib.rs"));
    let bindings = builder
        .generate()
        .map_err(|error| format!("sdk/ffi: {error}"))?;
    let mut text = Vec::new();
    bindings.write(&mut text);
    let text = String::from_utf8(text).map_err(|error| error.to_string())?;
    let out = format!("{INTRODUCTION}{}", enums(&comments(&text)));
    check_documented(&out)?;
    Ok(out)
}

/// Comments as a person would set them, without what only Rust needs to say.
fn comments(text: &str) -> String {
    let mut out = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if line.trim() != "/*" {
            out.push_str(line.trim_end());
            out.push('\n');
            continue;
        }
        let indent = &line[..line.len() - 2];
        let body: Vec<&str> = lines
            .by_ref()
            .map(str::trim)
            .take_while(|line| *line != "*/")
            .collect();
        let end = body.iter().position(|line| *line == "# Safety");
        let body = &body[..end.unwrap_or(body.len())];
        let last = body.iter().rposition(|line| !line.is_empty()).unwrap_or(0);
        for (at, line) in body[..=last].iter().enumerate() {
            let lead = if at == 0 { "/* " } else { " * " };
            out.push_str(indent);
            out.push_str(format!("{lead}{line}").trim_end());
            out.push_str(if at == last { " */\n" } else { "\n" });
        }
    }
    out
}

/// Enums as an integer type and its values: of the same size in every language and compiler, and
/// free to gain values.
fn enums(text: &str) -> String {
    let mut out = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let name = line
            .strip_prefix("enum ")
            .filter(|rest| !rest.contains(' '));
        let Some(name) = name else {
            out.push_str(line);
            out.push('\n');
            continue;
        };
        let head: Vec<&str> = lines
            .by_ref()
            .take_while(|line| line.trim() != "{")
            .collect();
        let kind = head.iter().find_map(|line| line.trim().strip_prefix(": "));
        out.push_str(&format!(
            "typedef {} {name};\nenum {{\n",
            kind.unwrap_or("int")
        ));
        for line in lines.by_ref().take_while(|line| *line != "};") {
            out.push_str(&format!("{line}\n"));
        }
        out.push_str("};\n");
        // cbindgen's own typedef.
        let ends = |line: &&str| *line != "#endif // __cplusplus";
        lines.by_ref().take_while(ends).for_each(drop);
    }
    out
}

/// Functions that the header declares, sorted, but for those of the feature `quic`.
pub fn functions(header: &str) -> Vec<String> {
    let optional = format!("#if defined({QUIC})\n");
    let always = header
        .split("\n\n")
        .filter(|part| !part.starts_with(&optional));
    let header = always.collect::<Vec<_>>().join("\n\n") + "\n\n";
    let mut names: Vec<String> = declarations(&header)
        .map(|(name, _)| name.to_string())
        .collect();
    names.sort();
    names
}

/// Each function with the comment above it.
fn declarations(header: &str) -> impl Iterator<Item = (&str, &str)> {
    let mut comment = "";
    header.split_inclusive("\n\n").flat_map(move |part| {
        let part = match part.strip_prefix("#if ") {
            Some(rest) => rest.split_once('\n')?.1,
            None => part,
        };
        if part.starts_with("/*") {
            comment = part;
        }
        let code = part.rsplit("*/\n").next().unwrap_or("");
        let open = code.find('(')?;
        let name = code[..open].rsplit([' ', '*']).next()?;
        let function = name.starts_with("psao_") && !code.starts_with("typedef");
        function.then_some((name, comment))
    })
}

/// Every function says what a caller must know.
fn check_documented(header: &str) -> Result<(), String> {
    for (name, comment) in declarations(header) {
        let comment = comment.replace("\n * ", " ");
        for must in ["Threads", "Since ABI"] {
            if !comment.contains(must) {
                return Err(format!("{name}: its comment does not say \"{must}\""));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_function_without_its_threads_is_noticed() {
        let good = "/* Does.\n * Threads: any. Since ABI 1. */\npsao_result psao_do(int x);\n\n";
        assert_eq!(check_documented(good), Ok(()));
        assert_eq!(functions(good), ["psao_do"]);
        let bad = good.replace("Threads", "Treads");
        assert!(check_documented(&bad).unwrap_err().contains("psao_do"));
        assert!(check_documented("/* Does. */\nconst char *psao_x(void);\n\n").is_err());
    }

    #[test]
    fn comments_lose_what_only_rust_needs() {
        let text = "  /*\n   One\n\n   two.\n\n   # Safety\n   Not.\n   */\n  int x;\n";
        assert_eq!(comments(text), "  /* One\n   *\n   * two. */\n  int x;\n");
    }
}
