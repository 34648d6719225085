//! `sdk/shaders/psao.wgsl` in the languages of engines: snippets to paste, without an entry point.

use naga::back::{glsl, hlsl, msl};
use naga::proc::BoundsCheckPolicies;
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use naga::{Module, ShaderStage};
use std::path::Path;

/// Writers want an entry point; it is cut off again.
const PROBE: &str = "
@fragment
fn psao_probe(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) @interpolate(flat) instance: u32,
) -> @location(0) vec4<f32> {
    let planar = psao_planar(instance, position, normal);
    let paper = psao_paper(instance, position, normal);
    let fast = psao_planar_fast(instance, position, normal);
    let over = psao_over_baked(instance, instance, position, normal, position.x, position.y);
    return vec4<f32>(planar, paper, fast, over);
}
";

/// What the reader of every snippet reads first.
const HEADER: &str = "\
// PSAO: the lookup, to paste into a shader. Blends the points around a fragment into its openness:
// 1 is open, 0 fully occluded. Multiply ambient light with it.
// Generated from sdk/shaders/psao.wgsl by psao-gen: do not edit. Its comments say how it works.
//
// Call one of these, from any stage. The stream's header says which kernel its points are for.
//     float psao_planar_fast(uint instance, vec3 position, vec3 normal)   planar, the quicker way
//     float psao_planar(uint instance, vec3 position, vec3 normal)        planar, written plainly
//     float psao_paper(uint instance, vec3 position, vec3 normal)
//     float psao_over_baked(uint kernel, uint instance, vec3 position, vec3 normal, float baked,
//         float share)    the stream where it covers the place, a baked value where it does not
// The first is quicker only if the buckets have tags: docs/gpu.md says how to put them there.
// instance: index into the instance buffer, below its capacity.
// position: in the instance's local space (rest space where it is skinned or morphed). It must come
//     from the vertices' own positions, as a varying. Never subtract it from a world position: f32
//     does not hold both far from the origin.
// normal: in the same space, of any length, on the side of the surface that is seen.
// Position and normal have to be finite, and of full precision (highp).
//
";

/// Each file's path from the root, and what belongs in it.
///
/// # Errors
/// The sources are no WGSL, or cannot be said in another language.
pub fn generate(root: &Path) -> Result<Vec<(&'static str, String)>, String> {
    let source = |name: &str| {
        let path = root.join("sdk/shaders").join(name);
        std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))
    };
    let functions = source("psao.wgsl")?;
    let storage = Source::parse("storage.wgsl", &source("storage.wgsl")?, &functions)?;
    let texel = Source::parse("texel.wgsl", &source("texel.wgsl")?, &functions)?;
    Ok(vec![
        (
            "sdk/shaders/generated/psao_es310.glsl",
            storage.glsl(
                310,
                "\
// GLSL ES 3.10 and Vulkan's GLSL (4.50). Reads storage buffers: bind the client's instances,
// buckets and cells, as they are, to the bindings below. The fragment stage needs three of them
// (GL_MAX_FRAGMENT_SHADER_STORAGE_BLOCKS); where there are fewer, use psao_es300.glsl.
",
            )?,
        ),
        (
            "sdk/shaders/generated/psao_es300.glsl",
            texel.glsl(
                300,
                "\
// GLSL ES 3.00. Reads textures of format GL_RGBA32UI, 2048 texels wide, filters GL_NEAREST, one
// level: bind the client's instances, buckets and cells to the samplers below. Each holds its
// buffer's bytes, 16 a texel, row after row; the last row is padded. Upload what changed with
// glTexSubImage2D (GL_RGBA_INTEGER, GL_UNSIGNED_INT): an instance is 4 texels, a bucket or a cell
// 2. A texture that has to be taller than GL_MAX_TEXTURE_SIZE is too much for this device.
",
            )?,
        ),
        (
            "sdk/shaders/generated/psao.hlsl",
            storage.hlsl(
                "\
// HLSL, shader model 5.1. Reads raw buffers (ByteAddressBuffer): bind the client's instances,
// buckets and cells, as they are, to the registers below. vec3 is float3.
",
            )?,
        ),
        (
            "sdk/shaders/generated/psao.metal",
            storage.msl(
                "\
// Metal shading language 2.0. Reads device buffers: bind the client's instances, buckets and cells,
// as they are, to any buffer slots, and pass the three on, behind the arguments above and in this
// order; each function shows it. vec3 is metal::float3.
",
            )?,
        ),
    ])
}

/// A parsed and validated source.
struct Source {
    module: Module,
    info: ModuleInfo,
}

impl Source {
    fn parse(name: &str, shim: &str, functions: &str) -> Result<Source, String> {
        let text = format!("{shim}{functions}{PROBE}");
        let module = naga::front::wgsl::parse_str(&text)
            .map_err(|error| format!("psao.wgsl with {name}: {}", error.emit_to_string(&text)))?;
        let info = Validator::new(ValidationFlags::all(), Capabilities::default())
            .validate(&module)
            .map_err(|error| format!("psao.wgsl with {name}: {}", error.emit_to_string(&text)))?;
        Ok(Source { module, info })
    }

    fn glsl(&self, version: u16, binding: &str) -> Result<String, String> {
        let options = glsl::Options {
            version: glsl::Version::new_gles(version),
            writer_flags: glsl::WriterFlags::empty(),
            binding_map: (0..3).map(|slot| (resource(slot), slot as u8)).collect(),
            zero_initialize_workgroup_memory: false,
        };
        let pipeline = glsl::PipelineOptions {
            shader_stage: ShaderStage::Fragment,
            entry_point: "psao_probe".into(),
            multiview: None,
        };
        let mut text = String::new();
        let mut writer = glsl::Writer::new(
            &mut text,
            &self.module,
            &self.info,
            &options,
            &pipeline,
            BoundsCheckPolicies::default(),
        )
        .map_err(|error| format!("GLSL {version}: {error}"))?;
        writer
            .write()
            .map_err(|error| format!("GLSL {version}: {error}"))?;
        // The engine's shader has its own version and inputs.
        let kept = cut(&text, "void main(")?
            .lines()
            .filter(|line| !line.starts_with("#version") && !is_varying(line))
            .collect::<Vec<_>>();
        let mut text = kept.join("\n");
        for (slot, name) in BUFFERS.iter().enumerate() {
            text = text.replace(&format!("_group_0_binding_{slot}_fs"), name);
            // The type's number before it changes with the source, and may be an engine's too.
            let block = format!("_block_{slot}Fragment");
            if let Some(end) = text.find(&block).map(|at| at + block.len()) {
                let start = text[..end].rfind(' ').map_or(0, |at| at + 1);
                text.replace_range(start..end, &format!("{name}_block"));
            }
        }
        Ok(format!("{HEADER}{binding}\n{}\n", tidy(&text)))
    }

    fn hlsl(&self, binding: &str) -> Result<String, String> {
        let target = |slot: u32| hlsl::BindTarget {
            register: slot,
            ..hlsl::BindTarget::default()
        };
        let options = hlsl::Options {
            binding_map: (0..3).map(|slot| (resource(slot), target(slot))).collect(),
            fake_missing_bindings: false,
            force_loop_bounding: false,
            restrict_indexing: false,
            ..hlsl::Options::default()
        };
        let pipeline = hlsl::PipelineOptions { entry_point: None };
        let mut text = String::new();
        hlsl::Writer::new(&mut text, &options, &pipeline)
            .write(&self.module, &self.info, None)
            .map_err(|error| format!("HLSL: {error}"))?;
        let text = cut(&text, "FragmentOutput_psao_probe psao_probe(")
            .or_else(|_| cut(&text, "float4 psao_probe("))?;
        let text = without_struct(text, "struct FragmentInput_psao_probe");
        Ok(format!("{HEADER}{binding}\n{}\n", tidy(&text)))
    }

    fn msl(&self, binding: &str) -> Result<String, String> {
        let options = msl::Options {
            lang_version: (2, 0),
            fake_missing_bindings: true,
            force_loop_bounding: false,
            zero_initialize_workgroup_memory: false,
            ..msl::Options::default()
        };
        let mut text = String::new();
        msl::Writer::new(&mut text)
            .write(
                &self.module,
                &self.info,
                &options,
                &msl::PipelineOptions::default(),
            )
            .map_err(|error| format!("Metal: {error}"))?;
        let text = without_struct(&text, "struct psao_probeInput");
        let text = without_struct(&text, "struct psao_probeOutput");
        let text = cut(&text, "fragment psao_probeOutput psao_probe(")?;
        // Sizes of the buffers would be for checks that are not made.
        let text = without_struct(text, "struct _mslBufferSizes")
            .replace(",\n    constant _mslBufferSizes& _buffer_sizes", "")
            .replace(", _buffer_sizes", "");
        // The type's number changes with the source.
        let words = text
            .split_once("typedef metal::uint4 ")
            .and_then(|(_, rest)| rest.split_once('['))
            .map(|(name, _)| name.to_string())
            .ok_or("the Metal writer declares the buffers in another way")?;
        let text = text.replace(&words, "PsaoWords");
        Ok(format!("{HEADER}{binding}\n{}\n", tidy(&text)))
    }
}

const BUFFERS: [&str; 3] = ["psao_instances", "psao_buckets", "psao_cells"];

fn resource(binding: u32) -> naga::ResourceBinding {
    naga::ResourceBinding { group: 0, binding }
}

/// What stands before the probe.
fn cut<'a>(text: &'a str, probe: &str) -> Result<&'a str, String> {
    match text.find(probe) {
        Some(at) => Ok(&text[..at]),
        None => Err(format!("the writer names the probe other than \"{probe}\"")),
    }
}

fn is_varying(line: &str) -> bool {
    line.contains("_vs2fs_") || line.contains("_fs2p_")
}

/// The text without a struct that only the probe needs.
fn without_struct(text: &str, head: &str) -> String {
    let Some(start) = text.find(head) else {
        return text.into();
    };
    let end = text[start..]
        .find("};\n")
        .map_or(text.len(), |at| start + at + 3);
    format!("{}{}", &text[..start], &text[end..])
}

/// No blank line twice, none at the ends, no blanks at the ends of lines; helpers of the writer
/// have names that another snippet by the same writer does not have.
fn tidy(text: &str) -> String {
    let text = text.replace("naga_", "psao_naga_");
    let mut lines: Vec<&str> = Vec::new();
    for line in text.trim().lines().map(str::trim_end) {
        if !(line.is_empty() && lines.last().is_some_and(|last| last.is_empty())) {
            lines.push(line);
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use naga::back::spv;
    use std::process::Command;

    fn root() -> &'static Path {
        Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
    }

    fn snippet(name: &str) -> String {
        let files = generate(root()).unwrap();
        let (_, text) = files.iter().find(|(path, _)| path.ends_with(name)).unwrap();
        text.clone()
    }

    /// Runs a validator over a file of this content; it must be content with it.
    fn valid(program: &str, words: &[&str], name: &str, content: &[u8]) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        let output = Command::new(program)
            .current_dir(folder.path())
            .args(words)
            .arg(&path)
            .output()
            .unwrap_or_else(|error| panic!("{program}: {error}: tests/run installs it"));
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            output.status.success(),
            "{program} {words:?}: {said}{error}"
        );
    }

    const GLSL_MAIN: &str = "
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) flat in uint instance;
layout(location = 0) out vec4 color;
void main() {
    color = vec4(psao_planar_fast(instance, position, normal), psao_planar(instance, position,
        normal), psao_paper(instance, position, normal),
        psao_over_baked(1u, instance, position, normal, 0.5, 1.0));
}
";

    #[test]
    fn the_glsl_snippets_are_valid_in_a_shader_of_an_engine() {
        for (name, version, words) in [
            ("psao_es310.glsl", "310 es", &[][..]),
            ("psao_es310.glsl", "450", &["-V"][..]),
            ("psao_es300.glsl", "300 es", &[][..]),
        ] {
            // Locations of what comes from another stage are not GLSL ES 3.00.
            let main = match version {
                "300 es" => GLSL_MAIN.replace("layout(location = 0) in", "in"),
                _ => GLSL_MAIN.into(),
            };
            let main = match version {
                "300 es" => main
                    .replace("layout(location = 1) in", "in")
                    .replace("layout(location = 2) flat in", "flat in"),
                _ => main,
            };
            let text = format!("#version {version}\n{}{main}", snippet(name));
            valid("glslangValidator", words, "shader.frag", text.as_bytes());
        }
    }

    #[test]
    fn the_hlsl_snippet_is_valid_in_a_shader_of_an_engine() {
        let main = "
float4 main(float3 position : P, float3 normal : N, nointerpolation uint instance : I) : SV_Target
{
    return float4(psao_planar_fast(instance, position, normal), psao_planar(instance, position,
        normal), psao_paper(instance, position, normal),
        psao_over_baked(1u, instance, position, normal, 0.5, 1.0));
}
";
        let text = snippet("psao.hlsl") + main;
        let words = ["-D", "-V", "-S", "frag", "-e", "main"];
        valid("glslangValidator", &words, "shader.hlsl", text.as_bytes());
    }

    #[test]
    fn the_source_is_valid_as_spir_v() {
        let read = |name: &str| std::fs::read_to_string(root().join("sdk/shaders").join(name));
        for shim in ["storage.wgsl", "texel.wgsl"] {
            let (shim_text, functions) = (read(shim).unwrap(), read("psao.wgsl").unwrap());
            let source = Source::parse(shim, &shim_text, &functions).unwrap();
            let options = spv::Options {
                lang_version: (1, 3),
                ..spv::Options::default()
            };
            let words = spv::write_vec(&source.module, &source.info, &options, None).unwrap();
            let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            valid(
                "spirv-val",
                &["--target-env", "vulkan1.1"],
                "shader.spv",
                &bytes,
            );
        }
    }

    #[test]
    fn names_of_snippets_do_not_meet_those_of_an_engine() {
        for name in [
            "psao_es310.glsl",
            "psao_es300.glsl",
            "psao.hlsl",
            "psao.metal",
        ] {
            let text = snippet(name);
            assert!(!text.contains("psao_probe"), "{name} has the probe in it");
            assert!(
                !text.contains("type_"),
                "{name} has a name of a type's number"
            );
            for function in [
                "psao_planar_fast(",
                "psao_planar(",
                "psao_paper(",
                "psao_over_baked(",
            ] {
                assert!(text.contains(function), "{name} lacks {function}");
            }
        }
    }

    #[test]
    fn wrong_source_is_refused_with_its_place() {
        let error = Source::parse("storage.wgsl", "fn psao_x( {", "")
            .err()
            .unwrap();
        assert!(error.contains("psao.wgsl with storage.wgsl") && error.contains("wgsl:1"));
    }
}
