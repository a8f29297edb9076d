"""What tests of the laboratory share."""

import pytest

from abcd_ns.lab.results import style


@pytest.fixture(autouse=True)
def _coarse_charts(monkeypatch):
    """Drawing dots that nobody looks at would take most of these tests' time."""
    monkeypatch.setattr(style, "DPI", 100)
