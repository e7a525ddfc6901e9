"""Kernels: those on disk that a change of the code has made old are compiled anew.

numba keeps a compiled function beside its module and looks whether that file has changed, but not whether another has,
whose functions and constants are part of it (https://numba.readthedocs.io/en/stable/developer/caching.html). A checkout
that is updated would go on with kernels from before.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

STAMP = "kernels.json"  # beside the compiled functions of the first package


def forget_old(packages: Sequence[Path]) -> bool:
    """Removes the compiled functions of all packages if what kernels are made from has changed in one; whether it did.

    Args:
        packages: folders of packages. Where nothing can be written nothing is done: numba keeps what it compiles
            elsewhere then.
    """
    stamp = packages[0] / "__pycache__" / STAMP
    known = _read(stamp)
    found: dict[str, list] = {}
    for folder in packages:
        for file in _sources(folder):
            about, name = file.stat(), file.path.removeprefix(str(folder.parent))
            when, before = [about.st_mtime_ns, about.st_size], known.get(name, [])
            found[name] = before if before[:2] == when else [*when, made_from(Path(file.path).read_bytes())]
    if found == known:
        return False
    with suppress(OSError):
        stamp.parent.mkdir(exist_ok=True)
    if found == _read(stamp) or not os.access(stamp.parent, os.W_OK):  # another process may have been quicker
        return False
    codes = [{name: one[2] for name, one in files.items() if one[2]} for files in (found, known)]
    changed = codes[0] != codes[1]
    with suppress(OSError):
        if changed:
            for folder in packages:
                for old in folder.rglob("*.nb[ic]"):
                    old.unlink(missing_ok=True)
        new = stamp.with_suffix(f".{os.getpid()}")
        new.write_text(json.dumps(found))
        new.replace(stamp)
    return changed


def _read(stamp: Path) -> dict[str, list]:
    try:
        read = json.loads(stamp.read_text())
        return {name: [int(when), int(size), str(code)] for name, (when, size, code) in read.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def made_from(source: bytes) -> str:
    """Digest of what of a module may go into kernels; empty: nothing.

    Constants and named tuples; where anything is compiled functions and imports, too.
    """
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ""
    compiled = any("jit" in ast.unparse(one) for node in tree.body if isinstance(node, ast.FunctionDef)
                   for one in node.decorator_list)  # fmt: skip
    kinds = (ast.Assign, ast.AnnAssign, *([ast.Import, ast.ImportFrom, ast.FunctionDef] if compiled else []))
    kept: list[ast.AST] = []
    for node in tree.body:
        named = isinstance(node, ast.ClassDef) and "NamedTuple" in map(ast.unparse, node.bases)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
        if named or isinstance(node, kinds):
            kept.append(node)
    return hashlib.sha256("".join(map(ast.dump, kept)).encode()).hexdigest()[:16] if kept else ""


def _sources(folder: str | Path) -> Iterator[os.DirEntry[str]]:
    """The modules in a folder and those below it."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                yield entry
            elif "." not in entry.name and entry.name != "__pycache__" and entry.is_dir():
                yield from _sources(entry.path)
