"""Recover: brings every sound chunk of a killed, truncated or damaged recording into a new, valid bag."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from bags.records import Damage, End, bag_file, summary, walk
from bags.writer import BagWriter
from stmpl_core.errors import BagError


@dataclass(frozen=True)
class Recovery:
    """Result of a recovery: what came back, and what is lost.

    Args:
        source, target: paths of the damaged file and of the new one.
        messages: number of messages brought back.
        seconds: log time between the first and the last of them [s].
        orphans: number of sound messages given up because their channel's description is lost.
        expected: number of messages that the source's writer counted, or None.
        damage: stretches of the source that were skipped.
        finished: flag of a source that was finished; False: its writer was killed, at most its last chunk is missing.
    """

    source: Path
    target: Path
    messages: int
    seconds: float
    orphans: int
    expected: int | None
    damage: tuple[Damage, ...]
    finished: bool

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self.finished and not self.damage and not self.orphans

    def __str__(self) -> str:
        missing = [str(damage) for damage in self.damage]
        if self.orphans:
            missing.append(f"{self.orphans} messages whose channel is not described any more")
        if not self.finished:
            missing.append("what the writer had not flushed when it was stopped (at most its last chunk)")
        of = "" if self.expected in (None, self.messages) else f" of {self.expected}"
        back = f"{self.messages}{of} messages over {self.seconds:.2f} s are back in {self.target}"
        return f"{back}; nothing is missing." if not missing else f"{back}. Missing: {'; '.join(missing)}."


def recover(source: Path | str, target: Path | str | None = None) -> Recovery:
    """Copies all that is sound in `source` into a new bag; the source is left as it is.

    Args:
        source: path of a folder or .mcap file.
        target: folder or .mcap file to make; by default a folder beside the source's, named `...-recovered`.

    Raises:
        BagError: the source is no MCAP file or holds nothing sound, or the target exists or cannot be written.
    """
    source = bag_file(source)
    target = Path(target) if target else _beside(source.parent.resolve())
    index = summary(source)
    schemas, channels = dict(index.schemas), dict(index.channels)
    damage, orphans, messages, finished, times = [], 0, 0, False, [0, 0]
    copied: dict[int, int] = {}
    with _begun(target, source) as writer:
        for record in walk(source):
            match record:
                case Schema():
                    schemas[record.id] = record
                case Channel():
                    channels[record.id] = record
                    _copy_channel(writer, record, schemas, copied)
                case Message():
                    channel = channels.get(record.channel_id)
                    if channel is None or not _copy_channel(writer, channel, schemas, copied):
                        orphans += 1
                        continue
                    writer.write(copied[record.channel_id], record.data, record.log_time, record.publish_time)
                    times = [min(times[0] or record.log_time, record.log_time), max(times[1], record.log_time)]
                    messages += 1
                case Attachment():
                    writer.attach(record.name, record.media_type, record.data)
                case Metadata() if record.name != "rosbag2":  # the writer makes its own
                    writer.add_metadata(record.name, record.metadata)
                case Damage():
                    damage.append(record)
                case End():
                    finished = True
        if not messages and not (finished and not damage):
            why = damage[0] if damage else "its writer was stopped before it flushed one"
            raise BagError(f"{source} holds no sound message: {why}.")
    seconds = (times[1] - times[0]) / 1e9
    return Recovery(source, writer.path, messages, seconds, orphans, index.messages, tuple(damage), finished)


@contextmanager
def _begun(target: Path, source: Path) -> Iterator[BagWriter]:
    """The writer of a copy; where that fails, what it made is removed."""
    writer = BagWriter(target, source=source)
    try:
        yield writer
        writer.close()
    except BaseException:
        writer.discard()
        raise


def _beside(folder: Path) -> Path:
    """Where the sound part of a recording in a folder goes unless told."""
    return folder.with_name(f"{folder.name}-recovered")


def _copy_channel(writer: BagWriter, channel: Channel, schemas: dict[int, Schema], copied: dict[int, int]) -> bool:
    """Announces the channel in the new bag once; False if its schema is lost."""
    schema = schemas.get(channel.schema_id)
    if channel.id not in copied and (schema is not None or not channel.schema_id):
        copied[channel.id] = writer.copy_channel(channel, schema)
    return channel.id in copied
