"""How a run begins or resumes: its stored blocks, what fits on the device, and what trains it."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from abcd_ns.cluster.assignment import Workers
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.forked_workers import ForkedWorkers, can_fork
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.engine.gaussians.initialize import PointCloud, cloud_from_points, split_off, thin_points
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.render import Rasterizer, loss
from abcd_ns.engine.space.partition import MAX_BLOCKS, build_grid, build_kd, robust_range
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.splitting import end_joint
from abcd_ns.engine.train.memory import LAYER_SHARE, coarse_model_size, limits_at
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import Budget, RunState
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_blocks, independent_trainer
from abcd_ns.run import fit
from abcd_ns.run.fit import RamShares
from abcd_ns.run.options import RunOptions
from abcd_ns.run.store import ASKED, MEMORY, MadeFor, Start, take_over

Say = Callable[[str], None]
RemoteWorkers = Callable[[RunSetup, int, int], Workers]
"""Starts workers on GPUs or other machines, from their common setup, their number, and the bytes of a device
that training may take."""


@dataclass(frozen=True)
class Capture:
    """What a run is trained on."""

    views: list[View]  # the training views, by row
    photos: Sequence[Path]  # their files; a run resumes only on photos of the same names and sizes
    target: Callable[[Sample], Target]  # returns what a sample is trained on
    cloud: Callable[[], PointCloud | Gaussians]
    """Makes what a new run begins with: Gaussians are trained already and have no warm-up."""
    points: int  # of the capture; 0 where the run begins with others
    factor: int = 1  # by which the photos' width and height were divided

    @property
    def pixels(self) -> int:
        """Of the largest photo."""
        return max(view.full.pixels for view in self.views)


def cloud_of(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"] | Float[Tensor, "n 3"],
    views: Sequence[View],
    training: TrainingConfig,
) -> PointCloud:
    """One Gaussian for each point (world space; colors 0..255) that the views can tell apart."""
    points, colors = thin_points(points, colors, views, training.point_pixels)
    flat = training.primitive == "2dgs"
    return cloud_from_points(points.float(), colors, sh_degree=training.sh_degree, flat=flat)


def begin_run(
    options: RunOptions,
    capture: Capture,
    device: torch.device,
    folder: Path,
    budget: Budget,
    rasterizer: Rasterizer,
    params: Params,
    optimizers: Optimizers,
    say: Say,
    remote: RemoteWorkers | None = None,
    start: Start | None = None,
) -> Trainer:
    """The training run that options describe, on a capture, ready for its next step. Its store is in
    `folder`; for `params` and `optimizers` see TrainingRun. `remote` starts workers where they cannot be
    forked. `start` is what it resumes; None for a new run.

    A UserError if nothing fits on the device, or `start` was made for something else.
    """
    device_bytes = fit.device_budget(options.device_budget_gb, device)
    rasterizer.warm_up()
    loss.warm_up(device)
    training, on_cpu = options.training, device.type == "cpu"
    made_for = MadeFor.of(capture.photos, capture.views, training)
    with ExitStack() as undo:
        if start is None:
            store = _new_store(folder, options, capture, device_bytes, on_cpu, made_for, say)
        else:
            store = take_over(start, folder, made_for)
        undo.callback(store.close)
        tree = BlockTree.from_json(store.header["tree"])
        scene = StoredScene(tree, store, RamShares.of(options.ram_budget_gb).blocks)
        limits = Limits(**{field.name: store.header.get(field.name, 0) for field in fields(Limits)})
        asked = _memory_asked(options)
        if start is not None and any(asked) and asked != store.header.get(MEMORY):
            # It resumes with another budget; else it keeps the limits of the last.
            there, blocks = sum(map(store.counts, range(tree.num_blocks))), tree.num_blocks
            photos = capture.pixels, capture.factor
            found = fit.fit_run(options, device_bytes, *photos, there, on_cpu, blocks).limits
            limits = replace(found, coarse_gaussians=limits.coarse_gaussians)
            store.commit({}, header={**store.header, **asdict(limits), MEMORY: asked})
        training = replace(training, limits=limits)
        if start is not None:
            state = RunState.from_json(store.state)
            end_joint(scene, state, limits_at(training, state.sh_degree))
        drawn = rasterizer, params, optimizers
        run = TrainingRun(training, budget, scene, capture.views, *drawn, device=device)
        trainer = _trainer_of(run, options, capture, device_bytes, remote)
        if start is not None:
            trainer.restore()
        undo.pop_all()
    return trainer


def _trainer_of(
    run: TrainingRun, options: RunOptions, capture: Capture, device_bytes: int, remote: RemoteWorkers | None
) -> Trainer:
    if run.config.recipe.exact:
        return ExactTrainer(run)
    if run.config.recipe.overlap > 0:
        return independent_trainer(run)
    device, blocks, target = run.device, run.scene.tree.num_blocks, capture.target
    ram, on_cpu = RamShares.of(options.ram_budget_gb).layers, device.type == "cpu"
    room = LayerRoom(ram) if on_cpu else LayerRoom(int(LAYER_SHARE * device_bytes), ram)
    # Where RAM is short, one process: each reads blocks for itself.
    wanted = options.workers or int(options.ram_budget_gb > 0)
    count = fit.number_of_workers(wanted, blocks, run.config, device)
    if blocks == 1 or (count == 1 and options.cluster is None):
        return Coordinator(run, room=room, target=target)
    # Workers that share a device share its room for layers.
    each = LayerRoom(room.device // (count if on_cpu else 1), room.ram // count)
    setup = RunSetup.of(run, each)
    if options.cluster is None and can_fork(device):
        workers = ForkedWorkers(count, VisitWorker(setup, run.rasterizer, target, device))
        return Dispatcher(run, workers, count, room, target)  # nothing travels for long: no slack is needed
    return Dispatcher(run, remote(setup, count, device_bytes), None, room, target)


def _new_store(
    folder: Path,
    options: RunOptions,
    capture: Capture,
    device_bytes: int,
    on_cpu: bool,
    made_for: MadeFor,
    say: Say,
) -> ParameterStore:
    """The store of a run that begins, with all blocks."""
    training = options.training
    cloud = _first_cloud(capture, training, say)
    blocks, limits = options.blocks, training.limits
    if blocks == 0:
        allowed = fit.fit_run(options, device_bytes, capture.pixels, capture.factor, len(cloud), on_cpu)
        workers = options.workers if fit.has_workers(options) else 0
        blocks, limits = fit.blocks_to_begin_with(allowed, workers), allowed.limits
        say(replace(allowed, blocks=blocks).in_words())
    if options.partition == "kd":
        tree = build_kd(cloud.means, blocks)
    else:
        tree = build_grid(cloud.means, counts=grid_counts(cloud.means, blocks))
    keep = _coarse_model_size(options, capture, len(cloud), tree.num_blocks, limits)
    kept = asdict(replace(limits, coarse_gaussians=keep or 0)) | made_for.header()
    asked = {ASKED: options.blocks, MEMORY: _memory_asked(options)}
    store = ParameterStore.create(folder, {"tree": tree.to_json(), **kept, **asked})
    if training.recipe.overlap > 0:
        content = independent_blocks(tree, cloud)
    else:
        content = stored_blocks(tree, cloud, room=keep, seed=training.seed)
    del cloud  # frees it while blocks are written
    store.commit(content)
    return store


def _memory_asked(options: RunOptions) -> list[float]:
    """What a run's limits follow from; zeros where it keeps to no budget, or to what the machine has."""
    return [0.0, 0] if options.blocks else [options.device_budget_gb, options.gaussian_bytes]


def _coarse_model_size(
    options: RunOptions, capture: Capture, gaussians: int, blocks: int, limits: Limits
) -> int | None:
    """Gaussians that the warm-up may have; None where there is no warm-up."""
    training = options.training
    if training.warmup == 0 or blocks == 1 or training.recipe.exact or training.recipe.overlap > 0:
        return None
    # Blocks grow to hold as many Gaussians as there were points, and so may the coarse model.
    grown = max(min(capture.points, training.density.limit or capture.points), gaussians)
    largest, training = limits.block_limit or -(-grown // blocks), replace(training, limits=limits)
    return coarse_model_size(training, largest, 0 if options.gaussian_bytes else capture.pixels)


def _first_cloud(capture: Capture, training: TrainingConfig, say: Say) -> PointCloud | Gaussians:
    """What the run begins with, thinned out to what the scene may have."""
    everything = capture.cloud()
    if len(everything) < capture.points:
        merged = f"merged {capture.points:,} points closer than these photos resolve"
        say(f"Starting with {len(everything):,} Gaussians: {merged}.")
    limit = training.density.limit
    kept = everything if limit is None else split_off(everything, limit, training.seed)[0]
    if len(kept) < len(everything):
        say(f"Training begins with {len(kept):,} of {len(everything):,} Gaussians, the limit.")
    return kept


def grid_counts(means: Float[Tensor, "n 3"], blocks: int) -> tuple[int, int, int]:
    """Cells along x, y, z, as near to cubes as the scene's shape allows, at least `blocks` in all. A
    UserError if these are over MAX_BLOCKS."""
    low, high = robust_range(means.cpu())
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
