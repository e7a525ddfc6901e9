"""NewtonRig: a ball led over a slab in NVIDIA's Newton, vertex block descent on one processor core."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from studies.peers.led_ball import Ground, Rig, grid

wp.config.log_level = wp.LOG_WARNING  # no banner and no list of kernels on standard output
PARTICLE_RADIUS = 1e-4  # of the slab's nodes: how far before the ball they touch it [m]
CONTACT_GAP = 0.01  # distance within which contacts are looked for, as in Newton's example of a gripper [m]


class NewtonRig(Rig):
    """Newton's SolverVBD with a soft grid under a ball that is moved, not simulated.

    Set up as Newton's own examples are (newton/examples/softbody): a coloured grid of tetrahedra, 10 iterations every
    1/600 s, bodies moved from outside (`integrate_with_external_rigid_solver`), contacts over the whole surface. The
    force is what the solver says of itself: the sum of its observable CONTACT_F.

    Args:
        ground: slab and ball.
        layers: number of cells through the thickness, see studies.peers.led_ball.grid.
        stiffness: stiffness of a contact, some hundred times that of a node of the slab [N/m].
        timestep: timestep [s].
        iterations: number of iterations of a step.
        damping: viscosity over Young's modulus [s]; a fifth of MuJoCo's, because unfinished iterations damp as well.
    """

    def __init__(self, ground: Ground, layers: int, *, stiffness: float = 1e4, timestep: float = 1 / 600,
                 iterations: int = 10, damping: float = 1e-3) -> None:  # fmt: skip
        super().__init__(timestep)
        tissue, cells = ground.tissue, grid(ground, layers)
        size = np.array([*ground.size, ground.thickness])
        edge, still = size / cells, wp.vec3(0.0, 0.0, 0.0)
        unturned: Any = wp.quat_identity()
        builder: Any = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_soft_grid(
            pos=wp.vec3(-size[0] / 2, -size[1] / 2, -size[2]), rot=unturned, vel=still, dim_x=cells[0], dim_y=cells[1],
            dim_z=cells[2], cell_x=edge[0], cell_y=edge[1], cell_z=edge[2], density=tissue.density,
            k_mu=tissue.shear_modulus, k_lambda=tissue.lame_lambda, k_damp=damping * tissue.youngs_modulus,
            particle_radius=PARTICLE_RADIUS,
        )  # fmt: skip
        x, y, z = np.array(builder.particle_q).T
        held = (z < 1e-6 - size[2]) | (np.abs(x) > size[0] / 2 - 1e-6) | (np.abs(y) > size[1] / 2 - 1e-6)
        for node in np.flatnonzero(held):
            builder.particle_mass[node] = 0.0
        body = builder.add_body(xform=wp.transform(still, unturned), mass=1.0, is_kinematic=True)
        builder.add_shape_sphere(body, radius=ground.radius)
        builder.color()
        self.model: Any = builder.finalize(device="cpu")
        for name, value in (("ke", stiffness), ("kd", 0.0), ("mu", ground.friction)):
            setattr(self.model, f"soft_contact_{name}", value)
            getattr(self.model, f"shape_material_{name}").fill_(value)
        self._pipeline: Any = newton.CollisionPipeline(self.model, soft_contact_gap=CONTACT_GAP,
                                                       enable_rigid_soft_full_surface_contact=True)  # fmt: skip
        self._contacts = self._pipeline.contacts()
        solver: Any = newton.solvers.SolverVBD
        self._solver = solver(self.model, iterations=iterations, integrate_with_external_rigid_solver=True,
                              particle_enable_self_contact=False, particle_enable_tile_solve=False)  # fmt: skip
        self._seen = self._solver.observables(contacts=self._contacts, kinds={solver.ObservableKind.CONTACT_F})
        self._states, self._control = (self.model.state(), self.model.state()), self.model.control()
        self._place: np.ndarray | None = None

    def step(self, place: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Rig."""
        now, after = self._states
        now.body_q.assign(_pose(self._place if self._place is not None else place))
        after.body_q.assign(_pose(place))  # friction follows the motion from one to the other
        self._place = place
        self._pipeline.collide(now, self._contacts)
        self._solver.step(now, after, self._control, self._contacts, self.timestep, observables=self._seen)
        self._states = after, now
        return place, self._seen.contact_f.numpy()[:, :3].sum(axis=0, dtype=float)


def _pose(place: np.ndarray) -> np.ndarray:
    return np.array([[*place, 0, 0, 0, 1]], dtype=np.float32)
