"""What fills too little of its views goes, and nothing else does."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.events import Repaired
from abcd_ns.engine.render import Shot
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.influence import weights
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.density.pruning import (
    PASSES,
    blend_sums,
    contributions,
    covered,
    floaters,
    fog,
    risen,
    veils,
)
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import NEAR_PLANE, Gaussians, View
from tests.reference.scenes import activated, listen, random_gaussians, steps_of, whole_scene

STILL = DensityConfig(refine_start=1.0, refine_stop=0.0)
"""Nothing grows, and the minimum is the full one from the beginning."""
HIDDEN = 20


def statistics(weight: list[float], passes: list[float]) -> dict[str, torch.Tensor]:
    return {"weight": torch.tensor(weight), "passes": torch.tensor(passes), "worth": torch.ones(len(weight))}


def some_hidden() -> Gaussians:
    """The last HIDDEN of them are above all views."""
    gaussians = random_gaussians(120, seed=1, size=0.12)
    gaussians.means[-HIDDEN:, 2] += 50.0
    return gaussians


@given(
    weight=st.lists(st.floats(0, 100), min_size=1, max_size=20),
    views=st.integers(1, 50),
    min_contribution=st.floats(0, 20),
    looks=st.integers(0, 200),
)
def test_a_gaussian_goes_if_its_mean_weight_in_all_views_is_below_the_minimum(
    weight, views, min_contribution, looks
):
    found = (contributions(statistics(weight, [looks / views] * len(weight))) <= min_contribution).tolist()
    for value, goes in zip(weight, found, strict=True):
        per_view = value / max(looks, 1)
        if abs(per_view * views - min_contribution) > 1e-3:
            assert goes == (looks >= views and per_view * views < min_contribution)


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(1, 20), st.integers(1, 9))
def test_the_warm_ups_views_and_a_blocks_own_say_the_same(whole, block, before, now):
    """A Gaussian that fills 20 px in `block` of a scene's `whole` views, and none in the others."""
    whole, total = max(whole, block), torch.zeros(2)
    for views, passes in ((whole, before), (block, now)):
        (weight, looks) = (20.0 * passes, passes * views)
        drawn = {"weights": torch.zeros(1, 1, requires_grad=True)}
        drawn["weights"].grad = torch.full((1, 1), weight / looks)
        one = blend_sums([drawn], views)
        total += looks * torch.cat((one["weight"], one["passes"]))
    growth = {"weight": total[:1], "passes": total[1:]}
    torch.testing.assert_close(contributions(growth), torch.tensor([20.0]), rtol=1e-4, atol=0.0)


@given(
    st.lists(
        st.tuples(st.floats(0, 100), st.floats(0, 1), st.booleans()),  # px, opacity, weighed in all views
        min_size=1,
        max_size=20,
    ),
    st.floats(0, 0.1),
)
def test_a_floater_is_faint_and_fills_more_than_the_mean_of_those_known(several, faint):
    weight, opacities, known = (list(values) for values in zip(*several, strict=True))
    growth = statistics(weight, [1.0 if each else 0.5 for each in known])
    told = [px for px, each in zip(weight, known, strict=True) if each]
    mean = sum(told) / max(len(told), 1)
    bound = min(faint, 0.25 * sorted(opacities)[(len(opacities) - 1) // 2])
    found = floaters(growth, torch.tensor(opacities), faint).tolist()
    for px, opacity, each, goes in zip(weight, opacities, known, found, strict=True):
        if abs(px - mean) > 1e-3 and abs(opacity - bound) > 1e-6:
            assert goes == (each and px > mean and opacity < bound)


@pytest.mark.parametrize(
    ("progress", "ends", "expected"),
    [(0.0, 0.5, 0.0), (0.25, 0.5, 1.5), (0.5, 0.5, 3.0), (0.69, 0.5, 3.0), (0.7, 0.5, 0.0), (0.0, 0.0, 3.0)],
)
def test_the_price_rises_with_growth_and_is_off_when_nothing_could_be_made_good(progress, ends, expected):
    assert risen(3.0, progress, ends) == pytest.approx(expected)


def test_what_no_view_shows_goes_and_what_fills_much_stays(make, views, photos):
    density = replace(STILL, min_contribution=1.0)
    coordinator = make(start=some_hidden(), blocks=4, steps=80, density=density, batch=1)
    told = listen(coordinator, Repaired)
    train(coordinator, photos)
    left = whole_scene(coordinator)
    gone = 120 - len(left)
    assert sum(event.count for event in told if event.what == "pruned") == gone
    assert sum(record.pruned for record in coordinator.state.health.values()) == gone
    assert HIDDEN / 2 < gone < 2 * HIDDEN
    assert float(left.means[:, 2].max()) < 40
    shown = weights(left, coordinator.run.rasterizer, [Shot(view, view.full) for view in views])
    assert float((shown.sum(dim=0) > 0.5).float().mean()) > 0.9


def test_what_is_too_faint_for_any_picture_goes_whenever_the_block_prunes(make, photos):
    start = random_gaussians(60, seed=7, size=0.12)
    start.opacities[:] = 1.0
    start.opacities[::3] = -6.0  # a sigmoid of 1/404
    coordinator = make(start=start, blocks=2, steps=12, density=replace(STILL, min_contribution=1e-6))
    train(coordinator, photos)
    left = whole_scene(coordinator)
    assert len(left) == 40
    assert float(torch.sigmoid(left.opacities).min()) >= 1 / 255


def before_a_camera(view: View, count: int) -> Gaussians:
    """So many, wide and opaque, a twentieth before the view's camera."""
    found = random_gaussians(count, seed=3, size=0.05)
    spot = view.center + 0.05 * view.viewmat[2, :3]
    return replace(found, means=spot.expand(count, 3).clone(), opacities=torch.full((count, 1), 2.0))


def test_what_veils_a_view_is_what_its_near_plane_hides(start, views):
    views = [replace(view, near=0.2) for view in views]
    scene, rasterizer = Gaussians.cat([start, before_a_camera(views[1], 2)]), TorchRasterizer()
    whole = Shot(replace(views[1], near=NEAR_PLANE), views[1].full)
    (expected,) = weights(scene, rasterizer, [whole])
    found = veils(views, scene, rasterizer, antialiased=False)
    assert float(found[-2:].sum()) > 0.5 * whole.crop.pixels
    torch.testing.assert_close(found[-2:], expected[-2:])
    assert bool((found[:-2] == 0).all())


@pytest.mark.parametrize("blocks", [1, 4])
def test_what_veils_a_camera_goes_so_that_a_file_shows_what_the_run_does(make, views, photos, blocks):
    """It fills a little of the other views, as a floater that they see from afar."""
    near = [replace(view, near=0.2) for view in views]
    start = Gaussians.cat([random_gaussians(120, seed=1, size=0.12), before_a_camera(near[0], 1)])
    density = replace(STILL, min_contribution=1e-6)
    coordinator = make(start=start, views=near, blocks=blocks, steps=60, density=density, batch=1)
    train(coordinator, photos)
    scene, rasterizer = whole_scene(coordinator), coordinator.run.rasterizer
    assert len(scene) >= 100
    assert float((scene.means - near[0].center).norm(dim=1).min()) > 0.2
    assert float(veils(near, scene, rasterizer, antialiased=False).sum()) < 0.01 * near[0].full.pixels


@pytest.mark.parametrize(("opacity", "stays"), [(-1.0, False), (3.0, True)])
@pytest.mark.parametrize("blocks", [1, 4])
def test_what_is_faint_and_mostly_fog_goes(make, views, photos, blocks, opacity, stays):
    """It stands nearer to a camera than all that photos are known to show, and fills much of the picture."""
    views = [replace(view, nearest=1.5) for view in views]
    spot = views[0].center + 0.4 * views[0].viewmat[2, :3]
    mist = random_gaussians(1, seed=3, size=0.08)
    mist = replace(mist, means=spot[None].clone(), opacities=torch.full((1, 1), opacity))
    start = Gaussians.cat([random_gaussians(120, seed=1, size=0.12), mist])
    (expected,) = weights(start, TorchRasterizer(), [Shot(views[0], views[0].full)])
    found = fog(views, start, TorchRasterizer(), antialiased=False)
    torch.testing.assert_close(found[-1], expected[-1])
    assert float(found[-1]) > 0.1 * views[0].full.pixels
    density = replace(STILL, min_contribution=1e-6)
    coordinator = make(start=start, views=views, blocks=blocks, steps=60, density=density, batch=1)
    train(coordinator, photos)
    away = (whole_scene(coordinator).means - spot).norm(dim=1)
    assert bool((away < 0.1).any()) == stays


@pytest.mark.parametrize("many", [64, 2])
def test_what_a_gaussian_would_cover_is_what_it_weighs_alone(views, monkeypatch, many):
    monkeypatch.setattr("abcd_ns.engine.train.density.pruning.MOST_VIEWS", many)
    scene, rasterizer = random_gaussians(40, seed=1, size=0.12), TorchRasterizer()
    asked = evenly(views, many)
    assert len(asked) == min(many, len(views))
    shots = [Shot(view, view.full) for view in asked]
    alone = [weights(scene[one : one + 1], rasterizer, shots).sum() for one in range(40)]
    found = covered(views, scene, rasterizer, antialiased=False)
    expected = torch.stack(alone) * len(views) / len(asked)
    large = expected > 30
    assert int(large.sum()) > 20
    torch.testing.assert_close(found[large], expected[large], rtol=0.1, atol=0.0)


@pytest.mark.parametrize("blocks", [1, 4])
def test_what_others_hide_in_all_photos_goes_though_it_fills_some_pixels(make, photos, monkeypatch, blocks):
    monkeypatch.setattr("abcd_ns.engine.train.step.active_block.SHOWN", 0.3)
    start, density = random_gaussians(120, seed=1, size=0.2), replace(STILL, min_contribution=1e-6)
    coordinator = make(start=start, blocks=blocks, steps=60, density=density, batch=1)
    views, rasterizer = list(coordinator.views.values()), coordinator.run.rasterizer

    def shares(scene: Gaussians) -> torch.Tensor:
        shown = weights(scene, rasterizer, [Shot(view, view.full) for view in views]).sum(dim=0)
        return shown / covered(views, scene, rasterizer, antialiased=False)

    assert int((shares(start) < 0.25).sum()) > 40
    train(coordinator, photos)
    left = shares(whole_scene(coordinator))
    assert len(left) > 50
    assert float(left.min()) > 0.25


@pytest.mark.parametrize(("progress", "gone"), [(0.6, [0, 1]), (0.25, [0]), (0.8, [])])
def test_a_cloud_before_cameras_is_pruned_and_what_is_as_faint_but_small_stays(progress, gone):
    opacity, contributions = [0.02, 0.07, 0.02, 0.07, *[0.9] * 5], [90.0, 90.0, 9.0, 9.0, 90.0, *[9.0] * 4]
    gaussians = replace(random_gaussians(9), opacities=torch.tensor(opacity).logit()[:, None])
    params, optimizers = activated(gaussians)
    growth = {**statistics(contributions, [1.0] * 9), "count": torch.ones(9)}
    DensityControl(DensityConfig(min_contribution=1.0)).prune(params, optimizers, growth, progress)
    left = [each for each in range(9) if each not in gone]
    assert params["means"].tolist() == gaussians.means[left].tolist()


def test_few_views_ask_for_less():
    density = DensityConfig(min_contribution=8.0)
    assert [density.for_views(n).min_contribution for n in (5, 12, 25, 500)] == [1.6, 3.84, 8.0, 8.0]


@pytest.mark.parametrize(("blocks", "most", "asked"), [(4, 38, 30.0), (1, 1000, 60.0)])
def test_where_memory_cuts_the_scene_half_of_the_minimum_is_asked(make, photos, blocks, most, asked):
    """`most` leaves no room to cut the scene anew into fewer blocks."""
    left = []
    for limit, minimum in ((most, 60.0), (0, asked), (0, 90.0 - asked)):
        options = {"block_limit": limit, "density": replace(STILL, min_contribution=minimum)}
        coordinator = make(f"{limit}-{minimum}", blocks=blocks, steps=80, **options)
        train(coordinator, photos)
        left.append(len(whole_scene(coordinator)))
    assert left[0] == left[1] != left[2]


def test_statistics_weigh_what_lies_before_the_block(make, views, photos):
    coordinator = make(blocks=2, density=replace(STILL, min_contribution=1e-9), batch=1)
    batch, before = coordinator.next_batch(), whole_scene(coordinator)
    block = coordinator.run.active.geometry.block
    (sample,) = batch.samples
    rendered = coordinator.render(batch)
    coordinator.loss(batch, rendered.pictures, [photos(sample.view.index, sample.crop)]).backward()
    found = blend_sums(rendered.infos, len(views))["weight"]
    owner = torch.cat([torch.full((coordinator.scene.count(b),), b) for b in range(2)])
    shot = replace(sample.shot, frozen=None, z_window=None)
    expected = weights(before, coordinator.run.rasterizer, [shot])[0, owner == block]
    # Layers are half floats, and by tiles where blocks interleave.
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0.05)


def test_one_block_prunes_after_every_so_many_passes(make, views, photos):
    first = PASSES * len(views)
    density = replace(STILL, min_contribution=1e-9)
    coordinator = make(start=some_hidden(), blocks=1, steps=3 * first, density=density, batch=1)
    counts = [coordinator.count() for _ in steps_of(coordinator, photos)]
    assert counts[first - 2] == 120
    assert counts[first - 1] <= 120 - HIDDEN
    assert math.isclose(counts[-1], counts[first - 1], abs_tol=5)
