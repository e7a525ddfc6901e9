"""Reactions on one thread and fields on another, of one skin, are to the bit what one thread finds."""

import threading
from collections.abc import Callable

import numpy as np
import pytest

from stmpl_core import Contact, Membrane, Ply, Prony, Simulator, SoftLayer, State, Tissue, Touch
from stmpl_core.bones import Bone, to_bone
from stmpl_core.methods import MomentNet
from tests.scenes import LENGTH, RADIUS, at, ball, limb

BALL, STEPS = ball(0.012), 25
SERIES = Prony((0.2, 0.2), (0.3, 4.0))


def one_material() -> SoftLayer:
    return limb(4e-3, youngs_modulus=5e3)


def stack() -> SoftLayer:
    tissue = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 20.0), deeper=(Ply(6e-3, 15e3),)).relaxing(SERIES)
    return to_bone(limb(6e-3), [Bone(np.zeros(3), np.array([0, 0, LENGTH]), 0.015)]).with_(tissue=tissue)


@pytest.mark.parametrize("build", [one_material, stack])
def test_touches_and_fields_on_two_threads_are_those_of_one(build: Callable[[], SoftLayer]) -> None:
    touching = Simulator(build(), MomentNet(), friction="dry")
    fields = Simulator(touching.skin, tools=touching.tools)
    poses = [at(RADIUS + 0.012 - 2e-3 - 5e-5 * (k % 7), 0, LENGTH / 2 + 3e-4 * k) for k in range(STEPS)]

    def touched() -> list[list[Touch]]:
        state, out = State(), []
        for pose in poses:
            touches, state = touching.touch([Contact(BALL, pose)], state, 0.01)
            out.append(touches)
        return out

    def moved(told: list[list[Touch]]) -> list[bytes]:
        return [fields.answer(touches).displacement.tobytes() for touches in told]

    told = touched()
    expected = moved(told)
    ended, found = threading.Event(), []

    def on() -> None:
        while not ended.is_set():
            found.append([touch.wrench.tobytes() for touches in touched() for touch in touches])

    beside = threading.Thread(target=on)
    beside.start()
    try:
        assert moved(told) == expected
        assert moved(told) == expected
    finally:
        ended.set()
        beside.join()
    assert all(one == [touch.wrench.tobytes() for touches in told for touch in touches] for one in found)
