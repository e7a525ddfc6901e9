"""08 A haptic loop: a device at 1 kHz between answers that come at 100 Hz.

Purpose: a hand feels what changes a thousand times a second; a model to first order fills the gaps.
Shows: `local_contact` (reaction, stiffness, how far it holds) and `DeviceLoop` (force, energy balance).

    .venv/bin/python examples/08_a_haptic_loop.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.haptics import DeviceLoop, LoopSettings
from stmpl_core.local_contact import local_contact
from stmpl_core.methods import MomentNet

RADIUS, SPEED, TICK = 12e-3, 0.01, 1e-3  # m, m/s, s


def main() -> float:
    """Force on the device after 0.3 s, along the skin's normal [N]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    simulator = Simulator(layer, MomentNet())
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    tool = Tool("stylus", ball.vertices, ball.faces)
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    outward = layer.normals[middle]

    loop = DeviceLoop(LoopSettings(coupling_stiffness=200.0))
    away, force = 1e-3, np.zeros(3)  # m over the skin
    for millisecond in range(300):
        device = layer.vertices[middle] + (RADIUS + away) * outward
        if millisecond % 10 == 0:  # beside the node, 100 times a second: where the tool rests, not where the device is
            pose = np.eye(4)
            pose[:3, 3] = loop.proxy if millisecond else device
            loop.update(local_contact(simulator.toucher, Contact(tool, pose)))
        force = loop.step(device, -SPEED * outward, TICK)  # beside the device, every millisecond
        away -= SPEED * TICK

    print(f"{-1e3 * away:.1f} mm deep the device feels {force @ outward:.4f} N")
    print(f"energy that the loop still holds: {1e6 * loop.balance:+.2f} uJ (below 0 it would have given some out)")
    return float(force @ outward)


if __name__ == "__main__":
    main()
