"""Distance fields of many tools at once: each distinct surface is built once, several at a time."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from logging.handlers import BufferingHandler

from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.pool import Pool
from stmpl_core.sdf import MARGIN, SignedDistance
from stmpl_core.tool import Tool

log = logging.getLogger(__name__)

MIN_FIELDS_PER_WORKER = 4  # surfaces that pay for a process; it takes as long to start as three of them to be built
Built = tuple[SignedDistance | StmplError, list[logging.LogRecord]]


def fields_of(
    tools: Sequence[Tool], *, spacing: float | None = None, margin: float = MARGIN, rounding: float = 0.0,
    workers: int | None = None
) -> list[SignedDistance | StmplError]:  # fmt: skip
    """Distance field of each tool in the order given, or the error that refuses it; alike surfaces share one field.

    Eight and more distinct surfaces are built in processes of their own. A script that calls this needs the usual
    `if __name__ == "__main__":` then, because each process imports it.

    Args:
        tools: tools, in any order.
        spacing: edge of the grids' cells [m]; None: chosen for each surface (see SignedDistance.of).
        margin: width of the grids around the surfaces [m].
        rounding: radius to which edges are rounded [m].
        workers: number of processes at most; None: one a core.

    Raises:
        InvalidInput: fewer than one worker.
    """
    workers = len(os.sched_getaffinity(0)) if workers is None else workers
    if workers < 1:
        raise InvalidInput(f"workers is {workers}; at least 1 is needed.")
    contents = [tool.digest for tool in tools]
    distinct = dict(zip(contents, tools, strict=True))
    build = partial(_built, spacing=spacing, margin=margin, rounding=rounding)
    many = min(workers, len(distinct) // MIN_FIELDS_PER_WORKER)
    fields: list[SignedDistance | StmplError] = []
    if many > 1:
        try:
            with Pool(many) as pool:
                fields = _heard(pool.map(partial(_recorded, build), distinct.values()))
        except BrokenProcessPool:
            log.warning("the processes that build distance fields died; the fields are built one by one instead")
    fields = fields or [build(tool) for tool in distinct.values()]
    by_content = dict(zip(distinct, fields, strict=True))
    return [by_content[content] for content in contents]


def _built(tool: Tool, *, spacing: float | None, margin: float, rounding: float) -> SignedDistance | StmplError:
    try:
        return SignedDistance.of(tool, spacing=spacing, margin=margin, rounding=rounding)
    except StmplError as error:
        return error


def _recorded(build: partial[SignedDistance | StmplError], tool: Tool) -> Built:
    """A field, and what was logged on the way: another process has no one to tell."""
    records, root = BufferingHandler(1000), logging.getLogger()
    root.addHandler(records)
    try:
        return build(tool), records.buffer
    finally:
        root.removeHandler(records)


def _heard(results: Iterable[Built]) -> list[SignedDistance | StmplError]:
    """The fields; what their processes logged is logged here."""
    fields = []
    for field, records in results:
        fields.append(field)
        for record in records:
            logging.getLogger(record.name).handle(record)
    return fields
