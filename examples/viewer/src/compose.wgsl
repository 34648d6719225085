// The picture from the G-buffer and the occlusion, with what is to be shown over it. In front of
// this text stand psao-gpu's lookup functions, with their buffers in bind group 0.

struct Look {
    // 0 none, 1 cells, 2 points, 3 dirty heat, 4 occupancy.
    overlay: u32,
    // Pictures so far.
    picture: u32,
    // Letters across, and lines.
    columns: u32,
    lines: u32,
}

@group(1) @binding(0) var<uniform> look: Look;
@group(1) @binding(1) var positions: texture_2d<u32>;
@group(1) @binding(2) var normals: texture_2d<f32>;
@group(1) @binding(3) var worlds: texture_2d<u32>;
@group(1) @binding(4) var openness: texture_2d<f32>;
// Of each cell, the picture in which it last changed.
@group(1) @binding(5) var<storage, read> stamps: array<u32>;
// Two words a letter of the font, then the text's letters.
@group(1) @binding(6) var<storage, read> text: array<u32>;

@vertex
fn corner(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

fn hash(n: u32) -> u32 {
    var x = (n ^ (n >> 16u)) * 0x7feb352du;
    x = (x ^ (x >> 15u)) * 0x846ca68bu;
    return x ^ (x >> 16u);
}

fn color_of(n: u32) -> vec3<f32> {
    let bits = hash(n);
    return vec3<f32>(vec3(bits, bits >> 8u, bits >> 16u) & vec3(255u)) / 255.0;
}

// Dark blue over red to pale yellow.
fn heat(v: f32) -> vec3<f32> {
    return saturate(vec3(v * 2.0, v * 2.0 - 0.9, 0.35 - v * 0.8 + v * v));
}

fn world_normal(packed: u32) -> vec3<f32> {
    let p = unpack2x16snorm(packed);
    let z = 1.0 - abs(p.x) - abs(p.y);
    let fold = max(-z, 0.0);
    return normalize(vec3(p - select(vec2(-fold), vec2(fold), p >= vec2(0.0)), z));
}

// What the overlay says of a fragment: colour, and how much of it.
fn overlay(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> vec4<f32> {
    let none = vec4(0.0);
    if look.overlay == 0u {
        return none;
    }
    let grid = psao_grid(instance);
    let fragment = psao_fragment(grid, position, normal);
    if fragment.outside {
        return none;
    }
    if look.overlay == 2u {
        var nearest = 1e30;
        var color = vec3(0.0);
        for (var corner = 0u; corner < 8u; corner++) {
            let offset = vec3<i32>(vec3(corner, corner >> 1u, corner >> 2u) & vec3(1u));
            let at = vec3<u32>(fragment.base + offset);
            if any(at >= grid.dims) {
                continue;
            }
            let cell = psao_find(grid, at);
            for (var i = 1u; i < 8u && cell != 0u; i++) {
                let point = psao_load_cell(cell * 2u + (i >> 2u))[i & 3u];
                let d = vec3<f32>(offset) + psao_point_place(point) - fragment.place;
                let far = select(1e30, dot(d, d), (point >> 31u) == 1u);
                if far < nearest {
                    nearest = far;
                    color = heat(psao_point_openness(point));
                }
            }
        }
        let dot_size = 0.18 * grid.radius;
        return vec4(color, select(0.0, 1.0, nearest < dot_size * dot_size));
    }
    let at = vec3<i32>(floor((position - grid.origin) * grid.cells_per_unit));
    if any(at < vec3(0)) || any(vec3<u32>(at) >= grid.dims) {
        return none;
    }
    let cell = psao_find(grid, vec3<u32>(at));
    if cell == 0u {
        return none;
    }
    if look.overlay == 1u {
        return vec4(color_of(cell), 0.55);
    }
    if look.overlay == 3u {
        if cell >= arrayLength(&stamps) || stamps[cell] == 0u {
            return vec4(heat(0.0), 0.5);
        }
        let age = f32(look.picture - stamps[cell]);
        return vec4(heat(exp2(-age / 20.0)), 0.7);
    }
    var count = 0u;
    for (var i = 1u; i < 8u; i++) {
        count += psao_load_cell(cell * 2u + (i >> 2u))[i & 3u] >> 31u;
    }
    return vec4(heat(f32(count) / 7.0), 0.7);
}

// Whether a letter of the text covers a pixel; and whether it is near one.
fn ink(pixel: vec2<u32>) -> bool {
    let column = pixel.x / 8u;
    let line = pixel.y / 10u;
    let row = pixel.y % 10u;
    if column >= look.columns || line >= look.lines || row >= 8u {
        return false;
    }
    let letter = text[256u + line * look.columns + column] & 127u;
    let bits = text[letter * 2u + row / 4u] >> (row % 4u * 8u);
    return ((bits >> (pixel.x % 8u)) & 1u) == 1u;
}

@fragment
fn picture(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let pixel = vec2<u32>(at.xy);
    let place = textureLoad(positions, pixel, 0);
    var color = mix(vec3(0.72, 0.80, 0.90), vec3(0.52, 0.64, 0.82),
        at.y / f32(textureDimensions(positions).y));
    if place.w != 0xffffffffu {
        let normal = world_normal(textureLoad(worlds, pixel, 0).x);
        let albedo = 0.80 + 0.12 * (color_of(place.w) - 0.5);
        let facing = dot(normal, normalize(vec3(0.4, 0.8, 0.45))) * 0.5 + 0.5;
        color = albedo * (0.72 + 0.28 * facing) * textureLoad(openness, pixel, 0).x;
        let over = overlay(place.w, bitcast<vec3<f32>>(place.xyz),
            textureLoad(normals, pixel, 0).xyz);
        color = mix(color, over.rgb, over.a);
    }
    let margin = vec2(8u, 8u);
    if all(pixel >= margin - 4u)
        && all(pixel < margin + vec2(look.columns * 8u, look.lines * 10u) + 2u) {
        color *= 0.35;
        if all(pixel >= margin) && ink(pixel - margin) {
            color = vec3(1.0);
        }
    }
    return vec4(color, 1.0);
}
