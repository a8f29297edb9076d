"""Assigned blocks come back as if they had never left; a lost worker loses nothing."""

import random
from dataclasses import replace
from functools import partial

import pytest
import torch

from abcd_ns.cluster.assignment import Report, WorkersError
from abcd_ns.cluster.dispatcher import LOSSES
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import EpochEnded, VisitBegan, VisitEnded, WorkerLost
from abcd_ns.engine.store.commit import with_pending
from abcd_ns.engine.train.density import control
from abcd_ns.engine.train.schedule import VisitPlan
from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.engine.train.training_loop import train, train_step
from tests.cluster.conftest import GROWING, InProcessWorkers, in_process
from tests.reference.scenes import STILL, equal, listen, stop, whole_scene


class Unreliable(InProcessWorkers):
    """They answer in any order, late, twice, or never.

    Args:
        fate: picks one of the members at work, and says what becomes of its visit: "lost", "late" (lost, and
            answered all the same), or "done".
    """

    def __init__(self, worker: VisitWorker, count: int, fate) -> None:
        super().__init__(worker, count)
        self._fate, self._late = fate, []
        self.lost = self.answered_late = 0

    def wait(self, seconds):  # noqa: ARG002 - nothing is under way meanwhile
        late, self._late = self._late, []
        busy = [member for member in self._members if member.assignment is not None]
        if not busy:
            return late
        member, fate = self._fate(busy)
        assignment = member.put_down()
        if fate == "done":
            return [*late, Report(assignment.number, (1, 20.0)), self._finish(assignment)]
        self.lost += 1
        if fate == "late":  # and with another answer
            number, outcome = self._finish(assignment)
            self._late = [Report(number, replace(outcome, state=outcome.state.nobody))]
            self.answered_late += 1
        return [*late, Report(assignment.number, fate)]


WARM_UP = {"density": STILL, "coarse_model": 40, "warmup": 0.3}
HARMONICS = {"late_harmonics": 2, "block_limit": 30}
"""They come late, while blocks in their first visits still grow; workers keep to the room that they leave."""


@pytest.mark.parametrize(
    "options",
    [
        {"density": GROWING},
        WARM_UP,
        {"density": replace(GROWING, refine_stop=0.2, min_contribution=0.0), **HARMONICS},
    ],
)
def test_with_one_visit_at_a_time_the_run_is_that_of_a_coordinator(make, photos, options, monkeypatch):
    monkeypatch.setattr(control, "MOST_NEW", 1.0)
    alone, assigned = make("alone", **options), make("assigned", workers=1, lag=1, **options)
    train(alone, photos)
    train(assigned, photos)
    assert alone.state.step == assigned.state.step == 60
    assert alone.state.sh_degree == 1
    assert equal(whole_scene(alone), whole_scene(assigned))
    assert alone.state.to_json() | {"seconds": 0} == assigned.state.to_json() | {"seconds": 0}


def unreliable(photos, fate) -> partial:
    return partial(in_process, photos=photos, count=2, kind=partial(Unreliable, fate=fate))


def test_what_a_run_computes_does_not_depend_on_who_is_done_first_or_lost(make, photos, steady):
    rng = random.Random(3)

    def fate(members):
        return rng.choice(members), rng.choices(["done", "lost", "late"], [6, 1, 1])[0]

    shaken = make("shaken", workers=unreliable(photos, fate), lag=4, density=GROWING)
    lost = listen(shaken, WorkerLost)
    train(shaken, photos)
    assert len(lost) == shaken.workers.lost > 0
    assert shaken.workers.answered_late > 0
    assert equal(steady[0], whole_scene(shaken))
    assert steady[2].to_json() | {"seconds": 0} == shaken.state.to_json() | {"seconds": 0}


def test_visits_that_are_out_at_once_train_other_blocks_and_end_in_their_order(make, photos):
    run = make(workers=3, density=STILL)
    events, epochs = listen(run, VisitBegan | VisitEnded), listen(run, EpochEnded)
    train(run, photos)
    out, most, ended = set(), 0, []
    for event in events:
        if isinstance(event, VisitBegan):
            assert event.block not in out
            out.add(event.block)
            most = max(most, len(out))
        else:
            out.remove(event.block)
            ended.append(event.visit)
    assert most > 1
    assert ended == sorted(ended)
    assert not out
    assert [event.epoch for event in epochs] == list(range(run.state.epoch + 1))
    assert run.state.step == 60


def test_who_has_a_long_visit_keeps_no_other_from_beginning_the_next(make, photos):
    run = make(workers=2, density=STILL, lag=2, steps=8)
    run.state.views = dict.fromkeys(range(4), 8)
    run.state.queue = [VisitPlan(block, steps) for block, steps in enumerate((4, 1, 1, 2))]
    events = listen(run, VisitBegan | VisitEnded)
    train(run, photos)
    heard = [(type(event) is VisitBegan, event.visit) for event in events]
    assert [visit for begins, visit in heard if not begins] == [1, 2, 0, 3]
    assert heard.index((True, 3)) < heard.index((False, 0))


def test_nobody_who_moves_meanwhile_is_lost(make, photos):
    """Gaussians that come to wait for a block while it is out are there when it is home, though it be cut."""
    run = make(workers=3, lag=5, density=STILL, steps=90, block_limit=24)
    total, generator = run.count(), torch.Generator().manual_seed(0)
    wait = run.workers.wait

    def elsewhere(outcome):
        gaussians = outcome.state.gaussians
        means = gaussians.means + 0.3 * torch.randn(gaussians.means.shape, generator=generator)
        return replace(outcome, state=replace(outcome.state, gaussians=replace(gaussians, means=means)))

    run.workers.wait = lambda seconds: [Report(n, elsewhere(outcome)) for n, outcome in wait(seconds)]
    moved, blocks = 0, set()
    while not run.finished:
        train_step(run, photos)
        assert run.count() == total
        blocks.add(run.scene.tree.num_blocks)
        moved += run.scene.pending is not None and len(run.scene.pending) > 0
    assert moved > 0
    assert max(blocks) > 6
    for block in range(run.scene.tree.num_blocks):
        means = with_pending(run.scene, block).gaussians.means
        assert bool((run.scene.tree.assign(means) == block).all())


def test_a_scene_that_is_cut_anew_keeps_two_blocks_for_each_visit_at_once(make, photos):
    run = make(workers=2, lag=2, density=STILL, steps=90, block_limit=90)
    assert run.scene.tree.num_blocks > 4
    train(run, photos)
    assert run.scene.tree.num_blocks == 4


@pytest.mark.parametrize("goes_on_with", [None, 3])
def test_a_run_that_stops_goes_on_with_any_number_of_workers(make, photos, goes_on_with):
    """Also alone: what was out is planned again."""
    stopped = make(workers=2, lag=4, density=STILL)
    while stopped.state.step < 20 or not stopped.state.in_flight:
        train_step(stopped, photos)
    out = [visit.geometry.block for visit in stopped.state.in_flight]
    stop(stopped)
    resumed = make(workers=goes_on_with, resume=True, density=STILL)
    assert resumed.state.step == stopped.state.step
    assert [plan.block for plan in resumed.state.queue][: len(out)] == out
    train(resumed, photos)
    assert resumed.state.step == 60
    assert len(whole_scene(resumed)) == len(whole_scene(stopped))


def test_visits_that_are_under_way_are_kept_when_a_run_stops(make, photos):
    stopped = make(workers=2, lag=4, density=STILL)
    while stopped.state.step < 20 or stopped.workers.idle:
        train_step(stopped, photos)
    before, planned = stopped.state.step, stopped.state.planned
    assert stopped.state.in_flight
    assert stopped.await_visits()
    assert (stopped.state.in_flight, stopped.state.planned) == ([], planned)
    assert stopped.state.step == planned > before
    assert not stopped.await_visits()
    stop(stopped)
    resumed = make(workers=2, resume=True, density=STILL)
    assert resumed.state.step == stopped.state.step
    train(resumed, photos)
    assert resumed.state.step == 60


def test_a_visit_that_ends_every_worker_ends_the_run_with_one_line(make, photos):
    run = make(workers=unreliable(photos, lambda members: (members[0], "lost")))
    with pytest.raises(WorkersError, match=rf"lost {LOSSES} workers.*abcd plan"):
        train(run, photos)
    assert run.state.step == 0


def test_a_limit_on_gaussians_holds_for_all_that_are_out(make, photos):
    density = replace(GROWING, max_gaussians=100, cull_alpha_thresh=0.0)
    run = make(workers=3, density=density)
    while not run.finished:
        train_step(run, photos)
        assert run.count() <= 100
    assert run.count() > 90


def test_workers_apply_the_light_of_the_moment_and_leave_it(make, photos):
    run = make(workers=2, lag=2, light="affine", **WARM_UP)
    while not run.trains_elsewhere:
        train(run, photos, steps=1)
    before = {view: run.run.light.of(view).detach() for view in run.views}
    assert any(bool((transform.diff(dim=-1) != 0).any()) for transform in before.values())
    assigned, submit = [], run.workers.submit
    run.workers.submit = lambda assignment: (assigned.append(assignment.task.light), submit(assignment))
    train(run, photos)
    assert assigned
    assert all(torch.equal(found, before[view]) for light in assigned for view, found in light.items())
    assert all(torch.equal(run.run.light.of(view), before[view]) for view in before)


def test_workers_draw_from_the_poses_that_the_warm_up_has_found(make, photos, monkeypatch):
    monkeypatch.setattr(pose_rounds, "FIRST", 0.0)
    drawn_from, run_of = [], VisitWorker._run_of

    def watched(worker, task, scene):
        run = run_of(worker, task, scene)
        drawn_from.append({view: found.viewmat for view, found in run.views.items()})
        return run

    monkeypatch.setattr(VisitWorker, "_run_of", watched)
    run = make(workers=2, poses="SO3xR3", target=photos.target, **WARM_UP)
    given = {index: view.viewmat for index, view in run.views.items()}
    while not run.trains_elsewhere:
        train(run, photos, steps=1)
    found = dict(run.run.poses.refined)
    assert not any(torch.equal(pose, given[view]) for view, pose in found.items())
    train(run, photos)
    assert drawn_from
    assert all(torch.equal(seen[view], pose) for seen in drawn_from for view, pose in found.items())
    assert run.run.poses.refined == found


def test_what_was_trained_here_leaves_the_device_before_anything_is_assigned(make, photos):
    alone = make("run", **WARM_UP)
    train(alone, photos, steps=3)
    assert alone.state.active is not None
    stop(alone)
    run = make("run", workers=2, resume=True, **WARM_UP)
    while not run.trains_elsewhere:
        train(run, photos, steps=1)
    held, submit = [], run.workers.submit
    run.workers.submit = lambda assignment: (held.append(len(run.params["means"])), submit(assignment))
    train(run, photos)
    assert held
    assert not any(held)
