"""Footing: kernels that say where a tool stands on the skin, and how it went along it in a step."""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.relaxation import decay_of_free, faded, left_over, stretch, weights

LEAST = 1e-9  # depth and radius of a contact that are none [m]
LEFT = 0.6  # of what is dragged: what a way of one radius leaves behind, far on; a ball that rolls by finite elements
ROLLED, PASSED = 0.5, 0.25  # radius of the room that a contact has rolled over, and of that it has slid over, over a
EDGE_SHARE = 0.3  # pressure over its mean from which skin counts as touched in full
ROUGH = 0.12  # error of the relaxed force, over what has relaxed: 5.4 of 45 % in trials where only the shear relaxes
SURELY = 1.25  # what a contact gives back at least, over what it does if columns' forces go as strain over stretch
HELD_OFF = 0.01  # relative error of the elastic force by wrench, from which it is asked for again


@numba.njit(cache=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _times(a, b):
    """Matrix (3, 3) times vector (3,): BLAS, called once a step, is ten times as slow."""
    return np.array([_dot(a[0], b), _dot(a[1], b), _dot(a[2], b)])


@numba.njit(cache=True, error_model="numpy")
def wrench_at(force, arm):
    """Wrench (6,) of a force (3,) that acts at the end of an arm (3,)."""
    out = np.empty(6)
    out[:3], out[3:] = force, _cross(arm, force)
    return out


@numba.njit(cache=True, error_model="numpy")
def patch_of(points, area, thickness, depth, forces, normal):
    """What a contact is as a whole: its middle (3,) [m]; the radius of a circle as large [m]; the mean distance of its
    forces from the middle [m]; its mean thickness [m]; and the energy of its forces if they grew as linear ones do,
    half the sum of each times its depth (Clapeyron) [J].
    """
    middle, total, squares, thick, energy = np.zeros(3), 0.0, 0.0, 0.0, 0.0
    for n in range(len(area)):
        energy += 0.5 * forces[n] * depth[n]
        total += forces[n]
        squares += forces[n] * forces[n] / area[n]
        thick += forces[n] * thickness[n]
        for x in range(3):
            middle[x] += forces[n] * points[n, x]
    middle /= total
    full, size, lever = EDGE_SHARE * squares / total, 0.0, 0.0
    for n in range(len(area)):
        size += min(area[n], forces[n] / full)
        square = up = 0.0
        for x in range(3):
            d = points[n, x] - middle[x]
            square += d * d
            up += d * normal[x]
        lever += forces[n] * np.sqrt(max(square - up * up, 0.0))
    radius = np.sqrt(size / np.pi)
    return middle, radius, max(lever / total, 0.1 * radius), thick / total, energy


@numba.njit(cache=True, error_model="numpy")
def needed(stated, push, size, whole, long, owed, now, slid):
    """Elastic force that a stated wrench takes, as a sum of sizes [N].

    Args:
        stated: wrench, (6,) [N, N m].
        push, size: force of the touch, (3,) [N], and its size.
        whole: sum of the sizes of its parts [N].
        long: stretch of the column under the tool [-].
        owed, now: see `aged`.
        slid: see Scalars.
    """
    return (_dot(stated, push) / size * whole / size / slid + long * owed) / now


@numba.njit(cache=True, error_model="numpy")
def borne(push, middle, radius, mean, whole, elastic, deepest, power, factor, way, before, held, fades, kept, gain,
          owed, shares, stated, creeps, slid):  # fmt: skip
    """What skin that relaxes bears of an elastic touch.

    Args:
        push: force of the touch, (3,) [N].
        middle, radius, mean, whole: see `patch_of`: its thickness is `mean`, its energy `whole`.
        elastic: sum of the sizes of the forces [N].
        deepest: depth of the tool [m].
        power, factor: see Pressed.
        way: by which the tool is drawn back from the core [m].
        before, held: contact before the step (see Memory), and whether the tool pressed there.
        fades: see relaxation.faded.
        kept, gain, owed: see `aged`.
        shares: shares of the series, (P,).
        stated: wrench that the touch carries, (6,); read where skin creeps under one.
        creeps: whether the contact law was asked for another.
        slid: see Scalars.

    Returns:
        force, elastic: sum of the sizes of the forces, relaxed and not [N]; the former is not above 0 where the skin
            came free.
        at_rest: the latter over the stretch [N].
        net, stretch: see Scalars.
        contact, relaxed: see Memory, after the step.
        stored, sure, whole: energy that the contact could give back, that it surely does, and that it could hold [J].
        doubt: error of the force that relaxing brings [N].
    """
    size = np.sqrt(_dot(push, push))
    normal = push / size
    net, long, more, now = min(size / elastic, 1.0), stretch(deepest, mean), faded(fades, radius), 1.0
    for i in range(len(shares)):
        now -= more * shares[i] * gain[i]
    force, at_rest = now * elastic - long * owed, elastic / long
    if creeps:
        asked = needed(stated, push, size, elastic, long, owed, now, slid)
        if abs(asked / elastic - 1) < 2 * HELD_OFF:
            force, at_rest = now * asked - long * owed, asked / long
    contact, relaxed, gone = np.empty((3, 3)), np.empty(len(shares)), 0.0
    contact[0] = middle + 2 * whole / elastic * normal
    contact[1], contact[2] = normal, carried_tangent(before, normal, held)
    for i in range(len(shares)):
        relaxed[i] = kept[i] + more * gain[i] * at_rest
        gone += shares[i] * relaxed[i]
    strain, left = 2 * whole / elastic / mean, left_over(gone / at_rest, power, 1 - long)
    core = 0.5 * (1 + 1 / factor) * size * way  # a force that goes straight from 1 / factor of it to all of it
    whole = whole / factor + core
    sure = core + min(SURELY * steep(strain), 1.0) * (whole - core)
    return force, elastic, at_rest, net, long, contact, relaxed, left * whole, left * sure, whole, ROUGH * long * gone


@numba.njit(cache=True, error_model="numpy")
def steep(strain):
    """Energy of a column whose force goes as its strain over its stretch, over half of its force times its way [-]."""
    x = min(strain, 0.99)
    return 2 * (1 - x) * (-x - np.log1p(-x)) / (x * x) if x > 1e-2 else 1 - x / 3


@numba.njit(cache=True, error_model="numpy")
def twist_between(start, end):
    """Way of a tool's origin and its turn as a vector, between poses (4, 4), (6,) [m, rad]."""
    out = np.empty(6)
    for x in range(3):
        out[x] = end[x, 3] - start[x, 3]
    cosine, turn = -1.0, np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                turn[a, b] += end[a, c] * start[b, c]
        cosine += turn[a, a]
    out[3], out[4], out[5] = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    sine = np.sqrt(out[3] ** 2 + out[4] ** 2 + out[5] ** 2)
    scale = np.arctan2(sine, cosine) / sine if sine > 1e-9 else 0.5
    for x in range(3, 6):
        out[x] *= scale
    return out


@numba.njit(cache=True, error_model="numpy")
def swung(turn, arm, sign):
    """How far the end of an arm (3,) goes under a turn (3,), exactly; sign 1: an arm as before it, -1: as after it."""
    size = np.sqrt(_dot(turn, turn))
    one = _cross(turn, arm)
    if size < 1e-9:
        return one
    return np.sin(size) / size * one + sign * (1 - np.cos(size)) / (size * size) * _cross(turn, one)


@numba.njit(cache=True, error_model="numpy")
def beyond(at, first, second, most):
    """Where a contact is in the room that it has been over, after a way in it; and how far it went beyond.

    What goes to and fro over the same skin meets nothing new. A room that is left grows, up to `most`, and then goes
    along: a way straight on is all beyond.

    Args:
        at: place from the room's middle, along two tangents, and the room's radius, (3,) [m].
        first, second: way along these [m].
        most: largest radius of a room [m].
    """
    room, x, y = min(at[2], most), at[0] + first, at[1] + second
    far = np.sqrt(x * x + y * y)
    over = max(far - room, 0.0)
    if over > 0:
        room = min(room + 0.5 * over, most)
        x, y = room / far * x, room / far * y
    return np.array([x, y, room]), over


@numba.njit(cache=True, error_model="numpy")
def way_of_tool(twist, known, before, held, contact, origin, depth, radius, lever, at):
    """Way of a tool along the skin and lever times its turn (3,) [m]; how far its contact rolled on, over a; and where
    that is in the room that it has rolled over, see `beyond`.

    A tool that meets the skin within a step goes along it from there on. Of a contact of radius a that has rolled by D,
    in all, a lens of the skin has been under the tool ever since, as large as a circle of a - D / pi; far on all that
    was dragged is left behind.
    """
    way, rolled, room = np.zeros(3), 0.0, np.zeros(3)
    if not known:
        return way, rolled, room
    middle, normal, first = contact
    second = _cross(normal, first)
    go = twist[:3] + swung(twist[3:], middle - origin, -1.0)
    if not held:
        go *= min(1.0, depth / max(abs(_dot(go, normal)), 1e-12))
    way[0], way[1], way[2] = _dot(go, first), _dot(go, second), lever * _dot(twist[3:], normal)
    if held:
        on = middle - before[0] - go
        room, over = beyond(at, _dot(on, first), _dot(on, second), ROLLED * radius)
        rolled = (1 / np.pi + (LEFT - 1 / np.pi) * room[2] / (ROLLED * radius)) * over / radius
    return way, rolled, room


@numba.njit(cache=True, error_model="numpy")
def curvature_at(corners, shares, forces, frames, curvature, thickness):
    """Mean curvature of skin at nodes, weighed with their forces (N,), (3, 3) [1/m]; see moments.Surroundings."""
    out, total = np.zeros((3, 3)), 0.0
    for n in range(len(corners)):
        total += forces[n]
        for a in range(3):
            v = corners[n, a]
            weight = shares[n, a] * forces[n] / thickness[v]
            xx, xy, yy = weight * curvature[v, 0], weight * curvature[v, 1], weight * curvature[v, 2]
            for x in range(3):
                p, q = xx * frames[v, 0, x] + xy * frames[v, 1, x], xy * frames[v, 0, x] + yy * frames[v, 1, x]
                for y in range(3):
                    out[x, y] += p * frames[v, 0, y] + q * frames[v, 1, y]
    return out / total if total > 0 else out


@numba.njit(cache=True, error_model="numpy")
def given_way(along, give, aim, contact):
    """Stiffness of a patch where a force (3,) along the skin aims [N/m], that of a flat layer being `along`.

    Args:
        along: stiffness on a flat layer [N/m].
        give: how the contact gives beyond that, (3, 3) [m/N].
        aim: force as in `in_plane`, of which the way matters, (3,).
        contact: see Memory.
    """
    return softened(along, along_aim(give, aim, contact))


@numba.njit(cache=True, error_model="numpy")
def along_aim(tensor, aim, contact):
    """What of a tensor (3, 3) is along a force (3,), see `given_way`; its mean along the skin where there is none."""
    first, second = contact[2], _cross(contact[1], contact[2])
    x, y = aim[0], aim[1]
    size = x * x + y * y
    if size > 0:
        way = x * first + y * second
        return _dot(way, _times(tensor, way)) / size
    return 0.5 * (_dot(first, _times(tensor, first)) + _dot(second, _times(tensor, second)))


@numba.njit(cache=True, inline="always", error_model="numpy")
def softened(along, more):
    """Stiffness of a patch that gives more than on a flat layer, where it is `along`, by so much [N/m], [m/N]."""
    return 1 / max(1 / along + more, 0.5 / along)


@numba.njit(cache=True, error_model="numpy")
def along_give(contact, give, springs, relaxed, rolled, passed):
    """A contact whose tangents are the ways in which it gives most and least, and what is told by tangents, by those.

    Args:
        contact, springs, relaxed: see Memory.
        give: how it gives beyond a flat layer, (3, 3) [m/N].
        rolled, passed: where it is in the rooms of Scalars, (3,) [m].

    Returns:
        contact, springs, relaxed, rolled, passed, turned, and the gives along both tangents, (2,) [m/N].
    """
    first, second = contact[2], _cross(contact[1], contact[2])
    along, across = _times(give, first), _times(give, second)
    a, b, c = _dot(first, along), 0.5 * (_dot(first, across) + _dot(second, along)), _dot(second, across)
    if not abs(b) > 1e-9 * max(abs(a), abs(c)):
        return contact, springs, relaxed, rolled, passed, np.array([a, c])
    angle = 0.5 * np.arctan(2 * b / (a - c)) if a != c else 0.25 * np.pi
    x, y = np.cos(angle), np.sin(angle)
    contact, springs, relaxed = contact.copy(), springs.copy(), relaxed.copy()
    contact[2] = x * first + y * second
    for j in range(len(springs)):
        springs[j, 0], springs[j, 1] = x * springs[j, 0] + y * springs[j, 1], x * springs[j, 1] - y * springs[j, 0]
        for i in range(len(relaxed)):
            one, other = relaxed[i, j, 0], relaxed[i, j, 1]
            relaxed[i, j, 0], relaxed[i, j, 1] = x * one + y * other, x * other - y * one
    rolled = np.array([x * rolled[0] + y * rolled[1], x * rolled[1] - y * rolled[0], rolled[2]])
    passed = np.array([x * passed[0] + y * passed[1], x * passed[1] - y * passed[0], passed[2]])
    return contact, springs, relaxed, rolled, passed, np.array([x * x * a + 2 * x * y * b + y * y * c,
                                                                y * y * a - 2 * x * y * b + x * x * c])


@numba.njit(cache=True, error_model="numpy")
def in_plane(wrench, contact, origin, lever):
    """Forces of friction (3,) [N] of a wrench (6,); see stmpl_core.slip."""
    middle, normal, first = contact
    turn = _dot(wrench[3:] - _cross(middle - origin, wrench[:3]), normal)
    return np.array([_dot(wrench, first), _dot(wrench, _cross(normal, first)), turn / lever])


@numba.njit(cache=True, error_model="numpy")
def faced(springs, stiffness, contact, bend, most):
    """How skin that is dragged along faced where it came from: turn of the normal as a way along the skin, (3,) [rad];
    and half of the work of a unit force through it [m].

    Skin that comes a way s around a limb of curvature B faced another way by B s, so a push N leans by N B s. What
    takes and gives that work is an energy, W(d) + N(d) s B s / 2 at a depth d, whose slope along d is the push too: it
    grows by dN/dd s B s / 2, as if the tool were s B s / 2 deeper (Maxwell's reciprocity).

    Args:
        springs, stiffness, contact: see Memory.
        bend: curvature of the skin, (3, 3) [1/m].
        most: largest turn of which note is taken [rad].
    """
    normal, first = contact[1], contact[2]
    way = springs[:, 0].sum() / stiffness[0] * first + springs[:, 1].sum() / stiffness[1] * _cross(normal, first)
    turned = _times(bend, way)
    turned -= _dot(turned, normal) * normal
    size = np.sqrt(_dot(turned, turned))
    if size > most:
        turned *= most / size
    return turned, 0.5 * _dot(turned, way)


@numba.njit(cache=True, error_model="numpy")
def wrapped_in(points, depth, forces, normal):
    """Mean products of the ways along the skin at which a contact's forces are from their middle, (3, 3) [m2]; and what
    they are times to be those of the sines by which the tool's surface turns from the push there [1/m2].

    Where skin has sunk by its depth along the push it is on the tool, of which a ball is fitted. The latter are a fifth
    of the square of the contact's radius over the ball's, each way, and 0 for what is flat.

    Args:
        points, depth: see Nodes.
        forces: forces of the nodes, (N,).
        normal: unit vector of the push, (3,).
    """
    total, middle, away, out = 0.0, np.zeros(4), np.empty(3), np.zeros((3, 3))
    for n in range(len(forces)):
        total += forces[n]
        middle[3] += forces[n] * depth[n]
        for x in range(3):
            middle[x] += forces[n] * points[n, x]
    up_mean = square_mean = both = fourth = 0.0
    for n in range(len(forces)):
        share, up = forces[n] / total, 0.0
        for x in range(3):
            away[x] = points[n, x] - middle[x] / total
            up += away[x] * normal[x]
        square = 0.0
        for x in range(3):
            away[x] -= up * normal[x]
            square += away[x] * away[x]
        up += depth[n] - middle[3] / total
        square += up * up
        for x in range(3):
            for y in range(3):
                out[x, y] += share * away[x] * away[y]
        up_mean += share * up
        square_mean += share * square
        both += share * up * square
        fourth += share * square * square
    spread = fourth - square_mean * square_mean
    bend = 2 * (both - up_mean * square_mean) / spread if spread > 0 else 0.0  # |away|^2 = 2 h up + ..., on a ball
    return out, bend * bend / (1 + bend * bend * square_mean)


@numba.njit(cache=True, error_model="numpy")
def carried_tangent(contact, normal, held):
    """The tangent (3,) of a contact after its normal turned, turned by the least; a new one where it was not held."""
    old, tangent = contact[1], contact[2].copy()
    if held:
        over = 1 + _dot(old, normal)
        up = _dot(tangent, normal)
        if over > 1e-6:
            tangent -= up / over * (old + normal)
    else:
        tangent[:] = 0.0
        tangent[np.argmin(np.abs(normal))] = 1.0
    tangent -= _dot(tangent, normal) * normal
    return tangent / np.sqrt(_dot(tangent, tangent))


@numba.njit(cache=True, error_model="numpy")
def leaned(contact, turned):
    """The contact whose normal is turned, as `faced` says: friction is along the skin, at right angles to the push."""
    out, normal = contact.copy(), contact[1] + turned
    normal /= np.sqrt(_dot(normal, normal))
    out[1], out[2] = normal, carried_tangent(contact, normal, np.bool_(True))
    return out


@numba.njit(cache=True, error_model="numpy")
def carried_more(wrench, normal, turned):
    """Factor on a push along a normal, by which one that leans carries its part of a stated wrench (6,) [-]."""
    stated = _dot(wrench, normal)
    size = 1 + _dot(turned, turned)
    return min(max((stated + _dot(wrench, turned)) / (size * stated), 0.5), 2.0) if stated > 0 else 1.0


@numba.njit(cache=True, error_model="numpy")
def in_space(forces, springs, stiffness, leaned, contact, origin, lever):
    """Wrench (6,) of forces of friction along a contact that leans, way of the skin under the tool (3,) [m], and its
    turn.
    """
    middle, normal, first = leaned
    wrench = np.empty(6)
    along = forces[0] * first + forces[1] * _cross(normal, first)
    wrench[:3], wrench[3:] = along, _cross(middle - origin, along) + forces[2] * lever * normal
    drawn = np.array([springs[:, 0].sum(), springs[:, 1].sum(), springs[:, 2].sum()])
    offset, turn = way_of_skin(drawn, stiffness, contact, lever)
    return wrench, offset, turn


@numba.njit(cache=True, error_model="numpy")
def way_of_skin(drawn, stiffness, contact, lever):
    """Way of the skin under the tool (3,) [m] and its turn, by forces of springs without relaxation, (3,) [N]."""
    first, second = contact[2], _cross(contact[1], contact[2])
    x, y = drawn[0] / stiffness[0], drawn[1] / stiffness[1]
    return x * first + y * second, drawn[2] / (stiffness[2] * lever)


@numba.njit(cache=True, error_model="numpy")
def way_along(twist, contact, pose):
    """Way along the skin, by its two tangents [m], of the place of a tool that was in the middle of its contact;
    contact: see Memory.
    """
    return along_tangents(twist[:3] + swung(twist[3:], contact[0] - pose[:3, 3], 1.0), contact)


@numba.njit(cache=True, error_model="numpy")
def along_tangents(vector, contact):
    """What of a vector (3, .) is along the two tangents of a contact, see Memory."""
    return _dot(vector, contact[2]), _dot(vector, _cross(contact[1], contact[2]))


@numba.njit(cache=True, error_model="numpy")
def part_of_way(way, normal, depth, radius, power):
    """Share of a step in which a tool is in the skin that it comes to, or leaves [-].

    Its force rises with a power of the depth, and is taken to rise straight: in a shorter time, at the end of which as
    much has been pressed.

    Args:
        way: way of its middle into the skin, or out of it, (3,) [m].
        normal: unit vector into the skin, or out of it, (3,).
        depth, radius: depth and radius of the contact that it comes to, or leaves [m].
        power: that power [-].
    """
    across, depth, radius = _dot(way, normal), max(depth, LEAST), max(radius, LEAST)
    beside = way - across * normal
    aside = np.sqrt(_dot(beside, beside))
    return min(1.0, depth / max(across, depth), radius / max(aside, radius)) * 2 / (max(power, 1.0) + 1)


@numba.njit(cache=True, error_model="numpy")
def aged(before, pose, imprint, contact, known, held, share, goes, along, radius, at, part, shares, times, fades, dt,
         elastic, relaxed, middle):  # fmt: skip
    """What a step knows of a tool before it is known what presses, and with what it presses on then.

    Its contact goes over the skin as its middle does, whatever place of the tool is there: one that rolls comes to
    other skin, and one that turns in the air, or spins without friction, does not. Skin that sticks goes with the tool.

    Args:
        before, pose: poses of the tool before the step and after it, (4, 4).
        imprint, contact, relaxed: see Memory.
        known: whether the tool was told of before.
        held: whether it pressed.
        share, radius, elastic: see Scalars.
        goes: way that skin goes along with the tool until all of it slides [m].
        along: way that it goes in the step by the friction that is told, by the tangents, (2,) [m]; not numbers: by
            pose, which tells none.
        at: where the contact is in the room that it has slid over, see `beyond`, (3,) [m].
        part: share of the step, its end, in which skin is held [-]; before that it is free.
        shares, times: series of the relaxation, (P,) each.
        fades: see relaxation.faded.
        dt: time of the step [s].
        middle: middle of the contact, (3,) [m]; not numbers: not known yet, it goes as the tool does.

    Returns:
        twist: way of the tool, (6,) [m, rad].
        gone: way of the contact over the skin, over its radius [-].
        kept: what has relaxed, less what follows from this step's force (see relaxation.weights), (P,) [N].
        gain: what follows, over that force, (P,) [-].
        owed, now: numbers a [N] and b [-] such that after the step a force at rest of S_e is b S_e - a.
        passed: where the contact is in the room that it has slid over, (3,) [m].
    """
    kept, gain, gone, owed, now = np.empty(len(times)), np.empty(len(times)), 0.0, 0.0, 1.0
    twist, passed = twist_between(before, pose) if known else np.zeros(6), np.zeros(3)
    told = not np.isnan(middle[0])
    first, second = along_tangents(middle - contact[0], contact)
    if radius > 0 and held:
        tools = way_along(twist, contact, before)
        if not told:
            first, second = tools
        square = tools[0] ** 2 + tools[1] ** 2
        takes = min(1 - share, goes / max(np.sqrt(square), 1e-300))  # of the tool's way, by the skin
        if not np.isnan(along[0]):
            takes = min(max((along[0] * tools[0] + along[1] * tools[1]) / max(square, 1e-300), 0.0), 1.0)
        passed, over = beyond(at, first - takes * tools[0], second - takes * tools[1], PASSED * radius)
        gone = over / radius
    elif radius > 0:
        if not told:
            first, second = way_along(twist_between(imprint, pose), contact, imprint)
        gone = np.sqrt(first * first + second * second) / radius
    more = faded(fades, radius)
    if part < 1:
        relaxed, elastic = decay_of_free(shares, times, (1 - part) * dt) @ relaxed, 0.0
        for i in range(len(times)):
            elastic += shares[i] * relaxed[i]
    weights(times, part * dt, gone, more * elastic, relaxed, kept, gain)
    for i in range(len(times)):
        owed += shares[i] * kept[i]
        now -= more * shares[i] * gain[i]
    return twist, gone, kept, gain, owed, now, passed
