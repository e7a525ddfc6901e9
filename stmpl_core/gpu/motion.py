# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels of the motion of skin under what tools press: stmpl_core.methods.moment_net, at the same vertices.

A thread takes a vertex: it sums what presses around it and runs the network. What a scene sums up over its vertices is
summed lane by lane, so for one number of lanes an answer is the same to the bit from run to run.
"""

import math

import warp as wp

from stmpl_core import response, thinning
from stmpl_core.gpu.columns import _marked
from stmpl_core.gpu.field_packs import HIDDEN as UNITS
from stmpl_core.gpu.field_packs import FieldScratch, MotionNet, SkinFields
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import BY_POSE
from stmpl_core.gpu.rays import OPTIONS, real, vec3
from stmpl_core.methods import moment_net as law
from stmpl_core.networks import DIRECTIONS, INPUTS, MOTION, STACK_INPUTS

FILLED_FROM = wp.constant(thinning.CORNERS)
MOST_FOLDS = wp.constant(31)  # the highest number of a group, whose bits are those of a word
FAR, STEPS = wp.constant(wp.float32(response.REACH)), wp.constant(wp.float32(response.STEPS))
NEAR_END, FINER = wp.constant(wp.float32(response.NEAR * response.STEPS)), wp.constant(wp.float32(response.FINER))
PER_LOG = wp.constant(wp.float32(1 / math.log(response.SPREADS[1] / response.SPREADS[0])))
TOP = wp.constant(wp.float32(len(response.SPREADS) - 1.001))
SCALARS, VECTORS, TENSORS = (wp.constant(n) for n in (response.SCALARS, response.VECTORS, response.TENSORS))
WAYS, MIXED_VECTORS, MIXED_TENSORS = (wp.constant(n) for n in (DIRECTIONS, law.MIXED_VECTORS, law.MIXED_TENSORS))
AMPLITUDE, SURROUNDED = wp.constant(wp.float32(law.AMPLITUDE)), wp.constant(wp.float32(law.SURROUNDED))
FADE, RING = wp.constant(wp.float32(law.FADE)), wp.constant(wp.float32(law.RING))
LEAST_GAIN, MOST_GAIN = (wp.constant(wp.float64(gain)) for gain in law.GAINS)
HIDDEN, SAID, MORE = wp.constant(UNITS), wp.constant(MOTION.size), wp.constant(INPUTS.size)
IN_SCALARS, IN_NORMAL, IN_HERE = (wp.constant(n) for n in (INPUTS.at.scalars, INPUTS.at.linear_normal, INPUTS.at.here))
IN_LOG_HERE, IN_LOG_G = wp.constant(INPUTS.at.log_here), wp.constant(INPUTS.at.log_g)
IN_G, IN_ROOT_G = wp.constant(INPUTS.at.g), wp.constant(INPUTS.at.root_g)
IN_DIFFERENCE, IN_PRODUCTS = wp.constant(INPUTS.at.field_difference), wp.constant(INPUTS.at.vector_products)
IN_TENSORS, IN_ALONG = wp.constant(INPUTS.at.tensor_products), wp.constant(INPUTS.at.tensor_along_vector)
IN_TURNED, IN_CURVED = wp.constant(INPUTS.at.tensor_along_curvature), wp.constant(INPUTS.at.curvature_along_vector)
IN_SLOPE, IN_MEAN = wp.constant(INPUTS.at.slope_along_vector), wp.constant(INPUTS.at.mean_curvature)
IN_BEND, IN_CONSTANTS = wp.constant(INPUTS.at.squared_bend), wp.constant(INPUTS.at.constants)
IN_VOLUMETRIC, IN_SLOPES = wp.constant(INPUTS.at.volumetric), wp.constant(INPUTS.at.squared_slope)
OUT_NORMAL, OUT_WAYS, OUT_TURNED = (wp.constant(n) for n in (MOTION.at.normal, MOTION.at.directions, MOTION.at.turned))
OUT_CURVED, OUT_SLOPE = wp.constant(MOTION.at.curved), wp.constant(MOTION.at.slope)
mat28, row, hidden, said = (wp.types.matrix(shape=(2, 8), dtype=wp.float32),
                            *(wp.types.vector(length=n, dtype=wp.float32)
                              for n in (STACK_INPUTS.size, UNITS, MOTION.size)))
mat14, mat82 = (wp.types.matrix(shape=(n, 2), dtype=wp.float32) for n in (14, 8))
mat62, mat42 = (wp.types.matrix(shape=(n, 2), dtype=wp.float32) for n in (6, 4))
assert (DIRECTIONS, 2 * response.TENSORS, law.MIXED_VECTORS, law.MIXED_TENSORS) == (14, 8, 6, 4)
wp.set_module_options({**OPTIONS, "max_unroll": 2})


@wp.kernel
def list_under(pick: wp.array(dtype=wp.int32), many: wp.int32, skins: Skins, scratch: Scratch, field: FieldScratch):
    """Vertices of the triangles that pressing tools touch, of each scene; counted where there is no room."""
    f = wp.tid()
    s, count = pick[f], wp.int32(0)
    one = skins.one[scratch.skin[s * many]]
    for b in range(one.end_ball - one.first_ball):
        mask = wp.uint32(0)
        for k in range(many):
            if scratch.status[s * many + k] == BY_POSE and scratch.nodes[s] > 0:
                mask = mask | scratch.seen[s * many + k, b]
        if mask != wp.uint32(0):
            for bit in range(32):
                if ((mask >> wp.uint32(bit)) & wp.uint32(1)) == wp.uint32(1):
                    if count < field.under.shape[1]:
                        field.under[f, count] = one.first + b * 32 + bit
                    count += 1
    field.many[f] = wp.min(count, field.under.shape[1])
    wp.atomic_max(field.most, 0, count)


@wp.func
def _stretch(p: real, mu: real, lam: real) -> real:
    """Stretch of a confined column under a pressure > 0, all over E: stmpl_core.methods.winkler.column_stretch."""
    side = p / (real(2.0) * mu)
    q = -wp.min(p / (lam + real(2.0) * mu), wp.log(side + wp.sqrt(side * side + real(1.0))))
    step, n = real(1.0), wp.int32(0)
    while n < 60 and wp.abs(step) > real(1e-15):
        left = real(2.0) * mu * wp.sinh(q) + lam * q * wp.exp(-q) + p
        step = -left / (real(2.0) * mu * wp.cosh(q) + lam * wp.exp(-q) * (real(1.0) - q))
        q = wp.min(q + step, real(0.0))
        n += 1
    return wp.exp(q)


@wp.kernel
def press(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
          field: FieldScratch):  # fmt: skip
    """Pressure over E at these vertices, of each tool; and both source fields of all."""
    f, lane = wp.tid()
    s = pick[f]
    one = skins.one[scratch.skin[s * many]]
    for n in range(lane, field.many[f], lanes):
        v, total = field.under[f, n], real(0.0)
        for k in range(many):
            force = real(0.0)
            for i in range(scratch.nodes[s]):
                if scratch.tool[s, i] == k:
                    corners = skins.faces[scratch.face[s, i]]
                    for x in range(3):
                        if corners[x] == v:
                            force += scratch.pressure[s, i] * scratch.area[s, i] * scratch.shares[s, i][x]
            force = wp.max(force, real(0.0)) / skins.area[v]
            field.press[f * many + k, n] = force
            total += force
        strain = real(0.0)
        if total > real(0.0):
            strain = (real(1.0) - _stretch(total, one.mu, one.lam)) * (one.lam + real(2.0) * one.mu)
        field.source[f, n] = wp.vec2f(wp.float32(total), wp.float32(strain))


@wp.kernel
def forget(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, first: wp.int32, skins: Skins,
           scratch: Scratch, field: FieldScratch):  # fmt: skip
    """No vertex feels anything yet; first: 1, and none moves."""
    f, lane = wp.tid()
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, one.end - one.first, lanes):
        field.mark[f, n] = 0
        field.feels[f, n] = wp.uint32(0)
        field.ask[f, n] = 0
        field.here[f, n] = wp.vec2f()
        if first == 1:
            field.motion[f, n] = vec3()


@wp.kernel
def fold(pick: wp.array(dtype=wp.int32), many: wp.int32, all: wp.int32, skins: Skins, scratch: Scratch,
         field: FieldScratch):  # fmt: skip
    """Groups of sources of which none feels another, on skin with folds: thinning._together; all: see `mark`."""
    f = wp.tid()
    one, count, groups, left = skins.one[scratch.skin[pick[f] * many]], field.many[f], wp.int32(0), wp.int32(0)
    field.folds[f] = 1
    if one.folded == 0:
        return
    for n in range(count):
        field.fold[f, n] = -1
        if all == 1 or field.source[f, n][0] != wp.float32(0.0):
            left += 1
    for n in range(count):
        if field.fold[f, n] < 0 and (all == 1 or field.source[f, n][0] != wp.float32(0.0)):
            field.fold[f, n] = groups
            field.queue[f, 0] = n
            done, end = wp.int32(0), wp.int32(1)
            left -= 1
            while done < end and left > 0:
                v = field.under[f, field.queue[f, done]]
                done += 1
                for m in range(count):
                    if field.fold[f, m] < 0 and (all == 1 or field.source[f, m][0] != wp.float32(0.0)):
                        w = field.under[f, m] - one.first
                        if _marked(skins.linked, v, w):
                            field.fold[f, m] = groups
                            field.queue[f, end] = m
                            end += 1
                            left -= 1
            groups = wp.min(groups + 1, MOST_FOLDS)
    field.folds[f] = groups


@wp.func
def feels(field: FieldScratch, f: wp.int32, n: wp.int32, m: wp.int32) -> bool:
    """Whether a vertex feels a source: not what is near it through the air only."""
    return field.folds[f] <= 1 or \
        ((field.feels[f, n] >> wp.uint32(field.fold[f, m])) & wp.uint32(1)) == wp.uint32(1)  # fmt: skip


@wp.func
def in_reach(skins: Skins, more: SkinFields, v: wp.int32, w: wp.int32) -> bool:
    """Whether two vertices feel each other, if what stands for them does: as stmpl_core.thinning."""
    reach, away = real(FAR), skins.points[v] - skins.points[w]
    return wp.dot(more.frame[v][2], more.frame[w][2]) > wp.float32(0.0) and \
        wp.dot(away, away) < reach * reach * skins.thickness[v] * skins.thickness[w]  # fmt: skip


@wp.kernel
def mark(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, all: wp.int32, skins: Skins, more: SkinFields,
         scratch: Scratch, field: FieldScratch):  # fmt: skip
    """How near a source each vertex is: thinning._zones; all: 1, those that carry nothing too."""
    f, lane = wp.tid()
    one, zones = skins.one[scratch.skin[pick[f] * many]], more.stands.shape[0]
    first = one.first
    for n in range(field.many[f]):
        v = field.under[f, n]
        if all == 1 or field.source[f, n][0] != wp.float32(0.0):
            field.here[f, v - first] = field.source[f, n]  # each lane says so; they share out the neighbours
            for z in range(zones):
                for p in range(more.reach[zones * v + z][0] + lane, more.reach[zones * v + z][1], lanes):
                    for q in range(more.heads[more.index[p]], more.heads[more.index[p] + 1]):
                        if z == zones - 1 and one.stacked == 0 and not in_reach(skins, more, v, more.member[q]):
                            continue
                        wp.atomic_max(field.mark, f, more.member[q] - first, zones - z)
                        if field.folds[f] > 1:
                            fold = wp.uint32(1) << wp.uint32(field.fold[f, n])
                            wp.atomic_or(field.feels, f, more.member[q] - first, fold)


@wp.kernel
def ask(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
        scratch: Scratch, field: FieldScratch):  # fmt: skip
    """Which vertices are asked: those that stand for themselves, and those from which others are filled in."""
    f, lane = wp.tid()
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, one.end - one.first, lanes):
        if field.mark[f, n] > 0:
            z, v = more.stands.shape[0] - field.mark[f, n], one.first + n
            if more.stands[z, v] != wp.uint8(0):
                field.ask[f, n] = 1
            else:
                for k in range(FILLED_FROM):
                    field.ask[f, more.corners[z, v, k] - one.first] = 1


@wp.func
def _smooth(x: wp.float32) -> wp.float32:
    y = wp.clamp(x, wp.float32(0.0), wp.float32(1.0))
    return y * y * (wp.float32(3.0) - wp.float32(2.0) * y)


@wp.func
def _at(table: wp.array3d(dtype=wp.float32), id: wp.int32, g: wp.int32, k: wp.int32, rest: wp.float32, h: wp.float32
        ) -> wp.float32:  # fmt: skip
    """Value of a table between its rows."""
    low = (wp.float32(1.0) - rest) * table[id, g, k] + rest * table[id, g, k + 1]
    high = (wp.float32(1.0) - rest) * table[id, g + 1, k] + rest * table[id, g + 1, k + 1]
    return (wp.float32(1.0) - h) * low + h * high


@wp.func
def _layer(given: hidden, w: wp.array2d(dtype=wp.float32), b: wp.array(dtype=wp.float32)) -> hidden:
    """A hidden layer."""
    out = hidden()
    for m in range(HIDDEN):
        x = given[m]
        for unit in range(HIDDEN):
            out[unit] = out[unit] + x * w[m, unit]
    for unit in range(HIDDEN):
        x = out[unit] + b[unit]
        out[unit] = x * (wp.float32(0.5) + wp.float32(0.5) * x / (wp.float32(1.0) + wp.abs(x)))
    return out


@wp.func
def _think(inputs: row, net: MotionNet) -> said:
    """What the network says."""
    one = hidden()
    for m in range(net.w1.shape[0]):
        x = (wp.clamp(inputs[m], net.low[m], net.high[m]) - net.mean[m]) * net.scale[m]
        for unit in range(HIDDEN):
            one[unit] = one[unit] + x * net.w1[m, unit]
    for unit in range(HIDDEN):
        x = one[unit] + net.b1[unit]
        one[unit] = x * (wp.float32(0.5) + wp.float32(0.5) * x / (wp.float32(1.0) + wp.abs(x)))
    two = _layer(one, net.w2, net.b2)
    three = _layer(two, net.w3, net.b3)
    out = said()
    for m in range(HIDDEN):
        for k in range(SAID):
            out[k] = out[k] + three[m] * net.w4[m, k]
    for k in range(SAID):
        out[k] = out[k] + net.b4[k]
    return out


@wp.func
def _bent(turn: wp.float32, bend: wp.float32, x: wp.float32, y: wp.float32) -> wp.float32:
    """A way along a traceless tensor, twice."""
    return turn * (x * x - y * y) + wp.float32(2.0) * bend * x * y


@wp.kernel
def move(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
         scratch: Scratch, field: FieldScratch, net: MotionNet):  # fmt: skip
    """Motion of the vertices that are asked, as a part that is fixed and one that a gain is still to scale."""
    f, lane = wp.tid()
    zero, unit = wp.float32(0.0), wp.float32(1.0)
    id = scratch.skin[pick[f] * many]
    one, told = skins.one[id], wp.vec2d()
    for local in range(lane, one.end - one.first, lanes):
        if field.ask[f, local] == 1:
            v = one.first + local
            site, frame, at = more.site[v], more.frame[v], more.at[v]
            linear_0, linear_1 = wp.vec3f(), wp.vec3f()
            even, cos_1, sin_1, cos_2, sin_2 = mat28(), mat28(), mat28(), mat28(), mat28()
            for n in range(field.many[f]):
                source = field.source[f, n]
                if source[0] != zero and feels(field, f, local, n):
                    q = field.under[f, n]
                    other, away = more.site[q], more.at[q] - at
                    inverse = site[0] * other[0]
                    square = wp.length_sq(away) * inverse * inverse
                    along = frame * away
                    x, y = along[0] * inverse, along[1] * inverse
                    flat = unit / wp.sqrt(x * x + y * y + wp.float32(1e-12))
                    facing = frame[2, 0] * more.normal[q][0] + frame[2, 1] * more.normal[q][1] + \
                        frame[2, 2] * more.normal[q][2]  # fmt: skip
                    if facing > zero and square < FAR * FAR:
                        area, far = other[1] * inverse * inverse, wp.sqrt(square) * STEPS
                        h = wp.clamp((other[3] - site[2]) * PER_LOG, zero, TOP)
                        k, low, c, d = wp.int32(far), wp.int32(h), x * flat, y * flat
                        scale = area * site[0] / other[0]
                        sinks = scale * _at(more.sink, id, low, k, far - wp.float32(k), h - wp.float32(low))
                        goes = scale * _at(more.away, id, low, k, far - wp.float32(k), h - wp.float32(low))
                        by = wp.vec3f(-goes * c, -goes * d, -sinks)
                        linear_0 = linear_0 + source[0] * by
                        linear_1 = linear_1 + source[1] * by
                        if far < NEAR_END:
                            ring = wp.int32(far * FINER + wp.float32(0.5))
                            scalars, vectors, tensors = more.rings[ring, 0], more.rings[ring, 1], more.rings[ring, 2]
                            c_2, d_2 = c * c - d * d, (c + c) * d
                            for p in range(2):
                                value = source[p] * area
                                for m in range(8):
                                    even[p, m] = even[p, m] + value * scalars[m]
                                    cos_1[p, m] = cos_1[p, m] + value * c * vectors[m]
                                    sin_1[p, m] = sin_1[p, m] + value * d * vectors[m]
                                    cos_2[p, m] = cos_2[p, m] + value * c_2 * tensors[m]
                                    sin_2[p, m] = sin_2[p, m] + value * d_2 * tensors[m]
            thick = wp.float32(skins.thickness[v])
            if one.stacked == 1:  # known better: see stmpl_core.gpu.sticks
                thick = wp.float32(one.flat)
                known = field.linear[f, local]
                linear_0 = frame * wp.vec3f(wp.float32(known[0]), wp.float32(known[1]), wp.float32(known[2])) / thick
                linear_1 = wp.vec3f(linear_0)
            g = wp.float32(0.0)
            for m in range(SCALARS):
                g += wp.abs(even[1, m])
            fixed, scaled = wp.vec3f(), wp.vec3f(linear_1)
            if g > SURROUNDED:
                per = unit / g
                ways, turns = mat14(), mat82()
                for p in range(2):
                    for m in range(VECTORS):
                        ways[p * VECTORS + m, 0] = cos_1[p, m] * per
                        ways[p * VECTORS + m, 1] = sin_1[p, m] * per
                    for m in range(TENSORS):
                        turns[p * TENSORS + m, 0] = cos_2[p, m] * per
                        turns[p * TENSORS + m, 1] = sin_2[p, m] * per
                for m in range(2):
                    ways[2 * VECTORS, m] = linear_0[m] * per
                    ways[2 * VECTORS + 1, m] = linear_1[m] * per
                mixed, tensor = mat62(), mat42()
                for a in range(MIXED_VECTORS):
                    for m in range(WAYS):
                        mixed[a, 0] = mixed[a, 0] + net.mix_vectors[a, m] * ways[m, 0]
                        mixed[a, 1] = mixed[a, 1] + net.mix_vectors[a, m] * ways[m, 1]
                for a in range(MIXED_TENSORS):
                    for m in range(2 * TENSORS):
                        tensor[a, 0] = tensor[a, 0] + net.mix_tensors[a, m] * turns[m, 0]
                        tensor[a, 1] = tensor[a, 1] + net.mix_tensors[a, m] * turns[m, 1]
                turn, bend = wp.float32(0.5) * (more.shape[v, 0] - more.shape[v, 2]), more.shape[v, 1]
                slope_x, slope_y = more.shape[v, 3], more.shape[v, 4]
                here, inputs = field.here[f, local], row()
                for p in range(2):
                    for m in range(SCALARS):
                        inputs[IN_SCALARS + p * SCALARS + m] = even[p, m] * per
                    inputs[IN_HERE + p] = here[p] * per
                    inputs[IN_LOG_HERE + p] = wp.log(wp.abs(here[p]) + wp.float32(0.02))
                for m in range(SCALARS):
                    inputs[IN_DIFFERENCE + m] = even[0, m] - even[1, m]
                inputs[IN_NORMAL] = linear_0[2] * per
                inputs[IN_NORMAL + 1] = linear_1[2] * per
                inputs[IN_LOG_G] = wp.log(g + wp.float32(1e-4))
                inputs[IN_G] = g
                inputs[IN_ROOT_G] = wp.sqrt(g)
                k = wp.int32(IN_PRODUCTS)
                for a in range(MIXED_VECTORS):
                    for b in range(a, MIXED_VECTORS):
                        inputs[k] = mixed[a, 0] * mixed[b, 0] + mixed[a, 1] * mixed[b, 1]
                        k += 1
                k = wp.int32(IN_TENSORS)
                for a in range(MIXED_TENSORS):
                    for b in range(a, MIXED_TENSORS):
                        inputs[k] = tensor[a, 0] * tensor[b, 0] + tensor[a, 1] * tensor[b, 1]
                        k += 1
                for a in range(MIXED_TENSORS):
                    inputs[IN_ALONG + a] = _bent(tensor[a, 0], tensor[a, 1], mixed[a, 0], mixed[a, 1])
                    inputs[IN_TURNED + a] = turn * tensor[a, 0] + bend * tensor[a, 1]
                for a in range(MIXED_VECTORS):
                    inputs[IN_CURVED + a] = _bent(turn, bend, mixed[a, 0], mixed[a, 1])
                    inputs[IN_SLOPE + a] = slope_x * mixed[a, 0] + slope_y * mixed[a, 1]
                nu = wp.float32(one.nu)
                inputs[IN_MEAN] = wp.float32(0.5) * (more.shape[v, 0] + more.shape[v, 2])
                inputs[IN_BEND] = turn * turn + bend * bend
                inputs[IN_CONSTANTS] = nu
                inputs[IN_VOLUMETRIC] = unit / (wp.float32(1.02) - wp.float32(2.0) * nu)
                inputs[IN_SLOPES] = slope_x * slope_x + slope_y * slope_y
                if one.stacked == 1:
                    inputs[MORE] = wp.float32(wp.log(skins.thickness[v] / one.flat))
                    inputs[MORE + 1] = wp.float32(wp.log(one.effective / one.flat))
                    inputs[MORE + 2] = wp.float32(one.log_kappa)
                    inputs[MORE + 3] = wp.float32(one.log_pull)
                    inputs[MORE + 4] = wp.float32(wp.log(one.softness))
                    inputs[MORE + 5] = wp.float32(wp.log(field.peak[f] / one.flat + real(1e-6)))
                    inputs[MORE + 6] = wp.float32(skins.alike[v][1])
                    inputs[MORE + 7] = wp.float32(skins.alike[v][2])
                out = _think(inputs, net)
                x, y = out[OUT_SLOPE] * slope_x, out[OUT_SLOPE] * slope_y
                for m in range(WAYS):
                    x += out[OUT_WAYS + m] * ways[m, 0]
                    y += out[OUT_WAYS + m] * ways[m, 1]
                for m in range(MIXED_TENSORS):
                    x += out[OUT_TURNED + m] * (tensor[m, 0] * mixed[m, 0] + tensor[m, 1] * mixed[m, 1])
                    y += out[OUT_TURNED + m] * (tensor[m, 1] * mixed[m, 0] - tensor[m, 0] * mixed[m, 1])
                for m in range(MIXED_VECTORS):
                    x += out[OUT_CURVED + m] * (turn * mixed[m, 0] + bend * mixed[m, 1])
                    y += out[OUT_CURVED + m] * (bend * mixed[m, 0] - turn * mixed[m, 1])
                most = AMPLITUDE * g / (unit + g)
                whole = linear_1 + most * wp.vec3f(x, y, out[OUT_NORMAL])
                square = wp.length_sq(linear_1)
                ratio = g / (wp.sqrt(square) + wp.float32(1e-30))
                share = _smooth(ratio / FADE)
                if here[0] == zero:
                    weight = share * (unit - _smooth(ratio / RING))
                    told = told + wp.vec2d(real(weight * wp.dot(linear_1, whole)), real(weight * square))
                fixed = share * whole
                scaled = (unit - share) * linear_1
            field.fixed[f, local] = thick * (wp.transpose(frame) * fixed)
            field.scaled[f, local] = thick * (wp.transpose(frame) * scaled)
    field.told[f, lane] = told


@wp.kernel
def gain(lanes: wp.int32, field: FieldScratch):
    """The multiple of the linear response with which a scene's answer goes on where its moments end."""
    f = wp.tid()
    told = wp.vec2d(real(1e-30), real(1e-30))
    for lane in range(lanes):
        told = told + field.told[f, lane]
    field.gain[f] = wp.clamp(told[0] / told[1], LEAST_GAIN, MOST_GAIN)


@wp.func
def _moved(field: FieldScratch, f: wp.int32, n: wp.int32, spread: wp.int32) -> vec3:
    """Motion of a vertex that was asked, or what was spread to it."""
    if spread == 1:
        return field.spread[f, n]
    fixed, scaled = field.fixed[f, n], field.scaled[f, n]
    g = field.gain[f]
    return vec3(real(fixed[0]) + g * real(scaled[0]), real(fixed[1]) + g * real(scaled[1]),
                real(fixed[2]) + g * real(scaled[2]))  # fmt: skip


@wp.func
def _before(field: FieldScratch, f: wp.int32, n: wp.int32, spread: wp.int32) -> vec3:
    if spread == 2:
        return vec3()
    return field.motion[f, n]


@wp.kernel
def fill(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, spread: wp.int32, skins: Skins,
         more: SkinFields, scratch: Scratch, field: FieldScratch):  # fmt: skip
    """Adds the motion of all vertices, from those that were asked; spread: 1, what corrects it, 2: not added."""
    f, lane = wp.tid()
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, one.end - one.first, lanes):
        if field.ask[f, n] == 1:
            field.motion[f, n] = _before(field, f, n, spread) + _moved(field, f, n, spread)
        elif field.mark[f, n] > 0:
            z, v, sum = more.stands.shape[0] - field.mark[f, n], one.first + n, vec3()
            for k in range(FILLED_FROM):
                weight = real(more.weights[z, v, k])
                sum = sum + weight * _moved(field, f, more.corners[z, v, k] - one.first, spread)
            field.motion[f, n] = _before(field, f, n, spread) + sum
