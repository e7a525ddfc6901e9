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
from stmpl_core.friction import Friction, coefficient
from stmpl_core.layer import MAX_THICKNESS, one_thickness
from stmpl_core.regions import HELD_SKIN
from stmpl_core.relaxation import Series, faded, fading, series_of, shares_aside
from stmpl_core.sideways import fading_aside, patch
from stmpl_core.stack import Ball, Fit, Misfit, ball, nearest, plies, response
from stmpl_core.stroke import Missed, Stroke, played, pulled, without_time
from stmpl_core.tissue import FRICTION, HARDEST, SOFTEST, Tissue

if TYPE_CHECKING:
    from stmpl_core.layer import SoftLayer

TermName = Literal["skin", "tension", "muscle", "time", "slip", "mesh"]

ENOUGH = Misfit(force=0.10, motion=0.10)  # with which a simpler model will do
FINEST = 1e-4  # misfit that may be asked for [-]
DEEPEST_OVER_THICKNESS, DEEPEST_OVER_RADIUS = 0.3, 0.5  # depth up to which the linear response is asked [-]
DEEPEST_IN_LAYER = 0.45  # the same over a fitted layer's thickness: at 0.76 and beyond force was 30 to 70 % too large
LARGEST_RADIUS, LARGEST_FORCE, FASTEST = 0.5, 5e3, 10.0  # of what a robot presses with [m], [N], [m/s]
LONGEST_STAY, LONGEST_WAY = 1e6, 10.0  # of a tool at one place [s], and along the skin [m]
STIFFENING = 1.18  # power of 1 / stretch^2 with which people's fat gets stiffer (Hatt et al. 2023)
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
        strain: depth of that over the thickness [-].
    """

    radius: float
    force: float
    depth: float
    beyond: bool
    judged: Ball
    strain: float

    @property
    def stiffer(self) -> float:
        """Shear modulus of people's fat pressed together by that strain, over that at rest [-]; neo-Hookean: 1."""
        return (1 - self.strain) ** (-2 * STIFFENING)


@dataclass(frozen=True)
class Term:
    """One part of a model, and what is lost without it: the largest over a scene.

    Args:
        name: skin, tension, muscle (all deeper materials), time, slip or mesh.
        force: difference of the force at the same depth without it, over the force with it [-]; below 0: too soft.
            Of time: largest over a stroke, over its largest force, above 0: too stiff. Of slip: the force of friction
            over the normal force. None: not judged.
        motion: difference of the motion [-]: root of the mean square over the surface, over that of the sinking. Of
            time: depth of skin that a lifted tool leaves behind, of slip: way of skin that is dragged along, over the
            depth of the tool. None: not judged.
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
        friction: coefficient of friction, or name of its pair, if slip is needed; None: not.
        moduli: share of the moduli that elastic tissue is given: of a scene so slow that it is relaxed; else 1 [-].
    """

    rung: int
    terms: tuple[Term, ...]
    indentations: tuple[Indentation, ...]
    layer: Fit | None
    enough: Misfit
    friction: Friction = None
    moduli: float = 1.0

    def __getitem__(self, name: TermName) -> Term:
        """The term of this name."""
        return next(term for term in self.terms if term.name == name)

    @property
    def relaxing(self) -> bool:
        """Whether the smallest model relaxes."""
        return self["time"].needed

    @property
    def beyond(self) -> bool:
        """Whether a force reaches deeper than the linear response says truly."""
        return any(one.beyond for one in self.indentations)

    @property
    def sentence(self) -> str:
        """The smallest model, in a sentence."""
        what = "every material as its own layer" if self.rung == 2 and not self["skin"].needed else RUNGS[self.rung]
        more: dict[TermName, str] = {"time": "relaxation in time", "slip": "slip", "mesh": "a finer mesh"}
        also = [said for name, said in more.items() if self[name].needed]
        is_, most = "no single layer is", f"{self.enough.force:.0%} in force and {self.enough.motion:.0%} in motion"
        if self.layer:
            what += f" of {self.layer.youngs_modulus * 1e-3:.3g} kPa and {self.layer.thickness * 1e3:.3g} mm"
            is_ = f"it is {_said(self.layer.misfit)}"
        with_ = f", with {' and '.join(also)}" if also else ""
        with_ += f", of {self.moduli:.2g} of its moduli" if self.moduli < 1 else ""
        return f"The smallest model within {most} is rung {self.rung}, {what}{with_}: {is_}."


def needs(
    of: Tissue | SoftLayer,
    radii: Iterable[float],
    forces: Iterable[float],
    speeds: Iterable[float] = (),
    *,
    thickness: float | None = None,
    duration: float = 0.0,
    path: float = 0.0,
    drag: float | None = None,
    friction: Friction = FRICTION,
    edge: float | None = None,
    enough: Misfit = ENOUGH,
) -> Needs:
    """The smallest model that comes near enough to a tissue, for balls of these radii under these forces.

    Skin, tension and muscle are left out one at a time, under one ball at one depth (`stmpl_core.stack.ball`).
    Which rung serves is told by single layers fitted to all contacts at once, as in `stmpl_core.stack.effective`. A
    stack cannot say all: muscle whose tone changes and fat that is known place by place ask for rung 2 as well, and a
    limb is round: at a radius of 2.5 thicknesses flat figures are 10 to 20 % off.

    Time and slip are what a state brings, played for one stroke of each ball at each speed (`stmpl_core.stroke`):
    pressed in, held, led along the skin, lifted. Its tissue relaxes by its own series, or where it has none by
    HELD_SKIN, which one person's skin had. Left out, time costs the difference of the force, and the skin that comes
    back late; it is needed where no share of the moduli makes up for that. Slip costs friction, and skin that is
    dragged along: by the way along the skin, or by a wrench that pulls along.

    Mesh: root mean square of what linear triangles with sides of one length miss of a wave, 0.0685 (k edge)^2.

    Args:
        of: tissue, or layer whose tissue, median thickness and edge length are meant.
        radii: radii of the balls [m], > 0; two for a range.
        forces: forces on them [N], > 0; two for a range.
        speeds: speeds of pressing, of leading along and of lifting [m/s], > 0; none: time is not judged.
        thickness: thickness from the surface to the bone [m], > 0; of a layer its own unless given.
        duration: time that a tool stays pressed in at one place [s], >= 0.
        path: way along the skin that it is led after that [m], >= 0.
        drag: tangential force over normal force of a wrench that pulls along [-], >= 0. None, and no path: slip is not
            judged.
        friction: coefficient of friction mu [-], > 0, or the name of a pair in stmpl_core.friction.
        edge: length of the mesh's edges [m], > 0; None: of a tissue, the mesh is not judged.
        enough: misfit that is allowed.

    Raises:
        InvalidInput: a number that is not above 0 or not that of a robot's tool, a tissue without a thickness, or a
            friction that has no name.
    """
    if not isinstance(of, Tissue):
        thickness = float(np.median(of.thickness)) if thickness is None else thickness
        edge = of.edge_length if edge is None else edge
    tissue = of if isinstance(of, Tissue) else of.typical.tissue
    if thickness is None:
        raise InvalidInput("a tissue wants a thickness: give thickness=, in m.")
    thickness = one_thickness(thickness)
    if not SOFTEST <= tissue.youngs_modulus <= HARDEST:
        raise InvalidInput(f"no soft layer has {tissue.youngs_modulus:.4g} Pa, {SOFTEST:g} to {HARDEST:g} Pa are "
                           "accepted.")  # fmt: skip
    speeds = _checked("speeds", speeds, "m/s", FASTEST)
    mu = coefficient(friction)
    accuracies = ((f"the accuracy in {name}", one) for name, one in enough._asdict().items())
    for name, one in (("friction", mu), ("edge", edge), *accuracies):
        if one is not None and not (np.isfinite(one) and one > 0):
            raise InvalidInput(f"{name} is {one:g}; it must be finite and above 0.")
    if min(enough) < FINEST:
        raise InvalidInput(f"an accuracy of {min(enough):g} is asked for; from {FINEST:g} on a model is chosen.")
    if drag is not None and not (np.isfinite(drag) and drag >= 0):
        raise InvalidInput(f"the drag is {drag:g} of the normal force; it must be finite and not below 0.")
    for name, one, unit, most in (("duration", duration, "s", LONGEST_STAY), ("path", path, "m", LONGEST_WAY)):
        if not 0 <= one <= most:
            raise InvalidInput(f"the {name} is {one:g} {unit}; from 0 to {most:g} is accepted.")
    radii, forces = _checked("radii", radii, "m", LARGEST_RADIUS), _checked("forces", forces, "N", LARGEST_FORCE)
    if not (radii and forces):
        raise InvalidInput("give at least one radius and one force.")
    pressed = tuple(_indentation(tissue, thickness, r, f) for r in radii for f in forces)
    stack, skin, contacts = plies(tissue, thickness), tissue.skin, {one.judged.contact_radius for one in pressed}
    slack, deepest = replace(skin, tension=0.0) if skin else None, max(one.judged.depth for one in pressed)
    bare, loose, taut = (nearest(stack, skin, one, sorted(contacts), 0.99 * MAX_THICKNESS,
                                 deepest / DEEPEST_IN_LAYER) for one in (None, slack, skin))  # fmt: skip
    rung = [_within(bare.misfit, enough), _within(taut.misfit, enough), True].index(True)
    pull = _tension(tissue, thickness, pressed, loose, rung, enough)
    eases = tissue if tissue.relaxes else tissue.relaxing(HELD_SKIN)
    series, fades = series_of(eases, thickness), np.vstack([fading(eases, thickness), fading_aside(eases, thickness)])
    strokes = [stroke_of(tissue, thickness, one.judged, speed, duration, path)._replace(
                   fades=float(faded(fades, one.judged.contact_radius)),
                   aside=shares_aside(fades, one.judged.contact_radius, len(series.times)))
               for one in pressed for speed in speeds or (np.inf,)]  # fmt: skip
    time, moduli = _time(strokes, series, mu if path else 0.0, bool(speeds), enough)
    slip = _slip(strokes, series, mu, path, drag, enough)
    terms = (
        _skin(tissue, thickness, pressed, bare, rung, enough),
        pull,
        _muscle(tissue, thickness, pressed, taut, rung),
        time,
        slip,
        _mesh(tissue, thickness, pressed, edge, enough),
    )
    layer = (bare, taut, None)[rung]  # with the skin's tension also where that is not needed: it costs nothing
    return Needs(rung, terms, pressed, layer, enough, friction if slip.needed else None, moduli)


def _checked(name: str, given: Iterable[float], unit: str, largest: float) -> tuple[float, ...]:
    try:
        each = tuple(float(one) for one in given)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{name} are numbers in {unit}, as a list or a range of two; got {given!r}.") from error
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
    return Indentation(radius, force, by_force.depth, beyond, judged, judged.depth / thickness)


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


def stroke_of(tissue: Tissue, thickness: float, at: Ball, speed: float, duration: float, path: float) -> Stroke:
    """The stroke of a ball that stands so deep [m/s, s, m]; its force grows with the depth as from half of it on."""
    power = float(np.log2(at.force / ball(tissue, thickness, at.radius, depth=0.5 * at.depth).force))
    under = patch(tissue, thickness, at.contact_radius)
    return Stroke(at.force, power, at.depth, at.contact_radius, under, speed, duration, path)


def _time(strokes: list[Stroke], series: Series, friction: float, told: bool, enough: Misfit) -> tuple[Term, float]:
    """What time is worth, and the share of the moduli that elastic tissue is given."""
    if not told:
        return Term("time", None, None, False, "No speed was given."), 1.0
    off = without_time(strokes, series, friction)
    needed = off.fitted > enough.force or off.lag > enough.motion
    moduli = 1.0 if needed or off.force <= enough.force else round(off.share, 3)
    return Term("time", off.force, off.lag, needed, _in_time(strokes, series, off)), moduli


def _in_time(strokes: list[Stroke], series: Series, off: Missed) -> str:
    if not len(series.times):
        return "The tissue is elastic."
    presses = sorted(one.depth / one.speed for one in strokes)
    lasts = f"A press takes {' to '.join(dict.fromkeys(f'{one:.2g}' for one in (presses[0], presses[-1])))} s"
    held = f", then it is held for {strokes[0].stays:.3g} s" if strokes[0].stays else ""
    shares = sorted(series.shares.sum() * one.fades for one in strokes)
    share = " to ".join(dict.fromkeys(f"{one:.0%}" for one in (shares[0], shares[-1])))
    fades = f"{share} of the force fades within {series.times.max():.2g} s"
    return f"{lasts}{held}; {fades}. {off.share:.2g} of the moduli, elastic, are {off.fitted:.0%} off in force."


def _slip(strokes: list[Stroke], series: Series, friction: float, path: float, drag: float | None,
          enough: Misfit) -> Term:  # fmt: skip
    ways = [1.5 * friction * one.force / one.patch.along for one in strokes]  # without ploughing [m]
    slides = f"skin goes along by {max(ways) * 1e3:.2g} mm before the whole contact slides"
    if drag is None and not path:
        return Term("slip", None, None, False, f"No way along the skin and no drag were given; {slides}.")
    found = [(float(one.drag.max() / one.force.max()), float(one.offset.max() / each.depth))
             for each in strokes if path for one in (played(each, series, friction),)]  # fmt: skip
    if drag is not None:
        found += [(carried, gone / one.depth) for one in strokes for carried, gone in (pulled(one, friction, drag),)]
    force, motion = (max(values) for values in zip(*found, strict=True))
    led = [f"it is led {path / one.radius:.2g} of its contact's radius" for one in strokes[:1] if path]
    led += [f"a wrench pulls along with {drag:.2g} of its force"] if drag is not None else []
    return Term("slip", force, motion, force > enough.force or motion > enough.motion,
                f"mu is {friction:.2g}, {' and '.join(led)}; {slides}.")  # fmt: skip


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
