"""Where methods fail, ABCD does not: every scenario of `abcd stability`, under its own rule."""

import pytest

from abcd_ns.lab.stability.command import SCENARIOS
from abcd_ns.lab.stability.lab import Lab


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=lambda scenario: scenario.id)
def test_scenario(scenario, tmp_path):
    found = scenario.run(Lab(tmp_path))
    assert found.passed, (scenario.rule, found.said, found.numbers)
    assert "abcd" in found.said
