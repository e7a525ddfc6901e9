"""Contacts: rigid tools that a simulator is asked for, instant by instant, on one skin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.tool import Tool
from stmpl_core.touch import Answer
from stmpl_core.trust import Displacement
from studies.stability.scene import Ask, Make, Mesh, restored_mesh


class Placed(NamedTuple):
    """A tool at a pose (4, 4), with a wrench (6,) [N, N m] or none. Unlike a Contact it may hold any number."""

    tool: Tool
    pose: np.ndarray
    wrench: np.ndarray | None = None


Instant = tuple[Placed, ...]


class Truth(NamedTuple):
    """What finite elements say: forces of all tools (K, T, 3) [N] and motion (K, V, 3) [m], an instant each."""

    forces: np.ndarray
    displacement: np.ndarray


@dataclass(frozen=True, eq=False)
class Contacts:
    """Tools that one simulator is asked for, one instant after the other.

    Args:
        mesh: mesh of the skin.
        instants: tools of each instant, each tool of a name of its own.
        series: number of the series of each instant, (K,): within one the tools press harder, or slide on.
        fed_back: flag of instants that are asked twice, by pose and then with the wrench that was answered.
        still: flags of vertices that must not move, (V,).
        truth: what finite elements say.
    """

    mesh: Mesh
    instants: tuple[Instant, ...]
    series: tuple[int, ...] = ()
    fed_back: bool = False
    still: np.ndarray | None = None
    truth: Truth | None = None

    @property
    def last(self) -> Contacts:
        """The last instant alone."""
        return replace(self, instants=self.instants[-1:], series=(), truth=None)

    def runs(self) -> Iterator[list[int]]:
        """Numbers of the instants of each series, in order."""
        series = self.series or (0,) * len(self.instants)
        for one in dict.fromkeys(series):
            yield [k for k, other in enumerate(series) if other == one]

    def steps(self) -> Iterator[tuple[int, int]]:
        """Neighbouring instants of each series."""
        for run in self.runs():
            yield from pairwise(run)

    def prepared(self, make: Make) -> Ask:
        """See Scene."""
        simulator = simulator_of(make, self.mesh.layer)
        return lambda: list(self.asked(simulator))

    def asked(self, simulator: Simulator) -> Iterator[Displacement]:
        """The answers of a simulator of this skin, instant by instant. Raises what the simulator raises."""
        for instant in self.instants:
            give_fields(simulator, instant)
            answer = simulator.step([Contact(*placed) for placed in instant])
            yield answer
            if self.fed_back:
                yield simulator.step([Contact(p.tool, p.pose, answer.touches[p.tool.name].wrench) for p in instant])

    def arrays(self) -> dict[str, np.ndarray]:
        """See Scene. A contact without a wrench has a row of zeros, and says so in `by_wrench`."""
        placed = [(k, one) for k, instant in enumerate(self.instants) for one in instant]
        tools = list({id(one.tool): one.tool for _, one in placed}.values())
        arrays = {f"tool_{n}_{part}": getattr(tool, part) for n, tool in enumerate(tools)
                  for part in ("vertices", "faces")}  # fmt: skip
        number = {id(tool): n for n, tool in enumerate(tools)}
        arrays |= {
            "instant": np.array([k for k, _ in placed], dtype=int),
            "tool": np.array([number[id(one.tool)] for _, one in placed], dtype=int),
            "names": np.array([tool.name for tool in tools]), "pose": np.array([one.pose for _, one in placed]),
            "by_wrench": np.array([one.wrench is not None for _, one in placed]),
            "wrench": np.array([np.zeros(6) if one.wrench is None else one.wrench for _, one in placed]),
            "series": np.array(self.series, dtype=int),
        }  # fmt: skip
        if self.still is not None:
            arrays["still"] = self.still
        if self.truth is not None:
            arrays |= {"truth_forces": self.truth.forces, "truth_displacement": self.truth.displacement}
        return self.mesh.arrays() | arrays

    def card(self) -> dict[str, Any]:
        """See Scene."""
        return asdict(self.mesh.tissue) | {"fed_back": self.fed_back}

    @classmethod
    def restored(cls, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Self:
        """See Scene."""
        tools = [Tool(str(name), arrays[f"tool_{n}_vertices"], arrays[f"tool_{n}_faces"])
                 for n, name in enumerate(arrays["names"])]  # fmt: skip
        placed = [Placed(tools[tool], pose, wrench if given else None) for tool, pose, wrench, given in
                  zip(arrays["tool"], arrays["pose"], arrays["wrench"], arrays["by_wrench"], strict=True)]  # fmt: skip
        instants = tuple(tuple(placed[n] for n in np.flatnonzero(arrays["instant"] == k))
                         for k in range(arrays["instant"].max(initial=-1) + 1))  # fmt: skip
        truth = Truth(arrays["truth_forces"], arrays["truth_displacement"]) if "truth_forces" in arrays else None
        return cls(restored_mesh(card, arrays), instants, tuple(arrays["series"].tolist()), card["fed_back"],
                   arrays.get("still"), truth)  # fmt: skip


def simulator_of(make: Make, layer: SoftLayer, friction: float | None = None) -> Simulator:
    """A simulator with a fresh method, or the one that a method brings itself by `simulator(layer)`.

    Where there is friction, one that is brought is asked for by `simulator(layer, friction)`.
    """
    method = make()
    own = getattr(method, "simulator", None)
    if own is None:
        return Simulator(layer, method, friction=friction)
    return own(layer) if friction is None else own(layer, friction)


def answers_of(answers: list[Displacement]) -> list[Answer]:
    """The same answers, which are those of a simulator."""
    assert all(isinstance(answer, Answer) for answer in answers)
    return answers  # type: ignore[return-value]


def give_fields(simulator: Simulator, instant: Instant) -> None:
    """Gives a simulator the distance fields of its tools: each is built once for all methods. Raises MeshError."""
    for placed in instant:
        if placed.tool.name not in simulator.tools or simulator.tools[placed.tool.name] is not placed.tool:
            simulator.tools.add(placed.tool, field_of(placed.tool, simulator.tools.margin))


@lru_cache(maxsize=64)
def field_of(tool: Tool, margin: float) -> SignedDistance:
    """A tool's distance field. Raises MeshError."""
    return SignedDistance.of(tool, margin=margin)
