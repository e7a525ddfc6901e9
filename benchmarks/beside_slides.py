"""Ours beside the strokes that `benchmarks.slides` wrote: drag, its onset, force over time, motion.

    .venv/bin/python -m benchmarks.slides --out runs/slides
    .venv/bin/python -m benchmarks.beside_slides runs/slides                        # all that lie there, seconds each
    .venv/bin/python -m benchmarks.beside_slides runs/slides forearm-ball20-mu0.3

Ours takes BETWEEN steps from pose to pose. Differences of force are the largest of any pose, in % of the largest force
of finite elements; of slides once before and once after the onset, where nine tenths of the steady drag are reached.
Motion is off in the mean where finite elements move more than a tenth of their peak, and at the worst vertex, in % of
that peak; of presses the peak is the largest of the whole stroke. Forces are whole ones. Where one is told apart, push
and friction are not the same to both while skin sticks: what it carries along itself is push to ours (as it comes and
goes with the depth), friction to finite elements.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from trimesh.transformations import rotation_from_matrix, rotation_matrix

from benchmarks.living_limbs import ball
from stmpl_core import Contact, Simulator, State
from stmpl_core.methods import MomentNet
from stmpl_core.packed import unpack

BETWEEN = 4  # steps of ours between two poses of finite elements
STEADY = 10  # last poses of a slide, the median of which is its steady drag
MOVES = 0.1  # motion over its peak from which skin counts as moving
LIFTED = 0.02  # force over the largest below which a tool counts as lifted


@dataclass(frozen=True, eq=False)
class Played:
    """A stroke by finite elements and by ours.

    Args:
        name: name of the scene.
        about: what was done.
        way: way of the tool from its first pose, (N,) [m].
        truth, found: forces on the body along the stroke, aside and outwards, finite elements' and ours, (N, 3) [N].
        true_friction, friction: their parts that are friction, (N, 3) [N].
        at: numbers of the poses whose motion is known, (K,).
        moved: motion of the skin by finite elements, (K, V, 3) [m].
        motion: ours, (K, V, 3) [m].
        elastic: that of an answer without a state, (K, V, 3) [m].
        in_range: flags of poses at which ours calls itself in range, (K,).
        bound: its bound on the motion, (K,) [m]; NaN: none.
    """

    name: str
    about: dict
    way: np.ndarray
    truth: np.ndarray
    found: np.ndarray
    true_friction: np.ndarray
    friction: np.ndarray
    at: np.ndarray
    moved: np.ndarray
    motion: np.ndarray
    elastic: np.ndarray
    in_range: np.ndarray
    bound: np.ndarray

    @property
    def slides(self) -> bool:
        """Whether the tool goes one way along the skin."""
        return not isinstance(self.about["friction"], str) and self.way[-1] > 0.9 * self.way.max() > 1e-3

    def onset(self, forces: np.ndarray) -> float:
        """Way at which nine tenths of the steady drag are reached [m]."""
        drag = np.maximum.accumulate(np.linalg.norm(forces[:, :2], axis=1)) / self.drag(forces)
        return float(np.interp(0.9, drag, self.way))

    @staticmethod
    def drag(forces: np.ndarray) -> float:
        """The steady drag [N]."""
        return float(np.median(np.linalg.norm(forces[-STEADY:, :2], axis=1)))

    @property
    def peak(self) -> np.ndarray:
        """What motion is off over, at the poses `at`, (K,) [m]."""
        moved = np.linalg.norm(self.moved, axis=2)
        return np.maximum(moved.max(axis=1) if self.slides else np.full(len(moved), moved.max()), 1e-9)

    def off(self, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean where skin moves, and worst, of how far a motion is off at the poses `at`, (K,) [% of the peak]."""
        moved = np.linalg.norm(self.moved, axis=2)
        wrong = 100 * np.linalg.norm(motion - self.moved, axis=2) / self.peak[:, None]
        where = moved > MOVES * moved.max(axis=1, keepdims=True)
        mean = [w[some].mean() if some.any() else 0.0 for w, some in zip(wrong, where, strict=True)]
        return np.array(mean), wrong.max(axis=1)


def played(path: Path) -> Played:
    """The stroke of a file, by ours too."""
    with np.load(path) as file:
        kept = dict(file)
    about, layer, frame = json.loads(str(kept["about"])), unpack(kept), kept["frame"]
    law = about["friction"]
    simulator = Simulator(layer, MomentNet(), friction=None if isinstance(law, str) else law)
    tool, poses, times = ball(about["radius"]), kept["pose"], kept["time"]
    state, found, rubs, motion, elastic, trusts = State(), [], [], [], [], []
    for k, pose in enumerate(poses):
        for part in range(1, BETWEEN + 1) if k else (1,):
            there = between(poses[k - 1], pose, part / BETWEEN) if k else pose
            dt = (times[k] - times[k - 1]) / BETWEEN if k else 0.0
            (touch,), state = simulator.touch([Contact(tool, there)], state, dt)
        found.append(touch.wrench[:3])
        rubs.append(np.zeros(3) if touch.slip is None else touch.slip.wrench[:3])
        if k in kept["at"]:
            answer = simulator.answer([touch])
            motion.append(answer.displacement)
            elastic.append(simulator.step([Contact(tool, pose)]).displacement)
            trusts.append((answer.trust.in_range, answer.trust.error_bound or np.nan))
    axes = frame[:3, :3]
    way = np.linalg.norm((poses[:, :3, 3] - poses[0, :3, 3]) @ axes[:, :2], axis=1)
    in_range, bound = np.array(trusts).T
    return Played(path.stem, about, way, kept["wrench"][:, :3] @ axes, np.array(found) @ axes,
                  kept["friction"][:, :3] @ axes, np.array(rubs) @ axes, kept["at"], kept["displacement"],
                  np.array(motion), np.array(elastic), in_range, bound)  # fmt: skip


def between(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """A pose between two, (4, 4)."""
    angle, axis, _ = rotation_from_matrix(end @ np.linalg.inv(start))
    pose = rotation_matrix(angle * share, axis) @ start
    pose[:3, 3] = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
    return pose


def told(one: Played) -> str:
    """What is to be said of a stroke."""
    about, truth, found = one.about, one.truth, one.found
    most, pull = np.maximum((np.abs(truth[:, 2]).max(), np.linalg.norm(truth[:, :2], axis=1).max()), 1e-12)
    normal = 100 * np.abs(found[:, 2] - truth[:, 2]) / most
    tangential = 100 * np.linalg.norm(found[:, :2] - truth[:, :2], axis=1) / pull
    mean, worst = one.off(one.motion)
    bare, _ = one.off(one.elastic)
    lines = [f"{one.name}: {about['played']} of {about['poses']} poses in {about['seconds']:.0f} s; largest force "
             f"{most:.3f} N normal, {pull:.3f} N tangential; normal off by at most {normal.max():.1f} %"
             + ("" if isinstance(about["friction"], str) else f", tangential {tangential.max():.1f} %")]  # fmt: skip
    pressed = np.abs(truth[:, 2]) > LIFTED * most
    if one.slides:
        begins = one.way < one.onset(truth)
        for name, when in {"begins": begins & (one.way > 0), "slides": ~begins}.items():
            if not when.any():
                continue
            mean_normal = 100 * (found[when, 2] / truth[when, 2] - 1).mean()
            lines.append(f"  {name}: tangential off by at most {tangential[when].max():.1f} %, normal "
                         f"{normal[when].max():.1f} % ({mean_normal:+.1f} % in the mean)")  # fmt: skip
        k, off = int(tangential.argmax()), 100 * (found - truth) / pull
        rubs = 100 * (one.friction - one.true_friction) / pull
        lines.append(f"  most is off at {1e3 * one.way[k]:.1f} mm; along the way by {off[k, 0]:+.1f} %: of the push "
                     f"{off[k, 0] - rubs[k, 0]:+.1f} %, of friction {rubs[k, 0]:+.1f} %")  # fmt: skip
        there, ours = one.onset(truth), one.onset(found)
        lines.append(f"  onset: {1e3 * ours:.2f} mm, finite elements {1e3 * there:.2f} mm "
                     f"({100 * (ours / there - 1):+.0f} %); steady drag {one.drag(found):.3f} N, finite elements "
                     f"{one.drag(truth):.3f} N")  # fmt: skip
        moves = {"motion while it slides": ~begins}
    else:
        after = np.arange(len(pressed)) > np.abs(truth[:, 2]).argmax()
        moves = {"motion while it presses": pressed, "motion of skin that was let go": ~pressed & after}
    for name, when in moves.items():
        if (some := when[one.at]).any():
            lines.append(f"  {name}: {_ends(mean[some])} off where it moves, worst vertex {worst[some].max():.0f} %; "
                         f"without a state {_ends(bare[some])}")  # fmt: skip
    stated = np.isfinite(one.bound)
    covered = worst / 100 * one.peak <= one.bound
    lines.append(f"  in range at {one.in_range.mean():.0%} of {len(one.at)} poses; the bound on motion covers "
                 f"{covered[stated].sum()} of {stated.sum()} that state one")  # fmt: skip
    return "\n".join(lines)


def _ends(shares: np.ndarray) -> str:
    return f"{shares.min():.1f} to {shares.max():.1f} %"


def main() -> None:
    """Prints the strokes of a folder."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path, help="folder that benchmarks.slides wrote")
    options.add_argument("scenes", nargs="*", help="names of scenes; all that lie there unless given")
    given = options.parse_args()
    for name in given.scenes or sorted(path.stem for path in given.folder.glob("*.npz")):
        print(told(played(given.folder / f"{name}.npz")), flush=True)


if __name__ == "__main__":
    main()
