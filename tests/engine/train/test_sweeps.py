"""What a sweep visits, what is known of it ahead, how blocks grow in the first, how rates fall at the end."""

import pytest

from abcd_ns.engine.events import PhotosWanted, SweepEnded, VisitBegan
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.health_record import BlockHealth
from abcd_ns.engine.train.planner import LOOK_AGAIN
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.train.schedule import VisitPlan, views_per_step
from abcd_ns.engine.train.step.batch import COMING
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import listen, make_coordinator


def test_who_is_hidden_is_no_part_of_a_sweep_until_looked_at_again(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=10_000, density=DensityConfig(strategy="off")
    )
    ended, began = listen(coordinator, SweepEnded), listen(coordinator, VisitBegan)
    while not ended:
        train(coordinator, photos, steps=1)
    for block in range(4):
        for other in {0, 1, 2, 3} - {block}:
            coordinator.state.health[other] = BlockHealth(hidden=True)
        before = len(ended)
        while len(ended) == before:
            train(coordinator, photos, steps=1)
        sweep = ended[-1].sweep
        assert sweep == before
        expected = {block} if sweep % LOOK_AGAIN else {0, 1, 2, 3}
        assert {visit.block for visit in began if visit.sweep == sweep} == expected
        coordinator.state.health.clear()


@pytest.mark.parametrize("blocks", [1, 4])
def test_photos_of_a_step_and_of_those_to_come_are_wanted(tmp_path, views, start, blocks):
    coordinator = make_coordinator(tmp_path, start, views, blocks=blocks, steps=24)
    wanted = listen(coordinator, PhotosWanted)
    told: dict[int, list[tuple[int, ...]]] = {}
    drawn: dict[int, list[int]] = {}
    while not coordinator.finished:
        batch = coordinator.next_batch()
        visit = coordinator.run.active.number
        told.setdefault(visit, []).append(wanted[-1].views)
        drawn.setdefault(visit, []).extend(sample.view.index for sample in batch.samples)
        coordinator.after_step(coordinator.render(batch))
    for visit, order in drawn.items():
        for step, views_told in enumerate(told[visit]):
            follows = order[step * coordinator.batch :][: coordinator.batch + COMING]
            assert list(views_told[: len(follows)]) == follows
    assert any(len(views_told) > coordinator.batch for views_told in told[0])


def test_a_block_draws_more_views_a_step_as_it_grows_up_also_when_it_goes_on(
    tmp_path, views, start, monkeypatch
):
    monkeypatch.setattr("abcd_ns.engine.train.schedule.YOUNG", 20)  # these see a few dozen
    options = {"blocks": 3, "steps": 150, "fast_start": True, "density": DensityConfig(strategy="off")}
    coordinator, drawn, expected, stops = make_coordinator(tmp_path, start, views, **options), set(), 0, 0
    while not coordinator.finished:
        batch = coordinator.next_batch()
        active = coordinator.run.active
        if active.done == 0:
            expected = views_per_step(0, 3, trained=coordinator.visit.live.clocks.adam_views)
        assert len(batch.samples) == coordinator.batch == expected
        drawn.add(expected)
        coordinator.after_step(coordinator.render(batch))
        if active.done == 1 and expected == 2:  # in the midst of a visit
            coordinator.save()
            coordinator.scene.store.close()
            coordinator, stops = make_coordinator(tmp_path, start, views, resume=True, **options), stops + 1
    assert drawn == {1, 2, 4}
    assert stops > 0


def test_a_visit_that_goes_on_with_less_memory_draws_no_more_views_than_fit(tmp_path, views, start):
    options = {"blocks": 3, "steps": 150, "density": DensityConfig(strategy="off")}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    coordinator.after_step(coordinator.render(coordinator.next_batch()))
    assert coordinator.batch == 4
    coordinator.save()
    coordinator.scene.store.close()
    went_on = make_coordinator(tmp_path, start, views, resume=True, batch_limit=2, **options)
    assert went_on.run.active.done == 1
    assert len(went_on.next_batch().samples) == went_on.batch == 2


def test_a_queue_of_before_visits_knew_their_batch_is_read():
    state = RunState(queue=[VisitPlan(3, 10, 2)]).to_json()
    assert RunState.from_json(state).queue == [VisitPlan(3, 10, 2)]
    state["queue"] = [[3, 10]]
    assert RunState.from_json(state).queue == [VisitPlan(3, 10)]


def test_rates_fall_at_the_end_but_not_in_the_first_visit_to_a_block(
    tmp_path, views, photos, start, monkeypatch
):
    monkeypatch.setattr("abcd_ns.engine.train.schedule.SETTLING_VIEWS", 1)  # these see a few dozen
    still = DensityConfig(strategy="off")
    options = {"steps": 55, "density": still, "visit_steps": 5, "fast_start": True}
    coordinator = make_coordinator(tmp_path, start, views, blocks=7, **options)
    began, rates = listen(coordinator, VisitBegan), dict[int, set[float]]()
    while not coordinator.finished:
        train(coordinator, photos, steps=1)
        rates.setdefault(began[-1].visit, set()).add(coordinator.optimizers["quats"].param_groups[0]["lr"])
    first, second = [rates[visit.visit] for visit in began[:7]], [rates[visit.visit] for visit in began[7:]]
    assert sorted(visit.block for visit in began[:7]) == list(range(7))
    # As large as they ever are, though the first sweep goes on when three fifths of the run are done.
    (whole,) = set.union(*first)
    assert max(set.union(*second)) < whole
    assert min(second[-1]) < 0.2 * whole


def test_a_run_whose_growth_is_over_grows_in_the_first_visit_to_each_block(tmp_path, views, photos, start):
    density = DensityConfig(refine_start=0.0, refine_stop=0.01, refine_every=1, split_pixels=0.0, price=0)
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=2, steps=60, scaffold=40, visit_steps=8, density=density
    )
    counts: dict[bool, dict[int, set[int]]] = {True: {}, False: {}}
    while not coordinator.finished:
        train_step(coordinator, photos)
        active, live = coordinator.state.active, coordinator.visit.live
        if active is not None and not active.is_whole:
            counts[live.clocks.visits == 0].setdefault(active.geometry.block, set()).add(len(live))
    assert [len(found) for found in counts[True].values()] == [2, 2]  # before it grew, and after
    assert [len(found) for found in counts[False].values()] == [1, 1]
