"""Carrying: how the memory of the tissue goes along with a skin whose joints move.

What skin and tool remember of each other is told in the layer's axes. Where the skin below a contact goes, it goes: so
friction feels a tool's way along the skin, not through space, and a tool that rides on the limb does not slide.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from stmpl_core.arrays import Transform
from stmpl_core.state import Memory, State
from stmpl_core.wake import carried_trail

if TYPE_CHECKING:
    from stmpl_core.skin import Skin


def carried(state: State, before: Skin, after: Skin) -> State:
    """The memory of tissue that its joints took from one pose of its skin to another."""
    if not state.tools:
        return state
    return State({name: _memory(memory, before, after) for name, memory in state.tools.items()})


def carry_at(before: Skin, after: Skin, place: np.ndarray) -> Transform:
    """Rigid motion of the skin near a place (3,) [m] from one pose to another, (4, 4): that of the nearest vertex."""
    start, end = before.layer.vertices, after.layer.vertices
    away = start - place
    nearest = int(np.argmin(np.einsum("vx,vx->v", away, away)))
    out = np.eye(4)
    out[:3, :3] = after.turn_at(nearest) @ before.turn_at(nearest).T
    out[:3, 3] = end[nearest] - out[:3, :3] @ start[nearest]
    return out


def _memory(memory: Memory, before: Skin, after: Skin) -> Memory:
    trail = carried_trail(memory.trail, partial(carry_at, before, after))
    if not memory.scalars.radius > 0:  # it never touched: where it is, it is in space
        return memory._replace(trail=trail)
    motion = carry_at(before, after, memory.contact[0])
    turn = motion[:3, :3]
    middle, normal, tangent = memory.contact
    contact = np.stack([turn @ middle + motion[:3, 3], turn @ normal, turn @ tangent])
    wrench = np.concatenate([turn @ memory.wrench[:3], turn @ memory.wrench[3:]])
    return memory._replace(pose=motion @ memory.pose, wrench=wrench, contact=contact, imprint=motion @ memory.imprint,
                           trail=trail)  # fmt: skip
