"""Messages: what the fields of the ROS messages mean as core types, for rclpy's objects and for decoded ones alike."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from stmpl_core.arrays import PerVertex, Transform, VertexVectors, Wrench
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.errors import FrameError, InvalidInput
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.trust import Trust

FixedFrames = Mapping[str, Transform]  # pose_body_from_frame of each frame that does not move, (4, 4)

NO_FRAMES: FixedFrames = MappingProxyType({})
QUATERNION_TOLERANCE = 1e-2  # a unit quaternion that went through float32 or text is off by far less


@dataclass(frozen=True, eq=False)
class Frame:
    """One recorded answer (stmpl_msgs/SkinDisplacement).

    Args:
        stamp_ns: of the newest pose that it answers [ns].
        log_time_ns: when the recorder received it [ns].
        sequence: counts the answers of one run.
        layer_id: of the layer that it refers to.
        displacement: (V, 3) float32 [m], as it was sent.
        pressure: that was solved for, (V,) float32 [Pa], or None.
        method: that answered.
        trust: what may be believed of it.
        statuses: what was found of each tool, by its name.
        inputs: stamps of the pose and the wrench of each tool that it answers [ns]; 0: no wrench.
        solve_seconds: time that the node spent on it [s].
        fade: share of its contacts' answer that it is; below 1 where the input had stopped.
    """

    stamp_ns: int
    log_time_ns: int
    sequence: int
    layer_id: str
    displacement: VertexVectors
    pressure: PerVertex | None
    method: str
    trust: Trust
    statuses: dict[str, str]
    inputs: dict[str, tuple[int, int]]
    solve_seconds: float
    fade: float = 1.0

    @property
    def tools(self) -> tuple[str, ...]:
        """Names of the tools whose contacts are answered."""
        return tuple(self.statuses)

    @property
    def peak(self) -> float:
        """Length of the largest displacement [m]."""
        return float(np.linalg.norm(self.displacement, axis=1).max(initial=0.0))


def stamp_ns(message: Any) -> int:
    """The header's stamp [ns]."""
    return _ns(message.header.stamp)


def _ns(time: Any) -> int:
    return time.sec * 1_000_000_000 + time.nanosec


def layer_id(layer: SoftLayer) -> str:
    """Sixteen hex digits that name a layer: SHA-256 of its vertices, faces, thickness and tissue, all as published.

    Vertices and thickness count as float32, so a layer that went through SkinTopology keeps its name.
    """
    tissue = layer.tissue
    material = np.array([tissue.youngs_modulus, tissue.poisson_ratio, tissue.density])
    digest = hashlib.sha256()
    for values, kind in ((layer.vertices, "<f4"), (layer.faces, "<u4"), (layer.thickness, "<f4"), (material, "<f8")):
        digest.update(np.ascontiguousarray(values, dtype=kind).tobytes())
    return digest.hexdigest()[:16]


def layer_from(topology: Any) -> SoftLayer:
    """The layer that a SkinTopology message describes. Raises MeshError or InvalidInput."""
    tissue = Tissue(topology.youngs_modulus, topology.poisson_ratio, topology.density)
    vertices, triangles = _rows("vertices", topology.vertices), _rows("triangles", topology.triangles)
    return SoftLayer(vertices, triangles.astype(np.int32), np.asarray(topology.thickness), tissue=tissue)


def tool_mesh_from(message: Any) -> ToolMesh:
    """The tool surface that a ContactMesh message describes. Raises MeshError or InvalidInput."""
    triangles = _rows("triangles", message.triangles).astype(np.int32)
    return ToolMesh.of(_rows("vertices", message.vertices), triangles)


def pose_from(pose: Any) -> Transform:
    """geometry_msgs/Pose as a rigid transform (4, 4).

    Raises:
        InvalidInput: not finite, or the quaternion is no unit quaternion.
    """
    p, q = pose.position, pose.orientation
    xyzw = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    length = float(np.sqrt(xyzw @ xyzw))
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise InvalidInput(f"quaternion {xyzw.tolist()} has length {length:g}; it must be 1 (no turn: 0, 0, 0, 1).")
    x, y, z, w = xyzw / length
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, 3] = p.x, p.y, p.z
    return transform


def wrench_from(
    message: Any, *, body_frame: str, tool: str, pose_body_from_tool: Transform, frames: FixedFrames = NO_FRAMES
) -> Wrench:
    """geometry_msgs/WrenchStamped in the body's axes: force [N], torque about the tool's origin [N m], shape (6,).

    Raises:
        FrameError: the wrench is given neither in the body's frame, nor in the tool's own, nor in one of `frames`.
    """
    f, t = message.wrench.force, message.wrench.torque
    wrench = np.array([f.x, f.y, f.z, t.x, t.y, t.z], dtype=np.float64)
    if message.header.frame_id == body_frame:
        return wrench
    placed = {**frames, tool: pose_body_from_tool}
    if message.header.frame_id not in placed:
        known = "' and '".join([body_frame, *placed])
        raise FrameError(f"the wrench of {tool} is in frame '{message.header.frame_id}'; known are '{known}'.")
    rotation = placed[message.header.frame_id][:3, :3]
    return np.concatenate([rotation @ wrench[:3], rotation @ wrench[3:]])


def contact_from(
    tool: str, mesh: ToolMesh, pose: Any, wrench: Any | None, *, body_frame: str, frames: FixedFrames = NO_FRAMES
) -> Contact:
    """One tool at one instant, from its PoseStamped and, where there is a force sensor, its WrenchStamped.

    Raises:
        FrameError: pose or wrench in a frame that is not known.
        InvalidInput: not finite, or not a rigid pose.
    """
    frame, transform = pose.header.frame_id, pose_from(pose.pose)
    if frame != body_frame:
        if frame not in frames:
            known = "' and '".join([body_frame, *frames])
            raise FrameError(f"the pose of {tool} is in frame '{frame}'; known are '{known}'.")
        transform = frames[frame] @ transform
    if wrench is None:
        return Contact(tool, mesh, transform)
    values = wrench_from(wrench, body_frame=body_frame, tool=tool, pose_body_from_tool=transform, frames=frames)
    return Contact(tool, mesh, transform, values)


def frame_from(message: Any, log_time_ns: int) -> Frame:
    """The answer that a SkinDisplacement message carries. Raises InvalidInput."""
    pressure = np.asarray(message.pressure, dtype=np.float32)
    bound = float(message.error_bound)
    trust = Trust(bool(message.converged), bool(message.in_range), None if np.isnan(bound) else bound, message.why)
    return Frame(
        stamp_ns=stamp_ns(message),
        log_time_ns=log_time_ns,
        sequence=int(message.sequence),
        layer_id=message.layer_id,
        displacement=_rows("displacement", message.displacement).astype(np.float32, copy=False),
        pressure=pressure if len(pressure) else None,
        method=message.method,
        trust=trust,
        statuses=dict(zip(message.tools, message.statuses, strict=True)),
        inputs={tool: (_ns(pose), _ns(wrench)) for tool, pose, wrench in zip(
            message.tools, message.pose_stamps, message.wrench_stamps, strict=True)},
        solve_seconds=float(message.solve_seconds),
        fade=float(getattr(message, "fade", 1.0)),  # older recordings have none
    )


def _rows(name: str, flat: Any) -> np.ndarray:
    array = np.asarray(flat)
    if array.ndim != 1 or len(array) % 3:
        raise InvalidInput(f"{name} holds {array.size} numbers; it must hold three each.")
    return array.reshape(-1, 3)
