"""Draws pictures/moving.webp and moving.png: a disc rides on a forearm, a ball presses a triceps, and the elbow bends.

.venv/bin/python docs/draw_moving.py
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from benchmarks.posing import JOINT, RADIUS, SUBDIVISIONS, arm, ball, sites  # noqa: E402
from stmpl_core import Contact, Simulator, Skin, State, Tool  # noqa: E402
from stmpl_core.methods import MomentNet  # noqa: E402
from stmpl_sim.film import colours, draw, save  # noqa: E402

DEEP, MOST = 2.5e-3, 2.5e-3  # depth of both tools; displacement that has the last colour [m]
FRAMES, RATE, BEND = 72, 12.0, np.deg2rad(75)  # of the film; most bend
SPOILT, DISC, BALL = (0.62, 0.72, 0.86), (0.25, 0.3, 0.36), (0.2, 0.42, 0.5)  # colours
STILLS = (0, 18, 36)  # frames of the picture


def disc() -> Tool:
    """A disc of 30 mm across z, 8 mm high, about its own middle."""
    mesh = trimesh.creation.cylinder(15.0, 8.0, sections=64)
    return Tool("disc", 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))


def placed(simulator: Simulator, vertex: int, slide: float, lift: float) -> np.ndarray:
    """Pose of a tool on the skin, its z along the normal, `slide` along the skin and `lift` above it [m]."""
    frame = simulator.skin.near.frames[vertex]
    pose = np.eye(4)
    pose[:3, :3] = frame.T
    pose[:3, 3] = simulator.layer.vertices[vertex] + slide * frame[0] + lift * frame[2]
    return pose


def main() -> None:
    """Plays, draws, writes."""
    layer, rig = arm()
    simulator, state = Simulator(Skin.of(layer, MomentNet()), friction=0.4), State()
    places, tools = sites(layer, rig), (disc(), ball(RADIUS, SUBDIVISIONS))
    elbow, axis = rig.heads[1], np.array(rig.joints[0].axis)
    back = -axis
    up = np.array([0.0, 0, 1]) - back[2] * back
    up /= np.linalg.norm(up)
    turn = np.stack([np.cross(up, back), up, back], axis=1)
    eye = elbow + 0.7 * back - 0.08 * turn[:, 0] + 0.05 * turn[:, 1]
    frames = []
    for k in range(FRAMES):
        bend = BEND * np.sin(np.pi * k / FRAMES) ** 2
        state = simulator.pose({JOINT: bend}, state)
        slide = 0.015 * np.sin(4 * np.pi * k / FRAMES)
        poses = (placed(simulator, places["forearm"], slide, 4e-3 - DEEP),
                 placed(simulator, places["triceps"], 0.0, 12e-3 - DEEP))  # fmt: skip
        touches, state = simulator.touch([Contact(*one) for one in zip(tools, poses, strict=True)], state, 1 / RATE)
        answer, here = simulator.answer(touches), simulator.layer
        print(f"{np.rad2deg(bend):3.0f} degrees: {', '.join(f'{t.name} {t.force:.2f} N' for t in touches)}; "
              f"{answer.trust.why or 'in range'}")  # fmt: skip
        shade = colours(np.clip(answer.magnitude / MOST, 0, 1))
        bad = simulator.skin.near.sound.bend
        if bad is not None:
            shade[bad.spoilt] = SPOILT
        moved = here.vertices + answer.displacement
        corners, shades = [moved[here.faces]], [shade[here.faces].mean(axis=1)]
        normals = [here.normals[here.faces].mean(axis=1)]
        for tool, pose, colour in zip(tools, poses, (DISC, BALL), strict=True):
            there = (tool.vertices @ pose[:3, :3].T + pose[:3, 3])[tool.faces]
            corners.append(there)
            normals.append(np.cross(there[:, 1] - there[:, 0], there[:, 2] - there[:, 0]))
            shades.append(np.broadcast_to(np.array(colour), (len(there), 3)))
        frames.append(draw(np.concatenate(corners), np.concatenate(shades), np.concatenate(normals), eye, turn, 45.0))
    save(frames, HERE / "pictures" / "moving.webp", RATE)
    from PIL import Image

    Image.fromarray(np.concatenate([frames[k] for k in STILLS], axis=1)).save(HERE / "pictures" / "moving.png")


if __name__ == "__main__":
    main()
