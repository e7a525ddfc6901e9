# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that read poses: quaternions or matrices, float32 or float64, and say which are no rigid transforms."""

from typing import Any

import warp as wp

from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.rays import FAR, OPTIONS, mat33, real, vec3

PENDING, APART, BY_POSE, WRAPPED, REFUSED, DEEP, OVERFULL = (wp.constant(n) for n in range(7))
wp.set_module_options(OPTIONS)


@wp.func
def _put(scratch: Scratch, skins: Skins, c: wp.int32, turn: mat33, place: vec3, sound: bool):
    """Writes a pose, the middle of its tool and a fresh status."""
    grid = skins.grids[scratch.grid[c]]
    scratch.status[c] = PENDING
    scratch.pose[c] = turn
    scratch.place[c] = place
    scratch.centre[c] = turn * ((grid.low + grid.high) / real(2.0)) + place
    scratch.wide[c] = 0
    scratch.count[c] = 0
    scratch.many[c] = 0
    scratch.sides[c] = 0
    scratch.nearest[c] = FAR
    scratch.around[c] = -FAR
    scratch.deep[c] = real(0.0)
    if not sound:
        scratch.status[c] = REFUSED


@wp.func
def _finite(x: vec3) -> bool:
    return wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])


@wp.kernel
def read_quaternions(poses: wp.array3d(dtype=Any), first: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Poses (n, K, 7), place and quaternion x, y, z, w."""
    c = wp.tid()
    s, k = first + c // many, c % many
    place = vec3(real(poses[s, k, 0]), real(poses[s, k, 1]), real(poses[s, k, 2]))
    turn = wp.quatd(real(poses[s, k, 3]), real(poses[s, k, 4]), real(poses[s, k, 5]), real(poses[s, k, 6]))
    size = wp.length(turn)
    sound = _finite(place) and wp.isfinite(size) and wp.abs(size - real(1.0)) < real(1e-3)
    if sound:
        _put(scratch, skins, c, wp.quat_to_matrix(turn / size), place, True)
    else:
        _put(scratch, skins, c, wp.identity(n=3, dtype=real), vec3(), False)


@wp.kernel
def read_matrices(poses: wp.array4d(dtype=Any), first: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Poses (n, K, 4, 4)."""
    c = wp.tid()
    s, k = first + c // many, c % many
    turn, place, sound = mat33(), vec3(), wp.bool(True)
    for i in range(3):
        place[i] = real(poses[s, k, i, 3])
        for j in range(3):
            turn[i, j] = real(poses[s, k, i, j])
            sound = sound and wp.isfinite(turn[i, j])
        sound = sound and wp.isfinite(place[i]) and wp.abs(real(poses[s, k, 3, i])) <= real(1e-4)
    sound = sound and wp.abs(real(poses[s, k, 3, 3]) - real(1.0)) <= real(1e-4)
    if sound:
        product = turn * wp.transpose(turn)
        for i in range(3):
            for j in range(3):
                wanted = real(0.0)
                if i == j:
                    wanted = real(1.0)
                sound = sound and wp.abs(product[i, j] - wanted) <= real(1e-4)
        sound = sound and wp.determinant(turn) > real(0.0)
    if sound:
        _put(scratch, skins, c, turn, place, True)
    else:
        _put(scratch, skins, c, wp.identity(n=3, dtype=real), vec3(), False)


for one in (wp.float32, wp.float64):
    wp.overload(read_quaternions, {"poses": wp.array3d(dtype=one)})
    wp.overload(read_matrices, {"poses": wp.array4d(dtype=one)})
