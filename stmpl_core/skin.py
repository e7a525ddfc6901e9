"""Skin: a layer with what was prepared for it: a method, and the neighbours of its vertices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from stmpl_core.arrays import check_count, check_kind
from stmpl_core.errors import InvalidInput
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer, layer_id
from stmpl_core.methods.base import Method
from stmpl_core.moments import Surroundings

if TYPE_CHECKING:
    from stmpl_core.posing import Posing


@dataclass(frozen=True, eq=False)
class Skin:
    """A layer, ready to answer. It can be pickled, so that another process of the same version of stmpl may make it.

    Args:
        layer: soft layer at rest.
        method: method, prepared for it.
        near: neighbours of its vertices, which method and contact share.
        green: linear response of a stack, likewise; None: one material straight below the skin.
        angles: angle of each joint of the layer's rig [rad]; empty: at rest.
        rest: same skin at rest; None: this is it.
    """

    layer: SoftLayer
    method: Method
    near: Surroundings
    green: Green | None = None
    angles: tuple[float, ...] = ()
    rest: Skin | None = None

    def __setstate__(self, state: dict[str, Any]) -> None:
        """What is kept by the layer is kept anew: one from another process has a layer of its own."""
        from stmpl_core.posing import keep_green

        vars(self).update(state)
        self.near.keep(self.layer)
        if self.green is not None:
            self.green.keep(self.layer)
        elif self.rest is not None:
            keep_green(self.rest, self.layer, self.near, self.angles)

    @classmethod
    def of(cls, layer: SoftLayer, method: Method) -> Skin:
        """Prepares a layer (seconds). Raises InvalidInput or MeshError."""
        check_kind("layer", layer, SoftLayer)
        if not hasattr(method, "prepare"):
            raise InvalidInput(f"method is {method!r:.40}; one of stmpl_core.methods is needed, as MomentNet().")
        ready = method.prepare(layer)
        return cls(layer, ready, Surroundings.of(layer), Green.of(layer) if layer.stacked else None)

    def posed(self, joints: Mapping[str, float]) -> Skin:
        """The same skin where joints take it, in milliseconds; this one stays as it is.

        Args:
            joints: angle by the joint's name [rad]; those that are not given are at rest.

        Raises:
            InvalidInput: a layer without a rig, or what Rig.angles refuses.
        """
        rig = (self.rest or self).layer.rig
        if rig is None:
            raise InvalidInput("this skin has no joints. Try layer.with_(rig=Rig.of(body, part, layer)).")
        return self.at_angles(rig.angles(joints))

    def at_angles(self, angles: Sequence[float]) -> Skin:
        """As `posed`, by the angles of all joints in the rig's order [rad]; none: at rest."""
        rest = self.rest or self
        if not any(angles):
            return rest
        return rest.posing.skin(angles)

    def turn_at(self, vertex: int) -> np.ndarray:
        """Rotation of the skin at a vertex from its rest, (3, 3)."""
        check_count("the vertex", vertex, 0, len(self.layer.vertices) - 1)
        return np.eye(3) if self.rest is None else self.rest.posing.turn_at(vertex, self.angles)

    @cached_property
    def posing(self) -> Posing:
        """What this skin at rest needs to be posed, found on the first call (a fifth of a second)."""
        from stmpl_core.posing import Posing

        return Posing(self)

    def at(self, layer: SoftLayer, method: Method, near: Surroundings, green: Green | None,
           angles: tuple[float, ...]) -> Skin:  # fmt: skip
        """This skin at rest as it is at some angles of its joints."""
        return Skin(layer, method, near, green, angles, self)

    def stiffened(self, method: Method, *, youngs_modulus: float, density: float) -> Skin:
        """The same skin, at rest, of another stiffness [Pa] and density [kg/m3], in a tenth of a second.

        Args:
            method: method, not yet prepared.
        """
        rest = self.rest or self
        alike = tuple(replace(ply, youngs_modulus=youngs_modulus) for ply in rest.layer.tissue.deeper)
        tissue = replace(rest.layer.tissue, youngs_modulus=youngs_modulus, density=density, deeper=alike)
        layer = rest.layer.with_(tissue=tissue)
        rest.near.keep(layer)
        if rest.green is None and (green := Green.kept(rest.layer)):
            green.stiffened(layer, rest.near).keep(layer)
        return Skin(layer, method.prepare(layer), rest.near)

    @cached_property
    def layer_id(self) -> str:
        """Name of the layer in messages: of its rest and its rig."""
        return layer_id((self.rest or self).layer)


def published(layer: SoftLayer) -> SoftLayer:
    """The layer rounded to float32, as messages carry it: whoever reads them has the very same layer."""
    exact = {"vertices": layer.vertices} | layer.below
    rounded = {name: values.astype(np.float32) for name, values in exact.items()}
    return layer.with_(**rounded)
