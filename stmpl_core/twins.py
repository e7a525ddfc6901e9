"""Twins: tools in one place, as one that is announced twice, or a pad and its cover.

Each tool has a lattice of contact nodes of its own. Where a node of one lies on one of the other, both are told where
the skin there goes: twice nearly the same, and what differs took forces without limit, against each other. So such a
pair gives way to what its forces differ by, as much as the skin itself gives to one of them, and goes its mean way.
Nodes a share of their lattice's spacing apart do so no longer; in between it fades, so nothing jumps while tools slide
over each other.

Which of the two presses at a place is open, too: one may press on the left and the other on the right, with forces
that point apart. So tools that cover the same skin go the way of their force together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.touch import Touch

APART = 0.5  # distance over the lattice's spacing from which nodes of two tools are no twins
GIVES = 1.0  # how much twins in one place give way, over what the skin gives to one of them
HERE = 0.9  # likewise, within which nodes of one say what it presses with at a place of the other
AROUND = 1.5  # distance over the lattice's spacing within which nodes say whether their tool covers a place
COVERED = 0.5  # share of a tool that another one covers from which they begin to go one way


class Twins(NamedTuple):
    """Pairs of nodes of two tools.

    Args:
        pairs: their numbers, (P, 2).
        share: how much they give way to what their forces differ by, over what the skin gives to one of them, (P,) [-].
    """

    pairs: np.ndarray
    share: np.ndarray


NO_TWINS = Twins(np.empty((0, 2), np.int64), np.empty(0))


def going_together(touches: Sequence[Touch]) -> Sequence[Touch]:
    """The touches, of which those that cover the same skin are told the way of the force that they share."""
    pressed = [(touch, touch.pressed) for touch in touches if touch.pressed is not None]
    if len(pressed) < 2:
        return touches
    nodes = [one.squeeze.nodes for _, one in pressed]
    of = np.repeat(np.arange(len(nodes)), [len(one.area) for one in nodes])
    points, inward, area, strain = (np.concatenate([getattr(one, name) for one in nodes])
                                    for name in ("points", "inward", "area", "strain"))  # fmt: skip
    shares = covered(points, inward, area, strain, of, len(nodes))
    if not shares.any():
        return touches
    shares = np.minimum(shares, shares.T) + np.eye(len(nodes))
    pushes = shares @ [touch.push for touch, _ in pressed]
    told = {}
    for (touch, one), share, push in zip(pressed, shares, pushes, strict=True):
        size = float(np.linalg.norm(push))
        if one.way is None and share.sum() > 1 and size > 0:
            told[touch.name] = touch.with_(pressed=one._replace(way=push / size))
    return [told.get(touch.name, touch) for touch in touches]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def covered(points, inward, area, strain, of, many):
    """How much of what each of many tools covers each other one covers too, from COVERED on, (many, many) [-].

    Args:
        points, inward, area, strain: those of Nodes, (N,): a place counts as much as it is deep.
        of: number of the tool of each, rising, (N,).
    """
    count, out, total, near = len(area), np.zeros((many, many)), np.zeros(many), np.zeros((len(area), many))
    for i in range(count):
        total[of[i]] += area[i] * strain[i]
        for j in range(i):
            if of[j] == of[i]:
                break
            _near(points, inward, area, of, i, j, near)
    if not near.any():
        return out
    for i in range(count):
        for j in range(i, -1, -1):
            if of[j] != of[i]:
                break
            _near(points, inward, area, of, i, j, near)
    for i in range(count):
        for k in range(many):
            if k != of[i]:
                out[of[i], k] += area[i] * strain[i] * min(near[i, k] / near[i, of[i]], 1.0) / total[of[i]]
    for k in range(many):
        for m in range(many):
            x = max(out[k, m] - COVERED, 0.0) / (1 - COVERED)
            out[k, m] = x * x * (3 - 2 * x)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def crowded(points, inward, area, strain, beside, force):
    """What tools that cover the same skin do at a node together, over what its own does there.

    Args:
        points, inward, area, strain, beside: those of Nodes, (N,) and (N, K).
        force: forces at the nodes, none below 0, (N,).

    Returns:
        times: pressure of them all over the node's own, (N,) [-].
        over: number of tools that cover the place, (N,) [-].
    """
    count, many = beside.shape
    times, over, sums, areas = np.ones(len(area)), np.ones(len(area)), np.empty(many), np.empty(many)
    for i in range(count):
        for k in range(many):
            over[i] += min(max(beside[i, k], 0.0) / strain[i], 1.0)
        if over[i] == 1 or force[i] <= 0:
            continue
        sums[:] = 0.0
        areas[:] = 1e-300
        for j in range(count):
            near = 1 - _apart(points, inward, area, i, j, HERE)
            if near > 0:
                for k in range(many):
                    if beside[j, k] < 0:
                        sums[k] += near * force[j]
                        areas[k] += near * area[j]
        for k in range(many):
            share = min(max(beside[i, k], 0.0) / strain[i], 1.0)
            times[i] += share * sums[k] / areas[k] * area[i] / force[i]
    return times, over


@numba.njit(cache=True, inline="always")
def _near(points, inward, area, of, i, j, near):
    """Adds what two nodes see of each other's tool to `near`."""
    over = _apart(points, inward, area, i, j, AROUND)
    if over < 1:
        near[i, of[j]] += area[j] * (1 - over)
        if i != j:
            near[j, of[i]] += area[i] * (1 - over)


@numba.njit(cache=True, inline="always")
def _apart(points, inward, area, i, j, most):
    """Squared distance of two nodes over that of `most` spacings of their lattices; 1 where they face apart."""
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    over = (x * x + y * y + z * z) / (most * most / np.sqrt(3.0) * (area[i] + area[j]))  # spacing^2 = 2 / sqrt(3) area
    if over >= 1 or inward[i, 0] * inward[j, 0] + inward[i, 1] * inward[j, 1] + inward[i, 2] * inward[j, 2] <= 0:
        return 1.0
    return over


@numba.njit(cache=True, nogil=True, error_model="numpy")
def twins(points, inward, area, group, of):
    """The Twins among nodes.

    Args:
        points, inward, area: those of Nodes.
        group: numbers of groups of nodes that do not feel each other, (N,).
        of: number of the tool of each, rising, (N,).
    """
    found, pairs, share = 0, np.empty((16, 2), np.int64), np.empty(16)
    for i in range(len(area)):
        for j in range(i):
            if of[j] == of[i]:
                break
            over = _apart(points, inward, area, i, j, APART)
            if over >= 1 or group[i] != group[j]:
                continue
            if found == len(share):
                pairs, share = np.concatenate((pairs, pairs)), np.concatenate((share, share))
            pairs[found, 0], pairs[found, 1], share[found] = i, j, GIVES * (1 - over) ** 2
            found += 1
    return pairs[:found].copy(), share[:found].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def give_way(blocks, pairs, share):
    """Adds to motions of nodes under forces at each, (N, 3, 3, M): by node, direction of both, node, what Twins give.

    They give way to what their forces differ by.
    """
    gives = np.empty(len(share), blocks.dtype)
    for k in range(len(share)):
        i, j = pairs[k]
        own = 0.0
        for x in range(3):
            own += blocks[i, x, x, i] + blocks[j, x, x, j]
        gives[k] = share[k] * own / 6
    for k in range(len(share)):
        i, j = pairs[k]
        for x in range(3):
            blocks[i, x, x, i] += gives[k]
            blocks[j, x, x, j] += gives[k]
            blocks[i, x, x, j] -= gives[k]
            blocks[j, x, x, i] -= gives[k]
