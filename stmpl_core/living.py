"""Living: a part of a body as people were measured: skin, fat and muscle of its region, down to its bones."""

from __future__ import annotations

from stmpl_core.body import Body
from stmpl_core.bones import bones_of, to_bone
from stmpl_core.layer import SoftLayer
from stmpl_core.regions import REGIONS, Region, Tone, region

WHOLE = {"arm": "forearm", "leg": "thigh", "torso": "back"}  # region whose numbers serve a part of several
SHEET = 2e-3  # thickness with which a part is meshed before its columns are known [m]


def region_of(part: str, tone: Tone = "relaxed") -> Region:
    """The region whose numbers are those of a part of a body.

    Args:
        part: part, as stmpl_core.body knows it: left_forearm, right_thigh, torso.
        tone: state of the muscle.

    Raises:
        InvalidInput: a part without a region.
    """
    name = part.removeprefix("left_").removeprefix("right_")
    return region(name if name in REGIONS else WHOLE.get(name, name), tone)


def living(body: Body, part: str, tone: Tone = "relaxed", *, edge_length: float | None = None) -> SoftLayer:
    """A part of a body with the tissue that was measured in its region (stmpl_core.regions).

    Arms and legs reach to their bones, so how thick their tissue is follows the body; the torso is as thick as its
    region. The fat is as thick everywhere as in the region's middle.

    Args:
        body: body.
        part: its part.
        tone: state of the muscle.
        edge_length: length of the skin mesh's edges [m]; None: the body's own.

    Raises:
        InvalidInput: a part without a region.
    """
    its = region_of(part, tone)
    if part == "torso":
        return body.part(part, edge_length=edge_length, thickness=its.thickness, tissue=its.tissue)
    skin = body.part(part, edge_length=edge_length, thickness=SHEET, tissue=its.tissue)
    return to_bone(skin, bones_of(body, part))
