// Rays into a scene of two bodies of triangles: what stands still, and what moves. How a ray finds
// what it hits is `is_occluded`, in trees.wgsl or query.wgsl.

struct Trees {
    // Nodes of the first tree, and of the second; triangles before the second's.
    fixed_nodes: u32,
    moving_nodes: u32,
    fixed_triangles: u32,
    // Rays in all; or rays a pixel, and which of its set is the first; or words of bits in all.
    rays: u32,
    first: u32,
    t_max: f32,
    // Words of bits of a fan.
    fan_words: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> trees: Trees;
// Three corners each; in w: 0 or one more than the mask's index, and where its corners' texture
// coordinates are.
@group(0) @binding(2) var<storage, read> triangles: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> uvs: array<vec2<f32>>;
@group(0) @binding(4) var<storage, read> masks: array<Mask>;
@group(0) @binding(5) var<storage, read> alpha: array<u32>;

fn is_hole(triangle: u32, u: f32, v: f32) -> bool {
    let index = bitcast<u32>(triangles[triangle * 3u].w);
    if index == 0u {
        return false;
    }
    let first = bitcast<u32>(triangles[triangle * 3u + 1u].w);
    let at = uvs[first] * (1.0 - u - v) + uvs[first + 1u] * u + uvs[first + 2u] * v;
    let mask = masks[index - 1u];
    let texel = mask.first + texel_at(at.y, mask.height, mask.wrap_v) * mask.width
        + texel_at(at.x, mask.width, mask.wrap_u);
    let value = (alpha[texel / 4u] >> (texel % 4u * 8u)) & 255u;
    return f32(value) / 255.0 < mask.cutoff;
}

struct Ray {
    origin: vec3<f32>,
    t_max: f32,
    direction: vec3<f32>,
    unused: f32,
}

@group(0) @binding(6) var<storage, read> rays: array<Ray>;
@group(0) @binding(7) var<storage, read_write> hits: array<u32>;

// Rays in, hits out: a bit each.
@compute @workgroup_size(64)
fn occluded(@builtin(global_invocation_id) id: vec3<u32>) {
    let first = id.x * 32u;
    var bits = 0u;
    for (var i = 0u; i < 32u && first + i < trees.rays; i++) {
        let ray = rays[first + i];
        if is_occluded(ray.origin, ray.direction, ray.t_max) {
            bits |= 1u << i;
        }
    }
    if first < trees.rays {
        hits[id.x] = bits;
    }
}

@group(1) @binding(0) var<uniform> eye: Eye;
@group(1) @binding(1) var positions: texture_2d<u32>;
@group(1) @binding(2) var worlds: texture_2d<u32>;
@group(1) @binding(3) var depths: texture_depth_2d;
@group(1) @binding(4) var<storage, read> placed: array<Placed>;
@group(1) @binding(5) var<storage, read> directions: array<vec4<f32>>;
@group(1) @binding(6) var openness: texture_storage_2d<r32float, read_write>;

// As in samples.rs.
const SETS: u32 = 64u;

fn scatter(n: u32) -> u32 {
    var x = (n ^ (n >> 16u)) * 0x7feb352du;
    x = (x ^ (x >> 15u)) * 0x846ca68bu;
    return x ^ (x >> 16u);
}

// Rays a pixel, each pixel its own turn of one of the sets of directions: what the earlier calls
// found goes in with its share.
@compute @workgroup_size(8, 8)
fn pixels(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(positions);
    if any(id.xy >= size) {
        return;
    }
    let instance = textureLoad(positions, id.xy, 0).w;
    if instance == 0xffffffffu {
        textureStore(openness, id.xy, vec4(1.0));
        return;
    }
    let world = textureLoad(worlds, id.xy, 0).xy;
    let normal = from_octahedral(world.x);
    let outward = from_octahedral(world.y);
    let depth = textureLoad(depths, id.xy, 0);
    let place = eye.position + way_to(eye, id.xy, size) * (eye.near / depth);
    let origin = place + outward * (placed[instance].reach / 262144.0);

    let bits = scatter(id.y * size.x + id.x);
    let turn = f32(bits >> 8u) / 16777216.0 * 6.2831853;
    // Duff et al. 2017.
    let side = select(-1.0, 1.0, normal.z >= 0.0);
    let a = -1.0 / (side + normal.z);
    let b = normal.x * normal.y * a;
    let across = vec3(1.0 + side * normal.x * normal.x * a, side * b, -side * normal.x);
    let upward = vec3(b, side + normal.y * normal.y * a, -normal.y);
    let x = across * cos(turn) + upward * sin(turn);
    let y = upward * cos(turn) - across * sin(turn);
    let own = (bits % SETS) * (arrayLength(&directions) / SETS);
    var open = 0u;
    for (var i = trees.first; i < trees.first + trees.rays; i++) {
        let d = directions[own + i].xyz;
        let direction = x * d.x + y * d.y + normal * d.z;
        if !is_occluded(origin, direction, trees.t_max) {
            open++;
        }
    }
    var before = 0.0;
    if trees.first > 0u {
        before = textureLoad(openness, id.xy).x * f32(trees.first);
    }
    let all = f32(trees.first + trees.rays);
    textureStore(openness, id.xy, vec4((before + f32(open)) / all));
}
