"""10 How stiff and how thick: modulus and thickness of a limb's tissue from ten presses, with what they leave open.

Purpose: nobody knows how thick the tissue over a person's bone is; it changes forces as much as its stiffness does.
Shows: `Gradients.wrench` by modulus and thickness in Gauss and Newton's method, and the covariance of what is found.

    .venv/bin/python examples/10_how_stiff_and_how_thick.py
"""

import numpy as np
import trimesh

from stmpl_core import Contact, Simulator, Tool
from stmpl_core.body import Body
from stmpl_core.gradients import Gradients
from stmpl_core.layer import thicker
from stmpl_core.methods import MomentNet

HIDDEN, THICKER = 1400.0, 1.25  # Pa, and times the 7.5 mm that the robot takes at first
NOISE = 0.03  # of each measured force


def main() -> float:
    """Thickness that was found [m]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    person = Simulator(thicker(layer, THICKER).with_(youngs_modulus=HIDDEN), MomentNet())  # plays the person
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    outward, noise = layer.normals[middle], np.random.default_rng(0)

    # A small ball feels the modulus more, a large one the bone below. Poses are known from the skin's surface.
    contacts = []
    for radius in (6e-3, 20e-3):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        tool = Tool(f"ball of {1e3 * radius:g} mm", ball.vertices, ball.faces)
        for depth in np.linspace(0.75e-3, 3.75e-3, 5):
            pose = np.eye(4)
            pose[:3, 3] = layer.vertices[middle] + (radius - depth) * outward
            contacts.append(Contact(tool, pose))
    forces = np.array([-outward @ person.touch([one])[0].wrench[:3] for one in contacts])
    measured = forces * (1 + NOISE * noise.normal(size=len(forces)))

    modulus, factor = layer.tissue.youngs_modulus, 1.0
    for _ in range(3):
        robot = Gradients(Simulator(thicker(layer, factor).with_(youngs_modulus=modulus), MomentNet()))
        told = [robot.wrench([one], by=("modulus", "thickness"))[0] for one in contacts]
        law, stiffer, deeper = (-np.array([getattr(one, by) @ [*outward, 0, 0, 0] for one in told])
                                for by in ("wrench", "modulus", "thickness"))  # fmt: skip
        slopes = np.column_stack([stiffer, deeper / factor]) / (NOISE * measured)[:, None]  # in standard deviations
        modulus, factor = [modulus, factor] + np.linalg.lstsq(slopes, (measured - law) / (NOISE * measured))[0]
        covariance = np.linalg.inv(slopes.T @ slopes)
        errors = np.sqrt(np.diag(covariance))
        print(f"E = {modulus:.0f} +- {errors[0]:.0f} Pa, {7.5 * factor:.2f} +- {7.5 * errors[1]:.2f} mm thick, "
              f"the two correlated by {covariance[0, 1] / errors.prod():.2f}")  # fmt: skip
    print(f"hidden: E = {HIDDEN:g} Pa, {7.5 * THICKER:g} mm")
    return 7.5e-3 * factor


if __name__ == "__main__":
    main()
