"""Joins datamanager and model to a coordinator when training begins."""

import sys
import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check

from abcd_ns.data.input_errors import say
from abcd_ns.data.ply import GREY, read_gaussians
from abcd_ns.engine.events import HeldOutScored
from abcd_ns.engine.gaussians.initialize import PointCloud, random_points
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step.batch import Rendered
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.nerfstudio.datamanager import AbcdDataManager, AbcdDataManagerConfig
from abcd_ns.nerfstudio.dataparser import AbcdDataParser
from abcd_ns.nerfstudio.flags import as_a_command, check_box, check_held_out, check_tool, opened, shown
from abcd_ns.nerfstudio.inspection import factor_of, where_data_is
from abcd_ns.nerfstudio.metrics import lpips_missing
from abcd_ns.nerfstudio.model import AbcdModel, AbcdModelConfig
from abcd_ns.nerfstudio.options import mirror
from abcd_ns.nerfstudio.run.progress import ProgressReport
from abcd_ns.nerfstudio.run.run_log import LOG_FILE, RunLog
from abcd_ns.nerfstudio.run.settings import write_settings
from abcd_ns.nerfstudio.views import training_views, views_of
from abcd_ns.nerfstudio.workers import ray_workers
from abcd_ns.run import STORE
from abcd_ns.run.begin import Capture, begin_run, cloud_of
from abcd_ns.run.fit import RamShares, photo_bytes
from abcd_ns.run.options import RunOptions
from abcd_ns.units import GIB
from abcd_ns.viewer import guard
from abcd_ns.viewer.panel import AbcdPanel

SCORING_SHARE = 0.05  # of a run's training time, for scores of held-out views: half of it before the end
LEAST_SCORED = 32  # held-out views that a score is the mean of, at least


@shown(
    "max_seconds", "blocks", "device_budget_gb", "ram_budget_gb", "workers", "cluster",
    "datamanager", "training", "model",
)  # fmt: skip
@dataclass
class AbcdPipelineConfig(RunOptions, VanillaPipelineConfig):
    """ABCD: how space is cut and how its blocks are trained."""

    _target: type = field(default_factory=lambda: AbcdPipeline)
    datamanager: AbcdDataManagerConfig = field(default_factory=AbcdDataManagerConfig)
    """How photos are served."""
    model: AbcdModelConfig = field(default_factory=AbcdModelConfig)
    """What draws, and what a run begins with."""


class AbcdPipeline(VanillaPipeline):
    """ABCD in nerfstudio. Constructed without side effects: evaluation tools make one, too."""

    config: AbcdPipelineConfig
    datamanager: AbcdDataManager
    model: AbcdModel

    def __init__(self, config: AbcdPipelineConfig, *args: Any, **kwargs: Any) -> None:
        mirror(config.training, config.model)
        if not config.datamanager.photo_cache_gb:
            config.datamanager.photo_cache_gb = max(RamShares.of(config.ram_budget_gb).photos, 1) / GIB
        guard.install()  # ns-viewer and ns-train start their viewers later
        with as_a_command():
            check_tool(sys.argv)
            if (opens := opened(sys.argv)) is not None:
                config.datamanager.data = where_data_is(config.datamanager.data, opens)
            super().__init__(config, *args, **kwargs)
            if (held_out := len(self.datamanager.eval_dataset)) < 2:  # as many as a path begins and ends at
                check_held_out(sys.argv, held_out)
        self.coordinator: Trainer | None = None  # drives the training once it has begun
        self._drawn: list[Rendered] = []
        self._view_seconds = self._scoring_seconds = 0.0
        data = self.datamanager.train_dataset
        self.panel = AbcdPanel(self.model, lambda: views_of(data.cameras), lambda row: data.photos.image(row))

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """Begin or resume, as everything exists by now, and drive the coordinator."""
        trainer = attributes.trainer
        self.coordinator = self._begin(trainer, attributes.optimizers.optimizers)
        self.datamanager.follow(self.coordinator)
        self.model.follow(self.coordinator)
        write_settings(trainer.config, trainer.asked, trainer.folder)
        earlier = trainer.resumed_from and trainer.resumed_from.store.parent / LOG_FILE
        photos = self.datamanager.train_dataset.photos
        log = RunLog(self.coordinator, photos, trainer.folder / LOG_FILE, earlier)
        report = ProgressReport(self.coordinator, log.visits)
        self.coordinator.announce.subscribe(report)
        self.coordinator.announce.subscribe(log)
        self.panel.follow(self.coordinator, log)

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
                with trainer.train_lock:  # browsers set the model's crop and background
                    self.get_average_eval_image_metrics(step)
            report.close()
            log.close()

        at = TrainingCallbackLocation
        return [
            TrainingCallback([at.AFTER_TRAIN_ITERATION], end_step),
            TrainingCallback([at.AFTER_TRAIN], end_run),
        ]

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """As VanillaPipeline's, for a step's parts in turn; runs backward for all but the last.
        Keeps what the coordinator needs after the step."""
        self._errors, earlier = [], 0.0
        while True:
            if self._drawn:
                self._drawn[-1] = self.coordinator.gathered(self._drawn[-1])
            outputs, losses, metrics = super().get_train_loss_dict(step)
            self._drawn.append(outputs.pop("rendered").kept)
            self._errors += outputs.pop("errors")
            share = outputs["batch"].share  # which the coordinator's own loss has by now
            losses = {k: loss if k == "main_loss" else share * loss for k, loss in losses.items()}
            if not self.datamanager.is_within_step:
                metrics["psnr"] = -10 * torch.stack(self._errors).log10().mean()
                return outputs, losses | {"main_loss": losses["main_loss"] + earlier}, metrics
            loss = sum(losses.values())
            loss.backward()
            earlier = earlier + loss.detach()
            del outputs, losses, loss  # frees memory for the next part

    def get_eval_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """As VanillaPipeline's; while training, it is no training time."""
        self._before_evaluation()
        return super().get_eval_loss_dict(step)

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """As VanillaPipeline's; while training, it is no training time."""
        self._before_evaluation()
        began = time.monotonic()
        found = super().get_eval_image_metrics_and_images(step)
        self._view_seconds = time.monotonic() - began
        return found

    def get_average_eval_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As VanillaPipeline's; while training, no time counts, and of many views a sample is scored."""
        self._before_evaluation()
        self.datamanager.scored, began = self._views_to_score(), time.monotonic()
        with as_a_command():
            found = super().get_average_eval_image_metrics(*args, **kwargs)
        taken, scored = time.monotonic() - began, self.datamanager.scored
        self._scoring_seconds += taken
        self._view_seconds = taken / max(scored or len(self.datamanager.eval_dataset), 1)
        self.datamanager.scored = None
        if self.coordinator is not None:
            self.coordinator.announce(HeldOutScored(float(found["psnr"]), found.get("ssim")))
        elif "lpips" not in found:  # nerfstudio's writers, while training, want numbers
            found |= {"lpips": None, "lpips_missing": lpips_missing()}
        return found

    def _views_to_score(self) -> int | None:
        """Number of held-out views that SCORING_SHARE has time for; None for all."""
        if self.coordinator is None or not self._view_seconds:
            return None
        of_run, there = self.coordinator.stopwatch.seconds, len(self.datamanager.eval_dataset)
        share = SCORING_SHARE if self.coordinator.finished else SCORING_SHARE / 2
        wanted = max(int((share * of_run - self._scoring_seconds) / self._view_seconds), LEAST_SCORED)
        if wanted >= there:
            return None
        say(f"Scoring {wanted} of {there} held-out views: all take over {share:.1%} of the training time.")
        return wanted

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """As VanillaPipeline's; cameras stand where their poses were refined to, and photos with alpha
        have the background of pictures."""
        with as_a_command():
            super().load_pipeline(loaded_state, step)
            check_box(sys.argv, self.model.means)
        self.config.datamanager.poses = self.model.poses
        self.config.datamanager.background = self.model.background_color.tolist()
        self.datamanager.take_poses(self.model.poses)

    def _before_evaluation(self) -> None:
        if self.coordinator is not None:
            self.coordinator.pause()
        self.datamanager.take_poses(self.model.poses)

    def _after_step(self) -> None:
        if self._drawn:  # else workers took the step
            self.coordinator.after_step(Rendered.joined(self._drawn), self._errors)
            self._drawn = []

    def _begin(self, trainer: Any, optimizers: dict[str, Any]) -> Trainer:
        """Begin or resume, and give the model its near plane."""
        manager, model, views = self.datamanager, self.model, self.training_views()
        model.near = views[0].near
        manager.device_photo_bytes = photo_bytes(self.config, self.device)
        elsewhere = model.config.random_init or model.config.init_splats is not None
        points = 0 if elsewhere else len(self._cloud[0])
        photos, first = manager.train_dataset.image_filenames, partial(self._first_cloud, views)
        capture = Capture(views, photos, manager.target, first, points, factor_of(manager.dataparser))
        return begin_run(
            self.config,
            capture,
            self.device,
            trainer.folder / STORE,
            Budget(trainer.total_steps, self.config.max_seconds),
            model.draws_with(),
            model.gauss_params,
            {name: optimizers[name] for name in model.gauss_params},
            say,
            partial(ray_workers, trainer.config),
            trainer.resumed_from,
        )

    def training_views(self) -> list[View]:
        """The photos' cameras as the scene is trained with them."""
        return training_views(self.datamanager.train_dataset.cameras, self._cloud[0], self.config.near_plane)

    @property
    def _cloud(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Points of the capture and their colours, if it has any."""
        return self.model.seed_points or (torch.zeros(0, 3), torch.zeros(0, 3))

    def _first_cloud(self, views: list[View]) -> PointCloud | Gaussians:
        """The Gaussians of a file, or one at each point of the capture or at random places."""
        model, training, (points, colors) = self.model.config, self.config.training, self._cloud
        if model.init_splats is not None:
            read = self.datamanager.train_dataparser_outputs
            found, lost = read_gaussians(model.init_splats)
            note = f" {lost:,} others hold NaN, or no rotation." if lost else ""
            say(f"Starting with {len(found):,} Gaussians of {model.init_splats}.{note}")
            to = Similarity.of(read.dataparser_transform, read.dataparser_scale)
            return to.gaussians(found).of_degree(training.sh_degree)
        if len(points) and not model.random_init:
            if len(colors) != len(points):  # as of a .ply without colours
                colors = torch.full_like(points, GREY)
            return cloud_of(points.cpu().float(), colors.cpu(), views, training)
        if not len(points) and not isinstance(self.datamanager.dataparser, AbcdDataParser):  # which says so
            where = "at random places, as splatfacto's do"
            say(f"The data has no points: {model.num_random:,} Gaussians begin {where}.")
        at_random = random_points(model.num_random, model.random_scale)
        return cloud_of(*at_random, views, replace(training, point_pixels=0.0))
