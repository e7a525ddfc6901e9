"""Regions: what published measurements say of skin, fat and muscle in eight regions of a body, relaxed and tensed.

Moduli come from elastography where nothing slower was found: E = 3 G, waves of 50 Hz and more, for muscle along its
fibres. Slow pressing across them is softer; that is why the low ends are low. What was not found is marked "assumed".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Membrane, Ply, Prony, Tissue

HELD_SKIN = Prony(
    (0.156, 0.217), (0.656, 8.79),
    "two terms fitted within 1 % to one person's skin, stretched by 9.45 mm and held, as if the stretch of 10 s were "
    "sudden: 0.855, 0.752, 0.694, 0.645, 0.622 of the peak after 1, 5, 10, 30, 40 s (Lavigne et al., data of "
    "Skin_porous_modelling); assumed of fat and muscle",
)  # fmt: skip

Tone = Literal["relaxed", "tensed"]


@dataclass(frozen=True)
class Quantity:
    """A number about people.

    Args:
        value: typical number.
        low: number of people or studies at the low end; not a bound.
        high: the same at the high end.
        unit: unit of all three; SI.
        source: authors, journal, year and what they measured, or "assumed, as ...".
    """

    value: float
    low: float
    high: float
    unit: str
    source: str

    def times(self, low: float, value: float, high: float, source: str) -> Quantity:
        """A multiple of it, to two digits: `low` times its low end, and so on."""
        ends = low * self.low, value * self.value, high * self.high
        low, value, high = (float(f"{each:.2g}") for each in ends)
        return Quantity(value, low, high, self.unit, source)

    def assumed(self, source: str) -> Quantity:
        """The same number at a place where none was found."""
        return replace(self, source=f"assumed, as {source}")


@dataclass(frozen=True)
class Region:
    """One region of a body in one tone.

    Args:
        name: name of the region.
        tone: relaxed or tensed muscle.
        where: place of the measurements.
        skin_modulus: Young's modulus E_s of the skin [Pa].
        skin_thickness: thickness h of the skin [m].
        skin_tension: tension T of the skin at rest [N/m].
        fat_modulus: Young's modulus of the fat [Pa].
        fat_thickness: thickness of the fat under the skin [m].
        muscle_modulus: Young's modulus of the muscle [Pa].
        muscle_thickness: thickness from fat to bone, or to the organs [m].
        poisson_ratio: Poisson's ratio nu of fat, muscle and organs [-].
        organs_modulus: Young's modulus of what lies under the muscle [Pa]; None: bone.
        organs_thickness: thickness of what lies under the muscle, to the bone [m]; None: bone.
    """

    name: str
    tone: Tone
    where: str
    skin_modulus: Quantity
    skin_thickness: Quantity
    skin_tension: Quantity
    fat_modulus: Quantity
    fat_thickness: Quantity
    muscle_modulus: Quantity
    muscle_thickness: Quantity
    poisson_ratio: Quantity
    organs_modulus: Quantity | None = None
    organs_thickness: Quantity | None = None

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Every number of the region, by its name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Quantity)}

    @property
    def tissue(self) -> Tissue:
        """Skin as a membrane over fat and muscle, typical numbers."""
        nu, fat = self.poisson_ratio.value, self.fat_thickness.value
        skin = Membrane(self.skin_modulus.value, self.skin_thickness.value, self.skin_tension.value,
                        source=self.skin_modulus.source)  # fmt: skip
        deeper = [Ply(fat, self.muscle_modulus.value, nu, f"{self.tone} muscle", self.muscle_modulus.source)]
        if self.organs_modulus:
            deeper.append(Ply(fat + self.muscle_thickness.value, self.organs_modulus.value, nu, "organs",
                              self.organs_modulus.source))  # fmt: skip
        return Tissue(self.fat_modulus.value, nu, skin=skin, deeper=tuple(deeper), source=self.fat_modulus.source)

    @property
    def thickness(self) -> float:
        """Thickness from the skin to the bone [m]; a membrane has none of its own."""
        under = self.organs_thickness.value if self.organs_thickness else 0.0
        return self.fat_thickness.value + self.muscle_thickness.value + under


def region(name: str, tone: Tone = "relaxed") -> Region:
    """A region of a typical adult's body.

    Args:
        name: name of the region: forearm, upper_arm, shoulder, neck, back, abdomen, thigh or calf; or of a part of a
            body, as stmpl_core.body knows it: left_forearm, right_arm, torso.
        tone: state of the muscle: relaxed or tensed.

    Raises:
        InvalidInput: a region or a tone that is not listed.
    """
    name = name.removeprefix("left_").removeprefix("right_")
    name = WHOLE.get(name, name)
    if name not in REGIONS:
        raise InvalidInput(f"there is no region '{name}'. Regions: {', '.join(REGIONS)}. Other parts are "
                           "answered as one material: --tissue single.")  # fmt: skip
    if not isinstance(tone, str) or tone not in get_args(Tone):
        raise InvalidInput(f"there is no tone '{tone}'. Tones: {', '.join(get_args(Tone))}.")
    where, tensed, numbers = REGIONS[name]
    if tone == "tensed":
        numbers = numbers | {"muscle_modulus": tensed}
    return Region(name, tone, where, **(COMMON | numbers))


def _mm(value: float, low: float, high: float, source: str) -> Quantity:
    return Quantity(value * 1e-3, low * 1e-3, high * 1e-3, "m", source)


def _kpa(value: float, low: float, high: float, source: str) -> Quantity:
    return Quantity(value * 1e3, low * 1e3, high * 1e3, "Pa", source)


_GIBNEY = "Gibney et al., Curr Med Res Opin 26 (2010) 1519: 388 adults with diabetes, ultrasound"
_LAURENT = "Laurent et al., Vaccine 25 (2007) 6423: 342 adults, ultrasound"
_MAUGHAN = ("Maughan et al., Clin Sci 66 (1984) 683: shares of fat and bone in 16 forearms, CT; assumed round, radius "
            "40 mm")
_MECHELLI = "Mechelli, J Cachexia Sarcopenia Muscle Clin Rep 4 (2019): 17 adults, front of the thigh, ultrasound"
_MULTIS = ("MULTIS, Neumann et al., Sci Data 5 (2018) 180193: {}, 95 adults, ultrasound; geometric mean and deviation, "
           "at 24 kg/m2")  # fmt: skip
_ABDUCTION = "Quantitative assessment of normal middle deltoid muscle elasticity, Sci Rep 11 (2021)"
_SEXES = "spread: difference of the sexes"

_SKIN_E = _kpa(130, 40, 220, "Diridollou et al., Skin Res Technol 6 (2000) 214: 129 +- 88 kPa, 10 forearms, suction")
_TENSION = Quantity(11.4, 6.2, 22.0, "N/m",
                    "Flynn et al., Biomech Model Mechanobiol 10 (2011) 27: largest, upper and lower forearm; high: "
                    "stress of 13.5 + 5 kPa of Diridollou et al. (2000) times thickness")  # fmt: skip
_FAT_E = _kpa(2.5, 2.3, 9, "Tran et al., Comput Methods Biomech Biomed Engin 10 (2007) 401: 6 C10, one forearm, "
              "indentation in MRI; low: G 0.75 kPa, Strain-dependent shear properties of human adipose tissue in vivo, "
              "J Mech Behav Biomed Mater (2023); high: G 3.0 kPa, Chakouch et al., PLOS ONE 10 (2015) "
              "e0138873")  # fmt: skip
_SITES = _mm(6, 3, 10, "assumed, as the means over eight sites of 10 people: Störchle et al., Sci Rep 8 (2018) 16268")
_THIGH_E = _kpa(12, 3, 15, "Bensamoun et al., J Magn Reson Imaging 23 (2006) 242: 3 G of vastus medialis, 3.9 +- 1.2 "
                "kPa, 14 people; low: G 1.0 kPa of gluteal muscle, J Mech Behav Biomed Mater (2023)")  # fmt: skip
_LIMB_E = _THIGH_E.assumed("the thigh's: Bensamoun et al. (2006)")
_DELTOID_E = _kpa(23, 15, 35, f"{_ABDUCTION}: 2.2-3.3 m/s of shear waves, arm at rest, 3 rho c^2")
_TRAPEZIUS_E = _kpa(31, 25, 36, "Leong, Hug & Fu, PLOS ONE 11 (2016): 3 G of upper trapezius at rest, 10.2 +- 1.8 kPa")
_NECK_E = _kpa(23, 20, 27, "Dieterich et al., Eur J Appl Physiol 117 (2017) 171: 3 G of trapezius 7.7 kPa; low, high: "
               "splenius, semispinalis; 10 people")  # fmt: skip
_WALL_E = _kpa(11, 10, 13, "Gabrielsen et al., Ultrasound Med Biol 44 (2018) 1978: 3 rho c^2 of external oblique, "
               "1.89 +- 0.16 m/s")  # fmt: skip
_TWICE = (1.5, 2.0, 5.0, "assumed, as twice the relaxed: multifidus from lying to sitting with arms raised, Sadeghi et "
          "al., J Eng Sci Med Diagn Ther 3 (2020) 041001; high: deltoid, Sci Rep 11 (2021)")  # fmt: skip
_LIFTED = (1.3, 1.55, 3.0, "1.55 times the relaxed: upper trapezius, arm at 30 degrees, 28 people, Leong et al., PLOS "
           "ONE 8 (2013) e67199; spread assumed")  # fmt: skip

COMMON = {
    "skin_modulus": _SKIN_E.assumed("the forearm's: Diridollou et al. (2000)"),
    "skin_tension": _TENSION.assumed("the forearm's: Flynn et al. (2011)"),
    "fat_modulus": _FAT_E,
    "poisson_ratio": Quantity(0.45, 0.40, 0.49, "-", "assumed, as nearly incompressible"),
}  # numbers of every region that has none of its own
WHOLE = {"arm": "forearm", "leg": "thigh", "torso": "back"}  # region whose numbers serve a part of several
REGIONS = {  # where, modulus of the tensed muscle, numbers
    "forearm": ("palm side, to the bones", _LIMB_E.times(*_TWICE), {
        "skin_modulus": _SKIN_E,
        "skin_thickness": _mm(1.2, 0.65, 1.55, "Van Mulder et al., Vaccine 35 (2017) 1810: adults, ultrasound"),
        "skin_tension": _TENSION,
        "fat_thickness": _mm(5, 3, 6, f"{_MAUGHAN}; low, high: men, women"),
        "muscle_modulus": _LIMB_E,
        "muscle_thickness": _mm(20, 15, 25, f"{_MAUGHAN}, bone in its middle; spread assumed"),
    }),
    "upper_arm": ("back of the arm, to the humerus", _LIMB_E.times(*_TWICE), {
        "skin_thickness": _mm(2.2, 2.0, 2.3, f"{_GIBNEY}; low: {_LAURENT}"),
        "skin_tension": Quantity(5.6, 5.6, 22.0, "N/m", "Flynn et al., Biomech Model Mechanobiol 10 (2011) 27: "
                                 "largest; high: assumed, as the forearm's"),
        "fat_thickness": _mm(10.8, 5.7, 15.9, f"{_GIBNEY}; {_SEXES}"),
        "muscle_modulus": _LIMB_E,
        "muscle_thickness": _mm(24, 18, 32, _MULTIS.format("back of the upper arm")),
    }),
    "shoulder": ("deltoid, to the humerus", _kpa(115, 75, 160, f"{_ABDUCTION}: 4.9-7.1 m/s, arm held at 90 degrees"), {
        "skin_thickness": _mm(2.0, 1.2, 3.2, f"{_LAURENT}; spread: Van Mulder et al., Vaccine 35 (2017) 1810"),
        "fat_thickness": _mm(8, 6, 10, "Poland et al., JAMA 277 (1997) 1709: skin to muscle 8.3 mm in 94 men, 11.7 mm "
                             "in 126 women, less the skin"),
        "muscle_modulus": _DELTOID_E,
        "muscle_thickness": _mm(20, 15, 30, "assumed, as the forearm's"),
    }),
    "neck": ("nape, to the vertebrae", _NECK_E.times(*_LIFTED), {
        "skin_thickness": _mm(2.5, 2.0, 3.0, "assumed, as above the shoulder blade: Laurent et al. (2007)"),
        "fat_thickness": _SITES,
        "muscle_modulus": _NECK_E,
        "muscle_thickness": _mm(25, 15, 35, "assumed, as between forearm and thigh"),
    }),
    "back": ("beside the shoulder blade, to the ribs", _TRAPEZIUS_E.times(*_LIFTED), {
        "skin_thickness": _mm(2.5, 2.0, 3.0, f"{_LAURENT}; spread assumed"),
        "fat_thickness": _SITES,
        "muscle_modulus": _TRAPEZIUS_E,
        "muscle_thickness": _mm(12, 9, 15, "Sonographic measurements of the thickness of the soft tissues of the "
                                "interscapular region, J Clin Ultrasound 39 (2011) 78: trapezius, rhomboid and "
                                "serratus; low, high: 34 women, 21 men"),
    }),
    "abdomen": ("beside the navel, to the spine", _WALL_E.times(*_TWICE), {
        "skin_thickness": _mm(2.2, 1.9, 2.4, f"{_GIBNEY}; low: {_LAURENT}, waist; high assumed"),
        "fat_thickness": _mm(13.9, 8.8, 19.0, f"{_GIBNEY}; {_SEXES}"),
        "muscle_modulus": _WALL_E,
        "muscle_thickness": _mm(14.7, 11.8, 17.6, "Egwu et al., Stud Med 30 (2014) 180: rectus abdominis, 120 adults"),
        "organs_modulus": _FAT_E.assumed("fat's"),
        "organs_thickness": _mm(60, 40, 90, "assumed, as half of a trunk's depth"),
    }),
    "thigh": ("front of the thigh, to the femur", _THIGH_E.times(*_TWICE), {
        "skin_thickness": _mm(1.55, 1.5, 1.9, f"{_LAURENT}; high: {_GIBNEY}"),
        "fat_thickness": _mm(10.4, 6.3, 14.5, _MECHELLI),
        "muscle_modulus": _THIGH_E,
        "muscle_thickness": _mm(28, 21, 35, _MECHELLI),
    }),
    "calf": ("back of the leg, to the tibia", _LIMB_E.times(*_TWICE), {
        "skin_thickness": _mm(1.35, 1.06, 1.72, _MULTIS.format("back of the lower leg")),
        "fat_thickness": _mm(7.1, 4.4, 11, _MULTIS.format("back of the lower leg")),
        "muscle_modulus": _LIMB_E,
        "muscle_thickness": _mm(44, 37, 53, _MULTIS.format("back of the lower leg")),
    }),
}  # fmt: skip
