"""Frames: where other frames than the body's stand, by a table or by tf2 where it is installed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from bags.wire import pose_from
from stmpl_core.arrays import Transform
from stmpl_core.errors import InvalidInput, StmplError

SHAPE = "name: {position: [x, y, z], orientation: [x, y, z, w]}, in metres, both optional"


class Frames(Mapping[str, Transform]):
    """pose_body_from_frame, (4, 4), by the name of the frame.

    Args:
        body: frame_id of the body.
        table: frames that do not move.
        node: node that listens to /tf for all others, if tf2_ros is installed.
    """

    def __init__(self, body: str, table: Mapping[str, Transform], node: Any = None) -> None:
        self.body, self.table, self._buffer = body, dict(table), None
        if node is not None and find_spec("tf2_ros"):
            from tf2_ros import Buffer, TransformListener  # pyright: ignore[reportMissingImports]

            self._buffer = Buffer()
            self._listener = TransformListener(self._buffer, node)

    def __getitem__(self, frame: str) -> Transform:
        if frame == self.body:
            return np.eye(4)
        if frame in self.table or self._buffer is None:
            return self.table[frame]
        from rclpy.time import Time

        if not frame or not self._buffer.can_transform(self.body, frame, Time()):
            raise KeyError(frame)
        moved: Any = self._buffer.lookup_transform(self.body, frame, Time()).transform
        return pose_from(SimpleNamespace(position=moved.translation, orientation=moved.rotation))

    def __iter__(self) -> Iterator[str]:
        return iter(self.table)

    def __len__(self) -> int:
        return len(self.table)


def read_frames(path: str) -> dict[str, Transform]:
    """The table of a YAML file; none if `path` is empty. Raises InvalidInput."""
    if not path:
        return {}
    from ruamel.yaml import YAML, YAMLError

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
        position = dict(zip("xyz", (float(v) for v in given.get("position", (0, 0, 0))), strict=True))
        orientation = dict(zip("xyzw", (float(v) for v in given.get("orientation", (0, 0, 0, 1))), strict=True))
        pose = pose_from(
            SimpleNamespace(position=SimpleNamespace(**position), orientation=SimpleNamespace(**orientation))
        )
        if not np.isfinite(pose).all():
            raise ValueError("it is not finite")
        return pose
    except (ValueError, TypeError, StmplError) as error:
        raise InvalidInput(f"frame '{name}' of {path}: {error}. Expected {SHAPE}.") from error
