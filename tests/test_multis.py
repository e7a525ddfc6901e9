"""Laws of the reader of the MULTIS master list, on a file of its layout with numbers of our own."""

import json

import numpy as np
import pytest

from stmpl_core.errors import InvalidInput
from stmpl_ros.cli import main
from studies.validate.judge import judge_row
from studies.validate.multis import SITES, read, rows

HEAD = (",SubID,Location,Age,Gender,BMI,ActivityLevel,Race,Ethnicity,MaxForce,TotalStrain,SkinStrain,FatStrain,"
        "MuscleStrain,Thickness,Skin,Fat,Muscle,Total_Stiff,Total_EMod,Skin_K,Skin_E,Fat_K,Fat_E,Muscle_K,Muscle_E,fat_disp,"
        "muscle_disp,R_squared,R_squared_poly,Rate,maxForce_normArea")  # fmt: skip


def line(site: str, force: float = 6.75, strain: float = 0.2, skin: float = 1.5, fat: float = 6, muscle: float = 22.5,
         area: float = 675, person: int = 6) -> str:  # fmt: skip
    """A line with thicknesses in mm, a force in N, an area in mm2."""
    t, modulus = skin + fat + muscle, force / area / strain
    return (f"0,{person:03d},{site},30,Female,24.5,Active  ,White,Not Hispanic or Latino,{force},{strain},0.1,0.2,"
            f"0.2,{t},{skin},{fat},{muscle},{modulus / t},{modulus},"
            f"0.1,0.1,0.1,0.1,0.1,0.1,1,4,0.9,0.95,5,{force / area}")  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "studies" / "dat"
    place.mkdir(parents=True)
    people = [line(site, force=5 + k, person=k) for site in SITES for k in range(5)]
    people.append(line("UA_P").replace(",22.5,", ",,"))  # nobody measured the muscle
    (place / "001_MasterList_indentation_orig.csv").write_text("\n".join([HEAD, *people]))
    return tmp_path


def test_numbers_come_in_si_and_lines_without_one_are_left_out(folder):
    people = read(folder)
    assert len(people) == 5 * len(SITES)
    one = people[0]
    assert (one.person, one.site, one.female) == ("000", "UA_A", True)
    np.testing.assert_allclose([one.skin, one.fat, one.muscle, one.area], [1.5e-3, 6e-3, 22.5e-3, 675e-6])
    assert one.stiffness == pytest.approx(5 / 6e-3)


def test_what_spreadsheets_write_is_read_and_a_gender_that_is_neither_is_told(folder):
    (path,) = folder.rglob("*.csv")
    text = path.read_text()
    path.write_text(text.replace("Female", "female"), encoding="utf-8-sig")
    assert all(one.female for one in read(folder))
    path.write_text(text.replace("Female", "F", 1))
    with pytest.raises(InvalidInput, match="line 2: Gender is 'F'"):
        read(folder)


def test_every_site_becomes_a_row_with_the_peoples_own_thicknesses(folder):
    made = rows(read(folder))
    assert [row.region for row in made] == [region for region, _ in SITES.values()]
    upper = made[1]
    assert upper.measured.value == pytest.approx(7 / 6e-3) and upper.measured.low < upper.measured.value
    assert upper.protocol.radius.value == pytest.approx(np.sqrt(675e-6 / np.pi))
    judged = judge_row(upper)
    assert judged.model.low < judged.model.value < judged.model.high and judged.by == "closed form"


def test_the_model_is_asked_with_the_thicknesses_that_were_measured(folder):
    text = next(folder.rglob("*.csv")).read_text()
    thin = folder / "thin.csv"
    thin.write_text(text.replace(",22.5,", ",6.5,"))
    before, after = (judge_row(rows(read(path))[0]).model.value for path in (folder / "studies", thin))
    assert after > 1.3 * before


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda text: text.replace("TotalStrain", "Strain"), "lacks the columns TotalStrain"),
        (lambda text: text.replace("UA_A", "XX_A"), "line 2: there is no site 'XX_A'. Sites: UA_A"),
        (lambda text: text.replace(",5,0.2,", ",five,0.2,"), "line 2: could not convert"),
        (lambda text: text.replace(",5,0.2,", ",5,1.2,"), "cannot be"),
        (lambda text: HEAD, "lacks any line"),
    ],
)
def test_a_file_of_another_kind_is_refused_in_one_sentence(folder, change, says):
    file = next(folder.rglob("*.csv"))
    file.write_text(change(file.read_text()))
    with pytest.raises(InvalidInput, match=says):
        read(folder)


def test_a_folder_without_it_says_where_it_is(tmp_path):
    with pytest.raises(InvalidInput, match="LayerEffectonStiffness"):
        read(tmp_path)
    with pytest.raises(InvalidInput, match="cannot be read"):
        read(tmp_path / "none.csv")


def test_validate_adds_its_rows(folder, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["validate", "--quick", "--multis", str(folder), "--out", str(tmp_path / "out"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert sum("probe" in row["name"] and row["read"] == "data" for row in told["rows"]) == len(SITES)
