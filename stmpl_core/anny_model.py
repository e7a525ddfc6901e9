"""Anny (NAVER, Apache-2.0): other bodies and poses than the one that ships; needs the extra bodies."""

from __future__ import annotations

import fcntl
import gzip
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from stmpl_core.arrays import Faces, Points
from stmpl_core.cache import folder, read, write
from stmpl_core.extras import needed

ANNY_TO_BODY = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # rotation; Anny looks along -y with its left towards +x
CACHE_VERSION = 1

Skin = tuple[Points, Faces, np.ndarray, np.ndarray, tuple[str, ...]]  # vertices, faces, uv, bone weights, bones


def posed(turns: Mapping[str, np.ndarray], phenotype: Mapping[str, float]) -> Skin:
    """The skin of a body, from the disk if it was built before: importing torch and Anny alone takes ten seconds.

    Args:
        turns: rotation vector of each bone that turns, (3,) [rad], in the body's axes.
        phenotype: shares by name, in [0, 1] [-].

    Raises:
        InvalidInput: Anny is not installed.
    """
    needed("a body other than the average at rest", "bodies", "anny", "roma", "torch")
    arguments = {"pose": {bone: turn.tolist() for bone, turn in turns.items()}, "phenotype": dict(phenotype)}
    text = json.dumps([CACHE_VERSION, version("anny"), arguments], sort_keys=True)
    name = f"anny-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    kept = read(name)
    if kept is not None:
        return kept["vertices"], kept["faces"], kept["uv"], kept["weights"], tuple(kept["bones"].tolist())
    with _one_builder(folder()):
        vertices, faces, uv, weights, bones = build(turns, phenotype)
    write(name, {"vertices": vertices, "faces": faces, "uv": uv, "weights": weights, "bones": np.array(bones)},
          packed=True)  # fmt: skip
    return vertices, faces, uv, weights, bones


def build(turns: Mapping[str, np.ndarray], phenotype: Mapping[str, float]) -> Skin:
    """The skin of a body, made by Anny; arguments as for `posed`."""
    import roma
    import torch

    model = _model()
    transforms = {}
    for bone, turn in turns.items():
        matrix = torch.eye(4, dtype=torch.float64)[None].repeat(1, 1, 1)
        matrix[0, :3, :3] = roma.rotvec_to_rotmat(torch.tensor(ANNY_TO_BODY.T @ turn))
        transforms[bone] = matrix
    with torch.no_grad():
        made = model(pose_parameters=transforms or None, phenotype_kwargs=dict(phenotype) or None)
    weights = np.zeros((len(model.template_vertices), len(model.bone_labels)))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    uv = model.texture_coordinates.numpy()[model.face_texture_coordinate_indices.numpy()]
    vertices = made["vertices"][0].numpy() @ ANNY_TO_BODY.T
    return vertices, model.faces.numpy(), uv, weights, tuple(model.bone_labels)


@cache
def _model() -> Any:
    import anny

    with _fast_targets():
        return anny.Anny(phenotype_blendshapes="original", skinning_method="lbs")


@contextmanager
def _fast_targets() -> Iterator[None]:
    """While Anny builds its model, reads its gzipped shape files with one NumPy call each.

    Anny 0.6 makes one tensor a line, 7 million of them: 150 s on two cores, against 10 s.
    """
    import torch
    from anny.models import full_model

    def load(filename: str, vertices_count: int, world_transformation: Any, dtype: Any) -> Any:
        shape = torch.zeros((vertices_count, 3), dtype=dtype)
        with gzip.open(filename, "rt") as file:
            table = np.array(file.read().split(), dtype=np.float64).reshape(-1, 4)
        shape[table[:, 0].astype(np.int64)] = torch.as_tensor(table[:, 1:], dtype=dtype)
        return world_transformation.apply(shape)

    original = full_model.load_blend_shape
    full_model.load_blend_shape = load
    try:
        yield
    finally:
        full_model.load_blend_shape = original


@contextmanager
def _one_builder(folder: Path) -> Iterator[None]:
    """Lets one process at a time build: Anny's first build writes files that a second one must not read half."""
    with ExitStack() as stack:
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context(open(folder / "build.lock", "w")), fcntl.LOCK_EX)
        yield
