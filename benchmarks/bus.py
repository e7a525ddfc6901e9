"""A bus of its own for a benchmark."""

from __future__ import annotations

import os
import socket

from stmpl_ros.domain import claim
from stmpl_ros.spinning import TRANSPORTS, UDP


def take_own(shared: bool) -> socket.socket:
    """Has this process and its children talk among themselves; to be called before rclpy.init.

    Args:
        shared: whether by shared memory, as rmw_fastrtps does on one machine alone, or by UDP, as the verbs do.

    Returns: what holds the bus, as `claim` gives it.
    """
    domain, held = claim()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST" if shared else "SUBNET"
    if not shared:
        os.environ[TRANSPORTS] = UDP
    return held
