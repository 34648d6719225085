// PSAO: the lookup, to paste into a shader. Blends the points around a fragment into its openness:
// 1 is open, 0 fully occluded. Multiply ambient light with it.
// Generated from sdk/shaders/psao.wgsl by psao-gen: do not edit. Its comments say how it works.
//
// Call one of these, from any stage. The stream's header says which kernel its points are for.
//     float psao_planar_fast(uint instance, vec3 position, vec3 normal)   planar, the quicker way
//     float psao_planar(uint instance, vec3 position, vec3 normal)        planar, written plainly
//     float psao_paper(uint instance, vec3 position, vec3 normal)
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
// glTexSubImage2D (GL_RGBA_INTEGER, GL_UNSIGNED_INT): an instance is 4 texels, a bucket or a cell 2.

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
const float PSAO_T_N = 0.1;
const float PSAO_T_D = 0.7;
const float PSAO_PLANE_BAND = 0.3;
const float PSAO_FAR = 1e30;

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
            uint _e35 = i;
            i = (_e35 + 1u);
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
            uint entry = _e23[(_e24 & 3u)];
            if ((entry == 0u)) {
                break;
            }
            uvec4 _e32 = psao_load_cell((entry * 2u));
            if ((_e32.x == _e4)) {
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
    float agree = dot(point_normal_1, normal_3);
    if ((agree <= PSAO_T_N)) {
        return 0.0;
    }
    float h = max(abs(dot(normal_3, d_1)), abs(dot(point_normal_1, d_1)));
    float band = (PSAO_PLANE_BAND * radius_1);
    float near = max((1.0 - (dot(d_1, d_1) / (radius_1 * radius_1))), 0.0);
    float flatness = max((1.0 - ((h * h) / (band * band))), 0.0);
    float agree2_ = (agree * agree);
    float agree4_ = (agree2_ * agree2_);
    return (((near * flatness) * agree4_) * agree4_);
}

float psao_blend(bool planar, uint instance_2, vec3 position_2, vec3 normal_4) {
    float weights = 0.0;
    float sum = 0.0;
    float nearest = 1.0;
    float nearest_squared = PSAO_FAR;
    uint corner = 0u;
    uint i_1 = 0u;
    float weight = 0.0;
    PsaoGrid _e4 = psao_grid(instance_2);
    PsaoFragment _e5 = psao_fragment(_e4, position_2, normal_4);
    if (_e5.outside) {
        return 1.0;
    }
    bool loop_init_1 = true;
    while(true) {
        if (!loop_init_1) {
            uint _e89 = corner;
            corner = (_e89 + 1u);
        }
        loop_init_1 = false;
        uint _e18 = corner;
        if ((_e18 < 8u)) {
        } else {
            break;
        }
        {
            uint _e21 = corner;
            uint _e22 = corner;
            uint _e25 = corner;
            uvec3 offset = (uvec3(_e21, (_e22 >> 1u), (_e25 >> 2u)) & uvec3(1u));
            uvec3 cell_2 = (uvec3(_e5.base) + offset);
            if (any(greaterThanEqual(cell_2, _e4.dims))) {
                continue;
            }
            uint _e38 = psao_find(_e4, cell_2);
            if ((_e38 == 0u)) {
                continue;
            }
            vec3 corner_from = (vec3(offset) - _e5.place);
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
                    uvec4 _e55 = psao_load_cell(((_e38 * 2u) + (_e51 >> 2u)));
                    uint _e56 = i_1;
                    uint point_3 = _e55[(_e56 & 3u)];
                    if ((point_3 == 0u)) {
                        break;
                    }
                    if ((point_3 < 2147483648u)) {
                        continue;
                    }
                    vec3 _e64 = psao_point_place(point_3);
                    vec3 d_2 = (corner_from + _e64);
                    vec3 _e66 = psao_point_normal(point_3);
                    float _e67 = psao_point_openness(point_3);
                    float squared_2 = dot(d_2, d_2);
                    float _e69 = nearest_squared;
                    if ((squared_2 < _e69)) {
                        nearest_squared = squared_2;
                        nearest = _e67;
                    }
                    weight = 0.0;
                    if (planar) {
                        float _e75 = psao_planar_weight(_e4.radius, _e5.normal, d_2, _e66);
                        weight = _e75;
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
        return min((_e95 / _e96), 1.0);
    }
    float _e100 = nearest;
    return (planar ? _e100 : 1.0);
}

float psao_planar(uint instance_3, vec3 position_3, vec3 normal_5) {
    float _e4 = psao_blend(true, instance_3, position_3, normal_5);
    return _e4;
}

float psao_paper(uint instance_4, vec3 position_4, vec3 normal_6) {
    float _e4 = psao_blend(false, instance_4, position_4, normal_6);
    return _e4;
}

float psao_planar_fast(uint instance_5, vec3 position_5, vec3 normal_7) {
    float _e4 = psao_blend(true, instance_5, position_5, normal_7);
    return _e4;
}
