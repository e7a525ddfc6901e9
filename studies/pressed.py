"""pressed: contacts of a data set with their tools built again, and what a ContactNet sees of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fem_tools.contact_job import INDENTER_REFINE
from fem_tools.dataset import Sample
from fem_tools.press import Press
from fem_tools.sampling import tool_scene
from fem_tools.scenes import Site
from stmpl_core.arrays import PerVertex, Transform, VertexVectors
from stmpl_core.columns import Columns, Squeeze
from stmpl_core.contact_net import ContactNet
from stmpl_core.layer import SoftLayer
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from stmpl_core.tool import Tool
from stmpl_core.touch import BY_POSE, Touch
from stmpl_core.touch import Pressed as Touched
from stmpl_core.wrenches import wrench_of

LEAST_CELLS = 20  # area of a contact over the square of the finite elements' edge, from which they know its pressure
TURNED = 0.3  # how far tractions turn from a tool's way to the way that its surface faces [-]
LEAST_FACING = 0.3  # least cosine between a traction and the skin's normal at rest that is reckoned with
STRAIGHT = 0.36  # largest slant of a tool's way that is learnt from: no pose tells of it [rad]


@dataclass(frozen=True, eq=False)
class Pressed:
    """One converged contact: where the tool is, the nodes under it, and the true pressure.

    Args:
        sample: sample of the data set.
        tool: tool that presses.
        field: its signed distance.
        pose: pose of the tool, (4, 4).
        way: unit vector along which it came, (3,).
        squeeze: columns under it.
    """

    sample: Sample
    tool: Tool
    field: SignedDistance
    pose: Transform
    way: np.ndarray
    squeeze: Squeeze

    @property
    def nodes(self) -> Nodes:
        """Contact nodes under it."""
        return self.squeeze.nodes

    @property
    def touch(self) -> Touch:
        """What a contact law that knows the true pressure would say: the force is that of these pressures alone."""
        layer, pressure = self.sample.layer, self.sample.load.values
        force = -(pressure @ layer.vertex_area_vectors)
        return Touch(self.tool.name, BY_POSE, self.pose, np.concatenate([force, np.zeros(3)]), pressure=pressure,
                     pressed=Touched(self.field, self.squeeze, self.way))  # fmt: skip

    @property
    def force(self) -> np.ndarray:
        """Force that the tool presses with, (3,) [N]: that of the pressures, and what they leave out of it."""
        return self.touch.wrench[:3] / self.kept

    @property
    def kept(self) -> float:
        """See `kept_by_normals`."""
        one = self.sample
        return kept_by_normals(one.layer, Press(self.field, self.pose, self.way), one.load.values, one.displacement)

    @property
    def true(self) -> np.ndarray:
        """True pressure over E at all vertices, (V,) [-]."""
        return self.sample.load.values / self.sample.layer.tissue.youngs_modulus


def pressed(samples: Iterable[Sample]) -> Iterator[Pressed]:
    """Contacts of samples, each with its tool built again where it stood."""
    layer = columns = site = last = None
    for sample in samples:
        if sample.info["set"] != "tool":
            continue
        if sample.layer is not layer:
            layer, columns, site = sample.layer, Columns(sample.layer), Site(sample.layer)
        assert columns is not None and site is not None
        if last is None or last[0] != (sample.info["body"], sample.info["number"]):
            scene = tool_scene(site, sample.info["drawn"])
            assert scene.tool is not None
            way = -scene.pose_body_from_tool[:3, 2]
            field = SignedDistance.of(scene.tool, rounding=scene.rounding)
            tool = Press(field, scene.pose_body_from_tool, way).touching(sample.layer)
            assert tool is not None
            last = ((sample.info["body"], sample.info["number"]), tool, scene.tool,
                    site.thickness_under(scene.pose_body_from_tool))  # fmt: skip
        _, tool, mesh, thickness = last
        pose = tool.at(sample.info["ratio"] * thickness).pose_body_from_tool
        yield Pressed(sample, mesh, tool.field, pose, tool.direction, columns.squeezed(tool.field, pose))


def force_of(layer: SoftLayer, nodes: Nodes, pressure: np.ndarray) -> np.ndarray:
    """Force on the limb, (3,) [N], of pressures at contact nodes (N,) [Pa], on skin that sticks."""
    some, values = nodes.at_vertices(pressure, layer.vertex_areas)
    wrench, _, _ = wrench_of(values, some, layer.vertices, layer.vertex_area_vectors, np.zeros(3), layer.stacked)
    return wrench[:3]


def kept_by_normals(layer: SoftLayer, tool: Press, pressure: PerVertex, displacement: VertexVectors) -> float:
    """Share of the force that a tool presses with, that pressures along the skin's normals at rest make, about [-].

    Data keep of the tractions only that pressure. Here they are taken to lie between the tool's way and the normal of
    its surface where the skin came to, nearer to the way: under balls, discs and capsules on limbs the force is then
    known to 0.8 % (root mean square of 70 presses), 2.2 % at the worst.

    Args:
        layer: skin at rest.
        tool: tool where it stands.
        pressure: normal part of the tractions on the skin at rest, (V,) [Pa].
        displacement: motion of the skin, (V, 3) [m].
    """
    on = np.flatnonzero(pressure > 0)
    inward, carried = -layer.normals[on], pressure[on] * layer.vertex_areas[on]
    surface = tool.jet(layer.vertices[on] + displacement[on])[1]
    along = tool.direction + TURNED * surface / np.maximum(np.linalg.norm(surface, axis=1, keepdims=True), 1e-9)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    facing, across = np.maximum(np.einsum("vx,vx->v", inward, along), LEAST_FACING), carried @ inward
    return float(across @ across / (across @ ((carried / facing) @ along)))


@dataclass(frozen=True, eq=False)
class Rows:
    """Nodes of many contacts, one after the other, and the vertices that they press on.

    Args:
        rows: inputs, laid out as stmpl_core.networks.NODE, (N, NODE.size) float32.
        prior: pressure over E that the network corrects, (N,) float32.
        fade: share of the correction, (N,) float32.
        area: area of the node, over its contact's scale, (N,) float32.
        corners: rows of `true` of the vertices around the node, (N, 3).
        shares: barycentric coordinates, (N, 3) float32.
        starts: first node of each contact, and the end, (C + 1,).
        true: true pressure over E at the vertices, (M,) float32.
        vertex_area: area of the vertices, over the contact's scale, (M,) float32.
        vertex_starts: first vertex of each contact, and the end, (C + 1,).
    """

    rows: np.ndarray
    prior: np.ndarray
    fade: np.ndarray
    area: np.ndarray
    corners: np.ndarray
    shares: np.ndarray
    starts: np.ndarray
    true: np.ndarray
    vertex_area: np.ndarray
    vertex_starts: np.ndarray

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return len(self.starts) - 1

    def some(self, contacts: np.ndarray) -> Rows:
        """Some of the contacts, by their numbers."""
        return Rows.joined([self._one(int(k)) for k in contacts])

    def _one(self, k: int) -> Rows:
        nodes, vertices = slice(*self.starts[k : k + 2]), slice(*self.vertex_starts[k : k + 2])
        return Rows(self.rows[nodes], self.prior[nodes], self.fade[nodes], self.area[nodes],
                    self.corners[nodes] - self.vertex_starts[k], self.shares[nodes],
                    np.array([0, nodes.stop - nodes.start]), self.true[vertices], self.vertex_area[vertices],
                    np.array([0, vertices.stop - vertices.start]))  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Contacts of several, in order."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts])
                   for name in ("rows", "prior", "fade", "area", "shares", "true", "vertex_area")}  # fmt: skip
        counts = [np.concatenate([np.diff(getattr(part, name)) for part in parts]) for name in
                  ("starts", "vertex_starts")]  # fmt: skip
        starts, vertex_starts = (np.concatenate([[0], np.cumsum(count)]) for count in counts)
        before = np.cumsum([0] + [len(part.true) for part in parts])
        corners = np.concatenate([part.corners + k for part, k in zip(parts, before, strict=False)])
        return cls(**columns, corners=corners, starts=starts, vertex_starts=vertex_starts)


def seen(one: Pressed, net: ContactNet) -> Rows | None:
    """What the network sees of a contact; None where finite elements were too coarse to know its pressure."""
    return rows_of(one.sample.layer, one.nodes, one.true, net,
                   LEAST_CELLS * (one.sample.layer.edge_length / 2**INDENTER_REFINE) ** 2)  # fmt: skip


def rows_of(layer: SoftLayer, nodes: Nodes, true: np.ndarray, net: ContactNet, least: float = 0.0) -> Rows | None:
    """What the network sees at contact nodes, and what is true at the vertices around.

    Args:
        layer: skin.
        nodes: contact nodes.
        true: true pressure over E at all vertices, (V,) [-].
        net: law on that skin.
        least: area that must touch; less is None [m2].
    """
    if not len(nodes.area) or not true.any():
        return None
    look = net.look(nodes)
    if float(nodes.area[look.pressure > 0].sum()) < least:
        return None
    vertices, float32 = np.union1d(nodes.corners, np.flatnonzero(true)), np.float32
    areas = layer.vertex_areas[vertices]
    scale = areas.sum()
    return Rows(look.inputs, look.pressure.astype(float32),
                look.fade.astype(float32), (nodes.area / scale).astype(float32),
                np.searchsorted(vertices, nodes.corners), nodes.shares.astype(float32),
                np.array([0, len(nodes.area)]), true[vertices].astype(float32), (areas / scale).astype(float32),
                np.array([0, len(vertices)]))  # fmt: skip


def slant_of(sample: Sample) -> float:
    """Angle between a tool's way and the skin's normal [rad]."""
    return float(np.hypot(*sample.info["drawn"]["slant"]))
