"""HandsOn: a tool that a person drags over the skin; every pose is answered by the simulator, the newest first."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import viser
from viser import transforms

from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import Method
from stmpl_core.simulator import Simulator
from stmpl_core.tool import Tool
from stmpl_ros.latest import LatestWins
from stmpl_ros.view.judge import Judge
from stmpl_ros.view.page import Page, wxyz_of
from stmpl_ros.view.snapshot import Snapshot, readings_of
from stmpl_ros.view.tools import TOOLS, place_on, tool_from_bytes, tool_named

KEPT = 2000  # number of answers that the plots go back
GIZMO = 0.03  # size of the handle [m]
GRIP = 5e-3  # place of the handle beyond the tool's end [m]: there the hand does not cover the contact
OFF = "off"
NUDGES = {"-1": -1e-3, "-0.1": -1e-4, "+0.1": 1e-4, "+1": 1e-3}  # steps into the skin [m] by the button's text [mm]


@dataclass(frozen=True, eq=False)
class Asked:
    """A tool at a pose, and when it was asked for [s]."""

    tool: Tool
    pose: Transform
    at: float


class HandsOn:
    """A tool on a page, a simulator behind it.

    Args:
        page: page that shows it.
        layer: layer that is pressed.
        method: method that answers.
        tool: name of a tool, a letter, or a mesh file.

    Raises:
        InvalidInput: a tool that does not exist.
    """

    def __init__(self, page: Page, layer: SoftLayer, method: Method, tool: str) -> None:
        self.page, self.layer, self._method = page, layer, method
        self.tool = tool_named(tool)
        self._simulator: Simulator | None = None
        self._track: deque[tuple[float, float, float, float]] = deque(maxlen=KEPT)
        self._started = time.monotonic()
        page.show_layer(layer)
        self._lay_out(tool)
        self._hold()
        self._answering = LatestWins(self._answer, page.say, "answering")
        page.say(f"Preparing {method.name} ...")
        self.lift()

    def _lay_out(self, tool: str) -> None:
        gui = self.page.server.gui
        self.gizmo = self.page.server.scene.add_transform_controls("/hand", GIZMO, line_width=3.0, depth_test=False)
        self.gizmo.on_update(self._on_drag)
        with self.page.controls:
            names = tuple(dict.fromkeys((*TOOLS, _label(tool))))
            self._tool = gui.add_dropdown("Tool", names, initial_value=_label(tool))
            self._upload = gui.add_upload_button("Your own mesh, in metres", mime_type=".stl,.obj,.ply,.glb,.off")
            gui.add_markdown("Drag the arrows at the tool's end, or push it along its axis:")
            self._push = gui.add_button_group("Push [mm]", (OFF, *NUDGES))
            self.judge = Judge(self.page, lambda before, judged: None)
        self.page.controls.label, self.page.controls.visible = "Your hand on the tool", True
        self._known = {_label(tool): self.tool}
        self._tool.on_update(lambda _: self.pick(self._tool.value))
        self._upload.on_upload(lambda _: self.take(self._upload.value.name, self._upload.value.content))
        self._push.on_click(lambda event: self._nudge(event.target.value))

    @property
    def pose(self) -> Transform:
        """Where the tool is: pose_body_from_tool, (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = transforms.SO3(self.gizmo.wxyz).as_matrix()
        pose[:3, 3] = self.gizmo.position - self._grip * pose[:3, 2]
        return pose

    def move_to(self, pose: Transform) -> None:
        """Puts the tool at pose_body_from_tool and answers it."""
        self.gizmo.wxyz = np.array(wxyz_of(pose))
        self.gizmo.position = pose[:3, 3] + self._grip * pose[:3, 2]
        self._ask()

    def push(self, distance: float) -> None:
        """Moves the tool by `distance` [m] along its own -z, which points into the skin."""
        pose = self.pose
        pose[:3, 3] -= distance * pose[:3, 2]
        self.move_to(pose)

    def lift(self) -> None:
        """Holds the tool off the skin, where it was at first."""
        self.move_to(place_on(self.layer, self.tool.vertices))

    def pick(self, name: str) -> None:
        """Takes another tool, and holds it off the skin; says why if there is none."""
        try:
            if name not in self._known:
                self._known[name] = tool_named(name)
        except StmplError as error:
            return self.page.say(str(error))
        self.tool = self._known[name]
        self._hold()
        self.page.say("")
        self.lift()

    def take(self, name: str, content: bytes) -> None:
        """Takes the tool in a mesh file; says why if it is none."""
        try:
            self._known[name] = tool_from_bytes(name, content)
        except StmplError as error:
            return self.page.say(str(error))
        self._tool.options = (*TOOLS, *(known for known in self._known if known not in TOOLS))
        self._tool.value = name
        self.pick(name)

    def _nudge(self, button: str) -> None:
        if button == OFF:
            self.lift()
        else:
            self.push(NUDGES[button])

    def _hold(self) -> None:
        """Fixes the tool's surface to the gizmo, which sits at the end that looks away from the skin."""
        self._grip = float(self.tool.vertices[:, 2].max()) + GRIP
        surface = self.page.add_tool("/hand/surface", self.tool)  # replaces what has that name
        surface.position = np.array([0.0, 0.0, -self._grip])

    def wait(self, timeout: float) -> bool:
        """Waits until the newest pose is answered; False if that takes longer than `timeout` [s]."""
        return self._answering.wait(timeout)

    def close(self) -> None:
        """Ends its threads."""
        self._answering.close()
        self.judge.close()

    async def _on_drag(self, _event: viser.TransformControlsEvent) -> None:
        self._ask()

    def _ask(self) -> None:
        self._answering.put(Asked(self.tool, self.pose, time.perf_counter()))

    def _answer(self, asked: Asked) -> None:
        if self._simulator is None:  # nobody waits for what is prepared once
            self._simulator = Simulator(self.layer, self._method)
            self.page.say("")
            asked = replace(asked, at=time.perf_counter())
        started = time.perf_counter()
        try:
            contact = Contact(asked.tool, asked.pose)
            self._simulator.tools.field(asked.tool)
            started = time.perf_counter()
            answer = self._simulator.step([contact])
        except InvalidInput as error:
            return self.page.say(f"This tool cannot press: {error}")
        ended = time.perf_counter()
        now = time.monotonic() - self._started
        snapshot = Snapshot(now, answer, (contact,), readings_of(answer), ended - started, ended - asked.at)
        self._track.append((now, snapshot.force, snapshot.depth, snapshot.peak))
        self.page.show(snapshot)
        self.page.plot(tuple(self._track))


def _label(tool: str) -> str:
    """How a tool is called in the list: its name, `letter X`, or its file's name."""
    if tool in TOOLS:
        return tool
    return f"letter {tool.upper()}" if len(tool) == 1 else Path(tool).name
