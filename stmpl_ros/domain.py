"""A ROS domain of one's own, among all processes of this machine that take theirs here."""

from __future__ import annotations

import os
import socket

from stmpl_core.errors import StmplError

DOMAINS = 50  # taken from 1 to here; those that lie so much higher are left to second buses
LOCKS = 27_400  # the first of the ports that stand for the domains; below those that systems hand out by themselves


class DomainError(StmplError):
    """No ROS domain is free."""


def claim() -> tuple[int, socket.socket]:
    """Number of a ROS domain, 1 to DOMAINS, that no other process of this machine claims; and what holds it.

    A port holds it, until it is closed or this process ends, however it ends. A number that each process makes of its
    own process number is another's too now and then, and then they hear each other.

    Raises: DomainError: every domain is in use.
    """
    for k in range(DOMAINS):
        domain, held = 1 + (os.getpid() + k) % DOMAINS, socket.socket()
        try:
            held.bind(("127.0.0.1", LOCKS + domain))
        except OSError:
            held.close()
            continue
        return domain, held
    raise DomainError(f"all {DOMAINS} ROS domains that demos and tests take are in use: end some of those that run")
