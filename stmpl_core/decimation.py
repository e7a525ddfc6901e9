"""Fewer triangles: a surface reduced to what the grid of its distance field resolves."""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.arrays import Faces, Points
from stmpl_core.rows import first_alike

MARGIN = 5e-3  # width of the grid around the tool [m]
BAND_CELLS = 3  # cells around the surface in which the distances are exact
BAND_NODES = 40_000  # nodes that the default spacing spends on the band: 1/3 s for 5,000 triangles
MAX_NODES = 3_000_000  # nodes of a grid: 24 MB
MAX_KEPT_TRIANGLES = 100_000  # triangles up to which a surface is left as it is
CELL_OVER_SPACING = 0.75  # edge of a cluster's cell over the field's spacing
MEAN_WEIGHT = 1e-3  # weight of a cluster's mean against its planes: it decides along a plane or an edge


def field_spacing(area: float, extent: np.ndarray, margin: float = MARGIN) -> float:
    """Spacing of a distance field's grid [m] whose band and box have the nodes that are allowed.

    Args:
        area: area of the surface [m2].
        extent: size of the surface along each axis, (3,) [m].
        margin: width of the grid around the surface [m].
    """
    spacing = (2 * BAND_CELLS * area / BAND_NODES) ** 0.5
    return max(spacing, (float(np.prod(extent + 2 * margin + 2 * spacing)) / (0.8 * MAX_NODES)) ** (1 / 3))


def decimated(vertices: Points, faces: Faces, cell: float) -> tuple[Points, Faces]:
    """The surface with the vertices of each cubic cell drawn into one, at the point nearest to the planes of its faces.

    Quadric placement (Lindstrom 2000, "Out-of-core simplification"). A closed surface stays closed: of the faces that
    fall together those of opposite sides cancel, but where all would, one of each side stays, so that a plate thinner
    than a cell is kept as a sheet; of the faces that shrink to a line of its own (a needle) one stays as it was.

    Args:
        vertices: positions (V, 3) [m].
        faces: vertex numbers (F, 3), each face with an area.
        cell: edge of the cells [m].
    """
    index = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    first = first_alike(index)
    leads = first == np.arange(len(first))
    cluster = (np.cumsum(leads) - 1)[first]
    low = vertices.min(axis=0) + cell * index[leads]
    drawn = cluster[faces]
    a, b, c = drawn.T
    whole = (a != b) & (b != c) & (c != a)
    kept = _uncancelled(drawn[whole])
    points = _placed(vertices, faces, cluster, low, cell)
    lost = vertices[faces[~whole][_lost(drawn[~whole], kept)]].reshape(-1, 3)
    own = len(points) + np.arange(len(lost)).reshape(-1, 3)
    points, kept = np.concatenate([points, lost]), np.concatenate([kept, own, own[:, ::-1]])
    used, numbers = np.unique(kept, return_inverse=True)
    return points[used], numbers.reshape(-1, 3).astype(np.int32)


def _uncancelled(faces: np.ndarray) -> np.ndarray:
    """Of the faces with the same three vertices: as many as one side has more than the other, or one of each."""
    turn = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (turn[:, None] + np.arange(3)) % 3, axis=1)  # the lowest number first
    first = first_alike(np.sort(faces, axis=1))
    side = np.where(faces[:, 1] < faces[:, 2], 1, -1)
    surplus = np.bincount(first, weights=side, minlength=len(faces)).astype(int)
    leads = np.flatnonzero(first == np.arange(len(first)))
    up = np.sort(faces[leads], axis=1)
    surplus = surplus[leads]
    ups, downs = np.maximum(surplus, surplus == 0), np.maximum(-surplus, surplus == 0)
    return np.concatenate([np.repeat(up, ups, axis=0), np.repeat(up[:, ::-1], downs, axis=0)])


def _lost(shrunk: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Numbers of the first faces that shrank to each line or point which is no edge or corner of the kept faces."""
    ends = np.stack([shrunk.min(axis=1), shrunk.max(axis=1), np.zeros(len(shrunk), int)], axis=1)
    lines = np.flatnonzero(first_alike(ends) == np.arange(len(ends)))
    low, high = ends[lines, :2].T
    n = int(max(shrunk.max(initial=0), kept.max(initial=0))) + 1
    sides = np.sort(kept[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    corners = np.concatenate([kept.ravel(), low[low < high], high[low < high]])
    there = np.concatenate([sides[:, 0] * n + sides[:, 1], corners * (n + 1)])
    return lines[~np.isin(low * n + high, there)]


def _placed(vertices: Points, faces: Faces, cluster: np.ndarray, low: Points, cell: float) -> Points:
    """Point of each cluster inside its cell, nearest to the planes of its faces by least squares, (C, 3) [m]."""
    count = np.bincount(cluster)[:, None]
    mean = np.stack([np.bincount(cluster, weights=x) for x in vertices.T], axis=1) / count
    quadric, pull = np.zeros((len(low), 3, 3)), np.zeros((len(low), 3))
    _gather_planes(vertices, faces, cluster, mean, quadric, pull)
    stay = MEAN_WEIGHT * np.trace(quadric, axis1=1, axis2=2) + 1e-30
    move = np.linalg.solve(quadric + stay[:, None, None] * np.eye(3), pull[..., None])[..., 0]
    return np.clip(mean + move, low, low + cell)


@numba.njit(cache=True)
def _gather_planes(vertices, faces, cluster, mean, quadric, pull):
    """Adds n n^T and n (n . (x - mean)), weighted by area, of each face to the clusters of its corners."""
    n = np.empty(3)
    for face in faces:
        a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            n[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
        size = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        if size == 0:
            continue
        for corner in range(3):
            one = cluster[face[corner]]
            height = 0.0
            for k in range(3):
                height += n[k] * (a[k] - mean[one, k])
            for k in range(3):
                pull[one, k] += n[k] * height / size
                for m in range(3):
                    quadric[one, k, m] += n[k] * n[m] / size
