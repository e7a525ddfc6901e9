"""ForceImpedance: an arm that follows a course along the skin with a set force into it, by joint torques."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from stmpl_core.arrays import Wrench
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
        self._carried = model.jnt_actgravcomp[list(joints)].astype(float)  # where MuJoCo adds to a motor's torque
        motors = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)
                  if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT}  # fmt: skip
        self._motors = np.array([motors[j] for j in joints])
        self._rest = qpos[self._places].copy()
        self._jacobian, self._rate = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        self._mass, self._felt = np.zeros((model.nv, model.nv)), np.zeros(3)

    def reset(self) -> None:
        """Forgets the force."""
        self._felt[:] = 0.0

    def torques(self, data: Any, goal: Goal, wrench: Wrench, stiffness: float, dt: float) -> np.ndarray:
        """Torques of the arm's motors, (joints,) [N m].

        Args:
            data: MuJoCo data after mj_step1.
            goal: goal of now.
            wrench: wrench on the tool, world axes, (6,) [N, N m].
            stiffness: stiffness of the contact along the normal [N/m], of use with a closed force; 0: nothing presses.
            dt: time since the last call [s].
        """
        model, dofs, x, g = self.model, self._dofs, data.geom_xpos[self._tool], self.gains
        mujoco.mj_jac(model, data, self._jacobian[:3], self._jacobian[3:], x, self._body)
        mujoco.mj_jacDot(model, data, self._rate[:3], self._rate[3:], x, self._body)
        mujoco.mj_fullM(model, data, self._mass)
        known = data.qfrc_bias[dofs] - data.qfrc_passive[dofs] - self._carried * data.qfrc_gravcomp[dofs]
        return _torques(
            self._jacobian, self._rate, self._mass, dofs, data.qvel[dofs], self._rest - data.qpos[self._places],
            known, goal.point - x, data.geom_xmat[self._tool, 2::3].copy(), goal.velocity, goal.acceleration,
            goal.normal, goal.spin, goal.swing,
            np.nan if goal.force is None else float(goal.force), float(goal.growth), float(goal.height), goal.closed,
            wrench, stiffness, dt, (g.along, g.turn, g.ratio, g.into, g.force, g.integral, g.posture),
            self._felt)  # fmt: skip

    def command(self, data: Any, goal: Goal, wrench: Wrench, stiffness: float, dt: float) -> None:
        """Writes the torques into `data.ctrl`."""
        data.ctrl[self._motors] = self.torques(data, goal, wrench, stiffness, dt)


@numba.njit(cache=True)
def _torques(jacobian, rate, mass, dofs, dq, away, known, off, axis, velocity, acceleration, n, spin, swing, force,
             growth, height, closed, wrench, stiffness, dt, gains, felt):  # fmt: skip
    """See ForceImpedance; numpy's own calls take six times as long.

    Args:
        jacobian, rate, mass: of all of the model's motions, (6, nv), (6, nv), (nv, nv).
        dofs: those of the arm, (joints,).
        dq, away, known: its rates, how far it is from its posture, and torques of gravity, Coriolis and damping.
        off, axis: from the tool to the goal's point, and the tool's axis, (3,).
        velocity, acceleration, n, spin, swing, force, growth, height, closed: see Goal; force: NaN for none.
        wrench, stiffness, dt: see ForceImpedance.torques.
        gains: see Gains, in that order.
        felt: integral of the force's error [N], force that was felt [N] and its rate [N/s]; written to.
    """
    many = len(dofs)
    moves, turns, bend, weight = np.empty((3, many)), np.empty((3, many)), np.zeros(6), np.empty((many, many))
    for j in range(many):
        for i in range(3):
            moves[i, j], turns[i, j] = jacobian[i, dofs[j]], jacobian[3 + i, dofs[j]]
        for i in range(6):
            bend[i] += rate[i, dofs[j]] * dq[j]
        for i in range(many):
            weight[i, j] = mass[dofs[i], dofs[j]]
    along, turn, ratio, into, quickest, integral, posture = gains
    mobility = np.linalg.inv(weight)
    inertia = np.linalg.inv(moves @ mobility @ moves.T + 1e-6 * np.eye(3))

    # Motion: along the skin and of the tool's axis; without a force over the skin, too.
    over = -(off @ n) * n  # the tool's origin goes round with the normal
    lag = velocity + _cross(spin, over) - moves @ dq
    ahead = acceleration + _cross(swing, over) + _cross(spin, _cross(spin, over))
    asked = ahead + 2 * ratio * along * lag + along**2 * off
    turned = swing + 2 * ratio * turn * (spin - turns @ dq) + turn**2 * _cross(axis, -n) - bend[3:]
    against, lift = wrench[:3].copy(), ahead @ n  # against: what is taken back of what the skin pushes
    feels = against @ n
    if np.isnan(force):
        lift += 2 * ratio * along * (lag @ n) + along**2 * (height + off @ n)
        felt[:] = 0.0
    elif closed and stiffness > 0:  # acceleration into the skin that a force's error asks for
        error = force - feels
        felt[2] += min(1.0, dt / FILTER_S) * ((feels - felt[1]) / dt - felt[2])
        felt[0] += integral * error * dt
        felt[1] = feels
        k = stiffness * max(1.0, force / max(feels, 1e-3)) ** STEEPER  # where it is going
        w = max(quickest, np.sqrt(k / (n @ (inertia @ n))))
        pushed = (w**2 * (error + felt[0]) + 2 * ratio * w * (growth - felt[2])) / k
        lift -= min(max(pushed, -MOST), MOST)
    else:
        felt[1], felt[2] = feels, 0.0
        against += (force - into * (lag @ n) - feels) * n
    asked += (lift - asked @ n) * n - bend[:3]

    torques = moves.T @ (inertia @ asked)
    free = np.eye(many) - mobility @ moves.T @ inertia @ moves
    for rows in (_square_to(axis) @ turns, axis.reshape(1, 3) @ turns):  # pointing, then spin
        wanted = (_square_to(axis) if len(rows) == 2 else axis.reshape(1, 3)) @ turned
        left = rows @ free
        heft = _inverse(left @ mobility @ left.T, np.trace(rows @ mobility @ rows.T))
        torques += left.T @ (heft @ (wanted - rows @ (mobility @ torques)))
        free -= mobility @ left.T @ heft @ left
    kept = weight @ (posture**2 * away - 2 * posture * dq)
    return torques - moves.T @ against + free.T @ kept + known


@numba.njit(cache=True)
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@numba.njit(cache=True)
def _square_to(axis):
    """Two unit vectors square to an axis and to each other, (2, 3)."""
    least, out = np.zeros(3), np.empty((2, 3))
    least[np.argmin(np.abs(axis))] = 1.0
    one = _cross(axis, least)
    out[0] = one / np.sqrt(one @ one)
    out[1] = _cross(axis, out[0])
    return out


@numba.njit(cache=True)
def _inverse(mobility, whole):
    """Inertia of a mobility (n, n) of which something else took its share; none where next to nothing is left.

    Args:
        mobility: mobility that is left.
        whole: trace of what it was before.
    """
    values, axes = np.linalg.eigh(mobility)
    return (axes * (values / (values**2 + (LEAST * whole) ** 2 + 1e-12))) @ axes.T
