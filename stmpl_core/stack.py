"""Stack: the linear response of bonded materials under a skin, in closed form, and the single layer nearest to it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import j0, j1, jv

from stmpl_core.arrays import check_number, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.rays import column_pressure
from stmpl_core.tissue import Membrane, Tissue

RADII = (2e-3, 4e-3, 9e-3, 19e-3, 40e-3)  # radii of loads that one effective layer shall serve [m]
THINNEST, THICKEST = 0.02, 4.0  # bounds of the effective layer's thickness, over that of the stack
LEAST_GIVE = 0.95  # its least, over that of a first material which gives as much as the stack under an even stress
STIFFENING = 0.5, 50.0  # moduli over the first material's that the networks know apart, least and most
WHERE = np.linspace(0, 1, 9)  # places in a contact that lie on the ball, over its radius
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


class Fit(NamedTuple):
    """A single layer in place of a stack.

    Args:
        youngs_modulus: modulus of the layer [Pa].
        thickness: thickness of the layer [m].
        misfit: what it misses.
    """

    youngs_modulus: float
    thickness: float
    misfit: Misfit


class Ball(NamedTuple):
    """A ball without friction, pressed in a little: what the linear response says of it.

    Args:
        radius: radius of the ball [m].
        depth: depth of its lowest point below the surface at rest [m].
        force: force that holds it [N].
        contact_radius: radius a of the contact [m].
        pressures: p_n in the pressure, the sum of p_n (1 - r^2 / a^2)^n of n = 0, 1/2, 1, (3,) [Pa].
    """

    radius: float
    depth: float
    force: float
    contact_radius: float
    pressures: np.ndarray

    def spectrum(self, k: np.ndarray) -> np.ndarray:
        """Pressure by wave number, int p J0(k r) r dr, (K,) [N], at k [1/m], (K,), > 0."""
        return self.contact_radius**2 * self.pressures @ _shapes(k * self.contact_radius)


def plies(tissue: Tissue, thickness: float) -> list[tuple[float, float, float]]:
    """Thickness [m], E [Pa] and nu [-] of each material of a tissue that is `thickness` [m] thick, from the skin on.

    Raises:
        InvalidInput: a thickness that is not above 0.
    """
    check_number("the thickness", thickness)
    if not thickness > 0:
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
    k, stack = _wave_numbers(k), plies(tissue, thickness)
    unit = thickness / tissue.youngs_modulus
    return Compliance(*(each / unit for each in response(stack, tissue.skin, k / thickness)))


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
    stack, skin, unit = plies(tissue, thickness), tissue.skin, thickness / tissue.youngs_modulus
    k = _wave_numbers(k) / thickness
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
    k = finite("wave numbers", np.atleast_1d(k), (None,))
    if not (k > 0).all():
        raise InvalidInput(f"the smallest wave number is {k.min():g} / t; all must be above 0.")
    return k


def response(stack: list[tuple[float, float, float]], skin: Membrane | None, k: np.ndarray) -> np.ndarray:
    """A and B of plies under a skin, (2, K) [m/Pa], at wave numbers k [1/m], (K,); see `compliance`."""
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


def hardening(tissue: Tissue, thickness: float, strain: ArrayLike) -> np.ndarray:
    """Logarithm of what a confined column of a stack presses back with, over that of a linear one, (K,) [-].

    Its materials carry the same pressure, each with the strain that this takes. All have the Poisson's ratio that they
    have in the mean of what each gives, h / E: tissue that is not confined makes room, and a column of one that hardly
    does would say that all else is pressed flat.

    Args:
        tissue: materials.
        thickness: thickness of the column [m], > 0.
        strain: depth by which it is pressed together over the thickness, (K,), from 0 to below 1.

    Raises:
        InvalidInput: a thickness that is not above 0.
    """
    pressure, whole = np.geomspace(1e-5, 1e5, 800), np.zeros(800)  # over E
    each = 1 - np.geomspace(1, 1e-4, 400)
    some = plies(tissue, thickness)
    first, gives = some[0][2], sum(h / modulus for h, modulus, _ in some)
    nu = first + sum((each - first) * h / modulus for h, modulus, each in some) / gives  # alike: exactly that
    for h, modulus, _ in some:
        moduli = np.array([0.5 / (1 + nu), nu / ((1 + nu) * (1 - 2 * nu))]) * modulus / tissue.youngs_modulus
        whole += h / thickness * np.interp(pressure, column_pressure(moduli, each), each)
    logs = np.log(pressure / whole) - np.log(pressure[0] / whole[0])
    return np.interp(np.asarray(strain, dtype=float), whole, logs)


def stiffening(tissue: Tissue, thickness: ArrayLike) -> np.ndarray:
    """How much stiffer columns are below their first material: moments over depth of log(E / E of the first), (V, 2).

    The mean, and the mean weighed with 2 z - 1 at the depth z over the thickness: how much of it lies deep. Both are 0
    of one material. What is much softer or stiffer than the first counts as STIFFENING says: no such stack was learnt.

    Args:
        tissue: materials.
        thickness: thickness of each column, (V,) [m], > 0.
    """
    thickness = np.asarray(thickness, dtype=float)
    out = np.zeros((len(thickness), 2))
    for k, ply in enumerate(tissue.deeper):
        end = tissue.deeper[k + 1].depth if k + 1 < len(tissue.deeper) else np.inf
        a, b = np.minimum(ply.depth / thickness, 1), np.minimum(end / thickness, 1)
        more = np.log(np.clip(ply.youngs_modulus / tissue.youngs_modulus, *STIFFENING))
        out += more * np.column_stack([b - a, (b - a) * (a + b - 1)])
    return out


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
    gives = sum(h * min(1.0, stack[0][1] / modulus) for h, modulus, _ in stack)
    modulus, t, misfit = nearest(stack, tissue.skin, tissue.skin, radii, thinnest=LEAST_GIVE * gives)
    bare = nearest(stack, tissue.skin, None, radii).misfit if tissue.skin else misfit
    stiffness, tension = (tissue.skin.stiffness, tissue.skin.tension) if tissue.skin else (0.0, 0.0)
    return Effective(modulus, t, stiffness / (modulus * t), tension / (modulus * t), misfit, bare)


def ball(
    tissue: Tissue, thickness: float, radius: float, *, depth: float | None = None, force: float | None = None
) -> Ball:
    """A ball without friction at a small depth, or under a small force, by the linear response.

    The pressure is a sum of p_n (1 - r^2 / a^2)^n, such that the contact lies on the paraboloid r^2 / (2 radius), by
    least squares: n = 1/2 is exact on a half-space (Hertz), 1 on columns, 0 under a taut skin alone (Johnson, "Contact
    Mechanics", 1985, chapters 4 and 5).

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radius: radius of the ball [m], > 0.
        depth: depth of its lowest point below the surface at rest [m], > 0 and small beside radius and thickness.
        force: force on it instead [N], > 0.

    Raises:
        InvalidInput: a number that is not above 0, not one of depth and force, or one beyond the linear response.
    """
    if (depth is None) == (force is None):
        raise InvalidInput("give the ball's depth or its force, one of them.")
    check_number("the ball's radius", radius)
    check_number("the ball's depth" if force is None else "the force on the ball", depth if force is None else force)
    if not (radius > 0 and (depth or force or 0) > 0):
        asked = f"depth {depth:g} m" if force is None else f"force {force:g} N"
        raise InvalidInput(f"the ball's radius is {radius:g} m, its {asked}; both must be above 0.")
    stack = plies(tissue, thickness)
    taut = tissue.skin is not None and tissue.skin.tension > 0
    x = (np.arange(6000) + 0.5) * 0.05  # k a
    loads = 0.05 * _shapes(x)[0 if taut else 1 :].T * x[:, None]
    at_r = j0(np.outer(WHERE, x))

    def at(a: float) -> Ball:
        """The ball with a contact of this radius [m]."""
        sunk = at_r @ (response(stack, tissue.skin, x / a)[0][:, None] * loads)  # [m/Pa], a row each WHERE
        scale = np.abs(sunk).max()
        *found, depth = np.linalg.lstsq(np.column_stack([sunk / scale, -np.ones(len(WHERE))]),
                                        -0.5 * (a * WHERE) ** 2 / radius, rcond=None)[0]  # fmt: skip
        pressures = np.array([*(() if taut else (0.0,)), *found]) / scale
        return Ball(radius, float(depth), float(np.pi * a * a * pressures @ [1, 2 / 3, 1 / 2]), a, pressures)

    from scipy.optimize import brentq  # a fifth of a second, which every process of a node would wait

    def beyond(a: float) -> float:
        """How far depth [m] or force [N] is from what is asked."""
        return at(a).depth - depth if depth is not None else at(a).force - (force or 0.0)

    usual = np.sqrt(radius * depth) if depth is not None else radius + thickness
    bounds = (1e-2 * usual, 2 * usual) if depth is not None else (1e-5 * usual, 20 * usual)
    try:
        a: Any = brentq(beyond, *bounds, rtol=1e-6)  # type: ignore[arg-type]
    except ValueError:
        asked = f"{depth * 1e3:g} mm deep" if depth is not None else f"under {force:g} N"
        raise InvalidInput(f"a ball of {radius * 1e3:g} mm, {asked}, is beyond the linear response of "
                           f"{thickness * 1e3:g} mm. Try less.") from None  # fmt: skip
    return at(float(a))


def ball_force(tissue: Tissue, thickness: float, radius: float, depth: float) -> float:
    """Force that holds a ball at a small depth [N]; see `ball`."""
    return ball(tissue, thickness, radius, depth=depth).force


def _shapes(x: np.ndarray) -> np.ndarray:
    """int_0^1 (1 - r^2)^n J0(x r) r dr of n = 0, 1/2, 1, at x > 0, (3, K); Sonine's first integral."""
    return np.array([j1(x) / x, (np.sin(x) - x * np.cos(x)) / x**3, 2 * jv(2, x) / x**2])


def nearest(stack: list[tuple[float, float, float]], skin: Membrane | None, its_skin: Membrane | None,
            radii: Iterable[float], thickest: float = np.inf, thinnest: float = 0.0) -> Fit:  # fmt: skip
    """The single layer under `its_skin` that answers most like plies under `skin`; see `effective`.

    It is from `thinnest` to `thickest` [m]: what presses deep wants room, of which a linear response knows nothing.
    """
    each = finite("radii", [*radii] if isinstance(radii, Iterable) else [radii], (None,))
    if not (len(each) and (each > 0).all()):
        raise InvalidInput(f"the loads' radii are {each.tolist()} m; all must be above 0, and there must be one.")
    k = np.geomspace(0.02 / each.max(), 8 / each.min(), 120)  # [1/m]
    weight = np.exp(-0.25 * (k * each[:, None]) ** 2) * k * k  # g^2 k dk on a logarithmic grid, (radius, k)

    def at_depth(both: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth under a unit of each load, and motion at a depth of 1, (2, radius, k)."""
        depth = weight @ both[0]
        return depth, both[:, None] / depth[:, None] * np.sqrt(weight)

    depth, motion = at_depth(response(stack, skin, k))
    whole = np.linalg.norm(motion[0], axis=1, keepdims=True)

    from scipy.optimize import least_squares

    def off(logs: np.ndarray) -> np.ndarray:
        """First the logarithm of the force, then the motion, (radius, 1 + 2 * k)."""
        modulus, t = np.exp(logs)
        its, its_motion = at_depth(response([(t, modulus, stack[0][2])], its_skin, k))
        return np.hstack([np.log(depth / its)[:, None], *((its_motion - motion) / whole)])

    t = sum(h for h, _, _ in stack)
    middle = np.exp(np.mean(np.log([modulus for _, modulus, _ in stack])))
    most = min(THICKEST * t, thickest)
    least = min(max(THINNEST * t, thinnest), 0.8 * most)
    bounds = np.log([[1e-4 * middle, least], [1e4 * middle, most]])
    starts = [np.log([middle, np.clip(share * t, 1.1 * least, 0.9 * most)]) for share in (0.7, 0.2)]
    tries = [least_squares(lambda logs: off(logs).ravel(), one, bounds=bounds, x_scale=0.3) for one in starts]
    best = min(tries, key=lambda one: one.cost).x
    rest = off(best)
    misfit = Misfit(float(np.abs(np.expm1(rest[:, 0])).max()), float(np.linalg.norm(rest[:, 1:], axis=1).max()))
    return Fit(float(np.exp(best[0])), float(np.exp(best[1])), misfit)
