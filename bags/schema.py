"""Schema: the text of a ROS message type with all that it depends on, and its type hash."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from stmpl_core.errors import BagError

SEPARATOR = "=" * 80
_OWN_MESSAGES = Path(__file__).resolve().parent.parent / "msg_defs" / "msg"  # folder in a checkout not yet built


@dataclass(frozen=True)
class Schema:
    """Description of a message type, enough to decode its messages.

    Args:
        name: name, `pkg/msg/Type`.
        text: .msg text, then each dependency after a line of 80 `=` and `MSG: pkg/Type` (encoding ros2msg).
        type_hash: RIHS01 hash, as in `share/<pkg>/msg/<Type>.json` (REP-2016).
    """

    name: str
    text: str
    type_hash: str


@cache
def find_schema(type_name: str) -> Schema:
    """The schema of `pkg/msg/Type` (or `pkg/Type`), from the installed .msg files, else from rosbags' Jazzy types.

    The text keeps the files' comments, which say units to who opens the recording elsewhere.

    Raises:
        BagError: a message type that is not installed.
    """
    package, type_ = _split(type_name)
    name = f"{package}/msg/{type_}"
    texts: dict[str, str] = {}
    waiting = [name]
    while waiting:
        wanted = waiting.pop(0)
        if wanted not in texts:
            texts[wanted] = _message_text(*_split(wanted))
            waiting += _mentioned(_types_in(wanted, texts[wanted]))
    text = f"\n{SEPARATOR}\n".join(
        body if one == name else f"MSG: {one.replace('/msg/', '/')}\n{body}" for one, body in texts.items()
    )
    return Schema(name, text, _installed_hash(package, type_) or typestore_of([(name, text)]).hash_rihs01(name))


def typestore_of(schemas: list[tuple[str, str]]) -> Typestore:
    """A store that decodes the given (name, text) schemas; Jazzy's own messages fill what a text leaves out.

    Raises:
        BagError: a schema text cannot be parsed.
    """
    types: Typesdict = {}
    for name, text in schemas:
        types |= _types_in(name, text)
    store = get_typestore(Stores.EMPTY)  # Jazzy's take half a second to load
    if not set(_mentioned(types)) <= {*types, *store.fielddefs}:
        store = get_typestore(Stores.ROS2_JAZZY)
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    return store


def _types_in(name: str, text: str) -> Typesdict:
    """The types that a schema text describes. Raises BagError if it cannot be parsed."""
    try:
        return get_types_from_msg(text, name)
    except Exception as error:
        raise BagError(f"the schema of {name} cannot be read: {error}.") from error


def _mentioned(types: Typesdict) -> Iterator[str]:
    """Names of the message types that the fields of these types are of."""
    for _, fields in types.values():
        for _, (kind, inner) in fields:
            inner = inner[0][1] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else inner
            if isinstance(inner, str):
                yield inner


def _split(type_name: str) -> tuple[str, str]:
    parts = type_name.split("/")
    if len(parts) not in (2, 3) or not all(parts):
        raise BagError(f"'{type_name}' is no message type; expected pkg/msg/Type, for instance std_msgs/msg/Header.")
    return parts[0], parts[-1]


def _message_text(package: str, type_: str) -> str:
    places = [*_share_folders(package), *([_OWN_MESSAGES] if package == "stmpl_msgs" else [])]
    for folder in places:
        if (file := folder / f"{type_}.msg").is_file():
            return file.read_text().rstrip("\n")
    try:
        text, _ = get_typestore(Stores.ROS2_JAZZY).generate_msgdef(f"{package}/msg/{type_}", ros_version=2)
    except Exception as error:
        looked = ", ".join(map(str, places))
        raise BagError(f"message type {package}/msg/{type_} is not installed; looked in {looked}. "
                       f"Install or source the package {package}.") from error
    return text.split(SEPARATOR)[0].rstrip("\n")


def _installed_hash(package: str, type_: str) -> str | None:
    for folder in _share_folders(package):
        if (file := folder / f"{type_}.json").is_file():
            hashes = json.loads(file.read_text())["type_hashes"]
            return next((h["hash_string"] for h in hashes if h["type_name"] == f"{package}/msg/{type_}"), None)
    return None


def _share_folders(package: str) -> list[Path]:
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    return [Path(prefix) / "share" / package / "msg" for prefix in prefixes]
