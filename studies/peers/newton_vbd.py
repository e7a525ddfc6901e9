"""NewtonVbd: vertex block descent of NVIDIA's Newton, stepped until it is at rest under the load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from fem_tools.patch import Patch
from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Tissue
from studies.peers.patch_peer import Found, PatchPeer, SkinForces, TetPatch

wp.config.log_level = wp.LOG_WARNING  # no banner and no list of kernels on standard output
LOOK_EVERY = 5  # steps between looks at what is left unbalanced


@dataclass(frozen=True, eq=False)
class _Model:
    tets: TetPatch
    centre: np.ndarray  # taken off all points: the solver works in single precision
    tissue: Tissue
    model: Any
    solver: Any
    states: tuple[Any, Any]


class NewtonVbd(PatchPeer):
    """Newton's SolverVBD: linear tetrahedra, one block Gauss-Seidel step a vertex and iteration, single precision.

    Set up as Newton's own example newton/examples/softbody/example_softbody_hanging.py: a soft mesh, coloured, stepped
    with 10 iterations every 1/600 s, no self-contact; core and rim have mass 0, as its `fix_left` does. The pressure
    is written to particle_f and follows the skin from step to step.

    Material: stable Neo-Hookean (Smith, De Goes & Kim, ACM TOG 37, 2018) without the logarithmic term,
    mu/2 (I_C - 3) + (lambda + mu)/2 (J - 1 - mu / (lambda + mu))^2: not our energy, but with its mu and lambda at small
    strain (ModelBuilder.add_soft_mesh: k_mu, k_lambda, k_damp).

    The solver reports no residual; the forces of the same energy are summed here in double precision.

    Args:
        layers, refine, reach: mesh, see PatchPeer; each wedge becomes three tetrahedra.
        timestep: [s].
        iterations: number of iterations of each step.
        damping: viscosity over Young's modulus [s]; a fifth of MuJoCo's, because unfinished iterations damp as well.
        rest: unbalanced force over the load's at which it counts as at rest [-].
        max_steps: then it stops, and says that it does not rest.
        device: Warp's name of it, "cpu" or "cuda:0"; None: what Warp prefers.
    """

    name = "newton_vbd"

    def __init__(
        self,
        *,
        layers: int = 2,
        refine: int = 0,
        reach: float = 6.0,
        timestep: float = 1 / 600,
        iterations: int = 10,
        damping: float = 1e-3,
        rest: float = 1e-2,
        max_steps: int = 500,
        device: str | None = None,
    ) -> None:
        super().__init__(layers=layers, refine=refine, reach=reach)
        if not timestep > 0 or not rest > 0 or iterations < 1 or max_steps < 1:
            raise InvalidInput(f"timestep {timestep}, rest {rest}, iterations {iterations} and max_steps {max_steps} "
                               "must all be above 0.")  # fmt: skip
        self.timestep, self.iterations, self.damping = timestep, iterations, damping
        self.rest, self.max_steps, self.device = rest, max_steps, device

    def _set_up(self, patch: Patch, tissue: Tissue) -> _Model:
        tets = TetPatch.of(patch, self.layers)
        mesh, centre = tets.tets, tets.tets.points.mean(axis=0)
        unturned: Any = wp.quat_identity()
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_soft_mesh(
            pos=wp.vec3(0.0), rot=unturned, scale=1.0, vel=wp.vec3(0.0),
            vertices=[wp.vec3(*point) for point in (mesh.points - centre).tolist()],
            indices=mesh.tets.ravel().tolist(), density=tissue.density, k_mu=tissue.shear_modulus,
            k_lambda=tissue.lame_lambda, k_damp=self.damping * tissue.youngs_modulus, particle_radius=1e-3,
        )  # fmt: skip
        for node in np.flatnonzero(tets.held):
            builder.particle_mass[node] = 0.0
        builder.color()
        model = builder.finalize(device=self.device)
        solver = newton.solvers.SolverVBD(
            model, iterations=self.iterations, particle_enable_self_contact=False, particle_enable_tile_solve=False
        )
        return _Model(tets, centre, tissue, model, solver, (model.state(), model.state()))

    def _run(self, model: _Model, forces: SkinForces) -> Found:
        rest, n = model.tets.tets.points, len(model.tets.patch.mesh.outer)
        now, after = model.states
        now.particle_q.assign(model.model.particle_q)
        now.particle_qd.zero_()
        points, pressing = rest, np.zeros_like(rest)
        residual, step = np.inf, 0
        while residual > self.rest and step < self.max_steps:
            pressing[:n] = forces.at(points[:n])
            now.particle_f.assign(pressing.astype(np.float32))
            model.solver.step(now, after, None, None, self.timestep)
            now, after, step = after, now, step + 1
            points = now.particle_q.numpy() + model.centre
            if not np.isfinite(points).all():
                residual = np.inf
                break
            if step % LOOK_EVERY == 0:
                residual = self._unbalanced(model, points, forces.at(points[:n]))
        return Found(
            skin=points[:n] - rest[:n],
            converged=bool(residual <= self.rest),
            residual=residual,
            min_j=model.tets.smallest_det(points),
            figures={"steps": float(step), "simulated_s": step * self.timestep, "nodes": float(len(points))},
        )

    def _unbalanced(self, model: _Model, points: np.ndarray, pressing: np.ndarray) -> float:
        """Forces of the solver's own energy that the load does not balance, over the load's [-]."""
        mesh, mu = model.tets.tets, model.tissue.shear_modulus
        stiffness = model.tissue.lame_lambda + mu
        F = np.einsum("mai,maj->mij", points[mesh.tets], mesh.gradients)
        cofactor = np.stack([np.cross(F[:, (k + 1) % 3], F[:, (k + 2) % 3]) for k in range(3)], axis=1)
        J = np.einsum("mi,mi->m", F[:, 0], cofactor[:, 0])
        P = mu * F + (stiffness * (J - 1) - mu)[:, None, None] * cofactor
        left = -(mesh.to_nodes @ np.einsum("m,mij,maj->mai", mesh.volumes, P, mesh.gradients).reshape(-1, 3))
        left[: len(pressing)] += pressing
        free = ~model.tets.held
        return float(np.linalg.norm(left[free]) / np.linalg.norm(pressing[free[: len(pressing)]]))
