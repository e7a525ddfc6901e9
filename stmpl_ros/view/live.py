"""Live: listens to a node's topics and shows the newest answer."""

from __future__ import annotations

import time
from collections import deque
from functools import partial

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from stmpl_msgs.msg import ContactMesh, SkinDisplacement, SkinTopology

from bags.wire import contact_from, frame_from, layer_from, stamp_ns, tool_from
from stmpl_core.contact import Contact
from stmpl_core.errors import StmplError
from stmpl_core.tool import Tool
from stmpl_ros.latest import LatestWins
from stmpl_ros.topics import KEPT, NEWEST
from stmpl_ros.view.judge import Judge
from stmpl_ros.view.page import Page
from stmpl_ros.view.snapshot import Snapshot, readings_of

REMEMBERED = 256  # number of poses and wrenches of a tool that an answer may still name
TRACK = 3000  # number of answers that the plots go back
SHOWN_EVERY = 0.05  # time between two answers that are read [s]; a node may send hundreds a second
NANO = 1e-9  # seconds in a nanosecond


class LiveNode(Node):
    """Shows on a page what a node answers; poses, wrenches and meshes are heard as the node hears them.

    Args:
        page: page that shows it.
        patience: silence after which the page says so [s].
    """

    def __init__(self, page: Page, patience: float) -> None:
        super().__init__("view")
        self.page, self.patience = page, patience
        self._layer_id, self._frame = "", ""
        self._tools: dict[str, Tool] = {}
        self._heard: dict[tuple[str, str], deque[tuple[int, PoseStamped | WrenchStamped]]] = {}
        self._track: deque[tuple[float, float, float, float]] = deque(maxlen=TRACK)
        self._first, self._read = 0, 0.0
        self._came = time.monotonic()
        gui = page.server.gui
        with page.controls:
            self.hold = gui.add_checkbox("Hold this instant", False)
            self.judge = Judge(page, lambda before, judged: setattr(self.hold, "value", True))
        page.controls.label, page.controls.visible = "Live", True
        page.say("Waiting for `skin/topology` ...")
        self._showing = LatestWins(self._show, page.say, "showing")
        self.create_subscription(SkinTopology, "skin/topology", self._on_topology, KEPT)
        self.create_subscription(ContactMesh, "contact_mesh", self._on_mesh, KEPT)
        self.create_subscription(SkinDisplacement, "skin/displacement", self._on_displacement, NEWEST)
        self.create_timer(1.0, self._complain)

    def close(self) -> None:
        """Ends its threads, and the node."""
        self._showing.close()
        self.judge.close()
        self.destroy_node()

    def _on_topology(self, message: SkinTopology) -> None:
        try:
            layer = layer_from(message)
        except StmplError as error:
            return self.page.say(f"The node's skin cannot be shown: {error}")
        self.page.show_layer(layer)
        self._layer_id, self._frame = message.layer_id, message.header.frame_id
        self._came = time.monotonic()
        self.page.say("The skin is here. Waiting for a tool to touch it ...")

    def _on_mesh(self, message: ContactMesh) -> None:
        name = message.header.frame_id
        if not len(message.triangles):
            self._tools.pop(name, None)
            return
        try:
            tool = tool_from(message)
        except StmplError as error:
            return self.page.say(f"The mesh of {name} cannot be shown: {error}")
        if (name, "pose") not in self._heard:
            for kind, of in (("pose", PoseStamped), ("wrench", WrenchStamped)):
                heard = self._heard[name, kind] = deque(maxlen=REMEMBERED)
                self.create_subscription(of, f"tools/{name}/{kind}", partial(self._on_input, heard), NEWEST)
        self._tools[name] = tool

    @staticmethod
    def _on_input(heard: deque, message: PoseStamped | WrenchStamped) -> None:
        heard.append((stamp_ns(message), message))

    def _on_displacement(self, message: SkinDisplacement) -> None:
        self._came = now = time.monotonic()
        if message.layer_id == self._layer_id and now - self._read >= SHOWN_EVERY and not self.hold.value:
            self._read = now
            self._showing.put((message, self.get_clock().now().nanoseconds))

    def _show(self, item: tuple[SkinDisplacement, int]) -> None:
        message, received = item
        frame = frame_from(message, received)
        contacts = [c for tool, stamps in frame.inputs.items() if (c := self._contact(tool, *stamps)) is not None]
        self._first = self._first or frame.stamp_ns
        snapshot = Snapshot((frame.stamp_ns - self._first) * NANO, frame, tuple(contacts), readings_of(frame),
                            frame.solve_seconds, (received - frame.stamp_ns) * NANO)  # fmt: skip
        self._track.append((snapshot.time, snapshot.force, snapshot.depth, snapshot.peak))
        self.page.say("")
        self.page.show_tools(contacts)
        self.page.show(snapshot)
        self.page.plot(tuple(self._track))

    def _contact(self, tool: str, posed: int, pushed: int) -> Contact | None:
        """A tool as the answer names it; None while its mesh or pose has not been heard."""
        pose = _newest(self._heard.get((tool, "pose")), posed)
        wrench = _newest(self._heard.get((tool, "wrench")), pushed) if pushed else None
        if pose is None or tool not in self._tools:
            return None
        return contact_from(self._tools[tool], pose, wrench, body_frame=self._frame)

    def _complain(self) -> None:
        silent = time.monotonic() - self._came
        if silent < self.patience or self.hold.value:
            return
        if not self._layer_id:
            self.page.say(f"No `skin/topology` for {silent:.0f} s. Is `stmpl node` running and active, on this "
                          "ROS_DOMAIN_ID and in this namespace?")  # fmt: skip
        else:
            self.page.say(f"No answer for {silent:.0f} s. The node answers when a tool sends its mesh and its pose: "
                          "`stmpl probe` does.")  # fmt: skip


def _newest(heard: deque | None, stamp: int):
    """The message of that stamp, or the newest there is; None if there is none."""
    if not heard:
        return None
    return next((message for known, message in reversed(heard) if known == stamp), heard[-1][1])
