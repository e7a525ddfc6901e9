"""DeviceLoop: renders a LocalContact to a hand-held device a thousand times a second, and keeps the loop passive."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from numbers import Real
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import check_count
from stmpl_core.errors import InvalidInput
from stmpl_core.local_contact import FADE, LocalContact

LONGEST_DELAY = 256  # device samples that a force may be under way
JUMP = 2.0  # speed beyond the measured one that a position shows at most [m/s]
STRAYS = 5  # samples that show more, after which they are believed
PAYBACK_S = 4e-3  # time in which the controller takes back the energy that was given out
ENERGY_DEPTH_M = 1e-2  # depth over which a reaction is taken to grow from nothing, for its energy


@dataclass(frozen=True)
class LoopSettings:
    """Settings of a DeviceLoop.

    Args:
        coupling_stiffness: stiffness of the spring between device and proxy, Kc [N/m]; the hand feels none stiffer.
        coupling_damping: damping of the damper beside it, Bc [N s/m].
        controller: permission for the passivity controller to act; the observer always watches.
        most_damping: largest damping that the controller may add [N s/m]; keep it below device mass times rate / 2.
        velocity_noise: speed up to which motion is noise to the controller [m/s]; damping noise makes energy.
        force_limit: largest force sent to the device [N].
        stale_after: age of the newest local model [s] from which its reaction decays.
        decay: time constant of that decay [s].
        blend: time over which a new local model replaces the last [s]; about one period of the node.
        delay_steps: device samples between a command and its force, if known; the observer counts with it.
    """

    coupling_stiffness: float = 1000.0
    coupling_damping: float = 1.0
    controller: bool = True
    most_damping: float = 20.0
    velocity_noise: float = 2e-3
    force_limit: float = 5.0
    stale_after: float = 0.1
    decay: float = 0.05
    blend: float = 8e-3
    delay_steps: int = 0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name not in ("controller", "delay_steps")):
            value, least = getattr(self, name), name in ("coupling_damping", "most_damping", "velocity_noise", "blend")
            number = float(value) if isinstance(value, Real) else math.nan
            if not (math.isfinite(number) and (number > 0 or (least and number == 0))):
                raise InvalidInput(f"{name} is {value}; it must be finite and {'at least' if least else 'above'} 0.")
        check_count("delay_steps", self.delay_steps, 0, LONGEST_DELAY - 1)


class DeviceLoop:
    """Renders the newest local model to a hand-held device that feels forces.

    Virtual coupling (Colgate, Stanley & Brown 1995; Adams & Hannaford 1999): the device at x pulls, through a spring Kc
    and a damper Bc, a proxy p without mass that rests on the local model,

        Kc (x - p) + Bc (v - dp/dt) = F(p),    F(p) = F0 + K (p - p0), never pulling,

    solved for p in closed form (backward Euler); the device feels -F. K is the symmetric part of the model's
    translational stiffness. Rotations of the tool are taken as they were in the newest model: its wrench and
    stiffness hold the tool's attitude of then, and no torque is rendered.

    Friction of the model is a spring along the skin that slips at its cone: T grows by k_t dp, |T| <= limit N, also
    between answers; a new model's T is blended in.

    Passivity observer (Hannaford & Ryu 2002, "Time-domain passivity control of haptic interfaces"), on the
    held force times the way measured since (exact for a held force: Stramigioli et al. 2005), less what coupling and
    contact store (a reference as in Ryu et al. 2005):

        W = -sum f(k-1) . (x(k) - x(k-1)) - V(k),    V = Kc |x - p|^2 / 2 + Fn^2 / (2 kn) + T^2 / (2 k_t).

    W < 0: the loop gives out what nobody put in. The controller then damps with -W / (v^2 T), up to `most_damping`,
    what the velocity has beyond `velocity_noise`; T is 4 ms, not one sample as in the paper, whose forces jump. A
    surplus W above V / 2 is forgotten, so that what was spent earlier does not pay for oscillating later; half of V is
    what a contact that stiffens like depth^3 stores beyond Fn^2 / (2 kn).

    `step` takes constant time, allocates nothing that grows, and takes no lock; `update` may be called from another
    thread, and is one assignment to it.

    Attributes:
        settings: settings of the loop.
        refused: number of samples and of local models so far that could not be used.
    """

    def __init__(self, settings: LoopSettings | None = None) -> None:
        self.settings = settings or LoopSettings()
        self.refused = 0
        s = self.settings
        self._constants = np.array([s.coupling_stiffness, s.coupling_damping, float(s.controller), s.most_damping,
                                    s.velocity_noise, s.force_limit, s.stale_after, s.decay, float(s.delay_steps)])
        self._newest: np.ndarray | None = None
        self._taken: np.ndarray | None = None
        self._state = _State(np.zeros(MODEL), np.zeros(MODEL), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3),
                             np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((LONGEST_DELAY, 3)), np.zeros(SCALARS))
        self._state.scalars[AGE] = math.inf
        _step(self._state, self._constants, 1e-3)  # compiles
        _owe(self._state)
        self._state.scalars[STARTED] = 0.0

    def update(self, model: LocalContact) -> None:
        """Hands the newest local model over; the next `step` begins to blend to it.

        One that cannot be rendered (`model.check()` says why) is counted in `refused`, and the last one goes on.
        """
        if not model.renderable:
            self.refused += 1
            return
        self._newest = _packed(model, self.settings.coupling_stiffness)

    def step(self, position: ArrayLike, velocity: ArrayLike, dt: float) -> np.ndarray:
        """Force for the device, once per sample.

        Args:
            position: position of the tool's origin as the device holds it, layer axes, (3,) [m].
            velocity: velocity of the tool's origin, (3,) [m/s].
            dt: time since the last step [s].

        Returns:
            Force on the device, (3,) [N]; the same array at every call. Zero, and one more in `refused`, when the
            input is not finite, dt not above 0, or the position farther from the last than it can have come (2 m/s
            more than the velocity); where that stays so for 5 samples the loop begins anew there.

        Raises:
            InvalidInput: another shape, or what is no number.
        """
        state, newest = self._state, self._newest
        if newest is not None and newest is not self._taken:
            self._taken = newest
            state.target[:] = newest
            _owe(state)
            state.scalars[LEFT], state.scalars[AGE] = self.settings.blend, 0.0
        if np.shape(position) != (3,) or np.shape(velocity) != (3,) or not isinstance(dt, Real):
            raise InvalidInput(f"a step is of position {position!r:.60}, velocity {velocity!r:.60} and dt {dt!r:.20}; "
                               "three numbers, three numbers and one are needed.")  # fmt: skip
        try:
            state.position[:], state.velocity[:] = position, velocity
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"position and velocity are no numbers: {error}.") from error
        if not _step(state, self._constants, dt):
            self.refused += 1
        return state.force

    @property
    def balance(self) -> float:
        """Energy W of the passivity observer [J]; below 0 the loop has given out energy that was not put in."""
        return float(self._state.scalars[BALANCE])

    @property
    def taken_in(self) -> float:
        """Energy that the device has put into the loop, as measured [J]."""
        return float(self._state.scalars[TAKEN_IN])

    @property
    def worst_balance(self) -> float:
        """Lowest energy W so far [J]."""
        return float(self._state.scalars[WORST])

    @property
    def added_damping(self) -> float:
        """Damping that the controller adds now [N s/m]."""
        return float(self._state.scalars[ADDED])

    @property
    def age(self) -> float:
        """Time since the newest local model was taken over [s]; infinite before the first."""
        return float(self._state.scalars[AGE])

    @property
    def proxy(self) -> np.ndarray:
        """Position where the tool's origin rests, (3,) [m]: the pose to ask the next local model for."""
        return self._state.proxy.copy()

    @property
    def outside(self) -> bool:
        """Whether the proxy has left the neighbourhood in which the newest local model holds."""
        return bool(np.linalg.norm(self._state.proxy - self._state.target[PLACE]) > self._state.target[VALID])


# A local model as the kernel reads it: what presses, as force at the origin of layer axes and stiffness; normal, size,
# normal stiffness; stiffness of friction and its limit; place, valid_m, friction there. The scalars of the loop follow.
BIAS, STIFFNESS, NORMAL, SIZE, ALONG, STICKS, LIMIT = slice(0, 3), slice(3, 12), slice(12, 15), 15, 16, 17, 18
BLENDED, PLACE, VALID, DRAG, MODEL = 19, slice(19, 22), 22, slice(23, 26), 26
AGE, LEFT, STARTED, BALANCE, TAKEN_IN, STORED, WORST, ADDED, TICK, STRAY, SCALARS = range(11)


class _State(NamedTuple):
    live: np.ndarray  # model that is rendered now, (MODEL,)
    target: np.ndarray  # newest model, (MODEL,)
    position: np.ndarray  # position of the tool's origin, (3,) [m]
    velocity: np.ndarray  # velocity of the tool's origin, (3,) [m/s]
    last: np.ndarray  # position one step ago, (3,) [m]
    proxy: np.ndarray  # position of the proxy, (3,) [m]
    force: np.ndarray  # force on the device, (3,) [N]
    drag: np.ndarray  # friction at the proxy, (3,) [N]
    owed: np.ndarray  # what of the newest model's friction is not blended in yet, (3,) [N]
    sent: np.ndarray  # ring of sent forces, (LONGEST_DELAY, 3) [N]
    scalars: np.ndarray


def _packed(model: LocalContact, coupling: float) -> np.ndarray:
    """The model for the kernel; stiffness that falls is kept to half of the coupling's: one place for the proxy."""
    whole = model.push_stiffness[:3, :3]
    values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
    stiffness = (vectors * np.maximum(values, -0.5 * coupling)) @ vectors.T
    place, force, normal, grip = model.pose_body_from_tool[:3, 3], model.push[:3], model.normal, model.grip
    size = float(np.linalg.norm(force))
    along = max(float(normal @ stiffness @ normal), size / ENERGY_DEPTH_M)
    sticks, limit, drag = (0.0, 0.0, np.zeros(3)) if grip is None else (grip.stiffness[0], grip.limit, grip.wrench[:3])
    return np.concatenate([force - stiffness @ place, stiffness.ravel(), normal, [size, along, sticks, limit], place,
                           [model.valid_m], drag])  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def _owe(state):
    """What the friction of the newest model at the proxy is more than the present one, along the skin."""
    model, p = state.target, state.proxy
    for i in range(3):
        state.owed[i] = model[23 + i] + model[17] * (p[i] - model[19 + i]) - state.drag[i]


@numba.njit(cache=True, error_model="numpy")
def _step(state, constants, dt):
    """One step; False when the input cannot be used."""
    kc, bc, controlled, most, noise, limit, stale_after, decay, delay = constants
    x, v, last, p, force, s = state.position, state.velocity, state.last, state.proxy, state.force, state.scalars
    drag, owed = state.drag, state.owed
    good = dt > 0 and np.isfinite(dt)
    for i in range(3):
        good = good and np.isfinite(x[i]) and np.isfinite(v[i])
    if good and s[STARTED] > 0:  # one wrong sample of an encoder would be paid for over seconds
        far = speed = 0.0
        for i in range(3):
            far += (x[i] - last[i]) ** 2
            speed += v[i] * v[i]
        strays = np.sqrt(far) > (s[STRAY] + 1) * dt * (JUMP + np.sqrt(speed))
        s[STRAY] = s[STRAY] + 1 if strays else 0.0
        if s[STRAY] > STRAYS:  # it is elsewhere indeed: begun anew
            s[STARTED] = s[STRAY] = 0.0
        good = not strays or s[STARTED] == 0.0
    if not good:
        force[:] = 0.0
        state.sent[int(s[TICK]) % len(state.sent)] = 0.0
        s[TICK] += 1.0
        return False
    if s[STARTED] == 0.0:
        last[:], p[:], drag[:], owed[:], s[STARTED] = x, x, 0.0, 0.0, 1.0
        s[BALANCE], s[TAKEN_IN], s[STORED], s[WORST], s[ADDED], s[TICK] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        state.sent[:] = 0.0

    # Observe: what the force that acted since the last step took in.
    tick = int(s[TICK])
    acted = state.sent[(tick - 1 - int(delay)) % len(state.sent)]
    work = 0.0
    for i in range(3):
        work -= acted[i] * (x[i] - last[i])
        last[i] = x[i]
    s[TAKEN_IN] += work

    # Model: blend to the newest; fade when it is stale.
    model, part = state.live, 1.0 if s[LEFT] <= dt else dt / s[LEFT]
    for i in range(BLENDED):
        model[i] += part * (state.target[i] - model[i])
    for i in range(3):
        drag[i] += part * owed[i]
        owed[i] -= part * owed[i]
    s[LEFT] = max(s[LEFT] - dt, 0.0)
    s[AGE] += dt
    fade = 1.0 if s[AGE] <= stale_after else np.exp(-(s[AGE] - stale_after) / decay)

    # Proxy: balance of coupling, model and friction that sticks; then pressing never pulls, and friction slips.
    c, pressing, up = kc + bc / dt, 0.0, 0.0
    right = kc * x + bc * (v + p / dt)
    k, sticks = fade * model[3:12].reshape(3, 3), fade * model[STICKS]
    bias, normal, held = fade * model[0:3], model[12:15], k.copy()
    for i in range(3):
        for j in range(3):
            held[i, j] += sticks * ((1.0 if i == j else 0.0) - normal[i] * normal[j])
    way = sticks * (p - (p @ normal) * normal)
    rest = _solved(held, c, right - bias - drag + way)
    f = bias + k @ rest
    drag += sticks * (rest - (rest @ normal) * normal) - way
    for i in range(3):
        pressing += f[i] * normal[i]
        up += drag[i] * normal[i]
    size = fade * model[15]
    kept = min(1.0, pressing / (FADE * size)) if size > 0 else 0.0
    dragged = 0.0
    for i in range(3):
        drag[i] -= up * normal[i]
        dragged += drag[i] * drag[i]
    cone = max(fade * model[LIMIT] * pressing, 0.0)
    slips = cone / np.sqrt(dragged) if dragged > cone * cone else 1.0
    dragged = 0.0
    for i in range(3):
        drag[i] *= slips
        dragged += drag[i] * drag[i]
        f[i] = pressing * normal[i] + kept * (f[i] - pressing * normal[i]) + drag[i] if pressing > 0 else 0.0
        p[i] = (right[i] - f[i]) / c

    # Balance: what was taken in, less what is stored; a surplus beyond half of that is forgotten.
    stored = 0.0
    for i in range(3):
        stored += 0.5 * kc * (x[i] - p[i]) ** 2
    along = fade * model[ALONG]
    if pressing > 0 and along > 0:
        stored += pressing * pressing / (2 * along)
    if sticks > 0:
        stored += dragged / (2 * sticks)
    s[BALANCE] = min(s[BALANCE] + work - (stored - s[STORED]), 0.5 * stored)
    s[STORED] = stored
    s[WORST] = min(s[WORST], s[BALANCE])

    # Control: damp while the balance is negative; limit the force.
    speed = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    s[ADDED] = 0.0
    if controlled > 0 and s[BALANCE] < 0 and speed > noise:
        s[ADDED] = min(most, -s[BALANCE] / (speed * speed * max(dt, PAYBACK_S))) * (1.0 - noise / speed)
    length = 0.0
    for i in range(3):
        force[i] = -f[i] - s[ADDED] * v[i]
        length += force[i] * force[i]
    length = np.sqrt(length)
    if length > limit:
        for i in range(3):
            force[i] *= limit / length
    state.sent[tick % len(state.sent)] = force
    s[TICK] = tick + 1.0
    return True


@numba.njit(cache=True, error_model="numpy")
def _solved(k, c, right):
    """(k + c I)^-1 right for a symmetric k (3, 3), by Cramer's rule."""
    a, b, d = k[0, 0] + c, k[1, 1] + c, k[2, 2] + c
    e, f, g = k[0, 1], k[0, 2], k[1, 2]
    p, q, r = b * d - g * g, f * g - e * d, e * g - f * b
    det = a * p + e * q + f * r
    out = np.empty(3)
    out[0] = (p * right[0] + q * right[1] + r * right[2]) / det
    out[1] = (q * right[0] + (a * d - f * f) * right[1] + (e * f - a * g) * right[2]) / det
    out[2] = (r * right[0] + (e * f - a * g) * right[1] + (a * b - e * e) * right[2]) / det
    return out
