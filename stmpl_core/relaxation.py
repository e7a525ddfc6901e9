"""Relaxation: what time makes of a force, as one convolution over the path, with skin that is replaced as tools slide.

An elastic force F_e(t), relaxing as its moduli do, E(t) = E (1 - sum g_i (1 - exp(-t / tau_i))), is

    F = lambda (S_e - sum g_i D_i),    S_e = F_e / lambda,    dD_i/dt = (S_e - D_i) / tau_i - D_i / a |ds/dt|

with D_i the part that has relaxed, and lambda = 1 - d / t the stretch of the column under a tool d deep in a layer t
thick. Without the last term the bracket is the convolution int G(t - s) dS_e(s) of quasi-linear viscoelasticity (Fung,
"Biomechanics", 1993, chapter 7), one number in place of a field. At finite strain it is the second Piola-Kirchhoff
stress that relaxes, which belongs to the rest state: what a deep press has made relax pulls lambda times as hard, so
harder once the tool goes back. Against finite elements that halves what misses while a tool lifts. The last term is
fresh skin: a contact of radius a that goes ds over the skin leaves what has relaxed behind. Against a ball on relaxing
columns that starts to slide, each with a history of its own, it is within 6 % of the force at any speed, 4.5 % in
steady slide.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.stack import plies, response
from stmpl_core.tissue import Membrane, Prony, Tissue

MIX_RADIUS = 9e-3  # radius of the load for which the materials of a stack share a force [m]
WIDER = 1.8  # radius of such a load over that of a contact: finite elements of balls on a back, 2 to 8 mm deep
RADII = 1e-3, 0.1, 25  # of contacts, from the least to the most, for which it is known how much fades [m]
LOG_STEP = 0.05  # change of a modulus by which its share is found, logarithm
LEAST_LEFT = 1e-6  # share of a modulus that is left at least
LEAST_STRETCH = 0.15  # of a column, to which it counts as pressed together
DEPTH_TRIALS = 12  # of Newton for the depth of skin that is free
HALVINGS = 30  # of a step in which skin comes free
SWEEPS = 30  # of rotations, at most; five or so are needed


class Series(NamedTuple):
    """Relaxation of the force on a layer.

    Args:
        shares: share of the force that relaxes in each time, (P,) [-].
        times: those times, (P,) [s].
    """

    shares: np.ndarray
    times: np.ndarray

    def balance(self, kept: np.ndarray, gain: np.ndarray) -> tuple[float, float]:
        """Numbers a and b such that an elastic force F_e is b F_e - a after a step; kept, gain: see `weights`, (P,)."""
        return float(self.shares @ kept), 1 - float(self.shares @ gain)


def series_of(tissue: Tissue, thickness: float) -> Series:
    """Relaxation of a force on a flat stack: each material's own times its share in the force.

    The shares are those of the linear response under a Gaussian load of MIX_RADIUS (`stmpl_core.stack.effective`), such
    that in the end as much has faded as the force on relaxed moduli is less. The skin's tension does not relax.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
    """
    each = relaxations(tissue, thickness)
    if not any(each):
        return Series(np.empty(0), np.empty(0))
    found: dict[float, float] = {}
    for prony, share in zip(each, _shares(tissue, thickness), strict=True):
        for g, tau in zip(prony.shares, prony.times, strict=True) if prony else ():
            found[tau] = found.get(tau, 0.0) + share * g
    times = sorted(found)
    return Series(np.array([found[tau] for tau in times]), np.array(times))


def fading(tissue: Tissue, thickness: float) -> np.ndarray:
    """How much more of a force fades under wide contacts than a Series says, and less under small ones.

    Skin's tension does not relax, and it holds much under a tip and little under a palm.

    Args:
        tissue, thickness: see series_of.

    Returns:
        Logarithms of contacts' radii in metres, rising evenly, and the factors there [-], (2, R); 1 where nothing
        relaxes.
    """
    radii = np.geomspace(*RADII)
    if tissue.single or not tissue.relaxes:
        return np.stack([np.log(radii), np.ones(len(radii))])
    fades = [_fades(tissue, thickness, radius) for radius in (*WIDER * radii, MIX_RADIUS)]
    return np.stack([np.log(radii), np.array(fades[:-1]) / max(fades[-1], 1e-300)])


def relaxations(tissue: Tissue, thickness: float) -> list[Prony | None]:
    """Series of each material of a stack, from the skin inwards, and last of the skin if there is one."""
    if tissue.single:
        return [tissue.relaxation]
    there = [ply for ply in tissue.deeper if ply.depth < thickness]
    skin = [tissue.skin.relaxation] if tissue.skin else []
    return [tissue.relaxation, *(ply.relaxation for ply in there), *skin]


def fading_moduli(tissue: Tissue, thickness: float) -> np.ndarray:
    """Share of each material's modulus that fades in the end, in the order of `relaxations`."""
    return np.array([sum(one.shares) if one else 0.0 for one in relaxations(tissue, thickness)])


def _log_force(tissue: Tissue, thickness: float, radius: float, factors: np.ndarray) -> float:
    """Logarithm of the force under a Gaussian load of a radius [m], with factors on the moduli, as `relaxations`."""
    k, skin = np.geomspace(0.02, 8, 200) / radius, tissue.skin
    weight = np.exp(-0.25 * (k * radius) ** 2) * k * k
    changed = [(h, modulus * by, nu) for (h, modulus, nu), by in zip(plies(tissue, thickness), factors, strict=False)]
    sheet = skin and Membrane(skin.youngs_modulus * factors[-1], skin.thickness, skin.tension, skin.poisson_ratio)
    return -float(np.log(weight @ response(changed, sheet, k)[0]))


def _fades(tissue: Tissue, thickness: float, radius: float) -> float:
    """Share of the force under such a load that is gone once every material has relaxed [-]."""
    return _gone(fading_moduli(tissue, thickness), lambda factors: _log_force(tissue, thickness, radius, factors))


def _gone(fade: np.ndarray, log_force: Callable[[np.ndarray], float]) -> float:
    """Share of a force that is gone in the end [-]; for the arguments see `borne_by`."""
    return 1 - float(np.exp(log_force(np.maximum(1 - fade, LEAST_LEFT)) - log_force(np.ones(len(fade)))))


def _shares(tissue: Tissue, thickness: float) -> list[float]:
    """Share of the force that each material bears, in the order of `relaxations`."""
    if tissue.single:
        return [1.0]
    return list(borne_by(fading_moduli(tissue, thickness),
                         lambda factors: _log_force(tissue, thickness, MIX_RADIUS, factors)))  # fmt: skip


def borne_by(fade: np.ndarray, log_force: Callable[[np.ndarray], float]) -> np.ndarray:
    """Share of a force that each material bears, (M,) [-].

    That is d ln F / d ln E, times a factor by which all together fade as much as the force on relaxed moduli falls: a
    material that softens much bears less and less of it.

    Args:
        fade: share of each modulus that fades in the end, (M,).
        log_force: function that tells the logarithm of the force, by factors on the moduli, (M,).
    """
    steps = np.exp(LOG_STEP * np.eye(len(fade)))
    up, down = ([log_force(one) for one in some] for some in (steps, 1 / steps))
    shares = np.subtract(up, down) / (2 * LOG_STEP)
    first_order = float(shares @ fade)
    return shares * (_gone(fade, log_force) / first_order) if first_order > 0 else shares


@numba.njit(cache=True, error_model="numpy")
def faded(fades, radius):
    """How much more of a force fades under a contact of a radius [m] than a Series says [-]; 1 where there is none.

    Args:
        fades: rows of `fading`: logarithms of radii, evenly, and the factors there, (2, R); more may follow.
        radius: radius of the contact [m]; 0: none.
    """
    if not radius > 0:
        return 1.0
    low, part = _place(fades[0], radius)
    return fades[1, low] + part * (fades[1, low + 1] - fades[1, low])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _place(logs, radius):
    """Number of the row of a table by the logarithms of radii, evenly, and how far to the next one [-]."""
    at = min(max((np.log(radius) - logs[0]) / (logs[1] - logs[0]), 0.0), len(logs) - 1.0)
    low = min(int(at), len(logs) - 2)
    return low, at - low


@numba.njit(cache=True, error_model="numpy")
def shares_aside(fades, radius, terms):
    """Share of a drag that relaxes in each time of a Series under a contact of a radius [m], (P,) [-].

    Args:
        fades: rows of `fading`, and below them those of `sideways.fading_aside`, (2 + P, R).
        radius: radius of the contact [m], > 0.
        terms: P.
    """
    out = np.empty(terms)
    if terms:
        low, part = _place(fades[0], radius)
        for i in range(terms):
            out[i] = fades[2 + i, low] + part * (fades[2 + i, low + 1] - fades[2 + i, low])
    return out


def fades_under(tissue: Tissue, thickness: float, radius: float) -> float:
    """`faded` of one contact of a radius [m] on a stack; see `fading`."""
    return float(faded(fading(tissue, thickness), radius))


@numba.njit(cache=True, error_model="numpy")
def weights(times, dt, gone, before, relaxed, kept, gain):
    """What has relaxed after a step is kept + gain F, with F the elastic force at its end, straight in between.

    The equation of the module, solved exactly. A step without time lets nothing relax.

    Args:
        times: times of the series, (P,) [s].
        dt: time of the step [s].
        gone: way of the contact over the skin in the step, over its radius [-].
        before: elastic force at the beginning of the step.
        relaxed: what had relaxed there, (P,).
        kept, gain: what is found, (P,) each.
    """
    for i in range(len(times)):
        part = dt / times[i]
        x = part + gone
        if not x > 0:
            kept[i], gain[i] = relaxed[i], 0.0
            continue
        left = np.exp(-x)
        mean = -np.expm1(-x) / x if x > 1e-4 else 1 - x / 2 + x * x / 6
        first = 1 - mean if x > 1e-4 else x / 2 - x * x / 6
        last = mean - left if x > 1e-4 else x / 2 - x * x / 3
        kept[i] = left * relaxed[i] + part / x * before * last
        gain[i] = part / x * first


@numba.njit(cache=True, error_model="numpy")
def stretch(depth, thickness):
    """Stretch of the column under a tool of a depth [m] in a layer of a thickness [m], at least LEAST_STRETCH [-]."""
    return max(1 - depth / thickness, LEAST_STRETCH)


@numba.njit(cache=True, error_model="numpy")
def depth_left(share, power, strain):
    """Depth x at which a tool would hold skin that was let go, over the depth of the press [-].

    There x^power / (1 - x strain) = share / (1 - strain).

    Args:
        share: force at rest S_e that is left, over that of the press [-].
        power: power of the depth with which the elastic force grows [-].
        strain: 1 less the stretch at the press [-].
    """
    if not share > 0:
        return 0.0
    x = min((share / (1 - strain)) ** (1 / power), 1.0)  # from above, where it is convex: Newton's method comes down
    for _ in range(DEPTH_TRIALS):
        rise = power * x ** (power - 1) * (1 - strain) + share * strain
        x = max(x - (x**power * (1 - strain) - share * (1 - x * strain)) / rise, 1e-12)
    return min(x, 1.0)


@numba.njit(cache=True, error_model="numpy")
def _diagonal(matrix):
    """Eigenvectors of a small symmetric matrix, which is made diagonal, by Jacobi's rotations: LAPACK's code, which is
    not in the processor's caches where it runs once a step, takes ten times as long to come there.
    """
    many = len(matrix)
    vectors = np.eye(many)
    for _ in range(SWEEPS):
        aside = 0.0
        for i in range(many):
            for j in range(i):
                if abs(matrix[i, j]) > 1e-16 * np.sqrt(abs(matrix[i, i] * matrix[j, j])):
                    angle = 0.5 * np.arctan2(2 * matrix[i, j], matrix[i, i] - matrix[j, j])
                    cosine, sine, aside = np.cos(angle), np.sin(angle), 1.0
                    for k in range(many):
                        one, other = matrix[k, i], matrix[k, j]
                        matrix[k, i], matrix[k, j] = cosine * one + sine * other, cosine * other - sine * one
                    for k in range(many):
                        one, other = matrix[i, k], matrix[j, k]
                        matrix[i, k], matrix[j, k] = cosine * one + sine * other, cosine * other - sine * one
                        one, other = vectors[k, i], vectors[k, j]
                        vectors[k, i], vectors[k, j] = cosine * one + sine * other, cosine * other - sine * one
        if not aside:
            break
    return vectors


@numba.njit(cache=True, error_model="numpy")
def decay_of_free(shares, times, dt):
    """Matrix that takes what has relaxed to what is left of it after a time in which nothing holds the skin, (P, P).

    Free skin has F = 0, so F_e = sum g_i D_i, and dD/dt = (1 g^T - I) D / tau. With D = S x, S = (tau g)^-1/2, the
    matrix is symmetric, so its exponential is that of its eigenvalues.

    Args:
        shares, times: series of the relaxation, (P,) each.
        dt: time [s].
    """
    many = len(times)
    size, rate, out = np.empty(many), np.empty(many), np.zeros((many, many))
    for i in range(many):
        share = max(shares[i], 1e-12)
        size[i], rate[i] = np.sqrt(share * times[i]), np.sqrt(share / times[i])
    for i in range(many):
        for j in range(many):
            out[i, j] = rate[i] * rate[j] - (1 / times[i] if i == j else 0.0)
    vectors = _diagonal(out)
    values = np.diag(out).copy()
    for i in range(many):
        for j in range(many):
            out[i, j] = 0.0
            for k in range(many):
                out[i, j] += vectors[i, k] * np.exp(min(values[k], 0.0) * dt) * vectors[j, k]
            out[i, j] *= size[j] / size[i]
    return out


@numba.njit(cache=True, error_model="numpy")
def let_go(shares, times, dt, gone, part, before, after, relaxed):
    """What has relaxed (P,) after a step in which the skin comes free, and the force at rest where it did.

    It comes free where the tool goes faster than it follows.

    The elastic force that the tool asks for goes straight from `before` to `after` in the first part of the step. Until
    the skin's force is 0 it relaxes under the tool; from there on it comes back by itself. What was free stays free.

    Args:
        shares, times: series of the relaxation, (P,) each.
        dt, gone, before, relaxed: see `weights`.
        part: share of the step in which it does [-].
        after: elastic force that the tool asks for at its end.
    """
    many, found = len(times), relaxed.copy()
    kept, gain, held = np.empty(many), np.empty(many), 0.0
    force, owed = before, 0.0
    for i in range(many):
        owed += shares[i] * relaxed[i]
    if before > owed * (1 + 1e-9) and dt > 0:
        low, high = 0.0, part
        for _ in range(HALVINGS):
            held = 0.5 * (low + high)
            force, owed = before + held / part * (after - before), 0.0
            weights(times, held * dt, held * gone, before, relaxed, kept, gain)
            for i in range(many):
                owed += shares[i] * (kept[i] + gain[i] * force)
            low, high = (held, high) if force > owed else (low, held)
        for i in range(many):
            found[i] = kept[i] + gain[i] * force
    back, out, there = decay_of_free(shares, times, (1 - held) * dt), np.zeros(many), 0.0
    for i in range(many):
        there += shares[i] * found[i]
        for j in range(many):
            out[i] += back[i, j] * found[j]
    return out, there


@numba.njit(cache=True, error_model="numpy")
def left_over(relaxed, power, strain):
    """What skin gives back when it is let go at once, over the energy of elastic skin, of which a share has relaxed.

    The integral of x^power - relaxed (1 - x strain) / (1 - strain) over x, from where that is 0 to 1, times power + 1.
    """
    free = depth_left(min(relaxed, 1.0), power, strain)
    eased = (1 - free - 0.5 * strain * (1 - free * free)) / (1 - strain)
    return max(1 - free ** (power + 1) - (power + 1) * relaxed * eased, 1e-12)
