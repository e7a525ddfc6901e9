"""Trial: the input of one test, as plain arrays that can be kept in a file and run again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.stability.contacts import Contacts
from studies.stability.scene import Pressures, Scene
from studies.stability.strokes import Strokes


@dataclass(frozen=True, eq=False)
class Twin:
    """The same scene, seen otherwise: its answer must be `scale turn u` at the vertices that are the same.

    Args:
        scene: scene that asks for as much as the one that it is compared with.
        pairs: number of each common vertex in the first scene and in this one, (N, 2); of strokes, of each instant.
        turn: rotation or reflection, (3, 3).
        scale: scale of lengths [-].
        may_refuse: refusing the scene with an error that says why is right as well.
    """

    scene: Scene
    pairs: np.ndarray
    turn: np.ndarray
    scale: float = 1.0
    may_refuse: bool = False


@dataclass(frozen=True, eq=False)
class Trial:
    """One level of one axis.

    Args:
        axis: name of the axis.
        level: place on the axis, with its unit, for a person.
        laws: names of the laws that must hold (studies.stability.laws).
        scene: scene that is asked.
        twin: scene that the answer is compared with.
        rounds: number of times that the scene's loads are asked for before the answers of the last round are judged.
    """

    axis: str
    level: str
    laws: tuple[str, ...]
    scene: Scene
    twin: Twin | None = None
    rounds: int = 1

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that is an array, by name."""
        arrays = _named("scene", self.scene)
        if self.twin is not None:
            arrays |= _named("twin", self.twin.scene) | {"pairs": self.twin.pairs, "turn": self.twin.turn}
        return arrays

    def card(self) -> dict[str, Any]:
        """Everything else, for JSON."""
        card: dict[str, Any] = {"axis": self.axis, "level": self.level, "laws": self.laws, "rounds": self.rounds}
        card |= {"kind": KINDS[type(self.scene)], "scene": self.scene.card()}
        if self.twin is not None:
            card |= {"twin": self.twin.scene.card(), "scale": self.twin.scale, "may_refuse": self.twin.may_refuse}
        return card

    @classmethod
    def restored(cls, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Trial:
        """The trial that `card` and `arrays` were taken from."""
        twin = None
        if "twin" in card:
            scene = _scene("twin", card, arrays)
            twin = Twin(scene, arrays["pairs"], arrays["turn"], card["scale"], card["may_refuse"])
        laws = tuple(card["laws"])
        return cls(card["axis"], card["level"], laws, _scene("scene", card, arrays), twin, card["rounds"])


KINDS: dict[type, str] = {Pressures: "pressures", Contacts: "contacts", Strokes: "strokes"}


def _named(name: str, scene: Scene) -> dict[str, np.ndarray]:
    return {f"{name}_{key}": value for key, value in scene.arrays().items()}


def _scene(name: str, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Scene:
    kind = {kind: scene for scene, kind in KINDS.items()}[card["kind"]]
    part = {key.removeprefix(f"{name}_"): value for key, value in arrays.items() if key.startswith(f"{name}_")}
    return kind.restored(card[name], part)
