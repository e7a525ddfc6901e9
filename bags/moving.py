"""Moving frames: where frames stood at a stamp, by a table and by a recorded /tf, which is read as tf2 reads it."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from math import acos, isnan, sin, sqrt
from typing import Any

import numpy as np

from bags.wire import NANO, FixedFrames, rigid, stamp_ns
from stmpl_core.arrays import Transform
from stmpl_core.errors import FrameError

TF, TF_STATIC = "/tf", "/tf_static"

Quaternion = tuple[float, float, float, float]  # x y z w
Vector = tuple[float, float, float]
BACK = NANO // 2  # way back of a frame's stamps by which the clock was set back, not one of them late [ns]
UNIT = 10e-3  # error of a quaternion's squared length that tf2 takes
ALWAYS = 2**63 - 1  # when everything was received [ns]

Placed = tuple[Quaternion, Vector]  # turn, and place of the origin [m]


class FramesAt(Mapping[str, Transform]):
    """pose_body_from_frame, (4, 4), by the name of the frame, at one stamp.

    Args:
        body: frame_id of the body.
        table: frames that do not move.
        look: function that tells where any other frame stands; it raises KeyError, or FrameError with a reason.
    """

    def __init__(self, body: str, table: FixedFrames, look: Callable[[str], Transform]) -> None:
        self._body, self._table, self._look = body, table, look

    def __getitem__(self, frame: str) -> Transform:
        if frame == self._body:
            return np.eye(4)
        return self._table[frame] if frame in self._table else self._look(frame)

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)


class MovingFrames:
    """All that a recording holds of /tf and /tf_static.

    Where a frame's stamps go back by more than BACK the clock was set back, and a node forgets what moved before.
    """

    def __init__(self) -> None:
        self._tracks: dict[str, list[_Track]] = {}  # of each frame, in the order in which it was still or moved

    def hear(self, message: Any, *, still: bool, received: int = 0) -> None:
        """Takes a tf2_msgs/TFMessage; still: it came on /tf_static; received: when [ns]."""
        for told in filter(_sound, message.transforms):
            child = told.child_frame_id.removeprefix("/")
            tracks = self._tracks.setdefault(child, [])
            back = bool(tracks) and not still and stamp_ns(told) < tracks[-1].last - BACK
            if not tracks or tracks[-1].still != still or back:  # in tf2, too, it goes over to how it was told last
                tracks.append(_Track(child, still, received))
            tracks[-1].put(told)

    def place(self, body: str, frame: str, stamp: int, by: int = ALWAYS) -> Transform:
        """pose_body_from_frame (4, 4) at a stamp [ns], between the two that were told around it.

        Where the clock was set back it is as a node knew it at the time `by` [ns], at which things were received.

        Raises:
            FrameError: /tf does not cover the stamp, or does not join the two frames.
        """
        (inner, why), (outer, other) = self._up(frame, body, stamp, by), self._up(body, frame, stamp, by)
        if body in inner:
            turn, at = inner[body]
        elif frame in outer:
            turn, at = _inverse(outer[frame])
        elif (top := next(reversed(inner))) in outer:
            turn, at = _joined(_inverse(outer[top]), inner[top])
        else:
            reason = why or other or f"nothing joins it to '{body}'"
            raise FrameError(f"/tf does not say where '{frame}' was at {stamp / NANO:.3f} s: {reason}")
        return rigid(at, turn)

    def _up(self, frame: str, until: str, stamp: int, by: int) -> tuple[dict[str, Placed], str]:
        """Where a frame stands in itself and in those that it hangs on, up to the last that is known, and why not."""
        found: dict[str, Placed] = {frame: ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))}
        while frame != until and (tracks := self._tracks.get(frame)) is not None:
            track = _of(tracks, stamp, by)
            told = track.at(stamp)
            if told is None:
                return found, track.span
            parent, placed = told
            if parent in found:
                return found, f"'{parent}' hangs on itself"
            found[parent], frame = _joined(placed, found[frame]), parent
        return found, ""


def _sound(told: Any) -> bool:
    """Whether tf2 takes a TransformStamped: no number is NaN, and its quaternion has length 1."""
    p, q = told.transform.translation, told.transform.rotation
    length = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w  # squared, as in tf2::BufferCore::setTransformImpl
    return not any(map(isnan, (p.x, p.y, p.z))) and abs(length - 1) < UNIT


def _of(tracks: list[_Track], stamp: int, by: int) -> _Track:
    """The one that holds at a stamp [ns]: a frame is still until its first stamp on /tf, or after its last.

    Of those that began until `by` [ns], and since the clock was set back, which is between two that move.
    """
    tracks = [track for track in tracks if track.began <= by] or tracks[:1]
    for before, track in zip(tracks[-2::-1], tracks[:0:-1], strict=True):
        if stamp > before.last if track.still else stamp >= track.first or not before.still:
            return track
    return tracks[0]


class _Track:
    """Where one frame was told to stand in its parent, by the stamp; one that is still, the last time."""

    def __init__(self, child: str, still: bool, began: int) -> None:
        self._child, self.still, self.began = child, still, began
        self._stamps, self._numbers, self._parents = array("q"), array("d"), list[str]()

    def put(self, told: Any) -> None:
        """Takes a geometry_msgs/TransformStamped; one of a stamp that was told already counts for nothing."""
        p, q = told.transform.translation, told.transform.rotation
        stamp, parent = stamp_ns(told), told.header.frame_id.removeprefix("/")
        if self.still:
            del self._stamps[:], self._numbers[:], self._parents[:]
        n = bisect_left(self._stamps, stamp)
        if n == len(self._stamps) or self._stamps[n] != stamp:
            self._stamps.insert(n, stamp)
            self._numbers[7 * n : 7 * n] = array("d", (q.x, q.y, q.z, q.w, p.x, p.y, p.z))
            same = self._parents[-1] if self._parents and self._parents[-1] == parent else parent
            self._parents.insert(n, same)

    def at(self, stamp: int) -> tuple[str, Placed] | None:
        """Its parent, and where it stood there at a stamp [ns]; None: it was not told."""
        if self.still:
            return self._parents[0], self._told(0)
        n = bisect_left(self._stamps, stamp)
        if n < len(self._stamps) and self._stamps[n] == stamp:
            return self._parents[n], self._told(n)
        if not 0 < n < len(self._stamps):
            return None
        before, after = self._stamps[n - 1], self._stamps[n]
        one = self._told(n - 1)
        if self._parents[n] != self._parents[n - 1]:
            return self._parents[n - 1], one
        return self._parents[n - 1], _between(one, self._told(n), (stamp - before) / (after - before))

    def _told(self, n: int) -> Placed:
        x, y, z, w, *place = self._numbers[7 * n : 7 * n + 7]
        return (x, y, z, w), (place[0], place[1], place[2])

    @property
    def first(self) -> int:
        """Its first stamp [ns]."""
        return self._stamps[0]

    @property
    def last(self) -> int:
        """Its last stamp [ns]."""
        return self._stamps[-1]

    @property
    def span(self) -> str:
        """When it was told."""
        return f"'{self._child}' was told from {self._stamps[0] / NANO:.3f} to {self._stamps[-1] / NANO:.3f} s"


def _between(one: Placed, two: Placed, share: float) -> Placed:
    """On a straight line and the shortest turn, a share of the way."""
    (q, a), (p, b) = one, two
    dot = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + q[3] * p[3]
    size = sqrt(sum(x * x for x in q) * sum(x * x for x in p))
    angle, back = acos(min(abs(dot) / size, 1.0)), -1.0 if dot < 0 else 1.0
    if angle:
        first, second = sin((1 - share) * angle) / sin(angle), back * sin(share * angle) / sin(angle)
        q = (q[0] * first + p[0] * second, q[1] * first + p[1] * second, q[2] * first + p[2] * second,
             q[3] * first + p[3] * second)  # fmt: skip
    rest = 1 - share
    return q, (rest * a[0] + share * b[0], rest * a[1] + share * b[1], rest * a[2] + share * b[2])


def _joined(outer: Placed, inner: Placed) -> Placed:
    """Where a thing stands that stands so in a frame which stands so."""
    (turn, place), (turned, at) = outer, inner
    x, y, z = _turned(turn, at)
    return _product(turn, turned), (x + place[0], y + place[1], z + place[2])


def _inverse(one: Placed) -> Placed:
    (x, y, z, w), place = one
    back = (-x, -y, -z, w)
    a, b, c = _turned(back, place)
    return back, (-a, -b, -c)


def _turned(turn: Quaternion, v: Vector) -> Vector:
    x, y, z, w = turn
    a, b, c, _ = _product(_product(turn, (*v, 0.0)), (-x, -y, -z, w))
    return a, b, c


def _product(q: Quaternion, p: Quaternion) -> Quaternion:
    (a, b, c, d), (x, y, z, w) = q, p
    return (d * x + a * w + b * z - c * y, d * y + b * w + c * x - a * z, d * z + c * w + a * y - b * x,
            d * w - a * x - b * y - c * z)  # fmt: skip
