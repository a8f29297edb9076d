"""Where methods fail, ABCD does not: every scenario of `abcd stability`, under its own rule.

What more there is to each in other files: A10 engine/test_ordering, A13 engine/test_coordinator, A17
plugin/test_dataparser_reads, A18 plugin/test_photos and plugin/test_dataparser_refuses, A20
engine/test_coordinator, A21 engine/test_rasterizer_self_check.
"""

import pytest

from abcd_ns.tools.stability.catalogue import SCENARIOS
from abcd_ns.tools.stability.lab import Lab

SLOW = {"A11", "A12", "A14", "A15", "A16", "A19"}
"""These compare three trained scenes, which takes minutes where nothing is compiled."""


@pytest.mark.parametrize(
    "scenario",
    [pytest.param(s, marks=[pytest.mark.slow] * (s.id in SLOW)) for s in SCENARIOS.values()],
    ids=lambda scenario: scenario.id,
)
def test_scenario(scenario, tmp_path):
    found = scenario.run(Lab(tmp_path, compile="never"))
    assert found.passed, (scenario.rule, found.said, found.numbers)
    assert "abcd" in found.said


def test_every_way_to_fail_has_its_scenario():
    assert list(SCENARIOS) == [f"A{number}" for number in range(1, 23)]
