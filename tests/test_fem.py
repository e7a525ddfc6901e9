"""Laws of the finite-element truth: patch test, slab, derivatives, objectivity, and an independent code."""

import subprocess
import sys

import numpy as np
import pytest
from skfem import Basis, BilinearForm, MeshWedge1
from skfem.element import ElementH1
from skfem.refdom import RefWedge

from fem_tools import PatchFem
from fem_tools import neo_hookean as nh
from fem_tools.krylov import bicgstab, conjugate_gradients, multiply
from fem_tools.mesh import ELEMENTS, WedgeMesh, reference_wedge
from fem_tools.newton import is_positive_definite, solve
from fem_tools.patch import mirror_projectors
from fem_tools.skin_loads import FollowerPressure
from fem_tools.system import System
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.tissue import Tissue
from tests.scenes import THICKNESS, bump, disc, limb, plate, wavy_layer

CASES = [(element, layers) for element in ELEMENTS for layers in (1, 2)]


def wavy_system(element, layers, pressure=400.0) -> System:
    layer = wavy_layer()
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element, layers)
    varied = pressure * (1 + np.sin(200 * layer.vertices[:, 0]))
    return System(mesh, layer.tissue, [FollowerPressure(mesh, varied)], mesh.border_columns())


@pytest.mark.parametrize(("element", "layers"), CASES)
def test_internal_forces_are_the_gradient_of_the_energy(element, layers):
    system, rng = wavy_system(element, layers), np.random.default_rng(0)
    m = system.mesh
    u = rng.normal(scale=5e-5, size=system.zeros().shape)
    direction = rng.normal(size=u.shape)

    def energy(v):
        return nh.strain_energy(v, m.columns, m.layers, m.gradients, m.volumes, system.mu, system.lam)

    eps = 1e-8
    slope = (energy(u + eps * direction) - energy(u - eps * direction)) / (2 * eps)
    assert np.vdot(system.internal(u)[0], direction) == pytest.approx(slope, rel=2e-5)


@pytest.mark.parametrize(("element", "layers"), CASES)
def test_tangent_is_the_derivative_of_the_residual_for_a_varying_follower_pressure(element, layers):
    system, rng = wavy_system(element, layers), np.random.default_rng(1)
    m, free = system.mesh, system.free
    u = system.zeros()
    u[:, :-1] = rng.normal(scale=5e-5, size=u[:, :-1].shape)
    d = np.zeros_like(u)
    d[:, :-1] = rng.normal(size=d[:, :-1].shape)
    product = np.empty((m.n_columns, 3 * free))
    multiply(m.indptr, m.indices, system.tangent(u, 1.0), d[:, :-1].reshape(len(u), -1), product)
    eps = 1e-7
    difference = (system.residual(u + eps * d, 1.0)[0] - system.residual(u - eps * d, 1.0)[0]) / (2 * eps)
    np.testing.assert_allclose(product, difference, atol=2e-6 * np.abs(difference).max())


@pytest.mark.parametrize("convex", [0.0, 0.3])
@pytest.mark.parametrize("layers", [1, 2])
def test_wedges_that_are_linear_in_plane_are_summed_in_another_order_and_that_is_all(layers, convex):
    system, rng = wavy_system("P1xP2", layers), np.random.default_rng(3)
    m, moduli = system.mesh, (system.mu, system.lam)
    u = rng.normal(scale=5e-5, size=system.zeros().shape)
    forces, blocks = np.zeros_like(u), np.zeros((len(m.indices), 3 * system.free, 3 * system.free))
    smallest = nh.internal_forces(u, m.columns, layers, m.gradients, m.volumes, *moduli, forces)
    nh.tangent(u, m.columns, m.blocks, layers, m.gradients, m.volumes, *moduli, convex, blocks)
    assert 0 < smallest < 0.95
    found, again = system.internal(u)
    np.testing.assert_allclose(found, forces, atol=1e-13 * np.abs(forces).max())
    assert again == pytest.approx(smallest, rel=1e-12)
    system.loads = []
    np.testing.assert_allclose(system.tangent(u, 1.0, convex=convex), blocks, atol=1e-13 * np.abs(blocks).max())
    u[len(u) // 2, 0] += 2 * THICKNESS * m.natural[0, 0, 2] / np.linalg.norm(m.natural[0, 0, 2])
    assert system.internal(u)[1] <= 0, "a folded wedge must show"


def test_stress_in_the_kernel_is_the_derivative_of_the_energy_density():
    """Homogeneous deformation of one wedge: its nodal forces are -volume * dpsi/dF : grad N."""
    mesh = WedgeMesh.of(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]),
        np.array([[0, 0, -1], [1, 0, -1], [0, 1, -1.0]]),
        np.array([[0, 1, 2]]),
    )
    mu, lam = 0.7, 1.9
    F = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.05, 0.0, 0.8]])
    u = mesh.rest_positions() @ (F - np.eye(3)).T
    forces = np.zeros_like(u)
    moduli = np.full(1, mu), np.full(1, lam)
    smallest = nh.internal_forces(u, mesh.columns, 1, mesh.gradients, mesh.volumes, *moduli, forces)
    assert smallest == pytest.approx(np.linalg.det(F))
    eps, P = 1e-6, np.empty((3, 3))
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = eps
        P[i, j] = (nh.energy_density(F + step, mu, lam) - nh.energy_density(F - step, mu, lam)) / (2 * eps)
    # sum_a X_a (x) f_a = volume * P^T for a homogeneous stress
    np.testing.assert_allclose(
        np.einsum("cli,clj->ij", forces, mesh.rest_positions()), P * mesh.volumes.sum(), atol=1e-8
    )


@pytest.mark.parametrize(("element", "layers"), CASES)
def test_patch_test_an_affine_motion_leaves_no_force_inside(element, layers):
    system = wavy_system(element, layers, pressure=0.0)
    F = np.array([[1.05, 0.1, 0.02], [0.0, 0.95, 0.05], [-0.03, 0.02, 0.9]])
    u = system.rest @ (F - np.eye(3)).T
    forces, smallest = system.internal(u)
    interior = ~system.mesh.border_columns()
    inside = forces[interior][:, 1:-1]  # neither on the skin nor on the core, nor on the rim
    assert smallest == pytest.approx(np.linalg.det(F))
    assert np.abs(inside).max() < 1e-12 * np.abs(forces).max()


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 2.0, 5.0])
def test_confined_slab_is_the_closed_form(element, ratio):
    """From rest, not from the closed-form guess, so that Newton has work to do."""
    layer = plate(4 * THICKNESS, THICKNESS, crossed=True)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element)
    pressure = ratio * layer.tissue.youngs_modulus
    load = FollowerPressure(mesh, np.full(mesh.n_columns, pressure))
    system = System(mesh, layer.tissue, [load], np.zeros(mesh.n_columns, bool), mirror_projectors(mesh))
    result = solve(system, system.zeros())
    assert result.converged and result.iterations > 2
    stretch = 1 + result.u[:, 0, 2] / THICKNESS
    np.testing.assert_allclose(column_pressure(stretch, layer.tissue), pressure, rtol=1e-3)
    assert np.ptp(stretch) < 1e-4


def test_a_wide_clamped_plate_reaches_the_slab_in_its_middle():
    layer = plate(16 * THICKNESS, THICKNESS, crossed=True)
    answer = PatchFem().prepare(layer).solve(Load.pressure(np.full(len(layer.vertices), 1e3)))
    middle = np.linalg.norm(layer.vertices, axis=1).argmin()
    stretch = 1 + answer.displacement[middle, 2] / THICKNESS
    assert column_pressure(stretch, layer.tissue) == pytest.approx(1e3, rel=1e-3)


def test_kernels_assemble_what_scikit_fem_assembles():
    """The linear tangent at rest, element by element, against scikit-fem's forms on the same wedges."""
    layer = wavy_layer(3)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, "P1xP2")
    system = System(mesh, layer.tissue, [], np.zeros(mesh.n_columns, bool))
    ours = np.zeros((mesh.n_columns, 6, mesh.n_columns, 6))
    data = system.tangent(system.zeros(), 1.0)
    for c in range(mesh.n_columns):
        for k in range(mesh.indptr[c], mesh.indptr[c + 1]):
            ours[c, :, mesh.indices[k], :] = data[k]
    theirs = scikit_fem_stiffness(layer, mesh)
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())


class ElementWedgeP1P2(ElementH1):
    """Linear in plane, quadratic through the thickness; all functions inside the element, for element matrices."""

    interior_dofs, maxdeg, refdom = 9, 4, RefWedge
    dofnames = [f"u{k}" for k in range(9)]  # noqa: RUF012 (scikit-fem asks for a list)
    doflocs = np.zeros((9, 3))

    def lbasis(self, X, i):
        column, level = divmod(i, 3)
        x, y, z = X
        zero, one = np.zeros_like(x), np.ones_like(x)
        plane = [(1 - x - y, -one, -one), (x, one, zero), (y, zero, one)][column]
        depth = [((1 - z) * (1 - 2 * z), 4 * z - 3), (4 * z * (1 - z), 4 - 8 * z), (z * (2 * z - 1), 4 * z - 1)][level]
        return plane[0] * depth[0], np.stack([plane[1] * depth[0], plane[2] * depth[0], plane[0] * depth[1]])


def scikit_fem_stiffness(layer: SoftLayer, mesh: WedgeMesh) -> np.ndarray:
    from skfem import ElementVector

    n = len(layer.vertices)
    points = np.vstack([layer.vertices, layer.inner_vertices]).T
    wedges = np.vstack([mesh.triangles.T, n + mesh.triangles.T])
    ref = reference_wedge("P1xP2")
    xi = ref.geometry_value @ np.array([[0, 0], [1, 0], [0, 1.0]])
    quadrature = (np.vstack([xi.T, ref.zeta]), ref.weight)
    basis = Basis(MeshWedge1(points, wedges), ElementVector(ElementWedgeP1P2()), quadrature=quadrature)
    mu, lam = layer.tissue.shear_modulus, layer.tissue.lame_lambda

    @BilinearForm
    def elasticity(u, v, w):
        gu, gv = u.grad, v.grad
        symmetric = gu + np.swapaxes(gu, 0, 1)
        return mu * (symmetric * gv).sum((0, 1)) + lam * np.trace(gu) * np.trace(gv)

    local = np.zeros((mesh.n_columns, 6, mesh.n_columns, 6))
    matrix, dofs = elasticity.assemble(basis).tocsr(), basis.element_dofs
    names = [divmod(k, 3) for k in range(27)]  # (function, component)
    for t, columns in enumerate(mesh.columns):
        block = abs(basis.dx[t].sum()) and matrix[np.ix_(dofs[:, t], dofs[:, t])].toarray()
        for i, (fi, ci) in enumerate(names):
            for j, (fj, cj) in enumerate(names):
                if fi % 3 < 2 and fj % 3 < 2:
                    local[columns[fi // 3], 3 * (fi % 3) + ci, columns[fj // 3], 3 * (fj % 3) + cj] += block[i, j]
    return local


def pressed_by_felupe(half: float, depth: float, tissue: Tissue, peak: float, radius: float, n: int = 9):
    """A slab of n x n x 2 tri-quadratic hexahedra, held below and at its sides: skin points and displacements."""
    fem = pytest.importorskip("felupe", reason="FElupe is under the GPL: pip install stmpl[peers]")

    mesh = fem.Cube(a=(-half, -half, -depth), b=(half, half, 0.0), n=(n + 1, n + 1, 3))
    mesh = mesh.add_midpoints_edges().add_midpoints_faces().add_midpoints_volumes()
    field = fem.FieldContainer([fem.Field(fem.RegionTriQuadraticHexahedron(mesh), dim=3)])
    on_skin = mesh.points[:, 2] > -1e-9
    skin = fem.RegionTriQuadraticHexahedronBoundary(mesh, only_surface=True, mask=on_skin)
    skin_field = fem.FieldContainer([fem.Field(skin, dim=3)])
    at = np.moveaxis(fem.Field(skin, dim=3, values=mesh.points).interpolate(), 0, -1)
    pressure = bump(at.reshape(-1, 3), peak, radius).reshape(at.shape[:2])
    held = (mesh.points[:, 2] < -depth + 1e-9) | (np.abs(mesh.points[:, :2]).max(axis=1) > half - 1e-9)
    bounds = {"held": fem.Boundary(field[0], mask=held)}
    dof0, dof1 = fem.dof.partition(field, bounds)
    solid = fem.SolidBody(fem.NeoHookeCompressible(tissue.shear_modulus, tissue.lame_lambda), field)
    for factor in (0.5, 1.0):
        pressing = fem.SolidBodyPressure(skin_field, pressure=factor * pressure)
        fem.newtonraphson(items=[solid, pressing], x0=field, dof0=dof0, dof1=dof1, verbose=0, tol=1e-8)
    return mesh.points[on_skin], field[0].values[on_skin]


def test_an_independent_quadratic_code_finds_the_same_press():
    """felupe's tri-quadratic hexahedra and follower pressure, p/E = 0.8, against both of our elements."""
    half, radius, peak = 0.0225, 0.015, 800.0
    points, theirs = pressed_by_felupe(half, THICKNESS, Tissue(), peak, radius)
    layer = plate(2 * half, half / 18, crossed=True)  # fine, because our pressure is linear between the vertices
    nearest = np.linalg.norm(points[:, None] - layer.vertices[None], axis=2).argmin(axis=1)
    assert np.linalg.norm(points - layer.vertices[nearest], axis=1).max() < 1e-9
    load = Load.pressure(bump(layer.vertices, peak, radius))
    for element, layers in (("P1xP2", 2), ("P2xP2", 2)):
        method = PatchFem(element=element, layers=layers, reach=9, check_stability=False)
        ours = method.prepare(layer).solve(load).displacement[nearest]
        error = np.linalg.norm(ours - theirs, axis=1)
        assert error.mean() < 0.003 * np.linalg.norm(theirs, axis=1).max()
        assert error.max() < 0.015 * np.linalg.norm(theirs, axis=1).max()


def test_turning_the_scene_turns_the_answer():
    layer = limb(4e-3)
    load = disc(layer, 0.6, layer.vertices[len(layer.vertices) // 2], 0.01)
    turn, shift = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0], np.array([0.3, -1.0, 0.5])
    turn *= np.sign(np.linalg.det(turn))
    moved = layer.with_(vertices=layer.vertices @ turn.T + shift)
    here, there = (PatchFem(reach=4).prepare(x).solve(load) for x in (layer, moved))
    assert here.trust.ok and there.trust.ok
    np.testing.assert_allclose(there.displacement, here.displacement @ turn.T, atol=1e-9)


def test_zero_load_moves_nothing_at_all():
    layer = wavy_layer()
    answer = PatchFem().prepare(layer).solve(Load.zero(layer))
    assert not answer.displacement.any() and answer.trust.ok and answer.trust.error_bound == 0.0


def test_dead_forces_lose_stability_where_follower_pressure_does_not():
    """Linear stability of a pressed layer: 0.65 E for dead loads, none for a follower pressure."""
    layer = plate(12 * 2.5e-3, 2.5e-3, crossed=True)
    for ratio, stable in ((0.5, True), (0.9, False)):
        mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, "P2xP2")
        keep, none = mirror_projectors(mesh), np.zeros(mesh.n_columns, bool)
        pressed = System(mesh, layer.tissue, [FollowerPressure(mesh, np.full(mesh.n_columns, 1e3 * ratio))], none, keep)
        uniform = solve(pressed).u
        assert is_positive_definite(pressed, uniform)
        assert is_positive_definite(System(mesh, layer.tissue, [], none, keep), uniform) is stable


def test_the_linear_solvers_agree_with_a_direct_solution():
    system = wavy_system("P1xP2", 2)
    u = system.zeros()
    m, data = system.mesh, system.tangent(u, 1.0, symmetric=True)
    inverse, b = system.preconditioner(data), np.random.default_rng(0).normal(size=(m.n_columns, 3 * system.free))
    b[system.fixed] = 0
    x = conjugate_gradients(m.indptr, m.indices, data, inverse, b, 1e-10, 500)
    y = bicgstab(m.indptr, m.indices, data, inverse, b, 1e-10, 500)
    product = np.empty_like(b)
    multiply(m.indptr, m.indices, data, x[0], product)
    np.testing.assert_allclose(product[~system.fixed], b[~system.fixed], atol=1e-7)
    np.testing.assert_allclose(x[0], y[0], atol=1e-6 * np.abs(x[0]).max())
    assert not x[3]


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_convex_tangent_is_positive_where_the_true_one_is_not(element):
    """A layer crushed to 0.4 by dead loads is unstable; leaving out the skew part makes a direction of descent."""
    layer = plate(6 * 2.5e-3, 2.5e-3, crossed=True)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element)
    system = System(mesh, layer.tissue, [], np.zeros(mesh.n_columns, bool), mirror_projectors(mesh))
    u = np.zeros_like(system.rest)
    u[..., 2] = -0.6 * (system.rest[..., 2] + THICKNESS)
    b = np.random.default_rng(0).normal(size=(mesh.n_columns, 3 * system.free))
    negative = []
    for convex in (False, True):
        data = system.tangent(u, 1.0, convex=convex)
        inverse = system.preconditioner(data)
        negative.append(conjugate_gradients(mesh.indptr, mesh.indices, data, inverse, b, 1e-8, 2000)[3])
    assert negative == [True, False]


def test_a_load_past_what_exists_is_flagged_not_believed():
    layer = limb(5e-3)
    pressure = disc(layer, 3.0, layer.vertices[len(layer.vertices) // 2], 0.012, 0.001)
    load = Load.nodal(pressure.values * layer.vertex_areas)
    answer = PatchFem(reach=3).prepare(layer).solve(load)
    assert not answer.trust.ok and answer.trust.error_bound is None and answer.trust.why
    assert np.isfinite(answer.displacement).all()


def test_bad_input_is_refused_with_its_reason():
    layer = wavy_layer()
    with pytest.raises(NotPrepared, match="prepare"):
        PatchFem().solve(Load.zero(layer))
    with pytest.raises(InvalidInput, match="not finite"):
        Load.pressure([0.0, np.nan])
    with pytest.raises(InvalidInput, match="3 values"):
        PatchFem().prepare(layer).solve(Load.pressure([1.0, 2.0, 3.0]))


def test_the_solvers_are_imported_without_what_only_draws():
    """Letters, scenes and meshes need matplotlib, shapely, trimesh and scikit-fem; a press does not."""
    code = ("import sys; from fem_tools import IndenterFem, PatchFem, Press, RigidFem; import fem_tools.scenes;"
            "names = 'matplotlib', 'shapely', 'trimesh', 'skfem', 'zarr';"
            "sys.exit(str([name for name in names if name in sys.modules]))")  # fmt: skip
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stderr
    assert said.strip() == "[]"
