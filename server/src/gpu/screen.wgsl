// Ambient occlusion from depth and normals alone: GTAO (Jimenez et al. 2016) with a visibility
// bitmask in place of two horizons (Therrien et al. 2023), arranged as in XeGTAO: depth with its
// mips, occlusion, and a denoiser that stops at edges.
//
// View space here: x right, y up, z forward, metres.

struct Settings {
    // Directions through a pixel.
    slices: u32,
    // Samples each way along one.
    steps: u32,
    // How far occluders count, metres.
    radius: f32,
    // How far surfaces are taken to go on behind what is seen of them, metres.
    thickness: f32,
    // What openness is raised to in the end.
    power: f32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> eye: Eye;
@group(0) @binding(1) var<uniform> settings: Settings;
@group(0) @binding(2) var depths: texture_depth_2d;

// What nothing is at.
const SKY: f32 = 1e6;
const PI: f32 = 3.14159265;

@group(1) @binding(0) var mip0: texture_storage_2d<r32float, write>;
@group(1) @binding(1) var mip1: texture_storage_2d<r32float, write>;
@group(1) @binding(2) var mip2: texture_storage_2d<r32float, write>;
@group(1) @binding(3) var mip3: texture_storage_2d<r32float, write>;

var<workgroup> tile: array<array<f32, 8>, 8>;

// The mean of four distances; those much nearer than the farthest count less.
fn coarser(d: vec4<f32>) -> f32 {
    let reach = 0.75 * settings.radius;
    let fall = 0.615 * reach;
    let farthest = max(max(d.x, d.y), max(d.z, d.w));
    let weights = saturate((reach - (farthest - d)) / fall);
    return dot(d, weights) / dot(weights, vec4(1.0));
}

fn distance_at(pixel: vec2<u32>) -> f32 {
    let depth = textureLoad(depths, min(pixel, textureDimensions(depths) - 1u), 0);
    return select(SKY, eye.near / depth, depth > 0.0);
}

// Distances along the middle axis, and three coarser mips of them.
@compute @workgroup_size(8, 8)
fn prepare(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let at = id.xy * 2u;
    let d = vec4(
        distance_at(at),
        distance_at(at + vec2(1u, 0u)),
        distance_at(at + vec2(0u, 1u)),
        distance_at(at + vec2(1u, 1u)),
    );
    textureStore(mip0, at, vec4(d.x));
    textureStore(mip0, at + vec2(1u, 0u), vec4(d.y));
    textureStore(mip0, at + vec2(0u, 1u), vec4(d.z));
    textureStore(mip0, at + vec2(1u, 1u), vec4(d.w));
    let one = coarser(d);
    textureStore(mip1, id.xy, vec4(one));
    tile[local.x][local.y] = one;
    workgroupBarrier();
    let x = local.x;
    let y = local.y;
    if all(local.xy % 2u == vec2(0u)) {
        let two = coarser(vec4(tile[x][y], tile[x + 1u][y], tile[x][y + 1u], tile[x + 1u][y + 1u]));
        textureStore(mip2, id.xy / 2u, vec4(two));
        tile[x][y] = two;
    }
    workgroupBarrier();
    if all(local.xy % 4u == vec2(0u)) {
        let three =
            coarser(vec4(tile[x][y], tile[x + 2u][y], tile[x][y + 2u], tile[x + 2u][y + 2u]));
        textureStore(mip3, id.xy / 4u, vec4(three));
    }
}

@group(1) @binding(4) var distances: texture_2d<f32>;
@group(1) @binding(5) var worlds: texture_2d<u32>;
// Occlusion in the low 16 bits, how closed the edges to the left, right, top and bottom are in 4
// bits each.
@group(1) @binding(6) var raw: texture_storage_2d<r32uint, write>;

const MIPS: f32 = 3.0;

fn view_at(at: vec2<f32>, size: vec2<f32>, distance: f32) -> vec3<f32> {
    let ndc = at / size * 2.0 - 1.0;
    return vec3(ndc.x * eye.tan_x, -ndc.y * eye.tan_y, 1.0) * distance;
}

// A number in an order in which neighbours in number are neighbours in the picture.
fn hilbert(pixel: vec2<u32>) -> u32 {
    var x = pixel.x & 63u;
    var y = pixel.y & 63u;
    var index = 0u;
    for (var level = 32u; level > 0u; level /= 2u) {
        let right = u32((x & level) > 0u);
        let down = u32((y & level) > 0u);
        index += level * level * ((3u * right) ^ down);
        if down == 0u {
            if right == 1u {
                x = 63u - x;
                y = 63u - y;
            }
            let swap = x;
            x = y;
            y = swap;
        }
    }
    return index;
}

// The part of a slice's cosine-weighted sphere between the direction to the eye and angle `h`,
// where the normal is at `n`; negative on the other side.
fn arc(h: f32, n: f32) -> f32 {
    return sign(h) * 0.25 * (cos(n) - cos(2.0 * h - n) + 2.0 * h * sin(n));
}

fn unit_acos(x: f32) -> f32 {
    return acos(clamp(x, -1.0, 1.0));
}

fn edges_of(pixel: vec2<u32>, size: vec2<u32>, center: f32) -> vec4<f32> {
    let p = vec2<i32>(pixel);
    let most = vec2<i32>(size) - 1;
    let around = vec4(
        textureLoad(distances, clamp(p - vec2(1, 0), vec2(0), most), 0).x,
        textureLoad(distances, clamp(p + vec2(1, 0), vec2(0), most), 0).x,
        textureLoad(distances, clamp(p - vec2(0, 1), vec2(0), most), 0).x,
        textureLoad(distances, clamp(p + vec2(0, 1), vec2(0), most), 0).x,
    );
    // What follows from the surface's slope is no edge.
    let step = around - center;
    let slope = vec2(step.y - step.x, step.w - step.z) * 0.5;
    let level = step + vec4(slope.x, -slope.x, slope.y, -slope.y);
    let jump = min(abs(step), abs(level));
    return saturate(1.25 - jump / (center * 0.011));
}

fn packed_with(openness: f32, edges: vec4<f32>) -> u32 {
    let e = vec4<u32>(edges * 15.0 + 0.5);
    return u32(saturate(openness) * 65535.0 + 0.5) | (e.x << 16u) | (e.y << 20u) | (e.z << 24u)
        | (e.w << 28u);
}

@compute @workgroup_size(8, 8)
fn occlusion(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(worlds);
    if any(id.xy >= size) {
        return;
    }
    let distance = textureLoad(distances, id.xy, 0).x;
    if distance >= SKY {
        textureStore(raw, id.xy, vec4(packed_with(1.0, vec4(0.0))));
        return;
    }
    let edges = edges_of(id.xy, size, distance);
    let world = from_octahedral(textureLoad(worlds, id.xy, 0).x);
    let normal = vec3(dot(world, eye.right), dot(world, eye.up), dot(world, eye.forward));
    let extent = vec2<f32>(size);
    let at = vec2<f32>(id.xy) + 0.5;
    // A little nearer, so that rounding does not make a surface hide itself.
    let here = view_at(at, extent, distance * 0.99999);
    let to_eye = normalize(-here);
    let radius_px = settings.radius * extent.y / (2.0 * eye.tan_y * distance);
    // The R2 sequence along Hilbert's curve (Roberts; XeGTAO).
    let noise =
        fract(0.5 + f32(hilbert(id.xy)) * vec2(0.75487766624669276, 0.56984029099805327));

    var open = 0.0;
    var all = 0.0;
    for (var slice = 0u; slice < settings.slices; slice++) {
        let phi = (f32(slice) + noise.x) * PI / f32(settings.slices);
        let along = vec3(cos(phi), sin(phi), 0.0);
        let in_plane = along - to_eye * dot(along, to_eye);
        let axis = normalize(cross(in_plane, to_eye));
        let projected = normal - axis * dot(normal, axis);
        let length_projected = length(projected);
        if length_projected < 1e-5 {
            continue;
        }
        let n = sign(dot(in_plane, projected))
            * unit_acos(dot(projected, to_eye) / length_projected);
        let low = arc(n - PI * 0.5, n);
        let whole = arc(n + PI * 0.5, n) - low;
        let jitter = fract(noise.y + f32(slice) * 0.6180339887);

        // 32 sectors of equal weight: bits of those in which something is.
        var blocked = 0u;
        for (var way = -1.0; way < 2.0; way += 2.0) {
            for (var step = 0u; step < settings.steps; step++) {
                let apart = f32(slice + step * settings.slices) * 0.6180339887;
                let share = (f32(step) + fract(noise.y + apart)) / f32(settings.steps);
                let offset_px = max(share * radius_px, 1.3 + f32(step));
                let sample_at = at + way * offset_px * vec2(along.x, -along.y);
                if any(sample_at < vec2(0.0)) || any(sample_at >= extent) {
                    continue;
                }
                let mip = u32(clamp(log2(offset_px) - 3.3, 0.0, MIPS));
                let texel = vec2<u32>(sample_at) >> vec2(mip);
                let most = textureDimensions(distances, mip) - 1u;
                // What is seen in a mip is seen in the middle of its texel.
                let middle = (vec2<f32>(texel) + 0.5) * f32(1u << mip);
                let there = textureLoad(distances, min(texel, most), mip).x;
                let front = view_at(middle, extent, there) - here;
                if dot(front, front) > settings.radius * settings.radius {
                    continue;
                }
                let back = front - to_eye * settings.thickness;
                let side = sign(dot(front, in_plane));
                let angles = side * vec2(
                    unit_acos(dot(normalize(front), to_eye)),
                    unit_acos(dot(normalize(back), to_eye)),
                );
                let within = clamp(angles, vec2(n - PI * 0.5), vec2(n + PI * 0.5));
                let shares = (vec2(arc(within.x, n), arc(within.y, n)) - low) / whole;
                let first = u32(clamp(min(shares.x, shares.y) * 32.0 + jitter, 0.0, 32.0));
                let last = u32(clamp(max(shares.x, shares.y) * 32.0 + jitter, 0.0, 32.0));
                if last > first {
                    blocked |= (0xffffffffu >> (32u - (last - first))) << first;
                }
            }
        }
        let weight = length_projected * whole;
        open += weight * (1.0 - f32(countOneBits(blocked)) / 32.0);
        all += weight;
    }
    let openness = select(1.0, open / all, all > 0.0);
    textureStore(raw, id.xy, vec4(packed_with(pow(openness, settings.power), edges)));
}

@group(1) @binding(7) var noisy: texture_2d<u32>;
@group(1) @binding(8) var less_noisy: texture_storage_2d<r32uint, write>;
@group(1) @binding(9) var openness_out: texture_storage_2d<r32float, write>;
@group(1) @binding(10) var openness_in: texture_2d<f32>;

// The occlusion of others (rays), with edges for the denoiser.
@compute @workgroup_size(8, 8)
fn take(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(openness_in);
    if any(id.xy >= size) {
        return;
    }
    let distance = textureLoad(distances, id.xy, 0).x;
    let edges = select(edges_of(id.xy, size, distance), vec4(0.0), distance >= SKY);
    textureStore(raw, id.xy, vec4(packed_with(textureLoad(openness_in, id.xy, 0).x, edges)));
}

struct Texel {
    openness: f32,
    // Left, right, top, bottom: 1 where there is no edge.
    open: vec4<f32>,
}

fn texel_of(pixel: vec2<i32>, size: vec2<i32>) -> Texel {
    let word = textureLoad(noisy, clamp(pixel, vec2(0), size - 1), 0).x;
    let edges = (vec4(word) >> vec4(16u, 20u, 24u, 28u)) & vec4(15u);
    return Texel(f32(word & 0xffffu) / 65535.0, vec4<f32>(edges) / 15.0);
}

// XeGTAO's: 3 by 3, what is behind an edge counts less. `own` is the middle's weight.
fn smoothed(id: vec2<u32>, own: f32) -> Texel {
    let size = vec2<i32>(textureDimensions(noisy));
    let p = vec2<i32>(id);
    let c = texel_of(p, size);
    let l = texel_of(p + vec2(-1, 0), size);
    let r = texel_of(p + vec2(1, 0), size);
    let t = texel_of(p + vec2(0, -1), size);
    let b = texel_of(p + vec2(0, 1), size);
    // An edge is one from both its sides.
    var e = c.open * vec4(l.open.y, r.open.x, t.open.w, b.open.z);
    // Pixels all around which there are edges would keep their noise.
    e = saturate(e + saturate((1.5 - dot(e, vec4(1.0))) / 1.5) * 0.5);
    let corner = 0.85 * 0.5;
    let tl = corner * (e.x * l.open.z + e.z * t.open.x);
    let tr = corner * (e.z * t.open.y + e.y * r.open.z);
    let bl = corner * (e.w * b.open.x + e.x * l.open.w);
    let br = corner * (e.y * r.open.w + e.w * b.open.y);
    var sum = c.openness * own + l.openness * e.x + r.openness * e.y + t.openness * e.z
        + b.openness * e.w;
    sum += texel_of(p + vec2(-1, -1), size).openness * tl
        + texel_of(p + vec2(1, -1), size).openness * tr
        + texel_of(p + vec2(-1, 1), size).openness * bl
        + texel_of(p + vec2(1, 1), size).openness * br;
    let weight = own + dot(e, vec4(1.0)) + tl + tr + bl + br;
    return Texel(sum / weight, c.open);
}

const BLUR: f32 = 1.2;

@compute @workgroup_size(8, 8)
fn denoise(@builtin(global_invocation_id) id: vec3<u32>) {
    if all(id.xy < textureDimensions(noisy)) {
        let texel = smoothed(id.xy, BLUR / 5.0);
        textureStore(less_noisy, id.xy, vec4(packed_with(texel.openness, texel.open)));
    }
}

@compute @workgroup_size(8, 8)
fn denoise_last(@builtin(global_invocation_id) id: vec3<u32>) {
    if all(id.xy < textureDimensions(noisy)) {
        textureStore(openness_out, id.xy, vec4(smoothed(id.xy, BLUR).openness));
    }
}

// Without a denoiser.
@compute @workgroup_size(8, 8)
fn plain(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(noisy);
    if all(id.xy < size) {
        let texel = texel_of(vec2<i32>(id.xy), vec2<i32>(size));
        textureStore(openness_out, id.xy, vec4(texel.openness));
    }
}
