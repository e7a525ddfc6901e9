"""Carrying: how the memory of the tissue goes along with a skin whose joints move.

What skin and tool remember of each other is told in the layer's axes. Where the skin below a contact goes, it goes: so
friction feels a tool's way along the skin, not through space, and a tool that rides on the limb does not slide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numba
import numpy as np

from stmpl_core.arrays import Points, Transform
from stmpl_core.errors import InvalidInput
from stmpl_core.state import Memory, State
from stmpl_core.wake import carried_trail

if TYPE_CHECKING:
    from stmpl_core.layer import SoftLayer
    from stmpl_core.skin import Skin

WINDOW, MOST_EXPONENT = 0.8, 4.5  # edges around a place whose skin tells how it turns, and exponent that is left out


def carried(state: State, skin: Skin, after: Skin) -> State:
    """The memory of tissue where its joints took it, from wherever they were when it was told.

    Args:
        state: memory.
        skin: same skin, most likely where it was told: elsewhere it costs a pose.
        after: same skin where it is now.

    Raises:
        InvalidInput: no memory, or one that does not say where its joints were, of other joints, or beyond their
            limits.
    """
    if not isinstance(state, State):
        raise InvalidInput(f"the state is {state!r:.40}; a State is needed, State() at the beginning.")
    for name, memory in state.tools.items():
        if not isinstance(memory, Memory):
            raise InvalidInput(f"the state of {name} is {memory!r:.40}; a Memory is needed. Try an empty State().")
    if state.joints == after.angles:
        return state
    state.check_finite()
    if not state.tools:
        return replace(state, joints=after.angles)
    rig = (after.rest or after).layer.rig
    if state.joints is None:
        if rig is None:
            return replace(state, joints=())
        raise InvalidInput("this state of a skin with joints does not say where its joints were. Try "
                           "State.unpack(packed, joints=...) with the angles that it was recorded at.")  # fmt: skip
    names = () if rig is None else rig.names
    if state.joints and len(state.joints) != len(names):
        many = len(state.joints)
        raise InvalidInput(f"this state was told at {many} joint{'s' * (many > 1)}; this skin has "
                           f"{', '.join(names) or 'none'}. Try an empty State().")  # fmt: skip
    before = skin if skin.angles == state.joints else skin.posed(dict(zip(names, state.joints, strict=False)))
    memories = {name: _memory(memory, before, after) for name, memory in state.tools.items()}
    return replace(state, tools=memories, joints=after.angles)


def carry_at(before: Skin, after: Skin, place: np.ndarray) -> Transform:
    """Rigid motion of the skin near a place (3,) [m] from one pose to another, (4, 4)."""
    return motion_at(before.layer, lambda some: after.layer.vertices[some], place)


def motion_at(layer: SoftLayer, moved: Callable[[np.ndarray], Points], place: np.ndarray) -> Transform:
    """Rigid motion of a layer's skin near a place, (4, 4).

    It goes as the nearest point of the skin, and turns as the vertices around do in the mean (Kabsch 1976), by a
    Gaussian of WINDOW edges: it changes smoothly as the place moves.

    Args:
        layer: layer, of which skin that is flat or bent does not matter.
        moved: function that gives where vertices have gone, (K, 3) [m], by their numbers (K,).
        place: place near it, (3,) [m].
    """
    some, shares, corners, at = _around(layer.vertices, layer.vertex_areas, layer.faces, np.ascontiguousarray(place))
    start, end, out = layer.vertices[some], moved(np.concatenate([some, corners])), np.eye(4)
    first, second = shares @ start, shares @ end[:-3]
    u, _, v = np.linalg.svd((shares[:, None] * (end[:-3] - second)).T @ (start - first))
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(v)  # no mirror: points on skin lie next to flat
    out[:3, :3] = u @ v
    out[:3, 3] = at @ end[-3:] - out[:3, :3] @ (at @ layer.vertices[corners])
    return out


@numba.njit(cache=True, nogil=True)
def _around(vertices, areas, faces, place):
    """Vertices around the one nearest to a place, and their shares, (K,) each; those of its face there, (3,) each."""
    square, nearest = np.empty(len(vertices)), 0
    for v in range(len(vertices)):
        square[v] = 0.0
        for x in range(3):
            square[v] += (vertices[v, x] - place[x]) ** 2
        if areas[v] > 0 and (square[v] < square[nearest] or not areas[nearest] > 0):
            nearest = v
    unit = 2 * WINDOW**2 * areas[nearest]
    some = np.flatnonzero(square < square[nearest] + MOST_EXPONENT * unit)
    shares = np.exp((square[nearest] - square[some]) / unit)
    corners, at, least, share = np.empty(3, np.int64), np.empty(3), np.inf, np.empty(3)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if i != nearest and j != nearest and k != nearest:
            continue
        a = b = c = d = e = away = 0.0
        for x in range(3):
            u, v, w = vertices[j, x] - vertices[i, x], vertices[k, x] - vertices[i, x], place[x] - vertices[i, x]
            a, b, c, d, e = a + u * u, b + u * v, c + v * v, d + w * u, e + w * v
        share[1] = max((c * d - b * e) / (a * c - b * b), 0.0)
        share[2] = max((a * e - b * d) / (a * c - b * b), 0.0)
        share[0] = max(1 - (c * d - b * e + a * e - b * d) / (a * c - b * b), 0.0)
        share /= share.sum()
        for x in range(3):
            there = share[0] * vertices[i, x] + share[1] * vertices[j, x] + share[2] * vertices[k, x]
            away += (there - place[x]) ** 2
        if away < least:
            least, at[:] = away, share
            corners[0], corners[1], corners[2] = i, j, k
    return some, shares / shares.sum(), corners, at


def _memory(memory: Memory, before: Skin, after: Skin) -> Memory:
    trail = carried_trail(memory.trail, partial(carry_at, before, after))
    if not memory.scalars.radius > 0:  # it never touched: with the skin nearest to where it is
        return memory.with_(pose=carry_at(before, after, memory.pose[:3, 3]) @ memory.pose, trail=trail)
    motion = carry_at(before, after, memory.contact[0])
    turn = motion[:3, :3]
    middle, normal, tangent = memory.contact
    contact = np.stack([turn @ middle + motion[:3, 3], turn @ normal, turn @ tangent])
    wrench = np.concatenate([turn @ memory.wrench[:3], turn @ memory.wrench[3:]])
    return memory.with_(pose=motion @ memory.pose, wrench=wrench, contact=contact, imprint=motion @ memory.imprint,
                        trail=trail)  # fmt: skip
