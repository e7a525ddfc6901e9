"""What the command shows of recordings, comparisons and parts of a body: tables for people, figures for machines."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from stmpl_core.errors import BagError

if TYPE_CHECKING:
    from bags.compare import Comparison, Presser
    from bags.provenance import Provenance
    from bags.reader import Bag
    from bags.survey import Survey
    from stmpl_core.methods.base import Method
    from stmpl_core.regions import Region

BALL_RADIUS, BALL_DEPTH = 0.010, 0.001  # ball and depth at which the stiffness of a part is told [m]
NEEDS_RADII, NEEDS_FORCES = (5e-3, 40e-3), (1.0, 20.0)  # scene for which the smallest model of a part is told [m], [N]
MOST_JUDGES, JUDGE_BYTES = 4, 4 << 30  # processes that press tools in once more, and memory that one may take
LOOKED_AT = 20  # number of answers of a recording that are looked at for their memory
RATED, RATED_S = 5, 0.1  # messages, and time over which they came [s], from which on a topic has a rate
SHOWN = {"Pa": (1e-3, "kPa"), "m": (1e3, "mm"), "N/m": (1.0, "N/m"), "-": (1.0, "")}  # factor and unit for people


def compare_with_progress(
    run: Path | Survey, reference: Method | Presser, frames: int, *, method: Method | None = None,
    tool: str = "", quiet: bool = False,
) -> Comparison:  # fmt: skip
    """bags.compare.compare_run under a progress bar on stderr. Raises BagError."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from bags.compare import compare_run

    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    workers = max(1, min(MOST_JUDGES, len(os.sched_getaffinity(0)), memory // JUDGE_BYTES)) if method is None else 1
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        task = progress.add_task(f"frames solved by {reference.name}", total=frames)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        return compare_run(run, reference, frames=frames, method=method, tool=tool, on_frame=show,
                           workers=workers)  # fmt: skip


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
        "unlike": comparison.unlike,
        "failed": comparison.failed,
        "left_out": comparison.left_out,
    }
    if comparison.whole:
        figures["whole"] = vars(comparison.whole)
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
        "memory": bag_memory(bag),
        "topics": {topic.name: topic._asdict() for topic in bag.topics.values()},
    }


def bag_memory(bag: Bag) -> dict[str, Any]:
    """What some answers of a recording, evenly over it, remember: friction of each tool, and the state's share [-]."""
    try:
        answers = bag.answers
        told = list(bag.frames(sorted({k * answers // LOOKED_AT for k in range(LOOKED_AT if answers else 0)})))
    except BagError:  # none, or those of several robots, or their schema is lost
        told = []
    remembering = [frame for frame in told if frame.state]
    size = sum(len(frame.state) + frame.displacement.nbytes
               + (0 if frame.pressure is None else frame.pressure.nbytes) for frame in told)  # fmt: skip
    friction = {name: mu for frame in remembering for name, mu in frame.friction.items()}
    share = sum(len(frame.state) for frame in told) / size if size else 0.0
    return {"looked_at": len(told), "remembering": len(remembering), "friction": friction, "share": share}


def memory_sentence(memory: dict[str, Any]) -> str:
    """The same for people; empty where nothing is remembered."""
    if not memory["remembering"]:
        return ""
    friction = ", ".join(f"{name} {mu:g}" for name, mu in memory["friction"].items() if mu)
    return (f"memory: {memory['remembering']} of {memory['looked_at']} answers that were looked at carry a state, "
            f"{memory['share']:.2%} of their size; friction: {friction or 'none'}")  # fmt: skip


def provenance_sentence(made: Provenance) -> str:
    """What made a recording, as far as it is named; empty where nothing is."""
    versions = ", ".join(f"{name} {version}" for name, version in made.versions.items())
    said = {"method: ": made.method, "body: ": made.body, "made by ": versions}
    return "; ".join(f"{label}{value}" for label, value in said.items() if value)


def bag_table(bag: Bag) -> Table:
    """What a recording holds, for people."""
    table = Table(title=str(bag.file), title_justify="left", caption_justify="left")
    for heading in ("topic", "type"):
        table.add_column(heading)
    for heading in ("messages", "seconds", "Hz"):
        table.add_column(heading, justify="right")
    for topic in sorted(bag.topics.values()):
        seconds = (topic.last_ns - topic.first_ns) / 1e9
        rate = f"{(topic.messages - 1) / seconds:.1f}" if topic.messages >= RATED and seconds >= RATED_S else ""
        table.add_row(topic.name, topic.type_name, f"{topic.messages:,}", f"{seconds:.2f}", rate)
    robots = f"{len(bag.namespaces)} robots: {', '.join(bag.namespaces)}; " if len(bag.namespaces) > 1 else ""
    state = "finished" if bag.finished else "not finished by its writer"
    table.caption = f"{robots}{state}, {len(bag.damage)} places damaged"
    return table


def part_figures(name: str) -> dict[str, Any]:
    """What a part of a body is made of, relaxed and tensed, for machines. Raises InvalidInput."""
    from dataclasses import asdict

    from stmpl_core.regions import region

    both = [region(name), region(name, "tensed")]
    return {"part": name, "where": both[0].where, "fat": _fat(both[0].name)} | {
        one.tone: {
            "quantities": {key: asdict(quantity) for key, quantity in one.quantities.items()},
            "thickness": one.thickness,
            "effective": _effective(one),
        }
        for one in both
    }


def _fat(name: str) -> dict[str, Any]:
    """How the fat of a part follows the person, and on arms and legs the side of the limb [m]."""
    from dataclasses import asdict

    from stmpl_core.body import Physique
    from stmpl_core.fat import MULTIS, SITES, fat_factor

    at = {"ten_kg_per_m2_more": (34, 0.5), "women": (24, 1.0), "men": (24, 0.0)}
    said: dict[str, Any] = {key: fat_factor(name, Physique(mass_index, 24, female))
                            for key, (mass_index, female) in at.items()}  # fmt: skip
    said["source"] = f"{MULTIS}; fitted" if name in SITES else f"assumed, as the limbs' of {MULTIS}"
    if name in SITES:
        said |= {"front": asdict(SITES[name][1].front), "back": asdict(SITES[name][1].back)}
    return said


def _effective(one: Region) -> dict[str, Any]:
    """The layer that answers most like a part, what it misses, the rung it needs, its stiffness under a ball [N/m]."""
    from stmpl_core.needs import needs
    from stmpl_core.stack import ball_force, effective

    near = effective(one.tissue, one.thickness)
    need = needs(one.tissue, NEEDS_RADII, NEEDS_FORCES, thickness=one.thickness)
    force = ball_force(one.tissue, one.thickness, BALL_RADIUS, BALL_DEPTH)
    return near._asdict() | {
        "misfit": near.misfit._asdict(),
        "bare": near.bare._asdict(),
        "ball_stiffness": force / BALL_DEPTH,
        "rung": need.rung,
        "why": need.sentence,
    }


def part_table(name: str) -> Table:
    """What a part of a body is made of, relaxed and tensed, for people: typical number, and low to high."""
    from stmpl_core.regions import region

    relaxed, tensed = region(name), region(name, "tensed")
    table = Table(title=f"{name}: {relaxed.where}", title_justify="left", caption_justify="left")
    table.add_column("quantity")
    table.add_column("unit")
    table.add_column("relaxed", justify="right")
    table.add_column("tensed", justify="right")
    table.add_column("source")
    for key, one in relaxed.quantities.items():
        other, (factor, unit) = tensed.quantities[key], SHOWN[one.unit]
        shown = [f"{q.value * factor:.3g} ({q.low * factor:.3g}-{q.high * factor:.3g})" for q in (one, other)]
        source = one.source if other == one else f"{one.source}. Tensed: {other.source}"
        table.add_row(key.replace("_", " "), unit, *shown, source)
    near = [_effective(relaxed), _effective(tensed)]
    fit = "fit to the linear response under loads of 2-40 mm radius"
    rows = [("effective modulus", "kPa", "youngs_modulus", 1e-3, fit),
            ("effective thickness", "mm", "thickness", 1e3, fit),
            ("kappa = E_s h / (E t)", "", "kappa", 1.0, "with effective E and t"),
            ("pull = T / (E t)", "", "pull", 1.0, "with effective E and t"),
            ("stiffness", "N/mm", "ball_stiffness", 1e-3,
             f"linear response to a ball of {BALL_RADIUS * 1e3:g} mm, {BALL_DEPTH * 1e3:g} mm deep")]  # fmt: skip
    fat = _fat(relaxed.name)
    table.add_section()
    for side in ("front", "back"):
        if side in fat:
            sizes = [f"{fat[side][key] * 1e3:.3g}" for key in ("value", "low", "high")]
            table.add_row(f"fat, {side}", "mm", *2 * [f"{sizes[0]} ({sizes[1]}-{sizes[2]})"], fat[side]["source"])
    for label, key in (("10 kg/m2 more", "ten_kg_per_m2_more"), ("women", "women"), ("men", "men")):
        table.add_row(f"fat, {label}", "times", *2 * [f"{fat[key]:.2f}"], fat["source"])
    table.add_section()
    for label, unit, key, factor, source in rows:
        table.add_row(label, unit, *(f"{one[key] * factor:.2g}" for one in near), source)
    table.caption = "\n".join(f"{tone}: {one['why']}"
                              for tone, one in zip(("relaxed", "tensed"), near, strict=True))  # fmt: skip
    table.caption += "\nFor tips of 5 to 40 mm radius and 1 to 20 N; `stmpl needs` says it for yours."
    return table
