"""Film: robot and skin coloured by displacement, without a screen: by MuJoCo's renderer, or drawn in software."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.touch import Touch

log = logging.getLogger(__name__)
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # says on every import what it lacks

SKIN = np.array([[242, 228, 218], [247, 178, 103], [228, 87, 46], [140, 28, 63], [46, 10, 60]]) / 255
WIDTH, HEIGHT = 640, 480  # of a frame [pixels]
BACKENDS = ("egl", "osmesa")  # ways to render without a screen, in the order in which they are tried
SKY = np.array([0.97, 0.97, 0.98])
INK = (40, 40, 48)  # of captions
LIGHT = np.array([-0.35, -0.55, 0.76])  # direction to the light of drawn frames, world axes
AMBIENT = 0.45  # share of the light that comes from everywhere


def colours(values: np.ndarray) -> np.ndarray:
    """Colours, (N, 3) [0..1], of values from 0 to 1, (N,)."""
    at = np.linspace(0, 1, len(SKIN))
    return np.stack([np.interp(values, at, channel) for channel in SKIN.T], axis=-1)


class Camera:
    """Takes frames of a run.

    Args:
        model: MuJoCo model of a scene.
        layer: skin of the scene.
        most: displacement that has the last colour [m].
        backend: egl, osmesa or software; unless given, the first that works here.

    Attributes:
        backend: renderer of the frames: egl, osmesa or software.
        frames: frames so far, (HEIGHT, WIDTH, 3) uint8 each.

    Raises:
        InvalidInput: a backend that does not work here.
    """

    def __init__(self, model: Any, layer: Any, most: float, backend: str | None = None) -> None:
        self.model, self.layer, self.most = model, layer, most
        self.frames: list[np.ndarray] = []
        self._surfaces: dict[int, Any] = {}
        self.backend, self._renderer = _renderer(model, backend)
        if self._renderer is not None:
            from stmpl_sim.scene import SKIN_MESH

            self._mesh = model.mesh(SKIN_MESH).id

    def take(self, data: Any, skin_in_world: np.ndarray, pose_world_from_layer: np.ndarray, moved: np.ndarray,
             caption: str = "") -> None:  # fmt: skip
        """Takes a frame, and writes a caption and what the colours mean on it.

        Args:
            data: MuJoCo data.
            skin_in_world: vertices of the deformed skin, (V, 3) [m].
            pose_world_from_layer: pose of the layer's axes, (4, 4).
            moved: displacement of each vertex, (V,) [m].
            caption: what is said of the frame.
        """
        share = np.clip(moved / self.most, 0, 1)
        frame = self._drawn(data, skin_in_world, share) if self._renderer is None else \
            self._rendered(data, skin_in_world, pose_world_from_layer, share)
        self.frames.append(told(frame, caption, self.most))

    def close(self) -> None:
        """Gives the renderer back."""
        if self._renderer is not None:
            self._renderer.close()

    def _rendered(self, data: Any, skin: np.ndarray, pose: np.ndarray, share: np.ndarray) -> np.ndarray:
        from stmpl_sim.engine import mujoco
        from stmpl_sim.scene import EYE

        model, mesh, renderer = self.model, self._mesh, self._renderer
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[mesh])  # the compiler moved the mesh to its own principal axes
        local = (skin - pose[:3, 3]) @ pose[:3, :3]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        model.mesh_vert[first : first + count] = (local - model.mesh_pos[mesh]) @ turn.reshape(3, 3)
        first, count = model.mesh_normaladr[mesh], model.mesh_normalnum[mesh]
        model.mesh_normal[first : first + count] = _normals(local, self.layer.faces) @ turn.reshape(3, 3)
        first, count = model.mesh_texcoordadr[mesh], model.mesh_texcoordnum[mesh]
        model.mesh_texcoord[first : first + count, 0] = 0.004 + 0.992 * share
        mujoco.mjr_uploadMesh(model, renderer._mjr_context, mesh)
        renderer.update_scene(data, camera=EYE)
        return renderer.render()

    def _drawn(self, data: Any, skin: np.ndarray, share: np.ndarray) -> np.ndarray:
        from stmpl_sim.engine import mujoco
        from stmpl_sim.scene import EYE, SKIN_GEOM
        from stmpl_sim.shapes import geom_surface

        corners, shades, normals = [skin[self.layer.faces]], [colours(share)[self.layer.faces].mean(axis=1)], []
        normals.append(_normals(skin, self.layer.faces)[self.layer.faces].mean(axis=1))
        for geom in range(self.model.ngeom):
            kind = self.model.geom_type[geom]
            if self.model.geom(geom).name == SKIN_GEOM or kind == mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            if geom not in self._surfaces:
                self._surfaces[geom] = geom_surface(self.model, geom)
            surface = self._surfaces[geom]
            at, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
            there = (surface.vertices @ turn.T + at)[surface.faces]
            corners.append(there)
            normals.append(np.cross(there[:, 1] - there[:, 0], there[:, 2] - there[:, 0]))
            shades.append(np.broadcast_to(self.model.geom_rgba[geom, :3], (len(there), 3)))
        camera = data.camera(EYE)
        return draw(np.concatenate(corners), np.concatenate(shades), np.concatenate(normals), camera.xpos,
                    camera.xmat.reshape(3, 3), float(self.model.camera(EYE).fovy[0]))  # fmt: skip


def caption_of(at: float, touches: Mapping[str, Touch]) -> str:
    """What the tools do at a time [s]: 2.5 s   ball 5.0 N."""
    pressing = (touch for touch in touches.values() if touch.presses)
    return "   ".join([f"{at:.1f} s", *(f"{touch.name.replace('_', ' ')} {touch.force:.1f} N" for touch in pressing)])


def told(frame: np.ndarray, caption: str, most: float) -> np.ndarray:
    """A frame with a caption above, and below the scale of its colours up to a displacement `most` [m]."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(frame)
    left, top, wide, high = 12, image.height - 22, 150, 10
    bar = np.broadcast_to(colours(np.linspace(0, 1, wide)), (high, wide, 3))
    image.paste(Image.fromarray((255 * bar).astype(np.uint8)), (left, top))
    write, font = ImageDraw.Draw(image), ImageFont.load_default(15)
    write.text((left, top - 20), f"skin moved by 0 to {1e3 * most:.0f} mm", INK, font)
    write.text((left, 8), caption, INK, font)
    return np.asarray(image)


def draw(corners: np.ndarray, shades: np.ndarray, normals: np.ndarray, eye: np.ndarray, turn: np.ndarray,
         fovy: float) -> np.ndarray:  # fmt: skip
    """Draws triangles with a depth buffer, (HEIGHT, WIDTH, 3) uint8.

    Args:
        corners: triangles in the world, (F, 3, 3) [m].
        shades: colours of the triangles, (F, 3) [0..1].
        normals: normals of the triangles, of any length, (F, 3).
        eye: position of the camera, (3,) [m].
        turn: axes of the camera as columns: right, up, backwards, (3, 3).
        fovy: vertical angle of view [deg].
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    lit = AMBIENT + (1 - AMBIENT) * np.abs(normals @ LIGHT)
    seen = (corners - eye) @ turn
    scale = 0.5 * HEIGHT / np.tan(np.radians(fovy) / 2)
    depth = -seen[..., 2]
    seen, depth, shown = seen[depth.min(axis=1) > 0.01], depth, (lit[:, None] * shades)[depth.min(axis=1) > 0.01]
    depth = depth[depth.min(axis=1) > 0.01]
    x = 0.5 * WIDTH + scale * seen[..., 0] / depth
    y = 0.5 * HEIGHT - scale * seen[..., 1] / depth
    picture = np.tile(SKY, (HEIGHT, WIDTH, 1))
    _raster(x, y, 1 / depth, np.ascontiguousarray(shown), picture, np.zeros((HEIGHT, WIDTH)))
    return (255 * np.clip(picture, 0, 1)).astype(np.uint8)


@numba.njit(cache=True)
def _raster(x, y, near, shades, picture, nearest):
    """Fills triangles (F, 3) where none nearer is, by barycentric coordinates; `near` is one over the depth."""
    height, width = nearest.shape
    for f in range(len(x)):
        area = (x[f, 1] - x[f, 0]) * (y[f, 2] - y[f, 0]) - (x[f, 2] - x[f, 0]) * (y[f, 1] - y[f, 0])
        if abs(area) < 1e-12:
            continue
        left, right = max(0, int(np.ceil(x[f].min()))), min(width - 1, int(np.floor(x[f].max())))
        top, bottom = max(0, int(np.ceil(y[f].min()))), min(height - 1, int(np.floor(y[f].max())))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                b = ((column - x[f, 0]) * (y[f, 2] - y[f, 0]) - (x[f, 2] - x[f, 0]) * (row - y[f, 0])) / area
                c = ((x[f, 1] - x[f, 0]) * (row - y[f, 0]) - (column - x[f, 0]) * (y[f, 1] - y[f, 0])) / area
                a = 1 - b - c
                if a < 0 or b < 0 or c < 0:
                    continue
                z = a * near[f, 0] + b * near[f, 1] + c * near[f, 2]
                if z > nearest[row, column]:
                    nearest[row, column] = z
                    for k in range(3):
                        picture[row, column, k] = shades[f, k]


def save(frames: Sequence[np.ndarray], path: Path, rate: float) -> Path:
    """Writes an animation: .webp, .gif or .png (animated) by its ending.

    Args:
        frames: frames, (H, W, 3) uint8.
        path: file.
        rate: frames a second.

    Raises:
        InvalidInput: no frames, or another ending.
    """
    from PIL import Image

    if not frames:
        raise InvalidInput("a film needs at least one frame.")
    if path.suffix not in (".webp", ".gif", ".png"):
        raise InvalidInput(f"a film ends in .webp, .gif or .png; got '{path.name}'.")
    images = [Image.fromarray(frame) for frame in frames]
    more: dict[str, Any] = {"quality": 80, "method": 4} if path.suffix == ".webp" else {}
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1e3 / rate), loop=0, **more)
    return path


def _renderer(model: Any, backend: str | None) -> tuple[str, Any]:
    """MuJoCo's renderer by the first backend that works, and its name; None where frames are drawn in software.

    A backend that does not work may end the process, so each is tried in one of its own first.
    """
    from importlib import import_module, reload

    allowed = (*BACKENDS, "software")
    if backend not in (None, *allowed):
        raise InvalidInput(f"frames cannot be made by '{backend}'. Allowed: {', '.join(allowed)}.")
    if backend == "software":
        return backend, None
    chosen = os.environ.get("MUJOCO_GL")
    for name in (backend,) if backend else (chosen,) if chosen else BACKENDS:
        assert name is not None
        if not _works(name):
            continue
        os.environ["MUJOCO_GL"] = name
        os.environ.setdefault("PYOPENGL_PLATFORM", name)
        try:  # MuJoCo, imported by now, chose its backend then: let it choose again
            reload(import_module("mujoco.rendering.classic.gl_context"))
            return name, import_module("mujoco").Renderer(model, HEIGHT, WIDTH)
        except Exception as error:  # GL fails in any way it likes
            log.warning("%s works, but not in this process (%s)", name, error)
    if backend:
        raise InvalidInput(f"{backend} does not work here: no frame could be rendered. Try software.")
    log.warning("neither EGL nor OSMesa renders here: frames are drawn in software, without shadows")
    return "software", None


def _works(backend: str) -> bool:
    import subprocess
    import sys

    trial = ("import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); r = mujoco.Renderer(m, 8, 8);"
             "r.update_scene(mujoco.MjData(m)); r.render()")  # fmt: skip
    environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    try:
        return subprocess.run([sys.executable, "-c", trial], env=environment, capture_output=True,
                              timeout=60).returncode == 0  # fmt: skip
    except subprocess.TimeoutExpired:
        return False


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at the vertices, (V, 3)."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    out = np.stack([np.bincount(faces.ravel(), np.repeat(flat[:, k], 3), len(points)) for k in range(3)], axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)
