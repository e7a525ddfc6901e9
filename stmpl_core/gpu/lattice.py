# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels that lay contact nodes under tools: stmpl_core.nodes, on the same lattice.

Each place of a lattice belongs to the lowest triangle that it lies on, found by an atomic minimum, so neither the order
of threads nor their number changes an answer.
"""

import math

import warp as wp

from stmpl_core import nodes as law
from stmpl_core.deep import DEEPEST
from stmpl_core.gpu.blocks import least_of, most_of, sum_before, sum_of
from stmpl_core.gpu.looks import BESIDE, CHARTS, FACING, inward_on, point_on, thickness_on
from stmpl_core.gpu.packs import Lattice, Scratch, Skins
from stmpl_core.gpu.places import APART, BY_POSE, DEEP, OVERFULL, PENDING
from stmpl_core.gpu.rays import FAR, OPTIONS, WALL_WIDTH, depth_at, real, strain_under, vec3

NODES = wp.constant(wp.float64(law.NODES))
MOST, MOST_PLACES = wp.constant(wp.float64(law.MOST)), wp.constant(wp.float64(law.MOST_LOOKED_AT))
WIDEST, BLEND = wp.constant(wp.float64(law.WIDEST)), wp.constant(wp.float64(law.BLEND))
RISE = wp.constant(wp.float64(0.5 * math.sqrt(3.0)))
FIRST_OFF, SECOND_OFF = wp.constant(wp.float64(0.31)), wp.constant(wp.float64(0.17))
ROUNDING = wp.constant(wp.float64(1e-9))
FULL = wp.constant(wp.float64(DEEPEST))
NO_ONE = wp.constant(2**31 - 1)
LAID, LOOKS, LOOKS_AGAIN = wp.constant(0), wp.constant(1), wp.constant(2)  # what a lattice is for
wp.set_module_options(OPTIONS)


@wp.func
def _steps(area: real, unit: real) -> real:
    """Steps of the spacing up to that which sees an area."""
    return wp.log2(area / unit)


@wp.func
def _other(step: real, seen: real, unit: real) -> real:
    """The other step between which and its own the area that is seen goes over; its own where it does not."""
    beyond, other = _steps(seen, unit) - step, real(step)
    if beyond < BLEND or beyond > real(1.0) - BLEND:
        other = step - real(1.0)
        if beyond > real(0.5):
            other = step + real(1.0)
    return other


@wp.func
def _area_seen(scratch: Scratch, c: wp.int32, unit: real) -> real:
    """Area that is covered, as the lattice sees it at one or two steps: nodes.nodes_under [m2]."""
    step, seen, also = wp.floor(_steps(scratch.covers[c], unit)), real(scratch.sees[c]), real(scratch.also[c])
    other = _other(step, seen, unit)
    fine, coarse = seen, also
    if other < step:
        fine = also
        coarse = seen
    if other != step and fine > real(0.0):
        share = (_steps(fine, unit) - wp.max(step, other)) / BLEND + real(0.5)
        seen = fine + wp.clamp(share, real(0.0), real(1.0)) * (coarse - fine)
    return seen


@wp.kernel
def lay(side: wp.int32, what: wp.int32, skins: Skins, scratch: Scratch):
    """The lattice on one side, and how far it must reach."""
    c, lane = wp.tid()
    lanes, lattice = wp.block_dim(), Lattice()
    if lane == 0:
        scratch.lattice[c] = lattice
    if side >= scratch.sides[c]:
        return
    many, parts, thick = scratch.many[c], scratch.split[c] * scratch.split[c], real(scratch.height[c])
    unit, area = NODES * thick * thick, real(scratch.covers[c])
    step = wp.floor(_steps(area, unit))
    if what == LOOKS_AGAIN:
        other = _other(step, scratch.sees[c], unit)
        if other == step:
            return
        step = other
    cell = real(0.5) * thick * thick * wp.pow(real(2.0), step)
    if what == LAID:
        area = _area_seen(scratch, c, unit)
        cell = area / NODES
    least = wp.max(wp.min(cell, RISE * WIDEST * thick * WIDEST * thick), area / MOST)
    axes, centre, sunk = scratch.axes[c, side], scratch.centre[c], wp.length_sq(scratch.top[c]) > real(0.0)
    low_u, low_v, high_u, high_v = real(FAR), real(FAR), -FAR, -FAR
    for m in range(lane, many, lanes):
        if scratch.chart[c, m] == side or scratch.chart[c, m] == side + CHARTS:
            corners, near = skins.faces[scratch.found[c, m]], wp.int32(0)
            edge = wp.length(skins.points[corners[0]] - skins.points[corners[1]]) / wp.sqrt(real(parts))
            for q in range(parts):
                if sunk or scratch.depths[c, m * parts + q] > -BESIDE * edge - WALL_WIDTH * thick:
                    near = CHARTS
                    at = axes * (scratch.middles[c, m * parts + q] - centre)
                    low_u, high_u = wp.min(low_u, at[0] - edge), wp.max(high_u, at[0] + edge)
                    low_v, high_v = wp.min(low_v, at[1] - edge), wp.max(high_v, at[1] + edge)
            scratch.chart[c, m] = side + near
    low_u = least_of(low_u)
    low_v = least_of(low_v)
    high_u = most_of(high_u)
    high_v = most_of(high_v)
    if high_u < low_u or lane > 0:
        return
    cell = wp.max(least, (high_u - low_u) * (high_v - low_v) / MOST_PLACES)
    lattice.cell = cell
    lattice.spacing = wp.sqrt(cell / RISE)
    lattice.rise = RISE * lattice.spacing
    lattice.start = wp.vec2d(FIRST_OFF * lattice.spacing, SECOND_OFF * lattice.spacing)
    lattice.blur = real(0.5) * lattice.spacing
    if scratch.deepest[c] > real(0.0):
        lattice.blur = wp.min(lattice.blur, real(0.5) * scratch.deepest[c])
    lattice.low = wp.int32(wp.floor((low_v - lattice.start[1]) / lattice.rise))
    lattice.left = wp.int32(wp.floor((low_u - lattice.start[0]) / lattice.spacing)) - 1
    lattice.rows = wp.int32(wp.ceil((high_v - lattice.start[1]) / lattice.rise)) - lattice.low + 1
    lattice.wide = wp.int32(wp.ceil((high_u - lattice.start[0]) / lattice.spacing)) + 1 - lattice.left + 1
    lattice.first = vec3(axes[0, 0], axes[0, 1], axes[0, 2])
    lattice.second = vec3(axes[1, 0], axes[1, 1], axes[1, 2])
    lattice.way = vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    if lattice.rows * lattice.wide > scratch.owner.shape[1]:
        scratch.status[c] = OVERFULL
        scratch.sides[c] = 0
        lattice.rows = 0
        lattice.wide = 0
    scratch.lattice[c] = lattice


@wp.kernel
def disown(lanes: wp.int32, scratch: Scratch):
    """No place of the lattice lies on a triangle yet."""
    c, lane = wp.tid()
    for n in range(lane, scratch.lattice[c].rows * scratch.lattice[c].wide, lanes):
        scratch.owner[c, n] = NO_ONE


@wp.func
def _across(lattice: Lattice, at: vec3) -> wp.vec2d:
    """Coordinates of a point, from the tool's middle, in the lattice."""
    return wp.vec2d(wp.dot(lattice.first, at), wp.dot(lattice.second, at)) - lattice.start


@wp.func
def _shares_at(lattice: Lattice, skins: Skins, f: wp.int32, centre: vec3, u: real, v: real) -> vec3:
    """Barycentric coordinates of a place of the lattice in a triangle."""
    corners = skins.faces[f]
    a = _across(lattice, skins.points[corners[0]] - centre)
    b, c = (_across(lattice, skins.points[corners[1]] - centre) - a,
            _across(lattice, skins.points[corners[2]] - centre) - a)  # fmt: skip
    double = b[0] * c[1] - c[0] * b[1]
    second = ((u - a[0]) * c[1] - c[0] * (v - a[1])) / double
    third = (b[0] * (v - a[1]) - (u - a[0]) * b[1]) / double
    return vec3(real(1.0) - second - third, second, third)


@wp.kernel
def own(lanes: wp.int32, side: wp.int32, skins: Skins, scratch: Scratch):
    """Which triangle each place of the lattice lies on."""
    c, lane = wp.tid()
    lattice, centre = scratch.lattice[c], scratch.centre[c]
    if lattice.rows == 0:
        return
    high, right = lattice.low + lattice.rows - 1, lattice.left + lattice.wide - 1
    for m in range(lane, scratch.many[c], lanes):
        if scratch.chart[c, m] == side + CHARTS:
            f = scratch.found[c, m]
            corners = skins.faces[f]
            one = _across(lattice, skins.points[corners[0]] - centre)
            two = _across(lattice, skins.points[corners[1]] - centre)
            three = _across(lattice, skins.points[corners[2]] - centre)
            least, most = wp.min(wp.min(one, two), three), wp.max(wp.max(one, two), three)
            from_row = wp.max(lattice.low, wp.int32(wp.ceil(least[1] / lattice.rise - ROUNDING)))
            to_row = wp.min(high, wp.int32(wp.floor(most[1] / lattice.rise + ROUNDING)))
            for j in range(from_row, to_row + 1):
                shift, v = real(0.5) * real(j & 1), real(j) * lattice.rise
                start = wp.max(lattice.left, wp.int32(wp.ceil(least[0] / lattice.spacing - shift - ROUNDING)))
                end = wp.min(right, wp.int32(wp.floor(most[0] / lattice.spacing - shift + ROUNDING)))
                for i in range(start, end + 1):
                    shares = _shares_at(lattice, skins, f, centre, (real(i) + shift) * lattice.spacing, v)
                    if wp.min(shares) >= -ROUNDING:
                        wp.atomic_min(scratch.owner, c, (j - lattice.low) * lattice.wide + i - lattice.left, f)


@wp.func
def _shares_of_place(lattice: Lattice, skins: Skins, f: wp.int32, centre: vec3, n: wp.int32) -> vec3:
    j, i = n // lattice.wide + lattice.low, n % lattice.wide + lattice.left
    u = (real(i) + real(0.5) * real(j & 1)) * lattice.spacing
    return _shares_at(lattice, skins, f, centre, u, real(j) * lattice.rise)


@wp.kernel
def sample(what: wp.int32, last: wp.int32, skins: Skins, scratch: Scratch):
    """Covered area [m2] of each place of the lattice, after the last side of all; or the strain of its column."""
    c, lane = wp.tid()
    lanes = wp.block_dim()
    lattice, grid, pose = scratch.lattice[c], skins.grids[scratch.grid[c]], wp.transpose(scratch.pose[c])
    top, sum = scratch.top[c], real(0.0)
    for n in range(lane, lattice.rows * lattice.wide, lanes):
        f, value = scratch.owner[c, n], real(0.0)
        if f != NO_ONE:
            shares = _shares_of_place(lattice, skins, f, scratch.centre[c], n)
            inward, t = inward_on(skins, f, shares), thickness_on(skins, f, shares)
            start, way = pose * (point_on(skins, f, shares) - scratch.place[c]), pose * inward
            if what != LAID:
                depth = depth_at(grid, skins.coefficients, start, way, t, top)
                value = wp.clamp(real(0.5) + depth / lattice.blur, real(0.0), real(1.0)) * lattice.cell
                sum += value / wp.max(wp.dot(inward, lattice.way), FACING)
            else:
                value = strain_under(grid, skins.coefficients, start, way, t, top)
        scratch.value[c, n] = value
    if what != LAID:
        sum = sum_of(sum)
        if lane == 0 and what == LOOKS:
            sum += scratch.sees[c]
            scratch.sees[c] = sum
            if last == 1 and sum <= real(0.0):
                scratch.sides[c] = 0
        if lane == 0 and what == LOOKS_AGAIN:
            scratch.also[c] = scratch.also[c] + sum


@wp.kernel
def list_nodes(many: wp.int32, side: wp.int32, scratch: Scratch):
    """Numbers of the places whose columns are squeezed, one after the other for all tools of a scene."""
    s, lane = wp.tid()
    begin, room, lanes = wp.int32(scratch.nodes[s]), scratch.tool.shape[1], wp.block_dim()
    before = wp.int32(begin)
    for k in range(many):
        c, count = s * many + k, wp.int32(0)
        places = scratch.lattice[c].rows * scratch.lattice[c].wide
        each = (places + lanes - 1) // lanes  # of a thread, one after the other
        for n in range(lane * each, wp.min((lane + 1) * each, places)):
            if scratch.value[c, n] > real(0.0):
                count += 1
        place = before + sum_before(count)
        before += wp.int32(sum_of(real(count)))
        for n in range(lane * each, wp.min((lane + 1) * each, places)):
            if scratch.value[c, n] > real(0.0):
                if place < room:
                    scratch.tool[s, place] = k
                    scratch.cell[s, place] = n
                else:
                    wp.atomic_max(scratch.status, c, OVERFULL)
                if scratch.value[c, n] >= FULL:
                    wp.atomic_max(scratch.status, c, DEEP)
                place += 1
    if lane == 0:
        scratch.begin[s] = begin
        scratch.nodes[s] = wp.min(before, room)
        wp.atomic_max(scratch.wants, 0, before)


@wp.kernel
def fill_nodes(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """The nodes that were listed last."""
    s, lane = wp.tid()
    for i in range(scratch.begin[s] + lane, scratch.nodes[s], lanes):
        c, n = s * many + scratch.tool[s, i], scratch.cell[s, i]
        lattice, f = scratch.lattice[c], scratch.owner[c, n]
        shares = _shares_of_place(lattice, skins, f, scratch.centre[c], n)
        inward = inward_on(skins, f, shares)
        scratch.face[s, i] = f
        scratch.shares[s, i] = shares
        scratch.point[s, i] = point_on(skins, f, shares)
        scratch.inward[s, i] = inward
        scratch.thick[s, i] = thickness_on(skins, f, shares)
        scratch.area[s, i] = lattice.cell / wp.max(wp.dot(inward, lattice.way), FACING)
        scratch.strain[s, i] = scratch.value[c, n]


@wp.kernel
def tell(many: wp.int32, scratch: Scratch):
    """Status of tools whose nodes are known: BY_POSE or APART."""
    s = wp.tid()
    for k in range(many):
        if scratch.status[s * many + k] == PENDING:
            scratch.status[s * many + k] = APART
    for i in range(scratch.nodes[s]):
        c = s * many + scratch.tool[s, i]
        if scratch.status[c] == APART:
            scratch.status[c] = BY_POSE


@wp.kernel
def withdraw(many: wp.int32, scratch: Scratch):
    """A scene with a tool that is refused or not served has no nodes."""
    s = wp.tid()
    for k in range(many):
        status = scratch.status[s * many + k]
        if status != APART and status != BY_POSE:
            scratch.nodes[s] = 0
