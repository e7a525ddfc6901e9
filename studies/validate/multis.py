"""Multis: a reader of the public MULTIS data, people into whose limbs an ultrasound probe was pressed, and its rows.

What is read is the table that the project made of its recordings, 001_MasterList_indentation_orig.csv of its study
LayerEffectonStiffness (SimTK, project multis: doi 10.18735/S5R97F; Neumann et al., Sci Data 5 (2018) 180193, and PLOS
ONE 18 (2023) e0284721). A line each person and site, with a head: SubID, Location, Gender, BMI, MaxForce, TotalStrain,
Skin, Fat, Muscle, Thickness, Total_Stiff, Total_EMod, maxForce_normArea and more. Nothing says its units, the numbers
do:

    Thickness = Skin + Fat + Muscle, Total_Stiff = Total_EMod / Thickness, and maxForce_normArea = MaxForce / 360 or
    / 675: the heads of the project's two probes are 45 mm by 8 and 45 mm by 15. So they are mm, N and MPa

and TotalStrain is what the thickness under the probe lost, over the thickness. The recordings themselves (DICOM images,
force files) are not read: how they are laid out was not found in public.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.regions import Quantity
from studies.validate.rows import Protocol, Row

FILE = "*MasterList_indentation*.csv"
NUMBERS = ("BMI", "MaxForce", "TotalStrain", "Skin", "Fat", "Muscle", "maxForce_normArea")
COLUMNS = ("SubID", "Location", "Gender", *NUMBERS)
MISSING = ("", "NA", "nan")  # what stands where nothing was measured
SITES = {  # by Location: region of the library, and what it is
    "UA_A": ("upper_arm", "front of the upper arm"), "UA_P": ("upper_arm", "back of the upper arm"),
    "LA_A": ("forearm", "front of the lower arm"), "LA_P": ("forearm", "back of the lower arm"),
    "UL_A": ("thigh", "front of the upper leg"), "UL_P": ("thigh", "back of the upper leg"),
    "LL_A": ("calf", "front of the lower leg"), "LL_P": ("calf", "back of the lower leg"),
}  # fmt: skip
DEVIATION = (16, 50, 84)  # percentiles that stand for low end, middle and high end
SOURCE = "MULTIS master list (SimTK, doi 10.18735/S5R97F): {} people; middle and 16th to 84th percentile"
OUTSIDE = ("a probe pressed by hand to a fifth of the thickness, and the closed form of small depths; the library's "
           "moduli; the probe's oblong counts as a disc of its area")  # fmt: skip


@dataclass(frozen=True)
class Indentation:
    """One person's site, pressed once.

    Args:
        person: number of the person.
        site: one of SITES.
        female: whether the person is a woman.
        mass_index: body mass index [kg/m2].
        skin, fat, muscle: thicknesses at rest [m].
        force: largest force [N].
        strain: what the thickness lost under it, over itself [-].
        area: area of the probe's head [m2].
    """

    person: str
    site: str
    female: bool
    mass_index: float
    skin: float
    fat: float
    muscle: float
    force: float
    strain: float
    area: float

    @property
    def thickness(self) -> float:
        """From the surface to the bone [m]."""
        return self.skin + self.fat + self.muscle

    @property
    def stiffness(self) -> float:
        """Largest force over its depth [N/m]."""
        return self.force / (self.strain * self.thickness)


def read(path: Path) -> list[Indentation]:
    """The sites of all people of a master list; lines that lack a number are left out.

    Args:
        path: file, or a folder in which it lies at any depth.

    Raises:
        InvalidInput: no such file, a column that is missing, a number or a site that cannot be.
    """
    file = path
    if path.is_dir():
        found = sorted(path.rglob(FILE))
        if not found:
            raise InvalidInput(f"there is no {FILE} in {path}. It is in the project multis of SimTK, "
                               "studies/LayerEffectonStiffness/dat.")  # fmt: skip
        file = found[0]
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            table = list(csv.DictReader(lines))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput(f"{file} cannot be read: {error}.") from error
    if not table or (missing := [name for name in COLUMNS if name not in table[0]]):
        lacks = "any line" if not table else f"the columns {', '.join(missing)}"
        raise InvalidInput(f"{file} is no MULTIS master list: it lacks {lacks}.")
    return [_indentation(line, f"{file}, line {number}") for number, line in enumerate(table, 2)
            if all((line[name] or "").strip() not in MISSING for name in COLUMNS)]  # fmt: skip


def _indentation(line: dict[str, str], where: str) -> Indentation:
    try:
        index, force, strain, skin, fat, muscle, pressure = (float(line[name]) for name in NUMBERS)
    except ValueError as error:
        raise InvalidInput(f"{where}: {error}.") from error
    if (gender := line["Gender"].strip().lower()) not in ("female", "male"):
        raise InvalidInput(f"{where}: Gender is {line['Gender']!r}; Female or Male is needed.")
    if line["Location"] not in SITES:
        raise InvalidInput(f"{where}: there is no site {line['Location']!r}. Sites: {', '.join(SITES)}.")
    sizes = (index, force, strain, skin, fat, muscle, pressure)
    if not (np.isfinite(sizes).all() and min(sizes) > 0 and strain < 1 and skin + fat + muscle < 300):
        raise InvalidInput(f"{where}: a force, strain or thickness [mm] that cannot be.")
    return Indentation(line["SubID"], line["Location"], gender == "female", index, 1e-3 * skin, 1e-3 * fat,
                       1e-3 * muscle, force, strain, 1e-6 * force / pressure)  # fmt: skip


def rows(people: Sequence[Indentation]) -> list[Row]:
    """A row each site: force over depth at the largest force, with the people's own thicknesses."""
    out = []
    for site, (region, where) in SITES.items():
        some = [one for one in people if one.site == site]
        if not some:
            continue
        source = SOURCE.format(len(some))

        def of(values: list[float], unit: str, source: str = source) -> Quantity:
            low, middle, high = (float(x) for x in np.percentile(values, DEVIATION))
            return Quantity(middle, low, high, unit, source)

        protocol = Protocol(
            "flat head of an ultrasound probe by hand, to its largest force",
            "pressed in",
            of([math.sqrt(one.area / math.pi) for one in some], "m"),
            of([one.strain * one.thickness for one in some], "m"),
        )
        own = {f"{name}_thickness": of([getattr(one, name) for one in some], "m") for name in ("skin", "fat", "muscle")}
        out.append(Row(f"{where}, probe", region, f"{where}, {len(some)} people", protocol, "stiffness",
                       of([one.stiffness for one in some], "N/m"), "data", OUTSIDE, own))  # fmt: skip
    return out
