"""A simulated haptic device in a hand, pressed on the real contact: what it feels, and what energy it gives out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import trimesh

from stmpl_core import Contact, SoftLayer, State, Tool
from stmpl_core.body import Body
from stmpl_core.friction import Friction
from stmpl_core.haptics import DeviceLoop, LoopSettings
from stmpl_core.history import History
from stmpl_core.local_contact import LocalContact, local_contact, local_contacts
from stmpl_core.tissue import Prony
from stmpl_core.toucher import Toucher

FINE = 25e-6  # s, step of the device's own motion
BALL = 0.012  # m
QUIET = 2e-6  # J that hand and device may trade by rounding
FELT = 0.02  # N, standard deviation: a chatter that a fingertip may notice
LASTING = 0.75  # of the chatter 0.15 s earlier: the free device's fades to less than half


@dataclass(frozen=True)
class Device:
    """What the hand holds: m dv/dt + b v = force of the loop + force of the hand.

    Args:
        mass: mass m [kg].
        damping: damping b of its bearings [N s/m].
        resolution: resolution of its encoders [m].
        noise: standard deviation on what they read [m].
        rate: rate of its loop [Hz]; forces are held between.
        delay_steps: number of samples between a force's command and its effect.
        cutoff: cut-off of the low-pass on the differences of the position that are its velocity [Hz].
    """

    mass: float = 0.2
    damping: float = 0.3
    resolution: float = 10e-6
    noise: float = 0.0
    rate: float = 1000.0
    delay_steps: int = 0
    cutoff: float = 80.0


@dataclass(frozen=True)
class Hand:
    """A grip on the device, spring and damper to where the person wants it: down, hold or stroke and hold, up.

    Args:
        stiffness: stiffness of the grip [N/m].
        damping: damping of the grip [N s/m].
        deep: depth that it wants to reach, under the skin at rest [m].
        away: height at which it starts and ends, over the skin [m].
        press: time to go down [s].
        hold: time to stay [s].
        leave: time to come back [s].
        stroke: way along the skin that it goes in the first half of the hold [m].
    """

    stiffness: float = 300.0
    damping: float = 2.0
    deep: float = 5e-3
    away: float = 2e-3
    press: float = 0.25
    hold: float = 0.6
    leave: float = 0.15
    stroke: float = 0.0

    @property
    def duration(self) -> float:
        """All of it, with a while away at the end [s]."""
        return self.press + self.hold + self.leave + 0.1

    def height(self, t: float) -> float:
        """Wanted height of the tool's lowest point over the skin at rest [m]."""
        down, up = t / self.press, (t - self.press - self.hold) / self.leave
        share = _smooth(down) if t < self.press + self.hold else 1 - _smooth(up)
        return self.away - share * (self.away + self.deep)

    def aside(self, t: float) -> float:
        """Wanted way along the skin [m]."""
        return self.stroke * _smooth((t - self.press) / (0.5 * self.hold))


@dataclass(frozen=True, eq=False)
class Spot:
    """A ball over one place of a skin: the node's side of the experiment. Everything here is the real contact.

    Args:
        toucher: contact law.
        tool: ball.
        place, out: place on the skin, and its outward normal, (3,) each.
        friction: friction of the ball.
        remembers: choice of a node that keeps a state; without, contacts are elastic and without friction.
    """

    toucher: Toucher
    tool: Tool
    place: np.ndarray
    out: np.ndarray
    friction: Friction = None
    remembers: bool = False

    @classmethod
    def of(cls, layer: SoftLayer, vertex: int) -> Spot:
        """Over `vertex`."""
        sphere = trimesh.creation.icosphere(4, BALL)
        tool = Tool("ball", sphere.vertices, sphere.faces)
        return cls(Toucher(layer), tool, layer.vertices[vertex], layer.normals[vertex])

    def with_modulus(self, youngs_modulus: float) -> Spot:
        """The same on a skin of another stiffness [Pa]."""
        return replace(self, toucher=Toucher(self.toucher.layer.with_(youngs_modulus=youngs_modulus)))

    def with_memory(self, relaxation: Prony | None, friction: Friction) -> Spot:
        """The same where the tissue relaxes and the ball rubs."""
        layer = self.toucher.layer
        if relaxation is not None:
            tissue = layer.tissue.relaxing(relaxation) if layer.stacked else \
                replace(layer.tissue, relaxation=relaxation)  # fmt: skip
            layer = layer.with_(tissue=tissue)
        return replace(self, toucher=Toucher(layer), friction=friction, remembers=True)

    def pose(self, origin: np.ndarray) -> np.ndarray:
        """The ball's pose with its centre there."""
        pose = np.eye(4)
        pose[:3, 3] = origin
        return pose

    def centre(self, height: float, aside: float = 0.0) -> np.ndarray:
        """The ball's centre when its lowest point is at `height` over the skin, and so far aside [m]."""
        first = np.cross(self.out, np.eye(3)[np.abs(self.out).argmin()])
        return self.place + (BALL + height) * self.out + aside / np.linalg.norm(first) * first

    def model(self, origin: np.ndarray) -> LocalContact:
        """The local model there, elastic and without friction."""
        return local_contact(self.toucher, Contact(self.tool, self.pose(origin)))

    def force(self, origin: np.ndarray) -> np.ndarray:
        """The reaction's force on the body there, (3,) [N]."""
        return self.toucher.touch(Contact(self.tool, self.pose(origin))).wrench[:3]


class Node:
    """The node of a spot: local models, with a memory where the spot has one."""

    def __init__(self, spot: Spot) -> None:
        self.spot, self._history = spot, History(spot.toucher, spot.friction)
        self._state, self._time = State(), 0.0

    def model(self, origin: np.ndarray, time: float) -> LocalContact:
        """The local model of a ball there at a time [s], not before that of the last call."""
        if not self.spot.remembers:
            return self.spot.model(origin)
        contact, dt = Contact(self.spot.tool, self.spot.pose(origin)), time - self._time
        touches, self._state = self._history.step([contact], self._state, dt)
        self._time = time
        return local_contacts(self._history, touches, self._state)[0]


@dataclass(frozen=True, eq=False)
class Felt:
    """What happened, one row a device sample.

    Args:
        time: time of the sample, (N,) [s].
        height: height of the tool's lowest point over the skin at rest, (N,) [m].
        force: force on the device along the skin's outward normal, (N,) [N].
        to_hand: energy that the hand has been given by device and loop together, net, (N,) [J].
        from_loop: energy that the loop has given the device, net, (N,) [J], found by integrating the motion.
        observed: energy that the loop's observer has from samples for it, (N,) [J].
        balance: observer's W, (N,) [J].
        stiffness: stiffnesses of the contact, and of contact and coupling in series, at the end of the hold [N/m].
        hand: hand that pressed.
    """

    time: np.ndarray
    height: np.ndarray
    force: np.ndarray
    to_hand: np.ndarray
    from_loop: np.ndarray
    observed: np.ndarray
    balance: np.ndarray
    stiffness: tuple[float, float]
    hand: Hand

    def _holding(self, early: float, late: float) -> np.ndarray:
        """Samples from `early` to `late` before the end of the hold [s]."""
        end = self.hand.press + self.hand.hold
        return np.flatnonzero((self.time >= end - early) & (self.time < end - late))

    @property
    def force_held(self) -> float:
        """Mean force over the last 0.15 s of the hold [N]."""
        return float(self.force[self._holding(0.15, 0.0)].mean())

    @property
    def chatter(self) -> float:
        """Standard deviation of the force over the last 0.15 s of the hold [N]."""
        return float(self.force[self._holding(0.15, 0.0)].std())

    @property
    def given_out(self) -> float:
        """Most that the hand ever had from device and loop beyond what it put in [J]."""
        return float(self.to_hand.max())

    @property
    def rings(self) -> bool:
        """Whether an oscillation is kept going while the hand only holds still: it can be felt, and does not fade."""
        return not self.chatter < max(FELT, LASTING * float(self.force[self._holding(0.3, 0.15)].std()))

    @property
    def passive(self) -> bool:
        """The hand never had more than it put in, and nothing rings."""
        return bool(np.isfinite(self.to_hand).all()) and self.given_out <= QUIET and not self.rings


def play(device: Device, hand: Hand, settings: LoopSettings, spot: Spot, *, node_rate: float = 125.0,
         node_delay: float = 0.0, held_force: bool = False) -> Felt:
    """One press, hold and letting go.

    Args:
        node_rate: rate of local models [Hz], each for the proxy's pose of its instant.
        node_delay: time from that instant to the model's arrival [s].
        held_force: models that come without their stiffness: what a loop without a local model would render.
    """
    loop, dt, node = DeviceLoop(settings), 1 / device.rate, Node(spot)
    rng, count = np.random.default_rng(0), round(hand.duration * device.rate)
    sent = [np.zeros(3)] * (device.delay_steps + 1)
    motion = np.concatenate([spot.centre(hand.height(0.0)), np.zeros(3)])
    energies, rows, under_way = np.zeros(2), np.zeros((count, 6)), []
    velocity, last, due, stiffness = np.zeros(3), motion[:3].copy(), 0.0, (0.0, 0.0)
    smoothing = 1 - np.exp(-2 * np.pi * device.cutoff * dt)
    for k in range(count):
        t = k * dt
        # The node: an answer for where the proxy is now, which arrives later.
        if t >= due - 1e-9:
            model = node.model(loop.proxy if k else motion[:3], t)
            if held_force:
                model = replace(model, stiffness=np.zeros((6, 6)), grip=None)
            under_way.append((t + node_delay, model))
            due += 1 / node_rate
        while under_way and under_way[0][0] <= t + 1e-9:
            loop.update(under_way[0][1])
            if t < hand.press + hand.hold:
                stiffness = _stiffnesses(under_way[0][1], settings)
            under_way.pop(0)

        # The device: encoders, velocity, a step of the loop, and a force that is held.
        read = np.round((motion[:3] + device.noise * rng.normal(size=3)) / device.resolution) * device.resolution
        velocity += smoothing * ((read - last) / dt - velocity) if k else 0.0
        last = read
        sent = sent[1:] + [loop.step(read, velocity, dt).copy()]
        rows[k] = (spot.out @ (motion[:3] - spot.place) - BALL, spot.out @ sent[0], *energies, -loop.taken_in,
                   loop.balance)
        wish, wished = (spot.centre(hand.height(at), hand.aside(at)) for at in (t, t + dt))
        _move(motion, energies, sent[0], wish, (wished - wish) / dt, dt, device.mass, device.damping, hand.stiffness,
              hand.damping)
    height, force, to_hand, from_loop, observed, balance = rows.T
    return Felt(np.arange(count) * dt, height, force, to_hand, from_loop, observed, balance, stiffness, hand)


@numba.njit(cache=True)
def _move(motion, energies, force, wish, wish_velocity, dt, mass, damping, grip, grip_damping):
    """Moves the device for one sample under a held force; adds what hand and device were given."""
    steps = max(1, int(round(dt / FINE)))
    h = dt / steps
    for n in range(steps):
        for i in range(3):
            x, v = motion[i], motion[3 + i]
            hand = grip * (wish[i] + n * h * wish_velocity[i] - x) + grip_damping * (wish_velocity[i] - v)
            v += h * (force[i] + hand - damping * v) / mass
            motion[i], motion[3 + i] = x + h * v, v
            energies[0] -= hand * h * v
            energies[1] += force[i] * h * v


def _stiffnesses(model: LocalContact, settings: LoopSettings) -> tuple[float, float]:
    along = float(model.normal @ model.push_stiffness[:3, :3] @ model.normal)
    return along, along * settings.coupling_stiffness / (along + settings.coupling_stiffness) if along > 0 else 0.0


def _smooth(s: float) -> float:
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10 - 15 * s + 6 * s * s)


def arm_spot() -> Spot:
    """Over the vertex of the arm's UV seam that is nearest to its middle."""
    layer = Body.anny().part("left_arm", edge_length=3e-3, thickness=7.5e-3)
    seam, middle = layer.chart.seam_vertices, layer.vertices.mean(axis=0)
    return Spot.of(layer, int(seam[np.linalg.norm(layer.vertices[seam] - middle, axis=1).argmin()]))
