"""Two fingers on a gantry: they hold the force that was asked for, and lift a limb that friction can hold."""

import numpy as np
import pytest

from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from tests.scenes import limb

pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
from stmpl_sim.grip import FINGERS, LIFT_M, PHASES, lifted, mount_of, usual_force, with_fingers
from stmpl_sim.massage import Course, Log, Massage
from stmpl_sim.scene import BALL, build
from stmpl_sim.site import Site
from stmpl_sim.verbs import gripped

GRIP = 10.0


def gripping(friction: dict[str, Friction]) -> dict[str, float]:
    """What a run keeps that grips and lifts a limb of 0.7 kg on its rest, and touches it with nothing else."""
    layer = limb(6e-3, radius=0.03, length=0.22).with_(youngs_modulus=20e3)
    site = Site.thickest(layer)
    scene = build(layer, site, mount="rest", gripper=True, timestep=4e-3)
    course = Course(site.circle(0.012), (1e-3,), laps=0.0, grip=GRIP)
    phases = [phase for phase in course.phases if phase.name in PHASES]
    object.__setattr__(course, "phases", tuple(type(one)(one.name, one.start - phases[0].start, one.duration, one.force)
                                               for one in phases))  # fmt: skip
    log: Log = Massage(scene, course, friction=friction).run()
    assert np.isfinite(log.qpos).all() and log.squeeze.shape[1] == len(FINGERS)
    kept = gripped(log)
    assert kept is not None
    return kept


def test_two_fingers_hold_their_force_and_lift_the_limb() -> None:
    kept = gripping({BALL: None})
    assert kept["mean_N"] == pytest.approx(GRIP, rel=0.05)
    assert 0.3 * LIFT_M < kept["lifted_m"] < 1.1 * LIFT_M
    assert kept["carried_N"] > 2.0 and kept["given_out_J"] < 0  # friction takes energy, and gives none out


def test_fingers_without_friction_leave_the_limb_where_it_lies() -> None:
    assert gripping(dict.fromkeys((BALL, *FINGERS)))["lifted_m"] < 2e-3


def test_the_lift_comes_back_and_its_rate_is_its_slope() -> None:
    assert lifted("lift", 1.0)[0] == lifted("hold", 0.3)[0] == LIFT_M
    assert lifted("lower", 1.0)[0] == lifted("grip", 1.0)[0] == 0
    for phase in ("lift", "lower"):
        slope = (lifted(phase, 0.41)[0] - lifted(phase, 0.39)[0]) / (0.02 * PHASES[phase])
        assert lifted(phase, 0.4)[1] == pytest.approx(slope, rel=1e-3)


def test_what_is_said_of_friction_stays_and_fingers_are_rubber() -> None:
    assert with_fingers("oiled", BALL) == {BALL: "oiled"} | dict.fromkeys(FINGERS, "glove")
    assert with_fingers({FINGERS[0]: 0.2}, BALL) == {FINGERS[0]: 0.2, FINGERS[1]: "glove"}


def test_only_what_can_be_lifted_is_gripped() -> None:
    assert usual_force("left_forearm") > 0 == usual_force("back")
    assert mount_of("auto", 5.0) == "rest" and mount_of("auto", 0.0) == mount_of("fixed", 0.0) == "fixed"
    with pytest.raises(InvalidInput, match="cannot be lifted"):
        mount_of("fixed", 5.0)
    for layer, why in ((limb(8e-3, radius=0.08, length=0.4), "wide"), (limb(6e-3, radius=0.02, length=0.1), "no room")):
        with pytest.raises(InvalidInput, match=why):
            build(layer, Site.thickest(layer), mount="rest", gripper=True)
