"""Show: the newest answer for people's eyes, at a display's rate and only while somebody looks."""

from __future__ import annotations

import struct
from array import array

import numpy as np
from geometry_msgs.msg import Point
from rclpy.lifecycle import LifecycleNode
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from bags.wire import NANO, header
from stmpl_core.layer import SoftLayer
from stmpl_core.posing import posed
from stmpl_core.trust import Displacement
from stmpl_ros.topics import SHOWN, managed

FIELDS = ("x", "y", "z", "displacement_mm", "pressure_kpa")
STAMP_AT = 4  # offset of the header's stamp, after the four bytes that say how the message is encoded
STOPS = np.array([[0.27, 0.0, 0.33], [0.13, 0.57, 0.55], [0.99, 0.91, 0.14]])  # colours from rest to peak


class Show:
    """Publisher of `skin/marker` and `skin/points`.

    Args:
        node: node that publishes.
        layer: layer at rest.
        frame: frame_id of the body.
        rate: rate of both topics [Hz].
    """

    def __init__(self, node: LifecycleNode, layer: SoftLayer, frame: str, rate: float) -> None:
        self._node, self._frame = node, frame
        self._marker = managed(node, Marker, "skin/marker", SHOWN)
        self._points = managed(node, PointCloud2, "skin/points", SHOWN)
        self._timer = node.create_timer(1 / rate, self._show)
        self.move_to(layer)

    def move_to(self, layer: SoftLayer) -> None:
        """Shows another layer from now on."""
        self._layer, self._made, self._newest = layer, None, None
        self._cloud = SkinCloud(layer, self._frame)

    def set_rate(self, rate: float) -> None:
        """Sets the rate of both topics [Hz], from now on."""
        self._timer.timer_period_ns = round(NANO / rate)
        self._timer.reset()  # or the last period ends first

    def put(self, answer: Displacement, stamp_ns: int, joints: tuple[float, ...] = ()) -> None:
        """Takes the newest answer, and the angles of the layer's joints [rad] that it was given at."""
        self._newest = answer, stamp_ns, joints

    def close(self) -> None:
        """Closes both topics."""
        self._node.destroy_timer(self._timer)
        for publisher in (self._marker, self._points):
            self._node.destroy_lifecycle_publisher(publisher)

    def _show(self) -> None:
        if self._newest is None or not self._marker.is_activated:
            return
        newest = answer, stamp, joints = self._newest
        looked_at = [publisher for publisher in (self._marker, self._points) if publisher.get_subscription_count()]
        here = posed(self._layer, joints).vertices if looked_at else None
        if self._points in looked_at:
            self._points.publish(self._cloud.frame(answer, stamp, here))
        if self._marker in looked_at:
            self._made = self._made or SkinMarker(self._layer, self._frame)
            self._marker.publish(self._made.frame(answer.displacement, stamp, here))
        if looked_at and self._newest is newest:  # a newer one may have come, on the thread of the fields
            self._newest = None


class SkinMarker:
    """A TRIANGLE_LIST whose bytes are made once; each frame overwrites stamp, points and colours.

    Building the message anew costs 78 ms for 8,000 vertices, patching it 0.4 ms.

    Args:
        layer: layer whose skin is shown.
        frame: frame_id of the body.
        scale: displacement that gets the brightest colour [m]; None: a third of the median thickness.
    """

    def __init__(self, layer: SoftLayer, frame: str, scale: float | None = None) -> None:
        self._corners = layer.faces.ravel()
        self._rest = layer.vertices
        self._scale = scale or float(np.median(layer.thickness)) / 3
        message = Marker(ns="skin", id=0, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
        message.header.frame_id = frame
        message.pose.orientation.w = message.scale.x = message.scale.y = message.scale.z = message.color.a = 1.0
        count, found = len(self._corners), (1.2345678901234e-5, 1.2345e-5)  # values to find the two blocks by
        message.points = [Point(x=found[0])] + [Point()] * (count - 1)
        message.colors = [ColorRGBA(r=found[1], a=1.0)] + [ColorRGBA(a=1.0)] * (count - 1)
        self._bytes = bytearray(serialize_message(message))
        points_at = self._bytes.index(struct.pack("<d", found[0]))
        colors_at = self._bytes.index(struct.pack("<f", found[1]), points_at + 24 * count)
        self._points = np.frombuffer(self._bytes, "<f8", 3 * count, points_at).reshape(-1, 3)
        self._colors = np.frombuffer(self._bytes, "<f4", 4 * count, colors_at).reshape(-1, 4)

    def frame(self, displacement: np.ndarray, stamp_ns: int, here: np.ndarray | None = None) -> bytes:
        """The serialised marker of the skin moved by `displacement` (V, 3) [m] from `here`, (V, 3) [m]; None: rest."""
        struct.pack_into("<iI", self._bytes, STAMP_AT, *divmod(stamp_ns, NANO))
        share = np.clip(np.linalg.norm(displacement, axis=1) / self._scale, 0, 1)
        colors = np.stack([np.interp(share, (0, 0.5, 1), STOPS[:, k]) for k in range(3)], axis=1)
        self._points[:] = ((self._rest if here is None else here) + displacement)[self._corners]
        self._colors[:, :3] = colors[self._corners]
        return bytes(self._bytes)


class SkinCloud:
    """Points of the moved skin: x y z [m], how far each moved [mm], the pressure on it [kPa]; all float32.

    The pressure is 0 where the method knows none.

    Args:
        layer: layer whose skin is shown.
        frame: frame_id of the body.
    """

    def __init__(self, layer: SoftLayer, frame: str) -> None:
        self._rest, self._frame = layer.vertices, frame
        self._values = np.zeros((len(layer.vertices), len(FIELDS)), np.float32)
        self._fields = [
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate(FIELDS)
        ]

    def frame(self, answer: Displacement, stamp_ns: int, here: np.ndarray | None = None) -> PointCloud2:
        """The cloud of an answer, its skin moved from `here`, (V, 3) [m]; None: rest."""
        values, step = self._values, self._values.strides[0]
        np.add(self._rest if here is None else here, answer.displacement, out=values[:, :3], casting="unsafe")
        values[:, 3] = 1e3 * answer.magnitude
        values[:, 4] = 0 if answer.pressure is None else 1e-3 * answer.pressure
        cloud = PointCloud2(header=header(self._frame, stamp_ns), height=1, width=len(values), fields=self._fields)
        cloud.point_step, cloud.row_step, cloud.is_dense = step, step * len(values), True
        cloud.data = array("B", values.tobytes())  # what a message takes over without looking at each byte
        return cloud
