"""Blocks that can be told apart, and disks that fail, can be watched, and held up."""

import errno
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch

from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.scene import StoredScene

PATIENCE = 20.0
"""Seconds."""


def block(rows: int, value: float = 0.0) -> tuple[dict[str, torch.Tensor], dict]:
    """The tensors and JSON of a block that can be told from others by `value`."""
    tensors = {
        "means": torch.arange(3.0 * rows).reshape(rows, 3) + value,
        "features_rest": torch.full((rows, 15, 3), value),
        "step": torch.tensor(int(value)),
    }
    return tensors, {"value": value, "rows": rows}


def assert_block(store: ParameterStore, number: int, rows: int, value: float) -> None:
    tensors, meta = store.load(number)
    expected, expected_meta = block(rows, value)
    assert meta == expected_meta
    assert tensors.keys() == expected.keys()
    assert all(torch.equal(tensors[name], expected[name]) for name in expected)
    assert store.counts(number) == rows


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


class FailAt:
    """Calls `original`, but the n-th call (counted from 1), or each from then on, raises OSError."""

    def __init__(self, original, n: int, persistent: bool = False, code: int = errno.EIO):
        self.original, self.n, self.persistent, self.calls, self.code = original, n, persistent, 0, code

    def __call__(self, *args, **kwargs):
        self.calls += 1
        if self.calls == self.n or (self.persistent and self.calls > self.n):
            raise OSError(self.code, "injected")
        return self.original(*args, **kwargs)


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
    """The run's state, as the store has it when it is opened."""
    return ParameterStore.open(scene.store.folder, read_only=True).state


def wait_until(condition: Callable[[], bool]) -> None:
    """Of what another thread does."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
