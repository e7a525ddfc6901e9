"""The axes along which tools press, from easy to hard, and the trials along each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from studies.stability import shapes
from studies.stability.contact_laws import SLIDE
from studies.stability.contacts import Contacts, Placed
from studies.stability.meshes import even_plate, fingers, inserted, irregular, limb, plate, slanted_plate
from studies.stability.scene import Mesh
from studies.stability.trial import Trial, Twin
from studies.stability.truth import truth

if TYPE_CHECKING:
    from studies.stability.sweeps import Stage

THICKNESS, RADIUS, LENGTH = 7.5e-3, 0.04, 0.16  # m, of the round limb
BALL = shapes.ball(0.012)
PRESSED = {  # tools with the half of their size along x at the limb
    "ball": (BALL, 0.012), "slab": (shapes.box(0.004, 0.03, 0.03, "slab"), 0.002),
    "pin": (shapes.capsule(0.002, 0.02, "pin"), 0.002), "box": (shapes.box(0.03, 0.03, 0.03), 0.015),
}  # fmt: skip
SLID = {"ball": PRESSED["ball"], "finger": (shapes.capsule(0.008, 0.014, "finger"), 0.008), "pin": PRESSED["pin"]}
UNEVEN = 0.2  # shift of vertices along the skin over its edges, which makes no triangle too long yet
DEEP_LEVELS = (0.15, 0.3, 0.5, 0.65, 0.8, 0.9, 1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 9.0)
FELT = 8.0  # thicknesses along the skin, within which a tool may be felt
COUNT = 5  # instants of a series
SOUND = ("finite", "bounded", "touches", "presses")

skin = cache(lambda edge_length: limb(edge_length, RADIUS, LENGTH, THICKNESS))


def at(x: float, y: float, z: float) -> np.ndarray:
    """A pose that is not turned, (4, 4)."""
    return posed(np.array([x, y, z]))


def posed(place: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
    """A pose at a place (3,) [m], (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = place
    if turn is not None:
        pose[:3, :3] = turn
    return pose


def on_limb(name: str, depth: float, z: float = LENGTH / 2, force: float | None = None) -> Placed:
    """A tool of PRESSED so deep [m] in the round limb, from +x; with a force [N] or none."""
    tool, half = PRESSED[name]
    wrench = None if force is None else np.array([-force, 0, 0, 0, 0, 0])
    return Placed(tool, at(RADIUS + half - depth, 0, z), wrench)


def on_plate(tool: Tool, half: float, depth: float, force: float | None = None) -> Placed:
    """A tool so deep [m] in the middle of a plate, its lowest point `half` under its origin [m]."""
    return Placed(tool, at(0, 0, half - depth), None if force is None else np.array([0, 0, -force, 0, 0, 0]))


def alone(placed: Iterable[Placed]) -> tuple[tuple[Placed], ...]:
    """One tool an instant."""
    return tuple((one,) for one in placed)


def deep(stage: Stage, level: float) -> Trial:
    """Depth over thickness, from the level before on; to the limb's axis and, with no law of growth, beyond."""
    before = max((other for other in DEEP_LEVELS if other < level), default=0.03)
    depths = THICKNESS * np.linspace(before, level, COUNT)
    placed = [on_limb(name, depth) for name in PRESSED for depth in depths]
    series = tuple(np.repeat(range(len(PRESSED)), COUNT).tolist())
    laws = (*SOUND, "outside", *(["rises"] if level * THICKNESS < RADIUS else []))
    return Trial("", f"{level:g} t", laws, Contacts(skin(stage.tool_edge), alone(placed), series))


def overload(stage: Stage, level: float) -> Trial:
    """Force in N on 1 kPa, at a pose that touches and at one in the core."""
    placed = [on_limb(name, depth, force=level) for name in PRESSED for depth in (1e-3, 1.5 * THICKNESS)]
    return Trial("", f"{level:g} N", (*SOUND, "carries"), Contacts(skin(stage.tool_edge), alone(placed)))


def border(stage: Stage, level: float) -> Trial:
    """Distance of a ball from the open border, in thicknesses, against finite elements."""
    return _true("border", level, f"{level:g} t")


def slant(stage: Stage, level: float) -> Trial:
    """Angle of a ball's way to the skin's normal, in degrees, with the force that finite elements found."""
    return _true("slant", level, f"{level:g}°")


def kind(stage: Stage, level: float) -> Trial:
    """Kinds of tool and skin, against finite elements."""
    names = ("ball", "capsule", "punch", "wide punch", "two balls", "ring on a saddle")
    return _true("kind", level, names[int(level)])


def contact_nu(stage: Stage, level: float) -> Trial:
    """Poisson's ratio under a ball, against finite elements."""
    return _true("nu of contact", level, f"{level:g}")


def _true(axis: str, level: float, told: str) -> Trial:
    return Trial("", told, ("finite", "bounded", "covers"), truth(axis, level))


def through_air(stage: Stage, level: float) -> Trial:
    """Gap between two fingers, in thicknesses; one is pressed."""
    mesh = fingers(level * 4e-3, 2e-3, 0.06, 4e-3)
    x, y, _ = mesh.vertices.T
    placed = Placed(shapes.ball(0.005), at(-level * 2e-3 - 5e-3, 0.02, 0.005 - 1e-3))
    still = (x > 0) & (y < 0.06 - FELT * 4e-3)
    return Trial("", f"{level:g} t", ("finite", "bounded", "still"), Contacts(mesh, ((placed,),), still=still))


def long_triangles(stage: Stage, level: float) -> Trial:
    """Length of the triangles over their width, under a ball."""
    return _finer(*_plates(3e-3, int(level), 1), f"{level:g}", BALL, 0.012)


def coarse(stage: Stage, level: float) -> Trial:
    """Edges of the mesh over the thickness, under a ball."""
    k = round(level / 0.4)
    return _finer(*_plates(3e-3, k, k), f"{level:g} t", BALL, 0.012)


def small_tool(stage: Stage, level: float) -> Trial:
    """Edges of the mesh over the radius of a ball."""
    radius = 4e-3 / level
    return _finer(*_plates(2e-3, 2, 2), f"{level:.2g}", shapes.ball(radius), radius)


def area_jump(stage: Stage, level: float) -> Trial:
    """On one side of a ball faces are cut in three at their middle, so many times."""
    even = mesh = skin(stage.tool_edge)
    for _ in range(int(level)):
        middles = mesh.vertices[mesh.faces].mean(axis=1)
        near = np.linalg.norm(middles - (RADIUS, 0, LENGTH / 2), axis=1) < 0.025
        mesh = inserted(mesh, np.flatnonzero(near & (middles[:, 2] > LENGTH / 2)), (1 / 3, 1 / 3, 1 / 3))
    instants = alone(on_limb("ball", share * THICKNESS) for share in (0.15, 0.3))
    same = np.arange(len(even.vertices))
    return Trial("", f"x {3 ** int(level)}", (*SOUND, "mesh"), Contacts(mesh, instants),
                 Twin(Contacts(even, instants), np.stack([same, same], axis=1), np.eye(3)))  # fmt: skip


def _plates(edge: float, along: int, across: int) -> tuple[Mesh, Mesh]:
    """A plate of these multiples of an edge, and the even one, which has all its vertices."""
    steps = edge * np.arange(-24, 25)
    return plate(steps[::along], steps[::across], THICKNESS), plate(steps, steps, THICKNESS)


def _finer(mesh: Mesh, even: Mesh, told: str, tool: Tool, radius: float) -> Trial:
    """The same presses on the same skin, at the vertices that both meshes have."""
    instants = alone(on_plate(tool, radius, share * THICKNESS) for share in (0.15, 0.3))
    partner = np.asarray(KDTree(even.vertices).query(mesh.vertices)[1])
    pairs = np.stack([np.arange(len(partner)), partner], axis=1)
    return Trial("", told, (*SOUND, "mesh"), Contacts(mesh, instants), Twin(Contacts(even, instants), pairs, np.eye(3)))


def massage(stage: Stage, level: float) -> Trial:
    """Thickness in mm at 10 and 50 kPa: an ordinary touch, then 5 to 50 N with a ball and a capsule."""
    thickness, modulus = level * 1e-3, (10e3, 50e3)[level != int(level)]
    mesh = even_plate(16 * thickness, 0.4 * thickness, thickness, Tissue(modulus))
    lying = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    tools = [(shapes.ball(0.025), 0.025, None), (shapes.capsule(0.015, 0.04), 0.015, lying)]
    placed = [on_plate(shapes.ball(1.6 * thickness), 1.6 * thickness, 0.3 * thickness)]
    for tool, half, turn in tools:
        for force in (5, 15, 50):
            one = on_plate(tool, half, 0.1 * thickness, force)
            placed.append(one._replace(pose=posed(one.pose[:3, 3], turn)))
    return Trial("", f"{int(level)} mm, {modulus / 1e3:g} kPa", (*SOUND, "needless"), Contacts(mesh, alone(placed)))


def first_touch(stage: Stage, level: float) -> Trial:
    """Depth over thickness of an ordinary touch, falling."""
    mesh = skin(stage.tool_edge)
    high = mesh.vertices[:, 2] - LENGTH / 2
    top = mesh.vertices[np.lexsort([np.abs(high), -mesh.vertices[:, 0].round(6)])[0], 2]  # of a vertex: no sag of faces
    placed = [on_limb(name, share * THICKNESS, top) for share, name in
              [(0.3, "ball"), (level, "ball"), (level, "box")]]  # fmt: skip
    return Trial("", f"{level:g} t", (*SOUND, "needless"), Contacts(mesh, alone(placed)))


def fit(stage: Stage, level: float) -> Trial:
    """Depth over thickness up to which a ball pressed, from whose forces the stiffness is found."""
    placed = [on_limb("ball", depth * THICKNESS) for depth in np.linspace(0.08, level, 7)]
    return Trial("", f"{level:g} t", (*SOUND, "agrees"), Contacts(skin(stage.tool_edge), alone(placed)))


def slide(stage: Stage, level: float) -> Trial:
    """30 mm at 0.2 t with three tools, on 3 and 5 mm, along an even limb and on an uneven plate, whose facets are even.

    Facets of an uneven mesh of a limb are no even skin: they lie up to edge^2 / (8 radius) below it, here and there.
    """
    number, rest = divmod(int(level), 4)
    name, flat, edge = list(SLID)[number], rest >= 2, (3e-3, 5e-3)[rest % 2]
    tool, half = SLID[name]
    mesh = irregular(slanted_plate(0.12, edge, THICKNESS), UNEVEN) if flat else skin(edge)
    lying = Rotation.from_euler("x", 90, degrees=True).as_matrix() if flat else None
    high = half - 0.2 * THICKNESS
    places = [(x, 0, high) if flat else (RADIUS + high, 0, LENGTH / 2 + x) for x in np.linspace(-0.015, 0.015, 61)]
    instants = alone(Placed(tool, posed(np.array(place), lying)) for place in places)
    told = f"{name}, {edge * 1e3:g} mm{', uneven plate' if flat else ''}"
    return Trial("", told, (*SOUND, "ripple"), Contacts(mesh, instants))


def creep(stage: Stage, level: float) -> Trial:
    """A tool slides by 2 um at a time: skin comes into its reach and leaves it."""
    name = list(PRESSED)[int(level)]
    placed = [on_limb(name, 0.3 * THICKNESS, LENGTH / 2 + k * SLIDE) for k in range(60)]
    return Trial("", name, (*SOUND, "smooth"), Contacts(skin(stage.tool_edge), alone(placed)))


def pop(stage: Stage, level: float) -> Trial:
    """Depth over a thickness of 20 mm: by pose, then with the force that it pressed with."""
    mesh = even_plate(0.24, 0.4 * 0.02, 0.02)
    placed = [on_plate(tool, half, level * 0.02) for tool, half in (PRESSED["ball"], PRESSED["box"])]
    return Trial("", f"{level:g} t", (*SOUND, "steady"), Contacts(mesh, alone(placed), fed_back=True))


def torque(stage: Stage, level: float) -> Trial:
    """Torque in N m without a force, and with one of 0.1 N."""
    twist = np.array([0, 0, 0, 0, level, 0])
    placed = [on_limb("ball", 1e-3, force=force) for force in (0.0, 0.1)]
    instants = alone(one._replace(wrench=one.wrench + twist) for one in placed)
    return Trial("", f"{level:g} N m", ("finite", "bounded", "carries"), Contacts(skin(stage.tool_edge), instants))


def scale(stage: Stage, level: float) -> Trial:
    """The scene in another size: the same ratios, the same answer, the same verdict."""
    mesh, instants = skin(stage.tool_edge), _ordinary()
    other = replace(mesh, vertices=level * mesh.vertices, thickness=level * mesh.thickness)
    larger = cache(lambda tool: Tool(tool.name, level * tool.vertices, tool.faces))
    grown = np.repeat([level**2, level**3], 3)
    twin = tuple(tuple(Placed(larger(p.tool), _moved(p.pose, np.eye(3), level),
                              None if p.wrench is None else grown * p.wrench) for p in instant)
                 for instant in instants)  # fmt: skip
    return _again(f"x {level:g}", "similar", mesh, instants, Contacts(other, twin), scale=level)


def stiffness(stage: Stage, level: float) -> Trial:
    """Young's modulus in Pa, forces likewise."""
    mesh, instants = skin(stage.tool_edge), _ordinary()
    other = replace(mesh, tissue=replace(mesh.tissue, youngs_modulus=level))
    by = level / mesh.tissue.youngs_modulus
    twin = tuple(tuple(p._replace(wrench=None if p.wrench is None else by * p.wrench) for p in one) for one in instants)
    return _again(f"{level:g} Pa", "similar", mesh, instants, Contacts(other, twin))


def turn(stage: Stage, level: float) -> Trial:
    """Skin and tools turned about a skew axis, in degrees."""
    mesh, instants = skin(stage.tool_edge), _ordinary()
    by = Rotation.from_rotvec(np.radians(level) * np.array([2.0, 3.0, 6.0]) / 7).as_matrix()
    other = replace(mesh, vertices=mesh.vertices @ by.T)
    both = np.kron(np.eye(2), by)
    twin = tuple(tuple(Placed(p.tool, _moved(p.pose, by), None if p.wrench is None else both @ p.wrench)
                       for p in instant) for instant in instants)  # fmt: skip
    return _again(f"{level:g}°", "objective", mesh, instants, Contacts(other, twin), by)


def contact_cycles(stage: Stage, level: float) -> Trial:
    """Pressing and leaving so often."""
    placed = [on_limb("ball", share * THICKNESS) for share in (-0.5, 0.7, 0.3)]
    scene = Contacts(skin(stage.tool_edge), alone(placed))
    return Trial("", f"{int(level):,}", ("finite", "bounded", "returns"), scene, rounds=int(level))


def tips(stage: Stage, level: float) -> Trial:
    """Width of a needle and of a pencil's end over the mesh's edges: over a vertex, beside it, over an edge and a face.

    They go in along the skin's normal, from 0.07 to 0.6 of the thickness.
    """
    layer = (mesh := skin(stage.tool_edge)).layer
    v = int(np.linalg.norm(layer.vertices - (RADIUS, 0, LENGTH / 2), axis=1).argmin())
    corners = layer.vertices[layer.faces[np.flatnonzero((layer.faces == v).any(axis=1))[0]]]
    places = layer.vertices[v], 0.95 * layer.vertices[v] + 0.05 * corners.mean(axis=0), corners[:2].mean(axis=0), \
        corners.mean(axis=0)  # fmt: skip
    out = layer.normals[v]
    turn = Rotation.align_vectors([out], [[0.0, 0.0, 1.0]])[0].as_matrix()
    placed = [Placed(tool, posed(place - depth * THICKNESS * out, turn))
              for tool in (shapes.needle(level * stage.tool_edge), shapes.pencil(level * stage.tool_edge))
              for place in places for depth in np.linspace(0.07, 0.6, COUNT)]  # fmt: skip
    series = tuple(np.repeat(range(2 * len(places)), COUNT).tolist())
    return Trial("", f"{level:g}", (*SOUND, "rises"), Contacts(mesh, alone(placed), series))


def _ordinary() -> tuple[tuple[Placed, ...], ...]:
    """A light and a deep touch by pose, one with a force, and two tools at once."""
    pin = on_limb("pin", 0.2 * THICKNESS, LENGTH / 2 + 0.02)
    return ((on_limb("ball", 0.1 * THICKNESS),), (on_limb("ball", 0.6 * THICKNESS),),
            (on_limb("ball", 1e-3, force=0.05),), (on_limb("ball", 0.3 * THICKNESS), pin))  # fmt: skip


def _moved(pose: np.ndarray, turn: np.ndarray, scale: float = 1.0) -> np.ndarray:
    return posed(scale * turn @ pose[:3, 3], turn @ pose[:3, :3])


def _again(told: str, law: str, mesh: Mesh, instants: tuple[tuple[Placed, ...], ...], other: Contacts,
           turn: np.ndarray | None = None, scale: float = 1.0) -> Trial:  # fmt: skip
    same = np.arange(len(mesh.vertices))
    twin = Twin(other, np.stack([same, same], axis=1), np.eye(3) if turn is None else turn, scale)
    return Trial("", told, ("finite", law, "verdict"), Contacts(mesh, instants), twin)


CONTACT_AXES: dict[str, Callable[[Stage, float], Trial]] = {
    "depth": deep, "overload": overload, "torque": torque, "border": border, "slant": slant, "kind": kind,
    "nu of contact": contact_nu, "through air": through_air, "long triangles": long_triangles, "coarse": coarse,
    "small tool": small_tool, "area jump of contact": area_jump, "massage": massage, "first touch": first_touch,
    "fit": fit, "slide": slide, "creep": creep, "pop": pop, "scale of contact": scale, "stiffness": stiffness,
    "turn of contact": turn, "cycles of contact": contact_cycles, "tips": tips,
}  # fmt: skip
CONTACT_LEVELS: dict[str, Sequence[float]] = {
    "depth": DEEP_LEVELS,
    "overload": (0.1, 1, 10, 1e3, 1e6, 1e20),
    "torque": (1e-3, 0.1, 10),
    "border": (4, 2, 1, 0.5, 0),
    "slant": (0, 15, 30, 45),
    "kind": (0, 1, 2, 3, 4, 5),
    "nu of contact": (0.3, 0.4, 0.45, 0.49),
    "through air": (2, 1, 0.375, 0.1),
    "long triangles": (1, 2, 3, 4),
    "coarse": (0.4, 0.8, 1.2, 1.6),
    "small tool": (0.33, 0.67, 1.33, 2.67),
    "area jump of contact": (1, 2, 3),
    "massage": (10, 20, 40, 10.5, 20.5, 40.5),
    "first touch": (0.15, 0.05, 0.01),
    "fit": (0.3, 0.5, 0.62),
    "slide": tuple(range(12)),
    "creep": (0, 1, 2, 3),
    "pop": (0.1, 0.3, 0.6, 0.8, 0.89),
    "scale of contact": (0.5, 0.1, 2),
    "stiffness": (1e2, 1e4, 1e6, 1e9, 1e12),
    "turn of contact": (30, 90, 180),
    "cycles of contact": (100, 1000),
    "tips": (1, 0.3, 0.1, 0.03, 0.01),
}
QUICK_CONTACTS: dict[str, Sequence[float]] = {
    "depth": (0.3, 3), "overload": (0.1,), "torque": (0.1,), "border": (4,), "slant": (0,), "kind": (0,),
    "nu of contact": (0.4,), "through air": (1,), "long triangles": (2,), "coarse": (0.8,), "small tool": (0.67,),
    "area jump of contact": (1,), "massage": (20,), "first touch": (0.05,), "fit": (0.5,), "slide": (0,),
    "creep": (0,), "pop": (0.3,), "scale of contact": (0.5,), "stiffness": (1e6,), "turn of contact": (90,),
    "cycles of contact": (100,), "tips": (0.1,),
}  # fmt: skip
