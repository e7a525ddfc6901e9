"""Stiffness: the Young's modulus of a skin from presses on it whose pose and force are both known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import single
from stmpl_core.simulator import Simulator
from stmpl_core.tissue import HARDEST, SOFTEST
from stmpl_core.touch import Touch
from stmpl_core.toucher import MAX_DRAG_RATIO, Toucher
from stmpl_core.trust import Trust

MIN_PRESSES = 6  # presses that a fit needs
LIGHT_PRESS_SHARE = 0.05  # force over the hardest presses', below which a press counts by its absolute error
HUBER_DEVIATIONS = 2.0  # standard deviations from which a press counts less (Huber)
WEIGHTING_ROUNDS = 8  # rounds of weighting
OFFSET_STEPS = 13  # offsets that are tried before the best is refined
OFFSET_TOLERANCE_M = 5e-6  # error of the offset at which the search ends
OFFSET_PENALTY = 2e-3  # relative error of the forces up to which the smaller of two offsets is taken
MAX_RESIDUAL = 0.15  # relative error of the forces that may be left; with more it is no skin of one stiffness
SET_ASIDE = 0.5  # weight below which a press that is off by more than MAX_RESIDUAL counts as set aside
MAX_SET_ASIDE = 0.25  # share of the presses that may be
WRONG_WAY = ("no force points into the skin where the poses touch it: is it what the tool exerts on the body, and are "
             "the poses right, in metres?")  # fmt: skip
DEVIATION = 1.25  # standard deviation of an error over the mean of its size, sqrt(pi / 2)
MAX_RELATIVE_ERROR = 0.2  # standard error of the modulus over it
OFFSET_MARGIN_M = 1e-4  # distance from the ends of the search, within which the offset may as well lie outside


@dataclass(frozen=True)
class Stiffness:
    """Stiffness of a skin, as its presses tell it.

    Args:
        youngs_modulus: E [Pa]; nan where `trust` says that none could be found.
        relative_error: standard error of E over E, scatter and the contact law's own error together, if the thickness
            is right [-]: one that is 20 % too large makes E some 30 % too large, and the forces fit as well.
        offset: distance by which the poses stand too far back along their push [m]; negative: too far in.
        residual: relative error of the forces that is left, root mean square by the presses' weights [-]: those that
            were set aside hardly count, and `trust` says how many they are.
        presses: number of presses that were fitted.
        depths: smallest and largest depth among them, with the offset [m].
        trust: verdict on E: may it be used, and why not.
    """

    youngs_modulus: float
    relative_error: float
    offset: float
    residual: float
    presses: int
    depths: tuple[float, float]
    trust: Trust

    def __str__(self) -> str:
        low, high = (1e3 * depth for depth in self.depths)
        return (f"E = {self.youngs_modulus:.4g} Pa +- {self.relative_error:.0%}, if the thickness is right, from "
                f"{self.presses} presses of {low:.1f} to {high:.1f} mm, poses off by {self.offset * 1e3:+.2f} mm, "
                f"forces off by {self.residual:.1%}")  # fmt: skip


class _Fit(NamedTuple):
    modulus: float  # Young's modulus [Pa]
    errors: np.ndarray  # relative errors of the forces, (N,)
    weights: np.ndarray  # Huber's weights, (N,)
    cost: float  # mean weighted square of the relative errors


def asked(toucher: Toucher | Simulator, contacts: Sequence[Contact]) -> Toucher:
    """The contact law that a fit is asked with. Raises InvalidInput: none, or no contacts."""
    law = toucher.toucher if isinstance(toucher, Simulator) else toucher
    if not isinstance(law, Toucher):
        raise InvalidInput(f"the contact law is {law!r:.40}; a Toucher or a Simulator is needed.")
    if not isinstance(contacts, Sequence) or not all(isinstance(one, Contact) for one in contacts):
        raise InvalidInput(f"contacts are {contacts!r:.40}; a list of Contact, with wrenches, is needed.")
    return law


def fit_stiffness(toucher: Toucher | Simulator, presses: Sequence[Contact]) -> Stiffness:
    """Finds the modulus E with which the contact law explains the measured forces.

    By dimensional analysis the force at a pose is E g, where g does not depend on E. For a given offset s of the poses
    along their push, E is then the weighted least-squares solution of E g_i(s) = f_i, f_i the measured force along the
    modelled one, weighed by relative error and, against outliers, by Huber's weights (Huber 1981, "Robust
    Statistics"). s itself, which hand-eye calibration leaves, is sought within the toucher's reach. Depth and offset
    are told apart only by presses of different depth: what they leave open is in `relative_error`, where the contact
    law's own error counts once for all presses, since it is alike in all of them. A sensor's zero must be right: one
    that is off by 3 % of the largest force makes E 12 % wrong, which looks like an offset and is not in that error.

    Args:
        toucher: contact law on the skin, of whatever stiffness, or a simulator that has it.
        presses: contacts with their wrenches, of tools that pressed one at a time.

    Raises:
        InvalidInput: a press without a wrench, or a layer of several materials: one number does not scale them.
    """
    toucher = asked(toucher, presses)
    single(toucher.layer, "the fit of a stiffness", straight=False, instead="")
    for press in presses:
        if press.wrench is None:
            raise InvalidInput(f"a press of {press.name} has no wrench; stiffness needs the force.")
    pressing = [one for one in presses if one.wrench is not None and one.wrench[:3].any()]
    if len(pressing) < MIN_PRESSES:
        return _nothing(f"{len(pressing)} of {len(presses)} instants pressed with a force; {MIN_PRESSES} are needed. "
                        "Press, at several depths, and ask again")  # fmt: skip
    fit = _Presses(toucher, pressing)
    offset = fit.best_offset()
    touches = fit.touches(offset)
    sound = [fit.sound(press, touch) for press, touch in zip(pressing, touches, strict=True)]
    if sum(sound) < MIN_PRESSES:
        return _nothing(f"{sum(sound)} of {len(pressing)} presses are inside what the contact law was validated on; "
                        f"{MIN_PRESSES} are needed{_most_common(touches, sound)}")  # fmt: skip
    if not all(sound):
        fit = _Presses(toucher, [press for press, kept in zip(pressing, sound, strict=True) if kept])
        offset = fit.best_offset()
        touches = fit.touches(offset)
    return fit.told(offset, touches)


class _Presses:
    """Presses and the law's forces at their poses, shifted along their push."""

    def __init__(self, toucher: Toucher, presses: list[Contact]) -> None:
        self._toucher, self._presses = toucher, presses
        self._forces = np.array([one.wrench[:3] for one in presses if one.wrench is not None])
        sizes = np.linalg.norm(self._forces, axis=1)
        self._pushes = self._forces / sizes[:, None]
        self._weigh_by = np.maximum(sizes, LIGHT_PRESS_SHARE * np.quantile(sizes, 0.9))  # N

    def touches(self, offset: float) -> list[Touch]:
        """Touch of each press by the contact law, by its shifted pose alone."""
        return [self._touch(press, offset * push) for press, push in zip(self._presses, self._pushes, strict=True)]

    def _touch(self, press: Contact, shift: np.ndarray) -> Touch:
        pose = press.pose_body_from_tool.copy()
        pose[:3, 3] += shift
        return self._toucher.touch(Contact(press.tool, pose))

    def best_offset(self) -> float:
        """Offset along the push that explains the forces best [m]."""
        from scipy.optimize import minimize_scalar

        reach = self._toucher.reach
        tried = np.linspace(-reach, reach, OFFSET_STEPS)
        costs = [self._cost(offset) for offset in tried]
        best = int(np.argmin(costs))
        around = tried[max(best - 1, 0)], tried[min(best + 1, OFFSET_STEPS - 1)]
        found = minimize_scalar(self._cost, bounds=around, method="bounded", options={"xatol": OFFSET_TOLERANCE_M})
        return float(found.x) if found.fun <= costs[best] else float(tried[best])

    def _cost(self, offset: float) -> float:
        return self._fit(*self._law(offset)).cost + (OFFSET_PENALTY * offset / self._toucher.reach) ** 2

    def _law(self, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """The law's force over E of each press [m2], and the measured force along it [N], (N,)."""
        modelled = np.array([touch.wrench[:3] for touch in self.touches(offset)])
        sizes = np.linalg.norm(modelled, axis=1)
        ways = np.where(sizes[:, None] > 0, modelled / np.maximum(sizes, 1e-300)[:, None], self._pushes)
        modulus = self._toucher.layer.tissue.youngs_modulus
        return sizes / modulus, (self._forces * ways).sum(axis=1)

    def _fit(self, law: np.ndarray, measured: np.ndarray) -> _Fit:
        """E for given forces over E, by iteratively reweighted least squares."""
        g, f, weights = law / self._weigh_by, measured / self._weigh_by, np.ones(len(law))
        modulus, errors = 0.0, f
        for _ in range(WEIGHTING_ROUNDS):
            modulus = float((weights * g * f).sum() / max((weights * g * g).sum(), 1e-300))
            errors = f - modulus * g
            most = HUBER_DEVIATIONS * max(1.4826 * float(np.median(np.abs(errors))), 1e-6)
            weights = np.minimum(1.0, most / np.maximum(np.abs(errors), 1e-300))
        return _Fit(modulus, errors, weights, float((weights * errors**2).sum() / weights.sum()))

    def sound(self, press: Contact, touch: Touch) -> bool:
        """Whether a press may count: validated, or apart, and not dragging; what drags says little of the normal."""
        size = float(np.linalg.norm(touch.wrench[:3]))
        if not size:
            return True
        assert press.wrench is not None
        normal = touch.wrench[:3] / size * (press.wrench[:3] @ touch.wrench[:3]) / size
        dragging = float(np.linalg.norm(press.wrench[:3] - normal))
        return touch.trust.in_range and dragging <= MAX_DRAG_RATIO * float(np.linalg.norm(normal))

    def told(self, offset: float, touches: list[Touch]) -> Stiffness:
        """Result of the fit, with its trust."""
        law, measured = self._law(offset)
        fit = self._fit(law, measured)
        if not fit.modulus > 0:
            return _nothing(WRONG_WAY)
        depths = [touch.depth for touch in touches if touch.force > 0]
        residual = float(np.sqrt(fit.cost))
        error = self._error(offset, fit, residual)
        trust, reach = Trust(), self._toucher.reach
        if not SOFTEST <= fit.modulus <= HARDEST:
            trust = trust.also(f"no soft layer has {fit.modulus:.4g} Pa, {SOFTEST:g} to {HARDEST:g} Pa are accepted: "
                               "are wrenches in newtons, and poses in metres?", converged=False)  # fmt: skip
        if residual > MAX_RESIDUAL:
            trust = trust.also(f"one stiffness leaves the forces off by {residual:.0%}, at most {MAX_RESIDUAL:.0%} is "
                               "accepted: check frames, wrench and thickness", converged=False)  # fmt: skip
        aside = int(((fit.weights < SET_ASIDE) & (np.abs(fit.errors) > MAX_RESIDUAL)).sum())
        if aside:
            trust = trust.also(f"{aside} of {len(law)} presses do not fit to the stiffness of the others by more than "
                               f"{MAX_RESIDUAL:.0%}: is it another place, another tool, or a force that is not right?",
                               converged=aside <= MAX_SET_ASIDE * len(law))  # fmt: skip
        if abs(offset) > reach - OFFSET_MARGIN_M:
            trust = trust.also(f"the poses are off by {reach * 1e3:g} mm along their push or more: calibrate them",
                               converged=False)  # fmt: skip
        if not error <= MAX_RELATIVE_ERROR:
            span = f"{1e3 * min(depths):.1f} to {1e3 * max(depths):.1f} mm"
            trust = trust.also(f"presses of {span} do not tell the stiffness from an offset of the poses: it is known "
                               f"to {error:.0%}, {MAX_RELATIVE_ERROR:.0%} is needed. Press from a light touch to "
                               "a third of the thickness", converged=False)  # fmt: skip
        return Stiffness(fit.modulus, error, offset, residual, len(law), (min(depths), max(depths)), trust)

    def _error(self, offset: float, fit: _Fit, residual: float) -> float:
        """Standard error of log E with the offset unknown: (J^T J)^-1 of both, J in the weighed forces."""
        step = 5e-5  # m
        reach = self._toucher.reach
        low, high = max(offset - step, -reach), min(offset + step, reach)
        slope = fit.modulus * (self._law(high)[0] - self._law(low)[0]) / (high - low) / self._weigh_by  # 1/m
        size = fit.modulus * self._law(offset)[0] / self._weigh_by
        weigh = np.sqrt(fit.weights)
        j = np.column_stack([weigh * size, weigh * slope * self._toucher.reach])
        normal = j.T @ j / len(j)
        if np.linalg.cond(normal) > 1e12:
            return float("inf")
        spread = float(np.sqrt(np.linalg.inv(normal)[0, 0]))
        own = DEVIATION * float(self._toucher.net.weights.card["bound"]["force_mean"])
        return spread * float(np.hypot(own, residual / np.sqrt(len(j))))


def _nothing(why: str) -> Stiffness:
    nan = float("nan")
    return Stiffness(nan, nan, nan, nan, 0, (nan, nan), Trust(converged=False, why=why))


def _most_common(touches: list[Touch], sound: list[bool]) -> str:
    whys = [touch.trust.why for touch, kept in zip(touches, sound, strict=True) if not kept and touch.trust.why]
    return f", most often because {max(set(whys), key=whys.count)}" if whys else "; the rest drags"
