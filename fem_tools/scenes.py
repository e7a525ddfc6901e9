"""Scenes: tools of real geometry set on a limb, and the footprint that each leaves on the skin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from stmpl_core.arrays import PerVertex, Points, Transform
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.soundness import border_distance
from stmpl_core.tool import Tool

if TYPE_CHECKING:
    import shapely

    from fem_tools.hand import Hand

    Outline = shapely.Polygon | shapely.MultiPolygon

EDGE = 4e-3  # m over which a footprint's weight falls from 1 to 0 across the tool's outline
FACING = 0.2  # cosine between a tool's axis and the skin's normal from which skin counts as facing it
DEEPEST_FACE = 15e-3  # m that a flat face may have to sink before all of it meets the skin
BACK = 10e-3  # m of tool above the skin
STRAP = 4e-3  # m, of a strap's cloth
CLEAR = 2.5  # largest thicknesses that a footprint keeps from the layer's open border
FEWEST = 7  # vertices that a footprint must cover


class UnusableContact(StmplError):
    """A tool that cannot be set down where it was asked to be; the message says why."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A tool on the skin.

    Args:
        tool: tool in its own frame; None where a pressure was drawn without one.
        pose_body_from_tool: pose of the tool, (4, 4).
        footprint: share of the tool's pressure that each vertex gets, (V,), 0 to 1.
        rounding: radius of the tool's edges where it is pressed in as a rigid one [m].
    """

    tool: Tool | None
    pose_body_from_tool: Transform
    footprint: PerVertex
    rounding: float = 0.0

    @property
    def covered(self) -> np.ndarray:
        """Mask of the vertices inside the outline, where the weight is at least one half, (V,)."""
        return self.footprint >= 0.5


class Site:
    """Where tools are set down on a layer."""

    def __init__(self, layer: SoftLayer) -> None:
        self.layer = layer

    @cached_property
    def border_distance(self) -> PerVertex:
        """Of each vertex from the layer's open border, straight, (V,) [m]; infinite if it has none."""
        return border_distance(self.layer)

    def near(self, vertex: int, radius: float) -> np.ndarray:
        """Numbers of the vertices within `radius` [m] of one, on its side of the limb."""
        away = np.linalg.norm(self.layer.vertices - self.layer.vertices[vertex], axis=1)
        return np.flatnonzero((away <= radius) & (self.layer.normals @ self.layer.normals[vertex] > FACING))

    def standing(self, vertex: int, radius: float, turn: float) -> Transform:
        """Pose of a tool that stands on a vertex: z along the mean normal within `radius`, x turned by `turn` [rad]."""
        normal = self.layer.vertex_area_vectors[self.near(vertex, radius)].sum(axis=0)
        return frame(self.layer.vertices[vertex], normal, self.axis(vertex), turn)

    def thickness_under(self, pose: Transform) -> float:
        """Of the layer, at the vertex nearest to the z axis of `pose` on the side that it comes from [m]."""
        layer = self.layer
        away = np.linalg.norm(np.cross(layer.vertices - pose[:3, 3], pose[:3, 2]), axis=1)
        return float(layer.thickness[np.where(layer.normals @ pose[:3, 2] > 0, away, np.inf).argmin()])

    def axis(self, vertex: int, radius: float = 0.05) -> np.ndarray:
        """The limb's axis there: what the skin's normals within `radius` [m] have least of, (3,) [-]."""
        around = np.linalg.norm(self.layer.vertices - self.layer.vertices[vertex], axis=1) <= radius
        n = self.layer.normals[around] * self.layer.vertex_areas[around, None] ** 0.5
        axis = np.linalg.eigh(n.T @ n)[1][:, 0]
        return axis * np.sign(axis[np.abs(axis).argmax()])

    def scene(self, mesh: Tool, pose: Transform, near: np.ndarray, inside: float, ramp: float) -> Scene:
        """The scene whose weight rises over `ramp` [m] of signed distance, and is one half where that is -`inside`.

        Raises:
            UnusableContact: it reaches the open border, or covers too few vertices.
        """
        distance = signed_distance(mesh, pose, self.layer.vertices[near])
        footprint = np.zeros(len(self.layer.vertices))
        footprint[near] = smoothstep(0.5 - (distance + inside) / ramp)
        return self._usable(Scene(mesh, pose, footprint))

    def uneven(self, vertex: int, radius: float, wavelength: float, rng: np.random.Generator) -> Scene:
        """Pressure without a tool: random waves of about this length [m], where they are positive, within `radius` [m].

        The highest pressure has weight 1. Real contacts press unevenly, and in shapes that no list of tools has.

        Raises:
            UnusableContact: as `scene`.
        """
        near = self.near(vertex, radius)
        points = self.layer.vertices[near] - self.layer.vertices[vertex]
        waves = rng.normal(size=(12, 3)) * (2 * np.pi / wavelength / 3**0.5)
        field = np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, 12)).sum(axis=1) / 6**0.5 + rng.uniform(-0.5, 1.0)
        field = np.maximum(field, 0.0) * smoothstep((radius - np.linalg.norm(points, axis=1)) / (2 * EDGE))
        if field.max(initial=0.0) <= 0:
            raise UnusableContact("nothing presses there")
        footprint = np.zeros(len(self.layer.vertices))
        footprint[near] = field / field.max()
        return self._usable(Scene(None, self.standing(vertex, radius, 0.0), footprint))

    def _usable(self, scene: Scene) -> Scene:
        footprint, loaded = scene.footprint, np.flatnonzero(scene.footprint)
        if (footprint >= 0.5).sum() < FEWEST:
            raise UnusableContact(f"it covers {int((footprint >= 0.5).sum())} vertices, fewer than {FEWEST}")
        thick = float(self.layer.thickness.max())
        if (gap := float(self.border_distance[loaded].min())) < CLEAR * thick:
            raise UnusableContact(f"it comes within {gap / thick:.1f} thicknesses of the open border")
        return scene

    def press_flat(self, vertex: int, outline: Outline, turn: float) -> Scene:
        """A flat-faced punch of `outline` (in metres about its origin), sunk until all of its face meets the skin.

        Raises:
            UnusableContact: the limb curves away too far under the outline, and as `scene`.
        """
        import shapely

        radius = float(np.linalg.norm(shapely.get_coordinates(outline), axis=1).max())
        pose = self.standing(vertex, radius, turn)
        local = (self.layer.vertices - pose[:3, 3]) @ pose[:3, :3]
        under = shapely.contains_xy(outline.buffer(EDGE / 2), local[:, 0], local[:, 1])
        facing = self.layer.normals @ pose[:3, 2] > FACING
        height = local[under & facing, 2]
        if not len(height) or -height.min() > DEEPEST_FACE:
            lowest = -1e3 * float(height.min(initial=0.0))
            allowed = 1e3 * DEEPEST_FACE
            raise UnusableContact(f"the limb falls away by {lowest:.0f} mm under it; {allowed:.0f} are allowed")
        mesh = extruded(outline, float(height.min()) - EDGE, max(float(height.max()), 0.0) + BACK)
        near = np.flatnonzero(facing & (np.linalg.norm(local, axis=1) < radius + DEEPEST_FACE + EDGE))
        return self.scene(mesh, pose, near, 0.0, EDGE)

    def strap(self, vertex: int, width: float, tilt: float) -> Scene:
        """A strap of `width` [m] pulled tight around the limb: along the convex hull of the slice under it.

        Raises:
            UnusableContact: the slice is no limb's, and as `scene`.
        """
        import shapely

        axis, normal = self.axis(vertex), self.layer.normals[vertex]
        along = np.cos(tilt) * axis + np.sin(tilt) * np.cross(axis, normal)
        pose = frame(self.layer.vertices[vertex], along, normal, 0.0)
        local = (self.layer.vertices - pose[:3, 3]) @ pose[:3, :3]
        slab = np.abs(local[:, 2]) <= (width + EDGE) / 2
        hull = shapely.MultiPoint(local[slab, :2]).convex_hull
        if not isinstance(hull, shapely.Polygon) or hull.area > 0.04:
            raise UnusableContact("the slice under it is not that of a limb")
        ring = hull.buffer(STRAP).difference(hull.buffer(-2 * EDGE))
        near = np.flatnonzero(np.abs(local[:, 2]) <= width / 2 + EDGE)
        return self.scene(extruded(ring, -width / 2, width / 2), pose, near, 0.0, EDGE)

    def grasp(self, vertex: int, hand: Hand, turn: float, depth: float, loose: np.ndarray) -> Scene:
        """A hand laid across the limb with its palm on `vertex`, its fingers closed until they are `depth` inside [m].

        Args:
            vertex: number of the vertex under the palm.
            hand: hand that grasps.
            turn: angle of the fingers away from across the limb [rad].
            depth: depth of palm and fingers below the skin at rest [m].
            loose: share of its way that each finger stays short of closing, (5,) [-].

        Raises:
            UnusableContact: as `scene`.
        """
        layer = self.layer
        normal = layer.vertex_area_vectors[self.near(vertex, 0.02)].sum(axis=0)
        normal /= np.linalg.norm(normal)
        axis = self.axis(vertex)
        across = np.cross(axis, normal)
        x = np.cos(turn) * across + np.sin(turn) * axis
        pose = frame(layer.vertices[vertex], -normal, x, 0.0)
        mesh, pose = hand.grip(layer, pose, depth, loose.tolist())
        return self.scene(mesh, pose, self.within(mesh, pose), EDGE / 4, EDGE / 2)

    def within(self, mesh: Tool, pose: Transform, margin: float = 0.03) -> np.ndarray:
        """Numbers of the vertices in the tool's box, `margin` [m] larger."""
        local = (self.layer.vertices - pose[:3, 3]) @ pose[:3, :3]
        low, high = mesh.vertices.min(axis=0) - margin, mesh.vertices.max(axis=0) + margin
        return np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))


def frame(origin: np.ndarray, z: np.ndarray, x: np.ndarray, turn: float) -> Transform:
    """Pose with this origin and z, its x as near to the given one as z lets it, then turned about z by `turn` [rad]."""
    z = z / np.linalg.norm(z)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    x = np.cos(turn) * x + np.sin(turn) * np.cross(z, x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([x, np.cross(z, x), z]), origin
    return pose


def smoothstep(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, 3 x^2 - 2 x^3 between."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def signed_distance(mesh: Tool, pose: Transform, points: Points) -> np.ndarray:
    """Exact distance of points of the layer's frame to a tool, negative inside, (N,) [m]."""
    import igl

    if not len(points):
        return np.empty(0)
    local = np.ascontiguousarray((points - pose[:3, 3]) @ pose[:3, :3])
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return np.asarray(igl.signed_distance(local, mesh.vertices, mesh.faces.astype(np.int64), kind)[0])


def ellipse(a: float, b: float) -> shapely.Polygon:
    """Outline with semi-axes a, b [m] about the origin, of the ellipse's own area."""
    import shapely

    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    swell = (angle[1] / np.sin(angle[1])) ** 0.5
    return shapely.Polygon(swell * np.column_stack([a * np.cos(angle), b * np.sin(angle)]))


def letter(character: str, height: float) -> Outline:
    """Outline of a bold block letter of this height [m], about the middle of its box.

    Raises:
        InvalidInput: no letter and no digit.
    """
    import shapely.affinity
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    if not character.isalnum():
        raise InvalidInput(f"the font draws nothing of use for {character!r}. Use capital letters.")
    path = TextPath((0, 0), character, size=100, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    outline: Any = shapely.Polygon()
    for loop in path.to_polygons():
        outline = outline.symmetric_difference(shapely.Polygon(np.asarray(loop)).buffer(0))
    x0, y0, x1, y1 = outline.bounds
    outline = shapely.affinity.translate(outline, -(x0 + x1) / 2, -(y0 + y1) / 2)
    return shapely.affinity.scale(outline, height / (y1 - y0), height / (y1 - y0), origin=(0, 0))


def extruded(outline: Any, low: float, high: float) -> Tool:
    """The prism over `outline` from z = low to z = high [m]. In millimetres on the way: trimesh drops small faces."""
    import shapely.affinity
    import trimesh

    parts = [p for p in shapely.get_parts(outline) if isinstance(p, shapely.Polygon)]
    scaled = [shapely.affinity.scale(p, 1e3, 1e3, origin=(0, 0)) for p in parts]
    prism: Any = trimesh.util.concatenate([trimesh.creation.extrude_polygon(p, 1e3 * (high - low)) for p in scaled])
    return Tool("stamp", 1e-3 * np.asarray(prism.vertices) + [0, 0, low], np.asarray(prism.faces))
