"""generate: draws contacts, solves them on local processes or a Dask cluster, and packs the samples into a data set."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import multiprocessing
import os
import platform
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from fem_tools.dataset import FIGURES, FORMAT, RAGGED, Record, Writer, write_layer
from fem_tools.hand import Hand
from fem_tools.indenter import INDENTER_LAYERS, IndenterFem, Tool
from fem_tools.patch import PatchFem
from fem_tools.sampling import BodyPlan, ContactId, Kind, Plan, contacts, draw, kinds_of, layers, ratios, split_of
from fem_tools.scenes import Scene, Site, UnusableContact
from stmpl_core.body import Body
from stmpl_core.chart import UvChart
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.extras import needed
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.sdf import SignedDistance
from stmpl_core.trust import Displacement, Trust

log = logging.getLogger(__name__)

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
VERSIONS = ("stmpl", "numpy", "scipy", "numba", "anny", "libigl", "mmgpy", "trimesh", "shapely", "zarr")
INDENTER_REFINE = 3  # splits where a tool's curvature asks: from 4 mm down to 0.5 mm
WORST_TRUNCATION = 0.05  # of the peak: motion that is left one thickness inside the patch's rim

OnProgress = Callable[[int, int, int, int], None]  # contacts done, contacts in all, samples kept, samples dropped


@dataclass(frozen=True)
class Drop:
    """A sample that is not in the data, and why."""

    contact: str
    kind: Kind
    ratio: float
    why: str


@dataclass(frozen=True, eq=False)
class Job:
    """One contact with all that a worker needs for it; a worker keeps what it made of a skin for the next."""

    plan: Plan
    contact: ContactId
    skin: Mapping[str, Any]
    digest: str
    hand: Hand | None


@dataclass(frozen=True, eq=False)
class Bench:
    """A layer with the solvers that are prepared for it."""

    site: Site
    fem: PatchFem
    paper_fem: PatchFem
    indenter: IndenterFem

    @classmethod
    def of(cls, plan: Plan, body: BodyPlan, skin: Mapping[str, Any]) -> Bench:
        """Builds the layer again from its arrays. Raises MeshError if it folds."""
        chart = None if skin["uv"] is None else UvChart(skin["vertices"], skin["faces"], skin["uv"])
        layer = SoftLayer(skin["vertices"], skin["faces"], skin["thickness"], tissue=skin["tissue"], chart=chart)
        pressing = PatchFem(reach=body.reach, refine=plan.refine).prepare(layer)
        paper_fem = PatchFem(reach=body.reach).prepare(layer)
        pressed = PatchFem(reach=body.reach, refine=INDENTER_REFINE, layers=INDENTER_LAYERS)
        indenting = IndenterFem(pressed, step=plan.indenter_step).prepare(layer)
        return cls(Site(layer), pressing, paper_fem, indenting)


_benches: dict[str, Bench] = {}


def solve_contact(job: Job) -> bytes:
    """Draws and solves one contact under all its kinds of load: its part of the data set, as a file's bytes."""
    if job.digest not in _benches:
        _benches[job.digest] = Bench.of(job.plan, job.plan.body(job.contact.body), job.skin)
    bench, plan, contact = _benches[job.digest], job.plan, job.contact
    rng = contact.rng(plan.seed)
    records: list[Record] = []
    drops: list[Drop] = []
    drawn, seconds = {}, {}
    loads: dict[Kind, np.ndarray] = {
        kind: ratios(plan, kind, plan.loads_of(contact.set), rng) for kind in kinds_of(plan, contact)
    }
    try:
        started = time.process_time()
        scene, drawn = draw(contact, bench.site, job.hand, rng)
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
    return _part_bytes(about, records, drops, seconds)


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
    """The tool pressed in along its axis to these depths over thickness, sticking."""
    layer, pose = bench.site.layer, scene.pose_body_from_tool
    assert scene.mesh is not None
    tool = Tool(SignedDistance.of(scene.mesh, rounding=scene.rounding), pose, -pose[:3, 2])
    answers = bench.indenter.path([tool], (wanted * bench.site.thickness_under(pose)).tolist())
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


def generate(
    plan: Plan,
    out: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Makes the data set of `plan` in the folder `out`, or goes on where an earlier run of it was stopped.

    Args:
        plan: what is generated.
        out: folder; each contact that is done is one file in it until all are packed.
        workers: local processes, each on one thread; None: one a core.
        scheduler: address of a Dask scheduler whose workers do the work instead (one thread each, please).
        on_progress: called after each contact.

    Returns:
        The manifest.

    Raises:
        InvalidInput: `out` holds the data of another plan, or workers below 1.
        StmplError: a worker died; what was done is kept.
    """
    out = Path(out)
    if (kept := _manifest_of(plan, out)) and kept.get("complete"):
        return kept
    (out / "parts").mkdir(parents=True, exist_ok=True)
    _write(out / "manifest.json", json.dumps({"format": FORMAT, "plan": plan.model_dump(mode="json"),
                                              "complete": False}, indent=1).encode())  # fmt: skip
    made = layers(plan)
    tally = _solve_all(plan, out, made, workers, scheduler, on_progress)
    manifest = _pack(plan, out, made, tally)
    shutil.rmtree(out / "parts")
    return manifest


def _manifest_of(plan: Plan, out: Path) -> dict[str, Any] | None:
    path = out / "manifest.json"
    if not path.is_file():
        if out.is_dir() and any(out.iterdir()):
            raise InvalidInput(f"{out} is not empty and holds no data set. Choose another folder.")
        return None
    kept = json.loads(path.read_text())
    if kept.get("format") != FORMAT or kept.get("plan") != plan.model_dump(mode="json"):
        raise InvalidInput(f"{out} holds data of another plan ({kept.get('plan', {}).get('preset')}). "
                           "Choose another folder, or remove it.")  # fmt: skip
    return kept


@dataclass
class _Tally:
    """How far a run is."""

    samples: int = 0
    dropped: int = 0
    seconds: float = 0.0
    workers: str = ""


def _solve_all(plan: Plan, out: Path, made: Mapping[str, SoftLayer], workers: int | None, scheduler: str | None,
               on_progress: OnProgress | None) -> _Tally:  # fmt: skip
    """Solves what has no file yet, in an order that mixes cheap and dear contacts, so that the rate holds."""
    every = list(contacts(plan))
    every = [every[k] for k in np.random.default_rng(plan.seed).permutation(len(every))]
    left = [c for c in every if not _part_path(out, c).is_file()]
    tally, started, done = _Tally(), time.monotonic(), len(every) - len(left)
    skins = {name: _skin(layer) for name, layer in made.items()}
    hand = Hand.of(Body.anny(weight=0.5)) if any(c.set == "hand" for c in left) else None
    with _executor(workers, scheduler) as (executor, many):
        tally.workers = f"dask {scheduler}" if scheduler else f"{many} local processes"
        waiting, running = iter(left), {}
        try:
            while True:
                while len(running) < 2 * many and (contact := next(waiting, None)):
                    held = hand if contact.set == "hand" else None
                    job = Job(plan, contact, *skins[contact.body], held)
                    running[executor.submit(solve_contact, job)] = contact
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    contact, content = running.pop(future), future.result()
                    _write(_part_path(out, contact), content)
                    _, records, drops, _ = _part_read(content)
                    done, tally.samples, tally.dropped = (
                        done + 1, tally.samples + len(records), tally.dropped + len(drops))  # fmt: skip
                    if on_progress:
                        on_progress(done, len(every), tally.samples, tally.dropped)
        except BrokenProcessPool as error:
            raise StmplError(f"a worker process died after {done} of {len(every)} contacts, perhaps for want of "
                             "memory. Run the same command again, with fewer --workers.") from error  # fmt: skip
        finally:
            for future in running:
                future.cancel()
    tally.seconds = time.monotonic() - started
    return tally


@contextmanager
def _executor(workers: int | None, scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Something that takes jobs, and how many it works on at a time."""
    if scheduler is not None:
        needed("a scheduler of Dask", "cluster", "distributed")
        from distributed import Client

        with Client(scheduler, timeout="20s") as client, client.get_executor(pure=False) as executor:
            nthreads: Any = client.nthreads()
            yield executor, max(1, len(nthreads))
        return
    many = workers if workers is not None else len(os.sched_getaffinity(0))
    if many < 1:
        raise InvalidInput(f"workers is {many}; at least 1 is needed.")
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        with ProcessPoolExecutor(many, mp_context=multiprocessing.get_context("spawn")) as executor:
            yield executor, many
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _skin(layer: SoftLayer) -> tuple[dict[str, Any], str]:
    """A layer as plain arrays, and a digest that names it."""
    uv = layer.chart.uv if isinstance(layer.chart, UvChart) else None
    skin = {"vertices": layer.vertices, "faces": layer.faces, "thickness": layer.thickness, "uv": uv,
            "tissue": layer.tissue}  # fmt: skip
    content = b"".join(np.ascontiguousarray(skin[k]).tobytes() for k in ("vertices", "faces", "thickness"))
    return skin, hashlib.sha256(content).hexdigest()


def _part_path(out: Path, contact: ContactId) -> Path:
    return out / "parts" / f"{contact.body}-{contact.set}-{contact.number:05d}.npz"


def _part_bytes(about: dict[str, Any], records: list[Record], drops: list[Drop], seconds: dict[str, float]) -> bytes:
    header = {
        "about": about,
        "records": [[r.kind, *r.figures] for r in records],
        "drops": [vars(d) for d in drops],
        "seconds": seconds,
    }
    arrays = {f"{name}_{k}": getattr(r, name) for k, r in enumerate(records)
              for name in RAGGED}  # fmt: skip
    buffer = io.BytesIO()
    np.savez_compressed(buffer, header=np.array(json.dumps(header)), **arrays)
    return buffer.getvalue()


def _part_read(content: bytes) -> tuple[dict[str, Any], list[Record], list[Drop], dict[str, float]]:
    with np.load(io.BytesIO(content)) as part:
        header = json.loads(str(part["header"]))
        records = [
            Record(kind, *(part[f"{name}_{k}"] for name in RAGGED), figures=tuple(figures))
            for k, (kind, *figures) in enumerate(header["records"])
        ]
    return header["about"], records, [Drop(**d) for d in header["drops"]], header["seconds"]


def _write(path: Path, content: bytes) -> None:
    """Writes a file so that it is there whole or not at all."""
    beside = path.with_suffix(f".{os.getpid()}.tmp")
    beside.write_bytes(content)
    beside.replace(path)


def _pack(plan: Plan, out: Path, made: Mapping[str, SoftLayer], tally: _Tally) -> dict[str, Any]:
    """All parts into Zarr, in the order of the plan whatever the order in which they were solved; the manifest last."""
    root = zarr.open_group(str(out / "data.zarr"), mode="w")
    counts: Counter[str] = Counter()
    drops: list[Drop] = []
    spent: dict[str, list[float]] = defaultdict(list)
    for name, layer in made.items():
        write_layer(root, name, layer)
        writer = Writer(root.require_group(name))
        for contact in (c for c in contacts(plan) if c.body == name):
            about, records, dropped, seconds = _part_read(_part_path(out, contact).read_bytes())
            if records:
                writer.add(about, records)
            drops += dropped
            for record in records:
                counts[f"{about['split']}/{record.kind}/{about['set']}"] += 1
            for kind, value in seconds.items():
                spent[f"{kind}/{about['set']}"].append(value)
        writer.close()
    manifest = {
        "format": FORMAT,
        "complete": True,
        "plan": plan.model_dump(mode="json"),
        "versions": {name: _version(name) for name in VERSIONS} | {"python": platform.python_version()},
        "samples": sum(counts.values()),
        "counts": dict(sorted(counts.items())),
        "wall_seconds_of_last_run": round(tally.seconds, 1),
        "workers": tally.workers,
        "cpu_seconds_per_contact": {name: round(float(np.mean(v)), 4) for name, v in sorted(spent.items())},
        "dropped": [vars(d) for d in drops],
    }
    _write(out / "manifest.json", json.dumps(manifest, indent=1).encode())
    return manifest


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
