"""MujocoFlex: MuJoCo's 3D flex, stepped until it is at rest under the load."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from fem_tools.patch import Patch
from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Tissue
from studies.peers.patch_peer import Found, PatchPeer, SkinForces, TetPatch

log = logging.getLogger(__name__)
Material = Literal["stvk", "snh"]
SCENE = """
<mujoco>
  <option integrator="discrete" timestep="{timestep}" tolerance="1e-6" iterations="400" gravity="0 0 0">
    <flag autoreset="disable"/>
  </option>
  <worldbody>
    <flexcomp name="layer" type="direct" dim="3" mass="{mass}" radius="1e-4" inertiabox="1e-3"
              point="{points}" element="{tets}">
      <elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <pin id="{pinned}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True, eq=False)
class _Model:
    tets: TetPatch
    model: mujoco.MjModel
    data: mujoco.MjData
    dofs: np.ndarray  # (M, 3) degrees of freedom of the nodes that move
    moving: np.ndarray  # (M,) their numbers


class MujocoFlex(PatchPeer):
    """MuJoCo flex: linear tetrahedra, implicit in position, a dynamic simulation that is run until it rests.

    Set up as "Deformables" in MuJoCo's modelling guide says (documentation of 4.0, modeling.rst, "Tuning"): a flexcomp
    of dof "full" with continuum elasticity, integrator "discrete", self-collision off, core and rim pinned. The
    pressure is applied to the vertices as generalised forces (qfrc_applied) that follow the skin from step to step.

    Material: Saint Venant-Kirchhoff, mu tr(e^2) + lambda/2 tr(e)^2 of the Green strain e (XML reference,
    flex/elasticity); or MuJoCo's experimental simplified stable Neo-Hookean one (mjSpec: flex.elastic3d = 1, API
    reference, mjsFlex). Neither is our energy; both have our E and nu at small strain.

    Args:
        material: "stvk", MuJoCo's default, or "snh".
        layers, refine, reach: mesh, see PatchPeer; each wedge becomes three tetrahedra.
        timestep: [s]; 1 to 4 ms is what the guide calls typical, longer ones settle in fewer steps.
        damping: Rayleigh's coefficient of the stiffness [s].
        rest: unbalanced force over the load's at which it counts as at rest [-].
        max_steps: then it stops, and says that it does not rest.
    """

    name = "mujoco_flex"

    def __init__(
        self,
        *,
        material: Material = "stvk",
        layers: int = 2,
        refine: int = 0,
        reach: float = 6.0,
        timestep: float = 4e-3,
        damping: float = 5e-3,
        rest: float = 1e-3,
        max_steps: int = 500,
    ) -> None:
        super().__init__(layers=layers, refine=refine, reach=reach)
        if material not in ("stvk", "snh"):
            raise InvalidInput(f'material is {material!r}; allowed are "stvk" and "snh".')
        if not timestep > 0 or not rest > 0 or max_steps < 1:
            raise InvalidInput(f"timestep {timestep}, rest {rest} and max_steps {max_steps} must all be above 0.")
        self.material: Material = material
        self.timestep, self.damping, self.rest, self.max_steps = timestep, damping, rest, max_steps

    def _set_up(self, patch: Patch, tissue: Tissue) -> _Model:
        tets = TetPatch.of(patch, self.layers)
        points, volume = tets.tets.points, float(tets.tets.volumes.sum())
        scene = SCENE.format(
            timestep=self.timestep, damping=self.damping, mass=tissue.density * volume, young=tissue.youngs_modulus,
            poisson=tissue.poisson_ratio, points=words(points), tets=words(tets.tets.tets),
            pinned=words(np.flatnonzero(tets.held)),
        )  # fmt: skip
        spec = mujoco.MjSpec.from_string(scene)
        spec.flexes[0].elastic3d = int(self.material == "snh")
        with warnings.catch_warnings():  # it warns of missing passive forces before it has seen the elasticity
            warnings.filterwarnings("ignore", message="flex 'layer' is not rigid")
            model = spec.compile()
        moving = np.flatnonzero(~tets.held)
        dofs = model.body_dofadr[model.flex_vertbodyid[moving]][:, None] + np.arange(3)
        return _Model(tets, model, mujoco.MjData(model), dofs, moving)

    def _run(self, model: _Model, forces: SkinForces) -> Found:
        with warnings_logged():
            return self._settle(model, forces)

    def _settle(self, model: _Model, forces: SkinForces) -> Found:
        mesh, data, n = model.tets, model.data, len(model.tets.patch.mesh.outer)
        rest, pressed = mesh.tets.points, model.moving < n
        mujoco.mj_resetData(model.model, data)
        residual, steps = np.inf, 0
        while True:
            points = rest.copy()
            points[model.moving] += data.qpos[model.dofs]
            pressing = forces.at(points[:n])[model.moving[pressed]]
            data.qfrc_applied[model.dofs[pressed]] = pressing
            mujoco.mj_step(model.model, data)  # leaves qfrc_spring as it was where the step began
            steps += 1
            residual = float(np.linalg.norm(data.qfrc_spring + data.qfrc_applied) / np.linalg.norm(pressing))
            if not residual > self.rest or steps == self.max_steps:
                break
        complaints = sum(int(kind.number) for kind in data.warning)
        return Found(
            skin=points[:n] - rest[:n],
            converged=residual <= self.rest,
            residual=residual,
            min_j=mesh.smallest_det(points),
            figures={"steps": float(steps), "simulated_s": steps * self.timestep, "nodes": float(len(points)),
                     "warnings": float(complaints)},
        )  # fmt: skip


@contextmanager
def warnings_logged() -> Iterator[None]:
    """Sends MuJoCo's warnings to the log, which otherwise go to a file MUJOCO_LOG.TXT where the process runs."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(log.debug)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def words(values: np.ndarray) -> str:
    """Numbers as MJCF wants them."""
    return " ".join(map(repr, values.ravel().tolist()))
