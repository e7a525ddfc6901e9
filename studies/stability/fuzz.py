"""Fuzz: random skins, materials, tools, poses and wrenches: every answer finite, bounded and, where wrong, flagged."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.provenance import commit, machine, versions
from stmpl_core.simulator import Simulator
from stmpl_core.tissue import Membrane, Ply, Tissue
from stmpl_core.tool import Tool
from stmpl_core.trust import Displacement
from studies.stability import failures, shapes
from studies.stability.broken import Answers
from studies.stability.contacts import Contacts, Instant, Placed, answers_of, simulator_of
from studies.stability.meshes import even_plate, inserted, irregular, limb, saddle
from studies.stability.scene import Make, Mesh
from studies.stability.suite import VERSIONS, Row, checked, judged
from studies.stability.trial import Trial

log = logging.getLogger(__name__)

ON_ONE_SKIN = 500  # contacts that a skin is pressed by, before the next one is made
STACKED = 0.25  # share of the skins that are a stack
TOOLS = 6  # tools that press it
SMALLEST = 3e-3  # size of a tool [m]: a tenth of it, a sheet's, is still one
DEEPER = 0.03  # of the thickness, by which a tool that presses by its pose alone goes on, where its force must not fall
LONGEST_ERROR = 500  # letters of an error
KEPT = 20  # failures of a kind that are saved
OnContact = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Fuzzed:
    """What came of a fuzz.

    Args:
        contacts: number of instants that were asked.
        outcomes: how many ended how: held, refused (with an error that says why), flagged, silent, crashed.
        statuses: how many tools were told to be what.
        broken: how many of each kind of failure, "outcome law".
        files: failures that can be run again, at most KEPT of a kind.
        about: what made them.
    """

    contacts: int
    outcomes: Mapping[str, int]
    statuses: Mapping[str, int]
    broken: Mapping[str, int]
    files: tuple[str, ...] = ()
    about: Mapping[str, Any] = field(default_factory=dict)


def fuzz(name: str, make: Make, count: int, seed: int = 0, out: Path | None = None, *,
         on_progress: OnContact | None = None) -> Fuzzed:  # fmt: skip
    """Asks a simulator for `count` random instants.

    Args:
        name: name of the method in failures.
        make: what makes a method.
        count: number of instants.
        seed: seed of it all.
        out: folder for fuzz.json and failures/; nothing is written unless given.
        on_progress: function that is called with instants done, in all, and what was found.
    """
    outcomes, statuses, kinds, files = Counter[str](), Counter[str](), Counter[str](), []
    started, done = time.perf_counter(), 0
    while done < count:
        rng = np.random.default_rng([seed, done])
        for row, trial, seen in pressed(name, make, rng, min(ON_ONE_SKIN, count - done)):
            outcomes[row.outcome] += 1
            statuses.update(seen)
            for one in row.broken:
                kind = f"{row.outcome} {one.law}"
                kinds[kind] += 1
                if out is not None and trial is not None and row.outcome != "refused" and kinds[kind] <= KEPT:
                    numbered = replace(trial, level=f"{seed} {done}")
                    files.append(str(failures.save(out / "failures", numbered, name, asdict(row))))
            done += 1
            if on_progress is not None:
                on_progress(done, count, ", ".join(f"{n:,} {what}" for what, n in sorted(outcomes.items())))
    about = {"commit": commit(), "machine": machine(), "versions": versions(VERSIONS), "seed": seed, "method": name,
             "seconds": time.perf_counter() - started}  # fmt: skip
    found = Fuzzed(done, dict(outcomes), dict(statuses), dict(kinds), tuple(dict.fromkeys(files)), about)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "fuzz.json").write_text(json.dumps(asdict(found), indent=1) + "\n")
    return found


def pressed(name: str, make: Make, rng: np.random.Generator, count: int) -> Iterator[tuple[Row, Trial, list[str]]]:
    """A random skin and tools, and `count` instants on it: what came of each, its trial, the statuses.

    A skin that is refused, for a good reason or not, is one instant.
    """
    mesh = random_mesh(rng)
    tools = [random_tool(rng, mesh, f"tool {k}") for k in range(TOOLS)]
    try:
        simulator = simulator_of(make, mesh.layer)
    except (Exception, SystemExit) as error:  # a method of others may end itself
        trial = Trial("fuzz", "", ("finite",), Contacts(mesh, (), ()))
        yield _failed(name, trial, error), trial, []
        return
    for _ in range(count):
        yield asked(name, simulator, random_trial(rng, mesh, tools))


def asked(name: str, simulator: Simulator, trial: Trial) -> tuple[Row, Trial, list[str]]:
    """What a simulator answers to a trial of one instant; where it presses by its pose, also when it goes deeper."""
    scene = trial.scene
    assert isinstance(scene, Contacts)
    try:
        answers: list[Displacement] = checked(scene, list(scene.asked(simulator)))
        if (further := _deeper(scene, answers)) is not None:
            trial = replace(trial, scene=further, laws=(*trial.laws, "rises"))
            answers = checked(further, list(further.asked(simulator)))
    except (Exception, SystemExit) as error:  # a method of others may end itself
        return _failed(name, trial, error), trial, []
    statuses = [touch.status for answer in answers_of(answers)[:1] for touch in answer.touches.values()]
    return judged(name, trial, Answers(answers, [])), trial, statuses


def _deeper(scene: Contacts, answers: list[Displacement]) -> Contacts | None:
    """The same instant, and one tool that presses by its pose moved on along its force."""
    (instant,), (answer,) = scene.instants, answers_of(answers)
    one, *others = instant
    if others or one.wrench is not None or not answer.touches[one.tool.name].force > 0:
        return None
    force = answer.touches[one.tool.name].wrench[:3]
    pose = one.pose.copy()
    pose[:3, 3] += DEEPER * float(scene.mesh.thickness.min()) * force / np.linalg.norm(force)
    return replace(scene, instants=(instant, (one._replace(pose=pose),)))


def _failed(name: str, trial: Trial, error: BaseException) -> Row:
    """A refusal in a sentence, or a crash."""
    from studies.stability.broken import Broken

    said = str(error)
    if isinstance(error, StmplError) and " " in said and len(said) < LONGEST_ERROR:
        return Row(name, trial.axis, trial.level, "refused", (Broken(type(error).__name__, _reason(said), True),))
    log.debug("%s crashed", name, exc_info=error)
    return Row(name, trial.axis, trial.level, "crashed", (Broken("answers", f"crashed: {error!r}", False),))


def _reason(said: str) -> str:
    return said[:80]


def random_mesh(rng: np.random.Generator) -> Mesh:
    """An even, uneven, refined, bent, long, flipped or torn skin, of any size and material."""
    t, edge = 7.5e-3 * 10 ** rng.uniform(-0.5, 0.3), 10 ** rng.uniform(-2.4, -2.1)
    tissue = random_tissue(rng)
    kind = rng.choice(["limb", "uneven", "plate", "saddle", "refined", "long", "torn", "flipped"],
                      p=[0.25, 0.2, 0.15, 0.1, 0.1, 0.1, 0.07, 0.03])  # fmt: skip
    mesh = even_plate(0.12, edge, t) if kind == "plate" else saddle(edge, 0.12, 0.05, t) if kind == "saddle" \
        else limb(edge, 0.04, 0.12, t)  # fmt: skip
    if kind == "uneven":
        mesh = irregular(mesh, 0.35, int(rng.integers(1 << 30)))
    if kind == "refined":
        mesh = inserted(mesh, np.flatnonzero(rng.uniform(size=len(mesh.faces)) < 0.2), (1 / 3, 1 / 3, 1 / 3))
    if kind == "torn":
        mesh = _without(mesh, np.flatnonzero(rng.uniform(size=len(mesh.faces)) < 0.01))
    if kind == "flipped":
        some = rng.uniform(size=len(mesh.faces)) < rng.choice([0.01, 1.0])
        mesh = replace(mesh, faces=np.where(some[:, None], mesh.faces[:, ::-1], mesh.faces),
                       uv=np.where(some[:, None, None], mesh.uv[:, ::-1], mesh.uv))  # fmt: skip
    by = np.array([1.0, 1.0, rng.uniform(1, 4) if kind == "long" else 1.0]) * random_size(rng)
    thickness = by[0] * mesh.thickness * (1 if rng.uniform() < 0.7 else rng.uniform(0.7, 1.3, len(mesh.thickness)))
    if rng.uniform() < STACKED:
        tissue = random_stack(rng, tissue, float(np.median(thickness)))
    return replace(mesh, vertices=mesh.vertices * by, thickness=thickness, tissue=tissue)


def random_size(rng: np.random.Generator) -> float:
    """A factor on lengths: mostly 1 or near it, sometimes anything from a tenth of a millimetre to kilometres."""
    kind = rng.choice(["same", "near", "any"], p=[0.5, 0.35, 0.15])
    return {"same": 1.0, "near": 10 ** rng.uniform(-1.5, 1), "any": 10 ** rng.uniform(-4, 4)}[str(kind)]


def random_tissue(rng: np.random.Generator) -> Tissue:
    """E over twelve decades, as far as a Tissue takes it; nu from 0 to 0.4999."""
    nu = rng.choice([rng.uniform(0.3, 0.45), rng.uniform(0, 0.4999), 0.0, 0.4999], p=[0.6, 0.3, 0.05, 0.05])
    modulus = 10 ** rng.choice([rng.uniform(3, 5), rng.uniform(2, 14)])
    return Tissue(float(modulus), float(nu))


def random_stack(rng: np.random.Generator, tissue: Tissue, thickness: float) -> Tissue:
    """The tissue under a skin, over deeper materials, or both, from laxer and softer than people's to beyond."""
    unit, more = tissue.youngs_modulus * thickness, {}
    if rng.uniform() < 0.8:
        stiffness = unit * 10 ** rng.uniform(-1.5, 2)
        sheet = min(0.1 * thickness, 4e-3)
        more["skin"] = Membrane(max(stiffness / sheet, 100.0), sheet, stiffness * 10 ** rng.uniform(-3, -0.5))
    if rng.uniform() < 0.7:
        starts = np.sort(rng.uniform(0.05, 0.95, int(rng.integers(1, 4)))) * thickness
        more["deeper"] = tuple(Ply(float(z), float(max(tissue.youngs_modulus * 10 ** rng.uniform(-1, 1.5), 100.0)),
                                   tissue.poisson_ratio) for z in starts)  # fmt: skip
    return replace(tissue, **more)


def random_tool(rng: np.random.Generator, mesh: Mesh, name: str) -> Tool:
    """A ball, capsule, punch, box, plate or ring, from much smaller than the layer to larger than the limb."""
    size = max(float(mesh.thickness.max()) * 10 ** rng.uniform(-0.7, 1.0), SMALLEST)
    a, b, c = size * 10 ** rng.uniform(-0.5, 0.5, 3)
    kind = rng.choice(["ball", "capsule", "punch", "box", "sheet", "ring"])
    made = {"ball": lambda: shapes.ball(size, name), "capsule": lambda: shapes.capsule(a, b, name),
            "punch": lambda: shapes.punch(a, b, name), "box": lambda: shapes.box(a, b, c, name),
            "sheet": lambda: shapes.box(3 * a, 3 * b, 0.1 * size, name),
            "ring": lambda: shapes.ring(3 * size, size, name)}[str(kind)]  # fmt: skip
    try:
        return made()
    except InvalidInput:  # too small or too large for a tool: that is said where tools are made
        return shapes.ball(0.01, name)


def random_trial(rng: np.random.Generator, mesh: Mesh, tools: list[Tool]) -> Trial:
    """One instant of one tool, seldom two or three."""
    several = 1 if rng.uniform() < 0.85 else int(rng.integers(2, 4))
    chosen = rng.choice(len(tools), several, replace=False)
    instant: Instant = tuple(Placed(tools[k], *_random_contact(rng, mesh)) for k in chosen)
    return Trial("fuzz", "", ("finite", "bounded", "touches", "carries"), Contacts(mesh, (instant,)))


def _random_contact(rng: np.random.Generator, mesh: Mesh) -> tuple[np.ndarray, np.ndarray | None]:
    """A pose near the skin, in the layer or far away; none, an ordinary or a wild wrench."""
    layer, t = mesh.layer, float(mesh.thickness.mean())
    v = int(rng.integers(len(layer.vertices)))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    away = rng.choice([rng.uniform(-3, 3), rng.uniform(-1, 1), rng.normal() * 10 ** rng.uniform(-4, 6)],
                      p=[0.3, 0.6, 0.1])  # fmt: skip
    pose[:3, 3] = layer.vertices[v] + t * away * layer.normals[v] + t * rng.normal(size=3) * 10 ** rng.uniform(-3, 0.3)
    if rng.uniform() < 0.45:
        return pose, None
    push = -layer.normals[v] if rng.uniform() < 0.7 else rng.normal(size=3)
    usual = mesh.tissue.youngs_modulus * t * t
    size = 10 ** (rng.uniform(-3, 1.5) if rng.uniform() < 0.6 else rng.uniform(-12, 20))
    twist = rng.normal(size=3) * size * t * 10 ** rng.uniform(-3, 3) * (rng.uniform() < 0.4)
    wrench = usual * np.concatenate([size * push, twist])
    kind = rng.uniform()
    if kind < 0.03:
        wrench[:3] = 0
    elif kind < 0.05:
        wrench[int(rng.integers(6))] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
    elif kind < 0.06:
        pose[int(rng.integers(3)), int(rng.integers(4))] = rng.choice([np.nan, np.inf, 1e30, 3.0])
    return pose, wrench


def _without(mesh: Mesh, gone: np.ndarray) -> Mesh:
    """The mesh without these faces, and without vertices that no face uses."""
    faces, uv = np.delete(mesh.faces, gone, axis=0), np.delete(mesh.uv, gone, axis=0)
    used, faces = np.unique(faces, return_inverse=True)
    return replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3).astype(np.int32), uv=uv,
                   thickness=mesh.thickness[used])  # fmt: skip
