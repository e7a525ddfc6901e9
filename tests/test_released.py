"""Laws of what is released of a data set, of presses into flat stacks, and of who is judged by them."""

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks import limbs
from fem_tools.axisymmetric import Flat, Profile
from fem_tools.contact_job import Part
from fem_tools.dataset import FIGURES, QUANTUM, Dataset, Record
from fem_tools.generate import _fewer_bodies, generate
from fem_tools.released import LEAST, STEPS, Released, write
from fem_tools.rounds import THICKNESS, Pressed, drawn, learnt, read_all, release, released, tissue_of
from fem_tools.sampling import PRESETS, ContactId, contacts, layers, split_of
from stmpl_core import Contact, Simulator
from stmpl_core.body import Body
from stmpl_core.contact_net import TURNED_FROM
from stmpl_core.errors import InvalidInput
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.networks import STACK_NODE
from stmpl_core.packed import stack_from_text
from studies.flat import flat_rows, plate, pressure_on
from tests.scenes import ball

TISSUE = PRESETS["tissue"]
BODY = next(b for b in TISSUE.bodies if b.name == "arm_20").model_copy(update={"edge_length": 9e-3, "reach": 3.0})
PLAN = TISSUE.model_copy(
    update={"preset": "few", "bodies": (BODY,), "tools": 1, "rounds": 1, "stacks": 1, "loads": 2, "deepest": 0.2,
            "indenter_step": 0.2}
)  # fmt: skip
BALL = Profile((0.0, 0.0), (0.0, 0.0), 0.01)
COARSE = 1.2e-2
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def press() -> Pressed:
    rounds = Flat(tissue_of(BODY), THICKNESS, fine=0.6).press(BALL, [2e-4, 1e-3])
    return Pressed(tissue_of(BODY), BALL, rounds)


def made_up(plan_layers: dict) -> list[tuple[ContactId, Part]]:
    """Two contacts of made-up numbers on a real limb: what is written must come back."""
    rng, out = np.random.default_rng(0), []
    for k in range(2):
        records = []
        for _ in range(2):
            moved = np.arange(5, 300, 3, dtype=np.int32)
            steps = np.round(rng.normal(size=(len(moved), 3)) * 1e5).astype(np.int32)
            records.append(Record("indenter", np.arange(20, 40, dtype=np.int32),
                                  rng.uniform(0, 1, 20).astype(np.float32), moved, steps, tuple(rng.uniform(0, 1, 6))))
        about = {"set": "tool", "number": k, "split": "test" if k else "train", "drawn": {"tool": "sphere"}}
        out.append((ContactId(next(iter(plan_layers)), "tool", k), Part(about, records, [], {})))
    return out


def test_what_is_written_comes_back_within_its_rounding(tmp_path: Path) -> None:
    made = layers(PLAN)
    parts, file = made_up(made), tmp_path / "some.npz"
    assert write(file, PLAN, made, parts) == 4
    again = Released(file)
    assert again.plan == PLAN and len(again) == 2
    for (name, part), (other, read) in zip(parts, again.parts(), strict=True):
        assert name == other and part.about == read.about
        for one, two in zip(part.records, read.records, strict=True):
            np.testing.assert_array_equal(one.loaded, two.loaded)
            np.testing.assert_allclose(one.values, two.values, rtol=1e-3, atol=1e-4)
            size = np.linalg.norm(one.steps, axis=1)
            np.testing.assert_array_equal(one.moved[size > LEAST * size.max()], two.moved)
            kept = one.steps[np.isin(one.moved, two.moved)]
            assert np.abs(kept - two.steps).max() <= 0.5 * size.max() / STEPS + 1
            assert one.figures == pytest.approx(two.figures)
    layer, other = made[BODY.name], again.layers[BODY.name]
    np.testing.assert_allclose(layer.vertices, other.vertices, atol=1e-7)
    np.testing.assert_array_equal(layer.faces, other.faces)
    assert other.tissue == layer.tissue
    only = list(again.samples("test"))
    assert len(only) == 2 and only[0].info["number"] == 1
    assert np.linalg.norm(only[0].displacement, axis=1).max() == pytest.approx(
        QUANTUM * np.linalg.norm(parts[1][1].records[0].steps, axis=1).max(), rel=2e-3)  # fmt: skip


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"\x00" * 100])
def test_a_file_that_is_none_is_refused_in_a_sentence(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(InvalidInput, match="holds no released contacts"):
        Released(tmp_path / "bad.npz")
    with pytest.raises(InvalidInput, match="holds no released contacts"):
        Released(tmp_path / "none.npz")


@pytest.mark.slow
def test_a_data_set_goes_on_from_released_contacts_and_holds_its_flat_presses(tmp_path: Path) -> None:
    made, file = layers(PLAN), tmp_path / "some.npz"
    (contact,) = contacts(PLAN)
    first = made_up(made)[:1]
    assert first[0][0] == contact  # so that nothing on the limb is left to solve
    write(file, PLAN, made, first)
    manifest = generate(PLAN, tmp_path / "out", workers=1, start=[file])
    assert manifest["samples"] == 2 and manifest["rounds"] == 2
    assert len(Dataset.open(tmp_path / "out")) == 2
    for k, press in enumerate(read_all(tmp_path / "out")):
        assert (press.tissue, press.tool) == drawn(PLAN, k)[:2] and len(press.rounds) == 2
    with pytest.raises(InvalidInput, match="another plan"):
        generate(PLAN.model_copy(update={"seed": 1}), tmp_path / "other", workers=1, start=file)
    more = PLAN.model_copy(update={"bodies": (BODY, BODY.model_copy(update={"name": "another", "weight": 0.8}))})
    assert _fewer_bodies(PLAN, more) and not _fewer_bodies(more, PLAN)


def test_the_files_that_ship_hold_contacts_of_the_plan_that_networks_learn_from() -> None:
    found = {}
    for name in ("limbs_v3.npz", "deep_v2.npz", "stout_v1.npz", "trunk_v1.npz", "thin_v1.npz"):
        some = Released(limbs.FILE.with_name(name))
        assert _fewer_bodies(some.plan, TISSUE)
        for contact, part in some.parts():
            assert part.about["split"] == split_of(TISSUE, contact)
            found[contact] = part
    assert set(found) <= set(contacts(TISSUE)) and len(found) > 620
    deep = [dict(zip(FIGURES, one.figures, strict=True)) for contact, part in found.items()
            if contact.body.startswith("deep_") for one in part.records]  # fmt: skip
    assert {b.name for b in TISSUE.bodies if b.name.startswith("deep_")} - {"deep_thigh"} <= {c.body for c in found}
    assert len(deep) > 480 and min(one["ratio"] for one in deep) > 0.45


def test_the_file_of_one_material_holds_the_whole_plan_of_contacts() -> None:
    plan, some = PRESETS["contacts"], Released(limbs.FILE.with_name("contacts_v1.npz"))
    assert some.plan == plan
    found = {contact for contact, part in some.parts() if part.about["split"] == split_of(plan, contact)}
    assert found <= set(contacts(plan)) and len(found) == len(some) > 0.99 * len(list(contacts(plan)))


def test_flat_presses_take_every_stack_that_is_learnt_from_and_no_other() -> None:
    bodies = learnt(TISSUE)
    assert {b.name for b in bodies} == {b.name for b in TISSUE.bodies if b.stack and not b.held_out}
    assert {drawn(TISSUE, k)[0] for k in range(TISSUE.rounds)} == {tissue_of(body) for body in bodies}
    for k in range(40):
        _, tool, depths = drawn(TISSUE, k)
        assert 0 < tool.rounding <= tool.width + 1e-12 and np.all(np.diff(depths) > 0)
        assert drawn(TISSUE, k)[1:] == (tool, depths)
    of_none = [drawn(TISSUE, TISSUE.rounds + k)[0] for k in range(TISSUE.stacks)]
    assert len(set(of_none)) == TISSUE.stacks and not {tissue_of(body) for body in bodies} & set(of_none)
    assert {len(one.deeper) for one in of_none} == {0, 1, 2, 3}
    assert any(one.skin is None for one in of_none) and any(one.skin and one.skin.tension == 0 for one in of_none)
    for tissue in of_none[:4]:
        assert Pressed.read(Pressed(tissue, BALL, []).write()) == Pressed(tissue, BALL, [])


def test_flat_presses_are_kept_in_a_small_file_and_not_pressed_again(press: Pressed, tmp_path: Path) -> None:
    file = tmp_path / "flat.npz"
    release([press, press], file)
    one, other = released(file)
    assert one.tissue == other.tissue == press.tissue and one.tool == press.tool
    assert len(one.rounds) == len(press.rounds)
    for kept, true in zip(other.rounds, press.rounds, strict=True):
        many = len(kept.radius)
        assert kept.depth == true.depth and kept.force == true.force
        np.testing.assert_allclose(kept.radius, true.radius[:many], atol=1e-4 * true.radius[many - 1])
        np.testing.assert_allclose(kept.carried, true.carried[:many], atol=2e-4 * true.force)
        assert abs(true.carried[many:] / true.force - 1).max(initial=0) < 2e-4
    with pytest.raises(InvalidInput, match="flat presses of another plan"):
        generate(PLAN, tmp_path / "out", workers=1, flat=file)
    with pytest.raises(InvalidInput, match="holds no flat presses"):
        released(tmp_path / "none.npz")
    (tmp_path / "rounds").mkdir()
    np.savez(tmp_path / "rounds" / "00000.npz", body=np.array("arm"), tool=np.zeros(5), depths=np.zeros(0))
    with pytest.raises(InvalidInput, match="flat presses that cannot be read"):
        read_all(tmp_path)
    known = released(limbs.FILE.with_name("rounds_v2.npz"))
    assert len(known) == TISSUE.rounds + TISSUE.stacks
    for k in (0, len(known) // 2, len(known) - 1):
        tissue, tool, depths = drawn(TISSUE, k)
        assert known[k].of(tissue, tool)
        assert np.allclose([each.depth for each in known[k].rounds], depths[: len(known[k].rounds)])


def test_a_plate_carries_what_the_rings_carry(press: Pressed) -> None:
    layer = plate(tissue_of(BODY), 0.02, 1.5e-3)
    for one in press.rounds:
        force = layer.tissue.youngs_modulus * float(pressure_on(layer, one) @ layer.vertex_areas)
        assert force == pytest.approx(one.force, rel=1e-3)
    assert layer.normals[len(layer.vertices) // 2] @ [0, 0, 1] > 0.999


def test_a_light_press_into_a_flat_stack_is_the_linear_layers(press: Pressed) -> None:
    rows = list(flat_rows(press))
    assert len(rows) == 2
    linear, true = ([float(getattr(r, v) @ getattr(r, a)) for r in rows] for v, a in
                    (("prior", "area"), ("true", "vertex_area")))  # fmt: skip
    assert linear[0] == pytest.approx(true[0], rel=0.08) and linear[1] < true[1]
    parts = STACK_NODE.split(rows[0].rows)
    for name in ("curvature", "curvature_over_strain", "given_way"):
        assert not parts[name].any()  # flat, and nothing to give way as a whole
    assert np.exp(parts["turned"]) == pytest.approx(TURNED_FROM, rel=1e-3) and parts["uneven"].max() < 1e-6


def test_a_law_of_ones_own_is_judged_like_ours(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The truth itself is off by nothing, half of it by half; and the file that ships can be read."""
    scene = next(limbs.pressed(Released(limbs.FILE).samples("held_out")))
    force, motion = scene.force, scene.sample.displacement
    assert limbs.off(scene, force, motion)[1:4] == (0, 0, 0)
    half = limbs.off(scene, 0.5 * force, 0.5 * motion)
    assert half.force == pytest.approx(-0.5) and half.worst == pytest.approx(0.5) and 0.05 < half.moves < 0.5
    laws = limbs.Laws(scene.sample.layer, {"yours": lambda layer, tool, pose, way: (0.9 * force, None)})
    found = laws.answers(scene)
    assert found["yours"].force == pytest.approx(-0.1) and np.isnan(found["yours"].worst)
    assert abs(found["moment_net"].force) < abs(found["elastic foundation"].force)
    given: list[Any] = [None, (3.0, None), (force, motion[:4]), (np.nan * force, None), (-force, None), 1 / 3]
    for answer in given:
        laws.others = {"yours": lambda *_, answer=answer: answer}
        one = laws.answers(scene)["yours"]
        assert (one.answered, one.force, one.worst) == (False, -1, 1) and "no answer to " in laws.refused["yours"][-1]
    assert limbs.table("both", {"yours": [one, found["yours"]]}).columns[1]._cells == ["1 of 2", "1"]
    known = [half._replace(truth=0.5 * limbs.KNOWN), half._replace(truth=2 * limbs.KNOWN)]
    assert limbs.table("known", {"yours": known}).columns[1]._cells == ["2", "1"]
    samples = list(islice(Released(limbs.FILE).samples("held_out"), 6))
    assert limbs.export(samples, tmp_path, ("held_out",)) == sum(one.info["set"] == "tool" for one in samples)
    told, layer = json.loads((tmp_path / "scenes.json").read_text()), scene.sample.layer
    written, limb = told["scenes"][0], told["limbs"][scene.sample.info["body"]]
    assert [one["judged"] for one in told["scenes"]].count(True) >= 2 and not written["judged"]  # it barely touches
    read = {name: trimesh.load(tmp_path / file, process=False)
            for name, file in (("skin", limb["skin"]), ("bone", limb["bone"]), ("tool", written["tool"]))}  # fmt: skip
    np.testing.assert_allclose(read["skin"].vertices, layer.vertices, atol=1e-7)  # type: ignore[union-attr]
    np.testing.assert_allclose(read["bone"].vertices, layer.inner_vertices, atol=1e-7)  # type: ignore[union-attr]
    np.testing.assert_allclose(np.load(tmp_path / written["motion_of_skin_m"]), motion, atol=1e-7)
    assert written["force_on_limb_N"] == pytest.approx(force.tolist())
    assert stack_from_text(json.dumps(limb["tissue"]))[0] == layer.tissue and read["tool"].volume > 0  # type: ignore[union-attr]
    limbs.export(samples, tmp_path, ("test",))
    assert not any(one["judged"] for one in json.loads((tmp_path / "scenes.json").read_text())["scenes"])


@pytest.mark.parametrize(("arguments", "says"), [
    (("--answers", f"{__file__}:COARSE"), "COARSE is no function"),
    (("--file", "/nonexistent.npz"), "/nonexistent.npz holds no released contacts"),
    (("--limbs", "backs", "--export", "/dev/null/x"), "Not a directory"),
])  # fmt: skip
def test_the_comparison_on_limbs_refuses_in_a_sentence(monkeypatch, capsys, arguments, says):
    monkeypatch.setattr("sys.argv", ["limbs", *arguments])
    with pytest.raises(SystemExit):
        limbs.main()
    assert says in capsys.readouterr().err


def test_scenes_are_written_of_the_limbs_that_are_asked_for(monkeypatch, tmp_path, capsys):
    bodies: set[str] = set()
    monkeypatch.setattr(limbs, "export", lambda samples, *_: len([bodies.add(one.info["body"]) for one in samples]))
    monkeypatch.setattr("sys.argv", ["limbs", "--limbs", "a forearm left out", "--export", str(tmp_path)])
    limbs.main()
    assert bodies and all(body.startswith("forearm") for body in bodies)


@pytest.mark.parametrize("bodies", [("back_18", "back_22"), ("living_upper_arm_3", "living_thigh")])
def test_the_bound_on_force_covers_backs_and_people(bodies: tuple[str, ...]) -> None:
    """Of people an upper arm and a thigh, which were missed most before the bound knew how even a limb is."""
    scenes = [one for split in ("test", "val") for one in Released(limbs.FILE).samples(split)
              if one.info["body"] in bodies and limbs.slant_of(one) <= limbs.STRAIGHT]  # fmt: skip
    made = {one.info["body"]: limbs.Laws(one.layer, {}) for one in scenes}
    off = []
    for one in limbs.pressed(scenes):
        laws = made[one.sample.info["body"]]
        if limbs.seen(one, laws.net) is not None:
            off.append(laws.answers(one)["moment_net"])
    covered = np.mean([abs(one.force) <= one.bound for one in off])
    assert len(off) >= 8 and covered >= 0.85
    assert max(one.bound for one in off) < 1.0  # and says something


def test_where_a_limb_is_unlike_its_median_the_bound_on_force_is_wider() -> None:
    layer = living(Body.anny(), "left_arm", edge_length=COARSE)
    simulator, median = Simulator(layer, MomentNet()), np.median(layer.thickness)
    inside = np.linalg.norm(layer.vertices[:, None] - layer.vertices[layer.border], axis=2).min(axis=1) > 0.06

    def stated(share: float) -> float:
        vertex = np.where(inside, np.abs(layer.thickness - share * median), 9).argmin()
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + (0.015 - 0.15 * layer.thickness[vertex]) * layer.normals[vertex]
        (touch,) = simulator.touch([Contact(ball(0.015), pose)])
        return touch.force_bound / touch.force

    bony, usual = stated(0.4), stated(1.0)
    assert bony > 1.4 * usual and usual < 0.3


def test_bodies_as_measured_have_what_people_have_there_and_are_no_average_ones() -> None:
    bodies = [b.model_copy(update={"edge_length": COARSE}) for b in TISSUE.bodies if b.tone]
    assert len(bodies) >= 6
    made = layers(TISSUE.model_copy(update={"bodies": tuple(bodies[:2])}))
    for body, layer in zip(bodies, made.values(), strict=False):
        assert body.part is not None and body.tone is not None
        its = living(Body.anny(weight=body.weight, gender=body.gender), body.part, body.tone, edge_length=COARSE)
        assert layer.tissue.deeper[0].youngs_modulus == its.tissue.deeper[0].youngs_modulus
        assert layer.tissue.deeper[0].depth == pytest.approx(its.tissue.deeper[0].depth, rel=0.1)
        assert np.median(layer.thickness) == pytest.approx(float(np.median(its.thickness)), rel=0.15)
        assert layer.ply_scale is not None and np.ptp(layer.ply_scale) > 0.2
        assert (body.weight, body.gender) != (0.5, 0.5)
