"""A small scene, and runs of it whose blocks are assigned to workers."""

import pytest

from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.training_loop import train
from tests.cluster.in_process import InProcessWorkers
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0, min_contribution=2.0)


@pytest.fixture(scope="session")
def views():
    return ring_of_views(8, width=32, height=24)


@pytest.fixture(scope="session")
def photos(views):
    return Photos(random_gaussians(60, seed=1), views)


def setup_of(run: TrainingRun) -> RunSetup:
    return RunSetup.of(run, LayerRoom())


def in_process(run: TrainingRun, photos: Photos, count: int) -> InProcessWorkers:
    worker = VisitWorker(setup_of(run), TorchRasterizer(), lambda s: (photos(s.view.index, s.crop), None))
    return InProcessWorkers(worker, count)


def make_run(folder, views, workers_of=None, lag: int | None = None, target=None, **options):
    """A run by a coordinator alone, or by a dispatcher and the workers that `workers_of` a run gives."""

    def kind(run: TrainingRun):
        if workers_of is None:
            return Coordinator(run, target=target)
        return Dispatcher(run, workers_of(run), lag, target=target)

    folder.mkdir(exist_ok=True)
    options = {"blocks": 6, "steps": 60, **options}
    return make_coordinator(folder, random_gaussians(90, seed=2), views, kind=kind, **options)


@pytest.fixture
def make(tmp_path, views, photos):
    """Makes runs: alone, with so many `workers` in this process, or with those that it gives."""

    def made(name: str = "run", workers=None, **options):
        count = workers
        if isinstance(workers, int):
            workers = lambda run: in_process(run, photos, count)  # noqa: E731
        return make_run(tmp_path / name, views, workers, **options)

    return made


@pytest.fixture(scope="session")
def steady(tmp_path_factory, views, photos):
    """What two workers in this process make of a run that grows, and the setup of its workers."""
    folder = tmp_path_factory.mktemp("steady")
    run = make_run(folder, views, lambda run: in_process(run, photos, 2), lag=4, density=GROWING)
    train(run, photos)
    return whole_scene(run), setup_of(run.run)
