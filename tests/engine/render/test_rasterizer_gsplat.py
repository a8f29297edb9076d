"""The gsplat backend's own logic, and the torch rasterizer, against stand-ins for gsplat's kernels."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.render import CutShot, Rasterizer, Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.render.cuda import backend as gsplat_backend
from abcd_ns.engine.render.cuda.backend import GsplatRasterizer
from abcd_ns.engine.render.cuda.pairs import TILE
from abcd_ns.engine.types import Crop, Gaussians, View
from tests.reference.gsplat_stand_ins import lent
from tests.reference.rasterizer_scenes import (
    as_leaves,
    assert_same_layer,
    probe,
    random_gaussians,
    random_window,
    relative_error,
    small_view,
    stacked,
)

VIEW = small_view(70, 45)


@pytest.fixture(params=["3dgs", "2dgs"])
def backend(request):
    with lent():
        yield GsplatRasterizer(request.param)


def torch_twin(backend: GsplatRasterizer, side: int = 4) -> TorchRasterizer:
    """Windows are given by tiles, so that only those of tiles of one size can be compared."""
    return TorchRasterizer(use_native=False, tile_side=side, primitive=backend.primitive.name)


@pytest.mark.parametrize("backend", ["3dgs"], indirect=True)  # gsplat gives surfels' cameras no gradient
def test_the_gradient_of_a_pose_equals_the_torch_backends(backend):
    gaussians, found = random_gaussians(40), []
    for draw in (backend, torch_twin(backend)):
        seen = replace(VIEW, viewmat=VIEW.viewmat.clone().requires_grad_())
        for _ in range(2):  # the second time, nothing is taken from what was kept
            picture = stacked(draw(gaussians, seen, sh_degree=3, antialiased=True))
            (picture * probe(*picture.shape[:2])).sum().backward()
        found.append(seen.viewmat.grad)
    assert relative_error(*found) < 1e-8


def moved(view: View, by: float = 0.0, **changes) -> View:
    viewmat = view.viewmat.clone()
    viewmat[0, 3] += by
    return replace(view, viewmat=viewmat, **changes)


def several_shots(backend, windowed: bool, with_frozen: bool) -> list[Shot]:
    """Of different sizes and near planes, with crops anywhere; some with frozen splats, none, or without."""
    views = [VIEW, moved(VIEW, 0.2), moved(VIEW, -0.3)]
    views += [moved(VIEW, 0.1, width=64), moved(VIEW, 0.3, near=2.5)]
    crops = [Crop(19, 5, 30, 31), Crop(0, 0, 17, 40), Crop(53, 16, 17, 29), Crop(32, 32, 32, 13), VIEW.full]
    shots = []
    for k, (view, crop) in enumerate(zip(views, crops, strict=True)):
        frozen = random_gaussians((0, 9, 12, 5, 3)[k], seed=k)
        seen = backend.project(frozen, view) if with_frozen and k < 4 else None
        window = random_window(backend.window_grid(crop), k) if windowed and k != 2 else None
        shots.append(Shot(view, crop, seen, window))
    return shots


@pytest.mark.parametrize(("windowed", "with_frozen"), [(False, False), (True, True)])
def test_shots_that_are_drawn_together_are_those_of_the_torch_backend(backend, windowed, with_frozen):
    found = []
    for draws in (backend, torch_twin(backend, TILE)):
        leaves = as_leaves(random_gaussians(40))
        shots = several_shots(torch_twin(backend, TILE), windowed, with_frozen)
        rasters = draws.draw(leaves, shots, sh_degree=2, residual_sums=True)
        infos = {id(raster.info): raster.info for raster in rasters}
        for info in infos.values():
            info["means2d"].retain_grad()
            own = [r for r in rasters if r.info is info]
            info["sums"].ask([probe(*r.transmittance.shape)[..., :4] for r in own])
        sum((stacked(r) * probe(*r.transmittance.shape)).sum() for r in rasters).backward()
        # One info for each size and near plane, or one for all: in the order of their cameras.
        places = [(id(raster.info), k) for k, raster in enumerate(rasters)]
        order = [k for info in infos for which, k in places if which == info]
        assert sum(len(info["radii"]) for info in infos.values()) == len(shots)
        place = torch.tensor(order).argsort()
        values = {"picture": torch.cat([stacked(raster).flatten() for raster in rasters])}
        values |= {name: value.grad for name, value in leaves.items()}
        values["means2d"] = torch.cat([info["means2d"].grad for info in infos.values()])[place]
        values["radii"] = torch.cat([info["radii"] for info in infos.values()])[place].double()
        values["sums"] = torch.cat([info["sums"].values for info in infos.values()])[place]
        found.append(values)
    for name, value in found[0].items():
        assert relative_error(value.detach(), found[1][name].detach()) < 1e-8, name


def test_where_many_views_see_gaussians_is_what_each_says(backend, monkeypatch):
    monkeypatch.setattr(gsplat_backend, "FOOTPRINT_BYTES", 2 * gsplat_backend.BYTES_PER_FOOTPRINT * 12)
    gaussians = random_gaussians(12)
    gaussians.means[0] -= 100
    views = [moved(VIEW, 2.0 * k, width=(70, 50)[k % 2], near=(0.01, 2.0)[k % 3 == 0]) for k in range(-9, 10)]
    found = backend.extents(gaussians, views)
    torch.testing.assert_close(found, torch_twin(backend, TILE).extents(gaussians, views))
    assert torch.equal(found, Rasterizer.extents(backend, gaussians, views))
    assert bool(found.isinf().any(dim=1).any())
    nobody = backend.extents(Gaussians.empty(dtype=torch.float64), views)
    assert bool((nobody[:, :2] > nobody[:, 2:]).all())


def test_depth_windows_and_cuts_of_several_views_are_the_torch_backends(backend):
    gaussians, draws = random_gaussians(60), (backend, torch_twin(backend, TILE))
    crops = {0.0: VIEW.full, 0.2: Crop(19, 5, 30, 31), -0.1: Crop(60, 40, 10, 5)}
    seen = [Shot(moved(VIEW, by), crop) for by, crop in crops.items()]
    windows = (draw.depth_windows(gaussians, seen, visible=0.1) for draw in draws)
    for found, expected in zip(*windows, strict=True):
        assert found.grid == expected.grid
        torch.testing.assert_close((found.near, found.far), (expected.near, expected.far))
    shots = []
    for shot in seen:
        window = random_window(backend.window_grid(shot.crop))
        every = ZWindow.everything(window.grid, "cpu", torch.float64)
        shots.append(CutShot(shot.view, shot.crop, *every.cut_by(window)))
    cuts = (draw.cuts(gaussians, shots, sh_degree=1) for draw in draws)
    for found, expected, shot in zip(*cuts, seen, strict=True):
        assert_same_layer(found.front, expected.front, atol=1e-9)
        assert_same_layer(found.back, expected.back, atol=1e-9)
        # gsplat's lists are longer: they hold what the square of the radius touches, drawn there or not.
        assert set(expected.kept_ids.tolist()) <= set(found.kept_ids.tolist())
        assert torch.equal(found.kept_ids, found.kept_ids.unique())
        depths = backend.project(gaussians, shot.view).depths[found.kept_ids]
        torch.testing.assert_close(found.inside.depths, depths)


def test_a_loss_of_nothing_has_a_gradient_and_its_window_is_empty(backend):
    """A block whose last Gaussian was pruned is drawn until its visit ends."""
    nobody = Gaussians.empty(1, dtype=torch.float64)
    window = next(backend.depth_windows(nobody, [Shot(VIEW, Crop(16, 0, 32, 20))], visible=0.06))
    assert bool((window.near == window.far).all())
    leaves = as_leaves(Gaussians.empty())
    shots = [Shot(small_view(dtype=torch.float32), Crop(3, 3, 5, 4))] * 2
    rasters = backend.draw(leaves, shots, sh_degree=3, residual_sums=True)
    sum(stacked(raster).sum() for raster in rasters).backward()
    assert bool((rasters[0].transmittance == 1).all())
    assert rasters[0].info["means2d"].shape == (2, 0, 2)
    assert leaves.means.grad.shape == (0, 3)
    assert "sums" not in rasters[0].info
