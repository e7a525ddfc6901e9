"""Soft skin as a unit of FMI 3.0, through a real importer."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

from stmpl_core import Tool
from stmpl_core.errors import InvalidInput
from stmpl_sim import Memory, Poses, SoftContact

RADIUS, STEP = 0.02, 1e-3


def path(layer: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses of body and tool at a step: down to 4 mm in the thickest skin and along it, seen from a turned world."""
    from stmpl_sim.site import Site

    site = Site.thickest(layer)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), (0.3, -0.1, 0.2)
    tool = np.eye(4)
    tool[:3, 3] = site.point + (RADIUS + 1e-3 - 1e-3 * number) * site.normal + 2e-4 * number * site.along
    return world, world @ tool


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Callable[..., Any], dict[str, int]]:
    """What makes a unit that is not yet instantiated, with what it is made with; and its references by name."""
    fmpy = pytest.importorskip("fmpy", reason="pip install fmpy")
    pytest.importorskip("pythonfmu3", reason="pip install 'stmpl[fmi]'")
    from fmpy.fmi3 import FMU3Slave

    from stmpl_sim.fmi import write_fmu

    folder = tmp_path_factory.mktemp("fmu")
    file = write_fmu(folder)
    described = fmpy.read_model_description(str(file))  # validated against FMI's own schema
    assert described.fmiVersion == "3.0"
    reference = {variable.name: variable.valueReference for variable in described.modelVariables}
    where = fmpy.extract(str(file), str(folder / "unit"))
    return lambda: FMU3Slave(guid=described.guid, unzipDirectory=where, instanceName="skin",
                             modelIdentifier=described.coSimulation.modelIdentifier), reference  # fmt: skip


def test_a_unit_gives_the_wrenches_of_the_contact_that_it_is_made_of(imported: Any) -> None:
    from stmpl_sim.verbs import limb

    unit, reference = imported[0](), imported[1]
    layer = limb("left_forearm", "single")
    mesh = trimesh.creation.icosphere(4, RADIUS)
    contact, memory = SoftContact(layer, [Tool("tool", mesh.vertices, mesh.faces)], damping=2.0), Memory()
    unit.instantiate()
    try:
        unit.enterInitializationMode()
        unit.setString([reference["tissue"]], ["single"])
        unit.setFloat64([reference["damping"], reference["radius"]], [2.0, RADIUS])
        unit.exitInitializationMode()
        forces = []
        for number in range(6):
            body, tool = path(layer, number)
            unit.setFloat64([reference["pose_world_from_body"]], body.ravel().tolist())
            unit.setFloat64([reference["pose_world_from_tool"]], tool.ravel().tolist())
            unit.doStep(number * STEP, STEP)
            given = np.array(unit.getFloat64([reference["wrench_on_tool"]], nValues=6))
            opposite = np.array(unit.getFloat64([reference["wrench_on_body"]], nValues=6))
            reaction = contact.step(Poses(body, {"tool": tool}), memory, STEP)
            memory = reaction.memory
            np.testing.assert_array_equal(given, reaction.tools["tool"])
            np.testing.assert_array_equal(opposite, reaction.body)
            assert unit.getBoolean([reference["in_range"]]) == [reaction.touches["tool"].trust.in_range is not False]
            forces.append(float(np.linalg.norm(given[:3])))
        assert forces[0] == 0 and forces[-1] > 1.0 and sorted(forces) == forces
    finally:
        unit.terminate()
        unit.freeInstance()


def test_a_unit_answers_at_its_start_and_goes_on_after_what_it_refused(imported: Any) -> None:
    """Each call that raised was fatal, and the next one ended the process."""
    from stmpl_sim.verbs import limb

    unit, reference = imported[0](), imported[1]
    body, tool = (pose.ravel().tolist() for pose in path(limb("left_forearm", "single"), 4))
    nan, said = [*tool[:3], float("nan"), *tool[4:]], []

    def outputs() -> list[float]:
        return [*unit.getFloat64([reference["wrench_on_tool"]], nValues=6), *unit.getFloat64([reference["depth"]]),
                *unit.getBoolean([reference["in_range"]])]  # fmt: skip

    unit.instantiate(logMessage=lambda *given: said.append(given[-1].decode()))
    try:
        unit.enterInitializationMode()
        unit.setString([reference["tissue"]], ["single"])
        unit.setFloat64([reference["radius"]], [-RADIUS])
        unit.exitInitializationMode()
        assert "radius of the ball is -0.02 m" in said.pop()
        assert np.isnan(outputs()[:7]).all() and not outputs()[7]
        with pytest.raises(Exception, match="error"):
            unit.doStep(0.0, STEP)
        assert "not initialised" in said.pop()

        unit.reset()
        unit.enterInitializationMode()
        unit.setString([reference["tissue"]], ["single"])
        unit.setFloat64([reference["pose_world_from_body"], reference["pose_world_from_tool"]], body + tool)
        unit.exitInitializationMode()
        first = outputs()
        assert np.linalg.norm(first[:3]) > 0.5 and first[6] > 2e-3 and first[7]
        for bad, why in ((nan, "not finite"), (tool[:15], "has 16 values; got 15"), (nan, "not finite")):
            unit.setFloat64([reference["pose_world_from_tool"]], bad)
            for _ in range(2):
                with pytest.raises(Exception, match="error"):
                    unit.doStep(0.0, STEP)
                assert why in said[-1] and np.isnan(outputs()[:7]).all() and not outputs()[7]
        unit.setFloat64([reference["pose_world_from_tool"]], tool)
        unit.doStep(0.0, STEP)
        np.testing.assert_allclose(outputs(), first, rtol=1e-6, atol=1e-9)
    finally:
        unit.terminate()
        unit.freeInstance()


def test_what_a_unit_cannot_be_told_is_one_sentence() -> None:
    from stmpl_sim.fmi import Unit

    unit = Unit()
    with pytest.raises(InvalidInput, match="pose_world_from_body has 16 values; got 3"):
        unit.set("pose_world_from_body", [1.0, 2.0, 3.0])
    with pytest.raises(InvalidInput, match="not initialised"):
        unit.step(STEP)
    unit.set("tissue", "tense")
    with pytest.raises(InvalidInput, match=r"no tissue 'tense'. Available: relaxed, tensed, single"):
        unit.start()
    unit.set("radius", float("inf"))
    with pytest.raises(InvalidInput, match="radius of the ball is inf m"):
        unit.start()
    unit.set("tool", "nowhere.stl")
    with pytest.raises(InvalidInput, match=r"no file 'nowhere.stl'"):
        unit.start()
    unit.set("pose_world_from_tool", range(16))
    assert unit.get("pose_world_from_tool") == list(map(float, range(16)))
