"""State: what a simulation remembers from step to step, as a value."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class State:
    """Memory of the tissue: goes into a step and comes out of it. Empty: this tissue has none."""
