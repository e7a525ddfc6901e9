"""01 Press a skin: a pressure goes in, the displacement comes out.

Purpose: the smallest whole use, without a tool and without a robot.
Shows: a limb as a `SoftLayer`, a `Load`, four methods of one protocol, and how far each is off finite elements.

    .venv/bin/python examples/01_press_a_skin.py
"""

import numpy as np

from fem_tools import PatchFem
from stmpl_core import Load
from stmpl_core.body import Body
from stmpl_core.methods import Linear, MomentNet, Winkler


def main() -> float:
    """Largest error of MomentNet at any vertex, over the largest displacement [-]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)  # E = 1 kPa, 7.5 mm thick, unless told otherwise

    # A disc of 20 mm radius in the middle of the limb: 500 Pa, falling to nothing over its outer half.
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    distance = np.linalg.norm(layer.vertices - layer.vertices[middle], axis=1)
    load = Load.pressure(500.0 * np.clip(2 - distance / 0.01, 0, 1))  # (V,) Pa, pressing in

    # The reference: finite elements of half the mesh width, two through the thickness.
    truth = PatchFem(refine=1, layers=2).prepare(layer).solve(load)
    print(f"the skin moves by up to {1e3 * truth.magnitude.max():.2f} mm")

    errors = {}
    for method in (Winkler(), Linear(), MomentNet(), PatchFem()):
        answer = method.prepare(layer).solve(load)  # .displacement (V, 3) [m], .trust
        off = np.linalg.norm(answer.displacement - truth.displacement, axis=1).max() / truth.magnitude.max()
        errors[method.name] = float(off)
        print(f"{method.name:>12}: off by {off:6.1%} at the worst vertex; {answer.trust.why or 'in range'}")
    return errors["moment_net"]


if __name__ == "__main__":
    main()
