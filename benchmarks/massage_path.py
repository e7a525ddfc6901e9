"""A recorded massage beside finite elements that go the ball's whole way, with its friction and the skin's relaxation.

    stmpl demo --node.friction oiled --node.relaxing
    .venv/bin/python -m benchmarks.massage_path runs/latest --until 4.4     # half an hour on a busy core

`stmpl compare` presses the tools of each frame once more, into skin that is at rest: elastic, and sticking. Here the
ball is led through its recorded poses from before it touches, at their times, under Coulomb's law. Printed are the
forces of finite elements and of the recorded answers, with what of them is friction.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from bags.run import NANO
from bags.survey import survey
from fem_tools import IndenterFem, PatchFem
from fem_tools.rigid import ROUNDED, STACK_STEP
from fem_tools.stroke import Stroke
from stmpl_core.errors import BagError
from stmpl_core.sdf import SignedDistance

SPACING, PAUSE = 2e-3, 0.25  # between two poses that are taken [m], [s]
REACH = 5.0  # of the patch [thicknesses]: the whole forearm changes the force by 0.2 % (benchmarks.massage_force)


def main() -> None:
    """Goes the way and prints."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("run", type=Path, help="folder of the recording")
    options.add_argument("--tool", default="ball", help="name of the tool that is followed")
    options.add_argument("--until", type=float, default=np.inf, help="end of the way, from the first pose [s]")
    given = options.parse_args()
    bag = survey(given.run).bag
    start = min(bag.pose_stamps)
    frames = [one for one in bag.frames() if given.tool in one.touches and one.fade == 1
              and (one.stamp_ns - start) * NANO <= given.until]  # fmt: skip
    if not frames:
        raise BagError(f"no answer of {given.run} up to {given.until:g} s has the tool {given.tool}.")
    layer = bag.layer_of(frames[-1])
    tool = next(one.tool for one in bag.contacts(frames[-1]) if one.name == given.tool)
    field = SignedDistance.of(tool, rounding=ROUNDED)
    at = np.array([(one.stamp_ns - start) * NANO for one in frames])
    poses = np.array([one.touches[given.tool].pose_body_from_tool for one in frames])
    gaps = [field.distance((layer.vertices - pose[:3, 3]) @ pose[:3, :3]).min() for pose in poses]
    taken = [max(int(np.argmax(np.array(gaps) < 0)) - 1, 0)]
    for k in range(taken[0] + 1, len(frames)):
        if np.linalg.norm(poses[k, :3, 3] - poses[taken[-1], :3, 3]) > SPACING or at[k] - at[taken[-1]] > PAUSE:
            taken.append(k)
    friction = frames[-1].friction.get(given.tool, 0.0)
    print(f"{len(taken)} poses, friction {friction:g}, {'relaxing' if layer.tissue.relaxes else 'elastic'}")
    print("time [s]   FEM [N] (friction)   answer [N] (friction)   off")
    patch = PatchFem(reach=REACH, check_stability=False, element="P1xP2", layers=1)
    fem = IndenterFem(patch, step=STACK_STEP, friction=friction).prepare(layer)
    way = Stroke(field, poses[taken], direction=frames[taken[-1]].touches[given.tool].push)
    for k, one in zip(taken, fem.follow([way], times=at[taken]), strict=False):
        touch = frames[k].touches[given.tool]
        rubs = 0.0 if touch.slip is None else float(np.linalg.norm(touch.slip.wrench[:3]))
        truth, ours = float(np.linalg.norm(one.wrenches[0][:3])), float(np.linalg.norm(touch.wrench[:3]))
        print(f"{at[k]:8.2f} {truth:9.2f} ({np.linalg.norm(one.frictions[0][:3]):.2f}) {ours:15.2f} ({rubs:.2f})"
              f"{100 * (ours / max(truth, 1e-9) - 1):+15.1f} %  {one.trust.why}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
