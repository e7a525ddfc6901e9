"""SkinCloud: the deformed skin as a sensor_msgs/PointCloud2, coloured by displacement or pressure."""

from __future__ import annotations

from array import array

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from stmpl_core.layer import SoftLayer
from stmpl_core.trust import Displacement
from stmpl_ros.conversions import header

FIELDS = ("x", "y", "z", "displacement_mm", "pressure_kpa")


class SkinCloud:
    """Points of the moved skin: x y z [m], how far each moved [mm], the pressure on it [kPa]; all float32.

    The pressure is 0 where the method knows none.

    Args:
        layer: whose skin is shown.
        frame: frame_id of the body.
    """

    def __init__(self, layer: SoftLayer, frame: str) -> None:
        self._rest, self._frame = layer.vertices, frame
        self._values = np.zeros((len(layer.vertices), len(FIELDS)), np.float32)
        self._fields = [
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate(FIELDS)
        ]

    def frame(self, answer: Displacement, stamp_ns: int) -> PointCloud2:
        """The cloud of an answer."""
        values, step = self._values, self._values.strides[0]
        np.add(self._rest, answer.displacement, out=values[:, :3], casting="unsafe")
        values[:, 3] = 1e3 * answer.magnitude
        values[:, 4] = 0 if answer.pressure is None else 1e-3 * answer.pressure
        cloud = PointCloud2(header=header(self._frame, stamp_ns), height=1, width=len(values), fields=self._fields)
        cloud.point_step, cloud.row_step, cloud.is_dense = step, step * len(values), True
        cloud.data = array("B", values.tobytes())  # what a message takes over without looking at each byte
        return cloud
