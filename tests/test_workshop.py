"""Laws of the processes beside a node: whatever becomes of them, what is asked for is made. Driven without a bus."""

import os
import pickle
import sys
import time
from collections.abc import Callable
from multiprocessing import active_children
from threading import Thread
from types import SimpleNamespace
from typing import Any

import pytest

from stmpl_core.friction import friction_from
from stmpl_ros.remembering import ELASTIC
from stmpl_ros.workshop import Workshop
from tests.bus import PATIENCE
from tests.scenes import ball, limb


@pytest.fixture
def shop():
    """A workshop on a limb, whose node runs at once what comes back; the errors that it told; and its processes."""
    told: list[str] = []
    others = set(active_children())
    executor: Any = SimpleNamespace(create_task=lambda do, future: do(future))
    node: Any = SimpleNamespace(executor=executor, get_logger=lambda: SimpleNamespace(error=told.append))
    one = Workshop(node)
    one.move_to(limb(8e-3), friction_from(""))
    yield one, told, lambda: set(active_children()) - others
    one.close()


def until(done: Callable[[], object]) -> None:
    last = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < last
        time.sleep(0.02)


@pytest.mark.parametrize("what", ["fields", "models", "fits"])
def test_a_process_that_died_while_it_had_nothing_to_do_is_replaced_by_the_next_that_is_asked_for(shop, what):
    workshop, told, processes = shop
    ask = {
        "fields": lambda do: workshop.field(ball(), do),
        "models": lambda do: workshop.models([], ELASTIC, do),
        "fits": lambda do: workshop.stiffness([]).add_done_callback(do),
    }[what]
    made = []
    ask(made.append)
    until(lambda: made)
    for process in processes():
        process.kill()
    until(lambda: workshop._builders.broken and (what == "fields" or workshop._models.broken))
    ask(made.append)
    until(lambda: len(made) == 2)
    assert type(made[1].exception()) is type(made[0].exception()), "as if nothing had been"
    assert len(told) == 1 and "a process that builds distance fields or local models died" in told[0]


def test_nobody_waits_for_the_process_that_finds_local_models_to_take_the_layer_over(shop, tmp_path, monkeypatch):
    """It imports before it reads, and a pipe holds less than a layer. Here it waits before it reads, and is killed."""
    workshop, told, processes = shop
    assert len(pickle.dumps(workshop._knows)) > 2**16
    slow, go, before, made = tmp_path / "python", tmp_path / "go", processes(), []
    slow.write_text(f'#!/bin/sh\nuntil [ -e {go} ]; do sleep 0.05; done\nexec {sys.executable} "$@"\n')
    slow.chmod(0o755)
    with monkeypatch.context() as patch:
        patch.setattr("multiprocessing.spawn._python_exe", os.fsencode(slow))
        asked = Thread(target=workshop.models, args=([], ELASTIC, made.append))
        asked.start()
        try:
            until(lambda: not asked.is_alive())
            (waits,) = processes() - before
            waits.kill()
        finally:
            go.touch()
    until(lambda: made and workshop._models.broken)
    workshop.models([], ELASTIC, made.append)
    until(lambda: len(made) == 2)
    assert made[0].exception() and made[1].result() == [] and "died" in told[0]
    workshop.move_to(limb(8e-3), friction_from(""))
    workshop.models([], ELASTIC, made.append)
    workshop.close()
    assert not processes(), "closed while it takes the layer over"
