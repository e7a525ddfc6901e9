"""Walls: which of a tool's surface is its outside, where bodies overlap or a surface passes through itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stmpl_core.arrays import Faces, Points
from stmpl_core.mending import parts

FINE = 2.0  # longest edge over the spacing of the pieces that are looked at
HALVINGS = 5  # of an edge, to find where a wall ends on it
OFF, LEAST_OFF = 0.02, 1e-6  # way off a wall where it is looked: over its size or the spacing, and over the tool's size
INNER = 0.75  # winding number in front of a wall, above which that is inside the tool; 0 of an outer one, 1 of an inner
TRIED = 300  # places of any surface from which inner walls are looked for
MANY_PARTS = 2000  # parts from which on these are all that is looked at
INSET = 0.06  # distance from a piece's edges at which it is looked at, over its heights
SEEN = np.vstack([np.full((1, 3), 1 / 3), INSET / 3 + (1 - INSET) * np.eye(3)])  # shares of its corners
MIDDLE = SEEN[:1]


@dataclass(frozen=True, eq=False)
class OuterWalls:
    """The outside of a surface that has inner walls, in pieces.

    Args:
        pieces: triangles (T, 3, 3) [m]; where an inner wall begins they end along straight lines.
        whole: mask of the pieces that are not cut there, (T,).
    """

    pieces: np.ndarray
    whole: np.ndarray


def outer_walls(vertices: Points, faces: Faces, spacing: float) -> OuterWalls | None:
    """The surface without the walls that have the tool's inside in front of them as well.

    Parts whose boxes meet are looked at in pieces of FINE of the spacing; other surfaces at TRIED places.

    Args:
        vertices: positions (V, 3) [m].
        faces: vertex numbers (F, 3), wound outwards; of a cavity inwards.
        spacing: edge of the distance field's cells [m].

    Returns:
        None where nothing is inside twice, and no wall is an inner one.
    """
    used = vertices[np.unique(faces)]
    middle = used.mean(axis=0)
    walls = _Walls(vertices - middle, faces, spacing, LEAST_OFF * float(np.ptp(used, axis=0).max()))
    corners, boxes = walls.vertices[faces], None
    tried = _drawn(corners)
    found = tried[walls.inner(tried, MIDDLE)[:, 0]]
    part = parts(walls.vertices, faces)
    some = np.full(len(faces), len(found) > 0)
    if 0 < part.max() < MANY_PARTS:
        boxes = _boxes(corners, part)
        if len(found) and not _shared(boxes, found.mean(axis=1)).all():
            boxes = None  # a part passes through itself
        else:
            some = walls.meeting(part, boxes, search=not len(found))
    if not some.any():
        return None
    pieces = _halved(corners[some], FINE * spacing)
    inner = walls.inner(pieces, SEEN, boxes=boxes)
    none = ~inner.any(axis=1)
    mixed = ~none & ~inner.all(axis=1)
    whole, cut = np.concatenate([corners[~some], pieces[none]]), walls.cut(pieces[mixed], inner[mixed], boxes)
    return OuterWalls(np.concatenate([whole, cut]) + middle, np.arange(len(whole) + len(cut)) < len(whole))


@dataclass(frozen=True, eq=False)
class _Walls:
    """A surface around its middle: winding numbers are reckoned in single precision.

    Args:
        vertices: positions (V, 3) [m].
        faces: vertex numbers (F, 3).
        spacing: edge of the field's cells [m].
        least: least way off a wall at which it is looked [m].
    """

    vertices: Points
    faces: Faces
    spacing: float
    least: float

    def inner(self, pieces: np.ndarray, seen: np.ndarray, *, by: np.ndarray | None = None, behind: bool = False,
              most: float = INNER, boxes: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
        """Whether pieces have the inside in front of them, (T, K).

        Args:
            pieces: triangles (T, 3, 3) [m].
            seen: where they are looked at: shares (K, 3) of their corners, or (T, K, 3).
            by: faces that bound the inside; None: all.
            behind: whether it is looked behind them.
            most: winding number above which a place counts.
            boxes: of all parts (P, 2, 3) [m]; only places in two of them are inside twice. None: any may be.
        """
        import igl

        a, b, c = np.swapaxes(pieces, 0, 1)
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1)
        off = np.maximum(OFF * np.minimum(self.spacing, (0.5 * area) ** 0.5), self.least) / np.maximum(area, 1e-300)
        front = seen @ pieces + ((-off if behind else off)[:, None] * normal)[:, None]
        front = front.reshape(-1, 3)
        out = np.zeros(len(front), bool)
        some = np.arange(len(front)) if boxes is None else np.flatnonzero(_shared(boxes, front))
        if len(some):
            faces = self.faces if by is None else by
            out[some] = np.asarray(igl.fast_winding_number(self.vertices, faces, front[some])) > most
        return out.reshape(len(pieces), seen.shape[-2])

    def cut(self, pieces: np.ndarray, inner: np.ndarray, boxes: np.ndarray | None) -> np.ndarray:
        """What is outside of pieces that an inner wall begins in, triangles (N, 3, 3) [m].

        Args:
            pieces: triangles (T, 3, 3) [m].
            inner: which of SEEN are inside, (T, 4).
            boxes: see `inner`.
        """
        corners = inner[:, 1:]
        alike = corners.all(axis=1) | ~corners.any(axis=1)
        kept, pieces, corners = pieces[alike & ~inner[:, 0]], pieces[~alike], corners[~alike]
        lone = np.where(corners.sum(axis=1) == 1, corners.argmax(axis=1), corners.argmin(axis=1))
        if not len(pieces):
            return kept
        pieces = np.take_along_axis(pieces, ((lone[:, None] + np.arange(3)) % 3)[..., None], axis=1)
        inside = corners[np.arange(len(lone)), lone]
        low, high = np.zeros((len(pieces), 2)), np.ones((len(pieces), 2))
        for _ in range(HALVINGS):
            way = 0.5 * (low + high)
            seen = np.zeros((len(pieces), 2, 3))
            seen[:, :, 0], seen[:, 0, 1], seen[:, 1, 2] = 1 - way, way[:, 0], way[:, 1]
            here = self.inner(pieces, INSET / 3 + (1 - INSET) * seen, boxes=boxes) == inside[:, None]
            low, high = np.where(here, way, low), np.where(here, high, way)
        a, b, c = np.swapaxes(pieces, 0, 1)
        way = 0.5 * (low + high)[..., None]
        on_b, on_c = a + way[:, 0] * (b - a), a + way[:, 1] * (c - a)
        tip, one, other = (np.stack(x, axis=1) for x in ((a, on_b, on_c), (on_b, b, c), (on_b, c, on_c)))
        return np.concatenate([kept, tip[~inside], one[inside], other[inside]])

    def meeting(self, part: np.ndarray, boxes: np.ndarray, *, search: bool) -> np.ndarray:
        """Mask of the faces that reach into the boxes of other parts, (F,).

        Args:
            part: number of each face's part, (F,).
            boxes: lowest and highest corner of each part, (P, 2, 3) [m].
            search: whether it is not known that any of them is inside another part; if none is, none counts.
        """
        low, high = np.swapaxes(boxes, 0, 1)
        met = ((low[:, None] <= high) & (high[:, None] >= low)).all(axis=2)
        np.fill_diagonal(met, False)
        corners, some = self.vertices[self.faces], np.zeros(len(self.faces), bool)
        for n in np.flatnonzero(met.any(axis=1)):
            others = (part != n) & (corners.min(axis=1) <= high[n]).all(axis=1)
            others &= (corners.max(axis=1) >= low[n]).all(axis=1)
            some |= others
            if search:
                pieces = _halved(corners[others], FINE * self.spacing)
                search = not any(self._twice(pieces, self.faces[part == n], behind) for behind in (False, True))
        return np.zeros_like(some) if search else some

    def _twice(self, pieces: np.ndarray, by: np.ndarray, behind: bool) -> bool:
        """Whether any piece is inside a part, or its back is, and that is no cavity of another."""
        pieces = pieces[self.inner(pieces, MIDDLE, by=by, behind=behind)[:, 0]]
        return bool(self.inner(pieces, MIDDLE, behind=behind, most=INNER + behind).any())


def _drawn(corners: np.ndarray) -> np.ndarray:
    """About TRIED triangles of those given (F, 3, 3), spread evenly over their area; pieces where they are few."""
    if len(corners) < TRIED:
        corners = _halved(corners, 2 * (areas(corners).sum() / TRIED) ** 0.5)
    area = np.cumsum(areas(corners))
    return corners[np.unique(np.searchsorted(area, area[-1] * (np.arange(TRIED) + 0.5) / TRIED))]


def areas(pieces: np.ndarray) -> np.ndarray:
    """Areas of triangles (T, 3, 3), (T,)."""
    a, b, c = np.swapaxes(pieces, 0, 1)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _boxes(corners: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Lowest and highest corner of each part of triangles (F, 3, 3), (P, 2, 3) [m]."""
    many = int(part.max()) + 1
    low, high = np.full((many, 3), np.inf), np.full((many, 3), -np.inf)
    np.minimum.at(low, part, corners.min(axis=1))
    np.maximum.at(high, part, corners.max(axis=1))
    return np.stack([low, high], axis=1)


def _shared(boxes: np.ndarray, points: Points) -> np.ndarray:
    """Mask of the points (N, 3) that are in more than one box, or may be, (N,)."""
    slack = 1e-3 * float(np.ptp(boxes, axis=(0, 1)).max())
    count = np.zeros(len(points), np.int64)
    for low, high in boxes:
        count += ((points >= low - slack) & (points <= high + slack)).all(axis=1)
    return count > 1


def _sides(pieces: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pieces[:, [1, 2, 0]] - pieces, axis=2)


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
        long = _sides(pieces).max(axis=1) > longest
        done.append(pieces[~long])
        pieces = _split(pieces[long])
    return np.concatenate(done)
