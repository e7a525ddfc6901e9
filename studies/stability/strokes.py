"""Strokes: a tool that is led over the skin step by step, with a state: time goes by, and skin sticks and slides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.simulator import Simulator
from stmpl_core.state import State
from stmpl_core.tool import Tool
from stmpl_core.touch import Answer, Touch
from stmpl_core.trust import Displacement, Trust
from studies.stability.contacts import Placed, give_fields, simulator_of
from studies.stability.scene import Ask, Make, Mesh, restored_mesh


class Spring(NamedTuple):
    """A spring that drags a tool along, which is free in this direction.

    Args:
        along: direction, (3,) [-].
        stiffness: stiffness of the spring [N/m].
        mass: mass of the tool [kg].
    """

    along: np.ndarray
    stiffness: float
    mass: float


@dataclass(frozen=True, eq=False)
class Strokes:
    """One tool that a simulator is asked for with a state, one instant after the other.

    Args:
        mesh: mesh of the skin.
        tool: tool.
        poses: its poses, (N, 4, 4); where a spring drags it, those of the spring's other end.
        times: instants, (N,) [s].
        friction: coefficient of friction [-]; 0: none.
        wrenches: wrenches on the body, (N, 6) [N, N m]; None: by pose.
        off: flags of instants at which the tool is off the skin, (N,); none: not known.
        spring: spring that drags the tool along.
    """

    mesh: Mesh
    tool: Tool
    poses: np.ndarray
    times: np.ndarray
    friction: float = 0.0
    wrenches: np.ndarray | None = None
    off: np.ndarray | None = None
    spring: Spring | None = None

    @property
    def last(self) -> Strokes:
        """The last instant alone."""
        return replace(self, poses=self.poses[-1:], times=self.times[-1:], off=None,
                       wrenches=None if self.wrenches is None else self.wrenches[-1:])  # fmt: skip

    def prepared(self, make: Make) -> Ask:
        """See Scene. Each round starts from an empty state."""
        simulator = simulator_of(make, self.mesh.layer, self.friction or None)
        return lambda: list(self.asked(simulator))

    def asked(self, simulator: Simulator) -> Iterator[Displacement]:
        """What a simulator of this skin says of each instant; where the skin goes is asked at the last one only."""
        give_fields(simulator, (Placed(self.tool, self.poses[0]),))
        state, gone, speed, still = State(), 0.0, 0.0, np.zeros_like(self.mesh.vertices)
        for k, pose in enumerate(self.poses):
            dt = float(self.times[k] - self.times[k - 1]) if k else 0.0
            at = pose
            if self.spring is not None:
                gone += dt * speed
                at = pose.copy()
                at[:3, 3] += (gone - self._driven(k)) * self.spring.along
            (touch,), state = simulator.touch([Contact(self.tool, at, self._wrench(k))], state, dt)
            if self.spring is not None:
                pull = self.spring.stiffness * (self._driven(k) - gone) - float(touch.wrench[:3] @ self.spring.along)
                speed += dt * pull / self.spring.mass
            last = k == len(self.poses) - 1
            yield simulator.answer([touch]) if last else _told(touch, still)

    def _driven(self, k: int) -> float:
        """Way of the spring's other end [m]."""
        assert self.spring is not None
        return float((self.poses[k, :3, 3] - self.poses[0, :3, 3]) @ self.spring.along)

    def _wrench(self, k: int) -> np.ndarray | None:
        return None if self.wrenches is None else self.wrenches[k]

    def arrays(self) -> dict[str, np.ndarray]:
        """See Scene."""
        arrays = {"tool_vertices": self.tool.vertices, "tool_faces": self.tool.faces, "poses": self.poses,
                  "times": self.times}  # fmt: skip
        more = {"wrenches": self.wrenches, "off": self.off, "along": self.spring and self.spring.along}
        return self.mesh.arrays() | arrays | {name: each for name, each in more.items() if each is not None}

    def card(self) -> dict[str, Any]:
        """See Scene."""
        spring = {"stiffness": self.spring.stiffness, "mass": self.spring.mass} if self.spring else None
        return asdict(self.mesh.tissue) | {"friction": self.friction, "tool": self.tool.name, "spring": spring}

    @classmethod
    def restored(cls, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Self:
        """See Scene."""
        tool = Tool(card["tool"], arrays["tool_vertices"], arrays["tool_faces"])
        spring = Spring(arrays["along"], **card["spring"]) if card["spring"] else None
        return cls(restored_mesh(card, arrays), tool, arrays["poses"], arrays["times"], card["friction"],
                   arrays.get("wrenches"), arrays.get("off"), spring)  # fmt: skip


def _told(touch: Touch, still: np.ndarray) -> Answer:
    """The touch as an answer that moves nothing; one that is no number if its wrench is none."""
    moved = still if np.isfinite(touch.wrench).all() else np.full_like(still, np.nan)
    return Answer(moved, touch.trust if touch.trust.why else Trust(), "touch", None, {touch.name: touch})
