"""Workshop: processes beside the node's for what takes long, so that no answer waits for fields, models or fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from typing import TypeVar

import numpy as np
from rclpy.node import Node

from stmpl_core.contact import Contact
from stmpl_core.friction import Friction
from stmpl_core.history import History
from stmpl_core.layer import SoftLayer
from stmpl_core.local_contact import LocalContact, local_contacts
from stmpl_core.methods.zero import Zero
from stmpl_core.pool import YIELDS, Pool
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.stiffness import Stiffness, fit_stiffness
from stmpl_core.strokes import Fading, Rubbing, fit_friction, fit_relaxation
from stmpl_core.tool import Tool
from stmpl_core.toucher import Toucher, margin_on
from stmpl_core.warming import TIP, middle, over, tip
from stmpl_ros.beside import Builders
from stmpl_ros.remembering import Before

MAX_FITTED_INSTANTS = 500  # instants of a stroke or a press that stays, evenly over it; each takes a touch
MAX_FITTED_PRESSES = 60  # presses of a fit, from the lightest to the hardest; it takes about 25 touches of each

Fit = TypeVar("Fit", Stiffness, Rubbing, Fading)
Then = Callable[[Future], None]


class Workshop:
    """Builds distance fields side by side; finds local models and fits stiffness in one process that knows the layer.

    A thread would not do: libigl keeps the interpreter's lock for half a second, and a fit takes many touches.
    What is made comes back by the node's executor. A process that died is replaced.

    Args:
        node: node whose executor gets what was made.
    """

    _knows: tuple[SoftLayer, Friction | Mapping[str, Friction]]

    def __init__(self, node: Node) -> None:
        self._node, self._closed = node, False
        self._models: Pool | None = None  # started when somebody asks
        self._builders = Builders()

    def move_to(self, layer: SoftLayer, friction: Friction | Mapping[str, Friction]) -> None:
        """Goes on with a layer that contacts are on, and the friction of the tools (see Simulator).

        The builders stay. Models and fits on the layer from before are dropped, and fields of another width.
        """
        self._knows = layer, friction
        if self._models:
            self._models.end()
            self._models = None

    def field(self, tool: Tool, do: Then) -> None:
        """Has the distance field of a tool built, for `do`. The future may raise MeshError."""
        margin = margin_on(self._knows[0])
        built = self._begun(lambda: self._builders.field(tool, margin))
        self._then(built, do, lambda: margin == margin_on(self._knows[0]))

    def models(self, contacts: Sequence[Contact], before: Before, do: Then) -> None:
        """Has the local model of each contact found, beside the others and as the tissue remembers, for `do`."""
        asked = list(contacts), before.state, before.dt, before.joints
        found = self._begun(lambda: self._modeller().submit(_local_contacts, *asked))
        knows = self._knows
        self._then(found, do, lambda: knows is self._knows)

    def expect_models(self) -> None:
        """Starts the process that finds them, unless it is there: it takes seconds, and somebody listens already."""
        self._modeller()

    def stiffness(self, presses: Sequence[Contact]) -> Future[Stiffness]:
        """Fits the skin's stiffness to these presses: for a thread that waits."""
        return self._fitted(_stiffness, presses)

    def friction(self, strokes: Sequence[Contact]) -> Future[Rubbing]:
        """Fits the friction of one tool to its strokes: likewise."""
        return self._fitted(_friction_of, strokes)

    def relaxation(self, press: Sequence[Contact]) -> Future[Fading]:
        """Fits the skin's relaxation to a press that stays: likewise."""
        return self._fitted(_relaxation_of, press)

    def _fitted(self, fit: Callable[[list[Contact]], Fit], contacts: Sequence[Contact]) -> Future[Fit]:
        found = self._begun(lambda: self._modeller().submit(fit, list(contacts)))
        self._then(found, lambda future: self.renew(future.exception()), lambda: True)
        return found

    def renew(self, error: BaseException | None) -> None:
        """Replaces the processes, if `error` says that one died."""
        if not isinstance(error, BrokenExecutor):
            return
        self._node.get_logger().error(f"a process that builds distance fields or local models died: {error}")
        if self._builders.broken:
            self._builders.close()
            self._builders = Builders()
        if self._models and self._models.broken:
            self._models.end()
            self._models = None

    def close(self) -> None:
        """Ends the processes, whatever they are at; nothing comes back any more."""
        self._closed = True
        self._builders.close()
        if self._models:
            self._models.end()

    def _begun[T](self, submit: Callable[[], Future[T]]) -> Future[T]:
        """What `submit` hands to a process; to another one, if that one died while it had nothing to do."""
        try:
            return submit()
        except BrokenExecutor as error:
            self.renew(error)
            return submit()

    def _modeller(self) -> Pool:
        if self._models is None:
            self._models = Pool(1, yields=YIELDS)
            self._models.submit(_know, *self._knows)  # by its queue: who starts it would wait until it has imported
        return self._models

    def _then(self, future: Future, do: Then, wanted: Callable[[], bool]) -> None:
        then(self._node, future, lambda done: do(done) if wanted() and not self._closed else None)


def then(node: Node, future: Future, do: Then) -> None:
    """Calls `do` with the future by the executor of `node`, once it is done."""

    def done(future: Future) -> None:
        executor = node.executor
        if executor and not future.cancelled():
            executor.create_task(do, future)

    future.add_done_callback(done)


# In the process that knows the layer

_history: History
_skin: Skin | None = None  # where its joints are; None: it has none


def _know(layer: SoftLayer, friction: Friction | Mapping[str, Friction]) -> None:
    import numba
    from threadpoolctl import threadpool_limits

    global _history, _skin
    numba.set_num_threads(1)  # what answers goes first
    threadpool_limits(1, user_api="blas")
    _history = History(Toucher(layer), friction)
    if layer.rig is not None:
        _skin = Skin.of(layer, Zero())
    tool, pose = tip(), over(layer, middle(layer), 0.5 * TIP)
    remembers = _history.rubs or len(_history.series.times) > 0
    _local_contacts([Contact(tool, pose)], State() if remembers else None, 0.01)  # loaded before somebody waits
    _history.toucher.tools.remove(tool.name)


def _local_contacts(contacts: list[Contact], state: State | None, dt: float,
                    joints: tuple[float, ...] = ()) -> list[LocalContact]:  # fmt: skip
    global _history, _skin
    if _skin is not None and _skin.angles != joints:
        _skin = _skin.at_angles(joints)
        _history = _history.moved(_history.toucher.moved(_skin))
    if state is None:
        return local_contacts(_history, _history.toucher.touch_all(contacts))
    touches, after = _history.step(contacts, state, dt)
    return local_contacts(_history, touches, after)


def _stiffness(presses: list[Contact]) -> Stiffness:
    global _history, _skin
    if _skin is not None and _skin.rest is not None:  # presses are kept at rest only
        _skin = _skin.rest
        _history = _history.moved(_history.toucher.moved(_skin))
    presses.sort(key=lambda one: 0.0 if one.wrench is None else float(np.linalg.norm(one.wrench[:3])))
    chosen = np.unique(np.linspace(0, len(presses) - 1, MAX_FITTED_PRESSES).astype(int)) if presses else []
    return fit_stiffness(_history.toucher, [presses[k] for k in chosen])


def _friction_of(strokes: list[Contact]) -> Rubbing:
    return fit_friction(_history.toucher, _some(strokes))


def _relaxation_of(press: list[Contact]) -> Fading:
    return fit_relaxation(_history.toucher, _some(press))


def _some(contacts: list[Contact]) -> list[Contact]:
    """At most MAX_FITTED_INSTANTS of them, evenly, in their order."""
    return contacts[:: -(-len(contacts) // MAX_FITTED_INSTANTS)] if contacts else []
