"""Laws of rigid contact: balance, growth with depth, independence of the start, and the theory of bonded layers."""

import numpy as np
import pytest

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Tissue
from tests import scenes
from tests.scenes import THICKNESS, at, limb, plate


@pytest.fixture(scope="module")
def ball() -> SignedDistance:
    return SignedDistance.of(scenes.ball(subdivisions=4))


@pytest.fixture(scope="module")
def layer() -> SoftLayer:
    return limb(4e-3)


@pytest.fixture(scope="module")
def pressed(ball, layer):
    depths = np.array([0.1, 0.3, 0.5, 0.7]) * THICKNESS
    return list(IndenterFem(PatchFem(refine=2, reach=4)).prepare(layer).path([side_tool(ball)], depths))


def side_tool(field: SignedDistance, x: float = 0.08) -> Press:
    return Press(field, at(x, 0, 0.08), np.array([-1.0, 0, 0]))


def test_force_grows_with_depth_and_every_answer_is_sound_down_to_70_percent(pressed):
    forces = [answer.force for answer in pressed]
    assert all(answer.trust.ok for answer in pressed), [answer.trust.why for answer in pressed]
    assert np.all(np.diff(forces) > 0) and forces[0] > 0
    for answer in pressed:
        assert answer.trust.figures["faces_entered_m"] < 0.01 * THICKNESS
        assert answer.trust.figures["min_j"] > 0.1
        assert (answer.pressure >= 0).all()


def test_the_skin_is_nowhere_inside_the_tool(pressed):
    for answer in pressed:
        inside = -answer.tools[0].distance(answer.displacement + limb(4e-3).vertices)
        assert inside.max() < 25e-6


def test_a_point_that_sticks_stays_where_it_touched(pressed, layer):
    early, late = pressed[2:4]
    stuck = early.pressure > 0.2 * early.pressure.max()
    before, after = (a.tools[0].to_tool((layer.vertices + a.displacement)[stuck]) for a in (early, late))
    assert stuck.sum() > 5
    assert np.linalg.norm(after - before, axis=1).max() < 0.01 * THICKNESS


def test_deep_in_the_layer_a_ball_carries_less_than_confined_columns_would(pressed, layer):
    """A ball presses the columns below it to all depths alike."""
    for answer in pressed[2:]:
        stretch = 1 - answer.depth / THICKNESS * np.linspace(0, 1, 201)
        columns = column_pressure(stretch, layer.tissue).mean() / layer.tissue.youngs_modulus
        assert 0.4 * columns < answer.trust.figures["mean_pressure_over_modulus"] < columns


def test_the_tractions_sum_to_the_wrench(pressed, layer):
    for answer in pressed:
        total = (answer.traction * layer.vertex_areas[:, None]).sum(axis=0)
        np.testing.assert_allclose(total, answer.wrenches[0][:3], atol=1e-10)


def test_the_core_bears_what_the_tool_exerts(ball, layer):
    """Global balance: internal forces at the held nodes are minus the tool's force."""
    from fem_tools.indenter import Walk

    press = Walk(IndenterFem(PatchFem(refine=1, reach=4)).prepare(layer), layer, [side_tool(ball)], np.array([2e-3]))
    press.walk(2e-3)
    reaction = press.system.internal(press.state.u)[0]
    held = reaction[:, -1].sum(axis=0) + reaction[press.patch.fixed, :-1].sum(axis=(0, 1))
    np.testing.assert_allclose(held, -press.answer().wrenches[0][:3], atol=2e-3 * press.force())


def test_a_force_asked_is_a_force_given_and_agrees_with_the_path(ball, layer, pressed):
    solver = IndenterFem(PatchFem(refine=2, reach=4)).prepare(layer)
    answer = solver.press_with([side_tool(ball)], 0.5 * (pressed[0].force + pressed[1].force))
    assert answer.trust.ok, answer.trust.why
    assert answer.force == pytest.approx(0.5 * (pressed[0].force + pressed[1].force), rel=1.1e-3)
    assert pressed[0].depth < answer.depth < pressed[1].depth


@pytest.mark.parametrize("friction", ["none", "stick"])
def test_the_same_answer_from_different_starts(ball, layer, friction):
    """A tool from far away, one already in the skin, and one that stops on its way."""
    solver = IndenterFem(PatchFem(refine=1, reach=4), friction=friction).prepare(layer)
    far = solver.press([side_tool(ball, 0.12)], 2e-3)
    inside = solver.press([side_tool(ball, 0.049)], 2e-3)
    stops = list(solver.path([side_tool(ball)], [0.5e-3, 1.03e-3, 2e-3]))[-1]
    assert inside.force == pytest.approx(far.force, rel=1e-3)
    assert stops.force == pytest.approx(far.force, rel=0.03)
    np.testing.assert_allclose(inside.displacement, far.displacement, atol=5e-6)


def test_coulomb_lies_between_sliding_and_sticking(ball, layer):
    def force(friction):
        solver = IndenterFem(PatchFem(refine=1, reach=4), friction=friction).prepare(layer)
        return solver.press([side_tool(ball)], 3e-3).force

    sliding, little, much, stuck = force("none"), force(0.1), force(2.0), force("stick")
    assert sliding < little < stuck
    assert much == pytest.approx(stuck, rel=0.02)


def test_a_grasp_of_a_symmetric_limb_is_in_balance(ball):
    layer = limb(3.93e-3)  # 64 vertices around: the two sides are alike
    other = Press(ball, at(-0.08, 0, 0.08), np.array([1.0, 0, 0]))
    answer = IndenterFem(PatchFem(refine=1, reach=3)).prepare(layer).press([side_tool(ball), other], 2e-3)
    assert answer.trust.converged
    first, second = answer.wrenches
    np.testing.assert_allclose(first[:3] + second[:3], 0, atol=0.02 * np.linalg.norm(first[:3]))


def test_turning_the_scene_turns_the_answer(ball, layer):
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, (0.1, -0.4, 0.2)
    moved = layer.with_(vertices=layer.vertices @ turn.T + motion[:3, 3])
    tool = side_tool(ball)
    turned = Press(ball, motion @ tool.pose_body_from_tool, turn @ tool.direction)
    fem = PatchFem(refine=1, reach=4)
    here, there = IndenterFem(fem).prepare(layer).press([tool], 2e-3), None
    there = IndenterFem(fem).prepare(moved).press([turned], 2e-3)
    np.testing.assert_allclose(there.displacement, here.displacement @ turn.T, atol=2e-6)
    assert there.force == pytest.approx(here.force, rel=1e-3)


def bonded_layer_force(radius: float, depth: float, thickness: float, tissue: Tissue) -> float:
    """Frictionless sphere on a bonded elastic layer [N]: Dimitriadis et al., Biophys. J. 82 (2002), eq. 12.

    It tends to Hertz's 4 E sqrt(R) depth^1.5 / (3 (1 - nu^2)) as sqrt(R depth) / thickness goes to 0, and carries the
    correction for the core of Hayes et al. (J. Biomech. 5, 1972) to fourth order.
    """
    nu, chi, pi = tissue.poisson_ratio, np.sqrt(radius * depth) / thickness, np.pi
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    series = (
        1
        - 2 * a / pi * chi
        + 4 * a**2 / pi**2 * chi**2
        - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        + 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    )
    return 4 * tissue.youngs_modulus / (3 * (1 - nu**2)) * np.sqrt(radius) * depth**1.5 * series


@pytest.mark.parametrize("nu", [0.3, 0.4])
def test_a_shallow_ball_is_hertz_with_the_correction_for_a_bonded_layer(ball, nu):
    flat = plate(18 * 2.5e-3, 2.5e-3, crossed=True, poisson_ratio=nu)
    solver = IndenterFem(PatchFem(refine=3, reach=4, layers=2), friction="none").prepare(flat)
    tool = Press(ball, at(0, 0, 0.02), np.array([0, 0, -1.0]))
    for answer in solver.path([tool], [0.15e-3, 0.3e-3]):
        expected = bonded_layer_force(0.012, answer.depth, THICKNESS, flat.tissue)
        assert answer.force == pytest.approx(expected, rel=0.06)


def test_bad_input_is_refused_with_its_reason(ball, layer):
    solver = IndenterFem().prepare(layer)
    with pytest.raises(InvalidInput, match="never meets"):
        solver.press([Press(ball, at(0.08, 0, 0.08), np.array([1.0, 0, 0]))], 1e-3)
    with pytest.raises(InvalidInput, match="inside the core"):
        solver.press([side_tool(ball)], 1.2 * THICKNESS)
    with pytest.raises(InvalidInput, match="increase"):
        list(solver.path([side_tool(ball)], [2e-3, 1e-3]))
    with pytest.raises(InvalidInput, match="no tool"):
        solver.press([], 1e-3)
    with pytest.raises(InvalidInput, match="friction"):
        IndenterFem(friction=-1.0)
    with pytest.raises(InvalidInput, match="force"):
        solver.press_with([side_tool(ball)], float("nan"))
