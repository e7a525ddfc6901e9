"""Remembering: the memory of the tissue from instant to instant, and the touches that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bags.wire import NANO
from stmpl_core.errors import InvalidInput
from stmpl_core.simulator import Simulator
from stmpl_core.state import State
from stmpl_core.touch import Touch
from stmpl_ros.inbox import Instant


class Before(NamedTuple):
    """What touches were made from beside their contacts; who replays them needs the same.

    Args:
        state: memory of the tissue before them; None: none, elastic skin.
        dt: time since that state [s].
        friction: coefficient of friction of each tool [-].
        joints: angle of each joint of the skin's rig [rad]; empty: at rest.
    """

    state: State | None
    dt: float
    friction: Mapping[str, float]
    joints: tuple[float, ...] = ()


ELASTIC = Before(None, 0.0, {})


class Reaction(NamedTuple):
    """Touches of an instant, what they were made from, and the memory of the tissue after them."""

    touches: list[Touch]
    before: Before
    after: State | None


class Remembering:
    """Memory of the tissue: a reaction is found from it, and counts once it is kept.

    Without friction and relaxation there is none: touches are elastic. Time is that of the instants' stamps, so
    instants that were dropped are one longer step. A stamp that lies before the last one's takes no time.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self, name: str | None = None) -> None:
        """Forgets all, or what is remembered of one tool."""
        if name is not None:
            self.state = self.state.without(name)
        else:
            self.state, self._stamp = State(), 0

    def went_back(self, instant: Instant) -> float:
        """How far an instant's stamp lies before the last one's [s]; 0: it does not."""
        return max(self._stamp - instant.stamp, 0) / NANO if self.state.tools else 0.0

    def reaction(self, simulator: Simulator, instant: Instant) -> Reaction:
        """The touches of an instant; nothing is remembered of them yet.

        Raises:
            InvalidInput: touches that are not finite.
            Exception: whatever the contact law does not bear.
        """
        if not simulator.remembers:
            touches, before, after = simulator.touch(instant.contacts), ELASTIC, None
            if simulator.skin.angles:
                before = before._replace(joints=simulator.skin.angles)
        else:
            dt = max(instant.stamp - self._stamp, 0) / NANO if self._stamp else 0.0
            friction = {one.name: simulator.history.friction(one.name) for one in instant.contacts}
            before = Before(self.state, dt, friction, simulator.skin.angles)
            touches, after = simulator.touch(instant.contacts, self.state, dt)
        if not all(np.isfinite(touch.wrench).all() for touch in touches) or not (after is None or after.finite):
            statuses = {touch.name: touch.status for touch in touches}
            raise InvalidInput(f"the wrench or the memory would not be finite under {statuses}.")
        return Reaction(touches, before, after)

    def keep(self, reaction: Reaction, instant: Instant) -> None:
        """Remembers a reaction."""
        if reaction.after is not None:
            self.state, self._stamp = reaction.after, instant.stamp
