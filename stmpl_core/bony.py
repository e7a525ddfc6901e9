"""Bony: places of arms and legs where bone lies some millimetres under the skin, and the capsules of bones do not.

Kneecap, the inner face of the shin, and the tip of the elbow. There the tissue of stmpl_core.living is several times as
thick as people's, so what presses is answered far too soft.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from stmpl_core.arrays import Points
from stmpl_core.body import Body
from stmpl_core.bones import bones_of

NEAREST = 4  # vertices of the body by which a place of a part is known
KNEECAP = (-45e-3, 25e-3)  # from so far above the knee to so far below [m]
SHIN = (0.06, 0.92)  # from such a share of the way from knee to ankle to such a one [-]
SHIN_ANGLES = np.deg2rad((-15.0, 75.0))  # from its ridge in front towards the inside, round the leg
ELBOW = 30e-3  # distance from the elbow along the forearm up to which its tip is [m]
FACING = 0.7  # cosine to the front of the knee, and to the back of the elbow


def bony(body: Body, part: str, points: Points) -> np.ndarray | None:
    """Mask of the places of an arm's or a leg's skin under which bone is nearer than the part's tissue knows, (N,).

    Args:
        body: body; of other models than Anny nothing is known: None, as of other parts.
        part: its part.
        points: places on its skin, (N, 3) [m].
    """
    side, _, name = part.partition("_")
    limb = {"leg": "leg", "thigh": "leg", "calf": "leg", "arm": "arm", "upper_arm": "arm", "forearm": "arm"}.get(name)
    if limb is None or side not in ("left", "right") or body.name != "anny":
        return None
    distance, nearest = cKDTree(body.vertices).query(points, NEAREST)
    weight = 1 / (distance + 1e-4)
    own = (weight * _bony(side, limb)[nearest]).sum(axis=1) > 0.5 * weight.sum(axis=1)
    return own if own.any() else None


@cache
def _bony(side: str, limb: str) -> np.ndarray:
    """The mask of Anny's average body, (V,), which stands at rest, up along z, and looks along x."""
    body = Body.anny()
    upper, lower = bones_of(body, f"{side}_{limb}")
    joint = min((lower.start, lower.end), key=lambda end: float(np.linalg.norm(end - upper.end)))
    far = lower.end if joint is lower.start else lower.start
    axis = far - joint
    length = float(np.linalg.norm(axis))
    axis = axis / length
    along, away = (body.vertices - joint) @ axis, body.vertices - lower.middles(body.vertices)
    away -= (away @ axis)[:, None] * axis
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    if limb == "arm":
        back = -(upper.start - joint) / np.linalg.norm(upper.start - joint) - axis
        back -= back @ axis * axis
        found = (away @ back > FACING * np.linalg.norm(back)) & (np.abs(along) < ELBOW)
    else:
        front = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
        front /= np.linalg.norm(front)
        inner = np.cross(axis, front) * (1 if side == "left" else -1)
        angle = np.arctan2(away @ inner, away @ front)
        knee = (away @ front > FACING) & (along > KNEECAP[0]) & (along < KNEECAP[1])
        shin = (angle > SHIN_ANGLES[0]) & (angle < SHIN_ANGLES[1]) & (along > SHIN[0] * length) & (
            along < SHIN[1] * length)  # fmt: skip
        found = knee | shin
    return found & (body.level(f"{side}_{limb}") > 0)
