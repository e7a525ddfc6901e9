"""What the simulated devices do: keyframes, the scripts made of them, and their path over a layer's skin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.arrays import Transform, Wrench
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.stack import ball_force
from stmpl_core.tool import Tool

SOFTER = 0.6  # factor by which a layer that may bulge at the rim presses back less than columns (FEM of spheres)
DEEPER = 4.5  # depth on skin, fat and muscle over that on one layer of 1 kPa
DEEPEST = 0.65  # depth over the tissue there, below which a device does not go on skin, fat and muscle
FORCES = 16  # depths between which a device's force on skin, fat and muscle is interpolated
STATIONS = 101  # points of a path
SMOOTHING = 2.0  # footprint radii over which the skin's normal is averaged along a path


@dataclass(frozen=True)
class Keyframe:
    """Where a device is at one moment.

    Args:
        time: time since the script began [s].
        depth: depth of its tip under the skin at rest [m]; negative: off the skin.
        along: place on the limb, 0 at one end of its axis, 1 at the other [-].
    """

    time: float
    depth: float
    along: float


@dataclass(frozen=True)
class Device:
    """A capsule on a stick, pressing with its round end.

    Args:
        name: name of the tool.
        radius: radius of the round end [m].
        around: angle about the limb's axis at which it comes [degrees]; 0 is the side that looks most outwards.
        keyframes: keyframes in order of time, at least two.
    """

    name: str
    radius: float
    around: float
    keyframes: tuple[Keyframe, ...]

    def __post_init__(self) -> None:
        times = [key.time for key in self.keyframes]
        if len(times) < 2 or sorted(set(times)) != times:
            raise InvalidInput(f"keyframes of {self.name} are at {times} s; expected two or more rising times.")

    def at(self, time: float) -> tuple[float, float]:
        """Depth [m] and place along the limb at `time` [s], with neither jumps in speed nor in acceleration.

        Between keyframes s(x) = 10 x^3 - 15 x^4 + 6 x^5 (Flash & Hogan 1985, minimum jerk).
        """
        times = [key.time for key in self.keyframes]
        i = int(np.clip(np.searchsorted(times, time, side="right"), 1, len(times) - 1))
        a, b = self.keyframes[i - 1], self.keyframes[i]
        x = float(np.clip((time - a.time) / (b.time - a.time), 0, 1))
        s = x**3 * (10 - 15 * x + 6 * x * x)
        return a.depth + s * (b.depth - a.depth), a.along + s * (b.along - a.along)


@dataclass(frozen=True)
class Script:
    """Devices that move together for `seconds`."""

    name: str
    seconds: float
    devices: tuple[Device, ...]


def _press(deeper: float) -> Script:
    """One probe presses, slides along, and lets go."""
    keys = (
        Keyframe(0.0, -0.03, 0.60),  # approach
        Keyframe(1.5, 0.0, 0.60),
        Keyframe(2.8, 2.6e-3 * deeper, 0.60),  # press
        Keyframe(3.3, 2.6e-3 * deeper, 0.60),
        Keyframe(6.3, 2.0e-3 * deeper, 0.78),  # slide
        Keyframe(7.0, 0.0, 0.78),  # release
        Keyframe(8.0, -0.03, 0.78),
    )
    return Script("press", 8.0, (Device("probe", 15e-3, 0.0, keys),))


def _squeeze(deeper: float, along: float) -> Script:
    """Finger and thumb close on a limb, let up, close again, and let go."""
    steps = ((0.0, -0.02), (1.5, 0.0), (2.7, 2.2e-3 * deeper), (3.4, 2.2e-3 * deeper), (4.2, 1e-3 * deeper),
             (5.0, 2.6e-3 * deeper), (6.0, -0.02))  # fmt: skip
    keys = tuple(Keyframe(time, depth, along) for time, depth in steps)
    return Script("squeeze", 6.0, (Device("finger", 12e-3, 0.0, keys), Device("thumb", 12e-3, 180.0, keys)))


PRESS = _press(1.0)
ON_ONE_LAYER = {script.name: script for script in (PRESS, _squeeze(1.0, 0.66))}  # to 0.1 N, where E is 1 kPa
ON_LIMBS = {script.name: script for script in (_press(DEEPER), _squeeze(DEEPER, 0.45))}  # to 5 N on a forearm


def scripts_for(layer: SoftLayer) -> dict[str, Script]:
    """The scripts by name, as deep as suits a layer: one of one material, or skin, fat and muscle."""
    return ON_LIMBS if layer.stacked else ON_ONE_LAYER


def capsule(radius: float, length: float = 0.06, sections: int = 32, *, name: str = "capsule") -> Tool:
    """A closed capsule of `radius` [m] whose round tip touches the origin; z points from the body into the tool."""
    import trimesh

    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[sections, sections])
    vertices = mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]
    return Tool(name, vertices, mesh.faces)


class SkinPath:
    """Points on the skin and averaged normals, along a limb at one angle about its axis.

    Args:
        layer: layer of the limb.
        around: angle about the limb's axis [degrees].
        footprint: radius over which normals are averaged [m].
    """

    def __init__(self, layer: SoftLayer, around: float, footprint: float) -> None:
        centre, axis, side = _limb_axes(layer)
        heights = (layer.vertices - centre) @ axis
        low, high = np.quantile(heights, (0.02, 0.98))
        stations = np.linspace(low, high, STATIONS)
        turn = np.radians(around)
        outwards = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
        places = [_surface_point(layer, centre, axis, outwards, h) for h in stations]
        found = {i: place for i, place in enumerate(places) if place is not None}
        if len(found) < STATIONS / 2:  # near its ends a limb's rim may leave some stations without skin
            raise InvalidInput(f"skin was found at {len(found)} of {STATIONS} heights along the layer; is it a limb?")
        points = np.array(list(found.values()))
        normals = np.array([_mean_normal(layer, point, outwards, footprint) for point in points])
        self._along = np.array(list(found)) / (STATIONS - 1)
        self._tissue = layer.thickness[KDTree(layer.vertices).query(points)[1]]
        kernel = np.hanning(13) / np.hanning(13).sum()
        self._points = _smoothed(points, kernel)
        self._normals = _smoothed(normals, kernel)
        self._tissue = _smoothed(self._tissue[:, None].repeat(3, axis=1), kernel)[:, 0]

    def at(self, along: float) -> tuple[np.ndarray, np.ndarray]:
        """Point on the skin (3,) [m] and outward unit normal (3,) at `along` in [0, 1]."""
        point = np.array([np.interp(along, self._along, self._points[:, k]) for k in range(3)])
        normal = np.array([np.interp(along, self._along, self._normals[:, k]) for k in range(3)])
        return point, normal / np.linalg.norm(normal)

    def tissue(self, along: float) -> float:
        """Thickness of the tissue below that point [m]."""
        return float(np.interp(along, self._along, self._tissue))


class Motion:
    """One device on one layer: its tool, and at every time its pose and wrench."""

    def __init__(self, device: Device, layer: SoftLayer) -> None:
        self.device, self.layer = device, layer
        self.tool = capsule(device.radius, name=device.name)
        self._path = SkinPath(layer, device.around, SMOOTHING * footprint(device.radius, 2e-3))
        self._force = self._force_on_limb() if layer.stacked else partial(
            foundation_force, radius=device.radius, thickness=float(np.median(layer.thickness)),
            confined_modulus=layer.tissue.confined_modulus,
        )  # fmt: skip

    def at(self, time: float) -> tuple[Transform, Wrench]:
        """pose_body_from_tool (4, 4), and the wrench on the body in the body's axes (6,), at `time` [s]."""
        depth, along = self.device.at(time)
        if self.layer.stacked:
            depth = min(depth, DEEPEST * self._path.tissue(along))
        point, normal = self._path.at(along)
        pose = np.eye(4)
        pose[:3, :3] = _frame_along(normal)
        pose[:3, 3] = point - depth * normal
        return pose, np.concatenate([-self._force(depth) * normal, np.zeros(3)])

    def _force_on_limb(self) -> Callable[[float], float]:
        """Force over depth [N] by the linear response of the flat stack, as thick as where the device presses most."""
        deepest = max(self.device.keyframes, key=lambda key: key.depth)
        tissue, thickness = self.layer.tissue, self._path.tissue(deepest.along)
        depths = np.linspace(0, deepest.depth, FORCES)
        forces = [0.0, *(ball_force(tissue, thickness, self.device.radius, depth) for depth in depths[1:])]
        return lambda depth: float(np.interp(depth, depths, forces))


def footprint(radius: float, depth: float) -> float:
    """Radius of the circle in which a sphere cuts a plane at `depth`, sqrt(2 R d) [m]."""
    return float(np.sqrt(2 * radius * max(depth, 0.0)))


def foundation_force(depth: float, radius: float, thickness: float, confined_modulus: float) -> float:
    """Force of a sphere on a soft foundation, F = 0.6 pi R d^2 M / t [N] (Johnson, Contact Mechanics, 4.3)."""
    return float(SOFTER * np.pi * radius * max(depth, 0.0) ** 2 * confined_modulus / thickness)


def _limb_axes(layer: SoftLayer) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre [m], long axis, and the direction across it in which the skin looks most (or x, y, z if it is round)."""
    centre = np.average(layer.vertices, axis=0, weights=layer.vertex_areas)
    axis = np.linalg.svd(layer.vertices - centre, full_matrices=False)[2][0]
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    up = np.eye(3)[np.abs(axis).argmin()]
    side = up - (up @ axis) * axis
    return centre, axis, side / np.linalg.norm(side)


def _surface_point(
    layer: SoftLayer, centre: np.ndarray, axis: np.ndarray, outwards: np.ndarray, height: float
) -> np.ndarray | None:
    """Where a ray `outwards` from the limb's middle at `height` last leaves the skin (Moller & Trumbore 1997)."""
    heights = (layer.vertices - centre) @ axis
    ring = np.abs(heights - height) < max(0.01, 2 * layer.edge_length)
    if not ring.any():
        return None
    middle = np.average(layer.vertices[ring], axis=0, weights=layer.vertex_areas[ring])
    a, b, c = (layer.vertices[layer.faces[:, k]] for k in range(3))
    cross = np.cross(outwards, c - a)
    det = np.einsum("ij,ij->i", b - a, cross)
    det = np.where(np.abs(det) < 1e-18, np.inf, det)
    u = np.einsum("ij,ij->i", middle - a, cross) / det
    other = np.cross(middle - a, b - a)
    v = other @ outwards / det
    t = np.einsum("ij,ij->i", c - a, other) / det
    hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0) & np.isfinite(det)
    if not hit.any():
        return None
    return middle + t[hit].max() * outwards


def _mean_normal(layer: SoftLayer, point: np.ndarray, outwards: np.ndarray, radius: float) -> np.ndarray:
    near = np.linalg.norm(layer.vertices - point, axis=1) < max(radius, 2 * layer.edge_length)
    near &= layer.normals @ outwards > 0
    total = layer.vertex_area_vectors[near].sum(axis=0)
    return total / np.linalg.norm(total)


def _smoothed(rows: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    padded = np.pad(rows, ((len(kernel) // 2,) * 2, (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in range(3)], axis=1)


def _frame_along(z: np.ndarray) -> np.ndarray:
    """A rotation whose third column is `z` (3,), turning no more than it must (Duff et al. 2017)."""
    x, y, s = z[0], z[1], np.copysign(1.0, z[2])
    a = -1.0 / (s + z[2])
    b = x * y * a
    return np.array([[1 + s * x * x * a, b, x], [s * b, s + y * y * a, y], [-s * x, -y, z[2]]])
