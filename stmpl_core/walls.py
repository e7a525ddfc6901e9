"""Walls: which of a tool's surface is its outside, where bodies overlap or a surface passes through itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stmpl_core.arrays import Faces, Points
from stmpl_core.mending import places

FINE, FINEST = 3.0, 0.25  # edges over the spacing: of the pieces that are looked at, and of those that are cut
OFF, LEAST_OFF = 0.02, 1e-6  # way in front of a wall where it is looked: over its size or the spacing, over the tool's
INNER = 0.75  # winding number in front of a wall, above which that is inside the tool; 0 of an outer one, 1 of an inner
TRIED = 300  # places of any surface from which inner walls are looked for
MANY_PARTS = 2000  # parts from which on these are all that is looked at
SEEN = np.vstack([np.full((1, 3), 1 / 3), 0.06 + 0.82 * np.eye(3)])  # where a piece is looked at: shares of its corners


@dataclass(frozen=True, eq=False)
class OuterWalls:
    """The outside of a surface that has inner walls, in pieces.

    Args:
        pieces: triangles (T, 3, 3) [m]; by an inner wall they end within FINEST of the spacing.
        whole: mask of the pieces that are not cut by an inner wall, (T,).
    """

    pieces: np.ndarray
    whole: np.ndarray


def outer_walls(vertices: Points, faces: Faces, spacing: float) -> OuterWalls | None:
    """The surface without the walls that have the tool's inside in front of them as well; None: there are none.

    Parts whose boxes meet are looked at in pieces of FINE of the spacing; other surfaces at TRIED places.

    Args:
        vertices: positions (V, 3) [m].
        faces: vertex numbers (F, 3), wound outwards; of a cavity inwards.
        spacing: edge of the distance field's cells [m].
    """
    used = vertices[np.unique(faces)]
    middle = used.mean(axis=0)
    walls = _Walls(vertices - middle, faces, spacing, LEAST_OFF * float(np.ptp(used, axis=0).max()))
    corners = walls.vertices[faces]
    some = np.ones(len(faces), bool)
    if not walls.inner(_drawn(corners), SEEN[:1]).any():
        some = walls.pierced()
        if not some.any():
            return None
    pieces = _halved(corners[some], FINE * spacing)
    inner = walls.inner(pieces, SEEN)
    kept, whole = [corners[~some]], [np.ones(int((~some).sum()), bool)]
    while len(pieces):
        none, cut = ~inner.any(axis=1), inner.any(axis=1) & ~inner.all(axis=1)
        small = cut & (_longest(pieces) <= FINEST * spacing)
        rim = small & ~inner[:, 0]
        kept += [pieces[none], pieces[rim]]
        whole += [np.ones(int(none.sum()), bool), np.zeros(int(rim.sum()), bool)]
        pieces = _split(pieces[cut & ~small])
        inner = walls.inner(pieces, SEEN)
    return OuterWalls(np.concatenate(kept) + middle, np.concatenate(whole))


@dataclass(frozen=True, eq=False)
class _Walls:
    """A surface around its middle: winding numbers are reckoned in single precision."""

    vertices: Points
    faces: Faces
    spacing: float
    least: float

    def inner(self, pieces: np.ndarray, seen: np.ndarray, by: np.ndarray | None = None) -> np.ndarray:
        """Whether pieces (T, 3, 3) [m] have the inside in front of them, at shares (K, 3) of their corners, (T, K).

        Args:
            pieces: triangles.
            seen: where they are looked at.
            by: faces that bound the inside; None: all.
        """
        import igl

        if not len(pieces):
            return np.zeros((0, len(seen)), bool)
        a, b, c = np.swapaxes(pieces, 0, 1)
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1)
        off = np.maximum(OFF * np.minimum(self.spacing, (0.5 * area) ** 0.5), self.least) / np.maximum(area, 1e-300)
        front = np.einsum("kc,tcx->tkx", seen, pieces) + (off[:, None] * normal)[:, None]
        number = igl.fast_winding_number(self.vertices, self.faces if by is None else by, front.reshape(-1, 3))
        return np.asarray(number).reshape(len(pieces), -1) > INNER

    def pierced(self) -> np.ndarray:
        """Mask of the faces that reach into the boxes of other parts, (F,); none, if no inner wall is there."""
        part, none = _parts(self.vertices, self.faces), np.zeros(len(self.faces), bool)
        n_parts = int(part.max()) + 1
        if n_parts == 1 or n_parts > MANY_PARTS:
            return none
        corners = self.vertices[self.faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        lowest, highest = np.full((n_parts, 3), np.inf), np.full((n_parts, 3), -np.inf)
        np.minimum.at(lowest, part, low)
        np.maximum.at(highest, part, high)
        met = ((lowest[:, None] <= highest) & (highest[:, None] >= lowest)).all(axis=2)
        np.fill_diagonal(met, False)
        some, found = none.copy(), False
        for n in np.flatnonzero(met.any(axis=1)):
            others = (part != n) & (low <= highest[n]).all(axis=1) & (high >= lowest[n]).all(axis=1)
            some |= others
            if not found:  # what is inside of one part may be outside of all, as a cavity is
                pieces = _halved(corners[others], FINE * self.spacing)
                pieces = pieces[self.inner(pieces, SEEN[:1], self.faces[part == n])[:, 0]]
                found = bool(self.inner(pieces, SEEN[:1]).any())
        return some if found else none


def _drawn(corners: np.ndarray) -> np.ndarray:
    """About TRIED triangles of those given (F, 3, 3), spread evenly over their area; pieces where they are few."""
    if len(corners) < TRIED:
        corners = _halved(corners, 2 * (_areas(corners).sum() / TRIED) ** 0.5)
    area = np.cumsum(_areas(corners))
    return corners[np.unique(np.searchsorted(area, area[-1] * (np.arange(TRIED) + 0.5) / TRIED))]


def _areas(pieces: np.ndarray) -> np.ndarray:
    a, b, c = np.swapaxes(pieces, 0, 1)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _parts(vertices: Points, faces: Faces) -> np.ndarray:
    """Number of the part that each face belongs to, of those that hang together, (F,)."""
    from scipy.sparse import coo_array, csgraph

    corners = places(vertices)[faces]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]]).T
    graph = coo_array((np.ones(ends.shape[1], np.int8), (ends[0], ends[1])), (len(vertices), len(vertices)))
    label = csgraph.connected_components(graph, directed=False)[1]
    return np.unique(label[corners[:, 0]], return_inverse=True)[1]


def _sides(pieces: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pieces[:, [1, 2, 0]] - pieces, axis=2)


def _longest(pieces: np.ndarray) -> np.ndarray:
    return _sides(pieces).max(axis=1)


def _split(pieces: np.ndarray) -> np.ndarray:
    """Triangles (T, 3, 3), each in two across its longest side, (2 T, 3, 3)."""
    turn = (_sides(pieces).argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.swapaxes(np.take_along_axis(pieces, turn[..., None], axis=1), 0, 1)
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _halved(pieces: np.ndarray, longest: float) -> np.ndarray:
    """Triangles split until no side is longer than that [m]."""
    done = [pieces[:0]]
    while len(pieces):
        long = _longest(pieces) > longest
        done.append(pieces[~long])
        pieces = _split(pieces[long])
    return np.concatenate(done)
