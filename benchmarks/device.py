"""What training asks of an accelerator whatever its speed: launches, waits, copies; on a simulated one.

    python -m benchmarks.device --blocks 1 8 --out device.json

Trains a small procedural scene by the engine, with gsplat's rasterizer, on a device that is CPU memory (see
tests/reference/simulated_device.py), and counts. Nothing is downloaded and no GPU is needed.

What the figures mean: a wait is a point where the host can launch nothing before the device has done all
that it was given, so each costs what the device has left to do; copies that block are waits, too. So are the
events by which a step's numbers are read while the next one runs, though these may find the device done. A
launch is one operation of torch's, or one function of gsplat's, which may be several kernels on CUDA. Steps
are those within a visit, plain ones those of them that neither grow nor prune; what is done when a visit
begins (survey, attach, layers) and ends (settle, commit) is counted apart, a visit at a time. Layer copies
are those that are made while layers are kept and read back. Peak bytes are those of live tensors.

What they do not mean: there are no seconds of an accelerator here, no speed of its memory, and no fraction of
its cores that such small pictures would keep busy. Counts of waits and launches hardly depend on the scene's
size; bytes do.
"""

import json
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import tyro

from abcd_ns.engine.layers.layer_store import LayerStore
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.results.tables import markdown
from abcd_ns.machine import describe_versions
from tests.reference.device_counts import Counts
from tests.reference.gsplat_stand_ins import lent
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views
from tests.reference.simulated_device import DEVICE, simulated_device

GROWS = DensityConfig(refine_start=0.0, refine_stop=1.0, refine_every=4, split_pixels=0.0)
"""Refines often, so that steps that do are among those counted."""
MOST_PLACES = 12


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


@dataclass
class Tally:
    """What is counted of one kind of work."""

    times: int = 0
    counts: Counts = field(default_factory=Counts)

    def add(self, counts: Counts) -> None:
        self.times += 1
        self.counts = self.counts.plus(counts)

    def each(self, unit: str) -> dict[str, float]:
        """Means, each named for the `unit` that it is of."""
        times, counts = max(self.times, 1), self.counts
        values = {
            "waits": counts.waited,
            "waits_in_isect_tiles": counts.waits["isect_tiles"],
            "copies_to_host": counts.copies_to_host,
            "copies_to_device": counts.copies_to_device,
            "bytes_to_host": counts.bytes_to_host,
            "bytes_to_device": counts.bytes_to_device,
            "launches": counts.launches,
        }
        return {f"{name}_per_{unit}": round(value / times, 2) for name, value in values.items()}


class Watch:
    """Sorts what the device counts: steps, visits' beginnings and ends, and layers."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self.steps, self.plain, self.visits, self.layers = Tally(), Tally(), Tally(), Tally()
        self._refined = False

    def layers_in(self) -> AbstractContextManager:
        """Count the copies that LayerStore makes, whoever calls it."""
        counted = {name: self._counted(getattr(LayerStore, name)) for name in ("put", "get")}
        return mock.patch.multiple(LayerStore, **counted)

    def _counted(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any) -> Any:
            before = self._counts.copy()
            result = method(*args)
            self.layers.add(self._counts.since(before))
            return result

        return counted

    def take_step(self, coordinator: Coordinator, photos: Photos) -> None:
        """A step of training; whatever a visit's beginning or end adds to it is that visit's."""
        edges: list[Counts] = []
        begin, end = coordinator.begin_visit, coordinator.end_visit

        def apart(method: Callable[[], None]) -> None:
            before = self._counts.copy()
            method()
            edges.append(self._counts.since(before))

        before, self._refined = self._counts.copy(), False
        parted = {"begin_visit": partial(apart, begin), "end_visit": partial(apart, end)}
        with mock.patch.multiple(coordinator, **parted):
            train_step(coordinator, photos)
        taken = self._counts.since(before)
        for edge in edges:
            taken = taken.since(edge)
            self.visits.add(edge)
        self.steps.add(taken)
        if not self._refined:
            self.plain.add(taken)

    def refinements_in(self) -> AbstractContextManager:
        """Notice which steps refine, or reset opacities."""
        original = DensityControl._step_default

        def noticed(*args: Any) -> Any:
            self._refined = True
            return original(*args)

        return mock.patch.object(DensityControl, "_step_default", noticed)


def scene(args: Args) -> tuple[Gaussians, list[View], Photos]:
    """What a run begins with, and the photos of another scene to train it on."""
    views = ring_of_views(args.views, width=args.width, height=3 * args.width // 4)
    truth = random_gaussians(args.gaussians, seed=args.seed + 7, size=0.1)
    return random_gaussians(args.gaussians, seed=args.seed + 1, size=0.08), views, Photos(truth, views)


def run(args: Args, blocks: int, folder: Path) -> dict[str, Any]:
    """Train once; what was counted."""
    start, views, photos = scene(args)
    began = time.perf_counter()
    with simulated_device() as counts, lent():
        rasterizer = make_rasterizer("auto", DEVICE)
        options = {"steps": args.steps, "seed": args.seed, "density": GROWS, "warmup": 0.0}
        options["commit_seconds"] = 0.0  # the host is slow here: its clock must not count
        coordinator = make_coordinator(
            folder, start, views, blocks=blocks, rasterizer=rasterizer, device=DEVICE, **options
        )
        watch = Watch(counts)
        counts.reset_peak()
        with watch.layers_in(), watch.refinements_in():
            while not coordinator.finished:
                watch.take_step(coordinator, photos)
        visits = max(coordinator.state.visit, 1)
        found = summary(watch, visits)
        found |= {"gaussians": coordinator.count(), "views_in_a_step": coordinator.batch}
        found |= {"peak_bytes": counts.peak_bytes, "ownership": coordinator.config.recipe.ownership}
        coordinator.close()
    return {"blocks": blocks, **found, "host_seconds": round(time.perf_counter() - began, 1)}


def summary(watch: Watch, visits: int) -> dict[str, Any]:
    """Means by step and by visit, and where the steps' waits are."""
    steps, at_edges, layers = watch.steps, Tally(visits, watch.visits.counts), watch.layers.counts
    places = steps.counts.places.most_common(MOST_PLACES)
    return {
        "steps": steps.times,
        "visits": visits,
        **steps.each("step"),
        "plain_steps": watch.plain.times,
        **watch.plain.each("plain_step"),
        **at_edges.each("visit"),
        "layer_copies_per_visit": round((layers.copies_to_host + layers.copies_to_device) / visits, 2),
        "waits_per_step_by_operation": by_step(steps.counts.waits.most_common(), steps.times),
        "waits_per_step_by_place": by_step(places, steps.times),
    }


def by_step(counted: list[tuple[str, int]], steps: int) -> dict[str, float]:
    """The same for each step."""
    return {name: round(count / max(steps, 1), 2) for name, count in counted if count}


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


def table(runs: list[dict[str, Any]]) -> str:
    """For the terminal: a step of each run, and a visit's beginning and end."""
    rows = [["a step", *(f"{each['blocks']} block{'s' * (each['blocks'] > 1)}" for each in runs)]]
    rows += [[title, *(f"{each[key]:,.1f}" for each in runs)] for key, title in COLUMNS.items()]
    return markdown(rows)


def main(args: Args) -> None:
    """Run all, print the table, write the JSON."""
    runs = []
    for blocks in args.blocks:
        with tempfile.TemporaryDirectory() as folder:
            runs.append(run(args, blocks, Path(folder)))
    print(table(runs))
    for each in runs:
        print(f"\nWaits of a step with {each['blocks']}: {each['waits_per_step_by_operation']}")
        print(f"at: {each['waits_per_step_by_place']}")
    scene_of = {"views": args.views, "width": args.width, "gaussians": args.gaussians, "seed": args.seed}
    result = {"runs": runs, "scene": scene_of, "versions": asdict(describe_versions())}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
