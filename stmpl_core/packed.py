"""Packed: a layer as plain arrays, exact, for files and for other processes; and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from stmpl_core.chart import UvChart
from stmpl_core.layer import SoftLayer
from stmpl_core.tissue import Membrane, Ply, Tissue


def pack(layer: SoftLayer) -> dict[str, np.ndarray]:
    """Arrays of a layer by name: vertices, faces, thickness or core, tissue, and if it has one the chart's uv.

    The tissue of one material is its modulus, ratio and density, (3,); what else it has is JSON, as bytes in `stack`.
    """
    tissue = layer.tissue
    arrays = {"vertices": layer.vertices, "faces": layer.faces} | layer.below
    arrays["tissue"] = np.array([tissue.youngs_modulus, tissue.poisson_ratio, tissue.density])
    if isinstance(layer.chart, UvChart):
        arrays["uv"] = layer.chart.uv
    if not tissue.single or tissue.source:
        arrays["stack"] = np.frombuffer(stack_to_text(tissue).encode(), np.uint8)
    return arrays


def stack_to_text(tissue: Tissue) -> str:
    """A tissue as JSON."""
    return json.dumps(asdict(tissue))


def stack_from_text(text: str) -> Tissue:
    """The tissue of such JSON.

    Raises:
        KeyError, TypeError, ValueError: text of another kind.
        InvalidInput: numbers that are no tissue's.
    """
    given = json.loads(text)
    skin, deeper = given.pop("skin"), given.pop("deeper")
    return Tissue(**given, skin=Membrane(**skin) if skin else None, deeper=tuple(Ply(**one) for one in deeper))


def unpack(arrays: Mapping[str, np.ndarray]) -> SoftLayer:
    """The layer of such arrays.

    Raises:
        KeyError, TypeError, ValueError: arrays that are missing or of another kind.
        InvalidInput, MeshError: arrays that are no layer.
    """
    if "stack" in arrays:
        tissue = stack_from_text(np.asarray(arrays["stack"], np.uint8).tobytes().decode())
    else:
        modulus, ratio, density = (float(x) for x in arrays["tissue"])
        tissue = Tissue(modulus, ratio, density)
    depth = {name: arrays[name] for name in ("thickness", "core") if name in arrays}
    chart = UvChart(arrays["vertices"], arrays["faces"], arrays["uv"]) if "uv" in arrays else None
    return SoftLayer(arrays["vertices"], arrays["faces"], **depth, tissue=tissue, chart=chart)
