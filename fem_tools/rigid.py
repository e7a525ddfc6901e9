"""RigidFem: the tools of an answer, pressed in once more by finite elements, where the answer has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from fem_tools.indenter import INDENTER_LAYERS, IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core.arrays import PerVertex
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import prepared
from stmpl_core.sdf import SignedDistance
from stmpl_core.touch import Answer
from stmpl_core.trust import Displacement, Trust

REFINE, STEP = 2, 0.08  # a third of IndenterFem's own cost; 0.5 % in pressure
REACH, STACK_STEP = 9.0, 0.1  # of a stack: half a minute a tool on a forearm of 3 mm edges
ROUNDED = 1e-3  # m, of edges: no skin mesh follows a sharp one
NEAR = 3.0  # edges around a tool within which pressure is its own
LEAST = 1e-5  # m: shallower contacts move nothing
TOUCH = 5e-5  # m, squared times E: nor do such forces
FORCE = 1e-2  # of the force, to which a tool with a wrench is pressed


class RigidFem:
    """Judges whole answers to contacts: geometry, force and motion, not only what a given pressure does.

    A tool with a wrench goes in along its force until it carries it; one without goes as deep as its pose says, along
    the mean normal of its pressure. Tools stick. They are pressed one by one and their motions added: right where they
    are some thicknesses apart.
    """

    name = "rigid_fem"

    def __init__(self) -> None:
        self._layer: SoftLayer | None = None
        self._fem = IndenterFem()
        self._fields: dict[str, SignedDistance] = {}  # by the digest of a tool

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer. A stack is thick beside the edges of its mesh, which is taken as it is, and far around."""
        self._layer = layer
        if layer.stacked:
            patch, step = PatchFem(element="P1xP2", layers=1, reach=REACH, check_stability=False), STACK_STEP
        else:
            patch, step = PatchFem(refine=REFINE, layers=INDENTER_LAYERS, check_stability=False), STEP
        self._fem = IndenterFem(patch, step=step).prepare(layer)
        return self

    def press(self, contacts: Sequence[Contact], answer: Answer) -> Displacement:
        """The motion under these contacts.

        Args:
            contacts: tools that press on the skin, at their stated poses.
            answer: answer to judge. Its pressure says from where a tool without a wrench comes, its touches how far it
                moved a tool along its force.

        Raises:
            InvalidInput: a tool that FEM cannot press, or an answer that does not say its pressure.
        """
        if answer.pressure is None:
            raise InvalidInput("this answer does not say the pressure that it was solved for: FEM cannot judge it.")
        pressure = np.asarray(answer.pressure, dtype=np.float64)
        layer = prepared(self._layer, self)
        displacement, trust, total = np.zeros_like(layer.vertices), Trust(), np.zeros_like(pressure)
        for contact in contacts:
            tool, depth = self._tool(contact, pressure, _moved(contact, answer))
            force = 0.0 if contact.wrench is None else float(np.linalg.norm(contact.wrench[:3]))
            if (force < layer.tissue.youngs_modulus * TOUCH**2) if force else (depth < LEAST):
                continue
            solved = self._fem.press_with([tool], force, tolerance=FORCE) if force else self._fem.press([tool], depth)
            displacement += solved.displacement
            total += solved.pressure
            found = {f"{contact.name}.normal_n": float(solved.wrenches[0][:3] @ tool.direction)}
            theirs = solved.trust
            trust = Trust(trust.converged and theirs.converged, trust.in_range and theirs.in_range, None,
                          "; ".join(filter(None, (trust.why, theirs.why))), dict(trust.figures) | found)  # fmt: skip
        return Displacement(displacement, trust, self.name, total)

    def _tool(self, contact: Contact, pressure: PerVertex, moved: float) -> tuple[Press, float]:
        """The tool where it first touches, and how far it goes from there [m]."""
        layer = prepared(self._layer, self)
        if contact.tool.digest not in self._fields:
            self._fields[contact.tool.digest] = SignedDistance.of(contact.tool, rounding=ROUNDED)
        field = self._fields[contact.tool.digest]
        pose = contact.pose_body_from_tool
        force = contact.wrench[:3] if contact.wrench is not None else np.zeros(3)
        if force.any():
            way = force
        else:
            away = field.distance((layer.vertices - pose[:3, 3]) @ pose[:3, :3])
            way = -(np.where(away < NEAR * layer.edge_length, pressure, 0.0) @ layer.vertex_area_vectors)
        tool = Press(field, pose, way)
        there = tool.at(moved)
        touching = there.at(-float(layer.thickness.max())).touching(layer)
        if touching is None:
            raise InvalidInput(f"{contact.name} never meets the skin along its way.")
        depth = float((there.pose_body_from_tool - touching.pose_body_from_tool)[:3, 3] @ tool.direction)
        return touching, depth


def _moved(contact: Contact, answer: Answer) -> float:
    """How far the answer moved a tool along its force [m]; 0 where a recording does not tell."""
    if contact.wrench is None or contact.name not in answer.touches or not contact.wrench[:3].any():
        return 0.0
    way = answer.touches[contact.name].pose_body_from_tool[:3, 3] - contact.pose_body_from_tool[:3, 3]
    moved = float(way @ contact.wrench[:3]) / float(np.linalg.norm(contact.wrench[:3]))
    return moved if np.isfinite(moved) else 0.0
