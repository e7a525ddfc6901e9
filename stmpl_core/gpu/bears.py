# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernel of what the memory of skin takes of each contact as a whole: see stmpl_core.stepped.PATCH."""

import warp as wp

from stmpl_core import footing
from stmpl_core.gpu.answers import NONE, PI, _power
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import BY_POSE
from stmpl_core.gpu.rays import OPTIONS, mat33, real, vec3
from stmpl_core.toucher import STIFFER as STIFFER_BY_DEPTH

EDGE_SHARE, STIFFER = wp.constant(wp.float64(footing.EDGE_SHARE)), wp.constant(wp.float64(STIFFER_BY_DEPTH))
wp.set_module_options(OPTIONS)


@wp.func
def _sunk(scratch: Scratch, s: wp.int32, i: wp.int32, stacked: wp.int32) -> real:
    """How deep a node has sunk [m]."""
    depth = scratch.strain[s, i] * scratch.thick[s, i]
    if stacked == 1:
        depth = scratch.sinking[s, i]
    return depth


@wp.func
def _wrapped_in(scratch: Scratch, s: wp.int32, k: wp.int32, stacked: wp.int32, middle: vec3, normal: vec3,
                total: real) -> tuple[mat33, real]:  # fmt: skip
    """footing.wrapped_in of a tool's nodes in a scene."""
    deep, up_mean, square_mean, both, fourth = real(0.0), real(0.0), real(0.0), real(0.0), real(0.0)
    out = mat33()
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            share = scratch.pressure[s, i] * scratch.area[s, i] / total
            deep += share * _sunk(scratch, s, i, stacked)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            share = scratch.pressure[s, i] * scratch.area[s, i] / total
            away = scratch.point[s, i] - middle
            up = wp.dot(away, normal)
            away = away - up * normal
            up += _sunk(scratch, s, i, stacked) - deep
            square = wp.length_sq(away) + up * up
            out = out + share * wp.outer(away, away)
            up_mean += share * up
            square_mean += share * square
            both += share * up * square
            fourth += share * square * square
    spread = fourth - square_mean * square_mean
    bend = real(0.0)
    if spread > real(0.0):
        bend = real(2.0) * (both - up_mean * square_mean) / spread
    return out, bend * bend / (real(1.0) + bend * bend * square_mean)


@wp.kernel
def bear(first: wp.int32, many: wp.int32, gives: wp.array(dtype=mat33), bends: wp.array(dtype=mat33), skins: Skins,
         scratch: Scratch, wrenches: wp.array3d(dtype=real), depths: wp.array2d(dtype=real),
         bounds: wp.array2d(dtype=real), in_range: wp.array2d(dtype=wp.bool), statuses: wp.array2d(dtype=wp.int32),
         out: wp.array3d(dtype=real)):  # fmt: skip
    """What each contact is as a whole: footing.patch_of, curvature_at and wrapped_in, green._give_at.

    Args:
        first: number of the part's first scene.
        gives, bends: by vertex, how a contact there gives along the skin [m/N] and the skin's curvature [1/m]; empty
            where nothing rubs.
        wrenches, depths, bounds, in_range, statuses: what WarpTouches tells.
        out: rows of PATCH, (n, K, .).
    """
    c = wp.tid()
    s, k = c // many, c % many
    n, pose = first + s, scratch.pose[c]
    for x in range(3):
        out[n, k, 48 + x] = scratch.place[c][x]
        for y in range(3):
            out[n, k, 39 + 3 * x + y] = pose[x, y]
    for x in range(6):
        out[n, k, x] = wrenches[n, k, x]
    out[n, k, 6] = bounds[n, k]
    out[n, k, 7] = real(0.0)
    if in_range[n, k]:
        out[n, k, 7] = real(1.0)
    out[n, k, 8] = real(statuses[n, k])
    out[n, k, 9] = depths[n, k]
    if statuses[n, k] != BY_POSE:
        return
    one = skins.one[scratch.skin[c]]
    middle, total, squares, thick, energy, area = vec3(), real(0.0), real(0.0), real(0.0), real(0.0), real(0.0)
    push, plain = vec3(), vec3()
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            force, own = scratch.pressure[s, i] * scratch.area[s, i], scratch.area[s, i]
            energy += real(0.5) * force * _sunk(scratch, s, i, one.stacked)
            total += force
            squares += force * force / own
            thick += force * scratch.thick[s, i]
            plain = plain + force * scratch.point[s, i]
            if force > real(0.0):
                area += own
            corners = skins.faces[scratch.face[s, i]]
            for x in range(3):
                push = push - force * scratch.shares[s, i][x] / skins.area[corners[x]] * skins.area_vectors[corners[x]]
    middle = plain / wp.max(total, NONE)
    normal = wp.normalize(vec3(out[n, k, 0], out[n, k, 1], out[n, k, 2]))
    full, size, lever = EDGE_SHARE * squares / wp.max(total, NONE), real(0.0), real(0.0)
    give, bend = mat33(), mat33()
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            force = scratch.pressure[s, i] * scratch.area[s, i]
            size += wp.min(scratch.area[s, i], force / wp.max(full, NONE))
            away = scratch.point[s, i] - middle
            up = wp.dot(away, normal)
            lever += force * wp.sqrt(wp.max(wp.length_sq(away) - up * up, real(0.0)))
            if gives.shape[0] > 0:
                trio = skins.faces[scratch.face[s, i]]
                for x in range(3):
                    share = force / wp.max(total, NONE) * scratch.shares[s, i][x]
                    give = give + share * gives[trio[x]]
                    bend = bend + share * bends[trio[x]]
    if gives.shape[0] > 0:
        spread, sines = _wrapped_in(scratch, s, k, one.stacked, middle, normal, wp.max(total, NONE))
        out[n, k, 84] = sines
        for x in range(3):
            for y in range(3):
                out[n, k, 75 + 3 * x + y] = spread[x, y]
    radius = wp.sqrt(size / PI)
    out[n, k, 10] = one.modulus * total
    for x in range(3):
        out[n, k, 11 + x] = middle[x]
        for y in range(3):
            out[n, k, 21 + 3 * x + y] = give[x, y]
            out[n, k, 30 + 3 * x + y] = bend[x, y]
    out[n, k, 14] = radius
    out[n, k, 15] = wp.max(lever / wp.max(total, NONE), real(0.1) * radius)
    out[n, k, 16] = thick / wp.max(total, NONE)
    out[n, k, 17] = one.modulus * energy
    out[n, k, 18] = STIFFER * _power(scratch, s, k)
    felt = wp.length(vec3(out[n, k, 0], out[n, k, 1], out[n, k, 2]))
    out[n, k, 19] = wp.max(real(1.0) - one.modulus * wp.length(push) / wp.max(felt, NONE), real(0.0))
    out[n, k, 20] = wp.sqrt(area / PI)
