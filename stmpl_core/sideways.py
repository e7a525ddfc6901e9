"""Sideways: how stiff skin is to a patch that sticks to a tool and is moved along it, or turned about its normal; and
how far it takes another one along."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from scipy.special import gamma, j0, j1, jv

from stmpl_core.layer import SoftLayer
from stmpl_core.relaxation import RADII as RELAXING_RADII
from stmpl_core.relaxation import borne_by, fading_moduli, relaxations, series_of
from stmpl_core.stack import along
from stmpl_core.tissue import Tissue

WAVES = np.concatenate([np.geomspace(1e-4, 0.05, 60)[:-1], np.arange(0.05, 120, 0.08)])  # k a
WEIGHTS = np.gradient(WAVES)
WHERE = np.linspace(0.05, 0.95, 10)  # places in the patch that move with the tool, over its radius
POWERS = (-0.5, 0.5, 1.5)  # powers of 1 - r^2 / a^2 in the traction: the first alone is exact on a half-space
RADII = np.geomspace(0.02, 8.0, 18)  # radii of the patch that are tabled, over the thickness
THICKNESSES = 5  # thicknesses of a stack that are tabled
HARDER = 1e6  # factor on all of a stack, by which what has softened is never softer than tissues may be
ASIDE_RADII = 7  # radii for which it is reckoned how much of a drag fades; others are between
ROUNDEST = 0.78  # mean distance of a round contact's forces from its middle over its radius; a ball 0.59, a punch 0.76
SPREAD, SPREAD_OVER, UNEVEN, UNEVEN_OVER = 0.42, 0.45, 0.25, 0.1  # see spread_out, by the linear response
EVEN, LEAST_SHORT = 0.25, 1e-3  # mean square of ways along one axis over a^2 of an even disc; least part of a short one
NEAR_RADII = np.geomspace(0.04, 2.5, 8)  # radii of patches beside each other that are tabled, over the thickness
NEAR_WAYS = np.geomspace(0.04, 12.0, 24)  # distances, likewise; beyond the last one they do not feel each other


class Patch(NamedTuple):
    """Stiffness of a round patch of skin that sticks to a tool.

    Args:
        along: tangential force over the way of the tool k_t [N/m].
        turn: torque about the normal over the turn of the tool [N m/rad].
        bare: k_t of the same layer without its skin [N/m].
        slack: force that skin carries when what is just ahead has lost its tension T, 2 pi a T [N].
    """

    along: float
    turn: float
    bare: float
    slack: float

    def secant(self, force: float) -> float:
        """Tangential force over the way of the tool where the tool drags with a force [N], in N/m.

        Skin carries no compression: it wrinkles. The traction around a rigid disc that is drawn along a sheet is even
        (Muskhelishvili, "Some Basic Problems of the Mathematical Theory of Elasticity", 1953, on rigid inclusions), so
        the sheet pushes back with F cos(angle) / (2 pi a) ahead. What is beyond its tension T there, from cos(angle) =
        2 pi a T / F on, is lost: a quarter of what skin carries in the end.
        """
        return secant(self.along, self.bare, self.slack, force)


@numba.njit(cache=True, error_model="numpy")
def secant(along, bare, slack, force):
    """See Patch.secant, and Patch for the arguments."""
    carried = force * (1 - bare / along)
    if not carried > slack:
        return along
    angle = np.arccos(slack / carried)
    lost = (angle - np.sin(angle) * slack / carried) / (2 * np.pi)
    return along - lost * (along - bare)


def patch(tissue: Tissue, thickness: float, radius: float) -> Patch:
    """Stiffness of a round patch in the linear response of a flat stack, free of traction around it.

    The traction is a sum of (1 - r^2/a^2)^n, n = -1/2, 1/2, 3/2, times r where the patch turns, such that it moves as
    one by least squares. With L, C of `stmpl_core.stack.along` a patch moved along feels (L + C) / 2, averaged over
    directions, one that turns C alone. On a half-space this is k_t = 8 G a / (2 - nu) and 16/3 G a^3 (Johnson, "Contact
    Mechanics", 1985, chapters 3 and 7; Mindlin, J. Appl. Mech. 16, 259, 1949).

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radius: radius a of the patch [m], > 0.
    """
    k = WAVES * thickness / radius
    both = along(tissue, thickness, k)
    unit = thickness / (tissue.youngs_modulus * radius)  # of motion under a traction of one, over the radius
    near = 0.5 * (both.lengthwise + both.crosswise)
    moved = j0(np.outer(WHERE, WAVES)) * (near * WAVES * WEIGHTS)
    sunk = moved @ _spectra(0).T * unit * radius
    found = np.linalg.lstsq(sunk, np.full(len(WHERE), 1.0), rcond=None)[0]
    force = 2 * np.pi * radius**2 * found @ [0.5 / (n + 1) for n in POWERS]
    turned = j1(np.outer(WHERE, WAVES)) * (both.crosswise * WAVES * WEIGHTS) @ _spectra(1).T * unit * radius
    found = np.linalg.lstsq(turned, WHERE * radius, rcond=None)[0]
    torque = 2 * np.pi * radius**3 * found @ [0.5 / ((n + 1) * (n + 2)) for n in POWERS]
    if tissue.skin is None:
        return Patch(float(force), float(torque), float(force), 0.0)
    bare = patch(replace(tissue, skin=None), thickness, radius).along
    return Patch(float(force), float(torque), bare, slack_at(tissue, radius))


@lru_cache(maxsize=64)
def fading_aside(tissue: Tissue, thickness: float) -> np.ndarray:
    """Share of a drag that relaxes in each time of the layer's Series (stmpl_core.relaxation), by the contact's radius.

    As of a force into the skin there, with the stiffness of a patch along the skin (`patch`) in place of the force:
    most of a drag is carried by skin and what is right below, whatever carries the push.

    Returns:
        Shares at the radii of relaxation.RADII, (P, R) [-]; not to be written to.
    """
    each, (least, most, many) = relaxations(tissue, thickness), RELAXING_RADII
    series = series_of(tissue, thickness)
    times = series.times.tolist()
    if tissue.single or not times:
        return np.repeat(series.shares[:, None], many, axis=1)
    fade, logs = fading_moduli(tissue, thickness), np.log(np.geomspace(least, most, many))
    coarse = np.linspace(logs[0], logs[-1], ASIDE_RADII)
    found = np.zeros((len(times), ASIDE_RADII))
    for k, radius in enumerate(np.exp(coarse)):
        borne = borne_by(fade, lambda factors, radius=radius: math.log(
            patch(_softened(tissue, factors), thickness, radius).along))  # fmt: skip
        for one, share in zip(each, borne, strict=True):
            for g, tau in zip(one.shares, one.times, strict=True) if one else ():
                found[times.index(tau), k] += share * g
    return np.array([np.interp(logs, coarse, row) for row in found])


def _softened(tissue: Tissue, factors: np.ndarray) -> Tissue:
    """HARDER times the tissue with factors on its moduli, in the order of relaxation.relaxations, but its tension."""
    first, *others = (HARDER * factors).tolist()
    deeper = tuple(replace(ply, youngs_modulus=ply.youngs_modulus * by)
                   for ply, by in zip(tissue.deeper, others[: len(others) - bool(tissue.skin)], strict=False))
    skin = tissue.skin and replace(tissue.skin, youngs_modulus=tissue.skin.youngs_modulus * others[-1],
                                   tension=tissue.skin.tension * HARDER)  # fmt: skip
    return replace(tissue, youngs_modulus=tissue.youngs_modulus * first, deeper=deeper, skin=skin)


def slack_at(tissue: Tissue, radius: float) -> float:
    """Force that skin carries along itself when what is ahead of a patch of a radius [m] has lost its tension [N]."""
    return 2 * math.pi * radius * tissue.skin.tension if tissue.skin else 0.0


def _spectra(order: int) -> np.ndarray:
    """int_0^1 r^order (1 - r^2)^n J_order(x r) r dr of POWERS, (3, K); Sonine's first integral."""
    return np.array([2**n * gamma(n + 1) * jv(order + n + 1, WAVES) / WAVES ** (n + 1) for n in POWERS])


def beside(tissue: Tissue, thickness: float) -> np.ndarray:
    """How far a flat stack that is pulled along at one place goes along at another.

    With L, C of `stmpl_core.stack.along` a unit force F pulls what is at a distance r from it along by
    int [(L + C) / 2 J_0(k r) F - (L - C) / 2 J_2(k r) (2 r r F - F)] k dk / (2 pi) (Cerruti's solution on a half-space:
    Johnson, "Contact Mechanics", 1985, chapter 3). Patches of a radius a spread a force, and feel a motion, as
    exp(-(k a)^2 / 6) in the mean: what stuck ones do, sin(k a) / (k a), for small k.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness t from the surface to the base [m], > 0.

    Returns:
        Motion over the force, along the line between both places and across it, at the radii of NEAR_RADII and the
        distances of NEAR_WAYS, (R, D, 2) [1 / (E t)], with E the modulus of the first material.
    """
    k = np.concatenate([np.geomspace(1e-4, 0.05, 40)[:-1], np.arange(0.05, 5 / NEAR_RADII[0], 0.05)])
    both, at = along(tissue, thickness, k), np.outer(NEAR_WAYS, k)
    first, second = j0(at), 2 * j1(at) / at - j0(at)
    weights = np.exp(-np.outer(NEAR_RADII**2 / 3, k * k)) * k * np.gradient(k) / (2 * np.pi)
    near = (weights * (both.lengthwise + both.crosswise) / 2) @ first.T
    far = (weights * (both.lengthwise - both.crosswise) / 2) @ second.T
    out = np.stack([near - far, near + far], axis=-1)
    out[:, -1] = 0.0
    return out


@numba.njit(cache=True, error_model="numpy")
def beside_at(table, radius, way, thickness):
    """The two numbers of a table of `beside` at a mean radius, a distance and a thickness [m]."""
    radii, ways = NEAR_RADII, NEAR_WAYS
    f = np.log(radius / thickness / radii[0]) / np.log(radii[1] / radii[0])
    g = np.log(max(way / thickness, 1e-9) / ways[0]) / np.log(ways[1] / ways[0])
    f, g = min(max(f, 0.0), len(radii) - 1.001), min(max(g, 0.0), len(ways) - 1.0)
    i, j = int(f), min(int(g), len(ways) - 2)
    f, g, out = f - i, g - j, np.empty(2)
    for x in range(2):
        out[x] = (1 - f) * ((1 - g) * table[i, j, x] + g * table[i, j + 1, x]) + f * (
            (1 - g) * table[i + 1, j, x] + g * table[i + 1, j + 1, x])  # fmt: skip
    return out[0], out[1]


@numba.njit(cache=True, error_model="numpy")
def spread_out(lever, spread, contact, radius):
    """How much stiffer a contact is along the skin than a round one as large, in the mean over directions; how much
    stiffer across its long axis than along it; that axis, (3,); and by what times the k_t a^2 of a round one it resists
    a turn beyond that.

    Forces far from their middle, of a bar, a ring or a tool that touches at several places, meet fresh skin. Found by
    the linear response of one material and of a stack under pairs and threes of balls, bars of 2 : 1 to 12 : 1,
    capsules and rings.

    Args:
        lever: mean distance of the forces from the middle [m].
        spread: mean products of their ways from it, see footing.wrapped_in, (3, 3) [m2].
        contact: see Memory.
        radius: radius of a circle as large [m].
    """
    first, second = contact[2], np.empty(3)
    a = b = c = 0.0
    for x in range(3):
        y, z = (x + 1) % 3, (x + 2) % 3
        second[x] = contact[1, y] * first[z] - contact[1, z] * first[y]
    for x in range(3):
        for y in range(3):
            a, b = a + first[x] * spread[x, y] * first[y], b + first[x] * spread[x, y] * second[y]
            c += second[x] * spread[x, y] * second[y]
    part, longer, uneven, square = lever / radius - ROUNDEST, 1.0, 1.0, 0.0
    angle, half = 0.5 * np.arctan2(2 * b, a - c), np.hypot(0.5 * (a - c), b)
    long, short = 0.5 * (a + c) + half, max(0.5 * (a + c) - half, LEAST_SHORT * (a + c))
    if part > 0:
        longer += SPREAD * -np.expm1(-part / SPREAD_OVER)
        part = min(part / UNEVEN_OVER, 1.0)
        uneven = (long / short) ** (part * UNEVEN * max(1 - lever * lever / (long + short), 0.0))
        for one, stiff in ((long, np.sqrt(uneven)), (short, 1 / np.sqrt(uneven))):
            square += part * longer * stiff * max(one / (radius * radius) - EVEN, 0.0)
    return longer, uneven, np.cos(angle) * first + np.sin(angle) * second, square


class Sideways:
    """Stiffness of patches of a layer, tabled on the first call (a tenth of a second).

    Args:
        layer: soft layer at rest.
    """

    def __init__(self, layer: SoftLayer) -> None:
        tissue, (least, most) = layer.tissue, (float(layer.thickness.min()), float(layer.thickness.max()))
        many = 1 if tissue.single or most < 1.02 * least else THICKNESSES
        middle = [float(np.median(layer.thickness))]
        self._log_thickness = np.log(np.geomspace(least, most, many) if many > 1 else middle)
        self._logs = np.log(RADII)
        rows = [[patch(tissue, t, t * r) for r in RADII] for t in np.exp(self._log_thickness)]
        radius = np.exp(self._log_thickness)[:, None] * RADII
        units = tissue.youngs_modulus * np.stack([radius, radius**3, radius], axis=-1)
        self._table = np.log(np.array(rows)[..., :3] / units)
        self._modulus, self._slack = tissue.youngs_modulus, slack_at(tissue, 1.0)

    @property
    def numbers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
        """The table, (T, R, 3), of logarithms over T of thickness and R of radius; modulus and slack: see `at`."""
        return self._table, self._log_thickness, self._logs, self._modulus, self._slack

    def at(self, radius: float, thickness: float) -> Patch:
        """Stiffness of a patch of a radius [m] where the layer is this thick [m]."""
        along, turn, bare = interpolated(self._table, self._log_thickness, self._logs, radius, thickness)
        size = self._modulus * radius
        return Patch(along * size, turn * size * radius**2, bare * size, self._slack * radius)


@numba.njit(cache=True, error_model="numpy")
def interpolated(table, log_thickness, log_radius, radius, thickness):
    """The three numbers of a table (thicknesses, radii, 3) at a radius and a thickness [m], between its logarithms."""
    log, j, g = np.log(radius / thickness), 0, 0.0
    f = min(max((log - log_radius[0]) / (log_radius[1] - log_radius[0]), 0.0), len(log_radius) - 1.001)
    i = int(f)
    f -= i
    if len(table) > 1:
        log = np.log(thickness)
        g = min(max((log - log_thickness[0]) / (log_thickness[1] - log_thickness[0]), 0.0), len(table) - 1.001)
        j = int(g)
        g -= j
    out = np.empty(3)
    for x in range(3):
        out[x] = (1 - f) * table[j, i, x] + f * table[j, i + 1, x]
        if g > 0:
            out[x] += g * ((1 - f) * table[j + 1, i, x] + f * table[j + 1, i + 1, x] - out[x])
        out[x] = np.exp(out[x])
    return out[0], out[1], out[2]
