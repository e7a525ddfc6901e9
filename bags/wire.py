"""Wire: every message, decoded and encoded once: what its fields mean as core types, and core types as messages.

Decoding takes rclpy's messages and those of a recording alike. Encoding imports the ROS classes when it is first asked.
"""

from __future__ import annotations

import importlib
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bags.frame import Frame, Stamps
from stmpl_core.arrays import Transform, Wrench, finite
from stmpl_core.contact import MOST, Contact, counted
from stmpl_core.errors import BagError, FrameError, InvalidInput, MeshError
from stmpl_core.layer import MAX_EXTENT, SoftLayer, layer_id
from stmpl_core.local_contact import Grip, LocalContact
from stmpl_core.packed import stack_from_text, stack_to_text
from stmpl_core.rig import Rig
from stmpl_core.state import State
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from stmpl_core.touch import Answer, Slip, Touch
from stmpl_core.trust import Trust

FixedFrames = Mapping[str, Transform]  # pose_body_from_frame of each frame that does not move, (4, 4)

NANO = 1_000_000_000  # nanoseconds in a second
NO_FRAMES: FixedFrames = MappingProxyType({})
NO_FRICTION: Mapping[str, float] = MappingProxyType({})
NO_SURFACES: Mapping[str, str] = MappingProxyType({})
MOST_TOLD = 1e-6 * MOST  # largest number of a wrench that is told: about another point it is one that is counted
QUATERNION_TOLERANCE = 1e-2  # error of a unit quaternion's length; through float32 or text it is far less
NOWHERE = np.full((4, 4), np.nan)  # pose that a recording does not tell
NOT_TOLD = np.full(3, np.nan)  # likewise a place, or a way


# Decoding


def stamp_ns(message: Any) -> int:
    """The header's stamp [ns]."""
    return _ns(message.header.stamp)


def layer_from(topology: Any) -> SoftLayer:
    """The layer that a SkinTopology message describes. Raises MeshError or InvalidInput."""
    tissue, scale, bony = Tissue(topology.youngs_modulus, topology.poisson_ratio, topology.density), None, None
    if stack := getattr(topology, "stack", ""):  # recordings from before stacks have none
        try:
            tissue, scale, bony = stack_from_text(stack)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InvalidInput(f"the stack of a SkinTopology cannot be read: {error}.") from error
    vertices, triangles = _rows("vertices", topology.vertices), _rows("triangles", topology.triangles)
    core = _rows("core", getattr(topology, "core", ()))
    below = {"core": core} if len(core) else {"thickness": np.asarray(topology.thickness)}
    rig = None
    if text := getattr(topology, "rig", ""):
        rig = Rig.from_text(text, np.asarray(topology.rig_weights, float))
    if bony is not None:
        bony = np.isin(np.arange(len(vertices)), bony)
    return SoftLayer(vertices, triangles.astype(np.int32), **below, tissue=tissue, ply_scale=scale, bony=bony, rig=rig)


def tool_from(message: Any) -> Tool:
    """The tool that a ContactMesh message announces. Raises FrameError, MeshError or InvalidInput."""
    triangles = _rows("triangles", message.triangles).astype(np.int32)
    return _announced(message.header.frame_id, _rows("vertices", message.vertices), triangles)


def tool_from_shape(message: Any, name: str) -> Tool:
    """The tool that a shape_msgs/Mesh announces, in metres and in its own frame. Raises as `tool_from`."""
    vertices = np.array([(p.x, p.y, p.z) for p in message.vertices], dtype=np.float64).reshape(-1, 3)
    triangles = np.array([list(t.vertex_indices) for t in message.triangles], dtype=np.int64).reshape(-1, 3)
    return _announced(name, vertices.astype(np.float32), triangles)


def pose_from(pose: Any) -> Transform:
    """geometry_msgs/Pose as a rigid transform (4, 4).

    Raises:
        InvalidInput: numbers that are not finite, or the quaternion is no unit quaternion.
    """
    p, q = pose.position, pose.orientation
    return rigid((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def rigid(place: Sequence[float], quaternion: Sequence[float]) -> Transform:
    """Rigid transform (4, 4) of a place [m] and a quaternion x y z w. Raises as `pose_from`."""
    x, y, z, w = map(float, quaternion)  # numpy takes five times as long for four numbers
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise InvalidInput(f"quaternion {[x, y, z, w]} has length {length:g}; it must be 1 (no turn: 0, 0, 0, 1).")
    x, y, z, w = x / length, y / length, z / length, w / length
    a, b, c = place
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), a],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), b],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), c],
        [0.0, 0.0, 0.0, 1.0],
    ], dtype=np.float64)  # fmt: skip


def pose_of_tool(message: Any, tool: str, body_frame: str, frames: FixedFrames = NO_FRAMES) -> Transform:
    """pose_body_from_tool (4, 4) of a PoseStamped.

    Raises:
        FrameError: a frame that is neither the body's nor in `frames`.
        InvalidInput: numbers that are not finite, no rotation, or so far off that it must be in millimetres.
    """
    frame, pose = message.header.frame_id, pose_from(message.pose)
    if frame != body_frame:
        if frame not in frames:
            known = "', '".join([body_frame, *frames])
            raise FrameError(f"the pose of {tool} is in frame '{frame}'; known are '{known}'. Transform it before "
                             "sending, list the frame in the file of the parameter `frames`, or set `frame`.")
        pose = frames[frame] @ pose
    finite(f"pose of {tool}", pose, (4, 4))
    far = float(np.abs(pose[:3, 3]).max())
    if far > MAX_EXTENT:
        told = f"{far:.1f}" if far < 1e6 else f"{far:.3g}"
        raise InvalidInput(f"{tool} is {told} m from the body's origin; at most {MAX_EXTENT} m is accepted. "
                           "Is its pose in millimetres? Scale it by 1e-3.")
    return pose


def wrench_from(
    message: Any, *, body_frame: str, tool: str, pose_body_from_tool: Transform, frames: FixedFrames = NO_FRAMES
) -> Wrench:
    """geometry_msgs/WrenchStamped in the body's axes: force [N], torque about the tool's origin [N m], shape (6,).

    In the body's frame and in the tool's own the torque is about the tool's origin already; in any other, such as a
    sensor's, it is about that frame's, as tf2 has it, and taken to the tool's.

    Raises:
        FrameError: a frame that is neither the body's, nor the tool's own, nor in `frames`.
        InvalidInput: numbers that are not finite or beyond MOST_TOLD.
    """
    frame = message.header.frame_id
    wrench = counted(f"wrench of {tool}", _six(message.wrench), (6,), MOST_TOLD)
    if frame == body_frame:
        return wrench
    if frame != tool and frame not in frames:  # frames of /tf are found when asked for, and not listed
        known = "', '".join([body_frame, *frames, tool])
        raise FrameError(f"the wrench of {tool} is in frame '{frame}'; known are '{known}'.")
    stands = pose_body_from_tool if frame == tool else frames[frame]
    force, torque = stands[:3, :3] @ wrench[:3], stands[:3, :3] @ wrench[3:]
    return np.concatenate([force, torque + np.cross(stands[:3, 3] - pose_body_from_tool[:3, 3], force)])


def joints_from(message: Any, names: Mapping[str, str]) -> dict[str, float]:
    """Angle of each joint [rad] that a JointState tells of, by the rig's names.

    Args:
        message: sensor_msgs/JointState; joints of no rig are passed over.
        names: name in the message by the rig's name of each joint.

    Returns:
        Angles by joint; empty if the message is of others.

    Raises:
        InvalidInput: of these joints, but not as many positions as names, one of them twice, or an angle that is not
            finite.
    """
    if not set(names.values()) & set(message.name):
        return {}
    if len(message.position) != len(message.name):
        raise InvalidInput(f"joint states hold {len(message.position)} positions for {len(message.name)} names.")
    for name in names.values():
        if list(message.name).count(name) > 1:
            raise InvalidInput(f"joint {name} is there {list(message.name).count(name)} times in one message of joint "
                               "states; which of its angles holds is not known.")  # fmt: skip
    told = dict(zip(message.name, message.position, strict=True))
    found = {joint: float(told[name]) for joint, name in names.items() if name in told}
    for joint, angle in found.items():
        if not np.isfinite(angle):
            raise InvalidInput(f"joint {names[joint]} is {angle} rad; it must be finite.")
    return found


def contact_from(
    tool: Tool, pose: Any, wrench: Any | None, *, body_frame: str, frames: FixedFrames = NO_FRAMES,
    wrench_frames: FixedFrames | None = None,
) -> Contact:  # fmt: skip
    """One tool at one instant, from its PoseStamped and, where there is a force sensor, its WrenchStamped.

    Args:
        wrench_frames: frames at the wrench's stamp; None: as at the pose's.

    Raises:
        FrameError: pose or wrench in a frame that is not known.
        InvalidInput: numbers that are not finite, or not a rigid pose.
    """
    at, time = pose_of_tool(pose, tool.name, body_frame, frames), stamp_ns(pose) / NANO
    if wrench is None:
        return Contact(tool, at, time=time)
    values = wrench_from(wrench, body_frame=body_frame, tool=tool.name, pose_body_from_tool=at,
                         frames=frames if wrench_frames is None else wrench_frames)  # fmt: skip
    return Contact(tool, at, values, time)


def frame_from(message: Any, log_time_ns: int) -> Frame:
    """The answer that a SkinDisplacement message carries, of today's form or an older one. Raises InvalidInput."""
    pressure = np.asarray(message.pressure, dtype=np.float32)
    bound = float(message.error_bound)
    trust = Trust(bool(message.converged), bool(message.in_range), None if np.isnan(bound) else bound, message.why)
    touches, inputs = _touches(message) if hasattr(message, "touches") else _touches_before(message)
    return Frame(
        displacement=_rows("displacement", message.displacement).astype(np.float32, copy=False),
        trust=trust,
        method=message.method,
        pressure=pressure if len(pressure) else None,
        touches=touches,
        stamp_ns=stamp_ns(message),
        log_time_ns=log_time_ns,
        sequence=int(message.sequence),
        layer_id=message.layer_id,
        inputs=inputs,
        solve_seconds=float(message.solve_seconds),
        fade=float(getattr(message, "fade", 1.0)),  # older recordings have none of these
        state=bytes(getattr(message, "state", b"")),
        dt=float(getattr(message, "dt", 0.0)),
        friction={one.tool: float(getattr(one, "friction", 0.0)) for one in getattr(message, "touches", ())},
        joints=tuple(float(angle) for angle in getattr(message, "joints", ())),
        surfaces={one.tool: getattr(one, "surface", "") for one in getattr(message, "touches", ())},
    )


def local_contact_from(message: Any) -> LocalContact:
    """The local model that a message carries, for a DeviceLoop. Raises InvalidInput if it cannot be rendered."""
    model = LocalContact(
        pose_from(message.pose),
        _six(message.wrench),
        np.asarray(message.stiffness, float).reshape(6, 6),
        float(message.valid_m),
        float(message.valid_rad),
        message.status,
        Trust(in_range=bool(message.in_range)),
        _grip(message),
        float(getattr(message, "power", 1.0)),
        float(getattr(message, "eased", 0.0)),
    )
    model.check()
    return model


def _grip(message: Any) -> Grip | None:
    """Friction of a local model; None: there is none, or the message is older than friction."""
    limit = float(getattr(message, "friction_limit", 0.0))
    if limit == 0:
        return None
    ways = np.asarray(message.friction_ways, float).reshape(3, 6)
    return Grip(ways, np.asarray(message.friction_forces, float), np.asarray(message.friction_stiffness, float), limit)


def _announced(name: str, vertices: np.ndarray, triangles: np.ndarray) -> Tool:
    if not name:
        raise FrameError("a contact mesh has no frame_id; it must carry the tool's name, as in tools/NAME/pose.")
    tool = Tool(name, vertices, triangles)
    extent = float(np.ptp(tool.vertices, axis=0).max())
    if extent > MAX_EXTENT:
        raise MeshError(f"{name} is {extent:.1f} m wide; at most {MAX_EXTENT} m is accepted. "
                        "Is its mesh in millimetres? Scale it by 1e-3.")
    return tool


def _touches(message: Any) -> tuple[dict[str, Touch], Stamps]:
    touches = {one.tool: _touch_from(one) for one in message.touches}
    return touches, {one.tool: (_ns(one.pose_stamp), _ns(one.wrench_stamp)) for one in message.touches}


def _touch_from(message: Any) -> Touch:
    touch = Touch(message.tool, message.status, pose_from(message.pose), _six(message.wrench), float(message.depth),
                  float(message.force_bound), trust=Trust(in_range=bool(message.in_range)))  # fmt: skip
    if not hasattr(message, "slip"):  # recordings from before friction
        return touch
    slip = None
    if message.slip:
        slip = Slip(_six(message.friction_wrench), float(message.slip_share), NOT_TOLD, float("nan"), NOT_TOLD)
    return replace(touch, missing=_six(message.missing), slip=slip, passive=float(message.passive))


def _touches_before(message: Any) -> tuple[dict[str, Touch], Stamps]:
    """Of recordings from before stmpl_msgs/Touch, which tell the status alone."""
    touches = {tool: Touch(tool, status, NOWHERE, np.full(6, np.nan))
               for tool, status in zip(message.tools, message.statuses, strict=True)}  # fmt: skip
    stamps = zip(message.tools, message.pose_stamps, message.wrench_stamps, strict=True)
    return touches, {tool: (_ns(pose), _ns(wrench)) for tool, pose, wrench in stamps}


def _six(wrench: Any) -> Wrench:
    f, t = wrench.force, wrench.torque
    return np.array([f.x, f.y, f.z, t.x, t.y, t.z], dtype=np.float64)


def _ns(time: Any) -> int:
    return time.sec * NANO + time.nanosec


def _rows(name: str, flat: Any) -> np.ndarray:
    values = np.asarray(flat)
    if values.ndim != 1 or len(values) % 3:
        raise InvalidInput(f"{name} holds {values.size} numbers; it must hold three each.")
    return values.reshape(-1, 3)


# Encoding


@cache
def message_class(type_name: str) -> Any:
    """The Python class of `pkg/msg/Type`. Raises BagError if it is not installed."""
    package, kind, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f"message type {type_name} is not installed; install or source {package}.") from error


def floats(values: ArrayLike) -> array:
    """`values` as the flat float32 array that a message takes over without looking at each element."""
    filled = array("f")
    filled.frombytes(np.ascontiguousarray(values, dtype=np.float32).tobytes())
    return filled


def integers(values: ArrayLike) -> array:
    """`values` as the flat uint32 array that a message takes over without looking at each element."""
    filled = array("I")
    filled.frombytes(np.ascontiguousarray(values, dtype=np.uint32).tobytes())
    return filled


def header(frame: str, stamp_ns: int) -> Any:
    """A header in `frame` with a stamp given in nanoseconds."""
    made = message_class("std_msgs/msg/Header")(frame_id=frame)
    made.stamp.sec, made.stamp.nanosec = divmod(stamp_ns, NANO)
    return made


def quaternion_from(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """The unit quaternion x y z w of a rotation matrix (3, 3), with w >= 0.

    It belongs to the largest eigenvalue of Davenport's K matrix (Bar-Itzhack 2000, J. Guidance 23(6)).
    """
    r = rotation
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    k = np.empty((4, 4))
    k[:3, :3] = r + r.T - np.trace(r) * np.eye(3)
    k[:3, 3] = k[3, :3] = axis
    k[3, 3] = np.trace(r)
    q = np.linalg.eigh(k)[1][:, -1]
    x, y, z, w = map(float, q if q[3] >= 0 else -q)
    return x, y, z, w


def pose_message(pose: Transform, body_frame: str, stamp_ns: int) -> Any:
    """pose_body_from_tool as a PoseStamped."""
    return message_class("geometry_msgs/msg/PoseStamped")(header=header(body_frame, stamp_ns), pose=_pose(pose))


def wrench_message(wrench: Wrench, frame: str, stamp_ns: int) -> Any:
    """Force [N] and torque about the tool's origin [N m] that the tool exerts on the body, as a WrenchStamped."""
    return message_class("geometry_msgs/msg/WrenchStamped")(header=header(frame, stamp_ns), wrench=_wrench(wrench))


def tool_message(tool: Tool, stamp_ns: int) -> Any:
    """The surface of a tool as a ContactMesh."""
    kind = message_class("stmpl_msgs/msg/ContactMesh")
    return kind(header=header(tool.name, stamp_ns), vertices=floats(tool.vertices), triangles=integers(tool.faces))


def topology_message(layer: SoftLayer, body_frame: str, stamp_ns: int) -> Any:
    """A layer as a SkinTopology."""
    tissue = layer.tissue
    more = bool(tissue.skin or tissue.deeper) or tissue.relaxes or layer.ply_scale is not None or layer.bony is not None
    return message_class("stmpl_msgs/msg/SkinTopology")(
        header=header(body_frame, stamp_ns),
        layer_id=layer_id(layer),
        vertices=floats(layer.vertices),
        triangles=integers(layer.faces),
        thickness=floats(layer.thickness),
        youngs_modulus=float(layer.tissue.youngs_modulus),
        poisson_ratio=float(layer.tissue.poisson_ratio),
        density=float(layer.tissue.density),
        core=floats([] if layer.core is None else layer.core),
        stack=stack_to_text(layer.tissue, layer.ply_scale, layer.bony) if more else "",
        rig="" if layer.rig is None else layer.rig.to_text(),
        rig_weights=floats([] if layer.rig is None else layer.rig.weights),
    )


def displacement_message(
    answer: Answer,
    *,
    layer_id: str,
    body_frame: str,
    stamp_ns: int,
    sequence: int = 0,
    solve_seconds: float = 0.0,
    inputs: Stamps,
    fade: float = 1.0,
    why: str = "",
    state: State | None = None,
    dt: float = 0.0,
    friction: Mapping[str, float] = NO_FRICTION,
    joints: Sequence[float] = (),
    surfaces: Mapping[str, str] = NO_SURFACES,
) -> Any:
    """An answer as a SkinDisplacement.

    Args:
        answer: answer, whole or a share of one.
        layer_id: name of its layer.
        body_frame: frame_id of the body.
        stamp_ns: stamp of the newest pose that it answers [ns].
        sequence: number of the answer.
        solve_seconds: time spent on it [s].
        inputs: stamps of the poses and wrenches that it answers [ns].
        fade: share of its contacts' answer that it is (see Answer.faded).
        why: sentence to add to the trust's own.
        state: memory of the tissue before it; None: none, elastic skin.
        dt: time since that state [s].
        friction: coefficient of friction of each tool [-]; 0 unless given.
        joints: angle of each joint of the layer's rig [rad]; empty: at rest.
        surfaces: name of each tool's surface (Tool.digest); empty unless given.
    """
    trust = answer.trust
    return message_class("stmpl_msgs/msg/SkinDisplacement")(
        header=header(body_frame, stamp_ns),
        layer_id=layer_id,
        sequence=sequence,
        displacement=floats(answer.displacement),
        pressure=array("f") if answer.pressure is None else floats(answer.pressure),
        method=answer.method,
        converged=bool(trust.converged),
        in_range=bool(trust.in_range),
        error_bound=float("nan") if trust.error_bound is None else float(trust.error_bound),
        why="; ".join(filter(None, (trust.why, why))),
        touches=[_touch(touch, *inputs[name], friction.get(name, 0.0), surfaces.get(name, ""))
                 for name, touch in answer.touches.items()],
        fade=fade,
        solve_seconds=solve_seconds,
        dt=dt,
        state=array("B", b"" if state is None else state.pack()),
        joints=array("d", joints),
    )


def deformed_message(answer: Any, rest: np.ndarray) -> Any:
    """The skin under a SkinDisplacement, as a SkinDeformed: its displacement added to vertices (V, 3) [m]."""
    moved = rest + np.frombuffer(answer.displacement, dtype=np.float32).reshape(-1, 3)
    kind = message_class("stmpl_msgs/msg/SkinDeformed")
    return kind(header=answer.header, layer_id=answer.layer_id, vertices=floats(moved))


def local_contact_message(tool: str, model: LocalContact, status: str, body_frame: str, stamp_ns: int) -> Any:
    """A local model as a message; `status` is what the answer says of the tool."""
    grip = model.grip
    return message_class("stmpl_msgs/msg/LocalContact")(
        header=header(body_frame, stamp_ns),
        name=tool,
        pose=_pose(model.pose_body_from_tool),
        wrench=_wrench(model.wrench),
        stiffness=np.ascontiguousarray(model.stiffness, dtype=np.float64).ravel(),
        valid_m=float(model.valid_m),
        valid_rad=float(model.valid_rad),
        status=status,
        in_range=bool(model.trust.in_range),
        power=float(model.power),
        eased=float(model.eased),
        friction_limit=0.0 if grip is None else float(grip.limit),
        friction_ways=np.zeros(18) if grip is None else np.ascontiguousarray(grip.axes, dtype=np.float64).ravel(),
        friction_forces=np.zeros(3) if grip is None else np.asarray(grip.forces, np.float64),
        friction_stiffness=np.zeros(3) if grip is None else np.asarray(grip.stiffness, np.float64),
    )


def _touch(touch: Touch, pose_stamp: int, wrench_stamp: int, friction: float, surface: str) -> Any:
    slip = touch.slip
    return message_class("stmpl_msgs/msg/Touch")(
        tool=touch.name,
        status=touch.status,
        pose=_pose(touch.pose_body_from_tool),
        wrench=_wrench(touch.wrench),
        depth=float(touch.depth),
        force_bound=float(touch.force_bound),
        in_range=bool(touch.trust.in_range),
        pose_stamp=_time(pose_stamp),
        wrench_stamp=_time(wrench_stamp),
        friction=friction,
        slip="" if slip is None else slip.kind,
        slip_share=0.0 if slip is None else float(slip.share),
        friction_wrench=_wrench(np.zeros(6) if slip is None else slip.wrench),
        missing=_wrench(touch.missing),
        passive=float(touch.passive),
        surface=surface,
    )


def _time(stamp_ns: int) -> Any:
    return message_class("builtin_interfaces/msg/Time")(sec=stamp_ns // NANO, nanosec=stamp_ns % NANO)


def _pose(pose: Transform) -> Any:
    message = message_class("geometry_msgs/msg/Pose")()
    p, q = message.position, message.orientation
    p.x, p.y, p.z = map(float, pose[:3, 3])
    q.x, q.y, q.z, q.w = quaternion_from(pose[:3, :3])
    return message


def _wrench(wrench: Wrench) -> Any:
    message = message_class("geometry_msgs/msg/Wrench")()
    f, t = message.force, message.torque
    f.x, f.y, f.z, t.x, t.y, t.z = map(float, wrench)
    return message
