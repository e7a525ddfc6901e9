"""Rows that are alike, found in linear time."""

from __future__ import annotations

import numba
import numpy as np


def first_alike(rows: np.ndarray) -> np.ndarray:
    """Number of the first row that is the same as each, (N,); rows (N, 3) of whole numbers."""
    return _first_alike(np.ascontiguousarray(rows, dtype=np.int64))


@numba.njit(cache=True)
def _first_alike(rows):
    bits = 4
    while 1 << bits < 2 * len(rows):
        bits += 1
    mask = np.uint64((1 << bits) - 1)
    table = np.full(1 << bits, -1, np.int32)  # open addressing
    first = np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        x, y, z = rows[n, 0], rows[n, 1], rows[n, 2]
        key = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
        key = ((key ^ (key >> np.uint64(29))) + np.uint64(y)) * np.uint64(0xBF58476D1CE4E5B9)
        key = ((key ^ (key >> np.uint64(32))) + np.uint64(z)) * np.uint64(0x94D049BB133111EB)
        slot = (key ^ (key >> np.uint64(31))) & mask
        while table[slot] >= 0:
            m = table[slot]
            if rows[m, 0] == x and rows[m, 1] == y and rows[m, 2] == z:
                break
            slot = (slot + np.uint64(1)) & mask
        if table[slot] < 0:
            table[slot] = n
        first[n] = table[slot]
    return first
