// Draws what a camera sees: position and normal in the instance's own space, normals in the
// world's, depth.

@group(0) @binding(0) var<uniform> eye: Eye;
@group(0) @binding(1) var<storage, read> placed: array<Placed>;
@group(0) @binding(2) var<storage, read> masks: array<Mask>;
@group(0) @binding(3) var<storage, read> alpha: array<u32>;

struct Corner {
    @builtin(position) clip: vec4<f32>,
    // From the eye, in the world.
    @location(0) way: vec3<f32>,
    @location(1) world_normal: vec3<f32>,
    // In the space that the instance's grid is in.
    @location(2) position: vec3<f32>,
    @location(3) normal: vec3<f32>,
    @location(4) uv: vec2<f32>,
    @location(5) @interpolate(flat) instance: u32,
}

@vertex
fn corner(
    @builtin(instance_index) instance: u32,
    @location(0) posed: vec3<f32>,
    @location(1) posed_normal: vec3<f32>,
    @location(2) position: vec3<f32>,
    @location(3) normal: vec3<f32>,
    @location(4) uv: vec2<f32>,
) -> Corner {
    let at = placed[instance];
    let local = vec4(posed, 1.0);
    var out: Corner;
    out.way = vec3(dot(at.x, local), dot(at.y, local), dot(at.z, local)) - eye.position;
    // Cofactors: the inverse transpose but for the determinant, of which the sign counts.
    let a = vec3(at.x.x, at.y.x, at.z.x);
    let b = vec3(at.x.y, at.y.y, at.z.y);
    let c = vec3(at.x.z, at.y.z, at.z.z);
    let turned = cross(b, c) * posed_normal.x + cross(c, a) * posed_normal.y
        + cross(a, b) * posed_normal.z;
    out.world_normal = normalize(select(turned, -turned, (at.flags & 2u) != 0u));
    out.clip = vec4(
        dot(out.way, eye.right) / eye.tan_x,
        dot(out.way, eye.up) / eye.tan_y,
        eye.near,
        dot(out.way, eye.forward),
    );
    out.position = position;
    out.normal = normal;
    out.uv = uv;
    out.instance = instance;
    return out;
}

struct Surface {
    @location(0) position: vec4<u32>,
    @location(1) normal: vec4<f32>,
    @location(2) world: vec2<u32>,
}

fn surface(in: Corner, front: bool) -> Surface {
    let at = placed[in.instance];
    var flat = cross(dpdx(in.way), dpdy(in.way));
    let mirrored = (at.flags & 2u) != 0u;
    // What has one side shows only its front.
    let back = (at.flags & 1u) != 0u && front == mirrored;
    let turn = select(1.0, -1.0, back);
    let world = normalize(in.world_normal) * turn;
    flat = select(flat, -flat, dot(flat, in.way) > 0.0);
    flat = select(world, normalize(flat), dot(flat, flat) > 0.0);
    var out: Surface;
    out.position = vec4(bitcast<vec3<u32>>(in.position), in.instance);
    out.normal = vec4(normalize(in.normal) * turn, 0.0);
    out.world = vec2(octahedral(world), octahedral(flat));
    return out;
}

// Without `discard`, depth is tested first.
@fragment
fn solid(in: Corner, @builtin(front_facing) front: bool) -> Surface {
    return surface(in, front);
}

@fragment
fn masked(in: Corner, @builtin(front_facing) front: bool) -> Surface {
    let out = surface(in, front);
    let mask = masks[placed[in.instance].mask - 1u];
    let x = texel_at(in.uv.x, mask.width, mask.wrap_u);
    let y = texel_at(in.uv.y, mask.height, mask.wrap_v);
    let texel = mask.first + y * mask.width + x;
    let value = (alpha[texel / 4u] >> (texel % 4u * 8u)) & 255u;
    if f32(value) / 255.0 < mask.cutoff {
        discard;
    }
    return out;
}
