"""UvChart: the body's own UV map as an image, and the way from vertices to texels and back across its seams."""

from __future__ import annotations

import logging
from functools import cached_property
from typing import cast

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import PerVertex, finite
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.layer import check_faces

log = logging.getLogger(__name__)

PADDING = 3  # texels beyond the island that carry extrapolated values: bilinear sampling at a seam needs one
MULTIPLE = 16  # texels of which image sides are multiples, so that a network may halve them four times


class UvChart:
    """A flat image of a skin through its UVs.

    The centre of texel (row i, column j) lies at u = u0 + (j + 1/2) s, v = v1 - (i + 1/2) s: row 0 is at the largest v.
    One texel is as wide as high in UV. A vertex on a seam has several places in the image.

    Args:
        vertices: positions, (V, 3) [m], for the scale in mm.
        faces: vertex numbers, (F, 3).
        uv: texture coordinates of each corner, (F, 3, 2) [-].
        resolution: texels along the longer side of the image.
        bounds: part of UV space to show, (u0, v0, u1, v1); the island itself unless given.
            (0, 0, 1, 1) is the whole body's image, as in the STMPL paper, most of which one limb leaves empty.

    Raises:
        MeshError: faces of no area in UV, or faces that lie over one another there.
        InvalidInput: wrong shapes, not finite, or UVs outside `bounds`.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        uv: ArrayLike,
        *,
        resolution: int = 512,
        bounds: tuple[float, float, float, float] | None = None,
    ) -> None:
        self.vertices = finite("vertices", vertices, (None, 3))
        self.faces = check_faces(faces, len(self.vertices))
        self.uv = finite("uv", uv, (len(self.faces), 3, 2))
        if resolution < 2 * MULTIPLE:
            raise InvalidInput(f"resolution is {resolution}; at least {2 * MULTIPLE} texels are needed.")
        self.texel, self.origin, self.shape = _frame(self.uv, resolution, bounds)
        self._places()

    def at(self, resolution: int, bounds: tuple[float, float, float, float] | None = None) -> UvChart:
        """The same chart at another resolution."""
        return UvChart(self.vertices, self.faces, self.uv, resolution=resolution, bounds=bounds)

    def to_texels(self, values: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
        """Values at the vertices, (V, k) or (V,), as an image (H, W, k) of the same dtype; 0 off the chart.

        Linear on each face; the padding around an island extrapolates its nearest face. See `mask`.
        """
        table = np.asarray(values)
        if table.shape[0] != len(self.vertices) or table.ndim > 2:
            raise InvalidInput(f"values have shape {table.shape}; expected ({len(self.vertices)}, k).")
        if table.dtype not in (np.float32, np.float64):
            table = table.astype(np.float64)
        table = np.ascontiguousarray(table.reshape(len(table), -1))
        image = np.zeros((*self.shape, table.shape[1]), table.dtype) if out is None else out
        index, corners, weights = self._raster
        _gather(image.reshape(-1, table.shape[1]), index, corners, weights.astype(table.dtype, copy=False), table)
        return image

    def to_vertices(self, image: ArrayLike) -> np.ndarray:
        """An image (H, W, k) sampled bilinearly at the vertices, (V, k); a seam's vertices average their places."""
        flat = self._flat(image)
        result = np.zeros((len(self.vertices), flat.shape[1]), flat.dtype)
        _sample(result, flat, self.place_vertex, *self._taps, self._share.astype(flat.dtype, copy=False))
        return result

    def seam_gap(self, image: ArrayLike) -> PerVertex:
        """How far the places of each seam vertex disagree in `image`, in its unit, (len(seam_vertices),)."""
        flat = self._flat(image)
        texels, weights = (table[self._seam_places] for table in self._taps)
        places = np.einsum("pt,ptk->pk", weights, flat[texels])
        owner = np.searchsorted(self.seam_vertices, self.place_vertex[self._seam_places])
        low = np.full((len(self.seam_vertices), flat.shape[1]), np.inf)
        high = -low
        np.minimum.at(low, owner, places)
        np.maximum.at(high, owner, places)
        return np.linalg.norm(high - low, axis=1)

    @cached_property
    def seam_vertices(self) -> np.ndarray:
        """Numbers of the vertices with more than one place in the image, sorted."""
        return np.flatnonzero(np.bincount(self.place_vertex) > 1)

    @cached_property
    def _seam_places(self) -> np.ndarray:
        return np.flatnonzero(np.bincount(self.place_vertex)[self.place_vertex] > 1)

    @cached_property
    def mask(self) -> np.ndarray:
        """Texels whose centres lie on a face, (H, W) bool; the padding does not count."""
        return self._cover >= 0

    @cached_property
    def texel_area(self) -> np.ndarray:
        """Area of skin that one texel covers, on each face, (F,) [m2]."""
        p = self.vertices[self.faces]
        area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
        return area / np.abs(doubled_area(self.uv)) * self.texel**2

    @property
    def mm_per_texel(self) -> tuple[float, float, float]:
        """Smallest, median and largest length of skin along a texel [mm], as the root of its area."""
        mm = np.sqrt(self.texel_area) * 1e3
        return float(mm.min()), float(np.median(mm)), float(mm.max())

    @cached_property
    def stretch(self) -> np.ndarray:
        """Singular values of the map from texels to the skin on each face, larger first, (F, 2) [m a texel]."""
        p, q = self.vertices[self.faces], self.uv / self.texel
        skin = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=-1)
        flat = np.stack([q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]], axis=-1)
        return np.linalg.svd(skin @ np.linalg.inv(flat), compute_uv=False)

    def _flat(self, image: ArrayLike) -> np.ndarray:
        array = np.asarray(image)
        if array.shape[:2] != self.shape:
            raise InvalidInput(f"the image has shape {array.shape}; expected ({self.shape[0]}, {self.shape[1]}, k).")
        if array.dtype not in (np.float32, np.float64):
            array = array.astype(np.float64)
        return np.ascontiguousarray(array).reshape(self.shape[0] * self.shape[1], -1)

    def _pixels(self, uv: np.ndarray) -> np.ndarray:
        """(column, row) of UVs, in texels; integers are texel centres."""
        return (uv - self.origin) * np.array([1, -1]) / self.texel - 0.5

    def _places(self) -> None:
        """Numbers the distinct places (vertex, uv) and finds the texels that an image is sampled from there."""
        key = np.column_stack([self.faces.ravel(), self.uv.reshape(-1, 2)])
        _, first, corner_place = np.unique(np.round(key, 9), axis=0, return_index=True, return_inverse=True)
        self.place_vertex = self.faces.ravel()[first]
        self.corner_place = corner_place.reshape(-1, 3)
        self._share = (1 / np.bincount(self.place_vertex, minlength=len(self.vertices)))[self.place_vertex]
        self._taps = _bilinear(self._pixels(self.uv.reshape(-1, 2)[first]), self.shape)

    @cached_property
    def _cover(self) -> np.ndarray:
        """The face over each texel centre, or -1, (H, W)."""
        cover, over = _rasterise(self._pixels(self.uv), self.shape)
        if over > 0.01 * (cover >= 0).sum():
            raise MeshError(f"{over} of {(cover >= 0).sum()} texels lie under more than one face: the UVs overlap.")
        if over:
            log.warning("%d of %d texels lie under more than one face; the last one counts", over, (cover >= 0).sum())
        return cover

    @cached_property
    def _raster(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For each texel that carries a value: its number, the vertices of its face, and their weights."""
        from scipy.ndimage import distance_transform_edt

        distance, nearest = cast(tuple, distance_transform_edt(self._cover < 0, return_indices=True))
        row, column = np.nonzero(distance <= PADDING)
        face = self._cover[tuple(nearest[:, row, column])]
        corners = self._pixels(self.uv[face])
        here = np.column_stack([column, row])
        d1, d2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], here - corners[:, 0]
        det = _cross(d1, d2)
        b, c = _cross(d, d2) / det, _cross(d1, d) / det
        index = (row * self.shape[1] + column).astype(np.int32)
        return index, self.faces[face], np.ascontiguousarray(np.column_stack([1 - b - c, b, c]), dtype=np.float32)


def doubled_area(uv: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles (F, 3, 2), positive counter-clockwise."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _frame(
    uv: np.ndarray, resolution: int, bounds: tuple[float, float, float, float] | None
) -> tuple[float, np.ndarray, tuple[int, int]]:
    """Width of a texel in UV, the top left corner of the image in UV, and its (H, W)."""
    if (np.abs(doubled_area(uv)) <= 1e-14).any():
        raise MeshError(f"{int((np.abs(doubled_area(uv)) <= 1e-14).sum())} faces have no area in UV.")
    low, high = uv.min(axis=(0, 1)), uv.max(axis=(0, 1))
    if bounds is not None:
        if (low < bounds[:2]).any() or (high > bounds[2:]).any():
            raise InvalidInput(f"UVs lie in {low}..{high}, outside the bounds {bounds}.")
        low, high = np.array(bounds[:2], float), np.array(bounds[2:], float)
    margin = 0 if bounds is not None else PADDING
    size = high - low
    texel = float(size.max() / (resolution - 2 * margin))
    texels = np.ceil((size / texel + 2 * margin - 1e-6) / MULTIPLE).astype(int) * MULTIPLE
    texels[size.argmax()] = resolution
    middle = (low + high) / 2
    return texel, middle + texels * texel / 2 * np.array([-1, 1]), (int(texels[1]), int(texels[0]))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _bilinear(pixels: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The four texels around (column, row) positions and their weights, each (P, 4)."""
    height, width = shape
    x, y = np.clip(pixels[:, 0], 0, width - 1), np.clip(pixels[:, 1], 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    a, b = x - left, y - top
    texels = (top * width + left)[:, None] + np.array([0, 1, width, width + 1])
    weights = np.column_stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    return texels.astype(np.int32), weights.astype(np.float32)


@numba.njit(cache=True)
def _rasterise(corners: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, int]:
    """The face over each texel centre, and how many centres lie well inside more than one."""
    cover = np.full(shape, -1, np.int32)
    deep = np.zeros(shape, np.bool_)
    over = 0
    for f in range(len(corners)):
        (x0, y0), (x1, y1), (x2, y2) = corners[f, 0], corners[f, 1], corners[f, 2]
        det = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        for row in range(max(0, int(np.ceil(min(y0, y1, y2)))), min(shape[0] - 1, int(np.floor(max(y0, y1, y2)))) + 1):
            for column in range(
                max(0, int(np.ceil(min(x0, x1, x2)))), min(shape[1] - 1, int(np.floor(max(x0, x1, x2)))) + 1
            ):
                b = ((column - x0) * (y2 - y0) - (x2 - x0) * (row - y0)) / det
                c = ((x1 - x0) * (row - y0) - (column - x0) * (y1 - y0)) / det
                least = min(b, c, 1 - b - c)
                if least >= -1e-12:
                    over += least > 1e-6 and deep[row, column]
                    deep[row, column] |= least > 1e-6
                    cover[row, column] = f
    return cover, over


@numba.njit(cache=True)
def _gather(image: np.ndarray, index: np.ndarray, corners: np.ndarray, weights: np.ndarray, table: np.ndarray) -> None:
    """image[index] = sum over corners of weights * table[corners]."""
    for n in range(len(index)):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        wa, wb, wc = weights[n, 0], weights[n, 1], weights[n, 2]
        for k in range(table.shape[1]):
            image[index[n], k] = wa * table[a, k] + wb * table[b, k] + wc * table[c, k]


@numba.njit(cache=True)
def _sample(
    result: np.ndarray, flat: np.ndarray, owner: np.ndarray, texels: np.ndarray, weights: np.ndarray, share: np.ndarray
) -> None:
    """result[owner] += share * sum over taps of weights * flat[texels]."""
    for p in range(len(owner)):
        for t in range(4):
            w = share[p] * weights[p, t]
            for k in range(flat.shape[1]):
                result[owner[p], k] += w * flat[texels[p, t], k]
