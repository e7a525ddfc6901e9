"""Protocol: poses in, wrenches out, one step at a time: what any rigid-body simulator needs to feel soft skin."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from stmpl_core.arrays import (
    Transform,
    Wrench,
    check_choice,
    check_count,
    check_dt,
    check_kind,
    check_number,
    cross,
    inverted,
)
from stmpl_core.carrying import carry_at
from stmpl_core.contact import Contact, rigid
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction, check_tools
from stmpl_core.layer import SoftLayer
from stmpl_core.local_contact import LocalContact, local_contacts
from stmpl_core.methods import MomentNet
from stmpl_core.methods.base import Method
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.tool import Tool
from stmpl_core.touch import APART, IN_CORE, Answer, Touch
from stmpl_core.toucher import FAR

WAY_THROUGH = 0.5  # way of a tool, over the thickness, from which it may have gone through the limb
FAR_HOLES = 3.0  # distance of a tool from the skin, over a hole of the mesh, from which the contact law is not asked
WENT_THROUGH = "{name} went through the body, and is pushed out on a side that it did not come from"


@dataclass(frozen=True, eq=False)
class Poses:
    """Places of one instant, as a simulator knows them.

    Args:
        body: pose_world_from_body of the body that carries the skin, (4, 4).
        tools: pose_world_from_tool by the tool's name, (4, 4) each.
    """

    body: Transform
    tools: Mapping[str, Transform]


@dataclass(frozen=True, eq=False)
class Asked:
    """The last step at which the contact law was asked, for the steps up to the next one.

    Args:
        at: pose_body_from_tool then, by the tool's name, layer axes.
        touches: touches then, by the tool's name.
        models: local models of those that press, by name.
        steps: steps since then.
    """

    at: Mapping[str, Transform]
    touches: Mapping[str, Touch]
    models: Mapping[str, LocalContact]
    steps: int = 0


class Row(NamedTuple):
    """What a simulator's side keeps of a body, to which skins and others add wrenches, each (6,) [N, N m].

    Args:
        numbers: sum, as it stood with the body.
        others: part that is not of skins.
        ours: part of this skin.
    """

    numbers: Wrench
    others: Wrench
    ours: Wrench


class Exerted(NamedTuple):
    """What a skin had put into a simulator's state, so that it is known again where the state is put back.

    Args:
        owner: key of the skin, of which there is one in the world.
        time: time of the simulation [s].
        rows: rows by the number of the body.
    """

    owner: str
    time: float
    rows: Mapping[int, Row]


@dataclass(frozen=True, eq=False)
class Memory:
    """Memory of a soft contact: a value that goes into a step and comes out of it.

    Args:
        tissue: memory of the tissue.
        at: pose_body_from_tool of the step before, by the tool's name, layer axes.
        speed: speed at which each tool that pressed went into the skin [m/s], and the force that it pressed with [N].
        free: way that each tool that is apart may go before it may touch, by name [m].
        asked: step at which the contact law was asked last; None: it must be asked now.
        waited: time since that step [s].
        pushes: way in which each tool that presses pushed last while it was not in the core, unit vector (3,), by name.
        through: names of tools that went through the body and have not been apart since.
        exerted: what the skin's wrenches were in the state that this belongs to, where somebody keeps it (SoftBody).
    """

    tissue: State = field(default_factory=State)
    at: Mapping[str, Transform] = field(default_factory=dict)
    speed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    free: Mapping[str, float] = field(default_factory=dict)
    asked: Asked | None = None
    waited: float = 0.0
    pushes: Mapping[str, np.ndarray] = field(default_factory=dict)
    through: frozenset[str] = frozenset()
    exerted: Exerted | None = None


@dataclass(frozen=True, eq=False)
class Reaction:
    """Wrenches of one step, for the simulator to exert: force [N], torque [N m], world axes, (6,).

    Args:
        tools: wrench on each tool about its own origin, by name. What a sensor behind the tool would feel.
        body: wrench on the body about its origin: the opposite of all of them.
        touches: touch of each contact, by the name of its tool, in layer axes: what the tissue and its friction carry,
            without `damping` and `implicit`. Between two steps that ask (`every`) wrench and pose are of now, all else
            is of when the law was asked.
        memory: memory for the next step.
    """

    tools: Mapping[str, Wrench]
    body: Wrench
    touches: Mapping[str, Touch]
    memory: Memory


class World(Protocol):
    """A rigid-body simulator, as a soft contact sees it."""

    def poses(self) -> Poses:
        """Places of now."""
        ...

    def push(self, reaction: Reaction) -> None:
        """Exerts the wrenches of a reaction during the coming step, in place of those of the last one."""
        ...


class SoftContact:
    """Soft skin on one body, and the tools that may touch it. It keeps no time: poses and memory in, wrenches out.

    The wrench follows from the poses of the same instant, so a simulator that integrates semi-implicitly (velocity
    first, then position with the new velocity) couples to it like to a spring of its own: stable while the step is
    shorter than 2 sqrt(m / k) for the effective mass m of what touches and the contact's stiffness k. `damping` and
    `implicit` are for what is lighter than that.

    Args:
        layer: soft layer at rest, or a Skin, or a Simulator that is ready.
        tools: tools that may touch.
        method: method that finds the displacement; MomentNet() unless given; a Skin or a Simulator has its own.
        pose_body_from_layer: pose of the layer's axes in the body's frame, (4, 4); the same frame unless given.
        damping: damping of the contact [s/m], as of Hunt and Crossley (1975): the force F that presses becomes
            F (1 + damping v) at the speed v into the skin, and never pulls; friction stays as it is. Not measured on
            tissue; 0: none. Without `implicit` a step h is stable while h^2 k + 2 h c < 4 m, c = damping F.
        implicit: choice to take the force that presses at the end of the step, to first order (backward Euler,
            linearised): F* = (F + h k (v + h a)) / (1 + h^2 k A), with the step h, the stiffness k along the force as a
            LocalContact has it, the speed v into the skin, its acceleration a without the contact, and the mobility A
            [1/kg] of the tool against the body. Needs `mobility` at each step. Each tool by itself. It damps: of the
            energy of a bounce it took 34 to 47 % at 0.2 ms. It is for what is too light for the step.
        friction: coefficient of friction, or the name of a pair in stmpl_core.friction, of all tools or by tool's
            name; None: none, or that of the Simulator that was given.
        every: steps from one at which the contact law is asked to the next. In between the contact goes on to first
            order, by its local model, while that holds; what is apart is asked about as soon as it may touch. Not with
            `damping` nor `implicit`.

    Raises:
        InvalidInput: tools of one name, no tools, a damping below 0, a pose that is not rigid, an `every` below 1 or
            beside `damping` or `implicit`, other kinds of values, a method beside what has one, or friction that is
            none or is given beside a Simulator, which has its own.
        MeshError: a surface that cannot be a tool.
    """

    def __init__(
        self,
        layer: SoftLayer | Skin | Simulator,
        tools: Sequence[Tool],
        method: Method | None = None,
        *,
        pose_body_from_layer: ArrayLike | None = None,
        damping: float = 0.0,
        implicit: bool = False,
        friction: Friction | Mapping[str, Friction] = None,
        every: int = 1,
    ) -> None:
        if isinstance(tools, str) or not isinstance(tools, Iterable):
            raise InvalidInput(f"tools is {tools!r:.40}; a list of Tools is needed.")
        tools = list(tools)
        for one in tools:
            check_kind("a tool", one, Tool)
        check_kind("layer", layer, (SoftLayer, Skin, Simulator))
        check_number("damping", damping)
        check_choice("implicit", implicit)
        names = [tool.name for tool in tools]
        if not names or len(set(names)) < len(names):
            raise InvalidInput(f"a skin wants tools with names of their own; got {', '.join(names) or 'none'}.")
        if damping < 0:
            raise InvalidInput(f"damping is {damping} s/m; it must be finite and at least 0.")
        check_count("every", every)
        if every > 1 and (damping or implicit):
            raise InvalidInput(f"the contact law is asked at every {every} steps; with damping or implicit=True that "
                               "must be 1.")  # fmt: skip
        check_tools(friction, names)
        if method is not None and not isinstance(layer, SoftLayer):
            raise InvalidInput(f"this {type(layer).__name__} has its method; leave the other one out.")
        if isinstance(layer, Simulator):
            if friction is not None:
                has = "has its own friction" if layer.history.rubs else "is without friction"
                raise InvalidInput(f"this Simulator {has}. Give it there: Simulator(..., friction=0.3).")
            self.simulator = layer
        else:
            ready = None if isinstance(layer, Skin) else MomentNet() if method is None else method
            self.simulator = Simulator(layer, ready, friction=friction)
        self.tools = {tool.name: tool for tool in tools}
        self.damping, self.implicit, self.every = damping, implicit, every
        self.pose_body_from_layer = rigid("pose_body_from_layer", np.eye(4) if pose_body_from_layer is None
                                          else pose_body_from_layer)  # fmt: skip
        hole = self.simulator.toucher.hole
        self._thickest = float(self.simulator.layer.thickness.max())
        self._far, self._seen = FAR_HOLES * hole, hole + self._thickest
        self._tree = KDTree((self.simulator.skin.rest or self.simulator.skin).layer.vertices)
        self._balls = {}
        for tool in tools:
            low, high = self.simulator.tools.field(tool).tool_bounds
            middle = 0.5 * (low + high)
            self._balls[tool.name] = middle, float(np.linalg.norm(tool.vertices - middle, axis=1).max())

    def step(
        self,
        poses: Poses,
        memory: Memory | None = None,
        dt: float = 0.0,
        mobility: Callable[[str, np.ndarray, np.ndarray], float] | None = None,
    ) -> Reaction:
        """Finds the wrenches at one instant.

        Args:
            poses: places of now.
            memory: memory of the step before; None: a fresh start.
            dt: time since that step [s].
            mobility: with `implicit`, acceleration [m/s2] of the tool of this name against the body, along a unit
                vector (3,) at a point (3,) [m], world axes, when 1 N pushes them apart there: n^T J M^-1 J^T n.

        Raises:
            InvalidInput: poses that are missing, not finite or not rigid, a dt below 0, or no mobility where one
                is needed.
        """
        if self.implicit and mobility is None:
            raise InvalidInput("an implicit contact needs the mobility of its tools. Try implicit=False.")
        check_dt(dt)
        check_kind("poses", poses, Poses)
        check_kind("poses.tools", poses.tools, Mapping)
        check_kind("memory", memory, (Memory, type(None)))
        memory = memory or Memory()
        body = sound_pose("the body", poses.body)
        world_from_layer = body @ self.pose_body_from_layer
        layer_from_world = inverted(world_from_layer)
        missing = [name for name in self.tools if name not in poses.tools]
        if missing:
            raise InvalidInput(f"there is no pose of {', '.join(missing)}; given: {', '.join(poses.tools) or 'none'}.")
        stand = {name: sound_pose(name, poses.tools[name]) for name in self.tools}
        at = {name: layer_from_world @ pose for name, pose in stand.items()}
        if memory.asked is not None and memory.asked.touches.keys() != self.tools.keys():
            raise InvalidInput(f"the memory is of a contact with {', '.join(memory.asked.touches)}; this one has "
                               f"{', '.join(self.tools)}. Start with an empty Memory().")  # fmt: skip

        # Touch: to first order from the last step that asked, or asked.
        touches, now = self._between(at, memory, dt) or self._ask(at, memory, dt)
        models = now.asked.models if now.asked is not None and self.implicit else {}

        # Wrenches: from layer to world axes, about the origin of the stated pose; the body feels the opposite.
        turn = world_from_layer[:3, :3]
        wrenches, on_body, speed = {}, np.zeros(6), {}
        for name, touch in touches.items():
            if not touch.wrench.any():
                wrenches[name] = np.zeros(6)
                continue
            factor, speed[name] = self._factor(touch, at[name], memory, dt, models.get(name), world_from_layer,
                                               mobility)  # fmt: skip
            pressing = _pressing(touch)
            exerted = factor * pressing + (touch.wrench - pressing)
            force, torque = exerted[:3], exerted[3:]
            torque = torque + cross(touch.pose_body_from_tool[:3, 3] - at[name][:3, 3], force)
            force, torque = turn @ force, turn @ torque
            wrenches[name] = -np.concatenate([force, torque])
            lever = stand[name][:3, 3] - body[:3, 3]
            on_body += np.concatenate([force, torque + cross(lever, force)])
        return Reaction(wrenches, on_body, touches, replace(now, speed=speed))

    def _ask(self, at: Mapping[str, Transform], memory: Memory, dt: float) -> tuple[dict[str, Touch], Memory]:
        """Touches by the contact law, and the memory then, but for speeds; at: see Memory.

        Of tools that are near, or whose imprint is still there; the others are apart, which costs nothing.
        """
        free = {name: self._free(name, pose, memory) for name, pose in at.items()
                if not _has_imprint(memory.tissue, name)}  # fmt: skip
        near = [Contact(self.tools[name], pose) for name, pose in at.items() if not 0 < free.get(name, 0.0) <= FAR]
        found, tissue = self.simulator.touch(near, memory.tissue, memory.waited + dt)
        through = frozenset(touch.name for touch in found if self._went_through(touch, at[touch.name], memory))
        found = [touch.with_(trust=touch.trust.also(WENT_THROUGH.format(name=touch.name), in_range=False))
                 if touch.name in through else touch for touch in found]  # fmt: skip
        hole, seen, models = self.simulator.toucher.hole, self._seen, {}
        free |= {touch.name: min(-touch.depth, seen) - hole for touch in found if touch.status == APART}
        if self.every > 1 or (self.implicit and dt > 0):
            pressing = [touch for touch in found if touch.wrench.any()]
            made = local_contacts(self.simulator.history, pressing, tissue)
            models = {touch.name: model for touch, model in zip(pressing, made, strict=True)}
        by_name = {touch.name: touch for touch in found}
        touches = {name: by_name.get(name) or Touch(name, APART, pose, np.zeros(6)) for name, pose in at.items()}
        return touches, Memory(tissue, at, free=free, asked=Asked(at, touches, models),
                               pushes=_pushes(found, memory), through=through)  # fmt: skip

    def _went_through(self, touch: Touch, pose: Transform, memory: Memory) -> bool:
        """Whether a tool presses on skin that it came to through the body; pose: of now, layer axes.

        Where it presses it moved out of that skin by more than it was deep in any; or it was deep, and came from the
        other side.
        """
        force, asked = touch.force, memory.asked
        if not force > 0 or asked is None or touch.name in memory.through:
            return force > 0 and touch.name in memory.through
        before, push = asked.touches[touch.name], touch.push / force
        deep, far = max(before.depth, 0.0) if before.presses else 0.0, WAY_THROUGH * self._thickest
        out = -float(_way(asked.at[touch.name], pose, _centre_of_pressure(touch)) @ push)
        return out > deep + far or (out > 0 and deep > far and float(memory.pushes.get(touch.name, push) @ push) < 0)

    def _between(self, at: Mapping[str, Transform], memory: Memory, dt: float
                 ) -> tuple[dict[str, Touch], Memory] | None:  # fmt: skip
        """The same to first order from the last step that asked; None: the law must be asked."""
        asked = memory.asked
        if asked is None or asked.steps + 1 >= self.every:
            return None
        touches, free = {}, {}
        for name, pose in at.items():
            touch, model = asked.touches[name], asked.models.get(name)
            if model is None:
                free[name] = 0.0 if _has_imprint(memory.tissue, name) else self._free(name, pose, memory)
                if not free[name] > 0:
                    return None
                touches[name] = touch.with_(pose_body_from_tool=pose)
                continue
            there = pose @ inverted(asked.at[name]) @ model.pose_body_from_tool
            rendered = model.wrench_at(there)
            if not rendered.inside:
                return None
            touches[name] = touch.with_(wrench=rendered.wrench, pose_body_from_tool=there)
        later = replace(asked, steps=asked.steps + 1)
        return touches, Memory(memory.tissue, at, free=free, asked=later, waited=memory.waited + dt,
                               pushes=memory.pushes, through=memory.through)  # fmt: skip

    def pose(self, joints: Mapping[str, float], memory: Memory) -> Memory:
        """Takes the skin to where its joints are now (milliseconds); the memory, gone along with it.

        Args:
            joints: angle by the joint's name [rad].
            memory: memory of the step before.

        Raises:
            InvalidInput: see Simulator.pose.
        """
        before, places = self.simulator.skin, {name: self.place(name, pose, memory) for name, pose in memory.at.items()}
        tissue = self.simulator.pose(joints, memory.tissue)
        at = {name: carry_at(before, self.simulator.skin, places[name]) @ pose for name, pose in memory.at.items()}
        return Memory(tissue, at, memory.speed, waited=memory.waited, pushes=memory.pushes,
                      through=memory.through)  # fmt: skip

    def place(self, name: str, pose: Transform, memory: Memory) -> np.ndarray:
        """Middle of a tool's last contact, or else of the tool at this pose, (3,) [m], layer axes."""
        kept = memory.tissue.tools.get(name)
        if kept is not None and kept.scalars.radius > 0:
            return kept.contact[0]
        pressure = None if memory.asked is None else memory.asked.touches[name].pressure
        if pressure is None or not pressure.any():
            return pose[:3, :3] @ self._balls[name][0] + pose[:3, 3]
        layer, pressed = self.simulator.layer, np.flatnonzero(pressure)
        forces = pressure[pressed] * layer.vertex_areas[pressed]
        return forces @ layer.vertices[pressed] / forces.sum()

    def answer(self, reaction: Reaction) -> Answer:
        """The displacement of the skin under a reaction of this contact, layer axes."""
        return self.simulator.answer(list(reaction.touches.values()))

    def _free(self, name: str, pose: Transform, memory: Memory) -> float:
        """Way that a tool may go from its pose before the contact law need be asked [m]; not above 0: it must be."""
        (middle, radius), before = self._balls[name], memory.at.get(name)
        if before is not None and memory.free.get(name, 0.0) > 0:
            way = pose - before
            left = memory.free[name] - float(np.linalg.norm(way[:3, :3] @ middle + way[:3, 3])
                                             + np.linalg.norm(way[:3, :3]) * radius)  # fmt: skip
            if left > 0:
                return left
        centre = pose[:3, :3] @ middle + pose[:3, 3]
        layer = self.simulator.layer
        if self.simulator.skin.rest is None:
            gap, nearest = self._tree.query(centre)
        else:  # a tree pays for itself only where the skin stays
            nearest = int(((layer.vertices - centre) ** 2).sum(axis=1).argmin())
            gap = np.linalg.norm(layer.vertices[nearest] - centre)
        outside = (centre - layer.vertices[nearest]) @ layer.normals[nearest] > 0.5 * gap
        return float(gap) - radius - self._far if outside else 0.0

    def _factor(
        self,
        touch: Touch,
        pose: Transform,
        memory: Memory,
        dt: float,
        model: LocalContact | None,
        world_from_layer: Transform,
        mobility: Callable[[str, np.ndarray, np.ndarray], float] | None,
    ) -> tuple[float, tuple[float, float]]:
        """Factor on the wrench that presses; and for the memory, speed into the skin [m/s] and force [N]."""
        if not (self.damping or self.implicit) or (force := touch.force) == 0:
            return 1.0, (0.0, 0.0)
        normal, centre = touch.push / force, _centre_of_pressure(touch)
        before, last = memory.at.get(touch.name), memory.speed.get(touch.name)
        v = 0.0 if last is None or dt > 0 else last[0]  # a step without time goes on as before
        if before is not None and dt > 0:  # of the tool's point that is at the centre of pressure now
            v = float(_way(before, pose, centre) @ normal) / dt
        c = self.damping * force
        if model is None:
            return max(0.0, 1 + self.damping * v), (v, force)
        assert mobility is not None
        k = max(0.0, float(normal @ model.push_stiffness[:3, :3] @ normal))
        turn = world_from_layer[:3, :3]
        a = mobility(touch.name, turn @ centre + world_from_layer[:3, 3], turn @ normal)
        # What accelerated it in the last step, less what the contact itself did of that.
        free = (v - last[0]) / dt + a * last[1] if last else 0.0
        stiff = k * dt + c
        taken = max(0.0, (force + stiff * (v + dt * free)) / (1 + stiff * dt * a))
        return taken / force, (v, taken)


def exchange(contact: SoftContact, world: World, memory: Memory | None = None, dt: float = 0.0) -> Reaction:
    """One step with a world: reads its poses, exerts the wrenches, and returns them. Raises InvalidInput."""
    reaction = contact.step(world.poses(), memory, dt, getattr(world, "mobility", None))
    world.push(reaction)
    return reaction


def _has_imprint(tissue: State, name: str) -> bool:
    """Whether the tissue has not yet come back from where this tool pressed."""
    known = tissue.tools.get(name)
    return known is not None and known.sunk


def _pushes(touches: Sequence[Touch], memory: Memory) -> dict[str, np.ndarray]:
    """The `pushes` of the next memory."""
    now = {touch.name: touch.push / force for touch in touches if (force := touch.force) > 0}
    kept = {touch.name for touch in touches if touch.status == IN_CORE} & set(memory.pushes)
    return now | {name: memory.pushes[name] for name in kept}


def _pressing(touch: Touch) -> Wrench:
    """Wrench that the tool presses with, friction left out, (6,) [N, N m]."""
    return touch.wrench if touch.slip is None else touch.wrench - touch.slip.wrench


def _centre_of_pressure(touch: Touch) -> np.ndarray:
    """Point nearest to the tool's origin on the axis of the wrench that presses, layer axes, (3,) [m]."""
    wrench = _pressing(touch)
    force = wrench[:3]
    return touch.pose_body_from_tool[:3, 3] + cross(force, wrench[3:]) / (force @ force)


def _way(before: Transform, now: Transform, point: np.ndarray) -> np.ndarray:
    """Way of a tool's point from one pose to another, after which it is here, (3,) [m]."""
    at = (point - now[:3, 3]) @ now[:3, :3]
    return point - before[:3, :3] @ at - before[:3, 3]


def sound_pose(name: str, pose: ArrayLike) -> Transform:
    """The pose, if it is one. Raises InvalidInput: it is not finite or not rigid."""
    try:
        return rigid(f"the pose of {name}", pose)
    except InvalidInput as error:
        raise InvalidInput(f"{error} Has the simulation diverged? Try a shorter timestep.") from error

