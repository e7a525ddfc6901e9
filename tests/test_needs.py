"""Laws of what a scene asks a model of tissue to have."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stmpl_core import Membrane, Ply, Prony, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import MAX_THICKNESS
from stmpl_core.living import read_model, read_tissue
from stmpl_core.needs import needs
from stmpl_core.regions import HELD_SKIN, region
from stmpl_core.relaxation import fades_under, series_of
from stmpl_core.stack import Misfit
from stmpl_ros.cli import main
from tests.scenes import plate

SKIN = Membrane(2e5, 1.5e-3, 20.0)
LIMB = Tissue(3e3, 0.45, skin=SKIN, deeper=(Ply(10e-3, 10e3, 0.45),))


def asked(tissue, radii=(5e-3, 40e-3), forces=(0.1, 2.0), *speeds, thickness=0.04, **more):
    return needs(tissue, radii, forces, speeds, thickness=thickness, **more)


def stmpl(capsys, *arguments):
    """Exit code of the command, what it printed, what it refused with."""
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


@pytest.mark.parametrize(
    "rung, tissue",
    [
        (0, Tissue(3e3, 0.45)),
        (0, Tissue(3e3, 0.45, deeper=(Ply(10e-3, 4e3, 0.45),))),
        (0, Tissue(3e3, 0.45, skin=Membrane(2e3, 1e-4))),  # a film as soft as what lies under it
        (1, LIMB),
        (2, Tissue(3e3, 0.45, skin=SKIN, deeper=(Ply(4e-3, 3e4, 0.45),))),  # little fat on a tense muscle
        (2, Tissue(1e5, 0.45, deeper=(Ply(2e-3, 3e3, 0.45),))),  # a thick skin as the first material
    ],
)
def test_the_rung_of_model_that_a_stack_needs(rung, tissue):
    found = asked(tissue)
    assert found.rung == rung and f"rung {rung}" in found.sentence
    assert found["muscle"].needed == (rung == 2) and (found.layer is None) == (rung == 2)
    assert found["skin"].needed == (rung > 0 and tissue.skin is not None)


def test_what_is_not_there_is_not_missed():
    found = asked(Tissue(3e3, 0.45))
    assert all((found[name].force, found[name].motion) == (0, 0) for name in ("skin", "tension", "muscle"))
    assert max(found.layer.misfit) < 1e-6 and found.layer.thickness == pytest.approx(0.04, rel=1e-3)


def test_without_skin_tension_or_muscle_a_limb_is_softer():
    found = asked(LIMB)
    assert found["skin"].force < found["tension"].force < 0 and found["muscle"].force < 0
    assert min(found[name].motion for name in ("skin", "tension", "muscle")) > 0.1


def test_what_vanishes_is_not_missed_in_proportion():
    off = [asked(Tissue(3e3, 0.45, skin=Membrane(e, 1e-6)))["skin"] for e in (1e5, 1e4)]  # kappa 8e-4, 8e-5
    assert off[0].motion < 0.01 and off[1].motion == pytest.approx(off[0].motion / 10, rel=0.1)


def test_a_force_beyond_the_linear_response_is_said_and_judged_where_it_ends():
    found = asked(LIMB, (20e-3,), (2.0, 50.0))
    light, heavy = found.indentations
    assert not light.beyond and light.judged.force == pytest.approx(2.0, rel=1e-4)
    assert heavy.beyond and heavy.judged.depth == pytest.approx(10e-3, rel=1e-4) and heavy.judged.force < 50
    assert heavy.stiffer == pytest.approx(0.75 ** (-2 * 1.18)) and 1 < light.stiffer < heavy.stiffer


def test_a_press_in_the_time_that_tissue_relaxes_needs_time():
    quick, usual, held, slow = (asked(LIMB, (20e-3,), (1.0,), speed, duration=stays) for speed, stays in
                                ((1.0, 0.0), (5e-3, 0.0), (5e-2, 10.0), (1e-6, 0.0)))  # fmt: skip
    assert [found.relaxing for found in (quick, usual, held, slow)] == [False, True, True, False]
    assert quick["time"].force < 0.01 and usual["time"].motion > 0.1 and held["time"].force > 0.15
    assert quick.moduli == usual.moduli == held.moduli == 1.0 and "relaxation in time" in held.sentence
    assert asked(LIMB)["time"].force is None and not asked(LIMB).relaxing


def test_a_scene_as_slow_as_tissue_relaxes_takes_a_share_of_the_moduli():
    found = asked(Tissue(3e3, 0.45), (20e-3,), (1.0,), 1e-7)
    assert found.moduli == pytest.approx(HELD_SKIN.relaxed, abs=3e-3) and "of its moduli" in found.sentence
    assert found["time"].force == pytest.approx(1 / HELD_SKIN.relaxed - 1, rel=0.01) and found["time"].motion < 0.01


def test_a_tissue_with_a_series_of_its_own_keeps_it():
    quick = replace(LIMB, relaxation=Prony((0.9,), (1e-3,)))
    assert asked(quick, (20e-3,), (1.0,), 0.1)["time"].force > 2 * asked(LIMB, (20e-3,), (1.0,), 0.1)["time"].force


def test_slip_matters_with_friction_and_a_way():
    off = [asked(LIMB, (20e-3,), (1.0,), friction=mu, path=path)["slip"]
           for mu, path in ((0.05, 0.1), (0.5, 1e-4), (0.5, 1e-3), (0.5, 0.1), ("moist", 0.1))]  # fmt: skip
    assert [one.needed for one in off] == [False, False, True, True, True]
    assert 0 < off[1].force < off[2].force < off[3].force < off[4].force and off[3].force > 0.5
    assert asked(LIMB)["slip"].force is None
    assert asked(LIMB, (20e-3,), (1.0,), friction="moist", path=0.1).friction == "moist"
    assert asked(LIMB, (20e-3,), (1.0,), friction=0.05, path=0.1).friction is None


def test_a_wrench_that_pulls_along_is_missed_up_to_what_sticks():
    off = [asked(LIMB, (20e-3,), (1.0,), drag=drag, friction=0.5)["slip"] for drag in (0.0, 0.05, 0.4, 2.0)]
    assert [one.needed for one in off] == [False, False, True, True]
    assert off[0].force == off[0].motion == 0 and off[2].force == pytest.approx(0.4) and 0.5 < off[3].force < 0.7


def test_a_mesh_errs_with_the_square_of_its_edge():
    off = [asked(LIMB, (20e-3,), (1.0,), edge=edge)["mesh"] for edge in (1e-3, 2e-3, 3e-2)]
    assert off[1].motion / off[0].motion == pytest.approx(4, rel=0.1)
    assert [one.needed for one in off] == [False, False, True]


def test_a_layer_brings_its_tissue_thickness_and_edges():
    layer = plate(0.12, 5e-3, 0.04).with_(tissue=LIMB)
    found, same = needs(layer, [20e-3], [1.0]), asked(LIMB, [20e-3], [1.0], edge=layer.edge_length)
    assert found.terms == same.terms and found["mesh"].motion > 0


def test_less_accuracy_asks_for_less():
    assert asked(LIMB, enough=Misfit(0.9, 0.9)).rung == 0 and asked(LIMB, enough=Misfit(1e-3, 1e-3)).rung == 2


@pytest.mark.parametrize(
    "change, says",
    [
        ({"radii": (20.0,)}, "radii is 20 m"),
        ({"radii": ()}, "at least one radius"),
        ({"forces": (-1.0,)}, "forces is -1 N"),
        ({"friction": -0.1}, "friction is -0.1"),
        ({"drag": -1.0}, "drag is -1"),
        ({"edge": 0.0}, "edge is 0"),
        ({"friction": "soap"}, "no friction 'soap'"),
        ({"duration": -1.0}, "duration is -1 s"),
        ({"path": float("nan")}, "path is nan m"),
        ({"thickness": None}, "thickness"),
        ({"thickness": 30.0}, "thickness is 30 m"),
        ({"enough": Misfit(0.0, 0.1)}, "the accuracy in force is 0"),
        ({"enough": Misfit(1e-7, 0.1)}, "accuracy of 1e-07"),
        ({"radii": 8e-3}, "radii are numbers in m"),
    ],
)
def test_what_cannot_be_is_refused_with_what_is_wrong(change, says):
    with pytest.raises(InvalidInput, match=says):
        asked(LIMB, **change)


def test_a_modulus_that_no_soft_layer_has_is_refused():
    with pytest.raises(InvalidInput, match="no soft layer has 3e\\+09 Pa"):
        needs(Tissue(3e9), [20e-3], [1.0], thickness=0.03)


def test_the_verb_says_the_smallest_model_with_units(capsys):
    code, said, _ = stmpl(capsys, "needs", "--part", "back", "--radius", 20, "--force", 10)
    assert code == 0
    for word in ("skin", "tension", "muscle", "time", "slip", "mesh", "mm", "N", "rung 1", "smallest model", "linear",
                 "low end"):  # fmt: skip
        assert word in said


def test_the_verb_gives_machines_the_same_in_si(capsys):
    code, said, _ = stmpl(capsys, "needs", "--part", "thigh", "--radius", 10, 40, "--force", 1, "--speed", 5, "--json")
    part, figures = region("thigh"), json.loads(said)
    found = needs(part.tissue, [0.01, 0.04], [1.0], [5e-3], thickness=part.thickness)
    assert code == 0 and figures["rung"] == found.rung and figures["smallest"] == found.sentence
    assert figures["terms"]["skin"]["force"] == pytest.approx(found["skin"].force)
    assert figures["indentations"][0]["radius"] == 0.01


def test_the_file_carries_time_and_slip_for_a_node(capsys, tmp_path):
    scene = ("needs", "--part", "forearm", "--force", 1, "--speed", 50, "--path", 100, "--json")
    code, said, _ = stmpl(capsys, *scene, "--duration", 10, "--friction", "dry", "--out", tmp_path / "rich.json")
    rich, told = read_model(tmp_path / "rich.json"), json.loads(said)
    assert code == 0 and rich.relaxing is told["relaxing"] is True and rich.friction == told["friction"] == "dry"
    assert read_tissue(tmp_path / "rich.json") == rich[:2]
    part, (ball,) = region("forearm"), told["indentations"]
    both = [series_of(*one).shares * fades_under(*one, ball["judged"]["contact_radius"])
            for one in (rich[:2], (part.tissue.relaxing(HELD_SKIN), part.thickness))]  # fmt: skip
    np.testing.assert_allclose(*both, rtol=1e-3)
    stmpl(capsys, *scene[:-4], "--path", 100, "--friction", 0.01, "--out", tmp_path / "plain.json")
    plain = read_model(tmp_path / "plain.json")
    assert not plain.relaxing and plain.friction is None and not plain.tissue.relaxes
    written = json.loads((tmp_path / "rich.json").read_text())
    (tmp_path / "old.json").write_text(json.dumps({name: written[name] for name in ("thickness", "tissue")}))
    assert read_model(tmp_path / "old.json")[2:] == (None, False)


def test_a_skin_keeps_its_tension_and_a_layer_is_one_that_a_node_accepts(capsys, tmp_path):
    for part in ("upper_arm", "abdomen"):
        stmpl(capsys, "needs", "--part", part, "--radius", 20, "--force", 2, "--out", tmp_path / "one.json")
        one, whole = read_model(tmp_path / "one.json"), region(part).tissue
        assert one.tissue.skin is not None and one.tissue.skin.tension == whole.skin.tension > 0
        assert not one.tissue.deeper and one.thickness < MAX_THICKNESS


def test_a_fitted_layer_has_room_for_the_press() -> None:
    """A layer of 5.8 mm fits the linear response of a back, which a ball of 20 mm enters by 5.3 mm at 2 N."""
    back, neck = region("back"), region("neck")
    found = needs(back.tissue, [20e-3], [2.0], thickness=back.thickness)
    assert found.layer is not None and found.layer.thickness > 2 * found.indentations[0].depth
    found = needs(neck.tissue, [20e-3], [1.5], thickness=neck.thickness)
    assert found.layer is None or found.layer.thickness > 2 * found.indentations[0].judged.depth


def test_a_slow_scene_writes_relaxed_moduli(capsys, tmp_path):
    own = ("needs", "--thickness", 40, "--modulus", 3, "--force", 1, "--out")
    stmpl(capsys, *own, tmp_path / "quick.json")
    stmpl(capsys, *own, tmp_path / "slow.json", "--speed", 1e-4)
    quick, slow = (read_model(tmp_path / name).tissue.youngs_modulus for name in ("quick.json", "slow.json"))
    assert slow == pytest.approx(HELD_SKIN.relaxed * quick, rel=5e-3)


def test_the_verb_takes_a_tissue_of_ones_own(capsys):
    code, said, _ = stmpl(capsys, "needs", "--thickness", 40, "--modulus", 3, "--radius", 20, "--force", 1)
    assert code == 0 and "rung 0" in said
    layers = ("--skin-modulus", 200, "--skin-thickness", 1.5, "--tension", 20, "--muscle-modulus", 10,
              "--muscle-depth", 10)  # fmt: skip
    code, said, _ = stmpl(capsys, "needs", "--thickness", 40, "--modulus", 3, *layers, "--radius", 20, "--force", 1)
    assert code == 0 and "rung 1" in said


@pytest.mark.parametrize(
    "arguments, says",
    [
        ((), "one of them"),
        (("--part", "knee"), "no region 'knee'"),
        (("--part", "back", "--thickness", 20), "one of them"),
        (("--part", "back", "--tension", 20), "--tension"),
        (("--part", "back", "--nu", 0.5), "leave --nu out"),
        (("--thickness", 20, "--modulus", 10, "--tone", "tensed"), "--tone is that of a region's muscle"),
        (("--thickness", 20, "--modulus", 3, "--tension", 20), "--skin-modulus"),
        (("--part", "back", "--radius", 20, 40, 60), "--radius has 3 values; give one, or two for a range"),
        (("--thickness", 30, "--modulus", 3, "--muscle-modulus", 10, "--muscle-depth", 40), "--muscle-depth is 40 mm"),
        (("--part", "back", "--radius", 0), "radii is 0 m"),
        (("--part", "back", "--radius", 0.02), "Is it in metres?"),
        (("--thickness", 0.02, "--modulus", 3), "Is it in metres?"),
        (("--part", "back", "--force", 1e9), "forces is 1e+09 N"),
        (("--part", "back", "--accuracy", 0), "force is 0"),
    ],
)
def test_the_verb_refuses_in_one_sentence(capsys, arguments, says):
    code, said, refused = stmpl(capsys, "needs", *arguments)
    assert code == 1 and not said and says in refused and "Traceback" not in refused
