"""SignedDistance: the distance to a tool's surface as a smooth (C2) field, negative inside, built once per mesh."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numba
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from stmpl_core.arrays import Points, check_kind, check_number, finite
from stmpl_core.compiling import UNCOUNTED
from stmpl_core.decimation import BAND_CELLS, MARGIN, MAX_NODES, field_spacing
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.mending import closed, openings, places
from stmpl_core.solids import bend_of_solid, half_of, solid_jet, solid_of, to_solid
from stmpl_core.spline import spline_sum
from stmpl_core.tool import Tool
from stmpl_core.walls import areas, outer_walls
from stmpl_core.winding import winding_numbers

log = logging.getLogger(__name__)

MAX_EXTENT = 2.0  # largest extent of a tool [m]; that of a mesh in millimetres is larger
MIN_EXTENT = 2e-4  # smallest extent of a tool [m]
COARSE = 3  # factor by which the grid far from the surface is coarser
COARSER = 1.02  # factor by which the cells of a grid grow until it fits
COLLAR = 2 * COARSE  # nodes around the grid that splines end beyond: at their ends they are flat, and far off
FAST = {"contract", "reassoc", "nsz"}  # sums of splines may be taken in any order
ONE, TWO, THREE = np.uint64(1), np.uint64(2), np.uint64(3)
SIXTH = 1 / 6  # dividing takes several times as long as multiplying
MOST_KEPT, MOST_KEPT_BYTES = 16, 8e6  # fields that are kept for the next caller, and the largest of them
MOST_OPENINGS, NO_POINTS = 1000, np.empty((0, 3))  # places at the rims of holes that are kept
CHECKED, ALIKE = 100, 3  # places at which a field is checked, and how many of these say what it is off at one
NO_CHECKS = np.empty((0, 4))
MOST_CHECKS = CHECKED + 27  # number of them with those farthest out
TIPS, STANDS_OUT = 256, 0.05  # tips that are known, and how far they stand out at least, over the spacing
MOST_EDGES, SHARP = 1000, np.cos(np.radians(30.0))  # places along edges that are looked at; cosine between their faces
BLUNT = 0.95  # mean of the normals around a corner that is no tip
CORNERS, DEEP_CORNER = 64, 1.5  # sharpest corners that are known; depth over the thickness to which they are looked for
LOST, LOOKS = 0.02, 80  # largest way inwards on which a tip's surface is looked for [m], and places on it
PROBED, THICK = 600, 5e-3  # places of a tool from which its thickness is told, and the largest half of it [m]
ROUNDING_WIDTH = 0.57  # width of the smoothing over the radius that it gives a right-angled edge, measured


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """Cubic B-spline on a regular grid in the tool's frame (Unser 1999, "Splines: a perfect fit").

    Nodes within three cells of the surface hold exact distances, signed by the winding number (of a mesh with holes,
    so that it has an inside too, the fast one of Barill et al. 2018); the others are interpolated from a grid three
    times coarser. Walls inside the tool, of bodies that overlap or abut, are no surface (see stmpl_core.walls).
    Smooth faces are met to about spacing^2 / radius / 100, edges and corners are rounded by about a sixth of the
    spacing; `surface_error` is what was measured on this mesh. Outside the grid the answer is sqrt(|x - c|^2 +
    d(c)^2), c the nearest point of the grid: continuous, and never more than the true distance, because the tool lies
    inside the (convex) grid.

    A ball and a capsule need no grid: their distance is a formula, which holds everywhere (see stmpl_core.solids). So
    do cylinders and boxes that are thin beside the grid's cells: sticks, boards, tables.

    Args:
        coefficients: weights of the spline, (I, J, K) [m]; of a solid see stmpl_core.solids.
        origin: position of node (0, 0, 0), (3,) [m].
        spacing: edge of the grid's cells [m].
        watertight: flag of a closed mesh; if it is not, the sign near its holes is a guess.
        flipped: flag of a mesh that came inside out, and was turned.
        surface_error: largest |distance| at the vertices and face centres of the mesh, where it should be 0 [m].
        tool_bounds: lowest and highest corner of the mesh, (3,) [m] each.
        half_thickness: how far inside the tool one gets at most from most of its surface [m]; at most THICK.
        checks: places spread over the surface, and those farthest out, with how far that is off around each: the least
            of ALIKE places, as edges are off by more than faces, (K, 4) [m]; none where edges are rounded on purpose.
        openings: places at the rims of its holes, (K, 3) [m].
        tips: corners of the mesh, and places along its sharp edges, that stand out of the rounded surface, at most
            TIPS of them, each with how far the surface lies inwards from there, the farthest first, (K, 4) [m].
        corners: its corners, the sharpest first, at most CORNERS, (K, 3) [m]; none where they are rounded on purpose.
    """

    coefficients: np.ndarray
    origin: np.ndarray
    spacing: float
    watertight: bool
    flipped: bool
    surface_error: float
    tool_bounds: tuple[np.ndarray, np.ndarray]
    half_thickness: float = math.inf
    checks: np.ndarray = field(default_factory=lambda: NO_CHECKS)
    openings: Points = field(default_factory=lambda: NO_POINTS)
    tips: np.ndarray = field(default_factory=lambda: NO_CHECKS)
    corners: Points = field(default_factory=lambda: NO_POINTS)

    @classmethod
    def of(
        cls, mesh: Tool, *, spacing: float | None = None, margin: float = MARGIN, rounding: float = 0.0
    ) -> Self:
        """Builds the distance field of `mesh`; a closed mesh that is inside out is turned, and `flipped` says so.

        The last few fields are kept: that of the same surface again takes no time.

        Args:
            mesh: surface in the tool's frame.
            spacing: edge of the grid's cells [m]; None: as fine as half a second of work allows (0.4 mm for a 20 mm
                cube), and no grid for a solid.
            margin: width of the grid around the tool [m].
            rounding: radius to which right-angled edges and corners are rounded [m], by smoothing the field; flat
                faces stay, a ball of radius R shrinks by about rounding^2 / (3 R). No skin mesh can follow a sharp
                edge: pressing by finite elements wants about 1 mm.

        Raises:
            MeshError: a surface without area, or an extent that no tool in metres has.
            InvalidInput: numbers that are not finite, or a spacing so fine that the grid would not fit in memory.
        """
        check_kind("the tool", mesh, Tool)
        if spacing is not None:
            check_number("spacing", spacing)
        key = (cls, mesh.digest, spacing, margin, rounding)
        if kept := _KEPT.get(key):
            return kept
        vertices, faces, watertight, flipped = _checked(mesh)
        used = vertices[np.unique(faces)]
        finest = field_spacing(float(areas(vertices[faces]).sum()), np.ptp(used, axis=0), margin)
        solid = solid_of(vertices, faces, finest) if watertight and spacing is None and not rounding else None
        if solid is None:
            made = _on_grid(mesh, vertices, faces, watertight, spacing, finest, margin, rounding)
            coefficients, origin, spacing, outer, seen = made
        else:
            outer, seen = _whole(vertices, faces)
            coefficients, origin, spacing = solid, used.min(axis=0), finest
        error = float(np.abs(_distances(coefficients, origin, spacing, seen)).max())
        half = _half_thickness(coefficients, origin, spacing, *outer)
        places = _spread_over(*outer) if not rounding else NO_POINTS
        away = np.abs(_distances(coefficients, origin, spacing, places))
        checks = np.column_stack([places, away[KDTree(places).query(places, ALIKE)[1]].min(axis=1)]) \
            if len(places) else NO_CHECKS
        rims = NO_POINTS if watertight else openings(vertices, faces)
        rims = rims[:: 1 + len(rims) // MOST_OPENINGS]
        tips = _tips(coefficients, origin, spacing, vertices, faces)  # what lies inside another body does not stand out
        box = used.min(axis=0), used.max(axis=0)
        corners = NO_POINTS if rounding else _corners(*outer)
        built = cls(coefficients, origin, spacing, watertight, flipped, error, box, half, checks, rims, tips, corners)
        if coefficients.nbytes <= MOST_KEPT_BYTES:
            _KEPT[key] = built
            for old in list(_KEPT)[:-MOST_KEPT]:
                _KEPT.pop(old, None)  # another thread may have
        return built

    def opening(self, points: ArrayLike) -> float:
        """Least distance of points (N, 3) [m] of the tool's frame from the rim of a hole [m]; infinite without one."""
        return float(self._rims.query(np.asarray(points))[0].min(initial=np.inf)) if len(self.openings) else np.inf

    @cached_property
    def _rims(self) -> KDTree:
        return KDTree(self.openings)

    @cached_property
    def mostly_off(self) -> float:
        """How far two thirds of the surface are off at most [m]."""
        return float(np.quantile(self.checks[:, 3], 2 / 3)) if len(self.checks) else 0.0

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box in which the field holds, in the tool's frame, (3,) [m] each."""
        if self.coefficients.shape[0] == 1:
            return np.full(3, -np.inf), np.full(3, np.inf)
        high = self.origin + self.spacing * (np.array(self.coefficients.shape) - 2)
        return self.origin + self.spacing, high

    def distance(self, points: ArrayLike) -> np.ndarray:
        """Signed distance at `points` (N, 3) [m] of the tool's frame, (N,) [m]. Raises InvalidInput if not finite."""
        return _distances(self.coefficients, self.origin, self.spacing, finite("points", points, (None, 3)))

    def distance_gradient(self, points: ArrayLike) -> tuple[np.ndarray, Points]:
        """Distance (N,) [m] and its gradient (N, 3) [-], the outward direction of the tool."""
        points = finite("points", points, (None, 3))
        return distances_and_gradients(self.coefficients, self.origin, self.spacing, points)

    def distance_gradient_hessian(self, points: ArrayLike) -> tuple[np.ndarray, Points, np.ndarray]:
        """Distance (N,) [m], gradient (N, 3) [-] and Hessian (N, 3, 3) [1/m], the tool's curvature."""
        return _jets(self.coefficients, self.origin, self.spacing, finite("points", points, (None, 3)))


_KEPT: dict[tuple, Any] = {}  # the last built, by what they were built from


def _checked(mesh: Tool) -> tuple[Points, np.ndarray, bool, bool]:
    """Vertices, faces with area, whether they are closed, whether they were turned."""
    vertices = finite("tool vertices", mesh.vertices, (None, 3))
    faces = np.asarray(mesh.faces)
    if not len(vertices) or not len(faces):
        raise MeshError(f"the tool's mesh is empty: {len(vertices)} vertices, {len(faces)} faces.")
    used = vertices[np.unique(faces)]
    extent = float(np.ptp(used, axis=0).max())
    if extent > MAX_EXTENT:
        raise MeshError(f"the tool is {extent:.1f} m wide; at most {MAX_EXTENT:g} m is accepted. "
                        "Is its mesh in millimetres? Scale it by 1e-3.")
    if extent < MIN_EXTENT:
        raise MeshError(f"the tool is {extent:.4g} m wide; at least {MIN_EXTENT:g} m is needed. Is its mesh in metres?")
    watertight = closed(vertices, faces)
    area = areas(vertices[faces])
    faces = faces[area > 1e-12 * area.max()].astype(np.int64)
    if not len(faces) or area.max() < 1e-12:
        raise MeshError(f"the tool's largest face has {area.max():.2g} m2: there is no surface to touch with.")
    corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6
    flipped = watertight and volume < 0
    if flipped:
        log.warning("the tool's mesh is inside out (volume %.3g m3); its faces are turned", volume)
        faces = np.ascontiguousarray(faces[:, ::-1])
    if not watertight:
        log.warning("the tool's mesh has holes; what is inside it near them is a guess")
    return np.ascontiguousarray(vertices), faces, watertight, flipped


def _on_grid(mesh: Tool, vertices: Points, faces: np.ndarray, watertight: bool, spacing: float | None, finest: float,
             margin: float, rounding: float) -> tuple[np.ndarray, np.ndarray, float, tuple[Points, np.ndarray],
                                                      Points]:  # fmt: skip
    """Coefficients, origin and spacing of a spline for a surface; what is outside of it, and places on that.

    finest: spacing that all of the surface would have, its inner walls too [m].
    """
    from scipy import ndimage  # who only reads a field need not wait for what builds it

    used = vertices[np.unique(faces)]
    low, extent = used.min(axis=0), np.ptp(used, axis=0)
    outer, seen = _outside(vertices, faces, finest)
    chosen = spacing is None
    if spacing is None:
        spacing = field_spacing(float(areas(outer[0][outer[1]]).sum()), extent, margin)
    elif not (np.isfinite(spacing) and spacing > 0):
        raise InvalidInput(f"spacing is {spacing} m; it must be finite and above 0.")
    shape = _nodes_each_way(extent, margin, spacing)
    while chosen and shape.prod() > MAX_NODES:  # whole cells are more than was reckoned
        spacing *= COARSER
        shape = _nodes_each_way(extent, margin, spacing)
    nodes = float(np.prod(shape.astype(float)))
    if nodes > MAX_NODES:
        raise InvalidInput(f"a grid of {spacing * 1e3:.3g} mm has {nodes:.3g} nodes; at most {MAX_NODES:.3g} fit. "
                           "Try a larger spacing, or None.")  # fmt: skip
    origin = low + extent / 2 - spacing * (shape - 1) / 2
    corner, many = origin - COLLAR * spacing, shape + 2 * COLLAR
    rounds = None
    if watertight:  # by all faces, also those without area: they close seams
        rounds = winding_numbers(vertices[places(vertices)[mesh.faces]], corner, spacing, many)
    values = _node_distances(vertices, faces, outer, rounds, corner, spacing, many)
    if rounding > 0:
        values = ndimage.gaussian_filter(values, ROUNDING_WIDTH * rounding / spacing, mode="nearest")
    inner = (slice(COLLAR, -COLLAR),) * 3
    coefficients = np.ascontiguousarray(ndimage.spline_filter(values, order=3, mode="mirror")[inner])
    return coefficients, origin, spacing, outer, seen


def _nodes_each_way(extent: np.ndarray, margin: float, spacing: float) -> np.ndarray:
    return COARSE * (np.ceil((extent + 2 * margin) / (COARSE * spacing)).astype(int) + 1) + 1


def _finer(coarse: np.ndarray) -> np.ndarray:
    """The cubic spline through the nodes of a grid (I, J, K) at those of one COARSE times as fine.

    ndimage.zoom says the same, ten times as slowly.
    """
    from scipy import ndimage

    out = np.asarray(ndimage.spline_filter(coarse, order=3, mode="mirror"))
    for axis in range(3):
        lines = np.pad(np.moveaxis(out, axis, 0), ((1, 2), (0, 0), (0, 0)), mode="reflect")
        many = out.shape[axis]
        fine = np.empty((COARSE * (many - 1) + 1, *lines.shape[1:]))
        for r in range(COARSE):
            ends = many - (r > 0)
            fine[r::COARSE] = sum(w * lines[q : q + ends] for q, w in enumerate(_cubic.py_func(r / COARSE)))
        out = np.moveaxis(fine, 0, axis)
    return np.ascontiguousarray(out)


def _spread_over(vertices: Points, faces: np.ndarray) -> Points:
    """Places of a surface by its area, CHECKED of them, and middles of the triangles farthest out each way, (K, 3)."""
    middles, ways = vertices[faces].mean(axis=1), np.array(list(np.ndindex(3, 3, 3))) - 1.0
    farthest = np.unique((middles @ ways.T).argmax(axis=0))
    return np.concatenate([_anywhere(vertices[faces], CHECKED, 1)[0], middles[farthest]])


def _tips(coefficients: np.ndarray, origin: np.ndarray, spacing: float, vertices: Points,
          faces: np.ndarray) -> np.ndarray:  # fmt: skip
    """See SignedDistance, however triangles share corners: those farthest out, and of the others some anywhere."""
    faces = places(vertices)[faces]
    normals, at_vertices, blunt = _faced(vertices, faces)
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(sides.T)
    same = (sides[order[1:]] == sides[order[:-1]]).all(axis=1)
    one, two = order[:-1][same] // 3, order[1:][same] // 3
    sharp = np.einsum("nx,nx->n", normals[one], normals[two]) < SHARP
    ends, out = vertices[sides[order[:-1][same][sharp]]], normals[one[sharp]] + normals[two[sharp]]
    looked = np.concatenate([ends, ends.mean(axis=1, keepdims=True)], axis=1).reshape(-1, 3)
    seen = (_distances(coefficients, origin, spacing, looked).reshape(-1, 3) > 0).any(axis=1)  # not inside another body
    ends, out = ends[seen], out[seen]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    many = np.ceil(length / max(0.5 * spacing, length.sum() / MOST_EDGES, 1e-12)).astype(int)
    number = np.repeat(np.arange(len(many)), many)
    share = (np.arange(len(number)) - np.repeat(np.cumsum(many) - many, many) + 0.5) / many[number]
    used = np.flatnonzero(blunt < BLUNT)
    points = np.concatenate([vertices[used], ends[number, 0] + share[:, None] * (ends[number, 1] - ends[number, 0])])
    inwards = -np.concatenate([at_vertices[used], out[number]])
    away = _distances(coefficients, origin, spacing, points)
    some = np.flatnonzero(away > STANDS_OUT * spacing)
    some = some[np.argsort(-away[some], kind="stable")]
    if len(some) > TIPS:
        rest = np.random.default_rng(0).permutation(some[TIPS // 4 :])
        some = np.concatenate([some[: TIPS // 4], rest[: TIPS - TIPS // 4]])
    points, inwards = points[some], inwards[some]
    inwards /= np.maximum(np.linalg.norm(inwards, axis=1), 1e-300)[:, None]
    way = LOST * np.linspace(0.0, 1.0, LOOKS + 1)[1:] ** 2
    looks = (points[:, None] + way[:, None] * inwards[:, None]).reshape(-1, 3)
    inside = _distances(coefficients, origin, spacing, looks).reshape(-1, LOOKS) <= 0
    lost = np.where(inside.any(axis=1), way[inside.argmax(axis=1)], LOST)
    apart = np.linalg.norm(points[:, None] - points, axis=2)  # at a blade's corner normals may lead along its edge
    lost = (apart + lost).min(axis=1, initial=LOST)
    return np.column_stack([points, lost])[np.argsort(-lost, kind="stable")]


def _corners(vertices: Points, faces: np.ndarray) -> Points:
    """See SignedDistance: vertices whose faces look many ways, however triangles share them."""
    _, _, blunt = _faced(vertices, places(vertices)[faces])
    sharp = np.argsort(blunt, kind="stable")[:CORNERS]
    return vertices[sharp[blunt[sharp] < BLUNT]]


def _faced(vertices: Points, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit normals of faces, (F, 3), their sums at vertices, (V, 3), and sizes of the means there, (V,); without: inf.

    How blunt a corner is: on a face 1, at a tip little.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    sums, met = np.zeros_like(vertices), np.bincount(faces.ravel(), minlength=len(vertices))
    np.add.at(sums, faces.ravel(), np.repeat(normals, 3, axis=0))
    return normals, sums, np.where(met > 0, np.linalg.norm(sums, axis=1) / np.maximum(met, 1), np.inf)


@numba.njit(cache=True, nogil=True)
def deepest_corner(corners, pose, points, inward, thickness, area):
    """Depth of the corner of a tool that is deepest for its column [m], and over the thickness there [-]; 0: of none.

    Columns are asked how deep a tool is in them; a corner may be between two. One deeper than DEEP_CORNER may be
    outside the limb again, on its other side.

    Args:
        corners: see SignedDistance, (K, 3) [m].
        pose: pose_body_from_tool, (4, 4).
        points, inward, thickness, area: of the nodes that are pressed, (N, 3) [m], (N, 3), (N,) [m], (N,) [m2].
    """
    wide, deep, most = 0.0, 0.0, 0.0
    for n in range(len(points)):
        wide = max(wide, 4 * area[n])
    for k in range(len(corners)):
        at = np.empty(3)
        for x in range(3):
            at[x] = pose[x, 3] + pose[x, 0] * corners[k, 0] + pose[x, 1] * corners[k, 1] + pose[x, 2] * corners[k, 2]
        least, own, share = wide, 0.0, 0.0
        for n in range(len(points)):
            a, b, c = at[0] - points[n, 0], at[1] - points[n, 1], at[2] - points[n, 2]
            into = a * inward[n, 0] + b * inward[n, 1] + c * inward[n, 2]
            square = a * a + b * b + c * c - into * into
            if square < least and 0 < into < DEEP_CORNER * thickness[n]:
                least, own, share = square, into, into / thickness[n]
        if share > most:
            deep, most = own, share
    return deep, most


@numba.njit(cache=True, nogil=True)
def lacking(tips, pose, way, points, area, depth):
    """How much deeper a tip is in the skin along a way than a tool is known to be, but for what its surface lacks [m].

    Args:
        tips: see SignedDistance.
        pose: pose_body_from_tool, (4, 4).
        way: unit vector into the skin, (3,).
        points, area: places of nodes that are pressed, (N, 3) [m], and their areas, (N,) [m2].
        depth: how deep the tool is known to be [m].
    """
    lowest, most, wide = np.inf, 0.0, 0.0
    for n in range(len(points)):
        lowest = min(lowest, way[0] * points[n, 0] + way[1] * points[n, 1] + way[2] * points[n, 2])
        wide = max(wide, 2 * np.sqrt(area[n]))
    for k in range(len(tips)):
        at, high = np.empty(3), 0.0
        for x in range(3):
            at[x] = pose[x, 3]
            for y in range(3):
                at[x] += pose[x, y] * tips[k, y]
            high += way[x] * at[x]
        if min(tips[k, 3], high - lowest - depth) <= most:
            continue
        least, deep = (wide + tips[k, 3]) ** 2, 0.0
        for n in range(len(points)):
            a, b, c = at[0] - points[n, 0], at[1] - points[n, 1], at[2] - points[n, 2]
            along = way[0] * a + way[1] * b + way[2] * c
            square = a * a + b * b + c * c - along * along
            if square < least:
                least, deep = square, along
        most = max(most, min(deep - depth, tips[k, 3]))
    return most


def _anywhere(corners: np.ndarray, many: int, seed: int) -> tuple[Points, np.ndarray]:
    """Places of triangles (F, 3, 3) by their areas, (K, 3), and the corners of the triangle of each, (K, 3, 3)."""
    area, rng = areas(corners), np.random.default_rng(seed)
    some = corners[rng.choice(len(corners), many, p=area / area.sum())]
    shares = np.diff(np.sort(rng.uniform(size=(many, 2))), prepend=0.0, append=1.0)
    return np.einsum("pc,pcx->px", shares, some), some


def _half_thickness(coefficients: np.ndarray, origin: np.ndarray, spacing: float, vertices: Points,
                    faces: np.ndarray) -> float:  # fmt: skip
    """See SignedDistance; from PROBED places of the surface, a third of which may be less thick: edges are."""
    if coefficients.shape[0] == 1:
        return min(half_of(coefficients), THICK)
    there, some = _anywhere(vertices[faces], PROBED, 0)
    a, b, c = np.swapaxes(some, 0, 1)
    inwards = -np.cross(b - a, c - a) / (2 * areas(some)[:, None])
    way = np.linspace(0.0, THICK, 1 + int(THICK / min(max(0.5 * spacing, 2e-4), 1e-3)))[1:]
    places = there[:, None] + way[:, None] * inwards[:, None]
    inside = -_distances(coefficients, origin, spacing, places.reshape(-1, 3)).reshape(PROBED, -1)
    inside[np.cumsum(inside <= 0, axis=1) > 0] = 0.0  # beyond the tool's other side
    return max(float(np.quantile(inside.max(axis=1), 2 / 3)), 0.25 * spacing)


def _whole(vertices: Points, faces: np.ndarray) -> tuple[tuple[Points, np.ndarray], Points]:
    """Vertices and faces of a surface, and places on it [m]."""
    return (vertices, faces), np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])


def _outside(vertices: Points, faces: np.ndarray, spacing: float) -> tuple[tuple[Points, np.ndarray], Points]:
    """Vertices and faces of what is outside of a surface, itself if it has no inner walls, and places on that [m]."""
    walls = outer_walls(vertices, faces, spacing)
    if walls is None:
        return _whole(vertices, faces)
    log.info("the tool's mesh has walls inside it, of bodies that overlap; they are left out")
    pieces, whole = walls.pieces, walls.pieces[walls.whole]
    return ((np.ascontiguousarray(pieces.reshape(-1, 3)), np.arange(3 * len(pieces)).reshape(-1, 3)),
            np.concatenate([whole.reshape(-1, 3), whole.mean(axis=1)]))  # fmt: skip


def _node_distances(vertices: Points, faces: np.ndarray, outer: tuple[Points, np.ndarray], rounds: np.ndarray | None,
                    origin: np.ndarray, h: float, shape: np.ndarray) -> np.ndarray:  # fmt: skip
    """Signed distances at all nodes (I, J, K) to what is outside of a surface [m].

    They are exact in the band around the surface, from the coarse grid elsewhere. Rounds are winding numbers at the
    nodes; None: the surface has holes.
    """
    import igl

    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_UNSIGNED

    def exact(nodes: np.ndarray) -> np.ndarray:
        points = origin + h * nodes.astype(float)
        within = igl.fast_winding_number(vertices, faces, points) if rounds is None else np.abs(rounds[tuple(nodes.T)])
        return (1 - 2 * np.clip(within, 0, 1)) * np.asarray(igl.signed_distance(points, *outer, kind)[0])

    index = np.stack(np.meshgrid(*(np.arange(0, n, COARSE) for n in shape), indexing="ij"), axis=-1)
    values = _finer(exact(index.reshape(-1, 3)).reshape(index.shape[:3]))
    band = np.argwhere(np.abs(values) < BAND_CELLS * h)
    values[tuple(band.T)] = exact(band)
    return values


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mean_off(checks, pose, points, forces):
    """How far a surface is off where it presses [m]: the mean over points, at the place beside each.

    Args:
        checks: see SignedDistance.
        pose: pose_body_from_tool, (4, 4).
        points: points of the body's frame, (N, 3) [m].
        forces: their weights, (N,), some above 0.
    """
    total = whole = 0.0
    for n in range(len(points)):
        if forces[n] > 0:
            a, b, c = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
            x = pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c
            y = pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c
            z = pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c
            least, off = np.inf, 0.0
            for k in range(len(checks)):
                a, b, c = checks[k, 0] - x, checks[k, 1] - y, checks[k, 2] - z
                square = a * a + b * b + c * c
                if square < least:
                    least, off = square, checks[k, 3]
            total, whole = total + forces[n] * off, whole + forces[n]
    return total / whole


@numba.njit(cache=True, inline="always")
def _cubic(f):
    """Weights of the four B-splines that reach a point at fraction f of its cell."""
    g = 1.0 - f
    return (SIXTH * (g * g * g), SIXTH * (4 - 6 * f * f + 3 * f * f * f), SIXTH * (4 - 6 * g * g + 3 * g * g * g),
            SIXTH * (f * f * f))  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _weights(f, out):
    """Weights (3, 4) of the four B-splines at fraction f of a cell, and of their first and second derivatives."""
    g = 1.0 - f
    out[0, 0], out[0, 1] = g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6
    out[0, 2], out[0, 3] = (4 - 6 * g * g + 3 * g * g * g) / 6, f * f * f / 6
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = -g * g / 2, (3 * f * f - 4 * f) / 2, (4 * g - 3 * g * g) / 2, f * f / 2
    out[2, 0], out[2, 1], out[2, 2], out[2, 3] = g, 3 * f - 2, 3 * g - 2, f


@numba.njit(cache=True, inline="always")
def _cell(u, n):
    """First of the four nodes that reach coordinate u (in cells), u clamped to where four exist, the fraction."""
    inside = min(max(u, 1.0), n - 2.0)
    first = min(int(inside), n - 3)
    return first - 1, inside, inside - first


@numba.njit(cache=True, nogil=True, fastmath=FAST, **UNCOUNTED)
def _on_line(line, k, c0, c1, c2, c3):
    """Spline along one line of nodes, from node k on."""
    return c0 * line[k] + c1 * line[k + ONE] + (c2 * line[k + TWO] + c3 * line[k + THREE])


@numba.njit(forceinline=True, cache=True, nogil=True, fastmath=FAST, error_model="numpy", **UNCOUNTED)
def distance_at(coefficients, origin, spacing, x, y, z):
    """Signed distance at one point [m]; for use inside other kernels."""
    if coefficients.shape[0] == 1:
        return to_solid(coefficients, x, y, z)
    per = 1 / spacing
    i, u, f = _cell((x - origin[0]) * per, coefficients.shape[0])
    j, v, g = _cell((y - origin[1]) * per, coefficients.shape[1])
    k, w, e = _cell((z - origin[2]) * per, coefficients.shape[2])
    total = spline_sum(coefficients, i, j, k, _cubic(f), _cubic(g), _cubic(e))
    dx, dy, dz = x - origin[0] - spacing * u, y - origin[1] - spacing * v, z - origin[2] - spacing * w
    away = dx * dx + dy * dy + dz * dz
    return total if away < 1e-24 else np.sqrt(away + total * total)


@numba.njit(cache=True, inline="always")
def _slopes(f):
    """Derivatives of the weights of _cubic."""
    g = 1.0 - f
    return -g * g / 2, (3 * f * f - 4 * f) / 2, (4 * g - 3 * g * g) / 2, f * f / 2


@numba.njit(cache=True, nogil=True, fastmath=FAST, **UNCOUNTED)
def _jet_on_plane(plane, j, b, db, k, c, dc):
    """Spline on one plane of nodes, from node (j, k) on, and its derivatives along both axes of it."""
    value = across = along = 0.0
    value, across, along = _add_line(plane[j], k, c, dc, b[0], db[0], value, across, along)
    value, across, along = _add_line(plane[j + ONE], k, c, dc, b[1], db[1], value, across, along)
    value, across, along = _add_line(plane[j + TWO], k, c, dc, b[2], db[2], value, across, along)
    return _add_line(plane[j + THREE], k, c, dc, b[3], db[3], value, across, along)


@numba.njit(cache=True, inline="always")
def _add_line(line, k, c, dc, b, db, value, across, along):
    here = _on_line(line, k, c[0], c[1], c[2], c[3])
    return value + b * here, across + db * here, along + b * _on_line(line, k, dc[0], dc[1], dc[2], dc[3])


@numba.njit(forceinline=True, cache=True, nogil=True, fastmath=FAST, error_model="numpy", **UNCOUNTED)
def jet_at(coefficients, origin, spacing, x, y, z):
    """Signed distance at one point [m], and its gradient: four numbers; for use inside other kernels."""
    if coefficients.shape[0] == 1:
        return solid_jet(coefficients, x, y, z)
    i, u, f = _cell((x - origin[0]) / spacing, coefficients.shape[0])
    j, v, g = _cell((y - origin[1]) / spacing, coefficients.shape[1])
    k, w, e = _cell((z - origin[2]) / spacing, coefficients.shape[2])
    a, da, b, db, c, dc = _cubic(f), _slopes(f), _cubic(g), _slopes(g), _cubic(e), _slopes(e)
    i, j, k = np.uint64(i), np.uint64(j), np.uint64(k)  # no index that may count from the end
    d0, y0, z0 = _jet_on_plane(coefficients[i], j, b, db, k, c, dc)
    d1, y1, z1 = _jet_on_plane(coefficients[i + ONE], j, b, db, k, c, dc)
    d2, y2, z2 = _jet_on_plane(coefficients[i + TWO], j, b, db, k, c, dc)
    d3, y3, z3 = _jet_on_plane(coefficients[i + THREE], j, b, db, k, c, dc)
    d = a[0] * d0 + a[1] * d1 + (a[2] * d2 + a[3] * d3)
    gx = (da[0] * d0 + da[1] * d1 + (da[2] * d2 + da[3] * d3)) / spacing
    gy = (a[0] * y0 + a[1] * y1 + (a[2] * y2 + a[3] * y3)) / spacing
    gz = (a[0] * z0 + a[1] * z1 + (a[2] * z2 + a[3] * z3)) / spacing
    dx, dy, dz = x - origin[0] - spacing * u, y - origin[1] - spacing * v, z - origin[2] - spacing * w
    away = dx * dx + dy * dy + dz * dz
    if away < 1e-24:
        return d, gx, gy, gz
    root = np.sqrt(away + d * d)  # along an axis that leads out of the grid the nearest point stays
    return (root, (dx if abs(dx) > 1e-12 else d * gx) / root, (dy if abs(dy) > 1e-12 else d * gy) / root,
            (dz if abs(dz) > 1e-12 else d * gz) / root)  # fmt: skip


@numba.njit(cache=True, nogil=True)
def distances_and_gradients(coefficients, origin, spacing, points):
    """Distance and gradient at each point."""
    value, gradient = np.empty(len(points)), np.empty((len(points), 3))
    for n in range(len(points)):
        value[n], gradient[n, 0], gradient[n, 1], gradient[n, 2] = jet_at(
            coefficients, origin, spacing, points[n, 0], points[n, 1], points[n, 2])  # fmt: skip
    return value, gradient


@numba.njit(cache=True, nogil=True)
def _distances(coefficients, origin, spacing, points):
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = distance_at(coefficients, origin, spacing, points[n, 0], points[n, 1], points[n, 2])
    return out


@numba.njit(cache=True, nogil=True)
def _jets(coefficients, origin, spacing, points):
    """Distance, gradient and Hessian at each point; outside the grid those of sqrt(|x - c|^2 + d(c)^2)."""
    value, gradient, hessian = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    first, weights, away, free = np.empty(3, np.int64), np.empty((3, 3, 4)), np.empty(3), np.empty(3)
    for n in range(len(points)):
        g, h = gradient[n], hessian[n]
        if coefficients.shape[0] == 1:
            x, y, z = points[n]
            value[n], g[0], g[1], g[2] = solid_jet(coefficients, x, y, z)
            bend_of_solid(coefficients, x, y, z, h)
            continue
        outside = 0.0
        for axis in range(3):
            u = (points[n, axis] - origin[axis]) / spacing
            first[axis], inside, fraction = _cell(u, coefficients.shape[axis])
            _weights(fraction, weights[axis])
            away[axis] = spacing * (u - inside)
            free[axis] = 1.0 if abs(away[axis]) < 1e-12 else 0.0
            outside += away[axis] * away[axis]
        value[n] = _spline_jet(coefficients, spacing, first, weights, g, h)
        if outside > 1e-24:
            value[n] = _outside_jet(value[n], outside, away, free, g, h)
    return value, gradient, hessian


@numba.njit(cache=True, nogil=True)
def _outside_jet(d, outside, away, free, g, h):
    """Turns the jet at the nearest point of the grid into that of r = sqrt(|x - c|^2 + d(c)^2); returns r."""
    root = np.sqrt(outside + d * d)
    for p in range(3):
        for q in range(3):
            h[p, q] = free[p] * free[q] * (g[p] * g[q] + d * h[p, q])
        h[p, p] += 1.0 - free[p]
    for p in range(3):
        g[p] = (away[p] + d * free[p] * g[p]) / root
    for p in range(3):
        for q in range(3):
            h[p, q] = (h[p, q] - g[p] * g[q]) / root
    return root


@numba.njit(cache=True, nogil=True)
def _spline_jet(coefficients, spacing, first, w, g, h):
    """Writes the spline's gradient and Hessian in the cell that starts at node `first`; returns its value."""
    d = gx = gy = gz = hxx = hyy = hzz = hxy = hxz = hyz = 0.0
    for p in range(4):
        for q in range(4):
            s = s1 = s2 = 0.0
            for r in range(4):
                value = coefficients[first[0] + p, first[1] + q, first[2] + r]
                s += w[2, 0, r] * value
                s1 += w[2, 1, r] * value
                s2 += w[2, 2, r] * value
            a, a1, b, b1 = w[0, 0, p], w[0, 1, p], w[1, 0, q], w[1, 1, q]
            d += a * b * s
            gx += a1 * b * s
            gy += a * b1 * s
            gz += a * b * s1
            hxx += w[0, 2, p] * b * s
            hyy += a * w[1, 2, q] * s
            hzz += a * b * s2
            hxy += a1 * b1 * s
            hxz += a1 * b * s1
            hyz += a * b1 * s1
    g[0], g[1], g[2] = gx / spacing, gy / spacing, gz / spacing
    square = spacing * spacing
    h[0, 0], h[1, 1], h[2, 2] = hxx / square, hyy / square, hzz / square
    h[0, 1] = h[1, 0] = hxy / square
    h[0, 2] = h[2, 0] = hxz / square
    h[1, 2] = h[2, 1] = hyz / square
    return d
