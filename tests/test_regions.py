"""Laws of the regions of a body: every number has a source and a spread, and a stack that methods can take."""

import json

import pytest

from stmpl_core.errors import InvalidInput
from stmpl_core.regions import REGIONS, region
from stmpl_core.stack import effective
from stmpl_ros.cli import main

EVERY = [(name, tone) for name in REGIONS for tone in ("relaxed", "tensed")]


def stmpl(capsys, *arguments):
    """Exit code of the command, what it printed, what it refused with."""
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


@pytest.mark.parametrize("name, tone", EVERY)
def test_every_number_lies_within_its_spread_and_says_where_it_comes_from(name, tone):
    for key, one in region(name, tone).quantities.items():
        assert 0 < one.low <= one.value <= one.high, key
        assert one.source.startswith("assumed, as ") or any(f"{year}" in one.source for year in range(1980, 2026)), key


@pytest.mark.parametrize("name, tone", EVERY)
def test_a_region_is_skin_on_fat_on_muscle_to_the_bone(name, tone):
    part = region(name, tone)
    tissue = part.tissue
    assert tissue.skin is not None and tissue.deeper[0].depth == part.fat_thickness.value
    assert tissue.deeper[0].youngs_modulus > tissue.youngs_modulus  # muscle over fat
    assert part.fat_thickness.value <= tissue.deeper[-1].depth < part.thickness <= 0.1


@pytest.mark.parametrize("name", REGIONS)
def test_tensing_changes_the_muscle_and_nothing_else(name):
    relaxed, tensed = region(name).quantities, region(name, "tensed").quantities
    assert [key for key in relaxed if relaxed[key] != tensed[key]] == ["muscle_modulus"]
    assert tensed["muscle_modulus"].value > 1.4 * relaxed["muscle_modulus"].value


@pytest.mark.parametrize("name", REGIONS)
def test_no_region_is_a_single_layer(name):
    part = region(name)
    near = effective(part.tissue, part.thickness)
    assert near.bare.motion > 0.2 and near.misfit.motion < near.bare.motion


def test_a_part_with_its_side_is_of_its_region():
    assert region("left_upper_arm", "tensed") == region("upper_arm", "tensed")


@pytest.mark.parametrize("asked, says", [(("knee",), "Regions: forearm"), (("back", "asleep"), "Tones: relaxed")])
def test_what_is_not_listed_is_refused_with_what_is(asked, says):
    with pytest.raises(InvalidInput, match=says):
        region(*asked)


def test_info_shows_a_part_with_units_and_sources(capsys):
    code, said, _ = stmpl(capsys, "info", "--part", "back")
    assert code == 0
    for word in ("relaxed", "tensed", "source", "kPa", "Laurent", "effective", "N/mm", "rung", "fat, women"):
        assert word in said


def test_info_without_a_word_more_is_of_the_default_limb(capsys):
    assert stmpl(capsys, "info") == stmpl(capsys, "info", "--part", "forearm")


def test_info_knows_parts_that_hold_several_regions_by_the_one_that_serves_them(capsys):
    for part, serves in (("torso", "back"), ("left_arm", "forearm")):
        (code, said, _), (_, other, _) = (stmpl(capsys, "info", "--part", name) for name in (part, serves))
        assert code == 0 and said.startswith(part) and said.splitlines()[1:] == other.splitlines()[1:]


def test_info_gives_machines_the_same_in_si(capsys):
    code, said, _ = stmpl(capsys, "info", "--part", "thigh", "--json")
    figures, part = json.loads(said), region("thigh", "tensed")
    assert code == 0 and figures["tensed"]["thickness"] == part.thickness
    assert figures["tensed"]["quantities"]["muscle_modulus"]["value"] == part.muscle_modulus.value
    assert figures["fat"]["men"] < 1 < figures["fat"]["women"] and 5e-3 < figures["fat"]["back"]["value"] < 0.02
    assert figures["relaxed"]["effective"]["rung"] in (1, 2) and figures["relaxed"]["effective"]["ball_stiffness"] > 0


@pytest.mark.parametrize(
    "arguments, says",
    [(("runs/latest", "--part", "back"), "not both"), (("--part", "knee"), "no region 'knee'")],
)
def test_info_refuses_both_and_parts_that_are_not_listed_in_one_sentence(capsys, arguments, says):
    code, said, refused = stmpl(capsys, "info", *arguments)
    assert code == 1 and not said and says in refused and "Traceback" not in refused
