"""03 Touch with a force: a tool with a force sensor, whose pose is a little off.

Purpose: hand-eye calibration leaves a millimetre; a wrench tells how deep the tool really is.
Shows: `Contact(wrench=...)`, how far the tool was moved to carry it, and what is said when no skin is there.

    .venv/bin/python examples/03_touch_with_a_force.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.methods import MomentNet

RADIUS, PUSH = 12e-3, 0.05  # m, N


def main() -> float:
    """Way that the tool was moved along its force [m]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    simulator = Simulator(layer, MomentNet())
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    tool = Tool("ball", ball.vertices, ball.faces)

    # The pose says that the ball stands 1 mm off the skin; the sensor says that it presses with 0.05 N.
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    outward = layer.normals[middle]
    pose = np.eye(4)
    pose[:3, 3] = layer.vertices[middle] + (RADIUS + 1e-3) * outward
    wrench = np.concatenate([-PUSH * outward, np.zeros(3)])  # on the body, about the tool's origin, in the layer's axes

    answer = simulator.step([Contact(tool, pose, wrench=wrench)])
    touch = answer.touches["ball"]
    print(f"{touch.status}: moved by {1e3 * touch.moved:.2f} mm, it presses with {touch.force:.4f} N; "
          f"the skin moves by {1e3 * answer.magnitude.max():.2f} mm")

    # The same force where there is no skin within reach: refused in words, and nothing moves.
    pose[:3, 3] += 0.05 * outward
    lost = simulator.step([Contact(tool, pose, wrench=wrench)])
    print(f"{lost.touches['ball'].status}; to be trusted: {lost.trust.ok}; {lost.trust.why}")
    return touch.moved


if __name__ == "__main__":
    main()
