"""The load at which each element and mesh width loses stability, beside the closed form of a pressed bonded layer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.polynomial.legendre import Legendre, leggauss
from scipy.linalg import eigh
from scipy.optimize import brentq

from fem_tools.indenter import IndenterFem
from fem_tools.mesh import WedgeMesh
from fem_tools.newton import NewtonSettings, is_positive_definite, newton
from fem_tools.patch import PatchFem, mirror_projectors
from fem_tools.press import Press
from fem_tools.skin_loads import DeadForces, FollowerPressure
from fem_tools.system import System
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.winkler import column_stretch
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Tissue
from studies.tets import TetSystem, split_wedges

THICKNESS = 7.5e-3  # m
SOFT_EDGE = 3e-3  # m; over which the disc's pressure falls to nothing
DISC_RADIUS = 10e-3  # m
LONGEST_STEP, SHORTEST_STEP = 0.25, 0.015  # p / E
LARGEST_JUMP = 0.3  # thicknesses; an answer further away than this from the last one lies on another branch
DEPTHS = np.arange(1, 9) / 10  # of a tool, in thicknesses

ELEMENTS = ("P1 tets", "P1xP2", "P2xP2")

LoadName = Literal["follower", "dead", "indenter"]
SceneName = Literal["plate", "disc", "ball"]
SCENES: tuple[SceneName, ...] = ("plate", "disc", "ball")
EDGES = (5e-3, 2.6e-3)  # m


@dataclass(frozen=True)
class CriticalLoad:
    """What became of one press.

    Args:
        load: "follower", "dead" or "indenter".
        scene: "plate" (pressed everywhere), "disc" (20 mm wide) or "ball" (a rigid sphere, 24 mm wide).
        element: "P1 tets", "P1xP2" or "P2xP2".
        edge: edge length of the skin's triangles [m].
        ratio: p / E where it ended (of a tool: its largest contact pressure).
        ended: "unstable" (negative curvature), "no solution" (Newton stops, while all before is stable), or "held" (it
            is stable up to the last load that was tried).
    """

    load: LoadName
    scene: SceneName
    element: str
    edge: float
    ratio: float
    ended: Literal["unstable", "no solution", "held"]


def least_stiffness(
    ratio: float, wavelength: float, poisson_ratio: float, load: LoadName, *, degree: int = 16
) -> float:
    """Smallest eigenvalue of the second variation of a uniformly pressed bonded layer; below 0 it is unstable.

    The layer is compressed to F0 = diag(1, 1, s) by p and disturbed by u = (U(z) sin kx, 0, W(z) cos kx), u = 0 at the
    core: int grad u : dP/dF(F0) : grad u dV + [follower] p (volume swept to second order), where dP/dF is that of
    psi = mu/2 (I_C - 3) - mu ln J + lambda/2 (ln J)^2 (Ogden, "Non-Linear Elastic Deformations", ch. 6). Ritz's method
    with polynomials z L_n(z).

    Args:
        ratio: p / E [-].
        wavelength: wavelength over the thickness [-].
        poisson_ratio: [-].
        load: "follower" or "dead".
        degree: number of polynomials for each of U and W; short waves need more.
    """
    tissue = Tissue(poisson_ratio=poisson_ratio)
    modulus, k = tissue.youngs_modulus, 2 * np.pi / wavelength
    mu, lam = tissue.shear_modulus / modulus, tissue.lame_lambda / modulus
    s = float(column_stretch(np.array([ratio * modulus]), tissue)[0])
    cross = mu - lam * np.log(s)
    x, weight = leggauss(degree + 4)
    z, weight = (x + 1) / 2, weight / 2
    basis = [Legendre.basis(n, domain=[0, 1]) for n in range(degree)]
    value = np.stack([z * f(z) for f in basis])
    slope = np.stack([f(z) + z * f.deriv()(z) for f in basis])
    mass, mixed, stiff = (value * weight) @ value.T, (value * weight) @ slope.T, (slope * weight) @ slope.T
    along = mu * (k * k * mass + stiff) + (cross + lam) * k * k * mass
    across = mu * (k * k * mass + stiff) + (cross + lam) * stiff / s**2
    coupling = (lam * mixed - cross * mixed.T) * k / s
    if load == "follower":
        top = np.array([f(1.0) for f in basis])
        coupling += k * ratio * np.outer(top, top)
    form, zero = np.block([[along, coupling], [coupling.T, across]]), np.zeros_like(stiff)
    norm = np.block([[stiff, zero], [zero, stiff]])
    return float(eigh(form, norm, eigvals_only=True, subset_by_index=[0, 0])[0])


def closed_form(
    wavelength: float, poisson_ratio: float = 0.4, load: LoadName = "dead", *, up_to: float = 40.0
) -> float:
    """The first p / E at which a wave of this length (over the thickness) grows; infinite if none up to `up_to`."""
    ratios = np.geomspace(0.2, up_to, 20)
    values = [least_stiffness(r, wavelength, poisson_ratio, load) for r in ratios]
    below = np.flatnonzero(np.array(values) < 0)
    if not len(below):
        return np.inf
    last = int(below[0])
    low, high = ratios[last - 1 : last + 1]
    root: Any = brentq(lambda r: least_stiffness(r, wavelength, poisson_ratio, load), low, high, xtol=1e-4)
    return float(root)


def critical_loads(
    *,
    edges: Sequence[float] = EDGES,
    elements: Sequence[str] = ELEMENTS,
    scenes: Sequence[SceneName] = SCENES,
    largest: float = 3.0,
) -> Iterator[CriticalLoad]:
    """Presses a flat layer (t = 7.5 mm, nu = 0.4) by each load with each element and mesh width, until it fails.

    Args:
        edges: edge lengths of the skin's triangles [m].
        elements: names out of "P1 tets", "P1xP2", "P2xP2".
        scenes: names out of "plate", "disc", "ball"; the ball is pressed in with wedges only.
        largest: p / E at which a press ends that nothing stopped.

    Yields:
        One row a press, as they are done.

    Raises:
        InvalidInput: an element that there is not.
    """
    for scene, load, element, edge in presses(edges, elements, scenes):
        yield _ball(element, edge) if scene == "ball" else _pressed(scene, load, element, edge, largest)


def presses(
    edges: Sequence[float] = EDGES, elements: Sequence[str] = ELEMENTS, scenes: Sequence[SceneName] = SCENES
) -> list[tuple[SceneName, LoadName, str, float]]:
    """What `critical_loads` does in turn: scene, load, element and edge [m] of each press."""
    if unknown := set(elements) - set(ELEMENTS):
        raise InvalidInput(f"unknown elements: {', '.join(unknown)}. Available: {', '.join(ELEMENTS)}.")
    loads: dict[SceneName, tuple[LoadName, ...]] = {scene: ("dead", "follower") for scene in ("plate", "disc")}
    loads["ball"] = ("indenter",)
    return [
        (scene, load, element, edge)
        for edge in edges
        for element in elements
        for scene in scenes
        for load in loads[scene]
        if (scene, element) != ("ball", "P1 tets")
    ]


def _pressed(scene: SceneName, load: LoadName, element: str, edge: float, largest: float) -> CriticalLoad:
    system = _system(scene, load, element, edge)
    settings = NewtonSettings(max_iterations=12)
    ratio, step, u, ended = 0.0, LONGEST_STEP, system.zeros(), "no solution"
    while step >= SHORTEST_STEP:
        if ratio + step > largest + 1e-9:
            return CriticalLoad(load, scene, element, edge, ratio, "held")
        tried = newton(system, u * (1 + step / ratio) if ratio > 0 else u, ratio + step, settings)
        jumped = np.linalg.norm(tried.u - u, axis=-1).max() > LARGEST_JUMP * THICKNESS
        if not tried.converged or jumped:
            step, ended = step / 2, "unstable" if jumped else ended
        elif not is_positive_definite(system, tried.u, ratio + step):
            step, ended = step / 2, "unstable"
        else:
            ratio, u = ratio + step, tried.u
    return CriticalLoad(load, scene, element, edge, ratio + step, ended)  # between here and the last that was stable


def _system(scene: SceneName, load: LoadName, element: str, edge: float) -> System:
    """A flat layer under p = E: all of it between planes of symmetry, or under a disc with its rim held."""
    tissue = Tissue()
    half = 1.5 * THICKNESS if scene == "plate" else DISC_RADIUS + 2.5 * THICKNESS
    outer, triangles = flat_skin(half, edge)
    inner = outer - [0, 0, THICKNESS]
    distance = np.linalg.norm(outer[:, :2], axis=1)
    x = np.clip((DISC_RADIUS - distance) / SOFT_EDGE + 0.5, 0, 1) if scene == "disc" else np.ones(len(outer))
    pressure = tissue.youngs_modulus * x * x * (3 - 2 * x)
    wedges = WedgeMesh.of(outer, inner, triangles, "P2xP2" if element == "P2xP2" else "P1xP2")
    rim, free = wedges.border_columns(), np.zeros(wedges.n_columns, dtype=bool)
    keep = mirror_projectors(wedges) if scene == "plate" else None
    mesh: Any = wedges
    if element == "P1 tets":
        layers = max(1, round(THICKNESS / edge))
        mesh = split_wedges(outer, inner, triangles, layers)
        rim, free = np.tile(rim, layers + 1), np.tile(free, layers + 1)
        keep = None if keep is None else np.tile(keep, (layers + 1, 1, 1))
    forces = DeadForces.of_traction(wedges, pressure[:, None] * [0.0, 0.0, -1.0]).forces
    if load == "dead":
        pressing: Any = DeadForces(np.vstack([forces, np.zeros((mesh.n_columns - len(forces), 3))]))
    else:
        pressing = FollowerPressure(mesh, pressure)
    kind = TetSystem if element == "P1 tets" else System
    return kind(mesh, tissue, [pressing], free if scene == "plate" else rim, keep)


def flat_skin(half: float, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """A square of side 2 `half` [m] in the plane z = 0, facing +z, of right triangles with legs of about `edge` [m]."""
    n = 2 * max(1, round(half / edge)) + 1
    x = np.linspace(-half, half, n)
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    b, c, d = a + n, a + n + 1, a + 1
    even = ((a // n + a % n) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return vertices, np.vstack([first, second])


def _ball(element: Any, edge: float) -> CriticalLoad:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.012)
    field = SignedDistance.of(_tool_mesh(ball))
    pose = np.eye(4)
    pose[2, 3] = 0.03
    vertices, faces = flat_skin(4 * THICKNESS, edge)
    layer = SoftLayer(vertices, faces, THICKNESS)
    solver = IndenterFem(PatchFem(element=element, reach=3, refine=1)).prepare(layer)
    ratio = 0.0
    for answer in solver.path([Press(field, pose, np.array([0.0, 0, -1]))], (DEPTHS * THICKNESS).tolist()):
        if not answer.trust.converged:
            return CriticalLoad("indenter", "ball", element, edge, ratio, "no solution")
        ratio = float(answer.pressure.max()) / layer.tissue.youngs_modulus
        if not answer.trust.figures["positive_definite"]:
            return CriticalLoad("indenter", "ball", element, edge, ratio, "unstable")
    return CriticalLoad("indenter", "ball", element, edge, ratio, "held")


def _tool_mesh(mesh: Any) -> Any:
    from stmpl_core.tool import Tool

    return Tool("ball", mesh.vertices, mesh.faces)


def draw(rows: Sequence[CriticalLoad], path: str | Path, *, poisson_ratio: float = 0.4) -> Path:
    """Draws the closed form over the wavelength, and beside it where each element and mesh width ended.

    Args:
        rows: answer of `critical_loads`.
        path: path of the PNG.
        poisson_ratio: Poisson's ratio of the closed form [-].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.5])
    least = _draw_closed_form(left, poisson_ratio)
    _draw_rows(right, rows, least)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))
    return path


def _draw_closed_form(axes: Any, poisson_ratio: float) -> float:
    wavelengths = np.geomspace(0.4, 6, 16)
    dead = np.array([closed_form(w, poisson_ratio) for w in wavelengths])
    axes.plot(wavelengths, dead, color="tab:red")
    axes.axhline(dead.min(), color="tab:red", lw=0.8, ls="--")
    axes.text(0.42, dead.min() * 0.93, f"{dead.min():.2f} E", color="tab:red", va="top")
    axes.text(0.42, 4.0, "follower pressure:\nno instability up to 40 E", color="tab:blue")
    axes.set(xscale="log", yscale="log", ylim=(0.3, 8), xlabel="wavelength / thickness", ylabel="critical p / E")
    axes.set_title("closed form: a bonded layer, dead load", fontsize=10)
    axes.minorticks_off()
    axes.set_xticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    axes.set_yticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    axes.grid(alpha=0.3)
    return float(dead.min())


def _draw_rows(axes: Any, rows: Sequence[CriticalLoad], least: float) -> None:
    colors = {"dead": "tab:red", "follower": "tab:blue", "indenter": "tab:green"}
    markers = {"unstable": "o", "no solution": "x", "held": "^"}
    names = list(dict.fromkeys((r.scene, r.element, r.edge) for r in sorted(rows, key=_order)))
    for row in rows:
        y = names.index((row.scene, row.element, row.edge)) + {"dead": -0.15, "follower": 0.15}.get(row.load, 0)
        axes.plot(row.ratio, y, markers[row.ended], color=colors[row.load], ms=8, alpha=0.8)
    axes.axvline(least, color="tab:red", lw=0.8, ls="--")
    axes.set_yticks(range(len(names)), [f"{s}, {e}, {h * 1e3:.1f} mm" for s, e, h in names])
    axes.invert_yaxis()
    axes.set(xlim=(0, None), xlabel="largest p / E")
    axes.set_title("finite elements, nu = 0.4, t = 7.5 mm", fontsize=10)
    axes.grid(alpha=0.3)
    for name, color in colors.items():
        axes.plot([], [], "s", color=color, label=name)
    labels = {"unstable": "loses stability", "no solution": "no solution beyond", "held": "stable as far as pressed"}
    for ended, marker in markers.items():
        axes.plot([], [], marker, color="grey", label=labels[ended])
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _order(row: CriticalLoad) -> tuple[int, int, float]:
    return SCENES.index(row.scene), ELEMENTS.index(row.element), -row.edge
