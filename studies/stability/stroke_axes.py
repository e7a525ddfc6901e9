"""The axes along which strokes with a state get harder: reversals, stick-slip, lifts, steps, and the trials of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from stmpl_core.tissue import Membrane, Ply, Prony, Tissue
from stmpl_core.tool import Tool
from studies.stability import shapes
from studies.stability.layered_axes import part
from studies.stability.meshes import even_plate, limb
from studies.stability.scene import Mesh
from studies.stability.strokes import Spring, Strokes
from studies.stability.trial import Trial, Twin

if TYPE_CHECKING:
    from studies.stability.sweeps import Stage

THICKNESS, RADIUS = 7.5e-3, 0.012  # m
DEEP = 0.3 * THICKNESS  # m
SERIES = Prony((0.225, 0.225), (0.5, 5.0))
ELASTIC, FADING = Tissue(2e4), Tissue(2e4, relaxation=SERIES)
STACK = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0, relaxation=SERIES), relaxation=SERIES,
               deeper=(Ply(2e-3, 12e3, 0.45, relaxation=SERIES),))  # fmt: skip
BALL, FLAT = shapes.ball(RADIUS), shapes.punch(8e-3, 0.02, fillet=2e-3)
HALF = {id(BALL): RADIUS, id(FLAT): 0.01}  # half of a tool's height [m]
TILTED = (  # tools of the tilting paths, and how far their origins are above their lowest point [m]
    (shapes.ball(0.01), 0.01), (shapes.box(0.02, 0.012, 0.01), 0.005), (shapes.punch(0.012, 0.01, "disc"), 0.005),
    (shapes.cup(9e-3, 12e-3, 0.02), 0.0), (shapes.capsule(3e-3, 0.054, "stylus"), 0.03),
)  # fmt: skip
LOOPS, RUBBED, OFF = (0.5, 0.85), (0.0, 0.3, 1e-3), 5e-4  # depths over the thickness, friction, way off the skin [m]
MU = 0.5
STEP = 0.01  # time between instants where nothing else is said [s]
LAWS = ("finite", "gives", "caps")
KEYS = np.dtype([("time", float), ("x", float), ("y", float), ("depth", float), ("turn", float, 3)])


@cache
def skin(tissue: Tissue) -> Mesh:
    """The plate that is stroked."""
    return even_plate(16 * THICKNESS, 0.4 * THICKNESS, THICKNESS, tissue)


def keys(*each: tuple[float, ...]) -> np.ndarray:
    """Places of a tool: time [s], x, y, depth [m] and, if given, a turn as a vector [rad]."""
    return np.array([(*one[:4], one[4:] or (0, 0, 0)) for one in each], dtype=KEYS)


def led(places: np.ndarray, times: np.ndarray, half: float) -> np.ndarray:
    """Poses of a tool at times, straight between its places, (N, 4, 4)."""
    between = {name: np.interp(times, places["time"], places[name]) for name in ("x", "y", "depth")}
    turns = np.stack([np.interp(times, places["time"], places["turn"][:, x]) for x in range(3)], axis=1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = np.stack([between["x"], between["y"], half - between["depth"]], axis=1)
    return poses


def stroke(places: np.ndarray, times: np.ndarray, tissue: Tissue = FADING, friction: float = MU,
           tool: Tool = BALL) -> Strokes:  # fmt: skip
    """A tool that is led by its places over the plate."""
    return Strokes(skin(tissue), tool, led(places, times, HALF[id(tool)]), times, friction)


def every(places: np.ndarray, step: float) -> np.ndarray:
    """Instants of a path, so long apart [s]."""
    return np.linspace(places["time"][0], places["time"][-1], 1 + round(np.ptp(places["time"]) / step))


def finer(times: np.ndarray) -> np.ndarray:
    """The same instants and those half between."""
    return np.interp(np.arange(2 * len(times) - 1) / 2, np.arange(len(times)), times)


def halved(told: str, scene: Strokes, places: np.ndarray, *laws: str) -> Trial:
    """A path, and the same with a further instant in the middle of each step."""
    times = finer(scene.times)
    twin = replace(scene, poses=led(places, times, HALF[id(scene.tool)]), times=times, off=None)
    pairs = np.stack([np.arange(len(scene.times)), 2 * np.arange(len(scene.times))], axis=1)
    return Trial("", told, (*LAWS, "alike", *laws), scene, Twin(twin, pairs, np.eye(3)))


def reversal(stage: Stage, level: float) -> Trial:
    """Way of a slide there and back in mm: at once, so that nothing fades."""
    way = 1e-3 * level * np.concatenate([np.linspace(0, 1, 41), np.linspace(1, -1, 81)[1:], np.linspace(-1, 1, 81)[1:]])
    poses = np.tile(np.eye(4), (len(way), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = way, RADIUS - DEEP
    scene = Strokes(skin(ELASTIC), BALL, poses, np.zeros(len(way)), MU)
    return Trial("", f"{level:g} mm", ("finite", "caps", "masing"), scene)


def stick_slip(stage: Stage, level: float) -> Trial:
    """Speed in mm/s of a spring of 100 N/m that drags a ball of 50 g along."""
    speed, step = 1e-3 * level, 1e-3
    lasts = min(0.02 / speed, 0.8)
    places = keys((0, 0, 0, -1e-4), (0.05, 0, 0, DEEP), (0.1, 0, 0, DEEP), (0.1 + lasts, speed * lasts, 0, DEEP))
    scene = stroke(places, every(places, step))
    spring = Spring(np.array([1.0, 0, 0]), 100.0, 0.05)
    return Trial("", f"{level:g} mm/s", LAWS, replace(scene, spring=spring))


def lift_off(stage: Stage, level: float) -> Trial:
    """Time in s that a tool is off the skin before it presses again; slides, too."""
    out = 0.3 + level
    places = keys((0, 0, 0, -1e-3), (0.1, 0, 0, DEEP), (0.2, 2e-3, 0, DEEP), (0.3, 2e-3, 0, -5e-3), (out, 0, 0, -5e-3),
                  (out + 0.1, 0, 0, DEEP), (out + 0.2, 2e-3, 0, DEEP), (out + 0.3, 2e-3, 0, -5e-3))  # fmt: skip
    near = np.linspace(0, 0.3, 31)
    times = np.concatenate([near, out + near]) if level > 0 else np.concatenate([near, out + near[1:]])
    scene = stroke(places, times)
    if level > 60:  # what fades has faded: the skin is back
        high = np.interp(times, places["time"], places["depth"]) < -1e-5
        return halved(f"{level:g} s", replace(scene, off=high & (times > 0.35)), places, "free")
    return halved(f"{level:g} s", scene, places)


def time_step(stage: Stage, level: float) -> Trial:
    """Time between instants in ms: press, hold, slide, back, lift, in 1.2 s or, of short steps, in 600 of them."""
    places = keys((0, 0, 0, 0), (0.2, 0, 0, DEEP), (0.4, 0, 0, DEEP), (0.7, 6e-3, 0, DEEP), (1.0, 2e-3, 2e-3, DEEP),
                  (1.2, 2e-3, 2e-3, 0))  # fmt: skip
    places["time"] *= min(1.0, 0.6 * level / 1.2)
    return halved(f"{level:g} ms", stroke(places, every(places, 1e-3 * level)), places)


def cut(stage: Stage, level: float) -> Trial:
    """Share of the instants that get lost, of a path told every 5 ms at uneven times."""
    places = keys((0, 0, 0, 0), (0.2, 0, 0, DEEP), (0.6, 5e-3, 3e-3, 0.8 * DEEP), (1.0, 0, 5e-3, DEEP, 0.1, 0, 0.5))
    full = every(places, 5e-3)
    rng = np.random.default_rng(stage.seed)
    full[1:-1] += rng.uniform(-2e-3, 2e-3, len(full) - 2)
    kept = np.sort(np.concatenate([[0, len(full) - 1], 1 + rng.permutation(len(full) - 2)[int(level * len(full)) :]]))
    kept = np.union1d(kept, np.searchsorted(full, places["time"][1:-1]))
    pairs = np.stack([np.arange(len(kept)), kept], axis=1)
    scene, twin = stroke(places, full[kept]), stroke(places, full)
    return Trial("", f"{level:.0%}", (*LAWS, "alike"), scene, Twin(twin, pairs, np.eye(3)))


def spin(stage: Stage, level: float) -> Trial:
    """Turn of a flat punch about its axis in degrees, and back, while it slides by 1 mm."""
    turn = np.radians(level)
    places = keys((0, 0, 0, 0), (0.1, 0, 0, DEEP), (0.4, 5e-4, 0, DEEP, 0, 0, turn), (0.7, 1e-3, 0, DEEP, 0, 0, 0),
                  (0.8, 1e-3, 0, 0, 0, 0, 0))  # fmt: skip
    return halved(f"{level:g}°", stroke(places, every(places, 5e-3), tool=FLAT), places)


def long_gap(stage: Stage, level: float) -> Trial:
    """One step of so many seconds while a tool is pressed in, then a slide and a lift."""
    places = keys((0, 0, 0, 0), (0.1, 0, 0, DEEP), (0.1 + level, 0, 0, DEEP), (0.4 + level, 3e-3, 0, DEEP),
                  (0.5 + level, 3e-3, 0, 0))  # fmt: skip
    near = np.linspace(0, 0.1, 11)
    times = np.concatenate([near, 0.1 + level + np.linspace(0, 0.4, 41)])
    return halved(f"{level:g} s", stroke(places, times), places)


def friction(stage: Stage, level: float) -> Trial:
    """Coefficient of friction: 8 mm along and back, then lifted."""
    places = keys((0, 0, 0, 0), (0.1, 0, 0, DEEP), (0.5, 8e-3, 0, DEEP), (0.9, 0, 0, DEEP), (1.0, 0, 0, 0))
    return halved(f"{level:g}", stroke(places, every(places, 5e-3), friction=level), places)


def fading(stage: Stage, level: float) -> Trial:
    """Time of relaxation in s, of half of the stress: a press in 0.2 s, then held, without friction."""
    tissue = Tissue(2e4, relaxation=Prony((0.5,), (level,)))
    places = keys((0, 0, 0, 1e-4), (0.2, 0, 0, DEEP), (0.5, 0, 0, DEEP))
    times = every(places, 0.01)
    scene = stroke(places, times, tissue, 0.0)
    elastic = replace(scene, mesh=skin(ELASTIC))
    pairs = np.stack([np.arange(len(times))] * 2, axis=1)
    return Trial("", f"{level:g} s", ("finite", "gives", "between"), scene, Twin(elastic, pairs, np.eye(3)))


def closed_path(stage: Stage, level: float) -> Trial:
    """Number of a random path from the air and back: press, slide, tilt, spin, lift, with any tissue and friction."""
    rng = np.random.default_rng([stage.seed, int(level)])
    tissue, mu = (ELASTIC, FADING, STACK)[int(level) % 3], (0.0, 0.1, 0.5, 1.5)[int(level) // 3 % 4]
    tool = (BALL, FLAT)[int(level) // 6 % 2]
    most = np.array([0.01, 0.01, 0.4 * THICKNESS, 0.2, 0.2, 1.0])
    places = rng.uniform([-1, -1, -0.3, -1, -1, -1], 1, (5, 6)) * most
    places = np.vstack([np.zeros(6), places, np.zeros(6)])
    places[[0, -1], 2] = -2e-4
    lasts = 10 ** rng.uniform(-2, 1)
    told = keys(*((k * lasts / 6, *place) for k, place in enumerate(places)))
    steps = np.linalg.norm(np.diff(places, axis=0) * [1, 1, 1, 0.01, 0.01, 0.01], axis=1).max() / 2e-4
    scene = stroke(told, every(told, lasts / (6 * np.ceil(steps))), tissue, mu, tool)
    kind = {id(ELASTIC): "elastic", id(FADING): "relaxing", id(STACK): "stack"}[id(tissue)]
    return Trial("", f"{int(level)}: {tool.name}, {kind}, {mu:g}", LAWS, scene)


def on_a_limb(stage: Stage, level: float) -> Trial:
    """Angle in degrees by which a ball is led round a limb of 40 mm radius, and back along it."""
    mesh = limb(stage.tool_edge, 0.04, 0.16, THICKNESS)
    angle = np.radians(level)
    places = np.array([(0, 0, 0), (0, DEEP, 0), (angle, DEEP, 0), (angle, DEEP, 0.01), (0, DEEP, 0.01), (0, 0, 0.01)])
    s = np.linspace(0, len(places) - 1, 301)
    a, depth, z = (np.interp(s, np.arange(len(places)), places[:, x]) for x in range(3))
    poses = np.tile(np.eye(4), (len(s), 1, 1))
    away = 0.04 + RADIUS - depth
    poses[:, :3, 3] = np.stack([away * np.cos(a), away * np.sin(a), 0.075 + z], axis=1)
    scene = Strokes(replace(mesh, tissue=FADING), BALL, poses, STEP * np.arange(len(s)), MU)
    return Trial("", f"{level:g}°", LAWS, scene)


def grip_on_a_limb(stage: Stage, level: float) -> Trial:
    """Coefficient of friction: a ball is pressed in and led by half a turn round a limb of 40 mm radius."""
    mesh = limb(stage.tool_edge, 0.04, 0.16, THICKNESS)
    depth = DEEP * np.minimum(np.arange(221) / 20, 1)
    angle = np.pi * np.maximum(np.arange(221) - 20, 0) / 200
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    away = 0.04 + RADIUS - depth
    poses[:, :3, 3] = np.stack([away * np.cos(angle), away * np.sin(angle), 0.08 + 0 * angle], axis=1)
    scene = Strokes(replace(mesh, tissue=ELASTIC), BALL, poses, STEP * np.arange(len(angle)), level)
    return Trial("", f"{level:g}", (*LAWS, "ends"), scene)


def noise(stage: Stage, level: float) -> Trial:
    """Noise of the pose in micrometres, at 100 Hz for 3 s, of a tool that was dragged and is held."""
    places = keys((0, 0, 0, 0), (0.1, 0, 0, DEEP), (0.2, 3e-4, 0, DEEP), (3.2, 3e-4, 0, DEEP))
    scene = stroke(places, every(places, STEP))
    shaken = scene.poses.copy()
    shaken[21:-1, :3, 3] += 1e-6 * level * np.random.default_rng(stage.seed).normal(size=(len(shaken) - 22, 3))
    return Trial("", f"{level:g} um", (*LAWS, "lasts"), replace(scene, poses=shaken), _at_last(scene, scene))


def rocking(stage: Stage, level: float) -> Trial:
    """Way in mm by which a tool that was dragged and sticks rolls to either side, eight times; and up and down."""
    way = 1e-3 * level
    once = [(way, way / RADIUS), (0, 0), (-way, -way / RADIUS), (0, 0)]
    start = [(0, 0, 0, 0), (0.1, 0, 0, DEEP), (0.2, 3e-4, 0, DEEP)]

    def rocked(times: int) -> Strokes:
        moves: list[tuple[float, ...]] = []
        for k, (x, turn) in enumerate(once * times):
            moves.append((0.25 + 0.05 * k, 3e-4 + x, 0, DEEP * (1 - 0.2 * (k % 2)), 0, turn, 0))
        moves.append((moves[-1][0] + 0.05, 3e-4, 0, DEEP))
        places = keys(*start, *moves)
        return stroke(places, every(places, STEP), ELASTIC, 1.0)

    scene = rocked(8)
    return Trial("", f"{level:g} mm", (*LAWS, "lasts"), scene, _at_last(scene, rocked(1)))


def tilting_path(stage: Stage, level: float) -> Trial:
    """Number of a random smooth loop over a forearm as measured, elastic: it presses, slides and tilts, and lifts.

    Five tools in turn, then to 0.5 and 0.85 of the thickness, then without friction, at mu 0.3 and at 0.001.
    """
    rng, number = np.random.default_rng([stage.seed, int(level)]), int(level)
    mesh, (tool, half) = part("left_forearm"), TILTED[number % 5]
    layer, top, mu = mesh.layer, LOOPS[number // 5 % 2], RUBBED[number // 10 % 3]
    near = np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argsort()
    v = int(rng.choice(near[: len(near) // 4]))
    out, phase = layer.normals[v], np.linspace(0, 2 * np.pi, 241)
    upright = Rotation.align_vectors([out], [[0.0, 0.0, 1.0]])[0]
    gone = rng.normal(size=(6, 2)) @ np.stack([np.sin(phase), 1 - np.cos(phase)])
    turns = upright * Rotation.from_euler("xyz", 5 * gone[3:].T, degrees=True)
    high = half + OFF - (top * layer.thickness[v] + OFF) * np.sin(phase / 2) ** 2
    poses = np.tile(np.eye(4), (len(phase), 1, 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = layer.vertices[v] + upright.apply(np.stack([*(2e-3 * gone[:2]), high], axis=1))
    scene = Strokes(mesh, tool, poses, STEP * np.arange(len(phase)), mu)
    return Trial("", f"{number}: {tool.name}, {top:g} t, {mu:g}", ("finite", "gives"), scene)


def _at_last(scene: Strokes, twin: Strokes) -> Twin:
    """A path that ends as another does."""
    return Twin(twin, np.array([[len(scene.times) - 1, len(twin.times) - 1]]), np.eye(3))


STROKE_AXES: dict[str, Callable[[Stage, float], Trial]] = {
    "time step": time_step, "lost steps": cut, "long gap": long_gap, "time of relaxation": fading, "friction": friction,
    "reversal": reversal, "spin": spin, "stick-slip": stick_slip, "lift-off": lift_off, "round a limb": on_a_limb,
    "friction round a limb": grip_on_a_limb, "noise of a pose": noise, "rocking": rocking, "closed path": closed_path,
    "tilting path": tilting_path,
}  # fmt: skip
STROKE_LEVELS: dict[str, Sequence[float]] = {
    "time step": (0.1, 0.5, 2, 5, 10, 20, 50),
    "lost steps": (0.1, 0.3, 0.5, 0.8),
    "long gap": (0.1, 10, 1e3, 1e6, 1e9),
    "time of relaxation": (1e4, 100, 1, 0.1, 1e-2, 1e-4, 1e-9),
    "friction": (0.05, 0.1, 0.3, 0.5, 1.0, 1.5),
    "reversal": (0.01, 0.1, 0.5, 2, 10),
    "spin": (2, 15, 90, 360),
    "stick-slip": (10, 40, 150, 600),
    "lift-off": (0, 0.05, 1, 100, 1e6),
    "round a limb": (2, 10, 45),
    "friction round a limb": (0.3, 0.6, 0.8, 1.0, 1.2, 3.0),
    "noise of a pose": (1, 3, 10),
    "rocking": (0.1, 0.2, 0.4),
    "closed path": tuple(range(24)),
    "tilting path": tuple(range(60)),
}
QUICK_STROKES: dict[str, Sequence[float]] = {
    "time step": (10,), "lost steps": (0.3,), "long gap": (10,), "time of relaxation": (0.1,), "friction": (0.5,),
    "reversal": (0.5,), "spin": (15,), "stick-slip": (100,), "lift-off": (100,), "round a limb": (10,),
    "friction round a limb": (0.8,), "noise of a pose": (3,), "rocking": (0.3,), "closed path": (7,),
    "tilting path": (6,),
}  # fmt: skip
