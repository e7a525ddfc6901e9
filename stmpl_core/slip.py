"""Slip: skin that sticks to a tool, creeps and slides: partial slip as a set of springs, each with a slider.

With k the stiffness of the patch that sticks (`stmpl_core.sideways`), s the way of the tool along it and cap = mu N the
force at which it slides, a contact that was not dragged before answers (Cattaneo 1938, Mindlin 1949; Johnson, "Contact
Mechanics", 1985, chapter 7)

    F = cap (1 - (1 - k s / (1.5 cap))^1.5)    up to s = 1.5 cap / k

Springs in parallel, each of which slides at its share of the cap, answer so on first loading, and by Masing's rule on
every reversal (Iwan, J. Appl. Mech. 33, 893, 1966). Whatever the path, they give no energy. Forces are vectors
(F_x, F_y, M / rho) in the tangent plane, with M the torque about the contact's normal and rho its lever, the mean
distance of the pressure from the middle; so translation and spin share one limit. What slides goes the way of its
force (the flow rule of a limit surface: Goyal, Ruina & Papadopoulos, Wear 143, 307, 1991), however much stiffer skin is
to the one than to the other. Springs relax as what carries a drag does (stmpl_core.sideways.fading_aside).

Skin moves as one where it sticks, and the more the harder it is pressed where it slides. A spring stands for a ring of
the contact, so the part of the way that is of skin that slides is a fixed sum of the springs' forces: nothing of it
while all stick, F / cap of it on first loading, all of it in a slide; and it stays where a tool stops or turns back.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.footing import (
    along_aim,
    along_give,
    along_tangents,
    carried_more,
    faced,
    given_way,
    in_plane,
    in_space,
    leaned,
    softened,
    way_of_skin,
    way_of_tool,
    wrench_at,
)
from stmpl_core.relaxation import weights
from stmpl_core.sideways import secant

SPRINGS = 8
_LEFT = (1 - np.arange(SPRINGS + 1) / SPRINGS) ** (4 / 3)  # 1 - x / 1.5 where springs begin to slide; finer at the end
_YIELD, _FORCE = 1.5 * (1 - _LEFT), 1 - _LEFT**1.5  # k s / cap and F / cap there
_SLOPE = np.append(np.diff(_FORCE) / np.diff(_YIELD), 0.0)
STIFFNESS = _SLOPE[:-1] - _SLOPE[1:]  # of each spring, over k, (SPRINGS,)
LIMIT = STIFFNESS * _YIELD[1:]  # force at which each slides, over the cap, (SPRINGS,)
_SLID = np.where(_YIELD > _YIELD[1], _FORCE**2, 0.0)  # part of F / cap there that moves skin as what slides
_SLID_SLOPE = np.append(np.diff(_SLID) / np.diff(_YIELD), 0.0)
SLID = (_SLID_SLOPE[:-1] - _SLID_SLOPE[1:]) / STIFFNESS  # the same of each spring's force, (SPRINGS,)
TRIALS, TOLERANCE = 30, 1e-9  # of the way for a force; over the cap
SLIDES = 8  # trials of how far a spring slides
MOST_CARRIED = 0.9999  # share of the cap that sticks: a force at the cap has no way
PART, PARTS = 0.25, 16  # way over cap / k from which a step is cut, for a slide that turns; most parts
SPUN = 0.8  # of slide times spin over their limit: force aside that a turning tool takes; 0.64 by finite elements
PLOUGHED = 0.33, 0.2, 0.67  # see ploughing: growth of stiffness, and of the cap without and over mu
FOLDS = 2.0  # what skin ahead gives as it folds, over what its lost pressure does: its shear goes, too
FOLDINGS = 4  # trials of how far skin folds
FURTHER = 1.05  # way of skin that slides over that of a patch that moves as one, see further
SHEARED = 0.25  # of k u^2 of what is below skin, over its thickness: growth of the push; 1/2 between plates
LOOSE = 0.4  # of W, see wrapped: what taut skin loses of the force once all of it slides, by flat stacks
MOST_WRAPPED = 0.2  # lean of the push of a tool that is wrapped in taut skin; 0.17 by finite elements [rad]
MOST_LEAN = 0.5  # turn of the normal under skin that is dragged along, of which a push takes note [rad]
MOST_GROWN = 1.5  # factor on the push by which skin that is dragged around a limb grows; 1.38 by finite elements
LEAST_LEFT = 0.25  # of its thickness: layer below a tool that is sheared
LEAST_GROWN = 0.5  # depth over the tool's that counts at least, where skin came from a hollow
MOST_PASSES, SETTLED = 4, 1e-3  # turn of the normal [rad] at which push and friction agree


class Drag(NamedTuple):
    """What a step makes of the springs.

    Args:
        springs: their forces without relaxation, (SPRINGS, 3) [N].
        relaxed: what of them has relaxed, (P, SPRINGS, 3) [N].
        force: sum of their forces, (3,) [N].
        share: share of the normal force whose skin slides [-]: 0 sticks, 1 slides.
        stored: energy that the springs would give back at once [J].
    """

    springs: np.ndarray
    relaxed: np.ndarray
    force: np.ndarray
    share: float
    stored: float


@numba.njit(cache=True, error_model="numpy")
def ploughing(depth, radius, force, along, bare, friction):
    """Factor on the stiffness of a patch [-], and force at which it slides [N].

    Skin that is dragged rises before the tool and leans on it: with r = (depth / a) N / (k_t a) the patch is stiffer by
    1 + 0.33 r, the cap mu N higher by 1 + (0.2 + 0.67 mu) r, fitted on slides of a ball on one material by finite
    elements at mu 0.3 and 0.6. Taut skin is held down: the share of k_t that is skin's does not grow.

    Args:
        depth: depth of the tool [m].
        radius: radius a of the contact [m].
        force: normal force N [N].
        along: stiffness k_t of the patch [N/m].
        bare: the same without skin [N/m].
        friction: coefficient mu [-].
    """
    rises = depth / radius * force / (along * radius)
    higher = 1 + (PLOUGHED[1] + PLOUGHED[2] * friction) * rises
    return 1 + PLOUGHED[0] * rises * bare / along, higher * friction * force


@numba.njit(cache=True, error_model="numpy")
def wrapped(mu, leans, across):
    """Force along the skin over that into it at which a tool slides that is wrapped in taut skin [-].

    Skin that is dragged by a way u pulls at the tool along its way, all over the contact. Where the tool's surface
    turns from the push by a sine n, n^2 of that is pressure, so the push leans by l = W k_t u / N with W the mean of
    n^2 along the way; friction is at right angles to it. Normals that turn aside from the way carry more pressure than
    push: friction is mu (1 + W' / 2) of it, with W' the mean across the way. Neither changes the force into the skin.

    Args:
        mu: coefficient of friction [-].
        leans: l over that ratio [-].
        across: W' of taut skin [-].

    Returns:
        ratio, and by how much l is beyond MOST_WRAPPED [rad], where it is held.
    """
    rubs = mu * (1 + 0.5 * across)
    root = np.sqrt(max((1 - leans) ** 2 - 4 * rubs * rubs * leans, 0.0))
    lean = 2 * rubs * leans / max(1 - leans + root, 0.5)
    held = min(lean, MOST_WRAPPED)
    return (rubs + held) / max(1 - rubs * held, 0.5), lean - held


@numba.njit(cache=True, error_model="numpy", inline="always")
def further(along, alone, sticks, stiffer):
    """Way of skin that slides, over that of a patch which sticks on a flat layer, without folds, under the same force.

    In a slide the traction goes as the pressure, under which skin goes further than as one: 1.2 times on a half-space
    (Johnson, "Contact Mechanics", 1985, chapters 3 and 7), 1.13 to 1.25 in the linear response of skin, fat and muscle,
    of which finite elements have 0.93. Where it folds ahead it loses its shear there with its pressure, by symmetry as
    much again.

    Args:
        along: k_t [N/m].
        alone: the same where skin folds and is ploughed; sticks: and goes along with its limb [N/m].
        stiffer: factor of ploughing on it [-].
    """
    return FURTHER * along / sticks + (FOLDS - 1) * (along / alone - 1 / stiffer)


@numba.njit(cache=True, error_model="numpy", inline="always")
def sheared(bare, thickness, depth, force):
    """Growth of a push where what is below its skin is sheared by a way, over the square of that way [1/m^2].

    A layer of a thickness t that is sheared between plates by a way u stores G A u^2 / (2 t), whose slope along the
    depth is push: it grows by G A (u / t)^2 / 2, which is Poynting's effect (Proc. R. Soc. A 82, 546, 1909). A patch
    feels its thickness less than a plate: by finite elements of flat stacks half of that, with k_t for G A / t.

    Args:
        bare: k_t of a patch without its skin [N/m].
        thickness, depth: of the layer, and by which it is pressed in [m].
        force: normal force [N].
    """
    return SHEARED * bare / (max(thickness - depth, LEAST_LEFT * thickness) * force)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _folded(stiffness, along, fold):
    """Stiffness of a patch [N/m] that skin ahead of it keeps a share of, as it folds; along: k_t on a flat layer."""
    return 1 / (1 / stiffness + (1 / fold - 1) / along)


@numba.njit(cache=True, error_model="numpy")
def _folding(way, before, stiffness, along, bare, slack, stiffer, most):
    """Way (3,) [m] along which springs without folds would come to what those of skin that folds do along `way`.

    What sticks is as stiff as the drag that there is lets it be (Patch.secant), not as one that slides. The way of the
    skin decides, wherever it came from, so that folds give no energy and take none.

    Args:
        way: way of the tool along the skin and rho times its turn, (3,) [m].
        before: forces of the springs, (3,) [N].
        stiffness: of the patch without folds, (3,) [N/m].
        along, bare, slack: see Patch.
        stiffer: factor of ploughing on it [-].
        most: drag at which all of it slides [N].
    """
    force = min(np.hypot(before[0], before[1]), most)
    fold, goes, out = secant(along, bare, slack, force) / along, np.zeros(2), way.copy()
    for x in range(2):
        goes[x] = before[x] / _folded(stiffness[x], stiffer * along, fold) + way[x]
    ends = np.zeros(2)
    for _ in range(FOLDINGS):
        for x in range(2):
            ends[x] = goes[x] * _folded(stiffness[x], stiffer * along, fold)
        fold = secant(along, bare, slack, min(np.hypot(ends[0], ends[1]), most)) / along
    for x in range(2):
        out[x] = (goes[x] * _folded(stiffness[x], stiffer * along, fold) - before[x]) / stiffness[x]
    return out


@numba.njit(cache=True, error_model="numpy")
def _go(way, stiffness, cap, start, left, over, springs, force, slides):
    """Springs after a way (3,): their forces without relaxation (S, 3), the sum (3,), and which slide (S,)."""
    force[:] = 0.0
    for j in range(len(springs)):
        square = 0.0
        for x in range(3):
            springs[j, x] = start[j, x] + STIFFNESS[j] * stiffness[x] * way[x]
            one = over * springs[j, x] - left[j, x]
            square += one * one
        most, size = LIMIT[j] * cap, np.sqrt(square)
        slides[j] = size >= most
        slip = _slipped(springs[j], left[j], stiffness, over, most) if size > most else 0.0
        for x in range(3):
            one = over * springs[j, x] - left[j, x]
            if slip > 0:
                one /= 1 + slip * stiffness[x]
                springs[j, x] = (one + left[j, x]) / over
            force[x] += one


@numba.njit(cache=True, error_model="numpy")
def _slipped(spring, left, stiffness, over, most):
    """How far a spring slides over its force [m/N], so that this falls to `most` [N].

    A force f_x that would be without slip is f_x / (1 + slip k_x) with it. What is solved for is where one over its
    size is one over `most`, by Newton's method, as of trust regions: in one step where the stiffnesses are alike.
    """
    if not most > 0:
        return np.inf
    slip = 0.0
    for _ in range(SLIDES):
        square = slope = 0.0
        for x in range(3):
            softer = 1 + slip * stiffness[x]
            one = (over * spring[x] - left[x]) / softer
            square += one * one
            slope += one * one * stiffness[x] / softer
        now = np.sqrt(square)
        if not now > most * (1 + 1e-12):
            break
        slip += square / slope * (now - most) / most
    return slip


@numba.njit(cache=True, error_model="numpy")
def drag(springs, relaxed, shares, times, dt, rolled, stiffness, before, cap, way, wanted, by_force):
    """One step of the springs of a patch that stays as it is; see Drag, and for the arguments `_step`."""
    return drag_on(springs, relaxed, shares, times, dt, rolled, stiffness, before, cap, way, wanted, by_force,
                   stiffness, cap)  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def drag_on(springs, relaxed, shares, times, dt, rolled, stiffness, before, cap, way, wanted, by_force, was, first):
    """One step of the springs; see Drag, and for the arguments `_step`.

    A slider that turns follows the way within a length of cap / k, so a longer step by pose is cut into parts, along
    which cap and stiffness go from what they were before the step, `first` and `was`, to what they are.
    """
    far = 0.0
    for x in range(3):
        far += (stiffness[x] * way[x]) ** 2
    parts = 1
    if not by_force and cap > 0:
        parts = int(min(max(np.ceil(np.sqrt(far) / (PART * cap)), 1.0), PARTS))
    found, kept, force, share, stored = springs, relaxed, np.zeros(3), 0.0, 0.0
    least = before.copy()
    for k in range(1, parts + 1):
        to_go = (parts - k) / parts
        limit, now = cap + to_go * (first - cap), stiffness + to_go * (was - stiffness)
        found, kept, force, share, stored = _step(found, kept, shares, times, dt / parts, rolled, now, least, limit,
                                                  way / parts, wanted, by_force)  # fmt: skip
        rolled = 0.0
        for x in range(3):
            least[x] = min(least[x], now[x]) if least[x] > 0 else now[x]
    return found, kept, force, share, stored


@numba.njit(cache=True, error_model="numpy")
def _step(springs, relaxed, shares, times, dt, rolled, stiffness, before, cap, way, wanted, by_force):
    """One part of a step of the springs; see Drag.

    Where the patch grew stiffer the springs keep their forces, where it grew softer than it ever was under them these
    fall in proportion, and where the cap fell they are cut to it: none of that gives energy.

    Args:
        springs, relaxed: see Drag, before the step.
        shares, times: series by which a drag relaxes, (P,) each.
        dt: time of the step [s].
        rolled: way that the contact rolled on, over its radius [-]: rolling leaves strained skin behind.
        stiffness: of the patch to (way, way, rho times turn), (3,) [N/m].
        before: that at which the springs' forces are held, (3,).
        cap: force at which all slides [N].
        way: way of the tool along the skin and rho times its turn, (3,) [m]; not read by force.
        wanted: forces to carry, (3,) [N]; read by force: the nearest that the cap allows is carried.
        by_force: whether forces are given.
    """
    many, terms = len(springs), len(times)
    start, left = np.empty((many, 3)), np.zeros((many, 3))
    found, kept_all = np.empty((many, 3)), np.empty((terms, many, 3))
    old, kept, gain = np.empty(terms), np.empty(terms), np.zeros(terms)
    over, stays = 1.0, np.exp(-rolled)
    for x in range(3):
        soft = min(stiffness[x] / before[x], 1.0) * stays if before[x] > 0 else stays
        for j in range(many):
            start[j, x] = soft * springs[j, x]
            for i in range(terms):
                old[i] = soft * relaxed[i, j, x]
            weights(times, dt, 0.0, start[j, x], old, kept, gain)
            for i in range(terms):
                kept_all[i, j, x] = kept[i]
                left[j, x] += shares[i] * kept[i]
    for i in range(terms):
        over -= shares[i] * gain[i]
    force, slides, go = np.zeros(3), np.zeros(many, np.bool_), way.copy()
    if by_force:
        go[:] = 0.0
        size = np.sqrt(wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2)
        if size > MOST_CARRIED * cap:  # all slide along the force
            for j in range(many):
                for x in range(3):
                    one = LIMIT[j] * cap * wanted[x] / size if size > 0 else 0.0
                    found[j, x] = (one + left[j, x]) / over
                    force[x] += one
                slides[j] = True
        else:
            _find(wanted, stiffness, cap, start, left, over, found, force, slides, go)
    else:
        _go(go, stiffness, cap, start, left, over, found, force, slides)
    share = stored = 0.0
    for j in range(many):
        share += LIMIT[j] if slides[j] else 0.0
        for x in range(3):
            stored += 0.5 * (over * found[j, x] - left[j, x]) ** 2 / (STIFFNESS[j] * stiffness[x])
            for i in range(terms):
                kept_all[i, j, x] += gain[i] * found[j, x]
    return found, kept_all, force, min(share, 1.0), stored


@numba.njit(cache=True, error_model="numpy")
def _solve(a, b, out):
    """Solves a matrix (3, 3) for a vector by Cramer's rule; LAPACK's call takes longer than the rest of a trial."""
    rows = np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for x in range(3):
            y, z = (x + 1) % 3, (x + 2) % 3
            rows[x, i] = a[j, y] * a[k, z] - a[j, z] * a[k, y]
    size = a[0, 0] * rows[0, 0] + a[0, 1] * rows[1, 0] + a[0, 2] * rows[2, 0]
    for x in range(3):
        out[x] = (rows[x, 0] * b[0] + rows[x, 1] * b[1] + rows[x, 2] * b[2]) / size


@numba.njit(cache=True, error_model="numpy")
def _find(wanted, stiffness, cap, start, left, over, springs, force, slides, go):
    """The way (3,) for a force within the cap, to `go`: Newton on a convex problem, with the springs' own tangent."""
    step, tangent = np.empty(3), np.empty((3, 3))
    last, back = np.inf, 1.0
    for _ in range(TRIALS):
        _go(go, stiffness, cap, start, left, over, springs, force, slides)
        off = 0.0
        for x in range(3):
            off += (wanted[x] - force[x]) ** 2
        if np.sqrt(off) < TOLERANCE * cap:
            return
        if off > last:  # a step too far: half of the way back
            back *= 0.5
            for x in range(3):
                go[x] -= back * step[x]
            if back > 1e-6:
                continue
            return
        last, back = off, 1.0
        tangent[:] = 0.0
        for j in range(len(springs)):
            along = 0.0
            if slides[j]:
                for x in range(3):
                    along += stiffness[x] * (over * springs[j, x] - left[j, x]) ** 2
            for x in range(3):
                tangent[x, x] += over * STIFFNESS[j] * stiffness[x]
                if along > 0:
                    a = over * springs[j, x] - left[j, x]
                    for y in range(3):
                        b = over * springs[j, y] - left[j, y]
                        tangent[x, y] -= over * STIFFNESS[j] * stiffness[x] * stiffness[y] * a * b / along
        for x in range(3):
            tangent[x, x] += 1e-9 * stiffness[x]
        _solve(tangent, wanted - force, step)
        far = 0.0
        for x in range(3):
            far += (stiffness[x] * step[x]) ** 2
        if far > (2 * cap) ** 2:  # where all slide the tangent says nothing along the force
            step *= 2 * cap / np.sqrt(far)
        for x in range(3):
            go[x] += step[x]


@numba.njit(cache=True, error_model="numpy")
def rub(wrench, stated, by_force, contact, origin, bend, give, mu, along_itself, wrap, force, lever, elastic, depth,
        radius, thickness, power, along, turn, bare, slack, twist, taken, known, pressed, before_contact,
        before_elastic, before_slid, before_held, first, room, passed, springs, relaxed, stiffness, shares, times,
        dt):  # fmt: skip
    """Friction of a contact that would press with a wrench (6,) without friction.

    Friction turns the way that the push faces, and the push bounds friction: both are asked until they agree.
    What skin carried along itself while it stuck (stmpl_core.wrenches) a drag takes from it, as far as it is used
    up. When it turns back that does not come back, but where the tool presses on.

    Args:
        wrench, stated: wrench without friction and that to carry, (6,) [N, N m]; the latter is read by force.
        by_force: whether the contact is told by a wrench.
        contact: contact, see Memory, (3, 3).
        origin: origin of the tool, (3,) [m].
        bend: curvature of the skin there, (3, 3) [1/m].
        give: how it gives along the skin beyond a flat layer, (3, 3) [m/N].
        mu: coefficient of friction [-].
        along_itself: what skin carries along itself once all of it slides, over its force [-].
        wrap: see footing.wrapped_in, (3, 3) [-].
        force: normal force [N].
        lever: mean distance of the forces from the middle [m].
        elastic, depth, radius, power: see Scalars.
        thickness: of the layer [m].
        along, turn, bare, slack: see Patch.
        twist, known: see footing.aged.
        taken: way by which what other tools drag takes the skin along in the step, (3,) [m].
        pressed: whether the tool pressed before the step.
        before_contact, before_elastic, before_slid, before_held: see Memory and Scalars, before the step.
        first: Scalars.limit before the step [N].
        room, passed: Scalars.rolled_first, .rolled_second and .rolled before it, and those of `passed`, (3,) [m].
        springs, relaxed, stiffness: see Memory, before it.
        shares, times: series by which a drag relaxes, (P,) each.
        dt: time of the step [s].

    Returns:
        push, rubs: wrench of the push and that of friction, (6,) each [N, N m].
        share, offset, turn, lean, grown, slid_offset, slid_turn: see Slip.
        cap: tangential force at which all of it slides [N].
        stiffness, springs, relaxed: see Memory, after the step.
        stored: energy that springs and bent skin store [J].
        slid, held, room, passed: see Scalars.
        contact: the contact with tangents by which all this is told.
        off: error of the force where the tool spins as it slides, or would grow by more than MOST_GROWN [N].
    """
    wanted, turned, out, carries, slid = np.zeros(3), np.zeros(3), 0.0, 1.0, before_slid
    contact, springs, relaxed, room, passed, gives = along_give(contact, give, springs, relaxed, room, passed)
    square, before = 0.0, np.array([springs[:, x].sum() for x in range(3)])
    if stiffness[0] > 0:
        fold = secant(along, bare, slack, min(np.hypot(before[0], before[1]), mu * force)) / along
        seen = stiffness.copy()
        seen[0], seen[1] = _folded(seen[0], along, fold), _folded(seen[1], along, fold)
        turned, out = faced(springs, seen, contact, bend, MOST_LEAN)
        square = (before[0] / seen[0]) ** 2 + (before[1] / seen[1]) ** 2
    way, rolled, room = way_of_tool(twist, known, before_contact, pressed, contact, origin, depth, radius, lever, room)
    if pressed:
        first_taken, second_taken = along_tangents(taken, contact)
        way[0], way[1] = way[0] - first_taken, way[1] - second_taken
    was = stiffness[0]
    last_held = before_held if before_held > 0 else was
    held_at = stiffness * (last_held / was) if was > 0 else stiffness.copy()
    size = np.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
    lost = (1 - before_slid) * before_elastic / elastic
    taut, past = 1 - bare / along, 0.0
    loose = taut * LOOSE * 0.5 * (wrap[0, 0] + wrap[1, 1] + wrap[2, 2])
    shears = taut * sheared(bare, thickness, depth, force)
    along_itself += loose
    aim = in_plane(stated, contact, origin, lever) if by_force else before + along * way
    turns_along = along_aim(wrap, aim, contact)
    turns_across = wrap[0, 0] + wrap[1, 1] + wrap[2, 2] - turns_along
    arm, wants, grown, cap, share, stored = contact[0] - origin, 1.0, 1.0, 0.0, 0.0, 0.0
    turned_by, arm_of_turn = way[2] / lever, lever
    carried, after, new, kept = np.zeros(3), stiffness.copy(), springs.copy(), relaxed.copy()
    seen, fold = stiffness.copy(), 1.0
    for _ in range(MOST_PASSES):
        if by_force:
            carries = carried_more(stated, contact[1], turned) * before_slid
            grown = carries / slid
        else:
            wants = max(1 + out / depth, LEAST_GROWN) ** power + shears * square
            grown = min(wants, MOST_GROWN)
        stiffer, cap = ploughing(depth, radius, grown * force, along, bare, mu)
        most = mu * grown * force
        plain = most / cap  # what turns in place has nothing before it that friction raises
        arm_of_turn = lever * (plain + (1 - plain) * PLOUGHED[1] / (PLOUGHED[1] + PLOUGHED[2] * mu))
        way[2] = turned_by * arm_of_turn
        if by_force:
            push = carries * (wrench + wrench_at(size * turned, arm))
            wanted = in_plane(stated - push, leaned(contact, turned), origin, arm_of_turn)
        alone = stiffer * secant(along, bare, slack, most)
        sticks = given_way(alone, give, wanted if by_force else before + alone * way, contact)
        if out > 0:  # skin leans before the tool once: as it turns about the bone, or as it is ploughed
            by_turn = max(1 - sticks / alone, bare / along) * np.sqrt(np.sum(turned**2))
            cap -= min(by_turn * grown * force, cap - most)
        if taut > 0:
            leans = taut * turns_along * further(along, alone, sticks, stiffer)
            ratio, past = wrapped(mu, leans, taut * turns_across)
            cap = (1 - loose) * (ratio * grown * force + (1 - taut) * (cap - most))
        flat, go = stiffer * along, way
        after = np.array([softened(flat, gives[0]), softened(flat, gives[1]), stiffer * turn / arm_of_turn**2])
        if alone < flat and not by_force:
            go = _folding(way, before, after, along, bare, slack, stiffer, most)
        from_cap, from_stiffness = cap, after.copy()
        if pressed and was > 0:
            from_cap, from_stiffness = first, stiffness.copy()
        new, kept, carried, share, stored = drag_on(
            springs, relaxed, shares, times, dt, rolled, after, held_at, cap, go, wanted, by_force, from_stiffness,
            from_cap)  # fmt: skip
        last, last_slid = turned, slid
        first_drawn, second_drawn = new[:, 0].sum(), new[:, 1].sum()
        fold = secant(along, bare, slack, min(np.hypot(first_drawn, second_drawn), most)) / along
        seen[0], seen[1], seen[2] = _folded(after[0], flat, fold), _folded(after[1], flat, fold), after[2]
        turned, out = faced(new, seen, contact, bend, MOST_LEAN)
        square = (first_drawn / seen[0]) ** 2 + (second_drawn / seen[1]) ** 2
        slid = 1 - max(along_itself * min(np.sqrt(np.sum(carried**2)) / cap, 1.0), min(lost, along_itself))
        if np.abs(turned - last).max() + abs(slid - last_slid) < SETTLED:
            break
    if by_force:
        grown = wants = carries / slid
    rubs, offset, turns = in_space(carried, new, seen, leaned(contact, turned), contact, origin, arm_of_turn)
    part = np.zeros(3)
    for j in range(len(new)):
        part += SLID[j] * new[j]
    slid_offset, slid_turn = way_of_skin(part, seen, contact, arm_of_turn)
    stored = stored / fold + max(0.5 * (1 + grown * slid) * size * out, 0.0)
    lean = grown * slid * size * turned
    held, total = min(after[0], last_held) if last_held > 0 else 0.0, 0.0
    for x in range(3):
        total += new[:, x].sum() ** 2
    if held > 0 and total > 0:  # what is new is held at what the patch is now
        old = held / last_held * np.exp(-rolled) * np.sqrt(np.sum(before**2) / total)
        held = after[0] + min(old, 1.0) * (held - after[0])
    else:
        held = after[0]
    push = grown * slid * wrench + wrench_at(lean, arm)
    drags = np.sqrt(carried[0] ** 2 + carried[1] ** 2)
    off = (wants - grown + past) * size
    if cap > 0:
        off += SPUN * abs(carried[2]) * drags / cap
    return (push, rubs, share, offset, turns, lean, grown, slid_offset, slid_turn, cap, after, new, kept, stored, slid,
            held, room, passed, contact, off)  # fmt: skip
