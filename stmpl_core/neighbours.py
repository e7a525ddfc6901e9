"""Neighbours: vertices that are near each other along the skin, not through the air."""

from __future__ import annotations

import numba
import numpy as np

CHUNK = 64  # vertices that one thread takes at a time


def neighbours(points: np.ndarray, normals: np.ndarray, thickness: np.ndarray, faces: np.ndarray,
               reaches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Pairs within each of `reaches`, rising, thicknesses (their geometric mean), normals less than 90 degrees apart.

    Only along the skin: a vertex is a neighbour if edges lead to it that never come back nearer, or if it is beside one
    that is. So what is near through the air, as another finger, is none.

    Returns:
        start (Z V + 1,), index: the neighbours of vertex v, itself among them, that lie between reach z - 1 and reach
        z of Z are index[start[Z v + z] : start[Z v + z + 1]].
    """
    first, beside = along_edges(faces, len(points))
    rows = np.column_stack([points, normals, thickness])
    start = np.zeros(len(reaches) * len(points) + 1, dtype=np.int64)
    _flood(rows, reaches, first, beside, start, np.empty(0, dtype=np.int32))
    start = np.cumsum(start)
    index = np.empty(start[-1], dtype=np.int32)
    _flood(rows, reaches, first, beside, start, index)
    return start, index


def along_edges(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at the other ends of the edges of vertex v: beside[first[v] : first[v + 1]]."""
    ends = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    ends = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    return np.searchsorted(ends[:, 0], np.arange(count + 1)), np.ascontiguousarray(ends[:, 1], dtype=np.int32)


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _flood(rows, reaches, first, beside, start, index):
    """Counts the neighbours of vertex i in zone z into start[Z i + z + 1], or where `index` has room writes them."""
    count, zones, writing = len(rows), len(reaches), len(index) > 0
    squares = reaches**2
    for chunk in numba.prange((count + CHUNK - 1) // CHUNK):
        seen, away = np.full(count, -1, np.int32), np.empty(count)
        queue, side, n = np.empty(count, np.int32), np.empty(count, np.int32), np.empty(zones, np.int64)
        for i in range(CHUNK * chunk, min(CHUNK * (chunk + 1), count)):
            n[:] = 0
            many, ends, sides = 0, 1, 0
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
                        if away[j] < squares[-1] * rows[i, 6] * rows[j, 6]:
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
            for m in range(ends):
                j = queue[m]
                square, zone = away[j] / (rows[i, 6] * rows[j, 6]), 0
                while square >= squares[zone]:
                    zone += 1
                if writing:
                    index[start[zones * i + zone] + n[zone]] = j
                n[zone] += 1
            if not writing:
                for zone in range(zones):
                    start[zones * i + zone + 1] = n[zone]
