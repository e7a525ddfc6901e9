"""ForceImpedance: an arm that follows a course along the skin with a set force into it, by joint torques."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stmpl_core.arrays import Wrench, cross
from stmpl_sim.engine import mujoco

FILTER_S = 3e-3  # time constant of the force's rate [s]


@dataclass(frozen=True)
class Gains:
    """Gains of a ForceImpedance.

    Args:
        along: natural frequency of the motion along the skin, and over it before it is touched [rad/s].
        turn: natural frequency of turning the tool [rad/s].
        ratio: damping ratio of both [-].
        into: damping of the motion into the skin before it is touched [N s/m]: a set force moves the tool through air
            at force / into.
        rate: gain on the force's rate [s], which damps once it is touched: against the skin, wherever that goes.
        proportional: gain on the force's error [-].
        integral: gain on its integral [1/s].
        posture: natural frequency of the arm's other motion, back to where it began [rad/s].
    """

    along: float = 30.0
    turn: float = 30.0
    ratio: float = 0.9
    into: float = 400.0
    rate: float = 0.1
    proportional: float = 4.0
    integral: float = 30.0
    posture: float = 3.0


@dataclass(frozen=True, eq=False)
class Goal:
    """What the tool is to do now, world axes.

    Args:
        point: point on the skin that the tool stands over, (3,) [m].
        velocity: velocity of that point along its course, (3,) [m/s].
        acceleration: acceleration of that point, (3,) [m/s2].
        normal: outward unit normal there, (3,) [-].
        spin: angular velocity of the normal, (3,) [rad/s].
        swing: angular acceleration of the normal, (3,) [rad/s2].
        force: force into the skin [N]; None: the tool holds `height` instead.
        height: height of the tool's origin over the point along the normal [m], used without a force.
        closed: feedback of the force's error; without it the force is a push in the open, damped by Gains.into.
    """

    point: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    normal: np.ndarray
    spin: np.ndarray
    swing: np.ndarray
    force: float | None
    height: float = 0.0
    closed: bool = True


class ForceImpedance:
    """Motion along the skin, force into it, in operational space (Khatib 1987):

        (f, m) = M ((x''_d + 2 z w e' + w^2 e) without its part along n, turning likewise, - J' q') + (f_n, 0)
        f_n    = -n (F_d + kp (F_d - F) + ki int (F_d - F) dt - kr F') - (what the skin pushes along itself)
        tau    = J^T (f, m) + gravity, Coriolis and damping of the joints + N^T posture

    with the outward normal n, the course x_d (over its point on the skin, as high as the tool is), e = x_d - x, the
    arm's inertia M at the tool, and its dynamically consistent null space N. Turning takes the tool's z axis to -n. F
    is the force along n that a sensor behind the tool feels. Along n the course's acceleration is fed forward only.

    Args:
        model: MuJoCo model.
        joints: numbers of the arm's joints, each with a torque motor.
        tool: name of the geom that is the tool.
        qpos: posture to stay near, (nq,).
        gains: gains.
    """

    def __init__(
        self, model: Any, joints: tuple[int, ...], tool: str, qpos: np.ndarray, gains: Gains | None = None
    ) -> None:
        self.model, self.gains = model, gains or Gains()
        self._tool = model.geom(tool).id
        self._body = int(model.geom_bodyid[self._tool])
        self._dofs = np.array([model.jnt_dofadr[j] for j in joints])
        self._places = np.array([model.jnt_qposadr[j] for j in joints])
        motors = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)
                  if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT}  # fmt: skip
        self._motors = np.array([motors[j] for j in joints])
        self._rest = qpos[self._places].copy()
        self._jacobian, self._rate = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        self._mass = np.zeros((model.nv, model.nv))
        self.reset()

    def reset(self) -> None:
        """Forgets the force."""
        self.integral = self.felt = self.rate = 0.0

    def torques(self, data: Any, goal: Goal, wrench: Wrench, dt: float) -> np.ndarray:
        """Torques of the arm's motors, (joints,) [N m].

        Args:
            data: MuJoCo data after mj_step1.
            goal: goal of now.
            wrench: wrench on the tool, world axes, (6,) [N, N m].
            dt: time since the last call [s].
        """
        model, g, n = self.model, self.gains, goal.normal
        x = data.geom_xpos[self._tool]
        mujoco.mj_jac(model, data, self._jacobian[:3], self._jacobian[3:], x, self._body)
        mujoco.mj_jacDot(model, data, self._rate[:3], self._rate[3:], x, self._body)
        mujoco.mj_fullM(model, data, self._mass)
        jacobian, mass = self._jacobian[:, self._dofs], self._mass[np.ix_(self._dofs, self._dofs)]
        dq = data.qvel[self._dofs]
        solved = np.linalg.solve(mass, jacobian.T)
        inertia = np.linalg.inv(jacobian @ solved + 1e-6 * np.eye(6))

        # Motion: along the skin and of the tool's axis; without a force over the skin, too.
        velocity = jacobian @ dq
        off = goal.point - x
        over = -(off @ n) * n  # the tool's origin goes round with the normal
        lag = goal.velocity + cross(goal.spin, over) - velocity[:3]
        ahead = goal.acceleration + cross(goal.swing, over) + cross(goal.spin, cross(goal.spin, over))
        axis = data.geom_xmat[self._tool].reshape(3, 3)[:, 2]
        asked = np.concatenate([
            ahead + 2 * g.ratio * g.along * lag + g.along**2 * off,
            goal.swing + 2 * g.ratio * g.turn * (goal.spin - velocity[3:]) + g.turn**2 * cross(axis, -n),
        ])  # fmt: skip
        lift = ahead @ n
        if goal.force is None:
            lift += 2 * g.ratio * g.along * (lag @ n) + g.along**2 * (goal.height + off @ n)
        asked[:3] += (lift - asked[:3] @ n) * n
        push = inertia @ (asked - self._rate[:, self._dofs] @ dq)

        # Force: what is asked for, its error, and what the skin pushes along itself taken back.
        felt = float(wrench[:3] @ n)
        push[:3] -= wrench[:3] - felt * n
        if goal.force is None:
            self.reset()
            push[:3] -= felt * n
        else:
            error, pressing = goal.force - felt, goal.closed and bool(wrench[:3].any())
            self.integral += g.integral * error * dt * pressing
            push[:3] -= n * goal.force
            if pressing:
                self.rate += min(1.0, dt / FILTER_S) * ((felt - self.felt) / dt - self.rate)
                push[:3] += n * (g.rate * self.rate - g.proportional * error - self.integral)
            else:
                self.rate = 0.0
                push[:3] += n * g.into * (lag @ n)
            self.felt = felt

        posture = mass @ (g.posture**2 * (self._rest - data.qpos[self._places]) - 2 * g.posture * dq)
        posture -= jacobian.T @ (inertia @ (solved.T @ posture))
        known = data.qfrc_bias[self._dofs] - data.qfrc_passive[self._dofs]
        return jacobian.T @ push + known + posture

    def command(self, data: Any, goal: Goal, wrench: Wrench, dt: float) -> None:
        """Writes the torques into `data.ctrl`."""
        data.ctrl[self._motors] = self.torques(data, goal, wrench, dt)
