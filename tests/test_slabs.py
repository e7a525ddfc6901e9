"""Laws of the elimination slab after slab: it solves the system, whatever hangs together and however loads come."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from fem_tools import slabs
from fem_tools.slabs import Slabs, slabs_of


def edges(*pairs: tuple[int, int], count: int) -> sp.csr_matrix:
    i, j = np.array(pairs).T
    half = sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    return sp.csr_matrix(half + half.T)


CHAIN = edges(*((k, k + 1) for k in range(12)), count=13)
RING_AND_CHAIN = edges(*((k, (k + 1) % 7) for k in range(7)), (7, 8), (8, 9), count=11)  # and one node alone
GRAPHS = {"chain": CHAIN, "pieces": RING_AND_CHAIN, "one": sp.csr_matrix((1, 1))}


@pytest.fixture(params=GRAPHS)
def graph(request) -> sp.csr_matrix:
    return GRAPHS[request.param]


def test_a_slab_feels_the_two_beside_it_alone(graph):
    where = np.empty(graph.shape[0])
    found = slabs_of(graph)
    for k, here in enumerate(found):
        where[here] = k
    i, j = graph.nonzero()
    assert sum(map(len, found)) == graph.shape[0] and (np.abs(where[i] - where[j]) <= 1).all()


def test_a_chain_is_eliminated_from_one_end_to_the_other():
    assert sorted(map(len, slabs_of(CHAIN))) == [1] * 13


def test_motion_is_that_of_a_sparse_solver(graph, monkeypatch):
    monkeypatch.setattr(slabs, "TOGETHER", 5)
    rng = np.random.default_rng(1)
    count, width = graph.shape[0], 2
    pattern = sp.kron(sp.csr_matrix(graph + sp.eye_array(count)), np.ones((width, width))).tocsr()
    half = sp.csr_matrix((rng.standard_normal(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
    matrix = sp.csr_matrix(half + half.T)
    matrix = sp.csr_matrix(matrix + sp.diags_array(np.asarray(abs(matrix).sum(axis=1)).ravel()))
    loads = sp.csc_matrix(sp.random_array((count * width, 12), density=0.2, rng=rng))  # some columns are empty
    parts = [(width * one[:, None] + np.arange(width)).ravel() for one in slabs_of(graph)]
    kept = np.arange(0, count * width, 2)[::-1]
    truth = spsolve(sp.csc_matrix(matrix), loads.toarray()).reshape(count * width, -1)[kept]
    np.testing.assert_allclose(Slabs.of(matrix, parts).solve(loads, kept), truth, atol=1e-6 * np.abs(truth).max())
