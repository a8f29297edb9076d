"""Workers that Ray starts: checks of their options, and what each reads when it starts."""

import copy
from functools import partial

import torch
from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns.cluster.assignment import Workers, WorkersError
from abcd_ns.cluster.connect import check_installed, connect
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.data.input_errors import say
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.train.memory import PHOTO_SHARE
from abcd_ns.errors import UserError
from abcd_ns.machine import threads_wanted
from abcd_ns.run.fit import BLOCKS_EACH, works_at_once


def check_workers(config: TrainerConfig) -> None:
    """Raise a UserError if workers are of no use, or cannot be had."""
    pipeline = config.pipeline
    workers, cluster, blocks = pipeline.workers, pipeline.cluster, pipeline.blocks
    if cluster is not None and not workers:
        raise UserError(f"--pipeline.cluster {cluster} needs a number of workers: add --pipeline.workers.")
    if workers <= 1 and cluster is None:
        return
    if cluster is not None or config.machine.device_type == "cuda":
        check_installed()
    if not works_at_once(pipeline.training.recipe):
        raise UserError("This method has no workers: leave out --pipeline.workers and --pipeline.cluster.")
    if 0 < blocks <= workers:
        raise UserError(
            f"{workers} workers need {workers + 1} blocks or more: leave --pipeline.blocks out, or give "
            f"{BLOCKS_EACH * workers}."
        )


def ray_workers(config: TrainerConfig, setup: RunSetup, count: int, budget: int) -> Workers:
    """`count` workers, each with `budget` bytes of a GPU or on a cluster; or a WorkersError."""
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
    say(f"{count} workers are starting.")
    try:
        while not on_gpu and workers.idle < count:  # the warm-up, too, wants the cores that they start on
            workers.wait(1.0)
    except BaseException:  # Ctrl-C, too: the process may live on, as a notebook's does
        workers.close()
        raise
    return workers


def make_worker(config: TrainerConfig, setup: RunSetup, device_photo_bytes: int) -> VisitWorker:
    """In a worker's process: photos, rasterizer and options of the run; a UserError if its data differs."""
    device = torch.device("cuda" if config.machine.device_type == "cuda" else "cpu")
    data = config.pipeline.datamanager.setup(device=device, test_mode="val", world_size=1, local_rank=0)
    if len(data.train_dataset) != len(setup.views):
        raise UserError(
            f"{config.pipeline.datamanager.data} holds {len(data.train_dataset)} training photos here, and "
            f"{len(setup.views)} where the run was started: it must be the same folder on every machine."
        )
    data.device_photo_bytes = device_photo_bytes

    rasterizer = make_rasterizer(config.pipeline.model.rasterizer, device, primitive=setup.config.primitive)
    return VisitWorker(setup, rasterizer, data.target, device, data.read_ahead)
