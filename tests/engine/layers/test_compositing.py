"""Compositing: the algebra of layers, against the formula written out."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.compositing import composite, fold, sandwich
from abcd_ns.engine.types import Layer
from tests.engine.space.test_tree import SEEDS
from tests.reference.rasterizer_scenes import assert_same_layer

TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6}
DTYPES = st.sampled_from(list(TOLERANCE))


def random_layers(seed: int, n: int, dtype: torch.dtype) -> list[Layer]:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return [Layer(draw(3, 4, 3) / 2, draw(3, 4)) for _ in range(n)]


def by_hand(layers: list[Layer]) -> Layer:
    """Light gathered front to back: the sum of C_i times the transmittances before it, in float64."""
    color, passing = torch.zeros(3, 4, 3), torch.ones(3, 4, dtype=torch.float64)
    for layer in layers:
        color = color + passing[..., None] * layer.color
        passing = passing * layer.transmittance
    dtype = layers[0].color.dtype
    return Layer(color.to(dtype), passing.to(dtype))


@given(SEEDS, st.integers(1, 7), DTYPES)
def test_fold_is_the_sum_over_layers(seed, n, dtype):
    layers = random_layers(seed, n, dtype)
    assert_same_layer(fold(layers), by_hand(layers), TOLERANCE[dtype])


@given(SEEDS, DTYPES, st.booleans())
def test_a_sandwich_is_the_fold_on_the_background(seed, dtype, image):
    front, active, back = layers = random_layers(seed, 3, dtype)
    background = random_layers(seed + 1, 1, dtype)[0].color
    background = background if image else background[0, 0]
    expected = composite(fold(layers), background)
    found = sandwich(front, active, back, background)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=TOLERANCE[dtype])
