"""What is drawn: bodies, the contacts on them, the loads of each, and which split a contact belongs to."""

from __future__ import annotations

import hashlib
import math
import string
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from fem_tools.hand import Hand
from fem_tools.newton import MAX_WORK
from fem_tools.scenes import EDGE, Scene, Site, UnusableContact, ellipse, letter
from stmpl_core.body import Body
from stmpl_core.bones import bones_of, to_bone
from stmpl_core.layer import SoftLayer
from stmpl_core.living import DEEPEST, filled
from stmpl_core.regions import Tone
from stmpl_core.tissue import Membrane, Ply, Tissue

Kind = Literal["pressure", "nodal", "indenter"]
SetName = Literal["disc", "ellipse", "seam", "field", "indenter", "tool", "hand", "band", "letter"]
Split = Literal["train", "val", "test", "ood", "held_out"]

IN_DISTRIBUTION: tuple[SetName, ...] = ("disc", "ellipse", "seam", "field", "indenter", "tool")
OUT_OF_DISTRIBUTION: tuple[SetName, ...] = ("hand", "band", "letter")
SHARES = (0.8, 0.9)  # of the contacts of a set on a body: training up to the first, validation up to the second
NEW = 1  # seed of contacts that judge: no network has learnt from one of that seed
ATTEMPTS = 60  # at a contact before it is given up
RADII = (5e-3, 20e-3)  # m, of discs and of the larger semi-axis of ellipses
ASPECTS = (1.3, 3.0)  # of ellipses
WIDTHS = (10e-3, 40e-3)  # m, of straps
HEIGHTS = (25e-3, 45e-3)  # m, of letters
DEPTHS = (3e-3, 5e-3)  # m, that a grasping hand sinks in
REGIONS = (10e-3, 45e-3)  # m, radii of uneven pressures
WAVES = (15e-3, 60e-3)  # m, their wavelengths
BALLS = (8e-3, 20e-3)  # m, radii of rounded indenters
TOOLS = ("sphere", "ellipsoid", "capsule", "cylinder", "box", "hull", "letter", "torus", "edge", "corner", "pin",
         "plate")  # of the set "tool"  # fmt: skip
SIZES = (4e-3, 25e-3)  # m, half their width
TILT = 0.25  # rad, of a tool's axis and of its way
SLANTED, SLANT = 0.25, 0.8  # share of tools that come at a slant of up to so much [rad]
SHALLOWEST = 0.01  # thicknesses, of indenters
SKIN = 1.5e-3  # m, thickness of a skin
DRAWN, DRAWN_SHARE = 20, 0.2  # bodies whose stack is drawn, and their share of the contacts


class StackPlan(BaseModel):
    """Fat on muscle under a skin, in ratios to fat and to the layer's median thickness t."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kappa: float = Field(ge=0)  # E_s h / (E t); 0: no skin
    pull: float = Field(default=0.0, ge=0)  # T / (E t)
    fat: float = Field(default=1.0, gt=0, le=1)  # depth at which muscle begins, over t; 1: no muscle
    muscle: float = Field(default=1.0, gt=0)  # its modulus over that of fat

    def tissue(self, poisson_ratio: float, thickness: float) -> Tissue:
        """The tissue, of fat of 1 kPa, for a median thickness [m]."""
        fat = Tissue(poisson_ratio=poisson_ratio)
        unit = fat.youngs_modulus * thickness
        skin = Membrane(self.kappa * unit / SKIN, SKIN, self.pull * unit) if self.kappa else None
        muscle = Ply(self.fat * thickness, self.muscle * fat.youngs_modulus, poisson_ratio)
        return replace(fat, skin=skin, deeper=(muscle,) if self.fat < 1 else ())


class BodyPlan(BaseModel):
    """One body: a phenotype, its soft layer, how far patches reach beyond a load, and what is drawn on it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    weight: float = Field(ge=0, le=1)
    gender: float = Field(default=0.5, ge=0, le=1)  # 1: female
    muscle: float = Field(default=0.5, ge=0, le=1)
    thickness: float | tuple[float, float] = DEEPEST  # m; two: varies smoothly between them
    poisson_ratio: float = Field(default=0.4, ge=0, lt=0.5)
    stack: StackPlan | None = None  # None: one material, or what was measured
    tone: Tone | None = None  # of the muscle: tissue as measured in the part's region, with its fat; None: as told here
    to_bone: bool = False  # columns run to the bones, or end at the thickness if they are longer
    part: str | None = None  # of the body; None: the plan's
    edge_length: float | None = None  # m, of the skin; None: the plan's
    reach: float = Field(default=6.0, gt=0)  # largest thicknesses under the load
    clear: float | None = None  # distance of tools from the open border, thicknesses; None: the plan's
    thickest: float | None = None  # m, of the tissue under tools; None: any
    sizes: tuple[float, float] | None = None  # m, half the width of tools; None: the plan's
    tools: tuple[str, ...] | None = None  # kinds of tools; None: all
    shallowest: float = Field(default=0.0, ge=0, lt=1)  # thicknesses, from which tools are looked at
    most_work: float | None = None  # multiplications of a press; None: the plan's
    share: float = Field(default=1.0, gt=0, le=1)  # of the plan's contacts
    paper_rule: bool = True  # the same contacts once more as the paper loads them
    out_of_distribution: bool = True
    held_out: bool = False  # nothing is ever learnt from it


PAPER_BODIES = tuple(  # thick bodies have thick layers, as in the paper
    BodyPlan(name=f"weight_{int(100 * w)}", weight=w, thickness=t)
    for w, t in ((0.0, 5e-3), (0.25, 6.25e-3), (0.5, 7.5e-3), (0.75, 8.75e-3), (1.0, 10e-3))
)
VARYING_BODIES = tuple(
    BodyPlan(name=name, weight=w, thickness=(2.5e-3, 12.5e-3), poisson_ratio=nu, reach=9.0, share=share,
             paper_rule=False, out_of_distribution=False)
    for name, w, nu, share in (("varying_25", 0.25, 0.4, 1.0), ("varying_75", 0.75, 0.4, 1.0),
                               ("nu_30", 0.5, 0.3, 1.0), ("nu_35", 0.9, 0.35, 1.0),
                               ("nu_45", 0.1, 0.45, 0.1), ("nu_49", 0.6, 0.49, 0.1))  # quadratic: ten times dearer
)  # fmt: skip
OTHER_LIMBS = tuple(
    BodyPlan(name=name, weight=w, thickness=t, poisson_ratio=nu, part=part, reach=9.0, share=0.1,
             paper_rule=False, out_of_distribution=False, held_out=True)
    for name, w, t, nu, part in (("calf", 0.4, 8e-3, 0.4, "left_calf"),
                                 ("thigh", 0.7, (2.5e-3, 12.5e-3), 0.37, "right_thigh"))
)  # fmt: skip

CONTACT_BODIES = tuple(
    BodyPlan(name=name, weight=w, thickness=t, poisson_ratio=nu, part=part, edge_length=edge, share=share,
             reach=6.0 if isinstance(t, tuple) else 4.5, paper_rule=False, out_of_distribution=False,
             held_out=part is not None)
    for name, w, t, nu, edge, share, part in (
        ("even_5", 0.0, 5e-3, 0.4, 3e-3, 1.0, None),
        ("even_75", 0.5, 7.5e-3, 0.4, 4e-3, 1.0, None),
        ("even_10", 1.0, 10e-3, 0.4, 4e-3, 1.0, None),
        ("varying_25", 0.25, (2.5e-3, 12.5e-3), 0.4, 3e-3, 1.0, None),
        ("nu_30", 0.5, (2.5e-3, 12.5e-3), 0.3, 4e-3, 1.0, None),
        ("nu_35", 0.75, (2.5e-3, 12.5e-3), 0.35, 3e-3, 1.0, None),
        ("nu_42", 0.1, (4e-3, 12.5e-3), 0.42, 4e-3, 0.15, None),
        ("calf", 0.4, 8e-3, 0.4, 4e-3, 0.2, "left_calf"),
        ("thigh", 0.7, (2.5e-3, 12.5e-3), 0.37, 3e-3, 0.2, "right_thigh"),
    )
)  # fmt: skip


TISSUE_BODIES = tuple(
    BodyPlan(name=name, weight=w, thickness=t, poisson_ratio=nu, part=part, edge_length=edge, to_bone=part != "back",
             stack=StackPlan(kappa=kappa, pull=pull, fat=fat, muscle=muscle), reach=6.0 + kappa / 5, paper_rule=False,
             out_of_distribution=False, share=share, held_out=part[:5] == "right")
    for name, w, part, t, edge, nu, kappa, pull, fat, muscle, share in (
        # what a limb has, to the bone and above it
        ("arm_bone", 0.5, "left_arm", 0.06, 7e-3, 0.45, 2.0, 0.15, 0.3, 5.0, 1.0),
        ("arm_lean", 0.1, "left_arm", 0.06, 6e-3, 0.45, 6.0, 0.4, 0.15, 8.0, 1.0),
        ("arm_heavy", 0.9, "left_arm", 0.06, 8e-3, 0.43, 1.0, 0.1, 0.5, 4.0, 1.0),
        ("arm_20", 0.4, "left_arm", 0.02, 6e-3, 0.4, 3.0, 0.2, 0.6, 3.0, 1.0),
        ("arm_12", 0.6, "left_arm", 0.012, 4e-3, 0.45, 10.0, 0.6, 1.0, 1.0, 1.0),
        ("leg_bone", 0.5, "left_leg", 0.08, 12e-3, 0.45, 1.5, 0.1, 0.2, 5.0, 0.6),
        ("leg_30", 0.7, "left_leg", 0.03, 9e-3, 0.42, 5.0, 0.3, 0.35, 12.0, 1.0),
        # what is flatter and wider than a limb
        ("back_14", 0.2, "back", 0.014, 7e-3, 0.45, 10.0, 0.35, 0.25, 15.0, 1.0),
        ("back_18", 0.5, "back", 0.018, 8e-3, 0.45, 7.0, 0.25, 0.33, 12.0, 1.0),
        ("back_22", 0.8, "back", 0.022, 9e-3, 0.43, 5.0, 0.15, 0.45, 10.0, 1.0),
        ("back_30", 0.7, "back", 0.03, 9e-3, 0.45, 3.0, 0.1, 0.5, 8.0, 1.0),
        # the ends of the ranges
        ("bare", 0.3, "left_arm", 0.02, 6e-3, 0.42, 0.0, 0.0, 0.5, 4.0, 1.0),
        ("drum", 0.5, "left_arm", 0.015, 5e-3, 0.4, 30.0, 1.0, 1.0, 1.0, 1.0),
        ("sheet", 0.8, "left_arm", 0.025, 7e-3, 0.35, 0.3, 0.02, 1.0, 1.0, 1.0),
        ("even", 0.2, "left_arm", 0.03, 8e-3, 0.45, 1.0, 0.05, 1.0, 1.0, 1.0),
        # nothing is learnt from these
        ("forearm", 0.6, "right_forearm", 0.06, 6e-3, 0.45, 2.5, 0.2, 0.25, 6.0, 0.4),
        ("thigh", 0.3, "right_thigh", 0.05, 10e-3, 0.45, 3.0, 0.15, 0.2, 5.0, 0.4),
    )
)  # fmt: skip

Person = tuple[str, float, float, float, str, Tone, float, float, float]
PEOPLE: tuple[Person, ...] = (
    # name, weight, gender, muscle, part, tone, edge length [m], reach, share
    ("upper_arm_1", 0.35, 0.0, 0.5, "left_upper_arm", "relaxed", 8e-3, 6.0, 1.0),
    ("upper_arm_2", 0.6, 1.0, 0.5, "left_upper_arm", "relaxed", 8e-3, 6.0, 1.0),
    ("upper_arm_3", 0.7, 0.3, 0.5, "left_upper_arm", "tensed", 8e-3, 6.0, 1.0),
    ("forearm_1", 0.3, 1.0, 0.5, "left_forearm", "relaxed", 6e-3, 6.7, 0.5),
    ("forearm_2", 0.65, 0.0, 0.5, "left_forearm", "relaxed", 7e-3, 6.7, 0.5),
    ("forearm_3", 0.5, 1.0, 0.5, "left_forearm", "tensed", 6e-3, 6.7, 0.5),
    ("thigh", 0.4, 0.8, 0.5, "left_thigh", "relaxed", 11e-3, 6.7, 0.3),
    ("calf", 0.6, 0.2, 0.5, "left_calf", "relaxed", 8e-3, 6.7, 0.3),
)
DEEP: tuple[Person, ...] = (
    ("upper_arm_1", 0.45, 0.2, 0.5, "left_upper_arm", "relaxed", 8e-3, 6.7, 0.38),
    ("upper_arm_2", 0.75, 0.9, 0.5, "left_upper_arm", "relaxed", 8e-3, 6.7, 0.38),
    ("upper_arm_3", 0.25, 0.6, 0.5, "left_upper_arm", "tensed", 8e-3, 6.7, 0.27),
    ("forearm_1", 0.7, 0.4, 0.5, "left_forearm", "relaxed", 7e-3, 6.7, 0.27),
    ("forearm_2", 0.4, 0.1, 0.5, "left_forearm", "tensed", 7e-3, 6.7, 0.21),
    ("calf", 0.4, 0.8, 0.5, "left_calf", "relaxed", 9e-3, 6.7, 0.16),
    ("thigh", 0.65, 0.3, 0.5, "left_thigh", "relaxed", 12e-3, 6.0, 0.1),
    ("back_1", 0.35, 0.3, 0.5, "back", "relaxed", 9e-3, 6.0, 0.5),
    ("back_2", 0.7, 0.8, 0.4, "back", "relaxed", 10e-3, 6.0, 0.5),
    ("back_3", 0.2, 0.6, 0.6, "back", "relaxed", 8e-3, 6.0, 0.5),
    ("back_4", 0.5, 0.9, 0.5, "back", "tensed", 9e-3, 6.0, 0.4),
    ("back_5", 0.9, 0.4, 0.3, "back", "relaxed", 10e-3, 6.0, 0.4),
    ("forearm_3", 0.55, 0.9, 0.6, "left_forearm", "relaxed", 7e-3, 6.7, 0.45),
    ("forearm_4", 0.25, 0.2, 0.4, "left_forearm", "relaxed", 6e-3, 6.7, 0.45),
    ("shoulder", 0.6, 0.7, 0.5, "left_shoulder", "relaxed", 8e-3, 3.0, 0.35),
)
STOUT: tuple[Person, ...] = (  # much fat under a skin that is stiff beside it, on limbs as round as they are thick
    ("upper_arm_1", 0.9, 0.9, 0.2, "left_upper_arm", "relaxed", 8e-3, 6.0, 0.5),
    ("upper_arm_2", 1.0, 0.5, 0.4, "left_upper_arm", "relaxed", 8e-3, 6.0, 0.5),
    ("upper_arm_3", 0.8, 1.0, 0.1, "left_upper_arm", "tensed", 8e-3, 6.0, 0.5),
    ("upper_arm_4", 0.95, 1.0, 0.35, "left_upper_arm", "relaxed", 9e-3, 6.0, 0.5),
    ("forearm", 1.0, 1.0, 0.1, "left_forearm", "relaxed", 7e-3, 6.0, 0.4),
    ("thigh_1", 0.55, 0.7, 0.6, "left_thigh", "relaxed", 11e-3, 6.0, 0.4),
    ("thigh_2", 0.95, 0.9, 0.2, "left_thigh", "relaxed", 12e-3, 6.0, 0.3),
    ("calf", 0.95, 0.7, 0.2, "left_calf", "relaxed", 9e-3, 6.0, 0.3),
)
TRUNK: tuple[Person, ...] = (  # three materials on the abdomen, soft over stiff on neck and shoulder
    ("abdomen_1", 0.5, 0.5, 0.5, "abdomen", "relaxed", 14e-3, 3.0, 0.45),
    ("abdomen_2", 0.7, 0.9, 0.4, "abdomen", "tensed", 14e-3, 3.0, 0.35),
    ("abdomen_3", 0.3, 0.2, 0.6, "abdomen", "relaxed", 14e-3, 3.0, 0.35),
    ("neck_1", 0.5, 0.4, 0.5, "neck", "relaxed", 8e-3, 3.0, 0.35),
    ("neck_2", 0.75, 0.8, 0.4, "neck", "tensed", 8e-3, 3.0, 0.25),
    ("shoulder", 0.4, 0.6, 0.5, "left_shoulder", "relaxed", 8e-3, 3.0, 0.35),
    ("forearm_1", 0.15, 0.3, 0.6, "left_forearm", "relaxed", 6e-3, 6.0, 0.35),
    ("forearm_2", 0.5, 0.7, 0.5, "left_forearm", "relaxed", 6e-3, 6.0, 0.35),
    ("forearm_3", 0.8, 0.1, 0.5, "left_forearm", "relaxed", 7e-3, 6.0, 0.35),
    ("neck_3", 0.1, 0.0, 0.3, "neck", "tensed", 8e-3, 3.0, 0.35),  # the thinnest single layers that stand for people's
    ("neck_4", 0.5, 0.5, 0.5, "neck", "tensed", 8e-3, 3.0, 0.35),
    ("shoulder_2", 0.1, 0.0, 0.3, "left_shoulder", "tensed", 8e-3, 3.0, 0.35),
    ("forearm_4", 0.9, 0.0, 0.7, "left_forearm", "tensed", 7e-3, 6.0, 0.35),
)
THIN: tuple[Person, ...] = (  # where a limb's tissue is a third of its median and less, half of it skin and muscle
    ("forearm_1", 0.5, 0.5, 0.5, "left_forearm", "relaxed", 4e-3, 6.7, 0.5),
    ("forearm_2", 0.3, 0.8, 0.4, "left_forearm", "tensed", 4e-3, 6.7, 0.4),
    ("forearm_3", 0.85, 0.6, 0.3, "left_forearm", "relaxed", 4e-3, 6.7, 0.4),
    ("forearm_4", 0.15, 0.3, 0.7, "left_forearm", "relaxed", 4e-3, 6.7, 0.4),
    ("calf_1", 0.5, 0.5, 0.5, "left_calf", "relaxed", 4.5e-3, 6.7, 0.5),
    ("calf_2", 0.25, 0.2, 0.6, "left_calf", "tensed", 4.5e-3, 6.7, 0.4),
    ("calf_3", 0.75, 0.9, 0.4, "left_calf", "relaxed", 4.5e-3, 6.7, 0.4),
    ("calf_4", 0.6, 0.6, 0.7, "left_calf", "relaxed", 4.5e-3, 6.7, 0.4),
)


def _living(kind: str, people: tuple[Person, ...], **more: Any) -> tuple[BodyPlan, ...]:
    """People unlike the average one, their tissue as measured."""
    return tuple(
        BodyPlan(name=f"{kind}_{name}", weight=weight, gender=gender, muscle=muscle, part=part, tone=tone,
                 edge_length=edge, share=share, clear=2.0, reach=reach, paper_rule=False, out_of_distribution=False,
                 **more)
        for name, weight, gender, muscle, part, tone, edge, reach, share in people
    )  # fmt: skip


LIVING_BODIES = _living("living", PEOPLE, sizes=(8e-3, 40e-3))
DEEP_BODIES = _living("deep", DEEP, sizes=(12e-3, 30e-3), tools=("sphere", "ellipsoid", "capsule"),
                      shallowest=0.45, most_work=1e11)  # that go deep where tissue is thick: most others end before
STOUT_BODIES = _living("stout", STOUT, sizes=(8e-3, 40e-3), most_work=8e10)
TRUNK_BODIES = _living("trunk", TRUNK, sizes=(8e-3, 40e-3), most_work=8e10)
THIN_BODIES = _living("thin", THIN, sizes=(4e-3, 25e-3), thickest=9e-3)


def _drawn_bodies(count: int) -> tuple[BodyPlan, ...]:
    """Arms and legs of many phenotypes and stacks, so that no network learns a few stacks by heart."""
    rng, out = np.random.default_rng(1), []
    for n in range(count):
        leg = n % 4 == 3
        thickness = float(rng.choice([0.015, 0.025, 0.04, 0.06])) * (1.3 if leg else 1.0)
        kappa = float(np.exp(rng.uniform(math.log(0.3), math.log(20))))
        layered = rng.uniform() < 0.75
        stack = StackPlan(kappa=round(kappa, 2), pull=round(kappa * float(np.exp(rng.uniform(-4, -2.3))), 3),
                          fat=round(float(rng.uniform(0.12, 0.7)), 2) if layered else 1.0,
                          muscle=round(float(np.exp(rng.uniform(0.7, 2.6))), 1) if layered else 1.0)  # fmt: skip
        out.append(BodyPlan(name=f"drawn_{n:02d}", weight=round(float(rng.uniform(0.1, 0.9)), 2),
                            thickness=round(thickness, 4), poisson_ratio=round(float(rng.uniform(0.38, 0.46)), 2),
                            stack=stack, to_bone=True, part="left_leg" if leg else "left_arm",
                            edge_length=0.011 if leg else (0.005 if thickness < 0.02 else 0.007),
                            reach=6.0 + kappa / 5, share=DRAWN_SHARE, paper_rule=False,
                            out_of_distribution=False))  # fmt: skip
    return tuple(out)


class Plan(BaseModel):
    """Everything that decides what is generated: the same plan gives the same data.

    Args:
        discs, ellipses, seams, fields, indenters, tools: numbers of contacts a body, by set.
        hands, bands, letters: numbers of contacts in all, by set, shared among the bodies.
        loads, loads_out_of_distribution: numbers of loads of each contact.
        shares: shares of the contacts up to which they are for training, and for validation [-]; the rest are tests.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: str
    bodies: tuple[BodyPlan, ...] = PAPER_BODIES + VARYING_BODIES + OTHER_LIMBS
    part: str = "left_arm"
    edge_length: float = 4e-3  # m
    refine: int = Field(default=1, ge=0)  # splits of the skin near a pressure; the paper's rule has no splits
    discs: int = 1884
    ellipses: int = 216
    seams: int = 555
    fields: int = 0  # uneven pressures without a tool
    indenters: int = 0
    tools: int = 0  # rigid tools of all shapes, pressed in at a slant
    rounds: int = 0  # tools of revolution pressed into the bodies' stacks laid flat, see fem_tools.rounds
    stacks: int = 0  # likewise, into stacks of no body
    hands: int = 395
    bands: int = 40
    letters: int = 273
    loads: int = Field(default=10, ge=1)
    loads_out_of_distribution: int = Field(default=5, ge=1)
    shares: tuple[float, float] = SHARES
    highest_pressure: float = Field(default=1.5, gt=0)  # p / E, of follower pressures
    highest_nodal: float = Field(default=0.4, gt=0)  # p / E at the worst vertex, of the paper's rule
    deepest: float = Field(default=0.7, gt=0, lt=1)  # thicknesses, of indenters
    indenter_step: float = Field(default=0.04, gt=0)  # thicknesses, of indenters
    most_work: float = Field(default=MAX_WORK, gt=0)  # multiplications of a press; deeper ones are dropped
    clear: float = Field(default=5.0, gt=0)  # distance of tools from the open border, thicknesses
    thinnest: float = Field(default=0.0, ge=0)  # thickness under tools, over the edge length
    sizes: tuple[float, float] = SIZES  # m, half the width of tools
    linear: bool = False  # elements linear in plane whatever nu is; they are 1 to 3 % off in force up to 0.45
    seed: int = 0

    @property
    def flat(self) -> int:
        """Number of all tools that are pressed into flat stacks."""
        return self.rounds + self.stacks

    def body(self, name: str) -> BodyPlan:
        """The body of that name."""
        return next(body for body in self.bodies if body.name == name)

    def loads_of(self, name: SetName) -> int:
        """Loads of each contact of a set."""
        return self.loads_out_of_distribution if name in OUT_OF_DISTRIBUTION else self.loads

    def count(self, name: SetName, body: str = "") -> int:
        """Contacts of a set: on that body where it is in distribution, in all where not."""
        whole = int(getattr(self, f"{name}s"))
        return whole if name in OUT_OF_DISTRIBUTION else math.ceil(whole * self.body(body).share)


PRESETS = {
    "tiny": Plan(preset="tiny", bodies=PAPER_BODIES[2:3], edge_length=6e-3, discs=5, ellipses=2, seams=2,
                 fields=1, indenters=1, hands=1, bands=1, letters=1, loads=3, loads_out_of_distribution=2),
    "default": Plan(preset="default", discs=150, ellipses=24, seams=44, fields=40, indenters=5),
    "paper": Plan(preset="paper", bodies=PAPER_BODIES + VARYING_BODIES[:2], indenters=40),
    "tables": Plan(preset="tables", discs=12, ellipses=3, seams=4, fields=3, hands=80, bands=8, letters=55,
                   bodies=PAPER_BODIES + VARYING_BODIES[:4] + tuple(
                       body.model_copy(update={"share": 1.0}) for body in OTHER_LIMBS), shares=(0.2, 0.2), seed=NEW),
    "contacts": Plan(preset="contacts", bodies=CONTACT_BODIES, discs=0, ellipses=0, seams=0, hands=0, bands=0,
                     letters=0, tools=60, loads=8, deepest=0.9, indenter_step=0.08),
    "tissue": Plan(preset="tissue", bodies=TISSUE_BODIES + _drawn_bodies(DRAWN) + LIVING_BODIES + DEEP_BODIES +
                   STOUT_BODIES + TRUNK_BODIES + THIN_BODIES, discs=0, ellipses=0, seams=0, hands=0, bands=0,
                   letters=0, tools=18, loads=8, deepest=0.85, indenter_step=0.12, clear=4.0, thinnest=1.4,
                   sizes=(4e-3, 40e-3), linear=True, most_work=4e10, rounds=400, stacks=300),
}  # fmt: skip


@dataclass(frozen=True, order=True)
class ContactId:
    """Names one contact: which body, which set, which number of it."""

    body: str
    set: SetName
    number: int

    def __str__(self) -> str:
        return f"{self.body}/{self.set}-{self.number:04d}"

    def rng(self, seed: int) -> np.random.Generator:
        """The contact's own random numbers, whoever draws them and when."""
        digest = hashlib.sha256(f"{seed} {self}".encode()).digest()
        return np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))


def contacts(plan: Plan) -> Iterator[ContactId]:
    """All contacts of a plan, body by body."""
    takers = [body.name for body in plan.bodies if body.out_of_distribution]
    for body in plan.bodies:
        for name in IN_DISTRIBUTION:
            yield from (ContactId(body.name, name, k) for k in range(plan.count(name, body.name)))
        if body.name in takers:
            for name in OUT_OF_DISTRIBUTION:
                first = takers.index(body.name)
                yield from (ContactId(body.name, name, k) for k in range(first, plan.count(name), len(takers)))


def split_of(plan: Plan, contact: ContactId) -> Split:
    """By contact, never by sample: all loads of a contact, under either rule, belong to one split."""
    if contact.set in OUT_OF_DISTRIBUTION:
        return "ood"
    if plan.body(contact.body).held_out:
        return "held_out"
    count = plan.count(contact.set, contact.body)
    place = (_shuffled(plan.seed, contact.body, contact.set, count)[contact.number] + 0.5) / count
    return "train" if place < plan.shares[0] else "val" if place < plan.shares[1] else "test"


@cache
def _shuffled(seed: int, body: str, name: SetName, count: int) -> list[int]:
    return ContactId(body, name, -1).rng(seed).permutation(count).tolist()


def kinds_of(plan: Plan, contact: ContactId) -> tuple[Kind, ...]:
    """How the contact presses: contacts by tools press once more as the paper's do."""
    if contact.set in ("indenter", "tool"):
        return ("indenter",)
    paper = plan.body(contact.body).paper_rule and contact.set != "field"
    return ("pressure", "nodal") if paper else ("pressure",)


def layers(plan: Plan) -> dict[str, SoftLayer]:
    """The soft layer of each body, by its name; those of one part and edge length share a chart."""
    kinds = {body.name: (body.part or plan.part, body.edge_length or plan.edge_length) for body in plan.bodies}
    patches = {kind: Body.anny(weight=0.5).patch(*kind) for kind in dict.fromkeys(kinds.values())}
    out = {}
    for body in plan.bodies:
        patch, skin = patches[kinds[body.name]], Body.anny(weight=body.weight, gender=body.gender, muscle=body.muscle)
        if body.tone:
            out[body.name] = filled(skin, patch.part, partial(patch.layer, skin), body.tone)
            continue
        thickness = body.thickness
        if isinstance(thickness, tuple):
            rng = ContactId(body.name, "disc", -2).rng(plan.seed)
            thickness = varying(patch.layer(skin, thickness=thickness[0]).vertices, thickness, rng)
        layer = patch.layer(skin, thickness=SKIN if body.to_bone else thickness,
                            tissue=Tissue(poisson_ratio=body.poisson_ratio))  # fmt: skip
        if body.to_bone:
            assert isinstance(body.thickness, float)
            layer = to_bone(layer, bones_of(skin, patch.part), body.thickness)
        if body.stack:
            layer = layer.with_(tissue=body.stack.tissue(body.poisson_ratio, float(np.median(layer.thickness))))
        out[body.name] = layer
    return out


def varying(points: np.ndarray, bounds: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """A smooth thickness that takes all values between the bounds: a few waves of 10 cm and longer, (V,) [m]."""
    waves = rng.normal(size=(6, 3))
    waves *= (2 * np.pi / rng.uniform(0.1, 0.3, size=6) / np.linalg.norm(waves, axis=1))[:, None]
    field = np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, size=6)).sum(axis=1)
    return bounds[0] + (bounds[1] - bounds[0]) * (field - field.min()) / np.ptp(field)


def ratios(plan: Plan, kind: Kind, count: int, rng: np.random.Generator, shallowest: float = 0.0) -> np.ndarray:
    """`count` loads of one contact, increasing, one in each equal part of the range: p / E, or depth over thickness.

    Those of indenters lie closer together where the contact begins, or evenly from `shallowest` thicknesses on.
    """
    highest = {"pressure": plan.highest_pressure, "nodal": plan.highest_nodal, "indenter": plan.deepest}[kind]
    share = (np.arange(count) + rng.uniform(0.05, 1.0, count)) / count
    if kind == "indenter" and shallowest:
        return shallowest + (highest - shallowest) * share
    if kind == "indenter":
        return np.maximum(highest * share**2, SHALLOWEST * (1 + np.arange(count)))
    return share * highest


def draw(
    plan: Plan, contact: ContactId, site: Site, hand: Hand | None, rng: np.random.Generator
) -> tuple[Scene, dict[str, Any]]:
    """Sets a tool down on the skin, drawing again where it cannot stand, and says what was drawn.

    Raises:
        UnusableContact: nothing fitted in ATTEMPTS.
    """
    for _ in range(ATTEMPTS):
        try:
            scene, drawn = _draw_once(plan, contact, site, hand, rng)
            return scene, drawn
        except UnusableContact as error:
            last = error
    raise UnusableContact(f"nothing fitted in {ATTEMPTS} attempts, the last because {last}")


def _draw_once(
    plan: Plan, contact: ContactId, site: Site, hand: Hand | None, rng: np.random.Generator
) -> tuple[Scene, dict[str, Any]]:
    from fem_tools.tool_shapes import rounded_tool

    layer, turn = site.layer, float(rng.uniform(0, 2 * np.pi))
    area = layer.vertex_areas
    vertex = int(rng.choice(len(area), p=area / area.sum()))
    drawn: dict[str, Any] = {"vertex": vertex, "turn": turn}
    if contact.set in ("disc", "ellipse", "seam"):
        if contact.set == "seam":
            drawn["vertex"] = vertex = int(rng.choice(layer.chart.seam_vertices))
        radius, aspect = float(rng.uniform(*RADII)), float(rng.uniform(*ASPECTS)) if contact.set == "ellipse" else 1.0
        drawn |= {"a": radius, "b": max(radius / aspect, 3e-3)}
        return site.press_flat(vertex, ellipse(drawn["a"], drawn["b"]), turn), drawn
    if contact.set == "field":
        drawn |= {"radius": float(rng.uniform(*REGIONS)), "wavelength": float(rng.uniform(*WAVES))}
        return site.uneven(vertex, drawn["radius"], drawn["wavelength"], rng), drawn
    if contact.set == "letter":
        drawn |= {"letter": string.ascii_uppercase[contact.number % 26], "height": float(rng.uniform(*HEIGHTS))}
        return site.press_flat(vertex, letter(drawn["letter"], drawn["height"]), turn), drawn
    if contact.set == "band":
        drawn |= {"width": float(rng.uniform(*WIDTHS)), "tilt": float(rng.normal(0.0, 0.15))}
        return site.strap(vertex, drawn["width"], drawn["tilt"]), drawn
    if contact.set == "hand":
        assert hand is not None
        side = float(rng.choice([0.0, np.pi]))
        loose = np.clip(rng.normal(0.0, 0.25, 5), 0, 0.9)
        drawn |= {"turn": side + float(rng.normal(0.0, 0.35)), "depth": float(rng.uniform(*DEPTHS)),
                  "loose": loose.round(4).tolist()}  # fmt: skip
        return site.grasp(vertex, hand, drawn["turn"], drawn["depth"], np.array(drawn["loose"])), drawn
    if contact.set == "tool":
        return _draw_tool(plan, contact.body, vertex, turn, site, rng, drawn)
    drawn |= {"tool": str(rng.choice(["sphere", "capsule", "cylinder"])), "radius": float(rng.uniform(*BALLS))}
    mesh = rounded_tool(drawn["tool"], drawn["radius"])
    pose = site.standing(vertex, drawn["radius"], turn)
    pose[:3, 3] += (BALLS[1] + EDGE) * pose[:3, 2]
    if (gap := float(site.border_distance[vertex])) < 6 * layer.thickness[vertex] + drawn["radius"]:
        raise UnusableContact(f"it stands {gap * 1e3:.0f} mm from the open border")
    return Scene(mesh, pose, np.zeros(len(area))), drawn


def _draw_tool(
    plan: Plan, body: str, vertex: int, turn: float, site: Site, rng: np.random.Generator, drawn: dict[str, Any]
) -> tuple[Scene, dict[str, Any]]:
    own = plan.body(body)
    size = float(np.exp(rng.uniform(*np.log(own.sizes or plan.sizes))))
    slant = SLANT if rng.uniform() < SLANTED else TILT
    drawn |= {"tool": str(rng.choice(own.tools or TOOLS)), "size": size,
              "shape": rng.uniform(0, 1, 8).round(4).tolist(),
              "tilt": rng.uniform(-TILT, TILT, 2).round(4).tolist(),
              "slant": rng.uniform(-slant, slant, 2).round(4).tolist()}  # fmt: skip
    scene = tool_scene(site, drawn)
    assert scene.tool is not None
    radius = float(np.linalg.norm(scene.tool.vertices, axis=1).max())
    clear = (plan.clear if own.clear is None else own.clear) * site.layer.thickness[vertex] + min(radius, 2 * SIZES[1])
    if site.layer.thickness[vertex] < plan.thinnest * site.layer.edge_length:
        raise UnusableContact("the tissue is thinner there than the mesh is fine")
    if own.thickest is not None and site.layer.thickness[vertex] > own.thickest:
        raise UnusableContact("the tissue is thicker there than asked")
    if (gap := float(site.border_distance[vertex])) < clear:
        raise UnusableContact(f"it stands {gap * 1e3:.0f} mm from the open border")
    return scene, drawn


def tool_scene(site: Site, drawn: Mapping[str, Any]) -> Scene:
    """The tool of the set "tool" that these figures describe, above its vertex; it goes against its z axis."""
    from fem_tools.tool_shapes import any_tool

    mesh, rounding = any_tool(drawn)
    pose = site.standing(drawn["vertex"], drawn["size"], drawn["turn"])
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_euler("xy", drawn["slant"]).as_matrix()
    pose = pose @ lean
    pose[:3, 3] += (float(np.linalg.norm(mesh.vertices, axis=1).max()) + EDGE) * pose[:3, 2]
    return Scene(mesh, pose, np.zeros(len(site.layer.vertices)), rounding)
