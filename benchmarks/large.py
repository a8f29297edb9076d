"""What a visit costs in a town of few blocks and in one of many.

    python -m benchmarks.large --out FILE.json

Blocks are of equal size. Cameras stand in the streets, houses hide each other, hills are the horizon. Nothing
is trained before: what a visit costs does not depend on it. Blocks and pictures are small. Gaussians are as
large as in a block of BLOCK. Room for layers and the tiles' slack are as on pictures `modelled` px wide.
"""

import json
import math
import multiprocessing
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import psutil
import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.gaussians.param_swap import nothing_active
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, Loaded
from abcd_ns.engine.render import CutShot
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.influence import Influence
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.train import visit_training
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.memory import LAYER_SHARE, needs_of
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step import layer_source
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.world.world import camera
from abcd_ns.machine import disk_bytes
from abcd_ns.run.begin import Capture, begin_run
from abcd_ns.run.options import RunOptions
from abcd_ns.run.store import Start
from abcd_ns.units import GIB
from benchmarks.runs import StageClock, print_machine

PITCH, HALF = 72.0, 26.0
"""From house to house, and half a house, metres."""
EYE = 2.0
"""Height of the cameras, metres."""
PARAMETERS = 236
"""Bytes of a Gaussian."""
STAGES = ("plan", "reading", "loading", "drawing", "folding, and Python", "steps", "commit")
"""Of a visit; the middle four are its layers."""
CARD = 24 << 30
"""Bytes of the card in the model."""
BLOCK = 250_000
"""Gaussians of a block in the model."""
DISK, BUS = 2e9, 12e9
"""Bytes a second of its disk, and to its card."""
DRAW, SHOW = 3e-9, 1e-9
"""Seconds for a Gaussian, and for a pixel, that are drawn without gradients."""
STEP, LAUNCHES = 4, 5e-3
"""A step's drawings take so many times as long, and so many seconds in any case."""


@dataclass
class Args:
    """What to measure."""

    blocks: tuple[int, ...] = (8, 200)
    """Of each town."""
    gaussians: int = 300
    """Of a block."""
    views: int = 25
    """For each block."""
    most_views: int = 5000
    """Of a town."""
    visits: int = 3
    """That are measured, after one that is not."""
    width: int = 192
    """Of a picture, px; its height is two thirds."""
    modelled: int = 1600
    """Width of the pictures that the room for layers is modelled on, px."""
    cached: int = 32
    """Blocks that have room in RAM."""
    out: Path | None = None
    """Gets all numbers."""


class Town:
    """A house for each block."""

    def __init__(self, blocks: int, args: Args) -> None:
        self.rows = max(n for n in range(1, math.isqrt(blocks) + 1) if blocks % n == 0)
        self.size = torch.tensor([blocks // self.rows, self.rows]) * PITCH
        self.args, self.blocks = args, blocks
        self._random = torch.Generator().manual_seed(0)
        self.heights = 10 + 20 * self._uniform(blocks)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self._random)

    def points(self) -> Float[Tensor, "n 3"]:
        """On walls (four fifths), roofs and streets, and on the hills."""
        count = self.blocks * self.args.gaussians
        house = torch.arange(count) % self.blocks
        corner = torch.stack((house // self.rows, house % self.rows), dim=1) * PITCH
        at = PITCH * self._uniform(count, 2)
        high = torch.where(((at - PITCH / 2).abs() < HALF).all(dim=1), self.heights[house], 0.0)
        side = torch.stack((torch.full((count,), HALF), HALF * (2 * self._uniform(count) - 1)), dim=1)
        side = side * torch.where(self._uniform(count, 1) < 0.5, 1.0, -1.0)
        side = torch.where(self._uniform(count, 1) < 0.5, side, side.flip(1)) + PITCH / 2
        is_wall = self._uniform(count) < 0.8
        at = torch.where(is_wall[:, None], side, at)
        high = torch.where(is_wall, self.heights[house] * self._uniform(count), high)
        places = torch.cat((corner + at, high[:, None]), dim=1)
        far, angle = float(self.size.norm()), 2 * math.pi * self._uniform(count // 50)
        hills = torch.stack((angle.cos(), angle.sin(), 0.2 * self._uniform(len(angle))), dim=1) * (far + 500)
        places[: len(hills)] = hills + torch.cat((self.size / 2, torch.zeros(1)))
        return places

    def gaussians(self) -> Gaussians:
        """Opaque ones with all their harmonics."""
        points = self.points()
        found = cloud_from_points(points, 255 * self._uniform(len(points), 3)).gaussians()
        rest = 0.02 * torch.randn(found.features_rest.shape, generator=self._random)
        scales = found.scales + math.log(self.args.gaussians / BLOCK) / 2
        opaque = torch.full_like(found.opacities, 3.0)
        return replace(found, scales=scales, features_rest=rest, opacities=opaque)

    def views(self) -> list[View]:
        """Along the streets, most of them looking that way."""
        views, size = [], (self.args.width, self.args.width * 2 // 3)
        for index in range(min(self.args.views * self.blocks, self.args.most_views)):
            along = int(self._uniform(1) < 0.5)
            lanes = int(self.size[1 - along] / PITCH) + 1
            eye = [0.0, 0.0, EYE]
            eye[along] = float(self.size[along] * self._uniform(1))
            eye[1 - along] = PITCH * int(lanes * self._uniform(1)) + 4 * float(self._uniform(1) - 0.5)
            turn = math.pi / 2 * along + math.pi * int(2 * self._uniform(1)) + float(self._uniform(1) - 0.5)
            target = (eye[0] + math.cos(turn), eye[1] + math.sin(turn), EYE + 0.1)
            views.append(camera(eye, target, index, size, focal=0.7))
        return views

    def influence(self, tree: BlockTree, views: list[View]) -> Influence:
        """By where rays meet a house, or the hills: what a warm-up would know."""
        found, tan = Influence(), torch.linspace(-0.45, 0.45, 4)
        rays = torch.cartesian_prod(torch.linspace(-0.7, 0.7, 24), tan, torch.ones(1))
        steps = torch.cat((torch.arange(1.0, 400.0, 2.0), self.size.norm()[None] + 500))
        for view in views:
            at = view.center + steps[:, None, None] * (rays @ view.viewmat[:3, :3])
            in_town = ((at[..., :2] > 0) & (at[..., :2] < self.size)).all(dim=2)
            stops = in_town & ((at[..., :2] % PITCH - PITCH / 2).abs() < HALF).all(dim=2)
            stops |= (at[..., 2] < 0) | (steps == steps[-1])[:, None]
            ends = at[stops.int().argmax(dim=0), torch.arange(len(rays))]
            for block, count in enumerate(tree.assign(ends).bincount().tolist()):
                if count:
                    found.setdefault(block, {})[view.index] = count / len(rays)
        return found


def options(blocks: int, args: Args) -> RunOptions:
    """Of a run that does not grow, whose nodes are as a card holds them, with a cache for some of them."""
    needs = needs_of(TrainingConfig(), args.modelled**2 * 2 // 3, blocks)
    training = TrainingConfig(
        recipe=Recipe(sh_ramp=0),
        limits=Limits(pass_gaussians=needs.frozen_beside(BLOCK) * args.gaussians // BLOCK),
        warmup=0,
        batch=4,
        density=DensityConfig(max_gaussians=blocks * args.gaussians),
    )
    ram = 4 * args.cached * args.gaussians * PARAMETERS / GIB
    return RunOptions(training, blocks=blocks, workers=1, ram_budget_gb=ram)


class Small(TorchRasterizer):
    """Reaches as far around as a card's tiles do on pictures `times` as large."""

    def __init__(self, times: float) -> None:
        super().__init__()
        self._slack = (self.primitive.blur_pixels + 16 / math.sqrt(2)) / times

    @property
    def slack(self) -> float:
        """See Rasterizer."""
        return self._slack


def begin(town: Town, folder: Path, start: Start | None = None) -> Coordinator:
    """A run that begins, or resumes."""
    views, device, args = town.views(), torch.device("cpu"), town.args
    names = [Path(str(view.index)) for view in views]
    capture = Capture(views, names, lambda _: None, town.gaussians, town.blocks * args.gaussians)
    empty, budget = nothing_active(3), Budget(steps=10**7)
    run = options(town.blocks, args), capture, device, folder, budget
    return begin_run(*run, Small(args.modelled / args.width), *empty, lambda _: None, None, start)


def make(blocks: int, args: Args, folder: Path) -> None:
    """The store of a run, by a process of its own: it holds all Gaussians."""
    town = Town(blocks, args)
    coordinator = begin(town, folder)
    coordinator.state.influence = town.influence(coordinator.scene.tree, list(coordinator.views.values()))
    coordinator.save()
    coordinator.close()


class Counts:
    """What visits take, by wrapping what they call."""

    def __init__(self, coordinator: Coordinator) -> None:
        self.clock, self.peak, self.numbers = StageClock(), 0, Counter[str]()
        self._process = psutil.Process()
        timed = self.clock.timed
        ParameterStore.load = self._noted(timed("reading", ParameterStore.load), self._read)
        LayerRenderer.load = self._noted(timed("loading", LayerRenderer.load), self._loaded)
        cuts = TorchRasterizer.cuts
        drawn = timed("drawing", lambda *args, **more: list(cuts(*args, **more)))
        TorchRasterizer.cuts = self._noted(drawn, self._drawn)
        visit_training.layers_of_visit = timed("folding, and Python", layer_source.layers_of_visit)
        coordinator.visits.begin = timed("plan", coordinator.visits.begin)
        coordinator.end_visit = timed("commit", coordinator.end_visit)

    def _noted(self, function: Callable, note: Callable) -> Callable:
        def call(*args: Any, **more: Any) -> Any:
            result = function(*args, **more)
            note(result, *args)
            self.peak = max(self.peak, self._process.memory_info().rss)
            return result

        return call

    def _read(self, found: Any, *_: Any) -> None:
        self.numbers["MB read"] += sum(value.nbytes for value in found[0].values()) / 1e6

    def _loaded(self, loaded: Loaded, *_: Any) -> None:
        self.numbers["nodes loaded"] += len(loaded.gaussians) > 0
        self.numbers["Gaussians loaded"] += len(loaded.gaussians)

    def _drawn(self, _: Any, __: Any, gaussians: Gaussians, shots: Sequence[CutShot]) -> None:
        self.numbers["nodes drawn"] += len(shots)
        self.numbers["Gaussians drawn"] += len(shots) * len(gaussians)
        self.numbers["Mpx drawn"] += sum(shot.crop.pixels for shot in shots) / 1e6


def measure(blocks: int, args: Args, folder: Path) -> dict[str, float]:
    """Of one visit: the mean of some."""
    coordinator = begin(Town(blocks, args), folder, Start(folder, None, 0))
    needs = needs_of(coordinator.config, args.modelled**2 * 2 // 3, blocks)
    smaller = (args.width / args.modelled) ** 2
    layer_source.PARTS_BYTES = int(smaller * needs.parts_bytes)
    room = layer_source.LayerRoom(int(smaller * LAYER_SHARE * CARD))
    coordinator.visit = visit_training.VisitTraining(coordinator.run, coordinator.visits, room)
    grey, counts, visits = torch.full((1, 1, 3), 0.5), Counts(coordinator), 0
    while visits <= args.visits:
        with counts.clock.stage("steps"):
            train_step(coordinator, lambda _, crop: grey.expand(crop.height, crop.width, 3))
        active, counts.numbers["steps"] = coordinator.state.active, counts.numbers["steps"] + 1
        if active is None:
            visits += 1
            if visits == 1:  # reads what later ones know
                counts.clock.seconds.clear(), counts.numbers.clear()
                counts.peak = 0
        elif active.done == 1:
            crops = [active.geometry.crops[view].pixels for view in active.views]
            counts.numbers["views"] += len(crops)
            counts.numbers["pixels of a view"] += sum(crops) / len(crops)
    numbers = {name: number / args.visits for name, number in counts.numbers.items()}
    seconds = {f"s {name}": counts.clock.seconds[name] / args.visits for name in STAGES}
    found = numbers | seconds | {"s": sum(seconds.values()), "MB peak": counts.peak / 1e6}
    found["MB disk"] = disk_bytes(folder) / 1e6
    found |= modelled(found, coordinator.config.batch, args)
    coordinator.close()
    return found


def modelled(found: dict[str, float], batch: int, args: Args) -> dict[str, float]:
    """At blocks of BLOCK Gaussians and pictures `args.modelled` px wide, by the rates of a card. What
    Python does between is as measured here."""
    more, larger = BLOCK / args.gaussians, (args.modelled / args.width) ** 2
    layers = found["s loading"] + found["s folding, and Python"]
    layers += more * (found["MB read"] * 1e6 / DISK + found["Gaussians loaded"] * PARAMETERS / BUS)
    layers += more * found["Gaussians drawn"] * DRAW + larger * found["Mpx drawn"] * 1e6 * SHOW
    of_view = BLOCK * STEP * DRAW + larger * found["pixels of a view"] * STEP * SHOW
    steps = found["steps"] * (LAUNCHES + batch * of_view)
    return {
        "layers, s, modelled": layers,
        "visit, s, modelled": layers + steps,
        "share of layers": layers / (layers + steps),
    }


def main(args: Args) -> None:
    """Make and visit each town, print the table."""
    found, processes = {}, multiprocessing.get_context("spawn")
    for blocks in args.blocks:
        with tempfile.TemporaryDirectory() as folder:
            for work in (make, measure):
                with processes.Pool(1) as pool:
                    found[blocks] = pool.apply(work, (blocks, args, Path(folder) / "store"))
    first, last = (found[blocks] for blocks in (args.blocks[0], args.blocks[-1]))
    print_machine(f"{args.gaussians} Gaussians a block, {args.width} px, {args.visits} visits\n")
    rows = [["of a visit", *(f"{blocks} blocks" for blocks in found), "ratio"]]
    for name in first:
        ratio = last[name] / max(first[name], 1e-9)
        rows.append([name, *(f"{each[name]:,.2f}" for each in found.values()), f"{ratio:.2f}"])
    print(markdown(rows))
    if args.out is not None:
        record = {"args": asdict(replace(args, out=None)), "visits": found}
        args.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
