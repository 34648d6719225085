// The lookup of a whole G-buffer: a thread a pixel, or two in the fast tier. Follows storage.wgsl
// and psao.wgsl.

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

// Three coordinates of two pixels side by side.
struct PsaoTwo {
    x: vec2<f32>,
    y: vec2<f32>,
    z: vec2<f32>,
}

fn psao_two(a: vec3<f32>, b: vec3<f32>) -> PsaoTwo {
    return PsaoTwo(vec2<f32>(a.x, b.x), vec2<f32>(a.y, b.y), vec2<f32>(a.z, b.z));
}

fn psao_dot_two(a: PsaoTwo, b: PsaoTwo) -> vec2<f32> {
    return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}

fn psao_dot_each(a: PsaoTwo, b: vec3<f32>) -> vec2<f32> {
    return fma(a.x, vec2<f32>(b.x), fma(a.y, vec2<f32>(b.y), a.z * b.z));
}

// The blends of two pixels.
struct PsaoSums {
    weights: vec2<f32>,
    openness: vec2<f32>,
}

// psao_add for both.
fn psao_add_two(
    sums: PsaoSums,
    inverse_radius2: vec2<f32>,
    normal: PsaoTwo,
    place: PsaoTwo,
    share: vec2<f32>,
    word: u32,
) -> PsaoSums {
    let point = psao_point(word);
    let p = point.place;
    let d = PsaoTwo(p.x - place.x, p.y - place.y, p.z - place.z);
    let agree = max(psao_dot_each(normal, point.normal), vec2<f32>(0.0));
    let agree2 = max(agree * agree, vec2<f32>((PSAO_T_N * PSAO_T_N) * point.square));
    let along = psao_dot_two(normal, d);
    let point_along = psao_dot_each(d, point.normal);
    let h2 = max(along * along * point.square, point_along * point_along);
    let squared = psao_dot_two(d, d);
    let toward_reach = inverse_radius2 * (-1.0 / PSAO_REACH);
    let in_reach = max(fma(squared, toward_reach, vec2<f32>(1.0)), vec2<f32>(PSAO_BEYOND));
    let near = fma(squared, inverse_radius2, vec2<f32>(PSAO_CORE)) * point.square;
    let apart = fma(h2, PSAO_FLATNESS * inverse_radius2, near);
    let ratio = agree2 * agree2 / (apart * point.square);
    let weight = share * point.seen * in_reach * (ratio * ratio);
    return PsaoSums(
        sums.weights + weight,
        fma(weight, vec2<f32>(point.openness), sums.openness),
    );
}

// Bits: the corners of a block that another block has, too, which lies so many cells further.
fn psao_shared(apart: vec3<i32>) -> u32 {
    let same = apart == vec3<i32>(0);
    let high = vec3<u32>(same | (apart == vec3<i32>(1))) * vec3<u32>(0xaau, 0xccu, 0xf0u);
    let low = vec3<u32>(same | (apart == vec3<i32>(-1))) * vec3<u32>(0x55u, 0x33u, 0x0fu);
    let axes = high | low;
    return axes.x & axes.y & axes.z;
}

// Far outside of any cell: a place at which none counts.
const PSAO_NOWHERE: vec3<f32> = vec3<f32>(1000.0);

@compute @workgroup_size(64)
fn psao_pass_fast(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // A thread has two pixels, which mostly share cells. Threads that run side by side have theirs
    // in a square, not in a row: they share more of them, too.
    let x = (thread & 1u) | ((thread >> 2u) & 6u);
    let y = ((thread >> 1u) & 3u) | ((thread >> 3u) & 4u);
    let at = tile.xy * vec2<u32>(16u, 8u) + vec2<u32>(x * 2u, y);
    let a = psao_pixel(at);
    let b = psao_pixel(at + vec2<u32>(1u, 0u));
    let grid_a = psao_grid_fast(select(a.instance, 0u, a.empty));
    var grid_b = grid_a;
    if a.empty || b.instance != a.instance {
        grid_b = psao_grid_fast(select(b.instance, 0u, b.empty));
    }
    let fragment_a = psao_fragment(grid_a, a.position, a.normal);
    let fragment_b = psao_fragment(grid_b, b.position, b.normal);
    let live_a = !a.empty && !fragment_a.outside;
    let live_b = !b.empty && !fragment_b.outside;
    let one_grid = live_a && live_b && a.instance == b.instance;
    let base_a = vec3<u32>(fragment_a.base);
    let base_b = vec3<u32>(fragment_b.base);
    let table_a = psao_table(grid_a, base_a);
    let table_b = psao_table(grid_b, base_b);
    var block_a = psao_block(grid_a, table_a, base_a, live_a);
    // Of the second pixel's block, what the first one's has not.
    var block_b = PsaoBlock(vec4<u32>(0u), vec4<u32>(0u), 0u);
    let apart = fragment_b.base - fragment_a.base;
    var todo = select(0u, 255u, live_b) & ~select(0u, psao_shared(-apart), one_grid);
    while todo != 0u {
        let corner = psao_lowest(todo);
        todo &= todo - 1u;
        let offset = psao_corner(corner);
        let found = psao_candidate(
            all(base_b + offset < grid_b.dims),
            psao_key(table_b, offset),
            psao_bucket(table_b, offset),
        );
        block_b = psao_with(block_b, corner, found.cell);
        block_b.unsure |= found.unsure << corner;
    }
    while (block_a.unsure | block_b.unsure) != 0u {
        let of_b = block_a.unsure == 0u;
        let corner = psao_lowest(select(block_a.unsure, block_b.unsure, of_b));
        let offset = psao_corner(corner);
        let bucket = select(psao_bucket(table_a, offset), psao_bucket(table_b, offset), of_b);
        let key = select(psao_key(table_a, offset), psao_key(table_b, offset), of_b);
        let found = psao_search(bucket, key);
        block_a = psao_with(block_a, corner, select(found, 0u, of_b));
        block_b = psao_with(block_b, corner, select(0u, found, of_b));
        block_b.unsure &= select(0xffffffffu, block_b.unsure - 1u, of_b);
        block_a.unsure &= select(block_a.unsure - 1u, 0u, of_b);
    }
    var left = psao_corners(block_a) | (psao_corners(block_b) << 8u);
    let normal = psao_two(fragment_a.normal, fragment_b.normal);
    let radius = vec2<f32>(grid_a.radius, grid_b.radius);
    let inverse_radius2 = 1.0 / (radius * radius);
    // The second pixel seen from the first one's block.
    let b_from_a = select(PSAO_NOWHERE, fragment_b.place + vec3<f32>(apart), one_grid);
    var sums = PsaoSums(vec2<f32>(0.0), vec2<f32>(0.0));
    var round = 0u;
    while left != 0u {
        let bit = psao_lowest(left);
        let of_b = bit >= 8u;
        let offset = psao_corner(bit);
        let cell = select(psao_cell_at(block_a, offset), psao_cell_at(block_b, offset), of_b);
        let key = select(psao_key(table_a, offset), psao_key(table_b, offset), of_b);
        let now = psao_round(cell, key, round);
        let lower = vec3<f32>(vec3<i32>(offset));
        let place_a = select(fragment_a.place, PSAO_NOWHERE, of_b) - lower;
        let place_b = select(b_from_a, fragment_b.place, of_b) - lower;
        let share = vec2<f32>(psao_share(place_a), psao_share(place_b));
        let place = psao_two(place_a - 0.015625, place_b - 0.015625);
        sums = psao_add_two(sums, inverse_radius2, normal, place, share, now.points.x);
        sums = psao_add_two(sums, inverse_radius2, normal, place, share, now.points.y);
        sums = psao_add_two(sums, inverse_radius2, normal, place, share, now.points.z);
        round = select(0u, round + 1u, now.more);
        left = select(left & (left - 1u), left, now.more);
    }
    let blend = min(sums.openness / sums.weights * (1.0 / 255.0), vec2<f32>(1.0));
    let openness = select(vec2<f32>(1.0), blend, sums.weights > vec2<f32>(0.0));
    textureStore(psao_openness, at, vec4<f32>(openness.x));
    textureStore(psao_openness, at + vec2<u32>(1u, 0u), vec4<f32>(openness.y));
}
