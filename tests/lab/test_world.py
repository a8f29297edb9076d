"""The procedural world: exact, and the same from everywhere."""

import pytest
import torch

from abcd_ns.lab.world.solids import Thing, ball, block, tube
from abcd_ns.lab.world.textures import Material
from abcd_ns.lab.world.world import FAR, Ball, Surfaces, camera


def test_rays_end_on_the_surface_that_is_nearest():
    world = Surfaces((Ball((0.0, 0.0, 0.0), 0.5), Ball((0.0, 0.0, 0.0), 4.0)))
    view = camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), 0)
    places, hit, _ = world.first(view)
    radii = places.norm(dim=1)
    assert bool(hit.all())
    on_ball = (radii - 0.5).abs() < 1e-9
    assert bool((on_ball | ((radii - 4.0).abs() < 1e-9)).all())
    assert bool((places[on_ball][:, 1] < 0).all())
    assert 0.05 < float(on_ball.double().mean()) < 0.5


STONE = Material("clouds", *[(0.5, 0.5, 0.5)] * 3)
SOLIDS = {
    "ball": ball((0, 0, 0), 1.0, STONE, 0.6),
    "block": block((-1, -0.5, -0.7), (1, 0.5, 0.7), STONE),
    "tube": tube(0.8, -0.6, 0.6, STONE),
}


def met(solid, origins, directions):
    """How far along each ray it is."""
    t = torch.full((directions.shape[1],), FAR)
    Thing((solid,)).meet(origins, directions, t, torch.full(t.shape, -1))
    return t


@pytest.mark.parametrize("name", sorted(SOLIDS))
def test_solids_are_met_where_they_are_and_their_normals_point_out(name):
    """From outside, rays towards the middle end on the surface; moved on by a hair they are inside."""
    solid = SOLIDS[name].placed((3.0, -1.0, 0.5), yaw=0.7)
    middle = torch.tensor(solid.center)[:, None]
    directions = torch.randn((3, 400), generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=0)
    origins = middle - 5 * directions
    t = met(solid, origins, directions)
    assert bool((t < 5).all())
    places = origins + t * directions
    inner, outer = (met(solid, places + step * directions, directions) for step in (1e-2, -1e-2))
    assert bool((inner <= 1.1e-4).all())
    assert float((outer - 1e-2).abs().max()) < 1e-3
    normals, _ = solid.surface(places)
    assert float((normals.norm(dim=0) - 1).abs().max()) < 1e-5
    assert bool(((normals * directions).sum(dim=0) < 0).all())


def test_what_is_cut_out_is_not_there_and_its_walls_face_inwards():
    pipe = tube(1.0, -1.0, 1.0, STONE, tube(0.8, -2.0, 2.0, STONE))
    origins = torch.tensor([[0.0, 0, 5], [0.9, 0, 5], [0, 0, 0]]).T
    directions = torch.tensor([[0.0, 0, -1], [0, 0, -1], [1, 0, 0]]).T
    t = met(pipe, origins, directions)
    assert t.tolist() == pytest.approx([FAR, 4.0, 0.8])
    normals, _ = pipe.surface(origins[:, 1:] + t[1:] * directions[:, 1:])
    assert torch.allclose(normals.T, torch.tensor([[0.0, 0, 1], [-1, 0, 0]]), atol=1e-6)


def test_a_thing_gives_the_first_of_its_solids():
    parts = tuple(SOLIDS[name].placed((4.0 * k, 0, 0)) for k, name in enumerate(sorted(SOLIDS)))
    thing = Thing((parts[0], Thing(parts[1:])))
    origins = torch.tensor([[-9.0, 0, 0], [20.0, 0, 0], [4.0, 0, 9], [0.0, 0, 9]]).T
    directions = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    t, which = torch.full((4,), FAR), torch.full((4,), -1)
    thing.meet(origins, directions, t, which)
    assert which.tolist() == [0, 2, 1, -1]
    assert t.tolist() == pytest.approx([8.0, 11.2, 8.3, FAR])
