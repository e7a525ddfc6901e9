"""Toucher: finds what tools do to the skin by their poses and wrenches: from Contacts to Touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stmpl_core.arrays import Transform
from stmpl_core.columns import HOLE_RADIUS, NO_SQUEEZE, Clearance, Columns, Squeeze
from stmpl_core.contact import Contact
from stmpl_core.contact_net import ContactNet, Held
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.sdf import MARGIN, SignedDistance
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

MAX_TOOL_OFFSET_M = 3e-3  # distance that calibration may leave between a pressing tool and its stated place
MAX_TOUCHING_GAP = 0.25  # largest gap of a tool that touches between vertices, over a hole's radius
GAP_TOLERANCE_M = 1e-6  # gap at which the search along the force ends
MIN_FACING_COSINE = 0.1  # cosine between push and inward normal from which the skin faces a tool that looks for it
MIN_NET_FORCE_SHARE = 0.1  # force over the sum of its parts' sizes, below which a contact has no direction
MAX_DRAG_RATIO = 0.3  # tangential over normal force that is not yet worth a word
MAX_FIELD_ERROR_M = 5e-4  # error of a distance field that is not yet worth a word
MAX_UNSEEN_FORCE_SHARE = 0.1  # share of the force that vertices unlike all training contacts may carry
MAX_PRESSED_STRAIN = 0.85  # depth over thickness beyond which no wrench presses a tool
FORCE_TOLERANCE = 0.02  # relative error of the force at which trials end; the rest of the way is reckoned
MAX_DEPTH_TRIALS = 12  # trials of the depth for one wrench
FIRST_SHARE_POWER = -0.25  # power of Winkler's force with which the skin's share of it falls, until a trial says more
MAX_SHARE_CHANGE = 1.4  # factor by which that share is taken to change at most from trial to trial
MANY_TOOLS = 8  # number of tools from which those that are apart are told by a tree of boxes


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
    """

    def __init__(self, layer: SoftLayer, near: Surroundings | None = None, tools: Tools | None = None, *,
                 reach: float = MAX_TOOL_OFFSET_M) -> None:  # fmt: skip
        self.layer, self.reach = layer, reach
        self.near = near or Surroundings.of(layer)
        self.hole = HOLE_RADIUS * layer.edge_length
        self.tools = Tools(margin_on(layer)) if tools is None else tools
        self.columns, self.net = Columns(layer), ContactNet(layer, near=self.near)
        self._modulus = layer.tissue.youngs_modulus
        self._confined = layer.tissue.confined_modulus / self._modulus
        self._thickest = float(layer.thickness.max())
        self._inward = self.columns.inward

    def touch(self, contact: Contact) -> Touch:
        """Touch of one contact alone. Raises MeshError: a surface that cannot be a tool."""
        return self.touch_all([contact])[0]

    def touch_all(self, contacts: Sequence[Contact]) -> list[Touch]:
        """Touches of several contacts at once: tools side by side feel each other through the skin."""
        many = len(contacts) >= MANY_TOOLS
        placed = [self._place(contact, self.tools.field(contact.tool), many) for contact in contacts]
        pressing = [one for one in placed if len(one.squeeze.vertices)]
        if len(pressing) == 1:
            together = pressing[0].squeeze
        elif pressing:
            together = _joined([one.squeeze for one in pressing], len(self.layer.vertices))
        else:
            return [self._answer(one, np.empty(0), np.empty(0), 0.0) for one in placed]
        held = pressing[0].held if len(pressing) == 1 else None
        held = held or self.net.hold(together.vertices, together.pressure, together.strain)
        share, out = held.pressure / together.pressure, []
        for one in placed:
            at = np.searchsorted(together.vertices, one.squeeze.vertices)
            pressure = one.squeeze.pressure * share[at] * self._modulus
            doubt = one.squeeze.pressure * held.doubt[at] / together.pressure[at] * self._modulus
            strange = float(pressure[held.outside[at]].sum() / max(pressure.sum(), 1e-300))
            out.append(self._answer(one, pressure, doubt, strange))
        return out

    def _place(self, contact: Contact, field: SignedDistance, many: bool) -> _Placed:
        """Where the tool presses, or why it does not."""
        pose = contact.pose_body_from_tool
        reach = 0.0 if contact.wrench is None else self.reach + self._thickest
        near = self.columns.near(field, pose, self._thickest + self.hole + reach, many=many)
        clearance = self.columns.clearance(field, pose, near, self.hole + reach)
        depth = -float(clearance.least.min(initial=np.inf))

        def nothing(status: str) -> _Placed:
            return _Placed(contact, field, status, pose, depth, 0.0, NO_SQUEEZE, 0.0)

        force = contact.wrench[:3] if contact.wrench is not None else None
        if force is None:
            if not len((squeeze := self.columns.squeeze(field, pose, clearance)).vertices):
                return nothing(APART)
            return _Placed(contact, field, self._status_by_pose(squeeze), pose, depth, 0.0, squeeze, None)
        if not force.any():
            return nothing(APART if depth <= 0 else NO_FORCE)
        gap = self._gap(field, pose, clearance, force)
        if gap is None:
            return nothing(NO_TOUCH)
        return self._pressed(contact, field, clearance, depth, gap, force) or nothing(PULLING)

    def _status_by_pose(self, squeeze: Squeeze) -> str:
        return IN_CORE if (squeeze.depth >= self.layer.thickness[squeeze.vertices]).any() else BY_POSE

    def _gap(self, field: SignedDistance, pose: Transform, clearance: Clearance, force: np.ndarray) -> float | None:
        """How far a tool that is apart must go along `force` to be 0 from the skin that faces it, by sphere tracing.

        0 where it touches. A tool that passes between vertices stops where it is nearest. None: it comes no nearer
        than a hole of the mesh within `reach` [m].
        """
        if clearance.least.min(initial=np.inf) <= 0:
            return 0.0
        push = force / np.linalg.norm(force)
        facing = clearance.vertices[self._inward[clearance.vertices] @ push > MIN_FACING_COSINE]
        moved, best, nearest = 0.0, None, self.hole
        while moved <= self.reach:
            there = self.columns.clearance(field, _shifted(pose, moved * push), facing, self.reach + self.hole)
            gap = float(there.least.min(initial=np.inf))
            if gap < nearest:
                best, nearest = moved, gap
            if gap < GAP_TOLERANCE_M:
                break
            moved += gap
        return best

    def _pressed(self, contact: Contact, field: SignedDistance, stated: Clearance, depth: float, gap: float,
                 force: np.ndarray) -> _Placed | None:  # fmt: skip
        """The tool moved along `force` until it presses with its component along the contact normal.

        Each trial takes the next from Winkler's columns, each of which keeps its share of the pressure; how far that
        was wrong bends the one after. All inside a bracket.
        None: the force points away from the skin.
        """
        layer, push, start = self.layer, force / np.linalg.norm(force), contact.pose_body_from_tool
        low, high, moved, best = -np.inf, np.inf, gap, None
        last: tuple[float, float] | None = None  # force of the trial before, and what it promised for this one
        bend = FIRST_SHARE_POWER
        for _ in range(MAX_DEPTH_TRIALS):
            pose, clearance = _shifted(start, moved * push), stated
            if moved:
                near = stated.vertices[~(stated.least > abs(moved) + 2 * self.hole) | np.isinf(stated.least)]
                clearance = self.columns.clearance(field, pose, near, self.hole)
            squeeze = self.columns.squeeze(field, pose, clearance)
            v = squeeze.vertices
            if not (self._inward[v] @ push > MIN_FACING_COSINE).any():
                if best is None and gap == 0.0 and len(v):
                    return None
                low = max(low, moved)
                moved += 0.05 * self._thickest if not np.isfinite(high) else 0.5 * (high - moved)
                continue
            held = self.net.hold(v, squeeze.pressure, squeeze.strain)
            pressure = held.pressure * self._modulus
            vector = -(pressure @ layer.vertex_area_vectors[v])
            size = float(np.linalg.norm(vector))
            if size <= MIN_NET_FORCE_SHARE * float(pressure @ layer.vertex_areas[v]):
                return _Placed(contact, field, WRAPPED, start, depth, 0.0, NO_SQUEEZE, 0.0)
            normal = float(force @ vector) / size
            if normal <= 0:
                return None
            status = MOVED if gap > MAX_TOUCHING_GAP * self.hole else TOUCHING
            best = _Placed(contact, field, status, pose, depth, moved, squeeze, normal, held=held)
            if last is not None:
                bend = float(np.clip(np.log(size / last[1]) / np.log(last[1] / last[0]), -0.8, 2.0))
            times = normal / size
            times *= float(np.clip(times ** (-bend / (1 + bend)), 1 / MAX_SHARE_CHANGE, MAX_SHARE_CHANGE))
            further = self._deeper(squeeze, clearance, push, times)
            if abs(size / normal - 1) < FORCE_TOLERANCE:  # the rest is small enough to go without another look
                under = np.where(squeeze.depth > 0, squeeze.depth + further * (self._inward[v] @ push), 0.0)
                return best._replace(pose=_shifted(pose, further * push), moved=moved + further,
                                     squeeze=squeeze._replace(depth=np.maximum(under, 0.0)))  # fmt: skip
            deepest = float((squeeze.depth / layer.thickness[v]).max())
            if size < normal and deepest > MAX_PRESSED_STRAIN - 0.01:
                why = (f"{contact.name} asks for {normal:.2g} N along the skin's normal; pressed to "
                       f"{deepest:.0%} of the layer it has {size:.2g} N")
                return best._replace(why=why)
            low, high = (moved, high) if size < normal else (low, moved)
            last = size, size * times
            following = moved + further
            if not low < following < high:  # halve the bracket, or go to where its open end must be
                least = 0.05 * self._thickest
                inside = np.isfinite(high - low)
                following = 0.5 * (low + high) if inside else min(high - least, max(low + least, following))
            moved = following
        return best

    def _deeper(self, squeeze: Squeeze, clearance: Clearance, push: np.ndarray, times: float) -> float:
        """How much further a tool must go to press `times` as hard, if columns keep their share of Winkler's [m]."""
        near = np.union1d(clearance.vertices, squeeze.vertices)  # a long triangle reaches beyond what was looked at
        gain, thickness, depth = self._inward[near] @ push, self.layer.thickness[near], np.full(len(near), -np.inf)
        depth[np.searchsorted(near, clearance.vertices)] = -clearance.least
        carry = np.searchsorted(near, squeeze.vertices)
        depth[carry] = np.where(squeeze.depth > 0, squeeze.depth, squeeze.strain / self._confined * thickness[carry])
        some = (gain > MIN_FACING_COSINE) & np.isfinite(depth)
        gain, thickness, depth, near = gain[some], thickness[some], depth[some], near[some]
        room = (MAX_PRESSED_STRAIN * thickness - depth) / gain if times > 1 else np.maximum(depth, 0.0) / gain
        most = float(room.min() if times > 1 else room.max())
        return self.columns.deeper(near, gain * self.layer.vertex_areas[near], depth, gain, times, most)

    def _answer(self, one: _Placed, pressure: np.ndarray, doubt: np.ndarray, strange: float) -> Touch:
        """What a placed tool does, scaled to its wrench, with what may be believed of it."""
        layer, v = self.layer, one.squeeze.vertices
        if one.force is not None and len(v):
            vector = pressure @ layer.vertex_area_vectors[v]
            scale = one.force / max(float(np.linalg.norm(vector)), 1e-300)
            pressure, doubt = scale * pressure, scale * doubt
        values = np.zeros(len(layer.vertices))
        values[v] = pressure
        forces = -pressure[:, None] * layer.vertex_area_vectors[v]
        arms = layer.vertices[v] - one.pose[:3, 3]
        turning = arms.T @ forces  # its antisymmetric part is the torque
        torque = (turning[1, 2] - turning[2, 1], turning[2, 0] - turning[0, 2], turning[0, 1] - turning[1, 0])
        wrench = np.array([*forces.sum(axis=0), *torque])
        stated, squeezed = one.contact.wrench, one.squeeze.depth
        depth = float(squeezed.max()) if len(squeezed) and squeezed.any() else one.depth
        way = stated[:3] / np.linalg.norm(stated[:3]) if stated is not None and stated[:3].any() else None
        touch = Touch(
            one.contact.name, one.status, one.pose, wrench,
            depth=depth if np.isfinite(depth) else float("nan"),
            force_bound=float(self.net.weights.card["bound"]["factor"]) * float(doubt @ layer.vertex_areas[v]),
            moved=one.moved,
            missing=np.zeros(6) if stated is None else stated - wrench,
            pressure=values,
            pressed=Pressed(one.field, one.squeeze, way) if values.any() else None,
        )  # fmt: skip
        return replace(touch, trust=self._trust(one, touch, pressure, strange))

    def _trust(self, one: _Placed, touch: Touch, pressure: np.ndarray, strange: float) -> Trust:
        name, layer, card, trust = touch.name, self.layer, self.net.weights.card, Trust()
        why = {
            NO_TOUCH: f"{name} presses, but no skin is within {self.reach * 1e3:g} mm along its force",
            PULLING: f"{name} pulls: nothing is taken to stick, so nothing is loaded",
            WRAPPED: f"{name} closes around the limb: its wrench does not say how hard it squeezes; "
                     "give each finger as a contact, or leave the wrench out",
            IN_CORE: f"{name} reaches {touch.depth * 1e3:.1f} mm deep, into the rigid core: "
                     "check its pose or the thickness",
        }  # fmt: skip
        if one.status in why:
            trust = trust.also(why[one.status], in_range=False if one.status != PULLING else None)
        if one.why:
            trust = trust.also(one.why, in_range=False)
        if not len(pressure):
            return trust
        ratio, highest = float(pressure.max()) / self._modulus, card["ranges"]["p_over_e"][1]
        if ratio > highest:
            trust = trust.also(f"{name} presses with p/E = {ratio:.2g}; contacts were learnt up to {highest:.2g}",
                               in_range=False)  # fmt: skip
        deepest = float((one.squeeze.depth / layer.thickness[one.squeeze.vertices]).max())
        if deepest > card["ranges"]["depth_over_thickness"][1] and one.status != IN_CORE:
            trust = trust.also(f"{name} presses to {deepest:.0%} of the thickness, learnt is "
                               f"{card['ranges']['depth_over_thickness'][1]:.0%}", in_range=False)  # fmt: skip
        nu, (low, high) = layer.tissue.poisson_ratio, card["ranges"]["poisson_ratio"]
        if not low - 1e-3 <= nu <= high + 1e-3:
            trust = trust.also(f"contacts were learnt at Poisson's ratios from {low:g} to {high:g}, not {nu:g}",
                               in_range=False)  # fmt: skip
        if strange > MAX_UNSEEN_FORCE_SHARE:
            trust = trust.also(f"{strange:.0%} of the force of {name} is where no training contact was like it",
                               in_range=False)  # fmt: skip
        if abs(one.moved) > self.reach:
            trust = trust.also(f"{name} was moved {one.moved * 1e3:+.1f} mm along its force: check its calibration")
        if touch.drag > MAX_DRAG_RATIO * touch.force:
            trust = trust.also(f"{name} also drags with {touch.drag:.2g} N, which is not carried")
        if one.field.surface_error > MAX_FIELD_ERROR_M:
            error_mm = one.field.surface_error * 1e3
            trust = trust.also(f"the distance field of {name} is off by up to {error_mm:.1f} mm")
        if not one.field.watertight:
            trust = trust.also(f"the mesh of {name} has holes")
        if one.field.flipped:
            trust = trust.also(f"the mesh of {name} was inside out and was turned")
        return trust


def margin_on(layer: SoftLayer) -> float:
    """Width that a tool's distance field needs around its surface to press on this layer [m]."""
    return max(MARGIN, 2 * HOLE_RADIUS * layer.edge_length)


def _shifted(pose: Transform, by: np.ndarray) -> Transform:
    out = pose.copy()
    out[:3, 3] += by
    return out


def _joined(squeezes: Sequence[Squeeze], count: int) -> Squeeze:
    """Several tools' squeezes as one: two tools share a vertex only where each has a part of its triangles."""
    pressure, strain, depth, rests = np.zeros((4, count))
    for one in squeezes:
        pressure[one.vertices] += one.pressure
        strain[one.vertices] += one.strain
        depth[one.vertices] = np.maximum(depth[one.vertices], one.depth)
        rests[one.vertices] = np.maximum(rests[one.vertices], one.rests)
    v = np.flatnonzero(pressure)
    return Squeeze(v, pressure[v], strain[v], depth[v], rests[v])
