"""Laws of the node's memory: whatever comes, it is the state of the instants that were answered."""

from pathlib import Path

import numpy as np
import pytest

from stmpl_core import Contact, Prony, Simulator, State, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import PAIRS, friction_from
from stmpl_core.living import write_tissue
from stmpl_core.methods import Winkler
from stmpl_core.warming import warm_up
from stmpl_ros.inbox import Instant
from stmpl_ros.making import friction_of, skin_of
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.remembering import ELASTIC, Remembering
from stmpl_ros.settings import checked
from tests.scenes import at, ball, plate

BALL, OTHER = ball(8e-3).named("ball"), ball(8e-3).named("other")
MS = 1_000_000
SKIN = plate(0.09).with_(tissue=Tissue(2e4, 0.4, relaxation=Prony((0.225, 0.225), (0.5, 5.0))))


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(SKIN, Winkler(), friction={"ball": 0.5})


def instant(stamp_ms: float, way: float = 0.0, depth: float = 2e-3, *more: Contact) -> Instant:
    contacts = [Contact(BALL, at(way, 0, 8e-3 - depth)), *more]
    return Instant(contacts, round(stamp_ms * MS), 0, {one.name: (0, 0) for one in contacts})


def other(way: float) -> Contact:
    return Contact(OTHER, at(0.02, way, 8e-3 - 1e-3))


def test_uneven_late_and_repeated_stamps_are_steps_of_that_time(sim: Simulator) -> None:
    rng, memory, state, now, last = np.random.default_rng(5), Remembering(), State(), 1e6, 0
    for k in range(40):
        now += rng.choice([0.0, 0.1, 1.0, 7.0, 130.0, -40.0])
        given = instant(now, 2e-4 * k, 2e-3, *([other(1e-4 * k)] if rng.random() < 0.5 else []))
        back = memory.went_back(given)
        reaction = memory.reaction(sim, given)
        dt = max(given.stamp - last, 0) / 1e9 if last else 0.0
        assert back == max(last - given.stamp, 0) / 1e9 and reaction.before.dt == dt
        touches, state = sim.touch(given.contacts, state, dt)
        memory.keep(reaction, given)
        last = given.stamp
        assert [one.wrench.tobytes() for one in touches] == [one.wrench.tobytes() for one in reaction.touches]
        assert memory.state.pack() == state.pack()
        assert reaction.before.friction["ball"] == 0.5 and reaction.before.friction.get("other", 0.0) == 0.0


def test_what_fails_or_is_not_finite_leaves_the_memory_as_it_was(sim: Simulator,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    memory = Remembering()
    for k in range(5):
        memory.keep(memory.reaction(sim, instant(1e6 + 10 * k, 2e-4 * k)), instant(1e6 + 10 * k))
    before = memory.state.pack()
    step = sim.history.step

    def spoilt(contacts, state, dt):
        touches, after = step(contacts, state, dt)
        return touches, State({name: one.with_(relaxed=one.relaxed * np.nan) for name, one in after.tools.items()})

    monkeypatch.setattr(sim.history, "step", spoilt)
    with pytest.raises(InvalidInput, match="would not be finite"):
        memory.reaction(sim, instant(1e6 + 50, 1e-3))
    monkeypatch.undo()
    assert memory.state.pack() == before
    reaction = memory.reaction(sim, instant(1e6 + 60, 1e-3))
    assert reaction.before.dt == pytest.approx(0.02), "time goes on from the last instant that counted"


def test_a_tool_that_is_forgotten_comes_back_as_one_that_never_touched(sim: Simulator) -> None:
    memory = Remembering()
    for k in range(6):
        memory.keep(memory.reaction(sim, instant(1e6 + 10 * k, 4e-4 * k, 2e-3, other(0.0))), instant(1e6 + 10 * k))
    memory.forget("ball")
    assert set(memory.state.tools) == {"other"}
    again = memory.reaction(sim, instant(1e6 + 60, 3e-3, 2e-3, other(0.0))).touches[0]
    (fresh, _), _ = sim.touch(instant(0, 3e-3, 2e-3, other(0.0)).contacts, State(), 0.01)
    assert again.slip is not None and fresh.slip is not None
    np.testing.assert_allclose(again.wrench, fresh.wrench, rtol=1e-9, atol=1e-12)
    assert again.slip.share == fresh.slip.share
    memory.forget()
    assert not memory.state.tools and memory.reaction(sim, instant(1e6 + 70)).before.dt == 0.0


def test_without_friction_and_relaxation_nothing_is_remembered() -> None:
    elastic = Simulator(SKIN.with_(tissue=Tissue(2e4, 0.4)), Winkler())
    memory = Remembering()
    for k in range(3):
        reaction = memory.reaction(elastic, instant(1e6 + k, 1e-3 * k))
        memory.keep(reaction, instant(1e6 + k))
        assert reaction.before is ELASTIC and not memory.state.tools
        plain = elastic.touch(instant(0, 1e-3 * k).contacts)
        assert plain[0].wrench.tobytes() == reaction.touches[0].wrench.tobytes()
    assert not elastic.remembers and Simulator(elastic.skin, friction=0.0).remembers
    assert Simulator(SKIN, Winkler()).remembers


# Settings


@pytest.mark.parametrize(
    ("text", "means"),
    [("", None), ("none", None), ("0.3", 0.3), ("0", 0.0), (" oiled ", "oiled"),
     ("ball: oiled, letter: 0.3", {"ball": "oiled", "letter": 0.3}), ("ball:none", {"ball": None})],
)  # fmt: skip
def test_friction_is_told_in_words_or_numbers(text: str, means: object) -> None:
    assert friction_from(text) == means
    assert NodeConfig(friction=text).friction == text


@pytest.mark.parametrize(
    ("text", "says"),
    [("slippery", f"Available: {', '.join(PAIRS)}"), ("-1", "from 0 to"), ("nan", "from 0 to"), ("ball: ice", "ice"),
     ("ball 0.3, letter: 0.3", "of each tool once"), ("ball: 1, ball: 2", "of each tool once"), ("ball:", "once")],
)  # fmt: skip
def test_friction_that_cannot_be_is_refused_and_told_why(text: str, says: str) -> None:
    with pytest.raises(InvalidInput, match=says):
        friction_from(text)
    with pytest.raises(InvalidInput, match=f"friction is .*{says}"):
        checked({"friction": text})


def flat(config: NodeConfig):
    return plate(0.06)


def test_relaxing_is_for_whatever_skin_is_built_and_is_warmed_up() -> None:
    settings = {"tissue": "paper", "method": "winkler"}
    plain, fading = (skin_of(NodeConfig(**settings, relaxing=on), flat) for on in (False, True))
    assert fading.layer.tissue.relaxes and not plain.layer.tissue.relaxes
    assert fading.layer_id != plain.layer_id
    simulator = Simulator(fading, friction="dry")
    warm_up(simulator)
    assert simulator.remembers and not len(simulator.tools)


def test_a_file_of_what_a_scene_needs_says_the_friction_unless_the_settings_do(tmp_path: Path) -> None:
    path = tmp_path / "massage.json"
    write_tissue(path, Tissue(relaxation=Prony((0.2,), (1.0,))), 0.01, "oiled", relaxing=True)
    assert friction_of(NodeConfig(tissue=str(path))) == "oiled"
    assert friction_of(NodeConfig(tissue=str(path), friction="0.3")) == 0.3
    assert friction_of(NodeConfig(tissue=str(path), friction="none")) is None
    assert friction_of(NodeConfig()) is None
