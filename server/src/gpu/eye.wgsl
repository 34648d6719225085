// What all shaders of the server share.

// A camera; see `Eye` in mod.rs.
struct Eye {
    position: vec3<f32>,
    near: f32,
    right: vec3<f32>,
    tan_x: f32,
    up: vec3<f32>,
    tan_y: f32,
    forward: vec3<f32>,
    unused: f32,
}

// From the eye to what is at a pixel's centre, along the middle axis 1 long.
fn way_to(eye: Eye, pixel: vec2<u32>, size: vec2<u32>) -> vec3<f32> {
    let at = (vec2<f32>(pixel) + 0.5) / vec2<f32>(size) * 2.0 - 1.0;
    return eye.forward + eye.right * (at.x * eye.tan_x) - eye.up * (at.y * eye.tan_y);
}

// A unit vector in two numbers of 16 bits.
fn octahedral(n: vec3<f32>) -> u32 {
    let p = n.xy / (abs(n.x) + abs(n.y) + abs(n.z));
    let turned = (1.0 - abs(p.yx)) * select(vec2(-1.0), vec2(1.0), p >= vec2(0.0));
    return pack2x16snorm(select(turned, p, n.z >= 0.0));
}

fn from_octahedral(packed: u32) -> vec3<f32> {
    let p = unpack2x16snorm(packed);
    let z = 1.0 - abs(p.x) - abs(p.y);
    let fold = max(-z, 0.0);
    return normalize(vec3(p - select(vec2(-fold), vec2(fold), p >= vec2(0.0)), z));
}

// An alpha mask; see `Masks` in gbuffer.rs.
struct Mask {
    first: u32,
    width: u32,
    height: u32,
    cutoff: f32,
    wrap_u: u32,
    wrap_v: u32,
    unused_a: u32,
    unused_b: u32,
}

// An instance; see `Placed` in gbuffer.rs.
struct Placed {
    // Rows of the matrix to world space.
    x: vec4<f32>,
    y: vec4<f32>,
    z: vec4<f32>,
    // 0 for none, else one more than its index.
    mask: u32,
    // 1: both sides show; 2: mirrored.
    flags: u32,
    // How coarse its numbers are, as in rays::reach.
    reach: f32,
    unused: u32,
}

// The texel of an axis of `size` texels nearest to `at`, as on the CPU.
fn texel_at(at: f32, size: u32, wrap: u32) -> u32 {
    var c = clamp(at, 0.0, 1.0);
    if wrap == 1u {
        c = at - floor(at);
    } else if wrap == 2u {
        c = 1.0 - abs(at - 2.0 * floor(at * 0.5) - 1.0);
    }
    return min(u32(c * f32(size)), size - 1u);
}
