"""Report: the judged rows as JSON and as a table of a page, in the units that people read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from stmpl_core.regions import Quantity
from studies.validate.judge import Judged

UNITS = {  # factor, and what people read
    "N/m": (1e-3, "N/mm"), "N": (1.0, "N"), "Pa": (1e-3, "kPa"), "-": (1.0, ""), "s": (1.0, "s"),
}  # fmt: skip
FITTED = ("No parameter was fitted on a row that is judged; inputs have the sources, or are assumed, as "
          "stmpl_core.regions says.")  # fmt: skip


def said(quantity: Quantity) -> str:
    """A number with its ends and its unit: "0.20 (0.07 to 0.33) N/mm"; without ends where it has none."""
    factor, unit = UNITS[quantity.unit]
    middle, low, high = (f"{factor * x:.2g}" for x in (quantity.value, quantity.low, quantity.high))
    ends = "" if low == high else f" ({low} to {high})"
    return f"{middle}{ends} {unit}".strip()


def as_dict(judged: Sequence[Judged]) -> dict[str, object]:
    """Every row, and how many are inside, for machines."""
    inside, of = met(judged)
    return {"fitted": FITTED, "inside": inside, "of": of, "rows": [one.as_dict() for one in judged]}


def met(judged: Sequence[Judged]) -> tuple[int, int]:
    """How many rows meet, of how many that nothing was fitted on."""
    fair = [one for one in judged if not one.row.fitted]
    return sum(one.inside for one in fair), len(fair)


def markdown(judged: Sequence[Judged]) -> str:
    """The rows as a table of a page, then why rows are outside and where each comes from."""
    lines = ["| row | protocol | asked | model | measured | model / measured | meets | matters most |",
             "| --- | --- | --- | --- | --- | ---: | --- | --- |"]  # fmt: skip
    for one in judged:
        row, verdict = one.row, one.verdict
        asked = f"{row.asked}, {row.protocol.way}"
        lines.append(f"| {row.name} | {row.protocol.said} | {asked} | {said(one.model)} | {said(row.measured)} | "
                     f"{one.ratio:.2g} | {verdict} | {one.most.replace('_', ' ')} |")  # fmt: skip
    why: dict[str, list[str]] = {}
    for one in judged:
        if not one.inside:
            why.setdefault(one.row.outside, []).append(one.row.name)
    lines += ["", "Likely reasons of rows that do not meet:", ""]
    lines += [f"- {'; '.join(names)}: {reason}." for reason, names in why.items()]
    lines += ["", "Sources:", ""]
    lines += [f"- {one.row.name}: {one.row.site}. {one.row.measured.source} ({one.row.read}). Tool: "
              f"{one.row.protocol.radius.source}." for one in judged]  # fmt: skip
    return "\n".join([*lines, "", FITTED, ""])


def save(judged: Sequence[Judged], folder: Path) -> Path:
    """Writes report.json, table.md and validate.png into a folder; gives the picture's path."""
    from studies.validate.picture import draw

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text(json.dumps(as_dict(judged), indent=2) + "\n")
    (folder / "table.md").write_text(markdown(judged))
    return draw(judged, folder / "validate.png")
