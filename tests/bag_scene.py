"""A recorded run made without ROS: a tube of soft tissue, a ball and a finger, and real messages in CDR."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bags.provenance import write_provenance
from bags.schema import find_schema, typestore_of
from bags.wire import NO_SURFACES, contact_from, quaternion_from, tool_from
from bags.writer import BagWriter, qos_yaml
from stmpl_core import Answer, SoftLayer, Tissue, Touch
from stmpl_core.layer import layer_id
from stmpl_core.methods.base import Method
from stmpl_core.simulator import Simulator
from stmpl_core.state import State
from stmpl_ros.cli import main

TYPES = {
    "mesh": "stmpl_msgs/msg/ContactMesh",
    "pose": "geometry_msgs/msg/PoseStamped",
    "wrench": "geometry_msgs/msg/WrenchStamped",
    "topology": "stmpl_msgs/msg/SkinTopology",
    "displacement": "stmpl_msgs/msg/SkinDisplacement",
    "tf": "tf2_msgs/msg/TFMessage",
}
STORE = typestore_of([(s.name, s.text) for s in map(find_schema, TYPES.values())])
ANGLES = {"ball": 0.3, "finger": 0.3 + 2.2}  # rad around the tube
START = 1_700_000_000_000_000_000  # ns
TURNED = np.array([[0.8, -0.6, 0, 0], [0.6, 0.8, 0, 0], [0, 0, 1, 0.01], [0, 0, 0, 1]])  # pose_body_from_frame
STANDS = np.array([[1, 0, 0, 0.5], [0, 0.8, -0.6, 0.2], [0, 0.6, 0.8, 0.9], [0, 0, 0, 1]])  # pose_world_from_body


def message(kind: str, **values: Any) -> Any:
    """A message of one of TYPES, or of any other type by its full name."""
    return STORE.types[TYPES.get(kind, kind)](**values)


def header(frame: str, stamp: int) -> Any:
    """std_msgs/Header at `stamp` [ns]."""
    time = message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def cdr(made: Any) -> bytes:
    """The message as it goes over the wire."""
    return bytes(STORE.serialize_cdr(made, made.__msgtype__))


def tube(edge: float = 6e-3, length: float = 0.16, radius: float = 0.04) -> SoftLayer:
    """A slightly tapered tube, open at both ends, with a layer of 7.5 mm and E = 10 kPa."""
    around, along = round(2 * np.pi * radius / edge), round(length / edge)
    i, j = np.meshgrid(np.arange(around), np.arange(along + 1))
    angle, z = (i + 0.5 * (j % 2)) * 2 * np.pi / around, j * length / along
    r = radius * (1 - 0.15 * z / length)
    vertices = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)
    faces = []
    for row in range(along):
        for k in range(around):
            a, b = row * around + k, row * around + (k + 1) % around
            c, d = a + around, b + around
            faces += [[a, b, c], [b, d, c]] if row % 2 == 0 else [[a, d, c], [a, b, d]]
    return SoftLayer(vertices.astype(np.float32), np.array(faces), np.float32(7.5e-3), tissue=Tissue(1e4, 0.4))


def ball(radius: float = 12e-3) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) float32 and triangles of a ball."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)


def pose(angle: float, z: float, gap: float, stamp: int, radius: float = 12e-3) -> Any:
    """A ball at `angle` around the tube, at height z, `gap` above its skin."""
    r = 0.04 * (1 - 0.15 * z / 0.16) + radius + gap
    point = message("geometry_msgs/msg/Point", x=r * np.cos(angle), y=r * np.sin(angle), z=z)
    turn = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(angle / 2), w=np.cos(angle / 2))
    placed = message("geometry_msgs/msg/Pose", position=point, orientation=turn)
    return message("pose", header=header("body", stamp), pose=placed)


def wrench(tool: str, newtons: float, stamp: int) -> Any:
    """A push of `newtons` along the tool's own -x, which points at the tube's axis."""
    force = message("geometry_msgs/msg/Vector3", x=-newtons, y=0.0, z=0.0)
    torque = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    push = message("geometry_msgs/msg/Wrench", force=force, torque=torque)
    return message("wrench", header=header(tool, stamp), wrench=push)


def topology(layer: SoftLayer) -> Any:
    """The layer as SkinTopology."""
    return message("topology", header=header("body", START), layer_id=layer_id(layer),
                   vertices=layer.vertices.astype(np.float32).ravel(), triangles=layer.faces.astype(np.uint32).ravel(),
                   thickness=layer.thickness.astype(np.float32), youngs_modulus=layer.tissue.youngs_modulus,
                   poisson_ratio=layer.tissue.poisson_ratio, density=layer.tissue.density,
                   core=np.zeros(0, np.float32), stack="", rig="",
                   rig_weights=np.zeros(0, np.float32))  # fmt: skip


def displacement(answer: Answer, layer: SoftLayer, stamp: int, sequence: int, state: State | None = None,
                 dt: float = 0.0, surfaces: Mapping[str, str] = NO_SURFACES) -> Any:  # fmt: skip
    """An answer as SkinDisplacement."""
    trust = answer.trust
    pressure = np.zeros(0) if answer.pressure is None else answer.pressure
    return message("displacement", header=header("body", stamp), layer_id=layer_id(layer), sequence=sequence,
                   displacement=answer.displacement.astype(np.float32).ravel(), pressure=pressure.astype(np.float32),
                   method=answer.method, converged=trust.converged, in_range=trust.in_range,
                   error_bound=float("nan") if trust.error_bound is None else trust.error_bound, why=trust.why,
                   touches=[touched(touch, stamp, surfaces.get(name, "")) for name, touch in answer.touches.items()],
                   fade=1.0, solve_seconds=0.001, dt=dt, joints=np.zeros(0),
                   state=np.frombuffer(b"" if state is None else state.pack(), np.uint8))  # fmt: skip


def touched(touch: Touch, stamp: int, surface: str = "") -> Any:
    """What one tool does, by pose and wrench of one stamp, as stmpl_msgs/Touch."""
    (x, y, z), turn = touch.pose_body_from_tool[:3, 3], quaternion_from(touch.pose_body_from_tool[:3, :3])
    point = message("geometry_msgs/msg/Point", x=x, y=y, z=z)
    turned = message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True)))
    placed = message("geometry_msgs/msg/Pose", position=point, orientation=turned)
    slip = touch.slip
    return message("stmpl_msgs/msg/Touch", tool=touch.name, status=touch.status, pose=placed,
                   wrench=six(touch.wrench), depth=touch.depth,
                   force_bound=touch.force_bound, in_range=touch.trust.in_range,
                   pose_stamp=header("", stamp).stamp, wrench_stamp=header("", stamp).stamp,
                   friction=0.0, slip=slip.kind if slip else "", slip_share=slip.share if slip else 0.0,
                   friction_wrench=six(slip.wrench if slip else np.zeros(6)), missing=six(touch.missing),
                   passive=touch.passive, surface=surface)  # fmt: skip


def going(stamp: int) -> np.ndarray:
    """pose_body_from_frame (4, 4) of a frame that turns about the tube and goes along it, at TURNED at the start."""
    seconds = (stamp - START) * 1e-9
    pose, angle = TURNED.copy(), 1.5 * seconds
    pose[:2, :2] = TURNED[:2, :2] @ [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[2, 3] += 0.05 * seconds
    return pose


def transform(parent: str, child: str, pose: np.ndarray, stamp: int) -> Any:
    """A TFMessage of one frame in its parent."""
    place = message("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[:3, 3], strict=True)))
    turn = message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion_from(pose[:3, :3]), strict=True)))
    placed = message("geometry_msgs/msg/Transform", translation=place, rotation=turn)
    return message("tf", transforms=[message("geometry_msgs/msg/TransformStamped", header=header(parent, stamp),
                                             child_frame_id=child, transform=placed)])  # fmt: skip


def write_tf(bag: BagWriter, child: str, since: int, until: int) -> None:
    """The body stands still in the world; a frame goes there, told at 30 Hz between two stamps [ns]."""
    still, moving = (bag.add_channel(topic, TYPES["tf"], qos_yaml()) for topic in ("/tf_static", "/tf"))
    bag.write(still, cdr(transform("world", "body", STANDS, START)), START, START)
    for stamp in range(since, until, 33_000_000):
        bag.write(moving, cdr(transform("world", child, STANDS @ going(stamp), stamp)), stamp, stamp)


def six(values: np.ndarray) -> Any:
    """A wrench, (6,) [N, N m], as geometry_msgs/Wrench."""
    force, torque = (message("geometry_msgs/msg/Vector3", **dict(zip("xyz", part, strict=True)))
                     for part in (values[:3], values[3:]))  # fmt: skip
    return message("geometry_msgs/msg/Wrench", force=force, torque=torque)


def write_run(folder: Path, method: Method, *, layer: SoftLayer | None = None, frames: int = 40, rate: float = 100.0,
              lose: tuple[int, ...] = (), skip: tuple[int, ...] = (), delay: float = 0.002,
              namespace: str = "/stmpl", frame: str = "body", table: bool = True,
              tf: tuple[int, int] | None = None, grow: int = -1, unheard: tuple[int, ...] = ()) -> Path:  # fmt: skip
    """Records a ball that presses and slides, joined in the last third by a second one; returns the folder.

    Frames in `lose` are answered but not recorded, those in `skip` are not answered at all; poses of those in `unheard`
    are not recorded. From frame `grow` on the tools are larger. Poses come in `frame`,
    which if it is not the body's stands at TURNED; the recording says so if it carries a `table`, else only /tf did.
    With `tf` it is `going`, and /tf between these stamps [ns] is recorded.
    """
    known_frames = {} if frame == "body" or tf else {frame: TURNED}
    layer = layer or tube()
    simulator, (vertices, triangles) = Simulator(layer, method), ball()
    with BagWriter(folder) as bag:
        write_provenance(bag, None, method=method.name, body="tube", config={"rate": rate, "frames": frames},
                         frames=known_frames if table else {})  # fmt: skip
        kept, stream = qos_yaml(transient_local=True), qos_yaml()
        skin = bag.add_channel(f"{namespace}/skin/topology", TYPES["topology"], kept)
        surface = bag.add_channel(f"{namespace}/contact_mesh", TYPES["mesh"], kept)
        answers = bag.add_channel(f"{namespace}/skin/displacement", TYPES["displacement"], stream)
        tools = {(tool, kind): bag.add_channel(f"{namespace}/tools/{tool}/{kind}", TYPES[kind], stream)
                 for tool in ANGLES for kind in ("pose", "wrench")}  # fmt: skip
        bag.write(skin, cdr(topology(layer)), START, START)
        if tf:
            write_tf(bag, frame, *tf)
        known = {}
        for tool in ANGLES:
            sent = message("mesh", header=header(tool, START), vertices=vertices.ravel(), triangles=triangles.ravel())
            bag.write(surface, cdr(sent), START, START)
            known[tool] = tool_from(sent)
        sequence = 0
        for k in range(frames):
            stamp = START + round((k + 1) * 1e9 / rate)
            contacts = []
            if k == grow:
                for tool in ANGLES:
                    sent = message("mesh", header=header(tool, stamp), vertices=1.3 * vertices.ravel(),
                                   triangles=triangles.ravel())  # fmt: skip
                    bag.write(surface, cdr(sent), stamp, stamp)
                    known[tool] = tool_from(sent)
            for tool, newtons in script(k / frames).items():
                height, gap = 0.06 + 0.03 * k / frames, -0.5e-3 if newtons else 5e-3
                instant = pose(ANGLES[tool], height, gap, stamp), wrench(tool, newtons, stamp)
                instant[0].header.frame_id = frame
                for kind, made in zip(("pose", "wrench"), instant, strict=True) if k not in unheard else ():
                    bag.write(tools[tool, kind], cdr(made), stamp + 100_000, stamp)
                frames_now = {frame: going(stamp)} if tf else known_frames
                contacts.append(contact_from(known[tool], *instant, body_frame="body", frames=frames_now))
            if k in skip:
                continue
            answer = simulator.step(contacts)
            if k not in lose:
                received = stamp + 100_000 + round(delay * 1e9)
                surfaces = {one.name: one.tool.digest for one in contacts}
                said = displacement(answer, layer, stamp, sequence, surfaces=surfaces)
                bag.write(answers, cdr(said), received, received)
            sequence += 1
    return folder


def script(share: float) -> dict[str, float]:
    """What each tool presses with [N] after a share of the run: one ball presses, in the last third a second joins."""
    pushes = {"ball": 0.4 * float(np.sin(np.pi / 2 * min(3 * share, 1.0)))}
    return pushes if share < 2 / 3 else pushes | {"finger": 0.3 * (3 * share - 2)}


def stmpl(capsys, *arguments: object) -> tuple[int, str]:
    """Exit code of the command, and all that it printed."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    shown = capsys.readouterr()
    return int(ended.value.code or 0), " ".join((shown.out + shown.err).split())
