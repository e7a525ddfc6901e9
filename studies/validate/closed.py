"""Closed: how stiff skin, fat and muscle are under a rigid disc that is pressed in or pulled along, by closed form."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import gamma, jv

from stmpl_core.errors import InvalidInput
from stmpl_core.stack import along, compliance
from stmpl_core.tissue import Tissue

Way = Literal["pressed in", "pulled along"]

_X = (np.arange(8000) + 0.5) * 0.05  # wave number times the disc's radius


def disc_stiffness(tissue: Tissue, thickness: float, radius: float, way: Way = "pressed in") -> float:
    """Force over way of a rigid disc on a flat stack, for small ways [N/m].

    The traction is the mixture of c (1 - r^2 / a^2)^b, b = -1/2 and 0, and -3/4 where a skin makes the rim bear more,
    that does the most work at a unit way: a stiffness from below (Ritz), exact on a half-space, 2 E a / (1 - nu^2).
    Each has the Hankel transform Gamma(b + 2) 2^(b + 1) J_(b+1)(k a) / (k a)^(b + 1) for a unit of force. Pressed in,
    the disc slides; pulled along it is glued and does not tilt, and the skin's tension takes no part.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness from the surface to the base [m], > 0.
        radius: radius a of the disc [m], > 0.
        way: direction of the force.

    Raises:
        InvalidInput: a thickness or a radius that is not above 0.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise InvalidInput(f"the disc's radius is {radius:g} m; it must be finite and above 0.")
    k, unit = _X * thickness / radius, thickness / tissue.youngs_modulus
    if way == "pressed in":
        rim, yields = tissue.skin is not None and tissue.skin.tension > 0, compliance(tissue, thickness, k).sinking
    else:
        rim, yields = tissue.skin is not None, 0.5 * sum(along(tissue, thickness, k))
    powers = np.array([-0.5, 0.0, *([-0.75] if rim else [])])[:, None] + 1
    waves = gamma(powers + 1) * 2**powers * jv(powers, _X) / _X**powers
    moved = (waves * (yields * _X)) @ waves.T * 0.05 * unit / (2 * np.pi * radius**2)
    return float(np.linalg.solve(moved, np.ones(len(moved))).sum())
