"""One file a method; all follow the protocol in base."""

from stmpl_core.methods.base import Method
from stmpl_core.methods.naive import Naive
from stmpl_core.methods.winkler import Winkler

__all__ = ["Method", "Naive", "Winkler"]
