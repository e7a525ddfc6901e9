"""Bounds: how far the motion under touches may be off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from stmpl_core.arrays import VertexVectors
from stmpl_core.dragged import ways_along
from stmpl_core.layer import SoftLayer
from stmpl_core.touch import Touch

SHEAR = 3.0  # motion of the skin along a force, over that across it: 1.3 on a half-space, 6 on a wide contact at nu 0.4
BESIDE = 0.5  # error of skin beside a tool's wall under its nodes, over its motion: up to 0.51 by finite elements
STEEP, LOADED = 0.7, 0.02  # cosine of a wall to the skin, at most; pressure there over the tool's highest, at least
LATE = 0.3  # error of skin that comes back, over its depth: up to 0.22 beyond the elastic bound by finite elements


def motion_bound(known: Mapping[str, float] | None, touches: Sequence[Touch], moves: Sequence[Touch], peak: float,
                 sunk: float) -> float | None:  # fmt: skip
    """Bound on the error of the motion under touches that are in range [m]; None where the method knows none.

    It follows from how far the force may be off and how deep the tools are; from the drag that a wrench tells of and
    that is not carried: the skin would go along with it, by so much as it gives; from skin that goes along by s under a
    tool d deep, in the linear response: s^2 / d, which a ball's slides by finite elements keep at mu 0.3, 0.6 and 1.0;
    and from skin that is not back. A groove may be off by all of itself, elsewhere than under a tool.

    Args:
        known: figures of the method's bound: `scale`, `power` of the force's relative bound, and `depth_power` of the
            depth over the thickness; None: none.
        touches: touches of the tools.
        moves: elastic touches that move the skin as they do, see History.elastic.
        peak: largest motion [m].
        sunk: largest motion that grooves add [m].
    """
    late = {touch.name for touch in touches if touch.imprint is not None}
    pressing = [touch for touch in touches if touch.presses and touch.force > 0]
    back = [touch for touch in moves if touch.name in late and touch.force > 0]
    if not pressing and not back:
        return sunk
    if known is None:
        return None
    under = peak * known["scale"] * max(
        (touch.force_bound / touch.force) ** known["power"] * deepest(touch) ** known.get("depth_power", 0.0)
        for touch in [*pressing, *back]
    )
    under += max((SHEAR * touch.drag / touch.force * touch.depth for touch in pressing), default=0.0)
    under += max((_dragged(touch) for touch in pressing), default=0.0)
    under += max((LATE * touch.depth for touch in back), default=0.0)
    return max(under, sunk)


def beside_walls(layer: SoftLayer, touches: Sequence[Touch], displacement: VertexVectors) -> float:
    """How far skin may be off that stands beside a tool's wall, while nodes of the tool load it [m].

    A node is some 2 mm wide, and skin that is closer than that to a wall goes along with it too far, which
    a mesh of longer edges hardly shows.

    Args:
        layer: soft layer at rest.
        touches: elastic touches that move it.
        displacement: motion, (V, 3) [m].
    """
    most = 0.0
    for touch in touches:
        if touch.pressed is None or touch.pressure is None:
            continue
        squeeze, field, pose = touch.pressed.squeeze, touch.pressed.field, touch.pose_body_from_tool
        some = squeeze.vertices[squeeze.depth <= 0]
        some = some[touch.pressure[some] > LOADED * touch.pressure.max()]
        moved = np.sqrt(np.einsum("nx,nx->n", displacement[some], displacement[some]))
        some, moved = some[BESIDE * moved > most], moved[BESIDE * moved > most]
        if not len(some):
            continue
        _, ways = field.distance_gradient((layer.vertices[some] - pose[:3, 3]) @ pose[:3, :3])
        facing = np.abs(np.einsum("nx,nx->n", ways @ pose[:3, :3].T, layer.normals[some]))
        steep = facing < STEEP * np.linalg.norm(ways, axis=1)
        most = BESIDE * float(moved[steep].max(initial=most / BESIDE))
    return most


def deepest(touch: Touch) -> float:
    """Depth of a tool over the thickness, where it is deepest [-]; 1 where nothing is known of it."""
    depths = () if touch.pressed is None else touch.pressed.squeeze.nodes.strain
    return float(np.max(depths)) if len(depths) else 1.0


def _dragged(touch: Touch) -> float:
    ways = ways_along(touch)
    return 0.0 if ways is None else float(np.einsum("nx,nx->n", ways, ways).max()) / touch.depth
