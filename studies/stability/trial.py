"""Trial: the input of one test, as plain arrays that can be kept in a file and run again."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stmpl_core.arrays import Faces, PerVertex, Points
from stmpl_core.chart import UvChart
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.load import Load


@dataclass(frozen=True, eq=False)
class Mesh:
    """What a SoftLayer is made of; `layer` makes it, and raises what SoftLayer raises.

    Args:
        vertices: vertices of the skin, (V, 3) [m].
        faces: faces of the skin, (F, 3).
        thickness: thickness of the layer, (V,) [m].
        tissue: tissue of the layer.
        uv: chart's coordinates of each corner, (F, 3, 2) [-].
    """

    vertices: Points
    faces: Faces
    thickness: PerVertex
    tissue: Tissue
    uv: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer) -> Mesh:
        """The mesh of a layer that has a UvChart."""
        return cls(layer.vertices, layer.faces, layer.thickness, layer.tissue, layer.chart.uv)

    @cached_property
    def layer(self) -> SoftLayer:
        """The layer, made on first use."""
        chart = UvChart(self.vertices, self.faces, self.uv)
        return SoftLayer(self.vertices, self.faces, self.thickness, tissue=self.tissue, chart=chart)


@dataclass(frozen=True, eq=False)
class Scene:
    """Pressures, (K, V) [Pa], that one method is asked for one after the other on one mesh."""

    mesh: Mesh
    pressures: np.ndarray

    def loads(self) -> list[Load]:
        """The loads. What is not finite is put in after `Load` was made, which would refuse it."""
        loads = []
        for pressure in self.pressures:
            load = Load.pressure(np.where(np.isfinite(pressure), pressure, 0.0))
            load.values[:] = pressure
            loads.append(load)
        return loads


@dataclass(frozen=True, eq=False)
class Twin:
    """The same scene, seen otherwise: its answer must be `scale turn u` at the vertices that are the same.

    Args:
        scene: scene with as many loads as the one that it is compared with.
        pairs: number of each common vertex in the first scene and in this one, (N, 2).
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
        arrays = _arrays("scene", self.scene)
        if self.twin is not None:
            arrays |= _arrays("twin", self.twin.scene) | {"pairs": self.twin.pairs, "turn": self.twin.turn}
        return arrays

    def card(self) -> dict[str, Any]:
        """Everything else, for JSON."""
        card: dict[str, Any] = {"axis": self.axis, "level": self.level, "laws": self.laws, "rounds": self.rounds}
        card["scene"] = asdict(self.scene.mesh.tissue)
        if self.twin is not None:
            card |= {"twin": asdict(self.twin.scene.mesh.tissue), "scale": self.twin.scale,
                     "may_refuse": self.twin.may_refuse}  # fmt: skip
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


def _arrays(name: str, scene: Scene) -> dict[str, np.ndarray]:
    mesh = scene.mesh
    parts = {"vertices": mesh.vertices, "faces": mesh.faces, "thickness": mesh.thickness, "uv": mesh.uv,
             "pressures": scene.pressures}  # fmt: skip
    return {f"{name}_{key}": value for key, value in parts.items()}


def _scene(name: str, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Scene:
    part = {key: arrays[f"{name}_{key}"] for key in ("vertices", "faces", "thickness", "uv")}
    return Scene(Mesh(**part, tissue=Tissue(**card[name])), arrays[f"{name}_pressures"])
