"""Serves the viewer: a recording, the running node, or a tool to drag."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

from rich.console import Console

from fem_tools import RigidFem
from stmpl_core.errors import InvalidInput
from stmpl_ros.interrupts import endings
from stmpl_ros.tables import compare_with_progress
from stmpl_ros.view.config import ViewConfig
from stmpl_ros.view.page import Page


def run(config: ViewConfig, path: Path | None, live: bool, arguments: list[str] | None = None) -> int:
    """Serves until SIGINT, SIGTERM or SIGHUP.

    Raises:
        InvalidInput: a recording and the live node at once, or a tool that does not exist.
        BagError: the recording cannot be shown.
    """
    if path is not None and live:
        raise InvalidInput(f"either a recording ({path}) or --live is shown, not both. Leave one out.")
    if live:
        return _serve_live(config, arguments)
    return _serve_recording(config, path) if path is not None else _serve_hands_on(config)


def _serve_recording(config: ViewConfig, path: Path) -> int:
    from bags.survey import survey
    from stmpl_ros.view.recording import Recording, RecordingPlayer

    with Console(stderr=True).status(f"reading {path}"):
        run = survey(path, config.namespace)
    compared = compare_with_progress(run, RigidFem(), config.fem) if config.fem else None
    with Console(stderr=True).status(f"reading {path}"):
        recording = Recording.of(run, config.frames, compared=compared)
    page = Page(config.host, config.port, str(path))
    return _until_stopped(page, RecordingPlayer(page, recording))


def _serve_hands_on(config: ViewConfig) -> int:
    from stmpl_core.skin import published
    from stmpl_ros.making import check, layer_of
    from stmpl_ros.view.hands_on import HandsOn
    from stmpl_ros.view.tools import tool_named

    tool_named(config.tool)  # a wrong one is refused before the body is made
    with Console(stderr=True).status("making the body"):
        check(config.node, layer_of)
        layer = published(layer_of(config.node))
    page = Page(config.host, config.port, f"{config.node.limb.replace('_', ' ')}, {config.node.method}")
    return _until_stopped(page, HandsOn(page, layer, config.node.new_method(), config.tool))


def _serve_live(config: ViewConfig, arguments: list[str] | None) -> int:
    from rclpy.experimental.events_executor import EventsExecutor

    from stmpl_ros.spinning import ros, spin
    from stmpl_ros.view.live import LiveNode

    with ros(arguments) as stop:
        page = Page(config.host, config.port, "the running node")
        node, executor = LiveNode(page, config.patience), EventsExecutor()
        executor.add_node(node)
        _say_where(page)
        try:
            spin(executor, stop)
        finally:
            executor.shutdown()
            node.close()
            page.close()
    return 0


def _until_stopped(page: Page, shown) -> int:
    stop = threading.Event()
    for number in endings():
        signal.signal(number, lambda *_: stop.set())
    _say_where(page)
    stop.wait()
    shown.close()
    page.close()
    return 0


def _say_where(page: Page) -> None:
    Console().print(f"open {page.url} in a browser; Ctrl-C ends it", soft_wrap=True)
