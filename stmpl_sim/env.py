"""MassageEnv: a gymnasium environment: keep a force on a person who breathes and sways. And what solves it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from stmpl_core.arrays import check_choice, check_number, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed
from stmpl_core.friction import Friction
from stmpl_core.layer import SoftLayer
from stmpl_core.simulator import Simulator
from stmpl_sim.controller import Goal
from stmpl_sim.engine import mujoco
from stmpl_sim.massage import Course, Massage
from stmpl_sim.protocol import Memory
from stmpl_sim.scene import BALL, build
from stmpl_sim.site import Site

needed("MassageEnv", "sim", "gymnasium")
import gymnasium  # noqa: E402

FORCE, SPEED = 10.0, 0.05  # asked of the massage [N], [m/s]
BREATH_M, BREATH_HZ = 4e-3, 0.25  # amplitude and rate at which the body rises and falls
SWAY_M, SWAY_HZ = 3e-3, (0.11, 0.07)  # amplitude and rates at which it sways across its length and along
TURN_RAD, TURN_HZ, PIVOT_M = np.radians(1.5), 0.09, 0.1  # the same of its turn about an axis along it, so deep
CONTROL_S = 0.02  # time between two actions [s]
PUSH_LIMIT, SHIFT_LIMIT = 20.0, 10e-3  # what the largest action adds: force [N], places beside the course [m]
MOST = 100.0  # largest size of an observation
HARD = 40.0  # force at which an episode ends, as too hard [N]
FORCE_SCALE, OFF_SCALE = 2.0, 5e-3  # errors at which a reward falls to 1 / e [N], [m]


class MassageEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A robot massages the back of a person who moves: 10 N along a circle at 50 mm/s.

    The person breathes (8 mm up and down, 15 times a minute), sways by 3 mm and turns by 1.5 degrees, slowly.

    Action, (3,) in -1..1: push into the skin, 0..20 N over the range, and places beside the course along the skin,
    up to 10 mm. The push acts in the open: what the arm feels is not fed back for you. Underneath, the arm follows the
    course over the body's mean place and keeps upright to the skin.
    Observation, (8,): force felt [10 N], its rate [100 N/s], where the ball is beside the course on the body as it is
    now [10 mm] (2), height over the mean skin [10 mm] and its rate [50 mm/s], sine and cosine of the course's angle;
    each within -100..100.
    Reward, 0..1 a step: exp(-(force error / 2 N)^2) exp(-(off course / 5 mm)^2).
    An episode ends after its laps; it ends at once, with -10, at 40 N.
    Processes of environments must be started afresh (`vector_kwargs={"context": "spawn"}`), not forked.

    Args:
        layer: skin, or a Simulator that is ready; the back as measured unless given. Any part does:
            living(Body.anny(), "left_forearm").
        circle: radius of the course [m].
        laps: laps of an episode.
        moving: choice that the person sways and turns; without it they breathe alone.
        friction: coefficient of friction between ball and skin, or a name of it; None: none.
        relaxing: choice that the skin's stress fades.
        robot, end, at: robot's file, what of it carries the ball, and place of the limb, as stmpl_sim.scene.build has
            them; the arm that ships unless given.
        timestep: timestep of physics [s].
        render_mode: kind of frames: rgb_array, or none.

    Raises:
        InvalidInput: another render_mode; friction or relaxing beside a Simulator, which has its own; a timestep of
            which no whole number makes 20 ms; a circle or laps that are none; an action that is not finite.
        gymnasium.error.ResetNeeded: a step before the first `reset`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_S)}  # noqa: RUF012

    def __init__(
        self,
        layer: SoftLayer | Simulator | None = None,
        *,
        circle: float = 0.012,
        laps: float = 2.0,
        moving: bool = True,
        friction: Friction = None,
        relaxing: bool = False,
        robot: str | Path | None = None,
        end: str | None = None,
        at: tuple[float, float, float] = (0.5, 0.0, 0.25),
        timestep: float = 2e-3,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InvalidInput(f"render_mode is {render_mode}; allowed is rgb_array or none.")
        self.render_mode = render_mode
        for name, value in {"timestep": timestep, "circle": circle, "laps": laps}.items():
            check_number(name, value)
        for name, value in {"moving": moving, "relaxing": relaxing}.items():
            check_choice(name, value)
        steps = CONTROL_S / timestep if timestep > 0 else 0.0
        if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
            raise InvalidInput(f"timestep is {timestep:g} s; {CONTROL_S:g} s, for which an action is held, must be a "
                               "whole number of steps.")  # fmt: skip
        if not (circle > 0 and laps > 0):
            raise InvalidInput(f"circle is {circle:g} m and laps {laps:g}; both must be above 0.")
        if isinstance(layer, Simulator):
            if friction is not None or relaxing:
                raise InvalidInput("a Simulator has its own friction and relaxation: give a layer, or neither.")
            ready, layer = layer, layer.layer
        else:
            if layer is not None and not isinstance(layer, SoftLayer):
                raise InvalidInput(f"layer is {layer!r:.40}; a SoftLayer or a Simulator is needed. Try "
                                   "living(Body.anny(), 'left_forearm').")  # fmt: skip
            ready, layer = None, _skin(layer, relaxing)
        site = Site.thickest(layer)
        self._scene = build(layer, site, robot=robot, end=end, at=at, mount="animated", timestep=timestep)
        self.course = Course(site.circle(circle), (FORCE,), SPEED, laps)
        self.massage = Massage(self._scene, self.course, skin=ready, friction=friction)
        self._rest, self._moving = self.massage.limb_pose(), moving
        self._steps = round(steps)
        self._camera: Any = None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-MOST, MOST, (8,), np.float32)
        self._phases, self._time, self._begun = np.zeros(4), 0.0, False
        self._press = self.course.phases[2].start
        self._start: tuple[np.ndarray, np.ndarray, Memory] | None = None
        self._last = np.zeros(2)
        self._goal = self.course.goal(0.0, self._rest, self._scene.radius)

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InvalidInput("a MassageEnv is neither copied nor pickled. Make another one, which may share the skin, "
                           "MassageEnv(env.massage.skin.simulator, ...), and take it there by reset(seed=...) and the "
                           "same actions.")  # fmt: skip

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A new episode: the ball presses with 10 N, and the person begins to move somewhere in a breath."""
        super().reset(seed=seed)
        self._phases = self.np_random.uniform(0, 2 * np.pi, 4)
        if self._start is None:
            self._start = self._pressed()
        run = self.massage
        run.reset()
        self._time, self._begun = self._press, True
        self._move()
        run.data.qpos[:], run.data.qvel[:], run.skin.memory = self._start
        run.skin.apply(run.data)
        self._goal = self.course.goal(self._time, self._rest, self._scene.radius)
        self._last = self._felt()
        return self._observed(), {}

    def _pressed(self) -> tuple[np.ndarray, np.ndarray, Memory]:
        """Configuration, velocity and the skin's memory after reaching and pressing, before it breathes."""
        self.massage.reset()
        self._time, self._begun = 0.0, False
        while self._time < self._press:
            self._advance(FORCE if self._time > self.course.phases[1].start else None, np.zeros(2))
        return self.massage.data.qpos.copy(), self.massage.data.qvel.copy(), self.massage.skin.memory

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One action, held for 20 ms."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset() before step().")
        action = np.clip(finite("action", action, (3,)), -1, 1)
        self._last = self._felt()
        for _ in range(self._steps):
            self._advance(PUSH_LIMIT * 0.5 * (1 + float(action[0])), SHIFT_LIMIT * action[1:])
        force, off = self._felt()[0], float(np.linalg.norm(self._beside()))
        reward = float(np.exp(-(((force - FORCE) / FORCE_SCALE) ** 2) - (off / OFF_SCALE) ** 2))
        hard = force > HARD
        done = self._time >= self.course.phases[-1].start
        info = {"force_N": force, "off_course_m": off, "in_range": self._in_range()}
        return self._observed(), -10.0 if hard else reward, bool(hard), bool(done), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A frame, (480, 640, 3) uint8."""
        if self.render_mode is None:
            return None
        from stmpl_sim.film import Camera, Shot, caption_of

        if self._camera is None:
            layer = self._scene.layer
            self._camera = Camera(self._scene.model, layer, 0.5 * float(layer.thickness.max()))
        skin, data = self.massage.skin, self.massage.data
        answer = skin.answer()
        self._camera.take(Shot(data, skin.skin_points(data, answer), self.massage.limb_pose(), answer.magnitude,
                               answer.pressure, caption_of(self._time, answer.touches)))  # fmt: skip
        return self._camera.frames.pop()

    def close(self) -> None:
        """Gives the renderer back."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _advance(self, push: float | None, shift: np.ndarray) -> None:
        """One step of physics, with a push in the open [N]; None holds the ball over the skin."""
        run = self.massage
        self._move()

        def goal(_limb: np.ndarray) -> Goal:
            aim = self.course.goal(self._time, self._rest, self._scene.radius)
            across = np.cross(self._axes()[1], aim.normal)
            beside = shift[0] * across + shift[1] * self._axes()[1]
            return Goal(aim.point + beside, aim.velocity, aim.acceleration, aim.normal, aim.spin, aim.swing, push,
                        height=aim.height, closed=False)  # fmt: skip

        self._goal, _ = run.step(goal)
        self._time += float(self._scene.model.opt.timestep)

    def _move(self) -> None:
        """Puts the person where they are now; they begin to move over the first second."""
        site, data, size = self.course.circle.site, self.massage.data, min(1.0, self._time - self._press) * self._begun
        rates = np.array([BREATH_HZ, *SWAY_HZ, TURN_HZ])
        breath, across, along, turn = size * np.sin(self._phases + 2 * np.pi * rates * self._time) * [
            BREATH_M, *((SWAY_M, SWAY_M, TURN_RAD) if self._moving else (0, 0, 0))]  # fmt: skip
        axes = self._rest[:3, :3] @ np.stack([np.cross(site.along, site.normal), site.along, site.normal], axis=1)
        pivot = self._rest[:3, 3] + self._rest[:3, :3] @ (site.point - PIVOT_M * site.normal)
        by, rest = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(by, axes[:, 1], turn)
        mujoco.mju_mat2Quat(rest, self._rest[:3, :3].ravel())
        mujoco.mju_mulQuat(data.mocap_quat[0], by, rest)
        mujoco.mju_rotVecQuat(data.mocap_pos[0], self._rest[:3, 3] - pivot, by)
        data.mocap_pos[0] += pivot + across * axes[:, 0] + along * axes[:, 1] + [0, 0, breath]

    def _axes(self) -> np.ndarray:
        """Axes of the site in the world: across and along the limb."""
        site = self.course.circle.site
        turn = self.massage.limb_pose()[:3, :3]
        return np.stack([turn @ np.cross(site.along, site.normal), turn @ site.along])

    def _felt(self) -> np.ndarray:
        """Force [N] and height over the mean skin [m]."""
        reaction = self.massage.skin.reaction
        assert reaction is not None
        n = self._goal.normal
        height = (self.massage.data.geom(BALL).xpos - self._goal.point) @ n - self._scene.radius
        return np.array([reaction.tools[BALL][:3] @ n, height])

    def _beside(self) -> np.ndarray:
        """Place of the ball beside the course on the body, along the skin, (2,) [m]."""
        here = self.course.goal(self._time, self.massage.limb_pose(), self._scene.radius)
        off = self.massage.data.geom(BALL).xpos - here.point
        return self._axes() @ (off - (off @ here.normal) * here.normal)

    def _in_range(self) -> bool:
        reaction = self.massage.skin.reaction
        return reaction is not None and reaction.touches[BALL].trust.in_range is not False

    def _observed(self) -> np.ndarray:
        force, height = self._felt()
        rate = (self._felt() - self._last) / CONTROL_S
        angle = self.course.angle(self._time)[0]
        values = [force / FORCE, rate[0] / 100, *(self._beside() / SHIFT_LIMIT), height / 0.01, rate[1] / 0.05,
                  np.sin(angle), np.cos(angle)]  # fmt: skip
        return np.clip(values, -MOST, MOST).astype(np.float32)


class Scripted:
    """What solves MassageEnv: proportional and integral control of the force, and of the place beside the course.

    Args:
        proportional: gain on the force's error [-].
        integral: gain on its integral [1/s].
        along: gain on the integral of the place beside the course [1/s].

    Raises:
        InvalidInput: a gain that is not a finite number.
    """

    def __init__(self, proportional: float = 0.5, integral: float = 6.0, along: float = 4.0) -> None:
        for name, value in {"proportional": proportional, "integral": integral, "along": along}.items():
            check_number(name, value)
        self.proportional, self.integral, self.along = proportional, integral, along
        self.reset()

    def reset(self) -> None:
        """Forgets what was: an episode begins."""
        self.sum, self.beside = 0.0, np.zeros(2)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action after an observation."""
        error = FORCE * (1 - float(observation[0]))
        self.sum = float(np.clip(self.sum + self.integral * error * CONTROL_S, -FORCE, FORCE))
        self.beside = np.clip(self.beside - self.along * CONTROL_S * observation[2:4], -1, 1)
        push = FORCE + self.proportional * error + self.sum
        return np.clip([2 * push / PUSH_LIMIT - 1, *(self.beside - 0.5 * observation[2:4])], -1, 1).astype(np.float32)


def _skin(layer: SoftLayer | None, relaxing: bool) -> SoftLayer:
    """The skin of an environment; the back unless given."""
    from stmpl_core.living import held_skin

    if layer is None:
        from stmpl_core.body import Body
        from stmpl_core.living import living

        layer = living(Body.anny(), "back")
    return held_skin(layer) if relaxing else layer


def register() -> None:
    """Makes gymnasium.make("stmpl/Massage-v0") known."""
    gymnasium.register("stmpl/Massage-v0", entry_point="stmpl_sim.env:MassageEnv")

