"""How deep tools go: to 70 % of a real arm, to a mean pressure of 5 E, and what keeps skin out of them."""

import numpy as np
import pytest
import trimesh

from benchmarks.indenters import FinerFem, Scene, errors
from benchmarks.tools import ball, flat
from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from fem_tools.tool_contact import PressLoad
from stmpl_core.body import Body
from stmpl_core.sdf import SignedDistance
from tests.scenes import THICKNESS, tool


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
    field = SignedDistance.of(tool(make(), 1e-3), rounding=rounding)
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
    answers = list(solver.path([Press(field, pose, -outwards)], np.array([0.3, 0.7]) * THICKNESS))
    assert len(answers) == 2
    for answer in answers:
        assert answer.trust.ok, answer.trust.why
        assert answer.trust.figures["faces_entered_m"] <= 0.01 * THICKNESS
    assert answers[1].force > 2 * answers[0].force > 0


@pytest.mark.slow
def test_a_flat_tool_carries_a_mean_pressure_of_5_times_the_modulus():
    scene = Scene("flat", lambda: flat(12, 5), edge=3.5e-3, rim=2.5)
    layer, tool = scene.built()
    solver = scene.solver(step=0.08).prepare(layer)
    answers = list(solver.path([tool], np.array([0.5, 0.7, 0.87]) * scene.thickness))
    assert len(answers) == 3
    for answer in answers:
        assert answer.trust.ok, answer.trust.why
        assert answer.trust.figures["min_j"] > 0.1
        assert answer.trust.figures["faces_entered_m"] <= 0.01 * scene.thickness
    assert answers[0].force < answers[1].force < answers[2].force
    assert answers[2].trust.figures["mean_pressure_over_modulus"] > 5


def test_the_stated_bound_covers_what_a_finer_mesh_changes():
    scene = Scene("ball", lambda: ball(6), thickness=4e-3)
    ours, finer = PatchFem(refine=3, reach=3), FinerFem(refine=4, layers=2, reach=4, check_stability=False)
    for error, bound, peak, _ in errors(
        scene, IndenterFem(ours, step=0.1), IndenterFem(finer, step=0.1), np.array([0.3, 0.5])
    ):
        assert 0.002 * peak < error < bound < 5 * error


def test_contact_pressure_is_minus_the_slope_of_its_energy_and_stiffness_that_of_the_pressure():
    field = SignedDistance.of(tool(trimesh.creation.icosphere(subdivisions=2, radius=5.0), 1e-3))
    n, nothing = 9, np.zeros((9, 3))
    load = PressLoad(
        Press(field, np.eye(4), np.array([0, 0, 1.0])), np.ones(n), np.arange(n), np.arange(n), (1e6, 0.0),
        np.full(n, 5.0), nothing * np.nan, np.full(n, np.inf),
    )  # fmt: skip
    gap, by = np.linspace(-20e-6, 22e-6, n), 1e-9
    below, here, above = (load.pressed(gap + shift) for shift in (-by, 0.0, by))
    np.testing.assert_allclose(here[1], (below[0] - above[0]) / (2 * by), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(here[2], (below[1] - above[1]) / (2 * by), rtol=1e-5, atol=1e-3)
    assert here[1][0] > 0 and here[1][-1] == 0
