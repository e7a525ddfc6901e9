"""Finite: a ball pressed into a flat plate of skin, fat and muscle, by finite elements."""

from __future__ import annotations

import numpy as np
import trimesh

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core.errors import StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from studies.critical_load import flat_skin

REACH = 2.0  # width of the patch beyond the ball [thicknesses]
CHEAP = PatchFem(element="P1xP2", reach=REACH, refine=2, layers=1, check_stability=False)


def ball_force(tissue: Tissue, thickness: float, radius: float, depth: float, fem: PatchFem = CHEAP) -> float:
    """Force that holds a sticking ball at a depth in a plate on a rigid base [N].

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness of the plate [m].
        radius: radius of the ball [m].
        depth: depth of its lowest point below the skin at rest [m].
        fem: solver of the patch around the ball.

    Raises:
        StmplError: a press that stopped on the way.
    """
    vertices, faces = flat_skin((REACH + 0.6) * thickness + radius, max(thickness / 3, radius / 6))
    layer = SoftLayer(vertices, faces, thickness, tissue=tissue)
    mesh, pose = trimesh.creation.icosphere(subdivisions=4, radius=radius), np.eye(4)
    ball = Tool("ball", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    pose[2, 3] = radius + 1e-3
    tool = Press(SignedDistance.of(ball), pose, np.array([0.0, 0.0, -1.0]))
    answer = IndenterFem(fem, step=0.1).prepare(layer).press([tool], depth)
    if not answer.trust.converged:
        raise StmplError(f"a ball of {radius * 1e3:g} mm stopped at {answer.depth * 1e3:.1f} mm: {answer.trust.why}")
    return answer.force
