"""Curve: a method and the values of its own knob, from cheap to dear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from fem_tools.few_steps import FewSteps
from fem_tools.ladder import ladder
from fem_tools.patch import PatchFem
from stmpl_core.methods import Linear, Method, MomentNet, Naive, UNet, Winkler
from stmpl_core.methods.coarse import Coarse
from stmpl_core.methods.zero import Zero
from studies.peers import peer

Make = Callable[[], Method]

COARSER = (2.5, 2.0, 1.5, 1.25)


@dataclass(frozen=True)
class Curve:
    """One method.

    Args:
        name: name in the legend.
        knob: name of what is swept.
        steps: value of the knob, for a person, and what makes the method.
        fast: solves that take milliseconds, so that many are timed; or not.
        extra: package that it needs beyond ours.
    """

    name: str
    knob: str
    steps: tuple[tuple[str, Make], ...]
    fast: bool = True
    extra: str = ""

    @property
    def installed(self) -> bool:
        """Whether what it needs is there."""
        return not self.extra or find_spec(self.extra) is not None


def _meshes(make: Make) -> tuple[tuple[str, Make], ...]:
    coarse = tuple((f"{k:g} x the mesh width", lambda k=k: Coarse(make(), k)) for k in COARSER)
    return (*coarse, ("the layer's own mesh", make))


def _fem(reach: float, refine: int = 0, layers: int = 1) -> Make:
    return lambda: PatchFem(reach=reach, refine=refine, layers=layers, check_stability=False)


def _ladder(accuracy: float) -> Make:
    return lambda: ladder(accuracy=accuracy)


def _peer(name: str, **knobs: Any) -> Make:
    return lambda: peer(name)(**knobs)


CURVES: tuple[Curve, ...] = (
    Curve("zero", "-", (("-", Zero),)),
    Curve("Naive", "-", (("-", Naive),)),
    Curve("Winkler", "-", (("-", Winkler),)),
    Curve("Linear", "mesh width", _meshes(Linear)),
    Curve("MomentNet", "mesh width", _meshes(MomentNet)),
    Curve("the paper's UNet, reduced", "-", (("128 x 128 texels", UNet),)),
    Curve("FEM, few steps", "Newton steps from MomentNet",
          tuple((f"{n} step{'s' * (n > 1)}", lambda n=n: FewSteps.from_network(n)) for n in (1, 2, 3)), fast=False),
    Curve("PatchFem, mesh", "mesh width",
          (*((f"{k:g} x the mesh width", lambda k=k: Coarse(_fem(5)(), k)) for k in (2.5, 2.0, 1.5)),
           ("the layer's own mesh", _fem(5)), ("half the mesh width", _fem(5, 1)),
           ("half, two wedges deep", _fem(5, 1, 2))), fast=False),
    Curve("PatchFem, patch", "reach of the patch in thicknesses",
          tuple((f"{reach:g}", _fem(reach)) for reach in (1.5, 2, 3, 4, 6, 8)), fast=False),
    Curve("whole-arm FEM", "-", (("-", _fem(200)),), fast=False),
    Curve("Ladder", "wished accuracy", tuple((f"{1e3 * a:g} mm", _ladder(a)) for a in (2e-3, 5e-4, 2e-4, 1e-4)),
          fast=False),
    Curve("MuJoCo flex, its defaults", "-", (("StVK, 4 ms", _peer("mujoco_flex")),), fast=False, extra="mujoco"),
    Curve("MuJoCo flex, neo-Hookean", "mesh", tuple(
        (f"{layers} layers, refine {refine}",
         _peer("mujoco_flex", material="snh", timestep=0.1, damping=0.0, layers=layers, refine=refine))
        for layers, refine in ((1, 0), (2, 0), (4, 0))), fast=False, extra="mujoco"),
    Curve("Newton VBD", "mesh", tuple((f"{n} layers", _peer("newton_vbd", layers=n)) for n in (1, 2)), fast=False,
          extra="newton"),
    Curve("FElupe, hex8", "mesh", tuple((f"{n} layers", _peer("felupe", layers=n)) for n in (1, 2)), fast=False,
          extra="felupe"),
)  # fmt: skip
