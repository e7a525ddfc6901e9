"""Solids: surfaces of balls, capsules, cylinders and boxes, whose distance is a formula.

A formula takes a tenth of a spline's time and needs no grid, which for a table that is 1 m wide and 20 mm thick cannot
be fine enough. What kernels take of a solid is an array (1, KIND, N), where a spline has its coefficients: no grid has
one plane alone. Its first N numbers are lengths along the tool's axes [m], so that they grow with the tool:

    CAPSULE, CYLINDER   both ends of the axis, and the radius (7); a ball is a capsule whose ends are one point
    BOX                 the middle, and the ways from there to the middles of three sides (12)
"""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.arrays import Points
from stmpl_core.compiling import UNCOUNTED

CAPSULE, CYLINDER, BOX = 1, 2, 3
ROUND_OFF = 2e-3  # largest distance of a mesh from the round solid that it is taken for, over the radius
LIKE = 0.1  # the same of a first guess, from which the best one is looked for
FLAT_OFF = 1e-5  # the same of flat sides, over the radius, or a box's longest half edge; and of its volume, over that
MOST_FITTED = 2000  # corners of a surface through which the best solid is laid
CELLS = 8.0  # cells of a grid across a cylinder or a box, from which the grid is as good, and rounds its edges, if they
FINE = 7e-4  # are no larger than this [m]: flat faces are up to a third of a cell off near their edges
NEAREST = 1e-12  # distance from an axis below which no way leads out [m]
STEP = 1e-6  # step of the differences of a gradient [m]


def solid_of(vertices: Points, faces: np.ndarray, spacing: float) -> np.ndarray | None:
    """The solid that a closed surface stands for; a round one with the radius that the triangles have in the mean.

    Args:
        vertices: corners (V, 3) [m].
        faces: triangles (F, 3), counter-clockwise seen from outside.
        spacing: edge of the cells of the grid that it would have [m].

    Returns:
        See the module; None: it is no such solid, or is a box or a cylinder that the grid knows well.
    """
    used, corners = vertices[np.unique(faces)], vertices[faces]
    ways = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if (numbers := _box(used, corners, ways)) is not None:
        least = 2 * np.linalg.norm(numbers[3:].reshape(3, 3), axis=1).min()
        return _packed(BOX, numbers) if _coarse(least, spacing) else None
    area = np.linalg.norm(ways, axis=1)
    places = 0.5 * (corners + corners[:, [1, 2, 0]]).reshape(-1, 3)
    weights = np.repeat(area / (3 * area.sum()), 3)  # with these a sum over the places is exact for squares
    away, fit = np.concatenate([used, places, corners.mean(axis=1)]), used[:: 1 + len(used) // MOST_FITTED]
    for kind, guess in ((CAPSULE, _ball), (CAPSULE, _capsule), (CYLINDER, _cylinder)):
        numbers = guess(used, places, weights)
        if not np.abs(_off(kind, numbers, used)).max() < LIKE * numbers[6] < LIKE * np.ptp(used, axis=0).max():
            continue
        if kind == CYLINDER and not _coarse(min(2 * numbers[6], np.linalg.norm(numbers[3:6] - numbers[:3])), spacing):
            continue
        numbers = _through(kind, numbers, fit)
        sides = _on_side(kind, numbers, places)
        if not sides.any():
            continue
        numbers[6] += weights[sides] @ _off(kind, numbers, places[sides]) / weights[sides].sum()
        most = np.where(_on_side(kind, numbers, away), ROUND_OFF, FLAT_OFF) * numbers[6]
        if (np.abs(_off(kind, numbers, away)) < most).all():
            return _packed(kind, numbers)
    return None


def _coarse(least: float, spacing: float) -> bool:
    """Whether a grid is too coarse for the flat faces of a solid, whose shortest length is told [m]."""
    return bool(least < CELLS * spacing or spacing > FINE)


def half_of(solid: np.ndarray) -> float:
    """Largest distance inside a solid from its surface [m]: of a box and a cylinder half of what is least."""
    numbers = solid[0, 0]
    if solid.shape[1] == BOX:
        return float(np.linalg.norm(numbers[3:].reshape(3, 3), axis=1).min())
    half = 0.5 * np.linalg.norm(numbers[3:6] - numbers[:3])
    return float(min(numbers[6], half) if solid.shape[1] == CYLINDER else numbers[6])


def _packed(kind: int, numbers: np.ndarray) -> np.ndarray:
    out = np.zeros((1, kind, len(numbers)))
    out[0, 0] = numbers
    return out


def _box(points: Points, corners: np.ndarray, ways: np.ndarray) -> np.ndarray | None:
    """The box whose sides all triangles lie in, twelve numbers; ways: normals of the triangles, as long as twice
    their areas, (F, 3)."""
    first = ways[np.linalg.norm(ways, axis=1).argmax()]
    across = np.linalg.norm(np.cross(ways, first / np.linalg.norm(first)), axis=1)
    first = first / np.linalg.norm(first)
    second = np.cross(first, np.cross(ways[across.argmax()], first))
    if not np.linalg.norm(second) > 0:
        return None
    axes = np.array([first, second / np.linalg.norm(second), np.cross(first, second) / np.linalg.norm(second)])
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    side = np.abs(ways @ axes.T).argmax(axis=1)
    apart = np.abs((corners @ axes.T - middle)[np.arange(len(side)), :, side]) - half[side, None]
    volume = np.einsum("fx,fx->", corners[:, 0] - corners[0, 0], ways) / 6
    if np.abs(apart).max() > FLAT_OFF * half.max() or abs(volume / (8 * half.prod()) - 1) > FLAT_OFF:
        return None
    return np.concatenate([middle @ axes, (half[:, None] * axes).ravel()])


def _ball(points: Points, *_: np.ndarray) -> np.ndarray:
    """The ball whose surface is nearest to points, by their squares."""
    middle = points.mean(axis=0)
    away = points - middle
    x = np.linalg.lstsq(np.column_stack([2 * away, np.ones(len(away))]), (away**2).sum(axis=1), rcond=None)[0]
    return np.concatenate([middle + x[:3], middle + x[:3], [np.sqrt(max(x[3] + x[:3] @ x[:3], 0.0))]])


def _capsule(points: Points, places: Points, weights: np.ndarray) -> np.ndarray:
    """The capsule around points along the way in which places are spread most."""
    middle, along, far, radius = _about(points, places, weights, 2)
    low, high = min(far.min() + radius, 0.0), max(far.max() - radius, 0.0)
    return np.concatenate([middle + low * along, middle + high * along, [radius]])


def _cylinder(points: Points, places: Points, weights: np.ndarray) -> np.ndarray:
    """The cylinder around points about the axis that the two others are most alike to."""
    spread = np.linalg.eigvalsh(_spread(places, weights))
    axis = 2 if spread[2] - spread[1] > spread[1] - spread[0] else 0
    middle, along, far, radius = _about(points, places, weights, axis)
    return np.concatenate([middle + far.min() * along, middle + far.max() * along, [radius]])


def _spread(places: Points, weights: np.ndarray) -> np.ndarray:
    away = places - weights @ places
    return (weights[:, None] * away).T @ away


def _about(points: Points, places: Points, weights: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray,
                                                                                 float]:  # fmt: skip
    """Middle of places, one of their principal axes, how far points are along it, and at most from it [m]."""
    middle, along = weights @ places, np.linalg.eigh(_spread(places, weights))[1][:, axis]
    far = (points - middle) @ along
    return middle, along, far, float(np.linalg.norm(points - middle - far[:, None] * along, axis=1).max())


def _through(kind: int, guess: np.ndarray, points: Points) -> np.ndarray:
    """The round solid, or the ball, whose surface is nearest to points."""
    from scipy.optimize import least_squares

    if (guess[:3] == guess[3:6]).all():
        return guess
    return least_squares(lambda numbers: _off(kind, numbers, points), guess, x_scale=guess[6]).x


def _on_side(kind: int, numbers: np.ndarray, points: Points) -> np.ndarray:
    """Mask of points that the radius says where they are, not the ends of a cylinder, (N,)."""
    if kind == CAPSULE:
        return np.ones(len(points), bool)
    start, way = numbers[:3], numbers[3:6] - numbers[:3]
    share = (points - start) @ way / (way @ way)
    out = np.linalg.norm(points - start - share[:, None] * way, axis=1) - numbers[6]
    return out > -np.minimum(share, 1 - share) * np.linalg.norm(way)


def _off(kind: int, numbers: np.ndarray, points: Points) -> np.ndarray:
    """Distances of points (N, 3) to a solid, (N,) [m]."""
    return _distances(_packed(kind, numbers), points)


@numba.njit(cache=True, nogil=True)
def _distances(solid, points):
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = solid_jet(solid, points[n, 0], points[n, 1], points[n, 2])[0]
    return out


@numba.njit(cache=True, inline="always")
def to_solid(solid, x, y, z):
    """Signed distance of a point to a solid [m]."""
    if solid.shape[1] > CAPSULE:
        return solid_jet(solid, x, y, z)[0]
    x, y, z = _from_axis(solid[0, 0], x, y, z)
    return np.sqrt(x * x + y * y + z * z) - solid[0, 0, 6]


@numba.njit(cache=True, inline="always")
def _from_axis(c, x, y, z):
    """Way from a capsule's axis to a point, three numbers [m]."""
    x, y, z = x - c[0], y - c[1], z - c[2]
    a, b, d = c[3] - c[0], c[4] - c[1], c[5] - c[2]
    along, square = x * a + y * b + z * d, a * a + b * b + d * d
    share = 0.0 if along <= 0 else 1.0 if along >= square else along / square
    return x - share * a, y - share * b, z - share * d


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def solid_jet(solid, x, y, z):
    """Signed distance of a point to a solid [m], and its gradient: four numbers."""
    c = solid[0, 0]
    if solid.shape[1] == BOX:
        return _box_jet(c, x - c[0], y - c[1], z - c[2])
    if solid.shape[1] == CAPSULE:
        x, y, z = _from_axis(c, x, y, z)
        away = np.sqrt(x * x + y * y + z * z)
        per = 1 / max(away, NEAREST)
        return away - c[6], x * per, y * per, z * per
    x, y, z, u, v, w = x - c[0], y - c[1], z - c[2], c[3] - c[0], c[4] - c[1], c[5] - c[2]
    long = np.sqrt(u * u + v * v + w * w)
    u, v, w = u / long, v / long, w / long
    along = x * u + y * v + z * w
    x, y, z = x - along * u, y - along * v, z - along * w
    away = np.sqrt(x * x + y * y + z * z)
    aside, beyond, per, sign = away - c[6], max(-along, along - long), 1 / max(away, NEAREST), 1.0
    if along < 0.5 * long:
        sign = -1.0
    a, b = (1.0, 0.0) if aside > beyond else (0.0, 1.0)  # inside the nearer of side and end counts
    d = max(aside, beyond)
    if min(aside, beyond) > 0:
        d = np.sqrt(aside * aside + beyond * beyond)
        a, b = aside / d, beyond / d
    a, b = a * per, b * sign
    return d, a * x + b * u, a * y + b * v, a * z + b * w


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _box_jet(c, x, y, z):
    """See solid_jet, of a box, and a point beside its middle [m]."""
    most, square, g, nearest = -np.inf, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(3):
        u, v, w = c[3 + 3 * k], c[4 + 3 * k], c[5 + 3 * k]
        half = np.sqrt(u * u + v * v + w * w)
        at = (x * u + y * v + z * w) / half
        over, per = abs(at) - half, (1.0 if at > 0 else -1.0) / half
        if over > most:
            most, nearest = over, (per * u, per * v, per * w)
        if over > 0:
            square += over * over
            g = (g[0] + over * per * u, g[1] + over * per * v, g[2] + over * per * w)
    if square == 0:
        return most, nearest[0], nearest[1], nearest[2]
    d = np.sqrt(square)
    return d, g[0] / d, g[1] / d, g[2] / d


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bend_of_solid(solid, x, y, z, out):
    """Writes the Hessian (3, 3) [1/m] of the distance of a point to a solid: differences of its gradient."""
    for axis in range(3):
        a, b, c = (STEP if axis == 0 else 0.0), (STEP if axis == 1 else 0.0), (STEP if axis == 2 else 0.0)
        far, near = solid_jet(solid, x + a, y + b, z + c), solid_jet(solid, x - a, y - b, z - c)
        out[0, axis], out[1, axis], out[2, axis] = ((far[1] - near[1]) / (2 * STEP), (far[2] - near[2]) / (2 * STEP),
                                                    (far[3] - near[3]) / (2 * STEP))  # fmt: skip
