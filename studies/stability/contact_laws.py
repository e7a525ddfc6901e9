"""The laws that any answer to rigid tools must hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.stiffness import fit_stiffness
from stmpl_core.tool import Tool
from stmpl_core.touch import APART, NO_FORCE, PULLING, Answer
from stmpl_core.toucher import Toucher, margin_on
from studies.stability.broken import Answers, Broken, Found, Law, broken, worst
from studies.stability.contacts import Contacts, Instant, Placed, answers_of, field_of
from studies.stability.trial import Trial

FALL = 5e-3  # relative, by which a force may fall while its tool goes deeper: what the law's iterations leave
CARRIED = 0.03  # relative, by which the force may miss what the wrench asks for along the contact's normal
STILL = 0.005  # of the peak, that skin may move which is far from the tool along the skin
POP = 0.02  # of the thickness, by which a tool may move when its own force is given instead of its pose alone
SMOOTH = 0.005  # of the peak or of the force, by which an answer may change while a tool slides by SLIDE
SLIDE = 2e-6  # m
RIPPLE = 0.01  # peak to peak over the mean, of the force while a tool slides along an even limb
RIPPLE_PEAK = 0.03  # the same of the motion's peak over the tool's largest depth at a vertex, which the mesh samples
RIPPLE_VOLUME = 0.05  # the same of the volume that is pressed in
HIT = 0.5  # share of the tool's depth that vertices must sample all the way, or its peak is not judged
ENTERED = 0.03  # of the thickness, that skin may be inside a tool: it is said from 0.02 on
UNSTATED = 0.15  # of the peak or of the force, by which an answer may be off that states no bound
TRUTH = 0.015  # of the peak and of the force, by which the finite elements themselves are off
LEARNT = 0.65  # depth over thickness up to which an ordinary touch must not be flagged
COVERED = 0.05  # depth over thickness of a vertex of the skin inside a tool, from which the tool is not apart
STEPS_OUT = 20  # steps of a vertex out of a tool, after which it is out to a thousandth of its way
PRESSURE = 20.0  # pressure over the confined modulus, above which no answer may be trusted


@worst
def bounded(trial: Trial, answers: Answers) -> Found:
    """No vertex moves further than the layer is thick, no tool presses harder than it is pressed.

    And no answer is trusted whose pressure is beyond PRESSURE confined moduli.
    """
    layer = _scene(trial).mesh.layer
    for instant, answer in _asked(trial, answers):
        far = float((answer.magnitude / layer.thickness).max())
        if far > 1 + 1e-9:
            yield broken("bounded", f"moves by {far:.3g} thicknesses", answer)
        for placed in instant:
            force = answer.touches[placed.tool.name].force
            if placed.wrench is not None and force > (1 + CARRIED) * (most := _size(placed.wrench[:3])) + 1e-12:
                yield broken("bounded", f"presses with {force:.3g} N of {most:.3g} N", answer)
        highest = 0.0 if answer.pressure is None else float(answer.pressure.max()) / layer.tissue.confined_modulus
        if highest > PRESSURE and answer.trust.ok:
            yield broken("bounded", f"presses with {highest:.3g} confined moduli", answer)


@worst
def rises(trial: Trial, answers: Answers) -> Found:
    """Within a series the tools go deeper: no force falls."""
    given, scene = answers_of(answers.scene), _scene(trial)
    for k, m in scene.steps():
        for name, touch in given[k].touches.items():
            less, more = touch.force, given[m].touches[name].force
            if not more >= (1 - FALL) * less:
                yield broken("rises", f"{name}: {less:.4g} -> {more:.4g} N as it went deeper", given[k], given[m])


@worst
def touches(trial: Trial, answers: Answers) -> Found:
    """A tool with skin inside it is not apart. An open border does not count: the limb goes on there."""
    layer = _scene(trial).mesh.layer
    counts = ~np.isin(np.arange(len(layer.vertices)), layer.border)
    for instant, answer in _asked(trial, answers):
        for placed in instant:
            touch = answer.touches[placed.tool.name]
            if touch.status != APART:
                continue
            depth = -_distance(placed.tool, layer, placed.pose, layer.vertices) / layer.thickness
            inside = float(depth[counts].max(initial=0.0))
            if inside > COVERED:
                yield broken("touches", f"{placed.tool.name} is apart, with skin {inside:.2g} thicknesses inside it",
                              answer)  # fmt: skip


@worst
def presses(trial: Trial, answers: Answers) -> Found:
    """Every tool loads the skin."""
    for _, answer in _asked(trial, answers):
        for name, touch in answer.touches.items():
            if not touch.presses or not touch.force > 0:
                yield broken("presses", f"{name} is {touch.status}, {touch.force:.3g} N", answer)


@worst
def carries(trial: Trial, answers: Answers) -> Found:
    """The force is the stated one's part along the contact's normal, or it is said that it is not.

    So is a torque that no force of that size on the tool can make. What pulls, and says so, carries nothing.
    """
    for instant, answer in _asked(trial, answers):
        for placed in instant:
            touch = answer.touches[placed.tool.name]
            if placed.wrench is None or touch.status == PULLING:
                continue
            stated = placed.wrench[:3]
            wanted = float(stated @ touch.wrench[:3]) / max(touch.force, 1e-300) if touch.force else _size(stated)
            if touch.status != NO_FORCE and abs(touch.force - wanted) > CARRIED * wanted:
                yield broken("carries", f"carries {touch.force:.3g} of {wanted:.3g} N", answer)
            across = float(np.ptp(placed.tool.vertices, axis=0).max())
            most, lost = _size(stated) * across, _size(touch.missing[3:])
            if lost > 2 * most:
                yield broken("carries", f"drops a torque of {lost:.2g} N m; its force makes {most:.2g}", answer)


@worst
def still(trial: Trial, answers: Answers) -> Found:
    """Skin that is far along the skin does not move, however near it is through air."""
    mask = _scene(trial).still
    assert mask is not None
    for answer in answers.scene:
        most, peak = float(answer.magnitude[mask].max()), float(answer.magnitude.max())
        if most > STILL * peak:
            yield broken("still", f"{100 * most / peak:.2g} % of the peak through air", answer)


@worst
def steady(trial: Trial, answers: Answers) -> Found:
    """A tool that is given the force which its pose presses with stays where it is."""
    thickness = float(_scene(trial).mesh.thickness.max())
    given = answers_of(answers.scene)
    for posed, pushed in zip(given[::2], given[1::2], strict=True):
        for name, touch in posed.touches.items():
            other = pushed.touches[name].pose_body_from_tool
            way = _size(other[:3, 3] - touch.pose_body_from_tool[:3, 3])
            if way > POP * thickness:
                yield broken("steady", f"{name} goes {way * 1e3:.2g} mm at {touch.force:.2g} N", posed, pushed)


@worst
def smooth(trial: Trial, answers: Answers) -> Found:
    """While a tool slides by SLIDE at a time, nothing jumps."""
    given = answers_of(answers.scene)
    for k, m in _scene(trial).steps():
        peak = float(given[m].magnitude.max())
        jump = float(np.linalg.norm(given[m].displacement - given[k].displacement, axis=1).max())
        if jump > SMOOTH * peak:
            yield broken("smooth", f"motion jumps by {100 * jump / peak:.2g} % of the peak", given[k], given[m])
        for name, touch in given[k].touches.items():
            change = abs(given[m].touches[name].force / touch.force - 1)
            if change > SMOOTH:
                yield broken("smooth", f"force jumps by {100 * change:.2g} %", given[k], given[m])


@worst
def ripple(trial: Trial, answers: Answers) -> Found:
    """While a tool slides along even skin force, motion's peak and the volume that is pressed in stay the same.

    The peak beside the depth at which the tool meets a vertex at all: motion is known at vertices only. The volume also
    within the bound that is stated, to either side: vertices sample it, on a coarse mesh badly.
    """
    scene, given = _scene(trial), answers_of(answers.scene)
    layer, inward = scene.mesh.layer, -scene.mesh.layer.vertex_area_vectors
    for run in scene.runs():
        some = [given[k] for k in run]
        peak = np.array([float(one.magnitude.max()) for one in some])
        met = np.array([max(_met(placed, layer) for placed in scene.instants[k]) for k in run])
        waves = {
            "force": _wave([sum(t.force for t in one.touches.values()) for one in some]),
            "peak": _wave(peak / met) if met.min() > HIT * met.max() else 0.0,
            "volume": _wave([np.maximum((one.displacement * inward).sum(axis=1), 0).sum() for one in some]),
        }
        stated = float(max(2 * (one.trust.error_bound or 0.0) / most for one, most in zip(some, peak, strict=True)))
        most = {"force": RIPPLE, "peak": RIPPLE_PEAK, "volume": max(RIPPLE_VOLUME, stated)}
        if any(waves[name] > most[name] for name in waves):
            told = ", ".join(f"{name} {100 * wave:.2g} %" for name, wave in waves.items())
            yield broken("ripple", f"{told} peak to peak", *some)


@worst
def outside(trial: Trial, answers: Answers) -> Found:
    """No skin is inside a tool, where the tool was answered for."""
    layer = _scene(trial).mesh.layer
    for instant, answer in _asked(trial, answers):
        moved = layer.vertices + answer.displacement
        for placed in instant:
            touch = answer.touches[placed.tool.name]
            if not touch.presses:
                continue
            entered = -_distance(placed.tool, layer, touch.pose_body_from_tool, moved) / layer.thickness
            if (most := float(entered.max())) > ENTERED:
                yield broken("outside", f"skin is {most:.2g} thicknesses inside {placed.tool.name}", answer)


@worst
def covers(trial: Trial, answers: Answers) -> Found:
    """The bounds that are stated cover the error; where none is stated, it is within UNSTATED of the truth's peak."""
    scene = _scene(trial)
    assert scene.truth is not None
    for k, (instant, answer) in enumerate(_asked(trial, answers)):
        u = scene.truth.displacement[k]
        peak = float(np.linalg.norm(u, axis=1).max())
        off, bound = float(np.linalg.norm(answer.displacement - u, axis=1).max()), answer.trust.error_bound
        if off > (UNSTATED * peak if bound is None else bound) + TRUTH * peak:
            said = "none is stated" if bound is None else f"{100 * bound / peak:.2g} % is stated"
            yield broken("covers", f"motion is off by {100 * off / peak:.2g} % of the peak, {said}", answer)
        for placed, true in zip(instant, scene.truth.forces[k], strict=True):
            touch, size = answer.touches[placed.tool.name], _size(true)
            bound = touch.force_bound if np.isfinite(touch.force_bound) else UNSTATED * size
            off = abs(touch.force - size)
            if placed.wrench is None and off > bound + TRUTH * size:
                yield broken("covers", f"force is off by {100 * off / size:.2g} %, {100 * bound / size:.2g} % is "
                              "stated", answer)  # fmt: skip


@worst
def needless(trial: Trial, answers: Answers) -> Found:
    """An ordinary touch is not flagged.

    The contact law's own verdict counts; and the whole answer's, if the method trusts the first instant.
    """
    thickness = float(_scene(trial).mesh.thickness.min())
    first, *others = answers_of(answers.scene)
    for answer in (first, *others):
        deep = [touch for touch in answer.touches.values() if not touch.depth <= LEARNT * thickness]
        sound = all(touch.trust.ok for touch in answer.touches.values()) and (answer.trust.ok or not first.trust.ok)
        if not deep and not sound:
            what = ", ".join(f"{t.name} {t.force:.2g} N, {t.depth / thickness:.2g} t" for t in answer.touches.values())
            yield Broken("needless", f"flagged at {what}", True, answer.trust.why)


@worst
def verdict(trial: Trial, answers: Answers) -> Found:
    """The twin's answer is trusted where this one is."""
    for one, other in zip(answers.scene, answers.twin, strict=True):
        if one.trust.ok != other.trust.ok:
            yield Broken("verdict", "trusted on one, flagged on the other", True, one.trust.why or other.trust.why)


@worst
def agrees(trial: Trial, answers: Answers) -> Found:
    """What the simulator trusts, the fit of the stiffness trusts, and the other way round; it finds E again."""
    scene, given = _scene(trial), answers_of(answers.scene)
    pushed = [Contact(placed.tool, placed.pose, answer.touches[placed.tool.name].wrench)
              for (placed,), answer in zip(scene.instants, given, strict=True)]  # fmt: skip
    found = fit_stiffness(Toucher(scene.mesh.layer), pushed)
    trusted = all(touch.trust.ok for answer in given for touch in answer.touches.values())
    if found.trust.ok != trusted:
        yield Broken("agrees", f"the simulator {_said(trusted)}, the fit {_said(found.trust.ok)}", True,
                      found.trust.why)  # fmt: skip
        return
    expected = scene.mesh.tissue.youngs_modulus
    if trusted and abs(found.youngs_modulus / expected - 1) > CARRIED:
        yield broken("agrees", f"E is {found.youngs_modulus:.4g} Pa, {expected:.4g} was pressed", *given)


CONTACT_LAWS: dict[str, Law] = {
    "bounded": bounded, "rises": rises, "touches": touches, "presses": presses, "carries": carries, "still": still,
    "steady": steady, "smooth": smooth, "ripple": ripple, "outside": outside, "covers": covers, "needless": needless,
    "verdict": verdict, "agrees": agrees,
}  # fmt: skip
"""Laws of answers to tools, by name."""


def forces_alike(name: str, tolerance: float, trial: Trial, answers: Answers) -> Found:
    """The twin's forces are the forces, turned and scaled with E and area."""
    twin = trial.twin
    assert twin is not None
    stiffer = twin.scene.mesh.tissue.youngs_modulus / trial.scene.mesh.tissue.youngs_modulus
    for one, other in zip(answers.scene, answers.twin, strict=True):
        if not (isinstance(one, Answer) and isinstance(other, Answer)):
            return
        for tool, touch in one.touches.items():
            expected = stiffer * twin.scale**2 * twin.turn @ touch.wrench[:3]
            off, size = _size(other.touches[tool].wrench[:3] - expected), _size(expected)
            if not off <= tolerance * size:
                yield broken(name, f"force off by {100 * off / max(size, 1e-300):.2g} %", one, other)


def _asked(trial: Trial, answers: Answers) -> Iterator[tuple[Instant, Answer]]:
    scene, given = _scene(trial), answers_of(answers.scene)
    asked: list[tuple[Placed, ...]] = []
    for k, instant in enumerate(scene.instants):
        asked.append(instant)
        if scene.fed_back:
            before = given[2 * k]
            asked.append(tuple(p._replace(wrench=before.touches[p.tool.name].wrench) for p in instant))
    return zip(asked, given, strict=True)


def _scene(trial: Trial) -> Contacts:
    assert isinstance(trial.scene, Contacts)
    return trial.scene


def _distance(tool: Tool, layer: SoftLayer, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return field_of(tool, margin_on(layer)).distance((points - pose[:3, 3]) @ pose[:3, :3])


def _met(placed: Placed, layer: SoftLayer) -> float:
    """The furthest that a vertex must go in along its normal to be out of a tool [m]."""
    inside = np.flatnonzero(_distance(placed.tool, layer, placed.pose, layer.vertices) < 0)
    way = np.zeros(len(inside))
    for _ in range(STEPS_OUT):  # sphere tracing, from inside
        points = layer.vertices[inside] - way[:, None] * layer.normals[inside]
        way += np.maximum(-_distance(placed.tool, layer, placed.pose, points), 0)
    return float(way.max(initial=0.0))


def _wave(values: Sequence[float] | np.ndarray) -> float:
    return float(np.ptp(values) / np.mean(values))


def _size(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def _said(trusted: bool) -> str:
    return "trusts it" if trusted else "does not"
