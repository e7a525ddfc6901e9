"""Page: pieces of an HTML page that refers to no other file."""

from __future__ import annotations

import html
from base64 import b64encode
from collections.abc import Sequence
from io import BytesIO

from matplotlib.figure import Figure

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #2b2b2b; max-width: 1120px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
table { border-collapse: collapse; margin: .6em 0; } td, th { padding: .22em .8em; text-align: right; }
th { border-bottom: 1px solid #999; font-weight: 600; } td:first-child, th:first-child { text-align: left; }
tr:nth-child(even) td { background: #f6f4f1; } img { max-width: 100%; }
pre { background: #f6f4f1; padding: 1em; overflow: auto; }
.verdict { padding: .6em 1em; border-left: 5px solid; } .good { border-color: #3a7d44; } .bad { border-color: #b3261e; }
.note { color: #666; font-size: .92em; }
"""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, its first column to the left."""
    top = "".join(f"<th>{text(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def image(figure: Figure) -> str:
    """A figure as a picture inside the page."""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    return inside("image/png", stream.getvalue())


def inside(kind: str, data: bytes) -> str:
    """A picture or an animation of this media type, inside the page."""
    return f"<img src='data:{kind};base64,{b64encode(data).decode()}' alt=''>"


def text(said: str) -> str:
    """Text, safe inside HTML."""
    return html.escape(str(said))
