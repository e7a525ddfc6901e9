"""ROS domains that processes of this machine take for themselves."""

import os
import subprocess
import sys

import pytest

from stmpl_ros import domain
from stmpl_ros.domain import DOMAINS, DomainError, claim

CLAIM = "from stmpl_ros.domain import claim; print(claim()[0])"


def test_no_two_hold_one_domain_and_what_is_let_go_is_free():
    taken, command = [claim() for _ in range(3)], (sys.executable, "-c", CLAIM)
    others = [int(subprocess.run(command, capture_output=True, text=True).stdout) for _ in range(2)]
    numbers = [number for number, _ in taken]
    assert len({*numbers, int(os.environ["ROS_DOMAIN_ID"])}) == 4 and not {*numbers} & {*others}
    assert all(1 <= number <= DOMAINS for number in (*numbers, *others))
    for _, held in taken:
        held.close()
    again, held = claim()
    held.close()
    assert again == numbers[0]


def test_when_none_is_free_that_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(domain, "DOMAINS", 0)
    with pytest.raises(DomainError, match="end some of those"):
        claim()
