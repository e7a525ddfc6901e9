"""Console: what commands print: figures for people or machines, and progress bars with the time left."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def print_figures(shown: object) -> None:
    """Prints a dict as JSON for machines, anything else as rich shows it to people."""
    if isinstance(shown, dict):
        sys.stdout.write(json.dumps(jsonable(shown), indent=2, default=str) + "\n")
        return
    from rich.console import Console

    class Plain(Console):
        def on_broken_pipe(self) -> None:  # rich ends the process with 1, as if something were wrong
            raise BrokenPipeError

    Plain().print(shown)


def jsonable(value: Any) -> Any:
    """The same with null for what is not finite, which JSON does not know."""
    if isinstance(value, dict):
        return {key: jsonable(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def contacts_bar(preset: str, *, quiet: bool = False) -> Iterator[Callable[[int, int, int, int], None]]:
    """A progress bar on stderr for fem_tools.generate: contacts done, samples kept and dropped, time left."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[said]}"),
               TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as progress:
        task = progress.add_task(what, total=None, said="")

        def show(done: int, total: int, said: str) -> None:
            progress.update(task, completed=done, total=total, said=said)

        yield show
