"""Zero: nothing moves; the row that shows what a metric is worth."""

from __future__ import annotations

from typing import Self

import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust


class Zero:
    """Predicts that nothing moves. It scores well wherever most counted vertices move little; trust it nowhere."""

    name = "zero"

    def __init__(self) -> None:
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer."""
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """Zeros. Raises NotPrepared, or InvalidInput if the load does not fit the layer."""
        layer = prepared(self._layer, self)
        pressure = load.check(layer).pressure_on(layer)
        trust = Trust().also("this method predicts that nothing moves", in_range=False) if load.loaded.size else Trust()
        return Displacement(np.zeros_like(layer.vertices), trust, self.name, pressure)
