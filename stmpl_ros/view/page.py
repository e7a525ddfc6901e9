"""Page: what the browser shows of a snapshot: the skin, the tools, the figures, a colour bar and two plots."""

from __future__ import annotations

import html
import socket
from collections.abc import Sequence
from time import sleep

import numpy as np
import viser
from viser import uplot

from bags.wire import quaternion_from
from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.posing import posed
from stmpl_core.tool import Tool
from stmpl_ros.latest import LatestWins
from stmpl_ros.view.fields import FIELDS
from stmpl_ros.view.skin import Skin
from stmpl_ros.view.snapshot import MM, Snapshot, joints_of
from stmpl_ros.view.tools import place_on

STEEL = (107, 118, 131)
PLOT_EVERY = 0.2  # time between two updates of the plots [s]
CAMERA_DISTANCE_M = 0.25  # distance of the camera from the skin at first
WIDTH, PLOT = 330, 150  # pixels: width of the panels, height of a plot
WARNING = "color:#b3261e;font-weight:600"
SCALES = {"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)}
FORCE, DEPTH, PEAK, NOW = "#c1440e", "#1f4e79", "#f7b267", "#2b2b2b"
Track = Sequence[tuple[float, float, float, float]]  # time [s], force [N], depth [m], peak displacement [m]


class Page:
    """A served page. Every method may be called from any thread; drawing is done in a thread of the page's own.

    Args:
        host, port: address and port to serve on; the next free port is taken.
        title: title of the page, a few words.

    Raises:
        InvalidInput: an address that is none of this machine's.
    """

    def __init__(self, host: str, port: int, title: str) -> None:
        try:
            family, kind, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as trial:
                trial.bind(place)
        except OSError as error:  # the server would wait for it without a word
            raise InvalidInput(f"nothing can be served on {host!r}: {error.strerror}. Try 127.0.0.1.") from None
        self.server = viser.ViserServer(host=host, port=port, label="stmpl", verbose=False)
        self.layer: SoftLayer | None = None
        self.snapshot: Snapshot | None = None
        self._skin: Skin | None = None
        self._tops: dict[str, float] = {}
        self._tools: dict[str, tuple[Tool, viser.MeshHandle]] = {}
        self._lay_out(title)
        self._drawing = LatestWins(self._draw, self.say, "drawing")
        self._plotting = LatestWins(self._plot, self.say, "plotting")

    def _lay_out(self, title: str) -> None:
        server, gui = self.server, self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(193, 68, 14))
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(cast_shadow=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        readings = gui.add_panel()
        with readings.add_tab("Readings"):
            self._lay_out_readings()
        readings.dock_left()
        readings.set_width(WIDTH)
        gui.add_markdown(f"**{title}**")
        self._message = gui.add_markdown("", visible=False)
        self.controls = gui.add_folder("Controls", visible=False)
        self._field = gui.add_dropdown("Colour", tuple(FIELDS), initial_value="displacement")
        self._bar = gui.add_html("")
        self._rescale = gui.add_button("Fit the colour scale", hint="It grows by itself and shrinks when asked to.")
        self._rescale.on_click(lambda _: self._fit())
        self._field.on_update(lambda _: self._redraw())

    def _lay_out_readings(self) -> None:
        gui, axes = self.server.gui, (uplot.Axis(size=26), uplot.Axis(size=54))
        self._figures = gui.add_html("")
        self._force_plot = gui.add_uplot(
            (np.zeros(1), np.zeros(1), np.zeros(1)),
            (uplot.Series(label="t [s]"), uplot.Series(label="force [N]", stroke=FORCE, width=2),
             uplot.Series(label="here", stroke=NOW, width=1, points={"show": False})),
            scales=SCALES, axes=axes, height=PLOT, title="force [N] over time [s]",
        )  # fmt: skip
        self._depth_plot = gui.add_uplot(
            (np.zeros(1), np.zeros(1), np.zeros(1)),
            (uplot.Series(label="t [s]"), uplot.Series(label="depth [mm]", stroke=DEPTH, width=2),
             uplot.Series(label="peak [mm]", stroke=PEAK, width=2)),
            scales=SCALES, axes=axes, height=PLOT, title="depth of the tool, and peak displacement [mm]",
        )  # fmt: skip

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{self.server.get_port()}"

    @property
    def field(self) -> str:
        """Name in FIELDS by which the skin is coloured."""
        return self._field.value

    @field.setter
    def field(self, name: str) -> None:
        self._field.value = name
        self._redraw()

    @property
    def message(self) -> str:
        """Message above everything else; empty if there is none."""
        return self._message.content

    def show_layer(self, layer: SoftLayer) -> None:
        """Shows another layer, at first from where a tool would come."""
        if self._skin is not None:
            self._skin.remove()
        self.layer, self.snapshot, self._tops = layer, None, {}
        self._skin = Skin(self.server, layer)
        pose = place_on(layer, np.zeros((1, 3)), gap=0.0)
        self.look_at(pose[:3, 3], pose[:3, 2])

    def look_at(self, point: np.ndarray, normal: np.ndarray) -> None:
        """Points a new visitor's camera at a point of the skin (3,) [m] with the outward normal (3,), from aside."""
        up = np.array([0.0, 0.0, 1.0])
        aside = np.cross(up, normal)
        camera = self.server.initial_camera
        camera.fov, camera.near, camera.up = 0.7, 5e-3, up
        camera.look_at = point + 0.1 * CAMERA_DISTANCE_M * normal
        camera.position = point + CAMERA_DISTANCE_M * (0.55 * normal + 0.75 * aside + 0.4 * up)

    def show(self, snapshot: Snapshot) -> None:
        """Shows a snapshot, unless a newer one comes before there is time to."""
        self.snapshot = snapshot
        self._drawing.put(snapshot)

    def say(self, message: str) -> None:
        """Shows a message above everything else; an empty one takes it away."""
        self._message.content, self._message.visible = message, bool(message)

    def plot(self, track: Track, now: float | None = None) -> None:
        """Draws force, depth and peak over time, the newest at most every PLOT_EVERY; `now` [s] marks one instant."""
        self._plotting.put((track, now))

    def show_tools(self, contacts: Sequence[Contact]) -> None:
        """Puts the tools where they are, and takes away those that are gone."""
        for name in set(self._tools) - {contact.name for contact in contacts}:
            self._tools.pop(name)[1].remove()
        for contact in contacts:
            known = self._tools.get(contact.name)
            if known is None or known[0] is not contact.tool:
                self._tools[contact.name] = contact.tool, self.add_tool(f"/tools/{contact.name}", contact.tool)
            handle = self._tools[contact.name][1]
            handle.wxyz, handle.position = wxyz_of(contact.pose_body_from_tool), contact.pose_body_from_tool[:3, 3]

    def add_tool(self, name: str, tool: Tool) -> viser.MeshHandle:
        """Adds the see-through surface of a tool to the scene."""
        return self.server.scene.add_mesh_simple(
            name, tool.vertices, tool.faces, color=STEEL, opacity=0.3, side="double", cast_shadow=False,
            receive_shadow=False, flat_shading=True,
        )  # fmt: skip

    def wait(self, timeout: float) -> bool:
        """Waits until everything is drawn; False if that takes longer than `timeout` [s]."""
        return self._drawing.wait(timeout)

    def close(self) -> None:
        """Stops serving."""
        self._drawing.close()
        self._plotting.close()
        self.server.stop()

    def _redraw(self) -> None:
        if self.snapshot is not None:
            self._drawing.put(self.snapshot)

    def _fit(self) -> None:
        self._tops.clear()
        self._redraw()

    def _plot(self, item: tuple[Track, float | None]) -> None:
        track, now = item
        time, force, depth, peak = np.array(track, dtype=np.float64).reshape(-1, 4).T
        marked = np.zeros(len(time))
        if now is not None and len(time):
            marked[int(np.abs(time - now).argmin())] = force.max()
        self._force_plot.data = (time, force, marked)
        self._depth_plot.data = (time, depth * MM, peak * MM)
        sleep(PLOT_EVERY)

    def _draw(self, snapshot: Snapshot) -> None:
        layer, skin = self.layer, self._skin
        if layer is None or skin is None or len(snapshot.answer.displacement) != len(layer.vertices):
            return
        field = FIELDS[self.field]
        top = self._tops[field.name] = max(field.top(snapshot), self._tops.get(field.name, 0.0))
        absent = field.values(snapshot) is None
        bar = "" if absent else field.bar(top)
        if self._bar.content != bar:
            self._bar.content = bar
        if absent or self._message.content in {f.absent for f in FIELDS.values()}:
            self.say(field.absent if absent else "")
        self._figures.content = table(snapshot.rows(), loud=() if snapshot.answer.trust.ok else ("trust",))
        here = posed(layer, joints_of(snapshot.answer)).vertices
        skin.show(here + snapshot.answer.displacement, field.paint(snapshot, top))


def wxyz_of(pose: Transform) -> tuple[float, float, float, float]:
    """The quaternion of a pose, scalar first as viser wants it."""
    x, y, z, w = quaternion_from(pose[:3, :3])
    return w, x, y, z


def table(rows: Sequence[tuple[str, str]], loud: Sequence[str] = ()) -> str:
    """Names and values as an HTML table; the values of the names in `loud` stand out."""
    cells = "".join(
        f'<tr><td style="color:#777;vertical-align:top;white-space:nowrap;padding-right:1em">{html.escape(name)}</td>'
        f'<td style="{WARNING if name in loud else ""}">{html.escape(value)}</td></tr>'
        for name, value in rows
    )
    return f'<table style="font-size:.85em;line-height:1.35;margin:.2em .8em">{cells}</table>'

