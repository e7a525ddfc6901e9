"""Compiles what nodes and replays share before two processes do so at once, whose sums then differ in the last bits.

A first process goes through one material, a second through layers, and each through the other once it is done: what the
other has compiled by then is read from the cache.

python -m tests.warm
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from stmpl_core import Contact, SoftLayer, State
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.local_contact import local_contact
from stmpl_core.methods import MomentNet
from stmpl_core.regions import HELD_SKIN
from stmpl_core.simulator import Simulator
from tests.scenes import at, ball, box, limb


def main() -> None:
    """Starts the second process."""
    with subprocess.Popen([sys.executable, "-m", "tests.warm", "layers"]) as second:
        warm("one material")
        assert second.wait() == 0


def warm(first: str) -> None:
    """Goes through a limb of one material and one of layers."""
    for what in sorted(("one material", "layers"), key=lambda one: one != first):
        layer = limb(4e-3, 7.5e-3) if what == "one material" else living(Body.anny(), "left_forearm", edge_length=6e-3)
        press(layer, what == "layers")


def press(layer: SoftLayer, backwards: bool) -> None:
    """Touches by pose and wrench, with and without a state, answers and models; backwards: the models first."""
    vertex = int(np.argmin(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1)))
    middle, out = layer.vertices[vertex], layer.normals[vertex]

    def model() -> None:
        local_contact(Simulator(layer, MomentNet()).toucher, Contact(ball(0.01), at(*(middle + 8e-3 * out))))

    def touches() -> None:
        for one, friction in ((layer, None), (layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN)), 0.3)):
            for tool in (ball(0.01), box(0.02, 0.02, 0.02)):
                simulator, state = Simulator(one, MomentNet(), friction=friction), State()
                for depth in (1e-3, 3e-3, 2e-3):
                    pose = at(*(middle + (0.01 - depth) * out))
                    for wrench in (None, np.concatenate([-0.2 * out, np.zeros(3)])):
                        contact = Contact(tool, pose, wrench)
                        simulator.answer(simulator.touch([contact]))
                        found, state = simulator.touch([contact], state, 0.01)
                        simulator.answer(found)

    for do in (model, touches) if backwards else (touches, model):
        do()


if __name__ == "__main__":
    if sys.argv[1:]:
        warm(sys.argv[1])
    else:
        main()
