"""Limbs that ship: Anny's average body at rest, and its parts at 3 mm edges, as small exact files (see README.md)."""

from __future__ import annotations

import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np

from stmpl_core.arrays import Faces, Points

FOLDER = Path(__file__).parent
EDGE_LENGTH = 3e-3  # length of the edges of the parts' meshes [m]
BODY = "body"

Mesh = tuple[Points, Faces, np.ndarray]  # vertices (V, 3) [m], faces (F, 3), uv of each corner (F, 3, 2)


def body() -> tuple[Points, Faces, np.ndarray, np.ndarray, tuple[str, ...]]:
    """The average body at rest: vertices, faces, uv, bone weights (V, B) [-], names of the bones."""
    kept = _read(FOLDER / f"{BODY}.npz")
    bones = tuple(kept["bones"].tolist())
    weights = np.zeros((len(kept["vertices"]), len(bones)))
    weights.ravel()[kept["weighted"]] = kept["weights"]
    return *_mesh(kept), weights, bones


def part(name: str, edge_length: float) -> Mesh | None:
    """The mesh of a part of the average body at rest, if it ships with such edges [m]."""
    return _mesh(_read(FOLDER / f"{name}.npz")) if ships(name, edge_length) else None


def ships(name: str, edge_length: float) -> bool:
    """Whether the mesh of a part with such edges [m] ships."""
    return edge_length == EDGE_LENGTH and name != BODY and (FOLDER / f"{name}.npz").is_file()


def write_body(folder: Path, mesh: Mesh, weights: np.ndarray, bones: tuple[str, ...]) -> Path:
    """Writes what `body` reads."""
    weighted = np.flatnonzero(weights).astype(np.int32)
    more = {"weighted": weighted, "weights": weights.ravel()[weighted], "bones": np.array(bones)}
    return _write(folder / f"{BODY}.npz", _packed(mesh) | more)


def write_part(folder: Path, name: str, mesh: Mesh) -> Path:
    """Writes what `part` reads."""
    return _write(folder / f"{name}.npz", _packed(mesh))


def _packed(mesh: Mesh) -> dict[str, np.ndarray]:
    """UVs once a vertex; corners whose UV is another than their vertex's first one are listed with their own."""
    vertices, faces, uv = mesh
    flat, corner_uv = faces.ravel(), uv.reshape(-1, 2)
    first = np.zeros((len(vertices), 2))
    used, where = np.unique(flat, return_index=True)
    first[used] = corner_uv[where]
    other = np.flatnonzero((corner_uv != first[flat]).any(axis=1)).astype(np.int32)
    return {"vertices": vertices, "faces": faces.astype(np.int32), "uv": first, "other": other,
            "other_uv": corner_uv[other]}


def _mesh(kept: dict[str, np.ndarray]) -> Mesh:
    faces = kept["faces"]
    uv = kept["uv"][faces.ravel()]
    uv[kept["other"]] = kept["other_uv"]
    return kept["vertices"], faces, uv.reshape(-1, 3, 2)


def _write(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """An .npz with float64 in byte planes, (8, ...) uint8, which pack better; the same bytes for the same arrays."""
    with zipfile.ZipFile(path, "w") as file:
        for name, array in arrays.items():
            real = array.dtype == np.float64
            stream = BytesIO()
            np.lib.format.write_array(stream, _planes(array) if real else array)
            packing = zipfile.ZIP_DEFLATED if real else zipfile.ZIP_LZMA  # no smaller for planes, and ten times as slow
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), stream.getvalue(), packing, 9)
    return path


def _read(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return {name: _joined(array) if array.dtype == np.uint8 else array for name, array in arrays.items()}


def _planes(array: np.ndarray) -> np.ndarray:
    split = np.ascontiguousarray(array, "<f8").view(np.uint8).reshape(*array.shape, 8)
    return np.ascontiguousarray(np.moveaxis(split, -1, 0))


def _joined(planes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f8")[..., 0]
