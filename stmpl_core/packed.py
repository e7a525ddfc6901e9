"""Packed: a layer as plain arrays, exact, for files and for other processes; and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from stmpl_core.chart import UvChart
from stmpl_core.layer import SoftLayer
from stmpl_core.rig import Rig
from stmpl_core.tissue import Membrane, Ply, Prony, Tissue


def pack(layer: SoftLayer) -> dict[str, np.ndarray]:
    """Arrays of a layer by name: vertices, faces, thickness or core, tissue; if it has them ply_scale, bony, uv, rig.

    The tissue of one material is its modulus, ratio and density, (3,); what else it has is JSON, as bytes in `stack`.
    """
    tissue = layer.tissue
    arrays = {"vertices": layer.vertices, "faces": layer.faces} | layer.below
    arrays["tissue"] = np.array([tissue.youngs_modulus, tissue.poisson_ratio, tissue.density])
    if isinstance(layer.chart, UvChart):
        arrays["uv"] = layer.chart.uv
    if tissue.skin or tissue.deeper or tissue.source or tissue.relaxation:
        arrays["stack"] = np.frombuffer(stack_to_text(tissue).encode(), np.uint8)
    if layer.bony is not None:
        arrays["bony"] = layer.bony
    if layer.rig is not None:
        arrays["rig"] = np.frombuffer(layer.rig.to_text().encode(), np.uint8)
        arrays["rig_weights"] = layer.rig.weights.astype(np.float32)
    return arrays


def stack_to_text(tissue: Tissue, ply_scale: np.ndarray | None = None, bony: np.ndarray | None = None) -> str:
    """A tissue as JSON, with a layer's ply_scale and bony if these are given: factors as float32, numbers of vertices.

    A series that is not there is not written: elastic tissues read as they always did.
    """
    given = _plain(asdict(tissue))
    if ply_scale is not None:
        given["ply_scale"] = [float(f"{x:.9g}") for x in ply_scale.astype(np.float32)]
    if bony is not None:
        given["bony"] = np.flatnonzero(bony).tolist()
    return json.dumps(given)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a tissue, or of one of its materials, without the series of those that are elastic."""
    out = {name: value for name, value in values.items() if name != "relaxation" or value is not None}
    for name in ("skin", "deeper"):
        if out.get(name):
            out[name] = _plain(out[name]) if name == "skin" else [_plain(one) for one in out[name]]
    return out


def stack_from_text(text: str) -> tuple[Tissue, np.ndarray | None, np.ndarray | None]:
    """Tissue, ply_scale, (V,) or None, and numbers of the bony vertices, or None, of such JSON.

    Raises:
        KeyError, TypeError, ValueError: text of another kind.
        InvalidInput: numbers that are no tissue's.
    """
    given = json.loads(text)
    scale, bony = given.pop("ply_scale", None), given.pop("bony", None)
    skin, deeper = given.pop("skin"), given.pop("deeper")
    membrane = Membrane(**_with_series(skin)) if skin else None
    tissue = Tissue(**_with_series(given), skin=membrane, deeper=tuple(Ply(**_with_series(one)) for one in deeper))
    return tissue, None if scale is None else np.array(scale, np.float32).astype(float), \
        None if bony is None else np.array(bony, int)  # fmt: skip


def _with_series(values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a material, its series made of those that it was written as."""
    series = values.get("relaxation")
    return values | {"relaxation": Prony(**series)} if series else values


def unpack(arrays: Mapping[str, np.ndarray]) -> SoftLayer:
    """The layer of such arrays.

    Raises:
        KeyError, TypeError, ValueError: arrays that are missing or of another kind.
        InvalidInput, MeshError: arrays that are no layer.
    """
    if "stack" in arrays:
        tissue, *_ = stack_from_text(np.asarray(arrays["stack"], np.uint8).tobytes().decode())
    else:
        modulus, ratio, density = (float(x) for x in arrays["tissue"])
        tissue = Tissue(modulus, ratio, density)
    depth = {name: arrays[name] for name in ("thickness", "core", "ply_scale", "bony") if name in arrays}
    chart, rig = UvChart(arrays["vertices"], arrays["faces"], arrays["uv"]) if "uv" in arrays else None, None
    if "rig" in arrays:
        text = np.asarray(arrays["rig"], np.uint8).tobytes().decode()
        rig = Rig.from_text(text, np.asarray(arrays["rig_weights"], float))
    return SoftLayer(arrays["vertices"], arrays["faces"], **depth, tissue=tissue, chart=chart, rig=rig)
