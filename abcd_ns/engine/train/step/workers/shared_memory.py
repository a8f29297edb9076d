"""Gaussians and their gradients in memory that a process shares with those it forks."""

import mmap
from collections.abc import Mapping

import torch
from torch import Tensor

from abcd_ns.engine.types import Gaussians


class SharedRows:
    """Room for tensors by name, each with the same number of rows, which may change up to a limit.

    Anonymous memory: a page takes none before it is written to, and all of it goes with the processes.

    Args:
        widths: by name, the floats of a row.
        rows: the limit.
    """

    def __init__(self, widths: Mapping[str, tuple[int, ...]], rows: int) -> None:
        sizes = {name: rows * torch.Size(shape).numel() for name, shape in widths.items()}
        self.limit = rows
        self._memory = mmap.mmap(-1, max(4 * sum(sizes.values()), mmap.PAGESIZE))
        self._all = torch.frombuffer(self._memory, dtype=torch.float32)
        self._widths, self._starts = dict(widths), {}
        start = 0
        for name, size in sizes.items():
            self._starts[name], start = start, start + size

    @staticmethod
    def like(gaussians: Gaussians, rows: int) -> "SharedRows":
        """Room for each parameter of such Gaussians."""
        return SharedRows({name: tuple(value.shape[1:]) for name, value in gaussians.items()}, rows)

    def rows(self, name: str, count: int) -> Tensor:
        """The first `count` rows, float32, shared: [count, ...].

        Raises:
            ValueError: more rows than the limit.
        """
        if count > self.limit:
            raise ValueError(f"{count} rows, and room for {self.limit}")
        shape = (count, *self._widths[name])
        start = self._starts[name]
        return self._all[start : start + shape[0] * torch.Size(shape[1:]).numel()].view(shape)

    def write(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy tensors in."""
        for name, value in tensors.items():
            self.rows(name, len(value)).copy_(value.detach())
