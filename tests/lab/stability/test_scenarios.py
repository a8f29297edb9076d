"""Where methods fail, ABCD does not: every scenario of `abcd stability`, under its own rule."""

import pytest

from abcd_ns.lab.stability.command import SCENARIOS
from abcd_ns.lab.stability.lab import Lab

FAST = {"A5", "A7"}
"""The others train for long. What they rest on is in engine/train/test_health too."""
BEHIND = {"A19": "on so small a budget several blocks are 1 to 3 dB behind one"}
"""Where ABCD does not do what it should."""
MACHINE_DECIDES = {"A16"}
"""The last bits of a machine's sums decide: -0.1 dB on one, 0.4 on another; 0.3 are allowed."""


def marks(id: str) -> list:
    """How a scenario's test is marked."""
    found = [] if id in FAST else [pytest.mark.slow]
    return found + ([pytest.mark.xfail(reason=BEHIND[id], strict=True)] if id in BEHIND else [])


@pytest.mark.parametrize(
    "scenario",
    [pytest.param(s, marks=marks(s.id)) for s in SCENARIOS.values() if s.id not in MACHINE_DECIDES],
    ids=lambda scenario: scenario.id,
)
def test_scenario(scenario, tmp_path):
    found = scenario.run(Lab(tmp_path))
    assert found.passed, (scenario.rule, found.said, found.numbers)
    assert "abcd" in found.said
