"""Photos that were taken in different light: a transform of each finished picture makes good for it."""

from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.train.capture.light import Light, lit
from abcd_ns.engine.train.training_loop import train
from abcd_ns.errors import UserError
from tests.reference.rasterizer_scenes import assert_same_layer
from tests.reference.scenes import (
    STILL,
    Photos,
    assert_resumes,
    random_gaussians,
    ring_of_views,
    stop,
    whole_scene,
)

GAINS = (0.75, 1.0, 1.25)
"""Their mean is 1: the light that held-out views are drawn in."""
TRUTH = random_gaussians(150, seed=7, size=0.12)
IDENTITY = torch.eye(3, 4)


class Drifting(Photos):
    def __call__(self, index, crop):
        return (GAINS[index % 3] * super().__call__(index, crop)).clamp(0, 1)


@pytest.fixture(scope="module")
def ring():
    return ring_of_views(6)


@pytest.fixture(scope="module")
def drifting(ring):
    return Drifting(TRUTH, ring)


@pytest.fixture
def make(make, ring):
    return partial(make, start=TRUTH, views=ring, density=STILL)


@pytest.fixture
def error(make, ring):
    """Gives how far a trained scene is from the truth that its photos show, in some light: L1."""

    def found(name: str, photos, light: str, **options) -> float:
        made = make(name, light=light, background="black", **options)
        train(made, photos)
        pictures = Photos(whole_scene(made), ring).images
        return float(torch.stack([(pictures[k] - photos.images[k]).abs().mean() for k in range(6)]).mean())

    return found


def transforms(light: Light) -> torch.Tensor:
    return torch.stack([light.of(view).detach() for view in sorted(light._rows)])


@given(st.integers(0, 10**6), st.integers(1, 6), st.sampled_from(["exposure", "affine"]))
def test_the_mean_transform_is_the_identity_whatever_the_gradients(seed, steps, kind):
    generator, light = torch.Generator().manual_seed(seed), Light(kind, range(5))
    for _ in range(steps):
        shown = torch.randint(5, (3,), generator=generator).tolist()  # the same view twice, at times
        light.step([(view, torch.randn(3, 4, generator=generator)) for view in shown])
    found = transforms(light)
    assert torch.allclose(found.mean(dim=0), IDENTITY, atol=1e-6)
    assert not torch.allclose(found, IDENTITY.expand_as(found), atol=1e-3)
    assert kind != "exposure" or torch.equal(found * torch.eye(3, 4), found)


def test_gradients_that_are_no_numbers_change_nothing():
    light = Light("affine", range(2))
    light.step([(0, torch.full((3, 4), torch.nan))])
    assert torch.equal(transforms(light), IDENTITY.expand(2, 3, 4))


def test_layers_and_cuts_are_those_of_a_run_without_it(make):
    """Layers, crops and transmittances know nothing of a transform: it is of the finished picture."""
    drawn = []
    for kind in ("none", "affine"):
        made = make(kind, light=kind)
        batch = made.next_batch()
        if kind == "affine":
            made.run.light._changes += 0.1 * torch.randn(6, 3, 4, generator=torch.Generator().manual_seed(3))
        rendered = made.render(batch)
        left = [raster.transmittance for raster in rendered.rasters]
        drawn.append(list(zip(batch.samples, rendered.pictures, left, strict=True)))
    for (one, plain, alone), (other, changed, same) in zip(*drawn, strict=True):
        assert one.crop == other.crop
        assert torch.equal(alone, same)
        assert_same_layer(one.layers.front, other.layers.front)
        assert_same_layer(one.layers.back, other.layers.back)
        whole = ((plain > 0) & (plain < 1)).all(dim=-1)  # the others were clamped
        expected = lit(plain, made.run.light.of(other.view.index)).clamp(0, 1)
        assert whole.any()
        assert torch.allclose(changed[whole], expected[whole], atol=1e-6)
        assert not torch.allclose(changed, plain, atol=1e-2)


def test_drifting_light_costs_next_to_nothing_once_it_is_compensated(error, ring, drifting):
    options = {"blocks": 2, "steps": 80}
    steady = error("steady", Photos(TRUTH, ring), "none", **options)
    cost = error("drift", drifting, "none", **options) - steady
    left = error("compensated", drifting, "affine", **options) - steady
    assert cost > steady
    assert left < 0.5 * cost


def test_a_run_goes_on_with_its_own_kind_of_light_alone(make, drifting):
    made = make("run", steps=12, light="affine")
    train(made, drifting, steps=6)
    stop(made)
    with pytest.raises(UserError, match=r"begun with --pipeline\.training\.light affine"):
        make("run", steps=12, light="exposure", resume=True)


def test_a_run_that_stops_goes_on_with_its_transforms_and_moments(make, drifting):
    whole, again = assert_resumes(make, drifting, 14, blocks=4, steps=30, light="affine")
    assert torch.equal(transforms(again.run.light), transforms(whole.run.light))
    assert not torch.allclose(transforms(whole.run.light), IDENTITY, atol=1e-3)
