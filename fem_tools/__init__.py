"""The ground truth: finite elements for a soft layer bonded to a rigid core, and what is learned from them."""

from fem_tools.patch import PatchFem

__all__ = ["PatchFem"]
