"""Joins datamanager and model to a coordinator when training begins."""

import math
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE

from abcd_ns.data.input_errors import exit_on_user_error
from abcd_ns.engine.events import HeldOutScored
from abcd_ns.engine.gaussians.initialize import thin_out
from abcd_ns.engine.render import loss
from abcd_ns.engine.space.partition import MAX_BLOCKS, build_grid, build_kd, robust_range
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scaffold import blocks_at_rest
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.splitting import cut_at_rest
from abcd_ns.engine.train.layer_source import LayerRoom, LayerSource
from abcd_ns.engine.train.memory import LAYER_SHARE, PHOTO_SHARE, scaffold_size
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import Budget, RunState
from abcd_ns.engine.train.step.batch import Rendered
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import AbcdDataManager, AbcdDataManagerConfig
from abcd_ns.nerfstudio.dataparser import AbcdDataParser
from abcd_ns.nerfstudio.fit import FITTED, SCAFFOLD, Demand, Fit, RamShares, device_budget, find_fit
from abcd_ns.nerfstudio.flags import named_too, opens_ours, trains_ours
from abcd_ns.nerfstudio.inspection import factor_of
from abcd_ns.nerfstudio.metrics import lpips_missing
from abcd_ns.nerfstudio.model import AbcdModel, AbcdModelConfig
from abcd_ns.nerfstudio.options import SAME, mirror
from abcd_ns.nerfstudio.run import STORE
from abcd_ns.nerfstudio.run.progress import ProgressReport
from abcd_ns.nerfstudio.run.resuming import ASKED, MadeFor, RunRequest, new_store, take_over
from abcd_ns.nerfstudio.run.run_log import keep_log
from abcd_ns.nerfstudio.views import training_views, views_of
from abcd_ns.nerfstudio.workers import blocks_to_begin_with, dispatcher_for, number_of_workers
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_at_rest, independent_trainer
from abcd_ns.units import GIB
from abcd_ns.viewer import guard
from abcd_ns.viewer.panel import AbcdPanel

# What makes a method and what memory decides stand in config.yml, and are no flags of `ns-train`.
for _not_offered in (Recipe, Limits):
    tyro.conf.configure(tyro.conf.Fixed)(_not_offered)
for _config, _flags in SAME.items():
    named_too(_config, {name: f"--pipeline.model.{flag}" for name, flag in _flags.items()})


@dataclass
class AbcdPipelineConfig(VanillaPipelineConfig):
    """ABCD: how space is cut and how its blocks are trained."""

    _target: type = field(default_factory=lambda: AbcdPipeline)
    datamanager: AbcdDataManagerConfig = field(default_factory=AbcdDataManagerConfig)
    model: AbcdModelConfig = field(default_factory=AbcdModelConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How blocks are trained."""
    blocks: int = 0
    """Number of blocks. 0 takes as few as `device_budget_gb` allows and splits those that outgrow it. A
    number forces that many blocks; the memory budget is then not enforced."""
    device_budget_gb: float = 0.0
    """Device memory for training, GiB; sets the number of blocks where `blocks` is 0. Of a GPU's, an eighth
    is for layers and one for photos. 0 takes 90% of a GPU's free memory; on a CPU, a quarter of the RAM."""
    partition: Literal["kd", "grid"] = "kd"
    """kd: cells with equally many points. grid: equal cells, as the paper has, at least `blocks` of them."""
    near_plane: float = 0.0
    """Gaussians closer to a camera than this, along its axis, are not drawn; world units. 0 takes half
    the nearest distance at which a photo shows a point."""
    ram_budget_gb: float = 0.0
    """RAM for cached photos, blocks and layers, GiB. Does not change results. Setting it turns off automatic
    workers. 0 takes 8, or 40% of the machine's memory where that is less."""
    workers: int = 0
    """Blocks that are trained at once, each by a process of its own: on a core each, or on a GPU each, which
    needs Ray (pip install 'abcd-ns[cluster]'). 0 takes all cores where there is no GPU, as far as there are
    two blocks for each; and else, or with `ram_budget_gb`, light or poses set, one."""
    cluster: str | None = None
    """Address (host:port) of the head of a Ray cluster that is to have the workers, instead of this machine;
    --data and --output-dir must be paths that all its machines see."""
    max_seconds: float | None = None
    """Stop after this many seconds of training; evaluation and saving do not count."""


def _as_a_command() -> AbstractContextManager:
    """Where a command of nerfstudio's opens a run, what the user can mend ends it in one line. Who opens one
    from Python is given the exception, and so is a training, which has blocks to put to rest before."""
    opens = opens_ours(sys.argv) and not trains_ours(sys.argv)
    return exit_on_user_error() if opens else nullcontext()


class AbcdPipeline(VanillaPipeline):
    """ABCD in nerfstudio. Constructed without side effects: evaluation tools make one, too."""

    config: AbcdPipelineConfig
    datamanager: AbcdDataManager
    model: AbcdModel

    def __init__(self, config: AbcdPipelineConfig, *args: Any, **kwargs: Any) -> None:
        mirror(config.training, config.model)
        self._ram = RamShares.of(config.ram_budget_gb)
        if not config.datamanager.photo_cache_gb:
            config.datamanager.photo_cache_gb = max(self._ram.photos, 1) / GIB
        # ns-viewer and ns-train start the viewer themselves, but neither does so before the pipeline exists.
        guard.install()
        with _as_a_command():
            super().__init__(config, *args, **kwargs)
        self.coordinator: Trainer | None = None
        """Drives the training, once it has begun."""
        self._rendered: Rendered | None = None
        self.panel = AbcdPanel(self.model, lambda: views_of(self.datamanager.train_dataset.cameras))

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """Everything exists by now, checkpoint included: begin or resume, and drive the coordinator."""
        trainer = attributes.trainer
        self.coordinator = self._begin(trainer.run, attributes.optimizers.optimizers)
        self.datamanager.follow(self.coordinator)
        self.model.follow(self.coordinator)
        log = keep_log(trainer.run, self.datamanager.train_dataset.photos, self.coordinator)
        report = ProgressReport(self.coordinator, log.visits)
        self.coordinator.announce.subscribe(report)
        self.coordinator.announce.subscribe(log)
        self.panel.follow(self.coordinator)
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]

        def end_step(step: int) -> None:
            self._after_step()
            if step_check(step, trainer.config.logging.steps_per_log, run_at_zero=True):
                writer.put_dict("ABCD", report.scalars(), step)
            if self.coordinator.finished:
                self.coordinator.complete()
                trainer.stop_training = True

        def end_run(step: int) -> None:
            self.coordinator.dismiss()
            evaluates = trainer.config.steps_per_eval_all_images and self.datamanager.eval_dataset
            if self.coordinator.finished and trainer.training_state == "completed" and evaluates:
                self.get_average_eval_image_metrics(step)
            report.close()
            log.close()

        return [
            TrainingCallback(after, end_step),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], end_run),
        ]

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """As VanillaPipeline's, but keeps what the coordinator must be told after the step."""
        outputs, losses, metrics = super().get_train_loss_dict(step)
        self._rendered, self._errors = outputs.pop("rendered"), outputs.pop("errors")
        return outputs, losses, metrics

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """As VanillaPipeline's; while training, it is no training time."""
        if self.coordinator is not None:
            self.coordinator.pause()
        self.datamanager.take_poses(self.model.poses)
        return super().get_eval_image_metrics_and_images(step)

    def get_average_eval_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As VanillaPipeline's; while training, it is no training time, and listeners are told."""
        if self.coordinator is not None:
            self.coordinator.pause()
        self.datamanager.take_poses(self.model.poses)
        with _as_a_command():
            found = super().get_average_eval_image_metrics(*args, **kwargs)
        if self.coordinator is not None:
            self.coordinator.announce(HeldOutScored(float(found["psnr"]), found.get("ssim")))
        elif "lpips" not in found:  # nerfstudio's writers, while training, want numbers
            found |= {"lpips": None, "lpips_missing": lpips_missing()}
        return found

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """As VanillaPipeline's; cameras stand where their poses were refined to."""
        with _as_a_command():
            super().load_pipeline(loaded_state, step)
        self.datamanager.take_poses(self.model.poses)

    def _after_step(self) -> None:
        if self._rendered is not None:  # else workers took the step
            self.coordinator.after_step(self._rendered, self._errors)
            self._rendered = None

    # -- set-up --------------------------------------------------------------------------------------

    def _begin(self, asked: RunRequest, optimizers: dict[str, Any]) -> Trainer:
        config, views = self.config, self._views()
        # Where there are workers, one of them shares this device, and photos are theirs.
        keeps_photos = not self._on_cpu and self.config.workers <= 1 and self.config.cluster is None
        self.datamanager.device_photo_bytes = int(PHOTO_SHARE * self._budget) if keeps_photos else 0
        self.model.draws_with().warm_up()
        loss.warm_up(self.device)
        store, resumed = self._open_store(asked, views), asked.resumed_from is not None
        scene = StoredScene(BlockTree.from_json(store.header["tree"]), store, self._ram.blocks)
        limits = replace(config.training.limits, **self._fitted(store, resumed))
        training = replace(config.training, limits=limits)
        if resumed:
            state = RunState.from_json(store.state)
            cut_at_rest(scene, state, training.limits)
        run = TrainingRun(
            training,
            Budget(asked.total_steps, config.max_seconds),
            scene,
            views,
            self.model.draws_with(),
            self.model.gauss_params,
            {name: optimizers[name] for name in self.model.gauss_params},
            device=self.device,
        )
        coordinator = self._trainer_of(run, asked)
        if resumed:
            coordinator.restore()
        return coordinator

    def _trainer_of(self, run: TrainingRun, asked: RunRequest) -> Trainer:
        """Who trains by the run's options."""
        if run.config.recipe.exact:
            return ExactTrainer(run)
        if run.config.recipe.overlap > 0:
            return independent_trainer(run)
        blocks, layers = run.scene.tree.num_blocks, self._ram.layers  # on the CPU, RAM is the device
        room = LayerRoom(layers) if self._on_cpu else LayerRoom(int(LAYER_SHARE * self._budget), layers)
        source, target = LayerSource(run, room), self.datamanager.target
        # Where RAM is short, one process: each reads blocks for itself.
        wanted = self.config.workers or int(self.config.ram_budget_gb > 0)
        workers = number_of_workers(wanted, blocks, run.config, self.device)
        if blocks > 1 and (workers > 1 or self.config.cluster is not None):
            return dispatcher_for(run, asked.config, workers, self._budget, source, target)
        return Coordinator(run, source=source, target=target)

    @property
    def _on_cpu(self) -> bool:
        return torch.device(self.device).type == "cpu"

    @cached_property
    def _budget(self) -> int:
        """Bytes of the device that training may take, of what is free when it begins."""
        return device_budget(self.config.device_budget_gb, self.device)

    def _fitted(self, store: ParameterStore, resumed: bool) -> dict[str, int]:
        """The limits that were fitted to the device: as the run began, unless it goes on with a budget of
        its own."""
        kept = {name: store.header.get(name, 0) for name in (*FITTED, SCAFFOLD)}
        if resumed and self.config.blocks == 0 and self.config.device_budget_gb > 0:
            blocks = BlockTree.from_json(store.header["tree"]).num_blocks
            return {**kept, **self._fit(sum(map(store.counts, range(blocks))), blocks).limits}
        return kept

    def _fit(self, points: int, blocks: int = 1) -> Fit:
        """How many blocks for a scene that goes on with so many Gaussians in so many blocks."""
        config = self.config
        most, factor = config.training.density.limit, factor_of(self.datamanager.dataparser)
        demand = Demand(self._pixels, points, config.training, most, factor, blocks, self._on_cpu)
        return find_fit(self._budget, demand)

    @property
    def _pixels(self) -> int:
        """Of the largest image."""
        cameras = self.datamanager.train_dataset.cameras
        return int((cameras.width * cameras.height).max())

    def _first_cut(self, points: int) -> tuple[int, dict[str, int]]:
        """The number of blocks to begin with, and the limits that are fitted to the device, by name."""
        if self.config.blocks > 0:
            return self.config.blocks, {name: getattr(self.config.training.limits, name) for name in FITTED}
        fit = self._fit(points)
        CONSOLE.print(fit.in_words(), highlight=False, soft_wrap=True)
        lends = self.config.workers > 1 or self.config.cluster is not None
        return blocks_to_begin_with(fit, self.config.workers if lends else 0), fit.limits

    def _views(self) -> list[View]:
        """The training views; from now on the model draws from their near plane on."""
        points = None if self.model.seed_points is None else self.model.seed_points[0]
        views = training_views(self.datamanager.train_dataset.cameras, points, self.config.near_plane)
        self.model.near = views[0].near
        return views

    def _open_store(self, asked: RunRequest, views: list[View]) -> ParameterStore:
        """The run's own store: a copy of the one it goes on from, or a new one."""
        training, photos = self.config.training, self.datamanager.train_dataset.image_filenames
        folder = asked.folder / STORE
        made_for = MadeFor.of(photos, views, training)
        if asked.resumed_from is not None:
            return take_over(asked.resumed_from, folder, made_for)
        everything = self.model.initial_gaussians(views, training.point_pixels)
        self._tell_of_points(len(everything))
        gaussians = thin_out(everything, training.density.limit, training.seed)
        if len(gaussians) < len(everything):
            words = f"Training begins with {len(gaussians):,} of {len(everything):,} Gaussians, the limit."
            CONSOLE.print(words, highlight=False)
        del everything
        blocks, fitted = self._first_cut(len(gaussians))
        if self.config.partition == "kd":
            tree = build_kd(gaussians.means, blocks)
        else:
            tree = build_grid(gaussians.means, counts=grid_counts(gaussians, blocks))
        keep = self._scaffold_size(len(gaussians), tree.num_blocks, fitted)
        header = {"tree": tree.to_json(), **fitted, SCAFFOLD: keep or 0, ASKED: self.config.blocks}
        store = new_store(folder, {**header, **made_for.header()})
        if training.recipe.overlap > 0:
            store.commit(independent_at_rest(tree, gaussians))
        else:
            store.commit(blocks_at_rest(tree, gaussians, keep, training.seed))
        return store

    def _scaffold_size(self, gaussians: int, blocks: int, fitted: dict[str, int]) -> int | None:
        """Gaussians that the warm-up may have; None where there is no warm-up."""
        training = self.config.training
        if training.warmup == 0 or blocks == 1 or training.recipe.exact or training.recipe.overlap > 0:
            return None
        # Blocks grow to hold as many Gaussians as there were points, and so may the scaffold.
        grown = max(min(self._points, training.density.limit or self._points), gaussians)
        largest = fitted["block_limit"] or -(-grown // blocks)
        training = replace(training, limits=replace(training.limits, **fitted))
        return scaffold_size(training, largest, self._pixels)

    @property
    def _points(self) -> int:
        """In the cloud."""
        return 0 if self.model.seed_points is None else len(self.model.seed_points[0])

    def _tell_of_points(self, begun: int) -> None:
        if not self._points and not isinstance(self.datamanager.dataparser, AbcdDataParser):  # which says so
            words = f"The data has no points: {begun:,} Gaussians begin at random places, as splatfacto's do."
            CONSOLE.print(words, highlight=False)
        if begun < self._points:
            merged = f"merged {self._points:,} points closer than these photos resolve"
            words = f"Starting with {begun:,} Gaussians: {merged}."
            CONSOLE.print(words, highlight=False)


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
