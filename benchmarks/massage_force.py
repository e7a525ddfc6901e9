"""The ball of `make demo` on its circle along the forearm: what its force off finite elements consists of.

    .venv/bin/python -m benchmarks.massage_force                # four places of the circle; about five minutes
    .venv/bin/python -m benchmarks.massage_force --finer        # one place, by finite elements of other settings

At each place the ball stands as deep as the law carries 5 N, and at shares of the thickness before. Printed are the
force of finite elements that stick, what of it pressures along the skin's normals at rest make, and how far off are
the limb's linear response and the law.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from benchmarks.living_limbs import ball
from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.rigid import STACK_STEP
from stmpl_core import Contact, SoftLayer
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_sim.site import Circle, Site

RADIUS, CIRCLE, FORCE = 0.02, 0.012, 5.0  # of the ball and of its circle [m]; N
ANGLES = (0, 90, 180, 270)  # places on the circle [degrees]
SHARES = (0.05, 0.1, 0.2, 0.35)  # depths before the last, over the thickness
REACH = 5.0  # of the patch [thicknesses]: 9, as the demo has it, is the whole forearm
DEMO: dict[str, Any] = {"element": "P1xP2", "layers": 1}  # fem_tools.RigidFem on a stack
FINER: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # settings of the patch, and of the press
    "as the demo": ({}, {}),
    "refined where the ball is curved": ({"refine": 3}, {}),
    "half the step": ({}, {"step": STACK_STEP / 2}),
    "the whole forearm": ({"reach": 9.0}, {}),
    "two wedges through the fat": ({"layers": 2}, {}),
    "quadratic in plane": ({"element": "P2xP2"}, {}),
    "without friction": ({}, {"friction": "none"}),
}


class Place:
    """A place of the circle: the ball above it, and the depths that it is pressed to [m]."""

    def __init__(self, simulator: Simulator, circle: Circle, angle: float) -> None:
        here, self.layer = circle.at(np.deg2rad(angle)), simulator.layer
        self.normal, pose = here.normal, np.eye(4)
        pose[:3, 3] = here.point + (RADIUS + 5e-3) * here.normal
        start = Press(SignedDistance.of(ball(RADIUS), margin=0.04), pose, -here.normal).touching(self.layer)
        assert start is not None
        self.start = start
        near = np.linalg.norm(self.layer.vertices - here.point, axis=1).argmin()
        self.thickness = float(self.layer.thickness[near])
        low = start.at(0.3 * self.thickness).pose_body_from_tool
        (touch,) = simulator.touch([Contact(ball(RADIUS), low, np.concatenate([-FORCE * here.normal, np.zeros(3)]))])
        way = (touch.pose_body_from_tool - start.pose_body_from_tool)[:3, 3]
        self.depths = [share * self.thickness for share in SHARES] + [float(way @ start.direction)]

    def solved(self, patch: dict[str, Any], press: dict[str, Any]) -> list[tuple[float, float]]:
        """Force along the way, and what of it pressures along the normals at rest make [N], at each depth.

        Not a number where Newton stopped before.
        """
        fem = PatchFem(**({"reach": REACH, "check_stability": False} | DEMO | patch))
        walk = IndenterFem(fem, **({"step": STACK_STEP} | press)).prepare(self.layer).path([self.start], self.depths)
        areas, none = self.layer.vertex_area_vectors, (float("nan"), float("nan"))
        found = [(one.force, float(-(one.pressure @ areas) @ self.start.direction)) if one.trust.converged else none
                 for one in walk]  # fmt: skip
        return found + [none] * (len(self.depths) - len(found))


def laws(simulator: Simulator, place: Place, depth: float) -> tuple[float, float]:
    """Forces along the way of the linear response and of the law [N]."""
    (touch,) = simulator.touch([Contact(ball(RADIUS), place.start.at(depth).pose_body_from_tool)])
    assert touch.pressed is not None
    nodes, modulus = touch.pressed.squeeze.nodes, simulator.layer.tissue.youngs_modulus
    linear = modulus * simulator.toucher.net.look(nodes).pressure * nodes.area
    return float(linear @ (nodes.inward @ place.start.direction)), float(touch.wrench[:3] @ place.start.direction)


def forearm() -> SoftLayer:
    """The skin of the demo."""
    return living(Body.anny(), "left_forearm")


def main() -> None:
    """Presses and prints."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--finer", action="store_true", help="finite elements of other settings at one place")
    options.add_argument("--angles", type=float, nargs="+", default=ANGLES, help="places on the circle [degrees]")
    given = options.parse_args()
    simulator = Simulator(forearm(), MomentNet())
    circle = Site.thickest(simulator.layer).circle(CIRCLE)
    if given.finer:
        place, first = Place(simulator, circle, 90), []
        for name, settings in FINER.items():
            forces = [force for force, _ in place.solved(*settings)]
            first = first or forces
            told = "  ".join(f"{b:7.4f} N ({100 * (b / a - 1):+.1f} %)" for a, b in zip(first, forces, strict=True))
            print(f"{name:34} {told}", flush=True)
        return
    print("place  depth/t   FEM [N]  by normals   linear      law  (off FEM)")
    for angle in given.angles:
        place = Place(simulator, circle, angle)
        for depth, (force, kept) in zip(place.depths, place.solved({}, {}), strict=True):
            linear, law = (100 * (one / force - 1) for one in laws(simulator, place, depth))
            print(f"{angle:5g} {depth / place.thickness:8.2f} {force:9.4f} {100 * kept / force:9.1f} % "
                  f"{linear:+8.1f} % {law:+7.1f} %", flush=True)


if __name__ == "__main__":
    main()
