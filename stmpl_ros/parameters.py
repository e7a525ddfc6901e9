"""What a person may set on node, devices, recorder and demo: one field list for command line and ROS parameters."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from stmpl_core.methods import Linear, Method, MomentNet, Naive, UNet, Winkler

METHODS: dict[str, Callable[[], Method]] = {
    "moment_net": MomentNet, "unet": UNet, "linear": Linear, "winkler": Winkler, "naive": Naive
}  # fmt: skip


class NodeConfig(BaseModel):
    """The node's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    part: str = Field(default="left_arm", description="part of the body that answers")
    edge_length: float = Field(default=3e-3, gt=0, description="of the skin's mesh [m]")
    thickness: float = Field(default=7.5e-3, gt=0, description="of the soft layer [m]")
    youngs_modulus: float = Field(default=1e3, gt=0, description="E of the tissue [Pa]")
    poisson_ratio: float = Field(default=0.4, ge=0, lt=0.5, description="nu of the tissue [-]")
    density: float = Field(default=1e3, gt=0, description="of the tissue [kg/m3]")
    method: Literal["moment_net", "unet", "linear", "winkler", "naive"] = Field(
        default="moment_net", description="that solves for the displacement"
    )
    frame: str = Field(default="body", min_length=1, description="frame_id of the body, in poses and answers")
    rest_after: float = Field(default=0.25, gt=0, description="a tool silent for longer is no longer in contact [s]")
    fade: float = Field(default=1.0, ge=0, description="in which the last answer goes to rest when all are silent [s]")
    max_age: float = Field(default=1.0, ge=0, description="older messages are dropped; 0 accepts any age [s]")
    marker_rate: float = Field(default=15.0, gt=0, description="of skin/marker while somebody looks [Hz]")
    local_rotations: bool = Field(
        default=True, description="local contacts say how the wrench follows rotations too, at twice the cost"
    )
    autostart: bool = Field(default=True, description="configure and activate without being asked")

    def declare_on(self, node: Any) -> NodeConfig:
        """Declares every field as a parameter of `node`, and returns the settings with what ROS overrides.

        Raises:
            pydantic.ValidationError: a parameter lies outside what its field allows.
        """
        from rcl_interfaces.msg import ParameterDescriptor

        values = {}
        for name, field in type(self).model_fields.items():
            described = ParameterDescriptor(description=field.description or "", read_only=True)
            values[name] = node.declare_parameter(name, getattr(self, name), described).value
        return NodeConfig(**values)

    def ros_arguments(self) -> list[str]:
        """The settings as arguments of a ROS process: --ros-args -p name:=value ..."""
        values = self.model_dump(mode="json").items()
        return ["--ros-args"] + [part for name, value in values for part in ("-p", f"{name}:={json.dumps(value)}")]


class ProbeConfig(BaseModel):
    """The simulated devices' settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scripts: tuple[Literal["press", "squeeze"], ...] = Field(
        default=("press", "squeeze"), description="played one after the other"
    )
    rate: float = Field(default=200.0, ge=1, le=2000, description="of poses and wrenches [Hz]")
    listeners: int = Field(default=1, ge=1, description="subscribers to wait for before moving; 2 with a recorder")
    patience: float = Field(default=60.0, gt=0, description="give up when nobody listens for longer [s]")


class RecordConfig(BaseModel):
    """The recorder's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: Path = Field(description="folder for run.mcap and metadata.yaml")
    run: Path | None = Field(default=None, description="JSON file that says what made the run; kept in the recording")


class DemoConfig(BaseModel):
    """The demo's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node: NodeConfig = NodeConfig()
    probe: ProbeConfig = ProbeConfig(rate=125.0, listeners=2, patience=180.0)
    frames: int = Field(default=12, ge=1, description="of the run that FEM solves again")
    runs: Path = Field(default=Path("runs"), description="folder that gets one folder a run")
