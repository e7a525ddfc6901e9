"""Compiles what nodes and replays share before two processes do so at once, whose sums then differ in the last bits.

python -m tests.warm
"""

from __future__ import annotations

import numpy as np

from stmpl_core import Contact, State
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.local_contact import local_contact
from stmpl_core.methods import MomentNet
from stmpl_core.regions import HELD_SKIN
from stmpl_core.simulator import Simulator
from tests.scenes import at, ball, box, limb


def main() -> None:
    """Touches by pose and wrench, with and without a state, answers and models, on one material and on a stack."""
    plain = limb(4e-3, 7.5e-3)
    stack = living(Body.anny(), "left_forearm", edge_length=6e-3)
    for layer in (plain, stack):
        vertex = int(np.argmin(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1)))
        middle, out = layer.vertices[vertex], layer.normals[vertex]
        skin = layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN))
        for one, friction in ((layer, None), (skin, 0.3)):
            for tool in (ball(0.01), box(0.02, 0.02, 0.02)):
                simulator, state = Simulator(one, MomentNet(), friction=friction), State()
                for depth in (1e-3, 3e-3, 2e-3):
                    pose = at(*(middle + (0.01 - depth) * out))
                    for wrench in (None, np.concatenate([-0.2 * out, np.zeros(3)])):
                        contact = Contact(tool, pose, wrench)
                        simulator.answer(simulator.touch([contact]))
                        touches, state = simulator.touch([contact], state, 0.01)
                        simulator.answer(touches)
            local_contact(simulator.toucher, Contact(ball(0.01), at(*(middle + 8e-3 * out))))


if __name__ == "__main__":
    main()
