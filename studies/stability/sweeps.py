"""The axes that are swept, from easy to hard, and the trials along each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from stmpl_core.body import Body
from stmpl_core.extrusion import foldfree_thickness
from stmpl_core.metrics import FAR
from studies.stability.contact_axes import CONTACT_AXES, CONTACT_LEVELS, QUICK_CONTACTS
from studies.stability.layered_axes import LAYERED_AXES, LAYERED_LEVELS, QUICK_LAYERED
from studies.stability.meshes import inserted, limb
from studies.stability.scene import Mesh, Pressures
from studies.stability.stroke_axes import QUICK_STROKES, STROKE_AXES, STROKE_LEVELS
from studies.stability.trial import Trial, Twin

THICKNESS = 7.5e-3  # m
RADIUS, RAMP = 12e-3, 6e-3  # m, of the contact and of its smooth edge
RATIO = 0.5  # p / E of the contact where another axis is swept
AROUND = 25e-3  # m from the contact, where the mesh is made bad
NOISE = 0.05  # of the load
SWEEP = ("finite", "zero", "monotone", "sinks", "unfolded", "leak")


@dataclass(frozen=True)
class Preset:
    """What is swept, and how finely.

    Args:
        edge_length: edge length of the skin's mesh [m].
        body: limb that is pressed: True, the left arm of the Anny body; False, a round limb.
        levels: levels of each axis, from easy to hard; an axis without levels is left out.
        seed: seed of the noise.
        tool_edge: edge length of the round limb that tools press [m].
    """

    edge_length: float = 6e-3
    body: bool = True
    levels: Mapping[str, Sequence[float]] = field(default_factory=lambda: AXIS_LEVELS)
    seed: int = 0
    tool_edge: float = 4e-3

    def only(self, which: str) -> Preset:
        """This preset with the axes of "pressures", "contacts" or "strokes" alone; "all": itself."""
        kept = {axis: levels for axis, levels in self.levels.items()
                if which == "all" or which == ("contacts" if axis in CONTACT_AXES | LAYERED_AXES else
                                               "strokes" if axis in STROKE_AXES else "pressures")}  # fmt: skip
        return replace(self, levels=kept)


HALF_ARM = np.inf  # as a contact's radius
AXIS_LEVELS: dict[str, Sequence[float]] = {
    "pressure": (0.01, 0.03, 0.1, 0.3, 0.5, 1, 1.5, 2, 3, 5, 10),
    "nu": (0.3, 0.35, 0.4, 0.45, 0.49, 0.499),
    "thickness": (12.5, 10, 7.5, 5, 2.5),
    "thickness gradient": (0, 0.1, 0.2, 0.4, 0.8),
    "contact size": (HALF_ARM, 50, 25, 12, 6, 0),
    "edge": (12, 6, 3, 0),
    "seam": (4, 2, 1, 0),
    "obtuse": (1 / 3, 0.1, 0.03, 0.01, 0.003),
    "area jump": (1, 2, 3, 4),
    "scale": (0.1, 0.5, 2, 8, 1000),
    "turn": (30, 90, 180),
    "shift": (1, 1000),
    "stale start": (0.1, 1, 2, 5, 10),
    "jump": (0.1, 0.5, 1, 2, 5, 10),
    "cycles": (100, 10_000),
    "noise": (0.1, 0.5, 1, 2, 5),
    "two contacts": (16, 12, 8),
    "not finite": (0, 1, 2),
} | CONTACT_LEVELS | LAYERED_LEVELS | STROKE_LEVELS  # fmt: skip
PRESETS = {
    "default": Preset(),
    "quick": Preset(edge_length=7e-3, body=False, levels={
        "pressure": (0.1, 0.5, 1), "nu": (0.3, 0.49), "thickness": (12.5, 5), "thickness gradient": (0, 0.2),
        "contact size": (25, 6), "edge": (6,), "seam": (2, 0), "obtuse": (0.1,), "area jump": (2,),
        "scale": (0.5, 1000), "turn": (90,), "shift": (1,), "stale start": (1,), "jump": (0.5,), "cycles": (100,),
        "noise": (0.1, 0.5), "two contacts": (8,), "not finite": (0, 1),
    } | QUICK_CONTACTS | QUICK_LAYERED | QUICK_STROKES, tool_edge=6e-3),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Stage:
    """The skin that is pressed, and where.

    Args:
        mesh: mesh of the skin.
        seed: seed of the noise.
        tool_edge: edge length of the round limb that tools press [m].
    """

    mesh: Mesh
    seed: int = 0
    tool_edge: float = 4e-3

    @classmethod
    def of(cls, preset: Preset) -> Stage:
        """The preset's skin. Raises MeshError."""
        if preset.body:
            arm = Body.anny().part("left_arm", edge_length=preset.edge_length, thickness=THICKNESS)
            return cls(Mesh.of(arm), preset.seed, preset.tool_edge)
        return cls(limb(preset.edge_length, 0.04, 0.26, THICKNESS), preset.seed, preset.tool_edge)

    @cached_property
    def border_distance(self) -> np.ndarray:
        """Of each vertex from the open border, straight, (V,) [m]."""
        points = self.mesh.vertices
        return KDTree(points[self.mesh.layer.border]).query(points)[0]

    @cached_property
    def centre(self) -> np.ndarray:
        """Where the contact is: the vertex farthest from the border, (3,) [m]."""
        return self.mesh.vertices[self.border_distance.argmax()]

    @cached_property
    def axis(self) -> np.ndarray:
        """The limb's axis, (3,) [-]."""
        points = self.mesh.vertices - self.mesh.vertices.mean(axis=0)
        return np.linalg.eigh(points.T @ points)[1][:, 2]

    @cached_property
    def thickest(self) -> np.ndarray:
        """12.5 mm, thinned where the skin curves more tightly than that, (V,) [m]."""
        return foldfree_thickness(self.mesh.layer.with_(thickness=12.5e-3))

    def apart(self, gap: float) -> np.ndarray:
        """Where another contact of the usual size leaves a gap of this many thicknesses, (3,) [m]."""
        away = np.linalg.norm(self.mesh.vertices - self.centre, axis=1)
        wanted = gap * THICKNESS + 2 * RADIUS + RAMP
        far = np.flatnonzero(away >= wanted)
        if not len(far):
            return self.mesh.vertices[away.argmax()]
        near = far[away[far] <= away[far].min() + 2 * self.mesh.layer.edge_length]
        return self.mesh.vertices[near[self.border_distance[near].argmax()]]


def disc(mesh: Mesh, centre: np.ndarray, radius: float = RADIUS, ramp: float = RAMP) -> np.ndarray:
    """A pressure of E, falling to 0 over `ramp` by a smoothstep centred on the rim, (V,) [Pa]."""
    away = np.linalg.norm(mesh.vertices - centre, axis=1)
    x = np.clip((radius - away) / ramp + 0.5, 0, 1) if ramp > 0 else (away <= radius).astype(float)
    return mesh.tissue.youngs_modulus * x * x * (3 - 2 * x)


def trials(stage: Stage, preset: Preset) -> Iterator[Trial]:
    """All trials of a preset, axis by axis; each makes its own arrays only when it is reached."""
    for axis, levels in preset.levels.items():
        for level in levels:
            yield replace(AXES[axis](stage, level), axis=axis)


def _pressed(mesh: Mesh, pressure: np.ndarray, level: str, *extra: str) -> Trial:
    """Half of a pressure, all of it, nothing."""
    return Trial("", level, (*SWEEP, *extra), Pressures(mesh, np.stack([0.5 * pressure, pressure, 0 * pressure])))


def pressure(stage: Stage, level: float) -> Trial:
    """p / E under a smooth disc."""
    return _pressed(stage.mesh, level * disc(stage.mesh, stage.centre), f"{level:g} E")


def poisson_ratio(stage: Stage, level: float) -> Trial:
    """Poisson's ratio."""
    mesh = replace(stage.mesh, tissue=replace(stage.mesh.tissue, poisson_ratio=level))
    return _pressed(mesh, RATIO * disc(mesh, stage.centre), f"{level:g}")


def thickness(stage: Stage, level: float) -> Trial:
    """Thickness in mm, thinned where the skin curves more tightly than that."""
    mesh = replace(stage.mesh, thickness=np.minimum(level * 1e-3, stage.thickest))
    return _pressed(mesh, RATIO * disc(mesh, stage.centre), f"{level:g} mm")


def gradient(stage: Stage, level: float) -> Trial:
    """Slope of the thickness along the limb, across the contact, from 2.5 to 12.5 mm [m/m]."""
    along = (stage.mesh.vertices - stage.centre) @ stage.axis
    sloped = np.clip(THICKNESS + level * along, 2.5e-3, 12.5e-3)
    mesh = replace(stage.mesh, thickness=np.minimum(sloped, stage.thickest))
    return _pressed(mesh, RATIO * disc(mesh, stage.centre), f"{level:g}")


def size(stage: Stage, level: float) -> Trial:
    """Radius of the contact in mm; 0: one vertex; infinite: the middle half of the limb."""
    mesh = stage.mesh
    if level == HALF_ARM:
        along = mesh.vertices @ stage.axis
        low, high = np.quantile(along, (0.25, 0.75))
        inside = ((along >= low) & (along <= high)) * mesh.tissue.youngs_modulus
        return _pressed(mesh, RATIO * inside, "half the arm")
    if level == 0:
        one = (mesh.vertices == stage.centre).all(axis=1) * mesh.tissue.youngs_modulus
        return _pressed(mesh, RATIO * one, "1 vertex")
    return _pressed(mesh, RATIO * disc(mesh, stage.centre, level * 1e-3), f"{level:g} mm")


def edge(stage: Stage, level: float) -> Trial:
    """Width over which the pressure falls at the contact's rim, in mm; 0: sharp. At p = E."""
    pressed = disc(stage.mesh, stage.centre, ramp=level * 1e-3)
    return _pressed(stage.mesh, pressed, f"{level:g} mm" if level else "sharp")


def seam(stage: Stage, level: float) -> Trial:
    """Distance of the contact from the seam, in thicknesses, on one side and on the other.

    On a round limb whose mesh is its own mirror image at the seam, as the loads are.
    """
    mesh = limb(stage.mesh.layer.edge_length, 0.04, 0.2, THICKNESS)
    angle, middle = level * THICKNESS / 0.04, mesh.vertices[:, 2].max() / 2
    mirror = np.diag([1.0, -1.0, 1.0])
    centre = np.array([0.04 * np.cos(angle), 0.04 * np.sin(angle), middle])
    partner = np.asarray(KDTree(mesh.vertices).query(mesh.vertices @ mirror)[1])
    pairs = np.stack([np.arange(len(partner)), partner], axis=1)
    scene, other = (Pressures(mesh, RATIO * disc(mesh, c)[None]) for c in (centre, mirror @ centre))
    return Trial("", f"{level:g} t", ("finite", "sinks", "seam"), scene, Twin(other, pairs, mirror))


def obtuse(stage: Stage, level: float) -> Trial:
    """Obtuse triangles and slivers: each second face near the contact is cut in three, one with this share of it."""
    side = (1 - level) / 2
    near = np.flatnonzero(_near(stage))
    return _remeshed(stage, inserted(stage.mesh, near[::2], (side, side, level)),
                     f"{2 * np.degrees(np.arctan2(0.5, 0.866 * level)):.3g}°")  # fmt: skip


def area_jump(stage: Stage, level: float) -> Trial:
    """On one side of the contact faces are cut in three at their middle, so many times."""
    mesh = stage.mesh
    for _ in range(int(level)):
        middles = mesh.vertices[mesh.faces].mean(axis=1)
        near = np.linalg.norm(middles - stage.centre, axis=1) < AROUND
        chosen = near & ((middles - stage.centre) @ stage.axis > 0)
        mesh = inserted(mesh, np.flatnonzero(chosen), (1 / 3, 1 / 3, 1 / 3))
    return _remeshed(stage, mesh, f"x {3 ** int(level)}")


def _near(stage: Stage) -> np.ndarray:
    middles = stage.mesh.vertices[stage.mesh.faces].mean(axis=1)
    return np.linalg.norm(middles - stage.centre, axis=1) < AROUND


def _remeshed(stage: Stage, mesh: Mesh, level: str) -> Trial:
    """The same load on the same skin, at the vertices that both meshes have."""
    trial = _pressed(mesh, RATIO * disc(mesh, stage.centre), level, "mesh")
    pressed = RATIO * disc(stage.mesh, stage.centre)
    even = Pressures(stage.mesh, np.stack([0.5 * pressed, pressed, 0 * pressed]))
    same = np.arange(len(stage.mesh.vertices))
    return replace(trial, twin=Twin(even, np.stack([same, same], axis=1), np.eye(3)))


def scale(stage: Stage, level: float) -> Trial:
    """The scene in another unit of length; millimetres are 1000, and refusing them is right."""
    mesh, pressed = stage.mesh, RATIO * disc(stage.mesh, stage.centre)[None]
    other = replace(mesh, vertices=level * mesh.vertices, thickness=level * mesh.thickness)
    same = np.arange(len(mesh.vertices))
    twin = Twin(Pressures(other, pressed), np.stack([same, same], axis=1), np.eye(3), level, may_refuse=level >= 100)
    return Trial("", f"x {level:g}", ("finite", "sinks", "similar"), Pressures(mesh, pressed), twin)


def turn(stage: Stage, level: float) -> Trial:
    """The scene turned about a skew axis through the origin, in degrees."""
    rotation = Rotation.from_rotvec(np.radians(level) * np.array([2.0, 3.0, 6.0]) / 7).as_matrix()
    return _moved(stage, rotation, np.zeros(3), f"{level:g}°")


def shift(stage: Stage, level: float) -> Trial:
    """The scene moved away from the origin, in metres."""
    return _moved(stage, np.eye(3), level * np.array([2.0, 3.0, 6.0]) / 7, f"{level:g} m")


def _moved(stage: Stage, rotation: np.ndarray, by: np.ndarray, level: str) -> Trial:
    mesh, pressed = stage.mesh, RATIO * disc(stage.mesh, stage.centre)[None]
    other = Pressures(replace(mesh, vertices=mesh.vertices @ rotation.T + by), pressed)
    same = np.arange(len(mesh.vertices))
    return Trial("", level, ("finite", "sinks", "objective"), Pressures(mesh, pressed),
                 Twin(other, np.stack([same, same], axis=1), rotation))  # fmt: skip


def stale_start(stage: Stage, level: float) -> Trial:
    """A load at p / E elsewhere and then here, before the usual one: its answer must know nothing of them."""
    mesh = stage.mesh
    here, there = disc(mesh, stage.centre), disc(mesh, stage.apart(2))
    loads = np.stack([level * there, level * here, RATIO * here])
    return Trial("", f"{level:g} E", ("finite", "sinks", "returns"), Pressures(mesh, loads))


def jump(stage: Stage, level: float) -> Trial:
    """Full load at p / E, none, full load."""
    pressed = level * disc(stage.mesh, stage.centre)
    scene = Pressures(stage.mesh, np.stack([pressed, 0 * pressed, pressed]))
    return Trial("", f"{level:g} E", ("finite", "zero", "sinks", "returns"), scene)


def cycles(stage: Stage, level: float) -> Trial:
    """Pressing and releasing so often."""
    pressed = RATIO * disc(stage.mesh, stage.centre, 8e-3)
    scene = Pressures(stage.mesh, np.stack([0 * pressed, pressed]))
    return Trial("", f"{int(level):,}", ("finite", "zero", "sinks", "returns"), scene, rounds=int(level))


def noise(stage: Stage, level: float) -> Trial:
    """Noise of 5 % on the load at each vertex, at p / E."""
    rng, pressed = np.random.default_rng(stage.seed), level * disc(stage.mesh, stage.centre)
    noisy = [pressed * (1 + NOISE * rng.normal(size=len(pressed))) for _ in range(3)]
    return Trial("", f"{level:g} E", ("finite", "sinks", "gain"), Pressures(stage.mesh, np.stack([pressed, *noisy])))


def two_contacts(stage: Stage, level: float) -> Trial:
    """Two contacts, and the gap between them in thicknesses; at least FAR, where neither feels the other."""
    assert level >= FAR
    here, there = (RATIO * disc(stage.mesh, c) for c in (stage.centre, stage.apart(level)))
    scene = Pressures(stage.mesh, np.stack([here, there, here + there]))
    return Trial("", f"{level:g} t", ("finite", "sinks", "additive"), scene)


def not_finite(stage: Stage, level: float) -> Trial:
    """NaN, infinity or minus infinity at one pressed vertex."""
    pressed = RATIO * disc(stage.mesh, stage.centre)
    pressed[pressed.argmax()] = (np.nan, np.inf, -np.inf)[int(level)]
    return Trial("", ("NaN", "inf", "-inf")[int(level)], ("refuses",), Pressures(stage.mesh, pressed[None]))


AXES: dict[str, Callable[[Stage, float], Trial]] = {
    "pressure": pressure, "nu": poisson_ratio, "thickness": thickness, "thickness gradient": gradient,
    "contact size": size, "edge": edge, "seam": seam, "obtuse": obtuse, "area jump": area_jump, "scale": scale,
    "turn": turn, "shift": shift, "stale start": stale_start, "jump": jump, "cycles": cycles, "noise": noise,
    "two contacts": two_contacts, "not finite": not_finite,
} | CONTACT_AXES | LAYERED_AXES | STROKE_AXES  # fmt: skip
