"""What benchmarks share: a clock of stages, and the line that says where they ran."""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from abcd_ns.machine import describe_machine, threads_wanted


class StageClock:
    """Seconds by stage, each until the device has done its work. A stage within another counts only once."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._within = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        outer, self._within, start = self._within, 0.0, time.perf_counter()
        yield
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        took = time.perf_counter() - start
        self.seconds[name] += took - self._within
        self._within = outer + took

    def timed(self, name: str, function: Callable) -> Callable:
        """The function as a stage."""

        def call(*args: Any, **options: Any) -> Any:
            with self.stage(name):
                return function(*args, **options)

        return call


def print_machine(*more: str) -> None:
    """A line that says where this was measured, and `more`."""
    machine = f"{describe_machine().cpu}, {os.cpu_count()} cores, {threads_wanted()} threads"
    print(", ".join([machine, f"torch {torch.__version__}", *more]))
