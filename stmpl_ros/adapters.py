"""Adapters: messages of other packages as those that the node understands."""

from __future__ import annotations

import numpy as np
from shape_msgs.msg import Mesh
from stmpl_msgs.msg import ContactMesh

from stmpl_ros.conversions import floats, header, integers


def contact_mesh_of(message: Mesh, tool: str, stamp_ns: int) -> ContactMesh:
    """The surface of a tool from a shape_msgs/Mesh, in metres and in the tool's own frame."""
    vertices = np.array([(p.x, p.y, p.z) for p in message.vertices]).reshape(-1, 3)
    triangles = np.array([list(t.vertex_indices) for t in message.triangles]).reshape(-1, 3)
    return ContactMesh(header=header(tool, stamp_ns), vertices=floats(vertices), triangles=integers(triangles))
