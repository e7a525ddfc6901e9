"""Skin: a layer with its prepared method, made from the settings, here or in another process."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context

import numpy as np

from bags.messages import layer_id
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.methods.base import Method
from stmpl_core.moments import Surroundings
from stmpl_core.simulator import Simulator
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.workshop import stand_beside

Build = Callable[[NodeConfig], SoftLayer]
STIFFNESS = {"youngs_modulus", "density"}  # settings that change neither geometry nor what is felt around a vertex
QUICK = {"moment_net", "winkler", "naive"}  # methods that such a change costs no preparation


def layer_of(config: NodeConfig) -> SoftLayer:
    """The soft layer that the settings ask for. Raises InvalidInput."""
    from stmpl_core.body import Body  # takes seconds to import, and who brings a layer does not need it

    tissue = Tissue(config.youngs_modulus, config.poisson_ratio, config.density)
    body = Body.anny(pose=None, **config.phenotype_values)
    return body.part(config.part, edge_length=config.edge_length, thickness=config.thickness, tissue=tissue)


def check(config: NodeConfig, build: Build) -> None:
    """Raises InvalidInput, at once, for a part that `layer_of` does not know; other builds are not asked."""
    if build is layer_of:
        from stmpl_core.body import Body

        Body.anny().level(config.part)


def published(layer: SoftLayer) -> SoftLayer:
    """The layer rounded to float32, as messages carry it: whoever reads them has the very same layer."""
    return layer.with_(vertices=layer.vertices.astype(np.float32), thickness=layer.thickness.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Skin:
    """What answers: it can be pickled, so that a process beside the node's may make it.

    Args:
        layer: as published.
        method: prepared for it.
        near: what is around each vertex, which method and contact share.
    """

    layer: SoftLayer
    method: Method
    near: Surroundings

    @classmethod
    def of(cls, config: NodeConfig, build: Build = layer_of) -> Skin:
        """The skin that the settings ask for (seconds). Raises InvalidInput or MeshError."""
        layer = published(build(config))
        return cls(layer, config.new_method().prepare(layer), Surroundings.of(layer))

    def stiffened(self, config: NodeConfig) -> Skin:
        """The same skin with the stiffness and density of these settings, in a tenth of a second."""
        layer = self.layer.with_(youngs_modulus=config.youngs_modulus, density=config.density)
        near = copy(self.near)
        near.layer = layer
        Surroundings.keep(near)
        return Skin(layer, config.new_method().prepare(layer), near)

    @cached_property
    def layer_id(self) -> str:
        """Names the layer in messages."""
        return layer_id(self.layer)

    def simulator(self) -> Simulator:
        """Answers on it; what took long to prepare is not prepared again."""
        Surroundings.keep(self.near)
        return Simulator(self.layer, self.method, prepared=True)


def warm_up(simulator: Simulator) -> None:
    """Solves one contact of each kind, so that nothing is left to compile when the first real one comes."""
    corners = 0.01 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    mesh, layer, pose = ToolMesh.of(corners, faces), simulator.layer, np.eye(4)
    vertex = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    push = np.concatenate([-0.01 * layer.normals[vertex], np.zeros(3)])
    for away, wrench in ((0.009, push), (0.012, push), (0.009, None), (0.05, push)):
        pose[:3, 3] = layer.vertices[vertex] + away * layer.normals[vertex]
        simulator.step([Contact("warm up", mesh, pose, wrench)])


class SkinMaker:
    """A process that makes one skin, so that nobody waits for it.

    Attributes:
        skin: raises what `Skin.of` raises, or BrokenExecutor if the process died.
    """

    def __init__(self, config: NodeConfig, build: Build) -> None:
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), stand_beside)
        self._pid = self._pool.submit(os.getpid)
        self.skin: Future[Skin] = self._pool.submit(Skin.of, config, build)

    def close(self) -> None:
        """Ends the process, whether the skin is made or not."""
        if self._pid.done() and not self.skin.done():
            os.kill(self._pid.result(), signal.SIGTERM)
        self._pool.shutdown(wait=False, cancel_futures=True)


class AtHand:
    """A skin that is there already, where a SkinMaker is asked for."""

    def __init__(self, skin: Skin) -> None:
        self.skin: Future[Skin] = Future()
        self.skin.set_result(skin)

    def close(self) -> None:
        """There is nothing to end."""


def maker_of(skin: Skin, config: NodeConfig, changed: set[str], build: Build) -> SkinMaker | AtHand:
    """Makes the skin of these settings from the one that answers, of which `changed` are changed."""
    if changed and changed <= STIFFNESS and config.method in QUICK:
        return AtHand(skin.stiffened(config))
    return SkinMaker(config, build)
