"""Released: contacts of a data set in one small file, which numpy alone reads and `stmpl generate` goes on from."""

from __future__ import annotations

import io
import json
import lzma
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fem_tools.contact_job import Part
from fem_tools.dataset import FIGURES, QUANTUM, Record, Sample
from fem_tools.sampling import ContactId, Plan
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.packed import pack, unpack

FORMAT = 1
STEPS = 1000  # numbers from 0 to the peak with which a motion is written: it is rounded to half of that
WIDE = {"f4": np.float64, "u2": np.int64}  # types in memory of what is written shorter
LEAST = 1 / 400  # motion that is written, over the peak


def write(path: str | Path, plan: Plan, layers: Mapping[str, SoftLayer],
          parts: Iterable[tuple[ContactId, Part]]) -> int:  # fmt: skip
    """Writes contacts under rigid tools, and the limbs that they are on; the number of samples."""
    contacts: dict[str, list[dict[str, Any]]] = defaultdict(list)
    ragged: dict[str, dict[str, list[np.ndarray]]] = defaultdict(lambda: defaultdict(list))
    count = 0
    for contact, part in parts:
        if not part.records:
            continue
        contacts[contact.body].append(part.about | {"records": [r.figures for r in part.records]})
        for record in part.records:
            _add(ragged[contact.body], record)
            count += 1
    arrays: dict[str, np.ndarray] = {}
    for body, columns in ragged.items():
        arrays |= {f"{body}/limb/{name}": _small(values) for name, values in pack(layers[body]).items() if name != "uv"}
        arrays |= {f"{body}/{name}": np.concatenate(values) for name, values in columns.items()}
        for name in ("loaded", "moved"):
            arrays[f"{body}/{name}_count"] = np.array([len(one) for one in columns[name]], np.int32)
    header = {"format": FORMAT, "plan": plan.model_dump(mode="json"), "figures": FIGURES, "contacts": contacts}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_arrays(path, arrays)
    return count


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays to an .npz file, in the order of their names, as small as numpy can read: the same to the bit."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        for name, values in sorted(arrays.items()):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(values))
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getvalue(), zipfile.ZIP_LZMA)


def _small(values: np.ndarray) -> np.ndarray:
    """Places as float32, triangles as uint16; numbers alone and text as they are."""
    if values.ndim < 2:
        return values
    return values.astype(np.uint16 if values.dtype.kind in "iu" else np.float32)


def _add(columns: dict[str, list[np.ndarray]], record: Record) -> None:
    """Adds a record's numbers, rounded."""
    size = np.linalg.norm(record.steps, axis=1)
    unit, keep = float(size.max()) / STEPS, size > LEAST * float(size.max())
    columns["loaded"].append(record.loaded.astype(np.int32))
    columns["values"].append(record.values.astype(np.float16))
    columns["moved"].append(record.moved[keep].astype(np.int32))
    columns["steps"].append(np.round(record.steps[keep] / unit).astype(np.int16))
    columns["unit"].append(np.array([unit * QUANTUM]))


class Released:
    """A released file.

    Args:
        path: its place.

    Attributes:
        plan: plan whose contacts they are, as far as they were solved.
        layers: soft layers by body.

    Raises:
        InvalidInput: no such file, or of another format.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            with np.load(path) as file:
                self._arrays = {name: file[name] for name in file.files}
            header = json.loads(self._arrays.pop("header").tobytes())
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, lzma.LZMAError) as error:
            raise InvalidInput(f"{path} holds no released contacts: {error}.") from error
        if header["format"] != FORMAT:
            raise InvalidInput(f"{path} has format {header['format']}; this version reads {FORMAT}.")
        self.plan, self._contacts = Plan.model_validate(header["plan"]), header["contacts"]
        self.layers: dict[str, SoftLayer] = {}
        for body in self._contacts:
            limb = {name.split("/")[2]: values for name, values in self._arrays.items()
                    if name.startswith(f"{body}/limb/")}  # fmt: skip
            self.layers[body] = unpack({name: values.astype(WIDE.get(values.dtype.str[1:], values.dtype))
                                        for name, values in limb.items()})  # fmt: skip

    def __len__(self) -> int:
        return sum(map(len, self._contacts.values()))

    def parts(self) -> Iterator[tuple[ContactId, Part]]:
        """The contacts, each as `generate` keeps it."""
        for body, contacts in self._contacts.items():
            columns = {name: self._arrays[f"{body}/{name}"] for name in ("loaded", "values", "moved", "steps", "unit")}
            ends = {name: np.cumsum([0, *self._arrays[f"{body}/{name}_count"]]) for name in ("loaded", "moved")}
            k = 0
            for one in contacts:
                about, records = {name: value for name, value in one.items() if name != "records"}, []
                for figures in one["records"]:
                    (a, b), (c, d) = ends["loaded"][k : k + 2], ends["moved"][k : k + 2]
                    steps = np.round(columns["steps"][c:d] * (columns["unit"][k] / QUANTUM)).astype(np.int32)
                    values = columns["values"][a:b].astype(np.float32)
                    records.append(Record("indenter", columns["loaded"][a:b], values, columns["moved"][c:d], steps,
                                          tuple(figures)))  # fmt: skip
                    k += 1
                yield ContactId(body, about["set"], about["number"]), Part(about, records, [], {})

    def samples(self, split: str | None = None) -> Iterator[Sample]:
        """Their samples, of one split or all."""
        for contact, part in self.parts():
            layer = self.layers[contact.body]
            for record in part.records if split in (None, part.about["split"]) else ():
                info = {"body": contact.body, "kind": record.kind, **part.about,
                        **dict(zip(FIGURES, record.figures, strict=True))}  # fmt: skip
                yield Sample.of(layer, info, record.loaded, record.values, record.moved, record.steps)
