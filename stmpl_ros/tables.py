"""What the command shows of a recording and of a comparison: tables for people, figures for machines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from bags.compare import Comparison, Presser, compare_run
from bags.reader import Bag
from bags.report import headline
from stmpl_core.methods.base import Method
from stmpl_core.metrics import mean_and_deviation

if TYPE_CHECKING:
    from fem_tools.calibrate import Coverage
    from fem_tools.chart import Chart
    from fem_tools.chart.break_even import BreakEven
    from fem_tools.critical_load import CriticalLoad
    from fem_tools.stability import Report
    from stmpl_core.ladder import Measured


def compare_with_progress(
    path: Path, reference: Method | Presser, frames: int, *, method: Method | None = None, quiet: bool = False
) -> Comparison:
    """bags.compare.compare_run under a progress bar on stderr. Raises BagError."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        task = progress.add_task(f"frames solved by {reference.name}", total=frames)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        return compare_run(path, reference, frames=frames, method=method, on_frame=show)


def figures_of(comparison: Comparison) -> dict[str, Any]:
    """All figures of a comparison, for machines: lengths in metres, times in seconds."""
    timing = comparison.run.timing
    figures = {
        "method": comparison.method,
        "reference": comparison.reference,
        "passed": comparison.passed,
        "answers": timing.answers,
        "instants": timing.instants,
        "skipped": timing.skipped,
        "lost": timing.lost,
        "instant_rate": timing.instant_rate,
        "answer_rate": timing.answer_rate,
        "latency_median": timing.latency(50),
        "latency_p99": timing.latency(99),
        "frames": len(comparison.judged),
        "failed": comparison.failed,
    }
    if comparison.judged:
        figures["score"] = vars(mean_and_deviation([pair.score for pair in comparison.judged])[0])
    return figures


def comparison_table(comparison: Comparison) -> Table:
    """All figures of a comparison, for people."""
    table = Table(show_header=False, title="the run", title_justify="left", caption_justify="left")
    table.add_column()
    table.add_column(justify="right")
    for name, value in headline(comparison):
        table.add_row(name, value)
    table.caption = comparison.verdict
    return table


@contextmanager
def contacts_bar(preset: str, *, quiet: bool = False) -> Iterator[Callable[[int, int, int, int], None]]:
    """A progress bar on stderr for fem_tools.generate: contacts done, samples kept and dropped, time left."""
    counts = TextColumn("{task.fields[kept]:,} samples, {task.fields[dropped]:,} dropped")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), counts, TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as progress:
        task = progress.add_task(f"contacts of {preset}", total=None, kept=0, dropped=0)

        def show(done: int, total: int, kept: int, dropped: int) -> None:
            progress.update(task, completed=done, total=total, kept=kept, dropped=dropped)

        yield show


@contextmanager
def steps_bar(what: str, *, quiet: bool = False) -> Iterator[Callable[[int, int, str], None]]:
    """A progress bar on stderr: steps done, in all, what to say of it, time left."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[said]}"),
               TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as progress:
        task = progress.add_task(what, total=None, said="")

        def show(done: int, total: int, said: str) -> None:
            progress.update(task, completed=done, total=total, said=said)

        yield show


def data_table(manifest: dict[str, Any], folder: Path) -> Table:
    """What a data set holds, for people."""
    table = Table(title=str(folder), title_justify="left", caption_justify="left")
    for heading in ("split", "load", "contacts"):
        table.add_column(heading)
    table.add_column("samples", justify="right")
    for name, count in manifest["counts"].items():
        table.add_row(*name.split("/"), f"{count:,}")
    table.caption = f"{manifest['samples']:,} samples, {len(manifest['dropped']):,} dropped: see manifest.json"
    return table


def critical_loads_with_progress(*, quiet: bool = False) -> list[CriticalLoad]:
    """fem_tools.critical_load.critical_loads under a progress bar on stderr."""
    from fem_tools.critical_load import critical_loads, presses

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        return list(progress.track(critical_loads(), total=len(presses()), description="presses of a flat layer"))


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
    colours = {"flagged": "yellow", "silent": "red", "crashed": "magenta", "": "green"}
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
    for outcome in ("flagged", "silent", "crashed"):
        table.add_row(f"all trials: {outcome}", *(str(count[outcome]) for count in counts))
    table.caption = f"drawn in {picture}; each failure runs again with stmpl stability --again FILE"
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


def bag_figures(bag: Bag) -> dict[str, Any]:
    """What a recording holds, for machines."""
    return {
        "file": str(bag.file),
        "finished": bag.finished,
        "damage": [vars(damage) for damage in bag.damage],
        "method": bag.provenance.method,
        "versions": dict(bag.provenance.versions),
        "topics": {topic.name: topic._asdict() for topic in bag.topics.values()},
    }


def bag_table(bag: Bag) -> Table:
    """What a recording holds, for people."""
    table = Table(title=str(bag.file), title_justify="left", caption_justify="left")
    for heading in ("topic", "type"):
        table.add_column(heading)
    for heading in ("messages", "seconds", "Hz"):
        table.add_column(heading, justify="right")
    for topic in sorted(bag.topics.values()):
        seconds = (topic.last_ns - topic.first_ns) / 1e9
        rate = f"{(topic.messages - 1) / seconds:.1f}" if seconds > 0 else ""
        table.add_row(topic.name, topic.type_name, f"{topic.messages:,}", f"{seconds:.2f}", rate)
    table.caption = f"{'finished' if bag.finished else 'not finished by its writer'}, {len(bag.damage)} places damaged"
    return table
