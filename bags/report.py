"""Report: one self-contained HTML page on a compared run: figures, pictures, timeline, latency, trust, origin."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bags.compare import Comparison, FramePair, headline
from bags.page import STYLE, image, table, text
from bags.pictures import (
    DIFFERENCE,
    FLAT,
    MM,
    SKIN,
    Spot,
    draw_cut,
    draw_skin,
    draw_tool,
    limb_axis,
    scale,
    spot_of,
    view_along,
)
from bags.replay import ReplaySummary
from stmpl_core.errors import BagError
from stmpl_core.trust import Trust

INK, OURS, TRUTH, WARN = "#2b2b2b", "#c1440e", "#1f4e79", "#f6c667"
STOPPED = "#d9534f"
ROOM = 2.6  # half width of a close-up, in radii of the contact
CLOSEST = 0.02  # half width of the narrowest close-up [m]


def write_report(
    comparison: Comparison, path: Path | str, *, replay: ReplaySummary | None = None, front: str = ""
) -> Path:
    """Writes the page; nothing in it refers to another file.

    Args:
        comparison: comparison with at least one frame that the reference solved.
        path: path of the .html file to write.
        replay: summary of a replay of the same run, if there was one.
        front: HTML that the page opens with.

    Raises:
        BagError: nothing to show, or the file cannot be written.
    """
    path = Path(path)
    parts = [_opening(comparison, replay), _pressed(comparison), _timeline_part(comparison), _frames_part(comparison)]
    page = "\n".join([front, *parts, _origin(comparison)])
    try:
        path.write_text(f"<!doctype html><html lang=en><meta charset=utf-8><title>stmpl: {text(comparison.method)}"
                        f"</title><style>{STYLE}</style><body>{page}</body></html>\n")  # fmt: skip
    except OSError as error:
        raise BagError(f"the report {path} cannot be written: {error.strerror}.") from error
    return path


def pressed_figures(comparison: Comparison, pair: FramePair) -> list[Figure]:
    """Close-ups of one frame (ours, reference, difference), then the whole limb beside a cut through the contact."""
    layer, pressure = pair.layer, pair.frame.pressure
    if pressure is None or not (pressure > 0).any():
        raise BagError(f"frame {pair.frame.sequence} carries no load, so there is nothing to show.")
    spot = spot_of(layer, pressure)
    return [_close_ups(comparison, pair, spot), _overview(comparison, pair, spot)]


def timeline_figure(comparison: Comparison) -> Figure:
    """Force, depth and error over time, with stretches that are not to be trusted shaded."""
    moments, judged = comparison.run.moments, comparison.judged
    time = np.array([moment.time for moment in moments])
    figure = Figure(figsize=(10.5, 6.2), layout="constrained")
    force, depth, error = figure.subplots(3, 1, sharex=True)
    force.plot(time, [moment.load for moment in moments], color=INK, lw=1.2)
    force.set_ylabel("load on the skin [N]")
    depth.plot(time, [MM * moment.peak for moment in moments], color=OURS, lw=1.2, label=comparison.method)
    at = [pair.time for pair in judged]
    depth.plot(at, [MM * pair.score.peak for pair in judged], "o", color=TRUTH, ms=5, label=comparison.reference)
    depth.set_ylabel("largest displacement [mm]")
    error.plot(at, [MM * pair.score.contact for pair in judged], "o-", color=OURS, label="mean under the contact")
    error.plot(at, [MM * pair.score.mee for pair in judged], "s-", color=INK, label="mean where the skin moves (MEE)")
    error.plot(at, [MM * abs(pair.score.peak_error) for pair in judged], "^-", color=TRUTH, label="at the peak")
    error.set(ylabel="error [mm]", xlabel="time since the first answer [s]")
    for axes in (force, depth, error):
        _shade(axes, time, ~np.array([moment.in_range for moment in moments]), WARN, "outside the validated range")
        _shade(axes, time, ~np.array([moment.converged for moment in moments]), STOPPED, "not converged")
        axes.set_ylim(bottom=0)
        if axes is not force or axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def latency_figure(comparison: Comparison) -> Figure:
    """Histogram of the latency from the last contact message to the answer."""
    timing = comparison.run.timing
    known = 1e3 * timing.latencies[np.isfinite(timing.latencies)]
    figure = Figure(figsize=(10.5, 2.8), layout="constrained")
    axes = figure.subplots()
    top = 1.3 * max(1e3 * timing.latency(99), 1e-3) if len(known) else 1.0
    axes.hist(np.minimum(known, top), bins=60, range=(0, top), color=TRUTH)
    for percent, style in ((50, "-"), (99, "--")):
        value = 1e3 * timing.latency(percent)
        axes.axvline(value, color=OURS, ls=style, label=f"{'median' if percent == 50 else '99 %'}: {value:.2f} ms")
    axes.set(xlabel="latency, contact message to displacement message [ms]", ylabel="answers")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _close_ups(comparison: Comparison, pair: FramePair, spot: Spot) -> Figure:
    layer, ours, truth = pair.layer, pair.ours.displacement, pair.reference.displacement
    view = view_along(spot.normal, limb_axis(layer), spot.centre, tilt=-42)
    half = max(ROOM * spot.radius, CLOSEST)
    lengths = [MM * np.linalg.norm(u, axis=1) for u in (ours, truth)]
    off = MM * np.linalg.norm(ours - truth, axis=1)
    moved, apart = scale(lengths, SKIN), scale([off], DIFFERENCE)
    figure = Figure(figsize=(10.5, 3.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    panels = (
        (left, comparison.method, ours, lengths[0], moved),
        (middle, comparison.reference, truth, lengths[1], moved),
        (right, "difference", ours, off, apart),
    )
    for axes, title, displacement, values, colours in panels:
        draw_skin(axes, view, layer, displacement, values, colours, half_width=half)
        axes.set_title(f"{title}\nup to {values.max():.2f} mm", fontsize=10, color=INK)
    _ruler(left, half)
    figure.colorbar(moved, ax=[left, middle], label="displacement [mm]", pad=0.01)
    figure.colorbar(apart, ax=right, label="difference [mm]", pad=0.01)
    return figure


def _overview(comparison: Comparison, pair: FramePair, spot: Spot) -> Figure:
    layer = pair.layer
    axis = limb_axis(layer)
    centre = (layer.vertices.max(axis=0) + layer.vertices.min(axis=0)) / 2
    length = MM * np.linalg.norm(pair.ours.displacement, axis=1)
    colours = scale([length], SKIN)
    figure = Figure(figsize=(10.5, 4.0), layout="constrained")
    whole, cut = figure.subplots(1, 2, width_ratios=(1.5, 1))
    side = np.cross(axis, spot.normal)
    towards = side / np.linalg.norm(side) + 0.55 * spot.normal
    view = view_along(towards / np.linalg.norm(towards), axis, centre)
    behind = [view.project(contact.pose_body_from_tool[None, :3, 3])[0, 2] < 0 for contact in pair.contacts]
    for contact in (c for c, hidden in zip(pair.contacts, behind, strict=True) if hidden):
        draw_tool(whole, view, contact)
    draw_skin(whole, view, layer, pair.ours.displacement, length, colours)
    for contact in (c for c, hidden in zip(pair.contacts, behind, strict=True) if not hidden):
        draw_tool(whole, view, contact)
    whole.set_title(f"{comparison.method} and the tools, {pair.load:.2f} N", fontsize=10, color=INK)
    figure.colorbar(colours, ax=whole, label="displacement [mm]", shrink=0.8, pad=0.01, location="left")
    _cut(cut, comparison, pair, spot, axis)
    return figure


def _cut(axes: Axes, comparison: Comparison, pair: FramePair, spot: Spot, limb: np.ndarray) -> None:
    """Across the limb where several tools press, along it where one does."""
    layer, across = pair.layer, len(pair.contacts) > 1
    out = limb if across else np.cross(spot.normal, limb)
    out = out - (out @ spot.normal) * spot.normal
    out /= np.linalg.norm(out)
    view = view_along(out, np.cross(spot.normal, out), spot.centre)
    for contact in pair.contacts:
        pose = contact.pose_body_from_tool
        points = contact.tool.vertices @ pose[:3, :3].T + pose[:3, 3]
        draw_cut(axes, points, contact.tool.faces, view, color="#9aa3ad", lw=1.2)
    draw_cut(axes, layer.vertices, layer.faces, view, color="#b8b0a8", lw=1.0, ls=":")
    draw_cut(axes, layer.inner_vertices, layer.faces, view, color="#b8b0a8", lw=1.0)
    for side, colour in ((pair.reference, TRUTH), (pair.ours, OURS)):
        draw_cut(axes, layer.vertices + side.displacement, layer.faces, view, color=colour, lw=1.6)
    names = (("tool", "#9aa3ad"), ("skin at rest (dotted), core", "#b8b0a8"), (comparison.reference, TRUTH),
             (comparison.method, OURS))  # fmt: skip
    for name, colour in names:
        axes.plot([], [], color=colour, label=name)
    half = MM * max(ROOM * spot.radius, CLOSEST)
    if across:
        axes.autoscale_view()
    else:
        axes.set(xlim=(-half, half), ylim=(-0.8 * half, 0.5 * half))
    axes.set_aspect("equal")
    axes.set(xlabel="mm", ylabel="mm")
    axes.set_title(f"cut {'across' if across else 'along'} the limb through the contact", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=8, loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.42))
    axes.spines[["top", "right"]].set_visible(False)


def _ruler(axes: Axes, half: float) -> None:
    left, low = -0.92 * half * MM, -0.92 * FLAT * half * MM
    axes.plot([left, left + 10], [low, low], color=INK, lw=2)
    axes.text(left, low + 0.02 * half * MM, "10 mm", fontsize=8, color=INK, va="bottom")


def _shade(axes: Axes, time: np.ndarray, flagged: np.ndarray, colour: str, label: str) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flagged, [False]]).astype(int)))
    for number, (start, stop) in enumerate(edges.reshape(-1, 2)):
        end = float(time[min(stop, len(time) - 1)])
        axes.axvspan(float(time[start]), end, color=colour, alpha=0.3, lw=0, label=label if number == 0 else None)


def _opening(comparison: Comparison, replay: ReplaySummary | None) -> str:
    kind = "good" if comparison.passed else "bad"
    lines = [f"<h1>{text(comparison.method)} against {text(comparison.reference)}</h1>",
             f"<p class='verdict {kind}'>{text(comparison.verdict)}</p>"]  # fmt: skip
    if replay is not None:
        lines.append(f"<p>{text(str(replay))}</p>")
    if comparison.run.bag.damage or not comparison.run.bag.finished:
        lines.append("<p class='verdict bad'>The recording is damaged or was not finished; what is sound was read.</p>")
    lines.append(table(("measured", "value"), headline(comparison)))
    lines.append("<p class=note>Errors are means and standard deviations over the compared frames. MAE, MEE and the "
                 "shares count vertices that the reference moves by more than 0.001 mm, as the STMPL paper does; most "
                 "of them hardly move, so look at the errors under the contact and at the peak.</p>")  # fmt: skip
    return "\n".join(lines)


def _pressed(comparison: Comparison) -> str:
    lines = ["<h2>The pressed limb</h2>"]
    shown = [("Under the largest load", comparison.heaviest)]
    if comparison.most_tools is not None and comparison.most_tools is not comparison.heaviest:
        shown.append(("With several tools", comparison.most_tools))
    for title, pair in shown:
        tools = "; ".join(f"{name}: {touch.status}" for name, touch in pair.frame.touches.items())
        lines.append(f"<h3>{title}, {pair.time:.2f} s, {pair.load:.2f} N</h3><p class=note>{text(tools)}. "
                     "Drawn to scale, not exaggerated; both sides answer the same contact.</p>")  # fmt: skip
        lines += [image(figure) for figure in pressed_figures(comparison, pair)]
    return "\n".join(lines)


def _timeline_part(comparison: Comparison) -> str:
    moments = comparison.run.moments
    outside = sum(not moment.in_range for moment in moments)
    stopped = sum(not moment.converged for moment in moments)
    reasons = Counter(moment.why for moment in moments if moment.why and not moment.in_range).most_common(1)
    most = f", most often since {text(reasons[0][0].rstrip('.'))}" if reasons else ""
    return (f"<h2>Over time</h2>{image(timeline_figure(comparison))}<p class=note>Yellow: outside the range that the "
            f"method was validated on, so that its error there is not known ({outside} of {len(moments)} answers"
            f"{most}); red: not converged ({stopped}).</p>"
            f"<h2>Latency</h2>{image(latency_figure(comparison))}")  # fmt: skip


def _frames_part(comparison: Comparison) -> str:
    head = ("time s", "load N", "peak of reference mm", "error at peak mm", "error at peak, % of it",
            "error under contact mm", "MEE mm", "answer", "reference")  # fmt: skip
    rows = [(f"{p.time:.2f}", f"{p.load:.3f}", f"{MM * p.score.peak:.3f}", f"{MM * p.score.peak_error:+.3f}",
             f"{100 * p.score.peak_share:+.1f}", f"{MM * p.score.contact:.3f}", f"{MM * p.score.mee:.3f}",
             _trust(p.frame.trust), _trust(p.reference.trust)) for p in comparison.pairs]  # fmt: skip
    failed = "".join(f"<li>answer {n}: {text(why)}</li>" for n, why in comparison.failed.items())
    return f"<h2>The compared frames</h2>{table(head, rows)}{f'<p>Not solved:</p><ul>{failed}</ul>' if failed else ''}"


def _origin(comparison: Comparison) -> str:
    bag = comparison.run.bag
    topics = [(t.name, t.type_name, str(t.messages)) for t in bag.topics.values()]
    told, layers = bag.provenance, [repr(layer) for layer in bag.layers.values()]
    made = {"body": told.body, "layers": layers, "method": told.method, "config": told.config,
            "versions": told.versions}  # fmt: skip
    recorded = table(("topic", "type", "messages"), topics)
    return (f"<h2>What was recorded</h2><p class=note>{text(bag.file.name)}</p>{recorded}"
            f"<h2>What made it</h2><pre>{text(json.dumps(made, indent=2, default=str))}</pre>")  # fmt: skip


def _trust(trust: Trust) -> str:
    flags = {"not converged": trust.converged, "out of range": trust.in_range}
    words = [word for word, good in flags.items() if not good]
    bound = "" if trust.error_bound is None else f" ±{MM * trust.error_bound:.2f} mm"
    return (", ".join(words) or "ok") + bound
