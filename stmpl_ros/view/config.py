"""ViewConfig: what a person may set on the viewer."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from stmpl_ros.parameters import NodeConfig


class ViewConfig(BaseModel):
    """The viewer's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node: NodeConfig = Field(default=NodeConfig(), description="skin and method under a dragged tool")
    tool: str = Field(default="fingertip", description="tool: ball, fingertip, cylinder, a letter, or a mesh file in m")
    frames: int = Field(default=300, ge=2, description="number of frames that the time slider holds; each costs 0.2 MB")
    namespace: str = Field(default="", description="namespace of the one robot of a recording to show, /left")
    fem: int = Field(default=0, ge=0, description="number of frames that FEM solves before the page opens")
    patience: float = Field(default=10.0, gt=0, description="silence of the live node after which the page says so [s]")
    host: str = Field(default="127.0.0.1", description="address to serve on; 0.0.0.0 lets other machines look")
    port: int = Field(default=8080, ge=0, le=65535, description="port to serve on; the next free one is taken")
