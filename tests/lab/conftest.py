from pathlib import Path

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from abcd_ns.lab.results import style
from abcd_ns.lab.runs import runner
from tests.lab.compare.fake_worker import FakeWorker
from tests.lab.compare.records import MACHINE


@pytest.fixture(autouse=True)
def _coarse_charts(monkeypatch):
    """Drawing dots that nobody looks at would take most of these tests' time."""
    monkeypatch.setattr(style, "DPI", 100)


@pytest.fixture
def drawn(monkeypatch) -> dict[str, list[str]]:
    """By file, what stands in the charts that were saved, piece by piece."""
    found, save = {}, Figure.savefig

    def note(figure: Figure, path: Path, **options) -> None:
        save(figure, path, **options)
        found[path.name] = [text.get_text() for text in figure.findobj(Text)]

    monkeypatch.setattr(Figure, "savefig", note)
    return found


@pytest.fixture
def worker(tmp_path, monkeypatch) -> FakeWorker:
    fake = FakeWorker(tmp_path / "worker")
    monkeypatch.setattr(runner, "command_of", lambda job: fake.command)  # noqa: ARG005
    monkeypatch.setattr("abcd_ns.lab.runs.runner.describe_machine", lambda: MACHINE)
    return fake
