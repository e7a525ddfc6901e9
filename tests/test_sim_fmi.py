"""Soft skin as a unit of FMI 3.0, through a real importer."""

from pathlib import Path
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


def test_a_unit_gives_the_wrenches_of_the_contact_that_it_is_made_of(tmp_path: Path) -> None:
    fmpy = pytest.importorskip("fmpy", reason="pip install fmpy")
    pytest.importorskip("pythonfmu3", reason="pip install 'stmpl[fmi]'")
    from fmpy.fmi3 import FMU3Slave

    from stmpl_sim.fmi import write_fmu
    from stmpl_sim.verbs import limb

    file = write_fmu(tmp_path)
    described = fmpy.read_model_description(str(file))  # validated against FMI's own schema
    assert described.fmiVersion == "3.0"
    reference = {variable.name: variable.valueReference for variable in described.modelVariables}
    unit = FMU3Slave(guid=described.guid, unzipDirectory=fmpy.extract(str(file), str(tmp_path / "unit")),
                     modelIdentifier=described.coSimulation.modelIdentifier, instanceName="skin")  # fmt: skip
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
    unit.set("tool", "nowhere.stl")
    with pytest.raises(InvalidInput, match=r"no file 'nowhere.stl'"):
        unit.start()
    unit.set("pose_world_from_tool", range(16))
    assert unit.get("pose_world_from_tool") == list(map(float, range(16)))
