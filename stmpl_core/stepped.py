"""Stepped: one step of time, friction and the balance of energy for the tools of one scene, compiled.

See stmpl_core.history for what it means. It takes some numbers of each contact as a whole, a row of PATCH, and rows of
what is remembered (stmpl_core.state.Memory), so that a scene's answers and thousands of scenes on a GPU go one way.
"""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.balance import MUCH, UNSURE, settled, work_of
from stmpl_core.footing import (
    HELD_OFF,
    aged,
    along_tangents,
    borne,
    curvature_at,
    needed,
    part_of_way,
    patch_of,
    wrapped_in,
)
from stmpl_core.green import give_at
from stmpl_core.relaxation import depth_left, faded, let_go, shares_aside, stretch, weights
from stmpl_core.sideways import NEAR_WAYS, beside_at, interpolated, spread_out
from stmpl_core.slip import MOST_CARRIED, MOST_GROWN, SPRINGS, rub
from stmpl_core.state import FORGOTTEN, NEVER, Scalars, parts_of, trail_of
from stmpl_core.touch import MIN_ONE_WAY_SHARE
from stmpl_core.wake import let_age, pressed_on

RUBBED = 0.1  # of the force: what skin that gives way beneath a dry tool is off, as the law was learnt from what sticks
PILED = 0.5  # of drag^2 / force: error of skin that piles up; 0.7 of it on a back, where the elastic bound was 0.45
LOST = 0.5  # of what skin carries along itself: what is gone once all of it slides; 0.4 to 0.6 by slides on a forearm
UNROUND = 0.5  # of a drag by what is no circle, over how much stiffer it is than one: error of how stiff it is
ROUND = 0.5  # of a drag and the thickness over the radius it goes around: its error on one material; 0.4 by one tube
MOST_DRAGGED = 0.9  # way by which sticking skin is dragged along, over the thickness, up to which it was tried
AROUND = 1.2  # thicknesses over which what a limb gives as a whole fades, by the response of a forearm and of a tube
MOST_TAKEN = 0.9  # of its own way: how far skin takes another place along at most
MOST_TURNS = 24  # times that tools beside each other are asked
ALIKE, FINEST = 1e-3, 1e-8  # by how much ways may differ then, over them, and at least [m]
STRAYED = 0.03  # of the elastic force: part of the memory from touches out of range, beyond which an answer is, too

# What a contact is as a whole: wrench without friction 0 to 5, bound, in range, status (of those below), depth; sum of
# the forces [N], middle 11 to 13 [m], radius, lever, thickness, energy, see footing.patch_of; power of the depth, share
# that skin carries along itself, radius of all that presses [m]; how it gives, 21 to 29 [m/N], how skin bends there, 30
# to 38 [1/m]; turn and place of the pose at which it presses, 39 to 50. Factor on the pressures less 1.
# All 0 by pose: whether it is told by a wrench, and whether the law was asked for another; that wrench, 54 to 59. Turn
# and place of the stated pose, 60 to 71, read where that is another. Coefficient of friction and number of the tool's
# surface; way by which it is drawn back from the core [m]; how its forces are spread, 75 to 83, and how skin wraps it,
# see footing.wrapped_in.
PATCH = 85
POSE, FACTOR, BY_FORCE, CREEPS, STATED, STATED_POSE, FRICTION, NUMBER, BACK = 39, 51, 52, 53, 54, 60, 72, 73, 74
SPREAD = 75
APART, HOLDS = 1.0, 2.0  # statuses: a tool is off, or holds the skin; another one's wrench stays as it is
# What a step makes of it: wrench, bound, in range, status and depth, as in a PATCH; and more, see SAYS.
OUT = 10
# Factor on the pressures, factor of the balance, whether that is worth a flag; whether friction was felt; its wrench, 4
# to 9; Slip.share, .offset 11 to 13, .turn, .lean 15 to 17, .grown, .slid_offset 19 to 21, .slid_turn, .middle 23 to
# 25; way by which skin is dragged over the thickness; depth to which skin that is free has come back [m]; way of the
# contact over the skin, over its radius (footing.aged); Slip.taken, 29 to 31.
SAYS, TAKEN = 32, 29
(PRESSING, ELASTIC, LARGEST, NET, RADIUS, DEPTH, IMPRINT_FORCE, POWER, SHARE, WORK, PASSIVE, LIMIT, STRETCH, SURFACE,
 SLID, STRAYS, HELD, ROLLED, _, _, PASSED, _, _, DOUBTED) = range(len(Scalars._fields))  # fmt: skip
NO_PLACE, NO_FORCE = np.zeros(3), np.zeros(0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put(values, out):
    """Writes values (N,) to the first of another array: assignments of slices compile for seconds each."""
    for i in range(len(values)):
        out[i] = values[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put_pose(pose, row, first):
    """Writes turn and place of a pose (4, 4) to a PATCH from there on."""
    for x in range(3):
        row[first + 9 + x] = pose[x, 3]
        for y in range(3):
            row[first + 3 * x + y] = pose[x, y]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pose_at(row, first):
    """Pose (4, 4) whose turn and place a PATCH has from there on."""
    out = np.eye(4)
    for x in range(3):
        out[x, 3] = row[first + 9 + x]
        for y in range(3):
            out[x, y] = row[first + 3 * x + y]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slid(old):
    """See Scalars.slid, of scalars before: 1 where the tool did not press."""
    return old[SLID] if old[PRESSING] > 0 else 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sunk(scalars):
    """See Memory.sunk."""
    return scalars[ELASTIC] > FORGOTTEN * scalars[LARGEST]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pressing(forces, area):
    """Sum of forces (N,) [N], and radius of a circle as large as the areas (N,) [m2] that press [m]."""
    total, wide = 0.0, 0.0
    for n in range(len(forces)):
        total += forces[n]
        wide += area[n] if forces[n] > 0 else 0.0
    return total, np.sqrt(wide / np.pi)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gone(before, after, point):
    """Way of a tool's point, that is at `point` (3,) before, between poses (4, 4), (3,) [m]."""
    out = np.empty(3)
    for x in range(3):
        out[x] = after[x, 3] - point[x]
        for y in range(3):
            inside = 0.0
            for z in range(3):
                inside += before[z, y] * (point[z] - before[z, 3])
            out[x] += after[x, y] * inside
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _along(parts, wrench, shares, times, fades, dt):
    """Way that skin goes along with its tool in a step, by its two tangents, where a wrench (6,) tells the friction at
    the end of it, (2,) [m]: none once all of it slides.
    """
    _, _, old, _, contact, _, stiffness, springs, springs_relaxed = parts
    out, terms, wanted = np.zeros(2), len(times), along_tangents(wrench, contact)
    if not stiffness[0] > 0 or wanted[0] ** 2 + wanted[1] ** 2 > (MOST_CARRIED * old[LIMIT]) ** 2:
        return out
    aside, kept, gain = shares_aside(fades, old[RADIUS], terms), np.empty(terms), np.empty(terms)
    for x in range(2):
        drawn, left, over = np.sum(springs[:, x]), 0.0, 1.0
        weights(times, dt, 0.0, drawn, np.sum(springs_relaxed[:, :, x], axis=1), kept, gain)
        for i in range(terms):
            left, over = left + aside[i] * kept[i], over - aside[i] * gain[i]
        out[x] = ((wanted[x] + left) / over - drawn) / stiffness[x]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _aged(parts, told, pose, part, shares, times, fades, dt, middle, along):
    """See footing.aged: of a tool that is at a pose (4, 4) now, and held its skin for a part of the step."""
    was, _, old, relaxed, contact, imprint, stiffness, _, _ = parts
    known, held = old[PRESSING] >= 0, old[PRESSING] > 0
    goes = old[LIMIT] / stiffness[0] if stiffness[0] > 0 else 0.0
    return aged(was if told else pose, pose, imprint if told else pose, contact, known, held, old[SHARE], goes, along,
                old[RADIUS], old[PASSED : PASSED + 3], part, shares, times, fades, dt, old[ELASTIC], relaxed,
                middle)  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _taken(rows, k, terms, patches, table, modulus):
    """Way by which what other tools drag takes the skin under one along, (3,) [m].

    As far as flat skin takes it along (sideways.beside), and what a limb gives beyond that, as a whole. What each would
    take the other along by its own force is alike, as linear skin has it (Maxwell, Betti): thickness and give are the
    mean of both, and places are where the skin under them came from, which no drag moves.

    Args:
        rows: rows of Memory, (R, .).
        k: number of the one.
        terms: P.
        patches: rows of PATCH, (K, .): how thick the layer is under each, and how it gives beyond a flat one; of a tool
            that is not among them as under the one.
        table, modulus: see sideways.beside.
    """
    out, (_, _, own, _, contact, _, stiffness, held, _) = np.zeros(3), parts_of(rows[k], terms)
    for other in range(len(rows)):
        _, _, its, _, there, _, stiff, springs, _ = parts_of(rows[other], terms)
        if other == k or not (stiff[0] > 0 and stiffness[0] > 0):
            continue
        o = other if other < len(patches) and patches[other, 16] > 0 else k
        thickness = 0.5 * (patches[k, 16] + patches[o, 16])
        give = (0.5 * (patches[k, 21:30] + patches[o, 21:30])).reshape(3, 3)
        pull, away, faces, far, on = np.zeros(3), np.zeros(3), 0.0, 0.0, 0.0
        for x in range(3):
            y, z = (x + 1) % 3, (x + 2) % 3
            across = there[1, y] * there[2, z] - there[1, z] * there[2, y]
            aside = contact[1, y] * contact[2, z] - contact[1, z] * contact[2, y]
            first, second = np.sum(springs[:, 0]) * there[2, x], np.sum(springs[:, 1]) * across
            pull[x] = first + second
            came = first / stiff[0] + second / stiff[1]
            own_came = np.sum(held[:, 0]) * contact[2, x] / stiffness[0] + np.sum(held[:, 1]) * aside / stiffness[1]
            away[x] = there[0, x] - came - contact[0, x] + own_came
            faces, far = faces + there[1, x] * contact[1, x], far + away[x] ** 2
        far = np.sqrt(far)
        if not (faces > 0 and pull.any() and far < NEAR_WAYS[-1] * thickness):
            continue
        wide = np.sqrt(0.5 * (own[RADIUS] ** 2 + its[RADIUS] ** 2))
        along, across = beside_at(table, wide, far, thickness)
        along, across, fade = along / (modulus * thickness), across / (modulus * thickness), np.exp(
            -far / (AROUND * thickness))  # fmt: skip
        most = max(give[0, 0], give[1, 1], give[2, 2], 0.0) * fade + max(along, across)
        by = faces * min(MOST_TAKEN / (np.sqrt(stiff[0] * stiffness[0]) * most), 1.0)
        for x in range(3):
            on += pull[x] * away[x] / max(far, 1e-12)
        for x in range(3):
            whole = give[x, 0] * pull[0] + give[x, 1] * pull[1] + give[x, 2] * pull[2]
            out[x] += by * (across * pull[x] + (along - across) * on * away[x] / max(far, 1e-12) + fade * whole)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def asked_for(row, pose, wrench, shares, times, fades, dt):
    """What elastic skin is asked for, as a factor on a stated wrench (6,), 0: as it is stated; and the way along its
    force at which the tool pressed before, NaN if it did not [m].

    Args:
        row: what is remembered.
        pose: stated pose, (4, 4).
        shares, times, fades: series of the relaxation, (P,) each, and see relaxation.faded.
        dt: time of the step [s].
    """
    parts = parts_of(row, len(times))
    was, _, old, _, contact, imprint, _, _, _ = parts
    slid, size, along, way = _slid(old), 0.0, 0.0, 0.0
    if not (len(times) or slid < 1):
        return 0.0, np.nan
    unknown, goes = np.full(3, np.nan), _along(parts, wrench, shares, times, fades, dt)
    _, _, _, _, owed, now, _ = _aged(parts, old[PRESSING] > NEVER, pose, 1.0, shares, times, fades, dt, unknown, goes)
    for x in range(3):
        size += wrench[x] ** 2
        along += wrench[x] * contact[1, x]
        way += (imprint[x, 3] - was[x, 3]) * wrench[x]
    size = np.sqrt(size)
    wanted = (along if old[RADIUS] > 0 else size) / (old[NET] * slid)
    if not wanted > 0:
        return 0.0, np.nan
    return (wanted + old[STRETCH] * owed) / (wanted * now * slid), way / size if old[PRESSING] > 0 else np.nan


@numba.njit(cache=True, nogil=True, error_model="numpy")
def asked_again(row, pose, wrench, asked, push, forces, points, area, thickness, depth, shares, times, fades, dt):
    """Factor on the wrench that elastic skin was asked for, where the contact's normal or its way over the skin turned
    out to be another; 0: what it says fits.

    Args:
        row, pose, wrench, shares, times, fades, dt: see `asked_for`.
        asked: wrench that the skin was asked for, (6,).
        push: force with which it answers, (3,) [N].
        forces, points, area, thickness: see footing.patch_of.
        depth: depth of the contact [m].
    """
    parts, terms = parts_of(row, len(times)), len(times)
    old, size, thick, carried, middle = parts[2], 0.0, 0.0, 0.0, np.zeros(3)
    has, radius = _pressing(forces, area)
    for n in range(len(forces)):
        thick += forces[n] * thickness[n]
        for x in range(3):
            middle[x] += forces[n] / has * points[n, x]
    for x in range(3):
        size, carried = size + push[x] ** 2, carried + asked[x] * push[x]
    size = np.sqrt(size)
    if not size > 0:
        return 0.0
    goes = _along(parts, wrench, shares, times, fades, dt)
    _, _, _, gain, owed, _, _ = _aged(parts, old[PRESSING] > NEVER, pose, 1.0, shares, times, fades, dt, middle, goes)
    now, more = 1.0, faded(fades, radius)
    for i in range(terms):
        now -= more * shares[i] * gain[i]
    takes = needed(wrench, push, size, has, stretch(depth, thick / has), owed, now, _slid(old))
    if size < (1 - 1e-6) * carried / size or not takes > 0 or abs(takes / has - 1) < HELD_OFF:
        return 0.0
    return takes / has


@numba.njit(cache=True, nogil=True, error_model="numpy")
def tell(wrench, bound, in_range, depth, pose, stated, stated_pose, by_force, creeps, friction, number, out):
    """Writes what an elastic touch is to a PATCH, but for what `whole_of` does.

    Args:
        wrench, bound, in_range, depth, pose: see Touch.
        stated, stated_pose: stated wrench, (6,), read where it is told `by_force`; and pose, (4, 4).
        by_force, creeps, friction, number: see PATCH.
        out: row of PATCH, all 0 before.
    """
    out[6], out[9], out[FRICTION], out[NUMBER] = bound, depth, friction, number
    out[7] = 1.0 if in_range else 0.0
    _put(wrench, out)
    _put_pose(pose, out, POSE)
    _put_pose(stated_pose, out, STATED_POSE)
    if by_force:
        out[BY_FORCE], out[CREEPS] = 1.0, 1.0 if creeps else 0.0
        _put(stated, out[STATED:])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def whole_of(points, area, thickness, depth, forces, corners, shares, power, along, factor, way, rubs, frames,
             curvature, vertex_thickness, gives, turns, modulus, out):  # fmt: skip
    """Writes what a contact is as a whole to a PATCH that has its wrench, if it presses.

    Args:
        points, area, thickness, depth, forces: see footing.patch_of.
        corners, shares: see Nodes.
        power, along, factor: see Pressed.
        way: by which the tool is drawn back from the core [m].
        rubs: whether there is friction; how skin gives and bends is not told without.
        frames, curvature, vertex_thickness: see moments.Surroundings.
        gives, turns: see green.give_at; the former empty where a contact gives as on a flat layer.
        modulus: Young's modulus by which these give [Pa].
        out: row of PATCH.
    """
    out[8], size = HOLDS, np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if not (size > 0 and len(forces)):
        return
    normal = out[:3] / size
    middle, radius, lever, mean, energy = patch_of(points, area, thickness, depth, forces, normal)
    _put(middle, out[11:14])
    out[14], out[15], out[16], out[17], out[18], out[19] = radius, lever, mean, energy, power, along
    out[10], out[20] = _pressing(forces, area)
    out[FACTOR], out[BACK] = factor - 1, way
    if rubs:
        bend = curvature_at(corners, shares, forces, frames, curvature, vertex_thickness)
        _put(bend.ravel(), out[30:39])
        spread, out[SPREAD + 9] = wrapped_in(points, depth, forces, normal)
        _put(spread.ravel(), out[SPREAD : SPREAD + 9])
        if len(gives):
            _put((give_at(corners, shares, forces, gives, turns) / modulus).ravel(), out[21:30])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def step(patches, before, after, grooves, shares, times, fades, has_skin, table, log_thickness, logs, modulus, slack,
         beside, dt, out, says):  # fmt: skip
    """One step of K tools of a scene, tool by tool, then what all together have of energy; `doubted` ends it.

    Tools that drag the skin beside each other are asked in turn until they agree how far each takes the others along.

    Args:
        patches: rows of PATCH, (K, .).
        before: what is remembered, (R, .); of tools that are not told of any more, too, from K on: after a time they
            are gone.
        after: the same, written: what is after the step.
        grooves: whether rows end in a trail.
        shares, times, fades: series of the relaxation, (P,) each, and see relaxation.faded.
        has_skin: whether the layer has a skin of its own.
        table, log_thickness, logs, modulus, slack: see Sideways.
        beside: see sideways.beside; read where several tools rub.
        dt: time of the step [s].
        out, says: rows of OUT and SAYS, (K, .), written.

    Returns:
        plain: whether `doubted` has nothing to say of answers that are in range: they are of one tool that was, too.
    """
    tools, terms = len(patches), len(times)
    stored, sure, whole = np.zeros(tools), np.zeros(tools), np.zeros(tools)
    works, givens, doubts, spares = np.zeros(tools), np.zeros(tools), np.zeros(tools), np.zeros(tools)
    for k in range(len(before)):
        _put(before[k], after[k])
        if k >= tools and dt > 0:
            _left(before[k], after[k], grooves, shares, times, dt)
    takes, was, now, turn, differ = np.zeros((tools, 3)), np.zeros((tools, 3)), np.zeros(3), 0, 1.0
    left = np.zeros(tools)
    while turn < MOST_TURNS and differ > 0:
        differ = 0.0
        for k in range(tools):
            rubs = len(before) > 1 and patches[k, FRICTION] > 0 and patches[k, 16] > 0
            pressed = rubs and parts_of(before[k], terms)[2][PRESSING] > 0
            now[:] = 0.0
            if pressed and turn == 0:
                was[k] = _taken(before, k, terms, patches, beside, modulus)
            if rubs and parts_of(after[k], terms)[2][PRESSING] > 0:
                now = _taken(after, k, terms, patches, beside, modulus)
                if not pressed:  # it comes to skin that has gone along
                    was[k] = now
            size = off = 0.0
            for x in range(3):
                size, off = size + now[x] ** 2, off + (now[x] - takes[k, x]) ** 2
            left[k] = np.sqrt(off)
            if turn == 0 or off > ALIKE**2 * size + FINEST**2:
                differ, says[k, :] = 1.0 if rubs else differ, 0.0
                _put(now, takes[k])
                _put(patches[k, :OUT], out[k])
                _put(before[k], after[k])
                stored[k], sure[k], whole[k], works[k], doubts[k], givens[k] = _one(
                    patches[k], before[k], after[k], grooves, shares, times, fades, has_skin, table, log_thickness,
                    logs, modulus, slack, dt, now, now - was[k], out[k], says[k])  # fmt: skip
        turn += 1
    for k in range(tools):
        if turn == MOST_TURNS and differ > 0:  # they did not agree
            out[k, 6] += left[k] * parts_of(after[k], terms)[6][0]
        old, new = parts_of(before[k], terms)[2], parts_of(after[k], terms)[2]
        first, work = not old[PRESSING] >= 0 or patches[k, BY_FORCE] > 0, works[k] + old[WORK]
        works[k] = max(work, stored[k] if first else min(stored[k], work + doubts[k]))
        spares[k] = UNSURE * new[LARGEST] * new[DEPTH]
    factors = settled(works, givens, spares, sure, whole)
    for k in range(tools):
        parts, passive = parts_of(after[k], terms), factors[k]
        new = parts[2]
        if passive < 1:
            square = 0.0
            for x in range(3):
                square += (out[k, x] - says[k, 4 + x]) ** 2
            less = (1 - passive) * np.sqrt(square)
            out[k, 6] = out[k, 6] * passive + less
            for x in range(6):
                out[k, x] *= passive
                says[k, 4 + x] *= passive
                parts[1][x] = out[k, x]
            for x in range(15, 18):
                says[k, x] *= passive
            if less > MUCH * new[LARGEST]:
                out[k, 7], says[k, 2] = 0.0, 1.0
        new[WORK], new[PASSIVE], says[k, 1] = works[k], passive, passive
        says[k, 0] *= passive
    plain = len(before) == 1
    for k in range(tools):
        old = parts_of(before[k], terms)[2]
        plain = plain and not (old[STRAYS] > 0 or old[DOUBTED] > 0)
    return plain


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _strayed(old, dt, times, gone, has, had, presses):
    """What is left of Scalars.strayed after a step in range, at most [N].

    Args:
        old: scalars before.
        dt: time of the step [s].
        times: times of the relaxation, (P,) [s].
        gone: way of the contact over the skin, over its radius [-].
        has, had: force that has relaxed, now and before [N].
        presses: whether the tool presses: what is new is in range then.
    """
    if not old[STRAYS] > 0:
        return 0.0
    if presses:
        return max(min(old[STRAYS] * np.exp(-dt / times[len(times) - 1] - gone), has), 0.0)
    return old[STRAYS] * max(has, 0.0) / max(had, 1e-300)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def doubted(before, after, shares, times, dt, possible, out, says):
    """What of the answers of a step rests on touches out of range, and what tools feel of what others let go.

    Writes out[:, 7] where an answer is out of range for that, and bounds.

    Args:
        possible: force that each tool that presses nothing may press with [N], (K,).
        before, after, shares, times, dt, out, says: see `step`.
    """
    tools, terms = len(out), len(times)
    for k in range(tools):
        (_, _, old, had_relaxed, _, _, _, _, _) = parts_of(before[k], terms)
        (_, _, new, relaxed, _, _, _, _, _) = parts_of(after[k], terms)
        has, had, more, doubts = 0.0, 0.0, 0.0, not out[k, 7] > 0
        for i in range(terms):
            has += shares[i] * relaxed[i]
            had += shares[i] * had_relaxed[i]
            more -= shares[i] * np.expm1(-dt / times[i])
        strayed = _strayed(old, dt, times, says[k, 28], has, had, new[PRESSING] > 0)
        if doubts or old[DOUBTED] > 0:  # what this step may have added rests on one of its ends
            most = max(new[ELASTIC], old[ELASTIC])
            if not (new[PRESSING] > 0 or old[PRESSING] > 0):  # a wrench that found no skin
                most = min(most, possible[k])
            strayed = min(strayed + most * more, max(has, 0.0))
        new[STRAYS], new[DOUBTED] = strayed, 1.0 if doubts else 0.0
        if (new[PRESSING] > 0 or _sunk(new)) and strayed > STRAYED * new[ELASTIC] > 0:
            out[k, 7] = 0.0
    for k in range(tools):
        (_, _, new, _, contact, _, _, _, _) = parts_of(after[k], terms)
        owed = 0.0
        for other in range(len(after)):
            (_, _, its, relaxed, there, _, _, _, _) = parts_of(after[other], terms)
            if out[k, 8] == HOLDS and other != k and not its[PRESSING] > 0 and _sunk(its):
                far = 0.0
                for x in range(3):
                    far += (there[0, x] - contact[0, x]) ** 2
                near = max(1 - np.sqrt(far) / (new[RADIUS] + its[RADIUS]), 0.0)
                for i in range(terms):
                    owed += near * shares[i] * relaxed[i]
        out[k, 6] += max(owed, 0.0) * new[STRETCH] * new[NET]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one(patch, before, after, grooves, shares, times, fades, has_skin, table, log_thickness, logs, modulus, slack, dt,
         taken, takes, out, says):  # fmt: skip
    """One tool. Writes its memory and its rows.

    Args:
        taken: way by which what other tools drag takes its skin along, after the step, (3,) [m].
        takes: the same in the step.
        other: see `step`.

    Returns:
        stored, sure, whole: energy that the contact could give back, that it surely does, and that it could hold [J].
        work, doubt, given: see balance.work_of [J].
    """
    terms, by_force, mu = len(times), patch[BY_FORCE] > 0, patch[FRICTION]
    parts, news = parts_of(before, terms), parts_of(after, terms)
    was, wrench_before, old, relaxed, contact, _, stiffness, springs, springs_relaxed = parts
    pose, told, held = _pose_at(patch, POSE), old[PRESSING] > NEVER, old[PRESSING] > 0
    stated_pose = _pose_at(patch, STATED_POSE) if by_force or patch[BACK] > 0 else pose
    push, size = patch[:3].copy(), np.sqrt(patch[0] ** 2 + patch[1] ** 2 + patch[2] ** 2)
    presses, depth, power = patch[8] == HOLDS and patch[10] > 0 and size > 0, patch[9], patch[18]
    middle, goes = np.full(3, np.nan), np.full(2, np.nan)
    if presses:
        _put(patch[11:14], middle)
    if by_force:
        _put(_along(parts, patch[STATED : STATED + 6], shares, times, fades, dt), goes)
    twist, gone, kept, gain, owed, _, passed = _aged(
        parts, told, stated_pose, 1.0, shares, times, fades, dt, middle, goes)  # fmt: skip
    if presses and old[PRESSING] == 0 and terms and not by_force:  # it came late in the step: from then on it relaxes
        way = -_gone(stated_pose, was, patch[11:14])
        part = part_of_way(way, push / size, depth, patch[20], power)
        _, gone, kept, gain, owed, _, passed = _aged(
            parts, told, stated_pose, part, shares, times, fades, dt, middle, goes)  # fmt: skip
    says[28], asked = gone, 0.0
    if presses:
        slid_before = _slid(old)
        force, elastic, at_rest, net, long, there, eased, stored, sure, whole, doubt = borne(
            push, patch[11:14], patch[14], patch[16], patch[17], patch[10], depth, power, 1 + patch[FACTOR],
            patch[BACK], contact, held, fades, kept, gain, owed, shares, patch[STATED : STATED + 6], patch[CREEPS] > 0,
            slid_before)  # fmt: skip
        asked = at_rest
        if force > 0:
            new, changed = news[2], force / elastic
            wrench = changed * patch[:6]
            share, limit, slid, held_at, room = 1.0, 0.0, 1.0, 0.0, NO_PLACE
            news[6][:] = 0.0
            if grooves and terms:
                trail, came = trail_of(after, terms), contact[0] if held else there[0]
                pressed_on(trail, shares, times, dt, pose, there[0], there[1], eased, at_rest, depth, power, 1 - long,
                           patch[14], came)  # fmt: skip
            if mu > 0 and net > MIN_ONE_WAY_SHARE:
                bend, give = patch[30:39].copy().reshape(3, 3), patch[21:30].copy().reshape(3, 3)
                along, turn, bare = interpolated(table, log_thickness, logs, patch[14], patch[16])
                spread = patch[SPREAD : SPREAD + 9].copy().reshape(3, 3)
                longer, uneven, axis, apart = spread_out(patch[15], spread, there, patch[14])
                unit, turn = modulus * patch[14], (turn + along * apart) * patch[14] ** 2
                along, bare, both = along * longer, bare * longer, np.sqrt(uneven)
                if uneven > 1:  # softer along its axis, and stiffer across
                    for x in range(3):
                        for y in range(3):
                            flat = (x == y) - there[1, x] * there[1, y]
                            more = (1 / both - 1) * flat + (both - 1 / both) * axis[x] * axis[y]
                            give[x, y] += more / (along * unit)
                (wrench, rubs, share, offset, turned, lean, grown, slid_offset, slid_turn, limit, stiff, drawn,
                 drawn_relaxed, bent, slid, held_at, room, passed, there, besides) = rub(
                    wrench, patch[STATED : STATED + 6], by_force, there, pose[:3, 3].copy(), bend, give, mu,
                    LOST * patch[19], patch[SPREAD + 9] * spread, force, patch[15], at_rest,
                    depth, patch[14], patch[16], power, along * unit, turn * unit, bare * unit,
                    slack * patch[14], twist, takes, old[PRESSING] >= 0, held, contact, old[ELASTIC], slid_before,
                    old[HELD], old[LIMIT], old[ROLLED : ROLLED + 3].copy(), passed, springs, springs_relaxed,
                    stiffness, shares_aside(fades, patch[14], terms), times, dt)  # fmt: skip
                changed, doubt = grown * changed, grown * doubt
                drag = rubs[0] ** 2 + rubs[1] ** 2 + rubs[2] ** 2
                besides += UNROUND * (longer - 1) * (1 - share) * np.sqrt(drag)
                pressing = np.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
                if has_skin:
                    besides += RUBBED * pressing + PILED * drag / pressing
                elif drag > 0:
                    around = 0.0
                    for x in range(3):
                        for y in range(3):
                            around += rubs[x] * bend[x, y] * rubs[y]
                    besides += ROUND * patch[16] * max(around, 0.0) / np.sqrt(drag)
                dragged = np.sqrt(np.sum(offset**2)) / patch[16]
                if dragged > MOST_DRAGGED or (grown >= MOST_GROWN and not by_force):
                    out[7] = 0.0
                says[3], says[10], says[14], says[18] = 1.0, share, turned, grown
                says[22], says[26] = slid_turn, dragged
                _put(rubs, says[4:10])
                for x in range(3):
                    says[11 + x], says[15 + x], says[19 + x] = offset[x], lean[x], slid_offset[x]
                    says[TAKEN + x] = taken[x]
                    bent += 0.5 * rubs[x] * taken[x]
                wrench = wrench + rubs
                stored, sure, whole = stored + bent, sure + bent, whole + 2 * bent
                _put(stiff, news[6])
                for x in range(SPRINGS):
                    _put(drawn[x], news[7][x])
                    for i in range(terms):
                        _put(drawn_relaxed[i, x], news[8][i, x])
                out[6] = (out[6] * changed + doubt if changed != 1 or doubt else out[6]) + max(besides, 0.0)
            elif changed != 1 or doubt:
                out[6] = out[6] * changed + doubt
            says[0] = changed
            _put(there[0], says[23:26])
            _put(wrench, out)
            work_before, largest = old[WORK], old[LARGEST]
            new[:] = 0.0
            new[PRESSING], new[PASSIVE], new[WORK], new[SURFACE] = 1.0, 1.0, work_before, patch[NUMBER]
            new[ELASTIC], new[IMPRINT_FORCE], new[LARGEST] = at_rest, at_rest, max(at_rest, largest)
            new[NET], new[RADIUS], new[DEPTH], new[POWER], new[STRETCH] = net, patch[14], depth, power, long
            new[SHARE], new[LIMIT], new[SLID], new[HELD] = share, limit, slid, held_at
            for x in range(3):
                new[ROLLED + x], new[PASSED + x] = room[x], passed[x]
                _put(there[x], news[4][x])
            _put(wrench, news[1])
            _put(eased, news[3])
            for x in range(4):
                _put(stated_pose[x], news[0][x])
                _put(pose[x], news[5][x])
            work, unsure, given = work_of(
                twist, wrench_before, wrench, contact, there, stated_pose[:3, 3].copy(), held, np.bool_(True),
                old[NET] * old[STRETCH], net * long, old[PASSIVE], relaxed, eased, shares, old[DEPTH], depth, power,
                patch[14])  # fmt: skip
            return stored, sure, whole, work, unsure, given
    if patch[8] == HOLDS:
        out[:7] = 0.0
        out[7], out[8] = 1.0, APART
    way_free = 1.0
    if asked == 0 and held and old[RADIUS] > 0:
        way = _gone(was, stated_pose, contact[0])
        way_free = part_of_way(way, -contact[1], old[DEPTH], old[RADIUS], old[POWER])
    _back(parts, news, grooves, after, shares, times, dt, gone, held, asked, way_free)
    new, eased = news[2], news[3]
    new[PRESSING] = 0.0
    _put(out[:6], news[1])
    for x in range(4):
        _put(stated_pose[x], news[0][x])
        if not told:
            _put(stated_pose[x], news[5][x])
    share = new[ELASTIC] / new[IMPRINT_FORCE] if new[ELASTIC] > 0 else 0.0
    says[27] = new[DEPTH] * depth_left(share, new[POWER], 1 - new[STRETCH])
    work, unsure, given = work_of(
        twist, wrench_before, out[:6], contact, contact, stated_pose[:3, 3].copy(), held, np.bool_(False),
        old[NET] * old[STRETCH], new[NET] * new[STRETCH], old[PASSIVE], relaxed, eased, shares, old[DEPTH], new[DEPTH],
        new[POWER], new[RADIUS])  # fmt: skip
    return 0.0, 0.0, 0.0, work, unsure, given


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _back(parts, news, grooves, after, shares, times, dt, gone, held, asked, part):
    """Skin that comes back by itself.

    Where the tool lets it go it is as deep as the tool, from there on it comes back as its force does: what is left
    of a load that fades is the same motion, smaller.

    Args:
        parts, news: views of what is remembered before and after the step.
        grooves, after: see `step`; row.
        dt, gone, part: see relaxation.let_go.
        held: whether a tool held it, and lets it go in the step.
        asked: force at rest that the tool asks for at the end of the step [N].
    """
    old, new = parts[2], news[2]
    left, least = let_go(shares, times, dt, gone, part, old[ELASTIC] if held else 0.0, asked, parts[3])
    if old[PRESSING] > 0 and old[IMPRINT_FORCE] > 0:
        depth = old[DEPTH] * depth_left(min(least / old[IMPRINT_FORCE], 1.0), old[POWER], 1 - old[STRETCH])
        new[STRETCH] = 1 - (1 - old[STRETCH]) * depth / old[DEPTH]
        new[DEPTH], new[IMPRINT_FORCE], new[POWER] = depth, max(least, 1e-300), 1.0
    elastic = 0.0
    for i in range(len(times)):
        elastic += shares[i] * left[i]
    new[ELASTIC], new[SHARE], new[PASSIVE], new[HELD] = max(elastic, 0.0), 1.0, 1.0, 0.0
    for x in range(ROLLED, PASSED + 3):
        new[x] = 0.0
    _put(left, news[3])
    news[6][:] = 0.0
    news[7][:, :] = 0.0
    news[8][:, :, :] = 0.0
    if grooves and len(times):
        let_age(trail_of(after, len(times)), shares, times, dt)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _left(before, after, grooves, shares, times, dt):
    """The memory of a tool that is not told of any more: the skin comes back."""
    parts, news = parts_of(before, len(times)), parts_of(after, len(times))
    _back(parts, news, grooves, after, shares, times, dt, 0.0, np.bool_(False), 0.0, 1.0)
    new, has, had = news[2], 0.0, 0.0
    new[PRESSING], new[WORK] = -1.0, 0.0
    for i in range(len(times)):
        has += shares[i] * news[3][i]
        had += shares[i] * parts[3][i]
    new[STRAYS] = _strayed(parts[2], dt, times, 0.0, has, had, parts[2][PRESSING] > 0)
    news[1][:] = 0.0
