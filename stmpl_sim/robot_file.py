"""Robot files: MJCF or URDF read for a scene, also where pictures of its links are not at hand."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from stmpl_core.errors import InvalidInput
from stmpl_sim.engine import mujoco

PACKAGE = "package://"  # beginning of ROS's names of files: package://NAME/path in it
READ = (".stl", ".obj", ".msh")  # kinds of meshes that MuJoCo reads
log = logging.getLogger(__name__)


def robot_spec(path: Path) -> Any:
    """A robot's model, MjSpec. Meshes that are not found or not read are left out with a warning.

    Args:
        path: MJCF or URDF file.

    Raises:
        InvalidInput: no such file, or one that MuJoCo does not read.
    """
    if not path.is_file():
        raise InvalidInput(f"there is no robot file {path}.")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        more = " It is a xacro: xacro FILE > robot.urdf makes a URDF of it." if path.suffix == ".xacro" else ""
        raise InvalidInput(f"MuJoCo cannot read {path}: {' '.join(str(error).split())}{more}") from error
    spec.compiler.discardvisual = spec.compiler.fusestatic = False  # as URDF has them, head and skin would be lost
    _place_meshes(spec, path)
    return spec


def _place_meshes(spec: Any, path: Path) -> None:
    """Says where the meshes of ROS packages lie, and leaves out those that are nowhere.

    Nothing of a robot collides with anything but the skin, so only a picture lacks them; a link without an inertial,
    whose mass would follow from them, is refused by MuJoCo itself.
    """
    missing = set()
    for mesh in spec.meshes:
        if not mesh.file or (not mesh.file.startswith(PACKAGE) and _found(mesh.file, spec, path)):
            continue
        if (found := _in_package(mesh.file, path)) is None:
            missing.add(_name(mesh))
        else:
            mesh.file = str(found)
    if not missing:
        return
    for geom in [one for one in spec.geoms if one.meshname in missing]:
        spec.delete(geom)
    for mesh in [one for one in spec.meshes if _name(one) in missing]:
        spec.delete(mesh)
    log.warning("%d meshes of %s are not there, or of no kind that MuJoCo reads (%s): they are not drawn. Contact and "
                "motion need none.", len(missing), path.name, ", ".join(READ))  # fmt: skip


def _name(mesh: Any) -> str:
    return mesh.name or Path(mesh.file).stem


def _found(file: str, spec: Any, path: Path) -> bool:
    """Whether MuJoCo finds and reads a mesh by itself, beside the robot's file."""
    name = Path(file).name if spec.strippath else file
    beside = (path.parent / spec.meshdir / name, path.parent / name)
    return Path(file).suffix.lower() in READ and any(one.is_file() for one in beside)


def _in_package(file: str, path: Path) -> Path | None:
    """A mesh package://NAME/rest under a folder NAME above or beside the robot's file; None: nowhere."""
    if not file.startswith(PACKAGE):
        return None
    rest = Path(file.removeprefix(PACKAGE))
    for above in path.resolve().parents:
        for one in (above / rest, above / Path(*rest.parts[1:])):
            if one.is_file() and one.suffix.lower() in READ:
                return one
    return None
