# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that tell what tools do: wrenches, depths, bounds, and what may be believed of them: stmpl_core.toucher."""

import math
from typing import Any

import warp as wp

from stmpl_core import pieces, soundness, toucher
from stmpl_core import wrenches as wrenches_of_skin
from stmpl_core.gpu.blocks import least_of, most_of, sum_of
from stmpl_core.gpu.columns import TOO_DEEP, _mark, _marked
from stmpl_core.gpu.packs import BONY_BIT, BORDER_BIT, LONG_BIT, STEEP_BIT, Scratch, Skins
from stmpl_core.gpu.places import APART, BY_POSE, DEEP, REFUSED, WRAPPED
from stmpl_core.gpu.rays import FAR, OPTIONS, real, vec3, way_of
from stmpl_core.obstacle import REACH
from stmpl_core.sdf import DEEP_CORNER

HALF_REACH = wp.constant(wp.float64(0.5 * REACH))
STEEP, LONG, BORDER = wp.constant(STEEP_BIT), wp.constant(LONG_BIT), wp.constant(BORDER_BIT)
BONY, BONY_SHARE = wp.constant(BONY_BIT), wp.constant(wp.float64(soundness.BONY_SHARE))
STEEP_SHARE, LONG_SHARE = wp.constant(wp.float64(soundness.STEEP_SHARE)), wp.constant(wp.float64(soundness.LONG_SHARE))
BORDER_SHARE = wp.constant(wp.float64(soundness.BORDER_SHARE))
AROUND, UNSEEN = wp.constant(wp.float64(toucher.MAX_AROUND)), wp.constant(wp.float64(toucher.MAX_UNSEEN_FORCE_SHARE))
SIDES = wp.constant(wp.vec2d(*toucher.SIDES))
SHELL, SHELL_FROM = wp.constant(wp.float64(toucher.SHELL)), wp.constant(wp.float64(toucher.SHELL_FROM))
SHALLOW, SHALLOW_TO = wp.constant(wp.float64(toucher.SHALLOW)), wp.constant(wp.float64(toucher.SHALLOW_TO))
FAR_OFF = wp.constant(wp.float64(toucher.FAR))
UNSOLVED, MOST_MORE = wp.constant(wp.float64(toucher.UNSOLVED)), wp.constant(wp.float64(toucher.MOST_MORE))
STUCK, WIDER = wp.constant(wp.float64(toucher.STUCK)), wp.constant(wp.float64(pieces.WIDER))
GROUP, PINS_DEEP = wp.constant(wp.float64(pieces.GROUP)), wp.constant(wp.float64(pieces.DEEP))
PIECE = wp.constant(wp.float64(2.0 / 3.0**0.5 * pieces.SPACINGS**2))
NEAR_PIECE = wp.constant(wp.float64(pieces.NEAR))
MORE = wp.constant(wp.float64(wrenches_of_skin.MORE))
LEAST_COSINE = wp.constant(wp.float64(wrenches_of_skin.LEAST_COSINE))
ONE_WAY = wp.constant(wp.float64(wrenches_of_skin.ONE_WAY))
ALL_ONE_WAY = wp.constant(wp.float64(wrenches_of_skin.ALL_ONE_WAY))
NONE = wp.constant(wp.float64(1e-300))
NAN, PI = wp.constant(wp.float64(float("nan"))), wp.constant(wp.float64(math.pi))
LED_DEEP, LED_LOST = (wp.constant(wp.float64(one)) for one in (toucher.LED_DEEP, toucher.LED_LOST))
LED_OUT, LED_FROM, MOST_LED = (wp.constant(wp.float64(one)) for one in (toucher.LED_OUT, toucher.LED_FROM,
                                                                        toucher.MOST_LED))  # fmt: skip
THIN_FROM, THIN_MORE, THIN_TO, LOW = (
    wp.constant(wp.float64(one)) for one in (toucher.THIN_FROM, toucher.THIN_MORE, toucher.THIN_TO, toucher.LOW)
)
EDGE_SURE = wp.constant(wp.float64(toucher.EDGE_SURE))
EDGE_OFF, MOST_LACKING = wp.constant(wp.float64(toucher.EDGE_OFF)), wp.constant(wp.float64(toucher.MOST_LACKING))
SURE, MOST_OFF = wp.constant(wp.float64(toucher.SURE)), wp.constant(wp.float64(toucher.MOST_OFF))
TIP_FROM, CORNER_TO = wp.constant(wp.float64(toucher.TIP_FROM)), wp.constant(wp.float64(DEEP_CORNER))
FIRST, TWICE_FIRST = wp.constant(wp.float64(toucher.FIRST)), wp.constant(wp.float64(2 * toucher.FIRST))
vec16 = wp.types.vector(length=16, dtype=wp.float64)
wp.set_module_options(OPTIONS)


@wp.kernel
def find_highest(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Highest pressure over E at the corners around each node."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        highest, corners = real(0.0), skins.faces[scratch.face[s, i]]
        for x in range(3):
            force = real(0.0)
            for j in range(scratch.nodes[s]):
                if scratch.tool[s, j] == scratch.tool[s, i]:
                    others = skins.faces[scratch.face[s, j]]
                    for y in range(3):
                        if others[y] == corners[x]:
                            force += scratch.pressure[s, j] * scratch.area[s, j] * scratch.shares[s, j][y]
            highest = wp.max(highest, force / skins.area[corners[x]])
        scratch.highest[s, i] = highest


@wp.func
def _ball(scratch: Scratch, s: wp.int32, k: wp.int32, reach: real) -> wp.vec4d:
    """Middle of a tool's nodes, and how far it is felt; below 0: it has none."""
    middle, count, far = vec3(), real(0.0), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            middle = middle + scratch.point[s, i]
            count += real(1.0)
    if count == real(0.0):
        return wp.vec4d(real(0.0), real(0.0), real(0.0), real(-1.0))
    middle = middle / count
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            far = wp.max(far, wp.length(scratch.point[s, i] - middle))
    return wp.vec4d(middle[0], middle[1], middle[2], far + reach)


@wp.kernel
def group(many: wp.int32, skins: Skins, scratch: Scratch):
    """Numbers of groups of tools, between which none feels another: toucher.groups_of."""
    s = wp.tid()
    reach = HALF_REACH * skins.one[scratch.skin[s * many]].thickest
    for k in range(many):
        scratch.group[s * many + k] = k
    for k in range(many):
        one = _ball(scratch, s, k, reach)
        for n in range(k):
            other = _ball(scratch, s, n, reach)
            away = wp.length(vec3(one[0] - other[0], one[1] - other[1], one[2] - other[2]))
            if one[3] > real(0.0) and other[3] > real(0.0) and away < one[3] + other[3]:
                old, new = wp.int32(scratch.group[s * many + k]), wp.int32(scratch.group[s * many + n])
                for m in range(many):
                    if scratch.group[s * many + m] == old:
                        scratch.group[s * many + m] = new


@wp.func
def _power(scratch: Scratch, s: wp.int32, k: wp.int32) -> real:
    """Power of the depth with which the force of a tool grows."""
    deepest, found, force = real(0.0), real(0.0), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            deepest = wp.max(deepest, scratch.wanted[s, i])
            found += scratch.found_power[s, i]
            force += scratch.force[s, i]
    return deepest * found / wp.max(force, NONE)


@wp.func
def _missed(scratch: Scratch, s: wp.int32, many: wp.int32, k: wp.int32) -> real:
    """How far the linear problem of a tool's group is from solved, over the deepest, at most 1."""
    deepest, missed = real(1e-300), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.group[s * many + scratch.tool[s, i]] == scratch.group[s * many + k]:
            deepest = wp.max(deepest, scratch.wanted[s, i])
            missed = wp.max(missed, scratch.gap[s, i])
    return wp.min(missed / deepest, real(1.0))


@wp.func
def _scene_status(scratch: Scratch, s: wp.int32, many: wp.int32) -> wp.int32:
    """REFUSED if a tool is, else what a tool is not served for, else below REFUSED."""
    out = wp.int32(-1)
    for k in range(many):
        status = scratch.status[s * many + k]
        if status == REFUSED:
            return REFUSED
        out = wp.max(out, status)
    return out


@wp.struct
class Known:
    """Of a network's card: factor and power of the bound and what uneven limbs add, largest p/E and depth learnt."""

    scale: real
    power: real
    uneven: real
    pressure: real
    depth: real


@wp.func
def _along(area_vector: vec3, way: vec3) -> real:
    """Force along a way that skin carries along itself, for a pressure [m2]: wrenches.along."""
    area, out = wp.length(area_vector), real(0.0)
    cosine = -wp.dot(area_vector, way) / wp.max(area, NONE)
    if cosine > real(0.0):
        out = MORE * area * wp.max(real(1.0) - cosine * cosine, real(0.0)) / wp.max(cosine, LEAST_COSINE)
    return out


@wp.kernel
def find_beside(lanes: wp.int32, many: wp.int32, scratch: Scratch):
    """Bits of the nodes of the same tool that are of one piece with each."""
    s, lane = wp.tid()
    count = scratch.nodes[s]
    words = (count + 31) // 32
    for n in range(lane, count * words, lanes):
        i, w, bits = n // words, n % words, wp.uint32(0)
        for j in range(32 * w, wp.min(32 * w + 32, count)):
            if scratch.tool[s, i] == scratch.tool[s, j] and \
                    wp.length_sq(scratch.point[s, i] - scratch.point[s, j]) < PIECE * scratch.area[s, i]:
                bits = bits | (wp.uint32(1) << wp.uint32(j - 32 * w))
        scratch.beside[s, i, w] = bits
    for n in range(lane, many * words, lanes):
        scratch.reached[s * many + n // words, n % words] = wp.uint32(0)


@wp.func
def _lowest(bits: wp.uint32) -> wp.int32:
    """Number of the lowest bit that is set."""
    n, rest = wp.int32(0), wp.uint32(bits)
    while (rest & wp.uint32(1)) == wp.uint32(0):
        rest = rest >> wp.uint32(1)
        n += 1
    return n


@wp.func
def _number_pieces(scratch: Scratch, c: wp.int32, s: wp.int32, k: wp.int32) -> wp.int32:
    """Numbers the pieces that a tool's nodes lie in, and says how many there are."""
    nodes, found, last = scratch.nodes[s], wp.int32(0), wp.int32(0)
    for n in range(nodes):
        if scratch.tool[s, n] < k:
            last += 1  # the queues of tools lie one after the other
    for n in range(nodes):
        if scratch.tool[s, n] == k and not _marked(scratch.reached, c, n):
            first = wp.int32(last)
            scratch.fold[s, n] = found
            scratch.queue[s, last] = n
            _mark(scratch.reached, c, n)
            last += 1
            while first < last:
                i = scratch.queue[s, first]
                first += 1
                for w in range((nodes + 31) // 32):
                    bits = scratch.beside[s, i, w] & ~scratch.reached[c, w]
                    scratch.reached[c, w] = scratch.reached[c, w] | bits
                    while bits != wp.uint32(0):
                        j = 32 * w + _lowest(bits)
                        bits = bits & (bits - wp.uint32(1))
                        scratch.fold[s, j] = found
                        scratch.queue[s, last] = j
                        last += 1
            found += 1
    return found


@wp.func
def _pins(scratch: Scratch, c: wp.int32, s: wp.int32, k: wp.int32, lane: wp.int32) -> wp.vec2d:
    """Force beside each piece of a tool over its own, and radius of a piece [m]: pieces.pins."""
    beside, size, total, found = real(0.0), real(0.0), real(0.0), real(0.0)
    if lane == 0:
        found = real(_number_pieces(scratch, c, s, k))
    found = sum_of(found)
    if found < real(2.0):
        return wp.vec2d(real(0.0), real(0.0))
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        if scratch.tool[s, i] != k:
            continue
        own, other, wide = real(0.0), real(0.0), real(0.0)
        near = NEAR_PIECE * scratch.thick[s, i]
        for j in range(scratch.nodes[s]):
            if scratch.tool[s, j] == k:
                force = scratch.pressure[s, j] * scratch.area[s, j]
                if scratch.fold[s, i] == scratch.fold[s, j]:
                    own += force
                    wide += scratch.area[s, j]
                elif wp.length_sq(scratch.point[s, i] - scratch.point[s, j]) < near * near:
                    other += force
        force = scratch.pressure[s, i] * scratch.area[s, i]
        beside += force * other / wp.max(own, NONE)
        size += force * wp.sqrt(wide / PI)
        total += force
    sums = sum_of(vec3(beside, size, total))
    return wp.vec2d(sums[0], sums[1]) / wp.max(sums[2], NONE)


@wp.func
def _off(skins: Skins, grid: wp.int32, at: vec3) -> real:
    """How far a distance field is off at the place beside a point of the tool's frame [m]: stmpl_core.sdf.mean_off."""
    least, off = real(1e30), real(0.0)
    for j in range(skins.checks.shape[1]):
        one = skins.checks[grid, j]
        square = wp.length_sq(vec3(one[0], one[1], one[2]) - at)
        if square < least:
            least = square
            off = one[3]
    return off


@wp.func
def _lacking(skins: Skins, scratch: Scratch, c: wp.int32, s: wp.int32, k: wp.int32, way: vec3, depth: real,
             lane: wp.int32) -> real:  # fmt: skip
    """How much deeper a tip is than a tool is known to be [m]: stmpl_core.sdf.lacking."""
    many = skins.tip_many[scratch.grid[c]]
    if many == 0:
        return real(0.0)
    wide, lowest, most = real(0.0), real(1e30), real(0.0)
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        if scratch.tool[s, i] == k:
            wide = wp.max(wide, real(2.0) * wp.sqrt(scratch.area[s, i]))
            lowest = wp.min(lowest, wp.dot(way, scratch.point[s, i]))
    wide = most_of(wide)
    lowest = least_of(lowest)
    for j in range(lane, many, wp.block_dim()):
        tip = skins.tips[scratch.grid[c], j]
        at = scratch.pose[c] * vec3(tip[0], tip[1], tip[2]) + scratch.place[c]
        if wp.min(tip[3], wp.dot(way, at) - lowest - depth) > most:
            least, deep = (wide + tip[3]) * (wide + tip[3]), real(0.0)
            for i in range(scratch.nodes[s]):
                if scratch.tool[s, i] == k:
                    to = at - scratch.point[s, i]
                    along = wp.dot(way, to)
                    square = wp.length_sq(to) - along * along
                    if square < least:
                        least = square
                        deep = along
            most = wp.max(most, wp.min(deep - depth, tip[3]))
    return most_of(most)


@wp.func
def _deepest_corner(skins: Skins, scratch: Scratch, c: wp.int32, s: wp.int32, k: wp.int32, lane: wp.int32) -> wp.vec2d:
    """Depth of the deepest corner [m], and over the thickness there: stmpl_core.sdf.deepest_corner."""
    wide, deep, most = real(0.0), real(0.0), real(0.0)
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        if scratch.tool[s, i] == k:
            wide = wp.max(wide, real(4.0) * scratch.area[s, i])
    wide = most_of(wide)
    for j in range(lane, skins.corner_many[scratch.grid[c]], wp.block_dim()):
        at = scratch.pose[c] * vec3(skins.corners[scratch.grid[c], j]) + scratch.place[c]
        least, own, share = real(wide), real(0.0), real(0.0)
        for i in range(scratch.nodes[s]):
            if scratch.tool[s, i] == k:
                to = at - scratch.point[s, i]
                into = wp.dot(to, scratch.inward[s, i])
                square = wp.length_sq(to) - into * into
                if square < least and into > real(0.0) and into < CORNER_TO * scratch.thick[s, i]:
                    least = square
                    own = into
                    share = into / scratch.thick[s, i]
        if share > most:
            most = share
            deep = own
    highest = most_of(most)
    return wp.vec2d(most_of(wp.where(most == highest, deep, real(0.0))), highest)


@wp.func
def _led_in(scratch: Scratch, s: wp.int32, k: wp.int32, way: vec3, lane: wp.int32) -> real:
    """Share of its depth in columns by which the nodes of a thin tool sink with it: stmpl_core.toucher._led_in."""
    sunk, deep = real(0.0), real(1e-300)
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        if scratch.tool[s, i] == k:
            cosine = wp.dot(scratch.inward[s, i], way)
            sunk = wp.max(sunk, scratch.sinking[s, i])
            deep = wp.max(deep, scratch.strain[s, i] * scratch.thick[s, i] * cosine * cosine)
    sunk = most_of(sunk)
    deep = most_of(deep)
    lost, whole = real(0.0), real(0.0)
    for i in range(lane, scratch.nodes[s], wp.block_dim()):
        if scratch.tool[s, i] == k:
            cosine = wp.dot(scratch.inward[s, i], way)
            depth = scratch.strain[s, i] * scratch.thick[s, i] * cosine * cosine
            if depth > LED_DEEP * deep:
                lost += wp.max(depth - scratch.sinking[s, i], real(0.0))
                whole += depth
    sums = sum_of(wp.vec2d(lost, whole))
    led = sunk / deep
    if sums[0] > LED_LOST * sums[1]:
        led = wp.min(led, real(1.0) - sums[0] / sums[1])
    return wp.clamp(led, real(0.02), real(1.0))


@wp.kernel
def answer(first: wp.int32, many: wp.int32, known: Known, skins: Skins, scratch: Scratch,
           wrenches: wp.array3d(dtype=Any), depths: wp.array2d(dtype=Any), bounds: wp.array2d(dtype=Any),
           in_range: wp.array2d(dtype=wp.bool), statuses: wp.array2d(dtype=wp.int32)):  # fmt: skip
    """What each tool does, and whether it may be believed."""
    c, lane = wp.tid()
    lanes = wp.block_dim()
    s, k = c // many, c % many
    n, one, grid = first + s, skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]]
    whole = _scene_status(scratch, s, many)
    if lane > 0 and (whole >= REFUSED or scratch.status[c] == APART):
        return
    if whole >= REFUSED:
        for x in range(6):
            wrenches[n, k, x] = wrenches.dtype(real(0.0))
            if whole >= DEEP:
                wrenches[n, k, x] = wrenches.dtype(NAN)
        depths[n, k] = depths.dtype(NAN)
        bounds[n, k] = bounds.dtype(NAN)
        in_range[n, k] = False
        statuses[n, k] = whole
        return
    if scratch.status[c] == APART:
        for x in range(6):
            wrenches[n, k, x] = wrenches.dtype(real(0.0))
        depth = -scratch.nearest[c]
        if -depth >= one.hole:
            depth = scratch.around[c]
        if depth < real(-0.5) * FAR:
            depth = NAN
        around = scratch.around[c] > AROUND * one.thickest
        off = scratch.place[c] - skins.points[one.first]
        far = wp.max(wp.max(wp.abs(off[0]), wp.abs(off[1])), wp.abs(off[2])) > FAR_OFF
        statuses[n, k] = APART
        if around:
            statuses[n, k] = WRAPPED
        depths[n, k] = depths.dtype(depth)
        bounds[n, k] = bounds.dtype(real(0.0))
        may = -depth < grid.mostly_off and grid.mostly_off > TWICE_FIRST * one.thickest
        in_range[n, k] = not around and not far and not may and scratch.misses[c] == 0
        return
    force, torque, forces, strange, doubt = vec3(), vec3(), real(0.0), real(0.0), real(0.0)
    total, below, wrong = real(0.0), real(0.0), real(0.0)
    steep, long, border, bony, highest = real(0.0), real(0.0), real(0.0), real(0.0), real(0.0)
    depth, thick, count, carried = real(scratch.deep[c]), real(0.0), real(0.0), real(0.0)
    for i in range(lane, scratch.nodes[s], lanes):
        if scratch.tool[s, i] == k:
            here, corners = scratch.pressure[s, i] * scratch.area[s, i], skins.faces[scratch.face[s, i]]
            for x in range(3):
                v, part = corners[x], here * scratch.shares[s, i][x]
                push = -part / skins.area[v] * skins.area_vectors[v]
                total += wp.length(push)
                below += part * skins.facets[v]
                force = force + push
                torque = torque + wp.cross(skins.points[v] - scratch.place[c], push)
                if (skins.doubts[v] & STEEP) != 0:
                    steep += part
                if (skins.doubts[v] & LONG) != 0:
                    long += part
                if (skins.doubts[v] & BORDER) != 0:
                    border += part
                if (skins.doubts[v] & BONY) != 0:
                    bony += part
            forces += here
            if grid.surface_error > SURE * real(scratch.deep[c]):
                at = wp.transpose(scratch.pose[c]) * (scratch.point[s, i] - scratch.place[c])
                wrong += here * _off(skins, scratch.grid[c], at)
            strange += here * scratch.strange[s, i]
            doubt += scratch.error[s, i] * scratch.area[s, i]
            depth = wp.max(depth, scratch.strain[s, i] * scratch.thick[s, i])
            thick += scratch.thick[s, i]
            carried += here * scratch.thick[s, i]
            count += real(1.0)
            highest = wp.max(highest, scratch.highest[s, i])
    sums = sum_of(vec16(force[0], force[1], force[2], forces, strange, doubt, total, below, steep, long, border, bony,
                        thick, count, carried, wrong))  # fmt: skip
    force, forces, strange, doubt = vec3(sums[0], sums[1], sums[2]), sums[3], sums[4], sums[5]
    total, below, steep, long, border, bony = sums[6], sums[7], sums[8], sums[9], sums[10], sums[11]
    thick, count, carried = sums[12], sums[13], sums[14]
    depth = most_of(depth)
    highest = most_of(highest)
    size = wp.length(force)
    along = real(0.0)
    if one.stacked == 1 and size > real(0.0):
        way = force / size
        share = wp.clamp((size / total - ONE_WAY) / (ALL_ONE_WAY - ONE_WAY), real(0.0), real(1.0))
        for i in range(lane, scratch.nodes[s], lanes):
            if scratch.tool[s, i] == k:
                trio, pressure = skins.faces[scratch.face[s, i]], scratch.pressure[s, i] * scratch.area[s, i]
                for x in range(3):
                    pressed = pressure * scratch.shares[s, i][x] / skins.area[trio[x]]
                    more = share * pressed * _along(skins.area_vectors[trio[x]], way)
                    along += more
                    torque = torque + wp.cross(skins.points[trio[x]] - scratch.place[c], more * way)
    more_sums = sum_of(wp.vec4d(torque[0], torque[1], torque[2], along))
    pins = _pins(scratch, c, s, k, lane)
    led, lack = real(1.0), real(0.0)
    if size > SIDES[1] * forces:
        lack = _lacking(skins, scratch, c, s, k, force / size, depth, lane)
        if one.stacked == 1:
            led = _led_in(scratch, s, k, force / size, lane)
    tip = wp.vec2d(real(0.0), real(0.0))
    if size > real(0.0) and depth * forces > TIP_FROM * carried:
        tip = _deepest_corner(skins, scratch, c, s, k, lane)
    if lane > 0:
        return
    torque = vec3(more_sums[0], more_sums[1], more_sums[2])
    along = more_sums[3]
    force = force + along / wp.max(size, NONE) * force
    power, missed = _power(scratch, s, k), _missed(scratch, s, many, k)
    doubt = doubt / wp.max(size, NONE) + power * grid.surface_error / wp.max(wp.max(depth, grid.surface_error), NONE)
    thicker = real(0.0)
    if one.stacked == 1 and forces > real(0.0):
        thicker = wp.log(carried / (forces * one.flat))
        unlike = known.uneven * thicker
        doubt = wp.sqrt(doubt * doubt + unlike * unlike)
    size += along
    sound = steep <= STEEP_SHARE * forces and long <= LONG_SHARE * forces and border <= BORDER_SHARE * forces
    sound = sound and bony <= BONY_SHARE * forces
    sound = sound and one.softness * highest <= known.pressure and depth * count <= known.depth * thick
    sound = sound and strange <= UNSEEN * forces and one.learnt == 1
    sound = sound and depth <= one.soft and missed <= UNSOLVED
    sound = sound and (size <= SIDES[0] * forces or size >= SIDES[1] * forces)
    group = pins[0] > GROUP and depth > PINS_DEEP * pins[1]
    sound = sound and not group
    sound = sound and skins.holes[k] == 0
    if size > real(0.0):
        sound = sound and tip[1] <= TOO_DEEP
        least = LED_FROM * carried / forces
        sound = sound and (real(1.0) - led) * depth <= (real(1.0) - LED_OUT) * wp.max(depth, least)
        sound = sound and thicker <= one.thicker[2]
        sound = sound and lack <= EDGE_OFF * wp.max(depth + lack, FIRST * carried / forces)
    wrong = real(0.0)
    if size > real(0.0) and grid.surface_error > SURE * depth:
        wrong = sums[15] / forces
        sound = sound and wrong <= MOST_OFF * wp.max(depth, FIRST * carried / forces)
    for x in range(3):
        wrenches[n, k, x] = wrenches.dtype(one.modulus * force[x])
        wrenches[n, k, 3 + x] = wrenches.dtype(one.modulus * torque[x])
    depths[n, k] = depths.dtype(depth)
    bounds[n, k] = bounds.dtype(real(0.0))
    if size > real(0.0):
        bound = one.doubt * known.scale * wp.pow(doubt, known.power)
        bound += power * wp.min(wrong / wp.max(depth, NONE), real(1.0))
        below /= wp.max(forces, NONE)
        if one.stacked == 1:
            if led < LED_OUT:
                bound += wp.exp(wp.min(-power * wp.log(wp.max(led, NONE)), MOST_LED)) - real(1.0)
            bound += SHELL * wp.max(-scratch.given_way[c] - SHELL_FROM, real(0.0))
            bound += one.thicker[1] * wp.max(thicker - one.thicker[0], real(0.0))
            thin = wp.clamp(depth / wp.max(grid.half, NONE) - THIN_FROM, real(0.0), THIN_TO)
            sunk, box = way_of(scratch.top[c]), grid.high - grid.low
            high = wp.abs(sunk[1]) * box[0] + wp.abs(sunk[2]) * box[1] + wp.abs(sunk[3]) * box[2]
            low = wp.clamp(LOW * (real(1.0) - high / wp.max(depth, NONE)), real(0.0), real(1.0))
            bound += sunk[0] * low * THIN_MORE * thin
        else:
            bound += SHALLOW * wp.max(real(1.0) - depth * forces / (SHALLOW_TO * carried), real(0.0))
        lacks = wp.max(wp.min(lack / wp.max(depth + lack, NONE), MOST_LACKING) - EDGE_SURE, real(0.0))
        bound += wp.pow(real(1.0) - lacks, -power) - real(1.0)
        if tip[1] > TOO_DEEP and tip[0] > depth:
            bound += wp.exp(wp.min(power * wp.log(tip[0] / depth), MOST_MORE)) - real(1.0)
        flat = below / wp.max(depth, NONE)
        flat = power * wp.log(real(1.0) + flat + flat * wp.min(flat, real(1.0)))
        bound += STUCK * along / size + wp.exp(wp.min(flat, MOST_MORE)) - real(1.0)
        if missed > UNSOLVED:
            bound += real(1.0) + power * missed
        if group:
            bound *= WIDER
        bounds[n, k] = bounds.dtype(one.modulus * size * bound)
    in_range[n, k] = sound
    statuses[n, k] = BY_POSE


for one in (wp.float32, wp.float64):
    wp.overload(answer, {"wrenches": wp.array3d(dtype=one), "depths": wp.array2d(dtype=one),
                         "bounds": wp.array2d(dtype=one)})  # fmt: skip
