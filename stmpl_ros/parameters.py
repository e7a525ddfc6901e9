"""What a person may set on node, devices, recorder and demo: one field list for command line and ROS parameters."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from pydantic.config import JsonDict

from stmpl_core.body import phenotype_from
from stmpl_core.friction import friction_from
from stmpl_core.layer import MAX_THICKNESS
from stmpl_core.methods import Method, method
from stmpl_core.tissue import SOFTEST

PAPER = "paper"  # tissue of one layer, by the settings beside it
ONE_LAYER = ("thickness", "youngs_modulus", "poisson_ratio", "density")  # settings beside it
FOREARM, PAPER_ARM = "left_forearm", "left_arm"  # parts that answer unless one is asked for
LEAST = {"deadline": 1e-3, "max_age": 1e-3, "field_rate": 1e-3}  # of fields in which 0 is a choice of its own
ACCURACY = 2e-4  # error at any vertex that is asked for [m]
ANY_TIME: JsonDict = {"when": "any time"}  # fields that a running node takes over at once
CONFIGURING: JsonDict = {"when": "configuring"}  # fields that count when the node is configured
LISTS: dict[str, tuple[str, str] | tuple[()]] = {  # fields of several names, and how a pair of them is written
    "shape_tools": (),
    "joints": ("joint=name", "left_elbow=elbow_2"),
    "tf_tools": ("tool=frame", "finger=tool0"),
    "gz_contacts": ("tool=collision", "finger=robot::tip::collision"),
}
Names = tuple[str, ...]


class NodeConfig(BaseModel):
    """The node's settings. What is neither ANY_TIME nor CONFIGURING counts from the start to the end."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    part: str = Field(
        default="", json_schema_extra=CONFIGURING,
        description=f"part of the body that answers, or a picked place and radius in metres, 'around:x,y,z,radius'; "
        f"empty: {FOREARM}, and with tissue 'paper' {PAPER_ARM}",
    )  # fmt: skip
    phenotype: str = Field(
        default="",
        description="phenotype of the body, each value from 0 to 1: 'weight=0.7 muscle=0.3'; 0.5 unless given",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    edge_length: float = Field(
        default=3e-3, gt=0, le=0.05, description="length of the skin mesh's edges [m]", json_schema_extra=CONFIGURING
    )
    tissue: str = Field(
        default="relaxed", min_length=1,
        description="what is under the skin: 'relaxed' or 'tensed': skin, fat and muscle of the part as measured, to "
        "its bones; 'paper': one layer of thickness, youngs_modulus and poisson_ratio; or a file of needs --out",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    thickness: float = Field(
        default=7.5e-3, gt=0, le=0.1, description="thickness of the paper's layer [m]", json_schema_extra=CONFIGURING
    )
    youngs_modulus: float = Field(
        default=1e3, gt=0, le=1e9, description="Young's modulus of the paper's layer [Pa]",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    poisson_ratio: float = Field(
        default=0.4, ge=0, lt=0.5, description="Poisson's ratio of the paper's layer [-]", json_schema_extra=CONFIGURING
    )
    density: float = Field(
        default=1e3, gt=0, le=1e5, description="density of the paper's layer [kg/m3]", json_schema_extra=CONFIGURING
    )
    joint_states: str = Field(
        default="", json_schema_extra=CONFIGURING,
        description="topic of sensor_msgs/JointState that bends the limb, an arm or a leg; empty: it stays at rest",
    )  # fmt: skip
    joints: Names = Field(
        default=(), json_schema_extra=CONFIGURING,
        description="names of the limb's joints in these messages where they are not its own: 'left_elbow=elbow_2'",
    )  # fmt: skip
    friction: str = Field(
        default="", json_schema_extra=CONFIGURING,
        description="friction of tools on skin: a coefficient, or dry, moist, oiled, glove, typical; or by tool: "
        "'ball: oiled, letter: 0.3', or none; empty: as a file of stmpl needs says, else none",
    )  # fmt: skip
    relaxing: bool = Field(
        default=False, json_schema_extra=CONFIGURING,
        description="stress that fades, as in skin that was stretched and held (assumed of all materials)",
    )  # fmt: skip
    method: Literal["moment_net", "unet", "linear", "winkler", "naive", "limb_linear", "ladder"] = Field(
        default="moment_net", description="method that solves for the displacement", json_schema_extra=CONFIGURING
    )
    accuracy: float = Field(
        default=ACCURACY, gt=0, le=1, description="largest error at any vertex that the ladder is asked for [m]",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    solve_time: float = Field(
        default=0.0, ge=0, le=3600, description="time that the ladder may take for a solve [s]; 0: as long as it needs",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    limits: str = Field(
        default="", description="YAML file of pressure and force limits, advisory; empty: none",
        json_schema_extra=CONFIGURING,
    )  # fmt: skip
    frame: str = Field(default="body", min_length=1, description="frame_id of the body, in poses and answers")
    frames: str = Field(
        default="", description="YAML file of other frames that poses may come in, fixed in the body's; empty: none"
    )
    deadline: float = Field(
        default=0.0, ge=0, le=3600, description="longest time between two poses that a device must promise, from "
        "0.001 [s]; 0: none",
    )  # fmt: skip
    shape_tools: Names = Field(default=(), description="tools that announce their surface as shape_msgs/Mesh")
    tf_tools: Names = Field(
        default=(), description="tools whose pose is that of a frame of /tf: 'finger=tool0'; needs tf2_ros"
    )
    tf_rate: float = Field(default=100.0, ge=1, le=1000, description="rate at which these frames are looked up [Hz]")
    tf_wait: float = Field(
        default=0.1, ge=0, le=10, json_schema_extra=ANY_TIME,
        description="longest wait for /tf to say where a message's frame was at its stamp; then it is refused [s]",
    )  # fmt: skip
    gz_contacts: Names = Field(
        default=(), description="tools that Gazebo's contacts push: 'finger=robot::tip::collision'"
    )
    gz_body: str = Field(
        default="", description="model, link or collision in Gazebo that is the body; empty: whatever the tools touch"
    )
    rest_after: float = Field(
        default=0.25, ge=0.01, le=3600, description="silence after which a tool is no longer in contact [s]",
        json_schema_extra=ANY_TIME,
    )  # fmt: skip
    fade: float = Field(
        default=1.0, ge=0, le=3600,
        description="time in which the last answer fades to rest when all tools are silent [s]",
        json_schema_extra=ANY_TIME,
    )  # fmt: skip
    max_age: float = Field(
        default=1.0, ge=0, le=1e9, description="age beyond which a message is dropped, from 0.001 [s]; 0: never",
        json_schema_extra=ANY_TIME,
    )  # fmt: skip
    marker_rate: float = Field(
        default=15.0, ge=1e-3, le=1000, description="rate of skin/marker and skin/points while somebody listens [Hz]",
        json_schema_extra=ANY_TIME,
    )  # fmt: skip
    field_rate: float = Field(
        default=0.0, ge=0, le=1000, json_schema_extra=ANY_TIME,
        description="largest rate of skin/displacement, to leave the processor to the reactions, from 0.001 [Hz]; 0: "
        "as it goes",
    )  # fmt: skip
    autostart: bool = Field(default=True, description="start into the active state without being asked")

    @field_validator("thickness", mode="before")
    @classmethod
    def _in_metres(cls, value: float) -> float:
        if isinstance(value, (int, float)) and value > MAX_THICKNESS:
            raise ValueError(f"at most {MAX_THICKNESS:g} m is accepted. Is it in millimetres? Scale it by 1e-3")
        return value

    @field_validator("youngs_modulus", mode="before")
    @classmethod
    def _in_pascals(cls, value: float) -> float:
        if isinstance(value, (int, float)) and 0 < value < SOFTEST:
            raise ValueError(f"at least {SOFTEST:g} Pa is accepted. Is it in kilopascals? Scale it by 1e3")
        return value

    @field_validator(*LEAST)
    @classmethod
    def _none_or_enough(cls, value: float, info: ValidationInfo) -> float:
        if 0 < value < (least := LEAST[str(info.field_name)]):
            raise ValueError(f"it must be 0 or at least {least:g}")
        return value

    @field_validator("phenotype")
    @classmethod
    def _phenotype(cls, text: str) -> str:
        phenotype_from(text)
        return text

    @field_validator("friction")
    @classmethod
    def _friction(cls, text: str) -> str:
        friction_from(text)
        return text

    @field_validator(*LISTS, mode="before")
    @classmethod
    def _parted(cls, given: object) -> object:
        """One text of names parted by blanks is as good as many; empty ones, which ROS needs in a list, are none."""
        texts = given.split() if isinstance(given, str) else given
        return tuple(text for text in texts if text != "") if isinstance(texts, Iterable) else given

    @field_validator(*LISTS)
    @classmethod
    def _pairs(cls, texts: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if pattern := LISTS[str(info.field_name)]:
            _named(texts, *pattern)
        body = info.data.get("frame")
        if info.field_name != "joints" and body in [text.partition("=")[0] for text in texts]:
            raise ValueError(f"'{body}' is the body's own frame; a tool needs another name")
        return texts

    @property
    def limb(self) -> str:
        """The part of the body that answers: the one that is asked for, or else that which the tissue is meant for."""
        return self.part or (PAPER_ARM if self.tissue == PAPER else FOREARM)

    @property
    def gz_collisions(self) -> dict[str, str]:
        """The collision of each tool that takes its wrench from Gazebo."""
        return _named(self.gz_contacts, *LISTS["gz_contacts"])

    @property
    def tf_frames(self) -> dict[str, str]:
        """The frame of each tool that takes its pose from /tf."""
        return _named(self.tf_tools, *LISTS["tf_tools"])

    @property
    def joint_names(self) -> dict[str, str]:
        """Names of joints in joint states, by the limb's own, where they differ."""
        return _named(self.joints, *LISTS["joints"])

    def new_method(self) -> Method:
        """The method, not yet prepared."""
        if self.method == "ladder":
            return method("ladder", accuracy=self.accuracy, deadline=self.solve_time or None)
        return method(self.method)

    @property
    def phenotype_values(self) -> dict[str, float]:
        """The phenotype by name."""
        return phenotype_from(self.phenotype)

    @classmethod
    def names(cls, when: JsonDict) -> set[str]:
        """The fields that count ANY_TIME or CONFIGURING."""
        return {name for name, field in cls.model_fields.items() if field.json_schema_extra == when}

    def ros_arguments(self) -> list[str]:
        """The settings as arguments of a ROS process: --ros-args -p name:=value ..."""
        values = {name: [""] if value == [] else value for name, value in self.model_dump(mode="json").items()}.items()
        return ["--ros-args"] + [part for name, value in values for part in ("-p", f"{name}:={json.dumps(value)}")]


def _named(texts: Iterable[str], what: str, example: str) -> dict[str, str]:
    """name=other name. Raises ValueError."""
    found = {}
    for text in texts:
        name, _, other = text.partition("=")
        if not name or not other:
            raise ValueError(f"'{text}' is no {what}, as in '{example}'")
        found[name] = other
    return found


class ProbeConfig(BaseModel):
    """The simulated devices' settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scripts: tuple[Literal["press", "squeeze"], ...] = Field(
        default=("press", "squeeze"), description="scripts to play, one after the other"
    )
    rate: float = Field(default=200.0, ge=1, le=2000, description="rate of poses and wrenches [Hz]")
    listeners: int = Field(
        default=1, ge=1, description="number of subscribers to wait for before moving; 2 with a recorder"
    )
    patience: float = Field(default=60.0, gt=0, description="time after which to give up if nobody listens [s]")


class RobotConfig(BaseModel):
    """The simulated robot's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    force: tuple[float, ...] = Field(
        default=(5.0,), min_length=1, description="forces to press with, one after the other [N]"
    )
    speed: float = Field(default=50.0, ge=0, description="speed along the circles [mm/s]")
    circle: float = Field(default=12.0, gt=0, description="radius of the circles [mm]")
    laps: float = Field(default=2.0, ge=0, description="laps with each force")
    radius: float = Field(default=20.0, gt=0, description="radius of the ball that presses [mm]")
    mount: Literal["auto", "fixed", "springs", "rest"] = Field(
        default="auto", description="mount of the limb; rest: hinged at its thicker end; auto: rest if it is gripped, "
        "else fixed",
    )  # fmt: skip
    grip: float | None = Field(
        default=None, ge=0, description="force of each of two fingers that grip the limb in the end, and lift it [N]; "
        "0: none; unless given, stmpl demo takes 10 on a forearm",
    )  # fmt: skip
    friction: str = Field(
        default="none", description="coefficient of friction, or dry, moist, oiled, glove, typical, or none; or by "
        "tool: 'ball: oiled, left_finger: 0.6'; fingers that are not named: glove",
    )  # fmt: skip
    robot: Path | None = Field(
        default=None, description="MJCF or URDF file of the robot; the 7-axis arm that ships unless given"
    )
    end: str = Field(default="", description="body or site of it that carries the ball; empty: its last body")
    at: tuple[float, float, float] = Field(default=(0.5, 0.0, 0.25), description="place of the limb in its world [m]")
    physics: float = Field(default=500.0, ge=50, le=20_000, description="rate of physics and contact [Hz]")
    every: int = Field(
        default=1, ge=1, description="steps from one at which the contact law is asked to the next; in between contact "
        "goes on to first order",
    )  # fmt: skip
    rate: float = Field(default=100.0, ge=1, le=2000, description="rate of poses, wrenches and joints [Hz]")
    told: bool = Field(
        default=False,
        description="wrench of the wrist on tools/ball/wrench too: the node then corrects the pose by it; without it "
        "both answer the contact by its pose",
    )
    out: Path | None = Field(default=None, description="folder for the robot's own log, robot.npz")
    listeners: int = Field(
        default=1, ge=1, description="number of subscribers to wait for before moving; 2 with a recorder"
    )
    patience: float = Field(default=60.0, gt=0, description="time after which to give up if nobody listens [s]")
    linger: float = Field(default=2.0, ge=0, description="time that the simulated clock goes on at the end [s]")


class LinksConfig(BaseModel):
    """The settings of soft skin for a simulator that talks ROS."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    body: str = Field(min_length=1, description="link that carries the skin; its axes are the skin's")
    tools: tuple[str, ...] = Field(
        min_length=1, description="links that may touch, each with a file of its surface [m], its axes: tip=tip.stl"
    )
    part: str = Field(default=FOREARM, description="part of the average body")
    tissue: str = Field(default="relaxed", description="tissue of it, as of stmpl node: relaxed, tensed, or a file")
    edge_length: float = Field(default=3e-3, gt=0, le=0.05, description="length of the skin mesh's edges [m]")
    poses: str = Field(default="links/{link}/pose", description="topic of the pose of a link in the world")
    pose_type: Literal["pose", "odometry", "tf"] = Field(
        default="pose", description="message of it: PoseStamped, Odometry, or /tf (where tf2_msgs is installed)"
    )
    wrenches: str = Field(default="links/{link}/wrench", description="topic of the wrench on a link")
    wrench_type: Literal["wrench", "entity"] = Field(
        default="wrench",
        description="message of it: WrenchStamped, or ros_gz_interfaces/EntityWrench, which names its link",
    )
    axes: Literal["world", "link"] = Field(default="world", description="axes of the wrenches")
    about: tuple[str, ...] = Field(
        default=(),
        description="point of a link that its wrench is about, its axes [m], where not its origin: tip=0,0,0.02",
    )
    damping: float = Field(default=0.0, ge=0, description="damping of the contact [s/m]; 0: none")
    friction: str = Field(
        default="",
        description="coefficient of friction, or dry, moist, oiled, glove, typical, or none; empty: as a file of stmpl "
        "needs says, else none",
    )
    relaxing: bool = Field(default=False, description="stress that fades, as in skin that was stretched and held")
    silence: float = Field(
        default=0.25, ge=0.01, description="time without a pose after which every wrench is set to nothing [s]"
    )


class RecordConfig(BaseModel):
    """The recorder's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    path: Path = Field(description="folder for run_0.mcap and metadata.yaml")
    run: Path | None = Field(default=None, description="JSON file that says what made the run; kept in the recording")
    frames: Path | None = Field(default=None, description="file of frames, as the node's; by default the one of `run`")


class DemoConfig(BaseModel):
    """The demo's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    device: Literal["robot", "probe"] = Field(
        default="robot", description="what touches: a simulated robot that massages, or devices along a script"
    )
    node: NodeConfig = NodeConfig()
    robot: RobotConfig = RobotConfig(force=(10.0,), laps=1.0, listeners=2, patience=400.0)
    probe: ProbeConfig = ProbeConfig(rate=125.0, listeners=2, patience=180.0)
    frames: int = Field(default=4, ge=1, description="number of frames of the run that FEM solves again")
    runs: Path = Field(default=Path("runs"), description="folder that gets one folder a run")
