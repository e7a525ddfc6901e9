"""Rows: what others measured on people, each with its protocol, and what to ask the model for it.

A row that a parameter of the model was fitted on says so, and is not judged. Where only an abstract was read, or
somebody's quotation of it, the row says so. A part of a protocol that was not found is marked "assumed" and carries a
spread of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from stmpl_core.regions import Quantity, region
from studies.validate.closed import Way

Asked = Literal["stiffness", "force", "reduced modulus", "layer modulus", "tensed over relaxed", "tensed less relaxed",
                "share lost", "energy lost", "last peak over first", "time of fading"]  # fmt: skip
IN_TIME = ("share lost", "energy lost", "last peak over first", "time of fading")  # what only tissue with time answers
Read = Literal["abstract", "quotation", "public page", "data"]


@dataclass(frozen=True)
class Protocol:
    """How a row was measured.

    Args:
        said: protocol as published, in a few words.
        way: direction of the force on the skin; stretched: between two pads that are glued to it.
        radius: radius of the tool, or of its contact where it is a ball or a jet [m].
        depth: depth of the tool, or its way along [m]; None: small.
        ball: whether a ball is pressed, by finite elements; a flat disc otherwise.
        speed: speed of the way there and back [m/s]; None: at once.
        stays: time between the two [s]; None: none.
        cycles: number of cycles of there and back.
    """

    said: str
    way: Way | Literal["stretched"]
    radius: Quantity
    depth: Quantity | None = None
    ball: bool = False
    speed: Quantity | None = None
    stays: Quantity | None = None
    cycles: int = 1


@dataclass(frozen=True)
class Row:
    """One published measurement.

    Args:
        name: name of the row, as it stands in the picture.
        region: region of the library that stands for the site.
        site: site and people, as published.
        protocol: protocol of the measurement.
        asked: number that was measured.
        measured: value, low and high over people; all three the same where no spread was read.
        read: what was read: the source's own abstract, another's quotation of it, a public page, or the data.
        outside: likely reason if model and measurement do not meet.
        own: numbers of the region that were measured on the same people, by name; the others are the library's.
        fitted: parameter of the model that was fitted on this row, which is then not judged; none if empty.
    """

    name: str
    region: str
    site: str
    protocol: Protocol
    asked: Asked
    measured: Quantity
    read: Read
    outside: str
    own: Mapping[str, Quantity] = field(default_factory=dict)
    fitted: str = ""


def _m(value: float, low: float, high: float, source: str) -> Quantity:
    return Quantity(value * 1e-3, low * 1e-3, high * 1e-3, "m", source)


def _spread(value: float, deviation: float, unit: str, source: str) -> Quantity:
    return Quantity(value, value - deviation, value + deviation, unit, source)


def _s(value: float) -> Quantity:
    return Quantity(value, value, value, "s", "of the protocol")


def _alone(value: float, unit: str, source: str) -> Quantity:
    return Quantity(value, value, value, unit, source)


FIBRES = ("the skin's modulus is that of suction at small stretch; 1.3 mm beside a probe 4 mm wide stretches the skin "
          "much further, where its fibres bear more (the authors find a neo-Hookean law too poor), and most along one "
          "direction")  # fmt: skip
TAP = ("a tap of 15 ms on a preload: rate and inertia stiffen tissue, and finite depth too (the thigh to 0.13 N/mm at "
       "half a newton, by finite elements); the closed form is slow and starts at rest")  # fmt: skip
LIGHT = "a contact of 2 mm under 20 mN feels the skin's tension first; the old have slacker skin than the library's"
TONE = ("relaxed and tensed differ by the muscle's modulus only, along its fibres by elastography; a fascia that "
        "tightens and a muscle that bulges are left out, and the fat hides what lies below")  # fmt: skip
SPRING = ("a safety standard's spring, meant for forces near the pain limit and told without tool or depth; the model "
          "bears 8 to 13 N at a third of its thickness, and neo-Hookean tissue stiffens too little beyond")  # fmt: skip

LOOP = ("the model's skin loses by what fades alone, with the series of one person; skin that is stretched far loses "
        "more as it yields, and the speed was not found")  # fmt: skip
RAMP = ("the series was fitted to the hold as if the stretch had been sudden; with the 10 s that it took, much of what "
        "fades has faded before")  # fmt: skip
AGAIN = ("preconditioning: skin that was stretched is longer and softer at once, which a series that fades is not (the "
         "pads then go slack early on the way back)")  # fmt: skip

_FLYNN = "Flynn, Taberner & Nielsen, Med Eng Phys 33 (2011) 610: largest force over largest way, 20 people"
_PULLED = Protocol("probe 4 mm wide, taken to be glued, moved up to 1.3 mm; stiffest along the skin", "pulled along",
                   _m(2, 2, 2, "Flynn et al., J Mech Behav Biomed Mater 28 (2013) 484: the same robot, on faces"),
                   _m(1.3, 1.3, 1.3, _FLYNN))  # fmt: skip
_INDENTER = Protocol(
    "flat indenter in a plate that lies on the skin, 1.3 mm deep",
    "pressed in",
    _m(1, 0.5, 1.5, "assumed: not found"),
    _m(1.3, 1.3, 1.3, "Virén et al., Int J Cosmet Sci 40 (2018) 134: depths of the device 0.6 and 1.3 mm"),
)
_ZAHOUANI = "Zahouani et al., Skin Res Technol 15 (2009) 68: 20 people aged 55 to 70, reduced modulus"
_BALL = Protocol("ball, 5 to 20 mN", "pressed in",
                 _m(1.8, 1.3, 2.5, "contact that 5 mN at 0.5 kPa and 20 mN at 2 kPa give; spread assumed"))  # fmt: skip
_BOYER = "Boyer et al., Med Eng Phys 34 (2012) 172: reduced modulus"
_JET = Protocol("jet of air, 10 mN", "pressed in", _m(1.8, 1, 4, "assumed, as a ball's of 10 mN; spread assumed"))
_PROBE = _m(1.5, 1, 2, "assumed: not found")
_MYOTON = Protocol("MyotonPRO: tap of 15 ms on a preload, from the oscillation that follows", "pressed in", _PROBE)
_RELAXED = "thigh, rectus femoris, relaxed, "
_BADU = "Agyapong-Badu et al., J Aging Phys Act 20 (2012) S233"
_LUMBAR = ("Stiffness of resting lumbar myofascia in healthy young subjects, J Bodyw Mov Ther 20 (2016) 388: standard "
           "error 11.3 N/m, times the root of 10")  # fmt: skip
_ZHENG = "Zheng & Mak, J Biomech Eng 121 (1999) 330"
_PEN = Protocol("pen-sized ultrasound indenter by hand, quasi-linear viscoelastic fit, initial modulus", "pressed in",
                _m(4.5, 3, 6, "assumed: not found"))  # fmt: skip
_HAND = Protocol("indenter by hand, fitted by Hertz", "pressed in", _m(10, 5, 20, "assumed: not found"),
                 _m(10, 5, 15, "assumed: not found"), ball=True)  # fmt: skip
_ISO = "ISO/TS 15066:2016, table A.3"
_LOOP = replace(_PULLED, said="probe 4 mm wide, taken to be glued, moved 1.3 mm along the skin and back",
                speed=_m(1, 0.1, 10, "assumed: not found"))  # fmt: skip
_HELD = replace(_PEN, said="pen-sized ultrasound indenter by hand, quasi-linear viscoelastic fit of one term",
                stays=_s(60))  # fmt: skip
_ONE = "skin of one person, site not told, taken to be a forearm"
_LAVIGNE = ("Lavigne et al., public data of Skin_porous_modelling, Healthy_skin.xlsx: force less its mean before the "
            "first stretch")  # fmt: skip
_STRETCHED = Protocol("extensometer: 9.45 mm at 0.97 mm/s, held, back at the same speed", "stretched",
                      _m(2, 2, 2, "two pads; their size is not used"), _m(9.45, 9.45, 9.45, _LAVIGNE),
                      speed=_m(0.97, 0.97, 0.97, _LAVIGNE), stays=_s(40))  # fmt: skip


def _robot(name: str) -> Protocol:
    """A robot's arm on a region, pressed in to a third of the thickness."""
    t = 1e3 * region(name).thickness
    return Protocol("spring of the region against a robot; tool and depth not told", "pressed in",
                    _m(40, 20, 60, "assumed: a ball of 40 mm"),
                    _m(t / 3, t / 5, t / 2, "assumed: a third of the thickness"), ball=True)  # fmt: skip


ROWS = (
    Row("forearm, skin pulled", "forearm", "right anterior forearm, 20 people", _PULLED, "stiffness",
        Quantity(846, 440, 1450, "N/m", f"{_FLYNN}; middle at second hand: 1.1 N at 1.3 mm"), "abstract", FIBRES),
    Row("upper arm, skin pulled", "upper_arm", "posterior upper arm, 20 people", _PULLED, "stiffness",
        _alone(531, "N/m", f"{_FLYNN}: 0.69 N at 1.3 mm on average"), "quotation", FIBRES),
    Row("forearm, small indenter", "forearm", "volar forearm, 12 people", _INDENTER, "force",
        _spread(84.1e-3, 22.7e-3, "N", "Mayrovitz, Cureus 16 (2024) e65590"), "abstract",
        "the indenter's width is not known, and its plate holds the skin around it"),
    Row("forearm, light ball", "forearm", "skin in vivo, site taken to be the forearm, 20 people aged 55 to 70", _BALL,
        "reduced modulus", _spread(8.3e3, 2.1e3, "Pa", _ZAHOUANI), "quotation", LIGHT),
    Row("forearm, air jet, young", "forearm", "skin in vivo, site taken to be the forearm, about 23 years", _JET,
        "reduced modulus", _spread(14.38e3, 3.61e3, "Pa", _BOYER), "quotation", LIGHT),
    Row("forearm, air jet, old", "forearm", "skin in vivo, site taken to be the forearm, about 60 years", _JET,
        "reduced modulus", _spread(6.20e3, 1.45e3, "Pa", _BOYER), "quotation", LIGHT),
    Row("thigh, tap, young men", "thigh", f"{_RELAXED}21 men of 26 years", _MYOTON, "stiffness",
        _spread(288, 22.5, "N/m", _BADU), "abstract", TAP),
    Row("thigh, tap, old men", "thigh", f"{_RELAXED}21 men of 72 years", _MYOTON, "stiffness",
        _spread(322.2, 27.9, "N/m", _BADU), "abstract", TAP),
    Row("thigh, tap, young women", "thigh", f"{_RELAXED}women of 18 to 35 years", _MYOTON, "stiffness",
        _alone(233, "N/m", "Agyapong-Badu et al., Arch Gerontol Geriatr 62 (2016) 59"), "abstract", TAP),
    Row("back, tap, men", "back", "lumbar, L3-L4, prone, 10 men", _MYOTON, "stiffness",
        _spread(247.8, 35.7, "N/m", _LUMBAR), "abstract", TAP),
    Row("back, tap, women", "back", "lumbar, L3-L4, prone, 10 women", _MYOTON, "stiffness",
        _spread(208.4, 35.7, "N/m", _LUMBAR), "abstract", TAP),
    Row("calf, tap", "calf", "superficial muscles at rest, adults", _MYOTON, "stiffness",
        Quantity(300, 220, 380, "N/m", "range that the device's maker gives (myoton.com)"), "public page", TAP),
    Row("calf, tap, tensed less relaxed", "calf", "gastrocnemius, 102 people", _MYOTON, "tensed less relaxed",
        Quantity(217.5, 191.3, 243.8, "N/m", "Hoffman et al., Int J Sports Phys Ther 16 (2021): mean and its 95 % "
                 "interval"), "abstract", TONE),
    Row("thigh, tensed over relaxed", "thigh", "thigh, isometric contraction", _HAND, "tensed over relaxed",
        _alone(2, "-", "Investigating the effects of activation state and location on lower limb tissue stiffness: "
               "about 2"), "abstract", TONE),
    Row("leg, initial modulus", "calf", "four sites of the lower limb, 8 people, three postures", _PEN, "layer modulus",
        Quantity(3.6e3, 0.22e3, 58.4e3, "Pa", "Zheng & Mak, J Biomech Eng 121 (1999) 330: range; geometric middle"),
        "abstract", "sites and postures are mixed"),
    Row("forearm, robot", "forearm", "forearm", _robot("forearm"), "stiffness", _alone(40e3, "N/m", _ISO),
        "quotation", SPRING),
    Row("upper arm, robot", "upper_arm", "upper arm", _robot("upper_arm"), "stiffness", _alone(30e3, "N/m", _ISO),
        "quotation", SPRING),
    Row("back, robot", "back", "back and shoulders", _robot("back"), "stiffness", _alone(35e3, "N/m", _ISO),
        "public page", SPRING),
    Row("abdomen, robot", "abdomen", "belly", _robot("abdomen"), "stiffness", _alone(10e3, "N/m", _ISO),
        "public page", SPRING),
    Row("thigh, robot", "thigh", "thigh and knee", _robot("thigh"), "stiffness", _alone(50e3, "N/m", _ISO),
        "quotation", SPRING),
    Row("arm, energy lost", "upper_arm", "several areas and directions of the arms of 20 people", _LOOP, "energy lost",
        Quantity(0.23, 0.119, 0.342, "-", "Flynn, Taberner & Nielsen, Med Eng Phys 33 (2011) 610: range of averages; "
                 "its middle"), "abstract", LOOP),
    Row("leg, share lost", "calf", "four sites of the lower limb, 8 people, three postures", _HELD, "share lost",
        Quantity(0.09, 0.029, 0.277, "-", f"{_ZHENG}: range of alpha; geometric middle"), "abstract",
        "sites and postures are mixed"),
    Row("leg, time of fading", "calf", "four sites of the lower limb, 8 people, three postures", _HELD,
        "time of fading", Quantity(0.67, 0.05, 8.93, "s", f"{_ZHENG}: range of tau of one term; geometric middle"),
        "abstract", "sites and postures are mixed"),
    Row("skin held, share lost in 40 s", "forearm", _ONE, _STRETCHED, "share lost", _alone(0.36, "-", _LAVIGNE),
        "data", RAMP, fitted="HELD_SKIN"),
    Row("skin stretched again, second peak over first", "forearm", _ONE, replace(_STRETCHED, stays=_s(59), cycles=2),
        "last peak over first", _alone(0.768, "-", _LAVIGNE), "data", AGAIN),
    Row("skin stretched once, energy lost", "forearm", _ONE, replace(_STRETCHED, stays=_s(59)), "energy lost",
        _alone(0.905, "-", _LAVIGNE), "data", AGAIN),
)  # fmt: skip
