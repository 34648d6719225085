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
const PSAO_FLATNESS: f32 = 11.0;
// `planar`: the squared distance, in radii, from which weights begin to fall.
const PSAO_CORE: f32 = 0.2;
// `planar`: how far before the block switches the cells fade that it will leave, in cells.
const PSAO_FADE: f32 = 0.3;
// `planar`: points less open than this count less, in proportion.
const PSAO_SEEN: f32 = 0.2;
// `planar`: what a point counts at least, however dark.
const PSAO_UNSEEN: f32 = 0.001;
// From this weight on, points that are not dark are near.
const PSAO_NEAR: f32 = 0.5;
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

// The index of the cell at a grid coordinate, 0 if there is none: hash (Eq. 1), then search its
// bucket for the key.
fn psao_find(grid: PsaoGrid, cell: vec3<u32>) -> u32 {
    let key = psao_weigh(grid, cell, 1u, 1u);
    let bucket = grid.bucket_first + psao_weigh(grid, cell, 17u, 31u) % grid.bucket_count;
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
    let apart = PSAO_CORE + (dot(d, d) + PSAO_FLATNESS * (h * h)) / (radius * radius);
    let agree2 = agree * agree;
    let agree4 = agree2 * agree2;
    return agree4 * agree4 / (apart * apart);
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
    return min(openness / PSAO_SEEN, 1.0) + PSAO_UNSEEN;
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

// s · (min(1, 5o) + 0.001) · max(0.1, n·nₚ)⁸ / (0.2 + (d² + 11h²)/r²)² with
// h = max(|n·d|, |nₚ·d|), o the point's openness and s its cell's part; open where no point is.
fn psao_planar(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> f32 {
    return psao_blend(true, instance, position, normal).x;
}

// The paper's Eq. 2 to 4; open where no point counts.
fn psao_paper(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> f32 {
    return psao_blend(false, instance, position, normal).x;
}

// ---- The same as psao_planar, in fewer steps, for buckets with tags. Without them it gives the
// same picture, but not sooner. ----

// The tag of a key in its bucket's entry; never 0. Whoever uploads buckets may put it there: it
// tells a cell that is not there without a look at the cells that are.
fn psao_tag(key: u32) -> u32 {
    return max((key * 0x9e3779b1u) >> 22u, 1u);
}

// hash % count, for a count below 2^23; inverse is 1 / count. Integer division is slow on GPUs.
fn psao_modulo(hash: u32, count: u32, inverse: f32) -> u32 {
    // Floats hold 24 bits: a quotient that is surely not too large, then one for what it left.
    let left = hash - u32(f32(hash) * inverse * 0.999999) * count;
    let rest = left - u32(f32(left) * inverse) * count;
    // One count too few or too many: what is below 0 has wrapped to a large number.
    let raised = select(rest, rest + count, rest >= 0x80000000u);
    return select(raised, raised - count, raised >= count);
}

// A blend that is being made: the sum of the weights, and of the weighted openness in 1/255.
// `place` is the fragment's in the cell, half a step less; `side` the cell's part. What is no point
// adds nothing. Signed integers become floats in one step everywhere, unsigned ones do not.
fn psao_add(
    sums: ptr<function, vec2<f32>>,
    inverse_radius2: f32,
    normal: vec3<f32>,
    place: vec3<f32>,
    side: f32,
    point: u32,
) {
    let steps = vec3<i32>(vec3<u32>(point) & vec3<u32>(0x1f0000u, 0x3e00000u, 0x7c000000u));
    let scale = vec3<f32>(0.03125 / 65536.0, 0.03125 / 2097152.0, 0.03125 / 67108864.0);
    let d = vec3<f32>(steps) * scale - place;
    let codes = vec2<i32>(vec2<u32>(point >> 8u, point >> 12u) & vec2<u32>(15u));
    let uv = vec2<f32>(min(codes, vec2<i32>(14))) - 7.0;
    let z = 7.0 - abs(uv.x) - abs(uv.y);
    let fold = max(-z, 0.0);
    // The point's normal, of any length: what is squared below is divided by its square.
    let m = vec3<f32>(uv - select(vec2<f32>(fold), vec2<f32>(-fold), uv < vec2<f32>(0.0)), z);
    let inverse = 1.0 / dot(m, m);
    let agree = max(dot(m, normal), 0.0);
    let agree2 = max(agree * agree * inverse, PSAO_T_N * PSAO_T_N);
    let along = dot(normal, d);
    let point_along = dot(m, d);
    let h2 = max(along * along, point_along * point_along * inverse);
    let apart = PSAO_CORE + (dot(d, d) + PSAO_FLATNESS * h2) * inverse_radius2;
    let openness = f32(i32(point & 255u));
    let seen = min(openness * (1.0 / (255.0 * PSAO_SEEN)), 1.0) + PSAO_UNSEEN;
    let agree4 = agree2 * agree2;
    let weight = side * seen * agree4 * agree4 / (apart * apart);
    *sums += select(0.0, weight, point >= 0x80000000u) * vec2<f32>(1.0, openness);
}

// What one corner of a block may be.
struct PsaoCandidate {
    // The cell that it is if it is there; 0 if it is not there for sure.
    cell: u32,
    // There are several such cells: they have the same tag, or none.
    unsure: bool,
}

// The one among four entries of a bucket that a tag allows.
fn psao_pick(entries: vec4<u32>, tag: u32) -> PsaoCandidate {
    let tags = entries >> vec4<u32>(22u);
    let may = (tags == vec4<u32>(tag)) | (tags == vec4<u32>(0u));
    // Not select: GLSL ES has none for integer vectors.
    let cells = entries & vec4<u32>(PSAO_ENTRY_CELL) & (vec4<u32>(0u) - vec4<u32>(may));
    // Their sum is one of them if the others are 0.
    let sum = cells.x + cells.y + cells.z + cells.w;
    return PsaoCandidate(sum, sum != max(max(cells.x, cells.y), max(cells.z, cells.w)));
}

fn psao_candidate(grid: PsaoGrid, inverse_count: f32, cell: vec3<u32>) -> PsaoCandidate {
    if any(cell >= grid.dims) {
        return PsaoCandidate(0u, false);
    }
    let tag = psao_tag(psao_weigh(grid, cell, 1u, 1u));
    let hash = psao_weigh(grid, cell, 17u, 31u);
    let bucket = grid.bucket_first + psao_modulo(hash, grid.bucket_count, inverse_count);
    let entries = psao_load_bucket(bucket * 2u);
    let first = psao_pick(entries, tag);
    if entries.w == 0u {
        return first;
    }
    let other = psao_pick(psao_load_bucket(bucket * 2u + 1u), tag);
    let both = first.cell != 0u && other.cell != 0u;
    return PsaoCandidate(first.cell + other.cell, first.unsure || other.unsure || both);
}

// What psao_blend gives.
fn psao_blend_fast(instance: u32, position: vec3<f32>, normal: vec3<f32>) -> vec2<f32> {
    let grid = psao_grid(instance);
    let fragment = psao_fragment(grid, position, normal);
    if fragment.outside {
        return vec2<f32>(1.0, 0.0);
    }
    // First all cells that may be there, then their points: fragments side by side spend as many
    // rounds as they have cells, and not always eight.
    let inverse_count = 1.0 / f32(grid.bucket_count);
    let base = vec3<u32>(fragment.base);
    let may_be_a = psao_candidate(grid, inverse_count, base);
    let may_be_b = psao_candidate(grid, inverse_count, base + vec3<u32>(1u, 0u, 0u));
    let may_be_c = psao_candidate(grid, inverse_count, base + vec3<u32>(0u, 1u, 0u));
    let may_be_d = psao_candidate(grid, inverse_count, base + vec3<u32>(1u, 1u, 0u));
    let may_be_e = psao_candidate(grid, inverse_count, base + vec3<u32>(0u, 0u, 1u));
    let may_be_f = psao_candidate(grid, inverse_count, base + vec3<u32>(1u, 0u, 1u));
    let may_be_g = psao_candidate(grid, inverse_count, base + vec3<u32>(0u, 1u, 1u));
    let may_be_h = psao_candidate(grid, inverse_count, base + vec3<u32>(1u, 1u, 1u));
    if may_be_a.unsure || may_be_b.unsure || may_be_c.unsure || may_be_d.unsure
        || may_be_e.unsure || may_be_f.unsure || may_be_g.unsure || may_be_h.unsure {
        return psao_blend(true, instance, position, normal);
    }
    var left = select(0u, 1u, may_be_a.cell != 0u) | select(0u, 2u, may_be_b.cell != 0u)
        | select(0u, 4u, may_be_c.cell != 0u) | select(0u, 8u, may_be_d.cell != 0u)
        | select(0u, 16u, may_be_e.cell != 0u) | select(0u, 32u, may_be_f.cell != 0u)
        | select(0u, 64u, may_be_g.cell != 0u) | select(0u, 128u, may_be_h.cell != 0u);
    let inverse_radius2 = 1.0 / (grid.radius * grid.radius);
    var sums = vec2<f32>(0.0);
    // A round takes half a cell, without branches: the first three points, then the other four.
    var second = false;
    while left != 0u {
        // Which bit is the lowest: the exponent of that bit as a float. GLSL ES 3.00 cannot say.
        let corner = (bitcast<u32>(f32(i32(left & (0u - left)))) >> 23u) - 127u;
        let offset = vec3<u32>(corner, corner >> 1u, corner >> 2u) & vec3<u32>(1u);
        let right = offset.x != 0u;
        let back = offset.y != 0u;
        let lower = select(
            select(may_be_a.cell, may_be_b.cell, right),
            select(may_be_c.cell, may_be_d.cell, right),
            back,
        );
        let upper = select(
            select(may_be_e.cell, may_be_f.cell, right),
            select(may_be_g.cell, may_be_h.cell, right),
            back,
        );
        let found = select(lower, upper, offset.z != 0u);
        var words = psao_load_cell(found * 2u + select(0u, 1u, second));
        if !second && words.x != psao_weigh(grid, base + offset, 1u, 1u) {
            // Another cell of the same tag: this one is not there.
            words = vec4<u32>(0u);
        }
        // A cell ends at its first empty word.
        let a = select(0u, words.x, second);
        let b = select(words.y, 0u, second && a == 0u);
        let c = select(0u, words.z, b != 0u);
        let d = select(0u, words.w, c != 0u);
        let side = psao_side(fragment.place, offset);
        let place = fragment.place - 0.015625 - vec3<f32>(vec3<i32>(offset));
        if second {
            psao_add(&sums, inverse_radius2, fragment.normal, place, side, a);
        }
        psao_add(&sums, inverse_radius2, fragment.normal, place, side, b);
        psao_add(&sums, inverse_radius2, fragment.normal, place, side, c);
        psao_add(&sums, inverse_radius2, fragment.normal, place, side, d);
        second = !second && d != 0u;
        left = select(left & (left - 1u), left, second);
    }
    let openness = min(sums.y / sums.x * (1.0 / 255.0), 1.0);
    let near = min(sums.x / (PSAO_NEAR * psao_seen(openness)), 1.0);
    return select(vec2<f32>(1.0, 0.0), vec2<f32>(openness, near), sums.x > 0.0);
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
