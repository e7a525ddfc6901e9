"""Two axes of tools on skin, fat and muscle: what breaks laws on one material, and parts of a body as measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.tissue import Membrane, Ply, Tissue
from stmpl_core.tool import Tool
from studies.stability import shapes
from studies.stability.contact_axes import COUNT, SOUND, alone, on_plate, posed
from studies.stability.contact_laws import SLIDE
from studies.stability.contacts import Contacts, Placed
from studies.stability.meshes import even_plate, irregular, limb, plate
from studies.stability.scene import Mesh
from studies.stability.trial import Trial, Twin

if TYPE_CHECKING:
    from studies.stability.sweeps import Stage

THICKNESS, RADIUS, LENGTH, EDGE = 0.02, 0.05, 0.2, 6e-3  # m, of the round limb
LAYERS = Tissue(3e3, 0.4, skin=Membrane(2e5, 1.5e-3, 15.0), deeper=(Ply(8e-3, 15e3, 0.4),))
PRESSED = {  # tools with the half of their size along x at the limb
    "ball": (shapes.ball(0.02), 0.02), "capsule": (shapes.capsule(0.01, 0.04), 0.01),
    "box": (shapes.box(0.03, 0.03, 0.03), 0.015),
}  # fmt: skip
EVENLY = 9e-3  # edge length from which the layer's own mesh is its coarse one [m]: MMG makes another in another size
TURN = Rotation.from_rotvec(np.pi / 2 * np.array([2.0, 3.0, 6.0]) / 7).as_matrix()
PARTS, PART_EDGE = ("left_forearm", "left_upper_arm", "left_thigh", "back"), 8e-3  # and their edges [m]
PLACES = 8  # places on a part that are pressed
DEPTHS = (0.15, 0.3, 0.5, 0.65, 0.9, 1.5, 3.0, 4.5)  # thicknesses


@cache
def skin(edge_length: float = EDGE) -> Mesh:
    """A round limb of skin, fat and muscle."""
    return replace(limb(edge_length, RADIUS, LENGTH, THICKNESS), tissue=LAYERS)


def flat_skin(edge_length: float = EDGE) -> Mesh:
    """A plate of the same layers."""
    return even_plate(12 * THICKNESS, edge_length, THICKNESS, LAYERS)


def grown(tissue: Tissue, length: float = 1.0, modulus: float = 1.0) -> Tissue:
    """A tissue whose lengths and moduli are so many times as large, and the tension of its skin likewise."""
    assert tissue.skin is not None
    sheet = Membrane(modulus * tissue.skin.youngs_modulus, length * tissue.skin.thickness,
                     length * modulus * tissue.skin.tension)  # fmt: skip
    deeper = tuple(replace(ply, depth=length * ply.depth, youngs_modulus=modulus * ply.youngs_modulus)
                   for ply in tissue.deeper)  # fmt: skip
    return replace(tissue, youngs_modulus=modulus * tissue.youngs_modulus, skin=sheet, deeper=deeper)


def on_limb(name: str, depth: float, z: float = LENGTH / 2, force: float | None = None) -> Placed:
    """A tool of PRESSED so deep [m] in the limb, from +x; with a force [N] or none."""
    tool, half = PRESSED[name]
    wrench = None if force is None else np.array([-force, 0, 0, 0, 0, 0])
    return Placed(tool, posed(np.array([RADIUS + half - depth, 0, z])), wrench)


def pressed(depth: float) -> Trial:
    """All tools to a depth over the thickness, from the level before on."""
    before = max((other for other in DEPTHS if other < depth), default=0.03)
    depths = THICKNESS * np.linspace(before, depth, COUNT)
    placed = [on_limb(name, each) for name in PRESSED for each in depths]
    series = tuple(np.repeat(range(len(PRESSED)), COUNT).tolist())
    laws = (*SOUND, "outside", *(["rises"] if depth * THICKNESS < RADIUS else []))
    return Trial("", f"{depth:g} t", laws, Contacts(skin(), alone(placed), series))


def forced(force: float) -> Trial:
    """A force in N, at a pose that touches and at one in the core."""
    placed = [on_limb(name, depth, force=force) for name in PRESSED for depth in (1e-3, 1.5 * THICKNESS)]
    return Trial("", f"{force:g} N", (*SOUND, "carries"), Contacts(skin(), alone(placed)))


def twisted(torque: float) -> Trial:
    """A torque in N m without a force, and with one of 1 N."""
    placed = [on_limb("ball", 1e-3, force=force) for force in (0.0, 1.0)]
    instants = alone(one._replace(wrench=one.wrench + np.array([0, 0, 0, 0, torque, 0])) for one in placed)
    return Trial("", f"{torque:g} N m", ("finite", "bounded", "carries"), Contacts(skin(), instants))


def ordinary() -> Trial:
    """A light and a deeper touch of all tools on the limb, 2 to 20 N on a plate."""
    lying = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    ball, half = PRESSED["ball"]
    placed = [on_plate(ball, half, 0.3 * THICKNESS)]
    for force in (2, 5, 20):
        placed.append(on_plate(ball, half, 0.1 * THICKNESS, force))
        one = on_plate(*PRESSED["capsule"], 0.1 * THICKNESS, force)
        placed.append(one._replace(pose=posed(one.pose[:3, 3], lying)))
    return Trial("", "massage", (*SOUND, "needless"), Contacts(flat_skin(), alone(placed)))


def first_touch() -> Trial:
    """Tools that barely touch."""
    mesh = skin()
    high = mesh.vertices[:, 2] - LENGTH / 2
    top = mesh.vertices[np.lexsort([np.abs(high), -mesh.vertices[:, 0].round(6)])[0], 2]  # of a vertex: no sag of faces
    depths = ((0.3, "ball"), (0.05, "ball"), (0.02, "ball"), (0.02, "box"))
    placed = [on_limb(name, share * THICKNESS, top) for share, name in depths]
    return Trial("", "first touch", (*SOUND, "needless"), Contacts(mesh, alone(placed)))


def slid(name: str, uneven: float = 0.0) -> Trial:
    """30 mm along the limb at 0.2 t; its vertices shifted by up to a share of an edge."""
    mesh = irregular(skin(), uneven) if uneven else skin()
    way = LENGTH / 2 + np.linspace(-0.015, 0.015, 31)
    placed = [on_limb(name, 0.2 * THICKNESS, z) for z in way]
    told = f"slide, {name}{', uneven' if uneven else ''}"
    return Trial("", told, (*SOUND, "ripple"), Contacts(mesh, alone(placed)))


def crept(name: str) -> Trial:
    """A tool slides by 2 um at a time: skin comes into its reach and leaves it."""
    placed = [on_limb(name, 0.3 * THICKNESS, LENGTH / 2 + k * SLIDE) for k in range(40)]
    return Trial("", f"creep, {name}", (*SOUND, "smooth"), Contacts(skin(), alone(placed)))


def popped(depth: float) -> Trial:
    """Depth over the thickness: by pose, then with the force that it pressed with."""
    placed = [on_plate(*PRESSED[name], depth * THICKNESS) for name in ("ball", "box")]
    return Trial("", f"by force, {depth:g} t", (*SOUND, "steady"), Contacts(flat_skin(), alone(placed), fed_back=True))


def coarse(edges: int) -> Trial:
    """A plate whose edges are so many times 6 mm, beside the even one, which has all its vertices."""
    steps = EDGE * np.arange(-24, 25)
    mesh, even = (plate(s, s, THICKNESS, LAYERS) for s in (steps[::edges], steps))
    instants = alone(on_plate(*PRESSED["ball"], share * THICKNESS) for share in (0.15, 0.3))
    pairs = np.stack([np.arange(len(mesh.vertices)), np.asarray(KDTree(even.vertices).query(mesh.vertices)[1])], axis=1)
    return Trial("", f"edges of {edges * EDGE / THICKNESS:.1f} t", (*SOUND, "mesh"), Contacts(mesh, instants),
                 Twin(Contacts(even, instants), pairs, np.eye(3)))  # fmt: skip


def instants_of() -> tuple[tuple[Placed, ...], ...]:
    """A light and a deep touch by pose, one with a force, and two tools at once."""
    two = on_limb("capsule", 0.2 * THICKNESS, LENGTH / 2 + 0.04)
    return ((on_limb("ball", 0.1 * THICKNESS),), (on_limb("ball", 0.6 * THICKNESS),),
            (on_limb("ball", 1e-3, force=2.0),), (on_limb("ball", 0.3 * THICKNESS), two))  # fmt: skip


def again(told: str, law: str, edge_length: float = EDGE, *, length: float = 1.0, modulus: float = 1.0,
          turn: np.ndarray | None = None) -> Trial:  # fmt: skip
    """The scene in another size, stiffness or place: the same ratios, the same answer, the same verdict.

    Its skin is uneven: on an even one vertices lie just as far from a load as it is felt, and rounding decides.
    """
    mesh, instants, by = irregular(skin(edge_length), 0.2), instants_of(), np.eye(3) if turn is None else turn
    tools = {id(tool): Tool(tool.name, length * tool.vertices, tool.faces) for tool, _ in PRESSED.values()}
    wrenches = modulus * np.repeat([length**2, length**3], 3)
    twin = tuple(tuple(Placed(tools[id(p.tool)], posed(length * by @ p.pose[:3, 3], by @ p.pose[:3, :3]),
                              None if p.wrench is None else np.kron(np.eye(2), by) @ (wrenches * p.wrench))
                       for p in instant) for instant in instants)  # fmt: skip
    other = replace(mesh, vertices=length * mesh.vertices @ by.T, thickness=length * mesh.thickness,
                    tissue=grown(mesh.tissue, length, modulus))  # fmt: skip
    same = np.arange(len(mesh.vertices))
    return Trial("", told, ("finite", law, "verdict"), Contacts(mesh, instants),
                 Twin(Contacts(other, twin), np.stack([same, same], axis=1), by, length))  # fmt: skip


def cycled(rounds: int) -> Trial:
    """Pressing and leaving so often."""
    placed = [on_limb("ball", share * THICKNESS) for share in (-0.5, 0.7, 0.3)]
    scene = Contacts(skin(), alone(placed))
    return Trial("", f"{rounds} cycles", ("finite", "bounded", "returns"), scene, rounds=rounds)


@cache
def part(name: str) -> Mesh:
    """A part of the average body as measured."""
    return Mesh.of(living(Body.anny(), name, edge_length=PART_EDGE))


def places(mesh: Mesh) -> np.ndarray:
    """Numbers of PLACES vertices, all over a part but for its borders."""
    layer = mesh.layer
    away = KDTree(layer.vertices[layer.border]).query(layer.vertices)[0] > 2 * layer.thickness.max()
    some = np.flatnonzero(away)
    chosen = [int(some[0])]
    while len(chosen) < PLACES:  # each the furthest from those before
        apart = KDTree(layer.vertices[chosen]).query(layer.vertices[some])[0]
        chosen.append(int(some[apart.argmax()]))
    return np.array(chosen)


def over(mesh: Mesh, vertex: int, name: str, depth: float, force: float | None = None) -> Placed:
    """A tool of PRESSED turned and moved to a vertex, so deep over the thickness there; with a force [N] or none."""
    layer, (tool, half) = mesh.layer, PRESSED[name]
    out = layer.normals[vertex]
    turn = Rotation.align_vectors(out[None], np.array([[1.0, 0.0, 0.0]]))[0].as_matrix()
    place = layer.vertices[vertex] + (half - depth * layer.thickness[vertex]) * out
    return Placed(tool, posed(place, turn), None if force is None else np.concatenate([-force * out, np.zeros(3)]))


def part_pressed(name: str) -> Trial:
    """All tools at places all over a part, from first touch on, until they are at the bone."""
    mesh = part(name)
    depths = np.linspace(0.05, 1.1, 8)
    some = [(vertex, tool) for vertex in places(mesh) for tool in PRESSED]
    placed = [over(mesh, vertex, tool, depth) for vertex, tool in some for depth in depths]
    series = tuple(np.repeat(range(len(some)), len(depths)).tolist())
    return Trial("", f"{name}, depth", (*SOUND, "outside", "rises"), Contacts(mesh, alone(placed), series))


def part_forced(name: str) -> Trial:
    """2, 20 and 200 N at the same places."""
    mesh = part(name)
    placed = [over(mesh, vertex, "ball", 0.05, force) for vertex in places(mesh) for force in (2.0, 20.0, 200.0)]
    return Trial("", f"{name}, force", (*SOUND, "carries"), Contacts(mesh, alone(placed)))


TRIALS: tuple[Callable[[], Trial], ...] = (
    first_touch, ordinary, *(partial(pressed, depth) for depth in DEPTHS),
    *(partial(forced, force) for force in (1.0, 10.0, 1e3, 1e20)), partial(twisted, 1.0), partial(slid, "ball"),
    partial(slid, "capsule"), partial(slid, "ball", uneven=0.3), partial(crept, "ball"), partial(crept, "box"),
    *(partial(popped, depth) for depth in (0.1, 0.5, 0.8)), partial(coarse, 2), partial(coarse, 3),
    partial(again, "x 0.5", "similar", EVENLY, length=0.5), partial(again, "x 2", "similar", EVENLY, length=2.0),
    partial(again, "x 0.5, another coarse mesh", "mesh", length=0.5),
    partial(again, "a million times as stiff", "similar", modulus=1e6), partial(again, "90°", "objective", turn=TURN),
    partial(cycled, 100),
)  # fmt: skip


def layered(stage: Stage, level: float) -> Trial:
    """Number of a trial of TRIALS."""
    return TRIALS[int(level)]()


def measured(stage: Stage, level: float) -> Trial:
    """Number of a part of PARTS, first pressed by pose, then by force."""
    by_force, number = divmod(int(level), len(PARTS))
    return (part_forced if by_force else part_pressed)(PARTS[number])


LAYERED_AXES: dict[str, Callable[[Stage, float], Trial]] = {"skin, fat, muscle": layered, "part as measured": measured}
LAYERED_LEVELS: dict[str, Sequence[float]] = {"skin, fat, muscle": tuple(range(len(TRIALS))),
                                              "part as measured": tuple(range(2 * len(PARTS)))}  # fmt: skip
QUICK_LAYERED: dict[str, Sequence[float]] = {"skin, fat, muscle": (3,), "part as measured": (0,)}
