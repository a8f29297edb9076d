"""What docs/tutorial.md says in numbers is what the code says."""

from pathlib import Path

from abcd_ns.engine.train.memory import DeviceNeeds

TUTORIAL = Path(__file__).resolve().parent.parent / "docs" / "tutorial.md"
BUDGETS = (4, 6, 8, 12, 24)
"""GiB."""
PHOTOS = (1, 2, 8)
"""Megapixels."""


def memory_table() -> str:
    """Millions of Gaussians in a block; a dash where not even a small one fits."""
    lines = [
        "| photos | " + " | ".join(f"{budget} GiB" for budget in BUDGETS) + " |",
        "| --- |" + " ---: |" * len(BUDGETS),
    ]
    for megapixels in PHOTOS:
        needs = DeviceNeeds(megapixels * 10**6, batch=1, waiting=3)
        limits = [needs.block_limit(budget << 30) / 1e6 for budget in BUDGETS]
        cells = [f"{limit:.1f} million" if limit > 0 else "-" for limit in limits]
        lines.append(f"| {megapixels} megapixels | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def test_the_table_of_memory_is_that_of_the_model():
    text = TUTORIAL.read_text()
    shown = text.split("<!-- memory:begin -->\n")[1].split("\n<!-- memory:end -->")[0]
    assert shown == memory_table()
