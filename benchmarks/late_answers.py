"""A robot that presses on skin through local models that come late: does it settle, and does the contact give energy?

python -m benchmarks.late_answers [--limbs left_forearm left_thigh] [--bare]

The robot is a mass that moves in three directions with a ball of 20 mm radius at its end, at 1 kHz; its controllers are
an impedance (press 12 mm, stroke 20 mm, let go) and a force (press, let go at once). The node answers at 100 Hz with a
state; models arrive late, and PassiveContact renders them, or with --bare the models alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.tools import ball
from stmpl_core import Contact, SoftLayer, State
from stmpl_core.body import Body
from stmpl_core.friction import Friction
from stmpl_core.history import History
from stmpl_core.living import living
from stmpl_core.local_contact import LocalContact, local_contacts
from stmpl_core.passive import PassiveContact
from stmpl_core.regions import HELD_SKIN
from stmpl_core.tissue import Prony
from stmpl_core.toucher import Toucher
from stmpl_sim.energy import EnergyBook
from stmpl_sim.site import Site

MASS, BRAKE, DT, RATE = 3.0, 5.0, 1e-3, 100.0  # kg, N s/m, s, Hz
START, DEEP, STROKE = 3e-3, 12e-3, 20e-3  # m: over the skin, under it, along it
DURATION, RELEASE = 2.8, 2.0  # s
MOST_DAMPING = 30.0  # N s/m: a force controller that takes the force's rate bears no more on 3 kg
DELAYS = (0.0, 5e-3, 20e-3)  # s
IMPEDANCES, FORCES = (300.0, 1000.0, 3000.0), (5.0, 10.0, 20.0, 30.0)  # N/m, N
KINDS: dict[str, tuple[Prony | None, Friction]] = {"elastic": (None, None), "relaxing, mu 0.3": (HELD_SKIN, 0.3)}


@dataclass(frozen=True, eq=False)
class Place:
    """Where a robot presses.

    Args:
        history: the node's law.
        point, out, aside: place on the skin, its outward normal, and a tangent, (3,) each.
    """

    history: History
    point: np.ndarray
    out: np.ndarray
    aside: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer, vertex: int, friction: Friction = None) -> Place:
        """Over a vertex."""
        out = layer.normals[vertex]
        aside = np.cross(out, np.eye(3)[np.abs(out).argmin()])
        return cls(History(Toucher(layer), friction), layer.vertices[vertex], out, aside / np.linalg.norm(aside))

    def pose(self, origin: np.ndarray) -> np.ndarray:
        """Pose of a ball whose lowest point is there."""
        pose = np.eye(4)
        pose[:3, :3] = np.stack([self.aside, np.cross(self.out, self.aside), self.out], axis=1)
        pose[:3, 3] = origin
        return pose


Control = Callable[[float, np.ndarray, np.ndarray, np.ndarray, Place], np.ndarray]


class Run(NamedTuple):
    """What happened, a row a millisecond.

    Args:
        time: time, (N,) [s].
        force: force on the robot along the skin's outward normal, (N,) [N].
        height: height of the ball's lowest point, (N,) [m].
        book: work on the skin.
    """

    time: np.ndarray
    force: np.ndarray
    height: np.ndarray
    book: EnergyBook

    @property
    def gained(self) -> float:
        """Most that the contact ever gave beyond what was put in, over the most that it held [-]."""
        return max(-self.book.lowest / self.book.most, 0.0)

    def during(self, start: float, end: float) -> np.ndarray:
        """Forces between two times [N]."""
        return self.force[(self.time >= start) & (self.time < end)]


class Bare:
    """Models as they come."""

    def __init__(self) -> None:
        self._model: LocalContact | None = None

    def update(self, model: LocalContact) -> None:
        """Takes the newest model."""
        self._model = model

    def step(self, pose: np.ndarray, _dt: float) -> np.ndarray:
        """Its wrench on the body, (6,)."""
        return np.zeros(6) if self._model is None else self._model.wrench_at(pose).wrench


def impedance(stiffness: float) -> Control:
    """Spring and damper to a course: down, along, up."""

    def control(t: float, x: np.ndarray, v: np.ndarray, _force: np.ndarray, place: Place) -> np.ndarray:
        down = smooth(t / 0.5) * (1 - smooth((t - RELEASE) / 0.5))
        height, way = START - (START + DEEP) * down, STROKE * smooth((t - 1.1) / 0.8)
        course = place.point + height * place.out + way * place.aside
        return stiffness * (course - x) - 1.4 * np.sqrt(stiffness * MASS) * v

    return control


class ForceControl:
    """A set force, with its error, the integral of that and the force's rate; along the skin a spring and damper."""

    def __init__(self, force: float) -> None:
        self.force, self._sum, self._seen, self._touched = force, 0.0, 0.0, False

    def __call__(self, t: float, x: np.ndarray, v: np.ndarray, force: np.ndarray, place: Place) -> np.ndarray:
        """Force of the robot's actuators, (3,) [N]."""
        if t > RELEASE:
            return 1500 * (place.point + 8e-3 * place.out - x) - 94 * v
        feels, before = float(force @ place.out), self._seen
        self._seen += (feels - self._seen) * DT / 3e-3
        wanted = self.force * (0.3 + 0.7 * smooth((t - 0.3) / 0.7))
        away, speed = x - place.point, float(v @ place.out)
        along = -8000 * (away - (away @ place.out) * place.out) - 220 * (v - speed * place.out)
        self._touched = self._touched or self._seen > 0.2 * wanted
        if not self._touched:
            return along - (wanted + 400 * speed) * place.out
        error = wanted - self._seen
        self._sum += error * DT
        return along - (wanted + 2 * error + 10 * self._sum - 0.1 * (self._seen - before) / DT) * place.out


def run(place: Place, control: Control, late: float, loop: PassiveContact | Bare) -> Run:
    """One press with models that arrive so late [s]."""
    tool, state, book = ball(20), State(), EnergyBook()
    x, v, told, due = place.point + START * place.out, np.zeros(3), 0.0, 0.0
    rows, under_way = np.zeros((round(DURATION / DT), 3)), []
    for k in range(len(rows)):
        t, pose = k * DT, place.pose(x)
        if t >= due - 1e-9:
            touches, state = place.history.step([Contact(tool, pose)], state, t - told)
            under_way.append((t + late, local_contacts(place.history, touches, state)[0]))
            told, due = t, due + 1 / RATE
        while under_way and under_way[0][0] <= t + 1e-9:
            loop.update(under_way.pop(0)[1])
        wrench = -loop.step(pose, DT)
        book.add(pose, wrench)
        v = v + DT / MASS * (wrench[:3] + control(t, x, v, wrench[:3], place) - BRAKE * v)
        x = x + DT * v
        rows[k] = t, wrench[:3] @ place.out, (x - place.point) @ place.out
    time, force, height = rows.T
    return Run(time, force, height, book)


def smooth(s: float) -> float:
    """0 to 1, at rest at both ends."""
    s = min(max(s, 0.0), 1.0)
    return s * s * s * (10 - 15 * s + 6 * s * s)


def main() -> None:
    """Prints a row for each limb, tissue, delay and controller."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--limbs", nargs="+", default=["left_forearm", "left_thigh"])
    given.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    given.add_argument("--late", nargs="+", type=float, default=list(DELAYS), help="delays of the models [s]")
    given.add_argument("--bare", action="store_true", help="models as they come, without the balance of energy")
    options = given.parse_args()
    print("limb           skin             late   controller    force held      peak    put in   came back   gained")
    for part in options.limbs:
        layer = living(Body.anny(), part, edge_length=4e-3)
        vertex = Site.thickest(layer).vertex
        for kind in options.kinds:
            series, friction = KINDS[kind]
            skin = layer if series is None else layer.with_(tissue=layer.tissue.relaxing(series))
            place = Place.of(skin, vertex, friction)
            for late in options.late:
                todo: list[tuple[str, Control, tuple[float, float]]] = [
                    *((f"{k:5.0f} N/m", impedance(k), (0.9, 1.1)) for k in IMPEDANCES),
                    *((f"{f:5.0f} N  ", ForceControl(f), (1.6, RELEASE)) for f in FORCES)]  # fmt: skip
                for name, control, when in todo:
                    one = run(place, control, late, Bare() if options.bare else PassiveContact(MOST_DAMPING))
                    held, book = one.during(*when), one.book
                    back = 1 - book.held / book.most
                    print(f"{part:14} {kind:16} {1e3 * late:3.0f} ms {name}  {held.mean():7.2f} ± {held.std():5.2f} N "
                          f"{one.force.max():7.1f} N {1e3 * book.most:7.1f} mJ {100 * back:8.1f} % "
                          f"{100 * one.gained:8.2f} %", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
