"""Tools: the one place where tools live, each with its distance field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from stmpl_core.errors import InvalidInput, MeshError, StmplError
from stmpl_core.sdf import MARGIN, SignedDistance
from stmpl_core.tool import Tool


class Tools:
    """Tools by name. A distance field is built once for each surface, and dropped with its last tool.

    A tool may be announced while its field is built elsewhere: until then the one of its name from before stays.

    Args:
        margin: width of the distance fields around the surfaces [m].
    """

    def __init__(self, margin: float = MARGIN) -> None:
        self.margin = margin
        self._tools: dict[str, Tool] = {}
        self._announced: dict[str, Tool] = {}
        self._fields: dict[str, SignedDistance] = {}

    def __contains__(self, name: object) -> bool:
        return name in self._tools

    def __getitem__(self, name: str) -> Tool:
        if name not in self._tools:
            raise InvalidInput(f"there is no tool '{name}'. Available: {', '.join(self._tools) or 'none'}.")
        return self._tools[name]

    def __iter__(self) -> Iterator[Tool]:
        return iter(list(self._tools.values()))

    def __len__(self) -> int:
        return len(self._tools)

    def copy(self) -> Tools:
        """Another store with the same tools and fields; what is added or removed later is so in one of them only."""
        other = Tools(self.margin)
        other._tools, other._announced, other._fields = dict(self._tools), dict(self._announced), dict(self._fields)
        return other

    def announce(self, tool: Tool) -> None:
        """Expects `add` of this tool, whose field is built elsewhere."""
        self._announced[tool.name] = tool

    def known(self, tool: Tool) -> bool:
        """Whether the newest surface of its name is the same, in use or announced."""
        newest = self._announced.get(tool.name) or self._tools.get(tool.name)
        return newest is not None and newest.digest == tool.digest

    def expected(self, tool: Tool) -> bool:
        """Whether this very tool was announced last under its name, and not added or removed since."""
        return self._announced.get(tool.name) is tool

    def withdraw(self, tool: Tool) -> None:
        """Does not expect this tool any more; the one of its name from before, if there is one, stays."""
        if self.expected(tool):
            del self._announced[tool.name]

    def add(self, tool: Tool, field: SignedDistance | None = None) -> None:
        """Takes a tool into use, in place of another of its name.

        Args:
            tool: tool to hold.
            field: distance field of its surface, built with this store's margin; None: built when it is first needed.
        """
        self._announced.pop(tool.name, None)
        before = self._tools.get(tool.name)
        self._tools[tool.name] = tool
        if field is not None:
            self._fields[tool.digest] = field
        if before is not None:
            self._forget(before.digest)

    def add_all(self, tools: Sequence[Tool]) -> None:
        """Takes many tools into use, their fields built side by side (see stmpl_core.fields). Raises MeshError."""
        from stmpl_core.fields import fields_of

        for tool, built in zip(tools, fields_of(tools, margin=self.margin), strict=True):
            if isinstance(built, StmplError):
                raise MeshError(f"{tool.name} cannot be a tool: {built}") from built
            self.add(tool, built)

    def remove(self, name: str) -> None:
        """Forgets a tool and what was announced under its name. Raises InvalidInput if there is neither."""
        announced = self._announced.pop(name, None)
        if name in self._tools:
            self._forget(self._tools.pop(name).digest)
        elif announced is None:
            self[name]

    def ready(self, name: str) -> bool:
        """Whether the field of this tool is built."""
        return name in self._tools and self._tools[name].digest in self._fields

    def field(self, tool: Tool) -> SignedDistance:
        """The distance field of a tool; one that is not known yet is added, and its field built (up to a second).

        Raises:
            MeshError: a surface that cannot be a tool (see SignedDistance.of).
        """
        if self._tools.get(tool.name) is not tool:
            self.add(tool)
        if tool.digest not in self._fields:
            self._fields[tool.digest] = SignedDistance.of(tool, margin=self.margin)
        return self._fields[tool.digest]

    def waiting(self) -> list[Tool]:
        """Tools that were announced and not added yet."""
        return list(self._announced.values())

    def _forget(self, digest: str) -> None:
        if all(tool.digest != digest for tool in self._tools.values()):
            self._fields.pop(digest, None)
