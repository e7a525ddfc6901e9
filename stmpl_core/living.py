"""Living: a part of a body as people were measured: skin, fat and muscle of its region, down to its bones."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stmpl_core.arrays import check_kind
from stmpl_core.body import AROUND, Body
from stmpl_core.bones import Bone, bones_of, to_bone
from stmpl_core.bony import bony
from stmpl_core.errors import InvalidInput
from stmpl_core.fat import fat_map, for_person, unmeasured
from stmpl_core.friction import Friction
from stmpl_core.layer import MAX_THICKNESS, SoftLayer, one_thickness
from stmpl_core.limbs import EDGE_LENGTH
from stmpl_core.packed import stack_from_text, stack_to_text
from stmpl_core.regions import HELD_SKIN, Tone, region
from stmpl_core.text_file import text_of
from stmpl_core.tissue import Tissue
from stmpl_core.trunk import TRUNK

log = logging.getLogger(__name__)

STRAIGHT = ("torso", "back")  # parts whose bones are not known: their tissue lies straight below the skin
SHEET = 2e-3  # thickness with which a part is meshed before its columns are known [m]
NEARLY, LEAST_HELD = 0.9, 0.5  # shares of picked skin: of the most that any part holds of it, and least of that
DEEPEST = 0.95 * MAX_THICKNESS  # depth at which tissue ends above the bone, as in a heavy person's groin [m]


def living(body: Body, part: str, tone: Tone = "relaxed", *, edge_length: float = EDGE_LENGTH) -> SoftLayer:
    """A part of a body with the tissue that was measured in its region (stmpl_core.regions).

    Skin around a picked place (Body.around) has that of the smallest part which holds nearly all of it.

    Arms and legs reach to their bones, so how thick their tissue is follows the body. Torso and back are as thick as
    their region; abdomen, neck and shoulders no thicker than theirs, in columns to spine or humerus. Fat and skin
    follow the person's weight and sex, fat also the side of a limb (stmpl_core.fat). The log tells of a person unlike
    those who were measured: below 1.4 m, as a child, or much lighter or heavier.

    Args:
        body: body.
        part: its part, or `around:x,y,z,radius`.
        tone: state of the muscle.
        edge_length: length of the skin mesh's edges [m].

    Raises:
        InvalidInput: a part without a region.
    """
    _check_body(body, part)
    named = part_around(body, part) if part.startswith(AROUND) else part
    return filled(body, named, partial(body.part, part, edge_length=edge_length), tone)


def _check_body(body: object, part: object) -> None:
    """Raises InvalidInput: no body, or a part that is no text."""
    check_kind("body", body, Body)
    check_kind("part", part, str)


def part_around(body: Body, picked: str) -> str:
    """The part whose tissue is that around a picked place: the smallest that holds nearly all of that skin.

    Raises:
        InvalidInput: skin of which no part whose tissue was measured holds half.
    """
    inside, held = body.level(picked) > 0, {}
    for part in body.parts:
        try:
            region(part)
        except InvalidInput:
            continue
        own = body.level(part) > 0
        held[part] = float((own & inside).sum() / inside.sum()), int(own.sum())
    most = max((share for share, _ in held.values()), default=0.0)
    if most < LEAST_HELD:
        outside = 100 * (1 - most)
        raise InvalidInput(f"the tissue of {picked!r} was not measured: at least {outside:.0f} % of that skin is "
                           f"outside of each of {', '.join(held)}. Give it a tissue of one material.")  # fmt: skip
    return min((size, part) for part, (share, size) in held.items() if share > NEARLY * most)[1]


def filled(body: Body, part: str, lay: Callable[..., SoftLayer], tone: Tone = "relaxed") -> SoftLayer:
    """A part's skin with the tissue of its region below it, down to the bones where they are known: see `living`.

    Args:
        body: body.
        part: its part, one with a region.
        lay: function that makes a layer on the part's skin, of a `thickness` [m] and, if told, a `tissue`.
        tone: state of the muscle.
    """
    skin = None if part in STRAIGHT else lay(thickness=SHEET)  # refuses a part that is none
    its = for_person(region(part, tone), body.physique)
    if why := unmeasured(body.physique):
        log.warning("skin, fat and muscle of %s may be wrong: %s", part, why)
    if skin is None:
        return lay(thickness=its.thickness, tissue=its.tissue)
    fat = fat_map(body, part, skin.vertices)
    if fat is None:
        skin = skin.with_(tissue=its.tissue)
    else:
        middle = float(np.median(fat))
        tissue = replace(its, fat_thickness=replace(its.fat_thickness, value=middle)).tissue
        skin = skin.with_(tissue=tissue, ply_scale=fat / middle)
    return _to_bones(body, part, skin, bones_of(body, part), its.thickness if part in TRUNK else DEEPEST)


def laid(body: Body, part: str, tissue: Tissue, thickness: float, *, edge_length: float = EDGE_LENGTH) -> SoftLayer:
    """A part of a body with one's own tissue: down to its bones, or to `thickness` [m] where they lie deeper.

    Parts whose bones are not known (torso, back, hands) are as thick as that everywhere.

    Args:
        body: body.
        part: its part, or `around:x,y,z,radius`.
        tissue: tissue.
        thickness: the most that it is thick, along the skin's normal [m]; columns that lean to a bone are longer.
        edge_length: length of the skin mesh's edges [m].

    Raises:
        InvalidInput: no such part, or a thickness on which no layer can be laid.
    """
    _check_body(body, part)
    thickness = one_thickness(thickness)
    try:
        named = part_around(body, part) if part.startswith(AROUND) else part
        bones = bones_of(body, named)
    except InvalidInput:
        return body.part(part, edge_length=edge_length, thickness=thickness, tissue=tissue)
    skin = body.part(part, edge_length=edge_length, thickness=min(SHEET, thickness), tissue=tissue)
    return _to_bones(body, named, skin, bones, thickness)


def _to_bones(body: Body, part: str, skin: SoftLayer, bones: Sequence[Bone], thickness: float) -> SoftLayer:
    """A part's skin with columns to its bones, or to so deep below it [m]."""
    return to_bone(skin.with_(bony=bony(body, part, skin.vertices)), bones, min(thickness, DEEPEST))


def held_skin(layer: SoftLayer) -> SoftLayer:
    """The layer with the stress of all its materials fading as in skin that was stretched and held (HELD_SKIN).

    Raises:
        InvalidInput: no layer.
    """
    check_kind("layer", layer, SoftLayer)
    return layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN))


class Model(NamedTuple):
    """What `stmpl needs --out` says that a scene wants, for a node to be started with.

    Args:
        tissue: tissue under the skin.
        thickness: its thickness [m].
        friction: name of a pair in stmpl_core.friction or a coefficient, as text; None: slip does not matter, or a file
            older than this.
        relaxing: whether the tissue has to relax; False also in files older than this.
    """

    tissue: Tissue
    thickness: float
    friction: str | None = None
    relaxing: bool = False


def write_tissue(path: str | Path, tissue: Tissue, thickness: float, friction: Friction = None,
                 relaxing: bool = False) -> None:  # fmt: skip
    """Writes a tissue, its thickness [m] and what a scene wants beside it as JSON, for the node's setting `tissue`."""
    told = {"thickness": thickness, "relaxing": relaxing, "tissue": json.loads(stack_to_text(tissue))}
    more = {} if friction is None else {"friction": friction if isinstance(friction, str) else f"{friction:g}"}
    Path(path).write_text(json.dumps(told | more, indent=1))


def read_tissue(path: str | Path) -> tuple[Tissue, float]:
    """The tissue and its thickness [m] that `write_tissue` wrote. Raises what `read_model` raises."""
    return read_model(path)[:2]


def read_model(path: str | Path) -> Model:
    """All that `write_tissue` wrote.

    Raises:
        InvalidInput: no such file, one that is no regular file, or one that holds no tissue.
    """
    try:
        given = json.loads(text_of(path))
        if not isinstance(given, dict) or not {"tissue", "thickness"} <= given.keys():
            raise ValueError("an object with 'tissue' and 'thickness' is needed")
        friction = given.get("friction")
        return Model(stack_from_text(json.dumps(given["tissue"]))[0], float(given["thickness"]),
                     None if friction is None else str(friction), bool(given.get("relaxing", False)))  # fmt: skip
    except OSError as error:
        raise InvalidInput(f"there is no tissue in {path}: {error.strerror}. stmpl needs --out writes one.") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InvalidInput(f"{path} holds no tissue ({error}). stmpl needs --out writes one.") from error
