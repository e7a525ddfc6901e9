"""Fat: how thick fat and skin are below each place of a limb, in a person of some weight and sex.

From the public data of MULTIS (Neumann et al., "Reference data on thickness and mechanics of tissue layers and
anthropometry of musculoskeletal extremities", Sci Data 5 (2018) 180193; SimTK, doi 10.18735/S5R97F): ultrasound in the
middle of each segment of arm and leg, front and back, 95 adults of 17 to 45 kg/m2. Fitted here, site by site, by least
squares: ln thickness = a + b (female - 1/2) + c (body mass index - 24 kg/m2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import exp

import numpy as np
from scipy.spatial import cKDTree

from stmpl_core.arrays import PerVertex, Points
from stmpl_core.body import Body, Physique
from stmpl_core.bones import SEGMENTS, across, bones_of
from stmpl_core.regions import Quantity, Region, region

MULTIS = "MULTIS, Neumann et al., Sci Data 5 (2018) 180193: 95 adults, ultrasound, geometric mean and deviation"
MEASURED = 17.0, 45.0  # body mass indices of those people [kg/m2]
AVERAGE = 24.0  # body mass index at which the fits below are, taken for that of a model's average body [kg/m2]
SHORTEST = 1.4  # height below which a person is a child, or shorter than nearly all adults [m]
LEAST_FAT = 1e-3  # thinnest fat [m]; the thinnest of MULTIS is 0.6 mm
NEAREST = 4  # vertices of the body from which a place of a part learns what side it is on


@dataclass(frozen=True)
class Site:
    """Fat of one region of a limb, at 24 kg/m2.

    Args:
        front: thickness in front (of the forearm: on the palm's side) [m].
        back: thickness behind [m].
        sexes: logarithm of women's over men's [-].
        per_mass_index: change of the logarithm with the body mass index [m2/kg].
    """

    front: Quantity
    back: Quantity
    sexes: float
    per_mass_index: float

    @property
    def ratio(self) -> float:
        """Front over back [-]."""
        return self.front.value / self.back.value


def _mm(value: float, deviation: float) -> Quantity:
    """A geometric mean and its deviation, of which the logarithm is given, [m]."""
    low, high = value * exp(-deviation), value * exp(deviation)
    return Quantity(1e-3 * value, 1e-3 * float(f"{low:.2g}"), 1e-3 * float(f"{high:.2g}"), "m", MULTIS)


SITES = {  # by region; the side at which the region's own numbers were found
    "forearm": ("front", Site(_mm(4.15, 0.46), _mm(2.40, 0.39), 0.37, 0.040)),
    "upper_arm": ("back", Site(_mm(3.49, 0.38), _mm(7.61, 0.34), 0.76, 0.049)),
    "thigh": ("front", Site(_mm(8.40, 0.34), _mm(8.57, 0.35), 0.80, 0.031)),
    "calf": ("back", Site(_mm(4.00, 0.57), _mm(7.06, 0.48), 0.58, 0.005)),
}
SEXES, PER_MASS_INDEX = 0.63, 0.031  # of all eight sites; the trunk's are assumed to be the same
SKIN_SEXES, SKIN_PER_MASS_INDEX = -0.084, 0.0034  # the same of the skin's thickness


def fat_factor(name: str, physique: Physique | None) -> float:
    """Fat of a person in a region over that of the average [-]. The trunk's is assumed to follow as the limbs' does.

    (Gibney et al., Curr Med Res Opin 26 (2010) 1519, found 5.1 mm between the sexes and 4 mm a 10 kg/m2, of 13.9 mm on
    the abdomen: 0.37 and 0.029 m2/kg.)
    """
    if physique is None:
        return 1.0
    sexes, slope = (SITES[name][1].sexes, SITES[name][1].per_mass_index) if name in SITES else (SEXES, PER_MASS_INDEX)
    return exp(sexes * (physique.female - 0.5) + slope * physique.heavier)


def unmeasured(physique: Physique | None) -> str:
    """Why nobody like a person was measured, a clause; "" of those who were, and of a person not known."""
    if physique is None:
        return ""
    if physique.height is not None and physique.height < SHORTEST:
        return f"the person is {physique.height:.2f} m tall, and adults were measured, hardly one below {SHORTEST:g} m"
    if not MEASURED[0] <= (mass_index := AVERAGE + physique.heavier) <= MEASURED[1]:
        return (f"the person is as heavy as people of {mass_index:.1f} kg/m2, and people of {MEASURED[0]:.0f} to "
                f"{MEASURED[1]:.0f} were measured")  # fmt: skip
    return ""


def for_person(its: Region, physique: Physique | None) -> Region:
    """A region with the fat and the skin of a person; the average body has the region's own numbers."""
    if physique is None:
        return its
    skin = exp(SKIN_SEXES * (physique.female - 0.5) + SKIN_PER_MASS_INDEX * physique.heavier)
    return replace(its, fat_thickness=_times(its.fat_thickness, fat_factor(its.name, physique)),
                   skin_thickness=_times(its.skin_thickness, skin))  # fmt: skip


def _times(one: Quantity, factor: float) -> Quantity:
    return replace(one, value=factor * one.value, low=factor * one.low, high=factor * one.high)


def fat_map(body: Body, part: str, points: Points) -> PerVertex | None:
    """Thickness of the fat at places of an arm or a leg of an Anny body, (N,) [m]; None for other parts and models.

    Round the limb it goes from the front's to the back's as the cosine of the angle from the front, (1 + cos) / 2 of
    the one and the rest of the other. From segment to segment of a whole arm or leg it goes as the squares of the
    distances from the other's bone. Along a segment it is the same: MULTIS measured in the middle only.

    Args:
        body: body.
        part: its part.
        points: places on its skin, (N, 3) [m].
    """
    side, _, name = part.partition("_")
    segments = SEGMENTS.get(name, (name,))
    if side not in ("left", "right") or any(one not in SITES for one in segments) or body.name != "anny":
        return None
    bones = bones_of(body, part)
    far = np.array([np.linalg.norm(points - bone.middles(points), axis=1) for bone in bones])
    near = 1 / far**2
    weight, nearest = near_on(body, points)
    thickness = np.zeros(len(points))
    for segment, share in zip(segments, near / near.sum(axis=0), strict=True):
        where, site = SITES[segment]
        middle = for_person(region(segment), body.physique).fat_thickness.value
        front = middle if where == "front" else middle * site.ratio
        facing = (weight * _frontward(f"{side}_{segment}")[nearest]).sum(axis=1)
        thickness += share * front * (1 / site.ratio + (1 - 1 / site.ratio) * (1 + facing) / 2)
    return np.maximum(thickness, LEAST_FAT)


def near_on(body: Body, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Weights that sum to 1, and numbers, of the vertices of a body near places (N, 3) [m], (N, NEAREST) each."""
    distance, nearest = cKDTree(body.vertices).query(points, NEAREST)
    weight = 1 / (distance + 1e-4)
    return weight / weight.sum(axis=1, keepdims=True), nearest


@cache
def _frontward(part: str) -> np.ndarray:
    """Cosine of the angle round a limb between each vertex of Anny's average body and the limb's front, (V,).

    The average stands at rest and looks along x: that is the front of its upper arms and legs. A forearm's front faces
    the upper arm at the elbow, and as the palm does at the wrist.
    """
    body = Body.anny()
    (bone,) = bones_of(body, part)
    axis = (bone.end - bone.start) / np.linalg.norm(bone.end - bone.start)
    front = np.tile([1.0, 0.0, 0.0], (len(body.vertices), 1))
    if part.endswith("forearm"):
        (upper,) = bones_of(body, part.replace("forearm", "upper_arm"))
        elbow, wrist = bone.ends_from(upper)
        shoulder = max((upper.start, upper.end), key=lambda end: float(np.linalg.norm(end - elbow)))
        along = np.clip((body.vertices - elbow) @ (wrist - elbow) / ((wrist - elbow) @ (wrist - elbow)), 0, 1)[:, None]
        crease, palm = (_unit(across(way, axis)) for way in (shoulder - elbow, _palm(body, part)))
        front = (1 - along) * crease + along * palm
    front = across(front, axis)
    front /= np.maximum(np.linalg.norm(front, axis=1, keepdims=True), 1e-9)
    return np.einsum("ij,ij->i", bone.outward(body.vertices), front)


def _unit(way: np.ndarray) -> np.ndarray:
    return way / np.linalg.norm(way)


def _palm(body: Body, part: str) -> np.ndarray:
    """Way that the palm faces, (3,): across the fingers' way and the thumb's."""
    letter = "L" if part.startswith("left") else "R"

    def middle(bone: str) -> np.ndarray:
        weight = body.weights[:, body.bones.index(f"{bone}.{letter}")]
        return weight @ body.vertices / weight.sum()

    fingers, thumb = middle("finger3-2") - middle("wrist"), middle("finger1-3") - middle("finger5-2")
    return np.cross(fingers, thumb) * (1 if letter == "L" else -1)
