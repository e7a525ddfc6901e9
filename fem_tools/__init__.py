"""The ground truth: finite elements for a soft layer bonded to a rigid core, and what is learned from them."""

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from fem_tools.rigid import RigidFem
from fem_tools.stroke import Stroke
from fem_tools.warm import WarmPatchFem

__all__ = ["IndenterFem", "PatchFem", "Press", "RigidFem", "Stroke", "WarmPatchFem"]
