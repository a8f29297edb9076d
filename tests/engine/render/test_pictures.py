"""Pictures by the native library, and what they lack: those of the algebra of layers, in torch."""

import pytest
import torch

from abcd_ns.engine.kernels.native import library
from abcd_ns.engine.layers.compositing import composite, sandwich
from abcd_ns.engine.render import Raster
from abcd_ns.engine.render.base import Surroundings
from abcd_ns.engine.render.pictures import lacking, pictures_of, seen_behind
from abcd_ns.engine.types import Layer

pytestmark = pytest.mark.skipif(library() is None, reason="no C++ compiler")


def some(generator, *size):
    return torch.rand(size, generator=generator) * 1.5 - 0.25  # also beyond 0..1, where gradients end


def layers(generator, height, width, like):
    """None, each for itself, or, as a visit has them, parts of one tensor."""
    if like == "none":
        return None, None
    if like == "apart":
        sizes = (height, width, 3), (height, width)
        return [Layer(*(some(generator, *size) for size in sizes)) for _ in range(2)]
    kept = (
        some(generator, 2, height, width, 4)
        if like == "kept"
        else some(generator, 2, height + 3, width + 5, 4)
    )
    return [Layer(one[..., :3], one[..., 3]) for one in kept[:, :height, :width]]


@pytest.mark.parametrize("like", ["none", "apart", "kept", "part of what is kept"])
@pytest.mark.parametrize("size", [(7, 11), (1, 1), (130, 90)])
def test_a_picture_and_its_gradients_are_those_of_the_sandwich(size, like):
    generator = torch.Generator().manual_seed(3)
    front, back = layers(generator, *size, like)
    background, counts = some(generator, 3), 2.5
    planes = [some(generator, *size, 3), some(generator, *size), some(generator, *size)]
    color, transmittance, depth = (plane.requires_grad_() for plane in planes)
    (picture,) = pictures_of(
        [Raster(color, transmittance, depth, {})], [Surroundings(front, back, background, counts)]
    )
    drawn = Layer(color, transmittance)
    wanted = composite(drawn, background) if front is None else sandwich(front, drawn, back, background)
    wanted = wanted.clamp(0, 1)
    torch.testing.assert_close(picture, wanted)
    gradient = some(generator, *size, 3)
    *found, by_depth = torch.autograd.grad(picture, [color, transmittance, depth], gradient)
    torch.testing.assert_close(found, list(torch.autograd.grad(wanted, [color, transmittance], gradient)))
    shows = torch.ones(size) if front is None else front.transmittance
    torch.testing.assert_close(by_depth, counts * shows)


@pytest.mark.parametrize("like", ["none", "kept"])
@pytest.mark.parametrize("channels", [3, 4])
def test_what_a_picture_lacks_is_its_residual(like, channels):
    generator = torch.Generator().manual_seed(4)
    front, _ = layers(generator, 40, 30, like)
    in_front = None if front is None else front.transmittance
    picture, photo = some(generator, 40, 30, 3), some(generator, 40, 30, channels)
    behind, error = lacking(picture, photo, in_front)
    residual = photo[..., :3] - picture
    torch.testing.assert_close(behind, seen_behind(residual, in_front))
    torch.testing.assert_close(error, residual.square().sum(dim=-1).mean())
