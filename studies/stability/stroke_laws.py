"""The laws that any stroke of a tool must hold, whose answers know what came before."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from stmpl_core.touch import APART, Touch
from studies.stability.broken import Answers, Found, Law, broken, worst
from studies.stability.contacts import answers_of
from studies.stability.strokes import Strokes
from studies.stability.trial import Trial

GIVEN = 0.005  # of the work that was put in, that may come out again beyond it
CUT = 0.01  # of the largest force, by which the same path in other steps may change a force
CAPPED = 1.7  # friction over mu N at most: ploughing raises it
DOUBLED = 0.03  # of the largest friction, by which a reversal may miss the first loading, twice as large
LASTS = 0.15  # of friction that sticks, and a third of that of the force, that may be lost to and fro
GROWS, JUMPS = 2.0, 0.2  # of the force pressed straight: most that it becomes where skin is dragged along, and at once
BETWEEN = 0.01  # of the elastic force, by which a force may leave what lies between relaxed and sudden


@worst
def gives(trial: Trial, answers: Answers) -> Found:
    """At no instant has a contact given more energy than was put in; the path begins off the skin."""
    given, scene = answers_of(answers.scene), _scene(trial)
    places = [_touch(one.touches).pose_body_from_tool for one in given]
    if scene.wrenches is None and scene.spring is None:  # in the core it is answered for where it is drawn back to
        places = list(scene.poses)
    net = put = 0.0
    for (before, after), (one, two) in zip(pairwise(given), pairwise(places), strict=True):
        work = _work(_touch(before.touches), _touch(after.touches), one, two)
        net, put = net + work, put + max(work, 0.0)
        if net < -GIVEN * put - 1e-12:
            yield broken("gives", f"{-100 * net / max(put, 1e-300):.2g} % more came out than was put in", before, after)
            return


@worst
def caps(trial: Trial, answers: Answers) -> Found:
    """Friction along the skin is at most CAPPED mu N."""
    scene = _scene(trial)
    for answer in answers_of(answers.scene):
        touch = _touch(answer.touches)
        if touch.slip is None:
            continue
        along = float(np.linalg.norm(touch.slip.wrench[:3]))
        most = CAPPED * scene.friction * touch.force
        if along > most * (1 + 1e-9):
            yield broken("caps", f"friction of {along:.3g} N, mu N is {scene.friction * touch.force:.3g}", answer)


@worst
def alike(trial: Trial, answers: Answers) -> Found:
    """The same path in other steps, or from a fresh start: at common instants the same wrench."""
    assert trial.twin is not None
    ours, theirs = answers_of(answers.scene), answers_of(answers.twin)
    size = max(float(np.linalg.norm(_touch(one.touches).wrench[:3])) for one in ours)
    for k, m in trial.twin.pairs:
        one, other = _touch(ours[k].touches), _touch(theirs[m].touches)
        off = float(np.linalg.norm(one.wrench[:3] - other.wrench[:3]))
        if off > CUT * size:
            yield broken("alike", f"force differs by {100 * off / size:.2g} % of the largest", ours[k], theirs[m])


@worst
def masing(trial: Trial, answers: Answers) -> Found:
    """After a reversal friction goes as at first loading, twice as far (Masing's rule)."""
    scene, given = _scene(trial), answers_of(answers.scene)
    along = scene.poses[:, :3, 3] - scene.poses[0, :3, 3]
    way = along @ (along[np.linalg.norm(along, axis=1).argmax()] / np.linalg.norm(along, axis=1).max())
    friction = np.array([_along(_touch(one.touches), scene, way) for one in given])
    moves = np.flatnonzero(np.diff(way) != 0)
    start, top = moves[0], int(way.argmax())
    back = np.arange(top, moves[-1] + 2)
    back = back[: 1 + int(np.argmax(np.append(np.diff(way[back]) > 0, True)))]
    half = np.interp((way[top] - way[back]) / 2, way[start : top + 1] - way[start], friction[start : top + 1])
    missed = np.abs(friction[top] - friction[back] - 2 * (half - friction[start]))
    k = int(missed.argmax())
    if missed[k] > DOUBLED * np.abs(friction).max():
        off = 100 * missed[k] / np.abs(friction).max()
        yield broken("masing", f"friction is {off:.2g} % of its largest off after a reversal", given[back[k]])


@worst
def between(trial: Trial, answers: Answers) -> Found:
    """While a tool goes deeper or stays, the force lies between the relaxed share of the elastic one and all of it.

    The twin is elastic.
    """
    assert trial.twin is not None
    series = _scene(trial).mesh.tissue.relaxation
    least = series.relaxed if series else 1.0
    for ours, theirs in zip(answers_of(answers.scene), answers_of(answers.twin), strict=True):
        force, elastic = _touch(ours.touches).force, _touch(theirs.touches).force
        if not (least - BETWEEN) * elastic <= force <= (1 + BETWEEN) * elastic:
            yield broken("between", f"{force:.3g} N of {elastic:.3g} elastic ones; {least:.2g} of them are left", ours)


@worst
def free(trial: Trial, answers: Answers) -> Found:
    """A tool that is off the skin exerts nothing and is apart."""
    off = _scene(trial).off
    assert off is not None
    for answer in (answers_of(answers.scene)[k] for k in np.flatnonzero(off)):
        touch = _touch(answer.touches)
        if touch.status != APART or touch.wrench.any():
            yield broken("free", f"off the skin, and {touch.status} with {touch.force:.2g} N", answer)


@worst
def lasts(trial: Trial, answers: Answers) -> Found:
    """What sticks stays, and so does what has relaxed: after moves to and fro as without, or as after the first."""
    assert trial.twin is not None
    ours, theirs = answers_of(answers.scene), answers_of(answers.twin)
    for k, m in trial.twin.pairs:
        one, other = _touch(ours[k].touches), _touch(theirs[m].touches)
        if one.slip is None or other.slip is None:
            continue
        held, meant = np.linalg.norm(one.slip.wrench[:3]), np.linalg.norm(other.slip.wrench[:3])
        if abs(held - meant) > LASTS * meant:
            yield broken("lasts", f"{held:.3g} N of friction, where {meant:.3g} stuck", ours[k], theirs[m])
        if abs(one.force - other.force) > LASTS / 3 * other.force:
            yield broken("lasts", f"presses with {one.force:.3g} N for {other.force:.3g}", ours[k], theirs[m])


@worst
def ends(trial: Trial, answers: Answers) -> Found:
    """Led on at one depth a tool presses at most GROWS times as hard as it pressed at first, and not at once."""
    given = answers_of(answers.scene)
    forces, depths = (np.array([getattr(_touch(one.touches), what) for one in given]) for what in ("force", "depth"))
    first = int(np.argmax(depths > 0.95 * depths.max()))  # where triangles are flat it goes up and down
    for k in range(first + 1, len(given)):
        if forces[k] > GROWS * forces[first] or abs(forces[k] - forces[k - 1]) > JUMPS * forces[first]:
            yield broken("ends", f"presses with {forces[k]:.3g} N, straight it was {forces[first]:.3g}", given[k])


STROKE_LAWS: dict[str, Law] = {
    "gives": gives, "caps": caps, "alike": alike, "masing": masing, "between": between, "free": free,
    "lasts": lasts, "ends": ends,
}  # fmt: skip
"""Laws of strokes, by name."""


def _scene(trial: Trial) -> Strokes:
    assert isinstance(trial.scene, Strokes)
    return trial.scene


def _touch(touches: Mapping[str, Touch]) -> Touch:
    (touch,) = touches.values()
    return touch


def _work(before: Touch, after: Touch, one: np.ndarray, two: np.ndarray) -> float:
    """Work that a tool did on the skin in a step from one pose to another, trapezoid [J]."""
    turned = Rotation.from_matrix(two[:3, :3] @ one[:3, :3].T).as_rotvec()
    return 0.5 * float((before.wrench + after.wrench) @ np.concatenate([two[:3, 3] - one[:3, 3], turned]))


def _along(touch: Touch, scene: Strokes, way: np.ndarray) -> float:
    """Friction along the path's direction [N]."""
    if touch.slip is None:
        return 0.0
    k = int(way.argmax())
    to = scene.poses[k, :3, 3] - scene.poses[0, :3, 3]
    return float(touch.slip.wrench[:3] @ to / np.linalg.norm(to))
