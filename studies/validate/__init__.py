"""Validate: the model beside published measurements on people: what meets them, and why the rest does not."""

from studies.validate.judge import Judged, judge
from studies.validate.report import as_dict, markdown, met, said, save
from studies.validate.rows import ROWS, Protocol, Row

__all__ = ["ROWS", "Judged", "Protocol", "Row", "as_dict", "judge", "markdown", "met", "said", "save"]
