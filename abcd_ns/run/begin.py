"""How a run begins or resumes: its blocks at rest, what fits on the device, and what trains it."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from abcd_ns.cluster.assignment import Workers
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.forked_workers import ForkedWorkers, can_fork
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.engine.gaussians.initialize import gaussians_from_points, thin_out, thin_points
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.render import Rasterizer, loss
from abcd_ns.engine.space.partition import MAX_BLOCKS, build_grid, build_kd, robust_range
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.coarse_model import blocks_at_rest
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.splitting import cut_at_rest
from abcd_ns.engine.train.layer_source import LayerRoom
from abcd_ns.engine.train.memory import LAYER_SHARE, PHOTO_SHARE, coarse_model_size
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import Budget, RunState
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_at_rest, independent_trainer
from abcd_ns.run.fit import (
    COARSE_MODEL,
    FITTED,
    Demand,
    Fit,
    RamShares,
    blocks_to_begin_with,
    device_budget,
    find_fit,
    fit_gaussians,
    number_of_workers,
)
from abcd_ns.run.options import RunOptions
from abcd_ns.run.store import ASKED, MadeFor, Start, take_over

RemoteWorkers = Callable[[RunSetup, int, int], Workers]
"""Starts workers on GPUs or other machines. Takes what they have in common, their number, and the bytes of
each one's device that training may take."""


@dataclass(frozen=True)
class Capture:
    """What a run is trained on."""

    views: list[View]
    """The training views, by row."""
    photos: Sequence[Path]
    """Their photos; a run resumes on photos of the same names and sizes alone."""
    target: Callable[[Sample], Target]
    """Gives what a sample is trained on."""
    gaussians: Callable[[], Gaussians]
    """Makes what a new run begins with."""
    points: int
    """In the cloud that these are made from; 0 where they are at random places."""
    factor: int = 1
    """By which the photos' width and height were divided."""

    @property
    def pixels(self) -> int:
        """Of the largest photo."""
        return max(view.full.pixels for view in self.views)


def gaussians_of_cloud(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"] | Float[Tensor, "n 3"],
    views: Sequence[View],
    training: TrainingConfig,
) -> Gaussians:
    """One Gaussian for each point that the views can tell apart.

    Args:
        points: world space.
        colors: 0..255.
    """
    points, colors = thin_points(points, colors.float(), views, training.point_pixels)
    flat = training.primitive == "2dgs"
    return gaussians_from_points(points.float(), colors, sh_degree=training.sh_degree, flat=flat)


class RunBuilder:
    """Builds the training run that options describe, on a capture.

    Args:
        say: takes lines for the user.
        remote: starts workers where they cannot be forked; None for a run that has no such workers.
    """

    def __init__(
        self,
        options: RunOptions,
        capture: Capture,
        device: torch.device | str,
        say: Callable[[str], None],
        remote: RemoteWorkers | None = None,
    ) -> None:
        self.options, self.capture, self.device = options, capture, torch.device(device)
        self._say, self._remote = say, remote
        self.ram = RamShares.of(options.ram_budget_gb)
        self.device_bytes = device_budget(options.device_budget_gb, self.device)
        """Of the device that training may take, of what is free now."""

    @property
    def photo_bytes(self) -> int:
        """Of the device, for photos. None on a CPU; none beside workers, of which one shares this device."""
        has_workers = self.options.workers > 1 or self.options.cluster is not None
        return 0 if self._on_cpu or has_workers else int(PHOTO_SHARE * self.device_bytes)

    def build(
        self,
        folder: Path,
        budget: Budget,
        rasterizer: Rasterizer,
        params: Params,
        optimizers: Optimizers,
        start: Start | None = None,
    ) -> Trainer:
        """The run, ready for its next step.

        Args:
            folder: for its store.
            params, optimizers: see TrainingRun.
            start: what it resumes; None for a new run.

        Raises:
            UserError: nothing fits on the device; `folder` holds another run's store; or `start` was made for
                something else.
        """
        rasterizer.warm_up()
        loss.warm_up(self.device)
        with ExitStack() as undo:
            store = self._new_store(folder) if start is None else take_over(start, folder, self._made_for)
            undo.callback(store.close)
            scene = StoredScene(BlockTree.from_json(store.header["tree"]), store, self.ram.blocks)
            limits = replace(self._training.limits, **self._limits_of(store, resumed=start is not None))
            training = replace(self._training, limits=limits)
            if start is not None:
                cut_at_rest(scene, RunState.from_json(store.state), limits)
            views = self.capture.views
            run = TrainingRun(
                training, budget, scene, views, rasterizer, params, optimizers, device=self.device
            )
            trainer = self._trainer_of(run)
            if start is not None:
                trainer.restore()
            undo.pop_all()
        return trainer

    @property
    def _training(self) -> TrainingConfig:
        return self.options.training

    @property
    def _on_cpu(self) -> bool:
        return self.device.type == "cpu"

    @property
    def _made_for(self) -> MadeFor:
        return MadeFor.of(self.capture.photos, self.capture.views, self._training)

    # -- what trains it ------------------------------------------------------------------------------

    def _trainer_of(self, run: TrainingRun) -> Trainer:
        if run.config.recipe.exact:
            return ExactTrainer(run)
        if run.config.recipe.overlap > 0:
            return independent_trainer(run)
        options, blocks = self.options, run.scene.tree.num_blocks
        layers = self.ram.layers  # on the CPU, RAM is the device
        room = LayerRoom(layers) if self._on_cpu else LayerRoom(int(LAYER_SHARE * self.device_bytes), layers)
        target = self.capture.target
        # Where RAM is short, one process: each reads blocks for itself.
        wanted = options.workers or int(options.ram_budget_gb > 0)
        count = number_of_workers(wanted, blocks, run.config, self.device)
        if blocks > 1 and (count > 1 or options.cluster is not None):
            workers, lag = self._workers(run, count, room)
            return Dispatcher(run, workers, lag, room, target)
        return Coordinator(run, room=room, target=target)

    def _workers(self, run: TrainingRun, count: int, room: LayerRoom) -> tuple[Workers, int | None]:
        """Forked on the cores of this machine, else remote ones; and the dispatcher's lag.

        Args:
            room: for layers; workers that share a device share it.
        """
        of_device = count if self._on_cpu else 1
        setup = RunSetup.of(run, LayerRoom(room.device // of_device, room.ram // count))
        if self.options.cluster is None and can_fork(self.device):
            worker = VisitWorker(setup, run.rasterizer, self.capture.target, self.device)
            return ForkedWorkers(count, worker), count  # nothing travels for long: no slack is needed
        return self._remote(setup, count, self.device_bytes), None

    # -- what fits -----------------------------------------------------------------------------------

    def _limits_of(self, store: ParameterStore, resumed: bool) -> dict[str, int]:
        """The limits that were fitted to the device: as the run began, unless it resumes with a budget of its
        own."""
        kept = {name: store.header.get(name, 0) for name in (*FITTED, COARSE_MODEL)}
        if resumed and self.options.blocks == 0 and self.options.device_budget_gb > 0:
            blocks = BlockTree.from_json(store.header["tree"]).num_blocks
            return {**kept, **self._fit(sum(map(store.counts, range(blocks))), blocks).limits}
        return kept

    def _fit(self, gaussians: int, blocks: int = 1) -> Fit:
        """How many blocks for a scene that resumes with so many Gaussians in so many blocks."""
        training, capture = self._training, self.capture
        most, factor = training.density.limit, capture.factor
        demand = Demand(capture.pixels, gaussians, training, most, factor, blocks, self._on_cpu)
        room = self.options.gaussian_bytes
        return fit_gaussians(room, demand) if room else find_fit(self.device_bytes, demand)

    def _first_cut(self, gaussians: int) -> tuple[int, dict[str, int]]:
        """The number of blocks to begin with, and the limits that are fitted to the device, by name."""
        options = self.options
        if options.blocks > 0:
            return options.blocks, {name: getattr(self._training.limits, name) for name in FITTED}
        fit = self._fit(gaussians)
        self._say(fit.in_words())
        has_workers = options.workers > 1 or options.cluster is not None
        return blocks_to_begin_with(fit, options.workers if has_workers else 0), fit.limits

    def _coarse_model_size(self, gaussians: int, blocks: int, fitted: dict[str, int]) -> int | None:
        """Gaussians that the warm-up may have; None where there is no warm-up."""
        training, points = self._training, self.capture.points
        if training.warmup == 0 or blocks == 1 or training.recipe.exact or training.recipe.overlap > 0:
            return None
        # Blocks grow to hold as many Gaussians as there were points, and so may the coarse model.
        grown = max(min(points, training.density.limit or points), gaussians)
        largest = fitted["block_limit"] or -(-grown // blocks)
        training = replace(training, limits=replace(training.limits, **fitted))
        pixels = 0 if self.options.gaussian_bytes else self.capture.pixels
        return coarse_model_size(training, largest, pixels)

    # -- at rest -------------------------------------------------------------------------------------

    def _new_store(self, folder: Path) -> ParameterStore:
        """The store of a run that begins, with all blocks."""
        training, made_for = self._training, self._made_for
        gaussians = self._first_gaussians()
        blocks, fitted = self._first_cut(len(gaussians))
        if self.options.partition == "kd":
            tree = build_kd(gaussians.means, blocks)
        else:
            tree = build_grid(gaussians.means, counts=grid_counts(gaussians, blocks))
        keep = self._coarse_model_size(len(gaussians), tree.num_blocks, fitted)
        header = {"tree": tree.to_json(), **fitted, COARSE_MODEL: keep or 0, ASKED: self.options.blocks}
        store = ParameterStore.create(folder, {**header, **made_for.header()})
        at_rest = partial(blocks_at_rest, room=keep, seed=training.seed)
        if training.recipe.overlap > 0:
            at_rest = independent_at_rest
        store.commit(at_rest(tree, gaussians))
        return store

    def _first_gaussians(self) -> Gaussians:
        """No more than the scene may have."""
        training, points = self._training, self.capture.points
        everything = self.capture.gaussians()
        if len(everything) < points:
            merged = f"merged {points:,} points closer than these photos resolve"
            self._say(f"Starting with {len(everything):,} Gaussians: {merged}.")
        gaussians = thin_out(everything, training.density.limit, training.seed)
        if len(gaussians) < len(everything):
            self._say(f"Training begins with {len(gaussians):,} of {len(everything):,} Gaussians, the limit.")
        return gaussians


def grid_counts(gaussians: Gaussians, blocks: int) -> tuple[int, int, int]:
    """Cells along x, y, z, as near to cubes as the scene's shape allows, at least `blocks` in all.

    Raises:
        UserError: these would be over MAX_BLOCKS.
    """
    low, high = robust_range(gaussians.means.double().cpu())
    extent = (high - low).clamp_min(1e-9).tolist()
    counts = [1, 1, 1]
    while (cells := math.prod(counts)) < blocks and cells <= MAX_BLOCKS:
        widest = max(range(3), key=lambda axis: extent[axis] / counts[axis])
        counts[widest] += 1
    if cells > MAX_BLOCKS:
        grid = " x ".join(map(str, counts))
        raise UserError(
            f"{blocks} blocks make a grid of {grid} cells or more here, and {MAX_BLOCKS} are the most: give "
            "fewer --pipeline.blocks, or --pipeline.partition kd."
        )
    return counts[0], counts[1], counts[2]
