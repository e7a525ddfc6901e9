"""Naive: the baseline of the STMPL paper, three numbers that multiply thickness and force."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import VertexVectors, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust


class Naive:
    """delta_c = alpha_c t F_c for each global axis c in {x, y, z} (STMPL paper, section "Naive").

    F is the force on the vertex as a vector: with a scalar force the three numbers would average to nothing over a
    closed limb, whose normals point every way. Because the axes are global, unequal alphas mean that turning the
    scene does not turn the answer. Only loaded vertices move.

    Args:
        alpha: three numbers [1/N], learnt with `Naive.fit`; None: 1 / (M A), A the mean vertex area of the layer and
            M its confined modulus, which is the column of `Winkler` at small load. That default is derived, not learnt.
        fitted_ratio: largest p/E [-] of what alpha was learnt from; 0 where nothing was learnt.
    """

    name = "naive"

    def __init__(self, alpha: ArrayLike | None = None, *, fitted_ratio: float = 0.0) -> None:
        self.alpha = None if alpha is None else finite("alpha", alpha, (3,))
        self.fitted_ratio = fitted_ratio
        self._layer: SoftLayer | None = None
        self._alpha = np.zeros(3)

    @classmethod
    def fit(cls, samples: Iterable[tuple[SoftLayer, Load, ArrayLike]]) -> Self:
        """The alphas of least squared error over all vertices of `samples`.

        alpha_c = sum t F_c delta_c / sum (t F_c)^2: the minimum that the paper's Adam (2e-2, batch 128) walks to.

        Args:
            samples: triples of layer, load and true displacement (V, 3) [m].

        Raises:
            InvalidInput: an empty list of samples, an axis along which nothing presses, or shapes that do not fit.
        """
        product, square, ratio = np.zeros(3), np.zeros(3), 0.0
        for layer, load, truth in samples:
            drive = _drive(layer, load.check(layer))
            product += (drive * finite("true displacement", truth, layer.vertices.shape)).sum(axis=0)
            square += (drive**2).sum(axis=0)
            ratio = max(ratio, load.peak_ratio(layer))
        unseen = square <= 1e-20 * square.max()
        if unseen.any():
            axes = ", ".join(axis for axis, none in zip("xyz", unseen, strict=True) if none)
            raise InvalidInput(f"no sample presses along {axes}: its alpha cannot be learnt. Give samples that do.")
        return cls(product / square, fitted_ratio=ratio)

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer, and derives alpha from it if none was given. Raises InvalidInput for a skin or a stack."""
        single(layer, "Naive")
        self._layer = layer
        default = 1 / (layer.tissue.confined_modulus * float(layer.vertex_areas.mean()))
        self._alpha = np.full(3, default) if self.alpha is None else self.alpha
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`. Raises NotPrepared, or InvalidInput if the load does not fit the layer."""
        layer = prepared(self._layer, self)
        displacement = self._alpha * _drive(layer, load.check(layer))
        ratio = load.peak_ratio(layer)
        trust = Trust(figures={"peak_ratio": ratio})
        if ratio > self.fitted_ratio:
            trust = trust.also(f"p/E is {ratio:.2g}, the naive baseline was fitted up to {self.fitted_ratio:.2g}",
                               in_range=False)
        return Displacement(displacement, trust, self.name, load.pressure_on(layer))


def _drive(layer: SoftLayer, load: Load) -> VertexVectors:
    """t F at each vertex, (V, 3) [m N]."""
    return layer.thickness[:, None] * load.forces_on(layer)
