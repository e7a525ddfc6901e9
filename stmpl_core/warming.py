"""Warming up: all that answers take is compiled before the first is asked for, on two cores where there are."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from concurrent.futures import Future, wait
from copy import copy
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numba.core.event import Event, Listener, register, unregister

from stmpl_core.arrays import Transform
from stmpl_core.compiling import TOLD_EVERY_S
from stmpl_core.contact import Contact
from stmpl_core.contact_net import compile_on_stacks
from stmpl_core.history import compile_steps
from stmpl_core.layer import SoftLayer
from stmpl_core.local_contact import local_contacts
from stmpl_core.methods.zero import Zero
from stmpl_core.pool import Pool
from stmpl_core.simulator import Simulator
from stmpl_core.state import State
from stmpl_core.tool import Tool

log = logging.getLogger(__name__)

TIP = 0.01  # size of the tool that warms up, from its middle to its corners [m]
TOUCHING = 0.009  # height of its middle above the skin at which it touches [m]
WARM_BEND = 0.1  # angle of each joint at which a bent skin is warmed up [rad]


class CompiledAhead(Listener):
    """Compiles in a process beside what is needed later, as soon as a kernel is to be compiled here.

    First how a stack holds a tool, while the skin is made here; then what steps with a memory take; last, once a first
    touch is compiled here, what else touches and local models take. Nothing is done where there is no second core. It
    listens as a context manager, and ends the process then.

    Args:
        stacked: whether there may be a stack.
        steps: whether steps with a memory will be asked for.
        tell: function that gets a sentence once in a while as it is waited for; None: the log does.
    """

    def __init__(self, stacked: bool, steps: bool, tell: Callable[[str], None] | None = None) -> None:
        self._stacked, self._steps, self._tell = stacked, steps, tell or log.info
        self._wanted, self._touched = len(os.sched_getaffinity(0)) > 1, False
        self._pool: Pool | None = None
        self._jobs: list[Future[None]] = []

    def __enter__(self) -> Self:
        register("numba:compile", self)
        return self

    def __exit__(self, *_: object) -> None:
        unregister("numba:compile", self)
        if self._pool is not None:
            self._pool.end()

    def on_start(self, event: Event) -> None:
        """Before a kernel is compiled."""
        if self._wanted:
            self._wanted = False
            self._pool = Pool(1)  # yields to nobody: it is waited for
            for job, wanted in ((compile_on_stacks, self._stacked), (compile_steps, self._steps)):
                if wanted:
                    self._submit(job)

    def on_end(self, event: Event) -> None:
        """After it."""

    def touch(self, simulator: Simulator) -> None:
        """Touches for the first time; what else touches take is compiled beside from then on."""
        self._wanted = False  # what is not on disk yet is compiled here: nobody is ahead any more
        if self._pool is None or self._touched:
            return
        self._touched = True
        if self._stacked:
            self._wait(self._jobs[:1])
        tool, skin = tip(), simulator.skin.rest or simulator.skin
        simulator.touch([_first(simulator.layer, tool)])
        simulator.tools.field(tool).distance_gradient(np.zeros((1, 3)))  # answers and local models take it
        simulator.tools.remove(tool.name)
        self._submit(compile_touches, copy(skin.layer))  # which is pickled while the other may be added to

    def wait(self) -> None:
        """Until all is on disk: what two processes compile at once rounds otherwise in the last bits."""
        self._wanted = False
        self._wait(self._jobs)
        for job in self._jobs:
            if not job.cancelled() and (error := job.exception()):
                log.debug("a process beside did not compile ahead: %r", error)

    def _submit(self, job: Callable[..., None], *arguments: Any) -> None:
        """Has a job done beside, unless that cannot be: then all of it is compiled here."""
        if self._pool is not None:
            try:
                self._jobs.append(self._pool.submit(job, *arguments))
            except (OSError, RuntimeError):
                self._pool.end()
                self._pool = None

    def _wait(self, jobs: list[Future[None]]) -> None:
        while wait(jobs, TOLD_EVERY_S).not_done:
            self._tell("compiling kernels in a process beside; the first time takes minutes, then they are on disk")


def compile_touches(layer: SoftLayer) -> None:
    """Compiles what local models, deep touches and those of two tools take beyond a first touch, which is compiled."""
    simulator, tool, again = Simulator(layer, Zero()), tip(), tip().named("again")
    first = _first(layer, tool)
    local_contacts(simulator.history, simulator.touch([first]))
    for wrench in (None, first.wrench):
        simulator.touch([replace(first, tool=one, wrench=wrench) for one in (tool, again)])
    simulator.touch([Contact(tool, over(layer, middle(layer), TOUCHING - 2 * TIP))])


def warm_up(simulator: Simulator, ahead: CompiledAhead | None = None) -> None:
    """Solves one contact of each kind, so that nothing is left to compile when the first real one comes.

    Where time and friction count, they are one press that slides; where joints bend the skin, all is done bent and at
    rest. The deepest reaches into the core. Of each comes a local model. Last two tools press at one place. All rub as
    the roughest of those whose friction is told.

    Args:
        simulator: simulator to warm up.
        ahead: who compiles a part of it beside.
    """
    frictions = every, some = simulator.history.frictions
    simulator.history.frictions = max(every, *some.values(), 0.0), {}
    tool, rig, state = tip(), simulator.layer.rig, State()
    if ahead:
        ahead.touch(simulator)
    for angles in ([WARM_BEND] * len(rig.joints), ()) if rig else ((),):
        if rig:
            state = simulator.move_to(simulator.skin.at_angles(angles), state)
        state = _press(simulator, tool, state, ahead)
    simulator.tools.remove(tool.name)
    simulator.history.frictions = frictions


def tip() -> Tool:
    """A tool to warm up with: an octahedron whose corners are TIP from its middle."""
    corners = TIP * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    return Tool("warm up", corners, faces)


def middle(layer: SoftLayer) -> int:
    """Vertex that is nearest to the middle of a limb."""
    return int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())


def over(layer: SoftLayer, vertex: int, away: float) -> Transform:
    """Pose (4, 4), not turned, so far above a vertex along its normal [m]."""
    pose = np.eye(4)
    pose[:3, 3] = layer.vertices[vertex] + away * layer.normals[vertex]
    return pose


def _first(layer: SoftLayer, tool: Tool) -> Contact:
    """Pushes gently near the middle of the limb."""
    vertex = middle(layer)
    push = np.concatenate([-0.01 * layer.normals[vertex], np.zeros(3)])
    return Contact(tool, over(layer, vertex, TOUCHING), push)


def _press(simulator: Simulator, tool: Tool, state: State, ahead: CompiledAhead | None) -> State:
    """Touches the skin where it stands, in each way."""
    layer = simulator.layer
    vertex, push = middle(layer), _first(layer, tool).wrench
    deep = -float(layer.thickness[vertex])
    for away, wrench in ((TOUCHING, push), (0.012, push), (TOUCHING, None), (deep, None), (0.05, push)):
        pose = over(layer, vertex, away)
        touches = simulator.touch([Contact(tool, pose, wrench)])
        simulator.answer(touches)
        if ahead:
            ahead.wait()
        local_contacts(simulator.history, touches)
        for way in (0.0, 1e-3) if simulator.remembers else ():
            pose[:3, 3] += way * np.roll(layer.normals[vertex], 1)
            touches, state = simulator.touch([Contact(tool, pose.copy(), wrench)], state, 0.01)
            simulator.answer(touches)
            local_contacts(simulator.history, touches, state)
    pose = over(layer, vertex, TOUCHING)
    again = tool.named(f"{tool.name} again")
    for wrench in (None, push):
        both = [Contact(tool, pose, wrench), Contact(again, pose, wrench)]
        simulator.answer(simulator.touch(both))
        if simulator.remembers:
            touches, state = simulator.touch(both, state, 0.01)
            simulator.answer(touches)
    simulator.tools.remove(again.name)
    return state.without(again.name)
