"""When a run is complete, what its training views hardly miss goes, and no more than they can spare."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from abcd_ns.engine.events import PrunedAtEnd, Pruning
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step import final_pruning
from abcd_ns.engine.train.step.final_pruning import FinalPruning
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from tests.engine.train.test_degrees import STILL
from tests.reference.scenes import listen, random_gaussians, whole_scene

VIEWS, FAINT = 5, 30
"""Fewer views than a final pruning looks at: it looks at all of them."""


def scene() -> Gaussians:
    """The last FAINT of them are next to nothing."""
    gaussians = random_gaussians(120, seed=1, size=0.12)
    gaussians.opacities[-FAINT:] = -5.0
    return gaussians


@pytest.fixture
def begin(make, photos):
    given = {"blocks": 1, "steps": 40, "density": STILL, "batch": 1, "target": photos.target}
    return partial(make, start=scene(), background="black", **given)


@pytest.fixture
def complete(begin, photos):
    def completed(*args, **options):
        run = begin(*args, **options)
        told = listen(run, object)
        train(run, photos)
        return run, told

    return completed


def mean_psnr(coordinator, views, photos) -> float:
    """Of the whole scene, drawn at once."""
    gaussians, draw = whole_scene(coordinator), coordinator.run.rasterizer
    with torch.no_grad():
        pictures = [draw(gaussians, view, sh_degree=gaussians.sh_degree).color.clamp(0, 1) for view in views]
    return float(sum(psnr(p, photos.images[v.index]) for p, v in zip(pictures, views, strict=True))) / VIEWS


def at_end(told) -> PrunedAtEnd:
    (event,) = [event for event in told if isinstance(event, PrunedAtEnd)]
    return event


@pytest.mark.parametrize("options", [{}, {"blocks": 4, "pass_gaussians": 1}, {"primitive": "2dgs"}])
def test_as_many_go_as_training_views_can_spare(complete, views, photos, monkeypatch, options):
    with monkeypatch.context() as patched:
        patched.setattr(FinalPruning, "run", lambda _: None)
        all_of_it, _ = complete("all", **options)
    coordinator, told = complete("pruned", **options)
    found = at_end(told)
    assert found.gone >= FAINT // 3
    assert coordinator.count() == found.gaussians == len(whole_scene(coordinator))
    assert found.gaussians == all_of_it.count() - found.gone
    # By nodes a picture is the merged one, but for the 1e-4 of light at which drawing stops.
    assert mean_psnr(all_of_it, views, photos) == pytest.approx(found.before, abs=0.005)
    assert mean_psnr(coordinator, views, photos) == pytest.approx(found.after, abs=0.005)
    assert found.before - found.after <= 0.05
    assert not [event for event in told[told.index(found) :] if isinstance(event, Pruning)]


def test_the_more_it_may_cost_the_more_go(complete, monkeypatch):
    counts = []
    for loss in (0.01, 0.3, 3.0):
        monkeypatch.setattr(final_pruning, "LOSS", loss)
        _, told = complete(f"{loss}")
        assert at_end(told).before - at_end(told).after <= loss
        counts.append(at_end(told).gone)
    assert counts == sorted(set(counts))


def test_what_shows_in_no_view_goes_first(begin, photos):
    start = scene()
    start.means[-FAINT:, 2] += 50.0
    coordinator = begin(start=start, blocks=2, steps=4)  # one visit each, which prunes nothing
    train(coordinator, photos)
    assert coordinator.count() <= len(start) - FAINT
    assert float(whole_scene(coordinator).means[:, 2].max()) < 40


def test_what_is_opaque_is_not_taken_for_what_does_not_show(complete):
    """Its alpha is at its limit wherever it is drawn: no gradient tells of its opacity."""
    opaque, start = 10, scene()
    start.means[:opaque] *= 0.5
    start.scales[:opaque] = -0.7
    start.opacities[:opaque] = 20.0
    coordinator, told = complete(start=start)
    assert at_end(told).gone >= FAINT // 3
    assert int((whole_scene(coordinator).opacities > 8).sum()) == opaque


def test_black_things_are_missed_where_training_has_other_backgrounds(begin, photos):
    """And where any picture is better without what was trained, a quarter of it stays."""
    start = random_gaussians(120, seed=1, size=0.12)
    start = replace(start, features_dc=0 * start.features_dc - 1.7, features_rest=0 * start.features_rest)
    start.opacities[:] = 4.0

    def black(view, crop):
        return 0 * photos(view, crop)

    left, given = {}, {"steps": 2, "target": lambda sample: (black(sample.view.index, sample.crop), None)}
    for color in ("random", "black"):
        coordinator = begin(color, start=start, background=color, **given)
        told = listen(coordinator, PrunedAtEnd)
        train(coordinator, black)
        left[color] = told[0].gaussians
    assert left["black"] <= 31
    assert left["random"] > 60


@pytest.mark.parametrize("density", [{"min_contribution": 0.0}, {"strategy": "off"}])
def test_options_keep_everything(complete, density):
    start = scene()
    start.means[-FAINT:, 2] += 50.0  # no view shows these
    coordinator, told = complete(start=start, blocks=2, steps=30, density=replace(STILL, **density))
    assert coordinator.scene.parameters() == 120 * 23  # and their harmonics
    assert not [event for event in told if isinstance(event, PrunedAtEnd)]


def test_a_complete_run_goes_on_with_those_that_are_left(complete, begin, photos):
    coordinator, told = complete(blocks=4)
    left = whole_scene(coordinator)
    coordinator.close()
    longer = begin(steps=60, blocks=4, resume=True)
    again = listen(longer, PrunedAtEnd)
    assert torch.equal(whole_scene(longer).means, left.means)
    train(longer, photos, steps=5)
    assert longer.count() == at_end(told).gaussians
    assert not again
    train(longer, photos)
    assert at_end(again).before - at_end(again).after <= 0.05


def test_a_run_that_is_killed_in_it_does_it_anew_and_once(begin, photos, monkeypatch):
    prune_block = FinalPruning._prune_block

    def killed(self, block, *of):
        if block == 2:
            raise KeyboardInterrupt
        return prune_block(self, block, *of)

    coordinator = begin(blocks=4)
    with monkeypatch.context() as patched:
        patched.setattr(FinalPruning, "_prune_block", killed)
        with pytest.raises(KeyboardInterrupt):
            train(coordinator, photos)
    coordinator.close()
    for times in (1, 0):
        again = begin(blocks=4, resume=True)
        told = listen(again, PrunedAtEnd)
        assert again.finished
        train(again, photos)
        again.complete()
        assert len(told) == times
        again.close()


def test_a_run_whose_time_is_up_between_two_looks_is_complete_all_the_same(begin, photos):
    coordinator = begin(blocks=2)
    told = listen(coordinator, PrunedAtEnd)
    while coordinator.state.step == 0 or coordinator.state.active is not None:
        train(coordinator, photos, steps=1)
    assert not coordinator.finished
    coordinator.run.budget = Budget(steps=coordinator.state.step)
    train(coordinator, photos)
    assert len(told) == 1
