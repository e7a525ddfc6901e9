"""Conform: moves an answer so that skin that is touched lies on its tool, and none lies inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stmpl_core.arrays import Points, VertexVectors
from stmpl_core.columns import depth_along
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.sdf import SignedDistance
from stmpl_core.touch import Pressed, Touch, way_of

MIN_LYING_PRESSURE = 0.05  # pressure over the tool's highest, below which a covered vertex may be apart from the tool
FIRM_DEPTH = 0.013  # depth in a tool over the thickness, from which skin is moved out with its neighbours, not alone
MIN_FACING_COSINE = 0.3  # cosine between tool's way and inward normal, from which skin comes along
PASSES = 3  # corrections of one answer
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
    field: SignedDistance
    pose: np.ndarray
    vertices: np.ndarray
    gone: Points  # way of the vertices with the tool if they lie on it, (N, 3) [m]
    lies: np.ndarray  # share from 0, may be apart, to 1, lies on the tool, (N,)
    firm: np.ndarray  # FIRM_DEPTH, (N,) [m]


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
    all_of = np.unique(np.concatenate([tool.vertices for tool in tools]))
    place = [np.searchsorted(all_of, tool.vertices) for tool in tools]
    sinking = near.sinking(all_of).astype(float)
    own = SMOOTHING_SHARE * float(np.diag(sinking).mean())
    moved, sources = displacement[all_of], np.zeros((len(all_of), 3))
    for _ in range(PASSES):
        wanted, weight = np.zeros((len(all_of), 3)), np.zeros(len(all_of))
        for tool, at in zip(tools, place, strict=True):
            some, firm = _wanted(tool, layer.vertices[tool.vertices], moved[at])
            more = firm > weight[at]
            wanted[at[more]], weight[at[more]] = some[more], firm[more]
        act = np.flatnonzero(weight > 1e-3)  # a weight that falls to 0 lets go of its vertex continuously
        if not len(act):
            break
        step = np.linalg.solve(sinking[np.ix_(act, act)] + np.diag(own / weight[act] ** 2), wanted[act])
        sources[act] += step
        moved += sinking[:, act] @ step
    out = near.spread(all_of, sources)
    out += displacement
    entered = _push_out(layer, touches, out)
    corrected = float(np.linalg.norm(out[all_of] - displacement[all_of], axis=1).max())
    return Conformed(out, corrected, entered)


def kept_out(layer: SoftLayer, displacement: VertexVectors, touches: Sequence[Touch]) -> Conformed:
    """The answer with the skin that is inside a tool on its surface: where all else lies on the tool already."""
    out = displacement.copy()
    entered = _push_out(layer, touches, out)
    under = np.concatenate([touch.pressed.squeeze.vertices for touch in touches if touch.pressed is not None])
    return Conformed(out, float(np.linalg.norm(out[under] - displacement[under], axis=1).max(initial=0.0)), entered)


def _push_out(layer: SoftLayer, touches: Sequence[Touch], out: VertexVectors) -> float:
    """Moves what is left inside tools straight out; the largest depth that is left [m]."""
    entered = 0.0
    for touch in touches:
        if touch.pressed is None:
            continue
        field, pose, v = touch.pressed.field, touch.pose_body_from_tool, touch.pressed.squeeze.vertices
        phi, gradient = _jet(field, pose, layer.vertices[v] + out[v])
        out[v] -= np.minimum(phi, 0.0)[:, None] * gradient
        phi, _ = _jet(field, pose, layer.vertices[v] + out[v])
        entered = max(entered, -float(phi.min(initial=0.0)))
    return entered


def _jet(field: SignedDistance, pose: np.ndarray, points: Points) -> tuple[np.ndarray, Points]:
    """Signed distance [m] of a tool and its gradient at points of the layer's frame."""
    turn = pose[:3, :3]
    phi, gradient = field.distance_gradient((points - pose[:3, 3]) @ turn)
    return phi, gradient @ turn.T


def _tool(touch: Touch, pressed: Pressed, layer: SoftLayer) -> _Tool:
    assert touch.pressure is not None
    field, squeeze = pressed.field, pressed.squeeze
    v = squeeze.vertices
    pressure = touch.pressure[v]
    way = way_of(touch, pressed, -layer.normals[v], float(pressure @ layer.vertex_areas[v]))
    depth, cosine = squeeze.depth, -np.einsum("ni,ni->n", layer.normals[v], way)
    lies = squeeze.rests * np.clip(pressure / (MIN_LYING_PRESSURE * pressure.max()) - 0.5, 0, 1)
    lies *= np.clip((cosine - MIN_FACING_COSINE) / 0.1, 0, 1)
    some, gone = np.flatnonzero(lies), np.zeros((len(v), 3))
    points, guess = layer.vertices[v[some]], depth[some] / cosine[some]
    far = depth_along(field, touch.pose_body_from_tool, points, way[some], guess)
    sure = np.clip(2 * lies[some] - 1, 0, 1)  # beside a wall it is not clear where the way ends
    gone[some] = (sure * far + (1 - sure) * guess)[:, None] * way[some]
    return _Tool(field, touch.pose_body_from_tool, v, gone, lies, FIRM_DEPTH * layer.thickness[v])


def _wanted(tool: _Tool, rest: Points, moved: Points) -> tuple[Points, np.ndarray]:
    """How the vertices under a tool should still move, (N, 3) [m], and how firmly, (N,): 0, need not, to 1."""
    phi, gradient = _jet(tool.field, tool.pose, rest + moved)
    out, lies = -np.minimum(phi, 0.0)[:, None] * gradient, tool.lies[:, None]
    wanted = lies * (tool.gone - moved) + (1 - lies) * out
    return wanted, np.maximum(tool.lies, np.clip(-phi / tool.firm, 0, 1))
