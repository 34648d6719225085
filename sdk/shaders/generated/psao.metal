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
// Metal shading language 2.0. Reads device buffers: bind the client's instances, buckets and cells,
// as they are, to any buffer slots, and pass the three on, behind the arguments above and in this
// order; each function shows it. vec3 is metal::float3.

// language: metal2.0
#include <metal_stdlib>
#include <simd/simd.h>

using metal::uint;

struct _mslBufferSizes {
    uint size0;
    uint size1;
    uint size2;
};

typedef metal::uint4 type_2[1];
struct PsaoGrid {
    metal::packed_float3 origin;
    float radius;
    metal::packed_float3 cells_per_unit;
    uint bucket_first;
    metal::packed_uint3 dims;
    uint bucket_count;
    metal::float3 normal_scale;
};
struct PsaoFragment {
    metal::int3 base;
    metal::float3 place;
    metal::packed_float3 normal;
    bool outside;
    char _pad4[3];
};
constant float PSAO_T_N = 0.1;
constant float PSAO_T_D = 0.7;
constant float PSAO_PLANE_BAND = 0.3;
constant float PSAO_FAR = 1000000000000000000000000000000.0;

metal::uint4 psao_load_instance(
    uint index,
    device type_2 const& psao_instances,
    constant _mslBufferSizes& _buffer_sizes
) {
    metal::uint4 _e3 = psao_instances[index];
    return _e3;
}

metal::uint4 psao_load_bucket(
    uint index_1,
    device type_2 const& psao_buckets,
    constant _mslBufferSizes& _buffer_sizes
) {
    metal::uint4 _e3 = psao_buckets[index_1];
    return _e3;
}

metal::uint4 psao_load_cell(
    uint index_2,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    metal::uint4 _e3 = psao_cells[index_2];
    return _e3;
}

PsaoGrid psao_grid(
    uint instance_1,
    device type_2 const& psao_instances,
    constant _mslBufferSizes& _buffer_sizes
) {
    metal::uint4 _e3 = psao_load_instance(instance_1 * 4u, psao_instances, _buffer_sizes);
    metal::uint4 _e8 = psao_load_instance((instance_1 * 4u) + 1u, psao_instances, _buffer_sizes);
    metal::uint4 _e13 = psao_load_instance((instance_1 * 4u) + 2u, psao_instances, _buffer_sizes);
    metal::uint4 _e18 = psao_load_instance((instance_1 * 4u) + 3u, psao_instances, _buffer_sizes);
    return PsaoGrid {as_type<metal::float3>(_e3.xyz), as_type<float>(_e3.w), as_type<metal::float3>(_e8.xyz), _e8.w, _e13.xyz, _e13.w, as_type<metal::float3>(_e18.xyz)};
}

metal::int3 naga_f2i32(metal::float3 value) {
    return static_cast<metal::int3>(metal::clamp(value, -2147483600.0, 2147483500.0));
}

PsaoFragment psao_fragment(
    PsaoGrid grid,
    metal::float3 position_1,
    metal::float3 normal_1
) {
    bool local = {};
    bool local_1 = {};
    metal::float3 g = (position_1 - grid.origin) * grid.cells_per_unit;
    if (metal::all(g >= metal::float3(-0.5))) {
        local = metal::all(g < (static_cast<metal::float3>(grid.dims) + metal::float3(0.5)));
    } else {
        local = false;
    }
    bool inside = local;
    metal::float3 lower = metal::floor(metal::clamp(g, metal::float3(-0.5), static_cast<metal::float3>(grid.dims) + metal::float3(0.5)) - metal::float3(0.5));
    float largest = metal::max(metal::max(metal::abs(normal_1.x), metal::abs(normal_1.y)), metal::abs(normal_1.z));
    metal::float3 n = (normal_1 / metal::float3(metal::max(largest, 0.0000000000000000000000000000000000001))) * grid.normal_scale;
    float squared = metal::dot(n, n);
    if (!((grid.bucket_count == 0u))) {
        local_1 = !(inside);
    } else {
        local_1 = true;
    }
    bool _e65 = local_1;
    return PsaoFragment {naga_f2i32(lower), g - lower, n * ((squared > 0.0) ? metal::rsqrt(squared) : 0.0), _e65};
}

uint psao_weigh(
    PsaoGrid grid_1,
    metal::uint3 cell,
    uint weight_y,
    uint weight_z
) {
    return (cell.x + ((cell.y * grid_1.dims[0]) * weight_y)) + ((cell.z * (grid_1.dims[0] * grid_1.dims[1])) * weight_z);
}

uint naga_mod(uint lhs, uint rhs) {
    return lhs % metal::select(rhs, 1u, rhs == 0u);
}

uint psao_find(
    PsaoGrid grid_2,
    metal::uint3 cell_1,
    device type_2 const& psao_buckets,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    uint i = 0u;
    uint _e4 = psao_weigh(grid_2, cell_1, 1u, 1u);
    uint _e8 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket = grid_2.bucket_first + naga_mod(_e8, grid_2.bucket_count);
    bool loop_init = true;
    while(true) {
        if (!loop_init) {
            uint _e35 = i;
            i = _e35 + 1u;
        }
        loop_init = false;
        uint _e14 = i;
        if (_e14 < 8u) {
        } else {
            break;
        }
        {
            uint _e19 = i;
            metal::uint4 _e23 = psao_load_bucket((bucket * 2u) + (_e19 >> 2u), psao_buckets, _buffer_sizes);
            uint _e24 = i;
            uint entry = _e23[_e24 & 3u];
            if (entry == 0u) {
                break;
            }
            metal::uint4 _e32 = psao_load_cell(entry * 2u, psao_cells, _buffer_sizes);
            if (_e32.x == _e4) {
                return entry;
            }
        }
    }
    return 0u;
}

metal::float3 psao_point_place(
    uint point
) {
    metal::uint3 steps = metal::uint3(point >> 16u, point >> 21u, point >> 26u) & metal::uint3(31u);
    return (static_cast<metal::float3>(steps) + metal::float3(0.5)) * 0.03125;
}

metal::float3 psao_point_normal(
    uint point_1
) {
    metal::uint2 codes = metal::uint2(point_1 >> 8u, point_1 >> 12u) & metal::uint2(15u);
    metal::float2 uv = (static_cast<metal::float2>(metal::min(codes, metal::uint2(14u))) - metal::float2(7.0)) / metal::float2(7.0);
    float z = (1.0 - metal::abs(uv.x)) - metal::abs(uv.y);
    metal::float2 folded = (metal::float2(1.0) - metal::abs(uv.yx)) * metal::select(metal::float2(1.0), metal::float2(-1.0), uv < metal::float2(0.0));
    return metal::normalize(metal::float3((z >= 0.0) ? uv : folded, z));
}

float psao_point_openness(
    uint point_2
) {
    return static_cast<float>(point_2 & 255u) * 0.003921569;
}

float psao_paper_weight(
    float radius,
    metal::float3 normal_2,
    metal::float3 d,
    metal::float3 point_normal
) {
    bool local_2 = {};
    bool local_3 = {};
    float squared_1 = metal::dot(d, d);
    float along = metal::dot(point_normal, d);
    if (!((metal::dot(point_normal, normal_2) <= PSAO_T_N))) {
        if ((along * along) >= (PSAO_T_D * squared_1)) {
            local_3 = squared_1 > 0.0;
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
    return metal::max((radius - metal::sqrt(squared_1)) / radius, 0.0);
}

float psao_planar_weight(
    float radius_1,
    metal::float3 normal_3,
    metal::float3 d_1,
    metal::float3 point_normal_1
) {
    float agree = metal::dot(point_normal_1, normal_3);
    if (agree <= PSAO_T_N) {
        return 0.0;
    }
    float h = metal::max(metal::abs(metal::dot(normal_3, d_1)), metal::abs(metal::dot(point_normal_1, d_1)));
    float band = PSAO_PLANE_BAND * radius_1;
    float near = metal::max(1.0 - (metal::dot(d_1, d_1) / (radius_1 * radius_1)), 0.0);
    float flatness = metal::max(1.0 - ((h * h) / (band * band)), 0.0);
    float agree2_ = agree * agree;
    float agree4_ = agree2_ * agree2_;
    return ((near * flatness) * agree4_) * agree4_;
}

float psao_blend(
    bool planar,
    uint instance_2,
    metal::float3 position_2,
    metal::float3 normal_4,
    device type_2 const& psao_instances,
    device type_2 const& psao_buckets,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    float weights = 0.0;
    float sum = 0.0;
    float nearest = 1.0;
    float nearest_squared = PSAO_FAR;
    uint corner = 0u;
    uint i_1 = {};
    float weight = {};
    PsaoGrid _e4 = psao_grid(instance_2, psao_instances, _buffer_sizes);
    PsaoFragment _e5 = psao_fragment(_e4, position_2, normal_4);
    if (_e5.outside) {
        return 1.0;
    }
    bool loop_init_1 = true;
    while(true) {
        if (!loop_init_1) {
            uint _e89 = corner;
            corner = _e89 + 1u;
        }
        loop_init_1 = false;
        uint _e18 = corner;
        if (_e18 < 8u) {
        } else {
            break;
        }
        {
            uint _e21 = corner;
            uint _e22 = corner;
            uint _e25 = corner;
            metal::uint3 offset = metal::uint3(_e21, _e22 >> 1u, _e25 >> 2u) & metal::uint3(1u);
            metal::uint3 cell_2 = static_cast<metal::uint3>(_e5.base) + offset;
            if (metal::any(cell_2 >= _e4.dims)) {
                continue;
            }
            uint _e38 = psao_find(_e4, cell_2, psao_buckets, psao_cells, _buffer_sizes);
            if (_e38 == 0u) {
                continue;
            }
            metal::float3 corner_from = static_cast<metal::float3>(offset) - _e5.place;
            i_1 = 1u;
            bool loop_init_2 = true;
            while(true) {
                if (!loop_init_2) {
                    uint _e86 = i_1;
                    i_1 = _e86 + 1u;
                }
                loop_init_2 = false;
                uint _e46 = i_1;
                if (_e46 < 8u) {
                } else {
                    break;
                }
                {
                    uint _e51 = i_1;
                    metal::uint4 _e55 = psao_load_cell((_e38 * 2u) + (_e51 >> 2u), psao_cells, _buffer_sizes);
                    uint _e56 = i_1;
                    uint point_3 = _e55[_e56 & 3u];
                    if (point_3 == 0u) {
                        break;
                    }
                    if (point_3 < 2147483648u) {
                        continue;
                    }
                    metal::float3 _e64 = psao_point_place(point_3);
                    metal::float3 d_2 = corner_from + _e64;
                    metal::float3 _e66 = psao_point_normal(point_3);
                    float _e67 = psao_point_openness(point_3);
                    float squared_2 = metal::dot(d_2, d_2);
                    float _e69 = nearest_squared;
                    if (squared_2 < _e69) {
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
                    weights = _e79 + _e80;
                    float _e82 = sum;
                    float _e83 = weight;
                    sum = _e82 + (_e83 * _e67);
                }
            }
        }
    }
    float _e92 = weights;
    if (_e92 > 0.0) {
        float _e95 = sum;
        float _e96 = weights;
        return metal::min(_e95 / _e96, 1.0);
    }
    float _e100 = nearest;
    return planar ? _e100 : 1.0;
}

float psao_planar(
    uint instance_3,
    metal::float3 position_3,
    metal::float3 normal_5,
    device type_2 const& psao_instances,
    device type_2 const& psao_buckets,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    float _e4 = psao_blend(true, instance_3, position_3, normal_5, psao_instances, psao_buckets, psao_cells, _buffer_sizes);
    return _e4;
}

float psao_paper(
    uint instance_4,
    metal::float3 position_4,
    metal::float3 normal_6,
    device type_2 const& psao_instances,
    device type_2 const& psao_buckets,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    float _e4 = psao_blend(false, instance_4, position_4, normal_6, psao_instances, psao_buckets, psao_cells, _buffer_sizes);
    return _e4;
}

float psao_planar_fast(
    uint instance_5,
    metal::float3 position_5,
    metal::float3 normal_7,
    device type_2 const& psao_instances,
    device type_2 const& psao_buckets,
    device type_2 const& psao_cells,
    constant _mslBufferSizes& _buffer_sizes
) {
    float _e4 = psao_blend(true, instance_5, position_5, normal_7, psao_instances, psao_buckets, psao_cells, _buffer_sizes);
    return _e4;
}
