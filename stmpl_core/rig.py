"""Rig: the bones that a skin hangs on, and the joints between them, which may move at run time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from stmpl_core.arrays import finite
from stmpl_core.body import PARTS, Body
from stmpl_core.bones import SEGMENTS, Bone, bones_of
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer

SPREAD = 34e-3  # deviation with which bone weights are spread along the skin [m]: Anny's own fold the inner elbow
STEPS = 3  # implicit steps of that
NEAREST = 5e-3  # distance from the body's skin up to which a layer is taken to be a part of it [m]
STRAIGHT = np.deg2rad(15)  # angle between two bones below which they do not tell the axis of their hinge
HINGES = {  # name of the joint between two segments, its axis where the bones are straight, most flexion
    "arm": ("elbow", (0.0, 1.0, 0.0), float(np.deg2rad(150))), "leg": ("knee", (0.0, 1.0, 0.0), float(np.deg2rad(140))),
}  # fmt: skip


@dataclass(frozen=True)
class Joint:
    """A hinge. At 0 the limb is at rest.

    Args:
        name: name of the joint, as in sensor_msgs/JointState.
        bone: name of the bone that it turns, with all that hangs on it.
        axis: axis at rest, layer axes, (3,); a positive angle turns by the right hand.
        low, high: least and largest angle [rad].

    Raises:
        InvalidInput: an axis without direction, or limits that do not hold 0.
    """

    name: str
    bone: str
    axis: tuple[float, float, float]
    low: float = -np.pi
    high: float = np.pi

    def __post_init__(self) -> None:
        axis = finite(f"axis of {self.name}", self.axis, (3,))
        if not np.linalg.norm(axis) > 0:
            raise InvalidInput(f"the axis of {self.name} is {axis.tolist()}; it must have a direction.")
        if not self.low <= 0 <= self.high:
            raise InvalidInput(f"{self.name} goes from {self.low:g} to {self.high:g} rad; 0, its rest, must be within.")
        object.__setattr__(self, "axis", tuple(float(x) for x in axis / np.linalg.norm(axis)))


@dataclass(frozen=True, eq=False)
class Rig:
    """Bones under a skin, how much each vertex goes with each, and the joints that turn them.

    A vertex goes with the weighted mean of its bones' motions (linear blend skinning), from where it is at rest.

    Args:
        bones: names of the bones; the first is the root, which stays.
        parents: number of the bone that each hangs on, lower than its own; -1 of the root.
        heads: place at rest about which each turns, (B, 3) [m], layer axes.
        weights: weight of each bone at each vertex, (V, B) [-], at least 0, rows sum to 1; kept as float32, the root's
            as what is left.
        joints: joints, at most one of a name; several may turn one bone, the first first.

    Raises:
        InvalidInput: numbers that are not finite, shapes that do not fit, or names that repeat or do not exist.
    """

    bones: tuple[str, ...]
    parents: tuple[int, ...]
    heads: np.ndarray
    weights: np.ndarray
    joints: tuple[Joint, ...]

    def __post_init__(self) -> None:
        many = len(self.bones)
        for kind, names in (("bones", list(self.bones)), ("joints", [joint.name for joint in self.joints])):
            if not names or len(set(names)) < len(names):
                raise InvalidInput(f"a rig wants {kind} with names of their own; got {', '.join(names) or 'none'}.")
        if len(self.parents) != many or self.parents[0] != -1 or any(
                not 0 <= parent < n for n, parent in enumerate(self.parents) if n):  # fmt: skip
            raise InvalidInput(f"parents are {list(self.parents)}; allowed are -1 of the first bone, and the number of "
                               "an earlier one of each other.")  # fmt: skip
        object.__setattr__(self, "heads", finite("heads", self.heads, (many, 3)))
        weights = finite("weights", self.weights, (None, many)).astype(np.float32).astype(float)
        off = float(np.abs(weights.sum(axis=1) - 1).max(initial=0.0))
        if off > 1e-4 or (weights < 0).any():
            raise InvalidInput(f"weights are {weights.min():g} at their least and their rows are up to {off:.2g} off "
                               "from 1; allowed is 0 and more, summing to 1.")  # fmt: skip
        weights[:, 0] = np.maximum(1 - weights[:, 1:].sum(axis=1), 0)  # the same again from what a message carries
        object.__setattr__(self, "weights", weights)
        for joint in self.joints:
            if joint.bone not in self.bones:
                raise InvalidInput(f"{joint.name} turns {joint.bone!r}. Available: {', '.join(self.bones)}.")

    @classmethod
    def of(cls, body: Body, part: str, layer: SoftLayer) -> Rig:
        """The rig of an arm or a leg: upper arm and forearm with the elbow, thigh and calf with the knee.

        The bone weights of the body are spread over the layer's skin by SPREAD, so that a bend's inside folds late.

        Args:
            body: body at rest.
            part: left_arm, right_arm, left_leg or right_leg.
            layer: that part of it as a layer.

        Raises:
            InvalidInput: another part, or a layer that is no part of the body's skin.
        """
        (joint_name,) = joints_of(part)
        side, _, name = part.partition("_")
        names = [f"{side}_{segment}" for segment in SEGMENTS[name]]
        bones = bones_of(body, part)
        weights = spread(layer, _weights_on(body, layer, names), SPREAD)
        _, axis, most = HINGES[name]
        heads, axis, bent = _hinge(bones, np.array(axis))
        joint = Joint(joint_name, names[1], (axis[0], axis[1], axis[2]), -bent, most - bent)
        return cls(tuple(names), (-1, 0), heads, weights, (joint,))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    def angles(self, joints: Mapping[str, float]) -> tuple[float, ...]:
        """Angle of each joint [rad], 0 of those that are not given.

        Raises:
            InvalidInput: an unknown joint, or an angle that is not finite or beyond the joint's limits.
        """
        if not isinstance(joints, Mapping):
            raise InvalidInput(f"joints are {joints!r}; angles by name are wanted, as {{'{self.names[0]}': 0.5}}.")
        unknown = sorted(set(joints) - set(self.names))
        if unknown:
            raise InvalidInput(f"unknown joint: {', '.join(unknown)}. Available: {', '.join(self.names)}.")
        out = []
        for joint in self.joints:
            try:
                angle = float(joints.get(joint.name, 0.0))
            except (TypeError, ValueError):
                raise InvalidInput(f"{joint.name} is {joints[joint.name]!r}; a number [rad] is wanted.") from None
            if not np.isfinite(angle):
                raise InvalidInput(f"{joint.name} is {angle} rad; it must be finite.")
            if not joint.low - 1e-9 <= angle <= joint.high + 1e-9:
                raise InvalidInput(f"{joint.name} is {angle:.3g} rad; it goes from {joint.low:.3g} to {joint.high:.3g} "
                                   "rad. Is it in degrees?")  # fmt: skip
            out.append(angle)
        return tuple(out)

    def motions(self, angles: Sequence[float]) -> np.ndarray:
        """Motion of each bone from its place at rest, (B, 4, 4), under such angles of the joints [rad]."""
        out = np.tile(np.eye(4), (len(self.bones), 1, 1))
        for n, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            if n:
                out[n] = out[parent]
            for joint, angle in zip(self.joints, angles, strict=True):
                if joint.bone == bone:
                    out[n] = out[n] @ about(self.heads[n], np.array(joint.axis), angle)
        return out

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all of it, as hex digits."""
        weights = np.ascontiguousarray(self.weights, "<f4").tobytes()
        return hashlib.sha256(json.dumps(self._told()).encode() + weights).hexdigest()

    def to_text(self) -> str:
        """The rig but for its weights, as JSON."""
        return json.dumps(self._told())

    def _told(self) -> dict[str, Any]:
        return {"bones": self.bones, "parents": self.parents, "heads": self.heads.tolist(),
                "joints": [asdict(joint) for joint in self.joints]}  # fmt: skip

    @classmethod
    def from_text(cls, text: str, weights: ArrayLike) -> Rig:
        """The rig of such JSON and weights (V, B). Raises InvalidInput."""
        try:
            told = json.loads(text)
            joints = tuple(Joint(**{**one, "axis": tuple(one["axis"])}) for one in told["joints"])
            bones, parents = tuple(map(str, told["bones"])), tuple(map(int, told["parents"]))
            return cls(bones, parents, np.array(told["heads"]), np.reshape(weights, (-1, len(bones))), joints)
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise InvalidInput(f"this is no rig: {error}.") from error


def joints_of(part: str) -> tuple[str, ...]:
    """Names of the joints that Rig.of gives a part. Raises InvalidInput for a part without any that it knows."""
    known = [f"{side}_{limb}" for side in ("left", "right") for limb in SEGMENTS]
    if part not in known:
        raise InvalidInput(f"{part!r} has no joints that are known. Known: {', '.join(known)}. Or give bones, weights "
                           "and joints of your own to Rig.")  # fmt: skip
    side, _, name = part.partition("_")
    return (f"{side}_{HINGES[name][0]}",)


def about(centre: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by an angle [rad] about a unit axis (3,) through a point (3,) [m], (4, 4); Rodrigues' formula."""
    out, x = np.eye(4), np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    out[:3, :3] += np.sin(angle) * x + (1 - np.cos(angle)) * (x @ x)
    out[:3, 3] = centre - out[:3, :3] @ centre
    return out


def spread(layer: SoftLayer, values: np.ndarray, deviation: float) -> np.ndarray:
    """Values at vertices (V, K), spread along the skin as heat is, by a deviation [m]; rows keep their sum.

    Implicit steps of du/dt = Laplace u until t = deviation^2 / 2, with linear elements and lumped areas; nothing flows
    over the open border.
    """
    import igl
    from scipy.sparse.linalg import splu

    laplace = sp.csc_matrix(igl.cotmatrix(layer.vertices, layer.faces.astype(np.int64)))
    areas = sp.diags(layer.vertex_areas)
    solver = splu((areas - 0.5 * deviation**2 / STEPS * laplace).tocsc())
    for _ in range(STEPS):
        values = solver.solve(areas @ values)
    values = np.clip(values, 0, None)
    return values / values.sum(axis=1, keepdims=True)


def _weights_on(body: Body, layer: SoftLayer, parts: Sequence[str]) -> np.ndarray:
    """Weights of parts of a body at a layer's vertices, (V, P); what no part has goes to those that have some."""
    import re

    from stmpl_core.methods.coarse import nearest_corners

    corners, shares = nearest_corners(body, layer.vertices)
    away = np.linalg.norm(np.einsum("vk,vkx->vx", shares, body.vertices[corners]) - layer.vertices, axis=1)
    if away.max() > NEAREST:
        raise InvalidInput(f"the layer is up to {1e3 * away.max():.3g} mm from the skin of this body; a part of it is "
                           f"within {1e3 * NEAREST:g} mm.")  # fmt: skip
    columns = [[k for k, bone in enumerate(body.bones) if re.fullmatch(PARTS[part], bone)] for part in parts]
    own = np.stack([body.weights[:, some].sum(axis=1) for some in columns], axis=1)
    weights = np.einsum("vk,vkp->vp", shares, own[corners])
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)


def _hinge(bones: Sequence[Bone], straight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Heads of two bones (2, 3) [m], axis of the hinge between them (3,), and by how much it is bent at rest [rad]."""
    ends = [(bone.start, bone.end) for bone in bones]
    near = [(np.linalg.norm(a - b), a, b, other_a, other_b) for a, other_a in (ends[0], ends[0][::-1])
            for b, other_b in (ends[1], ends[1][::-1])]  # fmt: skip
    _, joint, _, start, end = min(near, key=lambda one: one[0])
    upper, lower = joint - start, end - joint
    upper, lower = upper / np.linalg.norm(upper), lower / np.linalg.norm(lower)
    across = np.cross(upper, lower)
    bent = float(np.arctan2(np.linalg.norm(across), upper @ lower))
    axis = across / np.linalg.norm(across) if bent > STRAIGHT else straight
    return np.array([start, joint]), axis, bent
