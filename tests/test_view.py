"""The viewer: what is shown is what the simulator, the bag or the node answered, and a real browser shows it."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fem_tools import RigidFem
from stmpl_core import Contact
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.methods import Linear, Winkler
from stmpl_core.simulator import Simulator
from stmpl_core.touch import Answer
from stmpl_core.trust import Trust
from stmpl_ros.cli import main
from stmpl_ros.latest import LatestWins
from stmpl_ros.view.fields import FIELDS, STOPS, round_up
from stmpl_ros.view.hands_on import HandsOn
from stmpl_ros.view.page import Page
from stmpl_ros.view.recording import Recording, RecordingPlayer
from stmpl_ros.view.skin import glb
from stmpl_ros.view.snapshot import Gauge, Snapshot
from stmpl_ros.view.tools import TOOLS, place_on, tool_from_bytes, tool_named
from tests.bag_scene import tube, write_run
from tests.scenes import STACK, limb

PATIENCE = 120.0  # s to wait for anything; only a failing test waits so long
LAYOUT = Path(__file__).parents[1] / "stmpl_ros/foxglove/stmpl.json"


def moved(peak: float, trust: Trust | None = None) -> Snapshot:
    """Three vertices of which the last moves by `peak` [m]."""
    displacement = np.zeros((3, 3))
    displacement[2, 1] = -peak
    return Snapshot(0.0, Answer(displacement, trust or Trust(), "none"))


def shown_on(page: Page) -> Snapshot:
    """What a page shows."""
    assert page.snapshot is not None
    return page.snapshot


@contextmanager
def opened(title: str = "test"):
    page = Page("127.0.0.1", 0, title)
    try:
        yield page
    finally:
        page.close()


@pytest.mark.parametrize("host", ["300.1.1.1", "192.0.2.1"], ids=["no address", "another machine's"])
def test_an_address_that_is_none_of_this_machine_is_refused(host):
    with pytest.raises(InvalidInput, match="nothing can be served"):
        Page(host, 0, "test")


@pytest.fixture(scope="module")
def layer():
    return limb(5e-3)


@pytest.fixture
def hand(layer):
    with opened() as page:
        made = HandsOn(page, layer, Winkler(), "ball")
        assert made.wait(PATIENCE)
        yield made
        made.close()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("run"), Linear(), layer=tube(8e-3))


@pytest.fixture(scope="module")
def recording(run):
    return Recording.of(run, 12)


# Colours


@pytest.mark.parametrize(("value", "top"), [(0.0, 0.0), (1.0, 1.0), (1.01, 2.0), (0.03, 0.05), (7.0, 10.0)])
def test_a_scale_ends_at_the_next_of_1_2_5(value, top):
    assert round_up(value) == pytest.approx(top)


def test_rest_has_the_first_colour_and_the_end_of_the_scale_the_last():
    field = FIELDS["displacement"]
    colours = field.paint(moved(2e-3), 2.0)
    np.testing.assert_array_equal(colours[:2], field.palette[[0, 0]])
    np.testing.assert_array_equal(colours[2], field.palette[STOPS - 1])
    assert field.top(moved(1.9e-3)) == 2.0


def test_what_is_not_known_is_drawn_as_rest_and_told():
    for name in ("pressure", "error against FEM"):
        field = FIELDS[name]
        assert field.values(moved(1e-3)) is None and field.absent
        np.testing.assert_array_equal(field.paint(moved(1e-3), 1.0), field.palette[[0, 0, 0]])


@pytest.mark.parametrize(("trust", "state"), [(Trust(), 1), (Trust(in_range=False), 2), (Trust(False, False), 3)])
def test_what_moves_shows_the_trust_of_the_answer(trust, state):
    np.testing.assert_array_equal(FIELDS["trust"].values(moved(1e-3, trust)), [0, 0, state])


def test_the_skin_that_is_sent_has_the_vertices_and_colours_that_were_given(layer):
    colours = np.random.default_rng(0).integers(0, 255, (len(layer.vertices), 4)).astype(np.uint8)
    file = trimesh.util.wrap_as_stream(glb(layer.vertices + 1e-3, layer, colours))
    (sent,) = trimesh.load(file, file_type="glb", process=False).geometry.values()
    np.testing.assert_allclose(sent.vertices, layer.vertices + 1e-3, atol=1e-7)
    np.testing.assert_array_equal(sent.faces, layer.faces)
    np.testing.assert_array_equal(sent.visual.vertex_attributes["color"], colours)


# The newest wins


def test_what_came_while_busy_is_overwritten_and_the_newest_is_worked_on():
    begun, go_on, seen = threading.Event(), threading.Event(), []

    def work(item):
        seen.append(item)
        begun.set()
        assert go_on.wait(PATIENCE)

    worker = LatestWins(work, seen.append, "test")
    worker.put(0)
    assert begun.wait(PATIENCE)
    for item in range(1, 6):
        worker.put(item)
    go_on.set()
    assert worker.wait(PATIENCE)
    worker.close()
    assert seen == [0, 5]


def test_an_error_is_told_and_the_work_goes_on():
    done, told = [], []

    def work(item):
        if item < 0:
            raise InvalidInput("negative")
        done.append(item)

    worker = LatestWins(work, told.append, "test")
    for item in (-1, 1):
        worker.put(item)
        assert worker.wait(PATIENCE)
    worker.close()
    assert (done, told) == ([1], ["negative"])


# Tools


@pytest.mark.parametrize("name", [*TOOLS, "k"])
def test_a_tool_stands_off_the_skin_and_touches_when_it_is_pushed(layer, name):
    tool = tool_named(name)
    pose, gauge = place_on(layer, tool.vertices), Gauge(layer)
    assert gauge.read([Contact(tool, pose)])[tool.name].force == 0
    pose[:3, 3] -= 8e-3 * pose[:3, 2]
    reading = gauge.read([Contact(tool, pose)])[tool.name]
    assert reading.force > 0 and 1e-3 < reading.depth < 5e-3


def test_the_gauge_reads_layered_limbs_too():
    layers = limb(8e-3, thickness=16e-3).with_(tissue=STACK)
    tool = tool_named("ball")
    pose, gauge = place_on(layers, tool.vertices), Gauge(layers)
    pose[:3, 3] -= 8e-3 * pose[:3, 2]
    assert gauge.read([Contact(tool, pose)])[tool.name].force > 0


def test_a_mesh_file_is_the_mesh_in_it(tmp_path):
    ball = tool_named("ball")
    file = tmp_path / "ball.stl"
    trimesh.Trimesh(ball.vertices, ball.faces).export(file)
    np.testing.assert_allclose(np.ptp(tool_named(str(file)).vertices, axis=0), np.ptp(ball.vertices, axis=0), rtol=1e-5)


@pytest.mark.parametrize("name", ["spoon", "no/such.stl", "?"])
def test_an_unknown_tool_is_refused_with_what_there_is(name):
    with pytest.raises(InvalidInput, match=r"fingertip|capital letters"):
        tool_named(name)


@pytest.mark.parametrize(("name", "content"), [("a.stl", b""), ("a.xyz1", b"1 2 3"), ("a.obj", b"not a mesh at all")])
def test_a_file_that_is_no_mesh_is_refused(name, content):
    with pytest.raises((InvalidInput, MeshError)):
        tool_from_bytes(name, content)


# A tool in the hand


def test_a_pushed_tool_is_answered_as_the_simulator_answers_it(hand, layer):
    hand.push(7e-3)
    assert hand.wait(PATIENCE)
    shown = shown_on(hand.page)
    expected = Simulator(layer, Winkler()).step([Contact(hand.tool, hand.pose)])
    np.testing.assert_array_equal(shown.answer.displacement, expected.displacement)
    assert shown.force == pytest.approx(expected.touches[hand.tool.name].force) and shown.force > 0
    assert shown.peak > 0 and shown.latency >= shown.solve_seconds > 0
    rows = dict(shown.rows())
    assert rows["reaction force"] == f"{shown.force:.3f} N" and rows["depth"].endswith(" mm")
    assert rows["why"] == expected.trust.why and rows["method"] == "winkler"


def test_pushing_further_presses_harder_and_letting_go_gives_exactly_zero(hand):
    forces = []
    for _ in range(4):
        hand.push(2e-3)
        assert hand.wait(PATIENCE)
        forces.append(shown_on(hand.page).force)
    assert forces == sorted(forces) and forces[-1] > 2 * forces[-2] > 0
    hand.lift()
    assert hand.wait(PATIENCE)
    assert shown_on(hand.page).force == 0 and not shown_on(hand.page).answer.displacement.any()


def test_where_the_hand_holds_the_tool_is_not_where_it_touches(hand):
    pose = place_on(hand.layer, hand.tool.vertices)
    hand.move_to(pose)
    np.testing.assert_allclose(hand.pose, pose, atol=1e-9)
    assert (hand.gizmo.position - pose[:3, 3]) @ pose[:3, 2] > hand.tool.vertices[:, 2].max()


def test_another_tool_presses_with_its_own_shape(hand):
    hand.pick("cylinder")
    hand.push(6e-3)
    assert hand.wait(PATIENCE)
    assert shown_on(hand.page).contacts[0].tool is hand.tool and shown_on(hand.page).force > 0


@pytest.mark.parametrize(("scale", "said"), [(15.0, "millimetres"), (0.0, "nothing to touch with")])
def test_a_mesh_that_cannot_press_is_told_on_the_page_and_the_next_one_works(hand, scale, said):
    hand.take("mine.ply", trimesh.Trimesh(scale * np.eye(3), [[0, 1, 2]], process=False).export(file_type="ply"))
    assert hand.wait(PATIENCE)
    assert said in hand.page.message
    hand.pick("ball")
    hand.push(7e-3)
    assert hand.wait(PATIENCE)
    assert shown_on(hand.page).force > 0 and not hand.page.message


def test_fem_of_an_instant_presses_the_same_tool_as_deep(hand, layer):
    hand.push(6e-3)
    assert hand.wait(PATIENCE)
    shown = shown_on(hand.page)
    hand.judge.judge()
    assert hand.judge.wait(PATIENCE)
    reference, error = shown_on(hand.page).reference, shown_on(hand.page).error
    assert shown.answer.pressure is not None and reference is not None and error is not None
    fem = RigidFem().prepare(layer)
    truth = fem.press(shown.contacts, shown.answer).displacement
    np.testing.assert_array_equal(reference.displacement, truth)
    np.testing.assert_allclose(error, np.linalg.norm(shown.answer.displacement - truth, axis=1), atol=1e-15)
    assert hand.page.field == "error against FEM" and error.max() > 0
    hand.push(-1e-4)
    assert hand.wait(PATIENCE) and hand.page.wait(PATIENCE)
    assert "FEM of this instant" in hand.page.message, "another instant has no FEM yet"


# A recording


def test_a_recording_holds_instants_from_its_first_answer_to_its_last(recording, run):
    whole = Recording.of(run, 1000)
    assert len(recording.snapshots) == 12 and len(whole.snapshots) == 40
    assert recording.snapshots[0].time == 0 and recording.seconds == whole.seconds == pytest.approx(0.39)
    assert np.all(np.diff([snapshot.time for snapshot in recording.snapshots]) > 0)
    assert recording.nearest(-1) == 0 and recording.nearest(99) == 11


def test_the_forces_of_a_recording_are_those_that_were_sent(recording):
    last = recording.snapshots[-1]
    assert {name: round(reading.force, 1) for name, reading in last.readings.items()} == {"ball": 0.4, "finger": 0.3}
    assert last.force == pytest.approx(0.4 + 0.3 * (3 * 39 / 40 - 2), rel=0.03)
    assert recording.snapshots[0].force == pytest.approx(0, abs=1e-6)


def test_the_player_opens_at_the_heaviest_instant_and_keeps_what_fem_said(recording):
    with opened() as page:
        player = RecordingPlayer(page, recording)
        heaviest = max(recording.snapshots, key=lambda snapshot: snapshot.force)
        assert shown_on(page) is heaviest
        player.judge.judge()
        assert player.judge.wait(PATIENCE)
        player.show(0.0)
        assert shown_on(page).time == 0 and shown_on(page).reference is None
        player.show(heaviest.time)
        error = shown_on(page).error
        assert error is not None and 0 < error.max() < heaviest.peak
        player.close()


def test_playing_goes_through_the_recording(recording):
    with opened() as page:
        player = RecordingPlayer(page, recording)
        player.show(0.0)
        seen = set()
        player.toggle()
        until = time.monotonic() + PATIENCE
        while len(seen) < 4 and time.monotonic() < until:
            seen.add(shown_on(page).time)
            time.sleep(0.01)
        player.toggle()
        player.close()
        assert len(seen) >= 4


@pytest.mark.parametrize(("arguments", "said"), [(("{}",), "no recording"), (("{}", "--live"), "not both"),
                                                  (("--tool", "spoon"), "fingertip")])  # fmt: skip
def test_what_cannot_be_shown_is_refused_before_anything_is_served(tmp_path, capsys, arguments, said):
    with pytest.raises(SystemExit) as ended:
        main(["view", *(argument.format(tmp_path) for argument in arguments)])
    told = capsys.readouterr()
    assert ended.value.code == 1 and said in told.err and "http" not in told.out


# The layout for Foxglove


def leaves(tree) -> list[str]:
    return [tree] if isinstance(tree, str) else leaves(tree["first"]) + leaves(tree["second"])


def test_every_panel_of_the_layout_is_placed_once_and_shows_a_topic_that_there_is():
    from geometry_msgs.msg import WrenchStamped
    from stmpl_msgs.msg import SkinDisplacement, Touch

    layout = json.loads(LAYOUT.read_text())
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    script = next(iter(layout["userNodes"].values()))["sourceCode"]
    topics = {"/skin/displacement": SkinDisplacement, "/tools/probe/wrench": WrenchStamped}
    of_lists = {"touches": Touch}
    paths = [series["value"] for panel in layout["configById"].values() for series in panel.get("paths", ())]
    assert len(paths) > 5
    for topic, _, fields in (path.partition(".") for path in paths):
        if topic == "/foxglove_script/stmpl":
            assert f'output = "{topic}"' in script and f"{fields}: number" in script
            continue
        value = topics[topic]()
        for field in fields.split("."):
            name, listed, _ = field.partition("[")
            value = getattr(value, name)
            value = of_lists[name]() if listed else value
        assert isinstance(value, bool | float | str)


def test_the_script_of_the_layout_reads_force_and_peak_as_we_do(tmp_path, recording):
    driver = pytest.importorskip("playwright._impl._driver", reason="its node runs the script")
    node = str(driver.compute_driver_executable()[0])
    script = next(iter(json.loads(LAYOUT.read_text())["userNodes"].values()))["sourceCode"]
    (tmp_path / "script.mts").write_text(script)
    snapshot, layer = recording.snapshots[-1], recording.layer
    stamp = {"sec": 5, "nsec": 0}
    topology = {"vertices": layer.vertices.ravel().tolist(), "triangles": layer.faces.ravel().tolist()}
    answer = {"header": {"stamp": stamp}, "displacement": snapshot.answer.displacement.ravel().tolist(),
              "pressure": snapshot.answer.pressure.tolist(), "solve_seconds": 0.002, "converged": True,
              "in_range": True}  # fmt: skip
    later = {"sec": 5, "nsec": 3_000_000}
    events = [{"topic": "/skin/topology", "message": topology, "receiveTime": stamp},
              {"topic": "/skin/displacement", "message": answer, "receiveTime": later}]  # fmt: skip
    (tmp_path / "events.json").write_text(json.dumps(events))
    (tmp_path / "main.mjs").write_text(
        'import script from "./script.mts"; import { readFileSync } from "fs";\n'
        'const events = JSON.parse(readFileSync(new URL("./events.json", import.meta.url), "utf8"));\n'
        "console.log(JSON.stringify(events.map((event) => script(event)).at(-1)));\n"
    )
    said = subprocess.run([node, str(tmp_path / "main.mjs")], capture_output=True, text=True, check=True).stdout
    readings = json.loads(said)
    assert readings["force_n"] == pytest.approx(snapshot.answer.pressure @ layer.vertex_areas, rel=1e-4)
    assert readings["peak_mm"] == pytest.approx(1e3 * snapshot.peak, rel=1e-4)
    assert readings["latency_ms"] == pytest.approx(3.0) and readings["solve_ms"] == 2.0 and readings["trusted"] == 1


# A real browser

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync"]  # fmt: skip


@pytest.fixture(scope="module")
def tab():
    """A tab of a real headless Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed; on Debian and Ubuntu: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 560})
        page.set_default_timeout(1e3 * PATIENCE)
        yield page
        browser.close()


def picture(tab) -> np.ndarray:
    """What the tab shows, (H, W, 3) uint8."""
    import imageio.v3 as imageio

    return imageio.imread(tab.screenshot())[:, :, :3]


def sight(tab) -> np.ndarray:
    """The part of the tab between the panels, below viser's note on software rendering."""
    seen = picture(tab)
    return seen[190:, 340 : seen.shape[1] - 340].astype(int)


def until(tab, done, what: str):
    """Waits until `done()` holds, and gives the browser time to draw."""
    end = time.monotonic() + PATIENCE
    while not (found := done()):
        assert time.monotonic() < end, f"waited {PATIENCE} s for {what}"
        tab.wait_for_timeout(200)
    return found


def ink(seen: np.ndarray) -> float:
    """Share of the pixels that are not white."""
    return float((seen.min(axis=-1) < 235).mean())


def bluish(seen: np.ndarray) -> float:
    """Share of the pixels whose blue is well above their red."""
    return float((seen[..., 2] - seen[..., 0] > 25).mean())


def test_a_browser_shows_the_recording_its_figures_and_the_error_against_fem(tab, recording):
    with opened("a recording") as page:
        player = RecordingPlayer(page, recording)
        tab.goto(page.url)
        tab.get_by_text("reaction force").wait_for()
        body = tab.locator("body").inner_text
        assert f"{shown_on(page).force:.3f} N" in body() and "displacement [mm]" in body()
        until(tab, lambda: ink(sight(tab)) > 0.1, "the skin")
        plain = bluish(sight(tab))
        tab.get_by_role("button", name="FEM of this instant").click()
        tab.get_by_text("error against FEM [mm]").wait_for()
        assert player.judge.wait(PATIENCE)
        until(tab, lambda: bluish(sight(tab)) > plain + 5e-3, "the error's colours")
        assert "error against FEM" in [box.input_value() for box in tab.locator("input").all()]
        player.close()


def test_a_browser_pushes_the_tool_and_sees_what_the_simulator_answers(tab, hand):
    tab.goto(hand.page.url)
    tab.get_by_text("reaction force").wait_for()
    until(tab, lambda: ink(sight(tab)) > 0.1, "the skin")
    for _ in range(6):
        tab.get_by_role("button", name="+1", exact=True).click()
    until(tab, lambda: shown_on(hand.page).force > 0 and hand.page.wait(PATIENCE), "an answer that presses")

    def told() -> bool:
        shown, text = shown_on(hand.page), tab.locator("body").inner_text()
        return f"{shown.peak * 1e3:.2f} mm" in text and f"{shown.force:.3f} N" in text

    until(tab, told, "the figures of the newest answer")


# The running node


def test_the_live_page_shows_the_answers_of_a_running_node():
    import rclpy

    from stmpl_ros.view.live import LiveNode
    from tests import bus
    from tests import test_ros as ros

    rclpy.init()
    process = None
    device = ros.Device()
    with opened("live") as page:
        live = LiveNode(page, patience=0.5)

        def wait(done, what):
            return bus.wait_for(done, what, live, device.node)

        try:
            wait(lambda: "stmpl node" in page.message, "word that no node is there")
            process = bus.start("-c", ros.NODE)
            wait(lambda: page.layer is not None, "the skin")
            wait(lambda: device.pose.get_subscription_count() >= 2, "node and page to listen to the tool")
            wait(lambda: device.send(ros.TOUCH, 0.03) and page.snapshot, "an answer")
            wait(lambda: device.send(ros.TOUCH, 0.03) and shown_on(page).force == pytest.approx(0.03, rel=0.02),
                 "an answer to pose and wrench")  # fmt: skip
            shown = shown_on(page)
            assert 0.5e-3 < shown.depth < 3e-3, "as deep as its wrench presses"
            assert shown.contacts[0].tool.vertices.shape == ros.ball().vertices.shape
            assert {name: touch.status for name, touch in shown.answer.touches.items()} == {"probe": "touching"}
            assert shown.solve_seconds > 0
        finally:
            live.close()
            if process is not None:
                code, said = bus.end(process, signal.SIGTERM)
            device.node.destroy_node()
            rclpy.shutdown()
    assert code == 0, said
