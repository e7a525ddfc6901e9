"""Load: what presses on the skin, as a pressure or as a force per vertex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import PerVertex, VertexVectors, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer

LoadKind = Literal["pressure", "contact", "nodal"]


@dataclass(frozen=True, eq=False)
class Load:
    """Load on the skin, one number a vertex, inwards where positive. Make it with `pressure`, `contact` or `nodal`."""

    kind: LoadKind
    values: PerVertex
    motion: VertexVectors | None = None

    @classmethod
    def pressure(cls, p: ArrayLike) -> Load:
        """Pressure at each vertex, (V,) [Pa], along the *deformed* normal (a follower load)."""
        return cls("pressure", finite("pressure", p, (None,)))

    @classmethod
    def contact(cls, p: ArrayLike, motion: VertexVectors | None = None) -> Load:
        """Pressure of rigid tools that the skin sticks to, at each vertex, (V,) [Pa].

        A pressure, but one that comes with a pull along the skin: it keeps what is touched from spreading under the
        tool. Methods that do not know of it take it for a follower pressure.

        Args:
            p: pressure at each vertex, (V,) [Pa].
            motion: linear response, (V, 3) [m], where it is known better than from the pressure: from where the tools
                are.
        """
        return cls("contact", finite("pressure", p, (None,)), motion)

    @classmethod
    def nodal(cls, f: ArrayLike) -> Load:
        """Force at each vertex, (V,) [N], along the *rest* normal (a dead load: the paper's rule)."""
        return cls("nodal", finite("nodal force", f, (None,)))

    @classmethod
    def zero(cls, layer: SoftLayer) -> Load:
        """No load on any vertex of `layer`."""
        return cls("pressure", np.zeros(len(layer.vertices)))

    def check(self, layer: SoftLayer) -> Load:
        """Returns itself if it is finite and fits `layer`; raises InvalidInput otherwise."""
        if len(self.values) != len(layer.vertices):
            raise InvalidInput(f"the load has {len(self.values)} values; the layer has {len(layer.vertices)} vertices.")
        finite("load", self.values, (None,))  # once more: the array may have been written to since
        return self

    @property
    def loaded(self) -> np.ndarray:
        """Numbers of the vertices that carry load."""
        return np.flatnonzero(self.values != 0)  # five times as fast as on the numbers themselves

    def pressure_on(self, layer: SoftLayer) -> PerVertex:
        """The equivalent pressure at rest, (V,) [Pa]: nodal forces are divided by the vertex areas."""
        return self.values / layer.vertex_areas if self.kind == "nodal" else self.values

    def forces_on(self, layer: SoftLayer) -> VertexVectors:
        """Forces on the skin at rest, (V, 3) [N]; their sum is the force of the load."""
        if self.kind == "nodal":
            return -self.values[:, None] * layer.normals
        return -self.values[:, None] * layer.vertex_area_vectors

    def peak_ratio(self, layer: SoftLayer) -> float:
        """Largest |p| / E [-], the one number that decides how nonlinear the answer is."""
        return float(np.abs(self.pressure_on(layer)).max(initial=0.0)) / layer.tissue.youngs_modulus

    def scaled(self, factor: float) -> Load:
        """The same load times `factor`."""
        return Load(self.kind, self.values * factor, None if self.motion is None else self.motion * factor)
