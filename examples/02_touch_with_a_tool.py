"""02 Touch with a tool, by its pose: the reaction first, the deformed skin after it.

Purpose: what a robot without a force sensor does a hundred times a second.
Shows: `Tool`, `Contact`, `Simulator.touch` (six numbers, fast) and `Simulator.answer` (the field).

    .venv/bin/python examples/02_touch_with_a_tool.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.methods import MomentNet

RADIUS, DEPTH = 12e-3, 2e-3  # m


def main() -> float:
    """Size of the force with which the ball presses [N]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    simulator = Simulator(layer, MomentNet())

    # Any closed triangle mesh is a tool, in its own frame, in metres.
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    tool = Tool("ball", ball.vertices, ball.faces)
    simulator.tools.field(tool)  # builds its distance field, once; else the first touch would

    # Where the ball is: 2 mm deep over a vertex in the middle of the limb.
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    pose = np.eye(4)
    pose[:3, 3] = layer.vertices[middle] + (RADIUS - DEPTH) * layer.normals[middle]

    touches = simulator.touch([Contact(tool, pose)])
    touch = touches[0]
    print(f"{touch.name}: {touch.status}, {1e3 * touch.depth:.2f} mm deep, presses with {touch.force:.4f} N, "
          f"give or take {touch.force_bound:.4f} N")

    answer = simulator.answer(touches)  # simulator.step(contacts) does both
    print(f"the skin moves by up to {1e3 * answer.magnitude.max():.2f} mm; to be trusted: {answer.trust.ok}")
    return touch.force


if __name__ == "__main__":
    main()
