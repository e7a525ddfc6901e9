"""Methods that the suite knows by name, and how to name any other: see studies.own."""

from __future__ import annotations

import copy
from typing import cast

import numpy as np

from fem_tools.few_steps import FewSteps
from fem_tools.ladder import ladder
from fem_tools.patch import PatchFem
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods import LimbLinear, Linear, Method, MomentNet, Naive, UNet, Winkler
from stmpl_core.methods.zero import Zero
from stmpl_core.trust import Displacement
from studies.own import own
from studies.stability.scene import Make

PARTS = ("prepare", "solve")  # of a method
WANTED = 2e-4 / 7.5e-3  # error that the ladder is asked for, over the thickness: 0.2 mm of 7.5 mm


class ScaledLadder:
    """A ladder that is asked for the same share of the thickness whatever the size: in metres a scene of another size
    would be another question.
    """

    name = "ladder"

    def prepare(self, layer: SoftLayer) -> Method:
        """The ladder for a layer."""
        return ladder(accuracy=WANTED * float(np.median(layer.thickness))).prepare(layer)

    def solve(self, load: Load) -> Displacement:
        """Refused: there is no layer yet."""
        raise NotPrepared("ScaledLadder has no layer yet. Call ScaledLadder().prepare(layer) and ask what it returns.")


METHODS: dict[str, Make] = {
    "zero": Zero, "naive": Naive, "winkler": Winkler, "linear": Linear, "limb_linear": LimbLinear,
    "moment_net": MomentNet, "unet": UNet, "fem_1_step": FewSteps.from_network, "fem": PatchFem,
    "ladder": cast(Make, ScaledLadder),
}  # fmt: skip


def maker(name: str) -> Make:
    """What makes a method: one of METHODS, or a class, a function or a method object of one's own (see studies.own).

    Raises:
        InvalidInput: no such method, module, file or attribute, it fails where it is called without arguments, or it
            lacks prepare and solve.
    """
    if name in METHODS:
        return METHODS[name]
    if ":" not in name and not name.endswith(".py"):
        known = ", ".join(METHODS)
        raise InvalidInput(f"unknown method {name!r}. Available: {known}; or yours, as file.py or module:attribute.")
    found = own(name, *PARTS)
    if callable(found):
        try:
            made = found()
        except Exception as error:  # whatever a person's class does
            raise InvalidInput(f"{name} is called without arguments, and fails: {type(error).__name__}: {error}. Name "
                               "a function or an object of that file that needs none.") from error  # fmt: skip
        _check(name, made)
        return cast(Make, found)
    _check(name, found)
    return lambda: copy.deepcopy(found)


def _check(name: str, method: object) -> None:
    lacking = [part for part in PARTS if not callable(getattr(method, part, None))]
    if lacking:
        raise InvalidInput(f"{name} has no {' and no '.join(lacking)}: it does not follow stmpl_core.methods.Method.")
