# type: ignore  # kernels are in Warp's language, which pyright does not know
"""Kernels of the pressure at contact nodes: stmpl_core.obstacle and stmpl_core.contact_net.

The conjugate gradients of a scene are one block's, which reads the scene's matrix from memory: its threads share out
the nodes, and wait for each other where they add up. So no scene waits for another, nor for the CPU.
"""

import warp as wp

from stmpl_core import contact_net, obstacle
from stmpl_core.gpu.blocks import most_of, sum_of, wait
from stmpl_core.gpu.packs import HIDDEN as UNITS
from stmpl_core.gpu.packs import Net, OneSkin, Scratch, Skins
from stmpl_core.gpu.rays import FAR, OPTIONS, real, vec3
from stmpl_core.networks import NODE, STACK_NODE

STEPS, RINGS = wp.constant(obstacle.STEPS), wp.constant(obstacle.RINGS)
REACH, NEAR = wp.constant(wp.float64(obstacle.REACH)), wp.constant(wp.float64(obstacle.NEAR))
OWN = wp.constant(wp.float64(obstacle.OWN))
TOLERANCE = wp.constant(wp.float64(obstacle.TOLERANCE))
ITERATIONS = wp.constant(obstacle.MAX_ITERATIONS)
POWER_TOLERANCE = wp.constant(wp.float64(obstacle.POWER_TOLERANCE))
LINEAR_TO = wp.constant(wp.float64(contact_net.LINEAR_TO))
STACK_LINEAR_TO = wp.constant(wp.float64(contact_net.STACK_LINEAR_TO))
HARDENING = wp.constant(wp.float64(contact_net.HARDENING))
LITTLE, FAR_OUTSIDE = (wp.constant(wp.float64(x)) for x in (contact_net.LITTLE, contact_net.FAR_OUTSIDE))
FADE, FADE_RING = wp.constant(wp.float64(contact_net.FADE)), wp.constant(contact_net.FADE_RING)
NEAR_NONE, NEAR_WHOLE, FAR_NONE, FAR_WHOLE, FELT_NONE, FELT_WHOLE, DEEP_NONE, DEEP_WHOLE = (
    wp.constant(wp.float64(x)) for x in (*contact_net.THIN_NEAR, *contact_net.THIN_FAR, *contact_net.THIN_FELT,
                                         *contact_net.THIN_DEEP))  # fmt: skip
DOMED_NONE, DOMED_WHOLE, TOO_NONE, TOO_WHOLE, DOMED_DOUBT = (
    wp.constant(wp.float64(x)) for x in (*contact_net.DOMED, *contact_net.TOO_DOMED, contact_net.DOMED_DOUBT))
PLATE_NONE, PLATE_WHOLE, PLATE_FROM, PLATE_TO, KAPPA_NONE, KAPPA_WHOLE, PLATE_DOUBT, PLATE_ANYHOW = (
    wp.constant(wp.float64(x)) for x in (*contact_net.PLATE, *contact_net.PLATE_DEEP, *contact_net.PLATE_KAPPA,
                                         contact_net.PLATE_DOUBT, contact_net.PLATE_ANYHOW))  # fmt: skip
AT_TURNED, AT_COLUMN = wp.constant(STACK_NODE.at.turned), wp.constant(STACK_NODE.at.column_strain)
AT_KAPPA = wp.constant(STACK_NODE.at.log_kappa)
THIN_DOUBT, ONE_SEES = wp.constant(wp.float64(contact_net.THIN_DOUBT)), wp.constant(NODE.size)
LARGEST = wp.constant(wp.float64(contact_net.MAX_LOG_RATIO))
START, SMALL, SMALLER = (wp.constant(wp.float64(x)) for x in (0.3, 1e-3, 1e-4))
LEAST_SQUARE, ALMOST_TWO = wp.constant(wp.float64(1e-6)), wp.constant(wp.float64(1.02))
HIDDEN = wp.constant(UNITS)
AT_LOG_PRESSURE, AT_PRESSURE = wp.constant(NODE.at.log_pressure), wp.constant(NODE.at.pressure)
AT_LOG_STRAIN, AT_STRAIN = wp.constant(NODE.at.log_strain), wp.constant(NODE.at.strain)
AT_MOMENTS, AT_SIZES = wp.constant(NODE.at.log_moments), wp.constant(NODE.at.vector_sizes)
AT_TOGETHER, AT_MEAN = wp.constant(NODE.at.vectors_together), wp.constant(NODE.at.mean_curvature)
AT_SQUARED, AT_ALONG = wp.constant(NODE.at.squared_bend), wp.constant(NODE.at.curvature_along_vector)
AT_SLOPE, AT_SLOPES = wp.constant(NODE.at.slope_along_vector), wp.constant(NODE.at.squared_slope)
AT_NU, AT_VOLUMETRIC = wp.constant(NODE.at.poisson_ratio), wp.constant(NODE.at.volumetric)
wp.set_module_options(OPTIONS)


@wp.func
def _apart(scratch: Scratch, s: wp.int32, i: wp.int32, j: wp.int32) -> real:
    """Distance of two nodes over the thickness; beyond REACH if they face away from each other."""
    if wp.dot(scratch.inward[s, i], scratch.inward[s, j]) <= real(0.0) or scratch.fold[s, i] != scratch.fold[s, j]:
        return real(2.0) * REACH
    roots = real(1.0) / wp.sqrt(scratch.thick[s, i]) * (real(1.0) / wp.sqrt(scratch.thick[s, j]))
    return wp.length(scratch.point[s, i] - scratch.point[s, j]) * roots


@wp.func
def _row(skins: Skins, one: OneSkin, column: wp.int32, f: real) -> real:
    """Value of a table at a distance over the thickness, times STEPS."""
    k = wp.int32(f)
    share = f - real(k)
    k += one.table
    return (real(1.0) - share) * skins.rows[k, column] + share * skins.rows[k + 1, column]


@wp.kernel
def respond(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """Depth over a thickness of each node under a force E t^2 at each, (N, N): obstacle.pairs."""
    s, lane = wp.tid()
    one, count = skins.one[scratch.skin[s * many]], scratch.nodes[s]
    for n in range(lane, count * count, lanes):
        i, j = n // count, n % count
        apart, value = _apart(scratch, s, i, j), real(0.0)
        if apart < REACH:
            r = wp.length(scratch.point[s, i] - scratch.point[s, j])
            own = real(0.5) * (wp.sqrt(scratch.area[s, i]) / OWN + wp.sqrt(scratch.area[s, j]) / OWN)
            per = real(1.0) / wp.sqrt(scratch.thick[s, i]) * (real(1.0) / wp.sqrt(scratch.thick[s, j]))
            table = _row(skins, one, 0, apart * real(STEPS))
            value = one.thickest * (one.half_space / wp.max(r, own) + per * table)
        scratch.matrix[s, i, j] = value


@wp.func
def _wanted(scratch: Scratch, one: OneSkin, s: wp.int32, i: wp.int32) -> real:
    """Depth that the tool asks for, up to where the barrier takes over, over a thickness; on a stack [m]."""
    if one.stacked == 1:
        return scratch.sinking[s, i] * wp.min(STACK_LINEAR_TO / scratch.strain[s, i], real(1.0))
    return wp.min(scratch.strain[s, i], LINEAR_TO) * scratch.thick[s, i] / one.thickest


@wp.func
def _times(scratch: Scratch, s: wp.int32, i: wp.int32, vector: wp.array2d(dtype=real)) -> real:
    """A row of a scene's matrix times a vector."""
    sum = real(0.0)
    for j in range(scratch.nodes[s]):
        sum += scratch.matrix[s, j, i] * vector[s, j]
    return sum


@wp.func
def _among(scratch: Scratch, s: wp.int32, i: wp.int32, count: wp.int32) -> real:
    """Depth of node i under forces of 1 at all that come to press with it: those that do not move yet."""
    among = real(0.0)
    for j in range(count):
        if scratch.gap[s, j] < real(0.0) and scratch.move[s, j] == real(0.0):
            among += wp.max(scratch.matrix[s, i, j], real(0.0))
    return among


@wp.kernel
def solve(many: wp.int32, linear: wp.int32, skins: Skins, scratch: Scratch):
    """Forces at the nodes, none of which pulls: obstacle.solve; linear: 1, of a stack that would never harden.

    The gap is then by how much each node misses its depth.
    """
    s, lane = wp.tid()
    lanes, count = wp.block_dim(), scratch.nodes[s]
    one = skins.one[scratch.skin[s * many]]
    for i in range(lane, count, lanes):
        scratch.wanted[s, i] = _wanted(scratch, one, s, i)
        if linear == 1:
            scratch.wanted[s, i] = scratch.sinking[s, i]
        scratch.force[s, i] = START * scratch.wanted[s, i] / scratch.matrix[s, i, i]
        scratch.move[s, i] = real(0.0)
    wait()
    change, largest, before, number = real(count), real(0.0), real(0.0), wp.int32(0)
    while change > TOLERANCE * largest and number < ITERATIONS:
        number += 1
        square = real(0.0)
        for i in range(lane, count, lanes):
            gap = _times(scratch, s, i, scratch.force) - scratch.wanted[s, i]
            scratch.gap[s, i] = gap
            if scratch.force[s, i] > real(0.0):
                square += gap * gap
        square = sum_of(square)
        on, up, down = real(0.0), real(0.0), real(0.0)
        if before > real(0.0):
            on = square / before
        before = square
        for i in range(lane, count, lanes):
            move = real(0.0)
            if scratch.force[s, i] > real(0.0):
                move = scratch.gap[s, i] + on * scratch.move[s, i]
            scratch.move[s, i] = move
            up += scratch.gap[s, i] * move
        up = sum_of(up)
        for i in range(lane, count, lanes):
            down += _times(scratch, s, i, scratch.move) * scratch.move[s, i]
        down = sum_of(down)  # no thread goes on before all have said how their nodes move
        change, largest, again = real(0.0), real(0.0), real(0.0)
        if down > real(0.0):
            for i in range(lane, count, lanes):
                now = real(scratch.force[s, i])
                if now > real(0.0):
                    now = wp.max(now - up / down * scratch.move[s, i], real(0.0))
                elif scratch.gap[s, i] < real(0.0):  # the skin would enter it: it presses after all, and not alone
                    now = -scratch.gap[s, i] / _among(scratch, s, i, count)
                    again = real(1.0)
                change = wp.max(change, wp.abs(now - scratch.force[s, i]))
                largest = wp.max(largest, now)
                scratch.force[s, i] = now
        change = most_of(change)
        largest = most_of(largest)
        if most_of(again) > real(0.0):
            before = real(0.0)
    for i in range(lane, count, lanes):
        miss = _times(scratch, s, i, scratch.force) - scratch.wanted[s, i]
        if scratch.force[s, i] > real(0.0):
            miss = wp.abs(miss)
        else:
            miss = wp.max(-miss, real(0.0))
        if not (miss < FAR):
            miss = FAR
        scratch.gap[s, i] = miss


@wp.kernel
def find_power(scratch: Scratch):
    """What each node does to the power with which forces grow: obstacle.power_of."""
    s, lane = wp.tid()
    lanes, count, square, on = wp.block_dim(), scratch.nodes[s], real(0.0), real(0.0)
    for i in range(lane, count, lanes):
        here = real(0.0)
        if scratch.force[s, i] > real(0.0):
            here = real(1.0)
        scratch.found_power[s, i] = real(0.0)
        scratch.left[s, i] = here
        scratch.move[s, i] = real(0.0)
        square += here
    square = sum_of(square)
    first, number = real(square), wp.int32(0)
    while square > POWER_TOLERANCE * first and number < ITERATIONS:
        number += 1
        for i in range(lane, count, lanes):
            scratch.move[s, i] = scratch.left[s, i] + on * scratch.move[s, i]
        wait()
        down, before = real(0.0), real(square)
        for i in range(lane, count, lanes):
            along = real(0.0)
            if scratch.force[s, i] > real(0.0):
                along = _times(scratch, s, i, scratch.move)
            scratch.along[s, i] = along
            down += along * scratch.move[s, i]
        size = before / sum_of(down)
        square = real(0.0)
        for i in range(lane, count, lanes):
            left = scratch.left[s, i] - size * scratch.along[s, i]
            scratch.found_power[s, i] = scratch.found_power[s, i] + size * scratch.move[s, i]
            scratch.left[s, i] = left
            square += left * left
        square = sum_of(square)
        on = square / before


@wp.func
def _column_pressure(one: OneSkin, strain: real) -> real:
    stretch = real(1.0) - strain
    return -(one.mu * (stretch - real(1.0) / stretch) + one.lam * wp.log(stretch) / stretch)


@wp.func
def _pressure(scratch: Scratch, one: OneSkin, s: wp.int32, i: wp.int32) -> real:
    return scratch.force[s, i] * one.thickest * one.thickest / scratch.area[s, i]


@wp.kernel
def see(lanes: wp.int32, many: wp.int32, skins: Skins, scratch: Scratch):
    """What the network reads of each node; then its pressure beyond the linear layer's, and the network's share."""
    s, lane = wp.tid()
    one = skins.one[scratch.skin[s * many]]
    for i in range(lane, scratch.nodes[s], lanes):
        moments, strains, pull, sunk = wp.vec4d(), wp.vec4d(), vec3(), vec3()
        t, strain = scratch.thick[s, i], real(scratch.strain[s, i])
        for j in range(scratch.nodes[s]):
            apart = _apart(scratch, s, i, j)
            if apart < NEAR:
                f, per = apart * real(STEPS), scratch.area[s, j] / (t * scratch.thick[s, j])
                p, e = per * _pressure(scratch, one, s, j), per * scratch.strain[s, j] / scratch.over[s, j]
                for m in range(RINGS):
                    weight = _row(skins, one, 1 + m, f)
                    moments[m] = moments[m] + weight * p
                    strains[m] = strains[m] + weight * e
                way = _row(skins, one, 1 + RINGS, f) / t * (scratch.point[s, j] - scratch.point[s, i])
                pull = pull + p * way
                sunk = sunk + e * way
        pressure = scratch.times[s, i] * _pressure(scratch, one, s, i)
        pull = _write_alike(scratch, s, i, pressure, strain, moments, strains, pull, sunk)
        _write_shape(scratch, skins, s, i, pull)
        _write(scratch, s, i, AT_NU, one.nu)
        _write(scratch, s, i, AT_VOLUMETRIC, real(1.0) / (ALMOST_TWO - real(2.0) * one.nu))
        if strain > LINEAR_TO:
            more = _column_pressure(one, strain) / _column_pressure(one, LINEAR_TO)
            pressure = pressure * wp.pow(more, HARDENING)
        scratch.pressure[s, i] = pressure
        around = strain + strains[FADE_RING]
        scratch.fade[s, i] = around / (around + FADE)


@wp.func
def _write(scratch: Scratch, s: wp.int32, i: wp.int32, at: wp.int32, value: real):
    """Writes an input."""
    scratch.inputs[s, i, at] = wp.float32(value)


@wp.func
def _write_alike(scratch: Scratch, s: wp.int32, i: wp.int32, pressure: real, strain: real, moments: wp.vec4d,
                 strains: wp.vec4d, pull: vec3, sunk: vec3) -> vec3:  # fmt: skip
    """Writes what a node of one material and one of a stack read alike; their `pull` along the skin."""
    inward = scratch.inward[s, i]
    pull = (pull - wp.dot(pull, inward) * inward) / (moments[1] + SMALLER)
    sunk = (sunk - wp.dot(sunk, inward) * inward) / (strains[1] + SMALLER)
    _write(scratch, s, i, AT_LOG_PRESSURE, wp.log(pressure + SMALL))
    _write(scratch, s, i, AT_PRESSURE, pressure)
    _write(scratch, s, i, AT_LOG_STRAIN, wp.log(strain + SMALL))
    _write(scratch, s, i, AT_STRAIN, strain)
    scratch.strange[s, i] = real(0.0)
    for m in range(RINGS):
        _write(scratch, s, i, AT_MOMENTS + m, wp.log(moments[m] + SMALLER))
        _write(scratch, s, i, AT_MOMENTS + RINGS + m, wp.log(strains[m] + SMALLER))
    _write(scratch, s, i, AT_SIZES, wp.length(pull))
    _write(scratch, s, i, AT_SIZES + 1, wp.length(sunk))
    _write(scratch, s, i, AT_TOGETHER, wp.dot(pull, sunk))
    return pull


@wp.func
def _write_shape(scratch: Scratch, skins: Skins, s: wp.int32, i: wp.int32, v: vec3):
    """Writes the inputs that are of the skin's shape."""
    corners, shares = skins.faces[scratch.face[s, i]], scratch.shares[s, i]
    trace, whole, along, slope, slopes = real(0.0), real(0.0), real(0.0), real(0.0), real(0.0)
    for x in range(3):
        lean = real(0.0)
        for c in range(3):
            lean += shares[c] * skins.bent[corners[c], 9 + x]
        slope += lean * v[x]
        slopes += lean * lean
        for y in range(3):
            bend = real(0.0)
            for c in range(3):
                bend += shares[c] * skins.bent[corners[c], 3 * x + y]
            whole += bend * bend
            along += v[x] * bend * v[y]
            if x == y:
                trace += bend
    square = LEAST_SQUARE + wp.length_sq(v)
    _write(scratch, s, i, AT_MEAN, real(0.5) * trace)
    _write(scratch, s, i, AT_SQUARED, real(0.5) * whole - real(0.25) * trace * trace)
    _write(scratch, s, i, AT_ALONG, along / square - real(0.5) * trace)
    _write(scratch, s, i, AT_SLOPE, slope / wp.sqrt(square))
    _write(scratch, s, i, AT_SLOPES, slopes)


@wp.func
def _ramp(value: real, none: real, whole: real) -> real:
    return wp.clamp((value - none) / (whole - none), real(0.0), real(1.0))


@wp.kernel
def judge(lanes: wp.int32, scratch: Scratch, net: Net):
    """Keeps inputs within what training had, says how far they were not, and scales them."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        scratch.error[s, i] = real(1.0)
        if net.low.shape[0] == ONE_SEES:
            strain, log_strain = real(scratch.inputs[s, i, AT_STRAIN]), scratch.inputs[s, i, AT_LOG_STRAIN]
            thin = _ramp(real(scratch.inputs[s, i, AT_MOMENTS + RINGS] - log_strain), NEAR_NONE, NEAR_WHOLE)
            thin *= _ramp(real(scratch.inputs[s, i, AT_MOMENTS + RINGS + 2] - log_strain), FAR_NONE, FAR_WHOLE)
            both = real(scratch.inputs[s, i, AT_MEAN])
            both -= wp.sqrt(wp.max(real(scratch.inputs[s, i, AT_SQUARED]), real(0.0)))
            domed = real(1.0) + DOMED_DOUBT * _ramp(both, DOMED_NONE, DOMED_WHOLE)
            scratch.error[s, i] = (real(1.0) + THIN_DOUBT * thin * _ramp(strain, FELT_NONE, FELT_WHOLE)) * domed
            far = _ramp(both, TOO_NONE, TOO_WHOLE)
            scratch.strange[s, i] = wp.max(thin * _ramp(strain, DEEP_NONE, DEEP_WHOLE), far)
        else:
            plate = _ramp(real(scratch.inputs[s, i, AT_TURNED]), PLATE_NONE, PLATE_WHOLE)
            plate *= _ramp(real(scratch.inputs[s, i, AT_COLUMN]), PLATE_FROM, PLATE_TO)
            kappa = _ramp(real(scratch.inputs[s, i, AT_KAPPA]), KAPPA_NONE, KAPPA_WHOLE)
            share = PLATE_ANYHOW + (real(1.0) - PLATE_ANYHOW) * kappa
            scratch.error[s, i] = real(1.0) + PLATE_DOUBT * plate * share
        for m in range(net.low.shape[0]):
            given = scratch.inputs[s, i, m]
            kept = wp.clamp(given, net.low[m], net.high[m])
            if scratch.fade[s, i] > LITTLE:
                beyond = real(wp.abs(given - kept) * net.scale[m]) / FAR_OUTSIDE
                scratch.strange[s, i] = wp.max(scratch.strange[s, i], wp.min(beyond, real(1.0)))
            scratch.inputs[s, i, m] = (kept - net.mean[m]) * net.scale[m]


@wp.kernel
def layer(lanes: wp.int32, scratch: Scratch, given: wp.array3d(dtype=wp.float32), w: wp.array2d(dtype=wp.float32),
          b: wp.array(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)):  # fmt: skip
    """A hidden layer of the network."""
    s, lane = wp.tid()
    for n in range(lane, scratch.nodes[s] * HIDDEN, lanes):
        i, unit, sum = n // HIDDEN, n % HIDDEN, wp.float32(0.0)
        for m in range(w.shape[0]):
            sum += given[s, i, m] * w[m, unit]
        x = sum + b[unit]
        out[s, i, unit] = x * (0.5 + 0.5 * x / (1.0 + wp.abs(x)))


@wp.kernel
def correct(lanes: wp.int32, scratch: Scratch, net: Net):
    """Pressures over E, corrected by the network, and their doubt."""
    s, lane = wp.tid()
    for i in range(lane, scratch.nodes[s], lanes):
        ratio, doubt = wp.float32(net.b4[0]), wp.float32(net.b4[1])
        for m in range(HIDDEN):
            ratio += scratch.one[s, i, m] * net.w4[m, 0]
            doubt += scratch.one[s, i, m] * net.w4[m, 1]
        log_ratio = wp.clamp(real(ratio), -LARGEST, LARGEST)
        held = scratch.pressure[s, i] * wp.exp(scratch.fade[s, i] * log_ratio) / scratch.times[s, i]
        scratch.pressure[s, i] = held
        scratch.error[s, i] = scratch.error[s, i] * held * wp.exp(wp.min(real(doubt), real(1.0)))
