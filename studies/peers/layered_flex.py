"""LayeredFlex: a ball pressed into a stack that is MuJoCo's flex, with MuJoCo's own contact, run until it rests."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import mujoco
import numpy as np

from fem_tools.patch import PatchFem
from fem_tools.plies import materials, wedge_plies
from stmpl_core.arrays import Transform
from stmpl_core.layer import SoftLayer
from stmpl_core.tool import Tool
from studies.peers.mujoco_flex import warnings_logged, words
from studies.tets import split_wedges

SCENE = """
<mujoco>
  <option integrator="discrete" timestep="{timestep}" tolerance="1e-6" iterations="400" gravity="0 0 0" cone="elliptic">
    <flag autoreset="disable"/>
  </option>
  <worldbody>
    <body name="hand" mocap="true" pos="{place}">
      <geom name="ball" type="sphere" size="{radius}" condim="3" friction="{friction} 0 0" solref="{solref}"
            solimp="{solimp}"/>
    </body>
    <flexcomp name="layer" type="direct" dim="3" mass="{mass}" radius="1e-4" inertiabox="1e-3"
              point="{points}" element="{tets}">
      <elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>
      <contact selfcollide="none" condim="3" friction="{friction} 0 0" solref="{solref}" solimp="{solimp}"/>
      <pin id="{pinned}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""
ROUND = 0.98  # least radius of a tool's surface over the largest, from which it is a ball
STEPS, TIMESTEP = 20, 0.02  # steps in which `ball` goes in, and how long each is [s]
PER_MODULUS = 23  # of an element's 24 numbers, those that are proportional to its modulus (the last is of its shape)
SOLREF, SOLIMP = "-1e7 -3e3", "0.95 0.99 0.0001"  # contact much stiffer than the skin


class Held(NamedTuple):
    """Where it rests.

    Args:
        displacement: motion of the layer's vertices, (V, 3) [m].
        traction: contact force over rest area at the layer's vertices, (V, 3) [Pa].
        rests: flag that the force no longer changes by more than was allowed.
        min_j: smallest det F of a tetrahedron.
        entered: depth of the deepest node in the ball [m].
    """

    displacement: np.ndarray
    traction: np.ndarray
    rests: bool
    min_j: float
    entered: float


class LayeredFlex:
    """A stack as one flex, the stiffness of each tetrahedron that of its material, and its skin as a flex of triangles.

    MuJoCo gives a flex one modulus: the compiled model's `flex_stiffness` is scaled by element, in which it is linear.
    The skin shares the outermost nodes, stretches, does not bend, and has no tension at rest: MuJoCo has none.

    Args:
        layer: soft layer.
        loaded: vertices that are pressed, of whose surroundings the patch is made.
        radius: radius of the ball [m].
        material: "stvk", MuJoCo's default, or "snh".
        layers, refine, reach: mesh of the patch, as PatchFem's; each wedge becomes three tetrahedra.
        friction: coefficient of friction.
        timestep: timestep [s].
        damping: Rayleigh's coefficient of the stiffness [s].
    """

    def __init__(self, layer: SoftLayer, loaded: np.ndarray, radius: float, *, material: str = "snh", layers: int = 1,
                 refine: int = 1, reach: float = 5.0, friction: float = 1.0, timestep: float = 4e-3,
                 damping: float = 5e-3) -> None:  # fmt: skip
        tissue = layer.tissue
        self.layer, self.radius = layer, radius
        self.patch = PatchFem(element="P1xP2", layers=layers, refine=refine, reach=reach).prepare(layer).patch_around(
            loaded)  # fmt: skip
        mesh = self.patch.mesh
        self.tets = split_wedges(mesh.outer, mesh.inner, mesh.triangles, mesh.layers, mesh.ends)
        held = self.tets.core | np.tile(self.patch.fixed, mesh.layers + 1)
        spec = mujoco.MjSpec.from_string(SCENE.format(
            timestep=timestep, place="0 0 1", radius=radius, friction=friction, solref=SOLREF, solimp=SOLIMP,
            mass=tissue.density * float(self.tets.volumes.sum()), points=words(self.tets.points),
            tets=words(self.tets.tets), pinned=words(np.flatnonzero(held)), young=tissue.youngs_modulus,
            poisson=tissue.poisson_ratio, damping=damping))  # fmt: skip
        flex = spec.flexes[0]
        flex.elastic3d = int(material == "snh")
        if tissue.skin:
            membrane = spec.add_flex(name="skin", dim=2, radius=1e-4, vertbody=list(flex.vertbody)[: len(mesh.outer)],
                                     elem=mesh.triangles.ravel().tolist(), young=tissue.skin.youngs_modulus,
                                     poisson=tissue.skin.poisson_ratio, thickness=tissue.skin.thickness, elastic2d=2,
                                     damping=damping, contype=0, conaffinity=0, selfcollide=0)  # fmt: skip
            membrane.vert = list(flex.vert)[: 3 * len(mesh.outer)]
        with warnings.catch_warnings():  # it warns of missing passive forces before it has seen the elasticity
            warnings.filterwarnings("ignore", message=".*is not rigid")
            self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        plies = wedge_plies(mesh, tissue).reshape(len(mesh.triangles), mesh.layers).T
        moduli = np.array([one.youngs_modulus for one in materials(tissue)]) / tissue.youngs_modulus
        stiffness = self.model.flex_stiffness[: 24 * len(self.tets.tets)].reshape(-1, 24)
        stiffness[:, :PER_MODULUS] *= np.tile(moduli[plies][:, None], (1, 3, 1)).reshape(-1, 1)
        self.moving = np.flatnonzero(~held)
        self.dofs = self.model.body_dofadr[self.model.flex_vertbodyid[self.moving]][:, None] + np.arange(3)

    def press(self, places: np.ndarray, rest: float = 2e-3, most: int = 200) -> Held:
        """Leads the ball's middle through places (N, 3) [m], one a step, from rest, and waits at the last.

        Args:
            places: places of the ball's middle.
            rest: change of the contact's forces in a step, over their size, from which on it rests [-].
            most: steps after which it is given up.
        """
        model, data, points = self.model, self.data, self.tets.points.copy()
        held, last, change, steps = np.zeros_like(points), np.zeros_like(points), np.inf, 0
        mujoco.mj_resetData(model, data)
        with warnings_logged():
            while steps < len(places) or (change > rest and steps < most):
                data.mocap_pos[0] = places[min(steps, len(places) - 1)]
                mujoco.mj_step(model, data)
                held[self.moving] = data.qfrc_constraint[self.dofs]
                change = float(np.linalg.norm(held - last) / max(np.linalg.norm(held), 1e-12))
                last, steps = held.copy(), steps + 1
        points[self.moving] += data.qpos[self.dofs]
        here = self.patch.vertices
        moved, traction = np.zeros_like(self.layer.vertices), np.zeros_like(self.layer.vertices)
        moved[here] = (points - self.tets.points)[: len(here)]
        skin = held[: len(self.patch.mesh.outer)]
        traction[here] = self.patch.gather(skin) / self.layer.vertex_areas[here, None]
        entered = self.radius - float(np.linalg.norm(points - places[-1], axis=1).min())
        return Held(moved, traction, change <= rest, self.tets_det(points), entered)

    def tets_det(self, points: np.ndarray) -> float:
        """Smallest det F of the tetrahedra with their nodes at `points`, (N, 3) [m]."""
        corners = points[self.tets.tets]
        return float((np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6 / self.tets.volumes).min())


def ball(layer: SoftLayer, tool: Tool, pose: Transform, way: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Force of a ball on the limb (3,) [N] and motion of the skin (V, 3) [m], as benchmarks.limbs asks a law for them.

    Not a number for a tool that is no ball, and where the flex does not come to rest.
    """
    away = np.linalg.norm(tool.vertices - tool.vertices.mean(axis=0), axis=1)
    radius = float(away.max())
    if away.min() < ROUND * radius:
        return np.full(3, np.nan), None
    end = pose[:3, :3] @ tool.vertices.mean(axis=0) + pose[:3, 3]
    from_end = layer.vertices - end
    back = -(from_end @ way)
    beside = np.linalg.norm(from_end + back[:, None] * way, axis=1)
    deep = np.where(beside < radius, back + np.sqrt(np.clip(radius**2 - beside**2, 0, None)), 0.0)
    deep[np.linalg.norm(from_end, axis=1) > 2 * radius] = 0.0
    start = end - max(float(deep.max()), 0.0) * way
    peer = LayeredFlex(layer, np.flatnonzero(np.linalg.norm(from_end, axis=1) < radius), radius, refine=0,
                       timestep=TIMESTEP)  # fmt: skip
    held = peer.press(start + np.linspace(0, 1, STEPS + 1)[1:, None] * (end - start))
    force = layer.vertex_areas @ held.traction
    return force if held.rests else np.full(3, np.nan), held.displacement
