"""What training asks of an accelerator whatever its speed: launches, waits, copies; on a simulated one.

    python -m benchmarks.device --blocks 1 8 --out device.json

Trains a small procedural scene by the engine, with gsplat's rasterizer, on a device that is CPU memory (see
tests/reference/simulated_device.py), and counts. Nothing is downloaded and no GPU is needed.

A wait is a point where the host can launch nothing before the device is done; copies that block are waits,
too. A launch is one operation of torch's, or one function of gsplat's, which may be several kernels on CUDA.
Plain steps neither grow nor prune; a visit's beginning and end are counted apart. Layer copies are those of
layers that are kept and read back. Peak bytes are of live tensors. Counts hardly depend on the scene's size.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import reduce
from pathlib import Path
from typing import Any
from unittest import mock

import tyro

from abcd_ns.engine.layers.layer_store import LayerStore
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.lab.results.tables import markdown
from abcd_ns.machine import describe_versions
from tests.reference.device_counts import Counts
from tests.reference.gsplat_stand_ins import lent
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views
from tests.reference.simulated_device import DEVICE, simulated_device

GROWS = DensityConfig(refine_start=0.0, refine_stop=1.0, refine_every=4, split_pixels=0.0)
"""Refines often, so that steps that do are among those counted."""


@dataclass
class Args:
    """What to train, and where to write."""

    out: Path
    """JSON is written there."""
    blocks: tuple[int, ...] = (1, 8)
    """A run with each of these."""
    steps: int = 24
    """Of each run."""
    views: int = 6
    """Training views."""
    gaussians: int = 400
    """To begin with."""
    width: int = 48
    """Of the pictures; three quarters of it high."""
    seed: int = 0
    """Of scene and run."""


class Watch:
    """Sorts what the device counts: steps, visits' beginnings and ends, and the copies of layers."""

    def __init__(self, counts: Counts) -> None:
        self._counts, self._refined = counts, False
        self.steps: list[Counts] = []
        self.plain: list[Counts] = []
        self.edges: list[Counts] = []
        """Of visits."""
        self.layers: list[Counts] = []

    def noting(self, method: Callable[..., Any], found: list[Counts]) -> Callable[..., Any]:
        """The method, what it costs added to `found`."""

        def noted(*args: Any) -> Any:
            before = self._counts.copy()
            result = method(*args)
            found.append(self._counts.since(before))
            return result

        return noted

    @contextmanager
    def watching(self, coordinator: Coordinator) -> Iterator[None]:
        """Count layers, visits' ends and refinements, whatever calls them."""
        layers = {name: self.noting(getattr(LayerStore, name), self.layers) for name in ("put", "get")}
        ends = {n: self.noting(getattr(coordinator, n), self.edges) for n in ("begin_visit", "end_visit")}
        refine = DensityControl._step_default

        def refined(*args: Any) -> Any:
            self._refined = True
            return refine(*args)

        with (
            mock.patch.multiple(LayerStore, **layers),
            mock.patch.multiple(coordinator, **ends),
            mock.patch.object(DensityControl, "_step_default", refined),
        ):
            yield

    def take_step(self, coordinator: Coordinator, photos: Photos) -> None:
        """A step of training; whatever a visit's beginning or end adds to it is that visit's."""
        self._refined, known, taken = False, len(self.edges), []
        self.noting(train_step, taken)(coordinator, photos)
        for edge in self.edges[known:]:
            taken[0] = taken[0].since(edge)
        self.steps += taken
        self.plain += [] if self._refined else taken


def total(counted: list[Counts]) -> Counts:
    """Of all."""
    return reduce(Counts.plus, counted, Counts())


def means(counts: Counts, times: int, unit: str) -> dict[str, float]:
    """Means, each named for the `unit` that it is of."""
    values = {
        "waits": counts.waited,
        "waits_in_isect_tiles": counts.waits["isect_tiles"],
        "copies_to_host": counts.copies_to_host,
        "copies_to_device": counts.copies_to_device,
        "bytes_to_host": counts.bytes_to_host,
        "bytes_to_device": counts.bytes_to_device,
        "launches": counts.launches,
    }
    return {f"{name}_per_{unit}": round(value / max(times, 1), 2) for name, value in values.items()}


def run(args: Args, blocks: int, folder: Path) -> dict[str, Any]:
    """Train once on the photos of another scene; what was counted."""
    views = ring_of_views(args.views, width=args.width, height=3 * args.width // 4)
    photos = Photos(random_gaussians(args.gaussians, seed=args.seed + 7, size=0.1), views)
    start = random_gaussians(args.gaussians, seed=args.seed + 1, size=0.08)
    options = {"steps": args.steps, "seed": args.seed, "density": GROWS, "warmup": 0.0}
    options["commit_seconds"] = 0.0  # the host is slow here: its clock must not count
    with simulated_device() as counts, lent():
        options |= {"rasterizer": make_rasterizer("auto", DEVICE), "device": DEVICE}
        coordinator = make_coordinator(folder, start, views, blocks=blocks, **options)
        watch = Watch(counts)
        counts.reset_peak()
        with watch.watching(coordinator):
            while not coordinator.finished:
                watch.take_step(coordinator, photos)
        found = {"blocks": blocks, **summary(watch, max(coordinator.state.visit, 1))}
        found |= {"gaussians": coordinator.count(), "views_in_a_step": coordinator.batch}
        found["peak_bytes"] = counts.peak_bytes
        coordinator.close()
    return found


def summary(watch: Watch, visits: int) -> dict[str, Any]:
    """Means by step and by visit, and where the steps' waits are."""
    steps, layers, taken = total(watch.steps), total(watch.layers), len(watch.steps)
    return {
        "steps": taken,
        "visits": visits,
        **means(steps, taken, "step"),
        "plain_steps": len(watch.plain),
        **means(total(watch.plain), len(watch.plain), "plain_step"),
        **means(total(watch.edges), visits, "visit"),
        "layer_copies_per_visit": round((layers.copies_to_host + layers.copies_to_device) / visits, 2),
        "waits_per_step_by_operation": {
            name: round(count / taken, 2) for name, count in steps.waits.most_common() if count
        },
    }


COLUMNS = {
    "waits_per_step": "waits",
    "waits_per_plain_step": "waits where nothing is refined",
    "waits_in_isect_tiles_per_plain_step": "of these in isect_tiles",
    "launches_per_step": "launches",
    "copies_to_host_per_step": "copies to host",
    "copies_to_device_per_step": "copies to device",
    "bytes_to_device_per_step": "bytes to device",
    "waits_per_visit": "waits a visit",
    "layer_copies_per_visit": "layer copies a visit",
}


def main(args: Args) -> None:
    """Run all, print the table, write the JSON."""
    runs = []
    for blocks in args.blocks:
        with tempfile.TemporaryDirectory() as folder:
            runs.append(run(args, blocks, Path(folder)))
    rows = [["a step", *(f"{each['blocks']} block{'s' * (each['blocks'] > 1)}" for each in runs)]]
    rows += [[title, *(f"{each[key]:,.1f}" for each in runs)] for key, title in COLUMNS.items()]
    print(markdown(rows))
    scene_of = {"views": args.views, "width": args.width, "gaussians": args.gaussians, "seed": args.seed}
    result = {"runs": runs, "scene": scene_of, "versions": asdict(describe_versions())}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
