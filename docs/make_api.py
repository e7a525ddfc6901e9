"""Writes docs/api.md from the docstrings of the public names.

.venv/bin/python docs/make_api.py      # a test fails while the page is out of date
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "api.md"
PUBLIC = {  # heading: modules, and the names in them that are promised to stay
    "From contact to answer": ["stmpl_core: Tool Contact Simulator Tools State Touch Answer Trust",
                               "stmpl_core.batch: Batch BatchTouches", "stmpl_core.gpu.memory: WarpStates",
                               "stmpl_core.touch: Slip", "stmpl_core.friction: Pair coefficient",
                               "stmpl_core.warming: warm_up CompiledAhead"],
    "Limb and load": ["stmpl_core.body: Body", "stmpl_core: SoftLayer Load Skin Rig Joint",
                      "stmpl_core.bones: Bone bones_of core_of to_bone"],
    "Tissue": ["stmpl_core: Tissue Membrane Ply Prony",
               "stmpl_core.regions: region Region Quantity",
               "stmpl_core.stack: compliance Compliance along Along effective Effective Misfit Fit ball Ball"
               " ball_force",
               "stmpl_core.needs: needs Needs Term Indentation"],
    "Methods": ["stmpl_core.methods: Method method Naive Winkler Linear MomentNet UNet Ladder LimbLinear",
                "stmpl_core: Displacement", "fem_tools.ladder: ladder", "stmpl_core.metrics: score Score"],
    "Finite elements": ["fem_tools: PatchFem WarmPatchFem IndenterFem Press Stroke RigidFem"],
    "Stiffness, haptics and gradients": ["stmpl_core.stiffness: fit_stiffness Stiffness",
                              "stmpl_core.haptics: DeviceLoop LoopSettings",
                              "stmpl_core.local_contact: local_contact local_contacts LocalContact Grip Rendered",
                              "stmpl_core.passive: PassiveContact",
                              "stmpl_core.gradients: Gradients WrenchGradient FieldGradient twisted",
                              "stmpl_core.layer: thicker"],
    "Robots in simulators": ["stmpl_sim: SoftBody exclude SoftContact Poses Memory Reaction World exchange",
                             "stmpl_sim.massage: Massage Course Phase Log", "stmpl_sim.scene: build Scene",
                             "stmpl_sim.site: Site Circle", "stmpl_sim.controller: ForceImpedance Gains Goal",
                             "stmpl_sim.energy: EnergyBook", "stmpl_sim.env: MassageEnv Scripted"],
    "Recordings": ["bags.reader: Bag", "bags.run: Run", "bags.writer: BagWriter", "bags.replay: replay replay_run",
                   "bags.compare: compare_run compare_bags Comparison", "bags.recover: recover"],
    "The node in your own process": ["stmpl_ros.node: SkinNode", "stmpl_ros.parameters: NodeConfig"],
}  # fmt: skip
OPENING = """# Reference of the Python names

Made from the docstrings by `docs/make_api.py`; do not edit. SI units; millimetres only where people read. What is not
listed may change without a word. The names at work: [examples](../examples). The words: [words.md](words.md).
"""
SECTIONS = ("Args:", "Attributes:", "Returns:", "Yields:", "Raises:")


class _Written(str):
    """An annotation as it stands in the source."""

    def __repr__(self) -> str:
        return str(self)


def names(heading: str) -> list[list[str]]:
    """Module and name of everything under a heading."""
    return [[line.split(":")[0], name] for line in PUBLIC[heading] for name in line.split()[1:]]


def find(module: str, name: str) -> Any | None:
    """The object of this name, or None where there is none."""
    try:
        return getattr(import_module(module), name, None)
    except ImportError:
        return None


def page() -> str:
    """The whole page, of the names that exist."""
    parts = [OPENING]
    for heading in PUBLIC:
        parts.append(f"## {heading}\n")
        for module, name in names(heading):
            if (thing := find(module, name)) is not None:
                parts += entry(module, name, thing)
    return "\n".join(parts)


def entry(module: str, name: str, thing: Any) -> Iterator[str]:
    """One name: how to import and call it, its docstring, and a line for each public member."""
    yield f"### {name}\n\n```python\nfrom {module} import {name}\n\n{called(name, thing)}\n```\n"
    yield told(thing)
    members = vars(thing).items() if inspect.isclass(thing) else ()
    lines = [member(each, value) for each, value in members if not each.startswith("_")]
    if any(lines):
        yield "\n".join(["**Members**\n", *filter(None, lines)]) + "\n"


def member(name: str, value: Any) -> str:
    """A bullet for a method or a property: how to call it, and its first paragraph."""
    function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    if not inspect.isfunction(function):
        return f"- `.{name}`: {first(value)}" if isinstance(value, property | cached_property) else ""
    return f"- `.{called(name, function, width=1000)}`: {first(function)}"


def called(name: str, thing: Any, width: int = 110) -> str:
    """The name with its parameters, one a line where they are long; bare where it takes none (a protocol)."""
    if not callable(thing) or getattr(thing, "_is_protocol", False):
        return name
    whole = inspect.signature(thing)
    shown = [each.replace(annotation=_Written(written)) if isinstance(written, str) else each
             for each in whole.parameters.values() if each.name not in ("self", "cls")
             for written in [getattr(each.annotation, "__forward_arg__", each.annotation)]]  # fmt: skip
    back = whole.return_annotation
    back = "" if back in (None, "None", whole.empty) else f" -> {back}"
    listed = re.sub(r"<[^<>]*(?:factory|at 0x\w+)[^<>]*>", "...", str(inspect.Signature(shown)))
    if len(name + listed + back) > width:
        listed = "(\n    " + re.sub(r", (?=\*|\w+(:|=))", ",\n    ", listed[1:-1]) + ",\n)"
    return name + listed + back


def first(thing: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


def told(thing: Any) -> str:
    """A docstring as Markdown: its sections become lists."""
    lines, listing = [], False
    for line in (inspect.getdoc(thing) or "").splitlines():
        listing |= line in SECTIONS
        item = re.match(r"    (\w[\w, .]*): (.*)", line) if listing else None
        lines.append(f"**{line[:-1]}**\n" if line in SECTIONS else f"- `{item[1]}`: {item[2]}" if item
                     else "  " + line.strip() if listing and line else line)  # fmt: skip
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
