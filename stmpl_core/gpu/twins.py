# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels of tools that are in one place: stmpl_core.twins."""

import warp as wp

from stmpl_core import twins
from stmpl_core.gpu.conforms import ONE_WAY
from stmpl_core.gpu.field_packs import FieldScratch
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import BY_POSE
from stmpl_core.gpu.rays import (
    CLEAR,
    MORE_UPRIGHT,
    MOST_STRAIN,
    OPTIONS,
    SLANT,
    STEEP,
    depth_and_share,
    depth_in_column,
    distance_at,
    innermost,
    jet_at,
    led_in,
    real,
    strain_under,
    vec3,
    wall_in,
    way_of,
)

PLACE, HERE, SEEN = (wp.constant(wp.float64(most * most / 3**0.5)) for most in (twins.APART, twins.HERE, twins.AROUND))
COVERED, GIVES = wp.constant(wp.float64(twins.COVERED)), wp.constant(wp.float64(twins.GIVES))
wp.set_module_options({**OPTIONS, "max_unroll": 4})


@wp.func
def _apart(scratch: Scratch, s: wp.int32, i: wp.int32, j: wp.int32, most: real) -> real:
    """Squared distance of two nodes over one of their lattices, 1 where they face apart: twins._apart."""
    over = wp.length_sq(scratch.point[s, i] - scratch.point[s, j]) / (most * (scratch.area[s, i] + scratch.area[s, j]))
    if wp.dot(scratch.inward[s, i], scratch.inward[s, j]) <= real(0.0):
        return real(1.0)
    return wp.min(over, real(1.0))


@wp.func
def _ended(skins: Skins, scratch: Scratch, c: wp.int32, other: wp.int32, start: vec3, way: vec3, s: real, wall: real):
    """Share to which tool c has ended at s along a ray, and another is not there beyond its wall: nodes._ended."""
    grid, at = skins.grids[scratch.grid[c]], start + s * way
    jet = jet_at(grid, skins.coefficients, at)
    ended = real(0.0)
    if jet[0] > real(-0.5) * wall:
        at = at + (real(0.5) * wall - wp.min(jet[0], real(0.0))) * vec3(jet[1], jet[2], jet[3])
        at = wp.transpose(scratch.pose[other]) * (scratch.pose[c] * at + scratch.place[c] - scratch.place[other])
        beyond = distance_at(skins.grids[scratch.grid[other]], skins.coefficients, at)
        gap = wp.max(jet[0], real(0.0)) + wp.max(beyond + real(0.5) * wall, real(0.0))
        ended = wp.min(real(2.0) * gap / wall, real(1.0))
    return ended


@wp.kernel
def go_on(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Strains of nodes where another tool goes on at a wall of their own: nodes.strains_beside."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        c, t = s * many + scratch.tool[s, i], scratch.thick[s, i]
        for k in range(many):
            other = s * many + k
            if other != c and scratch.status[other] == BY_POSE and scratch.group[other] == scratch.group[c]:
                grid, top, point = skins.grids[scratch.grid[c]], scratch.top[c], scratch.point[s, i]
                there = wp.transpose(scratch.pose[other]) * (point - scratch.place[other])
                if distance_at(skins.grids[scratch.grid[other]], skins.coefficients, there) <= STEEP * t:
                    pose, wall, now = wp.transpose(scratch.pose[c]), wall_in(grid, t), real(0.0)
                    start, way = pose * (point - scratch.place[c]), pose * scratch.inward[s, i]
                    deep, share = depth_and_share(grid, skins.coefficients, start, way, t, top)
                    if deep > wall:
                        ended = _ended(skins, scratch, c, other, start, way, deep - wall, wall)
                        now = real(1.0) - ended * wp.min(deep / wall - real(1.0), real(1.0))
                        now = now * share * wp.min(deep / t, MOST_STRAIN)
                    sunk = way_of(top)
                    goes = vec3(sunk[1], sunk[2], sunk[3])
                    cosine = wp.dot(goes, way)
                    if share < real(1.0) and cosine > SLANT:
                        inside = innermost(grid, skins.coefficients, start, goes, t)
                        ended = _ended(skins, scratch, c, other, start, goes, inside[1], wall)
                        most = sunk[0] * (real(1.0) - ended) * wp.min((cosine - SLANT) / MORE_UPRIGHT, real(1.0))
                        if most > share:
                            ends = start + vec3()
                            if inside[0] <= CLEAR * wall:
                                ends = led_in(grid, skins.coefficients, start, goes, inside, wall)
                            deep = depth_in_column(grid, skins.coefficients, ends, goes, t, real(0.0)) * cosine
                            now += (most - share) * wp.min(deep / t, MOST_STRAIN)
                    scratch.strain[s, i] = wp.max(scratch.strain[s, i], now)


@wp.kernel
def crowd(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """What tools that cover the same skin do at a node together, over what its own does there: twins.crowded."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        times, over = real(1.0), real(1.0)
        for k in range(many):
            c = s * many + k
            if k != scratch.tool[s, i] and scratch.status[c] == BY_POSE:
                pose = wp.transpose(scratch.pose[c])
                start, way = pose * (scratch.point[s, i] - scratch.place[c]), pose * scratch.inward[s, i]
                share = strain_under(skins.grids[scratch.grid[c]], skins.coefficients, start, way,
                                     scratch.thick[s, i], scratch.top[c])  # fmt: skip
                share = wp.min(share / scratch.strain[s, i], real(1.0))
                over += share
                if share > real(0.0) and scratch.force[s, i] > real(0.0):
                    sum, area = real(0.0), real(1e-300)
                    for j in range(scratch.nodes[s]):
                        if scratch.tool[s, j] == k:
                            near = real(1.0) - _apart(scratch, s, i, j, HERE)
                            sum += near * scratch.force[s, j]
                            area += near * scratch.area[s, j]
                    times += share * sum / area * scratch.area[s, i] / scratch.force[s, i]
        scratch.times[s, i] = times
        scratch.over[s, i] = over


@wp.kernel
def cover(pick: wp.array(dtype=wp.int32), many: wp.int32, scratch: Scratch, field: FieldScratch):
    """How much of what each tool covers each other one covers too: twins.covered."""
    t, other = wp.tid()
    k, s, total, both = t % many, pick[t // many], real(0.0), real(0.0)
    if other != k:
        for i in range(scratch.nodes[s]):
            if scratch.tool[s, i] == k:
                own, its = real(0.0), real(0.0)
                for j in range(scratch.nodes[s]):
                    if scratch.tool[s, j] == k or scratch.tool[s, j] == other:
                        seen = scratch.area[s, j] * (real(1.0) - _apart(scratch, s, i, j, SEEN))
                        if scratch.tool[s, j] == k:
                            own += seen
                        else:
                            its += seen
                deep = scratch.area[s, i] * scratch.strain[s, i]
                total += deep
                both += deep * wp.min(its / own, real(1.0))
    x = real(0.0)
    if total > real(0.0):
        x = wp.max(both / total - COVERED, real(0.0)) / (real(1.0) - COVERED)
    field.covers[t, other] = x * x * (real(3.0) - real(2.0) * x)


@wp.kernel
def go_together(many: wp.int32, field: FieldScratch):
    """Tools that cover the same skin go the way of the force that they share: twins.going_together."""
    t = wp.tid()
    first, push, shares = t - t % many, vec3(field.push[t]), real(0.0)
    for k in range(many):
        share = wp.min(field.covers[t, k], field.covers[first + k, t % many])
        push = push + share * field.push[first + k]
        shares += share
    if shares > real(0.0) and field.one_way[t] == 1 and wp.length_sq(push) > real(0.0):
        way = wp.normalize(push)
        if wp.dot(way, field.way[t]) > ONE_WAY:
            field.way[t] = way


@wp.kernel
def trace(lanes: wp.int32, field: FieldScratch):
    """How much each node goes its own way under a force E, in three directions."""
    f, lane = wp.tid()
    for a in range(lane, field.holds[f], lanes):
        field.own_way[f, a] = wp.trace(field.block[f, a, a])


@wp.kernel
def give_way(pick: wp.array(dtype=wp.int32), lanes: wp.int32, scratch: Scratch, field: FieldScratch):
    """Nodes of two tools in one place give way to what their forces differ by: twins.give_way."""
    f, lane = wp.tid()
    s = pick[f]
    for a in range(lane, field.holds[f], lanes):
        i, sum = wp.int32(field.hold[f, a]), real(0.0)
        for b in range(field.holds[f]):
            j = wp.int32(field.hold[f, b])
            if scratch.tool[s, i] != scratch.tool[s, j] and scratch.fold[s, i] == scratch.fold[s, j]:
                left = real(1.0) - _apart(scratch, s, i, j, PLACE)
                if left > real(0.0):
                    gives = GIVES * left * left * (field.own_way[f, a] + field.own_way[f, b]) / real(6.0)
                    field.block[f, a, b] = field.block[f, a, b] - gives * wp.identity(n=3, dtype=real)
                    sum += gives
        field.block[f, a, a] = field.block[f, a, a] + sum * wp.identity(n=3, dtype=real)
