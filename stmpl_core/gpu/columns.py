# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that find the columns of skin that a tool meets, and the triangles around them: stmpl_core.columns."""

import warp as wp

from stmpl_core import columns as of_numba
from stmpl_core import rays, sdf
from stmpl_core.columns import ALL_UNDER, LEAST_UNDER, MIN_ONE_WAY_SHARE
from stmpl_core.columns import BLOCK as IN_BLOCK
from stmpl_core.deep import DEEPEST
from stmpl_core.gpu.blocks import sum_before
from stmpl_core.gpu.packs import EDGE_BIT, OneSkin, Scratch, Skins
from stmpl_core.gpu.places import APART, DEEP, OVERFULL, PENDING
from stmpl_core.gpu.rays import (
    FAR,
    OPTIONS,
    SLANT,
    WALL_WIDTH,
    Grid,
    along,
    clearance_of,
    depth_and_share,
    inside_most,
    real,
    swept,
    vec3,
)

BLOCK, EDGE = wp.constant(IN_BLOCK), wp.constant(EDGE_BIT)
UNDER, TOO_DEEP = wp.constant(wp.float64(LEAST_UNDER)), wp.constant(wp.float64(DEEPEST))
ENOUGH, THICK = wp.constant(wp.float64(ALL_UNDER)), wp.constant(wp.float64(sdf.THICK))
SINKS = wp.constant(wp.float64(ALL_UNDER - LEAST_UNDER))
ANYHOW, ONE_WAY = wp.constant(wp.float64(rays.ANYHOW)), wp.constant(wp.float64(MIN_ONE_WAY_SHARE))
SHEET, LEAST_MISSED = wp.constant(wp.float64(of_numba.SHEET)), wp.constant(wp.float64(of_numba.LEAST_MISSED))
BETWEEN, MOST_BETWEEN = wp.constant(wp.float64(of_numba.BETWEEN)), wp.constant(of_numba.MOST_BETWEEN)
wp.set_module_options(OPTIONS)


@wp.func
def _marked(masks: wp.array2d(dtype=wp.uint32), c: wp.int32, n: wp.int32) -> bool:
    """Whether the bit of a skin's column n is set."""
    return ((masks[c, n // BLOCK] >> wp.uint32(n % BLOCK)) & wp.uint32(1)) == wp.uint32(1)


@wp.func
def _mark(masks: wp.array2d(dtype=wp.uint32), c: wp.int32, n: wp.int32):
    masks[c, n // BLOCK] = masks[c, n // BLOCK] | (wp.uint32(1) << wp.uint32(n % BLOCK))


@wp.func
def _through(low: vec3, high: vec3, start: vec3, way: vec3, t: real) -> bool:
    """Whether a column passes a box of the tool's frame."""
    begin, end = real(0.0), real(t)
    for x in range(3):
        if wp.abs(way[x]) < real(1e-12):
            if start[x] < low[x] or start[x] > high[x]:
                end = real(-1.0)
        else:
            first, last = (low[x] - start[x]) / way[x], (high[x] - start[x]) / way[x]
            begin = wp.max(begin, wp.min(first, last))
            end = wp.min(end, wp.max(first, last))
    return begin <= end


@wp.kernel
def widen(skins: Skins, scratch: Scratch):
    """Marks tools that are apart by more than a hole of the mesh, to be looked at again from further away."""
    c = wp.tid()
    if scratch.status[c] == APART and scratch.nearest[c] >= skins.one[scratch.skin[c]].hole:
        scratch.wide[c] = 1


@wp.func
def _looks(scratch: Scratch, c: wp.int32, again: wp.int32) -> bool:
    pending = scratch.status[c] == PENDING
    return (again == 0 and pending) or (again == 1 and scratch.wide[c] == 1) or (again == 2 and _swept(scratch, c))


@wp.kernel
def find_near(lanes: wp.int32, again: wp.int32, skins: Skins, scratch: Scratch):
    """Broad phase: masks of the columns that pass the tool's box."""
    c, lane = wp.tid()
    if not _looks(scratch, c, again):
        return
    one, grid = skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]]
    reach = real(one.hole)
    if again == 1:
        reach = one.hole + one.thickest
    wide = vec3(reach, reach, reach)
    low, high, centre, pose = grid.low - wide, grid.high + wide, scratch.centre[c], scratch.pose[c]
    radius = real(0.5) * wp.length(high - low)
    for b in range(one.first_ball + lane, one.end_ball, lanes):
        local, mask = b - one.first_ball, wp.uint32(0)
        ball = skins.balls[b]
        middle = vec3(ball[0], ball[1], ball[2])
        if wp.length_sq(middle - centre) <= (radius + ball[3]) * (radius + ball[3]):
            base = one.first + local * BLOCK
            for v in range(base, wp.min(base + BLOCK, one.end)):
                t = skins.thickness[v]
                if wp.length_sq(skins.points[v] - centre) <= (radius + t) * (radius + t):
                    start = wp.transpose(pose) * (skins.points[v] - scratch.place[c])
                    way = wp.transpose(pose) * skins.inward[v]
                    if _through(low, high, start, way, t):
                        mask = mask | (wp.uint32(1) << wp.uint32(v - base))
        scratch.near[c, local] = mask
        if again == 0:
            scratch.covered[c, local] = wp.uint32(0)
            scratch.seen[c, local] = wp.uint32(0)


@wp.kernel
def list_near(again: wp.int32, skins: Skins, scratch: Scratch):
    """Numbers of these columns, one after the other."""
    c, lane = wp.tid()
    if not _looks(scratch, c, again):
        return
    one, count = skins.one[scratch.skin[c]], wp.int32(0)
    blocks = one.end_ball - one.first_ball
    each = (blocks + wp.block_dim() - 1) // wp.block_dim()  # of a thread, one after the other
    for write in range(2):  # counts them, and then knows where to write
        for local in range(lane * each, wp.min((lane + 1) * each, blocks)):
            mask = scratch.near[c, local]
            if mask != wp.uint32(0):
                for bit in range(BLOCK):
                    if ((mask >> wp.uint32(bit)) & wp.uint32(1)) == wp.uint32(1):
                        if write == 1 and count < scratch.columns.shape[1]:
                            scratch.columns[c, count] = one.first + local * BLOCK + bit
                        count += 1
        if write == 0:
            count = sum_before(count)
    if lane == wp.block_dim() - 1:
        if count > scratch.columns.shape[1]:
            count = 0
            if again == 0:
                scratch.status[c] = OVERFULL
        scratch.count[c] = count


@wp.kernel
def clear(lanes: wp.int32, again: wp.int32, skins: Skins, scratch: Scratch):
    """Distance of the tool from each of these columns."""
    c, lane = wp.tid()
    if not _looks(scratch, c, again):
        return
    one, grid, pose = skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]], wp.transpose(scratch.pose[c])
    for n in range(lane, scratch.count[c], lanes):
        v = scratch.columns[c, n]
        start, way = pose * (skins.points[v] - scratch.place[c]), pose * skins.inward[v]
        least, above = clearance_of(grid, skins.coefficients, start, way, skins.thickness[v], one.hole)
        scratch.least[c, n] = least
        scratch.above[c, n] = above


@wp.func
def _parts_between(grid: Grid, edge: real) -> wp.int32:
    """Parts of half an edge between which a tool is looked for under skin: stmpl_core.columns.parts_between."""
    size, out = grid.high - grid.low, wp.int32(0)
    wide = wp.max(wp.min(size[0], size[1]), wp.min(wp.max(size[0], size[1]), size[2]))
    if grid.half < THICK and real(2.0) * grid.half <= SHEET * wide and edge >= LEAST_MISSED * wide:
        out = wp.min(wp.int32(wp.ceil(BETWEEN * edge / wp.max(wide, real(1e-12)))), MOST_BETWEEN)
    return out


@wp.func
def _further_in(
    skins: Skins, grid: Grid, start: vec3, way: vec3, t: real, least: real, above: real, under: real
) -> real:
    """How much further inside a tool a column gets below its skin, or nearer to it: stmpl_core.columns._further_in."""
    out = wp.max(under, -least - wp.max(-above, real(0.0)))
    if above - least > out:
        out = wp.max(out, wp.min(above, along(grid, skins.coefficients, start, way, t)) - least)
    return out


@wp.func
def _under_between(skins: Skins, scratch: Scratch, c: wp.int32, v: wp.int32, parts: wp.int32, least: real) -> real:
    """The same of columns in the triangles around a vertex, the nearest: stmpl_core.columns._under_between."""
    grid, pose, under = skins.grids[scratch.grid[c]], wp.transpose(scratch.pose[c]), real(least)
    for p in range(skins.start[v], skins.start[v + 1]):
        corners, at = skins.faces[skins.around[p]], wp.int32(0)
        for x in range(3):
            if corners[x] == v:
                at = x
        j, k = corners[(at + 1) % 3], corners[(at + 2) % 3]
        for q in range(parts * parts):
            half = real(1.0) / real(2 * parts)
            b, d = (real(q // parts) + real(0.5)) * half, (real(q % parts) + real(0.5)) * half
            a = real(1.0) - b - d
            if wp.max(b, d) <= a:
                place = a * skins.points[v] + b * skins.points[j] + d * skins.points[k]
                way = pose * wp.normalize(a * skins.inward[v] + b * skins.inward[j] + d * skins.inward[k])
                t = a * skins.thickness[v] + b * skins.thickness[j] + d * skins.thickness[k]
                start = pose * (place - scratch.place[c])
                near, above = clearance_of(grid, skins.coefficients, start, way, t, real(0.0))
                if above <= t and near < FAR:
                    under = _further_in(skins, grid, start, way, t, near, above, under)
    return under


@wp.kernel
def gather_clearance(again: wp.int32, skins: Skins, scratch: Scratch):
    """Least of these distances; masks of the columns that are covered; whether the tool has sunk under skin."""
    c = wp.tid()
    if not _looks(scratch, c, again):
        return
    one, grid, pose = skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]], wp.transpose(scratch.pose[c])
    nearest, around, under, wall, covers = real(FAR), -FAR, -FAR, real(0.0), wp.int32(0)
    met, whole, parts = vec3(), real(0.0), _parts_between(grid, one.edge)
    for n in range(scratch.count[c]):
        least, above = scratch.least[c, n], scratch.above[c, n]
        nearest = wp.min(nearest, least)
        around = wp.max(around, -above)
        weight = wp.max(one.hole - least, real(0.0)) * wp.exp(-wp.max(above, real(0.0)) / one.hole)
        whole += weight
        met = met + weight * skins.inward[scratch.columns[c, n]]
        if again == 0 and least < one.hole:
            v = scratch.columns[c, n]
            start, way = pose * (skins.points[v] - scratch.place[c]), pose * skins.inward[v]
            under = _further_in(skins, grid, start, way, skins.thickness[v], least, above, under)
            wall += skins.thickness[v]
            covers += 1
            _mark(scratch.covered, c, v - one.first)
    scratch.nearest[c] = nearest
    scratch.around[c] = wp.max(scratch.around[c], around)
    if again == 1:
        return
    if parts > 0:
        for n in range(scratch.count[c]):
            if scratch.least[c, n] < one.hole and under * real(covers) < ENOUGH * WALL_WIDTH * wall:
                under = _under_between(skins, scratch, c, scratch.columns[c, n], parts, under)
    scratch.top[c] = vec3()
    if covers == 0:
        scratch.status[c] = APART
    elif under > UNDER * WALL_WIDTH * wall / real(covers):
        share = wp.min((under / (WALL_WIDTH * wall / real(covers)) - UNDER) / SINKS, real(1.0))
        scratch.top[c] = (ANYHOW + share) * vec3(real(1.0), real(1.0), real(1.0))
        if one.stacked == 1 and wp.length(met) > ONE_WAY * whole:
            scratch.top[c] = -share * (pose * wp.normalize(met))


@wp.func
def _swept(scratch: Scratch, c: wp.int32) -> bool:
    """Whether a tool has sunk under skin along a way that is known."""
    square = wp.length_sq(scratch.top[c])
    return scratch.status[c] == PENDING and square > real(0.0) and square < real(2.0)


@wp.kernel
def find_swept(lanes: wp.int32, skins: Skins, scratch: Scratch):
    """Marks columns besides that such a tool meets along its way: stmpl_core.columns._with_swept."""
    c, lane = wp.tid()
    if not _swept(scratch, c):
        return
    one, grid, pose = skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]], scratch.pose[c]
    wide = vec3(one.hole, one.hole, one.hole)
    low, high, centre = grid.low - wide, grid.high + wide, scratch.centre[c]
    radius, goes = real(0.5) * wp.length(high - low), -wp.normalize(scratch.top[c])
    for b in range(one.first_ball + lane, one.end_ball, lanes):
        local, ball = b - one.first_ball, skins.balls[b]
        middle = vec3(ball[0], ball[1], ball[2])
        if wp.length_sq(middle - centre) <= (radius + ball[3]) * (radius + ball[3]):
            base = one.first + local * BLOCK
            for v in range(base, wp.min(base + BLOCK, one.end)):
                t, n = skins.thickness[v], v - one.first
                if wp.length_sq(skins.points[v] - centre) <= (radius + t) * (radius + t):
                    start, way = wp.transpose(pose) * (skins.points[v] - scratch.place[c]), skins.inward[v]
                    if wp.dot(wp.transpose(pose) * way, goes) > SLANT and not _marked(scratch.covered, c, n):
                        if _through(low, high, start, goes, t):
                            if -inside_most(grid, skins.coefficients, start, goes, t) < one.hole:
                                _mark(scratch.covered, c, n)
                                _mark(scratch.near, c, n)


@wp.func
def _is_first(skins: Skins, scratch: Scratch, c: wp.int32, v: wp.int32, f: wp.int32) -> bool:
    """Whether no corner of a triangle before v is covered."""
    first, out = skins.one[scratch.skin[c]].first, wp.bool(True)
    corners = skins.faces[f]
    for x in range(3):
        if corners[x] < v and _marked(scratch.covered, c, corners[x] - first):
            out = False
    return out


@wp.func
def _mark_corners(skins: Skins, scratch: Scratch, c: wp.int32, f: wp.int32):
    corners = skins.faces[f]
    for x in range(3):
        n = corners[x] - skins.one[scratch.skin[c]].first
        wp.atomic_or(scratch.seen, c, n // BLOCK, wp.uint32(1) << wp.uint32(n % BLOCK))


@wp.kernel
def list_faces(skins: Skins, scratch: Scratch):
    """Triangles around covered columns: each is listed by the first of its corners that is covered."""
    c, lane = wp.tid()
    if scratch.status[c] != PENDING:
        return
    each = (scratch.count[c] + wp.block_dim() - 1) // wp.block_dim()  # columns of a thread, one after the other
    first, place = skins.one[scratch.skin[c]].first, wp.int32(0)
    for write in range(2):  # counts them, and then knows where to write
        for n in range(lane * each, wp.min((lane + 1) * each, scratch.count[c])):
            v = scratch.columns[c, n]
            if _marked(scratch.covered, c, v - first):
                for p in range(skins.start[v], skins.start[v + 1]):
                    f = skins.around[p]
                    if _is_first(skins, scratch, c, v, f):
                        if write == 1 and place < scratch.found.shape[1]:
                            scratch.found[c, place] = f
                            _mark_corners(skins, scratch, c, f)
                        place += 1
        if write == 0:
            place = sum_before(place)
    if lane == wp.block_dim() - 1:
        if place > scratch.found.shape[1]:
            scratch.status[c] = OVERFULL
            place = 0
        scratch.many[c] = place


@wp.kernel
def sink(lanes: wp.int32, skins: Skins, scratch: Scratch):
    """Depth of the tool under each vertex of these triangles."""
    c, lane = wp.tid()
    if scratch.status[c] != PENDING:
        return
    one, grid, pose = skins.one[scratch.skin[c]], skins.grids[scratch.grid[c]], wp.transpose(scratch.pose[c])
    for n in range(lane, scratch.count[c], lanes):
        v, under = scratch.columns[c, n], real(0.0)
        if _marked(scratch.seen, c, v - one.first):
            start, way = pose * (skins.points[v] - scratch.place[c]), pose * skins.inward[v]
            deep, share = depth_and_share(grid, skins.coefficients, start, way, skins.thickness[v], scratch.top[c])
            under = deep * share
            if share < real(1.0) and wp.length_sq(scratch.top[c]) > real(0.0):
                sunk = swept(grid, skins.coefficients, start, way, skins.thickness[v], scratch.top[c])
                under = under + wp.max(sunk[1] - share, real(0.0)) * sunk[0]
        scratch.under[c, n] = under


@wp.kernel
def gather_depth(skins: Skins, scratch: Scratch):
    """Largest of these depths; a tool beyond DEEPEST of the thickness is not served."""
    c = wp.tid()
    if scratch.status[c] != PENDING:
        return
    deep = real(0.0)
    for n in range(scratch.count[c]):
        deep = wp.max(deep, scratch.under[c, n])
        if scratch.under[c, n] >= TOO_DEEP * skins.thickness[scratch.columns[c, n]]:
            scratch.status[c] = DEEP
    scratch.deep[c] = deep


@wp.func
def nearest_to(skins: Skins, one: OneSkin, at: vec3, guess: wp.int32) -> wp.int32:
    """Number of the vertex of a skin nearest to a point; guess: one that may be near, which saves looking."""
    best, nearest = wp.length_sq(at - skins.points[guess]), wp.int32(guess)
    for b in range(one.first_ball, one.end_ball):
        ball = skins.balls[b]
        away = wp.length(at - vec3(ball[0], ball[1], ball[2])) - ball[3]
        if away <= real(0.0) or away * away < best:
            base = one.first + (b - one.first_ball) * BLOCK
            for v in range(base, wp.min(base + BLOCK, one.end)):
                square = wp.length_sq(at - skins.points[v])
                if square < best:
                    best = square
                    nearest = v
    return nearest


@wp.func
def _under_skin(skins: Skins, one: OneSkin, at: vec3) -> bool:
    """Whether a point is under its nearest vertex, which is not on the open border."""
    nearest = nearest_to(skins, one, at, one.first)
    inward = wp.dot(at - skins.points[nearest], skins.inward[nearest])
    return inward > real(0.0) and (skins.doubts[nearest] & EDGE) == 0


@wp.kernel
def tell_inside(many: wp.int32, skins: Skins, scratch: Scratch):
    """A tool that presses nothing, most of whose points are under the skin, is not served: Deep.inside."""
    c = wp.tid()
    if scratch.status[c] != APART:
        return
    one, centre = skins.one[scratch.skin[c]], scratch.centre[c]
    for x in range(3):
        if centre[x] < one.low[x] or centre[x] > one.high[x]:
            return
    k = c % many
    few, all = skins.look_many[k, 0], skins.look_many[k, 1]
    under, n = wp.int32(0), wp.int32(0)
    while n < few and under == 0:
        if _under_skin(skins, one, scratch.pose[c] * skins.looked_at[k, n] + scratch.place[c]):
            under = 1
        n += 1
    if under == 0:
        return
    most = wp.int32(0)
    for m in range(all):
        if _under_skin(skins, one, scratch.pose[c] * skins.looked_at[k, few + m] + scratch.place[c]):
            most += 1
    if 2 * most > all:
        scratch.status[c] = DEEP
