"""Methods that the suite knows by name, and how to name any other: see studies.own."""

from __future__ import annotations

import copy
from typing import cast

from fem_tools.few_steps import FewSteps
from fem_tools.ladder import ladder
from fem_tools.patch import PatchFem
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import LimbLinear, Linear, Method, MomentNet, Naive, UNet, Winkler
from stmpl_core.methods.zero import Zero
from studies.own import own
from studies.stability.scene import Make

PARTS = ("prepare", "solve")  # of a method


def _ladder() -> Method:
    return ladder(accuracy=2e-4)


METHODS: dict[str, Make] = {
    "zero": Zero, "naive": Naive, "winkler": Winkler, "linear": Linear, "limb_linear": LimbLinear,
    "moment_net": MomentNet, "unet": UNet, "fem_1_step": FewSteps.from_network, "fem": PatchFem, "ladder": _ladder,
}  # fmt: skip


def maker(name: str) -> Make:
    """What makes a method: one of METHODS, or a class, a function or a method object of one's own (see studies.own).

    Raises:
        InvalidInput: no such method, module, file or attribute, or it lacks prepare and solve.
    """
    if name in METHODS:
        return METHODS[name]
    if ":" not in name and not name.endswith(".py"):
        known = ", ".join(METHODS)
        raise InvalidInput(f"unknown method {name!r}. Available: {known}; or yours, as file.py or module:attribute.")
    found = own(name, *PARTS)
    if callable(found):
        made = found()
        _check(name, made)
        return cast(Make, found)
    _check(name, found)
    return lambda: copy.deepcopy(found)


def _check(name: str, method: object) -> None:
    lacking = [part for part in PARTS if not callable(getattr(method, part, None))]
    if lacking:
        raise InvalidInput(f"{name} has no {' and no '.join(lacking)}: it does not follow stmpl_core.methods.Method.")
