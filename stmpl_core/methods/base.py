"""Method: the one protocol that every way of solving follows."""

from __future__ import annotations

from copy import copy
from typing import Protocol, Self

from stmpl_core.errors import NotPrepared
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.trust import Displacement


class Method(Protocol):
    """prepare(layer) once, then solve(load) as often as wanted."""

    name: str

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps what the method needs of `layer`, and returns the method itself."""
        ...

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`. Raises NotPrepared, or InvalidInput if the load does not fit the layer."""
        ...


def prepared(layer: SoftLayer | None, method: object) -> SoftLayer:
    """Returns `layer`, or raises NotPrepared naming the method."""
    if layer is None:
        name = type(method).__name__
        raise NotPrepared(f"{name} has no layer yet. Call {name}().prepare(layer) before solve(load).")
    return layer


def anew[M: Method](method: M) -> M:
    """A copy to be prepared for another layer; the methods inside it are copies too, so this one stays as it is."""
    out = copy(method)
    for name, value in vars(method).items():
        if isinstance(value, list):
            setattr(out, name, [anew(one) if hasattr(one, "prepare") else one for one in value])
        elif hasattr(value, "prepare"):
            setattr(out, name, anew(value))
    return out
