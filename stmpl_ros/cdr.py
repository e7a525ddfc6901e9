"""CDR of the small messages that come and go at the rate of the poses: rclpy's own way takes tens of microseconds each.

What is read has the fields of the ROS message, as plain tuples.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message

from bags.wire import NANO, wrench_message
from stmpl_core.arrays import Wrench
from stmpl_core.errors import InvalidInput

ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}  # order of bytes by the encapsulation of plain CDR
START = 4  # bytes of the encapsulation; what follows is aligned from there on
STAMP_AT, FRAME_AT = START, START + 12  # stamp, and text of the frame_id after its length


class Stamp(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Vector(NamedTuple):
    """geometry_msgs/Point or Vector3."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class Pose(NamedTuple):
    """geometry_msgs/Pose."""

    position: Vector
    orientation: Quaternion


class ForceAndTorque(NamedTuple):
    """geometry_msgs/Wrench."""

    force: Vector
    torque: Vector


class StampedPose(NamedTuple):
    """geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose


class StampedWrench(NamedTuple):
    """geometry_msgs/WrenchStamped."""

    header: Header
    wrench: ForceAndTorque


Read = Callable[[bytes], Any]


def read_pose(data: bytes) -> Any:
    """The PoseStamped in these bytes. Raises InvalidInput if there is none."""
    return _read(data, PoseStamped, 7, lambda header, v: StampedPose(header, Pose(Vector(*v[:3]), Quaternion(*v[3:]))))


def read_wrench(data: bytes) -> Any:
    """The WrenchStamped in these bytes. Raises InvalidInput if there is none."""
    return _read(data, WrenchStamped, 6,
                 lambda header, v: StampedWrench(header, ForceAndTorque(Vector(*v[:3]), Vector(*v[3:]))))  # fmt: skip


def _read(data: bytes, kind: type, count: int, made: Callable[[Header, tuple[float, ...]], Any]) -> Any:
    """What is made of the header and the numbers after it; the message by rclpy where the bytes are no plain CDR."""
    order = ORDERS.get(data[:2])
    if order is None:
        return _read_by_rclpy(data, kind)
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}iII", data, STAMP_AT)
        frame = str(data[FRAME_AT : FRAME_AT + max(length - 1, 0)], "utf-8")  # it ends with a zero
        numbers = struct.unpack_from(f"{order}{count}d", data, _aligned(length))
    except (struct.error, UnicodeDecodeError) as error:
        raise InvalidInput(f"its bytes are no message of this kind: {error}") from error
    return made(Header(Stamp(sec, nanosec), frame), numbers)


def _read_by_rclpy(data: bytes, kind: type) -> Any:
    """The message, for which rclpy takes its time. Raises InvalidInput if there is none."""
    try:
        return deserialize_message(data, kind)
    except Exception as error:  # of the middleware, whichever it is
        raise InvalidInput(f"its bytes are no message of this kind: they begin with '{data[:2].hex(' ')}', where plain "
                           "CDR has '00 00' or '00 01'") from error  # fmt: skip


def _aligned(length: int) -> int:
    """Place of the first double after a frame_id of so many bytes."""
    return START + -(-(FRAME_AT - START + length) // 8) * 8


class WrenchBytes:
    """A WrenchStamped that is sent over and over.

    Args:
        frame: its frame_id.
    """

    def __init__(self, frame: str) -> None:
        self._bytes = bytearray(serialize_message(wrench_message(np.zeros(6), frame, 0)))
        order = ORDERS[bytes(self._bytes[:2])]
        (length,) = struct.unpack_from(f"{order}I", self._bytes, FRAME_AT - 4)
        self._stamp, self._values, self._at = struct.Struct(f"{order}iI"), struct.Struct(f"{order}6d"), _aligned(length)

    def of(self, wrench: Wrench, stamp_ns: int) -> bytes:
        """The message of a wrench (6,) [N, N m] and a stamp [ns]."""
        self._stamp.pack_into(self._bytes, STAMP_AT, *divmod(stamp_ns, NANO))
        self._values.pack_into(self._bytes, self._at, *wrench.tolist())
        return bytes(self._bytes)
