// Rays by the device's own ray queries, in place of trees.wgsl.
enable wgpu_ray_query;

// An instance a body; its number is 1 for what moves.
@group(0) @binding(1) var bodies: acceleration_structure;

fn is_occluded(origin: vec3<f32>, direction: vec3<f32>, t_max: f32) -> bool {
    var query: ray_query;
    let flags = RAY_FLAG_TERMINATE_ON_FIRST_HIT;
    rayQueryInitialize(&query, bodies, RayDesc(flags, 0xffu, 0.0, t_max, origin, direction));
    // Stops only at triangles of bodies with masks: the device asks whether each counts.
    while rayQueryProceed(&query) {
        let found = rayQueryGetCandidateIntersection(&query);
        let before = select(0u, trees.fixed_triangles, found.instance_custom_data == 1u);
        let at = found.barycentrics;
        if !is_hole(before + found.primitive_index, at.x, at.y) {
            rayQueryConfirmIntersection(&query);
        }
    }
    return rayQueryGetCommittedIntersection(&query).kind != RAY_QUERY_INTERSECTION_NONE;
}
