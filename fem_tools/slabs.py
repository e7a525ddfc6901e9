"""Slabs: many loads on one linear system of columns at once, eliminated slab after slab along the limb."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, dijkstra

TOGETHER = 128  # loads that are solved for together


class Slabs(NamedTuple):
    """A symmetric K in slabs, each of which feels the two beside it alone, eliminated in their order.

    With D_i the blocks of K on its diagonal and E_i those below it,

        S_i = D_i - E_(i-1) S_(i-1)^-1 E_(i-1)^T,     A_i = -S_i^-1 E_i^T

    (block Gauss; Golub and Van Loan, Matrix Computations, 4.5). All that is then left to do are products of dense
    blocks of some hundred unknowns, in single precision: that is 1e-6 of the largest motion off.

    Args:
        unknowns: numbers of the unknowns of each slab.
        inverses: S_i^-1, float32.
        passed: A_i, what motion of the slab after it does to each slab but the last, float32.
    """

    unknowns: list[np.ndarray]
    inverses: list[np.ndarray]
    passed: list[np.ndarray]

    @classmethod
    def of(cls, stiffness: sp.csr_matrix, slabs: list[np.ndarray]) -> Slabs:
        """Eliminates. Raises LinAlgError: a stiffness that is singular."""
        inverses, passed = [], []
        lost = np.zeros((len(slabs[0]),) * 2)
        for k, here in enumerate(slabs):
            rows = stiffness[here]
            inverse = np.linalg.inv(rows[:, here].toarray() - lost)
            inverses.append(inverse.astype(np.float32))
            if k + 1 < len(slabs):
                to_next = rows[:, slabs[k + 1]].toarray()
                way = -inverse @ to_next
                passed.append(way.astype(np.float32))
                lost = -to_next.T @ way
        return cls(slabs, inverses, passed)

    def solve(self, loads: sp.csc_matrix, kept: np.ndarray) -> np.ndarray:
        """Motion of the unknowns `kept` (K,) under each column of loads (N, L), (K, L) float32."""
        size, many = sum(map(len, self.unknowns)), len(loads.indptr) - 1
        loads = sp.csc_matrix(loads, dtype=np.float32)
        out, slab, place = np.empty((len(kept), many), np.float32), np.empty(size, int), np.full(size, -1)
        for k, here in enumerate(self.unknowns):
            slab[here] = k
        place[kept] = np.arange(len(kept))
        first = np.full(many, len(self.unknowns) - 1)  # slab at which each load begins: none before is pushed
        np.minimum.at(first, np.repeat(np.arange(many), np.diff(loads.indptr)), slab[loads.indices])
        for some in np.array_split(np.argsort(first, kind="stable"), -(-many // TOGETHER)):
            out[:, some] = self._solve(loads[:, some].toarray(), int(first[some[0]]), place, len(kept))
        return out

    def _solve(self, loads: np.ndarray, begin: int, place: np.ndarray, count: int) -> np.ndarray:
        """The same for loads that begin at slab `begin` or after it, with their places in the answer, -1: not kept."""
        out = np.empty((count, loads.shape[1]), np.float32)
        carried = [loads[here] for here in self.unknowns[begin:]]
        for k, way in enumerate(self.passed[begin:]):
            carried[k + 1] += way.T @ carried[k]
        motion = np.zeros((0, loads.shape[1]), np.float32)
        for k in reversed(range(len(self.unknowns))):
            after, motion = motion, np.zeros_like(loads, shape=(len(self.unknowns[k]), loads.shape[1]))
            if k >= begin:
                motion = self.inverses[k] @ carried.pop()
            if k < len(self.passed):
                motion += self.passed[k] @ after
            at = place[self.unknowns[k]]
            out[at[at >= 0]] = motion[at >= 0]
        return out


def slabs_of(neighbours: sp.csr_matrix) -> list[np.ndarray]:
    """Numbers of the nodes of a graph in slabs, by how many edges they are from a far end of what hangs together."""
    many, piece = connected_components(neighbours, directed=False)
    distance = np.zeros(len(piece))
    for _ in range(2):  # from anywhere to an end, then from that end
        order = np.lexsort((distance, piece))
        ends = order[np.searchsorted(piece[order], np.arange(many), side="right") - 1]
        distance = dijkstra(neighbours, directed=False, indices=ends, unweighted=True, min_only=True)
    which = distance.astype(int)
    return [np.flatnonzero(which == k) for k in range(which.max() + 1)]
