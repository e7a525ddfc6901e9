# type: ignore  # functions in Warp's language, which pyright does not know
"""What the threads of a block tell each other: a block is what kernels give one scene, or one tool of it.

Every thread of the block calls these, each with its own value, and none goes on before all have: so what they wrote
before is there to be read after. A value does not depend on who came first. On a CPU a block is one thread, unless
`wp.config.enable_cpu_blocks` allows more.
"""

import warp as wp

from stmpl_core.gpu.rays import OPTIONS, real

wp.set_module_options(OPTIONS)


@wp.func
def sum_of(value: real) -> real:
    return wp.tile_sum(wp.tile(value))[0]


@wp.func
def least_of(value: real) -> real:
    return wp.tile_min(wp.tile(value))[0]


@wp.func
def most_of(value: real) -> real:
    return wp.tile_max(wp.tile(value))[0]


@wp.func
def sum_before(value: wp.int32) -> wp.int32:
    """Sum of the values of the threads before this one."""
    return wp.untile(wp.tile_scan_exclusive(wp.tile(value)))


@wp.func
def wait():
    """Lets no thread go on before all are here."""
    sum_of(real(0.0))
