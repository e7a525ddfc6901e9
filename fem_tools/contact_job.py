"""One contact of a data set: drawn, solved under all its kinds of load, and turned into a file's bytes."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import time
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from fem_tools.dataset import FIGURES, RAGGED, Record
from fem_tools.hand import Hand
from fem_tools.indenter import INDENTER_LAYERS, IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press, above_core
from fem_tools.sampling import BodyPlan, ContactId, Kind, Plan, draw, kinds_of, ratios, split_of
from fem_tools.scenes import Scene, Site, UnusableContact
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.packed import pack, unpack
from stmpl_core.sdf import SignedDistance
from stmpl_core.trust import Displacement, Trust

log = logging.getLogger(__name__)

INDENTER_REFINE = 3  # splits where a tool's curvature asks: from 4 mm down to 0.5 mm
CLEAR = 0.03  # distance from the core that is left under a tool, over its depth
WORST_TRUNCATION = 0.05  # largest motion that is left one thickness inside the patch's rim, over the peak


@dataclass(frozen=True)
class Drop:
    """A sample that is not in the data, and why."""

    contact: str
    kind: Kind
    ratio: float
    why: str


@dataclass(frozen=True, eq=False)
class Part:
    """What one contact adds to a data set.

    Args:
        about: name and description of the contact: set, number, split, what was drawn.
        records: samples that are kept.
        drops: samples that are not.
        seconds: processor time by kind of load [s].
    """

    about: dict[str, Any]
    records: list[Record]
    drops: list[Drop]
    seconds: dict[str, float]

    def write(self) -> bytes:
        """The part as a file's bytes."""
        header = {
            "about": self.about,
            "records": [[r.kind, *r.figures] for r in self.records],
            "drops": [vars(d) for d in self.drops],
            "seconds": self.seconds,
        }
        arrays = {f"{name}_{k}": getattr(r, name) for k, r in enumerate(self.records) for name in RAGGED}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, header=np.array(json.dumps(header)), **arrays)
        return buffer.getvalue()

    @classmethod
    def read(cls, content: bytes) -> Part:
        """The part that such bytes hold."""
        with np.load(io.BytesIO(content)) as part:
            header = json.loads(str(part["header"]))
            records = [
                Record(kind, *(part[f"{name}_{k}"] for name in RAGGED), figures=tuple(figures))
                for k, (kind, *figures) in enumerate(header["records"])
            ]
        return cls(header["about"], records, [Drop(**d) for d in header["drops"]], header["seconds"])


@dataclass(frozen=True, eq=False)
class Skin:
    """A layer as plain arrays, which travel to workers, and a digest that names it."""

    arrays: dict[str, np.ndarray]
    digest: str

    @classmethod
    def of(cls, layer: SoftLayer) -> Skin:
        """The layer's arrays."""
        named = layer.vertices, layer.faces, *layer.below.values()
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in named)).hexdigest()
        return cls(pack(layer), digest)

    def layer(self) -> SoftLayer:
        """The layer again."""
        return unpack(self.arrays)


@dataclass(frozen=True, eq=False)
class Job:
    """One contact with all that a worker needs for it; a worker keeps what it made of a skin for the next."""

    plan: Plan
    contact: ContactId
    skin: Skin
    hand: Hand | None


@dataclass(frozen=True, eq=False)
class Bench:
    """A layer with the solvers that are prepared for it."""

    site: Site
    fem: PatchFem
    paper_fem: PatchFem
    indenter: IndenterFem

    @classmethod
    def of(cls, plan: Plan, body: BodyPlan, layer: SoftLayer) -> Bench:
        """Prepares the solvers."""
        pressing = PatchFem(reach=body.reach, refine=plan.refine).prepare(layer)
        paper_fem = PatchFem(reach=body.reach).prepare(layer)
        element, layers = ("P1xP2", 1) if plan.linear else (None, INDENTER_LAYERS)
        pressed = PatchFem(element=element, reach=body.reach, refine=INDENTER_REFINE, layers=layers)
        work = body.most_work or plan.most_work
        indenting = IndenterFem(pressed, step=plan.indenter_step, max_work=work).prepare(layer)
        return cls(Site(layer), pressing, paper_fem, indenting)


_benches: dict[str, Bench] = {}


def solve_contact(job: Job) -> bytes:
    """Draws and solves one contact under all its kinds of load: its part of the data set, as a file's bytes."""
    plan, contact, digest = job.plan, job.contact, job.skin.digest
    if digest not in _benches:
        _benches[digest] = Bench.of(plan, plan.body(contact.body), job.skin.layer())
    bench = _benches[digest]
    rng = contact.rng(plan.seed)
    records: list[Record] = []
    drops: list[Drop] = []
    drawn, seconds = {}, {}
    loads: dict[Kind, np.ndarray] = {
        kind: ratios(plan, kind, plan.loads_of(contact.set), rng, plan.body(contact.body).shallowest)
        for kind in kinds_of(plan, contact)
    }
    try:
        started = time.process_time()
        scene, drawn = draw(plan, contact, bench.site, job.hand, rng)
        seconds["draw"] = time.process_time() - started
    except UnusableContact as error:
        drops = [Drop(str(contact), kind, float(r), str(error)) for kind in loads for r in loads[kind]]
        loads = {}
    for kind, wanted in loads.items():
        started, reached = time.process_time(), 0
        try:
            for record, trust in SOLVERS[kind](bench, scene, wanted):
                ratio = float(wanted[reached])
                reached += 1
                if why := _reason_to_drop(record, trust):
                    drops.append(Drop(str(contact), kind, ratio, why))
                else:
                    records.append(record)
            why = "the press ended before this depth"
        except SystemError:  # Ctrl-C inside a compiled kernel: the run is ending, and this contact is not done
            raise
        except Exception as error:  # one contact that goes wrong must not end an hour's run; the manifest says which
            log.warning("%s under %s: %s: %s", contact, kind, type(error).__name__, error)
            why = f"{type(error).__name__}: {error}"
        drops += [Drop(str(contact), kind, float(r), why) for r in wanted[reached:]]
        seconds[kind] = time.process_time() - started
    about = {"set": contact.set, "number": contact.number, "split": split_of(plan, contact), "drawn": drawn}
    return Part(about, records, drops, seconds).write()


def _reason_to_drop(record: Record, trust: Trust) -> str:
    """Why a sample is not kept; empty if it is."""
    figures = dict(zip(FIGURES, record.figures, strict=True))
    if not trust.ok:
        return trust.why
    if (cut := figures["truncation_m"]) > WORST_TRUNCATION * figures["peak_m"]:
        return f"the patch cuts off {cut / figures['peak_m']:.1%} of the peak; {WORST_TRUNCATION:.0%} are allowed"
    return ""


def solve_pressures(bench: Bench, scene: Scene, wanted: np.ndarray) -> Iterator[tuple[Record, Trust]]:
    """The footprint under follower pressures of these p / E."""
    layer = bench.site.layer
    loads = [Load.pressure(r * layer.tissue.youngs_modulus * scene.footprint) for r in wanted]
    yield from _pressed(bench.fem, layer, "pressure", loads, wanted)


def solve_nodals(bench: Bench, scene: Scene, wanted: np.ndarray) -> Iterator[tuple[Record, Trust]]:
    """The paper's rule: the same force on every covered vertex, so that p / E at the worst of them is this."""
    layer = bench.site.layer
    force = layer.tissue.youngs_modulus * float(layer.vertex_areas[scene.covered].min())
    loads = [Load.nodal(np.where(scene.covered, r * force, 0.0)) for r in wanted]
    yield from _pressed(bench.paper_fem, layer, "nodal", loads, wanted)


def solve_indentations(bench: Bench, scene: Scene, wanted: np.ndarray) -> Iterator[tuple[Record, Trust]]:
    """The tool pressed in along its axis to these depths over thickness, sticking; not to those that reach the core."""
    layer, pose = bench.site.layer, scene.pose_body_from_tool
    assert scene.tool is not None
    tool = Press(SignedDistance.of(scene.tool, rounding=scene.rounding), pose, -pose[:3, 2])
    depths, touching = wanted * bench.site.thickness_under(pose), tool.touching(layer)
    while touching and len(depths) > 1 and above_core(layer, [touching.at(depths[-1])])[1][0] < CLEAR * depths[-1]:
        depths = depths[:-1]
    answers = bench.indenter.path([tool], depths.tolist())
    for ratio, answer in zip(wanted, answers, strict=False):
        figures = dict(answer.trust.figures) | {"ratio": float(ratio)}
        load = Load.pressure(answer.pressure)
        yield Record.of(layer, "indenter", load, answer.displacement, figures), answer.trust


def _pressed(
    fem: PatchFem, layer: SoftLayer, kind: Kind, loads: list[Load], wanted: np.ndarray
) -> Iterator[tuple[Record, Trust]]:
    for load, ratio, answer in zip(loads, wanted, _answers(fem, loads), strict=True):
        figures = dict(answer.trust.figures) | {"ratio": float(ratio)}
        yield Record.of(layer, kind, load, answer.displacement, figures), answer.trust


def _answers(fem: PatchFem, loads: list[Load]) -> list[Displacement]:
    """Answers to loads that grow. The largest is tested for stability, and each if that fails: a fifth of the time."""
    fem = copy(fem)
    answers, solving = [], fem.solve_many(loads)
    for k in range(len(loads)):
        fem.check_stability = k == len(loads) - 1
        answers.append(next(solving))
    if answers[-1].trust.ok:
        return answers
    fem.check_stability = True
    return list(fem.solve_many(loads))


SOLVERS: dict[Kind, Callable[[Bench, Scene, np.ndarray], Iterator[tuple[Record, Trust]]]] = {
    "pressure": solve_pressures,
    "nodal": solve_nodals,
    "indenter": solve_indentations,
}
