// Occlusion by depth maps: what lies over an element in a direction, of all elements at once.

struct Direction {
    // Unit vectors; the third is towards the light, and the fourth number the sphere's radius.
    right: vec4<f32>,
    up: vec4<f32>,
    toward: vec4<f32>,
    // Texels an edge, bias in texels, elements, numbers an element sums.
    size: vec4<f32>,
    // What the openness of the direction is multiplied with, for each number.
    basis: array<vec4<f32>, 4>,
}

// Elements are relative to the middle of the sphere that the maps are fitted to.
struct Element {
    position: vec4<f32>,
    normal: vec4<f32>,
    outward: vec4<f32>,
}

@group(0) @binding(0) var<uniform> direction: Direction;

@group(1) @binding(0) var<storage, read> masks: array<Mask>;
@group(1) @binding(1) var<storage, read> alpha: array<u32>;

fn in_map(position: vec3<f32>) -> vec3<f32> {
    let radius = direction.toward.w;
    let at = vec3(
        dot(position, direction.right.xyz),
        dot(position, direction.up.xyz),
        dot(position, direction.toward.xyz),
    ) / radius;
    return vec3(at.xy, 0.5 - 0.5 * at.z);
}

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) uv: vec2<f32>,
    @location(1) @interpolate(flat) mask: u32,
}

@vertex
fn corner(
    @location(0) position: vec3<f32>,
    @location(1) uv: vec2<f32>,
    @location(2) mask: u32,
) -> Corner {
    var out: Corner;
    out.clip = vec4(in_map(position), 1.0);
    out.uv = uv;
    out.mask = mask;
    return out;
}

// How much depth grows from a texel to the next one, in texels: right and down.
fn tilt(at: vec4<f32>) -> vec4<f32> {
    return vec4(vec2(dpdx(at.z), dpdy(at.z)) * direction.size.x, 0.0, 0.0);
}

@fragment
fn solid(in: Corner) -> @location(0) vec4<f32> {
    return tilt(in.clip);
}

// Holes let light through.
@fragment
fn masked(in: Corner) -> @location(0) vec4<f32> {
    let tilted = tilt(in.clip);
    let mask = masks[in.mask - 1u];
    let x = texel_at(in.uv.x, mask.width, mask.wrap_u);
    let y = texel_at(in.uv.y, mask.height, mask.wrap_v);
    let texel = mask.first + y * mask.width + x;
    let value = (alpha[texel / 4u] >> (texel % 4u * 8u)) & 255u;
    if f32(value) / 255.0 < mask.cutoff {
        discard;
    }
    return tilted;
}

@group(2) @binding(0) var<storage, read> elements: array<Element>;
// Of each element, the sum of weights and then the sums of what is visible.
@group(2) @binding(1) var<storage, read_write> sums: array<f32>;
@group(2) @binding(2) var depth_map: texture_depth_2d;
@group(2) @binding(3) var tilts: texture_2d<f32>;

@compute @workgroup_size(64)
fn gather(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let index = id.x + id.y * groups.x * 64u;
    if index >= u32(direction.size.z) {
        return;
    }
    let element = elements[index];
    let toward = direction.toward.xyz;
    let weight = dot(element.normal.xyz, toward);
    if weight <= 0.0 {
        return;
    }
    let numbers = u32(direction.size.w);
    let first = index * (numbers + 1u);
    sums[first] += weight;
    // Light from behind the flat surface does not reach it, whatever the interpolated normal says.
    let slope = dot(element.outward.xyz, toward);
    if slope <= 0.0 {
        return;
    }
    // A texel holds the depth of what is seen at its middle, and the element is elsewhere in it. So
    // the two are compared twice: where the texel's middle is, with the element's plane there, and
    // where the element is, with the plane of what was seen. What hides the element is above it in
    // both places; its own surface is in none, the one behind an edge not in the first, and that
    // across a corner not in the second.
    let edge = direction.size.x;
    let at = in_map(element.position.xyz);
    let place = vec2(at.x, -at.y) * (0.5 * edge) + 0.5 * edge;
    let texel = clamp(floor(place), vec2(0.0), vec2(edge - 1.0));
    let to_middle = texel + 0.5 - place;
    let across = vec2(dot(element.outward.xyz, direction.right.xyz),
        -dot(element.outward.xyz, direction.up.xyz));
    let own_tilt = across / slope;
    let tilt = textureLoad(tilts, vec2<u32>(texel), 0).xy;
    // In texels, as tilts are. How far off depths are grows with the tilt: corners are drawn on a
    // raster of 1/256 texel.
    let above = (at.z - textureLoad(depth_map, vec2<u32>(texel), 0)) * edge;
    let there = above + dot(own_tilt, to_middle) - direction.size.y * (1.0 + length(own_tilt));
    let here = above + dot(tilt, to_middle) - direction.size.y * (1.0 + length(tilt));
    if there > 0.0 && here > 0.0 {
        return;
    }
    for (var number = 0u; number < numbers; number++) {
        sums[first + 1u + number] += weight * direction.basis[number / 4u][number % 4u];
    }
}
