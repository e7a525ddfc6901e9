"""Stack: the linear response of bonded materials under a skin, in closed form, and the single layer nearest to it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, least_squares
from scipy.special import j0

from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Membrane, Tissue

RADII = (2e-3, 4e-3, 9e-3, 19e-3, 40e-3)  # radii of loads that one effective layer shall serve [m]
THINNEST, THICKEST = 0.02, 4.0  # bounds of the effective layer's thickness, over that of the stack
FLIP = np.array([[1.0, -1.0], [-1.0, 1.0]])  # signs of a 2 x 2 stiffness in a mirror


class Compliance(NamedTuple):
    """What a pressure cos(k x) does to the surface: it sinks by A cos(k x) and moves along by B sin(k x).

    Args:
        sinking: A, (K,) [t/E].
        along: B, (K,), positive away from the crest of the pressure [t/E].
    """

    sinking: np.ndarray
    along: np.ndarray


class Along(NamedTuple):
    """What a traction cos(k x) along the surface does to it: a motion along the traction, times cos(k x).

    Args:
        lengthwise: motion where the traction points along x, as the wave does, (K,) [t/E].
        crosswise: motion where it points across, (K,) [t/E].
    """

    lengthwise: np.ndarray
    crosswise: np.ndarray


class Misfit(NamedTuple):
    """How far a simpler model is from a stack, the largest over loads.

    Args:
        force: difference of the force at the same depth, over the force of the stack [-].
        motion: difference of the motion at the same depth [-]: root of the mean square over the surface, over that of
            the sinking.
    """

    force: float
    motion: float


ENOUGH = Misfit(force=0.10, motion=0.10)  # with which a simpler model will do


class Effective(NamedTuple):
    """The single layer under the same skin that answers most like a stack, with the first material's nu.

    Args:
        youngs_modulus: modulus of the layer [Pa].
        thickness: thickness of the layer [m].
        kappa: E_s h / (E t) with this modulus and thickness [-]; 0 without a skin.
        pull: T / (E t), likewise [-].
        misfit: what it misses.
        bare: what the best single layer without a skin misses.
    """

    youngs_modulus: float
    thickness: float
    kappa: float
    pull: float
    misfit: Misfit
    bare: Misfit


class Need(NamedTuple):
    """The simplest model that will do.

    Args:
        rung: 0: one layer; 1: a skin on one layer; 2: every material as its own layer.
        why: sentence with the numbers that decide.
    """

    rung: int
    why: str


def plies(tissue: Tissue, thickness: float) -> list[tuple[float, float, float]]:
    """Thickness [m], E [Pa] and nu [-] of each material of a tissue that is `thickness` [m] thick, from the skin on.

    Raises:
        InvalidInput: a thickness that is not above 0.
    """
    if not (np.isfinite(thickness) and thickness > 0):
        raise InvalidInput(f"thickness is {thickness:g} m; it must be finite and above 0.")
    there = [ply for ply in tissue.deeper if ply.depth < thickness]
    depths = [0.0, *(ply.depth for ply in there), thickness]
    moduli = [(tissue.youngs_modulus, tissue.poisson_ratio), *((p.youngs_modulus, p.poisson_ratio) for p in there)]
    return [(b - a, *both) for a, b, both in zip(depths, depths[1:], moduli, strict=False)]


def compliance(tissue: Tissue, thickness: float, k: ArrayLike) -> Compliance:
    """Linear response of a flat stack on a rigid base, per wave number.

    E is that of the first material and t the whole thickness. Each material is a stiffness between its faces (static
    limit of Kausel & Roësset, Bull. Seismol. Soc. Am. 71, 1743-1761, 1981). With q = k h / 2, s = sinh q, c = cosh q,
    what stretches it evenly meets K_s, what bends it K_a, for motions (along, inwards) of its upper face:

        K_s = 2 mu k / ((3 - 4 nu) s c - q) [[2 (1 - nu) s^2, (1 - 2 nu) s c - q], [., 2 (1 - nu) c^2]]
        K_a = 2 mu k / ((3 - 4 nu) s c + q) [[2 (1 - nu) c^2, (1 - 2 nu) s c + q], [., 2 (1 - nu) s^2]]

    From the base upwards, S <- P - N (P' + S)^-1 N^T, where P = (K_s + K_a) / 2 joins motion and traction of one
    face, P' is its mirror image and N the part between the faces. The skin adds E_s h k^2 / (1 - nu_s^2) along and
    T k^2 inwards.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness t from the surface to the base [m], > 0.
        k: wave numbers, (K,) [1/t], > 0.

    Raises:
        InvalidInput: a thickness or a wave number that is not above 0.
    """
    k = _wave_numbers(k)
    unit = thickness / tissue.youngs_modulus
    return Compliance(*(each / unit for each in _in_si(plies(tissue, thickness), tissue.skin, k / thickness)))


def along(tissue: Tissue, thickness: float, k: ArrayLike) -> Along:
    """How far the surface of a flat stack moves along under a traction cos(k x) that pulls along it.

    Where the traction points along x, it is what `compliance` inverts; where it points across, each material is
    sheared as mu k [[coth k h, -1 / sinh k h], [., coth k h]], and the skin adds E_s h k^2 / (2 (1 + nu_s)).

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness t from the surface to the base [m], > 0.
        k: wave numbers, (K,) [1/t], > 0.

    Raises:
        InvalidInput: a thickness or a wave number that is not above 0.
    """
    k = _wave_numbers(k) / thickness
    stack, skin, unit = plies(tissue, thickness), tissue.skin, thickness / tissue.youngs_modulus
    stiffness, across = _surface(stack, skin, k), np.full(len(k), np.inf)
    for h, modulus, nu in reversed(stack):
        shear, far = modulus / (2 * (1 + nu)) * k, np.exp(-k * h)
        own, between = shear * (1 + far * far) / -np.expm1(-2 * k * h), 2 * shear * far / -np.expm1(-2 * k * h)
        across = own - between**2 / (own + across)
    if skin:
        across = across + skin.stiffness / (2 * (1 + skin.poisson_ratio)) * k * k
    xx, xz, zz = stiffness[:, 0, 0], stiffness[:, 0, 1], stiffness[:, 1, 1]
    return Along(zz / (xx * zz - xz * xz) / unit, 1 / across / unit)


def _wave_numbers(k: ArrayLike) -> np.ndarray:
    k = np.atleast_1d(np.asarray(k, dtype=float))
    if not (np.isfinite(k) & (k > 0)).all():
        raise InvalidInput(f"the smallest wave number is {k.min():g} / t; all must be finite and above 0.")
    return k


def _in_si(stack: list[tuple[float, float, float]], skin: Membrane | None, k: np.ndarray) -> np.ndarray:
    """A and B of plies under a skin, (2, K) [m/Pa], at wave numbers k [1/m]; see `compliance`."""
    (xx, xz), (_, zz) = _surface(stack, skin, k).transpose(1, 2, 0)
    return np.array([xx, -xz]) / (xx * zz - xz * xz)


def _surface(stack: list[tuple[float, float, float]], skin: Membrane | None, k: np.ndarray) -> np.ndarray:
    """Stiffness of the surface of plies under a skin, (K, 2, 2) [Pa/m], to motions along and inwards."""
    stiffness, *above = (_between_faces(*ply, k) for ply in reversed(stack))
    stiffness = stiffness[0]
    for face, between in above:
        stiffness = face - between @ np.linalg.solve(FLIP * face + stiffness, between.transpose(0, 2, 1))
    if skin:
        added = np.array([[skin.stiffness / (1 - skin.poisson_ratio**2), 0.0], [0.0, skin.tension]])
        stiffness = stiffness + added * (k * k)[:, None, None]
    return stiffness


def _between_faces(h: float, modulus: float, nu: float, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P and N of `compliance`, each (K, 2, 2) [Pa/m]; all is divided by exp(k h), so that nothing overflows."""
    e = np.exp(-k * h)
    q, sc = 0.5 * k * h * e, -0.25 * np.expm1(-2 * k * h)
    ss, cc = 0.25 * np.expm1(-k * h) ** 2, 0.25 * (1 + e) ** 2
    scale, twice, less = modulus / (1 + nu) * k, 2 * (1 - nu), (1 - 2 * nu) * sc
    stretch = scale / ((3 - 4 * nu) * sc - q) * np.array([[twice * ss, less - q], [less - q, twice * cc]])
    bend = scale / ((3 - 4 * nu) * sc + q) * np.array([[twice * cc, less + q], [less + q, twice * ss]])
    between = 0.5 * (stretch - bend) * np.array([1.0, -1.0])[:, None]
    return (0.5 * (stretch + bend)).transpose(2, 0, 1), between.transpose(2, 0, 1)


def effective(tissue: Tissue, thickness: float, radii: Iterable[float] = RADII) -> Effective:
    """The single layer under the same skin that answers most like the stack, fitted to all loads at once.

    Loads are Gaussians of deviation radius / 2, as wide as an even pressure on a disc. With g = exp(-(k radius)^2 / 8)
    a unit of load sinks by d = int A g^2 k dk in its own mean, and by Parseval's theorem the mean square over the
    surface of a difference of motion is an integral over wave numbers too. Fitted are, over all radii,

        force = d / d' - 1,    motion^2 = int (|A'/d' - A/d|^2 + |B'/d' - B/d|^2) g^2 k dk / int (A/d)^2 g^2 k dk

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radii: radii of the loads [m], > 0.

    Raises:
        InvalidInput: a thickness or a radius that is not above 0.
    """
    stack = plies(tissue, thickness)
    modulus, t, misfit = _nearest(stack, tissue.skin, tissue.skin, radii)
    bare = _nearest(stack, tissue.skin, None, radii)[2] if tissue.skin else misfit
    stiffness, tension = (tissue.skin.stiffness, tissue.skin.tension) if tissue.skin else (0.0, 0.0)
    return Effective(modulus, t, stiffness / (modulus * t), tension / (modulus * t), misfit, bare)


def needs(tissue: Tissue, thickness: float, radii: Iterable[float] = RADII, enough: Misfit = ENOUGH) -> Need:
    """The simplest model that comes near enough to the stack, for loads of these radii.

    What it cannot see asks for rung 2 as well: muscle whose tone changes, fat that is known place by place.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radii: radii of the loads [m], > 0; one of them for one tool.
        enough: misfit that is allowed.

    Raises:
        InvalidInput: a thickness or a radius that is not above 0.
    """
    near = effective(tissue, thickness, radii)
    rungs = [all(is_ <= most for is_, most in zip(off, enough, strict=True)) for off in (near.bare, near.misfit)]
    said = [f"{off.force:.0%} off in force and {off.motion:.0%} in motion" for off in (near.bare, near.misfit, enough)]
    skin = f", one layer under the skin {said[1]}" if tissue.skin else ""
    return Need((*rungs, True).index(True), f"The best single layer is {said[0]}{skin}; allowed is {said[2]}.")


def ball_force(tissue: Tissue, thickness: float, radius: float, depth: float) -> float:
    """Force that holds a ball without friction at a small depth, by the linear response [N].

    The pressure is Hertz's, p0 sqrt(1 - r^2 / a^2), with p0 and a such that middle and edge of the contact lie on the
    paraboloid r^2 / (2 radius): exact on a half-space (Johnson, "Contact Mechanics", 1985, chapter 4), 8 % too stiff
    where the contact is about twice as wide as the layer is thick.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radius: radius of the ball [m], > 0.
        depth: depth of its lowest point below the surface at rest [m], > 0 and small beside radius and thickness.

    Raises:
        InvalidInput: a number that is not above 0, or a depth that the linear response does not reach.
    """
    if not (radius > 0 and depth > 0):
        raise InvalidInput(f"the ball's radius is {radius:g} m, its depth {depth:g} m; both must be above 0.")
    stack = plies(tissue, thickness)
    x = (np.arange(8000) + 0.5) * 0.05  # k a
    load = (np.sin(x) - x * np.cos(x)) / x**3

    def at(a: float) -> tuple[float, float]:
        """Depth [m] and force [N] with a contact of this radius [m]."""
        sunk = _in_si(stack, tissue.skin, x / a)[0] * load * x
        middle, edge = 0.05 * sunk.sum(), 0.05 * (sunk @ j0(x))
        pressure = a * a / (2 * radius) / (middle - edge)
        return pressure * middle, 2 / 3 * np.pi * a * a * pressure

    try:
        a = brentq(lambda a: at(a)[0] - depth, 1e-3 * np.sqrt(radius * depth), 2 * np.sqrt(radius * depth), rtol=1e-6)
    except ValueError:
        raise InvalidInput(f"a ball of {radius * 1e3:g} mm, {depth * 1e3:g} mm deep, is beyond the linear response of "
                           f"{thickness * 1e3:g} mm. Try a smaller depth.") from None  # fmt: skip
    return float(at(a)[1])


def _nearest(stack: list[tuple[float, float, float]], skin: Membrane | None, its_skin: Membrane | None,
             radii: Iterable[float]) -> tuple[float, float, Misfit]:  # fmt: skip
    """E [Pa], t [m] and misfit of the single layer under `its_skin` that answers most like plies under `skin`."""
    each = np.array(list(radii), dtype=float)
    if not (len(each) and (np.isfinite(each) & (each > 0)).all()):
        raise InvalidInput(f"the loads' radii are {each.tolist()} m; all must be finite and above 0.")
    k = np.geomspace(0.02 / each.max(), 8 / each.min(), 120)  # [1/m]
    weight = np.exp(-0.25 * (k * each[:, None]) ** 2) * k * k  # g^2 k dk on a logarithmic grid, (radius, k)

    def at_depth(both: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth under a unit of each load, and motion at a depth of 1, (2, radius, k)."""
        depth = weight @ both[0]
        return depth, both[:, None] / depth[:, None] * np.sqrt(weight)

    depth, motion = at_depth(_in_si(stack, skin, k))
    whole = np.linalg.norm(motion[0], axis=1, keepdims=True)

    def off(logs: np.ndarray) -> np.ndarray:
        """First the logarithm of the force, then the motion, (radius, 1 + 2 * k)."""
        modulus, t = np.exp(logs)
        its, its_motion = at_depth(_in_si([(t, modulus, stack[0][2])], its_skin, k))
        return np.hstack([np.log(depth / its)[:, None], *((its_motion - motion) / whole)])

    t = sum(h for h, _, _ in stack)
    middle = np.exp(np.mean(np.log([modulus for _, modulus, _ in stack])))
    bounds = np.log([[1e-4 * middle, THINNEST * t], [1e4 * middle, THICKEST * t]])
    tries = [least_squares(lambda logs: off(logs).ravel(), np.log([middle, share * t]), bounds=bounds, x_scale=0.3)
             for share in (0.7, 0.2)]  # fmt: skip
    best = min(tries, key=lambda one: one.cost).x
    rest = off(best)
    misfit = Misfit(float(np.abs(np.expm1(rest[:, 0])).max()), float(np.linalg.norm(rest[:, 1:], axis=1).max()))
    return float(np.exp(best[0])), float(np.exp(best[1])), misfit
