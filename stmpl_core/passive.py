"""PassiveContact: renders a LocalContact to a robot between answers, and takes back what late ones gave out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Transform, Wrench
from stmpl_core.contact import rigid
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import twist_between
from stmpl_core.local_contact import LocalContact

PAYBACK_S = 4e-3  # time in which the damper takes back what was given out
FORGETS_S = 0.3  # time in which a surplus of paid work is forgotten
SPARED = 0.05  # share of what is stored that must not be paid for: between it and nothing models are rounded
MUST_BE_PAID = 0.5  # share of what is stored, below which the wrench falls with what was paid


class PassiveContact:
    """The newest local model's wrench at a robot's poses, with the balance of energy kept by a damper.

    A model that comes late, or differs from the last one, makes energy: it says more force, or more stored energy S,
    than the tool has paid for. The balance (Hannaford & Ryu 2002)

        B = sum W . dx - S,

    with W the wrench that was held along the way dx, is below 0 by that. A damper then takes it back along the tool's
    motion, with -B / (v^2 T), T = 4 ms, up to `most_damping`; a surplus beyond half of what S was in the last FORGETS_S
    is forgotten, so that what was lost before pays for nothing now. Where less than half of S was paid, B + S < S / 2,
    the wrench is (B + S) / (S / 2) of what the model says: a softer spring, which never gives back more than was put
    in.

    Args:
        most_damping: largest damping that may be added [N s/m]. A robot of effective mass m and sample time T bears
            less than m / T; one whose controller takes the force's rate with a gain of kr [s] less than m / kr.
        stale_after: age of the newest model [s] from which its wrench decays, with a time constant as long.

    Attributes:
        balance: B [J].
        damping: damping that is added now [N s/m].
        refused: number of models so far that could not be rendered.
        share: share of the model's wrench that is rendered now [-]; below 1 too little was put in for all of it.

    Raises:
        InvalidInput: settings that are not above 0.
    """

    def __init__(self, most_damping: float = 300.0, stale_after: float = 0.1) -> None:
        for name, value in (("most_damping", most_damping), ("stale_after", stale_after)):
            if not (math.isfinite(value) and value > 0):
                raise InvalidInput(f"{name} is {value}; it must be finite and above 0.")
        self.most_damping, self.stale_after = most_damping, stale_after
        self.balance, self.damping, self.share, self.refused = 0.0, 0.0, 1.0, 0
        self._model: LocalContact | None = None
        self._pose: Transform | None = None
        self._begun = False
        self._wrench, self._stored, self._surplus, self._age = np.zeros(6), 0.0, 0.0, 0.0

    def update(self, model: LocalContact) -> None:
        """Hands the newest model over.

        One that cannot be rendered (`model.check()` says why) is counted in `refused`, and the last one goes on.
        """
        if not model.renderable:
            self.refused += 1
            return
        self._model, self._age = model, 0.0

    def step(self, pose_body_from_tool: ArrayLike, dt: float) -> Wrench:
        """Wrench on the body about the tool's origin, layer axes, (6,) [N, N m]; the tool feels the opposite.

        Args:
            pose_body_from_tool: pose of the tool now, (4, 4).
            dt: time since the last step [s].

        Raises:
            InvalidInput: a pose that is not finite or not rigid, or a dt that is not above 0.
        """
        pose = rigid("the tool's pose", pose_body_from_tool)
        if not (math.isfinite(dt) and dt > 0):
            raise InvalidInput(f"dt is {dt} s; it must be finite and above 0.")
        wrench, stored = np.zeros(6), 0.0
        if self._model is not None:
            self._age += dt
            fade = math.exp(-max(self._age / self.stale_after - 1, 0.0))
            rendered = self._model.wrench_at(pose)
            wrench, stored = fade * rendered.wrench, fade * rendered.stored
            if not self._begun:  # a device that begins in contact owes nothing for what was stored before
                self._begun, self._stored = True, stored
        twist = np.zeros(6) if self._pose is None else twist_between(self._pose, pose)
        work = float(self._wrench @ twist)  # the robot was given this wrench on all of its way
        self._surplus = max(0.5 * stored, self._surplus * math.exp(-dt / FORGETS_S))
        paid = self.balance + self._stored + work
        self.share = min(max(paid / (MUST_BE_PAID * stored), 0.0), 1.0) if stored > 0 else 1.0
        wrench *= self.share
        self.balance = min(self.balance + work - (stored - self._stored), self._surplus)
        self._stored, self._pose, self.damping = stored, pose, 0.0
        velocity = twist[:3] / dt
        square, lacking = float(velocity @ velocity), -self.balance - SPARED * stored
        if lacking > 0 and square > 0:
            self.damping = min(self.most_damping, lacking / (square * max(PAYBACK_S, dt)))
            wrench[:3] += self.damping * velocity
        self._wrench = wrench
        return wrench
