"""Scene: what one method is asked for, one after the other, on one skin; here pressures, in contacts.py rigid tools."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from stmpl_core.arrays import Faces, PerVertex, Points
from stmpl_core.chart import UvChart
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method
from stmpl_core.packed import stack_from_text
from stmpl_core.tissue import Tissue
from stmpl_core.trust import Displacement

Make = Callable[[], Method]  # a fresh method, not yet prepared
Ask = Callable[[], list[Displacement]]  # asks for all of a scene


@dataclass(frozen=True, eq=False)
class Mesh:
    """What a SoftLayer is made of; `layer` makes it, and raises what SoftLayer raises.

    Args:
        vertices: vertices of the skin, (V, 3) [m].
        faces: faces of the skin, (F, 3).
        thickness: thickness of the layer, (V,) [m].
        tissue: tissue of the layer.
        uv: chart's coordinates of each corner, (F, 3, 2) [-].
        core: ends of its columns, (V, 3) [m], which then say the thickness; None: straight below each vertex.
        ply_scale: factor on the depths of deeper materials, (V,) [-]; None: 1.
    """

    vertices: Points
    faces: Faces
    thickness: PerVertex
    tissue: Tissue
    uv: np.ndarray
    core: Points | None = None
    ply_scale: PerVertex | None = None

    @classmethod
    def of(cls, layer: SoftLayer) -> Mesh:
        """The mesh of a layer that has a UvChart."""
        return cls(layer.vertices, layer.faces, layer.thickness, layer.tissue, layer.chart.uv, layer.core,
                   layer.ply_scale)  # fmt: skip

    @cached_property
    def layer(self) -> SoftLayer:
        """The layer, made on first use."""
        chart = UvChart(self.vertices, self.faces, self.uv)
        return SoftLayer(self.vertices, self.faces, self.thickness if self.core is None else None, core=self.core,
                         tissue=self.tissue, chart=chart, ply_scale=self.ply_scale)  # fmt: skip

    def arrays(self) -> dict[str, np.ndarray]:
        """All but the tissue, by name."""
        always = {"vertices": self.vertices, "faces": self.faces, "thickness": self.thickness, "uv": self.uv}
        more = {"core": self.core, "ply_scale": self.ply_scale}
        return always | {name: values for name, values in more.items() if values is not None}


class Scene(Protocol):
    """What is asked for on one mesh."""

    @property
    def mesh(self) -> Mesh:
        """Mesh of the skin."""
        ...

    @property
    def last(self) -> Scene:
        """The last thing that is asked for, alone."""
        ...

    def prepared(self, make: Make) -> Ask:
        """Prepares a fresh method for the mesh. Raises what the method raises."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that is an array, by name."""
        ...

    def card(self) -> dict[str, Any]:
        """Everything else, for JSON."""
        ...

    @classmethod
    def restored(cls, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Self:
        """The scene that `card` and `arrays` were taken from."""
        ...


@dataclass(frozen=True, eq=False)
class Pressures:
    """Pressures, (K, V) [Pa], that one method is asked for one after the other on one mesh."""

    mesh: Mesh
    pressures: np.ndarray

    @property
    def last(self) -> Pressures:
        """The last pressure alone."""
        return replace(self, pressures=self.pressures[-1:])

    def loads(self) -> list[Load]:
        """The loads. What is not finite is put in after `Load` was made, which would refuse it."""
        loads = []
        for pressure in self.pressures:
            load = Load.pressure(np.where(np.isfinite(pressure), pressure, 0.0))
            load.values[:] = pressure
            loads.append(load)
        return loads

    def prepared(self, make: Make) -> Ask:
        """See Scene."""
        method, loads = make().prepare(self.mesh.layer), self.loads()
        return lambda: [method.solve(load) for load in loads]

    def arrays(self) -> dict[str, np.ndarray]:
        """See Scene."""
        return self.mesh.arrays() | {"pressures": self.pressures}

    def card(self) -> dict[str, Any]:
        """See Scene."""
        return asdict(self.mesh.tissue)

    @classmethod
    def restored(cls, card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Self:
        """See Scene."""
        return cls(restored_mesh(card, arrays), arrays["pressures"])


def restored_mesh(card: dict[str, Any], arrays: dict[str, np.ndarray]) -> Mesh:
    """The mesh of a scene's card and arrays."""
    told = {name: card.get(name) or value for name, value in asdict(Tissue()).items()}
    tissue, *_ = stack_from_text(json.dumps(told))
    always = {key: arrays[key] for key in ("vertices", "faces", "thickness", "uv")}
    return Mesh(**always, tissue=tissue, core=arrays.get("core"), ply_scale=arrays.get("ply_scale"))
