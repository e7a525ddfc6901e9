"""What the command shows of a recording and of a comparison: tables for people, figures for machines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

if TYPE_CHECKING:
    from bags.compare import Comparison, Presser
    from bags.reader import Bag
    from bags.survey import Survey
    from stmpl_core.methods.base import Method


def compare_with_progress(
    run: Path | Survey, reference: Method | Presser, frames: int, *, method: Method | None = None, quiet: bool = False
) -> Comparison:
    """bags.compare.compare_run under a progress bar on stderr. Raises BagError."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from bags.compare import compare_run

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        task = progress.add_task(f"frames solved by {reference.name}", total=frames)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        return compare_run(run, reference, frames=frames, method=method, on_frame=show)


def figures_of(comparison: Comparison) -> dict[str, Any]:
    """All figures of a comparison, for machines: lengths in metres, times in seconds."""
    from stmpl_core.metrics import mean_and_deviation

    timing = comparison.run.timing
    figures = {
        "method": comparison.method,
        "reference": comparison.reference,
        "passed": comparison.passed,
        "tolerance": comparison.tolerance,
        "reason": comparison.reason,
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
    from bags.compare import headline

    table = Table(show_header=False, title="the run", title_justify="left", caption_justify="left")
    table.add_column()
    table.add_column(justify="right")
    for name, value in headline(comparison):
        table.add_row(name, value)
    table.caption = comparison.verdict
    return table


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


def bag_figures(bag: Bag) -> dict[str, Any]:
    """What a recording holds, for machines."""
    return {
        "file": str(bag.file),
        "finished": bag.finished,
        "damage": [vars(damage) for damage in bag.damage],
        "method": bag.provenance.method,
        "versions": dict(bag.provenance.versions),
        "namespaces": bag.namespaces,
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
    robots = f"{len(bag.namespaces)} robots: {', '.join(bag.namespaces)}; " if len(bag.namespaces) > 1 else ""
    state = "finished" if bag.finished else "not finished by its writer"
    table.caption = f"{robots}{state}, {len(bag.damage)} places damaged"
    return table
