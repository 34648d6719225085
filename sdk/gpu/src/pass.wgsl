// The lookup of a whole G-buffer, a thread a pixel. Follows storage.wgsl and psao.wgsl.

@group(1) @binding(0) var psao_position: texture_2d<u32>;
@group(1) @binding(1) var psao_normal: texture_2d<f32>;
@group(1) @binding(2) var psao_openness: texture_storage_2d<r32float, write>;

// What a pixel shows.
struct PsaoPixel {
    position: vec3<f32>,
    normal: vec3<f32>,
    instance: u32,
    // Nothing was drawn, or by nothing that the client knows: open.
    empty: bool,
}

fn psao_pixel(pixel: vec2<u32>) -> PsaoPixel {
    let position = textureLoad(psao_position, pixel, 0);
    let normal = textureLoad(psao_normal, pixel, 0).xyz;
    let empty = any(pixel >= textureDimensions(psao_position))
        || position.w >= arrayLength(&psao_instances) / 4u;
    return PsaoPixel(bitcast<vec3<f32>>(position.xyz), normal, position.w, empty);
}

@compute @workgroup_size(8, 8)
fn psao_pass_paper(@builtin(global_invocation_id) id: vec3<u32>) {
    let pixel = psao_pixel(id.xy);
    var openness = 1.0;
    if !pixel.empty {
        openness = psao_paper(pixel.instance, pixel.position, pixel.normal);
    }
    textureStore(psao_openness, id.xy, vec4<f32>(openness));
}

@compute @workgroup_size(8, 8)
fn psao_pass_planar(@builtin(global_invocation_id) id: vec3<u32>) {
    let pixel = psao_pixel(id.xy);
    var openness = 1.0;
    if !pixel.empty {
        openness = psao_planar(pixel.instance, pixel.position, pixel.normal);
    }
    textureStore(psao_openness, id.xy, vec4<f32>(openness));
}

@compute @workgroup_size(64)
fn psao_pass_fast(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // Threads that run side by side have pixels in a square, not in a row: they share more cells.
    let x = (thread & 3u) | ((thread >> 1u) & 4u);
    let y = ((thread >> 2u) & 1u) | ((thread >> 3u) & 6u);
    let at = tile.xy * 8u + vec2<u32>(x, y);
    let pixel = psao_pixel(at);
    var openness = 1.0;
    if !pixel.empty {
        openness = psao_planar_fast(pixel.instance, pixel.position, pixel.normal);
    }
    textureStore(psao_openness, at, vec4<f32>(openness));
}
