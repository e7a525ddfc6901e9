"""Dataset: samples on disk in Zarr, one group a body, read sample by sample without loading the whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import zarr
from zarr.codecs import BloscCodec

from fem_tools.sampling import Kind, SetName, Split
from stmpl_core.arrays import VertexVectors
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load, LoadKind
from stmpl_core.packed import pack, unpack

FORMAT = 1
QUANTUM = 1e-8  # m; displacements are stored as whole numbers of it
MOVES = 1e-7  # m; vertices that move less are not stored (the paper's metric counts from 1e-6 m)
CHUNK = 32_768  # rows of a ragged array that are read at once
KINDS: tuple[Kind, ...] = ("pressure", "nodal", "indenter")
LOADS: dict[Kind, LoadKind] = {"pressure": "pressure", "nodal": "nodal", "indenter": "contact"}
SPLITS: tuple[Split, ...] = ("train", "val", "test", "ood", "held_out")
FIGURES = ("ratio", "force_n", "peak_m", "discretisation_m", "truncation_m", "min_j")
RAGGED = ("loaded", "values", "moved", "steps")  # of a Record

_CODEC = BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle")


class Sample(NamedTuple):
    """One solved load.

    `info` says body, set, number, split, kind, FIGURES and what was drawn of the contact (see fem_tools.sampling).
    """

    layer: SoftLayer
    load: Load
    displacement: VertexVectors  # (V, 3) [m]
    info: dict[str, Any]

    @classmethod
    def of(cls, layer: SoftLayer, info: dict[str, Any], loaded: np.ndarray, values: np.ndarray, moved: np.ndarray,
           steps: np.ndarray) -> Self:  # fmt: skip
        """The sample of what a Record holds."""
        load, displacement = np.zeros(len(layer.vertices)), np.zeros_like(layer.vertices)
        load[loaded] = values * layer.tissue.youngs_modulus
        displacement[moved] = steps * QUANTUM
        return cls(layer, Load(LOADS[info["kind"]], load), displacement, info)


@dataclass(frozen=True, eq=False)
class Record:
    """A sample as it is stored; loads are over Young's modulus, so that they serve every stiffness.

    Args:
        kind: kind of load.
        loaded: numbers of the vertices that carry load, (K,) int32.
        values: p / E [-], or nodal force / E [m2], (K,) float32.
        moved: numbers of the vertices that move, (N,) int32.
        steps: displacement of these in units of QUANTUM, (N, 3) int32.
        figures: numbers in the order of FIGURES.
    """

    kind: Kind
    loaded: np.ndarray
    values: np.ndarray
    moved: np.ndarray
    steps: np.ndarray
    figures: tuple[float, ...]

    @classmethod
    def of(
        cls, layer: SoftLayer, kind: Kind, load: Load, displacement: VertexVectors, figures: Mapping[str, float]
    ) -> Self:
        """Packs an answer of FEM."""
        length = np.linalg.norm(displacement, axis=1)
        loaded, moved = load.loaded.astype(np.int32), np.flatnonzero(length > MOVES).astype(np.int32)
        force = float(np.linalg.norm(load.forces_on(layer), axis=1).sum())
        known = dict(figures) | {"force_n": force, "peak_m": float(length.max())}
        return cls(
            kind,
            loaded,
            (load.values[loaded] / layer.tissue.youngs_modulus).astype(np.float32),
            moved,
            np.round(displacement[moved] / QUANTUM).astype(np.int32),
            tuple(float(known.get(name, np.nan)) for name in FIGURES),
        )


def write_layer(root: zarr.Group, name: str, layer: SoftLayer) -> None:
    """Writes a body's layer, with its UVs if it has a chart, over what is there."""
    group = root.create_group(name, overwrite=True)
    group.attrs["tissue"] = {k: getattr(layer.tissue, k) for k in ("youngs_modulus", "poisson_ratio", "density")}
    for key, values in pack(layer).items():
        group.create_array(f"layer/{key}", data=np.ascontiguousarray(values), compressors=_CODEC)


def read_layer(group: zarr.Group) -> SoftLayer:
    """Reads what `write_layer` wrote."""
    layer: Any = group["layer"]
    part = {key: np.asarray(array[...]) for key, array in layer.arrays()}
    return unpack({"tissue": np.array(list(group.attrs["tissue"].values()))} | part)  # type: ignore[union-attr]


def _rows(group: zarr.Group, name: str) -> Any:
    return group[f"samples/{name}"]


class Writer:
    """Writes the samples of one body, chunk by chunk, and says at the end that they are complete."""

    def __init__(self, group: zarr.Group) -> None:
        self.group = group
        self._contacts: list[dict[str, Any]] = []
        self._table: dict[str, list] = {name: [] for name in ("contact", "kind", "split", *FIGURES)}
        self._ends = {"loaded": [0], "moved": [0]}
        self._waiting: dict[str, list[np.ndarray]] = {}
        for name, dtype, width in (("loaded", "int32", 0), ("values", "float32", 0), ("moved", "int32", 0),
                                   ("steps", "int32", 3)):  # fmt: skip
            tail = (width,) if width else ()
            group.create_array(f"samples/{name}", shape=(0, *tail), chunks=(CHUNK, *tail), dtype=dtype,
                               compressors=_CODEC, overwrite=True)  # fmt: skip
            self._waiting[name] = []

    def add(self, contact: dict[str, Any], records: Sequence[Record]) -> None:
        """Adds all samples of one contact, described by `contact` ("set", "number", "split", ...)."""
        self._contacts.append(contact)
        for record in records:
            row = (len(self._contacts) - 1, KINDS.index(record.kind), SPLITS.index(contact["split"]), *record.figures)
            for name, value in zip(self._table, row, strict=True):
                self._table[name].append(value)
            for name in ("loaded", "moved"):
                self._ends[name].append(self._ends[name][-1] + len(getattr(record, name)))
            for name, waiting in self._waiting.items():
                waiting.append(getattr(record, name))
        self._flush(CHUNK)

    def close(self) -> int:
        """Writes what waits and the tables; returns how many samples there are."""
        self._flush(1)
        for name, values in self._table.items():
            dtype = np.float32 if name in FIGURES else np.int32 if name == "contact" else np.int8
            self.group.create_array(f"samples/{name}", data=np.array(values, dtype), compressors=_CODEC, overwrite=True)
        for name, ends in self._ends.items():
            self.group.create_array(
                f"samples/{name}_ends", data=np.array(ends, np.int64), compressors=_CODEC, overwrite=True
            )
        self.group.attrs["contacts"] = self._contacts
        self.group.attrs["samples"] = len(self._table["contact"])
        return len(self._table["contact"])

    def _flush(self, least: int) -> None:
        """Appends whole chunks of what waits (or all of it), so that no chunk is written twice."""
        for name, waiting in self._waiting.items():
            if (total := sum(map(len, waiting))) < least:
                continue
            rows = np.concatenate(waiting)
            now = total if least == 1 else total - total % CHUNK
            _rows(self.group, name).append(rows[:now])
            self._waiting[name] = [rows[now:]]


class _BodyStore:
    """The tables of one body in memory, its ragged arrays on disk."""

    def __init__(self, group: zarr.Group) -> None:
        self.group = group
        self.contacts: list[dict[str, Any]] = group.attrs["contacts"]  # type: ignore[assignment]
        names = ("contact", "kind", "split", *FIGURES, "loaded_ends", "moved_ends")
        self.table = {name: np.asarray(_rows(group, name)[...]) for name in names}
        self.sets = np.array([self.contacts[c]["set"] for c in self.table["contact"]])
        self.rows = {name: _rows(group, name) for name in RAGGED}

    @cached_property
    def layer(self) -> SoftLayer:
        return read_layer(self.group)

    def info(self, k: int) -> dict[str, Any]:
        table, contact = self.table, self.contacts[self.table["contact"][k]]
        return {"body": self.group.basename, "kind": KINDS[table["kind"][k]], **contact,
                **{name: float(table[name][k]) for name in FIGURES}}  # fmt: skip

    def sample(self, k: int) -> Sample:
        (a, b), (c, d) = (self.table[f"{name}_ends"][k : k + 2] for name in ("loaded", "moved"))
        rows = (self.rows["loaded"][a:b], self.rows["values"][a:b], self.rows["moved"][c:d], self.rows["steps"][c:d])
        return Sample.of(self.layer, self.info(k), *rows)


class Subset:
    """Some samples of a dataset: len, [number], and iteration, body by body."""

    def __init__(self, stores: Sequence[_BodyStore], chosen: Sequence[np.ndarray]) -> None:
        self._stores, self._chosen = stores, chosen
        self._ends = np.cumsum([len(c) for c in chosen])

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, k: int) -> Sample:
        store, row = self._find(k)
        return store.sample(row)

    def __iter__(self) -> Iterator[Sample]:
        return (self[k] for k in range(len(self)))

    def info(self, k: int) -> dict[str, Any]:
        """What is known of a sample, without reading its displacement."""
        store, row = self._find(k)
        return store.info(row)

    def _find(self, k: int) -> tuple[_BodyStore, int]:
        if not -len(self) <= k < len(self):
            raise IndexError(f"sample {k} of {len(self)}")
        k %= len(self)
        body = int(np.searchsorted(self._ends, k, side="right"))
        return self._stores[body], int(self._chosen[body][k - (self._ends[body - 1] if body else 0)])


class Dataset:
    """Samples on disk, made by `stmpl generate`."""

    def __init__(self, path: Path, manifest: dict[str, Any], stores: dict[str, _BodyStore]) -> None:
        self.path, self.manifest, self._stores = path, manifest, stores

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Opens a finished data set.

        Raises:
            InvalidInput: no data set there, one that is not finished, or one of another format.
        """
        path = Path(path)
        if not (path / "manifest.json").is_file():
            raise InvalidInput(f"{path} holds no manifest.json: it is no data set. Make one with stmpl generate.")
        try:
            manifest = json.loads((path / "manifest.json").read_text())
        except ValueError as error:
            raise InvalidInput(f"{path}/manifest.json is broken: {error}.") from error
        if manifest.get("format") != FORMAT:
            raise InvalidInput(f"{path} has format {manifest.get('format')}; this version reads {FORMAT}.")
        if not manifest.get("complete"):
            raise InvalidInput(f"{path} is not finished. Run the same stmpl generate again: it goes on where it was.")
        root = zarr.open_group(str(path / "data.zarr"), mode="r")
        return cls(path, manifest, {name: _BodyStore(group) for name, group in root.groups()})

    @property
    def layers(self) -> dict[str, SoftLayer]:
        """The layer of each body, by its name."""
        return {name: store.layer for name, store in self._stores.items()}

    def __len__(self) -> int:
        return sum(len(store.table["contact"]) for store in self._stores.values())

    def split(
        self,
        split: Split,
        *,
        kind: Kind | None = None,
        sets: Sequence[SetName] | None = None,
        bodies: Sequence[str] | None = None,
    ) -> Subset:
        """The samples of one split, all kinds of load, sets and bodies unless some are named.

        Raises:
            InvalidInput: an unknown split, kind or body; the message lists what exists.
        """
        _known("split", [split], SPLITS)
        _known("kind", [kind] if kind else [], KINDS)
        _known("body", bodies or [], tuple(self._stores))
        stores, chosen = [], []
        for name, store in self._stores.items():
            if bodies is None or name in bodies:
                mask = store.table["split"] == SPLITS.index(split)
                if kind is not None:
                    mask &= store.table["kind"] == KINDS.index(kind)
                if sets is not None:
                    mask &= np.isin(store.sets, sets)
                stores.append(store)
                chosen.append(np.flatnonzero(mask))
        return Subset(stores, chosen)


def data_card(path: str | Path, manifest: dict[str, Any]) -> dict[str, Any]:
    """A data set's preset, seed, size and the SHA-256 of its manifest, for the JSON beside what was learnt from it."""
    digest = hashlib.sha256((Path(path) / "manifest.json").read_bytes()).hexdigest()
    plan = manifest["plan"]
    return {"preset": plan["preset"], "seed": plan["seed"], "samples": manifest["samples"], "manifest_sha256": digest}


def _known(what: str, given: Sequence[str], available: Sequence[str]) -> None:
    for name in given:
        if name not in available:
            raise InvalidInput(f"unknown {what} {name!r}. Available: {', '.join(available)}.")
