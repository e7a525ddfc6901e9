"""Provenance: what a recording carries so that it can be repeated: layer, body, method, configuration, versions."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np

from bags.wire import NO_FRAMES, FixedFrames
from bags.writer import BagWriter
from stmpl_core.errors import BagError
from stmpl_core.layer import SoftLayer
from stmpl_core.packed import pack, unpack
from stmpl_core.provenance import versions

LAYER = "layer.npz"
RECORD = "stmpl"
OTHER_PROCESSOR = 1e-7  # difference of answers between processors [m], whose sums round in other orders


@dataclass(frozen=True)
class Provenance:
    """Origin of a recording: method, body, settings and versions.

    Args:
        method: name of the method that answered.
        body: line on the body and its part.
        config: settings, as JSON can hold them.
        versions: versions of Python, packages and weights that decide the numbers, and the processor.
        frames: poses of the frames that poses and wrenches are in, fixed in the body's.
    """

    method: str = ""
    body: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    frames: FixedFrames = NO_FRAMES

    @property
    def processor(self) -> str:
        """The processor that recorded; empty where the recording does not say."""
        return self.versions.get("processor", "")


def allowance(recorded: str, other: str) -> tuple[float, str]:
    """Allowed difference of answers to the same contacts [m], and why, by the processors that made them; "": unknown.

    Exact answers are asked for on one processor only.
    """
    if recorded and recorded == other:
        return 0.0, "the same processor recorded it"
    return OTHER_PROCESSOR, f"another processor ({recorded or 'not named'}) recorded it"


def write_provenance(
    writer: BagWriter, layer: SoftLayer | None, *, method: str, body: str = "",
    config: Mapping[str, Any] | None = None, frames: FixedFrames = NO_FRAMES,
) -> None:  # fmt: skip
    """Puts into a bag all that is needed to repeat the run, best before its first message.

    A recorder that does not hold the layer gives None; SkinTopology then says it, rounded to float32. Versions and
    processor are those of the process that writes: a recorder belongs on the machine whose answers it records.

    Raises:
        BagError: a disk that refused.
    """
    values = {"method": method, "body": body, "config": json.dumps(config or {}), "versions": json.dumps(versions()),
              "frames": json.dumps({name: pose.tolist() for name, pose in frames.items()})}  # fmt: skip
    writer.add_metadata(RECORD, values)
    if layer is not None:
        writer.attach(LAYER, "application/x-npz", layer_to_bytes(layer))


def provenance_from(values: Mapping[str, str]) -> Provenance:
    """Reads back the metadata record that `write_provenance` wrote. Raises BagError."""
    try:
        config, made_by = json.loads(values.get("config", "{}")), json.loads(values.get("versions", "{}"))
        frames = {name: np.array(pose, dtype=np.float64).reshape(4, 4) for name, pose in
                  json.loads(values.get("frames", "{}")).items()}  # fmt: skip
    except (ValueError, AttributeError) as error:
        raise BagError(f"the bag's '{RECORD}' record is broken: {error}.") from error
    return Provenance(values.get("method", ""), values.get("body", ""), config, made_by, frames)


def layer_to_bytes(layer: SoftLayer) -> bytes:
    """A layer as .npz of the arrays of stmpl_core.packed; exact."""
    stream = BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **pack(layer))
    return stream.getvalue()


def layer_from_bytes(data: bytes) -> SoftLayer:
    """The layer that `layer_to_bytes` wrote, bit for bit. Raises BagError if the bytes are no such file."""
    try:
        with np.load(BytesIO(data), allow_pickle=False) as arrays:
            return unpack(arrays)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise BagError(f"the attached {LAYER} cannot be read: {error}.") from error
