#!/usr/bin/env python3
"""Races `psao bake` against trimesh with Embree on the same points and the same definition.

    pip install trimesh embreex numpy
    psao bake SCENE --to points --density N --directions K --out baked.glb --json baked.json
    tests/bake_peer.py SCENE baked.glb baked.json

SCENE is rigid (trimesh does not skin) and has its triangles in floats. Both get the points of
baked.glb: cosine-weighted occlusion around their normals, either side of a triangle, rays without
end, stratified. The error of each is against 4096 of the peer's own rays on up to 512 of the
points. Run both on an otherwise idle machine: times are wall clocks, of all cores for psao and of
the one that trimesh uses.
"""

import json
import struct
import sys
import time

import numpy
import trimesh

SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
CHECKED = 512


def matrix(node):
    """A node's matrix, from whichever form it has."""
    if "matrix" in node:
        return numpy.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = trimesh.transformations.quaternion_matrix((w, x, y, z))
    scale = numpy.diag([*node.get("scale", (1, 1, 1)), 1])
    move = trimesh.transformations.translation_matrix(node.get("translation", (0, 0, 0)))
    return move @ turn @ scale


def points(path):
    """Positions and normals in the world, and occlusion, of all points in a baked .glb."""
    data = open(path, "rb").read()
    length = struct.unpack("<I", data[12:16])[0]
    root, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def floats(index):
        accessor = root["accessors"][index]
        view = root["bufferViews"][accessor["bufferView"]]
        width = SIZES[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = numpy.frombuffer(binary, "<f4", accessor["count"] * width, start)
        return values.reshape(-1, width).astype(float)

    found = []

    def walk(index, parent):
        node = root["nodes"][index]
        world = parent @ matrix(node)
        for primitive in root["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            if primitive.get("mode", 4) == 0 and "_OCCLUSION" in primitive["attributes"]:
                at, normal, value = (
                    floats(primitive["attributes"][name])
                    for name in ("POSITION", "NORMAL", "_OCCLUSION")
                )
                at = at @ world[:3, :3].T + world[:3, 3]
                normal = normal @ numpy.linalg.inv(world[:3, :3])
                normal /= numpy.linalg.norm(normal, axis=1, keepdims=True)
                found.append((at, normal, value[:, 0]))
        for child in node.get("children", ()):
            walk(child, world)

    for index in root["scenes"][root.get("scene", 0)]["nodes"]:
        walk(index, numpy.eye(4))
    return tuple(numpy.concatenate(part) for part in zip(*found))


def openness(mesh, at, normal, rays, seed):
    """The share of cosine-weighted rays that hit nothing: a jittered grid of them a point."""
    random = numpy.random.default_rng(seed)
    side = int(rays**0.5)
    lift = mesh.scale * 1e-6
    values = numpy.empty(len(at))
    grid = numpy.stack(numpy.meshgrid(range(side), range(side)), -1).reshape(-1, 2)
    # Some million rays at once, as trimesh likes them.
    batch = max(1, (1 << 20) // len(grid))
    for first in range(0, len(at), batch):
        n = normal[first : first + batch]
        u = (grid + random.random((len(n), len(grid), 2))) / side
        radius, angle = numpy.sqrt(u[..., 0]), 2 * numpy.pi * u[..., 1]
        helper = numpy.where(abs(n[:, :1]) > 0.5, [[0.0, 1, 0]], [[1.0, 0, 0]])
        x = numpy.cross(helper, n)
        x /= numpy.linalg.norm(x, axis=1, keepdims=True)
        y = numpy.cross(n, x)
        local = (radius * numpy.cos(angle), radius * numpy.sin(angle), numpy.sqrt(1 - u[..., 0]))
        directions = sum(a[..., None] * b[:, None] for a, b in zip(local, (x, y, n)))
        origins = numpy.repeat(at[first : first + batch] + n * lift, len(grid), 0)
        hit = mesh.ray.intersects_any(origins, directions.reshape(-1, 3))
        values[first : first + batch] = 1 - hit.reshape(len(n), -1).mean(1)
    return values


def main(scene, baked, report):
    mesh = trimesh.load(scene, process=False, skip_materials=True)
    mesh = mesh.to_geometry() if hasattr(mesh, "to_geometry") else mesh
    at, normal, value = points(baked)
    row = json.load(open(report))["rows"][0]
    picked = slice(None, None, -(-len(at) // CHECKED))
    reference = openness(mesh, at[picked], normal[picked], 4096, 1)

    def error(values):
        return 255 * numpy.sqrt(numpy.mean((values - reference) ** 2))

    print(f"{len(mesh.faces)} triangles, {len(at)} points")
    print(f"{'':8} {'rays':>6} {'seconds':>8} {'rmse/255':>8}")
    print(f"{'psao':8} {row['directions']:6} {row['seconds']:8.3f} {error(value[picked]):8.2f}")
    for rays in (16, 64, 256):
        began = time.perf_counter()
        values = openness(mesh, at, normal, rays, 0)
        seconds = time.perf_counter() - began
        print(f"{'trimesh':8} {rays:6} {seconds:8.3f} {error(values[picked]):8.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
