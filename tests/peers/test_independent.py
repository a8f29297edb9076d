"""Partition, train, merge: what a block sees, what it keeps, and that nobody else matters to it."""

import dataclasses

import pytest
import torch

from abcd_ns.engine.events import StepTaken, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.peers.independent import (
    CLEAR,
    OWN,
    enlarged,
    independent_blocks,
    independent_trainer,
    pixel_kinds,
    surface_depths,
)
from tests.reference.scenes import GROWING, STILL, assert_resumes, equal, listen


@pytest.fixture
def independent(make):
    given = {"overlap": 0.2, "layers": False, "migrate": False, "blocks": 4}
    given |= {"kind": independent_trainer, "content": independent_blocks}
    return lambda *args, **options: make(*args, **{**given, **options})


def test_a_cell_is_enlarged_by_a_share_of_its_extent():
    infinity = float("inf")
    cell = Box(*torch.tensor([[0.0, -infinity, -infinity], [2.0, 1.0, infinity]]).double())
    means = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([2.0, 10.0, 1.0])
    found = enlarged(cell, means, 0.5)
    assert found.lower.tolist() == [-1.0, -infinity, -infinity]
    assert found.upper[0] == 3.0
    assert 5.0 < found.upper[1] < 6.0
    assert found.upper[2] == infinity


def test_each_block_is_visited_once_and_the_budget_is_shared_by_views(independent, photos):
    coordinator = independent(steps=30, density=STILL, batch=1)
    begun, taken = listen(coordinator, VisitBegan), listen(coordinator, StepTaken)
    train(coordinator, photos)
    assert sorted(event.block for event in begun) == [0, 1, 2, 3]
    assert coordinator.state.step == 30
    seen = sum(event.views for event in begun)
    for event in begun:
        steps = sum(step.visit == event.visit for step in taken)
        assert abs(steps - 30 * event.views / seen) <= 2


def test_a_visit_that_begins_as_time_runs_out_is_at_its_end(independent, photos):
    coordinator = independent(blocks=3, steps=30)
    train(coordinator, photos, steps=1)
    coordinator.state.step = 30
    active = coordinator.visits.begin()
    assert active.share(coordinator.progress) == 1.0


def test_a_block_begins_with_its_overlap_and_keeps_its_cell(independent, photos, start):
    coordinator = independent(steps=12, density=STILL)
    begun, ended = listen(coordinator, VisitBegan), listen(coordinator, VisitEnded)
    tree = coordinator.scene.tree
    initial = [coordinator.scene.gaussians(b) for b in range(4)]
    train(coordinator, photos)
    for event in begun:
        box = enlarged(tree.cell(event.block), initial[event.block].means, 0.2)
        assert event.gaussians == int(box.contains(start.means).sum()) > len(initial[event.block])
    for event in ended:
        means = coordinator.scene.gaussians(event.block).means
        assert event.gaussians == len(means)
        assert bool((tree.assign(means) == event.block).all())


def test_what_others_became_is_nothing_to_a_block(independent, photos):
    """The block visited last ends up the same, whether or not the others were trained to nonsense."""
    results = []
    for name in ("plain", "spoilt"):
        coordinator = independent(name, steps=16, density=STILL, background="black")
        begun = listen(coordinator, VisitBegan)
        while not coordinator.finished:
            train_step(coordinator, photos)
            if name == "spoilt" and len(begun) < 4:
                with torch.no_grad():
                    coordinator.params["features_dc"].add_(1.0)
        results.append((begun[-1].block, coordinator.scene.gaussians(begun[-1].block)))
    (block, plain), (same, spoilt) = results
    assert block == same
    assert equal(plain, spoilt)


def test_every_pixel_is_some_blocks_and_without_overlap_just_ones(independent, views):
    coordinator = independent()
    scene = coordinator.scene
    depths = surface_depths(coordinator.run)
    for overlap in (0.0, 0.2):
        for view in views:
            owners = torch.zeros(view.height, view.width, dtype=torch.int64)
            for block in range(4):
                box = enlarged(scene.tree.cell(block), scene.gaussians(block).means, overlap)
                owners += pixel_kinds(depths[view.index], view, box) == OWN
            assert int(owners.min()) == 1
            assert (int(owners.max()) == 1) == (overlap == 0)


def test_own_pixels_pull_to_the_photo_clear_ones_to_the_background_and_hidden_ones_nowhere(
    independent, views, photos
):
    coordinator = independent(density=STILL, ssim_lambda=0.0, pixel_loss="l2", batch=len(views))
    batch = coordinator.next_batch()
    rendered = coordinator.render(batch)
    pictures = [picture.detach().requires_grad_() for picture in rendered.pictures]
    wanted = [photos(sample.view.index, sample.crop) for sample in batch.samples]
    coordinator.loss(batch, pictures, wanted).backward()
    kinds = torch.zeros(3, dtype=torch.int64)
    regions = coordinator.visits._regions(coordinator.run.active.geometry.block)
    for sample, picture, photo in zip(batch.samples, pictures, wanted, strict=True):
        _, region = regions[sample.view.index]
        masks = [region == kind for kind in (OWN, CLEAR, 0)]
        kinds += torch.stack([mask.sum() for mask in masks])
        scale = 2 / (3 * sample.view.width * sample.view.height * len(batch.samples))
        apart = {"own": picture - photo, "clear": picture - sample.background, "hidden": 0 * picture}
        for (name, difference), mask in zip(apart.items(), masks, strict=True):
            assert torch.allclose(picture.grad[mask], scale * difference[mask], atol=1e-9), name
    assert bool((kinds > 0).all())


def test_a_run_that_stops_and_goes_on_is_the_run_that_did_not(independent, photos):
    assert_resumes(independent, photos, 3, 14, steps=20, density=GROWING)


def test_a_limit_on_gaussians_is_shared_out(independent, photos, start):
    limit = len(start) + 20
    density = dataclasses.replace(GROWING, max_gaussians=limit, cull_alpha_thresh=0.0)
    coordinator = independent(steps=80, density=density, batch=1)
    began = listen(coordinator, VisitBegan)
    most: dict[int, int] = {}
    while not coordinator.finished:
        train_step(coordinator, photos)
        most[began[-1].block] = max(most.get(began[-1].block, 0), len(coordinator.params["means"]))
    for event in began:
        assert most[event.block] <= max(limit * event.gaussians / len(start), event.gaussians)
    assert any(most[event.block] > event.gaussians for event in began)


def test_a_block_keeps_to_what_a_device_holds_though_its_overlap_is_more(independent, photos):
    coordinator = independent(steps=40, density=GROWING, batch=1, sole_limit=35)
    assert max(len(coordinator.scene.gaussians(b)) for b in range(4)) < 35
    began = listen(coordinator, VisitBegan)
    while not coordinator.finished:
        train_step(coordinator, photos)
        assert len(coordinator.params["means"]) <= 35
    assert any(event.gaussians == 35 for event in began)


def test_where_harmonics_come_late_a_block_does_without(independent, photos, start):
    start = start.of_degree(0).of_degree(start.sh_degree)
    coordinator = independent(start=start, steps=40, density=STILL, sole_limit=1000, late_harmonics=2)
    while not coordinator.finished:
        train_step(coordinator, photos)
        assert coordinator.state.active is None or active_gaussians(coordinator.params).sh_degree == 0
