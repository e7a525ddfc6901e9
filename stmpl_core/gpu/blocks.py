# type: ignore  # functions in Warp's language, which pyright does not know
"""What the threads of a block tell each other: a block is what kernels give one scene, or one tool of it.

Every thread of the block calls these, each with its own value, and none goes on before all have: so what they wrote
before is there to be read after. A value does not depend on who came first. On a CPU a block is one thread, unless
`wp.config.enable_cpu_blocks` allows more.
"""

from typing import Any

import warp as wp

from stmpl_core.gpu.rays import OPTIONS, real

wp.set_module_options(OPTIONS)


def threads(lanes: int, device: Any) -> int:
    """Threads of a block, of as many that are to share the work of a scene."""
    return lanes if device.is_cuda or wp.config.enable_cpu_blocks else 1


@wp.func
def sum_of(value: Any):
    """Sum of numbers, or of vectors: many at once cost little more than one."""
    return wp.tile_sum(wp.tile(value, preserve_type=True))[0]


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
