"""Laws of fading stress: closed forms of a slab, limits of rate, derivatives, turning, and what a cycle loses."""

from dataclasses import replace

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.krylov import multiply
from fem_tools.mesh import ELEMENTS, WedgeMesh
from fem_tools.plies import wedge_ends
from fem_tools.relaxation import Relaxing
from fem_tools.system import System
from stmpl_core import Membrane, Ply, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.packed import pack, stack_to_text, unpack
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Prony
from tests import scenes
from tests.scenes import at, plate, wavy_layer

FAT, MUSCLE, SKIN = Prony((0.25, 0.2), (0.5, 5.0)), Prony((0.4,), (2.0,)), Prony((0.3,), (1.0,))
STACK = Tissue(3e3, 0.4, skin=Membrane(2e5, 1e-3, 20.0, relaxation=SKIN), relaxation=FAT,
               deeper=(Ply(3e-3, 2e4, 0.3, relaxation=MUSCLE),))  # fmt: skip
ONE = Tissue(1e3, 0.4, relaxation=FAT)


def system_of(tissue: Tissue, element="P1xP2", fading="stress") -> tuple[System, Relaxing]:
    layer = wavy_layer().with_(tissue=tissue)
    ends = wedge_ends(tissue, layer.thickness, 1)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element, ends=ends)
    system = System(mesh, tissue, [], mesh.border_columns())
    return system, system.relax(fading)


def squeezed(system: System, strain: float) -> np.ndarray:
    """All columns shortened alike."""
    u = np.zeros_like(system.rest)
    u[..., 2] = -strain * (system.rest[..., 2] - system.rest[:, -1:, 2])
    return u


def slab(tissue: Tissue) -> tuple[System, Relaxing]:
    layer = plate(6e-3, 3e-3, 1e-2).with_(tissue=tissue)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces)
    system = System(mesh, tissue, [], mesh.border_columns())
    return system, system.relax()


def carried(system: System, relaxing: Relaxing, times: np.ndarray, strains: np.ndarray) -> np.ndarray:
    """Pressure of a confined slab of 6 mm by 6 mm at these times [Pa], from rest on."""
    memories, last, out = relaxing.start, 0.0, []
    for now, strain in zip(times, strains, strict=True):
        u = squeezed(system, strain)
        relaxing.begin(memories, now - last)
        out.append(system.internal(u)[0][:, 0, 2].sum() / 6e-3**2)
        memories, last = relaxing.after(memories, now - last, u), now
    return -np.array(out)


def convolved(series: Prony, times: np.ndarray, stress, shape) -> np.ndarray:
    """lambda(t) times the convolution of S_e = stress / lambda with the series, on a fine grid of times [Pa]."""
    out = []
    for now in times:
        s = np.linspace(0, now, 4001)
        elastic = stress(shape(s)) / (1 - shape(s))
        faded = np.sum(np.diff(elastic) * series.left(now - (s[1:] + s[:-1]) / 2))
        out.append(faded * (1 - shape(now)))
    return np.array(out)


def test_a_slab_that_is_squeezed_and_held_carries_the_closed_form():
    """Ramp of 0.2 s to 0.4 of the thickness; then the elastic pressure fades as the series."""
    times = np.concatenate([np.linspace(0, 0.2, 41)[1:], 0.2 + np.geomspace(0.01, 30, 20)])

    def shape(t):
        return 0.4 * np.minimum(t / 0.2, 1)

    found = carried(*slab(ONE), times, shape(times))
    expected = convolved(FAT, times, lambda e: column_pressure(1 - e, ONE), shape)
    np.testing.assert_allclose(found, expected, rtol=3e-4)
    assert found[-1] == pytest.approx(FAT.relaxed * column_pressure(0.6, ONE), rel=5e-3)


def test_a_slab_that_goes_up_and_down_carries_the_closed_form_and_loses_what_it_should():
    """At 1 Hz between 0 and 0.3 of the thickness: the loss of the tenth cycle, within 1 % of that of the series."""
    times = np.linspace(0, 10, 801)[1:]

    def shape(t):
        return 0.15 * (1 - np.cos(2 * np.pi * t))

    found = carried(*slab(ONE), times, shape(times))
    expected = convolved(FAT, times[-80:], lambda e: column_pressure(1 - e, ONE), shape)
    np.testing.assert_allclose(found[-80:], expected, atol=3e-3 * expected.max())

    def loss(pressure):
        strains = shape(times[-81:])
        return float(np.sum(np.diff(strains) * (pressure[1:] + pressure[:-1]) / 2))

    lost = loss(found[-81:])
    assert lost > 0
    assert lost == pytest.approx(loss(np.concatenate([[expected[-1]], expected])), rel=0.02)


def test_small_cycles_lose_the_energy_of_the_loss_modulus():
    """pi M'' e^2 a volume and cycle, M'' = M sum g_i x / (1 + x^2), x = omega tau_i."""
    amplitude, times = 1e-4, np.linspace(0, 12, 1921)[1:]
    strains = amplitude * np.sin(2 * np.pi * times)
    found = carried(*slab(ONE), times, strains)[-161:]
    lost = np.sum(np.diff(strains[-161:]) * (found[1:] + found[:-1]) / 2)
    x = 2 * np.pi * np.array(FAT.times)
    modulus = ONE.confined_modulus * float(np.array(FAT.shares) @ (x / (1 + x * x)))
    assert lost == pytest.approx(np.pi * modulus * amplitude**2, rel=0.01)


def test_a_step_is_exact_where_the_stress_changes_evenly():
    """One step of 3 s, and three hundred, to the same stress: the same memories."""
    system, relaxing = slab(ONE)
    full = relaxing.after(relaxing.start, 3.0, squeezed(system, 0.3))[0]
    assert full is not None
    memory = relaxing.start[0]
    for k in range(300):
        memory = memory.after(0.01, full.elastic * (k + 1) / 300)
    np.testing.assert_allclose(memory.faded, full.faded, atol=1e-10 * np.abs(full.faded).max())


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("fading", ["stress", "shear"])
def test_forces_are_the_gradient_of_the_energy_and_the_tangent_that_of_the_forces(element, fading):
    system, relaxing = system_of(STACK, element, fading)
    u, v, d = np.random.default_rng(1).normal(size=(3, *system.zeros().shape)) * 1e-4
    u[:, -1] = v[:, -1] = d[:, -1] = 0
    relaxing.begin(relaxing.after(relaxing.start, 0.3, v), 0.2)
    eps, m = 1e-4, system.mesh
    slope = (system.energy(u + eps * d, 1.0) - system.energy(u - eps * d, 1.0)) / (2 * eps)
    assert np.vdot(system.internal(u)[0], d) == pytest.approx(slope, rel=2e-5)
    product = np.empty((m.n_columns, 3 * system.free))
    multiply(m.indptr, m.indices, system.tangent(u, 1.0), d[:, :-1].reshape(len(u), -1), product)
    difference = (system.residual(u + eps * d, 1.0)[0] - system.residual(u - eps * d, 1.0)[0]) / (2 * eps)
    np.testing.assert_allclose(product, difference, atol=1e-5 * np.abs(difference).max())


def test_a_step_of_no_time_is_elastic_and_one_without_end_is_relaxed():
    system, relaxing = system_of(STACK)
    u = np.random.default_rng(2).normal(size=system.zeros().shape) * 1e-4
    u[:, -1] = 0
    quick = system.internal(u)[0]
    relaxing.begin(relaxing.start, 1e9)
    slow = system.internal(u)[0]
    elastic = replace(STACK, relaxation=None, skin=replace(STACK.skin, relaxation=None),
                      deeper=(replace(STACK.deeper[0], relaxation=None),))  # fmt: skip
    assert not elastic.relaxes and STACK.relaxes
    bare = System(system.mesh, elastic, [], system.fixed)
    np.testing.assert_allclose(quick, bare.internal(u)[0], atol=1e-14)
    relaxed = replace(
        elastic, youngs_modulus=FAT.relaxed * 3e3, deeper=(replace(elastic.deeper[0], youngs_modulus=0.6 * 2e4),),
        skin=replace(elastic.skin, youngs_modulus=0.7 * 2e5))  # fmt: skip
    expected = System(system.mesh, relaxed, [], system.fixed).internal(u)[0]
    np.testing.assert_allclose(slow, expected, atol=1e-8 * np.abs(expected).max())


def test_turning_the_body_turns_its_memory():
    system, relaxing = system_of(STACK)
    turn = scenes.turn((1, 2, 3), 1.1)[:3, :3]
    first, second = np.random.default_rng(3).normal(size=(2, *system.zeros().shape)) * 1e-4
    rest = system.rest

    def turned(u):
        return (rest + u) @ turn.T - rest

    forces = []
    for u, v in ((first, second), (turned(first), turned(second))):
        memories = relaxing.after(relaxing.start, 0.4, u)
        relaxing.begin(memories, 0.3)
        balanced = np.zeros_like(v)
        balanced[:, 0] = system.membrane.balanced
        forces.append(system.internal(v)[0] - balanced)
    np.testing.assert_allclose(forces[1], forces[0] @ turn.T, atol=1e-9 * np.abs(forces[0]).max())


# A ball


def test_a_ball_without_series_or_without_times_is_todays_answer_to_the_bit():
    tool = Press(SignedDistance.of(scenes.ball()), at(0, 0, 0.02), np.array([0, 0, -1.0]))
    fem, flat = PatchFem(refine=1, reach=3), plate(0.06, 4e-3)
    fading = flat.with_(tissue=Tissue(relaxation=FAT))
    old = IndenterFem(fem).prepare(flat).press([tool], 2e-3)
    for layer, times in ((flat, [1.0]), (fading, None)):
        new = next(IndenterFem(fem).prepare(layer).path([tool], [2e-3], times=times))
        np.testing.assert_array_equal(new.displacement, old.displacement)
        np.testing.assert_array_equal(new.wrenches, old.wrenches)


def test_a_ball_pressed_at_once_is_elastic_and_pressed_forever_relaxed():
    tool = Press(SignedDistance.of(scenes.ball()), at(0, 0, 0.02), np.array([0, 0, -1.0]))
    fem, flat = PatchFem(refine=1, reach=3), plate(0.06, 4e-3)
    old = IndenterFem(fem).prepare(flat).press([tool], 2e-3)
    solver = IndenterFem(fem).prepare(flat.with_(tissue=Tissue(relaxation=FAT)))
    quick, slow = (next(solver.path([tool], [2e-3], times=[t])) for t in (1e-7, 1e7))
    assert quick.force == pytest.approx(old.force, rel=1e-4)
    assert slow.force == pytest.approx(FAT.relaxed * old.force, rel=2e-3)
    np.testing.assert_allclose(slow.displacement, old.displacement, atol=3e-6)


def test_tissue_without_a_series_is_packed_as_ever_and_one_with_comes_back():
    assert "relaxation" not in stack_to_text(Tissue(3e3, 0.45, skin=Membrane(2e5, 1e-3), deeper=(Ply(5e-3, 1e4),)))
    for tissue in (STACK, ONE, replace(STACK, relaxation=None)):
        assert unpack(pack(plate(6e-3, 3e-3).with_(tissue=tissue))).tissue == tissue


@pytest.mark.parametrize(
    "shares, times", [((), ()), ((0.5, 0.5), (1, 2)), ((0.1,), (0,)), ((-0.1,), (1,)), ((0.1,), (1, 2))]
)
def test_a_series_that_is_none_is_refused(shares, times):
    with pytest.raises(InvalidInput):
        Prony(shares, times)
