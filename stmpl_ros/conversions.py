"""Core types to messages, and the checks that a message passes on its way in (bags.messages does the reading)."""

from __future__ import annotations

from array import array
from collections.abc import Mapping

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, WrenchStamped
from geometry_msgs.msg import Wrench as WrenchMessage
from numpy.typing import ArrayLike
from std_msgs.msg import Header
from stmpl_msgs.msg import ContactMesh, SkinDeformed, SkinDisplacement, SkinTopology
from stmpl_msgs.msg import LocalContact as LocalContactMessage

from bags.messages import layer_id, pose_from, tool_mesh_from, wrench_from
from stmpl_core.arrays import Transform, Wrench, finite
from stmpl_core.contact import ToolMesh
from stmpl_core.errors import FrameError, InvalidInput, MeshError
from stmpl_core.haptics import LocalContact
from stmpl_core.layer import MAX_EXTENT, SoftLayer
from stmpl_core.trust import Displacement, Trust

NANO = 1_000_000_000  # nanoseconds in a second
STALE = "stale"  # status of a tool whose input has stopped: the answer is a share of its last one


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


def header(frame: str, stamp_ns: int) -> Header:
    """A header in `frame` with a stamp given in nanoseconds."""
    made = Header(frame_id=frame)
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


def checked_pose(
    message: PoseStamped, tool: str, body_frame: str, pose_body_from_frame: Transform | None = None
) -> Transform:
    """pose_body_from_tool, (4, 4).

    Raises:
        FrameError: the pose is in another frame than the body's, and not said where that is.
        InvalidInput: not finite, no rotation, or so far off that it must be in millimetres.
    """
    known = message.header.frame_id == body_frame
    if not known and pose_body_from_frame is None:
        raise FrameError(
            f"the pose of {tool} is in frame '{message.header.frame_id}'; expected '{body_frame}'. "
            "Transform it before sending, list the frame in the file of the parameter `frames`, or set `frame`."
        )
    pose = pose_from(message.pose) if known else pose_body_from_frame @ pose_from(message.pose)
    finite(f"pose of {tool}", pose, (4, 4))
    far = float(np.abs(pose[:3, 3]).max())
    if far > MAX_EXTENT:
        raise InvalidInput(
            f"{tool} is {far:.1f} m from the body's origin; at most {MAX_EXTENT} m is accepted. "
            "Is its pose in millimetres? Scale it by 1e-3."
        )
    return pose


def checked_wrench(message: WrenchStamped, tool: str, body_frame: str) -> WrenchStamped:
    """The message itself. Raises FrameError in an unknown frame, InvalidInput if not finite."""
    finite(
        f"wrench of {tool}",
        wrench_from(message, body_frame=body_frame, tool=tool, pose_body_from_tool=np.eye(4)),
        (6,),
    )
    return message


def checked_mesh(message: ContactMesh) -> ToolMesh:
    """The mesh of a tool. Raises MeshError (empty, broken, in millimetres) or InvalidInput."""
    if not message.header.frame_id:
        raise FrameError("a contact mesh has no frame_id; it must carry the tool's name, as in tools/NAME/pose.")
    mesh = tool_mesh_from(message)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if extent > MAX_EXTENT:
        raise MeshError(
            f"{message.header.frame_id} is {extent:.1f} m wide; at most {MAX_EXTENT} m is accepted. "
            "Is its mesh in millimetres? Scale it by 1e-3."
        )
    return mesh


def pose_message(pose: Transform, body_frame: str, stamp_ns: int) -> PoseStamped:
    """pose_body_from_tool as a message."""
    return PoseStamped(header=header(body_frame, stamp_ns), pose=_pose(pose))


def _pose(pose: Transform) -> Pose:
    message = Pose()
    p, q = message.position, message.orientation
    p.x, p.y, p.z = map(float, pose[:3, 3])
    q.x, q.y, q.z, q.w = quaternion_from(pose[:3, :3])
    return message


def wrench_message(wrench: Wrench, frame: str, stamp_ns: int) -> WrenchStamped:
    """Force [N] and torque about the tool's origin [N m] that the tool exerts on the body, as a message."""
    return WrenchStamped(header=header(frame, stamp_ns), wrench=_wrench(wrench))


def _wrench(wrench: Wrench) -> WrenchMessage:
    message = WrenchMessage()
    f, t = message.force, message.torque
    f.x, f.y, f.z, t.x, t.y, t.z = map(float, wrench)
    return message


def mesh_message(tool: str, mesh: ToolMesh, stamp_ns: int) -> ContactMesh:
    """The mesh of a tool as a message."""
    return ContactMesh(header=header(tool, stamp_ns), vertices=floats(mesh.vertices), triangles=integers(mesh.faces))


def topology_message(layer: SoftLayer, body_frame: str, stamp_ns: int) -> SkinTopology:
    """A layer as a message."""
    return SkinTopology(
        header=header(body_frame, stamp_ns),
        layer_id=layer_id(layer),
        vertices=floats(layer.vertices),
        triangles=integers(layer.faces),
        thickness=floats(layer.thickness),
        youngs_modulus=float(layer.tissue.youngs_modulus),
        poisson_ratio=float(layer.tissue.poisson_ratio),
        density=float(layer.tissue.density),
    )


def displacement_message(
    answer: Displacement,
    *,
    layer_id: str,
    body_frame: str,
    stamp_ns: int,
    sequence: int,
    solve_seconds: float,
    inputs: Mapping[str, tuple[int, int]],
    fade: float = 1.0,
) -> SkinDisplacement:
    """An answer as a message, with its trust and the stamps of what it answers [ns] (pose, wrench or 0).

    `fade` says which share of its contacts' answer it is (see `faded`).
    """
    trust = answer.trust
    stamps = [inputs[tool] for tool in answer.statuses]
    return SkinDisplacement(
        header=header(body_frame, stamp_ns),
        layer_id=layer_id,
        sequence=sequence,
        displacement=floats(answer.displacement),
        pressure=array("f") if answer.pressure is None else floats(answer.pressure),
        method=answer.method,
        converged=bool(trust.converged),
        in_range=bool(trust.in_range),
        error_bound=float("nan") if trust.error_bound is None else float(trust.error_bound),
        why=trust.why,
        tools=list(answer.statuses),
        statuses=list(answer.statuses.values()),
        pose_stamps=[Time(sec=pose // NANO, nanosec=pose % NANO) for pose, _ in stamps],
        wrench_stamps=[Time(sec=wrench // NANO, nanosec=wrench % NANO) for _, wrench in stamps],
        fade=fade,
        solve_seconds=solve_seconds,
    )


def faded(answer: Displacement, fade: float, why: str) -> Displacement:
    """The share `fade` of an answer whose input has stopped: no pressure, since none was solved for; `STALE`."""
    trust = Trust(answer.trust.converged, answer.trust.in_range, None, answer.trust.why, answer.trust.figures)
    return Displacement(
        fade * answer.displacement,
        trust.also(why, in_range=False),
        answer.method,
        None,
        dict.fromkeys(answer.statuses, STALE),
    )


def local_contact_message(
    tool: str, model: LocalContact, status: str, body_frame: str, stamp_ns: int
) -> LocalContactMessage:
    """A local model as a message; `status` is what the answer says of the tool."""
    return LocalContactMessage(
        header=header(body_frame, stamp_ns),
        name=tool,
        pose=_pose(model.pose_body_from_tool),
        wrench=_wrench(model.wrench),
        stiffness=np.ascontiguousarray(model.stiffness, dtype=np.float64).ravel(),
        valid_m=float(model.valid_m),
        valid_rad=float(model.valid_rad),
        status=status,
        in_range=bool(model.trust.in_range),
    )


def local_contact_from(message: LocalContactMessage) -> LocalContact:
    """The local model that a message carries, for a DeviceLoop. Raises InvalidInput if it is not finite."""
    f, t = message.wrench.force, message.wrench.torque
    return LocalContact(
        finite("pose", pose_from(message.pose), (4, 4)),
        finite("wrench", [f.x, f.y, f.z, t.x, t.y, t.z], (6,)),
        finite("stiffness", np.asarray(message.stiffness).reshape(6, 6), (6, 6)),
        float(message.valid_m),
        float(message.valid_rad),
        message.status,
        Trust(in_range=bool(message.in_range)),
    )


def deformed_message(answer: SkinDisplacement, rest: np.ndarray) -> SkinDeformed:
    """The skin under an answer: rest vertices (V, 3) [m] plus its displacement."""
    moved = rest + np.frombuffer(answer.displacement, dtype=np.float32).reshape(-1, 3)
    return SkinDeformed(header=answer.header, layer_id=answer.layer_id, vertices=floats(moved))
