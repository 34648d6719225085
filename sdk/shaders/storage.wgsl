// How psao.wgsl reads where fragment shaders have storage buffers: Vulkan, Metal, D3D12, GLES 3.1
// with GL_MAX_FRAGMENT_SHADER_STORAGE_BLOCKS ≥ 3. The client's three buffers, as they are.

@group(0) @binding(0) var<storage, read> psao_instances: array<vec4<u32>>;
@group(0) @binding(1) var<storage, read> psao_buckets: array<vec4<u32>>;
@group(0) @binding(2) var<storage, read> psao_cells: array<vec4<u32>>;

fn psao_load_instance(index: u32) -> vec4<u32> {
    return psao_instances[index];
}

fn psao_load_bucket(index: u32) -> vec4<u32> {
    return psao_buckets[index];
}

fn psao_load_cell(index: u32) -> vec4<u32> {
    return psao_cells[index];
}
