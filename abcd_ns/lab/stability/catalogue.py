"""All scenarios, in the order of their numbers."""

from abcd_ns.lab.stability import borders, cameras, captures, emptiness, freshness, growth, sizes, values
from abcd_ns.lab.stability.outcome import Scenario

_MODULES = (values, sizes, emptiness, growth, cameras, captures, freshness, borders)
SCENARIOS: dict[str, Scenario] = {
    scenario.id: scenario
    for scenario in sorted(
        (scenario for module in _MODULES for scenario in module.SCENARIOS),
        key=lambda scenario: int(scenario.id[1:]),
    )
}
"""By id, A1 to A22."""
