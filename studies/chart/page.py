"""A page with the chart to point at: one HTML file, drawn as SVG, that needs nothing else."""

from __future__ import annotations

import html
import math
from pathlib import Path

from matplotlib.colors import to_hex

from studies.chart.measure import Chart, Point
from studies.chart.picture import GUIDES, caption, limits, on_chart, style_of

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 360, 270, 42, 30, 24  # px of a panel and its margins
LOOK = """body{font:13px system-ui,sans-serif;margin:1.5em;color:#222}svg{background:#fff}p{color:#555;max-width:70em}
figure{display:inline-block;margin:4px}circle:hover{stroke:#000;stroke-width:2}.k.off{opacity:.25}
.k{margin-right:1.2em;white-space:nowrap;cursor:pointer;user-select:none}
.k i{display:inline-block;width:10px;height:10px;border-radius:5px;margin-right:4px}
text{font:10px system-ui,sans-serif;fill:#555}#tip{position:fixed;pointer-events:none;background:#fffe;border:1px solid
#999;padding:4px 7px;white-space:pre;display:none;border-radius:3px}"""
SCRIPT = """const tip=document.getElementById('tip');
document.querySelectorAll('[data-tip]').forEach(e=>{e.onmousemove=m=>{tip.textContent=e.dataset.tip;
tip.style.display='block';tip.style.left=Math.min(m.clientX+14,innerWidth-330)+'px';tip.style.top=m.clientY+14+'px'};
e.onmouseleave=()=>tip.style.display='none'});
document.querySelectorAll('.k').forEach(k=>k.onclick=()=>{const off=k.classList.toggle('off');
document.querySelectorAll('.c'+k.dataset.c).forEach(g=>g.style.display=off?'none':'')});"""


def write_page(chart: Chart, path: Path) -> Path:
    """Writes the HTML: point at a mark for all its figures, click a name to hide its curve."""
    styles, box = style_of(chart), limits(chart)
    colours = {name: to_hex(colour) for name, (colour, _) in styles.items()}
    keys = "".join(f'<span class=k data-c={k}><i style="background:{colour}"></i>{html.escape(name)}</span>'
                   for k, (name, colour) in enumerate(colours.items()))  # fmt: skip
    panels = "".join(_panel(chart, scene, ratio, colours, box)
                     for ratio in chart.about["ratios"] for scene in chart.about["scenes"])  # fmt: skip
    path.write_text(
        "<!doctype html><html lang=en><meta charset=utf-8><title>stmpl: speed against accuracy</title>"
        f"<style>{LOOK}</style><h2>Speed against accuracy</h2><p>Error: mean where the skin moves more than a tenth of "
        f"its largest displacement, in % of that. {html.escape(caption(chart))}</p><p>{keys}</p>{panels}"
        f"<div id=tip></div><script>{SCRIPT}</script></html>\n"
    )
    return path


def _panel(chart: Chart, scene: str, ratio: float, colours: dict[str, str],
           box: tuple[float, float, float, float]) -> str:  # fmt: skip
    fastest, slowest, least, largest = box

    def x(ms: float) -> float:
        return LEFT + (WIDTH - LEFT - 8) * math.log(ms / fastest) / math.log(slowest / fastest)

    def y(percent: float) -> float:
        kept = min(max(percent, least), largest)
        return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * math.log(kept / least) / math.log(largest / least)

    out = [f'<figure><svg width={WIDTH} height={HEIGHT}><text x={LEFT} y=14 style="font-weight:600">'
           f"{html.escape(scene)}, p = {ratio:g} E</text>"]  # fmt: skip
    for decade in range(-3, 6):
        value = 10.0**decade
        if fastest < value < slowest:
            out.append(f'<text x={x(value):.0f} y={HEIGHT - 14} text-anchor=middle>{value:g}</text>')
        if least < value < largest:
            out.append(f'<line x1={LEFT} x2={WIDTH - 8} y1={y(value):.1f} y2={y(value):.1f} stroke="#eee"/>'
                       f'<text x={LEFT - 4} y={y(value) + 3:.0f} text-anchor=end>{value:g} %</text>')  # fmt: skip
    for guide in GUIDES:
        out.append(f'<line x1={x(guide):.1f} x2={x(guide):.1f} y1={TOP} y2={HEIGHT - BOTTOM} stroke="#ccc" '
                   'stroke-dasharray="2 3"/>')  # fmt: skip
    out.append(f'<text x={WIDTH - 8} y={HEIGHT - 2} text-anchor=end>ms</text>')
    front = chart.front(scene, ratio)
    if front:
        path = [(x(1e3 * front[0].seconds), float(TOP))]
        for point in front:
            path += [(x(1e3 * point.seconds), path[-1][1]), (x(1e3 * point.seconds), y(100 * point.error))]
        path.append((WIDTH - 8.0, path[-1][1]))
        out.append(f'<polyline points="{_points(path)}" fill=none stroke="#ddd" stroke-width=6 />')
    for k, (name, colour) in enumerate(colours.items()):
        mine = [p for p in chart.points if (p.curve, p.scene, p.ratio) == (name, scene, ratio)]
        shown = [p for p in mine if on_chart(p)]
        line = _points([(x(1e3 * p.seconds), y(100 * p.error)) for p in shown])
        out.append(f'<g class=c{k}><polyline points="{line}" fill=none stroke="{colour}" stroke-opacity=.6 />')
        for p in mine:
            place = x(slowest / 1.3 if math.isnan(p.seconds) else 1e3 * p.seconds)
            if not on_chart(p):
                out.append(f'<text x={place:.1f} y={TOP + 8} style="fill:{colour};font-weight:700" '
                           f'data-tip="{_tip(p)}">x</text>')  # fmt: skip
            else:
                fill = colour if p.in_range else "#fff"
                out.append(f'<circle cx={place:.1f} cy={y(100 * p.error):.1f} r=4 fill="{fill}" stroke="{colour}" '
                           f'data-tip="{_tip(p)}"/>')  # fmt: skip
        out.append("</g>")
    return "".join(out) + "</svg></figure>"


def _points(path: list[tuple[float, float]]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in path)


def _tip(p: Point) -> str:
    slow = "" if math.isnan(p.slow) else f", p99 {1e3 * p.slow:.3g}"
    lines = [f"{p.curve}: {p.knob}"]
    if not math.isnan(p.seconds):
        lines += [f"{1e3 * p.seconds:.3g} ms{slow}", f"where it moves {100 * p.error:.2f} %",
                  f"under the contact {100 * p.contact:.2f} %", f"at the peak {100 * p.peak:+.2f} %",
                  f"largest {100 * p.largest:.1f} %, mean (the paper's) {100 * p.mee:.2f} %",
                  f"beyond 8 thicknesses {100 * p.far:.2g} %"]  # fmt: skip
    return html.escape("\n".join([*lines, *([p.why] if p.why else [])]), quote=True)
