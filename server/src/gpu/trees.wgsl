// Rays through obvhs' compressed wide trees (Ylitie et al. 2017), uploaded as they are: a node is
// five vectors. One tree a body.

@group(0) @binding(1) var<storage, read> nodes: array<vec4<u32>>;

// Tree depth is checked when it is built.
const STACK: u32 = 32u;

// As the processor's test (rays/body.rs): what tells the sides of an edge comes from its ends
// alone, so no ray slips through between two triangles.
fn is_hit(triangle: u32, origin: vec3<f32>, direction: vec3<f32>, t_max: f32) -> bool {
    let a = triangles[triangle * 3u].xyz - origin;
    let b = triangles[triangle * 3u + 1u].xyz - origin;
    let c = triangles[triangle * 3u + 2u].xyz - origin;
    let sides = vec3(
        dot(cross(c - b, c + b), direction),
        dot(cross(a - c, a + c), direction),
        dot(cross(b - a, b + a), direction),
    );
    if !(all(sides >= vec3(0.0)) || all(sides <= vec3(0.0))) {
        return false;
    }
    let normal = cross(b - a, c - a);
    let t = dot(normal, a) / dot(normal, direction);
    let sum = sides.x + sides.y + sides.z;
    if !(t > 0.0 && t < t_max && sum != 0.0) {
        return false;
    }
    return !is_hole(triangle, sides.y / sum, sides.z / sum);
}

// Bits of the children whose boxes a ray meets: inner nodes in the high 8, in the order they are
// to be walked in, triangles of leaves in the low 24.
fn children_hit(
    node: u32,
    origin: vec3<f32>,
    inverse: vec3<f32>,
    negative: vec3<bool>,
    octant: u32,
    t_max: f32,
) -> u32 {
    let head = nodes[node];
    let exponents = vec3(head.w, head.w >> 8u, head.w >> 16u) & vec3(255u);
    let scale = bitcast<vec3<f32>>(exponents << vec3(23u)) * inverse;
    let start = (bitcast<vec3<f32>>(head.xyz) - origin) * inverse;
    let links = nodes[node + 1u];
    let x = nodes[node + 2u];
    let y = nodes[node + 3u];
    let z = nodes[node + 4u];
    var hits = 0u;
    for (var half = 0u; half < 2u; half++) {
        let kinds = links[2u + half];
        let is_inner = (kinds & (kinds << 1u)) & 0x10101010u;
        let slots = (kinds ^ (octant & ((is_inner >> 4u) * 255u))) & 0x1f1f1f1fu;
        let bits = (kinds >> 5u) & 0x07070707u;
        let low_x = select(x[half], x[2u + half], negative.x);
        let high_x = select(x[2u + half], x[half], negative.x);
        let low_y = select(y[half], y[2u + half], negative.y);
        let high_y = select(y[2u + half], y[half], negative.y);
        let low_z = select(z[half], z[2u + half], negative.z);
        let high_z = select(z[2u + half], z[half], negative.z);
        for (var shift = 0u; shift < 32u; shift += 8u) {
            let low = vec3<f32>(vec3(low_x >> shift, low_y >> shift, low_z >> shift) & vec3(255u));
            let high =
                vec3<f32>(vec3(high_x >> shift, high_y >> shift, high_z >> shift) & vec3(255u));
            let enter = low * scale + start;
            let leave = high * scale + start;
            let near = max(max(enter.x, enter.y), max(enter.z, 0.0));
            let far = min(min(leave.x, leave.y), min(leave.z, t_max));
            if near <= far {
                hits |= ((bits >> shift) & 255u) << ((slots >> shift) & 31u);
            }
        }
    }
    return hits;
}

// Whether anything in a tree is in the way of a ray, nearer than `t_max`.
fn tree_occludes(
    first_node: u32,
    first_triangle: u32,
    origin: vec3<f32>,
    direction: vec3<f32>,
    t_max: f32,
) -> bool {
    let negative = direction < vec3(0.0);
    // Not infinite, which times zero would be NaN.
    let steep = 1e27;
    let flat = abs(direction) < vec3(1.0 / steep);
    let inverse = select(1.0 / direction, select(vec3(steep), vec3(-steep), negative), flat);
    let octant = select(4u, 0u, negative.x) + select(2u, 0u, negative.y)
        + select(1u, 0u, negative.z);
    var stack: array<vec2<u32>, STACK>;
    var height = 0u;
    // First child, and bits of those to walk.
    var group = vec2(0u, 0x80000000u);
    loop {
        if (group.y & 0xff000000u) == 0u {
            if height == 0u {
                return false;
            }
            height -= 1u;
            group = stack[height];
        }
        let bit = firstLeadingBit(group.y);
        let inner = group.y & 255u;
        let first = group.x;
        group.y &= ~(1u << bit);
        if (group.y & 0xff000000u) != 0u {
            stack[height] = group;
            height += 1u;
        }
        let slot = (bit - 24u) ^ octant;
        let node = (first_node + first + countOneBits(inner & ~(0xffffffffu << slot))) * 5u;
        let links = nodes[node + 1u];
        let hits =
            children_hit(node, origin, inverse, negative, octant * 0x01010101u, t_max);
        var leaves = hits & 0x00ffffffu;
        while leaves != 0u {
            let leaf = firstTrailingBit(leaves);
            leaves &= leaves - 1u;
            if is_hit(first_triangle + links.y + leaf, origin, direction, t_max) {
                return true;
            }
        }
        group = vec2(links.x, (hits & 0xff000000u) | (nodes[node].w >> 24u));
    }
    return false;
}

fn is_occluded(origin: vec3<f32>, direction: vec3<f32>, t_max: f32) -> bool {
    if trees.fixed_nodes > 0u && tree_occludes(0u, 0u, origin, direction, t_max) {
        return true;
    }
    return trees.moving_nodes > 0u
        && tree_occludes(trees.fixed_nodes, trees.fixed_triangles, origin, direction, t_max);
}

// Rays from one place, in the directions of a set.
struct Fan {
    origin: vec3<f32>,
    own_set: u32,
    x: vec3<f32>,
    y: vec3<f32>,
    normal: vec3<f32>,
}

@group(1) @binding(7) var<storage, read> asked: array<Fan>;
// In: rays to trace, in the set's sorted order. Out: those of them that hit.
@group(1) @binding(8) var<storage, read_write> fan_bits: array<u32>;

// A word of a fan's rays, which go nearly the same way, against what stands still.
@compute @workgroup_size(64)
fn fans(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= trees.rays {
        return;
    }
    let fan = asked[id.x / trees.fan_words];
    let own = fan.own_set * (arrayLength(&directions) / SETS);
    let first = own + id.x % trees.fan_words * 32u;
    var open = fan_bits[id.x];
    var found = 0u;
    while open != 0u && trees.fixed_nodes > 0u {
        let i = firstTrailingBit(open);
        open &= open - 1u;
        let d = directions[own + u32(directions[first + i].w)].xyz;
        let direction = fan.x * d.x + fan.y * d.y + fan.normal * d.z;
        if tree_occludes(0u, 0u, fan.origin, direction, trees.t_max) {
            found |= 1u << i;
        }
    }
    fan_bits[id.x] = found;
}
