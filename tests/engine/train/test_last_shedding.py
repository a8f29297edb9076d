"""When a run is complete, what its training views hardly miss goes, and no more than they can spare."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import ShedAtEnd, Shedding
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.store.derived_scenes import ChangedScene
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step import last_shedding
from abcd_ns.engine.train.step.last_shedding import LastShedding, _Probe, random_signs
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import (
    Photos,
    listen,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    whole_scene,
)

STILL = DensityConfig(refine_start=1.0, refine_stop=0.0, price=1e-9)
"""Nothing grows, and training sheds nobody that fills anything."""
VIEWS, FAINT = 5, 30
"""Fewer views than a last shedding looks at: it looks at all of them."""


def scene(seed: int = 1) -> Gaussians:
    """The last FAINT of them are next to nothing."""
    gaussians = random_gaussians(120, seed=seed, size=0.12)
    gaussians.opacities[-FAINT:] = -5.0
    return gaussians


@pytest.fixture(scope="module")
def ring():
    return ring_of_views(VIEWS)


@pytest.fixture(scope="module")
def pictured(ring):
    return Photos(random_gaussians(150, seed=7, size=0.12), ring)


def completed(folder, ring, pictured, start=None, **options):
    """A complete run, and what it said of its last shedding."""
    options = {"blocks": 1, "steps": 40, "density": STILL, "batch": 1, "background": "black", **options}
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    coordinator = make_coordinator(folder, start or scene(), ring, target=target, **options)
    told: list = []
    coordinator.announce.subscribe(told.append)
    train(coordinator, pictured)
    return coordinator, told


def mean_psnr(coordinator, ring, pictured) -> float:
    """Of the whole scene, drawn at once."""
    gaussians, draw = whole_scene(coordinator), coordinator.run.rasterizer
    with torch.no_grad():
        pictures = [draw(gaussians, view, sh_degree=gaussians.sh_degree).color.clamp(0, 1) for view in ring]
    return float(
        sum(psnr(p, pictured.images[v.index]) for p, v in zip(pictures, ring, strict=True)) / len(ring)
    )


def at_end(told) -> ShedAtEnd:
    (event,) = [event for event in told if isinstance(event, ShedAtEnd)]
    return event


@pytest.mark.parametrize(
    "options", [{}, {"blocks": 4}, {"blocks": 4, "pass_gaussians": 1}, {"primitive": "2dgs"}]
)
def test_as_many_go_as_training_views_can_spare(tmp_path, ring, pictured, monkeypatch, options):
    with monkeypatch.context() as patched:
        patched.setattr(LastShedding, "is_wanted", False)
        all_of_it, _ = completed(tmp_path / "all", ring, pictured, **options)
    coordinator, told = completed(tmp_path / "shed", ring, pictured, **options)
    found = at_end(told)
    assert found.gone >= FAINT // 3
    assert (
        coordinator.count()
        == found.gaussians
        == len(whole_scene(coordinator))
        == all_of_it.count() - found.gone
    )
    # By units a picture is the merged one, but for the 1e-4 of light at which drawing stops.
    assert mean_psnr(all_of_it, ring, pictured) == pytest.approx(found.before, abs=0.005)
    assert mean_psnr(coordinator, ring, pictured) == pytest.approx(found.after, abs=0.005)
    assert found.before - found.after <= 0.05
    assert not [event for event in told[told.index(found) :] if isinstance(event, Shedding)]


@pytest.mark.parametrize("loss", [0.01, 0.3, 3.0])
def test_the_more_it_may_cost_the_more_go(tmp_path, ring, pictured, monkeypatch, loss):
    counts = []
    for each in (loss, 2 * loss):
        monkeypatch.setattr(last_shedding, "LOSS", each)
        _, told = completed(tmp_path / f"{each}", ring, pictured)
        assert at_end(told).before - at_end(told).after <= each
        counts.append(at_end(told).gone)
    assert counts[0] <= counts[1] > 0


def test_who_shows_in_no_view_goes_first(tmp_path, ring, pictured):
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    start = scene()
    start.means[-FAINT:, 2] += 50.0
    off = replace(STILL, strategy="mcmc", max_gaussians=len(start))  # does not take them out in training
    options = {"blocks": 2, "steps": 30, "batch": 1, "density": off, "target": target}
    coordinator = make_coordinator(tmp_path, start, ring, **options)
    train(coordinator, pictured)
    assert coordinator.count() <= len(start) - FAINT
    assert float(whole_scene(coordinator).means[:, 2].max()) < 40


def test_who_is_opaque_is_not_taken_for_one_that_does_not_show(tmp_path, ring, pictured):
    """Its alpha is at its limit wherever it is drawn: no gradient tells of its opacity."""
    opaque, start = 10, scene()
    start.means[:opaque] *= 0.5
    start.scales[:opaque] = -0.7
    start.opacities[:opaque] = 20.0
    coordinator, told = completed(tmp_path, ring, pictured, start)
    assert at_end(told).gone >= FAINT // 3
    assert int((whole_scene(coordinator).opacities > 8).sum()) == opaque


@pytest.mark.parametrize("density", [{"price": 0.0}, {"strategy": "off"}])
def test_options_keep_everything(tmp_path, ring, pictured, density):
    coordinator, told = completed(tmp_path, ring, pictured, density=replace(STILL, **density))
    assert coordinator.count() == 120
    assert not [event for event in told if isinstance(event, ShedAtEnd)]


@pytest.mark.parametrize("blocks", [1, 4])
def test_a_complete_run_goes_on_with_those_that_are_left(tmp_path, ring, pictured, blocks):
    coordinator, told = completed(tmp_path, ring, pictured, blocks=blocks)
    left = whole_scene(coordinator)
    coordinator.close()
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    options = {"steps": 80, "density": STILL, "batch": 1, "background": "black", "target": target}
    longer = make_coordinator(tmp_path, left, ring, resume=True, **options)
    again: list = []
    longer.announce.subscribe(again.append)
    assert torch.equal(whole_scene(longer).means, left.means)
    train(longer, pictured, steps=5)
    assert longer.count() == at_end(told).gaussians
    assert not [event for event in again if isinstance(event, ShedAtEnd)]
    train(longer, pictured)
    assert at_end(again).before - at_end(again).after <= 0.05


class KilledError(Exception):
    """The process ends."""


def test_who_is_killed_in_it_does_it_anew_and_once(tmp_path, ring, pictured, monkeypatch):
    def killed_at(block, *_):
        if block == 2:
            raise KilledError

    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    options = {"steps": 40, "density": STILL, "batch": 1, "background": "black", "target": target}
    coordinator = make_coordinator(tmp_path, scene(), ring, blocks=4, **options)
    with monkeypatch.context() as patched:
        take_out = LastShedding._take_out
        patched.setattr(LastShedding, "_take_out", lambda self, *of: killed_at(*of) or take_out(self, *of))
        with pytest.raises(KilledError):
            train(coordinator, pictured)
    coordinator.close()
    for times in (1, 0):
        again = make_coordinator(tmp_path, scene(), ring, resume=True, **options)
        told = listen(again, ShedAtEnd)
        assert again.finished
        train(again, pictured)
        again.complete()
        assert len(told) == times
        again.close()


def test_a_run_whose_time_is_up_between_two_looks_is_complete_all_the_same(tmp_path, ring, pictured):
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    options = {"blocks": 2, "steps": 40, "density": STILL, "batch": 1, "target": target}
    coordinator = make_coordinator(tmp_path, scene(), ring, **options)
    told = listen(coordinator, ShedAtEnd)
    while coordinator.state.step == 0 or coordinator.state.active is not None:
        train(coordinator, pictured, steps=1)
    assert not coordinator.finished
    coordinator.run.budget = Budget(steps=coordinator.state.step)
    train(coordinator, pictured)
    assert len(told) == 1


def test_what_comes_back_from_random_signs_is_what_is_missing_without_a_gaussian(tmp_path, ring, pictured):
    """In the mean over many signs, of a Gaussian at a time."""
    coordinator, _ = completed(tmp_path, ring, pictured, steps=5, density=replace(STILL, price=0.0))
    everything, draw, view = whole_scene(coordinator), coordinator.run.rasterizer, ring[0]
    whole = coordinator._last._whole
    probed, signs = _Probe(), random_signs(0)
    pictures = whole.pictures([view], ChangedScene(coordinator.scene, probed.with_leaf))
    times = 400
    for _ in range(times):
        pictures.backward([view], lambda _, picture: signs(picture.color.shape).to(picture.color))
        probed.take_note()
    found = probed.worth(0, coordinator.scene) / times
    with torch.no_grad():
        before = draw(everything, view, sh_degree=1).color
        for row in found.argsort(descending=True)[:10].tolist():
            others = torch.arange(len(everything)) != row
            missing = (draw(everything[others], view, sh_degree=1).color - before).square().sum()
            assert float(found[row]) == pytest.approx(float(missing), rel=0.3)
