"""Peers: each is set up rightly if it finds what it must at small strain, and its known offset where it differs."""

from functools import cache

import numpy as np
import pytest

from fem_tools import PatchFem
from stmpl_core import Load, SoftLayer
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.methods import Linear
from stmpl_core.simulator import Simulator
from stmpl_core.tissue import Tissue
from studies.peers import PEERS, installed, peer
from studies.tets import TetFem
from tests import scenes
from tests.scenes import THICKNESS, disc, plate

RADIUS, EDGE = 8e-3, 4e-3  # m
SMALL, FIRM = 1e-3, 0.3  # p / E


@cache
def slab(across: int = 17) -> SoftLayer:
    """A flat layer, 64 mm wide unless said, with edges of 4 mm."""
    return plate((across - 1) * 4e-3, 4e-3, crossed=True)


def press(layer: SoftLayer, ratio: float) -> Load:
    return disc(layer, ratio, (0, 0, 0), RADIUS, EDGE)


def off(found: np.ndarray, truth: np.ndarray) -> float:
    """Mean error over the vertices that move by more than a tenth of the peak, over the peak [-]."""
    size, error = np.linalg.norm(truth, axis=1), np.linalg.norm(found - truth, axis=1)
    return float(error[size > 0.1 * size.max()].mean() / size.max())


def peak(found: np.ndarray) -> float:
    return float(np.linalg.norm(found, axis=1).max())


@cache
def fine(ratio: float) -> np.ndarray:
    layer = slab()
    return PatchFem(refine=1, layers=2).prepare(layer).solve(press(layer, ratio)).displacement


@cache
def linear_tets(ratio: float) -> np.ndarray:
    """Our own linear tetrahedra on the mesh that the peers get."""
    layer = slab()
    return TetFem(layers=2).prepare(layer).solve(press(layer, ratio)).displacement


def test_every_peer_that_is_listed_can_be_asked_for():
    assert set(installed()) <= set(PEERS)
    for name in installed():
        made = peer(name)()
        assert made.name == name
        with pytest.raises(NotPrepared, match="prepare"):
            made.solve(Load.pressure(np.zeros(3)))
    with pytest.raises(InvalidInput, match="mujoco_flex"):
        peer("abaqus")


@pytest.mark.parametrize("name", PEERS)
def test_no_load_moves_nothing_and_a_load_that_does_not_fit_is_refused(name):
    pytest.importorskip(PEERS[name][0])
    method = peer(name)().prepare(slab())
    answer = method.solve(Load.zero(slab()))
    assert not answer.displacement.any() and answer.trust.ok
    with pytest.raises(InvalidInput, match="vertices"):
        method.solve(Load.pressure(np.ones(3)))


@pytest.mark.parametrize("material", ["stvk", "snh"])
def test_mujoco_under_a_small_load_is_linear_elasticity_on_the_same_tetrahedra(material):
    pytest.importorskip("mujoco")
    answer = peer("mujoco_flex")(material=material, rest=2e-4).prepare(slab()).solve(press(slab(), SMALL))
    assert answer.trust.ok and answer.trust.figures["residual"] <= 2e-4
    assert off(answer.displacement, linear_tets(SMALL)) < 0.002


CONFINED = {"stvk": lambda s: 0.5 * (s - s**3), "snh": lambda s: 1 - s}  # stretch of a wide layer -> p / M


@pytest.mark.parametrize(("name", "material"), [("mujoco_flex", "stvk"), ("mujoco_flex", "snh"), ("newton_vbd", "snh")])
def test_a_wide_uniform_pressure_compresses_as_the_energy_says_in_closed_form(name, material):
    """P = d psi / d s of F = diag(1, 1, s): M (s^3 - s) / 2, and M (s - 1)."""
    pytest.importorskip(PEERS[name][0])
    layer = slab(25)  # at 17 the held sides are still felt in the middle: 3 % in the softest
    knobs = {"material": material} if name == "mujoco_flex" else {"iterations": 20, "rest": 2e-3}
    answer = peer(name)(**knobs).prepare(layer).solve(Load.pressure(np.full(len(layer.vertices), 150.0)))
    middle = np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin()
    stretch = 1 + answer.displacement[middle, 2] / THICKNESS
    expected = 150.0 / layer.tissue.confined_modulus
    assert answer.trust.ok
    assert CONFINED[material](stretch) == pytest.approx(expected, rel=0.015)


def test_mujoco_gets_nearer_to_ours_with_a_finer_mesh():
    pytest.importorskip("mujoco")
    load, errors = press(slab(), SMALL), []
    for layers, refine in ((1, 0), (2, 0), (4, 1)):
        method = peer("mujoco_flex")(layers=layers, refine=refine, timestep=0.1, damping=0.0).prepare(slab())
        errors.append(off(method.solve(load).displacement, fine(SMALL)))
    assert errors[2] < 0.5 * errors[1] < 0.5 * errors[0]


def test_mujocos_default_material_collapses_where_its_other_one_stands():
    """Saint Venant-Kirchhoff softens under compression and has no equilibrium at 0.4 E; stable Neo-Hookean has one."""
    pytest.importorskip("mujoco")
    load = press(slab(), 0.4)
    quick = {"timestep": 0.1, "damping": 0.0, "max_steps": 60}
    default, other = (peer("mujoco_flex")(material=m, **quick).prepare(slab()).solve(load) for m in ("stvk", "snh"))
    assert other.trust.ok
    assert not default.trust.ok and peak(default.displacement) > 3 * peak(other.displacement)


def test_newton_and_mujoco_agree_on_the_material_that_both_have():
    pytest.importorskip("mujoco")
    pytest.importorskip("newton")
    load = press(slab(), FIRM)
    theirs = peer("mujoco_flex")(material="snh", timestep=0.1, damping=0.0, rest=1e-4).prepare(slab()).solve(load)
    answer = peer("newton_vbd")(iterations=20, rest=2e-3).prepare(slab()).solve(load)
    assert theirs.trust.ok and answer.trust.ok
    assert off(answer.displacement, theirs.displacement) < 0.003


def test_newton_under_a_small_load_is_linear_elasticity_on_the_same_tetrahedra():
    pytest.importorskip("newton")
    answer = peer("newton_vbd")(iterations=20, rest=2e-3).prepare(slab()).solve(press(slab(), 0.01))
    assert answer.trust.ok
    assert off(answer.displacement, linear_tets(0.01)) < 0.002


def test_newton_rests_beside_the_equilibrium_if_its_iterations_are_too_few_for_its_timestep():
    """Each step starts from a ballistic guess, whose error too few sweeps leave in the answer: the residual tells."""
    pytest.importorskip("newton")
    load, truth = press(slab(), 0.01), linear_tets(0.01)
    few, enough = (peer("newton_vbd")(timestep=0.02, iterations=n, damping=0.0, rest=2e-3, max_steps=40)
                   .prepare(slab()).solve(load) for n in (50, 150))  # fmt: skip
    assert not few.trust.converged and enough.trust.ok
    assert off(few.displacement, truth) > 5 * off(enough.displacement, truth)


def test_felupe_has_our_energy_and_comes_to_our_answer():
    pytest.importorskip("felupe")
    load, errors = press(slab(), FIRM), []
    for layers in (1, 2, 4):
        answer = peer("felupe")(layers=layers, reach=3).prepare(slab()).solve(load)
        assert answer.trust.ok
        ours = PatchFem(refine=1, layers=2, reach=3).prepare(slab()).solve(load).displacement
        errors.append(off(answer.displacement, ours))
    assert errors[2] < 0.015 and errors[2] < 0.5 * errors[1] < 0.5 * errors[0]


def test_a_solver_that_stops_says_so():
    pytest.importorskip("felupe")
    answer = peer("felupe")(layers=1, reach=2, max_iterations=1).prepare(slab()).solve(press(slab(), FIRM))
    assert not answer.trust.converged and "of the load" in answer.trust.why


def test_felupe_halves_an_increment_that_fails():
    pytest.importorskip("felupe")
    answer = peer("felupe")(layers=1, reach=2).prepare(slab()).solve(press(slab(), 1.0))
    assert answer.trust.ok and answer.trust.figures["load_factor"] == 1.0
    assert answer.trust.figures["newton_iterations"] > 5


def test_the_patch_is_kept_while_loads_press_on_the_same_vertices():
    """A model that is used again starts from rest: the second answer is the first."""
    pytest.importorskip("mujoco")
    method = peer("mujoco_flex")(layers=1).prepare(slab())
    load = press(slab(), 0.05)
    first, _, again = method.solve(load), method.solve(load.scaled(3.0)), method.solve(load)
    np.testing.assert_array_equal(first.displacement, again.displacement)


def test_a_rigid_contact_rests_at_the_force_that_it_is_fitted_by() -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    from stmpl_core.tissue import Tissue
    from studies.peers.led_ball import Ground, RigidRig, grid

    ground = Ground((0.10, 0.07), 10e-3, Tissue(20e3), 15e-3, 0.0)
    assert grid(ground, 2) == (20, 14, 2)
    rig, low, high, width, k = RigidRig(ground, ("-1000 -60", "0.001 0.05 0.005 0.5 1")), 0.001, 0.05, 5e-3, 1e3
    place = np.array([0.0, 0.0, 15e-3 - 3e-3])
    for _ in range(1500):
        at, force = rig.step(place, np.zeros(3))
    depth = 15e-3 - at[2]
    d = low + (high - low) * depth / width
    assert force[2] == pytest.approx(ground.mass * d**2 * k * depth / high**2 / (1 - d), rel=1e-3)


def test_a_flex_under_a_ball_bears_about_what_we_answer_and_answers_no_other_tool() -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[peers]'")
    from studies.peers.layered_flex import ball as flex_ball

    limb = scenes.limb(6e-3).with_(tissue=Tissue(5e4, 0.4))
    pose = scenes.at(scenes.RADIUS + 0.0085, 0.0, scenes.LENGTH / 2)
    way = np.array([-1.0, 0.0, 0.0])
    (touch,) = Simulator(limb, Linear()).touch([scenes.press(scenes.ball(), pose, None)])
    force, motion = flex_ball(limb, scenes.ball(), pose, way)
    assert motion is not None and 0.5 < (force @ way) / touch.force < 1.5
    assert np.isnan(flex_ball(limb, scenes.punch(), pose, way)[0]).all()
