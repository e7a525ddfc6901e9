"""Judge: solves one instant again by finite elements, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable

from fem_tools import RigidFem
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.posing import posed
from stmpl_core.trust import Displacement
from stmpl_ros.latest import LatestWins
from stmpl_ros.view.page import Page
from stmpl_ros.view.snapshot import Snapshot, joints_of

NO_MEMORY = "FEM presses elastic skin without friction: where this answer remembers, their difference is no error."


class Judge:
    """The button `FEM of this instant`, and what it does.

    Args:
        page: page that gets the button, and shows the instant with its error when it is solved.
        keep: callback with the judged snapshot, so that whoever made it can show it again.
    """

    def __init__(self, page: Page, keep: Callable[[Snapshot, Snapshot], None]) -> None:
        self._page, self._keep = page, keep
        self._fem: tuple[SoftLayer, RigidFem] | None = None
        self._bent: tuple[float, ...] = ()  # angles of the layer's joints that it was prepared at [rad]
        self._working = LatestWins(self._judge, page.say, "judge")
        button = page.server.gui.add_button("FEM of this instant", hint="Presses these tools by finite elements")
        button.on_click(lambda _: self.judge())

    def judge(self) -> None:
        """Solves what the page shows."""
        if self._page.snapshot is None:
            self._page.say("There is no instant to solve yet.")
        else:
            self._page.say("FEM is solving this instant ...")
            self._working.put(self._page.snapshot)

    def wait(self, timeout: float) -> bool:
        """Waits until it is solved; False if that takes longer than `timeout` [s]."""
        return self._working.wait(timeout)

    def close(self) -> None:
        """Ends its thread."""
        self._working.close()

    def _judge(self, snapshot: Snapshot) -> None:
        judged = snapshot.judged_by(self._solve(snapshot))
        self._keep(snapshot, judged)
        self._page.say(NO_MEMORY if getattr(snapshot.answer, "state", b"") else "")
        if self._page.snapshot is snapshot:
            self._page.show(judged)
            self._page.field = "error against FEM"

    def _solve(self, snapshot: Snapshot) -> Displacement:
        layer, answer, joints = self._page.layer, snapshot.answer, joints_of(snapshot.answer)
        if layer is None:
            raise InvalidInput("there is no skin yet.")
        if self._fem is None or self._fem[0] is not layer or self._bent != joints:
            self._fem, self._bent = (layer, RigidFem().prepare(posed(layer, joints))), joints
        touches = answer.touches
        pressing = [one for one in snapshot.contacts if one.name in touches and touches[one.name].presses]
        solved = self._fem[1].press(pressing, answer)
        if not solved.trust.converged:
            raise InvalidInput(f"FEM did not converge on this instant, so it cannot judge it. {solved.trust.why}")
        return solved
