"""Reskin: another skin for a running node, made beside it with the fields of its tools, and then handed over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from functools import partial
from typing import NamedTuple

from rclpy.node import Node

from stmpl_core.contact import ToolMesh
from stmpl_core.errors import StmplError
from stmpl_core.sdf import SignedDistance
from stmpl_ros.background import Background, then
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.skin import AtHand, Skin, SkinMaker

Meshes = Mapping[str, tuple[int, ToolMesh]]  # number and mesh of each tool


class Made(NamedTuple):
    """Another skin, ready to answer.

    Args:
        config: that it was made by.
        skin: itself.
        background: for it.
        fields: number of the mesh, mesh and distance field of each tool that could be built.
    """

    config: NodeConfig
    skin: Skin
    background: Background
    fields: dict[str, tuple[int, ToolMesh, SignedDistance]]


class Reskin:
    """Makes it, while the node goes on answering on the skin that it has.

    Args:
        node: whose executor gets it.
        config: that it is made by.
        maker: of the skin, which this ends.
        meshes: asked for the tools of then, once the skin is there.
        do: is called with it.
        failed: is called with why it could not be made.
    """

    def __init__(
        self, node: Node, config: NodeConfig, maker: SkinMaker | AtHand, meshes: Callable[[], Meshes],
        do: Callable[[Made], None], failed: Callable[[BaseException], None],
    ) -> None:  # fmt: skip
        self._node, self._config, self._meshes, self._do, self._failed = node, config, meshes, do, failed
        self._made: Made | None = None
        self._closed = False
        self._maker = maker
        then(node, self._maker.skin, self._on_skin)

    def close(self) -> None:
        """Gives it up."""
        self._closed = True
        self._maker.close()
        if self._made:
            self._made.background.close()

    def _on_skin(self, future: Future[Skin]) -> None:
        if self._closed:
            return
        try:
            skin = future.result()
        except Exception as error:  # whatever happened in the other process; the node goes on
            self._maker.close()
            self._failed(error)
            return
        self._maker.close()
        self._made = Made(self._config, skin, Background(self._node, skin.layer), {})
        self._waiting = dict(self._meshes())
        for tool, (number, mesh) in list(self._waiting.items()):
            self._made.background.field(tool, number, mesh, partial(self._on_field, tool))
        self._hand_over_if_complete()

    def _on_field(self, tool: str, future: Future[SignedDistance]) -> None:
        assert self._made
        number, mesh = self._waiting.pop(tool)
        try:
            self._made.fields[tool] = number, mesh, future.result()
        except (StmplError, BrokenExecutor) as error:
            self._made.background.renew(error)  # the tool's mesh is asked for once more after the change
        self._hand_over_if_complete()

    def _hand_over_if_complete(self) -> None:
        if self._made and not self._waiting and not self._closed:
            made, self._made = self._made, None
            self._do(made)
