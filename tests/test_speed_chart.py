"""The chart of speed against accuracy: every point measured, the front right, failures shown, the pictures there."""

import math
import time
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from fem_tools import PatchFem
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Linear, Winkler
from stmpl_core.trust import Displacement, Trust
from studies.chart import CURVES, Chart, Curve, Point, measure
from studies.chart.break_even import break_even, core_hours, draw_break_even
from studies.chart.measure import Preset, contact
from studies.chart.page import write_page
from studies.chart.picture import draw

SMALL = Preset(edge_length=8e-3, part="left_forearm", ratios=(0.3,), scenes=("disc", "disc on the seam"), seconds=0.02)


class Refuses:
    """A method that takes no layer."""

    name = "refuses"

    def prepare(self, layer):
        raise InvalidInput("it takes no layer")


class Stuck(Linear):
    """A method that does not converge."""

    def solve(self, load):
        answer = super().solve(load)
        return Displacement(answer.displacement, Trust(converged=False, why="stuck"), self.name)


class Compiles(Winkler):
    """A method whose first solve takes half a second longer than the others."""

    def solve(self, load):
        time.sleep(0.0 if hasattr(self, "compiled") else 0.5)
        self.compiled = True
        return super().solve(load)


@pytest.fixture(scope="module")
def chart() -> Chart:
    curves = (
        Curve("Winkler", "-", (("-", Winkler),)),
        Curve("reference", "-", (("-", PatchFem),), fast=False),
        Curve("refuses", "-", (("-", Refuses),)),
        Curve("stuck", "-", (("-", Stuck),)),
        Curve("compiles", "-", (("-", Compiles),)),
        Curve("a peer", "-", (("-", Winkler),), extra="no_such_package"),
    )
    return measure(SMALL, curves, reference=PatchFem())


def test_a_run_that_was_stopped_goes_on(tmp_path):
    def stop(done, total, what):
        if what.startswith("Linear"):
            raise KeyboardInterrupt

    curves = tuple(Curve(name, "-", (("-", make),)) for name, make in (("Winkler", Winkler), ("Linear", Linear)))
    with pytest.raises(KeyboardInterrupt):
        measure(SMALL, curves, reference=PatchFem(), parts=tmp_path, on_progress=stop)
    seen = []
    whole = measure(SMALL, curves, parts=tmp_path, reference=PatchFem(), on_progress=lambda *a: seen.append(a[2]))
    assert len(whole.points) == 4 and not [what for what in seen if what.startswith("Winkler")]


def test_every_step_is_measured_on_every_scene_and_what_is_not_installed_is_named(chart):
    assert len(chart.points) == 5 * 2 and chart.about["missing"] == ["a peer (no no_such_package)"]
    for point in chart.points:
        if point.curve == "reference":
            assert point.error < 1e-4 and point.largest < 1e-3 and point.seconds > 0 and not point.failed
        if point.curve == "Winkler":
            assert 0.02 < point.error < 0.8 and not math.isnan(point.contact) and not point.failed
            assert point.error <= point.largest
        if point.curve == "compiles":
            assert point.seconds < 0.1  # what compiles is paid once


def test_what_fails_is_a_point_that_says_why(chart):
    said = {p.curve: p.why for p in chart.points if p.failed}
    assert said == {"refuses": "it takes no layer", "stuck": "stuck"}
    assert all(math.isnan(p.error) for p in chart.points if p.curve == "refuses")


def test_a_disc_on_the_seam_is_on_it_and_the_other_is_not():
    layer = Body.anny().part(SMALL.part, edge_length=SMALL.edge_length)
    seam = set(layer.chart.seam_vertices.tolist())
    on, off = (set(np.flatnonzero(contact(name, layer).footprint).tolist()) for name in ("disc on the seam", "disc"))
    assert on & seam and not off & seam


def test_the_front_holds_what_nothing_beats():
    def point(seconds, error, **more):
        return Point("m", "-", "disc", 0.3, seconds, error=error, failed=False, **more)

    a, b, c, d = point(1e-3, 0.5), point(2e-3, 0.1), point(3e-3, 0.2), point(4e-3, 0.05)
    failed, zero = replace(point(1e-4, 0.01), failed=True), replace(point(1e-5, 1.0), curve="zero")
    assert Chart((d, c, failed, b, a, zero)).front("disc", 0.3) == [a, b, d]
    assert Chart((a,)).front("letter", 0.3) == []


def test_a_network_breaks_even_against_the_cheapest_equal_solver():
    def point(curve, seconds, error, scene="disc"):
        return Point(curve, "the layer's own mesh", scene, 0.3, seconds, error=error, failed=False)

    chart = Chart((
        point("MomentNet", 1e-3, 0.02), point("PatchFem, mesh", 0.011, 0.02), point("PatchFem, mesh", 0.5, 0.01),
        point("PatchFem, patch", 0.002, 0.3), point("MomentNet", 1e-3, 0.001, "letter"),
    ))  # fmt: skip
    disc, letter = break_even(chart)
    assert disc.solver is not None and disc.solver.seconds == 0.011
    assert disc.solves == pytest.approx(3600 * core_hours() / 0.010)
    assert letter.solver is None and math.isnan(letter.solves)


def test_a_chart_is_kept_drawn_and_put_on_a_page(chart, tmp_path):
    chart.save(tmp_path / "chart.json")
    again = Chart.load(tmp_path / "chart.json")
    assert str(again.points) == str(chart.points) and again.about == chart.about
    assert Image.open(draw(again, tmp_path / "chart.png")).size[0] > 400
    assert Image.open(draw_break_even(break_even(again), tmp_path / "even.png")).size[0] > 400
    page = write_page(again, tmp_path / "chart.html").read_text()
    assert page.count("<svg") == 2 and page.count("<circle") == 6 and "it takes no layer" in page
    assert "http" not in page.replace("http-equiv", ""), "it needs nothing else"
    for panel in page.split("<figure>")[1:]:
        ET.fromstring(_quoted(panel.split("</figure>")[0]))
    (tmp_path / "broken.json").write_text("[]")
    with pytest.raises(InvalidInput, match="no chart"):
        Chart.load(tmp_path / "broken.json")


def _quoted(svg: str) -> str:
    """HTML allows attributes without quotes, XML does not."""
    import re

    return re.sub(r'=([^"\s>/]+)(?=[\s/>])', r'="\1"', svg)


def test_the_shipped_curves_have_names_of_their_own_and_knobs_that_differ():
    assert len({curve.name for curve in CURVES}) == len(CURVES)
    for curve in CURVES:
        assert len({knob for knob, _ in curve.steps}) == len(curve.steps) > 0
