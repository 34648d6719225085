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

struct PsaoCandidate {
    uint cell;
    bool unsure;
};

static const float PSAO_T_N = 0.1;
static const float PSAO_T_D = 0.7;
static const float PSAO_FLATNESS = 11.0;
static const float PSAO_CORE = 0.2;
static const float PSAO_FADE = 0.3;
static const float PSAO_SEEN = 0.2;
static const float PSAO_UNSEEN = 0.001;
static const float PSAO_NEAR = 0.5;
static const uint PSAO_PAPER = 0u;
static const uint PSAO_ENTRY_CELL = 4194303u;

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

int3 psao_naga_f2i32(float3 value) {
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
    const PsaoFragment psaofragment = ConstructPsaoFragment(psao_naga_f2i32(lower), (g - lower), (n * ((squared > 0.0) ? rsqrt(squared) : 0.0)), _e65);
    return psaofragment;
}

uint psao_weigh(PsaoGrid grid_1, uint3 cell, uint weight_y, uint weight_z)
{
    return ((cell.x + ((cell.y * grid_1.dims.x) * weight_y)) + ((cell.z * (grid_1.dims.x * grid_1.dims.y)) * weight_z));
}

uint psao_naga_mod(uint lhs, uint rhs) {
    return lhs % (rhs == 0u ? 1u : rhs);
}

uint psao_find(PsaoGrid grid_2, uint3 cell_1)
{
    uint i = 0u;

    const uint _e4 = psao_weigh(grid_2, cell_1, 1u, 1u);
    const uint _e8 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket = (grid_2.bucket_first + psao_naga_mod(_e8, grid_2.bucket_count));
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
            const uint4 _e23 = psao_load_bucket(((bucket * 2u) + (_e19 >> 2u)));
            uint _e24 = i;
            uint entry = (_e23[(_e24 & 3u)] & PSAO_ENTRY_CELL);
            if ((entry == 0u)) {
                break;
            }
            const uint4 _e34 = psao_load_cell((entry * 2u));
            if ((_e34.x == _e4)) {
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
    float agree = max(dot(point_normal_1, normal_3), PSAO_T_N);
    float h = max(abs(dot(normal_3, d_1)), abs(dot(point_normal_1, d_1)));
    float apart = (PSAO_CORE + ((dot(d_1, d_1) + (PSAO_FLATNESS * (h * h))) / (radius_1 * radius_1)));
    float agree2_ = (agree * agree);
    float agree4_ = (agree2_ * agree2_);
    return ((agree4_ * agree4_) / (apart * apart));
}

float psao_side(float3 place, uint3 offset)
{
    float3 left_1 = ((offset != (0u).xxx) ? (place - (0.5).xxx) : ((1.5).xxx - place));
    float3 sides = clamp((left_1 / (0.3).xxx), (0.0).xxx, (1.0).xxx);
    return ((sides.x * sides.y) * sides.z);
}

float psao_seen(float openness)
{
    return (min((openness / PSAO_SEEN), 1.0) + PSAO_UNSEEN);
}

float2 psao_blend(bool planar, uint instance_2, float3 position_2, float3 normal_4)
{
    float weights = 0.0;
    float sum = 0.0;
    uint corner = 0u;
    uint i_1 = (uint)0;
    float weight = (float)0;

    const PsaoGrid _e4 = psao_grid(instance_2);
    const PsaoFragment _e5 = psao_fragment(_e4, position_2, normal_4);
    if (_e5.outside) {
        return float2(1.0, 0.0);
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
            uint3 offset_1 = (uint3(_e19, (_e20 >> 1u), (_e23 >> 2u)) & (1u).xxx);
            uint3 cell_3 = (uint3(_e5.base) + offset_1);
            if (any((cell_3 >= _e4.dims))) {
                continue;
            }
            const uint _e36 = psao_find(_e4, cell_3);
            if ((_e36 == 0u)) {
                continue;
            }
            float3 corner_from = (float3(offset_1) - _e5.place);
            const float _e43 = psao_side(_e5.place, offset_1);
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
                    const uint4 _e55 = psao_load_cell(((_e36 * 2u) + (_e51 >> 2u)));
                    uint _e56 = i_1;
                    uint point_4 = _e55[(_e56 & 3u)];
                    if ((point_4 == 0u)) {
                        break;
                    }
                    if ((point_4 < 2147483648u)) {
                        continue;
                    }
                    const float3 _e64 = psao_point_place(point_4);
                    float3 d_2 = (corner_from + _e64);
                    const float3 _e66 = psao_point_normal(point_4);
                    const float _e67 = psao_point_openness(point_4);
                    weight = 0.0;
                    if (planar) {
                        const float _e70 = psao_seen(_e67);
                        const float _e74 = psao_planar_weight(_e4.radius, _e5.normal, d_2, _e66);
                        weight = ((_e43 * _e70) * _e74);
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
        float openness_1 = min((_e95 / _e96), 1.0);
        const float _e100 = psao_seen(openness_1);
        float seen = (planar ? _e100 : 1.0);
        float _e103 = weights;
        return float2(openness_1, min((_e103 / (PSAO_NEAR * seen)), 1.0));
    }
    return float2(1.0, 0.0);
}

float psao_planar(uint instance_3, float3 position_3, float3 normal_5)
{
    const float2 _e4 = psao_blend(true, instance_3, position_3, normal_5);
    return _e4.x;
}

float psao_paper(uint instance_4, float3 position_4, float3 normal_6)
{
    const float2 _e4 = psao_blend(false, instance_4, position_4, normal_6);
    return _e4.x;
}

uint psao_tag(uint key)
{
    return max(((key * 2654435761u) >> 22u), 1u);
}

uint psao_naga_f2u32(float value) {
    return uint(clamp(value, 0.0, 4294967000.0));
}

uint psao_modulo(uint hash, uint count, float inverse)
{
    uint left_2 = (hash - (psao_naga_f2u32(((float(hash) * inverse) * 0.999999)) * count));
    uint rest = (left_2 - (psao_naga_f2u32((float(left_2) * inverse)) * count));
    uint raised = ((rest >= 2147483648u) ? (rest + count) : rest);
    return ((raised >= count) ? (raised - count) : raised);
}

void psao_add(inout float2 sums, float inverse_radius2_, float3 normal_7, float3 place_1, float side, uint point_3)
{
    int3 steps_1 = int3(((point_3).xxx & uint3(2031616u, 65011712u, 2080374784u)));
    float3 scale = float3(4.7683716e-7, 1.4901161e-8, 4.656613e-10);
    float3 d_3 = ((float3(steps_1) * scale) - place_1);
    int2 codes_1 = int2((uint2((point_3 >> 8u), (point_3 >> 12u)) & (15u).xx));
    float2 uv_1 = (float2(min(codes_1, (int(14)).xx)) - (7.0).xx);
    float z_1 = ((7.0 - abs(uv_1.x)) - abs(uv_1.y));
    float fold = max(-(z_1), 0.0);
    float3 m = float3((uv_1 - ((uv_1 < (0.0).xx) ? (-(fold)).xx : (fold).xx)), z_1);
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
    float2 _e94 = sums;
    sums = (_e94 + (((point_3 >= 2147483648u) ? weight_1 : 0.0) * float2(1.0, openness_2)));
    return;
}

PsaoCandidate ConstructPsaoCandidate(uint arg0, bool arg1) {
    PsaoCandidate ret = (PsaoCandidate)0;
    ret.cell = arg0;
    ret.unsure = arg1;
    return ret;
}

PsaoCandidate psao_pick(uint4 entries, uint tag)
{
    uint4 tags = (entries >> (22u).xxxx);
    bool4 may = ((tags == (tag).xxxx) | (tags == (0u).xxxx));
    uint4 cells = ((entries & (4194303u).xxxx) & ((0u).xxxx - uint4(may)));
    uint sum_1 = (((cells.x + cells.y) + cells.z) + cells.w);
    const PsaoCandidate psaocandidate = ConstructPsaoCandidate(sum_1, (sum_1 != max(max(cells.x, cells.y), max(cells.z, cells.w))));
    return psaocandidate;
}

PsaoCandidate psao_candidate(PsaoGrid grid_3, float inverse_count, uint3 cell_2)
{
    bool local_4 = (bool)0;
    bool local_5 = (bool)0;
    bool local_6 = (bool)0;

    if (any((cell_2 >= grid_3.dims))) {
        const PsaoCandidate psaocandidate_1 = ConstructPsaoCandidate(0u, false);
        return psaocandidate_1;
    }
    const uint _e11 = psao_weigh(grid_3, cell_2, 1u, 1u);
    const uint _e12 = psao_tag(_e11);
    const uint _e15 = psao_weigh(grid_3, cell_2, 17u, 31u);
    const uint _e18 = psao_modulo(_e15, grid_3.bucket_count, inverse_count);
    uint bucket_1 = (grid_3.bucket_first + _e18);
    const uint4 _e22 = psao_load_bucket((bucket_1 * 2u));
    const PsaoCandidate _e23 = psao_pick(_e22, _e12);
    if ((_e22.w == 0u)) {
        const PsaoCandidate psaocandidate_2 = _e23;
        return psaocandidate_2;
    }
    const uint4 _e31 = psao_load_bucket(((bucket_1 * 2u) + 1u));
    const PsaoCandidate _e32 = psao_pick(_e31, _e12);
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
    const PsaoCandidate psaocandidate_3 = ConstructPsaoCandidate((_e23.cell + _e32.cell), _e57);
    return psaocandidate_3;
}

float2 psao_blend_fast(uint instance_5, float3 position_5, float3 normal_8)
{
    bool local_7 = (bool)0;
    bool local_8 = (bool)0;
    bool local_9 = (bool)0;
    bool local_10 = (bool)0;
    bool local_11 = (bool)0;
    bool local_12 = (bool)0;
    bool local_13 = (bool)0;
    uint left = (uint)0;
    float2 sums_1 = (0.0).xx;
    bool second = false;
    uint4 words = (uint4)0;
    bool local_14 = (bool)0;
    bool local_15 = (bool)0;
    bool local_16 = (bool)0;

    const PsaoGrid _e3 = psao_grid(instance_5);
    const PsaoFragment _e4 = psao_fragment(_e3, position_5, normal_8);
    if (_e4.outside) {
        return float2(1.0, 0.0);
    }
    float inverse_count_1 = (1.0 / float(_e3.bucket_count));
    uint3 base = uint3(_e4.base);
    const PsaoCandidate _e15 = psao_candidate(_e3, inverse_count_1, base);
    const PsaoCandidate _e21 = psao_candidate(_e3, inverse_count_1, (base + uint3(1u, 0u, 0u)));
    const PsaoCandidate _e27 = psao_candidate(_e3, inverse_count_1, (base + uint3(0u, 1u, 0u)));
    const PsaoCandidate _e33 = psao_candidate(_e3, inverse_count_1, (base + uint3(1u, 1u, 0u)));
    const PsaoCandidate _e39 = psao_candidate(_e3, inverse_count_1, (base + uint3(0u, 0u, 1u)));
    const PsaoCandidate _e45 = psao_candidate(_e3, inverse_count_1, (base + uint3(1u, 0u, 1u)));
    const PsaoCandidate _e51 = psao_candidate(_e3, inverse_count_1, (base + uint3(0u, 1u, 1u)));
    const PsaoCandidate _e57 = psao_candidate(_e3, inverse_count_1, (base + uint3(1u, 1u, 1u)));
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
        const float2 _e102 = psao_blend(true, instance_5, position_5, normal_8);
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
            uint corner_1 = ((asuint(float(int((_e172 & (0u - _e174))))) >> 23u) - 127u);
            uint3 offset_2 = (uint3(corner_1, (corner_1 >> 1u), (corner_1 >> 2u)) & (1u).xxx);
            bool right = (offset_2.x != 0u);
            bool back = (offset_2.y != 0u);
            uint lower_1 = (back ? (right ? _e33.cell : _e27.cell) : (right ? _e21.cell : _e15.cell));
            uint upper = (back ? (right ? _e57.cell : _e51.cell) : (right ? _e45.cell : _e39.cell));
            uint found_1 = ((offset_2.z != 0u) ? upper : lower_1);
            bool _e220 = second;
            const uint4 _e223 = psao_load_cell(((found_1 * 2u) + (_e220 ? 1u : 0u)));
            words = _e223;
            bool _e225 = second;
            if (!(_e225)) {
                uint _e230 = words.x;
                const uint _e234 = psao_weigh(_e3, (base + offset_2), 1u, 1u);
                local_14 = (_e230 != _e234);
            } else {
                local_14 = false;
            }
            bool _e237 = local_14;
            if (_e237) {
                words = (0u).xxxx;
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
            const float _e269 = psao_side(_e4.place, offset_2);
            float3 place_2 = ((_e4.place - (0.015625).xxx) - float3(int3(offset_2)));
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
    const float _e310 = psao_seen(openness_3);
    float near = min((_e308 / (PSAO_NEAR * _e310)), 1.0);
    float _e320 = sums_1.x;
    return ((_e320 > 0.0) ? float2(openness_3, near) : float2(1.0, 0.0));
}

float psao_planar_fast(uint instance_6, float3 position_6, float3 normal_9)
{
    const float2 _e3 = psao_blend_fast(instance_6, position_6, normal_9);
    return _e3.x;
}

float psao_over_baked(uint kernel, uint instance_7, float3 position_7, float3 normal_10, float baked, float share)
{
    float2 found = float2(1.0, 0.0);

    if ((share <= 0.0)) {
        return baked;
    }
    if ((kernel == PSAO_PAPER)) {
        const float2 _e15 = psao_blend(false, instance_7, position_7, normal_10);
        found = _e15;
    } else {
        const float2 _e16 = psao_blend_fast(instance_7, position_7, normal_10);
        found = _e16;
    }
    float _e18 = found.x;
    float _e20 = found.y;
    return lerp(baked, _e18, (_e20 * min(share, 1.0)));
}
