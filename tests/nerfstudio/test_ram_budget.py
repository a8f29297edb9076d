"""The RAM budget is shared out whole, and fits the machine; what it does to a run is in test_resume.py."""

import psutil
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.nerfstudio.ram_budget import budget_bytes, share_out


@given(st.integers(0, 2**50))
def test_shares_add_up(budget):
    shares = share_out(budget)
    assert sum(vars(shares).values()) == budget
    assert min(vars(shares).values()) >= 0


def test_the_automatic_budget_is_a_part_of_the_machines():
    automatic = budget_bytes(0.0)
    assert 0 < automatic <= min(8 * 2**30, psutil.virtual_memory().total // 2)


def test_a_budget_can_be_given():
    assert budget_bytes(1.5) == 3 * 2**29
