"""Simulators that people use, on our layer: one file a peer, each imported only when it is asked for."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from stmpl_core.errors import InvalidInput
from stmpl_core.extras import needed

PEERS = {  # name: (package that it needs, where its class is)
    "felupe": ("felupe", "studies.peers.felupe_hex:FelupeHex"),
    "mujoco_flex": ("mujoco", "studies.peers.mujoco_flex:MujocoFlex"),
    "newton_vbd": ("newton", "studies.peers.newton_vbd:NewtonVbd"),
}


def installed() -> list[str]:
    """Names of the peers whose package is there."""
    return [name for name, (package, _) in PEERS.items() if find_spec(package) is not None]


def peer(name: str) -> Any:
    """The class of a peer; its arguments are the peer's knobs.

    Raises:
        InvalidInput: there is no such peer, or its package is not installed.
    """
    if name not in PEERS:
        raise InvalidInput(f"unknown peer {name!r}. Available: {', '.join(PEERS)}.")
    package, place = PEERS[name]
    needed(name, "peers", package)
    module, attribute = place.split(":")
    return getattr(import_module(module), attribute)
