"""Conform: moves an answer so that skin that is touched lies on its tool, and none lies inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Points, Transform, VertexVectors
from stmpl_core.columns import grid_of
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.rays import depth_in_column, distance_in_column, ray_of, to_tool, wall_in
from stmpl_core.sdf import FAST, jet_at
from stmpl_core.touch import Pressed, Touch, way_of

MIN_LYING_PRESSURE = 0.05  # pressure over the tool's highest, below which a covered vertex may be apart from the tool
BEYOND = 0.05  # way that skin under a tool may go beyond it, over its way
FIRM_DEPTH = 0.013  # depth in a tool over the thickness, from which skin is moved out with its neighbours, not alone
MIN_FACING_COSINE = 0.3  # cosine between tool's way and inward normal, from which skin comes along
LEAST_WEIGHT = 1e-3  # firmness from which a correction counts: one that falls to 0 lets go of its vertex continuously
PUSHES = 5  # steps of a vertex out of a tool, at most
LEFT_DEPTH = 1e-3  # depth over the thickness that a step may leave, or another one follows
FURTHER = 4.0  # most that a step out of several tools is longer than the mean of what each of them asks for
RIVAL = 0.8  # way of skin with a tool over its longest with any, from which that tool has a say where several cover it
PASSES = 3  # corrections of one answer
LEFT_SHARE = 1e-4  # share of what is wanted that one of these passes may leave: the next asks for it again
ITERATIONS, BACK = 40, 2  # most steps of its linear solver, and how many steps before each is held against
SMOOTHING_SHARE = 0.05  # ridge over the sinking of a vertex under its own source: it keeps neighbours from fighting


class Conformed(NamedTuple):
    """An answer that fits its tools.

    Args:
        displacement: displacement that fits, (V, 3) [m].
        corrected: largest correction of a vertex under a tool [m].
        entered: largest depth of a vertex inside a tool that is left [m].
    """

    displacement: VertexVectors
    corrected: float
    entered: float


class _Tool(NamedTuple):
    grid: tuple[np.ndarray, np.ndarray, float, float]
    pose: np.ndarray
    vertices: np.ndarray
    gone: Points  # way of the vertices with the tool if they lie on it, (N, 3) [m]
    lies: np.ndarray  # share from 0, may be apart, to 1, lies on the tool, (N,)


def conform(layer: SoftLayer, near: Surroundings, displacement: VertexVectors, touches: Sequence[Touch]) -> Conformed:
    """Moves the skin under tools onto them, and the skin around them along as a bonded layer would.

    What presses is known as pressures, what they do is a method's answer; but under a rigid tool the motion is known
    better than any method can say it: the skin has come along with the tool that it sticks to, and does not enter it.
    Under each tool the answer is moved onto the tool along the tool's way: the force where there is one, else the mean
    contact normal, and each vertex's own where the tool closes around the limb. The correction is spread by the linear
    response of the layer (interpolation with its Green's function as kernel).

    Args:
        layer: soft layer at rest.
        near: neighbours of its vertices.
        displacement: a method's answer, (V, 3) [m].
        touches: touches of all contacts.
    """
    tools = [_tool(touch, touch.pressed, layer) for touch in touches if touch.pressed is not None]
    if not tools:
        return Conformed(displacement, 0.0, 0.0)
    under = tools[0].vertices if len(tools) == 1 else np.unique(np.concatenate([tool.vertices for tool in tools]))
    places = [np.searchsorted(under, tool.vertices) for tool in tools]
    sinking, rest = near.sinking(under), layer.vertices[under]
    firm, moved, sources = FIRM_DEPTH * layer.thickness[under], displacement[under], np.zeros((len(under), 3))
    lying = np.zeros(len(under))  # share to which each lies on any tool
    for tool, at in zip(tools, places, strict=True):
        lying[at] = np.maximum(lying[at], tool.lies)
    says = [1 - (1 - first) * lying[at] for first, at in zip(_firsts(tools, places), places, strict=True)]
    for _ in range(PASSES):
        wanted, weight, said = np.zeros((len(under), 3)), np.zeros(len(under)), np.zeros(len(under))
        for tool, at, say in zip(tools, places, says, strict=True):
            _want(tool.grid, tool.pose, rest, moved, at, tool.gone, tool.lies, say, firm, wanted, weight, said)
        if not _correct(sinking, wanted, weight, moved, sources):
            break
    out = displacement.copy()
    near.spread(under, sources, out)
    entered = _push_out(layer, touches, out)
    return Conformed(out, _furthest(displacement, out, under), entered)


def laid_on(layer: SoftLayer, displacement: VertexVectors, touches: Sequence[Touch]) -> Conformed:
    """The answer with the skin that is touched moved along its tool's way onto it; the skin around it stays."""
    out, tools = displacement.copy(), [_tool(touch, touch.pressed, layer) for touch in touches if touch.pressed]
    shares = [first * tool.lies for first, tool in zip(_firsts(tools, [t.vertices for t in tools]), tools, strict=True)]
    if len(tools) > 1:
        total = np.zeros(len(out))
        for tool, share in zip(tools, shares, strict=True):
            total[tool.vertices] += share
        shares = [share / np.maximum(total[tool.vertices], 1) for tool, share in zip(tools, shares, strict=True)]
    for tool, share in zip(tools, shares, strict=True):
        _lay(tool.vertices, tool.gone, share, displacement, out)
    return _pushed_out(layer, displacement, touches, out)


def kept_out(layer: SoftLayer, displacement: VertexVectors, touches: Sequence[Touch]) -> Conformed:
    """The answer with the skin that is inside a tool on its surface: where all else lies on the tool already."""
    return _pushed_out(layer, displacement, touches, displacement.copy())


def _pushed_out(layer: SoftLayer, before: VertexVectors, touches: Sequence[Touch], out: VertexVectors) -> Conformed:
    """What came of an answer, with the skin that is inside a tool on its surface."""
    entered = _push_out(layer, touches, out)
    under = [touch.pressed.squeeze.vertices for touch in touches if touch.pressed is not None]
    return Conformed(out, max((_furthest(before, out, some) for some in under), default=0.0), entered)


def no_further(layer: SoftLayer, motion: VertexVectors, displacement: VertexVectors, touches: Sequence[Touch]
               ) -> VertexVectors:  # fmt: skip
    """An answer on a stack, in which no tool's skin goes further than the tool by more than BEYOND.

    The linear motion of skin that sticks lies on its tools, and a method adds to it what is not linear. Where that goes
    through a tool, as of small tools on thick tissue and fine meshes, less is added everywhere.

    Args:
        layer: soft layer at rest.
        motion: linear motion (stmpl_core.stick), (V, 3) [m].
        displacement: a method's answer, (V, 3) [m].
        touches: touches of all contacts.
    """
    share = 1.0
    for touch in touches:
        if touch.pressed is None or touch.pressure is None:
            continue
        v = np.flatnonzero(touch.pressure > MIN_LYING_PRESSURE * touch.pressure.max())
        way = way_of(touch, touch.pressed, -layer.normals[v], float(touch.pressure @ layer.vertex_areas))
        goes, went = (float(np.einsum("nx,nx->n", each[v], way).max(initial=0.0)) for each in (motion, displacement))
        if went > (1 + BEYOND) * goes:
            share = min(share, BEYOND * goes / (went - goes))
    return motion + share * (displacement - motion) if share < 1 else displacement


def _push_out(layer: SoftLayer, touches: Sequence[Touch], out: VertexVectors) -> float:
    """Moves what is left inside tools straight out; the largest depth that is left [m].

    What several tools touch goes out of all at once, so that it does not matter which comes first.
    """
    tools = [(grid_of(touch.pressed.field), touch.pose_body_from_tool, touch.pressed.squeeze.vertices)
             for touch in touches if touch.pressed is not None]  # fmt: skip
    shared = np.empty(0, np.int64)
    if len(tools) > 1:
        vertices, many = np.unique(np.concatenate([v for *_, v in tools]), return_counts=True)
        shared = vertices[many > 1]
    alone = [np.setdiff1d(v, shared, assume_unique=True) if len(shared) else v for *_, v in tools]
    entered = max((_pushed(grid, pose, layer.vertices, layer.thickness, some, out)
                   for (grid, pose, _), some in zip(tools, alone, strict=True)), default=0.0)  # fmt: skip
    return max(entered, _pushed_together(layer, tools, shared, out)) if len(shared) else entered


def _pushed_together(layer: SoftLayer, tools: Sequence[tuple[Any, Transform, np.ndarray]], shared: np.ndarray,
                     out: VertexVectors) -> float:  # fmt: skip
    """Moves what several tools touch straight out of all of them; the largest depth that is left [m].

    Args:
        layer: soft layer at rest.
        tools: grid, pose_body_from_tool and touched vertices of each, rising.
        shared: vertices that more than one touches, rising.
        out: displacement, (V, 3) [m].
    """
    places = [np.searchsorted(shared, np.intersect1d(v, shared, assume_unique=True)) for *_, v in tools]
    rest, moved, thickness, left = layer.vertices[shared], out[shared], layer.thickness[shared], 0.0
    for push in range(PUSHES + 1):
        sums = np.zeros((len(shared), 6))
        for (grid, pose, _), at in zip(tools, places, strict=True):
            _ask_out(grid, pose, rest, moved, at, sums)
        left = float(sums[:, 5].max())
        if push == PUSHES or not _step_out(sums, LEFT_DEPTH * thickness if push else np.zeros(len(shared)), moved):
            break
    out[shared] = moved
    return left


def _firsts(tools: Sequence[_Tool], places: Sequence[np.ndarray]) -> list[np.ndarray]:
    """How much of a say each tool has where skin that lies on it goes, from 0, another takes it further, to 1, (N,).

    places: its vertices among those of all tools.
    """
    if len(tools) < 2:
        return [np.ones(len(tool.lies)) for tool in tools]
    ways = [tool.lies * np.linalg.norm(tool.gone, axis=1) for tool in tools]
    most = np.zeros(1 + max(int(at.max(initial=0)) for at in places))
    for way, at in zip(ways, places, strict=True):
        most[at] = np.maximum(most[at], way)
    return [np.clip((way / np.maximum(most[at], 1e-300) - RIVAL) / (1 - RIVAL), 0, 1)
            for way, at in zip(ways, places, strict=True)]  # fmt: skip


def _tool(touch: Touch, pressed: Pressed, layer: SoftLayer) -> _Tool:
    assert touch.pressure is not None
    grid, (v, depth, rests, *_) = grid_of(pressed.field), pressed.squeeze
    pressure, inward = touch.pressure[v], -layer.normals[v]
    way = way_of(touch, pressed, inward, float(pressure @ layer.vertex_areas[v]))
    pose, gone, lies = touch.pose_body_from_tool, np.zeros((len(v), 3)), np.empty(len(v))
    _lie(grid, pose, layer.vertices[v], inward, way, layer.thickness[v], depth, rests, pressure, gone, lies)
    return _Tool(grid, pose, v, gone, lies)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lie(grid, pose, points, inward, way, thickness, depth, rests, pressure, gone, lies):
    """Writes how far vertices lie on a tool and where they have gone then; see _Tool."""
    light = MIN_LYING_PRESSURE * pressure.max()
    for n in range(len(points)):
        cosine = inward[n, 0] * way[n, 0] + inward[n, 1] * way[n, 1] + inward[n, 2] * way[n, 2]
        if rests[n] == 0 or not cosine > MIN_FACING_COSINE:
            lies[n] = 0.0
            continue
        guess, ray, wall = depth[n] / cosine, ray_of(pose, points, way, n), wall_in(grid[3], thickness[n])
        along = _clipped(-2 * distance_in_column(grid, ray, 0.5 * guess) / wall)  # a way may lead out of a wall at once
        faces = _clipped((cosine - MIN_FACING_COSINE) / 0.1)
        lies[n] = min(rests[n], along) * _clipped(pressure[n] / light - 0.5) * faces
        if lies[n] == 0:
            continue
        far = depth_in_column(grid, ray, 4 * guess, guess, 0.0)
        sure = _clipped(2 * lies[n] - 1)  # beside a wall it is not clear where the way ends
        for x in range(3):
            gone[n, x] = (sure * far + (1 - sure) * guess) * way[n, x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lay(vertices, gone, lies, before, out):
    """Moves vertices along the way that they have gone with a tool by their share of what was missing before."""
    for n in range(len(vertices)):
        v, size, missing = vertices[n], 0.0, 0.0
        for x in range(3):
            size += gone[n, x] ** 2
            missing += gone[n, x] * (gone[n, x] - before[v, x])
        for x in range(3 if size > 0 else 0):
            out[v, x] += lies[n] * missing / size * gone[n, x]


@numba.njit(inline="always")
def _clipped(x):
    return min(max(x, 0.0), 1.0)


@numba.njit(inline="always")
def _jet(grid, pose, rest, moved):
    """Signed distance of a point that has moved to a tool [m], and its gradient: four numbers."""
    x, y, z = to_tool(pose, rest[0] + moved[0], rest[1] + moved[1], rest[2] + moved[2])
    phi, a, b, c = jet_at(grid[0], grid[1], grid[2], x, y, z)
    return (phi, pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c, pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c,
            pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c)  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _want(grid, pose, rest, moved, places, gone, lies, say, firm, wanted, weight, said):
    """Writes how the vertices under a tool, at places, should still move [m], and how firmly: 0, need not, to 1.

    Where other tools want something too it is the mean, by how firmly each does and by its say there, which are summed.
    """
    for n in range(len(places)):
        k = places[n]
        phi, a, b, c = _jet(grid, pose, rest[k], moved[k])
        firmly = max(lies[n], _clipped(-phi / firm[k]))
        weight[k] = max(weight[k], firmly)
        if firmly * say[n] > 0:
            said[k] += firmly * say[n]
            share, out = firmly * say[n] / said[k], -(1 - lies[n]) * min(phi, 0.0)
            wanted[k, 0] += share * (lies[n] * (gone[n, 0] - moved[k, 0]) + out * a - wanted[k, 0])
            wanted[k, 1] += share * (lies[n] * (gone[n, 1] - moved[k, 1]) + out * b - wanted[k, 1])
            wanted[k, 2] += share * (lies[n] * (gone[n, 2] - moved[k, 2]) + out * c - wanted[k, 2])


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _correct(sinking, wanted, weight, moved, sources):
    """Moves vertices as is wanted, with those around them, and adds up the sources that do so; False: none is.

    Solves (sinking + ridge) x = wanted by conjugate residuals with the diagonal as preconditioner. The matrix is not
    quite symmetric: each way is held against the BACK before it (Orthomin: Vinsome, SPE 5729, 1976).
    """
    count, own, active = len(weight), np.float32(0), False
    for n in range(count):
        own += np.float32(SMOOTHING_SHARE) * sinking[n, n] / np.float32(count)
    left, ridge, per = np.zeros((3, count), np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    for n in range(count):
        if weight[n] > LEAST_WEIGHT:
            active, ridge[n] = True, own / np.float32(weight[n]) ** 2
            per[n] = np.float32(1) / (sinking[n, n] + ridge[n])
            for x in range(3):
                left[x, n] = wanted[n, x]
    if not active:
        return False
    ways = np.zeros((BACK + 1, 3, count), np.float32)
    sinks, images = np.zeros_like(ways), np.zeros_like(ways)
    step, sunk, squares = np.zeros_like(left), np.zeros_like(left), np.ones(BACK + 1, np.float32)
    enough = np.float32(LEFT_SHARE) ** 2 * _dot(left, left)
    for k in range(ITERATIONS):
        if _dot(left, left) <= enough:
            break
        at = k % (BACK + 1)
        _follow(sinking, left, per, ridge, ways[at], sinks[at], images[at])
        for other in range(min(k, BACK + 1)):
            if other != at:
                share = -_dot(images[at], images[other]) / squares[other]
                _add(share, ways[other], ways[at])
                _add(share, sinks[other], sinks[at])
                _add(share, images[other], images[at])
        squares[at] = _dot(images[at], images[at])
        share = _dot(left, images[at]) / squares[at]
        _add(share, ways[at], step)
        _add(share, sinks[at], sunk)
        _add(-share, images[at], left)
    for n in range(count):
        for x in range(3):
            sources[n, x] += step[x, n]
            moved[n, x] += sunk[x, n]
    return True


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _follow(sinking, left, per, ridge, way, sinks, image):
    """Writes the preconditioned residual, how vertices sink by it, and its image under the matrix, (3, N) each."""
    for x in range(3):
        for n in range(len(per)):
            way[x, n] = per[n] * left[x, n]
    for n in range(len(per)):
        a = b = c = np.float32(0)
        for m in range(len(per)):
            a += sinking[n, m] * way[0, m]
            b += sinking[n, m] * way[1, m]
            c += sinking[n, m] * way[2, m]
        sinks[0, n], sinks[1, n], sinks[2, n] = a, b, c
    for x in range(3):
        for n in range(len(per)):
            image[x, n] = sinks[x, n] + ridge[n] * way[x, n] if per[n] > 0 else np.float32(0)


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _dot(one, other):
    total = np.float32(0)
    for x in range(3):
        for n in range(one.shape[1]):
            total += one[x, n] * other[x, n]
    return total


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _add(share, more, to):
    for x in range(3):
        for n in range(to.shape[1]):
            to[x, n] += share * more[x, n]


@numba.njit(cache=True, nogil=True)
def _pushed(grid, pose, points, thickness, vertices, out):
    """Moves vertices that are inside a tool straight out of it; the largest depth that is left [m]."""
    entered = 0.0
    for v in vertices:
        phi, a, b, c = _jet(grid, pose, points[v], out[v])
        for push in range(PUSHES):  # one is enough where the gradient is 1 long; between walls it is shorter
            if phi >= (-LEFT_DEPTH * thickness[v] if push else 0.0):
                break
            out[v, 0], out[v, 1], out[v, 2] = out[v, 0] - phi * a, out[v, 1] - phi * b, out[v, 2] - phi * c
            phi, a, b, c = _jet(grid, pose, points[v], out[v])
        entered = max(entered, -phi)
    return entered


@numba.njit(cache=True, nogil=True)
def _ask_out(grid, pose, rest, moved, places, sums):
    """Adds what a tool asks of the vertices at places that are inside it; see _step_out."""
    for k in places:
        phi, a, b, c = _jet(grid, pose, rest[k], moved[k])
        if phi < 0:
            sums[k, 0] -= phi
            sums[k, 1] += phi * phi * a
            sums[k, 2] += phi * phi * b
            sums[k, 3] += phi * phi * c
            sums[k, 4] -= phi**3 * (a * a + b * b + c * c)
            sums[k, 5] = max(sums[k, 5], -phi)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_out(sums, leave, moved):
    """Moves vertices (N, 3) out of several tools at once by parallel projections; False: none is deeper than leave.

    The mean of their ways out, by depth, is made so long that it is right where each is a half space: Pierra (1984).

    sums: of the tools that a vertex is inside, sum of depths [m], of ways out by depth (3) [m2], of these ways' squares
    by depth [m3], and the largest depth [m], (N, 6).
    """
    many = 0
    for n in range(len(sums)):
        if sums[n, 5] <= leave[n]:
            continue
        many += 1
        square = sums[n, 1] ** 2 + sums[n, 2] ** 2 + sums[n, 3] ** 2
        longer = min(sums[n, 4] * sums[n, 0] / max(square, 1e-300), FURTHER)
        for x in range(3):
            moved[n, x] += longer * sums[n, 1 + x] / sums[n, 0]
    return many > 0


@numba.njit(cache=True, nogil=True)
def _furthest(one, other, vertices):
    """Largest distance between two motions of vertices [m]."""
    most = 0.0
    for v in vertices:
        square = 0.0
        for x in range(3):
            square += (other[v, x] - one[v, x]) ** 2
        most = max(most, square)
    return np.sqrt(most)
