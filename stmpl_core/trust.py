"""Trust: what may be believed of an answer; and Displacement, the answer that carries it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stmpl_core.arrays import PerVertex, VertexVectors
from stmpl_core.errors import InvalidInput


@dataclass(frozen=True)
class Trust:
    """What may be believed of an answer.

    Args:
        converged: flag of an answer within the method's own tolerance (closed forms always are).
        in_range: flag of a scene inside the range that the method was validated on.
        error_bound: largest Euclidean error to expect at any vertex [m], or None where none is known.
        why: sentence for a person; empty when there is nothing to say.
        figures: figures that the method measured, by name with unit ("min_j", "truncation_m").

    Raises:
        InvalidInput: a flag that is neither True nor False.
    """

    converged: bool = True
    in_range: bool = True
    error_bound: float | None = None
    why: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises InvalidInput for a flag that is no truth."""
        for name in ("converged", "in_range"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise InvalidInput(f"{name} is {getattr(self, name)!r}; True or False is needed.")

    @property
    def ok(self) -> bool:
        """Whether the answer converged and lies inside the validated range."""
        return self.converged and self.in_range

    def also(self, why: str, *, in_range: bool | None = None, converged: bool | None = None) -> Trust:
        """The same trust with one more reason, if it is new, and flags lowered (never raised) as given."""
        told = self.why.split("; ")
        return replace(
            self,
            why="; ".join([*filter(None, told), *(one for one in why.split("; ") if one and one not in told)]),
            in_range=self.in_range and in_range is not False,
            converged=self.converged and converged is not False,
        )


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacement that a method finds for a load.

    Args:
        displacement: motion of each vertex, (V, 3) [m], in the layer's frame.
        trust: verdict on the answer: what may be believed of it.
        method: name of the method that answered.
        pressure: pressure that was solved for, (V,) [Pa], if the method knows it.
    """

    displacement: VertexVectors
    trust: Trust
    method: str
    pressure: PerVertex | None = None

    @property
    def magnitude(self) -> PerVertex:
        """Length of the displacement of each vertex, (V,) [m]."""
        return np.linalg.norm(self.displacement, axis=1)
