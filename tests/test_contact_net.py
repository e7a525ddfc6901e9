"""Laws of ContactNet: what holds contact nodes, whatever its weights were trained to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stmpl_core import Contact, Simulator, SoftLayer, Tissue, Tool
from stmpl_core.columns import Columns
from stmpl_core.contact_net import MAX_LOG_RATIO, ContactNet, Held
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.networks import NETWORKS, NODE, PRESSURE, Weights, shipped
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from tests.scenes import LENGTH, RADIUS, at, ball, enlarged, limb, placed, plate, turn

LIMB = limb(4e-3)
BALL = SignedDistance.of(ball(), margin=5e-3)
POSE = at(RADIUS + 0.009, 0.001, LENGTH / 2)


def random_weights(seed: int) -> Weights:
    """A network that was taught nothing: what holds for it holds for any."""
    rng, known = np.random.default_rng(seed), shipped("contact_net")
    arrays = {name: rng.normal(scale=0.5, size=a.shape).astype(np.float32) if name[0] in "wb" else a
              for name, a in known.arrays.items()}  # fmt: skip
    return Weights(arrays, known.card)


WEIGHTS = [shipped("contact_net"), random_weights(0), random_weights(1)]


def held(layer: SoftLayer, weights: Weights, pose: np.ndarray = POSE) -> tuple[Nodes, Held]:
    nodes = Columns(layer).squeezed(BALL, pose).nodes
    return nodes, ContactNet(layer, weights).hold(nodes)


def test_no_nodes_no_pressure() -> None:
    assert all(part.shape == (0,) for part in ContactNet(LIMB).hold(Nodes.none())[:3])


@pytest.mark.parametrize("weights", WEIGHTS)
def test_pressure_is_not_below_zero_and_within_a_factor_of_that_of_the_linear_layer(weights: Weights) -> None:
    nodes, answer = held(LIMB, weights)
    linear = ContactNet(LIMB, weights).look(nodes).pressure
    presses = linear > 0
    assert presses.sum() > 20
    assert (answer.pressure[~presses] == 0).all()
    assert (np.abs(np.log(answer.pressure[presses] / linear[presses])) <= MAX_LOG_RATIO + 1e-6).all()
    assert (answer.doubt >= 0).all() and np.isfinite(answer.doubt).all()


@pytest.mark.parametrize("weights", WEIGHTS)
def test_turning_and_moving_the_limb_leaves_the_pressure(weights: Weights) -> None:
    scene = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    (_, here), (_, there) = held(LIMB, weights), held(placed(LIMB, scene), weights, scene @ POSE)
    assert len(here.pressure) == len(there.pressure)
    np.testing.assert_allclose(there.pressure, here.pressure, rtol=5e-3, atol=1e-3 * here.pressure.max())


@pytest.mark.parametrize("weights", WEIGHTS)
def test_neither_stiffness_nor_size_changes_pressure_over_stiffness(weights: Weights) -> None:
    nodes, answer = held(LIMB, weights)
    stiff = ContactNet(LIMB.with_(youngs_modulus=3e4), weights).hold(nodes)
    np.testing.assert_allclose(stiff.pressure, answer.pressure, rtol=1e-6)
    twice = nodes._replace(points=2 * nodes.points, thickness=2 * nodes.thickness, area=4 * nodes.area)
    large = ContactNet(enlarged(LIMB, 2), weights).hold(twice)
    np.testing.assert_allclose(large.pressure, answer.pressure, rtol=2e-3)


def test_a_node_feels_its_neighbours_and_not_the_other_side() -> None:
    """One finger more beside the first changes what holds the skin under it; one on the other side does not."""
    columns, net = Columns(LIMB), ContactNet(LIMB)
    first, beside, across = (columns.squeezed(BALL, pose).nodes for pose in
                             (POSE, at(RADIUS + 0.009, 0.001, LENGTH / 2 + 0.02), at(-RADIUS - 0.009, 0, LENGTH / 2)))
    alone = net.hold(first).pressure
    for other, same in ((beside, False), (across, True)):
        together = net.hold(Nodes.joined([first, other])).pressure[: len(alone)]
        assert np.allclose(together, alone, rtol=1e-4, atol=1e-5) == same


def test_what_no_training_contact_had_is_said() -> None:
    nodes, usual = held(LIMB, WEIGHTS[0])
    strange = ContactNet(LIMB, WEIGHTS[0]).hold(nodes._replace(area=25 * nodes.area))
    assert strange.outside.mean() > 0.9 > usual.outside.mean()
    assert np.isfinite(strange.pressure).all()


def test_the_weights_that_come_with_the_package_say_what_made_them() -> None:
    card = shipped("contact_net").card
    assert {"data", "settings", "ranges", "bound", "commit", "versions"} <= set(card)
    for name in ("poisson_ratio", "thickness_mm", "depth_over_thickness", "p_over_e"):
        low, high = card["ranges"][name]
        assert 0 <= low < high
    assert 0 < card["bound"]["scale"] < np.inf
    arrays = shipped("contact_net").arrays
    assert arrays["w1"].shape[0] == NODE.size and arrays["w4"].shape[1] == PRESSURE.size
    assert all(np.isfinite(a).all() for a in arrays.values())


def test_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no network of this kind"):
        Weights.load(NETWORKS["contact_net"].path)  # a network for contact is no MomentNet
    with pytest.raises(InvalidInput, match="there is no"):
        Weights.load(tmp_path / "none.safetensors", "pressure")
    copy = replace(shipped("contact_net"), card={"format": 1})
    copy.save(tmp_path / "copy.safetensors")
    again = Weights.load(tmp_path / "copy.safetensors", "pressure")
    assert all((again.arrays[name] == shipped("contact_net").arrays[name]).all() for name in again.arrays)


def test_the_bound_covers_first_touches_of_small_contacts_on_thick_tissue() -> None:
    """Forces of balls by axisymmetric finite elements that stick, on 30 mm of 10 kPa, nu 0.3."""
    simulator = Simulator(plate(0.3, 10e-3, 30e-3).with_(tissue=Tissue(1e4, 0.3)), MomentNet())
    for radius, depth, truth in ((0.01, 3e-4, 0.0082), (0.01, 6e-4, 0.0237), (0.03, 3e-4, 0.0148)):
        mesh = trimesh.creation.icosphere(5, 1e3 * radius)
        fine = Tool("ball", 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))
        (touch,) = simulator.touch([Contact(fine, at(1e-3, 5e-4, radius - depth))])
        assert abs(touch.force - truth) < touch.force_bound < 0.2 * truth and touch.trust.in_range
