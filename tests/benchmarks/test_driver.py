"""What the driver does for a visit is measured on a block that is a real one, only small."""

from benchmarks.driver import NEIGHBOURS, Args, limits, measure


def test_a_small_block_is_measured(tmp_path):
    seconds, block, drawn = measure(Args(gaussians=50, visits=2), tmp_path)
    assert len(seconds) == 3
    assert all(value > 0 for value in seconds.values())
    gaussians = drawn // (4 * 59)
    assert 40 <= gaussians <= 60
    assert block >= 3 * drawn  # with both moments


def test_what_a_visit_asks_for_adds_up():
    asked = limits(700, 200)
    assert {nbytes for _, nbytes in asked.values()} == {700, 1400 + NEIGHBOURS * 200}
