"""Laws of the data: real footprints, splits by contact, the same plan the same samples, and none lost to a kill."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely

from fem_tools import PatchFem
from fem_tools.dataset import MOVES, QUANTUM, Dataset
from fem_tools.generate import generate
from fem_tools.hand import Hand
from fem_tools.sampling import PRESETS, TOOLS, Plan, contacts, draw, kinds_of, ratios, split_of, varying
from fem_tools.scenes import Site, UnusableContact, ellipse, letter, signed_distance
from stmpl_core import Load, SoftLayer
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from tests import scenes

TINY = PRESETS["tiny"]
OTHERS = ("ellipses", "seams", "fields", "indenters", "hands", "bands", "letters")
DISCS = TINY.model_copy(update=dict.fromkeys(OTHERS, 0))


@pytest.fixture(scope="module")
def limb() -> SoftLayer:
    return scenes.limb(3e-3, 6e-3, length=0.2)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "tiny"
    generate(TINY, out, workers=2)
    return out


def middle(layer: SoftLayer) -> int:
    return int(np.linalg.norm(layer.vertices - [0.04, 0, 0.1], axis=1).argmin())


@pytest.mark.parametrize("outline", [ellipse(0.012, 0.012), ellipse(0.016, 0.008), letter("H", 0.035)])
def test_a_footprint_weighs_as_much_as_its_outline_seen_along_the_tool(limb: SoftLayer, outline) -> None:
    scene = Site(limb).press_flat(middle(limb), outline, 0.7)
    along = -limb.vertex_area_vectors @ scene.pose_body_from_tool[:3, 2]
    assert -(scene.footprint @ along) == pytest.approx(outline.area, rel=0.06)


def test_covered_skin_lies_inside_the_tool_and_other_skin_outside(limb: SoftLayer) -> None:
    scene = Site(limb).press_flat(middle(limb), letter("S", 0.04), 0.3)
    away = signed_distance(scene.tool, scene.pose_body_from_tool, limb.vertices)
    assert (away[scene.covered] < 1e-9).all()
    facing = limb.normals @ scene.pose_body_from_tool[:3, 2] > 0.3
    assert (away[facing & ~scene.covered] > -1e-9).all()


def test_turning_the_limb_turns_the_footprint(limb: SoftLayer) -> None:
    angle = 2 * np.pi * 10 / round(2 * np.pi * 0.04 / 3e-3)  # ten columns on: the mesh falls on itself
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = SoftLayer(limb.vertices @ turn.T, limb.faces, limb.thickness)
    first, second = (Site(x).press_flat(middle(limb), letter("F", 0.03), 0.0).footprint for x in (limb, turned))
    assert first == pytest.approx(second, abs=1e-6)


def test_a_strap_goes_all_around_and_presses_towards_the_axis(limb: SoftLayer) -> None:
    scene = Site(limb).strap(middle(limb), 0.02, 0.0)
    angle = np.sort(np.arctan2(limb.vertices[scene.covered, 1], limb.vertices[scene.covered, 0]))
    assert np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < 0.1
    assert np.linalg.norm(scene.footprint @ limb.vertex_area_vectors) < 0.01 * (scene.footprint @ limb.vertex_areas)
    assert scene.footprint @ limb.vertex_areas == pytest.approx(2 * np.pi * 0.04 * 0.02, rel=0.06)


def test_a_hand_is_closed_and_its_grip_touches_from_opposite_sides() -> None:
    hand = Hand.of(Body.anny(weight=0.5))
    edges = np.sort(hand.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    limb = scenes.limb(5e-3, 6e-3, length=0.3)
    scene = Site(limb).grasp(
        int(np.linalg.norm(limb.vertices - [0.04, 0, 0.15], axis=1).argmin()), hand, 0.0, 4e-3, np.zeros(5)
    )
    around = np.arctan2(limb.vertices[scene.covered, 1], limb.vertices[scene.covered, 0])
    assert (np.abs(around) < 0.8).any() and (np.abs(around) > 1.6).any()
    entered = -signed_distance(scene.tool, scene.pose_body_from_tool, limb.vertices)
    assert 1e-3 < entered.max() < 0.015


def test_a_tool_that_does_not_fit_is_refused_and_says_why(limb: SoftLayer) -> None:
    site, end = Site(limb), int(limb.border[0])
    with pytest.raises(UnusableContact, match="open border"):
        site.press_flat(end, ellipse(0.01, 0.01), 0.0)
    with pytest.raises(UnusableContact, match=r"falls away by \d+ mm"):
        site.press_flat(middle(limb), ellipse(0.039, 0.039), 0.0)
    with pytest.raises(UnusableContact, match="fewer than 7"):
        site.press_flat(middle(limb), ellipse(0.002, 0.002), 0.0)
    with pytest.raises(InvalidInput, match="draws nothing"):
        letter(" ", 0.03)


def test_several_loads_on_one_patch_are_answered_as_each_alone(limb: SoftLayer) -> None:
    footprint = Site(limb).press_flat(middle(limb), ellipse(0.01, 0.01), 0.0).footprint
    loads = [Load.pressure(p * footprint) for p in (100.0, 700.0, 1500.0)]
    fem = PatchFem(reach=4).prepare(limb)
    for load, answer in zip(loads, fem.solve_many(loads), strict=True):
        alone = fem.solve(load)
        assert answer.trust.ok
        assert np.abs(answer.displacement - alone.displacement).max() < 1e-4 * alone.magnitude.max()
    with pytest.raises(InvalidInput, match="same vertices"):
        list(fem.solve_many([loads[0], Load.pressure(np.ones(len(limb.vertices)))]))


@pytest.mark.parametrize("preset", ["tiny", "default", "paper"])
def test_splits_are_by_contact_and_of_the_stated_sizes(preset: str) -> None:
    plan = PRESETS[preset]
    every = list(contacts(plan))
    assert len(set(every)) == len(every)
    ordinary = [c for c in every if split_of(plan, c) not in ("ood", "held_out")]
    share = np.mean([split_of(plan, c) == "train" for c in ordinary])
    assert share == pytest.approx(0.8, abs=0.12 if preset == "tiny" else 0.01)
    assert all((split_of(plan, c) == "held_out") == plan.body(c.body).held_out for c in ordinary)
    outside = [c for c in every if split_of(plan, c) == "ood"]
    assert len(outside) == plan.hands + plan.bands + plan.letters


def test_the_presets_are_as_large_as_they_say() -> None:
    def samples(plan: Plan, split: str | None, *kinds: str) -> int:
        wanted = ("train", "val", "test") if split is None else (split,)
        some = [c for c in contacts(plan) if split_of(plan, c) in wanted]
        return plan.loads * sum(kind in kinds_of(plan, c) for c in some for kind in kinds)

    assert samples(PRESETS["paper"], None, "nodal") == 132_750  # five bodies of constant thickness, as the paper
    assert samples(PRESETS["default"], "train", "pressure", "nodal") >= 20_000
    assert samples(PRESETS["default"], "test", "pressure") >= 2_000
    judges = PRESETS["tables"]  # new contacts: none of the data that networks learn from, whatever its split
    assert samples(judges, "test", "nodal") >= 400
    assert judges.seed not in {plan.seed for plan in PRESETS.values() if plan is not judges}
    assert (PRESETS["default"].hands, PRESETS["default"].bands, PRESETS["default"].letters) == (395, 40, 273)


def test_loads_increase_and_stay_in_their_range() -> None:
    for kind, highest in (("pressure", 1.5), ("nodal", 0.4), ("indenter", 0.7)):
        drawn = ratios(PRESETS["paper"], kind, 10, np.random.default_rng(3))
        assert len(drawn) == 10 and drawn[0] > 0 and drawn[-1] <= highest
        assert all(a < b for a, b in pairwise(drawn))


def test_deep_presses_are_looked_at_where_they_are_deep() -> None:
    plan = PRESETS["tissue"]
    deep = [body for body in plan.bodies if body.shallowest]
    assert deep and all(set(body.tools or ()) < set(TOOLS) for body in deep)
    for body in deep:
        drawn = ratios(plan, "indenter", plan.loads, np.random.default_rng(4), body.shallowest)
        assert body.shallowest < drawn[0] and drawn[-1] <= plan.deepest
        assert all(a < b for a, b in pairwise(drawn))


def test_a_contact_draws_the_same_whoever_draws_it(limb: SoftLayer) -> None:
    contact = next(c for c in contacts(TINY) if c.set == "letter")
    first, second = (draw(PRESETS["tiny"], contact, Site(limb), None, contact.rng(0)) for _ in range(2))
    assert first[1] == second[1] and (first[0].footprint == second[0].footprint).all()
    other = draw(PRESETS["tiny"], contact, Site(limb), None, contact.rng(1))
    assert other[1] != first[1]


def test_varying_thickness_spans_its_bounds_smoothly(limb: SoftLayer) -> None:
    thickness = varying(limb.vertices, (2.5e-3, 12.5e-3), np.random.default_rng(0))
    assert (thickness.min(), thickness.max()) == pytest.approx((2.5e-3, 12.5e-3))
    ends = thickness[limb.edges]
    length = np.linalg.norm(np.diff(limb.vertices[limb.edges], axis=1)[:, 0], axis=1)
    assert (np.abs(ends[:, 1] - ends[:, 0]) / length).max() < 0.5


def test_every_sample_is_an_answer_of_fem_to_its_load(made: Path) -> None:
    data = Dataset.open(made)
    layer = next(iter(data.layers.values()))
    body = TINY.bodies[0]
    for kind, sets in (("pressure", ["disc"]), ("nodal", ["ellipse"]), ("pressure", ["hand"])):
        subset = data.split("ood" if sets == ["hand"] else "train", kind=kind, sets=sets)
        sample = subset[len(subset) - 1]
        refine = TINY.refine if kind == "pressure" else 0
        answer = PatchFem(reach=body.reach, refine=refine).prepare(layer).solve(sample.load)
        tolerance = MOVES + QUANTUM + 1e-3 * sample.info["peak_m"]
        assert np.abs(answer.displacement - sample.displacement).max() < tolerance
        assert np.linalg.norm(sample.displacement, axis=1).max() == pytest.approx(sample.info["peak_m"], rel=1e-4)


def test_samples_and_drops_account_for_every_load(made: Path) -> None:
    data = Dataset.open(made)
    asked = sum(TINY.loads_of(c.set) * len(kinds_of(TINY, c)) for c in contacts(TINY))
    assert len(data) + len(data.manifest["dropped"]) == asked
    assert all(drop["why"] for drop in data.manifest["dropped"])
    assert sum(len(data.split(s)) for s in ("train", "val", "test", "ood")) == len(data) > 0.8 * asked
    assert sum(data.manifest["counts"].values()) == len(data)


def test_no_contact_is_in_two_splits(made: Path) -> None:
    data, seen = Dataset.open(made), {}
    for split in ("train", "val", "test", "ood"):
        for sample in data.split(split):
            name = (sample.info["body"], sample.info["set"], sample.info["number"])
            assert seen.setdefault(name, split) == split
    for seam in data.split("train", kind="pressure", sets=["seam"]):
        assert np.isin(seam.layer.chart.seam_vertices, seam.load.loaded).any()


def test_more_load_presses_deeper(made: Path) -> None:
    data, by_contact = Dataset.open(made), {}
    for sample in data.split("train"):
        by_contact.setdefault((sample.info["kind"], sample.info["set"], sample.info["number"]), []).append(sample.info)
    for samples in by_contact.values():
        assert all(a["ratio"] < b["ratio"] and a["peak_m"] < b["peak_m"] for a, b in pairwise(samples))


def test_a_killed_run_goes_on_and_ends_with_the_same_data(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny"
    script = ("from fem_tools.generate import generate; from tests.test_data import DISCS\n"
              f"if __name__ == '__main__': generate(DISCS, {str(out)!r}, workers=1)")  # fmt: skip
    program = tmp_path / "run.py"
    program.write_text(script)
    process = subprocess.Popen([sys.executable, str(program)], start_new_session=True,
                               env=os.environ | {"PYTHONPATH": os.getcwd()})  # fmt: skip
    while len(list(out.glob("parts/*.npz"))) < 2 and process.poll() is None:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {p.name: p.stat().st_mtime_ns for p in out.glob("parts/*.npz")}
    assert 2 <= len(kept) < 5 and not json.loads((out / "manifest.json").read_text())["complete"]
    with pytest.raises(InvalidInput, match="not finished"):
        Dataset.open(out)
    started = []
    generate(DISCS, out, workers=1, on_progress=lambda done, *_: started.append(done))
    assert started[0] == len(kept) + 1
    assert_same(Dataset.open(out), Dataset.open(made))


def assert_same(some: Dataset, every: Dataset) -> None:
    """All of `some` is in `every`, number for number."""
    names = ("kind", "set", "number", "ratio")
    samples = [[s for split in ("train", "val", "test") for s in data.split(split)] for data in (some, every)]
    known = {tuple(s.info[n] for n in names): s for s in samples[1]}
    for sample in samples[0]:
        same = known[tuple(sample.info[n] for n in names)]
        assert sample.info | {"split": ""} == same.info | {"split": ""}
        assert (sample.displacement == same.displacement).all() and (sample.load.values == same.load.values).all()
    assert samples[0]


def test_another_plan_does_not_overwrite(made: Path) -> None:
    with pytest.raises(InvalidInput, match="another plan"):
        generate(TINY.model_copy(update={"seed": 1}), made, workers=1)
    assert generate(TINY, made)["complete"]  # done already: nothing to do


def test_a_dask_cluster_makes_the_same_data(made: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    plan = DISCS.model_copy(update={"discs": 2})
    settings = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None, "processes": False}
    with distributed.LocalCluster(**settings, protocol="tcp") as cluster:
        manifest = generate(plan, tmp_path / "dask", scheduler=cluster.scheduler_address)
    assert manifest["workers"].startswith("dask") and manifest["samples"] == 2 * 2 * plan.loads
    assert_same(Dataset.open(tmp_path / "dask"), Dataset.open(made))


def test_outlines_have_their_own_area() -> None:
    assert ellipse(0.01, 0.02).area == pytest.approx(np.pi * 2e-4, rel=1e-9)
    assert isinstance(letter("O", 0.03), shapely.Polygon) and len(letter("O", 0.03).interiors) == 1
    assert np.diff(np.reshape(letter("K", 0.03).bounds, (2, 2)), axis=0)[0, 1] == pytest.approx(0.03)


ENDING = """
import os, signal, sys, time
from fem_tools.generate import _executor
with _executor(1, None) as (pool, _):
    pool.submit(os.getpid).result()
    pool.submit(time.sleep, 3600)
    os._exit(3) if sys.argv[1] == "exit" else os.killpg(0, signal.SIGINT)
    time.sleep(3600)
"""


@pytest.mark.parametrize("how", ["exit", "ctrl-c"])
def test_workers_end_with_the_process_that_makes_data_and_say_nothing_of_ctrl_c(how):
    """A worker that stays would hold the output open, and `run` would wait for it."""
    ended = subprocess.run([sys.executable, "-c", ENDING, how], start_new_session=True, capture_output=True, text=True,
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), timeout=120)  # fmt: skip
    assert (ended.returncode == 3) == (how == "exit")
    assert ended.stderr.count("Traceback") == (how == "ctrl-c")
