"""Stick: how the skin of a limb moves when what a tool touches sticks to it, in the linear response."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from stmpl_core.arrays import VertexVectors
from stmpl_core.columns import grid_of
from stmpl_core.green import ONE_WAY, Green
from stmpl_core.nodes import Nodes
from stmpl_core.obstacle import solve
from stmpl_core.rays import depth_in_column, distance_in_column, ray_of, sure_of, wall_in
from stmpl_core.touch import Pressed, Touch, way_of
from stmpl_core.twins import NO_TWINS, Twins, twins

FIRM = 0.1  # pressure over its mean, weighed with itself, from which a node is held where its tool is
LEAVES = 0.5  # slope of the distance where a way leaves a tool from which it is clear where: not along a wall
FURTHEST = 1.5  # way of a node over its depth along the tool's way


def stuck_motion(green: Green, touches: Sequence[Touch], loaded: np.ndarray | None = None) -> VertexVectors:
    """Motion of the skin under tools that press, (V, 3) [m].

    The nodes that press, in the linear problem without friction, go with their tools in all directions, and the forces
    that this takes move the rest of the skin. So the motion follows from the pose, not from the pressure: it depends
    little on how tissue stiffens.

    Args:
        green: response of the layer.
        touches: touches of the tools.
        loaded: vertices on which they press, (L,); None: those around the nodes.
    """
    pressed = [(touch, touch.pressed) for touch in touches if touch.pressed is not None]
    nodes = Nodes.joined([one.squeeze.nodes for _, one in pressed])
    group = green.near.groups(nodes.corners[:, 0])
    ways = [_gone(touch, one, green.layer.vertex_areas) for touch, one in pressed]
    gone, sure = np.concatenate([way for way, _ in ways]), np.concatenate([held for _, held in ways])
    if green.layer.stacked:
        forces, _ = solve(green.matrix(nodes, group), nodes.sinking)
    else:
        forces = np.concatenate([one.forces for _, one in pressed if one.forces is not None])
        forces /= green.layer.tissue.youngs_modulus
    holds = np.flatnonzero(forces > 0)
    if not len(holds):
        return np.zeros_like(green.layer.vertices)
    some = nodes.some(holds)
    guess = None if green.layer.stacked else forces[holds, None] * some.inward
    same = NO_TWINS
    if len(pressed) > 1:
        of = np.repeat(np.arange(len(pressed)), [len(one.squeeze.nodes.area) for _, one in pressed])
        same = Twins(*twins(some.points, some.inward, some.area, group[holds], of[holds]))
    firm = _firm(forces[holds], some.area) * sure[holds]
    return green.motion(some, green.stuck(some, group[holds], gone[holds], guess, same, firm), loaded=loaded)


def _firm(forces: np.ndarray, area: np.ndarray) -> np.ndarray:
    """How firmly nodes that press with forces above 0, (N,), are held, from 0 to 1: none lets go with a jump."""
    mean = float(forces @ (forces / area)) / float(forces.sum())
    return np.minimum(forces / area / (FIRM * mean), 1.0)


def _gone(touch: Touch, pressed: Pressed, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Way of a tool's nodes with it, if they stick, (N, 3) [m]; and how sure it is, from 0 to 1, that they do, (N,)."""
    nodes = pressed.squeeze.nodes
    assert touch.pressure is not None
    way = way_of(touch, pressed, nodes.inward, float(touch.pressure @ areas))
    return _along(grid_of(pressed.field), touch.pose_body_from_tool, nodes.points, nodes.inward, way, nodes.depths,
                  nodes.thickness)  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _along(grid, pose, points, inward, way, sinking, thickness):
    """Way of nodes (N, 3) along unit vectors (N, 3) out of a tool, where their skin sinks by (N,), (N, 3) [m]."""
    out, held = np.empty((len(points), 3)), np.empty(len(points))
    for n in range(len(points)):
        cosine = inward[n, 0] * way[n, 0] + inward[n, 1] * way[n, 1] + inward[n, 2] * way[n, 2]
        depth = sinking[n] / max(cosine, ONE_WAY)
        ray = ray_of(pose, points, way, n)
        far = min(depth_in_column(grid, ray, 4 * depth, depth, 0.0), FURTHEST * depth)
        wall = wall_in(grid[3], thickness[n])
        leaves = (distance_in_column(grid, ray, far) - distance_in_column(grid, ray, far - wall)) / wall
        sure, _, _ = sure_of(grid, ray, depth, wall)
        far = depth + min(max(sure, 0.0), max(leaves / LEAVES, 0.0), 1.0) * (far - depth)
        held[n] = 1 + min(sure, 0.0)
        for x in range(3):
            out[n, x] = far * way[n, x]
    return out, held
