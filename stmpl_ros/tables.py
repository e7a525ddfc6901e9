"""What the command shows of a recording and of a comparison: tables for people, figures for machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from bags.compare import Comparison, compare_run
from bags.reader import Bag
from stmpl_core.methods.base import Method


def compare_with_progress(path: Path, reference: Method, frames: int, *, quiet: bool = False) -> Comparison:
    """bags.compare.compare_run under a progress bar on stderr. Raises BagError."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        task = progress.add_task(f"frames solved by {reference.name}", total=frames)
        return compare_run(
            path, reference, frames=frames, on_frame=lambda done, total: progress.update(task, completed=done, total=total)
        )


def timing_figures(comparison: Comparison) -> dict[str, float]:
    """Rates [Hz], latencies [ms] and losses of the run, by their heading."""
    timing = comparison.run.timing
    return {
        "contact messages Hz": timing.instant_rate,
        "answers Hz": timing.answer_rate,
        "contacts answered %": 100 * timing.kept,
        "latency median ms": 1e3 * timing.latency(50),
        "latency p99 ms": 1e3 * timing.latency(99),
        "answers lost": timing.lost,
    }


def error_figures(comparison: Comparison) -> dict[str, float]:
    """The scores, averaged over the judged frames, by their heading."""
    rows = [pair.score.row() for pair in comparison.judged]
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]} if rows else {}


def figures_of(comparison: Comparison) -> dict[str, Any]:
    """All figures of a comparison, for machines."""
    return {
        "method": comparison.method,
        "reference": comparison.reference,
        "frames": len(comparison.judged),
        "failed": comparison.failed,
        **timing_figures(comparison),
        **error_figures(comparison),
        "passed": comparison.passed,
    }


def comparison_table(comparison: Comparison) -> Table:
    """All figures of a comparison, for people."""
    table = Table(title=f"{comparison.method} against {comparison.reference}", title_justify="left", caption_justify="left")
    table.add_column("over the run")
    table.add_column("", justify="right")
    for name, value in timing_figures(comparison).items():
        table.add_row(name, f"{value:.4g}")
    table.add_section()
    table.add_row(f"[bold]error, mean over {len(comparison.judged)} frames", "")
    for name, value in error_figures(comparison).items():
        table.add_row(name, f"{value:.3f}" if "mm" in name.split()[-1:] else f"{value:.1f}")
    table.caption = comparison.verdict
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
