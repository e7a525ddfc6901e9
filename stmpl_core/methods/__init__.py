"""One file a method; all follow the protocol in base."""

from stmpl_core.methods.base import Method
from stmpl_core.methods.linear import Linear
from stmpl_core.methods.moment_net import MomentNet
from stmpl_core.methods.naive import Naive
from stmpl_core.methods.unet import UNet
from stmpl_core.methods.winkler import Winkler
from stmpl_core.methods.zero import Zero

__all__ = ["Linear", "Method", "MomentNet", "Naive", "UNet", "Winkler", "Zero"]
