"""Robots in simulators that feel soft skin: MuJoCo, and the small interface that other simulators use. Knows no ROS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stmpl_sim.mujoco_skin import SoftBody, exclude
    from stmpl_sim.protocol import Memory, Poses, Reaction, SoftContact, World, exchange

__all__ = ["Memory", "Poses", "Reaction", "SoftBody", "SoftContact", "World", "exchange", "exclude"]

_HOME = {"SoftBody": "mujoco_skin", "exclude": "mujoco_skin"}  # who only uses the protocol needs no MuJoCo


def __getattr__(name: str) -> Any:
    """Imports the module of a public name when it is asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME.get(name, 'protocol')}"), name)
