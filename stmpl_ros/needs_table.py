"""What the verb `needs` shows: a table for people, figures for machines."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from stmpl_core.needs import Indentation, Needs, Term

WORDS = {"skin": "skin", "tension": "tension of the skin", "muscle": "muscle as its own layer",
         "time": "relaxation in time", "slip": "slip", "mesh": "finer mesh"}  # fmt: skip

STIFFER = 1.2  # factor on the modulus of people's fat from which it is told


def needs_figures(found: Needs) -> dict[str, Any]:
    """What a scene asks for, for machines; SI."""
    return {
        "smallest": found.sentence,
        "rung": found.rung,
        "layer": found.layer._asdict() | {"misfit": found.layer.misfit._asdict()} if found.layer else None,
        "relaxing": found.relaxing,
        "friction": found.friction,
        "moduli": found.moduli,
        "enough": found.enough._asdict(),
        "terms": {term.name: vars(term) for term in found.terms},
        "indentations": [_indentation_figures(one) for one in found.indentations],
    }


def _indentation_figures(one: Indentation) -> dict[str, Any]:
    judged = {"depth": one.judged.depth, "force": one.judged.force, "contact_radius": one.judged.contact_radius}
    return {"radius": one.radius, "force": one.force, "depth": one.depth, "beyond": one.beyond, "judged": judged,
            "fat_stiffer": one.stiffer}


def needs_table(found: Needs, title: str) -> Table:
    """What a scene asks for, for people: a row a term, the depths, and the smallest model in a sentence."""
    table = Table(title=title, title_justify="left", caption_justify="left", caption_style="")
    table.add_column("left out")
    table.add_column("force off [%]", justify="right")
    table.add_column("motion off [%]", justify="right")
    table.add_column("needed")
    table.add_column("why")
    for term in found.terms:
        table.add_row(WORDS[term.name], _percent(term.force, "+.0f"), _percent(term.motion, ".0f"), _verdict(term),
                      term.why)  # fmt: skip
    lines = ["Off: with all else as it is. Needed: where no fit of the rest makes up for it."]
    lines += [_depth(one) for one in found.indentations]
    if found.beyond:
        lines.append("Deeper, skin and muscle matter more than these figures say, tension less: docs/tissue.md.")
    if (deepest := max(found.indentations, key=lambda one: one.stiffer)).stiffer > STIFFER:
        lines.append(f"Pressed together by {deepest.strain:.0%}, people's fat is {deepest.stiffer:.1f} times as stiff "
                     "as at rest, which is left out here: forces are a low end (docs/credibility.md).")
    table.caption = "\n".join([*lines, "", found.sentence])
    return table


def _verdict(term: Term) -> str:
    judged = term.force is not None or term.motion is not None
    return ("yes" if term.needed else "no") if judged else "not judged"


def _depth(one: Indentation) -> str:
    ball = f"A ball of {one.radius * 1e3:g} mm under {one.force:g} N"
    if not one.beyond:
        return f"{ball} stands {one.depth * 1e3:.1f} mm deep, by the linear response."
    return (f"{ball} goes beyond the linear response: figures are for {one.judged.depth * 1e3:.1f} mm, "
            f"where it takes {one.judged.force:.2g} N.")  # fmt: skip


def _percent(share: float | None, form: str) -> str:
    return "" if share is None else f"{share * 100:{form}}"
