"""What a person may set on the verb `needs`: a tissue and what presses on it, in mm and N."""

from __future__ import annotations

from dataclasses import replace
from statistics import geometric_mean
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field

from stmpl_core.errors import InvalidInput, check_millimetres
from stmpl_core.regions import HELD_SKIN
from stmpl_core.tissue import FRICTION, Membrane, Ply, Tissue

if TYPE_CHECKING:
    from stmpl_core.living import Model
    from stmpl_core.needs import Needs

OWN = ("modulus", "nu", "skin_modulus", "skin_thickness", "tension", "muscle_modulus", "muscle_depth")
NU = 0.45  # Poisson's ratio of soft tissue, of which nothing else was said
LEAST_MM = 0.2  # least length of a scene [mm]: what is told in metres is smaller


class SceneConfig(BaseModel):
    """A tissue, and what presses on it, as people say it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    part: str | None = Field(default=None, description="region of the body: forearm, upper_arm, shoulder, neck, back, "
                             "abdomen, thigh or calf")  # fmt: skip
    tone: Literal["relaxed", "tensed"] = Field(default="relaxed", description="state of the region's muscle")
    radius: tuple[float, ...] = Field(default=(20.0,), description="radius of the tool's tip [mm]; two for a range")
    force: tuple[float, ...] = Field(default=(5.0,), description="force on the tool [N]; two for a range")
    speed: tuple[float, ...] = Field(default=(), description="speed of pressing [mm/s]; two for a range; none: time is "
                                     "not judged")  # fmt: skip
    duration: float = Field(default=0.0, description="time that the tool stays pressed in at one place [s]")
    path: float = Field(default=0.0, description="way along the skin that it is led after that [mm]")
    drag: float | None = Field(default=None, description="tangential force over normal force; without it and without a "
                               "path slip is not judged")  # fmt: skip
    friction: float | str = Field(default=FRICTION, description="coefficient of friction, or the name of a pair: "
                                  "typical, dry, moist, oiled, glove")  # fmt: skip
    edge: float | None = Field(default=None, description="length of the mesh's edges [mm]; none: it is not judged")
    accuracy: float = Field(default=10.0, description="error that is allowed, in force and in motion [%]")
    thickness: float | None = Field(default=None, description="thickness from skin to bone [mm], of a tissue of your "
                                    "own instead of a region")  # fmt: skip
    modulus: float | None = Field(default=None, description="Young's modulus of its first material [kPa]")
    nu: float | None = Field(default=None, description=f"Poisson's ratio of its materials; {NU} unless given")
    skin_modulus: float | None = Field(default=None, description="Young's modulus of its skin [kPa]; none: no skin")
    skin_thickness: float | None = Field(default=None, description="thickness of its skin [mm]")
    tension: float | None = Field(default=None, description="tension of its skin [N/m]")
    muscle_modulus: float | None = Field(default=None, description="Young's modulus of its muscle [kPa]; none: no "
                                         "muscle")  # fmt: skip
    muscle_depth: float | None = Field(default=None, description="depth at which its muscle begins [mm]")

    def needs(self) -> Needs:
        """What the scene asks for. Raises InvalidInput."""
        from stmpl_core.needs import needs
        from stmpl_core.stack import Misfit

        for name in ("radius", "path", "edge", "thickness"):
            value = getattr(self, name)
            for one in value if isinstance(value, tuple) else (value or 0.0,):
                check_millimetres(f"--{name}", one, LEAST_MM)
        for name in ("radius", "force", "speed"):
            if len(values := getattr(self, name)) > 2:
                raise InvalidInput(f"--{name} has {len(values)} values; give one, or two for a range.")
        tissue, thickness = self._tissue()
        share = self.accuracy * 1e-2
        return needs(tissue, _si(self.radius), self.force, _si(self.speed), thickness=thickness,
                     duration=self.duration, path=self.path * 1e-3, drag=self.drag, friction=self.friction,
                     edge=None if self.edge is None else self.edge * 1e-3, enough=Misfit(share, share))  # fmt: skip

    def model(self, found: Needs) -> Model:
        """The smallest model that serves: tissue, thickness, and what a state has to follow."""
        from stmpl_core.living import Model
        from stmpl_core.relaxation import fades_under, series_of

        tissue, thickness = self._serves(found)
        if found.relaxing:  # as much of its force fades as of the whole tissue's, whose taut skin keeps some
            radius = geometric_mean([one.judged.contact_radius for one in found.indentations])
            whole, own = (float(series_of(*one).shares.sum()) * fades_under(*one, radius)
                          for one in (self._tissue_that_relaxes(), (tissue.relaxing(HELD_SKIN), thickness)))
            shares = tuple(g * whole / own for g in HELD_SKIN.shares)
            tissue = tissue.relaxing(replace(HELD_SKIN, shares=shares))
        friction = None if found.friction is None else str(found.friction)
        return Model(tissue.softened(found.moduli) if found.moduli < 1 else tissue, thickness, friction, found.relaxing)

    def _serves(self, found: Needs) -> tuple[Tissue, float]:
        """The elastic tissue of the smallest model, and its thickness [m]."""
        tissue, thickness = self._tissue()
        if found.layer is None:
            return (tissue if found["skin"].needed else replace(tissue, skin=None)), thickness
        one = Tissue(found.layer.youngs_modulus, tissue.poisson_ratio, tissue.density,
                     skin=tissue.skin if found.rung else None,
                     source="the one layer that serves this scene, of stmpl needs")  # fmt: skip
        return one, found.layer.thickness

    def _tissue_that_relaxes(self) -> tuple[Tissue, float]:
        tissue, thickness = self._tissue()
        return tissue.relaxing(HELD_SKIN), thickness

    def _tissue(self) -> tuple[Tissue, float]:
        if (self.part is None) == (self.thickness is None):
            raise InvalidInput("Give --part with a region of the body or --thickness with a tissue of your own, "
                               "one of them.")  # fmt: skip
        given = [name for name in OWN if getattr(self, name) is not None]
        if self.part is not None:
            if given:
                raise InvalidInput(f"--part has its own numbers; leave --{given[0].replace('_', '-')} out, or give "
                                   "--thickness instead of --part.")  # fmt: skip
            from stmpl_core.regions import region

            part = region(self.part, self.tone)
            return part.tissue, part.thickness
        if self.tone != "relaxed":
            raise InvalidInput("--tone is that of a region's muscle; leave it out, or give --part instead of "
                               "--thickness.")  # fmt: skip
        modulus, nu = self._with("modulus", "thickness"), NU if self.nu is None else self.nu
        skin, deeper = None, ()
        if {"skin_modulus", "skin_thickness", "tension"} & set(given):
            skin = Membrane(self._with("skin_modulus", "a skin") * 1e3, self._with("skin_thickness", "a skin") * 1e-3,
                            self.tension or 0.0)  # fmt: skip
        if {"muscle_modulus", "muscle_depth"} & set(given):
            depth, thickness = self._with("muscle_depth", "a muscle"), self.thickness or 0.0
            if depth >= thickness:
                raise InvalidInput(f"--muscle-depth is {depth:g} mm; it must be less than --thickness, {thickness:g} "
                                   "mm, where the bone begins.")  # fmt: skip
            modulus_of_muscle = self._with("muscle_modulus", "a muscle")
            deeper = (Ply(depth * 1e-3, modulus_of_muscle * 1e3, nu, "muscle"),)
        return Tissue(modulus * 1e3, nu, skin=skin, deeper=deeper), (self.thickness or 0.0) * 1e-3

    def _with(self, name: str, what: str) -> float:
        value = getattr(self, name)
        if value is None:
            raise InvalidInput(f"{what} wants --{name.replace('_', '-')} as well.")
        return value


def _si(millimetres: tuple[float, ...]) -> list[float]:
    return [one * 1e-3 for one in millimetres]
