// PSAO: the lookup, for any engine. Blends the points around a fragment into its openness: 1 is
// open, 0 fully occluded. The CPU's lookup (sdk/core/src/lookup.rs) is the definition; these
// functions agree with it to 1/255.
//
// What to call:
//     psao_planar(instance, position, normal)    the default kernel
//     psao_paper(instance, position, normal)     Neff et al., Eq. 2 to 4
//     psao_over_baked(kernel, instance, position, normal, baked, share)
//                                                either, and a baked value where no point is
// Ask the stream's header which of the two its points were made for.
//     instance    index into the instance buffer; below the buffer's capacity
//     position    in the instance's local space (rest space where it is skinned or morphed), in
//                 local units. It must come from the vertices' own positions, as a varying. Never
//                 subtract it from a world position: f32 does not hold both far from the origin.
//     normal      in the same space, of any length, on the side of the surface that is seen
// Both finite.
//
// What it reads: three functions that a shim defines (storage.wgsl or texel.wgsl, or your own):
// the index-th 16 bytes of the instance, bucket and cell buffer, as four words.
//     fn psao_load_instance(index: u32) -> vec4<u32>
//     fn psao_load_bucket(index: u32) -> vec4<u32>
//     fn psao_load_cell(index: u32) -> vec4<u32>
// Nothing else: no bindings, no derivatives, no texture filters, no subgroups. Any stage will do.

// Points whose normal differs more than this from the fragment's (as a dot product) do not count;
// for `planar` they count as if it were this much.
const PSAO_T_N: f32 = 0.1;
// `paper`: points that lie this much above or below their own plane do not count.
const PSAO_T_D: f32 = 0.7;
// `planar`: squared distances from the planes count this much more than those along them.
const PSAO_FLATNESS: f32 = 30.0;
// `planar`: the squared distance, in radii, from which weights begin to fall.
const PSAO_CORE: f32 = 0.5;
// `planar`: the squared distance, in radii, from which points count next to nothing, and what is
// left of their weight there.
const PSAO_REACH: f32 = 1.2;
const PSAO_BEYOND: f32 = 0.001;
// `planar`: how far before the block switches the cells fade that it will leave, in cells.
const PSAO_FADE: f32 = 0.3;
// `planar`: points less open than this count less, by the square.
const PSAO_SEEN: f32 = 0.2;
// `planar`: what a point counts at least, however dark.
const PSAO_UNSEEN: f32 = 0.0001;
// From this weight on, points that are not dark are near.
const PSAO_NEAR: f32 = 0.05;
// The kernel `paper`, as the stream's header numbers it.
const PSAO_PAPER: u32 = 0u;
// A bucket's entry: the cell's index, and above it a tag of its key (psao_tag) or 0 for none.
const PSAO_ENTRY_CELL: u32 = 0x3fffffu;

// An instance's grid and hash table: the 64 bytes of an instance.
struct PsaoGrid {
    origin: vec3<f32>,
    // Interpolation radius, in cells.
    radius: f32,
    cells_per_unit: vec3<f32>,
    bucket_first: u32,
    dims: vec3<u32>,
    // 0: the instance has no points.
    bucket_count: u32,
    normal_scale: vec3<f32>,
}

// A fragment seen from the 2×2×2 cells nearest to it: the block.
struct PsaoFragment {
    // The block's lower cell, −1 at least.
    base: vec3<i32>,
    // The fragment's place seen from it, in cells: 0.5 to 1.5.
    place: vec3<f32>,
    // Unit length, or zero, in cell space.
    normal: vec3<f32>,
    // Outside the grid, or without points: it is open.
    outside: bool,
}

fn psao_grid(instance: u32) -> PsaoGrid {
    let a = psao_load_instance(instance * 4u);
    let b = psao_load_instance(instance * 4u + 1u);
    let c = psao_load_instance(instance * 4u + 2u);
    let d = psao_load_instance(instance * 4u + 3u);
    return PsaoGrid(
        bitcast<vec3<f32>>(a.xyz),
        bitcast<f32>(a.w),
        bitcast<vec3<f32>>(b.xyz),
        b.w,
        c.xyz,
        c.w,
        bitcast<vec3<f32>>(d.xyz),
    );
}

fn psao_fragment(grid: PsaoGrid, position: vec3<f32>, normal: vec3<f32>) -> PsaoFragment {
    let g = (position - grid.origin) * grid.cells_per_unit;
    let inside = all(g >= vec3<f32>(-0.5)) && all(g < vec3<f32>(grid.dims) + 0.5);
    // Clamped, so that no float is too large for the integer it becomes.
    let lower = floor(clamp(g, vec3<f32>(-0.5), vec3<f32>(grid.dims) + 0.5) - 0.5);
    // Divided by the largest first, so that no square over- or underflows.
    let largest = max(max(abs(normal.x), abs(normal.y)), abs(normal.z));
    let n = normal / max(largest, 1e-37) * grid.normal_scale;
    let squared = dot(n, n);
    return PsaoFragment(
        vec3<i32>(lower),
        g - lower,
        n * select(0.0, inverseSqrt(squared), squared > 0.0),
        grid.bucket_count == 0u || !inside,
    );
}

// x + y·Dx·weight_y + z·Dx·Dy·weight_z, wrapping.
fn psao_weigh(grid: PsaoGrid, cell: vec3<u32>, weight_y: u32, weight_z: u32) -> u32 {
    return cell.x + cell.y * grid.dims.x * weight_y
        + cell.z * (grid.dims.x * grid.dims.y) * weight_z;
}

// The index of the cell with a key that a bucket names, 0 if there is none.
fn psao_search(bucket: u32, key: u32) -> u32 {
    for (var i = 0u; i < 8u; i += 1u) {
        let entry = psao_load_bucket(bucket * 2u + (i >> 2u))[i & 3u] & PSAO_ENTRY_CELL;
        if entry == 0u {
            break;
        }
        if psao_load_cell(entry * 2u).x == key {
            return entry;
        }
    }
    return 0u;
}

// The index of the cell at a grid coordinate, 0 if there is none: hash (Eq. 1), then search its
// bucket for the key.
fn psao_find(grid: PsaoGrid, cell: vec3<u32>) -> u32 {
    let bucket = grid.bucket_first + psao_weigh(grid, cell, 17u, 31u) % grid.bucket_count;
    return psao_search(bucket, psao_weigh(grid, cell, 1u, 1u));
}

// A point's place in its cell, in cells: the middle of its 1/32 step.
fn psao_point_place(point: u32) -> vec3<f32> {
    let steps = vec3<u32>(point >> 16u, point >> 21u, point >> 26u) & vec3<u32>(31u);
    return (vec3<f32>(steps) + 0.5) * 0.03125;
}

// A point's unit normal in cell space: octahedral, 15 levels an axis.
fn psao_point_normal(point: u32) -> vec3<f32> {
    let codes = vec2<u32>(point >> 8u, point >> 12u) & vec2<u32>(15u);
    let uv = (vec2<f32>(min(codes, vec2<u32>(14u))) - 7.0) / 7.0;
    let z = 1.0 - abs(uv.x) - abs(uv.y);
    let folded = (1.0 - abs(uv.yx)) * select(vec2<f32>(1.0), vec2<f32>(-1.0), uv < vec2<f32>(0.0));
    return normalize(vec3<f32>(select(folded, uv, z >= 0.0), z));
}

fn psao_point_openness(point: u32) -> f32 {
    return f32(point & 255u) * (1.0 / 255.0);
}

// Weight of a point at `d` from the fragment. Eq. 2 and 3.
fn psao_paper_weight(radius: f32, normal: vec3<f32>, d: vec3<f32>, point_normal: vec3<f32>) -> f32 {
    let squared = dot(d, d);
    let along = dot(point_normal, d);
    if dot(point_normal, normal) <= PSAO_T_N
        || (along * along >= PSAO_T_D * squared && squared > 0.0) {
        return 0.0;
    }
    return max((radius - sqrt(squared)) / radius, 0.0);
}

// Weight of a point at `d` from the fragment.
fn psao_planar_weight(
    radius: f32,
    normal: vec3<f32>,
    d: vec3<f32>,
    point_normal: vec3<f32>,
) -> f32 {
    let agree = max(dot(point_normal, normal), PSAO_T_N);
    let h = max(abs(dot(normal, d)), abs(dot(point_normal, d)));
    let squared = dot(d, d);
    let apart = PSAO_CORE + (squared + PSAO_FLATNESS * (h * h)) / (radius * radius);
    let in_reach = max(1.0 - squared / (PSAO_REACH * radius * radius), PSAO_BEYOND);
    let agree2 = agree * agree;
    let agree4 = agree2 * agree2;
    return in_reach * agree4 * agree4 / (apart * apart);
}

// How much the lower and the upper cells of a block count along the axes, for a fragment at this
// place in it: nothing once the block is about to leave them.
fn psao_side(place: vec3<f32>, offset: vec3<u32>) -> f32 {
    let left = select(1.5 - place, place - 0.5, offset != vec3<u32>(0u));
    let sides = clamp(left / PSAO_FADE, vec3<f32>(0.0), vec3<f32>(1.0));
    return sides.x * sides.y * sides.z;
}

// How much a point of this openness counts for `planar`.
fn psao_seen(openness: f32) -> f32 {
    let lit = min(openness / PSAO_SEEN, 1.0);
    return lit * lit + PSAO_UNSEEN;
}

// The blend, written plainly: each of the 8 cells is found, each of its points weighed. The
// openness, and how far points cover the place: 0 where none is near, 1 where enough are.
fn psao_blend(planar: bool, instance: u32, position: vec3<f32>, normal: vec3<f32>) -> vec2<f32> {
    let grid = psao_grid(instance);
    let fragment = psao_fragment(grid, position, normal);
    if fragment.outside {
        return vec2<f32>(1.0, 0.0);
    }
    var weights = 0.0;
    var sum = 0.0;
    for (var corner = 0u; corner < 8u; corner += 1u) {
        let offset = vec3<u32>(corner, corner >> 1u, corner >> 2u) & vec3<u32>(1u);
        // −1 becomes a large number: below the grid is out of range too.
        let cell = vec3<u32>(fragment.base) + offset;
        if any(cell >= grid.dims) {
            continue;
        }
        let found = psao_find(grid, cell);
        if found == 0u {
            continue;
        }
        let corner_from = vec3<f32>(offset) - fragment.place;
        let side = psao_side(fragment.place, offset);
        for (var i = 1u; i < 8u; i += 1u) {
            let point = psao_load_cell(found * 2u + (i >> 2u))[i & 3u];
            if point == 0u {
                break;
            }
            if point < 0x80000000u {
                continue;
            }
            let d = corner_from + psao_point_place(point);
            let point_normal = psao_point_normal(point);
            let openness = psao_point_openness(point);
            var weight = 0.0;
            if planar {
                weight = side * psao_seen(openness)
                    * psao_planar_weight(grid.radius, fragment.normal, d, point_normal);
            } else {
                weight = psao_paper_weight(grid.radius, fragment.normal, d, point_normal);
            }
            weights += weight;
            sum += weight * openness;
        }
    }
    if weights > 0.0 {
        let openness = min(sum / weights, 1.0);
        // Dark points weigh less, but are as near.
        let seen = select(1.0, psao_seen(openness), planar);
        return vec2<f32>(openness, min(weights / (PSAO_NEAR * seen), 1.0));
    }
    return vec2<f32>(1.0, 0.0);
}

// s · (min(1, 5o)² + 0.0001) · max(0.001, 1 − d²/1.2r²) · max(0.1, n·nₚ)⁸
// / (0.5 + (d² + 30h²)/r²)² with h = max(|n·d|, |nₚ·d|), o the point's openness and s its cell's
// part; open where no point is.
fn psao_planar(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> f32 {
    return psao_blend(true, instance, position, normal).x;
}

// The paper's Eq. 2 to 4; open where no point counts.
fn psao_paper(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> f32 {
    return psao_blend(false, instance, position, normal).x;
}

// ---- The same as psao_planar, in fewer steps, for buckets with tags. Without them it gives the
// same picture, but not sooner. ----

// The tag of a key where a bucket's entry has it, above the cell's index; never 0. Whoever uploads
// buckets may put it there: it tells a cell that is not there without a look at the cells that are.
// No two entries of a bucket have the same tag, and none is in its second half: other buckets are
// left without any.
fn psao_tag(key: u32) -> u32 {
    return max((key * 0x9e3779b1u) & ~PSAO_ENTRY_CELL, PSAO_ENTRY_CELL + 1u);
}

// hash % count, for a count below 2^23; inverse is 1 / count. Integer division is slow on GPUs, and
// unsigned integers are where they become floats or are compared.
fn psao_modulo(hash: u32, count: u32, inverse: f32) -> u32 {
    // Floats hold 24 bits: a quotient that is surely not too large, then one for what it left.
    let left = i32(hash - u32(i32(f32(i32(hash >> 1u)) * (inverse * 1.999998))) * count);
    let divisor = i32(count);
    let rest = left - i32(f32(left) * inverse) * divisor;
    // One count too few or too many.
    let raised = select(rest, rest + divisor, rest < 0);
    let whole = select(raised, raised - divisor, raised >= divisor);
    // The first quotient by 1 is no signed integer.
    return select(u32(whole), 0u, count == 1u);
}

// Which bit is the lowest: the exponent of that bit as a float. GLSL ES 3.00 cannot say.
fn psao_lowest(bits: u32) -> u32 {
    return (bitcast<u32>(f32(i32(bits & (0u - bits)))) >> 23u) - 127u;
}

// A corner of a block, of 8: bits x, y, z.
fn psao_corner(corner: u32) -> vec3<u32> {
    return vec3<u32>(corner, corner >> 1u, corner >> 2u) & vec3<u32>(1u);
}

// As psao_grid, with a load less: only the direction of a normal counts.
fn psao_grid_fast(instance: u32) -> PsaoGrid {
    var grid = psao_grid(instance);
    grid.normal_scale = grid.cells_per_unit.x / grid.cells_per_unit;
    return grid;
}

// What keys and hashes of a block's cells are made of.
struct PsaoTable {
    // Of its lower cell.
    key: u32,
    hash: u32,
    // What a step along y and z adds to a key.
    row: u32,
    layer: u32,
    bucket_first: u32,
    bucket_count: u32,
    inverse_count: f32,
}

fn psao_table(grid: PsaoGrid, base: vec3<u32>) -> PsaoTable {
    let row = grid.dims.x;
    let layer = grid.dims.x * grid.dims.y;
    return PsaoTable(
        base.x + base.y * row + base.z * layer,
        base.x + base.y * row * 17u + base.z * layer * 31u,
        row,
        layer,
        grid.bucket_first,
        grid.bucket_count,
        1.0 / f32(grid.bucket_count),
    );
}

fn psao_key(table: PsaoTable, offset: vec3<u32>) -> u32 {
    return table.key + offset.x + select(0u, table.row, offset.y != 0u)
        + select(0u, table.layer, offset.z != 0u);
}

fn psao_bucket(table: PsaoTable, offset: vec3<u32>) -> u32 {
    let hash = table.hash + offset.x + select(0u, table.row * 17u, offset.y != 0u)
        + select(0u, table.layer * 31u, offset.z != 0u);
    return table.bucket_first + psao_modulo(hash, table.bucket_count, table.inverse_count);
}

// What one corner of a block may be.
struct PsaoCandidate {
    // The cell that it is if it is there; 0 if it is not there for sure.
    cell: u32,
    // 1 where its bucket has to be searched.
    unsure: u32,
}

// What is left of the smallest entry with the tag looked for taken off: the cell, if below 2^22.
fn psao_pick(entries: vec4<u32>, tag: u32) -> u32 {
    let rest = entries ^ vec4<u32>(tag);
    return min(min(rest.x, rest.y), min(rest.z, rest.w));
}

fn psao_candidate(there: bool, key: u32, bucket: u32) -> PsaoCandidate {
    if !there {
        return PsaoCandidate(0u, 0u);
    }
    let entries = psao_load_bucket(bucket * 2u);
    let found = psao_pick(entries, psao_tag(key));
    let here = found <= PSAO_ENTRY_CELL;
    // One bucket of some hundred has no tags and has to be searched.
    let unsure = entries.x - 1u < PSAO_ENTRY_CELL;
    return PsaoCandidate(select(0u, found, here), select(0u, 1u, unsure));
}

// Two cells side by side along x, at a row of a block: its y and z.
struct PsaoPair {
    cells: vec2<u32>,
    // Bits.
    unsure: u32,
}

fn psao_pair(table: PsaoTable, there: vec2<bool>, row: vec2<u32>) -> PsaoPair {
    let offset = vec3<u32>(0u, row);
    let first = psao_bucket(table, offset);
    // Their buckets are neighbours, too.
    let last = first + 1u == table.bucket_first + table.bucket_count;
    let next = select(first + 1u, table.bucket_first, last);
    let key = psao_key(table, offset);
    let a = psao_candidate(there.x, key, first);
    let b = psao_candidate(there.y, key + 1u, next);
    return PsaoPair(vec2<u32>(a.cell, b.cell), a.unsure | (b.unsure << 1u));
}

// The cells of a block.
struct PsaoBlock {
    // Of the corners 0 to 3 and 4 to 7; 0 where there is none for sure.
    lower: vec4<u32>,
    upper: vec4<u32>,
    // Bits: the corners whose bucket has to be searched.
    unsure: u32,
}

// Bits: the corners of a block that lie inside of the grid.
fn psao_within(grid: PsaoGrid, base: vec3<u32>) -> u32 {
    let low = vec3<u32>(base < grid.dims) * vec3<u32>(0x55u, 0x33u, 0x0fu);
    let high = vec3<u32>(base + 1u < grid.dims) * vec3<u32>(0xaau, 0xccu, 0xf0u);
    let axes = low | high;
    return axes.x & axes.y & axes.z;
}

// The cells at some corners of a block.
fn psao_block(table: PsaoTable, corners: u32) -> PsaoBlock {
    let low = (vec4<u32>(corners) & vec4<u32>(1u, 2u, 4u, 8u)) != vec4<u32>(0u);
    let high = (vec4<u32>(corners) & vec4<u32>(16u, 32u, 64u, 128u)) != vec4<u32>(0u);
    let a = psao_pair(table, low.xy, vec2<u32>(0u, 0u));
    let b = psao_pair(table, low.zw, vec2<u32>(1u, 0u));
    let c = psao_pair(table, high.xy, vec2<u32>(0u, 1u));
    let d = psao_pair(table, high.zw, vec2<u32>(1u, 1u));
    return PsaoBlock(
        vec4<u32>(a.cells, b.cells),
        vec4<u32>(c.cells, d.cells),
        a.unsure | (b.unsure << 2u) | (c.unsure << 4u) | (d.unsure << 6u),
    );
}

// With the cell that one corner was found to be.
fn psao_with(block: PsaoBlock, corner: u32, cell: u32) -> PsaoBlock {
    let here = vec4<u32>(0u, 1u, 2u, 3u) == vec4<u32>(corner & 3u);
    // Not select: GLSL ES has none for integer vectors.
    let cells = vec4<u32>(here) * cell;
    let high = vec4<u32>(select(0u, 0xffffffffu, corner >= 4u));
    return PsaoBlock(block.lower | (cells & ~high), block.upper | (cells & high), block.unsure);
}

// Bits: the corners that may have a cell.
fn psao_corners(block: PsaoBlock) -> u32 {
    let bits = vec4<u32>(block.lower != vec4<u32>(0u)) * vec4<u32>(1u, 2u, 4u, 8u)
        + vec4<u32>(block.upper != vec4<u32>(0u)) * vec4<u32>(16u, 32u, 64u, 128u);
    return bits.x + bits.y + bits.z + bits.w;
}

fn psao_cell_at(block: PsaoBlock, offset: vec3<u32>) -> u32 {
    let back = offset.y != 0u;
    let lower = select(
        select(block.lower.x, block.lower.z, back),
        select(block.lower.y, block.lower.w, back),
        offset.x != 0u,
    );
    let upper = select(
        select(block.upper.x, block.upper.z, back),
        select(block.upper.y, block.upper.w, back),
        offset.x != 0u,
    );
    return select(lower, upper, offset.z != 0u);
}

// A look at one entry of a bucket without tags.
struct PsaoPeek {
    // The cell with the key, 0 if it is not in this entry.
    cell: u32,
    // No other entry needs a look.
    last: bool,
}

fn psao_peek(wanted: bool, bucket: u32, key: u32, entry: u32) -> PsaoPeek {
    if !wanted {
        return PsaoPeek(0u, true);
    }
    let cell = psao_load_bucket(bucket * 2u + (entry >> 2u))[entry & 3u] & PSAO_ENTRY_CELL;
    let here = cell != 0u && psao_load_cell(cell * 2u).x == key;
    return PsaoPeek(select(0u, cell, here), here || cell == 0u || entry == 7u);
}

// Up to three points of a cell; 0 where there is none. The third round is for the seventh point.
struct PsaoRound {
    points: vec3<u32>,
    more: bool,
}

fn psao_round(cell: u32, key: u32, round: u32) -> PsaoRound {
    let words = psao_load_cell(cell * 2u + min(round, 1u));
    // Another key: another cell of the same tag. This one is not there.
    let first = select(words.x, select(0u, words.y, words.x == key), round == 0u);
    let a = select(first, words.w, round == 2u);
    // A cell ends at its first empty word.
    let b = select(select(words.y, words.z, round == 0u), 0u, a == 0u || round == 2u);
    let c = select(select(words.z, words.w, round == 0u), 0u, b == 0u);
    return PsaoRound(vec3<u32>(a, b, c), c != 0u);
}

// Half a step of a point's place: it is in the middle of its step.
const PSAO_HALF_STEP: f32 = 0.015625;

// How much a cell counts for a fragment at this place in it, half a step less.
fn psao_share(place: vec3<f32>) -> f32 {
    // Times the inverse: not every compiler makes this of a division by a constant.
    let inside = 1.0 - abs(place - (0.5 - PSAO_HALF_STEP));
    let sides = clamp(inside * (1.0 / PSAO_FADE), vec3<f32>(0.0), vec3<f32>(1.0));
    return sides.x * sides.y * sides.z;
}

// A point as it is weighed.
struct PsaoPoint {
    // In its cell, half a step less.
    place: vec3<f32>,
    // Of any length: what is squared is divided by its square.
    normal: vec3<f32>,
    square: f32,
    // In 1/255.
    openness: f32,
    // What it counts; 0 for what is no point.
    seen: f32,
}

// Signed integers become floats in one step everywhere, unsigned ones do not.
fn psao_point(point: u32) -> PsaoPoint {
    let steps = vec3<i32>(vec3<u32>(point) & vec3<u32>(0x1f0000u, 0x3e00000u, 0x7c000000u));
    let scale = vec3<f32>(0.03125 / 65536.0, 0.03125 / 2097152.0, 0.03125 / 67108864.0);
    let codes = vec2<i32>(vec2<u32>(point >> 8u, point >> 12u) & vec2<u32>(15u));
    let uv = vec2<f32>(min(codes, vec2<i32>(14))) - 7.0;
    let z = 7.0 - abs(uv.x) - abs(uv.y);
    let fold = max(-z, 0.0);
    let m = vec3<f32>(uv - select(vec2<f32>(fold), vec2<f32>(-fold), uv < vec2<f32>(0.0)), z);
    let openness = f32(i32(point & 255u));
    let lit = min(openness * (1.0 / (255.0 * PSAO_SEEN)), 1.0);
    let seen = fma(lit, lit, PSAO_UNSEEN);
    return PsaoPoint(
        vec3<f32>(steps) * scale,
        m,
        fma(m.x, m.x, fma(m.y, m.y, m.z * m.z)),
        openness,
        select(seen, 0.0, i32(point) >= 0),
    );
}

// Three coordinates of two fragments.
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

// Two fragments' blends that are being made: sums of the weights, and of the weighted openness in
// 1/255.
struct PsaoSums {
    weights: vec2<f32>,
    openness: vec2<f32>,
}

// Two fragments among the points of a cell.
struct PsaoSeen {
    // Unit length.
    normal: PsaoTwo,
    // In the cell, half a step less.
    place: PsaoTwo,
    inverse_radius2: vec2<f32>,
    // How much the cell counts.
    share: vec2<f32>,
}

// With one more point. The formula of psao_planar_weight, with one division. Where there is just
// one fragment, compilers leave out what is done for the other.
fn psao_add(sums: PsaoSums, seen: PsaoSeen, word: u32) -> PsaoSums {
    let point = psao_point(word);
    let p = point.place;
    let d = PsaoTwo(p.x - seen.place.x, p.y - seen.place.y, p.z - seen.place.z);
    let agree = max(psao_dot_each(seen.normal, point.normal), vec2<f32>(0.0));
    let agree2 = max(agree * agree, vec2<f32>((PSAO_T_N * PSAO_T_N) * point.square));
    let along = psao_dot_two(seen.normal, d);
    let point_along = psao_dot_each(d, point.normal);
    let h2 = max(along * along * point.square, point_along * point_along);
    let squared = psao_dot_two(d, d);
    let to_reach = seen.inverse_radius2 * (-1.0 / PSAO_REACH);
    let in_reach = max(fma(squared, to_reach, vec2<f32>(1.0)), vec2<f32>(PSAO_BEYOND));
    let near = fma(squared, seen.inverse_radius2, vec2<f32>(PSAO_CORE)) * point.square;
    let apart = fma(h2, PSAO_FLATNESS * seen.inverse_radius2, near) * point.square;
    let ratio = agree2 * agree2 / apart;
    let weight = seen.share * point.seen * in_reach * (ratio * ratio);
    return PsaoSums(
        sums.weights + weight,
        fma(weight, vec2<f32>(point.openness), sums.openness),
    );
}

// What psao_blend gives.
fn psao_blend_fast(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> vec2<f32> {
    let grid = psao_grid_fast(instance);
    let fragment = psao_fragment(grid, position, normal);
    if fragment.outside {
        return vec2<f32>(1.0, 0.0);
    }
    // First all cells that may be there, then their points: fragments side by side spend as many
    // rounds as they have cells, and not always eight. Loops end at their end: some GPUs run a body
    // once more only to find that there is nothing to do.
    let base = vec3<u32>(fragment.base);
    let table = psao_table(grid, base);
    var block = psao_block(table, psao_within(grid, base));
    var entry = 0u;
    loop {
        let corner = psao_lowest(block.unsure);
        let offset = psao_corner(corner);
        let key = psao_key(table, offset);
        let found = psao_peek(block.unsure != 0u, psao_bucket(table, offset), key, entry);
        block = psao_with(block, corner, found.cell);
        block.unsure &= select(0xffffffffu, block.unsure - 1u, found.last);
        entry = select(entry + 1u, 0u, found.last);
        if block.unsure == 0u {
            break;
        }
    }
    var left = psao_corners(block);
    let start = fragment.place - PSAO_HALF_STEP;
    let inverse_radius2 = 1.0 / (grid.radius * grid.radius);
    var sums = PsaoSums(vec2<f32>(0.0), vec2<f32>(0.0));
    var round = 0u;
    loop {
        let offset = psao_corner(psao_lowest(left));
        let now = psao_round(psao_cell_at(block, offset), psao_key(table, offset), round);
        let place = start - vec3<f32>(vec3<i32>(offset));
        let seen = PsaoSeen(
            psao_two(fragment.normal, vec3<f32>(0.0)),
            psao_two(place, vec3<f32>(0.0)),
            vec2<f32>(inverse_radius2, 0.0),
            vec2<f32>(psao_share(place), 0.0),
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
    let openness = min(sums.openness.x / sums.weights.x * (1.0 / 255.0), 1.0);
    let near = min(sums.weights.x / (PSAO_NEAR * psao_seen(openness)), 1.0);
    return select(vec2<f32>(1.0, 0.0), vec2<f32>(openness, near), sums.weights.x > 0.0);
}

fn psao_planar_fast(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> f32 {
    return psao_blend_fast(instance, position, normal).x;
}

// ---- For an engine that has baked values. ----

// The stream where it covers the place, a baked value where it does not: its points have not come,
// or it left them out because all is open there.
//     kernel   of the stream's header, 0 paper, 1 planar
//     baked    openness of the fragment, 0 to 1: a vertex attribute's or a texture's
//     share    how much of the stream to show, 0 to 1 (psao_status.stream_share). At 0 the buffers
//              are not read: they need not be filled yet.
fn psao_over_baked(
    kernel: u32,
    instance: u32,
    position: vec3<f32>,
    normal: vec3<f32>,
    baked: f32,
    share: f32,
) -> f32 {
    if share <= 0.0 {
        return baked;
    }
    var found = vec2<f32>(1.0, 0.0);
    if kernel == PSAO_PAPER {
        found = psao_blend(false, instance, position, normal);
    } else {
        found = psao_blend_fast(instance, position, normal);
    }
    return mix(baked, found.x, found.y * min(share, 1.0));
}
