"""Bones: the rigid core of a limb as capsules between its joints, and the columns of tissue that run to it.

Where tissue is no longer thin beside the limb's radius, columns along the skin's normals cross and fold; columns that
run to the bone do not. The bones' radii are guesses of an adult's, the joints are read from the body's own weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stmpl_core.arrays import Faces, Points, VertexVectors
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import SoftLayer

RADII = {  # radius of a segment's bones as one capsule [m]: humerus, radius and ulna, femur, tibia and fibula
    "upper_arm": 11e-3, "forearm": 15e-3, "thigh": 14e-3, "calf": 20e-3,
}  # fmt: skip
SPINE = {  # radius of the spine as a capsule, assumed: a vertebra of the loins is 34 by 44 mm (Panjabi 1992) [m]; two
    # groups of bones, through the middles of whose skin it runs
    "abdomen": (20e-3, (("spine05",), ("spine02",))), "neck": (10e-3, (("neck01", "neck02", "neck03"), ("head",))),
}  # fmt: skip
OWN = 0.5  # weight of such bones over its largest, from which skin is their own
BEYOND = 0.1  # how far the spine goes on beyond these middles [m]
SEGMENTS = {"arm": ("upper_arm", "forearm"), "leg": ("thigh", "calf")}
FACING = 0.35  # cosine between normal and column, below which a bone is no longer reached through this skin
AWAY = 0.3  # cost of a bone that the skin does not face, over the missing cosine [m]
BLEND = 6e-3  # difference of cost over which two bones share a column [m]
THINNEST = 0.8e-3  # shortest column: skin lies on the bone, and never in it [m]
LEAST_FOLD = 0.15  # fold ratio of a prism (stmpl_core.extrusion.fold_ratios) from which it is sound
SHORTER = 0.93  # factor on the columns around a folding face, each pass
WORST_FOLD = 0.02  # fold ratio below which a column that did not get sound by that also turns to the skin's normal
TURNED = 0.1  # how far in each pass
PASSES = 60  # passes of shortening at most


@dataclass(frozen=True)
class Bone:
    """A bone, or several side by side, as a capsule.

    Args:
        start, end: middles of its ends, (3,) each [m].
        radius: its radius [m].
    """

    start: np.ndarray
    end: np.ndarray
    radius: float

    def middles(self, points: Points) -> Points:
        """The nearest point of its axis to each of the points, (N, 3) [m]."""
        axis = self.end - self.start
        share = np.clip((points - self.start) @ axis / (axis @ axis), 0, 1)
        return self.start + share[:, None] * axis

    def outward(self, points: Points) -> VertexVectors:
        """Unit vectors straight away from its axis to each of the points, (N, 3)."""
        axis = (self.end - self.start) / np.linalg.norm(self.end - self.start)
        away = across(points - self.middles(points), axis)
        return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)

    def ends_from(self, other: Bone) -> tuple[np.ndarray, np.ndarray]:
        """Its ends, (3,) each, first the one that is nearer to another bone [m]."""
        gap = [float(np.linalg.norm(end - other.middles(end[None])[0])) for end in (self.start, self.end)]
        return (self.start, self.end) if gap[0] < gap[1] else (self.end, self.start)


def across(ways: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The parts of vectors, (N, 3) or (3,), at right angles to an axis of length 1, (3,)."""
    return ways - (ways @ axis)[..., None] * axis


def bones_of(body: Body, part: str) -> list[Bone]:
    """The bones of an arm, a leg, a segment of one, of a shoulder, abdomen or neck. Raises InvalidInput for others.

    A joint lies in the middle of the ring of skin that the bones on both sides of it move alike. A shoulder has the
    upper arm's. The spine runs through the middle of what its bones' skin spans: place and radius are guesses.
    """
    if part in SPINE:
        return [_spine(body, *SPINE[part])]
    part = part.replace("shoulder", "upper_arm")
    side, _, name = part.partition("_")
    segments = SEGMENTS.get(name, (name,))
    if side not in ("left", "right") or any(segment not in RADII for segment in segments):
        known = [*(f"left_{one}, right_{one}" for one in (*SEGMENTS, *RADII, "shoulder")), *SPINE]
        raise InvalidInput(f"the bones of {part!r} are not known. Known: {', '.join(known)}. "
                           "Or give SoftLayer a core of your own.")  # fmt: skip
    return [_bone(body, f"{side}_{segment}", RADII[segment]) for segment in segments]


def _spine(body: Body, radius: float, groups: Sequence[Sequence[str]]) -> Bone:
    if missing := {bone for group in groups for bone in group} - set(body.bones):
        raise InvalidInput(f"the spine of this body is not known: it has no {', '.join(sorted(missing))}.")
    ends = []
    for group in groups:
        weight = body.weights[:, [body.bones.index(bone) for bone in group]].sum(axis=1)
        own = body.vertices[weight > OWN * weight.max()]
        ends.append((own.min(axis=0) + own.max(axis=0)) / 2)
    way = BEYOND * (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return Bone(ends[0] - way, ends[1] + way, radius)


def _bone(body: Body, part: str, radius: float) -> Bone:
    level = body.level(part)
    own = body.vertices[level > 0]
    middle = own.mean(axis=0)
    axis = np.linalg.svd(own - middle, full_matrices=False)[2][0]
    along, ring = (body.vertices - middle) @ axis, np.abs(level) < 0.3
    weight = np.where(ring, 0.3 - np.abs(level), 0.0)
    first, second = (weight * (along < 0), weight * (along > 0))
    return Bone(first @ body.vertices / first.sum(), second @ body.vertices / second.sum(), radius)


def core_of(vertices: Points, normals: VertexVectors, faces: Faces, bones: Sequence[Bone],
            thickness: float | None = None) -> Points:  # fmt: skip
    """Where the column below each vertex of a skin ends, (V, 3) [m]: on the bones, or sooner.

    A column points to the bone that is near and that the skin faces, or between two. Columns of prisms that would fold
    are shortened.

    Args:
        vertices: skin at rest, (V, 3) [m].
        normals: its outward unit normals, (V, 3).
        faces: vertex numbers, (F, 3).
        bones: bones, at least one.
        thickness: depth below the skin, along its normal, at which the tissue ends above the bone [m]; None: it reaches
            to the bone.
    """
    ways, lengths, costs = [], [], []
    for bone in bones:
        away = vertices - bone.middles(vertices)
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        facing = np.einsum("ij,ij->i", normals, away) / distance
        ways.append(-away / distance[:, None])
        lengths.append(np.maximum(distance - bone.radius, THINNEST))
        costs.append(lengths[-1] / np.maximum(facing, FACING) + AWAY * np.maximum(FACING - facing, 0))
    cost = np.array(costs)
    share = np.exp(-(cost - cost.min(axis=0)) / BLEND)
    share /= share.sum(axis=0)
    columns = np.einsum("bv,bvi->vi", share, np.array(ways) * np.array(lengths)[..., None])
    steep = FACING * np.linalg.norm(columns, axis=1) + np.einsum("ij,ij->i", columns, normals)
    columns -= np.maximum(steep, 0)[:, None] * normals  # no column leaves the skin sideways, as at an armpit
    if thickness is not None:
        deep = -np.einsum("ij,ij->i", columns, normals)
        columns *= np.minimum(thickness / np.maximum(deep, FACING * thickness), 1)[:, None]
    return vertices + unfolded(vertices, normals, columns, faces)


def unfolded(vertices: Points, normals: VertexVectors, columns: VertexVectors, faces: Faces) -> VertexVectors:
    """Columns below a skin, shortened where their prisms are near to folding; where they still fold, also turned.

    Args:
        vertices: skin at rest, (V, 3) [m].
        normals: its outward unit normals, (V, 3).
        columns: vectors from there to the core, (V, 3) [m].
        faces: vertex numbers, (F, 3).
    """
    columns = columns.copy()
    hopeless = fold_ratios(vertices, vertices + 0.1 * columns, faces) < LEAST_FOLD
    for least, turned, spared in ((LEAST_FOLD, 0.0, hopeless), (WORST_FOLD, TURNED, False)):
        for _ in range(PASSES):
            bad = np.unique(faces[(fold_ratios(vertices, vertices + columns, faces) < least) & ~np.asarray(spared)])
            if not len(bad):
                break
            columns[bad] = shortened(columns[bad], normals[bad], SHORTER, turned)
    return columns


def shortened(columns: VertexVectors, normals: VertexVectors, factor: float, turned: float) -> VertexVectors:
    """Columns (N, 3) [m], shortened by a factor and turned inwards by so much of outward normals (N, 3)."""
    length = np.linalg.norm(columns, axis=1, keepdims=True)
    way = columns / length - turned * normals
    return factor * length * way / np.linalg.norm(way, axis=1, keepdims=True)


def to_bone(layer: SoftLayer, bones: Sequence[Bone], thickness: float | None = None) -> SoftLayer:
    """The layer with columns that run to bones (see `core_of`)."""
    return layer.with_(core=core_of(layer.vertices, layer.normals, layer.faces, bones, thickness))
