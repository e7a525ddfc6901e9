"""05 Your own method, judged like ours.

Purpose: try an idea against columns, a closed form, the network and finite elements.
Shows: the protocol of a method (`name`, `prepare`, `solve`), its trust, and `stmpl_core.metrics.score`.

    .venv/bin/python examples/05_your_own_method.py
    .venv/bin/stmpl stability --preset quick --methods examples/05_your_own_method.py    # where it fails
"""

from typing import Self

import numpy as np

from fem_tools import PatchFem
from stmpl_core import Displacement, Load, SoftLayer, Trust
from stmpl_core.body import Body
from stmpl_core.methods import Linear, MomentNet, Winkler
from stmpl_core.metrics import score


class Halfway:
    """The mean of two closed forms: columns sink too little, the linear response too far."""

    name = "halfway"

    def prepare(self, layer: SoftLayer) -> Self:
        """Prepares both; what a method computes once for a layer belongs here."""
        self._parts = Winkler().prepare(layer), Linear().prepare(layer)
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement (V, 3) [m]; nobody has validated it, and it says so."""
        first, second = (part.solve(load).displacement for part in self._parts)
        return Displacement((first + second) / 2, Trust(in_range=False, why="validated nowhere"), self.name)


def main() -> float:
    """Mean error of the own method where the skin moves, over the largest displacement [-]."""
    layer = Body.anny().part("left_forearm", edge_length=6e-3)
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    distance = np.linalg.norm(layer.vertices - layer.vertices[middle], axis=1)
    load = Load.pressure(500.0 * np.clip(2 - distance / 0.01, 0, 1))  # Pa
    truth = PatchFem(refine=1, layers=2).prepare(layer).solve(load).displacement

    errors = {}
    for method in (Winkler(), Linear(), Halfway(), MomentNet(), PatchFem()):
        one = score(method.prepare(layer).solve(load).displacement, truth, layer, load)
        errors[method.name] = one.much / one.peak
        print(f"{method.name:>12}: {errors[method.name]:6.1%} off where it moves, {one.peak_share:+6.1%} at the peak")
    return errors["halfway"]


if __name__ == "__main__":
    main()
