"""Toucher: finds what tools do to the skin by their poses and wrenches: from Contacts to Touches."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Transform
from stmpl_core.columns import HOLE_RADIUS, NO_SQUEEZE, Clearance, Columns, Squeeze, grid_of, shifted
from stmpl_core.contact import Contact
from stmpl_core.contact_net import NOTHING, ContactNet, Held
from stmpl_core.deep import DEEPEST, Deep
from stmpl_core.footing import curvature_at
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.nodes import Nodes, ball_around, gathered, strains_under
from stmpl_core.obstacle import REACH
from stmpl_core.pieces import DEEP, GROUP, WIDER, pins
from stmpl_core.rays import WALL, way_of
from stmpl_core.sdf import SignedDistance, deepest_corner, lacking, mean_off
from stmpl_core.tools import Tools
from stmpl_core.touch import (
    APART,
    BY_POSE,
    IN_CORE,
    MOVED,
    NO_FORCE,
    NO_TOUCH,
    PULLING,
    TOUCHING,
    WRAPPED,
    Pressed,
    Touch,
)
from stmpl_core.trust import Trust
from stmpl_core.wrenches import wrench_of

if TYPE_CHECKING:
    from stmpl_core.skin import Skin
    from stmpl_core.tissue import Ply, Tissue

MAX_TOOL_OFFSET_M = 3e-3  # distance that calibration may leave between a pressing tool and its stated place
MUCH_MOVED = 0.5  # way of a tool to where it presses as told, over the thickness, that is not yet worth a word
MAX_TOUCHING_GAP = 0.25  # largest gap of a tool that touches between vertices, over a hole's radius
GAP_TOLERANCE_M = 1e-6  # gap at which the search along the force ends
MIN_FACING_COSINE = 0.1  # cosine between push and inward normal from which the skin faces a tool that looks for it
MIN_NET_FORCE_SHARE = 0.1  # force over the sum of its parts' sizes, below which a contact has no direction
MAX_DRAG_RATIO = 0.3  # tangential over normal force that is not yet worth a word
MARGIN_SHARE = 2 / 3  # width of the distance fields around tools, over the thickness
MAX_AROUND = 0.02  # depth of skin in a tool that presses nothing, over the thickness, that is not yet worth a word
MAX_BESIDE = 0.3  # change of a force by the tools beside, beyond which the pose of a tool with a wrench is worth little
OPEN = 2.0  # distance of a hole in a tool's mesh over the depth, up to which what is inside the tool there is a guess
SHELL, SHELL_FROM = 2.5, 0.02  # bound on a force per share of work above this by which a limb is stiff as a shell
SHALLOW, SHALLOW_TO = 0.1, 0.05  # bound on a first touch of one material, and depth over the thickness where it ends
MOST_MORE = 100.0  # logarithm of how much harder a touch may press, as facets lie below smooth skin, at most
MOST_LED = 3.0  # likewise of a thin tool, as skin is led out of its walls
UNSOLVED = 0.02  # how far depths may be missed, over the deepest, where contact is found
STUCK = 0.5  # error of what skin that sticks carries along itself, over that
MAX_LEVER = 1.0  # torque that is not carried over the force, over the contact's radius, that is not yet worth a word
SURE = 0.02  # largest error of a distance field over the depth, up to which it does not matter where the field is off
MOST_OFF = 0.1  # error of a distance field where a tool presses, over the depth, beyond which the force is not known
LED_OUT = 0.95  # how far nodes sink with their tool over how deep it is in their columns: below, these lead out of it
LED_FROM = 0.1  # depth over the thickness up to which as much may be lost as there: a first touch loses little
THIN_FROM, THIN_MORE, THIN_TO = 14.0, 0.03, 50.0  # bound on tools that have sunk, by depth over their half thickness
LOW = 3.0  # share of that by the share of the depth that a tool's height lacks
LED_DEEP, LED_LOST = 0.9, 0.35  # depth over the deepest of nodes that tell it first, and share that these may lack
LOOKED_AT = 48  # tips of a tool that presses nothing that are looked at, the farthest; and as many of the others
EDGE_SURE = 0.05  # share of its depth that an edge of a box lacks, with which contacts were learnt
EDGE_OFF, MOST_LACKING = 0.2, 0.98  # depth of an edge that a distance field does not tell, from which it is flagged
TIP_FROM = 0.1  # depth over the thickness from which the corners of a tool are looked at
FIRST = 0.01  # depth over the thickness from which touches were tried
MUCH_STIFFER = 4.5, 22.0  # stiffness over that of what lies above, bare and under a skin, from which that may be felt
SOFT_SHARE = 0.25, 0.56  # depth over the soft tissue's, likewise, to which force is within its bound over nearly bone
NEARLY_BONE, FELT = 50.0, (1.5, 0.4)  # under a skin: from there on; below, so deep, and the less by this power of it
FEW_RATIO, FEW = 0.45, 8.0  # Poisson's ratio that most layers were learnt with, and bound by how far it is below that
OVER_SOFT = 0.25, 0.04, 0.15  # bound by how much stiffer a material is than one below it, at the skin and from this
# share of the thickness on: 10 times so over 8 mm force is 41 % off, a tensed belly over its organs 9 to 16
MOST_OVER_SOFT = 0.35  # that share of the bound beyond which it is flagged: a tensed belly has 0.31
RATIOS_APART = 0.06  # difference of the materials' Poisson's ratios: 0.05 cost nothing, of 0.1 force is 15 % off
MAX_PULL = 1.0, 1.5  # T / (E t) of the effective layer that is tried: of any skin, and of skin no tauter than TAUT
TAUT = 0.12, 1.0, 1.6  # T / (E_s h) up to which limbs were learnt (0.1), as the regions' skins are, also relaxed; bound
# beyond, at most, and its rise: of a tube 0.55 of its radius thick force is 10 % off at 0.27, 12 at 0.47, 15 at 0.93
PULLS_FROM = 0.2  # T / (E t) from which that is widened in full: what hardly pulls widens hardly
SLACK = 0.012, 0.5  # T / (E_s h), and kappa, below and above which skin is slack and matters: force then falls with T
PINS = 3  # tools side by side from which they may be pins of one brush
SIDES = (0.2, 0.9)  # share of the force that points one way: below, a tool closes around; between, none was learnt
MAX_UNSEEN_FORCE_SHARE = 0.1  # share of the force that vertices unlike all training contacts may carry
MAX_PRESSED_STRAIN, STRAINED = 0.85, 0.003  # depth over thickness beyond which no wrench presses a tool, and how well
RIM = 0.75, 0.89  # depth over the mean thickness from which a tool with a rim that is too deep is drawn back: wholly
STIFFENING = 10.0  # growth of the force beyond, relative, a thickness of the way that it was drawn back
FORCE_TOLERANCE = 0.015  # relative error of the force at which trials end; the rest of the way is reckoned
LEAST_STEP, SMALL_STEP = 2e-4, 0.05  # step of the depth, over the thickness and itself, that is likewise only reckoned
THICKER = (0.3, 0.8), (1.2, 0.5), (0.35, 1.3)  # see Thicker; without a skin, and under one
TAKES_KAPPA = 0.5  # kappa from which a skin is one
FIRST_DEPTH = 0.05  # depth of the first trial of a tool that is at the skin or over it, over the thickness
MAX_DEPTH_TRIALS = 14  # trials of the depth for one wrench
STIFFER = 1.1  # power of the depth with which the force grows over that of the linear layer, until a trial says more
POWERS = (0.7, 6.0)  # range of that power
DISAGREES = 0.1, 0.05  # depth over the thickness, and pull over what the pose presses with, that cannot both be true
FAR = 10.0  # distance of a tool from the limb beyond which its pose is taken to be in millimetres [m]
MANY_TOOLS = 8  # number of tools from which those that are apart are told by a tree of boxes
WHY = {
    NO_TOUCH: "{name} presses, but no skin is within {reach:g} mm along its force",
    PULLING: "{name} pulls: nothing is taken to stick, so nothing is loaded",
    WRAPPED: "{name} closes around the limb: its wrench does not say how hard it squeezes; "
             "give each finger as a contact, or leave the wrench out",
    IN_CORE: "{name} reaches {depth:.1f} mm deep, into the rigid core: check its pose or the thickness",
}  # fmt: skip
LOST = "{name} is at triangles {long:.0f} mm long, between whose corners it may press unseen: remesh the skin"


class _Placed(NamedTuple):
    """A tool where it presses, before its neighbours are known."""

    contact: Contact
    field: SignedDistance
    status: str
    pose: Transform
    depth: float  # depth of the stated pose [m]
    moved: float  # way along the force [m]
    squeeze: Squeeze
    force: float | None  # force to carry along the mean normal [N]; None: what the pose presses with
    why: str = ""
    held: Held | None = None  # pressures of the skin against this tool alone, where they are known
    factor: float = 1.0  # on the pressures: what a tool that was drawn back presses more
    rim: bool = False  # truth of the claim that a part of the skin below is deeper than DEEPEST, and the most is not
    lost: bool = False  # truth of the claim that it may press between corners of long triangles, where it is not found

    @property
    def unknown(self) -> bool:
        """Whether it may press though nothing of that is found."""
        return self.lost or self.status == IN_CORE


class Toucher:
    """Finds the skin that tools cover, and the pressure that carries them: the contact law on one layer.

    A tool covers a column when the column, skin to core, enters it, counted from the core: so a tool thinner than the
    layer may be pressed under the skin's rest position, and the far side of the limb stays free. How far the columns
    are squeezed is sampled between the vertices (Columns), so the load changes continuously while the tool slides; what
    holds them so is Winkler's pressure, corrected by a network trained on finite elements (ContactNet).

    Without a wrench the pose decides. With one, its component along the mean contact normal is carried: the tool is
    moved along the force until it presses as hard as the wrench says; the stated pose is a first guess.

    Args:
        layer: skin.
        near: neighbours of its vertices; None: found here.
        tools: tools with their distance fields; None: an empty store.
        reach: distance that a pressing tool may be from where its force says that it is [m].

    Attributes:
        joints: angle of each joint where the skin is [rad]; empty: at rest.
    """

    def __init__(self, layer: SoftLayer, near: Surroundings | None = None, tools: Tools | None = None, *,
                 reach: float = MAX_TOOL_OFFSET_M) -> None:  # fmt: skip
        self.layer, self.reach, self.joints = layer, reach, ()
        self.near = near or Surroundings.of(layer)
        self.hole = HOLE_RADIUS * layer.edge_length
        self.tools = Tools(margin_on(layer)) if tools is None else tools
        self.columns, self.net = Columns(layer), ContactNet(layer, near=self.near)
        self._modulus = layer.tissue.youngs_modulus
        self._thickest = float(layer.thickness.max())
        self._inward, self.deep = self.columns.inward, Deep(self.columns)
        self._soft, self._doubt, self._thicker = soft_depth(layer), tissue_doubt(layer), thicker_than_most(layer)
        nothing, one = np.zeros((1, 4)), np.ones(1)  # compiled now
        three = nothing[:, 1:].copy()
        mean_off(nothing, np.eye(4), three, one)
        lacking(nothing, np.eye(4), np.zeros(3), three, one, 0.0)
        deepest_corner(three, np.eye(4), three, three, one, one)

    @cached_property
    def _unlearnt(self) -> list[str]:
        return unlearnt(self.layer, *self.net.weights.card["ranges"]["poisson_ratio"])

    def give(self, nodes: Nodes, forces: np.ndarray) -> np.ndarray:
        """How a contact gives along the skin, beyond a flat layer, (3, 3) [m/N]. See `curvature`."""
        return Green.of(self.layer).give(nodes, forces) / self.layer.tissue.youngs_modulus

    def curvature(self, nodes: Nodes, forces: np.ndarray) -> np.ndarray:
        """Curvature of the skin at nodes, weighed with their forces (N,), (3, 3) [1/m]; convex is positive."""
        near = self.near
        return curvature_at(nodes.corners, nodes.shares, forces, near.frames, near.curvature, near.thickness)

    def moved(self, skin: Skin) -> Toucher:
        """The same law and tools where joints take the skin."""
        out = copy(self)
        out.layer, out.near, out.joints = skin.layer, skin.near, skin.angles
        out.columns, out.net = self.columns.moved(skin.layer), self.net.moved(skin.near, skin.green)
        out._inward, out.deep = out.columns.inward, Deep(out.columns)
        out._thickest = float(skin.layer.thickness.max())
        return out

    def touch(self, contact: Contact) -> Touch:
        """Touch of one contact alone. Raises MeshError: a surface that cannot be a tool."""
        return self.touch_all([contact])[0]

    def touch_all(self, contacts: Sequence[Contact], *, alone: bool = True,
                  tried: Mapping[str, float] | None = None) -> list[Touch]:  # fmt: skip
        """Touches of several contacts at once: tools side by side feel each other through the skin.

        Args:
            contacts: tools at one instant.
            alone: whether each touch is the last word, and tells of what of its wrench is not carried (`unmet`).
            tried: way along its force that a tool with a wrench is tried at first, by name [m]; else where it meets
                the skin.
        """
        if not contacts:
            return []
        many = len(contacts) >= MANY_TOOLS
        first = tried or {}
        placed = [self._place(contact, self.tools.field(contact.tool), many, first.get(contact.name))
                  for contact in contacts]  # fmt: skip
        pressing = sorted((one for one in placed if len(one.squeeze.nodes.area)), key=lambda one: one.contact.name)
        held: dict[str, Held] = {}
        beside: dict[str, tuple[float, float]] = {}
        covered: set[str] = set()
        told: dict[str, _Placed] = {}
        for some in groups_of([one.squeeze.nodes.points for one in pressing], self._thickest):
            group = [pressing[n] for n in some]
            if len(group) == 1:
                held[group[0].contact.name] = group[0].held or self.net.hold(group[0].squeeze.nodes)
                continue
            squeezes = self.columns.as_one([(one.field, one.pose, one.squeeze) for one in group])
            group = [one._replace(squeeze=squeeze) for one, squeeze in zip(group, squeezes, strict=True)]
            told |= {one.contact.name: one for one in group}
            nodes = self.joined([(one.field, one.pose, one.squeeze) for one in group])
            together = self.net.hold(nodes)
            if len(group) >= PINS:
                forces = together.pressure * nodes.area
                among = pins(nodes.points, nodes.area, nodes.thickness, forces)
                beside |= {one.contact.name: among for one in group}
            end = 0
            for one in group:
                start, end = end, end + len(one.squeeze.nodes.area)
                held[one.contact.name] = together.some(start, end)
            covered |= self._covered(group, nodes, held)
        placed = [told.get(one.contact.name, one) for one in placed]
        return [self._answer(one, held.get(one.contact.name, NOTHING), beside.get(one.contact.name), alone,
                             one.contact.name in covered) for one in placed]  # fmt: skip

    def joined(self, tools: Sequence[tuple[SignedDistance, Transform, Squeeze]]) -> Nodes:
        """Nodes of tools that feel each other, one after the other: field, pose_body_from_tool and squeeze of each."""
        if len(tools) == 1:
            return tools[0][2].nodes
        nodes, ends = Nodes.joined([squeeze.nodes for *_, squeeze in tools]), [0]
        beside = np.empty((len(nodes.area), len(tools)))
        for k, (field, pose, squeeze) in enumerate(tools):
            ends.append(ends[-1] + len(squeeze.nodes.area))
            beside[ends[k] : ends[k + 1], k] = -1.0
            for others in (slice(ends[k]), slice(ends[k + 1], None)):
                if len(beside[others]):
                    beside[others, k] = strains_under(grid_of(field), pose, nodes.points[others], nodes.inward[others],
                                                      nodes.thickness[others], squeeze.top)  # fmt: skip
        return nodes._replace(beside=beside)

    def _covered(self, group: Sequence[_Placed], nodes: Nodes, held: Mapping[str, Held]) -> set[str]:
        """Names of the tools of a group that would press alone, had not the others pushed all skin off their way.

        Args:
            group: tools that feel each other.
            nodes: their nodes, one after the other.
            held: what holds the skin against each, by name.
        """
        free = [not held[one.contact.name].pressure.any() for one in group]
        if not any(free):
            return set()
        ends = np.cumsum([len(one.squeeze.nodes.area) for one in group])[:-1]
        parts = zip(group, free, np.split(self.net.apart(nodes), ends), strict=True)
        off = [one for one, nothing, apart in parts if nothing and apart.all()]
        return {one.contact.name for one in off if (one.held or self.net.hold(one.squeeze.nodes)).pressure.any()}

    def _place(self, contact: Contact, field: SignedDistance, many: bool, tried: float | None) -> _Placed:
        """Where the tool presses, or why it does not; tried: see `touch_all`."""
        pose = contact.pose_body_from_tool
        if tried is not None and contact.wrench is not None:
            stated = contact.wrench[:3]
            pose = shifted(pose, tried / math.sqrt(stated @ stated) * stated)
        reach = 0.0 if contact.wrench is None else self.reach
        clearance = self._clearance(field, pose, reach, many)
        depth = -clearance.nearest

        def nothing(status: str) -> _Placed:
            around, why = -float(clearance.skin.min(initial=np.inf)), ""
            off = float(np.abs(pose[:3, 3] - self.layer.vertices[0]).max())
            if status != NO_FORCE and (long := self.columns.between(field, pose, reach)):
                why = LOST.format(name=contact.name, long=1e3 * long)
                return _Placed(contact, field, status, pose, math.nan, 0.0, NO_SQUEEZE, 0.0, why=why, lost=True)
            if status == APART and around > MAX_AROUND * self._thickest:
                status, why = WRAPPED, f"{1e3 * around:.1f} mm of skin are inside {contact.name}, which no column " \
                    "meets from outside: check its pose, its scale and which side of its surface is out"  # fmt: skip
            elif status == APART and -depth < field.mostly_off > 2 * FIRST * self._thickest:
                why = f"{contact.name} may touch: it is {-1e3 * depth:.2g} mm away, and its distance field is " \
                    f"{1e3 * field.mostly_off:.2g} mm off: leave out what of it is far away"  # fmt: skip
            elif status in (APART, NO_TOUCH) and off > FAR:
                why = f"{contact.name} is {off:.3g} m from the limb: is its pose in millimetres? Scale it by 1e-3"
            told = around if -depth >= self.hole else depth  # along columns that far away only a bound is known
            return _Placed(contact, field, status, pose, told, 0.0, NO_SQUEEZE, 0.0, why=why)

        force, tool = contact.wrench[:3] if contact.wrench is not None else None, contact.tool.vertices
        light = force is not None and 0 < depth < 0.5 * float(self.layer.thickness[clearance.vertices].min())
        squeeze = NO_SQUEEZE if light else self.columns.squeeze(field, pose, clearance)
        inside = not light and not len(squeeze.nodes.area) and not self.columns.between(field, pose, 0.0) \
            and self.deep.inside(field, pose, tool)
        if force is not None and not force.any():
            felt_from = max(self.reach, MUCH_MOVED * float(squeeze.nodes.thickness.max(initial=0.0)))
            if inside or (depth > felt_from and not light):
                deep = "inside the limb" if inside else f"{1e3 * depth:.2g} mm deep in the skin"
                why = f"{contact.name} is {deep} by its pose, and its force is zero: they disagree. Check its sensor"
                return nothing(NO_FORCE)._replace(why=why)
            return nothing(NO_FORCE if depth > 0 else APART)
        if inside or self.deep.strain(squeeze) >= DEEPEST:
            core = inside or bool((squeeze.depth >= self.layer.thickness[squeeze.vertices]).any())
            share = 1.0 if inside else self._deep_share(squeeze)
            if force is None and not share:
                return _Placed(contact, field, IN_CORE if core else BY_POSE, pose, depth, 0.0, squeeze, None, rim=True)
            back, drawn, way = self.deep.drawn_back(field, pose, tool, squeeze)
            if force is None:
                deepest = self._depth(drawn) + way
                if share < 1:
                    way *= share
                    back = shifted(pose, share * (back[:3, 3] - pose[:3, 3]))
                    drawn = self.columns.squeezed(field, back)
                return _Placed(contact, field, IN_CORE if core else BY_POSE, back, deepest, -way, drawn, None,
                               factor=1 + STIFFENING * way / self._thickest, rim=share < 1)  # fmt: skip
            pose, clearance = back, self._clearance(field, back, reach)
        elif force is None:
            return _Placed(contact, field, BY_POSE, pose, depth, 0.0, squeeze, None) if len(squeeze.nodes.area) \
                else nothing(APART)
        gap = self._gap(field, pose, clearance, force)
        found = None if gap is None else self._pressed(contact, field, pose, clearance, depth, gap)
        if tried is None:
            if found is None and gap == 0.0:
                pulls = nothing(PULLING)
                return pulls if pulls.lost \
                    else pulls._replace(why=self._disagrees(contact, field, pose, clearance, depth))
            return found or nothing(NO_TOUCH if gap is None else PULLING)
        if found is None or found.status == WRAPPED:
            return self._place(contact, field, many, None)
        apart = found.moved - self._depth(found.squeeze) > MAX_TOUCHING_GAP * self.hole
        return found._replace(status=MOVED) if apart else found

    def _deep_share(self, squeeze: Squeeze) -> float:
        """Share of the way by which a tool is drawn back that is too deep: none where that is a rim over thin tissue,
        and it is not deep by the thickness in the mean; all of it as on an even layer, where each column is as deep.

        There the columns bear no more than at MAX_COLUMN_STRAIN: to draw all of the tool back for one took 20 % of its
        force off as it slid on to it.
        """
        thickness = squeeze.nodes.thickness
        if not len(thickness):
            return 1.0
        x = (self._depth(squeeze) / float(thickness.mean()) - RIM[0]) / (RIM[1] - RIM[0])
        x = min(max(x, 0.0), 1.0)
        return x * x * (3 - 2 * x)

    def _disagrees(self, contact: Contact, field: SignedDistance, pose: Transform, clearance: Clearance,
                   depth: float) -> str:  # fmt: skip
        """Why a wrench that pulls a tool out of the skin is not believed: the pose is deep; empty: it may be so.

        pose: the stated one, or where it was drawn back to from deeper; depth: of the stated one [m].
        """
        assert contact.wrench is not None
        squeeze, force = self.columns.squeeze(field, pose, clearance), contact.wrench[:3]
        nodes = squeeze.nodes
        if not len(nodes.area) or max(depth, self._depth(squeeze)) < DISAGREES[0] * float(nodes.thickness.mean()):
            return ""
        v, pressure = nodes.at_vertices(self.net.hold(nodes).pressure * self._modulus, self.layer.vertex_areas)
        vector = wrench_of(pressure, v, self.layer.vertices, self.layer.vertex_area_vectors, pose[:3, 3],
                           self.layer.stacked)[0][:3]  # fmt: skip
        size = float(np.linalg.norm(vector))
        pull = -float(force @ vector) / max(size, 1e-300)
        if not pull > DISAGREES[1] * size:
            return ""
        return (f"{contact.name} is {1e3 * max(depth, self._depth(squeeze)):.2g} mm deep in the skin by its pose, and "
                f"its wrench pulls with {pull:.2g} N: they disagree, and nothing is loaded. Check the wrench's sign: "
                "it is what the tool exerts on the body")  # fmt: skip

    def _clearance(self, field: SignedDistance, pose: Transform, reach: float, many: bool = False) -> Clearance:
        """Clearance of the columns that a tool touches, or misses by a hole of the mesh.

        Where it touches none: of those within `reach` besides [m]; of more where there is none, to say how far.
        """
        far = self.hole
        found = self._cleared(field, pose, far, far, many)
        if found.nearest > 0 and reach > 0:
            far += reach
            found = self._cleared(field, pose, far, far, many)
        if found.nearest < far:
            return found
        wide = far + self._thickest
        return self._cleared(field, pose, wide, wide if reach > 0 else far, many)

    def _cleared(self, field: SignedDistance, pose: Transform, within: float, far: float,
                 many: bool = False) -> Clearance:  # fmt: skip
        return self.columns.clearance(field, pose, self.columns.near(field, pose, within, many=many), far)

    def _depth(self, squeeze: Squeeze) -> float:
        """Depth of the deepest column [m]."""
        return _deepest(squeeze.depth, squeeze.nodes.strain, squeeze.nodes.thickness)

    def _gap(self, field: SignedDistance, pose: Transform, clearance: Clearance, force: np.ndarray) -> float | None:
        """How far a tool that is apart must go along `force` to be 0 from the skin that faces it, by sphere tracing.

        0 where it touches. A tool that passes between vertices stops where it is nearest. None: it comes no nearer
        than a hole of the mesh within `reach` [m].
        """
        if clearance.nearest <= 0:
            return 0.0
        push = force / np.linalg.norm(force)
        facing = clearance.vertices[self._inward[clearance.vertices] @ push > MIN_FACING_COSINE]
        moved, best, nearest = 0.0, None, self.hole
        while moved <= self.reach:
            gap = self.columns.clearance(field, shifted(pose, moved * push), facing, self.reach + self.hole).nearest
            if gap < nearest:
                best, nearest = moved, gap
            if gap < GAP_TOLERANCE_M:
                break
            moved += gap
        return best

    def _pressed(self, contact: Contact, field: SignedDistance, start: Transform, stated: Clearance, depth: float,
                 gap: float) -> _Placed | None:  # fmt: skip
        """The tool moved along its force until it presses with its component along the contact normal.

        From trial to trial the force grows with a power of the depth, the last two trials say which. All inside a
        bracket. None: the force points away from the skin.
        """
        assert contact.wrench is not None
        layer, force = self.layer, contact.wrench[:3]
        push, stated_at = force / np.linalg.norm(force), contact.pose_body_from_tool[:3, 3]
        low, high, moved, best = -np.inf, np.inf, gap, None
        if stated.nearest > -FIRST_DEPTH * self._thickest:  # of a first touch little follows for what is deeper
            moved = gap + FIRST_DEPTH * self._thickest
        last: tuple[float, float] | None = None  # depth and force of the trial before
        strains: list[tuple[float, float]] = []  # way and strain of those that do not reach the core
        back, pressed_at = 0.1 * self._thickest, np.inf
        for _ in range(MAX_DEPTH_TRIALS):
            pose, clearance = shifted(start, moved * push), stated
            if moved:
                clearance = self._cleared(field, pose, self.hole, self.hole)
            squeeze = self.columns.squeeze(field, pose, clearance)
            v, strain = squeeze.vertices, self.deep.strain(squeeze)
            if strain < 1 or not strains:
                strains.append((moved, strain))
            through = moved > pressed_at  # deeper than where it pressed: it may have gone through the limb
            if not (self._inward[v] @ push > MIN_FACING_COSINE).any() or not len(squeeze.nodes.area):
                if best is None and gap == 0.0 and len(squeeze.nodes.area):
                    return None
                low, moved, high = _elsewhere(low, moved, high, through, 0.05 * self._thickest)
                continue
            held = self.net.hold(squeeze.nodes)
            some, pressure = squeeze.nodes.at_vertices(held.pressure * self._modulus, layer.vertex_areas)
            vector = wrench_of(pressure, some, layer.vertices, layer.vertex_area_vectors, pose[:3, 3],
                               layer.stacked)[0][:3]  # fmt: skip
            size = float(np.linalg.norm(vector))
            if not size > 0 and (through or not pressure.any()):  # of what is on the far side, or of a first touch
                low, moved, high = _elsewhere(low, moved, high, through, 0.05 * self._thickest)
                continue
            wrapped = size <= MIN_NET_FORCE_SHARE * float(pressure @ layer.vertex_areas[some])
            if wrapped and not through:
                return _Placed(contact, field, WRAPPED, contact.pose_body_from_tool, depth, 0.0, NO_SQUEEZE, 0.0)
            normal = 0.0 if wrapped else float(force @ vector) / size
            if normal <= 0 and not through:
                return None
            deep, power = self._depth(squeeze), held.power * STIFFER
            if last is not None and abs(deep / last[0] - 1) > 1e-6:
                power = float(np.log(size / last[1]) / np.log(deep / last[0]))
            power = min(max(power, POWERS[0]), POWERS[1])
            gain = max(normal / float(np.linalg.norm(force)), MIN_FACING_COSINE)
            further = deep * ((max(normal, 0.0) / size) ** (1 / power) - 1) / gain
            following = min(moved + further, _strained(strains, squeeze))
            if normal <= 0 or strain > MAX_PRESSED_STRAIN + STRAINED:  # too deep, whatever it presses with
                if not strain < 1:
                    back, following = 2 * back, min(following, moved - back)
                high = min(high, moved)
                moved = following if low < following < high else 0.5 * (max(low, high - 2 * back) + high)
                continue
            status = MOVED if gap > MAX_TOUCHING_GAP * self.hole else TOUCHING
            way = float((pose[:3, 3] - stated_at) @ push)
            best, pressed_at = _Placed(contact, field, status, pose, depth, way, squeeze, normal, held=held), moved
            if abs(size / normal - 1) < FORCE_TOLERANCE or \
                    abs(further) < min(LEAST_STEP * self._thickest, SMALL_STEP * deep):
                under = np.where(squeeze.depth > 0, squeeze.depth + further * (self._inward[v] @ push), 0.0)
                return best._replace(pose=shifted(pose, further * push), moved=way + further,
                                     squeeze=squeeze._replace(depth=np.maximum(under, 0.0)))  # fmt: skip
            if size < normal and strain > MAX_PRESSED_STRAIN - STRAINED:
                why = (f"{contact.name} carries {size:.2g} of {normal:.2g} N along the skin's normal, "
                       f"pressed to {strain:.0%} of the layer")  # fmt: skip
                return best._replace(force=size, why=why)
            low, high, last = (moved, high, (deep, size)) if size < normal else (low, moved, (deep, size))
            if not low < following < high:  # halve the bracket, or go to where its open end must be
                least = 0.05 * self._thickest
                inside = np.isfinite(high - low)
                following = 0.5 * (low + high) if inside else min(high - least, max(low + least, following))
            moved = following
        if best is not None and best.force is not None:
            force = min(size or best.force, best.force)
            best = best._replace(force=force, why=f"{contact.name} did not settle within 2 %")
        return best

    def _answer(self, one: _Placed, held: Held, among: tuple[float, float] | None, alone: bool,
                covered: bool) -> Touch:  # fmt: skip
        """What a placed tool does, scaled to its wrench, with what may be believed of it.

        among: what `pins` says of the tools that press beside it, if there are many; covered: see `_covered`.
        """
        layer, nodes, unit, stated = self.layer, one.squeeze.nodes, one.factor * self._modulus, one.contact.wrench
        if not len(nodes.area):
            nothing, none = np.zeros(6), np.empty(0)
            touch = Touch(
                one.contact.name, one.status, one.pose, nothing, one.depth if math.isfinite(one.depth) else math.nan,
                math.nan if one.unknown else 0.0, one.moved, nothing if stated is None else stated,
                pressure=np.zeros(len(layer.vertices)))  # fmt: skip
            object.__setattr__(touch, "trust", self._trust(one, touch, none, none, 0.0, alone, covered))
            return touch
        v, pressure, values, wrench, forces, scale, size, doubt, strange, stuck, along, below, thickness = _carried(
            nodes.corners, nodes.shares, nodes.area, nodes.thickness, *held[:3], unit,
            math.nan if one.force is None else one.force, layer.vertex_areas, layer.vertices,
            layer.vertex_area_vectors, one.pose[:3, 3], layer.stacked, self.near.sound.facets)  # fmt: skip
        depth = self._depth(one.squeeze) if len(v) and not one.factor > 1 else one.depth
        way = stated[:3] / np.linalg.norm(stated[:3]) if stated is not None and stated[:3].any() else None
        known = self.net.weights.card["bound"]
        wrong = one.field.surface_error
        doubt += held.power * wrong / max(depth, wrong, 1e-300)  # how well depth is known
        if "uneven" in known and size > 0:
            doubt = math.hypot(doubt, known["uneven"] * self.net.unlike(thickness))
        bound = self._doubt * known["scale"] * doubt ** known["power"] if size > 0 else 0.0
        off = 0.0  # of a board that is thin beside the field's cells, all of its face may lie elsewhere
        if size > 0 and wrong > SURE * depth:
            off = mean_off(one.field.checks, one.pose, nodes.points, forces)
            bound += held.power * min(off / max(depth, 1e-300), 1.0)
        lack = lacks = 0.0  # how much deeper a sharp edge is than the distance field tells [m], and over that
        one_way = size > SIDES[1] * scale * float(forces.sum())
        if one_way and len(one.field.tips):
            lack = lacking(one.field.tips, one.pose, wrench[:3] / size, nodes.points, nodes.area, depth)
            lacks = min(lack / max(depth + lack, 1e-300), MOST_LACKING)
            bound += (1 - max(lacks - EDGE_SURE, 0.0)) ** -held.power - 1
        tip = tip_share = 0.0
        if one.factor == 1 and size > 0 and depth > TIP_FROM * thickness:
            tip, tip_share = deepest_corner(one.field.corners, one.pose, *nodes[:4])
            if tip_share > DEEPEST and tip > depth:
                bound += math.expm1(min(held.power * math.log(tip / depth), MOST_MORE))
        led = 1.0
        if one_way and layer.stacked:
            led = _led_in(nodes.sinking, nodes.strain, nodes.thickness, nodes.inward, wrench[:3] / size)
            if led < LED_OUT:
                bound += math.expm1(min(-held.power * math.log(max(led, 1e-300)), MOST_LED))
        bound += SHELL * max(held.shell - SHELL_FROM, 0.0)
        thicker = self.net.thicker(thickness) if size > 0 else 0.0
        bound += self._thicker.steep * max(thicker - self._thicker.least, 0.0)
        sunk, *way_in_tool = way_of(one.squeeze.top)
        if sunk:
            high = float(np.abs(way_in_tool) @ -np.subtract(*one.field.tool_bounds))
            low = min(max(LOW * (1 - high / max(depth, 1e-300)), 0.0), 1.0)
            thin = depth / max(one.field.half_thickness, 1e-300) - THIN_FROM
            bound += sunk * low * THIN_MORE * min(max(thin, 0.0), THIN_TO)
        missed = min(held.missed, 1.0)
        bound += 1 + held.power * missed if missed > UNSOLVED else 0.0
        if size > 0 and not layer.stacked:
            bound += SHALLOW * max(1 - depth / (SHALLOW_TO * thickness), 0.0)
        beside_off = 0.0 if one.force is None else abs(1 / scale - 1) if len(v) else 1.0  # each was placed as if alone
        if beside_off > 2 * FORCE_TOLERANCE:
            bound += beside_off
        flat = below / max(depth, 1e-300)  # the skin is no facets, whose middle lies twice as low
        more = held.power * math.log1p(flat + flat * min(flat, 1.0))
        bound += STUCK * along + math.expm1(min(more, MOST_MORE))
        beside, radius = among or pins(nodes.points, nodes.area, nodes.thickness, forces)
        wider = WIDER if beside > GROUP and depth > DEEP * radius else 1.0
        touch = Touch(
            one.contact.name, one.status, one.pose, wrench,
            depth=depth if math.isfinite(depth) else float("nan"),
            force_bound=size * bound * wider if size > 0 else math.nan if one.unknown else one.force or 0.0,
            moved=one.moved,
            missing=np.zeros(6) if stated is None else stated - wrench,
            pressure=values,
            pressed=Pressed(one.field, one.squeeze, way, one.factor, scale * forces, held.power * STIFFER,
                            stuck, along) if len(v) else None,
        )  # fmt: skip
        trust = self._trust(one, touch, v, pressure, strange, alone, covered)
        if off > MOST_OFF * max(depth, FIRST * thickness):
            trust = trust.also(f"where {touch.name} presses, {1e3 * depth:.2g} mm deep, its distance field is "
                               f"{1e3 * off:.2g} mm off: leave out what of it is far away", in_range=False)  # fmt: skip
        if lack > EDGE_OFF * max(depth + lack, FIRST * thickness):
            trust = trust.also(f"{touch.name} is {1e3 * (depth + lack):.2g} mm deep in the skin, and its distance "
                               f"field, of {1e3 * one.field.spacing:.2g} mm, tells {1e3 * depth:.2g} mm of its edge: "
                               "leave out what of it is far away", in_range=False)  # fmt: skip
        if tip_share > DEEPEST:
            trust = trust.also(f"a corner of {touch.name} is {1e3 * tip:.2g} mm deep in the skin, {tip_share:.0%} "
                               "of the tissue there", in_range=False)  # fmt: skip
        if (1 - led) * depth > (1 - LED_OUT) * max(depth, LED_FROM * thickness):
            trust = trust.also(f"{touch.name} is {1e3 * depth:.2g} mm deep, and thin: the skin below it is led out of "
                               f"its walls, and goes along by {led:.0%} of that", in_range=False)  # fmt: skip
        if thicker > self._thicker.most:
            trust = trust.also(f"tissue under {touch.name} is {1e3 * thickness:.2g} mm thick, {math.exp(thicker):.2g} "
                               "times what it is in the median of this skin, whose response is taken for all of it: "
                               "give a part that is more even", in_range=False)  # fmt: skip
        if missed > UNSOLVED:
            trust = trust.also(f"where {touch.name} presses was not found: skin misses it by {missed:.0%} of its depth",
                               in_range=False, converged=False)  # fmt: skip
        if beside_off > MAX_BESIDE:
            where = (f"no place was found where {touch.name} presses so: the nearest" if held is one.held else
                     f"{touch.name} was moved to where it presses so alone; beside the other tools that")  # fmt: skip
            trust = trust.also(f"{where} is {beside_off:.0%} off", in_range=False)
        if wider > 1 and len(v):
            trust = trust.also(f"{touch.name} presses with pins of {1e3 * radius:.2g} mm radius, "
                               f"{1e3 * depth:.2g} mm deep, that feel each other; contacts were learnt of one area",
                               in_range=False)  # fmt: skip
        object.__setattr__(touch, "trust", trust)  # nobody has it yet
        return touch

    def _trust(self, one: _Placed, touch: Touch, vertices: np.ndarray, pressure: np.ndarray, strange: float,
               alone: bool, covered: bool) -> Trust:  # fmt: skip
        name, layer, card, trust = touch.name, self.layer, self.net.weights.card, Trust()
        if one.status in WHY and not one.why:
            why = WHY[one.status].format(name=name, reach=1e3 * self.reach, depth=1e3 * touch.depth)
            trust = trust.also(why, in_range=False if one.status != PULLING else None)
        stated = one.contact.wrench
        if stated is not None and stated[3:].any() and not stated[:3].any():
            trust = trust.also(f"{name} asks for a torque without a force, which is not carried", in_range=False)
        if one.why:
            trust = trust.also(one.why, in_range=False)
        if not touch.force and not covered and one.status in (APART, BY_POSE) and one.depth > -self.hole:
            deep = self._tip(one)
            if deep > 0:
                trust = trust.also(f"a tip of {name} is {1e3 * deep:.2g} mm in the skin and presses nothing: it is "
                                   f"narrower than its distance field, of {1e3 * one.field.spacing:.2g} mm, tells",
                                   in_range=False)  # fmt: skip
        if not len(pressure):
            deep = not touch.depth <= MAX_AROUND * self._thickest
            if one.status == BY_POSE and deep and not covered:  # else others took its skin
                trust = trust.also(f"{name} is in the skin and presses nothing: check its mesh", in_range=False)
            return trust
        forces = pressure * layer.vertex_areas[vertices]
        for why in self.near.sound.of_contact(vertices, forces):
            trust = trust.also(why, in_range=False)
        total = float(forces.sum())
        one_way = touch.force / max(total, 1e-300)
        if SIDES[0] < one_way < SIDES[1]:
            trust = trust.also(f"{name} presses from several sides: {one_way:.0%} of its force points one way, and "
                               "what drags along its walls is not known", in_range=False)  # fmt: skip
        highest, most = card["ranges"]["p_over_e"][1], float(pressure.max())
        if touch.pressed is not None and touch.pressed.forces is not None:  # on a mesh finer than the nodes
            most = min(most, float((touch.pressed.forces / one.squeeze.nodes.area).max()))
        ratio = most / self.net.unit
        if ratio > highest:
            trust = trust.also(f"{name} presses with p/E = {ratio:.3g}; contacts were learnt up to {highest:.3g}",
                               in_range=False)  # fmt: skip
        deepest = touch.depth / (float(one.squeeze.nodes.thickness.sum()) / len(one.squeeze.nodes.thickness))
        if deepest > card["ranges"]["depth_over_thickness"][1] and one.status != IN_CORE:
            trust = trust.also(f"{name} presses to {deepest:.0%} of the thickness, learnt is "
                               f"{card['ranges']['depth_over_thickness'][1]:.0%}", in_range=False)  # fmt: skip
        elif one.rim and one.status != IN_CORE:
            trust = trust.also(f"{name} presses a part of the skin below it to over {DEEPEST:.0%} of the tissue there",
                               in_range=False)  # fmt: skip
        if touch.depth > self._soft and one.status != IN_CORE:
            stiffer = MUCH_STIFFER[layer.tissue.skin is not None]
            trust = trust.also(f"{name} presses {1e3 * touch.depth:.2g} mm into what lies over a material over "
                               f"{stiffer:g} times as stiff, tried is {1e3 * self._soft:.2g} mm", in_range=False)
        for why in self._unlearnt:
            trust = trust.also(why, in_range=False)
        if strange > MAX_UNSEEN_FORCE_SHARE:
            trust = trust.also(f"{strange:.0%} of the force of {name} is where no training contact was like it",
                               in_range=False)  # fmt: skip
        far = one.force is not None and abs(one.moved) > self.reach
        if far and abs(one.moved) > MUCH_MOVED * float(one.squeeze.nodes.thickness.max()):
            trust = trust.also(f"{name} was moved {one.moved * 1e3:+.1f} mm along its force: check its calibration")
        if alone:
            trust = self.unmet(trust, touch, stated)
        if not one.field.watertight:
            nodes, pose = one.squeeze.nodes, one.pose
            away = one.field.opening((nodes.points - pose[:3, 3]) @ pose[:3, :3])
            trust = trust.also(f"the mesh of {name} has holes")
            if away < OPEN * touch.depth + WALL * float(nodes.thickness.max()):
                trust = trust.also(f"a hole of {name} is {1e3 * away:.2g} mm from where it presses", in_range=False)
        if one.field.flipped:
            trust = trust.also(f"the mesh of {name} was inside out and was turned")
        return trust

    def _tip(self, one: _Placed) -> float:
        """How deep a tip of the tool is in the skin that its distance field may not tell [m]; 0: none is so deep."""
        tips = one.field.tips
        if not len(tips):
            return 0.0
        tips = np.concatenate([tips[:LOOKED_AT], tips[LOOKED_AT :: len(tips) // LOOKED_AT + 1]])
        at = tips[:, :3] @ one.pose[:3, :3].T + one.pose[:3, 3]
        v = self.columns.nearest(at)
        away = at - self.columns.points[v]
        deep = np.einsum("nx,nx->n", away, self._inward[v])
        beside = np.linalg.norm(away - deep[:, None] * self._inward[v], axis=1)
        known = (beside < self.layer.edge_length) & (deep > 2 * FIRST * self.layer.thickness[v])
        return float(deep[known].max(initial=0.0))

    def unmet(self, trust: Trust, touch: Touch, stated: np.ndarray | None) -> Trust:
        """The trust in a touch, lowered where much of the stated wrench (6,) is not carried."""
        if touch.pressed is None:
            return trust
        name, force, drag = touch.name, touch.force, touch.drag
        if stated is not None and stated[3:].any():
            nodes, forces = touch.pressed.squeeze.nodes, touch.pressed.forces
            if forces is None or not forces.any():
                forces = nodes.area
            arm = forces @ nodes.points / forces.sum() - touch.pose_body_from_tool[:3, 3]
            turns = touch.missing[3:] - np.cross(arm, touch.missing[:3])  # wherever the tool's own origin is
            lever = float(np.linalg.norm(turns)) / max(force, 1e-300)
            area = float(nodes.area.sum())
            slack = min(self.reach, float(np.subtract(*touch.pressed.field.tool_bounds[::-1]).max()))
            if lever > max(MAX_LEVER * (area / np.pi) ** 0.5, slack):
                trust = trust.also(f"{name} also turns with {1e3 * force * lever:.2g} N mm, which is not carried",
                                   in_range=False)  # fmt: skip
        if drag > MAX_DRAG_RATIO * force:
            trust = trust.also(f"{name} also drags with {drag:.2g} N, which is not carried", in_range=False)
        return trust


def _elsewhere(low: float, moved: float, high: float, through: bool, step: float) -> tuple[float, float, float]:
    """Bracket and next trial where nothing presses: the tool has gone `through` the limb, or is not deep enough."""
    if through:
        return low, 0.5 * (low + moved), moved
    return max(low, moved), moved + (0.5 * (high - moved) if math.isfinite(high) else step), high


def _strained(trials: Sequence[tuple[float, float]], squeeze: Squeeze) -> float:
    """Way at which a tool presses to MAX_PRESSED_STRAIN, by trials (way [m], strain) and the last one's squeeze [m]."""
    near = sorted(trials, key=lambda one: abs(one[1] - MAX_PRESSED_STRAIN))[:2]
    way, strain = near[0]
    slope = 1 / float(squeeze.nodes.thickness.min())
    if len(near) > 1 and (near[1][1] - strain) * (near[1][0] - way) > 0:
        slope = (near[1][1] - strain) / (near[1][0] - way)
    return way + (MAX_PRESSED_STRAIN - strain) / slope


def groups_of(points: Sequence[np.ndarray], thickness: float) -> list[list[int]]:
    """Numbers of the tools in groups, between which none feels another: what many tools cost grows with the largest.

    Args:
        points: contact nodes of each tool, (N, 3) [m].
        thickness: thickness of the layer, the largest [m].
    """
    if len(points) < 2:
        return [[0]] if len(points) else []
    groups: list[tuple[list[int], list[tuple[np.ndarray, float]]]] = []
    for n, some in enumerate(points):
        middle, radius = ball_around(some)
        ball = middle, radius + 0.5 * REACH * thickness
        near = [group for group in groups
                if any(math.dist(middle, other) < ball[1] + size for other, size in group[1])]  # fmt: skip
        groups = [group for group in groups if group not in near]
        groups.append(([*(o for group in near for o in group[0]), n], [*(b for g in near for b in g[1]), ball]))
    return [sorted(group) for group, _ in groups]


@numba.njit(cache=True, nogil=True)
def _led_in(sinking, strain, thickness, inward, way):
    """Share of the depth in columns along a way (3,) by which the nodes of a thin tool sink with it, at most 1 [-].

    Columns of a limb lead a little aside, so a thin wall that is deep is left by those that it began in: at first by
    most of the deepest, and less of its edge presses, then by all.
    """
    sunk, deep, depths = 0.0, 1e-300, np.empty(len(sinking))
    for n in range(len(sinking)):
        cosine = inward[n, 0] * way[0] + inward[n, 1] * way[1] + inward[n, 2] * way[2]
        depths[n] = strain[n] * thickness[n] * cosine * cosine
        sunk, deep = max(sunk, sinking[n]), max(deep, depths[n])
    lost, whole = 0.0, 1e-300
    for n in range(len(sinking)):
        if depths[n] > LED_DEEP * deep:
            lost += max(depths[n] - sinking[n], 0.0)
            whole += depths[n]
    most = 1 - lost / whole if lost > LED_LOST * whole else 1.0
    return min(max(min(sunk / deep, most), 0.02), 1.0)


@numba.njit(cache=True, nogil=True)
def _deepest(depth, strain, thickness):
    """Depth of the deepest column, of vertices or nodes [m]; numpy's own calls take three times as long."""
    deepest = 0.0
    for n in range(len(depth)):
        deepest = max(deepest, depth[n])
    for n in range(len(strain)):
        deepest = max(deepest, strain[n] * thickness[n])
    return deepest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carried(corners, shares, area, thickness, held, doubts, outside, unit, carries, areas, points, area_vectors,
             origin, sticks, facets):  # fmt: skip
    """What the pressure at contact nodes amounts to.

    Args:
        corners, shares, area, thickness: those of Nodes.
        held, doubts, outside: those of a Held.
        unit: modulus that they are told over [Pa].
        carries: force that all is scaled to [N]; NaN: none.
        areas, points, area_vectors: of all vertices.
        origin: point about which torque is told, (3,) [m].
        sticks: see wrench_of.
        facets: how far the flat triangles around a vertex lie off smooth skin, (V,) [m].

    Returns:
        vertices, pressure: numbers of the vertices that are pressed on, and pressures there, (M,) [Pa].
        values: pressures at all vertices, (V,) [Pa].
        wrench: force [N] and torque [N m], (6,).
        forces: forces at the nodes before they are scaled, (N,) [N].
        scale: factor on what the nodes are held with.
        size: size of the force [N].
        doubt: error to expect of it, over it.
        strange: share of it that nodes carry that see what no training contact had.
        stuck: see wrench_of.
        along: share of the force that skin carries along itself.
        below: how far facets lie off smooth skin where it presses [m].
        thick: mean thickness of the layer there [m].
    """
    forces, doubt, strange, total, thick = np.empty(len(area)), 0.0, 0.0, 0.0, 0.0
    for n in range(len(area)):
        forces[n] = held[n] * unit * area[n]
        doubt += doubts[n] * area[n]
        strange += outside[n] * forces[n]
        thick += forces[n] * thickness[n]
        total += forces[n]
    vertices, pressure = gathered(corners, shares, forces, areas)
    wrench, stuck, along = wrench_of(pressure, vertices, points, area_vectors, origin, sticks)
    size = np.sqrt(wrench[0] * wrench[0] + wrench[1] * wrench[1] + wrench[2] * wrench[2])
    doubt *= unit / max(size - along, 1e-300)
    along /= max(size, 1e-300)
    scale = carries / max(size, 1e-300) if len(vertices) and carries == carries else 1.0
    values, size, below = np.zeros(len(areas)), scale * size, 0.0
    for x in range(6):
        wrench[x] *= scale
    for n in range(len(vertices)):
        v = vertices[n]
        below += pressure[n] * areas[v] * facets[v]
        pressure[n] *= scale
        values[v] = pressure[n]
    return (vertices, pressure, values, wrench, forces, scale, size, doubt, strange / max(total, 1e-300), stuck,
            along, below / max(total, 1e-300), thick / max(total, 1e-300))  # fmt: skip


def unlearnt(layer: SoftLayer, low: float, high: float) -> list[str]:
    """What of a layer's tissue no contact was learnt with, as sentences; Poisson's ratios from low to high were."""
    tissue, out = layer.tissue, []
    ratios = {tissue.poisson_ratio, *(ply.poisson_ratio for ply in _there(layer))}
    pull, kappa = 0.0, 0.0
    if tissue.skin is not None:
        effective = Green.of(layer).effective
        pull, kappa = effective.pull, effective.kappa
    out += [f"contacts were learnt at Poisson's ratios from {low:g} to {high:g}, not {nu:g}"
            for nu in sorted(ratios) if not low - 1e-3 <= nu <= high + 1e-3]  # fmt: skip
    if (apart := max(ratios) - min(ratios)) > RATIOS_APART:
        out.append(f"Poisson's ratios of the materials differ by {apart:.2g}; tried is {RATIOS_APART:g}")
    if kappa > SLACK[1] and pull < SLACK[0] * kappa:
        out.append(f"the skin has next to no tension, T / (E_s h) = {pull / kappa:.2g}: such skin is answered 10 to "
                   "22 % too stiff; people's is taut")  # fmt: skip
    tried = MAX_PULL[_tautness(tissue) <= TAUT[0]]
    if pull > tried:
        out.append(f"the skin's tension is {pull:.2g} times E t of the tissue under it; tried is {tried:g}")
    if over_soft(layer) > MOST_OVER_SOFT:
        out.append("a material lies over a much softer one, and no contact was learnt with that")
    return out


def tissue_doubt(layer: SoftLayer) -> float:
    """Factor on the bound of force for a layer of materials that few contacts were learnt with, at least 1."""
    if not layer.stacked:
        return 1.0
    least = min(one.poisson_ratio for one in (layer.tissue, *_there(layer)))
    learnt, most, steep = TAUT
    taut = min(steep * max(_tautness(layer.tissue) - learnt, 0.0), most)
    pulls = min(layer.tissue.pull(float(np.median(layer.thickness))) / PULLS_FROM, 1.0)
    return (1 + FEW * max(FEW_RATIO - least, 0.0)) * (1 + over_soft(layer)) * (1 + pulls * taut)


class Thicker(NamedTuple):
    """What it means that tissue under a tool is thicker than in the median of a stack's skin, logarithms of which.

    Args:
        least: from where on the bound on force grows.
        steep: by how much, over it.
        most: from where on an answer is flagged.
    """

    least: float
    steep: float
    most: float


def thicker_than_most(layer: SoftLayer) -> Thicker:
    """See Thicker; never of one material.

    The response is that of the median's stack, with another softness here, and what networks read of it. Balls of
    30 mm on 18 mm, 0.1 to 0.5 deep, that is less from four thicknesses on, beside axisymmetric finite elements: under
    a skin 1 to 10 % too much at 3 times the median, 42 at 4.5; without one 38 at 1.5 times and 83 at 3.
    """
    if not layer.stacked:
        return Thicker(math.inf, 0.0, math.inf)
    skin = min(Green.of(layer).effective.kappa / TAKES_KAPPA, 1.0)
    return Thicker(*(bare + skin * (under - bare) for bare, under in THICKER))


def _there(layer: SoftLayer) -> list[Ply]:
    """Deeper materials of a layer that begin above its bone anywhere."""
    deepest = float((layer.thickness / (1.0 if layer.ply_scale is None else layer.ply_scale)).max())
    return [ply for ply in layer.tissue.deeper if ply.depth < deepest]


def _tautness(tissue: Tissue) -> float:
    """T / (E_s h) of a skin [-]; 0 without one."""
    return tissue.skin.tension / max(tissue.skin.stiffness, 1e-300) if tissue.skin else 0.0


def over_soft(layer: SoftLayer) -> float:
    """What materials that lie over softer ones add to the bound of force, over it; 0 where each is the softest so far.

    By finite elements (balls of 25 to 80 mm, 0.2 to 0.7 of the thickness deep): what a skin over 12 kPa of 10 mm over
    4 kPa presses with is 9 to 14 % too much, over 20 kPa of 8 mm over 2 kPa 32 to 41 %.
    """
    thickness, plies = float(np.median(layer.thickness)), [(0.0, layer.tissue.youngs_modulus)]
    plies += [(ply.depth, ply.youngs_modulus) for ply in _there(layer.typical)]
    most, (at_skin, inside, from_here) = 0.0, OVER_SOFT
    for k, (depth, stiff) in enumerate(plies[:-1]):
        each = np.interp(depth / thickness, [0.0, from_here], [at_skin, inside])
        most = max(most, float(each) * (stiff / min(soft for _, soft in plies[k + 1 :]) - 1))
    return most


def soft_depth(layer: SoftLayer) -> float:
    """Depth to which a tool may press into what lies over a material that is MUCH_STIFFER [m]; infinite without one.

    Under a skin: a ball of 40 mm on 8 mm of fat over muscle 18 to 46 times as stiff, by finite elements.
    """
    softest, taut = layer.tissue.youngs_modulus, layer.tissue.skin is not None
    for ply in _there(layer.typical):
        stiffer = ply.youngs_modulus / softest
        if stiffer > MUCH_STIFFER[taut]:
            felt = taut and stiffer < NEARLY_BONE
            return ply.depth * (FELT[0] * (MUCH_STIFFER[1] / stiffer) ** FELT[1] if felt else SOFT_SHARE[taut])
        softest = min(softest, ply.youngs_modulus)
    return math.inf


def margin_on(layer: SoftLayer) -> float:
    """Width that a tool's distance field needs around its surface to press on this layer [m]."""
    return max(MARGIN_SHARE * float(layer.thickness.max()), 2 * HOLE_RADIUS * layer.edge_length)
