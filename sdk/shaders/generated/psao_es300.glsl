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
struct PsaoCandidate {
    uint cell;
    bool unsure;
};
const float PSAO_T_N = 0.1;
const float PSAO_T_D = 0.7;
const float PSAO_FLATNESS = 11.0;
const float PSAO_CORE = 0.2;
const float PSAO_FADE = 0.3;
const float PSAO_SEEN = 0.2;
const float PSAO_UNSEEN = 0.001;
const float PSAO_NEAR = 0.5;
const uint PSAO_PAPER = 0u;
const uint PSAO_ENTRY_CELL = 4194303u;

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

uint psao_find(PsaoGrid grid_2, uvec3 cell_1) {
    uint i = 0u;
    uint _e4 = psao_weigh(grid_2, cell_1, 1u, 1u);
    uint _e8 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket = (grid_2.bucket_first + (_e8 % grid_2.bucket_count));
    bool loop_init = true;
    while(true) {
        if (!loop_init) {
            uint _e37 = i;
            i = (_e37 + 1u);
        }
        loop_init = false;
        uint _e14 = i;
        if ((_e14 < 8u)) {
        } else {
            break;
        }
        {
            uint _e19 = i;
            uvec4 _e23 = psao_load_bucket(((bucket * 2u) + (_e19 >> 2u)));
            uint _e24 = i;
            uint entry = (_e23[(_e24 & 3u)] & PSAO_ENTRY_CELL);
            if ((entry == 0u)) {
                break;
            }
            uvec4 _e34 = psao_load_cell((entry * 2u));
            if ((_e34.x == _e4)) {
                return entry;
            }
        }
    }
    return 0u;
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
    float apart = (PSAO_CORE + ((dot(d_1, d_1) + (PSAO_FLATNESS * (h * h))) / (radius_1 * radius_1)));
    float agree2_ = (agree * agree);
    float agree4_ = (agree2_ * agree2_);
    return ((agree4_ * agree4_) / (apart * apart));
}

float psao_side(vec3 place, uvec3 offset) {
    vec3 left_1 = mix((vec3(1.5) - place), (place - vec3(0.5)), notEqual(offset, uvec3(0u)));
    vec3 sides = clamp((left_1 / vec3(0.3)), vec3(0.0), vec3(1.0));
    return ((sides.x * sides.y) * sides.z);
}

float psao_seen(float openness) {
    return (min((openness / PSAO_SEEN), 1.0) + PSAO_UNSEEN);
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
            uvec3 offset_1 = (uvec3(_e19, (_e20 >> 1u), (_e23 >> 2u)) & uvec3(1u));
            uvec3 cell_3 = (uvec3(_e5.base) + offset_1);
            if (any(greaterThanEqual(cell_3, _e4.dims))) {
                continue;
            }
            uint _e36 = psao_find(_e4, cell_3);
            if ((_e36 == 0u)) {
                continue;
            }
            vec3 corner_from = (vec3(offset_1) - _e5.place);
            float _e43 = psao_side(_e5.place, offset_1);
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
        float seen = (planar ? _e100 : 1.0);
        float _e103 = weights;
        return vec2(openness_1, min((_e103 / (PSAO_NEAR * seen)), 1.0));
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

uint psao_tag(uint key) {
    return max(((key * 2654435761u) >> 22u), 1u);
}

uint psao_modulo(uint hash, uint count, float inverse_) {
    uint left_2 = (hash - (uint(((float(hash) * inverse_) * 0.999999)) * count));
    uint rest = (left_2 - (uint((float(left_2) * inverse_)) * count));
    uint raised = ((rest >= 2147483648u) ? (rest + count) : rest);
    return ((raised >= count) ? (raised - count) : raised);
}

void psao_add(inout vec2 sums, float inverse_radius2_, vec3 normal_7, vec3 place_1, float side, uint point_3) {
    ivec3 steps_1 = ivec3((uvec3(point_3) & uvec3(2031616u, 65011712u, 2080374784u)));
    vec3 scale = vec3(4.7683716e-7, 1.4901161e-8, 4.656613e-10);
    vec3 d_3 = ((vec3(steps_1) * scale) - place_1);
    ivec2 codes_1 = ivec2((uvec2((point_3 >> 8u), (point_3 >> 12u)) & uvec2(15u)));
    vec2 uv_1 = (vec2(min(codes_1, ivec2(14))) - vec2(7.0));
    float z_1 = ((7.0 - abs(uv_1.x)) - abs(uv_1.y));
    float fold = max(-(z_1), 0.0);
    vec3 m = vec3((uv_1 - mix(vec2(fold), vec2(-(fold)), lessThan(uv_1, vec2(0.0)))), z_1);
    float inverse_1 = (1.0 / dot(m, m));
    float agree_1 = max(dot(m, normal_7), 0.0);
    float agree2_1 = max(((agree_1 * agree_1) * inverse_1), 0.010000001);
    float along_1 = dot(normal_7, d_3);
    float point_along = dot(m, d_3);
    float h2_ = max((along_1 * along_1), ((point_along * point_along) * inverse_1));
    float apart_1 = (PSAO_CORE + ((dot(d_3, d_3) + (PSAO_FLATNESS * h2_)) * inverse_radius2_));
    float openness_2 = float(int((point_3 & 255u)));
    float seen_1 = (min((openness_2 * 0.019607844), 1.0) + PSAO_UNSEEN);
    float agree4_1 = (agree2_1 * agree2_1);
    float weight_1 = ((((side * seen_1) * agree4_1) * agree4_1) / (apart_1 * apart_1));
    vec2 _e94 = sums;
    sums = (_e94 + (((point_3 >= 2147483648u) ? weight_1 : 0.0) * vec2(1.0, openness_2)));
    return;
}

PsaoCandidate psao_pick(uvec4 entries, uint tag) {
    uvec4 tags = (entries >> uvec4(22u));
    bvec4 may = bvec4(equal(tags, uvec4(tag)).x || equal(tags, uvec4(0u)).x, equal(tags, uvec4(tag)).y || equal(tags, uvec4(0u)).y, equal(tags, uvec4(tag)).z || equal(tags, uvec4(0u)).z, equal(tags, uvec4(tag)).w || equal(tags, uvec4(0u)).w);
    uvec4 cells = ((entries & uvec4(4194303u)) & (uvec4(0u) - uvec4(may)));
    uint sum_1 = (((cells.x + cells.y) + cells.z) + cells.w);
    return PsaoCandidate(sum_1, (sum_1 != max(max(cells.x, cells.y), max(cells.z, cells.w))));
}

PsaoCandidate psao_candidate(PsaoGrid grid_3, float inverse_count, uvec3 cell_2) {
    bool local_4 = false;
    bool local_5 = false;
    bool local_6 = false;
    if (any(greaterThanEqual(cell_2, grid_3.dims))) {
        return PsaoCandidate(0u, false);
    }
    uint _e11 = psao_weigh(grid_3, cell_2, 1u, 1u);
    uint _e12 = psao_tag(_e11);
    uint _e15 = psao_weigh(grid_3, cell_2, 17u, 31u);
    uint _e18 = psao_modulo(_e15, grid_3.bucket_count, inverse_count);
    uint bucket_1 = (grid_3.bucket_first + _e18);
    uvec4 _e22 = psao_load_bucket((bucket_1 * 2u));
    PsaoCandidate _e23 = psao_pick(_e22, _e12);
    if ((_e22.w == 0u)) {
        return _e23;
    }
    uvec4 _e31 = psao_load_bucket(((bucket_1 * 2u) + 1u));
    PsaoCandidate _e32 = psao_pick(_e31, _e12);
    if ((_e23.cell != 0u)) {
        local_4 = (_e32.cell != 0u);
    } else {
        local_4 = false;
    }
    bool both = local_4;
    if (!(_e23.unsure)) {
        local_5 = _e32.unsure;
    } else {
        local_5 = true;
    }
    bool _e52 = local_5;
    if (!(_e52)) {
        local_6 = both;
    } else {
        local_6 = true;
    }
    bool _e57 = local_6;
    return PsaoCandidate((_e23.cell + _e32.cell), _e57);
}

vec2 psao_blend_fast(uint instance_5, vec3 position_5, vec3 normal_8) {
    bool local_7 = false;
    bool local_8 = false;
    bool local_9 = false;
    bool local_10 = false;
    bool local_11 = false;
    bool local_12 = false;
    bool local_13 = false;
    uint left = 0u;
    vec2 sums_1 = vec2(0.0);
    bool second = false;
    uvec4 words = uvec4(0u);
    bool local_14 = false;
    bool local_15 = false;
    bool local_16 = false;
    PsaoGrid _e3 = psao_grid(instance_5);
    PsaoFragment _e4 = psao_fragment(_e3, position_5, normal_8);
    if (_e4.outside) {
        return vec2(1.0, 0.0);
    }
    float inverse_count_1 = (1.0 / float(_e3.bucket_count));
    uvec3 base = uvec3(_e4.base);
    PsaoCandidate _e15 = psao_candidate(_e3, inverse_count_1, base);
    PsaoCandidate _e21 = psao_candidate(_e3, inverse_count_1, (base + uvec3(1u, 0u, 0u)));
    PsaoCandidate _e27 = psao_candidate(_e3, inverse_count_1, (base + uvec3(0u, 1u, 0u)));
    PsaoCandidate _e33 = psao_candidate(_e3, inverse_count_1, (base + uvec3(1u, 1u, 0u)));
    PsaoCandidate _e39 = psao_candidate(_e3, inverse_count_1, (base + uvec3(0u, 0u, 1u)));
    PsaoCandidate _e45 = psao_candidate(_e3, inverse_count_1, (base + uvec3(1u, 0u, 1u)));
    PsaoCandidate _e51 = psao_candidate(_e3, inverse_count_1, (base + uvec3(0u, 1u, 1u)));
    PsaoCandidate _e57 = psao_candidate(_e3, inverse_count_1, (base + uvec3(1u, 1u, 1u)));
    if (!(_e15.unsure)) {
        local_7 = _e21.unsure;
    } else {
        local_7 = true;
    }
    bool _e64 = local_7;
    if (!(_e64)) {
        local_8 = _e27.unsure;
    } else {
        local_8 = true;
    }
    bool _e70 = local_8;
    if (!(_e70)) {
        local_9 = _e33.unsure;
    } else {
        local_9 = true;
    }
    bool _e76 = local_9;
    if (!(_e76)) {
        local_10 = _e39.unsure;
    } else {
        local_10 = true;
    }
    bool _e82 = local_10;
    if (!(_e82)) {
        local_11 = _e45.unsure;
    } else {
        local_11 = true;
    }
    bool _e88 = local_11;
    if (!(_e88)) {
        local_12 = _e51.unsure;
    } else {
        local_12 = true;
    }
    bool _e94 = local_12;
    if (!(_e94)) {
        local_13 = _e57.unsure;
    } else {
        local_13 = true;
    }
    bool _e100 = local_13;
    if (_e100) {
        vec2 _e102 = psao_blend(true, instance_5, position_5, normal_8);
        return _e102;
    }
    left = (((((((((_e15.cell != 0u) ? 1u : 0u) | ((_e21.cell != 0u) ? 2u : 0u)) | ((_e27.cell != 0u) ? 4u : 0u)) | ((_e33.cell != 0u) ? 8u : 0u)) | ((_e39.cell != 0u) ? 16u : 0u)) | ((_e45.cell != 0u) ? 32u : 0u)) | ((_e51.cell != 0u) ? 64u : 0u)) | ((_e57.cell != 0u) ? 128u : 0u));
    float inverse_radius2_1 = (1.0 / (_e3.radius * _e3.radius));
    while(true) {
        uint _e169 = left;
        if ((_e169 != 0u)) {
        } else {
            break;
        }
        {
            uint _e172 = left;
            uint _e174 = left;
            uint corner_1 = ((floatBitsToUint(float(int((_e172 & (0u - _e174))))) >> 23u) - 127u);
            uvec3 offset_2 = (uvec3(corner_1, (corner_1 >> 1u), (corner_1 >> 2u)) & uvec3(1u));
            bool right = (offset_2.x != 0u);
            bool back = (offset_2.y != 0u);
            uint lower_1 = (back ? (right ? _e33.cell : _e27.cell) : (right ? _e21.cell : _e15.cell));
            uint upper = (back ? (right ? _e57.cell : _e51.cell) : (right ? _e45.cell : _e39.cell));
            uint found_1 = ((offset_2.z != 0u) ? upper : lower_1);
            bool _e220 = second;
            uvec4 _e223 = psao_load_cell(((found_1 * 2u) + (_e220 ? 1u : 0u)));
            words = _e223;
            bool _e225 = second;
            if (!(_e225)) {
                uint _e230 = words.x;
                uint _e234 = psao_weigh(_e3, (base + offset_2), 1u, 1u);
                local_14 = (_e230 != _e234);
            } else {
                local_14 = false;
            }
            bool _e237 = local_14;
            if (_e237) {
                words = uvec4(0u);
            }
            uint _e242 = words.x;
            bool _e243 = second;
            uint a = (_e243 ? _e242 : 0u);
            uint _e246 = words.y;
            bool _e248 = second;
            if (_e248) {
                local_15 = (a == 0u);
            } else {
                local_15 = false;
            }
            bool _e254 = local_15;
            uint b = (_e254 ? 0u : _e246);
            uint _e258 = words.z;
            uint c = ((b != 0u) ? _e258 : 0u);
            uint _e264 = words.w;
            uint d_4 = ((c != 0u) ? _e264 : 0u);
            float _e269 = psao_side(_e4.place, offset_2);
            vec3 place_2 = ((_e4.place - vec3(0.015625)) - vec3(ivec3(offset_2)));
            bool _e277 = second;
            if (_e277) {
                psao_add(sums_1, inverse_radius2_1, _e4.normal, place_2, _e269, a);
            }
            psao_add(sums_1, inverse_radius2_1, _e4.normal, place_2, _e269, b);
            psao_add(sums_1, inverse_radius2_1, _e4.normal, place_2, _e269, c);
            psao_add(sums_1, inverse_radius2_1, _e4.normal, place_2, _e269, d_4);
            bool _e282 = second;
            if (!(_e282)) {
                local_16 = (d_4 != 0u);
            } else {
                local_16 = false;
            }
            bool _e289 = local_16;
            second = _e289;
            uint _e290 = left;
            uint _e291 = left;
            uint _e295 = left;
            bool _e296 = second;
            left = (_e296 ? _e295 : (_e290 & (_e291 - 1u)));
        }
    }
    float _e299 = sums_1.y;
    float _e301 = sums_1.x;
    float openness_3 = min(((_e299 / _e301) * 0.003921569), 1.0);
    float _e308 = sums_1.x;
    float _e310 = psao_seen(openness_3);
    float near = min((_e308 / (PSAO_NEAR * _e310)), 1.0);
    float _e320 = sums_1.x;
    return ((_e320 > 0.0) ? vec2(openness_3, near) : vec2(1.0, 0.0));
}

float psao_planar_fast(uint instance_6, vec3 position_6, vec3 normal_9) {
    vec2 _e3 = psao_blend_fast(instance_6, position_6, normal_9);
    return _e3.x;
}

float psao_over_baked(uint kernel, uint instance_7, vec3 position_7, vec3 normal_10, float baked, float share) {
    vec2 found = vec2(1.0, 0.0);
    if ((share <= 0.0)) {
        return baked;
    }
    if ((kernel == PSAO_PAPER)) {
        vec2 _e15 = psao_blend(false, instance_7, position_7, normal_10);
        found = _e15;
    } else {
        vec2 _e16 = psao_blend_fast(instance_7, position_7, normal_10);
        found = _e16;
    }
    float _e18 = found.x;
    float _e20 = found.y;
    return mix(baked, _e18, (_e20 * min(share, 1.0)));
}
