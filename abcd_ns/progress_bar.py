"""A progress bar for work that may be over before anybody has looked."""

import time
from collections.abc import Collection, Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

APPEARS_AFTER = 2.0  # seconds of work after which the bar appears

T = TypeVar("T")


class ProgressBar:
    """A progress bar with the time left that appears only when the work takes a while, and goes at its end.

    Args:
        title: what is being done.
        total: how often `advance` will be called.
        console: where to; None is stderr, so that the bar is in no output that is piped on.
    """

    def __init__(self, title: str, total: int, console: Console | None = None) -> None:
        console = console or Console(stderr=True)
        self._progress = Progress(console=console, transient=True, disable=not console.is_terminal)
        self._task = self._progress.add_task(title, total=total)
        self._start = time.monotonic()

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress.live.is_started:
            self._progress.stop()

    def advance(self) -> None:
        """One more is done."""
        self._progress.advance(self._task)
        if not self._progress.live.is_started and time.monotonic() - self._start > APPEARS_AFTER:
            self._progress.start()


def tracked(items: Iterable[T], title: str, total: int | None = None) -> Iterator[T]:
    """The items one by one, each of them some work, with a `ProgressBar`.

    Args:
        total: their number, where they are no collection.
    """
    if total is None and isinstance(items, Collection):
        total = len(items)
    with ProgressBar(title, total or 0) as bar:
        for item in items:
            yield item
            bar.advance()
