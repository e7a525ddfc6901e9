"""Rigs: a ball led along a course over a slab in MuJoCo: soft skin of ours, rigid contact, and MuJoCo's own flex."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.tissue import Tissue
from studies.peers.mujoco_flex import Material

Solver = tuple[str, str]  # MuJoCo's solref and solimp of a contact
DEFAULT: Solver = ("0.02 1", "0.9 0.95 0.001")  # MuJoCo's defaults
HARD: Solver = ("-1e6 -1e3", "0.95 0.99 0.0001")  # contact some hundred times as stiff as a node of the slab
SERVO = 5e4, 1e3  # gains that keep the ball on its course [N/m], [N s/m]


@dataclass(frozen=True)
class Ground:
    """A flat slab of one material, its upper face at z = 0, bonded below.

    Args:
        size: lengths along x and y of what is simulated of it [m].
        thickness: thickness [m].
        tissue: its material.
        radius: radius of the ball that is led over it [m].
        friction: Coulomb's coefficient between the two [-].
        mass: mass of the ball and of what moves it, an arm's effective mass [kg].
    """

    size: tuple[float, float]
    thickness: float
    tissue: Tissue
    radius: float
    friction: float
    mass: float = 5.0


class Rig(ABC):
    """A simulator with a ball over a slab.

    Args:
        timestep: timestep of its physics [s].
    """

    def __init__(self, timestep: float) -> None:
        self.timestep = timestep

    @abstractmethod
    def step(self, place: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One step with the ball's middle led to a place, (3,) [m], at a velocity [m/s].

        Returns:
            Where the ball is, (3,) [m], and the force of the slab on it, (3,) [N].
        """


class MujocoRig(Rig):
    """A ball on three slides, with a servo that keeps it near its course, 0.02 mm a newton.

    Args:
        ground: slab and ball.
        timestep: timestep [s].
        slab: MJCF of what is under the ball, a child of the world.
        integrator: MuJoCo's integrator.
        contact: MJCF attributes of the ball's contact.
        material: material of the flex that the slab is.
    """

    def __init__(self, ground: Ground, timestep: float, slab: str = "", *, integrator: str = "implicitfast",
                 contact: str = 'contype="0" conaffinity="0"', material: Material | None = None) -> None:  # fmt: skip
        super().__init__(timestep)
        spec = mujoco.MjSpec.from_string(f"""
<mujoco>
  <option integrator="{integrator}" timestep="{timestep}" gravity="0 0 0" cone="elliptic" tolerance="1e-6"/>
  <worldbody>
    {slab}
    <body name="hand">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="{ground.radius}" mass="{ground.mass}" {contact}/>
    </body>
  </worldbody>
</mujoco>""")
        if material:
            spec.flexes[0].elastic3d = int(material == "snh")
        with warnings.catch_warnings():  # it warns of missing passive forces before it has seen the elasticity
            warnings.filterwarnings("ignore", message=".*is not rigid")
            self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self._dofs = self.model.joint("x").dofadr[0] + np.arange(3)
        self._places = self.model.joint("x").qposadr[0] + np.arange(3)
        self._begun = False

    def step(self, place: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Rig."""
        model, data = self.model, self.data
        if not self._begun:
            data.qpos[self._places], self._begun = place, True
        mujoco.mj_step1(model, data)
        at, speed = data.qpos[self._places].copy(), data.qvel[self._dofs]
        data.qfrc_applied[self._dofs] = SERVO[0] * (place - at) + SERVO[1] * (velocity - speed)
        soft = self._soft()
        mujoco.mj_step2(model, data)
        return at, data.qfrc_constraint[self._dofs].copy() if soft is None else soft

    def _soft(self) -> np.ndarray | None:
        """Force of a skin that is no part of the model, (3,) [N]; None: MuJoCo's own contact says it."""
        return None


class SkinRig(MujocoRig):
    """Our SoftBody.

    Args:
        ground: slab and ball.
        layer: the slab's skin.
        timestep: timestep [s].
    """

    def __init__(self, ground: Ground, layer: SoftLayer, timestep: float = 1e-3) -> None:
        from stmpl_sim import SoftBody

        super().__init__(ground, timestep, '<body name="slab"/>')
        self.skin = SoftBody(self.model, layer, body="slab", tools=["ball"], friction=ground.friction or None)

    def _soft(self) -> np.ndarray:
        self.skin.apply(self.data)
        assert self.skin.reaction is not None
        return self.skin.reaction.tools["ball"][:3]


class RigidRig(MujocoRig):
    """MuJoCo's rigid contact, as soft as solref and solimp say.

    Args:
        ground: slab and ball; a box is in the slab's place.
        solver: solref and solimp.
        impratio: ratio of the impedance of friction to that of pressing [-]; 1 is MuJoCo's default.
        timestep: timestep [s].
    """

    def __init__(self, ground: Ground, solver: Solver, impratio: float = 1.0, timestep: float = 1e-3) -> None:
        x, y, z = ground.size[0] / 2, ground.size[1] / 2, ground.thickness / 2
        contact = _contact(ground, solver)
        super().__init__(ground, timestep, contact=contact,
                         slab=f'<geom type="box" size="{x} {y} {z}" pos="0 0 {-z}" {contact}/>')  # fmt: skip
        self.model.opt.impratio = impratio


class FlexRig(MujocoRig):
    """MuJoCo's flex: a regular grid of tetrahedra, bonded below and at its sides, stepped implicitly in position.

    Args:
        ground: slab and ball.
        layers: number of cells through the thickness; cells are cubes, as nearly as the slab allows.
        material: "stvk", MuJoCo's default, or "snh", its stable Neo-Hookean one.
        nodes: kind of nodes: each its own ("full"), or cells of 2 x 2 x 2 of the grid with 27 nodes ("quadratic").
        solver: solref and solimp of the contact with the ball.
        timestep: timestep [s]; 1 to 4 ms is what MuJoCo's guide calls typical.
        damping: Rayleigh's coefficient of the stiffness [s].
    """

    def __init__(self, ground: Ground, layers: int, material: Material = "snh",
                 nodes: Literal["full", "quadratic"] = "full", solver: Solver = HARD, timestep: float = 4e-3,
                 damping: float = 0.0) -> None:  # fmt: skip
        cells = grid(ground, layers)
        count = " ".join(str(n + 1) for n in cells)
        spacing = " ".join(map(str, np.array([*ground.size, ground.thickness]) / cells))
        last = np.array(cells)
        sides = [((0, 0, 0), (last[0], last[1], 0))]
        for axis in (0, 1):
            low, high = np.zeros(3, int), last.copy()
            high[axis] = 0
            sides.append((tuple(low), tuple(high)))
            low, high = np.zeros(3, int), last.copy()
            low[axis] = last[axis]
            sides.append((tuple(low), tuple(high)))
        pins = "".join(f'<pin gridrange="{" ".join(map(str, low))} {" ".join(map(str, high))}"/>'
                       for low, high in sides)  # fmt: skip
        dof = "" if nodes == "full" else f'dof="{nodes}" cellcount="{" ".join(str(n // 2) for n in cells)}"'
        mass = ground.tissue.density * ground.size[0] * ground.size[1] * ground.thickness
        contact = _contact(ground, solver)
        super().__init__(ground, timestep, f"""
    <flexcomp name="slab" type="grid" dim="3" count="{count}" spacing="{spacing}" pos="0 0 {-ground.thickness / 2}"
              mass="{mass}" radius="1e-4" {dof}>
      <contact selfcollide="none" {contact}/>
      <elasticity young="{ground.tissue.youngs_modulus}" poisson="{ground.tissue.poisson_ratio}" damping="{damping}"/>
      {pins}
    </flexcomp>""", integrator="discrete", contact=contact, material=material if nodes == "full" else None)  # fmt: skip


def grid(ground: Ground, layers: int) -> tuple[int, int, int]:
    """Cells of a slab along x, y and z: cubes, as nearly as the slab allows, an even number along x and y."""
    edge = ground.thickness / layers
    x, y = (2 * round(length / edge / 2) for length in ground.size)
    return x, y, layers


def _contact(ground: Ground, solver: Solver) -> str:
    friction = f'condim="3" friction="{ground.friction} 0 0"' if ground.friction else 'condim="1"'
    return f'{friction} solref="{solver[0]}" solimp="{solver[1]}"'
