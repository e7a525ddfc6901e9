"""Records: a walk through an MCAP file from its start, in bounded memory, that steps over damage and reports it."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from stmpl_core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
ATTACHMENT, METADATA, DATA_END = 9, 0x0C, 0x0F
LARGEST = 1 << 32  # size of an opened chunk [bytes]; one that claims more is broken
_FRAME = struct.Struct("<BQ")  # opcode, length
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, start of its offsets, CRC
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first and last log time, size when opened, CRC, length of compression's name
_DATA_END_SIZE = _FRAME.size + 4
_CHUNK_START = re.compile(rb"\x06.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd)", re.DOTALL)
_DECODING = (McapError, ValueError, struct.error, IndexError, OverflowError, MemoryError)


@dataclass(frozen=True)
class Damage:
    """A stretch of a file that cannot be believed: `length` bytes from `offset`, and what is wrong with it."""

    offset: int
    length: int
    what: str

    def __str__(self) -> str:
        return f"{self.what} at byte {self.offset} ({self.length} bytes)"


@dataclass(frozen=True)
class End:
    """The file was finished by its writer: nothing is missing behind this."""


Record = Schema | Channel | Message | Attachment | Metadata | Damage | End


class Place(NamedTuple):
    """Where a record stands: the offset of its chunk in the file (or its own, outside chunks), and its number in it."""

    offset: int
    number: int


@dataclass(frozen=True)
class Summary:
    """The index that a finished file ends with; empty where its CRC is wrong, and without places where it has none.

    Args:
        schemas, channels: descriptions by their numbers.
        messages: number of messages that the writer counted, or None.
        data_end: offset of the record that ends the data section [bytes], or None.
        places: (offset, opcode, end) of every chunk, attachment and metadata record, in the order of the file.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: int | None = None
    data_end: int | None = None
    places: tuple[tuple[int, int, int], ...] = ()

    def place(self, at: int) -> tuple[int, int, int] | None:
        """The first indexed record that starts at `at` or behind it."""
        found = bisect_left(self.places, (at, 0, 0))
        return self.places[found] if found < len(self.places) else None


def bag_file(path: Path | str) -> Path:
    """The .mcap file of a recording, given itself or its folder.

    Raises:
        BagError: a file that is missing, or a folder that does not hold exactly one.
    """
    path = Path(path)
    if path.is_file():
        return path
    if not path.exists():
        raise BagError(f"{path} does not exist. stmpl record or stmpl demo makes a recording.")
    found = sorted(file for file in path.iterdir() if file.suffix == ".mcap") if path.is_dir() else []
    if len(found) != 1:
        names = ", ".join(f.name for f in found) or "none"
        split = " Of a recording that was split, give them one by one, or join them (mcap merge)." if found else ""
        raise BagError(f"{path} is no recording: expected one .mcap file, found {names}.{split}")
    return found[0]


def walk(path: Path | str) -> Iterator[Record]:
    """Yields what the data section holds, in file order, opening chunks; damage comes as a `Damage`, an `End` last.

    Only chunks and attachments whose CRC is right are opened. Behind a broken record the walk goes on where the
    index of the file says, or without one at the next chunk whose CRC is right.

    Raises:
        BagError: the file cannot be opened or is no MCAP file.
    """
    for _, record in walk_places(path):
        yield record


def walk_places(path: Path | str) -> Iterator[tuple[Place, Record]]:
    """What `walk` yields, each with its place, by which `read_places` finds a message again. Raises BagError."""
    with _mapped(path) as data:
        for offset, records in _walk(data, _summary(data)):
            for number, record in enumerate(records):
                yield Place(offset, number), record


def read_places(path: Path | str, places: Iterable[Place]) -> Iterator[Message]:
    """Yields the messages at `places`; where several in a row stand in one chunk, it is opened once.

    Raises:
        BagError: the file cannot be opened, or has changed since it was walked.
    """
    with _mapped(path) as data:
        opened, records = -1, []
        for offset, number in places:
            if offset != opened:
                opened, records = offset, _opened(data, offset)
            if number >= len(records) or not isinstance(message := records[number], Message):
                raise BagError(f"{path} has changed since it was looked over: no message {number} at byte {offset}. "
                               "Is it still being recorded?")  # fmt: skip
            yield message


def summary(path: Path | str) -> Summary:
    """The index at the end of the file. Raises BagError if the file cannot be opened or is no MCAP file."""
    with _mapped(path) as data:
        return _summary(data)


@contextmanager
def _mapped(path: Path | str) -> Iterator[mmap.mmap]:
    file = bag_file(path)
    try:
        with open(file, "rb") as stream:
            if not (first := stream.read(len(MAGIC))):
                raise BagError(f"{file} is empty.")
            if first != MAGIC:
                raise BagError(f"{file} is no MCAP file: its first {len(MAGIC)} bytes are not MCAP's.")
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield data
    except OSError as error:
        raise BagError(f"{file} cannot be read: {error.strerror}.") from error


def _summary(data: mmap.mmap) -> Summary:
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return Summary()
    opcode, length, start, _, crc = _FOOTER.unpack_from(data, at)
    if (opcode, length) != (FOOTER, _FOOTER.size - _FRAME.size) or not len(MAGIC) + _DATA_END_SIZE <= start <= at:
        return Summary()
    section = data[start : at + _FOOTER.size - 4]
    if crc and zlib.crc32(section) != crc:
        return Summary()
    try:
        records = list(StreamReader(BytesIO(data[start:]), skip_magic=True).records)
    except _DECODING:
        return Summary()
    return Summary(
        schemas={record.id: record for record in records if isinstance(record, Schema)},
        channels={record.id: record for record in records if isinstance(record, Channel)},
        messages=next((record.message_count for record in records if isinstance(record, Statistics)), None),
        data_end=start - _DATA_END_SIZE if crc else None,
        places=tuple(sorted(place for record in records if crc and (place := _place(record)))),
    )


def _place(record: McapRecord) -> tuple[int, int, int] | None:
    match record:
        case ChunkIndex():
            return record.chunk_start_offset, CHUNK, record.chunk_start_offset + record.chunk_length
        case AttachmentIndex():
            return record.offset, ATTACHMENT, record.offset + record.length
        case MetadataIndex():
            return record.offset, METADATA, record.offset + record.length
    return None


def _walk(data: mmap.mmap, index: Summary) -> Iterator[tuple[int, list[Record]]]:
    """Yields the offset of each chunk, or of each record outside chunks, and what is in it."""
    at, stop = len(MAGIC), index.data_end or len(data)
    bare = sound = True  # bare: schemas, channels and messages may stand outside chunks
    while at < stop:
        opcode, after = _frame(data, at)
        place = index.place(at)
        if place and place[0] == at:
            opcode, after = place[1:]
        elif place and after > place[0]:
            after = len(data) + 1  # it would reach over a record that is known to be there
        elif not index.data_end and (opcode, after - at - _FRAME.size) in ((DATA_END, 4), (FOOTER, 20)):
            break
        records = _read(data, at, opcode, after, bare) if after <= stop else None
        if records is None and (chunk := _chunk_at(data, at)):  # told by its contents, whatever its frame says
            indexed = place is not None and place[0] == at
            records, after = chunk[0], after if indexed or not _fits(data, chunk[1], stop) else chunk[1]
            opcode = CHUNK
        if records is None:
            sound = False
            resume, what = _resume(data, at, opcode, after, index, stop)
            yield at, [Damage(at, resume - at, what)]
            at = resume
        else:
            bare = bare and opcode != CHUNK
            yield at, records
            at = after
    if index.data_end or at < stop:
        broken = _wrong_crc(data, at) if sound else None
        yield at, [*filter(None, (broken, _behind(data, at))), End()]


def _behind(data: mmap.mmap, at: int) -> Damage | None:
    """What stands behind the end of the recording whose data section ends at `at`; None: nothing."""
    end = data.find(MAGIC, at) + len(MAGIC)
    if not len(MAGIC) <= end < len(data):
        return None
    another = "another recording" if data[end : end + len(MAGIC)] == MAGIC else "what is of no recording"
    return Damage(end, len(data) - end, f"{another} stands behind the end, and is not read,")


def _opened(data: mmap.mmap, at: int) -> list[Record]:
    """The records at an offset that `_walk` gave, of a chunk or of one record outside chunks; none if it is broken."""
    if chunk := _chunk_at(data, at):
        return chunk[0]
    opcode, after = _frame(data, at)
    return _read(data, at, opcode, after, bare=True) or []


def _frame(data: mmap.mmap, at: int) -> tuple[int, int]:
    """Opcode of the record at `at`, and where it ends; past the file's end if there is no room for one."""
    if len(data) - at < _FRAME.size:
        return 0, len(data) + 1
    opcode, length = _FRAME.unpack_from(data, at)
    return opcode, at + _FRAME.size + length


def _fits(data: mmap.mmap, at: int, stop: int) -> bool:
    """Another record, or the end, is at `at`."""
    if at >= stop:
        return at == stop
    opcode, after = _frame(data, at)
    return HEADER <= opcode <= DATA_END and after <= len(data)


def _read(data: mmap.mmap, at: int, opcode: int, after: int, bare: bool) -> list[Record] | None:
    """What the record at `at` holds; None if it is broken, or of a kind that has no business there."""
    payload = data[at + _FRAME.size : after]
    try:
        if opcode == CHUNK:
            chunk = _chunk_at(data, at)
            return chunk[0] if chunk and chunk[1] == after else None
        if opcode == ATTACHMENT:
            noted = int.from_bytes(payload[-4:], "little")
            return [_whole(Attachment.read, payload)] if noted in (0, zlib.crc32(payload[:-4])) else None
        if opcode == METADATA:
            return [_whole(Metadata.read, payload)]
        if opcode == HEADER and at == len(MAGIC):
            _whole(Header.read, payload)
            return []
        if opcode == MESSAGE_INDEX:
            size = int.from_bytes(payload[2:6], "little")
            return [] if size == len(payload) - 6 and size % 16 == 0 else None
        if opcode in (SCHEMA, CHANNEL, MESSAGE) and bare:
            return _inside(_FRAME.pack(opcode, len(payload)) + payload)
    except _DECODING:
        pass
    return None


def _resume(data: mmap.mmap, at: int, opcode: int, after: int, index: Summary, stop: int) -> tuple[int, str]:
    """Where to go on behind the broken record at `at`, and what is wrong with it."""
    fits = _fits(data, after, stop)
    known = not index.data_end or (at, opcode, after) in index.places
    if fits and known and opcode == CHUNK:
        what = f"a chunk's CRC is wrong{_chunk_span(data, at)}"
    elif fits and known and opcode == ATTACHMENT:
        what = "an attachment's CRC is wrong"
    elif fits and known and opcode == METADATA:
        what = "a metadata record is broken"
    else:
        what = "the frame of a record is broken"
    if index.data_end:
        place = index.place(at + 1)
        return (after if fits else place[0] if place else stop), what
    resume = _next_chunk(data, at + 1, after if fits else len(data))
    return resume, "the file ends inside a record" if resume == len(data) else what


def _next_chunk(data: mmap.mmap, start: int, stop: int) -> int:
    """Offset of the first sound chunk that starts in [start, stop), else stop."""
    for match in _CHUNK_START.finditer(data, start):
        if match.start() >= stop:
            break
        if _chunk_at(data, match.start()):
            return match.start()
    return stop


def _chunk_at(data: mmap.mmap, at: int) -> tuple[list[Record], int] | None:
    """The records in the chunk whose frame is at `at`, and where it ends by its own contents; None if it is broken."""
    head = at + _FRAME.size
    if len(data) - head < _CHUNK.size:
        return None
    *_, opened, crc, named = _CHUNK.unpack_from(data, head)
    sized = head + _CHUNK.size + named
    after = sized + 8 + int.from_bytes(data[sized : sized + 8], "little") if named <= 4 else len(data) + 1
    if after > len(data) or opened > LARGEST or (not crc and data[at] != CHUNK):
        return None
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(data[head:after])))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return _inside(stream.read(length)), after
    except Exception:  # whatever a decompressor makes of broken bytes
        return None


def _chunk_span(data: mmap.mmap, at: int) -> str:
    start, end = struct.unpack_from("<QQ", data, at + _FRAME.size)
    return f" ({(end - start) / 1e9:.2f} s of messages)" if 0 <= end - start < 86400e9 else ""


def _inside(records: bytes) -> list[Record]:
    """The schemas, channels and messages in a chunk's bytes. Raises one of _DECODING."""
    at, found = 0, []
    while at < len(records):
        opcode, length = _FRAME.unpack_from(records, at)
        payload = records[at + _FRAME.size : at + _FRAME.size + length]
        at += _FRAME.size + length
        if at > len(records):
            raise ValueError("a record reaches over the end of its chunk")
        if opcode == MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(payload)
            found.append(Message(channel_id=channel, sequence=sequence, log_time=log_time, publish_time=publish_time,
                                 data=payload[_MESSAGE.size:]))  # fmt: skip
        elif opcode == SCHEMA:
            found.append(_whole(Schema.read, payload))
        elif opcode == CHANNEL:
            found.append(_whole(Channel.read, payload))
    return found


def _whole[T](read: Callable[[ReadDataStream], T], payload: bytes) -> T:
    """One record that fills its payload. Raises one of _DECODING."""
    stream = ReadDataStream(BytesIO(payload))
    record = read(stream)
    if stream.count != len(payload):
        raise ValueError(f"a record of {stream.count} bytes in a frame of {len(payload)}")
    return record


def _wrong_crc(data: mmap.mmap, at: int) -> Damage | None:
    """Damage if the data section, which the record at `at` ends, has another CRC than its writer noted."""
    if data[at : at + _FRAME.size] != _FRAME.pack(DATA_END, 4):
        return None
    noted, crc = int.from_bytes(data[at + _FRAME.size : at + _FRAME.size + 4], "little"), 0
    for start in range(0, at, 1 << 20):
        crc = zlib.crc32(data[start : min(start + (1 << 20), at)], crc)
    if noted in (0, crc):
        return None
    return Damage(len(MAGIC), at - len(MAGIC), "all messages are sound, but something else, metadata perhaps, is not,")
