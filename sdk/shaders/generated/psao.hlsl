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
// HLSL, shader model 5.1. Reads raw buffers (ByteAddressBuffer): bind the client's instances,
// buckets and cells, as they are, to the registers below. vec3 is float3.

struct PsaoGrid {
    float3 origin;
    float radius;
    float3 cells_per_unit;
    uint bucket_first;
    uint3 dims;
    uint bucket_count;
    float3 normal_scale;
    int _end_pad_0;
};

struct PsaoFragment {
    int3 base;
    int _pad1_0;
    float3 place;
    int _pad2_0;
    float3 normal;
    bool outside;
};

static const float PSAO_T_N = 0.1;
static const float PSAO_T_D = 0.7;
static const float PSAO_PLANE_BAND = 0.3;
static const float PSAO_FAR = 1e30;

ByteAddressBuffer psao_instances : register(t0);
ByteAddressBuffer psao_buckets : register(t1);
ByteAddressBuffer psao_cells : register(t2);

uint4 psao_load_instance(uint index)
{
    uint4 _e3 = asuint(psao_instances.Load4(index*16));
    return _e3;
}

uint4 psao_load_bucket(uint index_1)
{
    uint4 _e3 = asuint(psao_buckets.Load4(index_1*16));
    return _e3;
}

uint4 psao_load_cell(uint index_2)
{
    uint4 _e3 = asuint(psao_cells.Load4(index_2*16));
    return _e3;
}

PsaoGrid ConstructPsaoGrid(float3 arg0, float arg1, float3 arg2, uint arg3, uint3 arg4, uint arg5, float3 arg6) {
    PsaoGrid ret = (PsaoGrid)0;
    ret.origin = arg0;
    ret.radius = arg1;
    ret.cells_per_unit = arg2;
    ret.bucket_first = arg3;
    ret.dims = arg4;
    ret.bucket_count = arg5;
    ret.normal_scale = arg6;
    return ret;
}

PsaoGrid psao_grid(uint instance_1)
{
    const uint4 _e3 = psao_load_instance((instance_1 * 4u));
    const uint4 _e8 = psao_load_instance(((instance_1 * 4u) + 1u));
    const uint4 _e13 = psao_load_instance(((instance_1 * 4u) + 2u));
    const uint4 _e18 = psao_load_instance(((instance_1 * 4u) + 3u));
    const PsaoGrid psaogrid = ConstructPsaoGrid(asfloat(_e3.xyz), asfloat(_e3.w), asfloat(_e8.xyz), _e8.w, _e13.xyz, _e13.w, asfloat(_e18.xyz));
    return psaogrid;
}

PsaoFragment ConstructPsaoFragment(int3 arg0, float3 arg1, float3 arg2, bool arg3) {
    PsaoFragment ret = (PsaoFragment)0;
    ret.base = arg0;
    ret.place = arg1;
    ret.normal = arg2;
    ret.outside = arg3;
    return ret;
}

int3 naga_f2i32(float3 value) {
    return int3(clamp(value, -2147483600.0, 2147483500.0));
}

PsaoFragment psao_fragment(PsaoGrid grid, float3 position_1, float3 normal_1)
{
    bool local = (bool)0;
    bool local_1 = (bool)0;

    float3 g = ((position_1 - grid.origin) * grid.cells_per_unit);
    if (all((g >= (-0.5).xxx))) {
        local = all((g < (float3(grid.dims) + (0.5).xxx)));
    } else {
        local = false;
    }
    bool inside = local;
    float3 lower = floor((clamp(g, (-0.5).xxx, (float3(grid.dims) + (0.5).xxx)) - (0.5).xxx));
    float largest = max(max(abs(normal_1.x), abs(normal_1.y)), abs(normal_1.z));
    float3 n = ((normal_1 / (max(largest, 1e-37)).xxx) * grid.normal_scale);
    float squared = dot(n, n);
    if (!((grid.bucket_count == 0u))) {
        local_1 = !(inside);
    } else {
        local_1 = true;
    }
    bool _e65 = local_1;
    const PsaoFragment psaofragment = ConstructPsaoFragment(naga_f2i32(lower), (g - lower), (n * ((squared > 0.0) ? rsqrt(squared) : 0.0)), _e65);
    return psaofragment;
}

uint psao_weigh(PsaoGrid grid_1, uint3 cell, uint weight_y, uint weight_z)
{
    return ((cell.x + ((cell.y * grid_1.dims.x) * weight_y)) + ((cell.z * (grid_1.dims.x * grid_1.dims.y)) * weight_z));
}

uint naga_mod(uint lhs, uint rhs) {
    return lhs % (rhs == 0u ? 1u : rhs);
}

uint psao_find(PsaoGrid grid_2, uint3 cell_1)
{
    uint i = 0u;

    const uint _e4 = psao_weigh(grid_2, cell_1, 1u, 1u);
    const uint _e8 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket = (grid_2.bucket_first + naga_mod(_e8, grid_2.bucket_count));
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
            const uint4 _e23 = psao_load_bucket(((bucket * 2u) + (_e19 >> 2u)));
            uint _e24 = i;
            uint entry = _e23[(_e24 & 3u)];
            if ((entry == 0u)) {
                break;
            }
            const uint4 _e32 = psao_load_cell((entry * 2u));
            if ((_e32.x == _e4)) {
                return entry;
            }
        }
    }
    return 0u;
}

float3 psao_point_place(uint point_)
{
    uint3 steps = (uint3((point_ >> 16u), (point_ >> 21u), (point_ >> 26u)) & (31u).xxx);
    return ((float3(steps) + (0.5).xxx) * 0.03125);
}

float3 psao_point_normal(uint point_1)
{
    uint2 codes = (uint2((point_1 >> 8u), (point_1 >> 12u)) & (15u).xx);
    float2 uv = ((float2(min(codes, (14u).xx)) - (7.0).xx) / (7.0).xx);
    float z = ((1.0 - abs(uv.x)) - abs(uv.y));
    float2 folded = (((1.0).xx - abs(uv.yx)) * ((uv < (0.0).xx) ? (-1.0).xx : (1.0).xx));
    return normalize(float3(((z >= 0.0) ? uv : folded), z));
}

float psao_point_openness(uint point_2)
{
    return (float((point_2 & 255u)) * 0.003921569);
}

float psao_paper_weight(float radius, float3 normal_2, float3 d, float3 point_normal)
{
    bool local_2 = (bool)0;
    bool local_3 = (bool)0;

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

float psao_planar_weight(float radius_1, float3 normal_3, float3 d_1, float3 point_normal_1)
{
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

float psao_blend(bool planar, uint instance_2, float3 position_2, float3 normal_4)
{
    float weights = 0.0;
    float sum = 0.0;
    float nearest = 1.0;
    float nearest_squared = PSAO_FAR;
    uint corner = 0u;
    uint i_1 = (uint)0;
    float weight = (float)0;

    const PsaoGrid _e4 = psao_grid(instance_2);
    const PsaoFragment _e5 = psao_fragment(_e4, position_2, normal_4);
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
            uint3 offset = (uint3(_e21, (_e22 >> 1u), (_e25 >> 2u)) & (1u).xxx);
            uint3 cell_2 = (uint3(_e5.base) + offset);
            if (any((cell_2 >= _e4.dims))) {
                continue;
            }
            const uint _e38 = psao_find(_e4, cell_2);
            if ((_e38 == 0u)) {
                continue;
            }
            float3 corner_from = (float3(offset) - _e5.place);
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
                    const uint4 _e55 = psao_load_cell(((_e38 * 2u) + (_e51 >> 2u)));
                    uint _e56 = i_1;
                    uint point_3 = _e55[(_e56 & 3u)];
                    if ((point_3 == 0u)) {
                        break;
                    }
                    if ((point_3 < 2147483648u)) {
                        continue;
                    }
                    const float3 _e64 = psao_point_place(point_3);
                    float3 d_2 = (corner_from + _e64);
                    const float3 _e66 = psao_point_normal(point_3);
                    const float _e67 = psao_point_openness(point_3);
                    float squared_2 = dot(d_2, d_2);
                    float _e69 = nearest_squared;
                    if ((squared_2 < _e69)) {
                        nearest_squared = squared_2;
                        nearest = _e67;
                    }
                    weight = 0.0;
                    if (planar) {
                        const float _e75 = psao_planar_weight(_e4.radius, _e5.normal, d_2, _e66);
                        weight = _e75;
                    } else {
                        const float _e78 = psao_paper_weight(_e4.radius, _e5.normal, d_2, _e66);
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

float psao_planar(uint instance_3, float3 position_3, float3 normal_5)
{
    const float _e4 = psao_blend(true, instance_3, position_3, normal_5);
    return _e4;
}

float psao_paper(uint instance_4, float3 position_4, float3 normal_6)
{
    const float _e4 = psao_blend(false, instance_4, position_4, normal_6);
    return _e4;
}

float psao_planar_fast(uint instance_5, float3 position_5, float3 normal_7)
{
    const float _e4 = psao_blend(true, instance_5, position_5, normal_7);
    return _e4;
}
