"""generate: draws contacts, solves them on local processes or a Dask cluster, and packs the samples into a data set."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from pydantic import ValidationError

from fem_tools.contact_job import Drop, Job, Part, Skin, solve_contact
from fem_tools.dataset import FORMAT, Writer, write_layer
from fem_tools.hand import Hand
from fem_tools.released import Released
from fem_tools.rounds import drawn, press, released
from fem_tools.sampling import ContactId, Plan, contacts, layers
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.extras import needed
from stmpl_core.layer import SoftLayer
from stmpl_core.pool import Pool, one_thread_each
from stmpl_core.provenance import versions

VERSIONS = ("stmpl", "numpy", "scipy", "numba", "anny", "libigl", "mmgpy", "trimesh", "shapely", "zarr")

OnProgress = Callable[[int, int, int, int], None]  # contacts done, contacts in all, samples kept, samples dropped


def generate(
    plan: Plan,
    out: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    start: str | Path | Sequence[str | Path] | None = None,
    flat: str | Path | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Makes the data set of `plan` in the folder `out`, or goes on where an earlier run of it was stopped.

    Args:
        plan: plan of what is generated.
        out: folder; each contact that is done is one file in it until all are packed.
        workers: local processes, each on one thread; None: one a core.
        scheduler: address of a Dask scheduler whose workers do the work instead (one thread each, please).
        start: files of released contacts of the same plan (see fem_tools.released) that need not be solved again.
        flat: released presses of its flat stacks (see fem_tools.rounds), likewise.
        on_progress: function that is called after each contact.

    Returns:
        The manifest.

    Raises:
        InvalidInput: `out`, `start` or `flat` holds the data of another plan, or workers below 1.
        StmplError: a worker died; what was done is kept.
    """
    out = Path(out)
    if (kept := _manifest_of(plan, out)) and kept.get("complete"):
        return kept
    (out / "parts").mkdir(parents=True, exist_ok=True)
    if plan.flat:
        (out / "rounds").mkdir(exist_ok=True)
    _write(out / "manifest.json", json.dumps({"format": FORMAT, "plan": plan.model_dump(mode="json"),
                                              "complete": False}, indent=1).encode())  # fmt: skip
    for file in [start] if isinstance(start, str | Path) else start or ():
        _go_on_from(file, plan, out)
    if flat is not None:
        _press_on_from(flat, plan, out)
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
    if kept.get("format") != FORMAT or not _same(kept.get("plan"), plan):
        raise InvalidInput(f"{out} holds data of another plan ({kept.get('plan', {}).get('preset')}). "
                           "Choose another folder, or remove it.")  # fmt: skip
    return kept


def _go_on_from(start: str | Path, plan: Plan, out: Path) -> None:
    """Puts released contacts where those of a run are kept."""
    released = Released(start)
    if not _fewer_bodies(released.plan, plan):
        raise InvalidInput(f"{start} holds contacts of another plan ({released.plan.preset}).")
    for contact, part in released.parts():
        if not _part_path(out, contact).is_file():
            _write(_part_path(out, contact), part.write())


def _press_on_from(flat: str | Path, plan: Plan, out: Path) -> None:
    """Puts released presses where those of a run are kept."""
    presses = released(flat)
    if len(presses) > plan.flat or not all(
            one.of(*drawn(plan, k)[:2]) for k, one in enumerate(presses)):  # fmt: skip
        raise InvalidInput(f"{flat} holds flat presses of another plan.")
    for k, one in enumerate(presses):
        if not _part_path(out, k).is_file():
            _write(_part_path(out, k), one.write())


def _fewer_bodies(some: Plan, plan: Plan) -> bool:
    """Whether a plan is another one, or that without some bodies and flat stacks: contacts on the rest are the same."""
    others = {"bodies": plan.bodies, "rounds": plan.rounds, "stacks": plan.stacks}
    return set(some.bodies) <= set(plan.bodies) and some.model_copy(update=others) == plan


def _same(kept: Any, plan: Plan) -> bool:
    """Whether a plan on disk is this one; what it does not say is as it was before it could be said."""
    try:
        return Plan.model_validate(kept) == plan
    except ValidationError:
        return False


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
    every: list[ContactId | int] = [*contacts(plan), *range(plan.flat)]
    every = [every[k] for k in np.random.default_rng(plan.seed).permutation(len(every))]
    left = [c for c in every if not _part_path(out, c).is_file()]
    tally, started, done = _Tally(), time.monotonic(), len(every) - len(left)
    skins = {name: Skin.of(layer) for name, layer in made.items()}
    hand = Hand.of(Body.anny(weight=0.5)) if any(isinstance(c, ContactId) and c.set == "hand" for c in left) else None
    with _executor(workers, scheduler) as (executor, many):
        tally.workers = f"dask {scheduler}" if scheduler else f"{many} local processes"
        waiting, running = iter(left), {}
        try:
            while True:
                while len(running) < 2 * many and (contact := next(waiting, None)) is not None:
                    if isinstance(contact, int):
                        running[executor.submit(press, plan, contact)] = contact
                        continue
                    held = hand if contact.set == "hand" else None
                    job = Job(plan, contact, skins[contact.body], held)
                    running[executor.submit(solve_contact, job)] = contact
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    contact, content = running.pop(future), future.result()
                    _write(_part_path(out, contact), content)
                    done += 1
                    if isinstance(contact, ContactId):
                        part = Part.read(content)
                        tally.samples += len(part.records)
                        tally.dropped += len(part.drops)
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

        try:
            made = Client(scheduler, timeout="20s")
        except (OSError, ValueError) as error:
            raise InvalidInput(f"no scheduler of Dask answers at {scheduler!r}: {error}. Give its address, as "
                               "tcp://127.0.0.1:8786.") from error  # fmt: skip
        with made as client, client.get_executor(pure=False) as executor:
            nthreads: Any = client.nthreads()
            yield executor, max(1, len(nthreads))
        return
    many = workers if workers is not None else len(os.sched_getaffinity(0))
    if many < 1:
        raise InvalidInput(f"workers is {many}; at least 1 is needed.")
    with one_thread_each(), Pool(many) as executor:
        yield executor, many


def _part_path(out: Path, contact: ContactId | int) -> Path:
    if isinstance(contact, int):
        return out / "rounds" / f"{contact:05d}.npz"
    return out / "parts" / f"{contact.body}-{contact.set}-{contact.number:05d}.npz"


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
            part = Part.read(_part_path(out, contact).read_bytes())
            if part.records:
                writer.add(part.about, part.records)
            drops += part.drops
            for record in part.records:
                counts[f"{part.about['split']}/{record.kind}/{part.about['set']}"] += 1
            for kind, value in part.seconds.items():
                spent[f"{kind}/{part.about['set']}"].append(value)
        writer.close()
    manifest = {
        "format": FORMAT,
        "complete": True,
        "plan": plan.model_dump(mode="json"),
        "versions": versions(VERSIONS),
        "samples": sum(counts.values()),
        "rounds": plan.flat,
        "counts": dict(sorted(counts.items())),
        "wall_seconds_of_last_run": round(tally.seconds, 1),
        "workers": tally.workers,
        "cpu_seconds_per_contact": {name: round(float(np.mean(v)), 4) for name, v in sorted(spent.items())},
        "dropped": [vars(d) for d in drops],
    }
    _write(out / "manifest.json", json.dumps(manifest, indent=1).encode())
    return manifest
