"""Balance: a contact that would give more energy than was put into it is weakened."""

from __future__ import annotations

import numba
import numpy as np

GIVEN_BACK = 0.7  # share of what a contact surely gives back that must be covered by what was put in
KEPT = 1.5  # work beyond what elastic skin could hold that is forgotten: what was lost before pays for nothing now
UNSURE = 6e-4  # of the largest force so far times the depth: energy that a contact may lack, as no sum is exact
POWERS = (1.0, 12.0)  # range of the power of the depth with which a force grows between two depths
MIN_SPREAD = 1e-3  # logarithm of two depths' ratio, from which their forces say that power
MUCH = 0.1  # of the largest force so far: what is taken off a force, beyond which it is flagged
WEAKEST = 1e-12  # factor on a wrench that has nothing left to give: by 0 nobody could divide to find how it is pressed


@numba.njit(cache=True, nogil=True, error_model="numpy")
def settled(works, givens, spares, stored, whole):
    """Factors on the wrenches of tools (K,) [-], with which no more comes back than was put in; updates their works.

    Tools that feel each other pass energy on: one is weakened only where all together lack it, what all have beyond
    what all could hold is forgotten, and what one took from the others they no longer have. One that left the skin
    sideways, in the air for a moment, has what it put in: it gave nothing back.

    Args:
        works: work that was put in and not given back, before; written: after, (K,) [J].
        givens: what the last wrench has of it, (K,) [J].
        spares: what a contact may lack, (K,) [J].
        stored, whole: energy that a contact surely gives back, and that it could hold, (K,) [J].
    """
    tools, out = len(works), np.ones(len(works))
    all_stored, all_there = stored.sum(), works.sum() + spares.sum()
    together = all_there / (GIVEN_BACK * all_stored) if all_stored > 0 else 1.0
    excess = beyond = 0.0
    for k in range(tools):
        if stored[k] > 0:
            there, given = works[k] + spares[k], givens[k]
            passive = min(1.0, max(there / (GIVEN_BACK * stored[k]), together if tools > 1 else 0.0, WEAKEST))
            if passive < 1:
                at_rest = there - given
                if tools == 1 and at_rest + passive * given < 0 and given < 0:
                    passive = -at_rest / given
                out[k] = max(passive, WEAKEST)
                works[k] -= (1 - out[k]) * given
            beyond += works[k] - KEPT * whole[k]
            excess += max(works[k] - KEPT * whole[k], 0.0)
    share, owed, left = max(beyond / excess, 0.0) if excess > 0 else 0.0, 0.0, 0.0
    for k in range(tools):
        if stored[k] > 0 and works[k] > KEPT * whole[k]:
            works[k] = KEPT * whole[k] if share == 1 else works[k] - share * (works[k] - KEPT * whole[k])
        owed, left = owed + max(-works[k], 0.0), left + max(works[k], 0.0)
    paid = min(owed, left)
    for k in range(tools):
        if paid > 0:
            works[k] *= 1 - paid / (left if works[k] > 0 else owed)
        if stored[k] <= 0:
            works[k] = max(works[k], 0.0)
    return out


@numba.njit(cache=True, error_model="numpy")
def work_of(twist, before, after, old, new, origin, presses_first, presses_last, factor_first, factor_last,
            passive, relaxed_first, relaxed_last, shares, depth_first, depth_last, power, radius):  # fmt: skip
    """Work of a wrench over a tool's way in a step; how far it may be from that; and the last wrench's part of it [J].

    The wrench goes straight from one to the other, but for the force of elastic skin along the normal, which grows with
    a power m of the depth: F_1 d_1 - F_0 d_0 over (m + 1) (d_1 - d_0) in the mean. That is less than (F_0 + F_1) / 2,
    and the truth may be as far off on either side. A tool that comes or leaves in the step meets skin on as much of its
    way as it was deep. One that came along the skin from further than its contact is wide may have done any work.

    Args:
        twist: way of the tool, (6,) [m, rad].
        before, after: wrenches, (6,) [N, N m].
        old, new: contacts (see Memory), (3, 3).
        origin: origin of the tool, (3,) [m].
        presses_first, presses_last: whether the tool presses before and after.
        factor_first, factor_last: force along the normal over one that relaxed at rest, by what a tool presses with:
            net and stretch of Scalars, one times the other [-].
        passive: factor by which the first wrench was weakened: forces grow as those that are not [-].
        relaxed_first, relaxed_last: what has relaxed there, (P,) [N].
        shares: shares of the force that relax, (P,) [-].
        depth_first, depth_last: depths there [m].
        power: power of the depth with which it grows, where the depths do not say it [-].
        radius: radius of the contact there [m].
    """
    first = _elastic(before, old, 1 / passive, factor_first, relaxed_first, shares) if presses_first else 0.0
    last = _elastic(after, new, 1.0, factor_last, relaxed_last, shares) if presses_last else 0.0
    contact, deep = (new, depth_last) if last > 0 else (old, depth_first)
    go, square, share, less = 0.0, 0.0, 1.0, 0.0
    for x in range(3):
        y, z = (x + 1) % 3, (x + 2) % 3
        turned = twist[3 + y] * (contact[0, z] - origin[z]) - twist[3 + z] * (contact[0, y] - origin[y])
        go += contact[1, x] * (twist[x] + turned)
        square += (twist[x] + turned) ** 2
    if first > 0 and last > 0:
        spread = np.log(depth_last / depth_first)
        if abs(spread) > MIN_SPREAD:
            power = np.log(last / first) / spread
        less = _less(first, last, min(max(power, POWERS[0]), POWERS[1]))
    elif first > 0 or last > 0:
        share = min(1.0, deep / max(abs(go), 1e-12))
        less = _less(first, last, max(power, POWERS[0]))
    less *= passive
    given = taken = 0.0
    for x in range(6):
        given += 0.5 * share * before[x] * twist[x]
        taken += 0.5 * share * after[x] * twist[x]
    doubt = share * less * abs(go) if first > 0 or last <= 0 or square - go * go <= radius * radius else np.inf
    return given + taken - share * less * go, doubt, taken


@numba.njit(cache=True, error_model="numpy")
def _elastic(wrench, contact, sized, factor, relaxed, shares):
    """What a tool that presses would press with along the normal, had nothing relaxed [N]."""
    force = 0.0
    for x in range(3):
        force += sized * wrench[x] * contact[1, x]
    for i in range(len(shares)):
        force += factor * shares[i] * relaxed[i]
    return max(force, 0.0)


@numba.njit(cache=True, error_model="numpy")
def _less(first, last, power):
    """How much less than halfway between two forces the mean of one is that grows with a power of the depth [N]."""
    most, ratio = max(first, last), min(first, last) / max(first, last)
    shallow = ratio ** (1 / power)
    if shallow > 1 - 1e-4:
        return 0.0
    return most * (0.5 * (1 + ratio) - (1 - ratio * shallow) / ((power + 1) * (1 - shallow)))
