"""Schema: the text of a ROS message type with all that it depends on, and its type hash."""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from stmpl_core.errors import BagError

SEPARATOR = "=" * 80
_OWN_MESSAGES = Path(__file__).resolve().parent.parent / "msg_defs" / "msg"  # a checkout that is not built yet
_PRIMITIVES = frozenset(
    "bool byte char float32 float64 int8 uint8 int16 uint16 int32 uint32 int64 uint64 string wstring".split()
)
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*")


@dataclass(frozen=True)
class Schema:
    """What a reader needs to decode messages of one type.

    Args:
        name: `pkg/msg/Type`.
        text: its .msg text, then each dependency after a line of 80 `=` and `MSG: pkg/Type` (encoding ros2msg).
        type_hash: RIHS01 hash, as in `share/<pkg>/msg/<Type>.json` (REP-2016).
    """

    name: str
    text: str
    type_hash: str


@cache
def find_schema(type_name: str) -> Schema:
    """The schema of `pkg/msg/Type` (or `pkg/Type`), from the installed .msg files, else from rosbags' Jazzy types.

    Raises:
        BagError: no such message is installed.
    """
    package, type_ = _split(type_name)
    texts = _with_dependencies(package, type_)
    (_, first), *rest = texts.items()
    text = first + "".join(f"\n{SEPARATOR}\nMSG: {'/'.join(key)}\n{body}" for key, body in rest)
    name = f"{package}/msg/{type_}"
    return Schema(name, text, _installed_hash(package, type_) or typestore_of([(name, text)]).hash_rihs01(name))


def typestore_of(schemas: list[tuple[str, str]]) -> Typestore:
    """A store that decodes the given (name, text) schemas, beside Jazzy's own messages.

    Raises:
        BagError: a schema text cannot be parsed.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in schemas:
        try:
            types = get_types_from_msg(text, name)
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        except Exception as error:
            raise BagError(f"the schema of {name} cannot be read: {error}.") from error
    return store


def _split(type_name: str) -> tuple[str, str]:
    parts = type_name.split("/")
    if len(parts) not in (2, 3) or not all(parts):
        raise BagError(f"'{type_name}' is no message type; expected pkg/msg/Type, for instance std_msgs/msg/Header.")
    return parts[0], parts[-1]


def _with_dependencies(package: str, type_: str) -> dict[tuple[str, str], str]:
    texts: dict[tuple[str, str], str] = {}
    waiting = [(package, type_)]
    while waiting:
        name = waiting.pop(0)
        if name not in texts:
            texts[name] = _message_text(*name)
            waiting += _mentioned(texts[name], name[0])
    return texts


def _mentioned(text: str, package: str) -> list[tuple[str, str]]:
    lines = (line.split("#", 1)[0] for line in text.splitlines())
    named = [match[1] for line in lines if (match := _FIELD.match(line)) and match[1] not in _PRIMITIVES]
    return [_split(name) if "/" in name else (package, name) for name in named]


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
