"""Pieces: whether a contact is one area of skin, or a group of pins with skin between that nothing presses on."""

from __future__ import annotations

import numba
import numpy as np

SPACINGS = 1.8  # distance of nodes, over the spacing of their lattice, up to which they are of one piece
NEAR = 2.0  # distance over the thickness up to which one piece feels another
GROUP = 1.5  # force beside a piece, over its own, from which it is one of a group
DEEP = 1.3  # depth over the radius of a piece from which no contact of a group was learnt
WIDER = 1.5  # factor on the stated bound of such a contact's force


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pins(points, area, thickness, forces):
    """How much presses beside each piece of skin that is pressed on, and how wide a piece is, weighed with the force.

    Args:
        points, area, thickness: those of Nodes.
        forces: forces at them, (N,) [N].

    Returns:
        beside: force on other pieces within NEAR thicknesses, over that on the own one [-]; 0: one area, of whatever
            shape; 1: two pins side by side.
        radius: radius of a disc as large as a piece [m]; infinite where there is but one.
    """
    count = len(points)
    piece, queue, pieces = np.full(count, -1), np.empty(count, np.int64), 0
    for n in range(count):
        if piece[n] >= 0:
            continue
        piece[n], queue[0], first, last = pieces, n, 0, 1
        while first < last:
            i = queue[first]
            first += 1
            far = SPACINGS**2 * 2 / np.sqrt(3.0) * area[i]
            for j in range(count):
                if piece[j] < 0 and _square(points, i, j) < far:
                    piece[j], queue[last] = pieces, j
                    last += 1
        pieces += 1
    if pieces < 2:
        return 0.0, np.inf
    beside = size = total = 0.0
    for i in range(count):
        own = other = wide = 0.0
        for j in range(count):
            if piece[i] == piece[j]:
                own += forces[j]
                wide += area[j]
            elif _square(points, i, j) < (NEAR * thickness[i]) ** 2:
                other += forces[j]
        beside += forces[i] * other / max(own, 1e-300)
        size += forces[i] * np.sqrt(wide / np.pi)
        total += forces[i]
    return beside / max(total, 1e-300), size / max(total, 1e-300)


@numba.njit(cache=True, inline="always")
def _square(points, i, j):
    """Squared distance of two points [m2]."""
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return x * x + y * y + z * z
