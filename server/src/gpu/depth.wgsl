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

// Holes let light through.
@fragment
fn masked(in: Corner) {
    let mask = masks[in.mask - 1u];
    let x = texel_at(in.uv.x, mask.width, mask.wrap_u);
    let y = texel_at(in.uv.y, mask.height, mask.wrap_v);
    let texel = mask.first + y * mask.width + x;
    let value = (alpha[texel / 4u] >> (texel % 4u * 8u)) & 255u;
    if f32(value) / 255.0 < mask.cutoff {
        discard;
    }
}

@group(2) @binding(0) var<storage, read> elements: array<Element>;
// Of each element, the sum of weights and then the sums of what is visible.
@group(2) @binding(1) var<storage, read_write> sums: array<f32>;
@group(2) @binding(2) var depth_map: texture_depth_2d;

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
    // A texel holds one depth of a surface that slants through it. Lifted by so many texels, an
    // element is above that depth at any slant.
    let radius = direction.toward.w;
    let edge = direction.size.x;
    let bias = direction.size.y * 2.0 * radius / edge;
    let lift = bias * sqrt(max(1.0 - slope * slope, 0.0));
    let at = in_map(element.position.xyz + element.outward.xyz * lift + toward * (0.5 * bias));
    let texel = vec2<u32>(clamp(
        vec2(at.x, -at.y) * (0.5 * edge) + 0.5 * edge,
        vec2(0.0),
        vec2(edge - 1.0),
    ));
    if at.z > textureLoad(depth_map, texel, 0) {
        return;
    }
    for (var number = 0u; number < numbers; number++) {
        sums[first + 1u + number] += weight * direction.basis[number / 4u][number % 4u];
    }
}
