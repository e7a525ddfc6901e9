"""chart: speed against accuracy, every method with its own knob, on the same scenes in one run."""

from studies.chart.curves import CURVES, Curve
from studies.chart.measure import PRESETS, Chart, Point, measure

__all__ = ["CURVES", "PRESETS", "Chart", "Curve", "Point", "measure"]
