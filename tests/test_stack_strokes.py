"""Slides over flat skin, fat and muscle against finite elements, whose push leans and grows: the bound on force.

tests/stack_strokes_of_fem.npz holds poses and wrenches that `benchmarks.slides` wrote: `python -m
tests.test_stack_strokes FOLDER` cuts them again.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.slides import SCENES, ball
from stmpl_core import Contact, Simulator, State, Touch
from stmpl_core.methods import MomentNet

FILE = Path(__file__).with_name("stack_strokes_of_fem.npz")
LIMITS = {  # mean error of the force along the skin and into it, over the largest of each
    "flat-back-ball20-mu0.8": (0.08, 0.04),  # found 0.07 and 0.03; 0.09 and 0.03 where a tool is not wrapped
    "flat-back-ball8-mu0.5": (0.07, 0.05),  # 0.06 and 0.046; 0.06 and 0.06
    "stack-ball20-deep-mu0.6": (0.045, 0.03),  # 0.04 and 0.024; 0.04 and 0.02
}
PRESSED = 5  # poses of the press, before the ball is led along
BETWEEN = 4  # steps between two poses


def played(name: str, poses: np.ndarray) -> list[Touch]:
    scene = SCENES[name]
    simulator, state, touches = Simulator(scene.ground().layer, MomentNet(), friction=scene.friction), State(), []
    tool = ball(scene.radius)
    for k, pose in enumerate(poses):
        for part in range(1, BETWEEN + 1) if k else (BETWEEN,):
            there, before = pose.copy(), poses[max(k - 1, 0), :3, 3]
            there[:3, 3] = before + part / BETWEEN * (pose[:3, 3] - before)
            (touch,), state = simulator.touch([Contact(tool, there)], state, 0.0)
        touches.append(touch)
    return touches


@pytest.mark.parametrize("name", LIMITS)
def test_a_slide_over_taut_skin_is_as_near_as_stated_and_within_its_bound(name: str) -> None:
    """Ours drag up to 19 % too little at mu 0.8 and 9 % too much at 0.5, of the largest."""
    with np.load(FILE) as file:
        truth, poses = file[f"{name}.wrench"][:, :3], file[f"{name}.pose"]
    touches = played(name, poses)
    errors = np.array([touch.wrench[:3] for touch in touches]) - truth
    along, into = np.linalg.norm(errors[PRESSED:, :2], axis=1), np.abs(errors[PRESSED:, 2])
    assert along.mean() < LIMITS[name][0] * np.abs(truth[PRESSED:, 0]).max()
    assert into.mean() < LIMITS[name][1] * np.abs(truth[:, 2]).max()
    off = np.linalg.norm(errors, axis=1)
    assert (off <= [touch.force_bound for touch in touches])[1:].all()
    assert max(touch.force_bound for touch in touches) < np.linalg.norm(truth, axis=1).max()


def main(folder: Path) -> None:
    """Cuts what `benchmarks.slides` wrote to a folder."""
    cut = {}
    for name in LIMITS:
        with np.load(folder / f"{name}.npz") as file:
            believed = np.flatnonzero(file["ok"])[-1] + 1
            assert json.loads(str(file["about"]))["friction"] == SCENES[name].friction
            cut |= {f"{name}.{what}": file[what][:believed] for what in ("pose", "wrench")}
    np.savez_compressed(FILE, **cut)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
