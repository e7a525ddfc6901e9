# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that look at the skin under tools: what area they cover, and which sides of a limb it is on: nodes._look."""

import math

import warp as wp

from stmpl_core import nodes as law
from stmpl_core import toucher
from stmpl_core.gpu.blocks import least_of, most_of, sum_of
from stmpl_core.gpu.columns import nearest_to
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import APART, PENDING
from stmpl_core.gpu.rays import FAR, OPTIONS, depth_at, distance_at, mat33, real, vec3

FINER = wp.constant(16)  # parts of the side of a part, between which no tip is looked for
BESIDE, GRAZED = wp.constant(wp.float64(law.BESIDE)), wp.constant(wp.float64(1e-3))  # the latter over the thickness
LOOKED_AT, FIRST = wp.constant(toucher.LOOKED_AT), wp.constant(wp.float64(toucher.FIRST))
SAMPLES, CHARTS = wp.constant(law.SAMPLES), wp.constant(law.CHARTS)
FACING, ONE_WAY = wp.constant(wp.float64(law.FACING)), wp.constant(wp.float64(law.ONE_WAY))
COS_ASKEW, SIN_ASKEW = wp.constant(wp.float64(math.cos(law.ASKEW))), wp.constant(wp.float64(math.sin(law.ASKEW)))
wp.set_module_options(OPTIONS)


@wp.func
def _shares_of_part(split: wp.int32, q: wp.int32) -> vec3:
    """Barycentric coordinates of the middle of part q of a triangle, row by row."""
    p, left = wp.int32(0), wp.int32(q)
    while left >= 2 * (split - p) - 1:
        left -= 2 * (split - p) - 1
        p += 1
    r, flip = left // 2, left % 2
    third = real(1 + flip) / real(3.0)
    a, b = (real(p) + third) / real(split), (real(r) + third) / real(split)
    return vec3(a, b, real(1.0) - a - b)


@wp.func
def point_on(skins: Skins, f: wp.int32, shares: vec3) -> vec3:
    corners = skins.faces[f]
    return (shares[0] * skins.points[corners[0]] + shares[1] * skins.points[corners[1]]
            + shares[2] * skins.points[corners[2]])  # fmt: skip


@wp.func
def inward_on(skins: Skins, f: wp.int32, shares: vec3) -> vec3:
    corners = skins.faces[f]
    return wp.normalize(shares[0] * skins.inward[corners[0]] + shares[1] * skins.inward[corners[1]]
                        + shares[2] * skins.inward[corners[2]])  # fmt: skip


@wp.func
def thickness_on(skins: Skins, f: wp.int32, shares: vec3) -> real:
    corners = skins.faces[f]
    return (shares[0] * skins.thickness[corners[0]] + shares[1] * skins.thickness[corners[1]]
            + shares[2] * skins.thickness[corners[2]])  # fmt: skip


@wp.kernel
def begin(scratch: Scratch):
    """Parts that each triangle is looked at in."""
    c = wp.tid()
    split = wp.int32(1)
    while split < 8 and scratch.many[c] * split * split < SAMPLES:
        split += 1
    scratch.split[c] = split
    scratch.misses[c] = 0
    if scratch.status[c] != PENDING:
        scratch.many[c] = 0


@wp.kernel
def look(lanes: wp.int32, skins: Skins, scratch: Scratch):
    """How deep the tool is at parts of the triangles."""
    c, lane = wp.tid()
    split, top, pose = scratch.split[c], scratch.top[c], wp.transpose(scratch.pose[c])
    parts, grid = split * split, skins.grids[scratch.grid[c]]
    for n in range(lane, scratch.many[c] * parts, lanes):
        f, q = scratch.found[c, n // parts], n % parts
        if q == 0:
            corners = skins.faces[f]
            way = wp.cross(skins.points[corners[1]] - skins.points[corners[0]],
                           skins.points[corners[2]] - skins.points[corners[0]])  # fmt: skip
            scratch.ways[c, n // parts] = -wp.normalize(way)
            scratch.sizes[c, n // parts] = real(0.5) * wp.length(way) / real(parts)
        shares = _shares_of_part(split, q)
        middle = point_on(skins, f, shares)
        scratch.middles[c, n] = middle
        start, way = pose * (middle - scratch.place[c]), pose * inward_on(skins, f, shares)
        t = thickness_on(skins, f, shares)
        scratch.depths[c, n] = depth_at(grid, skins.coefficients, start, way, t, top)


@wp.kernel
def search(lanes: wp.int32, skins: Skins, scratch: Scratch):
    """Which tools have no nodes and meet skin between the places that were looked at, or with a tip: Toucher._tip."""
    c, lane = wp.tid()
    if scratch.status[c] != APART or scratch.nearest[c] >= skins.one[scratch.skin[c]].hole:
        return
    split, pose, grid = scratch.split[c], wp.transpose(scratch.pose[c]), skins.grids[scratch.grid[c]]
    parts = split * split
    for n in range(lane, scratch.many[c] * parts, lanes):
        f = scratch.found[c, n // parts]
        corners, whole = skins.faces[f], _shares_of_part(split, n % parts)
        edge = wp.length(skins.points[corners[0]] - skins.points[corners[1]]) / real(split)
        row = whole[0] * real(split)
        turn = real(1.0)
        if row - wp.floor(row) > real(0.5):
            turn = real(-1.0)
        if scratch.depths[c, n] > -BESIDE * edge:
            for q in range(FINER * FINER):
                a = _shares_of_part(FINER, q) - vec3(real(1.0), real(1.0), real(1.0)) / real(3.0)
                start = pose * (point_on(skins, f, whole + turn / real(split) * a) - scratch.place[c])
                if distance_at(grid, skins.coefficients, start) < -GRAZED * skins.thickness[corners[0]]:
                    scratch.misses[c] = 1
    one, tips = skins.one[scratch.skin[c]], skins.tip_many[scratch.grid[c]]
    v = wp.int32(one.first)
    few, step = wp.min(tips, LOOKED_AT), tips // LOOKED_AT + 1
    for n in range(lane, few + (tips - few + step - 1) // step, lanes):
        tip = skins.tips[scratch.grid[c], n + wp.max(n - few, 0) * (step - 1)]
        at = scratch.pose[c] * vec3(tip[0], tip[1], tip[2]) + scratch.place[c]
        v = nearest_to(skins, one, at, v)
        deep = wp.dot(at - skins.points[v], skins.inward[v])
        beside = wp.length_sq(at - skins.points[v]) - deep * deep
        if deep > real(2.0) * FIRST * skins.thickness[v] and beside < one.edge * one.edge:
            scratch.misses[c] = 1


@wp.func
def _deepest_of(scratch: Scratch, c: wp.int32, m: wp.int32, parts: wp.int32) -> real:
    deepest = -FAR
    for q in range(parts):
        deepest = wp.max(deepest, scratch.depths[c, m * parts + q])
    return deepest


@wp.func
def _axes(pose: mat33, way: vec3) -> mat33:
    """First and second axis of a lattice, and the way inwards, as rows."""
    first, axis = vec3(), wp.int32(0)
    while axis < 2:
        column = vec3(pose[0, axis], pose[1, axis], pose[2, axis])
        far = wp.dot(column, way)
        first = column - far * way
        axis += 1
        if far * far < real(0.9):
            axis = 2
    first = wp.normalize(first)
    cross = wp.cross(way, first)
    one, other = COS_ASKEW * first + SIN_ASKEW * cross, COS_ASKEW * cross - SIN_ASKEW * first
    return mat33(one[0], one[1], one[2], other[0], other[1], other[2], way[0], way[1], way[2])


@wp.kernel
def gather_look(skins: Skins, scratch: Scratch):
    """Area that the tool covers, the thickness there, and the sides of the limb that its triangles are on."""
    c, lane = wp.tid()
    lanes, many, parts = wp.block_dim(), scratch.many[c], scratch.split[c] * scratch.split[c]
    if many == 0:
        return
    mine, deepest = wp.int32(0), -FAR
    for m in range(lane, many, lanes):
        here = _deepest_of(scratch, c, m, parts)
        if here > deepest or (here == deepest and scratch.found[c, m] < scratch.found[c, mine]):
            deepest = here
            mine = m
    own, lowest, best = real(deepest), real(FAR), real(0.0)
    deepest = most_of(deepest)
    if own == deepest:
        lowest = real(scratch.found[c, mine])
    if lowest == least_of(lowest):
        best = real(mine)
    best = sum_of(best)  # of the one thread that has it
    area, height, total, mean = real(0.0), real(0.0), real(0.0), vec3()
    for m in range(lane, many, lanes):
        size = scratch.sizes[c, m]
        blur = real(0.5) * wp.sqrt(size)
        if deepest > real(0.0):
            blur = wp.min(blur, real(0.5) * deepest)
        weight = real(0.0)
        for q in range(parts):
            depth = scratch.depths[c, m * parts + q]
            part = wp.clamp(real(0.5) + depth / blur, real(0.0), real(1.0)) * size
            area += part
            height += part * skins.thickness[skins.faces[scratch.found[c, m]][0]]
            weight += size * wp.max(depth + real(0.05) * wp.abs(deepest), real(0.0))
        total += weight
        mean = mean + weight * scratch.ways[c, m]
        scratch.chart[c, m] = -1
    area = sum_of(area)
    height = sum_of(height)
    total = sum_of(total)
    mean = sum_of(mean)
    height = height / wp.max(area, real(1e-300))
    if deepest <= real(0.0):
        area = real(0.05) * area
    way = vec3(scratch.ways[c, wp.int32(best)])
    if wp.length(mean) > ONE_WAY * total:
        way = wp.normalize(mean)
    sides = wp.int32(0)
    if area > real(0.0):
        while sides < CHARTS:
            if lane == 0:
                scratch.axes[c, sides] = _axes(scratch.pose[c], way)
            rest, highest = wp.int32(many), real(0.0)
            for m in range(lane, many, lanes):
                if scratch.chart[c, m] < 0:
                    if wp.dot(scratch.ways[c, m], way) >= FACING:
                        scratch.chart[c, m] = sides
                    else:
                        here = _deepest_of(scratch, c, m, parts)
                        if here > highest:
                            rest = m
                            highest = here
            sides += 1
            if highest < most_of(highest):
                rest = many
            rest = wp.int32(least_of(real(rest)))
            if rest == many:
                break
            way = scratch.ways[c, rest]
    if lane == 0:
        scratch.covers[c] = area
        scratch.height[c] = height
        scratch.deepest[c] = deepest
        scratch.sides[c] = sides
        scratch.sees[c] = real(0.0)
        scratch.also[c] = real(0.0)
        wp.atomic_max(scratch.busy, 0, sides)
