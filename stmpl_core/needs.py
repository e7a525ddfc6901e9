"""Needs: what a scene asks a model of tissue to have, how far off it is without, and the smallest model that serves.

Every figure is of the linear response of the flat stack (`stmpl_core.stack`). At finite depth it says too little of
skin and muscle, too much of tension. One stack (skin, 10 mm of fat, 30 mm of muscle) under a ball of 20 mm, difference
of force without the term in %, linear response | finite elements:

    no skin       at 1, 8, 12 mm   -62, -31, -26 | -66, -43, -41
    no tension    at 1, 8, 16 mm   -61, -27, -17 | -48, -19, -9
    rigid muscle  at 1, 8 mm       +17, +59      | +19, +98
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.optimize import brentq

from stmpl_core.errors import InvalidInput
from stmpl_core.stack import Ball, Fit, Misfit, ball, nearest, plies, response
from stmpl_core.tissue import FRICTION, Tissue

if TYPE_CHECKING:
    from stmpl_core.layer import SoftLayer

TermName = Literal["skin", "tension", "muscle", "time", "slip", "mesh"]

ENOUGH = Misfit(force=0.10, motion=0.10)  # with which a simpler model will do
DEEPEST_OVER_THICKNESS, DEEPEST_OVER_RADIUS = 0.3, 0.5  # depth up to which the linear response is asked [-]
RELAXING = ((0.225, 0.5), (0.225, 5.0))  # share of the modulus that relaxes, and its time [s]: assumed, of one trial
RELAXES = (0.1, 10.0)  # times in which tissue relaxes [s]
LARGEST_RADIUS, LARGEST_FORCE, FASTEST = 0.5, 5e3, 10.0  # of what a robot presses with [m], [N], [m/s]
RUNGS = ("one layer", "a skin membrane on one layer", "a skin membrane on layers of fat and muscle")


@dataclass(frozen=True)
class Indentation:
    """A ball pressed by a force, and how far the linear response follows it.

    Args:
        radius: radius of the ball [m].
        force: force on it [N].
        depth: depth by the linear response [m]; too large where `beyond`.
        beyond: whether that depth is more than 0.3 of the thickness or 0.5 of the radius.
        judged: ball for which terms are judged: this one, or where `beyond` the same at the greatest depth allowed.
    """

    radius: float
    force: float
    depth: float
    beyond: bool
    judged: Ball


@dataclass(frozen=True)
class Term:
    """One part of a model, and what is lost without it: the largest over a scene.

    Args:
        name: skin, tension, muscle (all deeper materials), time, slip or mesh.
        force: difference of the force at the same depth without it, over the force with it [-]; below 0: too soft.
            Of slip: of the tangential force. None: not judged.
        motion: difference of the motion [-]: root of the mean square over the surface, over that of the sinking. Of
            time and slip: over the depth. None: not judged.
        needed: whether the smallest model has it.
        why: sentence with the numbers that decide.
    """

    name: TermName
    force: float | None
    motion: float | None
    needed: bool
    why: str


@dataclass(frozen=True)
class Needs:
    """The smallest model that serves a scene.

    Args:
        rung: 0: one layer; 1: a skin on one layer; 2: skin, and every material as its own layer.
        terms: what may be left out, and what not.
        indentations: every ball under every force.
        layer: the one layer of rungs 0 and 1, fitted to the contacts of this scene; None on rung 2.
        enough: misfit that is allowed.
    """

    rung: int
    terms: tuple[Term, ...]
    indentations: tuple[Indentation, ...]
    layer: Fit | None
    enough: Misfit

    def __getitem__(self, name: TermName) -> Term:
        """The term of this name."""
        return next(term for term in self.terms if term.name == name)

    @property
    def beyond(self) -> bool:
        """Whether a force reaches deeper than the linear response says truly."""
        return any(one.beyond for one in self.indentations)

    @property
    def sentence(self) -> str:
        """The smallest model, in a sentence."""
        what = "every material as its own layer" if self.rung == 2 and not self["skin"].needed else RUNGS[self.rung]
        if self["skin"].needed and not self["tension"].needed:
            what = what.replace("membrane", "membrane without tension")
        more: dict[TermName, str] = {"time": "relaxation in time", "slip": "slip", "mesh": "a finer mesh"}
        also = [said for name, said in more.items() if self[name].needed]
        is_, most = "no single layer is", f"{self.enough.force:.0%} in force and {self.enough.motion:.0%} in motion"
        if self.layer:
            what += f" of {self.layer.youngs_modulus * 1e-3:.2g} kPa and {self.layer.thickness * 1e3:.2g} mm"
            is_ = f"it is {_said(self.layer.misfit)}"
        with_ = f", with {' and '.join(also)}" if also else ""
        return f"The smallest model within {most} is rung {self.rung}, {what}{with_}: {is_}."


def needs(
    of: Tissue | SoftLayer,
    radii: Iterable[float],
    forces: Iterable[float],
    speeds: Iterable[float] = (),
    *,
    thickness: float | None = None,
    drag: float | None = None,
    friction: float = FRICTION,
    edge: float | None = None,
    enough: Misfit = ENOUGH,
) -> Needs:
    """The smallest model that comes near enough to a tissue, for balls of these radii under these forces.

    Skin, tension and muscle are left out one at a time, under one ball at one depth (`stmpl_core.stack.ball`).
    Which rung serves is told by single layers fitted to all contacts at once, as in `stmpl_core.stack.effective`. A
    stack cannot say all: muscle whose tone changes and fat that is known place by place ask for rung 2 as well, and a
    limb is round: at a radius of 2.5 thicknesses flat figures are 10 to 20 % off.

    Time: convolution of the elastic force F_e over a press and a retreat at one speed, F = int G(t - s) dF_e(s), with
    F_e ~ depth^1.5 and G = 1 - sum g (1 - exp(-t / tau)) of RELAXING. Off are the force at the end of the press and the
    depth that is left where the force is 0.

    Slip: a ball with k_t = 8 G a / (2 - nu), a = sqrt(radius depth), G of the layer under the skin, moves sideways by
    3/2 mu F / k_t (1 - (1 - q)^(2/3)), q = drag / mu (Cattaneo and Mindlin; Johnson, "Contact Mechanics", 1985, chapter
    7), and by q mu F / k_t if it sticks. The skin would hold it as well and is left out: motions are upper bounds.

    Mesh: root mean square of what linear triangles with sides of one length miss of a wave, 0.0685 (k edge)^2.

    Args:
        of: tissue, or layer whose tissue, median thickness and edge length are meant.
        radii: radii of the balls [m], > 0; two for a range.
        forces: forces on them [N], > 0; two for a range.
        speeds: speeds of pressing [m/s], > 0; none: time is not judged.
        thickness: thickness from the surface to the bone [m], > 0; of a layer its own unless given.
        drag: tangential force over normal force [-], >= 0; None: slip is not judged.
        friction: coefficient of friction mu [-], > 0.
        edge: length of the mesh's edges [m], > 0; None: of a tissue, the mesh is not judged.
        enough: misfit that is allowed.

    Raises:
        InvalidInput: a number that is not above 0 or not that of a robot's tool, or a tissue without a thickness.
    """
    if not isinstance(of, Tissue):
        thickness = float(np.median(of.thickness)) if thickness is None else thickness
        edge = of.edge_length if edge is None else edge
    tissue = of if isinstance(of, Tissue) else of.tissue
    if thickness is None:
        raise InvalidInput("a tissue wants a thickness: give thickness=, in m.")
    speeds = _checked("speeds", speeds, "m/s", FASTEST)
    for name, one in (("friction", friction), ("edge", edge), *enough._asdict().items()):
        if one is not None and not (np.isfinite(one) and one > 0):
            raise InvalidInput(f"{name} is {one:g}; it must be finite and above 0.")
    if drag is not None and not (np.isfinite(drag) and drag >= 0):
        raise InvalidInput(f"the drag is {drag:g} of the normal force; it must be finite and not below 0.")
    radii, forces = _checked("radii", radii, "m", LARGEST_RADIUS), _checked("forces", forces, "N", LARGEST_FORCE)
    if not (radii and forces):
        raise InvalidInput("give at least one radius and one force.")
    pressed = tuple(_indentation(tissue, thickness, r, f) for r in radii for f in forces)
    stack, skin, contacts = plies(tissue, thickness), tissue.skin, {one.judged.contact_radius for one in pressed}
    slack = replace(skin, tension=0.0) if skin else None
    bare, loose, taut = (nearest(stack, skin, one, sorted(contacts)) for one in (None, slack, skin))
    rung = [_within(bare.misfit, enough), _within(taut.misfit, enough), True].index(True)
    pull = _tension(tissue, thickness, pressed, loose, rung, enough)
    terms = (
        _skin(tissue, thickness, pressed, bare, rung, enough),
        pull,
        _muscle(tissue, thickness, pressed, taut, rung),
        _time(pressed, speeds, enough),
        _slip(pressed, thickness, taut.youngs_modulus, tissue.poisson_ratio, drag, friction, enough),
        _mesh(tissue, thickness, pressed, edge, enough),
    )
    layer = (bare, taut if pull.needed else loose, None)[rung]
    return Needs(rung, terms, pressed, layer, enough)


def _checked(name: str, given: Iterable[float], unit: str, largest: float) -> tuple[float, ...]:
    each = tuple(float(one) for one in given)
    if wrong := [one for one in each if not 0 < one <= largest]:
        raise InvalidInput(f"one of the {name} is {wrong[0]:g} {unit}; above 0 and up to {largest:g} is accepted.")
    return each


def _within(off: Misfit, enough: Misfit) -> bool:
    return off.force <= enough.force and off.motion <= enough.motion


def _indentation(tissue: Tissue, thickness: float, radius: float, force: float) -> Indentation:
    by_force = ball(tissue, thickness, radius, force=force)
    deepest = min(DEEPEST_OVER_THICKNESS * thickness, DEEPEST_OVER_RADIUS * radius)
    beyond = by_force.depth > deepest
    judged = ball(tissue, thickness, radius, depth=deepest) if beyond else by_force
    return Indentation(radius, force, by_force.depth, beyond, judged)


def _off(tissue: Tissue, thickness: float, other: Tissue, its_thickness: float, pressed: Ball) -> Misfit:
    """Force and motion of another stack under the same ball at the same depth; the force below 0: too soft."""
    its = ball(other, its_thickness, pressed.radius, depth=pressed.depth)
    k = np.geomspace(0.01, 60, 400) / pressed.contact_radius
    motion, its_motion = (
        response(plies(one, t), one.skin, k) * at.spectrum(k) * k
        for one, t, at in ((tissue, thickness, pressed), (other, its_thickness, its))
    )  # times k: the mean square over the surface is an integral of k^2 over the logarithm of k
    return Misfit(its.force / pressed.force - 1,
                  float(np.linalg.norm(its_motion - motion) / np.linalg.norm(motion[0])))  # fmt: skip


def _worst(misfits: Iterable[Misfit]) -> Misfit:
    every = list(misfits)
    return Misfit(float(max((one.force for one in every), key=abs)), max(one.motion for one in every))


def _without(tissue: Tissue, thickness: float, other: Tissue, pressed: tuple[Indentation, ...]) -> Misfit:
    return _worst(_off(tissue, thickness, other, thickness, one.judged) for one in pressed)


def _said(off: Misfit) -> str:
    return f"{abs(off.force):.0%} off in force, {off.motion:.0%} in motion"


def _skin(tissue: Tissue, thickness: float, pressed: tuple[Indentation, ...], bare: Fit, rung: int,
          enough: Misfit) -> Term:  # fmt: skip
    if tissue.skin is None:
        return Term("skin", 0.0, 0.0, False, "The tissue has none.")
    off = _without(tissue, thickness, replace(tissue, skin=None), pressed)
    needed = rung == 1 or (rung == 2 and not _within(Misfit(abs(off.force), off.motion), enough))
    return Term("skin", *off, needed, f"One layer fitted without it is {_said(bare.misfit)}.")


def _tension(tissue: Tissue, thickness: float, pressed: tuple[Indentation, ...], loose: Fit, rung: int,
             enough: Misfit) -> Term:  # fmt: skip
    if tissue.skin is None or tissue.skin.tension == 0:
        return Term("tension", 0.0, 0.0, False, "The skin has none.")
    off = _without(tissue, thickness, replace(tissue, skin=replace(tissue.skin, tension=0.0)), pressed)
    needed = rung > 0 and not _within(loose.misfit if rung == 1 else Misfit(abs(off.force), off.motion), enough)
    return Term("tension", *off, needed, f"One layer under a skin, fitted without it, is {_said(loose.misfit)}.")


def _muscle(tissue: Tissue, thickness: float, pressed: tuple[Indentation, ...], near: Fit, rung: int) -> Term:
    if len(plies(tissue, thickness)) == 1:
        return Term("muscle", 0.0, 0.0, False, "The tissue has one material.")
    bare = replace(tissue, deeper=())
    off, top = _without(tissue, thickness, bare, pressed), tissue.deeper[0].depth
    above = [one.judged for one in pressed if one.judged.depth < 0.5 * top]
    rigid = _worst(_off(tissue, thickness, bare, top, one) for one in above) if above else None
    why = f"One layer fitted under the same skin is {_said(near.misfit)}"
    return Term("muscle", *off, rung == 2, f"{why}; rigid muscle: {rigid.force:+.0%} in force." if rigid else f"{why}.")


def relaxed(duration: float) -> Misfit:
    """What an elastic answer misses of a press and a retreat that take this long each [s]; see `needs`.

    Raises:
        InvalidInput: a duration that is not above 0.
    """
    if not (np.isfinite(duration) and duration > 0):
        raise InvalidInput(f"the press takes {duration:g} s; it must be finite and above 0.")
    t = np.linspace(0, 2, 601)  # [duration]
    depth = np.minimum(t, 2 - t)
    since = duration * np.maximum(t[:, None] - 0.5 * (t[1:] + t[:-1]), 0)
    left = 1 - sum(g * -np.expm1(-since / tau) for g, tau in RELAXING)
    force = np.tril(left, -1) @ np.diff(depth**1.5)
    free = int(np.flatnonzero((force <= 0) & (t > 1))[0])
    share = np.interp(0.0, force[[free, free - 1]], depth[[free, free - 1]])
    return Misfit(float(1 / force[300] - 1), float(share))


def _time(pressed: tuple[Indentation, ...], speeds: tuple[float, ...], enough: Misfit) -> Term:
    times = sorted(one.judged.depth / speed for one in pressed for speed in speeds)
    if not times:
        return Term("time", None, None, False, "No speed was given.")
    off = _worst(relaxed(one) for one in times)
    slow = times[0] > RELAXES[1]
    needed = off.motion > enough.motion or (off.force > enough.force and not slow)
    lasts = f"A press lasts {' to '.join(dict.fromkeys(f'{one:.2g}' for one in (times[0], times[-1])))} s"
    if slow and not needed:
        share = 1 - sum(g for g, _ in RELAXING)
        return Term("time", *off, needed, f"{lasts}, more than tissue relaxes in: take {share:.2g} of the moduli.")
    also = f"tissue relaxes in {RELAXES[0]:g} to {RELAXES[1]:g} s, and trials were 15 to 41 % off in force"
    return Term("time", *off, needed, f"{lasts}; {also}.")


def _slip(pressed: tuple[Indentation, ...], thickness: float, modulus: float, nu: float, drag: float | None,
          friction: float, enough: Misfit) -> Term:  # fmt: skip
    judged = [one.judged for one in pressed]
    tangential = [4 * modulus / (1 + nu) * np.sqrt(one.radius * one.depth) / (2 - nu) for one in judged]  # k_t [N/m]
    slides = [friction * one.force / k for one, k in zip(judged, tangential, strict=True)]  # [m]
    most = f"skin goes along by at most {max(slides) * 1e3:.2g} mm"
    number = f"s* = mu F / (k_t t) is {max(slides) / thickness:.2g}: {most}"
    if drag is None:
        return Term("slip", None, None, False, f"No drag was given; {number} before the tool slides.")
    q = min(drag / friction, 1.0)
    further = 1.5 * (1 - (1 - q) ** (2 / 3))  # than mu F / k_t
    force = further / q - 1 if q else 0.0
    motion = max((further - q) * s / one.depth for s, one in zip(slides, judged, strict=True))
    ends = "it slides, and an answer that sticks has no bound" if drag >= friction else \
        f"it is dragged by {q:.0%} of what makes it slide"
    return Term("slip", force, float(motion), force > enough.force or motion > enough.motion, f"{number}; {ends}.")


def _mesh(tissue: Tissue, thickness: float, pressed: tuple[Indentation, ...], edge: float | None,
          enough: Misfit) -> Term:  # fmt: skip
    narrow = min((one.judged for one in pressed), key=lambda one: one.contact_radius)
    k = np.geomspace(0.01, 60, 400) / narrow.contact_radius
    motion = response(plies(tissue, thickness), tissue.skin, k) * narrow.spectrum(k) * k

    def off(length: float) -> float:
        return float(np.linalg.norm(np.minimum(0.0685 * (k * length) ** 2, 1) * motion) / np.linalg.norm(motion[0]))

    least, most = np.log(narrow.contact_radius) + np.array([-7, 7])
    longest: Any = brentq(lambda log: off(np.exp(log)) - min(enough.motion, 0.9), least, most)
    wide = f"the narrowest contact is {narrow.contact_radius * 2e3:.2g} mm wide"
    said = f"Edges up to {np.exp(longest) * 1e3:.2g} mm serve; {wide}"
    if edge is None:
        return Term("mesh", None, None, False, f"No edge was given. {said}.")
    over = f", the edges are {edge / narrow.contact_radius:.2g} of its radius"
    return Term("mesh", None, off(edge), off(edge) > enough.motion, f"{said}{over}. Force does not rest on them.")
