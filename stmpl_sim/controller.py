"""ForceImpedance: an arm that follows a course along the skin with a set force into it, by joint torques."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stmpl_core.arrays import Wrench, cross
from stmpl_sim.engine import mujoco

FILTER_S = 3e-3  # time constant of the force's rate [s]
STEEPER = 0.4  # power of the force with which a contact's stiffness grows: of round tools on skin 0.33 to 0.5
LEAST = 1e-3  # mobility of a turn that is left by what goes before, over its own, below which it is given up [-]
MOST = 20.0  # acceleration that an error of the force may ask for [m/s2]: at first touch there is next to no stiffness


@dataclass(frozen=True)
class Gains:
    """Gains of a ForceImpedance.

    Args:
        along: natural frequency of the motion along the skin, and over it before it is touched [rad/s].
        turn: natural frequency of turning the tool [rad/s].
        ratio: damping ratio of all [-].
        into: damping of the motion into the skin before it is touched [N s/m]: a set force moves the tool through air
            at force / into.
        force: natural frequency of the force's error [rad/s], once it is touched: on soft and on stiff skin, of a
            light and of a heavy arm.
        integral: rate at which what is left of that error is taken away [1/s].
        posture: natural frequency of the arm's other motion, back to where it began [rad/s].
    """

    along: float = 30.0
    turn: float = 30.0
    ratio: float = 0.9
    into: float = 400.0
    force: float = 80.0
    integral: float = 6.0
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
        growth: rate of that force [N/s].
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
    growth: float = 0.0
    height: float = 0.0
    closed: bool = True


class ForceImpedance:
    """Motion along the skin, force into it, in operational space (Khatib 1987), the place before the pointing:

        tau = J^T (L (a - J' q') - F) + pointing, spin, posture + gravity, Coriolis and damping of the joints
        a   = (x''_d + 2 z w e' + w^2 e) without its part along n, + a_n
        a_n = n (n . x''_d - (w_f^2 (E + r int E dt) + 2 z w_f E') / k),    E = F_d - F_n

    with the outward normal n, the course x_d (over its point on the skin, as high as the tool is), e = x_d - x, and the
    arm's inertia L at the tool's origin. Pointing takes the tool's z axis to -n likewise, spin about that axis is
    damped, and posture is kept, each in what those before leave free (dynamically consistent null spaces, Sentis and
    Khatib 2005): an arm of fewer than five axes keeps the place and points as well as it can. F is the force that a
    sensor behind the tool feels, F_n its part along n. As F_n' = -k n . x' on skin of stiffness k,
    E'' + 2 z w_f E' + w_f^2 (E + r int E dt) = 0: the arm's mass and the skin's stiffness leave it as it is. A contact
    that is quicker than w_f by itself, sqrt(k / n L n), is not slowed down. Before it touches, a_n is that of a push
    F_d, damped by Gains.into.

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

    def torques(self, data: Any, goal: Goal, wrench: Wrench, stiffness: float, dt: float) -> np.ndarray:
        """Torques of the arm's motors, (joints,) [N m].

        Args:
            data: MuJoCo data after mj_step1.
            goal: goal of now.
            wrench: wrench on the tool, world axes, (6,) [N, N m].
            stiffness: stiffness of the contact along the normal [N/m], of use with a closed force; 0: nothing presses.
            dt: time since the last call [s].
        """
        model, g, n = self.model, self.gains, goal.normal
        x = data.geom_xpos[self._tool]
        mujoco.mj_jac(model, data, self._jacobian[:3], self._jacobian[3:], x, self._body)
        mujoco.mj_jacDot(model, data, self._rate[:3], self._rate[3:], x, self._body)
        mujoco.mj_fullM(model, data, self._mass)
        mass, dq = self._mass[np.ix_(self._dofs, self._dofs)], data.qvel[self._dofs]
        jacobian, bend = self._jacobian[:, self._dofs], self._rate[:, self._dofs] @ dq
        mobility = np.linalg.inv(mass)
        inertia = np.linalg.inv(jacobian[:3] @ mobility @ jacobian[:3].T + 1e-6 * np.eye(3))

        # Motion: along the skin and of the tool's axis; without a force over the skin, too.
        velocity = jacobian @ dq
        off = goal.point - x
        over = -(off @ n) * n  # the tool's origin goes round with the normal
        lag = goal.velocity + cross(goal.spin, over) - velocity[:3]
        ahead = goal.acceleration + cross(goal.swing, over) + cross(goal.spin, cross(goal.spin, over))
        asked = ahead + 2 * g.ratio * g.along * lag + g.along**2 * off
        axis = data.geom_xmat[self._tool].reshape(3, 3)[:, 2]
        turned = goal.swing + 2 * g.ratio * g.turn * (goal.spin - velocity[3:]) + g.turn**2 * cross(axis, -n) - bend[3:]
        felt, lift = float(wrench[:3] @ n), float(ahead @ n)
        along = wrench[:3] - felt * n
        against = np.zeros(3)  # what is taken back of what the skin pushes
        if goal.force is None:
            lift += 2 * g.ratio * g.along * (lag @ n) + g.along**2 * (goal.height + off @ n)
            self.reset()
            against = wrench[:3]
        elif goal.closed and stiffness > 0:
            lift -= self._pressed(goal.force, goal.growth, felt, stiffness, float(n @ inertia @ n), dt)
            against = wrench[:3]
        else:
            self.felt, self.rate = felt, 0.0
            against = along + n * (goal.force - g.into * (lag @ n))
        asked += (lift - asked @ n) * n - bend[:3]

        torques = jacobian[:3].T @ (inertia @ asked)
        free = np.eye(len(dq)) - mobility @ jacobian[:3].T @ inertia @ jacobian[:3]
        for ways in (_square_to(axis), axis[None]):  # pointing, then spin
            rows = ways @ jacobian[3:]
            left = rows @ free
            heft = _inverse(left @ mobility @ left.T, float(np.trace(rows @ mobility @ rows.T)))
            torques += left.T @ (heft @ (ways @ turned - rows @ mobility @ torques))
            free -= mobility @ left.T @ heft @ left
        posture = mass @ (g.posture**2 * (self._rest - data.qpos[self._places]) - 2 * g.posture * dq)
        known = data.qfrc_bias[self._dofs] - data.qfrc_passive[self._dofs]
        return torques - jacobian[:3].T @ against + free.T @ posture + known

    def _pressed(self, force: float, growth: float, felt: float, stiffness: float, mass: float, dt: float) -> float:
        """Acceleration into the skin that a force's error asks for [m/s2]."""
        g, error = self.gains, force - felt
        self.rate += min(1.0, dt / FILTER_S) * ((felt - self.felt) / dt - self.rate)
        self.integral += g.integral * error * dt
        self.felt = felt
        k = stiffness * max(1.0, force / max(felt, 1e-3)) ** STEEPER  # where it is going
        w = max(g.force, np.sqrt(k / mass))
        asked = (w**2 * (error + self.integral) + 2 * g.ratio * w * (growth - self.rate)) / k
        return float(np.clip(asked, -MOST, MOST))

    def command(self, data: Any, goal: Goal, wrench: Wrench, stiffness: float, dt: float) -> None:
        """Writes the torques into `data.ctrl`."""
        data.ctrl[self._motors] = self.torques(data, goal, wrench, stiffness, dt)


def _square_to(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors square to an axis and to each other, (2, 3)."""
    one = cross(axis, np.eye(3)[np.abs(axis).argmin()])
    one /= np.linalg.norm(one)
    return np.stack([one, cross(axis, one)])


def _inverse(mobility: np.ndarray, whole: float) -> np.ndarray:
    """Inertia of a mobility (n, n) of which something else took its share; none where next to nothing is left.

    Args:
        mobility: mobility that is left.
        whole: trace of what it was before.
    """
    values, axes = np.linalg.eigh(mobility)
    return (axes * (values / (values**2 + (LEAST * whole) ** 2 + 1e-12))) @ axes.T
