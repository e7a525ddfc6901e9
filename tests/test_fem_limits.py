"""Limits of the finite-element truth: incompressibility, stability, its own error bound, and the paper's own path."""

import numpy as np
import pytest

from fem_tools import PatchFem
from fem_tools.skin_loads import FollowerPressure
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.tissue import Tissue
from studies.critical_load import closed_form, critical_loads, draw, least_stiffness
from studies.tets import TetFem, TetMesh, TetSystem, split_wedges
from tests.scenes import THICKNESS, bump, disc, limb, plate, wavy_layer


def peak_of_the_mixed_method(half: float, tissue: Tissue, peak: float, radius: float, n: int = 4) -> float:
    """Largest displacement [m] by felupe's u-p-J hexahedra (Simo, Taylor & Pister 1985), a quarter of the slab."""
    fem = pytest.importorskip("felupe", reason="FElupe is under the GPL: pip install stmpl[peers]")

    mesh = fem.Cube(a=(0, 0, -THICKNESS), b=(half, half, 0), n=(n + 1, n + 1, 3))
    mesh = mesh.add_midpoints_edges().add_midpoints_faces().add_midpoints_volumes()
    field = fem.FieldsMixed(fem.RegionTriQuadraticHexahedron(mesh), n=3)
    points = mesh.points
    on_skin = points[:, 2] > -1e-9
    skin = fem.RegionTriQuadraticHexahedronBoundary(mesh, only_surface=True, mask=on_skin)
    skin_field = fem.FieldContainer([fem.Field(skin, dim=3)])
    at = np.moveaxis(fem.Field(skin, dim=3, values=points).interpolate(), 0, -1)
    pressure = bump(at.reshape(-1, 3), peak, radius).reshape(at.shape[:2])
    bounds = {
        "held": fem.Boundary(field[0], mask=(points[:, 2] < 1e-9 - THICKNESS) | (points[:, :2].max(1) > half - 1e-9)),
        "x": fem.Boundary(field[0], mask=points[:, 0] < 1e-9, skip=(0, 1, 1)),
        "y": fem.Boundary(field[0], mask=points[:, 1] < 1e-9, skip=(1, 0, 1)),
    }
    dof0, dof1 = fem.dof.partition(field, bounds)
    material = fem.ThreeFieldVariation(fem.NeoHookeCompressible(tissue.shear_modulus, tissue.lame_lambda))
    pressing = fem.SolidBodyPressure(skin_field, pressure=pressure)
    fem.newtonraphson(items=[fem.SolidBody(material, field), pressing], x0=field, dof0=dof0, dof1=dof1, verbose=0)
    return float(np.linalg.norm(field[0].values[on_skin], axis=1).max())


def test_nearly_incompressible_tissue_is_within_3_percent_of_a_mixed_method():
    """nu = 0.499: two wedges deep against u-p-J, and the default, one deep, against those; linear in plane locks."""
    half, radius, tissue = 0.0225, 0.015, Tissue(poisson_ratio=0.499)
    layer = plate(2 * half, half / 6, crossed=True, poisson_ratio=tissue.poisson_ratio)
    load = Load.pressure(bump(layer.vertices, 400.0, radius))
    default, deep, linear = (
        PatchFem(**options, reach=9, check_stability=False).prepare(layer).solve(load)
        for options in ({}, {"layers": 2}, {"element": "P1xP2"})
    )
    assert default.trust.converged and deep.trust.converged
    assert deep.magnitude.max() == pytest.approx(peak_of_the_mixed_method(half, tissue, 400.0, radius), rel=0.03)
    assert default.magnitude.max() == pytest.approx(deep.magnitude.max(), rel=0.03)
    assert linear.magnitude.max() < 0.67 * deep.magnitude.max()


@pytest.mark.parametrize(("ratio", "edge", "reach"), [(0.2, 5e-3, 3.0), (0.8, 4e-3, 4.0), (1.2, 6e-3, 6.0)])
def test_the_stated_bound_covers_the_error(ratio, edge, reach):
    layer = limb(4e-3)
    load = disc(layer, ratio, layer.vertices[len(layer.vertices) // 2], 0.008, edge)
    answer = PatchFem(reach=reach).prepare(layer).solve(load)
    finer = PatchFem(element="P2xP2", layers=2, reach=reach, check_stability=False).prepare(layer).solve(load)
    wider = PatchFem(reach=8, check_stability=False).prepare(layer).solve(load)
    off = (answer.displacement - finer.displacement) + (answer.displacement - wider.displacement)
    error = float(np.linalg.norm(off, axis=1).max())
    assert answer.trust.ok and answer.trust.error_bound is not None
    assert error < answer.trust.error_bound < 5 * error


def outlines(points: np.ndarray, radius: float) -> dict[str, np.ndarray]:
    """Masks of points of a plane, (N, 2) [m], that lie in a shape of this radius [m]."""
    (x, y), away = points.T, np.linalg.norm(points, axis=1)
    return {
        "disc": away < radius,
        "ring": (away < 1.3 * radius) & (away > 0.7 * radius),
        "square": np.abs(points).max(axis=1) < radius,
        "star": away < radius * (1 + 0.5 * np.cos(5 * np.arctan2(y, x))),
        "T": ((np.abs(y - 1.2 * radius) < 0.4 * radius) & (np.abs(x) < 1.3 * radius))
        | ((np.abs(x) < 0.4 * radius) & (np.abs(y) < 1.5 * radius)),
    }


@pytest.mark.parametrize(("edge", "thickness", "radius", "ratio"),
                         [(4e-3, 5e-3, 8e-3, 0.15), (4e-3, 5e-3, 11e-3, 1.2), (3.5e-3, 10e-3, 8e-3, 0.15)])  # fmt: skip
def test_the_stated_bound_covers_hard_edges(edge, thickness, radius, ratio):
    layer = limb(edge, thickness)
    answers = PatchFem(check_stability=False).prepare(layer)
    truths = PatchFem(refine=2, layers=2, check_stability=False).prepare(layer)
    middle = layer.vertices[len(layer.vertices) // 2]
    side = middle * [1, 1, 0] / np.linalg.norm(middle[:2])
    facing = layer.normals @ side > 0.2
    plane = (layer.vertices - middle) @ np.column_stack([np.cross([0, 0, 1], side), [0, 0, 1]])
    over = []
    for shape in outlines(plane, radius).values():
        load = Load.pressure(ratio * layer.tissue.youngs_modulus * (shape & facing))
        answer, truth = answers.solve(load), truths.solve(load)
        error = float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max())
        assert answer.trust.ok and answer.trust.error_bound is not None
        over.append(answer.trust.error_bound / error)
    assert min(over) > 1 and np.median(over) < 4, over


def test_dead_loads_lose_stability_at_065_e_at_waves_up_to_one_thickness():
    least = min(closed_form(wave) for wave in (0.4, 0.7, 1.0))
    assert least == pytest.approx(0.651, abs=0.003)
    assert closed_form(2.0) > 1.2 * least


@pytest.mark.parametrize("nu", [0.3, 0.4, 0.45])
def test_a_follower_pressure_loses_no_stability(nu):
    assert all(least_stiffness(p, wave, nu, "follower") > 0 for p in (0.5, 2.0, 10.0, 40.0) for wave in (0.4, 1.0, 4.0))


def test_coarse_linear_tets_hide_the_instability_that_quadratic_wedges_show(tmp_path):
    rows = list(critical_loads(edges=(5e-3,), elements=("P2xP2", "P1 tets"), scenes=("plate",), largest=1.0))
    found = {(row.element, row.load): row for row in rows}
    assert found["P2xP2", "dead"].ended == "unstable" and 0.64 < found["P2xP2", "dead"].ratio < 0.78
    assert found["P1 tets", "dead"].ended == "held"
    assert found["P2xP2", "follower"].ended == "held"
    assert draw(rows, tmp_path / "critical.png").read_bytes().startswith(b"\x89PNG")


def wavy_tets(layers: int = 2) -> TetMesh:
    layer = wavy_layer()
    return split_wedges(layer.vertices, layer.inner_vertices, layer.faces.astype(np.int64), layers)


def test_split_wedges_conform_and_fill_the_layer():
    mesh, flat = wavy_tets(), plate(0.012, 3e-3, crossed=True)
    assert len(mesh.boundary_faces()) == 2 * len(mesh.triangles) + 2 * 2 * 20  # skin, core, and 20 rim quads a layer
    filled = split_wedges(flat.vertices, flat.inner_vertices, flat.faces.astype(np.int64), 3)
    assert filled.volumes.sum() == pytest.approx(0.012**2 * THICKNESS)


def test_tets_pass_the_patch_test_and_their_tangent_is_the_derivative():
    mesh, tissue = wavy_tets(), Tissue()
    none = np.zeros(mesh.n_columns, dtype=bool)
    pressure = np.full(36, 300.0)
    system = TetSystem(mesh, tissue, [FollowerPressure(mesh, pressure)], none)  # pyright: ignore
    F = np.array([[1.05, 0.1, 0.02], [0.0, 0.95, 0.05], [-0.03, 0.02, 0.9]])
    u = system.rest @ (F - np.eye(3)).T
    forces, smallest = system.internal(u)
    inside = np.ones(mesh.n_columns, dtype=bool)
    inside[np.unique(mesh.boundary_faces())] = False
    assert smallest == pytest.approx(np.linalg.det(F)) and inside.any()
    assert np.abs(forces[inside]).max() < 1e-12 * np.abs(forces).max()
    rng, eps = np.random.default_rng(0), 1e-7
    u = u + rng.normal(scale=3e-5, size=u.shape)
    direction = rng.normal(size=u.shape)
    product = np.zeros((mesh.n_columns, 3))
    data = system.tangent(u, 1.0)
    for c in range(mesh.n_columns):
        for k in range(mesh.indptr[c], mesh.indptr[c + 1]):
            product[c] += data[k] @ direction[mesh.indices[k], 0]
    difference = (system.residual(u + eps * direction, 1.0)[0] - system.residual(u - eps * direction, 1.0)[0]) / (
        2 * eps
    )
    np.testing.assert_allclose(product, difference, atol=3e-6 * np.abs(difference).max())


def paper_scene(h: float) -> tuple[SoftLayer, Load]:
    """The paper's rule: the same force along the rest normal at every vertex of a contact."""
    layer = limb(h, radius=0.03, length=0.08)
    touched = np.linalg.norm(layer.vertices - layer.vertices[len(layer.vertices) // 2], axis=1) < 0.01
    return layer, Load.nodal(np.where(touched, 0.04 / touched.sum(), 0.0))


def test_linear_tets_come_to_the_wedges_as_they_are_refined():
    errors = []
    for h in (5e-3, 2.5e-3):
        layer = limb(h, radius=0.03, length=0.08)
        load = disc(layer, 0.3, layer.vertices[len(layer.vertices) // 2], 0.01)
        truth = PatchFem(element="P2xP2", reach=3, check_stability=False).prepare(layer).solve(load)
        tets = TetFem(layers=round(THICKNESS / h), reach=3, check_stability=False).prepare(layer).solve(load)
        assert tets.trust.converged
        errors.append(np.linalg.norm(tets.displacement - truth.displacement, axis=1).max() / truth.magnitude.max())
    assert errors[1] < 0.75 * errors[0]


def test_tetgen_and_split_wedges_agree_on_the_papers_rule():
    pytest.importorskip("tetgen", reason="TetGen is an optional extra")
    layer, load = paper_scene(3e-3)
    split, tetgen = (TetFem(mesher=m, layers=3, reach=3).prepare(layer).solve(load) for m in ("split", "tetgen"))
    assert split.trust.ok and tetgen.trust.ok, (split.trust.why, tetgen.trust.why)
    assert tetgen.magnitude.max() == pytest.approx(split.magnitude.max(), rel=0.2)


def test_bad_input_is_refused_with_its_reason():
    with pytest.raises(InvalidInput, match="mesher"):
        TetFem(mesher="gmsh")  # pyright: ignore
    with pytest.raises(InvalidInput, match="elements"):
        next(critical_loads(elements=("P3",)))
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    with pytest.raises(MeshError, match="no volume"):
        TetMesh.of(flat, np.array([[0, 1, 2, 3]]), np.array([[0, 1, 2]]), np.zeros(4, dtype=bool))
