"""What benchmarks share: runs of ns-train's trainer, in processes of their own, and results, as JSON."""

import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns.lab.job import Job, Settings
from abcd_ns.lab.runs.configs import trainer_config
from abcd_ns.machine import describe_machine, describe_versions, threads_wanted


def write_runs(out: Path | None, asked: Mapping[str, Any], runs: Sequence[Any]) -> None:
    """Write what was found beside what was asked for, the machine and the versions; nothing without `out`.

    Args:
        runs: a dataclass each.
    """
    if out is None:
        return
    told = {"machine": asdict(describe_machine()), "versions": asdict(describe_versions())}
    found = {**told, **asked, "runs": [asdict(run) for run in runs]}
    out.write_text(json.dumps(found, indent=1) + "\n")


def apart(work: Callable, *args: Any) -> Any:
    """What a function returns, called in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *args).result()  # raises if the process was killed


def config_of(
    data: Path,
    out: Path,
    *,
    downscale: int,
    blocks: int,
    seed: int,
    workers: int = 1,
    steps: int | None = None,
    seconds: float | None = None,
) -> TrainerConfig:
    """That of a run of `abcd compare`, with workers."""
    unasked = {"evals": 1, "max_gaussians": 0, "densify": True, "pictures": 0}
    settings = Settings(str(data), downscale, blocks, seconds, steps, **unasked)
    config = trainer_config(Job("abcd", seed, settings), out)
    config.pipeline.workers = workers
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    return config


class StageClock:
    """Seconds by stage, each until the device has done its work; those of a stage within another one are its
    own alone."""

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
