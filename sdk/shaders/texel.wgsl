// How psao.wgsl reads where fragment shaders have no storage buffers (GLES 3.0, many GLES 3.1
// parts). The client's three buffers in textures of format RGBA32UI, 2048 texels wide: 16 bytes a
// texel, row after row, the last row padded. A buffer of 32-byte elements takes 2 texels each, so
// an element never straddles two rows, and a run of elements is at most three rectangles.

@group(0) @binding(0) var psao_instances: texture_2d<u32>;
@group(0) @binding(1) var psao_buckets: texture_2d<u32>;
@group(0) @binding(2) var psao_cells: texture_2d<u32>;

// 2048 texels a row: every GLES 3.0 device has textures that wide.
fn psao_texel(index: u32) -> vec2<i32> {
    return vec2<i32>(vec2<u32>(index & 2047u, index >> 11u));
}

fn psao_load_instance(index: u32) -> vec4<u32> {
    return textureLoad(psao_instances, psao_texel(index), 0);
}

fn psao_load_bucket(index: u32) -> vec4<u32> {
    return textureLoad(psao_buckets, psao_texel(index), 0);
}

fn psao_load_cell(index: u32) -> vec4<u32> {
    return textureLoad(psao_cells, psao_texel(index), 0);
}
