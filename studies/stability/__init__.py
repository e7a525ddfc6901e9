"""Where a method fails: axes swept until a law breaks, each failure kept so that it can be run again."""

from studies.stability.laws import LAWS
from studies.stability.methods import METHODS, maker
from studies.stability.scene import Mesh, Pressures
from studies.stability.suite import Report, Row, again, judge, stability
from studies.stability.sweeps import AXES, PRESETS, Preset
from studies.stability.trial import Trial, Twin

__all__ = ["AXES", "LAWS", "METHODS", "PRESETS", "Mesh", "Preset", "Pressures", "Report", "Row", "Trial", "Twin",
           "again", "judge", "maker", "stability"]  # fmt: skip
