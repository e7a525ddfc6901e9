"""FMI: soft skin as a unit of FMI 3.0 for co-simulation: poses in, wrenches out, one step at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed
from stmpl_core.friction import friction_from
from stmpl_core.tool import Tool
from stmpl_sim.protocol import Memory, Poses, SoftContact
from stmpl_sim.verbs import limb

SCRIPT = """from pythonfmu3 import Boolean, Dimension, Float64, Fmi3Slave, String
from pythonfmu3.enums import Fmi3Causality, Fmi3Initial, Fmi3Status, Fmi3Variability
from pythonfmu3.fmi3slave import Fmi3StepResult
from stmpl_sim.fmi import Unit


class SoftSkin(Fmi3Slave):
    description = "soft skin that one tool touches: poses in, wrenches out"

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.unit = unit = Unit()
        self.time = 0.0
        self.register_variable(Float64("time", causality=Fmi3Causality.independent,
                                       variability=Fmi3Variability.continuous))
        for kinds, causality, variability, initial in (
            (unit.PARAMETERS, Fmi3Causality.parameter, Fmi3Variability.fixed, Fmi3Initial.exact),
            (unit.INPUTS, Fmi3Causality.input, Fmi3Variability.discrete, None),
            (unit.OUTPUTS, Fmi3Causality.output, Fmi3Variability.discrete, Fmi3Initial.calculated),
        ):
            for name, (shape, said) in kinds.items():
                value = unit.get(name)
                kind = Boolean if isinstance(value, bool) else String if isinstance(value, str) else Float64
                more = {"dimensions": [Dimension(start=str(size)) for size in shape]} if shape else {}
                self.register_variable(kind(
                    name, causality=causality, variability=variability, initial=initial, description=said,
                    getter=lambda name=name: unit.get(name), setter=lambda value, name=name: unit.set(name, value),
                    **more))

    def set_float64(self, vrs, values):
        self.unit.refused |= dict.fromkeys(vrs, self.refusal(super().set_float64, vrs, values))

    def set_string(self, vrs, values):
        self.unit.refused |= dict.fromkeys(vrs, self.refusal(super().set_string, vrs, values))

    def exit_initialization_mode(self):
        self.refusal(self.unit.start)

    def do_step(self, current_time, step_size):
        if self.refusal(self.unit.step, step_size):
            return Fmi3StepResult(status=Fmi3Status.error)
        self.time = current_time + step_size
        return Fmi3StepResult()

    def refusal(self, call, *given):
        # What leaves Python is fatal to pythonfmu3, and ends the importer's process at the next call.
        try:
            call(*given)
        except Exception as error:
            why = str(error) or type(error).__name__
            self.log(why, Fmi3Status.error)
            return why
        return ""
"""
AWAY = np.eye(4) + np.outer([0, 0, 1, 0], [0, 0, 0, 1])  # pose of a tool that was not told one, off the skin


class Unit:
    """What a unit of soft skin holds: parameters, inputs and outputs by name, and the contact between them.

    Attributes:
        PARAMETERS, INPUTS, OUTPUTS: shape and meaning of each value, by its name.
        refused: why a value was refused, by its reference; empty: it was taken. Until all are, no step is taken.
    """

    PARAMETERS: ClassVar[dict[str, tuple[tuple[int, ...], str]]] = {
        "part": ((), "part of the average body"),
        "tissue": ((), "tissue of it: relaxed, tensed or single"),
        "tool": ((), "file of the tool's surface, its axes [m]; empty: a ball of `radius`"),
        "radius": ((), "radius of the ball [m]"),
        "damping": ((), "damping of the contact [s/m]"),
        "friction": ((), "coefficient of friction, or dry, moist, oiled, glove, typical, or none"),
    }
    INPUTS: ClassVar[dict[str, tuple[tuple[int, ...], str]]] = {
        "pose_world_from_body": ((4, 4), "pose of the body that carries the skin, row by row"),
        "pose_world_from_tool": ((4, 4), "pose of the tool, row by row"),
    }
    OUTPUTS: ClassVar[dict[str, tuple[tuple[int, ...], str]]] = {
        "wrench_on_tool": ((6,), "force [N] and torque about its origin [N m] on the tool, world axes"),
        "wrench_on_body": ((6,), "force [N] and torque about its origin [N m] on the body, world axes"),
        "depth": ((), "depth of the deepest column of skin under the tool [m]; below 0: apart; NaN: far"),
        "in_range": ((), "verdict whether the touch lies in the range that was validated"),
    }
    NOTHING: ClassVar[dict[str, Any]] = {  # outputs of what is not known
        "wrench_on_tool": np.full(6, np.nan), "wrench_on_body": np.full(6, np.nan), "depth": np.nan, "in_range": False,
    }  # fmt: skip

    def __init__(self) -> None:
        self._values: dict[str, Any] = {
            "part": "left_forearm", "tissue": "relaxed", "tool": "", "radius": 0.02, "damping": 0.0,
            "friction": "none",
            "pose_world_from_body": np.eye(4), "pose_world_from_tool": AWAY,
        } | self.NOTHING  # fmt: skip
        self.refused: dict[int, str] = {}
        self._contact: SoftContact | None = None
        self._memory = Memory()

    def get(self, name: str) -> Any:
        """A value: a number, a text, or a list of numbers, row by row."""
        value = self._values[name]
        return value.ravel().tolist() if isinstance(value, np.ndarray) else value

    def set(self, name: str, value: Any) -> None:
        """Sets a value. Raises InvalidInput: of another size."""
        known = self._values[name]
        if not isinstance(known, np.ndarray):
            self._values[name] = type(known)(value)
        elif np.size(value) == known.size:
            self._values[name] = np.array(value, dtype=float).reshape(known.shape)
        else:
            raise InvalidInput(f"{name} has {known.size} values; got {np.size(value)}.")

    def start(self) -> None:
        """Makes the skin and the tool by the parameters, and finds the wrenches. Raises InvalidInput or MeshError."""
        import trimesh

        file, radius = self._values["tool"], self._values["radius"]
        if not (file or (np.isfinite(radius) and radius > 0)):
            raise InvalidInput(f"the radius of the ball is {radius:g} m; it must be finite and above 0.")
        if file and not Path(file).is_file():
            raise InvalidInput(f"there is no file '{file}' with the tool's surface.")
        mesh: Any = trimesh.load(file, force="mesh") if file else trimesh.creation.icosphere(4, radius)
        tool = Tool("tool", mesh.vertices, mesh.faces)
        layer = limb(self._values["part"], self._values["tissue"])
        self._contact = SoftContact(layer, [tool], damping=self._values["damping"],
                                    friction=friction_from(self._values["friction"]))  # fmt: skip
        self._memory = Memory()
        self.step(0.0)
        if np.array_equal(self._values["pose_world_from_tool"], AWAY):
            self._memory = Memory()  # a tool that is told its first pose later does not fly there

    def step(self, dt: float) -> None:
        """Finds the wrenches at the poses of now, `dt` [s] after the last ones; NaN where it raises.

        Raises:
            InvalidInput: a unit that `start` has not made, values that were refused, or what SoftContact.step refuses.
        """
        self._values |= self.NOTHING
        if self._contact is None:
            raise InvalidInput("the unit is not initialised, or its parameters were refused. Reset it, and try others.")
        if why := next(filter(None, self.refused.values()), ""):
            raise InvalidInput(why)
        poses = Poses(self._values["pose_world_from_body"], {"tool": self._values["pose_world_from_tool"]})
        reaction = self._contact.step(poses, self._memory, dt)
        touch, self._memory = reaction.touches["tool"], reaction.memory
        self._values |= {"wrench_on_tool": reaction.tools["tool"], "wrench_on_body": reaction.body,
                         "depth": float(touch.depth), "in_range": touch.trust.in_range is not False}  # fmt: skip


def write_fmu(folder: Path | str = ".") -> Path:
    """Writes SoftSkin.fmu into a folder; returns its path.

    The unit runs in the Python that it is imported with, in which stmpl has to be installed.

    Raises:
        InvalidInput: pythonfmu3 is not installed.
    """
    needed("a unit of FMI 3.0", "fmi", "pythonfmu3")
    from tempfile import TemporaryDirectory

    from pythonfmu3.builder import FmuBuilder

    with TemporaryDirectory() as made:
        script = Path(made) / "soft_skin.py"
        script.write_text(SCRIPT)
        return Path(FmuBuilder.build_FMU(script, dest=folder))
