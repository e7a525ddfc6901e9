"""The wide part of a limb's linear response, made once for a layer and kept in the user's cache."""

from __future__ import annotations

import hashlib
import json
import os
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stmpl_core.cache import read, trim, write
from stmpl_core.layer import SoftLayer
from stmpl_core.provenance import processor, versions

MOST_KEPT_MB = 300.0  # size of all that is kept of a kind, unless STMPL_CACHE_MB says another
DECIDES = ("numpy", "scipy", "numba", "scikit-fem", "mmgpy", "libigl")  # packages that decide a response's last bit


class CoarseResponse(NamedTuple):
    """The wide part of a limb's response, on a coarse mesh of its skin.

    Args:
        corners: numbers of the coarse vertices around each vertex of the skin, (V, 3).
        shares: barycentric coordinates among them, (V, 3) [-].
        gathered: area that each coarse vertex stands for, (C,) [m2].
        motion: motion of coarse vertices under a pressure E at one, less that of the flat stack, (C, 3, C) float32 [m].
        edge_length: of the coarse mesh [m].
    """

    corners: np.ndarray
    shares: np.ndarray
    gathered: np.ndarray
    motion: np.ndarray
    edge_length: float

    @classmethod
    def of(cls, layer: SoftLayer) -> CoarseResponse:
        """The response of a layer: read from the cache if this machine made it before, else made (seconds) and kept.

        STMPL_CACHE_MB bounds what is kept; 0: nothing is kept or read.

        Raises:
            InvalidInput, MeshError: the skin cannot be meshed coarsely.
        """
        return _kept(cls, "response-", layer, "coarse_response")


class CoarseDrag(NamedTuple):
    """The wide part of a limb's response where its skin is dragged along, on the mesh of its CoarseResponse.

    A limb's skin is a tube: it turns about the bone and goes along it as one, more easily than flat skin.

    Args:
        corners, shares, gathered: see CoarseResponse.
        tangents: two ways along the skin at coarse vertices, (2, C, 3).
        by_source: motion of coarse vertices under a traction E along each way at one, less that of the flat stack,
            (2, C, 3 C) float32 [m].
        give: motion of a contact under a force E on it, less that of the flat stack, symmetric, (C, 3, 3) [1/m].
    """

    corners: np.ndarray
    shares: np.ndarray
    gathered: np.ndarray
    tangents: np.ndarray
    by_source: np.ndarray
    give: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer) -> CoarseDrag:
        """The response of a layer, made or read as CoarseResponse. Raises what that raises."""
        return _kept(cls, "drag-", layer, "coarse_drag")


def _kept(cls: Any, kind: str, layer: SoftLayer, maker: str) -> Any:
    """What of a class is kept of a layer, or made by a function of fem_tools.limb and kept."""
    most = 1e6 * _most_kept_mb()
    name = kind + digest(layer) if most > 0 else ""
    known = read(name) if name else None
    if known is not None and known.keys() == set(cls._fields):
        return cls(**{key: one if one.ndim else float(one) for key, one in known.items()})
    made = getattr(import_module("fem_tools.limb"), maker)(layer)
    if sum(np.asarray(one).nbytes for one in made) < most:
        write(name, made._asdict())
        trim(kind, most)
    return made


def digest(layer: SoftLayer) -> str:
    """Name of all that decides a layer's response: its numbers, to the last bit, code, packages and processor."""
    tissue = layer.tissue
    numbers = np.array([tissue.youngs_modulus, tissue.poisson_ratio, *tissue.stacked])
    found = hashlib.sha256(json.dumps([_code(), versions(DECIDES), processor()]).encode())
    arrays = {"vertices": layer.vertices, "faces": layer.faces, "tissue": numbers} | layer.below
    for name, values in arrays.items():
        found.update(f"{name} {values.dtype} {values.shape}".encode() + np.ascontiguousarray(values).tobytes())
    return found.hexdigest()[:32]


@cache
def _code() -> str:
    """Name of the code that makes a response; nobody has to remember to count its versions."""
    found = hashlib.sha256()
    for package in ("stmpl_core", "fem_tools"):
        spec = find_spec(package)
        places = spec.submodule_search_locations if spec else None
        for path in sorted(path for place in places or () for path in Path(place).rglob("*.py")):
            found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()


def _most_kept_mb() -> float:
    try:
        return float(os.environ.get("STMPL_CACHE_MB") or MOST_KEPT_MB)
    except ValueError:
        return MOST_KEPT_MB
