"""Toucher: turns a Contact (mesh, pose, wrench) into a Load on the skin, and says what it found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import fcl
import numba
import numpy as np

from stmpl_core.arrays import PerVertex, Transform
from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.sdf import SignedDistance, distance_at
from stmpl_core.trust import Trust

TOUCHING = "touching"  # the wrench is shared over the skin that the tool covers
MOVED = "moved to touch"  # as above, after the tool was moved along its push to meet the skin
BY_POSE = "pressed by pose"  # no wrench given: the pressure follows from how deep the pose is
APART = "apart"  # no wrench to carry, and no touch
NO_FORCE = "no force"  # the pose touches, the wrench is exactly zero
PULLING = "pulling"  # the wrench draws the tool off the skin; nothing sticks, so nothing is loaded
NO_TOUCH = "wrench without touch"  # a force, but no skin within reach along it
WRAPPED = "wrapped around"  # the tool closes around the limb: a wrench does not say how hard it squeezes

REACH = 3e-3  # m that a pressing tool may be moved to meet the skin: what calibration may be off by
HOLE = 0.6  # of an edge: a tool that comes this near to a vertex cannot slip between vertices (equilateral: 0.577)
STEEPEST = 2.0  # slope of the skin at a tool's edge: depth grows this much per unit of depth into the tool
DEEPEST = 0.9  # of the thickness; columns are not pressed further
SLACK = 0.25  # of a hole: a curved tool that touches between vertices is this far from them, and was not moved
NEARLY = 1e-6  # m; nearer than this is touching
FACING = 0.1  # cosine between push and inward normal from which the skin faces a tool that looks for it
ONE_SIDED = 0.1  # a contact whose pressures cancel to less than this share has no direction
SIDEWAYS = 0.3  # of the normal force: more tangential force than this is worth a word
ROUGH = 5e-4  # m: a tool whose distance field is off by more than this is worth a word
MAX_RATIO = 2.0  # p / E up to which smooth follower pressures were solved on every site tried


@dataclass(frozen=True, eq=False)
class Touch:
    """What one contact does to the skin.

    Args:
        load: a follower pressure.
        status: one of the constants of this module.
        trust: figures are depth_m (of the pose's deepest point; negative when apart, missing when far), moved_m
            (along the push), normal_n (carried), tangential_n and torque_nm (asked for, not carried).
    """

    load: Load
    status: str
    trust: Trust


class Covered(NamedTuple):
    """Vertices under a tool, and how deep it reaches into their columns."""

    vertices: np.ndarray  # (N,)
    clearance: np.ndarray  # (N,) [m], least signed distance along the column
    depth: np.ndarray  # (N,) [m], from the skin at rest to the tool, along the inward normal


class Toucher:
    """Finds the skin that a tool covers, and shares its force over it.

    A tool covers a vertex when the column under it, skin to core, enters the tool, counted from the core: so a tool
    thinner than the layer may be pressed under the skin's rest position, and the far side of the limb stays free.
    The wrench is shared as the columns would share it: by area and by the pressure of Winkler's law at their
    depth, scaled to the wrench's component along the mean contact normal. A tool that is less deep than a hole of
    the skin's mesh is grown to be so, and at sharp edges the depth falls off at a slope of 2: the load changes
    continuously while the tool slides, and no vertex pops in or out.

    Args:
        layer: the skin.
        reach: how far a pressing tool that does not touch is moved along its push [m].
    """

    def __init__(self, layer: SoftLayer, *, reach: float = REACH) -> None:
        self.layer, self.reach = layer, reach
        self.hole = HOLE * layer.edge_length
        self._thickest = float(layer.thickness.max())
        self._points, self._inward = layer.vertices, np.ascontiguousarray(-layer.normals)
        model = fcl.BVHModel()
        model.beginModel(len(layer.vertices), len(layer.faces))
        model.addSubModel(layer.vertices, layer.faces)
        model.endModel()
        self._skin = fcl.CollisionObject(model)

    def touch(self, contact: Contact, field: SignedDistance) -> Touch:
        """The load of `contact`, whose tool has the distance field `field`."""
        pose = contact.pose_body_from_tool
        near = self._near(field, pose)
        clearance = self._clearance(field, pose, near)
        depth = -float(clearance.min(initial=np.inf))
        if contact.wrench is None:
            return self._by_pose(contact, field, near, clearance, depth)
        force = contact.wrench[:3]
        if not force.any():
            return self._nothing(contact, APART if depth <= 0 else NO_FORCE, depth)
        moved, pose = self._move_to_touch(field, pose, near, clearance, force)
        if moved is None:
            return self._nothing(contact, NO_TOUCH, depth)
        if moved > 0:
            near = self._near(field, pose)
            clearance = self._clearance(field, pose, near)
        return self._by_wrench(contact, field, pose, near, clearance, depth, moved)

    def _near(self, field: SignedDistance, pose: Transform) -> np.ndarray:
        """Broad phase: numbers of the vertices whose columns may meet the tool's box; empty if FCL finds no overlap."""
        reach = self._thickest + self.hole + self.reach
        low, high = field.tool_bounds
        box = fcl.Box(*(high - low + 2 * reach))
        centre = pose[:3, :3] @ ((low + high) / 2) + pose[:3, 3]
        if not fcl.collide(self._skin, fcl.CollisionObject(box, fcl.Transform(pose[:3, :3], centre))):
            return np.empty(0, np.int64)
        return _inside_box(self._points, pose, low - reach, high + reach)

    def _clearance(self, field: SignedDistance, pose: Transform, near: np.ndarray) -> np.ndarray:
        """Least signed distance along the column of each vertex in `near` [m]; inf where the tool cannot reach."""
        return _clearances(field.coefficients, field.origin, field.spacing, pose, self._points, self._inward,
                           self.layer.thickness, near, self.hole)

    def _cover(self, field: SignedDistance, pose: Transform, near: np.ndarray, clearance: np.ndarray,
               grown: float) -> Covered:
        """The vertices that the tool, grown by `grown` [m], covers."""
        some = clearance < grown
        vertices, clearance = near[some], clearance[some]
        depth = _depths(field.coefficients, field.origin, field.spacing, pose, self._points, self._inward,
                        self.layer.thickness, vertices, grown)
        return Covered(vertices, clearance, np.minimum(depth, STEEPEST * (grown - clearance)))

    def _column_pressure(self, covered: Covered) -> PerVertex:
        """Winkler's pressure at those depths, (V,) [Pa]."""
        pressure = np.zeros(len(self.layer.vertices))
        share = np.clip(covered.depth / self.layer.thickness[covered.vertices], 0, DEEPEST)
        pressure[covered.vertices] = column_pressure(1 - share, self.layer.tissue)
        return np.maximum(pressure, 0.0)

    def _move_to_touch(self, field: SignedDistance, pose: Transform, near: np.ndarray, clearance: np.ndarray,
                       force: np.ndarray) -> tuple[float | None, Transform]:
        """Moves a tool that is apart along `force` until its distance to the facing skin is 0, by sphere tracing.

        A tool that passes between vertices stays where it is nearest. None: it comes no nearer than a hole of the mesh.
        """
        if clearance.min(initial=np.inf) <= 0:
            return 0.0, pose
        push = force / np.linalg.norm(force)
        facing = near[self._inward[near] @ push > FACING]
        moved, shifted = 0.0, pose.copy()
        best, nearest, there = None, self.hole, pose
        while moved <= self.reach:
            shifted[:3, 3] = pose[:3, 3] + moved * push
            gap = float(self._clearance(field, shifted, facing).min(initial=np.inf))
            if gap < nearest:
                best, nearest, there = moved, gap, shifted.copy()
            if gap < NEARLY:
                break
            moved += gap
        return best, there

    def _by_wrench(self, contact: Contact, field: SignedDistance, pose: Transform, near: np.ndarray,
                   clearance: np.ndarray, depth: float, moved: float) -> Touch:
        assert contact.wrench is not None
        covered = self._cover(field, pose, near, clearance, max(0.0, self.hole + float(clearance.min())))
        shape = self._column_pressure(covered)
        vector = -(shape @ self.layer.vertex_area_vectors)
        size = float(np.linalg.norm(vector))
        if size <= ONE_SIDED * float(shape @ self.layer.vertex_areas):
            return self._nothing(contact, WRAPPED, depth)
        force = contact.wrench[:3]
        normal = float(force @ vector) / size
        if normal <= 0:
            return self._nothing(contact, PULLING, depth)
        load = Load.pressure(shape * (normal / size))
        status = MOVED if moved > SLACK * self.hole else TOUCHING
        return Touch(load, status, self._trust(contact, field, load, depth, moved))

    def _by_pose(self, contact: Contact, field: SignedDistance, near: np.ndarray, clearance: np.ndarray,
                 depth: float) -> Touch:
        if depth <= 0:
            return self._nothing(contact, APART, depth)
        covered = self._cover(field, contact.pose_body_from_tool, near, clearance, 0.0)
        load = Load.pressure(self._column_pressure(covered))
        trust = self._trust(contact, field, load, depth, 0.0).also(
            f"{contact.name} has no wrench: its force is that of columns, which press up to twice too hard")
        return Touch(load, BY_POSE, trust)

    def _nothing(self, contact: Contact, status: str, depth: float) -> Touch:
        """No load, and why."""
        trust = Trust(figures=_figures(contact, np.zeros(3), np.zeros(3), depth, 0.0))
        why = {
            NO_TOUCH: f"{contact.name} presses, but no skin is within {self.reach * 1e3:g} mm along its force",
            PULLING: f"{contact.name} pulls: nothing is taken to stick, so nothing is loaded",
            WRAPPED: f"{contact.name} closes around the limb: its wrench does not say how hard it squeezes; "
                     "give each finger as a contact, or leave the wrench out",
        }
        if status in why:
            trust = trust.also(why[status], in_range=False if status != PULLING else None)
        return Touch(Load.zero(self.layer), status, trust)

    def _trust(self, contact: Contact, field: SignedDistance, load: Load, depth: float, moved: float) -> Trust:
        some = load.loaded
        forces = -load.values[some, None] * self.layer.vertex_area_vectors[some]
        arms = self.layer.vertices[some] - contact.pose_body_from_tool[:3, 3]
        figures = _figures(contact, forces.sum(axis=0), np.cross(arms, forces).sum(axis=0), depth, moved)
        trust, name = Trust(figures=figures), contact.name
        ratio = load.peak_ratio(self.layer)
        if ratio > MAX_RATIO:
            trust = trust.also(f"{name} presses with p/E = {ratio:.2g}; pressure loads were solved by FEM up to "
                               f"{MAX_RATIO:g}", in_range=False)
        if moved > SLACK * self.hole:
            trust = trust.also(f"{name} was moved {moved * 1e3:.1f} mm along its force to touch: check its calibration")
        if depth > self._thickest:
            trust = trust.also(f"{name} reaches {depth * 1e3:.1f} mm deep, past the layer: check its pose or the "
                               "thickness", in_range=False)
        if figures["tangential_n"] > SIDEWAYS * figures["normal_n"]:
            trust = trust.also(f"{name} also drags with {figures['tangential_n']:.2g} N, which is not carried")
        if field.surface_error > ROUGH:
            trust = trust.also(f"the distance field of {name} is off by up to {field.surface_error * 1e3:.1f} mm")
        if not field.watertight:
            trust = trust.also(f"the mesh of {name} has holes")
        return trust


def _figures(contact: Contact, force: np.ndarray, torque: np.ndarray, depth: float, moved: float) -> dict[str, float]:
    asked = np.zeros(6) if contact.wrench is None else contact.wrench
    missing = np.zeros(6) if contact.wrench is None else asked - np.concatenate([force, torque])
    figures = {"moved_m": moved, "normal_n": float(np.linalg.norm(force)),
               "tangential_n": float(np.linalg.norm(missing[:3])), "torque_nm": float(np.linalg.norm(missing[3:]))}
    return {"depth_m": depth} | figures if np.isfinite(depth) else figures


@numba.njit(cache=True, inline="always")
def _to_tool(pose, x, y, z):
    """Coordinates in the tool's frame of a point of the body's."""
    a, b, c = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    return (pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c, pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
            pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c)


@numba.njit(cache=True)
def _inside_box(points, pose, low, high):
    """Numbers of the points that lie in a box of the tool's frame."""
    found, n = np.empty(len(points), np.int64), 0
    for v in range(len(points)):
        x, y, z = _to_tool(pose, points[v, 0], points[v, 1], points[v, 2])
        if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
            found[n] = v
            n += 1
    return found[:n].copy()


@numba.njit(cache=True)
def _column_distance(coefficients, origin, spacing, pose, point, inward, s):
    """Signed distance to the tool at depth s under a vertex [m]."""
    x, y, z = _to_tool(pose, point[0] + s * inward[0], point[1] + s * inward[1], point[2] + s * inward[2])
    return distance_at(coefficients, origin, spacing, x, y, z)


@numba.njit(cache=True)
def _clearances(coefficients, origin, spacing, pose, points, inward, thickness, near, hole):
    """Least signed distance along each column [m], by sphere tracing from the skin to the core.

    A column whose core end lies inside the tool counts only if the tool comes from outside: where the distance still
    rises along the inward normal there.
    """
    out = np.full(len(near), np.inf)
    for n in range(len(near)):
        v = near[n]
        t, point, down = thickness[v], points[v], inward[v]
        d = _column_distance(coefficients, origin, spacing, pose, point, down, 0.0)
        if d > t + hole:
            out[n] = d - t  # the rest of the column cannot be nearer
            continue
        least, s = d, 0.0
        while s < t:
            s = min(s + max(abs(d), t / 16), t)
            d = _column_distance(coefficients, origin, spacing, pose, point, down, s)
            least = min(least, d)
        if d <= 0 and _column_distance(coefficients, origin, spacing, pose, point, down, t + 1e-5) < d:
            least = np.inf
        out[n] = least
    return out


@numba.njit(cache=True)
def _depths(coefficients, origin, spacing, pose, points, inward, thickness, vertices, grown):
    """How deep under each vertex the tool, grown by `grown`, is first met on the way up from the core [m]."""
    out = np.zeros(len(vertices))
    for n in range(len(vertices)):
        v = vertices[n]
        point, down = points[v], inward[v]
        low = thickness[v]
        d_low = _column_distance(coefficients, origin, spacing, pose, point, down, low) - grown
        if d_low <= 0:
            out[n] = low
            continue
        while low > 0:
            high = max(low - max(d_low, thickness[v] / 32), 0.0)
            d_high = _column_distance(coefficients, origin, spacing, pose, point, down, high) - grown
            if d_high <= 0:
                out[n] = _crossing(coefficients, origin, spacing, pose, point, down, grown, low, d_low, high, d_high)
                break
            low, d_low = high, d_high
    return out


@numba.njit(cache=True)
def _crossing(coefficients, origin, spacing, pose, point, down, grown, low, d_low, high, d_high):
    """Depth between low (outside) and high (inside) at which the grown tool begins, by the Illinois rule, to 0.1 nm."""
    side = 0
    for _ in range(40):
        middle = (low * d_high - high * d_low) / (d_high - d_low)
        d = _column_distance(coefficients, origin, spacing, pose, point, down, middle) - grown
        if abs(d) < 1e-10:
            return middle
        if d > 0:
            low, d_low = middle, d
            d_high = d_high / 2 if side == 1 else d_high
            side = 1
        else:
            high, d_high = middle, d
            d_low = d_low / 2 if side == -1 else d_low
            side = -1
    return 0.5 * (low + high)
