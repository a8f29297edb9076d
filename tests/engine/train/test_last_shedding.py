"""When a run is complete, what its training views hardly miss goes, and no more than they can spare."""

import pytest
import torch

from abcd_ns.engine.events import ShedAtEnd, Shedding
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step.last_shedding import LastShedding
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

STILL = DensityConfig(refine_start=1.0, refine_stop=0.0, price=1e-9)
"""Nothing grows, and training sheds nobody that fills anything."""
VIEWS, FAINT = 4, 30
"""No more views than a last shedding looks at: it looks at all of them."""


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


def completed(folder, ring, pictured, **options):
    """A complete run, and what it said of its last shedding."""
    options = {"blocks": 1, "steps": 40, "density": STILL, "batch": 1, "background": "black", **options}
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    coordinator = make_coordinator(folder, scene(), ring, target=target, **options)
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
    assert found.gone >= FAINT // 2
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
        monkeypatch.setattr("abcd_ns.engine.train.step.last_shedding.LOSS", each)
        _, told = completed(tmp_path / f"{each}", ring, pictured)
        assert at_end(told).before - at_end(told).after <= each
        counts.append(at_end(told).gone)
    assert counts[0] <= counts[1] > 0


def test_where_nothing_has_a_price_everything_stays(tmp_path, ring, pictured):
    coordinator, told = completed(tmp_path, ring, pictured, density=DensityConfig(strategy="off"))
    assert coordinator.count() == len(scene())
    assert not [event for event in told if isinstance(event, ShedAtEnd)]


def test_a_run_that_was_stopped_has_not_shed_and_does_when_it_is_complete(tmp_path, ring, pictured):
    """Bit for bit as one that was not."""
    whole, told = completed(tmp_path / "whole", ring, pictured, blocks=4)
    target = lambda sample: (pictured(sample.view.index, sample.crop), None)  # noqa: E731
    options = {"steps": 40, "density": STILL, "batch": 1, "background": "black", "target": target}
    stopped = make_coordinator(tmp_path / "stopped", scene(), ring, blocks=4, **options)
    train(stopped, pictured, steps=25)
    stopped.save()
    stopped.scene.store.close()
    again = make_coordinator(tmp_path / "stopped", scene(), ring, resume=True, **options)
    assert again.count() == whole.count() + at_end(told).gone
    train(again, pictured)
    found, expected = whole_scene(again), whole_scene(whole)
    assert all(torch.equal(value, getattr(found, name)) for name, value in expected.items())
