# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels of the linear motion of a limb's skin that sticks to its tools: stmpl_core.stick, by stmpl_core.green.

The nodes that press without friction go with their tools in all directions. One system of 3 x 3 blocks a scene says
with which forces, and is eliminated without pivots: it is nearly a positive kernel's, with a ridge. These forces move
the vertices that are asked, as on a flat stack, and all vertices with the limb's coarse mesh.
"""

import warp as wp

from stmpl_core import conform, green, moments, softness, stick, thinning
from stmpl_core.gpu.blocks import most_of, sum_before, wait
from stmpl_core.gpu.columns import _marked
from stmpl_core.gpu.field_packs import FieldScratch, SkinFields
from stmpl_core.gpu.motion import MOST_FOLDS, _stretch
from stmpl_core.gpu.packs import Scratch, Skins
from stmpl_core.gpu.places import REFUSED
from stmpl_core.gpu.rays import OPTIONS, along, depth_in_column, mat33, real, sure_of, vec3, wall_in
from stmpl_core.gpu.stacks import FARTHEST, ROUND_SQUARE, ROWS, SPREAD, _row_of, _share

LEAST_COSINE, FURTHEST = wp.constant(wp.float64(green.ONE_WAY)), wp.constant(wp.float64(stick.FURTHEST))
LEAVES = wp.constant(wp.float64(stick.LEAVES))
HELD_FROM, LEAST_FIRM = wp.constant(wp.float64(stick.FIRM)), wp.constant(wp.float64(green.LEAST_FIRM))
TINY = wp.constant(wp.float64(1e-300))
RIDGE, REACH = wp.constant(wp.float64(green.RIDGE)), wp.constant(wp.float64(green.REACH))
LYING, BEYOND = wp.constant(wp.float64(conform.MIN_LYING_PRESSURE)), wp.constant(wp.float64(conform.BEYOND))
WIDER = wp.constant(wp.float64(moments.SMOOTH / (0.5 * 3**0.5) ** 0.5))  # of the root of a node's area
FINE_SPREADS, FINE_SOFTS = wp.constant(wp.float64(16.0)), wp.constant(wp.float64(32.0))  # steps of green.add_motion
BANK = wp.constant(softness.BANK)
ENDS = wp.constant(wp.vec4d(*(wp.float64(x) for x in (*thinning.STACK_ZONES, 1e30))))
wp.set_module_options({**OPTIONS, "max_unroll": 4})


@wp.kernel
def unite(scratch: Scratch):
    """All tools of a scene are one group: what sticks to one is felt by all."""
    c = wp.tid()
    scratch.group[c] = 0


@wp.kernel
def list_holding(pick: wp.array(dtype=wp.int32), many: wp.int32, scratch: Scratch, field: FieldScratch):
    """Nodes that press without friction, of scenes that are served; counted where there is no room."""
    f = wp.tid()
    s, count, total, square = pick[f], wp.int32(0), real(0.0), real(0.0)
    good = wp.bool(True)
    field.parted[f] = 0
    for k in range(many):
        good = good and scratch.status[s * many + k] < REFUSED
    if good:
        for i in range(scratch.nodes[s]):
            if scratch.force[s, i] > real(0.0):
                if count > 0 and scratch.fold[s, i] != scratch.fold[s, field.hold[f, 0]]:
                    field.parted[f] = 1
                if count < field.hold.shape[1]:
                    field.hold[f, count] = i
                count += 1
                total += scratch.force[s, i]
                square += scratch.force[s, i] * scratch.force[s, i] / scratch.area[s, i]
    field.light[f] = HELD_FROM * square / wp.max(total, TINY)
    field.holds[f] = wp.min(count, field.hold.shape[1])
    wp.atomic_max(field.most, 0, count)


@wp.kernel
def go(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
       field: FieldScratch):  # fmt: skip
    """Where these go with their tools, stick._along; and how each goes with the limb under a pressure at its mesh.

    Of the tables of green.add_motion each reads a row between two spreads and a softness, in few steps of both; third
    is the square of the distance at which what it does no longer rises, over the thickness.
    """
    f, lane = wp.tid()
    s = pick[f]
    one, met = skins.one[scratch.skin[s * many]], scratch.meets[s]
    for a in range(lane, field.holds[f], lanes):
        i = field.hold[f, a]
        k = scratch.tool[s, i]
        c = s * many + k
        inward = scratch.inward[s, i]
        way = vec3(inward)
        if field.one_way[f * many + k] == 1:
            way = field.way[f * many + k]
        pose = wp.transpose(scratch.pose[c])
        depth = scratch.sinking[s, i] / wp.max(wp.dot(inward, way), LEAST_COSINE)
        start = pose * (scratch.point[s, i] - scratch.place[c])
        grid = skins.grids[scratch.grid[c]]
        far = wp.min(depth_in_column(grid, skins.coefficients, start, pose * way, real(4.0) * depth, depth),
                     FURTHEST * depth)  # fmt: skip
        wall = wall_in(grid, scratch.thick[s, i])
        leaves = (along(grid, skins.coefficients, start, pose * way, far)
                  - along(grid, skins.coefficients, start, pose * way, far - wall)) / wall  # fmt: skip
        sure = sure_of(grid, skins.coefficients, start, pose * way, depth, wall)
        share = wp.min(wp.max(sure, real(0.0)), wp.clamp(leaves / LEAVES, real(0.0), real(1.0)))
        field.pull[f, a] = (depth + share * (far - depth)) * way
        field.firm[f, a] = wp.min(scratch.force[s, i] / (scratch.area[s, i] * field.light[f]), real(1.0)) * (
            real(1.0) + wp.min(sure, real(0.0)))  # fmt: skip
        fine = wp.floor(FINE_SPREADS * _row_of(wp.log(SPREAD * wp.sqrt(scratch.area[s, i]) / one.flat)))
        soft = wp.floor(FINE_SOFTS * scratch.soft[s, i] + real(0.5))
        field.row[f, a] = vec3((fine + real(0.5)) / FINE_SPREADS, soft / FINE_SOFTS,
                               scratch.area[s, i] * ROUND_SQUARE / (one.flat * one.flat))  # fmt: skip
    for n in range(lane, field.holds[f] * met, lanes):
        a, d = n // met, n % met
        i = field.hold[f, a]
        sum, to = vec3(), one.first_motion + scratch.met[s, d]
        for k in range(scratch.around_node[s, i]):
            row = to + 3 * one.coarse * scratch.met[s, scratch.slots[s, i, k]]
            sum = sum + scratch.weights[s, i, k] * vec3(real(skins.motion[row]), real(skins.motion[row + one.coarse]),
                                                        real(skins.motion[row + 2 * one.coarse]))  # fmt: skip
        field.with_limb[f, a, d] = sum


@wp.func
def _at(more: SkinFields, b: wp.int32, m: wp.int32, g: wp.int32, k: wp.int32, f: real, h: real) -> real:
    low = (real(1.0) - f) * more.greens[b, m, g, k] + f * more.greens[b, m, g, k + 1]
    high = (real(1.0) - f) * more.greens[b, m, g + 1, k] + f * more.greens[b, m, g + 1, k + 1]
    return (real(1.0) - h) * low + h * high


@wp.func
def _softly(more: SkinFields, id: wp.int32, soft: real, k: wp.int32, f: real, g: wp.int32, h: real) -> wp.vec4d:
    """The four responses of a flat stack of some softness, at a place of their tables."""
    share, b, out = soft - wp.floor(soft), BANK * id + wp.int32(soft), wp.vec4d()
    for m in range(4):
        value = _at(more, b, m, g, k, f, h)
        if share > real(0.0):
            value += share * (_at(more, b + 1, m, g, k, f, h) - value)
        out[m] = value
    return out


@wp.func
def _of_force(n: vec3, s: vec3, d: vec3, size: real, g: wp.vec4d, force: vec3) -> vec3:
    """Flat motion of a point under a force: green._of_force."""
    m = n + s
    m = m / wp.sqrt(wp.max(wp.length_sq(m), real(1e-12)))
    across = d - wp.dot(d, m) * m
    length = wp.length(across)
    if length > real(1e-6) * size:
        across = across / length
    else:
        across = vec3()
    down, along = wp.dot(force, s), force - wp.dot(force, m) * m
    radial = wp.dot(along, across)
    sinks, goes = g[0] * down - g[1] * radial, g[1] * down + g[3] * radial
    return sinks * n + goes * across + (g[2] - real(0.5) * g[3]) * along


@wp.kernel
def fill_blocks(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
                scratch: Scratch, field: FieldScratch):  # fmt: skip
    """Motion of each of these nodes under a force E at each: green._blocks."""
    f, lane = wp.tid()
    s, count = pick[f], field.holds[f]
    id = scratch.skin[s * many]
    t = skins.one[id].flat
    for p in range(lane, count * count, lanes):
        a, b = p // count, p % count
        block = mat33()
        i = field.hold[f, a]
        j = field.hold[f, b]
        if scratch.fold[s, i] == scratch.fold[s, j]:
            wide = vec3()
            n = scratch.inward[s, i]
            source = scratch.inward[s, j]
            for k in range(scratch.around_node[s, j]):
                wide = wide + scratch.parts[s, j, k] * field.with_limb[f, a, scratch.slots[s, j, k]]
            block = wp.outer(wide, source)
            facing, away = wp.dot(n, source), scratch.point[s, i] - scratch.point[s, j]
            r = wp.length(away) / t
            if facing > real(0.0) and r < REACH:
                mean = real(0.5) * (scratch.area[s, i] + scratch.area[s, j])
                x, h = wp.min(wp.sqrt(r) * ROWS, FARTHEST), _row_of(wp.log(SPREAD * wp.sqrt(mean) / t))
                soft = real(0.5) * (scratch.soft[s, i] + scratch.soft[s, j])
                k, g = wp.int32(x), wp.int32(h)
                per = _share(facing) / (wp.sqrt(r * r + mean * ROUND_SQUARE / (t * t)) * t)
                told = per * _softly(more, id, soft, k, x - real(k), g, h - real(g))
                if a >= b:
                    for y in range(3):
                        force = vec3()
                        force[y] = real(1.0)
                        moved = _of_force(n, source, away, t, told, force)
                        for z in range(3):
                            block[z, y] = block[z, y] + moved[z]
                else:  # what j does to i, the other way round
                    for y in range(3):
                        force = vec3()
                        force[y] = real(1.0)
                        moved = _of_force(source, n, -away, t, told, force)
                        for z in range(3):
                            block[y, z] = block[y, z] + moved[z]
        field.block[f, a, b] = block


@wp.kernel
def solve(field: FieldScratch):
    """Forces over E that take the nodes there, by Gauss's elimination; two nodes in one place are no error."""
    f, lane = wp.tid()
    lanes, count, most = wp.block_dim(), field.holds[f], real(0.0)
    for n in range(lane, count * count, lanes):
        block = field.block[f, n // count, n % count]
        for y in range(3):
            for z in range(3):
                most = wp.max(most, wp.abs(block[y, z]))
    most = most_of(most)
    for a in range(lane, count, lanes):
        own, firm = field.block[f, a, a], wp.max(field.firm[f, a], LEAST_FIRM)
        more = (real(1.0) / (firm * firm) - real(1.0)) * wp.trace(own) / real(3.0) + RIDGE * most
        field.block[f, a, a] = own + more * wp.identity(n=3, dtype=real)
    wait()
    for k in range(count):
        pivot, rest = wp.inverse(field.block[f, k, k]), count - k - 1
        for i in range(k + 1 + lane, count, lanes):
            factor = field.block[f, i, k] * pivot
            field.block[f, i, k] = factor
            field.pull[f, i] = field.pull[f, i] - factor * field.pull[f, k]
        wait()
        for n in range(lane, rest * rest, lanes):
            i, j = k + 1 + n // rest, k + 1 + n % rest
            field.block[f, i, j] = field.block[f, i, j] - field.block[f, i, k] * field.block[f, k, j]
        wait()
    for back in range(count):
        k = count - 1 - back
        force = wp.inverse(field.block[f, k, k]) * field.pull[f, k]
        for i in range(lane, k, lanes):
            field.pull[f, i] = field.pull[f, i] - field.block[f, i, k] * force
        wait()
        if lane == 0:
            field.pull[f, k] = force


@wp.kernel
def mark(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
         scratch: Scratch, field: FieldScratch):  # fmt: skip
    """How near one of these nodes each vertex is: thinning._zones of their corners."""
    f, lane = wp.tid()
    s, zones = pick[f], more.stands.shape[0]
    one = skins.one[scratch.skin[s * many]]
    for a in range(field.holds[f]):  # the lanes share out the neighbours
        i = field.hold[f, a]
        corners = skins.faces[scratch.face[s, i]]
        for x in range(3):
            for z in range(zones):
                zone = zones * corners[x] + z
                for p in range(more.reach[zone][0] + lane, more.reach[zone][1], lanes):
                    for q in range(more.heads[more.index[p]], more.heads[more.index[p] + 1]):
                        wp.atomic_max(field.mark, f, more.member[q] - one.first, zones - z)
                        if field.parted[f] == 1:
                            fold = wp.uint32(1) << wp.uint32(wp.min(scratch.fold[s, i], MOST_FOLDS))
                            wp.atomic_or(field.feels, f, more.member[q] - one.first, fold)


@wp.kernel
def move(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
         scratch: Scratch, field: FieldScratch):  # fmt: skip
    """Flat motion of the vertices that are asked: green.add_motion."""
    f, lane = wp.tid()
    s = pick[f]
    id = scratch.skin[s * many]
    one = skins.one[id]
    t = one.flat
    for n in range(lane, one.end - one.first, lanes):
        if field.ask[f, n] == 1:
            v, sum = one.first + n, vec3()
            point = skins.points[v]
            inward = skins.inward[v]
            for a in range(field.holds[f]):
                i = field.hold[f, a]
                felt = field.parted[f] == 0
                if field.parted[f] == 1:
                    fold = wp.uint32(wp.min(scratch.fold[s, i], MOST_FOLDS))
                    felt = ((field.feels[f, n] >> fold) & wp.uint32(1)) == wp.uint32(1)
                away = point - scratch.point[s, i]
                source = scratch.inward[s, i]
                facing, r = wp.dot(inward, source), wp.length(away) / t
                if felt and facing > real(0.0) and r < real(0.98) * REACH:
                    row, x = field.row[f, a], wp.min(wp.sqrt(r) * ROWS, FARTHEST)
                    k, g = wp.int32(x), wp.int32(row[0])
                    per = _share(facing) / (wp.sqrt(r * r + row[2]) * t)
                    told = per * _softly(more, id, row[1], k, x - real(k), g, row[0] - real(g))
                    sum = sum + _of_force(inward, source, away, t, told, field.pull[f, a])
            field.spread[f, n] = sum


@wp.kernel
def hand(pick: wp.array(dtype=wp.int32), lanes: wp.int32, scratch: Scratch, field: FieldScratch):
    """Pressures over E at the coarse vertices that are met: green._handed."""
    f, lane = wp.tid()
    s = pick[f]
    for d in range(lane, scratch.meets[s], lanes):
        sum = real(0.0)
        for a in range(field.holds[f]):
            i = field.hold[f, a]
            for k in range(scratch.around_node[s, i]):
                if scratch.slots[s, i, k] == d:
                    sum += scratch.parts[s, i, k] * wp.dot(scratch.inward[s, i], field.pull[f, a])
        field.handed[f, d] = sum


@wp.kernel
def move_limb(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
              field: FieldScratch):  # fmt: skip
    """Motion of the coarse vertices under these."""
    f, lane = wp.tid()
    s = pick[f]
    one = skins.one[scratch.skin[s * many]]
    for c in range(lane, one.coarse, lanes):
        sum = vec3()
        for d in range(scratch.meets[s]):
            row = one.first_motion + 3 * one.coarse * c + scratch.met[s, d]
            pressure = field.handed[f, d]
            sum = sum + pressure * vec3(real(skins.motion[row]), real(skins.motion[row + one.coarse]),
                                        real(skins.motion[row + 2 * one.coarse]))  # fmt: skip
        field.limb[f, c] = sum


@wp.kernel
def add_limb(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
             field: FieldScratch):  # fmt: skip
    """Adds them to all vertices, whose linear motion is known then."""
    f, lane = wp.tid()
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, one.end - one.first, lanes):
        moved = vec3()
        corners = skins.coarse_corner[one.first + n]
        shares = skins.coarse_share[one.first + n]
        if field.holds[f] > 0:
            moved = field.motion[f, n]
            for k in range(3):
                moved = moved + shares[k] * field.limb[f, corners[k]]
        field.motion[f, n] = moved
        field.linear[f, n] = moved


@wp.kernel
def find_reach(pick: wp.array(dtype=wp.int32), many: wp.int32, scratch: Scratch, field: FieldScratch):
    """How far each tool's pressures are spread: Surroundings.spread_on; 0 where it presses nothing."""
    t = wp.tid()
    s, count, area = pick[t // many], real(0.0), real(0.0)
    for i in range(scratch.nodes[s]):
        if scratch.tool[s, i] == t % many:
            count += real(1.0)
            area += scratch.area[s, i]
    field.far[t] = WIDER * wp.sqrt(area / wp.max(count, real(1.0)))


@wp.kernel
def mark_beside(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, more: SkinFields,
                scratch: Scratch, field: FieldScratch):  # fmt: skip
    """Marks the vertices to which pressure at the nodes is spread."""
    f, lane = wp.tid()
    s, zones = pick[f], more.stands.shape[0]
    one = skins.one[scratch.skin[s * many]]
    for i in range(lane, scratch.nodes[s], lanes):
        corners = skins.faces[scratch.face[s, i]]
        far = field.far[f * many + scratch.tool[s, i]]
        for x in range(3):
            if scratch.shares[s, i][x] > real(0.0):
                z = wp.int32(0)
                v = corners[x]
                while z < zones:
                    for p in range(more.reach[zones * v + z][0], more.reach[zones * v + z][1]):
                        for q in range(more.heads[more.index[p]], more.heads[more.index[p] + 1]):
                            if wp.length(skins.points[more.member[q]] - skins.points[v]) < far:
                                field.mark[f, more.member[q] - one.first] = 1
                    if ENDS[z] * one.flat > far:
                        z = zones
                    z += 1


@wp.kernel
def list_beside(pick: wp.array(dtype=wp.int32), many: wp.int32, skins: Skins, scratch: Scratch, field: FieldScratch):
    """Lists these with the vertices that the tools touch; counted where there is no room."""
    f, lane = wp.tid()
    lanes, one, count = wp.block_dim(), skins.one[scratch.skin[pick[f] * many]], wp.int32(0)
    for n in range(lane, field.many[f], lanes):
        field.mark[f, field.under[f, n] - one.first] = 1
    wait()
    each = (one.end - one.first + lanes - 1) // lanes  # of a thread, one after the other
    for write in range(2):  # counts them, and then knows where to write
        for n in range(lane * each, wp.min((lane + 1) * each, one.end - one.first)):
            if field.mark[f, n] == 1:
                if write == 1 and count < field.under.shape[1]:
                    field.under[f, count] = one.first + n
                count += 1
        if write == 0:
            count = sum_before(count)
    if lane == lanes - 1:
        field.many[f] = wp.min(count, field.under.shape[1])
        wp.atomic_max(field.most, 0, count)


@wp.func
def _weight(skins: Skins, folded: wp.int32, v: wp.int32, w: wp.int32, first: wp.int32, far: real) -> real:
    """How much of a pressure at one vertex goes to another: thinning._spread."""
    near = real(1.0) - wp.length_sq(skins.points[v] - skins.points[w]) / (far * far)
    if v == w:
        return real(1.0)
    if near <= real(0.0) or (folded == 1 and not _marked(skins.linked, v, w - first)):
        return real(0.0)
    return near * near


@wp.kernel
def share_out(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
              field: FieldScratch):  # fmt: skip
    """Pressure at each vertex that presses, over the area that it is spread over."""
    t, lane = wp.tid()
    f = t // many
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, field.many[f], lanes):
        total = real(0.0)
        v = field.under[f, n]
        press = field.press[t, n]
        if press > real(0.0):
            for m in range(field.many[f]):
                w = field.under[f, m]
                total += skins.area[w] * _weight(skins, one.folded, v, w, one.first, field.far[t])
            total = press * skins.area[v] / total
        field.lies[t, n] = total


@wp.kernel
def spread(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
           field: FieldScratch):  # fmt: skip
    """Both source fields of the pressures that are spread, over E of the effective layer."""
    f, lane = wp.tid()
    one = skins.one[scratch.skin[pick[f] * many]]
    for n in range(lane, field.many[f], lanes):
        total, strain = real(0.0), real(0.0)
        v = field.under[f, n]
        for k in range(many):
            t = f * many + k
            for m in range(field.many[f]):
                press = field.lies[t, m]
                w = field.under[f, m]
                if press > real(0.0):
                    total += press * _weight(skins, one.folded, w, v, one.first, field.far[t])
        total = total * one.softness
        if total > real(0.0):
            strain = (real(1.0) - _stretch(total, one.mu, one.lam)) * (one.lam + real(2.0) * one.mu)
        field.source[f, n] = wp.vec2f(wp.float32(total), wp.float32(strain))


@wp.kernel
def find_peak(pick: wp.array(dtype=wp.int32), many: wp.int32, skins: Skins, scratch: Scratch, field: FieldScratch):
    """Largest linear motion of the vertices that are asked."""
    f, lane = wp.tid()
    one, most = skins.one[scratch.skin[pick[f] * many]], real(0.0)
    for n in range(lane, one.end - one.first, wp.block_dim()):
        if field.ask[f, n] == 1:
            most = wp.max(most, wp.length_sq(field.linear[f, n]))
    most = most_of(most)
    if lane == 0:
        field.peak[f] = wp.sqrt(most)


@wp.kernel
def hold_back(pick: wp.array(dtype=wp.int32), many: wp.int32, skins: Skins, scratch: Scratch, field: FieldScratch):
    """Share of what the network adds with which no tool's skin goes further than the tool: conform.no_further."""
    f = wp.tid()
    first, share = skins.one[scratch.skin[pick[f] * many]].first, real(1.0)
    for k in range(many):
        t, highest, goes, went = f * many + k, real(0.0), real(0.0), real(0.0)
        for n in range(field.many[f]):
            highest = wp.max(highest, field.press[t, n])
        for n in range(field.many[f]):
            if field.press[t, n] > LYING * highest:
                v = field.under[f, n]
                way = vec3(skins.inward[v])
                if field.one_way[t] == 1:
                    way = field.way[t]
                goes = wp.max(goes, wp.dot(field.linear[f, v - first], way))
                went = wp.max(went, wp.dot(field.motion[f, v - first], way))
        if went > (real(1.0) + BEYOND) * goes:
            share = wp.min(share, BEYOND * goes / (went - goes))
    field.gain[f] = share


@wp.kernel
def mix(pick: wp.array(dtype=wp.int32), lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch,
        field: FieldScratch):  # fmt: skip
    """The linear motion and that share of what is added to it."""
    f, lane = wp.tid()
    one, share = skins.one[scratch.skin[pick[f] * many]], field.gain[f]
    if share < real(1.0):
        for n in range(lane, one.end - one.first, lanes):
            linear = field.linear[f, n]
            field.motion[f, n] = linear + share * (field.motion[f, n] - linear)
