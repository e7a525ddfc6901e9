"""Strokes: the friction of a tool and the relaxation of a skin, from wrenches and poses that a robot measured.

What a stroke does not tell is refused: a tool that stuck says nothing of sliding, a short hold nothing of long times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import patch_of, wrapped_in
from stmpl_core.regions import HELD_SKIN
from stmpl_core.relaxation import faded, fading, series_of, stretch, weights
from stmpl_core.sideways import Patch, Sideways
from stmpl_core.simulator import Simulator
from stmpl_core.slip import MOST_LEAN, PLOUGHED, further, ploughing, wrapped
from stmpl_core.stiffness import WRONG_WAY, asked
from stmpl_core.tissue import Prony
from stmpl_core.touch import Touch
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Trust

MIN_INSTANTS = 8  # instants of one kind that a fit needs
MAX_FACTOR = 100.0  # measured force over the law's at a pose, beyond which it is no other stiffness [-]
TREMBLES = 0.2  # longest way straight on over how far the tool went, below which its poses tremble
SLID = 1.8  # way over friction / stiffness from which a tool slides (Cattaneo, Mindlin: 1.5); twice after another way
MOST_RUBBED = 0.95  # quantile of the force along the skin over that across it, from which follows where tools slide
STRAIGHT = 1.05  # length of a way over the distance of its ends, up to which it counts as straight
JITTER = 3e-4  # way by which a tool has moved, and not only what measures it trembled [m]
BEGUN = 0.25  # force at the first instant over the largest, up to which a press counts as told from its beginning
LEAN = 0.05  # tilt of the contact's normal that strokes one way do not tell from friction [-]
HALVED = 40  # times that the range in which mu is sought is halved
OWN_FRICTION = 0.08  # relative error of the law of friction: 3 to 9 % of the largest by finite elements
FREE = 0.005  # coefficient that is none: a contact's normal that is 0.3 degrees off makes as much [-]
MAX_FRICTION_ERROR = 0.3  # standard error of a coefficient over it
OWN_FORCE = 0.01  # error of the law of relaxation while a tool stays, over the largest force: 0.5 % by finite elements
STAYS = 3e-4  # way along the skin within which a tool stays [m]
MAX_RESIDUAL = 0.06  # relative error of the forces that may be left; with more it is not that series
MAX_SHARE_ERROR = 0.1  # standard error of the share of the force that fades [-]
MIN_SEEN = 0.2  # least part of the series' fading between half the largest force and the last instant [-]


@dataclass(frozen=True)
class Rubbing:
    """Friction of a tool, as its strokes tell it.

    Args:
        friction: coefficient mu [-]; nan where `trust` says that none could be found.
        error: standard error of it, scatter, tilt of the normal and the law's own error together [-].
        instants: number of instants at which the tool slid.
        way: way that it slid [m].
        both_ways: whether it slid there and back.
        trust: verdict on mu: may it be used, and why not.
    """

    friction: float
    error: float
    instants: int
    way: float
    both_ways: bool
    trust: Trust

    def __str__(self) -> str:
        back = "there and back" if self.both_ways else "one way"
        return f"mu = {self.friction:z.2f} +- {self.error:.2f} from {1e3 * self.way:.0f} mm of sliding {back}"


@dataclass(frozen=True)
class Fading:
    """Relaxation of a skin, as a press that stays tells it.

    Args:
        share: share of the force that fades in the end [-]; nan where `trust` says that none could be found.
        error: standard error of it [-].
        relaxation: series of the materials, that which was asked for with other shares; None: nothing fades, or `trust`
            says why none was found.
        lasts: time that the press took [s].
        residual: relative error of the forces that is left, root mean square [-].
        trust: verdict: may it be used, and why not.
    """

    share: float
    error: float
    relaxation: Prony | None
    lasts: float
    residual: float
    trust: Trust

    def __str__(self) -> str:
        return f"{self.share:.0%} +- {self.error:.0%} of the force fades, from {self.lasts:.1f} s of pressing"


class _Rubbed(NamedTuple):
    """An instant at which a tool rubs: normal (3,), N and F_t [N], radius [m], k_t [N/m], r of ploughing [-].

    leans: turn of the push, as skin came from where the limb faces another way [rad]; once: share of it by which skin
    is not ploughed, see slip.rub [-]. patch: the patch that sticks, on a flat layer; stiffer, gives: by how
    much it is stiffer there as it is ploughed [-], and gives more on a limb [m/N]. along, across: W and W' of
    slip.wrapped [-].
    """

    normal: np.ndarray
    pressing: float
    rubs: float
    radius: float
    stiffness: float
    rises: float
    leans: float
    once: float
    patch: Patch
    stiffer: float
    gives: float
    along: float
    across: float


def fit_friction(toucher: Toucher | Simulator, strokes: Sequence[Contact]) -> Rubbing:
    """Finds the coefficient mu of a tool that slides.

    In steady slide the force along the way is R = mu (1 + (0.2 + 0.67 mu) r) of the normal one (`slip.ploughing`), on
    taut skin that of `slip.wrapped`, which is solved for mu; around a limb the push leans besides. A tool slides once
    it went straight on by SLID F / k, twice that after another way, with F the largest force along the skin and k the
    stiffness of the skin to what sticks (`stmpl_core.sideways`): one that sticks never does, since its force grows with
    the way. The normal is that of the contact law under the measured force; how far it is off changes sign with the
    way, so strokes there and back are worth more than twice one of them. So does a sensor's zero that is off along the
    way: by strokes one way it is friction. One that is off across the skin changes mu as it does the normal force,
    which no stroke tells.

    Args:
        toucher: contact law on the skin, about as stiff as it is, or a simulator that has it.
        strokes: contacts of one tool with their wrenches, in order of time.

    Raises:
        InvalidInput: a contact without a wrench, of more than one tool, or times that go back.
    """
    toucher = asked(toucher, strokes)
    _of_one_tool(strokes)
    if not (np.diff([one.time for one in strokes]) >= 0).all():
        raise InvalidInput("the times of strokes go back; a tool's way is told in their order.")
    pressing = [one for one in strokes if one.wrench is not None and one.wrench[:3].any()]
    places = np.array([one.pose_body_from_tool[:3, 3] for one in pressing]).reshape(-1, 3)
    if not len(places) or not np.ptp(places, axis=0).any():
        return _no_friction("the tool pressed nowhere, or stood still")
    sideways = Sideways(toucher.layer.typical)
    found = [_rubbed(toucher, sideways, one) for one in pressing]
    if sum(one is not None for one in found) < MIN_INSTANTS <= len(pressing):
        return _no_friction(WRONG_WAY)
    ratios = [one.rubs / one.pressing for one in found if one is not None]
    most = max(FREE, float(np.quantile(ratios or [0.0], MOST_RUBBED)))
    slid, ways, mus, furthest, needed = [], [], [], 0.0, math.inf
    lengths = _lengths(places, np.zeros(3))
    for k, (contact, one) in enumerate(zip(pressing, found, strict=True)):
        if one is None or contact.wrench is None:
            continue
        wanted = SLID * most * one.pressing / one.stiffness
        way, start = _straight(places, lengths, k, 2 * wanted)
        way = way - (way @ one.normal) * one.normal
        went = float(np.linalg.norm(way))
        wanted *= 2 if _lengths(places[: start + 1], one.normal)[-1] > 0.1 * went else 1
        if went / wanted > furthest / needed:
            furthest, needed = went, wanted
        if went >= wanted > 0:
            slid.append(k)
            ways.append(way / went)
            mus.append(_friction_of(float(contact.wrench[:3] @ way) / went / one.pressing, one))
    if len(slid) < MIN_INSTANTS:
        went = f"; it went {1e3 * furthest:.1f} mm straight on, {1e3 * needed:.1f} mm are needed" if furthest else ""
        more = "Tell more instants of the stroke" if furthest > 2 * needed else "Stroke further, there and back"
        if furthest < TREMBLES * float(np.ptp(places, axis=0).max()):
            more = "Smooth its poses: they tremble"
        return _no_friction(f"the tool slid at {len(slid)} of {len(pressing)} instants, {MIN_INSTANTS} are needed"
                            f"{went}. {_unlike(toucher, pressing) or more}")  # fmt: skip
    mus, axis = np.array(mus), np.linalg.svd(np.array(ways), full_matrices=False)[2][0]
    forth = np.array(ways) @ axis > 0
    way = sum(float(np.linalg.norm(places[b] - places[a])) for a, b in pairwise(slid) if b == a + 1)
    radius = float(np.median([one.radius for one in found if one is not None]))
    both = min(forth.sum(), (~forth).sum()) >= MIN_INSTANTS
    friction = float(np.mean([np.median(mus[forth]), np.median(mus[~forth])]) if both else np.median(mus))
    spread = 1.4826 * float(np.median(np.abs(mus - friction))) / math.sqrt(max(way / radius, 1.0))
    error = float(np.hypot(np.hypot(spread, OWN_FRICTION * abs(friction)), 0.0 if both else LEAN))
    trust = Trust()
    if -max(FREE, error) <= friction <= FREE:
        trust = trust.also("no friction was found: the tool slides freely", converged=False)
    elif friction < 0:
        trust = trust.also("the force along the skin points against the tool's way: is it what the tool exerts on the "
                           "body?", converged=False)  # fmt: skip
    elif error > MAX_FRICTION_ERROR * friction:
        trust = trust.also(f"friction is known to {error:.2f} of {friction:.2f} only, {MAX_FRICTION_ERROR:.0%} is "
                           "needed. Stroke there and back", converged=False)  # fmt: skip
    return Rubbing(friction, error, len(slid), way, bool(both), trust)


def _unlike(toucher: Toucher, pressing: Sequence[Contact]) -> str:
    """Question on forces that are far from what the skin presses with at their poses; empty: they are not."""
    some = pressing[:: max(len(pressing) // MIN_INSTANTS, 1)]
    told = np.array([np.linalg.norm(one.wrench[:3]) for one in some if one.wrench is not None])
    borne = np.array([toucher.touch(Contact(one.tool, one.pose_body_from_tool)).force for one in some])
    factor = float(np.median(told[borne > 0] / borne[borne > 0])) if borne.any() else 1.0
    if 1 / MAX_FACTOR < factor < MAX_FACTOR:
        return ""
    return (f"Its forces are {factor:.3g} times those that this skin presses with at its poses: are wrenches in "
            "newtons, and poses in metres?")  # fmt: skip


def _rubbed(toucher: Toucher, sideways: Sideways, one: Contact) -> _Rubbed | None:
    """What an instant tells, with the contact law under its force; None: nothing presses."""
    touch = toucher.touch(one)
    pressed = touch.pressed
    if one.wrench is None or pressed is None or pressed.forces is None or not touch.force > 0:
        return None
    normal, nodes = touch.push / touch.force, pressed.squeeze.nodes
    _, radius, _, thickness, _ = patch_of(nodes.points, nodes.area, nodes.thickness, nodes.depths, pressed.forces,
                                          normal)  # fmt: skip
    pressing = float(one.wrench[:3] @ normal)
    if not pressing > 0:
        return None
    along = one.wrench[:3] - pressing * normal
    rubs = float(np.linalg.norm(along))
    patch, give = sideways.at(radius, thickness), toucher.give(nodes, pressed.forces)
    stiffer, _ = ploughing(touch.depth, radius, pressing, patch.along, patch.bare, 0.0)
    rises = touch.depth / radius * pressing / (patch.along * radius)
    alone = stiffness = stiffer * patch.secant(rubs)
    spread, sines = wrapped_in(nodes.points, nodes.depths, pressed.forces, normal)
    leans, gives, wrap = 0.0, 0.0, sines * spread
    turns = float(along @ wrap @ along) / rubs**2 if rubs > 0 else 0.5 * float(np.trace(wrap))
    if rubs > 0:
        gives = max(float(along @ give @ along) / rubs**2, 0.0)
        stiffness = 1 / (1 / alone + gives)
        leans = float(along @ toucher.curvature(nodes, pressed.forces) @ along) / rubs / stiffness
    once = max(1 - stiffness / alone, patch.bare / patch.along)
    return _Rubbed(normal, pressing, rubs, radius, stiffness, rises, min(leans, MOST_LEAN), once, patch,
                   float(stiffer), gives, turns, float(np.trace(wrap)) - turns)  # fmt: skip


def _friction_of(ratio: float, one: _Rubbed) -> float:
    """mu from the force along the way over the normal one; see slip.ploughing, slip.wrapped and slip.rub."""
    plain = max(math.tan(math.atan(abs(ratio)) - one.leans), 0.0)
    taut, low, high = 1 - one.patch.bare / one.patch.along, 0.0, plain
    for _ in range(HALVED):
        mu = 0.5 * (low + high)
        alone = one.stiffer * one.patch.secant(mu * one.pressing)
        leans = taut * one.along * further(one.patch.along, alone, 1 / (1 / alone + one.gives), one.stiffer)
        rises = mu * (PLOUGHED[1] + PLOUGHED[2] * mu) * one.rises - one.once * max(one.leans, 0.0)
        more = wrapped(mu, leans, taut * one.across)[0] + (1 - taut) * max(rises, 0.0) > plain
        low, high = (low, mu) if more else (mu, high)
    return math.copysign(0.5 * (low + high), ratio)


@numba.njit(cache=True)
def _lengths(places, normal):
    """Length of a way to each place (N, 3), but for what it trembles by and goes along a normal (3,), (N,) [m]."""
    out, last = np.zeros(len(places)), 0
    for k in range(1, len(places)):
        step = places[k] - places[last]
        up = step[0] * normal[0] + step[1] * normal[1] + step[2] * normal[2]
        far = np.sqrt(np.sum((step - up * normal) ** 2))
        out[k] = out[k - 1]
        if far >= JITTER:
            out[k], last = out[k] + far, k
    return out


def _straight(places: np.ndarray, lengths: np.ndarray, k: int, far: float) -> tuple[np.ndarray, int]:
    """Way that a tool went straight on to place k, (3,) [m], as far as just more than `far` [m]; and where it began.

    Args:
        places: its places, (N, 3) [m].
        lengths: length of its way to each, (N,) [m].
        k: number of a place.
        far: way that is enough [m].
    """
    best, start = np.zeros(3), k
    for j in range(k - 1, -1, -1):
        way = places[k] - places[j]
        went = float(np.linalg.norm(way))
        if lengths[k] - lengths[j] > STRAIGHT * went + JITTER:
            break
        best, start = way, j
        if went > far:
            break
    return best, start


def fit_relaxation(toucher: Toucher | Simulator, press: Sequence[Contact], relaxation: Prony | None = None,
                   offset: float = 0.0) -> Fading:  # fmt: skip
    """Finds how much of a skin's force fades, from a press that stays in one place.

    With S_e and D_i of `stmpl_core.relaxation` along the measured poses, which do not depend on the shares g_i while
    the tool presses, the measured force is linear in two unknowns, the stiffness c and the share's factor x:

        F = c lambda S_e - (c x) lambda sum g_i D_i

    A sensor that drifts while the tool is held, or a tool that creeps more than its poses say, is told as skin that
    fades more or less: 10 % of the force in the press change the share by some 0.1.

    Args:
        toucher: contact law on the skin, of whatever stiffness, or a simulator that has it.
        press: contacts of one tool with their wrenches and times, from the first touch on.
        relaxation: series whose times and whose shares among each other are taken; None: the tissue's own, else
            stmpl_core.regions.HELD_SKIN.
        offset: distance by which the poses stand too far back along their push [m] (`fit_stiffness` tells it).

    Raises:
        InvalidInput: a contact without a wrench, of more than one tool, or times that do not go forward.
    """
    toucher = asked(toucher, press)
    _of_one_tool(press)
    taken = relaxation or toucher.layer.tissue.relaxation or HELD_SKIN
    layer, steps = toucher.layer, np.diff([one.time for one in press])
    if (steps <= 0).any() or not np.isfinite(steps).all():
        raise InvalidInput("the times of a press must go forward; relaxation is a matter of time.")
    tissue, thickness = layer.typical.tissue.relaxing(taken), float(np.median(layer.thickness))
    (shares, times), fades = series_of(tissue, thickness), fading(tissue, thickness)
    relaxed, kept, gain, before = np.zeros(len(times)), np.empty(len(times)), np.empty(len(times)), 0.0
    rows, forces, when, more, middle, free = [], [], [], [], None, False
    for k, one in enumerate(press):
        assert one.wrench is not None
        size = float(np.linalg.norm(one.wrench[:3]))
        push = one.wrench[:3] / size if size > 0 else np.zeros(3)
        touch = _at(toucher, one, offset * push)
        if touch.pressed is None or touch.pressed.forces is None or not touch.force > 0:
            if rows:
                break
            free = True
            continue
        middle = one.pose_body_from_tool[:3, 3] if middle is None else middle
        normal = touch.push / touch.force
        away = one.pose_body_from_tool[:3, 3] - middle
        if np.linalg.norm(away - (away @ normal) * normal) > STAYS:
            break
        nodes, pressing = touch.pressed.squeeze.nodes, touch.pressed.forces
        _, radius, _, thick, _ = patch_of(nodes.points, nodes.area, nodes.thickness, nodes.depths, pressing, normal)
        long = stretch(touch.depth, thick)
        more.append(float(faded(fades, radius)))
        weights(times, steps[k - 1] if k else 0.0, 0.0, more[-1] * before, relaxed, kept, gain)
        before = touch.force / long
        relaxed = kept + more[-1] * gain * before
        rows.append((touch.force, -long * float(shares @ relaxed)))
        forces.append(float(one.wrench[:3] @ normal))
        when.append(one.time)
    if not rows and press:
        return _no_fading(WRONG_WAY)
    if len(rows) < MIN_INSTANTS:
        return _no_fading(f"the tool stayed where it pressed for {len(rows)} instants, {MIN_INSTANTS} are needed. "
                          "Press, and hold")  # fmt: skip
    elastic = np.array(rows)[:, 0]
    if not free and elastic[0] > BEGUN * elastic.max():
        return _no_fading(f"the first instant presses with {elastic[0] / elastic.max():.0%} of the largest force: what "
                          "faded before is not known. Begin before the tool touches, and press anew")  # fmt: skip
    return _faded(np.array(rows), np.array(forces), np.array(when), shares * float(np.mean(more)), taken)


def _faded(rows: np.ndarray, forces: np.ndarray, when: np.ndarray, shares: np.ndarray, taken: Prony) -> Fading:
    """Least squares of `fit_relaxation`: F (N,) = rows (N, 2) @ (c, c x), each instant by the time it stands for."""
    lasts = np.gradient(when)
    root = np.sqrt(lasts / lasts.mean())[:, None]
    (stiff, eased), *_ = np.linalg.lstsq(root * rows, root[:, 0] * forces, rcond=None)
    largest, whole, told = float(forces.max()), float(when[-1] - when[0]), _timing(when, taken)
    fades, half = -rows[:, 1] / rows[:, 0] / float(shares.sum()), int(np.argmax(rows[:, 0] > 0.5 * rows[:, 0].max()))
    seen = float(fades[-1] - fades[half])
    if seen < MIN_SEEN:
        return _no_fading(f"{told} hold {seen:.0%} of the fading, {MIN_SEEN:.0%} is needed: are the times in seconds? "
                          "Press quickly, and hold longer")  # fmt: skip
    if not (stiff > 0 and largest > 0):
        return _no_fading(WRONG_WAY)
    left = root[:, 0] * (forces - rows @ (stiff, eased))
    residual = float(np.sqrt(np.mean(left**2))) / largest
    normal = np.linalg.inv(rows.T @ (root**2 * rows) / len(rows) + 1e-12 * np.eye(2) * float((rows**2).mean()))
    factor = float(eased / stiff)
    slope = np.array([-factor, 1.0]) / stiff
    spread = float(np.sqrt(slope @ normal @ slope)) * largest
    spread *= math.hypot(OWN_FORCE, residual / math.sqrt(len(rows)))
    share, error = factor * float(shares.sum()), spread * float(shares.sum())
    if not -2 * error <= share < 1:
        return _no_fading(f"{share:.0%} of the force would fade: it does not go as under a tool that stays. {told} "
                          "tell it so: are the times in seconds?")  # fmt: skip
    trust = Trust()
    if residual > MAX_RESIDUAL:
        trust = trust.also(f"these times leave the forces off by {residual:.0%}, at most {MAX_RESIDUAL:.0%} is "
                           "accepted: the poses may be off, or the skin fades otherwise", converged=False)  # fmt: skip
    if error > MAX_SHARE_ERROR:
        trust = trust.also(f"{whole:.1f} s of pressing tell the share that fades to {error:.0%} only, "
                           f"{MAX_SHARE_ERROR:.0%} is needed. Press quickly, and hold longer", converged=False)
    series = None
    if trust.ok and factor > 0:
        series = Prony(tuple(factor * g for g in taken.shares), taken.times, "measured by a press that stayed")
    return Fading(share, error, series, whole, residual, trust)


def _timing(when: np.ndarray, taken: Prony) -> str:
    """The times of a press (N,) [s] and those of its series, in words."""
    every, times = float(np.median(np.diff(when))), " and ".join(f"{time:.3g}" for time in taken.times)
    return f"{when[-1] - when[0]:.3g} s of pressing, told every {every:.3g} s, of skin that fades in {times} s"


def _at(toucher: Toucher, one: Contact, shift: np.ndarray) -> Touch:
    pose = one.pose_body_from_tool.copy()
    pose[:3, 3] += shift
    return toucher.touch(Contact(one.tool, pose))


def _of_one_tool(contacts: Sequence[Contact]) -> None:
    for one in contacts:
        if one.wrench is None:
            raise InvalidInput(f"an instant of {one.name} has no wrench; strokes are judged by the force.")
        if (one.name, one.tool.digest) != (contacts[0].name, contacts[0].tool.digest):
            raise InvalidInput(f"strokes are of one tool; these are of {contacts[0].name} and {one.name}.")


def _no_friction(why: str) -> Rubbing:
    return Rubbing(math.nan, math.nan, 0, 0.0, False, Trust(converged=False, why=why))


def _no_fading(why: str) -> Fading:
    return Fading(math.nan, math.nan, None, 0.0, math.nan, Trust(converged=False, why=why))
