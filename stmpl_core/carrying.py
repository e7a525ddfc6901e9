"""Carrying: how the memory of the tissue goes along with a skin whose joints move.

What skin and tool remember of each other is told in the layer's axes. Where the skin below a contact goes, it goes: so
friction feels a tool's way along the skin, not through space, and a tool that rides on the limb does not slide.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from stmpl_core.arrays import Transform
from stmpl_core.errors import InvalidInput
from stmpl_core.state import Memory, State
from stmpl_core.wake import carried_trail

if TYPE_CHECKING:
    from stmpl_core.skin import Skin


def carried(state: State, skin: Skin, after: Skin) -> State:
    """The memory of tissue where its joints took it, from wherever they were when it was told.

    Args:
        state: memory.
        skin: same skin, most likely where it was told: elsewhere it costs a pose.
        after: same skin where it is now.

    Raises:
        InvalidInput: a memory that does not say where its joints were, or of other joints, or beyond their limits.
    """
    if state.joints == after.angles:
        return state
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
    return State({name: _memory(memory, before, after) for name, memory in state.tools.items()}, after.angles)


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
