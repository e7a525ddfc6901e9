"""Where a method fails: axes swept until a law breaks, each failure kept so that it can be run again."""

from studies.stability.laws import LAWS
from studies.stability.methods import METHODS, maker
from studies.stability.suite import Report, Row, again, judge, stability
from studies.stability.sweeps import AXES, PRESETS, Preset
from studies.stability.trial import Mesh, Scene, Trial, Twin

__all__ = ["AXES", "LAWS", "METHODS", "PRESETS", "Mesh", "Preset", "Report", "Row", "Scene", "Trial", "Twin", "again",
           "judge", "maker", "stability"]  # fmt: skip
