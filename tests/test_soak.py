"""The soak in small: listeners that come and go or are killed get the skin, and the node keeps nothing of them."""

import json
import os
from pathlib import Path

import pytest

from tests.bus import end, start
from tests.node_bus import NODE


@pytest.mark.slow
def test_listeners_come_and_go_or_are_killed_and_all_who_lived_got_the_skin_and_answers(tmp_path: Path):
    out, domain = tmp_path / "soak.json", os.environ["ROS_DOMAIN_ID"]
    small = ["--minutes", "0.2", "--listeners", "12", "--stay", "0.2", "--rate", "50", "--settle", "5"]
    small += ["--domain", domain, "--out", str(out)]
    code, said = end(start("-m", "benchmarks.soak", *small, "--node", "-c", NODE))
    assert out.exists(), said
    told = json.loads(out.read_text())
    listeners, first, last = told["listeners"], told["readings"][0], told["readings"][-1]
    assert len(listeners) == 12 and code == bool(told["verdict"])
    lived = [one for one in listeners if one["ending"] != "were killed early"]
    assert len(lived) == 8 and all(one["answer"] is not None for one in lived)
    assert all(one["topology"] is not None or one["asked"] is not None for one in lived), said
    assert last["threads"] <= first["threads"] and last["files"] <= first["files"], said


def test_a_listener_that_hangs_is_ended_and_told(monkeypatch):
    """No node is there: it would wait for a minute."""
    from threading import Event

    from benchmarks import crowd

    monkeypatch.setattr(crowd, "HUNG_S", 3.0)
    some = crowd.Crowd(int(os.environ["ROS_DOMAIN_ID"]), 1, 0.1, 1, 0.1, 5.0)
    some.run(Event())
    assert [(one.here, one.hung) for one in some.all] == [(True, True)]


def test_a_verdict_names_what_was_lost_and_what_leaks():
    from benchmarks.crowd import EARLY, KILLED, Listener
    from benchmarks.soak import Reading, verdict

    well = Listener(KILLED, topology=0.1, answer=0.2, answers=3)
    calm = [Reading(seconds, 400.0, 20, 30, 10, 100.0, 1) for seconds in (0.0, 5.0, 10.0)]
    assert verdict([well, Listener(EARLY), Listener(KILLED, hung=True)], calm) == {}
    asked = Listener(KILLED, asked=5.0, answer=0.2, gaps=2)
    busy = [*calm[:2], Reading(10.0, 450.0, 22, 35, 10, 0.0, 3)]
    said = "; ".join(verdict([well, asked, Listener(KILLED)], busy).values())
    for what in ("2 of 3 listeners did not get the latched topology", "1 of 3 listeners got no topology at all",
                 "1 of 3 listeners heard no answer", "2 answers are missing", "2 more threads", "5 more files",
                 "grew by 50.0 MB", "no contact wrench"):  # fmt: skip
        assert what in said
