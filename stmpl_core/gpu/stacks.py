# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels of what a stack does under contact nodes: stmpl_core.green._matrix and what a ContactNet reads on a stack."""

import math

import warp as wp

from stmpl_core import columns, contact_net, green
from stmpl_core.columns import MIN_ONE_WAY_SHARE
from stmpl_core.gpu.blocks import sum_of, wait
from stmpl_core.gpu.columns import _marked
from stmpl_core.gpu.hold import FADE_RING, HARDENING, NEAR, RINGS, STACK_LINEAR_TO, STEPS, _row, _write, _write_alike
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.rays import (
    CLEAR,
    OPTIONS,
    along,
    depth_in_column,
    innermost,
    led_in,
    real,
    vec3,
    wall_in,
    way_of,
)
from stmpl_core.networks import STACK_NODE
from stmpl_core.response import SPREAD as SPREAD_OF_AREA

ONE_WAY = wp.constant(wp.float64(MIN_ONE_WAY_SHARE))
AS_ONE, EACH_ITS_OWN = (wp.constant(wp.float64(x)) for x in columns.AS_ONE)
NEAR_TOOLS, FAR_TOOLS = (wp.constant(wp.float64(x)) for x in contact_net.FAR_TOOLS)
ROWS, FARTHEST, AROUND = (wp.constant(wp.float64(x)) for x in (green.ROWS, green.FARTHEST, green.AROUND))
FIRST_LOG, STEP_LOG = wp.constant(wp.float64(green.FIRST_LOG)), wp.constant(wp.float64(green.STEP_LOG))
LAST_ROW = wp.constant(wp.float64(len(green.SPREADS) - 1.001))
DEEP_GIVES, ROUND_GIVES, ROUNDEST = (
    wp.constant(wp.float64(x)) for x in (contact_net.DEEP_GIVES, contact_net.ROUND_GIVES, contact_net.ROUNDEST)
)
SPREAD, LAST_AREA = wp.constant(wp.float64(SPREAD_OF_AREA)), wp.constant(wp.float64(green.AREAS - 1.001))
MORE_AREAS = wp.constant(wp.float64(green.AREAS - 1))
TAKEN_BACK = wp.constant(wp.float64(green.TAKEN_BACK))
ROUND_SQUARE = wp.constant(wp.float64((green.ROUND * SPREAD_OF_AREA) ** 2))
THICKNESSES, STRAINS = wp.constant(green.COLUMNS), wp.constant(green.STRAINS)
STACK_FADE = wp.constant(wp.float64(contact_net.STACK_FADE))
ROUND_FROM = wp.constant(wp.float64(contact_net.ROUND_FROM))
AT_THICKNESS, AT_COLUMN = wp.constant(STACK_NODE.at.log_thickness), wp.constant(STACK_NODE.at.column_strain)
AT_HARDENING, AT_KAPPA = wp.constant(STACK_NODE.at.hardening), wp.constant(STACK_NODE.at.log_kappa)
AT_PULL, AT_CURVATURE = wp.constant(STACK_NODE.at.log_pull), wp.constant(STACK_NODE.at.curvature)
AT_OVER, AT_GIVEN = wp.constant(STACK_NODE.at.curvature_over_strain), wp.constant(STACK_NODE.at.given_way)
AT_TURNED, AT_UNEVEN = wp.constant(STACK_NODE.at.turned), wp.constant(STACK_NODE.at.uneven)
AT_STIFFENING = wp.constant(STACK_NODE.at.stiffening)
AMONG, TURNED_FROM = wp.constant(wp.float64(contact_net.AMONG)), wp.constant(wp.float64(contact_net.TURNED_FROM))
assert math.isclose(green.SPREADS[0], math.exp(green.FIRST_LOG))
wp.set_module_options({**OPTIONS, "max_unroll": 4})


@wp.kernel
def find_mean(many: wp.int32, skins: Skins, scratch: Scratch):
    """Where the skin under each tool is pushed: columns.pushed; and the extremes of the areas of its group."""
    c = wp.tid()
    s, k = c // many, c % many
    mean, middle, total, square, thick = vec3(), vec3(), real(0.0), real(0.0), real(0.0)
    least, most = real(1e30), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            push = scratch.area[s, i] * scratch.strain[s, i] * scratch.thick[s, i]
            mean = mean + push * scratch.inward[s, i]
            middle = middle + push * scratch.point[s, i]
            thick += push * scratch.thick[s, i]
            total += push
        if scratch.group[s * many + scratch.tool[s, i]] == scratch.group[c]:
            least = wp.min(least, scratch.area[s, i])
            most = wp.max(most, scratch.area[s, i])
    middle = middle / wp.max(total, real(1e-300))
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            push = scratch.area[s, i] * scratch.strain[s, i] * scratch.thick[s, i]
            square += push * wp.length_sq(scratch.point[s, i] - middle)
    scratch.mean[c] = mean
    scratch.middle[c] = wp.vec4d(middle[0], middle[1], middle[2], wp.sqrt(square / wp.max(total, real(1e-300))))
    scratch.pushed[c] = total
    scratch.tissue[c] = thick / wp.max(total, real(1e-300))
    scratch.least_area[c] = least
    scratch.most_area[c] = most


@wp.kernel
def share_way(many: wp.int32, scratch: Scratch):
    """The way of the skin under each tool of a scene, 0 where it has none: columns.shared_pushes; and how near each
    is to each other: contact_net._near_tools."""
    s = wp.tid()
    first = s * many
    for k in range(many):
        for m in range(many):
            own, other, share = scratch.middle[first + k], scratch.middle[first + m], real(0.0)
            near, around = real(0.0), scratch.tissue[first + k] + scratch.tissue[first + m]
            pressing = scratch.pushed[first + k] > real(0.0) and scratch.pushed[first + m] > real(0.0)
            if pressing and scratch.group[first + k] == scratch.group[first + m]:
                apart = wp.length(vec3(own[0] - other[0], own[1] - other[1], own[2] - other[2]))
                share = (EACH_ITS_OWN - apart / wp.max(own[3] + other[3], real(1e-12))) / (EACH_ITS_OWN - AS_ONE)
                share = wp.clamp(share, real(0.0), real(1.0))
                near = FAR_TOOLS - apart / wp.max(own[3] + other[3] + around, real(1e-12))
                near = wp.clamp(near / (FAR_TOOLS - NEAR_TOOLS), real(0.0), real(1.0))
            if k == m:
                near = real(1.0)
            scratch.near_tools[first + k, m] = near * near * (real(3.0) - real(2.0) * near)
            scratch.as_one[first + k, m] = share * share * (real(3.0) - real(2.0) * share)
    for third in range(many):
        for k in range(many):
            for m in range(many):
                by = wp.min(scratch.as_one[first + k, third], scratch.as_one[first + third, m])
                scratch.as_one[first + k, m] = wp.max(scratch.as_one[first + k, m], by)
    for k in range(many):
        way, whole = vec3(scratch.mean[first + k]), real(scratch.pushed[first + k])
        for m in range(many):
            if m != k and scratch.as_one[first + k, m] > real(0.0):
                facing = real(2.0) * wp.dot(scratch.mean[first + k], scratch.mean[first + m])
                facing = facing / (scratch.pushed[first + k] * scratch.pushed[first + m])
                share = scratch.as_one[first + k, m] * wp.clamp(facing, real(0.0), real(1.0))
                way = way + share * scratch.mean[first + m]
                whole += share * scratch.pushed[first + m]
        if wp.length(way) <= ONE_WAY * whole:
            way = vec3()
        scratch.way[first + k] = wp.normalize(way)


@wp.kernel
def sink(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Depth by which the skin sinks at each node if it goes with its tool."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        c, depth = s * many + scratch.tool[s, i], scratch.strain[s, i] * scratch.thick[s, i]
        sinking, way = real(depth), scratch.way[c]
        if wp.length_sq(way) > real(0.0):
            pose, cosine = wp.transpose(scratch.pose[c]), wp.dot(scratch.inward[s, i], way)
            guess = wp.max(depth * cosine, real(1e-9))
            start, goes = pose * (scratch.point[s, i] - scratch.place[c]), pose * way
            grid, thick = skins.grids[scratch.grid[c]], scratch.thick[s, i]
            wall, ends = wall_in(grid, thick), start + vec3()
            most, sunk = innermost(grid, skins.coefficients, start, goes, guess), way_of(scratch.top[c])[0]
            if most[0] < CLEAR * wall and sunk > real(0.0):
                guess = wp.max(guess, thick)
                most = innermost(grid, skins.coefficients, start, goes, guess)
            sure = wp.clamp(most[0] / (CLEAR * wall), real(-1.0), real(1.0))
            if sure < real(1.0):
                ends = led_in(grid, skins.coefficients, start, goes, most, wall)
            more = depth_in_column(grid, skins.coefficients, ends, goes, wp.max(real(4.0) * guess, thick), guess)
            more = more * cosine - depth
            if more > real(0.0):
                inside = real(1.0) - along(grid, skins.coefficients, start, goes, real(0.0)) / wall
                inside = wp.max(inside, sunk * (real(1.0) + most[0] / wall))
                more = more * wp.max(sure, real(0.0)) * wp.min(wp.clamp(inside, real(0.0), real(1.0)), depth / wall)
            sinking = (real(1.0) + wp.min(sure, real(0.0))) * (depth + more)
        scratch.sinking[s, i] = sinking


@wp.kernel
def fold(many: wp.int32, skins: Skins, scratch: Scratch):
    """Numbers of groups of nodes of which none feels another, on skin with folds: thinning._together."""
    s, lane = wp.tid()
    one = skins.one[scratch.skin[s * many]]
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        scratch.fold[s, i] = -one.folded
    wait()
    if one.folded == 0 or lane > 0:
        return
    groups, left = wp.int32(0), wp.int32(scratch.nodes[s])
    for i in range(scratch.nodes[s]):
        if scratch.fold[s, i] < 0:
            scratch.fold[s, i] = groups
            scratch.queue[s, 0] = i
            done, end = wp.int32(0), wp.int32(1)
            left -= 1
            while done < end and left > 0:
                n = scratch.queue[s, done]
                done += 1
                v, group = skins.faces[scratch.face[s, n]][0], scratch.group[s * many + scratch.tool[s, n]]
                for j in range(scratch.nodes[s]):
                    if scratch.fold[s, j] < 0 and scratch.group[s * many + scratch.tool[s, j]] == group:
                        w = skins.faces[scratch.face[s, j]][0] - one.first
                        if _marked(skins.linked, v, w):
                            scratch.fold[s, j] = groups
                            scratch.queue[s, end] = j
                            end += 1
                            left -= 1
            groups += 1


@wp.kernel
def meet(many: wp.int32, skins: Skins, scratch: Scratch):
    """Coarse vertices around the nodes of a scene, each once; and those around each node, with their weights."""
    s, lane = wp.tid()
    lanes, one, count = wp.block_dim(), skins.one[scratch.skin[s * many]], wp.int32(0)
    for n in range(lane, one.coarse, lanes):
        scratch.slot[s, n] = -1
    wait()
    for i in range(lane, scratch.nodes[s], lanes):
        corners, shares, own = skins.faces[scratch.face[s, i]], scratch.shares[s, i], wp.int32(0)
        scratch.soft[s, i] = (shares[0] * skins.soft[corners[0]] + shares[1] * skins.soft[corners[1]]
                              + shares[2] * skins.soft[corners[2]])  # fmt: skip
        for q in range(9):
            v = corners[q // 3]
            n, weight, k = skins.coarse_corner[v][q % 3], shares[q // 3] * skins.coarse_share[v][q % 3], wp.int32(0)
            while k < own and scratch.slots[s, i, k] != n:
                k += 1
            if k == own:
                scratch.slot[s, n] = 0  # met by one node or by several, who all say so
                scratch.slots[s, i, k] = n
                scratch.weights[s, i, k] = real(0.0)
                own += 1
            scratch.weights[s, i, k] = scratch.weights[s, i, k] + weight
        scratch.around_node[s, i] = own
    wait()
    if lane == 0:
        for n in range(one.coarse):
            if scratch.slot[s, n] == 0:
                scratch.slot[s, n] = count
                scratch.met[s, count] = n
                count += 1
        scratch.meets[s] = count
    wait()
    for i in range(lane, scratch.nodes[s], lanes):
        for k in range(scratch.around_node[s, i]):
            n = scratch.slots[s, i, k]
            scratch.slots[s, i, k] = scratch.slot[s, n]
            scratch.parts[s, i, k] = scratch.weights[s, i, k] / skins.gathered[one.first_coarse + n]


@wp.kernel
def give_way(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """How far each node goes inwards under a pressure at each of these."""
    s, lane = wp.tid()
    one, count = skins.one[scratch.skin[s * many]], scratch.meets[s]
    for n in range(lane, scratch.nodes[s] * count, lanes):
        i, d = n // count, n % count
        sum, inward, to = real(0.0), scratch.inward[s, i], one.first_motion + scratch.met[s, d]
        for k in range(scratch.around_node[s, i]):
            row = to + 3 * one.coarse * scratch.met[s, scratch.slots[s, i, k]]
            moved = vec3(real(skins.motion[row]), real(skins.motion[row + one.coarse]),
                         real(skins.motion[row + 2 * one.coarse]))  # fmt: skip
            sum += scratch.weights[s, i, k] * wp.dot(inward, moved)
        scratch.rows[s, i, d] = sum


@wp.func
def _wide(scratch: Scratch, s: wp.int32, i: wp.int32, j: wp.int32) -> real:
    """How far node i goes inwards with the limb under a force at node j."""
    sum = real(0.0)
    for k in range(scratch.around_node[s, j]):
        sum += scratch.parts[s, j, k] * scratch.rows[s, i, scratch.slots[s, j, k]]
    return sum


@wp.func
def _together(scratch: Scratch, s: wp.int32, many: wp.int32, i: wp.int32, j: wp.int32) -> bool:
    """Whether two nodes feel each other: their tools do, and no air is between them."""
    one, other = scratch.group[s * many + scratch.tool[s, i]], scratch.group[s * many + scratch.tool[s, j]]
    return one == other and scratch.fold[s, i] == scratch.fold[s, j]


@wp.func
def _share(facing: real) -> real:
    """Share of the flat response that two places with this cosine between their normals feel: green._share."""
    x = wp.clamp(facing / AROUND, real(0.0), real(1.0))
    return x * x * (real(3.0) - real(2.0) * x)


@wp.func
def _row_of(log_spread: real) -> real:
    """Place of a spread over the thickness in the tables, from its logarithm: green._row_of."""
    return wp.clamp((log_spread - FIRST_LOG) / STEP_LOG, real(0.0), LAST_ROW)


@wp.func
def _log_spread(least: real, steps: real, n: real) -> real:
    return wp.log(SPREAD * wp.sqrt(least + n / steps))


@wp.func
def _at(skins: Skins, id: wp.int32, b: wp.int32, g: wp.int32, k: wp.int32, x: real, y: real) -> real:
    """Response of the flat stack of one softness at a place of its table."""
    first = (real(1.0) - x) * skins.green[id, b, g, k] + x * skins.green[id, b, g, k + 1]
    second = (real(1.0) - x) * skins.green[id, b, g + 1, k] + x * skins.green[id, b, g + 1, k + 1]
    return (real(1.0) - y) * first + y * second


@wp.kernel
def respond(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Depth of each node under a force E at each, and the limb's part of it, (N, N) each [1/m]."""
    s, lane = wp.tid()
    id, count = scratch.skin[s * many], scratch.nodes[s]
    one = skins.one[id]
    for n in range(lane, count * count, lanes):
        i, j = n // count, n % count
        value, both = real(0.0), real(0.0)
        c = s * many + scratch.tool[s, i]
        if _together(scratch, s, many, i, j):
            both = real(0.5) * (_wide(scratch, s, i, j) + _wide(scratch, s, j, i))
            facing = wp.dot(scratch.inward[s, i], scratch.inward[s, j])
            square = wp.length_sq(scratch.point[s, i] - scratch.point[s, j])
            f = wp.sqrt(wp.sqrt(square) / one.flat) * ROWS
            if facing > real(0.0) and f < FARTHEST:
                least, most = scratch.least_area[c], scratch.most_area[c]
                steps = MORE_AREAS / wp.max(most - least, real(1e-9) * most)
                mean = real(0.5) * (scratch.area[s, i] + scratch.area[s, j])
                a = wp.min((mean - least) * steps, LAST_AREA)
                low, share = wp.floor(a), a - wp.floor(a)
                log_spread = (real(1.0) - share) * _log_spread(least, steps, low)
                log_spread += share * _log_spread(least, steps, low + real(1.0))
                h = _row_of(log_spread - wp.log(one.flat))
                k, g = wp.int32(f), wp.int32(h)
                x, y = f - real(k), h - real(g)
                soft = real(0.5) * (scratch.soft[s, i] + scratch.soft[s, j])
                b = wp.int32(soft)
                z = soft - real(b)
                value = _at(skins, id, b, g, k, x, y)
                if z > real(0.0):
                    value += z * (_at(skins, id, b + 1, g, k, x, y) - value)
                value *= _share(facing)
                value = value / wp.sqrt(square + mean * ROUND_SQUARE)
        scratch.wide_part[s, i, j] = both
        scratch.matrix[s, i, j] = value + both


@wp.kernel
def find_kept(lanes: wp.int32, scratch: Scratch):
    """Root of the share of the limb's part that each node keeps: see green._temper."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        wide = scratch.wide_part[s, i, i]
        most, kept = TAKEN_BACK * (scratch.matrix[s, i, i] - wide), real(1.0)
        if -wide > most:
            kept = wp.sqrt(wp.max(most, real(0.0)) / -wide)
        scratch.kept[s, i] = kept


@wp.kernel
def temper(lanes: wp.int32, scratch: Scratch):
    """Leaves the limb's part at that: see green._temper."""
    s, lane = wp.tid()
    count = scratch.nodes[s]
    for n in range(lane, count * count, lanes):
        i, j = n // count, n % count
        share = scratch.kept[s, i] * scratch.kept[s, j]
        if share < real(1.0):
            scratch.matrix[s, i, j] = scratch.matrix[s, i, j] + (share - real(1.0)) * scratch.wide_part[s, i, j]
            scratch.wide_part[s, i, j] = share * scratch.wide_part[s, i, j]


@wp.kernel
def share_given_way(many: wp.int32, scratch: Scratch):
    """Share of the work of the forces of each tool and those near it that goes into the limb as a whole."""
    c, lane = wp.tid()
    s, coarse, whole = c // many, real(0.0), real(0.0)
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        force = scratch.near_tools[c, scratch.tool[s, i]] * scratch.force[s, i]
        if force > real(0.0):
            for j in range(scratch.nodes[s]):
                other = scratch.near_tools[c, scratch.tool[s, j]] * scratch.force[s, j]
                if other > real(0.0):
                    coarse += force * scratch.wide_part[s, i, j] * other
                    whole += force * scratch.matrix[s, i, j] * other
    coarse = sum_of(coarse)
    whole = sum_of(whole)
    if lane == 0:
        scratch.given_way[c] = coarse / wp.max(whole, real(1e-300))


@wp.func
def _hardening(skins: Skins, id: wp.int32, thickness: real, strain: real) -> real:
    """Value of Green.hardening at a thickness [m] and a strain."""
    first = skins.hard_logs[id, 0]
    a = (wp.log(thickness) - first) / (skins.hard_logs[id, 1] - first)
    b = wp.min(strain, real(0.999)) * real(STRAINS)
    a = wp.clamp(a, real(0.0), real(THICKNESSES) - real(1.001))
    b = wp.clamp(b, real(0.0), real(STRAINS) - real(1.001))
    i, j = wp.int32(a), wp.int32(b)
    a = a - real(i)
    b = b - real(j)
    low = (real(1.0) - b) * skins.hard[id, i, j] + b * skins.hard[id, i, j + 1]
    high = (real(1.0) - b) * skins.hard[id, i + 1, j] + b * skins.hard[id, i + 1, j + 1]
    return (real(1.0) - a) * low + a * high


@wp.kernel
def see(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """What the network reads of each node of a stack: contact_net._see_on_stack."""
    s, lane = wp.tid()
    id = scratch.skin[s * many]
    one = skins.one[id]
    t = one.effective
    for i in range(lane, scratch.nodes[s], lanes):
        moments, strains, pull, sunk = wp.vec4d(), wp.vec4d(), vec3(), vec3()
        inward, strain, thick = scratch.inward[s, i], real(scratch.strain[s, i]), scratch.thick[s, i]
        ways, logs, weights = vec3(), wp.vec2d(), real(0.0)
        for j in range(scratch.nodes[s]):
            apart = wp.length(scratch.point[s, i] - scratch.point[s, j]) / t
            facing = wp.dot(inward, scratch.inward[s, j])
            if _together(scratch, s, many, i, j) and apart < AMONG and facing > real(0.0):
                near = real(1.0) - apart * apart / (AMONG * AMONG)
                counts, log_j = near * near * scratch.force[s, j] * facing, wp.log(scratch.thick[s, j] / t)
                weights += counts
                ways = ways + counts * scratch.inward[s, j]
                logs = logs + counts * wp.vec2d(log_j, log_j * log_j)
            if _together(scratch, s, many, i, j) and apart < NEAR and facing > real(0.0):
                f, per = apart * real(STEPS), scratch.area[s, j] / (t * t)
                p = per * one.softness * scratch.force[s, j] / scratch.area[s, j]
                e = per * scratch.sinking[s, j] / scratch.over[s, j] / t
                for m in range(RINGS):
                    weight = _row(skins, one, 1 + m, f)
                    moments[m] = moments[m] + weight * p
                    strains[m] = strains[m] + weight * e
                way = _row(skins, one, 1 + RINGS, f) / t * (scratch.point[s, j] - scratch.point[s, i])
                pull = pull + p * way
                sunk = sunk + e * way
        linear = scratch.times[s, i] * scratch.force[s, i] / scratch.area[s, i]
        pressure, overlap = one.softness * linear, scratch.sinking[s, i] / t
        _write_alike(scratch, s, i, pressure, overlap, moments, strains, pull, sunk)
        corners, shares, curvature = skins.faces[scratch.face[s, i]], scratch.shares[s, i], real(0.0)
        column = vec3()
        for n in range(3):
            v = corners[n]
            column = column + shares[n] * skins.alike[v]
            curvature += real(0.5) * shares[n] * (skins.bent[v, 0] + skins.bent[v, 4] + skins.bent[v, 8])
        alike = column[0]
        _write(scratch, s, i, AT_THICKNESS, wp.log(thick / t))
        _write(scratch, s, i, AT_COLUMN, strain)
        _write(scratch, s, i, AT_HARDENING, _hardening(skins, id, alike, scratch.sinking[s, i] / thick))
        _write(scratch, s, i, AT_KAPPA, one.log_kappa)
        _write(scratch, s, i, AT_PULL, one.log_pull)
        _write(scratch, s, i, AT_CURVATURE, curvature)
        _write(scratch, s, i, AT_OVER, curvature / (overlap + ROUND_FROM))
        _write(scratch, s, i, AT_GIVEN, scratch.given_way[s * many + scratch.tool[s, i]])
        turned, uneven = real(0.0), real(0.0)
        if weights > real(0.0):
            turned, mean = wp.max(real(1.0) - wp.length(ways) / weights, real(0.0)), logs[0] / weights
            uneven = wp.sqrt(wp.max(logs[1] / weights - mean * mean, real(0.0)))
        _write(scratch, s, i, AT_TURNED, wp.log(turned + TURNED_FROM))
        _write(scratch, s, i, AT_UNEVEN, uneven)
        _write(scratch, s, i, AT_STIFFENING, column[1])
        _write(scratch, s, i, AT_STIFFENING + 1, column[2])
        solved = wp.min(strain, STACK_LINEAR_TO)
        top = _hardening(skins, id, alike, solved)
        share = (real(1.0) - DEEP_GIVES * solved) * (real(1.0) - ROUND_GIVES * wp.clamp(curvature, real(0.0), ROUNDEST))
        linear = linear * wp.exp(share * top)
        if strain > solved:
            more = _hardening(skins, id, alike, strain) - top
            linear = linear * wp.pow(strain / solved * wp.exp(more), HARDENING)
        scratch.pressure[s, i] = linear
        around = overlap + strains[FADE_RING]
        scratch.fade[s, i] = around / (around + STACK_FADE)
