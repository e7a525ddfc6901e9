"""evaluate: the STMPL paper's tables on a data set, its printed rows beside ours, and what its metric leaves out."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from fem_tools.dataset import Dataset, Sample, Subset, data_card
from fem_tools.sampling import Kind, Split
from stmpl_core.console import jsonable
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.methods import Method, Naive, Winkler
from stmpl_core.methods.zero import Zero
from stmpl_core.metrics import LIMITS, Score, mean_and_deviation, score
from stmpl_core.provenance import commit, machine, versions

THREE_BODIES = ("weight_0", "weight_50", "weight_100")  # of the second set-up: beta_2 in {2, 0, -2}
THREE_BODY_ROW = "unet, 3 bodies"  # the method of Table 3
SPLITS: tuple[Split, ...] = ("test", "ood", "held_out")
RULES: dict[Kind, str] = {"nodal": "dead nodal forces, the paper's rule", "pressure": "follower pressures",
                          "indenter": "pressures under rigid tools"}  # fmt: skip
VERSIONS = ("stmpl", "numpy", "scipy", "torch")
HEADINGS = (
    "", "samples", "MAE x / y / z mm", "MEE mm", "% of peak", " / ".join(f"<={x * 1e3:g}" for x in LIMITS) + " mm %",
    "moving > 10 % mm (%)", "under contact mm (%)", "at peak mm (%)", "leak mm", "ms",
)  # fmt: skip
LEGEND = (
    "Mean±deviation over samples. Errors over vertices that move more than 0.001 mm; then over those that move more "
    "than 10 % of the sample's peak, under the load, and at the peak (signed); in brackets, as % of the mean peak. "
    "Leak: largest answer beyond 8 thicknesses from the load. ms: median of one answer. Rows of the paper are as "
    "printed, on its own data."
)

OnProgress = Callable[[int, int], None]  # samples judged, samples in all


@dataclass(frozen=True)
class Row:
    """One line of a table: mean and standard deviation of a method's Score over samples; nan where there is none."""

    name: str
    samples: int | None  # None: the paper's
    mean: Score
    deviation: Score
    milliseconds: float = math.nan  # median time of one answer


@dataclass(frozen=True)
class Table:
    """Rows under one title."""

    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Tables:
    """All tables; what they were made of; and which methods refused what, with their reason."""

    tables: tuple[Table, ...]
    about: dict[str, Any]
    refusals: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """For a terminal: aligned columns."""
        blocks = []
        for table in self.tables:
            lines = [HEADINGS, *map(_cells, table.rows)]
            widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
            ruled = [lines[0], ["-" * width for width in widths], *lines[1:]]
            aligned = ["  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]) for line in ruled]
            blocks.append("\n".join([table.title, *aligned]))
        return "\n\n".join([*blocks, *self._notes()])

    def markdown(self) -> str:
        """For a page."""
        blocks = []
        for table in self.tables:
            lines = [HEADINGS, ["---"] + ["---:"] * (len(HEADINGS) - 1), *map(_cells, table.rows)]
            blocks += [f"**{table.title}**", "\n".join("| " + " | ".join(line) + " |" for line in lines)]
        return "\n\n".join([*blocks, *self._notes()])

    def as_json(self) -> str:
        """For machines: metres and shares, null where there is no figure."""
        return json.dumps(jsonable(asdict(self)), indent=1)

    def _notes(self) -> list[str]:
        data = self.about["data"]
        origin = (f"Data: {data['preset']}, seed {data['seed']}, manifest {data['manifest_sha256'][:12]}. "
                  f"Machine: {self.about['machine']}. Commit: {self.about['commit'][:12] or 'unknown'}.")  # fmt: skip
        return [LEGEND, "\n".join([origin, *(f"{name}: refused, {why}" for name, why in self.refusals.items())])]


@dataclass(frozen=True)
class _Pick:
    """A sample to judge."""

    body: str
    kind: Kind
    split: Split
    subset: Subset
    number: int


@dataclass(frozen=True)
class _Judged:
    """A method's answer to a sample, judged."""

    name: str
    pick: _Pick
    score: Score
    seconds: float


def evaluate(
    data: str | Path,
    methods: Mapping[str, Callable[[], Method]],
    *,
    kinds: Sequence[Kind] = ("nodal", "pressure"),
    limit: int | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Tables:
    """Tables 1 to 3 of the STMPL paper for each kind of load, and one of limbs that nothing was learnt from.

    Rows are zero, naive (fitted to the training samples of the same kind), winkler, and `methods`. Table 3, seen and
    unseen thickness, is of the one named THREE_BODY_ROW, if there is one.

    Args:
        data: folder of a finished data set, see `stmpl generate`.
        methods: further rows: by name, what makes the method.
        kinds: kinds of load.
        limit: number of samples for each split and kind, spread evenly over it; None: all.
        seed: seed of that choice.
        on_progress: function that is called after each sample.

    Raises:
        InvalidInput: no finished data set there, or limit below 1.
    """
    if limit is not None and limit < 1:
        raise InvalidInput(f"limit is {limit}; at least 1 sample a table is needed.")
    started, dataset = time.monotonic(), Dataset.open(data)
    picks = [pick for kind in kinds for split in SPLITS for pick in _picks(dataset, kind, split, limit, seed)]
    picks.sort(key=lambda pick: pick.body)
    made = {name: make() for name, make in ({"zero": Zero, "winkler": Winkler} | dict(methods)).items()}
    naive = {kind: _fitted(dataset, kind, limit, seed) for kind in kinds if any(p.kind == kind for p in picks)}
    judged: list[_Judged] = []
    refusals: dict[str, str] = {}
    done = 0
    for body, group in groupby(picks, key=lambda pick: pick.body):
        layer = dataset.layers[body]
        ready = _prepared(made, layer, refusals, body)
        fitted = {kind: method.prepare(layer) for kind, method in naive.items()}
        for pick in group:
            sample = pick.subset[pick.number]
            for name, method in ({"naive": fitted[pick.kind]} | ready).items():
                judged += _judge(name, method, pick, sample, refusals)
            done += 1
            if on_progress:
                on_progress(done, len(picks))
    names = ["zero", "naive", *(name for name in made if name != "zero")]
    tables = [table for kind in kinds for table in _tables(kind, names, [j for j in judged if j.pick.kind == kind])]
    about = {"data": data_card(data, dataset.manifest), "limit": limit, "seed": seed, "machine": machine(),
             "commit": commit(), "versions": versions(VERSIONS),
             "seconds": round(time.monotonic() - started, 1)}  # fmt: skip
    return Tables(tuple(tables), about, refusals)


def _picks(dataset: Dataset, kind: Kind, split: Split, limit: int | None, seed: int) -> Iterable[_Pick]:
    subset = dataset.split(split, kind=kind)
    return (_Pick(subset.info(k)["body"], kind, split, subset, k) for k in spread(len(subset), limit, seed))


def spread(count: int, limit: int | None, seed: int) -> list[int]:
    """At most `limit` of the numbers below `count`, one drawn from each of as many equal parts."""
    if limit is None or limit >= count:
        return list(range(count))
    places = (np.arange(limit) + np.random.default_rng(seed).uniform(size=limit)) / limit
    return np.floor(places * count).astype(int).tolist()


def _fitted(dataset: Dataset, kind: Kind, limit: int | None, seed: int) -> Naive:
    """Naive as the training samples make it; as it comes where there are none."""
    train = dataset.split("train", kind=kind)
    chosen = spread(len(train), limit, seed)
    return Naive.fit(train[k][:3] for k in chosen) if chosen else Naive()


def _prepared(made: Mapping[str, Method], layer: SoftLayer, refusals: dict[str, str], body: str) -> dict[str, Method]:
    """The methods that take this layer; the others' reasons go to `refusals`."""
    ready = {}
    for name, method in made.items():
        try:
            ready[name] = method.prepare(layer)
        except StmplError as error:
            refusals[f"{name} on {body}"] = str(error)
    return ready


def _judge(name: str, method: Method, pick: _Pick, sample: Sample, refusals: dict[str, str]) -> list[_Judged]:
    started = time.perf_counter()
    try:
        answer = method.solve(sample.load)
    except StmplError as error:
        refusals.setdefault(f"{name} on {pick.body}", str(error))
        return []
    seconds = time.perf_counter() - started
    return [_Judged(name, pick, score(answer.displacement, sample.displacement, sample.layer, sample.load), seconds)]


def _tables(kind: Kind, names: Sequence[str], judged: Sequence[_Judged]) -> list[Table]:
    """The tables of one kind of load, those that have samples."""
    rule = RULES[kind]
    by_split: dict[Split, list[_Judged]] = {split: [j for j in judged if j.pick.split == split] for split in SPLITS}
    rows = {split: [r for name in names for r in _row(name, (j for j in some if j.name == name))]
            for split, some in by_split.items()}  # fmt: skip
    tables = [
        Table(f"Table 1, in distribution: {rule}", (*PAPER_TABLE_1, *rows["test"])) if rows["test"] else None,
        Table(f"Table 2, out of distribution: {rule}", (*PAPER_TABLE_2, *rows["ood"])) if rows["ood"] else None,
        _table_3(rule, by_split),
        Table(f"Limbs never seen: {rule}", tuple(rows["held_out"])) if rows["held_out"] else None,
    ]
    return [table for table in tables if table is not None]


def _table_3(rule: str, by_split: Mapping[Split, Sequence[_Judged]]) -> Table | None:
    """What the model of three bodies makes of thicknesses that it has seen, and of others."""
    rows: list[Row] = []
    places: tuple[tuple[Split, str], ...] = (("test", "in distribution"), ("ood", "out of distribution"))
    for split, where in places:
        for seen in (True, False):
            some = [j for j in by_split[split]
                    if j.name == THREE_BODY_ROW and (j.pick.body in THREE_BODIES) == seen]  # fmt: skip
            rows += _row(f"{where}, {'seen' if seen else 'unseen'} thickness", some)
    return Table(f"Table 3, {THREE_BODY_ROW}: {rule}", (*PAPER_TABLE_3, *rows)) if rows else None


def _row(name: str, judged: Iterable[_Judged]) -> list[Row]:
    """One row, or none where nothing was judged."""
    some = list(judged)
    if not some:
        return []
    return [Row(name, len(some), *mean_and_deviation([j.score for j in some]),
                1e3 * float(np.median([j.seconds for j in some])))]  # fmt: skip


def _printed(
    name: str,
    mae: tuple[float, float, float],
    mae_deviation: tuple[float, float, float] | None,
    mee: tuple[float, float],
    within: tuple[float, ...],
    peak: float = math.nan,
) -> Row:
    """A row as the paper prints it, in mm and %."""

    def figures(mae: Sequence[float], mee: float, within: Sequence[float], peak: float) -> Score:
        x, y, z = (value / 1e3 for value in mae)
        none = dict.fromkeys(("much", "contact", "peak_error", "peak_share", "leak", "moving"), math.nan)
        return Score(mae_x=x, mae_y=y, mae_z=z, mee=mee / 1e3, within=tuple(value / 100 for value in within),
                     mee_share=mee / peak, peak=peak / 1e3, **none)  # fmt: skip

    nan = (math.nan,) * len(LIMITS)
    deviation = figures(mae_deviation or nan[:3], mee[1], nan, math.nan)
    return Row(f"{name} (paper, printed)", None, figures(mae, mee[0], within, peak), deviation)


PAPER_TABLE_1 = (
    _printed("STMPL", (0.0196, 0.0321, 0.0339), (0.0098, 0.0251, 0.0269), (0.0577, 0.0408),
             (91.13, 94.98, 97.08, 98.58, 99.94)),
    _printed("STMPL, 3 bodies", (0.0182, 0.0301, 0.0316), (0.0098, 0.0262, 0.0281), (0.0545, 0.0423),
             (91.18, 94.9, 96.85, 98.76, 99.95)),
    _printed("Naive", (0.0347, 0.0637, 0.0632), (0.0148, 0.0338, 0.0336), (0.1106, 0.0505),
             (46.82, 70.21, 83.9, 94.59, 99.95)),
)  # fmt: skip
PAPER_TABLE_2 = (
    _printed("STMPL", (0.0346, 0.0648, 0.0695), (0.0208, 0.0411, 0.0390), (0.1160, 0.0666),
             (49.3, 63.92, 74.38, 88.17, 99.94), peak=2.081),
    _printed("STMPL, 3 bodies", (0.0345, 0.0719, 0.0801), (0.0147, 0.0398, 0.0439), (0.1289, 0.0662),
             (36.64, 56.16, 70.77, 86.22, 100.0), peak=2.081),
    _printed("Naive", (0.0444, 0.1015, 0.1095), (0.0303, 0.0889, 0.0993), (0.1775, 0.1527),
             (37.9, 48.37, 57.71, 69.85, 96.11), peak=2.081),
)  # fmt: skip
PAPER_TABLE_3 = (
    _printed("in distribution, seen thickness", (0.0189, 0.0313, 0.0332), None, (0.0569, 0.0425),
             (90.25, 94.44, 96.63, 98.56, 99.96)),
    _printed("in distribution, unseen thickness", (0.0172, 0.0287, 0.0296), None, (0.0515, 0.0418),
             (92.37, 95.48, 97.13, 99.0, 99.93)),
    _printed("out of distribution, seen thickness", (0.0368, 0.0771, 0.0845), None, (0.137, 0.0707),
             (33.18, 50.77, 65.56, 82.58, 100.0)),
    _printed("out of distribution, unseen thickness", (0.0282, 0.0578, 0.0678), None, (0.1066, 0.0448),
             (46.15, 70.96, 85.09, 96.23, 100.0)),
)  # fmt: skip


def _cells(row: Row) -> list[str]:
    """A row as it is read: mm and %."""
    mean, deviation = row.mean, row.deviation

    def spreads(value: float, width: float) -> str:
        return _shown(1e3 * value, ".4f") + ("" if math.isnan(width) else f"±{1e3 * width:.4f}")

    def with_share(value: float, sign: str = "") -> str:
        share = _shown(100 * value / mean.peak, f"{sign}.1f")
        return _shown(1e3 * value, f"{sign}.3f") + (f" ({share})" if share else "")

    mae = [spreads(getattr(mean, f"mae_{axis}"), getattr(deviation, f"mae_{axis}")) for axis in "xyz"]
    return [
        row.name, "" if row.samples is None else str(row.samples), " / ".join(mae), spreads(mean.mee, deviation.mee),
        _shown(100 * mean.mee / mean.peak, ".2f"), " / ".join(f"{100 * share:.2f}" for share in mean.within),
        with_share(mean.much), with_share(mean.contact), with_share(mean.peak_error, "+"),
        _shown(1e3 * mean.leak, ".4f"), _shown(row.milliseconds, ".3g"),
    ]  # fmt: skip


def _shown(value: float, form: str) -> str:
    """Empty for nan."""
    return "" if math.isnan(value) else format(value, form)
