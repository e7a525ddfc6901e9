"""Where a method fails: axes swept until a law breaks, each failure kept so that it can be run again."""

from fem_tools.stability.laws import LAWS
from fem_tools.stability.methods import METHODS, maker
from fem_tools.stability.suite import Report, Row, again, judge, stability
from fem_tools.stability.sweeps import AXES, PRESETS, Preset
from fem_tools.stability.trial import Mesh, Scene, Trial, Twin

__all__ = ["AXES", "LAWS", "METHODS", "PRESETS", "Mesh", "Preset", "Report", "Row", "Scene", "Trial", "Twin", "again",
           "judge", "maker", "stability"]  # fmt: skip
