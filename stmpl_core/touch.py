"""Touch and Answer: what one contact does, and where the skin goes under all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from stmpl_core.arrays import PerVertex, Transform, Wrench
from stmpl_core.trust import Displacement, Trust

if TYPE_CHECKING:
    from stmpl_core.columns import Squeeze
    from stmpl_core.sdf import SignedDistance
    from stmpl_core.wake import Wake

TOUCHING = "touching"  # wrench carried by the skin under the tool
MOVED = "moved to touch"  # wrench carried so, after the tool was moved along its push to meet the skin
BY_POSE = "pressed by pose"  # pose without a wrench: the force follows from the depth
APART = "apart"  # pose off the skin, and no wrench to carry
NO_FORCE = "no force"  # pose that touches, with a wrench of exactly zero
PULLING = "pulling"  # wrench that draws the tool off the skin; nothing sticks, so nothing is loaded
NO_TOUCH = "wrench without touch"  # force without skin within reach along it
WRAPPED = "wrapped around"  # tool that closes around the limb: a wrench does not say how hard it squeezes
IN_CORE = "inside the core"  # pose that reaches through the soft layer into what is rigid; the layer is pressed flat
STALE = "stale"  # input that has stopped: the answer is a share of its last one

MIN_ONE_WAY_SHARE = 0.7  # share of the pressure that points one way, and its cosine to a force: all skin then goes so
PRESSING = frozenset((TOUCHING, MOVED, BY_POSE, IN_CORE))  # statuses of a tool that loads the skin
NONE = np.zeros(3)


class Pressed(NamedTuple):
    """Squeeze and field from which the motion under a tool follows.

    Args:
        field: distance field of the tool.
        squeeze: columns that the tool squeezes.
        way: unit vector of the force that moved the tool, (3,), or None where the pose alone was given.
        factor: factor on the pressure that moves no skin: of a tool that was drawn back from the core, and of time.
        forces: forces along the normals at the squeeze's nodes, (N,) [N]; None: not told.
        power: power of the depth with which the force grows, about [-].
        stuck: see `wrench_of`, (3,).
        along: share of the force that sticking skin carries along itself [-].
    """

    field: SignedDistance
    squeeze: Squeeze
    way: np.ndarray | None
    factor: float = 1.0
    forces: np.ndarray | None = None
    power: float = 1.5
    stuck: np.ndarray = NONE
    along: float = 0.0


SlipKind = Literal["stick", "creep", "slide"]


class Slip(NamedTuple):
    """Friction of a contact: what it carries, and how far the skin goes along.

    Args:
        wrench: part of the touch's wrench that is friction, (6,) [N, N m].
        share: share of the normal force under which the skin slides [-]: 0 all sticks, 1 all slides.
        offset: way by which the skin under the tool is dragged along it, (3,) [m].
        turn: turn by which it is, about the inward normal of the contact [rad].
        middle: middle of the contact, as deep as its forces sink the skin, (3,) [m].
        lean: part of the push that is so since the skin came from where the limb faces another way, (3,) [N].
        grown: factor on the pressure, of the same energy as the lean [-].
        slid_offset, slid_turn: part of offset and turn that moves skin as what slides does: none while all sticks, all
            in a slide, which it stays where the tool stops or turns back, (3,) [m], [rad].
        taken: way by which what other tools drag takes the skin under this one along, beyond `offset`, (3,) [m].
    """

    wrench: Wrench
    share: float
    offset: np.ndarray
    turn: float
    middle: np.ndarray
    lean: np.ndarray = NONE
    grown: float = 1.0
    slid_offset: np.ndarray = NONE
    slid_turn: float = 0.0
    taken: np.ndarray = NONE

    @property
    def kind(self) -> SlipKind:
        """Whether the contact sticks, creeps (slides at its rim), or slides as a whole."""
        return "slide" if self.share > 1 - 1e-9 else "creep" if self.share > 0 else "stick"


class Imprint(NamedTuple):
    """Skin that is not back yet after a tool left it.

    Args:
        pose: pose of the tool when it pressed last, (4, 4).
        depth: depth at which the skin under its middle is now [m].
    """

    pose: Transform
    depth: float


@dataclass(frozen=True, eq=False)
class Touch:
    """Effect of one contact: status, wrench, depth, pressure.

    Args:
        name: name of the tool.
        status: one of the constants of this module.
        pose_body_from_tool: pose that is answered for, (4, 4): the stated one, moved along the force if there is one.
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts on the body, layer axes, (6,).
        depth: depth of the deepest column under the tool [m]; negative when apart, at least so far away; NaN when
            farther than the limb is thick, or not known.
        force_bound: bound on the error of the force that the pose presses with [N]; NaN where it is not known.
        moved: way that the tool went from the stated pose, along its push [m].
        missing: part of the stated wrench that the skin does not carry, (6,) [N, N m].
        trust: verdict on the touch: what may be believed of it.
        pressure: pressure on the skin, (V,) [Pa]; None in recordings, which keep the sum over all tools.
        pressed: squeeze and field from which the motion under the tool follows; None: nothing presses, or a recording.
        slip: friction of the contact; None: none is told (no state, no friction, nothing presses, or a recording).
        imprint: skin that the tool let go and that is not back yet; None: the skin is where the tool is.
        passive: factor on the wrench that keeps the contact from giving more energy than was put in [-].
        wake: grooves that the tool left behind where it slid over skin that relaxes.
    """

    name: str
    status: str
    pose_body_from_tool: Transform
    wrench: Wrench
    depth: float = float("nan")
    force_bound: float = float("nan")
    moved: float = 0.0
    missing: Wrench = field(default_factory=lambda: np.zeros(6))
    trust: Trust = field(default_factory=Trust)
    pressure: PerVertex | None = None
    pressed: Pressed | None = None
    slip: Slip | None = None
    imprint: Imprint | None = None
    passive: float = 1.0
    wake: Wake | None = None

    def __repr__(self) -> str:
        depth = "" if math.isnan(self.depth) else f", {1e3 * self.depth:.4g} mm deep"
        return (f"<Touch of {self.name!r}: {self.status}, {self.force:.4g} N (bound {self.force_bound:.2g} N){depth}, "
                f"{'to be trusted' if self.trust.ok else self.trust.why}>")  # fmt: skip

    def with_(self, **changes: Any) -> Touch:
        """The touch with other values of some fields; dataclasses.replace takes ten times as long.

        Raises:
            TypeError: names of no fields.
        """
        out = object.__new__(Touch)
        out.__dict__.update(self.__dict__, **changes)
        if len(out.__dict__) > len(self.__dict__):
            raise TypeError(f"a Touch has no {', '.join(changes.keys() - self.__dict__.keys())}.")
        return out

    @property
    def push(self) -> np.ndarray:
        """Force that the tool presses with, friction left out, (3,) [N]."""
        return self.wrench[:3] if self.slip is None else self.wrench[:3] - self.slip.wrench[:3]

    @property
    def force(self) -> float:
        """Size of the force that the tool presses with, friction left out [N]."""
        push = self.push
        return math.sqrt(push @ push)

    @property
    def drag(self) -> float:
        """Size of the stated force across the push, which is not carried [N]."""
        missing, push = self.missing[:3], self.push
        size = push @ push
        across = missing - (missing @ push) / size * push if size > 0 else missing
        return math.sqrt(across @ across)

    @property
    def presses(self) -> bool:
        """Whether the tool loads the skin."""
        return self.status in PRESSING


def way_of(touch: Touch, pressed: Pressed, inward: np.ndarray, total: float) -> np.ndarray:
    """Ways that skin with these inward normals goes with a tool that it sticks to, unit vectors (N, 3).

    That of the force where there is one, else of the mean contact normal, and each one's own normal where the tool
    closes around the limb.

    Args:
        touch: touch of the tool.
        pressed: what it presses.
        inward: unit vectors into the skin, (N, 3).
        total: sum of the sizes of the forces that it presses with [N].
    """
    if touch.force <= MIN_ONE_WAY_SHARE * total:
        return inward
    one = touch.push / touch.force
    if pressed.way is not None and pressed.way @ one > MIN_ONE_WAY_SHARE:
        one = pressed.way
    return np.full(inward.shape, one)


@dataclass(frozen=True, eq=False)
class Answer(Displacement):
    """The skin under some contacts.

    Args:
        touches: touch of each contact, by the name of its tool.
    """

    touches: Mapping[str, Touch] = field(default_factory=dict)

    def faded(self, share: float, why: str) -> Answer:
        """A share of this answer, whose input has stopped: every tool is STALE and exerts nothing."""
        trust = replace(self.trust, error_bound=None).also(why, in_range=False)
        touches = {name: touch.with_(status=STALE, wrench=np.zeros(6), pressure=None, pressed=None, slip=None,
                                     imprint=None, wake=None)
                   for name, touch in self.touches.items()}  # fmt: skip
        return Answer(share * self.displacement, trust, self.method, None, touches)
