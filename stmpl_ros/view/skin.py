"""Skin: the deformed, coloured skin in the page's scene."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
import trimesh
import viser
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from stmpl_core.arrays import Points
from stmpl_core.layer import SoftLayer

SETTLE = 0.04  # time that a browser gets to read a mesh before it is shown [s]
MATTE = PBRMaterial(metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True)


class Skin:
    """Two meshes in turn: the browser reads the hidden one while it shows the other, so that nothing flickers.

    viser colours the vertices of a glTF mesh only, and shows nothing while it reads one.

    Args:
        server: server whose scene holds the skin.
        layer: layer whose skin it is.
    """

    def __init__(self, server: viser.ViserServer, layer: SoftLayer) -> None:
        self._server, self._layer = server, layer
        self._shown: viser.GlbHandle | None = None
        self._hidden: viser.GlbHandle | None = None

    def show(self, vertices: Points, colours: np.ndarray) -> None:
        """Shows the skin with vertices (V, 3) [m] in linear colours (V, 4) uint8; takes SETTLE."""
        data = glb(vertices, self._layer, colours)
        if self._shown is None or self._hidden is None:
            add = partial(self._server.scene.add_glb, glb_data=data, cast_shadow=False, receive_shadow=False)
            self._shown, self._hidden = add("/skin/a"), add("/skin/b", visible=False)
            return
        self._hidden.glb_data = data
        self._server.flush()
        time.sleep(SETTLE)
        with self._server.atomic():
            self._hidden.visible, self._shown.visible = True, False
        self._shown, self._hidden = self._hidden, self._shown

    def remove(self) -> None:
        """Takes the skin out of the scene."""
        for mesh in (self._shown, self._hidden):
            if mesh is not None:
                mesh.remove()
        self._shown = self._hidden = None


def glb(vertices: Points, layer: SoftLayer, colours: np.ndarray) -> bytes:
    """A layer's skin with moved and coloured vertices as binary glTF; the viewer makes new normals of those at rest."""
    visual = TextureVisuals(material=MATTE)
    visual.vertex_attributes["color"] = colours
    mesh = trimesh.Trimesh(vertices, layer.faces, vertex_normals=layer.normals, visual=visual, process=False)
    made = mesh.export(file_type="glb", include_normals=True)  # without any, the viewer would shade it flat
    assert isinstance(made, bytes)
    return made
