"""Pictures: a pressed limb, shaded and coloured by displacement, and a cut through its contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb

from stmpl_core.arrays import Faces, PerVertex, Points
from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer

SKIN = LinearSegmentedColormap.from_list("skin", ["#f2e4da", "#f7b267", "#e4572e", "#8c1c3f", "#2e0a3c"])
DIFFERENCE = LinearSegmentedColormap.from_list("difference", ["#ecebe8", "#9ecae1", "#3182bd", "#08306b", "#030f24"])
LIGHT = np.array([-0.75, 0.35, 0.55])  # direction of the light in screen axes: from the upper left, towards the viewer
AMBIENT = 0.2  # share of the light that comes from everywhere
SMOOTH = 8_000  # triangles that a skin is split into at least, so that shades look smooth
FLAT = 0.75  # height of a close-up over its width; it looks at the skin at a slant
MM = 1e3  # millimetres in a metre
TOOL = to_rgb("#6b7683")


@dataclass(frozen=True, eq=False)
class View:
    """An orthographic camera that looks at `centre`; `axes` (3, 3) is screen right, screen up, towards the viewer."""

    axes: np.ndarray
    centre: np.ndarray

    def project(self, points: Points) -> Points:
        """Screen coordinates and nearness of points, (N, 3) [mm]."""
        return (points - self.centre) @ self.axes.T * MM


@dataclass(frozen=True, eq=False)
class Spot:
    """Where a load is heaviest: its centre [m], outward normal, and the radius of what is loaded around it [m]."""

    centre: np.ndarray
    normal: np.ndarray
    radius: float


def spot_of(layer: SoftLayer, pressure: PerVertex, *, reach: float = 0.04) -> Spot:
    """The heaviest spot of a pressure; other contacts, more than `reach` [m] away, do not count.

    The normal is the mean one of the spot, weighted by force.
    """
    centre = layer.vertices[int(np.argmax(pressure))]
    near = (np.linalg.norm(layer.vertices - centre, axis=1) < reach) & (pressure > 0)
    force = (pressure * layer.vertex_areas)[near]
    centre = np.average(layer.vertices[near], axis=0, weights=force)
    normal = force @ layer.normals[near]
    radius = np.linalg.norm(layer.vertices[near] - centre, axis=1).max()
    return Spot(centre, normal / np.linalg.norm(normal), float(radius))


def limb_axis(layer: SoftLayer) -> np.ndarray:
    """Unit vector along the longest extent of the skin."""
    return np.linalg.svd(layer.vertices - layer.vertices.mean(axis=0), full_matrices=False)[2][0]


def view_along(towards: np.ndarray, right: np.ndarray, centre: np.ndarray, *, tilt: float = 0.0) -> View:
    """A camera that sees `centre` from `towards`, with `right` to the right; `tilt` [deg] lifts it over the top."""
    right = right - (right @ towards) * towards
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    return View(np.array([right, c * up - s * towards, c * towards + s * up]), centre)


def draw_skin(
    axes: Axes, view: View, layer: SoftLayer, displacement: Points, values: PerVertex, colours: ScalarMappable,
    *, half_width: float | None = None,
) -> None:  # fmt: skip
    """Draws the deformed skin, shaded, coloured by `values` (V,) in the units of `colours`.

    Args:
        displacement: displacement, (V, 3) [m], drawn as it is, not exaggerated.
        half_width: half width of the window to show, which is FLAT times as high [m]; None shows all.
    """
    deformed = layer.vertices + displacement
    faces = layer.faces
    if half_width is not None:
        near = np.abs(view.project(deformed)[:, :2]).max(axis=1) < 1.5 * half_width * MM
        faces = faces[near[faces].any(axis=1)]
    coarse, normals = deformed[faces], _vertex_normals(deformed, layer.faces)[faces]
    corners, shades = coarse, values[faces]
    while len(corners) < SMOOTH:
        corners, normals, shades = _split(corners), _split(normals), _split(shades)
    _draw(axes, view, corners, normals.mean(axis=1), colours.to_rgba(shades.mean(axis=1))[:, :3])
    if half_width is not None:
        _draw_edges(axes, view, coarse)
        axes.set(xlim=(-half_width * MM, half_width * MM), ylim=(-FLAT * half_width * MM, FLAT * half_width * MM))
    axes.set_aspect("equal")
    axes.axis("off")


def draw_tool(axes: Axes, view: View, contact: Contact) -> None:
    """Draws the outline of a tool, see-through."""
    pose = contact.pose_body_from_tool
    points = contact.tool.vertices @ pose[:3, :3].T + pose[:3, 3]
    corners = points[contact.tool.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _draw(axes, view, corners, normals, np.broadcast_to(TOOL, (len(corners), 3)), alpha=0.35)


def draw_cut(axes: Axes, points: Points, faces: Faces, view: View, **style) -> None:
    """Draws where the plane of `view` through its centre cuts a surface, (N, 3) [m], in millimetres."""
    screen = view.project(points)
    side = screen[:, 2] > 0
    crossing = faces[side[faces].any(axis=1) & ~side[faces].all(axis=1)]
    segments = []
    for a, b, c in crossing:
        ends = [_meet(screen[p], screen[q]) for p, q in ((a, b), (b, c), (c, a)) if side[p] != side[q]]
        segments.append(ends)
    axes.add_collection(LineCollection(segments, capstyle="round", **style))


def scale(values: list[PerVertex], colours: LinearSegmentedColormap) -> ScalarMappable:
    """One colour scale from 0 to the largest of all values."""
    top = max((float(v.max(initial=0.0)) for v in values), default=0.0)
    return ScalarMappable(Normalize(0.0, top or 1.0), colours)


def _draw(
    axes: Axes, view: View, corners: np.ndarray, normals: np.ndarray, colour: np.ndarray, *, alpha: float = 1.0
) -> None:
    screen = view.project(corners.reshape(-1, 3)).reshape(corners.shape)
    turned = normals @ view.axes.T
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300)
    facing = _turn(screen) > 0
    order = np.argsort(screen[facing, :, 2].mean(axis=1))
    light = AMBIENT + (1 - AMBIENT) * np.clip(turned[facing] @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    shaded = np.clip(colour[facing] * (0.35 + 0.75 * light[:, None]), 0, 1)[order]
    edges = shaded if alpha == 1 else "none"
    outlines = list(screen[facing][order][:, :, :2])
    axes.add_collection(PolyCollection(outlines, facecolors=shaded, edgecolors=edges, linewidths=0.3, alpha=alpha))
    axes.autoscale_view()


def _draw_edges(axes: Axes, view: View, corners: np.ndarray) -> None:
    screen = view.project(corners.reshape(-1, 3)).reshape(corners.shape)
    outlines = list(screen[_turn(screen) > 0][:, :, :2])
    axes.add_collection(PolyCollection(outlines, facecolors="none", edgecolors=(0, 0, 0, 0.16), linewidths=0.35))


def _turn(screen: np.ndarray) -> np.ndarray:
    """Twice the signed area of each triangle on the screen; above 0 it faces the viewer."""
    a, b = screen[:, 1, :2] - screen[:, 0, :2], screen[:, 2, :2] - screen[:, 0, :2]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _split(values: np.ndarray) -> np.ndarray:
    """Each triangle's corner values (F, 3, ...) become those of four smaller ones (4 F, 3, ...)."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])


def _vertex_normals(vertices: Points, faces: Faces) -> Points:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _meet(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Where the segment from p to q crosses the plane of the screen."""
    return (p + (q - p) * p[2] / (p[2] - q[2]))[:2]
