"""Records: a walk through an MCAP file from its start, in bounded memory, that steps over damage and reports it."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from stmpl_core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 9, 0x0C, 0x0F
_FRAME = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_START = re.compile(rb"\x06.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd)", re.DOTALL)


@dataclass(frozen=True)
class Damage:
    """A stretch of a file that cannot be believed: `length` bytes from `offset`, and what is wrong with it."""

    offset: int
    length: int
    what: str


@dataclass(frozen=True)
class End:
    """The file was finished by its writer: nothing is missing behind this."""


Record = Schema | Channel | Message | Attachment | Metadata | Damage | End


def bag_file(path: Path | str) -> Path:
    """The .mcap file of a recording, given itself or its folder.

    Raises:
        BagError: no such file, or a folder that does not hold exactly one.
    """
    path = Path(path)
    if path.is_file():
        return path
    found = sorted(path.glob("*.mcap"))
    if len(found) != 1:
        names = ", ".join(f.name for f in found) or "none"
        raise BagError(f"{path} is no recording: expected one .mcap file, found {names}.")
    return found[0]


def walk(path: Path | str) -> Iterator[Record]:
    """Yields what the data section holds, in file order, opening chunks; damage comes as a `Damage`, an `End` last.

    Only chunks and attachments whose CRC is right are opened. After a broken frame the walk goes on at the next
    chunk whose CRC is right.

    Raises:
        BagError: the file cannot be opened or is no MCAP file.
    """
    file = bag_file(path)
    try:
        with open(file, "rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise BagError(f"{file} is no MCAP file: its first {len(MAGIC)} bytes are not MCAP's.")
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from _walk(data)
    except OSError as error:
        raise BagError(f"{file} cannot be read: {error.strerror}.") from error


def summary(path: Path | str) -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Schemas and channels from the index at the end of the file; empty if the file was not finished."""
    try:
        with open(bag_file(path), "rb") as stream:
            found = make_reader(stream).get_summary()
    except (McapError, OSError, ValueError, struct.error):
        found = None
    return ({}, {}) if found is None else (found.schemas, found.channels)


def _walk(data: mmap.mmap) -> Iterator[Record]:
    at = len(MAGIC)
    while at < len(data):
        opcode, length = _FRAME.unpack_from(data, at) if len(data) - at >= _FRAME.size else (0, 0)
        after = at + _FRAME.size + length
        if not _plausible(data, opcode, after):
            resume = _next_chunk(data, at + 1, len(data))
            what = "the file ends inside a record" if resume == len(data) else "the frame of a record is broken"
            yield Damage(at, resume - at, what)
            at = resume
        elif opcode in (DATA_END, FOOTER):
            yield End()
            return
        else:
            records = list(_open(opcode, at, data[at + _FRAME.size : after]))
            yield from records
            broken = len(records) == 1 and isinstance(records[0], Damage)
            at = _next_chunk(data, at + 1, after) if broken else after  # its length may be what is wrong


def _plausible(data: mmap.mmap, opcode: int, after: int) -> bool:
    """The record has a known opcode and ends where another one, or the file, does."""
    known = range(HEADER, DATA_END + 1)
    return opcode in known and (after == len(data) or (after < len(data) and data[after] in known))


def _next_chunk(data: mmap.mmap, start: int, stop: int) -> int:
    """Offset of the first sound chunk that starts in [start, stop), else stop."""
    for match in _CHUNK_START.finditer(data, start):
        if match.start() >= stop:
            break
        _, length = _FRAME.unpack_from(data, match.start())
        after = match.start() + _FRAME.size + length
        if after <= len(data) and _open_chunk(data[match.start() + _FRAME.size : after]) is not None:
            return match.start()
    return stop


def _open(opcode: int, at: int, payload: bytes) -> Iterator[Record]:
    if opcode == CHUNK:
        records = _open_chunk(payload)
        if records is None:
            span = _chunk_span(payload)
            yield Damage(at, _FRAME.size + len(payload), f"a chunk's CRC is wrong{span}")
        else:
            yield from _inside(records)
    elif opcode == ATTACHMENT:
        if zlib.crc32(payload[:-4]) != int.from_bytes(payload[-4:], "little"):
            yield Damage(at, _FRAME.size + len(payload), "an attachment's CRC is wrong")
        else:
            yield Attachment.read(ReadDataStream(BytesIO(payload)))
    elif opcode == METADATA:
        try:
            yield Metadata.read(ReadDataStream(BytesIO(payload)))
        except (McapError, ValueError, struct.error):
            yield Damage(at, _FRAME.size + len(payload), "a metadata record is broken")
    elif opcode in (SCHEMA, CHANNEL, MESSAGE):  # a file without chunks
        yield from _inside(_FRAME.pack(opcode, len(payload)) + payload)


def _open_chunk(payload: bytes) -> bytes | None:
    """The records in a chunk, or None if it is broken."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(length)
    except Exception:  # whatever a decompressor or decoder makes of broken bytes
        return None


def _chunk_span(payload: bytes) -> str:
    if len(payload) < 16:
        return ""
    start, end = struct.unpack_from("<QQ", payload)
    return f" ({(end - start) / 1e9:.2f} s of messages)" if 0 <= end - start < 86400e9 else ""


def _inside(records: bytes) -> Iterator[Record]:
    at = 0
    while at < len(records):
        opcode, length = _FRAME.unpack_from(records, at)
        payload = records[at + _FRAME.size : at + _FRAME.size + length]
        if opcode == MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(payload)
            yield Message(channel_id=channel, sequence=sequence, log_time=log_time, publish_time=publish_time,
                          data=payload[_MESSAGE.size:])  # fmt: skip
        elif opcode == SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(payload)))
        elif opcode == CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(payload)))
        at += _FRAME.size + length
