"""Frames: where other frames than the body's stand, by a table or by tf2 where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose
from rclpy.clock_type import ClockType
from rclpy.time import Time

from bags.moving import FramesAt
from bags.wire import pose_from, rigid
from stmpl_core.arrays import Transform
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.text_file import text_of

FAR = 10.0  # distance of a frame from the body's origin beyond which it is taken to be in millimetres [m]
SHAPE = "name: {position: [x, y, z], orientation: [x, y, z, w]}, in metres, both optional"


class Frames:
    """Where other frames stand in the body's, now and lately.

    Args:
        body: frame_id of the body.
        table: frames that do not move, pose_body_from_frame (4, 4) by name.
        node: node that listens to /tf for all others, if tf2_ros is installed.

    Attributes:
        table: see above.
        listens: whether /tf is listened to.
    """

    def __init__(self, body: str, table: Mapping[str, Transform], node: Any = None) -> None:
        self.body, self.table, self._buffer = body, dict(table), None
        if node is not None and find_spec("tf2_ros"):
            from tf2_ros import Buffer, TransformListener  # pyright: ignore[reportMissingImports]

            self._buffer: Any = Buffer()
            self._listener = TransformListener(self._buffer, node)
        self.listens = self._buffer is not None

    def at(self, stamp: int) -> FramesAt:
        """Where the frames stand at a stamp [ns]; 0: where /tf had them last."""

        def look(frame: str) -> Transform:
            if not self.moves(frame):
                raise KeyError(frame)
            return pose_from(self.place(frame, stamp))

        return FramesAt(self.body, self.table, look)

    def forget(self) -> None:
        """Forgets where the frames of /tf moved; what /tf_static told once stays, as it is not told again."""
        if self.listens:
            self._buffer.clear()

    def moves(self, frame: str) -> bool:
        """Whether a frame is one of /tf."""
        return self.listens and bool(frame) and frame != self.body and frame not in self.table

    def missing(self, frame: str, stamp: int) -> str:
        """Why /tf does not say where a frame stood at a stamp [ns]; empty if it does."""
        known, why = self._buffer.can_transform(self.body, frame, _time(stamp), return_debug_tuple=True)
        return "" if known else (str(why) or "nothing was heard of it")

    def newest(self, frame: str) -> int | None:
        """Stamp of the newest place of a frame of /tf [ns]; 0: it never moves; None: not known."""
        from tf2_ros import TransformException  # pyright: ignore[reportMissingImports]

        try:
            return int(self._buffer.get_latest_common_time(self.body, frame).nanoseconds)
        except TransformException:
            return None

    def place(self, frame: str, stamp: int) -> Pose:
        """Where a frame of /tf stood in the body's at a stamp [ns]. Raises KeyError where it is not known."""
        from tf2_ros import TransformException  # pyright: ignore[reportMissingImports]

        try:
            moved = self._buffer.lookup_transform(self.body, frame, _time(stamp)).transform
        except TransformException as error:
            raise KeyError(frame) from error
        at = moved.translation
        return Pose(position=Point(x=at.x, y=at.y, z=at.z), orientation=moved.rotation)


def _time(stamp: int) -> Time:
    return Time(nanoseconds=stamp, clock_type=ClockType.ROS_TIME)


def read_frames(path: str, body: str = "") -> dict[str, Transform]:
    """The table of a YAML file of frames in the body's; none if `path` is empty. Raises InvalidInput."""
    if not path:
        return {}
    from ruamel.yaml import YAML, YAMLError

    try:
        read = YAML(typ="safe").load(text_of(path)) or {}
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError) as error:
        raise InvalidInput(f"frames file {path}: {error}. It holds {SHAPE}.") from error
    if not isinstance(read, dict):
        raise InvalidInput(f"frames file {path} holds no table of frames. It holds {SHAPE}.")
    if body in map(str, read):
        raise InvalidInput(f"frames file {path} places '{body}', which is the body's own frame. Leave it out.")
    return {str(name): _placed(path, str(name), given) for name, given in read.items()}


def _placed(path: str, name: str, given: Any) -> Transform:
    try:
        if not isinstance(given, dict) or given.keys() - {"position", "orientation"}:
            raise ValueError(f"it is {given!r}")
        place, turn = given.get("position", (0, 0, 0)), given.get("orientation", (0, 0, 0, 1))
        pose = rigid([float(v) for v in place], [float(v) for v in turn])
        if not np.isfinite(pose).all():
            raise ValueError("it is not finite")
        far = float(np.abs(pose[:3, 3]).max())
        if far > FAR:
            raise ValueError(f"it is {far:.1f} m from the body's origin; at most {FAR:g} m is accepted. "
                             "Is its position in millimetres? Scale it by 1e-3")  # fmt: skip
        return pose
    except (ValueError, TypeError, StmplError) as error:
        raise InvalidInput(f"frame '{name}' of {path}: {error}. Expected {SHAPE}.") from error
