"""What the verbs of studies show: tables for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from stmpl_core.methods.ladder import Measured
    from studies.calibrate import Coverage
    from studies.chart import Chart
    from studies.chart.break_even import BreakEven
    from studies.critical_load import CriticalLoad
    from studies.stability import Report
    from studies.stability.fuzz import Fuzzed
    from studies.validate import Judged


def critical_load_table(rows: Sequence[CriticalLoad], picture: Path) -> Table:
    """The loads at which elements lose stability, for people."""
    table = Table(title="Where the finite elements lose stability", title_justify="left", caption_justify="left")
    for heading in ("load", "scene", "element"):
        table.add_column(heading)
    for heading in ("edge [mm]", "p / E"):
        table.add_column(heading, justify="right")
    table.add_column("ended")
    for row in rows:
        table.add_row(row.load, row.scene, row.element, f"{row.edge * 1e3:.1f}", f"{row.ratio:.2f}", row.ended)
    table.caption = f"drawn in {picture}"
    return table


def stability_table(report: Report, picture: Path) -> Table:
    """How far each method held along each axis, and its first failure, for people."""
    colours = {"flagged": "yellow", "needless": "blue", "silent": "red", "crashed": "magenta", "": "green"}
    table = Table(title="Held up to the first failure", title_justify="left", caption_justify="left", show_lines=True)
    table.add_column("axis")
    for method in report.methods:
        table.add_column(method)
    for axis in report.axes:
        cells = []
        for method in report.methods:
            one = report.summary(method, axis)
            failed = f"{one['failed_at']}: {one['law']}, {one['outcome']}"
            lines = filter(None, (one["held"], failed if one["failed_at"] else ""))
            cells.append(f"[{colours[one['outcome']]}]" + "\n".join(lines))
        table.add_row(axis, *cells)
    counts = [report.counts(method) for method in report.methods]
    for outcome in ("flagged", "needless", "silent", "crashed"):
        table.add_row(f"all trials: {outcome}", *(str(count[outcome]) for count in counts))
    again = f"drawn in {picture}; each failure runs again with stmpl stability --again FILE"
    table.caption = "\n".join([again, *report.crashes()])
    return table


def stability_markdown(report: Report) -> str:
    """How each method's trials ended, and its first failure along each axis, as tables of a page."""
    outcomes = ("held", "flagged", "needless", "silent", "crashed")
    counts = [[outcome, *(str(report.counts(m)[outcome]) for m in report.methods)] for outcome in outcomes]
    cells = []
    for axis in report.axes:
        first = report.cell(report.methods[0], axis)
        levels = first[0].level if len(first) == 1 else f"{first[0].level} to {first[-1].level}"
        cells.append([axis, levels, *(_ended(report, method, axis) for method in report.methods)])
    return "\n".join(["", *_rows(["", *report.methods], counts), "",
                      *_rows(["axis", "levels", *report.methods], cells), "",
                      *(f"- {why}" for why in report.crashes())])  # fmt: skip


def _ended(report: Report, method: str, axis: str) -> str:
    """The worst that a method did along an axis: how, where first, and which law broke."""
    failed = [row for row in report.cell(method, axis) if row.broken]
    if not failed:
        return "held"
    worst = max((row.outcome for row in failed), key=("flagged", "needless", "silent", "crashed").index)
    row = next(row for row in failed if row.outcome == worst)
    law = next((b.law for b in row.broken if not b.flagged), row.broken[0].law)
    return f"{worst} at {row.level}: {law}"


def _rows(heading: Sequence[str], cells: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (heading, ["---"] * len(heading), *cells)]


def fuzz_table(found: Mapping[str, Fuzzed], out: Path) -> Table:
    """How random contacts ended, for people."""
    table = Table(title="Random contacts", title_justify="left", caption_justify="left", show_lines=True)
    for heading in ("method", "contacts", "ended", "laws that broke", "tools were", "ms each"):
        table.add_column(heading)
    for name, one in found.items():
        counts = ["\n".join(f"{n:,} {what}" for what, n in sorted(told.items(), key=lambda item: -item[1]))
                  for told in (one.outcomes, one.broken, one.statuses)]  # fmt: skip
        table.add_row(name, f"{one.contacts:,}", *counts, f"{1e3 * one.about['seconds'] / max(one.contacts, 1):.1f}")
    table.caption = f"failures in {out}/METHOD/failures; each runs again with stmpl stability --again FILE"
    return table


def chart_table(chart: Chart, rows: list[BreakEven], out: Path) -> Table:
    """The Pareto front of every panel, and when the network has paid for itself, for people."""
    table = Table(title="Speed against accuracy: what nothing else beats", title_justify="left", show_lines=True,
                  caption_justify="left")  # fmt: skip
    for heading in ("scene", "p / E", "fastest first; error where it moves, of the peak", "network is ahead after"):
        table.add_column(heading)
    solves = {(row.scene, row.ratio): row.solves for row in rows}
    for scene in chart.about["scenes"]:
        for ratio in chart.about["ratios"]:
            front = [f"{1e3 * p.seconds:8.3g} ms {100 * p.error:6.2f} %  {p.curve}: {p.knob}"
                     for p in chart.front(scene, ratio)]  # fmt: skip
            after = solves.get((scene, ratio), float("nan"))
            table.add_row(scene, f"{ratio:g}", "\n".join(front), f"{after:,.0f} solves" if after == after else "-")
    failed = sum(p.failed for p in chart.points)
    left_out = ", ".join(chart.about["missing"]) or "nothing"
    table.caption = (f"{len(chart.points)} points, {failed} failed; {left_out} left out; drawn in {out}: chart.png, "
                     "chart.html (to point at), break_even.png; all figures in chart.json")  # fmt: skip
    return table


def coverage_table(rows: list[Coverage]) -> Table:
    """How often the stated bounds hold on loads that were not fitted, for people."""
    table = Table(title="Bounds on what was not fitted", title_justify="left")
    for heading in ("method", "load", "on"):
        table.add_column(heading)
    for heading in ("answers", "within the bound", "bound / error", "largest error / peak", "ms"):
        table.add_column(heading, justify="right")
    for r in rows:
        table.add_row(r.method, r.kind, r.use, str(r.answers), f"{r.covered:.0%}", f"{r.tight:.1f}",
                      f"{100 * r.error:.1f} %", f"{1e3 * r.seconds:.2f}")  # fmt: skip
    return table


def times_table(measured: Measured, file: Path) -> Table:
    """What a disc of a thickness' radius costs on this machine, for people."""
    table = Table(title="Time of a solve on this machine", title_justify="left", caption=f"kept in {file}")
    for heading in ("method", "small contact, 3 mm [ms]", "large contact, 3 mm [ms]", "1 in 20 is slower than"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for name, known in measured.methods.items():
        small, large = (1e3 * sum(c * x for c, x in zip(known.seconds, (1, m, 0.5 * m, p * m), strict=True))
                        for p, m in ((40, 1900), (800, 4000)))  # fmt: skip
        table.add_row(name, f"{small:.2f}", f"{large:.2f}", f"x {known.slow:.2f}")
    return table


def validation_table(judged: Sequence[Judged], picture: Path) -> Table:
    """The model beside published measurements, for people."""
    from studies.validate import met, said

    table = Table(title="The model beside published measurements", title_justify="left", caption_justify="left")
    for heading in ("row", "model", "measured"):
        table.add_column(heading)
    table.add_column("ratio", justify="right")
    for heading in ("meets", "matters most"):
        table.add_column(heading)
    for one in judged:
        verdict = f"[{'blue' if one.row.fitted else 'green' if one.inside else 'red'}]{one.verdict}"
        table.add_row(one.row.name, said(one.model), said(one.row.measured), f"{one.ratio:.2g}", verdict,
                      one.most.replace("_", " "))  # fmt: skip
    inside, of = met(judged)
    where = f"drawn in {picture}, reasons and sources in {picture.parent}/table.md"
    table.caption = f"{inside} of {of} rows meet; {where}"
    return table
