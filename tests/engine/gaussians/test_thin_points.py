"""Points that no view can tell apart become one."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.initialize import finest_pixel, thin_points
from tests.reference.scenes import ring_of_views

VIEWS = ring_of_views(6)


def cloud(count: int, seed: int, width: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * width
    return points, torch.rand(count, 3, generator=generator) * 255


def test_a_pixel_is_as_wide_as_the_nearest_view_that_sees_the_point_has_it():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.2, 0.1], [0.0, 0.0, 90.0]])
    found = finest_pixel(points, VIEWS)
    for point, width in zip(points, found, strict=True):
        seen = []
        for view in VIEWS:
            x, y, z = (view.viewmat[:3, :3] @ point + view.viewmat[:3, 3]).tolist()
            u, v = (view.K[0, 0] * x / z + view.K[0, 2], view.K[1, 1] * y / z + view.K[1, 2])
            if z > view.near and 0 <= u < view.width and 0 <= v < view.height:
                seen.append(z / float(view.K[0, 0]))
        torch.testing.assert_close(float(width), min(seen, default=float("inf")), rtol=1e-5, atol=0)
    assert found[2].isinf()


@given(seed=st.integers(0, 1000), pixels=st.floats(0.1, 8), width=st.floats(0.05, 2.0))
def test_no_point_is_far_from_the_one_that_stands_for_it(seed, pixels, width):
    points, colors = cloud(60, seed, width)
    found, tints = thin_points(points, colors, VIEWS, pixels)
    assert 1 <= len(found) <= len(points)
    assert len(tints) == len(found)
    size = pixels * finest_pixel(points, VIEWS)
    away = torch.cdist(points.double(), found.double()).amin(dim=1)
    assert bool((away <= 3**0.5 * size + 1e-6).all())
    assert float(tints.min()) >= float(colors.min()) - 1e-3
    assert float(tints.max()) <= float(colors.max()) + 1e-3


def test_points_that_nobody_sees_stay_and_so_do_all_at_0():
    points, colors = cloud(40, 4, width=1e-4)
    unseen = points + torch.tensor([0.0, 0.0, 500.0])
    assert len(thin_points(unseen, colors, VIEWS, 2.0)[0]) == 40
    assert thin_points(points, colors, VIEWS, 0.0)[0] is points


def by_cube(points, colors, pixels: float) -> dict[tuple, list[torch.Tensor]]:
    """Rows of place and colour by cube, one point after the other; unseen points have cubes of their own."""
    cubes: dict[tuple, list[torch.Tensor]] = {}
    for row, (point, size) in enumerate(zip(points, pixels * finest_pixel(points, VIEWS), strict=True)):
        level = math.floor(math.log2(size)) if size.isfinite() else None
        cube = (-1000, row) if level is None else (level, *(point.double() / 2.0**level).floor().tolist())
        cubes.setdefault(cube, []).append(torch.cat((point, colors[row])).double())
    return cubes


@pytest.mark.parametrize("chunk", [7, 1000])
def test_points_of_a_cube_become_their_mean_cubes_in_order(monkeypatch, chunk):
    monkeypatch.setattr("abcd_ns.engine.gaussians.initialize.CHUNK", chunk)
    points, colors = cloud(200, 6, width=0.3)
    points[::11] += 400.0  # unseen
    cubes = by_cube(points, colors, 3.0)
    found = torch.cat(thin_points(points, colors, VIEWS, 3.0), dim=1)
    assert 60 < len(found) == len(cubes) < 190
    expected = torch.stack([torch.stack(cubes[cube]).mean(dim=0) for cube in sorted(cubes)])
    torch.testing.assert_close(found, expected.float(), rtol=1e-6, atol=1e-6)
