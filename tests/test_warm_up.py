"""Laws of what a node does before its first answer: nothing is left to compile when a tool comes."""

import os

import pytest

from tests.bus import end, start

KERNELS = """
import sys
from numba.core.dispatcher import Dispatcher


def kernels():
    ours = [vars(module) for name, module in sys.modules.items() if name.startswith(("stmpl_core", "stmpl_sim"))]
    found = {one for names in ours for one in names.values() if isinstance(one, Dispatcher)}
    return {(one.py_func.__module__, one.__name__, str(kind)) for one in found for kind in one.signatures}


"""
FRESH = KERNELS + """
import numpy as np
from stmpl_core import Contact, Simulator
from stmpl_core.friction import friction_from
from stmpl_core.local_contact import local_contacts
from stmpl_core.methods import MomentNet
from stmpl_core.state import State
from stmpl_core.warming import warm_up
from tests.scenes import RADIUS, at, ball, limb
from tests.test_posing import hinged


layer = limb(8e-3)
simulator = Simulator(layer.with_(rig=hinged(layer)), MomentNet(), friction=friction_from(sys.argv[1]))
frictions = simulator.history.frictions
warm_up(simulator)
assert simulator.skin.angles == () and not len(simulator.tools) and simulator.history.frictions == frictions
before, state, push = kernels(), State(), np.array([0, -0.3, 0, 0, 0, 0])
for angle in (0.0, 0.4):
    simulator.move_to(simulator.skin.at_angles([angle]))
    state = State()
    for depth in (1e-3, 3e-3, 8e-3, 0.02):
        for wrench in (None, push):
            contacts = [Contact(ball(), at(0, RADIUS + 0.012 - depth, 0.05 + depth), wrench)]
            simulator.step(contacts)
            local_contacts(simulator.history, simulator.touch(contacts))
            twice = [*contacts, Contact(ball().named("again"), contacts[0].pose_body_from_tool, wrench)]
            simulator.step(twice)
            if simulator.remembers:
                touches, state = simulator.touch(contacts, state, 0.01)
                simulator.answer(touches)
                local_contacts(simulator.history, touches, state)
                touches, state = simulator.touch(twice, state, 0.01)
                simulator.answer(touches)
print(sorted(kernels() - before))
"""


ROBOT = KERNELS + """
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_ros.parameters import RobotConfig
from stmpl_ros.robot import massage_of

layer = living(Body.anny(), "left_forearm", edge_length=8e-3)
massage = massage_of(RobotConfig(laps=0.1, grip=5.0, physics=250.0, friction=sys.argv[1]), layer)
massage.warm_up()
before = kernels()
log = massage.run()
assert log.force.max() > 4 and log.squeeze.max() > 4
print(sorted(kernels() - before))
"""


STEPS = KERNELS + """
from stmpl_core import Simulator, stepped
from stmpl_core.history import compile_steps
from stmpl_core.methods import MomentNet
from stmpl_core.regions import HELD_SKIN
from stmpl_core.warming import warm_up
from tests.scenes import limb

compile_steps()
layer = limb(8e-3)
warm_up(Simulator(layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN)), MomentNet(), friction=0.3))
print(*(len(one.signatures) for one in (stepped.asked_for, stepped.tell, stepped.step, stepped.doubted)))
"""


LAW = KERNELS + """
import pickle
from stmpl_core import Simulator, contact_net, green
from stmpl_core.body import Body
from stmpl_core.contact_net import compile_on_stacks
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.warming import CompiledAhead, _first, compile_touches, tip

compile_on_stacks()
layer = living(Body.anny(), "left_forearm", edge_length=8e-3)
simulator, ahead, tool = Simulator(layer, MomentNet()), CompiledAhead(True, False), tip()
ahead._pool, ahead._submit = True, lambda *job: None
ahead.touch(simulator)
touches, first = simulator.touch([_first(layer, tool)]), kernels()
told = (contact_net._look_on_stack, contact_net._correct, contact_net._on_plates, green._matrix)
assert [len(one.signatures) for one in told] == [1] * 4
if sys.argv[1] == "answer":
    simulator.answer(touches)
else:
    compile_touches(pickle.loads(pickle.dumps(layer)))
print(*sorted(f"{module}.{name}" for module, name, _ in kernels() - first))
"""


AHEAD = """
import time
from numba import njit
from stmpl_core.warming import CompiledAhead

with CompiledAhead(stacked=False, steps=True) as ahead:
    if sys.argv[1] == "late":
        ahead.wait()
    njit(lambda x: x + 1)(1)
    jobs, pool = ahead._jobs, ahead._pool
    if sys.argv[1] == "dies":
        while not pool._processes:
            time.sleep(0.01)
        for process in list(pool._processes.values()):
            process.kill()
        ahead.wait()
print(len(jobs), pool is not None, all(job.done() for job in jobs))
"""


def test_what_another_process_compiles_of_steps_is_what_they_take():
    code, said = end(start("-c", STEPS))
    assert (code, said) == (0, "1 1 1 1\n")


def test_what_another_process_compiles_of_touches_is_not_what_answers_take():
    """Both happen at once. The law's kernels, which it compiled before, are those that are asked for."""
    left = {}
    for what in ("answer", "touches"):
        code, said = end(start("-c", LAW, what))
        assert code == 0
        left[what] = set(said.split())
    assert "stmpl_core.tangent._rates" in left["touches"] and "stmpl_core.methods.moment_net._move" in left["answer"]
    assert not left["answer"] & left["touches"]


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
@pytest.mark.parametrize(("when", "there"), [("early", "1 True True"), ("late", "0 False True"),
                                             ("dies", "1 True True")])  # fmt: skip
def test_a_process_compiles_ahead_unless_this_one_has_begun_itself_and_ends_with_it(when, there):
    assert end(start("-c", "import sys" + AHEAD, when)) == (0, there + "\n")


@pytest.mark.parametrize("friction", ["none", "oiled"])
def test_nothing_is_left_to_compile_once_the_clock_of_a_robot_runs(friction):
    """One that massages, then grips."""
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    code, said = end(start("-c", ROBOT, friction))
    assert (code, said) == (0, "[]\n")


@pytest.mark.parametrize("friction", ["none", "0.4", "other: 0.1, probe: 0.4"])
def test_nothing_is_left_to_compile_when_a_tool_comes_to_a_limb_at_rest_or_bent(friction):
    """In a process that touched nothing before."""
    code, said = end(start("-c", FRESH, friction))
    assert (code, said) == (0, "[]\n")
