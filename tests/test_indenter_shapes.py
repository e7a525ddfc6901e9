"""The tools that robots press with, to 70 % of a real arm: sound, growing, no face in the tool by over 1 %."""

import numpy as np
import pytest
import trimesh

from fem_tools.indenter import IndenterFem, Tool
from fem_tools.patch import PatchFem
from stmpl_core.body import Body
from stmpl_core.sdf import SignedDistance
from tests.test_indenter import tool_mesh

THICKNESS = 7.5e-3


def filleted_punch(radius: float = 12.0, fillet: float = 3.0) -> trimesh.Trimesh:
    """A flat-ended cylinder that stands on z = 0 [mm]."""
    angle = np.linspace(0, np.pi / 2, 8)
    rim = np.stack([radius - fillet + fillet * np.sin(angle), fillet - fillet * np.cos(angle)], axis=1)
    return trimesh.creation.revolve(np.vstack([[[0, 0]], rim, [[radius, 12], [0, 12]]]), sections=48)


def lying_capsule() -> trimesh.Trimesh:
    """A fingertip on its side [mm]."""
    mesh = trimesh.creation.capsule(height=14, radius=8, count=[24, 24])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    return mesh


TOOLS = {
    "ball": (lambda: trimesh.creation.icosphere(subdivisions=4, radius=12.0), 0.0),
    "punch": (filleted_punch, 0.0),
    "fingertip": (lying_capsule, 0.0),
}


@pytest.fixture(scope="module")
def arm():
    return Body.anny().part("left_arm", edge_length=4e-3, thickness=THICKNESS)


@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_goes_down_to_70_percent_of_the_arm(arm, name):
    make, rounding = TOOLS[name]
    field = SignedDistance.of(tool_mesh(make()), rounding=rounding)
    away = np.linalg.norm(arm.vertices[:, None] - arm.vertices[arm.border][None, ::3], axis=2).min(axis=1)
    inside = np.flatnonzero(away > 0.07)
    vertex = inside[len(inside) // 3]
    outwards = arm.normals[vertex]
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.svd(outwards[None])[2][[1, 2, 0]].T
    pose[:3, 2] *= np.sign(pose[:3, 2] @ outwards)
    pose[:3, 0] *= np.sign(np.linalg.det(pose[:3, :3]))
    pose[:3, 3] = arm.vertices[vertex] + 0.03 * outwards
    solver = IndenterFem(PatchFem(refine=3, reach=3), step=0.1).prepare(arm)
    answers = list(solver.path([Tool(field, pose, -outwards)], np.array([0.3, 0.7]) * THICKNESS))
    assert len(answers) == 2
    for answer in answers:
        assert answer.trust.ok, answer.trust.why
        assert answer.trust.figures["faces_entered_m"] <= 0.01 * THICKNESS
    assert answers[1].force > 2 * answers[0].force > 0
