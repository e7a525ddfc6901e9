"""Bony: places of arms and legs where bone lies some millimetres under the skin, and the capsules of bones do not.

Kneecap, the inner face of the shin, and the tip of the elbow. There the tissue of stmpl_core.living is several times as
thick as people's, so what presses is answered far too soft.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from stmpl_core.arrays import Points
from stmpl_core.body import Body
from stmpl_core.bones import SEGMENTS, across, bones_of
from stmpl_core.fat import near_on

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
    limb = next((limb for limb, segments in SEGMENTS.items() if name in (limb, *segments)), None)
    if limb is None or side not in ("left", "right") or body.name != "anny":
        return None
    weight, nearest = near_on(body, points)
    own = (weight * _bony(side, limb)[nearest]).sum(axis=1) > 0.5
    return own if own.any() else None


@cache
def _bony(side: str, limb: str) -> np.ndarray:
    """The mask of Anny's average body, (V,), which stands at rest, up along z, and looks along x."""
    body = Body.anny()
    upper, lower = bones_of(body, f"{side}_{limb}")
    joint, far = lower.ends_from(upper)
    length = float(np.linalg.norm(far - joint))
    axis, away = (far - joint) / length, lower.outward(body.vertices)
    along = (body.vertices - joint) @ axis
    if limb == "arm":
        back = -(upper.start - joint) / np.linalg.norm(upper.start - joint) - axis
        back = across(back, axis)
        found = (away @ back > FACING * np.linalg.norm(back)) & (np.abs(along) < ELBOW)
    else:
        front = across(np.array([1.0, 0.0, 0.0]), axis)
        front /= np.linalg.norm(front)
        inner = np.cross(axis, front) * (1 if side == "left" else -1)
        angle = np.arctan2(away @ inner, away @ front)
        knee = (away @ front > FACING) & (along > KNEECAP[0]) & (along < KNEECAP[1])
        shin = (angle > SHIN_ANGLES[0]) & (angle < SHIN_ANGLES[1]) & (along > SHIN[0] * length) & (
            along < SHIN[1] * length)  # fmt: skip
        found = knee | shin
    return found & (body.level(f"{side}_{limb}") > 0)
