"""A small scene, and runs of it whose blocks are lent to workers."""

import pytest

from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.visit_worker import AdamOptions, RunSetup, VisitWorker
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.layer_source import LayerRoom
from abcd_ns.engine.train.run import TrainingRun
from tests.cluster.in_process import InProcessWorkers
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views


@pytest.fixture(scope="session")
def views():
    return ring_of_views(8, width=32, height=24)


@pytest.fixture(scope="session")
def photos(views):
    return Photos(random_gaussians(60, seed=1), views)


def setup_of(run: TrainingRun) -> RunSetup:
    """What workers need to know of a run."""
    optimizers = {name: AdamOptions.of(optimizer) for name, optimizer in run.optimizers.items()}
    return RunSetup(run.config, run.budget, list(run.views.values()), optimizers, LayerRoom())


def in_process(run: TrainingRun, photos: Photos, count: int) -> InProcessWorkers:
    """So many workers of a run, in this process."""
    worker = VisitWorker(setup_of(run), TorchRasterizer(), lambda s: (photos(s.view.index, s.crop), None))
    return InProcessWorkers(worker, count)


@pytest.fixture
def make(tmp_path, views, photos):
    """Makes runs: by a coordinator alone, or with `workers` by a dispatcher."""

    def made(name: str = "run", workers=None, lag: int | None = None, target=None, **options):
        (tmp_path / name).mkdir(exist_ok=True)
        options = {"blocks": 6, "steps": 60, **options}

        def kind(run: TrainingRun):
            local = Coordinator(run, target=target)
            if workers is None:
                return local
            return Dispatcher(
                local, workers(run) if callable(workers) else in_process(run, photos, workers), lag
            )

        return make_coordinator(tmp_path / name, random_gaussians(90, seed=2), views, kind=kind, **options)

    return made
