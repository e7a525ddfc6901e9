"""One file a method; all follow the protocol in base. A method's file is imported when the method is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from stmpl_core.errors import InvalidInput
from stmpl_core.methods.base import Method

if TYPE_CHECKING:
    from stmpl_core.methods.coarse import Coarse
    from stmpl_core.methods.ladder import Ladder
    from stmpl_core.methods.limb_linear import LimbLinear
    from stmpl_core.methods.linear import Linear
    from stmpl_core.methods.moment_net import MomentNet
    from stmpl_core.methods.naive import Naive
    from stmpl_core.methods.unet import UNet
    from stmpl_core.methods.winkler import Winkler
    from stmpl_core.methods.zero import Zero

__all__ = ["METHODS", "Coarse", "Ladder", "LimbLinear", "Linear", "Method", "MomentNet", "Naive", "UNet", "Winkler",
           "Zero", "method"]  # fmt: skip

METHODS = {  # module and class of each method, by its name
    "moment_net": "stmpl_core.methods.moment_net:MomentNet",
    "unet": "stmpl_core.methods.unet:UNet",
    "linear": "stmpl_core.methods.linear:Linear",
    "winkler": "stmpl_core.methods.winkler:Winkler",
    "naive": "stmpl_core.methods.naive:Naive",
    "zero": "stmpl_core.methods.zero:Zero",
    "ladder": "fem_tools.ladder:ladder",
    "fem": "fem_tools.patch:PatchFem",
    "limb_linear": "stmpl_core.methods.limb_linear:LimbLinear",
}
_CLASSES = {"Coarse": "coarse", "Ladder": "ladder", "LimbLinear": "limb_linear", "Linear": "linear",
            "MomentNet": "moment_net", "Naive": "naive", "UNet": "unet", "Winkler": "winkler",
            "Zero": "zero"}  # fmt: skip


def method(name: str, **settings: Any) -> Method:
    """A method by its name, not yet prepared.

    Args:
        name: name in METHODS, or "module:attribute" of a method of your own.
        settings: arguments of its class.

    Raises:
        InvalidInput: an unknown method; the error lists those that exist.
    """
    module, _, attribute = METHODS.get(name, name).partition(":")
    try:
        make = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidInput(f"there is no method {name!r} ({error}). Available: {', '.join(METHODS)}, or "
                           "module:attribute of your own.") from error
    return make(**settings)


def __getattr__(name: str) -> Any:
    if name not in _CLASSES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_CLASSES[name]}"), name)
