"""Neighbours: vertices that are near each other along the skin, not through the air."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

CHUNK = 64  # vertices that one thread takes at a time


class Edges(NamedTuple):
    """Vertices at the other ends of the edges of vertex v: beside[first[v] : first[v + 1]]."""

    first: np.ndarray
    beside: np.ndarray

    @classmethod
    def of(cls, faces: np.ndarray, count: int) -> Edges:
        """Those of faces (F, 3) of so many vertices."""
        return cls.between(np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]), count)

    @classmethod
    def between(cls, ends: np.ndarray, count: int) -> Edges:
        """Those between pairs of so many vertices, (N, 2)."""
        both = np.concatenate([ends, ends[:, ::-1]]).astype(np.int64)
        key = np.unique(both[:, 0] * count + both[:, 1])
        return cls(np.searchsorted(key, count * np.arange(count + 1)), (key % count).astype(np.int32))


def neighbours(rows: np.ndarray, reach: float, edges: Edges,
               some: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Vertices within `reach` thicknesses (their geometric mean) of each, normals less than 90 degrees apart.

    Only along the skin: a vertex is a neighbour if edges lead to it that never come back nearer, or if it is beside one
    that is. So what is near through the air, as another finger, is none.

    Args:
        rows: point, normal and thickness of each vertex, (V, 7).
        reach: distance over the thickness.
        edges: edges between them.
        some: numbers of those whose neighbours are meant, (N,); all, if not said.

    Returns:
        start (N + 1,), index: the neighbours of number n, itself among them, are index[start[n] : start[n + 1]].
    """
    some = np.arange(len(rows)) if some is None else some
    start = np.zeros(len(some) + 1, dtype=np.int64)
    _flood(rows, reach, *edges, some, start, np.empty(0, dtype=np.int32))
    start = np.cumsum(start)
    index = np.empty(start[-1], dtype=np.int32)
    _flood(rows, reach, *edges, some, start, index)
    return start, index


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _flood(rows, reach, first, beside, some, start, index):
    """Counts the neighbours of number n into start[n + 1], or where `index` has room writes them."""
    count, writing, square = len(rows), len(index) > 0, reach**2
    for chunk in numba.prange((len(some) + CHUNK - 1) // CHUNK):
        seen, away = np.full(count, -1, np.int32), np.empty(count)
        queue, side = np.empty(count, np.int32), np.empty(count, np.int32)
        for n in range(CHUNK * chunk, min(CHUNK * (chunk + 1), len(some))):
            i, many, ends, sides = some[n], 0, 1, 0
            queue[0], seen[i], away[i] = i, 2 * i + 1, 0.0
            while many < ends:
                k = queue[many]
                many += 1
                for p in range(first[k], first[k + 1]):
                    j = beside[p]
                    if seen[j] == 2 * i + 1:
                        continue
                    if seen[j] != 2 * i:  # not looked at yet
                        x, y, z = rows[j, 0] - rows[i, 0], rows[j, 1] - rows[i, 1], rows[j, 2] - rows[i, 2]
                        facing = rows[i, 3] * rows[j, 3] + rows[i, 4] * rows[j, 4] + rows[i, 5] * rows[j, 5]
                        away[j] = (x * x + y * y + z * z) if facing > 0 else np.inf
                        seen[j] = 2 * i
                        if away[j] < square * rows[i, 6] * rows[j, 6]:
                            side[sides] = j
                            sides += 1
                        else:
                            away[j] = np.inf
                    if away[j] < np.inf and away[j] >= away[k]:
                        seen[j] = 2 * i + 1
                        queue[ends] = j
                        ends += 1
            for m in range(sides):  # beside the flood
                if seen[side[m]] == 2 * i:
                    queue[ends] = side[m]
                    ends += 1
            if writing:
                index[start[n] : start[n] + ends] = queue[:ends]
            else:
                start[n + 1] = ends
