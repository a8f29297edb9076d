"""What docs/tutorial.md and reference.md say of memory in numbers is what the code says."""

from pathlib import Path

from abcd_ns.engine.train.memory import DeviceNeeds

TUTORIAL = Path(__file__).resolve().parent.parent / "docs" / "tutorial.md"
REFERENCE = TUTORIAL.with_name("reference.md")
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


def test_what_a_gaussian_takes_is_what_the_reference_says():
    takes = [DeviceNeeds(1, batch=1, waiting=3, active_degree=degree).gaussian_bytes for degree in (0, 3)]
    assert "takes {:,} bytes instead of {:,}".format(*takes) in REFERENCE.read_text().replace("\n", " ")
    assert f"up to {takes[1] / takes[0]:.1f} times as many" in TUTORIAL.read_text().replace("\n", " ")


def test_the_table_of_memory_is_that_of_the_model():
    text = TUTORIAL.read_text()
    shown = text.split("<!-- memory:begin -->\n")[1].split("\n<!-- memory:end -->")[0]
    assert shown == memory_table()
