"""The worlds of the scenarios: exact, and the same from everywhere."""

import pytest
import torch

from abcd_ns.lab.stability.world import FAR, TABLE, Ball, Wall, World, camera, ring


def test_rays_end_on_the_surface_that_is_nearest():
    world = World((Ball((0.0, 0.0, 0.0), 0.5), Ball((0.0, 0.0, 0.0), 4.0)))
    view = camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), 0)
    places, hit, _ = world.first(view)
    radii = places.norm(dim=1)
    assert bool(hit.all())
    on_ball = (radii - 0.5).abs() < 1e-9
    assert bool((on_ball | ((radii - 4.0).abs() < 1e-9)).all())
    assert bool((places[on_ball][:, 1] < 0).all())
    assert 0.05 < float(on_ball.double().mean()) < 0.5


def test_a_wall_has_edges():
    wall = Wall(1, 1.0, 0.5)
    directions = torch.tensor([[0.0, 1, 0], [0.4, 1, 0], [0.6, 1, 0], [0, -1, 0]], dtype=torch.float64)
    assert wall.meet(torch.zeros(3, dtype=torch.float64), directions).tolist() == [1.0, 1.0, FAR, FAR]


def test_what_no_ray_meets_is_black():
    view = camera((0.0, -2.0, 0.0), (0.0, -4.0, 0.0), 0)
    assert float(World((Ball((0.0, 0.0, 0.0), 0.5),)).photo(view).abs().max()) == 0.0


def test_points_have_the_colours_of_the_photos():
    views = ring(3)
    points, colors = TABLE.points(views, 90)
    assert points.shape == colors.shape == (90, 3)
    photo = TABLE.photo(views[0], fine=1)
    local = points[:30].float() @ views[0].viewmat[:3, :3].T + views[0].viewmat[:3, 3]
    pixels = (local @ views[0].K.T)[:, :2] / local[:, 2:]
    rows, columns = pixels[:, 1].long(), pixels[:, 0].long()
    assert torch.allclose(photo[rows, columns], colors[:30] / 255, atol=1e-4)


@pytest.mark.parametrize("seed", [0, 1])
def test_textures_vary_and_are_within_range(seed):
    photo = World(TABLE.surfaces, seed).photo(ring(1)[0])
    assert 0 < float(photo.min()) < float(photo.max()) < 1
    assert float(photo.std()) > 0.08
