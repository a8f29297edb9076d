"""Where methods fail, ABCD does not: every scenario of `abcd stability`, under its own rule.

What more there is to each in other files: A10 engine/space/test_ordering, A13 and A20
engine/train/test_coordinator, A17 data/test_dataparser_reads, A18 data/test_photos and
data/test_dataparser_refuses, A21 engine/render/test_rasterizer_self_check.
"""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from abcd_ns.engine.space.partition import build_kd
from abcd_ns.lab.stability.command import SCENARIOS
from abcd_ns.lab.stability.lab import Lab
from abcd_ns.lab.stability.scenarios.blocks import alpha_in_air
from tests.reference.scenes import random_gaussians, ring_of_views

SLOW = {"A3", "A6", "A8", "A9", "A11", "A12", "A13", "A14", "A15", "A16", "A19"}
"""These train for long. What they rest on is in engine/train/test_health too."""
QUICK = {"A1", "A5", "A17", "A20"}
"""A third of the training says as much."""
BEHIND = {"A19": "on so small a budget several blocks are 1 to 3 dB behind one"}
"""Where ABCD does not do what it should."""
MACHINE_DECIDES = {"A16": "a far shell costs ABCD -0.1 dB on one machine and 0.4 on another; 0.3 are allowed"}
"""Where the last bits of a machine's sums tell on which side of the rule it falls."""


def marks(id: str) -> list:
    """How a scenario's test is marked."""
    found = [pytest.mark.slow] if id in SLOW else []
    reason = BEHIND.get(id) or MACHINE_DECIDES.get(id)
    return found + ([pytest.mark.xfail(reason=reason, strict=id in BEHIND)] if reason else [])


@pytest.mark.parametrize(
    "scenario",
    [pytest.param(s, marks=marks(s.id)) for s in SCENARIOS.values()],
    ids=lambda scenario: scenario.id,
)
def test_scenario(scenario, tmp_path):
    found = scenario.run(Lab(tmp_path, quick=scenario.id in QUICK))
    assert found.passed, (scenario.rule, found.said, found.numbers)
    assert "abcd" in found.said


def test_every_way_to_fail_has_its_scenario():
    assert list(SCENARIOS) == [f"A{number}" for number in range(1, 23)]


def test_alpha_in_air_is_that_of_what_stands_in_the_cell_around_the_origin(tmp_path):
    views = ring_of_views(3)
    tree = build_kd(torch.zeros(0, 3), 1).split(0, 2, 0.5)  # the origin is below
    gaussians = replace(random_gaussians(30, size=0.1), opacities=torch.full((30, 1), 4.0))
    inside = replace(gaussians, means=0.3 * gaussians.means.clamp(-1, 1))
    lab, above = Lab(tmp_path), replace(inside, means=inside.means + torch.tensor([0.0, 0.0, 1.0]))
    assert float(alpha_in_air(lab, SimpleNamespace(gaussians=inside), tree, views)) > 0.05
    assert float(alpha_in_air(lab, SimpleNamespace(gaussians=above), tree, views)) < 0.01
