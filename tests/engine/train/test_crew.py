"""Several processes share the views of a step, and nobody can tell from the result."""

import functools
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest
import torch

from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.schedule import size_of_crew, view_order, views_of_member
from abcd_ns.engine.train.step.workers import crew as crew_module
from abcd_ns.engine.train.step.workers.helper_process import can_fork
from abcd_ns.engine.train.step.workers.shared_memory import SharedRows
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import PARAM_NAMES
from abcd_ns.errors import UserError
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

pytestmark = pytest.mark.skipif(not can_fork(torch.device("cpu")), reason="needs Linux without a GPU")
GROWING = DensityConfig(refine_start=0.0, refine_stop=0.8, refine_every=5, densify_grad_thresh=1e-5)
"""So that blocks grow within a visit."""
WARM = {"scaffold": 40, "warmup": 0.3, "steps": 40}
"""A run that begins with a warm-up."""


@pytest.fixture(scope="module")
def views():
    return ring_of_views(8)


@pytest.fixture(scope="module")
def photos(views):
    return Photos(random_gaussians(60, seed=1), views)


def gather(folder, views, photos, processes: int = 2, **options):
    """A coordinator that gathers crews."""
    folder.mkdir(exist_ok=True)
    options = {"blocks": 2, "steps": 30, "density": GROWING, **options}
    options = {"target": lambda s: (photos(s.view.index, s.crop), None), **options}
    return make_coordinator(folder, random_gaussians(60, seed=2), views, processes=processes, **options)


@pytest.fixture
def make(tmp_path, views, photos):
    """Makes coordinators that gather crews."""

    def made(name: str = "run", processes: int = 2, **options):
        return gather(tmp_path / name, views, photos, processes, **options)

    return made


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, views, photos):
    """Scenes of runs that nothing befell: of blocks alone, and after a warm-up."""

    @functools.cache
    def trained(warm: bool):
        run = gather(tmp_path_factory.mktemp("undisturbed"), views, photos, **(WARM if warm else {}))
        train(run, photos)
        return whole_scene(run)

    return lambda options: trained(options is WARM)


def equal(one, other) -> bool:
    return len(one) == len(other) and all(
        torch.equal(getattr(one, n), getattr(other, n)) for n in PARAM_NAMES
    )


def is_alive(pid: int) -> bool:
    with suppress(OSError, ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


def test_a_step_is_the_one_that_a_single_process_takes(make, photos):
    """The same views, the same weights: gradients equal those of all views drawn at once."""
    shared, alone = make("shared", batch=4, density=DensityConfig("off")), make("alone", 1, batch=4)
    batch = shared.next_batch()
    crew = shared.visit.steps.crew
    assert len(batch.samples) == 2
    assert len(crew.pids) == 1
    rendered = shared.render(batch)
    loss = shared.loss(batch, rendered.pictures, [photos(s.view.index, s.crop) for s in batch.samples])
    loss.backward()
    order = shared.visit.steps._order_of(shared.state.active, 1)
    helped = [shared.visit.steps._sample(view, 2 + k, 0) for k, view in enumerate(order[:2])]
    alone.next_batch()
    every = type(batch)(0, (*batch.samples, *helped))
    drawn = alone.render(every)
    wanted = alone.loss(every, drawn.pictures, [photos(s.view.index, s.crop) for s in every.samples])
    wanted.backward()
    assert torch.allclose(loss, wanted, rtol=1e-6)
    for name in PARAM_NAMES:
        found, expected = shared.params[name].grad, alone.params[name].grad
        assert torch.allclose(found, expected, rtol=1e-4, atol=1e-7 * float(expected.abs().max())), name
    crew.dismiss()


def test_what_density_control_counts_is_that_of_all_views(make, photos):
    """Sums over the views of all members are those of the same views drawn in one process."""
    shared, alone = make("shared", batch=4), make("alone", 1, batch=4)
    batch = shared.next_batch()
    crew, order = shared.visit.steps.crew, shared.visit.steps._order_of(shared.state.active, 1)
    rendered = shared.render(batch)
    shared.loss(batch, rendered.pictures, [photos(s.view.index, s.crop) for s in batch.samples]).backward()
    (part,) = crew.contributions()
    own = shared.density.count(shared.params["means"], rendered.infos)
    found = {name: own[name] + part.counts[name] for name in own}
    alone.next_batch()
    helped = [shared.visit.steps._sample(view, 2 + k, 0) for k, view in enumerate(order[:2])]
    every = type(batch)(0, (*batch.samples, *helped))
    drawn = alone.render(every)
    alone.loss(every, drawn.pictures, [photos(s.view.index, s.crop) for s in every.samples]).backward()
    wanted = alone.density.count(alone.params["means"], drawn.infos)
    assert torch.equal(found["count"], wanted["count"])
    assert float(wanted["count"].sum()) > 0
    assert torch.allclose(found["grad2d"], wanted["grad2d"], rtol=1e-4)
    assert bool((wanted["looks"] == 4).all())
    assert torch.equal(found["looks"], wanted["looks"])
    assert torch.allclose(found["weight"], wanted["weight"], rtol=1e-4, atol=1e-5)
    crew.dismiss()


def test_a_step_of_the_warm_up_is_the_one_that_a_single_process_takes(make, photos):
    shared, alone = make("shared", **WARM), make("alone", 1, **WARM)
    for coordinator in (shared, alone):
        train(coordinator, photos, steps=3)
        assert coordinator.state.active.is_whole
    for name in PARAM_NAMES:  # Adam makes much of rounding in gradients that are next to nothing
        shared.params[name].data.copy_(alone.params[name].data)
    drawn = []
    for coordinator in (shared, alone):
        batch = coordinator.next_batch()
        for parameter in coordinator.params.values():
            parameter.grad = None
        rendered = coordinator.render(batch)
        wanted = [photos(s.view.index, s.crop) for s in batch.samples]
        coordinator.loss(batch, rendered.pictures, wanted).backward()
        drawn.append([s.view.index for s in batch.samples])
    (own,), both = drawn
    assert shared.state.active.crew == 2
    assert both == [own, *shared.visit.steps._views_of_step(shared.state.active, (), 3, member=1)]
    assert len(set(both)) == 2
    for name in PARAM_NAMES:
        found, expected = shared.params[name].grad, alone.params[name].grad
        assert torch.allclose(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max())), name
    shared.visit.steps.crew.dismiss()


@pytest.mark.parametrize("options", [{}, WARM], ids=["blocks", "warm-up"])
def test_a_run_does_not_depend_on_helpers_that_live(make, photos, undisturbed, monkeypatch, options):
    """Nor on those that are killed in the midst of it."""
    helped, lost, never = undisturbed(options), make("lost", **options), make("never", **options)
    while not lost.finished:
        train_step(lost, photos)
        if lost.state.step % 4 == 0 and lost.visit.steps.crew is not None:
            for pid in lost.visit.steps.crew.pids:
                os.kill(pid, signal.SIGKILL)
    monkeypatch.setattr("abcd_ns.engine.train.step.drawing.can_fork", lambda _: False)
    train(never, photos)
    assert len(helped) > 60  # blocks grew
    assert equal(helped, whole_scene(lost))
    assert equal(helped, whole_scene(never))


def raising_in_helpers(photos, error: Exception):
    """What gives targets here, and raises in processes that were forked from this one."""
    here = os.getpid()

    def target(sample):
        if os.getpid() != here:
            raise error
        return photos(sample.view.index, sample.crop), None

    return target


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (KeyError("no photo 3"), r"KeyError: 'no photo 3' \(test_crew\.py:\d+, in target\)\..*processes"),
        (ValueError("two\nlines"), r"ValueError: two \(test_crew"),
        (UserError("The photo is gone: put it back."), r"^The photo is gone: put it back\.$"),
    ],
)
def test_what_goes_wrong_in_a_helper_ends_the_run_in_one_line(make, photos, error, words):
    run = make(target=raising_in_helpers(photos, error))
    with pytest.raises(UserError, match=words) as raised:
        train(run, photos)
    assert "\n" not in str(raised.value)
    assert run.visit.steps.crew.pids == ()


def test_so_does_what_goes_wrong_when_it_gives_its_gradients(make, photos, monkeypatch):
    def give(*_):
        raise ValueError("no gradients")

    monkeypatch.setattr("abcd_ns.engine.train.step.workers.helper_process.Room.give", give)
    with pytest.raises(UserError, match="ValueError: no gradients"):
        train(make(), photos)


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_a_helper_that_runs_out_of_memory_is_stood_in_for(make, photos, undisturbed, error):
    run = make(target=raising_in_helpers(photos, error))
    train(run, photos)
    assert equal(undisturbed({}), whole_scene(run))


def test_a_block_that_outgrows_the_shared_memory_is_trained_all_the_same(
    make, photos, undisturbed, monkeypatch
):
    wide = undisturbed({})
    monkeypatch.setattr(crew_module, "GROWTH", 1)
    monkeypatch.setattr(crew_module, "SPARE", 3)
    narrow = make("narrow")
    train(narrow, photos)
    assert len(wide) > 66
    assert equal(wide, whole_scene(narrow))


@pytest.mark.parametrize(("options", "stop"), [({}, 3), ({}, 8), ({}, 17), (WARM, 5), (WARM, 12)])
def test_a_run_that_stops_and_goes_on_is_the_run_that_did_not(make, photos, undisturbed, options, stop):
    stopped = make("stopped", **options)
    train(stopped, photos, steps=stop)
    stopped.save()
    stopped.scene.store.close()
    resumed = make("stopped", resume=True, **options)
    train(resumed, photos)
    assert equal(undisturbed(options), whole_scene(resumed))


def test_each_member_has_its_part_of_the_room_for_layers(make, photos, undisturbed):
    """And draws anew what has no room there."""
    tight = make("tight", layer_bytes=80_000)
    held = []
    while not tight.finished:
        train_step(tight, photos)
        if tight.visit.steps.crew is not None:
            assert len(tight.visit.steps.crew.pids) == 1
            held.append(tight.layer_bytes)
    assert 0 < max(held) <= 40_000
    assert equal(undisturbed({}), whole_scene(tight))


def test_helpers_end_with_their_visit(make, photos):
    coordinator, seen = make(), set()
    threads = torch.get_num_threads()
    while not coordinator.finished:
        train_step(coordinator, photos)
        if coordinator.visit.steps.crew is not None:
            seen |= set(coordinator.visit.steps.crew.pids)
    assert len(seen) >= 2
    assert not any(is_alive(pid) for pid in seen)
    assert torch.get_num_threads() == threads


def test_what_counts_is_masked_in_helpers_too(make, photos):
    """A helper that is shown nothing but masked pixels adds nothing."""
    nothing = make(
        target=lambda s: (photos(s.view.index, s.crop), torch.zeros(s.crop.height, s.crop.width, 1))
    )
    nothing.next_batch()
    (part,) = nothing.visit.steps.crew.contributions()
    assert all(float(value.abs().max()) == 0 for value in part.gradients.values())
    nothing.visit.steps.crew.dismiss()


def test_a_helper_does_not_outlive_the_training_process(tmp_path):
    """Not even one that is killed; `kill -9` runs no handler."""
    script = f"""
import sys, time
sys.path.insert(0, {os.getcwd()!r})
from pathlib import Path
from tests.reference.scenes import *
views = ring_of_views(8)
photos = Photos(random_gaussians(60, seed=1), views)
coordinator = make_coordinator(
    Path({str(tmp_path)!r}), random_gaussians(60, seed=2), views, blocks=2, steps=30, processes=2,
    target=lambda s: (photos(s.view.index, s.crop), None))
coordinator.next_batch()
print(*coordinator.visit.steps.crew.pids, flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        helper = int(process.stdout.readline())
        assert is_alive(helper)
        process.kill()
    until = time.monotonic() + 20
    while is_alive(helper) and time.monotonic() < until:
        time.sleep(0.05)
    assert not is_alive(helper)


def test_crews_share_views_fairly():
    assert [size_of_crew(p, 4, 9) for p in (1, 2, 3, 4, 16)] == [1, 2, 2, 4, 4]
    assert (size_of_crew(4, 4, 3), size_of_crew(4, 4, 1), size_of_crew(8, 1, 9)) == (2, 1, 1)
    views = (3, 5, 8, 9, 12)
    parts = [views_of_member(views, member, 2) for member in range(2)]
    assert sorted(parts[0] + parts[1]) == list(views)
    assert parts[0][-1] == views[-1]  # the view that is measured is the training process' own
    assert views_of_member(views, 0, 1) == views
    assert view_order(views, 5, 1, 0) != view_order(views, 5, 1, 0, member=1)


def test_shared_rows_change_in_number_within_their_room():
    room = SharedRows({"means": (3,), "count": ()}, 10)
    room.write({"means": torch.ones(4, 3), "count": torch.arange(4.0)})
    assert torch.equal(room.rows("count", 4), torch.arange(4.0))
    assert room.rows("means", 10).shape == (10, 3)
    assert float(room.rows("means", 10).sum()) == 12
    with pytest.raises(ValueError, match="11 rows"):
        room.rows("means", 11)


@pytest.mark.parametrize("options", [{}, WARM], ids=["blocks", "warm-up"])
def test_a_run_goes_on_where_there_can_be_no_processes(make, photos, monkeypatch, options):
    """On a GPU, say: the visit under way is ended as it began, those that follow have no crew."""
    straight, stopped = make("straight", **options), make("stopped", **options)
    train(stopped, photos, steps=3)
    assert stopped.state.active.crew == 2
    left = stopped.state.active.steps - 3 if not options else 2
    train(straight, photos, steps=3 + left)
    stopped.save()
    stopped.scene.store.close()
    monkeypatch.setattr("abcd_ns.engine.train.step.drawing.can_fork", lambda _: False)
    resumed = make("stopped", processes=1, resume=True, **options)
    for _ in range(left):
        train_step(resumed, photos)
        assert resumed.visit.steps.crew is None or resumed.visit.steps.crew.pids == ()
    assert equal(whole_scene(straight), whole_scene(resumed))
    train(resumed, photos)
    assert resumed.finished
