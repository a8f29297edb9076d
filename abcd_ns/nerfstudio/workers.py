"""Workers of a run: what each reads when it starts, and who lends them blocks."""

import copy
from collections.abc import Callable
from functools import partial

import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from abcd_ns.cluster.connect import check_installed, connect
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.forked_workers import ForkedWorkers, can_fork
from abcd_ns.cluster.lease import Workers, WorkersError
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.layer_source import LayerRoom, LayerSource
from abcd_ns.engine.train.memory import PHOTO_SHARE
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.errors import UserError
from abcd_ns.machine import threads_wanted
from abcd_ns.nerfstudio.fit import Fit
from abcd_ns.units import bytes_in_words

BLOCKS_EACH = 2
"""Blocks for each worker at least, where their number is not given: one in training, one that rests."""


def check_workers(config: TrainerConfig) -> None:
    """Look at what is asked for, before anything is written.

    Raises:
        UserError: workers are of no use, or cannot be had.
    """
    pipeline = config.pipeline
    workers, cluster, blocks = pipeline.workers, pipeline.cluster, pipeline.blocks
    if workers < 0:
        raise UserError(f"--pipeline.workers must be 0 or more, not {workers}.")
    if cluster is not None and not workers:
        raise UserError(f"--pipeline.cluster {cluster} needs a number of workers: add --pipeline.workers.")
    if workers <= 1 and cluster is None:
        return
    if cluster is not None or config.machine.device_type == "cuda":
        check_installed()
    if not _works_at_once(pipeline.training.recipe):
        raise UserError("This method has no workers: leave out --pipeline.workers and --pipeline.cluster.")
    if 0 < blocks <= workers:
        raise UserError(
            f"{workers} workers need more than {blocks} blocks: leave --pipeline.blocks out, or give "
            f"{BLOCKS_EACH * workers}."
        )


def blocks_to_begin_with(fit: Fit, workers: int) -> int:
    """As few as fit the device, but enough for every worker.

    Args:
        workers: 0 for none, also where one process trains.

    Raises:
        UserError: they need several blocks, and there is no room for the layers around one.
    """
    if workers and not fit.limit:
        raise UserError(
            f"{bytes_in_words(fit.budget)} of the device have no room for a block among others, which "
            "workers need: train without workers, or on smaller photos."
        )
    return max(fit.blocks, BLOCKS_EACH * workers)


def _works_at_once(recipe: Recipe) -> bool:
    return not recipe.exact and recipe.overlap == 0


def number_of_workers(asked: int, blocks: int, training: TrainingConfig, device: torch.device | str) -> int:
    """`AbcdPipelineConfig.workers`, its 0 resolved.

    Args:
        blocks: of the scene.
    """
    if asked:
        return asked
    # Workers learn nothing of light and poses: two of them may show one photo.
    learns = training.light != "none" or training.poses != "off"
    if learns or not _works_at_once(training.recipe) or not can_fork(torch.device(device)):
        return 1
    return max(min(threads_wanted(), blocks // BLOCKS_EACH), 1)


def dispatcher_for(
    run: TrainingRun,
    config: TrainerConfig,
    count: int,
    budget: int,
    source: LayerSource,
    target: Callable[[Sample], Target],
) -> Dispatcher:
    """Lends the blocks of a run to workers: on the cores of this machine by forking, else by Ray.

    Args:
        count: of them.
        budget: bytes of each worker's device that training may take.
        source, target: see Coordinator; workers share the room of the one, where they share a device.

    Raises:
        WorkersError: they cannot be had.
    """
    room, of_device = source.room, 1 if config.machine.device_type == "cuda" else count
    setup = RunSetup.of(run, LayerRoom(room.device // of_device, room.ram // count))
    if config.pipeline.cluster is None and can_fork(run.device):
        workers = ForkedWorkers(count, VisitWorker(setup, run.rasterizer, target, run.device))
        lag = count  # nothing is on its way for long: no slack is needed
    else:
        workers, lag = _ray_workers(setup, config, count, budget), None
    return Dispatcher(run, workers, lag, source, target)


def _ray_workers(setup: RunSetup, config: TrainerConfig, count: int, budget: int) -> Workers:
    pipeline, on_gpu = config.pipeline, config.machine.device_type == "cuda"
    config = copy.deepcopy(config)
    config.pipeline.datamanager.photo_cache_gb = pipeline.datamanager.photo_cache_gb / count
    threads = 1 if on_gpu else max(threads_wanted() // count, 1)  # of machines that may be smaller
    if on_gpu and pipeline.cluster is None and torch.cuda.device_count() < count:
        raise WorkersError(
            f"{count} workers need {count} GPUs, one each, and this machine has {torch.cuda.device_count()}: "
            "ask for fewer."
        )
    connect(pipeline.cluster, cores=count * threads)
    # Imports Ray, which reads the environment that `connect` has set.
    from abcd_ns.cluster.ray_workers import RayWorkers

    make = partial(make_worker, config, setup, 0 if not on_gpu else int(PHOTO_SHARE * budget))
    workers = RayWorkers(count, make, gpus=int(on_gpu), cores=threads)
    CONSOLE.print(f"{count} workers are starting.", highlight=False)
    while not on_gpu and workers.idle < count:  # the warm-up, too, wants the cores that they start on
        workers.wait(1.0)
    return workers


def make_worker(config: TrainerConfig, setup: RunSetup, device_photo_bytes: int) -> VisitWorker:
    """In a worker's process: photos, rasterizer and options of the run.

    Raises:
        UserError: the data is not to be found where the run's driver has it, or is another.
    """
    device = torch.device("cuda" if config.machine.device_type == "cuda" else "cpu")
    data = config.pipeline.datamanager.setup(device=device, test_mode="val", world_size=1, local_rank=0)
    if len(data.train_dataset) != len(setup.views):
        raise UserError(
            f"{config.pipeline.datamanager.data} holds {len(data.train_dataset)} training photos here, and "
            f"{len(setup.views)} where the run was started: it must be the same folder on every machine."
        )
    data.device_photo_bytes = device_photo_bytes

    drawn_by, primitive = config.pipeline.model.rasterizer, setup.config.primitive
    rasterizer = make_rasterizer(drawn_by, device, primitive=primitive)
    return VisitWorker(setup, rasterizer, data.target, device, data.read_ahead)
