"""Laws of ContactNet: what holds squeezed columns, whatever its weights were trained to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stmpl_core import SoftLayer
from stmpl_core.columns import Columns, Squeeze
from stmpl_core.contact_net import MAX_LOG_RATIO, ContactNet, Held
from stmpl_core.errors import InvalidInput
from stmpl_core.networks import INPUTS, NETWORKS, PRESSURE, Weights, shipped
from stmpl_core.sdf import SignedDistance
from tests.scenes import LENGTH, RADIUS, at, ball, enlarged, limb, placed, turn

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


def held(layer: SoftLayer, weights: Weights, pose: np.ndarray = POSE) -> tuple[Squeeze, Held]:
    squeeze = Columns(layer).squeezed(BALL, pose)
    return squeeze, ContactNet(layer, weights).hold(squeeze.vertices, squeeze.pressure, squeeze.strain)


def test_no_squeeze_no_pressure() -> None:
    nothing = ContactNet(LIMB).hold(np.empty(0, np.int64), np.empty(0), np.empty(0))
    assert all(part.shape == (0,) for part in nothing)


@pytest.mark.parametrize("weights", WEIGHTS)
def test_pressure_is_above_zero_and_within_a_factor_of_that_of_columns(weights: Weights) -> None:
    squeeze, answer = held(LIMB, weights)
    assert len(squeeze.vertices) > 20
    ratio = answer.pressure / squeeze.pressure
    assert (np.abs(np.log(ratio)) <= MAX_LOG_RATIO + 1e-6).all()
    assert (answer.doubt > 0).all() and np.isfinite(answer.doubt).all()


@pytest.mark.parametrize("weights", WEIGHTS)
def test_turning_and_moving_the_limb_leaves_the_pressure(weights: Weights) -> None:
    scene = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    turned = placed(LIMB, scene)
    squeeze = Columns(LIMB).squeezed(BALL, POSE)
    here, there = (ContactNet(layer, weights).hold(squeeze.vertices, squeeze.pressure, squeeze.strain)
                   for layer in (LIMB, turned))  # fmt: skip
    np.testing.assert_allclose(there.pressure, here.pressure, rtol=2e-3)


@pytest.mark.parametrize("weights", WEIGHTS)
def test_neither_stiffness_nor_size_changes_pressure_over_stiffness(weights: Weights) -> None:
    squeeze = Columns(LIMB).squeezed(BALL, POSE)
    stiff = LIMB.with_(youngs_modulus=3e4)
    large = enlarged(LIMB, 2)
    answers = [ContactNet(layer, weights).hold(squeeze.vertices, squeeze.pressure, squeeze.strain)
               for layer in (LIMB, stiff, large)]  # fmt: skip
    np.testing.assert_allclose(answers[1].pressure, answers[0].pressure, rtol=1e-6)
    np.testing.assert_allclose(answers[2].pressure, answers[0].pressure, rtol=2e-3)


def test_a_column_feels_its_neighbours_and_not_the_other_side() -> None:
    """One finger more beside the first changes what holds the skin under it; one on the other side does not."""
    columns, net = Columns(LIMB), ContactNet(LIMB)
    first, beside, across = (columns.squeezed(BALL, pose) for pose in
                             (POSE, at(RADIUS + 0.009, 0.001, LENGTH / 2 + 0.02), at(-RADIUS - 0.009, 0, LENGTH / 2)))
    alone = net.hold(first.vertices, first.pressure, first.strain).pressure
    for other, same in ((beside, False), (across, True)):
        v = np.concatenate([first.vertices, np.setdiff1d(other.vertices, first.vertices)])
        fields = np.zeros((2, len(LIMB.vertices)))
        for one in (first, other):
            fields[:, one.vertices] += one.pressure, one.strain
        fields[:, first.vertices] = first.pressure, first.strain
        together = net.hold(v, fields[0, v], fields[1, v]).pressure[: len(alone)]
        assert np.allclose(together, alone, rtol=1e-6) == same


def test_what_no_training_contact_had_is_said() -> None:
    squeeze = Columns(LIMB).squeezed(BALL, POSE)
    net = ContactNet(LIMB)
    strange = net.hold(squeeze.vertices, 100 * squeeze.pressure, 100 * squeeze.strain)
    usual = net.hold(squeeze.vertices, squeeze.pressure, squeeze.strain)
    assert strange.outside.mean() > 0.9 > usual.outside.mean()
    assert np.isfinite(strange.pressure).all()


def test_the_weights_that_come_with_the_package_say_what_made_them() -> None:
    card = shipped("contact_net").card
    assert {"data", "settings", "ranges", "bound", "commit", "versions"} <= set(card)
    for name in ("poisson_ratio", "thickness_mm", "depth_over_thickness", "p_over_e"):
        low, high = card["ranges"][name]
        assert 0 <= low < high
    assert 0 < card["bound"]["factor"] < np.inf
    arrays = shipped("contact_net").arrays
    assert arrays["w1"].shape[0] == INPUTS.size and arrays["w4"].shape[1] == PRESSURE.size
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
