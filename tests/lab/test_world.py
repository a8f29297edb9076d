"""The procedural world: exact, and the same from everywhere."""

from abcd_ns.lab.world.world import Ball, Surfaces, camera


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
