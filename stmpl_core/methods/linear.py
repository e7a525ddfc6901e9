"""Linear: the response of a thin bonded layer to small pressures, summed over the neighbours of each vertex."""

from __future__ import annotations

from typing import Self

from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.moments import Surroundings
from stmpl_core.trust import Displacement, Trust

MAX_RATIO = 0.1  # p / E up to which the method is validated; its peak is then within 4 % (docs/networks.md)
NU = (0.3, 0.49)  # Poisson's ratios that the method is validated on


class Linear:
    """Green's function of a flat bonded layer (stmpl_core.response.response_table), cut off at REACH thicknesses.

    It is laid into each vertex's tangent plane with the local thickness, so that it needs no solve: only the loaded
    vertices and those near them are touched. The skin's curvature is left out, and so is all that is not linear.
    """

    name = "linear"

    def __init__(self) -> None:
        self._layer: SoftLayer | None = None
        self._surroundings: Surroundings | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Finds each vertex's neighbours (half a second for a limb). Raises InvalidInput for a skin or a stack."""
        single(layer, "Linear")
        self._surroundings = Surroundings.of(layer)
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`; nodal forces act as the equivalent pressure.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        assert self._surroundings is not None
        pressure = load.check(layer).pressure_on(layer)
        displacement = self._surroundings.linear(pressure / layer.tissue.youngs_modulus)
        return Displacement(displacement, _trust(layer, load), self.name, pressure)


def _trust(layer: SoftLayer, load: Load) -> Trust:
    ratio, nu = load.peak_ratio(layer), layer.tissue.poisson_ratio
    trust = Trust(figures={"peak_ratio": ratio})
    if ratio > MAX_RATIO * (1 + 1e-9):
        trust = trust.also(f"p/E is {ratio:.2g}, the linear response holds to {MAX_RATIO:g}", in_range=False)
    if not NU[0] <= nu <= NU[1]:
        trust = trust.also(f"nu is {nu:g}, validated is {NU[0]:g} to {NU[1]:g}", in_range=False)
    return trust
