# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that lay what is touched onto its tool, and the skin around it along: stmpl_core.conform.

The linear systems, one a scene, are eliminated without pivots: their matrices are a positive kernel's with a ridge.
"""

import warp as wp

from stmpl_core import conform, simulator, touch
from stmpl_core.gpu.blocks import wait
from stmpl_core.gpu.columns import _marked
from stmpl_core.gpu.field_packs import FieldScratch, SkinFields
from stmpl_core.gpu.motion import FAR, PER_LOG, STEPS, TOP, _at, feels
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import BY_POSE, REFUSED
from stmpl_core.gpu.rays import (
    OPTIONS,
    along,
    depth_and_share,
    depth_in_column,
    jet_at,
    real,
    swept,
    vec3,
    wall_in,
)

LYING = wp.constant(wp.float64(conform.MIN_LYING_PRESSURE))
FIRM, FACING = wp.constant(wp.float64(conform.FIRM_DEPTH)), wp.constant(wp.float64(conform.MIN_FACING_COSINE))
LEAST, RIDGE = wp.constant(wp.float64(conform.LEAST_WEIGHT)), wp.constant(wp.float64(conform.SMOOTHING_SHARE))
ONE_WAY = wp.constant(wp.float64(touch.MIN_ONE_WAY_SHARE))
MOST_MOVED = wp.constant(wp.float64(simulator.MOST_MOVED))
PUSHES, LEFT = wp.constant(conform.PUSHES), wp.constant(wp.float64(conform.LEFT_DEPTH))
FURTHER, RIVAL = wp.constant(wp.float64(conform.FURTHER)), wp.constant(wp.float64(conform.RIVAL))
NAN = wp.constant(wp.float64(float("nan")))
wp.set_module_options({**OPTIONS, "max_unroll": 4})


@wp.func
def _jet_of(skins: Skins, scratch: Scratch, c: wp.int32, at: vec3):
    """Signed distance to a tool at a point of the body's frame [m], and then its gradient."""
    pose, grid = scratch.pose[c], skins.grids[scratch.grid[c]]
    jet = jet_at(grid, skins.coefficients, wp.transpose(pose) * (at - scratch.place[c]))
    gradient = pose * vec3(jet[1], jet[2], jet[3])
    return wp.vec4d(jet[0], gradient[0], gradient[1], gradient[2])


@wp.func
def _met(scratch: Scratch, c: wp.int32, n: wp.int32) -> bool:
    """Whether a vertex is one of the triangles that a pressing tool touches."""
    if scratch.status[c] != BY_POSE:
        return False
    return _marked(scratch.seen, c, n)


@wp.func
def _clipped(x: real) -> real:
    return wp.clamp(x, real(0.0), real(1.0))


@wp.kernel
def find_way(pick: wp.array(dtype=wp.int32), many: wp.int32, skins: Skins, scratch: Scratch, field: FieldScratch):
    """Which way the skin under each tool goes with it: touch.way_of; and the tool's highest pressure."""
    t = wp.tid()
    f, k = t // many, t % many
    s, force, total = pick[f], vec3(), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == k:
            here, corners = scratch.pressure[s, i] * scratch.area[s, i], skins.faces[scratch.face[s, i]]
            for x in range(3):
                part = here * scratch.shares[s, i][x]
                total += part
                force = force - part / skins.area[corners[x]] * skins.area_vectors[corners[x]]
    field.one_way[t] = 0
    field.push[t] = force
    if wp.length(force) > ONE_WAY * total:
        field.one_way[t] = 1
        field.way[t] = wp.normalize(force)


@wp.kernel
def lie(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
        field: FieldScratch):  # fmt: skip
    """Share to which each vertex lies on each tool, and where it has gone then: conform._lie."""
    t, lane = wp.tid()
    f, k = t // many, t % many
    c = pick[f] * many + k
    first, pose = skins.one[scratch.skin[c]].first, wp.transpose(scratch.pose[c])
    grid, highest = skins.grids[scratch.grid[c]], real(0.0)
    for n in range(field.many[f]):
        highest = wp.max(highest, field.press[t, n])
    for n in range(lane, field.many[f], lanes):
        v, lies, gone = field.under[f, n], real(0.0), vec3()
        if _met(scratch, c, v - first) and highest > real(0.0):
            inward, thick = skins.inward[v], skins.thickness[v]
            start, down, wall = pose * (skins.points[v] - scratch.place[c]), pose * inward, wall_in(grid, thick)
            deep, share = depth_and_share(grid, skins.coefficients, start, down, thick, scratch.top[c])
            depth, rests = share * deep, real(0.0)
            if depth > real(0.0):
                inside = -along(grid, skins.coefficients, start, down, depth - wall)
                rests = _clipped(real(2.0) * inside / wall) * wp.min(depth / wall, real(1.0))
            if share < real(1.0) and wp.length_sq(scratch.top[c]) > real(0.0):
                sunk = swept(grid, skins.coefficients, start, down, thick, scratch.top[c])
                depth = depth + wp.max(sunk[1] - share, real(0.0)) * sunk[0]
                rests = wp.max(rests, sunk[2] * wp.min(depth / wall, real(1.0)))
            way = vec3(inward)
            if field.one_way[t] == 1:
                way = field.way[t]
            cosine = wp.dot(inward, way)
            guess, along_it = depth / wp.max(cosine, FACING), real(0.0)
            if rests > real(0.0) and cosine > FACING:
                along_it = real(-2.0) * along(grid, skins.coefficients, start, pose * way, real(0.5) * guess) / wall
            lies = wp.min(rests, _clipped(along_it)) * _clipped(field.press[t, n] / (LYING * highest) - real(0.5))
            lies = lies * _clipped((cosine - FACING) / real(0.1))
            if lies > real(0.0):
                far = depth_in_column(grid, skins.coefficients, start, pose * way, real(4.0) * guess, guess)
                sure = _clipped(real(2.0) * lies - real(1.0))
                gone = (sure * far + (real(1.0) - sure) * guess) * way
        field.lies[t, n] = lies
        field.gone[t, n] = gone


@wp.func
def _sinks(more: SkinFields, id: wp.int32, v: wp.int32, q: wp.int32) -> wp.float32:
    """How far a vertex sinks under a unit source at another, in thicknesses: response._sinks."""
    site, other, frame, away = more.site[v], more.site[q], more.frame[v], more.at[q] - more.at[v]
    inverse = site[0] * other[0]
    square, normal = wp.length_sq(away) * inverse * inverse, more.normal[q]
    facing = frame[2, 0] * normal[0] + frame[2, 1] * normal[1] + frame[2, 2] * normal[2]
    if facing <= wp.float32(0.0) or square >= FAR * FAR:
        return wp.float32(0.0)
    far, h = wp.sqrt(square) * STEPS, wp.clamp((other[3] - site[2]) * PER_LOG, wp.float32(0.0), TOP)
    k, low = wp.int32(far), wp.int32(h)
    scale = other[1] * inverse * site[0] * site[0]
    return scale * _at(more.sink, id, low, k, far - wp.float32(k), h - wp.float32(low))


@wp.kernel
def begin(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
          scratch: Scratch, field: FieldScratch):  # fmt: skip
    """How vertices under the tools sink under sources at each other; where a method has moved them."""
    f, lane = wp.tid()
    id = scratch.skin[pick[f] * many]
    first, count = skins.one[id].first, field.many[f]
    for n in range(lane, count * count, lanes):
        i, j = n // count, n % count
        sinks = wp.float32(0.0)
        if field.folds[f] <= 1 or field.fold[f, i] == field.fold[f, j]:
            sinks = _sinks(more, id, field.under[f, i], field.under[f, j])
        field.sinking[f, i, j] = sinks
    for n in range(lane, count, lanes):
        field.moved[f, n] = field.motion[f, field.under[f, n] - first]
        field.pulls[f, n] = vec3()


@wp.kernel
def want(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
         field: FieldScratch):  # fmt: skip
    """How each vertex should still move, and how firmly: conform._want."""
    f, lane = wp.tid()
    first = skins.one[scratch.skin[pick[f] * many]].first
    for n in range(lane, field.many[f], lanes):
        v, moved, wanted, weight = field.under[f, n], field.moved[f, n], vec3(), real(0.0)
        most, lying, said = real(0.0), real(0.0), real(0.0)
        for k in range(many):
            most = wp.max(most, field.lies[f * many + k, n] * wp.length(field.gone[f * many + k, n]))
            lying = wp.max(lying, field.lies[f * many + k, n])
        for k in range(many):
            c, t = pick[f] * many + k, f * many + k
            if _met(scratch, c, v - first):
                jet, lies = _jet_of(skins, scratch, c, skins.points[v] + moved), field.lies[t, n]
                firmly = wp.max(lies, _clipped(-jet[0] / (FIRM * skins.thickness[v])))
                weight = wp.max(weight, firmly)
                way = lies * wp.length(field.gone[t, n]) / wp.max(most, real(1e-300))
                say = firmly * (real(1.0) - lying * (real(1.0) - _clipped((way - RIVAL) / (real(1.0) - RIVAL))))
                if say > real(0.0):
                    said += say
                    out = -(real(1.0) - lies) * wp.min(jet[0], real(0.0))
                    asked = lies * (field.gone[t, n] - moved) + out * vec3(jet[1], jet[2], jet[3])
                    wanted = wanted + say / said * (asked - wanted)
        field.wanted[f, n] = wanted
        field.weight[f, n] = weight


@wp.kernel
def list_wanted(field: FieldScratch):
    """Vertices that should move, and the ridge."""
    f = wp.tid()
    count, own = wp.int32(0), real(0.0)
    for n in range(field.many[f]):
        own += RIDGE * real(field.sinking[f, n, n]) / real(field.many[f])
        if field.weight[f, n] > LEAST:
            field.act[f, count] = n
            count += 1
    field.acts[f] = count
    field.own[f] = own


@wp.kernel
def set_up(lanes: wp.int32, field: FieldScratch):
    """The linear system of each scene."""
    f, lane = wp.tid()
    count = field.acts[f]
    for n in range(lane, count * count, lanes):
        a, b = n // count, n % count
        value = real(field.sinking[f, field.act[f, a], field.act[f, b]])
        if a == b:
            weight = field.weight[f, field.act[f, a]]
            value += field.own[f] / (weight * weight)
        field.left[f, a, b] = value
    for a in range(lane, count, lanes):
        field.right[f, a] = field.wanted[f, field.act[f, a]]


@wp.kernel
def solve(field: FieldScratch):
    """Sources that move the vertices as is wanted, by Gauss's elimination."""
    f, lane = wp.tid()
    lanes, count = wp.block_dim(), field.acts[f]
    for k in range(count):
        rest = count - k - 1
        for i in range(k + 1 + lane, count, lanes):
            factor = field.left[f, i, k] / field.left[f, k, k]
            field.left[f, i, k] = factor
            field.right[f, i] = field.right[f, i] - factor * field.right[f, k]
        wait()
        for n in range(lane, rest * rest, lanes):
            i, j = k + 1 + n // rest, k + 1 + n % rest
            field.left[f, i, j] = field.left[f, i, j] - field.left[f, i, k] * field.left[f, k, j]
        wait()
    for back in range(count):
        k = count - 1 - back
        source = field.right[f, k] / field.left[f, k, k]
        for i in range(lane, k, lanes):
            field.right[f, i] = field.right[f, i] - field.left[f, i, k] * source
        wait()
        if lane == 0:
            field.right[f, k] = source
            field.pulls[f, field.act[f, k]] = field.pulls[f, field.act[f, k]] + source


@wp.kernel
def follow(lanes: wp.int32, field: FieldScratch):
    """Moves them, and those around them."""
    f, lane = wp.tid()
    for n in range(lane, field.many[f], lanes):
        moved = field.moved[f, n]
        for a in range(field.acts[f]):
            moved = moved + real(field.sinking[f, n, field.act[f, a]]) * field.right[f, a]
        field.moved[f, n] = moved


@wp.kernel
def spread(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
           scratch: Scratch, field: FieldScratch):  # fmt: skip
    """What all these sources add to the vertices that are asked."""
    f, lane = wp.tid()
    id = scratch.skin[pick[f] * many]
    one = skins.one[id]
    for n in range(lane, one.end - one.first, lanes):
        if field.ask[f, n] == 1:
            sum = vec3()
            for m in range(field.many[f]):
                if wp.length_sq(field.pulls[f, m]) > real(0.0) and feels(field, f, n, m):
                    sum = sum + real(_sinks(more, id, one.first + n, field.under[f, m])) * field.pulls[f, m]
            field.spread[f, n] = sum


@wp.kernel
def push_out(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
             field: FieldScratch):  # fmt: skip
    """Moves vertices that are left inside tools straight out of them, of several at once: conform._push_out."""
    f, lane = wp.tid()
    first = skins.one[scratch.skin[pick[f] * many]].first
    for n in range(lane, field.many[f], lanes):
        v, least, pushed, deep = field.under[f, n], real(0.0), wp.int32(0), real(1.0)
        moved = field.motion[f, v - first]
        while pushed < PUSHES and deep > least:
            deep = real(0.0)
            total, squares, way, step, inside = real(0.0), real(0.0), vec3(), vec3(), wp.int32(0)
            for k in range(many):
                c = pick[f] * many + k
                if _met(scratch, c, v - first):
                    jet = _jet_of(skins, scratch, c, skins.points[v] + moved)
                    if jet[0] < real(0.0):
                        step = -jet[0] * vec3(jet[1], jet[2], jet[3])
                        deep = wp.max(deep, -jet[0])
                        total -= jet[0]
                        squares -= jet[0] * wp.length_sq(step)
                        way = way - jet[0] * step
                        inside += 1
            if deep > least:
                if inside > 1:
                    longer = squares * total / wp.max(wp.length_sq(way), real(1e-300))
                    step = wp.min(longer, FURTHER) / total * way
                moved = moved + step
            least = LEFT * skins.thickness[v]
            pushed += 1
        field.motion[f, v - first] = moved


@wp.kernel
def hand_out(pick: wp.array(dtype=wp.int32), to: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32,
             skins: Skins, more: SkinFields, scratch: Scratch, field: FieldScratch, out: wp.array3d(dtype=wp.float32),
             out_double: wp.array3d(dtype=real)):  # fmt: skip
    """The motion, no longer than there is skin, to one of the outputs; NaN where a scene is not served."""
    f, lane = wp.tid()
    one, good, wide = skins.one[scratch.skin[pick[f] * many]], wp.bool(True), wp.max(out.shape[1], out_double.shape[1])
    for k in range(many):
        good = good and scratch.status[pick[f] * many + k] < REFUSED
    for n in range(lane, wide, lanes):
        moved, place = vec3(), wp.int32(n)
        if n < one.end - one.first:
            moved = field.motion[f, n]  # not as a tuple: Warp would not copy
            place = more.original[one.first + n]
            t, length = skins.thickness[one.first + n], wp.length(moved)
            if length > MOST_MOVED * t:
                over = (length / t - MOST_MOVED) / (real(1.0) - MOST_MOVED)
                moved = moved * (t * (MOST_MOVED + (real(1.0) - MOST_MOVED) * wp.tanh(over)) / length)
            if not good:
                moved = vec3(NAN, NAN, NAN)
        for x in range(3):
            if out.shape[0] > 0:
                out[to[f], place, x] = wp.float32(moved[x])
            else:
                out_double[to[f], place, x] = moved[x]
