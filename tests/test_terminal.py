"""What a terminal shows: a progress bar that stays away from what is soon over, and bytes in GiB and MiB."""

import io

import pytest
from rich.console import Console

from abcd_ns import progress_bar
from abcd_ns.progress_bar import ProgressBar
from abcd_ns.units import GIB, MIB, bytes_in_words


@pytest.mark.parametrize(("after", "shown"), [(-1.0, True), (1e9, False)])
def test_it_appears_only_when_work_takes_long(monkeypatch, after, shown):
    monkeypatch.setattr(progress_bar, "APPEARS_AFTER", after)
    stream = io.StringIO()
    with ProgressBar("Counting sheep", 3, Console(file=stream, force_terminal=True)) as bar:
        for _ in range(3):
            bar.advance()
    assert ("Counting sheep" in stream.getvalue()) == shown


def test_it_is_not_in_output_that_is_piped_on(monkeypatch, capsys):
    monkeypatch.setattr(progress_bar, "APPEARS_AFTER", -1.0)
    with ProgressBar("Counting sheep", 1) as bar:
        bar.advance()
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (0, "0 MiB"),
        (50_000, "0.048 MiB"),
        (1.44 * MIB, "1.4 MiB"),
        (9.96 * MIB, "10 MiB"),
        (10.5 * MIB + 1, "11 MiB"),
        (GIB - MIB, "1023 MiB"),
        (GIB, "1.0 GiB"),
        (24.26 * GIB, "24.3 GiB"),
    ],
)
def test_bytes_in_words(count, words):
    assert bytes_in_words(count) == words
