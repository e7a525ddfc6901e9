"""What holds for every test: its mark, the worker that runs it, and a ROS bus that no other process is on."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stmpl_ros.domain import claim

ROOMS = {  # every other file is of the room "unit"
    "ros": ["test_foxglove", "test_launch", "test_node", "test_node_life", "test_node_memory", "test_node_refusals",
            "test_node_tf", "test_node_topics", "test_record_and_publish", "test_ros", "test_ros_demo",
            "test_ros_links", "test_ros_parts", "test_ros_robot", "test_soak", "test_view"],
    "studies": ["test_axisymmetric", "test_evaluate", "test_fem_limits", "test_multis", "test_peers",
                "test_speed_chart", "test_stability", "test_stability_contacts", "test_train_contact", "test_unet",
                "test_validate"],
}  # fmt: skip
FIRST = ["test_conform", "test_ladder", "test_train_contact", "test_indenter_shapes", "test_unet", "test_node_life",
         "test_ros", "test_view", "test_moments", "test_haptics", "test_record_and_publish"]
BUS = pytest.StashKey[socket.socket]()
ROOM_OF = {file: room for room, files in ROOMS.items() for file in files}


def pytest_configure(config: pytest.Config) -> None:
    """Gives this process a bus; and one thread for linear algebra, where a worker has each core."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    domain, config.stash[BUS] = claim()
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")  # children's too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks each test with its file's room, if it names none itself; and puts the longest files first.

    So two workers end together; the first file compiles what nodes need before they are waited for.
    """
    missing = [file for file in (*ROOM_OF, *FIRST) if not Path(__file__).with_name(f"{file}.py").exists()]
    assert not missing, f"conftest.py names files that are not there: {missing}"
    for item in items:
        if not any(item.get_closest_marker(room) for room in ("unit", *ROOMS)):
            item.add_marker(ROOM_OF.get(item.path.stem, "unit"))
    rank = {file: k for k, file in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A robot's side of a node that runs as a process of its own; ROS is loaded by who asks for it."""
    from tests.node_bus import a_node

    yield from a_node(tmp_path_factory.mktemp("node"))


@pytest.fixture(scope="module")
def hand(bus: Any) -> Any:
    """A tool on that bus, heard by the node."""
    return bus.tool("probe").ready()


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """So small a network is not shared among threads, which would wait for one another."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
