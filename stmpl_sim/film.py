"""Film: robot and skin coloured by displacement, without a screen: by MuJoCo's renderer, or drawn in software.

Below, the same skin from above and coloured by pressure, without the tools that hide it: always drawn in software.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.touch import Touch

log = logging.getLogger(__name__)
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # says on every import what it lacks

SKIN = np.array([[242, 228, 218], [247, 178, 103], [228, 87, 46], [140, 28, 63], [46, 10, 60]]) / 255
PRESSED = np.array([[236, 236, 232], [150, 201, 198], [59, 142, 165], [30, 77, 122], [16, 24, 62]]) / 255
WIDTH, HEIGHT, STRIP = 640, 480, 240  # of a frame, and of its strip with the pressure [pixels]
ABOVE, FOVY, MARGIN = np.radians(60), 20.0, 1.15  # height and angle of view over the strip [rad, deg], room around [-]
BACKENDS = ("egl", "osmesa")  # ways to render without a screen, in the order in which they are tried
SKY = np.array([0.97, 0.97, 0.98])
INK = (40, 40, 48)  # of captions
LIGHT = np.array([-0.35, -0.55, 0.76])  # direction to the light of drawn frames, world axes
AMBIENT = 0.45  # share of the light that comes from everywhere


def colours(values: np.ndarray, scale: np.ndarray = SKIN) -> np.ndarray:
    """Colours, (N, 3) [0..1], of values from 0 to 1, (N,), on a scale of colours, (K, 3)."""
    at = np.linspace(0, 1, len(scale))
    return np.stack([np.interp(values, at, channel) for channel in scale.T], axis=-1)


class Shot(NamedTuple):
    """What a frame shows.

    Args:
        data: MuJoCo data, kept for it alone.
        skin: vertices of the deformed skin in the world, (V, 3) [m].
        limb: pose of the layer's axes in the world, (4, 4).
        moved: displacement of each vertex, (V,) [m].
        pressure: pressure at each vertex, (V,) [Pa]; None: not known.
        caption: what is said of it.
    """

    data: Any
    skin: np.ndarray
    limb: np.ndarray
    moved: np.ndarray
    pressure: np.ndarray | None
    caption: str


class Film(NamedTuple):
    """A film: its file, the renderer of its frames, and displacement [m] and pressure [Pa] of the last colours."""

    path: Path
    frames_by: str
    colour_m: float
    colour_pa: float | None


def film(model: Any, layer: Any, shots: Sequence[Shot], path: Path, *, most: float, rate: float,
         backend: str | None = None) -> Film:  # fmt: skip
    """Makes a film of shots; nine in ten of those under pressure stay within its scale.

    Args:
        model: MuJoCo model of the scene.
        layer: skin of the scene.
        shots: shots, in order.
        path: file, see `save`.
        most: displacement that has the last colour [m].
        rate: frames a second.
        backend: see Camera.
    """
    peaks = [float(one.pressure.max()) for one in shots if one.pressure is not None and one.pressure.max() > 0]
    hardest = 1e3 * float(np.ceil(1e-3 * np.percentile(peaks, 90))) if peaks else None
    camera = Camera(model, layer, most, backend, hardest)
    for shot in shots:
        camera.take(shot)
    camera.close()
    return Film(save(camera.frames, path, rate), camera.backend, most, hardest)


class Camera:
    """Takes frames of a run.

    Args:
        model: MuJoCo model of a scene.
        layer: skin of the scene.
        most: displacement that has the last colour [m].
        backend: egl, osmesa or software; unless given, the first that works here.
        hardest: pressure that has the last colour [Pa]; None: frames have no strip that shows it.

    Attributes:
        backend: renderer of the frames: egl, osmesa or software.
        frames: frames so far, (HEIGHT, WIDTH, 3) uint8 each, or (HEIGHT + STRIP, WIDTH, 3) with pressure.

    Raises:
        InvalidInput: a backend that does not work here.
    """

    def __init__(self, model: Any, layer: Any, most: float, backend: str | None = None,
                 hardest: float | None = None) -> None:  # fmt: skip
        self.model, self.layer, self.most, self.hardest = model, layer, most, hardest
        self._above: tuple[np.ndarray, np.ndarray] | None = None
        self.frames: list[np.ndarray] = []
        self._surfaces: dict[int, Any] = {}
        self.backend, self._renderer = _renderer(model, backend)
        if self._renderer is not None:
            from stmpl_sim.scene import SKIN_MESH

            self._mesh = model.mesh(SKIN_MESH).id

    def take(self, shot: Shot) -> None:
        """Takes a frame, and writes its caption and what the colours mean on it."""
        share = np.clip(shot.moved / self.most, 0, 1)
        frame = self._drawn(shot.data, shot.skin, share) if self._renderer is None else \
            self._rendered(shot.data, shot.skin, shot.limb, share)
        frame = told(frame, shot.caption, f"skin moved by 0 to {1e3 * self.most:.0f} mm", SKIN)
        if self.hardest is not None:
            frame = np.concatenate([frame, self._pressed(shot, self.hardest)])
        self.frames.append(frame)

    def close(self) -> None:
        """Gives the renderer back."""
        if self._renderer is not None:
            self._renderer.close()

    def _pressed(self, shot: Shot, hardest: float) -> np.ndarray:
        """The strip: skin without tools, from above, its pressure."""
        if self._above is None:
            self._above = _view_above(shot.data, shot.skin)
        pressure = np.zeros(len(shot.skin)) if shot.pressure is None else shot.pressure
        shades = colours(np.clip(pressure / hardest, 0, 1), PRESSED)[self.layer.faces].mean(axis=1)
        normals = _normals(shot.skin, self.layer.faces)[self.layer.faces].mean(axis=1)
        strip = draw(shot.skin[self.layer.faces], shades, normals, *self._above, FOVY, STRIP)
        return told(strip, "", f"pressure 0 to {1e-3 * hardest:.0f} kPa, from above, tools left out", PRESSED)

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


def told(frame: np.ndarray, caption: str, meaning: str, scale: np.ndarray) -> np.ndarray:
    """A frame with a caption above, and below a scale of colours, (K, 3), and its meaning."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(frame)
    left, top, wide, high = 12, image.height - 22, 150, 10
    bar = np.broadcast_to(colours(np.linspace(0, 1, wide), scale), (high, wide, 3))
    image.paste(Image.fromarray((255 * bar).astype(np.uint8)), (left, top))
    write, font = ImageDraw.Draw(image), ImageFont.load_default(15)
    write.text((left, top - 20), meaning, INK, font)
    write.text((left, 8), caption, INK, font)
    return np.asarray(image)


def draw(corners: np.ndarray, shades: np.ndarray, normals: np.ndarray, eye: np.ndarray, turn: np.ndarray,
         fovy: float, high: int = HEIGHT) -> np.ndarray:  # fmt: skip
    """Draws triangles with a depth buffer, (high, WIDTH, 3) uint8.

    Args:
        corners: triangles in the world, (F, 3, 3) [m].
        shades: colours of the triangles, (F, 3) [0..1].
        normals: normals of the triangles, of any length, (F, 3).
        eye: position of the camera, (3,) [m].
        turn: axes of the camera as columns: right, up, backwards, (3, 3).
        fovy: vertical angle of view [deg].
        high: height [pixels].
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    lit = AMBIENT + (1 - AMBIENT) * np.abs(normals @ LIGHT)
    seen = (corners - eye) @ turn
    scale = 0.5 * high / np.tan(np.radians(fovy) / 2)
    depth = -seen[..., 2]
    seen, depth, shown = seen[depth.min(axis=1) > 0.01], depth, (lit[:, None] * shades)[depth.min(axis=1) > 0.01]
    depth = depth[depth.min(axis=1) > 0.01]
    x = 0.5 * WIDTH + scale * seen[..., 0] / depth
    y = 0.5 * high - scale * seen[..., 1] / depth
    picture = np.tile(SKY, (high, WIDTH, 1))
    _raster(x, y, 1 / depth, np.ascontiguousarray(shown), picture, np.zeros((high, WIDTH)))
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


def _view_above(data: Any, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eye, (3,) [m], and axes, (3, 3), of a view from above of all of a skin, from the camera's side."""
    from stmpl_sim.scene import EYE

    right = data.camera(EYE).xmat.reshape(3, 3)[:, 0]
    back = np.cos(ABOVE) * np.cross(right, [0, 0, 1.0]) + np.sin(ABOVE) * np.array([0, 0, 1.0])
    turn = np.stack([right, np.cross(back, right), back], axis=1)
    seen = skin @ turn
    low, high = seen.min(axis=0), seen.max(axis=0)
    half = MARGIN * max((high[0] - low[0]) * STRIP / WIDTH, high[1] - low[1]) / 2
    middle = 0.5 * (low + high)
    return turn @ [middle[0], middle[1], high[2] + half / np.tan(np.radians(FOVY) / 2)], turn


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at the vertices, (V, 3)."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    out = np.stack([np.bincount(faces.ravel(), np.repeat(flat[:, k], 3), len(points)) for k in range(3)], axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)
