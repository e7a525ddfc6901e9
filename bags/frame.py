"""Frame: one recorded answer, with where it stands in its run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from stmpl_core.touch import Answer

Stamps = Mapping[str, tuple[int, int]]  # stamps of each tool's pose and wrench [ns]; 0: no wrench


@dataclass(frozen=True, eq=False)
class Frame(Answer):
    """One recorded answer (stmpl_msgs/SkinDisplacement): displacement (V, 3) and pressure (V,) float32, as sent.

    Args:
        stamp_ns: stamp of the newest pose that it answers [ns].
        log_time_ns: time at which the recorder received it [ns].
        sequence: number among the answers of one run.
        layer_id: name of the layer that it refers to.
        inputs: stamps of the pose and the wrench of each tool that it answers [ns]; 0: no wrench.
        solve_seconds: time that the node spent on it [s].
        fade: share of its contacts' answer that it is; below 1 where the input had stopped.
        state: memory of the tissue before it (State.pack); empty: none, elastic skin.
        dt: time since that state [s].
        friction: coefficient of friction of each tool [-].
        joints: angle of each joint of the layer's rig [rad]; empty: at rest.
        surfaces: name of the surface of each tool (Tool.digest); empty: recordings from before it was told.
    """

    stamp_ns: int = 0
    log_time_ns: int = 0
    sequence: int = 0
    layer_id: str = ""
    inputs: Stamps = field(default_factory=dict)
    solve_seconds: float = 0.0
    fade: float = 1.0
    state: bytes = b""
    dt: float = 0.0
    friction: Mapping[str, float] = field(default_factory=dict)
    joints: tuple[float, ...] = ()
    surfaces: Mapping[str, str] = field(default_factory=dict)

    @property
    def peak(self) -> float:
        """Length of the largest displacement [m]."""
        return float(self.magnitude.max(initial=0.0))
