"""04 Two fingers: a limb squeezed from both sides.

Purpose: several tools at once, as a gripper or a hand makes them.
Shows: several contacts in one answer, and the touch of each finger by its name.

    .venv/bin/python examples/04_two_fingers.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.methods import MomentNet

RADIUS, DEPTH = 8e-3, 1.5e-3  # m


def main() -> float:
    """Largest displacement of the skin [m]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    simulator = Simulator(layer, MomentNet())
    tip = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)

    # The second finger stands where a ray from the first one through the limb comes out.
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    way = layer.vertices - layer.vertices[middle]
    along = way @ -layer.normals[middle]
    beside = np.linalg.norm(way + along[:, None] * layer.normals[middle], axis=1)
    opposite = int(np.where(along > 0.02, beside, np.inf).argmin())

    contacts = []
    for name, vertex in (("thumb", middle), ("index", opposite)):
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + (RADIUS - DEPTH) * layer.normals[vertex]
        contacts.append(Contact(Tool(name, tip.vertices, tip.faces), pose))

    answer = simulator.step(contacts)
    for touch in answer.touches.values():
        print(f"{touch.name}: {touch.status}, presses with {touch.force:.4f} N")
    print(f"the skin moves by up to {1e3 * answer.magnitude.max():.2f} mm; to be trusted: {answer.trust.ok}")
    return float(answer.magnitude.max())


if __name__ == "__main__":
    main()
