"""Frames: where other frames than the body's stand, by a table or by tf2 where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.time import Time
from ruamel.yaml import YAML, YAMLError

from bags.messages import pose_from, stamp_ns, wrench_from
from stmpl_core.arrays import Transform
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_ros.conversions import wrench_message

ITSELF = np.eye(4)  # where the body's frame stands
SHAPE = "name: {position: [x, y, z], orientation: [x, y, z, w]}, in metres, both optional"


class Frames:
    """Brings poses and wrenches into the body's frame.

    Args:
        body: frame_id of the body.
        table: pose_body_from_frame of each frame that does not move, (4, 4).
        node: that listens to /tf for all others, if tf2_ros is installed.
    """

    def __init__(self, body: str, table: Mapping[str, Transform], node: Node | None = None) -> None:
        self.body, self.table, self._buffer = body, dict(table), None
        if node is not None and find_spec("tf2_ros"):
            from tf2_ros import Buffer, TransformListener  # pyright: ignore[reportMissingImports]

            self._buffer = Buffer()
            self._listener = TransformListener(self._buffer, node)

    def of(self, frame: str) -> Transform | None:
        """pose_body_from_frame, (4, 4), or None if nobody knows it."""
        if frame == self.body:
            return ITSELF
        if frame in self.table:
            return self.table[frame]
        if self._buffer is None or not frame or not self._buffer.can_transform(self.body, frame, Time()):
            return None
        moved: Any = self._buffer.lookup_transform(self.body, frame, Time()).transform
        message = PoseStamped().pose
        message.orientation = moved.rotation
        message.position.x, message.position.y, message.position.z = (
            moved.translation.x, moved.translation.y, moved.translation.z
        )  # fmt: skip
        return pose_from(message)

    def wrench(self, message: WrenchStamped, tool: str) -> WrenchStamped:
        """A tool's wrench, about its origin, in the body's axes; what is in the tool's or unknown ones stays."""
        frame = message.header.frame_id
        pose_body_from_frame = None if frame in (self.body, tool) else self.of(frame)
        if pose_body_from_frame is None:
            return message
        values = wrench_from(message, body_frame=self.body, tool=frame, pose_body_from_tool=pose_body_from_frame)
        return wrench_message(values, self.body, stamp_ns(message))


def read_frames(path: str) -> dict[str, Transform]:
    """The table of a YAML file; none if `path` is empty. Raises InvalidInput."""
    if not path:
        return {}
    try:
        read = YAML(typ="safe").load(Path(path).read_text()) or {}
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise InvalidInput(f"frames file {path}: {error}. It holds {SHAPE}.") from error
    if not isinstance(read, dict):
        raise InvalidInput(f"frames file {path} holds no table of frames. It holds {SHAPE}.")
    return {str(name): _placed(path, str(name), given) for name, given in read.items()}


def _placed(path: str, name: str, given: Any) -> Transform:
    try:
        if not isinstance(given, dict) or given.keys() - {"position", "orientation"}:
            raise ValueError(f"it is {given!r}")
        message = PoseStamped().pose
        p, q = message.position, message.orientation
        p.x, p.y, p.z = (float(value) for value in given.get("position", (0, 0, 0)))
        q.x, q.y, q.z, q.w = (float(value) for value in given.get("orientation", (0, 0, 0, 1)))
        pose = pose_from(message)
        if not np.isfinite(pose).all():
            raise ValueError("it is not finite")
        return pose
    except (ValueError, TypeError, AssertionError, StmplError) as error:
        raise InvalidInput(f"frame '{name}' of {path}: {error}. Expected {SHAPE}.") from error

