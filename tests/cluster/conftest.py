"""A small scene, and runs of it whose blocks are assigned to workers."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from abcd_ns.cluster.assignment import Assignment, Member, Report, Workers
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.visit_worker import RunSetup, VisitWorker
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.training_loop import train
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0, min_contribution=2.0)


class InProcessWorkers(Workers):
    """As many as are asked for, who take turns: none trains but while someone waits."""

    def __init__(self, worker: VisitWorker, count: int = 1) -> None:
        super().__init__([Member(number) for number in range(count)])
        self._worker = worker

    def submit(self, assignment: Assignment) -> None:
        self._longest_idle().take(assignment)

    def hold(self) -> bool:
        return True

    def wait(self, seconds: float) -> list[Report]:  # noqa: ARG002 - nothing is under way meanwhile
        """Train the visit that was submitted first."""
        busy = [member for member in self._members if member.assignment is not None]
        if not busy:
            return []
        return [self._finish(min(busy, key=lambda member: member.assignment.number).put_down())]

    def _finish(self, assignment: Assignment) -> Report:
        outcome = self._worker.visit(assignment.task, assignment.state(), assignment.drawn)
        return Report(assignment.number, outcome)

    def close(self) -> None: ...


@pytest.fixture(scope="session")
def views():
    return ring_of_views(8, width=32, height=24)


@pytest.fixture(scope="session")
def photos(views):
    return Photos(random_gaussians(60, seed=1), views)


def setup_of(run: TrainingRun) -> RunSetup:
    return RunSetup.of(run, LayerRoom())


def in_process(
    run: TrainingRun, photos: Photos, count: int, kind: Callable = InProcessWorkers, **setup
) -> InProcessWorkers:
    worker = VisitWorker(replace(setup_of(run), **setup), TorchRasterizer(), photos.target)
    return kind(worker, count)


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
    """What two workers in this process make of a run that grows, the setup of its workers, and its state."""
    folder = tmp_path_factory.mktemp("steady")
    run = make_run(folder, views, lambda run: in_process(run, photos, 2), lag=4, density=GROWING)
    train(run, photos)
    return whole_scene(run), setup_of(run.run), run.state
