"""The core: layers, tools, contacts, and the methods that solve them. Knows no ROS and no FEM."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stmpl_core.kernels import forget_old

if TYPE_CHECKING:
    from stmpl_core.contact import Contact
    from stmpl_core.layer import SoftLayer
    from stmpl_core.load import Load
    from stmpl_core.rig import Joint, Rig
    from stmpl_core.simulator import Simulator
    from stmpl_core.skin import Skin
    from stmpl_core.state import State
    from stmpl_core.tissue import Membrane, Ply, Prony, Tissue
    from stmpl_core.tool import Tool
    from stmpl_core.tools import Tools
    from stmpl_core.touch import Answer, Touch
    from stmpl_core.trust import Displacement, Trust

__all__ = ["Answer", "Contact", "Displacement", "Joint", "Load", "Membrane", "Ply", "Prony", "Rig", "Simulator", "Skin",
           "SoftLayer", "State", "Tissue", "Tool", "Tools", "Touch", "Trust"]  # fmt: skip

_HOME = {"Answer": "touch", "Contact": "contact", "Displacement": "trust", "Joint": "rig", "Load": "load",
         "Membrane": "tissue", "Ply": "tissue", "Prony": "tissue", "Rig": "rig", "Simulator": "simulator",
         "Skin": "skin", "SoftLayer": "layer",
         "State": "state", "Tissue": "tissue", "Tool": "tool", "Tools": "tools",
         "Touch": "touch", "Trust": "trust"}  # fmt: skip
_ON_CORE = ("fem_tools", "stmpl_sim")  # packages beside this one whose kernels are made from its


forget_old([folder for folder in (Path(__file__).parent, *map(Path(__file__).parents[1].joinpath, _ON_CORE))
            if folder.is_dir()])  # fmt: skip


def __getattr__(name: str) -> Any:
    """Imports the module of a public name when it is asked for: a verb pays for what it uses."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
