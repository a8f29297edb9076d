"""Photos under poses that are off: they are refined by whole pictures, and nothing stale is drawn."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from abcd_ns.engine.events import VisitBegan
from abcd_ns.engine.train.capture.poses import laid_over, turned
from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.engine.train.step.layer_source import layers_of_visit
from abcd_ns.engine.train.training_loop import train
from tests.reference.scenes import (
    STILL,
    Photos,
    assert_resumes,
    listen,
    random_gaussians,
    ring_of_views,
    steps_of,
)

TRUTH = random_gaussians(150, seed=7, size=0.12)
RING = ring_of_views(6)
NOISE = 0.01
"""Radians, and world units for each of the cameras' distance."""


STEPS = torch.randn(6, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
STEPS *= NOISE * torch.tensor([1, 1, 1, 3, 3, 3])
SHAKEN = [replace(v, viewmat=turned(v.viewmat.double(), STEPS[v.index]).float()) for v in RING]


def poses_of(run) -> torch.Tensor:
    return torch.stack([view.viewmat for _, view in sorted(run.views.items())])


@pytest.fixture(scope="module")
def photos():
    return Photos(TRUTH, RING)


@pytest.fixture
def make(make, photos, monkeypatch):
    """Makes runs that begin with the truth, under noisy poses, which are refined soon."""
    monkeypatch.setattr(pose_rounds, "FIRST", 0.0)
    options = {"density": STILL, "poses": "SO3xR3", "background": "black", "target": photos.target}
    return partial(make, start=TRUTH, views=SHAKEN, **options)


def off_by(views, others) -> float:
    """Root mean square of how far pixels of a point in the middle are apart, radians."""
    middle = torch.tensor([[0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3], [0, 0, 0]]).T
    slopes = []
    for some in (views, others):
        seen = torch.stack([view.viewmat[:3, :3] @ middle + view.viewmat[:3, 3:] for view in some])
        slopes.append(seen[:, :2] / seen[:, 2:])
    return float((slopes[0] - slopes[1]).square().mean().sqrt())


@given(st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_poses_do_not_turn_move_or_grow_together(seed):
    """What cameras did together is taken back, to first order, and what each did by itself stays."""
    draw = torch.Generator().manual_seed(seed)
    given_ = torch.stack([view.viewmat.double() for view in RING])
    world = turned(torch.eye(4).double(), 1e-4 * torch.randn(6, generator=draw, dtype=torch.float64))
    grown = given_ @ world
    grown[:, :3, 3] *= 1.0001
    assert float((grown - given_).abs().max()) > 1e-5
    assert float((laid_over(grown, given_) - given_).abs().max()) < 1e-6
    own = torch.stack([turned(v, 1e-4 * torch.randn(6, generator=draw, dtype=torch.float64)) for v in given_])
    once = laid_over(own, given_)
    assert float((once - given_).abs().max()) > 1e-5
    assert float((laid_over(once, given_) - once).abs().max()) < 1e-7


@pytest.mark.parametrize(("blocks", "together"), [(1, 0), (4, 1)])
def test_where_the_scene_is_right_poses_become_right(make, blocks, together):
    """But for what they are off by together; drawn block by block as well as at once."""
    made = make(blocks=blocks, pass_gaussians=together)
    for _ in range(8):
        made.poses.take()
    assert off_by(made.views.values(), RING) < 0.15 * off_by(SHAKEN, RING)
    assert made.state.posed == made.state.uses


def test_a_run_that_stops_goes_on_with_its_poses(make, photos):
    options = {"blocks": 4, "steps": 30, "warmup": 0.3, "coarse_model": 60}
    whole, again = assert_resumes(make, photos, 14, **options)
    assert torch.equal(poses_of(again.run), poses_of(whole.run))
    assert whole.state.posed > 0


def test_where_photos_are_too_many_for_many_uses_poses_are_refined_all_the_same(make, photos, monkeypatch):
    """From a share of the run on that the warm-up comes to, for with workers they are refined there alone."""
    monkeypatch.setattr(pose_rounds, "FIRST", 1e9)
    made = make(blocks=4, steps=60, warmup=0.4, coarse_model=60)
    while made.progress < pose_rounds.LATEST:
        train(made, photos, steps=1)
        assert made.state.posed == 0
    train(made, photos, steps=2)
    assert made.state.posed > 0


def test_poses_stay_through_a_visit_and_its_layers_show_them(make, photos):
    """They change between visits alone, and each visit's layers are drawn from where its views then are."""
    made = make(steps=60)
    seen = listen(made, VisitBegan, lambda _: poses_of(made.run))
    for _ in steps_of(made, photos):
        if made.state.active is not None:
            assert torch.equal(poses_of(made.run), seen[-1])
            layers, view = made.visit.layers, made.state.active.views[0]
            kept = layers.around(view)[0].front
            fresh = layers_of_visit(made.run, made.room, made.state.active, [view]).around(view)[0].front
            assert torch.equal(kept.color, fresh.color)
    assert sum(not torch.equal(a, b) for a, b in pairwise(seen)) > 1


def test_a_view_that_moved_is_not_drawn_with_layers_from_where_it_was(make):
    made = make()
    made.next_batch()
    view = made.state.active.views[0]
    made.run.poses.move({view: torch.full((6,), 0.01, dtype=torch.float64)})
    with pytest.raises(RuntimeError, match="moved"):
        made.next_batch()
