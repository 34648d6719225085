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
    // Beyond the picture's edge something finite is read, and what is written there goes nowhere.
    let empty = position.w >= arrayLength(&psao_instances) / 4u;
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

// Bits: the corners of a block that another block has, too, which lies so many cells further.
fn psao_shared(apart: vec3<i32>) -> u32 {
    let same = apart == vec3<i32>(0);
    let high = vec3<u32>(same | (apart == vec3<i32>(1))) * vec3<u32>(0xaau, 0xccu, 0xf0u);
    let low = vec3<u32>(same | (apart == vec3<i32>(-1))) * vec3<u32>(0x55u, 0x33u, 0x0fu);
    let axes = high | low;
    return axes.x & axes.y & axes.z;
}

// Cells between blocks that have none in common.
const PSAO_ELSEWHERE: f32 = 64.0;

// One of two tables.
fn psao_either(a: PsaoTable, b: PsaoTable, second: bool) -> PsaoTable {
    return PsaoTable(
        select(a.key, b.key, second),
        select(a.hash, b.hash, second),
        select(a.row, b.row, second),
        select(a.layer, b.layer, second),
        select(a.bucket_first, b.bucket_first, second),
        select(a.bucket_count, b.bucket_count, second),
        select(a.inverse_count, b.inverse_count, second),
    );
}

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
    let apart = fragment_b.base - fragment_a.base;
    let all_a = select(0u, psao_within(grid_a, base_a), live_a);
    let all_b = select(0u, psao_within(grid_b, base_b), live_b);
    var block_a = psao_block(table_a, all_a);
    // Of the second pixel's block, what the first one's has not.
    var block_b = psao_block(table_b, all_b & ~select(0u, psao_shared(-apart), one_grid));
    var unsure = block_a.unsure | (block_b.unsure << 8u);
    var entry = 0u;
    loop {
        let bit = psao_lowest(unsure);
        let of_b = bit >= 8u;
        let offset = psao_corner(bit);
        let table = psao_either(table_a, table_b, of_b);
        let bucket = psao_bucket(table, offset);
        let key = psao_key(table, offset);
        let found = psao_peek(unsure != 0u, bucket, key, entry);
        block_a = psao_with(block_a, bit, select(found.cell, 0u, of_b));
        block_b = psao_with(block_b, bit & 7u, select(0u, found.cell, of_b));
        unsure &= select(0xffffffffu, unsure - 1u, found.last);
        entry = select(entry + 1u, 0u, found.last);
        if unsure == 0u {
            break;
        }
    }
    var left = psao_corners(block_a) | (psao_corners(block_b) << 8u);
    let normal = psao_two(fragment_a.normal, fragment_b.normal);
    let radius = vec2<f32>(grid_a.radius, grid_b.radius);
    let inverse_radius2 = 1.0 / (radius * radius);
    // Both pixels and all cells are seen from the first pixel's block. The second one's lies beside
    // it, or so far off that neither has a share in the other's cells.
    let beside = one_grid && all(abs(apart) <= vec3<i32>(1));
    let between = select(vec3<f32>(PSAO_ELSEWHERE, 0.0, 0.0), vec3<f32>(apart), beside);
    let start_a = fragment_a.place - PSAO_HALF_STEP;
    let start_b = fragment_b.place - PSAO_HALF_STEP + between;
    var sums = PsaoSums(vec2<f32>(0.0), vec2<f32>(0.0));
    var round = 0u;
    loop {
        let bit = psao_lowest(left);
        let of_b = bit >= 8u;
        let offset = psao_corner(bit);
        let cell = select(psao_cell_at(block_a, offset), psao_cell_at(block_b, offset), of_b);
        let key = psao_key(psao_either(table_a, table_b, of_b), offset);
        let now = psao_round(cell, key, round);
        let lower = vec3<f32>(vec3<i32>(offset)) + select(vec3<f32>(0.0), between, of_b);
        let place_a = start_a - lower;
        let place_b = start_b - lower;
        let seen = PsaoSeen(
            normal,
            psao_two(place_a, place_b),
            inverse_radius2,
            vec2<f32>(psao_share(place_a), psao_share(place_b)),
        );
        sums = psao_add(sums, seen, now.points.x);
        sums = psao_add(sums, seen, now.points.y);
        sums = psao_add(sums, seen, now.points.z);
        round = select(0u, round + 1u, now.more);
        left = select(left & (left - 1u), left, now.more);
        if left == 0u {
            break;
        }
    }
    let blend = min(sums.openness / sums.weights * (1.0 / 255.0), vec2<f32>(1.0));
    let openness = select(vec2<f32>(1.0), blend, sums.weights > vec2<f32>(0.0));
    textureStore(psao_openness, at, vec4<f32>(openness.x));
    textureStore(psao_openness, at + vec2<u32>(1u, 0u), vec4<f32>(openness.y));
}
