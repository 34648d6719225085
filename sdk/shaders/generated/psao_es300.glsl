// PSAO: the lookup, to paste into a shader. Blends the points around a fragment into its openness:
// 1 is open, 0 fully occluded. Multiply ambient light with it.
// Generated from sdk/shaders/psao.wgsl by psao-gen: do not edit. Its comments say how it works.
//
// Call one of these, from any stage. The stream's header says which kernel its points are for.
//     float psao_planar_fast(uint instance, vec3 position, vec3 normal)   planar, the quicker way
//     float psao_planar(uint instance, vec3 position, vec3 normal)        planar, written plainly
//     float psao_paper(uint instance, vec3 position, vec3 normal)
//     float psao_over_baked(uint kernel, uint instance, vec3 position, vec3 normal, float baked,
//         float share)    the stream where it covers the place, a baked value where it does not
// The first is quicker only if the buckets have tags: docs/gpu.md says how to put them there.
// instance: index into the instance buffer, below its capacity.
// position: in the instance's local space (rest space where it is skinned or morphed). It must come
//     from the vertices' own positions, as a varying. Never subtract it from a world position: f32
//     does not hold both far from the origin.
// normal: in the same space, of any length, on the side of the surface that is seen.
// Position and normal have to be finite, and of full precision (highp).
//
// GLSL ES 3.00. Reads textures of format GL_RGBA32UI, 2048 texels wide, filters GL_NEAREST, one
// level: bind the client's instances, buckets and cells to the samplers below. Each holds its
// buffer's bytes, 16 a texel, row after row; the last row is padded. Upload what changed with
// glTexSubImage2D (GL_RGBA_INTEGER, GL_UNSIGNED_INT): an instance is 4 texels, a bucket or a cell
// 2. A texture that has to be taller than GL_MAX_TEXTURE_SIZE is too much for this device.

precision highp float;
precision highp int;

struct PsaoGrid {
    vec3 origin;
    float radius;
    vec3 cells_per_unit;
    uint bucket_first;
    uvec3 dims;
    uint bucket_count;
    vec3 normal_scale;
};
struct PsaoFragment {
    ivec3 base;
    vec3 place;
    vec3 normal;
    bool outside;
};
struct PsaoTable {
    uint key;
    uint hash;
    uint row;
    uint layer;
    uint bucket_first;
    uint bucket_count;
    float inverse_count;
};
struct PsaoCandidate {
    uint cell;
    uint unsure;
};
struct PsaoPair {
    uvec2 cells;
    uint unsure;
};
struct PsaoBlock {
    uvec4 lower;
    uvec4 upper;
    uint unsure;
};
struct PsaoPeek {
    uint cell;
    bool last;
};
struct PsaoRound {
    uvec3 points;
    bool more;
};
struct PsaoPoint {
    vec3 place;
    vec3 normal;
    float square;
    float openness;
    float seen;
};
struct PsaoTwo {
    vec2 x;
    vec2 y;
    vec2 z;
};
struct PsaoSums {
    vec2 weights;
    vec2 openness;
};
struct PsaoSeen {
    PsaoTwo normal;
    PsaoTwo place;
    vec2 inverse_radius2_;
    vec2 share;
};
const float PSAO_T_N = 0.1;
const float PSAO_T_D = 0.7;
const float PSAO_FLATNESS = 30.0;
const float PSAO_CORE = 0.5;
const float PSAO_REACH = 1.2;
const float PSAO_BEYOND = 0.001;
const float PSAO_FADE = 0.3;
const float PSAO_SEEN = 0.2;
const float PSAO_UNSEEN = 0.0001;
const float PSAO_NEAR = 0.05;
const uint PSAO_PAPER = 0u;
const uint PSAO_ENTRY_CELL = 4194303u;
const float PSAO_HALF_STEP = 0.015625;

uniform highp usampler2D psao_instances;

uniform highp usampler2D psao_buckets;

uniform highp usampler2D psao_cells;

ivec2 psao_texel(uint index) {
    return ivec2(uvec2((index & 2047u), (index >> 11u)));
}

uvec4 psao_load_instance(uint index_1) {
    ivec2 _e2 = psao_texel(index_1);
    uvec4 _e4 = texelFetch(psao_instances, _e2, 0);
    return _e4;
}

uvec4 psao_load_bucket(uint index_2) {
    ivec2 _e2 = psao_texel(index_2);
    uvec4 _e4 = texelFetch(psao_buckets, _e2, 0);
    return _e4;
}

uvec4 psao_load_cell(uint index_3) {
    ivec2 _e2 = psao_texel(index_3);
    uvec4 _e4 = texelFetch(psao_cells, _e2, 0);
    return _e4;
}

PsaoGrid psao_grid(uint instance_1) {
    uvec4 _e3 = psao_load_instance((instance_1 * 4u));
    uvec4 _e8 = psao_load_instance(((instance_1 * 4u) + 1u));
    uvec4 _e13 = psao_load_instance(((instance_1 * 4u) + 2u));
    uvec4 _e18 = psao_load_instance(((instance_1 * 4u) + 3u));
    return PsaoGrid(uintBitsToFloat(_e3.xyz), uintBitsToFloat(_e3.w), uintBitsToFloat(_e8.xyz), _e8.w, _e13.xyz, _e13.w, uintBitsToFloat(_e18.xyz));
}

PsaoFragment psao_fragment(PsaoGrid grid, vec3 position_1, vec3 normal_1) {
    bool local = false;
    bool local_1 = false;
    vec3 g = ((position_1 - grid.origin) * grid.cells_per_unit);
    if (all(greaterThanEqual(g, vec3(-0.5)))) {
        local = all(lessThan(g, (vec3(grid.dims) + vec3(0.5))));
    } else {
        local = false;
    }
    bool inside = local;
    vec3 lower = floor((clamp(g, vec3(-0.5), (vec3(grid.dims) + vec3(0.5))) - vec3(0.5)));
    float largest = max(max(abs(normal_1.x), abs(normal_1.y)), abs(normal_1.z));
    vec3 n = ((normal_1 / vec3(max(largest, 1e-37))) * grid.normal_scale);
    float squared = dot(n, n);
    if (!((grid.bucket_count == 0u))) {
        local_1 = !(inside);
    } else {
        local_1 = true;
    }
    bool _e65 = local_1;
    return PsaoFragment(ivec3(lower), (g - lower), (n * ((squared > 0.0) ? inversesqrt(squared) : 0.0)), _e65);
}

uint psao_weigh(PsaoGrid grid_1, uvec3 cell, uint weight_y, uint weight_z) {
    return ((cell.x + ((cell.y * grid_1.dims.x) * weight_y)) + ((cell.z * (grid_1.dims.x * grid_1.dims.y)) * weight_z));
}

uint psao_search(uint bucket, uint key) {
    uint i = 0u;
    bool loop_init = true;
    while(true) {
        if (!loop_init) {
            uint _e27 = i;
            i = (_e27 + 1u);
        }
        loop_init = false;
        uint _e4 = i;
        if ((_e4 < 8u)) {
        } else {
            break;
        }
        {
            uint _e9 = i;
            uvec4 _e13 = psao_load_bucket(((bucket * 2u) + (_e9 >> 2u)));
            uint _e14 = i;
            uint entry_2 = (_e13[(_e14 & 3u)] & PSAO_ENTRY_CELL);
            if ((entry_2 == 0u)) {
                break;
            }
            uvec4 _e24 = psao_load_cell((entry_2 * 2u));
            if ((_e24.x == key)) {
                return entry_2;
            }
        }
    }
    return 0u;
}

uint psao_find(PsaoGrid grid_2, uvec3 cell_1) {
    uint _e5 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket_3 = (grid_2.bucket_first + (_e5 % grid_2.bucket_count));
    uint _e11 = psao_weigh(grid_2, cell_1, 1u, 1u);
    uint _e12 = psao_search(bucket_3, _e11);
    return _e12;
}

vec3 psao_point_place(uint point) {
    uvec3 steps = (uvec3((point >> 16u), (point >> 21u), (point >> 26u)) & uvec3(31u));
    return ((vec3(steps) + vec3(0.5)) * 0.03125);
}

vec3 psao_point_normal(uint point_1) {
    uvec2 codes = (uvec2((point_1 >> 8u), (point_1 >> 12u)) & uvec2(15u));
    vec2 uv = ((vec2(min(codes, uvec2(14u))) - vec2(7.0)) / vec2(7.0));
    float z = ((1.0 - abs(uv.x)) - abs(uv.y));
    vec2 folded = ((vec2(1.0) - abs(uv.yx)) * mix(vec2(1.0), vec2(-1.0), lessThan(uv, vec2(0.0))));
    return normalize(vec3(((z >= 0.0) ? uv : folded), z));
}

float psao_point_openness(uint point_2) {
    return (float((point_2 & 255u)) * 0.003921569);
}

float psao_paper_weight(float radius, vec3 normal_2, vec3 d, vec3 point_normal) {
    bool local_2 = false;
    bool local_3 = false;
    float squared_1 = dot(d, d);
    float along = dot(point_normal, d);
    if (!((dot(point_normal, normal_2) <= PSAO_T_N))) {
        if (((along * along) >= (PSAO_T_D * squared_1))) {
            local_3 = (squared_1 > 0.0);
        } else {
            local_3 = false;
        }
        bool _e21 = local_3;
        local_2 = _e21;
    } else {
        local_2 = true;
    }
    bool _e23 = local_2;
    if (_e23) {
        return 0.0;
    }
    return max(((radius - sqrt(squared_1)) / radius), 0.0);
}

float psao_planar_weight(float radius_1, vec3 normal_3, vec3 d_1, vec3 point_normal_1) {
    float agree = max(dot(point_normal_1, normal_3), PSAO_T_N);
    float h = max(abs(dot(normal_3, d_1)), abs(dot(point_normal_1, d_1)));
    float squared_2 = dot(d_1, d_1);
    float apart = (PSAO_CORE + ((squared_2 + (PSAO_FLATNESS * (h * h))) / (radius_1 * radius_1)));
    float in_reach = max((1.0 - (squared_2 / ((PSAO_REACH * radius_1) * radius_1))), PSAO_BEYOND);
    float agree2_ = (agree * agree);
    float agree4_ = (agree2_ * agree2_);
    return (((in_reach * agree4_) * agree4_) / (apart * apart));
}

float psao_side(vec3 place, uvec3 offset) {
    vec3 left_1 = mix((vec3(1.5) - place), (place - vec3(0.5)), notEqual(offset, uvec3(0u)));
    vec3 sides = clamp((left_1 / vec3(0.3)), vec3(0.0), vec3(1.0));
    return ((sides.x * sides.y) * sides.z);
}

float psao_seen(float openness) {
    float lit = min((openness / PSAO_SEEN), 1.0);
    return ((lit * lit) + PSAO_UNSEEN);
}

vec2 psao_blend(bool planar, uint instance_2, vec3 position_2, vec3 normal_4) {
    float weights = 0.0;
    float sum = 0.0;
    uint corner = 0u;
    uint i_1 = 0u;
    float weight = 0.0;
    PsaoGrid _e4 = psao_grid(instance_2);
    PsaoFragment _e5 = psao_fragment(_e4, position_2, normal_4);
    if (_e5.outside) {
        return vec2(1.0, 0.0);
    }
    bool loop_init_1 = true;
    while(true) {
        if (!loop_init_1) {
            uint _e89 = corner;
            corner = (_e89 + 1u);
        }
        loop_init_1 = false;
        uint _e16 = corner;
        if ((_e16 < 8u)) {
        } else {
            break;
        }
        {
            uint _e19 = corner;
            uint _e20 = corner;
            uint _e23 = corner;
            uvec3 offset_4 = (uvec3(_e19, (_e20 >> 1u), (_e23 >> 2u)) & uvec3(1u));
            uvec3 cell_4 = (uvec3(_e5.base) + offset_4);
            if (any(greaterThanEqual(cell_4, _e4.dims))) {
                continue;
            }
            uint _e36 = psao_find(_e4, cell_4);
            if ((_e36 == 0u)) {
                continue;
            }
            vec3 corner_from = (vec3(offset_4) - _e5.place);
            float _e43 = psao_side(_e5.place, offset_4);
            i_1 = 1u;
            bool loop_init_2 = true;
            while(true) {
                if (!loop_init_2) {
                    uint _e86 = i_1;
                    i_1 = (_e86 + 1u);
                }
                loop_init_2 = false;
                uint _e46 = i_1;
                if ((_e46 < 8u)) {
                } else {
                    break;
                }
                {
                    uint _e51 = i_1;
                    uvec4 _e55 = psao_load_cell(((_e36 * 2u) + (_e51 >> 2u)));
                    uint _e56 = i_1;
                    uint point_4 = _e55[(_e56 & 3u)];
                    if ((point_4 == 0u)) {
                        break;
                    }
                    if ((point_4 < 2147483648u)) {
                        continue;
                    }
                    vec3 _e64 = psao_point_place(point_4);
                    vec3 d_2 = (corner_from + _e64);
                    vec3 _e66 = psao_point_normal(point_4);
                    float _e67 = psao_point_openness(point_4);
                    weight = 0.0;
                    if (planar) {
                        float _e70 = psao_seen(_e67);
                        float _e74 = psao_planar_weight(_e4.radius, _e5.normal, d_2, _e66);
                        weight = ((_e43 * _e70) * _e74);
                    } else {
                        float _e78 = psao_paper_weight(_e4.radius, _e5.normal, d_2, _e66);
                        weight = _e78;
                    }
                    float _e79 = weights;
                    float _e80 = weight;
                    weights = (_e79 + _e80);
                    float _e82 = sum;
                    float _e83 = weight;
                    sum = (_e82 + (_e83 * _e67));
                }
            }
        }
    }
    float _e92 = weights;
    if ((_e92 > 0.0)) {
        float _e95 = sum;
        float _e96 = weights;
        float openness_1 = min((_e95 / _e96), 1.0);
        float _e100 = psao_seen(openness_1);
        float seen_1 = (planar ? _e100 : 1.0);
        float _e103 = weights;
        return vec2(openness_1, min((_e103 / (PSAO_NEAR * seen_1)), 1.0));
    }
    return vec2(1.0, 0.0);
}

float psao_planar(uint instance_3, vec3 position_3, vec3 normal_5) {
    vec2 _e4 = psao_blend(true, instance_3, position_3, normal_5);
    return _e4.x;
}

float psao_paper(uint instance_4, vec3 position_4, vec3 normal_6) {
    vec2 _e4 = psao_blend(false, instance_4, position_4, normal_6);
    return _e4.x;
}

uint psao_tag(uint key_1) {
    return max(((key_1 * 2654435761u) & 4290772992u), 4194304u);
}

uint psao_modulo(uint hash, uint count, float inverse_) {
    int left_2 = int((hash - (uint(int((float(int((hash >> 1u))) * (inverse_ * 1.999998)))) * count)));
    int divisor = int(count);
    int rest = (left_2 - (int((float(left_2) * inverse_)) * divisor));
    int raised = ((rest < 0) ? (rest + divisor) : rest);
    int whole = ((raised >= divisor) ? (raised - divisor) : raised);
    return ((count == 1u) ? 0u : uint(whole));
}

uint psao_lowest(uint bits) {
    return ((floatBitsToUint(float(int((bits & (0u - bits))))) >> 23u) - 127u);
}

uvec3 psao_corner(uint corner_1) {
    return (uvec3(corner_1, (corner_1 >> 1u), (corner_1 >> 2u)) & uvec3(1u));
}

PsaoGrid psao_grid_fast(uint instance_5) {
    PsaoGrid grid_3 = PsaoGrid(vec3(0.0), 0.0, vec3(0.0), 0u, uvec3(0u), 0u, vec3(0.0));
    PsaoGrid _e1 = psao_grid(instance_5);
    grid_3 = _e1;
    float _e6 = grid_3.cells_per_unit.x;
    vec3 _e8 = grid_3.cells_per_unit;
    grid_3.normal_scale = (vec3(_e6) / _e8);
    PsaoGrid _e11 = grid_3;
    return _e11;
}

PsaoTable psao_table(PsaoGrid grid_4, uvec3 base) {
    uint row_1 = grid_4.dims.x;
    uint layer = (grid_4.dims.x * grid_4.dims.y);
    return PsaoTable(((base.x + (base.y * row_1)) + (base.z * layer)), ((base.x + ((base.y * row_1) * 17u)) + ((base.z * layer) * 31u)), row_1, layer, grid_4.bucket_first, grid_4.bucket_count, (1.0 / float(grid_4.bucket_count)));
}

uint psao_key(PsaoTable table, uvec3 offset_1) {
    return (((table.key + offset_1.x) + ((offset_1.y != 0u) ? table.row : 0u)) + ((offset_1.z != 0u) ? table.layer : 0u));
}

uint psao_bucket(PsaoTable table_1, uvec3 offset_2) {
    uint hash_1 = (((table_1.hash + offset_2.x) + ((offset_2.y != 0u) ? (table_1.row * 17u) : 0u)) + ((offset_2.z != 0u) ? (table_1.layer * 31u) : 0u));
    uint _e26 = psao_modulo(hash_1, table_1.bucket_count, table_1.inverse_count);
    return (table_1.bucket_first + _e26);
}

uint psao_pick(uvec4 entries, uint tag) {
    uvec4 rest_1 = (entries ^ uvec4(tag));
    return min(min(rest_1.x, rest_1.y), min(rest_1.z, rest_1.w));
}

PsaoCandidate psao_candidate(bool there, uint key_2, uint bucket_1) {
    if (!(there)) {
        return PsaoCandidate(0u, 0u);
    }
    uvec4 _e9 = psao_load_bucket((bucket_1 * 2u));
    uint _e10 = psao_tag(key_2);
    uint _e11 = psao_pick(_e9, _e10);
    bool here = (_e11 <= PSAO_ENTRY_CELL);
    bool unsure = ((_e9.x - 1u) < PSAO_ENTRY_CELL);
    return PsaoCandidate((here ? _e11 : 0u), (unsure ? 1u : 0u));
}

PsaoPair psao_pair(PsaoTable table_2, bvec2 there_1, uvec2 row) {
    uvec3 offset_5 = uvec3(0u, row);
    uint _e5 = psao_bucket(table_2, offset_5);
    bool last = ((_e5 + 1u) == (table_2.bucket_first + table_2.bucket_count));
    uint next = (last ? table_2.bucket_first : (_e5 + 1u));
    uint _e16 = psao_key(table_2, offset_5);
    PsaoCandidate _e18 = psao_candidate(there_1.x, _e16, _e5);
    PsaoCandidate _e22 = psao_candidate(there_1.y, (_e16 + 1u), next);
    return PsaoPair(uvec2(_e18.cell, _e22.cell), (_e18.unsure | (_e22.unsure << 1u)));
}

uint psao_within(PsaoGrid grid_5, uvec3 base_1) {
    uvec3 low = (uvec3(lessThan(base_1, grid_5.dims)) * uvec3(85u, 51u, 15u));
    uvec3 high = (uvec3(lessThan((base_1 + uvec3(1u)), grid_5.dims)) * uvec3(170u, 204u, 240u));
    uvec3 axes = (low | high);
    return ((axes.x & axes.y) & axes.z);
}

PsaoBlock psao_block(PsaoTable table_3, uint corners) {
    bvec4 low_1 = notEqual((uvec4(corners) & uvec4(1u, 2u, 4u, 8u)), uvec4(0u));
    bvec4 high_1 = notEqual((uvec4(corners) & uvec4(16u, 32u, 64u, 128u)), uvec4(0u));
    PsaoPair _e26 = psao_pair(table_3, low_1.xy, uvec2(0u, 0u));
    PsaoPair _e31 = psao_pair(table_3, low_1.zw, uvec2(1u, 0u));
    PsaoPair _e36 = psao_pair(table_3, high_1.xy, uvec2(0u, 1u));
    PsaoPair _e41 = psao_pair(table_3, high_1.zw, uvec2(1u, 1u));
    return PsaoBlock(uvec4(_e26.cells, _e31.cells), uvec4(_e36.cells, _e41.cells), (((_e26.unsure | (_e31.unsure << 2u)) | (_e36.unsure << 4u)) | (_e41.unsure << 6u)));
}

PsaoBlock psao_with(PsaoBlock block, uint corner_2, uint cell_2) {
    bvec4 here_1 = equal(uvec4(0u, 1u, 2u, 3u), uvec4((corner_2 & 3u)));
    uvec4 cells = (uvec4(here_1) * cell_2);
    uvec4 high_2 = uvec4(((corner_2 >= 4u) ? 4294967295u : 0u));
    return PsaoBlock((block.lower | (cells & ~(high_2))), (block.upper | (cells & high_2)), block.unsure);
}

uint psao_corners(PsaoBlock block_1) {
    uvec4 bits_1 = ((uvec4(notEqual(block_1.lower, uvec4(0u))) * uvec4(1u, 2u, 4u, 8u)) + (uvec4(notEqual(block_1.upper, uvec4(0u))) * uvec4(16u, 32u, 64u, 128u)));
    return (((bits_1.x + bits_1.y) + bits_1.z) + bits_1.w);
}

uint psao_cell_at(PsaoBlock block_2, uvec3 offset_3) {
    bool back = (offset_3.y != 0u);
    uint lower_1 = ((offset_3.x != 0u) ? (back ? block_2.lower.w : block_2.lower.y) : (back ? block_2.lower.z : block_2.lower.x));
    uint upper = ((offset_3.x != 0u) ? (back ? block_2.upper.w : block_2.upper.y) : (back ? block_2.upper.z : block_2.upper.x));
    return ((offset_3.z != 0u) ? upper : lower_1);
}

PsaoPeek psao_peek(bool wanted, uint bucket_2, uint key_3, uint entry) {
    bool local_4 = false;
    bool local_5 = false;
    bool local_6 = false;
    if (!(wanted)) {
        return PsaoPeek(0u, true);
    }
    uvec4 _e13 = psao_load_bucket(((bucket_2 * 2u) + (entry >> 2u)));
    uint cell_5 = (_e13[(entry & 3u)] & PSAO_ENTRY_CELL);
    if ((cell_5 != 0u)) {
        uvec4 _e25 = psao_load_cell((cell_5 * 2u));
        local_4 = (_e25.x == key_3);
    } else {
        local_4 = false;
    }
    bool here_2 = local_4;
    if (!(here_2)) {
        local_5 = (cell_5 == 0u);
    } else {
        local_5 = true;
    }
    bool _e38 = local_5;
    if (!(_e38)) {
        local_6 = (entry == 7u);
    } else {
        local_6 = true;
    }
    bool _e45 = local_6;
    return PsaoPeek((here_2 ? cell_5 : 0u), _e45);
}

PsaoRound psao_round(uint cell_3, uint key_4, uint round_) {
    bool local_7 = false;
    uvec4 _e8 = psao_load_cell(((cell_3 * 2u) + min(round_, 1u)));
    uint first = ((round_ == 0u) ? ((_e8.x == key_4) ? _e8.y : 0u) : _e8.x);
    uint a_3 = ((round_ == 2u) ? _e8.w : first);
    if (!((a_3 == 0u))) {
        local_7 = (round_ == 2u);
    } else {
        local_7 = true;
    }
    bool _e36 = local_7;
    uint b_3 = (_e36 ? 0u : ((round_ == 0u) ? _e8.z : _e8.y));
    uint c = ((b_3 == 0u) ? 0u : ((round_ == 0u) ? _e8.w : _e8.z));
    return PsaoRound(uvec3(a_3, b_3, c), (c != 0u));
}

float psao_share(vec3 place_1) {
    vec3 inside_1 = (vec3(1.0) - abs((place_1 - vec3(0.484375))));
    vec3 sides_1 = clamp((inside_1 * 3.3333333), vec3(0.0), vec3(1.0));
    return ((sides_1.x * sides_1.y) * sides_1.z);
}

PsaoPoint psao_point(uint point_3) {
    ivec3 steps_1 = ivec3((uvec3(point_3) & uvec3(2031616u, 65011712u, 2080374784u)));
    vec3 scale = vec3(4.7683716e-7, 1.4901161e-8, 4.656613e-10);
    ivec2 codes_1 = ivec2((uvec2((point_3 >> 8u), (point_3 >> 12u)) & uvec2(15u)));
    vec2 uv_1 = (vec2(min(codes_1, ivec2(14))) - vec2(7.0));
    float z_1 = ((7.0 - abs(uv_1.x)) - abs(uv_1.y));
    float fold = max(-(z_1), 0.0);
    vec3 m = vec3((uv_1 - mix(vec2(fold), vec2(-(fold)), lessThan(uv_1, vec2(0.0)))), z_1);
    float openness_2 = float(int((point_3 & 255u)));
    float lit_1 = min((openness_2 * 0.019607844), 1.0);
    float seen_2 = (lit_1 * lit_1 + PSAO_UNSEEN);
    return PsaoPoint((vec3(steps_1) * scale), m, (m.x * m.x + (m.y * m.y + (m.z * m.z))), openness_2, ((int(point_3) >= 0) ? 0.0 : seen_2));
}

PsaoTwo psao_two(vec3 a, vec3 b) {
    return PsaoTwo(vec2(a.x, b.x), vec2(a.y, b.y), vec2(a.z, b.z));
}

vec2 psao_dot_two(PsaoTwo a_1, PsaoTwo b_1) {
    return (a_1.x * b_1.x + (a_1.y * b_1.y + (a_1.z * b_1.z)));
}

vec2 psao_dot_each(PsaoTwo a_2, vec3 b_2) {
    return (a_2.x * vec2(b_2.x) + (a_2.y * vec2(b_2.y) + (a_2.z * b_2.z)));
}

PsaoSums psao_add(PsaoSums sums, PsaoSeen seen, uint word) {
    PsaoPoint _e3 = psao_point(word);
    vec3 p = _e3.place;
    PsaoTwo d_3 = PsaoTwo((vec2(p.x) - seen.place.x), (vec2(p.y) - seen.place.y), (vec2(p.z) - seen.place.z));
    vec2 _e23 = psao_dot_each(seen.normal, _e3.normal);
    vec2 agree_1 = max(_e23, vec2(0.0));
    vec2 agree2_1 = max((agree_1 * agree_1), vec2((0.010000001 * _e3.square)));
    vec2 _e34 = psao_dot_two(seen.normal, d_3);
    vec2 _e36 = psao_dot_each(d_3, _e3.normal);
    vec2 h2_ = max(((_e34 * _e34) * _e3.square), (_e36 * _e36));
    vec2 _e42 = psao_dot_two(d_3, d_3);
    vec2 to_reach = (seen.inverse_radius2_ * -0.8333333);
    vec2 in_reach_1 = max((_e42 * to_reach + vec2(1.0)), vec2(0.001));
    vec2 near = ((_e42 * seen.inverse_radius2_ + vec2(0.5)) * _e3.square);
    vec2 apart_1 = ((h2_ * (PSAO_FLATNESS * seen.inverse_radius2_) + near) * _e3.square);
    vec2 ratio = ((agree2_1 * agree2_1) / apart_1);
    vec2 weight_1 = (((seen.share * _e3.seen) * in_reach_1) * (ratio * ratio));
    return PsaoSums((sums.weights + weight_1), (weight_1 * vec2(_e3.openness) + sums.openness));
}

vec2 psao_blend_fast(uint instance_6, vec3 position_5, vec3 normal_7) {
    PsaoBlock block_3 = PsaoBlock(uvec4(0u), uvec4(0u), 0u);
    uint entry_1 = 0u;
    uint left = 0u;
    PsaoSums sums_1 = PsaoSums(vec2(0.0), vec2(0.0));
    uint round_1 = 0u;
    PsaoGrid _e3 = psao_grid_fast(instance_6);
    PsaoFragment _e4 = psao_fragment(_e3, position_5, normal_7);
    if (_e4.outside) {
        return vec2(1.0, 0.0);
    }
    uvec3 base_2 = uvec3(_e4.base);
    PsaoTable _e11 = psao_table(_e3, base_2);
    uint _e12 = psao_within(_e3, base_2);
    PsaoBlock _e13 = psao_block(_e11, _e12);
    block_3 = _e13;
    while(true) {
        uint _e18 = block_3.unsure;
        uint _e19 = psao_lowest(_e18);
        uvec3 _e20 = psao_corner(_e19);
        uint _e21 = psao_key(_e11, _e20);
        uint _e23 = block_3.unsure;
        uint _e26 = psao_bucket(_e11, _e20);
        uint _e27 = entry_1;
        PsaoPeek _e28 = psao_peek((_e23 != 0u), _e26, _e21, _e27);
        PsaoBlock _e29 = block_3;
        PsaoBlock _e31 = psao_with(_e29, _e19, _e28.cell);
        block_3 = _e31;
        uint _e33 = block_3.unsure;
        uint _e36 = block_3.unsure;
        block_3.unsure = (_e33 & (_e28.last ? (_e36 - 1u) : 4294967295u));
        uint _e42 = entry_1;
        entry_1 = (_e28.last ? 0u : (_e42 + 1u));
        uint _e49 = block_3.unsure;
        if ((_e49 == 0u)) {
            break;
        }
    }
    PsaoBlock _e52 = block_3;
    uint _e53 = psao_corners(_e52);
    left = _e53;
    vec3 start = (_e4.place - vec3(0.015625));
    float inverse_radius2_ = (1.0 / (_e3.radius * _e3.radius));
    while(true) {
        uint _e72 = left;
        uint _e73 = psao_lowest(_e72);
        uvec3 _e74 = psao_corner(_e73);
        PsaoBlock _e75 = block_3;
        uint _e76 = psao_cell_at(_e75, _e74);
        uint _e77 = psao_key(_e11, _e74);
        uint _e78 = round_1;
        PsaoRound _e79 = psao_round(_e76, _e77, _e78);
        vec3 place_2 = (start - vec3(ivec3(_e74)));
        PsaoTwo _e86 = psao_two(_e4.normal, vec3(0.0));
        PsaoTwo _e89 = psao_two(place_2, vec3(0.0));
        float _e92 = psao_share(place_2);
        PsaoSeen seen_3 = PsaoSeen(_e86, _e89, vec2(inverse_radius2_, 0.0), vec2(_e92, 0.0));
        PsaoSums _e96 = sums_1;
        PsaoSums _e99 = psao_add(_e96, seen_3, _e79.points.x);
        sums_1 = _e99;
        PsaoSums _e100 = sums_1;
        PsaoSums _e103 = psao_add(_e100, seen_3, _e79.points.y);
        sums_1 = _e103;
        PsaoSums _e104 = sums_1;
        PsaoSums _e107 = psao_add(_e104, seen_3, _e79.points.z);
        sums_1 = _e107;
        uint _e109 = round_1;
        round_1 = (_e79.more ? (_e109 + 1u) : 0u);
        uint _e114 = left;
        uint _e115 = left;
        uint _e119 = left;
        left = (_e79.more ? _e119 : (_e114 & (_e115 - 1u)));
        uint _e122 = left;
        if ((_e122 == 0u)) {
            break;
        }
    }
    float _e127 = sums_1.openness.x;
    float _e130 = sums_1.weights.x;
    float openness_3 = min(((_e127 / _e130) * 0.003921569), 1.0);
    float _e138 = sums_1.weights.x;
    float _e140 = psao_seen(openness_3);
    float near_1 = min((_e138 / (PSAO_NEAR * _e140)), 1.0);
    float _e151 = sums_1.weights.x;
    return ((_e151 > 0.0) ? vec2(openness_3, near_1) : vec2(1.0, 0.0));
}

float psao_planar_fast(uint instance_7, vec3 position_6, vec3 normal_8) {
    vec2 _e3 = psao_blend_fast(instance_7, position_6, normal_8);
    return _e3.x;
}

float psao_over_baked(uint kernel, uint instance_8, vec3 position_7, vec3 normal_9, float baked, float share) {
    vec2 found = vec2(1.0, 0.0);
    if ((share <= 0.0)) {
        return baked;
    }
    if ((kernel == PSAO_PAPER)) {
        vec2 _e15 = psao_blend(false, instance_8, position_7, normal_9);
        found = _e15;
    } else {
        vec2 _e16 = psao_blend_fast(instance_8, position_7, normal_9);
        found = _e16;
    }
    float _e18 = found.x;
    float _e20 = found.y;
    return mix(baked, _e18, (_e20 * min(share, 1.0)));
}
