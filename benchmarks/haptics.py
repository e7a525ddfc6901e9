"""A simulated haptic device on the real contact: what it feels, whether that stays passive, and how stiff it may be.

python -m benchmarks.haptics [--parts cost continuity slide session map] [--picture docs/pictures/z_width.png]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numba
import numpy as np
import trimesh

from stmpl_core import Contact, SoftLayer, ToolMesh
from stmpl_core.body import Body
from stmpl_core.haptics import DeviceLoop, LocalContact, LoopSettings, local_contact
from stmpl_core.provenance import machine
from stmpl_core.sdf import SignedDistance
from stmpl_core.touch import Toucher

FINE = 25e-6  # s, step of the device's own motion
BALL = 0.012  # m
HARD = 5e5  # Pa: a skin beside which the coupling is soft, 5 kN/m under 1 N
LEVELS = [round(100 * 2 ** (k / 2)) for k in range(15)]  # N/m, of the coupling: 100 to 12,800
MODULI = [1e3 * 2**k for k in range(11)]  # Pa, of the skin: 1 kPa to 1 MPa
COUPLING = 1000.0  # N/m, unless it is varied
RATES, DELAYS = (500, 1000, 2000, 4000), (0.0, 2e-3, 5e-3)  # Hz of the device, s of its force
NODE_DELAYS = (0.0, 20e-3)  # s of the local model
QUIET = 2e-6  # J that hand and device may trade by rounding
FELT = 0.02  # N, standard deviation: a chatter that a fingertip may notice
LASTING = 0.75  # of the chatter 0.15 s earlier: the free device's fades to less than half


@dataclass(frozen=True)
class Device:
    """What the hand holds: m dv/dt + b v = force of the loop + force of the hand.

    Args:
        mass: m [kg].
        damping: b, of its bearings [N s/m].
        resolution: of its encoders [m].
        noise: standard deviation on what they read [m].
        rate: of its loop [Hz]; forces are held between.
        delay_steps: samples between a force's command and its effect.
        cutoff: of the low-pass on the differences of the position that are its velocity [Hz].
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
    """A grip on the device, spring and damper to where the person wants it: down, hold, up.

    Args:
        stiffness: of the grip [N/m].
        damping: of the grip [N s/m].
        deep: where it wants to go, under the skin at rest [m].
        away: where it starts and ends, over the skin [m].
        press, hold, leave: times [s].
    """

    stiffness: float = 300.0
    damping: float = 2.0
    deep: float = 5e-3
    away: float = 2e-3
    press: float = 0.25
    hold: float = 0.6
    leave: float = 0.15

    @property
    def duration(self) -> float:
        """All of it, with a while away at the end [s]."""
        return self.press + self.hold + self.leave + 0.1

    def height(self, t: float) -> float:
        """Wanted height of the tool's lowest point over the skin at rest [m]."""
        down, up = t / self.press, (t - self.press - self.hold) / self.leave
        share = _smooth(down) if t < self.press + self.hold else 1 - _smooth(up)
        return self.away - share * (self.away + self.deep)


@dataclass(frozen=True, eq=False)
class Spot:
    """A ball over one place of a skin: the node's side of the experiment. Everything here is the real contact."""

    toucher: Toucher
    mesh: ToolMesh
    field: SignedDistance
    place: np.ndarray
    out: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer, vertex: int) -> Spot:
        """Over `vertex`."""
        sphere = trimesh.creation.icosphere(4, BALL)
        mesh = ToolMesh.of(sphere.vertices, sphere.faces)
        return cls(Toucher(layer), mesh, SignedDistance.of(mesh), layer.vertices[vertex], layer.normals[vertex])

    def with_modulus(self, youngs_modulus: float) -> Spot:
        """The same on a skin of another stiffness [Pa]."""
        return replace(self, toucher=Toucher(self.toucher.layer.with_(youngs_modulus=youngs_modulus)))

    def pose(self, origin: np.ndarray) -> np.ndarray:
        """The ball's pose with its centre there."""
        pose = np.eye(4)
        pose[:3, 3] = origin
        return pose

    def centre(self, height: float) -> np.ndarray:
        """The ball's centre when its lowest point is at `height` over the skin [m]."""
        return self.place + (BALL + height) * self.out

    def model(self, origin: np.ndarray) -> LocalContact:
        """The local model there."""
        return local_contact(self.toucher, Contact("ball", self.mesh, self.pose(origin)), self.field, rotations=False)

    def force(self, origin: np.ndarray) -> np.ndarray:
        """The reaction's force on the body there, (3,) [N]."""
        return self.toucher.touch(Contact("ball", self.mesh, self.pose(origin)), self.field).wrench[:3]


@dataclass(frozen=True, eq=False)
class Felt:
    """What happened, one row a device sample.

    Args:
        time: (N,) [s].
        height: of the tool's lowest point over the skin at rest, (N,) [m].
        force: on the device along the skin's outward normal, (N,) [N].
        to_hand: energy that the hand has been given by device and loop together, net, (N,) [J].
        from_loop: energy that the loop has given the device, net, (N,) [J], found by integrating the motion.
        observed: the same as the loop's observer has it from samples, (N,) [J].
        balance: the observer's W, (N,) [J].
        stiffness: of contact and of contact and coupling in series, at the end of the hold [N/m].
        hand: what it did.
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
        node_rate: of local models [Hz], each for the proxy's pose of its instant.
        node_delay: from that instant to the model's arrival [s].
        held_force: the model comes without its stiffness: what a loop without a local model would render.
    """
    loop, dt = DeviceLoop(settings), 1 / device.rate
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
            model = spot.model(loop.proxy if k else motion[:3])
            if held_force:
                model = replace(model, stiffness=np.zeros((6, 6)))
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
        wish, wished = spot.centre(hand.height(t)), spot.centre(hand.height(t + dt))
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
    along = float(model.normal @ model.stiffness[:3, :3] @ model.normal)
    return along, along * settings.coupling_stiffness / (along + settings.coupling_stiffness) if along > 0 else 0.0


def _smooth(s: float) -> float:
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10 - 15 * s + 6 * s * s)


def settings_for(device: Device, coupling: float, controller: bool) -> LoopSettings:
    """Settings whose controller cannot make a light or late device unstable by damping it too much."""
    late = 1 / device.rate + device.delay_steps / device.rate
    return LoopSettings(coupling_stiffness=coupling, controller=controller, delay_steps=device.delay_steps,
                        most_damping=min(20.0, 0.25 * device.mass / late),
                        velocity_noise=np.pi * device.cutoff * device.resolution)


def stiffest_coupling(spot: Spot, rate: float, delay: float, controller: bool) -> float:
    """Stiffest coupling of LEVELS that stays passive against a hard skin [N/m]; 0 when none does."""
    device = Device(rate=rate, delay_steps=round(delay * rate))
    hard = spot.with_modulus(HARD)
    last = _last_passive(LEVELS, lambda kc: play(device, Hand(), settings_for(device, kc, controller), hard))
    return 0.0 if last is None else LEVELS[last[0]]


def stiffest_contact(spot: Spot, node_delay: float, controller: bool, held_force: bool) -> float:
    """Stiffest contact that stays passive under models that come late, at 1 kHz [N/m at the hold]; 0 when none does.

    The skin's modulus is raised; without the stiffness of the models, the contact's is that found with it.
    """
    device = Device()
    settings = settings_for(device, COUPLING, controller)
    last = _last_passive(MODULI, lambda e: play(device, Hand(), settings, spot.with_modulus(e), node_delay=node_delay,
                                                held_force=held_force))
    if last is None:
        return 0.0
    felt = play(device, Hand(), replace(settings, controller=True), spot.with_modulus(MODULI[last[0]]))
    return felt.stiffness[0]


def _last_passive(levels: list, run: Callable[[float], Felt]) -> tuple[int, Felt] | None:
    """The last level that is passive, by halving: from there on up none is taken to be."""
    low, high, kept = -1, len(levels), None
    while high - low > 1:
        middle = (low + high) // 2
        felt = run(levels[middle])
        if felt.passive:
            low, kept = middle, (middle, felt)
        else:
            high = middle
    return kept


def guide(rate: float, delay: float) -> float:
    """K < 2 b / (T + 2 d), b of device and hand together [N/m].

    At no delay that is K < 2 b / T of Colgate & Schenkel 1994 ("Passivity of a class of sampled-data systems", for a
    spring without virtual damping); a delay d of the force adds d to the T / 2 by which a held sample is late.
    """
    return 2 * (Device().damping + Hand().damping) / (1 / rate + 2 * delay)


def forces_along(spot: Spot, start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """The reaction's force at every `step` [m] from one place of the ball's centre to another, (N, 3) [N]."""
    count = round(float(np.linalg.norm(end - start)) / step)
    return np.array([spot.force(start + (end - start) * k / count) for k in range(count + 1)])


def worst_jump(forces: np.ndarray) -> float:
    """Largest change of the force between neighbours [N]."""
    return float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())


def paths(spot: Spot) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Ways of the ball's centre: along the arm, around it over the UV seam, down into contact."""
    layer = spot.toucher.layer
    seam = layer.vertices[layer.chart.seam_vertices]
    near = seam[np.linalg.norm(seam - spot.place, axis=1).argsort()[:6]]
    along = np.linalg.svd(near - near.mean(axis=0))[2][0]
    across = np.cross(spot.out, along)
    across /= np.linalg.norm(across)
    deep = spot.centre(-2e-3)
    return {
        "across the UV seam, 2 mm deep": (deep - 4e-3 * across, deep + 4e-3 * across),
        "over edges along it, 2 mm deep": (deep - 4e-3 * along, deep + 4e-3 * along),
        "down, 0.5 mm over to 2 mm under": (spot.centre(0.5e-3), deep),
    }


def slide(spot: Spot, way: tuple[np.ndarray, np.ndarray], *, blend: float, speed: float = 0.05,
          node_rate: float = 125.0) -> tuple[float, float]:
    """A device led along a way: the largest change of its force in 1 ms [N], and its RMS error at the proxy [N]."""
    loop, dt = DeviceLoop(LoopSettings(blend=blend)), 1e-3
    start, end = way
    count = round(float(np.linalg.norm(end - start)) / speed / dt)
    velocity = (end - start) / (count * dt)
    sent, errors, due = [], [], 0.0
    for k in range(-60, count + 1):  # it rests first, until the loop has settled
        place = start + (end - start) * max(k, 0) / count
        if k * dt >= due - 0.06 - 1e-9:
            loop.update(spot.model(loop.proxy if k > -60 else place))
            due += 1 / node_rate
        force = loop.step(place, velocity if k > 0 else np.zeros(3), dt).copy()
        if k >= 20:  # in contact from its first sample on, it first takes back what that gave out
            sent.append(force)
            errors.append(force + spot.force(loop.proxy))
    return worst_jump(np.array(sent)), float(np.sqrt(np.mean(np.square(errors))))


def arm_spot() -> Spot:
    """Over the vertex of the arm's UV seam that is nearest to its middle."""
    layer = Body.anny().part("left_arm", edge_length=3e-3, thickness=7.5e-3)
    seam, middle = layer.chart.seam_vertices, layer.vertices.mean(axis=0)
    return Spot.of(layer, int(seam[np.linalg.norm(layer.vertices[seam] - middle, axis=1).argmin()]))


def cost(spot: Spot) -> None:
    """Prints what a local model and a step of the loop take."""
    print("what it takes                          median      p99   touches")
    contact = Contact("ball", spot.mesh, spot.pose(spot.centre(-2e-3)))
    for name, turns in (("local model", True), ("local model without rotations", False)):
        model = local_contact(spot.toucher, contact, spot.field, rotations=turns)
        median, p99 = _timed(lambda t=turns: local_contact(spot.toucher, contact, spot.field, rotations=t), 60)
        print(f"{name:35} {1e3 * median:7.2f}  {1e3 * p99:7.2f} ms {model.trust.figures['evaluations']:6.0f}")
        print(f"    holds within {1e3 * model.valid_m:.2f} mm and {np.degrees(model.valid_rad):.1f} degrees")
    loop, still = DeviceLoop(), np.zeros(3)
    loop.update(model)
    median, p99 = _timed(lambda: loop.step(spot.centre(-3e-3), still, 1e-3), 20_000)
    print(f"{'step of the device loop':35} {1e6 * median:7.2f}  {1e6 * p99:7.2f} us")
    matrix = model.stiffness[:3, :3]
    twisted = np.linalg.norm(matrix - matrix.T) / np.linalg.norm(matrix + matrix.T)
    print(f"the stiffness is skew by {100 * twisted:.1f} % (0 for a contact that stores all its work)\n")


def continuity(spot: Spot) -> None:
    """Prints the largest jump of the force for finer and finer steps of the tool."""
    steps = (1e-4, 2.5e-5, 6.25e-6)
    print("largest change of force, N per mm of way, at steps of " + ", ".join(f"{1e3 * s:g}" for s in steps) + " mm")
    for name, (start, end) in paths(spot).items():
        cells = [f"{worst_jump(forces_along(spot, start, end, s)) / s / 1e3:10.4f}" for s in steps]
        print(f"{name:35}" + "".join(cells))
    print()


def sliding(spot: Spot) -> None:
    """Prints how smooth and how right the loop's force is while the tool is led at 50 mm/s."""
    print("led at 50 mm/s, 125 models/s           blend    jump in 1 ms    RMS error")
    for name, way in paths(spot).items():
        for blend in (0.0, 8e-3):
            jump, error = slide(spot, way, blend=blend)
            print(f"{name:35} {1e3 * blend:6.0f} ms {1e3 * jump:10.2f} mN {1e3 * error:10.2f} mN")
    print()


def session(spot: Spot) -> None:
    """Prints presses at 1 kHz under models that come late: with and without their stiffness, and the controller."""
    late = 20e-3
    print(f"press, hold, let go at 1 kHz, coupling {COUPLING:g} N/m, 125 models/s {1e3 * late:g} ms late; energy: uJ\n"
          "       E   model        controller   contact     force   chatter     to the hand   least W")
    for modulus in (1e3, 2e4, 2e5):
        for held in (True, False):
            for controller in (False, True):
                settings = settings_for(Device(), COUPLING, controller)
                felt = play(Device(), Hand(), settings, spot.with_modulus(modulus), node_delay=late, held_force=held)
                print(f"{modulus / 1e3:4.0f} kPa   {'force only' if held else 'linear':12} "
                      f"{'on' if controller else 'off':>8} "
                      f"{felt.stiffness[0]:8.0f} N/m {felt.force_held:5.2f} N {felt.chatter:7.3f} N "
                      f"{1e6 * felt.given_out:14.0f} {1e6 * felt.balance.min():11.0f}   "
                      f"{'passive' if felt.passive else 'RINGS' if felt.rings else 'ACTIVE'}", flush=True)
    print()


def z_width(spot: Spot, kept: Path, seconds: float) -> dict[str, float]:
    """All cells of the maps; those already in `kept` are not measured again. Stops early after so many seconds."""
    cells: dict[str, float] = json.loads(kept.read_text()) if kept.exists() else {}
    wanted: dict[str, Callable[[], float]] = {}
    for delay in DELAYS:
        for on in (False, True):
            for rate in RATES:
                wanted[f"coupling {rate} {delay:g} {on}"] = partial(stiffest_coupling, spot, rate, delay, on)
    for late in NODE_DELAYS:
        for on in (False, True):
            for held in (False, True):
                wanted[f"contact {late:g} {on} {held}"] = partial(stiffest_contact, spot, late, on, held)
    end = time.perf_counter() + seconds
    for name, measure in wanted.items():
        if name not in cells:
            if time.perf_counter() > end:
                print(f"stopped with {len(cells)} of {len(wanted)} cells; run it again")
                break
            cells[name] = measure()
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(cells, indent=1))
    return cells


def print_map(cells: dict[str, float]) -> None:
    """Prints both maps."""
    print("stiffest passive coupling against a hard skin [N/m], levels a factor 1.4 apart\n"
          "force late by   controller" + "".join(f"{r:>9} Hz" for r in RATES))
    for delay in DELAYS:
        for on in (False, True):
            row = [cells.get(f"coupling {r} {delay:g} {on}", np.nan) for r in RATES]
            print(f"{1e3 * delay:10.0f} ms {'on' if on else 'off':>10}  " + "".join(f"{c:12.0f}" for c in row))
        print(f"{'2 b / (T + 2 d)':>24}  " + "".join(f"{guide(r, delay):12.0f}" for r in RATES))
    print("\nstiffest passive contact at 1 kHz, coupling 1 kN/m, 125 models/s [N/m], moduli a factor 2 apart\n"
          "models late by  controller  linear model  force only")
    for late in NODE_DELAYS:
        for on in (False, True):
            row = [cells.get(f"contact {late:g} {on} {held}", np.nan) for held in (False, True)]
            print(f"{1e3 * late:10.0f} ms {'on' if on else 'off':>10}  {row[0]:13.0f} {row[1]:11.0f}")
    print()


def draw(cells: dict[str, float], path: Path) -> None:
    """Draws both maps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for delay, colour in zip(DELAYS, plt.get_cmap("viridis")(np.linspace(0, 0.85, len(DELAYS))), strict=True):
        for on in (False, True):
            row = [cells.get(f"coupling {r} {delay:g} {on}", np.nan) for r in RATES]
            left.loglog(RATES, row, "o-" if on else "s--", color=colour, mfc=colour if on else "white",
                        label=f"force {1e3 * delay:.0f} ms late" if on else None)
        left.loglog(RATES, [guide(r, delay) for r in RATES], ":", color=colour, lw=1)
    left.plot([], [], "k-o", label="with the controller")
    left.plot([], [], "k--s", mfc="white", label="without")
    left.plot([], [], "k:", label="2 b / (T + 2 d)")
    left.set(xlabel="rate of the device loop [Hz]", ylabel="stiffest passive coupling [N/m]",
             title="Virtual coupling on a hard skin")
    left.set_xticks(RATES, [str(r) for r in RATES], minor=False)
    left.minorticks_off()
    left.legend(fontsize=8)
    late = 1e3 * np.array(NODE_DELAYS)
    for held, colour in ((False, "C0"), (True, "C3")):
        for on in (False, True):
            row = np.array([cells.get(f"contact {t:g} {on} {held}", np.nan) for t in NODE_DELAYS])
            name = "force held between answers" if held else "local model"
            right.semilogy(late, np.maximum(row, 10), "o-" if on else "s--", color=colour,
                           mfc=colour if on else "white", label=f"{name}, {'with' if on else 'without'} controller")
    right.set(xlabel="delay of the node's answers [ms]", ylabel="stiffest passive contact [N/m]",
              title="Contact, 125 answers/s, loop at 1 kHz")
    right.legend(fontsize=8)
    for axis in (left, right):
        axis.grid(True, which="major", alpha=0.3)
    figure.savefig(path, dpi=130)


def _timed(call: Callable[[], object], count: int) -> tuple[float, float]:
    """Median and 99th percentile [s]."""
    spent = np.empty(count)
    for k in range(count):
        start = time.perf_counter()
        call()
        spent[k] = time.perf_counter() - start
    return float(np.median(spent)), float(np.quantile(spent, 0.99))


def main() -> None:
    """Prints the tables and draws the map."""
    parts = {"cost": cost, "continuity": continuity, "slide": sliding, "session": session}
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--parts", nargs="+", default=[*parts, "map"], choices=[*parts, "map"])
    given.add_argument("--picture", type=Path, default=Path("docs/pictures/z_width.png"))
    given.add_argument("--cells", type=Path, default=Path("runs/z_width.json"), help="what the map has measured so far")
    given.add_argument("--seconds", type=float, default=3600.0, help="that the map may take")
    options = given.parse_args()
    spot = arm_spot()
    print(f"{spot.toucher.layer}\n{machine()}; load {os.getloadavg()[0]:.1f} before the run\n")
    for name in options.parts:
        if name in parts:
            parts[name](spot)
    if "map" in options.parts:
        cells = z_width(spot, options.cells, options.seconds)
        print_map(cells)
        draw(cells, options.picture)


if __name__ == "__main__":
    main()
