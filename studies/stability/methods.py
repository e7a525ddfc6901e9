"""Methods that the suite knows by name, and how to name any other: module:attribute."""

from __future__ import annotations

import copy
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from fem_tools.few_steps import FewSteps
from fem_tools.ladder import ladder
from fem_tools.patch import PatchFem
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Linear, Method, MomentNet, Naive, UNet, Winkler
from stmpl_core.methods.zero import Zero
from studies.stability.scene import Make


def _ladder() -> Method:
    return ladder(accuracy=2e-4)


METHODS: dict[str, Make] = {
    "zero": Zero, "naive": Naive, "winkler": Winkler, "linear": Linear, "moment_net": MomentNet, "unet": UNet,
    "fem_1_step": FewSteps.from_network, "fem": PatchFem, "ladder": _ladder,
}  # fmt: skip


def maker(name: str) -> Make:
    """What makes a method: one of METHODS, or `module:attribute`, a class, a function or a method object.

    Raises:
        InvalidInput: no such method, module or attribute, or it lacks prepare and solve.
    """
    if name in METHODS:
        return METHODS[name]
    module, colon, attribute = name.partition(":")
    if not colon:
        known = ", ".join(METHODS)
        raise InvalidInput(f"unknown method {name!r}. Available: {known}; or module:attribute of your own.")
    if str(Path.cwd()) not in sys.path:  # where a person keeps a module of one's own
        sys.path.insert(0, str(Path.cwd()))
    try:
        found: Any = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise InvalidInput(f"{name}: {error}. Give module:attribute, importable from {Path.cwd()}.") from error
    if callable(found):
        made = found()
        _check(name, made)
        return cast(Make, found)
    _check(name, found)
    return lambda: copy.deepcopy(found)


def _check(name: str, method: object) -> None:
    lacking = [part for part in ("prepare", "solve") if not callable(getattr(method, part, None))]
    if lacking:
        raise InvalidInput(f"{name} has no {' and no '.join(lacking)}: it does not follow stmpl_core.methods.Method.")
