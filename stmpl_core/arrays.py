"""Names of array kinds with shape and unit, and the checks that every public entrance shares."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from stmpl_core.errors import InvalidInput

Points = Float[np.ndarray, "n 3"]  # positions or vectors, one row each [m] or [-]
PerVertex = Float[np.ndarray, " v"]  # one scalar a vertex
VertexVectors = Float[np.ndarray, "v 3"]  # one vector a vertex
Faces = Int[np.ndarray, "f 3"]  # vertex numbers, counter-clockwise seen from outside
Transform = Float[np.ndarray, "4 4"]  # rigid, column convention: x_a = T_a_from_b @ x_b
Wrench = Float[np.ndarray, " 6"]  # force [N] then torque [N m]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two vectors, (3,): numpy's to the bit, which takes 60 times as long for a single pair."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


@numba.njit(cache=True, nogil=True)
def inverted(pose):
    """The inverse of a rigid transform (4, 4), far sooner than numpy's of a matrix."""
    out = np.zeros((4, 4))
    out[3, 3] = 1.0
    for x in range(3):
        for y in range(3):
            out[x, y] = pose[y, x]
            out[x, 3] -= pose[y, x] * pose[y, 3]
    return out


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _all_finite(values):
    """Whether all values (N,) are finite: a tenth of numpy's time on a limb."""
    total = 0.0
    for n in range(len(values)):
        total += 0.0 * values[n]
    return total == 0.0


def is_number(value: object) -> bool:
    """Whether a value is a real number; truth is none."""
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)


def check_number(name: str, value: object) -> None:
    """Raises InvalidInput: a value that is no number, or not finite."""
    if not (is_number(value) and math.isfinite(value)):  # type: ignore[arg-type]
        raise InvalidInput(f"{name} is {value!r:.40}; a finite number is needed.")


def check_count(name: str, value: object, least: int = 1, most: float = math.inf) -> None:
    """Raises InvalidInput: a value that is no whole number, or not from `least` to `most`; truth is none."""
    if not (is_number(value) and isinstance(value, Integral) and least <= int(value) <= most):
        allowed = f"from {least} to {most}" if most < math.inf else f"of at least {least}"
        raise InvalidInput(f"{name} is {value!r:.40}; a whole number {allowed} is needed.")


def check_choice(name: str, value: object) -> None:
    """Raises InvalidInput: a value that is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidInput(f"{name} is {value!r:.40}; True or False is needed.")


def check_kind(name: str, value: object, kind: type | tuple[type, ...]) -> None:
    """Raises InvalidInput: a value that is not of a kind."""
    if not isinstance(value, kind):
        kinds = " or ".join("None" if one is type(None) else one.__name__
                            for one in (kind if isinstance(kind, tuple) else (kind,)))  # fmt: skip
        raise InvalidInput(f"{name} is {value!r:.40}; {kinds} is needed.")


def check_dt(dt: float) -> None:
    """Raises InvalidInput: a time since the step before [s] that is no number, below 0, or not finite."""
    if not (is_number(dt) and 0 <= dt < np.inf):
        raise InvalidInput(f"dt is {dt!r:.40} s; time goes forward, allowed is a number of 0 or more, and finite.")


def check_places(name: str, array: Any) -> None:
    """Raises InvalidInput: an array to be written of which two elements may share a place; of numpy or Warp."""
    reach = 1
    for step, many in sorted((abs(step), many) for step, many in zip(array.strides, array.shape, strict=True)):
        if many > 1 and step < reach:
            raise InvalidInput(f"{name} has elements that share a place, as torch.expand makes them: what is written "
                               "to one would be read in another. Try clone() or copy().")  # fmt: skip
        reach += step * (many - 1)


def real(value: ArrayLike) -> ArrayLike:
    """The same value. Raises ValueError: complex numbers, of which numpy would drop a part with a warning."""
    if np.iscomplexobj(value):
        raise ValueError("they are complex")
    return value


def finite(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> np.ndarray:
    """Returns `value` as a contiguous float64 array of `shape` (None: any length).

    Raises:
        InvalidInput: wrong shape, not numeric, or any NaN or infinity.
    """
    try:
        array = np.ascontiguousarray(real(value), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{name} is not an array of numbers: {error}") from error
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise InvalidInput(f"{name} has shape {array.shape}; expected {wanted}.")
    if not _all_finite(array.ravel()):
        bad = ~np.isfinite(array)
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InvalidInput(f"{name} holds {int(bad.sum())} values that are not finite, the first at index {where}.")
    return array
