"""Rounds: tools of revolution pressed into the flat stacks of a plan: seconds a press, so every stack is seen to depth.

Solid elements on a limb take minutes a press and see a stack a few times; these see it whole, but flat. All lengths are
in thicknesses of the stack and all forces in E t^2 in the end, so one thickness serves.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fem_tools.axisymmetric import Flat, Profile, Round
from fem_tools.sampling import BodyPlan, Plan, ratios
from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Tissue

THICKNESS = 0.02  # of every flat stack [m]
WIDTHS = (0.15, 2.0)  # radii of the tools, over it
KINDS = ("ball", "flat", "cone", "ring")
SHARES = (0.45, 0.25, 0.15, 0.15)  # of the kinds
BEYOND = 1e-4  # share of the force that a release does not say where it is carried
FULL = 20_000  # steps of what a release rounds


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


def release(presses: Sequence[Pressed], path: str | Path) -> None:
    """Writes presses as one small file: where the skin bears what, not how it moved.

    Args:
        presses: presses of a plan, by their numbers from 0 on.
        path: file, .npz.
    """
    every = [one for press in presses for one in press.rounds]
    ends = [int(np.flatnonzero(np.abs(one.carried / one.force - 1) > BEYOND)[-1]) + 2 for one in every]
    radii = [one.radius[:end] for one, end in zip(every, ends, strict=True)]
    shares = [np.append(one.carried[: end - 1] / one.force, 1.0) for one, end in zip(every, ends, strict=True)]
    np.savez_compressed(
        path,
        bodies=np.array([press.body for press in presses]),
        tools=np.array([(*press.tool.inner, *press.tool.outer, press.tool.rounding) for press in presses]),
        depths=np.array([len(press.rounds) for press in presses]),
        depth=np.array([one.depth for one in every]),
        force=np.array([one.force for one in every]),
        places=np.array(ends),
        widest=np.array([places[-1] for places in radii]),
        steps=np.concatenate([_steps(places / places[-1]) for places in radii]),
        bears=np.concatenate([_steps(share) for share in shares]),
    )


def released(path: str | Path) -> list[Pressed]:
    """The presses that `release` wrote; motion, which it leaves out, is NaN.

    Raises:
        InvalidInput: no such file, or one that holds no presses.
    """
    try:
        with np.load(path) as read:
            file = dict(read)
        ends, first = np.cumsum(file["places"]), np.cumsum(file["depths"])
        rounds = []
        for k, end in enumerate(ends):
            some = slice(end - file["places"][k], end)
            radius, carried = (np.cumsum(file[name][some]) / FULL for name in ("steps", "bears"))
            force = float(file["force"][k])
            rounds.append(Round(float(file["depth"][k]), force, file["widest"][k] * radius, force * carried,
                                np.full((2, len(radius)), np.nan)))  # fmt: skip
        tools = [Profile((a, b), (c, d), e) for a, b, c, d, e in file["tools"].tolist()]
        return [Pressed(str(body), tool, rounds[end - many : end])
                for body, tool, many, end in zip(file["bodies"], tools, file["depths"], first, strict=True)]
    except (OSError, ValueError, KeyError) as error:
        raise InvalidInput(f"{path} holds no flat presses ({error}).") from error


def _steps(shares: np.ndarray) -> np.ndarray:
    """Steps of numbers that grow to 1, in FULLths."""
    return np.diff(np.round(FULL * shares).astype(np.int32), prepend=0).astype(np.int16)


def read_all(folder: str | Path) -> list[Pressed]:
    """All presses of a data set's folder, in their order; none where it has none."""
    return [Pressed.read(file.read_bytes()) for file in sorted((Path(folder) / "rounds").glob("*.npz"))]
