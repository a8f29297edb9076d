"""nerfstudio's configuration of one job: as `ns-train` would have it, without viewer and evaluation."""

import copy
import dataclasses
import zlib
from pathlib import Path

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns import methods
from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.engine.train.schedule import views_per_step
from abcd_ns.errors import UserError
from abcd_ns.lab.job import HELD_OUT_EVERY, METHODS, Job
from abcd_ns.lab.runs.options import change_options
from abcd_ns.lab.runs.splatfacto import Splatfacto, SplatfactoData, scaled
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.inspection import inspect
from abcd_ns.nerfstudio.options import mirror
from abcd_ns.nerfstudio.trainer import AbcdTrainerConfig

ENDLESS = 10**9  # steps of a run that its seconds end

REGISTERED: dict[str, AbcdTrainerConfig] = {
    method: getattr(methods, method.replace("-", "_")).config
    for method in METHODS
    if method.startswith("abcd")
}
"""What `ns-train` knows each method of ABCD's by. Not to be changed: copy it."""


def trainer_config(job: Job, out: Path) -> TrainerConfig:
    """What the job trains with; its files go to `job.folder(out)`."""
    config = _abcd(job) if job.method in REGISTERED else _splatfacto(job)
    settings = job.settings
    config.output_dir, config.experiment_name, config.timestamp = out, "runs", job.folder(out).name
    config.machine.seed = job.seed
    config.max_num_iterations = ENDLESS if settings.steps is None else settings.steps
    # "tensorboard" is the value of `vis` that starts no viewer and asks no service for an account.
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.logging.local_writer.enable = False
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = 0
    return config


def check_scene(job: Job) -> str:
    """By what the scene is known again, in words; a UserError if it cannot be trained on, photos included."""
    found = inspect(_parser(job))
    points = f"{len(found.cloud)} points of checksum {zlib.crc32(found.cloud.tobytes()):08x}"
    return f"{found.train} views, {found.held_out} held out, {points}"


def check_options(job: Job) -> None:
    """Raise a UserError if the options that the job changes do not go together."""
    if not job.changes:
        return
    pipeline = _abcd(job).pipeline
    mirror(pipeline.training, pipeline.model)
    if not 1 <= pipeline.blocks <= MAX_BLOCKS:
        raise UserError(f"{job.variant}: blocks must be 1 to {MAX_BLOCKS}, not {pipeline.blocks}.")


def _abcd(job: Job) -> AbcdTrainerConfig:
    config: AbcdTrainerConfig = copy.deepcopy(REGISTERED[job.method])
    settings, pipeline = job.settings, config.pipeline
    pipeline.datamanager.data = Path(settings.data)
    pipeline.datamanager.dataparser = _parser(job)
    if job.method != "abcd-monolithic":
        pipeline.blocks = settings.blocks
    if job.method == "abcd-paper":
        # One visit to each cell; cells that no view sees leave their steps to the others.
        training, steps = pipeline.training, -(-settings.steps // job.blocks)
        training.recipe = dataclasses.replace(training.recipe, visit_steps=steps)
    pipeline.max_seconds = settings.seconds
    change_options(pipeline, job.changes)
    if pipeline.gaussian_bytes:
        pipeline.workers = 1  # the budget is one device's
    if pipeline.gaussian_bytes and job.method == "abcd-monolithic":
        needs = DeviceNeeds(0, views_per_step(pipeline.training.batch, 1), pipeline.training.sh_degree)
        pipeline.training.density.max_gaussians = pipeline.gaussian_bytes // needs.gaussian_bytes
    return config


def _splatfacto(job: Job) -> TrainerConfig:
    # Here and not above: this import starts every installed plugin.
    from nerfstudio.configs.method_configs import method_configs

    config: TrainerConfig = copy.deepcopy(method_configs["splatfacto"])
    config.pipeline.datamanager = FullImageDatamanagerConfig(
        _target=SplatfactoData,
        data=Path(job.settings.data),
        dataparser=_parser(job),
        cache_images_type="uint8",
    )
    config.method_name, config.pipeline.model._target = job.method, Splatfacto
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    if job.method == "splatfacto-scaled":
        config = scaled(config, job.settings.steps)
    return config


def _parser(job: Job) -> AbcdDataParserConfig:
    settings = job.settings
    return AbcdDataParserConfig(
        data=Path(settings.data),
        downscale_factor=settings.downscale,
        eval_mode=settings.hold_out,
        eval_interval=HELD_OUT_EVERY,
    )
