"""Limits: how much of a body region's pressure and force limits the contacts use. Advisory, not a safety function."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stmpl_core.errors import InvalidInput, sentence_of
from stmpl_core.text_file import text_of
from stmpl_core.touch import Touch

ADVISORY = "advisory, not a safety function"
SHAPE = "regions: {PART: {pressure_kpa: 1800, force_n: 160, source: where they are from}}, as config/limits.yaml"


class Limit(BaseModel):
    """Limit of one region of the body, with its source."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pressure_kpa: float = Field(gt=0, description="largest pressure [kPa]")
    force_n: float = Field(gt=0, description="largest force of one contact [N]")
    source: str = Field(min_length=1, description="source of the figures")


class LimitsFile(BaseModel):
    """A limits file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    warn_at: float = Field(default=0.8, gt=0, le=1, description="share of a limit from which on it is a warning")
    regions: dict[str, Limit]


class Limits:
    """Largest shares of the limits that contacts used since last asked.

    Args:
        region: part of the body that answers.
        limit: limit that holds there.
        warn_at: share of the limit from which on it is a warning.
    """

    def __init__(self, region: str, limit: Limit, warn_at: float) -> None:
        self.region, self.limit, self.warn_at = region, limit, warn_at
        self.pressure_share = self.force_share = 0.0

    @classmethod
    def read(cls, path: str, region: str) -> Limits | None:
        """The limits of a region by a YAML file; None if `path` is empty. Raises InvalidInput."""
        if not path:
            return None
        from ruamel.yaml import YAML, YAMLError

        try:
            read = YAML(typ="safe").load(text_of(path))
        except (OSError, UnicodeDecodeError, YAMLError, RecursionError) as error:
            why = getattr(error, "problem", None) or error  # YAML's own text has many lines
            raise InvalidInput(f"limits file {path}: {why}. It holds {SHAPE}.") from error
        if not isinstance(read, dict):
            raise InvalidInput(f"limits file {path} holds no table of limits. It holds {SHAPE}.")
        try:
            file = LimitsFile.model_validate(read)
        except ValidationError as error:
            raise InvalidInput(f"limits file {path}: {sentence_of(error)}. See config/limits.yaml.") from error
        if region not in file.regions:
            raise InvalidInput(f"limits file {path} has no region '{region}'; it has {', '.join(file.regions)}.")
        return cls(region, file.regions[region], file.warn_at)

    def put(self, touches: Sequence[Touch]) -> None:
        """Takes the touches of an instant. Pressures add; force is what each contact presses with, by itself."""
        pressures = [touch.pressure for touch in touches if touch.pressure is not None]
        if pressures:
            peak = 1e-3 * float(np.max(np.sum(pressures, axis=0), initial=0.0))
            self.pressure_share = max(self.pressure_share, peak / self.limit.pressure_kpa)
        force = max((touch.force for touch in touches), default=0.0)
        self.force_share = max(self.force_share, force / self.limit.force_n)

    def take(self) -> tuple[bool, dict[str, str]]:
        """Whether to warn, and what to tell, of the time since the last call."""
        told = {
            "region": self.region,
            "share of the pressure limit [%]": f"{100 * self.pressure_share:.3g}",
            "share of the force limit [%]": f"{100 * self.force_share:.3g}",
            "pressure limit [kPa]": f"{self.limit.pressure_kpa:g}",
            "force limit [N]": f"{self.limit.force_n:g}",
            "source": self.limit.source,
        }
        warn = max(self.pressure_share, self.force_share) >= self.warn_at
        self.pressure_share = self.force_share = 0.0
        return warn, told
