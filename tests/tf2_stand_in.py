"""A stand-in for tf2_ros, which is on no package registry: what the node asks of it, as tf2 answers.

Where tf2_ros is installed the tests take that instead.
"""

from collections import defaultdict
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.time import Time
from scipy.spatial.transform import Rotation, Slerp

from bags.wire import NANO, header, pose_message, stamp_ns

KEEPS = 10 * NANO  # time that is remembered [ns]


class TransformException(Exception):
    """No such transform."""


class TransformListener:
    """Would listen to /tf; here tests tell the buffer themselves."""

    def __init__(self, buffer: Any, node: Any) -> None:
        pass


class Buffer:
    """Places of frames in their parents, over time."""

    def __init__(self) -> None:
        self._told: dict[str, list[tuple[int, np.ndarray]]] = defaultdict(list)
        self._parents: dict[str, str] = {}
        self._static: set[str] = set()

    def clear(self) -> None:
        """Forgets what moves; a static transform stays, as in tf2's StaticCache."""
        self._told = defaultdict(list, {f: told for f, told in self._told.items() if f in self._static})

    def set_transform(self, told: TransformStamped, authority: str) -> None:
        self._keep(told, moves=True)

    def set_transform_static(self, told: TransformStamped, authority: str) -> None:
        self._keep(told, moves=False)

    def _keep(self, told: TransformStamped, moves: bool) -> None:
        t, q = told.transform.translation, told.transform.rotation
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), (t.x, t.y, t.z)
        stamp, child = stamp_ns(told), told.child_frame_id
        self._parents[child] = told.header.frame_id
        if not moves:
            self._static.add(child)
            self._told[child] = [(stamp, place)]
            return
        self._told[child] = [(s, p) for s, p in self._told[child] if stamp - s < KEEPS and s != stamp]
        self._told[child] = sorted([*self._told[child], (stamp, place)], key=lambda one: one[0])

    def get_latest_common_time(self, target: str, source: str) -> Time:
        both = {*self._chain(target), *self._chain(source)}
        moving = [frame for frame in both & set(self._parents) if frame not in self._static]
        common = set(self._chain(target)) & set(self._chain(source))
        if not common:
            raise TransformException(f"'{source}' and '{target}' are not connected")
        way = [f for f in moving if f not in common]
        if not all(self._told[f] for f in way):
            raise TransformException(f"'{source}' was not told of since the buffer was cleared")
        return Time(nanoseconds=min((self._told[f][-1][0] for f in way), default=0))

    def can_transform(self, target: str, source: str, time: Time, timeout: Duration | None = None,
                      return_debug_tuple: bool = False) -> Any:  # fmt: skip
        try:
            self.lookup_transform(target, source, time)
        except TransformException as error:
            return (False, str(error)) if return_debug_tuple else False
        return (True, "") if return_debug_tuple else True

    def lookup_transform(self, target: str, source: str, time: Time) -> TransformStamped:
        stamp = time.nanoseconds or self.get_latest_common_time(target, source).nanoseconds
        if not set(self._chain(target)) & set(self._chain(source)):
            raise TransformException(f"'{source}' and '{target}' are not connected")
        found = np.linalg.inv(self._in_root(target, stamp)) @ self._in_root(source, stamp)
        pose = pose_message(found, target, stamp).pose
        out = TransformStamped(header=header(target, stamp), child_frame_id=source)
        out.transform.translation.x, out.transform.translation.y = pose.position.x, pose.position.y
        out.transform.translation.z, out.transform.rotation = pose.position.z, pose.orientation
        return out

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
        return chain

    def _in_root(self, frame: str, stamp: int) -> np.ndarray:
        place = np.eye(4)
        for one in self._chain(frame)[:-1]:
            place = self._at(one, stamp) @ place
        return place

    def _at(self, frame: str, stamp: int) -> np.ndarray:
        if not self._told[frame]:
            raise TransformException(f"nothing is known of '{frame}' since the buffer was cleared")
        times, places = zip(*self._told[frame], strict=True)
        if frame in self._static:
            return places[0]
        if not times[0] <= stamp <= times[-1]:
            raise TransformException(f"Lookup would require extrapolation. Requested time {stamp / NANO:.3f} but the "
                                     f"data of '{frame}' are from {times[0] / NANO:.3f} to {times[-1] / NANO:.3f}")
        place = np.eye(4)
        at = np.array([place[:3, 3] for place in places])
        since = (np.array(times) - times[0]).astype(float)
        place[:3, 3] = [np.interp(stamp - times[0], since, axis) for axis in at.T]
        turns = Rotation.from_matrix([place[:3, :3] for place in places])
        place[:3, :3] = (Slerp(since, turns)(stamp - times[0]) if len(times) > 1 else turns[0]).as_matrix()
        return place
