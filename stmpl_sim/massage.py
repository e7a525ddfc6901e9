"""Massage: approach, press, circle, let go: a course, the loop in which a robot follows it, and what it kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stmpl_core.arrays import Wrench, check_kind, check_number, cross, is_number
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from stmpl_core.local_contact import local_contacts
from stmpl_core.warming import CompiledAhead
from stmpl_sim.ability import strength, stuck_joints
from stmpl_sim.controller import ForceImpedance, Gains, Goal
from stmpl_sim.energy import EnergyBook
from stmpl_sim.engine import mujoco
from stmpl_sim.grip import FINGERS, GAP, Gripper, smooth, with_fingers
from stmpl_sim.grip import PHASES as GRIPPING
from stmpl_sim.mujoco_skin import SoftBody
from stmpl_sim.protocol import Memory, Poses
from stmpl_sim.scene import BALL, LIMB, Scene
from stmpl_sim.site import Circle

REACH_S, APPROACH_S, HOLD_S, RELEASE_S = 0.6, 1.4, 1.0, 1.0  # durations of phases
BLEND_S = 0.4  # time in which one force becomes the next
SETTLE_S = 0.5  # time into a press from which it is judged; circles are from their first instant
DIVERGED = tuple(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}") for what in ("QPOS", "QVEL", "QACC", "CTRL"))
RAMP_S = 0.4  # time in which the speed along a circle is reached
STIFFNESS_S = 0.01  # time between two looks at the contact's stiffness [s]
FIRST = 0.3  # share of the force with which the tool comes to the skin
LANDED = 0.6  # share of the approach after which it is taken to touch, and the force rises
MOST_SPEED = 2.0  # of a course [m/s]: far above that of any massage
START_M, NEAR_M = 0.01, 0.003  # height over the skin at which the tool begins and ends; from which it approaches [m]


@dataclass(frozen=True)
class Phase:
    """Part of a course.

    Args:
        name: name: reach, approach, press, circle, release; grip, lift, hold, lower, open.
        start: time at which it starts [s].
        duration: duration [s].
        force: force into the skin, or of each finger [N].
    """

    name: str
    start: float
    duration: float
    force: float


@dataclass(frozen=True, eq=False)
class Course:
    """Approach, then press and circle with each force, then let go; then grip the limb beside, lift it and lay it down.

    Args:
        circle: circle along the skin.
        forces: forces, one after the other [N].
        speed: speed along the circle [m/s]; 0: no circles.
        laps: laps around it with each force.
        grip: force of each finger [N]; 0: nothing is gripped.
    """

    circle: Circle
    forces: tuple[float, ...] = (5.0, 10.0)
    speed: float = 0.05
    laps: float = 2.0
    grip: float = 0.0
    phases: tuple[Phase, ...] = field(init=False)

    def __post_init__(self) -> None:
        check_kind("forces", self.forces, (tuple, list))
        for name in ("grip", "speed", "laps"):
            check_number(name, getattr(self, name))
        if not self.forces or not all(is_number(force) and 0 < force < np.inf for force in self.forces):
            raise InvalidInput(f"forces are {self.forces}; at least one is needed, each finite and above 0 N.")
        if self.grip < 0:
            raise InvalidInput(f"the grip is {self.grip} N; it must be finite and at least 0.")
        if not (0 <= self.speed <= MOST_SPEED and self.laps >= 0):
            raise InvalidInput(f"speed is {self.speed} m/s and laps {self.laps}; neither may be below 0, nor the speed "
                               f"above {MOST_SPEED:g}. Is it in mm/s?")  # fmt: skip
        lap = 2 * np.pi * self.circle.radius * self.laps / self.speed + RAMP_S if self.speed and self.laps else 0.0
        found = [Phase("reach", 0.0, REACH_S, 0.0), Phase("approach", REACH_S, APPROACH_S, self.forces[0])]
        for force in self.forces:
            for name, duration in (("press", HOLD_S), ("circle", lap)):
                if duration:
                    found.append(Phase(name, found[-1].start + found[-1].duration, duration, force))
        after = [("release", RELEASE_S, 0.0)]
        if self.grip:
            after += [(name, duration, self.grip) for name, duration in GRIPPING.items()]
        for name, duration, force in after:
            found.append(Phase(name, found[-1].start + found[-1].duration, duration, force))
        object.__setattr__(self, "phases", tuple(found))

    @property
    def duration(self) -> float:
        """Duration of all [s]."""
        return self.phases[-1].start + self.phases[-1].duration

    def phase(self, at: float) -> Phase:
        """The phase of a time [s]."""
        return next((p for p in reversed(self.phases) if at >= p.start), self.phases[0])

    def goal(self, at: float, pose_world_from_layer: np.ndarray, radius: float) -> Goal:
        """What the tool is to do at a time [s], where the limb is now.

        Args:
            at: time since the start [s].
            pose_world_from_layer: pose of the limb, (4, 4).
            radius: radius of the ball [m].
        """
        phase = self.phase(at)
        angle, rate, more = self.angle(at)
        place = self.circle.at(angle)
        point, normal, height, (force, growth) = place.point, place.normal, radius, self.force(at)
        if phase.name == "reach":  # from over the site to over the circle's start
            share = smooth((at - phase.start) / phase.duration)
            point = self.circle.site.point + share * (point - self.circle.site.point)
            normal = self.circle.site.normal + share * (normal - self.circle.site.normal)
            normal, force = normal / np.linalg.norm(normal), None
            height = radius + START_M + share * (NEAR_M - START_M)
        elif phase.name in GRIPPING:  # out of the way
            height, force = radius + START_M, None
        elif phase.name == "release":
            height, force = radius + START_M * smooth((at - phase.start) / (0.7 * RELEASE_S)), None
        turn = pose_world_from_layer[:3, :3]
        return Goal(
            point=turn @ point + pose_world_from_layer[:3, 3],
            velocity=turn @ (place.slope * rate),
            acceleration=turn @ (place.bend * rate**2 + place.slope * more),
            normal=turn @ normal,
            spin=turn @ cross(normal, place.tilt * rate),
            swing=turn @ cross(normal, place.curl * rate**2 + place.tilt * more),
            force=force,
            growth=growth,
            height=height,
        )

    def force(self, at: float) -> tuple[float, float]:
        """Force into the skin at a time [s], and its rate [N/s]: one becomes the next in BLEND_S."""
        phase = self.phase(at)
        start, least, duration = phase.start, FIRST * phase.force, (1 - LANDED) * phase.duration
        if phase.name == "approach":
            start += LANDED * phase.duration
        else:
            least = self.phases[max(self.phases.index(phase) - 1, 1)].force
            duration = BLEND_S
        share, more = (at - start) / duration, phase.force - least
        rate = 6 * share * (1 - share) / duration if 0 < share < 1 else 0.0
        return least + more * smooth(share), more * rate

    def angle(self, at: float) -> tuple[float, float, float]:
        """Angle along the circle, its rate [rad/s] and its acceleration: laps begin and end at rest."""
        angle, rate, more, top = 0.0, 0.0, 0.0, self.speed / self.circle.radius
        for phase in self.phases:
            if phase.name != "circle" or at <= phase.start:
                continue
            t, whole = min(at - phase.start, phase.duration), phase.duration
            up, down = min(t, RAMP_S), max(0.0, t - (whole - RAMP_S))
            angle += top * (0.5 * up**2 / RAMP_S + max(0.0, t - RAMP_S) - 0.5 * down**2 / RAMP_S)
            if at < phase.start + whole:
                rate = top * min(1.0, t / RAMP_S, (whole - t) / RAMP_S)
                more = top / RAMP_S * ((t < RAMP_S) - float(t > whole - RAMP_S))
        return angle, rate, more


@dataclass(frozen=True, eq=False)
class Log:
    """What a run did, a row a step.

    Args:
        time: time [s], (N,).
        force: force of the tool into the skin along the outward normal of the course [N], (N,).
        asked: force that was asked for [N], NaN without one, (N,).
        depth: depth of the tool, NaN apart [m], (N,).
        wrench: wrench on the tool, world axes, (N, 6) [N, N m].
        tool: pose of the tool in the world, (N, 4, 4).
        limb: pose of the limb in the world, (N, 4, 4).
        qpos: configuration, (N, nq).
        energy: energy that the skin holds of what the tool gave it [J], (N,).
        off: distance of the tool from its course, along the skin [m], (N,).
        trusted: verdict whether the touch was in the range that was validated, (N,) bool.
        fingers: wrenches on the fingers of a gripper, world axes, (N, F, 6) [N, N m].
        squeeze: force that each presses with, friction left out, (N, F) [N].
        finger: pose of each in the limb's axes, (N, F, 4, 4).
        grip_energy: energy that the skin holds of what the fingers gave it, less what their friction took [J], (N,).
        touch_s: time that contact took in each step on this machine [s], (N,).
        step_s: time that the whole step took [s], (N,).
        cpu_s: processor time of the whole step [s], (N,): what a core of its own would have taken.
        phases: phases.
        notes: what the scene had to say of the robot, one sentence each.
    """

    time: np.ndarray
    force: np.ndarray
    asked: np.ndarray
    depth: np.ndarray
    wrench: np.ndarray
    tool: np.ndarray
    limb: np.ndarray
    qpos: np.ndarray
    energy: np.ndarray
    off: np.ndarray
    trusted: np.ndarray
    fingers: np.ndarray
    squeeze: np.ndarray
    finger: np.ndarray
    grip_energy: np.ndarray
    touch_s: np.ndarray
    step_s: np.ndarray
    cpu_s: np.ndarray
    phases: tuple[Phase, ...]
    notes: tuple[str, ...] = ()

    @property
    def real_time_factor(self) -> float:
        """Simulated time over the time that it took on this machine, as busy as it was."""
        return float((self.time[-1] + self.time[1]) / self.step_s.sum())

    @property
    def own_core_factor(self) -> float:
        """Simulated time over the processor time that it took: the real-time factor on a core of its own."""
        return float((self.time[-1] + self.time[1]) / self.cpu_s.sum())

    def during(self, phase: Phase) -> np.ndarray:
        """Which rows are judged of a phase, (N,): all of a circle, of others those from SETTLE_S after their start."""
        late = 0.0 if phase.name == "circle" else min(SETTLE_S, 0.5 * phase.duration)
        return (self.time >= phase.start + late) & (self.time < phase.start + phase.duration)

    def save(self, path: Path) -> Path:
        """Writes all rows as .npz."""
        rows = {name: value for name, value in vars(self).items() if name not in ("phases", "notes")}
        phases = np.array([(p.name, p.start, p.duration, p.force) for p in self.phases],
                          dtype=[("name", "U16"), ("start", float), ("duration", float), ("force", float)])  # fmt: skip
        np.savez_compressed(path, **rows, phases=phases, notes=np.array(self.notes, dtype=str))
        return path

    @classmethod
    def load(cls, path: Path) -> Log:
        """What `save` wrote."""
        with np.load(path) as kept:
            rows = {name: kept[name] for name in kept.files if name not in ("phases", "notes")}
            phases = tuple(Phase(str(name), *map(float, numbers)) for name, *numbers in kept["phases"].tolist())
            notes = tuple(map(str, kept["notes"])) if "notes" in kept else ()
        return cls(**rows, phases=phases, notes=notes)


class Massage:
    """A robot that follows a course on a skin.

    Args:
        scene: scene.
        course: course.
        gains: gains of the controller.
        skin: Skin or Simulator of the scene's layer that is ready; made with MomentNet() unless given.
        damping: see SoftContact.
        implicit: see SoftContact.
        friction: see SoftContact.
        every: see SoftContact.

    Attributes:
        log: what the last run did, also where it was stopped before its end; None before two steps.

    Raises:
        InvalidInput: a force that the arm's motors do not press with.
    """

    def __init__(self, scene: Scene, course: Course, *, gains: Gains | None = None, skin: Any = None,
                 damping: float = 0.0, implicit: bool = False,
                 friction: Friction | Mapping[str, Friction] = None, every: int = 1) -> None:  # fmt: skip
        self.scene, self.course = scene, course
        most, weakest = strength(scene.model, scene.joints, scene.qpos, BALL)
        if max(course.forces) > most:
            limit = f"is at its limit from {most:.3g} N on" if most > 0 else "does not even hold the arm"
            raise InvalidInput(f"the arm cannot press with {max(course.forces):g} N: at the start the motor of "
                               f"'{weakest}' {limit}. Ask for less, or put the limb elsewhere (--at).")  # fmt: skip
        self.fingers = tuple(name for name in scene.tools if name in FINGERS)
        if self.fingers and not hasattr(skin, "history"):  # a Simulator has its own
            friction = with_fingers(friction, BALL)
        self.skin = SoftBody(scene.model, skin or scene.layer, body=LIMB, tools=scene.tools, damping=damping,
                             implicit=implicit, friction=friction, every=every)  # fmt: skip
        self.gripper = Gripper(scene.model, course.grip) if self.fingers else None
        self.data = mujoco.MjData(scene.model)
        self.controller = ForceImpedance(scene.model, scene.joints, BALL, scene.qpos, gains)
        self.log: Log | None = None
        self.reset()

    def reset(self) -> None:
        """Back to the start."""
        self.skin.reset(self.data)
        self._stiffness, self._looked = np.zeros((3, 3)), -np.inf
        mujoco.mj_resetData(self.scene.model, self.data)
        self.data.qpos[:] = self.scene.qpos
        self.controller.reset()
        mujoco.mj_forward(self.scene.model, self.data)

    def warm_up(self, ahead: CompiledAhead | None = None) -> None:
        """Goes back to the start after steps with all tools in the skin: then nothing is left to compile.

        Args:
            ahead: who compiles a part of it beside.
        """
        skin, data = self.skin, self.data
        poses, normal = skin.poses(data), self.limb_pose()[:3, :3] @ self.scene.site.normal
        inwards = {BALL: -(START_M + 1e-3) * normal}
        inwards |= {name: (GAP + 1e-3) * data.joint(name).xaxis for name in self.fingers}
        pressed = {name: pose.copy() for name, pose in poses.tools.items()}
        for name, way in inwards.items():
            pressed[name][:3, 3] += way
        memory = Memory()
        if ahead:
            ahead.touch(skin.simulator)
            ahead.wait()
        for _ in range(2):
            reaction = skin.contact.step(Poses(poses.body, pressed), memory, self.scene.model.opt.timestep)
            memory = reaction.memory
        local_contacts(skin.simulator.history, list(reaction.touches.values()), memory.tissue)
        self.step(lambda limb: self.course.goal(0.0, limb, self.scene.radius))
        self.reset()

    def step(self, goal: Callable[[np.ndarray], Goal]) -> tuple[Goal, float]:
        """One step: contact, controller, physics.

        Args:
            goal: function that says what to do, by the pose of the limb, (4, 4).

        Returns:
            The goal, and the time that contact took [s].
        """
        model, data = self.scene.model, self.data
        mujoco.mj_step1(model, data)
        begun = time.perf_counter()
        self.skin.apply(data)
        took = time.perf_counter() - begun
        assert self.skin.reaction is not None
        aim, wrench = goal(self.limb_pose()), self.skin.reaction.tools[BALL]
        if aim.force is not None and aim.closed:
            self._look(wrench)
        stiffness = float(aim.normal @ self._stiffness @ aim.normal)
        self.controller.command(data, aim, wrench, stiffness, model.opt.timestep)
        mujoco.mj_step2(model, data)
        return aim, took

    def _look(self, wrench: Wrench) -> None:
        """Keeps the contact's stiffness as it is now."""
        if not wrench.any():
            self._stiffness, self._looked = np.zeros((3, 3)), -np.inf
        elif self.data.time - self._looked >= STIFFNESS_S:
            self._stiffness, self._looked = self.skin.stiffness(self.data, BALL), self.data.time

    def limb_pose(self) -> np.ndarray:
        """Pose of the limb in the world, (4, 4)."""
        return self.skin.pose(self.data)

    def run(self, seen: Sequence[Callable[[Massage, float], None]] = ()) -> Log:
        """Follows the course from the start.

        Args:
            seen: functions that are called after each step with this and the time [s]; their time is not counted.

        Raises:
            InvalidInput: a simulation that diverged.
        """
        self.reset()
        self.log = None
        radius, dt = self.scene.radius, float(self.scene.model.opt.timestep)
        rows: list[tuple[Any, ...]] = []
        left = ""  # why the first touch that was out of range was
        book, books = EnergyBook(), [EnergyBook() for _ in self.fingers]
        try:
            for k in range(round(self.course.duration / dt)):
                at, begun, busy = k * dt, time.perf_counter(), time.thread_time()
                if self.gripper:
                    phase = self.course.phase(at)
                    self.gripper.command(self.data, phase.name, (at - phase.start) / phase.duration)
                aim, took = self.step(lambda limb, at=at: self.course.goal(at, limb, radius))
                if any(self.data.warning[kind].number for kind in DIVERGED):
                    raise InvalidInput(f"the simulation diverged at {at:.3f} s. Try a higher rate; if that does not "
                                       "help, check the masses of the robot's links."
                                       + "".join(f" To note: {note}." for note in self.scene.notes))  # fmt: skip
                spent, busy = time.perf_counter() - begun, time.thread_time() - busy
                reaction = self.skin.reaction
                assert reaction is not None
                touch, wrench = reaction.touches[BALL], reaction.tools[BALL]
                limb, held = self.limb_pose(), reaction.memory.at
                energy = book.add(held[BALL], _in_layer(wrench, limb))
                worked = [one.add(held[name], _in_layer(reaction.tools[name], limb))
                          for name, one in zip(self.fingers, books, strict=True)]  # fmt: skip
                off = self.data.geom(BALL).xpos - aim.point
                along = off - (off @ aim.normal) * aim.normal
                rows.append((at, wrench[:3] @ aim.normal, np.nan if aim.force is None else aim.force,
                             touch.depth if touch.presses else np.nan, wrench, self.skin.poses(self.data).tools[BALL],
                             limb, self.data.qpos.copy(), energy, np.linalg.norm(along),
                             touch.trust.in_range is not False,
                             np.array([reaction.tools[name] for name in self.fingers]).reshape(-1, 6),
                             np.array([reaction.touches[name].force for name in self.fingers]),
                             np.array([held[name] for name in self.fingers]).reshape(-1, 4, 4), sum(worked),
                             took, spent, busy))  # fmt: skip
                if not left and touch.trust.in_range is False:
                    left = f"{touch.name} was out of range from {at:.2f} s on, first as {touch.trust.why}"
                for see in seen:
                    see(self, at)
        finally:
            if len(rows) > 1:
                log = Log(*(np.array(column) for column in zip(*rows, strict=True)), phases=self.course.phases)
                stuck = stuck_joints(self.scene.model, self.scene.joints, log.qpos)
                self.log = replace(log, notes=(*self.scene.notes, *stuck, *([left] if left else [])))
        assert self.log is not None
        return self.log


def _in_layer(wrench: np.ndarray, limb: np.ndarray) -> np.ndarray:
    return np.concatenate([wrench[:3] @ limb[:3, :3], wrench[3:] @ limb[:3, :3]])
