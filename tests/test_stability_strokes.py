"""The stability suite's strokes: each law catches the simulator with a state that is made to break it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from stmpl_core import Simulator, SoftLayer, State, Touch
from stmpl_core.methods import MomentNet, Winkler
from studies.stability import PRESETS, again, judge, stability
from studies.stability.laws import MEANING
from studies.stability.picture import LETTERS
from studies.stability.stroke_axes import QUICK_STROKES, STROKE_AXES, STROKE_LEVELS
from studies.stability.stroke_laws import STROKE_LAWS
from studies.stability.sweeps import Stage
from studies.stability.trial import Trial

QUICK = PRESETS["quick"]
Fault = Callable[[Touch, float, float], dict]  # what is changed of a touch, from the time and the step


class Faulty(Simulator):
    """A simulator that is spoilt by `fault(touch, time, dt)`."""

    fault: Fault
    time = 0.0

    def touch(self, contacts, state=None, dt=0.0):
        touches, state = super().touch(contacts, State() if state is None else state, dt)
        self.time = self.time + dt if state.tools else 0.0
        return [replace(touch, **self.fault(touch, self.time, dt)) for touch in touches], state


@dataclass
class Brings:
    """A method that brings its own simulator."""

    fault: Fault

    def simulator(self, layer: SoftLayer, friction: float | None = None) -> Faulty:
        made = Faulty(layer, MomentNet() if layer.stacked else Winkler(), friction=friction)
        made.fault = self.fault
        return made


def sound(touch, time, dt):
    return {}


def nan(touch, time, dt):
    return {"wrench": np.full(6, np.nan)}


def pushing(touch, time, dt):
    """Friction that helps the slide along."""
    return {"wrench": touch.wrench - 2 * touch.slip.wrench} if touch.slip is not None else {}


def sticky(touch, time, dt):
    if touch.slip is None:
        return {}
    wrench = 4 * touch.slip.wrench
    return {"wrench": touch.wrench - touch.slip.wrench + wrench, "slip": touch.slip._replace(wrench=wrench)}


def by_step(touch, time, dt):
    return {"wrench": touch.wrench * (1 + 3 * dt)}


def one_sided(touch, time, dt):
    if touch.slip is None:
        return {}
    return {"slip": touch.slip._replace(wrench=touch.slip.wrench * (0.8 if touch.slip.wrench[0] < 0 else 1.0))}


def too_stiff(touch, time, dt):
    relaxed = touch.pressed is not None and touch.pressed.factor < 0.99
    return {"wrench": touch.wrench * (3.0 if relaxed else 1.0)}


def clinging(touch, time, dt):
    return {} if touch.presses else {"wrench": np.array([0, 0, 1e-3, 0, 0, 0])}


def growing(touch, time, dt):
    return {"wrench": touch.wrench * (1 + time)}


def waning(touch, time, dt):
    return {} if touch.slip is None else {"slip": touch.slip._replace(wrench=touch.slip.wrench * np.exp(-time))}


FAULTS: dict[str, tuple[str, Fault]] = {
    "finite": ("spin", nan), "gives": ("closed path", pushing), "caps": ("friction", sticky),
    "alike": ("time step", by_step), "masing": ("reversal", one_sided), "between": ("time of relaxation", too_stiff),
    "free": ("lift-off", clinging), "lasts": ("rocking", waning), "ends": ("friction round a limb", growing),
}  # fmt: skip


@pytest.fixture(scope="module")
def made() -> dict[str, Trial]:
    stage = Stage.of(replace(QUICK, levels={}))
    return {axis: replace(STROKE_AXES[axis](stage, QUICK_STROKES[axis][0]), axis=axis) for axis in STROKE_AXES}


def broken(fault: Fault, trial: Trial) -> set[str]:
    row = judge("one", lambda: Brings(fault), trial)
    assert row.outcome != "crashed", row
    return {one.law for one in row.broken}


@pytest.mark.parametrize("law", FAULTS)
def test_a_simulator_made_to_break_a_law_is_caught_by_it(made, law):
    axis, fault = FAULTS[law]
    assert law in broken(fault, made[axis])


@pytest.mark.parametrize("axis", STROKE_AXES)
def test_a_sound_simulator_holds_every_axis(made, axis):
    assert not broken(sound, made[axis])


def test_every_law_is_broken_here_and_every_axis_has_levels():
    assert set(FAULTS) == set(STROKE_LAWS) | {"finite"} and STROKE_LAWS.keys() <= LETTERS.keys() & MEANING.keys()
    assert list(STROKE_AXES) == list(STROKE_LEVELS) == list(QUICK_STROKES)
    assert set(QUICK.only("strokes").levels) == set(STROKE_AXES)


def test_a_spring_lets_the_tool_stick_and_slip(made):
    """It lags behind the spring's other end, and goes."""
    scene = made["stick-slip"].scene
    simulator = Simulator(scene.mesh.layer, Winkler(), friction=scene.friction)
    at = np.array([next(iter(a.touches.values())).pose_body_from_tool[0, 3] for a in scene.asked(simulator)])
    lag = scene.poses[:, 0, 3] - at
    cap = 2 * scene.friction * 2.0
    assert 1e-4 < lag.max() < cap / scene.spring.stiffness and at[-1] > 2e-3


def test_a_saved_failure_of_a_stroke_fails_again(tmp_path):
    preset = replace(QUICK, levels={"reversal": QUICK_STROKES["reversal"]})
    (row,) = stability({"one": lambda: Brings(one_sided)}, preset, tmp_path).rows
    assert row.outcome == "silent" and again(row.file, lambda name: lambda: Brings(one_sided)).broken == row.broken
    assert not again(row.file, lambda name: lambda: Brings(sound)).broken


def test_a_slide_that_turns_in_long_steps_is_that_of_short_ones():
    """A quarter of a circle in six steps of 0.8 cap / k: within 2.5 % of the cap."""
    from stmpl_core.slip import SPRINGS, drag

    def led(parts: int) -> np.ndarray:
        springs, relaxed, one = np.zeros((SPRINGS, 3)), np.zeros((0, SPRINGS, 3)), np.ones(3)
        angle = np.linspace(0, np.pi / 2, 7)
        corners = 3 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
        ways = np.repeat(np.diff(corners, axis=0) / parts, parts, axis=0)
        for way in ways:
            springs, relaxed, force, _, _ = drag(springs, relaxed, np.empty(0), np.empty(0), 0.0, 0.0, one, one, 1.0,
                                                 way, np.zeros(3), False)  # fmt: skip
        return force

    assert np.abs(led(1) - led(64)).max() < 0.025
