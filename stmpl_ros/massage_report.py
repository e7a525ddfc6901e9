"""What a recorded massage shows first: film, force against its set-point, energy, rate kept, as HTML."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from bags.compare import Comparison
from bags.page import image, inside, table, text
from bags.run import NANO
from bags.survey import survey
from bags.wire import stamp_ns
from stmpl_core.touch import Touch
from stmpl_ros.parameters import RobotConfig
from stmpl_ros.robot import LOG, TOOL, scene_of
from stmpl_sim.verbs import course_left, force_missed, gripped, held

if TYPE_CHECKING:
    from bags.frame import Frame
    from stmpl_sim.film import Film, Shot
    from stmpl_sim.massage import Log
    from stmpl_sim.scene import Scene

FILM = "film.webp"
FILM_RATE = 12.0  # frames a second
LARGEST_GAIN = 0.01  # energy that the contact gave out beyond what was put in, over what was stored
AROUND_S = 8e-3  # time within which the simulator's force counts, two of its steps at 250 Hz [s]
LARGEST_APART = 0.01  # difference of the node's force from the simulator's, over the largest
LARGEST_SQUEEZE = 0.05  # difference of the mean force of the fingers from what was asked for, over that
LARGEST_OFF = 0.05  # difference of the answers' force from the reference's at a frame, over that [-]
LEAST_LIFT_M = 0.005  # height that a gripped limb must be lifted by
LARGEST_FINGERS_APART = 0.05  # as LARGEST_APART, for fingers: their friction follows from all answers before
INK, ASKED, NODE, WRIST, TRUTH, FINGER = "#2b2b2b", "#9a9a9a", "#c1440e", "#7aa6c2", "#1f4e79", "#3d8b5f"


class Solved(NamedTuple):
    """Force at a compared frame.

    Args:
        at: time since the start [s].
        reference: force of the reference [N].
        ours: force of the answer [N].
        bound: bound that the answer states of its error [N]; NaN: none.
        alike: whether both sides have friction and relaxation, or neither; else their difference is no error.
    """

    at: float
    reference: float
    ours: float
    bound: float
    alike: bool = True

    @property
    def off(self) -> float:
        """Difference of the answer's force from the reference's, over that [-]."""
        return self.ours / self.reference - 1

    @property
    def stated(self) -> bool:
        """Whether the answer states that it may be so far off."""
        return abs(self.ours - self.reference) <= self.bound

    def __str__(self) -> str:
        bound = f"±{100 * self.bound / self.ours:.0f} %" if self.bound < np.inf else "no bound"
        return (f"at {self.at:.1f} s the force is {100 * self.off:+.1f} % off finite elements ({self.ours:.2f} for "
                f"{self.reference:.2f} N; it states {bound})")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Massaged:
    """A recorded massage, put together from the recording and the robot's own log.

    Args:
        log: log of the robot.
        answered: times of the node's answers since the start [s], (N,), and the forces that they say [N], (N,).
        gripped: times of those of the node's answers with both fingers in the skin [s], (G,), and the forces that they
            say of each, friction included [N], (G, 2).
        measured: times and forces of the wrist's sensor, as recorded, (M,) each.
        solved: forces at the compared frames.
        real_time: simulated time over real time, from the first recorded pose to the last [-].
        poses: rate of the recorded poses by the recorder's clock [Hz].
        film: film of it.
    """

    log: Log
    answered: tuple[np.ndarray, np.ndarray]
    gripped: tuple[np.ndarray, np.ndarray]
    measured: tuple[np.ndarray, np.ndarray]
    solved: tuple[Solved, ...]
    real_time: float
    poses: float
    film: Film

    @property
    def apart(self) -> float:
        """Largest difference of the node's force from the simulation's within AROUND_S while a force is held, over the
        largest force [-].

        Where a tool lifts, the force falls by a third from one step of the simulation to the next. What either gives
        back then is bounded by what it was told of the way (Touch.passive), and the node does not get every step.
        """
        times, forces = self.answered
        ends = [self.log.time[rows][[0, -1]] for _, rows in held(self.log)]
        holding = np.any([(times >= first) & (times <= last) for first, last in ends], axis=0)
        times, forces = times[holding], forces[holding]
        size = np.linalg.norm(self.log.wrench[:, :3], axis=1)
        felt = np.array([np.interp(times + late, self.log.time, size) for late in (-AROUND_S, 0.0, AROUND_S)])
        return _apart(forces, np.clip(forces, felt.min(axis=0), felt.max(axis=0)))

    @property
    def fingers_apart(self) -> float:
        """The same of the forces of the fingers [-]."""
        return _apart(self.gripped[1], self.squeezed)

    @property
    def judged(self) -> tuple[Solved, ...]:
        """Forces at those of the compared frames whose reference is of the same skin."""
        return tuple(one for one in self.solved if one.alike)

    @property
    def squeezed(self) -> np.ndarray:
        """Forces between fingers and skin in the simulation, at the times of `gripped`, (G, F) [N]."""
        sizes = np.linalg.norm(self.log.fingers[..., :3], axis=-1)
        return np.array([np.interp(self.gripped[0], self.log.time, one) for one in sizes.T]).T

    @property
    def gained(self) -> float:
        """Energy that the contact gave out beyond what was put in, over what was stored [-]."""
        most = float(self.log.energy.max())
        return -float(self.log.energy[-1]) / most if most > 0 else 0.0

    def complaints(self) -> Iterator[str]:
        """What is not sane, one sentence each."""
        yield from force_missed(self.log)
        if grip := gripped(self.log):
            if abs(grip["mean_N"] - grip["asked_N"]) > LARGEST_SQUEEZE * grip["asked_N"]:
                yield f"the fingers gripped with {grip['mean_N']:.2f} N of {grip['asked_N']:g} N"
            if grip["lifted_m"] < LEAST_LIFT_M:
                yield f"the fingers lifted the limb by {1e3 * grip['lifted_m']:.1f} mm only"
            if not len(self.gripped[0]):
                yield "the node answered no contact of both fingers"
            elif self.fingers_apart > LARGEST_FINGERS_APART:
                yield f"the node's fingers feel up to {100 * self.fingers_apart:.1f} % else than the simulation's"
            if grip["given_out_J"] > LARGEST_GAIN * grip["stored_J"]:
                yield "the grip gave out more energy than was put in"
        yield from (str(one) for one in self.judged if abs(one.off) > LARGEST_OFF and not one.stated)
        if self.apart > LARGEST_APART:
            yield f"the node's force is up to {100 * self.apart:.1f} % off the simulation's"
        if self.gained > LARGEST_GAIN:
            yield f"the contact gave out {100 * self.gained:.1f} % more energy than was put in"

    def remarks(self) -> Iterator[str]:
        """What is farther off than one would wish, and said so, one sentence each."""
        yield from (str(one) for one in self.judged if abs(one.off) > LARGEST_OFF and one.stated)
        if unlike := len(self.solved) - len(self.judged):
            yield (f"the force of {unlike} compared frames is not held to finite elements: those have neither friction "
                   "nor relaxation, and the run has")  # fmt: skip
        yield from course_left(self.log)
        yield from self.log.notes


def filmed(folder: Path, config: RobotConfig) -> Film:
    """Makes the film of a run from the recorded answers, and what moved the robot from its own log.

    Args:
        folder: folder of the run.
        config: settings of the robot.
    """
    from stmpl_sim.film import film
    from stmpl_sim.massage import Log

    run, log = survey(folder).bag, Log.load(folder / LOG)
    start, due, shots = min(run.pose_stamps), 0.0, []
    scene = scene_of(config, run.layer)
    for frame in run.frames():
        at = (frame.stamp_ns - start) * NANO
        if due <= at <= log.time[-1]:
            shots.append(_shot(scene, log, at, frame))
            due = max(due + 1 / FILM_RATE, at)
    most = 0.5 * float(run.layer.thickness[scene.site.vertex])
    return film(scene.model, run.layer, shots, folder / FILM, most=most, rate=FILM_RATE)


def massaged(folder: Path, comparison: Comparison, film: Film) -> Massaged:
    """Puts a massage together.

    Args:
        folder: folder of the run.
        comparison: comparison of the run.
        film: film of the run.

    Raises:
        BagError: a recording that lacks what a massage has.
    """
    from stmpl_sim.grip import FINGERS
    from stmpl_sim.massage import Log

    run, log = comparison.run.bag, Log.load(folder / LOG)
    start, last = min(run.pose_stamps), max(run.pose_stamps)
    answered, squeezed = [], []
    for frame in run.frames():
        at = (frame.stamp_ns - start) * NANO
        if TOOL in frame.touches and frame.fade == 1:
            answered.append((at, _size(frame.touches[TOOL])))
        fingers = [frame.touches[name] for name in FINGERS if name in frame.touches and frame.touches[name].presses]
        if len(fingers) == len(FINGERS) and frame.fade == 1:
            squeezed.append((at, *map(_size, fingers)))
    took = (max(run.received[last]) - max(run.received[start])) * NANO
    return Massaged(
        log=log,
        answered=_columns(answered),
        gripped=(np.array([one[0] for one in squeezed]), np.array([one[1:] for one in squeezed]).reshape(-1, 2)),
        measured=_columns([((stamp_ns(message) - start) * NANO, _length(message.wrench.force))
                           for _, message, _ in run.messages(lambda topic: topic.endswith("wrist/wrench"))]),
        solved=_solved(comparison, start),
        real_time=(last - start) * NANO / took,
        poses=(len(run.pose_stamps) - 1) / took,
        film=film,
    )  # fmt: skip


def _size(touch: Touch) -> float:
    """Size of the force of a touch [N]."""
    return float(np.linalg.norm(touch.wrench[:3]))


def _apart(ours: np.ndarray, felt: np.ndarray) -> float:
    top = float(felt.max(initial=0.0))
    return float(np.abs(ours - felt).max()) / top if top > 0 else 0.0


def front(done: Massaged, limb: str) -> str:
    """HTML that a report opens with; `limb` is what is massaged."""
    drawn = " Drawn in software: there is no GL here." if done.film.frames_by == "software" else ""
    hardest = done.film.colour_pa
    pressed = "" if hardest is None else (f" Below, the skin from above and without the tools: pressure up to "
                                          f"{1e-3 * hardest:.0f} kPa.")  # fmt: skip
    forces = sorted({phase.force for phase, _ in held(done.log)})
    said = " and ".join(f"{force:g}" for force in forces)
    return "\n".join([
        f"<h1>A robot massages a {text(limb.replace('_', ' '))} with {said} N</h1>",
        inside("image/webp", done.film.path.read_bytes()),
        f"<p class=note>The robot as its simulator moved it, the skin as the node answered it over ROS: coloured by "
        f"displacement, from none to {1e3 * done.film.colour_m:.0f} mm, not exaggerated.{pressed}{drawn}</p>",
        "<h2>Force, energy, rate</h2>",
        image(course_figure(done)),
        *(f"<p class=note>{kind}: {text(said)}.</p>" for kind, sentences in (
            ("Not as it should be", done.complaints()), ("To note", done.remarks())) for said in sentences),
        table(("phase", "asked N", "kept N", "worst N", "depth mm", "off course mm", "in range %"), _phases(done)),
        table(("measured", "value"), rows(done)),
    ])  # fmt: skip


def rows(done: Massaged) -> list[tuple[str, str]]:
    """Figures of a massage as a whole, name and value with unit."""
    log = done.log
    off = max((float(log.off[judged].max()) for _, judged in held(log)), default=0.0)
    figures = [
        ("highest force", f"{log.force.max():.2f} N"),
        ("off course", f"at most {1e3 * off:.2f} mm along the skin while a force was held"),
        ("node's force off the simulation's while held", f"at most {100 * done.apart:.2f} % of the highest"),
        ("energy stored in the skin", f"{1e3 * log.energy.max():.2f} mJ at most"),
        ("given out beyond what was put in", f"{100 * done.gained:+.1f} % of that (below 0: lost)"),
        ("physics and contact", f"{1 / (log.time[1] - log.time[0]):.0f} Hz"),
        ("poses over ROS", f"{done.poses:.0f} Hz; the simulation ran at {done.real_time:.2f} of real time, which it "
         "does not exceed"),
    ]  # fmt: skip
    if grip := gripped(log):
        figures[1:1] = [
            ("grip of two fingers", f"{grip['mean_N']:.2f} ± {grip['deviation_N']:.2f} N each, {grip['asked_N']:g} N "
             f"asked; they carried {grip['carried_N']:.1f} N and lifted the limb by {1e3 * grip['lifted_m']:.0f} mm"),
            ("node's forces of the fingers off the simulation's", f"at most {100 * done.fingers_apart:.2f} % of the "
             f"highest, in {len(done.gripped[0])} answers with both"),
            ("energy of the grip", f"{1e3 * grip['stored_J']:.0f} mJ at most, {-1e3 * grip['given_out_J']:.0f} mJ "
             "lost to friction"),
        ]  # fmt: skip
    if done.judged:
        told = ", ".join(f"{100 * one.off:+.1f}" for one in done.judged)
        bounds = [100 * one.bound / one.ours for one in done.judged if one.bound < np.inf and one.ours > 0]
        stated = f"±{max(bounds):.0f} % stated" if len(bounds) == len(done.judged) else "not all with a bound"
        figures.insert(1, ("force off finite elements", f"{told} % at the compared frames, {stated}"))
    return figures


def course_figure(done: Massaged) -> Figure:
    """Force against its set-point, and the energy that the skin holds, over time."""
    log = done.log
    figure = Figure(figsize=(10.5, 5.4), layout="constrained")
    force, energy = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    force.plot(*done.measured, color=WRIST, lw=1.0, label="measured at the wrist (recorded)")
    force.plot(*done.answered, color=NODE, lw=1.4, label="the node's answers (recorded)")
    force.plot(log.time, log.asked, color=INK, lw=1.2, ls="--", label="asked for")
    for name, one in zip(("fingers, simulated", None), np.linalg.norm(log.fingers[..., :3], axis=-1).T, strict=False):
        force.plot(log.time, one, color=FINGER, lw=1.0, label=name)
    force.plot(np.repeat(done.gripped[0], done.gripped[1].shape[1]), done.gripped[1].ravel(), ".", color=NODE, ms=2)
    if done.solved:
        solved = _columns([(one.at, one.reference) for one in done.solved])
        force.plot(*solved, "o", color=TRUTH, ms=6, label="finite elements" if len(done.judged) == len(done.solved) else
                   "finite elements, elastic and without friction")  # fmt: skip
    force.set(ylabel="force [N]", ylim=(0, None))
    energy.plot(log.time, 1e3 * log.energy, color=INK, lw=1.2)
    energy.set(ylabel="energy held by the skin [mJ]", xlabel="time [s]")
    for axes in (force, energy):
        for phase in log.phases:
            axes.axvline(phase.start, color=ASKED, lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    top = force.get_ylim()[1]
    for phase in log.phases:
        force.text(phase.start + 0.05, 1.01 * top, phase.name, fontsize=9, color=INK, va="bottom")
    force.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0.0, 0.96))
    return figure


def _shot(scene: Scene, log: Log, at: float, frame: Frame) -> Shot:
    from stmpl_sim.engine import mujoco
    from stmpl_sim.film import Shot, caption_of

    data, row = mujoco.MjData(scene.model), min(int(np.searchsorted(log.time, at)), len(log.time) - 1)
    data.qpos[:] = log.qpos[row]
    mujoco.mj_forward(scene.model, data)
    limb = log.limb[row]
    points = (scene.layer.vertices + frame.displacement) @ limb[:3, :3].T + limb[:3, 3]
    return Shot(data, points, limb, frame.magnitude, frame.pressure, caption_of(at, frame.touches))


def _solved(comparison: Comparison, start: int) -> tuple[Solved, ...]:
    key, found = f"{TOOL}.normal_n", []
    for pair in comparison.judged:
        if key in (forces := pair.reference.trust.figures):
            at, touch = (pair.frame.stamp_ns - start) * NANO, pair.frame.touches[TOOL]
            found.append(Solved(at, abs(forces[key]), touch.force, touch.force_bound, pair.alike))
    return tuple(found)


def _columns(pairs: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.array(pairs, dtype=float).reshape(-1, 2).T
    return first, second


def _length(v: Any) -> float:
    return float(np.linalg.norm([v.x, v.y, v.z]))


def _phases(done: Massaged) -> list[tuple[str, ...]]:
    shown = []
    for phase, judged in held(done.log):
        force, log = done.log.force[judged], done.log
        shown.append((phase.name, f"{phase.force:.1f}", f"{force.mean():.2f} ± {force.std():.2f}",
                      f"{np.abs(force - phase.force).max():.2f}", f"{1e3 * np.nanmean(log.depth[judged]):.1f}",
                      f"{1e3 * log.off[judged].max():.2f}", f"{100 * log.trusted[judged].mean():.0f}"))  # fmt: skip
    return shown
