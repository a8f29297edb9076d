"""What tests of the laboratory share."""

import pytest

from abcd_ns.lab.results import style
from abcd_ns.lab.runs import runner
from tests.lab.compare.fake_worker import FakeWorker
from tests.lab.compare.records import MACHINE


@pytest.fixture(autouse=True)
def _coarse_charts(monkeypatch):
    """Drawing dots that nobody looks at would take most of these tests' time."""
    monkeypatch.setattr(style, "DPI", 100)


@pytest.fixture
def worker(tmp_path, monkeypatch) -> FakeWorker:
    """Does the jobs of experiments."""
    fake = FakeWorker(tmp_path / "worker")
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(runner, "command_of", lambda job: fake.command)  # noqa: ARG005
    monkeypatch.setattr("abcd_ns.lab.runs.experiment.describe_machine", lambda: MACHINE)
    return fake
