"""07 How stiff is it: Young's modulus from presses whose depth and force are both known.

Purpose: nobody knows how stiff a person is; a robot that presses a few times can tell.
Shows: `fit_stiffness`, which finds the modulus and by how much the poses are off. On the node: `~/calibrate`.

    .venv/bin/python examples/07_how_stiff_is_it.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.methods import MomentNet
from stmpl_core.stiffness import fit_stiffness

RADIUS = 12e-3  # m
HIDDEN = 1400.0  # Pa, of the person
OFFSET = 0.5e-3  # m, by which the robot thinks that it stands back


def main() -> float:
    """Young's modulus that was found [Pa]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    person = Simulator(layer.with_(youngs_modulus=HIDDEN), MomentNet())  # plays the person
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    tool = Tool("finger", ball.vertices, ball.faces)
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    outward = layer.normals[middle]

    robot = Simulator(layer, MomentNet())  # knows the shape, and takes E = 1 kPa until it has pressed
    presses = []
    for depth in np.linspace(0.5e-3, 3e-3, 10):
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[middle] + (RADIUS - depth) * outward
        felt = person.touch([Contact(tool, pose)])[0].wrench
        pose[:3, 3] += OFFSET * outward
        presses.append(Contact(tool, pose, wrench=felt))

    found = fit_stiffness(robot.toucher, presses)
    print(f"hidden: E = {HIDDEN:g} Pa, poses off by {1e3 * OFFSET:+.2f} mm")
    print(f"found:  {found}")
    return found.youngs_modulus


if __name__ == "__main__":
    main()
