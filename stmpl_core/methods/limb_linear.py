"""LimbLinear: the linear response of a whole limb to small pressures."""

from __future__ import annotations

from typing import Self

import numpy as np

from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust

MAX_SINK = 0.05  # largest motion over the median thickness up to which the linear response is validated
THIN = 1.0  # thickness under a load over the coarse edges, below which those are too wide
THIN_SHARE = 0.1  # share of the load's force that may press on thinner tissue
BOUND_SHARE = 0.12  # bound of the error over the peak of the answer; 4 to 11 % were found on five limbs


class LimbLinear:
    """Linear response of a whole limb: any stack, under a skin or not, on any core. Milliseconds an answer."""

    name = "limb_linear"

    def __init__(self) -> None:
        self._green: Green | None = None
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Finds the response (see stmpl_core.green; 5 to 20 s for a limb).

        Raises:
            InvalidInput, MeshError: the skin cannot be meshed coarsely.
        """
        self._green, self._layer = Green.of(layer), layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`; nodal forces act as the equivalent pressure.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        assert self._green is not None
        pressure = load.check(layer).pressure_on(layer)
        displacement = linear_motion(self._green, load)
        return Displacement(displacement, _trust(layer, self._green, displacement, pressure), self.name, pressure)


def linear_motion(green: Green, load: Load) -> np.ndarray:
    """Linear response to a load, (V, 3) [m]; if the load knows it, a copy of that."""
    if load.motion is not None:
        return load.motion.copy()
    return green.linear(load.pressure_on(green.layer) / green.layer.tissue.youngs_modulus)


def _trust(layer: SoftLayer, green: Green, displacement: np.ndarray, pressure: np.ndarray) -> Trust:
    peak = float(np.linalg.norm(displacement, axis=1).max())
    trust = Trust(error_bound=BOUND_SHARE * peak, figures={"sink": peak / green.thickness})
    if peak > MAX_SINK * green.thickness:
        trust = trust.also(f"the skin moves by {peak / green.thickness:.0%} of the tissue's thickness, the linear "
                           f"response holds to {MAX_SINK:.0%}", in_range=False)  # fmt: skip
    loaded, edge = np.flatnonzero(pressure), green.coarse.edge_length if green.coarse is not None else 0.0
    force = np.abs(pressure[loaded]) * layer.vertex_areas[loaded]
    thin = float(force @ (layer.thickness[loaded] < THIN * edge)) / max(float(force.sum()), 1e-300)
    if thin > THIN_SHARE:
        trust = trust.also(f"{thin:.0%} of the force is where the tissue is thinner than the edges of the coarse "
                           f"mesh, {1e3 * edge:.2g} mm", in_range=False)  # fmt: skip
    for why in green.near.sound.of_load(loaded, force):
        trust = trust.also(why, in_range=False)
    return trust
