"""09 Press evenly: the pose at which a flat head presses a forearm with 10 N, as hard on one side as on the other.

Purpose: a massage head or an ultrasound probe that leans presses with its rim.
Shows: `Gradients.wrench`, whose `pose` is the Jacobian that Newton's method needs, and `twisted`, which takes its step.

    .venv/bin/python examples/09_press_evenly.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.gradients import Gradients, twisted
from stmpl_core.living import living
from stmpl_core.methods import MomentNet

RADIUS, ROUND, WANTED = 15e-3, 3e-3, 10.0  # m, m, N


def main() -> float:
    """Depth at which the head presses evenly with 10 N [m]."""
    layer = living(Body.anny(), "left_forearm", edge_length=6e-3)  # skin, fat and muscle, down to the bones
    gradients = Gradients(Simulator(layer, MomentNet()))

    # A disc with a round rim; the middle of its face is its origin, and it presses along its own -z.
    angle = np.linspace(0, np.pi / 2, 8)
    rim = np.column_stack([RADIUS - ROUND * (1 - np.sin(angle)), ROUND * (1 - np.cos(angle))])
    mesh = trimesh.creation.revolve([(0, 0), *rim, (RADIUS, 0.012), (0, 0.012)], sections=64)
    tool = Tool("head", mesh.vertices, mesh.faces)

    # A first guess: 4 mm deep over a vertex in the middle of the limb, 5 degrees off the skin's normal.
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    outward = layer.normals[middle]
    pose = trimesh.geometry.align_vectors([0, 0, 1], outward) @ trimesh.transformations.rotation_matrix(0.09, [1, 1, 0])
    pose[:3, 3] = layer.vertices[middle] - 4e-3 * outward

    for _ in range(8):
        found = gradients.wrench([Contact(tool, pose)], by=("pose",))[0]
        across, along, push = pose[:3, :3].T * [[1], [1], [-1]]
        force, torques = found.wrench[:3] @ push, np.array([across, along]) @ found.wrench[3:]
        aside = np.linalg.norm(torques) / force
        print(f"{force:6.2f} N, with its centre {1e3 * aside:.3f} mm off the middle; {found.trust.why or 'in range'}")
        if abs(force - WANTED) < 1e-3 and aside < 1e-5:
            break

        # Three ways to move: along the push, and two tilts. Three wishes: the force, and no torque about the face.
        ways = np.zeros((6, 3))
        ways[:3, 0], ways[3:, 1], ways[3:, 2] = push, across, along
        slopes = np.vstack([push @ found.pose[:3], [across, along] @ found.pose[3:]]) @ ways
        step = np.linalg.solve(slopes, [WANTED - force, *-torques])
        pose = twisted(pose, ways @ (step * min(1.0, 3e-3 / abs(step[0]))))  # no more than 3 mm at once

    return float(gradients.simulator.touch([Contact(tool, pose)])[0].depth)


if __name__ == "__main__":
    main()
