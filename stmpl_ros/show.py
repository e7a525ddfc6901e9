"""Show: the newest answer for people's eyes, at a display's rate and only while somebody looks."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

from stmpl_core.layer import SoftLayer
from stmpl_core.trust import Displacement
from stmpl_ros.cloud import SkinCloud
from stmpl_ros.marker import SkinMarker
from stmpl_ros.topics import SHOWN, managed

NANO = 1_000_000_000


class Show:
    """`skin/marker` and `skin/points`.

    Args:
        node: that publishes.
        layer: at rest.
        frame: of the body.
        rate: of both [Hz].
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
        """Of both [Hz]."""
        self._timer.timer_period_ns = round(NANO / rate)

    def put(self, answer: Displacement, stamp_ns: int) -> None:
        """Takes the newest answer."""
        self._newest = answer, stamp_ns

    def close(self) -> None:
        """Closes both topics."""
        self._node.destroy_timer(self._timer)
        for publisher in (self._marker, self._points):
            self._node.destroy_lifecycle_publisher(publisher)

    def _show(self) -> None:
        if self._newest is None or not self._marker.is_activated:
            return
        answer, stamp = self._newest
        looked_at = [publisher for publisher in (self._marker, self._points) if publisher.get_subscription_count()]
        if self._points in looked_at:
            self._points.publish(self._cloud.frame(answer, stamp))
        if self._marker in looked_at:
            self._made = self._made or SkinMarker(self._layer, self._frame)
            self._marker.publish(self._made.frame(answer.displacement, stamp))
        if looked_at:
            self._newest = None
