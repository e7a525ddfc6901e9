"""Winkler: every column of the layer is squeezed on its own, in closed form."""

from __future__ import annotations

import math
from typing import Self

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import PerVertex, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.tissue import Tissue
from stmpl_core.trust import Displacement, Trust

MAX_SPREAD = 0.1  # share of the depth that neighbours may add before a column is no model of the layer
MAX_RATIO = 5.0  # p / E up to which FEM of a confined slab is compared with the closed form


class Winkler:
    """Confined compression of a Neo-Hookean column, stretch l at pressure p:

        mu (l - 1/l) + lambda ln(l) / l = -p,    u = -(1 - l) t n

    the Cauchy stress of Tissue (Bonet & Wood) with F = diag(1, 1, l); the column's area does not change, so a
    follower pressure and a nominal one are the same. Exact under a contact much wider than the layer is thick; it
    moves nothing outside the load, and lets nothing bulge.
    """

    name = "winkler"

    def __init__(self) -> None:
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer; there is nothing to compute. Raises InvalidInput for a skin or a stack."""
        single(layer, "Winkler")
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`; nodal forces act as the equivalent pressure.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        pressure = load.check(layer).pressure_on(layer)
        loaded = np.flatnonzero(pressure)
        displacement = np.zeros_like(layer.vertices)
        depth = (1 - column_stretch(pressure[loaded], layer.tissue)) * layer.thickness[loaded]
        displacement[loaded] = -depth[:, None] * layer.normals[loaded]
        return Displacement(displacement, _trust(layer, pressure, loaded), self.name, pressure)


def column_stretch(pressure: ArrayLike, tissue: Tissue) -> np.ndarray:
    """Stretch l [-] of confined columns under `pressure` (N,) [Pa]; below 1 where pressed, above 1 where pulled."""
    return _stretch(finite("pressure", pressure, (None,)), tissue.shear_modulus, tissue.lame_lambda)


def column_pressure(stretch: ArrayLike, tissue: Tissue) -> np.ndarray:
    """Pressure [Pa] that holds confined columns at `stretch` (N,) [-]: the inverse of `column_stretch`.

    Raises:
        InvalidInput: a stretch that is not finite or not above 0.
    """
    values = finite("stretch", stretch, (None,))
    if (values <= 0).any():
        raise InvalidInput(f"stretch is {values.min():g}; a column cannot be pressed to nothing. Allowed is above 0.")
    return -(tissue.shear_modulus * (values - 1 / values) + tissue.lame_lambda * np.log(values) / values)


@numba.njit(cache=True)
def _stretch(pressure, mu, lam):
    """Newton in q = ln l on g(q) = 2 mu sinh q + lambda q exp(-q) + p, kept inside a bracket of the root.

    For p > 0, g is concave and rises, and the left end -min(p/M, asinh(p/2mu)) lies left of the root: Newton climbs
    to it without a step back. For p < 0 the root lies below asinh(-p/2mu).
    """
    out = np.empty_like(pressure)
    for i in range(len(pressure)):
        p = pressure[i]
        if p == 0.0:
            out[i] = 1.0
            continue
        side = math.asinh(p / (2 * mu))
        low, high = (-min(p / (lam + 2 * mu), side), 0.0) if p > 0 else (0.0, -side)
        q = low if p > 0 else min(-p / (lam + 2 * mu), high)
        for _ in range(60):
            residual = 2 * mu * math.sinh(q) + lam * q * math.exp(-q) + p
            if residual > 0:
                high = min(high, q)
            else:
                low = max(low, q)
            slope = 2 * mu * math.cosh(q) + lam * math.exp(-q) * (1 - q)
            step = q - residual / slope if slope > 0 else low - 1.0
            if abs(step - q) < 1e-15 + 1e-15 * abs(q):
                break
            q = step if low <= step <= high else 0.5 * (low + high)
        out[i] = math.exp(q)
    return out


def least_width(poisson_ratio: float) -> float:
    """Width of a load, over t, from which columns are within MAX_SPREAD of a linear layer's depth [-].

    A bonded layer of thickness t under p cos(k x) sinks by p t / M (1 + kappa (k t)^2 + ...), with
    kappa = (3 - 4 nu) / (3 (1 - 2 nu)) - 1 / (1 - nu): the expansion of the plane-strain solution (Johnson, "Contact
    Mechanics", 1985, chapter 5). For p = p0 (1 - r^2/a^2) that adds 4 kappa (t / a)^2 of the depth at the centre.
    """
    kappa = (3 - 4 * poisson_ratio) / (3 * (1 - 2 * poisson_ratio)) - 1 / (1 - poisson_ratio)
    return 4 * math.sqrt(max(kappa, 0.0) / MAX_SPREAD)


def _trust(layer: SoftLayer, pressure: PerVertex, loaded: np.ndarray) -> Trust:
    if not len(loaded):
        return Trust()
    ratio = float(np.abs(pressure[loaded]).max()) / layer.tissue.youngs_modulus
    width = 2 * math.sqrt(float(layer.vertex_areas[loaded].sum()) / math.pi) / float(layer.thickness[loaded].mean())
    least = least_width(layer.tissue.poisson_ratio)
    trust = Trust(figures={"peak_ratio": ratio, "width_in_thicknesses": width})
    if ratio > MAX_RATIO:
        trust = trust.also(f"p/E is {ratio:.2g}, columns are compared with FEM up to {MAX_RATIO:g}", in_range=False)
    if (pressure[loaded] < 0).any():
        trust = trust.also("the load pulls, columns are compared with FEM under pressure only", in_range=False)
    if width < least:
        why = f"the load is {width:.1f} thicknesses wide, columns hold from {least:.1f} on"
        trust = trust.also(why, in_range=False)
    return trust
