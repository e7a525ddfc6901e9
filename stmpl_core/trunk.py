"""Trunk: parts of a body that no bones' weights tell apart: back, abdomen, neck and shoulders, by place at rest."""

from __future__ import annotations

import numpy as np

from stmpl_core.arrays import Points

TRUNK = ("back", "abdomen", "neck", "left_shoulder", "right_shoulder")
STEEP = 0.1  # distance over which the level of a part grows by one [m]
SHOULDER = np.array([0.012, 0.161, 0.441])  # left shoulder joint of Anny's average body at rest [m]
OUT = np.array([0.0, 0.6, 0.8])  # way from there out of the shoulder's cap


def trunk_level(points: Points, torso: np.ndarray, part: str) -> np.ndarray:
    """How far each vertex of Anny's average body lies inside a part of the trunk, (V,) [-]; cut at 0.

    Each reaches some thicknesses beyond where it is meant to be pressed: the back from the loins to the neck, the
    abdomen all round the trunk from the hips to the breast, the neck's nape from the shoulder blades to the skull, a
    shoulder over the deltoid.

    Args:
        points: vertices of the average body at rest, (V, 3) [m].
        torso: level of the torso there, (V,).
        part: one of TRUNK.
    """
    x, y, z = points.T
    if part == "back":
        inside = [0.03 - x, z - 0.02, 0.50 - z]
    elif part == "abdomen":
        inside = [z + 0.05, 0.42 - z, x + z + 0.03]  # not down between the buttocks, where skin lies on skin
    elif part == "neck":
        inside = [0.03 - x, z - 0.42, 0.615 - z, 0.10 - np.abs(y)]
    else:
        side = np.array([1.0, 1.0 if part.startswith("left") else -1.0, 1.0])
        away = points * side - SHOULDER
        inside = [0.16 - np.linalg.norm(away, axis=1), away @ OUT + 0.05]
    level = np.min(inside, axis=0) / STEEP
    return np.minimum(level, torso) if part in ("back", "abdomen") else level
