"""Spline: a tricubic B-spline's sum over its 64 coefficients, four at a time in one vector register."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

FOUR = ir.VectorType(ir.DoubleType(), 4)
ANY_ORDER = ("contract", "reassoc", "nsz")  # sums may be taken in any order


def _sum(_: Any, grid: Any, i: Any, j: Any, k: Any, a: Any, b: Any, c: Any) -> Any:
    """For kernels: sum of a[p] b[q] c[r] grid[i + p, j + q, k + r], p, q and r from 0 to 3.

    numba's own loops leave registers three quarters empty here.

    Args:
        grid: coefficients, (I, J, K) float64, contiguous.
        i, j, k: first place along each axis; it is not checked that it and three more are there.
        a, b, c: weights along each axis, tuples of four floats.
    """
    if grid != types.Array(types.float64, 3, "C"):
        raise TypingError(f"a spline's coefficients are {grid}; float64 (I, J, K), contiguous, are needed.")
    return types.float64(grid, i, j, k, a, b, c), _lowered


spline_sum: Any = intrinsic(_sum)


def _lowered(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = cgutils.create_struct_proxy(signature.args[0])(context, builder, args[0])
    _, rows, wide = cgutils.unpack_tuple(builder, array.shape, 3)
    a, b, c = (cgutils.unpack_tuple(builder, weights, 4) for weights in args[4:])
    plane = builder.add(builder.mul(builder.add(builder.mul(args[1], rows), args[2]), wide), args[3])
    whole = ir.Constant(FOUR, [0.0] * 4)
    for p in range(4):
        line, sheet = plane, ir.Constant(FOUR, [0.0] * 4)
        for q in range(4):
            at = builder.bitcast(builder.gep(array.data, [line]), FOUR.as_pointer())
            sheet = _add(builder, sheet, _four_times(builder, b[q]), builder.load(at, align=8))
            line = builder.add(line, wide)
        whole = _add(builder, whole, _four_times(builder, a[p]), sheet)
        plane = builder.add(plane, builder.mul(rows, wide))
    out = ir.Constant(ir.DoubleType(), 0.0)
    for r in range(4):
        out = _add(builder, out, c[r], builder.extract_element(whole, ir.Constant(ir.IntType(32), r)))
    return out


def _four_times(builder: Any, value: Any) -> Any:
    """A vector of one value."""
    out = ir.Constant(FOUR, ir.Undefined)
    for r in range(4):
        out = builder.insert_element(out, value, ir.Constant(ir.IntType(32), r))
    return out


def _add(builder: Any, total: Any, a: Any, b: Any) -> Any:
    """total + a b."""
    return builder.fadd(total, builder.fmul(a, b, flags=ANY_ORDER), flags=ANY_ORDER)
