"""Tissue: what lies between skin and bone. One soft material, or a stack under a skin that is a stretched membrane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stmpl_core.arrays import check_kind, check_number, is_number
from stmpl_core.errors import InvalidInput

DEEPEST = 1.0  # largest depth at which a material begins [m]; that of a depth in millimetres is larger
THICKEST_SKIN = 5e-3  # largest thickness of a skin [m]; that of a skin in millimetres is larger
SOFTEST = 100.0  # smallest Young's modulus of a tissue [Pa]; that of a modulus in kilopascals is smaller
HARDEST = 1e6  # Young's modulus above any soft layer's [Pa]: 8 times that of skin's sheet (stmpl_core.regions)
FRICTION = 0.52  # static, on skin: median of 450 measurements (Veijgen et al., 2013) [-]


@dataclass(frozen=True)
class Prony:
    """How stress fades under a strain that is held: a share 1 - sum g_i (1 - exp(-t / tau_i)) of it is left.

    Moduli are those of a strain too quick for it to fade; the relaxed ones are 1 - sum g_i of them.

    Args:
        shares: g_i of the terms [-], each above 0, their sum below 1.
        times: tau_i of the terms [s], > 0.
        source: where the numbers come from.
    """

    shares: tuple[float, ...]
    times: tuple[float, ...]
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("shares", "times"):
            values = getattr(self, name)
            if not isinstance(values, Iterable) or not all(map(is_number, values := tuple(values))):
                raise InvalidInput(f"the {name} of a Prony series are {values!r:.60}; numbers are needed.")
            object.__setattr__(self, name, tuple(map(float, values)))
        if len(self.shares) != len(self.times) or not self.shares:
            raise InvalidInput(
                f"a Prony series has {len(self.shares)} shares and {len(self.times)} times; it needs as "
                "many of each, and one at least."
            )
        if not all(x > 0 for x in self.shares) or not sum(self.shares) < 1:
            raise InvalidInput(
                f"the shares of a Prony series are {self.shares}; each must be above 0, and their sum below 1."
            )
        if not all(np.isfinite(x) and x > 0 for x in self.times):
            raise InvalidInput(f"the times of a Prony series are {self.times} s; each must be finite and above 0.")

    @property
    def relaxed(self) -> float:
        """Share of a stress that is left at last, 1 - sum g_i [-]."""
        return 1.0 - sum(self.shares)

    def left(self, after: float | np.ndarray) -> np.ndarray:
        """Share of a stress that is left after times that a strain was held [-], in the shape of `after` [s]."""
        fading = np.exp(-np.asarray(after, dtype=np.float64)[..., None] / np.array(self.times))
        return self.relaxed + fading @ np.array(self.shares)


@dataclass(frozen=True)
class Membrane:
    """Skin: a sheet so thin that it only resists stretching, and carries a tension at rest.

    Args:
        youngs_modulus: E_s [Pa], > 0.
        thickness: h [m], > 0.
        tension: T, the same in all directions of the rest state [N/m], >= 0.
        poisson_ratio: nu_s [-], in [0, 0.5]; 0.5: its thickness gives what its area takes.
        source: where the numbers come from.
        relaxation: how its stress fades, but for the tension at rest; None: it is elastic.
    """

    youngs_modulus: float
    thickness: float
    tension: float = 0.0
    poisson_ratio: float = 0.45
    source: str = ""
    relaxation: Prony | None = None

    def __post_init__(self) -> None:
        for name in ("thickness", "tension", "poisson_ratio"):
            check_number(f"the skin's {name}", getattr(self, name))
        check_kind("the skin's relaxation", self.relaxation, (Prony, type(None)))
        _check_moduli(self.youngs_modulus, min(self.poisson_ratio, 0.499))
        if not (np.isfinite(self.thickness) and 0 < self.thickness <= THICKEST_SKIN):
            raise InvalidInput(
                f"the skin is {self.thickness:g} m thick; above 0 and up to {THICKEST_SKIN:g} m is "
                "accepted. Is it in millimetres? Scale it by 1e-3."
            )
        if not (np.isfinite(self.tension) and self.tension >= 0):
            raise InvalidInput(f"the skin's tension is {self.tension:g} N/m; it must be finite and not below 0.")

    @property
    def stiffness(self) -> float:
        """E_s h [N/m]."""
        return self.youngs_modulus * self.thickness


@dataclass(frozen=True)
class Ply:
    """One material of a stack, from a depth on.

    Args:
        depth: where it begins below the surface [m], > 0. Where the tissue is thinner than that, it is not there.
        youngs_modulus: E [Pa], > 0.
        poisson_ratio: nu [-], in [0, 0.5).
        name: what it is.
        source: where the numbers come from.
        relaxation: how its stress fades; None: it is elastic.
    """

    depth: float
    youngs_modulus: float
    poisson_ratio: float = 0.45
    name: str = ""
    source: str = ""
    relaxation: Prony | None = None

    def __post_init__(self) -> None:
        check_number("the depth of a material", self.depth)
        check_kind("the relaxation of a material", self.relaxation, (Prony, type(None)))
        _check_moduli(self.youngs_modulus, self.poisson_ratio)
        if not (np.isfinite(self.depth) and self.depth > 0):
            raise InvalidInput(f"a material begins {self.depth:g} m deep; it must be finite and above 0.")
        if self.depth > DEEPEST:
            raise InvalidInput(f"a material begins {self.depth:g} m deep; at most {DEEPEST:g} m is accepted. "
                               "Is it in millimetres? Scale it by 1e-3.")  # fmt: skip


@dataclass(frozen=True)
class Tissue:
    """What lies between the skin and a rigid core: one soft material, or a stack of them, with or without a skin.

    Every material is compressible Neo-Hookean, psi = mu/2 (I_C - 3) - mu ln J + lambda/2 (ln J)^2 (Bonet & Wood,
    "Nonlinear Continuum Mechanics for Finite Element Analysis", 2nd ed., eq. 6.28). The first, right under the skin,
    gives the unit of all moduli; each that lies deeper reaches from its depth to the next one's, the last to the core.

    Args:
        youngs_modulus: E of the first material [Pa], > 0.
        poisson_ratio: its nu [-], in [0, 0.5).
        density: rho [kg/m3], > 0; quasi-static answers do not depend on it.
        skin: membrane on top; None: the first material reaches to the surface.
        deeper: materials below the first, from the skin inwards.
        source: where the first material's numbers come from.
        relaxation: how the first material's stress fades; None: it is elastic.
    """

    youngs_modulus: float = 1e3
    poisson_ratio: float = 0.4
    density: float = 1e3
    skin: Membrane | None = None
    deeper: tuple[Ply, ...] = ()
    source: str = ""
    relaxation: Prony | None = None

    def __post_init__(self) -> None:
        check_number("density", self.density)
        check_kind("skin", self.skin, (Membrane, type(None)))
        check_kind("relaxation", self.relaxation, (Prony, type(None)))
        check_kind("deeper", self.deeper, (tuple, list))
        for ply in self.deeper:
            check_kind("a deeper material", ply, Ply)
        _check_moduli(self.youngs_modulus, self.poisson_ratio)
        if not (np.isfinite(self.density) and self.density > 0):
            raise InvalidInput(f"density is {self.density} kg/m3; it must be finite and above 0.")
        object.__setattr__(self, "deeper", tuple(self.deeper))
        depths = [ply.depth for ply in self.deeper]
        if any(b <= a for a, b in pairwise(depths)):
            raise InvalidInput(f"the deeper materials begin at {depths} m; each must begin below the one before it.")

    @property
    def shear_modulus(self) -> float:
        """mu = E / (2 (1 + nu)) [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """lambda = E nu / ((1 + nu)(1 - 2 nu)) [Pa]."""
        nu = self.poisson_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def confined_modulus(self) -> float:
        """M = lambda + 2 mu [Pa], the stiffness of a column that cannot bulge."""
        return self.lame_lambda + 2 * self.shear_modulus

    @property
    def numbers(self) -> np.ndarray:
        """All that an answer depends on, in a row; equal for tissues that differ in their sources alone."""
        of = [*self.deeper, *([self.skin] if self.skin else [])]
        names = "youngs_modulus", "poisson_ratio", "depth", "thickness", "tension"
        rows = [[getattr(one, name, 0.0) for name in names] for one in (self, *of)]
        fades = [(*one.relaxation.shares, *one.relaxation.times) if one.relaxation else () for one in (self, *of)]
        return np.array([*np.ravel(rows), *(number for each in fades for number in (*each, -1.0))])

    @property
    def single(self) -> bool:
        """Whether it is one material without a skin; several that are alike are one."""
        first = self.youngs_modulus, self.poisson_ratio, self.relaxation
        return self.skin is None and all(
            (ply.youngs_modulus, ply.poisson_ratio, ply.relaxation) == first for ply in self.deeper
        )

    def relaxing(self, series: Prony) -> Tissue:
        """The same tissue, the stress of all its materials fading by one series."""
        skin = self.skin and replace(self.skin, relaxation=series)
        deeper = tuple(replace(ply, relaxation=series) for ply in self.deeper)
        return replace(self, relaxation=series, skin=skin, deeper=deeper)

    def softened(self, share: float) -> Tissue:
        """The same tissue with a share of all its moduli; the skin's tension stays."""
        skin = self.skin and replace(self.skin, youngs_modulus=share * self.skin.youngs_modulus)
        deeper = tuple(replace(ply, youngs_modulus=share * ply.youngs_modulus) for ply in self.deeper)
        return replace(self, youngs_modulus=share * self.youngs_modulus, skin=skin, deeper=deeper)

    @property
    def relaxes(self) -> bool:
        """Whether the stress of any of its materials fades."""
        return any(one is not None and one.relaxation is not None for one in (self, self.skin, *self.deeper))

    @property
    def stacked(self) -> tuple[float, ...]:
        """The numbers of skin and deeper materials, one after the other: E_s, h, T, nu_s, and depth, E, nu of each."""
        skin = self.skin
        sheet = (skin.youngs_modulus, skin.thickness, skin.tension, skin.poisson_ratio) if skin else (0.0,) * 4
        return sheet + tuple(x for ply in self.deeper for x in (ply.depth, ply.youngs_modulus, ply.poisson_ratio))

    def kappa(self, thickness: float) -> float:
        """E_s h / (E t) [-]: how stiff the skin is beside the material under it; 0 without a skin."""
        return self.skin.stiffness / (self.youngs_modulus * thickness) if self.skin else 0.0

    def pull(self, thickness: float) -> float:
        """T / (E t) [-]: how taut the skin is beside the material under it; 0 without a skin."""
        return self.skin.tension / (self.youngs_modulus * thickness) if self.skin else 0.0


def _check_moduli(youngs_modulus: float, poisson_ratio: float) -> None:
    check_number("poisson_ratio", poisson_ratio)
    if not is_number(youngs_modulus):
        raise InvalidInput(f"youngs_modulus is {youngs_modulus!r:.40}; a number is needed [Pa].")
    if not (np.isfinite(youngs_modulus) and youngs_modulus > 0):
        raise InvalidInput(f"youngs_modulus is {youngs_modulus} Pa; it must be finite and above 0.")
    if youngs_modulus < SOFTEST:
        raise InvalidInput(
            f"youngs_modulus is {youngs_modulus:g} Pa; at least {SOFTEST:g} Pa is accepted. Is "
            "it in kilopascals? Scale it by 1e3."
        )
    if not 0 <= poisson_ratio < 0.5:
        raise InvalidInput(f"poisson_ratio is {poisson_ratio}; allowed is 0 <= nu < 0.5 (try 0.499).")
