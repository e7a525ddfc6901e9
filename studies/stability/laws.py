"""The laws that any answer must hold, whatever method gave it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from fem_tools.mesh import reference_wedge, rest_gradients
from fem_tools.patch import MIN_FOLD
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import SoftLayer
from stmpl_core.metrics import FAR
from stmpl_core.trust import Displacement
from studies.stability.broken import Answers, Broken, Found, Law, broken, worst
from studies.stability.contact_laws import CONTACT_LAWS, forces_alike
from studies.stability.scene import Pressures
from studies.stability.stroke_laws import STROKE_LAWS
from studies.stability.trial import Trial

LEAK = 0.005  # of the peak, that may move beyond FAR thicknesses: finite elements leave 0.001 (DESIGN: locality)
SAME = 1e-3  # of the peak, by which answers that must be equal may differ: an iterative solver's own tolerance
FIELD = 0.02  # the same for tools of another size: the grid of a tool's distance field has a margin in metres
MESH = 0.1  # of the peak, by which the same load on the same skin may differ on another mesh of it
ADDED = 0.02  # of the peak, by which two contacts FAR apart may differ from their sum
GAIN = 2.0  # largest relative change of the answer over that of the load; a layer that stiffens stays below 1
NOTHING = 1e-12  # m, below which answers are the same


def finite(trial: Trial, answers: Answers) -> Broken | None:
    """Every displacement is a number."""
    for answer in answers.scene + answers.twin:
        bad = ~np.isfinite(answer.displacement).all(axis=1)
        if bad.any():
            return broken("finite", f"{int(bad.sum())} vertices not finite", answer)
    return None


def zero(trial: Trial, answers: Answers) -> Broken | None:
    """No load moves nothing, exactly."""
    for _, pressure, answer in _all(trial, answers):
        if not pressure.any() and (most := float(answer.magnitude.max())) > 0:
            return broken("zero", f"{most * 1e3:.2g} mm without a load", answer)
    return None


def monotone(trial: Trial, answers: Answers) -> Broken | None:
    """A load that grows everywhere presses deeper: the peak grows strictly."""
    pressed = [(p, a) for p, a in zip(_pressures(trial), answers.scene, strict=True) if p.any()]
    for (_, before), (_, after) in pairwise(pressed):
        less, more = float(before.magnitude.max()), float(after.magnitude.max())
        if not more > less:
            return broken("monotone", f"peak {less * 1e3:.3g} -> {more * 1e3:.3g} mm as the load grew", before, after)
    return None


def sinks(trial: Trial, answers: Answers) -> Broken | None:
    """Pressure does work on the skin: the sum of p A u over the vertices, u inwards, is above 0."""
    for scene, pressure, answer in _all(trial, answers):
        layer = scene.mesh.layer
        forces = pressure * layer.vertex_areas
        work = -float(forces @ (answer.displacement * layer.normals).sum(axis=1))
        if pressure.any() and not work > 0:
            return broken("sinks", f"{1e3 * work / forces.sum():.2g} mm inwards on average, where it presses", answer)
    return None


def unfolded(trial: Trial, answers: Answers) -> Broken | None:
    """J = det F > 0 in the layer under the skin (see `least_det_f`)."""
    for scene, _, answer in _all(trial, answers):
        if (least := least_det_f(scene.mesh.layer, answer.displacement)) <= 0:
            return broken("unfolded", f"least det F {least:.2g}", answer)
    return None


def leak(trial: Trial, answers: Answers) -> Broken | None:
    """Nothing moves beyond FAR thicknesses from the load."""
    for scene, pressure, answer in _all(trial, answers):
        layer, loaded = scene.mesh.layer, np.flatnonzero(pressure)
        if not len(loaded):
            continue
        away, _ = KDTree(layer.vertices[loaded]).query(layer.vertices)
        moved = answer.magnitude
        most, peak = float(moved[away > FAR * layer.thickness.max()].max(initial=0.0)), float(moved.max())
        if most > LEAK * peak + NOTHING:
            return broken("leak", f"{most * 1e3:.2g} mm beyond {FAR:g} thicknesses, peak {peak * 1e3:.2g}", answer)
    return None


def _alike(name: str, tolerance: float, of_tools: float) -> Law:
    def law(trial: Trial, answers: Answers) -> Found:
        twin, within = trial.twin, tolerance if isinstance(trial.scene, Pressures) else of_tools
        if twin is None or not answers.twin:
            return
        for one, other in zip(answers.scene, answers.twin, strict=True):
            expected = twin.scale * one.displacement[twin.pairs[:, 0]] @ twin.turn.T
            off = float(np.linalg.norm(other.displacement[twin.pairs[:, 1]] - expected, axis=1).max())
            peak = float(np.linalg.norm(expected, axis=1).max())
            stated = _stated(one, other, twin.scale) if name == "mesh" or one.method != other.method else 0.0
            if not off <= max(within * peak, stated) + NOTHING:
                yield broken(name, f"off by {_of_peak(off, peak)}", one, other)
        yield from forces_alike(name, within, trial, answers)

    law.__doc__ = (f"The twin's answer is the answer, turned and scaled, within {tolerance:g} of the peak. Two methods "
                   "of one that chooses among several agree within the bounds that both state.")  # fmt: skip
    if name == "mesh":
        law.__doc__ += " Or within the bounds that both state: on a coarse mesh they are wide."
    return worst(law)


def returns(trial: Trial, answers: Answers) -> Broken | None:
    """The last answer is what a fresh method gives to the last load: what came before is forgotten."""
    last, fresh = answers.scene[-1], answers.fresh
    assert fresh is not None
    off, peak = float(np.linalg.norm(last.displacement - fresh.displacement, axis=1).max()), _peak(fresh)
    if off <= SAME * peak + NOTHING:
        return None
    return broken("returns", f"{_of_peak(off, peak)} off a fresh answer", last)


def additive(trial: Trial, answers: Answers) -> Broken | None:
    """Two contacts so far apart that neither feels the other give the sum of their answers: loads A, B, A + B."""
    a, b, both = answers.scene
    off = float(np.linalg.norm(both.displacement - a.displacement - b.displacement, axis=1).max())
    if off <= ADDED * _peak(both) + NOTHING:
        return None
    return broken("additive", f"{_of_peak(off, _peak(both))} off the sum", a, b, both)


def gain(trial: Trial, answers: Answers) -> Broken | None:
    """Noise on the load is not amplified: |du|/|u| <= GAIN |dp|/|p|, in the root of mean squares.

    Two methods, of one that chooses among several, agree within the bounds that both state.
    """
    (clean, *noisy), (first, *others) = _pressures(trial), answers.scene
    whole = float(np.linalg.norm(first.displacement))
    if not whole > 0:
        return None
    for pressure, answer in zip(noisy, others, strict=True):
        moved = np.linalg.norm(answer.displacement - first.displacement, axis=1)
        if answer.method != first.method and float(moved.max()) <= _stated(first, answer):
            continue
        change = float(np.linalg.norm(moved)) / whole
        factor = change / float(np.linalg.norm(pressure - clean) / np.linalg.norm(clean))
        if not factor <= GAIN:
            return broken("gain", f"noise amplified {factor:.1f} times", first, answer)
    return None


LAWS: dict[str, Law] = {
    "finite": finite, "zero": zero, "monotone": monotone, "sinks": sinks, "unfolded": unfolded, "leak": leak,
    "seam": _alike("seam", SAME, SAME), "objective": _alike("objective", SAME, SAME),
    "similar": _alike("similar", SAME, FIELD), "mesh": _alike("mesh", MESH, MESH),
    "returns": returns, "additive": additive, "gain": gain,
} | CONTACT_LAWS | STROKE_LAWS  # fmt: skip
"""Laws of answers, by name. Two more are judged where a method is asked: "answers" (a load that is sound is answered),
and "refuses" (a load that is not finite is refused, or its answer flagged)."""

MEANING = {
    "answers": "answers a sound input", "refuses": "refuses what is not finite", "finite": "finite",
    "zero": "zero in, zero out", "monotone": "peak grows with the load", "sinks": "sinks under pressure",
    "unfolded": "J > 0", "leak": "nothing beyond 8 thicknesses", "seam": "equal on both sides of the seam",
    "objective": "objective", "similar": "the same at any scale", "mesh": "the same on another mesh",
    "returns": "forgets what came before", "additive": "far contacts add up", "gain": "noise is not amplified",
    "bounded": "motion and force have a bound", "rises": "force never falls with depth",
    "touches": "not apart with skin inside", "presses": "a force where it presses",
    "carries": "carries the wrench, or says", "still": "nothing moves through air",
    "steady": "same place by pose and wrench", "smooth": "no jump while sliding", "ripple": "no ripple while sliding",
    "outside": "no skin inside a tool", "covers": "stated bounds cover the error",
    "needless": "an ordinary touch is not flagged", "verdict": "one verdict for one scene",
    "agrees": "stiffness agrees", "gives": "gives no energy", "caps": "friction has a limit",
    "alike": "the same in other steps", "masing": "reversals as Masing says", "between": "between relaxed and sudden",
    "free": "free when lifted", "lasts": "what sticks stays", "ends": "a drag grows no force",
}  # fmt: skip
VERDICTS = frozenset(("needless", "verdict", "agrees"))  # laws of flags: alone, they do not make an answer wrong


def least_det_f(layer: SoftLayer, displacement: np.ndarray) -> float:
    """Smallest det F of the layer when its columns stay straight between the moved skin and the core, which is fixed.

    Each face and its inward copy bound a wedge, at rest and moved; det F is the ratio of the two wedges' Jacobians at
    the quadrature points of P1xP2 elements. Wedges that PatchFem would refuse as folded at rest do not count.
    """
    moved = displacement.any(axis=1)
    faces = layer.faces[moved[layer.faces].any(axis=1)].astype(np.int64)
    if not len(faces):
        return 1.0
    reference, inner = reference_wedge("P1xP2"), layer.inner_vertices
    rest = rest_gradients(layer.vertices, inner, faces, reference, 1)[1]
    now = rest_gradients(layer.vertices + displacement, inner, faces, reference, 1)[1]
    sound = (rest > 0).all(axis=1) & (fold_ratios(layer.vertices, inner, faces) >= MIN_FOLD)
    return float((now[sound] / rest[sound]).min(initial=1.0))


def _all(trial: Trial, answers: Answers) -> Iterator[tuple[Pressures, np.ndarray, Displacement]]:
    pairs = [(trial.scene, answers.scene)]
    if trial.twin is not None and answers.twin:
        pairs.append((trial.twin.scene, answers.twin))
    for scene, given in pairs:
        assert isinstance(scene, Pressures)
        for pressure, answer in zip(scene.pressures, given, strict=True):
            yield scene, pressure, answer


def _pressures(trial: Trial) -> np.ndarray:
    assert isinstance(trial.scene, Pressures)
    return trial.scene.pressures


def _stated(one: Displacement, other: Displacement, scale: float = 1.0) -> float:
    """How far two answers, the first of them scaled, may be apart by the bounds that they state [m]."""
    return scale * (one.trust.error_bound or 0.0) + (other.trust.error_bound or 0.0)


def _peak(answer: Displacement) -> float:
    return float(answer.magnitude.max())


def _of_peak(off: float, peak: float) -> str:
    return f"{off * 1e3:.2g} mm" + (f" ({100 * off / peak:.2g} % of the peak)" if peak > 0 else "")
