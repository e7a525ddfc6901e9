# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Rays in Warp: stmpl_core.sdf.distance_at and stmpl_core.rays as functions of kernels, line by line the same law."""

import warp as wp

from stmpl_core.rays import (
    ANYHOW,
    ASLANT,
    GRAZES,
    LEAST_ASIDE,
    LONGEST,
    LOOKED_AT,
    MAX_COLUMN_STRAIN,
    MOST_PASSED,
    PASSED,
    SECANT_START,
    SECANT_TOLERANCE,
    STEEPEST,
    UPRIGHT,
    WALL,
)
from stmpl_core.rays import ENTERS as MOST_ENTERS
from stmpl_core.rays import LOOKS_BACK as LOOKED_BACK
from stmpl_core.rays import SURE as CLEAR_FROM
from stmpl_core.solids import BOX, CAPSULE, NEAREST

real = wp.float64  # of all geometry: float32 keeps 1e-8 m on a limb, a touch of 0.1 mm wants less
vec3, mat33 = wp.vec3d, wp.mat33d
OPTIONS = {"enable_backward": False}
FAR = wp.constant(wp.float64(1e30))  # stands for infinity
WALL_WIDTH = wp.constant(wp.float64(WALL))
MOST_STRAIN = wp.constant(wp.float64(MAX_COLUMN_STRAIN))
PARTS, MOST_PARTS = wp.constant(wp.float64(PASSED)), wp.constant(wp.float64(MOST_PASSED))
GRAZE, STEEP = wp.constant(wp.float64(GRAZES)), wp.constant(wp.float64(STEEPEST))
SAID_ANYHOW, SAYS_NO_WAY = wp.constant(wp.float64(ANYHOW)), wp.constant(wp.float64(LONGEST))
ENTERS, LOOKS_BACK = wp.constant(MOST_ENTERS), wp.constant(wp.float64(LOOKED_BACK))
SLANT, MORE_UPRIGHT = wp.constant(wp.float64(ASLANT)), wp.constant(wp.float64(UPRIGHT))
CLEAR, ASIDE = wp.constant(wp.float64(CLEAR_FROM)), wp.constant(wp.float64(LEAST_ASIDE))
BEHIND = wp.constant(wp.float64(LOOKED_AT))
IS_BOX, IS_CAPSULE, ON_AXIS = wp.constant(BOX), wp.constant(CAPSULE), wp.constant(wp.float64(NEAREST))
START, TOLERANCE = wp.constant(wp.float64(SECANT_START)), wp.constant(wp.float64(SECANT_TOLERANCE))
wp.set_module_options(OPTIONS)


@wp.struct
class Grid:
    """Distance field of a tool: place among all coefficients, shape, origin, cells, box and half thickness, [m] all."""

    offset: wp.int32
    shape: wp.vec3i
    origin: vec3
    spacing: real
    low: vec3
    high: vec3
    surface_error: real
    mostly_off: real
    half: real


@wp.func
def wall_in(grid: Grid, t: real) -> real:
    """Width over which depth rises beside a wall of the tool, in a column t long [m]."""
    return wp.min(WALL_WIDTH * t, grid.half)


@wp.func
def _three(coefficients: wp.array(dtype=real), k: wp.int32) -> vec3:
    return vec3(coefficients[k], coefficients[k + 1], coefficients[k + 2])


@wp.func
def _jet_of(d: real, way: vec3):
    return wp.vec4d(d, way[0], way[1], way[2])


@wp.func
def solid_jet(grid: Grid, coefficients: wp.array(dtype=real), at: vec3):
    """Signed distance to a solid at a point of the tool's frame [m], and its gradient: stmpl_core.solids.solid_jet."""
    zero, start = real(0.0), _three(coefficients, grid.offset)
    x = at - start
    if grid.shape[1] == IS_BOX:
        most, square, way, nearest = real(-1e30), real(0.0), vec3(), vec3()
        for k in range(3):
            axis = _three(coefficients, grid.offset + 3 + 3 * k)
            half, far = wp.length(axis), wp.dot(x, axis)
            over, axis = wp.abs(far) / half - half, axis / half * wp.where(far > zero, real(1.0), real(-1.0))
            if over > most:
                most, nearest = over, axis
            if over > zero:
                square += over * over
                way = way + over * axis
        if square == zero:
            return _jet_of(most, nearest)
        return _jet_of(wp.sqrt(square), way / wp.sqrt(square))
    axis, radius = _three(coefficients, grid.offset + 3) - start, coefficients[grid.offset + 6]
    long = wp.length(axis)
    axis = axis / wp.max(long, ON_AXIS)
    far = wp.dot(x, axis)
    if grid.shape[1] == IS_CAPSULE:
        x = x - wp.clamp(far, zero, long) * axis
        away = wp.length(x)
        return _jet_of(away - radius, x / wp.max(away, ON_AXIS))
    x = x - far * axis
    away = wp.length(x)
    aside, beyond, out = away - radius, wp.max(-far, far - long), x / wp.max(away, ON_AXIS)
    axis = axis * wp.where(far < real(0.5) * long, real(-1.0), real(1.0))
    if wp.min(aside, beyond) > zero:
        d = wp.sqrt(aside * aside + beyond * beyond)
        return _jet_of(d, (aside * out + beyond * axis) / d)
    if aside > beyond:
        return _jet_of(aside, out)
    return _jet_of(beyond, axis)


@wp.func
def cubic(f: real):
    """Weights of the four B-splines that reach a point at fraction f of its cell."""
    g = real(1.0) - f
    return wp.vec4d(
        g * g * g / real(6.0),
        (real(4.0) - real(6.0) * f * f + real(3.0) * f * f * f) / real(6.0),
        (real(4.0) - real(6.0) * g * g + real(3.0) * g * g * g) / real(6.0),
        f * f * f / real(6.0),
    )


@wp.func
def distance_at(grid: Grid, coefficients: wp.array(dtype=real), at: vec3) -> real:
    """Signed distance at one point of the tool's frame [m]."""
    if grid.shape[0] == 1:
        return solid_jet(grid, coefficients, at)[0]
    u = (at - grid.origin) / grid.spacing
    first, inside = wp.vec3i(0, 0, 0), vec3(real(0.0), real(0.0), real(0.0))
    for x in range(3):
        inside[x] = wp.min(wp.max(u[x], real(1.0)), real(grid.shape[x]) - real(2.0))
        first[x] = wp.min(wp.int32(inside[x]), grid.shape[x] - 3)
    a, b = cubic(inside[0] - real(first[0])), cubic(inside[1] - real(first[1]))
    c = cubic(inside[2] - real(first[2]))
    total = real(0.0)
    for i in range(4):
        plane = grid.offset + (first[0] - 1 + i) * grid.shape[1] * grid.shape[2]
        sum = real(0.0)
        for j in range(4):
            k = plane + (first[1] - 1 + j) * grid.shape[2] + first[2] - 1
            sum += b[j] * (c[0] * coefficients[k] + c[1] * coefficients[k + 1]
                           + (c[2] * coefficients[k + 2] + c[3] * coefficients[k + 3]))  # fmt: skip
        total += a[i] * sum
    away = wp.length_sq(u - inside) * grid.spacing * grid.spacing
    if away < real(1e-24):
        return total
    return wp.sqrt(away + total * total)


@wp.func
def _slopes(f: real):
    """Slopes of the weights of `cubic`."""
    g = real(1.0) - f
    return wp.vec4d(real(-0.5) * g * g, real(1.5) * f * f - real(2.0) * f, real(2.0) * g - real(1.5) * g * g,
                    real(0.5) * f * f)  # fmt: skip


@wp.func
def jet_at(grid: Grid, coefficients: wp.array(dtype=real), at: vec3):
    """Signed distance at a point of the tool's frame [m], and then its gradient: stmpl_core.sdf.jet_at."""
    if grid.shape[0] == 1:
        return solid_jet(grid, coefficients, at)
    u = (at - grid.origin) / grid.spacing
    first, inside = wp.vec3i(0, 0, 0), vec3()
    for x in range(3):
        inside[x] = wp.min(wp.max(u[x], real(1.0)), real(grid.shape[x]) - real(2.0))
        first[x] = wp.min(wp.int32(inside[x]), grid.shape[x] - 3)
    f, g, e = inside[0] - real(first[0]), inside[1] - real(first[1]), inside[2] - real(first[2])
    a, b, c, da, db, dc = cubic(f), cubic(g), cubic(e), _slopes(f), _slopes(g), _slopes(e)
    total, gradient = real(0.0), vec3()
    for i in range(4):
        plane = grid.offset + (first[0] - 1 + i) * grid.shape[1] * grid.shape[2]
        sum, across, up = real(0.0), real(0.0), real(0.0)
        for j in range(4):
            k = plane + (first[1] - 1 + j) * grid.shape[2] + first[2] - 1
            line, slope = real(0.0), real(0.0)
            for m in range(4):
                line += c[m] * coefficients[k + m]
                slope += dc[m] * coefficients[k + m]
            sum += b[j] * line
            across += db[j] * line
            up += b[j] * slope
        total += a[i] * sum
        gradient = gradient + vec3(da[i] * sum, a[i] * across, a[i] * up)
    gradient = gradient / grid.spacing
    off = (u - inside) * grid.spacing
    away = wp.length_sq(off)
    if away < real(1e-24):
        return wp.vec4d(total, gradient[0], gradient[1], gradient[2])
    root = wp.sqrt(away + total * total)
    for x in range(3):
        if wp.abs(off[x]) > real(1e-12):
            gradient[x] = off[x] / root
        else:
            gradient[x] = total * gradient[x] / root
    return wp.vec4d(root, gradient[0], gradient[1], gradient[2])


@wp.func
def along(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, s: real) -> real:
    """Signed distance to the tool at depth s along a ray [m]."""
    return distance_at(grid, coefficients, start + s * way)


@wp.func
def clearance_of(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, far: real):
    """Least signed distance along a column and that at its skin [m]: stmpl_core.columns.clearances."""
    d = along(grid, coefficients, start, way, real(0.0))
    skin = d  # not as a tuple: Warp would not copy
    least = d
    s = real(0.0)
    if d > t + far:
        least = d - t
    else:
        while s < t:
            s = wp.min(s + wp.max(wp.max(wp.abs(d), d - least), wp.min(t / real(16.0), grid.half)), t)
            d = along(grid, coefficients, start, way, s)
            least = wp.min(least, d)
        if d <= real(0.0):
            if along(grid, coefficients, start, way, t + real(1e-5)) < d:
                least = FAR
    return least, skin


@wp.func
def secant(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, guess: real) -> real:
    """Depth by the secant rule from a guess [m]; below 0 where that goes astray."""
    s = guess
    d = along(grid, coefficients, start, way, guess)
    last_s, last_d = s + real(1.0), d + real(1.0)
    out, step = real(-1.0), wp.int32(0)
    while step < 6:
        slope = (d - last_d) / (s - last_s)
        if slope < real(0.3):
            step = 6
        else:
            last_s = s
            last_d = d
            s = s - d / slope
            if wp.abs(s - last_s) < TOLERANCE * t:
                if s > real(0.0):
                    out = wp.min(s, t)
                step = 6
            else:
                d = along(grid, coefficients, start, way, s)
        step += 1
    return out


@wp.func
def depth_in_column(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real,
                    guess: real) -> real:  # fmt: skip
    """How deep along a ray, from the skin inwards, the tool ends [m]; 0 if it is not met."""
    if guess > WALL_WIDTH * t:
        found = secant(grid, coefficients, start, way, t, guess)
        if found > real(0.0):
            return found
    s = t
    d = along(grid, coefficients, start, way, t)
    if d <= real(0.0):
        return t
    last_s, last_d, out, step = s + real(1.0), d + real(1.0), real(-1.0), wp.int32(0)
    while step < 40:
        if s - d > real(0.0) and d > START * t:
            last_s = s
            last_d = d
            s = s - d
        else:
            slope = (d - last_d) / (s - last_s)
            following = s - d
            if slope > real(0.2) or d * last_d < real(0.0):
                following = s - d / slope
            elif d > real(0.0):
                following = s - wp.max(d, GRAZE * t)
            last_s = s
            last_d = d
            s = following
        if s <= real(0.0):
            out = real(0.0)
            step = 40
        elif wp.abs(s - last_s) < TOLERANCE * t:
            out = wp.min(s, t)
            step = 40
        else:
            d = along(grid, coefficients, start, way, s)
        step += 1
    if out < real(0.0):
        out = wp.min(s, t)
    return out


@wp.func
def innermost(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, deep: real) -> wp.vec2d:
    """How far inside the tool a ray gets at most on its way to a depth, below 0: passes beside it; and where [m]."""
    most, where, at = -along(grid, coefficients, start, way, real(0.0)), real(0.0), real(0.0)
    there, step = real(most), wp.max(wp.min(real(0.5) * grid.half, deep / PARTS), deep / MOST_PARTS)
    k = wp.int32(1)
    while k > 0:
        s = wp.min(real(k) * step, deep)
        if there + STEEP * (s - at) > most:
            at, there = real(s), -along(grid, coefficients, start, way, s)
            if there > most:
                most, where = real(there), real(s)
        k += 1
        if not s < deep:
            k = wp.int32(0)
    return wp.vec2d(most, where)


@wp.func
def inside_most(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, deep: real) -> real:
    """How far inside the tool a ray gets at most on its way to a depth [m]; below 0: how far it passes beside it."""
    return innermost(grid, coefficients, start, way, deep)[0]


@wp.func
def sure_of(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, deep: real, wall: real) -> real:
    """How clear it is that a ray leads through the tool to a depth [m], from -1, it passes beside it, to 1."""
    return wp.clamp(inside_most(grid, coefficients, start, way, deep) / (CLEAR * wall), real(-1.0), real(1.0))


@wp.func
def led_in(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, most: wp.vec2d, wall: real) -> vec3:
    """Start of a ray that passes the tool, moved aside until it surely leads through it; most: see `innermost`."""
    jet = jet_at(grid, coefficients, start + most[1] * way)
    aside = vec3(jet[1], jet[2], jet[3])
    aside = aside - wp.dot(aside, way) * way
    return start - wp.max(CLEAR * wall - most[0], real(0.0)) / wp.max(wp.length_sq(aside), ASIDE) * aside


@wp.func
def way_of(top: vec3) -> wp.vec4d:
    """Share to which a tool has sunk under skin along a way that is known, and that way: stmpl_core.rays.way_of."""
    size = wp.length(top)
    if size == real(0.0) or size >= SAYS_NO_WAY:
        return wp.vec4d()
    return wp.vec4d(size, -top[0] / size, -top[1] / size, -top[2] / size)


@wp.func
def sunk_under(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, top: vec3) -> real:
    """Share to which a tool has sunk under a column's skin, from 0, it comes from beside, to 1."""
    sunk = way_of(top)
    if sunk[0] == real(0.0):
        return wp.clamp(top[0] - SAID_ANYHOW, real(0.0), real(1.0))
    s, d, step = real(0.0), along(grid, coefficients, start, way, real(0.0)), wp.int32(0)
    at, near = real(0.0), real(d)
    while step < ENTERS:
        step += 1
        if d < START * t:
            step = ENTERS
        else:
            s = s + d
            d = along(grid, coefficients, start, way, wp.min(s, t))
            if s >= t:
                step = ENTERS
            elif d < near:
                at, near = real(s), real(d)
    enters = real(1.0) - wp.max(near - START * t, real(0.0)) / (WALL_WIDTH * t)
    if enters <= real(0.0):
        return real(0.0)
    back = BEHIND * t * vec3(sunk[1], sunk[2], sunk[3])
    rise = distance_at(grid, coefficients, start + at * way - back) - near
    return sunk[0] * enters * wp.clamp(rise / (LOOKS_BACK * BEHIND * t), real(0.0), real(1.0))


@wp.func
def depth_and_share(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, top: vec3):
    """How deep the tool is in a column [m], and the share of that which counts."""
    wall, guess = wall_in(grid, t), -along(grid, coefficients, start, way, real(0.0))
    share, deep = wp.clamp(real(1.0) + guess / wall, real(0.0), real(1.0)), real(0.0)
    sunk = wp.length_sq(top) > real(0.0)
    if share > real(0.0) or sunk:
        deep = depth_in_column(grid, coefficients, start, way, t, guess)
        if deep == real(0.0):
            deep = wp.max(guess, real(0.0))
        if share < real(1.0) and sunk and deep > real(0.0):
            within = wp.min(real(2.0) * inside_most(grid, coefficients, start, way, deep) / wall, real(1.0))
            if within > share:
                share = share + (within - share) * sunk_under(grid, coefficients, start, way, t, top)
    return deep, share


@wp.func
def swept(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, top: vec3) -> vec3:
    """Depth by which skin sinks with a tool along its way [m], share of that which counts, and how much lies on it."""
    sunk, out = way_of(top), vec3()
    goes = vec3(sunk[1], sunk[2], sunk[3])
    cosine = wp.dot(goes, way)
    if cosine > SLANT:
        inside = inside_most(grid, coefficients, start, goes, t)
        if inside > real(0.0):
            wall, lies = wall_in(grid, t), real(1.0)
            share = sunk[0] * wp.min(real(2.0) * inside / wall, real(1.0))
            share = share * wp.min((cosine - SLANT) / MORE_UPRIGHT, real(1.0))
            deep = depth_in_column(grid, coefficients, start, goes, t, real(0.0))
            if deep > wall:
                lies = real(-2.0) * along(grid, coefficients, start, goes, deep - wall) / wall
            out = vec3(deep * cosine, share, share * wp.clamp(lies, real(0.0), real(1.0)))
    return out


@wp.func
def strain_under(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real,
                 top: vec3) -> real:  # fmt: skip
    """How far the tool squeezes a column, over its thickness; rising from 0 beside the tool's walls."""
    wall = wall_in(grid, t)
    deep, share = depth_and_share(grid, coefficients, start, way, t, top)
    strain = share * wp.min(deep / t, MOST_STRAIN)
    if deep > wall:
        inside = -along(grid, coefficients, start, way, deep - wall)
        inside = wp.clamp(real(2.0) * inside / wall, real(0.0), real(1.0))
        strain = strain * (real(1.0) - (real(1.0) - inside) * wp.min(deep / wall - real(1.0), real(1.0)))
    if share < real(1.0) and wp.length_sq(top) > real(0.0):
        sunk = swept(grid, coefficients, start, way, t, top)
        strain = strain + wp.max(sunk[1] - share, real(0.0)) * wp.min(sunk[0] / t, MOST_STRAIN)
    return strain


@wp.func
def depth_at(grid: Grid, coefficients: wp.array(dtype=real), start: vec3, way: vec3, t: real, top: vec3) -> real:
    """Depth of the skin in the tool [m], or where the tool has sunk under it, of its column: nodes._inside."""
    depth = -distance_at(grid, coefficients, start)
    beyond = wp.min(real(1.0) - depth / (WALL_WIDTH * t), real(1.0))
    if beyond > real(0.0) and wp.length_sq(top) > real(0.0):
        deep = wp.max(depth_in_column(grid, coefficients, start, way, t, real(0.0)), real(0.5) * t)
        most, more, sunk = inside_most(grid, coefficients, start, way, deep), real(0.0), way_of(top)
        if most > depth:
            more = (most - depth) * sunk_under(grid, coefficients, start, way, t, top)
        misses = wp.min(real(1.0) - real(2.0) * most / (WALL_WIDTH * t), real(1.0))
        goes = vec3(sunk[1], sunk[2], sunk[3])
        if misses > real(0.0) and wp.dot(goes, way) > SLANT:
            through = inside_most(grid, coefficients, start, goes, t)
            more = wp.max(more, misses * sunk[0] * (through - depth))
        depth = depth + beyond * more
    return depth
