"""Hand: the hand of a parametric body as a tool whose fingers close on a limb until they touch."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.arrays import Points, Transform
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.tool import Tool

FINGERS = range(1, 6)  # the thumb first
STEP = np.radians(6.0)  # by which a closing joint turns
FURTHEST = np.radians((80.0, 100.0, 70.0))  # of the three joints of a finger
OPEN = np.radians((-45.0, -20.0, -20.0, -20.0, -20.0))  # the first joint of each finger, before it closes
SETTLING = 8  # times that the palm is moved by its distance to the skin
FURTHEST_THUMB = np.radians((35.0, 50.0, 60.0))


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand in its own frame: origin in the middle of the palm, x along the fingers, z out of the palm. Metres.

    Args:
        vertices: vertices at rest, (V, 3) [m].
        faces: faces, closed at the wrist, (F, 3).
        weights: skinning weights of the palm and then the fifteen finger bones, thumb first, knuckle to tip, (V, 16)
            [-].
        joints: points about which the finger bones turn, (15, 3) [m].
        axes: axes about which they close, (15, 3) [-].
    """

    vertices: Points
    faces: np.ndarray
    weights: np.ndarray
    joints: Points
    axes: Points

    @classmethod
    def of(cls, body: Body, side: str = "R") -> Hand:
        """The hand of `body`; a joint lies where the skin belongs to the bones on both of its sides.

        Raises:
            InvalidInput: a body without Anny's names for the bones of the fingers.
        """
        palm = [k for k, b in enumerate(body.bones) if re.fullmatch(rf"(wrist|metacarpal\d)\.{side}", b)]
        names = [f"finger{finger}-{bone}.{side}" for finger in FINGERS for bone in (1, 2, 3)]
        if not palm or not set(names) <= set(body.bones):
            raise InvalidInput(f"{body.name} has no bones named {names[0]} ... {names[-1]}; use a body of Body.anny.")
        columns = [body.weights[:, palm].sum(axis=1), *(body.weights[:, body.bones.index(n)] for n in names)]
        weights = np.stack(columns, axis=1)
        inside = weights.sum(axis=1) > 0.5
        faces = body.faces[inside[body.faces].all(axis=1)]
        used, flat = np.unique(faces, return_inverse=True)
        vertices, weights = body.vertices[used], weights[used] / weights[used].sum(axis=1, keepdims=True)
        joints = np.array([_between(vertices, weights, b, 0 if b % 3 == 1 else b - 1) for b in range(1, 16)])
        frame, axes = _palm_frame(vertices, weights, joints)
        closed, extra = _closed(vertices, flat.reshape(-1, 3))
        weights = np.vstack([weights, np.tile(np.eye(16)[:1], (len(extra), 1))])
        local = (np.vstack([vertices, extra]) - frame[:3, 3]) @ frame[:3, :3]
        return cls(local, closed, weights, (joints - frame[:3, 3]) @ frame[:3, :3], axes @ frame[:3, :3])

    def closed_by(self, angles: Sequence[float] | np.ndarray) -> Points:
        """The vertices with the fifteen joints turned by `angles` [rad], by linear blend skinning, (V, 3) [m]."""
        from trimesh.transformations import rotation_matrix

        transforms = np.tile(np.eye(4), (16, 1, 1))
        for j in range(15):
            before = transforms[0] if j % 3 == 0 else transforms[j]
            turn = rotation_matrix(angles[j], self.axes[j], self.joints[j])
            transforms[j + 1] = before @ turn
        moved = np.einsum("bij,vj->vbi", transforms[:, :3, :3], self.vertices) + transforms[:, :3, 3]
        return np.einsum("vb,vbi->vi", self.weights, moved)

    @cached_property
    def beyond(self) -> list[np.ndarray]:
        """Numbers of the vertices that move with each finger bone itself."""
        return [np.flatnonzero(self.weights[:, j + 1] > 0.5) for j in range(15)]

    def grip(
        self, layer: SoftLayer, pose_body_from_hand: Transform, depth: float, loose: Sequence[float]
    ) -> tuple[Tool, Transform]:
        """The hand and its pose, once the palm has settled on the skin and the fingers have closed, joint after joint.

        Args:
            layer: soft layer that is held.
            pose_body_from_hand: pose from which the hand comes along its z, (4, 4).
            depth: depth of palm and finger bones below the skin at rest [m].
            loose: share of its way that each finger stays short of closing, (5,) [-].
        """
        tree, angles, pose = KDTree(layer.vertices), np.zeros(15), pose_body_from_hand.copy()
        angles[::3] = OPEN

        def entered(vertices: np.ndarray) -> float:
            points = self.closed_by(angles)[vertices] @ pose[:3, :3].T + pose[:3, 3]
            nearest = tree.query(points)[1]
            return float(-np.einsum("ij,ij->i", points - layer.vertices[nearest], layer.normals[nearest]).min())

        palm = np.flatnonzero(self.weights[:, 0] > 0.95)
        for _ in range(SETTLING):
            pose[:3, 3] += (depth - entered(palm)) * pose[:3, 2]
        for finger in range(5):
            furthest = (FURTHEST_THUMB if finger == 0 else FURTHEST) * (1 - loose[finger])
            for bone in range(3):
                j = 3 * finger + bone
                watched = np.concatenate(self.beyond[j : 3 * finger + 3])
                while angles[j] + STEP <= furthest[bone] and entered(watched) < depth:
                    angles[j] += STEP
        return Tool("hand", self.closed_by(angles), self.faces), pose


def _between(vertices: Points, weights: np.ndarray, bone: int, parent: int) -> np.ndarray:
    shared = weights[:, bone] * weights[:, parent]
    return shared @ vertices / shared.sum()


def _palm_frame(vertices: Points, weights: np.ndarray, joints: Points) -> tuple[Transform, Points]:
    """Pose of the palm's frame in the body's, and the axes about which the fingers close, in the body's axes."""
    knuckles, tips = joints[3::3], joints[5::3]
    palm = vertices[weights[:, 0] > 0.9]
    along = knuckles.mean(axis=0) - palm.mean(axis=0)
    x = along / np.linalg.norm(along)
    out = np.cross(x, knuckles[-1] - knuckles[0])
    bent = tips.mean(axis=0) - knuckles.mean(axis=0)  # at rest fingers are a little closed
    z = out / np.linalg.norm(out) * (1.0 if out @ (bent - (bent @ x) * x) > 0 else -1.0)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    frame[:3, 3] = 0.5 * (knuckles.mean(axis=0) + palm.mean(axis=0))
    axes = np.empty((15, 3))
    for finger in range(5):
        chain = joints[3 * finger : 3 * finger + 3]
        towards = z if finger else z + (knuckles[-1] - knuckles[0]) / np.linalg.norm(knuckles[-1] - knuckles[0])
        ways = [b - a for a, b in pairwise(chain)]
        for bone, way in enumerate([*ways, ways[-1]]):
            axis = np.cross(way, towards)
            axes[3 * finger + bone] = axis / np.linalg.norm(axis)
    return frame, axes


def _closed(vertices: Points, faces: np.ndarray) -> tuple[np.ndarray, Points]:
    """The faces with a fan over each hole, and the fans' middles."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    known = {tuple(e) for e in directed.tolist()}
    follows = {b: a for a, b in known if (b, a) not in known}
    fans, middles = [], []
    while follows:
        loop = [next(iter(follows))]
        while (to := follows.pop(loop[-1], None)) is not None and to != loop[0]:
            loop.append(to)
        middle = len(vertices) + len(middles)
        middles.append(vertices[loop].mean(axis=0))
        fans += [(loop[k], loop[(k + 1) % len(loop)], middle) for k in range(len(loop))]
    return np.vstack([faces, np.array(fans, dtype=faces.dtype).reshape(-1, 3)]), np.reshape(middles, (-1, 3))
