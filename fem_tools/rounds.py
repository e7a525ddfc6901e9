"""Rounds: tools of revolution pressed into the flat stacks of a plan: seconds a press, so every stack is seen to depth.

Solid elements on a limb take minutes a press and see a stack a few times; these see it whole, but flat. All lengths are
in thicknesses of the stack and all forces in E t^2 in the end, so one thickness serves.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fem_tools.axisymmetric import Flat, Profile, Round
from fem_tools.sampling import BodyPlan, Plan, ratios
from stmpl_core.tissue import Tissue

THICKNESS = 0.02  # of every flat stack [m]
WIDTHS = (0.15, 2.0)  # radii of the tools, over it
KINDS = ("ball", "flat", "cone", "ring")
SHARES = (0.45, 0.25, 0.15, 0.15)  # of the kinds


@dataclass(frozen=True)
class Pressed:
    """One press.

    Args:
        body: name of the body in the plan whose stack it is.
        tool: tool.
        rounds: converged depths, increasing.
    """

    body: str
    tool: Profile
    rounds: list[Round]

    def write(self) -> bytes:
        """The press as a file's bytes."""
        arrays = {f"{name}_{k}": getattr(one, name) for k, one in enumerate(self.rounds)
                  for name in ("radius", "carried", "moved")}  # fmt: skip
        buffer = io.BytesIO()
        tool = np.array([*self.tool.inner, *self.tool.outer, self.tool.rounding])
        np.savez_compressed(buffer, body=np.array(self.body), tool=tool,
                            depths=np.array([one.depth for one in self.rounds]),
                            **{name: value.astype(np.float32) for name, value in arrays.items()})  # fmt: skip
        return buffer.getvalue()

    @classmethod
    def read(cls, content: bytes) -> Pressed:
        """The press that such bytes hold."""
        with np.load(io.BytesIO(content)) as file:
            a, b, c, d, e = map(float, file["tool"])
            rounds = [Round(float(depth), float(file[f"carried_{k}"][-1]),
                            *(file[f"{name}_{k}"].astype(float) for name in ("radius", "carried", "moved")))
                      for k, depth in enumerate(file["depths"])]  # fmt: skip
            return cls(str(file["body"]), Profile((a, b), (c, d), e), rounds)


def learnt(plan: Plan) -> list[BodyPlan]:
    """The bodies whose stacks are pressed flat: those with one, of which something is learnt."""
    return [body for body in plan.bodies if body.stack and not body.held_out]


def tissue_of(body: BodyPlan) -> Tissue:
    """The stack of a body, THICKNESS thick."""
    assert body.stack is not None
    return body.stack.tissue(body.poisson_ratio, THICKNESS)


def drawn(plan: Plan, number: int) -> tuple[BodyPlan, Profile, list[float]]:
    """Stack, tool and depths [m] of a press, whoever draws it and when."""
    bodies = learnt(plan)
    rng = np.random.default_rng([plan.seed, 1 + number])
    width = THICKNESS * math.exp(rng.uniform(*np.log(WIDTHS)))
    kind, edge, slope = rng.choice(KINDS, p=SHARES), width * rng.uniform(0.15, 0.5), rng.uniform(0.1, 0.5)
    shapes = {
        "ball": Profile((0.0, 0.0), (0.0, 0.0), width),
        "flat": Profile((0.0, 0.0), (width - edge, 0.0), edge),
        "cone": Profile((0.0, 0.0), (width - edge, slope * (width - edge)), edge),
        "ring": Profile((width - edge, 0.0), (width - edge, 0.0), edge),
    }
    depths = THICKNESS * ratios(plan, "indenter", plan.loads, rng)
    return bodies[number % len(bodies)], shapes[str(kind)], depths.tolist()


def press(plan: Plan, number: int) -> bytes:
    """One press of a plan, as a file's bytes; to the depth to which Newton's method comes."""
    body, tool, depths = drawn(plan, number)
    return Pressed(body.name, tool, Flat(tissue_of(body), THICKNESS).press(tool, depths)).write()



def read_all(folder: str | Path) -> list[Pressed]:
    """All presses of a data set's folder, in their order; none where it has none."""
    return [Pressed.read(file.read_bytes()) for file in sorted((Path(folder) / "rounds").glob("*.npz"))]
