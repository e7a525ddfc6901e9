"""Judge: the model's answer to a published row, its spread, and whether the two meet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stmpl_core.regions import HELD_SKIN, Quantity, Region, Tone, region
from stmpl_core.relaxation import Series
from stmpl_core.tissue import Tissue
from studies.validate import fading
from studies.validate.closed import disc_stiffness
from studies.validate.rows import IN_TIME, ROWS, Row

Inputs = dict[str, Quantity]
FADES = Quantity(
    sum(HELD_SKIN.shares), sum(HELD_SKIN.shares), 0.75, "-",
    f"{HELD_SKIN.source}; high: our fits to the same data with the 10 s that the stretch took, 0.75 to 0.83",
)  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """One row, judged.

    Args:
        row: published row.
        by: what gave the model's middle: "closed form", "finite elements" or "laws of a state"; the spread of the
            former two is by closed form.
        model: model's value from the typical inputs, with the ends that their spreads give, in the row's unit.
        shares: change of the logarithm of the model's value from each input's low and high end [-].
    """

    row: Row
    by: str
    model: Quantity
    shares: dict[str, tuple[float, float]]

    @property
    def ratio(self) -> float:
        """Model over measured, of the middles [-]."""
        return self.model.value / self.row.measured.value

    @property
    def inside(self) -> bool:
        """Whether the model's interval and the measured one meet."""
        return self.model.low <= self.row.measured.high and self.row.measured.low <= self.model.high

    @property
    def verdict(self) -> str:
        """Whether the two meet, or what was fitted on the row, which is then no evidence."""
        if self.row.fitted:
            return f"not judged: {self.row.fitted} was fitted on it"
        return "yes" if self.inside else f"no, {self.apart:.{2 if self.apart > 1.05 else 4}g} apart"

    @property
    def apart(self) -> float:
        """Factor between the ends that are nearest; 1 if the intervals meet [-]."""
        measured = self.row.measured
        return max(1.0, measured.low / self.model.high, self.model.low / measured.high)

    @property
    def most(self) -> str:
        """The input whose spread matters most; "-": none does."""
        found = max(self.shares, key=lambda name: max(map(abs, self.shares[name])))
        return found if max(map(abs, self.shares[found])) > 1e-6 else "-"

    def as_dict(self) -> dict[str, object]:
        """The row, the model's answer and the verdict, for machines."""
        row, protocol = self.row, self.row.protocol
        return {
            "name": row.name, "region": row.region, "site": row.site, "protocol": protocol.said, "way": protocol.way,
            "radius": vars(protocol.radius), "depth": vars(protocol.depth) if protocol.depth else None,
            "asked": row.asked, "measured": vars(row.measured), "read": row.read, "by": self.by,
            "model": vars(self.model), "ratio": self.ratio, "inside": self.inside, "apart": self.apart,
            "most": self.most, "shares": self.shares, "outside": "" if self.inside else row.outside,
            "fitted": row.fitted,
        }  # fmt: skip


def judge(rows: Sequence[Row] = ROWS, *, quick: bool = False,
          on_progress: Callable[[int, int, str], None] | None = None) -> list[Judged]:  # fmt: skip
    """The model's answer to every row.

    Args:
        rows: rows to judge.
        quick: whether rows that ask for finite elements are left out.
        on_progress: rows done, in all, and the name of the last.
    """
    chosen, judged = [row for row in rows if not (quick and row.protocol.ball)], []
    for row in chosen:
        judged.append(judge_row(row))
        if on_progress:
            on_progress(len(judged), len(chosen), row.name)
    return judged


def judge_row(row: Row, inputs: Inputs | None = None) -> Judged:
    """The model's answer to a row: middle, ends, and what each input does to it.

    Inputs are moved to their ends one at a time. With l = ln f(low) / f and h = ln f(high) / f of each input, the ends
    of the answer are f exp(+- (sum max(+-l, +-h, 0)^2)^(1/2)).

    Args:
        row: row to judge.
        inputs: numbers to judge it with; those of its region and protocol unless given.
    """
    inputs = inputs or inputs_of(row)
    middle, shares = surrogate(row, inputs), {}
    for name, known in inputs.items():
        ends = (surrogate(row, inputs | {name: replace(known, value=end)}) for end in (known.low, known.high))
        low, high = (math.log(end / middle) for end in ends)
        shares[name] = (low, high)
    down, up = (math.hypot(*(max(sign * a, sign * b, 0.0) for a, b in shares.values())) for sign in (-1, 1))
    value, by = middle, "laws of a state" if row.asked in IN_TIME else "closed form"
    if row.protocol.ball:
        value, by = _pressed(row), "finite elements"
    source = f"{by}, {row.region} of the library"
    model = Quantity(value, value * math.exp(-down), value * math.exp(up), row.measured.unit, source)
    return Judged(row, by, model, shares)


def inputs_of(row: Row) -> Inputs:
    """Every number of the region, or of the people themselves, and of the protocol, by name."""
    inputs, protocol = region(row.region).quantities | dict(row.own), row.protocol
    given = {"radius": protocol.radius, "depth": protocol.depth, "speed": protocol.speed, "stays": protocol.stays,
             "fades": FADES if row.asked in IN_TIME else None}  # fmt: skip
    return inputs | {name: one for name, one in given.items() if one is not None}


def surrogate(row: Row, inputs: Inputs) -> float:
    """What is asked, by closed form, from the values of the inputs; a ball counts as the disc that it touches.

    Of rows that finite elements answer only its changes with the inputs are used.
    """
    radius, depth = inputs["radius"].value, inputs["depth"].value if "depth" in inputs else 0.0
    contact = math.sqrt(radius * depth) if row.protocol.ball else radius
    if row.asked in IN_TIME:
        return _in_time(row, inputs, contact)
    way = row.protocol.way
    assert way != "stretched"  # only with time
    relaxed, tensed = (_with(region(row.region, tone), inputs) for tone in ("relaxed", "tensed"))

    def stiffness(body: Region, tissue: Tissue | None = None) -> float:
        return disc_stiffness(tissue or body.tissue, body.thickness, contact, way)

    if row.asked == "force":
        return stiffness(relaxed) * depth
    if row.asked == "reduced modulus":
        return stiffness(relaxed) / (2 * contact)
    if row.asked == "layer modulus":
        return 1e3 * stiffness(relaxed) / stiffness(relaxed, Tissue(1e3, inputs["poisson_ratio"].value))
    if row.asked == "tensed over relaxed":
        return stiffness(tensed) / stiffness(relaxed)
    if row.asked == "tensed less relaxed":
        return stiffness(tensed) - stiffness(relaxed)
    return stiffness(relaxed)


def _in_time(row: Row, inputs: Inputs, contact: float) -> float:
    """What is asked of tissue that fades under a contact of a radius [m], from the values of the inputs."""
    fades, protocol = inputs["fades"].value, row.protocol
    if protocol.way == "stretched":
        law = fading.series(fades)
        left = Series(np.array(law.shares), np.array(law.times))
    else:
        body = _with(region(row.region), inputs)
        left = fading.series_under(body.tissue, body.thickness, fades, contact)
    if row.asked == "time of fading":
        return fading.fading_time(left)
    lasts = inputs["depth"].value / inputs["speed"].value if "speed" in inputs else 0.0
    found = fading.cycles(left, lasts, inputs["stays"].value if "stays" in inputs else 0.0, protocol.cycles,
                          slack=protocol.way == "stretched")  # fmt: skip
    ask = {"share lost": fading.lost_share, "energy lost": fading.lost_energy, "last peak over first": fading.last_peak}
    return ask[row.asked](found)


def _with(body: Region, inputs: Inputs) -> Region:
    """A region with these values; the muscle's ends are those of its own tone."""
    given = {name: value for name, value in inputs.items() if name in body.quantities}
    own, moved = body.muscle_modulus, given["muscle_modulus"]
    relaxed = region(body.name).muscle_modulus
    if body.tone == "tensed":
        ends = {relaxed.low: own.low, relaxed.value: own.value, relaxed.high: own.high}
        given["muscle_modulus"] = replace(own, value=ends[moved.value])
    return replace(body, **given)


def _pressed(row: Row) -> float:
    """What is asked of the row's ball, by finite elements: force over depth [N/m], or that tensed over that relaxed."""
    from studies.validate.finite import ball_force

    radius, depth = row.protocol.radius.value, row.protocol.depth
    assert depth is not None  # a ball has one

    def stiffness(tone: Tone) -> float:
        body = region(row.region, tone)
        return ball_force(body.tissue, body.thickness, radius, depth.value) / depth.value

    return stiffness("tensed") / stiffness("relaxed") if row.asked == "tensed over relaxed" else stiffness("relaxed")
