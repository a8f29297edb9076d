"""What benchmarks share: a capture, a clock of stages, and the line that says where they ran."""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from abcd_ns.data.photos import Photos
from abcd_ns.errors import UserError
from abcd_ns.lab.stability.lab import Stage
from abcd_ns.machine import describe_machine, threads_wanted
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.views import training_views


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


def read_stage(data: Path, downscale: int) -> Stage:
    """A capture as `ns-train abcd --data` reads it; every 8th view held out. All photos are kept in RAM;
    masks and alpha channels are left aside.

    Raises:
        UserError: it cannot be used; the message says why.
    """
    parser = AbcdDataParserConfig(data=data, downscale_factor=downscale).setup()
    train, test = (parser.get_dataparser_outputs(split) for split in ("train", "test"))
    pictures = []
    for outputs in (train, test):
        photos = Photos(outputs.metadata["photos"])
        pictures.append([photos.image(row)[..., :3].float() / 255 for row in range(len(photos.sources))])
    points = train.metadata.get("points3D_xyz")
    if points is None:
        raise UserError(f"{data} has no points to begin with.")
    views = training_views(train.cameras, points)
    held_out = training_views(test.cameras, points, views[0].near)
    photos, colors = dict(enumerate(pictures[0])), train.metadata["points3D_rgb"].float()
    return Stage(views, photos, points.double(), colors, held_out, pictures[1])
