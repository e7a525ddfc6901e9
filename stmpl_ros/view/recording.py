"""Recording: instants of a bag, evenly over it, and the slider that goes through them."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bags.compare import Comparison
from bags.frame import Frame
from bags.pictures import spot_of
from bags.run import Run
from bags.survey import Survey, survey
from stmpl_core.contact import Contact
from stmpl_core.errors import BagError
from stmpl_core.layer import SoftLayer
from stmpl_ros.view.judge import Judge
from stmpl_ros.view.page import Page
from stmpl_ros.view.snapshot import Gauge, Snapshot, readings_of

TICK = 0.05  # time between two steps of the play button [s]
SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}


@dataclass(frozen=True, eq=False)
class Recording:
    """Some instants of a run, in the order of time, and the layer that each is of."""

    name: str
    layers: tuple[SoftLayer, ...]
    snapshots: tuple[Snapshot, ...]

    @classmethod
    def of(cls, run: Path | str | Survey, frames: int, *, compared: Comparison | None = None) -> Recording:
        """Reads `frames` instants evenly over a bag, and those that a comparison of it solved.

        Args:
            run: recording: its folder, its .mcap file, or what a survey of it gave.
            frames: number of frames to show.
            compared: comparison of this recording.

        Raises:
            BagError: a file that is no recording, or has no answers or no skin.
        """
        run = run if isinstance(run, Survey) else survey(run)
        judged = {} if compared is None else {pair.number: pair.reference for pair in compared.judged}
        even = np.linspace(0, len(run.moments) - 1, min(frames, len(run.moments))).round().astype(int).tolist()
        numbers = sorted({*even, *judged})
        gauge: Gauge | None = None
        shown: list[tuple[Snapshot, SoftLayer]] = []
        for number, frame in zip(numbers, run.bag.frames(numbers), strict=True):
            layer = run.bag.rest_of(frame)
            if gauge is None or shown[-1][1] is not layer:
                gauge = Gauge(layer)
            shown.append((replace(_snapshot(run, number, frame, gauge), reference=judged.get(number)), layer))
        shown.sort(key=lambda one: one[0].time)
        snapshots, layers = zip(*shown, strict=True)
        return cls(str(run.bag.file), layers, snapshots)

    @property
    def layer(self) -> SoftLayer:
        """Layer of the first instant."""
        return self.layers[0]

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.snapshots[-1].time

    def nearest(self, time: float) -> int:
        """Number of the instant that is nearest to `time` [s]."""
        return int(np.abs([snapshot.time - time for snapshot in self.snapshots]).argmin())


class RecordingPlayer:
    """A recording on a page: time slider, play button, speed.

    Args:
        page: page that shows it.
        recording: recording that it shows.
    """

    def __init__(self, page: Page, recording: Recording) -> None:
        self.page, self.recording = page, recording
        self.snapshots = list(recording.snapshots)
        gui = page.server.gui
        page.show_layer(recording.layer)
        end = max(recording.seconds, 1e-3)
        with page.controls:
            self._slider = gui.add_slider(
                "Time [s]", 0.0, round(end, 3), 1e-3, 0.0, marks=_marks(self.snapshots), hint="Dots: solved by FEM"
            )
            self._play = gui.add_button("Play")
            self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1")
            self.judge = Judge(page, self._keep)
        page.controls.label, page.controls.visible = "Recording", True
        self._slider.on_update(lambda _: self.show(self._slider.value))
        self._play.on_click(lambda _: self.toggle())
        self._playing, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="playing", daemon=True)
        self._thread.start()
        heaviest = max(self.snapshots, key=lambda snapshot: snapshot.force)
        if heaviest.answer.pressure is not None and heaviest.answer.pressure.any():
            spot = spot_of(recording.layers[self.snapshots.index(heaviest)], heaviest.answer.pressure)
            page.look_at(spot.centre, spot.normal)
        self._slider.value = min(round(heaviest.time, 3), round(end, 3))
        self.show(heaviest.time)

    def show(self, time: float) -> None:
        """Shows the instant nearest to `time` [s]."""
        number = self.recording.nearest(time)
        snapshot, layer = self.snapshots[number], self.recording.layers[number]
        if layer is not self.page.layer:
            self.page.show_layer(layer)
        self.page.show_tools(snapshot.contacts)
        self.page.show(snapshot)
        self.page.plot([(s.time, s.force, s.depth, s.peak) for s in self.snapshots], now=snapshot.time)

    def toggle(self) -> None:
        """Plays, or stops playing."""
        if self._playing.is_set():
            self._playing.clear()
        else:
            self._playing.set()
        self._play.label = "Stop" if self._playing.is_set() else "Play"

    def close(self) -> None:
        """Ends its threads."""
        self._closed.set()
        self._playing.set()
        self._thread.join()
        self.judge.close()

    def _keep(self, before: Snapshot, judged: Snapshot) -> None:
        self.snapshots[self.snapshots.index(before)] = judged

    def _run(self) -> None:
        while self._playing.wait() and not self._closed.is_set():
            started = time.monotonic()
            self._closed.wait(TICK)
            passed = (time.monotonic() - started) * SPEEDS[self._speed.value]
            later = self._slider.value + passed
            self._slider.value = round(later if later < self.recording.seconds else 0.0, 3)


def _marks(snapshots: Sequence[Snapshot]) -> tuple[float, ...] | None:
    return tuple(round(snapshot.time, 3) for snapshot in snapshots if snapshot.reference is not None) or None


def _snapshot(run: Survey, number: int, frame: Frame, gauge: Gauge) -> Snapshot:
    moment = run.moments[number]
    contacts = _contacts(run.bag, frame)
    told = all(np.isfinite(touch.wrench).all() for touch in frame.touches.values())  # older recordings do not
    readings = readings_of(frame) if told or contacts is None else gauge.read(contacts)
    return Snapshot(moment.time, frame, tuple(contacts or ()), readings, moment.solve_seconds, moment.latency)


def _contacts(run: Run, frame: Frame) -> list[Contact] | None:
    """The contacts of an answer; None if the bag lacks one of them."""
    try:
        return run.contacts(frame)
    except BagError:
        return None
