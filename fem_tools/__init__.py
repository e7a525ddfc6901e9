"""The ground truth: finite elements for a soft layer bonded to a rigid core, and what is learned from them."""

from fem_tools.indenter import IndenterFem, Tool
from fem_tools.patch import PatchFem
from fem_tools.rigid import RigidFem

__all__ = ["IndenterFem", "PatchFem", "RigidFem", "Tool"]
