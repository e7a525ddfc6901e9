"""Rounds: tools of revolution pressed into flat stacks, a plan's bodies' and others: seconds a press, to any depth.

Solid elements on a limb take minutes a press and see a stack a few times; these see it whole, but flat. All lengths are
in thicknesses of the stack and all forces in E t^2 in the end, so one thickness serves.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fem_tools.axisymmetric import Flat, Profile, Round
from fem_tools.sampling import SKIN, BodyPlan, Plan, ratios
from stmpl_core.errors import InvalidInput
from stmpl_core.packed import stack_from_text, stack_to_text
from stmpl_core.tissue import Membrane, Ply, Tissue

THICKNESS = 0.02  # of every flat stack [m]
WIDTHS = (0.15, 2.0)  # radii of the tools, over it
KINDS = ("ball", "flat", "cone", "ring")
SHARES = (0.45, 0.25, 0.15, 0.15)  # of the kinds
KAPPAS, PULLS = (0.1, 30.0), (0.01, 1.5)  # E_s h / (E t) and T / (E t) of skins on stacks of no body
BARE, SLACK = 0.2, 0.15  # shares of these stacks without a skin, and of skins without tension
PLIES, PLY_SHARES = (1, 2, 3, 4), (0.05, 0.6, 0.25, 0.1)  # their materials, and the shares of stacks with as many
BEGINS = (0.05, 0.85)  # depths at which these begin, over the thickness
STIFFER = (0.5, 50.0)  # their moduli over the first one's
POISSON = (0.35, 0.47)  # their Poisson's ratios, one for all of a stack
BEYOND = 1e-4  # share of the force that a release does not say where it is carried
FULL = 20_000  # steps of what a release rounds


@dataclass(frozen=True)
class Pressed:
    """One press.

    Args:
        tissue: stack, THICKNESS thick.
        tool: tool.
        rounds: converged depths, increasing.
    """

    tissue: Tissue
    tool: Profile
    rounds: list[Round]

    def of(self, tissue: Tissue, tool: Profile) -> bool:
        """Whether it is a press of this tool into this stack, but for last bits, which processors draw otherwise."""
        return len(self.tissue.numbers) == len(tissue.numbers) and np.allclose(self.tissue.numbers, tissue.numbers) \
            and np.allclose(np.hstack(self.tool), np.hstack(tool))

    def write(self) -> bytes:
        """The press as a file's bytes."""
        arrays = {f"{name}_{k}": getattr(one, name) for k, one in enumerate(self.rounds)
                  for name in ("radius", "carried", "moved")}  # fmt: skip
        buffer = io.BytesIO()
        tool = np.array([*self.tool.inner, *self.tool.outer, self.tool.rounding])
        np.savez_compressed(buffer, tissue=np.array(stack_to_text(self.tissue)), tool=tool,
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
            return cls(stack_from_text(str(file["tissue"]))[0], Profile((a, b), (c, d), e), rounds)


def learnt(plan: Plan) -> list[BodyPlan]:
    """The bodies whose stacks are pressed flat: those with one, of which something is learnt."""
    return [body for body in plan.bodies if body.stack and not body.held_out]


def tissue_of(body: BodyPlan) -> Tissue:
    """The stack of a body, THICKNESS thick."""
    assert body.stack is not None
    return body.stack.tissue(body.poisson_ratio, THICKNESS)


def any_stack(plan: Plan, number: int) -> Tissue:
    """The stack of a press by its number: such as phantoms are, of moduli, depths and skins that no body need have."""
    rng = np.random.default_rng([plan.seed, 2, number])
    fat = Tissue(poisson_ratio=float(rng.uniform(*POISSON)))
    unit = fat.youngs_modulus * THICKNESS
    begins = np.sort(_between(rng, BEGINS, int(rng.choice(PLIES, p=PLY_SHARES)) - 1))
    stiffer = _between(rng, STIFFER, len(begins))
    kappa, pull = (float(_between(rng, ends, 1)[0]) for ends in (KAPPAS, PULLS))
    bare, slack = rng.uniform(size=2)
    membrane = Membrane(kappa * unit / SKIN, SKIN, 0.0 if slack < SLACK else pull * unit)
    skin = membrane if bare > BARE or not len(begins) else None  # one material alone is no stack
    plies = tuple(Ply(float(begin) * THICKNESS, float(share) * fat.youngs_modulus, fat.poisson_ratio)
                  for begin, share in zip(begins, stiffer, strict=True))  # fmt: skip
    return replace(fat, skin=skin, deeper=plies)


def _between(rng: np.random.Generator, ends: tuple[float, float], count: int) -> np.ndarray:
    """Numbers between two, evenly in their logarithms."""
    low, high = np.log(ends)
    return np.exp(rng.uniform(float(low), float(high), count))


def drawn(plan: Plan, number: int) -> tuple[Tissue, Profile, list[float]]:
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
    of_body = number < plan.rounds
    tissue = tissue_of(bodies[number % len(bodies)]) if of_body else any_stack(plan, number)
    return tissue, shapes[str(kind)], depths.tolist()


def press(plan: Plan, number: int) -> bytes:
    """One press of a plan, as a file's bytes; to the depth to which Newton's method comes."""
    tissue, tool, depths = drawn(plan, number)
    return Pressed(tissue, tool, Flat(tissue, THICKNESS).press(tool, depths)).write()


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
        tissues=np.frombuffer(json.dumps([stack_to_text(press.tissue) for press in presses]).encode(), np.uint8),
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
        tissues = [stack_from_text(text)[0] for text in json.loads(file["tissues"].tobytes())]
        return [Pressed(tissue, tool, rounds[end - many : end])
                for tissue, tool, many, end in zip(tissues, tools, file["depths"], first, strict=True)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInput(f"{path} holds no flat presses ({error}).") from error


def _steps(shares: np.ndarray) -> np.ndarray:
    """Steps of numbers that grow to 1, in FULLths."""
    return np.diff(np.round(FULL * shares).astype(np.int32), prepend=0).astype(np.int16)


def read_all(folder: str | Path) -> list[Pressed]:
    """All presses of a data set's folder, in their order; none where it has none.

    Raises:
        InvalidInput: a file that holds none, or one of before their stacks were kept.
    """
    try:
        return [Pressed.read(file.read_bytes()) for file in sorted((Path(folder) / "rounds").glob("*.npz"))]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInput(f"{folder} holds flat presses that cannot be read ({error}). Make it again.") from error
