import errno
from pathlib import Path

import torch

from abcd_ns.engine.store import ParameterStore


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
