"""Skin: a layer with what was prepared for it: a method, and the neighbours of its vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer, layer_id
from stmpl_core.methods.base import Method
from stmpl_core.moments import Surroundings


@dataclass(frozen=True, eq=False)
class Skin:
    """A layer, ready to answer. It can be pickled, so that another process may make it.

    Args:
        layer: soft layer at rest.
        method: method, prepared for it.
        near: neighbours of its vertices, which method and contact share.
        green: linear response of a stack, likewise; None: one material straight below the skin.
    """

    layer: SoftLayer
    method: Method
    near: Surroundings
    green: Green | None = None

    @classmethod
    def of(cls, layer: SoftLayer, method: Method) -> Skin:
        """Prepares a layer (seconds). Raises InvalidInput or MeshError."""
        ready = method.prepare(layer)
        return cls(layer, ready, Surroundings.of(layer), Green.of(layer) if layer.stacked else None)

    def stiffened(self, method: Method, *, youngs_modulus: float, density: float) -> Skin:
        """The same skin of another stiffness [Pa] and density [kg/m3], in a tenth of a second.

        Args:
            method: method, not yet prepared.
        """
        tissue = replace(self.layer.tissue, youngs_modulus=youngs_modulus, density=density)
        layer = self.layer.with_(tissue=tissue)
        self.near.keep(layer)
        return Skin(layer, method.prepare(layer), self.near)

    @cached_property
    def layer_id(self) -> str:
        """Name of the layer in messages."""
        return layer_id(self.layer)


def published(layer: SoftLayer) -> SoftLayer:
    """The layer rounded to float32, as messages carry it: whoever reads them has the very same layer."""
    exact = {"vertices": layer.vertices} | layer.below
    rounded = {name: values.astype(np.float32) for name, values in exact.items()}
    return layer.with_(**rounded)
