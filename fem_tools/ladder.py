"""ladder: a Ladder of the core's methods and of finite elements, by the chart that ships with the package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fem_tools.few_steps import FewSteps
from fem_tools.patch import PatchFem
from fem_tools.warm import WarmPatchFem
from stmpl_core.cache import folder
from stmpl_core.methods.base import Method
from stmpl_core.methods.coarse import Coarse
from stmpl_core.methods.ladder import SHIPPED, Ladder, Measured
from stmpl_core.methods.linear import Linear
from stmpl_core.methods.moment_net import MomentNet
from stmpl_core.methods.winkler import Winkler


def default_rungs(*, warm: bool = False) -> list[Method]:
    """Methods that a Ladder climbs by default, cheapest first; `warm`: finite elements that start from the last frame.

    A warm rung takes PatchFem's place, whose errors it has.
    """
    fem = WarmPatchFem(reach=4) if warm else PatchFem(reach=4, check_stability=False)
    return [Winkler(), Linear(), Coarse(MomentNet(), 1.5), MomentNet(), FewSteps.from_network(1), fem]


def ladder(*, accuracy: float = 1e-4, deadline: float | None = None, warm: bool = False,
           rungs: Sequence[Method] | None = None) -> Ladder:  # fmt: skip
    """A Ladder of the default methods by the shipped chart, with this machine's own times if it was calibrated.

    Args:
        accuracy: largest error wanted at any vertex [m].
        deadline: time for each solve [s]; None: no limit.
        warm: choice to start finite elements from their last frame: a fifth to two fifths of the time where a load is
            near the last one; answers then depend on those before. Under a deadline that a first frame does not keep it
            begins once the rung, the last of `rungs`, was asked by itself.
        rungs: methods to choose from.
    """
    rungs = default_rungs(warm=warm) if rungs is None else rungs
    return Ladder(rungs, measured(), accuracy=accuracy, deadline=deadline)


def times_file() -> Path:
    """File in which `stmpl calibrate` keeps this machine's times."""
    return folder() / "ladder_times.json"


def measured() -> Measured:
    """The shipped chart, with this machine's times where they were measured. Raises InvalidInput: a broken file."""
    chart = Measured.load(SHIPPED)
    return chart.timed_by(Measured.load(times_file())) if times_file().is_file() else chart
