"""A disk that can be watched and held up."""

import threading
import time
from collections.abc import Callable

from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.scene import StoredScene

PATIENCE = 20.0
"""Seconds."""


class Disk:
    """Stands before a store's commits: notes them, and holds them up or refuses them."""

    def __init__(self, store: ParameterStore) -> None:
        self.commits: list[tuple[set[int], dict]] = []
        self.refuses = False
        self.free, self.asked = threading.Event(), threading.Event()
        self.free.set()
        self._commit, store.commit = store.commit, self

    def __call__(self, blocks, header=None, state=None) -> int:
        self.asked.set()
        assert self.free.wait(PATIENCE)
        if self.refuses:
            raise StoreError("the disk is full")
        found = self._commit(blocks, header=header, state=state)
        self.commits.append((set(blocks), state))
        return found


def on_disk(scene: StoredScene) -> dict:
    """The run's state, as whoever opens the store finds it."""
    return ParameterStore.open(scene.store.folder, read_only=True).state


def wait_until(condition: Callable[[], bool]) -> None:
    """Of what another thread does."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
