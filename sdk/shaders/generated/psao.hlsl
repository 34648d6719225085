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
    uint2 cells;
    uint unsure;
    int _end_pad_0;
};

struct PsaoBlock {
    uint4 lower;
    uint4 upper;
    uint unsure;
    int _end_pad_0;
    int _end_pad_1;
    int _end_pad_2;
};

struct PsaoPeek {
    uint cell;
    bool last;
};

struct PsaoRound {
    uint3 points;
    bool more;
};

struct PsaoPoint {
    float3 place;
    int _pad1_0;
    float3 normal;
    float square;
    float openness;
    float seen;
    int _end_pad_0;
    int _end_pad_1;
};

struct PsaoTwo {
    float2 x;
    float2 y;
    float2 z;
};

struct PsaoSums {
    float2 weights;
    float2 openness;
};

struct PsaoSeen {
    PsaoTwo normal;
    PsaoTwo place;
    float2 inverse_radius2_;
    float2 share;
};

static const float PSAO_T_N = 0.1;
static const float PSAO_T_D = 0.7;
static const float PSAO_FLATNESS = 30.0;
static const float PSAO_CORE = 0.5;
static const float PSAO_REACH = 1.2;
static const float PSAO_BEYOND = 0.001;
static const float PSAO_FADE = 0.3;
static const float PSAO_SEEN = 0.2;
static const float PSAO_UNSEEN = 0.0001;
static const float PSAO_NEAR = 0.05;
static const uint PSAO_PAPER = 0u;
static const uint PSAO_ENTRY_CELL = 4194303u;
static const float PSAO_HALF_STEP = 0.015625;

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

uint psao_search(uint bucket, uint key)
{
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
            const uint4 _e13 = psao_load_bucket(((bucket * 2u) + (_e9 >> 2u)));
            uint _e14 = i;
            uint entry_2 = (_e13[(_e14 & 3u)] & PSAO_ENTRY_CELL);
            if ((entry_2 == 0u)) {
                break;
            }
            const uint4 _e24 = psao_load_cell((entry_2 * 2u));
            if ((_e24.x == key)) {
                return entry_2;
            }
        }
    }
    return 0u;
}

uint psao_naga_mod(uint lhs, uint rhs) {
    return lhs % (rhs == 0u ? 1u : rhs);
}

uint psao_find(PsaoGrid grid_2, uint3 cell_1)
{
    const uint _e5 = psao_weigh(grid_2, cell_1, 17u, 31u);
    uint bucket_3 = (grid_2.bucket_first + psao_naga_mod(_e5, grid_2.bucket_count));
    const uint _e11 = psao_weigh(grid_2, cell_1, 1u, 1u);
    const uint _e12 = psao_search(bucket_3, _e11);
    return _e12;
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
    float squared_2 = dot(d_1, d_1);
    float apart = (PSAO_CORE + ((squared_2 + (PSAO_FLATNESS * (h * h))) / (radius_1 * radius_1)));
    float in_reach = max((1.0 - (squared_2 / ((PSAO_REACH * radius_1) * radius_1))), PSAO_BEYOND);
    float agree2_ = (agree * agree);
    float agree4_ = (agree2_ * agree2_);
    return (((in_reach * agree4_) * agree4_) / (apart * apart));
}

float psao_side(float3 place, uint3 offset)
{
    float3 left_1 = ((offset != (0u).xxx) ? (place - (0.5).xxx) : ((1.5).xxx - place));
    float3 sides = clamp((left_1 / (0.3).xxx), (0.0).xxx, (1.0).xxx);
    return ((sides.x * sides.y) * sides.z);
}

float psao_seen(float openness)
{
    float lit_ = min((openness / PSAO_SEEN), 1.0);
    return ((lit_ * lit_) + PSAO_UNSEEN);
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
            uint3 offset_4 = (uint3(_e19, (_e20 >> 1u), (_e23 >> 2u)) & (1u).xxx);
            uint3 cell_4 = (uint3(_e5.base) + offset_4);
            if (any((cell_4 >= _e4.dims))) {
                continue;
            }
            const uint _e36 = psao_find(_e4, cell_4);
            if ((_e36 == 0u)) {
                continue;
            }
            float3 corner_from = (float3(offset_4) - _e5.place);
            const float _e43 = psao_side(_e5.place, offset_4);
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
        float seen_1 = (planar ? _e100 : 1.0);
        float _e103 = weights;
        return float2(openness_1, min((_e103 / (PSAO_NEAR * seen_1)), 1.0));
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

uint psao_tag(uint key_1)
{
    return max(((key_1 * 2654435761u) & 4290772992u), 4194304u);
}

int psao_naga_f2i32(float value) {
    return int(clamp(value, -2147483600.0, 2147483500.0));
}

uint psao_modulo(uint hash, uint count, float inverse)
{
    int left_2 = int((hash - (uint(psao_naga_f2i32((float(int((hash >> 1u))) * (inverse * 1.999998)))) * count)));
    int divisor = int(count);
    int rest = asint(asuint(left_2) - asuint(asint(asuint(psao_naga_f2i32((float(left_2) * inverse))) * asuint(divisor))));
    int raised = ((rest < int(0)) ? asint(asuint(rest) + asuint(divisor)) : rest);
    int whole = ((raised >= divisor) ? asint(asuint(raised) - asuint(divisor)) : raised);
    return ((count == 1u) ? 0u : uint(whole));
}

uint psao_lowest(uint bits)
{
    return ((asuint(float(int((bits & (0u - bits))))) >> 23u) - 127u);
}

uint3 psao_corner(uint corner_1)
{
    return (uint3(corner_1, (corner_1 >> 1u), (corner_1 >> 2u)) & (1u).xxx);
}

PsaoGrid psao_grid_fast(uint instance_5)
{
    PsaoGrid grid_3 = (PsaoGrid)0;

    const PsaoGrid _e1 = psao_grid(instance_5);
    grid_3 = _e1;
    float _e6 = grid_3.cells_per_unit.x;
    float3 _e8 = grid_3.cells_per_unit;
    grid_3.normal_scale = ((_e6).xxx / _e8);
    PsaoGrid _e11 = grid_3;
    const PsaoGrid psaogrid_1 = _e11;
    return psaogrid_1;
}

PsaoTable ConstructPsaoTable(uint arg0, uint arg1, uint arg2, uint arg3, uint arg4, uint arg5, float arg6) {
    PsaoTable ret = (PsaoTable)0;
    ret.key = arg0;
    ret.hash = arg1;
    ret.row = arg2;
    ret.layer = arg3;
    ret.bucket_first = arg4;
    ret.bucket_count = arg5;
    ret.inverse_count = arg6;
    return ret;
}

PsaoTable psao_table(PsaoGrid grid_4, uint3 base)
{
    uint row_1 = grid_4.dims.x;
    uint layer = (grid_4.dims.x * grid_4.dims.y);
    const PsaoTable psaotable = ConstructPsaoTable(((base.x + (base.y * row_1)) + (base.z * layer)), ((base.x + ((base.y * row_1) * 17u)) + ((base.z * layer) * 31u)), row_1, layer, grid_4.bucket_first, grid_4.bucket_count, (1.0 / float(grid_4.bucket_count)));
    return psaotable;
}

uint psao_key(PsaoTable table, uint3 offset_1)
{
    return (((table.key + offset_1.x) + ((offset_1.y != 0u) ? table.row : 0u)) + ((offset_1.z != 0u) ? table.layer : 0u));
}

uint psao_bucket(PsaoTable table_1, uint3 offset_2)
{
    uint hash_1 = (((table_1.hash + offset_2.x) + ((offset_2.y != 0u) ? (table_1.row * 17u) : 0u)) + ((offset_2.z != 0u) ? (table_1.layer * 31u) : 0u));
    const uint _e26 = psao_modulo(hash_1, table_1.bucket_count, table_1.inverse_count);
    return (table_1.bucket_first + _e26);
}

uint psao_pick(uint4 entries, uint tag)
{
    uint4 rest_1 = (entries ^ (tag).xxxx);
    return min(min(rest_1.x, rest_1.y), min(rest_1.z, rest_1.w));
}

PsaoCandidate ConstructPsaoCandidate(uint arg0, uint arg1) {
    PsaoCandidate ret = (PsaoCandidate)0;
    ret.cell = arg0;
    ret.unsure = arg1;
    return ret;
}

PsaoCandidate psao_candidate(bool there, uint key_2, uint bucket_1)
{
    if (!(there)) {
        const PsaoCandidate psaocandidate = ConstructPsaoCandidate(0u, 0u);
        return psaocandidate;
    }
    const uint4 _e9 = psao_load_bucket((bucket_1 * 2u));
    const uint _e10 = psao_tag(key_2);
    const uint _e11 = psao_pick(_e9, _e10);
    bool here = (_e11 <= PSAO_ENTRY_CELL);
    bool unsure = ((_e9.x - 1u) < PSAO_ENTRY_CELL);
    const PsaoCandidate psaocandidate_1 = ConstructPsaoCandidate((here ? _e11 : 0u), (unsure ? 1u : 0u));
    return psaocandidate_1;
}

PsaoPair ConstructPsaoPair(uint2 arg0, uint arg1) {
    PsaoPair ret = (PsaoPair)0;
    ret.cells = arg0;
    ret.unsure = arg1;
    return ret;
}

PsaoPair psao_pair(PsaoTable table_2, bool2 there_1, uint2 row)
{
    uint3 offset_5 = uint3(0u, row);
    const uint _e5 = psao_bucket(table_2, offset_5);
    bool last = ((_e5 + 1u) == (table_2.bucket_first + table_2.bucket_count));
    uint next = (last ? table_2.bucket_first : (_e5 + 1u));
    const uint _e16 = psao_key(table_2, offset_5);
    const PsaoCandidate _e18 = psao_candidate(there_1.x, _e16, _e5);
    const PsaoCandidate _e22 = psao_candidate(there_1.y, (_e16 + 1u), next);
    const PsaoPair psaopair = ConstructPsaoPair(uint2(_e18.cell, _e22.cell), (_e18.unsure | (_e22.unsure << 1u)));
    return psaopair;
}

uint psao_within(PsaoGrid grid_5, uint3 base_1)
{
    uint3 low = (uint3((base_1 < grid_5.dims)) * uint3(85u, 51u, 15u));
    uint3 high = (uint3(((base_1 + (1u).xxx) < grid_5.dims)) * uint3(170u, 204u, 240u));
    uint3 axes = (low | high);
    return ((axes.x & axes.y) & axes.z);
}

PsaoBlock ConstructPsaoBlock(uint4 arg0, uint4 arg1, uint arg2) {
    PsaoBlock ret = (PsaoBlock)0;
    ret.lower = arg0;
    ret.upper = arg1;
    ret.unsure = arg2;
    return ret;
}

PsaoBlock psao_block(PsaoTable table_3, uint corners)
{
    bool4 low_1 = (((corners).xxxx & uint4(1u, 2u, 4u, 8u)) != (0u).xxxx);
    bool4 high_1 = (((corners).xxxx & uint4(16u, 32u, 64u, 128u)) != (0u).xxxx);
    const PsaoPair _e26 = psao_pair(table_3, low_1.xy, uint2(0u, 0u));
    const PsaoPair _e31 = psao_pair(table_3, low_1.zw, uint2(1u, 0u));
    const PsaoPair _e36 = psao_pair(table_3, high_1.xy, uint2(0u, 1u));
    const PsaoPair _e41 = psao_pair(table_3, high_1.zw, uint2(1u, 1u));
    const PsaoBlock psaoblock = ConstructPsaoBlock(uint4(_e26.cells, _e31.cells), uint4(_e36.cells, _e41.cells), (((_e26.unsure | (_e31.unsure << 2u)) | (_e36.unsure << 4u)) | (_e41.unsure << 6u)));
    return psaoblock;
}

PsaoBlock psao_with(PsaoBlock block, uint corner_2, uint cell_2)
{
    bool4 here_1 = (uint4(0u, 1u, 2u, 3u) == ((corner_2 & 3u)).xxxx);
    uint4 cells = (uint4(here_1) * cell_2);
    uint4 high_2 = (((corner_2 >= 4u) ? 4294967295u : 0u)).xxxx;
    const PsaoBlock psaoblock_1 = ConstructPsaoBlock((block.lower | (cells & ~(high_2))), (block.upper | (cells & high_2)), block.unsure);
    return psaoblock_1;
}

uint psao_corners(PsaoBlock block_1)
{
    uint4 bits_1 = ((uint4((block_1.lower != (0u).xxxx)) * uint4(1u, 2u, 4u, 8u)) + (uint4((block_1.upper != (0u).xxxx)) * uint4(16u, 32u, 64u, 128u)));
    return (((bits_1.x + bits_1.y) + bits_1.z) + bits_1.w);
}

uint psao_cell_at(PsaoBlock block_2, uint3 offset_3)
{
    bool back = (offset_3.y != 0u);
    uint lower_1 = ((offset_3.x != 0u) ? (back ? block_2.lower.w : block_2.lower.y) : (back ? block_2.lower.z : block_2.lower.x));
    uint upper = ((offset_3.x != 0u) ? (back ? block_2.upper.w : block_2.upper.y) : (back ? block_2.upper.z : block_2.upper.x));
    return ((offset_3.z != 0u) ? upper : lower_1);
}

PsaoPeek ConstructPsaoPeek(uint arg0, bool arg1) {
    PsaoPeek ret = (PsaoPeek)0;
    ret.cell = arg0;
    ret.last = arg1;
    return ret;
}

PsaoPeek psao_peek(bool wanted, uint bucket_2, uint key_3, uint entry)
{
    bool local_4 = (bool)0;
    bool local_5 = (bool)0;
    bool local_6 = (bool)0;

    if (!(wanted)) {
        const PsaoPeek psaopeek = ConstructPsaoPeek(0u, true);
        return psaopeek;
    }
    const uint4 _e13 = psao_load_bucket(((bucket_2 * 2u) + (entry >> 2u)));
    uint cell_5 = (_e13[(entry & 3u)] & PSAO_ENTRY_CELL);
    if ((cell_5 != 0u)) {
        const uint4 _e25 = psao_load_cell((cell_5 * 2u));
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
    const PsaoPeek psaopeek_1 = ConstructPsaoPeek((here_2 ? cell_5 : 0u), _e45);
    return psaopeek_1;
}

PsaoRound ConstructPsaoRound(uint3 arg0, bool arg1) {
    PsaoRound ret = (PsaoRound)0;
    ret.points = arg0;
    ret.more = arg1;
    return ret;
}

PsaoRound psao_round(uint cell_3, uint key_4, uint round_)
{
    bool local_7 = (bool)0;

    const uint4 _e8 = psao_load_cell(((cell_3 * 2u) + min(round_, 1u)));
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
    const PsaoRound psaoround = ConstructPsaoRound(uint3(a_3, b_3, c), (c != 0u));
    return psaoround;
}

float psao_share(float3 place_1)
{
    float3 inside_1 = ((1.0).xxx - abs((place_1 - (0.484375).xxx)));
    float3 sides_1 = clamp((inside_1 * 3.3333333), (0.0).xxx, (1.0).xxx);
    return ((sides_1.x * sides_1.y) * sides_1.z);
}

PsaoPoint ConstructPsaoPoint(float3 arg0, float3 arg1, float arg2, float arg3, float arg4) {
    PsaoPoint ret = (PsaoPoint)0;
    ret.place = arg0;
    ret.normal = arg1;
    ret.square = arg2;
    ret.openness = arg3;
    ret.seen = arg4;
    return ret;
}

PsaoPoint psao_point(uint point_3)
{
    int3 steps_1 = int3(((point_3).xxx & uint3(2031616u, 65011712u, 2080374784u)));
    float3 scale = float3(4.7683716e-7, 1.4901161e-8, 4.656613e-10);
    int2 codes_1 = int2((uint2((point_3 >> 8u), (point_3 >> 12u)) & (15u).xx));
    float2 uv_1 = (float2(min(codes_1, (int(14)).xx)) - (7.0).xx);
    float z_1 = ((7.0 - abs(uv_1.x)) - abs(uv_1.y));
    float fold = max(-(z_1), 0.0);
    float3 m = float3((uv_1 - ((uv_1 < (0.0).xx) ? (-(fold)).xx : (fold).xx)), z_1);
    float openness_2 = float(int((point_3 & 255u)));
    float lit_1 = min((openness_2 * 0.019607844), 1.0);
    float seen_2 = mad(lit_1, lit_1, PSAO_UNSEEN);
    const PsaoPoint psaopoint = ConstructPsaoPoint((float3(steps_1) * scale), m, mad(m.x, m.x, mad(m.y, m.y, (m.z * m.z))), openness_2, ((int(point_3) >= int(0)) ? 0.0 : seen_2));
    return psaopoint;
}

PsaoTwo ConstructPsaoTwo(float2 arg0, float2 arg1, float2 arg2) {
    PsaoTwo ret = (PsaoTwo)0;
    ret.x = arg0;
    ret.y = arg1;
    ret.z = arg2;
    return ret;
}

PsaoTwo psao_two(float3 a, float3 b)
{
    const PsaoTwo psaotwo = ConstructPsaoTwo(float2(a.x, b.x), float2(a.y, b.y), float2(a.z, b.z));
    return psaotwo;
}

float2 psao_dot_two(PsaoTwo a_1, PsaoTwo b_1)
{
    return mad(a_1.x, b_1.x, mad(a_1.y, b_1.y, (a_1.z * b_1.z)));
}

float2 psao_dot_each(PsaoTwo a_2, float3 b_2)
{
    return mad(a_2.x, (b_2.x).xx, mad(a_2.y, (b_2.y).xx, (a_2.z * b_2.z)));
}

PsaoSums ConstructPsaoSums(float2 arg0, float2 arg1) {
    PsaoSums ret = (PsaoSums)0;
    ret.weights = arg0;
    ret.openness = arg1;
    return ret;
}

PsaoSums psao_add(PsaoSums sums, PsaoSeen seen, uint word)
{
    const PsaoPoint _e3 = psao_point(word);
    float3 p = _e3.place;
    PsaoTwo d_3 = ConstructPsaoTwo(((p.x).xx - seen.place.x), ((p.y).xx - seen.place.y), ((p.z).xx - seen.place.z));
    const float2 _e23 = psao_dot_each(seen.normal, _e3.normal);
    float2 agree_1 = max(_e23, (0.0).xx);
    float2 agree2_1 = max((agree_1 * agree_1), ((0.010000001 * _e3.square)).xx);
    const float2 _e34 = psao_dot_two(seen.normal, d_3);
    const float2 _e36 = psao_dot_each(d_3, _e3.normal);
    float2 h2_ = max(((_e34 * _e34) * _e3.square), (_e36 * _e36));
    const float2 _e42 = psao_dot_two(d_3, d_3);
    float2 to_reach = (seen.inverse_radius2_ * -0.8333333);
    float2 in_reach_1 = max(mad(_e42, to_reach, (1.0).xx), (0.001).xx);
    float2 near = (mad(_e42, seen.inverse_radius2_, (0.5).xx) * _e3.square);
    float2 apart_1 = (mad(h2_, (PSAO_FLATNESS * seen.inverse_radius2_), near) * _e3.square);
    float2 ratio = ((agree2_1 * agree2_1) / apart_1);
    float2 weight_1 = (((seen.share * _e3.seen) * in_reach_1) * (ratio * ratio));
    const PsaoSums psaosums = ConstructPsaoSums((sums.weights + weight_1), mad(weight_1, (_e3.openness).xx, sums.openness));
    return psaosums;
}

PsaoSeen ConstructPsaoSeen(PsaoTwo arg0, PsaoTwo arg1, float2 arg2, float2 arg3) {
    PsaoSeen ret = (PsaoSeen)0;
    ret.normal = arg0;
    ret.place = arg1;
    ret.inverse_radius2_ = arg2;
    ret.share = arg3;
    return ret;
}

float2 psao_blend_fast(uint instance_6, float3 position_5, float3 normal_7)
{
    PsaoBlock block_3 = (PsaoBlock)0;
    uint entry_1 = 0u;
    uint left = (uint)0;
    PsaoSums sums_1 = ConstructPsaoSums((0.0).xx, (0.0).xx);
    uint round_1 = 0u;

    const PsaoGrid _e3 = psao_grid_fast(instance_6);
    const PsaoFragment _e4 = psao_fragment(_e3, position_5, normal_7);
    if (_e4.outside) {
        return float2(1.0, 0.0);
    }
    uint3 base_2 = uint3(_e4.base);
    const PsaoTable _e11 = psao_table(_e3, base_2);
    const uint _e12 = psao_within(_e3, base_2);
    const PsaoBlock _e13 = psao_block(_e11, _e12);
    block_3 = _e13;
    while(true) {
        uint _e18 = block_3.unsure;
        const uint _e19 = psao_lowest(_e18);
        const uint3 _e20 = psao_corner(_e19);
        const uint _e21 = psao_key(_e11, _e20);
        uint _e23 = block_3.unsure;
        const uint _e26 = psao_bucket(_e11, _e20);
        uint _e27 = entry_1;
        const PsaoPeek _e28 = psao_peek((_e23 != 0u), _e26, _e21, _e27);
        PsaoBlock _e29 = block_3;
        const PsaoBlock _e31 = psao_with(_e29, _e19, _e28.cell);
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
    const uint _e53 = psao_corners(_e52);
    left = _e53;
    float3 start = (_e4.place - (0.015625).xxx);
    float inverse_radius2_ = (1.0 / (_e3.radius * _e3.radius));
    while(true) {
        uint _e72 = left;
        const uint _e73 = psao_lowest(_e72);
        const uint3 _e74 = psao_corner(_e73);
        PsaoBlock _e75 = block_3;
        const uint _e76 = psao_cell_at(_e75, _e74);
        const uint _e77 = psao_key(_e11, _e74);
        uint _e78 = round_1;
        const PsaoRound _e79 = psao_round(_e76, _e77, _e78);
        float3 place_2 = (start - float3(int3(_e74)));
        const PsaoTwo _e86 = psao_two(_e4.normal, (0.0).xxx);
        const PsaoTwo _e89 = psao_two(place_2, (0.0).xxx);
        const float _e92 = psao_share(place_2);
        PsaoSeen seen_3 = ConstructPsaoSeen(_e86, _e89, float2(inverse_radius2_, 0.0), float2(_e92, 0.0));
        PsaoSums _e96 = sums_1;
        const PsaoSums _e99 = psao_add(_e96, seen_3, _e79.points.x);
        sums_1 = _e99;
        PsaoSums _e100 = sums_1;
        const PsaoSums _e103 = psao_add(_e100, seen_3, _e79.points.y);
        sums_1 = _e103;
        PsaoSums _e104 = sums_1;
        const PsaoSums _e107 = psao_add(_e104, seen_3, _e79.points.z);
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
    const float _e140 = psao_seen(openness_3);
    float near_1 = min((_e138 / (PSAO_NEAR * _e140)), 1.0);
    float _e151 = sums_1.weights.x;
    return ((_e151 > 0.0) ? float2(openness_3, near_1) : float2(1.0, 0.0));
}

float psao_planar_fast(uint instance_7, float3 position_6, float3 normal_8)
{
    const float2 _e3 = psao_blend_fast(instance_7, position_6, normal_8);
    return _e3.x;
}

float psao_over_baked(uint kernel, uint instance_8, float3 position_7, float3 normal_9, float baked, float share)
{
    float2 found = float2(1.0, 0.0);

    if ((share <= 0.0)) {
        return baked;
    }
    if ((kernel == PSAO_PAPER)) {
        const float2 _e15 = psao_blend(false, instance_8, position_7, normal_9);
        found = _e15;
    } else {
        const float2 _e16 = psao_blend_fast(instance_8, position_7, normal_9);
        found = _e16;
    }
    float _e18 = found.x;
    float _e20 = found.y;
    return lerp(baked, _e18, (_e20 * min(share, 1.0)));
}
